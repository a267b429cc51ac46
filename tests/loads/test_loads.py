"""Loadings that a user adds: the pressure follows the enclosed volume, and the step knows how it falls."""

from __future__ import annotations

import dataclasses
from typing import Any, cast

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxform
from jaxform import shapes
from jaxform.core.errors import InputError
from jaxform.dynamics.timestep import choose_step
from jaxform.mechanics import membrane
from jaxform.mesh import volumes
from jaxform.results.result import Result
from jaxform.sheet.active_set import active_set_of
from tests import scenes
from tests.examples.sealed_gas import SealedGas
from tests.examples.warm_gas import WarmGas
from tests.scenes import real

THICKNESS = 0.01
DEAD = 0.1


def gas(initial: float, content: float, outside: float = 1.0, inflow_time: float = 40.0) -> SealedGas:
    return SealedGas(*map(real, (initial, content, inflow_time, DEAD, outside)))


def sphere(elements: int, outside: float, stretch: float, end_time: float = 60.0) -> jaxform.Scene:
    """A quarter of a closed sphere of radius 1, filled with the gas that holds it at a stretch; at rest at first."""
    sheet = shapes.sphere(radius=1.0, elements=elements, symmetry="quarter")
    quarter = volumes.enclosed_volume(sheet.positions, sheet.triangles)
    content = (float(_bears(np.asarray(stretch))) + outside) * (DEAD + quarter * stretch**3)
    return jaxform.build_scene(
        parison=jaxform.make_parison(sheet.positions, sheet.triangles, THICKNESS, sheet.clamped, sheet.fixed),
        material=scenes.mooney(0.1),
        pressure=gas(outside * (DEAD + quarter), content, outside),
        solver=jaxform.make_solver(end_time=end_time, damping=1.0),
    )


def _retry(result: Result) -> int:
    assert result.schedule is not None
    counts = np.asarray(result.schedule.counts)
    return int(np.sum(counts[: np.flatnonzero(counts)[-1]] == 0))


def _bears(stretch: np.ndarray) -> np.ndarray:
    """Pressure of a Mooney-Rivlin sphere: 4 c (h0/r) (1/s - 1/s^7) (1 + alpha s^2)."""
    return 4 * THICKNESS * (1 / stretch - stretch**-7) * (1 + 0.1 * stretch**2)


@pytest.mark.long
def test_a_sphere_filled_with_gas() -> None:
    """In equilibrium the gas of that volume has the pressure that the sphere bears at that stretch."""
    scene = sphere(512, outside=1.0, stretch=1.5)
    result = jaxform.run(scene)
    radius = np.linalg.norm(np.asarray(result.positions), axis=1)
    assert int(result.status) == 0 and _retry(result) == 0
    # The error of 512 flat triangles.
    assert np.sqrt(np.mean(np.square(radius / 1.5 - 1.0))) < 3e-3
    assert float(jaxform.summarize(result, scene)["energy"]["balance_error"]) < 1e-3


@pytest.mark.parametrize("outside", scenes.short_first([0.1, 100.0, 10000.0]))
def test_the_step_is_below_the_limit_however_stiff_the_gas(outside: float) -> None:
    """Against the largest eigenvalue of the exact Hessian, the gas included."""
    scene = sphere(32, outside, stretch=1.1)
    state, sheet = scenes.begin_run(scene)
    active = jax.jit(active_set_of)(state, scene, sheet)
    mobile = np.asarray(sheet.compliance > 0).ravel()

    def force(flat: jax.Array) -> jax.Array:
        def energy(flat: jax.Array) -> jax.Array:
            volume = sheet.sheet.area * sheet.thickness
            geometry = flat.reshape(3, -1), sheet.sheet.triangles, sheet.sheet.inverse_metric
            return membrane.strain_energy(*geometry, volume, scene.material)

        def inside(flat: jax.Array) -> jax.Array:
            return dataclasses.replace(active, inactive_volume=real(0.0)).volume(
                active.packed.pack(flat.reshape(3, -1))
            )

        volume, rise = jax.value_and_grad(inside)(flat)
        return scene.pressure.at(state.time, volume) * rise - jax.grad(energy)(flat)

    stiffness = -np.asarray(jax.jacobian(force)(state.nodes.positions.ravel()))[np.ix_(mobile, mobile)]
    root = np.sqrt(np.asarray(sheet.compliance).ravel()[mobile])
    limit = 2.0 / np.sqrt(np.linalg.eigvalsh(root[:, None] * stiffness * root).max())
    for sharp in (True, False):
        changed = dataclasses.replace(scene, solver=dataclasses.replace(scene.solver, sharp_step=sharp))
        begin, _ = scenes.begin_run(changed)
        length, *_ = jax.jit(choose_step)(active.pack_state(begin), changed, active)
        assert 0.3 * limit < float(length) < limit
    result = jaxform.run(
        dataclasses.replace(scene, solver=dataclasses.replace(scene.solver, end_time=real(2000 * limit)))
    )
    assert int(result.status) == 0 and _retry(result) == 0


@pytest.fixture(scope="module")
def cup() -> jaxform.Scene:
    return scenes.loaded_scene(gas(initial=DEAD, content=0.5, inflow_time=16.0))


@pytest.mark.long
def test_a_gas_forms_a_cup_and_its_work_is_kept_account_of(cup: jaxform.Scene) -> None:
    result = jaxform.run(cup)
    assert int(result.status) == 0 and np.mean(np.asarray(result.contact_time) > 0) > 0.3
    assert float(result.energy.balance_error) < 2e-3


@pytest.mark.long
def test_a_gas_keeps_account_of_its_temperature() -> None:
    """Its internal energy changes by what flows in and by what work it does, outside and on the sheet."""
    gas = WarmGas(*map(real, (DEAD, 1.0, 0.02, 16.0, 1.5, 1.0, 2.5, DEAD, 1.0)))
    scene = scenes.loaded_scene(gas)
    result = jaxform.run(scene)

    def current_volume(positions: jax.Array) -> float:
        place = np.asarray(positions) + 0.0
        return volumes.enclosed_volume(place, np.asarray(scene.parison.triangles))

    assert int(result.status) == 0 and np.mean(np.asarray(result.contact_time) > 0) > 0.3
    assert float(result.energy.balance_error) < 2e-3
    more = 0.02 * min(16.0, float(result.time))
    work = float(result.energy.external_work) + current_volume(result.positions)
    held = float(result.loading.mass * result.loading.temperature) * 2.5
    np.testing.assert_allclose(result.loading.mass, DEAD + more, rtol=1e-12)
    np.testing.assert_allclose(held, 2.5 * DEAD + more * 3.5 * 1.5 - work, rtol=1e-5)


def test_what_is_no_loading_is_refused_in_words() -> None:
    with pytest.raises(InputError, match="is not a loading"):
        jaxform.loading(cast("Any", type("Nothing", (), {})))
    with pytest.raises(InputError, match="define its pressure"):
        jaxform.loading(type("Empty", (jaxform.Loading,), {}))
    with pytest.raises(InputError, match=r"pressure: is not a loading.*decorated with jaxform\.loading"):
        scenes.loaded_scene(cast("Any", 3.0))
    with pytest.raises(InputError, match=r"pressure\.content.*must be positive"):
        scenes.loaded_scene(gas(1.0, -1.0))


def test_plain_numbers_are_enough_and_a_pressure_is_one_number() -> None:
    scene = scenes.loaded_scene(cast("Any", SealedGas)(0.1, 0.5, 16.0, DEAD, 1.0))
    assert scene.pressure.content.shape == ()
    jax.grad(lambda c: jaxform.replace(scene, {"pressure.content": c}).pressure.content)(0.5)

    @jaxform.loading
    class Several(jaxform.Loading):
        def at(self, time: jax.Array, volume: jax.Array) -> jax.Array:
            return jnp.ones(4)

    @jaxform.loading
    class Untraced(jaxform.Loading):
        def at(self, time: jax.Array, volume: jax.Array) -> jax.Array:
            return real(float(time))

    with pytest.raises(InputError, match=r"pressure: gives pressures of shape \(4,\)"):
        scenes.loaded_scene(Several())

    class Growing(jaxform.Loading):
        def start(self, volume: jax.Array) -> jax.Array:
            return jnp.zeros(1)

        def after(self, own: jax.Array, interval: jaxform.Interval) -> jax.Array:
            return jnp.append(own, interval.volume)

        def at(self, time: jax.Array, volume: jax.Array, own: jax.Array) -> jax.Array:
            return own[0]

    with pytest.raises(InputError, match=r"another state after a step, float64\[2\], than at first, float64\[1\]"):
        scenes.loaded_scene(jaxform.loading(Growing)())
    with pytest.raises(InputError, match=r"does not follow the volume.*follows_volume = True"):
        jaxform.loading(type("Timed", (Growing,), {"follows_volume": False}))
    with pytest.raises(InputError, match="pressure: cannot be traced by JAX"):
        scenes.loaded_scene(Untraced())
    with pytest.raises(InputError, match=r"pressure\.content.*is a string"):
        scenes.loaded_scene(cast("Any", SealedGas)(0.1, "much", 16.0, DEAD, 1.0))

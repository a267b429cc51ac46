"""A sheet that nothing damps keeps its energy over many steps, and rounding does not decide its steps."""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxform
from jaxform import shapes
from jaxform.dynamics import timestep
from tests import scenes

_SOFT = jaxform.NeoHookean(scenes.real(1.0), scenes.real(1.0))


def _ringing_disc(pressure: float, end: float, damping: float | None = None, size: float = 1.0) -> jaxform.Scene:
    """A disc under a sudden constant pressure, which swings through; lengths and times are scaled by `size`."""
    sheet = shapes.disc(radius=size, elements=40, symmetry="quarter")
    return jaxform.build_scene(
        parison=jaxform.make_parison(sheet.positions, sheet.triangles, 0.01 * size, sheet.clamped, sheet.fixed),
        material=_SOFT,
        pressure=jaxform.make_pressure([0.0], [pressure]),
        solver=jaxform.make_solver(end_time=end * size, damping=None if damping is None else damping / size),
    )


def _energy_gain(result: jaxform.Result) -> float:
    """Energy held and lost beyond the work, over the largest work."""
    energy = result.energy
    return float((energy.strain + energy.kinetic + energy.damping_loss - energy.work) / energy.peak_work)


@pytest.mark.parametrize("end", scenes.short_first([50.0, 500.0]))
def test_a_nonlinear_disc_keeps_its_energy(end: float) -> None:
    result = jaxform.run(_ringing_disc(0.01, end))
    assert jaxform.explain(result) == "ok"
    assert int(result.steps) > 50 * end
    assert abs(_energy_gain(result)) < 2e-3


@pytest.mark.long
def test_a_disc_that_is_hardly_damped_gains_no_energy() -> None:
    result = jaxform.run(_ringing_disc(0.01, 200.0, damping=1e-3))
    assert jaxform.explain(result) == "ok"
    assert abs(_energy_gain(result)) < 0.01


@pytest.mark.long
def test_the_step_of_a_free_sheet_only_falls() -> None:
    result = jaxform.run(_ringing_disc(0.01, 500.0))
    assert result.schedule is not None
    lengths = np.asarray(result.schedule.lengths)[np.asarray(result.schedule.counts) > 0]
    assert np.all(np.diff(lengths) <= 1e-3 * lengths[1:])
    # The rest at the end is shared: no step is much shorter than the last level.
    assert lengths[-1] > 0.9 * lengths[-3]


@pytest.mark.long
def test_a_scaled_copy_takes_the_same_steps() -> None:
    """Scaled by four, lengths and times are the same numbers to the last bit but for their exponent."""
    one, four = (jaxform.run(_ringing_disc(0.02, 30.0, size=size)) for size in (1.0, 4.0))
    assert one.schedule is not None and four.schedule is not None
    np.testing.assert_array_equal(one.schedule.counts, four.schedule.counts)
    np.testing.assert_allclose(4.0 * one.positions, four.positions, rtol=0, atol=1e-6)


@pytest.mark.long
def test_every_loop_takes_the_same_steps_and_the_slope_is_that_of_differences() -> None:
    scene = _ringing_disc(0.01, 3.0)
    ran, simulated = jaxform.run(scene), jaxform.simulate(scene)
    np.testing.assert_allclose(simulated.positions, ran.positions, rtol=0, atol=1e-12)
    np.testing.assert_allclose(simulated.energy.kinetic, ran.energy.kinetic, rtol=1e-9)

    def energy(thickness: jax.Array) -> jax.Array:
        result = jaxform.simulate(jaxform.replace(scene, {"parison.thickness": thickness}), schedule=ran.schedule)
        return result.energy.kinetic + jnp.sum(result.thickness)

    found = jaxform.check_gradient(energy, scene.parison.thickness, steps=(1e-4, 1e-5, 1e-6))
    assert found.error < 1e-6


def test_weak_damping_shortens_the_step_and_strong_damping_does_not() -> None:
    scene, length = _ringing_disc(0.01, 1.0), jnp.asarray(0.01)

    def share(damping: float | None) -> float:
        solver = jaxform.make_solver(end_time=1.0, damping=damping)
        return float(timestep.damped_share(length, dataclasses.replace(scene, solver=solver)))

    assert share(None) == share(0.0) == share(1e-3) == 0.0
    assert 0.0 < share(0.1) < 1.0
    assert share(0.25) == share(10.0) == 1.0


@pytest.mark.long
def test_a_gas_that_fills_an_undamped_disc_keeps_the_balance_that_is_judged() -> None:
    """The fast modes that the gas excites have exactly the energy that it gave them, but most of the little work."""
    shape = _ringing_disc(0.01, 1.0)
    gas = jaxform.make_gas([0.0], [0.0032], temperature=1.0, gas_constant=1.0, ambient_pressure=0.5, dead_volume=0.02)
    result = jaxform.run(jaxform.build_scene(parison=shape.parison, material=_SOFT, pressure=gas, solver=shape.solver))
    assert int(result.status) == 0 and float(result.energy.balance_error) < 0.01

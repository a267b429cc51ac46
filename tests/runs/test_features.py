"""Contract of every feature: run, simulation and replay are one, energy balances, gradients equal central differences.

A few scenes that have all features between them. Of each, the programs of `run` and one more, which gives the part,
a figure of everything in it, and the figure's gradient.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxform
from jaxform import molds, shapes
from jaxform.io import output
from jaxform.mesh import meshes
from jaxform.model.replacement import number_at
from jaxform.results import summary
from jaxform.runs import padding
from jaxform.sheet.state import noise_vector
from tests import scenes
from tests.examples.cooling import Cooling
from tests.examples.warm_gas import WarmGas
from tests.examples.yeoh import Yeoh
from tests.scenes import real

PLAIN = "parison.thickness", "pressure.time", "pressure.value", "solver.damping"


def _cup(elements: int = 24, **parts: Any) -> jaxform.Scene:
    """A quarter of a disc that is blown onto the bottom of a truncated cone."""
    plain = scenes.cup(elements, 12.0)
    usual = {"parison": plain.parison, "solver": plain.solver, "mold": plain.mold, "material": scenes.mooney(0.1)}
    usual["pressure"] = jaxform.make_pressure([0.0, 16.0], [0.001, 0.3])
    return jaxform.build_scene(fill=False, **(usual | parts))  # pyright: ignore[reportArgumentType]


def _radius() -> np.ndarray:
    return np.linalg.norm(np.asarray(scenes.cup(24, 12.0).parison.positions), axis=1)


def _refinement_scene() -> jaxform.Scene:
    """Ogden's law, one list of whose numbers and whose density vary over the sheet; refined where it bends."""
    terms = jnp.asarray(np.stack([1.8 + 0.3 * _radius(), 0.05 + 0.01 * _radius()]))
    law = jaxform.Ogden(terms, jnp.asarray([2.2, 5.0]), jnp.asarray(1.0 + 0.1 * _radius()))
    return _cup(material=law, refinement=jaxform.make_refinement(angle=8.0, interval=64, max_level=2, elements=96))


def _cooling_scene() -> jaxform.Scene:
    """A sheet that cools by a fifth of its warmth while it is formed, and stiffens; refined as well."""
    plain = scenes.cup(24, 6.0)
    shift = jaxform.ArrheniusStiffness(real(140.0), real(40e3))
    modes = jaxform.Maxwell(jnp.asarray([1.0]), jnp.asarray([2.0]))
    cooling: dict[str, Any] = {"heat_capacity": 1.0, "air": 1e-4, "air_temperature": 20.0, "mold": 1e-3}
    cooling |= {"mold_temperature": 30.0, "conductivity": 1e-5}
    places = np.asarray(plain.parison.positions)
    return _cup(
        parison=dataclasses.replace(plain.parison, temperature=jnp.asarray(135.0 + 10.0 * places[:, 0])),
        material=jaxform.NeoHookean(real(1.0), real(1.0), viscous=modes, shift=shift),
        pressure=jaxform.make_pressure([0.0, 16.0], [0.001, 0.8]),
        # The search for the highest mode, which the others have, takes long to compile.
        solver=dataclasses.replace(plain.solver, safety=real(0.7), sharp_step=False),
        refinement=jaxform.make_refinement(angle=12.0, interval=64, max_level=2, elements=96),
        cooling=jaxform.Cooling(**{name: real(value) for name, value in cooling.items()}),
    )


def _plug_scene() -> jaxform.Scene:
    """A heavy sheet with Christensen's modes, which slides on a plug that rises into it."""
    shape = molds.revolved(profile=[[0.0, -0.02], [0.42, -0.02], [0.47, -0.6]], segments=48)
    motion = jaxform.make_motion([0.0, 0.0, 1.0], [0.0, 8.0], [0.0, 0.5])
    modes = jaxform.Christensen(jnp.asarray([1.0, 0.5]), jnp.asarray([2.0, 20.0]))
    plain, slippery = scenes.cup(24, 12.0), jaxform.make_contact_law("coulomb", 0.2)
    return _cup(
        mold=jaxform.make_mold(shape.vertices, shape.triangles, motion=motion, contact=slippery),
        solver=dataclasses.replace(plain.solver, gravity=jnp.asarray([0.0, 0.0, -0.02])),
        material=jaxform.NeoHookean(real(1.0), real(1.0), viscous=modes),
        pressure=jaxform.make_pressure([0.0], [0.0]),
    )


def _balloon_scene() -> jaxform.Scene:
    """An eighth of two discs that are joined along their rims; a plate stops the balloon whose rim has wrinkled."""
    sheet = shapes.disc(radius=1.0, elements=60, symmetry="quarter")
    fixed, free = np.array(sheet.fixed), np.zeros(len(sheet.positions), bool)
    fixed[np.asarray(sheet.clamped), 2] = True
    plate = np.asarray([[-2.0, -2.0, 0.3], [2.0, -2.0, 0.3], [2.0, 2.0, 0.3], [-2.0, 2.0, 0.3]])
    return _cup(
        parison=jaxform.make_parison(sheet.positions, sheet.triangles, 0.01, free, fixed),
        material=jaxform.MooneyRivlin(real(1.0), real(0.1), real(1.0), tension_field=True),
        pressure=jaxform.make_pressure([0.0, 1.0], [0.0, 2e-4]),
        solver=jaxform.make_solver(end_time=10.0, damping=0.3),
        mold=jaxform.make_mold(plate, np.asarray([[0, 1, 2], [0, 2, 3]])),
    )


def _extension_scene() -> jaxform.Scene:
    """All that a user may add: a law, a gas with a temperature of its own, and a field."""
    field = Cooling(jnp.asarray(150.0 + 30.0 * _radius()), *map(real, (0.02, 0.3, 20.0, 10.0)))
    gas = WarmGas(*map(real, (0.1, 1.0, 0.03, 16.0, 1.5, 1.0, 2.5, 0.1, 1.0)))
    return _cup(material=Yeoh(real(1.0), real(0.1), real(0.5), real(1.0)), pressure=gas, fields={"temperature": field})


COOLED = [f"cooling.{part.name}" for part in dataclasses.fields(jaxform.Cooling)]
COOLED += ["material.shift.activation_energy", "material.shift.reference"]
COOLED += ["parison.temperature", "parison.thickness"]
MODES = ["material.viscous.modulus", "material.viscous.time"]
GAS = ["pressure.inflow_temperature", "pressure.capacity", "pressure.dead_volume", "pressure.inflow"]
YEOH = ["material.c1", "material.c2", "material.c3", "material.density"]
PLUGGED = ["mold.motion.displacement", "mold.motion.time", "mold.contact.friction", "solver.gravity"]
PLUGGED += ["parison.thickness", "material.c", "material.density", *MODES]
MAKE: dict[str, tuple[Callable[[], jaxform.Scene], list[str]]] = {
    "plain": (_cup, [*PLAIN, "material.c", "material.alpha", "material.density"]),
    "refined": (_refinement_scene, [*PLAIN[:3], "material.mu", "material.alpha", "material.density"]),
    "cooled": (_cooling_scene, [*COOLED, *MODES]),
    "plugged": (_plug_scene, PLUGGED),
    "plugged in room": (_plug_scene, PLUGGED),
    "wrinkled": (_balloon_scene, ["material.c", "parison.thickness", "pressure.value"]),
    "added": (_extension_scene, [*GAS, *YEOH, "fields.temperature.initial", "fields.temperature.mold_rate", PLAIN[0]]),
}


AS_THEY_ARE = "cooled", "plugged"
"""Without room: in room two dozen runs with refinement and cooling, or of a sheet that slides, take minutes."""

LONG = [pytest.mark.long]
LONGER = "refined", "plugged in room", "wrinkled"
"""Others are refined, or slide on a plug, too; what wrinkles is in tests/materials/test_tension_field.py."""


# Those that carry a derivative.
ENERGIES = "strain", "external_work", "tool_work", "damping_loss", "contact_loss", "viscous_loss", "cooling_loss"
ENERGIES += "gravity_work", "friction_loss"


def _measure(result: jaxform.Result) -> jax.Array:
    """A figure of all that a part has and that carries a derivative, each weighted without a pattern."""
    ways = noise_vector(result.positions.T).T
    energies = sum((0.3 + 0.1 * k) * getattr(result.energy, name) for k, name in enumerate(ENERGIES))
    figure = 1e2 * jnp.sum((1.5 + ways[:, 0]) * jnp.square(result.thickness))
    figure += jnp.mean(ways * (result.positions + result.velocities)) + 10.0 * energies + result.mass
    figure += 1e-2 * jnp.mean(jnp.where(result.contact_time > 0.0, result.contact_time, 0.0))
    for values in (result.temperature, *result.fields.values()):
        if values is not None:
            figure += jnp.mean(jnp.square(jnp.where(result.active, values, 0.0) / 100.0))
    return figure + 1e-2 * sum(jnp.sum(leaf) for leaf in jax.tree.leaves(result.loading))


def _figure(
    numbers: dict[str, jax.Array], scene: jaxform.Scene, schedule: jaxform.Schedule
) -> tuple[jax.Array, jaxform.Result]:
    result = jaxform.simulate(jaxform.replace(scene, numbers), schedule=schedule)
    return _measure(result), result


_both = jax.jit(jax.value_and_grad(_figure, has_aux=True))


class Case(NamedTuple):
    """A scene with its run, and the same in room or as it is, with what may be changed of it."""

    name: str
    scene: jaxform.Scene
    ran: jaxform.Result
    room: padding.PaddedScene
    numbers: dict[str, jax.Array]

    def simulate(self, *, replayed: bool = True) -> tuple[tuple[jax.Array, jaxform.Result], dict[str, jax.Array]]:
        """Figure and part of the scene in room, and the slopes; a schedule without windows decides nothing."""
        return _simulate(self.name, replayed)

    @property
    def schedule(self) -> jaxform.Schedule:
        """The decisions of the run, for the scene in room."""
        assert self.ran.schedule is not None
        return self.room.schedule(self.ran.schedule)


@functools.cache
def _case(name: str) -> Case:
    make, names = MAKE[name]
    scene = make()
    room = padding.PaddedScene(scene, scene, None) if name in AS_THEY_ARE else padding.pad_to_bucket(scene)
    return Case(name, scene, jaxform.run(scene), room, {path: number_at(room.scene, path) for path in names})


@functools.cache
def _simulate(name: str, replayed: bool) -> Any:
    case = _case(name)
    counts = case.schedule.counts
    schedule = dataclasses.replace(case.schedule, counts=counts if replayed else jnp.zeros_like(counts))
    return _both(case.numbers, case.room.scene, schedule)


def _names(*others: str) -> list[Any]:
    """The scenes but for others."""
    return [pytest.param(name, marks=LONG if name in LONGER else []) for name in MAKE if name not in others]


@pytest.fixture(scope="module", params=_names())
def case(request: pytest.FixtureRequest) -> Case:
    return _case(request.param)


def _assert_same_part(found: jaxform.Result, expected: jaxform.Result) -> None:
    assert int(found.status) == int(expected.status) == 0 and int(found.steps) == int(expected.steps)
    count = int(expected.used.sum())
    for name in ("triangles", "level", "used"):
        np.testing.assert_array_equal(getattr(found, name)[:count], getattr(expected, name)[:count], err_msg=name)
    for name in ("wall", "stuck", "active"):
        np.testing.assert_array_equal(getattr(found, name), getattr(expected, name), err_msg=name)
    close = functools.partial(np.testing.assert_allclose, rtol=1e-9)
    for name in ("positions", "thickness", "contact_time", "stretches", "temperature"):
        one, other = getattr(found, name), getattr(expected, name)
        if other is not None:
            assert one.shape == other.shape
            close(one, other, atol=1e-12 * np.abs(other).max(), err_msg=name)
    # No more than rounding is left of them once the sheet rests.
    speed = float(np.abs(expected.positions).max() / expected.time)
    close(found.velocities, expected.velocities, atol=1e-12 * speed)
    for name in ("energy", "fields", "loading", "mass"):
        for one, other in zip(*(jax.tree.leaves(getattr(part, name)) for part in (found, expected)), strict=True):
            close(one, other, atol=1e-12 * np.abs(other).max(), err_msg=name)


def test_every_feature_is_in_use(case: Case) -> None:
    """The scenes use contact, refinement, cooling, wrinkles and what a user adds, so the other tests ask of these."""
    scene, ran = case.scene, case.ran
    assert np.sum(np.asarray(ran.contact_time) > 0) > 2
    assert scene.refinement is None or int(ran.used.sum()) > len(scene.parison.triangles)
    assert scene.cooling is None or float(jnp.ptp(jnp.asarray(ran.temperature))) > 5.0
    assert scene.motion is None or float(ran.energy.tool_work) > 1e-3
    assert scene.solver.gravity is None or (ran.energy.friction_loss > 1e-5 and abs(ran.energy.gravity_work) > 1e-5)
    assert not scene.material.tension_field or summary.wrinkle_fraction(ran).max() > 0.1


def test_energy_balances(case: Case) -> None:
    # New nodes that begin at rest lose their energy at half a step from where it is counted.
    plain = case.scene.refinement is None and isinstance(case.scene.pressure, jaxform.Pressure)
    error, limit = float(case.ran.energy.balance_error), 1e-3 if plain else 2e-3
    if case.name == "added":
        # In 192 steps of a nonlinear law trapezoids miss 0.21 % of the work: in steps of half the length a quarter.
        short = dataclasses.replace(case.scene, solver=dataclasses.replace(case.scene.solver, safety=real(0.45)))
        coarse, error, limit = error, float(jaxform.run(short).energy.balance_error), 6e-4
        assert error < 0.3 * coarse
    assert error < limit


def test_a_file_has_what_the_part_has(case: Case, tmp_path: Path) -> None:
    ran = case.ran
    output.write_part(case.scene, ran, tmp_path / "final.vtu")
    written = meshes.read_mesh(tmp_path / "final.vtu").fields
    expected = {"thickness": ran.thickness, "contact_time": ran.contact_time, **ran.fields}
    expected |= {} if ran.temperature is None else {"temperature": ran.temperature}
    for name, values in expected.items():
        np.testing.assert_allclose(written[name], np.asarray(values)[np.asarray(ran.active)], rtol=1e-12, err_msg=name)


def test_a_replay_is_the_run(case: Case) -> None:
    (_, result), _ = case.simulate()
    _assert_same_part(case.room.result(result), case.ran)


@pytest.mark.parametrize("case", _names("refined", "cooled"), indirect=True)
def test_a_simulation_is_the_run(case: Case) -> None:
    """The same for refined meshes is in tests/adapt/test_refinement.py."""
    (_, result), _ = case.simulate(replayed=False)
    _assert_same_part(case.room.result(result), case.ran)


def test_gradients_equal_central_differences_by_every_number(case: Case) -> None:
    given = case.room.scene, case.schedule

    def objective(numbers: dict[str, jax.Array]) -> tuple[jax.Array, dict[str, jax.Array]]:
        (value, _), slopes = _both(numbers, *given)
        return value, slopes

    scenes.assert_slopes(objective, case.numbers)


@pytest.mark.parametrize("case", _names(*AS_THEY_ARE), indirect=True)
def test_beyond_the_scene_itself_there_is_no_slope(case: Case) -> None:
    order, (_, slopes) = case.room.order, case.simulate()
    assert order is not None
    inside = np.zeros(order.node_capacity, bool)
    inside[order.node] = True
    assert not inside.all()
    wide = np.asarray(slopes["parison.thickness"])
    assert np.all(wide[~inside] == 0.0) and np.any(wide[inside] != 0.0)
    pressure = case.scene.pressure
    if isinstance(pressure, jaxform.Pressure) and pressure.time[-1] > case.scene.solver.end_time:
        assert np.all(np.asarray(slopes["pressure.value"])[pressure.value.size :] == 0.0)


@pytest.mark.long
@pytest.mark.parametrize("case", ["plain"], indirect=True)
def test_the_same_without_room(case: Case) -> None:
    """The same for refined meshes is in tests/adapt/test_refinement.py."""
    _assert_same_part(case.ran, jax.jit(jaxform.simulate)(case.scene))

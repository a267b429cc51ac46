"""Whole runs: the two loops agree, derivatives equal differences, energy balances, failures say so."""

from __future__ import annotations

import dataclasses
import itertools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxform
from benchmarks.speed.bench import disable_skips
from jaxform import molds, shapes
from jaxform.dynamics import window as windows
from jaxform.dynamics import window_state
from jaxform.sheet import discretization, state
from jaxform.sheet.state import Status
from tests import scenes
from tests.examples.sealed_gas import SealedGas

simulate = jax.jit(jaxform.simulate)


@pytest.fixture(scope="module")
def cup_run() -> jaxform.Result:
    """The shared cup, formed."""
    return jaxform.run(scenes.cup())


def test_compiled_code_computes_what_eager_code_does() -> None:
    """A canary: some versions of JAX computed this shape of code wrongly on the CPU, without a word."""
    matrix = jnp.asarray(np.random.default_rng(0).normal(size=(3, 3)))
    rows = jnp.asarray(np.random.default_rng(1).normal(size=(16385, 3)))

    def energy(row: jax.Array) -> jax.Array:
        return jnp.sum(jnp.square(matrix @ row))

    expected = np.sum(np.square(np.asarray(rows) @ np.asarray(matrix).T), axis=1)
    np.testing.assert_allclose(jax.jit(jax.vmap(energy))(rows), expected, rtol=1e-12)


@pytest.mark.long
def test_run_and_simulate_give_the_same_numbers() -> None:
    scene = scenes.cup()
    seen: list[float] = []
    whole = simulate(scene)
    for result in (jaxform.run(scene), jaxform.run(scene, on_window=lambda moment: seen.append(moment.time))):
        assert jaxform.explain(result) == "ok"
        np.testing.assert_allclose(result.positions, whole.positions, rtol=0, atol=1e-12)
        np.testing.assert_allclose(result.thickness, whole.thickness, rtol=1e-10)
        np.testing.assert_array_equal(result.stuck, whole.stuck)
        assert int(result.steps) == int(whole.steps)
    assert seen == sorted(seen)
    assert len(seen) == int(whole.windows)


def test_the_cup_touches_and_nothing_passes_the_wall(cup_run: jaxform.Result) -> None:
    x, y, z = np.asarray(cup_run.positions).T
    radius = np.hypot(x, y)
    assert np.asarray(cup_run.stuck).mean() > 0.5
    assert z.max() <= 0.5 + 1e-12
    # Inside the polygon of the wall: at most on the circle that its vertices lie on.
    assert np.all(radius <= 1.0 - 0.9 * z + 1e-9)
    touching = np.asarray(cup_run.contact_time) > 0
    on_wall = np.abs(z - 0.5) < 1e-9
    on_wall |= radius >= (1.0 - 0.9 * z) * np.cos(np.pi / 48) - 1e-9
    assert np.all(on_wall[touching])
    assert float(cup_run.energy.balance_error) < 1e-2


def test_a_stuck_node_never_moves_again() -> None:
    scene = scenes.cup()
    early = jaxform.run(jaxform.replace(scene, {"solver.end_time": 12.0}))
    late = jaxform.run(scene)
    stuck = np.asarray(early.stuck)
    assert stuck.sum() > 20
    shared = stuck & (np.asarray(late.contact_time) <= 11.0)
    np.testing.assert_allclose(np.asarray(early.positions)[shared], np.asarray(late.positions)[shared], atol=2e-3)
    moments = []
    jaxform.run(scene, on_window=lambda moment: moments.append(moment.result()))
    for before, after in itertools.pairwise(moments):
        held = np.asarray(before.stuck)
        np.testing.assert_array_equal(np.asarray(before.positions)[held], np.asarray(after.positions)[held])


def test_uniform_thickness_cancels_where_pressure_scales_with_it() -> None:
    scene = scenes.cup()
    double = {"parison.thickness": 2 * scene.parison.thickness, "pressure.value": 2 * scene.pressure.value}
    one, two = jaxform.run(scene), jaxform.run(jaxform.replace(scene, double))
    np.testing.assert_allclose(two.positions, one.positions, atol=1e-9)
    np.testing.assert_allclose(two.thickness, 2 * one.thickness, rtol=1e-9)


@pytest.mark.parametrize("symmetry", ["half", "quarter"])
def test_a_symmetric_part_equals_the_whole(symmetry: shapes.Symmetry) -> None:
    """A rectangle, whose cut meshes are exact parts of the whole mesh."""
    heights = []
    cuts: tuple[shapes.Symmetry, ...] = ("none", symmetry)
    for cut in cuts:
        sheet = shapes.rectangle(size=(1.0, 1.0), element_size=0.125, symmetry=cut)
        scene = jaxform.build_scene(
            parison=jaxform.make_parison(sheet.positions, sheet.triangles, 0.01, sheet.clamped, sheet.fixed),
            material=scenes.mooney(0.1),
            pressure=jaxform.make_pressure([0.0, 5.0], [0.0, 0.05]),
            solver=jaxform.make_solver(end_time=6.0, damping=1.0),
        )
        result = jaxform.run(scene)
        assert float(result.energy.balance_error) < 1e-3
        middle = np.argmin(np.linalg.norm(sheet.positions - [0.5, 0.5, 0.0], axis=1))
        heights.append(float(result.positions[middle, 2]))
    np.testing.assert_allclose(heights[1], heights[0], rtol=1e-3)


def test_energy_is_kept_without_damping() -> None:
    scene = scenes.free_disc(60, 2.0, scenes.mooney(0.1), damping=None, end_time=50.0)
    result = jaxform.run(scene)
    assert jaxform.explain(result) == "ok"
    assert float(result.energy.damping_loss) == 0.0
    assert float(result.energy.balance_error) < 1e-2


def _with_longer_steps(factor: float, *, measured: bool = False) -> jaxform.Scene:
    """A disc whose elements' bound on the step is wrong by a factor, and believed where the step is not measured."""
    scene = disable_skips(scenes.free_disc(60, 2.0, scenes.mooney(0.1)), sharp_step=measured)
    return dataclasses.replace(scene, tables=dataclasses.replace(scene.tables, bound=scene.tables.bound / factor**2))


def test_an_unstable_window_is_taken_anew_with_half_the_step() -> None:
    result, rescued = (jaxform.run(_with_longer_steps(factor)) for factor in (1.0, 2.0))
    assert jaxform.explain(rescued) == "ok"
    assert int(rescued.shortened) > int(result.shortened) == 0
    np.testing.assert_allclose(rescued.positions, result.positions, atol=1e-3)


@pytest.mark.parametrize("factor", [2.0, 1e6])
def test_a_measured_step_does_not_believe_a_bound_that_is_wrong(factor: float) -> None:
    result, other = (jaxform.run(_with_longer_steps(f, measured=True)) for f in (1.0, factor))
    assert jaxform.explain(other) == "ok"
    assert int(other.shortened) == 0 and int(other.steps) < 1.3 * int(result.steps)
    np.testing.assert_allclose(other.positions, result.positions, atol=1e-3)


def test_an_unstable_run_stops_and_says_so() -> None:
    result = jaxform.run(_with_longer_steps(1e6))  # no halving makes up for that
    assert int(result.status) & (Status.UNSTABLE | Status.NON_FINITE)
    assert np.all(np.isfinite(result.positions))
    assert "at t =" in jaxform.explain(result)
    assert float(result.time) < 60.0


def _beside_its_mold() -> jaxform.Scene:
    # A plate beside the sheet, which the balloon passes.
    plate = np.array([[1.5, 0.0, 0.0], [2.0, 0.0, 0.0], [1.5, 1.0, 0.0], [1.5, 0.0, 0.5]])
    cup = scenes.cup()
    return jaxform.build_scene(
        parison=cup.parison,
        material=cup.material,
        pressure=cup.pressure,
        solver=cup.solver,
        mold=jaxform.make_mold(plate, np.array([[0, 1, 2], [0, 2, 3]], np.int32)),
        fill=False,
    )


def test_a_sheet_that_leaves_its_mold_ends_the_run() -> None:
    scene = _beside_its_mold()
    with pytest.warns(jaxform.InputWarning):
        result = jaxform.run(scene)
    assert int(result.status) == Status.ESCAPED and "left its mold" in jaxform.explain(result)
    # 1 m, the longest side of the box, beyond it; at the next border of windows.
    assert 1.5 < np.asarray(result.positions)[:, 2].max() < 10.0
    assert float(result.time) < 0.95 * float(scene.solver.end_time)


@pytest.mark.long
def test_a_sheet_that_leaves_its_mold_ends_a_simulation() -> None:
    assert int(simulate(_beside_its_mold()).status) == Status.ESCAPED


@pytest.mark.long
def test_running_out_of_windows_is_a_status() -> None:
    scene = scenes.free_disc(60, 2.0, scenes.mooney(0.1))
    longer = jaxform.replace(scene, {"solver.end_time": 1e4})  # than its windows were counted for
    result = simulate(longer)
    assert int(result.status) == Status.WINDOWS_EXHAUSTED
    assert int(result.windows) == scene.tables.window_count


def test_a_run_plans_more_windows_by_itself_and_stops_at_the_limit_that_was_set() -> None:
    scene = scenes.free_disc(60, 2.0, scenes.mooney(0.1), end_time=10.0)
    planned = jaxform.run(scene)
    hasty = dataclasses.replace(scene, tables=dataclasses.replace(scene.tables, window_count=3))
    grown = jaxform.run(hasty)
    assert int(grown.status) == 0 and int(grown.windows) == int(planned.windows) > 3
    scenes.assert_same(grown.positions, planned.positions)
    assert grown.schedule is not None and planned.schedule is not None
    np.testing.assert_array_equal(grown.schedule.counts[:3], planned.schedule.counts[:3])
    limited = dataclasses.replace(scene, solver=dataclasses.replace(scene.solver, max_steps=100))
    stopped = jaxform.run(limited)
    assert int(stopped.status) == Status.WINDOWS_EXHAUSTED and "solver.max_steps" in jaxform.explain(stopped)
    assert 100 <= int(stopped.steps) < 100 + scene.tables.longest_window


def test_the_caller_can_stop_a_run() -> None:
    result = jaxform.run(scenes.cup(), on_window=lambda moment: moment.time > 5.0)
    assert int(result.status) == Status.STOPPED
    assert 5.0 < float(result.time) < 20.0


def test_the_run_ends_when_nothing_can_move() -> None:
    disc = shapes.disc(radius=1.0, elements=24, symmetry="quarter")
    wall = molds.revolved(profile=[[0.0, 0.1], [1.2, 0.1]], segments=24)
    scene = jaxform.build_scene(
        parison=jaxform.make_parison(disc.positions, disc.triangles, 0.01, disc.clamped, disc.fixed),
        material=scenes.mooney(0.0),
        pressure=jaxform.make_pressure([0.0, 40.0], [0.0, 0.05]),
        solver=jaxform.make_solver(end_time=50.0, damping=1.0, safety=0.5),
        mold=jaxform.make_mold(wall.vertices, wall.triangles),
        fill=False,
    )
    result = jaxform.run(scene)
    assert jaxform.explain(result) == "ok"
    assert np.all(result.stuck)
    assert float(result.time) < 25.0


def _trace(scene: jaxform.Scene) -> set[str]:
    """Files and functions of this package in which the operations of a window of a scene were made."""
    found: set[str] = set()

    def collect(jaxpr: Any) -> None:
        for equation in jaxpr.eqns:
            for frame in equation.source_info.traceback.frames:
                if "/jaxform/" in frame.file_name:
                    found.update((frame.file_name.rpartition("/jaxform/")[2], frame.function_name))
            for part in jax.tree.leaves(list(equation.params.values()), is_leaf=lambda leaf: hasattr(leaf, "eqns")):
                inner = getattr(part, "jaxpr", part)
                if hasattr(inner, "eqns"):
                    collect(inner)

    def window(scene: jaxform.Scene) -> state.State:
        return windows.window(window_state.initial_state(scene), scene, discretization.discretize(scene))

    collect(jax.make_jaxpr(window)(scene).jaxpr)
    return found


def _programs() -> list[set[str]]:
    """The results of `_trace` for a sheet alone, one over a mold, and one under a history of pressure."""
    law, history = scenes.mooney(0.1), jaxform.make_pressure([0.0], [1.0])
    return [_trace(scene) for scene in (scenes.free_disc(60, 2.0, law), scenes.cup(), scenes.loaded_scene(history))]


def test_what_a_scene_does_not_use_is_not_in_its_program() -> None:
    # In a process of its own: JAX traces a function once, and names ever after who called it first, here another test.
    free, cup, loaded = scenes.call_elsewhere(_programs)
    for part in ("contact/candidates.py", "contact/broad_phase.py", "contact/sticking.py", "pack_moving"):
        assert part in cup and part not in free
    absent = {
        "_pressure_inside",
        "model/field.py",
        "adapt/refinement.py",
        "materials/viscous.py",
        "inactive_elements",
    }
    assert not absent & (free | cup | loaded)


@pytest.mark.long
def test_one_compilation_serves_all_numbers() -> None:
    scene = scenes.free_disc(60, 2.0, scenes.mooney(0.1))
    compiled = [0]

    @jax.jit
    def fresh(scene: jaxform.Scene) -> jax.Array:
        compiled[0] += 1  # counts traces
        return jaxform.simulate(scene).thickness

    walls = [fresh(jaxform.replace(scene, {"pressure.value": jnp.asarray([0.0, 0.01 * p])})) for p in (1.0, 1.5, 2.0)]
    assert compiled == [1]
    assert walls[0].min() > walls[1].min() > walls[2].min()


@pytest.mark.parametrize(
    ("path", "value", "words"),
    [
        ("parison.thickness", -1.0, "positive"),
        ("parison.thickness", np.nan, "finite"),
        ("parison.thickness", np.ones(3), "shape"),
        ("pressure.values", 1.0, "pressure.value"),
        ("parison.positions", 1.0, "build a new scene"),
        ("material.a01", 1.0, "no such parameter"),
        ("solver.end_time", 0.0, "positive"),
    ],
)
def test_replace_refuses_what_does_not_fit(path: str, value: float | np.ndarray, words: str) -> None:
    with pytest.raises(jaxform.InputError, match=words) as caught:
        jaxform.replace(scenes.cup(), {path: value})
    assert path in str(caught.value)


def test_float32_is_close_and_warns_once(cup_run: jaxform.Result) -> None:
    with jax.enable_x64(False):
        scenes.cup.cache_clear()
        with pytest.warns(UserWarning, match="float32"):
            scene = scenes.cup()
        scenes.cup.cache_clear()
        single = jaxform.run(scene)
        assert single.thickness.dtype == np.float32
    assert int(single.status) == 0
    error = np.asarray(single.thickness, float) / np.asarray(cup_run.thickness) - 1
    assert np.sqrt(np.mean(np.square(error))) < 5e-3


def test_a_gas_between_two_parallel_symmetry_planes_is_refused() -> None:
    """The volume is counted from one point on every plane; of a strip between two it would be wrong."""
    sheet = shapes.rectangle(size=(1.0, 0.5), elements=40)
    ends = np.isclose(sheet.positions[:, 0] % 1.0, 0.0)
    fixed = np.zeros_like(sheet.fixed)
    fixed[:, 1] = np.isclose(sheet.positions[:, 1] % 0.5, 0.0)
    parts: dict[str, Any] = {
        "parison": jaxform.make_parison(sheet.positions, sheet.triangles, 0.01, ends, fixed),
        "material": scenes.mooney(0.1),
        "solver": jaxform.make_solver(end_time=1.0),
    }
    gas = SealedGas(*map(scenes.real, (1.0, 2.0, 1.0, 1.0, 1.0)))
    with pytest.raises(jaxform.InputError, match=r"parison.fixed.*y from 0 to 0.5 m"):
        jaxform.build_scene(pressure=gas, **parts)
    # Under a pressure of the time alone the edges in the farther plane count as a rim (tests/dynamics/test_rims.py).
    rim = jaxform.build_scene(pressure=jaxform.make_pressure([0.0], [1.0]), **parts).tables.rim
    assert rim is not None and np.allclose(sheet.positions[np.asarray(rim.ends), 1], 0.5)


def test_the_end_time_has_no_derivative_and_what_is_no_scene_is_told() -> None:
    scene = scenes.cup()

    def mean(end_time: jax.Array) -> jax.Array:
        return jnp.mean(jaxform.simulate(jaxform.replace(scene, {"solver.end_time": end_time})).thickness)

    for derivative in (jax.grad(mean), jax.jit(jax.grad(mean)), lambda t: jax.jvp(mean, (t,), (t,))):
        with pytest.raises(jaxform.InputError, match=r"solver\.end_time: has no derivative"):
            derivative(scene.solver.end_time)
    for call in (jaxform.simulate, jaxform.run, lambda scene: jaxform.replace(scene, {})):
        with pytest.raises(jaxform.InputError, match=r"is not a scene; use jaxform\.load"):
            call("dish")  # pyright: ignore[reportArgumentType]
    with pytest.raises(jaxform.InputError, match="is not a schedule"):
        jaxform.simulate(scene, schedule=3)  # pyright: ignore[reportArgumentType]


@pytest.mark.long
def test_a_sensitivity_map_is_the_change_per_area() -> None:
    scene = scenes.cup()
    mass = jaxform.sensitivity(scene, lambda result: result.mass)
    np.testing.assert_allclose(mass, float(scene.material.density), rtol=1e-12)  # whatever the mesh
    slope = jaxform.sensitivity(scene)
    places, triangles = np.asarray(scene.parison.positions), np.asarray(scene.parison.triangles)
    change = 1e-5 * np.asarray(scene.parison.thickness) * (1.0 + places[:, 0] - 2.0 * places[:, 1])
    corners = places[triangles]
    area = 0.5 * np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    integral = np.sum(area * (slope * change)[triangles].mean(axis=1))
    ends = []
    for sign in (1, -1):
        changed = jaxform.replace(scene, {"parison.thickness": scene.parison.thickness + sign * change})
        formed = jaxform.run(changed)
        ends.append(float(np.asarray(formed.thickness)[np.asarray(formed.active)].min()))
    np.testing.assert_allclose(integral, (ends[0] - ends[1]) / 2, rtol=1e-5)
    with pytest.raises(jaxform.InputError, match="is not a field over the sheet"):
        jaxform.sensitivity(scene, path="pressure.value")

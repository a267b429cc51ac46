"""Windows become longer while nothing happens; what a run comes to, and its derivative, stay the same."""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxform
from benchmarks.speed.bench import disable_skips, with_windows_of
from jaxform import shapes
from jaxform.dynamics import timestep, window_end
from jaxform.dynamics import window as windows
from jaxform.dynamics.window_state import initial_state
from jaxform.model.replacement import number_at
from jaxform.model.tables import LONG_WINDOW, SHORT_WINDOW
from jaxform.prepare import planning
from jaxform.sheet.active_set import ActiveSet, Workspace, active_set_of
from jaxform.sheet.discretization import discretize
from jaxform.sheet.state import State, noise_vector
from tests import scenes


def _counts(result: jaxform.Result) -> list[int]:
    assert result.schedule is not None
    counts = np.asarray(result.schedule.counts)
    return [int(count) for count in counts[counts > 0]]


@pytest.fixture(scope="module")
def cup() -> jaxform.Scene:
    """Formed so slowly that a window changes little; without the search for the highest mode, which compiles long."""
    plain = dataclasses.replace(scenes.cup(), material=scenes.mooney(0.1))
    plain = jaxform.replace(plain, {"pressure.value": jnp.asarray([0.001, 0.2])})
    scene = disable_skips(plain, sharp_step=False)
    slow = {"pressure.time": 5.0 * np.asarray(scene.pressure.time), "solver.end_time": 100.0, "solver.damping": 1.0}
    tables = dataclasses.replace(scene.tables, window_count=40, longest_window=LONG_WINDOW)
    return dataclasses.replace(jaxform.replace(scene, slow), tables=tables)


@pytest.fixture(scope="module")
def cup_result(cup: jaxform.Scene) -> jaxform.Result:
    return jaxform.run(cup)


@pytest.mark.long
def test_the_wall_is_that_of_short_windows(cup: jaxform.Scene, cup_result: jaxform.Result) -> None:
    short = jaxform.run(with_windows_of(SHORT_WINDOW, cup))
    assert jaxform.explain(cup_result) == jaxform.explain(short) == "ok"
    assert max(_counts(short)) <= SHORT_WINDOW < max(_counts(cup_result))
    assert int(cup_result.windows) < int(short.windows)
    # Other windows are halted and other steps taken, as with larger balls.
    np.testing.assert_allclose(cup_result.positions, short.positions, rtol=0, atol=2e-4)
    np.testing.assert_allclose(cup_result.thickness, short.thickness, rtol=4e-3)
    np.testing.assert_allclose(cup_result.energy.external_work, short.energy.external_work, rtol=1e-3)
    np.testing.assert_array_equal(cup_result.stuck, short.stuck)


def test_after_one_that_was_cut_short_comes_a_short_one() -> None:
    """A disc whose pressure jumps, so that a long window turns over more energy than it says."""
    disc = scenes.free_disc(60, 2.0, scenes.mooney(0.1))
    jump = jaxform.make_pressure([0.0, 20.0, 20.01], [0.0, 0.02, 0.08])
    scene = dataclasses.replace(disc, pressure=jump, solver=jaxform.make_solver(end_time=22.0, damping=0.5))
    schedule = jaxform.run(with_windows_of(LONG_WINDOW, scene)).schedule
    assert schedule is not None
    counts = np.asarray(schedule.counts)
    rejected = np.flatnonzero((counts == 0) & (np.asarray(schedule.lengths) > 0.0))
    assert len(rejected) and counts[rejected[0] - 1] > SHORT_WINDOW
    assert all(counts[k + 1] <= SHORT_WINDOW for k in rejected)


@pytest.mark.parametrize(("gain", "retried"), [(0.01, True), (0.003, False), (-0.01, False)])
def test_a_window_that_gains_energy_is_retried_though_damping_would_take_it_away(
    monkeypatch: pytest.MonkeyPatch, gain: float, retried: bool
) -> None:
    """A folded web gained 1.5 % of the work in one window of a run with damping, and the run ended unbalanced."""
    disc = scenes.free_disc(60, 2.0, scenes.mooney(0.1))
    solver = jaxform.make_solver(end_time=22.0, damping=20.0)
    scene = dataclasses.replace(disc, pressure=jaxform.make_pressure([0.0, 20.0], [0.0, 0.08]), solver=solver)
    scene = disable_skips(scene, sharp_step=False)
    state, sheet = scenes.begin_run(scene)
    advance = jax.jit(lambda state: windows.window(state, scene, sheet, differentiable=False))
    for _ in range(12):
        state = advance(state)
    assert int(state.control.retries) == 0
    health = window_end._health

    def gained(new: Any, *given: Any) -> Any:
        status, imbalance = health(new, *given)
        return status, imbalance + gain * new.account.peak_work

    monkeypatch.setattr(window_end, "_health", gained)
    after = windows.window(state, scene, sheet, differentiable=False)
    assert int(after.control.retries) == retried and int(after.shortened - state.shortened) == retried
    assert (float(after.time) > float(state.time)) is not retried


def test_no_window_takes_more_of_a_velocity_than_can_be_found_again(cup: jaxform.Scene) -> None:
    def longest(damping: float | None, length: float = 0.05) -> int:
        scene = dataclasses.replace(cup, solver=jaxform.make_solver(end_time=20.0, damping=damping))
        return int(timestep.max_step_count(jnp.asarray(length), scene))

    assert longest(None) == longest(0.0) == longest(0.1) == LONG_WINDOW
    assert longest(50.0) == longest(1e6) == SHORT_WINDOW
    for damping in (0.8, 1.0, 1.3):
        assert SHORT_WINDOW < longest(damping) < LONG_WINDOW
        half = 0.5 * damping * 0.05
        left = ((1.0 - half) / (1.0 + half)) ** np.array([longest(damping), longest(damping) + 1])
        assert left[1] < timestep.LEAST_LEFT <= left[0]


def test_windows_become_shorter_where_the_stiffness_changes_or_one_is_taken_anew() -> None:
    """Blown up evenly, and nearly at once."""
    law = jaxform.ModifiedMooneyRivlin(scenes.real(1.0), scenes.real(0.05), scenes.real(1.0))
    scene = with_windows_of(LONG_WINDOW, disable_skips(scenes.free_disc(60, 2.0, law), sharp_step=False))
    changing = anew = 0
    for pressure in ([0.0, 0.15, 0.3], [0.0, 0.01, 0.3]):
        at = [0.0, 20.0, 40.0] if pressure[1] > 0.1 else [0.0, 20.0, 22.0]
        run = jaxform.run(dataclasses.replace(scene, pressure=jaxform.make_pressure(at, pressure)))
        assert jaxform.explain(run) == "ok"
        assert run.schedule is not None
        last = int(run.windows) - 2
        counts, bounds = np.asarray(run.schedule.counts), np.asarray(run.schedule.bounds)
        for k in range(1, last):
            if counts[k] == 0:
                anew += 1
                assert counts[k + 1] <= SHORT_WINDOW
            elif abs(bounds[k] / bounds[k - 1] - 1.0) > 0.05:
                changing += counts[k] > SHORT_WINDOW
                assert counts[k + 1] < counts[k] or counts[k + 1] <= SHORT_WINDOW
            else:
                assert counts[k + 1] <= 2 * counts[k]
        assert counts.max() == LONG_WINDOW
    assert changing > 2
    assert anew > 0


def _weigh(
    values: dict[str, jax.Array],
    vertices: jax.Array,
    scene: jaxform.Scene,
    adjoint: jaxform.Adjoint | None,
) -> tuple[jax.Array, jaxform.Result]:
    """All of a result that carries a derivative, weighted without a pattern; and the result."""
    assert scene.mold is not None
    changed = jaxform.replace(scene, values)
    changed = dataclasses.replace(changed, mold=dataclasses.replace(scene.mold, vertices=vertices))
    result = jaxform.simulate(changed, adjoint=adjoint)
    ways = noise_vector(result.positions.T).T
    energies = sum(jax.tree.leaves(result.energy))
    landing_time = jnp.mean(jnp.where(result.contact_time > 0.0, result.contact_time, 0.0))
    wall = jnp.mean((1.0 + ways[:, 0]) * jnp.square(result.thickness / 0.005))
    return wall + jnp.mean(ways * (result.positions + result.velocities)) + 0.3 * energies + 0.01 * landing_time, result


_slopes = jax.jit(jax.value_and_grad(_weigh, argnums=(0, 1), has_aux=True), static_argnames="adjoint")


def test_every_loop_takes_the_same_windows_and_all_derivatives_agree(
    cup: jaxform.Scene, cup_result: jaxform.Result
) -> None:
    """The host's loop and those that can be differentiated.

    By hand all steps are taken back; with every step kept the derivative is JAX's, which takes a long window as several
    short ones, in forward mode as well. Of everything that a design may change, and of the mold.
    """
    assert cup.mold is not None and cup.solver.damping is not None
    paths = "parison.thickness", "pressure.time", "pressure.value", "solver.damping"
    paths += "material.c", "material.alpha", "material.density"
    values = {path: number_at(cup, path) for path in paths}
    at = values, cup.mold.vertices
    # By hand with the steps of three windows at a time; of each by itself: tests/runs/test_features.py.
    ways = jaxform.Stored(), jaxform.Reversed(windows=3)
    expected: Any = None
    for adjoint in ways:
        (value, result), slopes = _slopes(*at, cup, adjoint=adjoint)
        assert _counts(result) == _counts(cup_result)
        np.testing.assert_allclose(result.positions, cup_result.positions, rtol=0, atol=1e-12)
        expected = (value, slopes) if expected is None else expected
        _assert_close((value, slopes), expected)
    change = jax.tree.map(lambda value: value * jnp.cos(jnp.arange(value.size)).reshape(value.shape), at)
    forward = jax.jit(lambda at, change, scene: jax.jvp(lambda x: _weigh(x[0], x[1], scene, None)[0], (at,), (change,)))
    along = sum(map(jnp.vdot, jax.tree.leaves(expected[1]), jax.tree.leaves(change)))
    np.testing.assert_allclose(forward(at, change, cup)[1], along, rtol=1e-9)
    # Steps with so much damping that they cannot be taken back are worked out once more.
    damped = values | {"solver.damping": scenes.real(20.0)}, cup.mold.vertices
    found = [_slopes(*damped, cup, adjoint=adjoint) for adjoint in ways]
    _assert_close(*((value, slopes) for (value, _), slopes in found))


def _assert_close(found: Any, expected: Any) -> None:
    for own, other in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
        assert np.abs(other).max() > 1e-6
        np.testing.assert_allclose(own, other, rtol=1e-9, atol=1e-11 * np.abs(other).max())


@pytest.mark.parametrize(
    ("short_ones", "frames", "longest"),
    [(60, 0, 64), (130, 0, 128), (260, 0, 256), (9000, 0, 256), (260, 8, 256), (260, 16, 128), (260, 40, 64)],
)
def test_there_are_enough_windows_to_look_at_a_run(short_ones: int, frames: int, longest: int) -> None:
    """A built scene knows how many short windows it may take; a run takes a quarter of them, or more."""
    assert planning.longest_window(short_ones, frames) == longest


def test_a_run_that_ends_sooner_has_as_many_windows() -> None:
    scene = scenes.cup(end_time=400.0)
    assert scene.tables.longest_window == LONG_WINDOW
    for share, longest in ((2.0, LONG_WINDOW), (1.0, LONG_WINDOW), (0.6, 128), (0.1, SHORT_WINDOW)):
        ended = jaxform.replace(scene, {"solver.end_time": share * 400.0})
        assert ended.tables.longest_window == longest
    traced = jax.jit(lambda end: jaxform.replace(scene, {"solver.end_time": end}))(40.0)
    assert traced.tables.longest_window == LONG_WINDOW


def test_with_refinement_all_windows_are_short() -> None:
    sheet = shapes.rectangle(size=(1.0, 1.0), elements=8)
    assert scenes.refinable(sheet, 256).tables.longest_window == SHORT_WINDOW


@pytest.mark.long
def test_what_is_left_in_the_room_of_the_last_window_counts_for_nothing() -> None:
    scene = scenes.cup()

    def begun(state: State) -> tuple[State, ActiveSet]:
        active = windows.allocate_workspace(active_set_of(state, scene, discretize(scene)), scene)
        return active.pack_state(state), active

    @jax.jit
    def several(state: State, active: ActiveSet) -> tuple[State, ActiveSet]:
        window = lambda _, now: windows.window_in_place(now[0], scene, now[1])  # noqa: E731
        return jax.lax.fori_loop(0, 9, window, (state, active))

    def full(room: jax.Array) -> jax.Array:
        """Values that spoil everything; places and triangles that exist, as an old list's do."""
        return jnp.full_like(room, jnp.nan if jnp.issubdtype(room.dtype, jnp.floating) else 1)

    state, active = jax.jit(begun)(initial_state(scene))
    spoiled = dataclasses.replace(active, workspace=jax.tree.map(full, active.workspace))
    end, after = several(state, active)
    again, _ = several(state, spoiled)
    assert bool(jnp.any(end.nodes.stuck & ~state.nodes.stuck))
    assert isinstance(after.workspace, Workspace)
    assert after.workspace.basis is not None
    assert bool(jnp.any(after.workspace.basis))  # it was written in
    jax.tree.map(np.testing.assert_array_equal, again, end)

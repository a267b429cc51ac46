"""Bounds hold no search: starts on them, slopes there, and what is said where a search stands still."""

from __future__ import annotations

import dataclasses
import functools
import itertools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxform
import optimize
from jaxform.mesh.grids import Profile
from optimize import fixed_point, sensitivity_check, termination
from optimize.descent import lbfgs
from optimize.designs import Point
from optimize.gradients import gradient_error, slope_within
from optimize.least_squares import _step, _trials
from optimize.search import Search
from optimize.variables import (
    SPAN,
    apply_bounds,
    apply_log_bounds,
    apply_step_limit,
    invert_bounds,
    invert_log_bounds,
    invert_step_limit,
)
from tests import scenes

HIDDEN = np.array([0.015, 0.012, 0.01, 0.009])
BOUNDS = (0.008, 0.03)


@functools.cache
def _hidden_wall() -> np.ndarray:
    scene = scenes.cup()
    sheet = Profile("radius", (0.0, 1 / 3, 2 / 3, 1.0), tuple(HIDDEN))(np.asarray(scene.parison.positions, float))
    return np.asarray(jaxform.run(jaxform.replace(scene, {"parison.thickness": sheet})).thickness)


def _study(thickness: float, **options: Any) -> optimize.Study:
    """The wall that a known profile makes, sought from a uniform sheet."""
    scene = scenes.cup()
    sheet = np.full(scene.parison.thickness.shape, thickness)
    scene = jaxform.replace(scene, {"parison.thickness": sheet})
    variable = optimize.ThicknessProfile(scene, along="radius", bounds=BOUNDS, knots=4)
    return optimize.Study(scene, (variable,), optimize.Target(scene, _hidden_wall()), **options)


def _even(thickness: float, bounds: tuple[float, float], **options: Any) -> optimize.Study:
    """A wall as even as can be, sought from a uniform sheet."""
    scene = scenes.cup()
    scene = jaxform.replace(scene, {"parison.thickness": np.full(scene.parison.thickness.shape, thickness)})
    variable = optimize.ThicknessProfile(scene, along="radius", bounds=bounds, knots=4)
    return optimize.Study(scene, (variable,), optimize.Uniform(), **options)


@pytest.mark.parametrize("into", [apply_bounds, apply_log_bounds])
def test_the_map_is_as_steep_on_a_bound_as_in_the_middle(into: Any) -> None:
    ends = 0.5 * SPAN * np.array([-1.0, 0.0, 1.0])
    values = np.asarray(into(jnp.asarray(ends), (2.0, 5.0)))
    slopes = np.diag(jax.jacobian(lambda free: into(free, (2.0, 5.0)))(jnp.asarray(ends)))
    assert values[0] == 2.0 and values[2] == 5.0
    shares = slopes / 3.0 if into is apply_bounds else slopes / values / np.log(2.5)
    np.testing.assert_allclose(shares, 1 / SPAN, rtol=1e-12)
    beyond = np.asarray(into(jnp.asarray(3.7 * ends), (2.0, 5.0)))
    assert beyond[0] == 2.0 and beyond[2] == 5.0


@pytest.mark.parametrize("bounds", [(0.1, 0.3), (1e-3, 2e-3), (3e-5, 1.5e-3)])
def test_values_on_a_bound_come_back_exactly(bounds: tuple[float, float]) -> None:
    for into, back in ((apply_bounds, invert_bounds), (apply_log_bounds, invert_log_bounds)):
        np.testing.assert_array_equal(into(jnp.asarray(back(np.array(bounds), bounds)), bounds), bounds)


def test_a_sheet_on_its_bounds_starts_there() -> None:
    scene = scenes.cup()
    for edge in BOUNDS:
        thick = jaxform.replace(scene, {"parison.thickness": np.full(scene.parison.thickness.shape, edge)})
        for variable in (
            optimize.ThicknessProfile(thick, along="radius", bounds=BOUNDS, knots=4),
            optimize.ThicknessField(thick, bounds=BOUNDS, smoothness=0.4),
        ):
            np.testing.assert_array_equal(np.abs(variable.start), variable.reach)


def test_values_on_a_limit_of_neighbours_come_back_and_have_slopes() -> None:
    values, change = np.array([2.0, 2.5, 2.3, 3.3, 5.0]), np.array([0.5, 0.2, 1.0, 1.7])
    free = jnp.asarray(invert_step_limit(values, (2.0, 5.0), change))
    np.testing.assert_allclose(apply_step_limit(free, (2.0, 5.0), change), values, rtol=1e-12)
    slopes = np.diag(jax.jacobian(lambda free: apply_step_limit(free, (2.0, 5.0), change))(free))
    assert slopes.min() > 0.09
    # A history that never falls and has come to its largest value: all but the first of its knots can go down.
    variable = optimize.PressureKnots(scenes.cup(), bounds=(0.0, 0.25), increasing=True)
    changes = np.asarray(jax.jacobian(lambda x: variable.changes(x)["pressure.value"])(jnp.asarray(variable.start)))
    assert np.all(np.isfinite(changes)) and changes.max(axis=0)[0] > 0.05


@pytest.mark.long
@pytest.mark.parametrize("edge", scenes.short_first(BOUNDS))
@pytest.mark.parametrize("method", scenes.short_first(["lbfgs", "least-squares"]))
def test_a_search_from_a_bound_finds_a_wall_that_is_within_reach(method: str, edge: float) -> None:
    design = optimize.solve(_study(edge, method=method, iterations=15, warm_start=0))
    assert design.history[0]["thickness_rms_error"] > 0.1
    assert design.best_row["thickness_rms_error"] < 5e-3, (design.message, len(design.history))
    assert len(design.history) <= 40
    found = np.asarray(design.changes["parison.thickness"]["value"])
    np.testing.assert_allclose(found, HIDDEN, rtol=0.04)
    assert design.gradient_error is not None and design.gradient_error < 1e-5


def test_the_warm_start_of_an_even_wall_is_as_good_from_a_bound_as_from_the_middle() -> None:
    """A factor on the sheet is free: one that leaves its bounds is scaled into them, and each level is tried."""
    bounds, found, steps = (0.01, 0.02), [], []
    for thickness in (bounds[0], float(np.sqrt(bounds[0] * bounds[1])), bounds[1]):
        study = _even(thickness, bounds)
        search = Search(study, None, 1.0)
        fixed_point.warm_start(search, study, search.start)
        assert search.best is not None
        found.append(search.best.objective**0.5)
        steps.append(len(search.history) - search.iteration - 1)
    np.testing.assert_allclose(found, 0.0232, rtol=0.01)
    assert steps == [2, 2, 2]  # beside the updates, the thinnest and the thickest such sheet


@pytest.mark.long
def test_an_optimum_on_a_bound_is_kept_exactly_and_called_one() -> None:
    """The even wall asks for a middle three times as thick as the rim; the bounds leave it twice."""
    bounds = (0.01, 0.02)
    design = optimize.solve(_even(0.01, bounds, iterations=40, warm_start=0))
    found = np.asarray(design.changes["parison.thickness"]["value"])
    assert found.max() == bounds[1] or found.min() == bounds[0]
    assert np.all((found >= bounds[0]) & (found <= bounds[1]))
    middle = optimize.solve(_even(0.014, bounds, iterations=40, warm_start=0))
    np.testing.assert_allclose(design.objective**0.5, middle.objective**0.5, rtol=0.1)
    assert design.stopped_by in ("tolerance", "gradient_tolerance", "no-step")


def _at_design(value: float, slope: float) -> Point:
    gradient = np.array([slope, 0.0])
    return Point(np.zeros(2), value, gradient, value, slope=gradient)


@pytest.mark.long
def test_standing_still_on_a_slope_is_not_called_tolerance() -> None:
    study, first = _study(0.01), _at_design(0.0275, 0.03)
    idle = [0.0111] * 7
    flat = termination.check_convergence(study, _at_design(0.0111, 1e-4), idle, first)
    steep = termination.check_convergence(study, _at_design(0.0111, 0.03), idle, first)
    assert flat is not None and flat.by == "tolerance"
    assert steep is not None and steep.by == "no-progress" and "100 % of the first one" in steep.words
    # A number that presses on a bound promises nothing.
    free, gradient = np.array([-2.0, -2.0, 2.0, 0.5]), np.array([1.0, -1.0, 1.0, 1.0])
    assert slope_within(free, gradient, np.full(4, 2.0)).tolist() == [0.0, -1.0, 1.0, 1.0]


@pytest.mark.long
@pytest.mark.parametrize(
    ("objective", "value", "slope", "first", "by"),
    [
        # A value that halves between the bounds: 1 % of them promises seven times the tolerance.
        ("time", 0.9, 0.17, 0.17, "no-progress"),
        ("time", 0.9, 0.005, 0.17, "tolerance"),
        # The slope of a sum of squares falls with its root: of the root, three fifths are left.
        ("target", 1e-4, 6e-3, 1.0, "no-progress"),
        ("target", 1e-4, 6e-4, 1.0, "tolerance"),
        # The promise is below what a mesh resolves.
        ("target", 1.4e-4, 6e-5, 2e-4, "tolerance"),
    ],
)
def test_a_slope_that_is_left_is_measured_by_what_it_promises(
    objective: str, value: float, slope: float, first: float, by: str
) -> None:
    study = _study(0.01)
    if objective == "time":
        study = dataclasses.replace(study, objective=optimize.FormingTime(study.scene))
    begin = _at_design(1.0 if first == 1.0 else 2.0 * value, first)
    ending = termination.check_convergence(study, _at_design(value, slope), [value] * 7, begin)
    assert ending is not None and ending.by == by
    failed = termination.stagnation_ending(study, _at_design(value, slope), begin, "no-step")
    assert failed.by == ("no-step" if by == "tolerance" else by)


def test_a_gradient_of_zero_is_told_with_its_reason() -> None:
    study = _even(0.01, BOUNDS)
    flat = Point(np.zeros(2), 1.0, np.zeros(2), 1.0, slope=np.zeros(2))
    held = dataclasses.replace(flat, gradient=np.array([1.0, 0.0]))
    for point, words in ((flat, "no number of the design changes"), (held, "is at a bound beyond which")):
        ending = termination.check_convergence(study, point, [1.0], point)
        assert ending is not None and ending.by == "gradient_tolerance" and words in ending.words


def test_a_line_search_that_fails_on_a_slope_is_repeated_and_no_optimum() -> None:
    """The value rises on both sides of the first design, though its gradient says that it falls."""

    class Misled(Search):
        def compute(self, free: np.ndarray) -> Any:
            names = ("error", "least", "mean", "variation", "mass")
            value = jnp.asarray(0.1 + np.abs(free - start).sum())
            report = {"objective": value, "status": jnp.asarray(0)} | dict.fromkeys(names, jnp.asarray(0.0))
            return (value, report), jnp.ones(free.size)

    search = Misled(_even(0.015, BOUNDS), None, 1.0)
    start = search.start
    point, ending = lbfgs(search, search.study, search(start))
    assert ending.by == "no-progress" and "no step gains anything" in ending.words
    assert point.free.tolist() == start.tolist() and len(search.history) == 1 + 2 * 8


def test_numbers_that_never_left_their_bound_are_told() -> None:
    search = Search(_even(BOUNDS[0], BOUNDS), None, 1.0)
    assert sensitivity_check.numbers_at_bounds(search, np.zeros(4)) == []
    names = ("error", "least", "mean", "variation", "mass", "ratio", "cost", "elapsed")
    answer = {"status": 0, "error": np.nan} | dict.fromkeys(names, 0.0)
    free = search.start.copy()
    free[:3] = free[0], 0.0, search.reach[2]
    for value, design in ((1.0, search.start), (0.9, np.append(free[:3], 0.0)), (0.8, free)):
        search.accept(design, answer | {"value": value, "objective": value})
    (row,) = rows = sensitivity_check.numbers_at_bounds(search, free)
    # The last number went inside and came back; only the first has stayed.
    assert row == {
        "variable": 0,
        "kind": "thickness",
        "numbers": 4,
        "lower": [0, 3],
        "upper": [2],
        "unmoved": [0],
    }
    (sentence,) = sensitivity_check.unmoved_numbers(rows, "tolerance")
    assert sentence.startswith("1 of 4 numbers of variable[0] (thickness)") and "solver.starts" in sentence
    assert sensitivity_check.unmoved_numbers(rows, "iterations") == []
    assert sensitivity_check.unmoved_numbers([row | {"unmoved": []}], "tolerance") == []


def test_a_sheet_that_would_have_to_leave_its_bounds_ends_and_is_told() -> None:
    """A wall of half the thickness that the least sheet gives: no update changes anything."""
    study = _study(BOUNDS[0], method="fixed-point", iterations=9)
    thin = optimize.Target(study.scene, 0.5 * np.asarray(jaxform.run(study.scene).thickness))
    study = dataclasses.replace(study, objective=thin)
    told: list[str] = []
    design = optimize.solve(study, on_warning=told.append)
    assert design.stopped_by == "no-step" and len(design.history) == 2
    assert design.summary()["at_bounds"][0]["unmoved"] == [0, 1, 2, 3]
    assert any(sentence.startswith("4 of 4 numbers") for sentence in told) and design.warnings == told
    # Other starts are the remedy: where there are several, it is not advised.
    told.clear()
    several = optimize.solve(dataclasses.replace(study, starts=2, iterations=1), on_warning=told.append)
    assert not any("solver.starts" in sentence for sentence in told) and len(several.starts) == 2


@pytest.mark.long
def test_a_search_ends_where_deviations_are_finer_than_a_mesh_can_tell() -> None:
    study, first = _study(0.01), _at_design(1.0, 1.0)
    reached = termination.check_convergence(study, _at_design(0.9e-6, 0.1), [1.0, 0.9e-6], first)
    assert reached is not None and reached.by == "target"
    # From 0.305 to 0.3 % in five steps: a wall of 1 mm by 50 nm.
    slow = np.square(np.linspace(3.05e-3, 3.0e-3, 6)).tolist()
    ended = termination.check_convergence(study, _at_design(slow[-1], 1e-7), slow, _at_design(1.0, 1e-6))
    assert ended is not None and ended.by == "tolerance"
    quick = np.square(np.linspace(4e-3, 3.0e-3, 6)).tolist()
    assert termination.check_convergence(study, _at_design(quick[-1], 1e-7), quick, _at_design(1.0, 1e-6)) is None


def test_the_check_of_a_gradient_on_a_bound_stays_inside() -> None:
    asked: list[np.ndarray] = []

    def value(free: np.ndarray) -> float:
        asked.append(free)
        return float(np.sum(np.exp(free)))

    def values(designs: list[np.ndarray]) -> list[float]:
        return [value(free) for free in designs]

    for free in (np.array([-2.0, 0.3, 2.0]), np.array([-2.0, -2.0, -2.0])):
        point = Point(free, value(free), np.exp(free))
        assert gradient_error(point, np.full(3, 2.0), values) < 1e-7
        assert gradient_error(Point(free, point.value, 1.1 * np.exp(free)), np.full(3, 2.0), values) > 0.05
    # A start that a solver left a little inside of its bounds is one on them.
    free = np.array([2.0 - 1e-9, 1.0, -2.0 + 1e-9])
    assert gradient_error(Point(free, value(free), np.exp(free)), np.full(3, 2.0), values) < 1e-7
    assert np.abs(asked).max() <= 2.0


def test_the_check_of_a_gradient_finds_the_slope_between_jumps() -> None:
    """A value that rises by 1 between jumps and falls by 1 over them, which are 1e-6 apart."""

    def value(free: np.ndarray) -> float:
        place = float(free[0] - free[1])
        return place - 2e-6 * np.floor(place / 1e-6)

    free, reach = np.array([0.1, 0.2 + 5e-7]), np.full(2, 2.0)
    right, wrong = (
        gradient_error(
            Point(free, value(free), slope * np.array([1.0, -1.0])),
            reach,
            lambda designs: [value(one) for one in designs],
        )
        for slope in (1.0, 1.1)
    )
    assert right < 1e-6 and wrong > 0.05


def test_a_damped_step_within_bounds_is_the_least_of_the_model() -> None:
    """A model of two numbers that are coupled: cut at the bound, the other one takes the best that is left."""
    matrix, gradient = np.array([[2.0, 1.0], [1.0, 2.0]]), np.array([-3.0, -3.0])
    np.testing.assert_allclose(_step(matrix, gradient, 0.0, -np.ones(2) * 9, np.ones(2) * 9), [1.0, 1.0], rtol=1e-9)
    step = _step(matrix, gradient, 0.0, np.array([-9.0, -9.0]), np.array([0.2, 9.0]))
    np.testing.assert_allclose(step, [0.2, 1.4], rtol=1e-9)
    assert _step(matrix, gradient, 0.0, np.array([0.0, -9.0]), np.array([0.0, 9.0]))[0] == pytest.approx(0.0, abs=1e-11)


def test_after_many_good_steps_a_short_one_is_still_found() -> None:
    """Each good step lowers the damping; where the value turns rough then, only a short step makes it better."""
    matrix, gradient, most = np.diag([2.0, 4.0]), np.array([2.0, -1.0]), [np.inf]

    class Rough:
        reach, stopped = np.full(2, 50.0), False

        def inside(self, free: np.ndarray) -> np.ndarray:
            return free

        def evaluate_forward(self, free: np.ndarray) -> tuple[Point, None]:
            value = 0.5 if np.abs(free).max() <= most[0] else 2.0
            return Point(free, value, gradient), None

    damping, point = 1e-4, Point(np.zeros(2), 1.0, gradient)
    for _ in range(12):
        step, damping = _trials(Rough(), point, matrix, damping)  # pyright: ignore[reportArgumentType]
        assert step is not None
    most[0] = 0.02  # a fiftieth of the undamped step
    step, _ = _trials(Rough(), point, matrix, damping)  # pyright: ignore[reportArgumentType]
    assert step is not None and np.abs(step.free).max() <= most[0] and step.free @ gradient < 0.0


def test_a_reachable_target_takes_the_fixed_point_alone() -> None:
    """By default updates come first while each halves the value; no gradient is compiled where they suffice."""
    scene = scenes.cup()
    field = optimize.ThicknessField(scene, bounds=(0.004, 0.06))
    target = np.asarray(jaxform.run(scene).thickness)
    sheet = jaxform.replace(scene, {"parison.thickness": 1.4 * scene.parison.thickness})
    study = optimize.Study(sheet, (field,), optimize.Target(sheet, target))
    waits: list[str] = []
    design = optimize.solve(study, on_wait=waits.append)
    assert design.stopped_by == "target" and len(design.history) <= 14
    assert design.summary()["warm_start"] == len(design.history) - 1
    assert all(row["gradient_norm"] == "" for row in design.history)
    assert waits == ["simulating the initial scene"]


@pytest.mark.long
def test_updates_that_do_not_halve_the_value_leave_it_to_the_gradient() -> None:
    waits: list[str] = []
    design = optimize.solve(_study(0.02, iterations=6), on_wait=waits.append)
    updates = design.summary()["warm_start"]
    objectives = [row["objective"] for row in design.history]
    halved = [after <= 0.5 * before for before, after in itertools.pairwise(objectives[: updates + 1])]
    assert 1 <= updates <= 12 and all(halved[:-1])
    assert any(row["gradient_norm"] != "" for row in design.history[updates + 1 :])
    assert any(words.startswith("compiling value and gradient, about") for words in waits)
    none = optimize.solve(_study(0.02, iterations=1, warm_start=0))
    assert none.history[0]["gradient_norm"] != "" and none.summary()["warm_start"] == 0

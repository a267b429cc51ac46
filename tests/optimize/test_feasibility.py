"""A search says what it cannot reach before it begins, what it did not reach after it, and what all that cost."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest

import jaxform
import optimize
from jaxform.cli import command, session
from optimize import feasibility
from optimize.designs import Point
from optimize.penalty_rounds import rounds
from optimize.price import price
from optimize.search import Search
from optimize.termination import Ending, budget_ending, check_convergence
from tests import scenes

pytestmark = pytest.mark.quick

BOUNDS = (0.004, 0.03)


def _study(objective: optimize.Objective, scene: jaxform.Scene | None = None, **options: Any) -> optimize.Study:
    scene = scene or scenes.cup()
    return optimize.Study(
        scene, (optimize.ThicknessProfile(scene, along="radius", bounds=BOUNDS, knots=4),), objective, **options
    )


def _ball() -> jaxform.Scene:
    return scenes.sphere(40, 1.0, scenes.mooney(0.1), [0.0, 1.0], end_time=1.0, damping=1.0)


# --- Before -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("minimum", [0.0305, 1.0])
def test_a_wall_thicker_than_any_sheet_is_refused_before_any_simulation(
    minimum: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(jaxform, "run", lambda *_: pytest.fail("a simulation"))
    study = _study(optimize.LeastMass(scenes.cup(), minimum))
    with pytest.raises(jaxform.InputError, match=r"objective\.minimum = .*0\.03 m.*raise .* variable\[0\]\.bounds"):
        optimize.solve(study)


def test_what_a_sheet_may_reach_is_not_refused() -> None:
    scene = scenes.cup()
    feasibility.check(_study(optimize.LeastMass(scene, 0.03)))
    # A sheet that is not flat, or not held at its rim, may shrink: to half its area at most.
    ball = _ball()
    feasibility.check(_study(optimize.LeastMass(ball, 0.05), ball))
    with pytest.raises(jaxform.InputError, match=r"objective\.minimum"):
        feasibility.check(_study(optimize.LeastMass(ball, 0.07), ball))
    # A limit on the deviation: a wall of 0.03 m deviates from one of 0.04 m by a quarter.
    feasibility.check(_study(optimize.Target(scene, 0.04, limit=0.26)))
    with pytest.raises(jaxform.InputError, match=r"objective\.limit = 0\.24.*25 % or more"):
        feasibility.check(_study(optimize.Target(scene, 0.04, limit=0.24)))
    both = optimize.Weighted([(1.0, optimize.Uniform()), (1.0, optimize.LeastMass(scene, 1.0))])
    with pytest.raises(jaxform.InputError, match=r"objective\[1\]\.minimum"):
        feasibility.check(_study(both))


def test_without_a_variable_sheet_its_own_thickness_counts() -> None:
    scene = scenes.cup()
    study = _study(optimize.LeastMass(scene, 0.011))
    pressure = optimize.PressureKnots(scene, bounds=(0.0, 0.4))
    with pytest.raises(jaxform.InputError, match=r"has 0\.01 m.*let the sheet's thickness vary"):
        feasibility.check(dataclasses.replace(study, variables=(pressure,)))
    scale = optimize.Scale(scene, of="parison.thickness", bounds=(0.5, 1.2))
    feasibility.check(dataclasses.replace(study, variables=(scale,)))


def test_a_target_out_of_reach_is_a_warning() -> None:
    scene = scenes.cup()
    assert feasibility.doubts(_study(optimize.Target(scene, 0.03))) == []
    (sentence,) = feasibility.doubts(_study(optimize.Target(scene, 0.12)))
    assert "75% less" in sentence and "unit" in sentence and "\n" not in sentence


# --- After ------------------------------------------------------------------------------------------------------------


def test_a_scene_that_its_variables_cannot_have_is_a_warning() -> None:
    scene = scenes.cup()
    study = _study(optimize.Uniform())
    assert feasibility.doubts(study) == []
    far = optimize.ThicknessProfile(scene, along="radius", bounds=(0.3, 2.0), knots=4)
    slow = optimize.PressureKnots(scene, bounds=(0.0, 0.4), rate=1e-4)
    sheet, pressure = feasibility.doubts(dataclasses.replace(study, variables=(far, slow)))
    assert "parison.thickness is 0.01 in the scene" in sheet and "starts with 0.3" in sheet
    assert "pressure.value is 0 to" in pressure and "rate" in pressure


def _point(violation: float) -> Point:
    return Point(np.zeros(4), 1.0, np.zeros(4), 1.0, np.array([violation]))


def test_a_limit_that_is_not_kept_is_told_with_number_and_remedy() -> None:
    scene = scenes.cup()
    result = jaxform.run(scene)
    wall = float(np.asarray(result.element_thickness).min())
    study = _study(optimize.LeastMass(scene, 1.25 * wall))
    ended = Ending("iterations", "")
    words = feasibility.broken_limits(study, scene, result, _point(0.2), ended)
    assert f"{wall:.4g} m, 20 % below objective.minimum = {1.25 * wall:g} m" in words
    assert "raise solver.iterations" in words and "lower objective.minimum" in words and "bounds" not in words
    thick = jaxform.replace(scene, {"parison.thickness": np.full_like(scene.parison.thickness, 0.03)})
    words = feasibility.broken_limits(study, thick, result, _point(0.2), Ending("no-step", ""))
    assert "raise the upper end of variable[0].bounds" in words and "solver" not in words
    kept = _study(optimize.LeastMass(scene, 1.004 * wall))
    assert feasibility.broken_limits(kept, scene, result, _point(0.004), ended) == ""
    deviation = optimize.Target(scene, result.thickness / 1.1, limit=0.05)
    words = feasibility.broken_limits(_study(deviation), scene, result, _point(1.0), ended)
    assert "deviates by 10 %, more than objective.limit = 5 %" in words


LEAST_MASS = (
    'scene = "scene.toml"\n[[variable]]\nkind = "thickness-profile"\nalong = "radius"\nknots = 4\n'
    'bounds = [5e-4, 1e-3]\n[objective]\nkind = "least-mass"\nminimum = {}\n'
    '[solver]\nmethod = "fixed-point"\niterations = 3\n'
)


@pytest.mark.parametrize("minimum", [1e-4, 9.9e-4])
def test_the_facts_of_a_search_tell_a_mold_that_is_not_filled(
    tmp_path: Path, capfd: pytest.CaptureFixture[str], minimum: float
) -> None:
    """As the summary does, beside a broken limit where there is one."""
    scene = scenes.FILE.replace("fill = false", "").replace("end_time = 0.05", "end_time = 0.02")
    (tmp_path / "scene.toml").write_text(scene)
    (tmp_path / "study.toml").write_text(LEAST_MASS.format(minimum))
    out = tmp_path / "out"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(session, "cache_folder", lambda: None)
        assert command.main(["optimize", str(tmp_path / "study.toml"), "--out", str(out), "--quiet"]) == 3
    status = json.loads((out / "design.json").read_text())["status"]
    assert status == json.loads((out / "summary.json").read_text())["status"]
    assert "mold is not filled" in status and ("a limit is violated" in status) == (minimum > 9e-4)
    told = capfd.readouterr().err
    assert all(part in told for part in status.split("; a limit"))


def test_the_command_tells_a_broken_limit_and_exits_with_3(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    """In status and exit status, and the price of what was gained beside it."""
    scene = scenes.FILE.replace("end_time = 0.05", "end_time = 0.22")
    (tmp_path / "scene.toml").write_text(scene)
    (tmp_path / "study.toml").write_text(LEAST_MASS.format(9.5e-4))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(session, "cache_folder", lambda: None)
        assert command.main(["optimize", str(tmp_path / "study.toml"), "--out", str(tmp_path / "out")]) == 3
        captured = capfd.readouterr()
        assert "limits are violated; multiplier" in captured.out and "stopped by" in captured.out
        summary = json.loads((tmp_path / "out" / "summary.json").read_text())
        assert (
            summary["status"].startswith("a limit is violated: the thinnest wall is") and "bounds" in summary["status"]
        )
        assert summary["status"] in captured.err
        assert summary["design"]["violation"] > 0.3 and summary["design"]["stopped_by"] == "iterations"
        (tmp_path / "study.toml").write_text(LEAST_MASS.format(1.0))
        assert command.main(["optimize", str(tmp_path / "study.toml"), "--out", str(tmp_path / "none")]) == 2
    lines = capfd.readouterr().err.splitlines()
    assert len(lines) == 1 and "study.toml: objective.minimum = 1.0: cannot be satisfied" in lines[0]
    assert not (tmp_path / "none" / "history.csv").exists()


# --- What it costs ----------------------------------------------------------------------------------------------------


def test_the_price_of_the_last_tenth() -> None:
    """From 10 to 0: nine tenths by 20 simulations, the last tenth by 50, and 30 more for nothing."""
    steps = [(10.0, 10.0, 0.0), (20.0, 1.0, 0.0), (25.0, 0.5, 0.3), (50.0, 0.0, 0.0), (80.0, 2.0, 0.0)]
    rows = [{"simulations": cost, "objective": value, "violation": broken} for cost, value, broken in steps]
    found = price(rows)
    assert found == {
        "gain": 10.0,
        "gain_relative": 1.0,
        "simulations_for_nine_tenths": 20.0,
        "simulations_for_the_last_tenth": 60.0,
    }
    # Where one step brings it all, the last tenth is a tenth of that step.
    found = price([{"simulations": 0.0, "objective": 4.0}, {"simulations": 10.0, "objective": 2.0}])
    assert found is not None
    np.testing.assert_allclose(found["simulations_for_the_last_tenth"], 1.0, rtol=1e-12)
    assert price(rows[:1]) is None and price(rows[2:3] + rows[3:4]) is None


def test_limits_on_simulations_and_minutes() -> None:
    study = _study(optimize.Uniform(), max_simulations=20.0, minutes=0.5)
    assert budget_ending(study, 20.0, 29.9) is None
    for ending, by in (
        (budget_ending(study, 20.1, 0.0), "max_simulations"),
        (budget_ending(study, 1.0, 30.0), "minutes"),
    ):
        assert ending is not None and ending.by == by
    values = [1.0, 0.8995, 0.8995, 0.8994, 0.8993, 0.8992, 0.8991]
    first = Point(np.zeros(4), 1.0, np.ones(4), 1.0, slope=np.ones(4))
    point = Point(np.zeros(4), 0.8991, np.ones(4), 0.8991, slope=np.full(4, 0.01))
    ending = check_convergence(study, point, values, first)
    assert ending is not None and ending.by == "tolerance"
    assert check_convergence(dataclasses.replace(study, tolerance=1e-4), point, values, first) is None
    # Where the slope has not gone, steps that bring nothing are no sign of an optimum.
    steep = dataclasses.replace(point, slope=np.ones(4))
    ending = check_convergence(study, steep, values, first)
    assert ending is not None and ending.by == "no-progress"


def _counting(study: optimize.Study, seconds: float = 0.0) -> Search:
    """A search whose simulations cost nothing to compute: each counts as two, or takes so long."""
    search = Search(study, None, 1.0)

    def forward(free: np.ndarray) -> dict[str, Any]:
        search._began -= seconds
        value = float(np.sum(np.square(free - 1.0)))
        wall = {"least": 1.0, "mean": 1.0, "variation": 0.0, "mass": 1.0, "error": np.nan, "status": 0}
        ratio = np.full(study.scene.parison.thickness.size, 1.1)
        return wall | {"value": value, "objective": value, "ratio": ratio.tolist(), "spent": 2.0}

    search.forward = forward  # pyright: ignore
    return search


@pytest.mark.parametrize(
    ("limits", "count", "by"),
    [
        ({"iterations": 3}, 5, "iterations"),
        ({"iterations": 50, "max_simulations": 12.0}, 5, "max_simulations"),
        ({"iterations": 50, "minutes": 1.0}, 3, "minutes"),
    ],
)
def test_a_search_stops_at_each_limit_and_says_at_which(
    monkeypatch: pytest.MonkeyPatch, limits: dict[str, Any], count: int, by: str
) -> None:
    """A simulation counts before the search; each design takes the time of 2, or 20 s; the first one is tried twice."""
    study = _study(optimize.Uniform(), method="fixed-point", **limits)
    monkeypatch.setattr(
        "optimize.solvers.Search", lambda study, *_, **__: _counting(study, 20.0 * ("minutes" in limits))
    )
    design = optimize.solve(study)
    assert design.stopped_by == by and design.summary()["stopped_by"] == by
    assert len(design.history) == count
    assert design.history[-1]["simulations"] <= limits.get("max_simulations", np.inf)
    assert max(row["iteration"] for row in design.history) <= study.iterations


class _Rounds:
    """A search with limits whose simulations are made up: each round leaves a part of the violation."""

    def __init__(self, study: optimize.Study, factor: float, costs: float) -> None:
        self.study, self.iteration, self.pause = study, 0, np.inf
        self.most_iterations = study.iterations
        self.limits = jnp.zeros(1), jnp.asarray(1.0)
        self.multiplier: float | None = None
        self.best: Point | None = None
        self._factor, self._costs = factor, costs
        self.point = self._make_point(1.0, 0.4)

    def _make_point(self, objective: float, violation: float) -> Point:
        row = {"multiplier": 1.0}
        point = Point(np.zeros(4), objective, np.zeros(4), objective, np.array([violation]), row)
        if self.best is None or point.rank < self.best.rank:
            self.best = point
        return point

    def begin(self) -> Ending | None:
        return Search.begin(self)  # pyright: ignore

    def __call__(self, free: np.ndarray) -> Point:
        return self.point

    def parts(self, free: np.ndarray) -> list[Any]:
        return []

    def plain(self, free: np.ndarray) -> None:
        raise AssertionError

    def method(self, search: Any, study: optimize.Study, point: Point) -> tuple[Point, Ending]:
        """A round to the end of its iterations."""
        while True:
            ending = self.begin()
            if ending:
                self.point = self._make_point(point.objective * self._costs, point.violation * self._factor)
                return self.point, ending


@pytest.mark.parametrize(
    ("iterations", "factor", "costs", "by", "rounds_done"),
    [
        (6, 0.5, 0.9, "iterations", 1),  # the total, not that of each round
        (30, 0.5, 0.9, "iterations", 3),
        (200, 0.1, 0.9995, "tolerance", 2),  # kept after the second, which gains nothing
        (200, 0.97, 0.9, "no-progress", 3),  # as near after two rounds as before them
        (200, 0.5, 0.9, "rounds", 8),
    ],
)
def test_rounds_end_by_what_they_reach_and_iterations_are_their_total(
    iterations: int, factor: float, costs: float, by: str, rounds_done: int
) -> None:
    study = _study(optimize.Uniform(), iterations=iterations)
    search = _Rounds(dataclasses.replace(study, variables=()), factor, costs)
    ending = rounds(search, search.study, search.point, search.method)  # pyright: ignore
    assert ending.by == by
    assert search.iteration == min(iterations, 12 * rounds_done)
    assert search.multiplier == 1.0


@pytest.mark.parametrize("last", ["tolerance", "no-progress"])
def test_a_round_that_ends_on_a_slope_is_searched_once_more(last: str) -> None:
    """Limits are kept and nothing is gained, but the second round ends where its gradient is left."""
    study = _study(optimize.Uniform(), iterations=200)
    search = _Rounds(dataclasses.replace(study, variables=()), 0.1, 0.9995)
    search.memory = "of the curvature"  # pyright: ignore
    endings = ["iterations", "no-progress", last]
    count = 0

    def method(*arguments: Any) -> tuple[Point, Ending]:
        nonlocal count
        count += 1
        point, _ = search.method(*arguments)
        assert (search.memory is None) == (count == 3)  # pyright: ignore
        return point, Ending(endings[count - 1], "the gradient is left")

    ending = rounds(search, search.study, search.point, method)  # pyright: ignore
    assert (ending.by, count) == (last, 3)

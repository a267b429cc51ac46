"""Slopes against secants of a hundredth of the bounds: what a search says of them, and what that costs."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import pytest

import optimize
from optimize import slope_trend
from optimize.designs import Point
from optimize.search import Search
from tests import scenes

RATE = 1e4  # of the ripple, whose period is far below a secant


def _search(ripple: float, **options: Any) -> tuple[Search, Point]:
    """A search whose value is a square of all numbers plus a ripple along the first, and a point where it is steep."""
    scene = scenes.cup()
    sheet = optimize.ThicknessProfile(scene, along="radius", bounds=(0.004, 0.03), knots=3)
    search = Search(optimize.Study(scene, (sheet,), optimize.Uniform(), **options), None, 1.0)

    def value(free: np.ndarray) -> float:
        return 1.0 + float(free @ free) + ripple * np.sin(RATE * free[0]) / RATE

    search.forward = lambda free: {"status": 0, "spent": 1.0, "value": value(free)}  # pyright: ignore
    free = np.array([2.0 * np.pi, -1.0, 0.5]) / RATE + np.array([0.3, 0.1, 0.0])
    gradient = 2.0 * free + np.array([ripple * np.cos(RATE * free[0]), 0.0, 0.0])
    return search, Point(free, value(free), gradient, value(free), slope=gradient)


def test_a_ripple_is_told_from_the_secant_and_a_smooth_value_is_not() -> None:
    for ripple in (0.0, 0.4):
        search, point = _search(ripple)
        told: list[str] = []
        slope_trend.compare_start(search, point, told.append)
        found, norm = search.secants["start"], np.linalg.norm(point.gradient)
        np.testing.assert_allclose(found["slope"], norm, rtol=1e-12)
        # The secant sees the square alone: the ripple averages out.
        np.testing.assert_allclose(found["secant"], 2.0 * point.free @ point.gradient / norm, atol=2e-3)
        assert len(told) == (ripple > 0.0) and search.simulations == 3.0
    assert "first design" in told[0] and f"{norm:.3g}" in told[0] and "1 % of their bounds" in told[0]
    assert "solver.smooth_landing = true and solver.safety = 0.45" in told[0]


def test_smooth_landing_is_advised_only_where_a_scene_may_have_it() -> None:
    scene = scenes.cup()
    for name, value in (("edge_contact", True), ("smooth_landing", True)):
        solver = dataclasses.replace(scene.solver, **{name: value}, safety=0.45)
        assert not slope_trend._advise_landing(dataclasses.replace(scene, solver=solver))


def test_the_end_is_held_against_the_first_slope() -> None:
    """The slope left at an optimum is small and may have any secant: that says nothing."""
    for left, warned in ((1e-4, 0), (0.1, 1)):
        search, first = _search(0.0)
        told: list[str] = []
        slope_trend.compare_start(search, first, told.append)
        end = np.array([left, 0.0, 0.0])
        search.best = Point(np.zeros(3), 1.0, end, 1.0, slope=end)
        slope_trend.compare_end(search, told.append)
        assert search.secants["end"]["slope"] == pytest.approx(left) and abs(search.secants["end"]["secant"]) < 1e-12
        assert len(told) == warned and all("best design" in words for words in told)


def test_a_difference_that_is_nothing_beside_the_first_objective_is_no_warning() -> None:
    """Near the floor of an objective that began a hundred times as high the ripple decides the slope."""
    found = {"slope": 2.6e-3, "secant": 1.1e-3, "step": 0.05}
    assert slope_trend.parts_from_secant(found, 2.6e-3, 0.05)
    assert not slope_trend.parts_from_secant(found, 2.6e-3, 0.36)


def test_numbers_at_their_bounds_stay_and_small_searches_are_not_charged() -> None:
    search, point = _search(0.0)
    asked: list[np.ndarray] = []

    def values(designs: list[np.ndarray]) -> list[float]:
        asked.extend(designs)
        return [float(free @ free) for free in designs]

    at_bound = np.array([search.reach[0], 0.1, 0.0])
    pressed = Point(at_bound, 0.0, 2.0 * at_bound, 0.0, slope=2.0 * at_bound)
    found = slope_trend.slope_and_secant(pressed, search.reach, values)
    assert found is not None and all(free[0] == at_bound[0] for free in asked) and asked[0][1] != asked[1][1]
    assert found["secant"] == pytest.approx(found["slope"], rel=1e-9) == pytest.approx(0.2, rel=1e-9)
    assert slope_trend.slope_and_secant(pressed, search.reach, lambda designs: [np.inf, 1.0]) is None
    for options in ({"iterations": 19}, {"max_simulations": 79.0}, {"method": "fixed-point"}):
        search, point = _search(0.4, **options)
        slope_trend.compare_start(search, point, lambda words: pytest.fail(words))
        slope_trend.compare_end(search, lambda words: pytest.fail(words))
        assert not search.secants and search.simulations == 1.0

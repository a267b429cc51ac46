"""Variables that do nothing are seen in the first gradient, and only they."""

from __future__ import annotations

import dataclasses
import re
import types
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import optimize
from optimize import sensitivity_check
from optimize.designs import Point
from optimize.search import Search
from optimize.variables import apply_bounds
from tests import scenes

BOUNDS = (0.004, 0.03)


def _search(strength: float, centre: float, edge: float = 0.0) -> tuple[Search, Point]:
    """Sheet and pressure, whose value is 1 + (share - centre)^2 of the sheet, and so of the pressure by a strength.

    The pressure's first knot, which begins at its lower bound, counts by another strength.
    """
    scene = scenes.cup()
    sheet = optimize.ThicknessProfile(scene, along="radius", bounds=BOUNDS, knots=4)
    pressure = optimize.PressureKnots(scene, bounds=(0.0, 0.4))
    study = optimize.Study(scene, (sheet, pressure), optimize.Uniform())
    search = Search(study, None, 1.0)

    def value(free: Any) -> jax.Array:
        one, other = sheet.shares(free[:4]), pressure.shares(free[4:])
        return 1.0 + jnp.sum(jnp.square(one - centre)) + strength * jnp.sum(jnp.square(other - 1.0)) - edge * other[0]

    answer = {"status": 0, "spent": 1.0}
    search.forward = lambda free: answer | {"value": float(value(free))}  # pyright: ignore
    free = search.start
    point = Point(free, float(value(free)), np.asarray(jax.grad(value)(jnp.asarray(free))), float(value(free)))
    return search, point


def _result(error: float) -> Any:
    return types.SimpleNamespace(energy=types.SimpleNamespace(quasi_static_error=error))


@pytest.mark.parametrize(("error", "words"), [(1e-4, "process is slow.*0.01 %.*thickness-profile"), (0.2, "widen")])
def test_a_variable_that_does_nothing_is_named_with_the_reason(error: float, words: str) -> None:
    found: list[str] = []
    sensitivity_check.warn_of_insensitive_variables(*_search(1e-3, 0.5), _result(error), found.append)
    assert len(found) == 1 and found[0].startswith("variable[1] (pressure) has almost no effect")
    assert re.search(words, found[0]) and "hardly improve the design" not in found[0]


def test_a_knot_at_its_bound_counts_with_what_it_would_do() -> None:
    """All of its bounds would change the value by a tenth, and a search goes there: the map is not flat at a bound."""
    found: list[str] = []
    search, point = _search(1e-3, 0.5, edge=0.1)
    sensitivity_check.warn_of_insensitive_variables(search, point, _result(1e-4), found.append)
    assert found == [] and search.simulations == 1.0


def test_a_variable_that_does_something_is_not() -> None:
    found: list[str] = []
    search, point = _search(0.1, 0.5)
    sensitivity_check.warn_of_insensitive_variables(search, point, _result(1e-4), found.append)
    assert found == [] and search.simulations == 1.0


def test_at_the_best_design_the_gradient_vanishes_and_nothing_is_said() -> None:
    """The sheet is where it ought to be: a step away from there makes it worse."""
    search, point = _search(0.1, 0.0)
    sheet = search.study.variables[0]
    centre = float(np.asarray(sheet.shares(jnp.asarray(sheet.start)))[0])
    search, point = _search(0.1, centre)
    assert np.abs(point.gradient[:4]).max() < 1e-12
    found: list[str] = []
    sensitivity_check.warn_of_insensitive_variables(search, point, _result(1e-4), found.append)
    assert found == [] and search.simulations == 2.0


def test_a_search_over_such_variables_alone_says_so() -> None:
    search, point = _search(1e-3, 0.5)
    study = dataclasses.replace(search.study, variables=search.study.variables[1:])
    alone = Search(study, None, 1.0)
    alone._forward = lambda free: {"value": point.value, "status": 0, "spent": 1.0}  # pyright: ignore
    found: list[str] = []
    sensitivity_check.warn_of_insensitive_variables(
        alone, dataclasses.replace(point, free=point.free[4:], gradient=point.gradient[4:]), _result(1e-4), found.append
    )
    assert len(found) == 1 and found[0].startswith("this search can hardly improve the design: variable[0] (pressure)")


@pytest.mark.parametrize("kind", ["sheet", "pressure", "rising", "ending", "scale"])
def test_shares_run_from_one_bound_to_the_other(kind: str) -> None:
    scene = scenes.cup()
    made: dict[str, Any] = {
        "sheet": lambda: optimize.ThicknessProfile(scene, along="radius", bounds=BOUNDS, knots=4),
        "pressure": lambda: optimize.PressureKnots(scene, bounds=(0.0, 0.4)),
        "rising": lambda: optimize.PressureKnots(scene, bounds=(0.0, 0.4), increasing=True),
        "ending": lambda: optimize.PressureKnots(scene, bounds=(0.0, 0.4), end_time=(4.0, 20.0)),
        "scale": lambda: optimize.Scale(scene, of="material.c", bounds=(0.5, 2.0)),
    }
    variable = made[kind]()
    free = jnp.asarray(variable.start)
    shares = np.asarray(variable.shares(free))
    assert shares.shape == free.shape and np.all((shares >= 0.0) & (shares <= 1.0))
    if kind == "sheet":
        np.testing.assert_allclose(shares, (0.01 - BOUNDS[0]) / (BOUNDS[1] - BOUNDS[0]), rtol=1e-6)
        assert np.all(np.asarray(variable.shares(free + 50.0)) > 0.999)
    if kind == "scale":
        np.testing.assert_allclose(shares, apply_bounds(free, (0.0, 1.0)), rtol=1e-12)
    if kind == "ending":
        np.testing.assert_allclose(shares[-1], (16.0 - 4.0) / 16.0, rtol=1e-9)
    assert np.all(np.isfinite(sensitivity_check._spans(variable, np.asarray(free))))

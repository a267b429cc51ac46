"""Variables without effect, found in the first gradient, and variables at their bounds in the best design.

The wall of a slow process depends on neither pressure nor stiffness; a search over them alone is useless. A number
that stays at the bound where it began may be held there by a rise of the objective behind which it falls further.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxform import Result
from jaxform.extend import QUASI_STATIC_LIMIT, format_percent
from optimize.designs import Point
from optimize.gradients import side_of_bounds
from optimize.heaters import HeaterZones
from optimize.pressures import PressureKnots
from optimize.search import Search
from optimize.termination import LOCAL
from optimize.variables import Scale, SheetVariable, Variable

_IDLE = 0.01  # of the value: what changes it by less than this over its whole bounds does nothing
_FARTHEST = 10.0  # of a number of the search: where a limit of neighbours leaves it no room, it does nothing
_STEP = 0.5  # of all numbers at once, an eighth of the way between their bounds


def warn_of_insensitive_variables(search: Search, point: Point, first: Result, warn: Callable[[str], object]) -> None:
    """Warns of each variable that has almost no effect at the first design.

    Args:
        search: The search, before its first step.
        point: The first design, with its gradient.
        first: The part that the scene makes.
        warn: Called with a sentence for each.
    """
    size = max(abs(point.value), abs(point.objective))
    if not np.all(np.isfinite(point.gradient)) or not 0.0 < size < np.inf:
        return
    slow = float(first.energy.quasi_static_error) <= QUASI_STATIC_LIMIT
    begin, found = 0, []
    for index, (variable, part_free) in enumerate(search.parts(point.free)):
        gradient = point.gradient[begin : begin + part_free.size]
        change = float(np.abs(gradient) @ _spans(variable, part_free)) / size
        known = slow and not isinstance(variable, SheetVariable)
        if change < _IDLE and (known or _has_no_effect(search, point, slice(begin, begin + part_free.size), size)):
            found.append((index, variable, change))
        begin += part_free.size
    for index, variable, change in found:
        warn(_sentence(index, variable, change, first, everything=len(found) == len(search.study.variables)))


def _spans(variable: Variable, free: np.ndarray) -> np.ndarray:
    """Distance of each number of the search (n,) from one end of its bounds to the other, at its present slope.

    It is limited to the range of a search.
    """
    slopes = np.abs(np.asarray(jax.jacobian(variable.shares)(jnp.asarray(free)))).max(0)
    return 1.0 / np.maximum(slopes, 1.0 / _FARTHEST)


def _has_no_effect(search: Search, point: Point, rows: slice, size: float) -> bool:
    """True if a step of a variable changes nothing: at an optimum the gradient vanishes too, but not this change."""
    step = np.zeros_like(point.free)
    step[rows] = -_STEP * np.where(point.gradient[rows] < 0.0, -1.0, 1.0)
    outside = np.abs(point.free + step) > search.reach
    value = search.probe(search.inside(np.where(outside, point.free - step, point.free + step)))
    return abs(value - point.value) < _IDLE * size


def _sentence(index: int, variable: Variable, change: float, first: Result, everything: bool) -> str:
    what = f"variable[{index}] ({_kind(variable)}) has almost no effect"
    if everything:
        what = f"this search can hardly improve the design: {what}"
    error = float(first.energy.quasi_static_error)
    remedy = "widen its bounds, or choose another variable"
    if not isinstance(variable, SheetVariable) and error <= QUASI_STATIC_LIMIT:
        remedy = (
            f"the process is slow (energy.quasi_static_error is {format_percent(error)}), and the wall of a slow "
            "process depends on neither pressure nor stiffness nor density: design the sheet's thickness "
            "(thickness-profile), or make the process faster (a steeper pressure, a shorter solver.end_time)"
        )
    return (
        f"{what}: according to the first gradient, a search over it changes the objective by {format_percent(change)}; "
        f"{remedy}"
    )


def numbers_at_bounds(search: Search, free: np.ndarray) -> list[dict[str, Any]]:
    """A row for each variable with numbers at a bound, or at a limit of neighbours, in a design.

    Args:
        search: The search.
        free: The design, as numbers of the search (n,).

    Returns:
        For each variable: its place in the study, its kind, the count of its numbers, and the places from 0 of those at
        the lower end ("lower"), at the upper one ("upper"), and of those that never left the end where they began
        ("unmoved").
    """
    rows = []
    parts = zip(search.parts(side_of_bounds(free, search.reach)), search.parts(search.unmoved), strict=True)
    for index, ((variable, at), (_, unmoved)) in enumerate(parts):
        if at.any():
            lower, upper, same = (np.flatnonzero(mask).tolist() for mask in (at < 0, at > 0, unmoved & (at != 0)))
            facts = {"variable": index, "kind": _kind(variable), "numbers": at.size}
            rows.append(facts | {"lower": lower, "upper": upper, "unmoved": same})
    return rows


def unmoved_numbers(rows: list[dict[str, Any]], stopped_by: str) -> list[str]:
    """A sentence for each variable with numbers that never left their bound in a search that ended at an optimum.

    Args:
        rows: Rows of `numbers_at_bounds`.
        stopped_by: The reason for the search's end, in a word.
    """
    return [
        f"{len(row['unmoved'])} of {row['numbers']} numbers of variable[{row['variable']}] ({row['kind']}) never left "
        "the bound where they began: this may be a local optimum, with better designs inside the bounds; compare other "
        "starts (solver.starts)"
        for row in rows
        if row["unmoved"] and stopped_by in LOCAL
    ]


def _kind(variable: Variable) -> str:
    if isinstance(variable, Scale):
        return f"scale of {variable.of}"
    if isinstance(variable, PressureKnots):
        return "pressure"
    if isinstance(variable, HeaterZones):
        return "heater-zones"
    return "thickness"

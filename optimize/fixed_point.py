"""Fixed-point updates: where the wall is too thin, the sheet is thickened by the root of the missing ratio.

They need no gradient, only the required wall; a search may start from their result, and is compared with it. The full
ratio instead of its root would make the sheet oscillate.

A factor on the whole sheet hardly changes how even a wall is. So a sheet for an even wall that leaves its bounds is
scaled into them rather than clipped, and before a search it is tried as thin and as thick as its bounds allow: between
these levels the value changes slowly and has ripples, in which a search by gradients stands still.
"""

from __future__ import annotations

from collections.abc import Callable

import jax.numpy as jnp
import numpy as np

from optimize.designs import Point, Study
from optimize.search import Search
from optimize.termination import STOPPED, Ending, check_goal
from optimize.variables import Bounds, SheetVariable

_EXPONENT = 0.5
_MOST = 2.0  # times, or one over it, that the sheet changes at once
WARM = 12  # updates at most before a search that says nothing of them
_NEAR = 0.02  # of the sheet: a level that changes it by less is not tried
_WORTH = 0.5  # of the value: what such an update must leave at most, as one does where the target is reachable


def fixed_point(search: Search, study: Study, point: Point) -> tuple[Point, Ending]:
    """Updates from a design; the last one and why it ended."""
    return updates(search, study, point.free, study.iterations)


def updates(search: Search, study: Study, free: np.ndarray, count: int, worth: float = 1.0) -> tuple[Point, Ending]:
    """Up to `count` updates of a design (n,); ends early when one leaves more than `worth` times the value."""
    last, ratio = search.evaluate_forward(free)
    for _ in range(count):
        reached = check_goal(study, last)
        if reached and not search.stopped:
            return last, reached
        ending = search.begin()
        if search.stopped:
            return last, STOPPED
        if ending:
            return last, ending
        if not np.isfinite(last.value):
            return last, Ending("failure", "an update fails")
        free = _update(search, last.free, ratio)
        if np.array_equal(free, last.free):
            return last, Ending("no-step", "an update changes nothing: the sheet would have to leave its bounds")
        new, ratio = search.evaluate_forward(free)
        if new.value > last.value and search.limits is None:
            return last, Ending("no-step", "an update makes the deviation larger")
        gained, last = new.value <= worth * last.value, new
        if not gained and search.limits is None:
            return last, Ending("tolerance", "an update has little effect")
    return last, Ending("iterations", f"{count} updates done")


def warm_start(search: Search, study: Study, free: np.ndarray) -> tuple[Point, Ending] | None:
    """The updates before a search, from a design; None where there are none.

    Where the study says nothing of them, they go on as long as each halves the value, for sums of squares that say how
    thick the wall shall be, of which the sheet is a variable.
    """
    objective = study.objective
    if study.warm_start is not None:
        count, worth = study.warm_start, 1.0
    else:
        sheet = any(isinstance(variable, SheetVariable) for variable in study.variables)
        able = study.method != "fixed-point" and sheet and objective.aims and objective.squares
        count, worth = WARM if able else 0, _WORTH
    if not count:
        return None
    warm = updates(search, study, free, count, worth)
    if objective.scale_free and search.best is not None and not search.stopped:
        _try_levels(search, study, search.best)
    return warm


def _try_levels(search: Search, study: Study, point: Point) -> None:
    """Evaluates the sheet of a point as thin, and as thick, as its bounds allow."""
    for end in (0, 1):
        if search.stopped or check_goal(study, search.best or point):
            return
        free = _change_sheet(search, point.free, lambda sheet, bounds, end=end: sheet * _room(sheet, bounds)[end])
        change = _change_sheet(search, point.free, lambda sheet, _: sheet) - free
        if np.any(np.abs(change) > _NEAR * search.reach):
            search.evaluate_forward(free)


def _update(search: Search, free: np.ndarray, ratio: np.ndarray) -> np.ndarray:
    factor = np.clip(ratio**_EXPONENT, 1.0 / _MOST, _MOST)
    if not search.study.objective.scale_free:
        return _change_sheet(search, free, lambda sheet, _: sheet * factor)
    return _change_sheet(search, free, lambda sheet, bounds: _scale_into(sheet * factor, bounds))


def _change_sheet(search: Search, free: np.ndarray, change: Callable[[np.ndarray, Bounds], np.ndarray]) -> np.ndarray:
    """Numbers of the search (n,) whose sheet is nearest to a changed one; `change` has its thickness and bounds [m]."""
    parts = []
    for variable, part_free in search.parts(free):
        if isinstance(variable, SheetVariable):
            sheet = np.asarray(variable.changes(jnp.asarray(part_free))["parison.thickness"], float)
            part_free = variable.nearest(change(sheet, variable.bounds))
        parts.append(part_free)
    return np.concatenate(parts)


def _room(sheet: np.ndarray, bounds: Bounds) -> tuple[float, float]:
    """Factors that bring a sheet's thinnest place to the lower bound, and its thickest place to the upper one."""
    return bounds[0] / float(sheet.min()), bounds[1] / float(sheet.max())


def _scale_into(sheet: np.ndarray, bounds: Bounds) -> np.ndarray:
    """The sheet (n_node,) where it is within its bounds; else scaled to the middle between them."""
    low, high = _room(sheet, bounds)
    return sheet if low <= 1.0 <= high else sheet * (low * high) ** 0.5

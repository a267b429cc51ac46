"""Fixed-point updates: where the wall is too thin, the sheet is thickened by the root of the missing ratio.

They need no gradient, only the required wall; a search may start from their result, and is compared with it. The full
ratio instead of its root would make the sheet oscillate.
"""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np

from optimize.designs import Point, Study
from optimize.search import Search
from optimize.termination import STOPPED, Ending, check_goal
from optimize.variables import SheetVariable

_EXPONENT = 0.5
_MOST = 2.0  # times, or one over it, that the sheet changes at once
WARM = 12  # updates at most before a search that says nothing of them
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
        new, ratio = search.evaluate_forward(_update(search, last.free, ratio))
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
    if study.warm_start is not None:
        return updates(search, study, free, study.warm_start) if study.warm_start else None
    objective = study.objective
    sheet = any(isinstance(variable, SheetVariable) for variable in study.variables)
    if study.method == "fixed-point" or not (sheet and objective.aims and objective.squares):
        return None
    return updates(search, study, free, WARM, worth=_WORTH)


def _update(search: Search, free: np.ndarray, ratio: np.ndarray) -> np.ndarray:
    factor = np.clip(ratio**_EXPONENT, 1.0 / _MOST, _MOST)
    parts = []
    for variable, part_free in search.parts(free):
        if isinstance(variable, SheetVariable):
            sheet = np.asarray(variable.changes(jnp.asarray(part_free))["parison.thickness"], float)
            part_free = variable.nearest(sheet * factor)
        parts.append(part_free)
    return np.concatenate(parts)

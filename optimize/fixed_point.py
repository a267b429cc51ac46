"""The rule of thumb: where the wall is too thin, thicken the sheet by the root of what is missing.

It needs no gradient, and only what is wanted of the wall; it is where a search may begin, and what searches have to
beat. The root, since with the full factor the sheet oscillates.
"""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np

from optimize.designs import Point, Study
from optimize.endings import GOAL, STOPPED, Ending
from optimize.search import Search
from optimize.variables import SheetVariable

_EXPONENT = 0.5
_MOST = 2.0  # times, or one over it, that the sheet changes at once


def fixed_point(search: Search, study: Study, point: Point) -> tuple[Point, Ending]:
    """Updates from a design; the last one and why it ended."""
    return updates(search, study, point.free, study.iterations)


def updates(search: Search, study: Study, free: np.ndarray, count: int) -> tuple[Point, Ending]:
    """So many updates of a design (n,); ends early when one makes it worse."""
    last, ratio = search.plain(free)
    for _ in range(count):
        ending = search.begin()
        if search.stopped:
            return last, STOPPED
        if study.goal is not None and last.rank <= (0.0, study.goal):
            return last, GOAL
        if ending:
            return last, ending
        if not np.isfinite(last.value):
            return last, Ending("failure", "an update fails")
        new, ratio = search.plain(_updated(search, last.free, ratio))
        if new.value > last.value and search.limits is None:
            return last, Ending("no-step", "an update makes it worse")
        last = new
    return last, Ending("iterations", f"{count} updates done")


def _updated(search: Search, free: np.ndarray, ratio: np.ndarray) -> np.ndarray:
    factor = np.clip(ratio**_EXPONENT, 1.0 / _MOST, _MOST)
    parts = []
    for variable, own in search.parts(free):
        if isinstance(variable, SheetVariable):
            sheet = np.asarray(variable.changes(jnp.asarray(own))["parison.thickness"], float)
            own = variable.nearest(sheet * factor)
        parts.append(own)
    return np.concatenate(parts)

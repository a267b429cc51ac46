"""Searches with limits: rounds, between which multipliers are updated."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np

from optimize.designs import KEPT, Point, Study
from optimize.search import Method, Search
from optimize.termination import NO_STEP, Ending
from optimize.variables import SheetVariable

_STEPS = 12  # of a round at most: to the end of a problem that is about to change, they would be wasted
_IDLE_ROUNDS = 2  # that gain nothing; one alone may have had its multipliers changed for the next one
_MOST_THICKENED = 0.5
_LARGER_PENALTY = 4.0
_ENOUGH = 0.25  # a round that leaves more of the violation than this makes the penalty larger
_NO_PROGRESS = 0.9  # of the violation before: a limit that can be kept is nearer after a round than that


def rounds(search: Search, study: Study, point: Point, method: Method) -> Ending:
    """Searches by a method until limits are satisfied and the objective no longer improves; the reason of the end."""
    before, idle, hopeless, again = np.inf, 0, 0, True
    ending = NO_STEP
    for number in range(1, study.rounds + 1):
        last, least = point.objective, _least_feasible(search)
        search.pause = search.iteration + _STEPS
        point, ending = method(search, study, point)
        search.multiplier = point.row["multiplier"]
        if ending.by in ("caller", "goal"):
            return ending
        if search.iteration >= study.iterations:
            _thicken(search, point)
            return Ending("iterations", f"{search.iteration} iterations done, the last in round {number}")
        settled = point.violation <= KEPT and abs(point.objective - last) <= study.tolerance * abs(last)
        _thicken(search, point)
        idle = 0 if _gain(least, _least_feasible(search)) > study.tolerance else idle + 1
        if number > 1 and (settled or (idle >= _IDLE_ROUNDS and np.isfinite(_least_feasible(search)))):
            if ending.by != "no-progress":
                words = f"limits are satisfied and the objective no longer improves, after {number} rounds"
                return Ending("tolerance", words)
            if not again:
                return ending._replace(words=f"limits are satisfied after {number} rounds, but {ending.words}")
            # Once more, without the memory of the curvature.
            again, search.memory = False, None
        hopeless = hopeless + 1 if point.violation > max(_NO_PROGRESS * before, KEPT) else 0
        if hopeless >= _IDLE_ROUNDS and not np.isfinite(_least_feasible(search)):
            return Ending("no-progress", f"the last {hopeless} of {number} rounds reduced the violation no further")
        _update_multipliers(search, point, before)
        before = point.violation
        point = search(point.free)
    if ending.by == NO_STEP.by:
        return ending
    return Ending("rounds", f"{study.rounds} rounds done, the last ended because: {ending.words}")


def _update_multipliers(search: Search, point: Point, before: float) -> None:
    """Updates the multipliers after a round of the search, and the penalty if the violation fell too little."""
    assert search.limits is not None
    multipliers, penalty = search.limits
    multipliers = jnp.maximum(multipliers + penalty * jnp.asarray(point.excess), 0.0)
    if point.violation > max(_ENOUGH * before, KEPT):
        penalty = _LARGER_PENALTY * penalty
    search.limits = multipliers, penalty


def fall_back(search: Search) -> None:
    """Scales the best design so that it nearly satisfies its limits, with the simulation reserved for that."""
    if search.best is not None and search.limits is not None and search.best.violation > KEPT:
        search.last = True
        _thicken(search, search.best)


def _least_feasible(search: Search) -> float:
    """The least objective so far of designs that keep their limits; infinite without one."""
    best = search.best
    return best.objective if best is not None and best.violation <= KEPT else np.inf


def _gain(before: float, after: float) -> float:
    """Relative to what there was before; infinite for the first design that keeps its limits, 0 where there is none."""
    if not np.isfinite(before):
        return np.inf if np.isfinite(after) else 0.0
    return (before - after) / max(abs(before), 1e-300)


def _thicken(search: Search, point: Point) -> None:
    """Tries the design with a sheet thick enough to satisfy the limit: a feasible design to fall back on.

    The wall is proportional to the sheet, nearly. The search itself goes on from where it was.
    """
    sheets = [variable for variable in search.study.variables if isinstance(variable, SheetVariable)]
    if not sheets or not search.study.objective.aims or not KEPT < point.violation < _MOST_THICKENED:
        return
    parts = []
    for variable, part_free in search.parts(point.free):
        if isinstance(variable, SheetVariable):
            sheet = np.asarray(variable.changes(jnp.asarray(part_free))["parison.thickness"], float)
            part_free = variable.nearest(sheet / (1.0 - point.violation))
        parts.append(part_free)
    search.evaluate_forward(np.concatenate(parts))

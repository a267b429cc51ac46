"""A study from its first design to its best one: checks, warm starts, the search, and its rounds of multipliers."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import jax
import numpy as np

import jaxform
from jaxform import InputError, Result, Scene
from optimize.descent import NO_STEP, STOPPED, adam, lbfgs
from optimize.designs import COLUMNS, KEPT, LIMIT_COLUMNS, Point, Study
from optimize.fixed_point import fixed_point, updates
from optimize.journal import Answer, Journal
from optimize.least_squares import least_squares
from optimize.search import Search
from optimize.variables import SheetVariable

__all__ = ["COLUMNS", "LIMIT_COLUMNS", "METHODS", "Design", "Search", "Study", "solve"]

Row = dict[str, Any]
Method = Callable[[Search, Study, Point], tuple[Point, str]]

METHODS: dict[str, Method] = {
    "lbfgs": lbfgs,
    "adam": adam,
    "least-squares": least_squares,
    "fixed-point": fixed_point,
}
_WITHOUT_GRADIENT = ("fixed-point", "least-squares")  # at the begin; the latter takes its own
_MOST_THICKENED = 0.5
_SPREAD = 1.0  # of several starts, in the unbounded numbers


@dataclass(frozen=True)
class Design:
    """What a search found.

    Attributes:
        scene, result: The best scene and its part.
        first_scene, first_result: The scene to begin with and its part.
        changes: Best design as dotted keys of a scene file with plain values, or nodal arrays.
        history: A row per simulation of the search, with the columns `COLUMNS` (and `LIMIT_COLUMNS`).
        document: Of the study.
        message: Why the search ended.
        objective: Of the best design.
        violation: By how much it breaks the worst limit, relative to it; 0 without constraints.
        gradient_error: Relative difference of the gradient to central differences along one direction, before the
            search; None where it takes no gradient.
        best_row: Of the history.
        multiplier: The weighted sum of the constraints' multipliers; None without constraints.
    """

    scene: Scene
    result: Result
    first_scene: Scene
    first_result: Result
    changes: dict[str, Any]
    history: list[Row]
    document: Any
    message: str
    objective: float
    violation: float
    gradient_error: float | None
    best_row: Row
    multiplier: float | None

    def summary(self) -> dict[str, Any]:
        """Plain facts: what it was before and after, what that took, and how far it can be trusted."""
        names = ("objective", "thickness_rms_error", "wall_min", "wall_mean", "wall_cv", "mass")
        before, after = ({name: _number(row[name]) for name in names} for row in (self.history[0], self.best_row))
        return {
            "message": self.message,
            "before": before,
            "after": after,
            "violation": self.violation,
            "multiplier": self.multiplier,
            "gradient_error": self.gradient_error,
            "evaluations": len(self.history),
            "simulations": self.history[-1]["simulations"],
            "seconds": self.history[-1]["seconds"],
        }


def _number(value: Any) -> float | None:
    return None if value == "" else float(value)


def solve(
    study: Study,
    on_evaluation: Callable[[Row], object] | None = None,
    *,
    on_check: Callable[[float], object] | None = None,
    journal: Journal | None = None,
) -> Design:
    """Searches for the best design.

    Args:
        study: What is designed and how.
        on_evaluation: Called with every row of the history as it comes; a true answer ends the search.
        on_check: Called with the gradient's relative difference to central differences, before the search.
        journal: What is kept on disk, so that a search that was killed goes on; nothing by default.

    Raises:
        InputError: If the study asks for what its objective or variables do not have, or the scene to begin with
            cannot be simulated to its end.
    """
    _check(study)
    first = jaxform.run(study.scene)
    if int(first.status):
        raise InputError(f"the scene to begin with fails: {jaxform.explain(first)}", "mend the scene first", "scene")
    forward_seconds = _cost(study.scene)
    study = dataclasses.replace(study, scene=jaxform.fitted(study.scene, int(first.used.sum())))
    schedule = None if study.scene.refinement is None else first.schedule
    search = Search(study, on_evaluation, forward_seconds, schedule=schedule, journal=journal or Journal())
    try:
        message = _searched(search, study, on_check)
    except KeyboardInterrupt:
        if search.best is None:
            raise
        message = "interrupted"  # what was found is worth keeping
    best = search.best
    if best is None:
        raise InputError("the first design, moved into the bounds, fails", "widen the bounds", "variable.bounds")
    scene = search.scene(best.free)
    return Design(
        scene=scene,
        result=jaxform.run(scene),
        first_scene=study.scene,
        first_result=first,
        changes=search.document(best.free),
        history=search.history,
        document=study.document,
        message=message,
        objective=best.objective,
        violation=best.violation,
        gradient_error=search.gradient_error,
        best_row=best.row,
        multiplier=None if search.limits is None else search.multiplier,
    )


def _cost(scene: Scene) -> float:
    """Processor time [s] of a simulation, the unit in which they are counted; the first in a process took longer."""
    spent = []
    for _ in range(2):
        began = time.process_time()
        jaxform.run(scene)
        spent.append(time.process_time() - began)
    return max(min(spent), 1e-6)


def _check(study: Study) -> None:
    """Raises InputError where method, objective and variables do not go together."""
    paths = [path for part in study.variables for path in part.changes(jax.numpy.asarray(part.start))]
    for path in paths:
        if paths.count(path) > 1:
            raise InputError("is designed by two variables", "keep one of them", "variable", path)
    objective = study.objective
    if study.method == "least-squares" and (not objective.squares or objective.constrained):
        mend = "use the method lbfgs, or the objective target or uniform"
        raise InputError("needs a sum of squares without limits", mend, "solver.method", study.method)
    rule = {"fixed-point": "solver.method"}.get(study.method) or (study.warm_start and "solver.warm_start")
    if not rule:
        return
    if not objective.aims:
        mend = "use target, uniform or least-mass, or leave it out"
        raise InputError("needs an objective that says how thick the wall shall be", mend, rule)
    if not any(isinstance(variable, SheetVariable) for variable in study.variables):
        mend = "add a thickness-profile or thickness-field, or leave it out"
        raise InputError("changes the sheet, which is no variable here", mend, rule)


def _searched(search: Search, study: Study, on_check: Callable[[float], object] | None) -> str:
    """Warm starts, the gradient's check and the search; why it ended."""
    free = search.start
    if study.starts > 1:
        free = _best_start(search, study)
    if study.warm_start:
        last, _ = updates(search, study, free, study.warm_start)
        if search.best is not None:
            # Where there are limits the last one is the best, though it may break them by a few per cent more.
            free = last.free if search.limits is not None and np.isfinite(last.value) else search.best.free
    point = search.plain(free)[0] if study.method in _WITHOUT_GRADIENT else search(free)
    if search.stopped:
        return STOPPED
    if not np.isfinite(point.value):
        return "the first design fails"
    if study.method != "fixed-point":
        known = search.curvature(free)[0] if study.method == "least-squares" else point
        error = search.check(known)
        if on_check is not None:
            on_check(error)
    return _rounds(search, study, point) if study.objective.constrained else _search(search, study, point)[1]


def _search(search: Search, study: Study, point: Point) -> tuple[Point, str]:
    return METHODS[study.method](search, study, point)


def _rounds(search: Search, study: Study, point: Point) -> str:
    """Searches between which the multipliers are brought up to date, until limits are kept and nothing changes."""
    before = np.inf
    for number in range(1, study.rounds + 1):
        last = point.objective
        point, message = _search(search, study, point)
        if search.stopped:
            return message
        if point.violation <= KEPT and abs(point.objective - last) <= study.improvement * abs(last) and number > 1:
            return f"limits are kept and nothing more is gained, after {number} rounds"
        _thicken(search, point)
        search.press(point, before)
        before = point.violation
        point = search(point.free)
    return f"{study.rounds} rounds done, the last ended since: {message}" if message != NO_STEP else message


def _thicken(search: Search, point: Point) -> None:
    """Tries the design with so much thicker a sheet that the limit ought to be kept: a good design to fall back on.

    The wall is proportional to the sheet, nearly. The search itself goes on from where it was.
    """
    sheets = [variable for variable in search.study.variables if isinstance(variable, SheetVariable)]
    if not sheets or not search.study.objective.aims or not KEPT < point.violation < _MOST_THICKENED:
        return
    parts = []
    for variable, own in search.parts(point.free):
        if isinstance(variable, SheetVariable):
            sheet = np.asarray(variable.changes(jax.numpy.asarray(own))["parison.thickness"], float)
            own = variable.nearest(sheet / (1.0 - point.violation))
        parts.append(own)
    search.plain(np.concatenate(parts))


def _best_start(search: Search, study: Study) -> np.ndarray:
    """The best of several designs about the first one, simulated side by side."""
    first = search.start
    strewn = _SPREAD * np.random.default_rng(0).normal(size=(study.starts - 1, first.size))
    designs = np.concatenate([first[None], first + strewn])

    def work() -> Answer:
        rows = [search.changes(jax.numpy.asarray(design)) for design in designs]
        stacked = {path: np.stack([np.asarray(row[path]) for row in rows]) for path in rows[0]}
        results = jaxform.simulate_batch(search.study.scene, stacked)
        values = []
        for k, row in enumerate(rows):
            result = jax.tree.map(lambda leaf, k=k: leaf[k], results)
            value, report = search.judged(jaxform.replace(search.study.scene, row), result, search.limits)
            good = not int(report["status"]) and np.isfinite(value)
            values.append(float(value) if good else np.inf)
        return {"values": values, "spent": len(designs) * search.forward_seconds}

    return designs[int(np.argmin(search.asked("starts", designs.ravel(), work)["values"]))]

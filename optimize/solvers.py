"""A search from its first design to its best one: checks, warm starts, the method, and its rounds of multipliers."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import jax
import numpy as np

import jaxform
from jaxform import InputError, Result, Scene
from jaxform.extend import part_elements
from optimize import feasibility, sensitivity_check, slope_trend
from optimize.descent import adam, lbfgs
from optimize.designs import COLUMNS, LIMIT_COLUMNS, Point, Study
from optimize.fixed_point import fixed_point, warm_start
from optimize.hopping import hop
from optimize.journal import Journal
from optimize.least_squares import least_squares
from optimize.penalty_rounds import fall_back, rounds
from optimize.price import price
from optimize.search import Evaluators, Method, Search
from optimize.termination import STOPPED, Ending, SpentError, check_goal
from optimize.variables import SheetVariable
from optimize.wall_statistics import formed_part

__all__ = ["COLUMNS", "LIMIT_COLUMNS", "METHODS", "Design", "Search", "Study", "solve_once"]

Row = dict[str, Any]

METHODS: dict[str, Method] = {
    "lbfgs": lbfgs,
    "adam": adam,
    "least-squares": least_squares,
    "fixed-point": fixed_point,
}
_HALVINGS = 4  # of the way between a start that fails and the scene's own design
_UNFINISHED = ("caller", "failure")  # endings of a search whose best design is compared with nothing
_WITHOUT_GRADIENT = ("fixed-point", "least-squares")  # at the start; the latter takes its own


@dataclass(frozen=True)
class Design:
    """Result of a search.

    Attributes:
        scene, result: The best scene and its part.
        first_scene, first_result: The initial scene and its part.
        changes: Best design as dotted keys of a scene file with plain values, or nodal arrays.
        history: A row per simulation of the search, with the columns `COLUMNS` (and `LIMIT_COLUMNS`).
        document: Document of the study.
        message: The reason for the search's end, in words.
        stopped_by: The reason in one word: a key of the study, or one that `optimize.termination.Ending` names.
        broken: Description of the limits that the design breaks, by how much, and the remedy; empty where it keeps all.
        warnings: Warnings about the study, a sentence each.
        objective: Objective of the best design.
        violation: Its violation of the worst limit, relative to it; 0 without constraints.
        gradient_error: Relative difference of the gradient to central differences along one direction, before the
            search; None where it takes no gradient.
        secants: Slope and secant along the steepest direction, at the first design of the search ("start") and at the
            best one ("end"); see `optimize.slope_trend`.
        best_row: Row of the best design in the history.
        multiplier: The weighted sum of the constraints' multipliers; None without constraints, or before
            a round has ended.
        updates: Updates of the fixed point before the search.
        simulations: Cost of all of the search, checks of its gradient included, in simulations without gradient.
        seconds: Its time [s].
        starts: A row for each of several starts: its number from 1, objective, status, simulations, and seconds.
        at_bounds: A row for each variable with numbers at a bound in the best design; see
            `optimize.sensitivity_check.numbers_at_bounds`.
        first_row: Row of the study's own first design; None where it is the first of the history.
    """

    scene: Scene
    result: Result
    first_scene: Scene
    first_result: Result
    changes: dict[str, Any]
    history: list[Row]
    document: Any
    message: str
    stopped_by: str
    broken: str
    warnings: list[str]
    objective: float
    violation: float
    gradient_error: float | None
    best_row: Row
    multiplier: float | None
    updates: int
    simulations: float
    seconds: float
    starts: list[Row] = field(default_factory=list)
    first_row: Row | None = None
    at_bounds: list[Row] = field(default_factory=list)
    secants: dict[str, dict[str, float]] = field(default_factory=dict)

    @property
    def status(self) -> str:
        """The status of the best part's run in words, "ok" if nothing stopped it, and the limits that it breaks."""
        stopped = jaxform.explain(self.result) if int(self.result.status) else ""
        return "; ".join(filter(None, [stopped, self.broken])) or "ok"

    def amend_summary(self, summary: dict[str, Any]) -> dict[str, Any]:
        """The summary of the part and the search: status, warnings, and its facts."""
        warnings = [*self.warnings, *summary["warnings"]]
        return summary | {"status": self.status, "warnings": warnings, "design": self.summary()}

    def summary(self) -> dict[str, Any]:
        """Plain facts: values before and after, cost, and accuracy."""
        names = ("objective", "thickness_rms_error", "wall_min", "wall_mean", "wall_cv", "mass")
        before, after = (
            {name: _number(row[name]) for name in names} for row in (self.first_row or self.history[0], self.best_row)
        )
        return {
            "status": self.status,
            "message": self.message,
            "stopped_by": self.stopped_by,
            "before": before,
            "after": after,
            "violation": self.violation,
            "multiplier": self.multiplier,
            "gradient_error": self.gradient_error,
            "secants": self.secants,
            "at_bounds": self.at_bounds,
            "iterations": self.history[-1]["iteration"],
            "warm_start": self.updates,
            "evaluations": len(self.history),
            "simulations": self.simulations,
            "seconds": self.seconds,
            "price": price(self.history),
            "warnings": self.warnings,
        } | ({"starts": self.starts} if self.starts else {})


def _number(value: Any) -> float | None:
    return None if value == "" else float(value)


def solve_once(
    study: Study,
    on_evaluation: Callable[[Row], object] | None = None,
    *,
    on_check: Callable[[float], object] | None = None,
    on_warning: Callable[[str], object] | None = None,
    on_wait: Callable[[str], object] | None = None,
    journal: Journal | None = None,
    evaluators: Evaluators | None = None,
    programs: dict[str, Any] | None = None,
) -> Design:
    """Searches for the best design from one start; see `optimize.solve`.

    Args:
        study: The design study.
        on_evaluation: See `optimize.solve`.
        on_check: See there.
        on_warning: See there.
        on_wait: See there.
        journal: See there.
        evaluators: Function that computes values for the check of the gradient side by side; None for one after the
            other.
        programs: Compiled programs of another search of this study, which gets those of this one.

    Raises:
        InputError: See `optimize.solve`.
    """
    check(study)
    if on_wait is not None:
        on_wait("simulating the initial scene")
    first = formed_part(study.scene)
    if int(first.status):
        raise InputError(f"the initial scene fails: {jaxform.explain(first)}", "correct the scene first", "scene")
    if not np.asarray(part_elements(first, study.scene)).any():
        raise InputError("has no element of the formed sheet", "give places in the formed part, in m", "part")
    forward_seconds = _cost(study.scene)
    study = dataclasses.replace(study, scene=jaxform.fitted(study.scene, int(first.used.sum())))
    schedule = None if study.scene.refinement is None else first.schedule
    search = Search(
        study,
        on_evaluation,
        forward_seconds,
        schedule=schedule,
        journal=journal or Journal(),
        on_wait=on_wait,
        evaluators=evaluators,
        programs={} if programs is None else programs,
    )
    warnings: list[str] = []

    def warn(sentence: str) -> None:
        warnings.append(sentence)
        if on_warning is not None:
            on_warning(sentence)

    for sentence in feasibility.doubts(study):
        warn(sentence)
    try:
        ending = _run_search(
            search,
            study,
            on_check,
            lambda point: sensitivity_check.warn_of_insensitive_variables(search, point, first, warn),
            warn,
        )
        if ending.by not in _UNFINISHED:
            slope_trend.compare_end(search, warn)
    except SpentError as spent:
        ending = spent.ending
        fall_back(search)
    except KeyboardInterrupt:
        if search.best is None:
            raise
        ending = Ending("interrupted", "interrupted")  # what was found is worth keeping
    best = search.best
    if best is None:
        raise InputError("the initial design, moved into the bounds, fails", "widen the bounds", "variable.bounds")
    scene = search.scene(best.free)
    result = jaxform.run(scene)
    return Design(
        scene=scene,
        result=result,
        first_scene=study.scene,
        first_result=first,
        changes=search.document(best.free),
        history=search.history,
        document=study.document,
        message=ending.words,
        stopped_by=ending.by,
        broken=feasibility.broken_limits(study, scene, result, best, ending),
        warnings=warnings,
        objective=best.objective,
        violation=best.violation,
        gradient_error=search.gradient_error,
        best_row=best.row,
        multiplier=search.multiplier,
        updates=search.updates,
        simulations=search.simulations,
        seconds=search.seconds,
        secants=search.secants,
        at_bounds=sensitivity_check.numbers_at_bounds(search, best.free),
    )


def _cost(scene: Scene) -> float:
    """Processor time [s] of a simulation, the unit in which they are counted; the first in a process took longer."""
    spent = []
    for _ in range(2):
        began = time.process_time()
        formed_part(scene)
        spent.append(time.process_time() - began)
    return max(min(spent), 1e-6)


def check(study: Study) -> None:
    """Raises InputError if method, objective and variables cannot be combined, or a limit cannot be satisfied."""
    _check_method(study)
    feasibility.check(study)


def _check_method(study: Study) -> None:
    paths = [path for part in study.variables for path in part.changes(jax.numpy.asarray(part.start))]
    for path in paths:
        if paths.count(path) > 1:
            raise InputError("is changed by two variables", "keep one of them", "variable", path)
    objective = study.objective
    if study.hops and (objective.constrained or study.method == "fixed-point"):
        what = "an objective without limits" if objective.constrained else "a method that takes gradients"
        raise InputError(f"need {what}", "leave them out, or use starts", "solver.hops", study.hops)
    if study.method == "least-squares" and (not objective.squares or objective.constrained):
        remedy = "use the method lbfgs, or the objective target or uniform"
        raise InputError(
            "needs an objective that is a sum of squares, without limits", remedy, "solver.method", study.method
        )
    rule = {"fixed-point": "solver.method"}.get(study.method) or (study.warm_start and "solver.warm_start")
    if not rule:
        return
    if not objective.aims:
        remedy = "use target, uniform or least-mass, or leave it out"
        raise InputError("needs an objective with a target thickness", remedy, rule)
    if not any(isinstance(variable, SheetVariable) for variable in study.variables):
        remedy = "add a thickness-profile or thickness-field, or leave it out"
        raise InputError("changes the sheet, which is not a variable of this study", remedy, rule)


def _run_search(
    search: Search,
    study: Study,
    on_check: Callable[[float], object] | None,
    look: Callable[[Point], object],
    warn: Callable[[str], object],
) -> Ending:
    """Warm start, checks of the first gradient, and the search; the reason of its end."""
    free = search.start
    warm = warm_start(search, study, free)
    if warm is not None and search.best is not None:
        search.updates, (last, _) = search.iteration, warm
        # Where there are limits the last one is the best, though it may break them by a few per cent more.
        free = last.free if search.limits is not None and np.isfinite(last.value) else search.best.free
        if search.limits is None and not search.stopped and (reached := check_goal(study, search.best)):
            return reached
    point = _evaluate_first(search, study, free)
    if search.stopped:
        return STOPPED
    if not np.isfinite(point.value) and study.first is not None:
        point = _approach_own_design(search, study, point)
        free = point.free
    if not np.isfinite(point.value):
        return Ending("failure", "the first design fails")
    if study.method != "fixed-point":
        known = search.curvature(free)[0] if study.method == "least-squares" else point
        look(known)
        error = search.check(known)
        if on_check is not None:
            on_check(error)
        slope_trend.compare_start(search, known, warn)
    method = METHODS[study.method]
    if study.objective.constrained:
        return rounds(search, study, point, method)
    return hop(
        search, study, method(search, study, point)[1], method, lambda free: _evaluate_first(search, study, free)
    )


def _evaluate_first(search: Search, study: Study, free: np.ndarray) -> Point:
    """The first design of a search, with its gradient where the method does not take its own."""
    return search.evaluate_forward(free)[0] if study.method in _WITHOUT_GRADIENT else search(free)


def _approach_own_design(search: Search, study: Study, point: Point) -> Point:
    """The first point on the way from a start that fails to the scene's own design that does not, by halving it."""
    own = np.concatenate([variable.start for variable in study.variables])
    for _ in range(_HALVINGS):
        free = 0.5 * (point.free + own)
        point = _evaluate_first(search, study, free)
        if np.isfinite(point.value) or search.stopped:
            break
    return point

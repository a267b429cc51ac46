"""Slopes against secants: how well the gradient predicts a change of the design by a hundredth of its bounds.

The gradient is that of the discrete run, whose value has ripples along a design: small in value, steep in slope, for
the moment in a time step at which a node lands changes with the design (docs/explanation/gradients.md).
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

import jaxform
from optimize.designs import Point, Study
from optimize.search import Search
from optimize.termination import SpentError

SECANT_STEP = 0.04  # of the number that changes most: a hundredth of the way between its bounds
_PARTED, _NEGLIGIBLE = 0.1, 0.01  # of the larger of slope and secant, and of the first gradient
_NOTICED = 1e-3  # of the objective at first: what slope and secant differ by over the step, to be worth a warning
_RUNS, _GRADIENT_COST = 4, 4  # simulations for both comparisons, and those that an iteration takes the time of
_MOST_SHARE = 0.05  # of the simulations that a search may take
_SAFE = 0.45  # share of the stable step with which slopes of a fast preform were those of secants (gradients.md)
_PLACES = {"start": "first", "end": "best"}

Found = dict[str, float]


def is_affordable(study: Study) -> bool:
    """True if the method takes gradients, and the runs for secants cost little beside those that the study allows."""
    most = min(_GRADIENT_COST * study.iterations, study.max_simulations or np.inf)
    return study.method != "fixed-point" and _RUNS <= _MOST_SHARE * most


def compare_start(search: Search, point: Point, warn: Callable[[str], object]) -> None:
    """Compares slope and secant at the first design of a search, a point with its gradient."""
    if is_affordable(search.study):
        _compare(search, "start", point, warn)


def compare_end(search: Search, warn: Callable[[str], object]) -> None:
    """Compares slope and secant at the best design of a search that is over, if the budget allows it."""
    best = search.best
    if best is None or "start" not in search.secants:
        return
    try:
        # Multipliers or decisions about the mesh may have changed since the best design was evaluated.
        changed = search.limits is not None or search.schedule is not None or not np.isfinite(best.gradient).all()
        _compare(search, "end", search.with_gradient(best.free) if changed else best, warn)
    except (SpentError, KeyboardInterrupt):
        return


def _compare(search: Search, place: str, point: Point, warn: Callable[[str], object]) -> None:
    """Stores slope and secant at a point under the name of its place, and warns if they differ."""
    found = slope_and_secant(point, search.reach, search.secant_values)
    if found is None:
        return
    search.secants[place] = found
    first = search.history[0]["objective"] if search.history else point.value
    if parts_from_secant(found, abs(search.secants["start"]["slope"]), abs(first)):
        landing = _advise_landing(search.study.scene)
        warn(
            f"at the {_PLACES[place]} design the slope of the objective is not its trend: {found['slope']:.3g} along "
            f"the gradient, {found['secant']:.3g} over a change of the variables by 1 % of their bounds; compare "
            f"designs by their objective, or search with solver.hops or solver.starts{landing}"
        )


def _advise_landing(scene: jaxform.Scene) -> str:
    """Advice to use smooth landing and shorter steps, for scenes that allow it; empty for others."""
    solver = scene.solver
    if not scene.surfaces or scene.moves or scene.slides or solver.edge_contact:
        return ""
    if solver.smooth_landing and solver.safety <= _SAFE:
        return ""
    return (
        f"; slopes are nearer to the trend where the scene has solver.smooth_landing = true and solver.safety = {_SAFE}"
    )


def slope_and_secant(
    point: Point, reach: np.ndarray, values: Callable[[list[np.ndarray]], list[float]]
) -> Found | None:
    """Slope of the value along the gradient, for a step of length 1, its secant over two designs, and the step.

    One is a step up, one a step down; the number that changes most changes by `SECANT_STEP`. Numbers that this would
    lead out of the bounds stay as they are. None where nothing is left, or a simulation fails.
    """
    slope = np.where(np.isfinite(point.slope), point.slope, 0.0)
    step = SECANT_STEP * slope / max(float(np.abs(slope).max(initial=0.0)), np.finfo(float).tiny)
    step = np.where(reach - np.abs(point.free) >= np.abs(step), step, 0.0)
    length = float(np.linalg.norm(step))
    if length == 0.0:
        return None
    up, down = values([point.free + step, point.free - step])
    if not np.isfinite(up - down):
        return None
    return {"slope": float(point.gradient @ step) / length, "secant": (up - down) / (2.0 * length), "step": length}


def parts_from_secant(found: Found, first_slope: float, first_value: float) -> bool:
    """True if slope and secant differ noticeably.

    They differ by more than a tenth, by more than a hundredth of the first slope and, over the step, by more than a
    thousandth of the value that the search began with: near an optimum a small slope may have any secant.
    """
    slope, secant = found["slope"], found["secant"]
    apart = abs(slope - secant)
    noticed = apart * found["step"] > _NOTICED * first_value
    return noticed and apart > _PARTED * max(abs(slope), abs(secant)) and apart > _NEGLIGIBLE * first_slope

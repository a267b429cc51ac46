"""First-order searches within bounds: L-BFGS with a line search that sees every simulation, and optax's Adam.

The loop is on the host, so that every simulation is a row of the history, is reported, and can stop the search. After a
failed simulation the line search shortens its step, and Adam goes back to the best design and halves its rate.

SciPy's L-BFGS-B was tried in its place, with the same bounds and numbers: it converges as fast (on 16 quadratic and
convex functions of 25 numbers, most with optima on bounds, to a ten-thousandth in 17 evaluations, this one in 16), but
ended with an abnormal line search where contact makes the objective rough, and it knows neither failed simulations nor
a mesh whose decisions are renewed on the way. Optax's L-BFGS, whose curvature cannot be had for the numbers that are
not held alone, took 49.
"""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
import optax
from scipy.optimize import LbfgsInvHessProduct

from optimize.designs import Point, Study
from optimize.search import Search
from optimize.termination import NO_STEP, STOPPED, Ending, check_convergence, is_negligible, stagnation_ending

_SUFFICIENT, _CURVATURE = 1e-4, 0.9  # of the weak Wolfe conditions
_TRIALS = 8
_INSIDE = (0.1, 0.8)  # of an interval, where the next trial is
_MEMORY = 10
_CURVED = 1e-12  # below which a step has no information on the curvature
_FIRST_STEP, _LEAST_FIRST_STEP = 1.0, 0.2  # of the number with the largest slope, of 4 between its bounds


def lbfgs(search: Search, study: Study, point: Point) -> tuple[Point, Ending]:
    """L-BFGS' direction with a weak Wolfe line search; the last point and why it ended.

    Numbers at a bound are fixed if the gradient points out of it; the line search follows the path projected onto the
    bounds.
    """
    # With limits, the next round searches again.
    first, values, again, stuck = point, [point.value], not study.objective.constrained, False
    while True:
        ending = (
            search.begin()
            or check_convergence(study, point, values, first)
            or (stagnation_ending(study, point, first) if stuck else None)
        )
        if ending and ending.by == "no-progress" and again:
            # Once more, without the memory of the curvature.
            again, stuck, values, search.memory, ending = False, False, [point.value], None, None
        if ending:
            return point, ending
        step, whole = _line_search(search, point, _direction(search, point))
        failure = stagnation_ending(study, point, first, NO_STEP.by)
        if step is None and again and failure.by == "no-progress" and not search.stopped:
            again, search.memory = False, None
            step, whole = _line_search(search, point, _direction(search, point))
        if search.stopped:
            return step or point, STOPPED
        if step is None:
            return point, failure
        values.append(step.value)
        stuck = not whole and is_negligible(study, point.value, step.value)
        point = search.refresh(step)


def _direction(search: Search, point: Point) -> np.ndarray:
    """L-BFGS' direction (n,) of the numbers that are not held, 0 for those that are; it brings the memory up to date.

    The memory is the last design, and the last steps with the changes of the gradient by them. The curvature from an
    earlier round holds approximately for other multipliers.
    """
    steps: list[np.ndarray] = []
    changes: list[np.ndarray] = []
    if search.memory is not None:
        last, steps, changes = search.memory
        if not np.array_equal(last.free, point.free):
            steps = [*steps, point.free - last.free][-_MEMORY:]
            changes = [*changes, point.gradient - last.gradient][-_MEMORY:]
    search.memory = point, steps, changes
    moving = point.slope != 0.0
    pairs = [(step[moving], change[moving]) for step, change in zip(steps, changes, strict=True)]
    pairs = [(step, change) for step, change in pairs if step @ change > _CURVED * (change @ change) > 0.0]
    direction = np.zeros_like(point.free)
    if not pairs:
        return -_first_size(search, point) / max(np.abs(point.slope).max(), 1e-300) * point.slope
    step, change = pairs[-1]
    size = (step @ change) / (change @ change)  # of the first guess of the inverse curvature, which SciPy takes as 1
    scaled = np.array(pairs) * np.array([[[size**-0.5], [size**0.5]]])
    inverse = LbfgsInvHessProduct(scaled[:, 0], scaled[:, 1])
    direction[moving] = -size * np.asarray(inverse.matvec(point.slope[moving]))
    return direction


def _first_size(search: Search, point: Point) -> float:
    """First step of the number with the largest slope, without knowledge of the curvature.

    A sum of squares is not below 0: a parabola with its value and slope reaches 0 at this distance.
    """
    steepest = float(np.abs(point.slope).max())
    if search.study.objective.squares and search.limits is None:
        return min(_FIRST_STEP, 2.0 * point.value * steepest / max(float(point.slope @ point.slope), 1e-300))
    return min(_FIRST_STEP, max(steepest, _LEAST_FIRST_STEP))


_IntervalEnd = tuple[float, float, float]
"""An end of the interval that holds the step: its length, and value and slope there."""


def _line_search(search: Search, point: Point, direction: np.ndarray) -> tuple[Point | None, bool]:
    """A point that meets the weak Wolfe conditions, else the best one that is better, else None; and whether it does.

    The path is projected onto the bounds.
    """
    slope = float(direction @ point.slope)
    short, long, length = (0.0, point.value, slope), (np.inf, np.inf, np.nan), 1.0
    better: Point | None = None
    for _ in range(_TRIALS):
        trial = search(search.inside(point.free + length * direction))
        moving = np.abs(trial.free) < search.reach
        end = length, trial.value, float(trial.gradient @ np.where(moving, direction, 0.0))
        if trial.value < (better or point).value:
            better = trial
        if search.stopped:
            break
        if not trial.value <= point.value + _SUFFICIENT * length * slope:
            long = end
        elif end[2] < _CURVATURE * slope:
            short = end
        else:
            return trial, True
        length = _cubic_minimum(short, long)
    return better, False


def _cubic_minimum(short: _IntervalEnd, long: _IntervalEnd) -> float:
    """Minimum of the cubic through both ends, well inside; twice the shorter length where there is no longer one."""
    (length, value, slope), (far_length, far_value, far_slope) = short, long
    if np.isinf(far_length):
        return 2.0 * length
    width = far_length - length
    share = 0.5
    if np.isfinite(far_value):
        first = slope + far_slope - 3.0 * (far_value - value) / width
        root = np.sqrt(max(first**2 - slope * far_slope, 0.0))
        below = far_slope - slope + 2.0 * root
        share = 1.0 - (far_slope + root - first) / below if below != 0.0 else 0.5
    return length + width * float(np.clip(share, *_INSIDE))


def adam(search: Search, study: Study, point: Point) -> tuple[Point, Ending]:
    """Optax's Adam; after a failed simulation from the best design with half the rate."""
    rate = study.learning_rate
    transform = optax.scale_by_adam()
    first = point
    state = transform.init(jnp.asarray(point.free))
    while True:
        ending = search.begin() or check_convergence(study, point, [], first)
        if ending:
            return point, ending
        update, state = transform.update(jnp.asarray(point.gradient), state)
        trial = search(search.inside(point.free - rate * np.asarray(update)))
        if search.stopped:
            return trial, STOPPED
        if np.isfinite(trial.value):
            point = search.refresh(trial)
        else:
            assert search.best is not None
            rate, point, state = 0.5 * rate, search.best, transform.init(jnp.asarray(search.best.free))

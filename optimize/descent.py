"""First-order searches: optax's L-BFGS with a line search that sees every simulation, and optax's Adam.

The loop is the host's, so that every simulation is a row of the history and can be shown, kept and stopped. After a
failed simulation the line search shortens its step, and Adam goes back to the best design and halves its rate.
"""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
import optax

from optimize.designs import Point, Study
from optimize.endings import NO_STEP, STOPPED, Ending, done
from optimize.search import Search

_SUFFICIENT, _CURVATURE = 1e-4, 0.9  # of the weak Wolfe conditions
_TRIALS = 12
_INSIDE = (0.1, 0.8)  # of an interval, where the next trial is
_MEMORY = 10
_FIRST_STEP = 1.0  # in the unbounded numbers, of the largest of them


def lbfgs(search: Search, study: Study, point: Point) -> tuple[Point, Ending]:
    """Optax's L-BFGS direction with a weak Wolfe line search; the last point and why it ended."""
    transform = optax.scale_by_lbfgs(memory_size=_MEMORY)
    first, values, fresh = point, [point.value], search.memory is None
    # What an earlier round learnt of the curvature holds for other multipliers, nearly.
    state = transform.init(jnp.asarray(point.free)) if search.memory is None else search.memory
    while True:
        ending = search.begin() or done(study, point, values, first)
        if ending:
            return point, ending
        update, state = transform.update(jnp.asarray(point.gradient), state, jnp.asarray(point.free))
        direction = -np.asarray(update)
        if direction @ point.gradient >= 0:
            state, fresh = transform.init(jnp.asarray(point.free)), True
            direction = -point.gradient
        if fresh:
            # Nothing is known of the curvature.
            fresh = False
            direction = direction * min(1.0, _FIRST_STEP / np.abs(direction).max())
        search.memory = state
        step = _line_search(search, point, direction)
        if search.stopped:
            return step or point, STOPPED
        if step is None:
            return point, NO_STEP
        values.append(step.value)
        point = search.refreshed(step)


class _End(NamedTuple):
    """An end of the interval that holds the step: its length, and value and slope there."""

    length: float
    value: float
    slope: float


def _line_search(search: Search, point: Point, direction: np.ndarray) -> Point | None:
    """A point that meets the weak Wolfe conditions; else the best one that is better, else None."""
    slope = float(direction @ point.gradient)
    short, long, length = _End(0.0, point.value, slope), _End(np.inf, np.inf, np.nan), 1.0
    better: Point | None = None
    for _ in range(_TRIALS):
        trial = search(point.free + length * direction)
        end = _End(length, trial.value, float(trial.gradient @ direction))
        if trial.value < (better or point).value:
            better = trial
        if search.stopped:
            break
        if not trial.value <= point.value + _SUFFICIENT * length * slope:
            long = end
        elif end.slope < _CURVATURE * slope:
            short = end
        else:
            return trial
        length = _between(short, long)
    return better


def _between(short: _End, long: _End) -> float:
    """Where a cubic through both ends is least, well inside; twice the shorter length where there is no longer one."""
    if np.isinf(long.length):
        return 2.0 * short.length
    width = long.length - short.length
    share = 0.5
    if np.isfinite(long.value):
        first = short.slope + long.slope - 3.0 * (long.value - short.value) / width
        root = np.sqrt(max(first**2 - short.slope * long.slope, 0.0))
        below = long.slope - short.slope + 2.0 * root
        share = 1.0 - (long.slope + root - first) / below if below != 0.0 else 0.5
    return short.length + width * float(np.clip(share, *_INSIDE))


def adam(search: Search, study: Study, point: Point) -> tuple[Point, Ending]:
    """Optax's Adam; after a failed simulation from the best design with half the rate."""
    rate = study.learning_rate
    transform = optax.scale_by_adam()
    first = point
    state = transform.init(jnp.asarray(point.free))
    while True:
        ending = search.begin() or done(study, point, [], first)
        if ending:
            return point, ending
        update, state = transform.update(jnp.asarray(point.gradient), state)
        trial = search(point.free - rate * np.asarray(update))
        if search.stopped:
            return trial, STOPPED
        if np.isfinite(trial.value):
            point = search.refreshed(trial)
        else:
            assert search.best is not None
            rate, point, state = 0.5 * rate, search.best, transform.init(jnp.asarray(search.best.free))

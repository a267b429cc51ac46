"""Levenberg-Marquardt for sums of squares of few variables, with slopes by forward differentiation.

A library's would do as well (scipy has one) but for two things: a search that goes on after a kill asks the same
questions again, and a simulation that fails is a step to shorten.
"""

from __future__ import annotations

import numpy as np

from optimize.designs import Point, Study
from optimize.endings import NO_STEP, STOPPED, Ending, done
from optimize.search import Search

_FIRST_DAMPING, _DAMPING_STEP, _TRIALS = 1e-4, 10.0, 8
_LARGEST = 4.0  # a step in the unbounded numbers, beyond which their map is flat
_IDLE_STEPS = 3  # that bring next to nothing; where contact makes the value rough, one may be stuck and the next not
_FLOOR = 1e-6  # of the largest diagonal entry: where a number does nothing, the step stays small


def least_squares(search: Search, study: Study, point: Point) -> tuple[Point, Ending]:
    """Levenberg-Marquardt from a point; the last point and why it ended. A step is a matrix and a trial or more."""
    first, values, damping = search.curvature(point.free)[0], [point.value], _FIRST_DAMPING
    while True:
        ending = search.begin()
        if ending:
            return point, ending
        point, matrix = search.curvature(point.free)
        ending = done(study, point, values, first, steps=_IDLE_STEPS)
        if ending or search.stopped:
            return point, ending or STOPPED
        step, damping = _trials(search, point, matrix, damping)
        if search.stopped:
            return step or point, STOPPED
        if step is None:
            return point, NO_STEP
        values.append(step.value)
        point = search.refreshed(step)


def _trials(search: Search, point: Point, matrix: np.ndarray, damping: float) -> tuple[Point | None, float]:
    """The first damped step that makes it better, and the damping to begin the next one with."""
    for _ in range(_TRIALS):
        trial, _ = search.plain(point.free + _step(matrix, point.gradient, damping))
        if trial.value < point.value:
            return trial, damping / _DAMPING_STEP
        if search.stopped:
            break
        damping *= _DAMPING_STEP
    return None, damping


def _step(matrix: np.ndarray, gradient: np.ndarray, damping: float) -> np.ndarray:
    """Marquardt's step (n,), no number of it beyond what its map can follow."""
    diagonal = np.diag(matrix)
    scaled = matrix + damping * np.diag(np.maximum(diagonal, _FLOOR * diagonal.max()))
    step = -np.linalg.lstsq(scaled, gradient, rcond=None)[0]
    return step * min(1.0, _LARGEST / max(np.abs(step).max(), 1e-300))

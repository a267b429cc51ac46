"""Reasons why searches end: the goal that they reached, or the cost that the study allows."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from optimize.designs import Point, Study

_IDLE_STEPS = 5
_ROOTS = 0.1  # of the tolerance: what the root of a sum of squares must gain, for below it the mesh decides
_SMALL_STEP = 0.04  # of every number of the search, a hundredth of the way between its bounds
_STEEP = 5.0  # times the tolerance, of the value or the root: where such a step promises more than this,
_LEFT = 0.1  # and of the first slope more than this is left, a search that stands still is at no optimum


class Ending(NamedTuple):
    """Reason why a search ended.

    Attributes:
        by: The reason in a word: the key of the study, or one of "no-step", "no-progress", "updates",
            "target", "failure", "caller", "interrupted".
        words: The reason in a sentence.
    """

    by: str
    words: str


NO_STEP = Ending("no-step", "no step along the search direction improves the objective")
STOPPED = Ending("caller", "stopped by the caller")
GOAL = Ending("goal", "the goal is reached")
LOCAL = ("gradient_tolerance", "no-progress", "no-step", "tolerance")  # endings at what may be a local optimum


class SpentError(Exception):
    """A limit of the study on the cost of the search is reached; holds the `Ending`."""

    def __init__(self, ending: Ending) -> None:
        """See the class."""
        super().__init__(ending.words)
        self.ending = ending


def check_convergence(
    study: Study, point: Point, values: list[float], first: Point, steps: int = _IDLE_STEPS
) -> Ending | None:
    """The reason why a search ends at a point, after steps with these values; None where it goes on.

    The last `steps` steps together must have reduced the value.
    """
    if reached := check_goal(study, point):
        return reached
    if not point.slope.any():
        words = "the gradient is zero: no number of the design changes the objective"
        if point.gradient.any():
            words = "every number of the design that has an effect is at a bound beyond which the objective improves"
        return Ending("gradient_tolerance", words)
    if float(np.linalg.norm(point.slope)) <= study.gradient_tolerance * float(np.linalg.norm(first.slope)):
        return Ending("gradient_tolerance", "the gradient is below its tolerance")
    if len(values) > steps and is_negligible(study, values[-1 - steps], values[-1]):
        return stagnation_ending(study, point, first)
    return None


def check_goal(study: Study, point: Point) -> Ending | None:
    """The reason why a design needs no search: it reaches the goal, or its deviations are below the tolerance."""
    if study.goal is not None:
        return GOAL if point.rank <= (0.0, study.goal) else None
    if _has_root(study) and point.objective <= study.tolerance**2:
        return Ending("target", f"the deviation is {study.tolerance:.2g} or less, below the resolution of a mesh")
    return None


def is_negligible(study: Study, before: float, after: float) -> bool:
    """True if the reduction from one value to another is negligible."""
    if before - after <= study.tolerance * abs(after):
        return True
    return _has_root(study) and before**0.5 - max(after, 0.0) ** 0.5 <= _ROOTS * study.tolerance


def predicted_gain(point: Point) -> float:
    """Predicted gain of a small step of all numbers down the slope."""
    return float(_SMALL_STEP * np.abs(point.slope).sum())


def stagnation_ending(study: Study, point: Point, first: Point, by: str = "tolerance") -> Ending:
    """The ending after steps without gain, or without a step that gains ("no-step").

    It is called an optimum only where the slope has vanished, or predicts no gain either.
    """
    left = _steepness(study, point) / max(_steepness(study, first), 1e-300)
    promised = point.value - predicted_gain(point) / _STEEP
    if left <= _LEFT or is_negligible(study, point.value, promised):
        return NO_STEP if by == NO_STEP.by else Ending("tolerance", "the last steps gained almost nothing")
    share = float(np.linalg.norm(point.slope)) / max(float(np.linalg.norm(first.slope)), 1e-300)
    what = "no step gains anything" if by == NO_STEP.by else "the last steps gained almost nothing"
    words = (
        f"{what}, although the gradient is still {100 * share:.0f} % of the first one: "
        "the objective is rough here, and this need not be the best design; try other starts (solver.starts)"
    )
    return Ending("no-progress", words)


def _has_root(study: Study) -> bool:
    """True if the value is a sum of squares, whose root says how far off a design is."""
    return study.objective.squares and not study.objective.constrained


def _steepness(study: Study, point: Point) -> float:
    """Norm of the slope, that of the root of a sum of squares: the slope of the sum itself vanishes with its value."""
    norm = float(np.linalg.norm(point.slope))
    return norm / max(point.value, 1e-300) ** 0.5 if _has_root(study) else norm


def budget_ending(study: Study, simulations: float, seconds: float) -> Ending | None:
    """The ending by the study's limit on simulations or on time [s]; None where neither is reached."""
    if study.max_simulations is not None and simulations > study.max_simulations:
        return Ending("max_simulations", f"the time of {study.max_simulations:g} simulations is spent")
    if study.minutes is not None and seconds >= 60.0 * study.minutes:
        return Ending("minutes", f"{study.minutes:g} minutes are over")
    return None

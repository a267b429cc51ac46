"""Why searches end: what they reached, or what the study allows them to cost."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from optimize.designs import Point, Study

_IDLE_STEPS = 5


class Ending(NamedTuple):
    """Why a search ended.

    Attributes:
        by: What ended it, a word: the key of the study that did, or one of "no-step", "no-progress", "updates",
            "failure", "caller", "interrupted".
        words: The same for people.
    """

    by: str
    words: str


NO_STEP = Ending("no-step", "no step along the search direction makes it better")
STOPPED = Ending("caller", "stopped by the caller")
GOAL = Ending("goal", "the goal is reached")


class SpentError(Exception):
    """A limit of the study on what the search may cost is reached; holds the `Ending`."""

    def __init__(self, ending: Ending) -> None:
        """See the class."""
        super().__init__(ending.words)
        self.ending = ending


def done(study: Study, point: Point, values: list[float], first: Point, steps: int = _IDLE_STEPS) -> Ending | None:
    """Why a search ends at a point, after steps with these values; None where it goes on.

    So many steps together must have brought something.
    """
    if study.goal is not None and point.rank <= (0.0, study.goal):
        return GOAL
    if float(np.linalg.norm(point.gradient)) <= study.gradient_tolerance * float(np.linalg.norm(first.gradient)):
        return Ending("gradient_tolerance", "the gradient is small enough")
    if len(values) > steps and values[-1 - steps] - values[-1] <= study.tolerance * abs(values[-1]):
        return Ending("tolerance", "the last steps brought next to nothing")
    return None


def spent(study: Study, simulations: float, seconds: float) -> Ending | None:
    """Why there is no more work, where it would cost so many simulations, or so many seconds have passed already."""
    if study.max_simulations is not None and simulations > study.max_simulations:
        return Ending("max_simulations", f"the time of {study.max_simulations:g} simulations is spent")
    if study.minutes is not None and seconds >= 60.0 * study.minutes:
        return Ending("minutes", f"{study.minutes:g} minutes are over")
    return None

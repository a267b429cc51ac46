"""Basin hopping (Wales and Doye, 1997): a search that ends in a local optimum begins again near its best design.

Contact makes an objective rough, with many local optima close together: a shift of a few per cent of the bounds is
enough to leave one. The next shift is from the best design of all, so that hops never make a search worse.
`scipy.optimize.basinhopping` shifts likewise, but cannot resume a killed search without repeating its simulations, and
counts a failed simulation as a value.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from optimize.designs import Point, Study
from optimize.search import Method, Search
from optimize.termination import GOAL, LOCAL, STOPPED, Ending, check_goal

_SHIFT = 0.16  # standard deviation of every number: 4 % of the way between its bounds
_LOCAL = ("iterations", *LOCAL)  # ends that a hop may mend


def hop(
    search: Search, study: Study, ending: Ending, method: Method, evaluate: Callable[[np.ndarray], Point]
) -> Ending:
    """Searches again by a method from shifted best designs until the goal or the number of hops is reached.

    Args:
        search: The search, after its first one has ended.
        study: The study; each hop has its number of iterations.
        ending: The reason for the first search's end.
        method: The method.
        evaluate: Evaluates the first design of a hop as the method needs it.

    Returns:
        The reason for the end of the last search, and the number of hops.
    """
    done = 0
    while done < study.hops and ending.by in _LOCAL and search.best is not None:
        done += 1
        shift = _SHIFT * np.random.default_rng(done).standard_normal(search.reach.size)
        search.memory, search.most_iterations = None, search.iteration + study.iterations
        point = evaluate(search.inside(search.best.free + shift))
        if search.stopped:
            return STOPPED
        if np.isfinite(point.value):
            ending = method(search, study, point)[1]
    if search.best is not None and check_goal(study, search.best) is not None and ending.by in _LOCAL:
        ending = GOAL
    return ending._replace(words=f"{ending.words}, after {done} hops") if done else ending

"""Basin hopping: searches again from shifted best designs, on a function with many wells whose values are known."""

import dataclasses
from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest

import jaxform
import optimize
from optimize.descent import lbfgs
from optimize.hopping import hop
from optimize.search import Search
from optimize.termination import Ending
from tests.optimize.test_optimize import study_of_hidden_profile

WIDTH = 0.5  # of a well: three shifts


class _Wells(Search):
    """A parabola around 1 with cosines on it, in place of simulations; the least value is 0."""

    def compute(self, free: np.ndarray) -> Any:
        from_best, turn = free - 1.0, 2.0 * np.pi / WIDTH
        value = np.sum(from_best**2 + 0.1 * (1.0 - np.cos(turn * from_best)))
        slope = 2.0 * from_best + 0.1 * turn * np.sin(turn * from_best)
        names = ("error", "least", "mean", "variation", "mass")
        report = {"objective": jnp.asarray(value), "status": jnp.asarray(0)} | dict.fromkeys(names, jnp.asarray(0.0))
        return (jnp.asarray(value), report), jnp.asarray(slope)


def _search(study: optimize.Study) -> tuple[Search, Ending]:
    search = _Wells(study, None, 1.0)
    first = search(np.full(search.reach.size, -1.4))
    ending = lbfgs(search, study, first)[1]
    return search, hop(search, study, ending, lbfgs, search)


def _study(**options: Any) -> optimize.Study:
    return dataclasses.replace(study_of_hidden_profile(), **options)


def test_hops_leave_local_optima_until_the_goal() -> None:
    alone, ending = _search(_study())
    assert ending.by != "goal" and alone.best is not None and alone.best.objective > 0.5
    far, ending = _search(_study(hops=200, goal=0.3))
    assert far.best is not None and far.best.objective <= 0.3
    assert ending.by == "goal" and "hops" in ending.words
    # No more hops than the goal needs, and the first search is that without hops.
    values = [row["objective"] for row in far.history]
    assert sum(value <= 0.3 for value in values) == 1
    assert values[: len(alone.history)] == [row["objective"] for row in alone.history]
    assert [row["objective"] for row in _search(_study(hops=200, goal=0.3))[0].history] == values


def test_hops_end_with_their_number_and_make_nothing_worse() -> None:
    alone, _ = _search(_study())
    few, ending = _search(_study(hops=3, goal=1e-9))
    assert alone.best is not None and few.best is not None and few.best.objective <= alone.best.objective
    assert ending.by != "goal" and ending.words.endswith("after 3 hops")


def test_a_search_at_its_goal_does_not_hop() -> None:
    alone, _ = _search(_study(goal=100.0))
    hopping, ending = _search(_study(goal=100.0, hops=5))
    assert ending.by == "goal" and len(hopping.history) == len(alone.history)


@pytest.mark.parametrize("wrong", ["limits", "fixed-point"])
def test_what_hops_cannot_be_combined_with(wrong: str) -> None:
    study = _study(hops=2)
    if wrong == "limits":
        changes: dict[str, Any] = {"objective": optimize.LeastMass(study.scene, 1e-3)}
    else:
        changes = {"method": "fixed-point", "warm_start": None}
    with pytest.raises(jaxform.InputError, match=r"solver.hops = 2.*leave them out"):
        optimize.solve(dataclasses.replace(study, **changes))

"""The comparison of searches, in small: the curves are what was tried, and the page says what they say."""

from __future__ import annotations

import importlib.util
from pathlib import Path

import numpy as np
import pytest

from benchmarks.design import figures, page
from tests.optimize.test_optimize import study_of_hidden_profile

BUDGET = 12


def _case() -> figures.Case:
    """That of the tests of `optimize`, whose programs it then has."""
    study = study_of_hidden_profile()
    own = {
        "least squares": {"method": "least-squares", "iterations": 2},
        "fixed point": {"method": "fixed-point", "iterations": 3},
    }
    return figures.Case("a cup", "deviation, rms [%]", study, figures.deviation, own)


@pytest.mark.long
def test_searches_are_compared_from_the_same_start_and_the_page_says_so(tmp_path: Path) -> None:
    others = ["Nelder-Mead", "random search"] + ["CMA-ES"] * (importlib.util.find_spec("cma") is not None)
    found = figures.compare(_case(), BUDGET, tuple(others))
    curves = found["curves"]
    assert set(curves) == {"least squares", "fixed point", *others} and found["variables"] == 4
    for name, curve in curves.items():
        costs, merits = np.array(curve).T
        assert np.all(np.diff(costs) > 0) and np.all(np.diff(merits) < 0)
        assert name in ("least squares", "fixed point") or costs[-1] <= BUDGET
        if name != "CMA-ES":  # which never tries its start itself
            np.testing.assert_allclose(merits[0], curves["fixed point"][0][1], rtol=1e-9)
    assert curves["least squares"][-1][1] < curves["random search"][-1][1]
    page.write({"searches": {"cup": found}}, tmp_path)
    text = (tmp_path / "design.md").read_text()
    assert f"{curves['Nelder-Mead'][-1][1]:.4g}" in text and "a cup (4 variables)" in text
    assert (tmp_path / "search.png").stat().st_size > 10_000


def test_when_a_ramp_comes_to_the_same_deviation() -> None:
    rows = [{"units": units, "error": 0.2 / units} for units in (1.0, 2.0, 4.0, 8.0)]
    np.testing.assert_allclose(page.equal_deviation(rows, 0.04), 5.0, rtol=1e-12)
    assert np.isnan(page.equal_deviation(rows, 0.001))


def test_only_new_bests_are_kept() -> None:
    tried = [(1.0, 5.0), (2.0, 6.0), (3.0, np.inf), (4.0, 4.0), (5.0, 4.0)]
    assert figures.best_so_far(tried) == [[1.0, 5.0], [4.0, 4.0]]


@pytest.mark.parametrize(("least", "expected"), [(0.3e-4, 4.0), (0.6e-4, 2.0), (0.9e-4, 2.0)])
def test_mass_is_told_at_the_minimum_wall(least: float, expected: float) -> None:
    np.testing.assert_allclose(figures.equal_mass({"mass": 2e-3, "wall_min": least}), expected, rtol=1e-12)

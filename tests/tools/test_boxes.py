"""Triangles that may meet, against every pair."""

from __future__ import annotations

import numpy as np
import pytest

from jaxform.tools import crossings, penetration
from jaxform.tools.crossings import intersect


def _triangles(seed: int, count: int, finest: float) -> np.ndarray:
    """Random triangles in a room of 1, of sizes that differ as those of a refined mesh; a few are points or lines."""
    draw = np.random.default_rng(seed)
    size = 0.3 * finest ** draw.random(count)
    corners = draw.random((count, 1, 3)) + size[:, None, None] * draw.standard_normal((count, 3, 3))
    corners[0] = corners[0, 0]
    corners[1, 2] = corners[1, 1]
    return corners


@pytest.mark.parametrize("finest", [1.0, 1e-2, 1e-4])
@pytest.mark.parametrize("chunk", [50, 1_000_000])
def test_all_that_meet_are_found_and_none_whose_boxes_are_apart(
    monkeypatch: pytest.MonkeyPatch, finest: float, chunk: int
) -> None:
    monkeypatch.setattr(crossings, "_CHUNK", chunk)
    one, other = _triangles(1, 80, finest), _triangles(2, 150, finest)
    first, second = (grid.ravel() for grid in np.indices((80, 150)))
    meet, over = (np.zeros((80, 150), bool) for _ in range(2))
    meet[first, second] = intersect(one[first], other[second])
    over[...] = ((one.min(1)[:, None] <= other.max(1)) & (one.max(1)[:, None] >= other.min(1))).all(2)
    found = np.zeros((80, 150), bool)
    for pair in penetration.overlapping_pairs(one, other):
        found[pair] = True
    assert meet.any() and not (meet & ~found).any() and not (found & ~over).any()


def test_one_that_ran_away_is_not_cut_where_the_others_are_not() -> None:
    one = _triangles(1, 20, 1.0)
    away = np.array([[[0.5, 0.5, 0.0], [1e6, 0.0, 1e6], [0.5, 0.5, 1.0]]])
    assert {int(other) for part in penetration.overlapping_pairs(one, away) for other in part[1]} == {0}


def test_sets_apart_have_none() -> None:
    one = _triangles(1, 20, 1.0)
    assert not list(penetration.overlapping_pairs(one, one + 10.0))

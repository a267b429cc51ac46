"""Places where a sheet passes through itself, against every pair of elements."""

from __future__ import annotations

import itertools

import numpy as np

from jaxform import shapes
from jaxform.tools.crossings import intersect
from jaxform.tools.penetration import self_intersecting_elements

SHEET = shapes.rectangle(size=(2.0, 1.0), element_size=0.15)


def _fold(slope: float) -> np.ndarray:
    """The sheet with its right half turned back over the left one, rising from 0.2 above it by a slope."""
    x, y, _ = SHEET.positions.T
    back = np.minimum(x, 2.0 - x)
    return np.stack([back, y + 0.013 * (x > 1.0), np.where(x > 1.0, 0.2 + slope * (x - 1.0), 0.0)], axis=1)


def test_a_sheet_that_is_folded_through_itself() -> None:
    positions, triangles = _fold(-0.37), SHEET.triangles
    pairs = np.asarray(list(itertools.combinations(range(len(triangles)), 2)))
    shared = (triangles[pairs[:, 0]][:, :, None] == triangles[pairs[:, 1]][:, None, :]).any((1, 2))
    one, other = pairs[~shared].T
    cut = intersect(positions[triangles[one]], positions[triangles[other]])
    expected = set(one[cut]) | set(other[cut])
    everything = np.arange(len(triangles))
    assert len(expected) > 10
    assert set(self_intersecting_elements(positions, triangles, everything)) == expected
    some = everything[::-3]
    assert list(self_intersecting_elements(positions, triangles, some)) == sorted(expected & set(some))
    assert not len(self_intersecting_elements(positions, triangles, some[:0]))


def test_a_sheet_that_lies_over_itself_does_not_pass_through() -> None:
    everything = np.arange(len(SHEET.triangles))
    for positions in (SHEET.positions, _fold(0.37), _fold(0.0)):
        assert not len(self_intersecting_elements(np.asarray(positions), SHEET.triangles, everything))

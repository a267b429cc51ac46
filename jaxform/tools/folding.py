"""Self-intersection of a sheet: the method has no contact of a sheet with itself. On the host."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from jaxform.tools.boxes import overlapping_pairs
from jaxform.tools.crossings import all_columns, intersect

Array = NDArray[np.float64]
Integers = NDArray[np.integer]

_FIRST = 300  # elements that are checked first
_MOST_PAIRS = 600_000  # of these and others, from which the rest is not checked


def self_intersecting_elements(positions: Array, triangles: Integers, asked: Integers) -> NDArray[np.int64]:
    """Those of the given elements that are cut by one that shares no node with them, in order.

    Args:
        positions: Node positions (n_node, 3) [m].
        triangles: Their elements (n_element, 3).
        asked: Numbers of those elements (n,), the most doubtful first: where they meet very many others, these alone
            are checked.
    """
    asked, corners = np.asarray(asked, np.int64), positions[triangles]
    if not len(asked) or _faces_one_way(corners):
        return asked[:0]
    found, pairs = _intersected_elements(corners, triangles, asked[:_FIRST])
    # In a sheet that burst, each element meets a thousand others: then the first ones suffice.
    if len(asked) > _FIRST and pairs <= _MOST_PAIRS:
        found = np.union1d(found, _intersected_elements(corners, triangles, asked[_FIRST:])[0])
    return found


def _intersected_elements(
    corners: Array, triangles: Integers, asked: NDArray[np.int64]
) -> tuple[NDArray[np.int64], int]:
    """The asked elements that others, with corners (n_element, 3, 3) [m], cut, and the number of compared pairs."""
    found, pairs = [], 0
    for place, other in overlapping_pairs(corners[asked], corners):
        pairs += len(place)
        one = asked[place]
        apart = all_columns((triangles[one][:, :, None] != triangles[other][:, None, :]).reshape(-1, 9))
        one, other = one[apart], other[apart]
        found.append(one[intersect(corners[one], corners[other])])
    return np.unique(np.concatenate([asked[:0], *found])).astype(np.int64), pairs


def _faces_one_way(corners: Array) -> bool:
    """True when all elements (n, 3, 3) [m] show their front to one side: then none hides another."""
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    return bool((normal @ normal.sum(0) > 0).all())

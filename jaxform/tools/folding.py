"""Where a sheet passes through itself: the method has no contact of a sheet with itself. On the host."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from jaxform.tools.crossings import intersect, near_pairs
from jaxform.tools.search import build_grid

Array = NDArray[np.float64]
Integers = NDArray[np.integer]


def through_itself(positions: Array, triangles: Integers, free: NDArray[np.bool_]) -> NDArray[np.int64]:
    """The free elements that another element cuts which shares no node with them.

    Args:
        positions: Of the nodes (n_node, 3) [m].
        triangles: Their elements (n_element, 3).
        free: The elements (n_element,) that are asked about.
    """
    asked = np.flatnonzero(free)
    corners = positions[triangles]
    if not len(asked):
        return asked
    low, high = corners[asked].min((0, 1)), corners[asked].max((0, 1))
    near = np.flatnonzero(((corners.min(1) <= high) & (corners.max(1) >= low)).all(1))
    grid = build_grid(positions, triangles[near])
    found = []
    for piece, place in near_pairs(corners[asked], corners[near], grid):
        one, other = asked[piece], near[place]
        apart = ~(triangles[one][:, :, None] == triangles[other][:, None, :]).any((1, 2))
        one, other = one[apart], other[apart]
        found.append(one[intersect(corners[one], corners[other])])
    return np.unique(np.concatenate(found)) if found else asked[:0]

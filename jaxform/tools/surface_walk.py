"""Motion of nodes along a triangulated surface: from triangle to triangle, never off it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def signed_neighbors(triangles: NDArray[np.integer]) -> NDArray[np.int32]:
    """The triangles (n_triangle, 3) beside each side of a triangle, counted from 1; 0 where there is none.

    Side k goes from corner k to the next one. A neighbor whose corners turn the other way round is negative. Where
    more than two triangles meet, a side has no neighbor: a node that slides there leaves the surface.
    """
    count = len(triangles)
    begin, end = triangles.ravel(), np.roll(triangles, -1, axis=1).ravel()
    low, high = np.minimum(begin, end).astype(np.int64), np.maximum(begin, end).astype(np.int64)
    key = low * (int(triangles.max()) + 1) + high
    _, place, each = np.unique(key, return_inverse=True, return_counts=True)
    order = np.argsort(place, kind="stable")
    first = np.concatenate([[0], np.cumsum(each)[:-1]])[each == 2]
    one, other = order[first], order[first + 1]
    sign = np.where(begin[one] == begin[other], -1, 1)
    found = np.zeros(3 * count, np.int32)
    found[one], found[other] = sign * (other // 3 + 1), sign * (one // 3 + 1)
    return found.reshape(count, 3)

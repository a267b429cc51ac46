"""Where a sheet passes through itself: the method has no contact of a sheet with itself. On the host."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from jaxform.tools.boxes import overlapping
from jaxform.tools.crossings import every, intersect

Array = NDArray[np.float64]
Integers = NDArray[np.integer]


def through_itself(positions: Array, triangles: Integers, asked: Integers) -> NDArray[np.int64]:
    """Which of some elements another one cuts that shares no node with them, in order.

    Args:
        positions: Of the nodes (n_node, 3) [m].
        triangles: Their elements (n_element, 3).
        asked: Numbers of those elements (n,).
    """
    asked, corners = np.asarray(asked, np.int64), positions[triangles]
    if not len(asked) or _faces_one_way(corners):
        return asked[:0]
    found = []
    for place, other in overlapping(corners[asked], corners):
        one = asked[place]
        apart = every((triangles[one][:, :, None] != triangles[other][:, None, :]).reshape(-1, 9))
        one, other = one[apart], other[apart]
        found.append(one[intersect(corners[one], corners[other])])
    return np.unique(np.concatenate(found))


def _faces_one_way(corners: Array) -> bool:
    """Whether all elements (n, 3, 3) [m] are seen from their front, from one side: then none hides another."""
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    return bool((normal @ normal.sum(0) > 0).all())

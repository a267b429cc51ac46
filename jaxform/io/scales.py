"""Ranges of colours for many numbers, and the points that the eye tells apart, for pictures and the report."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

_FINENESS = 500  # points that the eye tells apart along a side of a diagram
_MOVED = 0.02  # of the farthest way an element went: one that went less was not formed
_MOST = 0.98  # of the formed area, the colours tell apart; the thickest have one colour


def formed_elements(start: Array, end: Array, triangles: NDArray[np.integer]) -> NDArray[np.bool_]:
    """Mask of the elements (n,) that were formed, unlike a flange that stayed flat; all where none moved.

    Args:
        start: Initial positions (n_node, 3) [m].
        end: Final positions (n_node, 3) [m].
        triangles: Node numbers of the elements (n, 3).
    """
    way = np.linalg.norm((end - start)[triangles].mean(1), axis=1)
    moved = way >= _MOVED * way.max(initial=0.0)
    return moved | (not moved.any())


def counted_elements(
    start: Array, end: Array, triangles: NDArray[np.integer], part: NDArray[Any] | None
) -> NDArray[np.bool_]:
    """Mask like `formed_elements`, within a part's mask (n,) if given; the whole part where none of it moved."""
    formed = formed_elements(start, end, triangles)
    if part is None or not np.any(part):
        return formed
    own = np.asarray(part) != 0
    return formed & own if (formed & own).any() else own


def color_range(values: Array, area: Array, most: float = _MOST) -> tuple[float, float]:
    """Range that colours show, of values (n,) and their areas: from the least to one that most of the area is below."""
    order = np.argsort(values)
    share = np.cumsum(area[order]) / area.sum()
    last = min(int(np.searchsorted(share, most)), len(values) - 1)
    low, high = float(values.min()), float(values[order[last]])
    room = 0.05 * max(abs(low), abs(high))
    return (low, high) if high - low > 0.02 * room else (low - room, high + room)


def distinguishable_points(across: Array, up: Array) -> NDArray[np.int64]:
    """Indices of the points to draw, out of many: one in each place that the eye can distinguish."""
    cells = [np.round(_FINENESS * (x - x.min()) / (np.ptp(x) or 1.0)).astype(np.int64) for x in (across, up)]
    return np.unique(cells[0] * (_FINENESS + 1) + cells[1], return_index=True)[1]

"""Self-intersection of a sheet: the method has no contact of a sheet with itself. On the host."""

from __future__ import annotations

import functools
from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from jaxform.tools.crossings import all_columns, bounding_boxes, expand_ranges, intersect, short_pieces

Array = NDArray[np.float64]
Integers = NDArray[np.integer]

# Pairs of triangles of two sets that may meet, found by cells that are made for one search. On the host.

_WIDE = 2.0  # cells, in boxes: most triangles then need not be cut


def _cells_of_boxes(low: Array, high: Array, corner: Array, width: float, shape: Integers) -> tuple[Integers, Integers]:
    """Cells (n_entry,), ascending, and the boxes (n_entry,) in them, which are no wider than a cell.

    Args:
        low: Lowest corners of the boxes (n, 3) [m].
        high: Highest corners of the boxes (n, 3) [m].
        corner: Lowest corner of the first cell (3,) [m].
        width: Width of the cells [m].
        shape: Number of cells along each axis (3,).
    """
    first, last = (np.floor((end - corner) / width).astype(np.int64) for end in (low, high))
    found = []
    # Each box is in at most two cells along each axis.
    for step in np.ndindex(2, 2, 2):
        index = first + step
        piece = np.flatnonzero(all_columns(index <= last))
        found.append((np.ravel_multi_index(tuple(index[piece].T), tuple(shape)), piece))
    cell, piece = (np.concatenate(parts) for parts in zip(*found, strict=True))
    order = np.argsort(cell, kind="stable")
    return cell[order], piece[order]


def overlapping_pairs(one: Array, other: Array) -> Iterator[tuple[Integers, Integers]]:
    """Numbers of triangles (n, 3, 3) [m] and of others (m, 3, 3) that may meet, part by part; the first are not empty.

    Large ones are cut into pieces: each pair that has pieces with boxes that overlap comes at least once. The width of
    the cells follows the mean of the logarithms of the first set's boxes: then neither the pieces of the large ones nor
    the small ones in a cell are many.
    """
    low, high = bounding_boxes(one)
    extent = functools.reduce(np.maximum, (high - low).T)
    width = _WIDE * float(np.exp(np.log(np.maximum(extent, 1e-3 * extent.max())).mean()))
    box = low.min(0), high.max(0)
    (pieces, owner), (other_pieces, other_owner) = (short_pieces(corners, width, *box) for corners in (one, other))
    if not len(other_owner):
        return
    (low, high), (other_low, other_high) = bounding_boxes(pieces), bounding_boxes(other_pieces)
    corner = np.minimum(low.min(0), other_low.min(0))
    shape = np.max([np.floor((top - corner) / width).max(0) for top in (high, other_high)], axis=0) + 2
    cells = corner, width, shape.astype(np.int64)
    cell, mine = _cells_of_boxes(low, high, *cells)
    other_cell, theirs = _cells_of_boxes(other_low, other_high, *cells)
    begin, end = (np.searchsorted(other_cell, cell, side) for side in ("left", "right"))
    for row, place in expand_ranges(begin, end):
        first, second = mine[row], theirs[place]
        for axis in range(3):
            over = low[first, axis] <= other_high[second, axis]
            over &= high[first, axis] >= other_low[second, axis]
            first, second = first[over], second[over]
        yield owner[first], other_owner[second]


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

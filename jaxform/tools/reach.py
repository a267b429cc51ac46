"""Pairs of a uniform grid's cells and the triangles in their reach. On the host, in NumPy, vectorized.

A triangle is taken apart into lines of cells: layer by layer along one axis, line by line along another, and along the
third its plane says between which cells it is in reach. So a long sliver, an oblique plane and a small triangle are all
compared with little more than the cells that do list them.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from jaxform.mesh.rows import positions_in_rows

Array = NDArray[np.float64]
Integers = NDArray[np.int64]

HALF_DIAGONAL = np.sqrt(0.75)  # of a cell of width 1
_CHUNK = 40_000  # pairs of cell and triangle processed together: what a core's cache holds
_LINES = 100_000  # lines of cells laid out together
_ROUNDING = 1e-5  # of a cell, by which a triangle counts as nearer than it is


class CellFrame(NamedTuple):
    """The cells: lowest corner (3,) [m], width [m], reach [m], number along x, y, z (3,)."""

    corner: Array
    width: float
    reach: float
    shape: Integers


class CellTrianglePairs(NamedTuple):
    """Pairs of a cell and a triangle that is in its reach.

    Attributes:
        cell: Numbers (n,).
        triangle: Numbers (n,), ascending.
        distance: Distance of the cell's middle from the triangle (n,) [m].
    """

    cell: Integers
    triangle: Integers
    distance: Array


class _Local(NamedTuple):
    """Triangles in units of cells, whose middles have whole numbers, each with its axes in an order of its own.

    The first axis is that of the layers, the second that of the lines, and along the third the normal is longest.

    Attributes:
        corners: By corner and axis, (3, 3) arrays (n,).
        plane: The unit normal's components and the place of the plane along it, 4 arrays (n,).
        shape: Number of cells along each axis, 3 arrays (n,).
        strides: Increment of a cell's number in a step along each axis, 3 arrays (n,).
    """

    corners: list[list[Array]]
    plane: list[Array]
    shape: list[Integers]
    strides: list[Integers]


def pairs_in_reach(corners: Array, frame: CellFrame) -> CellTrianglePairs:
    """All pairs of a cell and a triangle (n, 3, 3) [m] that is no farther from any place in the cell than the reach."""
    far = (frame.reach / frame.width) + HALF_DIAGONAL + _ROUNDING
    parts = np.array_split(np.arange(len(corners)), 1 + len(corners) // 20_000 + (os.cpu_count() or 1))

    def pairs(part: Integers) -> CellTrianglePairs:
        local = _local(corners[part], frame)
        found = [_pairs_of(local, *lines, far) for lines in _lines(local, far)]
        found = found or [CellTrianglePairs(part[:0], part[:0], np.zeros(0))]
        cell, triangle, distance = (np.concatenate(values) for values in zip(*found, strict=True))
        return CellTrianglePairs(cell, part[triangle], distance * frame.width)

    # NumPy lets go of the interpreter's lock in long operations.
    with ThreadPoolExecutor(os.cpu_count()) as workers:
        found = list(workers.map(pairs, [part for part in parts if len(part)]))
    return CellTrianglePairs(*(np.concatenate(values) for values in zip(*found, strict=True)))


def _local(corners: Array, frame: CellFrame) -> _Local:
    places = (corners - frame.corner) / frame.width - 0.5
    steepest = np.argmax(np.abs(np.cross(places[:, 1] - places[:, 0], places[:, 2] - places[:, 0])), axis=1)
    extent = np.ptp(places, axis=1)
    # Of the two other axes, the layers are along the one that the triangle is longer along.
    one, other = (steepest + 1) % 3, (steepest + 2) % 3
    row = np.arange(len(places))
    turn = extent[row, one] < extent[row, other]
    order = np.stack([np.where(turn, other, one), np.where(turn, one, other), steepest], axis=1)
    places = np.take_along_axis(places, order[:, None, :], axis=2)
    # Anew, for an order of axes may turn its sign.
    normal = np.cross(places[:, 1] - places[:, 0], places[:, 2] - places[:, 0])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    shape = np.asarray(frame.shape, np.int64)
    strides = np.array([shape[1] * shape[2], shape[2], 1])
    return _Local(
        [[np.ascontiguousarray(places[:, k, axis]) for axis in range(3)] for k in range(3)],
        [*normal.T, np.einsum("ij,ij->i", normal, places[:, 0])],
        list(shape[order].T),
        list(strides[order].T),
    )


def _lines(local: _Local, far: float) -> Iterator[tuple[Integers, Integers, Integers]]:
    """Lines of cells that may be in reach: triangle, layer and line, part by part, in the triangles' order."""
    along = np.stack([corner[0] for corner in local.corners])
    first, count = _cells_between(along.min(0), along.max(0), far, local.shape[0])
    for part in _parts(count, _LINES):
        triangle = np.repeat(part, count[part])
        layer = first[triangle] + positions_in_rows(count[part])
        low, high = _within_layer(local, triangle, layer, far)
        begin, lines = _cells_between(low, high, far, local.shape[1][triangle])
        yield np.repeat(triangle, lines), np.repeat(layer, lines), np.repeat(begin, lines) + positions_in_rows(lines)


def _within_layer(local: _Local, triangle: Integers, layer: Integers, far: float) -> tuple[Array, Array]:
    """Intervals (n,), (n,) of triangles along the second axis, as far as they are in reach of a layer's middle."""
    low, high = np.full(len(layer), np.inf), np.full(len(layer), -np.inf)
    for k in range(3):
        begin, end = local.corners[k], local.corners[(k + 1) % 3]
        one, rise = begin[0][triangle] - layer, (end[0] - begin[0])[triangle]
        with np.errstate(divide="ignore", invalid="ignore"):
            enter, leave = (-far - one) / rise, (far - one) / rise
        level = rise == 0
        enter, leave = np.minimum(enter, leave), np.maximum(enter, leave)
        enter = np.where(level, 0.0, np.maximum(enter, 0.0))
        leave = np.where(level, np.where(np.abs(one) <= far, 1.0, -1.0), np.minimum(leave, 1.0))
        for share in (enter, leave):
            place = begin[1][triangle] + share * (end[1] - begin[1])[triangle]
            low = np.where(enter <= leave, np.minimum(low, place), low)
            high = np.where(enter <= leave, np.maximum(high, place), high)
    return low, high


def _cells_between(low: Array, high: Array, far: float, shape: Integers) -> tuple[Integers, Integers]:
    """The first cell (n,) whose middle is that near to an interval, and how many there are (n,)."""
    some = low <= high
    first = np.maximum(np.ceil(np.where(some, low, 0.0) - far), 0.0).astype(np.int64)
    last = np.minimum(np.floor(np.where(some, high, -2.0) + far), shape - 1).astype(np.int64)
    return first, np.where(some, np.maximum(last - first + 1, 0), 0)


def _pairs_of(local: _Local, triangle: Integers, layer: Integers, line: Integers, far: float) -> CellTrianglePairs:
    """The cells of lines (n,) that are in reach; distances are in cells."""
    one, two, three, level = (values[triangle] for values in local.plane)
    middle, wide = (level - one * layer - two * line) / three, far / np.abs(three)
    third = np.stack([corner[2] for corner in local.corners])
    low = np.maximum(middle - wide, third.min(0)[triangle] - far)
    high = np.minimum(middle + wide, third.max(0)[triangle] + far)
    first, count = _cells_between(low, high, 0.0, local.shape[2][triangle])
    found = []
    for part in _parts(count, _CHUNK):
        row = np.repeat(part, count[part])
        owner, cell = triangle[row], first[row] + positions_in_rows(count[part])
        distance = _distances(local, owner, layer[row], line[row], cell)
        near = np.flatnonzero(distance <= far)
        owner, row = owner[near], row[near]
        strides = [stride[owner] for stride in local.strides]
        number = layer[row] * strides[0] + line[row] * strides[1] + cell[near] * strides[2]
        found.append(CellTrianglePairs(number, owner, distance[near]))
    none = np.zeros(0, np.int64)
    return (
        CellTrianglePairs(*map(np.concatenate, zip(*found, strict=True)))
        if found
        else CellTrianglePairs(none, none, np.zeros(0))
    )


def _parts(count: Integers, most: int) -> list[Integers]:
    """Rows with entries, in parts of about so many entries."""
    some = np.flatnonzero(count)
    total = np.cumsum(count[some])
    cuts = np.searchsorted(total, np.arange(most, total[-1] if len(total) else 0, most)) + 1
    return [part for part in np.split(some, cuts) if len(part)]


def _distances(local: _Local, triangle: Integers, *middle: Integers) -> Array:
    """Distances (n,) of middles of cells, 3 arrays (n,), from triangles (n,), a little less than they are."""
    corners = [[values[triangle] for values in corner] for corner in local.corners]
    away = [[place - value for place, value in zip(middle, corner, strict=True)] for corner in corners]
    normal = [values[triangle] for values in local.plane[:3]]
    inside = np.ones(len(triangle), bool)
    square = np.full(len(triangle), np.inf)
    for k in range(3):
        side = [end - begin for begin, end in zip(corners[k], corners[(k + 1) % 3], strict=True)]
        begin = away[k]
        inside &= _dot(_cross(side, begin), normal) >= 0
        share = np.clip(_dot(begin, side) / _dot(side, side), 0.0, 1.0)
        gap = [value - share * along for value, along in zip(begin, side, strict=True)]
        square = np.minimum(square, _dot(gap, gap))
    return np.where(inside, np.abs(_dot(away[0], normal)), np.sqrt(square)) - _ROUNDING


def _dot(one: list[Array], other: list[Array]) -> Array:
    return one[0] * other[0] + one[1] * other[1] + one[2] * other[2]


def _cross(one: list[Array], other: list[Array]) -> list[Array]:
    return [one[(k + 1) % 3] * other[(k + 2) % 3] - one[(k + 2) % 3] * other[(k + 1) % 3] for k in range(3)]

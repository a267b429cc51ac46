"""Ribs and pins of a mold that stand between the nodes of a sheet, so that it passed through them. On the host.

Nodes alone meet the mold. Between two that stick to it, or that are held, the side of an element enters what is thinner
than it is and leaves it again; a pin comes through an element's middle. A convex edge of the mold is cut in the same
way, but less than it is wide: of a rib the mold stands higher above the sheet than it is wide where it is crossed.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from jaxform.mesh.rows import distinct_rows
from jaxform.tools.crossings import crosses, near_pairs
from jaxform.tools.search import SearchGrid
from jaxform.tools.sides import Ways

Array = NDArray[np.float64]
Integers = NDArray[np.integer]

_SLENDER = 0.75  # times as high as it is wide where it is crossed, a rib is; a right-angled edge is half as high
_FACING = -0.4  # the cosine between the normals of both sides of a rib at most: of an edge as slender as that
_SAME = 1e-6  # of a side: crossings as near as that are one, at an edge that two triangles share
_MOST = 4000  # places that are examined, evenly over all
_UPWARDS = 0.2  # the cosine that the way along a rib has with the way off the mold


class Ribs(NamedTuple):
    """Ribs and pins that a sheet passed through.

    Attributes:
        count: Number of places, which are sides of elements or elements.
        height: Height of the highest above the sheet [m].
        width: Width of that one where it is crossed [m].
        place: Place of that crossing (3,) [m].
    """

    count: int
    height: float
    width: float
    place: Array


NO_RIBS = Ribs(0, 0.0, 0.0, np.zeros(3))
"""The value for a sheet that passed through none."""


class _Spots(NamedTuple):
    """Places inside what a sheet passed through (n, 3) [m], how wide it is (n,) [m], and the way up along it (n, 3)."""

    place: Array
    width: Array
    way: Array


def find_ribs(
    positions: Array, away: Array, sticking: NDArray[np.bool_], ways: Ways, mold_corners: Array, grid: SearchGrid
) -> Ribs:
    """The ribs and pins that a sheet passed through.

    Args:
        positions: Node positions (n_node, 3) [m], lifted off the mold.
        away: Unit vectors off the mold (n_node, 3), of nodes that stick to it or are held.
        sticking: Mask (n_node,) of these nodes.
        ways: Inside the elements that the mold cuts.
        mold_corners: Corners of the mold's triangles (n_triangle, 3, 3) [m].
        grid: The mold's search structure.
    """
    row, triangle = ways.pairs()
    held = sticking[ways.triangles].all(1)[row]
    row, triangle = row[held], triangle[held]
    sides, crossed = _between_crossings(positions, away, ways.triangles[row], triangle, mold_corners)
    whole = ~np.isin(row, row[crossed])
    pins = _through_faces(positions, away, ways.triangles[row[whole]], row[whole], triangle[whole], mold_corners)
    spots = _Spots(*(np.concatenate(parts) for parts in zip(sides, pins, strict=True)))
    step = 1 + len(spots.place) // _MOST
    spots = _Spots(*(values[::step] for values in spots))
    if not len(spots.place):
        return NO_RIBS
    height = _heights(spots, mold_corners, grid)
    slender = np.flatnonzero(height > _SLENDER * spots.width)
    if not len(slender):
        return NO_RIBS
    highest = slender[np.argmax(height[slender])]
    width = float(spots.width[highest])
    return Ribs(step * len(slender), float(height[highest]), width, spots.place[highest])


def _between_crossings(
    positions: Array, away: Array, nodes: Integers, triangle: Integers, mold_corners: Array
) -> tuple[_Spots, Integers]:
    """Places between where sides of elements, nodes (n, 3), enter and leave the mold, and which pairs are crossed."""
    ends = np.concatenate([np.sort(nodes[:, [k, (k + 1) % 3]], axis=1) for k in range(3)])
    pair = np.tile(np.arange(len(nodes)), 3)
    met = crosses(positions[ends[:, 0]], positions[ends[:, 1]], mold_corners[triangle[pair]])
    crossed = np.unique(pair[met])
    rows = distinct_rows(np.column_stack([ends[met], triangle[pair[met]]])).rows
    begin, end, normal = positions[rows[:, 0]], positions[rows[:, 1]], _normals(mold_corners[rows[:, 2]])
    slope = np.einsum("ij,ij->i", end - begin, normal)
    share = np.einsum("ij,ij->i", mold_corners[rows[:, 2], 0] - begin, normal) / np.where(slope == 0, 1.0, slope)
    order = np.lexsort((share, rows[:, 1], rows[:, 0]))
    rows, share, normal = rows[order], share[order], normal[order]
    same = np.zeros(len(rows), bool)
    same[1:] = (rows[1:, :2] == rows[:-1, :2]).all(1) & (np.diff(share) <= _SAME)
    rows, share, normal = rows[~same], share[~same], normal[~same]
    found = distinct_rows(rows[:, :2])
    even = found.count % 2 == 0
    # In order along each side: it is in the mold between the first and the second, the third and the fourth.
    number = np.arange(len(rows)) - np.repeat(np.cumsum(found.count) - found.count, found.count)
    enter = np.flatnonzero(np.repeat(even, found.count) & (number % 2 == 0))
    enter = enter[_faces_opposite(positions, rows, normal, enter)]
    begin, end = positions[rows[enter, 0]], positions[rows[enter, 1]]
    middle = 0.5 * (share[enter] + share[enter + 1])
    width = (share[enter + 1] - share[enter]) * np.linalg.norm(end - begin, axis=1)
    off = away[rows[enter, 0]] + away[rows[enter, 1]]
    way = _directions_along(off, normal[enter]) + _directions_along(off, normal[enter + 1])
    return _escaping_spots(begin + middle[:, None] * (end - begin), width, way, off), crossed


def _faces_opposite(positions: Array, rows: Integers, normal: Array, enter: Integers) -> NDArray[np.bool_]:
    """True where the surfaces by which sides enter and leave the mold (n,) face opposite ways, as those of a rib do.

    A side also cuts the corner of a wide feature, between two surfaces that face sideways.
    """
    along = positions[rows[enter, 1]] - positions[rows[enter, 0]]
    inwards, outwards = (np.einsum("ij,ij->i", normal[number], along) for number in (enter, enter + 1))
    cosine = np.einsum("ij,ij->i", normal[enter], normal[enter + 1])
    return -np.sign(inwards) * np.sign(outwards) * cosine <= _FACING


def _through_faces(
    positions: Array, away: Array, nodes: Integers, row: Integers, triangle: Integers, mold_corners: Array
) -> _Spots:
    """Places amid where edges of mold triangles (n,) come through elements, nodes (n, 3), of which no side is cut."""
    corners, walls = positions[nodes], mold_corners[triangle]
    up = away[nodes].sum(1)
    places, owners, edges = [np.zeros((0, 3))], [np.zeros(0, np.int64)], [np.zeros((0, 3))]
    for k in range(3):
        begin, end = walls[:, k], walls[:, (k + 1) % 3]
        met = np.flatnonzero(crosses(begin, end, corners))
        normal = _normals(corners[met])
        along = (end - begin)[met]
        share = np.einsum("ij,ij->i", corners[met, 0] - begin[met], normal) / np.einsum("ij,ij->i", along, normal)
        places.append(begin[met] + share[:, None] * along)
        owners.append(met)
        edges.append(along * np.sign(np.einsum("ij,ij->i", along, up[met]))[:, None])
    place, pair, edge = np.concatenate(places), np.concatenate(owners), np.concatenate(edges)
    order = np.argsort(row[pair], kind="stable")
    place, pair, edge = place[order], pair[order], edge[order]
    first = np.flatnonzero(np.diff(row[pair], prepend=-1))
    if not len(first):
        return _Spots(place, np.zeros(0), edge)
    count = np.diff(first, append=len(pair))[:, None]
    low, high = np.minimum.reduceat(place, first), np.maximum.reduceat(place, first)
    way = np.add.reduceat(edge / np.linalg.norm(edge, axis=1, keepdims=True), first)
    # Each edge comes with both of its triangles; three of them are around a pin.
    kept = np.flatnonzero(count[:, 0] >= 6)
    middle = (np.add.reduceat(place, first) / count)[kept]
    return _escaping_spots(middle, np.linalg.norm(high - low, axis=1)[kept], way[kept], up[pair[first]][kept])


def _escaping_spots(place: Array, width: Array, way: Array, off: Array) -> _Spots:
    """The places from which a way leads off the mold."""
    length, clear = np.linalg.norm(way, axis=1), np.linalg.norm(off, axis=1)
    kept = np.einsum("ij,ij->i", way, off) > _UPWARDS * length * clear
    return _Spots(place[kept], width[kept], way[kept] / length[kept, None])


def _heights(spots: _Spots, mold_corners: Array, grid: SearchGrid) -> Array:
    """Distances (n,) [m] from places in the mold up to its surface; 0 where there is none."""
    size = float(np.ptp(mold_corners, axis=(0, 1)).max())
    begin, end = spots.place, spots.place + 2 * size * spots.way
    share = np.full(len(begin), np.inf)
    for piece, triangle in near_pairs(np.stack([begin, end], axis=1), mold_corners, grid):
        met = crosses(begin[piece], end[piece], mold_corners[triangle])
        piece, triangle = piece[met], triangle[met]
        normal = _normals(mold_corners[triangle])
        slope = np.einsum("ij,ij->i", end[piece] - begin[piece], normal)
        height = np.einsum("ij,ij->i", mold_corners[triangle, 0] - begin[piece], normal)
        np.minimum.at(share, piece, height / np.where(slope == 0, np.inf, slope))
    return np.where(np.isfinite(share), 2 * size * share, 0.0)


def _directions_along(vectors: Array, normal: Array) -> Array:
    """Unit vectors (n, 3) along planes with unit normals (n, 3), as near to vectors (n, 3) as they can be."""
    flat = vectors - np.einsum("ij,ij->i", vectors, normal)[:, None] * normal
    return flat / np.maximum(np.linalg.norm(flat, axis=1, keepdims=True), 1e-300)


def _normals(corners: Array) -> Array:
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    return normal / np.linalg.norm(normal, axis=1, keepdims=True)

"""Penetration of a mold by a sheet. On the host.

Nodes never pass the mold, but an element can span a convex edge of it and cut it. The side of the mold on which a place
is follows from how often the path to it crosses the mold, from a node whose side is known: a node in contact is on the
side from which it came. So neither the mold's triangles need turn the same way, nor must all that is on one part of a
mold be on one side of it: a sheet may well be in contact with both sides of a flange.

For this check stuck nodes are lifted off the mold, by a millionth of the mold's size to the side from which they came.
"""

from __future__ import annotations

import functools
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from jaxform.mesh.volumes import longest_sides
from jaxform.tools.crossings import (
    Ways,
    all_columns,
    bounding_boxes,
    contact_normals,
    expand_ranges,
    intersect,
    nodal_normals,
    penetrating_nodes,
    short_pieces,
)
from jaxform.tools.distances import Distances, point_triangle_distance
from jaxform.tools.mold import Mold
from jaxform.tools.ribs import NO_RIBS, Ribs, find_ribs
from jaxform.tools.search import SearchGrid, build_grid

__all__ = ["Penetration", "penetration", "point_triangle_distance"]

Array = NDArray[np.float64]
Integers = NDArray[np.integer]

_LIFT = 1e-6  # of the mold's size
_RESTING_LIFT = 5e-5  # the same of what began on the mold, to within the rounding of its file
_TRUST_IN_RESTING = 0.3  # what its word counts: a clamped rim may well be a little outside of a mold that is a polygon
_FACING = 0.5  # length of the mean normal of a sheet, from which it is pulled off one way
_RESTING = 1e-4  # of the sheet's size: what moved by less is where it began
_DIVISIONS = 6  # of an element's sides
_MOST_PIECES, _PIECES_EACH = 4_000_000, 20  # as long as the grid's reach, that elements are compared in
_MOST_DIVIDED = 8192  # elements, the deepest by their middles, that are measured all over


class Penetration(NamedTuple):
    """Penetration depths of a sheet [m]: of its nodes, of its elements, and where these are deepest (3,) [m].

    Also the number of elements of a burst sheet that are too large to be measured, and the ribs of the mold that the
    sheet passed through, which may be far higher than its elements are deep in them.
    """

    nodes: float
    elements: float
    place: Array
    unmeasured: int = 0
    ribs: Ribs = NO_RIBS

    @property
    def deepest(self) -> float:
        """Largest penetration depth [m], the height of ribs that the sheet passed through included."""
        return max(self.elements, self.ribs.height)

    @property
    def deepest_place(self) -> Array:
        """Place of the largest penetration depth (3,) [m]."""
        return self.ribs.place if self.ribs.height > self.elements else self.place


def penetration(
    positions: Array,
    triangles: Integers,
    wall: Integers,
    mold: Mold,
    resting: Array | None = None,
    *,
    grid: SearchGrid | None = None,
    pull: Array | None = None,
) -> Penetration:
    """Measures the penetration of the mold by a sheet.

    Args:
        positions: Positions of the nodes (n_node, 3) [m].
        triangles: Their elements (n_element, 3).
        wall: Triangle in contact with each node (n_node,), see `Result.wall`.
        mold: The mold.
        resting: Unit directions (n_node, 3) against the pressure's push, of nodes that are where they began; 0 of the
            others. Where they are in contact, that is the side on which they are, whatever `wall` says.
        grid: The mold's search structure; made here by default.
        pull: Unit vector (3,) in which the part is pulled off the mold; None without such a direction.
    """
    resting = np.zeros_like(positions) if resting is None else resting
    ways, compared, side, (lifted, away, below) = _find_cuts(positions, triangles, wall, mold, resting, grid)
    unmeasured = len(triangles) - len(compared)
    if not len(ways.element):
        return Penetration(below, 0.0, np.zeros(3), unmeasured)
    rests, corners = resting.any(1), positions[triangles]
    distances = Distances(mold.vertices, mold.triangles, float(longest_sides(corners).max()))
    deepest, _ = distances.largest(positions[(side < 0) & ~rests])
    deepest_element = _deepest(corners[compared[ways.element]], ways, side, distances)
    ribs = find_ribs(lifted, resting + away, (wall != 0) | rests, ways, pull)
    return Penetration(max(deepest, below), *deepest_element, unmeasured, ribs)


def element_depths(
    positions: Array, triangles: Integers, wall: Integers, mold: Mold, resting: Array, *, grid: SearchGrid | None = None
) -> tuple[Array, Array]:
    """Depths of all elements in the mold, by the arguments of `penetration`.

    Returns:
        Depths (n_element,) [m], and the shares (n_element, 3) of their corners at the deepest places.
    """
    ways, compared, side, _ = _find_cuts(positions, triangles, wall, mold, resting, grid)
    depth, share = np.zeros(len(triangles)), np.full((len(triangles), 3), 1.0 / 3.0)
    if not len(ways.element):
        return depth, share
    shares = _lattice(_DIVISIONS)
    row, point = np.nonzero(_points_beyond_mold(ways, np.arange(len(ways.element)), shares, side))
    element = compared[ways.element[row]]
    corners = positions[triangles]
    distances = Distances(mold.vertices, mold.triangles, float(longest_sides(corners).max()))
    own = distances.exact(np.einsum("pc,pck->pk", shares[point], corners[element]))
    order = np.argsort(own, kind="stable")
    depth[element[order]], share[element[order]] = own[order], shares[point[order]]
    return depth, share


def _find_cuts(
    positions: Array, triangles: Integers, wall: Integers, mold: Mold, resting: Array, grid: SearchGrid | None
) -> tuple[Ways, NDArray[np.int64], Array, tuple[Array, Array, float]]:
    """The elements that the mold cuts, by the arguments of `penetration`.

    Returns:
        Paths inside these elements; the elements (k,) that are compared with the mold, in whose order the paths name
        theirs; the sides of the nodes (n_node,), negative beyond the mold, the magnitude of which is their certainty;
        and the nodes lifted off the mold, as of `_lift_nodes`.
    """
    if grid is None:
        grid = build_grid(np.asarray(mold.vertices, float), np.asarray(mold.triangles))
    mold_corners = np.asarray(mold.vertices, float)[np.asarray(mold.triangles)]
    rests = resting.any(1)
    in_contact = (wall != 0) & ~rests
    lifted, away, below = _lift_nodes(positions, wall, in_contact, mold_corners, resting)
    compared = _limit_elements(lifted[triangles], mold_corners, float(grid.reach))
    ways = Ways(triangles[compared], lifted[triangles[compared]], mold_corners, grid)
    trust = np.where(rests, _TRUST_IN_RESTING, 1.0)
    beyond = penetrating_nodes(triangles, ways, in_contact, trust) if len(ways.element) else np.zeros(len(wall), bool)
    return ways, compared, np.where(beyond, -trust, trust), (lifted, away, below)


def _limit_elements(corners: Array, mold_corners: Array, reach: float) -> NDArray[np.int64]:
    """The elements, with corners (n, 3, 3) [m], that are compared with the mold, in order: the smallest of a sheet.

    All, but of a sheet that burst: its elements are as large as the mold, and each cuts thousands of triangles.
    """
    low, high = bounding_boxes(mold_corners)
    lowest, highest = bounding_boxes(corners)
    extent = np.clip(highest, low.min(0), high.max(0)) - np.clip(lowest, low.min(0), high.max(0))
    longest, middle, _ = np.sort(extent, axis=1)[:, ::-1].T
    pieces = (1 + 2 * longest / reach) * (1 + 2 * middle / reach)
    order = np.argsort(pieces, kind="stable")
    most = max(_MOST_PIECES, _PIECES_EACH * len(corners))
    return np.sort(order[np.cumsum(pieces[order]) <= most])


def resting_directions(start: Array, end: Array, triangles: Integers, pressure: float) -> Array:
    """Unit directions (n_node, 3) against the pressure's push, of nodes that are where they began; else 0.

    Args:
        start: First positions of the nodes (n_node, 3) [m].
        end: Their present positions (n_node, 3) [m].
        triangles: The elements (n_element, 3), whose normals are those along which pressure acts.
        pressure: The pressure [Pa]; its sign alone counts.
    """
    rests = np.linalg.norm(end - start, axis=1) <= _RESTING * np.ptp(start, axis=0).max()
    total = nodal_normals(start, triangles)
    length = np.linalg.norm(total, axis=1, keepdims=True)
    away = -np.sign(pressure) * total / np.where(length > 0, length, 1.0)
    return np.where(rests[:, None], away, 0.0)


def pull_direction(start: Array, triangles: Integers, pressure: float) -> Array | None:
    """The unit vector (3,) from which the pressure pushes a sheet as a whole; None where that is curved too much.

    Args:
        start: First positions of the nodes (n_node, 3) [m].
        triangles: The elements (n_element, 3), whose normals are those along which pressure acts.
        pressure: The pressure [Pa]; its sign alone counts.
    """
    corners = start[triangles]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    total = -np.sign(pressure) * normal.sum(0)
    length = float(np.linalg.norm(total))
    return total / length if length > _FACING * np.linalg.norm(normal, axis=1).sum() else None


def _lift_nodes(
    positions: Array, wall: Integers, in_contact: NDArray[np.bool_], mold_corners: Array, resting: Array
) -> tuple[Array, Array, float]:
    """Nodes (n_node, 3) [m] lifted off the mold, directions (n_node, 3) from it, and their depth below its planes [m].

    The directions are those of nodes in contact (n_node,), 0 of the others, the ones that rest included.
    """
    size = float(np.ptp(mold_corners, axis=(0, 1)).max())
    node = np.flatnonzero(in_contact)
    normal = contact_normals(wall[node], mold_corners)
    height = np.einsum("ij,ij->i", positions[node] - mold_corners[np.abs(wall[node]) - 1, 0], normal)
    lift = np.zeros_like(positions)
    lift[node] = _LIFT * size * normal
    lifted = positions + lift + _RESTING_LIFT * size * resting
    return lifted, lift / (_LIFT * size), 0.0 - float(height.min(initial=0.0))


def _deepest(corners: Array, ways: Ways, side: Array, distances: Distances) -> tuple[float, Array]:
    """Largest depth [m] of the cut elements, with corners (n, 3, 3) [m], beyond the mold, and its place (3,) [m].

    The side of the nodes (n_node,) is negative beyond the mold; its magnitude is its certainty.
    """
    middle = corners.mean(1)
    row = np.arange(len(corners))
    if len(row) > _MOST_DIVIDED:
        row = np.sort(np.argsort(-distances.upper_bounds(middle), kind="stable")[:_MOST_DIVIDED])
    shares, best, where = _lattice(_DIVISIONS), 0.0, np.zeros(3)

    def measure(asked: NDArray[np.int64]) -> float:
        nonlocal best, where
        part = row[asked]
        element, point = np.nonzero(_points_beyond_mold(ways, part, shares, side))
        points = np.einsum("pc,pck->pk", shares[point], corners[part[element]])
        best, deepest = distances.largest(points, best)
        if deepest >= 0:
            where = points[deepest]
        return best

    # No place of an element is deeper than its middle by more than it is away from that.
    radius = np.linalg.norm(corners[row] - middle[row, None], axis=2).max(1)
    distances.search_largest(middle[row], measure, beyond=radius)
    return best, where


def _points_beyond_mold(ways: Ways, row: Integers, shares: Array, side: Array) -> NDArray[np.bool_]:
    """Mask (n, p) of the points, at shares (p, 3) of the corners of cut elements (n,), that are beyond the mold."""
    here = np.where(ways.cross_oddly(row, shares), -1.0, 1.0)
    return np.einsum("ncp,nc->np", here, side[ways.triangles[row]]) < 0


def _lattice(divisions: int) -> Array:
    """Barycentric points (n, 3) all over a triangle."""
    i, j = (index.ravel() for index in np.meshgrid(np.arange(divisions + 1), np.arange(divisions + 1)))
    kept = i + j <= divisions
    return np.stack([divisions - i - j, i, j], axis=1)[kept] / divisions


# Self-intersection of a sheet: the method has no contact of a sheet with itself. On the host.

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

"""Crossings of segments and triangles with the mold, and the nodes that are beyond it. On the host.

Candidates are looked up in the mold's search grid, box by box, so that a sheet of n elements is compared with a few
triangles each, however many there are.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator
from typing import Any

import jax
import numpy as np
from numpy.typing import NDArray

from jaxform.mesh import topology
from jaxform.mesh.topology import positions_in_rows, unique_ascending
from jaxform.tools.mold import Mold
from jaxform.tools.search import CLASSES, SearchGrid, split_long_triangles

Array = NDArray[np.float64]
Integers = NDArray[np.integer]

_CHUNK = 1_000_000  # pairs processed together, to bound the memory
_IN_CACHE = 20_000  # pairs whose coordinates fit into a core's cache
_SLACK = 1e-5  # of a radius, for rounding in a grid of float32
_TOUCH = 1e-9  # of the mold's size, for rounding in heights above planes
_STEEP = 1e-9  # of the mold's size: a path that changes its height over a triangle by less touches it


def near_pairs(
    corners: Array, mold_corners: Array, grid: SearchGrid, margin: float = 0.0
) -> Iterator[tuple[NDArray[np.int64], Integers]]:
    """Pairs of pieces, with k corners (n, k, 3) [m], and mold triangles whose boxes overlap, part by part.

    Args:
        corners: Corners of segments, with k = 2, or of triangles, with k = 3. The boxes are widened by the margin [m].
        mold_corners: Corners of the mold's triangles (n_triangle, 3, 3) [m].
        grid: The mold's search structure.
        margin: Margin [m] by which the boxes are widened.

    Yields:
        Numbers of pieces (m,), and of the triangles (m,) that they may meet.
    """
    cells, reach = jax.device_get(grid), float(grid.reach)
    # The mold is well inside of its grid.
    low, high = cells.corner - margin, cells.corner + cells.width * cells.shape + margin
    touch = _TOUCH * float(np.max(high - low))

    def may_be_near(pieces: Array) -> NDArray[np.bool_]:
        middle, radius = _spheres(pieces, margin)
        return cells.bound[_cell_index(middle, cells)] * (1 - _SLACK) <= radius

    pieces, owner = short_pieces(corners, reach, low, high, may_be_near)
    low, high = bounding_boxes(pieces)
    low, high = low - margin, high + margin
    middle, radius = _spheres(pieces, margin)
    cell = _cell_index(middle, cells)
    kind = np.ceil(CLASSES * radius * (1 + _SLACK) / reach).astype(np.int64) - 1
    begin, end = cells.start[cell], cells.ends[CLASSES * cell + np.clip(kind, 0, CLASSES - 1)]
    # In a fine mold few triangles are near to a few pieces.
    few = int((end - begin).sum()) < len(mold_corners)
    bounds = None if few else _boxes_and_planes(mold_corners)
    for row, place in expand_ranges(begin, end):
        piece, triangle = row, cells.number[cells.listed[place]]
        known = triangle
        if few:
            some, known = np.unique(triangle, return_inverse=True)
            bounds = _boxes_and_planes(mold_corners[some])
        assert bounds is not None
        mold_low, mold_high, normal, level = bounds
        for axis in range(3):
            over = low[piece, axis] <= mold_high[known, axis]
            over &= high[piece, axis] >= mold_low[known, axis]
            piece, triangle, known = piece[over], triangle[over], known[over]
        # Slivers as long as the mold have large boxes; a piece that its plane does not cut is not near.
        height = np.einsum("ij,ij->i", normal[known], middle[piece]) - level[known]
        cut = np.abs(height) <= radius[piece] + touch
        yield owner[piece[cut]], triangle[cut]


def _boxes_and_planes(corners: Array) -> tuple[Array, Array, Array, Array]:
    """Lowest and highest coordinates of triangles (n, 3, 3) [m], and their `_planes`."""
    return *bounding_boxes(corners), *_planes(corners)


def _spheres(pieces: Array, margin: float) -> tuple[Array, Array]:
    """Middles (n, 3) and radii (n,) [m] of spheres round pieces (n, k, 3) [m] and the margin [m] about them."""
    middle = pieces.mean(1)
    away = np.moveaxis(pieces, 1, 0) - middle
    square = functools.reduce(np.maximum, np.einsum("kij,kij->ki", away, away))
    return middle, np.sqrt(square) * (1 + _SLACK) + 2 * margin


def _cell_index(places: Array, cells: Any) -> NDArray[np.int64]:
    """The cells (n,) of places (n, 3) [m], or the nearest cells, where they are outside of the grid.

    The mold is inside it: no triangle is farther from the nearest place of the grid than from the place itself.
    """
    index = np.clip(np.floor((places - cells.corner) / cells.width), 0, cells.shape - 1).astype(np.int64)
    return np.asarray(np.ravel_multi_index(tuple(index.T), tuple(cells.shape)))


def _planes(corners: Array) -> tuple[Array, Array]:
    """Unit normals (n, 3) of triangles (n, 3, 3) [m], and the places of their planes along them (n,) [m]."""
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    return normal, np.einsum("ij,ij->i", normal, corners[:, 0])


def bounding_boxes(corners: Array) -> tuple[Array, Array]:
    """Lowest and highest coordinates (n, 3), (n, 3) [m] of pieces with k corners (n, k, 3) [m].

    Corner by corner: NumPy takes several times as long along an axis of three.
    """
    each = np.moveaxis(corners, 1, 0)
    return functools.reduce(np.minimum, each), functools.reduce(np.maximum, each)


def all_columns(columns: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Mask (n,) of the rows that are true in each of a few columns (n, k)."""
    return functools.reduce(np.logical_and, columns.T)


def expand_ranges(begin: Integers, end: Integers) -> Iterator[tuple[NDArray[np.int64], NDArray[np.int64]]]:
    """The entries from `begin` to `end` (n,) of each row of a list: their rows and places, part by part."""
    count = (end - begin).astype(np.int64)
    total = np.cumsum(count)
    parts = np.searchsorted(total, np.arange(_CHUNK, total[-1] if len(total) else 0, _CHUNK)) + 1
    for part in np.split(np.arange(len(count)), parts):
        row = np.repeat(part, count[part])
        yield row, begin[row] + positions_in_rows(count[part])


def short_pieces(
    corners: Array,
    longest: float,
    low: Array,
    high: Array,
    may_be_near: Callable[[Array], NDArray[np.bool_]] | None = None,
) -> tuple[Array, NDArray[np.int64]]:
    """Pieces of segments or triangles that may be in a box, none longer than `longest`, and the owner of each.

    They are halved repeatedly, and pieces outside are dropped each time: of one that is far larger than the box little
    is cut small. So are those of which `may_be_near` says that they are not near what is looked for.
    """
    owner = np.arange(len(corners))
    while True:
        lowest, highest = bounding_boxes(corners)
        wanted = all_columns((lowest <= high) & (highest >= low))
        if may_be_near is not None:
            wanted &= may_be_near(corners)
        if not wanted.all():
            corners, owner = corners[wanted], owner[wanted]
        side = max(_longest(corners[:, k] - corners[:, k - 1]) for k in range(corners.shape[1]))
        if side <= longest:
            return corners, owner
        halve = split_long_triangles if corners.shape[1] == 3 else _halve_segments
        corners, part = halve(corners, max(longest, 0.5 * side))
        owner = owner[part]


def _longest(sides: Array) -> float:
    """The length of the longest of some vectors (n, 3) [m], 0 of none."""
    return float(np.sqrt(np.einsum("ij,ij->i", sides, sides).max(initial=0.0)))


def _halve_segments(corners: Array, longest: float) -> tuple[Array, NDArray[np.int64]]:
    """Segments (n, 2, 3) [m] of which those that are longer are halved, and the owner of each piece."""
    long = np.linalg.norm(corners[:, 1] - corners[:, 0], axis=1) > longest
    middle = corners[long].mean(1)
    first, second = np.stack([corners[long, 0], middle], 1), np.stack([middle, corners[long, 1]], 1)
    number = np.flatnonzero(long)
    return np.concatenate([corners[~long], first, second]), np.concatenate([np.flatnonzero(~long), number, number])


def crosses(begin: Array, end: Array, corners: Array) -> NDArray[np.bool_]:
    """True where segments from `begin` to `end`, (n, 3) each, cross triangles (n, 3, 3), pair by pair.

    One that ends in a triangle's plane ends below it; one in it does not cross it.
    """
    edge1, edge2 = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    normal = np.cross(edge1, edge2)
    one, other = (np.einsum("ij,ij->i", place - corners[:, 0], normal) for place in (begin, end))
    found = np.flatnonzero((one > 0) != (other > 0))
    edge1, edge2, normal = edge1[found], edge2[found], normal[found]
    share = one[found] / (one[found] - other[found])
    away = begin[found] + share[:, None] * (end - begin)[found] - corners[found, 0]
    gamma = np.einsum("ij,ij->i", np.cross(away, edge2), normal)
    delta = np.einsum("ij,ij->i", np.cross(edge1, away), normal)
    square = np.einsum("ij,ij->i", normal, normal)
    result = np.zeros(len(begin), bool)
    result[found] = (gamma >= 0) & (delta >= 0) & (gamma + delta <= square)
    return result


def intersect(one: Array, other: Array) -> NDArray[np.bool_]:
    """True where triangles (n, 3, 3) and others (n, 3, 3) cut each other, pair by pair."""
    result = np.zeros(len(one), bool)
    apart = _on_one_side(one, other)
    rest = np.flatnonzero(~apart)
    rest = rest[~_on_one_side(other[rest], one[rest])]
    for cutting, crossed in ((one, other), (other, one)):
        for k in range(3):
            rest = rest[~result[rest]]
            result[rest] = crosses(cutting[rest, k], cutting[rest, (k + 1) % 3], crossed[rest])
    return result


def _on_one_side(one: Array, other: Array) -> NDArray[np.bool_]:
    """True where triangles (n, 3, 3) are on one side of the planes of others (n, 3, 3), pair by pair.

    Coordinate by coordinate, which is several times as fast as vector by vector.
    """
    result = np.zeros(len(one), bool)
    for part in np.array_split(np.arange(len(one)), 1 + len(one) // _IN_CACHE):
        ours, theirs = (np.ascontiguousarray(np.moveaxis(corners[part], 0, 2)) for corners in (one, other))
        x, y, z = theirs[1] - theirs[0]
        u, v, w = theirs[2] - theirs[0]
        p, q, r = y * w - z * v, z * u - x * w, x * v - y * u
        ours -= theirs[0]
        height = ours[:, 0] * p + ours[:, 1] * q + ours[:, 2] * r
        result[part] = (height > 0).all(0) | (height < 0).all(0)
    return result


def proper_crossings(
    begin: Array, end: Array, mold: Mold, grid: SearchGrid, margin: float = 1e-6
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """The segments (from `begin` to `end`, each (n, 3) [m]) that properly cross the mold, ascending, with a triangle.

    Touching does not count: the crossing must lie inside segment and triangle by the relative margin.
    """
    mold_corners = np.asarray(mold.vertices, float)[np.asarray(mold.triangles)]
    found = [np.zeros((2, 0), np.int64)]
    steep = _STEEP * float(grid.size)
    for piece, triangle in near_pairs(np.stack([begin, end], axis=1), mold_corners, grid):
        inside = _crosses_inside(begin[piece], end[piece], mold_corners[triangle], margin, steep)
        found.append(np.stack([piece[inside], np.asarray(triangle[inside], np.int64)]))
    segment, triangle = np.concatenate(found, axis=1)
    segment, first = np.unique(segment, return_index=True)
    return segment, triangle[first]


def _crosses_inside(begin: Array, end: Array, corners: Array, margin: float, steep: float) -> NDArray[np.bool_]:
    """True where segments cross triangles, pair by pair, inside both by the relative margin, more than `steep`."""
    path = end - begin
    d, edge1, edge2 = corners[:, 0], corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    normal = np.cross(edge1, edge2)
    square = np.einsum("ij,ij->i", normal, normal)
    height = np.einsum("ij,ij->i", begin - d, normal)
    slope = np.einsum("ij,ij->i", path, normal)
    # A path that hardly leaves the triangle's plane is a touch.
    leaves = np.abs(slope) > steep * np.sqrt(square)
    beta = -height / np.where(leaves, slope, 1.0)
    meet = begin + beta[:, None] * path - d
    gamma = np.einsum("ij,ij->i", np.cross(meet, edge2), normal) / square
    delta = np.einsum("ij,ij->i", np.cross(edge1, meet), normal) / square
    # Strictly inside, for a sheet may rest on the rim of an open mold.
    inside = (gamma > margin) & (delta > margin) & (gamma + delta < 1 - margin)
    return leaves & inside & (beta > margin) & (beta < 1 - margin)


# Nodes of a sheet that are beyond the mold. On the host.
#
# A path inside an element from one place to another changes sides as often as it crosses the mold. Nodes in contact
# with the mold are on the side from which they came; from them sides are propagated over the sheet, node by node.

_APART = 1e-7  # of an element, how far inside it a way starts: it may end at an edge of the mold, but not run along it
_SIDES_CHUNK = 300_000  # paths and triangles processed together


def nodal_normals(positions: Array, triangles: Integers) -> Array:
    """Sums (n_node, 3) [m^2] of the normals of the elements round each node, each twice as long as its area."""
    corners = positions[triangles]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    return np.stack([np.bincount(triangles.ravel(), np.repeat(part, 3), len(positions)) for part in normal.T], axis=1)


def contact_normals(wall: Integers, mold_corners: Array) -> Array:
    """Unit normals (n, 3) of the mold, on the side from which nodes came that stick to `wall` (n,), nowhere 0."""
    corners = mold_corners[np.abs(wall) - 1]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    return normal * (np.sign(wall) / np.linalg.norm(normal, axis=1))[:, None]


class Ways:
    """Paths inside the elements that the mold cuts.

    Attributes:
        element: The elements (n_cut,), in order.
        triangles: Their nodes (n_cut, 3).
        mold_corners: Corners of the mold's triangles (n_triangle, 3, 3) [m].
        grid: The mold's search structure.
    """

    def __init__(self, triangles: Integers, corners: Array, mold_corners: Array, grid: SearchGrid) -> None:
        """Finds the elements, with corners (n_element, 3, 3) [m], that the mold cuts."""
        keys = [np.zeros(0, np.int64)]
        for element, triangle in near_pairs(corners, mold_corners, grid):
            cut = intersect(corners[element], mold_corners[triangle])
            keys.append(element[cut] * len(mold_corners) + triangle[cut])
        element, self._triangle = np.divmod(unique_ascending(np.concatenate(keys)), len(mold_corners))
        self.element, self._first, self._count = np.unique(element, return_index=True, return_counts=True)
        self.triangles, self.mold_corners, self.grid = triangles[self.element], mold_corners, grid
        self._corners = corners[self.element]
        inside = np.random.default_rng(0).uniform(0.1, 1.0, (len(self.element), 3, 3))
        inside /= inside.sum(2, keepdims=True)
        self._begin = self._corners + _APART * (np.einsum("esc,eck->esk", inside, self._corners) - self._corners)

    def pairs(self) -> tuple[Integers, Integers]:
        """All pairs of a cut element, as in `element`, and a triangle of the mold that cuts it, element by element."""
        return np.repeat(np.arange(len(self.element)), self._count), self._triangle

    def cross_oddly(self, row: Integers, shares: Array) -> NDArray[np.bool_]:
        """True where paths cross the mold an odd number of times.

        Args:
            row: Cut elements (n,), as in `element`.
            shares: Shares of their corners in the places where paths end (p, 3).

        Returns:
            Mask (n, 3, p) of the paths from each of the three corners to each place.
        """
        ends = np.einsum("pc,nck->npk", shares, self._corners[row])
        count = self._count[row]
        owner = np.repeat(np.arange(len(row)), count)
        pair = np.repeat(self._first[row] - np.cumsum(count) + count, count) + np.arange(len(owner))
        result = np.zeros((len(row), 3, len(shares)), np.int64)
        for part in np.array_split(np.arange(len(owner)), 1 + len(owner) * 3 * len(shares) // _SIDES_CHUNK):
            one, corner, place = (
                index.ravel() for index in np.meshgrid(part, range(3), range(len(shares)), indexing="ij")
            )
            element = owner[one]
            begin, end = self._begin[row[element], corner], ends[element, place]
            met = crosses(begin, end, self.mold_corners[self._triangle[pair[one]]])
            np.add.at(result, (element[met], corner[met], place[met]), 1)
        return result % 2 == 1


def penetrating_nodes(
    triangles: Integers, ways: Ways, in_contact: NDArray[np.bool_], trust: NDArray[np.floating]
) -> NDArray[np.bool_]:
    """Mask (n_node,) of the nodes that are beyond the mold.

    Args:
        triangles: The sheet's elements (n_element, 3).
        ways: Paths inside the elements that the mold cuts.
        in_contact: Nodes (n_node,) in contact with the mold, on the side from which they came. Where there are none,
            most of the sheet is on its right side.
        trust: Weights of the nodes in the vote on their neighbours' side (n_node,).
    """
    edge, weight = _sides_of_edges(triangles, ways, in_contact)
    if not np.any(weight < 0):
        return np.zeros(len(in_contact), bool)
    from scipy.sparse import coo_array

    count = len(in_contact)
    rows, columns = np.concatenate([edge[:, 0], edge[:, 1]]), np.concatenate([edge[:, 1], edge[:, 0]])
    graph = coo_array((np.concatenate([weight, weight]), (rows, columns)), shape=(count, count)).tocsr()
    side = np.where(in_contact | _majority_side(edge, weight, in_contact), trust, 0.0)
    unknown = np.flatnonzero(side == 0)
    while len(unknown):
        # A node is on the side of most of its neighbours that are known.
        votes = np.sign((graph @ side)[unknown])
        if not votes.any():
            break
        side[unknown] = votes * trust[unknown]
        unknown = unknown[votes == 0]
    return side < 0


def _sides_of_edges(triangles: Integers, ways: Ways, in_contact: NDArray[np.bool_]) -> tuple[NDArray[np.int64], Array]:
    """Edges (n, 2) of the sheet, and 1 (n,) where both ends are on one side of the mold, -1 where not, 0 unknown."""
    edge, _ = topology.edges(triangles)
    total, asked = np.zeros(len(edge)), np.zeros(len(edge), bool)
    # Edges between nodes in contact add no information.
    row = np.flatnonzero(~in_contact[ways.triangles].all(1))
    odd = ways.cross_oddly(row, np.eye(3))
    name = np.array([len(in_contact), 1], np.int64)
    known = edge @ name
    for k in range(3):
        for other in ((k + 1) % 3, (k + 2) % 3):
            ends = np.sort(ways.triangles[row][:, [k, other]], axis=1) @ name
            place = np.searchsorted(known, ends)
            np.add.at(total, place, np.where(odd[:, k, other], -1.0, 1.0))
            asked[place] = True
    return edge, np.where(asked, np.sign(total), 1.0)


def _majority_side(edge: NDArray[np.int64], weight: Array, in_contact: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Mask (n_node,) of the largest group on one side of the mold, in each part of the sheet without contact."""
    count = len(in_contact)
    part = topology.connected_parts(edge[:, 0], edge[:, 1], count)
    one, other = edge[weight > 0].T
    together = topology.connected_parts(one, other, count)
    rank = np.bincount(together, minlength=count)[together] * count - together  # of two as large, one
    most = np.zeros(count, np.int64)
    np.maximum.at(most, part, rank)
    elsewhere = np.ones(count, bool)
    elsewhere[part[in_contact]] = False
    return elsewhere[part] & (rank == most[part])

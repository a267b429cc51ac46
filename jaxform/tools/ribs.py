"""Ribs and pins of a mold that are thinner than the elements, before a run and after it. On the host.

Nodes alone meet the mold. Between two that stick to it, or that are held, the side of an element enters what is thinner
than it is and leaves it again; a pin comes through an element's middle. A convex edge of the mold is cut in the same
way, but less than it is wide: of a rib the mold stands higher above the sheet than it is wide where it is crossed.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from jaxform.mesh import outlines, raster
from jaxform.mesh.topology import distinct_rows
from jaxform.mesh.volumes import longest_sides
from jaxform.tools.crossings import Ways, crosses, near_pairs
from jaxform.tools.search import SearchGrid

Array = NDArray[np.float64]
Integers = NDArray[np.integer]

_SLENDER = 0.75  # times as high as it is wide where it is crossed, a rib is; a right-angled edge is half as high
_FACING = -0.4  # the cosine between the normals of both sides of a rib at most: of an edge as slender as that
_SAME = 1e-6  # of a side: crossings as near as that are one, at an edge that two triangles share
_MOST = 4000  # places that are examined, evenly over all
_UPWARDS = 0.2  # the cosine that the way along a rib has with the way off the mold
_UPRIGHT = 0.5  # the cosine that it has with the sheet's normal at least: a rib stands up from the sheet
_LEAN = tuple(np.radians([15.0, -15.0, 30.0, -30.0]))  # aside, of ways out along a rib beside the one straight up
_TOP = 0.5  # the cosine that the normal of a rib's top has with the way up
_LOW = 0.1  # of an element's side: what is lower, as a scan's noise, makes its wall thinner by at most a fifth


class Ribs(NamedTuple):
    """Ribs and pins that a sheet passed through, or may pass through.

    Attributes:
        count: Number of places, which are sides of elements or elements; 1 before a run.
        height: Height of the highest above the sheet, or above its surroundings [m].
        width: Width of that one where it is crossed, or at most half way up [m].
        place: Place of that crossing, or of its top (3,) [m].
    """

    count: int
    height: float
    width: float
    place: Array


NO_RIBS = Ribs(0, 0.0, 0.0, np.zeros(3))
"""The value for a sheet that passed through none."""


class _Spots(NamedTuple):
    """Places inside ribs or pins that a sheet passed through.

    Attributes:
        place: Their positions (n, 3) [m].
        width: Width of the mold there (n,) [m].
        way: Unit vectors (n, 3) up along it.
        along: Unit vectors (n, 3) along a rib, square to `way`; 0 of a pin.
        rise: Component of `way` away from the sheet (n,).
        side: Side of the element that is cut (n,) [m].
    """

    place: Array
    width: Array
    way: Array
    along: Array
    rise: Array
    side: Array

    def select(self, index: Any) -> _Spots:
        """Some of the places."""
        return _Spots(*(values[index] for values in self))


def find_ribs(
    positions: Array,
    away: Array,
    sticking: NDArray[np.bool_],
    ways: Ways,
    pull: Array | None = None,
) -> Ribs:
    """The ribs and pins that a sheet passed through.

    Args:
        positions: Node positions (n_node, 3) [m], lifted off the mold.
        away: Unit vectors off the mold (n_node, 3), of nodes that stick to it or are held.
        sticking: Mask (n_node,) of these nodes.
        ways: Inside the elements that the mold cuts.
        pull: Unit vector (3,) in which the part is pulled off the mold, along which no rib is measured as higher than
            it is; None where there is none.
    """
    mold_corners = ways.mold_corners
    row, triangle = ways.pairs()
    held = sticking[ways.triangles].all(1)[row]
    row, triangle = row[held], triangle[held]
    sides, crossed = _between_crossings(positions, away, ways.triangles[row], triangle, mold_corners)
    whole = ~np.isin(row, row[crossed])
    pins = _through_faces(positions, away, ways.triangles[row[whole]], row[whole], triangle[whole], mold_corners)
    spots = _Spots(*(np.concatenate(parts) for parts in zip(sides, pins, strict=True)))
    step = 1 + len(spots.place) // _MOST
    spots = spots.select(slice(None, None, step))
    reach = 2 * float(np.ptp(mold_corners, axis=(0, 1)).max())
    length = np.full(len(spots.place), reach)
    for find_ways, by_top in _ways_out(pull):
        length = _distances_out(spots, length, find_ways(spots), by_top, mold_corners, ways.grid)
        height = length * spots.rise
        slender = (height > _SLENDER * spots.width) & (height > _LOW * spots.side) & (length < reach)
        spots, length = spots.select(slender), length[slender]
        if not len(length):
            return NO_RIBS
    highest = int(np.argmax(length * spots.rise))
    height, width = float((length * spots.rise)[highest]), float(spots.width[highest])
    return Ribs(step * len(length), height, width, spots.place[highest])


def _between_crossings(
    positions: Array, away: Array, nodes: Integers, triangle: Integers, mold_corners: Array
) -> tuple[_Spots, Integers]:
    """Places between where sides of elements, nodes (n, 3), enter and leave the mold, and which pairs are crossed."""
    ends = np.concatenate([np.sort(nodes[:, [k, (k + 1) % 3]], axis=1) for k in range(3)])
    pair = np.tile(np.arange(len(nodes)), 3)
    met = crosses(positions[ends[:, 0]], positions[ends[:, 1]], mold_corners[triangle[pair]])
    crossed = np.unique(pair[met])
    rows = distinct_rows(np.column_stack([ends[met], triangle[pair[met]]]))[0]
    begin, end, normal = positions[rows[:, 0]], positions[rows[:, 1]], _normals(mold_corners[rows[:, 2]])
    slope = np.einsum("ij,ij->i", end - begin, normal)
    share = np.einsum("ij,ij->i", mold_corners[rows[:, 2], 0] - begin, normal) / np.where(slope == 0, 1.0, slope)
    order = np.lexsort((share, rows[:, 1], rows[:, 0]))
    rows, share, normal = rows[order], share[order], normal[order]
    same = np.zeros(len(rows), bool)
    same[1:] = (rows[1:, :2] == rows[:-1, :2]).all(1) & (np.diff(share) <= _SAME)
    rows, share, normal = rows[~same], share[~same], normal[~same]
    count = distinct_rows(rows[:, :2])[3]
    even = count % 2 == 0
    # In order along each side: it is in the mold between the first and the second, the third and the fourth.
    number = np.arange(len(rows)) - np.repeat(np.cumsum(count) - count, count)
    enter = np.flatnonzero(np.repeat(even, count) & (number % 2 == 0))
    enter = enter[_faces_opposite(positions, rows, normal, enter)]
    begin, end = positions[rows[enter, 0]], positions[rows[enter, 1]]
    middle = 0.5 * (share[enter] + share[enter + 1])
    width = (share[enter + 1] - share[enter]) * np.linalg.norm(end - begin, axis=1)
    off = away[rows[enter, 0]] + away[rows[enter, 1]]
    facing = _normals_of_sides(positions, nodes, rows[enter, :2])
    way = _directions_up(normal[enter], facing, off) + _directions_up(normal[enter + 1], facing, off)
    place, side = begin + middle[:, None] * (end - begin), np.linalg.norm(end - begin, axis=1)
    along = _unit(np.cross(way, normal[enter]))
    return _escaping_spots(place, width, way, along, off, facing, side), crossed


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
        place = begin[met] + share[:, None] * along
        inside = _side_distances(place, corners[met]) > _SAME
        met, along = met[inside], along[inside]
        places.append(place[inside])
        owners.append(met)
        edges.append(along * np.sign(np.einsum("ij,ij->i", along, up[met]))[:, None])
    place, pair, edge = np.concatenate(places), np.concatenate(owners), np.concatenate(edges)
    order = np.argsort(row[pair], kind="stable")
    place, pair, edge = place[order], pair[order], edge[order]
    first = np.flatnonzero(np.diff(row[pair], prepend=-1))
    if not len(first):
        return _Spots(place, np.zeros(0), edge, edge, np.zeros(0), np.zeros(0))
    count = np.diff(first, append=len(pair))[:, None]
    low, high = np.minimum.reduceat(place, first), np.maximum.reduceat(place, first)
    way = np.add.reduceat(edge / np.linalg.norm(edge, axis=1, keepdims=True), first)
    # Each edge comes with both of its triangles; three of them are around a pin.
    kept = np.flatnonzero(count[:, 0] >= 6)
    middle, width = (np.add.reduceat(place, first) / count)[kept], np.linalg.norm(high - low, axis=1)[kept]
    triangles = corners[pair[first]][kept]
    side = longest_sides(triangles)
    return _escaping_spots(middle, width, way[kept], 0.0 * way[kept], up[pair[first]][kept], _normals(triangles), side)


def _side_distances(places: Array, corners: Array) -> Array:
    """Distances (n,) of places in triangles (n, 3, 3) from the nearest side, in heights of the triangle over it.

    Edges of a face that ends at an element's side, as the lid's of a bottle at a parison's rim, do not come through it.
    """
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    areas = np.stack([np.cross(corners[:, k - 2] - places, corners[:, k - 1] - places) for k in range(3)], axis=1)
    return (np.einsum("ikj,ij->ik", areas, normal) / np.einsum("ij,ij->i", normal, normal)[:, None]).min(1)


def _escaping_spots(
    place: Array, width: Array, way: Array, along: Array, off: Array, facing: Array, side: Array
) -> _Spots:
    """The places from which a way leads off the mold and away from the sheet, with unit normals `facing` (n, 3)."""
    length, clear = np.linalg.norm(way, axis=1), np.linalg.norm(off, axis=1)
    rise = np.abs(np.einsum("ij,ij->i", way, facing)) / np.maximum(length, 1e-300)
    kept = (np.einsum("ij,ij->i", way, off) > _UPWARDS * length * clear) & (rise >= _UPRIGHT)
    up = way / np.maximum(length, 1e-300)[:, None]
    return _Spots(place, width, up, along, rise, side).select(kept)


def _ways_out(pull: Array | None) -> Iterator[tuple[Callable[[_Spots], Array], bool]]:
    """Ways out of ribs, straight up first; an element may be tilted, and a rib that meets a wall is as long as that.

    Each is a function that returns unit vectors (n, 3); whether they count only where they leave the mold by the top
    of a rib stands beside it.
    """
    yield lambda spots: spots.way, False
    for angle in _LEAN:
        yield lambda spots, angle=angle: np.cos(angle) * spots.way + np.sin(angle) * spots.along, True
    if pull is not None:
        yield lambda spots: _directions_of_pull(spots, pull), False


def _directions_of_pull(spots: _Spots, pull: Array) -> Array:
    """Unit vectors (n, 3) along ribs, as near to the pull (3,) as they can be; straight up those that lie across it."""
    across = np.cross(spots.way, spots.along)
    flat = pull - (across @ pull)[:, None] * across
    # A pin has no plane.
    upright = spots.along.any(1) & (np.linalg.norm(flat, axis=1) > _UPRIGHT)
    return np.where(upright[:, None], _unit(flat), spots.way)


def _distances_out(
    spots: _Spots, length: Array, way: Array, by_top: bool, mold_corners: Array, grid: SearchGrid
) -> Array:
    """The distances (n,) [m] from places in the mold to its surface, at most the length (n,) [m].

    Args:
        spots: The places.
        length: The longest distances that are looked for (n,) [m].
        way: Unit vectors (n, 3) along which the surface is looked for.
        by_top: True if only tops of ribs count.
        mold_corners: Corners of the mold's triangles (n_triangle, 3, 3) [m].
        grid: The mold's search structure.
    """
    begin, end = spots.place, spots.place + length[:, None] * way
    found = np.full(len(begin), np.inf)
    for piece, triangle in near_pairs(np.stack([begin, end], axis=1), mold_corners, grid):
        met = crosses(begin[piece], end[piece], mold_corners[triangle])
        piece, triangle = piece[met], triangle[met]
        normal = _normals(mold_corners[triangle])
        slope = np.einsum("ij,ij->i", end[piece] - begin[piece], normal)
        height = np.einsum("ij,ij->i", mold_corners[triangle, 0] - begin[piece], normal)
        share = height / np.where(slope == 0, np.inf, slope)
        if by_top:
            share[np.abs(np.einsum("ij,ij->i", normal, spots.way[piece])) < _TOP] = np.inf
        np.minimum.at(found, piece, share)
    return length * np.minimum(found, 1.0)


def _normals_of_sides(positions: Array, nodes: Integers, sides: Integers) -> Array:
    """Unit normals (n, 3) of the elements, nodes (n_element, 3), that share sides (n, 2), whose nodes are in order."""
    elements = distinct_rows(nodes)[0]
    one, other = (positions[elements[:, k]] - positions[elements[:, 0]] for k in (1, 2))
    normal = np.cross(one, other)
    ends = np.concatenate([np.sort(elements[:, [k, (k + 1) % 3]], axis=1) for k in range(3)])
    number = np.array([len(positions), 1], np.int64)
    names, index = np.unique(ends @ number, return_inverse=True)
    total = np.stack([np.bincount(index, np.tile(part, 3)) for part in normal.T], axis=1)
    total = total[np.searchsorted(names, sides @ number)]
    return _unit(total)


def _directions_up(wall: Array, facing: Array, off: Array) -> Array:
    """Unit vectors (n, 3) in walls, square to the line in which they cut the sheet, on the side of `off` (n, 3).

    Args:
        wall: Unit normals (n, 3) of the walls.
        facing: Unit normals (n, 3) of the sheet there.
        off: Vectors (n, 3) off the mold.
    """
    up = np.cross(wall, np.cross(wall, facing))
    up *= np.sign(np.einsum("ij,ij->i", up, off))[:, None]
    return _unit(up)


def _unit(vectors: Array) -> Array:
    return vectors / np.maximum(np.linalg.norm(vectors, axis=1, keepdims=True), 1e-300)


def _normals(corners: Array) -> Array:
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    return normal / np.linalg.norm(normal, axis=1, keepdims=True)


# Ribs and pins of a mold that are thinner than the elements of the sheet, seen before a run. On the host.
#
# Seen along the push, the mold is a map of heights. What stands up from it and is narrower than an element is what its
# morphological closing fills: a filter that keeps what an element can lie on.

_FINE, _SLENDER_MOST = 8.0, 600.0  # pixels along an element at least, and along the sheet at most
_TALL = 1.5  # sides of an element, and of its own width: what is lower is followed by the nodes beside it
_CORNER = 0.5  # of an element's radius, how far a right-angled corner reaches out of a disc in it
_PARTS = 20  # places that stand up, of which each is examined, the highest first
_POINTS = 2_000_000  # on the edges of the mold's triangles: a rib may be thinner than a pixel


def slender_feature(sheet: Array, mold: Array, push: Array, side: float, held: Array) -> Ribs | None:
    """The highest rib or pin that an element of the sheet may pass over or through; None where there is none.

    Args:
        sheet: Corners of the elements (n_element, 3, 3) [m].
        mold: Corners of the mold's triangles (n_triangle, 3, 3) [m].
        push: Unit vector (3,) along which the sheet is pushed.
        side: Side of an element [m].
        held: Positions of clamped nodes (n, 3) [m]: the mold beside them is its rim.
    """
    across = np.linalg.svd(push[None])[2][1:]
    flat, wall = sheet @ across.T, mold @ across.T
    low, high = flat.min((0, 1)), flat.max((0, 1))
    pixel = max(side / _FINE, float((high - low).max()) / _SLENDER_MOST)
    shape = tuple(max(1, round(float(extent) / pixel)) for extent in high - low)
    level = _nearest((flat - low) / pixel, sheet @ push, shape)
    way = _nearest((wall - low) / pixel, mold @ push, shape, edges=True)
    inside, met = np.isfinite(level), np.isfinite(way)
    if not (inside & met).any() or side < 2 * pixel:
        return None
    way = np.where(met, way, way[met].max())
    radius = side / (2 * pixel)
    filled = outlines.fill_narrow_minima(way, radius)
    near_rim = _is_near((held @ across.T - low) / pixel, inside, 3 * radius)
    above = np.where(inside & met & ~near_rim & (way > level), filled - way, 0.0)
    found = _highest(above, way, filled, radius, _TALL * side)
    if found is None:
        return None
    top, half_width = found
    height, width = float(above[top]), 2 * pixel * half_width
    row, column = top
    middle = (low + (np.array([column, row]) + 0.5) * pixel) @ across
    return Ribs(1, height, width, middle + float(way[top]) * push) if height > _TALL * width else None


def _highest(
    above: Array, way: Array, filled: Array, radius: float, least: float
) -> tuple[tuple[int, int], float] | None:
    """The pixel of the highest rib that is higher than `least`, and half its width [pixels]; None where there is none.

    A disc does not fill the corners of a wide block: places near the disc are not counted as a rib.

    Args:
        above: Height of a pixel over the surface that an element can lie on (height, width) [m].
        way: Place of the mold along the push there [m].
        filled: The same of what an element can lie on [m].
        radius: Radius of an element [pixels].
        least: Height [m].
    """
    part, count = outlines.label_parts(above > least)
    for number in sorted(range(1, count + 1), key=lambda k: -above[part == k].max())[:_PARTS]:
        region = part == number
        row, column = np.unravel_index(int(np.argmax(np.where(region, above, 0.0))), above.shape)
        wide = filled <= way[row, column] + 0.5 * above[row, column]
        away = outlines.distance(~wide)[region].max() if wide.any() else np.inf
        if away > _CORNER * radius + 2.0:
            return (int(row), int(column)), float(outlines.distance(region).max())
    return None


def _nearest(corners: Array, along: Array, shape: tuple[int, ...], *, edges: bool = False) -> Array:
    """The least distance along the push of triangles in each pixel (height, width) [m]; infinite where there is none.

    Args:
        corners: Corners of the triangles (n, 3, 2), in pixels.
        along: Places of their corners along the push (n, 3) [m].
        shape: Width and height of the map, in pixels.
        edges: True if points on the triangles' edges count too, which pixels' middles may miss.
    """
    width, height = shape
    found = np.full(width * height, np.inf)
    for _, pixel, interpolate in raster.rasterize(corners, width, height):
        np.minimum.at(found, pixel, interpolate(along))
    if edges:
        places, depth = _edge_points(corners, along)
        cell = np.floor(places).astype(np.int64)
        good = ((cell >= 0) & (cell < [width, height])).all(1)
        np.minimum.at(found, cell[good, 0] + width * cell[good, 1], depth[good])
    return found.reshape(height, width)


def _edge_points(corners: Array, along: Array) -> tuple[Array, Array]:
    """Points on the edges of triangles, about a pixel apart (n, 2), and their distance along the push (n,) [m]."""
    begin, end = corners.reshape(-1, 2), np.roll(corners, -1, axis=1).reshape(-1, 2)
    first, last = along.ravel(), np.roll(along, -1, axis=1).ravel()
    count = np.ceil(np.linalg.norm(end - begin, axis=1)).astype(np.int64) + 1
    count = np.maximum(1, (count * min(1.0, _POINTS / count.sum())).astype(np.int64))
    edge = np.repeat(np.arange(len(count)), count)
    share = (np.arange(len(edge)) - np.repeat(np.cumsum(count) - count, count)) / count[edge]
    return begin[edge] + share[:, None] * (end - begin)[edge], first[edge] + share * (last - first)[edge]


def _is_near(points: Array, inside: NDArray[np.bool_], reach: float) -> NDArray[np.bool_]:
    """Mask of a map's pixels that are within so many pixels of points (n, 2)."""
    marked = np.zeros_like(inside)
    if not len(points):
        return marked
    column, row = np.clip(np.floor(points).astype(np.int64), 0, np.array(inside.shape)[::-1] - 1).T
    marked[row, column] = True
    return outlines.distance(~marked) <= reach

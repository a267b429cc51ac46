"""Covers for what a sheet would be blown through: holes of a mold, gaps under the edge of the sheet. On the host."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from jaxform.mesh import masks, meshes, outlines, topology, volumes
from jaxform.mesh.meshes import Mesh
from jaxform.mesh.rows import positions_in_rows
from jaxform.tools import cells, heights
from jaxform.tools.heights import Heights
from jaxform.tools.opening import FINE, FLAT, Opening
from jaxform.tools.patches import close_sides

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
Integers = NDArray[np.integer]

SEAM = 1e-4
"""Distance, relative to the mold's size, within which rims are a seam, not holes."""
_CHORDS = 0.1  # of the edge's length, that a seam may be open besides
_STEP = 4.0  # pixels, from one check under the sheet's edge to the next
_SPECK = 5e-7  # of the square of the mold's size, an area: less is no hole


class Covers(NamedTuple):
    """Covers of a mold, and what they close.

    Attributes:
        mesh: The covers, where the mold's file has it; None where nothing is open.
        holes: Number of covered holes.
        gaps: The length [m] of the sheet's edge under which there was no rim.
        sides: Number of these in upright surfaces, hidden from the sheet.
        hidden: Ratio of the hidden to the visible volume behind the sheet.
    """

    mesh: Mesh | None
    holes: int
    gaps: float
    sides: int = 0
    hidden: float = 0.0


def cover(found: Opening, polygon: Array, mold: Mesh) -> Covers:
    """Covers for the holes of a mold and the gaps under the edge of a sheet.

    Args:
        found: The opening.
        polygon: Outline of the sheet, counter-clockwise, in the plane of the view (k, 2) [m].
        mold: Welded, not turned.
    """
    turned = mold.positions @ found.view.turn.T
    size = meshes.size(mold.positions)
    fans = _fans(turned, mold.triangles, found, size)
    curtain, length = _curtain(found, polygon, size)
    closed = meshes.merge([Mesh(turned, mold.triangles), *fans, *curtain])
    patches = _patches(
        heights.view_heights(heights.make_viewed_surface(closed.positions, closed.triangles), np.eye(3), FINE), polygon
    )
    closed = meshes.merge([closed, *patches])
    behind = cells.cells(closed.positions[closed.triangles], polygon, found)
    sides = [] if found.male else close_sides(behind, closed)
    parts = [*fans, *curtain, *patches, *sides]
    if not parts:
        return Covers(None, 0, 0.0, 0, behind.hidden)
    joined = meshes.merge(parts)
    mesh = Mesh(joined.positions @ found.view.turn, joined.triangles)
    return Covers(mesh, len(fans) + len(patches) + len(sides), length, len(sides), behind.hidden)


def _fans(turned: Array, triangles: Integers, found: Opening, size: float) -> list[Mesh]:
    """A cover on each open rim of a shell, behind the clamp plane as a whole, not around what is formed."""
    edges, part = topology.open_rims(triangles, len(turned))
    if not len(edges):
        return []
    count = np.bincount(part)
    in_seams = np.bincount(part, find_seams(turned, edges, SEAM * size)) > 0.5 * count
    nearest = np.full(len(count), np.inf)
    np.minimum.at(nearest, part, turned[edges][..., 2].min(1))
    made = []
    for one in np.flatnonzero(~in_seams & (nearest > found.level + FLAT * size)):
        rim = turned[edges[part == one]]
        if found.view.sample(found.view.inside, rim[:, 0, :2]).mean() < 0.5:
            continue
        cap = fan(rim)
        if _lies_before(found, cap):
            continue
        if volumes.areas(cap.positions, cap.triangles).sum() > _SPECK * size**2:
            made.append(cap)
    return made


def _lies_before(found: Opening, cap: Mesh) -> bool:
    """True when a cap lies before the visible surface: the end of a lip is around a hollow, not around a hole."""
    places = cap.positions[cap.triangles].mean(1)
    size = volumes.areas(np.insert(cap.positions[:, :2], 2, 0.0, axis=1), cap.triangles)
    deep = found.view.sample(found.view.height, places[:, :2])
    before = np.isfinite(deep) & (deep > places[:, 2] + found.view.pixel)
    return bool(size @ before > 0.5 * max(size.sum(), found.view.pixel**2))


def find_seams(turned: Array, edges: Integers, near: float) -> Mask:
    """Mask (n,) of the rim edges along which another one runs, beside their middles."""
    from scipy.spatial import KDTree

    begin, side = turned[edges[:, 0]], turned[edges[:, 1]] - turned[edges[:, 0]]
    length = np.linalg.norm(side, axis=1)
    usual = float(np.median(length))
    # Along a curved seam the chords of one piece are not those of the other.
    apart = near + _CHORDS * np.minimum(length, 3 * usual)
    count = np.ceil(4 * length / usual).astype(int)
    owner = np.repeat(np.arange(len(edges)), count)
    share = (np.arange(len(owner)) - (np.cumsum(count) - count)[owner] + 0.5) / count[owner]
    samples = begin[owner] + share[:, None] * side[owner]
    close = KDTree(samples).query_ball_point(begin + 0.5 * side, apart + 0.25 * usual)
    edge = np.repeat(np.arange(len(edges)), [len(some) for some in close])
    other = np.concatenate([np.array(some, np.int64) for some in close])
    edge, other = edge[owner[other] != edge], other[owner[other] != edge]
    away = samples[other] - begin[edge]
    along = np.einsum("ij,ij->i", away, side[edge]) / length[edge] ** 2
    off = np.linalg.norm(away - along[:, None] * side[edge], axis=1)
    found = np.zeros(len(edges), bool)
    found[edge[(np.abs(along - 0.5) < 0.25) & (off <= apart[edge])]] = True
    return found


def fan(edges: Array) -> Mesh:
    """Triangles from the middle of edges (n, 2, 3) [m] to each of them."""
    count = len(edges)
    points = np.concatenate([edges.reshape(-1, 3), edges.mean((0, 1))[None]])
    number = np.arange(count)
    fan = np.stack([2 * number, 2 * number + 1, np.full(count, 2 * count)], axis=1)
    return Mesh(points, fan.astype(np.int32))


def _curtain(found: Opening, polygon: Array, size: float) -> tuple[list[Mesh], float]:
    """Surfaces down from the sheet's edge where nothing is under it, and their length [m]."""
    view = found.view
    along = _edge_points(polygon, _STEP * view.pixel)
    near, deep = view.sample(view.local_minimum(), along), view.sample(_deepest(view), along)
    open_there = near > found.level + FLAT * size
    # A single place is below the pixels' resolution. A rim is seen from a few pixels away, so that walls reach beyond
    # the gap.
    sure = open_there & (np.roll(open_there, -1) | np.roll(open_there, 1))
    if not sure.any():
        return [], 0.0
    side = np.any([np.roll(sure, k) for k in (-2, -1, 0, 1)], axis=0)
    bottom = max(found.base, float(np.max(deep[open_there & np.isfinite(deep)], initial=found.base)))
    number = np.flatnonzero(side)
    following = (number + 1) % len(along)
    count = len(along)
    points = np.concatenate([np.insert(along, 2, z, axis=1) for z in (found.level, bottom)])
    walls = [[number, following, following + count], [number, following + count, number + count]]
    triangles = np.concatenate([np.stack(wall, axis=1) for wall in walls]).astype(np.int32)
    length = float(np.linalg.norm(along[following] - along[number], axis=1).sum())
    return [meshes.drop_unused_nodes(Mesh(points, triangles))], length


def _edge_points(polygon: Array, step: float) -> Array:
    """Points (n, 2) [m] along a closed polygon, its corners included."""
    ends = np.roll(polygon, -1, axis=0)
    counts = np.maximum(1, np.ceil(np.linalg.norm(ends - polygon, axis=1) / step).astype(int))
    side = np.repeat(np.arange(len(polygon)), counts)
    share = positions_in_rows(counts) / counts[side]
    return polygon[side] + share[:, None] * (ends - polygon)[side]


def _deepest(view: Heights) -> Array:
    return -masks.local_minimum(np.where(np.isfinite(view.height), -view.height, np.inf), 3)


def _patches(view: Heights, polygon: Array) -> list[Mesh]:
    """Covers on see-through holes, at the height of their surroundings."""
    through = ~np.isfinite(view.height) & masks.dilate(view.inside_polygon(polygon), -2)
    part, count = masks.label_parts(through)
    made = []
    for one in range(1, count + 1):
        hole = part == one
        around = masks.dilate(hole, 2) & np.isfinite(view.height)
        if not around.any():
            continue
        rim, rise = view.places(around), view.height[around]
        corners = outlines.hull(np.concatenate([rim, view.places(hole)]))
        nearest = np.argmin(np.linalg.norm(corners[:, None] - rim, axis=2), axis=1)
        points = np.insert(corners, 2, rise[nearest], axis=1)
        made.append(fan(np.stack([points, np.roll(points, -1, axis=0)], axis=1)))
    return made

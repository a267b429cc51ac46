"""Covers for openings through which a sheet would be blown: holes of a mold, gaps under its edge. On the host."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from jaxform.mesh import meshes, outlines, topology, volumes
from jaxform.mesh.meshes import Mesh
from jaxform.mesh.topology import positions_in_rows
from jaxform.tools import opening
from jaxform.tools.opening import FINE, FLAT, Heights, Opening
from jaxform.tools.patches import cells, close_sides

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
        opening.view_heights(opening.make_viewed_surface(closed.positions, closed.triangles), np.eye(3), FINE), polygon
    )
    closed = meshes.merge([closed, *patches])
    behind = cells(closed.positions[closed.triangles], polygon, found)
    sides = [] if found.male else close_sides(behind, closed)
    parts = [*fans, *curtain, *patches, *sides]
    if not parts:
        return Covers(None, 0, 0.0, 0, behind.hidden_ratio)
    joined = meshes.merge(parts)
    mesh = Mesh(joined.positions @ found.view.turn, joined.triangles)
    return Covers(mesh, len(fans) + len(patches) + len(sides), length, len(sides), behind.hidden_ratio)


def _fans(turned: Array, triangles: Integers, found: Opening, size: float) -> list[Mesh]:
    """A cover on each open rim of a shell, entirely behind the clamp plane, not around the formed surface."""
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
    return -outlines.local_minimum(np.where(np.isfinite(view.height), -view.height, np.inf), 3)


def _patches(view: Heights, polygon: Array) -> list[Mesh]:
    """Covers on see-through holes, at the height of their surroundings."""
    through = ~np.isfinite(view.height) & outlines.dilate(view.inside_polygon(polygon), -2)
    part, count = outlines.label_parts(through)
    made = []
    for one in range(1, count + 1):
        hole = part == one
        around = outlines.dilate(hole, 2) & np.isfinite(view.height)
        if not around.any():
            continue
        rim, rise = view.places(around), view.height[around]
        corners = outlines.hull(np.concatenate([rim, view.places(hole)]))
        nearest = np.argmin(np.linalg.norm(corners[:, None] - rim, axis=2), axis=1)
        points = np.insert(corners, 2, rise[nearest], axis=1)
        made.append(fan(np.stack([points, np.roll(points, -1, axis=0)], axis=1)))
    return made


# Open surfaces, such as a scan of a face: which way they face, where they end, and what closes them. On the host.

_OPEN = 0.02  # of the area, that the rims must span: else the surface is closed, but for cracks
_ALONG = np.cos(np.radians(10))  # within so much of an axis, a rim is meant to lie across it
_FACES = 0.3  # of the area that rims span, the least by which the surface faces one way
_SHORT = 1e-9
_FLAT = 1e-6  # of the largest moment of a piece's areas, the second one of a flat piece


def find_rims(mold: Mesh) -> list[Integers] | None:
    """Edges (k, 2) of each open rim of a mold, seams left out; None where it is closed, but for cracks."""
    edges, rim = topology.open_rims(_curved_triangles(mold), len(mold.positions))
    if not len(edges):
        return None
    seams = find_seams(mold.positions, edges, SEAM * meshes.size(mold.positions))
    in_seam = np.bincount(rim, seams) > 0.5 * np.bincount(rim)
    rims: list[Integers] = [edges[rim == one] for one in np.unique(rim) if not in_seam[one]]
    total = volumes.areas(mold.positions, mold.triangles).sum()
    largest = max((np.linalg.norm(_vector_area(mold.positions, one)) for one in rims), default=0.0)
    return rims if largest > _OPEN * total else None


def _curved_triangles(mold: Mesh) -> Integers:
    """The triangles (k, 3) of the pieces of a mold that are not flat, as a platen is."""
    piece = topology.components(mold.triangles, len(mold.positions))[mold.triangles[:, 0]]
    corners = mold.positions[mold.triangles]
    across = 0.5 * np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    # All normals of a flat piece are along one line: the moment of its areas has one eigenvalue.
    weight = np.linalg.norm(across, axis=1)
    moment = across[:, :, None] * across[:, None] / np.maximum(weight, 1e-300)[:, None, None]
    total = np.stack([np.bincount(piece, moment[:, i, j]) for i in range(3) for j in range(3)], axis=1)
    values = np.linalg.eigvalsh(total.reshape(-1, 3, 3))
    return mold.triangles[(values[:, 1] > _FLAT * values[:, 2])[piece]]


def _vector_area(positions: Array, edges: Integers) -> Array:
    """The vector area (3,) [m^2] of a fan over a closed line of edges (k, 2), which run either way."""
    ends = positions[edges] - positions[edges].mean((0, 1))
    ends = ends[np.linalg.norm(np.cross(ends[:, 0], ends[:, 1]), axis=1) > _SHORT * np.ptp(ends) ** 2]
    if not len(ends):
        return np.zeros(3)
    areas = 0.5 * np.cross(ends[:, 0], ends[:, 1])
    # The plane of the line, by which each edge is given its sense.
    points = positions[np.unique(edges)]
    normal = np.linalg.svd(points - points.mean(0), full_matrices=False)[2][2]
    return normal * abs(areas @ normal).sum()


def facing_fraction(mold: Mesh, direction: Array) -> float:
    """The share of a surface that faces a direction (3,): from -1 to 1 of the area that it has across it.

    Parts whose triangles turn differently are made to turn as most of their area does.
    """
    corners = mold.positions[mold.triangles]
    across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    part, sign = topology.orientations(mold.triangles)
    area = np.linalg.norm(across, axis=1)
    majority = np.where(np.bincount(part, sign * area) < 0, -1.0, 1.0)
    along = (across @ direction) * sign * majority[part]
    return float(along.sum() / max(np.abs(along).sum(), _SHORT * area.sum()))


def outward_direction(mold: Mesh, rims: list[Integers]) -> Array:
    """The unit vector (3,) across the largest rim to the side on which the surface bulges; an axis where it is near."""
    spanned = np.array([_vector_area(mold.positions, edges) for edges in rims])
    largest = int(np.argmax(np.linalg.norm(spanned, axis=1)))
    normal = spanned[largest] / np.linalg.norm(spanned[largest])
    area = volumes.areas(mold.positions, mold.triangles)
    middle = np.average(mold.positions[mold.triangles].mean(1), axis=0, weights=area)
    rim = mold.positions[rims[largest]].mean((0, 1))
    normal = normal * (1.0 if normal @ (middle - rim) >= 0 else -1.0)
    axis = int(np.argmax(np.abs(normal)))
    if abs(normal[axis]) >= _ALONG:
        return np.eye(3)[axis] * np.sign(normal[axis])
    return normal


def faces_outward(mold: Mesh, direction: Array) -> bool | None:
    """True when a surface that bulges to a direction (3,) faces it by its triangles' orientation; None if undecided."""
    share = facing_fraction(mold, direction)
    return None if abs(share) < _FACES else share > 0


def close_rims(mold: Mesh, rims: list[Integers], turn: Array, base: float) -> tuple[list[Mesh], list[Mesh]]:
    """Walls from the outer rims of a mold down to a base, and covers on its holes, after turning.

    Args:
        mold: Welded, not turned.
        rims: Edges (k, 2) of its open rims.
        turn: Rotation (3, 3), after which the base is where z is largest.
        base: Height of the base [m], after turning.
    """
    turned = mold.positions @ turn.T
    tolerance = opening.FLAT * meshes.size(turned)
    walls, fans = [], []
    for line, outer in zip(rims, _outer(mold, rims, turned), strict=True):
        if not outer:
            fans.append(fan(turned[line]))
        elif (turned[line][..., 2] < base - tolerance).any():
            walls.append(_walls(turned[line], base))
    return walls, fans


def _outer(mold: Mesh, rims: list[Integers], turned: Array) -> NDArray[np.bool_]:
    """Mask of the outer rims: of those of one piece the one that is nearest to the base."""
    piece = topology.components(mold.triangles, len(turned))
    depth = np.array([turned[line][..., 2].mean() for line in rims])
    owner = np.array([piece[line[0, 0]] for line in rims])
    lowest = np.full(piece.max() + 1, -np.inf)
    np.maximum.at(lowest, owner, depth)
    return depth >= lowest[owner]


def _walls(edges: Array, base: float) -> Mesh:
    """Triangles from edges (k, 2, 3) [m] straight to z = base."""
    begin, end = edges[:, 0], edges[:, 1]
    below = [np.column_stack([some[:, :2], np.full(len(some), base)]) for some in (begin, end)]
    number = np.arange(len(edges))
    count = len(edges)
    one = np.stack([number, number + count, number + 3 * count], axis=1)
    other = np.stack([number, number + 3 * count, number + 2 * count], axis=1)
    points = np.concatenate([begin, end, *below])
    # Where the rim is on the base there is nothing to close.
    return meshes.drop_degenerate(meshes.weld(Mesh(points, np.concatenate([one, other]).astype(np.int32))))[0]

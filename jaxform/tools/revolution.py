"""Bottles and bodies of revolution from their surface: the axis, the whole from a half, the profile. On the host."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull, QhullError

from jaxform.core.errors import InputError
from jaxform.mesh import meshes, topology
from jaxform.mesh.meshes import Mesh

Array = NDArray[np.float64]

TOP = 0.01  # of the length, that is cut off at the neck: the rim, which joins the inside and the outside
_SLICE = 0.02  # of the length: where sections at the two ends are compared
NARROW = 0.95  # width of the neck over that of the bottle, of circles of the same area, at most
_NECK_ERROR, _PER_WIDTH = 0.6, 0.3  # of what is a neck, at most; and what a neck as wide as the bottle counts
_DEPTHS = (0.04, 0.08, 0.12)  # of a neck's width, below its end, where its sections are compared
_COMPACT, _END_AREA, _ENDS_TRIED = 0.5, 2e-4, 12  # of the flat end of a neck; its area over the size squared
_FACES, _CUTS_TRIED = 100, 6  # flat faces of a hull, and those of them in which a half may have been cut
_ALIKE, _SAME = 5e-3, 1.0 - 4e-5  # between normals of one flat face; cosine between directions that are one
FLAT = 1e-5  # of the size: what is as near to a plane lies in it
_CUT = 0.5  # of the area that the hull of a half covers, that of its cut face at least; and of its open edges
_WHOLE = 0.97  # of the length of a half, along which its cut reaches at least
_STEEP = 0.3  # sine of the angle between an axis and what is about along it, at most
_ALIGNED = 4e-5  # cosine below 1 of an axis that is taken for x, y or z
_STEEPER = (_STEEP, _STEEP, 0.15, 0.15, 0.08, 0.08, 0.04, 0.04)  # as the axis becomes closer
_AROUND = 0.1  # of the area of sides in one direction, that of those across at least
_NECK_END = 0.1  # of the length, in which a bottle has its neck


def find_axis(mesh: Mesh) -> tuple[Mesh, Array]:
    """The whole of a bottle, from its surface or half of it, and its axis (3,), towards its neck; x, y or z if near.

    Of the directions that the axis may have, it is the one at whose end the bottle is most like a neck: narrow, round
    and as wide below the end as there. Without a neck, it is the longest direction, towards the narrower end.
    """
    faces = flat_faces(mesh.positions[np.unique(mesh.triangles)])
    cuts = [normal for normal, _ in faces[:_CUTS_TRIED]]
    found = list[tuple[float, Array, Mesh]]()
    for way in axis_candidates(mesh, faces):
        # The cut of a half is sought only where the end is narrow, as the whole's is then.
        ends = [axis for axis in (way, -way) if np.isfinite(neck_error(mesh, axis))]
        whole = _complete_half(mesh, way, cuts) if ends else mesh
        found += [(neck_error(whole, axis), axis, whole) for axis in ends]
    error, axis, whole = min(found, key=lambda each: each[0], default=(np.inf, np.zeros(3), mesh))
    if error > _NECK_ERROR:
        axis = _longest_direction(mesh)
        whole = _complete_half(mesh, axis, cuts)
        points = whole.positions[np.unique(whole.triangles)]
        axis = axis if _width_at_end(points, axis) <= _width_at_end(points, -axis) else -axis
    return whole, _refine_axis(whole, axis)


def _longest_direction(mesh: Mesh) -> Array:
    """The direction (3,) in which a surface is longest; x, y or z if it is about as long along that."""
    points = mesh.positions[np.unique(mesh.triangles)]
    principal = np.linalg.svd(points - points.mean(0), full_matrices=False)[2][0]
    extents = np.ptp(points, axis=0)
    best = int(np.argmax(extents))
    return principal if float(np.ptp(points @ principal)) > 1.02 * extents[best] else np.eye(3)[best]


def axis_candidates(mesh: Mesh, faces: list[tuple[Array, float]]) -> list[Array]:
    """Directions (3,) that the axis may have, either way.

    They are those of the file, of the flat and compact ends of the surface, as that of a neck, of its extent, and those
    near these to which its sides are parallel.

    Args:
        mesh: The surface.
        faces: Those of `flat_faces`.
    """
    points = mesh.positions[np.unique(mesh.triangles)]
    principal = np.linalg.svd(points - points.mean(0), full_matrices=False)[2]
    ends = [way for way, compactness in faces if compactness > _COMPACT]
    ways: list[Array] = [*np.eye(3), *ends[:_ENDS_TRIED], *principal]
    for way in list(ways):
        for steep in _STEEPER:
            if (closer := _side_axis(mesh, way, steep)) is not None:
                way = closer
        ways.append(way)
    kept = list[Array]()
    for way in ways:
        if all(abs(way @ other) < _SAME for other in kept):
            kept.append(way)
    return kept


def flat_faces(points: Array) -> list[tuple[Array, float]]:
    """Normals (3,) of the flat faces of the hull of points (n, 3), largest first, and the compactness of each."""
    try:
        hull = ConvexHull(points)
    except (QhullError, ValueError):
        return []  # they lie in a plane
    corners, normal = points[hull.simplices], hull.equations[:, :3]
    area = 0.5 * np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    _, group = np.unique(np.round(normal / _ALIKE), axis=0, return_inverse=True)
    total, found = np.bincount(group, area), list[tuple[Array, float]]()
    for number in np.argsort(-total):
        if len(found) == _FACES or total[number] < _END_AREA * meshes.size(points) ** 2:
            break
        there = group == number
        way = area[there] @ normal[there]
        way /= np.linalg.norm(way)
        found.append((way, _compactness(*hull_sizes(corners[there].reshape(-1, 3) @ plane_axes(way).T))))
    return found


def plane_axes(normal: Array) -> Array:
    """Two axes (2, 3) across a direction (3,)."""
    first = np.cross(normal, np.eye(3)[np.argmin(np.abs(normal))])
    first /= np.linalg.norm(first)
    axes: Array = np.asarray([first, np.cross(normal, first)], np.float64)
    return axes


def hull_sizes(points: Array) -> tuple[float, float]:
    """Area and perimeter of the hull of points (n, 2); none of points on a line."""
    try:
        found = ConvexHull(points)
    except (QhullError, ValueError):
        return 0.0, 0.0
    return float(found.volume), float(found.area)


def _compactness(area: float, perimeter: float) -> float:
    """An area over that of a circle with its perimeter."""
    return 4.0 * np.pi * area / perimeter**2 if perimeter > 0.0 else 0.0


def neck_error(mesh: Mesh, axis: Array) -> float:
    """A measure of how far the end of a surface along an axis is from a neck: 0 for a narrow cylinder.

    It is the sum of what sections below the end differ from circles and from each other, and of their width over that
    of the surface; infinite where these are as wide as the surface.
    """
    section, (low, high), wide = sections_across(mesh, axis)
    width = 2.0 * np.sqrt(section(high - TOP * (high - low))[0] / np.pi)
    if not 0.0 < 0.25 * np.pi * width**2 < NARROW**2 * wide:
        return np.inf
    sections = [section(high - share * width) for share in _DEPTHS]
    areas = [area for area, _ in sections]
    if min(areas) <= 0.0 or max(areas) >= NARROW**2 * wide:
        return np.inf
    out_of_round = 1.0 - min(_compactness(*each) for each in sections)
    return out_of_round + max(areas) / min(areas) - 1.0 + _PER_WIDTH * float(np.sqrt(areas[0] / wide))


def sections_across(
    mesh: Mesh, axis: Array
) -> tuple[Callable[[float], tuple[float, float]], tuple[float, float], float]:
    """Sections of a surface across an axis (3,).

    Returns:
        The area [m^2] and perimeter [m] of the hull of the section at a level, as a function of it; the levels [m] of
        both ends; the area [m^2] of the hull of the surface seen along the axis.
    """
    across = plane_axes(axis)
    along = mesh.positions @ axis
    used = np.unique(mesh.triangles)
    wide, _ = hull_sizes(mesh.positions[used] @ across.T)
    one, other = mesh.triangles.ravel(), mesh.triangles[:, [1, 2, 0]].ravel()

    def section(level: float) -> tuple[float, float]:
        crossed = (along[one] > level) != (along[other] > level)
        first, second = one[crossed], other[crossed]
        share = ((level - along[first]) / (along[second] - along[first]))[:, None]
        return hull_sizes(((1.0 - share) * mesh.positions[first] + share * mesh.positions[second]) @ across.T)

    return section, (float(along[used].min()), float(along[used].max())), wide


def _refine_axis(mesh: Mesh, axis: Array) -> Array:
    """The axis of a bottle to which the sides of its neck are parallel, near a given one (3,); x, y or z if near."""
    along = mesh.positions[mesh.triangles] @ axis
    near = along.max(1) > along.max() - _NECK_END * np.ptp(along)
    neck = Mesh(mesh.positions, mesh.triangles[near], {})
    for steep in _STEEPER[3::2]:
        if (closer := _side_axis(neck, axis, steep)) is not None:
            axis = closer
    nearest = int(np.argmax(np.abs(axis)))
    aligned = abs(axis[nearest]) > 1.0 - _ALIGNED
    return np.eye(3)[nearest] * np.sign(axis[nearest]) if aligned else axis


def _side_axis(mesh: Mesh, axis: Array, steep: float) -> Array | None:
    """The direction to which faces are most nearly parallel; None without one.

    Of the faces whose angle with an axis has at most this sine.
    """
    corners = mesh.positions[mesh.triangles]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = np.linalg.norm(normal, axis=1)
    sides = (area > 0.0) & (np.abs(normal @ axis) < steep * area)
    if not sides.any():
        return None
    sizes, ways = np.linalg.eigh(np.einsum("ni,nj->ij", normal[sides] / area[sides, None], normal[sides]))
    # Sides all around have normals in two directions, but for the third.
    around = sizes[0] < _STEEP * sizes[1] and sizes[1] > _AROUND * sizes[2]
    return ways[:, 0] * np.sign(ways[:, 0] @ axis) if around else None


def _width_at_end(points: Array, axis: Array) -> float:
    """The width [m] of points (n, 3) near the end along an axis, across it."""
    along = points @ axis
    near = points[along >= along.max() - _SLICE * np.ptp(along)]
    across = near - np.outer(near @ axis, axis)
    return float(np.linalg.norm(np.ptp(across, axis=0)))


def _complete_half(mesh: Mesh, axis: Array, normals: list[Array]) -> Mesh:
    """The whole of a mesh that is half of a bottle, open or closed by a flat face along the axis; else the mesh.

    The axis is about that of the bottle; the cut is across x, y or z, or has one of some normals (3,). It reaches from
    the bottom to the end of the neck; a flat side of a bottle ends below the neck.
    """
    positions, triangles = mesh.positions, mesh.triangles
    used = np.unique(triangles)
    size, edges = meshes.size(positions[used]), topology.boundary_edges(triangles)
    length = np.linalg.norm(positions[edges[:, 1]] - positions[edges[:, 0]], axis=1)
    across = [normal for normal in (*np.eye(3), *normals) if abs(normal @ axis) < _STEEP]
    for way in (sign * normal for normal in across for sign in (1.0, -1.0)):
        level = (positions[used] @ way).min()
        there = np.abs(positions @ way - level) <= FLAT * size
        flat = there[triangles].all(1)
        face = positions[np.unique(triangles[flat])] @ plane_axes(way).T if flat.any() else np.zeros((0, 2))
        closed = hull_sizes(face)[0] >= _CUT * hull_sizes(positions[used] @ plane_axes(way).T)[0]
        opened = len(edges) > 0 and length[there[edges].all(1)].sum() >= _CUT * length.sum()
        along = positions[used] @ (axis - (axis @ way) * way)
        if (closed or opened) and np.ptp(along[there[used]]) >= _WHOLE * np.ptp(along):
            # The cut is put exactly into its plane, so that the halves meet.
            above = np.where(there, 0.0, positions @ way - level)
            half = Mesh(positions - np.outer(np.where(there, positions @ way - level, 0.0), way), triangles[~flat], {})
            image = half.positions - 2.0 * np.outer(above, way)
            both = meshes.merge([half, Mesh(image, half.triangles[:, ::-1], {})])
            return meshes.weld(both)
    return mesh


# Bodies of revolution, and the profile of their outside.

_HALF_PLANES = 16  # through the axis, in which the profile is found
_FIRST = 0.0123  # angle of the first of them: no vertex of a regular mesh lies in it
_LEVELS = 400  # along the axis, and along the radius, at which the outside is found
ROUND = 0.04  # of the radius, its variation around the axis, root mean square, in a body of revolution at most
_FINE = 0.002  # of the body's length, by which a simplified profile deviates at most
_ENDS = 1e-6  # of the length, left out at both ends, where caps are


class Revolution(NamedTuple):
    """A body of revolution.

    Attributes:
        origin: Intersection of the axis and the plane of the narrow end, the neck (3,) [m].
        axis: Unit vector along the axis from the neck to the other end (3,).
        profile: Points r, z [m] of the outside, z from the neck on, from the axis at the far end to the neck (k, 2).
        variation: Variation of the radius around the axis, relative, root mean square.
    """

    origin: Array
    axis: Array
    profile: Array
    variation: float

    @property
    def length(self) -> float:
        """Length along the axis [m]."""
        return float(self.profile[:, 1].max())

    @property
    def radius(self) -> float:
        """Largest radius [m]."""
        return float(self.profile[:, 0].max())

    @property
    def neck(self) -> float:
        """Radius of the neck at its end [m]."""
        return float(self.profile[-1, 0])


def find_revolution(mesh: Mesh) -> Revolution:
    """The body of revolution that a welded surface [m] is, with the neck at its narrower end.

    Raises:
        InputError: It is none.
    """
    corners = mesh.positions[mesh.triangles]
    area = 0.5 * np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    middle = (area @ corners.mean(1)) / area.sum()
    ways = axis_candidates(mesh, flat_faces(mesh.positions[np.unique(mesh.triangles)]))
    best = min((_sections(corners, middle, way) for way in ways), key=lambda found: found[2])
    axis, outside, variation = best
    if variation > ROUND:
        varies = f"its radius varies by {100 * variation:.0f} % around the best axis"
        problem = f"is not a body of revolution: {varies if np.isfinite(variation) else 'it surrounds no axis'}"
        raise InputError(problem, "give a bottle that is round, or write the scene by hand from stretch-blow-bottle")
    return _from_neck(corners, middle, axis, outside, variation)


def _in_bottle_frame(points: Array, middle: Array, axis: Array) -> Array:
    """Points (..., 3) with the axis as z and the middle as origin."""
    other = np.eye(3)[np.argmin(np.abs(axis))]
    across = np.cross(axis, other)
    across /= np.linalg.norm(across)
    frame: Array = np.asarray([across, np.cross(axis, across), axis], np.float64)
    return (points - middle) @ frame.T


def _segments(corners: Array, angle: float) -> Array:
    """Sections (n, 2, 2) [m] of triangles (m, 3, 3) about z with a half-plane at an angle: ends r, z."""
    cos, sin = np.cos(angle), np.sin(angle)
    along = corners[..., 0] * cos + corners[..., 1] * sin
    off = corners[..., 1] * cos - corners[..., 0] * sin
    cut = (off.min(1) < 0.0) & (off.max(1) > 0.0)
    along, off, height = along[cut], off[cut], corners[cut, :, 2]
    after = np.roll(np.arange(3), -1)
    crosses = off * off[:, after] < 0.0
    share = np.where(crosses, off / np.where(crosses, off - off[:, after], 1.0), 0.0)
    ends = np.stack([x + share * (x[:, after] - x) for x in (along, height)], axis=2)
    two = crosses.sum(1) == 2
    found = ends[two][crosses[two]].reshape(-1, 2, 2)
    return found[found[..., 0].max(1) > 0.0]


def _extreme(segments: Array, levels: Array, level_of: int, value_of: int, largest: bool) -> Array:
    """Largest or smallest value (k,) of segments (n, 2, 2) where they cross each level (k,); NaN where none does."""
    one, other = segments[:, 0, level_of][:, None], segments[:, 1, level_of][:, None]
    crosses = (np.minimum(one, other) <= levels) & (levels <= np.maximum(one, other)) & (one != other)
    share = np.clip((levels - one) / np.where(one != other, other - one, 1.0), 0.0, 1.0)
    first = segments[:, 0, value_of][:, None]
    values = first + share * (segments[:, 1, value_of][:, None] - first)
    found = np.where(crosses, values, -np.inf if largest else np.inf)
    found = found.max(0, initial=-np.inf) if largest else found.min(0, initial=np.inf)
    return np.where(np.isfinite(found), found, np.nan)


def _sections(corners: Array, middle: Array, axis: Array) -> tuple[Array, Array, float]:
    """An axis, the outer radius (levels, 2) over the height along it, and its variation around, relative."""
    turned = _in_bottle_frame(corners, middle, axis)
    low, high = turned[..., 2].min(), turned[..., 2].max()
    levels = np.linspace(low, high, _LEVELS + 1)
    inner = np.clip(levels, low + _ENDS * (high - low), high - _ENDS * (high - low))
    angles = _FIRST + 2.0 * np.pi * np.arange(_HALF_PLANES) / _HALF_PLANES
    radius = np.stack([_extreme(_segments(turned, angle), inner, 1, 0, True) for angle in angles])
    if np.isnan(radius).any():
        return axis, np.stack([np.nan_to_num(radius).max(0), levels], 1), np.inf
    outer = radius.max(0)
    variation = float(np.sqrt(np.mean(np.square(radius - radius.mean(0))) / np.mean(np.square(outer))))
    return axis, np.stack([outer, levels], axis=1), variation


def _from_neck(corners: Array, middle: Array, axis: Array, outside: Array, variation: float) -> Revolution:
    """The body with z from the neck on."""
    tenth = _LEVELS // 10
    if outside[:tenth, 0].mean() > outside[-tenth:, 0].mean():
        axis, outside = -axis, (outside * [1.0, -1.0])[::-1]
    origin = middle + outside[0, 1] * axis
    turned = _in_bottle_frame(corners, origin, axis)
    side = outside - [0.0, outside[0, 1]]
    length = side[-1, 1]
    # Seen from below, the bottom: from the axis to the ring on which the body stands.
    angles = _FIRST + 2.0 * np.pi * np.arange(_HALF_PLANES) / _HALF_PLANES
    levels = np.linspace(0.0, side[:, 0].max(), _LEVELS + 1)[1:-1]
    segments = [_segments(turned, angle) for angle in angles]
    bottom = np.nanmax(np.stack([_extreme(each, levels, 0, 1, True) for each in segments]), axis=0)
    stands = int(np.flatnonzero(bottom >= bottom.max() - 1e-4 * length)[-1])
    base = np.stack([levels, bottom], axis=1)[: stands + 1]
    above = side[side[:, 1] < bottom[stands] - _FINE * length]
    points = np.concatenate([[[0.0, base[0, 1]]], base, above[::-1]])
    return Revolution(origin, axis, simplify(points, _FINE * length), variation)


def mean_revolution(mesh: Mesh) -> tuple[Revolution, float]:
    """The body of revolution with the mean section of a surface [m] about z, from the neck at z = 0 on; its neck.

    Returns:
        The body, and the least distance [m] of the surface from the axis in its upper quarter.
    """
    corners = mesh.positions[mesh.triangles]
    length = float(mesh.positions[:, 2].max())
    levels = np.linspace(0.0, length, _LEVELS + 1)
    angles = _FIRST + 2.0 * np.pi * np.arange(_HALF_PLANES) / _HALF_PLANES
    segments = [_segments(corners, angle) for angle in angles]
    radius = np.stack([_extreme(each, levels, 1, 0, True) for each in segments])
    side = np.stack([np.sqrt(np.nanmean(np.square(radius[:, :-1]), axis=0)), levels[:-1]], axis=1)
    near = max(float(side[:, 0].max()) / _LEVELS, 1e-9)
    bottom = np.nanmax([_extreme(each, np.array([near]), 0, 1, True)[0] for each in segments])
    # The side down to where it turns in, then straight to the middle of the bottom.
    last = int(np.flatnonzero(side[:, 0] >= 0.5 * side[:, 0].max())[-1])
    points = np.concatenate([[[0.0, bottom]], side[last::-1]])
    profile = simplify(points, _FINE * length)
    variation = float(np.sqrt(np.nanmean(np.square(radius[:, :-1] - side[:, 0])) / np.mean(np.square(side[:, 0]))))
    neck = float(np.nanmin(radius[:, levels <= 0.25 * length]))
    return Revolution(np.zeros(3), np.eye(3)[2], profile, variation), neck


def simplify(points: Array, tolerance: float) -> Array:
    """The points (k, 2) of a line (n, 2) without which it would deviate by more than a tolerance."""
    kept = np.zeros(len(points), dtype=bool)
    kept[[0, -1]] = True
    waiting = [(0, len(points) - 1)]
    while waiting:
        begin, end = waiting.pop()
        if end - begin < 2:
            continue
        way, away = points[end] - points[begin], points[begin + 1 : end] - points[begin]
        share = np.clip(away @ way / max(float(way @ way), 1e-300), 0.0, 1.0)
        distance = np.linalg.norm(away - share[:, None] * way, axis=1)
        if distance.max() > tolerance:
            farthest = begin + 1 + int(np.argmax(distance))
            kept[farthest] = True
            waiting += [(begin, farthest), (farthest, end)]
    return points[kept]

"""The axis of a bottle from its surface: candidates, the neck at one end, and the whole from a half. On the host."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull, QhullError

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

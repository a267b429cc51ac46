"""Bottles: their axis, neck and parting plane, the half of their outside, and round ones as bodies of revolution."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize_scalar
from scipy.spatial import ConvexHull, QhullError

from jaxform.core.errors import InputError
from jaxform.mesh import meshes, topology
from jaxform.mesh.meshes import Mesh
from jaxform.tools.distances import Distances

Array = NDArray[np.float64]
Index = NDArray[np.int32]

_TOP = 0.01  # of the length, that is cut off at the neck: the rim, which joins the inside and the outside
_SLICE = 0.02  # of the length: where sections at the two ends are compared
_NARROW = 0.95  # width of the neck over that of the bottle, of circles of the same area, at most
_NECK_ERROR, _PER_WIDTH = 0.6, 0.3  # of what is a neck, at most; and what a neck as wide as the bottle counts
_DEPTHS = (0.04, 0.08, 0.12)  # of a neck's width, below its end, where its sections are compared
_COMPACT, _END_AREA, _ENDS_TRIED = 0.5, 2e-4, 12  # of the flat end of a neck; its area over the size squared
_FACES, _CUTS_TRIED = 100, 6  # flat faces of a hull, and those of them in which a half may have been cut
_ALIKE, _SAME = 5e-3, 1.0 - 4e-5  # between normals of one flat face; cosine between directions that are one
_SAMPLES = 1500  # vertices that are mirrored
_SYMMETRIC = 0.002  # of the length, for a bottle of which a half or a quarter is modelled
_MIRRORED = 0.01  # of the length, root mean square, by which a mirrored bottle deviates from itself at most
_TURNS = 24  # directions across the axis that are tried as normals of the parting plane
_FLAT = 1e-5  # of the size: what is as near to a plane lies in it
_CUT = 0.5  # of the area that the hull of a half covers, that of its cut face at least; and of its open edges
_WHOLE = 0.97  # of the length of a half, along which its cut reaches at least
_STEEP = 0.3  # sine of the angle between an axis and what is about along it, at most
_ALIGNED = 4e-5  # cosine below 1 of an axis that is taken for x, y or z
_STEEPER = (_STEEP, _STEEP, 0.15, 0.15, 0.08, 0.08, 0.04, 0.04)  # as the axis becomes closer
_AROUND = 0.1  # of the area of sides in one direction, that of those across at least


class BottleHalf(NamedTuple):
    """Half of the outside of a bottle, x >= 0, open in x = 0 and at the neck; z along the axis from the bottom.

    Attributes:
        mesh: The surface [m].
        length: Length of the bottle [m].
        neck: Radius of the neck's end, of a circle of the same width in the parting plane [m].
        area: Area of the half [m^2].
        rotation: Rows are the axes x, y, z in those of the file (3, 3).
        origin: Place of the origin in the file [m]: below the middle of the neck, at the height of the bottom.
    """

    mesh: Mesh
    length: float
    neck: float
    area: float
    rotation: Array
    origin: Array


class BottleBody(NamedTuple):
    """The outside of a bottle that is blown whole, open above the neck; z along the axis from the neck to the bottom.

    Attributes:
        mesh: The surface [m].
        symmetry: "quarter" where it is symmetric across x and y, "half" where it is across x, else "none".
        rotation: Rows are the axes x, y, z in those of the file (3, 3).
        origin: Place of the origin in the file [m]: the middle of the neck, at a small distance below its end.
    """

    mesh: Mesh
    symmetry: str
    rotation: Array
    origin: Array


Outside = tuple[Mesh, Array, Array, float, float]
"""A bottle's outside in the frame of its file, cut off below the end of its neck: the surface [m], the axis towards the
neck (3,), the middle of the cut (3,) [m], and the places of bottom and cut along the axis [m]."""


def find_bottle(mesh: Mesh) -> BottleHalf:
    """Half of a bottle, from its surface [m], welded: the whole, closed or open at the neck, or a half of it.

    Raises:
        InputError: It has no neck, or no plane of symmetry along its axis.
    """
    outside = find_outside(mesh)
    opened, axis, rim, low, cut = outside
    normal = _parting_normal(outside)
    half = clip(opened, normal, float(rim @ normal), keep_below=False)
    rotation = np.stack([normal, np.cross(axis, normal), axis])
    origin = rim + (low - rim @ axis) * axis
    size = meshes.size(mesh.positions[np.unique(mesh.triangles)])
    places = (half.positions - origin) @ rotation.T
    places[np.abs(places[:, 0]) <= _FLAT * size, 0] = 0.0
    top = np.abs(places[:, 2] - (cut - low)) <= _FLAT * size
    places[top, 2] = cut - low
    triangles = half.triangles
    corners = places[triangles]
    area = 0.5 * np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    in_plane = top & (places[:, 0] == 0.0)
    neck = 0.5 * float(np.ptp(places[in_plane, 1])) if in_plane.any() else 0.0
    if neck <= 0.0:
        raise InputError("has no open end at its neck in the parting plane", "repair the mesh of the bottle")
    return BottleHalf(Mesh(places, triangles, {}), float(cut - low), neck, float(area.sum()), rotation, origin)


def find_body(mesh: Mesh) -> BottleBody:
    """The outside of a bottle of any section, from its surface [m], as for `find_bottle`.

    Raises:
        InputError: It has no neck, or a handle.
    """
    outside = find_outside(mesh)
    opened, axis, rim, low, cut = outside
    if (handles := topology.count_handles(opened.triangles)) > 0:
        problem = f"has {handles} handle{'s' * (handles > 1)}, or holes through it, around which no preform is blown"
        raise InputError(problem, "use --process extrusion-blow, or leave the handle out of the file")
    x, symmetry = _symmetry(outside)
    origin = rim - _TOP * (cut - low) * axis
    rotation = np.stack([x, np.cross(-axis, x), -axis])
    places = (opened.positions - origin) @ rotation.T
    return BottleBody(Mesh(places, opened.triangles, {}), symmetry, rotation, origin)


def _symmetry(outside: Outside) -> tuple[Array, str]:
    """The direction x (3,) of a bottle's frame, and the symmetry of the bottle in it, as `BottleBody`."""
    planes = _MirrorPlanes(outside)
    angles, limit = planes.best_angles(), _SYMMETRIC * (outside[4] - outside[3])
    pairs = [max(planes.error(angle), planes.error(angle + 0.5 * np.pi)) for angle in angles]
    if min(pairs) <= limit:
        return planes.normal(angles[int(np.argmin(pairs))]), "quarter"
    errors = [planes.error(angle) for angle in angles]
    return planes.normal(angles[int(np.argmin(errors))]), "half" if min(errors) <= limit else "none"


def find_outside(mesh: Mesh) -> Outside:
    """The outside of a bottle, whole, and cut off at its neck."""
    used = np.unique(mesh.triangles)
    size = meshes.size(mesh.positions[used])
    whole, axis = _find_axis(mesh)
    along = whole.positions[np.unique(whole.triangles)] @ axis
    low, high = along.min(), along.max()
    cut = high - _TOP * (high - low)
    opened = _largest_part(clip(whole, axis, cut, keep_below=True))
    return opened, axis, _section_middle(opened, axis, cut, size), float(low), float(cut)


def clip(mesh: Mesh, normal: Array, level: float, *, keep_below: bool) -> Mesh:
    """The part of a surface on one side of the plane normal . x = level, open where it was cut.

    Vertices that are nearly in the plane are put there; triangles in the plane are left out.
    """
    side = (mesh.positions @ normal - level) * (-1.0 if keep_below else 1.0)
    near = _FLAT * meshes.size(mesh.positions[np.unique(mesh.triangles)])
    flat = np.abs(side) <= near
    positions = mesh.positions - np.where(flat, mesh.positions @ normal - level, 0.0)[:, None] * normal
    side = np.where(flat, 0.0, side)
    of_corners = side[mesh.triangles]
    whole = (of_corners >= 0.0).all(1) & (of_corners > 0.0).any(1)
    crossed = (of_corners > 0.0).any(1) & (of_corners < 0.0).any(1)
    places, triangles, cuts = [positions], [mesh.triangles[whole]], dict[tuple[int, int], int]()
    count, added, made = len(positions), list[Array](), list[list[int]]()
    for corner in mesh.triangles[crossed].tolist():
        polygon: list[int] = []
        for one, other in zip(corner, [*corner[1:], corner[0]], strict=True):
            if side[one] >= 0.0:
                polygon.append(one)
            if side[one] * side[other] < 0.0:
                key = (min(one, other), max(one, other))
                if key not in cuts:
                    share = side[key[0]] / (side[key[0]] - side[key[1]])
                    cuts[key] = count + len(added)
                    added.append(positions[key[0]] + share * (positions[key[1]] - positions[key[0]]))
                polygon.append(cuts[key])
        made += [[polygon[0], polygon[k], polygon[k + 1]] for k in range(1, len(polygon) - 1)]
    if added:
        places.append(np.array(added))
        triangles.append(np.array(made, np.int32))
    joined = np.concatenate(places)
    faces = np.concatenate(triangles)
    faces = faces[~meshes.find_degenerate(joined, faces)]
    kept, renumbered = np.unique(faces, return_inverse=True)
    return Mesh(joined[kept], renumbered.reshape(-1, 3).astype(np.int32), {})


def _find_axis(mesh: Mesh) -> tuple[Mesh, Array]:
    """The whole of a bottle, from its surface or half of it, and its axis (3,), towards its neck; x, y or z if near.

    Of the directions that the axis may have, it is the one at whose end the bottle is most like a neck: narrow, round
    and as wide below the end as there. Without a neck, it is the longest direction, towards the narrower end.
    """
    faces = _flat_faces(mesh.positions[np.unique(mesh.triangles)])
    cuts = [normal for normal, _ in faces[:_CUTS_TRIED]]
    found = list[tuple[float, Array, Mesh]]()
    for way in _axis_candidates(mesh, faces):
        # The cut of a half is sought only where the end is narrow, as the whole's is then.
        ends = [axis for axis in (way, -way) if np.isfinite(_neck_error(mesh, axis))]
        whole = _complete_half(mesh, way, cuts) if ends else mesh
        found += [(_neck_error(whole, axis), axis, whole) for axis in ends]
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


def _axis_candidates(mesh: Mesh, faces: list[tuple[Array, float]]) -> list[Array]:
    """Directions (3,) that the axis may have, either way.

    They are those of the file, of the flat and compact ends of the surface, as that of a neck, of its extent, and those
    near these to which its sides are parallel.

    Args:
        mesh: The surface.
        faces: Those of `_flat_faces`.
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


def _flat_faces(points: Array) -> list[tuple[Array, float]]:
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
        found.append((way, _compactness(*_hull_sizes(corners[there].reshape(-1, 3) @ _plane_axes(way).T))))
    return found


def _plane_axes(normal: Array) -> Array:
    """Two axes (2, 3) across a direction (3,)."""
    first = np.cross(normal, np.eye(3)[np.argmin(np.abs(normal))])
    first /= np.linalg.norm(first)
    axes: Array = np.asarray([first, np.cross(normal, first)], np.float64)
    return axes


def _hull_sizes(points: Array) -> tuple[float, float]:
    """Area and perimeter of the hull of points (n, 2); none of points on a line."""
    try:
        found = ConvexHull(points)
    except (QhullError, ValueError):
        return 0.0, 0.0
    return float(found.volume), float(found.area)


def _compactness(area: float, perimeter: float) -> float:
    """An area over that of a circle with its perimeter."""
    return 4.0 * np.pi * area / perimeter**2 if perimeter > 0.0 else 0.0


def _neck_error(mesh: Mesh, axis: Array) -> float:
    """A measure of how far the end of a surface along an axis is from a neck: 0 for a narrow cylinder.

    It is the sum of what sections below the end differ from circles and from each other, and of their width over that
    of the surface; infinite where these are as wide as the surface.
    """
    section, (low, high), wide = _sections_across(mesh, axis)
    width = 2.0 * np.sqrt(section(high - _TOP * (high - low))[0] / np.pi)
    if not 0.0 < 0.25 * np.pi * width**2 < _NARROW**2 * wide:
        return np.inf
    sections = [section(high - share * width) for share in _DEPTHS]
    areas = [area for area, _ in sections]
    if min(areas) <= 0.0 or max(areas) >= _NARROW**2 * wide:
        return np.inf
    out_of_round = 1.0 - min(_compactness(*each) for each in sections)
    return out_of_round + max(areas) / min(areas) - 1.0 + _PER_WIDTH * float(np.sqrt(areas[0] / wide))


def _sections_across(
    mesh: Mesh, axis: Array
) -> tuple[Callable[[float], tuple[float, float]], tuple[float, float], float]:
    """Sections of a surface across an axis (3,).

    Returns:
        The area [m^2] and perimeter [m] of the hull of the section at a level, as a function of it; the levels [m] of
        both ends; the area [m^2] of the hull of the surface seen along the axis.
    """
    across = _plane_axes(axis)
    along = mesh.positions @ axis
    used = np.unique(mesh.triangles)
    wide, _ = _hull_sizes(mesh.positions[used] @ across.T)
    one, other = mesh.triangles.ravel(), mesh.triangles[:, [1, 2, 0]].ravel()

    def section(level: float) -> tuple[float, float]:
        crossed = (along[one] > level) != (along[other] > level)
        first, second = one[crossed], other[crossed]
        share = ((level - along[first]) / (along[second] - along[first]))[:, None]
        return _hull_sizes(((1.0 - share) * mesh.positions[first] + share * mesh.positions[second]) @ across.T)

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
        there = np.abs(positions @ way - level) <= _FLAT * size
        flat = there[triangles].all(1)
        face = positions[np.unique(triangles[flat])] @ _plane_axes(way).T if flat.any() else np.zeros((0, 2))
        closed = _hull_sizes(face)[0] >= _CUT * _hull_sizes(positions[used] @ _plane_axes(way).T)[0]
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


def _largest_part(mesh: Mesh) -> Mesh:
    """The connected part with the largest box: of a bottle with a wall, its outside."""
    parts = topology.components(mesh.triangles, len(mesh.positions))[mesh.triangles[:, 0]]
    numbers = np.unique(parts)
    sizes = [meshes.size(mesh.positions[np.unique(mesh.triangles[parts == number])]) for number in numbers]
    kept, renumbered = np.unique(mesh.triangles[parts == numbers[int(np.argmax(sizes))]], return_inverse=True)
    return Mesh(mesh.positions[kept], renumbered.reshape(-1, 3).astype(np.int32), {})


def _section_middle(mesh: Mesh, axis: Array, level: float, size: float) -> Array:
    """The middle (3,) [m] of the open end at a level along the axis."""
    edges = topology.boundary_edges(mesh.triangles)
    ends = mesh.positions[edges]
    there = (np.abs(ends @ axis - level) <= _FLAT * size).all(1)
    if not there.any():
        raise InputError("has no neck", "give the surface of a bottle")
    points = ends[there].reshape(-1, 3)
    width = np.linalg.norm(points - points.mean(0), axis=1).max()
    widest = np.sqrt(_hull_sizes(mesh.positions @ _plane_axes(axis).T)[0] / np.pi)
    if width > _NARROW * widest:
        problem = f"has no neck: its narrow end is {2e3 * width:.3g} mm wide, and its body {2e3 * widest:.3g} mm"
        raise InputError(problem, "leave --process out for a sheet that is formed into it")
    length = np.linalg.norm(ends[there, 1] - ends[there, 0], axis=1)
    return np.average(ends[there].mean(1), axis=0, weights=length)


def _parting_normal(outside: Outside) -> Array:
    """The normal of the plane of symmetry along the axis across which the bottle is shortest."""
    mesh, axis, *_ = outside
    length = float(np.ptp(mesh.positions @ axis))
    planes = _MirrorPlanes(outside)
    angles = planes.best_angles()
    error = np.array([planes.error(angle) for angle in angles])
    extent = np.array([float(np.ptp(mesh.positions @ planes.normal(angle))) for angle in angles])
    mirrored = error <= _MIRRORED * length
    if not mirrored.any():
        problem = (
            f"has no plane of symmetry through its neck: the best one leaves {1e3 * error.min():.3g} mm; such halves "
            "differ"
        )
        raise InputError(problem, "write the scene by hand, with one half as [mold] and the other as [[tool]]")
    # Among nearly equal widths the plane that fits best is taken.
    return planes.normal(angles[int(np.lexsort((error, np.round(extent / length, 2), ~mirrored))[0])])


class _MirrorPlanes:
    """Planes along the axis of a bottle through the middle of its neck, by the angle of their normal."""

    def __init__(self, outside: Outside) -> None:
        mesh, axis, self._rim, *_ = outside
        first = next(way for way in np.eye(3) if abs(way @ axis) < 0.9)
        first = first - (first @ axis) * axis
        self._first = first / np.linalg.norm(first)
        self._other = np.cross(axis, self._first)
        positions = mesh.positions
        self._length = float(np.ptp(positions @ axis))
        self._picked = positions[:: max(1, len(positions) // _SAMPLES)]
        self._surface = Distances(positions, mesh.triangles, self._length)

    def normal(self, angle: float) -> Array:
        """The normal (3,) of the plane at an angle."""
        return np.cos(angle) * self._first + np.sin(angle) * self._other

    def error(self, angle: float) -> float:
        """The distance of the bottle from its image in the plane [m], root mean square."""
        way = self.normal(angle)
        image = self._picked - 2.0 * np.outer((self._picked - self._rim) @ way, way)
        return float(np.sqrt(np.mean(np.square(self._surface.nearest(image).distance))))

    def best_angles(self) -> list[float]:
        """Evenly spaced angles, those between which the error is least moved to where it is, if that is elsewhere."""
        turn = np.pi / _TURNS
        angles = [float(angle) for angle in turn * np.arange(_TURNS)]
        errors = [self.error(angle) for angle in angles]
        for k in range(_TURNS):
            if errors[k] > min(errors[k - 1], errors[(k + 1) % _TURNS]) or errors[k] <= _FLAT * self._length:
                continue
            bounds = angles[k] - turn, angles[k] + turn
            found = minimize_scalar(self.error, bounds=bounds, method="bounded", options={"xatol": 1e-4})
            if found.fun < 0.9 * errors[k]:
                angles[k] = float(found.x)
        return angles


# Bodies of revolution: the axis of a surface, and the profile of its outside. On the host.

_HALF_PLANES, _FIRST = (
    16,
    0.0123,
)  # through the axis, in which the profile is found; the first one's angle, off vertices
_LEVELS = 400  # along the axis, and along the radius, at which the outside is found
_ROUND = 0.04  # of the radius, its variation around the axis, root mean square, in a body of revolution at most
_FINE = 0.002  # of the body's length, by which a simplified profile deviates at most
_NECK_END = 0.1  # of the length, in which a bottle has its neck
_HINT_ERROR, _BASE = 0.35, 0.97  # of the neck of what looks like a bottle; width of its base over its own, if short
_TIP, _NARROW_NECK = 0.1, 0.65  # of the largest radius, between which the radius of a neck is
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
    ways = _axis_candidates(mesh, _flat_faces(mesh.positions[np.unique(mesh.triangles)]))
    best = min((_sections(corners, middle, way) for way in ways), key=lambda found: found[2])
    axis, outside, variation = best
    if variation > _ROUND:
        varies = f"its radius varies by {100 * variation:.0f} % around the best axis"
        problem = f"is not a body of revolution: {varies if np.isfinite(variation) else 'it surrounds no axis'}"
        raise InputError(problem, "give a bottle that is round, or write the scene by hand from stretch-blow-bottle")
    return _from_neck(corners, middle, axis, outside, variation)


def describe_bottle(mesh: Mesh) -> str:
    """Reasons why a solid looks like a bottle, and the process that blows it; empty if it does not.

    A bottle has a narrow neck, and a handle, a length of twice its mean radius at least, or a base narrower than its
    body, which a buck has not.
    """
    try:
        opened, axis, _, low, cut = find_outside(mesh)
    except InputError:
        return ""
    section, (bottom, top), area = _sections_across(opened, axis)
    levels = (top - _TOP * (top - bottom), bottom + _TOP * (top - bottom))
    wide, neck, base = (float(np.sqrt(each / np.pi)) for each in (area, *(section(level)[0] for level in levels)))
    handle = topology.count_handles(opened.triangles) > 0
    if not (_TIP * wide <= neck <= _NARROW_NECK * wide and _neck_error(opened, axis) <= _HINT_ERROR):
        return ""
    if not (handle or cut - low >= 2.0 * wide or base <= _BASE * wide):
        return ""
    if handle:
        return "a body with a neck and a handle, as a bottle: --process extrusion-blow blows it from a tube"
    try:
        shape = "round " if find_revolution(mesh).variation <= _ROUND else ""
    except InputError:
        shape = ""
    blown = "--process stretch-blow blows it from a preform, extrusion-blow from a tube"
    return f"a {shape}body with a neck, as the inside of a bottle: {blown}"


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

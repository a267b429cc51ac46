"""Bottles: the outside, the half on one side of the parting plane, mirror symmetry, and hints in words. On the host."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize_scalar
from scipy.spatial import ConvexHull, QhullError

from jaxform.core.errors import InputError
from jaxform.mesh import meshes, topology, volumes
from jaxform.mesh.meshes import Mesh
from jaxform.tools import revolution
from jaxform.tools.distances import Distances
from jaxform.tools.revolution import (
    FLAT,
    NARROW,
    ROUND,
    TOP,
    find_axis,
    find_revolution,
    hull_sizes,
    plane_axes,
    sections_across,
)

Array = NDArray[np.float64]

_SAMPLES = 1500  # vertices that are mirrored
_SYMMETRIC = 0.002  # of the length, for a bottle of which a half or a quarter is modelled
_MIRRORED = 0.01  # of the length, root mean square, by which a mirrored bottle deviates from itself at most
_TURNS = 24  # directions across the axis that are tried as normals of the parting plane
_HINT_ERROR, _BASE = 0.35, 0.97  # of the neck of what looks like a bottle; width of its base over its own, if short
_FACE, _OUTER = 0.01, 0.5  # of the area of a block's convex hull: its smallest face, and what is in its faces at least
_SOLID = 0.35  # of the volume of that hull, that a block is filled at least, unlike a bottle with a wall
_TIP, _NARROW_NECK = 0.1, 0.65  # of the largest radius, between which the radius of a neck is


class HalfBottle(NamedTuple):
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


def find_bottle(mesh: Mesh) -> HalfBottle:
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
    places[np.abs(places[:, 0]) <= FLAT * size, 0] = 0.0
    top = np.abs(places[:, 2] - (cut - low)) <= FLAT * size
    places[top, 2] = cut - low
    triangles = half.triangles
    corners = places[triangles]
    area = 0.5 * np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    in_plane = top & (places[:, 0] == 0.0)
    neck = 0.5 * float(np.ptp(places[in_plane, 1])) if in_plane.any() else 0.0
    if neck <= 0.0:
        raise InputError("has no open end at its neck in the parting plane", "repair the mesh of the bottle")
    return HalfBottle(Mesh(places, triangles, {}), float(cut - low), neck, float(area.sum()), rotation, origin)


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
    origin = rim - TOP * (cut - low) * axis
    rotation = np.stack([x, np.cross(-axis, x), -axis])
    places = (opened.positions - origin) @ rotation.T
    return BottleBody(Mesh(places, opened.triangles, {}), symmetry, rotation, origin)


def block_cavities(parts: Sequence[Mesh]) -> list[Mesh]:
    """Surfaces that may be the cavity of mold halves cut into blocks, the likeliest first; none of other solids.

    They are what is left of the blocks without the faces of their convex hulls: of both halves where these are closed,
    else of the one with the larger cavity. Several pockets in a block are no bottle.

    Args:
        parts: The surfaces of the files [m], each of one block or of several apart, welded.
    """
    found = []
    for part in parts:
        label = topology.components(part.triangles, len(part.positions))[part.triangles[:, 0]]
        for number in np.unique(label):
            triangles = _block_cavity(part, part.triangles[label == number])
            found += (
                [meshes.drop_unused_nodes(Mesh(part.positions, triangles.astype(np.int32), {}))]
                if len(triangles)
                else []
            )
    found.sort(key=lambda cavity: len(cavity.triangles), reverse=True)
    whole = [meshes.merge(found)] if len(found) > 1 else []
    welded = [meshes.weld(each, FLAT * meshes.size(each.positions)) for each in [*whole, *found[:1]]]
    return [each for each in welded if not topology.components(each.triangles, len(each.positions)).any()]


def _block_cavity(mesh: Mesh, triangles: NDArray[np.integer]) -> NDArray[np.integer]:
    """The triangles (n, 3) of a block's cavity; none where the solid is no block, or its hollows are no cavity."""
    corners = mesh.positions[triangles]
    try:
        hull = ConvexHull(mesh.positions[np.unique(triangles)])
    except QhullError:
        return triangles[:0]
    planes, group = np.unique(
        np.round(hull.equations / [1, 1, 1, np.cbrt(hull.volume)], 6), axis=0, return_inverse=True
    )
    sides = hull.points[hull.simplices]
    area = 0.5 * np.linalg.norm(np.cross(sides[:, 1] - sides[:, 0], sides[:, 2] - sides[:, 0]), axis=1)
    planes = planes[np.bincount(np.ravel(group), area) > _FACE * hull.area] * [1, 1, 1, np.cbrt(hull.volume)]
    off = np.abs(corners @ planes[:, :3].T + planes[:, 3]).max(1)
    inner = ~(off <= 1e-5 * np.cbrt(hull.volume)).any(1)
    outer_area = float(volumes.areas(mesh.positions, triangles[~inner]).sum())
    solid = abs(volumes.enclosed_volume(mesh.positions, triangles))
    if not inner.any() or outer_area < _OUTER * hull.area or solid < _SOLID * hull.volume:
        return triangles[:0]
    middle = corners[inner].reshape(-1, 3)
    middle = 0.5 * (middle.min(0) + middle.max(0))
    return triangles[inner] if abs(_winding_number(corners, middle)) < 0.5 else triangles[:0]


def _winding_number(corners: Array, place: Array) -> float:
    """Winding number of a surface of triangles (n, 3, 3) around a place (3,): 1 in a solid, 0 outside.

    Source: A. van Oosterom, J. Strackee, IEEE Trans. Biomed. Eng. 30 (1983) 125-126.
    """
    a, b, c = np.moveaxis(corners - place, 1, 0)
    one, two, three = (np.linalg.norm(each, axis=1) for each in (a, b, c))
    dots = [np.einsum("ij,ij->i", *pair) for pair in ((a, b), (b, c), (c, a))]
    below = one * two * three + dots[0] * three + dots[1] * one + dots[2] * two
    return float(np.arctan2(np.einsum("ij,ij->i", a, np.cross(b, c)), below).sum() / (2 * np.pi))


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
    whole, axis = find_axis(mesh)
    along = whole.positions[np.unique(whole.triangles)] @ axis
    low, high = along.min(), along.max()
    cut = high - TOP * (high - low)
    opened = _largest_part(clip(whole, axis, cut, keep_below=True))
    return opened, axis, _section_middle(opened, axis, cut, size), float(low), float(cut)


def neck_error(mesh: Mesh) -> float:
    """A measure of how far the narrow end of a surface, or of the whole of a half, is from a neck; 0 for a cylinder."""
    return revolution.neck_error(*find_axis(mesh))


def clip(mesh: Mesh, normal: Array, level: float, *, keep_below: bool) -> Mesh:
    """The part of a surface on one side of the plane normal . x = level, open where it was cut.

    Vertices that are nearly in the plane are put there; triangles in the plane are left out.
    """
    side = (mesh.positions @ normal - level) * (-1.0 if keep_below else 1.0)
    near = FLAT * meshes.size(mesh.positions[np.unique(mesh.triangles)])
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
    there = (np.abs(ends @ axis - level) <= FLAT * size).all(1)
    if not there.any():
        raise InputError("has no neck", "give the surface of a bottle")
    points = ends[there].reshape(-1, 3)
    width = np.linalg.norm(points - points.mean(0), axis=1).max()
    widest = np.sqrt(hull_sizes(mesh.positions @ plane_axes(axis).T)[0] / np.pi)
    if width > NARROW * widest:
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
            if errors[k] > min(errors[k - 1], errors[(k + 1) % _TURNS]) or errors[k] <= FLAT * self._length:
                continue
            bounds = angles[k] - turn, angles[k] + turn
            found = minimize_scalar(self.error, bounds=bounds, method="bounded", options={"xatol": 1e-4})
            if found.fun < 0.9 * errors[k]:
                angles[k] = float(found.x)
        return angles


def describe_bottle(mesh: Mesh) -> str:
    """Reasons why a solid looks like a bottle, and the process that blows it; empty if it does not.

    A bottle has a narrow neck, and a handle, a length of twice its mean radius at least, or a base narrower than its
    body, which a buck has not.
    """
    try:
        opened, axis, _, low, cut = find_outside(mesh)
    except InputError:
        return ""
    section, (bottom, top), area = sections_across(opened, axis)
    levels = (top - TOP * (top - bottom), bottom + TOP * (top - bottom))
    wide, neck, base = (float(np.sqrt(each / np.pi)) for each in (area, *(section(level)[0] for level in levels)))
    handle = topology.count_handles(opened.triangles) > 0
    if not (_TIP * wide <= neck <= _NARROW_NECK * wide and revolution.neck_error(opened, axis) <= _HINT_ERROR):
        return ""
    if not (handle or cut - low >= 2.0 * wide or base <= _BASE * wide):
        return ""
    if handle:
        return "a body with a neck and a handle, as a bottle: --process extrusion-blow blows it from a tube"
    try:
        shape = "round " if find_revolution(mesh).variation <= ROUND else ""
    except InputError:
        shape = ""
    blown = "--process stretch-blow blows it from a preform, extrusion-blow from a tube"
    return f"a {shape}body with a neck, as the inside of a bottle: {blown}"

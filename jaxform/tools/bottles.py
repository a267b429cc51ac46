"""Bottles: their axis, neck and parting plane, the half of their outside, and round ones as bodies of revolution."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize_scalar

from jaxform.core.errors import InputError
from jaxform.mesh import meshes, topology
from jaxform.mesh.meshes import Mesh
from jaxform.tools.distances import Distances

Array = NDArray[np.float64]
Index = NDArray[np.int32]

_TOP = 0.01  # of the length, that is cut off at the neck: the rim, which joins the inside and the outside
_SLICE = 0.02  # of the length: where sections at the two ends are compared
_NARROW = 0.7  # width of the neck over the largest width, at most
_SAMPLES = 1500  # vertices that are mirrored
_SYMMETRIC = 0.002  # of the length, for a bottle of which a half or a quarter is modelled
_MIRRORED = 0.01  # of the length, root mean square, by which a mirrored bottle deviates from itself at most
_TURNS = 24  # directions across the axis that are tried as normals of the parting plane
_FLAT = 1e-5  # of the size: what is as near to a plane lies in it
_CUT = 0.5  # of the area that a half covers, its cut face at least
_WHOLE = 0.97  # of the length of a half, along which its cut reaches at least
_IN_CUT = 0.7  # of the open edges of a half, that lie in its cut
_STEEP = 0.3  # sine of the angle between an axis and what is about along it, at most
_OFF, _ALIGNED = 0.1, 6e-4  # cosine below 1 of an axis off the longest direction at most, and off x, y or z
_STEEPER = (_STEEP, _STEEP, 0.15, 0.15, 0.08, 0.08, 0.04, 0.04)  # as the axis becomes closer
_AROUND = 0.1  # of the area of sides in one direction, that of those across at least
_TURNED = 6  # times that a plane is fitted to what is near the last one


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
    if handles := topology.count_handles(opened.triangles):
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
    whole = _complete_half(mesh, _find_axis(mesh))
    positions, used = whole.positions, np.unique(whole.triangles)
    axis = _find_axis(whole)  # the longest direction of a half is only near it
    along = positions @ axis
    if _width_at_end(positions[used], axis) > _width_at_end(positions[used], -axis):
        axis, along = -axis, -along
    low, high = along[used].min(), along[used].max()
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


def _find_axis(mesh: Mesh) -> Array:
    """The axis of a bottle: that to which its sides, and then those of its neck, are parallel; x, y or z if near.

    With a handle, a bottle is longest in a direction off its axis. Without sides, its longest direction, or x, y or z
    if it is about as long along that.
    """
    points = mesh.positions[np.unique(mesh.triangles)]
    principal = np.linalg.svd(points - points.mean(0), full_matrices=False)[2][0]
    axis = None
    for steep in _STEEPER:
        if (closer := _side_axis(mesh, principal if axis is None else axis, steep)) is not None:
            axis = closer
    if axis is not None:
        neck = _neck(mesh, axis)
        for steep in _STEEPER[3::2]:
            if (closer := _side_axis(neck, axis, steep)) is not None:
                axis = closer
    if axis is not None and axis @ principal > 1.0 - _OFF:
        nearest = int(np.argmax(np.abs(axis)))
        return np.eye(3)[nearest] if abs(axis[nearest]) > 1.0 - _ALIGNED else axis
    extents = np.ptp(points, axis=0)
    best = int(np.argmax(extents))
    return principal if float(np.ptp(points @ principal)) > 1.02 * extents[best] else np.eye(3)[best]


def _neck(mesh: Mesh, axis: Array) -> Mesh:
    """The faces of a bottle at the end of its neck, which is the narrower of its ends along an axis."""
    used = mesh.positions[np.unique(mesh.triangles)]
    if _width_at_end(used, axis) > _width_at_end(used, -axis):
        axis = -axis
    along = mesh.positions[mesh.triangles] @ axis
    near = along.min(1) > along.max() - _NECK_END * np.ptp(along)
    return Mesh(mesh.positions, mesh.triangles[near], {})


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


def _complete_half(mesh: Mesh, axis: Array) -> Mesh:
    """The whole of a mesh that is half of a bottle, open or closed by a flat face along the axis; else the mesh.

    The axis is about that of the bottle. The plane of the cut reaches from its bottom to the end of its neck; a flat
    side of a bottle ends below the neck.
    """
    positions, triangles = mesh.positions, mesh.triangles
    corners = positions[triangles]
    area_vector = 0.5 * np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    used = np.unique(triangles)
    size, edges = meshes.size(positions[used]), topology.boundary_edges(triangles)
    length = np.linalg.norm(positions[edges[:, 1]] - positions[edges[:, 0]], axis=1)
    for way in _across(mesh, axis):
        level = (positions[used] @ way).min()
        there = np.abs(positions @ way - level) <= _FLAT * size
        flat = there[triangles].all(1)
        covered = 0.5 * np.abs(area_vector @ way).sum()
        closed = np.abs(area_vector[flat] @ way).sum() >= _CUT * covered
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


def _across(mesh: Mesh, axis: Array) -> Iterator[Array]:
    """Directions about across the axis, both ways, in which a surface may have been cut.

    They are those of the file, and the normals of its largest face and of the plane of most of its open edges.
    """
    corners = mesh.positions[mesh.triangles]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    ways = [*np.eye(3), normal[np.argmax(np.linalg.norm(normal, axis=1))]]
    ends = mesh.positions[topology.boundary_edges(mesh.triangles)]
    if len(ends) > 2:
        passed = np.cumsum(np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1))
        points = ends[np.searchsorted(passed, np.linspace(0.0, passed[-1], _SAMPLES))].reshape(-1, 3)
        near = points
        for _ in range(_TURNED):
            middle = near.mean(0)
            ways[4:] = [np.linalg.svd(near - middle, full_matrices=False)[2][2]]
            away = np.abs((points - middle) @ ways[4])
            near = points[away <= np.quantile(away, _IN_CUT)]
    for way in ways:
        size = np.linalg.norm(way)
        if abs(way @ axis) < _STEEP * size:
            yield way / size
            yield -way / size


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
    across = mesh.positions - np.outer(mesh.positions @ axis, axis)
    widest = 0.5 * np.linalg.norm(np.ptp(across, axis=0))
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
_TIP, _NARROW_NECK = 0.1, 0.6  # of the largest radius, between which the radius of a neck is
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
    best = min((_sections(corners, middle, axis) for axis in _axes(corners, area, middle)), key=lambda found: found[2])
    axis, outside, variation = best
    if variation > _ROUND:
        varies = f"its radius varies by {100 * variation:.0f} % around the best axis"
        problem = f"is not a body of revolution: {varies if np.isfinite(variation) else 'it surrounds no axis'}"
        raise InputError(problem, "give a bottle that is round, or write the scene by hand from stretch-blow-bottle")
    return _from_neck(corners, middle, axis, outside, variation)


def is_bottle(mesh: Mesh) -> bool:
    """True for a long body of revolution whose one end is a neck: narrow, but no tip."""
    try:
        found = find_revolution(mesh)
    except InputError:
        return False
    near = found.profile[found.profile[:, 1] <= _NECK_END * found.length, 0]
    narrow = _TIP * found.radius <= near.min() <= near.max() <= _NARROW_NECK * found.radius
    return bool(narrow and found.length >= 2.0 * found.radius)


def _axes(corners: Array, area: Array, middle: Array) -> list[Array]:
    """Axes (3,) that it may have: those of the file, and the principal ones of the surface."""
    away = corners - middle
    total = away.sum(1)
    moment = np.einsum("n,nki,nkj->ij", area, away, away) + np.einsum("n,ni,nj->ij", area, total, total)
    return [*np.eye(3), *np.linalg.svd(moment)[2]]


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

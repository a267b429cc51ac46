"""Shapes of tools on the host: revolved profiles, rods, plates, a box with an insert, half a bottle, a user's mesh."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike, NDArray

from jaxform.core.errors import InputError
from jaxform.mesh import meshes
from jaxform.mesh.meshes import Mesh
from jaxform.mesh.topology import distinct_rows

MOST_TRIANGLES = 2_000_000


@dataclass(frozen=True)
class MoldShape:
    """The surface of a mold; which way its triangles turn does not matter.

    Attributes:
        vertices: Vertex positions [m], shape (n, 3), float64.
        triangles: Vertex indices, shape (m, 3), int32.
        dropped: Number of degenerate triangles that were left out.
    """

    vertices: NDArray[np.float64]
    triangles: NDArray[np.int32]
    dropped: int = 0


def revolved(*, profile: ArrayLike, segments: int = 96) -> MoldShape:
    """A profile turned about the z axis.

    Each stretch of the profile makes one band of `segments` facets; a band that reaches the axis is a fan.

    Args:
        profile: Points r, z [m] from the axis outwards, shape (k, 2). A first r > 0 leaves a hole.
        segments: Facets of the full circle; the vertices are on the circle, and the facets of 96 within 0.05 % of its
            radius.

    Returns:
        The mold; vertices run point by point, counter-clockwise, beginning at y = 0, x > 0.

    Raises:
        InputError: The profile has fewer than two points, a negative radius, a point twice or a stretch along
            the axis; fewer than three segments, or too many.
    """
    points = _profile_points(profile)
    if isinstance(segments, bool) or not isinstance(segments, int | np.integer) or segments < 3:
        raise InputError("is not a number of facets", "use 3 or more", "mold.segments", segments)
    if 2 * int(segments) * len(points) > MOST_TRIANGLES:
        raise InputError("makes too many triangles", f"keep them under {MOST_TRIANGLES}", "mold.segments", segments)
    angle = 2 * np.pi * np.arange(segments) / segments
    circle = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    circle[np.abs(circle) < 1e-14] = 0.0
    rings = [np.insert(r * (circle if r else circle[:1]), 2, z, axis=1) for r, z in points]
    starts = np.cumsum([0, *map(len, rings)])
    # Vertex numbers around each point of the profile, the one on the axis repeated.
    around = [start + np.arange(segments) % len(ring) for start, ring in zip(starts, rings, strict=False)]
    bands = [_band(inner, outer) for inner, outer in pairwise(around)]
    return MoldShape(np.concatenate(rings), np.concatenate(bands).astype(np.int32))


def box_insert(
    *,
    size: Sequence[float] = (0.3, 0.2),
    depth: float = 0.08,
    insert_size: Sequence[float] = (0.12, 0.08),
    insert_height: float = 0.04,
    draft: float = 0.0,
    divisions: int = 1,
) -> MoldShape:
    """A box, open at z = 0, with a raised block in the middle of its bottom (paper, Fig. 11); 26 triangles.

    The opening is [0, a] x [0, b], as a rectangular sheet's; the bottom is at z = depth, the block rises from it
    towards the opening.

    Args:
        size: Sides a, b [m] of the opening.
        depth: Depth of the bottom [m].
        insert_size: Sides [m] of the block where it stands on the bottom.
        insert_height: Height of the block [m], less than the depth.
        draft: Angle [degrees] by which the sides of box and block lean back from the vertical.
        divisions: Every edge is cut in so many, every triangle in its square.

    Returns:
        The mold, normals towards the sheet's side.

    Raises:
        InputError: A number is out of range, or the parts do not fit into each other.
    """
    outer, block = _sides("mold.size", size), _sides("mold.insert_size", insert_size)
    depth, height = _positive("mold.depth", depth), _positive("mold.insert_height", insert_height)
    if not 0 <= draft < 60:
        raise InputError("is not a draft angle", "give 0 to 60 degrees", "mold.draft", draft)
    if height >= depth:
        raise InputError(f"is not less than the depth ({depth:g} m)", "lower it", "mold.insert_height", insert_height)
    if isinstance(divisions, bool) or not isinstance(divisions, int | np.integer) or not 1 <= divisions <= 200:
        raise InputError("is not a number of parts", "use 1 to 200", "mold.divisions", divisions)
    slope = np.tan(np.radians(draft))
    floor, top = outer - 2 * slope * depth, block - 2 * slope * height
    if np.any(block >= floor):
        raise InputError("does not fit on the bottom", "make it smaller", "mold.insert_size", list(insert_size))
    if np.any(top <= 0):
        raise InputError("leaves no top face on the insert", "lower it", "mold.draft", draft)
    levels = [(outer, 0.0), (floor, depth), (block, depth), (top, depth - height)]
    corner = np.array([[-0.5, -0.5], [0.5, -0.5], [0.5, 0.5], [-0.5, 0.5]])
    rings = [np.column_stack([0.5 * outer + corner * side, np.full(4, z)]) for side, z in levels]
    numbers = [4 * k + np.arange(4) for k in range(4)]
    bands = [_band(outside, inside)[:, ::-1] for outside, inside in pairwise(numbers)]
    lid = numbers[3][[[0, 1, 2], [0, 2, 3]]]
    return divided(MoldShape(np.concatenate(rings), np.concatenate([*bands, lid]).astype(np.int32)), int(divisions))


def bottle_half(
    *,
    height: float = 0.23,
    radius: float = 0.04,
    neck_radius: float = 0.014,
    hole: Sequence[float] = (0.0075, 0.027),
    hole_center: Sequence[float] | None = None,
    handle_edge: float | None = None,
    element_size: float = 0.00595,
) -> MoldShape:
    """Half of a soap bottle with a handle, z >= 0, open at the neck (paper, 4.3); 1215 triangles or so.

    Args:
        height: Height from the bottom, y = 0, to the neck [m].
        radius: Radius of the body [m].
        neck_radius: Radius of the neck [m].
        hole: Half width and half height of the handle's hole [m].
        hole_center: Distance of its middle from the axis, and its height [m]; 0.41 radii and 0.66 heights by default.
        handle_edge: Distance of the handle's outer edge from the axis [m]; nearly the body's radius by default.
        element_size: Length of the edges [m] in the plane of the outline.

    Returns:
        The mold, outward normals.

    Raises:
        InputError: The parts do not fit into each other.
    """
    from jaxform.mesh import bottle

    center = None if hole_center is None else (hole_center[0], hole_center[1])
    shape = bottle.Bottle(height, radius, neck_radius, (hole[0], hole[1]), center, handle_edge)
    try:
        vertices, triangles = bottle.half_bottle(shape, element_size)
    except InputError as error:
        raise replace(error, key=f"mold.{error.key}") from None
    return MoldShape(vertices, triangles)


def rod(*, radius: float, length: float, end_radius: float | None = None, segments: int = 48) -> MoldShape:
    """A closed rod along the z axis, with its rounded end at the origin and the rest at z < 0.

    Args:
        radius: Radius [m].
        length: Length [m], with the end.
        end_radius: Radius of the rounding between end and side [m]; that of the rod by default: a hemisphere.
        segments: Facets of the full circle, and four times those of the rounding from the end to the side.

    Returns:
        The rod, its back closed by a flat disc.

    Raises:
        InputError: A number is out of range, or they do not fit together.
    """
    radius, length = _positive("mold.radius", radius), _positive("mold.length", length)
    rounding = radius if end_radius is None else float(end_radius)
    if not 0 <= rounding <= radius:
        problem = f"is not between 0 and the radius of the rod ({radius:g} m)"
        raise InputError(problem, "give a smaller one, or none for a hemisphere", "mold.end_radius", end_radius)
    if length <= rounding:
        raise InputError(
            f"is not more than the rounding of its end ({rounding:g} m)", "lengthen it", "mold.length", length
        )
    count = 1 if rounding == 0 else max(2, -(-int(segments) // 4))
    angle = np.linspace(0.0, 0.5 * np.pi, count + 1)
    arc = np.stack([radius - rounding + rounding * np.sin(angle), rounding * (np.cos(angle) - 1.0)], axis=1)
    if rounding == 0:
        arc = np.array([[radius, 0.0]])
    tip = [] if rounding == radius else [[0.0, 0.0]]
    arc[0, 0] = 0.0 if rounding == radius else arc[0, 0]
    profile = [*tip, *arc.tolist(), [radius, -length], [0.0, -length]]
    return revolved(profile=profile, segments=segments)


def plate(*, size: Sequence[float] | None = None, radius: float | None = None, segments: int = 48) -> MoldShape:
    """A plate in z = 0: a rectangle from the origin to `size` [m], or a disc of a `radius` [m] about the origin.

    Args:
        size: Sides of the rectangle along x and y [m].
        radius: Radius of the disc [m].
        segments: Segments of the disc's circle.

    Returns:
        The plate.

    Raises:
        InputError: Neither or both are given, or one is no length.
    """
    if (size is None) == (radius is None):
        raise InputError("needs size or radius, one of them", "give size = [a, b] or radius", "mold.size", size)
    if radius is not None:
        return revolved(profile=[[0.0, 0.0], [_positive("mold.radius", radius), 0.0]], segments=segments)
    sides = _sides("mold.size", size or ())
    corners = np.array([[0, 0], [1, 0], [1, 1], [0, 1]]) * sides
    return MoldShape(np.insert(corners, 2, 0.0, axis=1), np.array([[0, 1, 2], [0, 2, 3]], np.int32))


def placed(
    mold: MoldShape, *, translate: Sequence[float] = (0, 0, 0), rotate: Sequence[float] = (0, 0, 0)
) -> MoldShape:
    """The surface turned about x, y and z [degrees], in that order, then moved [m].

    Raises:
        InputError: One of the two is not three finite numbers.
    """
    shift, turn = _triple("mold.translate", translate, "metres"), _triple("mold.rotate", rotate, "degrees")
    if not np.any(shift) and not np.any(turn):
        return mold
    return replace(mold, vertices=mold.vertices @ rotation(turn).T + shift)


def divided(mold: MoldShape, parts: int) -> MoldShape:
    """The surface with every edge cut in `parts` and every triangle in `parts` squared."""
    if parts == 1:
        return mold
    # Barycentric places of the corners of the small triangles, in parts, pointing up and down.
    i, j = (index.ravel() for index in np.meshgrid(np.arange(parts), np.arange(parts), indexing="ij"))
    base = np.stack([parts - 1 - i - j, i, j], axis=1)
    up = base[base[:, 0] >= 0][:, None] + np.eye(3, dtype=int)
    down = (base - [1, 0, 0])[base[:, 0] >= 1][:, None] + 1 - np.eye(3, dtype=int)
    places = np.concatenate([up, down])
    corners = np.einsum("pck,tkx->tpcx", places / parts, mold.vertices[mold.triangles])
    # Nodes are known by their numbers, not by where rounding puts them.
    numbers = np.sort(np.where(places, mold.triangles[:, None, None] + 1, 0), axis=-1)
    order = np.argsort(np.where(places, mold.triangles[:, None, None] + 1, 0), axis=-1)
    shares = np.take_along_axis(np.broadcast_to(places, order.shape), order, axis=-1)
    keys = np.concatenate([numbers, shares], axis=-1).reshape(-1, 6)
    _, first, index, _ = distinct_rows(keys)
    return MoldShape(corners.reshape(-1, 3)[first], index.reshape(-1, 3).astype(np.int32), mold.dropped)


def from_mesh(mesh: Mesh, *, translate: Sequence[float] = (0, 0, 0), rotate: Sequence[float] = (0, 0, 0)) -> MoldShape:
    """A user's mesh as a mold: welded, degenerate triangles left out, turned, then moved.

    Args:
        mesh: The mesh, positions in m.
        translate: Displacement [m], shape (3,).
        rotate: Angles [degrees] about the x, y and z axes, applied in that order, shape (3,).

    Returns:
        The mold, and how many triangles were left out.

    Raises:
        InputError: No triangle is left, or `translate` or `rotate` are not three finite numbers.
    """
    clean, dropped = meshes.drop_degenerate(meshes.weld(mesh))
    if not len(clean.triangles):
        problem = f"none of its {len(mesh.triangles)} triangles has an area"
        raise InputError(problem, "check the file and the scale", key="mold.path")
    return placed(MoldShape(clean.positions, clean.triangles, dropped), translate=translate, rotate=rotate)


def _profile_points(profile: ArrayLike) -> NDArray[np.float64]:
    key = "mold.profile"
    try:
        points = np.asarray(profile, dtype=np.float64)
    except (TypeError, ValueError):
        points = np.zeros(0)
    if points.ndim != 2 or points.shape[-1] != 2 or not np.isfinite(points).all():
        raise InputError("is not a list of points", "give [[r, z], ...] in m", key, profile)
    if len(points) < 2:
        raise InputError(f"has {len(points)} points", "give two or more", key, profile)
    if points[:, 0].min() < 0:
        raise InputError("has a negative radius", "give r >= 0", key, profile)
    if len(np.unique(points, axis=0)) < len(points):
        raise InputError("has a point twice", "give each point once", key, profile)
    if np.any((points[:-1, 0] == 0) & (points[1:, 0] == 0)):
        raise InputError("runs along the axis", "start with the last point on the axis", key, profile)
    return points + 0.0


def _band(inner: NDArray[np.int64], outer: NDArray[np.int64]) -> NDArray[np.int64]:
    inner_next, outer_next = np.roll(inner, -1), np.roll(outer, -1)
    halves = np.stack([np.stack([inner, outer, outer_next], 1), np.stack([inner, outer_next, inner_next], 1)], 1)
    triangles = halves.reshape(-1, 3)
    ordered = np.sort(triangles, axis=1)
    # At the axis one half of every facet has no area.
    return triangles[(ordered[:, 0] < ordered[:, 1]) & (ordered[:, 1] < ordered[:, 2])]


def _positive(key: str, value: float) -> float:
    if not (np.isfinite(value) and value > 0):
        raise InputError("is not a positive length", "give metres above 0", key, value)
    return float(value)


def _sides(key: str, values: Sequence[float]) -> NDArray[np.float64]:
    array = np.asarray(values, dtype=np.float64)
    if array.shape != (2,):
        raise InputError("is not two lengths", "give [a, b] in m", key, values)
    return np.array([_positive(key, side) for side in array])


def _triple(key: str, values: Sequence[float], unit: str) -> NDArray[np.float64]:
    try:
        array = np.asarray(values, dtype=np.float64)
    except (TypeError, ValueError):
        array = np.zeros(0)
    if array.shape != (3,) or not np.isfinite(array).all():
        raise InputError("is not three finite numbers", f"give [x, y, z] in {unit}", key, values)
    return array


def angles(matrix: NDArray[np.float64]) -> NDArray[np.float64]:
    """Angles [degrees] about x, then y, then z (3,) that make a rotation (3, 3): the inverse of `rotation`."""
    flat = np.hypot(matrix[0, 0], matrix[1, 0])
    if flat > 1e-9:
        about_x, about_z = np.arctan2(matrix[2, 1], matrix[2, 2]), np.arctan2(matrix[1, 0], matrix[0, 0])
    else:
        # Where y is turned by a quarter, turning about x or z is the same.
        about_x, about_z = np.arctan2(-matrix[1, 2], matrix[1, 1]), 0.0
    return np.degrees([about_x, np.arctan2(-matrix[2, 0], flat), about_z])


def rotation(degrees: NDArray[np.float64]) -> NDArray[np.float64]:
    """The matrix that turns about x, then y, then z [degrees], quarter turns exact: (3, 3)."""
    matrix = np.eye(3)
    for axis, angle in enumerate(np.radians(degrees)):
        i, j = (axis + 1) % 3, (axis + 2) % 3
        turn = np.eye(3)
        turn[[i, j], [i, j]] = np.cos(angle)
        turn[j, i], turn[i, j] = np.sin(angle), -np.sin(angle)
        turn[np.abs(turn) < 1e-15] = 0.0
        matrix = turn @ matrix
    return matrix

"""Shapes of molds on the host: revolved profiles and a user's mesh."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike, NDArray

from jaxform import meshes
from jaxform.errors import InputError
from jaxform.meshes import Mesh

MOST_TRIANGLES = 2_000_000


@dataclass(frozen=True)
class MoldShape:
    """The surface of a mold; which way its triangles turn does not matter.

    Attributes:
        vertices: Vertex positions [m], shape (n, 3), float64.
        triangles: Vertex indices, shape (m, 3), int32.
        dropped: How many degenerate triangles were left out.
    """

    vertices: NDArray[np.float64]
    triangles: NDArray[np.int32]
    dropped: int = 0


def revolved(*, profile: ArrayLike, segments: int) -> MoldShape:
    """A profile turned about the z axis.

    Each stretch of the profile makes one band of `segments` facets; a band that reaches the axis is a fan.

    Args:
        profile: Points r, z [m] from the axis outwards, shape (k, 2). A first r > 0 leaves a hole.
        segments: Facets of the full circle; the vertices are on the circle.

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
    shift, turn = _triple("mold.translate", translate, "metres"), _triple("mold.rotate", rotate, "degrees")
    clean, dropped = meshes.drop_degenerate(meshes.weld(mesh))
    if not len(clean.triangles):
        problem = f"no triangle with an area is left of {len(mesh.triangles)}"
        raise InputError(problem, "check the file and the scale", key="mold.path")
    return MoldShape(clean.positions @ _rotation(turn).T + shift, clean.triangles, dropped)


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
        raise InputError("runs along the axis", "begin with the last point on the axis", key, profile)
    return points + 0.0


def _band(inner: NDArray[np.int64], outer: NDArray[np.int64]) -> NDArray[np.int64]:
    inner_next, outer_next = np.roll(inner, -1), np.roll(outer, -1)
    halves = np.stack([np.stack([inner, outer, outer_next], 1), np.stack([inner, outer_next, inner_next], 1)], 1)
    triangles = halves.reshape(-1, 3)
    ordered = np.sort(triangles, axis=1)
    # At the axis one half of every facet has no area.
    return triangles[(ordered[:, 0] < ordered[:, 1]) & (ordered[:, 1] < ordered[:, 2])]


def _triple(key: str, values: Sequence[float], unit: str) -> NDArray[np.float64]:
    try:
        array = np.asarray(values, dtype=np.float64)
    except (TypeError, ValueError):
        array = np.zeros(0)
    if array.shape != (3,) or not np.isfinite(array).all():
        raise InputError("is not three finite numbers", f"give [x, y, z] in {unit}", key, values)
    return array


def _rotation(degrees: NDArray[np.float64]) -> NDArray[np.float64]:
    """The matrix that turns about x, then y, then z, quarter turns exact: (3, 3)."""
    matrix = np.eye(3)
    for axis, angle in enumerate(np.radians(degrees)):
        i, j = (axis + 1) % 3, (axis + 2) % 3
        turn = np.eye(3)
        turn[[i, j], [i, j]] = np.cos(angle)
        turn[j, i], turn[i, j] = np.sin(angle), -np.sin(angle)
        turn[np.abs(turn) < 1e-15] = 0.0
        matrix = turn @ matrix
    return matrix

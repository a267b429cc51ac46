"""Faces with any number of corners, cut in triangles that cover them once; on the host."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from jaxform.core.errors import InputError

Array = NDArray[np.float64]
Index = NDArray[np.int64]
_MOST_CORNERS = 2000  # of a face that no fan covers: the search for ears takes time with their square
_FLAT = 1e-9  # a triangle's area, relative to its face's, down to which it may point the wrong way


def split(positions: Array, corners: Index, counts: Index) -> tuple[Index, Index]:
    """Cuts faces in triangles: fans where one covers the face (all convex faces), ears where none does.

    Args:
        positions: Node positions, shape (n, 3).
        corners: The node indices of all faces, one face after the other, shape (counts.sum(),).
        counts: Corners of each face, shape (f,); faces of fewer than three are left out.

    Returns:
        Triangles in the order of the faces and turning as they do, shape (m, 3), and the face of each, shape (m,).

    Raises:
        InputError: A face with very many corners is not convex.
    """
    start = np.cumsum(counts) - counts
    triangles: list[Index] = [np.zeros((0, 3), np.int64)]
    owner: list[Index] = [np.zeros(0, np.int64)]
    for count in np.unique(counts[counts >= 3]):
        face = np.flatnonzero(counts == count)
        fans = _triangulate_faces(positions, corners[start[face, None] + np.arange(count)])
        triangles.append(fans.reshape(-1, 3))
        owner.append(np.repeat(face, count - 2))
    joined = np.concatenate(owner)
    order = np.argsort(joined, kind="stable")
    return np.concatenate(triangles)[order], joined[order]


def _triangulate_faces(positions: Array, faces: Index) -> Index:
    """The triangles (f, k - 2, 3) of faces (f, k)."""
    fans = _fan(faces)
    if faces.shape[1] == 3:
        return fans
    # Scaled to the box of the faces, so that no unit of length makes the products overflow or vanish.
    used = positions[faces]
    scaled = (used - used.min((0, 1))) / (np.ptp(used, axis=(0, 1)).max() or 1.0)
    for index in np.flatnonzero(~_fan_covers(scaled, np.broadcast_to(_fan(_numbers(faces)), fans.shape))):
        fans[index] = faces[index][_triangulate_face(scaled[index])]
    return fans


def _numbers(faces: Index) -> Index:
    return np.arange(faces.shape[1])[None]


def _fan(faces: Index) -> Index:
    """Triangles (f, k - 2, 3) from the first corner of each face (f, k)."""
    count = faces.shape[1]
    second = np.arange(1, count - 1)
    return faces[:, np.stack([np.zeros_like(second), second, second + 1], axis=1)]


def _fan_covers(corners: Array, triangles: Index) -> NDArray[np.bool_]:
    """True for faces with corners (f, k, 3) of whose triangles (f, t, 3) none has the opposite orientation."""
    points = np.take_along_axis(corners[:, :, None], triangles.reshape(len(corners), -1)[..., None, None], axis=1)
    points = points.reshape(*triangles.shape, 3)
    normal = np.cross(points[:, :, 1] - points[:, :, 0], points[:, :, 2] - points[:, :, 0])
    # The sum is the face's own, twice its area, whichever triangles it is cut in.
    whole = normal.sum(axis=1)
    along = np.einsum("ftx,fx->ft", normal, whole)
    return (along >= -_FLAT * np.einsum("fx,fx->f", whole, whole)[:, None]).all(axis=1)


def _triangulate_face(corners: Array) -> Index:
    """Triangles (k - 2, 3) of a face with corners (k, 3) that a fan from the first corner does not cover."""
    count = len(corners)
    if count > _MOST_CORNERS:
        raise InputError(f"has a face with {count} corners that is not convex", "export the surface as triangles")
    for first in range(1, count):
        fan = _fan((first + np.arange(count)[None]) % count)
        if _fan_covers(corners[None], fan)[0]:
            return fan[0]
    return _ears(_project(corners))


def _project(corners: Array) -> Array:
    """Corners (k, 2) in the plane of the face, turning to the left."""
    normal = np.cross(corners, np.roll(corners, -1, axis=0)).sum(axis=0)
    axis = int(np.argmax(np.abs(normal)))
    plane = corners[:, [(axis + 1) % 3, (axis + 2) % 3]]
    return plane if normal[axis] >= 0 else plane[:, ::-1]


def _ears(plane: Array) -> Index:
    """Triangles (k - 2, 3) of a simple polygon (k, 2): cuts off the corner whose triangle holds no other corner."""
    left, triangles = list(range(len(plane))), []
    while len(left) > 3:
        place = next((k for k in range(len(left)) if _is_ear(plane, left, k)), 0)
        triangles.append([left[place - 1], left[place], left[(place + 1) % len(left)]])
        del left[place]
    return np.array([*triangles, left])


def _is_ear(plane: Array, left: list[int], place: int) -> bool:
    ends = left[place - 1], left[place], left[(place + 1) % len(left)]
    a, b, c = plane[list(ends)]
    if _turn(a, b, c) <= 0:
        return False
    others = plane[[k for k in left if k not in ends]]
    # Corners that lie on those of the ear, where a hole was joined to the rim, do not stand in the way.
    others = others[~(others[:, None] == plane[list(ends)]).all(axis=2).any(axis=1)]
    inside = (_turn(a, b, others) >= 0) & (_turn(b, c, others) >= 0) & (_turn(c, a, others) >= 0)
    return not inside.any()


def _turn(a: Array, b: Array, c: Array) -> Array:
    """Twice the area of the triangles a, b, c: above 0 where they turn to the left."""
    return (b[..., 0] - a[..., 0]) * (c[..., 1] - a[..., 1]) - (b[..., 1] - a[..., 1]) * (c[..., 0] - a[..., 0])

"""Open surfaces, such as a scan of a face: which way they face, where they end, and what closes them. On the host."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from jaxform.mesh import meshes, topology, volumes
from jaxform.mesh.meshes import Mesh
from jaxform.tools import covers, opening

Array = NDArray[np.float64]
Integers = NDArray[np.integer]

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
    seams = covers.find_seams(mold.positions, edges, covers.SEAM * meshes.size(mold.positions))
    in_seam = np.bincount(rim, seams) > 0.5 * np.bincount(rim)
    rims = [edges[rim == one] for one in np.unique(rim) if not in_seam[one]]
    total = volumes.areas(mold.positions, mold.triangles).sum()
    largest = max((np.linalg.norm(_vector_area(mold.positions, one)) for one in rims), default=0.0)
    return rims if largest > _OPEN * total else None


def _curved_triangles(mold: Mesh) -> Integers:
    """The triangles (k, 3) of the pieces of a mold that are not flat, as a platen is."""
    piece = topology.components(mold.triangles, len(mold.positions))[mold.triangles[:, 0]]
    corners = mold.positions[mold.triangles]
    across = 0.5 * np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    # Of a flat piece all normals are along one line: the moment of its areas has one eigenvalue.
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
            fans.append(covers.fan(turned[line]))
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

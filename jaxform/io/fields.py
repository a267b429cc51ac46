"""Nodal fields in mesh files, carried over to another mesh by initial position."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from jaxform.core.errors import InputError
from jaxform.mesh import meshes
from jaxform.mesh.meshes import Mesh

Array = NDArray[np.float64]

SAME_PLACE = 1e-9
"""Distance up to which two nodes are at the same place, relative to the size of the field's mesh."""
FARTHEST = 0.05
"""Distance from the field's mesh beyond which nothing is known, relative to its size."""
_CANDIDATES = 16  # triangles, those with the nearest centres, among which the nearest is looked for


def nodal_field(path: str | Path, name: str, positions: Array, key: str = "") -> Array:
    """A field of a mesh file at other places: exactly where nodes agree, linear in the nearest triangle elsewhere.

    Args:
        path: The file; its positions are initial positions in m, or it has such as point data `reference` [m].
        name: The field, point data of one number per node.
        positions: Where it is wanted [m], shape (n, 3).
        key: Where the file is named, for messages.

    Returns:
        The field, shape (n,), in the unit of the file.

    Raises:
        InputError: The file is no mesh, has no such field, or is not at those positions.
    """
    try:
        mesh = meshes.used(meshes.read_mesh(path))
        if name in mesh.cell_fields:
            # The mean over the triangles around a node wants all of them to know it.
            mesh = meshes.weld(mesh)
        values = _values(mesh, name, f"{key}.field" if key else "field")
        return carried(_as_it_began(mesh, positions), values, positions)
    except InputError as error:
        raise error.within(key=f"{key}.file" if key else "file") from None


def _as_it_began(mesh: Mesh, positions: Array) -> Mesh:
    """A formed mesh at its initial positions, unless the places (n, 3) [m] are nodes of it as it is formed."""
    if not all(name in mesh.fields for name in meshes.REFERENCE):
        return mesh
    initial = np.stack([mesh.fields[name] for name in meshes.REFERENCE], axis=1)
    same = _tree(mesh.positions).query(positions)[0] <= SAME_PLACE * meshes.size(mesh.positions)
    # A sheet that is formed a second time is this mesh itself.
    return mesh if same.all() or not np.isfinite(initial).all() else replace(mesh, positions=initial)


def _values(mesh: Mesh, name: str, key: str) -> Array:
    known = meshes.nodal_fields(mesh)
    if name not in known:
        raise InputError("the file has no such field", f"its fields: {', '.join(sorted(known)) or 'none'}", key, name)
    if not np.isfinite(known[name]).all():
        raise InputError("the field is not finite everywhere", "repair the file", key, name)
    return known[name]


def carried(mesh: Mesh, values: Array, positions: Array) -> Array:
    """Nodal values (n_node,) of a mesh at other places (n, 3) [m], as `nodal_field` carries them over.

    Raises:
        InputError: The mesh is not at those places.
    """
    size = meshes.size(mesh.positions)
    apart, node = _tree(mesh.positions).query(positions)
    result = values[node]
    elsewhere = np.flatnonzero(apart > SAME_PLACE * size)
    if len(elsewhere):
        triangle, weight, distance = _nearest(mesh, positions[elsewhere])
        worst = int(np.argmax(distance))
        if distance[worst] > FARTHEST * size:
            place = ", ".join(f"{x:.4g}" for x in positions[elsewhere[worst]])
            problem = f"has nothing at ({place}) m: its mesh is {distance[worst]:.3g} m away"
            raise InputError(problem, "give a mesh of the initial sheet, in metres")
        result[elsewhere] = np.einsum("nk,nk->n", weight, values[mesh.triangles[triangle]])
    return result


def _tree(points: Array) -> Any:
    from scipy.spatial import KDTree  # takes a tenth of a second to import

    return KDTree(points)


def _nearest(mesh: Mesh, points: Array) -> tuple[NDArray[np.int64], Array, Array]:
    """The nearest triangle of each point, the weights of its corners at the nearest place, and the distance."""
    corners = mesh.positions[mesh.triangles]
    count = min(_CANDIDATES, len(corners))
    candidates = np.asarray(_tree(corners.mean(1)).query(points, k=count)[1]).reshape(len(points), count)
    weight = _weights(points[:, None], corners[candidates])
    place = np.einsum("nck,ncki->nci", weight, corners[candidates])
    distance = np.linalg.norm(place - points[:, None], axis=2)
    best = np.argmin(distance, axis=1)
    row = np.arange(len(points))
    return candidates[row, best], weight[row, best], distance[row, best]


def _weights(points: Array, corners: Array) -> Array:
    """Barycentric coordinates (..., 3) of the places in triangles (..., 3, 3) nearest to points (..., 3)."""
    options = [_inside(points, corners)]
    for k in range(3):
        begin, end = corners[..., k, :], corners[..., (k + 1) % 3, :]
        along = end - begin
        square = np.einsum("...i,...i", along, along)
        t = np.einsum("...i,...i", points - begin, along) / np.where(square > 0, square, 1.0)
        t = np.clip(t, 0.0, 1.0)
        option = np.zeros((*t.shape, 3))
        option[..., k], option[..., (k + 1) % 3] = 1.0 - t, t
        options.append(option)
    stacked = np.stack(options)
    places = np.einsum("o...k,...ki->o...i", stacked, corners)
    best = np.argmin(np.linalg.norm(places - points, axis=-1), axis=0)
    return np.take_along_axis(stacked, best[None, ..., None], axis=0)[0]


def _inside(points: Array, corners: Array) -> Array:
    """Coordinates of the foot of the perpendicular; those of the first corner where it is outside."""
    edge1, edge2 = corners[..., 1, :] - corners[..., 0, :], corners[..., 2, :] - corners[..., 0, :]
    away, normal = points - corners[..., 0, :], np.cross(edge1, edge2)
    square = np.einsum("...i,...i", normal, normal)
    square = np.where(square > 0, square, np.inf)
    second = np.einsum("...i,...i", np.cross(away, edge2), normal) / square
    third = np.einsum("...i,...i", np.cross(edge1, away), normal) / square
    inside = (second >= 0) & (third >= 0) & (second + third <= 1)
    second, third = np.where(inside, second, 0.0), np.where(inside, third, 0.0)
    return np.stack([1.0 - second - third, second, third], axis=-1)

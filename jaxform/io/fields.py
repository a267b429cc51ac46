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
from jaxform.tools.distances import Distances, Triangulation, interpolate, weights

Array = NDArray[np.float64]

SAME_PLACE = 1e-9
"""Distance up to which two nodes are at the same place, relative to the size of the field's mesh."""
FARTHEST = 0.05
"""Distance from the field's mesh beyond which nothing is known, relative to its size."""


def nodal_field(path: str | Path, name: str, positions: Array, key: str = "") -> Array:
    """A field of a mesh file at other places: exactly where nodes agree, linear in the nearest triangle elsewhere.

    Args:
        path: The file; its positions are initial positions in m, or it has such as point data `reference` [m].
        name: The field, point data of one number per node.
        positions: Positions at which it is evaluated [m], shape (n, 3).
        key: Key that names the file, for messages.

    Returns:
        The field, shape (n,), in the unit of the file.

    Raises:
        InputError: The file is no mesh, has no such field, or is not at those positions.
    """
    try:
        mesh = meshes.drop_unused_nodes(meshes.read_mesh(path))
        if name in mesh.cell_fields:
            # The mean over the triangles around a node wants all of them to know it.
            mesh = meshes.weld(mesh)
        values = _values(mesh, name, f"{key}.field" if key else "field")
        return transfer_values(_at_initial_positions(mesh, positions), values, positions)
    except InputError as error:
        raise error.with_context(key=f"{key}.file" if key else "file") from None


def _at_initial_positions(mesh: Mesh, positions: Array) -> Mesh:
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


def transfer_values(mesh: Mesh, values: Array, positions: Array) -> Array:
    """Nodal values (n_node,) of a mesh at other places (n, 3) [m], as `nodal_field` carries them over.

    Raises:
        InputError: The mesh is not at those places, or nothing of it has an area.
    """
    size = meshes.size(mesh.positions)
    apart, node = _tree(mesh.positions).query(positions)
    result = values[node]
    elsewhere = np.flatnonzero(apart > SAME_PLACE * size)
    if len(elsewhere):
        triangles = mesh.triangles[~meshes.find_degenerate(mesh.positions, mesh.triangles)]
        if not len(triangles):
            raise InputError("has no triangle with an area", "give a mesh of the initial sheet, in metres")
        found = Distances(Triangulation(mesh.positions, triangles), FARTHEST * size).nearest(positions[elsewhere])
        worst = int(np.argmax(found.distance))
        if found.distance[worst] > FARTHEST * size:
            place = ", ".join(f"{x:.4g}" for x in positions[elsewhere[worst]])
            problem = f"has nothing at ({place}) m: its mesh is {found.distance[worst]:.3g} m away"
            raise InputError(problem, "give a mesh of the initial sheet, in metres")
        weight = weights(found.place, mesh.positions[triangles[found.triangle]])
        result[elsewhere] = interpolate(values, triangles, found.triangle, weight)
    return result


def _tree(points: Array) -> Any:
    from scipy.spatial import KDTree  # takes a tenth of a second to import

    return KDTree(points)

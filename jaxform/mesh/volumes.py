"""Areas of triangles, and nodal thicknesses that have the volume of the triangles'."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from jaxform.mesh import meshes
from jaxform.mesh.meshes import Mesh

Array = NDArray[np.float64]
Index = NDArray[np.integer]


def areas(positions: Array, triangles: Index) -> Array:
    """Of triangles (m, 3) [m^2], shape (m,)."""
    corners = positions[triangles]
    doubled = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    return 0.5 * np.linalg.norm(doubled, axis=1)


def conserving(positions: Array, triangles: Index, nodal: Array, elements: Array) -> Array:
    """A nodal thickness (n,) [m] near a given positive one, whose volume is that of the elements' thickness (m,) [m].

    Each node's is multiplied by the mean, by area, of what its elements are thicker than their corners say. The volume
    of a linear field is a sum over nodes of a third of the area around, so the products add up exactly.
    """
    area, ratio = areas(positions, triangles), elements / nodal[triangles].mean(1)
    corner, count = triangles.reshape(-1), len(positions)
    around = np.bincount(corner, np.repeat(area, 3), count)
    # A node that no triangle with an area uses has no volume.
    share = np.bincount(corner, np.repeat(area * ratio, 3), count) / np.where(around > 0, around, 1.0)
    return nodal * np.where(around > 0, share, 1.0)


def nodal_fields(mesh: Mesh) -> dict[str, Array]:
    """The mesh's fields at its nodes; of a positive one that its triangles have too, with the triangles' volume."""
    found = meshes.nodal_fields(mesh)
    for name in mesh.fields.keys() & mesh.cell_fields.keys():
        nodal, elements = mesh.fields[name], mesh.cell_fields[name]
        if nodal.min() > 0 and elements.min() > 0:
            found[name] = conserving(mesh.positions, mesh.triangles, nodal, elements)
    return found

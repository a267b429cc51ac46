"""Sides, areas, volumes and reference metrics of triangles in NumPy, where JAX would compile for every mesh size."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from jaxform.core.errors import InputError, format_percent, warn_of
from jaxform.mesh import meshes
from jaxform.mesh.meshes import Mesh

Array = NDArray[np.float64]
Index = NDArray[np.integer]

_MOST_FOLDED = 0.99  # of an element, that may lie in folds: no wall is more than a hundred times as thick
_WORTH_TELLING = 1e-3  # the same share, from which it is warned of


def longest_sides(corners: Array) -> Array:
    """The longest side (n,) [m] of each triangle (n, 3, 3) [m]."""
    return np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(1)


def areas(positions: Array, triangles: Index) -> Array:
    """Areas of triangles (m, 3) [m^2], shape (m,)."""
    corners = positions[triangles]
    doubled = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    return 0.5 * np.linalg.norm(doubled, axis=1)


def conserve_volume(positions: Array, triangles: Index, nodal: Array, elements: Array) -> Array:
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


def add_fold_volume(mesh: Mesh, thickness: Array, file: str = "") -> Array:
    """The elements' thickness (m,) [m] such that with their area it has the volume of their folds too.

    Where a sheet has wrinkled the thickness is that of its material, which has a larger area than the elements: the
    mesh's cell field `wrinkled` is the share of it that lies in folds.

    Raises:
        InputError: That share is not finite.

    Warns:
        InputWarning: Some of the mesh lies in folds.
    """
    folds = mesh.cell_fields.get("wrinkled")
    if folds is None:
        return thickness
    if not np.isfinite(folds).all():
        raise InputError("is not finite everywhere", "run the scene again", "wrinkled", file=file)
    worst = float(folds.max())
    if worst > _WORTH_TELLING:
        problem = f"the sheet has wrinkled, up to {format_percent(worst, 3)} of an element lies in folds"
        remedy = "the exported thickness is that of the stacked folds, which keeps the volume, but in one flat layer"
        warn_of(problem, remedy, key="wrinkled", file=file)
    return thickness / (1.0 - np.clip(folds, 0.0, _MOST_FOLDED))


def nodal_fields(mesh: Mesh) -> dict[str, Array]:
    """The mesh's fields at its nodes; of a positive one that its triangles have too, with the triangles' volume.

    The volume of `thickness` is that of what lies in folds too, as `add_fold_volume` says, which raises and warns.
    """
    found = meshes.nodal_fields(mesh)
    for name in mesh.fields.keys() & mesh.cell_fields.keys():
        nodal, elements = mesh.fields[name], mesh.cell_fields[name]
        if nodal.min() > 0 and elements.min() > 0:
            elements = add_fold_volume(mesh, elements) if name == "thickness" else elements
            found[name] = conserve_volume(mesh.positions, mesh.triangles, nodal, elements)
    return found


# The initial geometry of elements in NumPy: on the host, where JAX would compile a program for every size of mesh.


def reference_metric(positions: Array, triangles: NDArray[np.integer]) -> tuple[Array, Array]:
    """Inverse metric (3, n_element) [1/m^2] and area (n_element,) [m^2], as `membrane.reference_metric` has them.

    Args:
        positions: Node positions (n_node, 3) [m].
        triangles: Node numbers (n_element, 3).
    """
    g11, g12, g22, determinant = _metric(positions, triangles)
    return np.stack([g22, -g12, g11]) / determinant, 0.5 * np.sqrt(determinant)


def shape_bound(positions: Array, triangles: NDArray[np.integer]) -> Array:
    """Largest eigenvalue (n_element,) [1/m^2] of the shape functions' gradients, as `stiffness.shape_bound` has it."""
    g11, g12, g22, determinant = _metric(positions, triangles)
    total = 2.0 * (g11 + g22 - g12) / determinant
    gap = np.square(total) - 12.0 / determinant
    return 0.5 * (total + np.sqrt(np.maximum(gap, 0.0)))


def enclosed_volume(positions: Array, triangles: NDArray[np.integer]) -> float:
    """Volume [m^3] between triangles and the origin."""
    first, second, third = (positions[triangles[:, k]] for k in range(3))
    return float(np.einsum("ij,ij->", first, np.cross(second - first, third - first))) / 6.0


def _metric(positions: Array, triangles: NDArray[np.integer]) -> tuple[Array, Array, Array, Array]:
    """The metric's components (n_element,) [m^2] and its determinant [m^4]."""
    first = positions[triangles[:, 0]]
    edge1, edge2 = positions[triangles[:, 1]] - first, positions[triangles[:, 2]] - first
    g11, g12, g22 = (np.einsum("ij,ij->i", a, b) for a, b in ((edge1, edge1), (edge1, edge2), (edge2, edge2)))
    return g11, g12, g22, g11 * g22 - g12 * g12

"""The initial geometry of elements in NumPy: on the host, where JAX would compile a program for every size of mesh."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


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

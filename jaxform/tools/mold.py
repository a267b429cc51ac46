"""The mold: a rigid triangulated surface to which the sheet sticks."""

from __future__ import annotations

import jax
import numpy as np

from jaxform.core.errors import InputError
from jaxform.core.pytree import as_index, as_real, pytree, static
from jaxform.mesh import meshes


@pytree
class Mold:
    """A rigid triangulated surface to which the sheet sticks; the triangles' orientation does not matter.

    Attributes:
        vertices: (n_vertex, 3) [m].
        triangles: Vertex numbers (n_triangle, 3).
        dropped: Degenerate or duplicate triangles that were left out of the file's.
    """

    vertices: jax.Array
    triangles: jax.Array
    dropped: int = static(default=0)


def make_mold(vertices: np.ndarray, triangles: np.ndarray, dropped: int = 0) -> Mold:
    """A mold from vertices (n_vertex, 3) [m] and triangles (n_triangle, 3).

    Degenerate triangles and copies are left out, and counted in `dropped` beside those left out before.

    Raises:
        InputError: If no triangle with an area is left, one has a vertex that is not there, or a coordinate is not
            finite.
    """
    vertices, triangles = np.asarray(vertices, float), np.asarray(triangles)
    if not np.all(np.isfinite(vertices)):
        raise InputError("a vertex of the mold is not finite", "repair the mesh", key="mold")
    if triangles.size and (triangles.min() < 0 or triangles.max() >= len(vertices)):
        raise InputError("a triangle of the mold has a vertex that is not there", "repair the mesh", key="mold")
    bad = meshes.degenerate(vertices, triangles) if len(triangles) else np.zeros(0, bool)
    if np.all(bad):
        raise InputError("the mold has no triangles", "give a surface mesh of triangles", key="mold")
    return Mold(as_real(vertices), as_index(triangles[~bad]), dropped + int(bad.sum()))

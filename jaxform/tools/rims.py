"""A sheet over the opening of a mold, in the plane of its rim. On the host."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from jaxform.core.errors import InputError
from jaxform.mesh import meshes, shapes
from jaxform.mesh.meshes import Mesh
from jaxform.mesh.shapes import Sheet
from jaxform.tools import footprint, opening

Array = NDArray[np.float64]

WELD = 1e-5
"""Distance, relative to a mold's size, within which corners are one in the search for openings."""


def weld_mold(vertices: Array, triangles: NDArray[np.integer]) -> Mesh:
    """A mold for the search for openings: pieces that meet are joined."""
    mold = Mesh(vertices, triangles.astype(np.int32))
    return meshes.drop_degenerate(meshes.weld(mold, WELD * meshes.size(vertices)))[0]


def sheet_over_opening(
    vertices: Array,
    triangles: NDArray[np.integer],
    *,
    element_size: float | None = None,
    elements: int | None = None,
) -> Sheet:
    """A sheet over the opening of a mold, with normals into the mold, clamped along its edge.

    Where the opening has a flange, the sheet reaches over it by a little.

    Args:
        vertices: The mold's (n, 3) [m].
        triangles: Vertex numbers (m, 3).
        element_size: Length of the sheet's edges [m]; or
        elements: About how many triangles.

    Raises:
        InputError: The mold has no opening, or a number is out of range.
    """
    mold = weld_mold(vertices, triangles)
    found = opening.find_opening(mold.positions, mold.triangles)
    if found.male:
        raise InputError("the mold has no opening: a plug stands out of it", "give polygon", "parison.mold_rim")
    polygon = footprint.outline(found, mold.positions, mold.triangles)
    sheet = shapes.outline(polygon=polygon, element_size=element_size, elements=elements)
    turn, shift = found.view.turn, np.array([0.0, 0.0, found.level])
    flat = sheet.snap
    assert flat is not None

    def snap(middles: Array, ends: Array, boundary: NDArray[np.bool_]) -> Array:
        return (flat(middles @ turn.T - shift, ends @ turn.T - shift, boundary) + shift) @ turn

    return replace(sheet, positions=(sheet.positions + shift) @ turn, snap=snap)

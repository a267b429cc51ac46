"""Rims that can move, along which the enclosed volume is not all that the sheet sweeps; on the host."""

from __future__ import annotations

import numpy as np

from jaxform.core.pytree import as_index
from jaxform.mesh import bisection, topology
from jaxform.model.tables import Rim

_ON_PLANE = 1e-9  # of the sheet's extent


def moving_rim(
    positions: np.ndarray,
    triangles: np.ndarray,
    held: np.ndarray,
    origin: np.ndarray,
    forest: bisection.TriangleForest | None = None,
) -> Rim | None:
    """The rim of a sheet whose edges sweep a cone with the origin as they move; None where none do.

    Edges of clamped nodes do not move, and those on a symmetry plane through the origin stay in it.

    Args:
        positions: Node positions (n_node, 3) [m].
        triangles: Node numbers (n_element, 3).
        held: Components that never move (n_node, 3).
        origin: Point from which the enclosed volume is counted (3,) [m].
        forest: Forest of a refined mesh; its nodes are those above.
    """
    if forest is None:
        ends, triangle = topology.open_sides(triangles), None
    else:
        triangle, side = np.nonzero(bisection.rim_sides(forest))
        ends = np.stack([forest.triangles[triangle, side], forest.triangles[triangle, (side + 1) % 3]], 1)
    there = held & (np.abs(positions - origin) <= _ON_PLANE * np.ptp(positions, axis=0).max())
    on_plane = np.any(there[ends].all(1), axis=1)
    moves = ~(on_plane | held[ends].all((1, 2)))
    if not moves.any():
        return None
    return Rim(as_index(ends[moves].T), None if triangle is None else as_index(triangle[moves]))

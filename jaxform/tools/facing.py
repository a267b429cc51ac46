"""The surface of the mold that a nearly flat sheet meets first on its way along the push, and its depth.

A place of the mold counts where the straight way back to the sheet, against the push, meets the sheet and no other part
of the mold. Undercuts, backs and outer faces of solids, and what lies beside the sheet do not count. On the host.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from jaxform.tools.crossings import proper_crossings
from jaxform.tools.distances import Distances, Triangulation
from jaxform.tools.mold import Mold
from jaxform.tools.search import SearchGrid

Array = NDArray[np.float64]
Integers = NDArray[np.integer]

_FLAT = 0.95  # of the area of a sheet, what its projection along the push must have
_BESIDE = 1e-6  # of the sheet's size: what is visible from its edge is before it
_CLOSE = 1e-3  # of the way back, that is left out: the place itself is on the mold
_EDGE = 1e-6  # of a triangle's sides: a way through an edge is blocked
_ASKED, _MORE = 64, 4  # places, the deepest ones, whose way back is examined first, and times as many then


@dataclass(frozen=True)
class Facing:
    """The surface of a mold before a nearly flat sheet.

    Attributes:
        positions: Nodes of the sheet (n_node, 3) [m].
        triangles: Its elements (n_element, 3).
        direction: Unit vector (3,) along which it is pushed.
        mold: The mold, in the frame of the sheet.
        grid: Its search structure.
        flat: Distances from the sheet's projection along the push.
    """

    positions: Array
    triangles: Integers
    direction: Array
    mold: Mold
    grid: SearchGrid
    flat: Distances

    def heights(self, places: Array) -> tuple[Array, NDArray[np.bool_]]:
        """Distances (n,) [m] of places (n, 3) [m] before the sheet along the push, and the mask of those before it."""
        near = self.flat.nearest(_project(places, self.direction))
        corners = self.positions[self.triangles[near.triangle]]
        normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        slope = np.einsum("ij,j->i", normal, self.direction)
        ahead = np.einsum("ij,ij->i", places - corners[:, 0], normal) / np.where(slope == 0, np.inf, slope)
        return ahead, (near.distance <= _BESIDE * self.flat.size) & (ahead > 0) & (slope != 0)

    def meets(self, places: Array) -> NDArray[np.bool_]:
        """Mask (n,) of the places of the mold (n, 3) [m] that the sheet meets first on its way along the push."""
        ahead, before = self.heights(places)
        found = np.flatnonzero(before)
        back = -ahead[found, None] * self.direction
        begin, end = places[found] + _CLOSE * back, places[found] + (1 - _CLOSE) * back
        before[found[proper_crossings(begin, end, self.mold, self.grid, margin=-_EDGE)[0]]] = False
        return before

    def depth(self, places: Array) -> float:
        """Largest distance [m] before the sheet of the places of the mold (n, 3) [m] that it meets; 0 of none."""
        ahead, before = self.heights(places)
        found = np.flatnonzero(before)
        order = found[np.argsort(-ahead[found], kind="stable")]
        first, count = 0, _ASKED
        while first < len(order):
            part = order[first : first + count]
            met = part[self.meets(places[part])]
            if len(met):
                return float(ahead[met[0]])
            first, count = first + count, _MORE * count
        return 0.0


def find_facing(positions: Array, triangles: Integers, push: float, mold: Mold, grid: SearchGrid) -> Facing | None:
    """Finds the mold's surface before a sheet; None where the sheet is not nearly flat, or nothing pushes it.

    Args:
        positions: Node positions (n_node, 3) [m].
        triangles: Their elements (n_element, 3), along whose normals pressure acts.
        push: The pressure [Pa]; its sign alone counts.
        mold: The mold.
        grid: Its search structure.
    """
    corners = positions[triangles]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    total, area = np.sign(push) * normal.sum(0), np.linalg.norm(normal, axis=1).sum()
    size = float(np.linalg.norm(total))
    if not size >= _FLAT * area > 0:
        return None
    direction = total / size
    flat = Distances(Triangulation(_project(positions, direction), triangles), float(np.ptp(positions, axis=0).max()))
    return Facing(positions, triangles, direction, mold, grid, flat)


def _project(places: Array, direction: Array) -> Array:
    """Places (n, 3) [m] moved along a unit vector (3,) into the plane through the origin across it."""
    return places - (places @ direction)[:, None] * direction

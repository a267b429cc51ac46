"""Molds of which the file holds a half or a quarter: the planes that they are cut in, and the rest. On the host."""

from __future__ import annotations

import itertools

import numpy as np
from numpy.typing import NDArray

from jaxform.mesh import meshes, topology
from jaxform.mesh.meshes import Mesh
from jaxform.tools import footprint, opening

_CUT = 0.1  # of the length of open rims, what lies in a plane in which the mold is cut


Plane = tuple[int, float]
"""A plane across an axis, 0 to 2 for x to z, at a place [m] along it."""


def _mirror(mesh: Mesh, plane: Plane) -> Mesh:
    """The mesh mirrored in a plane."""
    axis, level = plane
    positions = mesh.positions.copy()
    positions[:, axis] = 2 * level - positions[:, axis]
    return Mesh(positions, mesh.triangles[:, ::-1])


Completion = tuple[Mesh, list[Plane]]
"""The rest of a mold that is cut in a half or a quarter, and the planes in which it is cut."""


def _is_closed_by(mold: Mesh) -> bool:
    """True when the open edges of a mold are the rim of its opening: else its cut is taken for one."""
    edges, _ = topology.open_rims(mold.triangles, len(mold.positions))
    if not len(edges):
        return True
    found, size = opening.find_opening(mold.positions, mold.triangles), meshes.size(mold.positions)
    ends = mold.positions[edges]
    length = np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1)
    height = (ends @ found.view.turn[2]).mean(1)
    return bool(length[np.abs(height - found.base) <= opening.FLAT * size].sum() >= opening.RIM * length.sum())


def _length(edges: NDArray[np.floating]) -> float:
    """Total length [m] of edges (n, 2, k) [m]."""
    return float(np.linalg.norm(edges[:, 1] - edges[:, 0], axis=1).sum())


class _Lines:
    """The lines on which the surface of a mold ends, and those on which it bends sharply."""

    def __init__(self, mold: Mesh) -> None:
        self._open = mold.positions[topology.boundary_edges(mold.triangles)]
        self._sharp = topology.feature_edges(mold.positions, mold.triangles, rims=False)
        self._tolerance = opening.FLAT * meshes.size(mold.positions)

    def allow_plane(self, plane: Plane) -> bool:
        """True when the mold may be cut in a plane: it is open there, or has an edge inside of its outline there.

        Few planes meet this, and a test of one takes views of a mold twice as large from all sides.
        """
        if len(self._open):
            return _length(self._lines_in_plane(plane, self._open)) >= _CUT * _length(self._open)
        edges = self._lines_in_plane(plane, self._sharp)
        if not len(edges):
            return False
        low, high = edges.min((0, 1)) + self._tolerance, edges.max((0, 1)) - self._tolerance
        middles = edges.mean(1)
        return bool(((middles > low) & (middles < high)).all(1).any())

    def _lines_in_plane(self, plane: Plane, edges: NDArray[np.floating]) -> NDArray[np.floating]:
        """Those of edges (n, 2, 3) [m] that are in the plane (k, 2, 2), without the coordinate across it."""
        axis, level = plane
        there = (np.abs(edges[..., axis] - level) <= self._tolerance).all(1)
        return np.delete(edges[there], axis, axis=2)


def find_completion(mold: Mesh) -> Completion | None:
    """The rest of an open mold that has no rim by itself, but one together with its images; None if there is none.

    A closed solid is whole as it is.

    Args:
        mold: Welded; its box touches the planes [m].

    Returns:
        The rest, and the planes in which the mold is cut.
    """
    if topology.is_closed(mold.triangles) or opening.is_rimmed(mold.positions, mold.triangles):
        return None
    used = mold.positions[np.unique(mold.triangles)]
    lines = _Lines(mold)
    sides = [(axis, float(end[axis])) for end in (used.min(0), used.max(0)) for axis in range(3)]
    sides = [side for side in sides if lines.allow_plane(side)]
    pairs = [pair for pair in itertools.combinations(sides, 2) if pair[0][0] != pair[1][0]]
    for planes in [*((side,) for side in sides), *pairs]:
        images: list[Mesh] = []
        for plane in planes:
            images += [_mirror(part, plane) for part in [mold, *images]]
        whole = meshes.merge([mold, *images])
        whole = footprint.weld_mold(whole.positions, whole.triangles)
        if opening.is_rimmed(whole.positions, whole.triangles) and _is_closed_by(whole):
            return meshes.merge(images), list(planes)
    return None

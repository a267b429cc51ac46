"""The thinnest recovered wall of a part, and how much the wall scatters around it: found after the run, on the host.

One element's thickness is of first order in the element size, and of many elements the thinnest is the one that misses
most. The recovered thickness at the nodes is of second order (see `jaxform.results.recovery`).
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from jaxform.model.scene import Scene
from jaxform.results import sections

if TYPE_CHECKING:
    from jaxform.results.result import Result

Array = NDArray[np.float64]

_ALIKE = 1e-6  # of the size: radii and heights that differ by less are those of one ring
_ROUND = 12  # nodes or vertices to a whole ring, at least, that is round
_BAND = 0.75  # of an element's side, on both sides of the thinnest node's ring, in which nodes are of it
_SECTOR = 1.5  # of the same, along the ring, whose least wall is one value of the ring
_FEWEST = 3  # values without which there is no scatter around a ring


def thinnest_recovered(result: Result, scene: Scene) -> dict[str, Any]:
    """The least recovered thickness of the nodes that are not clamped, its place, and the scatter around it.

    Returns:
        `recovered` [m], `recovered_place` (3,) [m] in the part, `scatter` (the relative standard deviation), and
        `scatter_of`: 'ring' where sheet and mold are round, and it is that of the least recovered thickness around the
        axis; 'patch' elsewhere, where it is that of the elements which meet at the node, by initial area.
    """
    triangles = np.asarray(result.triangles)[np.asarray(result.used)]
    nodes, wall = np.unique(triangles), np.asarray(result.thickness, float)
    # To a clamped rim the wall is carried on from inside, which is no better than the elements there.
    inner = nodes[~np.asarray(scene.parison.clamped)[nodes]]
    candidates = inner if len(inner) else nodes
    node = int(candidates[np.argmin(wall[candidates])])
    around = _around_ring(scene, nodes, triangles, wall, node) if is_axisymmetric(scene) else np.zeros(0)
    of_ring = len(around) >= _FEWEST
    return {
        "recovered": float(wall[node]),
        "recovered_place": np.asarray(result.positions, float)[node].tolist(),
        "scatter": _spread(around, np.ones(len(around))) if of_ring else _spread(*_patch(result, scene, node)),
        "scatter_of": "ring" if of_ring else "patch",
    }


def is_axisymmetric(scene: Scene) -> bool:
    """True if a round sheet of axisymmetric thickness is formed freely or in a mold of revolution about the z axis."""
    if not sections.is_disc(scene):
        return False
    whole = 2 ** len(sections.symmetry_planes(scene))
    parison = scene.parison
    sheet, thickness = np.asarray(parison.positions, float), np.asarray(parison.thickness, float)
    if np.ptp(thickness) > _ALIKE * thickness.max():
        rings = np.stack([np.hypot(*sheet[:, :2].T) / np.ptp(sheet), thickness / thickness.max()], axis=1)
        if not _is_ring_pattern(rings, rings[:, 0] > _ALIKE, 2):
            return False
    if scene.mold is None:
        return True
    mold = scene.mold.where_it_turns()
    rings = np.stack([np.hypot(*mold[:, :2].T), mold[:, 2]], axis=1) / np.ptp(mold)
    return _is_ring_pattern(rings, rings[:, 0] > _ALIKE, _ROUND // whole)


def _is_ring_pattern(values: Array, off_axis: NDArray[np.bool_], fewest: int) -> bool:
    """True if each of the values (n, 2) off the axis occurs at least `fewest` times."""
    _, count = np.unique((values[off_axis] / _ALIKE).round(), axis=0, return_counts=True)
    return bool((count >= fewest).all())


def _around_ring(scene: Scene, nodes: NDArray[np.int64], triangles: NDArray[np.int64], wall: Array, node: int) -> Array:
    """The least recovered thickness (k,) of each sector of the ring of a node."""
    sheet = np.asarray(scene.parison.positions, float)
    corners = sheet[triangles[(triangles == node).any(1)]]
    side = float(np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).mean())
    radius, angle = np.hypot(*sheet[nodes, :2].T), np.arctan2(sheet[nodes, 1], sheet[nodes, 0]) % (2 * np.pi)
    ring = float(np.hypot(*sheet[node, :2]))
    of_ring = np.abs(radius - ring) <= _BAND * side
    count = int(2 * np.pi * ring / (_SECTOR * side))
    if not count:
        return np.zeros(0)
    sector = np.minimum((angle[of_ring] / (2 * np.pi) * count).astype(int), count - 1)
    least = np.full(count, np.inf)
    np.minimum.at(least, sector, wall[nodes][of_ring])
    return least[np.isfinite(least)]


def _patch(result: Result, scene: Scene, node: int) -> tuple[Array, Array]:
    """Thickness (k,) [m] and initial area (k,) [m^2] of the elements at a node."""
    triangles = np.asarray(result.triangles)
    at_node = np.asarray(result.used) & (triangles == node).any(1)
    corners = np.asarray(scene.parison.positions, float)[triangles[at_node]]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    return np.asarray(result.element_thickness, float)[at_node], 0.5 * np.linalg.norm(normal, axis=1)


def _spread(values: Array, weight: Array) -> float:
    """The standard deviation over the mean."""
    mean = np.average(values, weights=weight)
    return float(np.sqrt(np.average(np.square(values - mean), weights=weight)) / mean)

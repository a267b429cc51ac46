"""Covers for holes in the side walls of a mold, which no view along the push shows. On the host."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from jaxform.mesh import contours
from jaxform.mesh.meshes import Mesh
from jaxform.mesh.rows import distinct_rows
from jaxform.tools.cells import CellGrid, label_cells
from jaxform.tools.distances import Distances, Triangulation

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
Integers = NDArray[np.integer]

_LEAST = 6  # sides of cells: less is no hole but a crack
_AROUND = 2  # cells, by which a cover reaches over the edge of its hole
_REACH = 4.0  # cells, from which a cover's edge is drawn to the wall
_FLAT = 0.5  # cells, by which a cover may be off a plane to be made flat
_COARSE = 3  # cells along a triangle of a cover that is curved


def close_sides(found: CellGrid, mold: Mesh) -> list[Mesh]:
    """A cover for each hole through which the hollow leaks sideways.

    A cover is the skin of the cells that are seen, over the hole and a little beyond: its edge is drawn to the wall,
    and the rest of it spans that edge as a film would.

    Args:
        found: The cells behind the sheet.
        mold: The mold that they are of.
    """
    from scipy import ndimage

    leaks = found.leaks
    if not leaks.any():
        return []
    walls = Distances(Triangulation(mold.positions, mold.triangles), _REACH * found.width)
    part, _ = label_cells(leaks, corners=True)
    made = []
    for one, box in enumerate(ndimage.find_objects(part), start=1):
        near = tuple(slice(max(0, side.start - _AROUND - 1), side.stop + _AROUND + 1) for side in box)
        made.append(_patch(found.crop(near), part[near] == one, walls))
    return [patch for patch in made if patch is not None]


def _patch(found: CellGrid, hole: Mask, walls: Distances) -> Mesh | None:
    """The cover of one hole, or None where it is too small to be one."""
    cell = _dilate(hole) & found.seen
    sides = [_sides(found, cell, hole, axis, side) for axis in range(3) for side in (-1, 1)]
    quads, is_open = (np.concatenate(some) for some in zip(*sides, strict=True))
    if is_open.sum() < _LEAST:
        return None
    number, _, index, _ = distinct_rows(quads.reshape(-1, 3))
    quads = index.reshape(-1, 4)
    free = np.ones(len(number), bool)
    free[quads[~is_open]] = False
    points = found.low + found.width * number
    points[~free] = walls.nearest(points[~free]).place
    points = _relax_points(points, quads, free)
    return _planar_hull(points, found.width) or _merge_points(points, quads, _COARSE * found.width)


def _dilate(mask: Mask) -> Mask:
    """A mask with the cells around it, corners included."""
    from scipy import ndimage

    return np.asarray(ndimage.binary_dilation(mask, np.ones((3, 3, 3)), iterations=_AROUND), bool)


def _sides(found: CellGrid, cell: Mask, hole: Mask, axis: int, side: int) -> tuple[Integers, Mask]:
    """Corners (n, 4, 3), in cells, of those sides of cells beyond which nothing is seen; whether the outside is."""
    place = np.argwhere(cell)
    beyond = place + side * np.eye(3, dtype=int)[axis]
    # The sheet itself is beyond the first layer.
    kept = ((beyond >= 0) & (beyond < cell.shape)).all(1)
    place, beyond = place[kept], beyond[kept]
    unseen = ~found.seen[tuple(beyond.T)]
    place, beyond = place[unseen], beyond[unseen]
    steps = np.zeros((4, 3), int)
    steps[1:3, (axis + 1) % 3], steps[2:, (axis + 2) % 3] = 1, 1
    steps[:, axis] = int(side > 0)
    return place[:, None] + steps, found.outside[tuple(beyond.T)] & hole[tuple(place.T)]


def _relax_points(points: Array, quads: Integers, free: Mask) -> Array:
    """Points (n, 3) of which the free ones lie in the middle of their neighbours."""
    from scipy.sparse import coo_array, csgraph
    from scipy.sparse.linalg import splu

    ends = np.stack([quads, np.roll(quads, -1, axis=1)]).reshape(2, -1)
    size = (len(points), len(points))
    graph = coo_array((np.ones(ends.shape[1]), (ends[0], ends[1])), shape=size).tocsr()
    graph = ((graph + graph.T) > 0).astype(float)
    # What hangs on nothing that is drawn to the wall stays where it is.
    group = csgraph.connected_components(graph, directed=False)[1]
    inner = np.flatnonzero(free & np.isin(group, group[~free]))
    if not len(inner):
        return points
    outer = np.setdiff1d(np.arange(len(points)), inner)
    laplacian: Any = csgraph.laplacian(graph)
    rows = laplacian.tocsr()[inner]
    result = points.copy()
    result[inner] = splu(rows[:, inner].tocsc()).solve(-(rows[:, outer] @ points[outer]))
    return result


def _planar_hull(points: Array, width: float) -> Mesh | None:
    """The hull of points (n, 3) [m] in their plane, where they lie in one."""
    middle = points.mean(0)
    axes = np.linalg.svd(points - middle, full_matrices=False)[2]
    if np.abs((points - middle) @ axes[2]).max() > _FLAT * width:
        return None
    hull = contours.hull((points - middle) @ axes[:2].T)
    number = np.arange(1, len(hull) - 1)
    return Mesh(middle + hull @ axes[:2], np.stack([0 * number, number, number + 1], axis=1).astype(np.int32))


def _merge_points(points: Array, quads: Integers, size: float) -> Mesh:
    """Points (n, 3) [m] that are near each other made one, and the triangles between them."""
    _, _, group, count = distinct_rows(np.floor((points - points.min(0)) / size))
    middle = np.stack([np.bincount(group, along) for along in points.T], axis=1) / count[:, None]
    triangles = group[np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])]
    apart = (triangles != np.roll(triangles, 1, axis=1)).all(1)
    kept = distinct_rows(np.sort(triangles[apart], axis=1)).rows
    return Mesh(middle, kept.astype(np.int32))

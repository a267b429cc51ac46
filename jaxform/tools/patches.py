"""Covers for holes in side walls and for chambers, which no view along the push shows. On the host."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from jaxform.core.errors import InputError
from jaxform.mesh import outlines, planform, raster
from jaxform.mesh.meshes import Mesh
from jaxform.mesh.topology import distinct_rows
from jaxform.tools.distances import Distances
from jaxform.tools.opening import Opening

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
    walls = Distances(mold.positions, mold.triangles, _REACH * found.width)
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
    # Free points that are connected to no fixed one keep their places.
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
    hull = outlines.hull((points - middle) @ axes[:2].T)
    number = np.arange(1, len(hull) - 1)
    return Mesh(middle + hull @ axes[:2], np.stack([0 * number, number, number + 1], axis=1).astype(np.int32))


def _merge_points(points: Array, quads: Integers, size: float) -> Mesh:
    """Points (n, 3) [m] that are near each other made one, and the triangles between them."""
    _, _, group, count = distinct_rows(np.floor((points - points.min(0)) / size))
    middle = np.stack([np.bincount(group, along) for along in points.T], axis=1) / count[:, None]
    triangles = group[np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])]
    apart = (triangles != np.roll(triangles, 1, axis=1)).all(1)
    kept = distinct_rows(np.sort(triangles[apart], axis=1))[0]
    return Mesh(middle, kept.astype(np.int32))


# Holes in the side walls of a mold, behind a sheet that lies before it. On the host.

_ALL_ROUND = 0.5  # of the air beside the sheet's edge, from which an opening there is no notch but a gap all round


def find_side_holes(found: CellGrid) -> list[tuple[float, Array]]:
    """Holes through which the space behind a sheet is open to the outside of the mold, the largest first.

    A sheet at a distance before the mold is open all round: that is no hole.

    Returns:
        Of each hole the length of the longest side of its box [m], and its middle (3,) [m].
    """
    # Columns without a cell of the mold lie on its rim, by which less than half of them is covered: they are no hole.
    leaks = found.leaks & found.wall.any(axis=2)[..., None]
    part, count = label_cells(leaks, corners=True)
    sides = _open_sides(found, part, count)
    edge = _edge(found.seen)
    # The first layer of cells is closed beside the sheet.
    at_edge = np.bincount(part[:, :, 1][edge], minlength=count + 1) / max(int(edge.sum()), 1)
    made = []
    for one in np.flatnonzero((sides >= _LEAST) & (at_edge < _ALL_ROUND)):
        if one:
            cell = np.argwhere(part == one)
            place = found.low + found.width * (cell.mean(0) + 0.5)
            made.append((found.width * float(np.ptp(cell, axis=0).max() + 1), place))
    return sorted(made, key=lambda hole: -hole[0])


def _open_sides(found: CellGrid, part: NDArray[np.int64], count: int) -> NDArray[np.int64]:
    """Number of the sides of each part's cells (count + 1,) that are open to the outside."""
    total = np.zeros(count + 1, np.int64)
    for axis in range(3):
        ahead, behind = [slice(None)] * 3, [slice(None)] * 3
        ahead[axis], behind[axis] = slice(1, None), slice(None, -1)
        for one, other in ((ahead, behind), (behind, ahead)):
            total += np.bincount(part[tuple(one)][found.outside[tuple(other)]], minlength=count + 1)
    total[0] = 0
    return total


def _edge(seen: Mask) -> Mask:
    """Cells (nx, ny) of the second layer that are seen, and have a neighbour there that is not."""
    inside = seen[:, :, 1]
    around = np.pad(inside, 1)
    return inside & ~(around[2:, 1:-1] & around[:-2, 1:-1] & around[1:-1, 2:] & around[1:-1, :-2])


# Hollows that are wider than the way into them, as bottles and cans have them. On the host.

_COUNT = 100  # cells along the longest side
_CHAMBERS_AROUND = 4  # cells of air around the mold
_NARROW = 0.7  # of the width of a hollow, that the way into it is at most, to be a neck
_SHARE = 0.1  # of the mold's box, that such a hollow is at least
_CHAMBERS_LEAST, _STEPS = 1.5, 16  # cells: half the narrowest way that is resolved; and how many are checked


def refuse_bottles(mold: Mesh) -> None:
    """Raises an InputError where a mold [m] is a bottle, which is blown from a parison, not formed from a sheet."""
    found = widest_chamber(mold)
    if found is None:
        return
    width, neck, _ = found
    widths = f"about {1e3 * width:.2g} mm wide behind a neck of about {1e3 * neck:.2g} mm"
    problem = f"is a bottle: its cavity is {widths}"
    remedy = (
        "give --process stretch-blow to blow it from a preform, --process extrusion-blow from a tube, "
        f"--drape --direction=+{_flattest_axis(mold)} for a sheet over one side of it, or one half of it, cut along "
        "its axis, as a cavity"
    )
    raise InputError(problem, remedy)


def _flattest_axis(mold: Mesh) -> str:
    """The axis along which a mold is shortest: standing on its base, a bottle is too tall to be draped."""
    extent = np.ptp(mold.positions[np.unique(mold.triangles)], axis=0)
    return "xyz"[int(np.argmin(np.round(extent / extent.max(), 2)))]


def close_necks(mold: Mesh) -> list[Mesh]:
    """Covers on the ways into the hollow of a bottle, for a sheet that is formed over its outside; none of others."""
    found = widest_chamber(mold)
    return [] if found is None else close_sides(found[2], mold)


def widest_chamber(mold: Mesh) -> tuple[float, float, CellGrid] | None:
    """The hollow behind a neck of a mold [m], or None where a ball that fits a hollow can be brought into it.

    Returns:
        The width of the hollow [m], the width of the widest way into it [m], and cells in which all other air around
        the mold is seen, and the hollow is what is outside.
    """
    from scipy import ndimage

    corners = mold.positions[mold.triangles]
    low, extent = corners.min((0, 1)), np.ptp(corners, axis=(0, 1))
    width = float(extent.max()) / _COUNT
    low = low - (_CHAMBERS_AROUND + 0.5) * width
    shape = np.ceil(extent / width).astype(np.int64) + 2 * _CHAMBERS_AROUND + 1
    wall = surface_cells((corners - low) / width, shape)
    air = _border_cells(~wall)
    away: Any = ndimage.distance_transform_edt(~wall)
    for half in np.geomspace(_CHAMBERS_LEAST, max(float(shape.min()) / 2, 2 * _CHAMBERS_LEAST), _STEPS):
        wide = air & (away > half)
        inner = wide & ~_border_cells(wide)
        deepest = float(away[inner].max(initial=0.0))
        if half > _NARROW * deepest:
            continue
        # The hollow is what a ball of that size, rolling outside, does not touch; outer corners are none.
        rolled: Any = ndimage.distance_transform_edt(~(wide & ~inner))
        part, _ = label_cells(air & (rolled > half))
        hollow = np.isin(part, np.unique(part[inner])) & (part > 0)
        if hollow.sum() >= _SHARE * np.prod(extent) / width**3:
            parted = CellGrid(low, width, wall, air & ~hollow, hollow)
            return 2 * deepest * width, 2 * float(half) * width, parted
    return None


def _border_cells(air: Mask) -> Mask:
    """The cells of air from which a path leads to the grid's edge."""
    part, count = label_cells(air)
    out = np.zeros(count + 1, bool)
    for side in (part[0], part[-1], part[:, 0], part[:, -1], part[..., 0], part[..., -1]):
        out[np.unique(side)] = True
    out[0] = False
    return out[part]


# The hollow behind a sheet in cubic cells: what is seen through its opening, what is hidden, what leaks. On the host.

_CELL_COUNT = 200  # cells along the longest side


@dataclass(frozen=True)
class CellGrid:
    """Cubic cells, counted along x, y and z.

    Attributes:
        low: Least corner of the first (3,) [m].
        width: Width of a cell [m].
        wall: Cells (nx, ny, nz) that a surface passes through.
        seen: Cells of air that are visible from the sheet along +z, up to the first surface.
        outside: Those of other air from which a way leads out of the mold.
    """

    low: Array
    width: float
    wall: Mask
    seen: Mask
    outside: Mask

    def crop(self, box: tuple[slice, ...]) -> CellGrid:
        """The cells in a box."""
        low = self.low + self.width * np.array([side.start for side in box])
        return CellGrid(low, self.width, self.wall[box], self.seen[box], self.outside[box])

    @property
    def leaks(self) -> Mask:
        """Visible cells (nx, ny, nz) with a neighbour on the outside."""
        return self.seen & neighbour_cells(self.outside)

    @property
    def hidden_ratio(self) -> float:
        """Ratio of the hidden to the visible volume of air behind the sheet."""
        part, count = label_cells(~self.wall & ~self.seen & ~self.outside)
        met = np.zeros(count + 1, bool)
        met[np.unique(part[neighbour_cells(self.seen)])] = True
        met[0] = False
        return float(met[part].sum() / max(int(self.seen.sum()), 1))


def cells(corners: Array, polygon: Array, found: Opening) -> CellGrid:
    """The cells of the space behind a sheet.

    Args:
        corners: Corners of the mold's triangles (n, 3, 3) [m], rotated so that the sheet is pushed to +z.
        polygon: Outline of the sheet (k, 2) [m].
        found: The opening, in the plane of which the sheet lies.
    """

    def over(places: Array) -> Mask:
        # A sheet may reach over the outer edge of a narrow rim, by less than a cell.
        return found.view.sample(found.cavity, places) & planform.inside(places, [polygon])

    return cells_behind(corners, found.level, over)


def cells_behind(corners: Array, level: float, over: Callable[[Array], Mask]) -> CellGrid:
    """The cells of the space behind a flat sheet.

    Args:
        corners: Corners of the mold's triangles (n, 3, 3) [m], rotated so that the sheet is pushed to +z.
        level: Height of the sheet [m].
        over: The mask (n,) of places (n, 2) [m] that are behind the sheet.
    """
    used = corners.reshape(-1, 3)
    extent = np.append(np.ptp(used[:, :2], axis=0), used[:, 2].max() - level)
    width = float(extent.max()) / _CELL_COUNT
    low = np.append(used[:, :2].min(0) - (_AROUND + 0.5) * width, level - 0.5 * width)
    shape = np.ceil(extent / width).astype(np.int64) + _AROUND * np.array([2, 2, 1]) + 2
    wall = surface_cells((corners - low) / width, shape)
    columns, rows = (low[k] + width * (np.arange(shape[k]) + 0.5) for k in range(2))
    places = np.stack(np.meshgrid(columns, rows, indexing="ij"), axis=-1)
    sheet = over(places.reshape(-1, 2)).reshape(places.shape[:2])
    seen = sheet[..., None] & ~np.logical_or.accumulate(wall, axis=2)
    # A flange may lie anywhere in the first layer: nothing passes between the sheet and it.
    wall[..., 0] |= ~seen[..., 0]
    return CellGrid(low, width, wall, seen, _outside(~wall & ~seen))


def surface_cells(corners: Array, shape: NDArray[np.integer]) -> Mask:
    """The cells (nx, ny, nz) that triangles (n, 3, 3) pass through, in cells, closed to ways through cells' sides."""
    wall = np.zeros(shape, bool)
    for axis in range(3):
        one, other = (k for k in range(3) if k != axis)
        wide, high = int(shape[one]), int(shape[other])
        across = np.moveaxis(wall, (one, other, axis), (0, 1, 2))
        for _, pixel, interpolate in raster.rasterize(corners[..., [one, other]], wide, high):
            depth = np.floor(interpolate(corners[..., axis])).astype(int)
            within = (depth >= 0) & (depth < shape[axis])
            row, column = np.divmod(pixel[within], wide)
            across[column, row, depth[within]] = True
    return wall


def _outside(air: Mask) -> Mask:
    """The cells of air from which a way leads to the grid's sides or bottom."""
    part, count = label_cells(air)
    out = np.zeros(count + 1, bool)
    for side in (part[0], part[-1], part[:, 0], part[:, -1], part[..., -1]):
        out[np.unique(side)] = True
    out[0] = False
    return out[part]


def label_cells(mask: Mask, corners: bool = False) -> tuple[NDArray[np.int64], int]:
    """The number of the connected part that each cell is in, from 1, 0 outside; and how many there are.

    Args:
        mask: The cells.
        corners: True if cells that meet in an edge or a corner are connected.
    """
    from scipy import ndimage

    found: Any = ndimage.label(mask, np.ones((3, 3, 3)) if corners else None)
    return found[0], int(found[1])


def neighbour_cells(mask: Mask) -> Mask:
    """The cells that share a side with one of a mask."""
    near = np.zeros_like(mask)
    for axis in range(3):
        ahead, behind = [slice(None)] * 3, [slice(None)] * 3
        ahead[axis], behind[axis] = slice(1, None), slice(None, -1)
        near[tuple(ahead)] |= mask[tuple(behind)]
        near[tuple(behind)] |= mask[tuple(ahead)]
    return near

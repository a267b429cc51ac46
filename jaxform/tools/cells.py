"""The hollow behind a sheet in cubic cells: what is seen through its opening, what is hidden, what leaks. On the host.

Heights seen along the push do not show a hole in a wall that is upright: a rim is above it. Cells do: air that is seen
through the opening and has a neighbour from which a way leads out of the mold is at a hole.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from jaxform.mesh import planform, raster
from jaxform.tools.opening import Opening

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

_COUNT = 200  # cells along the longest side
_AROUND = 2  # cells of air around the mold, and half a cell more, so that no surface lies between two


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
    def hidden(self) -> float:
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
    width = float(extent.max()) / _COUNT
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
        corners: Whether cells that meet in an edge or a corner are connected.
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

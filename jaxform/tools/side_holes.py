"""Holes in the side walls of a mold, behind a sheet that lies before it. On the host."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from jaxform.tools.cells import CellGrid, label_cells

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

_LEAST = 6  # sides of cells: a smaller opening is a crack
_ALL_ROUND = 0.5  # of the air beside the sheet's edge, from which an opening there is no notch but a gap all round


class SideHole(NamedTuple):
    """A hole in a side wall.

    Attributes:
        place: Middle of the hole (3,) [m].
        size: Length of the longest side of its box [m].
    """

    place: Array
    size: float


def find_side_holes(found: CellGrid) -> list[SideHole]:
    """Holes through which the space behind a sheet is open to the outside of the mold, the largest first.

    A sheet at a distance before the mold is open all round: that is no hole.
    """
    leaks = found.leaks
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
            made.append(SideHole(place, found.width * float(np.ptp(cell, axis=0).max() + 1)))
    return sorted(made, key=lambda hole: -hole.size)


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

"""Hollows that are wider than the way into them, as bottles and cans have them. On the host."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from jaxform.core.errors import InputError
from jaxform.mesh.meshes import Mesh
from jaxform.tools import cells
from jaxform.tools.cells import CellGrid
from jaxform.tools.patches import close_sides

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

_COUNT = 100  # cells along the longest side
_AROUND = 4  # cells of air around the mold
_NARROW = 0.7  # of the width of a hollow, that the way into it is at most, to be a neck
_SHARE = 0.1  # of the mold's box, that such a hollow is at least
_LEAST, _STEPS = 1.5, 16  # cells: half the narrowest way that is resolved; and how many are checked


class Chamber(NamedTuple):
    """A hollow behind a neck.

    Attributes:
        width: Width of the hollow [m].
        neck: Width of the widest way into it [m].
        cells: In which all other air around the mold is seen, and the hollow is what is outside.
    """

    width: float
    neck: float
    cells: CellGrid


def refuse_bottles(mold: Mesh) -> None:
    """Raises an InputError where a mold [m] is a bottle, which is blown from a parison, not formed from a sheet."""
    found = widest_chamber(mold)
    if found is None:
        return
    widths = f"about {1e3 * found.width:.2g} mm wide behind a neck of about {1e3 * found.neck:.2g} mm"
    problem = f"is a bottle: its hollow is {widths}"
    remedy = (
        f"`new` makes no scene for blow moulding; give --drape --direction=+{_flattest_axis(mold)} for a sheet over "
        "one side of it, or one half of it, cut along its axis, as a cavity"
    )
    raise InputError(problem, remedy)


def _flattest_axis(mold: Mesh) -> str:
    """The axis along which a mold is shortest: standing on its base, a bottle is too tall to be draped."""
    extent = np.ptp(mold.positions[np.unique(mold.triangles)], axis=0)
    return "xyz"[int(np.argmin(np.round(extent / extent.max(), 2)))]


def close_necks(mold: Mesh) -> list[Mesh]:
    """Covers on the ways into the hollow of a bottle, for a sheet that is formed over its outside; none of others."""
    found = widest_chamber(mold)
    return [] if found is None else close_sides(found.cells, mold)


def widest_chamber(mold: Mesh) -> Chamber | None:
    """The hollow behind a neck of a mold [m], or None where a ball that fits a hollow can be brought into it."""
    from scipy import ndimage

    corners = mold.positions[mold.triangles]
    low, extent = corners.min((0, 1)), np.ptp(corners, axis=(0, 1))
    width = float(extent.max()) / _COUNT
    low = low - (_AROUND + 0.5) * width
    shape = np.ceil(extent / width).astype(np.int64) + 2 * _AROUND + 1
    wall = cells.surface_cells((corners - low) / width, shape)
    air = _border_cells(~wall)
    away: Any = ndimage.distance_transform_edt(~wall)
    for half in np.geomspace(_LEAST, max(float(shape.min()) / 2, 2 * _LEAST), _STEPS):
        wide = air & (away > half)
        inner = wide & ~_border_cells(wide)
        deepest = float(away[inner].max(initial=0.0))
        if half > _NARROW * deepest:
            continue
        # What a ball of that size, which rolls outside, does not touch; corners outside are no hollow.
        rolled: Any = ndimage.distance_transform_edt(~(wide & ~inner))
        part, _ = cells.label_cells(air & (rolled > half))
        hollow = np.isin(part, np.unique(part[inner])) & (part > 0)
        if hollow.sum() >= _SHARE * np.prod(extent) / width**3:
            parted = CellGrid(low, width, wall, air & ~hollow, hollow)
            return Chamber(2 * deepest * width, 2 * float(half) * width, parted)
    return None


def _border_cells(air: Mask) -> Mask:
    """The cells of air from which a path leads to the grid's edge."""
    part, count = cells.label_cells(air)
    out = np.zeros(count + 1, bool)
    for side in (part[0], part[-1], part[:, 0], part[:, -1], part[..., 0], part[..., -1]):
        out[np.unique(side)] = True
    out[0] = False
    return out[part]

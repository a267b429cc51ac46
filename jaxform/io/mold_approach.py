"""Distance of a moving mold from the sheet. On the host."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from jaxform.core.errors import warn_of
from jaxform.core.pytree import as_real
from jaxform.model.scene import Scene
from jaxform.tools.distances import Distances

Array = NDArray[np.float64]

_NEAR = 1e-4  # of the sheet's size: a mold that touches it at first may well pull it along
_SAME = 1e-3  # of a distance: one that is as much less is nearer
_FARTHER = 0.02  # of the sheet's size, that a mold moves off
_TIMES = 21  # times at which the distance of the mold is measured


class Approach(NamedTuple):
    """Distances of a moving mold from the initial sheet.

    Attributes:
        first: Distance at the start [m].
        nearest: Smallest distance [m].
        last: Distance at the end of the motion [m].
        end: Time of that end [s].
    """

    first: float
    nearest: float
    last: float
    end: float


def measure_approach(scene: Scene) -> Approach | None:
    """Distances of a scene's mold from the initial sheet; None where it does not move."""
    if scene.mold is None or scene.motion is None:
        return None
    sheet = np.asarray(scene.parison.positions, float)[np.unique(np.asarray(scene.parison.triangles))]
    size = float(np.ptp(np.concatenate([sheet, scene.mold.where_it_turns()]), axis=0).max())
    end = min(float(scene.solver.end_time), float(np.asarray(scene.motion.time)[-1]))
    distances = Distances(scene.mold, size)
    away = [
        float(distances.upper_bounds(sheet - np.asarray(scene.motion.offset(as_real(time)), float)).min())
        for time in np.linspace(0.0, end, _TIMES)
    ]
    return Approach(away[0], min(away), away[-1], end)


def warn_of_motion(scene: Scene, file: str) -> None:
    """Warns of a mold that moves away from a sheet which it is not near to, and never comes nearer."""
    found = measure_approach(scene)
    if found is None or scene.motion is None:
        return
    size = float(np.ptp(np.asarray(scene.parison.positions, float), axis=0).max())
    moves_off = found.nearest >= (1 - _SAME) * found.first and found.last > found.first + _FARTHER * size
    if found.first <= _NEAR * size or not moves_off:
        return
    way = np.asarray(scene.motion.direction, float).tolist()
    ends = f"{found.first:.3g} m from the sheet at first, {found.last:.3g} m at {found.end:.3g} s"
    warn_of(
        f"the mold moves without coming nearer to the sheet: {ends}",
        "turn mold.motion.direction round, or move the mold to the other side of the sheet (mold.translate)",
        key="mold.motion.direction",
        value=way,
        file=file,
    )

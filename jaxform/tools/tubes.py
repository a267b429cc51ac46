"""Tubes: bodies that are open from end to end. On the host."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from jaxform.core.errors import InputError
from jaxform.mesh import masks
from jaxform.mesh.meshes import Mesh
from jaxform.tools import heights, opening

Array = NDArray[np.float64]

_SHARE = 0.3  # of what a body covers and surrounds, seen along a tube, that one sees through at least
_DEEP = 1.0  # times the width of that opening: what is shorter is a frame, over whose opening a sheet is drawn
_PIXELS = 120
_ALONG = np.cos(np.radians(3.0))  # to another direction, within which it is the same


class Tube(NamedTuple):
    """The widest way through a body.

    Attributes:
        direction: Unit vector (3,) along it.
        width: Width of the opening that one sees through [m].
        length: Length of the body along it [m].
    """

    direction: Array
    width: float
    length: float


def widest_tube(mold: Mesh) -> Tube | None:
    """The widest way through a mold [m] that is longer than it is wide; None where there is none."""
    surface = heights.make_viewed_surface(mold.positions, mold.triangles)
    used = mold.positions[np.unique(mold.triangles)]
    found = []
    for direction in _directions(mold):
        view = heights.view_heights(surface, opening.rotation_to_z(direction), _PIXELS)
        through = view.inside & ~np.isfinite(view.height)
        width, length = 2 * view.pixel * float(masks.distance(through).max()), float(np.ptp(used @ direction))
        if through.sum() >= _SHARE * view.inside.sum() and length >= _DEEP * width:
            found.append(Tube(direction, width, length))
    return max(found, key=lambda tube: tube.width, default=None)


def refuse_tubes(mold: Mesh) -> None:
    """Raises an InputError where a mold [m] is a tube: a sheet over one end would be blown out of the other."""
    tube = widest_tube(mold)
    if tube is None:
        return
    across = "xyz"[int(np.argmin(np.round(np.abs(tube.direction), 6)))]
    size = f"{1e3 * tube.width:.3g} mm wide and {1e3 * tube.length:.3g} mm long"
    problem = f"is open from end to end: a tube, {size} inside"
    remedy = f"close one end, or give --drape --direction=+{across} for a sheet over its side"
    raise InputError(problem, remedy)


def _directions(mold: Mesh) -> list[Array]:
    """The axes (3,), then normals of flat faces and principal axes of the vertices that are beside them."""
    chosen, used = list(np.eye(3)), mold.positions[np.unique(mold.triangles)]
    principal = np.linalg.svd(used - used.mean(0), full_matrices=False)[2]
    for normal in (*opening.plane_normals(mold.positions, mold.triangles), *principal):
        if max(abs(float(normal @ other)) for other in chosen) < _ALONG:
            chosen.append(normal)
    return chosen

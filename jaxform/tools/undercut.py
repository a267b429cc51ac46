"""Undercuts of a male mold: surfaces that are hidden from a sheet that comes from one side. On the host."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from jaxform.mesh import masks, topology
from jaxform.mesh.meshes import Mesh
from jaxform.tools import heights
from jaxform.tools.buck import Buck

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

_LEVELS = 24
_SEEN = 3.0  # pixels: less is no undercut
_PIXELS = 480  # of the longer side


class Undercut(NamedTuple):
    """The place where a mold recedes farthest under what is above it.

    Attributes:
        depth: Its depth, sideways [m].
        place: The place, in the file's axes (3,) [m].
    """

    depth: float
    place: Array


def deepest_undercut(buck: Buck, mold: Mesh) -> Undercut | None:
    """The deepest undercut above the platen; None where there is none.

    Args:
        buck: The mold in its pose.
        mold: The mold (n, 3) [m], not turned, its rims closed.
    """
    turn = buck.view.turn
    corners = (mold.positions @ turn.T)[mold.triangles]
    view = heights.view_heights(heights.make_viewed_surface(mold.positions, mold.triangles), turn, _PIXELS)
    found = [_undercut_at(level, corners, view) for level in np.linspace(buck.top, buck.base, _LEVELS + 2)[1:-1]]
    worst = max(found, key=lambda one: one.depth)
    if worst.depth < _SEEN * view.pixel:
        return None
    return Undercut(worst.depth, worst.place @ turn)


def _undercut_at(level: float, corners: Array, view: heights.Heights) -> Undercut:
    """The deepest undercut at a height [m], its place after turning."""
    wall = _section(level, corners, view)
    part, _ = masks.label_parts(~wall)
    shadow = view.height < level - 0.5 * view.pixel
    depth = np.where((part == part[0, 0]) & ~wall, masks.distance(shadow), 0.0)
    row, column = np.unravel_index(int(np.argmax(depth)), depth.shape)
    place = view.low + view.pixel * (np.array([column, row]) + 0.5)
    return Undercut(float(depth[row, column]) * view.pixel, np.append(place, level))


def _section(level: float, corners: Array, view: heights.Heights) -> Mask:
    """The pixels (ny, nx) through which the surface passes at a height [m]."""
    # A level that meets corners exactly is moved off them.
    rise = corners[..., 2] - level
    rise = np.where(rise == 0, 1e-12 * view.pixel, rise)
    cut = corners[(rise.min(1) < 0) & (rise.max(1) > 0)]
    rise = rise[(rise.min(1) < 0) & (rise.max(1) > 0)]
    following = np.roll(rise, -1, axis=1)
    crossed = (rise < 0) != (following < 0)
    share = np.where(crossed, rise / np.where(crossed, rise - following, 1.0), 0.0)[..., None]
    points = cut + share * (np.roll(cut, -1, axis=1) - cut)
    # Two of the three sides of each are crossed.
    ends = points[crossed].reshape(-1, 2, 3)
    along = topology.edge_points(ends, view.pixel)
    wall = np.zeros(view.inside.shape, bool)
    column, row = np.floor((along[:, :2] - view.low) / view.pixel).astype(int).T
    wall[row, column] = True
    return wall

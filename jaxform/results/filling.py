"""Filling of a mold by a formed part: the widest gap, measured against the depth of the opening. On the host."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from jaxform.core.errors import format_place
from jaxform.core.pytree import as_real
from jaxform.model.scene import Scene
from jaxform.sheet.state import Status
from jaxform.tools import gaps
from jaxform.tools.gaps import NO_GAP, Gap, mold_points, widest_gap

if TYPE_CHECKING:
    from jaxform.results.result import Result

Array = NDArray[np.float64]

OPEN = 0.2  # of the opening's depth: what is left open of a part that does not fill its mold
_NOTICED = 0.02  # of the same, that is warned of
_SMALL = 2e-3  # of the mold's size: a smaller gap is not measured against the depth
_BRIDGED, _WIDE = 2.0, 0.025  # sides of an element, and of the mold's size, that a gap which stays open is wide


class Filling(NamedTuple):
    """Gaps between a formed part and its mold.

    Attributes:
        gap: The widest gap between the part and the mold before it.
        depth: Depth of the opening [m]: initial distance, along the push, from the sheet to the deepest place of the
            mold that it meets first; 0 where the gap is so small that it was not measured.
        left: The widest gap, of at least a fifth of the depth, before places that the sheet is to reach, where elements
            are free to move: then the mold is not filled. `NO_GAP` where there is none.
    """

    gap: Gap
    depth: float
    left: Gap

    @property
    def unfilled(self) -> bool:
        """True if a fifth of the opening's depth or more is left open."""
        return self.left.width > 0.0


def measure_filling(result: Result, scene: Scene) -> Filling:
    """Gaps between the formed part and its mold; no gap where there is no mold, or no part."""
    positions, lost = np.asarray(result.positions, float), Status.RUNAWAY | Status.ESCAPED | Status.BURST
    if scene.mold is None or scene.tables.grid is None or int(result.status) & lost or not np.isfinite(positions).all():
        return Filling(NO_GAP, 0.0, NO_GAP)
    triangles, clamped = np.asarray(result.triangles)[np.asarray(result.used)], np.asarray(scene.parison.clamped)
    offset, push, mold, grid = mold_offset(result, scene), scene.strongest_push(), scene.mold, scene.tables.grid
    formed = positions - offset, triangles, np.asarray(result.wall), clamped, push, mold, grid
    places = _places(scene, offset)
    gap = widest_gap(*formed, places=places)
    if gap.element < 0 or not gap.width > _SMALL * float(grid.size):
        return Filling(_offset_gap(gap, offset), 0.0, NO_GAP)
    start = np.asarray(scene.parison.positions, float)
    ahead = gaps.find_facing(start[: scene.first_nodes], np.asarray(scene.parison.triangles), push, mold, grid)
    depth = 0.0 if ahead is None else ahead.depth(places)
    depth = depth or _first_gap(scene, push, places)
    left = NO_GAP
    if depth > 0.0 and gap.width >= OPEN * depth:
        held = clamped[triangles].any(1) | np.asarray(result.stuck)[triangles].all(1)
        left = widest_gap(*formed, held=held, counts=None if ahead is None else ahead.meets, places=places)
        left = left if left.width >= OPEN * depth else NO_GAP
    return Filling(_offset_gap(gap, offset), depth, _offset_gap(left, offset))


def _places(scene: Scene, offset: Array) -> Array:
    """The places (n, 3) [m] of the mold, as it starts, that the part is to reach in the end."""
    assert scene.mold is not None
    part = scene.part
    if part is None:
        return mold_points(scene.mold)
    places = mold_points(scene.mold, None if part.walls is None else np.asarray(part.walls))
    return places[np.asarray(part.holds(places + offset))]


def _first_gap(scene: Scene, push: float, places: Array) -> float:
    """The widest gap [m] before the initial sheet, for one that meets nothing straight along the push."""
    parison, lying = scene.parison, scene.tables.initial_contact
    assert scene.mold is not None
    wall = np.zeros(len(parison.positions), int) if lying is None else np.asarray(lying)
    first, triangles = np.asarray(parison.positions, float), np.asarray(parison.triangles)
    none = np.zeros(len(triangles), bool)
    start = first, triangles, wall, np.asarray(parison.clamped), push, scene.mold, scene.tables.grid
    return widest_gap(*start, held=none, places=places).width


def mold_offset(result: Result, scene: Scene) -> Array:
    """Displacement of the mold (3,) [m] at the end of the run; its grid is at the initial position."""
    return np.zeros(3) if scene.motion is None else np.asarray(scene.motion.offset(as_real(float(result.time))), float)


def _sides(result: Result, scene: Scene, gap: Gap) -> Array:
    """The initial sides (3,) [m] of the element that is nearest to a gap, ascending."""
    nodes = np.asarray(result.triangles)[np.asarray(result.used)][gap.element]
    corners = np.asarray(scene.parison.positions, float)[nodes]
    return np.sort(np.linalg.norm(corners - np.roll(corners, 1, axis=0), axis=1))


def warnings_of_filling(result: Result, scene: Scene, filling: Filling) -> list[str]:
    """A sentence where the part is visibly short of its mold, with the place, how much, and the remedy."""
    gap, mold = filling.gap, scene.mold
    if (
        mold is None
        or gap.element < 0
        or filling.unfilled
        or int(result.status) & ~(Status.UNBALANCED | Status.UNFILLED)
    ):
        return []
    nodes = np.asarray(result.triangles)[np.asarray(result.used)][gap.element]
    sides, size = _sides(result, scene, gap), float(np.ptp(mold.where_it_turns(), axis=0).max())
    noticed = scene.fill and gap.width > max(float(sides[1]), _NOTICED * filling.depth) and filling.depth > 0.0
    if np.asarray(result.stuck)[nodes].all():
        if gap.width <= max(_BRIDGED * float(sides[2]), _WIDE * size) and not noticed:
            return []
        return [
            f"a gap of {gap.width:.3g} m between sheet and mold is closed off by contact all around, at "
            f"{format_place(gap.place)}: its elements are too large to follow the mold there; add [refinement], or "
            "make parison.element_size smaller"
        ]
    if not noticed:
        return []
    return [
        f"the mold is not filled: {gap.width:.3g} m remain at {format_place(gap.place)}, "
        f"{100 * gap.width / filling.depth:.0f} % of the opening's depth; raise pressure.value or solver.end_time, or "
        "set mold.fill = false"
    ]


def _offset_gap(gap: Gap, offset: Array) -> Gap:
    return gap._replace(place=gap.place + offset) if gap.element >= 0 else gap

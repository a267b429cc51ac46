"""Filling of a mold by a formed part: the widest gap, measured against the depth of the opening. On the host."""

from __future__ import annotations

import weakref
from typing import TYPE_CHECKING, Any, NamedTuple

import jax
import numpy as np
from numpy.typing import NDArray

from jaxform.core.errors import format_place
from jaxform.model.scene import Scene
from jaxform.sheet.state import Status
from jaxform.tools import gaps
from jaxform.tools.distances import Distances
from jaxform.tools.gaps import NO_GAP, Gap, mold_points, widest_gap
from jaxform.tools.search import SearchGrid

if TYPE_CHECKING:
    from jaxform.results.result import Result

Array = NDArray[np.float64]

OPEN = 0.2  # of the opening's depth: what is left open of a part that does not fill its mold
_NOTICED = 0.02  # of the same, that is warned of
_SMALL = 2e-3  # of the mold's size: a smaller gap is not measured against the depth
_BRIDGED, _WIDE = 2.0, 0.025  # sides of an element, and of the mold's size, that a gap which stays open is wide
FINER = "make the elements smaller (parison.element_size or parison.elements)"
"""The remedy where elements are too large for the mold, whichever key the sheet has."""


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
    def is_unfilled(self) -> bool:
        """True if a fifth of the opening's depth or more is left open."""
        return self.left.width > 0.0


class _Opening:
    """The surface that a scene's sheet is to reach, whatever part it becomes.

    Attributes:
        places: Places of the mold (n, 3) [m], as it starts, that are examined.
        facing: The mold's surface before the sheet; None where the sheet is not nearly flat.
        depth: Depth of the opening [m], see `Filling`.
    """

    def __init__(self, scene: Scene, push: float, offset: Array) -> None:
        """See the class; the mold is at an offset (3,) [m] from where it starts in the end."""
        assert scene.mold is not None and scene.tables.grid is not None
        start, triangles = np.asarray(scene.parison.positions, float), np.asarray(scene.parison.triangles)
        first = start[: scene.first_nodes]
        self.places = _places(scene, offset)
        self.facing = gaps.find_facing(first, triangles, push, scene.mold, scene.tables.grid)
        self.depth = 0.0 if self.facing is None else self.facing.depth(self.places)
        self.depth = self.depth or _first_gap(scene, push, self.places)
        self._unknown, self._met = np.ones(len(self.places), bool), np.ones(len(self.places), bool)

    def meets(self, index: NDArray[np.int64]) -> NDArray[np.bool_]:
        """Mask (n,) of the places, of given numbers (n,), that the sheet meets first on its way; each is found once."""
        new = index[self._unknown[index]]
        if self.facing is not None and len(new):
            self._met[new] = self.facing.meets(self.places[new])
        self._unknown[new] = False
        return self._met[index]


_openings: weakref.WeakKeyDictionary[SearchGrid, tuple[list[Any], tuple[Any, ...], _Opening]] = (
    weakref.WeakKeyDictionary()
)


def _opening(scene: Scene, offset: Array) -> _Opening:
    """The surface that a scene's sheet is to reach; found once for successive runs that differ in other things."""
    parison, tables, push = scene.parison, scene.tables, scene.strongest_push()
    assert tables.grid is not None
    same = [parison.positions, parison.triangles, parison.clamped, tables.initial_contact, scene.mold, scene.part]
    equal = (float(np.sign(push)), scene.first_nodes, *offset.tolist())
    known = _openings.get(tables.grid)
    if known is not None and known[1] == equal and all(one is other for one, other in zip(known[0], same, strict=True)):
        return known[2]
    made = _Opening(scene, push, offset)
    if not any(isinstance(leaf, np.ndarray) for leaf in jax.tree.leaves(same)):
        _openings[tables.grid] = same, equal, made
    return made


def may_be_unfilled(result: Result, scene: Scene) -> bool:
    """False if a part fills its mold for certain: no place that it is to reach is a fifth of the depth away from it.

    It takes a small part of the time of `measure_filling`, which says more.
    """
    if not _has_part(result, scene) or not scene.fill or int(result.status) & ~Status.UNBALANCED:
        return False
    opening, positions, triangles = _opening_and_part(result, scene)
    if not opening.depth or not len(triangles):
        return False
    from scipy.spatial import KDTree

    sheet, open_from = positions[triangles], OPEN * opening.depth
    # The nearest node or middle of an element is enough for most places.
    away = KDTree(np.concatenate([positions[np.unique(triangles)], sheet.mean(1)])).query(opening.places)[0]
    left = np.flatnonzero(away >= open_from)
    left = left[opening.meets(left)]
    if not len(left):
        return False
    usual = float(np.linalg.norm(sheet - np.roll(sheet, 1, axis=1), axis=2).mean())
    away = Distances(positions, triangles, usual).upper_bounds(opening.places[left])
    return bool((away >= open_from).any())


def _has_part(result: Result, scene: Scene) -> bool:
    """True where there is a part, and a mold to fill."""
    lost = int(result.status) & (Status.RUNAWAY | Status.ESCAPED | Status.BURST)
    mold = scene.mold is not None and scene.tables.grid is not None
    return mold and not lost and bool(np.isfinite(np.asarray(result.positions)).all())


def _opening_and_part(result: Result, scene: Scene) -> tuple[_Opening, Array, NDArray[np.int64]]:
    """The surface that a sheet is to reach; the part's nodes (n, 3) [m], beside the mold as it starts, and elements."""
    offset = mold_offset(result, scene)
    triangles = np.asarray(result.triangles)[np.asarray(result.used)]
    return _opening(scene, offset), np.asarray(result.positions, float) - offset, triangles


def measure_filling(result: Result, scene: Scene) -> Filling:
    """Gaps between the formed part and its mold; no gap where there is no mold, or no part."""
    if not _has_part(result, scene):
        return Filling(NO_GAP, 0.0, NO_GAP)
    assert scene.mold is not None and scene.tables.grid is not None
    clamped, offset, grid = np.asarray(scene.parison.clamped), mold_offset(result, scene), scene.tables.grid
    opening, positions, triangles = _opening_and_part(result, scene)
    formed = positions, triangles, np.asarray(result.wall), clamped, scene.strongest_push(), scene.mold, grid
    gap = widest_gap(*formed, places=opening.places)
    if opening.facing is not None and gap.width > opening.depth > 0.0:
        # Before surfaces that the sheet does not meet first, as the base of a buck that it is blown past.
        gap = widest_gap(*formed, counts=opening.facing.meets, places=opening.places)
    if gap.element < 0 or not gap.width > _SMALL * float(grid.size):
        return Filling(_offset_gap(gap, offset), 0.0, NO_GAP)
    left = NO_GAP
    if opening.depth > 0.0 and gap.width >= OPEN * opening.depth:
        held = clamped[triangles].any(1) | np.asarray(result.stuck)[triangles].all(1)
        counts = None if opening.facing is None else opening.facing.meets
        left = widest_gap(*formed, held=held, counts=counts, places=opening.places)
        left = left if left.width >= OPEN * opening.depth else NO_GAP
    return Filling(_offset_gap(gap, offset), opening.depth, _offset_gap(left, offset))


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
    parison, in_contact = scene.parison, scene.tables.initial_contact
    assert scene.mold is not None
    wall = np.zeros(len(parison.positions), int) if in_contact is None else np.asarray(in_contact)
    first, triangles = np.asarray(parison.positions, float), np.asarray(parison.triangles)
    none = np.zeros(len(triangles), bool)
    start = first, triangles, wall, np.asarray(parison.clamped), push, scene.mold, scene.tables.grid
    return widest_gap(*start, held=none, places=places).width


def mold_offset(result: Result, scene: Scene) -> Array:
    """Displacement of the mold (3,) [m] at the end of the run; its grid is at the initial position."""
    return np.zeros(3) if scene.mold is None else scene.mold.offset_at(float(result.time))


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
        or filling.is_unfilled
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
            f"{format_place(gap.place)}: its elements are too large to follow the mold there; "
            f"{remedy_of_bridge(scene)}"
        ]
    if not noticed:
        return []
    return [
        f"the mold is not filled: {gap.width:.3g} m remain at {format_place(gap.place)}, "
        f"{100 * gap.width / filling.depth:.0f} % of the opening's depth; {remedy_of_opening(result)}"
    ]


def remedy_of_opening(result: Result) -> str:
    """Remedies for a mold that is not filled: where elements are held at edges, more pressure hardly moves them."""
    remedy = "raise the pressure or solver.end_time, or set mold.fill = false if the mold need not be filled"
    if result.held_sides is None or not int(result.held_sides):
        return remedy
    return f"{FINER} or run `jaxform adapt`: elements that are held at edges bridge what lies between; or {remedy}"


def remedy_of_bridge(scene: Scene) -> str:
    """Remedies for elements that are too large to follow the mold: those that the scene can use."""
    if scene.refinement is not None:
        return f"{FINER}, or refinement.max_level larger"
    can_refine = not scene.solver.edge_contact and not scene.solver.smooth_landing
    return f"add [refinement], or {FINER}" if can_refine else FINER


def _offset_gap(gap: Gap, offset: Array) -> Gap:
    return gap._replace(place=gap.place + offset) if gap.element >= 0 else gap

"""Gaps between a formed sheet and the mold surface that it was to fill. On the host."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from jaxform.tools.crossings import contact_normals, nodal_normals, proper_crossings
from jaxform.tools.distances import Distances, NearestPlaces
from jaxform.tools.mold import Mold
from jaxform.tools.search import SearchGrid, build_grid

Array = NDArray[np.float64]
Integers = NDArray[np.integer]

_ASKED, _MORE = 64, 4  # places, the farthest ones by a quick bound, that are examined first, and times as many then
_MOST = 20_000  # places: of a mold of more triangles every few are examined
_REACH = 4.0  # sides of an element, to which distances are exact
_LIFT = 0.05  # of a gap, how far before the mold, which a node may lie on, one looks from
_FIRST = 0.2  # of the way to the mold, that is looked along first
_CLOSE = 1e-3  # of the way to the mold, that is not looked along: the place itself is on it
_EDGE = 1e-6  # of a triangle's sides: what is examined through an edge is hidden


class Gap(NamedTuple):
    """The place of the mold that is farthest from the sheet before it.

    Attributes:
        width: Its distance [m]; 0 where the sheet is in contact everywhere.
        place: The place of the mold (3,) [m].
        element: The nearest element of the sheet; -1 where there is none.
    """

    width: float
    place: Array
    element: int


NO_GAP = Gap(0.0, np.zeros(3), -1)
"""The gap of a sheet that lies on all of the mold, or has none."""


def widest_gap(
    positions: Array,
    triangles: Integers,
    wall: Integers,
    clamped: NDArray[np.bool_],
    push: float,
    mold: Mold,
    grid: SearchGrid | None = None,
    *,
    held: NDArray[np.bool_] | None = None,
    counts: Callable[[Array], NDArray[np.bool_]] | None = None,
    places: Array | None = None,
) -> Gap:
    """The widest gap between a sheet and the mold before it.

    The mold's corners and the middles of its triangles are examined. What is beside the sheet or behind it, and what
    another part of the mold hides from it, is no gap; nor is what is nearest to its clamped edge, which ends there.

    Args:
        positions: Positions of the nodes (n_node, 3) [m].
        triangles: Their elements (n_element, 3), along whose normals pressure acts.
        wall: Triangle in contact with each node (n_node,), see `Result.wall`.
        clamped: Nodes of its edge (n_node,).
        push: The pressure [Pa]; its sign alone counts.
        mold: The mold.
        grid: Its search structure; made here by default.
        held: Elements (n_element,) before which nothing counts; those with a clamped node by default.
        counts: Says which places of the mold (n, 3) [m] count (n,); all by default.
        places: Points of the mold (n, 3) [m] that are examined; those of `mold_points` by default.
    """
    places = mold_points(mold) if places is None else places
    if not len(triangles) or not len(places):
        return NO_GAP
    held = clamped[triangles].any(1) if held is None else held
    grid = build_grid(np.asarray(mold.vertices, float), np.asarray(mold.triangles)) if grid is None else grid
    walls, corners = np.asarray(mold.triangles), np.asarray(mold.vertices, float)
    sheet = positions[triangles]
    usual = float(np.linalg.norm(sheet - np.roll(sheet, 1, axis=1), axis=2).mean())
    distances = Distances(positions, triangles, _REACH * usual)
    back = _back_directions(positions, triangles, wall, push, corners[walls])
    best, directions = NO_GAP, back[triangles]

    def measure(asked: NDArray[np.int64]) -> float:
        nonlocal best
        near, there = distances.nearest(places[asked]), places[asked]
        found = _places_before(near, there, directions, held)
        # A place of an element may be beyond an edge of the mold; its nodes are not.
        lift = _LIFT * near.distance[found, None, None] * directions[near.triangle[found]]
        found = found[_sees(sheet[near.triangle[found]], lift, there[found], mold, grid).sum(1) >= 2]
        if counts is not None and len(found):
            found = found[counts(there[found])]
        if len(found):
            one = found[np.argmax(near.distance[found])]
            gap = Gap(float(near.distance[one]), there[one], int(near.triangle[one]))
            best = max(best, gap, key=lambda gap: gap.width)
        return best.width

    distances.search_largest(places, measure)
    return best


def mold_points(mold: Mold, chosen: NDArray[np.bool_] | None = None) -> Array:
    """The places (n, 3) [m] of a mold that are examined: corners and middles of its triangles, or of chosen ones."""
    walls, corners = np.asarray(mold.triangles), np.asarray(mold.vertices, float)
    walls = walls if chosen is None else walls[chosen]
    places = np.concatenate([corners[np.unique(walls)], corners[walls].mean(1)])
    return places[:: 1 + len(places) // _MOST]


def _back_directions(positions: Array, triangles: Integers, wall: Integers, push: float, mold_corners: Array) -> Array:
    """Unit vectors (n_node, 3) away from where the nodes are pushed: off the mold, of those that touch it."""
    back = -np.sign(push) * nodal_normals(positions, triangles)
    length = np.linalg.norm(back, axis=1, keepdims=True)
    back /= np.where(length > 0, length, 1.0)
    node = np.flatnonzero(wall)
    back[node] = contact_normals(wall[node], mold_corners)
    return back


def _places_before(near: NearestPlaces, places: Array, back: Array, held: NDArray[np.bool_]) -> NDArray[np.int64]:
    """Those places of the mold (n, 3) [m] that lie before the elements nearest to them.

    Args:
        near: The nearest places of the sheet.
        places: The places of the mold.
        back: Unit vectors (n_element, 3, 3) away from where the elements' nodes are pushed.
        held: Elements (n_element,) before which nothing counts.
    """
    way = places - near.place
    before = np.einsum("nkj,nj->n", back[near.triangle], way) < 0
    before &= ~near.at_rim & ~held[near.triangle] & (near.distance > 0)
    return np.flatnonzero(before)


def _sees(nodes: Array, lift: Array, places: Array, mold: Mold, grid: SearchGrid) -> NDArray[np.bool_]:
    """Mask (n, 3) of the places (n, 3) [m] that are visible from eyes before nodes (n, 3, 3) [m]."""
    eyes = nodes + lift
    way = places[:, None] - eyes
    seen = np.ones(eyes.shape[:2], bool)
    # An eye that another wall parts from its node is in the mold. What is right before the eye hides most.
    for begin, end in (
        (nodes + _CLOSE * lift, eyes),
        (eyes, eyes + _FIRST * way),
        (eyes, eyes + (1 - _CLOSE) * way),
    ):
        row, eye = np.nonzero(seen)
        hidden = proper_crossings(begin[row, eye], end[row, eye], mold, grid, margin=-_EDGE)[0]
        seen[row[hidden], eye[hidden]] = False
    return seen


# The surface of the mold that a nearly flat sheet meets first on its way along the push, and its depth.
#
# A place of the mold counts where the straight way back to the sheet, against the push, meets the sheet and no other
# part of the mold. Undercuts, backs and outer faces of solids, and what lies beside the sheet do not count. On the
# host.

_FLAT = 0.95  # of the area of a sheet, what its projection along the push must have
_BESIDE = 1e-6  # of the sheet's size: what is visible from its edge is before it


@dataclass(frozen=True)
class Facing:
    """The surface of a mold before a nearly flat sheet.

    Attributes:
        positions: Nodes of the sheet (n_node, 3) [m].
        triangles: Its elements (n_element, 3).
        direction: Unit vector (3,) along which it is pushed.
        mold: The mold, in the frame of the sheet.
        grid: Its search structure.
        flat: Distances from the sheet's projection along the push.
    """

    positions: Array
    triangles: Integers
    direction: Array
    mold: Mold
    grid: SearchGrid
    flat: Distances

    def heights(self, places: Array) -> tuple[Array, NDArray[np.bool_]]:
        """Distances (n,) [m] of places (n, 3) [m] before the sheet along the push, and the mask of those before it."""
        near = self.flat.nearest(_project(places, self.direction))
        corners = self.positions[self.triangles[near.triangle]]
        normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        slope = np.einsum("ij,j->i", normal, self.direction)
        ahead = np.einsum("ij,ij->i", places - corners[:, 0], normal) / np.where(slope == 0, np.inf, slope)
        return ahead, (near.distance <= _BESIDE * self.flat.size) & (ahead > 0) & (slope != 0)

    def meets(self, places: Array) -> NDArray[np.bool_]:
        """Mask (n,) of the places of the mold (n, 3) [m] that the sheet meets first on its way along the push."""
        ahead, before = self.heights(places)
        found = np.flatnonzero(before)
        back = -ahead[found, None] * self.direction
        begin, end = places[found] + _CLOSE * back, places[found] + (1 - _CLOSE) * back
        before[found[proper_crossings(begin, end, self.mold, self.grid, margin=-_EDGE)[0]]] = False
        return before

    def depth(self, places: Array) -> float:
        """Largest distance [m] before the sheet of the places of the mold (n, 3) [m] that it meets; 0 of none."""
        ahead, before = self.heights(places)
        found = np.flatnonzero(before)
        order = found[np.argsort(-ahead[found], kind="stable")]
        first, count = 0, _ASKED
        while first < len(order):
            part = order[first : first + count]
            met = part[self.meets(places[part])]
            if len(met):
                return float(ahead[met[0]])
            first, count = first + count, _MORE * count
        return 0.0


def find_facing(positions: Array, triangles: Integers, push: float, mold: Mold, grid: SearchGrid) -> Facing | None:
    """Finds the mold's surface before a sheet; None where the sheet is not nearly flat, or nothing pushes it.

    Args:
        positions: Node positions (n_node, 3) [m].
        triangles: Their elements (n_element, 3), along whose normals pressure acts.
        push: The pressure [Pa]; its sign alone counts.
        mold: The mold.
        grid: Its search structure.
    """
    corners = positions[triangles]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    total, area = np.sign(push) * normal.sum(0), np.linalg.norm(normal, axis=1).sum()
    size = float(np.linalg.norm(total))
    if not size >= _FLAT * area > 0:
        return None
    direction = total / size
    flat = Distances(_project(positions, direction), triangles, float(np.ptp(positions, axis=0).max()))
    return Facing(positions, triangles, direction, mold, grid, flat)


def _project(places: Array, direction: Array) -> Array:
    """Places (n, 3) [m] moved along a unit vector (3,) into the plane through the origin across it."""
    return places - (places @ direction)[:, None] * direction

"""The meridian of a preform: from the pole to the open neck, its surface of revolution, and rings of nodes on it."""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from jaxform.core.errors import InputError
from jaxform.mesh import grids, outlines

Array = NDArray[np.float64]
Index = NDArray[np.int64]

DENSITY = 6.0
"""Segments of a ring in 2 pi times its radius over the distance of rings, times 2 pi: those of a disc."""
_SAME = 1e-9  # of the profile's size: points as near are one, and a radius as small is 0
_SHARP = math.radians(20.0)  # a bend of the profile by more is a corner, on which a ring lies
_CHUNK = 2_000_000  # places times sides of the profile that are compared together


@dataclass(frozen=True)
class Meridian:
    """A polyline from the pole, on the axis, to the neck.

    Attributes:
        points: Points r, z [m], shape (k, 2).
        arc: Their distances from the pole along it [m], shape (k,).
    """

    points: Array
    arc: Array

    @property
    def length(self) -> float:
        """From the pole to the neck [m]."""
        return float(self.arc[-1])

    @property
    def area(self) -> float:
        """Area [m^2] of the surface of revolution."""
        radius = self.points[:, 0]
        return math.pi * float(np.sum((radius[1:] + radius[:-1]) * np.diff(self.arc)))

    @property
    def volume(self) -> float:
        """Volume [m^3] between the surface and the plane of the neck, below 0 where the neck is below the pole."""
        (r, z), (s, t) = self.points[:-1].T, self.points[1:].T
        return math.pi / 3.0 * float(np.sum((r * r + r * s + s * s) * (t - z)))

    def at(self, arc: Array) -> Array:
        """Points r, z (..., 2) [m] at distances (...) [m] from the pole."""
        return np.stack([np.interp(arc, self.arc, column) for column in self.points.T], axis=-1)

    def nearest(self, positions: Array) -> Array:
        """Distances (n,) [m] from the pole of the points of the meridian that are nearest to positions (n, 3) [m]."""
        places = np.stack([np.hypot(positions[:, 0], positions[:, 1]), positions[:, 2]], axis=1)
        parts = max(1, len(places) * len(self.points) // _CHUNK)
        return np.concatenate([self._nearest(part) for part in np.array_split(places, parts)])

    def _nearest(self, places: Array) -> Array:
        begin, side = self.points[:-1], np.diff(self.points, axis=0)
        away = places[:, None, :] - begin
        share = np.clip(np.sum(away * side, axis=2) / np.sum(side * side, axis=1), 0.0, 1.0)
        distance = np.linalg.norm(away - share[..., None] * side, axis=2)
        best = np.argmin(distance, axis=1)
        return self.arc[best] + share[np.arange(len(places)), best] * np.diff(self.arc)[best]

    def snap(self, middles: Array, ends: Array, boundary: NDArray[np.bool_]) -> Array:
        """Middles (k, 3) [m] of edges with ends (k, 2, 3) [m], moved onto the surface half way along the arc."""
        arc = self.nearest(ends.reshape(-1, 3)).reshape(-1, 2).mean(1)
        radius, height = self.at(arc).T
        size = np.linalg.norm(middles[:, :2], axis=1)
        factor = np.where(size > 0.0, radius / np.where(size > 0.0, size, 1.0), 1.0)
        return np.stack([middles[:, 0] * factor, middles[:, 1] * factor, height], axis=1)


def make_meridian(profile: Any, key: str = "parison.profile") -> Meridian:
    """The meridian of a profile.

    Args:
        profile: Points r, z [m] from the pole to the neck or from the neck to the pole, shape (k, 2).
        key: Its key, for messages.

    Raises:
        InputError: It has fewer than two points or too many, a negative radius, not just one end on the axis, another
            point there, no volume, or it crosses itself.
    """
    try:
        points = np.asarray(profile, np.float64)
    except (TypeError, ValueError):
        points = np.zeros(0)
    if points.ndim != 2 or points.shape[-1] != 2 or not np.isfinite(points).all():
        raise InputError("is not a list of points", "give [[r, z], ...] in m", key, profile)
    if len(points) > outlines.MOST_CORNERS:
        raise InputError(f"has {len(points)} points", f"give at most {outlines.MOST_CORNERS}", key)
    size = float(np.ptp(points, axis=0).max(initial=0.0)) if len(points) else 0.0
    apart = np.linalg.norm(np.diff(points, axis=0), axis=1) > _SAME * size
    points = points[np.insert(apart, 0, True)] if len(points) else points
    if len(points) < 2:
        raise InputError("has fewer than two different points", "give two or more", key, profile)
    if points[:, 0].min() < -_SAME * size:
        raise InputError("has a negative radius", "give r >= 0", key, profile)
    return _from_pole(np.where(np.abs(points) <= _SAME * size * np.array([1.0, 0.0]), 0.0, points), size, key, profile)


def _from_pole(points: Array, size: float, key: str, profile: Any) -> Meridian:
    """The meridian of points (k, 2) [m] in either order."""
    closed = points[:, 0] == 0.0
    if not (closed[0] or closed[-1]):
        raise InputError("does not reach the axis", "end it at r = 0, where the preform is closed", key, profile)
    if closed[0] and closed[-1]:
        raise InputError("is closed at both ends", "leave one end open, the neck, at r > 0", key, profile)
    if closed[1:-1].any():
        raise InputError("touches the axis between its ends", "keep r > 0 there", key, profile)
    place = outlines.crossing_point(points, closed=False)
    if place is not None:
        where = f"r = {place[0]:.6g} m, z = {place[1]:.6g} m"
        raise InputError(f"crosses or touches itself at {where}", "move the points apart there", key)
    points = points if closed[0] else points[::-1].copy()
    steps = np.linalg.norm(np.diff(points, axis=0), axis=1)
    made = Meridian(points, np.insert(np.cumsum(steps), 0, 0.0))
    if abs(made.volume) <= _SAME * size**3:
        raise InputError("encloses no volume", 'give a profile along z, or shape = "disc"', key, profile)
    return made


def place_rings(meridian: Meridian, size: float) -> Array:
    """Distances (n,) [m] of rings from the pole, about a size [m] apart, the pole's and the neck's included.

    A ring lies on each corner of the profile that has no other within half the size.
    """
    way = np.diff(meridian.points, axis=0)
    direction = np.arctan2(way[:, 1], way[:, 0])
    bend = np.abs((np.diff(direction) + math.pi) % (2.0 * math.pi) - math.pi)
    stops = [0.0]
    for arc in meridian.arc[1:-1][bend > _SHARP]:
        if arc - stops[-1] >= 0.5 * size and meridian.length - arc >= 0.5 * size:
            stops.append(float(arc))
    stops.append(meridian.length)
    counts = [grids.round_count((end - begin) / size) for begin, end in pairwise(stops)]
    counts[0] = max(2, counts[0])
    parts = [np.linspace(begin, end, n + 1)[1:] for (begin, end), n in zip(pairwise(stops), counts, strict=True)]
    return np.concatenate([[0.0], *parts])


def turn_rings(meridian: Meridian, size: float, symmetry: str, parts: int) -> tuple[Array, Index, Index]:
    """Nodes and triangles of the surface, or of a part of it.

    Args:
        meridian: The meridian.
        size: Element size [m].
        symmetry: "none", "half" or "quarter".
        parts: Number of such parts in the whole.

    Returns:
        Nodes (n, 3) [m], the pole first, then ring by ring; triangles (m, 3), counter-clockwise seen against the axis
        of a pole below; and the number of each node's ring (n,).
    """
    arc = place_rings(meridian, size)
    points, steps = meridian.at(arc), np.diff(arc)
    apart = 0.5 * (steps + np.append(steps[1:], steps[-1]))
    wanted = DENSITY / parts * points[1:, 0] / apart
    if symmetry == "none":
        rings = grids.staggered_rings(wanted.tolist())
        nodes = [np.zeros((1, 3)), *(ring.positions(r) for ring, r in zip(rings, points[1:, 0], strict=True))]
        triangles = grids.triangles(rings)
    else:
        counts = [0, *(max(1 + (parts == 2), math.floor(count + 0.5)) for count in wanted)]
        nodes = [grids.ring(r, count, symmetry) for r, count in zip(points[:, 0], counts, strict=True)]
        starts = np.cumsum([0, *map(len, nodes)]).tolist()
        bands = enumerate(pairwise(zip(starts, counts, strict=False)))
        triangles = np.concatenate([_band(*inner, *outer, number) for number, (inner, outer) in bands])
    ring_of = np.repeat(np.arange(len(nodes)), [len(ring) for ring in nodes])
    positions = np.concatenate(nodes)
    positions[:, 2] = points[ring_of, 1]
    return positions, triangles, ring_of


def _band(inner: int, inner_count: int, outer: int, outer_count: int, number: int) -> Index:
    """Triangles between two arcs of nodes; of as many segments, diagonals alternate along the arc and between bands."""
    if inner_count != outer_count:
        return grids.zip_rings(inner, inner_count, outer, outer_count, False)
    place = np.arange(inner_count)
    a, b, c, d = inner + place, outer + place, outer + place + 1, inner + place + 1
    rising = ((place + number) % 2 == 0)[:, None, None]
    one = np.stack([np.stack([a, b, c], 1), np.stack([a, c, d], 1)], 1)
    other = np.stack([np.stack([a, b, d], 1), np.stack([b, c, d], 1)], 1)
    return np.where(rising, one, other).reshape(-1, 3)

"""Rings of nodes of a disc, each turned by half a segment against the last, and triangles between them. On the host.

Where rings have the same number of segments and are so staggered, every triangle of a band is like every other, and so
are their errors. Numbers therefore stay the same over several rings, and grow by a half or a third in between, all
around the ring at once. Were a ring to have six segments more than the last, the nodes from which a segment begins
would lie above each other on six spokes, along which the sheet is thinner than beside them.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Index = NDArray[np.int64]
Side = Literal["left", "right"]

_UNIT = {"none": 6, "half": 3, "quarter": 1}  # numbers of segments are a power of two, or three times one, times this
_SPAN = {"none": (0.0, 2.0), "half": (-0.5, 1.0), "quarter": (0.0, 0.5)}  # where an arc begins, and how long it is [pi]
_FINER = 1.04  # than wanted, since numbers grow a ring late where the last one is turned
_EVEN = 0.85  # share of even spacing in a staggered arc, whose first and last segments else were half a segment long
_POWERS = 24
_DIGITS = 12  # of a share of the ring: places that differ by less are the same


class Ring(NamedTuple):
    """The nodes of a ring, or of an arc that ends on planes of symmetry.

    Attributes:
        places: Of the nodes, as shares of the whole way around, counter-clockwise (k,).
        closed: Whether the last node is followed by the first.
    """

    places: Array
    closed: bool

    @property
    def segments(self) -> Index:
        """Numbers of the nodes at both ends of each segment (n, 2)."""
        begin = np.arange(len(self.places) - (not self.closed))
        return np.stack([begin, (begin + 1) % len(self.places)], axis=1)

    @property
    def middles(self) -> Array:
        """Places of the middles of the segments (n,), in ascending order."""
        following = np.append(self.places[1:], self.places[:1] + 1.0) if self.closed else self.places[1:]
        return 0.5 * (self.places[: len(following)] + following)

    def nearest(self, places: Array, side: Side) -> Index:
        """The node (n,) nearest to places (n,); of two as near the 'left' or 'right' one."""
        middles, count = self.middles, len(self.places)
        if self.closed:
            middles = np.concatenate([middles - 1.0, middles, middles + 1.0])
        found = np.searchsorted(middles.round(_DIGITS), places.round(_DIGITS), side=side)
        return (found - count) % count if self.closed else found

    def positions(self, radius: float, symmetry: str) -> Array:
        """The nodes (k, 3) [m] at a radius [m], exactly on the planes of symmetry."""
        first, span = _SPAN[symmetry]
        angle = np.pi * (first + span * self.places)
        unit = np.stack([np.cos(angle), np.sin(angle), np.zeros(len(angle))], axis=1)
        unit[np.abs(unit) < 1e-14] = 0.0
        return radius * unit


def staggered(wanted: Sequence[float], symmetry: str) -> list[Ring]:
    """Rings with about the wanted numbers of segments, from the inside outwards; the last has just so many.

    Args:
        wanted: Numbers of segments of the modelled part, one for each ring.
        symmetry: 'none', 'half' or 'quarter'.
    """
    closed = symmetry == "none"
    multiples = np.sort(np.concatenate([2 ** np.arange(_POWERS), 3 * 2 ** np.arange(_POWERS)]))
    counts = _UNIT[symmetry] * multiples
    counts = counts[counts > 1]
    rings: list[Ring] = []
    last, turned = 0, False
    for number in wanted[:-1]:
        count = int(counts[np.argmin(np.abs(np.log(counts / (_FINER * max(number, 1.0)))))])
        # Numbers change after a ring that is not turned: else no choice of diagonals may have mirror symmetry.
        count = last if turned else count
        turned = count == last and not turned
        last = count
        rings.append(Ring(_places(count, turned, closed), closed))
    rim = max(1, math.floor(wanted[-1] + 0.5))
    turned = rim == last and not turned
    return [*rings, Ring(_places(rim - (turned and not closed), turned, closed), closed)]


def _places(count: int, turned: bool, closed: bool) -> Array:
    """Places of the nodes of so many segments; an arc that is turned has one more of them."""
    if closed:
        return (np.arange(count) + 0.5 * turned) / count
    if not turned:
        return np.arange(count + 1) / count
    between = np.concatenate([[0.0], (np.arange(count) + 0.5) / count, [1.0]])
    return _EVEN * np.arange(count + 2) / (count + 1) + (1.0 - _EVEN) * between


def triangles(rings: Sequence[Ring]) -> Index:
    """Triangles (m, 3), counter-clockwise, of a centre, node 0, and rings of nodes that follow it one by one."""
    spokes = rings[0].segments + 1
    bands, start = [np.insert(spokes, 0, 0, axis=1)], 1
    for inner, outer in pairwise(rings):
        bands.append(_band(inner, outer) + start)
        start += len(inner.places)
    return np.concatenate(bands)


def _band(inner: Ring, outer: Ring) -> Index:
    """Triangles between two rings whose nodes are numbered from 0 on, the inner one's first.

    Each segment's third corner is the node of the other ring that is nearest to its middle: the Delaunay triangles.
    """
    count = len(inner.places)
    outward = np.insert(outer.segments + count, 0, inner.nearest(outer.middles, "left"), axis=1)
    inward = np.insert(inner.segments[:, ::-1], 0, outer.nearest(inner.middles, "right") + count, axis=1)
    order = np.argsort(np.concatenate([outer.middles, inner.middles]).round(_DIGITS), kind="stable")
    return np.concatenate([outward, inward])[order]

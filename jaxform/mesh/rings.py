"""Rings of nodes of a disc, each turned by half a segment against the last, and triangles between them. On the host.

Where rings have the same number of segments and are so turned, every triangle of a band is like every other, and so are
their errors. Numbers therefore stay the same over several rings, and grow by a half or a third in between, all around
the ring at once. Were a ring to have six segments more than the last, the nodes from which a segment begins would lie
above each other on six spokes, along which the sheet is thinner than beside them.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from jaxform.core.errors import InputError
from jaxform.mesh import grids
from jaxform.mesh.profiles import Profile
from jaxform.mesh.resolution import check_count

Array = NDArray[np.float64]
Index = NDArray[np.int64]

_UNIT = 6  # numbers of segments are this times a power of two, or times three of them
_POWERS = 24
_APART = 0.85  # of the rim's number of segments, at most, has a ring that does not have as many
_FINER = 1.02  # than wanted, since numbers grow a ring late where the last one is turned
_DIGITS = 12  # of a share of the ring: places that differ by less are the same


class Ring(NamedTuple):
    """The nodes of a ring, evenly spaced.

    Attributes:
        count: Number of nodes, and of segments.
        turned: Whether the first node is half a segment off the x axis.
    """

    count: int
    turned: bool

    @property
    def places(self) -> Array:
        """Angles of the nodes, as shares of the full circle, counter-clockwise (count,)."""
        return (np.arange(self.count) + 0.5 * self.turned) / self.count

    @property
    def middles(self) -> Array:
        """Places of the middles of the segments (count,), ascending; segment k begins at node k."""
        return (np.arange(self.count) + 0.5 * self.turned + 0.5) / self.count

    @property
    def segments(self) -> Index:
        """Numbers of the nodes at both ends of each segment (count, 2)."""
        begin = np.arange(self.count)
        return np.stack([begin, (begin + 1) % self.count], axis=1)

    def nearest(self, places: Array, side: Literal["left", "right"]) -> Index:
        """The node (n,) nearest to places (n,); of two that are as near the one before, 'left', or after."""
        middles = np.concatenate([self.middles - 1.0, self.middles, self.middles + 1.0])
        return np.searchsorted(middles.round(_DIGITS), places.round(_DIGITS), side=side) % self.count

    def positions(self, radius: float) -> Array:
        """The nodes (count, 3) [m] at a radius [m], exactly on the axes where they lie there."""
        angle = 2.0 * np.pi * self.places
        unit = np.stack([np.cos(angle), np.sin(angle), np.zeros(self.count)], axis=1)
        unit[np.abs(unit) < 1e-14] = 0.0
        return radius * unit


def graded_rings(radius: float, size: Profile, density: float) -> tuple[Array, list[int]]:
    """Radii [m] of rings and their numbers of segments, from 0 on, from the local size over the radius.

    Args:
        radius: Radius of the disc [m].
        size: Element size [m], along the radius.
        density: Segments of a ring at a distance of one size from the axis.

    Raises:
        InputError: The size is not along the radius, not positive, or gives too few or too many elements.
    """
    if size.along != "radius":
        raise InputError("a disc is graded along its radius", "use radius", f"{size.key}.along", size.along)
    size.positive()
    check_count(density * (radius / min(size.value)) ** 2, min(size.value))
    fine = np.linspace(0.0, radius, 20_001)
    local = np.interp(fine, size.at, size.value)
    rank = np.concatenate([[0.0], np.cumsum(np.diff(fine) * 0.5 * (1 / local[1:] + 1 / local[:-1]))])
    ring_count = max(2, grids.round_count(rank[-1]))
    radii = np.interp(np.linspace(0.0, rank[-1], ring_count + 1), rank, fine)
    local = np.interp(radii, size.at, size.value)
    segments = [max(1, math.floor(density * r / s + 0.5)) for r, s in zip(radii, local, strict=True)]
    return radii, [0, *segments[1:]]


def staggered_rings(wanted: Sequence[float]) -> list[Ring]:
    """Rings with about the wanted numbers of segments, from the inside outwards; the last has exactly as many."""
    counts = _counts(wanted[-1])
    rings: list[Ring] = []
    for left, number in zip(reversed(range(len(wanted))), wanted, strict=True):
        last = rings[-1] if rings else Ring(0, False)
        count = _nearest(counts, number)
        # Numbers change after a ring that is not turned: else no choice of diagonals may have mirror symmetry. Where
        # the size changes fast they cannot wait.
        if last.turned and left and 2 * last.count <= 3 * count <= 4.5 * last.count:
            count = last.count
        rings.append(Ring(count, count == last.count and not last.turned))
    return rings


def _nearest(counts: Index, number: float) -> int:
    return int(counts[np.argmin(np.abs(np.log(counts / (_FINER * max(number, 1.0)))))])


def _counts(rim: float) -> Index:
    """Numbers of segments that rings may have: just that of the rim, and others which divide each other well.

    None hardly differs from that of the rim: the last rings have as many as the rim, as many as a regular band needs.
    """
    powers, last = 2 ** np.arange(_POWERS), max(1, math.floor(rim + 0.5))
    ladder = _UNIT * np.sort(np.concatenate([powers, 3 * powers]))
    lower, higher = ladder[ladder <= _APART * last], ladder[ladder * _APART >= last]
    between = _UNIT * round(math.sqrt(lower[-1] * last) / _UNIT) if len(lower) and 1.5 * lower[-1] < last else last
    return np.concatenate([lower, np.unique([between, last]), higher])


def triangles(rings: Sequence[Ring]) -> Index:
    """Triangles (m, 3), counter-clockwise, of a centre, node 0, and rings of nodes that follow it one by one."""
    bands, start = [np.insert(rings[0].segments + 1, 0, 0, axis=1)], 1
    for inner, outer in pairwise(rings):
        bands.append(_band(inner, outer) + start)
        start += inner.count
    return np.concatenate(bands)


def _band(inner: Ring, outer: Ring) -> Index:
    """Triangles between two rings whose nodes are numbered from 0 on, the inner one's first.

    Each segment's third corner is the node of the other ring that is nearest to its middle: the Delaunay triangles.
    """
    outward = np.insert(outer.segments + inner.count, 0, inner.nearest(outer.middles, "left"), axis=1)
    inward = np.insert(inner.segments[:, ::-1], 0, outer.nearest(inner.middles, "right") + inner.count, axis=1)
    order = np.argsort(np.concatenate([outer.middles, inner.middles]).round(_DIGITS), kind="stable")
    return np.concatenate([outward, inward])[order]

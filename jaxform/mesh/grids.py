"""Nodes and triangles of the built-in sheets: rings, rows of cells, faces of an octahedron; their resolution."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from jaxform.core.errors import InputError, warn_of

Array = NDArray[np.float64]
Index = NDArray[np.int64]


def ring(radius: float, segments: int, symmetry: str) -> NDArray[np.float64]:
    """Nodes of a ring or arc, counter-clockwise, exactly on the cut planes: (k, 3)."""
    if radius == 0:
        return np.zeros((1, 3))
    first, span = {"none": (0.0, 2.0), "half": (-0.5, 1.0), "quarter": (0.0, 0.5)}[symmetry]
    nodes = np.arange(segments + (symmetry != "none"))
    angle = np.pi * (first + span * nodes / segments)
    unit = np.stack([np.cos(angle), np.sin(angle), np.zeros(len(angle))], axis=1)
    unit[np.abs(unit) < 1e-14] = 0.0
    return radius * unit


def zip_rings(inner: int, inner_count: int, outer: int, outer_count: int, closed: bool) -> NDArray[np.int64]:
    """Triangles between two rings of nodes that start at `inner` and `outer`: (inner_count + outer_count, 3).

    One triangle for each segment of either ring, in the order of the angles where the segments end; at equal
    angles the inner one goes first, which makes every sector of a full disc symmetric about its middle.
    """
    inner_ends, outer_ends = np.arange(1, inner_count + 1), np.arange(1, outer_count + 1)
    ends = np.concatenate([inner_ends * outer_count, outer_ends * inner_count])
    is_outer = np.arange(len(ends)) >= inner_count
    is_outer = is_outer[np.lexsort((is_outer, ends))]
    inner_node = _numbers(inner, np.cumsum(~is_outer), inner_count, closed)
    outer_node = _numbers(outer, np.cumsum(is_outer), outer_count, closed)
    near = _numbers(inner, np.cumsum(~is_outer) - ~is_outer, inner_count, closed)
    far = _numbers(outer, np.cumsum(is_outer) - is_outer, outer_count, closed)
    return np.stack([near, far, np.where(is_outer, outer_node, inner_node)], axis=1)


def _numbers(start: int, place: NDArray[np.int64], segment_count: int, closed: bool) -> NDArray[np.int64]:
    return start + (place % max(1, segment_count) if closed else place)


def round_count(ratio: float) -> int:
    """The nearest count to a ratio, at least 1, and never too large to multiply."""
    return max(1, round(min(ratio, 1e7)))


def cell_counts(extent: Sequence[float], element_size: float | None, elements: int | None) -> list[int]:
    """Rows of near-square cells of two triangles along the sides x, y [m] of a rectangle."""
    if element_size is not None:
        return [round_count(length / element_size) for length in extent]
    cell_count = (elements or 0) / 2
    across = round_count(math.sqrt(cell_count * min(extent) / max(extent)))
    along = round_count(cell_count / across)
    return [across, along] if extent[0] <= extent[1] else [along, across]


def union_jack(nx: int, ny: int) -> NDArray[np.int64]:
    """Triangles of nx by ny cells with alternating diagonals, nodes numbered along y first: (2 nx ny, 3)."""
    i, j = (grid.ravel() for grid in np.meshgrid(np.arange(nx), np.arange(ny), indexing="ij"))
    a = i * (ny + 1) + j
    b, c, d = a + ny + 1, a + ny + 2, a + 1
    rising = ((i + j) % 2 == 0)[:, None, None]
    split = np.where(
        rising,
        np.stack([np.stack([a, b, c], 1), np.stack([a, c, d], 1)], 1),
        np.stack([np.stack([a, b, d], 1), np.stack([b, c, d], 1)], 1),
    )
    return split.reshape(-1, 3)


def octant(division: int, signs: tuple[int, int, int]) -> NDArray[np.int64]:
    """Corners of the triangles on one face of |x| + |y| + |z| = division: (division^2, 3, 3)."""
    i, j = (grid.ravel() for grid in np.meshgrid(np.arange(division), np.arange(division), indexing="ij"))
    base = np.stack([i, j, division - 1 - i - j], axis=1)
    unit = np.eye(3, dtype=np.int64)
    upward = base[base[:, 2] >= 0][:, None, :] + unit
    downward = (base - [0, 0, 1])[base[:, 2] >= 1][:, None, :] + (1 - unit)
    corners = np.concatenate([upward, downward])
    return corners[:, :: int(np.prod(signs))] * np.array(signs)


# The resolution of a shape's mesh: limits of its element size and of its number of elements.

FEWEST_ELEMENTS, MOST_ELEMENTS = 4, 2_000_000


def as_number(value: Any) -> float:
    """The value as a float, NaN when it is no number."""
    if isinstance(value, bool) or not isinstance(value, int | float | np.integer | np.floating):
        return math.nan
    return float(value) if abs(value) < 1e300 else math.inf


def as_length(key: str, value: Any) -> float:
    """A positive length [m] that was given for a key."""
    number = as_number(value)
    if not (math.isfinite(number) and number > 0):
        raise InputError("is not a positive length", "give metres above 0", key, value)
    return number


def check_resolution(element_size: float | None, elements: int | None, *, largest: float) -> None:
    """Raises InputError unless an element size [m] that the shape allows, or a number of elements, is given."""
    if (element_size is None) == (elements is None):
        problem = "no mesh size is given" if elements is None else "is given together with elements"
        raise InputError(problem, "give element_size or elements, one of them", "parison.element_size", element_size)
    if element_size is not None and as_length("parison.element_size", element_size) > largest:
        raise InputError(
            f"is larger than the shape ({largest:.6g} m)",
            "make it smaller",
            "parison.element_size",
            element_size,
        )
    if elements is not None and not FEWEST_ELEMENTS <= as_number(elements) <= MOST_ELEMENTS:
        remedy = f"use {FEWEST_ELEMENTS} to {MOST_ELEMENTS}"
        raise InputError("is not a possible number of elements", remedy, "parison.elements", elements)


def triangle_side(area: float, elements: float) -> float:
    """The side [m] of so many equilateral triangles that have an area [m^2] together."""
    return math.sqrt(4 / math.sqrt(3) * area / elements)


def check_count(count: float, element_size: float | None) -> None:
    """Raises InputError where a mesh would have too few elements, or too many."""
    if element_size is not None and not FEWEST_ELEMENTS <= count <= MOST_ELEMENTS:
        problem = f"gives {count:.3g} elements, not {FEWEST_ELEMENTS} to {MOST_ELEMENTS}"
        remedy = "make it smaller" if count < FEWEST_ELEMENTS else "make it larger"
        raise InputError(problem, remedy, "parison.element_size", element_size)


# Rings of nodes of a disc, each turned by half a segment against the last, and triangles between them. On the host.
#
# Where rings have the same number of segments and are so turned, every triangle of a band is like every other, and so
# are their errors. Numbers therefore stay the same over several rings, and grow by a half or a third in between, all
# around the ring at once. Were a ring to have six segments more than the last, the nodes from which a segment starts
# would lie above each other on six spokes, along which the sheet is thinner than beside them.


_UNIT = 6  # numbers of segments are this times a power of two, or times three of them
_POWERS = 24
_APART = 0.85  # of the rim's number of segments, at most, has a ring that does not have as many
_FINER = 1.02  # than wanted, since numbers grow a ring late where the last one is turned
_DIGITS = 12  # of a share of the ring: places that differ by less are the same


class Ring(NamedTuple):
    """The nodes of a ring, evenly spaced.

    Attributes:
        count: Number of nodes, and of segments.
        turned: True if the first node is half a segment off the x axis.
    """

    count: int
    turned: bool

    @property
    def places(self) -> Array:
        """Angles of the nodes, as shares of the full circle, counter-clockwise (count,)."""
        return (np.arange(self.count) + 0.5 * self.turned) / self.count

    @property
    def middles(self) -> Array:
        """Places of the middles of the segments (count,), ascending; segment k starts at node k."""
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
    ring_count = max(2, round_count(rank[-1]))
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
    sizes = _UNIT * np.sort(np.concatenate([powers, 3 * powers]))
    lower, higher = sizes[sizes <= _APART * last], sizes[sizes * _APART >= last]
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


# Profiles: a quantity that varies along one coordinate, on the host.

_KNOTS = "give places in m on the sheet, or turn it"
_NO_WIDTH, _WIDE = 1e-6, 20.0  # of the sheet's size; knots over so many times its width


@dataclass(frozen=True)
class Profile:
    """A quantity over a place: piecewise linear between knots, constant outside.

    Attributes:
        along: The place: 'radius' (distance from the z axis), 'x', 'y' or 'z' [m]; 'angle' about the z axis from x
            towards y, from 0 to 360 [degrees]; 'arc' along the meridian of a preform, from its pole [m].
        at: Places of the knots, increasing.
        value: The quantity at the knots, in its own unit.
        key: Its key in the scene file, for messages.
    """

    along: str
    at: tuple[float, ...]
    value: tuple[float, ...]
    key: str = field(default="profile", compare=False)

    def __post_init__(self) -> None:
        """Raises InputError for an unknown place, knots that do not increase, lengths that differ, or NaN."""
        if self.along not in ("radius", "x", "y", "z", "angle", "arc"):
            raise InputError("is not a coordinate", "use radius, x, y, z or angle", f"{self.key}.along", self.along)
        for name in ("at", "value"):
            object.__setattr__(self, name, _finite_tuple(f"{self.key}.{name}", getattr(self, name)))
        if len(self.at) != len(self.value):
            problem = f"has {len(self.value)} values for {len(self.at)} knots"
            raise InputError(problem, "give one value per knot", f"{self.key}.value", self.value)
        if any(right <= left for left, right in pairwise(self.at)):
            raise InputError("does not increase", "sort the knots, and give each only once", f"{self.key}.at", self.at)

    def coordinate(self, positions: NDArray[np.float64]) -> NDArray[np.float64]:
        """The place of positions [m] of shape (..., 3), shape (...), in the unit of the knots.

        Raises:
            InputError: Along 'arc', which positions alone do not tell.
        """
        if self.along == "radius":
            return np.hypot(positions[..., 0], positions[..., 1])
        if self.along == "angle":
            return np.degrees(np.arctan2(positions[..., 1], positions[..., 0])) % 360.0
        if self.along == "arc":
            problem, remedy = "is known of the thickness and temperature of a preform alone", "use z or radius"
            raise InputError(problem, remedy, f"{self.key}.along", self.along)
        return positions[..., "xyz".index(self.along)]

    def __call__(self, positions: NDArray[np.float64]) -> NDArray[np.float64]:
        """The quantity at positions [m] of shape (..., 3), shape (...)."""
        return np.interp(self.coordinate(positions), self.at, self.value)

    def over(self, positions: NDArray[np.float64], arc: NDArray[np.float64] | None = None) -> NDArray[np.float64]:
        """The quantity at the nodes (n, 3) [m] of a sheet.

        Args:
            positions: The nodes.
            arc: Their places (n,) [m] along the meridian of a preform; None for other sheets.

        Warns:
            InputWarning: If the knots hardly overlap the sheet, so that the quantity is constant or nearly so.
        """
        place = arc if self.along == "arc" and arc is not None else self.coordinate(positions)
        at, unit = np.asarray(self.at), "degrees" if self.along == "angle" else "m"
        low, high = float(place.min()), float(place.max())
        sheet = f"the sheet is from {low:.4g} to {high:.4g} {unit}"
        if min(self.value) == max(self.value):
            pass
        elif at[-1] <= low or at[0] >= high or high - low <= _NO_WIDTH * np.ptp(positions):
            warn_of(f"varies nowhere on the sheet: {sheet}", _KNOTS, key=f"{self.key}.at", value=self.at)
        elif at[-1] - at[0] > _WIDE * (high - low):
            warn_of(f"hardly varies on the sheet: {sheet}", _KNOTS, key=f"{self.key}.at", value=self.at)
        return np.interp(place, self.at, self.value)

    def positive(self) -> Profile:
        """The profile itself if all values are positive; raises InputError otherwise."""
        if min(self.value) <= 0:
            raise InputError("is not positive everywhere", "give values above 0", f"{self.key}.value", self.value)
        return self


def _finite_tuple(key: str, values: ArrayLike) -> tuple[float, ...]:
    try:
        array = np.asarray(values, dtype=np.float64)
    except (TypeError, ValueError):
        array = np.array(np.nan)
    if array.ndim != 1 or not array.size or not np.isfinite(array).all():
        raise InputError("is not a list of finite numbers", "give at least one number", key, values)
    return tuple(array.tolist())

"""Triangles over a polygon of a user's own: regular, smaller in necks, two across every one of them. On the host."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from jaxform.core.errors import InputError
from jaxform.mesh import outlines, planform
from jaxform.mesh.bisection import Snap

Array = NDArray[np.float64]
Index = NDArray[np.int64]

_FLATTER = (0.1, 0.02, 0.002)  # of the local size, how far the rim may be from the polygon; less where it has to be
_SHORT = 0.25  # of the local size: corners nearer than that are one
_TIP = 0.3  # of the size: where a sharp corner is as narrow as that, it ends
_NECK = 0.4  # of the way along the rim, below which two of its places are those of a neck, not of a corner
_FINEST = 3  # times that the size may be halved in necks
_GROWTH = 0.4  # of the size, over the distance from where it is small
_PER_SIZE = 6  # places in which a neck is searched for, in an element's length
_ATTEMPTS = 12
_LOWEST = 0.01  # of the size, an element's height
_CHUNK = 4_000_000  # pairs of points and sides processed together


@dataclass(frozen=True)
class PolygonCurve:
    """A closed polygon by the arc length along it.

    Attributes:
        corners: Corners (k, 2) [m], counter-clockwise.
        arc_length: To each corner and back to the first (k + 1,) [m].
    """

    corners: Array
    arc_length: Array

    @classmethod
    def through_corners(cls, corners: Array) -> PolygonCurve:
        """The curve through corners (k, 2) [m]."""
        steps = np.linalg.norm(np.roll(corners, -1, axis=0) - corners, axis=1)
        return cls(corners, np.concatenate([[0.0], np.cumsum(steps)]))

    @property
    def length(self) -> float:
        """Once around [m]."""
        return float(self.arc_length[-1])

    def at(self, arc_length: Array) -> Array:
        """Places (n, 2) [m] at an arc length (n,) [m]."""
        closed = np.concatenate([self.corners, self.corners[:1]])
        return np.stack([np.interp(arc_length, self.arc_length, closed[:, k]) for k in range(2)], axis=1)

    def nearest(self, points: Array) -> Array:
        """The places (n, 2) [m] on the curve that are nearest to points (n, 2) [m]."""
        begin, side = self.corners, np.roll(self.corners, -1, axis=0) - self.corners
        found = []
        for part in np.array_split(points, 1 + len(points) * len(begin) // _CHUNK):
            from_begin = part[:, None] - begin
            share = np.clip(np.einsum("pki,ki->pk", from_begin, side) / np.einsum("ki,ki->k", side, side), 0, 1)
            away = from_begin - share[..., None] * side
            best = np.argmin(np.einsum("pki,pki->pk", away, away), axis=1)
            found.append(begin[best] + share[np.arange(len(part)), best, None] * side[best])
        return np.concatenate(found)


class ElementSize:
    """The size of elements: the same everywhere but near necks, where it is up to eight times smaller."""

    def __init__(self, curve: PolygonCurve, largest: float) -> None:
        """Finds the necks of a curve for elements at most so large [m]."""
        from scipy.spatial import KDTree

        self.largest = largest
        count = max(16, int(np.ceil(_PER_SIZE * curve.length / largest)))
        arc_length = curve.length * (np.arange(count) + 0.5) / count
        places = curve.at(arc_length)
        width = np.full(count, np.inf)
        one, other = KDTree(places).query_pairs(2 * largest, output_type="ndarray").T
        around = np.abs(arc_length[one] - arc_length[other])
        apart = np.linalg.norm(places[one] - places[other], axis=1)
        neck = apart < _NECK * np.minimum(around, curve.length - around)
        one, other, apart = one[neck], other[neck], apart[neck]
        within = planform.inside(0.5 * (places[one] + places[other]), [curve.corners])
        for side in (one, other):
            np.minimum.at(width, side[within], apart[within])
        halved = np.clip(np.ceil(np.log2(largest / np.minimum(0.5 * width, largest)) - 1e-9), 0, _FINEST)
        self._near = [
            (largest / 2**k, KDTree(places[halved == k])) for k in range(1, _FINEST + 1) if (halved == k).any()
        ]

    def __call__(self, points: Array) -> Array:
        """The size (n,) [m] at points (n, 2) [m]."""
        size = np.full(len(points), self.largest)
        for least, tree in self._near:
            size = np.minimum(size, least + _GROWTH * tree.query(points)[0])
        return size


def fill_polygon(
    corners: Array, size: float, forced: NDArray[np.bool_] | None = None
) -> tuple[Array, NDArray[np.int32]]:
    """Nearly regular triangles over a simple polygon; elements are smaller in necks, so that two lie across them.

    Args:
        corners: Corners (k, 2) [m], counter-clockwise, as `clean` gives them.
        size: Length of the sides [m].
        forced: Corners (k,) that the mesh must have; others are left out where they are within a tenth of the size.

    Returns:
        Points (n, 2) [m] and triangles (m, 3), counter-clockwise. No edge but those of the rim joins two points of it,
        so that clamping the rim lets every element move.

    Raises:
        InputError: The polygon is too narrow somewhere for the size.
    """
    forced = np.zeros(len(corners), bool) if forced is None else forced
    corners, forced = outlines.blunt(corners, _TIP * size, forced)
    curve = PolygonCurve.through_corners(corners)
    narrow = None
    for flat in _FLATTER:
        # Teeth that the rim does not follow are no necks.
        graded = ElementSize(_simplify(curve, flat * size, forced), size)
        arc_length = _rim(curve, graded, flat, forced)
        loop = curve.at(arc_length)
        narrow = outlines.crossing_point(loop) if outlines.area(loop) > 0 else loop[0]
        if narrow is None:
            return _check_quality(*_split_chords(*_triangulate_to_rim(curve, arc_length, graded)), size)
    assert narrow is not None
    raise _narrow_error(narrow, size)


def _simplify(curve: PolygonCurve, tolerance: float, forced: NDArray[np.bool_]) -> PolygonCurve:
    """The curve with fewer corners, where it then does not cross itself."""
    kept = outlines.essential_corners(curve.corners, np.full(len(curve.corners), tolerance), forced)
    corners = curve.corners[kept]
    return curve if outlines.crossing_point(corners) is not None else PolygonCurve.through_corners(corners)


def _check_quality(points: Array, triangles: NDArray[np.int32], size: float) -> tuple[Array, NDArray[np.int32]]:
    """The mesh; raises where an element is so low that it would make the step useless."""
    corners = points[triangles]
    one, other = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    longest = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(1)
    height = (one[:, 0] * other[:, 1] - one[:, 1] * other[:, 0]) / longest
    if height.min() < _LOWEST * size:
        raise _narrow_error(corners[np.argmin(height)].mean(0), size)
    return points, triangles


def snap_to_polygon(corners: Array) -> Snap:
    """Puts the middles of a rim's edges on the polygon (k, 2) [m] in z = 0, where it is as near as a quarter edge."""
    curve = PolygonCurve.through_corners(corners)

    def snap(middles: Array, ends: Array, boundary: NDArray[np.bool_]) -> Array:
        moved, length = middles.copy(), np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1)
        moved[boundary, :2] = curve.nearest(middles[boundary, :2])
        near = np.linalg.norm(moved - middles, axis=1) <= 0.25 * length
        return np.where(near[:, None], moved, middles)

    return snap


def _narrow_error(place: Array, size: float) -> InputError:
    problem = f"is much narrower than an element ({size:.4g} m) at ({place[0]:.6g}, {place[1]:.6g}) m"
    return InputError(problem, "make element_size smaller, or the polygon wider there", "parison.polygon")


def _triangulate_to_rim(
    curve: PolygonCurve, arc_length: Array, graded: ElementSize
) -> tuple[Array, NDArray[np.int64], int]:
    """Points, triangles and how many of the points are the rim's; the rim is cut where triangles do not follow it."""
    for _ in range(_ATTEMPTS):
        loop = curve.at(arc_length)
        points, triangles, missing = planform.try_triangulate([loop], graded)
        if not len(missing):
            return points, triangles, len(loop)
        begin = arc_length[missing]
        end = np.append(arc_length, curve.length + arc_length[0])[missing + 1]
        arc_length = np.sort(np.concatenate([arc_length, (0.5 * (begin + end)) % curve.length]))
    raise _narrow_error(loop[missing[0]], graded.largest)


def _rim(curve: PolygonCurve, graded: ElementSize, flat: float, forced: NDArray[np.bool_]) -> Array:
    """The arc length (n,) [m] of the points of the rim: corners that count, and points between them."""
    local = graded(curve.corners)
    kept = outlines.essential_corners(curve.corners, flat * local, forced)
    kept = _merge_close_corners(curve, kept, _SHORT * local * (flat == _FLATTER[0]), forced)
    corner = curve.arc_length[:-1][kept]
    arc_lengths = []
    for begin, end in zip(corner, np.append(corner[1:], curve.length + corner[0]), strict=True):
        fine = np.linspace(begin, end, 2 + int(np.ceil(4 * (end - begin) / graded.largest)))
        size = graded(curve.at(0.5 * (fine[1:] + fine[:-1]) % curve.length))
        rank = np.concatenate([[0.0], np.cumsum(np.diff(fine) / size)])
        arc_lengths.append(np.interp(np.linspace(0.0, rank[-1], max(1, round(rank[-1])) + 1)[:-1], rank, fine))
    return np.unique(np.concatenate(arc_lengths) % curve.length)


def _merge_close_corners(
    curve: PolygonCurve, kept: NDArray[np.bool_], least: Array, forced: NDArray[np.bool_]
) -> NDArray[np.bool_]:
    """Without corners that are nearer than the least (k,) [m] to the last one that counts; those forced stay."""
    kept, last = kept.copy(), -1
    if kept.sum() <= 4:
        return kept
    for corner in np.flatnonzero(kept):
        near = last >= 0 and curve.arc_length[corner] - curve.arc_length[last] < least[corner]
        if near and not forced[corner]:
            kept[corner] = False
        elif near and not forced[last]:
            kept[last] = False
        last = corner if kept[corner] else last
    return kept if kept.sum() >= 3 else kept | forced


def _split_chords(points: Array, triangles: Index, rim: int) -> tuple[Array, NDArray[np.int32]]:
    """The mesh with each inner edge that joins two of the first so many points cut in its middle."""
    outer = {(k, k + 1) for k in range(rim - 1)} | {(0, rim - 1)}
    middle: dict[tuple[int, int], int] = {}
    places, cut = list(points), []
    for triangle in triangles.tolist():
        a, b, c = triangle
        sides = [(min(ends), max(ends)) for ends in ((a, b), (b, c), (c, a))]
        for side in sides:
            if side[1] < rim and side not in outer and side not in middle:
                middle[side] = len(places)
                places.append(0.5 * (points[side[0]] + points[side[1]]))
        cut += _split_triangle(triangle, [middle.get(side) for side in sides])
    return np.array(places), np.array(cut, np.int32)


def _split_triangle(triangle: list[int], middles: list[int | None]) -> list[list[int]]:
    """A triangle cut at the middles of its sides, the first of which begins at its first corner."""
    count = sum(middle is not None for middle in middles)
    if count == 0:
        return [triangle]
    # Turned so that the first side is cut, and the second of two; then each case is one.
    turn = next(k for k in range(3) if middles[k] is not None and (count != 2 or middles[(k + 1) % 3] is not None))
    a, b, c = triangle[turn:] + triangle[:turn]
    ab, bc, ca = (-1 if middle is None else middle for middle in middles[turn:] + middles[:turn])
    if count == 1:
        return [[a, ab, c], [ab, b, c]]
    if count == 2:
        return [[ab, b, bc], [a, ab, bc], [a, bc, c]]
    return [[a, ab, ca], [ab, b, bc], [ca, bc, c], [ab, bc, ca]]

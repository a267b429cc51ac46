"""Regular triangles over a plane region with holes, and over a polygon. On the host."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from jaxform.core.errors import InputError
from jaxform.mesh import outlines, topology
from jaxform.mesh.bisection import Snap
from jaxform.mesh.topology import positions_in_rows
from jaxform.mesh.volumes import longest_sides

Array = NDArray[np.float64]
Index = NDArray[np.int64]
Size = Callable[[Array], Array]
"""Length of the sides (n,) [m] at points (n, 2) [m]."""

_ROUNDS = 6  # of smoothing; more change little
_CLEAR = 0.6  # of the size: inner points keep that far from the rim, so that its edges are edges of the mesh
_MOST_PAIRS = 5_000_000  # of points and sides of the loops beside them, processed together
_FLAT = 1e-7  # of a triangle's side, its height, where it is none
_LEVELS = 4  # times that the largest size may be halved


def resample(curve: Array, size: Size) -> Array:
    """Points (k, 2) [m] along an open curve (n, 2) [m] as far apart as the local size, both ends included."""
    step = np.linalg.norm(np.diff(curve, axis=0), axis=1)
    local = size(0.5 * (curve[1:] + curve[:-1]))
    rank = np.concatenate([[0.0], np.cumsum(step / local)])
    places = np.linspace(0.0, rank[-1], max(2, round(rank[-1])) + 1)
    return np.stack([np.interp(places, rank, curve[:, k]) for k in range(2)], axis=1)


def triangulate(loops: Sequence[Array], size: Size) -> tuple[Array, NDArray[np.int32]]:
    """Nearly regular triangles over the inside of closed curves.

    Args:
        loops: Corners (k, 2) [m] of each closed curve, as far apart as the local size: the rim and the holes.
        size: Length of the sides.

    Returns:
        Points (n, 2) [m], those of the loops first and unmoved, and triangles (m, 3), counter-clockwise.

    Raises:
        ValueError: The curves are too close to each other, or too coarse, for the mesh to follow them.
    """
    points, triangles, missing = try_triangulate(loops, size)
    if len(missing):
        raise ValueError("the triangles do not follow the curves")
    return points, triangles.astype(np.int32)


def try_triangulate(loops: Sequence[Array], size: Size) -> tuple[Array, NDArray[np.int64], NDArray[np.int64]]:
    """The mesh of `triangulate`, and the loops' edges (k,) that it lacks, by their first point; raises nothing."""
    rim = np.concatenate(loops)
    inner = _lattice(rim, size)
    inner = inner[_is_clear(inner, loops, _CLEAR * size(inner))]
    for _ in range(_ROUNDS):
        points = np.concatenate([rim, inner])
        moved = _neighbours_mean(points, _inner_triangles(points, loops))[len(rim) :]
        stays = _is_clear(moved, loops, 0.5 * _CLEAR * size(moved))
        inner = np.where(stays[:, None], moved, inner)
    points = np.concatenate([rim, inner])
    triangles = _inner_triangles(points, loops)
    return points, triangles, _missing_edges(triangles, loops)


def _lattice(rim: Array, size: Size) -> Array:
    """Nested hexagonal lattices over the rim's bounding box: where the size is smaller, the next finer one."""
    low, high = rim.min(0), rim.max(0)
    spacing = float(size(rim).max())
    chosen = []
    for level in range(_LEVELS + 1):
        step = spacing / 2**level
        x, y = np.meshgrid(np.arange(low[0], high[0] + step, step), np.arange(low[1], high[1] + step, step * _ROW))
        x[1::2] += 0.5 * step
        points = np.stack([x.ravel(), y.ravel()], axis=1)
        wanted = np.clip(np.round(np.log2(spacing / size(points))), 0, _LEVELS)
        chosen.append(points[wanted == level])
    return np.concatenate(chosen)


_ROW = np.sqrt(0.75)  # distance of a hexagonal lattice's rows


def _is_clear(points: Array, loops: Sequence[Array], clearance: Array) -> NDArray[np.bool_]:
    """True where points are inside the loops and at a larger distance from them than the clearance."""
    return inside(points, loops) & (_rim_distance(points, loops) > clearance)


def inside(points: Array, loops: Sequence[Array]) -> NDArray[np.bool_]:
    """True where points (n, 2) are inside the loops: a line to the right crosses these an odd number of times."""
    begin = np.concatenate(loops)
    end = np.concatenate([np.roll(loop, -1, axis=0) for loop in loops])
    slope = (end[:, 0] - begin[:, 0]) / np.where(begin[:, 1] == end[:, 1], 1.0, end[:, 1] - begin[:, 1])
    # In the order of y the points beside a side of the loops are next to each other.
    order = np.argsort(points[:, 1])
    x, y = points[order].T
    first = np.searchsorted(y, np.minimum(begin[:, 1], end[:, 1]))
    count = np.searchsorted(y, np.maximum(begin[:, 1], end[:, 1])) - first
    crossings = np.zeros(len(points), np.int64)
    for part in np.array_split(np.arange(len(begin)), 1 + int(count.sum()) // _MOST_PAIRS):
        side = np.repeat(part, count[part])
        point = positions_in_rows(count[part]) + first[side]
        left = x[point] < begin[side, 0] + (y[point] - begin[side, 1]) * slope[side]
        crossings += np.bincount(point[left], minlength=len(points))
    found = np.zeros(len(points), bool)
    found[order] = crossings % 2 == 1
    return found


def _rim_distance(points: Array, loops: Sequence[Array]) -> Array:
    """Distance to the loops, each side sampled ten times."""
    from scipy.spatial import KDTree

    share = np.arange(10)[:, None] / 10
    samples = [(loop[:, None] + share * (np.roll(loop, -1, axis=0) - loop)[:, None]).reshape(-1, 2) for loop in loops]
    return KDTree(np.concatenate(samples)).query(points)[0]


def _inner_triangles(points: Array, loops: Sequence[Array]) -> NDArray[np.int64]:
    """The Delaunay triangles inside the loops."""
    from scipy.spatial import Delaunay

    triangles = Delaunay(points).simplices.astype(np.int64)
    corners = points[triangles]
    one, other = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    doubled = np.abs(one[:, 0] * other[:, 1] - one[:, 1] * other[:, 0])
    longest = np.maximum(np.sum(one**2, axis=1), np.sum(other**2, axis=1))
    # Along a straight side of the rim rounding makes triangles of three of its points.
    return triangles[(doubled > _FLAT * longest) & inside(corners.mean(1), loops)]


def _neighbours_mean(points: Array, triangles: NDArray[np.int64]) -> Array:
    total, count = np.zeros_like(points), np.zeros(len(points))
    for k in range(3):
        here = triangles[:, k]
        np.add.at(total, here, points[triangles[:, (k + 1) % 3]] + points[triangles[:, (k + 2) % 3]])
        np.add.at(count, here, 2.0)
    return total / np.maximum(count, 1.0)[:, None]


def _missing_edges(triangles: NDArray[np.int64], loops: Sequence[Array]) -> NDArray[np.int64]:
    """The edges of the loops that are not edges of triangles, by the number of their first point."""
    sides = np.sort(triangles[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    start = np.cumsum([0, *map(len, loops)])
    following = [np.roll(np.arange(len(loop)) + at, -1) for at, loop in zip(start, loops, strict=False)]
    wanted = np.sort(np.stack([np.arange(start[-1]), np.concatenate(following)], axis=1), axis=1)
    base = int(max(sides.max(initial=0), start[-1])) + 1
    return np.flatnonzero(~np.isin(wanted @ [base, 1], sides @ [base, 1]))


def interpolator(points: Array, values: Array) -> Callable[[Array], Array]:
    """Linear interpolation of (n, k) values at scattered points (n, 2); outside of them the nearest one's value."""
    from scipy.interpolate import LinearNDInterpolator  # takes a third of a second to import
    from scipy.spatial import KDTree

    inside, tree = LinearNDInterpolator(points, values), KDTree(points)

    def at(places: Array) -> Array:
        found = inside(places)
        return np.where(np.isnan(found), values[tree.query(places)[1]], found)

    return at


# Triangles over a polygon of a user's own: regular, smaller in necks, two across every one of them. On the host.


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


class PolygonCurve:
    """A closed polygon by the arc length along it.

    Attributes:
        corners: Corners (k, 2) [m], counter-clockwise.
        arc_length: To each corner and back to the first (k + 1,) [m].
    """

    def __init__(self, corners: Array) -> None:
        """The curve through corners (k, 2) [m]."""
        steps = np.linalg.norm(np.roll(corners, -1, axis=0) - corners, axis=1)
        self.corners = corners
        self.arc_length = np.concatenate([[0.0], np.cumsum(steps)])

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
        within = inside(0.5 * (places[one] + places[other]), [curve.corners])
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
    curve = PolygonCurve(corners)
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
    return curve if outlines.crossing_point(corners) is not None else PolygonCurve(corners)


def _check_quality(points: Array, triangles: NDArray[np.int32], size: float) -> tuple[Array, NDArray[np.int32]]:
    """The mesh; raises where an element is so low that it would make the step useless."""
    corners = points[triangles]
    one, other = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    longest = longest_sides(corners)
    height = (one[:, 0] * other[:, 1] - one[:, 1] * other[:, 0]) / longest
    if height.min() < _LOWEST * size:
        raise _narrow_error(corners[np.argmin(height)].mean(0), size)
    return points, triangles


def snap_to_polygon(corners: Array) -> Snap:
    """Puts the middles of a rim's edges on the polygon (k, 2) [m] in z = 0, where it is as near as a quarter edge."""
    curve = PolygonCurve(corners)

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
        points, triangles, missing = try_triangulate([loop], graded)
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
        cut += topology.split_triangle(triangle, [middle.get(side) for side in sides])
    return np.array(places), np.array(cut, np.int32)

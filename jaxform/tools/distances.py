"""Distances of points from the mold, or from another surface. On the host."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from jaxform.mesh import topology
from jaxform.mesh.topology import unique_ascending
from jaxform.mesh.volumes import longest_sides
from jaxform.tools.search import split_long_triangles

Array = NDArray[np.float64]

_TIE = 1e-9  # of the mold's size: triangles as near as that are equally near
_AT_FIRST = 8  # pieces of triangles that are searched for near a point
_FINEST = 200  # pieces of triangles along the mold's longest side
_MOST_PIECES = 100_000, 2  # in all or for each triangle, whichever are more
_ASKED, _MORE = 32, 2  # points, the farthest by their bounds, that are measured first, and times as many each round
_POINTS = 4096  # that are looked up together
_THREADED = 2048  # points whose query is spread over the cores
_IN_CACHE = 10_000  # pairs of them whose coordinates fit into a core's cache
_CHUNK = 50_000  # pairs of point and triangle processed together


class NearestPlaces(NamedTuple):
    """The places of a surface that are nearest to points.

    Attributes:
        triangle: The triangle of each place (n,).
        place: The places (n, 3) [m].
        distance: Distances of the points from them (n,) [m].
        at_rim: True where they are on the rim of an open surface (n,).
    """

    triangle: NDArray[np.int64]
    place: Array
    distance: Array
    at_rim: NDArray[np.bool_]


_TriangleGroup = tuple[Any, Array, NDArray[np.int64]]
"""Pieces of triangles that are about as large: a tree of their middles, radii (n,) [m], and the triangles of all."""


def _candidate_pairs(group: _TriangleGroup, points: Array, limit: Array) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Pairs of a point (n, 3) and a piece that may be no farther from it than its limit (n,) [m]."""
    tree, radius, owner = group
    reach, wanted = (limit + radius.max()) * (1 + _TIE), min(_AT_FIRST, len(owner))
    away, piece = tree.query(points, k=wanted, workers=_workers(points))
    away, piece = away.reshape(-1, wanted), piece.reshape(-1, wanted)
    more = (away[:, -1] <= reach) & (wanted < len(owner))
    row, column = np.nonzero((away <= reach[:, None]) & ~more[:, None])
    row, piece = [row], [piece[row, column]]
    # Most points have few pieces in reach; around the others all of them are listed.
    many = np.flatnonzero(more)
    if len(many):
        listed = tree.query_ball_point(points[many], reach[many], return_sorted=False, workers=_workers(many))
        row.append(np.repeat(many, [len(one) for one in listed]))
        piece.append(np.concatenate([np.asarray(one, np.int64) for one in listed]))
    point, piece = np.concatenate(row), np.concatenate(piece)
    away = np.linalg.norm(points[point] - tree.data[piece], axis=1)
    near = away <= (limit[point] + radius[piece]) * (1 + _TIE)
    return point[near], piece[near]


def _workers(points: NDArray[Any]) -> int:
    """The number of threads for a query of points (n, ...); -1 for all cores."""
    return -1 if len(points) >= _THREADED else 1


def _groups(pieces: Array, owner: NDArray[np.int64]) -> list[_TriangleGroup]:
    """Pieces (n, 3, 3) [m] of triangles (n,) by their size: of the smaller ones fewer need be checked."""
    from scipy.spatial import KDTree  # takes a tenth of a second to import

    middle = pieces.mean(1)
    radius = np.linalg.norm(pieces - middle[:, None], axis=2).max(1)
    kind = np.floor(np.log2(radius.max() / np.maximum(radius, 1e-3 * radius.max())) / 2).astype(int)
    rows = [np.flatnonzero(kind == k) for k in np.unique(kind)]
    return [(KDTree(middle[row]), radius[row], owner[row]) for row in rows]


class Distances:
    """Distances from a mold or another surface, where they are no more than `farthest` [m].

    Args:
        vertices: Its vertices (n_vertex, 3) [m].
        triangles: Vertex numbers (n_triangle, 3); every triangle has an area.
        farthest: The largest distance [m].
    """

    def __init__(self, vertices: ArrayLike, triangles: ArrayLike, farthest: float) -> None:
        """See the class."""
        places, triangles = np.asarray(vertices, float), np.asarray(triangles)
        self.corners = places[triangles]
        self.size = float(np.ptp(self.corners, axis=(0, 1)).max())
        self.farthest = farthest
        self.open_side, self.open_corner = _rims(triangles, len(places))
        longest = longest_sides(self.corners).max()
        shortest = max(min(longest, 0.5 * farthest), self.size / _FINEST)
        self._known: list[tuple[Array, NDArray[np.int64]]] = []
        self.groups = _groups(*split_long_triangles(self.corners, _length(self.corners, shortest)))

    def upper_bounds(self, points: Array) -> Array:
        """Upper bounds (n,) [m] of the distances of points (n, 3): those from triangles with near middles."""
        return self._upper_bounds(points)[0]

    def _upper_bounds(self, points: Array) -> tuple[Array, NDArray[np.int64]]:
        """Upper bounds (n,) [m] of distances, and the triangles (n,) that are so far away."""
        least, triangle = np.full(len(points), np.inf), np.zeros(len(points), np.int64)
        for tree, _, owner in self.groups:
            candidate = owner[np.asarray(tree.query(points, workers=_workers(points))[1])]
            distance = self._distances(points, candidate)
            triangle = np.where(distance < least, candidate, triangle)
            least = np.minimum(least, distance)
        return least, triangle

    def _distances(self, points: Array, triangle: NDArray[np.int64]) -> Array:
        """Distances (n,) [m] of points (n, 3) from triangles (n,), pair by pair."""
        parts = np.array_split(np.arange(len(points)), 1 + len(points) // _CHUNK)
        return np.concatenate([point_triangle_distance(points[part], self.corners[triangle[part]]) for part in parts])

    def exact(self, points: Array) -> Array:
        """Distances (n,) [m] of points (n, 3).

        Zero where it is too far, or where the nearest place is on the rim of an open mold, beyond which there is no
        surface.
        """
        if not len(points):
            return np.zeros(0)
        bound, about = self._upper_bounds(points)
        point, triangle = self._pairs(points, bound)
        parts = np.array_split(np.arange(len(point)), 1 + len(point) // _CHUNK)
        found = [self._examine(points[point[part]], triangle[part]) for part in parts]
        distance, at_rim = (np.concatenate(values) for values in zip(*found, strict=True))
        nearest = np.full(len(points), np.inf)
        np.minimum.at(nearest, point, distance)
        rim = np.zeros(len(points), bool)
        rim[point[at_rim & (distance <= nearest[point] + _TIE * self.size)]] = True
        one = distance == nearest[point]
        about[point[one]] = triangle[one]
        self._known.append((points, about))
        return np.where(rim | (nearest > self.farthest), 0.0, nearest)

    def largest(self, points: Array, above: float = 0.0) -> tuple[float, int]:
        """The largest distance [m] of points (n, 3) [m] by `exact`, and its index; `above` and -1 of none above it."""
        best, found = above, -1

        def measure(asked: NDArray[np.int64]) -> float:
            nonlocal best, found
            distance = self.exact(points[asked])
            if distance.max() > best:
                best, found = float(distance.max()), int(asked[np.argmax(distance)])
            return best

        self.search_largest(points, measure, above)
        return best, found

    def search_largest(
        self,
        points: Array,
        measure: Callable[[NDArray[np.int64]], float],
        above: float = 0.0,
        beyond: Array | float = 0.0,
    ) -> None:
        """Measures those of points (n, 3) [m] whose values may be the largest, by bounds of their distances.

        Each round measures a few. What is nearest to a measured point bounds the distances of the others around it,
        which then mostly need not be measured.

        Args:
            points: The points.
            measure: Measures some of them (k,), by `exact` or `nearest`; returns the largest value [m] so far.
            above: The value [m] that must be exceeded.
            beyond: Largest excess (n,) [m] of the value of each over its distance.
        """
        best, count, left = above, _ASKED, np.arange(len(points))
        beyond, bound = np.broadcast_to(beyond, len(points)), self.upper_bounds(points)
        bound = np.minimum(bound, self._bounds_by_known(points))
        while len(left := left[bound[left] + beyond[left] > best]):
            order = left[np.argsort(-(bound + beyond)[left], kind="stable")]
            # The first ones, and some from all over the others.
            asked = np.concatenate([order[:count], order[count :: max(1, len(order) // count)]])
            best = max(best, measure(asked))
            left = np.setdiff1d(left, asked, assume_unique=True)
            bound[left] = np.minimum(bound[left], self._bounds_by_known(points[left]))
            count *= _MORE

    def _bounds_by_known(self, points: Array) -> Array:
        """Upper bounds (n,) [m] of the distances of points (n, 3): from what is nearest to the nearest known point."""
        from scipy.spatial import KDTree

        if not self._known or not len(points):
            return np.full(len(points), np.inf)
        known, triangle = (np.concatenate(values) for values in zip(*self._known, strict=True))
        return self._distances(points, triangle[np.asarray(KDTree(known).query(points)[1])])

    def nearest(self, points: Array) -> NearestPlaces:
        """The nearest places to points (n, 3) [m]; in a triangle with a near middle, where it is too far."""
        bound, triangle = self._upper_bounds(points)
        point, candidate = self._pairs(points, bound)
        distance = self._distances(points[point], candidate)
        order = np.lexsort((distance, point))
        first = order[np.unique(point[order], return_index=True)[1]]
        triangle[point[first]] = candidate[first]
        self._known.append((points, triangle))
        parts = np.array_split(np.arange(len(points)), 1 + len(points) // _CHUNK)
        seen = [self._examine(points[part], triangle[part]) for part in parts]
        distance, at_rim = (np.concatenate(values) for values in zip(*seen, strict=True))
        return NearestPlaces(triangle, nearest_places(points, self.corners[triangle]), distance, at_rim)

    def _pairs(self, points: Array, bound: Array) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Points and the triangles that may be nearest to them, which are no farther than their bounds (n,) [m]."""
        count, keys = len(self.corners), [np.zeros(0, np.int64)]
        limit = np.minimum(bound, self.farthest) + _TIE * self.size
        for group in self.groups:
            for part in np.array_split(np.arange(len(points)), 1 + len(points) // _POINTS):
                point, piece = _candidate_pairs(group, points[part], limit[part])
                keys.append(unique_ascending(part[point] * count + group[2][piece]))
        key = unique_ascending(np.concatenate(keys))
        return key // count, key % count

    def _examine(self, points: Array, triangle: NDArray[np.int64]) -> tuple[Array, NDArray[np.bool_]]:
        """Distances, and whether the nearest place is on an open rim, pair by pair."""
        distance, side, end = _nearest(points, self.corners[triangle])
        on_corner = np.where(end == 0, side, (side + 1) % 3)
        at_rim = (side >= 0) & self.open_side[triangle, side]
        at_rim |= (side >= 0) & (end >= 0) & self.open_corner[triangle, on_corner]
        return distance, at_rim


def _length(corners: Array, length: float) -> float:
    """A length [m] to which triangles (n, 3, 3) can be cut, so that the pieces are not too many."""
    side = longest_sides(corners)
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    in_all, each = _MOST_PIECES
    while True:
        across = np.maximum(area / side / length, 1.0)
        if (2 * np.maximum(side / length, 0.5) * across).sum() <= max(in_all, each * len(corners)):
            return length
        length *= 1.25


def _rims(triangles: NDArray[np.integer], vertex_count: int) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Masks of the triangles' sides (n, 3), from each corner to the next, and corners (n, 3) on an open rim."""
    rim = topology.boundary_edges(triangles)
    side = np.sort(np.stack([triangles, np.roll(triangles, -1, axis=1)], axis=2), axis=2)
    name = np.array([vertex_count, 1], np.int64)
    return np.isin(side @ name, rim @ name), np.isin(triangles, rim)


def _nearest(points: Array, corners: Array) -> tuple[Array, NDArray[np.int64], NDArray[np.int64]]:
    """Distances of points (n, 3) from triangles (n, 3, 3), pair by pair, and where the nearest place is.

    Returns:
        The distance; the side that it is on, -1 inside; the end of that side (0 or 1), -1 between.
    """
    parts = np.array_split(np.arange(len(points)), 1 + len(points) // _IN_CACHE)
    found = [_nearest_by_coordinate(points[part], corners[part]) for part in parts]
    distance, side, end = zip(*found, strict=True)
    return np.concatenate(distance), np.concatenate(side), np.concatenate(end)


def _nearest_by_coordinate(points: Array, corners: Array) -> tuple[Array, NDArray[np.int64], NDArray[np.int64]]:
    """The same as `_nearest`, coordinate by coordinate: several times as fast as vector by vector."""
    place, (d, e, f) = points.T, np.ascontiguousarray(np.moveaxis(corners, 0, 2))
    edge1, edge2, away = e - d, f - d, place - d
    normal = _cross(edge1, edge2)
    square, height = _dot(normal, normal), _dot(away, normal)
    gamma, delta = _dot(_cross(away, edge2), normal) / square, _dot(_cross(edge1, away), normal) / square
    inside = (gamma >= 0) & (delta >= 0) & (gamma + delta <= 1)
    distance, side, share = np.full(len(points), np.inf), np.zeros(len(points), np.int64), np.zeros(len(points))
    for k, (begin, end) in enumerate(((d, e), (e, f), (f, d))):
        along, beside = end - begin, place - begin
        t = np.clip(_dot(beside, along) / _dot(along, along), 0.0, 1.0)
        beside -= t * along
        off = np.sqrt(_dot(beside, beside))
        nearer = off < distance
        distance, share = np.where(nearer, off, distance), np.where(nearer, t, share)
        side[nearer] = k
    ends = np.where(share <= 0, 0, np.where(share >= 1, 1, -1))
    distance = np.where(inside, np.abs(height) / np.sqrt(square), distance)
    return distance, np.where(inside, -1, side), np.where(inside, -1, ends)


def _dot(one: Array, other: Array) -> Array:
    """Products (n,) of vectors (3, n) and (3, n)."""
    return one[0] * other[0] + one[1] * other[1] + one[2] * other[2]


def _cross(one: Array, other: Array) -> Array:
    """Cross products (3, n) of vectors (3, n) and (3, n)."""
    return np.stack([one[(k + 1) % 3] * other[(k + 2) % 3] - one[(k + 2) % 3] * other[(k + 1) % 3] for k in range(3)])


def _segment(points: Array, begin: Array, end: Array) -> tuple[Array, Array]:
    """Distance of points from segments and where on them the nearest place is, 0 to 1; pair by pair."""
    along, away = end - begin, points - begin
    t = np.clip(np.einsum("ij,ij->i", away, along) / np.einsum("ij,ij->i", along, along), 0.0, 1.0)
    return np.linalg.norm(away - t[:, None] * along, axis=1), t


def segment_distance(points: Array, begin: Array, end: Array) -> Array:
    """Distances (n,) [m] from points (n, 3) to segments between places (n, 3), pair by pair."""
    return _segment(points, begin, end)[0]


def point_triangle_distance(points: Array, corners: Array) -> Array:
    """Distances (n,) [m] from points (n, 3) to triangles (n, 3, 3), pair by pair."""
    return _nearest(points, corners)[0]


def nearest_places(points: Array, corners: Array) -> Array:
    """The places (n, 3) [m] of triangles (n, 3, 3) that are nearest to points (n, 3), pair by pair."""
    _, side, _ = _nearest(points, corners)
    row, first = np.arange(len(points)), np.maximum(side, 0)
    begin, end = corners[row, first], corners[row, (first + 1) % 3]
    share = _segment(points, begin, end)[1]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    height = np.einsum("ij,ij->i", points - corners[:, 0], normal) / np.einsum("ij,ij->i", normal, normal)
    return np.where((side < 0)[:, None], points - height[:, None] * normal, begin + share[:, None] * (end - begin))


def weights(places: Array, corners: Array) -> Array:
    """Barycentric coordinates (n, 3) of places (n, 3) in triangles (n, 3, 3), pair by pair."""
    weight = np.maximum(signed_weights(places, corners), 0.0)
    return weight / weight.sum(1, keepdims=True)


def signed_weights(places: Array, corners: Array) -> Array:
    """As `weights`, of the places' projections on the triangles' planes: negative outside of a triangle."""
    opposite = np.cross(corners[:, [1, 2, 0]] - places[:, None], corners[:, [2, 0, 1]] - places[:, None])
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    return np.einsum("nki,ni->nk", opposite, normal) / np.einsum("ni,ni->n", normal, normal)[:, None]


def interpolate(nodal: Array, triangles: NDArray[np.integer], triangle: NDArray[np.int64], weight: Array) -> Array:
    """Nodal values (n, ...) at places (m, ...), in which triangle each is (m,), with which `weights` (m, 3)."""
    return np.einsum("mk,mk...->m...", weight, nodal[triangles[triangle]])

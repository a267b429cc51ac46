"""Whether a sheet is through the mold, and how far. On the host.

Nodes never pass the mold, but an element can span a convex edge of it and cut it. How deep, is measured at points all
over the elements: their distance to the mold, where they are on its far side. The mold's triangles need not all turn
the same way, so the near side is the one from which the nodes came that stick to it.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from jaxform import topology
from jaxform.mold import Mold
from jaxform.search import SearchGrid, cut

Array = NDArray[np.float64]

_DIVISIONS = 6  # of an element's sides
_TIE = 1e-9  # of the mold's size: triangles as near as that are equally near
_AT_FIRST = 8  # pieces of triangles that are looked for near a point
_CHUNK = 200_000  # pairs of point and triangle looked at together


class Penetration(NamedTuple):
    """How far a sheet is beyond the mold [m]: its nodes, its elements, and where these are deepest (3,) [m]."""

    nodes: float
    elements: float
    place: Array


def penetration(positions: Array, triangles: NDArray[np.integer], wall: NDArray[np.integer], mold: Mold) -> Penetration:
    """How far a sheet is beyond the mold.

    Args:
        positions: Of the nodes (n_node, 3) [m].
        triangles: Their elements (n_element, 3).
        wall: What each node sticks to (n_node,), see `Result.wall`.
        mold: The mold.
    """
    corners = positions[triangles]
    longest = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(initial=0.0)
    walls = _Walls(mold, wall, longest)
    suspect = walls.behind_some(corners)
    nodes = np.unique(triangles[suspect])
    points = np.einsum("pc,tck->tpk", _lattice(_DIVISIONS), corners[suspect]).reshape(-1, 3)
    depth = np.maximum(-walls.heights(np.concatenate([positions[nodes], points])), 0.0)
    of_nodes, of_points = np.split(depth, [len(nodes)])
    place = points[np.argmax(of_points)] if len(points) else np.zeros(3)
    return Penetration(float(of_nodes.max(initial=0.0)), float(of_points.max(initial=0.0)), place)


def _lattice(divisions: int) -> Array:
    """Barycentric points (n, 3) all over a triangle."""
    i, j = (index.ravel() for index in np.meshgrid(np.arange(divisions + 1), np.arange(divisions + 1)))
    kept = i + j <= divisions
    return np.stack([divisions - i - j, i, j], axis=1)[kept] / divisions


class _Walls:
    """The mold's triangles with their near sides, for places within a distance [m] of them."""

    def __init__(self, mold: Mold, wall: NDArray[np.integer], farthest: float) -> None:
        triangles = np.asarray(mold.triangles)
        self.corners = np.asarray(mold.vertices, float)[triangles]
        self.size = float(np.ptp(self.corners, axis=(0, 1)).max())
        normal = np.cross(self.corners[:, 1] - self.corners[:, 0], self.corners[:, 2] - self.corners[:, 0])
        normal /= np.linalg.norm(normal, axis=1, keepdims=True)
        self.normal = normal * _near_sides(triangles, wall)[:, None]
        open_edge = topology.boundary_edges(triangles)
        key = open_edge @ [len(mold.vertices), 1]
        side = np.sort(np.stack([triangles, np.roll(triangles, -1, axis=1)], axis=2), axis=2)
        self.open_side = np.isin(side @ [len(mold.vertices), 1], key)
        self.open_corner = np.isin(triangles, open_edge)
        from scipy.spatial import KDTree  # takes a tenth of a second to import

        self.farthest = farthest
        longest = np.linalg.norm(self.corners - np.roll(self.corners, 1, axis=1), axis=2).max()
        pieces, self.owner = cut(self.corners, max(min(longest, 0.5 * farthest), self.size / 200))
        middle = pieces.mean(1)
        self.radius = float(np.linalg.norm(pieces - middle[:, None], axis=2).max())
        self.tree = KDTree(middle)

    def behind_some(self, corners: Array) -> NDArray[np.bool_]:
        """Which elements with these corners (n, 3, 3) [m] are partly behind the plane of some triangle near them.

        No other can be through the mold: an element that is before the planes of all that may be nearest to its
        points, as everywhere in a hollow, is before the mold.
        """
        middle = corners.mean(1)
        extent = np.linalg.norm(corners - middle[:, None], axis=2).max(1)
        element, triangle = self._pairs(middle, extent)
        away = corners[element] - self.corners[triangle, :1]
        height = np.einsum("pck,pk->pc", away, self.normal[triangle]).min(1)
        found = np.zeros(len(corners), bool)
        found[element[height < -_TIE * self.size]] = True
        return found

    def heights(self, points: Array) -> Array:
        """Distance (n,) [m] of points (n, 3) from the mold, negative on its far side.

        Zero where it is too far, where nothing is known of the sides, or where the nearest place is on
        the rim of an open mold, beyond which there is no wall.
        """
        point, triangle = self._pairs(points, np.zeros(len(points)))
        if not len(point):
            return np.zeros(len(points))
        parts = np.array_split(np.arange(len(point)), 1 + len(point) // _CHUNK)
        found = [self._examine(points[point[part]], triangle[part]) for part in parts]
        distance, height, at_rim = (np.concatenate(values) for values in zip(*found, strict=True))
        nearest = np.full(len(points), np.inf)
        np.minimum.at(nearest, point, distance)
        # At an edge or corner, the triangle that looks at the point most squarely tells the side.
        tied = distance <= nearest[point] + _TIE * self.size
        order = np.flatnonzero(tied)[np.argsort(np.abs(height[tied]), kind="stable")]
        result = np.zeros(len(points))
        result[point[order]] = np.sign(height[order]) * distance[order]
        rim = np.zeros(len(points), bool)
        rim[point[tied & at_rim]] = True
        return np.where(rim | (nearest > self.farthest), 0.0, result)

    def _pairs(self, points: Array, extent: Array) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Points and the triangles that may be nearest to them, or to what is within an extent (n,) [m] of them."""
        asked, wanted, count = np.arange(len(points)), min(_AT_FIRST, len(self.owner)), len(self.corners)
        keys = [asked[:0]]
        while len(asked):
            # So many of the nearest at once; the few points with more of them in reach are asked again.
            away, piece = self.tree.query(points[asked], k=wanted, workers=-1)
            away, piece = away.reshape(-1, wanted), piece.reshape(-1, wanted)
            reach = away[:, :1] + 2 * extent[asked, None] + self.radius * (1 + _TIE)
            near = away[:, :1] <= self.farthest + extent[asked, None] + self.radius
            within = near & (away <= reach)
            key = asked[:, None] * count + self.owner[piece]
            keys.append(np.unique(key[within]))
            asked = asked[within[:, -1] & (wanted < len(self.owner))]
            wanted = min(4 * wanted, len(self.owner))
        key = np.unique(np.concatenate(keys))
        return key // count, key % count

    def _examine(self, points: Array, triangle: NDArray[np.int64]) -> tuple[Array, Array, NDArray[np.bool_]]:
        """Distance, height over the plane, and whether the nearest place is on an open rim, pair by pair."""
        corners = self.corners[triangle]
        height = np.einsum("ij,ij->i", self.normal[triangle], points - corners[:, 0])
        distance, side, end = _nearest(points, corners)
        row = np.arange(len(points))
        on_corner = np.where(end == 0, side, (side + 1) % 3)
        at_rim = (side >= 0) & self.open_side[triangle, side]
        at_rim |= (side >= 0) & (end >= 0) & self.open_corner[triangle, on_corner][row]
        return distance, height, at_rim


def _near_sides(triangles: NDArray[np.integer], wall: NDArray[np.integer]) -> Array:
    """1 where a triangle's normal points to the side from which the nodes came, -1 where away, 0 where unknown."""
    part, sign = topology.orientations(triangles)
    touching = wall[wall != 0]
    touched = np.abs(touching) - 1
    votes = np.bincount(part[touched], np.sign(touching) * sign[touched], minlength=part.max() + 1)
    return (sign * np.sign(votes)[part]).astype(float)


def _nearest(points: Array, corners: Array) -> tuple[Array, NDArray[np.int64], NDArray[np.int64]]:
    """Distances of points (n, 3) from triangles (n, 3, 3), pair by pair, and where the nearest place is.

    Returns:
        The distance; the side that it is on, -1 inside; the end of that side (0 or 1), -1 between.
    """
    d, edge1, edge2 = corners[:, 0], corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    normal = np.cross(edge1, edge2)
    square = np.einsum("ij,ij->i", normal, normal)
    away = points - d
    gamma = np.einsum("ij,ij->i", np.cross(away, edge2), normal) / square
    delta = np.einsum("ij,ij->i", np.cross(edge1, away), normal) / square
    inside = (gamma >= 0) & (delta >= 0) & (gamma + delta <= 1)
    flat = np.abs(np.einsum("ij,ij->i", away, normal)) / np.sqrt(square)
    sides = [_segment(points, corners[:, k], corners[:, (k + 1) % 3]) for k in range(3)]
    distances, places = (np.stack(values) for values in zip(*sides, strict=True))
    side = np.argmin(distances, axis=0)
    row = np.arange(len(points))
    place = places[side, row]
    end = np.select([place <= 0, place >= 1], [0, 1], -1)
    distance = np.where(inside, flat, distances[side, row])
    return distance, np.where(inside, -1, side), np.where(inside, -1, end)


def _segment(points: Array, begin: Array, end: Array) -> tuple[Array, Array]:
    """Distance of points from segments and where on them the nearest place is, 0 to 1; pair by pair."""
    along, away = end - begin, points - begin
    t = np.clip(np.einsum("ij,ij->i", away, along) / np.einsum("ij,ij->i", along, along), 0.0, 1.0)
    return np.linalg.norm(away - t[:, None] * along, axis=1), t


def point_triangle_distance(points: Array, corners: Array) -> Array:
    """Distances (n,) [m] from points (n, 3) to triangles (n, 3, 3), pair by pair."""
    return _nearest(points, corners)[0]


def first_crossing(
    begin: np.ndarray, end: np.ndarray, mold: Mold, grid: SearchGrid, margin: float = 1e-6
) -> tuple[int, int] | None:
    """The first segment (from `begin` to `end`, each (n, 3) [m]) that properly crosses the mold, with its triangle.

    Touching does not count: the crossing must lie inside segment and triangle by the relative margin.
    """
    segment, triangle = _segment_pairs(begin, end, grid)
    corners = np.asarray(mold.vertices, float)[np.asarray(mold.triangles)[triangle]]
    b, path = begin[segment], (end - begin)[segment]
    d, edge1, edge2 = corners[:, 0], corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    normal = np.cross(edge1, edge2)
    square = np.einsum("ij,ij->i", normal, normal)
    height = np.einsum("ij,ij->i", b - d, normal)
    slope = np.einsum("ij,ij->i", path, normal)
    # A path that hardly leaves the triangle's plane is a touch.
    steep = np.abs(slope) > 1e-9 * np.sqrt(square) * float(grid.size)
    beta = -height / np.where(steep, slope, 1.0)
    meet = b + beta[:, None] * path - d
    gamma = np.einsum("ij,ij->i", np.cross(meet, edge2), normal) / square
    delta = np.einsum("ij,ij->i", np.cross(edge1, meet), normal) / square
    # Strictly inside, for a sheet may rest on the rim of an open mold.
    inside = (gamma > margin) & (delta > margin) & (gamma + delta < 1 - margin)
    hit = np.flatnonzero(steep & inside & (beta > margin) & (beta < 1 - margin))
    return (int(segment[hit[0]]), int(triangle[hit[0]])) if len(hit) else None


def _segment_pairs(begin: np.ndarray, end: np.ndarray, grid: SearchGrid) -> tuple[np.ndarray, np.ndarray]:
    """Pairs of segments and triangles that can meet: segments are sampled once per cell width."""
    width, shape = float(grid.width), np.array(grid.shape)
    samples = np.ceil(np.linalg.norm(end - begin, axis=1) / width).astype(int) + 1
    segment = np.repeat(np.arange(len(begin)), samples)
    k = np.arange(len(segment)) - np.repeat(np.cumsum(samples) - samples, samples)
    t = (k + 0.5) / samples[segment]
    point = begin[segment] + t[:, None] * (end - begin)[segment]
    index = np.floor((point - np.asarray(grid.corner, float)) / width).astype(int)
    kept = np.all((index >= 0) & (index < shape), axis=1)
    cell = np.ravel_multi_index(tuple(index[kept].T), grid.shape)
    start = np.asarray(grid.start)
    count = start[cell + 1] - start[cell]
    flat = np.repeat(start[cell] - np.cumsum(count) + count, count) + np.arange(count.sum())
    pairs = np.unique(
        np.stack([np.repeat(segment[kept], count), np.asarray(grid.number)[np.asarray(grid.listed)[flat]]], 1), axis=0
    )
    return pairs[:, 0], pairs[:, 1]

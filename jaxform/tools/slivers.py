"""Merging the slivers of a mold into fewer triangles of the same surface. On the host.

CAD writes turned parts as slivers: as long as a wall, and as narrow as a fine step of the angle. A node meets thousands
of them, most of all where they meet in one vertex. Short sides of slivers are collapsed as long as the surface stays
where it is to within a millionth of its size, which is about the rounding of a mesh file.

Vertices are removed in rounds of independent half-edge collapses. How far a triangle may be from the first surface is
carried along, so that rounds do not add up to more (compare Cohen et al., Simplification envelopes, SIGGRAPH 1996).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from jaxform.tools.distances import point_triangle_distance, segment_distance

Array = NDArray[np.float64]
Integers = NDArray[np.int64]
Mask = NDArray[np.bool_]

_TOLERANCE = 3e-6  # of the mold's size: a bound, on a round surface about three times as large as what is lost
_THIN = 10.0  # times as long as a short side is a sliver
_FEW = 2000  # slivers of a mold that is left as it is
_MOST_ROUNDS = 60
_TURN = 0.5  # cosine of the angle by which a triangle may turn
_FLATTEST = 1e-6  # height over length of a triangle that is made


_Edges = tuple[Integers, Integers, Integers]
"""The edges of a mesh: ends (k, 2), the lower first; keys (k,), ascending; of how many triangles each is."""


def merge_slivers(vertices: Array, triangles: NDArray[np.integer]) -> tuple[Array, NDArray[np.int32], Integers]:
    """The surface with its slivers merged where that leaves it as it is; one of few slivers is not changed at all.

    Args:
        vertices: (n, 3) [m], of a welded mesh without degenerate triangles.
        triangles: Vertex numbers (m, 3).

    Returns:
        Vertices and triangles of the merged surface, and the number (m,) that each triangle had before.
    """
    places, left = np.asarray(vertices, float), np.asarray(triangles, np.int64)
    if not has_slivers(places, left):
        return places, left.astype(np.int32), np.arange(len(left))
    return collapse_short_sides(places, left)


def collapse_short_sides(places: Array, left: Integers) -> tuple[Array, NDArray[np.int32], Integers]:
    """The same of a surface that is known to have many slivers (see `has_slivers`)."""
    source, error = np.arange(len(left)), np.zeros(len(left))
    tolerance = _TOLERANCE * float(np.ptp(places[left], axis=(0, 1)).max())
    random, refused = np.random.default_rng(0), np.zeros(0, np.int64)
    for _ in range(_MOST_ROUNDS):
        edges = _edges(left, len(places))
        wanted, length = _wanted_collapses(places, left, edges, refused)
        if not len(wanted):
            break
        fits, total = _fitting(places, left, edges, wanted, error, tolerance)
        refused = np.union1d(refused, (wanted[:, 0] * len(places) + wanted[:, 1])[~fits])
        chosen = _independent(edges, wanted[fits], length[fits], len(places), random)
        moved, kept, chosen = _collapse(left, edges, chosen, len(places))
        vertex_error = np.full(len(places), -1.0)
        vertex_error[chosen[:, 0]] = total[chosen[:, 0]]
        error = np.maximum(error, vertex_error[left].max(1))[kept]
        left, source = moved[kept], source[kept]
    used, renumbered = np.unique(left, return_inverse=True)
    return places[used], renumbered.reshape(-1, 3).astype(np.int32), source


def has_slivers(vertices: Array, triangles: NDArray[np.integer]) -> bool:
    """True where a surface has so many slivers that they are merged."""
    return len(triangles) >= _FEW and int(np.count_nonzero(_short_sides(vertices[triangles]).any(1))) >= _FEW


def _short_sides(corners: Array) -> Mask:
    """Mask (n, 3) of the sides of triangles (n, 3, 3), from each corner to the next, that are short."""
    side = np.linalg.norm(np.roll(corners, -1, axis=1) - corners, axis=2)
    return _THIN * side < side.max(1, keepdims=True)


def _side_keys(triangles: Integers, count: int) -> Integers:
    """One integer for each side (3 n,) of triangles (n, 3) of so many vertices, the same for both senses."""
    following = np.roll(triangles, -1, axis=1)
    return (np.minimum(triangles, following) * count + np.maximum(triangles, following)).ravel()


def _edges(triangles: Integers, count: int) -> _Edges:
    key = np.sort(_side_keys(triangles, count))
    first = np.flatnonzero(np.diff(key, prepend=-1))
    key, times = key[first], np.diff(first, append=len(key))
    return np.stack([key // count, key % count], axis=1), key, times


def _wanted_collapses(places: Array, triangles: Integers, edges: _Edges, refused: Integers) -> tuple[Integers, Array]:
    """The shortest collapse of each vertex along a short side of a sliver, unless it was refused before.

    Returns:
        Vertices and the targets that they are moved to (k, 2), and the lengths of these ways (k,) [m].
    """
    count, (ends, edge_key, times) = len(places), edges
    key = _side_keys(triangles, count)
    short = np.zeros(len(edge_key), bool)
    short[np.searchsorted(edge_key, key[_short_sides(places[triangles]).ravel()])] = True
    rim = times == 1
    rims = np.bincount(ends[rim].ravel(), minlength=count)
    # On an open edge a vertex moves along it; where three walls meet, or two edges, none moves.
    held = (rims > 0) & (rims != 2)
    held[ends[times > 2]] = True
    way = np.concatenate([ends[short], ends[short][:, ::-1]])
    along = np.tile(rim[short], 2)
    way = way[~held[way[:, 0]] & (along | (rims[way[:, 0]] == 0))]
    way = way[~np.isin(way[:, 0] * count + way[:, 1], refused)]
    length = np.linalg.norm(places[way[:, 0]] - places[way[:, 1]], axis=1)
    order = np.lexsort((length, way[:, 0]))
    first = order[np.flatnonzero(np.diff(way[order, 0], prepend=-1))]
    return way[first], length[first]


def _fitting(
    places: Array, triangles: Integers, edges: _Edges, wanted: Integers, error: Array, tolerance: float
) -> tuple[Mask, Array]:
    """Mask (k,) of the wanted collapses that keep the surface in place, and the bound for each vertex (n,) [m]."""
    count = len(places)
    target = np.full(count, -1)
    target[wanted[:, 0]] = wanted[:, 1]
    row, corner = np.nonzero(target[triangles] >= 0)
    vertex = triangles[row, corner]
    goal, a, b = target[vertex], triangles[row, (corner + 1) % 3], triangles[row, (corner + 2) % 3]
    total = np.zeros(count)
    np.maximum.at(total, vertex, error[row])
    bad = ~_can_collapse(edges[1], (vertex, goal, a, b), count)
    stays = (goal != a) & (goal != b)
    row, vertex, goal, a, b = (each[stays] for each in (row, vertex, goal, a, b))
    away, turned = _deviations(places, (vertex, goal, a, b))
    bad[vertex[turned]] = True
    there = np.stack([places[goal], places[a], places[b]], axis=1)
    left_behind, beyond = np.full(count, np.inf), np.zeros(count)
    np.minimum.at(left_behind, vertex, np.where(turned, np.inf, point_triangle_distance(places[vertex], there)))
    np.maximum.at(beyond, vertex, away)
    beyond = np.maximum(beyond, _off_the_rim(places, edges, target))
    total += np.maximum(beyond, left_behind)
    return (~bad & (total <= tolerance))[wanted[:, 0]], total


def _deviations(places: Array, star: tuple[Integers, ...]) -> tuple[Array, Mask]:
    """The distances of targets from planes of triangles (vertex, target, a, b) [m]; a mask of what would turn."""
    vertex, goal, a, b = star
    before = np.cross(places[a] - places[vertex], places[b] - places[vertex])
    before /= np.linalg.norm(before, axis=1, keepdims=True)
    one, other = places[a] - places[goal], places[b] - places[goal]
    after = np.cross(one, other)
    area = np.linalg.norm(after, axis=1)
    longest = np.maximum(np.square(one).sum(1), np.square(other).sum(1))
    turned = (np.einsum("ij,ij->i", before, after) < _TURN * area) | (area <= _FLATTEST * longest)
    return np.abs(np.einsum("ij,ij->i", before, places[goal] - places[vertex])), turned


def _off_the_rim(places: Array, edges: _Edges, target: Integers) -> Array:
    """The distances (n,) [m] of an open edge's vertices from the edge after they have moved to their targets."""
    every, _, times = edges
    ends = every[times == 1]
    begin, end = np.concatenate([ends, ends[:, ::-1]]).T
    other = (target[begin] >= 0) & (target[begin] != end)
    begin, end = begin[other], end[other]
    away = np.zeros(len(places))
    np.maximum.at(away, begin, segment_distance(places[begin], places[end], places[target[begin]]))
    return away


def _can_collapse(edge_key: Integers, star: tuple[Integers, ...], count: int) -> Mask:
    """At which vertices (n,) the star (vertex, target, a, b) can be collapsed without folding the mesh onto itself.

    Vertex and target have no common neighbours but those across from their edge.
    """
    vertex, goal, a, b = star
    across = np.bincount(vertex[(goal == a) | (goal == b)], minlength=count)
    pair = np.unique(np.concatenate([vertex * count + a, vertex * count + b]))
    one, neighbour = pair // count, pair % count
    target = np.zeros(count, np.int64)
    target[vertex] = goal
    key = np.minimum(target[one], neighbour) * count + np.maximum(target[one], neighbour)
    at = np.minimum(np.searchsorted(edge_key, key), len(edge_key) - 1)
    common = np.bincount(one[edge_key[at] == key], minlength=count)
    return common == across


def _independent(edges: _Edges, some: Integers, length: Array, count: int, random: np.random.Generator) -> Integers:
    """Those of some collapses (k, 2) of lengths (k,) [m] none of whose vertices are neighbours, short ones first."""
    ends, rank = edges[0], np.full(count, np.inf)
    rank[some[:, 0]] = length * random.uniform(1.0, 2.0, len(some))
    chosen = np.zeros(count, bool)
    for _ in range(2):
        one, other = ends[np.isfinite(rank[ends]).all(1)].T
        first = np.isfinite(rank)
        first[np.where(rank[one] < rank[other], other, one)] = False
        chosen |= first
        # The neighbours of a chosen one are not chosen.
        rank[first] = np.inf
        rank[ends[first[ends].any(1)].ravel()] = np.inf
    return some[chosen[some[:, 0]]]


def _collapse(triangles: Integers, edges: _Edges, chosen: Integers, count: int) -> tuple[Integers, Mask, Integers]:
    """The triangles with vertices moved, which of them are kept (m,), and the collapses that were made."""
    _, key, times = edges
    walls = key[times > 2]
    while True:
        new = np.arange(count)
        new[chosen[:, 0]] = chosen[:, 1]
        moved = new[triangles]
        kept = (moved != np.roll(moved, 1, axis=1)).all(1)
        ends, key, times = _edges(moved[kept], count)
        # Two collapses side by side may make the same edge.
        doubled = ends[(times > 2) & ~np.isin(key, walls)]
        if not len(doubled):
            return moved, kept, chosen
        chosen = chosen[~np.isin(chosen[:, 1], doubled)]

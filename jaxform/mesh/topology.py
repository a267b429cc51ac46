"""Connectivity of triangle meshes: edges, boundary, orientation, connected parts; lists in rows. On the host."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

SHARPEST_FACETS = 30.0  # degrees: facets of a round surface turn by less from one to the next
HOLDING_FACETS = 10.001  # degrees: those at whose edges sides of elements are held turn by more; 36 in a circle do not


def edges(triangles: NDArray[np.integer]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """The edges of a mesh.

    Args:
        triangles: Node indices, shape (m, 3).

    Returns:
        The edges, smaller index first, sorted, without repeats, shape (k, 2); and the number of triangles on
        each, shape (k,).
    """
    return _count_pairs(np.sort(_sides(triangles), axis=1))


def boundary_edges(triangles: NDArray[np.integer]) -> NDArray[np.int64]:
    """Edges of one triangle only, smaller index first, sorted, shape (k, 2)."""
    edge, count = edges(triangles)
    return edge[count == 1]


def opposite_nodes(triangles: NDArray[np.integer]) -> NDArray[np.int64]:
    """The two nodes (n, 2) opposite to each side that two triangles share."""
    third = np.roll(triangles, 1, axis=1).astype(np.int64).ravel()
    key, _ = _keys(np.sort(_sides(triangles), axis=1))
    order = np.argsort(key, kind="stable")
    begin = np.flatnonzero(np.diff(key[order], prepend=-1))
    pair = begin[np.diff(begin, append=len(key)) == 2]
    return np.stack([third[order[pair]], third[order[pair + 1]]], axis=1)


def open_sides(triangles: NDArray[np.integer]) -> NDArray[np.int64]:
    """Sides (k, 2) of triangles, in their sense, that no neighbour's side in the opposite sense makes up for.

    Where neighbours agree, those of the boundary; a side is there as often as triangles too many have it.
    """
    side = _sides(triangles)
    key, base = _keys(np.sort(side, axis=1))
    sense = np.where(side[:, 0] < side[:, 1], 1.0, -1.0)
    edge, inverse = np.unique(key, return_inverse=True)
    net = np.round(np.bincount(inverse, sense)).astype(int)
    ends = np.stack([edge // base, edge % base], axis=1)
    return np.repeat(np.where(net[:, None] < 0, ends[:, ::-1], ends), np.abs(net), axis=0)


def boundary_nodes(triangles: NDArray[np.integer]) -> NDArray[np.int64]:
    """Indices of the nodes on edges of one triangle only, sorted, shape (k,)."""
    return np.unique(boundary_edges(triangles))


def is_closed(triangles: NDArray[np.integer]) -> bool:
    """True when there are triangles, and every edge has triangles on both sides."""
    return len(triangles) > 0 and len(boundary_edges(triangles)) == 0


def nonmanifold_edges(triangles: NDArray[np.integer]) -> NDArray[np.int64]:
    """Edges of more than two triangles, smaller index first, sorted, shape (k, 2)."""
    edge, count = edges(triangles)
    return edge[count > 2]


def inconsistent_edges(triangles: NDArray[np.integer]) -> NDArray[np.int64]:
    """Edges that two triangles run through in the same direction (their normals disagree), shape (k, 2)."""
    directed, count = _count_pairs(_sides(triangles))
    return _count_pairs(np.sort(directed[count > 1], axis=1))[0]


def orientations(triangles: NDArray[np.integer]) -> tuple[NDArray[np.int32], NDArray[np.int64]]:
    """Consistent orientations of the triangles, part by part.

    Returns:
        For each triangle the number of the part that edges of exactly two triangles hold together, and 1 or -1:
        triangles of one part with the same sign turn the same way round. Shape (m,) each.
    """
    count = len(triangles)
    side, owner = _sides(triangles), np.repeat(np.arange(count), 3)
    key, _ = _keys(np.sort(side, axis=1))
    order = np.argsort(key, kind="stable")
    begin = np.flatnonzero(np.diff(key[order], prepend=-1))
    pair = begin[np.diff(begin, append=len(key)) == 2]
    first, second = order[pair], order[pair + 1]
    # Neighbours agree when they run along their common edge in opposite directions.
    agree = side[first, 0] != side[second, 0]
    a, b = owner[first], owner[second]
    # A part of the doubled graph is one triangle's side together with the sides of others that go with it.
    link = np.where(agree, b, b + count), np.where(agree, b + count, b)
    rows, columns = np.concatenate([a, a + count]), np.concatenate(link)
    sheet, part = connected_parts(rows, columns, 2 * count), connected_parts(a, b, count)
    # The side that is in the same sheet as the part's first triangle.
    leader = np.unique(part, return_index=True)[1]
    return part, np.where(sheet[:count] == sheet[leader][part], 1, -1)


def feature_edges(
    vertices: NDArray[np.floating], triangles: NDArray[np.integer], angle: float = 20.0, *, rims: bool = True
) -> NDArray[np.floating]:
    """Edges (n, 2, 3) [m] of a surface at which it bends by more than the angle [degrees], or ends where rims count."""
    corners = vertices[triangles]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    length = np.linalg.norm(normal, axis=1, keepdims=True)
    normal /= np.where(length > 0, length, 1.0)
    sides = np.sort(_sides(triangles), axis=1)
    owner = np.repeat(np.arange(len(triangles)), 3)
    edge, count = _count_pairs(sides)
    order = np.argsort(_keys(sides)[0], kind="stable")
    first = np.cumsum(count) - count
    one, other = owner[order[first]], owner[order[first + np.minimum(count, 2) - 1]]
    bent = np.abs(np.sum(normal[one] * normal[other], axis=1)) < np.cos(np.deg2rad(angle))
    return vertices[edge[(count != 2) & rims | (count >= 2) & bent]]


def sharp_edges(
    vertices: NDArray[np.floating], triangles: NDArray[np.integer], angle: float = SHARPEST_FACETS
) -> NDArray[np.int32]:
    """The edges at which the surface turns by more than an angle, (4, n_edge).

    Of each the vertices at its ends, then the third vertex of either triangle. Edges of one triangle, as along the rim
    of an open mold, are not among them. One of more than two, as where bodies or a thin rib join, is convex to what is
    between two of them with none of the others, more than 180 degrees apart: it is among them with these two.

    Args:
        vertices: Vertices (n_vertex, 3) [m].
        triangles: Their numbers (n_triangle, 3), of either orientation.
        angle: The angle [degrees].
    """
    corners = np.asarray(vertices, float)
    faces = np.asarray(triangles, np.int64)
    begin, end, third = (np.roll(faces, -k, axis=1).ravel() for k in range(3))
    low, high = np.minimum(begin, end), np.maximum(begin, end)
    _, place, each = np.unique(low * (int(faces.max(initial=0)) + 1) + high, return_inverse=True, return_counts=True)
    order = np.argsort(place, kind="stable")
    first = np.concatenate([[0], np.cumsum(each)[:-1]])[each == 2].astype(np.int64)
    one, other = order[first], order[first + 1]
    found = np.stack([low[one], high[one], third[one], third[other]])
    ways = [_ways_across(corners, found[0], found[1], others) for others in found[2:]]
    sharp = found[:, -np.einsum("ij,ij->i", *ways) < np.cos(np.radians(angle))]
    several = order[each[place[order]] > 2]
    if not len(several):
        return sharp.astype(np.int32)
    fans = np.stack([low, high, third])[:, several]
    return np.concatenate([sharp, _convex_pairs(corners, fans, place[several], angle)], axis=1).astype(np.int32)


def _ways_across(corners: NDArray[np.floating], begin: Any, end: Any, third: Any) -> NDArray[np.floating]:
    """Unit vectors (n, 3) in triangles away from their edges: opposite to each other where a surface is flat."""
    along = corners[end] - corners[begin]
    along /= np.maximum(np.linalg.norm(along, axis=1), 1e-300)[:, None]
    way = corners[third] - corners[begin]
    way -= np.einsum("ij,ij->i", way, along)[:, None] * along
    return way / np.maximum(np.linalg.norm(way, axis=1), 1e-300)[:, None]


def _convex_pairs(
    corners: NDArray[np.floating], fans: NDArray[np.int64], edge: NDArray[np.int64], angle: float
) -> NDArray[np.int64]:
    """The edges of several triangles (4, k) of which two neighbours around the edge are more than 180 degrees apart.

    Args:
        corners: Vertices (n_vertex, 3) [m].
        fans: Both ends of the edge and the third vertex of each such triangle (3, n), edge by edge.
        edge: The number of its edge (n,).
        angle: By how much more [degrees].
    """
    way, first = _ways_across(corners, fans[0], fans[1], fans[2]), np.searchsorted(edge, edge)
    along = corners[fans[1]] - corners[fans[0]]
    upright = np.cross(along / np.maximum(np.linalg.norm(along, axis=1), 1e-300)[:, None], way[first])
    turn = np.arctan2(np.einsum("ij,ij->i", way, upright), np.einsum("ij,ij->i", way, way[first])) % (2.0 * np.pi)
    order = np.lexsort((turn, edge))
    fans, turn, number = fans[:, order], turn[order], np.arange(len(edge))
    last = np.append(np.diff(edge) > 0, True)
    following = np.where(last, first, number + 1)  # around the edge
    gap = turn[following] - turn + np.where(last, 2.0 * np.pi, 0.0)
    chosen = np.flatnonzero(gap - np.pi > np.radians(angle))
    return np.concatenate([fans[:, chosen], fans[2:, following[chosen]]])


def smooth_parts(vertices: NDArray[np.floating], triangles: NDArray[np.integer]) -> NDArray[np.int32]:
    """The number of the part between `sharp_edges` that each triangle belongs to (n_triangle,), from 0."""
    side, base = np.sort(_sides(triangles), axis=1), int(np.max(triangles, initial=0)) + 1
    key, sharp = side @ [base, 1], np.sort(sharp_edges(vertices, triangles)[:2].T.astype(np.int64), axis=1) @ [base, 1]
    order = np.argsort(key, kind="stable")
    order = order[~np.isin(key[order], sharp)]
    joined = key[order[1:]] == key[order[:-1]]
    return connected_parts(order[1:][joined] // 3, order[:-1][joined] // 3, len(triangles))


def edge_paths(edges: NDArray[np.integer], stops: NDArray[np.integer] | None = None) -> list[list[int]]:
    """Paths (k,) through the vertices of edges (n, 2): each edge is part of one.

    A path ends where other than two edges meet, and at the stops (m,); a closed one ends with its first vertex.
    """
    neighbours: dict[int, list[int]] = {}
    for a, b in np.asarray(edges).tolist():
        neighbours.setdefault(a, []).append(b)
        neighbours.setdefault(b, []).append(a)
    ends = {vertex for vertex, near in neighbours.items() if len(near) != 2}
    ends |= set(() if stops is None else np.asarray(stops).tolist())
    paths = []
    # Closed paths without an end are left for the last.
    for start in [*(vertex for vertex in neighbours if vertex in ends), *neighbours]:
        while neighbours[start]:
            path = [start]
            while neighbours[path[-1]] and (len(path) == 1 or path[-1] not in ends):
                ahead = neighbours[path[-1]].pop()
                neighbours[ahead].remove(path[-1])
                path.append(ahead)
            paths.append(path)
    return paths


def edge_points(edges: NDArray[np.floating], step: float) -> NDArray[np.floating]:
    """Points (k, 3) [m] along edges (n, 2, 3) [m], two in a step or more, both ends included."""
    count = np.ceil(2 * np.linalg.norm(edges[:, 1] - edges[:, 0], axis=1) / step).astype(int) + 1
    # An edge without length has both its ends as well.
    count = np.maximum(count, 2)
    owner = np.repeat(np.arange(len(edges)), count)
    share = ((np.arange(len(owner)) - (np.cumsum(count) - count)[owner]) / (count[owner] - 1))[:, None]
    return (1 - share) * edges[owner, 0] + share * edges[owner, 1]


def open_rims(triangles: NDArray[np.integer], node_count: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Edges (k, 2) of one triangle only, and the number (k,) of the open rim of which each is a part, from 0."""
    edge = boundary_edges(triangles)
    part = connected_parts(edge[:, 0], edge[:, 1], node_count)[edge[:, 0]]
    return edge, np.unique(part, return_inverse=True)[1]


def components(triangles: NDArray[np.integer], node_count: int) -> NDArray[np.int32]:
    """Number of the connected part that each of `node_count` nodes belongs to, shape (n,)."""
    side = _sides(triangles)
    return connected_parts(side[:, 0], side[:, 1], node_count)


def connected_parts(one: NDArray[np.integer], other: NDArray[np.integer], count: int) -> NDArray[np.int32]:
    """Number of the part that each of `count` things belongs to, shape (n,), where pairs of them are connected."""
    # Most runs need none of this part of SciPy, which takes a tenth of a second to import.
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    graph = coo_array((np.ones(len(one), bool), (one, other)), shape=(count, count))
    return connected_components(graph, directed=False)[1]


def count_handles(triangles: NDArray[np.integer]) -> int:
    """The number of handles, or holes through it, of a connected orientable surface, open or closed: its genus."""
    nodes, count = len(np.unique(triangles)), int(np.max(triangles)) + 1
    rims = len(np.unique(open_rims(triangles, count)[1]))
    return (2 - rims - (nodes - len(edges(triangles)[0]) + len(triangles))) // 2


def _sides(triangles: NDArray[np.integer]) -> NDArray[np.int64]:
    return np.asarray(triangles, dtype=np.int64).reshape(-1, 3)[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)


def _count_pairs(pairs: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    keys, base = _keys(pairs)
    key, count = np.unique(keys, return_counts=True)
    return np.stack([key // base, key % base], axis=1), count


def _keys(pairs: NDArray[np.int64]) -> tuple[NDArray[np.int64], int]:
    """One integer per pair, which sorts many times faster than rows do; and by what the first is multiplied."""
    base = int(pairs.max(initial=0)) + 1
    return pairs[:, 0] * base + pairs[:, 1], base


# Cutting a mesh along a line.

_SNAP, _SNAP_CORNER = 0.3, 0.05  # of an edge: nodes that are as near to the line, and corners of the rim, move onto it
_CORNER = 0.8  # cosine of the angle between sides of a rim, below which they meet in a corner
_ON_LINE = 1e-9  # of the mesh's size
_FLAT = 0.05  # of its area, that a triangle keeps at least as nodes move
_BISECTIONS = 50

Level = Callable[[NDArray[np.float64]], NDArray[np.float64]]
"""A number (n,) of places (n, 3) [m], which is 0 on a line."""


def cut_along(
    positions: NDArray[np.float64], triangles: NDArray[np.integer], level: Level
) -> tuple[NDArray[np.float64], NDArray[np.int64], NDArray[np.int64]]:
    """A mesh with edges along the line on which a level is 0: near nodes move onto it, and other edges are cut there.

    Nodes of the rim move along it, so that it stays where it is but for corners that are very near to the line.

    Returns:
        Positions (n, 3), those of the mesh first; triangles (m, 3); and the ends (k, 2) of the edges with new nodes.
    """
    places = positions.copy()
    height, ends = level(places), edges(triangles)[0]
    height[np.abs(height) <= _ON_LINE * np.ptp(places, axis=0).max()] = 0.0
    crossing = ends[height[ends[:, 0]] * height[ends[:, 1]] < 0.0]
    if not len(crossing):
        return places, np.asarray(triangles, np.int64), crossing
    share, points = _crossings(places, crossing, level)
    moved = _snap(places, triangles, crossing, share, points)
    places[moved >= 0], height[moved >= 0] = points[moved[moved >= 0]], 0.0
    left = np.flatnonzero(height[crossing[:, 0]] * height[crossing[:, 1]] < 0.0)
    return *split_edges(places, triangles, crossing[left], points[left]), crossing[left]


def _crossings(
    positions: NDArray[np.float64], ends: NDArray[np.int64], level: Level
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Places (n, 3) where edges (n, 2) cross the line, after the share (n,) of their length before these."""
    begin, way = positions[ends[:, 0]], positions[ends[:, 1]] - positions[ends[:, 0]]
    sign, low, high = np.sign(level(begin)), np.zeros(len(ends)), np.ones(len(ends))
    for _ in range(_BISECTIONS):
        middle = 0.5 * (low + high)
        before = np.sign(level(begin + middle[:, None] * way)) == sign
        low, high = np.where(before, middle, low), np.where(before, high, middle)
    return high, begin + high[:, None] * way


def _snap(
    positions: NDArray[np.float64],
    triangles: NDArray[np.integer],
    crossing: NDArray[np.int64],
    share: NDArray[np.float64],
    points: NDArray[np.float64],
) -> NDArray[np.int64]:
    """The number of the crossing edge (n_node,) along which each node moves onto the line; -1 where it does not."""
    rim, corner = _rim_corners(positions, triangles)
    on_rim = np.isin(np.sort(crossing, axis=1) @ [len(positions), 1], np.sort(rim, axis=1) @ [len(positions), 1])
    node = np.where(share < 0.5, crossing[:, 0], crossing[:, 1])
    near = np.minimum(share, 1.0 - share)
    inner = ~np.isin(node, rim)
    wanted = np.flatnonzero((near < np.where(corner[node], _SNAP_CORNER, _SNAP)) & (inner | on_rim))
    moved = np.full(len(positions), -1)
    wanted = wanted[np.argsort(-near[wanted], kind="stable")]
    moved[node[wanted]] = wanted  # the nearest comes last
    before = doubled_normals(positions, triangles)
    while (moved >= 0).any():
        there = np.where((moved >= 0)[:, None], points[moved], positions)
        after = np.einsum("ni,ni->n", doubled_normals(there, triangles), before)
        bad = after < _FLAT * np.einsum("ni,ni->n", before, before)
        stays = triangles[bad][moved[triangles[bad]] >= 0]
        if not len(stays):
            break
        moved[stays] = -1
    return moved


def doubled_normals(positions: NDArray[np.float64], triangles: NDArray[np.integer]) -> NDArray[np.float64]:
    """Normals of triangles (n, 3), each twice its area long (n, 3) [m^2], from positions (n_node, 3) [m]."""
    corners = positions[triangles]
    return np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])


def _rim_corners(
    positions: NDArray[np.float64], triangles: NDArray[np.integer]
) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
    """Ends (n, 2) of the rim's edges, and the nodes (n_node,) at which it has a corner."""
    rim = open_sides(triangles)
    way = positions[rim[:, 1]] - positions[rim[:, 0]]
    way /= np.linalg.norm(way, axis=1, keepdims=True)
    into, out = np.zeros_like(positions), np.zeros_like(positions)
    into[rim[:, 1]], out[rim[:, 0]] = way, way
    corner = np.zeros(len(positions), bool)
    corner[rim[:, 0]] = np.einsum("ni,ni->n", into, out)[rim[:, 0]] < _CORNER
    return rim, corner


def split_edges(
    positions: NDArray[np.float64],
    triangles: NDArray[np.integer],
    ends: NDArray[np.int64],
    points: NDArray[np.float64],
) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """The mesh with edges (k, 2) cut at points (k, 3), which come after its nodes."""
    middle = {(int(min(pair)), int(max(pair))): len(positions) + k for k, pair in enumerate(ends)}
    cut = []
    for triangle in np.asarray(triangles).tolist():
        a, b, c = triangle
        cut += split_triangle(triangle, [middle.get((min(pair), max(pair))) for pair in ((a, b), (b, c), (c, a))])
    return np.concatenate([positions, points]), np.array(cut, np.int64).reshape(-1, 3)


def split_triangle(triangle: list[int], middles: list[int | None]) -> list[list[int]]:
    """A triangle cut at the middles of its sides, the first of which starts at its first corner."""
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


# Rows of an array without repeats, as `numpy.unique` gives them but many times as fast, and of lists.


def positions_in_rows(counts: NDArray[np.integer]) -> NDArray[np.int64]:
    """0, 1, ... up to each count (n,), one after the other: the places of entries in their rows."""
    return np.arange(int(counts.sum())) - np.repeat(np.cumsum(counts) - counts, counts)


def unique_ascending(numbers: NDArray[np.int64]) -> NDArray[np.int64]:
    """Each of some numbers (n,) once, ascending; NumPy's `unique` takes many times as long."""
    found = np.sort(numbers)
    first = np.ones(len(found), bool)
    first[1:] = found[1:] != found[:-1]
    return found[first]


def distinct_rows(rows: NDArray[Any]) -> tuple[NDArray[Any], NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]:
    """The distinct ones of rows (n, c) of numbers, sorted by their first column, then by the next.

    Returns:
        As `numpy.unique`: each row once (k, c); the index of its first occurrence (k,); the index among them of each
        row of the array (n,); the number of occurrences (k,).
    """
    order = np.lexsort(rows.T[::-1])
    ordered = rows[order]
    fresh = np.ones(len(rows), bool)
    fresh[1:] = (ordered[1:] != ordered[:-1]).any(1)
    inverse = np.empty(len(rows), np.int64)
    inverse[order] = np.cumsum(fresh) - 1
    begin = np.flatnonzero(fresh)
    return ordered[begin], order[begin], inverse, np.diff(begin, append=len(rows))

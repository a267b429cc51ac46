"""Connectivity of triangle meshes: edges, boundary, orientation, connected parts. On the host."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

SHARPEST_FACETS = 30.0  # degrees: facets of a round surface turn by less from one to the next


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


def sharp_edges(vertices: NDArray[np.floating], triangles: NDArray[np.integer]) -> NDArray[np.int32]:
    """The edges at which the surface turns by more than the limit, (4, n_edge).

    Of each the vertices at its ends, then the third vertex of either triangle. Edges of one triangle, as along the rim
    of an open mold, and of more than two are not among them.

    Args:
        vertices: Vertices (n_vertex, 3) [m].
        triangles: Their numbers (n_triangle, 3), of either orientation.
    """
    corners = np.asarray(vertices, float)
    faces = np.asarray(triangles, np.int64)
    begin, end, third = (np.roll(faces, -k, axis=1).ravel() for k in range(3))
    low, high = np.minimum(begin, end), np.maximum(begin, end)
    _, place, each = np.unique(low * (int(faces.max(initial=0)) + 1) + high, return_inverse=True, return_counts=True)
    order = np.argsort(place, kind="stable")
    first = np.concatenate([[0], np.cumsum(each)[:-1]])[each == 2].astype(np.int64)
    one, other = order[first], order[first + 1]
    a, b = low[one], high[one]
    found = np.stack([a, b, third[one], third[other]])
    along = corners[b] - corners[a]
    along /= np.maximum(np.linalg.norm(along, axis=1), 1e-300)[:, None]
    # The faces' directions away from the edge: opposite to each other where the surface is flat.
    ways = [corners[c] - corners[a] for c in found[2:]]
    ways = [way - np.einsum("ij,ij->i", way, along)[:, None] * along for way in ways]
    sizes = [np.maximum(np.linalg.norm(way, axis=1), 1e-300) for way in ways]
    cosine = -np.einsum("ij,ij->i", *ways) / (sizes[0] * sizes[1])
    return found[:, cosine < np.cos(np.radians(SHARPEST_FACETS))].astype(np.int32)


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

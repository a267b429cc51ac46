"""Connectivity of a parison's mesh: parts, rims, and seams whose nodes are not merged. On the host."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from jaxform.core.errors import format_place, warn_of
from jaxform.mesh import topology
from jaxform.model.scene import Parison

Array = NDArray[np.float64]
Index = NDArray[np.int64]

_NEAR = 0.15  # of a rim edge's length: a node as near as that belongs on it, as the two sides of a curved seam show
_SLOPE = 0.35  # of the way from the nearer end: a node as near as that is no neighbour round a corner
_SAME = 0.1  # of the shortest rim edge there: two nodes as near as that are meant to be one
_MOST_EDGES = 50_000  # rim edges that are checked; a mesh with more of them is not joined anywhere
_ONE_WAY = 0.5  # of a part's area, its projection, from which the part faces one direction


class MeshConnectivity(NamedTuple):
    """The connectivity of a mesh.

    Attributes:
        part: Number of the part of each triangle (n_triangle,); edges hold a part together.
        part_count: Number of parts.
        rims: Number of connected rims, cuts by symmetry planes left out.
        loose: Rim nodes (k,) that lie on a rim that they are not joined to.
        pinched: Nodes (k,) in which alone some elements meet others.
        opposed: A triangle in each part that faces the opposite of the largest one (k,).
    """

    part: Index
    part_count: int
    rims: int
    loose: Index
    pinched: Index
    opposed: Index


def find_connectivity(positions: Array, triangles: NDArray[np.integer], fixed: NDArray[np.bool_]) -> MeshConnectivity:
    """Finds the parts, rims, loose and pinched nodes of a mesh.

    Args:
        positions: Node positions (n_node, 3) [m].
        triangles: Node numbers (n_element, 3).
        fixed: Components that symmetry planes hold (n_node, 3).
    """
    triangles = np.asarray(triangles, np.int64)
    count, node = len(triangles), triangles.ravel()
    one, other, alone = _pair_sides(triangles)
    part = topology.connected_parts(one // 3, other // 3, count).astype(np.int64)
    end = triangles[:, [1, 2, 0]].ravel()
    on_cut = (fixed[node[alone]] & fixed[end[alone]]).any(1)
    alone = alone[~on_cut]
    rim = np.stack([node[alone], end[alone]], axis=1)
    on_rim, numbered = np.unique(rim, return_inverse=True)
    numbered = numbered.reshape(-1, 2)
    rims = len(np.unique(topology.connected_parts(numbered[:, 0], numbered[:, 1], len(on_rim)))) if len(rim) else 0
    return MeshConnectivity(
        part,
        int(part.max(initial=-1)) + 1,
        rims,
        _loose_nodes(positions, triangles, alone, on_rim),
        _pinched_nodes(triangles, one, other, len(positions)),
        _opposed_triangles(positions, triangles, part),
    )


def parison_connectivity(parison: Parison) -> MeshConnectivity:
    """The connectivity of a parison's mesh, before it is refined."""
    positions = np.asarray(parison.positions, float)
    return find_connectivity(positions, np.asarray(parison.triangles), np.asarray(parison.fixed))


def warn_of_connectivity(parison: Parison, file: str, key: str, value: str) -> None:
    """Warns of parts that may not be joined as intended, with places and numbers; names file, key and value."""
    found = parison_connectivity(parison)
    positions, clamped = np.asarray(parison.positions, float), np.asarray(parison.clamped)
    where: dict[str, Any] = {"file": file, "key": key, "value": value}
    if len(found.loose):
        held = int(clamped[found.loose].sum())
        nodes = f"{_format_count(len(found.loose), 'rim node')} on another rim without being joined to it"
        warn_of(
            f"{nodes}, the first at {format_place(positions[found.loose[0]])}: these seams are open, with {held} of "
            "the nodes clamped",
            "mesh both sides of a seam with the same nodes",
            **where,
        )
    elif len(found.pinched):
        # Along an open seam, the nodes that both sides do share are such places too.
        warn_of(
            f"elements meet in a single node at {_format_count(len(found.pinched), 'place')}, the first at "
            f"{format_place(positions[found.pinched[0]])}",
            "join them along edges, or separate them",
            **where,
        )
    if found.part_count > 1:
        warn_of(
            f"has {found.part_count} parts that share no edge",
            "join them if they are one sheet; `jaxform check` draws them",
            **where,
        )
    if len(found.opposed):
        middle = positions[np.asarray(parison.triangles)[found.opposed[0]]].mean(0)
        warn_of(
            f"the pressure pushes {_format_count(len(found.opposed), 'part')}, the first at {format_place(middle)}, "
            "the opposite way to the largest",
            "reverse the orientation of these parts",
            **where,
        )


def _format_count(count: int, thing: str) -> str:
    return f"{count} {thing}" if count == 1 else f"{count} {thing}s"


def _pair_sides(triangles: Index) -> tuple[Index, Index, Index]:
    """Sides that two triangles share, one and the other, and those of one triangle alone; 3 triangle + corner each."""
    node, end = triangles.ravel(), triangles[:, [1, 2, 0]].ravel()
    key = np.minimum(node, end) * (int(node.max(initial=0)) + 1) + np.maximum(node, end)
    order = np.argsort(key, kind="stable")
    first = np.flatnonzero(np.diff(key[order], prepend=-1))
    many = np.diff(first, append=len(key))
    pair = first[many == 2]
    return order[pair], order[pair + 1], np.sort(order[first[many == 1]])


def _pinched_nodes(triangles: Index, one: Index, other: Index, node_count: int) -> Index:
    """Nodes (k,) around which the elements make more than one fan."""

    def end(side: Index) -> Index:
        return side - side % 3 + (side % 3 + 1) % 3

    # Corners of neighbours at the same node belong to one fan; the neighbours run along their common side in
    # opposite directions.
    rows, columns = np.concatenate([one, end(one)]), np.concatenate([end(other), other])
    fan = topology.connected_parts(rows, columns, triangles.size)
    some = np.unique(fan, return_index=True)[1]
    return np.flatnonzero(np.bincount(triangles.ravel()[some], minlength=node_count) > 1)


def _loose_nodes(positions: Array, triangles: Index, alone: Index, on_rim: Index) -> Index:
    """Rim nodes (k,) that lie on a rim edge, or at a rim node, that they are not joined to."""
    if not len(alone):
        return on_rim[:0]
    from scipy.spatial import KDTree  # takes a tenth of a second to import

    begin, end = triangles.ravel(), triangles[:, [1, 2, 0]].ravel()
    shortest = np.full(len(positions), np.inf)
    length = np.linalg.norm(positions[end[alone]] - positions[begin[alone]], axis=1)
    for ends in (begin, end):
        np.minimum.at(shortest, ends[alone], length)
    alone, length = alone[:_MOST_EDGES], length[:_MOST_EDGES]
    a, b = begin[alone], end[alone]
    near = KDTree(positions[on_rim]).query_ball_point(0.5 * (positions[a] + positions[b]), 0.66 * length, workers=-1)
    edge = np.repeat(np.arange(len(alone)), [len(found) for found in near])
    node = on_rim[np.concatenate([np.asarray(found, np.int64) for found in near])]
    # The ends of the edge, and the third node of its triangle, are joined to it.
    apart = (node[:, None] != triangles[alone[edge] // 3]).all(1)
    edge, node = edge[apart], node[apart]
    along, away = positions[b[edge]] - positions[a[edge]], positions[node] - positions[a[edge]]
    size = length[edge]
    share = np.einsum("ij,ij->i", along, away) / size**2
    off = np.linalg.norm(away - share[:, None] * along, axis=1)
    nearer = np.where(share < 0.5, a[edge], b[edge])
    gap = np.linalg.norm(positions[node] - positions[nearer], axis=1)
    same = gap <= _SAME * np.minimum(shortest[node], shortest[nearer])
    inside = (off <= _NEAR * size) & (off <= _SLOPE * size * np.minimum(share, 1 - share))
    joined = _share_edge(node, nearer, triangles, len(positions))
    return np.unique(node[inside | (same & ~joined)])


def _share_edge(one: Index, other: Index, triangles: Index, node_count: int) -> NDArray[np.bool_]:
    """True where pairs of nodes (n,) are the ends of one edge."""
    begin, end = triangles.ravel(), triangles[:, [1, 2, 0]].ravel()
    wanted = np.isin(begin, one)
    keys = np.concatenate([begin[wanted] * node_count + end[wanted], end[wanted] * node_count + begin[wanted]])
    back = np.isin(end, one)
    keys = np.concatenate([keys, begin[back] * node_count + end[back], end[back] * node_count + begin[back]])
    return np.isin(one * node_count + other, keys)


def _opposed_triangles(positions: Array, triangles: Index, part: Index) -> Index:
    """A triangle of each part (k,) that faces the opposite of the largest part, and not away from it on both sides."""
    count = int(part.max(initial=-1)) + 1
    if count < 2:
        return part[:0]
    corners = positions[triangles]
    normal = 0.5 * np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = np.linalg.norm(normal, axis=1)
    middle = corners.mean(1)

    def sums(values: Array) -> Array:
        return np.stack([np.bincount(part, column, count) for column in np.atleast_2d(values.T)], axis=-1)

    whole = sums(area)[:, 0]
    center, facing = sums(area[:, None] * middle) / whole[:, None], sums(normal) / whole[:, None]
    largest = int(np.argmax(whole))
    volume = sums(np.einsum("ij,ij->i", normal, middle - center[part]))[:, 0]
    apart = center - center[largest]
    outward = np.einsum("ij,ij->i", apart, facing), -apart @ facing[largest]
    # Two halves of a closed parison face opposite ways, each away from the other, or each towards it.
    halves = (outward[0] * outward[1] > 0) & (
        np.minimum(*map(np.abs, outward)) > 0.1 * np.linalg.norm(apart, axis=1) * _ONE_WAY
    )
    against = (facing @ facing[largest] < -(_ONE_WAY**2)) & ~halves
    rounded = np.linalg.norm(facing, axis=1) < 1e-6
    against |= rounded & rounded[largest] & (volume * volume[largest] < 0)
    return np.unique(part, return_index=True)[1][against]

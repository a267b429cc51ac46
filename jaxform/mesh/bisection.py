"""The forest: every triangle of a parison's mesh bisected beforehand, down to a deepest level. On the host.

Newest-vertex bisection: a triangle (peak, a, b) is halved from its peak to the middle m of the opposite edge, which is
its refinement edge, into (m, peak, a) and (m, b, peak). The first triangles' edges are their longest ones. Refining is
then nothing but marking triangles as bisected, and everything a mark can ask for is known before a run.

Triangles are numbered level by level; those of level l start at roots * (2**l - 1), and the children of the i-th there
are the (2 i)-th and the (2 i + 1)-th of the next.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from jaxform.core.errors import InputError
from jaxform.mesh import topology
from jaxform.mesh.topology import positions_in_rows

Array = NDArray[np.float64]
Integers = NDArray[np.int32]
_MOST_TRIANGLES = 4_000_000
Snap = Callable[[Array, Array, NDArray[np.bool_]], Array]


@dataclasses.dataclass(frozen=True)
class TriangleForest:
    """Triangles and nodes of all levels.

    Attributes:
        root_count: Triangles at level 0.
        depth: The deepest level; even, so that no mark ever requires more (see `even_depth`).
        positions: Node positions (n_node, 3) [m]; those of the mesh come first.
        triangles: Node numbers (n_triangle, 3), the peak first.
        partner: The other triangle (n_triangle,) with the same refinement edge; itself where there is none.
        middle: Node in the middle of the refinement edge (n_triangle,); -1 at the deepest level.
        half_edges: Numbers of the sides from each corner to the next (n_triangle, 3): two neighbours have 2 k, 2 k + 1.
        corner_slots: Slots of the corners (n_triangle, 3); triangles that do not overlap have different ones at a node.
        ends: End nodes (n_node, 2) of the edge of which a node is the middle; the node twice for those of the mesh.
        clamped: Nodes that never move (n_node,).
        fixed: Components that never move (n_node, 3).
    """

    root_count: int
    depth: int
    positions: Array
    triangles: Integers
    partner: Integers
    middle: Integers
    half_edges: Integers
    corner_slots: Integers
    ends: Integers
    clamped: NDArray[np.bool_]
    fixed: NDArray[np.bool_]

    def level(self) -> Integers:
        """The level of each triangle (n_triangle,)."""
        return np.repeat(np.arange(self.depth + 1), self.root_count << np.arange(self.depth + 1)).astype(np.int32)

    def inherit(self, roots: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """Values (..., n_triangle) of all triangles, which have those of the first ones (..., n_root)."""
        return np.concatenate([np.repeat(roots, 1 << level, axis=-1) for level in range(self.depth + 1)], axis=-1)


def number_regions(regions: NDArray[np.bool_]) -> NDArray[np.int64]:
    """A number (n_root,) for each set of regions that triangles belong to, from their masks (n_region, n_root)."""
    return np.unique(regions, axis=1, return_inverse=True)[1].reshape(-1)


def extend_values(values: NDArray[np.floating], ends: NDArray[np.integer], depth: int) -> NDArray[np.floating]:
    """Values at all nodes (n_node, ...) from those at the mesh's: new nodes have the mean of their ends (n_node, 2)."""
    count, whole = len(values), np.zeros((len(ends), *values.shape[1:]))
    whole[:count] = values
    for _ in range(depth):  # a new node can be the end of a newer one's edge
        whole[count:] = whole[ends[count:]].mean(1)
    return whole


def even_depth(level: int) -> int:
    """The depth of a forest in which triangles up to a level can be requested: closure never needs an odd one more."""
    return level + level % 2


def build_forest(
    positions: Array,
    triangles: NDArray[np.integer],
    depth: int,
    *,
    clamped: NDArray[np.bool_] | None = None,
    fixed: NDArray[np.bool_] | None = None,
    snap: Snap | None = None,
    region: NDArray[np.integer] | None = None,
) -> TriangleForest:
    """Bisects a conforming mesh of consistently oriented triangles.

    Args:
        positions: Node positions (n_node, 3) [m].
        triangles: Node numbers (n_root, 3).
        depth: The deepest level, even.
        clamped: Nodes that never move; none by default.
        fixed: Components (n_node, 3) that never move; none by default.
        snap: Puts the middles (n, 3) of edges with ends (n, 2, 3) [m] on the true surface, told which (n,) are on the
            mesh's boundary; none by default.
        region: Number of each triangle's region (n_root,): a side between two regions whose ends are clamped does not
            move. One region by default.

    Raises:
        InputError: If an edge has more than two triangles, or two neighbours turn opposite ways.
    """
    count = len(triangles) << (depth + 1)
    if count > _MOST_TRIANGLES:
        problem = f"the mesh bisected in advance would have {count} triangles"
        raise InputError(problem, "lower it, or start with fewer elements", "refinement.max_level", depth)
    for bad, problem in (
        (topology.nonmanifold_edges(triangles), "an edge of more than two triangles cannot be refined"),
        (topology.inconsistent_edges(triangles), "neighbours of opposite orientation cannot be refined"),
    ):
        if len(bad):
            raise InputError(problem, "correct the mesh or leave [refinement] out", "parison", bad[0].tolist())
    count = len(positions)
    immobile = np.zeros(count, bool) if clamped is None else np.asarray(clamped, bool)
    nodes: _NodeTable = (
        np.asarray(positions, float),
        np.repeat(np.arange(count), 2).reshape(-1, 2),
        immobile,
        np.zeros((count, 3), bool) if fixed is None else np.asarray(fixed, bool),
    )
    level = _rotate_longest_first(nodes[0], np.asarray(triangles, np.int64))
    slots = _root_slots(level, count)
    held = immobile[level].all(1)  # a triangle that cannot move at all stays so in its parts
    rim = _rim(level)
    still = _fixed_sides(level, rim, held, immobile, region)
    levels, middles, all_slots = [level], [], [slots]
    for _ in range(depth):
        node, nodes = _add_middle_nodes(nodes, level[:, 1:], rim[:, 1], still[:, 1], snap)
        peak, a, b = level.T
        second = a > b  # its neighbour across the refinement edge runs along it the other way
        level = np.stack([np.stack([node, peak, a], 1), np.stack([node, b, peak], 1)], 1).reshape(-1, 3)
        rim, still = _child_sides(rim, np.zeros_like(held)), _child_sides(still, held)
        slots, held = _child_slots(slots, second), np.repeat(held, 2)
        levels.append(level)
        middles.append(node)
        all_slots.append(slots)
    node_positions, ends, node_clamped, node_fixed = nodes
    whole = np.concatenate(levels)
    middle = np.concatenate([*middles, np.full(len(level), -1)])
    return TriangleForest(
        root_count=len(triangles),
        depth=depth,
        positions=node_positions,
        triangles=whole.astype(np.int32),
        partner=_partners(middle),
        middle=middle.astype(np.int32),
        half_edges=_half_edges(whole),
        corner_slots=np.concatenate(all_slots).astype(np.int32),
        ends=ends.astype(np.int32),
        clamped=node_clamped,
        fixed=node_fixed,
    )


_NodeTable = tuple[Array, NDArray[np.int64], NDArray[np.bool_], NDArray[np.bool_]]
"""The nodes so far: `positions`, `ends`, `clamped` and `fixed` of `TriangleForest`."""


def _rim(triangles: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Mask (n, 3) of the sides, from each corner to the next, that have no neighbour."""
    half = _half_edges(triangles)
    return ~np.isin(half ^ 1, half)


def _fixed_sides(
    triangles: NDArray[np.int64],
    rim: NDArray[np.bool_],
    held: NDArray[np.bool_],
    clamped: NDArray[np.bool_],
    region: NDArray[np.integer] | None,
) -> NDArray[np.bool_]:
    """Sides (n, 3) that do not move: of a triangle that cannot, or of a rim or a border of regions that does not."""
    side = _half_edges(triangles) >> 1
    still = np.zeros(int(side.max(initial=0)) + 1, bool)
    still[side[held]] = True
    ends = clamped[triangles] & clamped[np.roll(triangles, -1, axis=1)]
    return still[side] | (rim if region is None else rim | _border_sides(side, region)) & ends


def _border_sides(side: NDArray[np.int32], region: NDArray[np.integer]) -> NDArray[np.bool_]:
    """Mask (n, 3) of the sides, by number, between triangles (n,) of different regions."""
    count = int(side.max(initial=0)) + 1
    low, high = np.full(count, np.iinfo(np.int64).max), np.full(count, np.iinfo(np.int64).min)
    np.minimum.at(low, side, region[:, None])
    np.maximum.at(high, side, region[:, None])
    return (low < high)[side]


def _child_sides(sides: NDArray[np.bool_], cut: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """The sides' mask of both children (2 n, 3): (m, p, a) has m-p, p-a and a-m, (m, b, p) has m-b, b-p and p-m."""
    begin, middle, end = sides.T
    return np.stack([np.stack([cut, begin, middle], 1), np.stack([middle, end, cut], 1)], 1).reshape(-1, 3)


def _add_middle_nodes(
    nodes: _NodeTable,
    edges: NDArray[np.int64],
    rim: NDArray[np.bool_],
    still: NDArray[np.bool_],
    snap: Snap | None,
) -> tuple[NDArray[np.int64], _NodeTable]:
    """The nodes in the middle of edges (n, 2), and all nodes with those that are new."""
    known_positions, known_ends, known_clamped, known_fixed = nodes
    count = len(known_positions)
    known, key = _keys(known_ends, count), _keys(edges, count)
    order = np.argsort(known, kind="stable")
    place = np.minimum(np.searchsorted(known[order], key), count - 1)
    node = np.where(known[order][place] == key, order[place], -1)
    missing = node < 0
    _, first, inverse = np.unique(key[missing], return_index=True, return_inverse=True)
    node[missing] = count + inverse
    ends, on_rim = edges[missing][first], rim[missing][first]
    positions = known_positions[ends].mean(1)
    if snap is not None:
        positions = snap(positions, known_positions[ends], on_rim)
    clamped = still[missing][first]
    fixed = on_rim[:, None] & known_fixed[ends].all(1)
    return node, (
        np.concatenate([known_positions, positions]),
        np.concatenate([known_ends, ends]),
        np.concatenate([known_clamped, clamped]),
        np.concatenate([known_fixed, fixed]),
    )


def _keys(pairs: NDArray[np.int64], count: int) -> NDArray[np.int64]:
    """A number for each pair (n, 2) of node numbers below `count`, whichever comes first; for equal ones a negative."""
    low, high = pairs.min(1), pairs.max(1)
    return np.where(low == high, -1 - low, low * np.int64(count) + high)


def _rotate_longest_first(positions: Array, triangles: NDArray[np.int64]) -> NDArray[np.int64]:
    """The triangles rotated so that the longest edge is opposite the first node; neighbours break ties alike."""
    side = np.roll(triangles, -1, axis=1), np.roll(triangles, -2, axis=1)
    length = np.linalg.norm(positions[side[0]] - positions[side[1]], axis=2)
    # Rounding must not decide: lengths that agree to a millionth count as equal, and the edges' names decide.
    length = np.round(length / length.max(axis=1, keepdims=True), 6)
    name = np.maximum(*side) + np.minimum(*side) / (triangles.max(initial=0) + 1.0)
    peak = np.lexsort((name, length), axis=1)[:, -1]
    return np.take_along_axis(triangles, (peak[:, None] + np.arange(3)) % 3, axis=1)


def _root_slots(triangles: NDArray[np.int64], node_count: int) -> NDArray[np.int64]:
    """Every other number round each node: an angle is halved at most once."""
    corner = triangles.ravel()
    order = np.argsort(corner, kind="stable")
    count = np.bincount(corner, minlength=node_count)
    rank = np.empty(len(corner), np.int64)
    rank[order] = positions_in_rows(count)
    return 2 * rank.reshape(-1, 3)


def _child_slots(slots: NDArray[np.int64], second: NDArray[np.bool_]) -> NDArray[np.int64]:
    """The slots of both children (2 n, 3): the peak's angle is halved; the new node gets four, two on each side."""
    peak, a, b = slots.T
    new = 4 * second
    return np.stack([np.stack([new, peak, a], 1), np.stack([new + 2, b, peak + 1], 1)], 1).reshape(-1, 3)


def _partners(middle: NDArray[np.int64]) -> Integers:
    """The other triangle with the same node in the middle of its refinement edge, or itself."""
    order = np.argsort(middle, kind="stable")
    same = (middle[order][1:] == middle[order][:-1]) & (middle[order][1:] >= 0)
    partner = np.arange(len(middle), dtype=np.int32)
    one, other = order[:-1][same], order[1:][same]
    partner[one], partner[other] = other, one
    return partner


def _half_edges(triangles: NDArray[np.int64]) -> Integers:
    """Twice the edge's number, and one more where it runs from the higher node to the lower."""
    begin, end = triangles.ravel(), np.roll(triangles, -1, axis=1).ravel()
    count = int(triangles.max(initial=0)) + 1
    number = np.unique(np.minimum(begin, end) * np.int64(count) + np.maximum(begin, end), return_inverse=True)[1]
    return (2 * number + (begin > end)).reshape(-1, 3).astype(np.int32)


def rim_sides(forest: TriangleForest) -> NDArray[np.bool_]:
    """Mask (n_triangle, 3) of the sides, from each corner to the next, on the boundary of the mesh; of all levels."""
    sides = [_rim(forest.triangles[: forest.root_count].astype(np.int64))]
    for _ in range(forest.depth):
        sides.append(_child_sides(sides[-1], np.zeros(len(sides[-1]), bool)))
    return np.concatenate(sides)


def closure(split: NDArray[np.bool_], forest: TriangleForest) -> NDArray[np.bool_]:
    """Mask (n_triangle,) of triangles bisected with those split so that no node hangs; see `close_queue` of `adapt`."""
    split, new = split.copy(), np.flatnonzero(split)
    while len(new):
        inner = new[new >= forest.root_count]
        asked = np.unique(np.concatenate([forest.partner[new], (inner - forest.root_count) // 2]))
        new = asked[~split[asked]]
        split[new] = True
    return split

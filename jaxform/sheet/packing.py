"""Packing of the active set: elements and nodes in the order in which a window processes them.

Elements whose nodes all stick, and nodes that belong to no other element, come last and are not active: the
problem becomes "a smaller and smaller free inflation problem" (paper, 3.2). Nothing is compiled again, since the number
of blocks in use is data.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxform.core.pytree import as_index, as_real, pytree
from jaxform.kernels.blocks import BLOCK, Halves, compact_indices, over_blocks, padded_length, running_count
from jaxform.mechanics.elements import Elements, typical_row_count
from jaxform.mechanics.membrane import gather
from jaxform.mesh.topology import positions_in_rows
from jaxform.mesh.volumes import reference_metric
from jaxform.model.tables import Assembly, Counts, ElementPairs, ReferenceGeometry

# Elements in pairs that share an edge: four nodes are looked up for two elements, where each by itself needs three.


def pair_elements(triangles: np.ndarray) -> np.ndarray:
    """Pairs (2, n_pair) of elements that share an edge; -1 for the second of one that is left over.

    Whoever has one neighbour left is paired first, so that few are left over; else an element takes the neighbour with
    the fewest others, and of these the one with the nearest number.

    Args:
        triangles: Node numbers (n_element, 3).
    """
    beside = _neighbors(triangles)
    left, partner = [len(others) for others in beside], [-1] * len(beside)
    lonely, rest = [e for e, count in enumerate(left) if count == 1], iter(range(len(beside)))
    while (element := lonely.pop() if lonely else next(rest, None)) is not None:
        if partner[element] >= 0:
            continue
        free = [other for other in beside[element] if partner[other] < 0]
        ranked = [(left[other], abs(other - element), other) for other in free]
        other = min(ranked)[2] if ranked else element
        partner[element], partner[other] = other, element
        for taken in {element, other}:
            for near in beside[taken]:
                left[near] -= 1
                if left[near] == 1 and partner[near] < 0:
                    lonely.append(near)
    second = np.asarray(partner)
    first = np.flatnonzero(second >= np.arange(len(second)))
    return np.stack([first, np.where(second[first] == first, -1, second[first])])


def _neighbors(triangles: np.ndarray) -> list[list[int]]:
    """Elements that share an edge with each; where more than two share one, some of them."""
    count = len(triangles)
    ends = np.sort(np.concatenate([triangles[:, [k, (k + 1) % 3]] for k in range(3)]), axis=1).astype(np.int64)
    name = ends[:, 1] * (int(ends.max(initial=0)) + 1) + ends[:, 0]
    order = np.argsort(name, kind="stable")
    same = np.flatnonzero(name[order[1:]] == name[order[:-1]])
    both = np.stack([order[same] % count, order[same + 1] % count], axis=1)
    both = both[both[:, 0] != both[:, 1]]
    own, others = both.ravel(), both[:, ::-1].ravel()
    by_owner = np.argsort(own, kind="stable")
    listed, end = others[by_owner].tolist(), np.cumsum(np.bincount(own, minlength=count)).tolist()
    return [listed[begin:stop] for begin, stop in zip([0, *end[:-1]], end, strict=True)]


def rotate_to_common_edge(triangles: np.ndarray, pairs: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The elements' nodes (n_element, 3) in such an order that those of a pair begin with their common edge.

    And for each element whether its order is still that of its normal, 1, or has been reversed, -1.
    """
    corners, sign = triangles.copy(), np.ones(len(triangles))
    one, other = pairs[:, pairs[1] >= 0]
    apex, beyond = (_opposite_corner(triangles[a], triangles[b]) for a, b in ((one, other), (other, one)))
    for element, place in ((one, apex), (other, beyond)):
        at = place[:, None] + np.array([1, 2, 3])
        corners[element] = np.take_along_axis(triangles[element], at % 3, axis=1)
    against = corners[one, 0] != corners[other, 0]
    flipped = other[against]
    corners[flipped] = corners[flipped][:, [1, 0, 2]]
    sign[flipped] = -1.0
    return corners, sign


def _opposite_corner(own: np.ndarray, others: np.ndarray) -> np.ndarray:
    """The corner (n,) of triangles (n, 3) whose node is none of the others' (n, 3)."""
    return np.argmin((own[:, :, None] == others[:, None, :]).any(axis=2), axis=1)


_MOST_ROWS = 16  # of the shares of a node that are looked up row by row: each is compiled by itself


@pytree
class Packed:
    """Elements and nodes in packed order.

    Attributes:
        node: The node at each place (place,); node 0 at the places beyond the nodes.
        place: The place of each node (n_node,).
        element: The element at each place of the list (capacity,).
        exists: True for places with a node (place,).
        kept: True for elements in the list (n_element,).
        elements: Data of the elements for the force.
    """

    node: jax.Array
    place: jax.Array
    element: jax.Array
    exists: jax.Array
    kept: jax.Array
    elements: Elements

    def pack(self, nodal: jax.Array) -> jax.Array:
        """Values (..., place) of (..., n_node), in packed order."""
        return gather(nodal, self.node)

    def unpack(self, packed: jax.Array) -> jax.Array:
        """Values (..., n_node) of (..., place), in the mesh's order."""
        return gather(packed, self.place)


def make_assembly(triangles: np.ndarray, node_count: int) -> Assembly:
    """The element corners (n_element, 3) from which each node gathers its force; on the host.

    The few nodes with far more elements than the others, such as a pole, hand their surplus to a list.
    """
    return _assembly(triangles, node_count, None)


def make_paired_assembly(positions: np.ndarray, triangles: np.ndarray) -> Assembly:
    """The assembly with elements in pairs, of a sheet with nodes at initial positions (n_node, 3) [m]."""
    pairs = pair_elements(triangles)
    corners, orientation = rotate_to_common_edge(triangles, pairs)
    inverse, _ = reference_metric(positions, corners)
    there = pairs >= 0
    pair = np.zeros(len(triangles), np.int32)
    pair[pairs[there]] = np.nonzero(there)[1]
    beyond = np.where(there[1], corners[pairs[1], 2], -1)
    kept = ElementPairs(as_index(pairs), as_index(pair), as_index(corners.T), as_real(inverse), as_real(orientation))
    return _assembly(np.column_stack([corners[pairs[0]], beyond]), len(positions), kept)


def _assembly(nodes: np.ndarray, node_count: int, pairs: ElementPairs | None) -> Assembly:
    """The assembly from the corner nodes (n, 3) of elements, or (n, 4) of pairs; -1 where there is no corner."""
    corner_node, width = nodes.ravel(), nodes.shape[1]
    order = np.argsort(corner_node, kind="stable")
    order = order[np.count_nonzero(corner_node < 0) :]
    count = np.bincount(corner_node[order], minlength=node_count)
    rank = positions_in_rows(count)
    code = 4 * (order // width) + order % width
    depth = _depth(count, typical_row_count(pairs is not None))
    table = np.full((depth, node_count), -1, np.int32)
    inside = rank < depth
    table[rank[inside], corner_node[order[inside]]] = code[inside]
    overflow = order[~inside]
    return Assembly(
        table=as_index(table),
        overflow_node=as_index(corner_node[overflow]),
        overflow=as_index(code[~inside]),
        pairs=pairs,
    )


def _depth(count: np.ndarray, usual: int) -> int:
    """The depth at which looking up costs least [ns]: rows, the unusual ones of few blocks, or a list of the rest."""
    depths = np.arange(1, min(count.max(), _MOST_ROWS) + 1)
    beyond = np.array([np.maximum(count - depth, 0).sum() for depth in depths])
    blocks = np.array([-(-np.count_nonzero(count >= depth) // BLOCK) for depth in depths])
    looked_up = np.cumsum(np.where(depths <= usual, len(count), BLOCK * blocks))
    return int(depths[np.argmin(2 * looked_up + (depths > usual) * len(count) + 12 * beyond)])


def pack(
    moving: jax.Array | None,
    sheet: ReferenceGeometry,
    assembly: Assembly,
    counts: Counts | None = None,
    *,
    stepped: bool = True,
) -> Packed:
    """Packs the elements (n_element,) that can move, and their nodes.

    Where `moving` is None, all elements and nodes; in the mesh's own order where there are no pairs, or what is packed
    does not advance, only summed over, and needs to know no node's shares. There may be room for more of each than
    `counts` says.
    """
    element_count, node_count, pairs = sheet.area.size, assembly.table.shape[1], assembly.pairs
    places = padded_length(node_count)
    counts = counts or Counts(jnp.int32(element_count), jnp.int32(node_count))
    if pairs is None:
        listing = _list_elements(moving, element_count, counts.elements)
    else:
        listing = _list_pairs(moving, pairs, counts.pairs)
    count, kept = listing.count, listing.active
    place, node_total = jnp.arange(node_count, dtype=jnp.int32), counts.nodes
    if moving is not None:
        place, node_total = _order_by_valence(_nodes_of_moving(kept, assembly, counts.nodes), assembly, counts.nodes)
    elif stepped and pairs is not None:
        place, node_total = _order_by_valence(place < counts.nodes, assembly, counts.nodes)
    node = jnp.zeros(places, jnp.int32).at[place].set(jnp.arange(node_count, dtype=jnp.int32), unique_indices=True)
    exists = jnp.arange(places) < node_count

    def slots(code: jax.Array, there: jax.Array) -> jax.Array:
        """Places of shares in the corners' arrays; what is not worked out is looked up at the first unused element."""
        owner = jnp.maximum(code, 0) >> 2
        share, unused = listing.share(code & 3, listing.rank[owner]), listing.share(0, count)
        return jnp.where(there & (code >= 0) & kept[owner], share, unused).astype(jnp.int32)

    overflow = overflow_into = assembly.overflow
    table, overflow_count = assembly.table, jnp.int32(0)
    if assembly.overflow.size > 0:
        home, added, table = _overflow_targets(assembly, kept)
        order, overflow_count = compact_indices(added, overflow.size)
        overflow, overflow_into = (slots(code[order], jnp.asarray(True)) for code in (overflow, home))
    block_count, node_block_count = count // listing.per_block + 1, -(-node_total // BLOCK)
    triangles, inverse_metric, area, orientation = _columns(sheet, pairs, place, listing, block_count)
    shares = jnp.zeros((assembly.table.shape[0], places), jnp.int32)
    row_count = jnp.zeros(places // BLOCK, jnp.int32)
    if stepped:
        shares, row_count = _shares(slots, table, node, exists, node_block_count)
    elements = Elements(
        triangles=triangles,
        inverse_metric=inverse_metric,
        area=area,
        orientation=orientation,
        origin=sheet.origin,
        slots=shares,
        overflow=overflow,
        overflow_into=overflow_into,
        overflow_count=overflow_count,
        block_count=block_count,
        node_block_count=node_block_count,
        row_count=row_count,
        regions=None if sheet.regions is None else gather(sheet.regions, listing.element),
    )
    return Packed(node, place, listing.element, exists, kept if pairs is None else kept[pairs.pair], elements)


class _Listing(NamedTuple):
    """The elements, or pairs of them, that are active.

    Attributes:
        element: The element at each place (capacity,).
        there: True at places of the list (capacity,); places beyond its end repeat an element.
        active: True for listed elements, or pairs (n,).
        rank: Position of each of these in the list (n,).
        count: Number of listed elements, or pairs.
        per_block: Number in a block.
    """

    element: jax.Array
    there: jax.Array
    active: jax.Array
    rank: jax.Array
    count: jax.Array
    per_block: int

    def share(self, corner: jax.Array | int, rank: jax.Array) -> jax.Array:
        """The index of a corner's share, of the element or pair of that rank, in the arrays of corner forces."""
        capacity = self.element.size
        if self.per_block == BLOCK:
            return corner * capacity + rank
        block, place = rank // self.per_block, rank % self.per_block
        return (corner >> 1) * capacity + block * BLOCK + (corner & 1) * self.per_block + place


def _list_elements(moving: jax.Array | None, element_count: int, used: jax.Array) -> _Listing:
    capacity = padded_length(element_count)
    if moving is None:
        rank, count = jnp.arange(element_count, dtype=jnp.int32), used
        kept, element = rank < count, jnp.minimum(jnp.arange(capacity, dtype=jnp.int32), element_count - 1)
    else:
        kept, (element, count) = moving, compact_indices(moving, capacity, used)
        rank = running_count(moving, used) - 1
    return _Listing(element, jnp.arange(capacity) < count, kept, rank, count, BLOCK)


def _list_pairs(moving: jax.Array | None, pairs: ElementPairs, used: jax.Array | None) -> _Listing:
    """A pair is listed if either element can move: the first in a block's first half, the second in its second."""
    (first, second), half = pairs.element, BLOCK // 2
    capacity = (first.size // half + 1) * half
    if moving is None:
        rank, count = jnp.arange(first.size, dtype=jnp.int32), jnp.int32(first.size) if used is None else used
        kept, pair = rank < count, jnp.minimum(jnp.arange(capacity), first.size - 1)
    else:
        kept = moving[first] | (second >= 0) & moving[jnp.maximum(second, 0)]
        (pair, count), rank = compact_indices(kept, capacity, used), running_count(kept, used) - 1
    used, other = jnp.arange(capacity) < count, second[pair]
    element = Halves(first[pair], jnp.where(other >= 0, other, first[pair])).concatenate()
    return _Listing(element, Halves(used, used & (other >= 0)).concatenate(), kept, rank, count, half)


def _columns(
    sheet: ReferenceGeometry, pairs: ElementPairs | None, place: jax.Array, listing: _Listing, block_count: jax.Array
) -> tuple[jax.Array, jax.Array, jax.Array, jax.Array | None]:
    """Triangles (3, capacity) of places, inverse metric, area, orientation where there are pairs; 0 beyond the list."""
    order = sheet if pairs is None else pairs
    numbers = [sheet.area] if pairs is None else [sheet.area, pairs.orientation]

    def compute_block(element: jax.Array, there: jax.Array) -> Any:
        corners = [gather(place, row[element]) for row in order.triangles]
        own = [jnp.where(there, values[element], 0.0) for values in numbers]
        return [corners, [row[element] for row in order.inverse_metric], own], []

    capacity, real = listing.element.size, sheet.area.dtype
    into = [
        jnp.zeros((3, capacity), jnp.int32),
        jnp.zeros((3, capacity), real),
        jnp.zeros((len(numbers), capacity), real),
    ]
    (triangles, inverse_metric, own), _ = over_blocks(
        compute_block, block_count, (listing.element, listing.there), into
    )
    return triangles, inverse_metric, own[0], None if pairs is None else own[1]


def _shares(
    slots: Callable[[jax.Array, jax.Array], jax.Array],
    table: jax.Array,
    node: jax.Array,
    exists: jax.Array,
    node_block_count: jax.Array,
) -> tuple[jax.Array, jax.Array]:
    """Places of the shares of the nodes in use (depth, place), and the rows in use for each block of nodes."""

    def compute_block(node: jax.Array, exists: jax.Array) -> Any:
        codes = gather(table, node)
        count = jnp.sum(codes >= 0, axis=0, dtype=jnp.int32)
        return [list(slots(codes, exists[None])), [jnp.where(exists, count, 0)]], []

    depth = table.shape[0]
    into = [jnp.zeros((depth, node.size), jnp.int32), jnp.zeros((1, node.size), jnp.int32)]
    (found, count), _ = over_blocks(compute_block, node_block_count, (node, exists), into)
    return found, jnp.max(count.reshape(-1, BLOCK), axis=1)


def _overflow_targets(assembly: Assembly, kept: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
    """The active share to which each node with surplus shares adds them: the first of its shares that are active.

    Returns:
        That share of the node of each surplus one (k,); which of these are added to it; and the table with a surplus
        share in its first row where a node has none else: one that sticks, and whose position has a derivative.
    """
    node, table = assembly.overflow_node, assembly.table
    rows, own = table[:, node], (assembly.overflow >= 0) & kept[jnp.maximum(assembly.overflow, 0) >> 2]
    worked = (rows >= 0) & kept[jnp.maximum(rows, 0) >> 2]
    usual = jnp.any(worked, axis=0)
    first = jnp.take_along_axis(rows, jnp.argmax(worked, axis=0)[None], axis=0)[0]
    home = jnp.where(usual, first, jnp.where(own, assembly.overflow, -1))
    home = jnp.full(table.shape[1], -1, home.dtype).at[node].max(home)[node]
    return home, own & (home != assembly.overflow), table.at[0, node].set(jnp.where(usual, rows[0], home))


def _nodes_of_moving(moving: jax.Array, assembly: Assembly, node_count: jax.Array) -> jax.Array:
    """Nodes (n_node,) of elements that can move."""
    table = assembly.table

    def compute_block(node: jax.Array) -> Any:
        codes = gather(table, jnp.minimum(node, table.shape[1] - 1))
        return [[jnp.any((codes >= 0) & gather(moving, jnp.maximum(codes, 0) >> 2), axis=0)]], []

    places = padded_length(table.shape[1])
    into = [jnp.zeros((1, places), bool)]
    (found,), _ = over_blocks(compute_block, -(-node_count // BLOCK), (jnp.arange(places, dtype=jnp.int32),), into)
    touched = found[0, : table.shape[1]]
    if assembly.overflow.size == 0:
        return touched
    spilt = (assembly.overflow >= 0) & moving[jnp.maximum(assembly.overflow, 0) >> 2]
    return touched.at[assembly.overflow_node].max(spilt)


def _order_by_valence(touched: jax.Array, assembly: Assembly, node_count: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Places (n,) that put the marked nodes first, before all those with many elements; and how many are marked.

    So nearly all blocks of nodes look up the usual number of shares, and no more.
    """
    usual = typical_row_count(assembly.pairs is not None)
    if len(assembly.table) <= usual:
        return _order_marked_first(touched, node_count)
    many, _ = _order_marked_first(assembly.table[usual] >= 0, node_count)
    place, count = _order_marked_first(jnp.zeros_like(touched).at[many].set(touched, unique_indices=True), node_count)
    return place[many], count


def _order_marked_first(marked: jax.Array, size: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Places (n,) that put the marked ones first and keep the order otherwise; and how many are marked.

    Of the first `size` entries; the others keep their places.
    """
    running, own = running_count(marked, size), jnp.arange(marked.size, dtype=jnp.int32)
    count = running[size - 1]
    return jnp.where(own >= size, own, jnp.where(marked, running - 1, count + own - running)), count

"""What can still move, packed: elements and nodes in the order in which a window works through them.

Elements whose nodes all stick, and nodes that belong to no other element, come last and are not worked through: the
problem becomes "a smaller and smaller free inflation problem" (paper, 3.2). Nothing is compiled anew, since the number
of blocks in use is data.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxform.blocks import BLOCK, listed, over_blocks, padded, running_count
from jaxform.force import USUAL_ROWS, Elements
from jaxform.membrane import gather
from jaxform.pytree import as_index, pytree
from jaxform.scene import Assembly, Sheet

_MOST_ROWS = 16  # of the shares of a node that are looked up row by row: each is compiled by itself


@pytree
class Packed:
    """Elements and nodes in packed order.

    Attributes:
        node: The node at each place (place,); node 0 at the places beyond the nodes.
        place: The place of each node (n_node,).
        element: The element at each place of the list (room,).
        exists: Whether there is a node at a place (place,).
        kept: Elements (n_element,) that are in the list.
        elements: What the force needs of them.
    """

    node: jax.Array
    place: jax.Array
    element: jax.Array
    exists: jax.Array
    kept: jax.Array
    elements: Elements

    def taken(self, nodal: jax.Array) -> jax.Array:
        """Values (..., place) of (..., n_node), in packed order."""
        return gather(nodal, self.node)

    def put_back(self, packed: jax.Array) -> jax.Array:
        """Values (..., n_node) of (..., place), in the mesh's order."""
        return gather(packed, self.place)


def make_assembly(triangles: np.ndarray, node_count: int) -> Assembly:
    """Which corners of which elements each node gathers its force from; on the host.

    The few nodes with far more elements than the others, such as a pole, hand their surplus to a list.
    """
    corner_node = triangles.ravel()
    order = np.argsort(corner_node, kind="stable")
    count = np.bincount(corner_node, minlength=node_count)
    rank = np.arange(len(order)) - np.repeat(np.cumsum(count) - count, count)
    code = 4 * (order // 3) + order % 3
    depth = _depth(count)
    table = np.full((depth, node_count), -1, np.int32)
    inside = rank < depth
    table[rank[inside], corner_node[order[inside]]] = code[inside]
    spill = order[~inside]
    return Assembly(
        table=as_index(table),
        spill_node=as_index(corner_node[spill]),
        spill=as_index(code[~inside]),
    )


def _depth(count: np.ndarray) -> int:
    """The depth at which looking up costs least [ns]: rows, the unusual ones of few blocks, or a list of the rest."""
    depths = np.arange(1, min(count.max(), _MOST_ROWS) + 1)
    beyond = np.array([np.maximum(count - depth, 0).sum() for depth in depths])
    blocks = np.array([-(-np.count_nonzero(count >= depth) // BLOCK) for depth in depths])
    looked_up = np.cumsum(np.where(depths <= USUAL_ROWS, len(count), BLOCK * blocks))
    return int(depths[np.argmin(2 * looked_up + (depths > USUAL_ROWS) * len(count) + 12 * beyond)])


def pack(
    moving: jax.Array | None,
    sheet: Sheet,
    assembly: Assembly,
    counts: tuple[jax.Array, jax.Array] | None = None,
    *,
    stepped: bool = True,
) -> Packed:
    """Packs the elements (n_element,) that can move, and their nodes.

    Where `moving` is None, all elements and nodes. There may be room for more of each than `counts` says. What is not
    `stepped`, only summed over, needs to know no node's shares.
    """
    element_count, node_count = sheet.area.size, assembly.table.shape[1]
    room, places = padded(element_count), padded(node_count)
    counts = counts or (jnp.int32(element_count), jnp.int32(node_count))
    if moving is None:
        count, node_total = counts
        rank, place = jnp.arange(element_count, dtype=jnp.int32), jnp.arange(node_count, dtype=jnp.int32)
        kept, element = rank < count, jnp.minimum(jnp.arange(room, dtype=jnp.int32), element_count - 1)
    else:
        kept, (element, count) = moving, listed(moving, room)
        rank = running_count(moving) - 1
        place, node_total = _ordered(_touched(moving, assembly, counts[1]), assembly)
    node = jnp.zeros(places, jnp.int32).at[place].set(jnp.arange(node_count, dtype=jnp.int32), unique_indices=True)
    exists = jnp.arange(places) < node_count

    def slots(code: jax.Array, there: jax.Array) -> jax.Array:
        """Places of shares in the corners' arrays; what is not worked out is looked up at the first unused element."""
        owner = jnp.maximum(code, 0) >> 2
        return jnp.where(there & (code >= 0) & kept[owner], (code & 3) * room + rank[owner], count).astype(jnp.int32)

    spill = spill_into = assembly.spill
    table, spill_count = assembly.table, jnp.int32(0)
    if assembly.spill.size > 0:
        home, added, table = _homes(assembly, kept)
        order, spill_count = listed(added, spill.size)
        spill, spill_into = (slots(code[order], jnp.asarray(True)) for code in (spill, home))
    block_count, node_block_count = count // BLOCK + 1, -(-node_total // BLOCK)
    triangles, inverse_metric, area = _columns(sheet, place, element, block_count)
    shares = jnp.zeros((assembly.table.shape[0], places), jnp.int32)
    row_count = jnp.zeros(places // BLOCK, jnp.int32)
    if stepped:
        shares, row_count = _shares(slots, table, node, exists, node_block_count)
    elements = Elements(
        triangles=triangles,
        inverse_metric=inverse_metric,
        area=jnp.where(jnp.arange(room) < count, area, 0.0),
        origin=sheet.origin,
        slots=shares,
        spill=spill,
        spill_into=spill_into,
        spill_count=spill_count,
        block_count=block_count,
        node_block_count=node_block_count,
        row_count=row_count,
    )
    return Packed(node, place, element, exists, kept, elements)


def _columns(
    sheet: Sheet, place: jax.Array, element: jax.Array, block_count: jax.Array
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Triangles (3, room) of places, inverse metric and area of the elements in the list; 0 beyond it."""

    def work(element: jax.Array) -> Any:
        corners = [gather(place, row[element]) for row in sheet.triangles]
        return [corners, [row[element] for row in sheet.inverse_metric], [sheet.area[element]]], []

    room, real = element.size, sheet.area.dtype
    into = [jnp.zeros((3, room), jnp.int32), jnp.zeros((3, room), real), jnp.zeros((1, room), real)]
    (triangles, inverse_metric, area), _ = over_blocks(work, block_count, (element,), into)
    return triangles, inverse_metric, area[0]


def _shares(
    slots: Callable[[jax.Array, jax.Array], jax.Array],
    table: jax.Array,
    node: jax.Array,
    exists: jax.Array,
    node_block_count: jax.Array,
) -> tuple[jax.Array, jax.Array]:
    """Where the shares of the nodes in use are (depth, place), and how many rows each block of nodes uses of it."""

    def work(node: jax.Array, exists: jax.Array) -> Any:
        codes = [row[node] for row in table]
        count = sum((code >= 0).astype(jnp.int32) for code in codes)
        return [[slots(code, exists) for code in codes], [jnp.where(exists, count, 0)]], []

    depth = table.shape[0]
    into = [jnp.zeros((depth, node.size), jnp.int32), jnp.zeros((1, node.size), jnp.int32)]
    (found, count), _ = over_blocks(work, node_block_count, (node, exists), into)
    return found, jnp.max(count.reshape(-1, BLOCK), axis=1)


def _homes(assembly: Assembly, kept: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Where nodes with surplus shares have them added: to the first of their shares that are worked through.

    Returns:
        That share of the node of each surplus one (k,); which of these are added to it; and the table with a surplus
        share in its first row where a node has none else: one that sticks, and whose position has a derivative.
    """
    node, table = assembly.spill_node, assembly.table
    rows, own = table[:, node], kept[assembly.spill >> 2]
    worked = (rows >= 0) & kept[jnp.maximum(rows, 0) >> 2]
    usual = jnp.any(worked, axis=0)
    first = jnp.take_along_axis(rows, jnp.argmax(worked, axis=0)[None], axis=0)[0]
    home = jnp.where(usual, first, jnp.where(own, assembly.spill, -1))
    home = jnp.full(table.shape[1], -1, home.dtype).at[node].max(home)[node]
    return home, own & (home != assembly.spill), table.at[0, node].set(jnp.where(usual, rows[0], home))


def _touched(moving: jax.Array, assembly: Assembly, node_count: jax.Array) -> jax.Array:
    """Nodes (n_node,) of elements that can move."""
    table = assembly.table

    def work(node: jax.Array) -> Any:
        codes = [row.at[node].get(mode="clip") for row in table]
        touched = [(code >= 0) & moving[jnp.maximum(code, 0) >> 2] for code in codes]
        return [[functools.reduce(jnp.logical_or, touched)]], []

    places = padded(table.shape[1])
    into = [jnp.zeros((1, places), bool)]
    (found,), _ = over_blocks(work, -(-node_count // BLOCK), (jnp.arange(places, dtype=jnp.int32),), into)
    touched = found[0, : table.shape[1]]
    if assembly.spill.size == 0:
        return touched
    return touched.at[assembly.spill_node].max(moving[assembly.spill >> 2])


def _ordered(touched: jax.Array, assembly: Assembly) -> tuple[jax.Array, jax.Array]:
    """Places (n,) that put the marked nodes first, before all those with many elements; and how many are marked.

    So nearly all blocks of nodes look up the usual number of shares, and no more.
    """
    if len(assembly.table) <= USUAL_ROWS:
        return _first(touched)
    many, _ = _first(assembly.table[USUAL_ROWS] >= 0)
    place, count = _first(jnp.zeros_like(touched).at[many].set(touched, unique_indices=True))
    return place[many], count


def _first(marked: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Places (n,) that put the marked ones first and keep the order otherwise; and how many are marked."""
    running = running_count(marked)
    count = running[-1]
    others = count + jnp.arange(marked.size, dtype=jnp.int32) - running
    return jnp.where(marked, running - 1, others), count

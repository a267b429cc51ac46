"""The broad phase of a step: selection of the listed pairs that are tested, while one candidate list is valid.

Every few steps a check of all nodes tells whether any can touch the mold, or leave its sphere, before the next check.
While none can, nothing is tested. Otherwise every step selects the pairs whose nodes have moved far enough from where
they were listed, and another list is made where a node is about to leave its sphere. A check relies on the velocities.
Where these changed, so that a node may have touched the mold unchecked, the next check or the end of the list detects
it, and the window is retried without relying on checks.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp

from jaxform.core.pytree import pytree
from jaxform.kernels.blocks import over_blocks, put, slice_at
from jaxform.mechanics.membrane import dot, gather, minus
from jaxform.tools.mold import ToolFrame

LOOK_EVERY = 4  # steps
_AHEAD = 2.0  # times as far as a node goes at its speed until the next check: where it may be before that


BroadPhaseCheck = tuple[jax.Array, jax.Array]
"""The result of a check of the nodes.

Whether any can touch a listed triangle, or leave its sphere, before the next check, so that every step until then
selects pairs; and whether one may have touched the mold unchecked before this check.
"""


DueBlocks = tuple[jax.Array, jax.Array]
"""Blocks of listed pairs that are tested: their numbers (n_block,), and their count."""


def initial_check() -> BroadPhaseCheck:
    """The check before the first one: every step selects pairs."""
    return jnp.asarray(True), jnp.asarray(False)


def no_active_pairs(candidates: Candidates) -> tuple[DueBlocks, jax.Array]:
    """The return value of `find_active_pairs` for a step that tests nothing."""
    block, _ = all_blocks(candidates)
    return (block, jnp.int32(0)), jnp.asarray(False)


def check_nodes(
    positions: Any,
    velocities: jax.Array,
    stuck: jax.Array,
    till_next: jax.Array,
    candidates: Candidates,
    last: BroadPhaseCheck,
    node_block_count: jax.Array,
    frame: ToolFrame | None = None,
) -> BroadPhaseCheck:
    """Checks every node in use, up to the next check.

    Args:
        positions: Node positions, (3, n_node) or three times (n_node,) [m].
        velocities: Node velocities (3, n_node) [m/s].
        stuck: Nodes (n_node,) that do not move any more.
        till_next: Time until the next check [s].
        candidates: The list.
        last: Result of the last check.
        node_block_count: Number of node blocks in use.
        frame: The frame of the tool, where that moves; the list is that of places in it.
    """

    def compute_block(stuck: Any, positions: Any, velocities: Any, spheres: Any) -> Any:
        start, clear_square, near_square, center, alarm_square, unwatched_square = spheres
        if frame is not None:
            positions, velocities = frame.places(positions), frame.speeds(velocities)
        there, beyond = (
            [x + ahead * till_next * v for x, v in zip(positions, velocities, strict=True)] for ahead in (1.0, _AHEAD)
        )
        close = _has_moved(positions, start, near_square) | _has_moved(beyond, start, near_square)
        close |= _has_moved(positions, center, unwatched_square) | _has_moved(there, center, alarm_square)
        return [], [~stuck & close, ~stuck & _has_moved(positions, start, clear_square)]

    spheres = (
        candidates.start,
        candidates.clear_square,
        candidates.near_square,
        candidates.center,
        candidates.alarm_square,
        candidates.unwatched_square,
    )
    inputs = stuck, positions, velocities, spheres
    _, (close, touching) = over_blocks(compute_block, node_block_count, inputs, [], sums=2)
    return close > 0, (touching > 0) & ~last[0]


def list_spheres(candidates: Candidates) -> tuple[jax.Array, ...]:
    """The arrays of a list that `may_have_missed` needs, node by node."""
    return candidates.start, candidates.clear_square, candidates.center, candidates.limit_square


def may_have_missed(positions: Any, stuck: jax.Array, spheres: Any, last: BroadPhaseCheck) -> jax.Array:
    """Mask (n,) of nodes that may have missed the mold: out of their spheres, or far enough to touch it unchecked.

    Args:
        positions: Node positions (3, n) [m].
        stuck: Nodes (n,) that do not move any more.
        spheres: The `list_spheres` of the list at these nodes.
        last: Result of the last check.
    """
    start, clear_square, center, limit_square = spheres
    close, _ = last
    return ~stuck & (~close & _has_moved(positions, start, clear_square) | _has_moved(positions, center, limit_square))


def all_blocks(candidates: Candidates) -> DueBlocks:
    """All listed pairs."""
    blocks = candidates.lists.node.size // TEST_BLOCK
    return jnp.arange(blocks, dtype=jnp.int32), -(-candidates.count // TEST_BLOCK)


def find_active_pairs(
    positions: Any,
    stuck: jax.Array,
    touches: jax.Array,
    candidates: Candidates,
    node_block_count: jax.Array,
    frame: ToolFrame | None = None,
) -> tuple[DueBlocks, jax.Array]:
    """The blocks with free nodes that moved far enough to touch the mold, and whether one soon leaves its sphere.

    Args:
        positions: Node positions after the step, (3, n_node) or three times (n_node,) [m].
        stuck: Nodes (n_node,) that do not move any more.
        touches: Nodes (n_node,) that touch this surface already, those that are stuck included.
        candidates: The list.
        node_block_count: Number of node blocks in use.
        frame: The frame of the tool, as in `check_nodes`.
    """

    def compute_block(stuck: Any, touches: Any, positions: Any, spheres: Any) -> Any:
        start, clear_square, center, alarm_square = spheres
        positions = positions if frame is None else frame.places(positions)
        touching = ~touches & _has_moved(positions, start, clear_square)
        return [[touching]], [touching, ~stuck & _has_moved(positions, center, alarm_square)]

    def add(block: jax.Array, due: DueBlocks) -> DueBlocks:
        first = block * TEST_BLOCK
        node = slice_at(candidates.lists.node, first, TEST_BLOCK)
        used = first + jnp.arange(TEST_BLOCK) < candidates.count
        # A block that is not due is overwritten by the next one.
        blocks, due_count = due
        return put(blocks, block[None], due_count), due_count + jnp.any(used & gather(touching[0], node))

    inputs = (
        stuck,
        touches,
        positions,
        (candidates.start, candidates.clear_square, candidates.center, candidates.alarm_square),
    )
    into = [jnp.zeros((1, stuck.size), bool)]
    (touching,), (count, leaving) = over_blocks(compute_block, node_block_count, inputs, into, sums=2)
    _, listed = all_blocks(candidates)
    none, _ = no_active_pairs(candidates)
    return jax.lax.fori_loop(0, jnp.where(count > 0, listed, 0), add, none), leaving > 0


def _has_moved(positions: Any, place: jax.Array, square: jax.Array) -> jax.Array:
    """True where the squared distance of nodes (n,) from a place (3, n) [m] is at least the square (n,) [m^2]."""
    gap = minus(positions, place)
    return dot(gap, gap) >= square


# Candidate lists: pairs of node and mold triangle near the sheet, and each node's bounding sphere.

TEST_BLOCK = 128  # pairs that are tested together
LANES, DEPTH = 16, 8  # nodes, and triangles of each, that are processed together
_CANDIDATES = 8  # for each of these pairs, from which they are chosen: where a mold is flat, many planes are near
PAIRS_PER_NODE, _LEAST_ROOM = 2, 4096  # that a list can hold, where nothing else is requested


@pytree
class CandidateLists:
    """Workspace of a candidate list: all of it is written before it is read.

    Attributes:
        node, triangle: The pairs (capacity,) that can meet.
        planes: Geometry of the pairs' triangles (12, capacity).
        coarse: The coarse pairs (capacity,) from which these were selected.
        spheres: Spheres of the nodes: center, radius and a lower bound on the center's distance to the mold (5, n_node)
            [m], begin and end of their triangles in the grid's lists (2, n_node), and whether the mold may be in them
            (1, n_node).
        clear: The distance (n_node,) [m] that a node can go without touching.
        squares: The five squares of `Candidates`, in its order (5, n_node).
    """

    node: jax.Array
    triangle: jax.Array
    planes: jax.Array
    coarse: tuple[jax.Array, jax.Array]
    spheres: tuple[jax.Array, jax.Array, jax.Array]
    clear: jax.Array
    squares: jax.Array


@pytree
class NearSides:
    """Pairs of a side and a sharp edge of one surface that can meet, while nodes stay in their spheres.

    Attributes:
        ends: Places of the side's ends (2, capacity).
        edge: Numbers of the edges (capacity,).
        count: Number of pairs.
        center: Centers of the spheres (3, n_node) [m], in the frame of the tool.
        square: Their radii, squared (n_node,) [m^2]; infinite for nodes that stick.
        overflow: True if pairs were lost.
    """

    ends: jax.Array
    edge: jax.Array
    count: jax.Array
    center: jax.Array
    square: jax.Array
    overflow: jax.Array


@pytree
class Candidates:
    """A candidate list, valid until a node is about to leave its sphere; undefined beyond the node blocks in use.

    Attributes:
        lists: The pairs of node and triangle that can meet.
        count: Number of pairs.
        start: Positions (3, n_node) [m] when they were listed.
        center: Centers of the spheres (3, n_node) [m].
        clear_square: Square of the distance (n_node,) [m^2] that a node can go from there without touching.
        near_square: The same, less the distance that any node moves between two checks.
        limit_square: Square of the radius (n_node,) [m^2] of the spheres: inside, none but listed triangles can be met.
        alarm_square: Square of the distance (n_node,) [m^2] from the center at which another list is made.
        unwatched_square: The same, less the distance that any node moves between two checks.
        overflow: True if pairs were lost, so that the list must not be used.
        sides: Sides that can meet sharp edges of the surface; None where it has none.
    """

    lists: CandidateLists
    count: jax.Array
    start: jax.Array
    center: jax.Array
    clear_square: jax.Array
    near_square: jax.Array
    limit_square: jax.Array
    alarm_square: jax.Array
    unwatched_square: jax.Array
    overflow: jax.Array
    sides: NearSides | None = None


def allocate_lists(node_count: int, real: jnp.dtype, pairs_per_node: int = PAIRS_PER_NODE) -> CandidateLists:
    """Workspace for the list of so many nodes; it has a margin, since whole blocks are written."""
    least = max(pairs_per_node * node_count, _LEAST_ROOM * pairs_per_node // PAIRS_PER_NODE)
    capacity = -(-least // TEST_BLOCK) * TEST_BLOCK
    coarse = jnp.zeros(_CANDIDATES * capacity + LANES * DEPTH, jnp.int32)
    pairs = jnp.zeros(capacity + TEST_BLOCK, jnp.int32)
    return CandidateLists(
        node=pairs,
        triangle=pairs,
        planes=jnp.zeros((12, capacity + TEST_BLOCK), real),
        coarse=(coarse, coarse),
        spheres=(
            jnp.zeros((5, node_count), real),
            jnp.zeros((2, node_count), jnp.int32),
            jnp.zeros((1, node_count), bool),
        ),
        clear=jnp.zeros(node_count, real),
        squares=jnp.zeros((5, node_count), real),
    )

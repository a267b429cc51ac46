"""Candidate lists: pairs of node and mold triangle near the sheet, and each node's bounding sphere."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from jaxform.core.pytree import pytree

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
        overflow: Whether pairs were lost, so that the list must not be used.
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


def allocate_lists(node_count: int, real: jnp.dtype, pairs_per_node: int = PAIRS_PER_NODE) -> CandidateLists:
    """Workspace for the list of so many nodes; it has a margin, since whole blocks are written."""
    least = max(pairs_per_node * node_count, _LEAST_ROOM * pairs_per_node // PAIRS_PER_NODE)
    room = -(-least // TEST_BLOCK) * TEST_BLOCK
    coarse = jnp.zeros(_CANDIDATES * room + LANES * DEPTH, jnp.int32)
    pairs = jnp.zeros(room + TEST_BLOCK, jnp.int32)
    return CandidateLists(
        node=pairs,
        triangle=pairs,
        planes=jnp.zeros((12, room + TEST_BLOCK), real),
        coarse=(coarse, coarse),
        spheres=(
            jnp.zeros((5, node_count), real),
            jnp.zeros((2, node_count), jnp.int32),
            jnp.zeros((1, node_count), bool),
        ),
        clear=jnp.zeros(node_count, real),
        squares=jnp.zeros((5, node_count), real),
    )

"""Which of the listed pairs are tested in a step: the watch over the nodes between two borders.

Every few steps a look at all nodes says whether any can touch the mold before the next look. While none can, nothing is
tested; else those pairs are in every step whose nodes have gone far enough from where the window began. A look trusts
the velocities; where one was wrong, so that a node may have touched unseen, the next one sees that it was, or the
window's end does, and the window is taken anew without trust in any look.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from jaxform.blocks import over_blocks
from jaxform.membrane import dot, gather, minus
from jaxform.near import TEST_BLOCK, Near

LOOK_EVERY = 4  # steps
_AHEAD = 2.0  # times as far as a node goes at its speed until the next look: where it may be before that


class Seen(NamedTuple):
    """What a look at the nodes finds.

    Whether any can touch a listed triangle before the next look; whether any may leave its ball till then; and whether
    one may have touched unseen before this one.
    """

    near: jax.Array
    leaving: jax.Array
    missed: jax.Array


class Due(NamedTuple):
    """Blocks of listed pairs that are tested: their numbers (n_block,), and how many they are."""

    block: jax.Array
    count: jax.Array


def unseen() -> Seen:
    """Before the first look at the nodes: any may touch."""
    return Seen(jnp.asarray(True), jnp.asarray(False), jnp.asarray(False))


def look(
    positions: Any,
    velocities: jax.Array,
    stuck: jax.Array,
    till_next: jax.Array,
    near: Near,
    last: Seen,
    node_block_count: jax.Array,
) -> Seen:
    """Looks at every node in use, and ahead.

    Args:
        positions: (3, n_node) or three times (n_node,) [m].
        velocities: (3, n_node) [m/s].
        stuck: Nodes (n_node,) that do not move any more.
        till_next: Time until the next look [s].
        near: The window's list.
        last: What the last look found.
        node_block_count: How many blocks of nodes are in use.
    """

    def work(stuck: Any, positions: Any, velocities: Any, balls: Any) -> Any:
        start, clear_square, near_square, center, alarm_square = balls
        there, beyond = (
            [x + ahead * till_next * v for x, v in zip(positions, velocities, strict=True)] for ahead in (1.0, _AHEAD)
        )
        comes_near = _gone(positions, start, near_square) | _gone(beyond, start, near_square)
        leaves = _gone(positions, center, alarm_square) | _gone(there, center, alarm_square)
        return [], [~stuck & found for found in (comes_near, leaves, _gone(positions, start, clear_square))]

    balls = near.start, near.clear_square, near.near_square, near.center, near.alarm_square
    inputs = stuck, positions, velocities, balls
    _, found = over_blocks(work, node_block_count, inputs, [], sums=3)
    comes_near, leaves, touches = (count > 0 for count in found)
    return Seen(comes_near, leaves, last.missed | touches & ~last.near)


def missed(positions: Any, stuck: jax.Array, balls: Any, last: Seen) -> jax.Array:
    """Which nodes (n,) may have missed the mold: out of their balls, or so far that they may have touched unseen.

    Args:
        positions: (3, n) [m].
        stuck: Nodes (n,) that do not move any more.
        balls: Of the window's list start, clear_square, center and limit_square at these nodes.
        last: What the last look found.
    """
    start, clear_square, center, limit_square = balls
    return ~stuck & (~last.near & _gone(positions, start, clear_square) | _gone(positions, center, limit_square))


def every_block(near: Near) -> Due:
    """All listed pairs."""
    return Due(jnp.arange(near.node.size // TEST_BLOCK, dtype=jnp.int32), -(-near.count // TEST_BLOCK))


def touching(positions: Any, stuck: jax.Array, near: Near, node_block_count: jax.Array) -> Due:
    """The blocks of pairs with any free node far enough from where the window began to touch; else as in `look`."""

    def work(stuck: Any, positions: Any, start: Any, clear_square: Any) -> Any:
        touches = ~stuck & _gone(positions, start, clear_square)
        return [[touches]], [touches]

    def put(block: jax.Array, due: Due) -> Due:
        first = block * TEST_BLOCK
        node = jax.lax.dynamic_slice_in_dim(near.node, first, TEST_BLOCK)
        used = first + jnp.arange(TEST_BLOCK) < near.count
        # What is not due is written over by the next one.
        blocks = jax.lax.dynamic_update_slice(due.block, block[None], (due.count,))
        return Due(blocks, due.count + jnp.any(used & gather(touches[0], node)))

    inputs, none = (stuck, positions, near.start, near.clear_square), jnp.zeros((1, stuck.size), bool)
    (touches,), (count,) = over_blocks(work, node_block_count, inputs, [none], sums=1)
    every = every_block(near)
    return jax.lax.fori_loop(0, jnp.where(count > 0, every.count, 0), put, Due(every.block, jnp.int32(0)))


def _gone(positions: Any, place: jax.Array, square: jax.Array) -> jax.Array:
    """Which nodes (n,) are as far from a place (3, n) [m] as the root of these squares (n,) [m^2], or farther."""
    gap = minus(positions, place)
    return dot(gap, gap) >= square

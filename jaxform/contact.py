"""Sticking contact: which nodes cross which triangle of the mold in a step, and where they land (paper, 3.2).

At a window's border the few pairs of node and triangle that can meet within the window are listed, with the
distance each node may travel before the list stops being complete. Inside the window only the listed pairs are
tested. The choice of the triangle carries no gradient; the landing point is then computed differentiably from it,
and since it is the point where the path meets the triangle, its gradient is that of the time of impact.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp

from jaxform.membrane import cross, dot, gather
from jaxform.mold import Mold, SearchGrid
from jaxform.pytree import pytree

# Pairs are worked through in blocks by loops that end when the pairs do: the cost follows the number of pairs, not
# the room for them, and nothing is compiled twice. No derivative goes through these loops.
_LIST_BLOCK = 512
_TEST_BLOCK = 128
_ROOM_PER_NODE = 16  # pairs that a window can hold, per node


@pytree
class Near:
    """What a window knows of the mold.

    Attributes:
        node, triangle: The pairs (room,) that can meet.
        planes: Geometry of the pairs' triangles (12, room).
        count: How many pairs there are.
        start: Positions (3, n_node) [m] at the border.
        limit: Distance (n_node,) [m] from there within which no triangle but the listed can be met.
        overflow: Whether pairs were lost, so that the window must not be trusted.
    """

    node: jax.Array
    triangle: jax.Array
    planes: jax.Array
    count: jax.Array
    start: jax.Array
    limit: jax.Array
    overflow: jax.Array


def expected_travel(velocities: jax.Array, duration: jax.Array, grid: SearchGrid) -> jax.Array:
    """How far (n_node,) [m] each node may well travel in a window; wrong guesses cost time, not truth.

    The fastest node's share covers what neighbours hand on, the cell's share the start from rest.
    """
    speed = jnp.sqrt(dot(velocities, velocities))
    return duration * (1.5 * speed + 0.25 * jnp.max(speed)) + 0.1 * grid.width


def leaving(positions: jax.Array, velocities: jax.Array, glance: jax.Array, near: Near) -> jax.Array:
    """Whether any node may leave the range of its list within the time `glance` [s]."""
    fastest = jnp.sqrt(jnp.max(dot(velocities, velocities)))
    room = jnp.maximum(near.limit - glance * fastest, 0.0)
    gap = positions - near.start
    return jax.lax.stop_gradient(jnp.any(dot(gap, gap) > jnp.square(room)))


def left(positions: jax.Array, near: Near) -> jax.Array:
    """Whether any node has left the range of its list, so that it may have missed the mold."""
    gap = positions - near.start
    return jnp.any(dot(gap, gap) > jnp.square(near.limit))


def list_near(positions: jax.Array, free: jax.Array, travel: jax.Array, mold: Mold, grid: SearchGrid) -> Near:
    """Lists the pairs of free nodes and triangles that are closer than the node may travel.

    Args:
        positions: (3, n_node) [m].
        free: Nodes (n_node,) that can still move.
        travel: Expected travel (n_node,) [m] within the window; the grid's reach limits it.
        mold: The mold.
        grid: Its search structure.
    """
    travel = jnp.minimum(travel, grid.width)
    cell = _cells(positions, grid)
    bound = grid.bound[cell]
    near = free & (bound < travel)
    limit = jnp.where(free, jnp.where(near, travel, bound), jnp.inf)
    end = jnp.cumsum(jnp.where(near, grid.start[cell + 1] - grid.start[cell], 0))
    shift = grid.start[cell + 1] - end
    # Whole blocks: a slice that reached beyond the end would be moved back.
    room = -(-_ROOM_PER_NODE * positions.shape[1] // _TEST_BLOCK) * _TEST_BLOCK
    lists = jnp.zeros((2, room), jnp.int32), jnp.zeros((12, room), positions.dtype), jnp.int32(0)

    def more(carry: tuple[jax.Array, tuple[jax.Array, ...]]) -> jax.Array:
        return carry[0] < end[-1]

    def list_block(carry: tuple[jax.Array, tuple[jax.Array, ...]]) -> tuple[jax.Array, tuple[jax.Array, ...]]:
        first, (pairs, planes, count) = carry
        slot = first + jnp.arange(_LIST_BLOCK, dtype=jnp.int32)
        node = jnp.minimum(jnp.searchsorted(end, slot, side="right"), end.size - 1).astype(jnp.int32)
        triangle = grid.listed[jnp.clip(slot + shift[node], 0, grid.listed.size - 1)]
        d, edge1, edge2 = _corners(mold, triangle)
        keep = (slot < end[-1]) & (_distance(gather(positions, node) - d, edge1, edge2) <= travel[node])
        # Where a pair goes; what is not kept, or finds no room, goes nowhere.
        place = jnp.where(keep, count + jnp.cumsum(keep) - 1, room)
        pairs = pairs.at[:, place].set(jnp.stack([node, triangle]), mode="drop")
        planes = planes.at[:, place].set(jnp.concatenate([d, *_dual(edge1, edge2)]), mode="drop")
        return first + _LIST_BLOCK, (pairs, planes, count + jnp.sum(keep, dtype=jnp.int32))

    _, (pairs, planes, count) = jax.lax.while_loop(more, list_block, (jnp.int32(0), lists))
    return Near(pairs[0], pairs[1], planes, jnp.minimum(count, room), positions, limit, count > room)


def _cells(positions: jax.Array, grid: SearchGrid) -> jax.Array:
    """Cell numbers (n_node,); a node outside the grid takes the nearest cell, whose bound holds for it too."""
    shape = jnp.asarray(grid.shape)
    index = jnp.floor((positions - grid.corner[:, None]) / grid.width).astype(jnp.int32)
    i, j, k = jnp.clip(index, 0, shape[:, None] - 1)
    return (i * grid.shape[1] + j) * grid.shape[2] + k


def _corners(mold: Mold, triangle: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
    """First vertex D and the edges DE and DF, each (3, n) [m]."""
    d, e, f = (mold.vertices[mold.triangles[triangle, k]].T for k in range(3))
    return d, e - d, f - d


def _distance(away: jax.Array, edge1: jax.Array, edge2: jax.Array) -> jax.Array:
    """Distance (n,) [m] from triangles to points that lie `away` (3, n) [m] from their first vertex."""
    normal, dual1, dual2 = _dual(edge1, edge2)
    gamma, delta = dot(away, dual1), dot(away, dual2)
    inside = (gamma >= 0) & (delta >= 0) & (gamma + delta <= 1)
    rim = jnp.minimum(_to_segment(away, edge1), _to_segment(away, edge2))
    rim = jnp.minimum(rim, _to_segment(away - edge1, edge2 - edge1))
    return jnp.where(inside, jnp.abs(dot(away, normal)), rim)


def _to_segment(away: jax.Array, along: jax.Array) -> jax.Array:
    t = jnp.clip(dot(away, along) / dot(along, along), 0.0, 1.0)
    gap = away - t * along
    return jnp.sqrt(dot(gap, gap))


def _dual(edge1: jax.Array, edge2: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Unit normal, and the vectors whose products with a point's offset are its gamma and delta (Eq. 10)."""
    normal = cross(edge1, edge2)
    square = dot(normal, normal)
    return normal / jnp.sqrt(square), cross(edge2, normal) / square, cross(normal, edge1) / square


def _meet(before: jax.Array, after: jax.Array, planes: jax.Array, touch: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Beta and whether the path from `before` to `after` meets the triangle, pair by pair (Eqs 9-12).

    A node within `touch` of the plane touches it, whichever way it goes; the triangle's edges are inclusive, so that
    no path leaks between two triangles.
    """
    d, normal, dual1, dual2 = planes[0:3], planes[3:6], planes[6:9], planes[9:12]
    height = dot(before - d, normal)
    fall = height - dot(after - d, normal)
    level = fall == 0.0
    beta = jnp.clip(height / jnp.where(level, 1.0, fall), 0.0, 1.0)
    touches = jnp.abs(height) <= touch
    crosses = ~level & (height * (height - fall) <= 0.0)
    point = before + beta * (after - before) - d
    gamma, delta = dot(point, dual1), dot(point, dual2)
    tolerance = 1e3 * jnp.finfo(planes.dtype).eps
    inside = (gamma >= -tolerance) & (delta >= -tolerance) & (gamma + delta <= 1.0 + tolerance)
    return beta, (touches | crosses) & inside


class Landing(NamedTuple):
    """Where the nodes are after contact: positions and velocities (3, n_node), stuck, contact_time (n_node,)."""

    positions: jax.Array
    velocities: jax.Array
    stuck: jax.Array
    contact_time: jax.Array
    loss: jax.Array


def land(
    before: jax.Array,
    landing: Landing,
    mass: jax.Array,
    time: jax.Array,
    near: Near,
    mold: Mold,
    grid: SearchGrid,
) -> Landing:
    """Puts the nodes that crossed the mold in this step where they met it; they stay there.

    Args:
        before: Positions (3, n_node) [m] before the step.
        landing: The state after the step as if there were no mold; `loss` is the kinetic energy lost so far [J].
        mass: (n_node,) [kg].
        time: At the end of the step [s].
        near: The window's list.
        mold: The mold.
        grid: Its search structure.
    """
    touch = 64 * jnp.finfo(before.dtype).eps * grid.size
    paths = jax.lax.stop_gradient((before, landing.positions))
    met = _any_meets(*paths, landing.stuck, near, touch)

    def pull(before: jax.Array, landing: Landing, mass: jax.Array, mold: Mold) -> Landing:
        chosen = _first_met(*jax.lax.stop_gradient((before, landing.positions)), landing.stuck, near, touch)
        return _landed(before, landing, mass, time, mold, chosen)

    return jax.lax.cond(met, jax.checkpoint(pull), lambda _, landing, *__: landing, before, landing, mass, mold)


def _block(
    first: jax.Array, before: jax.Array, after: jax.Array, stuck: jax.Array, near: Near, touch: jax.Array
) -> tuple[jax.Array, jax.Array, jax.Array, jax.Array]:
    """Node, triangle, beta and whether they meet, (block,) each, of the pairs from `first` on."""

    def cut(values: jax.Array) -> jax.Array:
        return jax.lax.dynamic_slice_in_dim(values, first, _TEST_BLOCK, axis=-1)

    node = cut(near.node)
    beta, meets = _meet(gather(before, node), gather(after, node), cut(near.planes), touch)
    used = first + jnp.arange(_TEST_BLOCK) < near.count
    return node, cut(near.triangle), beta, meets & used & ~stuck[node]


def _any_meets(before: jax.Array, after: jax.Array, stuck: jax.Array, near: Near, touch: jax.Array) -> jax.Array:
    """Whether any listed pair meets in this step; looks no further than the first block where one does."""

    def more(carry: tuple[jax.Array, jax.Array]) -> jax.Array:
        return (carry[0] < near.count) & ~carry[1]

    def test(carry: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        return carry[0] + _TEST_BLOCK, jnp.any(_block(carry[0], before, after, stuck, near, touch)[3])

    return jax.lax.while_loop(more, test, (jnp.int32(0), jnp.asarray(False)))[1]


def _first_met(before: jax.Array, after: jax.Array, stuck: jax.Array, near: Near, touch: jax.Array) -> jax.Array:
    """The triangle (n_node,) that each node meets first in this step, -1 where none.

    Of two that are met at once the one with the higher number counts, every time.
    """
    none = jnp.full(stuck.size, jnp.inf, before.dtype), jnp.full(stuck.size, -1, jnp.int32)

    def more(carry: tuple[jax.Array, tuple[jax.Array, jax.Array]]) -> jax.Array:
        return carry[0] < near.count

    def choose(
        carry: tuple[jax.Array, tuple[jax.Array, jax.Array]],
    ) -> tuple[jax.Array, tuple[jax.Array, jax.Array]]:
        first, (best, chosen) = carry
        node, triangle, beta, meets = _block(first, before, after, stuck, near, touch)
        better = best.at[node].min(jnp.where(meets, beta, jnp.inf))
        chosen = jnp.where(better < best, -1, chosen)
        chosen = chosen.at[node].max(jnp.where(meets & (beta == better[node]), triangle, -1))
        return first + _TEST_BLOCK, (better, chosen)

    return jax.lax.while_loop(more, choose, (jnp.int32(0), none))[1][1]


def _landed(
    before: jax.Array, landing: Landing, mass: jax.Array, time: jax.Array, mold: Mold, chosen: jax.Array
) -> Landing:
    """The landing on the chosen triangles (n_node,); differentiable."""
    lands = chosen >= 0
    point = _landing_point(before, landing.positions, mold, jnp.maximum(chosen, 0), lands)
    kinetic = 0.5 * mass * dot(landing.velocities, landing.velocities)
    return Landing(
        positions=jnp.where(lands, point, landing.positions),
        velocities=jnp.where(lands, 0.0, landing.velocities),
        stuck=landing.stuck | lands,
        contact_time=jnp.where(lands, time, landing.contact_time),
        loss=landing.loss + jnp.sum(jnp.where(lands, kinetic, 0.0)),
    )


def _landing_point(before: jax.Array, after: jax.Array, mold: Mold, triangle: jax.Array, lands: jax.Array) -> jax.Array:
    """M of the paper's Eq. 9, (3, n_node) [m], differentiable in the path and the mold."""
    d, edge1, edge2 = _corners(mold, triangle)
    normal = cross(edge1, edge2)
    height = dot(before - d, normal)
    fall = -dot(after - before, normal)
    # A path within the plane touches it where it begins; both `where` keep its gradient finite.
    crosses = lands & (fall != 0.0)
    ratio = height / jnp.where(crosses, fall, 1.0)
    beta = jnp.where(crosses, jnp.clip(ratio, 0.0, 1.0), 0.0)
    return before + beta * (after - before)

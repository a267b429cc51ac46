"""Sticking contact: which nodes cross which triangle of the mold in a step, and where they land (paper, 3.2).

At a window's border the few pairs of node and triangle that can meet within the window are listed, with the
distance each node may travel before the list stops being complete. Inside the window only the listed pairs are
tested. The choice of the triangle carries no gradient; the landing point is then computed differentiably from it,
and since it is the point where the path meets the triangle, its gradient is that of the time of impact.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from jaxform.membrane import cross, dot, gather
from jaxform.mold import Mold, SearchGrid

_LISTED_PER_NODE = (1, 4, 24)  # capacities of the first listing, by cell, in pairs per node
_TESTED_PER_NODE = (0.25, 1, 6)  # capacities of the list that is tested in every step


class Near(NamedTuple):
    """What a window knows of the mold.

    Attributes:
        node, triangle: The pairs (capacity,) that can meet; the unused ones have `used` False.
        used: (capacity,).
        planes: Geometry of the pairs' triangles (12, capacity).
        rung: Which of the short ladder of capacities holds them; 0 is none at all.
        start: Positions (3, n_node) [m] at the border.
        limit: Distance (n_node,) [m] from there within which no triangle but the listed can be met.
        overflow: Whether pairs were lost, so that the window must not be trusted.
    """

    node: jax.Array
    triangle: jax.Array
    used: jax.Array
    planes: jax.Array
    rung: jax.Array
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


def _capacities(per_node: tuple[float, ...], node_count: int) -> list[int]:
    return [max(64, int(k * node_count)) for k in per_node]


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
    limit = jnp.where(near, travel, bound)
    count = jnp.where(near, grid.start[cell + 1] - grid.start[cell], 0)
    total = jnp.sum(count)
    capacities = _capacities(_LISTED_PER_NODE, positions.shape[1])
    rung = jnp.searchsorted(jnp.asarray([0, *capacities]), total)
    kept = _capacities(_TESTED_PER_NODE, positions.shape[1])
    branches = [_nothing(kept[-1])]
    branches += [_lister(capacity, kept[-1]) for capacity in capacities]
    node, triangle, used, tested = jax.lax.switch(
        jnp.minimum(rung, len(capacities)),
        branches,
        positions,
        travel,
        count,
        grid.start[cell],
        mold,
        grid.listed,
    )
    planes = _planes(mold, triangle)
    return Near(
        node=node,
        triangle=triangle,
        used=used,
        planes=planes,
        rung=jnp.minimum(jnp.searchsorted(jnp.asarray([0, *kept]), tested), len(kept)),
        start=positions,
        limit=jnp.where(free, limit, jnp.inf),
        overflow=(rung > len(capacities)) | (tested > kept[-1]),
    )


def _cells(positions: jax.Array, grid: SearchGrid) -> jax.Array:
    """Cell numbers (n_node,); a node outside the grid takes the nearest cell, whose bound holds for it too."""
    shape = jnp.asarray(grid.shape)
    index = jnp.floor((positions - grid.corner[:, None]) / grid.width).astype(jnp.int32)
    i, j, k = jnp.clip(index, 0, shape[:, None] - 1)
    return (i * grid.shape[1] + j) * grid.shape[2] + k


def _nothing(kept: int) -> Callable[..., Any]:
    zeros = jnp.zeros(kept, jnp.int32)
    return lambda *_: (zeros, zeros, zeros.astype(bool), jnp.int32(0))


def _lister(capacity: int, kept: int) -> Callable[..., Any]:
    """Expands the near nodes' lists into at most `capacity` pairs and keeps those within the node's travel."""

    def pairs(
        positions: jax.Array,
        travel: jax.Array,
        count: jax.Array,
        start: jax.Array,
        mold: Mold,
        listed: jax.Array,
    ) -> tuple[jax.Array, ...]:
        end = jnp.cumsum(count)
        slot = jnp.arange(capacity)
        node = jnp.repeat(jnp.arange(count.size), count, total_repeat_length=capacity)
        triangle = listed[jnp.clip(start[node] + slot - (end - count)[node], 0, listed.size - 1)]
        distance = _distance(gather(positions, node), mold, triangle)
        keep = (slot < end[-1]) & (distance <= travel[node])
        (index,) = jnp.nonzero(keep, size=kept, fill_value=0)
        tested = jnp.sum(keep)
        return (
            node[index].astype(jnp.int32),
            triangle[index],
            jnp.arange(kept) < tested,
            tested.astype(jnp.int32),
        )

    return pairs


def _corners(mold: Mold, triangle: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
    """First vertex D and the edges DE and DF, each (3, n) [m]."""
    d, e, f = (mold.vertices[mold.triangles[triangle, k]].T for k in range(3))
    return d, e - d, f - d


def _distance(points: jax.Array, mold: Mold, triangle: jax.Array) -> jax.Array:
    """Distance (n,) [m] of points (3, n) to their triangles."""
    d, edge1, edge2 = _corners(mold, triangle)
    away = points - d
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


def _planes(mold: Mold, triangle: jax.Array) -> jax.Array:
    """First vertex, unit normal and the two dual vectors of each pair's triangle, (12, capacity)."""
    d, edge1, edge2 = _corners(mold, triangle)
    return jnp.concatenate([d, *_dual(edge1, edge2)])


def _meet(
    before: jax.Array, after: jax.Array, planes: jax.Array, touch: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """beta and whether the path from `before` to `after` meets the triangle, pair by pair (Eqs 9-12).

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
    capacities = _capacities(_TESTED_PER_NODE, before.shape[1])
    touch = 64 * jnp.finfo(before.dtype).eps * grid.size
    fixed = jax.lax.stop_gradient((before, landing.positions, landing.stuck, near))
    tests = [lambda *_: jnp.asarray(False)] + [_tester(capacity, touch) for capacity in capacities]
    met = jax.lax.switch(near.rung, tests, *fixed)
    pulls = [lambda _before, landing, *_: landing] + [_lander(capacity, touch) for capacity in capacities]
    return jax.lax.switch(jnp.where(met, near.rung, 0), pulls, before, landing, mass, time, near, mold)


def _hits(
    before: jax.Array, after: jax.Array, stuck: jax.Array, near: Near, capacity: int, touch: jax.Array
) -> tuple[jax.Array, jax.Array]:
    node = near.node[:capacity]
    beta, meets = _meet(gather(before, node), gather(after, node), near.planes[:, :capacity], touch)
    return beta, meets & near.used[:capacity] & ~stuck[node]


def _tester(capacity: int, touch: jax.Array) -> Callable[..., jax.Array]:
    return lambda before, after, stuck, near: jnp.any(_hits(before, after, stuck, near, capacity, touch)[1])


def _lander(capacity: int, touch: jax.Array) -> Callable[..., Landing]:
    """The landing itself; rare, so it may look at all nodes."""

    def pull(
        before: jax.Array, landing: Landing, mass: jax.Array, time: jax.Array, near: Near, mold: Mold
    ) -> Landing:
        fixed = jax.lax.stop_gradient((before, landing.positions))
        beta, hit = _hits(*fixed, landing.stuck, near, capacity, touch)
        node = near.node[:capacity]
        first = jnp.full(before.shape[1], jnp.inf, before.dtype).at[node].min(jnp.where(hit, beta, jnp.inf))
        # Of the walls met in this step the first counts; of equals the one with the highest number, every time.
        best = jnp.where(hit & (beta == first[node]), near.triangle[:capacity], -1)
        chosen = jnp.full(before.shape[1], -1, jnp.int32).at[node].max(best)
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

    return jax.checkpoint(pull)


def _landing_point(
    before: jax.Array, after: jax.Array, mold: Mold, triangle: jax.Array, lands: jax.Array
) -> jax.Array:
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

"""New nodes at the mold: where an element cut a corner of it, the middle of its side may be beyond.

The mold's near side is the one from which the nodes came that stick to it. A new node is judged by the place of the
mold that is nearest to it: beyond, it is put there; on it, it sticks where its edge's ends do; before it, it is free.
"""

from __future__ import annotations

import dataclasses
from typing import NamedTuple

import jax
import jax.numpy as jnp

from jaxform import near
from jaxform.blocks import listed
from jaxform.body import Mesh
from jaxform.membrane import cross, dot
from jaxform.mold import Mold
from jaxform.scene import Forest, Scene
from jaxform.search import SearchGrid
from jaxform.state import State

_LANES = 64  # nodes that are looked at together
_FARTHEST = 0.5  # of its edge, that a new node is moved


class _Nearest(NamedTuple):
    """The nearest triangle's number (n,), -1 where none is within reach, its distance and height over its plane [m]."""

    triangle: jax.Array
    distance: jax.Array
    height: jax.Array


class Births(NamedTuple):
    """Which places (n,) have a new node, and the places of its edge's ends; any other place is both of its ends."""

    new: jax.Array
    first: jax.Array
    second: jax.Array


def births_of(old: Mesh, mesh: Mesh, forest: Forest) -> Births:
    """What a mesh has that the old one had not."""
    place = jnp.arange(mesh.node.size)
    new = (place >= old.node_count) & (place < mesh.node_count)
    return Births(new, *(jnp.where(new, mesh.place[end], place) for end in forest.ends[:, mesh.node]))


def settled(state: State, births: Births, scene: Scene) -> State:
    """The state with the new nodes that are on the mold, or beyond it, put there; differentiable in their positions."""
    mold, grid, forest = scene.mold, scene.tables.grid, scene.tables.forest
    if mold is None or grid is None or forest is None:
        return state
    new, first, second = births
    positions = jax.lax.stop_gradient(state.positions)
    found = _nearest(positions, new & ~state.stuck, grid)
    side = _near_side(state.wall, found.triangle, forest)
    edge = positions[:, first] - positions[:, second]
    reachable = found.distance <= _FARTHEST * jnp.sqrt(dot(edge, edge))
    touches = new & (side != 0) & (found.distance <= near.touch_distance(grid))
    beyond = new & (side * found.height < 0) & reachable & ~touches

    def sticks(stuck: jax.Array, _: None) -> tuple[jax.Array, None]:
        # A new node can be the end of a newer one's edge.
        return stuck | beyond | touches & stuck[first] & stuck[second], None

    stuck, _ = jax.lax.scan(sticks, state.stuck, length=forest.depth)
    lands = stuck & ~state.stuck
    triangle = jnp.maximum(found.triangle, 0)
    point = _closest(state.positions, mold, triangle, lands)
    return dataclasses.replace(
        state,
        positions=jnp.where(lands, point, state.positions),
        velocities=jnp.where(lands, 0.0, state.velocities),
        stuck=stuck,
        contact_time=jnp.where(lands, state.time, state.contact_time),
        wall=jnp.where(lands, side * (triangle + 1), state.wall),
    )


def _near_side(wall: jax.Array, triangle: jax.Array, forest: Forest) -> jax.Array:
    """1 or -1 (n,) where the sheet is on the side of a triangle's normal or the other; 0 where nothing is known."""
    assert forest.turn is not None and forest.part is not None
    touched = jnp.maximum(jnp.abs(wall) - 1, 0)
    votes = jnp.zeros(forest.part_count, jnp.int32)
    votes = votes.at[forest.part[touched]].add(jnp.sign(wall) * forest.turn[touched])
    chosen = jnp.maximum(triangle, 0)
    return jnp.where(triangle >= 0, jnp.sign(votes[forest.part[chosen]]) * forest.turn[chosen], 0)


def _nearest(positions: jax.Array, wanted: jax.Array, grid: SearchGrid) -> _Nearest:
    """The nearest triangle to each wanted node; of equally near ones, the one that looks at it most squarely."""
    count = positions.shape[1]
    rows = -(-count // _LANES) * _LANES
    node, total = listed(wanted, rows)
    cells = near.cells(positions, grid)
    tie = 1e-9 * grid.size

    def more_nodes(carry: tuple[jax.Array, _Nearest]) -> jax.Array:
        return carry[0] < total

    def look(carry: tuple[jax.Array, _Nearest]) -> tuple[jax.Array, _Nearest]:
        first, found = carry
        lane = jax.lax.dynamic_slice_in_dim(node, first, _LANES)
        point, cell = positions[:, lane], cells[lane]
        begin = grid.start[cell]
        length = jnp.where(first + jnp.arange(_LANES) < total, grid.start[cell + 1] - begin, 0)

        def more(carry: tuple[jax.Array, _Nearest]) -> jax.Array:
            return carry[0] < jnp.max(length)

        def compare(carry: tuple[jax.Array, _Nearest]) -> tuple[jax.Array, _Nearest]:
            k, best = carry
            row = grid.listed[jnp.where(k < length, begin + k, 0)]
            frame = grid.frames[row]
            distance, height = near.distance(point, frame), dot(point - frame[:, :3].T, frame[:, 3:6].T)
            closer = distance < best.distance - tie
            squarer = (distance <= best.distance + tie) & (jnp.abs(height) > jnp.abs(best.height))
            take = (k < length) & (closer | squarer)
            new = grid.number[row], distance, height
            return k + 1, _Nearest(*(jnp.where(take, a, b) for a, b in zip(new, best, strict=True)))

        start = _Nearest(*(jnp.broadcast_to(value, (_LANES,)) for value in _nothing(positions.dtype)))
        _, best = jax.lax.while_loop(more, compare, (jnp.int32(0), start))
        mine = jnp.where(first + jnp.arange(_LANES) < total, lane, count)
        put = [old.at[mine].set(value, mode="drop") for old, value in zip(found, best, strict=True)]
        return first + _LANES, _Nearest(*put)

    nothing = _Nearest(*(jnp.full(count, value) for value in _nothing(positions.dtype)))
    return jax.lax.while_loop(more_nodes, look, (jnp.int32(0), nothing))[1]


def _nothing(real: jnp.dtype) -> tuple[jax.Array, jax.Array, jax.Array]:
    return jnp.int32(-1), jnp.asarray(jnp.inf, real), jnp.asarray(0.0, real)


def _closest(positions: jax.Array, mold: Mold, triangle: jax.Array, lands: jax.Array) -> jax.Array:
    """The point (3, n) [m] of each node's triangle that is nearest to it; differentiable where it lands."""
    d, e, f = (mold.vertices[mold.triangles[triangle, k]].T for k in range(3))
    edge1, edge2 = e - d, f - d
    normal = jnp.stack(cross(edge1, edge2))
    square = dot(normal, normal)
    away = jnp.where(lands, positions - d, 0.0)
    gamma = dot(cross(away, edge2), normal) / square
    delta = dot(cross(edge1, away), normal) / square
    flat = d + gamma * edge1 + delta * edge2
    inside = (gamma >= 0) & (delta >= 0) & (gamma + delta <= 1)
    candidates = [_on_segment(positions, *ends) for ends in ((d, e), (e, f), (f, d))]
    best = candidates[0]
    for other in candidates[1:]:
        gaps = [positions - point for point in (other, best)]
        nearer = dot(gaps[0], gaps[0]) < dot(gaps[1], gaps[1])
        best = jnp.where(nearer, other, best)
    return jnp.where(inside, flat, best)


def _on_segment(points: jax.Array, begin: jax.Array, end: jax.Array) -> jax.Array:
    along = end - begin
    return begin + jnp.clip(dot(points - begin, along) / dot(along, along), 0.0, 1.0) * along

"""The nearest place of the mold: of points, and on a chosen triangle, differentiably."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp

from jaxform.contact.cells import cell_of
from jaxform.contact.cells import distance as distance_to
from jaxform.kernels.blocks import compact_indices, slice_at
from jaxform.mechanics.membrane import cross, dot
from jaxform.tools.mold import Mold
from jaxform.tools.search import SearchGrid

_LANES = 64  # nodes that are processed together


class NearestTriangle(NamedTuple):
    """The nearest triangle's number (n,), -1 where none is within reach, its distance and height over its plane [m]."""

    triangle: jax.Array
    distance: jax.Array
    height: jax.Array


def nearest_triangle(positions: jax.Array, wanted: jax.Array, grid: SearchGrid) -> NearestTriangle:
    """The nearest triangle to each wanted node; of equally near ones, the one that faces it most squarely."""
    count = positions.shape[1]
    rows = -(-count // _LANES) * _LANES
    node, total = compact_indices(wanted, rows)
    cells = cell_of(positions, grid)
    tie = 1e-9 * grid.size

    def more_nodes(carry: tuple[jax.Array, NearestTriangle]) -> jax.Array:
        return carry[0] < total

    def search_nodes(carry: tuple[jax.Array, NearestTriangle]) -> tuple[jax.Array, NearestTriangle]:
        first, found = carry
        lane = slice_at(node, first, _LANES)
        point, cell = positions[:, lane], cells[lane]
        begin = grid.start[cell]
        length = jnp.where(first + jnp.arange(_LANES) < total, grid.start[cell + 1] - begin, 0)

        def more(carry: tuple[jax.Array, NearestTriangle]) -> jax.Array:
            return carry[0] < jnp.max(length)

        def compare(carry: tuple[jax.Array, NearestTriangle]) -> tuple[jax.Array, NearestTriangle]:
            k, best = carry
            row = grid.listed[jnp.where(k < length, begin + k, 0)]
            frame = grid.frames[row]
            distance, height = distance_to(point, frame), dot(point - frame[:, :3].T, frame[:, 3:6].T)
            closer = distance < best.distance - tie
            squarer = (distance <= best.distance + tie) & (jnp.abs(height) > jnp.abs(best.height))
            take = (k < length) & (closer | squarer)
            new = grid.number[row], distance, height
            return k + 1, NearestTriangle(*(jnp.where(take, a, b) for a, b in zip(new, best, strict=True)))

        start = NearestTriangle(*(jnp.broadcast_to(value, (_LANES,)) for value in _no_triangle(positions.dtype)))
        _, best = jax.lax.while_loop(more, compare, (jnp.int32(0), start))
        mine = jnp.where(first + jnp.arange(_LANES) < total, lane, count)
        put = [old.at[mine].set(value, mode="drop") for old, value in zip(found, best, strict=True)]
        return first + _LANES, NearestTriangle(*put)

    nothing = NearestTriangle(*(jnp.full(count, value) for value in _no_triangle(positions.dtype)))
    return jax.lax.while_loop(more_nodes, search_nodes, (jnp.int32(0), nothing))[1]


def _no_triangle(real: jnp.dtype) -> tuple[jax.Array, jax.Array, jax.Array]:
    return jnp.int32(-1), jnp.asarray(jnp.inf, real), jnp.asarray(0.0, real)


def closest_place(positions: jax.Array, mold: Mold, triangle: jax.Array, lands: jax.Array) -> jax.Array:
    """The point (3, n) [m] of each node's triangle that is nearest to it; differentiable where it `lands`."""
    d, e, f = (mold.vertices[mold.triangles[triangle, k]].T for k in range(3))
    edge1, edge2 = e - d, f - d
    normal = jnp.stack(cross(edge1, edge2))
    square = dot(normal, normal)
    away = jnp.where(lands, positions - d, 0.0)
    gamma = dot(cross(away, edge2), normal) / square
    delta = dot(cross(edge1, away), normal) / square
    flat = d + gamma[None] * edge1 + delta[None] * edge2
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
    return begin + jnp.clip(dot(points - begin, along) / dot(along, along), 0.0, 1.0)[None] * along

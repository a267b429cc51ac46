"""Cells of points in the mold's search grid, and distances of points from its triangles."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from jaxform.kernels.blocks import materialize
from jaxform.mechanics.membrane import dot
from jaxform.tools.search import FarCells, SearchGrid


def cell_of(positions: jax.Array, grid: SearchGrid | FarCells, parts: jax.Array | int = 1) -> jax.Array:
    """Cell numbers (n,) of positions (3, n) [m]; outside the grid the nearest cell's, whose bound and list hold too.

    The cells may be cut into so many parts along each axis.
    """
    shape = parts * grid.shape
    place = jnp.floor((positions - grid.corner[:, None]) * (parts / grid.width)).astype(jnp.int32)
    i, j, k = jnp.clip(place, 0, shape[:, None] - 1)
    return (i * shape[1] + j) * shape[2] + k


def cell_bounds(positions: jax.Array, grid: SearchGrid) -> tuple[jax.Array, jax.Array]:
    """Cell numbers and lower bounds on the distance to the mold [m], each (n_node,)."""
    cell = cell_of(positions, grid)
    place = (positions - grid.corner[:, None]) / grid.width
    outside = place - jnp.clip(place, 0.0, grid.shape.astype(place.dtype)[:, None])
    return cell, jnp.maximum(grid.bound[cell], grid.width * jnp.sqrt(dot(outside, outside)))


def distance_bound(points: jax.Array, triangle: jax.Array, grid: SearchGrid) -> jax.Array:
    """Lower bound (n, k) [m] on the distance of points (3, n) from triangles (n, k): their spheres and planes."""
    # Whole rows at once, and once: they are far apart in memory.
    rows = materialize(rows_of_table(grid.outlines, triangle))
    x, y, z = points[:, :, None]
    a, b, c = x - rows[..., 0], y - rows[..., 1], z - rows[..., 2]
    outside = jnp.sqrt(a * a + b * b + c * c) - rows[..., 3]
    height = x * rows[..., 4] + y * rows[..., 5] + z * rows[..., 6] - rows[..., 7]
    return jnp.maximum(outside, jnp.abs(height)) - touch_distance(grid)


def distance(points: jax.Array, frame: jax.Array) -> jax.Array:
    """Distance (n,) [m] of points (3, n) from triangles of frames (n, 18), pair by pair."""
    d, normal, dual1, dual2, edge1, edge2 = frame.T.reshape(6, 3, -1)
    away = points - d
    gamma, delta = dot(away, dual1), dot(away, dual2)
    inside = (gamma >= 0) & (delta >= 0) & (gamma + delta <= 1)
    rim = jnp.minimum(_to_segment(away, edge1), _to_segment(away, edge2))
    rim = jnp.minimum(rim, _to_segment(away - edge1, edge2 - edge1))
    return jnp.where(inside, jnp.abs(dot(away, normal)), jnp.sqrt(rim))


def _to_segment(away: jax.Array, along: jax.Array) -> jax.Array:
    """Squared distance (n,) [m^2] from segments to points, both from the segments' begin."""
    t = jnp.clip(dot(away, along) / dot(along, along), 0.0, 1.0)
    gap = away - t[None] * along
    return dot(gap, gap)


def touch_distance(grid: SearchGrid) -> jax.Array:
    """Distance [m] from a plane within which a node touches it: rounding, relative to the size of the mold."""
    return 64 * jnp.finfo(grid.size.dtype).eps * grid.size


def rows_of_table(table: jax.Array, triangle: jax.Array) -> jax.Array:
    """Gathers rows (..., k) of a table (n, k), as `gather` does entries."""
    return table.at[triangle].get(mode="promise_in_bounds", wrap_negative_indices=False)

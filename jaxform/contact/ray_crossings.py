"""Ray casting: crossings of the mold with paths between two places. No derivative is taken.

A place is on the sheet's side of the mold if the path to it, from a node on that side, crosses the mold an even number
of times. Nothing else is required of the mold: it may be open, in pieces, and its triangles may turn either way.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp

from jaxform.kernels.blocks import compact_indices, materialize, slice_at
from jaxform.mechanics.membrane import dot
from jaxform.tools import search
from jaxform.tools.search import SearchGrid

_LANES = 64  # paths that are searched together
_APART = 16  # times the distance at which a node touches: crossings that are nearer to each other are one


Crossings = tuple[jax.Array, jax.Array, jax.Array]
"""The crossings of paths with the mold.

The number of crossings of each path (n,), the triangle that it crosses last, -1 where none, and 1 or -1 where it
reaches that from the side of its normal or from the other.
"""


def ray_crossings(begin: jax.Array, end: jax.Array, wanted: jax.Array, grid: SearchGrid) -> Crossings:
    """Finds the crossings of the mold with straight paths.

    Args:
        begin: Begins of the paths (3, n) [m]; a crossing there does not count.
        end: Ends of the paths (3, n) [m]; a crossing there does not count.
        wanted: Mask (n,) of the paths to search.
        grid: The mold's search structure.
    """
    count = begin.shape[1]
    node, total = compact_indices(wanted, -(-count // _LANES) * _LANES)

    def more(carry: tuple[jax.Array, Crossings]) -> jax.Array:
        return carry[0] < total

    def search_ways(carry: tuple[jax.Array, Crossings]) -> tuple[jax.Array, Crossings]:
        first, all_found = carry
        lane = slice_at(node, first, _LANES)
        used = first + jnp.arange(_LANES) < total
        found = _trace_ways(begin[:, lane], end[:, lane], used, grid)
        mine = jnp.where(used, lane, count)
        counts, triangles, sides = (
            old.at[mine].set(value, mode="drop") for old, value in zip(all_found, found, strict=True)
        )
        return first + _LANES, (counts, triangles, sides)

    return jax.lax.while_loop(more, search_ways, (jnp.int32(0), _no_crossings(count)))[1]


def _no_crossings(count: int) -> Crossings:
    none = jnp.zeros(count, jnp.int32)
    return none, none - 1, none


def _trace_ways(begin: jax.Array, end: jax.Array, used: jax.Array, grid: SearchGrid) -> Crossings:
    """The crossings of a few paths (3, lanes), computed side by side."""
    path = end - begin
    length = jnp.sqrt(dot(path, path))
    unit = path / jnp.maximum(length, jnp.finfo(length.dtype).tiny)[None]
    apart = _APART * search.touch_distance(grid)
    last = length - apart

    def more(carry: tuple[jax.Array, Crossings]) -> jax.Array:
        return jnp.any(used & (carry[0] < last))

    def step(carry: tuple[jax.Array, Crossings]) -> tuple[jax.Array, Crossings]:
        way, (count, triangles, sides) = carry  # the distance [m] searched so far, and the crossings found
        cell, bound = search.cell_bounds(begin + way[None] * unit, grid)
        # All that is within reach of its cell is listed there, and nothing is nearer than the bound.
        till = jnp.minimum(way + jnp.maximum(bound, grid.reach), last)
        met, triangle, side = _first_crossing(begin, unit, way, till, cell, grid)
        hit = used & (met < jnp.inf)
        found = (count + hit, jnp.where(hit, triangle, triangles), jnp.where(hit, side, sides))
        # Behind a crossing the rest is searched.
        return jnp.where(hit, met + apart, till), found

    start = jnp.full_like(length, apart), _no_crossings(length.size)
    return jax.lax.while_loop(more, step, start)[1]


def _first_crossing(
    begin: jax.Array, unit: jax.Array, low: jax.Array, high: jax.Array, cell: jax.Array, grid: SearchGrid
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """The first crossing of each path (lanes,) between two distances [m] in its cell: distance, triangle, side."""
    first, end = grid.start[cell], grid.start[cell + 1]
    tolerance = 1e3 * jnp.finfo(unit.dtype).eps

    def more(carry: tuple[jax.Array, tuple[jax.Array, ...]]) -> jax.Array:
        return carry[0] < jnp.max(end - first)

    def compare(carry: tuple[jax.Array, tuple[jax.Array, ...]]) -> tuple[jax.Array, tuple[jax.Array, ...]]:
        k, (best, chosen, side) = carry
        row = grid.listed[jnp.where(first + k < end, first + k, 0)]
        d, normal, dual1, dual2 = grid.frames[row, :12].T.reshape(4, 3, -1)
        slope = dot(unit, normal)
        level = slope == 0.0
        met = -dot(begin - d, normal) / jnp.where(level, 1.0, slope)
        away = begin + met[None] * unit - d
        gamma, delta = dot(away, dual1), dot(away, dual2)
        inside = (gamma >= -tolerance) & (delta >= -tolerance) & (gamma + delta <= 1.0 + tolerance)
        closer = (first + k < end) & ~level & inside & (met > low) & (met <= high) & (met < best)
        # All three use the same mask, also where rounding decides.
        closer = materialize(closer)
        new = met, grid.number[row], jnp.where(slope < 0.0, 1, -1)
        return k + 1, tuple(jnp.where(closer, a, b) for a, b in zip(new, (best, chosen, side), strict=True))

    none = jnp.zeros(unit.shape[1], jnp.int32)
    start = jnp.full(unit.shape[1], jnp.inf, unit.dtype), none, none
    met, triangle, side = jax.lax.while_loop(more, compare, (jnp.int32(0), start))[1]
    return met, triangle, side

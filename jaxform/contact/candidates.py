"""Which nodes can meet which triangles of the mold within the next steps.

Each node gets a sphere in which it is expected to stay: about the middle of its expected path. The pairs of node and
triangle that can meet in such a sphere are listed, and with each node how far it can go before it touches anything. The
list holds until a node is about to leave its sphere; then another is made, as in Verlet's lists of neighbours. It is
made for the rest of the window, or for fewer steps where that would be much more work than those steps are.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from jaxform.contact.broad_phase import LOOK_EVERY
from jaxform.contact.cells import cell_of, distance, distance_bound, looked_up, rows_of_table, touch_distance
from jaxform.contact.lists import DEPTH, LANES, TEST_BLOCK, Candidates, Lists, no_lists
from jaxform.core.pytree import pytree
from jaxform.kernels.blocks import BLOCK, cut, listed, lowered, once, only_if, over_blocks, put
from jaxform.mechanics.membrane import dot, gather
from jaxform.tools.search import CLASSES, FarCells, SearchGrid

# Pairs are worked through in blocks by loops that end when the pairs do: the cost follows the number of pairs, not
# the room for them, and nothing is compiled twice. No derivative goes through these loops.
_MARGIN = 0.15  # of the expected half path, of the longest path and of the grid's reach, added to the spheres
# How far before a node leaves its sphere the list ends: of its expected path, of the sphere's radius, and of the way
# of the fastest node in a step: any may become as fast.
_GLANCE, _ALARM, _LEAP = 0.05, 0.1, 1.5
_FEWEST_STEPS = 16  # that a list is made for
_WORTH = 8  # for so many steps of a node a list may look at one triangle
_MOST_ATTEMPTS = 13  # to shorten the paths, then to shrink the spheres, until the pairs find room


@pytree
class _Spheres:
    """Where the nodes are expected: centers (3, n_node) and radii (n_node,) [m].

    Each with the place in the grid's lists where the triangles begin that it may meet, and where they end; and whether
    the mold may be in it.
    """

    center: jax.Array
    radius: jax.Array
    begin: jax.Array
    end: jax.Array
    near: jax.Array


class _Pairs(NamedTuple):
    """Pairs of node and triangle, each (room + block,), and how many; beyond the room they are only counted."""

    node: jax.Array
    triangle: jax.Array
    count: jax.Array


def _with(found: _Pairs, node: jax.Array, triangle: jax.Array, more: jax.Array) -> _Pairs:
    """With a block of pairs (n,) after those found, of which the first `more` count; what finds no room is lost."""
    return _Pairs(put(found.node, node, found.count), put(found.triangle, triangle, found.count), found.count + more)


class _Found(NamedTuple):
    """What is found in so many attempts: the pairs that may meet and those that can, with planes and clear distance.

    And the spheres, as `Lists` has them; and whether the pairs were not even looked for, since they are too many.
    """

    attempts: jax.Array
    dear: jax.Array
    coarse: _Pairs
    kept: _Pairs
    planes: jax.Array
    clear: jax.Array
    spheres: tuple[jax.Array, jax.Array, jax.Array]


def list_candidates(
    positions: jax.Array,
    velocities: jax.Array,
    free: jax.Array,
    length: jax.Array,
    steps: jax.Array,
    grid: SearchGrid,
    skip_far: bool = True,
    into: Lists | None = None,
    blocks: jax.Array | None = None,
) -> Candidates:
    """Lists the pairs of free nodes and triangles that may meet.

    Args:
        positions: (3, n_node) [m]; whole blocks of nodes.
        velocities: (3, n_node) [m/s].
        free: Nodes (n_node,) that can still move.
        length: Of a step [s].
        steps: How many are to come, at most; a wrong guess of the paths costs time, not truth.
        grid: The mold's search structure.
        skip_far: Whether the spheres are as small as the paths allow; else they are as large as the grid allows.
        into: What is written over, such as an old list's; a new one by default.
        blocks: How many blocks of nodes are in use; all by default.
    """
    into = into or no_lists(free.size, positions.dtype)
    blocks = jnp.int32(-(-free.size // BLOCK)) if blocks is None else blocks
    room, most = into.node.size - TEST_BLOCK, into.coarse[0].size - LANES * DEPTH

    square = _fastest_square(velocities, blocks)
    halvings = jnp.floor(jnp.log2(jnp.maximum(steps / _FEWEST_STEPS, 1.0))).astype(length.dtype)

    def duration_of(attempts: jax.Array) -> jax.Array:
        return length * steps * jnp.exp2(-jnp.minimum(attempts, halvings))

    # Where there are too many pairs the list is made for fewer steps, then the spheres shrink: it will end the sooner.
    def too_many(found: _Found) -> jax.Array:
        full = (found.coarse.count > most) | (found.kept.count > room)
        return (found.attempts == 0) | (found.dear | full) & (found.attempts < _MOST_ATTEMPTS)

    def attempt(found: _Found) -> _Found:
        duration, shrinkings = duration_of(found.attempts), jnp.maximum(found.attempts - halvings, 0.0)
        moving = positions, velocities, free, duration, _slip(square, 0.5 * duration), _LEAP * _slip(square, length)
        arrays, clear, looks = _bounding_spheres(
            moving, jnp.exp2(-shrinkings), grid, skip_far, blocks, (*found.spheres, found.clear[None])
        )
        dear = (_WORTH * looks > duration / length * BLOCK * blocks) & (found.attempts < halvings)

        def examine(found: _Found) -> _Found:
            real, (begin, end), (near,) = found.spheres
            spheres = _Spheres(real[:3], real[3], begin, end, near)
            coarse = _coarse_pairs(spheres, grid, found.coarse, blocks)
            last = jnp.minimum(coarse.count, most)
            kept, planes, clear = _examined(
                coarse, last, positions, spheres, grid, found.kept, found.planes, found.clear
            )
            return found._replace(coarse=coarse, kept=kept, planes=planes, clear=clear)

        attempts = found.attempts + 1
        return only_if(~dear, examine, found._replace(attempts=attempts, dear=dear, clear=clear, spheres=arrays))

    coarse, kept = _Pairs(*into.coarse, jnp.int32(0)), _Pairs(into.node, into.triangle, jnp.int32(0))
    begun = _Found(jnp.int32(0), jnp.asarray(False), coarse, kept, into.planes, into.clear, into.spheres)
    attempts, _, coarse, kept, planes, clear, spheres = jax.lax.while_loop(too_many, attempt, begun)
    leap, way, duration = _LEAP * _slip(square, length), _slip(square, LOOK_EVERY * length), duration_of(attempts - 1)

    def work(velocities: jax.Array, free: jax.Array, sphere: Any, near: jax.Array, clear: jax.Array) -> Any:
        radius, bound = sphere[3], sphere[4]
        limit = jnp.where(free, jnp.where(near[0], radius, bound), jnp.inf)
        path = duration * jnp.sqrt(dot(velocities, velocities))
        alarm = jnp.maximum(limit - jnp.maximum(jnp.maximum(_GLANCE * path, _ALARM * radius), leap), 0.0)
        unwatched = jnp.maximum(alarm - way, 0.0)
        there = jnp.where(near[0], jnp.square(clear), jnp.inf)
        soon = jnp.where(near[0], jnp.square(jnp.maximum(clear - way, 0.0)), jnp.inf)
        return [[there, soon, jnp.square(limit), jnp.square(alarm), jnp.square(unwatched)]], []

    (squares,), _ = over_blocks(work, blocks, (velocities, free, spheres[0], spheres[2], clear), [into.squares])
    return Candidates(
        lists=Lists(
            node=kept.node,
            triangle=kept.triangle,
            planes=planes,
            coarse=(coarse.node, coarse.triangle),
            spheres=spheres,
            clear=clear,
            squares=squares,
        ),
        count=jnp.minimum(kept.count, room),
        start=positions,
        center=spheres[0][:3],
        clear_square=squares[0],
        near_square=squares[1],
        limit_square=squares[2],
        alarm_square=squares[3],
        unwatched_square=squares[4],
        overflow=(coarse.count > most) | (kept.count > room),
    )


def _slip(square: jax.Array, time: jax.Array) -> jax.Array:
    """How far [m] the fastest node goes: a slow one may become so fast meanwhile."""
    return time * jnp.sqrt(square)


def _fastest_square(velocities: jax.Array, blocks: jax.Array) -> jax.Array:
    """Square of the highest speed [m^2/s^2]."""
    _, (square,) = over_blocks(lambda v: ([], [dot(v, v)]), blocks, (velocities,), [], most=1)
    return square


def _bounding_spheres(
    moving: tuple[jax.Array, ...],
    scale: jax.Array,
    grid: SearchGrid,
    skip_far: bool,
    blocks: jax.Array,
    into: Sequence[jax.Array],
) -> tuple[tuple[jax.Array, jax.Array, jax.Array], jax.Array, jax.Array]:
    """The spheres, as `Lists` has them, and the clear distance (n_node,) before any triangle is looked at.

    And how many triangles are to be looked at.

    Args:
        moving: Positions, velocities and whether nodes are free, as in `list_candidates`; for how long they are
            expected to stay [s], half the longest path in it, and the least radius [m].
        scale: Of the spheres, so that the pairs find room.
        grid: The mold's search structure.
        skip_far: As in `list_candidates`.
        blocks: How many blocks of nodes are in use.
        into: What is written over.
    """
    positions, velocities, free, duration, longest, least = moving

    def work(positions: jax.Array, velocities: jax.Array, free: jax.Array) -> Any:
        path = duration * velocities
        half = 0.5 * jnp.sqrt(dot(path, path))
        # The longest path covers what neighbours hand on, the reach's share the start from rest.
        radius = half + _MARGIN * (half + 2 * longest + grid.reach) + least
        if not skip_far:
            radius = jnp.maximum(radius, grid.reach)
        own = scale * jnp.minimum(1.0, grid.farthest / radius)
        center, radius = positions + (0.5 * own)[None] * path, own * radius
        cell, bound = looked_up(center, grid)
        begin, end = _listed_nearby(center, radius, cell, grid)
        near, (x, y, z) = free & (bound < radius), center
        looks = jnp.where(near, end - begin, 0)
        return [[x, y, z, radius, bound], [begin, end], [near], [jnp.full_like(x, jnp.inf)]], [looks]

    arrays, (looks,) = over_blocks(work, blocks, (positions, velocities, free), list(into), sums=1)
    real, places, near, clear = arrays
    return (real, places, near), clear[0], looks


def _listed_nearby(
    center: jax.Array, radius: jax.Array, cell: jax.Array, grid: SearchGrid
) -> tuple[jax.Array, jax.Array]:
    """Where the triangles that spheres (n,) may meet begin in the lists, and where they end."""

    def within(level: SearchGrid | FarCells, cell: jax.Array) -> tuple[jax.Array, jax.Array]:
        kind = jnp.clip(jnp.ceil(CLASSES * radius / level.reach).astype(jnp.int32) - 1, 0, CLASSES - 1)
        return level.start[cell], level.ends[CLASSES * cell + kind]

    begin, end = within(grid, cell)
    if grid.far is None:
        return begin, end
    beyond, (far_begin, far_end) = radius > grid.reach, within(grid.far, cell_of(center, grid.far))
    return jnp.where(beyond, far_begin, begin), jnp.where(beyond, far_end, end)


def _coarse_pairs(spheres: _Spheres, grid: SearchGrid, into: _Pairs, blocks: jax.Array) -> _Pairs:
    """The pairs of the near nodes and the triangles of their cells whose spheres and planes cut the spheres."""
    member, total = listed(spheres.near, -(-spheres.near.size // LANES) * LANES, BLOCK * blocks)

    def more_nodes(carry: tuple[jax.Array, _Pairs]) -> jax.Array:
        return carry[0] < total

    def list_nodes(carry: tuple[jax.Array, _Pairs]) -> tuple[jax.Array, _Pairs]:
        first, found = carry
        node = cut(member, first, LANES)
        center, radius = gather(spheres.center, node), spheres.radius[node]
        begin, end = spheres.begin[node], spheres.end[node]
        length = jnp.where(first + jnp.arange(LANES) < total, end - begin, 0)
        nodes = jnp.broadcast_to(node[:, None], (LANES, DEPTH)).ravel()

        def more_triangles(carry: tuple[jax.Array, _Pairs]) -> jax.Array:
            return carry[0] < jnp.max(length)

        def list_triangles(carry: tuple[jax.Array, _Pairs]) -> tuple[jax.Array, _Pairs]:
            level, found = carry
            slot = level + jnp.arange(DEPTH, dtype=jnp.int32)
            used = slot[None] < length[:, None]
            triangle = gather(grid.listed, jnp.where(used, begin[:, None] + slot[None], 0))
            keep = used & (distance_bound(center, triangle, grid) <= radius[:, None])
            # The barrier keeps the distances from being worked out again for each use of what they decide.
            keep, triangle = once((keep.ravel(), triangle.ravel()))
            place, more = listed(keep, keep.size)
            return level + DEPTH, _with(found, gather(nodes, place), gather(triangle, place), more)

        _, found = jax.lax.while_loop(more_triangles, list_triangles, (jnp.int32(0), found))
        return first + LANES, found

    return jax.lax.while_loop(more_nodes, list_nodes, (jnp.int32(0), into._replace(count=jnp.int32(0))))[1]


def _examined(
    coarse: _Pairs,
    last: jax.Array,
    start: jax.Array,
    spheres: _Spheres,
    grid: SearchGrid,
    into: _Pairs,
    planes: jax.Array,
    clear: jax.Array,
) -> tuple[_Pairs, jax.Array, jax.Array]:
    """Those of the coarse pairs, up to the last, that truly cut the spheres; their planes (12, room), the clear way."""
    touch = touch_distance(grid)

    def more(carry: tuple[jax.Array, tuple[_Pairs, jax.Array, jax.Array]]) -> jax.Array:
        return carry[0] < last

    def examine(
        carry: tuple[jax.Array, tuple[_Pairs, jax.Array, jax.Array]],
    ) -> tuple[jax.Array, tuple[_Pairs, jax.Array, jax.Array]]:
        first, (kept, planes, clear) = carry
        node, triangle = (cut(pairs, first, TEST_BLOCK) for pairs in (coarse.node, coarse.triangle))
        # The barriers keep things from being worked out, and fetched from afar, again for each use.
        frame = once(rows_of_table(grid.frames, triangle))
        used = first + jnp.arange(TEST_BLOCK) < last
        keep = used & (distance(gather(spheres.center, node), frame) <= spheres.radius[node] + touch)
        # A node touches a plane from as far as the contact's tolerance.
        free_way = distance(gather(start, node), frame) - 2 * touch
        keep, free_way = once((keep, free_way))
        place, more = listed(keep, keep.size)
        planes = put(planes, frame[place, :12].T, kept.count)
        clear = lowered(clear, node[place], jnp.maximum(free_way, 0.0)[place], more)
        kept = _with(kept, gather(node, place), gather(grid.number, gather(triangle, place)), more)
        return first + TEST_BLOCK, (kept, planes, clear)

    nothing = into._replace(count=jnp.int32(0)), planes, clear
    return jax.lax.while_loop(more, examine, (jnp.int32(0), nothing))[1]

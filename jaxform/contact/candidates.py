"""Candidate pairs: nodes and the mold triangles that they can meet within the next steps.

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

from jaxform.contact.broad_phase import DEPTH, LANES, LOOK_EVERY, TEST_BLOCK, CandidateLists, Candidates, allocate_lists
from jaxform.core.pytree import pytree
from jaxform.kernels.blocks import (
    BLOCK,
    compact_indices,
    lax_cond_once,
    materialize,
    over_blocks,
    put,
    scatter_min,
    slice_at,
)
from jaxform.mechanics.elements import highest_speed
from jaxform.mechanics.membrane import dot, gather
from jaxform.tools.search import (
    CLASSES,
    FarCells,
    SearchGrid,
    cell_bounds,
    cell_of,
    distance,
    distance_bound,
    rows_of_table,
    touch_distance,
)

# Bounding spheres of the positions in which nodes are expected within the next steps, for the contact search.
#
# A sphere lies about the middle of a node's expected path, with a margin for what its neighbours hand on and for a
# start from rest. A list of candidates holds until a node is about to leave its sphere.

_MARGIN = 0.15  # of the expected half path, of the longest path and of the grid's reach, added to the spheres
# The list ends before a node leaves its sphere, by these shares of its expected path, of the sphere's radius, and of
# the way of the fastest node in a step: any may become as fast.
_GLANCE, _ALARM, _LEAP = 0.05, 0.1, 1.5
_FEWEST_STEPS = 16  # that a list is made for


@pytree
class BoundingSpheres:
    """Spheres in which the nodes are expected: centers (3, n_node) and radii (n_node,) [m].

    Each has the begin and end in the grid's lists of the triangles that it may meet, and whether the mold may be in it.
    """

    center: jax.Array
    radius: jax.Array
    begin: jax.Array
    end: jax.Array
    near: jax.Array

    @classmethod
    def from_lists(cls, arrays: tuple[jax.Array, jax.Array, jax.Array]) -> BoundingSpheres:
        """The spheres from the arrays of `CandidateLists`."""
        real, (begin, end), (near,) = arrays
        return cls(real[:3], real[3], begin, end, near)


class ListHorizon(NamedTuple):
    """The steps that a list is made for: their length [s], how many, and the nodes' highest speed [m/s]."""

    length: jax.Array
    steps: jax.Array
    speed: jax.Array

    @property
    def halvings(self) -> jax.Array:
        """The number of times that the steps may be halved."""
        return jnp.floor(jnp.log2(jnp.maximum(self.steps / _FEWEST_STEPS, 1.0))).astype(self.length.dtype)

    def steps_in_attempt(self, attempt: jax.Array) -> jax.Array:
        """The number of steps that the list is made for, in an attempt."""
        return self.steps * jnp.exp2(-jnp.minimum(attempt, self.halvings))

    def travel(self, steps: jax.Array | float) -> jax.Array:
        """The distance [m] of the fastest node in so many steps: a slow one may become as fast meanwhile."""
        return steps * self.length * self.speed


Arrays = tuple[tuple[jax.Array, jax.Array, jax.Array], jax.Array]
"""The spheres, as `CandidateLists` has them, and the clear distance (n_node,) [m]."""


def bounding_spheres(
    nodes: tuple[jax.Array, jax.Array, jax.Array],
    ahead: ListHorizon,
    attempt: jax.Array,
    grid: SearchGrid,
    skip_far: bool,
    blocks: jax.Array,
    into: Sequence[jax.Array],
) -> tuple[tuple[jax.Array, jax.Array, jax.Array], jax.Array, jax.Array]:
    """The spheres, as `CandidateLists` has them, and the clear distance (n_node,) before any triangle is checked.

    Also the number of triangles to check.

    Args:
        nodes: Positions, velocities and whether nodes are free, as in `list_candidates`.
        ahead: The steps to come.
        attempt: Number of the attempt.
        grid: The mold's search structure.
        skip_far: As in `list_candidates`.
        blocks: Number of node blocks in use.
        into: Workspace that is overwritten.
    """
    steps, scale = ahead.steps_in_attempt(attempt), jnp.exp2(jnp.minimum(ahead.halvings - attempt, 0.0))
    duration, longest, least = steps * ahead.length, 0.5 * ahead.travel(steps), ahead.travel(_LEAP)

    def compute_block(positions: jax.Array, velocities: jax.Array, free: jax.Array) -> Any:
        path = duration * velocities
        half = 0.5 * jnp.sqrt(dot(path, path))
        # The longest path covers what neighbours hand on, the reach's share the start from rest.
        radius = half + _MARGIN * (half + 2 * longest + grid.reach) + least
        if not skip_far:
            radius = jnp.maximum(radius, grid.reach)
        own = scale * jnp.minimum(1.0, grid.farthest / radius)
        center, radius = positions + (0.5 * own)[None] * path, own * radius
        cell, bound = cell_bounds(center, grid)
        begin, end = _nearby_range(center, radius, cell, grid)
        near, (x, y, z) = free & (bound < radius), center
        looks = jnp.where(near, end - begin, 0)
        return [[x, y, z, radius, bound], [begin, end], [near], [jnp.full_like(x, jnp.inf)]], [looks]

    arrays, (looks,) = over_blocks(compute_block, blocks, nodes, list(into), sums=1)
    real, places, near, clear = arrays
    return (real, places, near), clear[0], looks


def _nearby_range(
    center: jax.Array, radius: jax.Array, cell: jax.Array, grid: SearchGrid
) -> tuple[jax.Array, jax.Array]:
    """Begin and end in the lists (n,) of the triangles that spheres (n,) may meet."""

    def range_in(level: SearchGrid | FarCells, cell: jax.Array) -> tuple[jax.Array, jax.Array]:
        kind = jnp.clip(jnp.ceil(CLASSES * radius / level.reach).astype(jnp.int32) - 1, 0, CLASSES - 1)
        return level.start[cell], level.ends[CLASSES * cell + kind]

    begin, end = range_in(grid, cell)
    if grid.far is None:
        return begin, end
    beyond, (far_begin, far_end) = radius > grid.reach, range_in(grid.far, cell_of(center, grid.far))
    return jnp.where(beyond, far_begin, begin), jnp.where(beyond, far_end, end)


def candidate_squares(
    nodes: tuple[jax.Array, jax.Array],
    ahead: ListHorizon,
    attempt: jax.Array,
    arrays: Arrays,
    into: jax.Array,
    blocks: jax.Array,
) -> jax.Array:
    """The squares (5, n_node) of `Candidates`, in its order, of nodes (velocities, free), written `into` workspace."""
    duration = ahead.length * ahead.steps_in_attempt(attempt)
    leap, way = ahead.travel(_LEAP), ahead.travel(LOOK_EVERY)

    def compute_block(velocities: jax.Array, free: jax.Array, sphere: Any, near: jax.Array, clear: jax.Array) -> Any:
        radius, bound = sphere[3], sphere[4]
        limit = jnp.where(free, jnp.where(near[0], radius, bound), jnp.inf)
        path = duration * jnp.sqrt(dot(velocities, velocities))
        alarm = jnp.maximum(limit - jnp.maximum(jnp.maximum(_GLANCE * path, _ALARM * radius), leap), 0.0)
        unwatched = jnp.maximum(alarm - way, 0.0)
        there = jnp.where(near[0], jnp.square(clear), jnp.inf)
        soon = jnp.where(near[0], jnp.square(jnp.maximum(clear - way, 0.0)), jnp.inf)
        return [[there, soon, jnp.square(limit), jnp.square(alarm), jnp.square(unwatched)]], []

    (real, _, near), clear = arrays
    inputs = *nodes, real, near, clear
    return over_blocks(compute_block, blocks, inputs, [into])[0][0]


# Pairs are worked through in blocks by loops that end when the pairs do: the cost follows the number of pairs, not
# the capacity for them, and nothing is compiled twice. No derivative goes through these loops.
_WORTH = 8  # for so many steps of a node a list may check one triangle
_MOST_ATTEMPTS = 13  # to shorten the paths, then to shrink the spheres, until the pairs fit the capacity


class _CandidatePairs(NamedTuple):
    """Pairs of node and triangle, each (capacity + block,), and their count; beyond capacity they are only counted."""

    node: jax.Array
    triangle: jax.Array
    count: jax.Array


def _append_block(found: _CandidatePairs, node: jax.Array, triangle: jax.Array, more: jax.Array) -> _CandidatePairs:
    """Appends a block of pairs (n,), of which the first `more` count; pairs beyond the capacity are lost."""
    return _CandidatePairs(
        put(found.node, node, found.count), put(found.triangle, triangle, found.count), found.count + more
    )


class _SearchState(NamedTuple):
    """The result after some attempts: the pairs that may meet and those that can, with planes and clear distance.

    Also the spheres, as in `CandidateLists`, and whether the pairs were not searched, since they are too many.
    """

    attempts: jax.Array
    too_expensive: jax.Array
    coarse: _CandidatePairs
    pairs: _CandidatePairs
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
    into: CandidateLists | None = None,
    blocks: jax.Array | None = None,
) -> Candidates:
    """Lists the pairs of free nodes and triangles that may meet.

    Args:
        positions: Node positions (3, n_node) [m]; whole blocks of nodes.
        velocities: Node velocities (3, n_node) [m/s].
        free: Nodes (n_node,) that can still move.
        length: Length of a step [s].
        steps: Largest number of steps to come; wrongly predicted paths cost time, not accuracy.
        grid: The mold's search structure.
        skip_far: True if the spheres are as small as the paths allow; else they are as large as the grid allows.
        into: Workspace that is overwritten, such as an old list's; a new one by default.
        blocks: Number of node blocks in use; all by default.
    """
    into = into or allocate_lists(free.size, positions.dtype)
    blocks = jnp.int32(-(-free.size // BLOCK)) if blocks is None else blocks
    ahead = ListHorizon(length, steps, highest_speed(velocities, blocks))
    found, full = _search_pairs((positions, velocities, free), ahead, grid, skip_far, into, blocks)
    arrays = found.spheres, found.clear
    squares = candidate_squares((velocities, free), ahead, found.attempts - 1, arrays, into.squares, blocks)
    return Candidates(
        lists=CandidateLists(
            node=found.pairs.node,
            triangle=found.pairs.triangle,
            planes=found.planes,
            coarse=(found.coarse.node, found.coarse.triangle),
            spheres=found.spheres,
            clear=found.clear,
            squares=squares,
        ),
        count=jnp.minimum(found.pairs.count, _capacity(into)),
        start=positions,
        center=found.spheres[0][:3],
        clear_square=squares[0],
        near_square=squares[1],
        limit_square=squares[2],
        alarm_square=squares[3],
        unwatched_square=squares[4],
        overflow=full,
    )


def _capacity(into: CandidateLists) -> int:
    return into.node.size - TEST_BLOCK


def _search_pairs(
    nodes: tuple[jax.Array, jax.Array, jax.Array],
    ahead: ListHorizon,
    grid: SearchGrid,
    skip_far: bool,
    into: CandidateLists,
    blocks: jax.Array,
) -> tuple[_SearchState, jax.Array]:
    """The last attempt's result for nodes (positions, velocities, free), and whether pairs exceeded the capacity."""
    most = into.coarse[0].size - LANES * DEPTH

    def is_full(found: _SearchState) -> jax.Array:
        return (found.coarse.count > most) | (found.pairs.count > _capacity(into))

    # Where there are too many pairs the list is made for fewer steps, then the spheres shrink: it will end the sooner.
    def needs_attempt(found: _SearchState) -> jax.Array:
        return (found.attempts == 0) | (found.too_expensive | is_full(found)) & (found.attempts < _MOST_ATTEMPTS)

    def attempt(found: _SearchState) -> _SearchState:
        workspace = *found.spheres, found.clear[None]
        arrays, clear, looks = bounding_spheres(nodes, ahead, found.attempts, grid, skip_far, blocks, workspace)
        worth = ahead.steps_in_attempt(found.attempts) * BLOCK * blocks
        dear = (_WORTH * looks > worth) & (found.attempts < ahead.halvings)

        def examine(found: _SearchState) -> _SearchState:
            spheres = BoundingSpheres.from_lists(found.spheres)
            coarse = _coarse_pairs(spheres, grid, found.coarse, blocks)
            last, workspace = jnp.minimum(coarse.count, most), (found.pairs, found.planes, found.clear)
            kept, planes, clear = _filter_pairs(coarse, last, nodes[0], spheres, grid, *workspace)
            return found._replace(coarse=coarse, pairs=kept, planes=planes, clear=clear)

        attempts = found.attempts + 1
        return lax_cond_once(
            ~dear, examine, found._replace(attempts=attempts, too_expensive=dear, clear=clear, spheres=arrays)
        )

    coarse, kept = _CandidatePairs(*into.coarse, jnp.int32(0)), _CandidatePairs(into.node, into.triangle, jnp.int32(0))
    initial = _SearchState(jnp.int32(0), jnp.asarray(False), coarse, kept, into.planes, into.clear, into.spheres)
    found = jax.lax.while_loop(needs_attempt, attempt, initial)
    return found, is_full(found)


def _coarse_pairs(
    spheres: BoundingSpheres, grid: SearchGrid, into: _CandidatePairs, blocks: jax.Array
) -> _CandidatePairs:
    """The pairs of the near nodes and the triangles of their cells whose spheres and planes cut the spheres."""
    member, total = compact_indices(spheres.near, -(-spheres.near.size // LANES) * LANES, BLOCK * blocks)

    def more_nodes(carry: tuple[jax.Array, _CandidatePairs]) -> jax.Array:
        return carry[0] < total

    def list_nodes(carry: tuple[jax.Array, _CandidatePairs]) -> tuple[jax.Array, _CandidatePairs]:
        first, found = carry
        node = slice_at(member, first, LANES)
        center, radius = gather(spheres.center, node), spheres.radius[node]
        begin, end = spheres.begin[node], spheres.end[node]
        length = jnp.where(first + jnp.arange(LANES) < total, end - begin, 0)
        nodes = jnp.broadcast_to(node[:, None], (LANES, DEPTH)).ravel()

        def more_triangles(carry: tuple[jax.Array, _CandidatePairs]) -> jax.Array:
            return carry[0] < jnp.max(length)

        def list_triangles(carry: tuple[jax.Array, _CandidatePairs]) -> tuple[jax.Array, _CandidatePairs]:
            level, found = carry
            slot = level + jnp.arange(DEPTH, dtype=jnp.int32)
            used = slot[None] < length[:, None]
            triangle = gather(grid.listed, jnp.where(used, begin[:, None] + slot[None], 0))
            keep = used & (distance_bound(center, triangle, grid) <= radius[:, None])
            # The barrier keeps the distances from being computed again for each use of what they decide.
            keep, triangle = materialize((keep.ravel(), triangle.ravel()))
            place, more = compact_indices(keep, keep.size)
            return level + DEPTH, _append_block(found, gather(nodes, place), gather(triangle, place), more)

        _, found = jax.lax.while_loop(more_triangles, list_triangles, (jnp.int32(0), found))
        return first + LANES, found

    return jax.lax.while_loop(more_nodes, list_nodes, (jnp.int32(0), into._replace(count=jnp.int32(0))))[1]


def _filter_pairs(
    coarse: _CandidatePairs,
    last: jax.Array,
    start: jax.Array,
    spheres: BoundingSpheres,
    grid: SearchGrid,
    into: _CandidatePairs,
    planes: jax.Array,
    clear: jax.Array,
) -> tuple[_CandidatePairs, jax.Array, jax.Array]:
    """The coarse pairs, up to the last, that truly cut the spheres; their planes (12, capacity), clear distance."""
    touch = touch_distance(grid)

    def more(carry: tuple[jax.Array, tuple[_CandidatePairs, jax.Array, jax.Array]]) -> jax.Array:
        return carry[0] < last

    def examine(
        carry: tuple[jax.Array, tuple[_CandidatePairs, jax.Array, jax.Array]],
    ) -> tuple[jax.Array, tuple[_CandidatePairs, jax.Array, jax.Array]]:
        first, (kept, planes, clear) = carry
        node, triangle = (slice_at(pairs, first, TEST_BLOCK) for pairs in (coarse.node, coarse.triangle))
        # The barriers keep values from being computed, and fetched from afar, again for each use.
        frame = materialize(rows_of_table(grid.frames, triangle))
        used = first + jnp.arange(TEST_BLOCK) < last
        keep = used & (distance(gather(spheres.center, node), frame) <= spheres.radius[node] + touch)
        # A node touches a plane from as far as the contact's tolerance.
        free_way = distance(gather(start, node), frame) - 2 * touch
        keep, free_way = materialize((keep, free_way))
        place, more = compact_indices(keep, keep.size)
        planes = put(planes, frame[place, :12].T, kept.count)
        clear = scatter_min(clear, node[place], jnp.maximum(free_way, 0.0)[place], more)
        kept = _append_block(kept, gather(node, place), gather(grid.number, gather(triangle, place)), more)
        return first + TEST_BLOCK, (kept, planes, clear)

    nothing = into._replace(count=jnp.int32(0)), planes, clear
    return jax.lax.while_loop(more, examine, (jnp.int32(0), nothing))[1]

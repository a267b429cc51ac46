"""Candidate pairs: nodes and the mold triangles that they can meet within the next steps.

Each node gets a sphere in which it is expected to stay: about the middle of its expected path. The pairs of node and
triangle that can meet in such a sphere are listed, and with each node how far it can go before it touches anything. The
list holds until a node is about to leave its sphere; then another is made, as in Verlet's lists of neighbours. It is
made for the rest of the window, or for fewer steps where that would be much more work than those steps are.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp

from jaxform.contact.cells import distance, distance_bound, rows_of_table, touch_distance
from jaxform.contact.lists import DEPTH, LANES, TEST_BLOCK, CandidateLists, Candidates, allocate_lists
from jaxform.contact.spheres import BoundingSpheres, ListHorizon, bounding_spheres, candidate_squares
from jaxform.kernels.blocks import BLOCK, compact_indices, lax_cond_once, materialize, put, scatter_min, slice_at
from jaxform.mechanics.membrane import gather
from jaxform.mechanics.nodes import highest_speed
from jaxform.tools.search import SearchGrid

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
        skip_far: Whether the spheres are as small as the paths allow; else they are as large as the grid allows.
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
        room = *found.spheres, found.clear[None]
        arrays, clear, looks = bounding_spheres(nodes, ahead, found.attempts, grid, skip_far, blocks, room)
        worth = ahead.steps_in_attempt(found.attempts) * BLOCK * blocks
        dear = (_WORTH * looks > worth) & (found.attempts < ahead.halvings)

        def examine(found: _SearchState) -> _SearchState:
            spheres = BoundingSpheres.from_lists(found.spheres)
            coarse = _coarse_pairs(spheres, grid, found.coarse, blocks)
            last, room = jnp.minimum(coarse.count, most), (found.pairs, found.planes, found.clear)
            kept, planes, clear = _filter_pairs(coarse, last, nodes[0], spheres, grid, *room)
            return found._replace(coarse=coarse, pairs=kept, planes=planes, clear=clear)

        attempts = found.attempts + 1
        return lax_cond_once(
            ~dear, examine, found._replace(attempts=attempts, too_expensive=dear, clear=clear, spheres=arrays)
        )

    coarse, kept = _CandidatePairs(*into.coarse, jnp.int32(0)), _CandidatePairs(into.node, into.triangle, jnp.int32(0))
    begun = _SearchState(jnp.int32(0), jnp.asarray(False), coarse, kept, into.planes, into.clear, into.spheres)
    found = jax.lax.while_loop(needs_attempt, attempt, begun)
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

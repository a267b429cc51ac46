"""Bounding spheres of the positions in which nodes are expected within the next steps, for the contact search.

A sphere lies about the middle of a node's expected path, with a margin for what its neighbours hand on and for a start
from rest. A list of candidates holds until a node is about to leave its sphere.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from jaxform.contact.broad_phase import LOOK_EVERY
from jaxform.contact.cells import cell_bounds, cell_of
from jaxform.core.pytree import pytree
from jaxform.kernels.blocks import over_blocks
from jaxform.mechanics.membrane import dot
from jaxform.tools.search import CLASSES, FarCells, SearchGrid

_MARGIN = 0.15  # of the expected half path, of the longest path and of the grid's reach, added to the spheres
# How far before a node leaves its sphere the list ends: of its expected path, of the sphere's radius, and of the way
# of the fastest node in a step: any may become as fast.
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

    def work(positions: jax.Array, velocities: jax.Array, free: jax.Array) -> Any:
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

    arrays, (looks,) = over_blocks(work, blocks, nodes, list(into), sums=1)
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

    def work(velocities: jax.Array, free: jax.Array, sphere: Any, near: jax.Array, clear: jax.Array) -> Any:
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
    return over_blocks(work, blocks, inputs, [into])[0][0]

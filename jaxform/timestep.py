"""The length of the steps of a window: piecewise constant in the design, so it carries no gradient.

The limit of the central difference is 2 over the square root of the largest eigenvalue of the inverse mass times the
tangent stiffness. Element by element it is bounded from below, by a half on the meshes of the built-in scenes; power
iteration with the force's own tangent measures it to a percent. The vector is kept from window to window, so that few
iterations do.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp

from jaxform import membrane
from jaxform.blocks import over_blocks, total
from jaxform.body import Body
from jaxform.force import Load, force_change
from jaxform.membrane import Vector
from jaxform.packing import Packed
from jaxform.scene import STEPS_PER_WINDOW, Scene
from jaxform.state import State, can_move

_RUNGS_PER_OCTAVE = 8
_RANGE_PER_STEP = 0.1  # of the search grid's reach
_COLD_ITERATIONS, _AFTER_BIRTHS, _ITERATIONS = 16, 8, 1
_MOST_SHARPENING = 2.0  # how far beyond the elements' bound the step may go


def choose_step(
    state: State, scene: Scene, sheet_body: Body, packed: Packed
) -> tuple[jax.Array, jax.Array | None, jax.Array]:
    """The step [s] of the next window: from the ladder 2^(k/8), or what divides the rest of the time evenly.

    With it the mode of the highest frequency (3, n_node), where it is measured, and that frequency's square [1/s^2].
    """
    state, scene, sheet_body = jax.lax.stop_gradient((state, scene, sheet_body))
    limit, mode, rate = _limit(state, scene, sheet_body, packed)
    limit = scene.solver.safety * limit
    if scene.tables.grid is not None:
        # No node passes more of the range of its list in one step than can be watched.
        fastest = jnp.sqrt(jnp.max(membrane.dot(state.velocities, state.velocities)))
        limit = jnp.minimum(limit, _RANGE_PER_STEP * scene.tables.grid.reach / jnp.maximum(fastest, 1e-30))
    rung = jnp.exp2(jnp.floor(jnp.log2(limit) * _RUNGS_PER_OCTAVE) / _RUNGS_PER_OCTAVE)
    rung = rung * jnp.exp2(-state.retries)
    rest = (scene.solver.end_time - state.time) / STEPS_PER_WINDOW
    return jax.lax.stop_gradient((jnp.minimum(rung, rest), mode, rate))


def _limit(
    state: State, scene: Scene, sheet_body: Body, packed: Packed
) -> tuple[jax.Array, jax.Array | None, jax.Array]:
    """The longest stable step [s], its mode and its squared frequency."""
    bound = _bound(state, scene, sheet_body, packed)
    if state.mode is None:
        return bound, None, state.rate
    mode, rate, residual = _measured(state, scene, sheet_body, packed)
    # It comes from below: the residual makes up for what is missing, growth so far for growth within the window.
    growth = jnp.clip(rate / jnp.where(state.rate > 0.0, state.rate, rate), 1.0, 2.0)
    sharp = 2.0 / jnp.sqrt(growth * (rate + residual))
    return jnp.clip(sharp, bound, _MOST_SHARPENING * bound), mode, rate


def _bound(state: State, scene: Scene, sheet_body: Body, packed: Packed) -> jax.Array:
    """A step [s] that is stable whatever the elements' neighbours are; in tension."""
    rows, bounds = membrane.rows_of(packed.taken(state.positions)), sheet_body.bound[packed.element]
    moving = can_move(state, sheet_body.sheet)[packed.element]

    def work(triangles: jax.Array, inverse: jax.Array, area: jax.Array, bound: jax.Array, moving: jax.Array) -> Any:
        return [(membrane.stiffness(rows, triangles, inverse, bound, moving & (area > 0.0), scene.material),)], []

    elements = packed.elements
    inputs = elements.triangles, elements.inverse_metric, elements.area, bounds, moving
    (stiffness,), _ = over_blocks(work, elements.block_count, inputs, [jnp.zeros((1, bounds.size), bounds.dtype)])
    return membrane.stable_step(jnp.max(stiffness), scene.material)


def _measured(state: State, scene: Scene, sheet_body: Body, packed: Packed) -> tuple[jax.Array, jax.Array, jax.Array]:
    """The mode (3, n_node), and its squared frequency with the residual [1/s^2], by power iteration."""
    assert state.mode is not None
    positions = packed.taken(state.positions)
    stuck = packed.taken(state.stuck) | ~packed.exists
    compliance = jnp.where(stuck, 0.0, packed.taken(sheet_body.compliance))
    mass = packed.taken(sheet_body.mass)
    load = Load(positions, sheet_body.thickness[packed.element], scene.pressure.at(state.time), scene.material)

    def product(a: jax.Array | Vector, b: jax.Array | Vector) -> jax.Array:
        return total(mass * membrane.dot(a, b))

    def iterate(_: int, found: tuple[jax.Array, jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array, jax.Array]:
        mode = found[0]
        new = -compliance * force_change(load, packed.elements, mode)
        rate = product(mode, new)
        gap = new - rate * mode
        norm = jnp.sqrt(product(new, new))
        return new / jnp.where(norm > 0.0, norm, 1.0), rate, jnp.sqrt(product(gap, gap))

    start = jnp.where(compliance > 0.0, packed.taken(state.mode), 0.0)
    start = start / jnp.sqrt(jnp.maximum(product(start, start), jnp.finfo(mass.dtype).tiny))
    count = jnp.where(state.rate == 0.0, jnp.where(state.windows == 0, _COLD_ITERATIONS, _AFTER_BIRTHS), _ITERATIONS)
    zero = jnp.zeros((), mass.dtype)
    mode, rate, residual = jax.lax.fori_loop(0, count, iterate, (start, zero, zero))
    return packed.put_back(mode), rate, residual

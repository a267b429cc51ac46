"""The length of the steps of a window: piecewise constant in the design, so it carries no gradient.

The limit of the central difference is 2 over the square root of the largest eigenvalue of the inverse mass times the
tangent stiffness. Element by element it is bounded from below, by a half on the meshes of the built-in scenes; power
iteration with the force's own tangent measures it to a percent. The vector is kept from window to window, so that few
iterations do.
"""

from __future__ import annotations

from typing import Any, NamedTuple

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

RUNGS_PER_OCTAVE = 8
_RANGE_PER_STEP = 0.1  # of the search grid's reach
_COLD_ITERATIONS, _AFTER_BIRTHS, _ITERATIONS = 16, 8, 1
_MOST_SHARPENING = 2.0  # how far beyond the elements' bound the step may go
_RISE = 1.02  # of that from one window to the next
_REGAIN = 2.0  # how many times as long the step must be to rise again where nothing damps
_MOST_GROWTH = 0.7  # by what factor the step is shortened for the stiffness that grows


class Limit(NamedTuple):
    """How the longest stable step was found, kept for the next window; as in `State`."""

    mode: jax.Array | None
    bound: jax.Array
    sharpness: jax.Array


def choose_step(state: State, scene: Scene, sheet_body: Body, packed: Packed) -> tuple[jax.Array, Limit]:
    """The step [s] of the next window: from the ladder 2^(k/8), or what divides the rest of the time evenly.

    With it what the next window needs to know of the limit.
    """
    state, scene, sheet_body = jax.lax.stop_gradient((state, scene, sheet_body))
    longest, limit = _limit(state, scene, sheet_body, packed)
    longest = scene.solver.safety * longest
    if scene.tables.grid is not None:
        # No node passes more of the range of its list in one step than can be watched.
        fastest = jnp.sqrt(jnp.max(membrane.dot(state.velocities, state.velocities)))
        longest = jnp.minimum(longest, _RANGE_PER_STEP * scene.tables.grid.reach / jnp.maximum(fastest, 1e-30))
    rung = jnp.exp2(jnp.floor(jnp.log2(longest) * RUNGS_PER_OCTAVE) / RUNGS_PER_OCTAVE)
    if scene.solver.damping is None:
        # Every change of the step changes the energy of the fast modes, which nothing takes away.
        held = (state.step_length <= rung) & (rung < _REGAIN * state.step_length)
        rung = jnp.where(held, state.step_length, rung)
    rung = rung * jnp.exp2(-state.retries)
    rest = (scene.solver.end_time - state.time) / STEPS_PER_WINDOW
    return jax.lax.stop_gradient((jnp.minimum(rung, rest), limit))


def _limit(state: State, scene: Scene, sheet_body: Body, packed: Packed) -> tuple[jax.Array, Limit]:
    """The longest stable step [s], and how it was found.

    The iteration follows one mode, while another may have become the highest; it comes from below, so the step would
    be too long. How much sharper it is than the elements' bound depends on shapes and changes slowly: where it seems
    to rise quickly, the mode was lost. The bound itself is of this moment.
    """
    bound = elements_bound(state, scene, sheet_body, packed)
    if state.mode is None:
        return bound, Limit(None, bound, state.sharpness)
    mode, rate, residual = _measured(state, scene, sheet_body, packed)
    # The residual makes up for what is missing.
    sharpness = jnp.clip(2.0 / (bound * jnp.sqrt(rate + residual)), 1.0, _MOST_SHARPENING)
    known = state.sharpness > 0.0
    sharpness = jnp.where(known, jnp.minimum(sharpness, _RISE * state.sharpness), sharpness)
    # Growth of the stiffness so far stands for growth within the window.
    growth = jnp.where(known, jnp.clip(bound / state.bound, _MOST_GROWTH, 1.0), 1.0)
    return jnp.maximum(growth * sharpness, 1.0) * bound, Limit(mode, bound, sharpness)


def elements_bound(state: State, scene: Scene, sheet_body: Body, packed: Packed) -> jax.Array:
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
    count = jnp.where(
        state.sharpness == 0.0, jnp.where(state.windows == 0, _COLD_ITERATIONS, _AFTER_BIRTHS), _ITERATIONS
    )
    zero = jnp.zeros((), mass.dtype)
    mode, rate, residual = jax.lax.fori_loop(0, count, iterate, (start, zero, zero))
    return packed.put_back(mode), rate, residual

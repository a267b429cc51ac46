"""The length of the steps of a window: piecewise constant in the design, so it carries no gradient.

The limit of the central difference is 2 over the square root of the largest eigenvalue of the inverse mass times the
tangent stiffness. Element by element it is bounded from below, by a half on the meshes of the built-in scenes; Lanczos'
method with the force's own tangent measures it to a percent. The mode is kept from window to window, so that few
products with the tangent do.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from jaxform import membrane
from jaxform.blocks import over_blocks, total
from jaxform.body import Body
from jaxform.force import Load, force_change, no_corners
from jaxform.packing import Packed
from jaxform.scene import STEPS_PER_WINDOW, Scene
from jaxform.state import State, any_mode, can_move

RUNGS_PER_OCTAVE = 16
_RANGE_PER_STEP = 0.1  # of the search grid's reach
_FEW, _MANY = 2, 12  # products with the tangent, where the mode is known and where it is not
_NOISE = 0.1  # of what a thorough search begins with: else it is blind for modes that the last one lacks
_MARGIN = 0.98  # for a mode that was missed all the same: over the cases of docs/stability.md by up to 1.6 %
_MOST_SHARPENING = 4.0  # how far beyond the elements' bound the step may go
_RISE = 1.02  # of that from one window to the next: where it seems to be more, the mode may have been lost
_UNDAMPED = 0.9  # of the step, where nothing damps: near the limit the fast modes win energy over 100 000 steps
_REGAIN = 2.0  # how many times as long the step must be to rise again where nothing damps
_MOST_GROWTH = 0.7  # by what factor the step is shortened for the stiffness that grows


class Limit(NamedTuple):
    """How the longest stable step was found, kept for the next window; as in `State`."""

    mode: jax.Array | None
    bound: jax.Array
    sharpness: jax.Array


def choose_step(state: State, scene: Scene, sheet_body: Body, packed: Packed) -> tuple[jax.Array, Limit]:
    """The step [s] of the next window: from the ladder 2^(k/16), or what divides the rest of the time evenly.

    With it what the next window needs to know of the limit.
    """
    state, scene, sheet_body = jax.lax.stop_gradient((state, scene, sheet_body))
    longest, limit = _limit(state, scene, sheet_body, packed)
    longest = scene.solver.safety * longest
    if scene.solver.damping is None:
        longest = _UNDAMPED * longest
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

    How much sharper the measured step is than the elements' bound depends on shapes and changes slowly. A search that
    begins with the last window's mode may miss another that has become the highest, and finds a step that is too long:
    where it seems to rise, the search is done once more and thoroughly, as it is where no mode is known, or else the
    rise is not believed.
    """
    bound = elements_bound(state, scene, sheet_body, packed)
    if state.mode is None:
        return bound, Limit(None, bound, state.sharpness)

    def search(found: tuple[jax.Array, jax.Array, jax.Array, jax.Array]) -> Any:
        thorough = found[2]
        mode, square = _highest(state, scene, sheet_body, packed, thorough)
        sharpness = jnp.clip(_MARGIN * 2.0 / (bound * jnp.sqrt(square)), 1.0, _MOST_SHARPENING)
        lost = ~thorough & (sharpness > _RISE * state.sharpness)
        sharpness = jnp.where(thorough, sharpness, jnp.minimum(sharpness, state.sharpness))
        return mode, sharpness, lost, lost

    known = state.sharpness > 0.0
    begun = state.mode, state.sharpness, ~known, jnp.asarray(True)
    mode, sharpness, _, _ = jax.lax.while_loop(lambda found: found[3], search, begun)
    # Growth of the stiffness so far stands for growth within the window.
    before = state.sharpness * state.bound
    growth = jnp.where(known, jnp.clip(sharpness * bound / before, _MOST_GROWTH, 1.0), 1.0)
    return jnp.maximum(growth * sharpness, 1.0) * bound, Limit(mode, bound, sharpness)


def elements_bound(state: State, scene: Scene, sheet_body: Body, packed: Packed) -> jax.Array:
    """A step [s] that is stable whatever the elements' neighbours are; in tension."""
    rows, bounds = membrane.rows_of(packed.taken(state.positions)), sheet_body.bound[packed.element]
    stuck = packed.taken(state.stuck)

    def work(triangles: jax.Array, inverse: jax.Array, area: jax.Array, bound: jax.Array) -> Any:
        moving = can_move(stuck, triangles, area)
        return [(membrane.stiffness(rows, triangles, inverse, bound, moving, scene.material),)], []

    elements = packed.elements
    inputs = elements.triangles, elements.inverse_metric, elements.area, bounds
    (stiffness,), _ = over_blocks(work, elements.block_count, inputs, [jnp.zeros((1, bounds.size), bounds.dtype)])
    return membrane.stable_step(jnp.max(stiffness), scene.material)


def _highest(
    state: State, scene: Scene, sheet_body: Body, packed: Packed, thorough: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """The mode (3, n_node), and its squared frequency with the residual [1/s^2], by Lanczos' method.

    The residual makes up for what is missing: the frequency is approached from below.
    """
    assert state.mode is not None
    positions = packed.taken(state.positions)
    stuck = packed.taken(state.stuck) | ~packed.exists
    compliance = jnp.where(stuck, 0.0, packed.taken(sheet_body.compliance))
    mass = packed.taken(sheet_body.mass)
    load = Load(positions, sheet_body.thickness[packed.element], scene.pressure.at(state.time), scene.material)

    def product(a: jax.Array, b: jax.Array) -> jax.Array:
        return total(mass * membrane.dot(a, b))

    def unit(vector: jax.Array) -> jax.Array:
        return vector / jnp.sqrt(jnp.maximum(product(vector, vector), jnp.finfo(mass.dtype).tiny))

    def multiply(k: jax.Array, found: tuple[jax.Array, ...]) -> tuple[jax.Array, ...]:
        basis, diagonal, beside, vector, last, *room = found
        change, room = force_change(load, packed.elements, vector, room)
        new = -compliance * change
        rate = product(vector, new)
        new = new - rate * vector - jnp.where(k > 0, beside[k - 1], 0.0) * last
        norm = jnp.sqrt(product(new, new))
        basis, diagonal, beside = basis.at[k].set(vector), diagonal.at[k].set(rate), beside.at[k].set(norm)
        return basis, diagonal, beside, new / jnp.where(norm > 0.0, norm, 1.0), vector, *room

    mode = unit(jnp.where(compliance > 0.0, packed.taken(state.mode), 0.0))
    noise = unit(jnp.sqrt(compliance) * packed.taken(any_mode(state.positions)))
    start = unit(mode + jnp.where(thorough, _NOISE, 0.0) * noise)
    count = jnp.where(thorough, _MANY, _FEW)
    none = jnp.zeros(_MANY, mass.dtype)
    basis = jnp.zeros((_MANY, *start.shape), mass.dtype)
    begun = basis, none, none, start, jnp.zeros_like(start), *no_corners(positions, packed.elements)
    basis, diagonal, beside, *_ = jax.lax.fori_loop(0, count, multiply, begun)
    off = jnp.where(jnp.arange(1, _MANY) < count, beside[:-1], 0.0)
    small = jnp.diag(diagonal) + jnp.diag(off, 1) + jnp.diag(off, -1)
    squares, shares = jnp.linalg.eigh(jnp.where(jnp.isfinite(small), small, 0.0))
    share = shares[:, -1]
    residual = jnp.abs(beside[count - 1] * share[count - 1])
    return packed.put_back(jnp.tensordot(share, basis, 1)), squares[-1] + residual

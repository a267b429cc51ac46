"""The state of a simulation, one step, and one window of steps.

Every loop uses the same step and the same window. Discrete decisions (the length of the step, which nodes are tested
against the mold) are taken at a window's border only, and are piecewise constant in the design; inside a window all
shapes are fixed and the continuous state flows through.
"""

from __future__ import annotations

import dataclasses
import enum
from collections.abc import Callable

import jax
import jax.numpy as jnp

from jaxform import contact, membrane
from jaxform.force import Load, force
from jaxform.near import Near, left, list_near, watch
from jaxform.pytree import as_real, pytree
from jaxform.scene import STEPS_PER_WINDOW, Scene

_RUNGS_PER_OCTAVE = 8
_MOST_RETRIES = 12
_RANGE_PER_STEP = 0.1  # of the search grid's reach
_ENERGY_TOLERANCE = 0.2  # of the largest work done so far; a blow-up passes it within a window


class Status(enum.IntFlag):
    """Why a run stopped early; no bit is set when all went well."""

    NON_FINITE = 1
    UNSTABLE = 2
    WINDOWS_EXHAUSTED = 4
    CONTACT_OVERFLOW = 8
    CONTACT_MISSED = 16
    STOPPED = 32


@pytree
class State:
    """Where a simulation is.

    Attributes:
        positions: (3, n_node) [m].
        velocities: (3, n_node) [m/s], half a step behind the positions.
        stuck: Nodes (n_node,) that do not move any more: on the mold, or clamped.
        contact_time: When a node stuck (n_node,) [s]; -1 where free, 0 where clamped.
        wall: What a node sticks to (n_node,): one more than the number of the mold's triangle, negative where the node
            came from the far side of its normal; 0 where it does not touch the mold.
        time: [s].
        step_length: Of the last step [s]; 0 before the first.
        volume: Enclosed before the last step [m^3].
        external_work, damping_loss, contact_loss: So far [J].
        peak_work: Largest magnitude of the external work so far [J].
        retries: Times that the present window was taken anew with half the step, since a node flew out of its ball.
        steps, windows, shortened: Steps and windows taken; windows cut short because a node left its list's range.
        status: Bits of `Status`.
    """

    positions: jax.Array
    velocities: jax.Array
    stuck: jax.Array
    contact_time: jax.Array
    wall: jax.Array
    time: jax.Array
    step_length: jax.Array
    volume: jax.Array
    external_work: jax.Array
    damping_loss: jax.Array
    contact_loss: jax.Array
    peak_work: jax.Array
    retries: jax.Array
    steps: jax.Array
    windows: jax.Array
    shortened: jax.Array
    status: jax.Array


@pytree
class Body:
    """What stays the same over a run and follows from the scene's leaves.

    Attributes:
        thickness: Initial thickness of the elements (n_element,) [m].
        mass: Lumped mass of the nodes (n_node,) [kg].
        compliance: Mobility over mass (3, n_node) [1/kg].
    """

    thickness: jax.Array
    mass: jax.Array
    compliance: jax.Array


def body(scene: Scene) -> Body:
    """Element thickness and lumped masses of a scene."""
    sheet = scene.tables.sheet
    thickness = membrane.element_mean(scene.parison.thickness, sheet.triangles)
    share = scene.material.density * sheet.area * thickness / 3.0
    mass = membrane.sum_to_nodes(share, sheet.triangles, scene.parison.thickness.size)
    return Body(thickness, mass, scene.tables.mobility / mass)


def initial_state(scene: Scene) -> State:
    """The sheet at rest in its initial shape."""
    positions = scene.parison.positions.T
    zero, none = as_real(0.0), jnp.int32(0)
    held = jnp.all(scene.tables.mobility == 0.0, axis=0)
    return State(
        positions=positions,
        velocities=jnp.zeros_like(positions),
        stuck=held,
        contact_time=jnp.where(held, zero, -1.0),
        wall=jnp.zeros(held.size, jnp.int32),
        time=zero,
        step_length=zero,
        volume=enclosed_volume(positions, scene),
        external_work=zero,
        damping_loss=zero,
        contact_loss=zero,
        peak_work=zero,
        retries=none,
        steps=none,
        windows=none,
        shortened=none,
        status=none,
    )


def finished(state: State, scene: Scene) -> jax.Array:
    """Whether there is nothing left to do: the end is reached, nothing can move, or something went wrong."""
    slack = 16 * jnp.finfo(state.time.dtype).eps
    return (state.time >= scene.solver.end_time * (1.0 - slack)) | jnp.all(state.stuck) | (state.status != 0)


def kinetic_energy(state: State, mass: jax.Array) -> jax.Array:
    """Kinetic energy [J]."""
    return 0.5 * jnp.sum(mass * membrane.dot(state.velocities, state.velocities))


def strain_energy(state: State, scene: Scene, sheet_body: Body) -> jax.Array:
    """Strain energy [J]."""
    sheet = scene.tables.sheet
    volume = sheet.area * sheet_body.thickness
    return membrane.strain_energy(state.positions, sheet.triangles, sheet.inverse_metric, volume, scene.material)


def choose_step(state: State, scene: Scene) -> jax.Array:
    """The step [s] of the next window: from the ladder 2^(k/8), or what divides the rest of the time evenly.

    It is piecewise constant in the design, so it carries no gradient.
    """
    sheet = scene.tables.sheet
    moving = ~(state.stuck[sheet.triangles[0]] & state.stuck[sheet.triangles[1]] & state.stuck[sheet.triangles[2]])
    limit = scene.solver.safety * membrane.stable_step(
        state.positions, sheet.triangles, sheet.inverse_metric, scene.tables.bound, moving, scene.material
    )
    if scene.tables.grid is not None:
        # No node passes more of the range of its list in one step than can be watched.
        fastest = jnp.sqrt(jnp.max(membrane.dot(state.velocities, state.velocities)))
        limit = jnp.minimum(limit, _RANGE_PER_STEP * scene.tables.grid.reach / jnp.maximum(fastest, 1e-30))
    rung = jnp.exp2(jnp.floor(jnp.log2(limit) * _RUNGS_PER_OCTAVE) / _RUNGS_PER_OCTAVE)
    rung = rung * jnp.exp2(-state.retries)
    rest = (scene.solver.end_time - state.time) / STEPS_PER_WINDOW
    return jax.lax.stop_gradient(jnp.minimum(rung, rest))


@pytree
class _Moving:
    """What changes from step to step inside a window."""

    positions: jax.Array
    velocities: jax.Array
    stuck: jax.Array
    contact_time: jax.Array
    wall: jax.Array
    volume: jax.Array
    external_work: jax.Array
    damping_loss: jax.Array
    contact_loss: jax.Array
    count: jax.Array
    halted: jax.Array


def step(
    moving: _Moving,
    pressures: tuple[jax.Array, jax.Array, jax.Array],
    scene: Scene,
    sheet_body: Body,
    begin: jax.Array,
    length: jax.Array,
    near: Near | None,
) -> _Moving:
    """One step of the central-difference scheme (the paper's Eq. 8 with damping), and contact.

    Args:
        moving: Before the step.
        pressures: At the step's begin, averaged since the begin of the step before [Pa], and the step that the
            velocity takes [s].
        scene: The scene.
        sheet_body: Its thickness and masses.
        begin: Time of the window's begin [s].
        length: The step [s].
        near: The window's list of nodes near the mold; None where there is no mold.
    """
    pressure, mean_pressure, kick = pressures
    if near is not None:
        # A halted window runs on without moving: a step of length zero changes nothing.
        length, kick = jnp.where(moving.halted, 0.0, length), jnp.where(moving.halted, 0.0, kick)
    load = Load(moving.positions, sheet_body.thickness, pressure, scene.material)
    nodal, volume = force(load, scene.tables.sheet)
    acceleration = jnp.where(moving.stuck, 0.0, nodal * sheet_body.compliance)
    velocities, damping_loss = _kick(moving, acceleration, kick, scene, sheet_body)
    count = moving.count + jnp.where(moving.halted, 0, 1)
    moved = dataclasses.replace(
        moving,
        positions=moving.positions + length * velocities,
        velocities=velocities,
        volume=volume,
        external_work=moving.external_work + mean_pressure * (volume - moving.volume),
        damping_loss=damping_loss,
        count=count,
    )
    if near is None or scene.mold is None or scene.tables.grid is None:
        return moved
    return _touch(moving, moved, scene, sheet_body, begin + count * length, near)


def _kick(
    moving: _Moving, acceleration: jax.Array, kick: jax.Array, scene: Scene, sheet_body: Body
) -> tuple[jax.Array, jax.Array]:
    """New velocities, and the damping loss so far."""
    old = moving.velocities
    if scene.solver.damping is None:
        return old + kick * acceleration, moving.damping_loss
    half = 0.5 * scene.solver.damping * kick
    new = ((1.0 - half) * old + kick * acceleration) / (1.0 + half)
    mean = 0.5 * (old + new)
    loss = kick * scene.solver.damping * jnp.sum(sheet_body.mass * membrane.dot(mean, mean))
    return new, moving.damping_loss + loss


def _touch(
    before: _Moving,
    moved: _Moving,
    scene: Scene,
    sheet_body: Body,
    time: jax.Array,
    near: Near,
) -> _Moving:
    """Contact of one step; halts the window when a node is about to leave the range of its list."""
    assert scene.mold is not None and scene.tables.grid is not None
    landing = contact.Landing(
        moved.positions, moved.velocities, moved.stuck, moved.contact_time, moved.wall, moved.contact_loss
    )
    mold, grid = scene.mold, scene.tables.grid
    reached, leaving = watch(jax.lax.stop_gradient(moved.positions), moved.stuck, near)
    landing = contact.land(before.positions, landing, reached, sheet_body.mass, time, near, mold, grid)
    return dataclasses.replace(
        moved,
        positions=landing.positions,
        velocities=landing.velocities,
        stuck=landing.stuck,
        contact_time=landing.contact_time,
        wall=landing.wall,
        contact_loss=landing.loss,
        halted=moved.halted | leaving,
    )


def window(state: State, scene: Scene, sheet_body: Body, *, differentiable: bool = True) -> State:
    """A fixed number of steps with the decisions taken at its border.

    Where no derivative is asked for, a halted window ends at once; else its remaining steps change nothing.
    """
    length = choose_step(state, scene)
    index = jnp.arange(STEPS_PER_WINDOW)
    times = state.time + index * length
    pressure = scene.pressure.at(times)
    before = scene.pressure.at(jnp.where(index == 0, state.time - state.step_length, times - length))
    kick = jnp.where(index == 0, 0.5 * (state.step_length + length), length)
    near = _list_near(state, scene, length)
    moving = _Moving(
        positions=state.positions,
        velocities=state.velocities,
        stuck=state.stuck,
        contact_time=state.contact_time,
        wall=state.wall,
        volume=state.volume,
        external_work=state.external_work,
        damping_loss=state.damping_loss,
        contact_loss=state.contact_loss,
        count=jnp.int32(0),
        halted=jnp.asarray(False),
    )

    def advance(moving: _Moving, pressures: tuple[jax.Array, ...]) -> tuple[_Moving, None]:
        a, b, c = pressures
        return step(moving, (a, b, c), scene, sheet_body, state.time, length, near), None

    steps = pressure, 0.5 * (before + pressure), kick
    if differentiable:
        moving, _ = jax.lax.scan(advance, moving, steps)
    else:
        moving = _until_halted(
            lambda moving, taken: advance(moving, jax.tree.map(lambda x: x[taken], steps))[0], moving
        )
    return _close(state, moving, scene, sheet_body, length, near)


def _until_halted(advance: Callable[[_Moving, jax.Array], _Moving], moving: _Moving) -> _Moving:
    def going(moving: _Moving) -> jax.Array:
        return (moving.count < STEPS_PER_WINDOW) & ~moving.halted

    return jax.lax.while_loop(going, lambda moving: advance(moving, moving.count), moving)


def _list_near(state: State, scene: Scene, length: jax.Array) -> Near | None:
    if scene.mold is None or scene.tables.grid is None:
        return None
    positions, velocities, grid, length = jax.lax.stop_gradient(
        (state.positions, state.velocities, scene.tables.grid, length)
    )
    duration = length * STEPS_PER_WINDOW
    return list_near(positions, velocities, ~state.stuck, duration, grid)


def _close(
    state: State,
    moving: _Moving,
    scene: Scene,
    sheet_body: Body,
    length: jax.Array,
    near: Near | None,
) -> State:
    """The state at the window's end, with its health checked; a state that is not finite is not taken."""
    new = dataclasses.replace(
        state,
        positions=moving.positions,
        velocities=moving.velocities,
        stuck=moving.stuck,
        contact_time=moving.contact_time,
        wall=moving.wall,
        time=state.time + moving.count * length,
        step_length=length,
        volume=moving.volume,
        external_work=moving.external_work,
        damping_loss=moving.damping_loss,
        contact_loss=moving.contact_loss,
        peak_work=jnp.maximum(state.peak_work, jnp.abs(jax.lax.stop_gradient(moving.external_work))),
        steps=state.steps + moving.count,
        windows=state.windows + 1,
        shortened=state.shortened + moving.halted,
    )
    status = _health(new, scene, sheet_body) | state.status
    bad, retries = (status & Status.NON_FINITE) != 0, state.retries
    if near is not None:
        # A node that flew out of its ball may have missed the mold: the window is taken anew with smaller steps.
        missed = left(moving.positions, near)
        hopeless = missed & (retries >= _MOST_RETRIES)
        status = jnp.where(missed, state.status, status) | jnp.where(hopeless, Status.CONTACT_MISSED, 0)
        status |= jnp.where(near.overflow, Status.CONTACT_OVERFLOW, 0)
        bad, retries = bad | missed, jnp.where(missed, retries + 1, jnp.maximum(retries - 1, 0))
    kept = jax.tree.map(lambda old, new: jnp.where(bad, old, new), state, new)
    shortened = jnp.where(bad, state.shortened + 1, new.shortened)
    return dataclasses.replace(
        kept, status=status.astype(jnp.int32), retries=retries, windows=new.windows, shortened=shortened
    )


def _health(state: State, scene: Scene, sheet_body: Body) -> jax.Array:
    state, scene, sheet_body = jax.lax.stop_gradient((state, scene, sheet_body))
    finite = jnp.isfinite(jnp.sum(state.positions) + jnp.sum(state.velocities))
    held = strain_energy(state, scene, sheet_body) + kinetic_energy(state, sheet_body.mass)
    excess = held + state.damping_loss + state.contact_loss - state.external_work - last_work(state, scene)
    scale = scene.material.stiffness() * jnp.sum(scene.tables.sheet.area * sheet_body.thickness)
    # Near rest the strain energy is the rounding of I1 - 3.
    rounding = 1e-9 + 64 * jnp.finfo(scale.dtype).eps
    unstable = excess > _ENERGY_TOLERANCE * state.peak_work + rounding * scale
    return jnp.where(finite, jnp.where(unstable, Status.UNSTABLE, 0), Status.NON_FINITE)


def last_work(state: State, scene: Scene) -> jax.Array:
    """External work of the last step [J]; the account inside the loop lags, as the volume comes with the next force."""
    pressures = scene.pressure.at(jnp.stack([state.time - state.step_length, state.time]))
    return jnp.mean(pressures) * (enclosed_volume(state.positions, scene) - state.volume)


def enclosed_volume(positions: jax.Array, scene: Scene) -> jax.Array:
    """Volume [m^3] between the sheet, at positions (3, n_node) [m], and its origin."""
    first, edge1, edge2 = membrane.edges(positions, scene.tables.sheet.triangles)
    arm = first - scene.tables.sheet.origin[:, None]
    return jnp.sum(membrane.dot(arm, membrane.cross(edge1, edge2))) / 6.0

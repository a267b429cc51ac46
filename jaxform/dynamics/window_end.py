"""The end of a window: its energy balance, whether it is accepted or rejected, and the length of the next one."""

from __future__ import annotations

import dataclasses
import functools
from typing import Any

import jax
import jax.numpy as jnp

from jaxform.contact.sliding import split_by_tool
from jaxform.dynamics.contact_step import FAR
from jaxform.dynamics.window_state import ContactSearch, WindowData, WindowState
from jaxform.kernels.blocks import lax_cond_once, over_blocks
from jaxform.mechanics import membrane
from jaxform.mechanics.constitutive import present_memory
from jaxform.mechanics.corners import Load, corner_forces
from jaxform.mechanics.elements import Corners, allocate_corner_forces, gather_shares, gather_table
from jaxform.model.scene import Scene
from jaxform.model.tables import SHORT_WINDOW, SLACK
from jaxform.sheet.active_set import ActiveSet
from jaxform.sheet.energy_balance import element_energy, energy_rounding, last_work, pressure_at
from jaxform.sheet.scheme import add_gravity, apply_tool_velocity, conserves_energy, update_velocity
from jaxform.sheet.state import EnergyBalance, PackedState, Replay, State, Status
from jaxform.tools.mold import tool_velocity

_MOST_RETRIES = 12
_ENERGY_TOLERANCE = 0.2  # of the largest work done so far; a blow-up passes it within a window
_FEW_PAIRS = 0.25  # of the nodes' number, near the mold: with no more, windows become longer
_STEADY = 0.05  # of the bound on the step: where it changes by more in a window, they become shorter
_QUIET = 1e-2  # of the largest work: where a window misses more energy, they become shorter
_JUMP_TOLERANCE, _RETRIES_FOR_ENERGY = 0.02, 4  # the same of one window, which is then retried at most so often
_GAIN_TOLERANCE = 0.005  # the same of energy that is gained: damping would take it away, with the wall changed
_RELEASE_TOLERANCE = 0.002  # the same for the first window of a damped sheet after the clamp opens


def end_window(
    state: PackedState,
    current: WindowState,
    end: WindowEnd,
    searched: ContactSearch | None,
    scene: Scene,
    data: WindowData,
) -> PackedState:
    """The state at the window's end, or where the window is rejected that at its begin, to be retried."""
    kinetic, behind, largest, tool = end
    account = dataclasses.replace(current.account, gravity_work=_add_gravity_work(state, current, scene, data))
    account = dataclasses.replace(account, restarts=_add_restart(state, account))
    work = jax.lax.stop_gradient(account.work)
    new = dataclasses.replace(
        state,
        nodes=dataclasses.replace(current.nodes, mode=state.nodes.mode, fields=current.fields),
        memory=current.memory,
        held=None if current.held is None else current.held.at(data.active.packed.node),
        account=dataclasses.replace(
            account,
            peak_work=jnp.maximum(state.account.peak_work, jnp.abs(work)),
            kinetic_peak=jnp.maximum(state.account.kinetic_peak, kinetic),
            kinetic_excess=behind - kinetic,
            tool_last=tool[0] if tool else None,
            last_by_tool=tuple(tool[1:]),
        ),
        control=dataclasses.replace(state.control, step_length=data.length, bound=data.bound),
        time=state.time + current.count * data.length,
        steps=state.steps + current.count,
        windows=state.windows + 1,
    )
    rounding = energy_rounding(scene, data.active.material_volume)
    status, imbalance = _health(new, end, rounding, scene, data.active)
    new = dataclasses.replace(new, account=dataclasses.replace(new.account, imbalance=imbalance))
    # A window whose energy balance misses too much is retried with shorter steps, a few times.
    jump = jnp.abs(imbalance - state.account.imbalance) - rounding
    gained = imbalance - jnp.maximum(state.account.imbalance, 0.0) - rounding
    unsure = jump > _jump_tolerance(state, scene) * new.account.peak_work
    unsure |= gained > _GAIN_TOLERANCE * new.account.peak_work
    unsure &= state.control.retries < _RETRIES_FOR_ENERGY
    # An unstable window, and one in which a node may have missed the mold, is retried with half the step: the sheet
    # may have stiffened within the window.
    pairs, overflow, missed = (None, None, None) if searched is None else searched
    if missed is not None:
        status = jnp.where(missed, Status.CONTACT_MISSED, status)
    bad = (status != 0) | unsure
    status = state.status | jnp.where(state.control.retries >= _MOST_RETRIES, status, 0)
    if overflow is not None:
        # Pairs are missing: the state is unchanged, for a run with a larger capacity.
        bad |= overflow
        status |= jnp.where(overflow, Status.CONTACT_OVERFLOW, 0)
    box = scene.tables.box
    if box is None:
        status |= jnp.where((largest > FAR * scene.tables.size) & ~bad, Status.RUNAWAY, 0)
    else:
        status |= jnp.where((largest > box.reach) & ~bad, Status.ESCAPED, 0)
    retries = jnp.where(bad, state.control.retries + 1, jnp.maximum(state.control.retries - 1, 0))
    if data.row is not None:
        spent = current.count * data.length
        whole = data.row[1] - spent <= SLACK * data.length
        row_time = jnp.where(whole, 0.0, state.replay.row_time + spent)
        new = dataclasses.replace(new, replay=Replay(data.row[0] + whole, row_time))
    # One conditional for the whole state: leaf by leaf there would be a kernel for each.
    kept = lax_cond_once(bad, lambda _: state, new, differentiable=current.corners is None)
    return dataclasses.replace(
        kept,
        status=status.astype(jnp.int32),
        control=dataclasses.replace(
            kept.control,
            window_steps=_next_window_steps(
                state, bad, jump <= _QUIET * new.account.peak_work, pairs, scene, data, new.time
            ),
            retries=retries,
            last_length=data.length,
            last_count=jnp.where(bad, 0, current.count),
        ),
        windows=new.windows,
        shortened=state.shortened + bad,
    )


def _add_restart(state: PackedState, account: EnergyBalance) -> jax.Array | None:
    """`EnergyBalance.restarts` [J] after the window that a state begins, with the account at its end."""
    before, after = state.account.unresolved, account.unresolved
    if account.restarts is None or before is None or after is None:
        return None
    anew = (state.control.step_length == 0.0) & (state.steps > 0)
    return account.restarts + jnp.where(anew, jax.lax.stop_gradient(after - before), 0.0)


def _jump_tolerance(state: PackedState, scene: Scene) -> jax.Array | float:
    """Share of the largest work that one window may miss before it is retried with shorter steps."""
    until, control = scene.parison.clamp_until, state.control
    if until is None or conserves_energy(scene):
        return _JUMP_TOLERANCE
    opens = (control.step_length == 0.0) & (jnp.abs(state.time - until) <= SLACK * control.last_length)
    return jnp.where(opens, _RELEASE_TOLERANCE, _JUMP_TOLERANCE)


def _add_gravity_work(state: PackedState, current: WindowState, scene: Scene, data: WindowData) -> jax.Array | None:
    """Work of gravity [J] up to the window's end; None where none acts."""
    before, gravity = state.account.gravity_work, scene.solver.gravity
    if before is None or gravity is None:
        return None
    return before + gravity @ jnp.sum(data.active.mass * (current.nodes.positions - state.nodes.positions), axis=1)


def _next_window_steps(
    state: State,
    rejected: jax.Array,
    quiet: jax.Array,
    pairs: jax.Array | None,
    scene: Scene,
    data: WindowData,
    time: jax.Array,
) -> jax.Array:
    """Number of steps of the next window.

    It grows while the energy balance is quiet, the stiffness steady, and few nodes are near the mold. A window boundary
    costs as much as ten steps; but there stuck elements leave the active set, and the step length follows the
    stiffness. Where the planned windows would not suffice for the `time` that is left, windows have their full length.
    """
    if scene.tables.step_capacity <= SHORT_WINDOW:
        return state.control.window_steps
    longer = quiet & (jnp.abs(data.bound - state.control.bound) <= _STEADY * state.control.bound)
    if pairs is not None:
        counts = scene.tables.counts
        nodes = scene.tables.mobility.shape[1] if counts is None else counts.nodes
        longer &= pairs <= _FEW_PAIRS * nodes
    longest = jnp.int32(scene.tables.longest_window)
    twice, half = (
        jnp.minimum(2 * state.control.window_steps, longest),
        jnp.maximum(state.control.window_steps // 2, jnp.minimum(SHORT_WINDOW, longest)),
    )
    window_steps = jnp.where(longer, twice, half)
    windows = (scene.solver.end_time - time) / (SHORT_WINDOW * data.length)
    window_steps = jnp.where(windows > scene.tables.planned - state.windows, longest, window_steps)
    return jnp.where(rejected, jnp.minimum(SHORT_WINDOW, longest), window_steps)


WindowEnd = tuple[jax.Array, jax.Array, jax.Array, list[jax.Array]]
"""Quantities at a window's end.

Kinetic energy at the time of the positions [J]; kinetic energy of the velocities, half a step earlier [J]; largest
coordinate [m], from the middle of sheet and mold where there is a mold, not finite where any position is not; and the
work of the moving tools by the present forces [J], their total first: empty where all tools rest.
"""


def end_of_window_energy(current: WindowState, scene: Scene, data: WindowData) -> tuple[WindowEnd, Corners]:
    """Energies at a window's end, and the workspace for corner forces; not differentiable.

    The kinetic energy is that of the product of the velocities half a step before and half a step after the positions,
    which a linear mode conserves.
    """
    current, scene, data = jax.lax.stop_gradient((current, scene, data))
    active, elements = data.active, data.active.packed.elements
    positions = current.nodes.positions
    time = data.begin + current.count * data.length
    volume = None if current.account.load_state is None else active.volume(positions)
    pressure = pressure_at(current.account, scene, time, data.length, volume).pressure
    modes = scene.material.viscous
    memory = None if modes is None or current.memory is None else present_memory(current.memory, modes)
    load = Load(positions, active.thickness, pressure, *active.response(scene.material, memory))
    corners = allocate_corner_forces(positions, elements) if current.corners is None else current.corners
    corners, _ = corner_forces(load, elements, corners)

    frames = scene.frames(time, time + data.length)
    moves = scene.moves
    middle = None if scene.tables.box is None else scene.tables.box.middle

    def compute_block(own: Any, nodes: Any, positions: Any, velocities: Any, wall: Any, tool: Any) -> Any:
        nodal, done = add_gravity(gather_shares(corners, own), nodes[1], scene.solver.gravity), []
        ahead, _ = update_velocity(nodal, velocities, nodes, data.length, scene.solver.damping)
        if moves:
            # Half of the work from the present force to the next one, at the present velocity of the tool.
            carrier = tool_velocity(frames, tool)
            ahead, held, _ = apply_tool_velocity(nodal, (velocities, ahead), nodes, wall, data.length, carrier)
            triples = zip(nodal, velocities, ahead, strict=True)
            pulls = [(nodes[1] * (new - old) - data.length * own) * old for own, old, new in triples]
            each = jnp.where(held, 0.5 * sum(pulls), 0.0)
            done = [each, *split_by_tool(each, tool, scene.moving_tools)]
        half = 0.5 * nodes[1]
        energies = [half * membrane.dot(velocities, ahead), half * membrane.dot(velocities, velocities)]
        away = positions if middle is None else [x - middle[k] for k, x in enumerate(positions)]
        size = functools.reduce(jnp.maximum, [jnp.abs(x) for x in away])
        if middle is not None:
            # Fixed nodes do not count, nor places without a node, whose positions are arbitrary.
            size = jnp.where(sum(nodes[2]) > 0.0, size, 0.0)
        return [], [*energies, *done, size]

    nodes = current.nodes.stuck, active.mass, active.compliance
    touched = (current.nodes.wall, current.nodes.tool) if moves else (None, None)
    inputs = gather_table(elements), nodes, positions, current.nodes.velocities, *touched
    sums = 2 + moves + len(scene.moving_tools)
    _, (kinetic, behind, *tool, largest) = over_blocks(
        compute_block, elements.node_block_count, inputs, [], sums=sums, most=1
    )
    return (kinetic, behind, largest, tool), corners


def _health(
    state: PackedState, end: WindowEnd, rounding: jax.Array, scene: Scene, active: ActiveSet
) -> tuple[jax.Array, jax.Array]:
    """Errors of the state at a window's end, as bits of `Status`, and its energy imbalance [J]."""
    state, scene, active = jax.lax.stop_gradient((state, scene, active))
    law = active.law(scene.material)
    energy, volume = element_energy(state.nodes.positions, active.packed.elements, active.thickness, law, state.memory)
    strain, volume = energy + active.inactive_energy, volume + active.inactive_volume
    kinetic, _, largest, _ = end
    # Without what the first step and changes of the step do not resolve: where that is much, the step is too long.
    restarts = 0.0 if state.account.restarts is None else state.account.restarts
    held = strain + kinetic + sum(state.account.losses().values()) + restarts
    excess = held - state.account.work - last_work(state, scene, volume)
    # False for NaN as well, where energies overflow, and where energy vanished.
    balanced = jnp.abs(excess) <= _ENERGY_TOLERANCE * state.account.peak_work + rounding
    finite = jnp.isfinite(largest + kinetic)
    status = jnp.where(finite, jnp.where(balanced, 0, Status.UNSTABLE), Status.NON_FINITE)
    return status, excess

"""The central-difference scheme: pressures and velocity steps of a window, and the velocity update.

Velocities are half a step behind the positions.
"""

from __future__ import annotations

import dataclasses
from typing import Any, cast

import jax
import jax.numpy as jnp

from jaxform.contact.sliding import ContactLosses, SlideInput, ToolEnergies, slide_nodes, sliding_nodes, split_by_tool
from jaxform.kernels.blocks import lax_cond_once, materialize
from jaxform.kernels.derivatives import save_decision
from jaxform.loads import Loading
from jaxform.mechanics import membrane
from jaxform.mechanics.constitutive import present_memory
from jaxform.mechanics.corners import Load
from jaxform.mechanics.force import force
from jaxform.mechanics.membrane import vector
from jaxform.model.scene import Scene
from jaxform.sheet.active_set import ActiveSet, active_set_of
from jaxform.sheet.discretization import Discretization
from jaxform.sheet.energy_balance import enclosed_volume, last_work, present_pressure
from jaxform.sheet.state import PackedState, State, clamp_is_open, initial_node_state
from jaxform.tools.mold import tool_velocity

WindowTiming = tuple[jax.Array, jax.Array, jax.Array]
"""A window's begin, the length of the step before it, and that of its own steps [s]."""


def pressures(pressure: Loading, timing: WindowTiming, count: int) -> tuple[jax.Array, jax.Array]:
    """At the begin of each of the `count` steps of a window, and averaged since the begin of the step before [Pa].

    Zeros where the pressure follows the volume, so that each step has to find it.
    """
    begin, before, length = timing
    if pressure.follows_volume:
        none = jnp.zeros(count, begin.dtype)
        return none, none
    # The step before the window's first has a length of its own.
    times = begin + jnp.arange(count) * length
    found = pressure.at(jnp.append(begin - before, times), None)
    return found[1:], 0.5 * (found[:-1] + found[1:])


def velocity_steps(timing: WindowTiming, count: int) -> jax.Array:
    """Time steps of the velocity updates in each of the `count` steps of a window [s]."""
    _, before, length = timing
    return jnp.where(jnp.arange(count) == 0, 0.5 * (before + length), length)


def add_gravity(nodal: Any, mass: jax.Array, gravity: jax.Array | None) -> Any:
    """Nodal forces, three times (n,) [N], with the weight of the nodes' mass (n,) [kg] where gravity (3,) acts."""
    return nodal if gravity is None else vector(f + mass * g for f, g in zip(nodal, gravity, strict=True))


def update_velocity(
    nodal: Any,
    velocities: Any,
    nodes: tuple[jax.Array, jax.Array, Any],
    velocity_step: jax.Array,
    damping: jax.Array | None,
) -> tuple[membrane.Vector, jax.Array | None]:
    """New velocities, three times (n,) [m/s], and the damping loss (n,) [J]; None without damping.

    Args:
        nodal: Forces, three times (n,) [N].
        velocities: Velocities half a step before the positions, three times (n,) [m/s].
        nodes: True for stuck nodes (n,), mass (n,) [kg] and compliance, three times (n,) [1/kg].
        velocity_step: Time step of the velocity update [s].
        damping: Mass-proportional damping [1/s]; None without damping.
    """
    stuck, mass, compliance = nodes
    gains = [velocity_step * jnp.where(stuck, 0.0, f * c) for f, c in zip(nodal, compliance, strict=True)]
    if damping is None:
        return materialize(vector(old + gain for old, gain in zip(velocities, gains, strict=True))), None
    half = 0.5 * damping * velocity_step
    rest = 1.0 / (1.0 + half)  # one division, not three at every node
    # Materialized: else the positions and the loss would each compute them, and the force, again.
    gains = materialize(vector(0.5 * gain for gain in gains))
    # The mean of both velocities, of which the loss is made; the new ones follow from it, without the old.
    mean = materialize(vector(rest * (old + gain) for old, gain in zip(velocities, gains, strict=True)))
    new = vector((1.0 - half) * middle + gain for middle, gain in zip(mean, gains, strict=True))
    return new, velocity_step * damping * mass * membrane.dot(mean, mean)


def unresolved_energy(
    nodal: Any,
    velocities: tuple[Any, Any],
    free: jax.Array,
    steps: tuple[jax.Array, jax.Array],
    scene: Scene,
) -> jax.Array:
    """Energy (n,) [J] that the balance misses by a velocity update between steps of different length.

    The kinetic energy of the balance is the product of the velocities half a step before and half a step after the
    positions. A linear mode keeps it at a constant step h, but it is less than m v^2 / 2 by h^2 m a^2 / 8. So an update
    from a step h1 to a step h2, with forces f, misses (h2^2 - h1^2) f a / 8: at a start h1 = 0, and h2 = 0 where the
    velocity is brought to the time of the positions. docs/explanation/method.md has the derivation.

    Args:
        nodal: Forces, three times (n,) [N].
        velocities: Velocities before and after the update, three times (n,) each [m/s].
        free: Nodes (n,), as `touches_no_tool` finds them.
        steps: Time step of the velocity update, and length of the step that it begins [s]: 0 where it begins none.
        scene: The scene.
    """
    before, after = map(vector, velocities)
    return jnp.where(free, unresolved_factor(*steps, scene) * membrane.dot(nodal, membrane.minus(after, before)), 0.0)


def touches_no_tool(stuck: jax.Array, wall: jax.Array, on_edge: jax.Array | None) -> jax.Array:
    """True for nodes (n,) whose force no clamp and no tool bears; `on_edge` is true at ends of sides held at edges."""
    free = ~stuck & (wall == 0)
    return free if on_edge is None else free & ~on_edge


def unresolved_factor(velocity_step: jax.Array, length: jax.Array, scene: Scene) -> jax.Array:
    """Factor [s] of force times change of velocity in `unresolved_energy`; 0 where there is no update.

    With the step's time s = (h1 + h2) / 2 and the change a s, (h2^2 - h1^2) f a / 8 is (h2 - s) f a s / 2.
    """
    counts = velocity_step > 0.0
    if conserves_energy(scene):
        # Where the step only changes, a sheet in motion misses what `present_energies` adds as well, and less of it.
        counts &= (length == 0.0) | (length == 2.0 * velocity_step)
    return jnp.where(counts, 0.5 * (unresolved_share(scene) or 0.0) * (length - velocity_step), 0.0)


def unresolved_share(scene: Scene) -> float | None:
    """Share of the energy by `unresolved_energy` that the kinetic energy misses; None where it is not counted.

    A sheet with which nothing exchanges energy misses a third of it, since `present_energies` has the rest; that counts
    where motion begins anew as a clamp opens or new nodes are inserted.
    """
    if not conserves_energy(scene):
        return 1.0
    return 1.0 / 3.0 if begins_anew(scene) else None


def begins_anew(scene: Scene) -> bool:
    """True where motion begins anew during a run: as a clamp opens, and as new nodes are inserted."""
    return scene.parison.clamp_until is not None or scene.adaptivity is not None


def apply_tool_velocity(
    nodal: Any,
    velocities: tuple[Any, Any],
    nodes: tuple[jax.Array, jax.Array, Any],
    wall: jax.Array,
    velocity_step: jax.Array,
    carrier: Any,
) -> tuple[membrane.Vector, jax.Array, jax.Array]:
    """New velocities where tools move: nodes that stick to a tool take its velocity.

    Returns:
        Velocities, three times (n,) [m/s]; True for the nodes that stick to a tool (n,); work of the tools (n,) [J].

    Args:
        nodal: Forces, three times (n,) [N].
        velocities: Velocities before the update, and after that of free nodes, three times (n,) each [m/s].
        nodes: True for stuck nodes (n,), mass (n,) [kg] and compliance, three times (n,) [1/kg].
        wall: Contact triangles, as in `Nodes` (n,); 0 where nodes are clamped.
        velocity_step: Time step of the velocity update [s].
        carrier: The tool's velocity, three numbers, or three times (n,) [m/s].
    """
    stuck, mass, compliance = nodes
    held, new, work = stuck & (wall != 0), [], jnp.zeros_like(mass)
    for own, mobile, before, after, speed in zip(nodal, compliance, *velocities, carrier, strict=True):
        moves = held & (mobile > 0.0)
        new.append(jnp.where(moves, speed, after))
        work += jnp.where(moves, 0.5 * (mass * (speed - before) - velocity_step * own) * (speed + before), 0.0)
    return vector(new), held, work


def _present_force(packed: PackedState, scene: Scene, active: ActiveSet, pressure: jax.Array) -> Any:
    """Nodal forces of a state, three times (n,) [N], at a pressure [Pa]; differentiable."""
    modes = scene.material.viscous
    memory = None if packed.memory is None or modes is None else present_memory(packed.memory, modes)
    load = Load(packed.nodes.positions, active.thickness, pressure, *active.response(scene.material, memory))
    return add_gravity(force(load, active.packed.elements)[0], active.mass, scene.solver.gravity)


def conserves_energy(scene: Scene) -> bool:
    """True where no damping, viscous modes, tools or gas exchange energy with the fast modes."""
    lossless = scene.solver.damping is None and scene.material.viscous is None
    return lossless and not scene.slides and not scene.moves and not scene.pressure.follows_volume


def present_energies(state: State, scene: Scene, discrete: Discretization) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Energies [J] at the time of the positions that need the next velocities; differentiable.

    They are the kinetic energy, what modes gain as they exchange it, and the damping loss of the last half step.

    The first is that of the product of the velocities half a step before and half a step after, which a linear mode
    keeps. The second is that of an undamped sheet, 0 if a sheet is damped. The scheme keeps the energy of a Hamiltonian
    that differs from the sheet's by the square of the step h: with velocities v, accelerations a and the tangent K, the
    first and h^2 / 12 (v K v + m a^2), and terms of the fourth order. For a single linear mode the second part is a
    constant share of the first; a share that is larger for faster modes, so that the first alone falls as slow modes
    excite fast ones (Engle, Skeel, Drees, Monitoring energy drift with shadow Hamiltonians, J. Comput. Phys. 2005).
    A gas works on the fast modes directly, by which a linear mode gains exactly the first part: so it is alone there.
    """
    active = active_set_of(state, scene, discrete, differentiable=True)
    packed, length = active.pack_state(state), state.control.step_length
    volume = enclosed_volume(state.nodes.positions, discrete.sheet) if scene.pressure.follows_volume else None
    pressure = present_pressure(state, scene, volume).pressure
    nodal = _present_force(packed, scene, active, pressure)
    nodes, before = (packed.nodes.stuck, active.mass, active.compliance), packed.nodes.velocities
    after, _ = update_velocity(nodal, before, nodes, length, scene.solver.damping)
    carrier, damped = tool_velocity(scene.frames(state.time, state.time + length), packed.nodes.tool), active.mass
    if carrier is not None:
        after, held, _ = apply_tool_velocity(nodal, (before, after), nodes, packed.nodes.wall, length, carrier)
        damped = jnp.where(held, 0.0, damped)

    def total(mass: jax.Array | float, first: Any, second: Any) -> jax.Array:
        return jnp.sum(jnp.where(active.packed.exists, mass * membrane.dot(first, second), 0.0))

    kinetic = 0.5 * total(active.mass, before, after)
    if not conserves_energy(scene):
        rate = 0.0 if scene.solver.damping is None else scene.solver.damping
        lost = 0.25 * rate * length * total(damped, before, jnp.stack(after) + before)
        return kinetic, jnp.zeros_like(kinetic), lost
    mean, gain = (0.5 * (jnp.stack(after) + before), jnp.stack(after) - before)

    def force_at(way: jax.Array) -> Any:
        moved = cast(PackedState, packed.replace_nodes(positions=packed.nodes.positions + way))
        return _present_force(moved, scene, active, pressure)

    pull = jnp.stack(force_at(-0.5 * length * mean)) - jnp.stack(force_at(0.5 * length * mean))
    return kinetic, (length * total(1.0, mean, pull) + total(active.mass, gain, gain)) / 12.0, jnp.zeros_like(kinetic)


def synchronize_velocity(
    state: State, scene: Scene, discrete: Discretization, active: ActiveSet | None = None
) -> State:
    """The state with velocities at the time of the positions, and its account closed.

    Before forces jump, so that the next velocity update does not apply the new ones over the half step before.

    Args:
        state: In the mesh's order.
        scene: The scene.
        discrete: The sheet with that mesh.
        active: An active set with all elements that can move; by default it is made here, differentiably.
    """
    active = active or active_set_of(state, scene, discrete, differentiable=True)
    volume = enclosed_volume(state.nodes.positions, discrete.sheet)
    done = _synchronize(active.pack_state(state), scene, active, volume)
    new = dataclasses.replace(state, control=done.control, account=done.account)
    return new.replace_nodes(velocities=active.packed.unpack(done.nodes.velocities))


def _synchronize(packed: PackedState, scene: Scene, active: ActiveSet, volume: jax.Array) -> PackedState:
    """`synchronize_velocity` of a state in packed order, which encloses a volume [m^3]."""
    control, account = packed.control, packed.account
    pressed = present_pressure(packed, scene, volume)
    nodes, half = (packed.nodes.stuck, active.mass, active.compliance), 0.5 * control.step_length
    nodal = _present_force(packed, scene, active, pressed.pressure)
    velocities, losses = update_velocity(nodal, packed.nodes.velocities, nodes, half, scene.solver.damping)
    missed: jax.Array | float = 0.0
    if account.unresolved is not None:
        both, held = (packed.nodes.velocities, velocities), packed.held
        on_edge = None if held is None else held.at(active.packed.place).has_end(packed.nodes.wall.size)
        free = touches_no_tool(packed.nodes.stuck, packed.nodes.wall, on_edge)
        missed = jnp.sum(unresolved_energy(nodal, both, free, (half, jnp.zeros_like(half)), scene))
    work, by_tool = account.tool_work, account.by_tool
    if work is not None:
        before = packed.nodes.velocities
        velocities, held, done = apply_tool_velocity(
            nodal, (before, velocities), nodes, packed.nodes.wall, half, before
        )
        by_tool = add_by_tool(by_tool, scene, packed.nodes.tool, done)
        work, losses = work + jnp.sum(done), None if losses is None else jnp.where(held, 0.0, losses)
    lost = 0.0 if losses is None else jnp.sum(losses)
    friction, impact = account.friction_loss, account.contact_loss
    if friction is not None:
        velocities, slid, sliding = _synchronize_slip(packed, scene, active, nodal, velocities)
        lost = 0.0 if losses is None else jnp.sum(jnp.where(sliding, slid.damping, losses))
        friction, impact = friction + jnp.sum(slid.friction), impact + jnp.sum(slid.impact)
        work = None if work is None else work + jnp.sum(slid.work)
        by_tool = add_by_tool(by_tool, scene, packed.nodes.tool, slid.work, slid.friction)
    made = dataclasses.replace(
        packed,
        nodes=dataclasses.replace(packed.nodes, velocities=jnp.stack(velocities)),
        control=dataclasses.replace(control, step_length=jnp.zeros_like(control.step_length)),
        account=dataclasses.replace(
            account,
            volume=volume,
            load_state=None if account.load_state is None else pressed,
            external_work=account.external_work + last_work(packed, scene, volume),
            damping_loss=account.damping_loss + lost,
            unresolved=None if account.unresolved is None else account.unresolved + missed,
            restarts=None if account.restarts is None else account.restarts + jax.lax.stop_gradient(missed),
            friction_loss=friction,
            contact_loss=impact,
            tool_work=work,
            by_tool=by_tool,
            rim=None if account.rim is None else jnp.zeros_like(account.rim),
        ),
    )
    return PackedState(made)


def open_clamp_of(state: State, scene: Scene, discrete: Discretization) -> State:
    """`open_clamp` of a state in the mesh's order."""
    if scene.parison.clamp_until is None:
        return state

    def open_now(state: State) -> State:
        active = active_set_of(state, scene, discrete, differentiable=True)
        return active.unpack_state(open_clamp(active.pack_state(state), scene, active, differentiable=True))

    freed = save_decision(jnp.any(_freed_nodes(state, scene, discrete.compliance)))
    return lax_cond_once(freed, open_now, state, differentiable=True)


def open_clamp(state: PackedState, scene: Scene, active: ActiveSet, *, differentiable: bool = False) -> PackedState:
    """The state at a window boundary, in which clamped nodes are free from the time on at which the clamp opens.

    They begin at rest. One that was in contact with a tool at rest from the start is held by that from now on.
    """
    if scene.parison.clamp_until is None:
        return state
    freed = save_decision(_freed_nodes(state, scene, active.compliance) & active.packed.exists)
    node = active.packed.node if state.mesh is None else state.mesh.node[active.packed.node]

    def open_now(state: PackedState) -> PackedState:
        state = _synchronize(state, scene, active, active.volume(state.nodes.positions))
        nodes = state.nodes
        stuck, since, wall, tool = initial_node_state(scene, node, opened=True)
        new = dataclasses.replace(
            nodes,
            stuck=jnp.where(freed, stuck, nodes.stuck),
            contact_time=jnp.where(freed, jnp.where(since < 0.0, since, state.time), nodes.contact_time),
            wall=jnp.where(freed, wall, nodes.wall),
            tool=None if nodes.tool is None or tool is None else jnp.where(freed, tool, nodes.tool),
        )
        # The fastest mode of the sheet may be another from now on.
        control = dataclasses.replace(state.control, sharpness=jnp.zeros_like(state.control.sharpness))
        return PackedState(dataclasses.replace(state, nodes=new, control=control))

    return lax_cond_once(jnp.any(freed), open_now, state, differentiable=differentiable)


def _freed_nodes(state: State, scene: Scene, compliance: jax.Array) -> jax.Array:
    """Nodes (n,) that the clamp still holds when it opens, of this compliance (3, n) [1/kg]."""
    nodes = state.nodes
    held = nodes.stuck & (nodes.wall == 0) & (nodes.contact_time == 0.0) & jnp.any(compliance > 0.0, axis=0)
    return held & clamp_is_open(state, scene)


def add_by_tool(
    before: ToolEnergies,
    scene: Scene,
    tool: jax.Array | None,
    work: jax.Array,
    friction: jax.Array | float = 0.0,
) -> ToolEnergies:
    """The energies of tools with those of nodes (n,) [J] added, which touch the tools of these numbers (n,)."""
    parts = split_by_tool(work, tool, scene.moving_tools), split_by_tool(friction, tool, scene.rubbing_tools)
    pairs = zip(before, parts, strict=True)
    return ToolEnergies(*(tuple(old + jnp.sum(new) for old, new in zip(*pair, strict=True)) for pair in pairs))


def _synchronize_slip(
    packed: PackedState, scene: Scene, active: ActiveSet, nodal: Any, free: Any
) -> tuple[membrane.Vector, ContactLosses, jax.Array]:
    """The velocities with contact, from the `free` ones without; the losses of nodes on tools; True for these (n,).

    The tools act on the nodes in this half step, too, but the nodes do not move.
    """
    own, half = packed.nodes, 0.5 * packed.control.step_length
    sliding = sliding_nodes(own.stuck, own.wall)
    slide_input = SlideInput.from_nodes(own, free, nodal, (active.mass, active.compliance), sliding)
    frames = scene.frames(packed.time - packed.control.step_length, packed.time)
    steps = half, jnp.zeros_like(half)
    slid = slide_nodes(slide_input, steps, scene.surfaces, frames, scene.solver.damping, differentiable=True)
    return slid.velocities, slid.losses, sliding

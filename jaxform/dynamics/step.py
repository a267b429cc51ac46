"""One step of the central-difference scheme: forces, velocities, positions, contact, and user-defined fields.

Every loop uses this step. It has two forms of the same arithmetic: `_advance_nodes` on whole arrays, for derivatives,
and `_advance_nodes_in_blocks`, for runs.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from jaxform.contact.broad_phase import Candidates
from jaxform.contact.facet_slip import KnownFacets, find_facets, slide_within_facets
from jaxform.contact.sliding import ContactLosses, SlideInput, ToolEnergies, slide_nodes, sliding_nodes, split_by_tool
from jaxform.dynamics.contact_step import check_free_flight, replay_contact, search_contact, update_broad_phase
from jaxform.dynamics.edge_step import hold_sides_at_edges
from jaxform.dynamics.window_state import KnownContact, WindowData, WindowState
from jaxform.kernels.blocks import (
    entry,
    lax_cond_once,
    list_marked,
    materialize,
    on_cpu,
    over_blocks,
    put,
    slice_at,
    total,
)
from jaxform.mechanics import membrane
from jaxform.mechanics.constitutive import ViscousMemory, present_memory
from jaxform.mechanics.corners import (
    HistoryUpdate,
    Load,
    corner_forces,
    present_mode_stress,
    update_history,
    viscous_corner_forces,
)
from jaxform.mechanics.elements import Corners, gather_shares, gather_table
from jaxform.mechanics.force import force
from jaxform.mechanics.membrane import vector
from jaxform.model.field import Surroundings, advance_fields
from jaxform.model.scene import Scene
from jaxform.sheet.energy_balance import pressure_at, pressure_work, rim_ends, rim_swept_volume
from jaxform.sheet.scheme import (
    add_by_tool,
    add_gravity,
    apply_tool_velocity,
    touches_no_tool,
    unresolved_energy,
    unresolved_share,
    update_velocity,
)
from jaxform.tools.mold import ToolFrame, tool_velocity


def step(
    current: WindowState,
    pressures: tuple[jax.Array, ...],
    scene: Scene,
    data: WindowData,
    contact: tuple[Candidates, ...] | KnownContact | None = None,
) -> WindowState:
    """The window state after one step of the central-difference scheme (the paper's Eq. 8 with damping) and contact.

    Args:
        current: The window state before the step.
        pressures: Pressure at the step's begin, its mean since the begin of the last step [Pa], and the time over
            which forces accelerate the velocity [s].
        scene: The scene.
        data: Constants of the window.
        contact: Candidates of each surface, among which contact is searched, or known contact; None without surfaces.
    """
    pressure, mean_pressure, velocity_step = pressures
    length = data.length
    if contact is not None and not isinstance(contact, KnownContact):
        current = update_broad_phase(current, scene, data, contact)
    if current.corners is None:
        # The remaining steps of a halted window have the length zero, so that they change nothing.
        length, velocity_step = jnp.where(current.halted, 0.0, length), jnp.where(current.halted, 0.0, velocity_step)
    rim = None if data.rim is None else materialize(rim_ends(current.nodes.positions, data.rim))
    begin = data.begin + current.count * data.length
    last = load_state = current.account.load_state
    if last is not None:
        volume = data.active.volume(jnp.asarray(current.nodes.positions))
        # The velocity's step is half of the last one and half of this one.
        load_state = pressure_at(current.account, scene, begin, 2.0 * velocity_step - length, volume)
        pressure, mean_pressure = load_state.pressure, 0.5 * (last.pressure + load_state.pressure)
    frames = scene.frames(begin, begin + length)
    response = data.active.response(scene.material, _memory(current, scene, data))
    load = Load(current.nodes.positions, data.active.thickness, pressure, *response)
    if current.corners is None:
        advanced = _advance_nodes(load, current, velocity_step, length, scene, data, frames)
    else:
        advanced = _advance_nodes_in_blocks(load, current, current.corners, velocity_step, length, scene, data, frames)
    volume, account = advanced.volume + data.active.inactive_volume, current.account
    swept = account.swept_volume(volume)
    if current.corners is None:
        # A halted window keeps its account, as a loop would that ends with its last step.
        volume, swept = jnp.where(current.halted, account.volume, volume), jnp.where(current.halted, 0.0, swept)
    moved = dataclasses.replace(
        current,
        nodes=dataclasses.replace(
            current.nodes, positions=advanced.positions, velocities=advanced.velocities, **_contact_change(advanced)
        ),
        account=dataclasses.replace(
            account,
            volume=volume,
            load_state=jax.tree.map(lambda old, new: jnp.where(current.halted, old, new), last, load_state),
            external_work=account.external_work + pressure_work(mean_pressure, swept),
            damping_loss=account.damping_loss + advanced.loss,
            unresolved=None if account.unresolved is None else account.unresolved + advanced.unresolved,
            tool_work=None if account.tool_work is None else account.tool_work + advanced.work,
            contact_loss=account.contact_loss if advanced.slid is None else account.contact_loss + advanced.impact,
            friction_loss=None if account.friction_loss is None else account.friction_loss + advanced.friction,
            viscous_loss=_add_viscous_loss(current, length, advanced.history),
            by_tool=jax.tree.map(jnp.add, account.by_tool, advanced.by_tool),
        ),
        memory=_update_memory(current, advanced.history),
        count=current.count + jnp.where(current.halted, 0, 1),
        corners=advanced.corners,
        facets=None if advanced.slid is None else advanced.slid.facets,
    )
    if current.held is not None and contact is not None:
        moved = hold_sides_at_edges(current, moved, (velocity_step, length), scene, data, frames)
    if isinstance(contact, KnownContact):
        assert advanced.forces is not None
        before, forces = current.nodes.velocities, advanced.forces
        moved = replay_contact(moved, before, forces, length, scene, contact, data, frames)
    elif contact is not None:
        over = None if advanced.slid is None else advanced.slid.over
        moved = search_contact(moved, length, contact, scene, data, frames, over, velocity_step)
    elif current.corners is None:
        moved = dataclasses.replace(moved, halted=check_free_flight(moved, scene, data))
    moved = _add_rim_volume(moved, current.halted, rim, data)
    return _advance_fields(moved, current.halted, length, scene, data) if scene.fields else moved


def _contact_change(advanced: _AdvancedNodes) -> dict[str, jax.Array]:
    """The nodes' contact after the step, where nodes may slide."""
    if advanced.slid is None:
        return {}
    return {"wall": advanced.slid.wall, "contact_time": advanced.slid.contact_time, "slip": advanced.slid.distance}


def _add_rim_volume(moved: WindowState, halted: jax.Array, before: jax.Array | None, data: WindowData) -> WindowState:
    """Adds the volume swept by moving rims in the step, from their ends `before`, unless the window was halted."""
    last = moved.account.rim
    if before is None or data.rim is None or last is None:
        return moved
    swept = rim_swept_volume(before, rim_ends(moved.nodes.positions, data.rim), data.active.packed.elements.origin)
    kept = swept if moved.corners is not None else jnp.where(halted, last, swept)
    return dataclasses.replace(moved, account=dataclasses.replace(moved.account, rim=kept))


def _memory(current: WindowState, scene: Scene, data: WindowData) -> ViscousMemory | None:
    """History of the elements at the step's begin; in the first step of a window it is the stress of the modes."""
    modes = scene.material.viscous
    if modes is None or current.memory is None or data.recursion is None:
        return None
    gain = jnp.where(current.count == 0, 0.0, data.recursion[1])
    return dataclasses.replace(present_memory(current.memory, modes), gain=gain)


def _add_viscous_loss(current: WindowState, length: jax.Array, history: HistoryUpdate | None) -> jax.Array | None:
    """Viscous loss up to half a step after the step's begin, by trapezoids; in the first step, from its begin."""
    before = current.account.viscous_loss
    if before is None or history is None:
        return before
    return before + jnp.where(current.count == 0, 0.5, 1.0) * length * history[1]


def _update_memory(current: WindowState, history: HistoryUpdate | None) -> jax.Array | None:
    """History of the elements after the step; unchanged in a halted window."""
    if history is None or current.memory is None or current.corners is not None:
        return None if history is None else history[0]
    return jnp.where(current.halted, current.memory, history[0])


def stop_landed_nodes(current: WindowState, scene: Scene, data: WindowData) -> WindowState:
    """A window's state at its end, with the nodes of the last step's landings at their landing points, and at rest."""
    if not scene.lands_smoothly:
        return current
    nodes, damping = current.nodes, scene.solver.damping
    half = 0.0 if damping is None else 0.5 * damping * data.length
    back = jnp.where(nodes.stuck, (1.0 - half) / (1.0 + half) * data.length * nodes.velocities, 0.0)
    velocities = jnp.where(nodes.stuck, 0.0, nodes.velocities)
    at_rest = dataclasses.replace(nodes, positions=nodes.positions + back, velocities=velocities)
    return dataclasses.replace(current, nodes=at_rest)


def finalize_history(current: WindowState, scene: Scene, data: WindowData) -> WindowState:
    """The window state at a window's end: its memory is the stress of the Prony terms, its viscous loss complete."""
    memory, lost = _memory(current, scene, data), current.account.viscous_loss
    modes = data.loss_modes
    if memory is None or modes is None or lost is None:
        return current
    load = Load(current.nodes.positions, data.active.thickness, data.length, scene.material.elastic, memory)
    stress, rate = present_mode_stress(load, data.active.packed.elements, modes, differentiable=current.corners is None)
    lost += jnp.where(current.count == 0, 0.0, 0.5) * data.length * rate
    return dataclasses.replace(current, memory=stress, account=dataclasses.replace(current.account, viscous_loss=lost))


def _advance_fields(
    moved: WindowState, halted: jax.Array, length: jax.Array, scene: Scene, data: WindowData
) -> WindowState:
    """Advances the user-defined fields by the step, unless the window was halted before it."""
    nodes = moved.nodes
    step = Surroundings(
        time=data.begin + moved.count * data.length,
        length=length,
        positions=jnp.asarray(nodes.positions),
        velocities=nodes.velocities,
        stuck=nodes.stuck,
        contact_time=nodes.contact_time,
    )
    new = advance_fields(scene.fields, moved.fields, step)
    kept = jax.tree.map(lambda state, old: jnp.where(halted, old, state), new, moved.fields)
    return dataclasses.replace(moved, fields=kept)


class _SlideContact(NamedTuple):
    """Contact of nodes (n,) after a step in which they may have slid.

    Attributes:
        wall, contact_time: As in `Nodes`.
        distance: Slip distance, as `slip` in `Nodes` [m].
        over: True where a node left a tool over its edge.
        facets: Facets on which nodes lie; None where derivatives are taken.
    """

    wall: jax.Array
    contact_time: jax.Array
    distance: jax.Array
    over: jax.Array
    facets: KnownFacets | None = None


class _AdvancedNodes(NamedTuple):
    """Nodes after a step, before new contacts, and the energies of the step.

    Attributes:
        positions: Positions after the step [m].
        velocities: Velocities half a step before them [m/s].
        volume: Volume enclosed by the active elements at the step's begin [m^3].
        loss: Damping loss [J].
        corners: Workspace for corner forces, as in `WindowState`.
        history: History of the Prony terms and the viscous power; None without Prony terms.
        work: Work of moving tools [J].
        friction, impact: Losses of sliding nodes by friction and by impact [J].
        slid: Contact of nodes that may have slid; None where no node can slide.
        by_tool: Work and friction of each tool.
        unresolved: Energy that the step misses, as in `scheme.unresolved_energy` [J].
        forces: Forces on the nodes [N]; None in blocks, whose corner forces are kept.
    """

    positions: jax.Array | membrane.Vector
    velocities: jax.Array
    volume: jax.Array
    loss: jax.Array | float
    corners: Corners | None
    history: HistoryUpdate | None
    work: jax.Array | float = 0.0
    friction: jax.Array | float = 0.0
    impact: jax.Array | float = 0.0
    slid: _SlideContact | None = None
    by_tool: ToolEnergies = ToolEnergies()
    unresolved: jax.Array | float = 0.0
    forces: jax.Array | None = None


def _no_energies(scene: Scene, real: Any) -> ToolEnergies:
    """Zero work and friction of each tool."""
    zero = jnp.zeros((), real)
    return ToolEnergies(*((zero,) * len(numbers) for numbers in (scene.moving_tools, scene.rubbing_tools)))


def _advance_nodes(
    load: Load,
    current: WindowState,
    velocity_step: jax.Array,
    length: jax.Array,
    scene: Scene,
    data: WindowData,
    frames: tuple[ToolFrame | None, ...],
) -> _AdvancedNodes:
    nodal, volume = force(load, data.active.packed.elements)
    nodal = add_gravity(nodal, data.active.mass, scene.solver.gravity)
    state = current.nodes
    nodes = state.stuck, data.active.mass, data.active.compliance
    velocities, losses = update_velocity(nodal, state.velocities, nodes, velocity_step, scene.solver.damping)
    work: jax.Array | float = 0.0
    missed: jax.Array | float = 0.0
    if unresolved_share(scene) is not None:
        both, free = (state.velocities, velocities), touches_no_tool(state.stuck, state.wall, _on_edge(current))
        missed = total(unresolved_energy(nodal, both, free, (velocity_step, length), scene))
    by_tool = _no_energies(scene, state.velocities.dtype)
    carrier = tool_velocity(frames, state.tool)
    if carrier is not None:
        both = state.velocities, velocities
        velocities, held, done = apply_tool_velocity(nodal, both, nodes, state.wall, velocity_step, carrier)
        work, losses = total(done), None if losses is None else jnp.where(held, 0.0, losses)
        # In a halted window tools do not move nodes, and do no work.
        velocities = [jnp.where(current.halted, old, new) for old, new in zip(both[0], velocities, strict=True)]
        work = jnp.where(current.halted, 0.0, work)
        by_tool = add_by_tool(by_tool, scene, state.tool, jnp.where(current.halted, 0.0, done))
    positions = state.positions + length * jnp.stack(velocities)
    if scene.lands_smoothly:
        at_rest = state.stuck & ~current.halted
        velocities = [jnp.where(at_rest, 0.0, v) for v in velocities]
        losses = None if losses is None else jnp.where(at_rest, 0.0, losses)
    history, modes = None, data.loss_modes
    if modes is not None and data.recursion is not None:
        history = update_history(load, data.active.packed.elements, modes, data.recursion)
    loss = total(losses) if losses is not None else 0.0
    advanced = _AdvancedNodes(
        positions, jnp.stack(velocities), volume, loss, None, history, work, by_tool=by_tool, unresolved=missed
    )
    advanced = advanced._replace(forces=jnp.stack(nodal) if scene.surfaces else None)
    if state.slip is None:
        return advanced
    sliding = sliding_nodes(state.stuck, state.wall) & ~current.halted
    slide_input = SlideInput.from_nodes(state, velocities, nodal, nodes[1:], sliding)
    slid = slide_nodes(
        slide_input, (velocity_step, length), scene.surfaces, frames, scene.solver.damping, differentiable=True
    )
    lost = slid.losses
    damped = 0.0 if losses is None else total(jnp.where(sliding, lost.damping, losses))
    return advanced._replace(
        positions=jnp.stack(slid.positions),
        velocities=jnp.stack(slid.velocities),
        loss=damped,
        work=work + total(lost.work),
        friction=total(lost.friction),
        impact=total(lost.impact),
        by_tool=add_by_tool(by_tool, scene, state.tool, lost.work, lost.friction),
        slid=_SlideContact(
            slid.wall,
            jnp.where(slid.left, -1.0, state.contact_time),
            state.slip + jnp.where(sliding, slid.distance, 0.0),
            slid.over,
        ),
    )


def _advance_nodes_in_blocks(
    load: Load,
    current: WindowState,
    corners: Corners,
    velocity_step: jax.Array,
    length: jax.Array,
    scene: Scene,
    data: WindowData,
    frames: tuple[ToolFrame | None, ...],
) -> _AdvancedNodes:
    """Advances elements and nodes in one pass over each of those in use; not differentiable."""
    elements = data.active.packed.elements
    modes, history = data.loss_modes, None
    if modes is None or data.recursion is None:
        corners, volume = corner_forces(load, elements, corners)
    else:
        corners, volume, history = viscous_corner_forces(load, elements, corners, modes, data.recursion)
    nodes = current.nodes.stuck, data.active.mass, data.active.compliance
    state, missed = current.nodes, 0.0
    if unresolved_share(scene) is not None:
        missed = _unresolved_energy(corners, current, (velocity_step, length), scene, data)
        # All is read before anything is written (docs/explanation/kernels.md).
        missed, both = materialize((missed, (state.positions, state.velocities)))
        state = dataclasses.replace(state, positions=both[0], velocities=both[1])
    moves, slides = any(frame is not None for frame in frames), scene.slides

    surfaces, damping, moving_tools = scene.surfaces, scene.solver.damping, scene.moving_tools
    split_count = len(moving_tools) + len(scene.rubbing_tools)

    def advance_block(old: Any, table: Any, nodes: Any, wall: Any, tool: Any, facets: Any, temperature: Any) -> Any:
        (x,), (y,), (z,), before, *slip = old
        nodal, sums = add_gravity(gather_shares(corners, table), nodes[1], scene.solver.gravity), []
        velocities, losses = update_velocity(nodal, before, nodes, velocity_step, damping)
        if moves:
            carrier = tool_velocity(frames, tool)
            velocities, held, done = apply_tool_velocity(
                nodal, (before, velocities), nodes, wall, velocity_step, carrier
            )
            sums = [done, *split_by_tool(done, tool, moving_tools)]
            losses = None if losses is None else jnp.where(held, 0.0, losses)
        new = vector(x + length * v for x, v in zip((x, y, z), velocities, strict=True))
        if scene.lands_smoothly:
            velocities = vector(jnp.where(nodes[0], 0.0, v) for v in velocities)
            losses = None if losses is None else jnp.where(nodes[0], 0.0, losses)
        if not slides:
            new = materialize(new)
            return [*([x] for x in new), velocities], sums if losses is None else [losses, *sums]
        slid_from = dataclasses.replace(
            state, positions=(x, y, z), velocities=before, wall=wall, tool=tool, temperature=temperature
        )
        sliding = sliding_nodes(nodes[0], wall)
        slide_input = SlideInput.from_nodes(slid_from, materialize(velocities), nodal, nodes[1:], sliding)
        slid = slide_within_facets(slide_input, facets, (velocity_step, length), surfaces, frames, damping)
        (place, on_tool), stays, lost, distance = slid
        # Nodes that leave their triangle are moved by `_walk_nodes`.
        new = _choose(stays, place, _choose(sliding, (x, y, z), new))
        velocities = _choose(stays, on_tool, _choose(sliding, before, velocities))
        done = [jnp.where(stays, lost.work, jnp.where(sliding, 0.0, each)) for each in sums[:1]]
        friction, impact = (jnp.where(stays, each, 0.0) for each in (lost.friction, lost.impact))
        sums = [*done, *(x for each in done for x in split_by_tool(each, tool, moving_tools))]
        sums += [*split_by_tool(friction, tool, scene.rubbing_tools), friction, impact]
        losses = None if losses is None else jnp.where(stays, lost.damping, jnp.where(sliding, 0.0, losses))
        walks = sliding & ~stays
        slip = slip[0][0] + jnp.where(stays, distance, 0.0)
        rows = [*([x] for x in materialize(new)), velocities, [slip], [walks]]
        return rows, [*([] if losses is None else [losses]), *sums, walks]

    inputs = (
        gather_table(elements),
        nodes,
        state.wall if moves or slides else None,
        state.tool if moves or slides else None,
        current.facets,
        state.temperature,
    )
    into = [*(x[None] for x in state.positions), state.velocities]
    if state.slip is not None:
        into += [state.slip[None], jnp.zeros_like(state.stuck)[None]]
    damped = damping is not None
    # Positions, velocities and slip are each read by what is written there alone, so that neither need be copied.
    new, sums = over_blocks(
        advance_block,
        elements.node_block_count,
        inputs,
        into,
        sums=damped + moves + split_count + 3 * slides,
        update=4 + slides,
        kept=slides or moves,
    )
    loss, *sums = sums if damped else (0.0, *sums)
    advanced = _AdvancedNodes(
        vector(row for (row,) in new[:3]), new[3], volume, loss, corners, history, sums[0] if moves else 0.0
    )
    by_tool = ToolEnergies(*_split_at(sums[moves : moves + split_count], len(moving_tools)))
    advanced = advanced._replace(by_tool=by_tool, unresolved=missed)
    if not slides:
        return advanced
    friction, impact, walking = sums[-3:]
    contact = _SlideContact(state.wall, state.contact_time, new[4][0], jnp.zeros_like(state.stuck), current.facets)
    advanced = advanced._replace(friction=friction, impact=impact, slid=contact)
    return _walk_nodes(advanced, current, new[5][0], walking > 0.0, (velocity_step, length), scene, data, frames)


def _unresolved_energy(
    corners: Corners, current: WindowState, steps: tuple[jax.Array, jax.Array], scene: Scene, data: WindowData
) -> jax.Array:
    """The sum of `unresolved_energy` [J], by a pass over no nodes where the step is as long as the one before."""
    own, elements = current.nodes, data.active.packed.elements

    def sum_block(table: Any, nodes: Any, before: Any, wall: Any, on_edge: Any) -> Any:
        nodal = add_gravity(gather_shares(corners, table), nodes[1], scene.solver.gravity)
        after, _ = update_velocity(nodal, before, nodes, steps[0], scene.solver.damping)
        free = touches_no_tool(nodes[0], wall, on_edge)
        return [], [unresolved_energy(nodal, (before, after), free, steps, scene)]

    nodes = own.stuck, data.active.mass, data.active.compliance
    inputs = gather_table(elements), nodes, own.velocities, own.wall, _on_edge(current)
    count = jnp.where(steps[0] == steps[1], 0, elements.node_block_count)
    return over_blocks(sum_block, count, inputs, [], sums=1)[1][0]


def _on_edge(current: WindowState) -> jax.Array | None:
    """True for nodes (n,) that are the end of a side held at an edge; None where none can be."""
    return None if current.held is None else current.held.has_end(current.nodes.wall.size)


def _split_at(values: list[jax.Array], place: int) -> tuple[tuple[jax.Array, ...], tuple[jax.Array, ...]]:
    """The values before a place and those from there on."""
    return tuple(values[:place]), tuple(values[place:])


def _choose(chosen: jax.Array, new: membrane.Vector, old: membrane.Vector) -> membrane.Vector:
    """The new vectors of the chosen nodes (n,), and the old ones of the others."""
    return vector(jnp.where(chosen, one, other) for one, other in zip(new, old, strict=True))


_LANES = 16  # nodes that are walked together


_Walking = tuple[membrane.Vector, jax.Array, _SlideContact, ContactLosses, ToolEnergies]
"""Data of nodes (n,) that a walk over facets changes.

Positions, velocities, contact, the losses of all nodes so far, and the energies of each tool [J].
"""


def _walk_nodes(
    advanced: _AdvancedNodes,
    current: WindowState,
    walks: jax.Array,
    any_walks: jax.Array,
    steps: tuple[jax.Array, jax.Array],
    scene: Scene,
    data: WindowData,
    frames: tuple[ToolFrame | None, ...],
) -> _AdvancedNodes:
    """Advances the nodes (n,) that leave their triangles, which have not been moved yet; not differentiable."""
    state, damping, corners = current.nodes, scene.solver.damping, advanced.corners
    assert corners is not None and advanced.slid is not None
    slots = data.active.packed.elements.slots

    def walk(node: jax.Array, before: _Walking, sliding: jax.Array) -> _Walking:
        """The data of the nodes with these numbers (n,) after their walk, from those before it."""
        every = state.stuck, data.active.mass, data.active.compliance, state.tool, state.temperature
        stuck, mass, compliance, tool, temperature = jax.tree.map(lambda values: membrane.gather(values, node), every)
        table = membrane.gather(slots, node), jnp.int32(len(slots))
        nodal = add_gravity(gather_shares(corners, table), mass, scene.solver.gravity)
        places, speeds, touching, lost, by_tool = before
        old = vector(speeds)
        free, _ = update_velocity(nodal, old, (stuck, mass, compliance), steps[0], damping)
        slid_from = dataclasses.replace(
            state, positions=places, velocities=old, wall=touching.wall, tool=tool, temperature=temperature
        )
        slide_input = SlideInput.from_nodes(slid_from, free, nodal, (mass, compliance), sliding)
        slid = materialize(slide_nodes(slide_input, steps, scene.surfaces, frames, damping, differentiable=False))
        time = jnp.where(slid.left, -1.0, touching.contact_time)
        far = touching.distance + jnp.where(sliding, slid.distance, 0.0)
        known = find_facets(slid.wall, tool, slide_input.mobile, scene.surfaces)
        contact = _SlideContact(slid.wall, time, far, slid.over, known)
        new = ContactLosses(*(jnp.where(sliding, each, 0.0) for each in slid.losses))
        total = jax.tree.map(lambda before, each: before + jnp.sum(each), lost, new)
        by_tool = add_by_tool(by_tool, scene, tool, new.work, new.friction)
        return slid.positions, jnp.stack(slid.velocities), contact, total, by_tool

    none = jnp.zeros((), state.velocities.dtype)
    start = (
        vector(advanced.positions),
        advanced.velocities,
        advanced.slid,
        ContactLosses(none, none, none, none),
        advanced.by_tool,
    )

    def walk_all(start: _Walking) -> _Walking:
        if on_cpu():
            return _in_groups(walk, start, walks, data.active.packed.elements.node_block_count)
        new = walk(jnp.arange(walks.size), start, walks)
        return jax.tree.map(lambda one, other: jnp.where(walks, one, other) if one.ndim else one, new, start)

    positions, velocities, slid, losses, by_tool = lax_cond_once(any_walks, walk_all, materialize(start))
    return advanced._replace(
        positions=positions,
        velocities=velocities,
        slid=slid,
        work=advanced.work + losses.work,
        friction=advanced.friction + losses.friction,
        impact=advanced.impact + losses.impact,
        loss=advanced.loss + losses.damping,
        by_tool=by_tool,
    )


def _in_groups(
    walk: Callable[[jax.Array, _Walking, jax.Array], _Walking],
    start: _Walking,
    walks: jax.Array,
    block_count: jax.Array,
) -> _Walking:
    """The data of all nodes after the walks of those marked (n,), `_LANES` at a time."""
    listed, count = list_marked(walks, block_count)

    def take(group: jax.Array, data: _Walking) -> _Walking:
        node = slice_at(listed, group * _LANES, _LANES)
        left = jnp.minimum(count - group * _LANES, _LANES)
        before = jax.tree.map(lambda x: membrane.gather(x, node) if x.ndim else x, data)
        # All is read before anything is written (docs/explanation/kernels.md).
        before, data = materialize((before, data))
        new = materialize(walk(node, before, jnp.arange(_LANES) < left))

        def write(lane: jax.Array, data: _Walking) -> _Walking:
            return jax.tree.map(
                lambda old, x: put(old, slice_at(x, lane, 1), entry(node, lane)) if x.ndim else x, data, new
            )

        return jax.lax.fori_loop(0, left, write, data)

    return jax.lax.fori_loop(0, -(-count // _LANES), take, start)

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
from jaxform.contact.sliding import ContactLosses, LyingNodes, ToolEnergies, lying_nodes, slide_nodes, split_by_tool
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
from jaxform.sheet.scheme import add_by_tool, add_gravity, apply_tool_velocity, update_velocity
from jaxform.tools.mold import ToolFrame, tool_velocity


def step(
    moving: WindowState,
    pressures: tuple[jax.Array, ...],
    scene: Scene,
    data: WindowData,
    contact: tuple[Candidates, ...] | KnownContact | None = None,
) -> WindowState:
    """The window state after one step of the central-difference scheme (the paper's Eq. 8 with damping) and contact.

    Args:
        moving: The window state before the step.
        pressures: Pressure at the step's begin, its mean since the begin of the last step [Pa], and the time over
            which forces accelerate the velocity [s].
        scene: The scene.
        data: Constants of the window.
        contact: Candidates of each surface, among which contact is searched, or known contact; None without surfaces.
    """
    pressure, mean_pressure, velocity_step = pressures
    length = data.length
    if contact is not None and not isinstance(contact, KnownContact):
        moving = update_broad_phase(moving, scene, data, contact)
    if moving.room is None:
        # The remaining steps of a halted window have the length zero, so that they change nothing.
        length, velocity_step = jnp.where(moving.halted, 0.0, length), jnp.where(moving.halted, 0.0, velocity_step)
    rim = None if data.rim is None else materialize(rim_ends(moving.nodes.positions, data.rim))
    begin = data.begin + moving.count * data.length
    last = pressed = moving.account.load_state
    if last is not None:
        volume = data.active.volume(jnp.asarray(moving.nodes.positions))
        # The velocity's step is half of the last one and half of this one.
        pressed = pressure_at(moving.account, scene, begin, 2.0 * velocity_step - length, volume)
        pressure, mean_pressure = pressed.pressure, 0.5 * (last.pressure + pressed.pressure)
    frames = scene.frames(begin, begin + length)
    response = data.active.response(scene.material, _memory(moving, scene, data))
    load = Load(moving.nodes.positions, data.active.thickness, pressure, *response)
    if moving.room is None:
        taken = _advance_nodes(load, moving, velocity_step, length, scene, data, frames)
    else:
        taken = _advance_nodes_in_blocks(load, moving, moving.room, velocity_step, length, scene, data, frames)
    volume, account = taken.volume + data.active.idle_volume, moving.account
    swept = account.swept_volume(volume)
    if moving.room is None:
        # A halted window keeps its account, as a loop would that ends with its last step.
        volume, swept = jnp.where(moving.halted, account.volume, volume), jnp.where(moving.halted, 0.0, swept)
    moved = dataclasses.replace(
        moving,
        nodes=dataclasses.replace(
            moving.nodes, positions=taken.positions, velocities=taken.velocities, **_contact_change(taken)
        ),
        account=dataclasses.replace(
            account,
            volume=volume,
            load_state=jax.tree.map(lambda old, new: jnp.where(moving.halted, old, new), last, pressed),
            external_work=account.external_work + pressure_work(mean_pressure, swept),
            damping_loss=account.damping_loss + taken.loss,
            tool_work=None if account.tool_work is None else account.tool_work + taken.work,
            contact_loss=account.contact_loss if taken.slid is None else account.contact_loss + taken.impact,
            friction_loss=None if account.friction_loss is None else account.friction_loss + taken.friction,
            viscous_loss=_add_viscous_loss(moving, length, taken.remembered),
            by_tool=jax.tree.map(jnp.add, account.by_tool, taken.by_tool),
        ),
        memory=_update_memory(moving, taken.remembered),
        count=moving.count + jnp.where(moving.halted, 0, 1),
        room=taken.room,
        facets=None if taken.slid is None else taken.slid.facets,
    )
    if moving.held is not None and contact is not None:
        moved = hold_sides_at_edges(moving, moved, (velocity_step, length), scene, data, frames)
    if isinstance(contact, KnownContact):
        moved = replay_contact(moved, moving.nodes.velocities, length, scene, contact, data, frames)
    elif contact is not None:
        over = None if taken.slid is None else taken.slid.over
        moved = search_contact(moved, length, contact, scene, data, frames, over, velocity_step)
    elif moving.room is None:
        moved = dataclasses.replace(moved, halted=check_free_flight(moved, scene, data))
    moved = _add_rim_volume(moved, moving.halted, rim, data)
    return _advance_fields(moved, moving.halted, length, scene, data) if scene.fields else moved


def _contact_change(taken: _AdvancedNodes) -> dict[str, jax.Array]:
    """The nodes' contact after the step, where nodes may slide."""
    if taken.slid is None:
        return {}
    return {"wall": taken.slid.wall, "contact_time": taken.slid.contact_time, "slip": taken.slid.distance}


def _add_rim_volume(moved: WindowState, halted: jax.Array, before: jax.Array | None, data: WindowData) -> WindowState:
    """Adds the volume swept by moving rims in the step, from their ends `before`, unless the window was halted."""
    last = moved.account.rim
    if before is None or data.rim is None or last is None:
        return moved
    swept = rim_swept_volume(before, rim_ends(moved.nodes.positions, data.rim), data.active.packed.elements.origin)
    kept = swept if moved.room is not None else jnp.where(halted, last, swept)
    return dataclasses.replace(moved, account=dataclasses.replace(moved.account, rim=kept))


def _memory(moving: WindowState, scene: Scene, data: WindowData) -> ViscousMemory | None:
    """History of the elements at the step's begin; in the first step of a window it is the stress of the modes."""
    modes = scene.material.viscous
    if modes is None or moving.memory is None or data.recursion is None:
        return None
    gain = jnp.where(moving.count == 0, 0.0, data.recursion[1])
    return dataclasses.replace(present_memory(moving.memory, modes), gain=gain)


def _add_viscous_loss(moving: WindowState, length: jax.Array, remembered: HistoryUpdate | None) -> jax.Array | None:
    """Viscous loss up to half a step after the step's begin, by trapezoids; in the first step, from its begin."""
    before = moving.account.viscous_loss
    if before is None or remembered is None:
        return before
    return before + jnp.where(moving.count == 0, 0.5, 1.0) * length * remembered[1]


def _update_memory(moving: WindowState, remembered: HistoryUpdate | None) -> jax.Array | None:
    """History of the elements after the step; unchanged in a halted window."""
    if remembered is None or moving.memory is None or moving.room is not None:
        return None if remembered is None else remembered[0]
    return jnp.where(moving.halted, moving.memory, remembered[0])


def stop_landed_nodes(moving: WindowState, scene: Scene, data: WindowData) -> WindowState:
    """A window's state at its end, with the nodes of the last step's landings at their landing points, and at rest."""
    if not scene.lands_smoothly:
        return moving
    nodes, damping = moving.nodes, scene.solver.damping
    half = 0.0 if damping is None else 0.5 * damping * data.length
    back = jnp.where(nodes.stuck, (1.0 - half) / (1.0 + half) * data.length * nodes.velocities, 0.0)
    velocities = jnp.where(nodes.stuck, 0.0, nodes.velocities)
    at_rest = dataclasses.replace(nodes, positions=nodes.positions + back, velocities=velocities)
    return dataclasses.replace(moving, nodes=at_rest)


def finalize_history(moving: WindowState, scene: Scene, data: WindowData) -> WindowState:
    """The window state at a window's end: its memory is the stress of the Prony terms, its viscous loss complete."""
    memory, lost = _memory(moving, scene, data), moving.account.viscous_loss
    modes = data.losing
    if memory is None or modes is None or lost is None:
        return moving
    load = Load(moving.nodes.positions, data.active.thickness, data.length, scene.material.elastic, memory)
    stress, rate = present_mode_stress(load, data.active.packed.elements, modes, differentiable=moving.room is None)
    lost += jnp.where(moving.count == 0, 0.0, 0.5) * data.length * rate
    return dataclasses.replace(moving, memory=stress, account=dataclasses.replace(moving.account, viscous_loss=lost))


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
    kept = jax.tree.map(lambda own, old: jnp.where(halted, old, own), new, moved.fields)
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
        room: Workspace for corner forces, as in `WindowState`.
        remembered: History of the Prony terms and the viscous power; None without Prony terms.
        work: Work of moving tools [J].
        friction, impact: Losses of sliding nodes by friction and by impact [J].
        slid: Contact of nodes that may have slid; None where no node can slide.
        by_tool: Work and friction of each tool.
    """

    positions: jax.Array | membrane.Vector
    velocities: jax.Array
    volume: jax.Array
    loss: jax.Array | float
    room: Corners | None
    remembered: HistoryUpdate | None
    work: jax.Array | float = 0.0
    friction: jax.Array | float = 0.0
    impact: jax.Array | float = 0.0
    slid: _SlideContact | None = None
    by_tool: ToolEnergies = ToolEnergies()


def _no_energies(scene: Scene, real: Any) -> ToolEnergies:
    """Zero work and friction of each tool."""
    zero = jnp.zeros((), real)
    return ToolEnergies(*((zero,) * len(numbers) for numbers in (scene.moving_tools, scene.rubbing_tools)))


def _advance_nodes(
    load: Load,
    moving: WindowState,
    velocity_step: jax.Array,
    length: jax.Array,
    scene: Scene,
    data: WindowData,
    frames: tuple[ToolFrame | None, ...],
) -> _AdvancedNodes:
    nodal, volume = force(load, data.active.packed.elements)
    nodal = add_gravity(nodal, data.active.mass, scene.solver.gravity)
    own = moving.nodes
    nodes = own.stuck, data.active.mass, data.active.compliance
    velocities, losses = update_velocity(nodal, own.velocities, nodes, velocity_step, scene.solver.damping)
    work: jax.Array | float = 0.0
    by_tool = _no_energies(scene, own.velocities.dtype)
    carrier = tool_velocity(frames, own.tool)
    if carrier is not None:
        both = own.velocities, velocities
        velocities, held, done = apply_tool_velocity(nodal, both, nodes, own.wall, velocity_step, carrier)
        work, losses = total(done), None if losses is None else jnp.where(held, 0.0, losses)
        # In a halted window tools do not move nodes, and do no work.
        velocities = [jnp.where(moving.halted, old, new) for old, new in zip(both[0], velocities, strict=True)]
        work = jnp.where(moving.halted, 0.0, work)
        by_tool = add_by_tool(by_tool, scene, own.tool, jnp.where(moving.halted, 0.0, done))
    positions = own.positions + length * jnp.stack(velocities)
    if scene.lands_smoothly:
        at_rest = own.stuck & ~moving.halted
        velocities = [jnp.where(at_rest, 0.0, v) for v in velocities]
        losses = None if losses is None else jnp.where(at_rest, 0.0, losses)
    rest, modes = None, data.losing
    if modes is not None and data.recursion is not None:
        rest = update_history(load, data.active.packed.elements, modes, data.recursion)
    loss = total(losses) if losses is not None else 0.0
    taken = _AdvancedNodes(positions, jnp.stack(velocities), volume, loss, None, rest, work, by_tool=by_tool)
    if own.slip is None:
        return taken
    lies = lying_nodes(own.stuck, own.wall) & ~moving.halted
    lying = LyingNodes.of(own, velocities, nodal, nodes[1:], lies)
    slid = slide_nodes(
        lying, (velocity_step, length), scene.surfaces, frames, scene.solver.damping, differentiable=True
    )
    lost = slid.losses
    damped = 0.0 if losses is None else total(jnp.where(lies, lost.damping, losses))
    return taken._replace(
        positions=jnp.stack(slid.positions),
        velocities=jnp.stack(slid.velocities),
        loss=damped,
        work=work + total(lost.work),
        friction=total(lost.friction),
        impact=total(lost.impact),
        by_tool=add_by_tool(by_tool, scene, own.tool, lost.work, lost.friction),
        slid=_SlideContact(
            slid.wall,
            jnp.where(slid.left, -1.0, own.contact_time),
            own.slip + jnp.where(lies, slid.distance, 0.0),
            slid.over,
        ),
    )


def _advance_nodes_in_blocks(
    load: Load,
    moving: WindowState,
    room: Corners,
    velocity_step: jax.Array,
    length: jax.Array,
    scene: Scene,
    data: WindowData,
    frames: tuple[ToolFrame | None, ...],
) -> _AdvancedNodes:
    """Advances elements and nodes in one pass over each of those in use; not differentiable."""
    elements = data.active.packed.elements
    modes, rest = data.losing, None
    if modes is None or data.recursion is None:
        corners, volume = corner_forces(load, elements, room)
    else:
        corners, volume, rest = viscous_corner_forces(load, elements, room, modes, data.recursion)
    nodes = moving.nodes.stuck, data.active.mass, data.active.compliance
    own = moving.nodes
    moves, slides = any(frame is not None for frame in frames), scene.slides

    surfaces, damping, worked = scene.surfaces, scene.solver.damping, scene.moving_tools
    split_count = len(worked) + len(scene.rubbing_tools)

    def work(old: Any, table: Any, nodes: Any, wall: Any, tool: Any, facets: Any, temperature: Any) -> Any:
        (x,), (y,), (z,), before, *slipped = old
        nodal, sums = add_gravity(gather_shares(corners, table), nodes[1], scene.solver.gravity), []
        velocities, losses = update_velocity(nodal, before, nodes, velocity_step, damping)
        if moves:
            carrier = tool_velocity(frames, tool)
            velocities, held, done = apply_tool_velocity(
                nodal, (before, velocities), nodes, wall, velocity_step, carrier
            )
            sums = [done, *split_by_tool(done, tool, worked)]
            losses = None if losses is None else jnp.where(held, 0.0, losses)
        new = vector(x + length * v for x, v in zip((x, y, z), velocities, strict=True))
        if scene.lands_smoothly:
            velocities = vector(jnp.where(nodes[0], 0.0, v) for v in velocities)
            losses = None if losses is None else jnp.where(nodes[0], 0.0, losses)
        if not slides:
            new = materialize(new)
            return [*([x] for x in new), velocities], sums if losses is None else [losses, *sums]
        there = dataclasses.replace(
            own, positions=(x, y, z), velocities=before, wall=wall, tool=tool, temperature=temperature
        )
        lies = lying_nodes(nodes[0], wall)
        lying = LyingNodes.of(there, materialize(velocities), nodal, nodes[1:], lies)
        slid = slide_within_facets(lying, facets, (velocity_step, length), surfaces, frames, damping)
        (place, on_tool), stays, lost, distance = slid
        # Nodes that leave their triangle are moved by `_walk_nodes`.
        new = _choose(stays, place, _choose(lies, (x, y, z), new))
        velocities = _choose(stays, on_tool, _choose(lies, before, velocities))
        done = [jnp.where(stays, lost.work, jnp.where(lies, 0.0, each)) for each in sums[:1]]
        rubbed, impact = (jnp.where(stays, each, 0.0) for each in (lost.friction, lost.impact))
        sums = [*done, *(x for each in done for x in split_by_tool(each, tool, worked))]
        sums += [*split_by_tool(rubbed, tool, scene.rubbing_tools), rubbed, impact]
        losses = None if losses is None else jnp.where(stays, lost.damping, jnp.where(lies, 0.0, losses))
        walks = lies & ~stays
        slipped = slipped[0][0] + jnp.where(stays, distance, 0.0)
        rows = [*([x] for x in materialize(new)), velocities, [slipped], [walks]]
        return rows, [*([] if losses is None else [losses]), *sums, walks]

    inputs = (
        gather_table(elements),
        nodes,
        own.wall if moves or slides else None,
        own.tool if moves or slides else None,
        moving.facets,
        own.temperature,
    )
    into = [*(x[None] for x in own.positions), own.velocities]
    if own.slip is not None:
        into += [own.slip[None], jnp.zeros_like(own.stuck)[None]]
    damped = damping is not None
    # Positions, velocities and slip are each read by what is written there alone, so that neither need be copied.
    new, sums = over_blocks(
        work,
        elements.node_block_count,
        inputs,
        into,
        sums=damped + moves + split_count + 3 * slides,
        update=4 + slides,
        kept=slides or moves,
    )
    loss, *sums = sums if damped else (0.0, *sums)
    taken = _AdvancedNodes(
        vector(row for (row,) in new[:3]), new[3], volume, loss, corners, rest, sums[0] if moves else 0.0
    )
    taken = taken._replace(by_tool=ToolEnergies(*_split_at(sums[moves : moves + split_count], len(worked))))
    if not slides:
        return taken
    friction, impact, walking = sums[-3:]
    contact = _SlideContact(own.wall, own.contact_time, new[4][0], jnp.zeros_like(own.stuck), moving.facets)
    taken = taken._replace(friction=friction, impact=impact, slid=contact)
    return _walk_nodes(taken, moving, new[5][0], walking > 0.0, (velocity_step, length), scene, data, frames)


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
    taken: _AdvancedNodes,
    moving: WindowState,
    walks: jax.Array,
    any_walks: jax.Array,
    steps: tuple[jax.Array, jax.Array],
    scene: Scene,
    data: WindowData,
    frames: tuple[ToolFrame | None, ...],
) -> _AdvancedNodes:
    """Advances the nodes (n,) that leave their triangles, which have not been moved yet; not differentiable."""
    own, damping, corners = moving.nodes, scene.solver.damping, taken.room
    assert corners is not None and taken.slid is not None
    slots = data.active.packed.elements.slots

    def walk(node: jax.Array, before: _Walking, lies: jax.Array) -> _Walking:
        """The data of the nodes with these numbers (n,) after their walk, from those before it."""
        every = own.stuck, data.active.mass, data.active.compliance, own.tool, own.temperature
        stuck, mass, compliance, tool, temperature = jax.tree.map(lambda values: membrane.gather(values, node), every)
        table = membrane.gather(slots, node), jnp.int32(len(slots))
        nodal = add_gravity(gather_shares(corners, table), mass, scene.solver.gravity)
        places, speeds, touching, lost, by_tool = before
        old = vector(speeds)
        free, _ = update_velocity(nodal, old, (stuck, mass, compliance), steps[0], damping)
        there = dataclasses.replace(
            own, positions=places, velocities=old, wall=touching.wall, tool=tool, temperature=temperature
        )
        lying = LyingNodes.of(there, free, nodal, (mass, compliance), lies)
        slid = materialize(slide_nodes(lying, steps, scene.surfaces, frames, damping, differentiable=False))
        time = jnp.where(slid.left, -1.0, touching.contact_time)
        far = touching.distance + jnp.where(lies, slid.distance, 0.0)
        known = find_facets(slid.wall, tool, lying.mobile, scene.surfaces)
        contact = _SlideContact(slid.wall, time, far, slid.over, known)
        new = ContactLosses(*(jnp.where(lies, each, 0.0) for each in slid.losses))
        total = jax.tree.map(lambda before, each: before + jnp.sum(each), lost, new)
        by_tool = add_by_tool(by_tool, scene, tool, new.work, new.friction)
        return slid.positions, jnp.stack(slid.velocities), contact, total, by_tool

    none = jnp.zeros((), own.velocities.dtype)
    begun = (
        vector(taken.positions),
        taken.velocities,
        taken.slid,
        ContactLosses(none, none, none, none),
        taken.by_tool,
    )

    def walk_all(begun: _Walking) -> _Walking:
        if on_cpu():
            return _in_groups(walk, begun, walks, data.active.packed.elements.node_block_count)
        new = walk(jnp.arange(walks.size), begun, walks)
        return jax.tree.map(lambda one, other: jnp.where(walks, one, other) if one.ndim else one, new, begun)

    positions, velocities, slid, losses, by_tool = lax_cond_once(any_walks, walk_all, materialize(begun))
    return taken._replace(
        positions=positions,
        velocities=velocities,
        slid=slid,
        work=taken.work + losses.work,
        friction=taken.friction + losses.friction,
        impact=taken.impact + losses.impact,
        loss=taken.loss + losses.damping,
        by_tool=by_tool,
    )


def _in_groups(
    walk: Callable[[jax.Array, _Walking, jax.Array], _Walking],
    begun: _Walking,
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

    return jax.lax.fori_loop(0, -(-count // _LANES), take, begun)

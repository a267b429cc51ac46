"""Contact in the steps of a window: searched for, or known from an earlier search.

A search is not differentiable. For derivatives the steps of the window are computed again with the known contacts.
"""

from __future__ import annotations

import dataclasses
import functools
import operator
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp

from jaxform.contact import sticking
from jaxform.contact.broad_phase import (
    LOOK_EVERY,
    BroadPhaseCheck,
    Candidates,
    DueBlocks,
    all_blocks,
    check_nodes,
    find_active_pairs,
    list_spheres,
    may_have_missed,
    no_active_pairs,
)
from jaxform.dynamics.edge_step import replay_sides, search_sides
from jaxform.dynamics.window_state import KnownContact, WindowData, WindowState
from jaxform.kernels.blocks import lax_cond_once, materialize, over_blocks
from jaxform.mechanics.elements import gather_shares
from jaxform.mechanics.membrane import gather, gather_columns
from jaxform.model.scene import Scene
from jaxform.sheet.scheme import add_gravity
from jaxform.tools.mold import ToolFrame

FAR = 1e4  # of the sheet's size: at such coordinates the run is diverging


def update_broad_phase(
    current: WindowState, scene: Scene, data: WindowData, candidates: Sequence[Candidates]
) -> WindowState:
    """Checks for each surface, every few steps, whether nodes are close to it or will be until the next check.

    A node that becomes so much faster in between that contact may be missed is found by the next check, or at the
    list's end.
    """
    nodes = current.nodes

    def check_again(last: tuple[BroadPhaseCheck, ...]) -> tuple[BroadPhaseCheck, ...]:
        till_next = jnp.minimum(LOOK_EVERY, data.max_count - current.count) * data.length
        count, found = data.active.packed.elements.node_block_count, []
        for number, listed in enumerate(candidates):
            frame = _present_frame(current, scene, data, number)
            state = jax.lax.stop_gradient((nodes.positions, nodes.velocities, nodes.stuck, till_next, listed))
            close, missed = check_nodes(*state, last[number], count, frame)
            found.append((close | data.always_check, missed))
        return tuple(found)

    due = (current.count > 0) & (current.count % LOOK_EVERY == 0) & ~current.halted
    seen = lax_cond_once(due, check_again, current.last_checks)
    # Read before they are written (docs/explanation/kernels.md).
    seen, positions, velocities = materialize((seen, nodes.positions, nodes.velocities))
    return dataclasses.replace(
        current, check=seen, nodes=dataclasses.replace(nodes, positions=positions, velocities=velocities)
    )


def to_tool_frame(current: WindowState, scene: Scene, data: WindowData, number: int) -> tuple[Any, jax.Array]:
    """Present positions [m] and velocities [m/s], in the frame of the surface where it moves."""
    positions, velocities = current.nodes.positions, current.nodes.velocities
    frame = _present_frame(current, scene, data, number)
    if frame is None:
        return positions, velocities
    return frame.places(positions), jnp.stack(frame.speeds(velocities))


def _present_frame(current: WindowState, scene: Scene, data: WindowData, number: int) -> ToolFrame | None:
    """The frame of a surface in the last step, not differentiable; None where the surface rests."""
    motion = scene.surfaces[number].mold.motion
    if motion is None:
        return None
    time = data.begin + current.count * data.length
    return jax.lax.stop_gradient(motion.frame(time - data.length, time))


def search_contact(
    moved: WindowState,
    length: jax.Array,
    candidates: Sequence[Candidates],
    scene: Scene,
    data: WindowData,
    frames: tuple[ToolFrame | None, ...],
    over: jax.Array | None,
    velocity_step: jax.Array,
) -> WindowState:
    """The window state after the contact search of one step; stale where a node is about to leave its sphere.

    Nodes that went `over` an edge (n_node,) are not tested against that surface: their paths are not straight.
    """
    assert moved.hits is not None
    known = [
        sticking.touches_already(moved.nodes, number, surface, over) for number, surface in enumerate(scene.surfaces)
    ]
    found = [
        _active_pairs(moved, listed, scene, data, number, known[number], frames[number])
        for number, listed in enumerate(candidates)
    ]
    landing, contact_step = _free_flight(moved, length, scene, data, frames)
    due, mass = [blocks for blocks, _ in found], _masses(scene, data)
    flight = _flight_forces(moved, (velocity_step, length), scene, data)
    landing, met = sticking.apply_contact(
        landing, contact_step, due, mass, candidates, scene.surfaces, known, moved.hits, flight
    )
    missed = functools.reduce(operator.or_, [missed for _, missed in moved.last_checks])
    landed = dataclasses.replace(
        _apply_landing(moved, landing),
        hits=met,
        halted=moved.halted | missed | (moved.count >= data.max_count),
        stale=functools.reduce(operator.or_, [leaving for _, leaving in found]),
    )
    return landed if moved.held is None else search_sides(moved, landed, length, candidates, scene, data, frames)


def _flight_forces(
    moved: WindowState, steps: tuple[jax.Array, jax.Array], scene: Scene, data: WindowData
) -> Callable[[jax.Array, jax.Array], sticking.FlightForces]:
    """A function for `FlightForces` of nodes, from the forces in a step with this velocity_step and length [s].

    The velocities before the step have been overwritten.
    """
    (velocity_step, length), slots, corners = steps, data.active.packed.elements.slots, moved.corners
    assert corners is not None

    def forces(node: jax.Array, velocity: jax.Array) -> sticking.FlightForces:
        places = node[None]
        mass, compliance = gather(data.active.mass, places), gather_columns(data.active.compliance, places)
        shares = gather_shares(corners, (gather(slots, places), jnp.int32(len(slots))))
        nodal = add_gravity(shares, mass, scene.solver.gravity)
        impulse = length * jnp.stack(nodal)
        if not scene.lands_smoothly:
            return impulse, None
        gain = jnp.stack([velocity_step * f * c for f, c in zip(nodal, compliance, strict=True)])
        half = 0.0 if scene.solver.damping is None else 0.5 * scene.solver.damping * velocity_step
        # The velocity before is ((1 + half) v - gain) / (1 - half).
        return impulse, length * (gain - 2.0 * half * velocity) / (1.0 - half)

    return forces


def replay_contact(
    moved: WindowState,
    before: jax.Array,
    forces: jax.Array,
    length: jax.Array,
    scene: Scene,
    known: KnownContact,
    data: WindowData,
    frames: tuple[ToolFrame | None, ...],
) -> WindowState:
    """The window state after the known contacts of one step; differentiable.

    Args:
        moved: The window state after the step without them.
        before: The nodes' velocities before the step (3, n_node) [m/s].
        forces: The forces on them in the step (3, n_node) [N].
        length: Step length [s].
        scene: The scene.
        known: The contacts.
        data: Constants of the window.
        frames: Frames of the surfaces in the step.
    """
    landing, contact_step = _free_flight(moved, length, scene, data, frames)
    contact_step = contact_step._replace(impulse=length * forces)
    if scene.lands_smoothly:
        contact_step = contact_step._replace(curve=length * (moved.nodes.velocities - before))
    if known.record is None:
        lands = (known.step == contact_step.number) & ~moved.nodes.stuck
        chosen = jnp.where(lands, known.chosen, -1)
    else:
        touching = jnp.where(contact_step.number < known.count, known.record[contact_step.number], -1)
        chosen = jnp.where(moved.nodes.stuck, -1, touching)
    mass = _masses(scene, data)
    landed = _apply_landing(moved, sticking.apply_known_contact(landing, contact_step, chosen, mass, scene.surfaces))
    if known.sides is not None:
        landed = replay_sides(moved, landed, length, known.sides, scene, frames)
    return dataclasses.replace(landed, halted=moved.halted | (moved.count >= known.count))


def _masses(scene: Scene, data: WindowData) -> tuple[jax.Array, jax.Array | None]:
    """The nodes' masses [kg], and where they may slide or a tool moves their compliances [1/kg]."""
    return data.active.mass, data.active.compliance if scene.slides or scene.moves else None


def _free_flight(
    moved: WindowState, length: jax.Array, scene: Scene, data: WindowData, frames: tuple[ToolFrame | None, ...]
) -> tuple[sticking.Landing, sticking.ContactStep]:
    account = moved.account
    landing = sticking.Landing(
        moved.nodes,
        moved.landing_step,
        account.contact_loss,
        moved.impact,
        account.tool_work,
        moved.record,
        account.by_tool.work,
    )
    end, damping = data.begin + moved.count * data.length, scene.solver.damping if scene.lands_smoothly else None
    return landing, sticking.ContactStep(length, end, moved.count - 1, frames, damping=damping)


def _apply_landing(moved: WindowState, landing: sticking.Landing) -> WindowState:
    return dataclasses.replace(
        moved,
        nodes=landing.nodes,
        landing_step=landing.step,
        impact=landing.impact,
        record=landing.record,
        account=dataclasses.replace(
            moved.account,
            contact_loss=landing.loss,
            tool_work=landing.work,
            by_tool=moved.account.by_tool._replace(work=landing.works),
        ),
    )


def any_missed(current: WindowState, candidates: Sequence[Candidates], scene: Scene, data: WindowData) -> jax.Array:
    """True where, at the end of a list, a node may have missed a surface."""
    missed = jnp.asarray(False)
    for number, (listed, seen) in enumerate(zip(candidates, current.last_checks, strict=True)):
        frame = _present_frame(current, scene, data, number)

        def compute_block(
            positions: Any, stuck: jax.Array, sphere: tuple[jax.Array, ...], seen: Any = seen, frame: Any = frame
        ) -> tuple[list, list]:
            places = positions if frame is None else frame.places(positions)
            return [], [may_have_missed(places, stuck, sphere, seen)]

        inputs = jax.lax.stop_gradient((current.nodes.positions, current.nodes.stuck, list_spheres(listed)))
        _, (count,) = over_blocks(compute_block, data.active.packed.elements.node_block_count, inputs, [], sums=1)
        missed = missed | seen[1] | (count > 0)
    return missed


def _active_pairs(
    moved: WindowState,
    candidates: Candidates,
    scene: Scene,
    data: WindowData,
    number: int,
    touches: jax.Array,
    frame: ToolFrame | None,
) -> tuple[DueBlocks, jax.Array]:
    """The listed pairs that are tested in this step, and whether a node is about to leave the range of its list."""
    state = jax.lax.stop_gradient((moved.nodes.positions, moved.nodes.stuck, touches, candidates))
    blocks, frame = data.active.packed.elements.node_block_count, jax.lax.stop_gradient(frame)
    close, _ = moved.last_checks[number]
    found = lax_cond_once(close, lambda _: find_active_pairs(*state, blocks, frame), no_active_pairs(candidates))
    return found if scene.solver.skip_far else (all_blocks(candidates), found[1])


def check_free_flight(moved: WindowState, scene: Scene, data: WindowData) -> jax.Array:
    """True where a window without contact halts: a sheet that flies off must not overflow derivatives."""
    far = jnp.max(jnp.abs(jax.lax.stop_gradient(moved.nodes.positions))) > FAR * scene.tables.size
    return moved.halted | far | (moved.count >= data.max_count)

"""Element sides at sharp edges of tools in the steps of a window: constraints, search, and replay of known ones."""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp

from jaxform.contact import edge_contact, edge_forces
from jaxform.contact.broad_phase import Candidates
from jaxform.contact.edge_contact import HeldSides, SidePaths
from jaxform.contact.edge_forces import HeldNodes, Inverse
from jaxform.contact.sliding import sliding_nodes
from jaxform.dynamics.window_state import WindowData, WindowState
from jaxform.kernels.blocks import lax_cond_once
from jaxform.mechanics.elements import Nodes
from jaxform.model.scene import Scene
from jaxform.sheet.active_set import ActiveSet
from jaxform.sheet.scheme import add_by_tool
from jaxform.sheet.state import PackedState
from jaxform.tools.mold import ToolFrame, tool_offset, tool_velocity

Frames = tuple[ToolFrame | None, ...]


def first_edges(scene: Scene) -> list[int]:
    """The number of each surface's first sharp edge, counted over all surfaces; the total comes last."""
    firsts = [0]
    for edges in scene.tables.edges:
        firsts.append(firsts[-1] + edges.shape[1])
    return firsts


def list_sides(listed: Candidates, current: WindowState, scene: Scene, data: WindowData, number: int) -> Candidates:
    """The candidates of a surface, with the sides that can meet its sharp edges."""
    edges, mold = scene.tables.edges[number], scene.surfaces[number].mold
    if not edges.size:
        return listed
    left = (data.max_count - current.count) * data.length
    moved = 0.0 if mold.motion is None else left * mold.motion.highest_speed()
    elements, stuck = data.active.packed.elements, current.nodes.stuck
    given = listed, stuck, elements.triangles, elements.area > 0.0, mold, edges, moved
    near = edge_contact.list_near_sides(*jax.lax.stop_gradient(given))
    return dataclasses.replace(listed, sides=near, overflow=listed.overflow | near.overflow)


def hold_sides_at_edges(
    current: WindowState,
    moved: WindowState,
    steps: tuple[jax.Array, jax.Array],
    scene: Scene,
    data: WindowData,
    frames: Frames,
) -> WindowState:
    """The window state after a step, with the constraints of the sides that are held at edges of tools.

    Args:
        current: The window state before the step.
        moved: The window state after it, without these constraints.
        steps: Time step of the velocity update, and the step length [s].
        scene: The scene.
        data: Constants of the window.
        frames: Frames of the surfaces in the step.
    """
    held, nodes, differentiable = moved.held, moved.nodes, moved.corners is None
    assert held is not None
    tools = _tools_of_edges(held.edge, scene)
    carrier = _carrier(tools, frames, held.point)
    before = edge_forces.values_at_ends(current.nodes.velocities, held)
    damping = scene.solver.damping
    half = 0.0 if damping is None else 0.5 * damping * steps[0]
    immovable = _immovable_nodes(nodes, scene)
    zero = jnp.zeros((), nodes.velocities.dtype)

    def hold(free: HeldNodes) -> HeldNodes:
        return edge_forces.hold_sides(
            free.positions,
            free.velocities,
            before,
            held,
            data.active.compliance,
            immovable,
            (steps[0] / (1.0 + half), steps[1]),
            carrier,
            current.count,
            data.edge_inverse,
            differentiable=differentiable,
        )

    free = HeldNodes(nodes.positions, nodes.velocities, zero, jnp.zeros(held.edge.shape, zero.dtype), zero, held.force)
    found = lax_cond_once(held.count > 0, hold, free, differentiable=differentiable)
    account = dataclasses.replace(moved.account, contact_loss=moved.account.contact_loss + found.loss)
    if damping is not None:
        account = dataclasses.replace(account, damping_loss=account.damping_loss + damping * steps[0] * found.damped)
    if account.tool_work is not None:
        by_tool = add_by_tool(account.by_tool, scene, tools, found.work)
        account = dataclasses.replace(account, tool_work=account.tool_work + jnp.sum(found.work), by_tool=by_tool)
    nodes = dataclasses.replace(nodes, positions=found.positions, velocities=found.velocities)
    pushed = dataclasses.replace(held, force=found.force)
    return dataclasses.replace(moved, nodes=nodes, account=account, held=pushed)


def _immovable_nodes(nodes: Nodes, scene: Scene) -> jax.Array:
    """The nodes (n_node,) that the constraints do not move."""
    return nodes.stuck | sliding_nodes(nodes.stuck, nodes.wall) if scene.slides else nodes.stuck


def invert_at_begin(state: PackedState, scene: Scene, active: ActiveSet, length: jax.Array) -> Inverse | None:
    """The inverse of the system of the sides that are held when a window begins; None without sharp edges."""
    if state.held is None:
        return None
    held, immovable = state.held.at(active.packed.place), _immovable_nodes(state.nodes, scene)
    return edge_forces.invert_system(*jax.lax.stop_gradient((held, active.compliance, immovable, length)))


def _tools_of_edges(edge: jax.Array, scene: Scene) -> jax.Array:
    """The numbers of the tools (capacity,), as in `Scene.surfaces`, to which these edges belong."""
    tool = jnp.zeros_like(edge)
    for first in first_edges(scene)[1:-1]:
        tool = tool + (edge >= first)
    return tool


def _carrier(tool: jax.Array, frames: Frames, like: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Displacement at the step's end [m] and velocity [m/s] of the tools of edges (3, capacity)."""
    offset, speed, still = tool_offset(frames, tool), tool_velocity(frames, tool), jnp.zeros_like(like)
    return (still, still) if offset is None else (jnp.stack(offset), jnp.stack(speed))


def _paths(moved: WindowState, landed: WindowState, length: jax.Array, frame: ToolFrame | None) -> SidePaths:
    """The nodes' paths in a step, from the window states before nodes landed and after."""
    return SidePaths(moved.nodes.positions, landed.nodes.positions, moved.nodes.velocities, length, frame)


def search_sides(
    moved: WindowState,
    landed: WindowState,
    length: jax.Array,
    candidates: Any,
    scene: Scene,
    data: WindowData,
    frames: Frames,
) -> WindowState:
    """The window state with the sides that meet an edge in this step; `moved` is the one before nodes landed."""
    held, stale = landed.held, landed.stale
    assert held is not None and stale is not None
    firsts, number = first_edges(scene), moved.count - 1
    for k, (surface, edges) in enumerate(zip(scene.surfaces, scene.tables.edges, strict=True)):
        near, frame = candidates[k].sides, frames[k]
        if near is None:
            continue
        paths = _paths(moved, landed, length, frame)
        held = edge_contact.find_held_sides(held, near, paths, landed.nodes, surface, edges, firsts[k], number)
        places = landed.nodes.positions if frame is None else frame.places(landed.nodes.positions)
        stale |= edge_contact.leaves_list(near, places, data.active.packed.elements.node_block_count)
    return dataclasses.replace(landed, held=held, stale=stale, halted=landed.halted | held.overflow)


def replay_sides(
    moved: WindowState, landed: WindowState, length: jax.Array, known: HeldSides, scene: Scene, frames: Frames
) -> WindowState:
    """The window state with the known sides that meet an edge in this step; differentiable."""
    held = landed.held
    assert held is not None
    firsts, number = first_edges(scene), jnp.where(moved.halted, -2, moved.count - 1)
    for k, (surface, edges) in enumerate(zip(scene.surfaces, scene.tables.edges, strict=True)):
        if edges.size:
            paths = _paths(moved, landed, length, frames[k])
            held = edge_contact.hold_known_sides(held, known, paths, surface, edges, firsts[k], number)
    return dataclasses.replace(landed, held=held)

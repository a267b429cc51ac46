"""Contact in the steps of a window: searched for, or taken from what a search has found.

A search takes no derivative. Where one is wanted, the window's steps are taken again with the landings that are known.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp

from jaxform.contact import sticking
from jaxform.contact.broad_phase import (
    LOOK_EVERY,
    ActivePairs,
    BroadPhaseCheck,
    all_blocks,
    check_nodes,
    find_active_pairs,
    list_spheres,
    may_have_missed,
    no_active_pairs,
)
from jaxform.contact.lists import Candidates
from jaxform.dynamics.window_state import KnownContact, WindowData, WindowState
from jaxform.kernels.blocks import lax_cond_once, materialize, over_blocks
from jaxform.model.scene import Scene, Tool
from jaxform.tools.motion import ToolFrame

FAR = 1e4  # of the sheet's size: a sheet that gets there has run away


def update_broad_phase(moving: WindowState, scene: Scene, now: WindowData, candidates: Candidates) -> WindowState:
    """Every few steps a look at where the nodes are, and where they will be at the next one.

    What it says of the mold holds until then, unless a node has become so much faster that it may have touched unseen:
    that shows in the next look, or when the list ends.
    """
    nodes = moving.nodes

    def check_again(last: BroadPhaseCheck) -> BroadPhaseCheck:
        till_next = jnp.minimum(LOOK_EVERY, now.max_count - moving.count) * now.length
        state = jax.lax.stop_gradient((*to_tool_frame(moving, scene, now), nodes.stuck, till_next, candidates))
        new = check_nodes(*state, last, now.active.packed.elements.node_block_count)
        return new._replace(close=new.close | now.always_check)

    due = (moving.count > 0) & (moving.count % LOOK_EVERY == 0) & ~moving.halted
    seen = lax_cond_once(due, check_again, moving.last_look)
    # Read before they are written (docs/explanation/kernels.md).
    seen, positions, velocities = materialize((seen, nodes.positions, nodes.velocities))
    return dataclasses.replace(
        moving, check=seen, nodes=dataclasses.replace(nodes, positions=positions, velocities=velocities)
    )


def to_tool_frame(moving: WindowState, scene: Scene, now: WindowData) -> tuple[Any, jax.Array]:
    """Positions [m] and velocities [m/s] of now in the frame of the tool, where that moves."""
    positions, velocities = moving.nodes.positions, moving.nodes.velocities
    if scene.motion is None:
        return positions, velocities
    time = now.begin + moving.count * now.length
    frame = scene.motion.frame(time - now.length, time)
    return frame.places(positions), jnp.stack(frame.speeds(velocities))


def search_contact(
    moved: WindowState,
    length: jax.Array,
    tool: Tool,
    candidates: Candidates,
    scene: Scene,
    now: WindowData,
    frame: ToolFrame | None,
) -> WindowState:
    """Contact of one step; where a node is about to leave its sphere, another list is due."""
    assert moved.hits is not None
    due, leaving = _active_pairs(moved, candidates, scene, now)
    flying, this = _free_flight(moved, length, now, frame)
    landing, met = sticking.apply_contact(flying, this, due, now.active.mass, candidates, tool, moved.hits)
    return dataclasses.replace(
        _apply_landing(moved, landing),
        hits=met,
        halted=moved.halted | moved.last_look.missed | (moved.count >= now.max_count),
        stale=leaving,
    )


def replay_contact(
    moved: WindowState, length: jax.Array, tool: Tool, known: KnownContact, now: WindowData, frame: ToolFrame | None
) -> WindowState:
    """Contact of one step of a window whose landings are known; differentiable."""
    flying, this = _free_flight(moved, length, now, frame)
    lands = (known.step == this.number) & ~moved.nodes.stuck
    chosen = jnp.where(lands, jnp.abs(known.wall) - 1, -1)
    moved = _apply_landing(moved, sticking.apply_known_contact(flying, this, chosen, now.active.mass, tool.mold))
    return dataclasses.replace(moved, halted=moved.halted | (moved.count >= known.count))


def _free_flight(
    moved: WindowState, length: jax.Array, now: WindowData, frame: ToolFrame | None
) -> tuple[sticking.Landing, sticking.ContactStep]:
    account = moved.account
    flying = sticking.Landing(moved.nodes, moved.landing_step, account.contact_loss, moved.impact, account.tool_work)
    return flying, sticking.ContactStep(length, now.begin + moved.count * now.length, moved.count - 1, frame)


def _apply_landing(moved: WindowState, landing: sticking.Landing) -> WindowState:
    return dataclasses.replace(
        moved,
        nodes=landing.nodes,
        landing_step=landing.step,
        impact=landing.impact,
        account=dataclasses.replace(moved.account, contact_loss=landing.loss, tool_work=landing.work),
    )


def any_missed(moving: WindowState, candidates: Candidates, scene: Scene, now: WindowData) -> jax.Array:
    """True where, at the end of a list, a node may have missed the mold."""
    seen = moving.last_look

    def work(positions: list[jax.Array], stuck: jax.Array, sphere: tuple[jax.Array, ...]) -> tuple[list, list]:
        return [], [may_have_missed(positions, stuck, sphere, seen)]

    positions, _ = to_tool_frame(moving, scene, now)
    inputs = jax.lax.stop_gradient((positions, moving.nodes.stuck, list_spheres(candidates)))
    _, (count,) = over_blocks(work, now.active.packed.elements.node_block_count, inputs, [], sums=1)
    return seen.missed | (count > 0)


def _active_pairs(moved: WindowState, candidates: Candidates, scene: Scene, now: WindowData) -> ActivePairs:
    """The listed pairs that are tested in this step, and whether a node is about to leave the range of its list."""
    positions, _ = to_tool_frame(moved, scene, now)
    state = jax.lax.stop_gradient((positions, moved.nodes.stuck, candidates))
    blocks = now.active.packed.elements.node_block_count
    found = lax_cond_once(
        moved.last_look.close, lambda _: find_active_pairs(*state, blocks), no_active_pairs(candidates)
    )
    return found if scene.solver.skip_far else found._replace(due=all_blocks(candidates))


def check_free_flight(moved: WindowState, scene: Scene, now: WindowData) -> jax.Array:
    """True where a window without contact halts: a sheet that flies off must not overflow derivatives."""
    far = jnp.max(jnp.abs(jax.lax.stop_gradient(moved.nodes.positions))) > FAR * scene.tables.size
    return moved.halted | far | (moved.count >= now.max_count)

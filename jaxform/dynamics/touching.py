"""Contact in the steps of a window: searched for, or taken from what a search has found.

A search takes no derivative. Where one is wanted, the window's steps are taken again with the landings that are known.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp

from jaxform.contact import sticking
from jaxform.contact.broad_phase import LOOK_EVERY, Seen, Watched, every_block, look, missed, spheres, unwatched, watch
from jaxform.contact.lists import Candidates
from jaxform.dynamics.moving import Landings, Moving, Window
from jaxform.kernels.blocks import once, only_if, over_blocks
from jaxform.model.scene import Scene, Tool
from jaxform.tools.motion import Frame

FAR = 1e4  # of the sheet's size: a sheet that gets there has run away


def looked(moving: Moving, scene: Scene, now: Window, candidates: Candidates) -> Moving:
    """Every few steps a look at where the nodes are, and where they will be at the next one.

    What it says of the mold holds until then, unless a node has become so much faster that it may have touched unseen:
    that shows in the next look, or when the list ends.
    """
    nodes = moving.nodes

    def again(last: Seen) -> Seen:
        till_next = jnp.minimum(LOOK_EVERY, now.most - moving.count) * now.length
        state = jax.lax.stop_gradient((*seen_by_tool(moving, scene, now), nodes.stuck, till_next, candidates))
        new = look(*state, last, now.active.packed.elements.node_block_count)
        return new._replace(close=new.close | now.wary)

    due = (moving.count > 0) & (moving.count % LOOK_EVERY == 0) & ~moving.halted
    seen = only_if(due, again, moving.last_look)
    # Read before they are written (docs/explanation/kernels.md).
    seen, positions, velocities = once((seen, nodes.positions, nodes.velocities))
    return dataclasses.replace(
        moving, seen=seen, nodes=dataclasses.replace(nodes, positions=positions, velocities=velocities)
    )


def seen_by_tool(moving: Moving, scene: Scene, now: Window) -> tuple[Any, jax.Array]:
    """Positions [m] and velocities [m/s] of now in the frame of the tool, where that moves."""
    positions, velocities = moving.nodes.positions, moving.nodes.velocities
    if scene.motion is None:
        return positions, velocities
    time = now.begin + moving.count * now.length
    frame = scene.motion.frame(time - now.length, time)
    return frame.places(positions), jnp.stack(frame.speeds(velocities))


def touched(
    moved: Moving,
    length: jax.Array,
    tool: Tool,
    candidates: Candidates,
    scene: Scene,
    now: Window,
    frame: Frame | None,
) -> Moving:
    """Contact of one step; where a node is about to leave its sphere, another list is due."""
    assert moved.met is not None
    due, leaving = _watched(moved, candidates, scene, now)
    flying, this = _flying(moved, length, now, frame)
    landing, met = sticking.land(flying, this, due, now.active.mass, candidates, tool, moved.met)
    return dataclasses.replace(
        _landed(moved, landing),
        met=met,
        halted=moved.halted | moved.last_look.missed | (moved.count >= now.most),
        stale=leaving,
    )


def landed_again(
    moved: Moving, length: jax.Array, tool: Tool, known: Landings, now: Window, frame: Frame | None
) -> Moving:
    """Contact of one step of a window whose landings are known; differentiable."""
    flying, this = _flying(moved, length, now, frame)
    lands = (known.step == this.number) & ~moved.nodes.stuck
    chosen = jnp.where(lands, jnp.abs(known.wall) - 1, -1)
    moved = _landed(moved, sticking.land_on(flying, this, chosen, now.active.mass, tool.mold))
    return dataclasses.replace(moved, halted=moved.halted | (moved.count >= known.count))


def _flying(
    moved: Moving, length: jax.Array, now: Window, frame: Frame | None
) -> tuple[sticking.Landing, sticking.Step]:
    account = moved.account
    flying = sticking.Landing(moved.nodes, moved.landed, account.contact_loss, moved.impact, account.tool_work)
    return flying, sticking.Step(length, now.begin + moved.count * now.length, moved.count - 1, frame)


def _landed(moved: Moving, landing: sticking.Landing) -> Moving:
    return dataclasses.replace(
        moved,
        nodes=landing.nodes,
        landed=landing.step,
        impact=landing.impact,
        account=dataclasses.replace(moved.account, contact_loss=landing.loss, tool_work=landing.work),
    )


def any_missed(moving: Moving, candidates: Candidates, scene: Scene, now: Window) -> jax.Array:
    """Whether, where a list ends, a node may have missed the mold."""
    seen = moving.last_look

    def work(positions: list[jax.Array], stuck: jax.Array, sphere: tuple[jax.Array, ...]) -> tuple[list, list]:
        return [], [missed(positions, stuck, sphere, seen)]

    positions, _ = seen_by_tool(moving, scene, now)
    inputs = jax.lax.stop_gradient((positions, moving.nodes.stuck, spheres(candidates)))
    _, (count,) = over_blocks(work, now.active.packed.elements.node_block_count, inputs, [], sums=1)
    return seen.missed | (count > 0)


def _watched(moved: Moving, candidates: Candidates, scene: Scene, now: Window) -> Watched:
    """The listed pairs that are tested in this step, and whether a node is about to leave the range of its list."""
    positions, _ = seen_by_tool(moved, scene, now)
    state = jax.lax.stop_gradient((positions, moved.nodes.stuck, candidates))
    blocks = now.active.packed.elements.node_block_count
    found = only_if(moved.last_look.close, lambda _: watch(*state, blocks), unwatched(candidates))
    return found if scene.solver.skip_far else found._replace(due=every_block(candidates))


def flown(moved: Moving, scene: Scene, now: Window) -> jax.Array:
    """Whether a window without contact halts: a sheet that flies off must not overflow where derivatives are taken."""
    far = jnp.max(jnp.abs(jax.lax.stop_gradient(moved.nodes.positions))) > FAR * scene.tables.size
    return moved.halted | far | (moved.count >= now.most)

"""One step, and one window of steps.

Every loop uses the same step and the same window. Discrete decisions (the length of the step, which elements are worked
through, which nodes are tested against the mold) are taken at a window's border only, and are piecewise constant in the
design; inside a window all shapes are fixed and the continuous state flows through.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from jaxform.contact import sticking
from jaxform.contact.broad_phase import unseen
from jaxform.contact.candidates import list_candidates
from jaxform.contact.lists import Candidates, Lists, no_lists
from jaxform.dynamics.closing import SLACK, close, looked_over
from jaxform.dynamics.moving import Landings, Moving, Row, Searched, Window
from jaxform.dynamics.step import settled, step
from jaxform.dynamics.timestep import RUNGS_PER_OCTAVE, Chosen, Limit, choose_step, elements_bound, most_steps, no_basis
from jaxform.dynamics.touching import any_missed, seen_by_tool
from jaxform.kernels.blocks import as_one, entry
from jaxform.kernels.keeping import decided
from jaxform.mechanics import membrane
from jaxform.mechanics.elements import Corners, no_corners
from jaxform.model.scene import Scene
from jaxform.model.tables import SHORT_WINDOW
from jaxform.sheet.active_set import ActiveSet, Room, active_set_of
from jaxform.sheet.cooling import cooled
from jaxform.sheet.discretization import NEVER, Discretization
from jaxform.sheet.rim import rim_places
from jaxform.sheet.scheme import Timing, kicks, pressures
from jaxform.sheet.state import PackedState, Schedule, State

_STIFFER = 0.95  # a sheet that is less stiffer than this keeps the steps of a schedule


def window(
    state: State,
    scene: Scene,
    discrete: Discretization,
    schedule: Schedule | None = None,
    *,
    differentiable: bool = True,
) -> State:
    """A fixed number of steps with the decisions taken at its border, or as a schedule has them.

    A design may move faster than the one whose schedule it follows: then its window is retried with shorter steps, as
    any other. Where no derivative is asked for, a halted window ends at once; else its remaining steps change nothing.
    """
    active = active_set_of(state, scene, discrete, differentiable=differentiable)
    packed, active = cooled(active.taken(state), scene, active, differentiable=differentiable)
    decisions = decided(_decided(packed, scene, active, schedule))
    return active.put_back(_stepped(packed, scene, active, decisions, differentiable=differentiable)[0])


def window_in_place(state: PackedState, scene: Scene, active: ActiveSet) -> tuple[PackedState, ActiveSet]:
    """As `window`, not differentiable, of a state in packed order; with the room that the next window may write in."""
    state, active = cooled(state, scene, active, differentiable=False)
    decisions = _decided_freely(state, scene, active)

    def whole(now: tuple[PackedState, Room | None]) -> tuple[PackedState, Room | None]:
        own = decisions._replace(chosen=decisions.chosen._replace(room=now[1]))
        state, _, room = _stepped(now[0], scene, active, own, differentiable=False)
        return state, room

    state, room = as_one(whole, (state, decisions.chosen.room), state.windows)
    return state, dataclasses.replace(active, room=room)


def with_room(active: ActiveSet, scene: Scene) -> ActiveSet:
    """With room for what is worked out in every window."""
    places, elements = active.compliance, active.packed.elements
    basis = no_basis(places.shape[1], places.dtype) if scene.solver.sharp_step else None
    lists = None if scene.mold is None else _no_lists(scene, places)
    return dataclasses.replace(active, room=Room(no_corners(places, elements), basis, lists))


def window_and_impacts(
    state: State, scene: Scene, discrete: Discretization, schedule: Schedule | None
) -> tuple[State, jax.Array, jax.Array | None]:
    """As `window`, not differentiable; with the step in which each node (n_node,) landed, NEVER where it did not.

    And its impact (6, n_node), as in `sticking.Landing`; None where there is no mold.
    """
    active = active_set_of(state, scene, discrete)
    impacts, packed = scene.mold is not None, active.packed
    begin = active.taken(state)
    decisions = _decided(begin, scene, active, schedule)
    end, moving, _ = _stepped(begin, scene, active, decisions, differentiable=False, impacts=impacts)
    # Of a window that is not taken nothing landed.
    landed = jnp.where(end.control.last_count > 0, packed.put_back(moving.landed), NEVER)
    return active.put_back(end), landed, None if moving.impact is None else packed.put_back(moving.impact)


def _stepped(
    state: PackedState,
    scene: Scene,
    active: ActiveSet,
    decisions: _Decisions,
    *,
    differentiable: bool,
    impacts: bool = False,
) -> tuple[PackedState, Moving, Room | None]:
    (length, most, limit, room), row = decisions
    modes = active.viscous(scene.material)
    now = Window(
        active=active,
        begin=state.time,
        length=length,
        bound=limit.bound,
        most=most,
        row=row,
        wary=state.control.last_count == 0,
        recursion=None if modes is None else modes.recursion(length),
        losing=None if modes is None else modes.with_losses(length),
        rim=rim_places(scene, state.mesh, active.packed),
    )
    timing = Timing(state.time, state.control.step_length, length)
    longest = scene.tables.window_room
    steps = *pressures(scene.pressure, timing, longest), kicks(timing, longest)
    lists = None
    if differentiable:
        moving, searched = _taken_again(state, scene, now, steps)
    else:
        moving, searched, lists = _taken(state, scene, now, steps, room, impacts)
    moving = settled(moving, scene, now)
    found = dataclasses.replace(
        state,
        nodes=dataclasses.replace(state.nodes, mode=limit.mode),
        control=dataclasses.replace(state.control, sharpness=limit.sharpness),
    )
    end, corners = looked_over(moving, scene, now)
    if room is not None:
        room = Room(corners, room.basis, lists)
    return close(found, moving, end, searched, scene, now), moving, room


_Steps = tuple[jax.Array, ...]
"""What `step` takes of all steps of a window."""


def _taken(
    state: PackedState, scene: Scene, now: Window, steps: _Steps, room: Room | None, impacts: bool
) -> tuple[Moving, Searched | None, Lists | None]:
    """The steps of a window, with its contact searched for; not differentiable."""
    corners = no_corners(state.nodes.positions, now.active.packed.elements) if room is None else room.corners
    moving = _begun(state, scene, now, corners, impacts)
    moving = _with_positions(moving, membrane.rows_of(state.nodes.positions))
    if scene.tool is None:
        moving, searched, lists = _until_halted(moving, scene, now, steps), None, None
    else:
        lists = _no_lists(scene, state.nodes.positions) if room is None or room.lists is None else room.lists
        moving, searched, lists = _from_list_to_list(moving, scene, now, steps, lists)
    return _with_positions(moving, jnp.stack(moving.nodes.positions)), searched, lists


def _from_list_to_list(
    moving: Moving, scene: Scene, now: Window, steps: _Steps, lists: Lists
) -> tuple[Moving, Searched, Lists]:
    """The steps of a window with a mold: as long as one list of candidates holds, then with another."""

    def with_another(carry: tuple[Moving, Searched, Lists]) -> tuple[Moving, Searched, Lists]:
        moving, searched, lists = carry
        candidates = _list_candidates(moving, scene, now, lists)
        halted = moving.halted | candidates.overflow
        moving = dataclasses.replace(moving, halted=halted, stale=jnp.asarray(False), seen=unseen())
        moving = _until_halted(moving, scene, now, steps, candidates)
        missed = any_missed(moving, candidates, scene, now)
        pairs, overflow = jnp.maximum(searched.pairs, candidates.count), searched.overflow | candidates.overflow
        moving = dataclasses.replace(moving, halted=moving.halted | missed)
        return moving, Searched(pairs, overflow, searched.missed | missed), candidates.lists

    none = Searched(jnp.int32(0), jnp.asarray(False), jnp.asarray(False))
    return jax.lax.while_loop(lambda carry: _going(carry[0], now), with_another, (moving, none, lists))


def _until_halted(
    moving: Moving, scene: Scene, now: Window, steps: _Steps, candidates: Candidates | None = None
) -> Moving:
    """The steps of a window, as far as a list of candidates holds."""

    def going(moving: Moving) -> jax.Array:
        more = _going(moving, now)
        return more if moving.stale is None else more & ~moving.stale

    def advance(moving: Moving) -> Moving:
        return step(moving, jax.tree.map(lambda x: entry(x, moving.count), steps), scene, now, candidates)

    return jax.lax.while_loop(going, advance, moving)


def _going(moving: Moving, now: Window) -> jax.Array:
    return (moving.count < now.most) & ~moving.halted


def _taken_again(state: PackedState, scene: Scene, now: Window, steps: _Steps) -> tuple[Moving, Searched | None]:
    """The steps of a window, differentiable: where there is a mold, with the landings that a search has found."""
    searched = known = None
    moving = _begun(state, scene, now)
    if scene.tool is not None:
        found, searched, _ = _taken(*jax.lax.stop_gradient((state, scene, now, steps)), None, False)
        known, searched = decided((Landings(found.landed, found.nodes.wall, found.count), searched))
        moving = dataclasses.replace(moving, halted=known.count == 0)
    moving = _in_short_ones(lambda moving, own: (step(moving, own, scene, now, known), None), moving, steps)
    return moving, searched


def _with_positions(moving: Moving, positions: Any) -> Moving:
    return dataclasses.replace(moving, nodes=dataclasses.replace(moving.nodes, positions=positions))


class _Decisions(NamedTuple):
    """What is decided at a window's border: the steps, and the row they belong to, where a schedule is followed."""

    chosen: Chosen
    row: Row | None = None


def _decided(state: PackedState, scene: Scene, active: ActiveSet, schedule: Schedule | None) -> _Decisions:
    if schedule is None:
        return _decided_freely(state, scene, active)
    row = schedule.upcoming(state.replay.row)

    def as_planned(state: PackedState, scene: Scene, active: ActiveSet) -> _Decisions:
        length, count = schedule.lengths[row], schedule.counts[row]
        left = jnp.minimum(length * count - state.replay.row_time, jnp.maximum(scene.solver.end_time - state.time, 0.0))
        # Where the sheet is stiffer for its mass than the one of the plan, the steps are shorter by whole rungs.
        bound = elements_bound(state, scene, active)
        rungs = jnp.ceil(jnp.log2(_STIFFER * schedule.bounds[row] / bound) * RUNGS_PER_OCTAVE) / RUNGS_PER_OCTAVE
        finer = jnp.exp2(jnp.maximum(rungs, 0.0) + state.control.retries)
        # As many as planned, if none of them is taken yet; else what is left is divided evenly.
        steps = jnp.ceil(left / length * finer - SLACK).astype(count.dtype)
        fresh = (steps == count) & (state.replay.row_time == 0.0)
        even = left / jnp.maximum(steps, 1)
        own = jnp.where(fresh, jnp.minimum(length, even), even)
        most = jnp.clip(steps, 1, most_steps(own, scene))
        limit = Limit(state.nodes.mode, bound, state.control.sharpness)
        return _Decisions(Chosen(own, most, limit), Row(row, left))

    def beyond(*now: Any) -> _Decisions:
        return _decided_freely(*now)._replace(row=Row(row, jnp.full_like(state.time, jnp.inf)))

    now = jax.lax.stop_gradient((state, scene, active))
    return jax.lax.cond(row < schedule.counts.size, as_planned, beyond, *now)


def _decided_freely(state: PackedState, scene: Scene, active: ActiveSet) -> _Decisions:
    return _Decisions(choose_step(state, scene, active))


def _begun(state: PackedState, scene: Scene, now: Window, room: Corners | None = None, impacts: bool = False) -> Moving:
    """Before the first step; with room for corner forces where contact is searched for."""
    places, positions = now.active.mass.size, state.nodes.positions
    searches = scene.tool is not None and room is not None
    return Moving(
        nodes=state.nodes.stepped(),
        fields=state.nodes.fields,
        account=state.account,
        memory=state.memory,
        landed=jnp.full(places, NEVER, jnp.int32),
        impact=jnp.zeros((6, places), positions.dtype) if impacts else None,
        count=jnp.int32(0),
        halted=jnp.asarray(False),
        stale=jnp.asarray(False) if searches else None,
        seen=unseen() if searches else None,
        room=room,
        met=sticking.nothing_met(places, positions.dtype) if searches else None,
    )


def _in_short_ones(advance: Callable[..., Any], moving: Moving, steps: tuple[jax.Array, ...]) -> Moving:
    """Step by step, with a derivative; of a long window as many short ones as are not over when they begin."""

    def take(moving: Moving, steps: tuple[jax.Array, ...]) -> Moving:
        return jax.lax.scan(advance, moving, steps)[0]

    def unless_halted(moving: Moving, steps: tuple[jax.Array, ...]) -> tuple[Moving, None]:
        return jax.lax.cond(moving.halted, lambda moving, _: moving, take, moving, steps), None

    if len(steps[0]) <= SHORT_WINDOW:
        return take(moving, steps)
    short = jax.tree.map(lambda values: values.reshape(-1, SHORT_WINDOW), steps)
    return jax.lax.scan(unless_halted, moving, short)[0]


def _list_candidates(moving: Moving, scene: Scene, now: Window, into: Lists) -> Candidates:
    """For the steps that are left of a window."""
    assert scene.tool is not None
    (positions, velocities), grid = jax.lax.stop_gradient((seen_by_tool(moving, scene, now), scene.tool.grid))
    return list_candidates(
        jnp.stack(positions),
        velocities,
        ~moving.nodes.stuck,
        jax.lax.stop_gradient(now.length),
        now.most - moving.count,
        grid,
        scene.solver.skip_far,
        into,
        now.active.packed.elements.node_block_count,
    )


def _no_lists(scene: Scene, positions: jax.Array) -> Lists:
    return no_lists(positions.shape[1], positions.dtype, scene.tables.pairs_per_node)

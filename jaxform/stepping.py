"""One step, and one window of steps.

Every loop uses the same step and the same window. Discrete decisions (the length of the step, which elements are worked
through, which nodes are tested against the mold) are taken at a window's border only, and are piecewise constant in the
design; inside a window all shapes are fixed and the continuous state flows through.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from jaxform import contact, membrane
from jaxform.blocks import as_one, entry, once, only_if, over_blocks, total
from jaxform.body import NEVER, Body
from jaxform.carried import Surroundings, stepped
from jaxform.force import Corners, Load, assembled, corner_forces, force, no_corners, shares
from jaxform.membrane import vector
from jaxform.near import Lists, Near, list_near, no_lists
from jaxform.nodes import Nodes
from jaxform.pytree import pytree
from jaxform.scene import SHORT_WINDOW, Scene
from jaxform.scheme import Timing, kicked, kicks, pressures
from jaxform.state import Account, PackedState, Replay, Schedule, State, Status, account, last_work
from jaxform.timestep import RUNGS_PER_OCTAVE, Chosen, Limit, choose_step, elements_bound, most_steps, no_basis
from jaxform.watch import LOOK_EVERY, Seen, Watched, balls, every_block, look, missed, unseen, unwatched, watch
from jaxform.working import Room, Working, worked_through

_MOST_RETRIES = 12
_STIFFER = 0.95  # a sheet that is less stiffer than this keeps the steps of a schedule
_SLACK = 1e-3  # of a step: less is rounding
_FAR = 1e4  # of the sheet's size: a sheet that gets there has run away
_ENERGY_TOLERANCE = 0.2  # of the largest work done so far; a blow-up passes it within a window
_FEW_PAIRS = 0.25  # of the nodes' number, near the mold: with no more, windows become longer
_STEADY = 0.05  # of the bound on the step: where it changes by more in a window, they become shorter
_QUIET = 1e-2  # of the largest work: where a window misses more energy, they become shorter
_JUMP_TOLERANCE, _RETRIES_FOR_ENERGY = 0.02, 4  # the same of one window, which is then taken anew at most so often


@pytree
class _Moving:
    """What changes from step to step inside a window, in packed order.

    Positions (3, place) [m] are three rows where no derivative is taken: else they would be taken apart in every step.
    `landed` is the step in which a node landed, NEVER where it has not in this window, and the impact that of
    `contact.Landing`, None where it is not kept. What was seen last of the mold is None where there is none, the room
    where derivatives are taken, and that for meetings in either case.
    """

    nodes: Nodes
    fields: dict[str, jax.Array]
    account: Account
    landed: jax.Array
    impact: jax.Array | None
    count: jax.Array
    halted: jax.Array
    seen: Seen | None
    room: Corners | None
    met: contact.Met | None


@pytree
class _Window:
    """What stays the same within a window, in packed order.

    Attributes:
        working: The elements and nodes that are worked through.
        begin: Its begin [s].
        length: The step [s].
        bound: The elements' bound on it [s].
        most: How many steps it takes, unless it is cut short.
        row: Of a schedule that is followed; None where none is.
        duration: What it is to last [s].
        near: The list of nodes near the mold; None where there is no mold.
        wary: Whether no look at the nodes is trusted, since the last window was not taken.
    """

    working: Working
    begin: jax.Array
    length: jax.Array
    bound: jax.Array
    most: jax.Array
    row: _Row | None
    duration: jax.Array
    near: Near | None
    wary: jax.Array


def step(moving: _Moving, pressures: tuple[jax.Array, ...], scene: Scene, now: _Window) -> _Moving:
    """One step of the central-difference scheme (the paper's Eq. 8 with damping), and contact.

    Args:
        moving: Before the step.
        pressures: At the step's begin, averaged since the begin of the step before [Pa], and the step that the
            velocity takes [s].
        scene: The scene.
        now: The window.
    """
    pressure, mean_pressure, kick = pressures
    length = now.length
    if now.near is not None:
        moving = _looked(moving, now)
    if moving.room is None:
        # A halted window runs on without moving: a step of length zero changes nothing.
        length, kick = jnp.where(moving.halted, 0.0, length), jnp.where(moving.halted, 0.0, kick)
    if moving.account.pressure is not None:
        pressure = _pressure_inside(moving, scene, now)
        mean_pressure = 0.5 * (moving.account.pressure + pressure)
    load = Load(moving.nodes.positions, now.working.thickness, pressure, scene.material)
    taken = (_taken if moving.room is None else _taken_in_blocks)(load, moving, kick, length, scene, now)
    volume, account = taken.volume + now.working.idle_volume, moving.account
    if moving.room is None:
        # So that the account is that of a loop which ends with the last step.
        volume = jnp.where(moving.halted, account.volume, volume)
    moved = dataclasses.replace(
        moving,
        nodes=dataclasses.replace(moving.nodes, positions=taken.positions, velocities=taken.velocities),
        account=dataclasses.replace(
            account,
            volume=volume,
            pressure=None if account.pressure is None else jnp.where(moving.halted, account.pressure, pressure),
            external_work=account.external_work + mean_pressure * (volume - account.volume),
            damping_loss=account.damping_loss + taken.loss,
        ),
        count=moving.count + jnp.where(moving.halted, 0, 1),
        room=taken.room,
    )
    if now.near is not None:
        moved = _touch(moved, length, scene, now)
    elif moving.room is None:
        moved = dataclasses.replace(moved, halted=_flown(moved, scene, now))
    return _with_fields(moved, moving.halted, length, scene, now) if scene.fields else moved


def _pressure_inside(moving: _Moving, scene: Scene, now: _Window) -> jax.Array:
    """The pressure [Pa] that goes with the volume enclosed as the step begins."""
    volume = now.working.volume(jnp.asarray(moving.nodes.positions)) + now.working.idle_volume
    return scene.pressure.at(now.begin + moving.count * now.length, volume)


def _with_fields(moved: _Moving, halted: jax.Array, length: jax.Array, scene: Scene, now: _Window) -> _Moving:
    """With what the step made of the scene's own fields, unless the window was halted before it."""
    nodes = moved.nodes
    step = Surroundings(
        time=now.begin + moved.count * now.length,
        length=length,
        positions=jnp.asarray(nodes.positions),
        velocities=nodes.velocities,
        stuck=nodes.stuck,
        contact_time=nodes.contact_time,
    )
    new = stepped(scene.fields, moved.fields, step)
    kept = jax.tree.map(lambda own, old: jnp.where(halted, old, own), new, moved.fields)
    return dataclasses.replace(moved, fields=kept)


def _watched(moved: _Moving, scene: Scene, now: _Window) -> Watched:
    """The listed pairs that are tested in this step, and whether a node is about to leave the range of its list."""
    assert now.near is not None and moved.seen is not None
    state = jax.lax.stop_gradient((moved.nodes.positions, moved.nodes.stuck, now.near))
    blocks = now.working.packed.elements.node_block_count
    found = only_if(
        moved.seen.close,
        lambda _: watch(*state, blocks),
        unwatched(now.near),
        differentiable=moved.room is None,
    )
    return found if scene.solver.skip_far else found._replace(due=every_block(now.near))


def _flown(moved: _Moving, scene: Scene, now: _Window) -> jax.Array:
    """Whether a window without contact halts: a sheet that flies off must not overflow where derivatives are taken."""
    far = jnp.max(jnp.abs(jax.lax.stop_gradient(moved.nodes.positions))) > _FAR * scene.tables.size
    return moved.halted | far | (moved.count >= now.most)


class _Taken(NamedTuple):
    """After a step without contact: positions [m], velocities [m/s], the volume before [m^3], the damping loss [J]."""

    positions: jax.Array | membrane.Vector
    velocities: jax.Array
    volume: jax.Array
    loss: jax.Array | float
    room: Corners | None


def _taken(load: Load, moving: _Moving, kick: jax.Array, length: jax.Array, scene: Scene, now: _Window) -> _Taken:
    nodal, volume = force(load, now.working.packed.elements)
    nodes = moving.nodes.stuck, now.working.mass, now.working.compliance
    velocities, losses = kicked(nodal, moving.nodes.velocities, nodes, kick, scene.solver.damping)
    positions = moving.nodes.positions + length * jnp.stack(velocities)
    loss = total(losses) if losses is not None else 0.0
    return _Taken(positions, jnp.stack(velocities), volume, loss, None)


def _taken_in_blocks(
    load: Load, moving: _Moving, kick: jax.Array, length: jax.Array, scene: Scene, now: _Window
) -> _Taken:
    """The same in one pass over the elements in use and one over the nodes in use; not differentiable."""
    elements, room = now.working.packed.elements, moving.room
    assert room is not None
    corners, volume = corner_forces(load, elements, room)
    nodes = moving.nodes.stuck, now.working.mass, now.working.compliance

    def work(old: Any, own: Any, nodes: Any) -> Any:
        (x,), (y,), (z,), velocities = old
        nodal = assembled(corners, own)
        velocities, losses = kicked(nodal, velocities, nodes, kick, scene.solver.damping)
        new = once(vector(x + length * v for x, v in zip((x, y, z), velocities, strict=True)))
        return [*([x] for x in new), velocities], [] if losses is None else [losses]

    inputs = shares(elements), nodes
    into = [*(x[None] for x in moving.nodes.positions), moving.nodes.velocities]
    damped = scene.solver.damping is not None
    # Positions and velocities are each read by what is written there alone, so that neither need be copied.
    new, losses = over_blocks(work, elements.node_block_count, inputs, into, sums=int(damped), update=4, kept=False)
    positions = vector(row for (row,) in new[:3])
    return _Taken(positions, new[3], volume, losses[0] if damped else 0.0, corners)


def _looked(moving: _Moving, now: _Window) -> _Moving:
    """Every few steps a look at where the nodes are, and where they will be at the next one.

    What it says of the mold holds until then, unless a node has become so much faster that it may have touched unseen:
    that shows in the next look, or at the window's end.
    """
    nodes = moving.nodes

    def again(last: Seen) -> Seen:
        assert now.near is not None
        till_next = jnp.minimum(LOOK_EVERY, now.most - moving.count) * now.length
        state = jax.lax.stop_gradient((nodes.positions, nodes.velocities, nodes.stuck, till_next, now.near))
        new = look(*state, last, now.working.packed.elements.node_block_count)
        return new._replace(close=new.close | now.wary)

    assert moving.seen is not None
    due = (moving.count > 0) & (moving.count % LOOK_EVERY == 0) & ~moving.halted
    seen = only_if(due, again, moving.seen, differentiable=moving.room is None)
    # In this order, or XLA would keep a copy of the positions for the look, at every step.
    seen, positions, velocities = jax.lax.optimization_barrier((seen, nodes.positions, nodes.velocities))
    return dataclasses.replace(
        moving, seen=seen, nodes=dataclasses.replace(nodes, positions=positions, velocities=velocities)
    )


def _touch(moved: _Moving, length: jax.Array, scene: Scene, now: _Window) -> _Moving:
    """Contact of one step; halts the window when a node is about to leave the range of its list."""
    assert scene.mold is not None and scene.tables.grid is not None and now.near is not None and moved.seen is not None
    landing = contact.Landing(moved.nodes, moved.landed, moved.account.contact_loss, moved.impact)
    due, leaving = _watched(moved, scene, now)
    this = contact.Step(length, now.begin + moved.count * now.length, moved.count - 1)
    landing, met = contact.land(
        landing, this, due, now.working.mass, now.near, scene.mold, scene.tables.grid, moved.met
    )
    return dataclasses.replace(
        moved,
        nodes=landing.nodes,
        landed=landing.step,
        impact=landing.impact,
        account=dataclasses.replace(moved.account, contact_loss=landing.loss),
        met=met,
        halted=moved.halted | leaving | moved.seen.missed | (moved.count >= now.most),
    )


def window(
    state: State, scene: Scene, sheet_body: Body, schedule: Schedule | None = None, *, differentiable: bool = True
) -> State:
    """A fixed number of steps with the decisions taken at its border, or as a schedule has them.

    A design may move faster than the one whose schedule it follows: contact then cuts its window short, and the next
    one goes on with the steps that are left; or it is taken anew with shorter ones, as any other. Where no derivative
    is asked for, a halted window ends at once; else its remaining steps change nothing.
    """
    working = worked_through(state, scene, sheet_body, differentiable=differentiable)
    packed = working.taken(state)
    decisions = _decided(packed, scene, working, schedule)
    return working.put_back(_stepped(packed, scene, working, decisions, differentiable=differentiable)[0])


def window_in_place(state: PackedState, scene: Scene, working: Working) -> tuple[PackedState, Working]:
    """As `window`, not differentiable, of a state in packed order; with the room that the next window may write in."""
    decisions = _decided_freely(state, scene, working)

    def whole(now: tuple[PackedState, Room | None]) -> tuple[PackedState, Room | None]:
        own = decisions._replace(chosen=decisions.chosen._replace(room=now[1]))
        state, _, room = _stepped(now[0], scene, working, own, differentiable=False)
        return state, room

    state, room = as_one(whole, (state, decisions.chosen.room), state.windows)
    return state, dataclasses.replace(working, room=room)


def with_room(working: Working, scene: Scene) -> Working:
    """With room for what is worked out in every window."""
    places, elements = working.compliance, working.packed.elements
    basis = no_basis(places.shape[1], places.dtype) if scene.solver.sharp_step else None
    lists = _no_lists(scene, places)
    return dataclasses.replace(working, room=Room(no_corners(places, elements), basis, lists))


def window_and_impacts(
    state: State, scene: Scene, sheet_body: Body, schedule: Schedule | None
) -> tuple[State, jax.Array, jax.Array | None]:
    """As `window`, not differentiable; with the step in which each node (n_node,) landed, NEVER where it did not.

    And its impact (6, n_node), as in `contact.Landing`; None where there is no mold.
    """
    working = worked_through(state, scene, sheet_body)
    impacts, packed = scene.mold is not None, working.packed
    begin = working.taken(state)
    decisions = _decided(begin, scene, working, schedule)
    end, moving, _ = _stepped(begin, scene, working, decisions, differentiable=False, impacts=impacts)
    # Of a window that is not taken nothing landed.
    landed = jnp.where(end.control.last_count > 0, packed.put_back(moving.landed), NEVER)
    return working.put_back(end), landed, None if moving.impact is None else packed.put_back(moving.impact)


def _stepped(
    state: PackedState,
    scene: Scene,
    working: Working,
    decisions: _Decisions,
    *,
    differentiable: bool,
    impacts: bool = False,
) -> tuple[PackedState, _Moving, Room | None]:
    (length, most, limit, room), duration, row = decisions
    now = _Window(
        working=working,
        begin=state.time,
        length=length,
        bound=limit.bound,
        most=most,
        row=row,
        duration=duration,
        near=_list_near(state, scene, working, duration, length, room),
        wary=state.control.last_count == 0,
    )
    nodes = state.nodes
    corners = None if differentiable else no_corners(nodes.positions, working.packed.elements)
    moving = _begun(state, now, corners if room is None else room.corners, impacts)

    def advance(moving: _Moving, pressures: tuple[jax.Array, ...]) -> tuple[_Moving, None]:
        return step(moving, pressures, scene, now), None

    timing = Timing(state.time, state.control.step_length, length)
    longest = scene.tables.window_room
    steps = *pressures(scene.pressure, timing, longest), kicks(timing, longest)
    if differentiable:
        moving = _in_short_ones(advance, moving, steps)
    else:
        moving = _with_positions(moving, membrane.rows_of(nodes.positions))
        moving = _until_halted(
            lambda moving, taken: advance(moving, jax.tree.map(lambda x: entry(x, taken), steps))[0], moving, now.most
        )
        moving = _with_positions(moving, jnp.stack(moving.nodes.positions))
    found = dataclasses.replace(
        state,
        nodes=dataclasses.replace(nodes, mode=limit.mode),
        control=dataclasses.replace(state.control, sharpness=limit.sharpness),
    )
    end, corners = _looked_over(moving, scene, now)
    if room is not None:
        room = Room(corners, room.basis, None if now.near is None else now.near.lists)
    return _close(found, moving, end, scene, now), moving, room


def _with_positions(moving: _Moving, positions: Any) -> _Moving:
    return dataclasses.replace(moving, nodes=dataclasses.replace(moving.nodes, positions=positions))


class _Row(NamedTuple):
    """The row of a schedule whose steps are taken, and the time that is left of it [s]."""

    number: jax.Array
    left: jax.Array


class _Decisions(NamedTuple):
    """What is decided at a window's border.

    The steps, and how long they or those of the schedule were to last [s]; the row they belong to, where one is
    followed.
    """

    chosen: Chosen
    duration: jax.Array
    row: _Row | None = None


def _decided(state: PackedState, scene: Scene, working: Working, schedule: Schedule | None) -> _Decisions:
    if schedule is None:
        return _decided_freely(state, scene, working)
    row = schedule.upcoming(state.replay.row)

    def as_planned(state: PackedState, scene: Scene, working: Working) -> _Decisions:
        length, count = schedule.lengths[row], schedule.counts[row]
        left = jnp.minimum(length * count - state.replay.row_time, jnp.maximum(scene.solver.end_time - state.time, 0.0))
        # Where the sheet is stiffer for its mass than the one of the plan, the steps are shorter by whole rungs.
        bound = elements_bound(state, scene, working)
        rungs = jnp.ceil(jnp.log2(_STIFFER * schedule.bounds[row] / bound) * RUNGS_PER_OCTAVE) / RUNGS_PER_OCTAVE
        finer = jnp.exp2(jnp.maximum(rungs, 0.0) + state.control.retries)
        # As many as planned, if none of them is taken yet; else what is left is divided evenly.
        steps = jnp.ceil(left / length * finer - _SLACK).astype(count.dtype)
        fresh = (steps == count) & (state.replay.row_time == 0.0)
        even = left / jnp.maximum(steps, 1)
        own = jnp.where(fresh, jnp.minimum(length, even), even)
        most = jnp.clip(steps, 1, most_steps(own, scene))
        limit = Limit(state.nodes.mode, bound, state.control.sharpness)
        return _Decisions(Chosen(own, most, limit), schedule.durations[row], _Row(row, left))

    def beyond(*now: Any) -> _Decisions:
        return _decided_freely(*now)._replace(row=_Row(row, jnp.full_like(state.time, jnp.inf)))

    now = jax.lax.stop_gradient((state, scene, working))
    return jax.lax.cond(row < schedule.counts.size, as_planned, beyond, *now)


def _decided_freely(state: PackedState, scene: Scene, working: Working) -> _Decisions:
    chosen = choose_step(state, scene, working)
    return _Decisions(chosen, chosen.most * chosen.length)


def _begun(state: PackedState, now: _Window, room: Corners | None, impacts: bool) -> _Moving:
    working = now.working
    places, positions = working.mass.size, state.nodes.positions
    return _Moving(
        nodes=state.nodes.stepped(),
        fields=state.nodes.fields,
        account=state.account,
        landed=jnp.full(places, NEVER, jnp.int32),
        impact=jnp.zeros((6, places), positions.dtype) if impacts else None,
        count=jnp.int32(0),
        halted=jnp.asarray(False),
        seen=None if now.near is None else unseen(),
        room=room,
        met=None if now.near is None or room is None else contact.nothing_met(places, positions.dtype),
    )


def _in_short_ones(advance: Callable[..., Any], moving: _Moving, steps: tuple[jax.Array, ...]) -> _Moving:
    """Step by step, with a derivative; of a long window as many short ones as are not over when they begin."""

    def take(moving: _Moving, steps: tuple[jax.Array, ...]) -> _Moving:
        return jax.lax.scan(advance, moving, steps)[0]

    def unless_halted(moving: _Moving, steps: tuple[jax.Array, ...]) -> tuple[_Moving, None]:
        return jax.lax.cond(moving.halted, lambda moving, _: moving, take, moving, steps), None

    if len(steps[0]) <= SHORT_WINDOW:
        return take(moving, steps)
    short = jax.tree.map(lambda values: values.reshape(-1, SHORT_WINDOW), steps)
    return jax.lax.scan(unless_halted, moving, short)[0]


def _until_halted(advance: Callable[[_Moving, jax.Array], _Moving], moving: _Moving, most: jax.Array) -> _Moving:
    def going(moving: _Moving) -> jax.Array:
        return (moving.count < most) & ~moving.halted

    return jax.lax.while_loop(going, lambda moving: advance(moving, moving.count), moving)


def _list_near(
    state: PackedState, scene: Scene, working: Working, duration: jax.Array, length: jax.Array, room: Room | None
) -> Near | None:
    if scene.mold is None or scene.tables.grid is None:
        return None
    positions, velocities, grid, duration = jax.lax.stop_gradient(
        (state.nodes.positions, state.nodes.velocities, scene.tables.grid, duration)
    )
    into = _no_lists(scene, positions) if room is None or room.lists is None else room.lists
    till_look, skip_far = LOOK_EVERY * length, scene.solver.skip_far
    blocks = working.packed.elements.node_block_count
    return list_near(positions, velocities, ~state.nodes.stuck, duration, till_look, grid, skip_far, into, blocks)


def _no_lists(scene: Scene, positions: jax.Array) -> Lists | None:
    if scene.mold is None:
        return None
    return no_lists(positions.shape[1], positions.dtype, scene.tables.pairs_per_node)


def _close(state: PackedState, moving: _Moving, end: _End, scene: Scene, now: _Window) -> PackedState:
    """The state at the window's end, with its health checked; a state that is not finite is not taken."""
    near, work = now.near, jax.lax.stop_gradient(moving.account.external_work)
    new = dataclasses.replace(
        state,
        nodes=dataclasses.replace(moving.nodes, mode=state.nodes.mode, fields=moving.fields),
        account=dataclasses.replace(
            moving.account,
            peak_work=jnp.maximum(state.account.peak_work, jnp.abs(work)),
            kinetic_peak=jnp.maximum(state.account.kinetic_peak, end.kinetic),
            kinetic_excess=end.behind - end.kinetic,
        ),
        control=dataclasses.replace(state.control, step_length=now.length, bound=now.bound),
        time=state.time + moving.count * now.length,
        steps=state.steps + moving.count,
        windows=state.windows + 1,
        shortened=state.shortened + (moving.count < now.most),
    )
    rounding = energy_rounding(scene, now.working.substance)
    status, imbalance = _health(new, end, rounding, scene, now.working)
    new = dataclasses.replace(new, account=dataclasses.replace(new.account, imbalance=imbalance))
    # Of a window that turns over more energy than it says, a shorter one is tried: a few times.
    jump = jnp.abs(imbalance - state.account.imbalance) - rounding
    unsure = (jump > _JUMP_TOLERANCE * new.account.peak_work) & (state.control.retries < _RETRIES_FOR_ENERGY)
    # What blew up, and what may have missed the mold since a node flew out of its ball or faster than it looked, is
    # taken anew with half the step: the sheet may have stiffened within the window.
    status = jnp.where(end.missed, Status.CONTACT_MISSED, status)
    bad = (status != 0) | unsure
    status = state.status | jnp.where(state.control.retries >= _MOST_RETRIES, status, 0)
    if near is not None:
        # Pairs were lost: the state is left as it was, for a run with more room.
        bad |= near.overflow
        status |= jnp.where(near.overflow, Status.CONTACT_OVERFLOW, 0)
    status |= jnp.where((end.largest > _FAR * scene.tables.size) & ~bad, Status.RUNAWAY, 0)
    retries = jnp.where(bad, state.control.retries + 1, jnp.maximum(state.control.retries - 1, 0))
    if now.row is not None:
        spent = moving.count * now.length
        whole = now.row.left - spent <= _SLACK * now.length
        row_time = jnp.where(whole, 0.0, state.replay.row_time + spent)
        new = dataclasses.replace(new, replay=Replay(now.row.number + whole, row_time))
    # Chosen as a whole: leaf by leaf it would be a kernel for each.
    kept = only_if(bad, lambda _: state, new, differentiable=moving.room is None)
    shortened = jnp.where(bad, state.shortened + 1, new.shortened)
    return dataclasses.replace(
        kept,
        status=status.astype(jnp.int32),
        control=dataclasses.replace(
            kept.control,
            span=_next_span(state, bad | (moving.count < now.most), jump <= _QUIET * new.account.peak_work, scene, now),
            retries=retries,
            last_length=now.length,
            last_count=jnp.where(bad, 0, moving.count),
            last_duration=now.duration,
        ),
        windows=new.windows,
        shortened=shortened,
    )


def _next_span(state: State, cut_short: jax.Array, quiet: jax.Array, scene: Scene, now: _Window) -> jax.Array:
    """Steps of the next window: more while the account is quiet, the stiffness steady, and little is near the mold.

    A border costs as much as ten steps; but at a border elements that stick leave the list, and the step follows the
    stiffness.
    """
    if scene.tables.window_room <= SHORT_WINDOW:
        return state.control.span
    longer = quiet & (jnp.abs(now.bound - state.control.bound) <= _STEADY * state.control.bound)
    if now.near is not None:
        counts = scene.tables.counts
        nodes = scene.tables.mobility.shape[1] if counts is None else counts.nodes
        longer &= now.near.count <= _FEW_PAIRS * nodes
    longest = jnp.int32(scene.tables.longest_window)
    twice, half = (
        jnp.minimum(2 * state.control.span, longest),
        jnp.maximum(state.control.span // 2, jnp.minimum(SHORT_WINDOW, longest)),
    )
    return jnp.where(cut_short, jnp.minimum(SHORT_WINDOW, longest), jnp.where(longer, twice, half))


class _End(NamedTuple):
    """What a window's end comes to.

    Kinetic energy [J], and that of the velocities, which are half a step behind; the largest coordinate [m], not finite
    where any position is not; whether a node may have missed the mold.
    """

    kinetic: jax.Array
    behind: jax.Array
    largest: jax.Array
    missed: jax.Array | bool


def _looked_over(moving: _Moving, scene: Scene, now: _Window) -> tuple[_End, Corners]:
    """In one pass over the elements and one over the nodes; no derivative is taken of it. With the corners' room.

    Velocities are half a step behind, which shows at the begin and in fast modes: the half step that follows counts as
    well. The product of both is what a linear mode keeps.
    """
    moving, scene, now = jax.lax.stop_gradient((moving, scene, now))
    working, elements = now.working, now.working.packed.elements
    positions = moving.nodes.positions
    volume = None if moving.account.pressure is None else working.volume(positions) + working.idle_volume
    pressure = scene.pressure.at(now.begin + moving.count * now.length, volume)
    load = Load(positions, working.thickness, pressure, scene.material)
    room = no_corners(positions, elements) if moving.room is None else moving.room
    corners, _ = corner_forces(load, elements, room)

    def work(own: Any, nodes: Any, positions: Any, velocities: Any, ball: Any) -> Any:
        ahead, _ = kicked(assembled(corners, own), velocities, nodes, now.length, scene.solver.damping)
        half = 0.5 * nodes[1]
        energies = [half * membrane.dot(velocities, ahead), half * membrane.dot(velocities, velocities)]
        size = functools.reduce(jnp.maximum, [jnp.abs(x) for x in positions])
        if moving.seen is None:
            return [], [*energies, size]
        return [], [*energies, size, missed(positions, nodes[0], ball, moving.seen)]

    nodes = moving.nodes.stuck, working.mass, working.compliance
    ball = None if now.near is None else balls(now.near)
    inputs = shares(elements), nodes, positions, moving.nodes.velocities, ball
    _, found = over_blocks(work, elements.node_block_count, inputs, [], sums=2, most=1 + (ball is not None))
    missing = False if moving.seen is None else moving.seen.missed | (found[3] > 0.0)
    return _End(*found[:3], missed=missing), corners


def _health(
    state: PackedState, end: _End, rounding: jax.Array, scene: Scene, working: Working
) -> tuple[jax.Array, jax.Array]:
    """What is wrong with the state at a window's end, as bits of `Status`, and the energy it holds too much [J]."""
    state, scene, working = jax.lax.stop_gradient((state, scene, working))
    strain, volume = account(state.nodes.positions, working.packed.elements, working.thickness, scene.material)
    strain, volume = strain + working.idle_energy, volume + working.idle_volume
    held = strain + end.kinetic + sum(state.account.losses().values())
    excess = held - state.account.external_work - last_work(state, scene, volume)
    # Not a number, where what is held overflows, is no balance either; nor is energy that vanished.
    balanced = jnp.abs(excess) <= _ENERGY_TOLERANCE * state.account.peak_work + rounding
    finite = jnp.isfinite(end.largest + end.kinetic)
    status = jnp.where(finite, jnp.where(balanced, 0, Status.UNSTABLE), Status.NON_FINITE)
    return status, excess


def energy_rounding(scene: Scene, volume: jax.Array) -> jax.Array:
    """What the account may miss [J] near rest, where the strain energy of a volume [m^3] is the rounding of I1 - 3."""
    scale = jax.lax.stop_gradient(scene.material.stiffness() * volume)
    return (1e-9 + 64 * jnp.finfo(scale.dtype).eps) * scale

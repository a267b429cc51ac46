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

from jaxform import contact, membrane
from jaxform.blocks import BLOCK, only_if, over_blocks, total
from jaxform.body import NEVER, Body, Mesh
from jaxform.force import Corners, Load, assembled, corner_forces, force, no_corners, shares
from jaxform.near import Near, left, list_near, seen, watch
from jaxform.packing import Packed, pack
from jaxform.pytree import pytree
from jaxform.scene import STEPS_PER_WINDOW, Pressure, Scene
from jaxform.state import Schedule, State, Status, account, can_move, counted_volume, enclosed_volume, last_pressure
from jaxform.timestep import RUNGS_PER_OCTAVE, Limit, choose_step, elements_bound

_MOST_RETRIES = 12
_STIFFER = 0.95  # a sheet that is less stiffer than this keeps the steps of a schedule
_SLACK = 1e-3  # of a step: less is rounding
_FAR = 1e4  # of the sheet's size: a sheet that gets there has run away
_ENERGY_TOLERANCE = 0.2  # of the largest work done so far; a blow-up passes it within a window
_JUMP_TOLERANCE, _RETRIES_FOR_ENERGY = 0.02, 4  # the same of one window, which is then taken anew at most so often


@pytree
class _Moving:
    """What changes from step to step inside a window, in packed order.

    `landed` is the step in which a node landed, NEVER where it has not in this window, and the impact that of
    `contact.Landing`, None where it is not kept; the room is None where derivatives are taken.
    """

    positions: jax.Array
    velocities: jax.Array
    stuck: jax.Array
    contact_time: jax.Array
    wall: jax.Array
    landed: jax.Array
    impact: jax.Array | None
    volume: jax.Array
    external_work: jax.Array
    damping_loss: jax.Array
    contact_loss: jax.Array
    count: jax.Array
    halted: jax.Array
    room: Corners | None


@pytree
class _Window:
    """What stays the same within a window, in packed order.

    Attributes:
        packed: The elements and nodes that are worked through.
        thickness: Initial thickness of the elements (room,) [m].
        mass: Lumped mass of the nodes (place,) [kg].
        compliance: Mobility over mass (3, place) [1/kg].
        begin: Its begin [s].
        length: The step [s].
        bound: The elements' bound on it [s].
        most: How many steps it takes, unless it is cut short.
        row: Of a schedule that is followed; None where none is.
        idle_volume: Enclosed by what is not worked through [m^3].
        near: The list of nodes near the mold; None where there is no mold.
    """

    packed: Packed
    thickness: jax.Array
    mass: jax.Array
    compliance: jax.Array
    begin: jax.Array
    length: jax.Array
    bound: jax.Array
    most: jax.Array | int
    row: _Row | None
    idle_volume: jax.Array
    near: Near | None


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
    if moving.room is None:
        # A halted window runs on without moving: a step of length zero changes nothing.
        length, kick = jnp.where(moving.halted, 0.0, length), jnp.where(moving.halted, 0.0, kick)
    load = Load(moving.positions, now.thickness, pressure, scene.material)
    taken = (_taken if moving.room is None else _taken_in_blocks)(load, moving, kick, length, scene, now)
    volume = taken.volume + now.idle_volume
    count = moving.count + jnp.where(moving.halted, 0, 1)
    moved = dataclasses.replace(
        moving,
        positions=taken.positions,
        velocities=taken.velocities,
        volume=volume,
        external_work=moving.external_work + mean_pressure * (volume - moving.volume),
        damping_loss=moving.damping_loss + taken.loss,
        count=count,
        room=taken.room,
    )
    if now.near is None:
        return moved if moving.room is not None else dataclasses.replace(moved, halted=_flown(moved, scene, now))
    return _touch(moved, taken, length, scene, now)


def _flown(moved: _Moving, scene: Scene, now: _Window) -> jax.Array:
    """Whether a window without contact halts: a sheet that flies off must not overflow where derivatives are taken."""
    far = jnp.max(jnp.abs(jax.lax.stop_gradient(moved.positions))) > _FAR * scene.tables.size
    return moved.halted | far | (moved.count >= now.most)


class _Taken(NamedTuple):
    """After a step without contact: positions [m], velocities [m/s], the volume before [m^3], the damping loss [J].

    With them whether a node has gone far enough to touch the mold, and whether one may soon leave its ball.
    """

    positions: jax.Array
    velocities: jax.Array
    volume: jax.Array
    loss: jax.Array | float
    reached: jax.Array | bool
    leaving: jax.Array | bool
    room: Corners | None


def _taken(load: Load, moving: _Moving, kick: jax.Array, length: jax.Array, scene: Scene, now: _Window) -> _Taken:
    nodal, volume = force(load, now.packed.elements)
    nodes = moving.stuck, now.mass, now.compliance
    velocities, losses = kicked(nodal, moving.velocities, nodes, kick, scene.solver.damping)
    positions = moving.positions + length * jnp.stack(velocities)
    reached = leaving = False
    if now.near is not None:
        found = watch(jax.lax.stop_gradient(positions), moving.stuck, seen(now.near))
        reached, leaving = (jnp.any(flag) for flag in found)
    loss = total(losses) if losses is not None else 0.0
    return _Taken(positions, jnp.stack(velocities), volume, loss, reached, leaving, None)


def _taken_in_blocks(
    load: Load, moving: _Moving, kick: jax.Array, length: jax.Array, scene: Scene, now: _Window
) -> _Taken:
    """The same in one pass over the elements in use and one over the nodes in use; not differentiable."""
    elements, room = now.packed.elements, moving.room
    assert room is not None
    corners, volume = corner_forces(load, elements, room)
    nodes = moving.stuck, now.mass, now.compliance
    near = None if now.near is None else seen(now.near)

    def work(old: Any, own: Any, nodes: Any, near: Any) -> Any:
        positions, velocities = old
        nodal = assembled(corners, own)
        velocities, losses = kicked(nodal, velocities, nodes, kick, scene.solver.damping)
        new = [x + length * v for x, v in zip(positions, velocities, strict=True)]
        sums = [] if losses is None else [losses]
        if near is not None:
            sums += watch(new, nodes[0], near)
        return [new, velocities], sums

    inputs, into = (shares(corners, elements), nodes, near), [moving.positions, moving.velocities]
    count = (scene.solver.damping is not None) + 2 * (near is not None)
    new, sums = over_blocks(work, elements.node_block_count, inputs, into, sums=count, update=2)
    loss = sums.pop(0) if scene.solver.damping is not None else 0.0
    reached, leaving = (sums[0] > 0, sums[1] > 0) if sums else (False, False)
    return _Taken(new[0], new[1], volume, loss, reached, leaving, corners)


def kicked(
    nodal: Any,
    velocities: Any,
    nodes: tuple[jax.Array, jax.Array, Any],
    kick: jax.Array,
    damping: jax.Array | None,
) -> tuple[membrane.Vector, jax.Array | None]:
    """New velocities, and the loss (n,) [J] by damping where there is any, of nodes stuck or not, mass, compliance."""
    stuck, mass, compliance = nodes
    gains = [kick * jnp.where(stuck, 0.0, f * c) for f, c in zip(nodal, compliance, strict=True)]
    half = None if damping is None else 0.5 * damping * kick
    if half is None:
        x, y, z = (old + gain for old, gain in zip(velocities, gains, strict=True))
    else:
        x, y, z = (((1.0 - half) * old + gain) / (1.0 + half) for old, gain in zip(velocities, gains, strict=True))
    # Kept, since the positions and the loss would each work them, and the force, out again.
    new = jax.lax.optimization_barrier((x, y, z))
    if damping is None:
        return new, None
    mean = membrane.plus(new, velocities)
    return new, 0.25 * kick * damping * mass * membrane.dot(mean, mean)


def _touch(moved: _Moving, taken: _Taken, length: jax.Array, scene: Scene, now: _Window) -> _Moving:
    """Contact of one step; halts the window when a node is about to leave the range of its list."""
    assert scene.mold is not None and scene.tables.grid is not None and now.near is not None
    landing = contact.Landing(
        moved.positions,
        moved.velocities,
        moved.stuck,
        moved.contact_time,
        moved.wall,
        moved.landed,
        moved.contact_loss,
        moved.impact,
    )
    reached = jnp.asarray(taken.reached) if scene.solver.skip_far else jnp.asarray(True)
    this = contact.Step(length, now.begin + moved.count * now.length, moved.count - 1)
    differentiable = moved.room is None
    landing = contact.land(
        landing, this, reached, now.mass, now.near, scene.mold, scene.tables.grid, differentiable=differentiable
    )
    return dataclasses.replace(
        moved,
        positions=landing.positions,
        velocities=landing.velocities,
        stuck=landing.stuck,
        contact_time=landing.contact_time,
        wall=landing.wall,
        landed=landing.step,
        impact=landing.impact,
        contact_loss=landing.loss,
        halted=moved.halted | taken.leaving | (moved.count >= now.most),
    )


def window(
    state: State,
    scene: Scene,
    sheet_body: Body,
    schedule: Schedule | None = None,
    *,
    packed: Packed | None = None,
    differentiable: bool = True,
) -> State:
    """A fixed number of steps with the decisions taken at its border, or as a schedule has them.

    A design may move faster than the one whose schedule it follows: contact then cuts its window short, and the next
    one goes on with the steps that are left; or it is taken anew with shorter ones, as any other. Where no derivative
    is asked for, a halted window ends at once; else its remaining steps change nothing. What is worked through may be
    given, `packed`, where it is known.
    """
    packed = worked_through(state.stuck, state.mesh, scene, sheet_body) if packed is None else packed
    return _stepped(state, scene, sheet_body, packed, schedule, differentiable=differentiable)[0]


def window_and_impacts(
    state: State, scene: Scene, sheet_body: Body, packed: Packed, schedule: Schedule | None
) -> tuple[State, jax.Array, jax.Array | None]:
    """As `window`, not differentiable; with the step in which each node (n_node,) landed, NEVER where it did not.

    And its impact (6, n_node), as in `contact.Landing`; None where there is no mold.
    """
    impacts = scene.mold is not None
    end, moving = _stepped(state, scene, sheet_body, packed, schedule, differentiable=False, impacts=impacts)
    # Of a window that is not taken nothing landed.
    landed = jnp.where(end.last_count > 0, packed.put_back(moving.landed), NEVER)
    return end, landed, None if moving.impact is None else packed.put_back(moving.impact)


def _stepped(
    state: State,
    scene: Scene,
    sheet_body: Body,
    packed: Packed,
    schedule: Schedule | None,
    *,
    differentiable: bool,
    impacts: bool = False,
) -> tuple[State, _Moving]:
    decided = _decided(state, scene, sheet_body, packed, schedule)
    length = decided.length
    moving = _begun(state, packed, differentiable, impacts)
    now = _Window(
        packed=packed,
        thickness=sheet_body.thickness[packed.element],
        mass=packed.taken(sheet_body.mass),
        compliance=packed.taken(sheet_body.compliance),
        begin=state.time,
        length=length,
        bound=decided.limit.bound,
        most=decided.most,
        row=decided.row,
        idle_volume=idle_volume(state.positions, scene, sheet_body, packed, differentiable=differentiable),
        near=_list_near(moving, scene, length),
    )

    def advance(moving: _Moving, pressures: tuple[jax.Array, ...]) -> tuple[_Moving, None]:
        return step(moving, pressures, scene, now), None

    timing = Timing(state.time, state.step_length, length)
    steps = *pressures(scene.pressure, timing), kicks(timing)
    if differentiable:
        moving, _ = jax.lax.scan(advance, moving, steps)
    else:
        moving = _until_halted(
            lambda moving, taken: advance(moving, jax.tree.map(lambda x: x[taken], steps))[0], moving, now.most
        )
    found = dataclasses.replace(state, mode=decided.limit.mode, sharpness=decided.limit.sharpness)
    return _close(found, moving, scene, sheet_body, now), moving


class Timing(NamedTuple):
    """A window's begin, the step before it and its own [s]."""

    begin: jax.Array
    before: jax.Array
    length: jax.Array


def pressures(pressure: Pressure, timing: Timing) -> tuple[jax.Array, jax.Array]:
    """At the begin of each step of a window, and averaged since the begin of the step before [Pa]."""
    index = jnp.arange(STEPS_PER_WINDOW)
    times = timing.begin + index * timing.length
    now = pressure.at(times)
    before = pressure.at(jnp.where(index == 0, timing.begin - timing.before, times - timing.length))
    return now, 0.5 * (before + now)


def kicks(timing: Timing) -> jax.Array:
    """The step that the velocity takes in each step of a window [s]."""
    first = 0.5 * (timing.before + timing.length)
    return jnp.where(jnp.arange(STEPS_PER_WINDOW) == 0, first, timing.length)


class _Row(NamedTuple):
    """The row of a schedule whose steps are taken, and the time that is left of it [s]."""

    number: jax.Array
    left: jax.Array


class _Decisions(NamedTuple):
    """What is decided at a window's border.

    The step [s], what it was found with, and how many there are at most; the row they belong to, where a schedule is
    followed.
    """

    length: jax.Array
    limit: Limit
    most: jax.Array | int
    row: _Row | None = None


def _decided(state: State, scene: Scene, sheet_body: Body, packed: Packed, schedule: Schedule | None) -> _Decisions:
    if schedule is None:
        return _Decisions(*choose_step(state, scene, sheet_body, packed), STEPS_PER_WINDOW)
    row = schedule.upcoming(state.row)

    def as_planned(state: State, scene: Scene, sheet_body: Body, packed: Packed) -> _Decisions:
        length, count = schedule.lengths[row], schedule.counts[row]
        left = jnp.minimum(length * count - state.row_time, jnp.maximum(scene.solver.end_time - state.time, 0.0))
        # Where the sheet is stiffer for its mass than the one of the plan, the steps are shorter by whole rungs.
        bound = elements_bound(state, scene, sheet_body, packed)
        rungs = jnp.ceil(jnp.log2(_STIFFER * schedule.bounds[row] / bound) * RUNGS_PER_OCTAVE) / RUNGS_PER_OCTAVE
        finer = jnp.exp2(jnp.maximum(rungs, 0.0) + state.retries)
        # As many as planned, if none of them is taken yet; else what is left is divided evenly.
        steps = jnp.ceil(left / length * finer - _SLACK).astype(count.dtype)
        fresh = (steps == count) & (state.row_time == 0.0)
        even = left / jnp.maximum(steps, 1)
        most = jnp.clip(steps, 1, STEPS_PER_WINDOW)
        limit = Limit(state.mode, bound, state.sharpness)
        return _Decisions(jnp.where(fresh, jnp.minimum(length, even), even), limit, most, _Row(row, left))

    def beyond(*now: Any) -> _Decisions:
        most = jnp.full_like(schedule.counts[0], STEPS_PER_WINDOW)
        return _Decisions(*choose_step(*now), most, _Row(row, jnp.full_like(state.time, jnp.inf)))

    now = (*jax.lax.stop_gradient((state, scene, sheet_body)), packed)
    return jax.lax.cond(row < schedule.counts.size, as_planned, beyond, *now)


def worked_through(stuck: jax.Array, mesh: Mesh | None, scene: Scene, sheet_body: Body) -> Packed:
    """The elements and nodes of a window that begins with such nodes (n_node,) stuck."""
    if not scene.packs_moving:
        return sheet_body.whole
    sheet = sheet_body.sheet
    counts = None if mesh is None else (mesh.element_count, mesh.node_count)
    return pack(can_move(stuck, sheet.triangles, sheet.area), sheet, sheet_body.assembly, counts)


def still_worked_through(
    state: State, scene: Scene, sheet_body: Body, packed: Packed, stale: jax.Array | bool
) -> Packed:
    """The same from what the last window worked through: made anew only where that is stale, or is a block too long."""
    if not scene.packs_moving:
        return sheet_body.whole
    elements, stuck = packed.elements, packed.taken(state.stuck)

    def work(triangles: jax.Array, area: jax.Array) -> Any:
        return [], [can_move(stuck, triangles, area).astype(area.dtype)]

    _, (moving,) = over_blocks(work, elements.block_count, (elements.triangles, elements.area), [], sums=1)
    shorter = moving.astype(jnp.int32) // BLOCK + 1 < elements.block_count
    return only_if(stale | shorter, lambda _: worked_through(state.stuck, state.mesh, scene, sheet_body), packed)


def _begun(state: State, packed: Packed, differentiable: bool, impacts: bool) -> _Moving:
    positions = packed.taken(state.positions)
    return _Moving(
        positions=positions,
        velocities=jnp.where(packed.exists, packed.taken(state.velocities), 0.0),
        stuck=packed.taken(state.stuck) | ~packed.exists,
        contact_time=packed.taken(state.contact_time),
        wall=packed.taken(state.wall),
        landed=jnp.full(packed.node.size, NEVER, jnp.int32),
        impact=jnp.zeros((6, packed.node.size), positions.dtype) if impacts else None,
        volume=state.volume,
        external_work=state.external_work,
        damping_loss=state.damping_loss,
        contact_loss=state.contact_loss,
        count=jnp.int32(0),
        halted=jnp.asarray(False),
        room=None if differentiable else no_corners(positions, packed.elements),
    )


def idle_volume(
    positions: jax.Array, scene: Scene, sheet_body: Body, packed: Packed, *, differentiable: bool
) -> jax.Array:
    """Volume [m^3] enclosed by what is not worked through, of positions (3, n_node) [m]."""
    if not scene.packs_moving:
        return jnp.zeros((), positions.dtype)
    if differentiable:
        return enclosed_volume(positions, sheet_body.sheet, jnp.where(packed.kept, 0.0, 1.0))
    return counted_volume(positions, sheet_body, ~packed.kept)


def _until_halted(advance: Callable[[_Moving, jax.Array], _Moving], moving: _Moving, most: jax.Array | int) -> _Moving:
    def going(moving: _Moving) -> jax.Array:
        return (moving.count < most) & ~moving.halted

    return jax.lax.while_loop(going, lambda moving: advance(moving, moving.count), moving)


def _list_near(moving: _Moving, scene: Scene, length: jax.Array) -> Near | None:
    if scene.mold is None or scene.tables.grid is None:
        return None
    positions, velocities, grid, length = jax.lax.stop_gradient(
        (moving.positions, moving.velocities, scene.tables.grid, length)
    )
    duration = length * STEPS_PER_WINDOW
    return list_near(positions, velocities, ~moving.stuck, duration, grid, scene.solver.skip_far)


def _close(
    state: State,
    moving: _Moving,
    scene: Scene,
    sheet_body: Body,
    now: _Window,
) -> State:
    """The state at the window's end, with its health checked; a state that is not finite is not taken."""
    packed, near = now.packed, now.near
    kinetic, excess = _kinetic(moving, scene, now)
    new = dataclasses.replace(
        state,
        positions=packed.put_back(moving.positions),
        velocities=packed.put_back(moving.velocities),
        stuck=packed.put_back(moving.stuck),
        contact_time=packed.put_back(moving.contact_time),
        wall=packed.put_back(moving.wall),
        time=state.time + moving.count * now.length,
        step_length=now.length,
        bound=now.bound,
        volume=moving.volume,
        external_work=moving.external_work,
        damping_loss=moving.damping_loss,
        contact_loss=moving.contact_loss,
        peak_work=jnp.maximum(state.peak_work, jnp.abs(jax.lax.stop_gradient(moving.external_work))),
        kinetic_peak=jnp.maximum(state.kinetic_peak, kinetic),
        kinetic_excess=excess,
        steps=state.steps + moving.count,
        windows=state.windows + 1,
        shortened=state.shortened + (moving.count < STEPS_PER_WINDOW),
    )
    rounding = energy_rounding(scene, total(packed.elements.area * now.thickness))
    largest = jnp.max(jnp.abs(jax.lax.stop_gradient(moving.positions)))
    status, imbalance = _health(new, largest, kinetic, rounding, scene, sheet_body)
    new = dataclasses.replace(new, imbalance=imbalance)
    # Of a window that turns over more energy than it says, a shorter one is tried: a few times.
    jump = jnp.abs(imbalance - state.imbalance) > _JUMP_TOLERANCE * new.peak_work + rounding
    unsure = jump & (state.retries < _RETRIES_FOR_ENERGY)
    # What blew up, and what may have missed the mold since a node flew out of its ball, is taken anew with half the
    # step: the sheet may have stiffened within the window.
    missed = jnp.asarray(False) if near is None else left(moving.positions, near)
    status = jnp.where(missed, Status.CONTACT_MISSED, status)
    bad = (status != 0) | unsure
    status = state.status | jnp.where(state.retries >= _MOST_RETRIES, status, 0)
    if near is not None:
        status |= jnp.where(near.overflow, Status.CONTACT_OVERFLOW, 0)
    status |= jnp.where((largest > _FAR * scene.tables.size) & ~bad, Status.RUNAWAY, 0)
    retries = jnp.where(bad, state.retries + 1, jnp.maximum(state.retries - 1, 0))
    if now.row is not None:
        spent = moving.count * now.length
        whole = now.row.left - spent <= _SLACK * now.length
        row_time = jnp.where(whole, 0.0, state.row_time + spent)
        new = dataclasses.replace(new, row=now.row.number + whole, row_time=row_time)
    # Chosen as a whole: leaf by leaf it would be a kernel for each.
    kept = only_if(bad, lambda _: state, new, differentiable=moving.room is None)
    shortened = jnp.where(bad, state.shortened + 1, new.shortened)
    return dataclasses.replace(
        kept,
        status=status.astype(jnp.int32),
        retries=retries,
        windows=new.windows,
        shortened=shortened,
        last_length=now.length,
        last_count=jnp.where(bad, 0, moving.count),
    )


def _kinetic(moving: _Moving, scene: Scene, now: _Window) -> tuple[jax.Array, jax.Array]:
    """Kinetic energy [J] and by how much that of the velocities is larger; no derivative is taken of them.

    Velocities are half a step behind, which shows at the begin and in fast modes: the half step that follows counts as
    well. The product of both is what a linear mode keeps.
    """
    moving, scene, now = jax.lax.stop_gradient((moving, scene, now))
    behind = 0.5 * total(now.mass * membrane.dot(moving.velocities, moving.velocities))
    end = now.begin + moving.count * now.length
    load = Load(moving.positions, now.thickness, scene.pressure.at(end), scene.material)
    ahead = (_taken if moving.room is None else _taken_in_blocks)(load, moving, now.length, now.length, scene, now)
    kinetic = 0.5 * total(now.mass * membrane.dot(moving.velocities, ahead.velocities))
    return kinetic, behind - kinetic


def _health(
    state: State, largest: jax.Array, kinetic: jax.Array, rounding: jax.Array, scene: Scene, sheet_body: Body
) -> tuple[jax.Array, jax.Array]:
    """What is wrong with the state at a window's end, as bits of `Status`, and the energy it holds too much [J].

    `largest` is the largest coordinate [m]: not finite where any position is not.
    """
    state, scene, sheet_body = jax.lax.stop_gradient((state, scene, sheet_body))
    strain, volume = account(state.positions, scene, sheet_body)
    held = strain + kinetic
    held += state.damping_loss + state.contact_loss + state.refinement_loss
    excess = held - state.external_work - last_pressure(state, scene) * (volume - state.volume)
    # Not a number, where what is held overflows, is no balance either; nor is energy that vanished.
    balanced = jnp.abs(excess) <= _ENERGY_TOLERANCE * state.peak_work + rounding
    status = jnp.where(jnp.isfinite(largest + kinetic), jnp.where(balanced, 0, Status.UNSTABLE), Status.NON_FINITE)
    return status, excess


def energy_rounding(scene: Scene, volume: jax.Array) -> jax.Array:
    """What the account may miss [J] near rest, where the strain energy of a volume [m^3] is the rounding of I1 - 3."""
    scale = jax.lax.stop_gradient(scene.material.stiffness() * volume)
    return (1e-9 + 64 * jnp.finfo(scale.dtype).eps) * scale

"""The reverse derivative of a window's steps, written by hand.

Between its borders a window is a few passes over elements and nodes. Gone through backwards they are as many: the steps
are worked out once more from the state at the border, by loops as fast as a run's, the velocities of each are kept, and
then every step costs one pass over the elements, for the transpose of the force's derivative, and one over the nodes.
Found by JAX, it would keep more and work every step out a third time; forward mode, which keeps nothing, is left to
JAX.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from jaxform import contact
from jaxform.blocks import Part, listed, only_if, over_blocks
from jaxform.body import NEVER, Body, Mesh, present_body
from jaxform.derivatives import Cotangents, Rule
from jaxform.force import Corners, Load, assembled, corner_cotangents, corner_forces, no_corners, spilled
from jaxform.membrane import Vector, dot, rows_of
from jaxform.mold import Mold
from jaxform.packing import Packed
from jaxform.pytree import pytree
from jaxform.scene import STEPS_PER_WINDOW, Scene
from jaxform.state import Schedule, State
from jaxform.stepping import (
    Timing,
    idle_volume,
    kicked,
    kicks,
    pressures,
    window,
    window_and_landings,
    worked_through,
)

_SMOOTH = ("positions", "velocities", "contact_time", "volume", "external_work")
_SMOOTH += ("damping_loss", "contact_loss", "refinement_loss")


@pytree
class _Kept:
    """What the reverse derivative of a window needs.

    Of its begin positions, velocities, stuck, time [s], step [s], volume [m^3] and mesh, as in `State`; of its end
    `end` (3, n_node) [m], wall and the steps in which nodes landed (n_node,), its step [s] and how many were taken.
    """

    scene: Scene
    first: Body
    positions: jax.Array
    velocities: jax.Array
    stuck: jax.Array
    time: jax.Array
    before: jax.Array
    volume: jax.Array
    mesh: Mesh | None
    end: jax.Array
    wall: jax.Array
    landed: jax.Array
    length: jax.Array
    count: jax.Array


def _value(state: State, scene: Scene, sheet_body: Body, first: Body, schedule: Schedule | None) -> tuple[State, _Kept]:
    packed = worked_through(state.stuck, state.mesh, scene, sheet_body)
    end, landed = window_and_landings(state, scene, sheet_body, packed, schedule, differentiable=False)
    kept = _Kept(
        scene=scene,
        first=first,
        positions=state.positions,
        velocities=state.velocities,
        stuck=state.stuck,
        time=state.time,
        before=state.step_length,
        volume=state.volume,
        mesh=state.mesh,
        end=end.positions,
        wall=end.wall,
        landed=landed,
        length=end.last_length,
        count=end.last_count,
    )
    return end, kept


@jax.checkpoint
def _plain(state: State, scene: Scene, sheet_body: Body, _: Body, schedule: Schedule | None) -> State:
    return window(state, scene, sheet_body, schedule)


def carries(state: State) -> State:
    """Which leaves of a state carry a derivative."""
    none: Any = jax.tree.map(lambda _: False, state)
    return dataclasses.replace(none, **dict.fromkeys(_SMOOTH, True))


class _Window(NamedTuple):
    """What stays the same within a window, in packed order; as in `stepping`, and when nodes landed (place,)."""

    scene: Scene
    packed: Packed
    thickness: jax.Array
    mass: jax.Array
    compliance: jax.Array
    landed: jax.Array
    pressure: jax.Array
    kick: jax.Array
    length: jax.Array
    count: jax.Array


class _Replay(NamedTuple):
    """The steps worked out once more.

    Attributes:
        speeds: Velocities before each step and after the last (3, (1 + steps) place) [m/s], one step's after another's;
            of nodes that landed, what they landed with. Positions follow from them.
        volumes: Enclosed by what is worked through, before each step [m^3].
    """

    speeds: jax.Array
    volumes: jax.Array


def _replayed(kept: _Kept, now: _Window) -> _Replay:
    packed, elements, damping = now.packed, now.packed.elements, now.scene.solver.damping
    begin, end = packed.taken(kept.positions), packed.taken(kept.end)
    velocities = jnp.where(packed.exists, packed.taken(kept.velocities), 0.0)
    places = now.mass.size

    def advance(carry: tuple[Any, ...]) -> tuple[Any, ...]:
        n, positions, velocities, speeds, volumes, corners = carry
        load = Load(positions, now.thickness, now.pressure[n], now.scene.material)
        corners, volume = corner_forces(load, elements, corners)
        spill = spilled(corners, elements)

        def work(old: Any, slots: Any, spill: Any, landed: Any, mass: Any, compliance: Any, end: Any) -> Any:
            positions, velocities = old
            nodal = assembled(corners, slots, elements.row_count, spill)
            new, _ = kicked(nodal, velocities, (landed < n, mass, compliance), now.kick[n], damping)
            velocities = [jnp.where(landed < n, old, v) for old, v in zip(velocities, new, strict=True)]
            ways = zip(positions, velocities, end, strict=True)
            return [[jnp.where(landed <= n, to, x + now.length * v) for x, v, to in ways], velocities, velocities], []

        inputs = elements.slots, spill, now.landed, now.mass, now.compliance, end
        into = [positions, velocities, Part(speeds, (n + 1) * places, places)]
        new, _ = over_blocks(work, elements.node_block_count, inputs, into, update=2)
        return n + 1, *new, volumes.at[n].set(volume), corners

    speeds = jnp.zeros((3, (STEPS_PER_WINDOW + 1) * places), begin.dtype).at[:, :places].set(velocities)
    volumes = jnp.zeros(STEPS_PER_WINDOW, begin.dtype)
    carry = jnp.int32(0), begin, velocities, speeds, volumes, no_corners(begin, elements)
    carry = jax.lax.while_loop(lambda carry: carry[0] < now.count, advance, carry)
    return _Replay(carry[3], carry[4])


class _Nodes(NamedTuple):
    """Between two steps: where the nodes are (3, place) [m], cotangents, and what the sums over steps have come to.

    Cotangents of positions and velocities (3, place); that of the force of the step before, for the elements to pull
    back; of the mass, the compliance's logarithm and the contact time (place,); of the damping and of the mold's
    vertices (n_vertex, 3).
    """

    at: jax.Array
    positions: jax.Array
    velocities: jax.Array
    force: jax.Array
    mass: jax.Array
    compliance: jax.Array
    contact_time: jax.Array
    damping: jax.Array
    vertices: jax.Array | None


class _Step(NamedTuple):
    """One step: its number, its length and the one that the velocity takes [s]."""

    number: jax.Array
    length: jax.Array
    kick: jax.Array


class _Before(NamedTuple):
    """Cotangents before a step, of velocity and force (3, n), and a step's shares of others, as in `_Nodes` (n,)."""

    velocity: Any
    force: Any
    mass: jax.Array
    compliance: jax.Array
    damping: jax.Array


def _vector(components: Iterable[jax.Array]) -> Vector:
    x, y, z = components
    return x, y, z


def _before(
    after: tuple[Any, Any],
    node: tuple[jax.Array, Any, jax.Array],
    speeds: tuple[Any, Any],
    step: _Step,
    damping: jax.Array | None,
    loss: jax.Array,
) -> _Before:
    """Nodes' cotangents before a step without contact.

    Args:
        after: Those of positions and velocities after it.
        node: Of the nodes mass, compliance, and whether they are free.
        speeds: Their velocities before and after it [m/s].
        step: The step.
        damping: The scene's [1/s].
        loss: Cotangent of the damping loss.
    """
    mass, compliance, free = node
    rubbed = 0.0 if damping is None else damping
    half = 0.5 * step.kick * rubbed
    kept = [v + step.length * x for x, v in zip(*after, strict=True)]
    twice = _vector(jnp.where(free, old + new, 0.0) for old, new in zip(*speeds, strict=True))
    share = 0.5 * loss * step.kick * mass * rubbed
    if damping is not None:
        kept = [g + share * both for g, both in zip(kept, twice, strict=True)]
    kept = _vector(jax.lax.optimization_barrier(kept))
    ratio = (1.0 - half) / (1.0 + half)
    gains = _vector(jnp.where(free, new - ratio * old, 0.0) for old, new in zip(*speeds, strict=True))
    velocity = kept if damping is None else [ratio * g + share * both for g, both in zip(kept, twice, strict=True)]
    force = [jnp.where(free, step.kick / (1.0 + half) * c * g, 0.0) for g, c in zip(kept, compliance, strict=True)]
    rate = 0.25 * loss * step.kick * dot(twice, twice)
    return _Before(
        velocity=velocity,
        force=force,
        mass=jnp.zeros_like(rate) if damping is None else rate * damping,
        compliance=dot(kept, gains),
        damping=rate * mass - 0.5 * step.kick / (1.0 + half) * dot(kept, twice),
    )


def _over_nodes(
    nodes: _Nodes, corners: Corners, speeds: tuple[Any, Any], step: _Step, now: _Window, loss: jax.Array
) -> _Nodes:
    """Adds what the elements pulled back to the positions' cotangents, and goes back over the step before.

    Nodes that landed in that step are left for `_landings`.
    """
    elements, damping = now.packed.elements, now.scene.solver.damping
    spill = spilled(corners, elements)

    def work(old: Any, slots: Any, spill: Any, landed: Any, mass: Any, compliance: Any, speeds: Any) -> Any:
        at, position, velocity, (power,), *more = old
        pulled = assembled(corners, slots, elements.row_count, spill)
        position = jax.lax.optimization_barrier([x + own for x, own in zip(position, pulled, strict=True)])
        free, lands = landed >= step.number, landed == step.number
        before = _before((position, velocity), (mass, compliance, free), speeds, step, damping, loss)
        velocity = [jnp.where(lands, v, new) for v, new in zip(velocity, before.velocity, strict=True)]
        force = [jnp.where(lands, 0.0, f) for f in before.force]
        power = [power + jnp.where(lands, 0.0, before.compliance)]
        # Taken back is what was gone; nodes that stuck stay.
        at = [x - jnp.where(free, step.length * v, 0.0) for x, v in zip(at, speeds[1], strict=True)]
        if damping is None:
            return [at, position, velocity, power, force], []
        masses = [more[0][0] + jnp.where(lands, 0.0, before.mass)]
        return [at, position, velocity, power, masses, force], [jnp.where(lands, 0.0, before.damping)]

    inputs = elements.slots, spill, now.landed, now.mass, now.compliance, speeds
    updated = [nodes.at, nodes.positions, nodes.velocities, nodes.compliance[None]]
    updated += [nodes.mass[None]] if damping is not None else []
    new, sums = over_blocks(
        work, elements.node_block_count, inputs, [*updated, nodes.force], sums=len(updated) - 4, update=len(updated)
    )
    nodes = nodes._replace(at=new[0], positions=new[1], velocities=new[2], compliance=new[3][0], force=new[-1])
    return nodes if damping is None else nodes._replace(mass=new[4][0], damping=nodes.damping + sums[0])


def _landings(nodes: _Nodes, replay: _Replay, kept: _Kept, step: _Step, now: _Window, losses: Any) -> _Nodes:
    """Goes back over the landings of a step, and over the step, for the nodes that landed: one by one."""
    mold = now.scene.mold
    assert mold is not None
    wall = now.packed.taken(kept.wall)
    end = kept.time + (step.number + 1) * step.length
    number = step.number
    places, count = listed(now.landed == number, now.landed.size)
    start, steps = now.packed.taken(kept.positions), jnp.arange(STEPS_PER_WINDOW + 1)
    speeds = replay.speeds.reshape(3, steps.size, -1)

    def one(k: jax.Array, nodes: _Nodes) -> _Nodes:
        place = places[k]

        def own(values: jax.Array) -> jax.Array:
            return jax.lax.dynamic_slice_in_dim(values, place, 1, axis=values.ndim - 1)

        def put(values: jax.Array, new: jax.Array) -> jax.Array:
            return jax.lax.dynamic_update_slice_in_dim(values, new, place, values.ndim - 1)

        def land(after: jax.Array, velocity: jax.Array, mass: jax.Array, corners: jax.Array) -> Any:
            free, none = jnp.zeros(1, bool), jnp.zeros(1, jnp.int32)
            flying = contact.Landing(after, velocity, free, jnp.zeros_like(mass), none, none, jnp.zeros_like(end))
            triangle = Mold(corners, jnp.arange(3, dtype=jnp.int32)[None])
            there = contact.landed(flying, contact.Step(step.length, end, number), mass, triangle, none)
            return there.positions, there.velocities, there.contact_time, there.loss

        # All is read before anything is written, or XLA would copy the arrays.
        old = jax.lax.optimization_barrier(jax.tree.map(own, nodes._replace(damping=None, vertices=None)))
        # Its positions were not kept: they are summed up from the begin.
        own_speeds = jax.lax.dynamic_index_in_dim(speeds, place, 2, keepdims=False)
        gone = jnp.where((steps > 0) & (steps <= number), own_speeds, 0.0)
        begin = own(start) + step.length * jnp.sum(gone, axis=1, keepdims=True)
        around = own_speeds[:, number, None], own_speeds[:, number + 1, None]
        triangle = mold.triangles[jnp.abs(own(wall)[0]) - 1]
        _, pull = jax.vjp(land, begin + step.length * around[1], around[1], own(now.mass), mold.vertices[triangle])
        after, speed, mass, corners = pull((old.positions, old.velocities, old.contact_time, losses[1]))
        node = own(now.mass), rows_of(own(now.compliance)), jnp.ones(1, bool)
        rows = rows_of(around[0]), rows_of(around[1])
        before = _before((rows_of(after), rows_of(speed)), node, rows, step, now.scene.solver.damping, losses[0])
        return _Nodes(
            at=put(nodes.at, begin),
            positions=put(nodes.positions, after),
            velocities=put(nodes.velocities, jnp.stack(before.velocity)),
            force=put(nodes.force, jnp.stack(before.force)),
            mass=put(nodes.mass, old.mass + mass + before.mass),
            compliance=put(nodes.compliance, old.compliance + before.compliance),
            contact_time=put(nodes.contact_time, jnp.zeros_like(old.contact_time)),
            damping=nodes.damping + before.damping[0],
            vertices=None if nodes.vertices is None else nodes.vertices.at[triangle].add(corners),
        )

    return jax.lax.fori_loop(0, count, one, nodes)


def _pull(kept: _Kept, cotangents: Cotangents, end: State) -> None:
    """Of a window's begin and of all that it depends on, from those of its `end`."""
    scene, begun = kept.scene, cotangents.of[0]
    sheet_body = present_body(scene, kept.mesh, kept.first)
    packed = worked_through(kept.stuck, kept.mesh, scene, sheet_body)
    timing = Timing(kept.time, kept.before, kept.length)
    (pressure, mean), pull_pressure = jax.vjp(lambda pressure: pressures(pressure, timing), scene.pressure)
    number = jnp.arange(STEPS_PER_WINDOW)
    taken = number < kept.count
    landed = jnp.where(kept.count > 0, kept.landed, NEVER)
    held = packed.taken(kept.stuck) | ~packed.exists
    now = _Window(
        scene=scene,
        packed=packed,
        thickness=sheet_body.thickness[packed.element],
        mass=packed.taken(sheet_body.mass),
        compliance=packed.taken(sheet_body.compliance),
        landed=jnp.where(held, -1, packed.taken(landed)),
        pressure=jnp.append(pressure, 0.0),
        kick=kicks(timing),
        length=kept.length,
        count=kept.count,
    )
    replay = _replayed(kept, now)

    # What the pressure does: mean times (volume - volume before), summed.
    work = end.external_work
    after = jnp.where(number == kept.count - 1, end.volume, -work * jnp.append(mean[1:], 0.0))
    volume = jnp.append(jnp.where(taken, work * mean + after, 0.0), 0.0)
    idle, pull_idle = jax.vjp(
        lambda positions: idle_volume(positions, scene, sheet_body, packed, differentiable=True), kept.positions
    )
    volumes = replay.volumes + idle
    gains = jnp.where(taken, work * jnp.diff(volumes, prepend=kept.volume), 0.0)

    nodes, summed, pressing, law = _steps_back(kept, now, replay, cotangents, end, volume)

    put, of = cotangents.put, cotangents.of
    put(begun.positions, packed.put_back(nodes.positions) + pull_idle(jnp.sum(volume))[0])
    put(begun.velocities, packed.put_back(nodes.velocities))
    put(begun.contact_time, packed.put_back(nodes.contact_time))
    put(begun.volume, jnp.where(kept.count > 0, -work * mean[0], end.volume))
    for name in ("external_work", "damping_loss", "contact_loss", "refinement_loss"):
        put(getattr(begun, name), getattr(end, name))
    put(of[1].pressure, pull_pressure((pressing[:-1], gains))[0])
    put(of[1].material, jax.tree.unflatten(jax.tree.structure(scene.material), law))
    put(of[1].solver.damping, None if scene.solver.damping is None else nodes.damping)
    if scene.mold is not None and nodes.vertices is not None:
        put(of[1].mold.vertices, nodes.vertices)
    put(of[2].mass, packed.put_back(nodes.mass))
    # In proportion, since mass alone changes it: the mobility is given.
    square = dot(now.compliance, now.compliance)
    share = jnp.where(square > 0.0, nodes.compliance / jnp.where(square > 0.0, square, 1.0), 0.0)
    put(of[2].compliance, packed.put_back(share * now.compliance))
    if cotangents.want(of[2].thickness):
        none = jnp.zeros_like(sheet_body.thickness)
        put(of[2].thickness, none.at[packed.element].add(summed[0][0] / now.thickness))


def _steps_back(
    kept: _Kept, now: _Window, replay: _Replay, cotangents: Cotangents, end: State, volume: jax.Array
) -> tuple[_Nodes, list[jax.Array], jax.Array, list[jax.Array]]:
    """Cotangents at the window's begin.

    With them the elements' sums, the cotangents of the pressure at every step, and those of the law's parameters.
    """
    scene, packed, elements, of = now.scene, now.packed, now.packed.elements, cotangents.of
    positions, real = packed.taken(kept.positions), now.thickness.dtype
    thickens = cotangents.want(of[2].thickness)
    presses, varies = cotangents.want(of[1].pressure), cotangents.want(of[1].material)
    parameters = jax.tree.leaves(scene.material)
    wanted = [True, thickens, presses, *(varies for _ in parameters)]
    losses = end.damping_loss, end.contact_loss
    vertices = scene.mold.vertices if scene.mold is not None and cotangents.want(of[1].mold.vertices) else None
    nodes = _Nodes(
        at=packed.taken(kept.end),
        positions=jnp.where(packed.exists, packed.taken(end.positions), 0.0),
        velocities=jnp.where(packed.exists, packed.taken(end.velocities), 0.0),
        force=jnp.zeros_like(positions),
        mass=jnp.zeros_like(now.mass),
        compliance=jnp.zeros_like(now.mass),
        contact_time=jnp.where(packed.exists, packed.taken(end.contact_time), 0.0),
        damping=jnp.zeros((), real),
        vertices=None if vertices is None else jnp.zeros_like(vertices),
    )
    steps = jnp.arange(STEPS_PER_WINDOW)
    lands = jnp.append(jnp.any(now.landed[:, None] == steps, axis=0), jnp.asarray(False))
    room = now.thickness.size
    summed = [jnp.zeros((1, room), real)] * thickens
    none, places = jnp.zeros((), real), now.mass.size
    carry = (
        now.count,
        nodes,
        no_corners(positions, elements),
        summed,
        jnp.zeros(STEPS_PER_WINDOW + 1, real),
        [none for _ in parameters] if varies else [],
    )

    def back(carry: tuple[Any, ...]) -> tuple[Any, ...]:
        n, nodes, corners, summed, pressing, law = carry
        load = Load(nodes.at, now.thickness, now.pressure[n], scene.material)
        corners, summed, sums = corner_cotangents(load, elements, wanted, nodes.force, volume[n], corners, summed)
        pressing = pressing.at[n].set(sums.pop(0)) if presses else pressing
        law = [total + more for total, more in zip(law, sums, strict=True)]
        first = n == 0
        step = _Step(n - 1, jnp.where(first, 0.0, now.length), jnp.where(first, 0.0, now.kick[n - 1]))
        before, after = (Part(replay.speeds, k * places, places) for k in (jnp.maximum(n - 1, 0), n))
        nodes = _over_nodes(nodes, corners, (before, after), step, now, losses[0])
        if scene.mold is not None:
            nodes = only_if(lands[n - 1], lambda nodes: _landings(nodes, replay, kept, step, now, losses), nodes)
        return n - 1, nodes, corners, summed, pressing, law

    _, nodes, _, summed, pressing, law = jax.lax.while_loop(lambda carry: carry[0] >= 0, back, carry)
    return nodes, summed, pressing, law or [none for _ in parameters]


differentiable_window = Rule(_value, _plain, _pull, lambda state, *_: state, carries)

"""The reverse derivative of a window's steps, written by hand.

Between its borders a window is a few passes over elements and nodes, and its scheme goes as well backwards: from the
positions and velocities at the end, the forces at these positions give the velocities before. So nothing is kept but
the end; every step back costs one pass over the elements, for the force and the transpose of its derivative together,
and one over the nodes. Nodes that landed are let go in the step they landed in, one by one. Where damping takes too
much of a velocity for it to be found again, the steps are worked out once more from the begin, and their velocities
kept. Found by JAX, the derivative would keep more and work every step out again; forward mode, which keeps nothing, is
left to JAX.
"""

from __future__ import annotations

import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from jaxform.adjoint.backward import BackwardNodes, End, Turn, Window, over_nodes, with_loss
from jaxform.adjoint.landings import back_over_landings
from jaxform.adjoint.moving_rims import at_rim, back_over_rim, ends_of
from jaxform.core.parameters import ranges_of
from jaxform.core.pytree import pytree
from jaxform.dynamics.timestep import LEAST_LEFT
from jaxform.dynamics.window import window, window_and_impacts
from jaxform.kernels.blocks import Part, only_if, over_blocks
from jaxform.kernels.derivatives import Cotangents, Rule
from jaxform.mechanics.corners import Load, corner_forces
from jaxform.mechanics.elements import Corners, assembled, no_corners, shares
from jaxform.mechanics.membrane import dot
from jaxform.mechanics.pullback import corner_cotangents, no_sums, zone_cotangents
from jaxform.model.scene import Scene
from jaxform.model.tables import SHORT_WINDOW
from jaxform.sheet.active_set import idle_volume, packed_moving
from jaxform.sheet.discretization import NEVER, Discretization, Mesh, present_discretization
from jaxform.sheet.rim import rim_places
from jaxform.sheet.scheme import Timing, kicked, kicks, pressures
from jaxform.sheet.state import LOSSES, Schedule, State, carries


@pytree
class _Kept:
    """What the reverse derivative of a window needs.

    Of its begin stuck, time [s], step [s], volume and rim [m^3], and mesh, as in `State`; of its end the positions
    `end` (3, n_node) [m], wall and the steps in which nodes landed (n_node,), its step [s] and how many were taken.

    Attributes:
        positions: Of nodes that landed, before that step (3, n_node) [m].
        velocities: At the end (3, n_node) [m/s]; of nodes that landed, what they landed with. Where steps cannot be
            taken back, both are those of all nodes at the begin.
    """

    scene: Scene
    first: Discretization
    stuck: jax.Array
    time: jax.Array
    before: jax.Array
    volume: jax.Array
    rim: jax.Array | None
    mesh: Mesh | None
    end: jax.Array
    wall: jax.Array
    landed: jax.Array
    length: jax.Array
    count: jax.Array
    positions: jax.Array
    velocities: jax.Array


def _value(
    _: tuple[bool, ...],
    state: State,
    scene: Scene,
    discrete: Discretization,
    first: Discretization,
    schedule: Schedule | None,
) -> tuple[State, _Kept]:
    end, landed, impact = window_and_impacts(state, scene, discrete, schedule)
    positions, velocities, control = end.nodes.positions, end.nodes.velocities, end.control
    if impact is not None:
        positions, velocities = impact[:3], jnp.where(landed < NEVER, impact[3:], velocities)
    damping = scene.solver.damping
    if damping is not None:
        timing = Timing(state.time, state.control.step_length, control.last_length)
        back = _can_be_taken_back(damping, timing, control.last_count)
        positions, velocities = (
            jnp.where(back, late, early)
            for late, early in ((positions, state.nodes.positions), (velocities, state.nodes.velocities))
        )
    kept = _Kept(
        scene=scene,
        first=first,
        stuck=state.nodes.stuck,
        time=state.time,
        before=state.control.step_length,
        volume=state.account.volume,
        rim=state.account.rim,
        mesh=state.mesh,
        end=end.nodes.positions,
        wall=end.nodes.wall,
        landed=landed,
        length=control.last_length,
        count=control.last_count,
        positions=positions,
        velocities=velocities,
    )
    return end, kept


def _can_be_taken_back(damping: jax.Array, timing: Timing, count: jax.Array) -> jax.Array:
    """Whether the steps of a window leave enough of a velocity to find it again: a longer one is as long as they do."""
    half = 0.5 * damping * jnp.maximum(timing.before, timing.length)
    return (count > SHORT_WINDOW) | (1.0 - half > LEAST_LEFT ** (1.0 / SHORT_WINDOW) * (1.0 + half))


@jax.checkpoint
def _plain(state: State, scene: Scene, discrete: Discretization, _: Discretization, schedule: Schedule | None) -> State:
    return window(state, scene, discrete, schedule)


def _end_of(kept: _Kept, now: Window) -> End:
    """Where steps cannot be taken back, they are worked out once more."""
    packed, elements, damping = now.packed, now.packed.elements, now.scene.solver.damping
    begin, end = packed.taken(kept.positions), packed.taken(kept.end)
    velocities = jnp.where(packed.exists, packed.taken(kept.velocities), 0.0)
    if damping is None:
        return End(begin, velocities)
    keeps = ~_can_be_taken_back(damping, Timing(kept.time, kept.before, kept.length), kept.count)
    places, count = now.mass.size, jnp.where(keeps, now.count, 0)

    def advance(carry: tuple[Any, ...]) -> tuple[Any, ...]:
        n, positions, velocities, before, speeds, corners = carry
        load = Load(positions, now.thickness, now.pressure[n], now.material)
        corners, _ = corner_forces(load, elements, corners)

        def work(old: Any, own: Any, landed: Any, mass: Any, compliance: Any, end: Any) -> Any:
            positions, velocities, before = old
            nodal = assembled(corners, own)
            new, _ = kicked(nodal, velocities, (landed < n, mass, compliance), now.kick[n], damping)
            new = [jnp.where(landed < n, old, v) for old, v in zip(velocities, new, strict=True)]
            before = [jnp.where(landed == n, x, at) for x, at in zip(positions, before, strict=True)]
            ways = zip(positions, new, end, strict=True)
            moved = [jnp.where(landed <= n, to, x + now.length * v) for x, v, to in ways]
            return [moved, new, before, new], []

        inputs = shares(elements), now.landed, now.mass, now.compliance, end
        into = [positions, velocities, before, Part(speeds, (n + 1) * places, places)]
        new, _ = over_blocks(work, elements.node_block_count, inputs, into, update=3)
        return n + 1, *new, corners

    speeds = jnp.zeros((3, (SHORT_WINDOW + 1) * places), begin.dtype).at[:, :places].set(velocities)
    carry = jnp.int32(0), begin, velocities, begin, speeds, no_corners(begin, elements)
    carry = jax.lax.while_loop(lambda carry: carry[0] < count, advance, carry)
    return End(carry[3], carry[2], carry[4], keeps)


def _pull(kept: _Kept, cotangents: Cotangents, end: State) -> None:
    """Of a window's begin and of all that it depends on, from those of its `end`."""
    scene, begun = kept.scene, cotangents.of[0]
    discrete = present_discretization(scene, kept.mesh, kept.first)
    packed = packed_moving(kept.stuck, kept.mesh, scene, discrete)
    timing, longest = Timing(kept.time, kept.before, kept.length), scene.tables.window_room
    (pressure, mean), pull_pressure = jax.vjp(lambda pressure: pressures(pressure, timing, longest), scene.pressure)
    number = jnp.arange(longest)
    taken = number < kept.count
    held = packed.taken(kept.stuck) | ~packed.exists
    own = discrete.of_elements(packed.element)
    now = Window(
        scene=scene,
        packed=packed,
        thickness=own.thickness,
        material=scene.material.with_zones(own.zones),
        mass=packed.taken(discrete.mass),
        compliance=packed.taken(discrete.compliance),
        landed=jnp.where(held, -1, packed.taken(kept.landed)),
        pressure=jnp.append(pressure, 0.0),
        kick=jnp.append(jnp.where(taken, kicks(timing, longest), 0.0), 0.0),
        length=kept.length,
        count=kept.count,
    )

    # What the pressure does: mean times what is swept, (volume - volume before) and what the rim adds; summed.
    work = end.account.external_work
    after = jnp.where(number == kept.count - 1, end.account.volume, -work * jnp.append(mean[1:], 0.0))
    volume = jnp.append(jnp.where(taken, work * mean + after, 0.0), 0.0)
    idle, pull_idle = jax.vjp(lambda positions: idle_volume(positions, scene, discrete, packed), kept.end)
    back = _steps_back(kept, now, cotangents, end, volume, mean)
    nodes, gains = back.nodes, jnp.diff(back.volumes[:-1] + idle, prepend=kept.volume)
    if back.rim is not None and kept.rim is not None:
        gains += back.rim[:-1].at[0].set(kept.rim)
    gains = jnp.where(taken, work * gains, 0.0)

    put, of = cotangents.put, cotangents.of
    put(begun.nodes.positions, packed.put_back(nodes.positions) + pull_idle(jnp.sum(volume))[0])
    put(begun.nodes.velocities, packed.put_back(nodes.velocities))
    put(begun.nodes.contact_time, packed.put_back(nodes.contact_time))
    put(begun.account.volume, jnp.where(kept.count > 0, -work * mean[0], end.account.volume))
    if end.account.rim is not None:
        put(begun.account.rim, jnp.where(kept.count > 0, work * mean[0], end.account.rim))
    for name in ("external_work", *LOSSES):
        put(getattr(begun.account, name), getattr(end.account, name))
    put(of[1].pressure, pull_pressure((back.pressing[:-1], gains))[0])
    for name, value in back.law.items():
        put(getattr(of[1].material, name), value)
    put(of[1].solver.damping, None if scene.solver.damping is None else nodes.damping)
    if scene.mold is not None and nodes.vertices is not None:
        put(of[1].mold.vertices, nodes.vertices)
    put(of[2].mass, packed.put_back(nodes.mass))
    # In proportion, since mass alone changes it: the mobility is given.
    square = dot(now.compliance, now.compliance)
    share = jnp.where(square > 0.0, nodes.compliance / jnp.where(square > 0.0, square, 1.0), 0.0)
    put(of[2].compliance, packed.put_back(share[None] * now.compliance))
    element = packed.element
    if cotangents.want(of[2].thickness):
        put(of[2].thickness, _spread(back.summed[0][0] / now.thickness, element, discrete.thickness))
    for name, values in back.zones.items():
        put(of[2].zones[name], _spread(values, element, discrete.zones[name]))


def _spread(values: jax.Array, element: jax.Array, like: jax.Array) -> jax.Array:
    """Sums (..., n_element) of values (..., room) of elements with these numbers."""
    return jnp.zeros_like(like).at[..., element].add(values)


class _Back(NamedTuple):
    """On the way back: the next step, the nodes, and room for corner forces.

    With them the elements' sums; at every step, and after the last, the cotangents of the pressure, and the volume
    enclosed by what is active [m^3]; the cotangents of the law's numbers that do not vary, and in the end of those that
    do (..., room), by name.
    """

    number: jax.Array
    nodes: BackwardNodes
    corners: Corners
    summed: list[jax.Array]
    pressing: jax.Array
    volumes: jax.Array
    law: dict[str, jax.Array]
    zones: dict[str, jax.Array]
    rim: jax.Array | None


def _rim_cotangents(kept: _Kept, end: State, mean: jax.Array) -> jax.Array | None:
    """Of what moving rims sweep in the step before each (steps + 1,), and in the last one; None without such."""
    if end.account.rim is None:
        return None
    number, work = jnp.arange(len(mean) + 1), end.account.external_work * jnp.append(mean, 0.0)
    found = jnp.where(number < kept.count, work, jnp.where(number == kept.count, end.account.rim, 0.0))
    # What was swept before the window's first step is given.
    return found.at[0].set(0.0)


def _steps_back(
    kept: _Kept, now: Window, cotangents: Cotangents, end: State, volume: jax.Array, mean: jax.Array
) -> _Back:
    """To the window's begin, with the cotangents of the volume at every step."""
    scene, packed, elements, of = now.scene, now.packed, now.packed.elements, cotangents.of
    start, positions, real = _end_of(kept, now), packed.taken(kept.end), now.thickness.dtype
    loss = end.account
    rim, places = _rim_cotangents(kept, end, mean), rim_places(scene, kept.mesh, packed)
    thickens = cotangents.want(of[2].thickness)
    presses, zones = cotangents.want(of[1].pressure), now.material.zones
    numbers = {name: getattr(scene.material, name) for name in ranges_of(scene.material)}
    single = [name for name in numbers if name not in zones]
    varies = any(cotangents.want(getattr(of[1].material, name)) for name in single)
    wanted = [True, thickens, presses]
    wanted += [cotangents.want(of[2].zones[name]) if name in zones else varies for name in numbers]
    first = Load(positions, now.thickness, now.pressure[0], now.material)
    mold = scene.mold
    vertices = mold.vertices if mold is not None and cotangents.want(of[1].mold.vertices) else None
    at_every_step = jnp.zeros(scene.tables.window_room + 1, real)
    landed = jnp.where(now.landed < 0, NEVER, now.landed)
    lands = jnp.zeros(at_every_step.size, bool).at[landed].set(True, mode="drop")
    last = _Back(
        number=now.count,
        nodes=BackwardNodes(
            at=positions,
            speeds=start.velocities,
            positions=jnp.where(packed.exists, packed.taken(end.nodes.positions), 0.0),
            velocities=jnp.where(packed.exists, packed.taken(end.nodes.velocities), 0.0),
            force=jnp.zeros_like(positions),
            mass=jnp.zeros_like(now.mass),
            compliance=jnp.zeros_like(now.mass),
            contact_time=jnp.where(packed.exists, packed.taken(end.nodes.contact_time), 0.0),
            damping=jnp.zeros((), real),
            vertices=None if vertices is None else jnp.zeros_like(vertices),
        ),
        corners=no_corners(positions, elements) + no_corners(positions, elements),
        summed=no_sums(first, wanted),
        pressing=at_every_step,
        volumes=at_every_step,
        law={name: jnp.zeros_like(numbers[name]) for name in single},
        zones={},
        rim=None if rim is None else at_every_step,
    )

    def back(carry: _Back) -> _Back:
        n, nodes, corners = carry.number, carry.nodes, carry.corners
        first = n == 0
        turn = Turn(
            n - 1, jnp.where(first, 0.0, now.length), jnp.where(first, 0.0, now.kick[n - 1]), later_kick=now.kick[n]
        )
        load = Load(nodes.at, now.thickness, now.pressure[n], now.material)
        damping = scene.solver.damping
        if damping is not None:
            nodes, corners = only_if(
                loss.damping_loss != 0.0,
                lambda both: with_loss(*both, load, turn, damping, now, start, loss.damping_loss),
                (nodes, corners),
            )
        corners, summed, sums = corner_cotangents(
            load, elements, wanted, nodes.force, volume[n], corners, carry.summed, forces=True
        )
        enclosed = sums.pop()
        pressing = carry.pressing.at[n].set(sums.pop(0)) if presses else carry.pressing
        law = carry.law
        if varies:
            law = {name: carry.law[name] + more for name, more in zip(single, sums, strict=True)}
        after = None if places is None else ends_of(nodes, places)
        nodes = over_nodes(nodes, corners, turn, now, start, loss.damping_loss)
        early, swept = None, carry.rim
        if rim is not None and places is not None and after is not None and swept is not None:
            nodes, early, own = back_over_rim(nodes, start.before, after, turn, places, now, rim[n])
            swept = swept.at[n].set(own)
        if mold is not None:
            back_over = functools.partial(back_over_landings, mold=mold, now=now, loss=loss.contact_loss)
            nodes = only_if(
                lands[n - 1],
                lambda nodes: back_over(nodes, start.before, turn, (packed.taken(kept.wall), kept.time)),
                nodes,
            )
        if early is not None and places is not None:
            nodes = at_rim(nodes, early, places)
        volumes = carry.volumes.at[n].set(enclosed)
        return _Back(n - 1, nodes, corners, summed, pressing, volumes, law, {}, swept)

    done = jax.lax.while_loop(lambda carry: carry.number >= 0, back, last)
    return done._replace(zones=zone_cotangents(first, wanted, done.summed))


differentiable_window = Rule(_value, _plain, _pull, lambda state, *_: state, carries, lasting=True)

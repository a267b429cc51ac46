"""The reverse derivative of a window's steps, written by hand.

The central-difference scheme can be inverted: from the positions and velocities at a window's end, the forces at these
positions give the velocities before. So only the end is stored. Every reverse step costs one pass over the elements,
for the force and the transpose of its derivative together, and one over the nodes; nodes that landed are released in
the step of their landing. Where damping is too strong to recover a velocity, the steps are recomputed from the begin
and their velocities stored. JAX's own derivative would store more and recompute every step; forward mode, which stores
nothing, is left to JAX.
"""

from __future__ import annotations

import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from jaxform.adjoint.backward import (
    BackwardNodes,
    ReverseWindow,
    add_impact_cotangents,
    add_loss_cotangents,
    add_rim_cotangents,
    add_weight_cotangents,
    displace_landed_nodes,
    pull_back_landings,
    pull_back_rim,
    rim_end_positions,
    split_point_cotangents,
    step_nodes_back,
)
from jaxform.core.pytree import parameter_ranges, pytree
from jaxform.dynamics.timestep import LEAST_LEFT
from jaxform.dynamics.window import window, window_and_impacts
from jaxform.kernels.blocks import ArraySlice, lax_cond_once, over_blocks
from jaxform.kernels.derivatives import Cotangents, DerivativeRule
from jaxform.mechanics.corners import Load, corner_forces
from jaxform.mechanics.elements import Corners, allocate_corner_forces, gather_shares, gather_table
from jaxform.mechanics.force import corner_cotangents, zero_sums, zone_cotangents
from jaxform.mechanics.membrane import dot
from jaxform.model.scene import Scene
from jaxform.model.tables import SHORT_WINDOW
from jaxform.sheet.active_set import inactive_volume, pack_moving
from jaxform.sheet.discretization import NEVER, Discretization, RefinedMesh, present_discretization
from jaxform.sheet.energy_balance import rim_places
from jaxform.sheet.scheme import (
    WindowTiming,
    add_gravity,
    pressures,
    unresolved_share,
    update_velocity,
    velocity_steps,
)
from jaxform.sheet.state import LOSSES, Schedule, State, differentiable_leaves, immobile_nodes


@pytree
class _WindowResiduals:
    """Residuals for the reverse derivative of a window.

    Attributes:
        scene: The scene.
        first: Discretization at the run's begin.
        stuck: Nodes that are stuck at the window's begin (n_node,).
        immobile: Nodes that never move again from the window's begin on (n_node,), where a clamp opens; None otherwise.
        time: Time at the window's begin [s].
        before: Step length of the window before [s].
        volume: Enclosed volume at the window's begin, as in `EnergyBalance` [m^3].
        rim: Volume swept by moving rims, as in `EnergyBalance` [m^3]; None without moving rims.
        mesh: Mesh of the window; None without refinement.
        end: Positions at the window's end (3, n_node) [m].
        wall: Contact triangles at the window's end (n_node,), as in `Nodes`.
        landing_step: Step in which each node landed (n_node,); NEVER for the others.
        length: Step length [s].
        count: Steps taken.
        positions: Positions of nodes that landed, before that step (3, n_node) [m].
        velocities: Velocities at the end (3, n_node) [m/s]; of nodes that landed, those before the impact. Where
            damping makes the steps irreversible, both are those of all nodes at the window's begin.
        curved: `ContactStep.curve` of nodes that land on curved paths, and their position after the landing's step
            (6, n_node) [m]; None otherwise.
    """

    scene: Scene
    first: Discretization
    stuck: jax.Array
    immobile: jax.Array | None
    time: jax.Array
    before: jax.Array
    volume: jax.Array
    rim: jax.Array | None
    mesh: RefinedMesh | None
    end: jax.Array
    wall: jax.Array
    landing_step: jax.Array
    length: jax.Array
    count: jax.Array
    positions: jax.Array
    velocities: jax.Array
    curved: jax.Array | None


def _simulate_window(
    _: tuple[bool, ...],
    state: State,
    scene: Scene,
    discrete: Discretization,
    first: Discretization,
    schedule: Schedule | None,
) -> tuple[State, _WindowResiduals]:
    end, landed, impact = window_and_impacts(state, scene, discrete, schedule)
    positions, velocities, control = end.nodes.positions, end.nodes.velocities, end.control
    if impact is not None:
        positions, velocities = impact[:3], jnp.where(landed < NEVER, impact[3:6], velocities)
    damping = scene.solver.damping
    if damping is not None:
        timing = state.time, state.control.step_length, control.last_length
        back = _is_reversible(damping, timing, control.last_count)
        positions, velocities = (
            jnp.where(back, late, early)
            for late, early in ((positions, state.nodes.positions), (velocities, state.nodes.velocities))
        )
    kept = _WindowResiduals(
        scene=scene,
        first=first,
        stuck=state.nodes.stuck,
        immobile=None if scene.parison.clamp_until is None else immobile_nodes(state, scene),
        time=state.time,
        before=state.control.step_length,
        volume=state.account.volume,
        rim=state.account.rim,
        mesh=state.mesh,
        end=end.nodes.positions,
        wall=end.nodes.wall,
        landing_step=landed,
        length=control.last_length,
        count=control.last_count,
        positions=positions,
        velocities=velocities,
        curved=impact[6:] if impact is not None and scene.lands_smoothly else None,
    )
    return end, kept


def _is_reversible(damping: jax.Array, timing: WindowTiming, count: jax.Array) -> jax.Array:
    """True where damping leaves enough of a velocity to invert the steps; longer windows are limited to that."""
    _, before, length = timing
    half = 0.5 * damping * jnp.maximum(before, length)
    return (count > SHORT_WINDOW) | (1.0 - half > LEAST_LEFT ** (1.0 / SHORT_WINDOW) * (1.0 + half))


@jax.checkpoint
def _recompute_window(
    state: State, scene: Scene, discrete: Discretization, _: Discretization, schedule: Schedule | None
) -> State:
    return window(state, scene, discrete, schedule)


def _begin_reverse_steps(kept: _WindowResiduals, now: ReverseWindow) -> tuple[ReverseWindow, jax.Array]:
    """The window with stored velocities, if its steps cannot be inverted, and velocities (3, place) [m/s] after them.

    Steps that cannot be inverted are recomputed from the window's begin. The velocities of nodes that landed are those
    before the impact.
    """
    packed, elements, damping = now.packed, now.packed.elements, now.scene.solver.damping
    begin, end = now.before, packed.pack(kept.end)
    velocities = jnp.where(packed.exists, packed.pack(kept.velocities), 0.0)
    if damping is None:
        return now, velocities
    beyond = None if now.curved is None else now.curved[3:]
    keeps = ~_is_reversible(damping, (kept.time, kept.before, kept.length), kept.count)
    places, count = now.mass.size, jnp.where(keeps, now.count, 0)

    def advance(carry: tuple[Any, ...]) -> tuple[Any, ...]:
        n, positions, velocities, before, speeds, corners = carry
        load = Load(positions, now.thickness, now.pressure[n], now.material)
        corners, _ = corner_forces(load, elements, corners)

        def compute_block(old: Any, own: Any, landed: Any, mass: Any, compliance: Any, end: Any, beyond: Any) -> Any:
            positions, velocities, before = old
            nodal = add_gravity(gather_shares(corners, own), mass, now.scene.solver.gravity)
            new, _ = update_velocity(nodal, velocities, (landed < n, mass, compliance), now.velocity_step[n], damping)
            new = [jnp.where(landed < n, old, v) for old, v in zip(velocities, new, strict=True)]
            before = [jnp.where(landed == n, x, at) for x, at in zip(positions, before, strict=True)]
            if beyond is not None:
                end = [jnp.where(landed == n, far, to) for far, to in zip(beyond, end, strict=True)]
            ways = zip(positions, new, end, strict=True)
            moved = [jnp.where(landed <= n, to, x + now.length * v) for x, v, to in ways]
            return [moved, new, before, new], []

        inputs = gather_table(elements), now.landing_step, now.mass, now.compliance, end, beyond
        into = [positions, velocities, before, ArraySlice(speeds, (n + 1) * places, places)]
        new, _ = over_blocks(compute_block, elements.node_block_count, inputs, into, update=3)
        return n + 1, *new, corners

    speeds = jnp.zeros((3, (SHORT_WINDOW + 1) * places), begin.dtype).at[:, :places].set(velocities)
    carry = jnp.int32(0), begin, velocities, begin, speeds, allocate_corner_forces(begin, elements)
    carry = jax.lax.while_loop(lambda carry: carry[0] < count, advance, carry)
    return now._replace(before=carry[3], stored=carry[4], keeps=keeps), carry[2]


def _pull_back_window(kept: _WindowResiduals, cotangents: Cotangents, end: State) -> None:
    """Cotangents of a window's begin and its other arguments, from those of its `end`."""
    scene, begun = kept.scene, cotangents.of[0]
    discrete = present_discretization(scene, kept.mesh, kept.first)
    packed = pack_moving(kept.stuck if kept.immobile is None else kept.immobile, kept.mesh, scene, discrete)
    timing, longest = (kept.time, kept.before, kept.length), scene.tables.step_capacity
    (pressure, mean), pull_pressure = jax.vjp(lambda pressure: pressures(pressure, timing, longest), scene.pressure)
    number = jnp.arange(longest)
    taken = number < kept.count
    held = packed.pack(kept.stuck) | ~packed.exists
    thickness, zones, _ = discrete.of_elements(packed.element)
    now = ReverseWindow(
        scene=scene,
        packed=packed,
        thickness=thickness,
        material=scene.material.with_zones(zones),
        mass=packed.pack(discrete.mass),
        compliance=packed.pack(discrete.compliance),
        landing_step=jnp.where(held, -1, packed.pack(kept.landing_step)),
        pressure=jnp.append(pressure, 0.0),
        velocity_step=jnp.append(jnp.where(taken, velocity_steps(timing, longest), 0.0), 0.0),
        length=kept.length,
        count=kept.count,
        before=packed.pack(kept.positions),
        curved=None if kept.curved is None else packed.pack(kept.curved),
    )

    # The pressure's work is the sum of mean pressure times swept volume: the change of the volume, and the rim's part.
    work = end.account.external_work
    after = jnp.where(number == kept.count - 1, end.account.volume, -work * jnp.append(mean[1:], 0.0))
    volume = jnp.append(jnp.where(taken, work * mean + after, 0.0), 0.0)
    inactive, pull_inactive = jax.vjp(lambda positions: inactive_volume(positions, scene, discrete, packed), kept.end)
    gravity, fall, weight = scene.solver.gravity, end.account.gravity_work, None
    if gravity is not None and fall is not None:
        # Gravity's work is force times displacement in the window: the force at its end, less that at its begin.
        weight = fall * discrete.mass * gravity[:, None]
        end = end.replace_nodes(positions=end.nodes.positions + weight)
    back = _reverse_steps(kept, now, cotangents, end, volume, mean)
    nodes, gains = back.nodes, jnp.diff(back.volumes[:-1] + inactive, prepend=kept.volume)
    if back.rim is not None and kept.rim is not None:
        gains += back.rim[:-1].at[0].set(kept.rim)
    gains = jnp.where(taken, work * gains, 0.0)

    put, of = cotangents.put, cotangents.of
    positions, mass = packed.unpack(nodes.positions) + pull_inactive(jnp.sum(volume))[0], packed.unpack(nodes.mass)
    if gravity is not None and fall is not None and weight is not None and nodes.gravity is not None:
        displacement = kept.end - packed.unpack(nodes.at)
        positions, mass = positions - weight, mass + fall * (gravity @ displacement)
        put(of[1].solver.gravity, nodes.gravity + fall * jnp.sum(discrete.mass * displacement, axis=1))
        put(begun.account.gravity_work, fall)
    put(begun.nodes.positions, positions)
    put(begun.nodes.velocities, packed.unpack(nodes.velocities))
    put(begun.nodes.contact_time, packed.unpack(nodes.contact_time))
    put(begun.account.volume, jnp.where(kept.count > 0, -work * mean[0], end.account.volume))
    if end.account.rim is not None:
        put(begun.account.rim, jnp.where(kept.count > 0, work * mean[0], end.account.rim))
    for name in ("pre_stretch_work", "unresolved"):
        if (passed := getattr(end.account, name)) is not None:
            put(getattr(begun.account, name), passed)
    for name in ("external_work", *LOSSES):
        put(getattr(begun.account, name), getattr(end.account, name))
    put(of[1].pressure, pull_pressure((back.pressing[:-1], gains))[0])
    for name, value in back.law.items():
        put(getattr(of[1].material, name), value)
    put(of[1].solver.damping, None if scene.solver.damping is None else nodes.damping)
    if scene.mold is not None and nodes.vertices is not None:
        put(of[1].mold.vertices, nodes.vertices)
    put(of[2].mass, mass)
    # All components change in proportion: the mobility is given, so only the mass varies.
    square = dot(now.compliance, now.compliance)
    share = jnp.where(square > 0.0, nodes.compliance / jnp.where(square > 0.0, square, 1.0), 0.0)
    put(of[2].compliance, packed.unpack(share[None] * now.compliance))
    element = packed.element
    if cotangents.want(of[2].thickness):
        put(of[2].thickness, _scatter_sums(back.summed[0][0] / now.thickness, element, discrete.thickness))
    for name, values in back.zones.items():
        put(of[2].zones[name], _scatter_sums(values, element, discrete.zones[name]))


def _scatter_sums(values: jax.Array, element: jax.Array, like: jax.Array) -> jax.Array:
    """Sums (..., n_element) of values (..., capacity) of elements with these numbers."""
    return jnp.zeros_like(like).at[..., element].add(values)


class _ReverseState(NamedTuple):
    """State of the loop of reverse steps.

    Attributes:
        number: Number of the next step to reverse.
        nodes: Nodes and their cotangents.
        corners: Workspace for corner forces and their cotangents.
        summed: Sums of the elements over steps.
        pressing: Cotangents of the pressure at each step and after the last (steps + 1,).
        volumes: Volume enclosed by the active elements, at the same steps [m^3].
        law: Cotangents of the material parameters that do not vary over the sheet, by name.
        zones: Cotangents of those that vary (..., capacity), by name; empty before the last step.
        rim: Volume swept by the rim in each step [m^3]; None without moving rims.
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


def _rim_cotangents(kept: _WindowResiduals, end: State, mean: jax.Array) -> jax.Array | None:
    """Cotangents of the rim's swept volume before each step (steps + 1,) and in the last; None without rims."""
    if end.account.rim is None:
        return None
    number, work = jnp.arange(len(mean) + 1), end.account.external_work * jnp.append(mean, 0.0)
    found = jnp.where(number < kept.count, work, jnp.where(number == kept.count, end.account.rim, 0.0))
    # The volume swept before the window's first step is given.
    return found.at[0].set(0.0)


def _reverse_steps(
    kept: _WindowResiduals, now: ReverseWindow, cotangents: Cotangents, end: State, volume: jax.Array, mean: jax.Array
) -> _ReverseState:
    """The state after all reverse steps, at the window's begin; `volume` has the cotangents of the volumes."""
    scene, packed, elements, of = now.scene, now.packed, now.packed.elements, cotangents.of
    now, velocities = _begin_reverse_steps(kept, now)
    positions, real = packed.pack(kept.end), now.thickness.dtype
    loss = end.account
    lost, missed = loss.damping_loss, jnp.zeros((), real) if loss.unresolved is None else loss.unresolved
    rim, places = _rim_cotangents(kept, end, mean), rim_places(scene, kept.mesh, packed)
    thickens = cotangents.want(of[2].thickness)
    presses, zones = cotangents.want(of[1].pressure), now.material.zones
    numbers = {name: getattr(scene.material, name) for name in parameter_ranges(scene.material)}
    single = [name for name in numbers if name not in zones]
    varies = any(cotangents.want(getattr(of[1].material, name)) for name in single)
    wanted = [True, thickens, presses]
    wanted += [cotangents.want(of[2].zones[name]) if name in zones else varies for name in numbers]
    first = Load(positions, now.thickness, now.pressure[0], now.material)
    mold = scene.mold
    vertices = mold.vertices if mold is not None and cotangents.want(of[1].mold.vertices) else None
    at_every_step = jnp.zeros(scene.tables.step_capacity + 1, real)
    landed = jnp.where(now.landing_step < 0, NEVER, now.landing_step)
    lands = jnp.zeros(at_every_step.size, bool).at[landed].set(True, mode="drop")
    last = _ReverseState(
        number=now.count,
        nodes=BackwardNodes(
            at=positions,
            speeds=velocities,
            positions=jnp.where(packed.exists, packed.pack(end.nodes.positions), 0.0),
            velocities=jnp.where(packed.exists, packed.pack(end.nodes.velocities), 0.0),
            force=jnp.zeros_like(positions),
            mass=jnp.zeros_like(now.mass),
            compliance=jnp.zeros_like(now.mass),
            contact_time=jnp.where(packed.exists, packed.pack(end.nodes.contact_time), 0.0),
            damping=jnp.zeros((), real),
            gravity=None if scene.solver.gravity is None else jnp.zeros(3, real),
            vertices=None if vertices is None else jnp.zeros_like(vertices),
            point=None if now.curved is None else jnp.zeros_like(positions),
        ),
        corners=allocate_corner_forces(positions, elements) + allocate_corner_forces(positions, elements),
        summed=zero_sums(first, wanted),
        pressing=at_every_step,
        volumes=at_every_step,
        law={name: jnp.zeros_like(numbers[name]) for name in single},
        zones={},
        rim=None if rim is None else at_every_step,
    )

    def reverse_step(carry: _ReverseState) -> _ReverseState:
        n, nodes, corners = carry.number, carry.nodes, carry.corners
        first = n == 0
        step = (
            n - 1,
            jnp.where(first, 0.0, now.length),
            jnp.where(first, 0.0, now.velocity_step[n - 1]),
            now.velocity_step[n],
        )
        load = Load(nodes.at, now.thickness, now.pressure[n], now.material)
        if unresolved_share(scene) is not None:
            nodes, corners = lax_cond_once(
                (lost != 0.0) | ((missed != 0.0) & (now.velocity_step[n] != now.length)),
                lambda both: add_loss_cotangents(*both, load, step, now, (lost, missed)),
                (nodes, corners),
            )
        if mold is not None:
            add = functools.partial(
                add_impact_cotangents,
                load=load,
                step=step,
                wall=packed.pack(kept.wall),
                mold=mold,
                window=now,
                loss=loss.contact_loss,
            )
            struck = (loss.contact_loss != 0.0) & lands[n]
            nodes, corners = lax_cond_once(struck, lambda both: add(*both), (nodes, corners))
        nodes = add_weight_cotangents(nodes, now)
        corners, summed, sums = corner_cotangents(
            load, elements, wanted, nodes.force, volume[n], corners, carry.summed, forces=True
        )
        enclosed = sums.pop()
        pressing = carry.pressing.at[n].set(sums.pop(0)) if presses else carry.pressing
        law = carry.law
        if varies:
            law = {name: carry.law[name] + more for name, more in zip(single, sums, strict=True)}
        after = None if places is None else rim_end_positions(nodes, places)
        nodes = step_nodes_back(nodes, corners, step, now, (lost, missed))
        if now.curved is not None:
            displace = functools.partial(displace_landed_nodes, step=step, window=now)
            nodes = lax_cond_once(lands[n - 2], displace, nodes)
        early, swept = None, carry.rim
        if rim is not None and places is not None and after is not None and swept is not None:
            nodes, early, own = pull_back_rim(nodes, after, step, places, now, rim[n])
            swept = swept.at[n].set(own)
        if now.curved is not None:
            keep = functools.partial(split_point_cotangents, step=step, window=now)
            nodes = lax_cond_once(lands[n - 2], keep, nodes)
        if mold is not None:
            back_over = functools.partial(pull_back_landings, mold=mold, window=now, loss=loss.contact_loss)
            nodes = lax_cond_once(
                lands[n - 1],
                lambda nodes: back_over(nodes, step, (packed.pack(kept.wall), kept.time)),
                nodes,
            )
        if early is not None and places is not None:
            nodes = add_rim_cotangents(nodes, early, places)
        volumes = carry.volumes.at[n].set(enclosed)
        return _ReverseState(n - 1, nodes, corners, summed, pressing, volumes, law, {}, swept)

    done = jax.lax.while_loop(lambda carry: carry.number >= 0, reverse_step, last)
    return done._replace(zones=zone_cotangents(first, wanted, done.summed))


differentiable_window = DerivativeRule(
    _simulate_window, _recompute_window, _pull_back_window, lambda state, *_: state, differentiable_leaves, lasting=True
)

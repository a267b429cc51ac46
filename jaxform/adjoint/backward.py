"""One step of the reversed scheme, from the state after it to the state before: nodes, contact, moving rims."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from jaxform.contact import sticking
from jaxform.kernels import blocks
from jaxform.kernels.blocks import ArraySlice, compact_indices, materialize, over_blocks
from jaxform.materials import Law
from jaxform.mechanics.corners import Load, corner_forces
from jaxform.mechanics.elements import Corners, Nodes, gather_shares, gather_table
from jaxform.mechanics.membrane import Vector, dot, unstack_rows, vector
from jaxform.model.scene import Scene
from jaxform.sheet.energy_balance import rim_ends, rim_swept_volume
from jaxform.sheet.packing import Packed
from jaxform.sheet.scheme import add_gravity, unresolved_factor, unresolved_share
from jaxform.tools.mold import Mold
from jaxform.tools.surface_walk import ContactSurface


class ReverseWindow(NamedTuple):
    """Constants of a window for its reverse steps, in packed order.

    Attributes:
        scene: The scene.
        packed: Elements and nodes in packed order.
        thickness: Initial thickness of the elements (capacity,) [m].
        material: Material model, whose varying parameters have a value for each element.
        mass: Lumped mass of the nodes (place,) [kg].
        compliance: Mobility over mass (3, place) [1/kg].
        landing_step: Step in which each node landed (place,); NEVER for the others, -1 for nodes stuck before.
        pressure: Pressure in each step (steps + 1,) [Pa]; 0 beyond the last.
        velocity_step: Time step of each velocity update (steps + 1,) [s]; 0 beyond the last.
        length: Step length [s].
        count: Steps taken.
        before: Positions of nodes that landed, before that step (3, place) [m].
        stored: Stored velocities before each step and after the last (3, (1 + steps) place) [m/s], one step's after
            another's; None without damping, whose steps are always inverted.
        keeps: True where these are used, because the steps cannot be inverted.
        curved: `ContactStep.curve` of nodes that land on curved paths, and their position after the landing's step
            (6, place) [m]; None otherwise.
    """

    scene: Scene
    packed: Packed
    thickness: jax.Array
    material: Law
    mass: jax.Array
    compliance: jax.Array
    landing_step: jax.Array
    pressure: jax.Array
    velocity_step: jax.Array
    length: jax.Array
    count: jax.Array
    before: jax.Array
    stored: jax.Array | None = None
    keeps: jax.Array | bool = False
    curved: jax.Array | None = None

    def stored_velocities(self, number: jax.Array) -> ArraySlice | None:
        """Stored velocities before a step; where they are not used, always the same part of the array: that is fast."""
        if self.stored is None:
            return None
        places = self.mass.size
        return ArraySlice(self.stored, jnp.where(self.keeps, number, 0) * places, places)


class BackwardNodes(NamedTuple):
    """Nodes between two reverse steps, their cotangents, and the sums over steps so far.

    Attributes:
        at: Positions (3, place) [m].
        speeds: Velocities after the step that begins at these positions (3, place) [m/s].
        positions: Cotangents of the positions (3, place), without the contribution of the force at them.
        velocities: Cotangents of the velocities after the step (3, place), with the contribution of the positions.
        force: Cotangents of the force in the step (3, place).
        mass, compliance, contact_time: Cotangents of mass, logarithm of compliance, and contact time (place,).
        damping, gravity, vertices: Cotangents of damping, gravity (3,), and the mold's vertices (n_vertex, 3).
        point: Cotangents of the landing points to which nodes returned in the step after their landing (3, place);
            None where nodes do not land on curved paths.
    """

    at: jax.Array
    speeds: jax.Array
    positions: jax.Array
    velocities: jax.Array
    force: jax.Array
    mass: jax.Array
    compliance: jax.Array
    contact_time: jax.Array
    damping: jax.Array
    gravity: jax.Array | None
    vertices: jax.Array | None
    point: jax.Array | None = None


AdjointStep = tuple[jax.Array, jax.Array, jax.Array, jax.Array]
"""The data of a reverse step, which leads from the begin of a step to that of the step before.

Number of the earlier step, its length, its velocity step and that of the later one [s]; before the first step of a
window the length is 0.
"""


def _half_damping(velocity_step: jax.Array, damping: jax.Array | None) -> jax.Array | float:
    return 0.0 if damping is None else 0.5 * velocity_step * damping


def _velocities_before(
    nodal: Sequence[jax.Array],
    after: Any,
    speeds: Any,
    node: tuple[jax.Array, Any],
    velocity_step: jax.Array,
    window: ReverseWindow,
) -> Vector:
    """Velocities before a step, three times (n,), by inverting its velocity update; or the stored ones.

    Args:
        nodal: Nodal forces of the step [N].
        after: Velocities after the step [m/s].
        speeds: Stored velocities before the step [m/s]; None where none are stored.
        node: True where nodes are free in the step, and their compliance [1/kg].
        velocity_step: Time step of the velocity update [s].
        window: Constants of the window.
    """
    flies, compliance = node
    half = _half_damping(velocity_step, window.scene.solver.damping)
    rest = 1.0 / (1.0 - half)

    def invert_update(v: jax.Array, f: jax.Array, c: jax.Array) -> jax.Array:
        before = ((1.0 + half) * v - velocity_step * (f * c)) * rest
        return jnp.where(flies, before, v)

    found = [invert_update(*each) for each in zip(after, nodal, compliance, strict=True)]
    if speeds is not None:
        found = [jnp.where(window.keeps, old, v) for old, v in zip(speeds, found, strict=True)]
    return vector(found)


def force_cotangent(
    velocities: Any, compliance: Any, velocity_step: jax.Array, window: ReverseWindow
) -> list[jax.Array]:
    """Cotangents of the force in a step, from those of the velocities after it."""
    factor = velocity_step / (1.0 + _half_damping(velocity_step, window.scene.solver.damping))
    return [factor * c * g for g, c in zip(velocities, compliance, strict=True)]


def add_loss_cotangents(
    nodes: BackwardNodes,
    corners: Corners,
    load: Load,
    step: AdjointStep,
    window: ReverseWindow,
    losses: tuple[jax.Array, jax.Array],
) -> tuple[BackwardNodes, Corners]:
    """Adds the contributions of a step's damping loss and unresolved energy to the cotangents of velocities and force.

    They need the velocities before the step, hence its force, before the reverse pass over its elements.
    """
    elements = window.packed.elements
    forces, _ = corner_forces(load, elements, corners[3:])
    number, _, _, velocity_step = step
    half = _half_damping(velocity_step, window.scene.solver.damping)
    loss, unresolved = losses[0], losses[1] * unresolved_factor(velocity_step, window.length, window.scene)

    def compute_block(old: Any, own: Any, landed: Any, mass: Any, compliance: Any, after: Any, kept: Any) -> Any:
        flies = landed > number
        nodal = add_gravity(gather_shares(forces, own), mass, window.scene.solver.gravity)
        before = _velocities_before(nodal, after, kept, (flies, compliance), velocity_step, window)
        share, missed = jnp.where(flies, loss * half * mass, 0.0), jnp.where(flies, unresolved, 0.0)
        triples = list(zip(before, after, nodal, strict=True))
        more = [share * (v + w) + missed * f for v, w, f in triples]
        power = force_cotangent(more, compliance, velocity_step, window)
        more = [more, [own + missed * (w - v) for own, (v, w, _) in zip(power, triples, strict=True)]]
        return [[x + own for x, own in zip(*pair, strict=True)] for pair in zip(old, more, strict=True)], []

    kept = window.stored_velocities(number + 1)
    inputs = gather_table(elements), window.landing_step, window.mass, window.compliance, nodes.speeds, kept
    into = [nodes.velocities, nodes.force]
    new, _ = over_blocks(compute_block, elements.node_block_count, inputs, into, update=2)
    return nodes._replace(velocities=new[0], force=new[1]), [*corners[:3], *forces]


def add_weight_cotangents(nodes: BackwardNodes, window: ReverseWindow) -> BackwardNodes:
    """Adds the contributions of a step's weight to the cotangents of mass and gravity."""
    gravity = window.scene.solver.gravity
    if gravity is None or nodes.gravity is None:
        return nodes
    return nodes._replace(
        mass=nodes.mass + gravity @ nodes.force, gravity=nodes.gravity + jnp.sum(window.mass * nodes.force, axis=1)
    )


def step_nodes_back(
    nodes: BackwardNodes,
    corners: Corners,
    step: AdjointStep,
    window: ReverseWindow,
    losses: tuple[jax.Array, jax.Array],
) -> BackwardNodes:
    """Steps the nodes back by one step, from the cotangents and forces at the elements' corners.

    The losses are the cotangents of damping loss and unresolved energy.
    Nodes that landed in the earlier step are moved by `pull_back_landings`.
    """
    elements, damping = window.packed.elements, window.scene.solver.damping
    number, length, early_velocity_step, velocity_step = step
    half = _half_damping(velocity_step, damping)
    loss, unresolved = losses[0], losses[1] * unresolved_factor(velocity_step, window.length, window.scene)

    def compute_block(old: Any, own: Any, landed: Any, mass: Any, compliance: Any, kept: Any) -> Any:
        at, after, position, velocity, (power,), *more = old
        flies = landed > number
        both = gather_shares(corners, own)
        pulled, nodal = both[:3], add_gravity(both[3:], mass, window.scene.solver.gravity)
        before = _velocities_before(nodal, after, kept, (flies, compliance), velocity_step, window)
        position = [x + own for x, own in zip(position, pulled, strict=True)]
        before, position = materialize((before, position))
        ratio = (1.0 - half) / (1.0 + half)
        gains = vector(jnp.where(flies, v - ratio * w, 0.0) for v, w in zip(after, before, strict=True))
        power, sums = [power + dot(vector(velocity), gains)], []
        if damping is not None:
            twice = vector(jnp.where(flies, v + w, 0.0) for v, w in zip(before, after, strict=True))
            rate, share = 0.25 * loss * velocity_step * dot(twice, twice), 0.5 * loss * velocity_step * mass * damping
            more = [[more[0][0] + rate * damping]]
            sums = [rate * mass - 0.5 * velocity_step / (1.0 + half) * dot(vector(velocity), twice)]
            velocity = [ratio * g + share * both for g, both in zip(velocity, twice, strict=True)]
        if unresolved_share(window.scene) is not None:
            velocity = [g - jnp.where(flies, unresolved * f, 0.0) for g, f in zip(velocity, nodal, strict=True)]
        velocity = [g + length * x for g, x in zip(velocity, position, strict=True)]
        velocity = materialize(velocity)
        force = [jnp.where(flies, f, 0.0) for f in force_cotangent(velocity, compliance, early_velocity_step, window)]
        at = [x - jnp.where(flies, length * v, 0.0) for x, v in zip(at, before, strict=True)]
        return [at, before, position, velocity, power, *more, force], sums

    kept = window.stored_velocities(number + 1)
    inputs = gather_table(elements), window.landing_step, window.mass, window.compliance, kept
    updated = [nodes.at, nodes.speeds, nodes.positions, nodes.velocities, nodes.compliance[None]]
    updated += [nodes.mass[None]] if damping is not None else []
    count = int(damping is not None)
    new, sums = over_blocks(
        compute_block, elements.node_block_count, inputs, [*updated, nodes.force], sums=count, update=len(updated)
    )
    at, before, position, velocity, (power,), *more, force = new
    nodes = nodes._replace(at=at, speeds=before, positions=position, velocities=velocity, force=force, compliance=power)
    return nodes if damping is None else nodes._replace(mass=more[0][0], damping=nodes.damping + sums[0])


# The reverse step of the volume that moving rims sweep.


def rim_end_positions(nodes: BackwardNodes, places: jax.Array) -> jax.Array:
    """Positions of the rim's ends (3, 2, n_edge) [m], read before the nodes are stepped back."""
    return materialize(rim_ends(nodes.at, places))


def pull_back_rim(
    nodes: BackwardNodes,
    after: jax.Array,
    step: AdjointStep,
    places: jax.Array,
    window: ReverseWindow,
    cotangent: jax.Array,
) -> tuple[BackwardNodes, jax.Array, jax.Array]:
    """Adds the contributions of the volume that the rim swept in the earlier step to the cotangents at its end.

    Args:
        nodes: Nodes at the earlier step's begin; those that land in it, at its end.
        after: Positions of the rim's ends at the step's end (3, 2, n_edge) [m].
        step: The reverse step.
        places: Places of the rim's ends (2, n_edge).
        window: Constants of the window.
        cotangent: Cotangent of the swept volume.

    Returns:
        The nodes; the cotangents of the rim's ends at the step's begin (3, 2, n_edge), for `add_rim_cotangents` once
        all nodes are there; and the volume that the rim swept [m^3].
    """
    number, length, velocity_step, _ = step
    landed = window.landing_step[places]
    begin = jnp.where(landed == number, rim_ends(window.before, places), rim_ends(nodes.at, places))
    origin = window.packed.elements.origin
    swept, pull = jax.vjp(lambda begin, after: rim_swept_volume(begin, after, origin), begin, after)
    early, late = pull(cotangent)
    speeds = length * jnp.where(landed > number, late, 0.0)
    compliance = rim_ends(window.compliance, places)
    force = jnp.stack(force_cotangent(unstack_rows(speeds), unstack_rows(compliance), velocity_step, window))
    nodes = add_rim_cotangents(nodes, late, places)
    velocities, power = nodes.velocities.at[:, places].add(speeds), nodes.force.at[:, places].add(force)
    return nodes._replace(velocities=velocities, force=power), early, swept


def add_rim_cotangents(nodes: BackwardNodes, cotangents: jax.Array, places: jax.Array) -> BackwardNodes:
    """Adds cotangents of the positions of the rim's ends (3, 2, n_edge)."""
    return nodes._replace(positions=nodes.positions.at[:, places].add(cotangents))


# The reverse step of nodes that landed on the mold.


_CurvedPath = tuple[jax.Array, jax.Array | None]
"""Change of a node's velocity by the force in its landing's step (3, 1) [m/s], and the solver's damping [1/s]."""


def _curve_of_gain(
    gain: jax.Array, damping: jax.Array | None, velocity: jax.Array, velocity_step: jax.Array, length: jax.Array
) -> jax.Array:
    """`ContactStep.curve` (3, 1) [m], from the velocity's gain by the force and the velocity after the step [m/s]."""
    half = _half_damping(velocity_step, damping)
    return length * (gain - 2.0 * half * velocity) / (1.0 - half)


def _gain_of_curve(
    curve: jax.Array, damping: jax.Array | None, velocity: jax.Array, velocity_step: jax.Array, length: jax.Array
) -> jax.Array:
    """The inverse of `_curve_of_gain`."""
    half = _half_damping(velocity_step, damping)
    return (1.0 - half) * curve / length + 2.0 * half * velocity


def displace_landed_nodes(nodes: BackwardNodes, step: AdjointStep, window: ReverseWindow) -> BackwardNodes:
    """Places nodes that return to their landing points in a step where they are at its begin, on a curved path."""
    assert window.curved is not None
    return nodes._replace(at=jnp.where(window.landing_step == step[0] - 1, window.curved[3:], nodes.at))


def split_point_cotangents(nodes: BackwardNodes, step: AdjointStep, window: ReverseWindow) -> BackwardNodes:
    """Keeps the cotangents of the landing points to which nodes return in a step.

    Their positions before belong to the landing's step, too; the cotangents of both are summed in `positions`.
    """
    assert nodes.point is not None
    return nodes._replace(point=jnp.where(window.landing_step == step[0] - 1, nodes.positions, nodes.point))


def _land_on_triangle(
    node: tuple[jax.Array, jax.Array, jax.Array],
    corners: jax.Array,
    landing: sticking.ContactStep,
    window: ReverseWindow,
) -> sticking.Landing:
    """The landing of a node on a triangle with these corners (3, 3) [m]; differentiable.

    The node is its position at the end of its path (3, 1) [m], its velocity (3, 1) [m/s] and its mass (1,) [kg].
    """
    after, velocity, mass = node
    free, none = jnp.zeros(1, bool), jnp.zeros(1, jnp.int32)
    flying = sticking.Landing(
        Nodes(after, velocity, free, jnp.zeros_like(mass), none, None, {}), none, jnp.zeros_like(landing.end)
    )
    triangle = ContactSurface(Mold(corners, jnp.arange(3, dtype=jnp.int32)[None]), window.scene.surfaces[0].grid)
    return sticking.place_on_surfaces(flying, landing, (mass, None), (triangle,), none, differentiable=True)


def add_impact_cotangents(
    nodes: BackwardNodes,
    corners: Corners,
    load: Load,
    step: AdjointStep,
    wall: jax.Array,
    mold: Mold,
    window: ReverseWindow,
    loss: jax.Array,
) -> tuple[BackwardNodes, Corners]:
    """Adds the contributions of what forces do to the contact loss in a step's landings, node by node.

    That is the loss without the kinetic energy, which `pull_back_landings` reverses. It needs the step's forces.

    Args:
        nodes: Nodes at the begin of the step in which they land.
        corners: Workspace for corner forces.
        load: The load then.
        step: The reverse step, to the begin of the step before.
        wall: Contact triangles at the window's end (place,), as in `Nodes`.
        mold: The mold.
        window: Constants of the window.
        loss: The cotangent of the contact loss.
    """
    elements, (number, _, _, velocity_step) = window.packed.elements, step
    forces, _ = corner_forces(load, elements, corners[3:])
    places, count = compact_indices(window.landing_step == number + 1, window.landing_step.size)
    length = window.length

    def one(k: jax.Array, nodes: BackwardNodes) -> BackwardNodes:
        place = blocks.entry(places, k)

        def read_node(values: jax.Array) -> jax.Array:
            return blocks.slice_at(values, place, 1)

        def add(values: jax.Array, more: Any) -> jax.Array:
            return blocks.put(values, read_node(values) + jnp.stack(more), place)

        def lost(begin: jax.Array, velocity: jax.Array, nodal: jax.Array, vertices: jax.Array) -> jax.Array:
            landing = sticking.ContactStep(length, length, number, impulse=length * nodal)
            node = begin + length * velocity, velocity, jnp.zeros_like(velocity[0])
            return _land_on_triangle(node, vertices, landing, window).loss

        shares = gather_shares(forces, (read_node(elements.slots), jnp.int32(len(elements.slots))))
        nodal = jnp.stack(add_gravity(shares, read_node(window.mass), window.scene.solver.gravity))
        triangle = mold.triangles[jnp.abs(read_node(wall)[0]) - 1]
        at, speeds, compliance = (read_node(x) for x in (nodes.at, nodes.speeds, window.compliance))
        _, pull = jax.vjp(lost, at, speeds, nodal, mold.vertices[triangle])
        position, velocity, force, vertices = pull(loss)
        power = force_cotangent(unstack_rows(velocity), unstack_rows(compliance), velocity_step, window)
        return nodes._replace(
            positions=add(nodes.positions, position),
            velocities=add(nodes.velocities, velocity),
            force=add(nodes.force, force + jnp.stack(power)),
            vertices=None if nodes.vertices is None else nodes.vertices.at[triangle].add(vertices),
        )

    return jax.lax.fori_loop(0, count, one, nodes), [*corners[:3], *forces]


def pull_back_landings(
    nodes: BackwardNodes,
    step: AdjointStep,
    at: tuple[jax.Array, jax.Array],
    mold: Mold,
    window: ReverseWindow,
    loss: jax.Array,
) -> BackwardNodes:
    """Reverses the landings of a step, node by node, back to the positions before it.

    `at` has the contact triangles at the window's end (place,), as `wall` in `Nodes`, and the window's begin [s].
    """
    wall, begin_time = at
    number, length, velocity_step, _ = step
    time = begin_time + (number + 1) * length
    places, count = compact_indices(window.landing_step == number, window.landing_step.size)

    def one(k: jax.Array, nodes: BackwardNodes) -> BackwardNodes:
        place = blocks.entry(places, k)

        def read_node(values: jax.Array) -> jax.Array:
            return blocks.slice_at(values, place, 1)

        def write_node(values: jax.Array, new: jax.Array) -> jax.Array:
            return blocks.put(values, new, place)

        def land(
            after: jax.Array, velocity: jax.Array, mass: jax.Array, corners: jax.Array, curved: _CurvedPath | None
        ) -> Any:
            landing = sticking.ContactStep(length, time, number)
            if curved is not None:
                landing = landing._replace(
                    curve=_curve_of_gain(*curved, velocity, velocity_step, length), damping=curved[1]
                )
            there = _land_on_triangle((after, velocity, mass), corners, landing, window)
            ends, back = [there.nodes.positions], _half_damping(length, landing.damping)
            if curved is not None:
                # In the next step it returns to its landing point.
                ends += [ends[0] + (1.0 - back) / (1.0 + back) * length * there.nodes.velocities]
            return ends, there.nodes.contact_time, there.loss

        # All is read before anything is written (docs/explanation/kernels.md).
        old = materialize(jax.tree.map(read_node, nodes._replace(damping=None, gravity=None, vertices=None)))
        begin, curved = read_node(window.before), None
        if window.curved is not None:
            curve, damping = read_node(window.curved)[:3], window.scene.solver.damping
            curved = _gain_of_curve(curve, damping, old.speeds, velocity_step, length), damping
        triangle = mold.triangles[jnp.abs(read_node(wall)[0]) - 1]
        after = begin + length * old.speeds
        _, pull = jax.vjp(land, after, old.speeds, read_node(window.mass), mold.vertices[triangle], curved)
        ends = [old.positions]
        if old.point is not None:
            # A window's last step ends at the landing point itself.
            point = jnp.where(number == window.count - 1, old.positions, old.point)
            ends = [old.positions - point, point]
        position, velocity, mass, corners, pulled = pull((ends, old.contact_time, loss))
        velocity = velocity + length * position
        compliance = read_node(window.compliance)
        force = jnp.stack(force_cotangent(unstack_rows(velocity), unstack_rows(compliance), velocity_step, window))
        if curved is not None and pulled is not None:
            force = force + velocity_step * compliance * pulled[0]
            nodes = nodes._replace(
                compliance=write_node(nodes.compliance, old.compliance + dot(pulled[0], curved[0])),
                damping=nodes.damping if pulled[1] is None else nodes.damping + pulled[1],
            )
        return BackwardNodes(
            at=write_node(nodes.at, begin),
            speeds=nodes.speeds,
            positions=write_node(nodes.positions, position),
            velocities=write_node(nodes.velocities, velocity),
            force=write_node(nodes.force, force),
            mass=write_node(nodes.mass, old.mass + mass),
            compliance=nodes.compliance,
            contact_time=write_node(nodes.contact_time, jnp.zeros_like(old.contact_time)),
            damping=nodes.damping,
            gravity=nodes.gravity,
            vertices=None if nodes.vertices is None else nodes.vertices.at[triangle].add(corners),
            point=nodes.point,
        )

    return jax.lax.fori_loop(0, count, one, nodes)

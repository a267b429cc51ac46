"""Refinement at a window boundary: the elements that are bisected, the closure by their neighbours, and the new nodes.

Only marks change: the forest has been bisected beforehand. The decisions are piecewise constant in the design; the
state of the new nodes is differentiable in that of their edges' ends.
"""

from __future__ import annotations

import dataclasses
import functools
from typing import Any

import jax
import jax.numpy as jnp

from jaxform.adapt.element_bisection import (
    Queue,
    add_sides,
    bisect_mesh,
    close_queue,
    find_ancestry,
    inherit_stress,
    make_queue,
)
from jaxform.adapt.insertion import insert_nodes, present_frames
from jaxform.kernels import capacities
from jaxform.kernels.blocks import BLOCK, compact_indices, lax_cond_once, over_blocks, padded_length
from jaxform.kernels.derivatives import save_decision
from jaxform.mechanics import membrane
from jaxform.mechanics.membrane import Vector, dot, gather, minus
from jaxform.model.scene import Adaptivity, Refinement, Scene
from jaxform.model.tables import SHORT_WINDOW, Bend, BisectionHierarchy
from jaxform.sheet.active_set import ActiveSet, totals_of
from jaxform.sheet.discretization import (
    NEVER,
    Discretization,
    RefinedMesh,
    element_levels,
    refined_discretization,
    refined_node_capacity,
)
from jaxform.sheet.energy_balance import enclosed_volume, kinetic_energy, strain_energy
from jaxform.sheet.scheme import synchronize_velocity
from jaxform.sheet.state import PackedState, Schedule, State, Status
from jaxform.tools.search import SearchGrid, cell_of


def refine(
    state: State, scene: Scene, discrete: Discretization, schedule: Schedule | None = None
) -> tuple[State, Discretization]:
    """The state refined where the mesh needs it, at a window boundary where a check is due; and its discretization.

    With a schedule the mesh is refined as it was when that was recorded, whatever its shape.

    Args:
        state: The state; its mesh has no `side`.
        scene: The scene.
        discrete: The sheet with the state's mesh.
        schedule: The recorded decisions; None where the mesh decides.
    """
    mesh, adaptivity = state.mesh, scene.adaptivity
    if mesh is None or adaptivity is None:
        return state, discrete
    if schedule is not None and schedule.split_at is not None:
        planned = schedule.split_at <= schedule.next_row(state.replay.row)
        due = jnp.any(planned & (mesh.split_at == NEVER))
        wanted = functools.partial(_planned_queue, planned=planned)
    else:
        due, wanted = _is_due(state, adaptivity), functools.partial(_requested_queue, scene=scene)

    def refine_now(pair: tuple[State, Discretization]) -> tuple[State, Discretization]:
        state, discrete = pair
        state = dataclasses.replace(state, mesh=add_sides(state.refined_mesh, adaptivity[1]))
        state, discrete = _bisect_queue(state, scene, adaptivity, discrete, *wanted(state, discrete, adaptivity), None)
        return drop_sides(state), discrete

    return lax_cond_once(save_decision(due), refine_now, (state, discrete), differentiable=True)


def drop_sides(state: State) -> State:
    """The state, with a mesh that has no `side`."""
    return state if state.mesh is None else dataclasses.replace(state, mesh=dataclasses.replace(state.mesh, side=None))


def refine_in_place(
    state: PackedState, scene: Scene, discrete: Discretization, active: ActiveSet
) -> tuple[PackedState, Discretization, ActiveSet]:
    """Refines a state in the order of the last window's active set; no derivative is taken.

    Also returns that set: where elements have a memory, it has that of the new ones, in whose order it must be packed.
    """
    adaptivity = scene.adaptivity
    if state.mesh is None or adaptivity is None:
        return state, discrete, active

    def refine_now(pair: Any) -> tuple[PackedState, Discretization, Any]:
        packed, discrete, _ = pair
        state = active.unpack_state(packed)
        state, discrete = _bisect_queue(
            state, scene, adaptivity, discrete, *_requested_queue(state, discrete, adaptivity, scene), active
        )
        inactive = active.inactive
        if inactive is not None and state.memory is not None:
            inactive = dataclasses.replace(inactive, stress=state.memory[:, inactive.element], since=state.time)
        return active.pack_state(state), discrete, (state.memory, inactive, state.heat)

    before = state, discrete, (active.memory, active.inactive, active.heat)
    state, discrete, (memory, inactive, heat) = lax_cond_once(_is_due(state, adaptivity), refine_now, before)
    return state, discrete, dataclasses.replace(active, memory=memory, inactive=inactive, heat=heat)


def _is_due(state: State | PackedState, adaptivity: Adaptivity) -> jax.Array:
    # A window that is retried starts with the mesh that it had.
    limits, _ = adaptivity
    return is_refinement_due(state.windows, limits) & ((state.control.last_count > 0) | (state.windows == 0))


def is_refinement_due(window: jax.Array, limits: Refinement) -> jax.Array:
    """True where a check of the mesh is due at the boundary before a window, without a schedule."""
    return window % -(-limits.interval // SHORT_WINDOW) == 0


def _planned_queue(
    state: State, _: Discretization, adaptivity: Adaptivity, planned: jax.Array
) -> tuple[jax.Array, Queue]:
    """Windows of the triangles' bisection (n_triangle,), with those planned by now, and the queue of the new ones."""
    mesh, forest = state.refined_mesh, adaptivity[1]
    new = planned & (mesh.split_at == NEVER)
    return jnp.where(new, state.windows, mesh.split_at), make_queue(*compact_indices(new, mesh.element.size), forest)


def _requested_queue(
    state: State, discrete: Discretization, adaptivity: Adaptivity, scene: Scene
) -> tuple[jax.Array, Queue]:
    """Windows of the triangles' bisection (n_triangle,), with those that the mesh requests, and their queue."""
    mesh = state.refined_mesh
    place, count = compact_indices(_mark_elements(state, discrete, adaptivity, scene), mesh.element.size)
    _, forest = adaptivity
    return close_queue(mesh.split_at, mesh.element[place], count, forest, state.windows)


def _mark_elements(state: State, discrete: Discretization, adaptivity: Adaptivity, scene: Scene) -> jax.Array:
    """Mask (element_capacity,) of the elements to bisect for their own and their neighbours' shape."""
    state, discrete, adaptivity, scene = jax.lax.stop_gradient((state, discrete, adaptivity, scene))
    (limits, forest), mesh, frame = adaptivity, state.refined_mesh, None
    if scene.mold is not None:
        frame = present_frames(state, scene)[0]
    positions = state.nodes.positions if frame is None else frame.places(state.nodes.positions)
    shapes = _shapes(positions, discrete, adaptivity, scene.tables.grid)
    sheet, fine = discrete.sheet, 0.5 * discrete.sheet.area < limits.min_area
    capacity = padded_length(mesh.element.size)
    blocks = mesh.element_count // BLOCK + 1

    def compute_block(
        element: jax.Array, neighbor: jax.Array, element_shape: jax.Array, fine: jax.Array, area: jax.Array
    ) -> Any:
        level = element_levels(element, forest)
        wanted = _is_bent(element_shape, neighbor, shapes, limits.angle) & (level < limits.max_level)
        if limits.jump is not None:
            wanted |= _is_uneven(element_shape, neighbor, shapes, limits.jump) & (level < limits.max_level)
        if forest.bend is not None:
            # A bent part of the mold is nearer than so many longest sides.
            wanted |= (element_shape[4] > 0.0) & (level < limits.base_level)
        return [[wanted & ~fine & (area > 0.0)]], []

    across = mesh.sides[forest.half_edges[:, mesh.element] ^ 1]
    lists = mesh.element, across, shapes[:, : mesh.element.size], fine, sheet.area
    inputs = tuple(jnp.pad(x, [(0, 0)] * (x.ndim - 1) + [(0, capacity - x.shape[-1])]) for x in lists)
    (marks,), _ = over_blocks(compute_block, blocks, inputs, [jnp.zeros((1, capacity), bool)])
    return marks[0, : mesh.element.size]


def _shapes(positions: Any, discrete: Discretization, adaptivity: Adaptivity, grid: SearchGrid | None) -> jax.Array:
    """Unit normal, thickness [m], and distance by which a bent part of the mold is in base reach [m] (5, capacity)."""
    elements, (limits, forest) = discrete.whole.elements, adaptivity
    bend = forest.bend
    rows = membrane.unstack_rows(positions)
    thickness = discrete.thickness[discrete.whole.element]

    def compute_block(triangles: jax.Array, area: jax.Array, thickness: jax.Array) -> Any:
        first, edge1, edge2 = membrane.edges(rows, triangles)
        normal = membrane.cross(edge1, edge2)
        size = jnp.sqrt(jnp.maximum(membrane.dot(normal, normal), jnp.finfo(area.dtype).tiny))
        x, y, z = (component / size for component in normal)
        near = jnp.zeros_like(size)
        if bend is not None and grid is not None:
            near = _within_reach(first, edge1, edge2, bend, grid, limits.proximity_factor)
        return [[x, y, z, 2.0 * area * thickness / size, near]], []

    inputs = elements.triangles, elements.area, thickness
    into = [jnp.zeros((5, thickness.size), thickness.dtype)]
    (found,), _ = over_blocks(compute_block, elements.block_count, inputs, into)
    return found


def _within_reach(
    first: Vector, edge1: Vector, edge2: Vector, bend: Bend, grid: SearchGrid, reach: jax.Array
) -> jax.Array:
    """Distance (n,) [m] by which a bent part of the mold is within reach of triangles (n,) with such edges [m].

    The reach is a multiple of their longest side.
    """
    square = functools.reduce(jnp.maximum, (dot(side, side) for side in (edge1, edge2, minus(edge2, edge1))))
    middle = jnp.stack([p + (a + b) / 3.0 for p, a, b in zip(first, edge1, edge2, strict=True)])
    cell = cell_of(middle, grid, bend.parts)
    return reach * jnp.sqrt(square) - gather(bend.distance, cell)


def _is_bent(element: jax.Array, neighbor: jax.Array, shapes: jax.Array, angle: jax.Array) -> jax.Array:
    """True where a normal of an element (n,) or of a neighbour is far from the mean of the group's (paper, 3.3)."""
    normal = element[0], element[1], element[2]
    beside = []
    for side in neighbor:
        there = side >= 0
        x, y, z = (jnp.where(there, row[jnp.maximum(side, 0)], 0.0) for row in shapes[:3])
        beside.append((there, (x, y, z)))
    mean = functools.reduce(membrane.plus, (other for _, other in beside), normal)
    limit = jnp.cos(jnp.deg2rad(angle)) * jnp.sqrt(membrane.dot(mean, mean))
    bent = membrane.dot(normal, mean) < limit
    for there, other in beside:
        bent |= there & (membrane.dot(other, mean) < limit)
    return bent


def _is_uneven(element: jax.Array, neighbor: jax.Array, shapes: jax.Array, jump: jax.Array) -> jax.Array:
    """True where the thickness ratio of an element (n,) and a neighbour exceeds 1 + `jump`."""
    uneven = jnp.zeros(element.shape[1], bool)
    for side in neighbor:
        other = shapes[3][jnp.maximum(side, 0)]
        ratio = jnp.maximum(other, element[3]) / jnp.minimum(other, element[3])
        uneven |= (side >= 0) & (ratio > 1.0 + jump)
    return uneven


def _bisect_queue(
    state: State,
    scene: Scene,
    adaptivity: Adaptivity,
    discrete: Discretization,
    split_at: jax.Array,
    queue: Queue,
    active: ActiveSet | None,
) -> tuple[State, Discretization]:
    """The state with the queue's triangles bisected within the capacity; else its status reports the overflow."""
    mesh = state.refined_mesh
    fits = (mesh.element_count + queue.count <= mesh.element.size) & (
        mesh.node_count + queue.node_count <= mesh.node.size
    )
    full = jnp.where(fits, 0, Status.REFINEMENT_OVERFLOW).astype(state.status.dtype)
    state = dataclasses.replace(state, status=state.status | full)

    def bisect(pair: tuple[State, Discretization]) -> tuple[State, Discretization]:
        state, discrete = pair
        return _bisect_state(state, scene, adaptivity, discrete, split_at, queue, active)

    return lax_cond_once(
        save_decision(fits & (queue.count > 0)), bisect, (state, discrete), differentiable=active is None
    )


def _bisect_state(
    state: State,
    scene: Scene,
    adaptivity: Adaptivity,
    discrete: Discretization,
    split_at: jax.Array,
    queue: Queue,
    active: ActiveSet | None,
) -> tuple[State, Discretization]:
    """The state with the queue's triangles bisected."""
    differentiable, (_, forest), properties = active is None, adaptivity, discrete.forest_properties
    before, state = state, synchronize_velocity(state, scene, discrete, active)
    mesh = dataclasses.replace(bisect_mesh(state.refined_mesh, queue, forest), split_at=split_at)
    finer = refined_discretization(scene, forest, mesh, properties)
    new = insert_nodes(state, mesh, scene, adaptivity, properties[0], differentiable=differentiable)
    new = dataclasses.replace(_inherit_state(new, state, mesh, forest), mesh=mesh)
    energy, volume = _energy_and_volume(state, scene, discrete, differentiable=differentiable)
    new_energy, new_volume = _energy_and_volume(new, scene, finer, differentiable=differentiable)
    loss = energy - new_energy
    made = dataclasses.replace(
        new,
        control=dataclasses.replace(state.control, sharpness=jnp.zeros_like(state.control.sharpness)),
        account=dataclasses.replace(
            state.account,
            refinement_loss=state.account.refinement_loss + loss,
            volume=state.account.volume + new_volume - volume,
        ),
    )
    # A new node that the mold flattens an element with would end the run: the mesh stays as it is.
    sound = save_decision(jnp.isfinite(loss))
    return lax_cond_once(~sound, lambda _: (before, discrete), (made, finer), differentiable=differentiable)


def _inherit_state(new: State, state: State, mesh: RefinedMesh, forest: BisectionHierarchy) -> State:
    """The state on a new mesh, with the quantities that its elements inherit from the old ones."""
    if state.memory is None and state.heat is None:
        return new
    element, parts = find_ancestry(state.refined_mesh, mesh, forest)
    memory = None if state.memory is None else inherit_stress(state.memory, element, parts)
    heat = None if state.heat is None else state.heat.select(element)
    return dataclasses.replace(new, memory=memory, heat=heat)


def _energy_and_volume(
    state: State, scene: Scene, discrete: Discretization, *, differentiable: bool
) -> tuple[jax.Array, jax.Array]:
    """Strain and kinetic energy [J] and enclosed volume [m^3] of a state with velocities at its time."""
    kinetic = kinetic_energy(state, discrete.mass)
    if differentiable:
        return strain_energy(state, scene, discrete) + kinetic, enclosed_volume(state.nodes.positions, discrete.sheet)
    energy, volume = totals_of(state, scene, discrete)
    return energy + kinetic, volume


# Capacity for elements and nodes.

_SPARE_BLOCKS = 2


def can_enlarge_capacity(adaptivity: Adaptivity) -> bool:
    """True where the forest has more elements than the capacity."""
    limits, forest = adaptivity
    return limits.elements < forest.root_count << forest.depth


def fitted(scene: Scene, used: int) -> Scene:
    """A scene with capacity for somewhat more elements than were `used` in a run: unused capacity takes time too.

    A scene without refinement, or with no more capacity than that, is unchanged.
    """
    if scene.adaptivity is None:
        return scene
    limits, forest = scene.adaptivity
    blocks = min(_SPARE_BLOCKS + -(-used // BLOCK), -(-(forest.root_count << forest.depth) // BLOCK))
    if used <= limits.elements <= blocks * BLOCK:
        return scene
    return _replace_adaptivity(scene, _enlarge(scene.adaptivity, blocks))


def enlarge_capacity(scene: Scene, adaptivity: Adaptivity, state: State) -> tuple[Scene, State]:
    """A scene with twice the capacity for elements, and the state as it was before the capacity was exceeded."""
    (limits, _), mesh = adaptivity, state.refined_mesh
    more = _enlarge(adaptivity, capacities.refined_capacity(2 * limits.elements) // BLOCK)
    elements, nodes = more[0].elements, more[1].node_capacity
    beyond = _pad(mesh.corner, nodes).at[:, mesh.node.size :].set(-1)
    grown = dataclasses.replace(
        mesh,
        element=_pad(mesh.element, elements),
        node=_pad(mesh.node, nodes),
        corner=beyond,
        corner_count=_pad(mesh.corner_count, nodes),
        row=_pad(mesh.row, elements),
    )
    status = state.status & ~int(Status.REFINEMENT_OVERFLOW)
    memory, heat = jax.tree.map(lambda rows: _pad(rows, elements), (state.memory, state.heat))
    nodes = state.nodes.pad(nodes)
    state = dataclasses.replace(state, nodes=nodes, mesh=grown, memory=memory, heat=heat, status=status)
    return _replace_adaptivity(scene, more), state


def _enlarge(adaptivity: Adaptivity, blocks: int) -> Adaptivity:
    elements, (limits, forest) = blocks * BLOCK, adaptivity
    nodes = refined_node_capacity(elements, forest.first_nodes, forest.owner.size)
    return dataclasses.replace(limits, elements=elements), dataclasses.replace(forest, node_capacity=nodes)


def _replace_adaptivity(scene: Scene, adaptivity: Adaptivity) -> Scene:
    limits, forest = adaptivity
    return dataclasses.replace(scene, tables=dataclasses.replace(scene.tables, forest=forest), refinement=limits)


def _pad(values: jax.Array, count: int) -> jax.Array:
    return jnp.concatenate([values, jnp.zeros((*values.shape[:-1], count - values.shape[-1]), values.dtype)], axis=-1)

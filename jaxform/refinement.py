"""Refinement at a window's border: which elements are bisected, what their neighbours then need, and the new nodes.

Nothing but marks changes: the forest has been bisected beforehand. What is decided here is piecewise constant in the
design; the state of the new nodes flows through from their edges' ends.
"""

from __future__ import annotations

import dataclasses
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from jaxform import membrane
from jaxform.blocks import listed
from jaxform.body import NEVER, Body, Mesh, levels, node_room, refined_body, relisted
from jaxform.near import cells
from jaxform.newborn import settled
from jaxform.scene import STEPS_PER_WINDOW, Forest, Refinement, Scene
from jaxform.state import Schedule, State, Status, any_mode, enclosed_volume, kinetic_energy, strain_energy


class Tree(NamedTuple):
    """As much of a forest as closure needs."""

    partner: jax.Array
    root_count: int
    depth: int


def refined(state: State, scene: Scene, sheet_body: Body, schedule: Schedule | None = None) -> tuple[State, Body]:
    """The state with more elements where the mesh needs them, at a border where it is time to look; and its body.

    With a schedule the mesh grows as it did when that was recorded, whatever it looks like.
    """
    refinement, forest = scene.refinement, scene.tables.forest
    if refinement is None or forest is None:
        return state, sheet_body
    mesh = state.mesh
    assert mesh is not None
    due = state.windows % -(-refinement.interval // STEPS_PER_WINDOW) == 0

    def look() -> jax.Array:
        return closure((mesh.split_at != NEVER) | _marked(state, scene, sheet_body), forest)

    if schedule is not None and schedule.split_at is not None:
        split = schedule.split_at <= state.windows
    else:
        split = jax.lax.cond(due, look, lambda: mesh.split_at != NEVER)
    grows = jnp.any(split & (mesh.split_at == NEVER))
    return jax.lax.cond(
        grows,
        lambda state, scene, body: _grown(state, scene, body, split),
        lambda state, _, body: (state, body),
        state,
        scene,
        sheet_body,
    )


def can_have_more_room(scene: Scene) -> bool:
    """Whether the forest has more elements than there is room for."""
    forest, refinement = scene.tables.forest, scene.refinement
    return forest is not None and refinement is not None and refinement.elements < forest.root_count << forest.depth


def with_more_room(scene: Scene, state: State) -> tuple[Scene, State]:
    """A scene with twice the room for elements, and a state that found too little as it was before it did."""
    forest, refinement, mesh = scene.tables.forest, scene.refinement, state.mesh
    assert forest is not None and refinement is not None and mesh is not None
    elements = min(2 * refinement.elements, forest.root_count << forest.depth)
    nodes = node_room(elements, forest.first_nodes, forest.owner.size)
    tables = dataclasses.replace(scene.tables, forest=dataclasses.replace(forest, node_room=nodes))
    scene = dataclasses.replace(scene, tables=tables, refinement=dataclasses.replace(refinement, elements=elements))
    nodal = ("positions", "velocities", "stuck", "contact_time", "wall", *(("mode",) if state.mode is not None else ()))
    grown: dict[str, Any] = {name: _padded(getattr(state, name), nodes) for name in nodal}
    grown["stuck"] = grown["stuck"].at[state.stuck.size :].set(True)
    element = _padded(mesh.element, elements).at[mesh.element.size :].set(mesh.element[0])
    neighbor = _padded(mesh.neighbor, elements).at[:, mesh.element.size :].set(-1)
    grown["mesh"] = dataclasses.replace(mesh, element=element, neighbor=neighbor, node=_padded(mesh.node, nodes))
    status = state.status & ~int(Status.REFINEMENT_OVERFLOW)
    return scene, dataclasses.replace(state, **grown, status=status)


def _padded(values: jax.Array, count: int) -> jax.Array:
    return jnp.concatenate([values, jnp.zeros((*values.shape[:-1], count - values.shape[-1]), values.dtype)], axis=-1)


def closure(split: jax.Array, tree: Forest | Tree) -> jax.Array:
    """Triangles (n_triangle,) that are bisected when those of `split` are, so that no node hangs on a side.

    With a triangle its partner is bisected, and what has bisected parts is so itself. The least such set, so it does
    not depend on the order of the marks.
    """

    def more(carry: tuple[jax.Array, jax.Array]) -> jax.Array:
        return carry[1]

    def sweep(carry: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        split = carry[0]
        wider = split | split[tree.partner]
        levels, end = [], wider.size
        below = None
        for level in range(tree.depth, -1, -1):
            begin = tree.root_count * ((1 << level) - 1)
            part = wider[begin:end]
            if below is not None:
                part = part | below[0::2] | below[1::2]
            levels.append(part)
            below, end = part, begin
        wider = jnp.concatenate(levels[::-1])
        return wider, jnp.any(wider != split)

    return jax.lax.while_loop(more, sweep, (split, jnp.asarray(True)))[0]


def _marked(state: State, scene: Scene, sheet_body: Body) -> jax.Array:
    """Triangles (n_triangle,) of the forest that should be bisected for what they and their neighbours look like."""
    state, scene, sheet_body = jax.lax.stop_gradient((state, scene, sheet_body))
    refinement, forest, mesh = scene.refinement, scene.tables.forest, state.mesh
    assert refinement is not None and forest is not None and mesh is not None
    used = sheet_body.sheet.area > 0.0
    small = 0.5 * sheet_body.sheet.area < refinement.min_area
    level = levels(mesh.element, forest)
    _, edge1, edge2 = membrane.edges(state.positions, sheet_body.sheet.triangles)
    wanted = _bent(edge1, edge2, mesh.neighbor, refinement) & (level < refinement.max_level)
    if refinement.jump is not None:
        wanted |= _uneven(edge1, edge2, sheet_body, mesh.neighbor, refinement.jump) & (level < refinement.max_level)
    if forest.bend is not None:
        wanted |= _near_a_bend(state, scene, sheet_body, edge1, edge2) & (level < refinement.base_level)
    marks = wanted & used & ~small
    none = jnp.zeros(forest.bound.size, bool)
    return none.at[jnp.where(marks, mesh.element, none.size)].set(True, mode="drop")


def _bent(edge1: membrane.Vector, edge2: membrane.Vector, neighbor: jax.Array, refinement: Refinement) -> jax.Array:
    """Whether a normal of an element (n_element,) or a neighbour is far from the mean of the group's (paper, 3.3)."""
    normal = jnp.stack(membrane.cross(edge1, edge2))
    normal = normal / jnp.sqrt(jnp.maximum(membrane.dot(normal, normal), jnp.finfo(normal.dtype).tiny))
    beside = [jnp.where(side >= 0, normal[:, side], 0.0) for side in neighbor]
    mean = normal + sum(beside)
    length = jnp.sqrt(membrane.dot(mean, mean))
    limit = jnp.cos(jnp.deg2rad(refinement.angle)) * length
    bent = membrane.dot(normal, mean) < limit
    for side, other in zip(neighbor, beside, strict=True):
        bent |= (side >= 0) & (membrane.dot(other, mean) < limit)
    return bent


def _uneven(
    edge1: membrane.Vector, edge2: membrane.Vector, sheet_body: Body, neighbor: jax.Array, jump: jax.Array
) -> jax.Array:
    """Whether an element (n_element,) is that much thicker or thinner than a neighbour."""
    normal = membrane.cross(edge1, edge2)
    now = jnp.maximum(membrane.dot(normal, normal), jnp.finfo(normal[0].dtype).tiny)
    thickness = sheet_body.thickness * 2.0 * sheet_body.sheet.area / jnp.sqrt(now)
    uneven = jnp.zeros(thickness.size, bool)
    for side in neighbor:
        other = thickness[side]
        uneven |= (side >= 0) & (jnp.maximum(other, thickness) > (1.0 + jump) * jnp.minimum(other, thickness))
    return uneven


def _near_a_bend(
    state: State, scene: Scene, sheet_body: Body, edge1: membrane.Vector, edge2: membrane.Vector
) -> jax.Array:
    """Whether a bent part of the mold is nearer to an element (n_element,) than its longest side."""
    grid, forest = scene.tables.grid, scene.tables.forest
    assert grid is not None and forest is not None and forest.bend is not None
    third = membrane.minus(edge2, edge1)
    longest = jnp.sqrt(
        jnp.maximum(jnp.maximum(membrane.dot(edge1, edge1), membrane.dot(edge2, edge2)), membrane.dot(third, third))
    )
    first = membrane.gather(state.positions, sheet_body.sheet.triangles[0])
    middle = first + (jnp.stack(edge1) + jnp.stack(edge2)) / 3.0
    return forest.bend[cells(middle, grid)] < longest


def _grown(state: State, scene: Scene, sheet_body: Body, split: jax.Array) -> tuple[State, Body]:
    """The state with the new nodes, where there is room for all; else its status says so."""
    forest, old = scene.tables.forest, state.mesh
    assert forest is not None and old is not None and sheet_body.volumes is not None
    mesh, fits = _remeshed(old, split, state.windows, forest)
    body = refined_body(scene, mesh, sheet_body.volumes)
    new = settled(_born(state, old, mesh, scene, body), old, mesh, scene, body)
    before = strain_energy(state, scene, sheet_body) + kinetic_energy(state, sheet_body.mass)
    after = strain_energy(new, scene, body) + kinetic_energy(new, body.mass)
    lost = enclosed_volume(state.positions, sheet_body.sheet)
    new = dataclasses.replace(
        new,
        refinement_loss=state.refinement_loss + before - after,
        volume=state.volume + enclosed_volume(new.positions, body.sheet) - lost,
    )
    full = dataclasses.replace(state, status=state.status | Status.REFINEMENT_OVERFLOW)
    return jax.tree.map(lambda a, b: jnp.where(fits, a, b), (new, body), (full, sheet_body))


def _remeshed(old: Mesh, split: jax.Array, window: jax.Array, forest: Forest) -> tuple[Mesh, jax.Array]:
    """The mesh with more triangles bisected, and whether there is room for it."""
    split_at = jnp.where(split & (old.split_at == NEVER), window, old.split_at).astype(jnp.int32)
    born = split[forest.owner] & (old.split_at[forest.owner] == NEVER)
    born = born & (jnp.arange(born.size) >= forest.first_nodes)
    room = old.node.size
    found, count = listed(born, room)
    rank = jnp.cumsum(born, dtype=jnp.int32) - 1
    place = jnp.where(born, jnp.minimum(old.node_count + rank, room - 1), old.place)
    index = jnp.arange(room) - old.node_count
    node = jnp.where((index >= 0) & (index < count), found[jnp.maximum(index, 0)], old.node)
    total = old.node_count + count
    mesh = Mesh(split_at, old.element, old.neighbor, old.element_count, node, place, jnp.minimum(total, room))
    mesh = relisted(mesh, forest)
    return mesh, (total <= room) & (mesh.element_count <= mesh.element.size)


def _born(state: State, old: Mesh, mesh: Mesh, scene: Scene, body: Body) -> State:
    """New nodes move as the middles of their edges did; the momentum of all is what it was.

    A bisection takes from the edge's ends the mass of the parts that they do not belong to any more: with velocities
    weighted by these the momentum is kept exactly.
    """
    forest = scene.tables.forest
    assert forest is not None and body.volumes is not None
    place = jnp.arange(mesh.node.size)
    new = (place >= old.node_count) & (place < mesh.node_count)
    first, second = (jnp.where(new, mesh.place[end], place) for end in forest.ends[:, mesh.node])
    weight = _weight(body.volumes, forest.owner[mesh.node], forest.ends[0, mesh.node], forest)
    reference = scene.parison.positions[mesh.node].T
    moved = state.positions - reference
    values = moved, state.velocities, state.mode if state.mode is not None else moved

    def between(values: tuple[jax.Array, ...], _: None) -> tuple[tuple[jax.Array, ...], None]:
        moved, velocities, mode = values
        mean = 0.5 * (moved[:, first] + moved[:, second])
        mixed = weight * velocities[:, first] + (1.0 - weight) * velocities[:, second]
        middle = 0.5 * (mode[:, first] + mode[:, second])
        pairs = (mean, moved), (mixed, velocities), (middle, mode)
        return tuple(jnp.where(new, fresh, kept) for fresh, kept in pairs), None

    # A new node can be the end of a newer one: as often as there can be generations at one border.
    (moved, velocities, mode), _ = jax.lax.scan(between, values, length=forest.depth)
    held = new & jnp.all(forest.mobility[:, mesh.node] == 0.0, axis=0)
    free = new & ~held
    positions = jnp.where(new, reference + jnp.where(held, 0.0, moved), state.positions)
    return dataclasses.replace(
        state,
        positions=positions,
        velocities=jnp.where(held, 0.0, velocities),
        stuck=jnp.where(free, False, state.stuck),
        contact_time=jnp.where(free, -1.0, jnp.where(held, 0.0, state.contact_time)),
        mode=None if state.mode is None else jnp.where(new, jnp.max(jnp.abs(mode)) * any_mode(mode), mode),
        rate=jnp.zeros_like(state.rate),
        mesh=mesh,
    )


def _weight(volumes: jax.Array, owner: jax.Array, end: jax.Array, forest: Forest) -> jax.Array:
    """Share (n,) of an edge's first end in the velocity of its middle: of the mass that both lose."""
    lost = jnp.zeros((2, owner.size), volumes.dtype)
    for triangle, there in ((owner, True), (forest.partner[owner], forest.partner[owner] != owner)):
        children = 2 * triangle + forest.root_count
        # The first child keeps the edge's begin, the second its end; each end loses the other's part.
        parts = volumes[jnp.minimum(children + 1, volumes.size - 1)], volumes[jnp.minimum(children, volumes.size - 1)]
        turned = forest.sheet.triangles[1, triangle] != end
        lost += jnp.where(there, jnp.stack([jnp.where(turned, parts[1], parts[0]), jnp.where(turned, *parts)]), 0.0)
    return lost[0] / (lost[0] + lost[1])

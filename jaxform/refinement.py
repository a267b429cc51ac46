"""Refinement at a window's border: which elements are bisected, what their neighbours then need, and the new nodes.

Nothing but marks changes: the forest has been bisected beforehand. What is decided here is piecewise constant in the
design; the state of the new nodes flows through from their edges' ends.
"""

from __future__ import annotations

import dataclasses
import functools
from typing import Any

import jax
import jax.numpy as jnp

from jaxform import bisection, membrane
from jaxform.blocks import BLOCK, listed, over_blocks, padded
from jaxform.body import NEVER, Body, Mesh, levels, node_room, refined_body, relisted
from jaxform.near import cells
from jaxform.newborn import Births, births_of, settled
from jaxform.scene import STEPS_PER_WINDOW, Forest, Scene
from jaxform.state import Schedule, State, Status, account, any_mode, kinetic_energy

_SPARE_BLOCKS = 2


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
        marked = _marked(state, scene, sheet_body)
        return closure((mesh.split_at != NEVER) | marked, forest, jnp.any(marked))

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


def fitted(scene: Scene, used: int) -> Scene:
    """A scene with room for somewhat more elements than were `used` in a run of it: what is not used takes time too.

    Any scene without refinement is as it was.
    """
    forest = scene.tables.forest
    if forest is None:
        return scene
    return _with_room(scene, min(_SPARE_BLOCKS + -(-used // BLOCK), -(-(forest.root_count << forest.depth) // BLOCK)))


def _with_room(scene: Scene, blocks: int) -> Scene:
    forest, refinement = scene.tables.forest, scene.refinement
    assert forest is not None and refinement is not None
    elements = blocks * BLOCK
    nodes = node_room(elements, forest.first_nodes, forest.owner.size)
    tables = dataclasses.replace(scene.tables, forest=dataclasses.replace(forest, node_room=nodes))
    return dataclasses.replace(scene, tables=tables, refinement=dataclasses.replace(refinement, elements=elements))


def with_more_room(scene: Scene, state: State) -> tuple[Scene, State]:
    """A scene with twice the room for elements, and a state that found too little as it was before it did."""
    refinement, mesh = scene.refinement, state.mesh
    assert refinement is not None and mesh is not None
    scene = _with_room(scene, -(-2 * refinement.elements // BLOCK))
    assert scene.refinement is not None and scene.tables.forest is not None
    elements, nodes = scene.refinement.elements, scene.tables.forest.node_room
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


def closure(split: jax.Array, forest: Forest | bisection.Forest, changed: jax.Array | bool = True) -> jax.Array:
    """Triangles (n_triangle,) that are bisected when those of `split` are, so that no node hangs on a side.

    With a triangle its partner is bisected, and what has bisected parts is so itself. The least such set, so it does
    not depend on the order of the marks. Where nothing has `changed` since it was closed, nothing is done.
    """

    def more(carry: tuple[jax.Array, jax.Array]) -> jax.Array:
        return carry[1]

    def sweep(carry: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        split = carry[0]
        wider = split | split[forest.partner]
        levels, end = [], wider.size
        below = None
        for level in range(forest.depth, -1, -1):
            begin = forest.root_count * ((1 << level) - 1)
            part = wider[begin:end]
            if below is not None:
                part = part | below[0::2] | below[1::2]
            levels.append(part)
            below, end = part, begin
        wider = jnp.concatenate(levels[::-1])
        return wider, jnp.any(wider != split)

    return jax.lax.while_loop(more, sweep, (split, jnp.asarray(changed)))[0]


def _marked(state: State, scene: Scene, sheet_body: Body) -> jax.Array:
    """Triangles (n_triangle,) of the forest that should be bisected for what they and their neighbours look like."""
    state, scene, sheet_body = jax.lax.stop_gradient((state, scene, sheet_body))
    refinement, forest, mesh = scene.refinement, scene.tables.forest, state.mesh
    assert refinement is not None and forest is not None and mesh is not None
    shapes = _shapes(state, scene, sheet_body)
    sheet, fine = sheet_body.sheet, 0.5 * sheet_body.sheet.area < refinement.min_area
    room = padded(mesh.element.size)
    blocks = mesh.element_count // BLOCK + 1

    def work(element: jax.Array, neighbor: jax.Array, own: jax.Array, fine: jax.Array, area: jax.Array) -> Any:
        level = levels(element, forest)
        wanted = _bent(own, neighbor, shapes, refinement.angle) & (level < refinement.max_level)
        if refinement.jump is not None:
            wanted |= _uneven(own, neighbor, shapes, refinement.jump) & (level < refinement.max_level)
        if forest.bend is not None:
            # A bent part of the mold is nearer than the longest side.
            wanted |= (own[4] > 0.0) & (level < refinement.base_level)
        return [[wanted & ~fine & (area > 0.0)]], []

    lists = mesh.element, mesh.neighbor, shapes[:, : mesh.element.size], fine, sheet.area
    inputs = tuple(jnp.pad(x, [(0, 0)] * (x.ndim - 1) + [(0, room - x.shape[-1])]) for x in lists)
    (marks,), _ = over_blocks(work, blocks, inputs, [jnp.zeros((1, room), bool)])
    none = jnp.zeros(forest.bound.size, bool)
    return none.at[jnp.where(marks[0, : mesh.element.size], mesh.element, none.size)].set(True, mode="drop")


def _shapes(state: State, scene: Scene, sheet_body: Body) -> jax.Array:
    """Unit normal, thickness [m], and by how much a bent part of the mold is nearer than the longest side (5, room)."""
    elements, grid, forest = sheet_body.whole.elements, scene.tables.grid, scene.tables.forest
    assert forest is not None
    rows = membrane.rows_of(state.positions)
    thickness = sheet_body.thickness[sheet_body.whole.element]

    def work(triangles: jax.Array, area: jax.Array, thickness: jax.Array) -> Any:
        first, edge1, edge2 = membrane.edges(rows, triangles)
        normal = membrane.cross(edge1, edge2)
        size = jnp.sqrt(jnp.maximum(membrane.dot(normal, normal), jnp.finfo(area.dtype).tiny))
        x, y, z = (component / size for component in normal)
        near = jnp.zeros_like(size)
        if forest.bend is not None and grid is not None:
            third = membrane.minus(edge2, edge1)
            square = functools.reduce(jnp.maximum, (membrane.dot(e, e) for e in (edge1, edge2, third)))
            middle = [p + (a + b) / 3.0 for p, a, b in zip(first, edge1, edge2, strict=True)]
            near = jnp.sqrt(square) - forest.bend[cells(jnp.stack(middle), grid)]
        return [[x, y, z, 2.0 * area * thickness / size, near]], []

    inputs = elements.triangles, elements.area, thickness
    into = [jnp.zeros((5, thickness.size), thickness.dtype)]
    (found,), _ = over_blocks(work, elements.block_count, inputs, into)
    return found


def _bent(own: jax.Array, neighbor: jax.Array, shapes: jax.Array, angle: jax.Array) -> jax.Array:
    """Whether a normal of an element (n,) or of a neighbour is far from the mean of the group's (paper, 3.3)."""
    normal = own[0], own[1], own[2]
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


def _uneven(own: jax.Array, neighbor: jax.Array, shapes: jax.Array, jump: jax.Array) -> jax.Array:
    """Whether an element (n,) is that much thicker or thinner than a neighbour."""
    uneven = jnp.zeros(own.shape[1], bool)
    for side in neighbor:
        other = shapes[3][jnp.maximum(side, 0)]
        ratio = jnp.maximum(other, own[3]) / jnp.minimum(other, own[3])
        uneven |= (side >= 0) & (ratio > 1.0 + jump)
    return uneven


def _grown(state: State, scene: Scene, sheet_body: Body, split: jax.Array) -> tuple[State, Body]:
    """The state with the new nodes, where there is room for all; else its status says so."""
    forest, old = scene.tables.forest, state.mesh
    assert forest is not None and old is not None and sheet_body.volumes is not None
    mesh, fits = _remeshed(old, split, state.windows, forest)
    body = refined_body(scene, mesh, sheet_body.volumes)
    births = births_of(old, mesh, forest)
    new = settled(_born(state, mesh, births, scene, sheet_body.volumes), births, scene)
    # What concerns the account alone carries no derivative.
    (strain, volume), (new_strain, new_volume) = (
        account(*jax.lax.stop_gradient((s.positions, scene, b))) for s, b in ((state, sheet_body), (new, body))
    )
    kinetic, new_kinetic = (
        jax.lax.stop_gradient(kinetic_energy(s, b.mass)) for s, b in ((state, sheet_body), (new, body))
    )
    loss = strain + kinetic - new_strain - new_kinetic
    new = dataclasses.replace(
        new, refinement_loss=state.refinement_loss + loss, volume=state.volume + new_volume - volume
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


def _born(state: State, mesh: Mesh, births: Births, scene: Scene, volumes: jax.Array) -> State:
    """New nodes move as the middles of their edges did; the momentum of all is what it was.

    A bisection takes from the edge's ends the mass of the parts that they do not belong to any more: with velocities
    weighted by these the momentum is kept exactly.
    """
    forest = scene.tables.forest
    assert forest is not None
    new, first, second = births
    weight = _weight(volumes, forest.owner[mesh.node], forest.ends[0, mesh.node], forest)
    reference = scene.parison.positions[mesh.node].T
    moved = state.positions - reference

    def between(values: tuple[jax.Array, jax.Array], _: None) -> tuple[tuple[jax.Array, jax.Array], None]:
        moved, velocities = values
        mean = 0.5 * (moved[:, first] + moved[:, second])
        mixed = weight * velocities[:, first] + (1.0 - weight) * velocities[:, second]
        return (jnp.where(new, mean, moved), jnp.where(new, mixed, velocities)), None

    # A new node can be the end of a newer one: as often as there can be generations at one border.
    (moved, velocities), _ = jax.lax.scan(between, (moved, state.velocities), length=forest.depth)
    held = new & jnp.all(forest.mobility[:, mesh.node] == 0.0, axis=0)
    free = new & ~held
    positions = jnp.where(new, reference + jnp.where(held, 0.0, moved), state.positions)
    return dataclasses.replace(
        state,
        positions=positions,
        velocities=jnp.where(held, 0.0, velocities),
        stuck=jnp.where(free, False, state.stuck),
        contact_time=jnp.where(free, -1.0, jnp.where(held, 0.0, state.contact_time)),
        mode=None if state.mode is None else _with_noise(state.mode, new),
        rate=jnp.zeros_like(state.rate),
        mesh=mesh,
    )


def _with_noise(mode: jax.Array, new: jax.Array) -> jax.Array:
    """A mode (3, n) in which the new nodes move without a pattern: between their neighbours they would hide theirs."""
    return jnp.where(new, jnp.max(jnp.where(new, 0.0, jnp.abs(mode))) * any_mode(mode), mode)


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

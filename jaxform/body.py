"""The sheet as it is worked through: elements, masses, and which triangles of the forest there are."""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp

from jaxform import membrane
from jaxform.blocks import listed
from jaxform.packing import Packed, pack
from jaxform.pytree import pytree
from jaxform.scene import Assembly, Forest, Scene, Sheet

NEVER = jnp.iinfo(jnp.int32).max


@pytree
class Mesh:
    """Which triangles of the forest there are, in lists that are rebuilt only when some are bisected.

    Attributes:
        split_at: The window (n_triangle,) at whose border each triangle was bisected; NEVER where it was not.
        element: The triangles in use (element_room,), then others.
        neighbor: Across each element's sides (3, element_room), -1 where there is none.
        element_count: How many are in use.
        node: The node at each place (node_room,), in the order in which they came to be.
        place: The place of each node (n_node,); 0 where there is no such node.
        node_count: How many there are.
    """

    split_at: jax.Array
    element: jax.Array
    neighbor: jax.Array
    element_count: jax.Array
    node: jax.Array
    place: jax.Array
    node_count: jax.Array


@pytree
class Body:
    """The sheet as it is worked through: without refinement the same over a run, with it until elements are added.

    What is not in use has the area 0.

    Attributes:
        sheet: Initial geometry of the elements.
        assembly: How nodes gather their force.
        bound: Largest eigenvalue of each element's shape gradients (n_element,) [1/m^2], for the stable step.
        thickness: Initial thickness of the elements (n_element,) [m].
        mass: Lumped mass of the nodes (n_node,) [kg], with what fine elements are given to keep the step long.
        compliance: Mobility over mass (3, n_node) [1/kg].
        whole: All elements and nodes, packed.
        volumes: Of all triangles of the forest (n_triangle,) [m^3]; None without one.
    """

    sheet: Sheet
    assembly: Assembly
    bound: jax.Array
    thickness: jax.Array
    mass: jax.Array
    compliance: jax.Array
    whole: Packed
    volumes: jax.Array | None = None


def body(scene: Scene) -> Body:
    """The sheet of a scene; of a refined one as it is at first."""
    tables = scene.tables
    if tables.forest is not None:
        return refined_body(scene, first_mesh(scene), forest_volumes(scene))
    sheet = tables.sheet
    thickness = membrane.element_mean(scene.parison.thickness, sheet.triangles)
    share = scene.material.density * sheet.area * thickness / 3.0
    mass = membrane.sum_to_nodes(share, sheet.triangles, scene.parison.thickness.size)
    whole = pack(None, sheet, tables.assembly)
    return Body(sheet, tables.assembly, tables.bound, thickness, mass, tables.mobility / mass, whole)


def present_body(scene: Scene, mesh: Mesh | None, first: Body) -> Body:
    """The sheet as it is with a mesh, from what it was at first."""
    return first if mesh is None or first.volumes is None else refined_body(scene, mesh, first.volumes)


def forest_volumes(scene: Scene) -> jax.Array:
    """Volume (n_triangle,) [m^3] of the forest's triangles: at the deepest level from the nodes' thickness.

    Above, the sum of the parts: no bisection makes or loses mass, and coarse elements know the whole profile.
    """
    forest = scene.tables.forest
    assert forest is not None
    deepest = forest.root_count << forest.depth
    sheet = forest.sheet
    thickness = membrane.element_mean(scene.parison.thickness, sheet.triangles[:, -deepest:])
    levels = [sheet.area[-deepest:] * thickness]
    for _ in range(forest.depth):
        levels.append(levels[-1][0::2] + levels[-1][1::2])
    return jnp.concatenate(levels[::-1])


def first_mesh(scene: Scene) -> Mesh:
    """The mesh before it is refined."""
    forest, refinement = scene.tables.forest, scene.refinement
    assert forest is not None and refinement is not None
    node = jnp.arange(forest.node_room, dtype=jnp.int32)
    node_count = forest.ends.shape[1]
    place = jnp.arange(node_count, dtype=jnp.int32)
    none = jnp.full(forest.sheet.area.size, NEVER, jnp.int32)
    mesh = Mesh(
        split_at=none,
        element=jnp.zeros(refinement.elements, jnp.int32),
        neighbor=jnp.zeros((3, refinement.elements), jnp.int32),
        element_count=jnp.int32(0),
        node=jnp.where(node < forest.first_nodes, node, 0),
        place=jnp.where(place < forest.first_nodes, place, 0),
        node_count=jnp.int32(forest.first_nodes),
    )
    return relisted(mesh, forest)


def relisted(mesh: Mesh, forest: Forest) -> Mesh:
    """The lists of elements and neighbours anew, from what is bisected."""
    active = _active(mesh.split_at, forest)
    room = mesh.element.size
    element, count = listed(active, room)
    used = jnp.arange(room) < count
    # What is not in use is a copy of the first element, without area.
    element = jnp.where(used, element, element[0])
    number = jnp.arange(room, dtype=jnp.int32)
    half_edge = forest.half_edges[:, element]
    owner = jnp.full(forest.half_edge_count, -1, jnp.int32)
    for side in half_edge:
        owner = owner.at[jnp.where(used, side, owner.size)].set(number, mode="drop", unique_indices=True)
    neighbor = jnp.where(used, owner[half_edge ^ 1], -1)
    return dataclasses.replace(mesh, element=element, neighbor=neighbor, element_count=count)


def node_room(elements: int, first_nodes: int, most: int) -> int:
    """Room for nodes that goes with that for elements: a cut brings two elements or, at a rim, one, and one node."""
    return min(first_nodes + 64 + int(0.6 * elements), most)


def levels(triangle: jax.Array, forest: Forest) -> jax.Array:
    """Of triangles (n,) of the forest."""
    begins = [forest.root_count * ((1 << level) - 1) for level in range(1, forest.depth + 1)]
    return jnp.searchsorted(jnp.asarray(begins, jnp.int32), triangle, side="right").astype(jnp.int32)


def _active(split_at: jax.Array, forest: Forest) -> jax.Array:
    """Triangles (n_triangle,) that are in use: their parent is bisected, they are not."""
    split = split_at != NEVER
    inner = split[: split.size - (forest.root_count << forest.depth)]
    there = jnp.concatenate([jnp.ones(forest.root_count, bool), jnp.repeat(inner, 2)])
    return there & ~split


def refined_body(scene: Scene, mesh: Mesh, volumes: jax.Array) -> Body:
    """The sheet of the elements that a mesh lists."""
    forest = scene.tables.forest
    assert forest is not None
    element = mesh.element
    used = jnp.arange(element.size) < mesh.element_count
    exists = jnp.arange(mesh.node.size) < mesh.node_count
    sheet = Sheet(
        triangles=mesh.place[forest.sheet.triangles[:, element]],
        inverse_metric=forest.sheet.inverse_metric[:, element],
        area=jnp.where(used, forest.sheet.area[element], 0.0),
        origin=forest.sheet.origin,
    )
    volume = volumes[element]
    share = jnp.where(used, forest.heavier[element] * scene.material.density * volume / 3.0, 0.0)
    mass = membrane.sum_to_nodes(share, sheet.triangles, mesh.node.size)
    heavy = jnp.where(exists, mass, 1.0)
    assembly = _assembly(sheet, forest.corner_slots[:, element], used, mesh.node.size, forest.slot_count)
    return Body(
        sheet=sheet,
        assembly=assembly,
        bound=forest.bound[element],
        thickness=volume / forest.sheet.area[element],
        mass=heavy,
        compliance=jnp.where(exists, forest.mobility[:, mesh.node] / heavy, 0.0),
        whole=pack(None, sheet, assembly, (mesh.element_count, mesh.node_count)),
        volumes=volumes,
    )


def _assembly(sheet: Sheet, slots: jax.Array, used: jax.Array, node_count: int, slot_count: int) -> Assembly:
    """As `packing.make_assembly`, in the program: the slots that are taken at each node are moved together."""
    taken = jnp.zeros((slot_count, node_count), jnp.int32)
    for slot, node in zip(slots, sheet.triangles, strict=True):
        taken = taken.at[jnp.where(used, slot, slot_count), node].set(1, mode="drop")
    rank = jnp.cumsum(taken, axis=0) - 1
    table = jnp.full((slot_count, node_count), -1, jnp.int32)
    code = 4 * jnp.arange(used.size, dtype=jnp.int32)
    for corner, (slot, node) in enumerate(zip(slots, sheet.triangles, strict=True)):
        row = jnp.where(used, rank[slot, node], slot_count)
        table = table.at[row, node].set(code + corner, mode="drop")
    none = jnp.zeros(0, jnp.int32)
    return Assembly(table, none, none)

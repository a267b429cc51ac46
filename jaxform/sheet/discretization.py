"""The discretization of the sheet: elements, masses, and the present triangles of the forest."""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp

from jaxform.core.pytree import pytree
from jaxform.materials import Law, Modes
from jaxform.mechanics import membrane
from jaxform.model.scene import Adaptivity, Scene
from jaxform.model.tables import Assembly, BisectionHierarchy, Counts, ReferenceGeometry
from jaxform.sheet.heat import ThermalState, at_temperature
from jaxform.sheet.packing import Packed, pack

NEVER = jnp.iinfo(jnp.int32).max


@pytree
class RefinedMesh:
    """The triangles of the forest that are in use, in lists that grow with each bisection.

    Attributes:
        split_at: Window at whose begin each triangle was bisected (n_triangle,); NEVER for the others.
        element: The triangles in use (element_capacity,), then others.
        element_count: Number of triangles in use.
        node: The node at each place (node_capacity,), in the order in which they came to be.
        place: The place of each node (n_node,); 0 where there is no such node.
        node_count: Number of nodes.
        side: The element with each half edge (n_half_edge,), -1 where there is none. None where derivatives are taken,
            which would keep it for each window: it is as long as the forest, and made anew where it is needed.
        corner: Four times the element, and its corner, of those at each place (valence, node_capacity); -1 beyond them.
        corner_count: Number of corners at each place (node_capacity,).
        row: The row of `corner` in which each element's corners are (3, element_capacity).
    """

    split_at: jax.Array
    element: jax.Array
    element_count: jax.Array
    node: jax.Array
    place: jax.Array
    node_count: jax.Array
    side: jax.Array | None
    corner: jax.Array
    corner_count: jax.Array
    row: jax.Array

    @property
    def sides(self) -> jax.Array:
        """The element with each half edge, where that is known."""
        assert self.side is not None
        return self.side


def element_law(material: Law, zones: dict[str, jax.Array], modes: Modes | None) -> Law:
    """The material model of elements, with their varying parameters and, where given, Prony terms."""
    made = material.with_zones(zones)
    return made if modes is None else dataclasses.replace(made, viscous=modes)


@pytree
class Discretization:
    """The discretization of the sheet: constant over a run without refinement, else until elements are added.

    Unused elements have the area 0.

    Attributes:
        sheet: Initial geometry of the elements.
        assembly: Table of the element corners at each node, for the nodal sums.
        bound: Largest eigenvalue of each element's shape gradients (n_element,) [1/m^2], for the stable step.
        thickness: Initial thickness of the elements (n_element,) [m].
        zones: Numbers of the law that vary over the sheet, of the elements (..., n_element), by name.
        mass: Lumped mass of the nodes (n_node,) [kg], with what fine elements are given to keep the step long.
        compliance: Mobility over mass (3, n_node) [1/kg].
        whole: All elements and nodes, packed.
        volumes: Volumes of all triangles of the forest (n_triangle,) [m^3]; None without refinement.
        forest_zones: Numbers of the material that vary, of all triangles of the forest.
        forest_temperature: Initial temperature of these triangles (n_triangle,) [degC]; None where it has no effect.
        modes: Prony terms of each element (n_mode, n_element); None where they do not vary.
        temperature: Initial temperature of the elements (n_element,) [degC]; None where the sheet does not cool. With
            it, zones and modes are those at the reference temperature.
    """

    sheet: ReferenceGeometry
    assembly: Assembly
    bound: jax.Array
    thickness: jax.Array
    zones: dict[str, jax.Array]
    mass: jax.Array
    compliance: jax.Array
    whole: Packed
    volumes: jax.Array | None = None
    forest_zones: dict[str, jax.Array] = dataclasses.field(default_factory=dict)
    forest_temperature: jax.Array | None = None
    modes: Modes | None = None
    temperature: jax.Array | None = None

    def with_zones(self, heat: ThermalState | None, material: Law) -> Discretization:
        """The discretization with the material parameters at the present temperature of the elements."""
        if heat is None or self.temperature is None:
            return self
        zones, modes = at_temperature(material, self.zones, self.temperature + heat.felt)
        return dataclasses.replace(self, zones=zones, modes=modes, temperature=None)

    @property
    def forest_properties(self) -> ForestProperties:
        """The properties of the forest's triangles, for a sheet that is refined."""
        assert self.volumes is not None
        return self.volumes, self.forest_zones, self.forest_temperature

    def of_elements(self, element: jax.Array) -> tuple[jax.Array, dict[str, jax.Array], Modes | None]:
        """The properties of the elements with these numbers (n,).

        Returns:
            Initial thickness (n,) [m], varying material parameters (..., n), and varying modes; None of others.
        """
        zones, modes = jax.tree.map(lambda own: own[..., element], (self.zones, self.modes))
        return self.thickness[element], zones, modes


def discretize(scene: Scene) -> Discretization:
    """The initial discretization of a scene's sheet."""
    tables = scene.tables
    if scene.adaptivity is not None:
        _, forest = scene.adaptivity
        volumes, mesh = _volumes(scene, forest), first_mesh(scene, scene.adaptivity)
        nodal = scene.material.zones, _nodal_temperature(scene)
        zones, temperature = jax.tree.map(lambda own: _forest_mean(own, forest, volumes), nodal)
        return refined_discretization(scene, forest, mesh, (volumes, zones, temperature))
    sheet = tables.sheet
    thickness = membrane.element_mean(scene.parison.thickness, sheet.triangles)
    zones = {name: membrane.element_mean(own, sheet.triangles) for name, own in scene.material.zones.items()}
    warmth = _nodal_temperature(scene)
    warmth = None if warmth is None else membrane.element_mean(warmth, sheet.triangles)
    zones, modes, warmth = _initial_properties(scene, zones, warmth)
    share = zones.get("density", scene.material.density) * sheet.area * thickness / 3.0
    mass = membrane.sum_to_nodes(share, sheet.triangles, scene.parison.thickness.size)
    if tables.counts is not None:
        mass = jnp.where(jnp.arange(mass.size) < tables.counts.nodes, mass, 1.0)
    whole = pack(None, sheet, tables.assembly, tables.counts, stepped=not scene.packs_moving)
    compliance = tables.mobility / mass[None]
    own = sheet, tables.assembly, tables.bound, thickness, zones, mass, compliance, whole
    return Discretization(*own, modes=modes, temperature=warmth)


def present_discretization(
    scene: Scene, mesh: RefinedMesh | None, first: Discretization, *, stepped: bool = False
) -> Discretization:
    """The discretization with a refined mesh; without one, the initial discretization.

    Args:
        scene: The scene.
        mesh: The refined mesh; None without refinement.
        first: The initial discretization.
        stepped: True if all elements together are advanced by steps, not an active set alone.
    """
    if mesh is None or first.volumes is None or scene.adaptivity is None:
        return first
    _, forest = scene.adaptivity
    return refined_discretization(scene, forest, mesh, first.forest_properties, stepped=stepped)


ForestProperties = tuple[jax.Array, dict[str, jax.Array], jax.Array | None]
"""Properties of each forest triangle: volume [m^3], varying material parameters, and temperature [degC]."""


def _nodal_temperature(scene: Scene) -> jax.Array | None:
    """The temperature of the nodes (n_node,) [degC], where it matters."""
    return None if scene.material.shift is None and scene.cooling is None else scene.parison.temperature


def _initial_properties(
    scene: Scene, zones: dict[str, jax.Array], temperature: jax.Array | None
) -> tuple[dict[str, jax.Array], Modes | None, jax.Array | None]:
    """Zones, modes and temperature as `Discretization` has them, of elements with these zones and temperatures."""
    if scene.cooling is not None:
        return zones, None, temperature
    return *at_temperature(scene.material, zones, temperature), None


def _volumes(scene: Scene, forest: BisectionHierarchy) -> jax.Array:
    """Volume (n_triangle,) [m^3] of the forest's triangles: at the deepest level from the nodes' thickness.

    Above, the sum of the parts: no bisection makes or loses mass, and coarse elements know the whole profile.
    """
    deepest = forest.root_count << forest.depth
    sheet = forest.sheet
    thickness = membrane.element_mean(scene.parison.thickness, sheet.triangles[:, -deepest:])
    levels = [sheet.area[-deepest:] * thickness]
    for _ in range(forest.depth):
        levels.append(levels[-1][0::2] + levels[-1][1::2])
    return jnp.concatenate(levels[::-1])


def _forest_mean(nodal: jax.Array, forest: BisectionHierarchy, volumes: jax.Array) -> jax.Array:
    """Mean of nodal values (..., n_node) over each triangle of the forest, with volumes (n_triangle,) [m^3].

    At the deepest level from the nodes' values; above, the mean of the parts, weighted by their volume, so that no
    bisection makes or loses mass.
    """
    deepest = forest.root_count << forest.depth
    weighted = [membrane.element_mean(nodal, forest.sheet.triangles[:, -deepest:]) * volumes[-deepest:]]
    for _ in range(forest.depth):
        weighted.append(weighted[-1][..., 0::2] + weighted[-1][..., 1::2])
    there = volumes > 0.0  # beyond the first triangles there may be room
    mean = jnp.concatenate(weighted[::-1], axis=-1) / jnp.where(there, volumes, 1.0)
    return jnp.where(there, mean, jax.lax.stop_gradient(nodal[..., :1]))


def first_mesh(scene: Scene, adaptivity: Adaptivity) -> RefinedMesh:
    """The mesh before it is refined."""
    limits, forest = adaptivity
    capacity = limits.elements
    roots = jnp.arange(forest.root_count, dtype=jnp.int32)
    counts = scene.tables.counts or Counts(jnp.int32(forest.root_count), jnp.int32(forest.first_nodes))
    node = jnp.arange(forest.node_capacity, dtype=jnp.int32)
    place = jnp.arange(forest.owner.size, dtype=jnp.int32)
    corner, row = 4 * roots[None] + jnp.arange(3, dtype=jnp.int32)[:, None], forest.root_row
    # Entries beyond the first triangles are dropped.
    there = roots < counts.elements
    at = jnp.where(there, forest.sheet.triangles[:, : forest.root_count], node.size)
    element = jnp.zeros(capacity, jnp.int32).at[roots].set(jnp.where(there, roots, 0))
    return RefinedMesh(
        split_at=jnp.full(forest.bound.size, NEVER, jnp.int32),
        element=element,
        element_count=counts.elements,
        node=jnp.where(node < counts.nodes, node, 0),
        place=jnp.where(place < counts.nodes, place, 0),
        node_count=counts.nodes,
        side=half_edge_elements(element, counts.elements, forest),
        corner=jnp.full((forest.valence, node.size), -1, jnp.int32).at[row, at].set(corner, mode="drop"),
        corner_count=jnp.zeros(node.size, jnp.int32).at[at].add(1, mode="drop"),
        row=jnp.zeros((3, capacity), jnp.int32).at[:, : roots.size].set(row),
    )


def half_edge_elements(element: jax.Array, count: jax.Array, forest: BisectionHierarchy) -> jax.Array:
    """The element (capacity,) at each half edge, as `RefinedMesh.side`; `count` elements are in use."""
    number = jnp.arange(element.size, dtype=jnp.int32)
    there = jnp.where(number < count, forest.half_edges[:, element], forest.half_edge_count)
    return jnp.full(forest.half_edge_count, -1, jnp.int32).at[there].set(number, mode="drop")


def refined_node_capacity(elements: int, first_nodes: int, most: int) -> int:
    """Room for nodes that goes with that for elements: a cut brings two elements or, at a rim, one, and one node."""
    return min(first_nodes + 64 + int(0.6 * elements), most)


def element_levels(triangle: jax.Array, forest: BisectionHierarchy) -> jax.Array:
    """The refinement level of each triangle (n,) of the forest."""
    begins = [forest.root_count * ((1 << level) - 1) for level in range(1, forest.depth + 1)]
    return jnp.searchsorted(jnp.asarray(begins, jnp.int32), triangle, side="right").astype(jnp.int32)


def refined_discretization(
    scene: Scene,
    forest: BisectionHierarchy,
    mesh: RefinedMesh,
    properties: ForestProperties,
    *,
    stepped: bool = False,
) -> Discretization:
    """The sheet of the elements that a mesh lists, from what the forest's triangles are made of."""
    element = mesh.element
    used = jnp.arange(element.size) < mesh.element_count
    exists = jnp.arange(mesh.node.size) < mesh.node_count
    sheet = ReferenceGeometry(
        triangles=mesh.place[forest.sheet.triangles[:, element]],
        inverse_metric=forest.sheet.inverse_metric[:, element],
        area=jnp.where(used, forest.sheet.area[element], 0.0),
        origin=forest.sheet.origin,
        regions=None if forest.sheet.regions is None else forest.sheet.regions[:, element],
    )
    volumes, forest_zones, temperature = properties
    volume = volumes[element]
    zones = {name: own[..., element] for name, own in forest_zones.items()}
    warmth = None if temperature is None else temperature[element]
    zones, modes, warmth = _initial_properties(scene, zones, warmth)
    density = zones.get("density", scene.material.density)
    share = jnp.where(used, forest.mass_scale[element] * density * volume / 3.0, 0.0)
    mass = membrane.sum_to_nodes(share, sheet.triangles, mesh.node.size)
    heavy = jnp.where(exists, mass, 1.0)
    none = jnp.zeros(0, jnp.int32)
    assembly, counts = Assembly(mesh.corner, none, none), Counts(mesh.element_count, mesh.node_count)
    return Discretization(
        sheet=sheet,
        assembly=assembly,
        bound=forest.bound[element],
        thickness=volume / forest.sheet.area[element],
        zones=zones,
        mass=heavy,
        compliance=jnp.where(exists[None], forest.mobility[:, mesh.node] / heavy[None], 0.0),
        whole=pack(None, sheet, assembly, counts, stepped=stepped or not scene.packs_moving),
        volumes=volumes,
        forest_zones=forest_zones,
        forest_temperature=temperature,
        modes=modes,
        temperature=warmth,
    )

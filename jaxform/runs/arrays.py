"""The parts of a scene in arrays padded to capacity: on the host, in NumPy."""

from __future__ import annotations

import dataclasses
from typing import Any, NamedTuple

import numpy as np

from jaxform.core.pytree import as_index, nodal_parameter_names
from jaxform.kernels import capacities
from jaxform.loads import Loading, Pressure, RegionalLoad
from jaxform.materials import Law
from jaxform.model.field import Field
from jaxform.model.scene import Parison, Refinement
from jaxform.model.tables import Assembly, Bend, BisectionHierarchy, ElementPairs, ReferenceGeometry, Rim
from jaxform.sheet.discretization import NEVER, refined_node_capacity
from jaxform.tools.mold import FAR_LATER, Mold, Motion
from jaxform.tools.search import CLASSES, SearchGrid


class Order(NamedTuple):
    """Places of a scene's nodes (n_node,), and of its forest's triangles (n_triangle,), in a padded scene.

    Also the capacities for elements and for nodes before the mesh is refined, then for all nodes and triangles.
    """

    node: np.ndarray
    triangle: np.ndarray | None
    elements: int
    first_nodes: int
    node_capacity: int
    triangle_capacity: int


def pad_values(values: Any, capacity: int, fill: Any) -> Any:
    """Values (..., n), padded to capacity."""
    values = np.asarray(values)
    if values.shape[-1] == capacity:
        return values
    new = np.full((*values.shape[:-1], capacity), fill, values.dtype)
    new[..., : values.shape[-1]] = values
    return new


def scatter_values(values: Any, place: np.ndarray, capacity: int, fill: Any) -> Any:
    """Values (..., n) at places (n,) of a padded array, and `fill` elsewhere."""
    values = np.asarray(values)
    if len(place) == capacity:
        return values
    new = np.full((*values.shape[:-1], capacity), fill, values.dtype)
    new[..., place] = values
    return new


def pad_with_first(values: Any, capacity: int) -> Any:
    """Values (..., n), padded to capacity with the first one."""
    values = np.asarray(values)
    new = np.empty((*values.shape[:-1], capacity), values.dtype)
    new[..., : values.shape[-1]] = values
    new[..., values.shape[-1] :] = values[..., :1]
    return new


def pad_nodal(values: Any, order: Order, fill: Any) -> Any:
    """Values (..., n_node) in the order of the padded nodes, and a fill value at the others."""
    return scatter_values(values, order.node, order.node_capacity, fill)


def pad_parison(parison: Parison, elements: int, order: Order) -> Parison:
    """The padded parison; padded nodes are at the place of the first one, and clamped."""
    positions = np.asarray(parison.positions)
    there = pad_nodal(np.ones(len(order.node), bool), order, False)
    places: Any = np.where(there, pad_nodal(positions.T, order, 0.0), positions[:1].T).T

    def like_first_node(values: Any) -> Any:
        return np.where(there, pad_nodal(values, order, 0.0), np.asarray(values)[0])

    return Parison(
        positions=places,
        triangles=pad_with_first(order.node[np.asarray(parison.triangles)].T, elements).T.astype(np.int32),
        thickness=like_first_node(parison.thickness),
        clamped=pad_nodal(parison.clamped, order, True),
        fixed=pad_nodal(np.asarray(parison.fixed).T, order, True).T,
        temperature=None if parison.temperature is None else like_first_node(parison.temperature),
        pre_stretch=parison.pre_stretch,
        clamp_until=parison.clamp_until,
    )


def pad_material(material: Law, order: Order) -> Law:
    """The material model; at padded nodes, its zones are as at the first node."""
    there = pad_nodal(np.ones(len(order.node), bool), order, False)

    def pad_zone(own: Any) -> Any:
        values = np.asarray(own)
        return np.where(there, pad_nodal(values, order, 0.0), values[..., :1])

    return material.with_zones({name: pad_zone(own) for name, own in material.zones.items()})


def pad_sheet(sheet: ReferenceGeometry, capacity: int, order: Order) -> ReferenceGeometry:
    """The padded geometry; padded elements are at the place of the first one, and have no area."""
    return ReferenceGeometry(
        triangles=pad_with_first(order.node[np.asarray(sheet.triangles)].astype(np.int32), capacity),
        inverse_metric=pad_with_first(sheet.inverse_metric, capacity),
        area=pad_values(sheet.area, capacity, 0.0),
        origin=sheet.origin,
        regions=None if sheet.regions is None else pad_values(sheet.regions, capacity, False),
    )


def pad_initial_contact(contact: Any, order: Order) -> Any:
    """Initial contact of the nodes, padded; none at any node where the scene has none."""
    return pad_nodal(np.zeros(len(order.node), np.int32) if contact is None else contact, order, 0)


def pad_rim(rim: Rim, order: Order) -> Rim:
    """The padded rim; padded edges begin and end at one node."""
    ends, triangle = order.node[np.asarray(rim.ends)].astype(np.int32), rim.triangle
    capacity = capacities.rim_edge_capacity(ends.shape[1])
    if triangle is not None and order.triangle is not None:
        triangle = pad_values(order.triangle[np.asarray(triangle)].astype(np.int32), capacity, 0)
    return Rim(pad_values(ends, capacity, 0), triangle)


def pad_assembly(assembly: Assembly, elements: int, nodes: int) -> Assembly:
    """The table by which nodes gather forces, padded; nothing is gathered from padded elements."""
    table, rows = np.asarray(assembly.table), capacities.table_row_capacity(len(assembly.table))
    deep: Any = np.full((rows, nodes), -1, np.int32)
    deep[: table.shape[0], : table.shape[1]] = table
    overflow = capacities.overflow_capacity(len(assembly.overflow))
    pairs = assembly.pairs
    if pairs is not None:
        capacity = capacities.pair_capacity(pairs.element.shape[1], elements)
        pair: Any = np.asarray(pairs.element)
        # A padded pair has one padded element and no other.
        first, second = pad_values(pair[0], capacity, elements - 1), pad_values(pair[1], capacity, -1)
        both: Any = np.stack([first, second])
        pairs = ElementPairs(
            element=both,
            pair=pad_values(pairs.pair, elements, capacity - 1),
            triangles=pad_with_first(pairs.triangles, elements),
            inverse_metric=pad_with_first(pairs.inverse_metric, elements),
            orientation=pad_values(pairs.orientation, elements, 1.0),
        )
    return Assembly(
        table=deep,
        overflow_node=pad_values(assembly.overflow_node, overflow, nodes - 1),
        overflow=pad_values(assembly.overflow, overflow, -1),
        pairs=pairs,
    )


def pad_field(field: Field, order: Order) -> Field:
    """The field with its nodal values, and the first node's value at padded nodes."""
    there = pad_nodal(np.ones(len(order.node), bool), order, False)
    new = {}
    for name in nodal_parameter_names(field):
        values = np.asarray(getattr(field, name))
        new[name] = np.where(there, pad_nodal(values, order, 0.0), values[0]) if values.ndim else values
    made: Any = dataclasses.replace(field, **new)  # pyright: ignore
    return made


def pad_pressure(pressure: Loading) -> Loading:
    """The pressure with padded knots long after the last one, of the same value; of regions without their names."""
    if isinstance(pressure, RegionalLoad):
        return dataclasses.replace(pressure, loads=tuple(map(pad_pressure, pressure.loads)), names=(), regions=None)
    if not isinstance(pressure, Pressure):
        return pressure
    time, value = extend_knots(np.asarray(pressure.time), np.asarray(pressure.value))
    return dataclasses.replace(pressure, time=time, value=value)


def extend_knots(time: np.ndarray, value: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Knots, and further ones of the last value long after."""
    more = capacities.knot_capacity(len(time)) - len(time)
    later = time[-1] + FAR_LATER * max(1.0, abs(float(time[-1]))) * np.arange(1, more + 1)
    return np.append(time, later.astype(time.dtype)), np.append(value, np.full(more, value[-1]))


def pad_mold(mold: Mold) -> Mold:
    """The padded mold; padded triangles and vertices are copies of the first one."""
    triangles = capacities.mold_triangle_capacity(len(mold.triangles))
    vertices = capacities.node_capacity(len(mold.vertices), triangles)
    return Mold(
        vertices=pad_with_first(np.asarray(mold.vertices).T, vertices).T,
        triangles=pad_with_first(np.asarray(mold.triangles).T, triangles).T,
        motion=None if mold.motion is None else _pad_motion(mold.motion),
        contact=mold.contact,
        temperature=mold.temperature,
        heat_transfer=mold.heat_transfer,
    )


def pad_neighbors(neighbors: Any) -> Any:
    """The padded table of neighbors; padded triangles have none."""
    return pad_values(np.asarray(neighbors).T, capacities.mold_triangle_capacity(len(neighbors)), 0).T


def pad_edges(edges: Any) -> Any:
    """The padded sharp edges of a tool; padded ones have no length."""
    return pad_values(edges, capacities.sharp_edge_capacity(np.shape(edges)[1]), 0)


def _pad_motion(motion: Motion) -> Motion:
    time, displacement = extend_knots(np.asarray(motion.time), np.asarray(motion.displacement))
    return dataclasses.replace(motion, time=time, displacement=displacement)


def pad_grid(grid: SearchGrid) -> SearchGrid:
    """The padded grid; no cell lists a padded triangle."""
    cells = max(grid.bound.size, 0 if grid.far is None else grid.far.start.size)
    capacity, rows = capacities.cell_capacity(cells), capacities.mold_triangle_capacity(grid.number.size)
    far = grid.far
    if far is not None:
        far = dataclasses.replace(
            far, start=pad_values(far.start, capacity + 1, 0), ends=pad_values(far.ends, CLASSES * capacity, 0)
        )
    return SearchGrid(
        corner=grid.corner,
        width=grid.width,
        reach=grid.reach,
        size=grid.size,
        bound=pad_values(grid.bound, capacity, 0.0),
        start=pad_values(grid.start, capacity + 1, 0),
        ends=pad_values(grid.ends, CLASSES * capacity, 0),
        listed=pad_values(grid.listed, capacities.cell_list_capacity(grid.listed.size), 0),
        number=pad_values(grid.number, rows, 0),
        outlines=pad_with_first(np.asarray(grid.outlines).T, rows).T,
        frames=pad_with_first(np.asarray(grid.frames).T, rows).T,
        far=far,
        shape=grid.shape,
    )


def forest_order(forest: BisectionHierarchy, roots: int) -> Order:
    """The padded order of a forest: at each level, the first triangles' parts come first, as do the first nodes."""
    levels = np.arange(forest.depth + 1)
    begin, size = forest.root_count * ((1 << levels) - 1), forest.root_count << levels
    triangle = np.arange(forest.partner.size) + np.repeat(roots * ((1 << levels) - 1) - begin, size)
    capacity = roots * ((1 << (forest.depth + 1)) - 1)
    count, first = forest.owner.size, forest.first_nodes
    first_capacity = capacities.node_capacity(first, roots)
    node = np.arange(count) + np.where(np.arange(count) < first, 0, first_capacity - first)
    node_capacity = first_capacity + capacities.node_capacity(count - first, roots << forest.depth)
    return Order(node, triangle, roots, first_capacity, node_capacity, capacity)


def pad_forest(forest: BisectionHierarchy, refinement: Refinement, order: Order) -> BisectionHierarchy:
    """The padded forest; its padded triangles have no area and no parts."""
    assert order.triangle is not None
    place, capacity, node = order.triangle, order.triangle_capacity, order.node
    roots, first = order.elements, order.first_nodes

    def scatter_triangles(values: Any, fill: Any) -> Any:
        return scatter_values(values, place, capacity, fill)

    def pad_triangles(values: Any) -> Any:
        values = np.asarray(values)
        new = np.empty((*values.shape[:-1], capacity), values.dtype)
        new[...] = values[..., :1]
        new[..., place] = values
        return new

    partner = np.arange(capacity, dtype=np.int32)
    partner[place] = place[np.asarray(forest.partner)]
    middle = np.asarray(forest.middle)
    edges = capacities.half_edge_capacity(forest.half_edge_count, capacity)
    ends = np.tile(np.arange(order.node_capacity, dtype=np.int32), (2, 1))
    ends[:, node] = node[np.asarray(forest.ends)]
    fine, bend = forest.fine_at_once, forest.bend
    if fine is not None:
        fine = pad_values(place[np.asarray(fine)].astype(np.int32), capacities.bucket_size(fine.size, 256), NEVER)
    if bend is not None:
        bend = Bend(pad_values(bend.distance, capacities.bend_part_capacity(bend.distance.size), 0.0), bend.parts)
    return BisectionHierarchy(
        sheet=ReferenceGeometry(
            triangles=pad_triangles(node[np.asarray(forest.sheet.triangles)].astype(np.int32)),
            inverse_metric=pad_triangles(forest.sheet.inverse_metric),
            area=scatter_triangles(forest.sheet.area, 0.0),
            origin=forest.sheet.origin,
            regions=None if forest.sheet.regions is None else scatter_triangles(forest.sheet.regions, False),
        ),
        bound=pad_triangles(forest.bound),
        mass_scale=pad_triangles(forest.mass_scale),
        partner=as_index(partner),
        middle=scatter_triangles(np.where(middle >= 0, node[middle], -1).astype(np.int32), -1),
        half_edges=scatter_triangles(forest.half_edges, edges - 2),
        root_row=pad_values(forest.root_row, roots, 0),
        ends=as_index(ends),
        owner=pad_nodal(place[np.asarray(forest.owner)].astype(np.int32), order, 0),
        mobility=pad_nodal(forest.mobility, order, 0.0),
        bend=bend,
        fine_at_once=fine,
        root_count=roots,
        depth=forest.depth,
        first_nodes=first,
        half_edge_count=edges,
        valence=capacities.valence_capacity(forest.valence),
        node_capacity=capacities.staggered_capacity(
            refined_node_capacity(refinement.elements, first, order.node_capacity)
        ),
    )

"""The parts of a scene in arrays with room: on the host, in NumPy."""

from __future__ import annotations

import dataclasses
from typing import Any, NamedTuple

import numpy as np

from jaxform.core.parameters import nodal_numbers
from jaxform.core.pytree import as_index
from jaxform.kernels import sizes
from jaxform.loads import Loading, Pressure
from jaxform.materials import Law
from jaxform.model.field import Field
from jaxform.model.scene import Parison, Refinement
from jaxform.model.tables import Assembly, Bend, Forest, Pairs, Rim, Sheet
from jaxform.sheet.discretization import NEVER, node_room
from jaxform.tools.mold import Mold
from jaxform.tools.motion import Motion
from jaxform.tools.search import CLASSES, SearchGrid

_FAR_LATER = 1e6  # times as late as the last knot, or as many seconds: where the pressure's other knots are


class Order(NamedTuple):
    """Where the nodes (n_node,), and the triangles of the forest (n_triangle,), of a scene are in a padded one.

    And the room for elements and for nodes before the mesh is refined, then for all nodes and triangles.
    """

    node: np.ndarray
    triangle: np.ndarray | None
    elements: int
    first_nodes: int
    node_room: int
    triangle_room: int


def padded_to(values: Any, room: int, fill: Any) -> Any:
    """Values (..., n) with as many more as there is room for."""
    values = np.asarray(values)
    if values.shape[-1] == room:
        return values
    new = np.full((*values.shape[:-1], room), fill, values.dtype)
    new[..., : values.shape[-1]] = values
    return new


def spread(values: Any, place: np.ndarray, room: int, fill: Any) -> Any:
    """Values (..., n) at places (n,) of the room, and elsewhere another."""
    values = np.asarray(values)
    if len(place) == room:
        return values
    new = np.full((*values.shape[:-1], room), fill, values.dtype)
    new[..., place] = values
    return new


def like_first(values: Any, room: int) -> Any:
    """Values (..., n) with as many more of the first one as there is room for."""
    values = np.asarray(values)
    new = np.empty((*values.shape[:-1], room), values.dtype)
    new[..., : values.shape[-1]] = values
    new[..., values.shape[-1] :] = values[..., :1]
    return new


def nodal_with_room(values: Any, order: Order, fill: Any) -> Any:
    """Values (..., n_node), in the order of the padded nodes, another beyond."""
    return spread(values, order.node, order.node_room, fill)


def parison_with_room(parison: Parison, elements: int, order: Order) -> Parison:
    """The parison; nodes beyond lie where the first one lies, and are clamped."""
    positions = np.asarray(parison.positions)
    there = nodal_with_room(np.ones(len(order.node), bool), order, False)
    places: Any = np.where(there, nodal_with_room(positions.T, order, 0.0), positions[:1].T).T

    def like_first_node(values: Any) -> Any:
        return np.where(there, nodal_with_room(values, order, 0.0), np.asarray(values)[0])

    return Parison(
        positions=places,
        triangles=like_first(order.node[np.asarray(parison.triangles)].T, elements).T.astype(np.int32),
        thickness=like_first_node(parison.thickness),
        clamped=nodal_with_room(parison.clamped, order, True),
        fixed=nodal_with_room(np.asarray(parison.fixed).T, order, True).T,
        temperature=None if parison.temperature is None else like_first_node(parison.temperature),
    )


def material_with_room(material: Law, order: Order) -> Law:
    """The law; at nodes beyond, its zones are as at the first node."""
    there = nodal_with_room(np.ones(len(order.node), bool), order, False)

    def longer(own: Any) -> Any:
        values = np.asarray(own)
        return np.where(there, nodal_with_room(values, order, 0.0), values[..., :1])

    return material.with_zones({name: longer(own) for name, own in material.zones.items()})


def sheet_with_room(sheet: Sheet, room: int, order: Order) -> Sheet:
    """Elements beyond those there are lie where the first one lies, and have no area."""
    return Sheet(
        triangles=like_first(order.node[np.asarray(sheet.triangles)].astype(np.int32), room),
        inverse_metric=like_first(sheet.inverse_metric, room),
        area=padded_to(sheet.area, room, 0.0),
        origin=sheet.origin,
    )


def lying_with_room(lying: Any, order: Order) -> Any:
    """What lies on the mold at first; where nothing does, it says so of every node."""
    return nodal_with_room(np.zeros(len(order.node), np.int32) if lying is None else lying, order, 0)


def rim_with_room(rim: Rim, order: Order) -> Rim:
    """Edges beyond those there are begin and end at one node."""
    ends, triangle = order.node[np.asarray(rim.ends)].astype(np.int32), rim.triangle
    room = sizes.rim(ends.shape[1])
    if triangle is not None and order.triangle is not None:
        triangle = padded_to(order.triangle[np.asarray(triangle)].astype(np.int32), room, 0)
    return Rim(padded_to(ends, room, 0), triangle)


def assembly_with_room(assembly: Assembly, elements: int, nodes: int) -> Assembly:
    """How nodes gather forces; of elements beyond those there are, none does."""
    table, rows = np.asarray(assembly.table), sizes.rows(len(assembly.table))
    deep: Any = np.full((rows, nodes), -1, np.int32)
    deep[: table.shape[0], : table.shape[1]] = table
    overflow = sizes.overflow(len(assembly.overflow))
    pairs = assembly.pairs
    if pairs is not None:
        room = sizes.pairs(pairs.element.shape[1], elements)
        pair: Any = np.asarray(pairs.element)
        # A pair beyond those there are is of an element beyond those there are, and of no other.
        first, second = padded_to(pair[0], room, elements - 1), padded_to(pair[1], room, -1)
        both: Any = np.stack([first, second])
        pairs = Pairs(
            element=both,
            pair=padded_to(pairs.pair, elements, room - 1),
            triangles=like_first(pairs.triangles, elements),
            inverse_metric=like_first(pairs.inverse_metric, elements),
            orientation=padded_to(pairs.orientation, elements, 1.0),
        )
    return Assembly(
        table=deep,
        overflow_node=padded_to(assembly.overflow_node, overflow, nodes - 1),
        overflow=padded_to(assembly.overflow, overflow, -1),
        pairs=pairs,
    )


def field_with_room(field: Field, order: Order) -> Field:
    """What it has at each node, at the first one's value beyond."""
    there = nodal_with_room(np.ones(len(order.node), bool), order, False)
    new = {}
    for name in nodal_numbers(field):
        values = np.asarray(getattr(field, name))
        new[name] = np.where(there, nodal_with_room(values, order, 0.0), values[0]) if values.ndim else values
    made: Any = dataclasses.replace(field, **new)  # pyright: ignore
    return made


def pressure_with_room(pressure: Loading) -> Loading:
    """The pressure is held after the last knot: there are further ones, of the same value, long after."""
    if not isinstance(pressure, Pressure):
        return pressure
    time, value = _held_later(np.asarray(pressure.time), np.asarray(pressure.value))
    return dataclasses.replace(pressure, time=time, value=value)


def _held_later(time: np.ndarray, value: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Knots, and further ones of the last value long after."""
    more = sizes.knots(len(time)) - len(time)
    later = time[-1] + _FAR_LATER * max(1.0, abs(float(time[-1]))) * np.arange(1, more + 1)
    return np.append(time, later.astype(time.dtype)), np.append(value, np.full(more, value[-1]))


def mold_with_room(mold: Mold) -> Mold:
    """The mold; triangles and vertices beyond are copies of the first one."""
    triangles = sizes.mold_triangles(len(mold.triangles))
    vertices = sizes.nodes(len(mold.vertices), triangles)
    return Mold(
        vertices=like_first(np.asarray(mold.vertices).T, vertices).T,
        triangles=like_first(np.asarray(mold.triangles).T, triangles).T,
        motion=None if mold.motion is None else _motion_with_room(mold.motion),
    )


def _motion_with_room(motion: Motion) -> Motion:
    time, displacement = _held_later(np.asarray(motion.time), np.asarray(motion.displacement))
    return dataclasses.replace(motion, time=time, displacement=displacement)


def grid_with_room(grid: SearchGrid) -> SearchGrid:
    """No cell lists a triangle beyond those there are."""
    cells = max(grid.bound.size, 0 if grid.far is None else grid.far.start.size)
    room, rows = sizes.cells(cells), sizes.mold_triangles(grid.number.size)
    far = grid.far
    if far is not None:
        far = dataclasses.replace(
            far, start=padded_to(far.start, room + 1, 0), ends=padded_to(far.ends, CLASSES * room, 0)
        )
    return SearchGrid(
        corner=grid.corner,
        width=grid.width,
        reach=grid.reach,
        size=grid.size,
        bound=padded_to(grid.bound, room, 0.0),
        start=padded_to(grid.start, room + 1, 0),
        ends=padded_to(grid.ends, CLASSES * room, 0),
        listed=padded_to(grid.listed, sizes.listed(grid.listed.size), 0),
        number=padded_to(grid.number, rows, 0),
        outlines=like_first(np.asarray(grid.outlines).T, rows).T,
        frames=like_first(np.asarray(grid.frames).T, rows).T,
        far=far,
        shape=grid.shape,
    )


def forest_order(forest: Forest, roots: int) -> Order:
    """Level by level, the first triangles' parts come at the begin of each level's room, as do the first nodes."""
    levels = np.arange(forest.depth + 1)
    begin, size = forest.root_count * ((1 << levels) - 1), forest.root_count << levels
    triangle = np.arange(forest.partner.size) + np.repeat(roots * ((1 << levels) - 1) - begin, size)
    room = roots * ((1 << (forest.depth + 1)) - 1)
    count, first = forest.owner.size, forest.first_nodes
    first_room = sizes.nodes(first, roots)
    node = np.arange(count) + np.where(np.arange(count) < first, 0, first_room - first)
    node_room = first_room + sizes.nodes(count - first, roots << forest.depth)
    return Order(node, triangle, roots, first_room, node_room, room)


def forest_with_room(forest: Forest, refinement: Refinement, order: Order) -> Forest:
    """The forest; triangles beyond those there are have no area and no parts."""
    assert order.triangle is not None
    place, room, node = order.triangle, order.triangle_room, order.node
    roots, first = order.elements, order.first_nodes

    def of_triangles(values: Any, fill: Any) -> Any:
        return spread(values, place, room, fill)

    def like_first(values: Any) -> Any:
        values = np.asarray(values)
        new = np.empty((*values.shape[:-1], room), values.dtype)
        new[...] = values[..., :1]
        new[..., place] = values
        return new

    partner = np.arange(room, dtype=np.int32)
    partner[place] = place[np.asarray(forest.partner)]
    middle = np.asarray(forest.middle)
    edges = sizes.half_edges(forest.half_edge_count, room)
    ends = np.tile(np.arange(order.node_room, dtype=np.int32), (2, 1))
    ends[:, node] = node[np.asarray(forest.ends)]
    fine, bend = forest.fine_at_once, forest.bend
    if fine is not None:
        fine = padded_to(place[np.asarray(fine)].astype(np.int32), sizes.rung(fine.size, 256), NEVER)
    if bend is not None:
        bend = Bend(padded_to(bend.distance, sizes.bend(bend.distance.size), 0.0), bend.parts)
    return Forest(
        sheet=Sheet(
            triangles=like_first(node[np.asarray(forest.sheet.triangles)].astype(np.int32)),
            inverse_metric=like_first(forest.sheet.inverse_metric),
            area=of_triangles(forest.sheet.area, 0.0),
            origin=forest.sheet.origin,
        ),
        bound=like_first(forest.bound),
        heavier=like_first(forest.heavier),
        partner=as_index(partner),
        middle=of_triangles(np.where(middle >= 0, node[middle], -1).astype(np.int32), -1),
        half_edges=of_triangles(forest.half_edges, edges - 2),
        root_row=padded_to(forest.root_row, roots, 0),
        ends=as_index(ends),
        owner=nodal_with_room(place[np.asarray(forest.owner)].astype(np.int32), order, 0),
        mobility=nodal_with_room(forest.mobility, order, 0.0),
        bend=bend,
        fine_at_once=fine,
        root_count=roots,
        depth=forest.depth,
        first_nodes=first,
        half_edge_count=edges,
        valence=sizes.valence(forest.valence),
        node_room=sizes.apart(node_room(refinement.elements, first, order.node_room)),
    )

"""A scene in arrays that are as long as the rungs of the ladder of sizes, and a result in its own again. On the host.

Scenes of the same kind and rungs are the same to a compiled program. What is beyond a scene's own nodes and elements
is inert: such nodes cannot move, such elements have no area, no cell of the search grid lists such a triangle of the
mold, and the pressure stays what it was after such knots. Names and limits that only the host reads are left out.
"""

from __future__ import annotations

import dataclasses
from typing import Any, NamedTuple

import jax
import numpy as np
from jax.core import Tracer

from jaxform import sizes
from jaxform.body import NEVER, node_room
from jaxform.carried import Field
from jaxform.errors import InputError
from jaxform.loads import Loading, Pressure
from jaxform.mold import Mold
from jaxform.parameters import nodal_numbers
from jaxform.pytree import as_index
from jaxform.ranges import MOST_STEPS
from jaxform.result import Result
from jaxform.scene import (
    Assembly,
    Bend,
    Counts,
    Forest,
    Pairs,
    Parison,
    Refinement,
    Scene,
    Sheet,
    Tables,
)
from jaxform.search import CLASSES, SearchGrid
from jaxform.state import Schedule

_NODAL = ("positions", "thickness", "active", "stuck", "contact_time", "wall", "velocities")
_OF_ELEMENTS = ("level", "used", "element_volume", "element_thickness", "stretches")
_OF_WINDOWS = ("lengths", "counts", "bounds", "durations")
_FAR_LATER = 1e6  # times as late as the last knot, or as many seconds: where the pressure's other knots are


class _Order(NamedTuple):
    """Where the nodes (n_node,), and the triangles of the forest (n_triangle,), of a scene are in a padded one.

    And the room for elements and for nodes before the mesh is refined, then for all nodes and triangles.
    """

    node: np.ndarray
    triangle: np.ndarray | None
    elements: int
    first_nodes: int
    node_room: int
    triangle_room: int


class Padded(NamedTuple):
    """A scene with room, and the scene that it stands for.

    Attributes:
        scene: It has the structure and shapes of all scenes of its kind and rungs.
        own: The scene as it was.
        order: Where things of the one are in the other; None where they are the same.
    """

    scene: Scene
    own: Scene
    order: _Order | None

    def result(self, result: Result) -> Result:
        """A result of the padded scene as one of the scene itself."""
        if self.order is None:
            return result
        nodes, forest, refinement = self.order.node, self.own.tables.forest, self.own.refinement
        used = np.asarray(result.used)
        count = len(self.own.parison.triangles)
        if refinement is not None:
            count = min(max(refinement.elements, int(used.sum())), used.size)
        new: dict[str, Any] = {name: np.asarray(getattr(result, name))[nodes] for name in _NODAL}
        new |= {name: np.asarray(getattr(result, name))[:count] for name in _OF_ELEMENTS}
        new["fields"] = {name: np.asarray(values)[nodes] for name, values in result.fields.items()}
        triangles = np.asarray(result.triangles)[:count]
        if forest is not None:
            back = np.zeros(self.order.node_room, np.int32)
            back[nodes] = np.arange(len(nodes))
            triangles = back[triangles]
        schedule = None if result.schedule is None else self._schedule(result.schedule, self.order)
        # Unlike `jnp.asarray` this compiles nothing.
        new = jax.device_put(new | {"triangles": triangles, "schedule": schedule})
        return dataclasses.replace(result, **new)

    def _schedule(self, schedule: Schedule, order: _Order) -> Schedule:
        """The decisions of the windows that the scene plans for, or that there were."""
        counts = np.asarray(schedule.counts)
        taken = np.flatnonzero(counts)
        count = max(self.own.tables.window_count, int(taken[-1]) + 1 if len(taken) else 0)
        split: Any = schedule.split_at
        if split is not None and order.triangle is not None:
            split = np.asarray(split)[order.triangle]
        rows = {name: np.asarray(getattr(schedule, name))[:count] for name in _OF_WINDOWS}
        return dataclasses.replace(schedule, **rows, split_at=split)

    def schedule(self, schedule: Schedule) -> Schedule:
        """A schedule of the scene itself as one of the padded scene."""
        if self.order is None:
            return schedule
        room = sizes.windows(len(schedule.counts))
        split: Any = schedule.split_at
        if split is not None and self.order.triangle is not None:
            split = _spread(split, self.order.triangle, self.order.triangle_room, NEVER)
        rows = {name: _padded(getattr(schedule, name), room, 0) for name in _OF_WINDOWS}
        return jax.device_put(dataclasses.replace(schedule, **rows, split_at=split))


def padded(scene: Scene) -> Scene:
    """A scene in arrays as long as the rungs of the ladder of sizes, for `jax.jit` of functions of scenes.

    Such scenes of a kind and rungs have the same structure and shapes, so that a jitted function of one is traced and
    compiled once for all. Results have as much room: count nodes that are `active` and elements that are `used`; the
    others have the thickness 0. `run`, `simulate` outside of traces, and `simulate_batch` do the same by themselves
    with any scene, and give results without such room.

    Raises:
        InputError: If the scene is traced.
    """
    if any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves(scene)):
        raise InputError("is traced, how much room it needs is not known", "pad it outside of the function", "scene")
    return on_rungs(scene).scene


def on_rungs(scene: Scene, least: int = 0, *, recorded: bool = False) -> Padded:
    """A scene with room, of which nothing is traced; one that has room already is as it was.

    Args:
        scene: The scene.
        least: As if it had so many elements before it is refined, where it has fewer.
        recorded: Whether its windows are only recorded, as by `run`, and no derivative is taken.
    """
    if scene.tables.counts is not None:
        return Padded(scene, scene, None)
    forest, refinement, tables = scene.tables.forest, scene.refinement, scene.tables
    if forest is None:
        elements = sizes.elements(max(len(scene.parison.triangles), least))
        count = len(scene.parison.positions)
        room = sizes.nodes(count, elements)
        order = _Order(np.arange(count), None, elements, room, room, 0)
        pairs = tables.assembly.pairs
        pair_count = None if pairs is None else pairs.element.shape[1]
        assembly = _assembly(tables.assembly, elements, order.node_room)
    else:
        elements = sizes.roots(max(forest.root_count, least))
        order, pair_count = _forest_order(forest, elements), None
        none: Any = np.zeros(0, np.int32)
        # What the mesh was before it was refined is not worked through.
        assembly = Assembly(none[None], none, none)
    numbers: list[Any] = [
        np.int32(count) for count in (len(scene.parison.triangles), scene.first_nodes, pair_count or 0)
    ]
    counts = Counts(numbers[0], numbers[1], None if pair_count is None else numbers[2])
    grown = None
    if forest is not None and refinement is not None:
        refinement = dataclasses.replace(refinement, elements=sizes.grown(refinement.elements))
        grown = _forest(forest, refinement, order)
    made = Tables(
        sheet=_sheet(tables.sheet, elements, order),
        assembly=assembly,
        bound=grown.bound if grown is not None else _like_first(tables.bound, elements),
        mobility=_nodal(tables.mobility, order, 0.0),
        size=tables.size,
        grid=None if tables.grid is None else _grid(tables.grid),
        forest=grown,
        lying=_lying(scene, order),
        longest_window=tables.longest_window,
        window_count=sizes.windows(tables.window_count, recorded=recorded),
        window_room=tables.window_room,
        pairs_per_node=tables.pairs_per_node,
        counts=counts,
    )
    whole = Scene(
        parison=_parison(scene.parison, elements, order),
        material=scene.material,
        pressure=_pressure(scene.pressure),
        solver=dataclasses.replace(scene.solver, quasi_static=False, max_steps=MOST_STEPS),
        mold=None if scene.mold is None else _mold(scene.mold),
        refinement=refinement,
        tables=made,
        name="",
        fields={name: _field(own, order) for name, own in scene.fields.items()},
    )
    return Padded(jax.device_put(whole), scene, order)


def _padded(values: Any, room: int, fill: Any) -> Any:
    """Values (..., n) with as many more as there is room for."""
    values = np.asarray(values)
    if values.shape[-1] == room:
        return values
    new = np.full((*values.shape[:-1], room), fill, values.dtype)
    new[..., : values.shape[-1]] = values
    return new


def _spread(values: Any, place: np.ndarray, room: int, fill: Any) -> Any:
    """Values (..., n) at places (n,) of the room, and elsewhere another."""
    values = np.asarray(values)
    if len(place) == room:
        return values
    new = np.full((*values.shape[:-1], room), fill, values.dtype)
    new[..., place] = values
    return new


def _like_first(values: Any, room: int) -> Any:
    """Values (..., n) with as many more of the first one as there is room for."""
    values = np.asarray(values)
    new = np.empty((*values.shape[:-1], room), values.dtype)
    new[..., : values.shape[-1]] = values
    new[..., values.shape[-1] :] = values[..., :1]
    return new


def _nodal(values: Any, order: _Order, fill: Any) -> Any:
    return _spread(values, order.node, order.node_room, fill)


def _parison(parison: Parison, elements: int, order: _Order) -> Parison:
    positions = np.asarray(parison.positions)
    there = _nodal(np.ones(len(order.node), bool), order, False)
    places: Any = np.where(there, _nodal(positions.T, order, 0.0), positions[:1].T).T
    thickness = np.asarray(parison.thickness)
    return Parison(
        positions=places,
        triangles=_like_first(order.node[np.asarray(parison.triangles)].T, elements).T.astype(np.int32),
        thickness=np.where(there, _nodal(thickness, order, 0.0), thickness[0]),
        clamped=_nodal(parison.clamped, order, True),
        fixed=_nodal(np.asarray(parison.fixed).T, order, True).T,
    )


def _sheet(sheet: Sheet, room: int, order: _Order) -> Sheet:
    """Elements beyond those there are lie where the first one lies, and have no area."""
    return Sheet(
        triangles=_like_first(order.node[np.asarray(sheet.triangles)].astype(np.int32), room),
        inverse_metric=_like_first(sheet.inverse_metric, room),
        area=_padded(sheet.area, room, 0.0),
        origin=sheet.origin,
    )


def _lying(scene: Scene, order: _Order) -> Any:
    if scene.mold is None:
        return None
    lying = scene.tables.lying
    return _nodal(np.zeros(len(order.node), np.int32) if lying is None else lying, order, 0)


def _assembly(assembly: Assembly, elements: int, nodes: int) -> Assembly:
    table, rows = np.asarray(assembly.table), sizes.rows(len(assembly.table))
    deep: Any = np.full((rows, nodes), -1, np.int32)
    deep[: table.shape[0], : table.shape[1]] = table
    spill = sizes.spill(len(assembly.spill))
    pairs = assembly.pairs
    if pairs is not None:
        room = sizes.pairs(pairs.element.shape[1], elements)
        pair: Any = np.asarray(pairs.element)
        # A pair beyond those there are is of an element beyond those there are, and of no other.
        first, second = _padded(pair[0], room, elements - 1), _padded(pair[1], room, -1)
        both: Any = np.stack([first, second])
        pairs = Pairs(
            element=both,
            pair=_padded(pairs.pair, elements, room - 1),
            triangles=_like_first(pairs.triangles, elements),
            inverse_metric=_like_first(pairs.inverse_metric, elements),
            turn=_padded(pairs.turn, elements, 1.0),
        )
    return Assembly(
        table=deep,
        spill_node=_padded(assembly.spill_node, spill, nodes - 1),
        spill=_padded(assembly.spill, spill, -1),
        pairs=pairs,
    )


def _field(field: Field, order: _Order) -> Field:
    """What it has at each node, at the first one's value beyond."""
    there = _nodal(np.ones(len(order.node), bool), order, False)
    new = {}
    for name in nodal_numbers(field):
        values = np.asarray(getattr(field, name))
        new[name] = np.where(there, _nodal(values, order, 0.0), values[0]) if values.ndim else values
    made: Any = dataclasses.replace(field, **new)  # pyright: ignore
    return made


def _pressure(pressure: Loading) -> Loading:
    """The pressure is held after the last knot: there are further ones, of the same value, long after."""
    if not isinstance(pressure, Pressure):
        return pressure
    time, value = np.asarray(pressure.time), np.asarray(pressure.value)
    more = sizes.knots(len(time)) - len(time)
    later = time[-1] + _FAR_LATER * max(1.0, abs(float(time[-1]))) * np.arange(1, more + 1)
    return dataclasses.replace(
        pressure,
        time=np.append(time, later.astype(time.dtype)),
        value=np.append(value, np.full(more, value[-1])),
    )


def _mold(mold: Mold) -> Mold:
    triangles = sizes.mold_triangles(len(mold.triangles))
    vertices = sizes.nodes(len(mold.vertices), triangles)
    return Mold(
        vertices=_like_first(np.asarray(mold.vertices).T, vertices).T,
        triangles=_like_first(np.asarray(mold.triangles).T, triangles).T,
    )


def _grid(grid: SearchGrid) -> SearchGrid:
    """No cell lists a triangle beyond those there are."""
    cells = max(grid.bound.size, 0 if grid.far is None else grid.far.start.size)
    room, rows = sizes.cells(cells), sizes.mold_triangles(grid.number.size)
    far = grid.far
    if far is not None:
        far = dataclasses.replace(far, start=_padded(far.start, room + 1, 0), ends=_padded(far.ends, CLASSES * room, 0))
    return SearchGrid(
        corner=grid.corner,
        width=grid.width,
        reach=grid.reach,
        size=grid.size,
        bound=_padded(grid.bound, room, 0.0),
        start=_padded(grid.start, room + 1, 0),
        ends=_padded(grid.ends, CLASSES * room, 0),
        listed=_padded(grid.listed, sizes.listed(grid.listed.size), 0),
        number=_padded(grid.number, rows, 0),
        outlines=_like_first(np.asarray(grid.outlines).T, rows).T,
        frames=_like_first(np.asarray(grid.frames).T, rows).T,
        far=far,
        shape=grid.shape,
    )


def _forest_order(forest: Forest, roots: int) -> _Order:
    """Level by level, the first triangles' parts come at the begin of each level's room, as do the first nodes."""
    levels = np.arange(forest.depth + 1)
    begin, size = forest.root_count * ((1 << levels) - 1), forest.root_count << levels
    triangle = np.arange(forest.partner.size) + np.repeat(roots * ((1 << levels) - 1) - begin, size)
    room = roots * ((1 << (forest.depth + 1)) - 1)
    count, first = forest.owner.size, forest.first_nodes
    first_room = sizes.nodes(first, roots)
    node = np.arange(count) + np.where(np.arange(count) < first, 0, first_room - first)
    node_room = first_room + sizes.nodes(count - first, roots << forest.depth)
    return _Order(node, triangle, roots, first_room, node_room, room)


def _forest(forest: Forest, refinement: Refinement, order: _Order) -> Forest:
    assert order.triangle is not None
    place, room, node = order.triangle, order.triangle_room, order.node
    roots, first = order.elements, order.first_nodes

    def of_triangles(values: Any, fill: Any) -> Any:
        return _spread(values, place, room, fill)

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
        fine = _padded(place[np.asarray(fine)].astype(np.int32), sizes.rung(fine.size, 256), NEVER)
    if bend is not None:
        bend = Bend(_padded(bend.distance, sizes.bend(bend.distance.size), 0.0), bend.parts)
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
        root_row=_padded(forest.root_row, roots, 0),
        ends=as_index(ends),
        owner=_nodal(place[np.asarray(forest.owner)].astype(np.int32), order, 0),
        mobility=_nodal(forest.mobility, order, 0.0),
        bend=bend,
        fine_at_once=fine,
        root_count=roots,
        depth=forest.depth,
        first_nodes=first,
        half_edge_count=edges,
        valence=sizes.valence(forest.valence),
        node_room=sizes.apart(node_room(refinement.elements, first, order.node_room)),
    )

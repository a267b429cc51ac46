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

from jaxform.core.errors import InputError
from jaxform.core.ranges import MOST_STEPS
from jaxform.core.rules import by_own_rules, on_device_of
from jaxform.kernels import sizes
from jaxform.model.replacing import check_scene
from jaxform.model.scene import Refinement, Scene
from jaxform.model.tables import Assembly, Counts, Tables
from jaxform.results.result import NODAL, OF_ELEMENTS, Result
from jaxform.runs.arrays import (
    Order,
    assembly_with_room,
    field_with_room,
    forest_order,
    forest_with_room,
    grid_with_room,
    like_first,
    lying_with_room,
    material_with_room,
    mold_with_room,
    nodal_with_room,
    padded_to,
    parison_with_room,
    pressure_with_room,
    rim_with_room,
    sheet_with_room,
    spread,
)
from jaxform.runs.kept import kept
from jaxform.sheet.discretization import NEVER
from jaxform.sheet.state import Schedule
from jaxform.tools.mold import Mold

_OF_WINDOWS = ("lengths", "counts", "bounds")


class Padded(NamedTuple):
    """A scene with room, and the scene that it stands for.

    Attributes:
        scene: It has the structure and shapes of all scenes of its kind and rungs.
        own: The scene as it was.
        order: Where things of the one are in the other; None where they are the same.
    """

    scene: Scene
    own: Scene
    order: Order | None

    def result(self, result: Result) -> Result:
        """A result of the padded scene as one of the scene itself."""
        if self.order is None:
            return result
        nodes, forest, refinement = self.order.node, self.own.tables.forest, self.own.refinement
        used = np.asarray(result.used)
        count = len(self.own.parison.triangles)
        if refinement is not None:
            count = min(max(refinement.elements, int(used.sum())), used.size)
        new = result.of(NODAL, nodes) | result.of(OF_ELEMENTS, slice(count))
        triangles = np.asarray(result.triangles)[:count]
        if forest is not None:
            back = np.zeros(self.order.node_room, np.int32)
            back[nodes] = np.arange(len(nodes))
            triangles = back[triangles]
        schedule = None if result.schedule is None else self._schedule(result.schedule, self.order)
        # Unlike `jnp.asarray` this compiles nothing.
        new = jax.device_put(new | {"triangles": triangles, "schedule": schedule})
        return dataclasses.replace(result, **new)

    def _schedule(self, schedule: Schedule, order: Order) -> Schedule:
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
            split = spread(split, self.order.triangle, self.order.triangle_room, NEVER)
        rows = {name: padded_to(getattr(schedule, name), room, 0) for name in _OF_WINDOWS}
        return jax.device_put(dataclasses.replace(schedule, **rows, split_at=split))


@by_own_rules
def padded(scene: Scene) -> Scene:
    """A scene in arrays as long as the rungs of the ladder of sizes, for `jax.jit` of functions of scenes.

    Such scenes of a kind and rungs have the same structure and shapes, so that a jitted function of one is traced and
    compiled once for all. Results have as much room: count nodes that are `active` and elements that are `used`; the
    others have the thickness 0. `run`, `simulate` outside of traces, and `simulate_batch` do the same by themselves
    with any scene, and give results without such room.

    Raises:
        InputError: If the scene is traced, or is none.
    """
    check_scene(scene)
    if any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves(scene)):
        raise InputError("is traced, how much room it needs is not known", "pad it outside of the function", "scene")
    if scene.tables.counts is not None:
        return scene
    with on_device_of(scene.parison.positions) as placed:
        return placed(dataclasses.replace(on_rungs(scene).scene, part=scene.part))


def on_rungs(scene: Scene, least: int = 0, *, recorded: bool = False) -> Padded:
    """A scene with room, of which nothing is traced; one that has room already is as it was.

    Args:
        scene: The scene.
        least: As if it had so many elements before it is refined, where it has fewer.
        recorded: Whether its windows are only recorded, as by `run`, and no derivative is taken.
    """
    if scene.tables.counts is not None:
        return Padded(scene, scene, None)
    room = kept(_rungs, scene.tables, len(scene.parison.triangles), scene.refinement, least, recorded)
    order, elements = room.order, room.order.elements
    own = {
        "parison": parison_with_room(scene.parison, elements, order),
        "material": material_with_room(scene.material, order),
        "pressure": pressure_with_room(scene.pressure),
        "solver": dataclasses.replace(scene.solver, quasi_static=False, max_steps=MOST_STEPS),
        "fields": {name: field_with_room(field, order) for name, field in scene.fields.items()},
        "cooling": scene.cooling,
    }
    whole = Scene(
        mold=None if scene.mold is None else kept(_mold, scene.mold),
        refinement=room.refinement,
        tables=room.tables,
        name="",
        **jax.device_put(own),
    )
    return Padded(whole, scene, order)


def _mold(mold: Mold) -> Mold:
    return jax.device_put(mold_with_room(mold))


class _Rungs(NamedTuple):
    """Tables with room, limits of refinement that go with it, and where things of a scene are in them."""

    tables: Tables
    refinement: Refinement | None
    order: Order


def _rungs(tables: Tables, count: int, refinement: Refinement | None, least: int, recorded: bool) -> _Rungs:
    """Of the tables of a scene of so many elements; the rest as of `on_rungs`."""
    forest, nodes = tables.forest, tables.mobility.shape[1]
    pair_count = None
    if forest is None:
        elements = sizes.elements(max(count, least))
        room = sizes.nodes(nodes, elements)
        order = Order(np.arange(nodes), None, elements, room, room, 0)
        pairs = tables.assembly.pairs
        pair_count = None if pairs is None else pairs.element.shape[1]
        assembly = assembly_with_room(tables.assembly, elements, order.node_room)
    else:
        elements = sizes.roots(max(forest.root_count, least))
        order = forest_order(forest, elements)
        nodes = forest.first_nodes
        none: Any = np.zeros(0, np.int32)
        # What the mesh was before it was refined is not active.
        assembly = Assembly(none[None], none, none)
    numbers: list[Any] = [np.int32(number) for number in (count, nodes, pair_count or 0)]
    counts = Counts(numbers[0], numbers[1], None if pair_count is None else numbers[2])
    grown = None
    if forest is not None and refinement is not None:
        refinement = dataclasses.replace(refinement, elements=sizes.grown(refinement.elements))
        grown = forest_with_room(forest, refinement, order)
    made = Tables(
        sheet=sheet_with_room(tables.sheet, elements, order),
        assembly=assembly,
        bound=grown.bound if grown is not None else like_first(tables.bound, elements),
        mobility=nodal_with_room(tables.mobility, order, 0.0),
        size=tables.size,
        box=tables.box,
        grid=None if tables.grid is None else grid_with_room(tables.grid),
        forest=grown,
        lying=None if tables.grid is None else lying_with_room(tables.lying, order),
        longest_window=tables.longest_window,
        planned=tables.planned,
        window_count=sizes.windows(tables.window_count, recorded=recorded),
        window_room=tables.window_room,
        pairs_per_node=tables.pairs_per_node,
        counts=counts,
        rim=None if tables.rim is None else rim_with_room(tables.rim, order),
    )
    made, refinement = jax.device_put((made, refinement))
    return _Rungs(made, refinement, order)

"""Padding of a scene's arrays to bucket sizes, and of a result back to its own sizes. On the host.

Scenes of a kind and bucket sizes are the same to a compiled program. What is beyond a scene's own nodes and elements
is inert: such nodes cannot move, such elements have no area, no cell of the search grid lists such a triangle of the
mold, and the pressure is constant after the scene's last knot. Names and limits that only the host reads are left out.
"""

from __future__ import annotations

import dataclasses
import weakref
from collections.abc import Callable, Hashable
from typing import Any, NamedTuple

import jax
import numpy as np
from jax.core import Tracer

from jaxform.core.compilation import device_context, with_standard_promotion
from jaxform.core.errors import InputError
from jaxform.core.ranges import MOST_STEPS
from jaxform.kernels import capacities
from jaxform.model.replacement import check_scene
from jaxform.model.scene import Refinement, Scene
from jaxform.model.tables import Assembly, Counts, Precomputed
from jaxform.results.result import NODAL, OF_ELEMENTS, Result
from jaxform.runs.arrays import (
    Order,
    forest_order,
    pad_assembly,
    pad_edges,
    pad_field,
    pad_forest,
    pad_grid,
    pad_initial_contact,
    pad_material,
    pad_mold,
    pad_neighbors,
    pad_nodal,
    pad_parison,
    pad_pressure,
    pad_rim,
    pad_sheet,
    pad_values,
    pad_with_first,
    scatter_values,
)
from jaxform.sheet.discretization import NEVER
from jaxform.sheet.state import Schedule
from jaxform.tools.mold import Mold
from jaxform.tools.search import SearchGrid

# Cache of values computed from parts of a scene, for as long as these exist; scenes share them with their parts.

_made: weakref.WeakKeyDictionary[Any, dict[tuple[Hashable, ...], Any]] = weakref.WeakKeyDictionary()


def cache_by_identity[P, R, *Ts](make: Callable[[P, *Ts], R], part: P, *others: *Ts) -> R:
    """The value of a function of a part of a scene and of other arguments, cached with the part.

    It is computed once while the part exists, unless the arguments have arrays that can be written into.

    Args:
        make: The function; its value depends on its arguments only.
        part: A record whose leaves are arrays.
        others: Hashable; records are compared by identity, not by content.
    """
    if any(isinstance(leaf, np.ndarray) for leaf in jax.tree.leaves((part, others))):
        return make(part, *others)
    made, key = _made.setdefault(part, {}), (make, *others)
    if key not in made:
        made[key] = make(part, *others)
    return made[key]


_OF_WINDOWS = ("lengths", "counts", "bounds")


class PaddedScene(NamedTuple):
    """A padded scene, and the original scene.

    Attributes:
        scene: It has the structure and shapes of all scenes of its kind and bucket sizes.
        original: The scene without padding.
        order: Places of the original's nodes and triangles in the padded scene; None where they are the same.
    """

    scene: Scene
    original: Scene
    order: Order | None

    def result(self, result: Result) -> Result:
        """A result of the padded scene as one of the scene itself."""
        if self.order is None:
            return result
        nodes, forest, refinement = self.order.node, self.original.tables.forest, self.original.refinement
        used = np.asarray(result.used)
        count = len(self.original.parison.triangles)
        if refinement is not None:
            count = min(max(refinement.elements, int(used.sum())), used.size)
        new = result.of(NODAL, nodes) | result.of(OF_ELEMENTS, slice(count))
        triangles = np.asarray(result.triangles)[:count]
        if forest is not None:
            back = np.zeros(self.order.node_capacity, np.int32)
            back[nodes] = np.arange(len(nodes))
            triangles = back[triangles]
        schedule = None if result.schedule is None else self._schedule(result.schedule, self.order)
        # Unlike `jnp.asarray` this compiles nothing.
        new = jax.device_put(new | {"triangles": triangles, "schedule": schedule})
        return dataclasses.replace(result, **new)

    def _schedule(self, schedule: Schedule, order: Order) -> Schedule:
        """The decisions of the planned windows, or of those that were taken if these are more."""
        counts = np.asarray(schedule.counts)
        taken = np.flatnonzero(counts)
        count = max(self.original.tables.window_count, int(taken[-1]) + 1 if len(taken) else 0)
        split: Any = schedule.split_at
        if split is not None and order.triangle is not None:
            split = np.asarray(split)[order.triangle]
        rows = {name: np.asarray(getattr(schedule, name))[:count] for name in _OF_WINDOWS}
        return dataclasses.replace(schedule, **rows, split_at=split)

    def schedule(self, schedule: Schedule) -> Schedule:
        """A schedule of the scene itself as one of the padded scene."""
        if self.order is None:
            return schedule
        capacity = capacities.window_capacity(len(schedule.counts))
        split: Any = schedule.split_at
        if split is not None and self.order.triangle is not None:
            split = scatter_values(split, self.order.triangle, self.order.triangle_capacity, NEVER)
        rows = {name: pad_values(getattr(schedule, name), capacity, 0) for name in _OF_WINDOWS}
        return jax.device_put(dataclasses.replace(schedule, **rows, split_at=split))


@with_standard_promotion
def padded(scene: Scene) -> Scene:
    """The scene in arrays padded to bucket sizes, for `jax.jit` of functions of scenes.

    Scenes of a kind and sizes have the same structure and shapes, so that a jitted function of one is traced and
    compiled once for all. Results are padded too: count nodes that are `active` and elements that are `used`; the
    others have the thickness 0. `run`, `simulate` outside of traces, and `simulate_batch` do the same by themselves
    with any scene, and give results without padding.

    Raises:
        InputError: If the scene is traced, or is none.
    """
    check_scene(scene)
    if any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves(scene)):
        raise InputError(
            "is traced, so the capacity it needs is not known", "pad it outside the traced function", "scene"
        )
    if scene.tables.counts is not None:
        return scene
    with device_context(scene.parison.positions) as placed:
        return placed(dataclasses.replace(pad_to_bucket(scene).scene, part=scene.part))


def pad_to_bucket(scene: Scene, least: int = 0, *, recorded: bool = False) -> PaddedScene:
    """The padded scene, of which nothing is traced; a scene that is padded already is returned unchanged.

    Args:
        scene: The scene.
        least: Smallest number of elements, before refinement, that the sizes allow for.
        recorded: True if its windows are only recorded, as by `run`, and no derivative is taken.
    """
    if scene.tables.counts is not None:
        return PaddedScene(scene, scene, None)
    count, limits = len(scene.parison.triangles), scene.refinement
    tables, refinement, order = cache_by_identity(_pad_tables, scene.tables, count, limits, least, recorded)
    own = {
        "parison": pad_parison(scene.parison, order.elements, order),
        "material": pad_material(scene.material, order),
        "pressure": pad_pressure(scene.pressure),
        "solver": dataclasses.replace(scene.solver, quasi_static=False, edge_contact=False, max_steps=MOST_STEPS),
        "fields": {name: pad_field(field, order) for name, field in scene.fields.items()},
        "cooling": scene.cooling,
    }
    whole = Scene(
        mold=None if scene.mold is None else cache_by_identity(_mold, scene.mold),
        tools=tuple(cache_by_identity(_mold, tool) for tool in scene.tools),
        refinement=refinement,
        tables=tables,
        name="",
        **jax.device_put(own),
    )
    return PaddedScene(whole, scene, order)


def _mold(mold: Mold) -> Mold:
    return jax.device_put(pad_mold(mold))


def _grid(grid: SearchGrid) -> SearchGrid:
    return jax.device_put(pad_grid(grid))


def _pad_tables(
    tables: Precomputed, count: int, refinement: Refinement | None, least: int, recorded: bool
) -> tuple[Precomputed, Refinement | None, Order]:
    """Padded tables of a scene with so many elements; the other arguments are those of `pad_to_bucket`.

    Returns:
        The tables, their limits of refinement, and the places of the scene's nodes and triangles in them.
    """
    forest, nodes = tables.forest, tables.mobility.shape[1]
    pair_count = None
    if forest is None:
        elements = capacities.element_capacity(max(count, least))
        capacity = capacities.node_capacity(nodes, elements)
        order = Order(np.arange(nodes), None, elements, capacity, capacity, 0)
        pairs = tables.assembly.pairs
        pair_count = None if pairs is None else pairs.element.shape[1]
        assembly = pad_assembly(tables.assembly, elements, order.node_capacity)
    else:
        elements = capacities.root_capacity(max(forest.root_count, least))
        order = forest_order(forest, elements)
        nodes = forest.first_nodes
        none: Any = np.zeros(0, np.int32)
        # The mesh before refinement is not active.
        assembly = Assembly(none[None], none, none)
    numbers: list[Any] = [np.int32(number) for number in (count, nodes, pair_count or 0)]
    counts = Counts(numbers[0], numbers[1], None if pair_count is None else numbers[2])
    grown = None
    if forest is not None and refinement is not None:
        refinement = dataclasses.replace(refinement, elements=capacities.refined_capacity(refinement.elements))
        grown = pad_forest(forest, refinement, order)
    touches = tables.grid is not None or bool(tables.tool_grids)
    several = (tables.grid is not None) + len(tables.tool_grids) > 1
    made = Precomputed(
        sheet=pad_sheet(tables.sheet, elements, order),
        assembly=assembly,
        bound=grown.bound if grown is not None else pad_with_first(tables.bound, elements),
        mobility=pad_nodal(tables.mobility, order, 0.0),
        size=tables.size,
        box=tables.box,
        grid=None if tables.grid is None else cache_by_identity(_grid, tables.grid),
        forest=grown,
        initial_contact=pad_initial_contact(tables.initial_contact, order) if touches else None,
        initial_tool=pad_initial_contact(tables.initial_tool, order) if several else None,
        longest_window=tables.longest_window,
        planned=tables.planned,
        window_count=capacities.window_capacity(tables.window_count, recorded=recorded),
        step_capacity=tables.step_capacity,
        pairs_per_node=tables.pairs_per_node,
        counts=counts,
        rim=None if tables.rim is None else pad_rim(tables.rim, order),
        tool_grids=tuple(cache_by_identity(_grid, grid) for grid in tables.tool_grids),
        neighbors=tuple(jax.device_put(pad_neighbors(each)) for each in tables.neighbors),
        edges=tuple(jax.device_put(pad_edges(each)) for each in tables.edges),
    )
    made, refinement = jax.device_put((made, refinement))
    return made, refinement, order

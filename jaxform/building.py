"""Building a scene on the host: validation, reference geometry, search structure, number of windows."""

from __future__ import annotations

import dataclasses
import warnings
from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxform import bisection, membrane, reference, start, topology
from jaxform.body import node_room
from jaxform.carried import Field
from jaxform.errors import InputError
from jaxform.loads import Loading
from jaxform.materials import Law
from jaxform.mold import Mold
from jaxform.near import PAIRS_PER_NODE
from jaxform.packing import make_assembly, make_paired_assembly
from jaxform.parameters import check_part, is_declared, nodal_numbers, ranges_of
from jaxform.pytree import as_index, as_real
from jaxform.ranges import MOST_STEPS, check_one
from jaxform.scene import (
    LONG_WINDOW,
    SHORT_WINDOW,
    Assembly,
    Bend,
    Forest,
    Parison,
    Refinement,
    Scene,
    Sheet,
    Solver,
    Tables,
    make_parison,
)
from jaxform.search import SearchGrid, build_grid
from jaxform.store import Store

_LARGEST_STRETCH = 6.0  # that windows are planned for
_PLANNED_TO_TAKEN, _LEAST_WINDOWS = 4, 16  # as a rule; and how many windows a run has at least
_FAR_NODES = 0.125  # of all, that may be listed with all that is within the farthest reach
_MOST_PAIRS_RUNGS = 3  # by doubling, of the room for pairs when a scene is built
_BEND = 10.0  # degrees, from which two triangles of the mold make a bend
_RESERVED = ("reference", "thickness", "initial_thickness", "contact_time")  # in final.vtu
_MOST_BEND_CELLS = 500_000  # where the distance to such a bend is kept


def build_scene(
    *,
    parison: Parison,
    material: Law,
    pressure: Loading,
    solver: Solver,
    mold: Mold | None = None,
    refinement: Refinement | None = None,
    forest: bisection.Forest | None = None,
    fields: Mapping[str, Field] | None = None,
    name: str = "scene",
    frames: int = 0,
    store: Store | None = None,
) -> Scene:
    """Builds a scene: validates it and does all host work.

    Args:
        parison: The sheet.
        material: Its law.
        pressure: The pressure history, or any other loading.
        solver: Options of the time integration.
        mold: The mold; None for free inflation.
        refinement: Where the mesh becomes finer; None where it stays as it is.
        forest: Of the parison's mesh, where the parison has its nodes already; else it is built here, and new nodes
            have the mean thickness of their edges' ends.
        fields: Nodal fields that the sheet carries, by name; with a value at each node of the parison.
        name: What the scene is called.
        frames: At how many moments the run is to be looked at; it can be at the borders of its windows.
        store: Where the mold's search structure is kept between runs; nowhere by default.

    Raises:
        InputError: If the parison's mesh is degenerate, can move away as a whole, or starts through the mold; or if
            the run would take more steps than anyone would wait for.
    """
    _warn_of_float32()
    _check_material(material)
    _check_loading(pressure)
    count = len(parison.positions)
    if refinement is not None and forest is None:
        forest, parison = _planted(parison, refinement)
    carried = {str(key): _carried(str(key), own, count, forest) for key, own in (fields or {}).items()}
    positions, triangles = np.asarray(parison.positions, float), np.asarray(parison.triangles)
    _check_mesh(positions, triangles, parison)
    grid = lying = None
    if mold is not None:
        grid = _search_grid(mold, positions, triangles, store)
        start.check_start(parison, triangles, mold, grid)
        pushes = pressure.pushes(float(solver.end_time), reference.enclosed_volume(positions, triangles))
        parison, lying = _laid(parison, triangles if forest is None else forest.triangles, pushes, mold, grid)
        positions = np.asarray(parison.positions, float)
        forest = None if forest is None else dataclasses.replace(forest, positions=positions)
    sheet = _reference_sheet(parison)
    bound = as_real(reference.shape_bound(positions, triangles))
    held = np.asarray(parison.fixed) | np.asarray(parison.clamped)[:, None]
    mobility, grown = as_real(~held.T), None
    if refinement is not None and forest is not None:
        _check_room(refinement, len(triangles))
        bend = None if mold is None or grid is None or not refinement.base_level else bends(mold, grid, store)
        fine = None if grid is None else start.fine_at_once(forest, lying, refinement, bend, grid)
        refinement = _with_room_for(refinement, forest, fine)
        grown = _grown(forest, refinement, sheet, mobility, bend, fine)
        bound = grown.bound
    planned = _planned_windows(bound, material, solver)
    tables = Tables(
        sheet=sheet,
        assembly=_assembly(positions, triangles, refinement),
        bound=bound,
        mobility=mobility,
        size=as_real(np.abs(positions).max()),
        grid=grid,
        forest=grown,
        lying=lying,
        window_count=planned + _spare_windows(grid),
        longest_window=np.int32(SHORT_WINDOW if refinement is not None else longest_window(planned, frames)),
        window_room=SHORT_WINDOW if refinement is not None else LONG_WINDOW,
        pairs_per_node=_pairs_per_node(mold, grid),
    )
    return Scene(
        parison=parison,
        material=material,
        pressure=pressure,
        solver=solver,
        mold=mold,
        refinement=refinement,
        tables=tables,
        name=name,
        fields=carried,
    )


def _assembly(positions: np.ndarray, triangles: np.ndarray, refinement: Refinement | None) -> Assembly:
    """In pairs, unless the elements will be others."""
    if refinement is not None:
        return make_assembly(triangles, len(positions))
    return make_paired_assembly(positions, triangles)


def _check_material(material: Law) -> None:
    if not is_declared(material, Law):
        raise InputError("is no law", "derive its class from jaxform.Law, decorated with jaxform.law", "material")
    for name, allowed in ranges_of(material).items():
        check_one(f"material.{name}", getattr(material, name), allowed)


def _check_loading(pressure: Loading) -> None:
    if not is_declared(pressure, Loading):
        remedy = "use make_pressure, or derive its class from jaxform.Loading, decorated with jaxform.loading"
        raise InputError("is no loading", remedy, "pressure")
    check_part(pressure, "pressure")


def _carried(name: str, field: Field, count: int, forest: bisection.Forest | None) -> Field:
    """A field of a parison with so many nodes, with values at all nodes of its forest."""
    key = f"fields.{name}"
    if not is_declared(field, Field):
        raise InputError("is no field", "derive its class from jaxform.Field, decorated with jaxform.field", key)
    if name in _RESERVED or not name.isidentifier():
        raise InputError("cannot be a field's name", f"give a name in letters, none of {', '.join(_RESERVED)}", key)
    check_part(field, key)
    new = {}
    for part in nodal_numbers(field):
        values = np.asarray(getattr(field, part), float)
        if values.ndim and values.shape != (count,):
            problem = f"needs one number, or one at each node: {count}, not {values.shape}"
            raise InputError(problem, "match the mesh", f"{key}.{part}")
        if forest is not None and values.ndim and len(values) < len(forest.positions):
            values = bisection.extended(values, forest.ends, forest.depth)
        new[part] = as_real(np.broadcast_to(values, (len(forest.positions) if forest is not None else count,)))
    made: Any = dataclasses.replace(field, **new)  # pyright: ignore
    return made


def _check_mesh(positions: np.ndarray, triangles: np.ndarray, parison: Parison) -> None:
    if len(triangles) == 0:
        raise InputError("the parison has no triangles", "give a surface mesh of triangles", "parison")
    bad = _degenerate(positions, triangles)
    if len(bad):
        raise InputError(
            f"{len(bad)} of its triangles are degenerate, the first is number {bad[0]}",
            "remesh the parison",
            "parison",
        )
    held = np.asarray(parison.clamped)[:, None] | np.asarray(parison.fixed)
    if np.all(held):
        raise InputError("nothing can move: every node is clamped", "clamp fewer nodes or refine the mesh", "parison")


def _degenerate(positions: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    edge1 = positions[triangles[:, 1]] - positions[triangles[:, 0]]
    edge2 = positions[triangles[:, 2]] - positions[triangles[:, 0]]
    area = 0.5 * np.linalg.norm(np.cross(edge1, edge2), axis=1)
    longest = np.maximum(np.square(edge1).sum(1), np.square(edge2).sum(1))
    return np.flatnonzero(~(area > 1e-9 * longest))


def _laid(
    parison: Parison, triangles: np.ndarray, pushes: np.ndarray, mold: Mold, grid: SearchGrid
) -> tuple[Parison, jax.Array | None]:
    """The parison with what lies on the mold exactly there; and which nodes (n_node,) those are, None where none."""
    found = start.lying(parison, triangles, pushes, mold, grid)
    if not np.any(found.wall):
        return parison, None
    if len(bad := _degenerate(found.positions, triangles)):
        raise InputError(
            f"the parison cannot be laid onto it: {len(bad)} of its triangles would be degenerate",
            "compare the sizes of mold and parison (`jaxform check`, mold.scale)",
            "mold",
        )
    return dataclasses.replace(parison, positions=as_real(found.positions)), as_index(found.wall)


def _with_room_for(refinement: Refinement, forest: bisection.Forest, fine: np.ndarray | None) -> Refinement:
    """With room for half as many elements again as there are when the run begins."""
    if fine is None or not len(fine):
        return refinement
    least = min(3 * (forest.root_count + len(fine)) // 2, forest.root_count << forest.depth)
    return dataclasses.replace(refinement, elements=max(refinement.elements, least))


def _reference_sheet(parison: Parison) -> Sheet:
    triangles = np.asarray(parison.triangles)
    inverse, area = reference.reference_metric(np.asarray(parison.positions, float), triangles)
    # A component that only a symmetry plane fixes tells where that plane is; the volume is counted from there.
    on_plane = np.asarray(parison.fixed) & ~np.asarray(parison.clamped)[:, None]
    places = np.asarray(parison.positions)
    origin = []
    for k, axis in enumerate("xyz"):
        there = places[on_plane[:, k], k] if on_plane[:, k].any() else np.zeros(1)
        if np.ptp(there) > 1e-6 * np.ptp(places, axis=0).max():
            raise InputError(
                "nodes are held on more than one plane, from which the enclosed volume cannot be counted",
                f"keep one symmetry plane across {axis}",
                "parison.fixed",
                f"{axis} from {there.min():.4g} to {there.max():.4g} m",
            )
        origin.append(there.mean())
    return Sheet(as_index(triangles.T), as_real(inverse), as_real(area), as_real(origin))


def _check_room(refinement: Refinement, count: int) -> None:
    if refinement.elements < count:
        mend = f"make room for the {count} elements that there are at first, and more"
        raise InputError("is too little", mend, "refinement.elements", refinement.elements)


def _planted(parison: Parison, refinement: Refinement) -> tuple[bisection.Forest, Parison]:
    """The forest of a parison's mesh, and the parison with all its nodes."""
    forest = bisection.build_forest(
        np.asarray(parison.positions, float),
        np.asarray(parison.triangles),
        bisection.even_depth(refinement.deepest),
        clamped=np.asarray(parison.clamped),
        fixed=np.asarray(parison.fixed),
    )
    thickness = bisection.extended(np.asarray(parison.thickness, float), forest.ends, forest.depth)
    return forest, grown_parison(forest, thickness)


def grown_parison(forest: bisection.Forest, thickness: np.ndarray | float) -> Parison:
    """The parison of a forest, with all its nodes, from their thickness [m]."""
    triangles = forest.triangles[: forest.root_count]
    return make_parison(forest.positions, triangles, thickness, forest.clamped, forest.fixed)


def _grown(
    forest: bisection.Forest,
    refinement: Refinement,
    sheet: Sheet,
    mobility: jax.Array,
    bend: Bend | None,
    fine: np.ndarray | None,
) -> Forest:
    """The forest as the program needs it."""
    inverse, area = reference.reference_metric(forest.positions, forest.triangles)
    owner = np.zeros(len(forest.positions), np.int32)
    inner = np.flatnonzero(forest.middle >= 0)[::-1]
    owner[forest.middle[inner]] = inner
    first_nodes = int(np.sum(forest.ends[:, 0] == forest.ends[:, 1]))
    bound = as_real(reference.shape_bound(forest.positions, forest.triangles))
    heavier = jnp.ones_like(bound)
    if refinement.scaled_levels:
        unscaled = forest.level() <= refinement.deepest - refinement.scaled_levels
        heavier = jnp.maximum(bound / jnp.max(jnp.where(unscaled, bound, 0.0)), 1.0)
    return Forest(
        sheet=Sheet(as_index(forest.triangles.T), as_real(inverse), as_real(area), sheet.origin),
        bound=bound / heavier,
        heavier=heavier,
        partner=as_index(forest.partner),
        middle=as_index(forest.middle),
        half_edges=as_index(forest.half_edges.T),
        # Bisections come between the first triangles round a node, whose slots are every other one.
        root_row=as_index(forest.corner_slots[: forest.root_count].T // 2),
        ends=as_index(forest.ends.T),
        owner=as_index(owner),
        mobility=mobility,
        bend=bend,
        fine_at_once=as_index(fine) if fine is not None and len(fine) else None,
        root_count=forest.root_count,
        depth=forest.depth,
        first_nodes=first_nodes,
        half_edge_count=int(forest.half_edges.max()) + 2,
        valence=int(forest.corner_slots.max()) + 1,
        node_room=node_room(refinement.elements, first_nodes, len(forest.positions)),
    )


def bends(mold: Mold, grid: SearchGrid, store: Store | None = None) -> Bend:
    """Distance from the middles of a grid's cells to an edge at which the mold is bent, to half a cell or so.

    The search grid's cells are as large as the mold's triangles, so they are cut into as many along each axis as there
    is room for.
    """
    edges = topology.feature_edges(np.asarray(mold.vertices, float), np.asarray(mold.triangles), _BEND, rims=False)
    parts = max(1, int(np.cbrt(_MOST_BEND_CELLS / np.prod(np.asarray(grid.shape, float)))))
    shape = tuple(parts * int(count) for count in np.asarray(grid.shape))
    width = float(grid.width) / parts
    corner = np.asarray(grid.corner, float)
    if not len(edges):
        return Bend(as_real(np.full(int(np.prod(shape)), np.inf)), as_index(parts))
    key = edges, corner, np.array([width, *shape])
    kept = (store or Store()).arrays("bends", key, lambda: {"distance": _to_edges(edges, corner, width, shape)})
    return Bend(as_real(kept["distance"].ravel()), as_index(parts))


def _to_edges(edges: np.ndarray, corner: np.ndarray, width: float, shape: tuple[int, ...]) -> np.ndarray:
    """Distance [m] from the middles of cells to the edges (n, 2, 3) [m], to half a cell or so."""
    from scipy import ndimage  # not needed where the distances are kept

    # Points along the edges, two in a cell's width.
    count = np.ceil(np.linalg.norm(edges[:, 1] - edges[:, 0], axis=1) / (0.5 * width)).astype(int) + 1
    owner = np.repeat(np.arange(len(edges)), count)
    share = ((np.arange(len(owner)) - (np.cumsum(count) - count)[owner]) / (count[owner] - 1))[:, None]
    points = (1 - share) * edges[owner, 0] + share * edges[owner, 1]
    cell = np.clip(np.floor((points - corner) / width).astype(int), 0, np.array(shape) - 1)
    far = np.ones(shape, bool)
    far[tuple(cell.T)] = False
    return width * np.asarray(ndimage.distance_transform_edt(far))


def _search_grid(mold: Mold, positions: np.ndarray, triangles: np.ndarray, store: Store | None = None) -> SearchGrid:
    """Made for nodes that move a quarter of an element's side within a window: a tenth of the speed of sound."""
    corners = positions[triangles]
    side = float(np.median(np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2)))
    return build_grid(np.asarray(mold.vertices, float), np.asarray(mold.triangles), 0.25 * side, store)


def _pairs_per_node(mold: Mold | None, grid: SearchGrid | None) -> int:
    """Room for pairs: a node that moves far over a fine mold meets many of its triangles in a window."""
    if mold is None or grid is None or grid.far is None:
        return PAIRS_PER_NODE
    corners = np.asarray(mold.vertices, float)[np.asarray(mold.triangles)]
    cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    within = np.pi * float(grid.farthest) ** 2 / np.median(0.5 * np.linalg.norm(cross, axis=1))
    rungs = round(np.log2(max(_FAR_NODES * within / PAIRS_PER_NODE, 1.0)))
    return PAIRS_PER_NODE * 2 ** int(min(rungs, _MOST_PAIRS_RUNGS))


def _planned_windows(bound: jax.Array, material: Law, solver: Solver) -> int:
    """Enough short windows for the step that the stiffest strain up to stretch 6 would ask for."""
    step = float(solver.safety) * float(
        _stiffest_step(as_real(np.asarray(bound).max()), material, as_real(_LARGEST_STRETCH))
    )
    steps = 1.3 * float(solver.end_time) / step if step > 0 else np.inf
    if not steps < MOST_STEPS:
        raise InputError(
            f"the run would take {steps:.2g} steps of {step:.2g} s",
            "shorten it, coarsen the smallest elements or soften the material",
            "solver.end_time",
            float(solver.end_time),
        )
    return int(np.ceil(steps / SHORT_WINDOW))


def _spare_windows(grid: SearchGrid | None) -> int:
    """For some that contact cuts short when nodes fly through the mold, and some that are taken anew."""
    return 32 if grid is None else 32 + round(2 * float(grid.size) / float(grid.reach))


def longest_window(planned: int, frames: int) -> int:
    """Steps of the longest window, so that of so many planned short ones there are enough that are taken."""
    # Steps are not all alike, so there are twice as many windows as frames.
    longest, enough = SHORT_WINDOW, _PLANNED_TO_TAKEN * max(_LEAST_WINDOWS, 2 * frames)
    while longest < LONG_WINDOW and planned * SHORT_WINDOW >= 2 * longest * enough:
        longest *= 2
    return longest


def first_step(scene: Scene) -> float:
    """How long the first step is at least [s]: what the elements bound it to before they stretch.

    What a run measures is up to twice as long. This needs no program of the mesh's size.
    """
    forest = scene.tables.forest
    active = np.arange(len(scene.parison.triangles))
    if forest is not None and forest.fine_at_once is not None:
        bisected = np.asarray(forest.fine_at_once)
        children = 2 * bisected + forest.root_count
        active = np.setdiff1d(np.concatenate([active, children, children + 1]), bisected)
    bound = as_real(np.max(np.asarray(scene.tables.bound)[active]))
    return float(scene.solver.safety) * float(_stiffest_step(bound, scene.material, as_real(1.0)))


@jax.jit
def _stiffest_step(bound: jax.Array, material: Law, largest: jax.Array) -> jax.Array:
    """The step [s] for the largest bound [1/m^2] of the elements, up to a stretch."""
    square = jnp.square(jnp.linspace(1.0, largest, 64))
    unit = jnp.ones_like(square), jnp.zeros_like(square), jnp.ones_like(square)
    strain = membrane.invariants((square, jnp.zeros_like(square), square), jnp.stack(unit))
    stiffness = membrane.tangent_stiffness(strain, material)
    stiffest = jnp.max(jnp.where(jnp.isfinite(stiffness), stiffness, 0.0))  # beyond a limit stretch there is none
    return membrane.stable_step(stiffest * bound, material)


def _warn_of_float32() -> None:
    if not jax.config.read("jax_enable_x64"):
        warnings.warn(
            "jaxform computes in float32 because JAX's x64 mode is off; "
            'for full accuracy call jax.config.update("jax_enable_x64", True) first',
            stacklevel=3,
        )

"""Building a scene on the host: validation, reference geometry, search structure, number of windows."""

from __future__ import annotations

import contextlib
import dataclasses
import warnings
from collections.abc import Iterator, Mapping, Sequence

import jax
import numpy as np

from jaxform.contact.broad_phase import PAIRS_PER_NODE
from jaxform.core.compilation import with_standard_promotion
from jaxform.core.errors import InputError, format_place, warn_of
from jaxform.core.pytree import as_index, as_real, cast_to_precision, check_untraced
from jaxform.core.store import PACKAGE, Store
from jaxform.loads import Loading, RegionalLoad
from jaxform.materials import Cooling, Law
from jaxform.mesh import bisection, topology, volumes
from jaxform.mesh.topology import HOLDING_FACETS, sharp_edges
from jaxform.model.field import Field
from jaxform.model.part import Part, check_part
from jaxform.model.scene import Parison, Refinement, Scene, Solver, enclosed_volumes, sample_pressures
from jaxform.model.tables import LONG_WINDOW, SHORT_WINDOW, Assembly, Precomputed, ReferenceGeometry, Rim, SceneBox
from jaxform.prepare import component_validation, initial_contact
from jaxform.prepare.planning import (
    bends,
    build_hierarchy,
    check_capacity,
    expected_stretch,
    longest_window,
    pack_forest,
    plan_windows,
    reserve_capacity,
    spare_windows,
    stiffens_steeply,
    tool_steps,
)
from jaxform.sheet.discretization import NEVER
from jaxform.sheet.packing import make_assembly, make_paired_assembly
from jaxform.tools.mold import Mold, Motion
from jaxform.tools.search import SearchGrid, build_grid
from jaxform.tools.surface_walk import ContactSurface, connected_parts, signed_neighbors

# Rims that can move, along which the enclosed volume is not all that the sheet sweeps; on the host.

_ON_PLANE = 1e-9  # of the sheet's extent


def moving_rim(
    positions: np.ndarray,
    triangles: np.ndarray,
    held: np.ndarray,
    origin: np.ndarray,
    forest: bisection.TriangleForest | None = None,
) -> Rim | None:
    """The rim of a sheet whose edges sweep a cone with the origin as they move; None where none do.

    Edges of clamped nodes do not move, and those on a symmetry plane through the origin stay in it.

    Args:
        positions: Node positions (n_node, 3) [m].
        triangles: Node numbers (n_element, 3).
        held: Components that never move (n_node, 3).
        origin: Point from which the enclosed volume is counted (3,) [m].
        forest: Forest of a refined mesh; its nodes are those above.
    """
    if forest is None:
        ends, triangle = topology.open_sides(triangles), None
    else:
        triangle, side = np.nonzero(bisection.rim_sides(forest))
        ends = np.stack([forest.triangles[triangle, side], forest.triangles[triangle, (side + 1) % 3]], 1)
    there = held & (np.abs(positions - origin) <= _ON_PLANE * np.ptp(positions, axis=0).max())
    on_plane = np.any(there[ends].all(1), axis=1)
    moves = ~(on_plane | held[ends].all((1, 2)))
    if not moves.any():
        return None
    return Rim(as_index(ends[moves].T), None if triangle is None else as_index(triangle[moves]))


def _hold_regions(
    load: RegionalLoad,
    positions: np.ndarray,
    triangles: np.ndarray,
    held: np.ndarray,
    origin: np.ndarray,
    forest: bisection.TriangleForest | None,
) -> RegionalLoad:
    """The loads of regions with the volumes between their borders and the origin; arguments as of `moving_rim`.

    Raises:
        InputError: A border can move: it would sweep a volume that its region's elements do not know.
    """
    own, volume = np.asarray(load.regions), np.zeros(len(load.loads))
    deep = None if forest is None else forest.inherit(own)
    for k, name in enumerate(load.names):
        part = None
        if forest is not None and deep is not None:
            part = dataclasses.replace(forest, triangles=forest.triangles[deep[k]], root_count=int(own[k].sum()))
        moves = moving_rim(positions, triangles[own[k]], held, origin, part)
        if moves is not None:
            where = format_place(positions[np.asarray(moves.ends)[:, 0]].mean(0))
            remedy = "clamp the nodes on the border of the region (parison.clamp), as a clamp grid holds the sheet"
            raise InputError(f"has a border that can move, at {where} m", remedy, f"gas.{name}.region")
        volume[k] = _border_volume(positions, triangles[own[k]], held, origin)
    return dataclasses.replace(load, border_volume=as_real(volume))


def _border_volume(positions: np.ndarray, triangles: np.ndarray, held: np.ndarray, origin: np.ndarray) -> float:
    """Volume [m^3] between the origin and the surface that closes the border of a region, from its held edges.

    That surface is made of triangles to the middle of the border, which is on the symmetry planes that the region has.
    """
    ends = topology.open_sides(triangles)
    still = held[ends].all((1, 2))
    if not still.any():
        return 0.0
    border = positions[ends[still]] - origin
    on_plane = held[ends[~still]].all(1).any(0)
    middle = np.where(on_plane, 0.0, border.reshape(-1, 3).mean(0))
    return float(np.einsum("i,ni->", middle, np.cross(border[:, 0], border[:, 1])) / 6.0)


_FAR_NODES = 0.125  # of all, that may be listed with all that is within the farthest reach
_MOST_PAIR_DOUBLINGS = 3  # by doubling, of the capacity for pairs when a scene is built


@with_standard_promotion
def build_scene(
    *,
    parison: Parison,
    material: Law,
    pressure: Loading,
    solver: Solver,
    mold: Mold | None = None,
    refinement: Refinement | None = None,
    forest: bisection.TriangleForest | None = None,
    fields: Mapping[str, Field] | None = None,
    cooling: Cooling | None = None,
    fill: bool = True,
    part: Part | None = None,
    tools: Sequence[Mold] = (),
    name: str = "scene",
    frames: int = 0,
    store: Store | None = None,
) -> Scene:
    """Builds a scene: validates it and does all host work.

    Args:
        parison: The sheet.
        material: The material model; a number of it may have a value at each node of the parison (..., n_node).
        pressure: The pressure history, or any other loading.
        solver: Options of the time integration.
        mold: The mold; None for free inflation.
        refinement: Adaptive refinement; None for a fixed mesh.
        forest: Hierarchy of the parison's mesh, if the parison has its nodes already; else it is built here, with the
            mean thickness of the ends of their edge at new nodes.
        fields: Nodal fields of the sheet, by name, with a value at each node of the parison.
        cooling: Cooling of the sheet; None where it keeps its temperature.
        fill: True if the mold is to be filled: if a gap of a fifth of its depth remains, the status has `UNFILLED`.
        part: The part of the formed sheet, from `make_part`, to which statistics, objectives and pictures refer; all of
            it by default.
        tools: Tools besides the mold, each with a name of its own, motion and contact law.
        name: Name of the scene.
        frames: Number of times at which the run is observed, which are window boundaries.
        store: Store of the mold's search structure between runs; none by default.

    Raises:
        InputError: If the parison's mesh is degenerate, can move as a rigid body, or initially penetrates the mold; or
            if the run would take too many steps.
    """
    check_untraced()
    _warn_of_float32()
    # Parts may have been made before x64 was switched.
    parison, solver = cast_to_precision(parison), cast_to_precision(solver)
    mold, refinement = cast_to_precision(mold), cast_to_precision(refinement)
    tools = component_validation.validate_tools([cast_to_precision(tool) for tool in tools])
    tools = [component_validation.set_behind_plane(tool, parison) for tool in tools]
    surfaces = [*([] if mold is None else [mold]), *tools]
    if solver.edge_contact and refinement is not None:
        problem = "cannot be combined with a mesh that is refined during the run"
        raise InputError(problem, "leave [refinement] out, or edge_contact", "solver.edge_contact", True)
    component_validation.check_smooth_landing(solver, surfaces)
    check_part(part, None if mold is None else len(mold.triangles), [len(tool.triangles) for tool in tools])
    pressure, count = component_validation.validate_loading(pressure), len(parison.positions)
    component_validation.check_weight(solver, refinement)
    if refinement is not None and forest is None:
        forest, parison = build_hierarchy(parison, refinement, pressure)
    material = component_validation.validate_law(material, count, forest)
    cooling = component_validation.validate_cooling(cooling, fields or {}, surfaces)
    component_validation.check_temperature(material, parison, cooling, surfaces)
    carried = {
        str(key): component_validation.validate_field(str(key), one, count, forest)
        for key, one in (fields or {}).items()
    }
    positions, triangles = np.asarray(parison.positions, float), np.asarray(parison.triangles)
    _check_mesh(positions, triangles, parison)
    grids: list[SearchGrid] = []
    in_contact: tuple[np.ndarray, np.ndarray] | None = None
    for number, surface in enumerate(surfaces):
        with _named_errors(surface, mold):
            component_validation.check_motion(surface, parison)
            grids.append(_search_grid(surface, positions, triangles, store))
            initial_contact.check_start(parison, triangles, surface, grids[-1])
            pushes = sample_pressures(pressure, solver, parison, material)
            parison, in_contact = _place_on_surface(
                parison,
                triangles if forest is None else forest.triangles,
                pushes if surface.motion is None else _push_against(surface.motion, positions, triangles),
                ContactSurface(surface, grids[-1]),
                number,
                in_contact,
            )
        positions = np.asarray(parison.positions, float)
        forest = None if forest is None else dataclasses.replace(forest, positions=positions)
    grid = grids[0] if mold is not None else None
    sheet = _reference_sheet(parison, pressure)
    rest = parison.remove_pre_stretch(positions)
    bound = as_real(volumes.shape_bound(rest, triangles))
    held = np.asarray(parison.fixed)
    if parison.clamp_until is None:
        held = held | np.asarray(parison.clamped)[:, None]
    else:
        component_validation.check_clamp_opening(parison, pressure, solver, surfaces)
        in_contact = _release_from_moving_tools(in_contact, parison, surfaces)
    mobility, grown = as_real(~held.T), None
    if isinstance(pressure, RegionalLoad):
        pressure, rim = _hold_regions(pressure, positions, triangles, held, np.asarray(sheet.origin), forest), None
    else:
        rim = moving_rim(positions, triangles, held, np.asarray(sheet.origin), forest)
    component_validation.check_gas(pressure, enclosed_volumes(pressure, parison))
    if refinement is not None and forest is not None:
        check_capacity(refinement, len(triangles))
        bend = None if mold is None or grid is None or not refinement.base_level else bends(mold, grid, store)
        fine = (
            None
            if grid is None
            else initial_contact.find_initial_bisections(
                forest, None if in_contact is None else as_index(in_contact[0]), refinement, bend, grid
            )
        )
        refinement = reserve_capacity(refinement, forest, fine)
        of_forest = parison.remove_pre_stretch(forest.positions)
        grown = pack_forest(forest, refinement, sheet, mobility, bend, fine, of_forest)
        bound = grown.bound
    cold, change = component_validation.coldest_temperature(parison, cooling, solver, material, surfaces)
    law = material.at(cold)
    steep = stiffens_steeply(law)
    expected = (
        expected_stretch(parison, law, sample_pressures(pressure, solver, parison, material), mold, tools)
        if steep
        else None
    )
    planned = plan_windows(bound, law, solver, expected)
    if steep and refinement is not None:
        # Its windows do not become longer.
        planned *= LONG_WINDOW // SHORT_WINDOW
    end_time = float(solver.end_time)
    moving = sum(tool_steps(one.motion, own, end_time, np.inf) for one, own in zip(surfaces, grids, strict=True))
    window_count = (
        planned + int(np.ceil(moving / SHORT_WINDOW)) + max(spare_windows(own, change) for own in grids or [None])
    )
    longest = longest_window(planned, frames, steep=steep)
    tables = Precomputed(
        sheet=sheet,
        assembly=_assembly(rest, triangles, refinement),
        bound=bound,
        mobility=mobility,
        size=as_real(np.abs(positions).max()),
        box=_box(surfaces, positions) if surfaces else None,
        grid=grid,
        forest=grown,
        initial_contact=None if in_contact is None else as_index(in_contact[0]),
        window_count=window_count,
        planned=np.int32(window_count if steep else NEVER),
        longest_window=np.int32(SHORT_WINDOW if refinement is not None else longest),
        step_capacity=SHORT_WINDOW if refinement is not None else LONG_WINDOW,
        pairs_per_node=max([PAIRS_PER_NODE, *map(_pairs_per_node, surfaces, grids)]),
        rim=rim,
        tool_grids=tuple(grids[len(grids) - len(tools) :]),
        neighbors=_neighbors(surfaces),
        edges=_sharp_edges(surfaces, solver),
        initial_tool=None if in_contact is None or len(surfaces) == 1 else as_index(in_contact[1]),
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
        cooling=cooling,
        fill=bool(fill),
        part=part,
        tools=tuple(tools),
    )


@contextlib.contextmanager
def _named_errors(surface: Mold, mold: Mold | None) -> Iterator[None]:
    """Errors of a tool name it in their key, which else would be the mold's."""
    try:
        yield
    except InputError as error:
        if surface is mold or not error.key.startswith("mold"):
            raise
        raise dataclasses.replace(error, key=f"tool {surface.name}{error.key.removeprefix('mold')}") from None


def _push_against(motion: Motion, positions: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """The push (1,) of a sheet against a tool that touches it when the run begins, with the sign of a pressure."""
    far = np.asarray(motion.displacement, float)
    first = far[np.flatnonzero(far)[:1]].sum()
    corners = positions[triangles]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]).sum(0)
    return np.array([-np.sign(first) * np.sign(np.asarray(motion.direction, float) @ normal)])


def _neighbors(surfaces: list[Mold]) -> tuple[jax.Array, ...]:
    """The triangles beside those of each surface, where nodes slide on any."""
    if all(surface.contact.sticks for surface in surfaces):
        return ()
    return tuple(as_index(_neighbor_table(np.asarray(surface.triangles))) for surface in surfaces)


def _sharp_edges(surfaces: list[Mold], solver: Solver) -> tuple[jax.Array, ...]:
    """The sharp edges of each surface at which sides are held; empty where they are not, or, with a warning, none."""
    if not solver.edge_contact:
        return ()
    none = np.zeros((4, 0), np.int32)
    found = [
        sharp_edges(np.asarray(surface.vertices), np.asarray(surface.triangles), HOLDING_FACETS)
        if surface.contact.sticks
        else none
        for surface in surfaces
    ]
    if not any(edges.size for edges in found):
        problem = "has no effect: no tool that the sheet sticks to has a sharp edge"
        warn_of(problem, "leave it out", key="solver.edge_contact", value=True)
        return ()
    return tuple(map(as_index, found))


def _neighbor_table(triangles: np.ndarray) -> np.ndarray:
    """Neighbors (n_triangle, 3), and as a fourth column the connected part, where there are several."""
    beside = signed_neighbors(triangles)
    part = connected_parts(beside)
    return beside if part.max() == 0 else np.concatenate([beside, part[:, None]], axis=1)


def _assembly(positions: np.ndarray, triangles: np.ndarray, refinement: Refinement | None) -> Assembly:
    """The assembly of nodal forces: in pairs, unless refinement changes the elements."""
    if refinement is not None:
        return make_assembly(triangles, len(positions))
    return make_paired_assembly(positions, triangles)


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
        raise InputError(
            "every node is clamped, so nothing can move", "clamp fewer nodes or refine the mesh", "parison"
        )


def _degenerate(positions: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    edge1 = positions[triangles[:, 1]] - positions[triangles[:, 0]]
    edge2 = positions[triangles[:, 2]] - positions[triangles[:, 0]]
    area = 0.5 * np.linalg.norm(np.cross(edge1, edge2), axis=1)
    longest = np.maximum(np.square(edge1).sum(1), np.square(edge2).sum(1))
    return np.flatnonzero(~(area > 1e-9 * longest))


def _place_on_surface(
    parison: Parison,
    triangles: np.ndarray,
    pushes: np.ndarray,
    surface: ContactSurface,
    number: int,
    before: tuple[np.ndarray, np.ndarray] | None,
) -> tuple[Parison, tuple[np.ndarray, np.ndarray] | None]:
    """The parison with its nodes in contact exactly on the surface, and the initial contact with all so far.

    That is the signed triangle and the number of the surface (n_node,) each; None where nothing touches.
    """
    mold, grid, _ = surface
    wall, positions = initial_contact.find_initial_contact(parison, triangles, pushes, mold, grid)
    if not np.any(wall):
        return parison, before
    walls, numbers = np.zeros_like(wall), np.zeros_like(wall)
    if before is not None:
        walls, numbers = before
        wall = np.where(walls != 0, 0, wall)
        positions = np.where((wall != 0)[:, None], positions, np.asarray(parison.positions, float))
    if len(bad := _degenerate(positions, triangles)):
        raise InputError(
            f"the parison cannot be projected onto it: {len(bad)} of its triangles would be degenerate",
            "compare its size with the parison's (`jaxform check`, scale)",
            "mold",
        )
    walls, numbers = np.where(wall != 0, wall, walls), np.where(wall != 0, number, numbers)
    return dataclasses.replace(parison, positions=as_real(positions)), (walls, numbers)


def _release_from_moving_tools(
    found: tuple[np.ndarray, np.ndarray] | None, parison: Parison, surfaces: Sequence[Mold]
) -> tuple[np.ndarray, np.ndarray] | None:
    """The initial contact without clamped nodes on tools that move: when the clamp opens, these are elsewhere."""
    if found is None:
        return None
    walls, numbers = found
    moves = np.array([surface.motion is not None for surface in surfaces])
    return np.where(np.asarray(parison.clamped) & moves[numbers], 0, walls), numbers


def _reference_sheet(parison: Parison, pressure: Loading) -> ReferenceGeometry:
    triangles = np.asarray(parison.triangles)
    inverse, area = volumes.reference_metric(parison.remove_pre_stretch(parison.positions), triangles)
    # A component that only a symmetry plane fixes defines where that plane is; the volume is counted from there.
    on_plane = np.asarray(parison.fixed) & ~np.asarray(parison.clamped)[:, None]
    places = np.asarray(parison.positions)
    origin = []
    for k, axis in enumerate("xyz"):
        there = places[on_plane[:, k], k] if on_plane[:, k].any() else np.zeros(1)
        apart = np.ptp(there) > 1e-6 * np.ptp(places, axis=0).max()
        if apart and pressure.follows_volume:
            raise InputError(
                "nodes are fixed to more than one plane, so the enclosed volume is not defined",
                f"keep one symmetry plane across {axis}",
                "parison.fixed",
                f"{axis} from {there.min():.4g} to {there.max():.4g} m",
            )
        origin.append(there[0] if apart else there.mean())
    regions = pressure.regions if isinstance(pressure, RegionalLoad) else None
    return ReferenceGeometry(as_index(triangles.T), as_real(inverse), as_real(area), as_real(origin), regions)


def _box(surfaces: list[Mold], positions: np.ndarray) -> SceneBox:
    places = np.concatenate([positions, *(surface.where_it_turns() for surface in surfaces)])
    low, high = places.min(0), places.max(0)
    return SceneBox(as_real(0.5 * (low + high)), as_real(1.5 * (high - low).max()))


def _search_grid(mold: Mold, positions: np.ndarray, triangles: np.ndarray, store: Store | None = None) -> SearchGrid:
    """The grid for nodes that move a quarter of an element's side within a window: a tenth of the speed of sound."""
    corners = positions[triangles]
    side = float(np.median(np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2)))
    return build_grid(np.asarray(mold.vertices, float), np.asarray(mold.triangles), 0.25 * side, store)


def _pairs_per_node(mold: Mold | None, grid: SearchGrid | None) -> int:
    """Capacity for pairs: a node that moves far over a fine mold meets many of its triangles in a window."""
    if mold is None or grid is None or grid.far is None:
        return PAIRS_PER_NODE
    corners = np.asarray(mold.vertices, float)[np.asarray(mold.triangles)]
    cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    within = np.pi * float(grid.farthest) ** 2 / np.median(0.5 * np.linalg.norm(cross, axis=1))
    doublings = round(np.log2(max(_FAR_NODES * within / PAIRS_PER_NODE, 1.0)))
    return PAIRS_PER_NODE * 2 ** int(min(doublings, _MOST_PAIR_DOUBLINGS))


def _warn_of_float32() -> None:
    if not jax.config.read("jax_enable_x64"):
        warnings.warn(
            "jaxform computes in float32 because JAX's x64 mode is off; "
            'for full accuracy call jax.config.update("jax_enable_x64", True) first',
            stacklevel=2,
            skip_file_prefixes=(str(PACKAGE),),
        )

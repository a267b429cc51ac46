"""Plans of a run: refinement's forest, estimated stretches, the number and length of windows."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np

from jaxform.core.errors import InputError
from jaxform.core.pytree import as_index, as_real
from jaxform.core.ranges import MOST_STEPS
from jaxform.core.store import Store
from jaxform.loads import Loading
from jaxform.materials import Law, Modes
from jaxform.mechanics import constitutive, membrane
from jaxform.mechanics.constitutive import ViscousMemory, overstress, strain_state
from jaxform.mesh import bisection, topology, volumes
from jaxform.model.scene import Parison, Refinement, Scene, Solver, make_parison
from jaxform.model.tables import (
    LONG_WINDOW,
    MOST_COOLING,
    RANGE_PER_STEP,
    SHORT_WINDOW,
    UNDAMPED,
    Bend,
    BisectionHierarchy,
    ReferenceGeometry,
)
from jaxform.sheet.discretization import refined_node_capacity
from jaxform.tools.mold import FASTEST, Mold, Motion
from jaxform.tools.search import SearchGrid

# Estimate of a sheet's largest stretch: for laws that stiffen steeply, whose steps depend on it. On the host.

LARGEST_STRETCH = 6.0  # that windows are planned for at most
_MARGIN = 2.0  # of the pressure, for a sheet that swings beyond its equilibrium


def expected_stretch(
    parison: Parison, material: Law, pushes: np.ndarray, mold: Mold | None, tools: Sequence[Mold] = ()
) -> float:
    """The stretch that a sheet reaches over most of its area, at most `LARGEST_STRETCH`.

    The pressure stretches it no further than a sphere of its size that is in equilibrium, a mold no further than to its
    own surface, and tools that move as far as they go.

    Args:
        parison: The sheet.
        material: Its law.
        pushes: Pressures of the process [Pa].
        mold: The mold; None for free inflation.
        tools: Other tools.
    """
    extents = _extents(np.asarray(parison.positions, float), parison)
    far = LARGEST_STRETCH
    if mold is None or mold.motion is None:
        load = _MARGIN * float(np.max(np.abs(pushes), initial=0.0)) * 0.5 * extents[1]
        far = float(_bearable_stretch(material, as_real(load / float(np.min(np.asarray(parison.thickness))))))
    moving = [tool for tool in tools if tool.motion is not None]
    far = max(far, _stretch_within(parison, extents, moving)) if moving else far
    return far if mold is None else min(far, _stretch_within(parison, extents, [mold, *moving]))


def _stretch_within(parison: Parison, extents: np.ndarray, tools: Sequence[Mold]) -> float:
    """The stretch of a sheet of these extents (3,) [m] that reaches as far as the tools go."""
    places = [np.asarray(parison.positions, float), *(tool.where_it_turns() for tool in tools)]
    both = _extents(np.concatenate(places), parison)
    across = 1.0 + 2.0 * (both[2] - extents[2]) / extents[1]
    across = min(across, both[2] / extents[2]) if extents[2] > 0.0 else across
    return min(LARGEST_STRETCH, max(*(both[:2] / extents[:2]), across))


def _extents(places: np.ndarray, parison: Parison) -> np.ndarray:
    """Lengths (3,) [m] along the axes of places (n, 3) [m], longest first, with what symmetry planes stand for."""
    on_plane = np.asarray(parison.fixed) & ~np.asarray(parison.clamped)[:, None]
    planes = [coordinate[there].mean() if there.any() else np.nan for coordinate, there in zip(
        np.asarray(parison.positions, float).T, on_plane.T, strict=True)]  # fmt: skip
    whole = 2.0 * np.abs(places - planes).max(0)
    return np.sort(np.where(on_plane.any(0), whole, np.ptp(places, axis=0)))[::-1]


@jax.jit
def _bearable_stretch(material: Law, load: jax.Array) -> jax.Array:
    """The largest stretch [-] at which a sphere does not bear a load, its pressure times radius over thickness [Pa]."""
    stretches = jnp.linspace(1.0, LARGEST_STRETCH, 101)

    def largest_stretch(zones: dict[str, jax.Array]) -> jax.Array:
        law = material.with_zones(zones)

        def density(stretch: jax.Array) -> jax.Array:
            square, none, one = jnp.square(stretch), jnp.zeros_like(stretch), jnp.ones_like(stretch)
            strain = membrane.invariants((square, none, square), jnp.stack([one, none, one]))
            return membrane.energy_density(strain, law)

        slope = jax.vmap(jax.grad(density))(stretches)
        yields = slope < load * jnp.square(stretches)  # beyond a limit, where it is no number, nothing does
        # One stretch further, at which it does bear it.
        return jnp.max(jnp.where(yields, jnp.append(stretches[1:], LARGEST_STRETCH), 1.0))

    zones = material.zones
    return largest_stretch(zones) if not zones else jnp.max(jax.vmap(largest_stretch, in_axes=-1)(zones))


_STEEP = 8.0  # times as many steps at the largest stretch as at first: such a law is planned for what it will meet
_FEWEST_WINDOWS = 128  # for which such a plan is made
_PLANNED_TO_TAKEN, _LEAST_WINDOWS = 4, 16  # as a rule; and how many windows a run has at least


def stiffens_steeply(material: Law) -> bool:
    """True where steps at the largest stretch are so much shorter than at first that no run is planned for it."""
    first, last = (
        float(_stiffest_step(as_real(1.0), material, as_real(stretch))) for stretch in (1.0, LARGEST_STRETCH)
    )
    return not last * _STEEP > first


def plan_windows(bound: jax.Array, material: Law, solver: Solver, expected: float | None = None) -> int:
    """The number of short windows for the step that the stiffest strain up to stretch 6 requires.

    For a law that stiffens steeply, up to the expected stretch: where it is stiffer, windows become longer
    (`dynamics.window_end`). A number for which there is always capacity is planned in any case.
    """
    stretch = as_real(LARGEST_STRETCH if expected is None else expected)
    step = float(solver.safety) * float(_stiffest_step(as_real(np.asarray(bound).max()), material, stretch))
    steps = float(solver.end_time) / step if step > 0 else np.inf
    steps = 1.3 * steps if expected is None else max(steps, _FEWEST_WINDOWS * SHORT_WINDOW)
    if not steps < MOST_STEPS:
        raise InputError(
            f"the run would take {steps:.2g} steps of {step:.2g} s",
            "shorten it, coarsen the smallest elements or soften the material",
            "solver.end_time",
            float(solver.end_time),
        )
    return int(np.ceil(steps / SHORT_WINDOW))


def spare_windows(grid: SearchGrid | None, cooling: float = 0.0) -> int:
    """The number of spare windows: for contact that cuts them short as nodes cross the mold, retries, cooling [K]."""
    spare = 32 + int(np.ceil(cooling / MOST_COOLING))
    return spare if grid is None else spare + round(2 * float(grid.size) / float(grid.reach))


def tool_steps(motion: Motion | None, grid: SearchGrid | None, end_time: float, step: float) -> float:
    """The number of a run's steps due to a moving mold, beyond those of a length [s] that it would take at rest."""
    if motion is None or grid is None:
        return 0.0
    time = np.minimum(np.asarray(motion.time, float), end_time)
    shortest = RANGE_PER_STEP * float(grid.farthest) / np.maximum(FASTEST * motion.mean_speeds(), 1e-300)
    return float(np.sum(np.diff(time) * np.maximum(1.0 / shortest - 1.0 / step, 0.0)))


def longest_window(planned: int, frames: int, *, steep: bool = False) -> int:
    """Steps of the longest window, so that the planned number of short ones suffices.

    Where a steep law is planned for the expected stretch, windows can become longer whatever the plan.
    """
    planned *= LONG_WINDOW // SHORT_WINDOW if steep else 1
    # Steps are not all alike, so there are twice as many windows as frames.
    longest, enough = SHORT_WINDOW, _PLANNED_TO_TAKEN * max(_LEAST_WINDOWS, 2 * frames)
    while longest < LONG_WINDOW and planned * SHORT_WINDOW >= 2 * longest * enough:
        longest *= 2
    return longest


def first_step(scene: Scene) -> float:
    """A lower bound on the first step [s]: from the elements' bounds before they stretch.

    The step that a run measures is up to twice as long. This needs no program of the mesh's size.
    """
    forest = scene.tables.forest
    active = np.arange(len(scene.parison.triangles))
    if forest is not None and forest.fine_at_once is not None:
        bisected = np.asarray(forest.fine_at_once)
        children = 2 * bisected + forest.root_count
        active = np.setdiff1d(np.concatenate([active, children, children + 1]), bisected)
    bound = as_real(np.max(np.asarray(scene.tables.bound)[active]))
    safety = float(scene.solver.safety) * (UNDAMPED if scene.solver.damping is None else 1.0)
    return safety * float(_stiffest_step(bound, scene.law, as_real(1.0)))


def _stiffness_at_once(square: jax.Array, modes: Modes) -> jax.Array:
    """Largest stiffness [Pa] that Prony terms add to a sheet stretched at once along both axes by these squares."""
    none, one = jnp.zeros_like(square), jnp.ones_like(square)
    g = square, none, square
    unit = jnp.stack([one, none, one])
    memory = ViscousMemory(modes.initial_stress(unit), modes.recursion(none[0])[1], modes.kind)
    stresses = overstress(g, unit, memory).modes
    return constitutive.viscous_stiffness(membrane.invariants(g, unit), strain_state(g, unit), stresses, modes)


@jax.jit
def _stiffest_step(bound: jax.Array, material: Law, largest: jax.Array) -> jax.Array:
    """The step [s] for the largest bound [1/m^2] of the elements, up to a stretch."""
    square = jnp.square(jnp.linspace(1.0, largest, 64))
    unit = jnp.ones_like(square), jnp.zeros_like(square), jnp.ones_like(square)
    strain = membrane.invariants((square, jnp.zeros_like(square), square), jnp.stack(unit))

    def steps(zones: dict[str, jax.Array], modes: Modes | None) -> jax.Array:
        local = dataclasses.replace(material.with_zones(zones), viscous=modes)
        values = constitutive.tangent_stiffness(strain, local)
        if local.viscous is not None:
            values += _stiffness_at_once(square, local.viscous)
        stiffest = jnp.max(jnp.where(jnp.isfinite(values), values, 0.0))  # beyond a limit stretch there is none
        return constitutive.stable_step(stiffest * bound, local)

    zones, modes = material.zones, material.viscous
    shifted = modes is not None and modes.modulus.ndim == 2
    if not zones and not shifted:
        return steps(zones, modes)
    return jnp.min(jax.vmap(steps, in_axes=(-1, -1 if shifted else None))(zones, modes))


# Refinement's setup before a run: the forest in arrays, and the distance to bent parts of the mold.

_BEND = 10.0  # degrees, from which two triangles of the mold make a bend
_MOST_BEND_CELLS = 500_000  # where the distance to such a bend is kept


def reserve_capacity(refinement: Refinement, forest: bisection.TriangleForest, fine: np.ndarray | None) -> Refinement:
    """The refinement with capacity for half as many elements again as there are at the start of the run."""
    if fine is None or not len(fine):
        return refinement
    least = min(3 * (forest.root_count + len(fine)) // 2, forest.root_count << forest.depth)
    return dataclasses.replace(refinement, elements=max(refinement.elements, least))


def check_capacity(refinement: Refinement, count: int) -> None:
    """Raises InputError where so many elements exceed the capacity."""
    if refinement.elements < count:
        remedy = f"allow for the {count} initial elements, and more"
        raise InputError("is too small", remedy, "refinement.elements", refinement.elements)


def build_hierarchy(
    parison: Parison, refinement: Refinement, pressure: Loading
) -> tuple[bisection.TriangleForest, Parison]:
    """The forest of a parison's mesh, with borders of the regions of a load, and the parison with all its nodes."""
    regions = getattr(pressure, "regions", None)
    forest = bisection.build_forest(
        np.asarray(parison.positions, float),
        np.asarray(parison.triangles),
        bisection.even_depth(refinement.deepest),
        clamped=np.asarray(parison.clamped),
        fixed=np.asarray(parison.fixed),
        region=None if regions is None else bisection.number_regions(np.asarray(regions)),
    )
    thickness, temperature = (
        None if values is None else bisection.extend_values(np.asarray(values, float), forest.ends, forest.depth)
        for values in (parison.thickness, parison.temperature)
    )
    assert thickness is not None
    extended = extend_parison(forest, thickness, temperature)
    inherited = {name: getattr(parison, name) for name in ("pre_stretch", "clamp_until", "guided")}
    return forest, dataclasses.replace(extended, **inherited)


def extend_parison(
    forest: bisection.TriangleForest, thickness: np.ndarray | float, temperature: np.ndarray | float | None
) -> Parison:
    """The parison of a forest, with all its nodes, from their thickness [m] and temperature [degC]."""
    triangles = forest.triangles[: forest.root_count]
    return make_parison(forest.positions, triangles, thickness, forest.clamped, forest.fixed, temperature)


def pack_forest(
    forest: bisection.TriangleForest,
    refinement: Refinement,
    sheet: ReferenceGeometry,
    mobility: jax.Array,
    bend: Bend | None,
    fine: np.ndarray | None,
    rest: np.ndarray,
) -> BisectionHierarchy:
    """The forest as the program needs it; its nodes are at `rest` (n_node, 3) [m] where the sheet has no stress."""
    inverse, area = volumes.reference_metric(rest, forest.triangles)
    owner = np.zeros(len(forest.positions), np.int32)
    inner = np.flatnonzero(forest.middle >= 0)[::-1]
    owner[forest.middle[inner]] = inner
    first_nodes = int(np.sum(forest.ends[:, 0] == forest.ends[:, 1]))
    bound = as_real(volumes.shape_bound(rest, forest.triangles))
    regions = None if sheet.regions is None else jnp.asarray(forest.inherit(np.asarray(sheet.regions)))
    heavier = jnp.ones_like(bound)
    if refinement.mass_scaling_levels:
        unscaled = forest.level() <= refinement.deepest - refinement.mass_scaling_levels
        heavier = jnp.maximum(bound / jnp.max(jnp.where(unscaled, bound, 0.0)), 1.0)
    return BisectionHierarchy(
        sheet=ReferenceGeometry(as_index(forest.triangles.T), as_real(inverse), as_real(area), sheet.origin, regions),
        bound=bound / heavier,
        mass_scale=heavier,
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
        node_capacity=refined_node_capacity(refinement.elements, first_nodes, len(forest.positions)),
    )


def bends(mold: Mold, grid: SearchGrid, store: Store | None = None) -> Bend:
    """Distance from the middles of a grid's cells to an edge at which the mold is bent, to half a cell or so.

    The search grid's cells are as large as the mold's triangles, so they are cut into as many along each axis as memory
    allows.
    """
    edges = topology.feature_edges(np.asarray(mold.vertices, float), np.asarray(mold.triangles), _BEND, rims=False)
    parts = max(1, int(np.cbrt(_MOST_BEND_CELLS / np.prod(np.asarray(grid.shape, float)))))
    shape = tuple(parts * int(count) for count in np.asarray(grid.shape))
    width = float(grid.width) / parts
    corner = np.asarray(grid.corner, float)
    if not len(edges):
        return Bend(as_real(np.full(int(np.prod(shape)), np.inf)), as_index(parts))
    key = edges, corner, np.array([width, *shape])
    kept = (store or Store()).arrays("bends", key, lambda: {"distance": _edge_distance(edges, corner, width, shape)})
    return Bend(as_real(kept["distance"].ravel()), as_index(parts))


def _edge_distance(edges: np.ndarray, corner: np.ndarray, width: float, shape: tuple[int, ...]) -> np.ndarray:
    """Distance [m] from the middles of cells to the edges (n, 2, 3) [m], to half a cell or so."""
    from scipy import ndimage  # not needed where the distances are kept

    points = topology.edge_points(edges, width)
    cell = np.clip(np.floor((points - corner) / width).astype(int), 0, np.array(shape) - 1)
    far = np.ones(shape, bool)
    far[tuple(cell.T)] = False
    return width * np.asarray(ndimage.distance_transform_edt(far))

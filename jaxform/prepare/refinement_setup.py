"""Refinement's setup before a run: the forest in arrays, and the distance to bent parts of the mold."""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np

from jaxform.core.errors import InputError
from jaxform.core.pytree import as_index, as_real
from jaxform.core.store import Store
from jaxform.mesh import bisection, topology, volumes
from jaxform.model.scene import Parison, Refinement, make_parison
from jaxform.model.tables import Bend, BisectionHierarchy, ReferenceGeometry
from jaxform.sheet.discretization import node_room
from jaxform.tools.mold import Mold
from jaxform.tools.search import SearchGrid

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


def build_hierarchy(parison: Parison, refinement: Refinement) -> tuple[bisection.TriangleForest, Parison]:
    """The forest of a parison's mesh, and the parison with all its nodes."""
    forest = bisection.build_forest(
        np.asarray(parison.positions, float),
        np.asarray(parison.triangles),
        bisection.even_depth(refinement.deepest),
        clamped=np.asarray(parison.clamped),
        fixed=np.asarray(parison.fixed),
    )
    thickness, temperature = (
        None if values is None else bisection.extend_values(np.asarray(values, float), forest.ends, forest.depth)
        for values in (parison.thickness, parison.temperature)
    )
    assert thickness is not None
    extended = extend_parison(forest, thickness, temperature)
    return forest, dataclasses.replace(extended, pre_stretch=parison.pre_stretch, guided=parison.guided)


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
    heavier = jnp.ones_like(bound)
    if refinement.mass_scaling_levels:
        unscaled = forest.level() <= refinement.deepest - refinement.mass_scaling_levels
        heavier = jnp.maximum(bound / jnp.max(jnp.where(unscaled, bound, 0.0)), 1.0)
    return BisectionHierarchy(
        sheet=ReferenceGeometry(as_index(forest.triangles.T), as_real(inverse), as_real(area), sheet.origin),
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
        node_room=node_room(refinement.elements, first_nodes, len(forest.positions)),
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

"""Contact at the start of a run: nodes on the mold, sheets through it, and elements that are refined at once.

Molds from CAD have a flange in the sheet's plane, to the rounding of the file. Nodes in contact with it stick from the
start on; at the edge of an opening the sheet is held within an element, so the mesh is refined there before it moves.
On the host.
"""

from __future__ import annotations

import jax
import numpy as np
from numpy.typing import NDArray

from jaxform.core.errors import InputError
from jaxform.mesh import bisection, topology
from jaxform.mesh.volumes import longest_sides
from jaxform.model.scene import Parison, Refinement
from jaxform.model.tables import Bend
from jaxform.tools.crossings import proper_crossings
from jaxform.tools.distances import nearest_places, point_triangle_distance
from jaxform.tools.mold import Mold
from jaxform.tools.search import SearchGrid

Array = NDArray[np.float64]

_ON = 0.01  # of the sheet's thickness: a node that is nearer to the mold lies on it
_IN_PLANE = 1.0 - 1e-6  # cosine between the normals of a triangle and of a symmetry plane in which it lies
_FACING = 0.1  # cosine between the sheet's normal and a triangle's, below which pressure does not define the side
_ASIDE = np.array([0.27, 0.84, 0.47])  # a direction along no edge of built-in shapes
_CHUNK = 2_000_000  # pairs of node and triangle processed together


def find_initial_contact(
    parison: Parison, triangles: NDArray[np.integer], pushes: np.ndarray, mold: Mold, grid: SearchGrid
) -> tuple[NDArray[np.int32], Array]:
    """Finds the nodes in contact with the mold, to a hundredth of the sheet's thickness.

    Args:
        parison: The sheet; of a refined one, all its nodes.
        triangles: Those that the nodes belong to (n_triangle, 3); of a refined sheet, of all levels.
        pushes: Pressures; the sign of the first that is not 0 is the direction of the push.
        mold: The mold.
        grid: Its search structure.

    Returns:
        Signed triangle numbers (n_node,) as `State.wall`, 0 where a node is not in contact; and the nodes' positions
        (n_node, 3) [m], on the mold for those in contact.
    """
    positions = np.asarray(parison.positions, float)
    node, triangle, gap = _contact_pairs(positions, tolerance(parison, grid), grid)
    corners = np.asarray(mold.vertices, float)[np.asarray(mold.triangles)]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    # A node that symmetry holds in the plane of a triangle slides along it: it neither comes nor goes.
    held = np.any(np.asarray(parison.fixed)[node] & (np.abs(normal[triangle]) > _IN_PLANE), axis=1)
    node, triangle, gap = node[~held], triangle[~held], gap[~held]
    pushed = np.sign(pushes[np.flatnonzero(pushes)[:1]]).sum() or 1.0
    facing = np.einsum("ij,ij->i", pushed * _normals(positions, triangles)[node], normal[triangle])
    inward = np.einsum("ij,ij->i", _inward_directions(positions, triangles)[node], normal[triangle])
    # Triangles that the pressure pushes against come first; where the mold stands across the sheet, the side is that of
    # the sheet's own elements.
    square = np.abs(facing) >= _FACING
    order = np.lexsort((-gap, np.round(np.abs(facing), 6), node))
    last = order[np.flatnonzero(np.diff(node[order], append=-1))]
    side = np.where(square, -np.sign(facing), np.where(inward < 0, -1, 1)).astype(np.int32)
    wall = np.zeros(len(positions), np.int32)
    wall[node[last]] = side[last] * (triangle[last] + 1)
    moved = positions.copy()
    # Nodes that are on the mold but for rounding errors are not moved.
    last = last[gap[last] > np.finfo(float).eps * float(grid.size)]
    moved[node[last]] = nearest_places(positions[node[last]], corners[triangle[last]])
    return wall, np.where(np.asarray(parison.fixed), positions, moved)


def tolerance(parison: Parison, grid: SearchGrid) -> float:
    """Distance [m] within which a node is in contact with the mold.

    It is small beside the thickness, but not below the resolution of single precision, in which files have numbers.
    """
    size = max(float(np.abs(np.asarray(parison.positions)).max()), float(grid.size))
    return max(_ON * float(np.median(np.asarray(parison.thickness))), 4 * float(np.finfo(np.float32).eps) * size)


def _contact_pairs(
    positions: Array, near: float, grid: SearchGrid
) -> tuple[NDArray[np.int64], NDArray[np.int64], Array]:
    """Nodes and the mold's triangles within a distance [m] of them, pair by pair, and how far they are apart [m]."""
    shape, width = np.asarray(grid.shape), float(grid.width)
    index = np.floor((positions - np.asarray(grid.corner, float)) / width).astype(int)
    inside = np.all((index >= 0) & (index < shape), axis=1)
    cell = np.asarray(np.ravel_multi_index(tuple(np.clip(index, 0, shape - 1).T), tuple(shape)))
    node = np.flatnonzero(inside & (np.asarray(grid.bound)[cell] <= near))
    start, listed = np.asarray(grid.start), np.asarray(grid.listed)
    outlines, frames = np.asarray(grid.outlines, float), np.asarray(grid.frames, float)
    found = [(node[:0], node[:0], np.zeros(0))]
    count = (start[cell + 1] - start[cell])[node]
    for part in np.split(node, np.flatnonzero(np.diff(np.cumsum(count) // _CHUNK)) + 1):
        count = (start[cell + 1] - start[cell])[part]
        rows = listed[np.repeat(start[cell[part]] - np.cumsum(count) + count, count) + np.arange(count.sum())]
        candidate = np.repeat(part, count)
        # The plane and the sphere round a triangle rule out nearly all.
        height = np.einsum("ij,ij->i", outlines[rows, 4:7], positions[candidate]) - outlines[rows, 7]
        keep = np.flatnonzero(np.abs(height) <= near)
        away = positions[candidate[keep]] - outlines[rows[keep], :3]
        keep = keep[np.einsum("ij,ij->i", away, away) <= np.square(outlines[rows[keep], 3] + near)]
        frame = frames[rows[keep]]
        corners = frame[:, None, :3] + np.stack([np.zeros_like(frame[:, :3]), frame[:, 12:15], frame[:, 15:]], 1)
        gap = point_triangle_distance(positions[candidate[keep]], corners)
        keep, gap = keep[gap <= near], gap[gap <= near]
        found.append((candidate[keep], np.asarray(grid.number)[rows[keep]], gap))
    node, triangle, gap = (np.concatenate(values) for values in zip(*found, strict=True))
    return node, triangle, gap


def _normals(positions: Array, triangles: NDArray[np.integer]) -> Array:
    """Unit normals of the sheet at its nodes (n_node, 3); 0 where there is no triangle."""
    edge1, edge2 = (positions[triangles[:, k]] - positions[triangles[:, 0]] for k in (1, 2))
    normal = _sum_to_nodes(np.cross(edge1, edge2), triangles, len(positions))
    return normal / np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), np.finfo(float).tiny)


def _inward_directions(positions: Array, triangles: NDArray[np.integer]) -> Array:
    """Sums of the vectors from each node to the middles of its triangles (n_node, 3) [m]."""
    count = _sum_to_nodes(np.ones((len(triangles), 1)), triangles, len(positions))
    return _sum_to_nodes(positions[triangles].mean(1), triangles, len(positions)) - count * positions


def _sum_to_nodes(values: Array, triangles: NDArray[np.integer], count: int) -> Array:
    """Values of triangles (n_triangle, k) added up at their nodes (count, k)."""
    node, each = triangles.ravel(), np.repeat(values, 3, axis=0)
    return np.stack([np.bincount(node, column, count) for column in each.T], axis=1)


def check_start(parison: Parison, triangles: NDArray[np.integer], mold: Mold, grid: SearchGrid) -> None:
    """Refuses a sheet that is through the mold.

    A sheet that touches it within the tolerance of `find_initial_contact` is accepted: a sheet through the mold still
    is when moved by as much to either side. It is not tested where it is given: edges of sheet and mold that meet
    there, as those of a disc and a rod with one axis do, would count as touching.

    Raises:
        InputError: If a side of an element crosses the mold.
    """
    positions = np.asarray(parison.positions, float)
    sides, _ = topology.edges(triangles)
    near = 2 * tolerance(parison, grid)
    off, aside = near * _normals(positions, triangles), 0.5 * near * _ASIDE
    for shift in (off + aside, off - aside, -off + aside, -off - aside):
        places = positions + shift
        through, triangle = proper_crossings(places[sides[:, 0]], places[sides[:, 1]], mold, grid)
        sides = sides[through]
        if not len(sides):
            return
    where = positions[sides[0]].mean(0)
    place = ", ".join(f"{value:.4g}" for value in where)
    what = mold.describe()
    raise InputError(
        f"the parison initially penetrates {what}, near ({place}) m, in triangle {triangle[0]} of it",
        f"move {what} (translate), make the parison smaller, or give a curved surface smaller triangles "
        "(element_size, segments)",
        "mold",
    )


def find_initial_bisections(
    forest: bisection.TriangleForest,
    in_contact: jax.Array | None,
    refinement: Refinement,
    bend: Bend | None,
    grid: SearchGrid,
) -> NDArray[np.int32]:
    """Triangles of the forest that are bisected before the run, ascending: closed, so that no node hangs.

    Those partly in contact, up to the deepest level; those near a bend of the mold, up to the base level.

    Args:
        forest: The forest, with its nodes where they are at the start of the run.
        in_contact: Initial contact of the nodes (n_node,), as `Precomputed.initial_contact`.
        refinement: Its limits.
        bend: Distance to the mold's bent parts, as in `BisectionHierarchy.bend`.
        grid: The mold's search structure.
    """
    level, corners = forest.level(), forest.positions[forest.triangles]
    side = longest_sides(corners)
    area = 0.5 * np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    wanted = np.zeros(len(level), bool)
    if in_contact is not None:
        wanted = _partly_in_contact(forest, np.asarray(in_contact)) & (level < refinement.deepest)
    if bend is not None:
        wanted |= (_bend_distance(corners.mean(1), bend, grid) < float(refinement.proximity_factor) * side) & (
            level < refinement.base_level
        )
    wanted &= 0.5 * area >= float(refinement.min_area)
    return np.flatnonzero(bisection.closure(_reachable_triangles(wanted, forest), forest)).astype(np.int32)


def _partly_in_contact(forest: bisection.TriangleForest, wall: NDArray[np.int32]) -> NDArray[np.bool_]:
    """Triangles (n_triangle,) of which some nodes are in contact and others are not, those of their parts included."""
    touches = wall != 0
    some = (touches & ~forest.clamped)[forest.triangles].any(1)
    each = (touches | forest.clamped)[forest.triangles].all(1)
    for level in range(forest.depth - 1, -1, -1):
        first, last = (forest.root_count * ((1 << k) - 1) for k in (level, level + 1))
        end = forest.root_count * ((1 << (level + 2)) - 1)
        some[first:last] |= some[last:end].reshape(-1, 2).any(1)
        each[first:last] &= each[last:end].reshape(-1, 2).all(1)
    return some & ~each


def _reachable_triangles(wanted: NDArray[np.bool_], forest: bisection.TriangleForest) -> NDArray[np.bool_]:
    """Those wanted whose parents are bisected, from level to level; without those that only closure requires."""
    for level in range(1, forest.depth + 1):
        first, last = (forest.root_count * ((1 << k) - 1) for k in (level, level + 1))
        above = forest.root_count * ((1 << (level - 1)) - 1)
        wanted[first:last] &= np.repeat(wanted[above:first], 2)
    return wanted


def _bend_distance(places: Array, bend: Bend, grid: SearchGrid) -> Array:
    """Distance (n,) [m] from places (n, 3) to the mold's bends, as the run computes it."""
    shape = int(bend.parts) * np.asarray(grid.shape)
    width = float(grid.width) / int(bend.parts)
    index = np.clip(np.floor((places - np.asarray(grid.corner, float)) / width).astype(int), 0, shape - 1)
    return np.asarray(bend.distance, float)[np.ravel_multi_index(tuple(index.T), tuple(shape))]

"""The triangulated mold and its search structure, built once on the host: the mold does not move.

Space is cut into cubes. Each cell near the mold lists every triangle within one cell's width (the *reach*) of it,
and every cell holds a lower bound on the distance from anywhere inside it to the mold. A node far away is then
dismissed by one look-up, and a near one is tested against the few triangles of its cell.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from scipy import ndimage

from jaxform.errors import InputError
from jaxform.pytree import as_real, pytree, static

_CELLS_ALONG = 32  # cells along the longest side of a coarse mold
_MOST_CELLS = 2_000_000
_CHUNK = 2_000_000  # pairs of cell and triangle looked at together, to bound the memory


@pytree
class Mold:
    """A rigid triangulated surface to which the sheet sticks; the triangles' orientation does not matter.

    Attributes:
        vertices: (n_vertex, 3) [m].
        triangles: Vertex numbers (n_triangle, 3).
        dropped: Degenerate or duplicate triangles that were left out of the file's.
    """

    vertices: jax.Array
    triangles: jax.Array
    dropped: int = static(default=0)


@pytree
class SearchGrid:
    """Where the mold's triangles are.

    Attributes:
        corner: Lowest corner (3,) [m].
        width: Side of a cell [m]; also the reach of the cells' lists.
        size: Largest side of the mold's bounding box [m].
        bound: Lower bound (n_cell,) [m] on the distance to the mold from anywhere in the cell.
        start: Where each cell's list begins (n_cell + 1,) in `listed`.
        listed: Triangle numbers, cell by cell.
        shape: Number of cells along x, y, z.
    """

    corner: jax.Array
    width: jax.Array
    size: jax.Array
    bound: jax.Array
    start: jax.Array
    listed: jax.Array
    shape: tuple[int, int, int] = static()


def make_mold(vertices: np.ndarray, triangles: np.ndarray, dropped: int = 0) -> Mold:
    """A mold from vertices (n_vertex, 3) [m] and triangles (n_triangle, 3).

    Raises:
        InputError: If there is no triangle or a coordinate is not finite.
    """
    if len(triangles) == 0:
        raise InputError("the mold has no triangles", "give a surface mesh of triangles", key="mold")
    if not np.all(np.isfinite(vertices)):
        raise InputError("a vertex of the mold is not finite", "repair the mesh", key="mold")
    return Mold(as_real(vertices), jnp.asarray(triangles, jnp.int32), dropped)


def build_grid(vertices: np.ndarray, triangles: np.ndarray) -> SearchGrid:
    """The search structure of a mold of vertices (n_vertex, 3) [m] and triangles (n_triangle, 3)."""
    corners = np.asarray(vertices, float)[np.asarray(triangles)]
    low, high = corners.min((0, 1)), corners.max((0, 1))
    size = float((high - low).max())
    width = _cell_width(corners, low, high)
    shape = tuple(int(n) for n in np.ceil((high - low) / width) + 2)
    corner = 0.5 * (low + high) - 0.5 * width * np.array(shape)
    cell, triangle, distance = _near_pairs(corners, corner, width, shape)
    order = np.lexsort((triangle, cell))
    cell, triangle, distance = cell[order], triangle[order], distance[order]
    start = np.searchsorted(cell, np.arange(np.prod(shape) + 1))
    return SearchGrid(
        corner=as_real(corner),
        width=as_real(width),
        size=as_real(size),
        bound=as_real(_distance_bound(cell, distance, width, shape)),
        start=jnp.asarray(start, jnp.int32),
        listed=jnp.asarray(triangle, jnp.int32),
        shape=(shape[0], shape[1], shape[2]),
    )


def _cell_width(corners: np.ndarray, low: np.ndarray, high: np.ndarray) -> float:
    """About twice the size of a typical triangle, within what memory and the mold's own size allow."""
    size = float((high - low).max())
    edge = float(np.median(np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2)))
    width = min(max(2.0 * edge, size / 128), size / _CELLS_ALONG)
    while np.prod(np.ceil((high - low) / width) + 2) > _MOST_CELLS:
        width *= 1.2
    return width


def _near_pairs(
    corners: np.ndarray, corner: np.ndarray, width: float, shape: tuple[int, ...]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """All (cell, triangle) closer than the reach, with the distance of the triangle from the cell's centre."""
    reach = width * (1.0 + np.sqrt(0.75) + 1e-6)
    first = np.floor((corners.min(1) - reach - corner) / width).astype(int)
    last = np.floor((corners.max(1) + reach - corner) / width).astype(int)
    first, last = np.clip(first, 0, np.array(shape) - 1), np.clip(last, 0, np.array(shape) - 1)
    span = last - first + 1
    count = span.prod(1)
    found = []
    for part in _chunks(count):
        triangle = np.repeat(part, count[part])
        k = np.arange(len(triangle)) - np.repeat(np.cumsum(count[part]) - count[part], count[part])
        s = span[triangle]
        index = first[triangle] + np.stack([k // (s[:, 1] * s[:, 2]), k // s[:, 2] % s[:, 1], k % s[:, 2]], 1)
        centre = corner + (index + 0.5) * width
        distance = point_triangle_distance(centre, corners[triangle])
        keep = distance <= reach
        cell = np.ravel_multi_index(tuple(index[keep].T), shape)
        found.append((cell, triangle[keep], distance[keep]))
    cells, triangles, distances = (np.concatenate(parts) for parts in zip(*found, strict=True))
    return cells, triangles, distances


def _chunks(count: np.ndarray) -> list[np.ndarray]:
    """Runs of triangles whose pairs fit in memory together."""
    group = np.cumsum(count) // _CHUNK
    return np.split(np.arange(len(count)), np.flatnonzero(np.diff(group)) + 1)


def _distance_bound(cell: np.ndarray, distance: np.ndarray, width: float, shape: tuple[int, ...]) -> np.ndarray:
    """Near the mold from the listed triangles, elsewhere from the distance between cells."""
    half_diagonal = np.sqrt(0.75) * width * (1 + 1e-6)
    nearest = np.full(int(np.prod(shape)), np.inf)
    np.minimum.at(nearest, cell, distance)
    touched = (nearest <= half_diagonal).reshape(shape)
    apart = np.asarray(ndimage.distance_transform_edt(~touched)).ravel()
    far = np.maximum(width, (apart - np.sqrt(3.0)) * width)
    return np.where(np.isfinite(nearest), np.maximum(nearest - half_diagonal, 0.0), far)


def point_triangle_distance(points: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """Distances (n,) [m] from points (n, 3) to triangles (n, 3, 3), pair by pair."""
    d, edge1, edge2 = corners[:, 0], corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    normal = np.cross(edge1, edge2)
    square = np.einsum("ij,ij->i", normal, normal)
    away = points - d
    gamma = np.einsum("ij,ij->i", np.cross(away, edge2), normal) / square
    delta = np.einsum("ij,ij->i", np.cross(edge1, away), normal) / square
    inside = (gamma >= 0) & (delta >= 0) & (gamma + delta <= 1)
    flat = np.abs(np.einsum("ij,ij->i", away, normal)) / np.sqrt(square)
    rim = np.min([_segment_distance(points, corners[:, k], corners[:, (k + 1) % 3]) for k in range(3)], axis=0)
    return np.where(inside, flat, rim)


def _segment_distance(points: np.ndarray, begin: np.ndarray, end: np.ndarray) -> np.ndarray:
    along, away = end - begin, points - begin
    t = np.clip(np.einsum("ij,ij->i", away, along) / np.einsum("ij,ij->i", along, along), 0.0, 1.0)
    return np.linalg.norm(away - t[:, None] * along, axis=1)


def first_crossing(
    begin: np.ndarray, end: np.ndarray, mold: Mold, grid: SearchGrid, margin: float = 1e-6
) -> tuple[int, int] | None:
    """The first segment (from `begin` to `end`, each (n, 3) [m]) that properly crosses the mold, with its triangle.

    Touching does not count: the crossing must lie inside segment and triangle by the relative margin.
    """
    segment, triangle = _segment_pairs(begin, end, grid)
    corners = np.asarray(mold.vertices, float)[np.asarray(mold.triangles)[triangle]]
    b, path = begin[segment], (end - begin)[segment]
    d, edge1, edge2 = corners[:, 0], corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    normal = np.cross(edge1, edge2)
    square = np.einsum("ij,ij->i", normal, normal)
    height = np.einsum("ij,ij->i", b - d, normal)
    slope = np.einsum("ij,ij->i", path, normal)
    # A path that hardly leaves the triangle's plane is a touch.
    steep = np.abs(slope) > 1e-9 * np.sqrt(square) * float(grid.size)
    beta = -height / np.where(steep, slope, 1.0)
    meet = b + beta[:, None] * path - d
    gamma = np.einsum("ij,ij->i", np.cross(meet, edge2), normal) / square
    delta = np.einsum("ij,ij->i", np.cross(edge1, meet), normal) / square
    # Strictly inside, for a sheet may rest on the rim of an open mold.
    inside = (gamma > margin) & (delta > margin) & (gamma + delta < 1 - margin)
    hit = np.flatnonzero(steep & inside & (beta > margin) & (beta < 1 - margin))
    return (int(segment[hit[0]]), int(triangle[hit[0]])) if len(hit) else None


def _segment_pairs(begin: np.ndarray, end: np.ndarray, grid: SearchGrid) -> tuple[np.ndarray, np.ndarray]:
    """Pairs of segments and triangles that can meet: segments are sampled once per cell width."""
    width, shape = float(grid.width), np.array(grid.shape)
    samples = np.ceil(np.linalg.norm(end - begin, axis=1) / width).astype(int) + 1
    segment = np.repeat(np.arange(len(begin)), samples)
    k = np.arange(len(segment)) - np.repeat(np.cumsum(samples) - samples, samples)
    t = (k + 0.5) / samples[segment]
    point = begin[segment] + t[:, None] * (end - begin)[segment]
    index = np.floor((point - np.asarray(grid.corner, float)) / width).astype(int)
    kept = np.all((index >= 0) & (index < shape), axis=1)
    cell = np.ravel_multi_index(tuple(index[kept].T), grid.shape)
    start = np.asarray(grid.start)
    count = start[cell + 1] - start[cell]
    flat = np.repeat(start[cell] - np.cumsum(count) + count, count) + np.arange(count.sum())
    pairs = np.unique(np.stack([np.repeat(segment[kept], count), np.asarray(grid.listed)[flat]], 1), axis=0)
    return pairs[:, 0], pairs[:, 1]

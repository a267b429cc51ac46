"""Regular triangles over a plane region with holes. On the host."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from jaxform.mesh.rows import positions_in_rows

Array = NDArray[np.float64]
Size = Callable[[Array], Array]
"""Length of the sides (n,) [m] at points (n, 2) [m]."""

_ROUNDS = 6  # of smoothing; more change little
_CLEAR = 0.6  # of the size: inner points keep that far from the rim, so that its edges are edges of the mesh
_MOST_PAIRS = 5_000_000  # of points and sides of the loops beside them, processed together
_FLAT = 1e-7  # of a triangle's side, its height, where it is none
_LEVELS = 4  # times that the largest size may be halved


def resample(curve: Array, size: Size) -> Array:
    """Points (k, 2) [m] along an open curve (n, 2) [m] as far apart as the local size, both ends included."""
    step = np.linalg.norm(np.diff(curve, axis=0), axis=1)
    local = size(0.5 * (curve[1:] + curve[:-1]))
    rank = np.concatenate([[0.0], np.cumsum(step / local)])
    places = np.linspace(0.0, rank[-1], max(2, round(rank[-1])) + 1)
    return np.stack([np.interp(places, rank, curve[:, k]) for k in range(2)], axis=1)


def triangulate(loops: Sequence[Array], size: Size) -> tuple[Array, NDArray[np.int32]]:
    """Nearly regular triangles over the inside of closed curves.

    Args:
        loops: Corners (k, 2) [m] of each closed curve, as far apart as the local size: the rim and the holes.
        size: Length of the sides.

    Returns:
        Points (n, 2) [m], those of the loops first and unmoved, and triangles (m, 3), counter-clockwise.

    Raises:
        ValueError: The curves are too close to each other, or too coarse, for the mesh to follow them.
    """
    points, triangles, missing = try_triangulate(loops, size)
    if len(missing):
        raise ValueError("the triangles do not follow the curves")
    return points, triangles.astype(np.int32)


def try_triangulate(loops: Sequence[Array], size: Size) -> tuple[Array, NDArray[np.int64], NDArray[np.int64]]:
    """The mesh of `triangulate`, and the loops' edges (k,) that it lacks, by their first point; raises nothing."""
    rim = np.concatenate(loops)
    inner = _lattice(rim, size)
    inner = inner[_is_clear(inner, loops, _CLEAR * size(inner))]
    for _ in range(_ROUNDS):
        points = np.concatenate([rim, inner])
        moved = _neighbours_mean(points, _inner_triangles(points, loops))[len(rim) :]
        stays = _is_clear(moved, loops, 0.5 * _CLEAR * size(moved))
        inner = np.where(stays[:, None], moved, inner)
    points = np.concatenate([rim, inner])
    triangles = _inner_triangles(points, loops)
    return points, triangles, _missing_edges(triangles, loops)


def _lattice(rim: Array, size: Size) -> Array:
    """Nested hexagonal lattices over the rim's bounding box: where the size is smaller, the next finer one."""
    low, high = rim.min(0), rim.max(0)
    spacing = float(size(rim).max())
    chosen = []
    for level in range(_LEVELS + 1):
        step = spacing / 2**level
        x, y = np.meshgrid(np.arange(low[0], high[0] + step, step), np.arange(low[1], high[1] + step, step * _ROW))
        x[1::2] += 0.5 * step
        points = np.stack([x.ravel(), y.ravel()], axis=1)
        wanted = np.clip(np.round(np.log2(spacing / size(points))), 0, _LEVELS)
        chosen.append(points[wanted == level])
    return np.concatenate(chosen)


_ROW = np.sqrt(0.75)  # distance of a hexagonal lattice's rows


def _is_clear(points: Array, loops: Sequence[Array], clearance: Array) -> NDArray[np.bool_]:
    """True where points are inside the loops and at a larger distance from them than the clearance."""
    return inside(points, loops) & (_rim_distance(points, loops) > clearance)


def inside(points: Array, loops: Sequence[Array]) -> NDArray[np.bool_]:
    """True where points (n, 2) are inside the loops: a line to the right crosses these an odd number of times."""
    begin = np.concatenate(loops)
    end = np.concatenate([np.roll(loop, -1, axis=0) for loop in loops])
    slope = (end[:, 0] - begin[:, 0]) / np.where(begin[:, 1] == end[:, 1], 1.0, end[:, 1] - begin[:, 1])
    # In the order of y the points beside a side of the loops are next to each other.
    order = np.argsort(points[:, 1])
    x, y = points[order].T
    first = np.searchsorted(y, np.minimum(begin[:, 1], end[:, 1]))
    count = np.searchsorted(y, np.maximum(begin[:, 1], end[:, 1])) - first
    crossings = np.zeros(len(points), np.int64)
    for part in np.array_split(np.arange(len(begin)), 1 + int(count.sum()) // _MOST_PAIRS):
        side = np.repeat(part, count[part])
        point = positions_in_rows(count[part]) + first[side]
        left = x[point] < begin[side, 0] + (y[point] - begin[side, 1]) * slope[side]
        crossings += np.bincount(point[left], minlength=len(points))
    found = np.zeros(len(points), bool)
    found[order] = crossings % 2 == 1
    return found


def _rim_distance(points: Array, loops: Sequence[Array]) -> Array:
    """Distance to the loops, each side sampled ten times."""
    from scipy.spatial import KDTree

    share = np.arange(10)[:, None] / 10
    samples = [(loop[:, None] + share * (np.roll(loop, -1, axis=0) - loop)[:, None]).reshape(-1, 2) for loop in loops]
    return KDTree(np.concatenate(samples)).query(points)[0]


def _inner_triangles(points: Array, loops: Sequence[Array]) -> NDArray[np.int64]:
    """The Delaunay triangles inside the loops."""
    from scipy.spatial import Delaunay

    triangles = Delaunay(points).simplices.astype(np.int64)
    corners = points[triangles]
    one, other = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    doubled = np.abs(one[:, 0] * other[:, 1] - one[:, 1] * other[:, 0])
    longest = np.maximum(np.sum(one**2, axis=1), np.sum(other**2, axis=1))
    # Along a straight side of the rim rounding makes triangles of three of its points.
    return triangles[(doubled > _FLAT * longest) & inside(corners.mean(1), loops)]


def _neighbours_mean(points: Array, triangles: NDArray[np.int64]) -> Array:
    total, count = np.zeros_like(points), np.zeros(len(points))
    for k in range(3):
        here = triangles[:, k]
        np.add.at(total, here, points[triangles[:, (k + 1) % 3]] + points[triangles[:, (k + 2) % 3]])
        np.add.at(count, here, 2.0)
    return total / np.maximum(count, 1.0)[:, None]


def _missing_edges(triangles: NDArray[np.int64], loops: Sequence[Array]) -> NDArray[np.int64]:
    """The edges of the loops that are not edges of triangles, by the number of their first point."""
    sides = np.sort(triangles[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    start = np.cumsum([0, *map(len, loops)])
    following = [np.roll(np.arange(len(loop)) + at, -1) for at, loop in zip(start, loops, strict=False)]
    wanted = np.sort(np.stack([np.arange(start[-1]), np.concatenate(following)], axis=1), axis=1)
    base = int(max(sides.max(initial=0), start[-1])) + 1
    return np.flatnonzero(~np.isin(wanted @ [base, 1], sides @ [base, 1]))


def interpolator(points: Array, values: Array) -> Callable[[Array], Array]:
    """Linear interpolation of (n, k) values at scattered points (n, 2); outside of them the nearest one's value."""
    from scipy.interpolate import LinearNDInterpolator  # takes a third of a second to import
    from scipy.spatial import KDTree

    inside, tree = LinearNDInterpolator(points, values), KDTree(points)

    def at(places: Array) -> Array:
        found = inside(places)
        return np.where(np.isnan(found), values[tree.query(places)[1]], found)

    return at

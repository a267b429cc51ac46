"""Geometry of points, segments and the mold's triangles, many pairs at once. On the host."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from jaxform.mold import Mold
from jaxform.search import SearchGrid

Array = NDArray[np.float64]
Integers = NDArray[np.int64]

_CHUNK = 2_000_000  # pairs looked at together


def nearest_places(points: Array, corners: Array) -> Array:
    """The places (n, 3) [m] of triangles (n, 3, 3) that are nearest to points (n, 3), pair by pair."""
    edge1, edge2 = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    normal, away = np.cross(edge1, edge2), points - corners[:, 0]
    square = np.einsum("ij,ij->i", normal, normal)
    gamma = np.einsum("ij,ij->i", np.cross(away, edge2), normal) / square
    delta = np.einsum("ij,ij->i", np.cross(edge1, away), normal) / square
    inside = (gamma >= 0) & (delta >= 0) & (gamma + delta <= 1)
    flat = corners[:, 0] + gamma[:, None] * edge1 + delta[:, None] * edge2
    sides = np.stack([_on_segment(points, corners[:, k], corners[:, (k + 1) % 3]) for k in range(3)])
    best = np.argmin(np.linalg.norm(points - sides, axis=2), axis=0)
    return np.where(inside[:, None], flat, sides[best, np.arange(len(points))])


def gaps(points: Array, corners: Array) -> Array:
    """Distances (n,) [m] of points (n, 3) from triangles (n, 3, 3), pair by pair."""
    return np.linalg.norm(points - nearest_places(points, corners), axis=1)


def _on_segment(points: Array, begin: Array, end: Array) -> Array:
    along = end - begin
    share = np.einsum("ij,ij->i", points - begin, along) / np.einsum("ij,ij->i", along, along)
    return begin + np.clip(share, 0.0, 1.0)[:, None] * along


def crossings(
    begin: Array, end: Array, mold: Mold, grid: SearchGrid, margin: float = 1e-6
) -> tuple[Integers, Integers]:
    """The segments (from `begin` to `end`, each (n, 3) [m]) that properly cross the mold, each with a triangle.

    Touching does not count: the crossing must lie inside segment and triangle by the relative margin.
    """
    corners = np.asarray(mold.vertices, float)[np.asarray(mold.triangles)]
    found = [np.zeros((2, 0), np.int64)]
    for segment, triangle in _segment_pairs(begin, end, grid):
        hit = _cross(begin[segment], end[segment], corners[triangle], float(grid.size), margin)
        found.append(np.stack([segment[hit], triangle[hit]]))
    segment, triangle = np.concatenate(found, axis=1)
    segment, first = np.unique(segment, return_index=True)
    return segment, triangle[first]


def _cross(begin: Array, end: Array, corners: Array, size: float, margin: float) -> NDArray[np.bool_]:
    d, edge1, edge2 = corners[:, 0], corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    path, normal = end - begin, np.cross(edge1, edge2)
    square = np.einsum("ij,ij->i", normal, normal)
    height = np.einsum("ij,ij->i", begin - d, normal)
    slope = np.einsum("ij,ij->i", path, normal)
    # A path that hardly leaves the triangle's plane is a touch.
    steep = np.abs(slope) > 1e-9 * np.sqrt(square) * size
    beta = -height / np.where(steep, slope, 1.0)
    meet = begin + beta[:, None] * path - d
    gamma = np.einsum("ij,ij->i", np.cross(meet, edge2), normal) / square
    delta = np.einsum("ij,ij->i", np.cross(edge1, meet), normal) / square
    # Strictly inside, for a sheet may rest on the rim of an open mold.
    inside = (gamma > margin) & (delta > margin) & (gamma + delta < 1 - margin)
    return steep & inside & (beta > margin) & (beta < 1 - margin)


def _segment_pairs(begin: Array, end: Array, grid: SearchGrid) -> Iterator[tuple[Integers, Integers]]:
    """Pairs of segments and triangles that can meet, some at a time: segments are sampled once per cell width."""
    width, shape = float(grid.width), np.array(grid.shape)
    samples = np.ceil(np.linalg.norm(end - begin, axis=1) / width).astype(int) + 1
    segment = np.repeat(np.arange(len(begin)), samples)
    k = np.arange(len(segment)) - np.repeat(np.cumsum(samples) - samples, samples)
    t = (k + 0.5) / samples[segment]
    point = begin[segment] + t[:, None] * (end - begin)[segment]
    index = np.floor((point - np.asarray(grid.corner, float)) / width).astype(int)
    kept = np.all((index >= 0) & (index < shape), axis=1)
    cell, segment = np.ravel_multi_index(tuple(index[kept].T), grid.shape), segment[kept]
    # Half a sample's length is the farthest that a segment's places are from a sample.
    near = np.asarray(grid.bound)[cell] <= width
    cell, segment = cell[near], segment[near]
    start, listed = np.asarray(grid.start), np.asarray(grid.number)[np.asarray(grid.listed)]
    count = start[cell + 1] - start[cell]
    for part in np.split(np.arange(len(cell)), np.flatnonzero(np.diff(np.cumsum(count) // _CHUNK)) + 1):
        own = count[part]
        flat = np.repeat(start[cell[part]] - np.cumsum(own) + own, own) + np.arange(own.sum())
        yield np.repeat(segment[part], own), listed[flat]

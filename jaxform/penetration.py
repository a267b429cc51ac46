"""Whether and how far a sheet is through the mold. On the host."""

from __future__ import annotations

import numpy as np

from jaxform.mold import Mold
from jaxform.search import SearchGrid


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
    pairs = np.unique(np.stack([np.repeat(segment[kept], count), np.asarray(grid.number)[np.asarray(grid.listed)[flat]]], 1), axis=0)
    return pairs[:, 0], pairs[:, 1]

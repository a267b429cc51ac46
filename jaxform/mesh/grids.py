"""Nodes and triangles of the built-in sheets: rings, rows of cells, faces of an octahedron. On the host."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray


def ring(radius: float, segments: int, symmetry: str) -> NDArray[np.float64]:
    """Nodes of a ring or arc, counter-clockwise, exactly on the cut planes: (k, 3)."""
    if radius == 0:
        return np.zeros((1, 3))
    first, span = {"none": (0.0, 2.0), "half": (-0.5, 1.0), "quarter": (0.0, 0.5)}[symmetry]
    nodes = np.arange(segments + (symmetry != "none"))
    angle = np.pi * (first + span * nodes / segments)
    unit = np.stack([np.cos(angle), np.sin(angle), np.zeros(len(angle))], axis=1)
    unit[np.abs(unit) < 1e-14] = 0.0
    return radius * unit


def zip_rings(inner: int, inner_count: int, outer: int, outer_count: int, closed: bool) -> NDArray[np.int64]:
    """Triangles between two rings of nodes that start at `inner` and `outer`: (inner_count + outer_count, 3).

    One triangle for each segment of either ring, in the order of the angles where the segments end; at equal
    angles the inner one goes first, which makes every sector of a full disc symmetric about its middle.
    """
    inner_ends, outer_ends = np.arange(1, inner_count + 1), np.arange(1, outer_count + 1)
    ends = np.concatenate([inner_ends * outer_count, outer_ends * inner_count])
    is_outer = np.arange(len(ends)) >= inner_count
    is_outer = is_outer[np.lexsort((is_outer, ends))]
    inner_node = _numbers(inner, np.cumsum(~is_outer), inner_count, closed)
    outer_node = _numbers(outer, np.cumsum(is_outer), outer_count, closed)
    near = _numbers(inner, np.cumsum(~is_outer) - ~is_outer, inner_count, closed)
    far = _numbers(outer, np.cumsum(is_outer) - is_outer, outer_count, closed)
    return np.stack([near, far, np.where(is_outer, outer_node, inner_node)], axis=1)


def _numbers(start: int, place: NDArray[np.int64], segment_count: int, closed: bool) -> NDArray[np.int64]:
    return start + (place % max(1, segment_count) if closed else place)


def round_count(ratio: float) -> int:
    """The nearest count to a ratio, at least 1, and never too large to multiply."""
    return max(1, round(min(ratio, 1e7)))


def cell_counts(extent: Sequence[float], element_size: float | None, elements: int | None) -> list[int]:
    """Rows of near-square cells of two triangles along the sides x, y [m] of a rectangle."""
    if element_size is not None:
        return [round_count(length / element_size) for length in extent]
    cell_count = (elements or 0) / 2
    across = round_count(math.sqrt(cell_count * min(extent) / max(extent)))
    along = round_count(cell_count / across)
    return [across, along] if extent[0] <= extent[1] else [along, across]


def union_jack(nx: int, ny: int) -> NDArray[np.int64]:
    """Triangles of nx by ny cells with alternating diagonals, nodes numbered along y first: (2 nx ny, 3)."""
    i, j = (grid.ravel() for grid in np.meshgrid(np.arange(nx), np.arange(ny), indexing="ij"))
    a = i * (ny + 1) + j
    b, c, d = a + ny + 1, a + ny + 2, a + 1
    rising = ((i + j) % 2 == 0)[:, None, None]
    split = np.where(
        rising,
        np.stack([np.stack([a, b, c], 1), np.stack([a, c, d], 1)], 1),
        np.stack([np.stack([a, b, d], 1), np.stack([b, c, d], 1)], 1),
    )
    return split.reshape(-1, 3)


def octant(division: int, signs: tuple[int, int, int]) -> NDArray[np.int64]:
    """Corners of the triangles on one face of |x| + |y| + |z| = division: (division^2, 3, 3)."""
    i, j = (grid.ravel() for grid in np.meshgrid(np.arange(division), np.arange(division), indexing="ij"))
    base = np.stack([i, j, division - 1 - i - j], axis=1)
    unit = np.eye(3, dtype=np.int64)
    upward = base[base[:, 2] >= 0][:, None, :] + unit
    downward = (base - [0, 0, 1])[base[:, 2] >= 1][:, None, :] + (1 - unit)
    corners = np.concatenate([upward, downward])
    return corners[:, :: int(np.prod(signs))] * np.array(signs)

"""Triangles to the pixels of a picture: what is seen, and what covers what. NumPy alone, all triangles at once."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Index = NDArray[np.int64]

_AT_ONCE = 1_000_000  # pairs of triangle and pixel that are looked at together
_EDGE = 1e-9  # by which a point may be outside of a triangle, so that none falls between two


class Hits(NamedTuple):
    """Pairs of triangle and pixel: numbers (n,) each, and the weights (n, 3) of the corners at the pixel's middle."""

    triangle: Index
    pixel: Index
    weight: Array


def hits(corners: Array, width: int, height: int) -> Iterator[Hits]:
    """The pixels whose middles triangles cover; pixel (i, j) has its middle at (i + 1/2, j + 1/2), number i + j width.

    Args:
        corners: Of the triangles (n, 3, 2), in pixels; what is outside is left out.
        width: Of the picture, in pixels.
        height: Of the picture, in pixels.
    """
    size = np.array([width, height])
    with np.errstate(invalid="ignore"):
        low = np.clip(np.ceil(corners.min(1) - 0.5), 0, size)
        high = np.clip(np.floor(corners.max(1) - 0.5), -1, size - 1)
        turned = _turned(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        extent = np.where(np.isfinite(corners).all((1, 2))[:, None], high - low + 1, 0.0)
    count = np.where(turned != 0, np.prod(np.maximum(extent, 0), axis=1), 0).astype(np.int64)
    some = np.flatnonzero(count)
    total = np.cumsum(count[some])
    for part in np.split(some, np.searchsorted(total, np.arange(_AT_ONCE, total[-1] if len(total) else 0, _AT_ONCE))):
        if len(part):
            yield _hits_of(part, corners[part], turned[part], low[part], extent[part, 0], count[part], width)


def _hits_of(part: Index, corners: Array, turned: Array, low: Array, columns: Array, count: Index, width: int) -> Hits:
    row = np.repeat(np.arange(len(part)), count)
    k = np.arange(len(row)) - np.repeat(np.cumsum(count) - count, count)
    wide = columns.astype(np.int64)[row]
    down = k // wide
    x, y = low[:, 0][row] + (k - down * wide), low[:, 1][row] + down
    weights = []
    for corner in (1, 2):
        # The cross product with the opposite side, linear in the place.
        begin, side = corners[:, (corner + 1) % 3], corners[:, (corner + 2) % 3] - corners[:, (corner + 1) % 3]
        a, b = -side[:, 1] / turned, side[:, 0] / turned
        c = -(a * begin[:, 0] + b * begin[:, 1])
        weights.append(a[row] * (x + 0.5) + b[row] * (y + 0.5) + c[row])
    weights.insert(0, 1.0 - weights[0] - weights[1])
    inside = np.flatnonzero((weights[0] >= -_EDGE) & (weights[1] >= -_EDGE) & (weights[2] >= -_EDGE))
    pixel = (x[inside] + y[inside] * width).astype(np.int64)
    return Hits(part[row[inside]], pixel, np.stack([weight[inside] for weight in weights], axis=1))


def _turned(one: Array, other: Array) -> Array:
    return one[:, 0] * other[:, 1] - one[:, 1] * other[:, 0]


class View(NamedTuple):
    """What is nearest in each pixel: the triangle (height * width,), -1 where none, and its corners' weights."""

    triangle: Index
    weight: Array


def nearest(
    corners: Array, depth: Array, width: int, height: int, kept: Callable[[Hits], NDArray[np.bool_]] | None = None
) -> View:
    """What is seen of triangles.

    Args:
        corners: (n, 3, 2), in pixels.
        depth: Of the corners (n, 3); the smallest is the nearest.
        width: Of the picture, in pixels.
        height: Of the picture, in pixels.
        kept: Which of the pairs count (n,), where the triangles are cut open; all by default.
    """
    best = np.full(width * height, np.inf)
    view = View(np.full(width * height, -1), np.zeros((width * height, 3)))
    for found in hits(corners, width, height):
        if kept is not None:
            some = kept(found)
            found = Hits(found.triangle[some], found.pixel[some], found.weight[some])
        away = np.einsum("nc,nc->n", found.weight, depth[found.triangle])
        np.minimum.at(best, found.pixel, away)
        front = away <= best[found.pixel]
        view.triangle[found.pixel[front]] = found.triangle[front]
        view.weight[found.pixel[front]] = found.weight[front]
    return view

"""Rasterization of triangles: covered pixels, and the visible triangle of each. NumPy alone, vectorized."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from jaxform.mesh.topology import positions_in_rows

Array = NDArray[np.float64]
Index = NDArray[np.int64]

_AT_ONCE = 1_000_000  # pairs of triangle and pixel that are processed together
_EDGE = 1e-9  # by which a point may be outside of a triangle, so that none falls between two


Interpolation = Callable[[Array], Array]
"""A function of values at the corners of all triangles (n_triangle, 3) that returns those at pixels' middles (n,)."""


def rasterize(corners: Array, width: int, height: int) -> Iterator[tuple[Index, Index, Interpolation]]:
    """The pixels whose middles triangles cover; pixel (i, j) has its middle at (i + 1/2, j + 1/2), number i + j width.

    Args:
        corners: Corners of the triangles (n, 3, 2), in pixels; what is outside is left out.
        width: Width of the picture, in pixels.
        height: Height of the picture, in pixels.

    Yields:
        Pairs of triangle and pixel: the triangles' numbers (n,), the pixels' numbers (n,), and the function that
        interpolates linearly between values at corners.
    """
    size = np.array([width, height])
    # Corner by corner: NumPy takes ten times as long along an axis of three.
    one, two, three = corners[:, 0], corners[:, 1], corners[:, 2]
    with np.errstate(invalid="ignore", over="ignore"):
        low = np.clip(np.ceil(np.minimum(np.minimum(one, two), three) - 0.5), 0, size)
        high = np.clip(np.floor(np.maximum(np.maximum(one, two), three) - 0.5), -1, size - 1)
        turned = _cross(two - one, three - one)
        extent = np.maximum(np.where(np.isfinite(one + two + three), high - low + 1, 0.0), 0.0)
    count = np.where(turned != 0, extent[:, 0] * extent[:, 1], 0).astype(np.int64)
    some = np.flatnonzero(count)
    total = np.cumsum(count[some])
    for part in np.split(some, np.searchsorted(total, np.arange(_AT_ONCE, total[-1] if len(total) else 0, _AT_ONCE))):
        if len(part):
            yield _rasterize_rows(part, corners[part], turned[part], low[part], high[part], width)


def _rasterize_rows(
    part: Index, corners: Array, turned: Array, low: Array, high: Array, width: int
) -> tuple[Index, Index, Interpolation]:
    """Row by row of pixels: a row's are covered from one side of the triangle to another."""
    rows = (high - low + 1)[:, 1].astype(np.int64)
    y = _repeat(low[:, 1], rows) + positions_in_rows(rows)
    first, last = _repeat(low[:, 0], rows), _repeat(high[:, 0], rows)
    slopes, begins = [], []
    # The weights, cross products with the opposite sides, are linear in the place.
    for corner in range(3):
        begin, side = corners[:, (corner + 1) % 3], corners[:, (corner + 2) % 3] - corners[:, (corner + 1) % 3]
        across, up = -side[:, 1] / turned, side[:, 0] / turned
        begins.append(_repeat(up, rows) * (y + 0.5) - _repeat(across * begin[:, 0] + up * begin[:, 1], rows))
        slopes.append(_repeat(across, rows))
    for slope, begin in zip(slopes, begins, strict=True):
        with np.errstate(divide="ignore", invalid="ignore"):
            place = -(begin + _EDGE) / slope - 0.5
        first = np.where(slope > 0, np.maximum(first, np.ceil(place)), first)
        last = np.where(slope < 0, np.minimum(last, np.floor(place)), last)
        last = np.where((slope == 0) & (begin < -_EDGE), -1.0, last)
    columns = np.maximum(last - first + 1, 0).astype(np.int64)
    along, triangle = positions_in_rows(columns), _repeat(part, rows)
    pixel = _repeat((first + y * width).astype(np.int64), columns) + along
    two, three = (begin + slope * (first + 0.5) for begin, slope in zip(begins[1:], slopes[1:], strict=True))
    weights, rises = [1.0 - two - three, two, three], [-slopes[1] - slopes[2], *slopes[1:]]

    def interpolate(values: Array) -> Array:
        one, two, three = values[triangle].T
        start, rise = (a * one + b * two + c * three for a, b, c in (weights, rises))
        return _repeat(start, columns) + _repeat(rise, columns) * along.astype(float)

    return _repeat(triangle, columns), pixel, interpolate


def _repeat(values: NDArray[Any], counts: Index) -> Any:
    """Each value (n,) as often as its count says."""
    return np.repeat(values, counts)


def _cross(one: Array, other: Array) -> Array:
    return one[:, 0] * other[:, 1] - one[:, 1] * other[:, 0]


def nearest_in_pixels(
    corners: Array,
    depth: Array,
    width: int,
    height: int,
    kept: Callable[[Interpolation], NDArray[np.bool_]] | None = None,
) -> NDArray[np.int32]:
    """The visible triangle of each pixel (height * width,), -1 where there is none.

    Args:
        corners: Corners of the triangles (n, 3, 2), in pixels.
        depth: Depths of the corners (n, 3); the smallest is the nearest.
        width: Width of the picture, in pixels.
        height: Height of the picture, in pixels.
        kept: Selects the pairs that count (n,) by their interpolation, where triangles are cut open; all by default.
    """
    best, seen = np.full(width * height, np.inf), np.full(width * height, -1, np.int32)
    for triangle, pixel, interpolate in rasterize(corners, width, height):
        away = interpolate(depth)
        if kept is not None:
            some = kept(interpolate)
            triangle, pixel, away = triangle[some], pixel[some], away[some]
        np.minimum.at(best, pixel, away)
        front = away <= best[pixel]
        seen[pixel[front]] = triangle[front]
    return seen


def weights(corners: Array, triangle: NDArray[np.integer], pixel: NDArray[np.integer], width: int) -> Array:
    """Weights (3, n) of the corners of triangles (n,), which are in pixels (n_triangle, 3, 2), at pixels' middles."""
    row, column = np.divmod(pixel, width)
    one, two, three = corners[:, 0], corners[:, 1], corners[:, 2]
    turned = _cross(two - one, three - one)[triangle]
    x, y = column + 0.5, row + 0.5

    def opposite(begin: Array, end: Array) -> Array:
        across, up = (end - begin).T
        level = (across * begin[:, 1] - up * begin[:, 0])[triangle]
        return (across[triangle] * y - up[triangle] * x - level) / turned

    second, third = opposite(three, one), opposite(one, two)
    return np.stack([1.0 - second - third, second, third])

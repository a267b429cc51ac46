"""Ribs and pins of a mold that are thinner than the elements of the sheet, seen before a run. On the host.

Seen along the push, the mold is a map of heights. What stands up from it and is narrower than an element is what its
morphological closing fills: a filter that keeps what an element can lie on.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from jaxform.mesh import masks, raster

Array = NDArray[np.float64]

_FINE, _MOST = 8.0, 600.0  # pixels along an element at least, and along the sheet at most
_TALL = 1.5  # sides of an element, and of its own width: what is lower is followed by the nodes beside it
_CORNER = 0.5  # of an element's radius, how far a right-angled corner reaches out of a disc in it
_PARTS = 20  # places that stand up, of which each is looked at, the highest first
_POINTS = 2_000_000  # on the edges of the mold's triangles: a rib may be thinner than a pixel


class SlenderFeature(NamedTuple):
    """The highest rib or pin of a mold that is thinner than an element.

    Attributes:
        width: Its width half way up, at most [m].
        height: How far it stands up from what is around it [m].
        place: Where its top is (3,) [m].
    """

    width: float
    height: float
    place: Array


def slender_feature(sheet: Array, mold: Array, push: Array, side: float, held: Array) -> SlenderFeature | None:
    """The highest rib or pin that an element of the sheet may pass over or through; None where there is none.

    Args:
        sheet: Corners of the elements (n_element, 3, 3) [m].
        mold: Corners of the mold's triangles (n_triangle, 3, 3) [m].
        push: Unit vector (3,) along which the sheet is pushed.
        side: Of an element [m].
        held: Positions of clamped nodes (n, 3) [m]: what is beside them is the rim of the mold.
    """
    across = np.linalg.svd(push[None])[2][1:]
    flat, wall = sheet @ across.T, mold @ across.T
    low, high = flat.min((0, 1)), flat.max((0, 1))
    pixel = max(side / _FINE, float((high - low).max()) / _MOST)
    shape = tuple(max(1, round(float(extent) / pixel)) for extent in high - low)
    level = _nearest((flat - low) / pixel, sheet @ push, shape)
    way = _nearest((wall - low) / pixel, mold @ push, shape, edges=True)
    inside, met = np.isfinite(level), np.isfinite(way)
    if not (inside & met).any() or side < 2 * pixel:
        return None
    way = np.where(met, way, way[met].max())
    radius = side / (2 * pixel)
    filled = masks.fill_narrow_minima(way, radius)
    near_rim = _is_near((held @ across.T - low) / pixel, inside, 3 * radius)
    above = np.where(inside & met & ~near_rim & (way > level), filled - way, 0.0)
    found = _highest(above, way, filled, radius, _TALL * side)
    if found is None:
        return None
    top, half_width = found
    height, width = float(above[top]), 2 * pixel * half_width
    row, column = top
    middle = (low + (np.array([column, row]) + 0.5) * pixel) @ across
    return SlenderFeature(width, height, middle + float(way[top]) * push) if height > _TALL * width else None


def _highest(
    above: Array, way: Array, filled: Array, radius: float, least: float
) -> tuple[tuple[int, int], float] | None:
    """The pixel of the highest rib that is higher than `least`, and half its width [pixels]; None where there is none.

    A disc does not fill the corners of what is wide enough: what is that near to it is no rib.

    Args:
        above: How far a pixel stands up from what an element can lie on (height, width) [m].
        way: How far the mold is along the push there [m].
        filled: The same of what an element can lie on [m].
        radius: Of an element [pixels].
        least: Height [m].
    """
    part, count = masks.label_parts(above > least)
    for number in sorted(range(1, count + 1), key=lambda k: -above[part == k].max())[:_PARTS]:
        own = part == number
        row, column = np.unravel_index(int(np.argmax(np.where(own, above, 0.0))), above.shape)
        wide = filled <= way[row, column] + 0.5 * above[row, column]
        away = masks.distance(~wide)[own].max() if wide.any() else np.inf
        if away > _CORNER * radius + 2.0:
            return (int(row), int(column)), float(masks.distance(own).max())
    return None


def _nearest(corners: Array, along: Array, shape: tuple[int, ...], *, edges: bool = False) -> Array:
    """The least distance along the push of triangles in each pixel (height, width) [m]; infinite where there is none.

    Args:
        corners: Of the triangles (n, 3, 2), in pixels.
        along: Of their corners (n, 3) [m].
        shape: Width and height of the map, in pixels.
        edges: Whether points on the triangles' edges count too, which pixels' middles may miss.
    """
    width, height = shape
    found = np.full(width * height, np.inf)
    for hit in raster.rasterize(corners, width, height):
        np.minimum.at(found, hit.pixel, hit.interpolate(along))
    if edges:
        places, depth = _edge_points(corners, along)
        cell = np.floor(places).astype(np.int64)
        good = ((cell >= 0) & (cell < [width, height])).all(1)
        np.minimum.at(found, cell[good, 0] + width * cell[good, 1], depth[good])
    return found.reshape(height, width)


def _edge_points(corners: Array, along: Array) -> tuple[Array, Array]:
    """Points on the edges of triangles, about a pixel apart (n, 2), and their distance along the push (n,) [m]."""
    begin, end = corners.reshape(-1, 2), np.roll(corners, -1, axis=1).reshape(-1, 2)
    first, last = along.ravel(), np.roll(along, -1, axis=1).ravel()
    count = np.ceil(np.linalg.norm(end - begin, axis=1)).astype(np.int64) + 1
    count = np.maximum(1, (count * min(1.0, _POINTS / count.sum())).astype(np.int64))
    edge = np.repeat(np.arange(len(count)), count)
    share = (np.arange(len(edge)) - np.repeat(np.cumsum(count) - count, count)) / count[edge]
    return begin[edge] + share[:, None] * (end - begin)[edge], first[edge] + share * (last - first)[edge]


def _is_near(points: Array, inside: NDArray[np.bool_], reach: float) -> NDArray[np.bool_]:
    """Mask of a map's pixels that are within so many pixels of points (n, 2)."""
    marked = np.zeros_like(inside)
    if not len(points):
        return marked
    column, row = np.clip(np.floor(points).astype(np.int64), 0, np.array(inside.shape)[::-1] - 1).T
    marked[row, column] = True
    return masks.distance(~marked) <= reach

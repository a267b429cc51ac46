"""Heights of a surface as seen from a side: the nearest in each pixel, holes and rims included. On the host."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from jaxform.mesh import masks, planform, raster, topology

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

_RIM = 2  # pixels beside the surface in which its rim is searched for
_ABRUPT = 20.0  # degrees, from which a bend of the surface is an edge that may be thinner than a pixel


@dataclass(frozen=True)
class Heights:
    """A surface viewed along +z, from below, in square pixels.

    Attributes:
        turn: Rotation of the surface (3, 3) for a view along +z.
        low: Place of the first pixel's outer corner (2,) [m], after turning.
        pixel: Side of a pixel [m].
        height: The smallest z (ny, nx) [m] in each, after turning; infinite where there is nothing.
        inside: Pixels (ny, nx) that the surface covers or surrounds.
    """

    turn: Array
    low: Array
    pixel: float
    height: Array
    inside: Mask

    @property
    def edge(self) -> Mask:
        """Pixels of what is inside that are next to the outside."""
        return self.inside & ~masks.dilate(self.inside, -1)

    def places(self, pixels: Mask) -> Array:
        """Middles (n, 2) [m] of pixels."""
        row, column = np.nonzero(pixels)
        return self.low + self.pixel * (np.stack([column, row], axis=1) + 0.5)

    def sample(self, values: NDArray[Any], places: Array) -> NDArray[Any]:
        """The values (ny, nx) of the pixels that places (n, 2) [m] are in, or are nearest to."""
        column, row = np.floor((places - self.low) / self.pixel).astype(int).T
        return values[np.clip(row, 0, values.shape[0] - 1), np.clip(column, 0, values.shape[1] - 1)]

    def inside_polygon(self, polygon: Array) -> Mask:
        """The pixels (ny, nx) whose middles are in a polygon (k, 2) [m]."""
        places = self.places(np.ones_like(self.inside))
        return planform.inside(places, [polygon]).reshape(self.inside.shape)

    def edge_level(self, tolerance: float) -> tuple[float, float]:
        """The height [m] that most of the edge has, within a tolerance [m], and the share of the edge that has it."""
        at_edge = np.sort(self.local_minimum()[self.edge])
        many = np.searchsorted(at_edge, at_edge + 2 * tolerance, side="right") - np.arange(len(at_edge))
        first = int(np.argmax(many))
        return float(np.median(at_edge[first : first + many[first]])), float(many[first] / len(at_edge))

    def local_minimum(self) -> Array:
        """The smallest height (ny, nx) [m] in a few pixels around each."""
        return masks.local_minimum(self.height, _RIM)


ViewedSurface = tuple[Array, NDArray[np.integer], Array]
"""A surface to be viewed: vertices (n, 3) [m], triangles (m, 3), and its rims and sharp edges (k, 2, 3) [m]."""


def make_viewed_surface(vertices: Array, triangles: NDArray[np.integer]) -> ViewedSurface:
    """A surface (n, 3) [m], (m, 3), with its edges."""
    return vertices, triangles, np.asarray(topology.feature_edges(vertices, triangles, _ABRUPT), np.float64)


def view_heights(looked_at: ViewedSurface, turn: Array, pixels: int) -> Heights:
    """The heights of a surface that is turned first.

    Args:
        looked_at: The surface.
        turn: Matrix (3, 3).
        pixels: Along the longer side.
    """
    vertices, triangles, edges = looked_at
    turned = vertices @ turn.T
    low, high = turned.min(0), turned.max(0)
    pixel = float((high - low)[:2].max()) / pixels
    first = low[:2] - 2.5 * pixel
    width, height = (int(np.ceil(extent / pixel)) + 5 for extent in (high - low)[:2])
    nearest = np.full(width * height, np.inf)
    corners = turned[triangles]
    for _, covered, interpolate in raster.rasterize((corners[..., :2] - first) / pixel, width, height):
        np.minimum.at(nearest, covered, interpolate(corners[..., 2]))
    # Walls that stand upright, and rims, are in no pixel's middle.
    points = topology.edge_points(edges @ turn.T, pixel)
    column, row = np.floor((points[:, :2] - first) / pixel).astype(int).T
    np.minimum.at(nearest, row * width + column, points[:, 2])
    seen_there = nearest.reshape(height, width)
    return Heights(turn, first, pixel, seen_there, masks.fill_holes(np.isfinite(seen_there)))

"""What is seen of a surface from a side: the nearest height in each pixel, holes and rims included. On the host."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from jaxform.mesh import raster, topology

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

_RIM = 2  # pixels beside the surface in which its rim is looked for
_ABRUPT = 20.0  # degrees, from which a bend of the surface is an edge that may be thinner than a pixel


@dataclass(frozen=True)
class Heights:
    """A surface seen along +z, from below, in square pixels.

    Attributes:
        turn: Turns the surface (3, 3), so that what looks along +z sees it.
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
        from scipy import ndimage

        return self.inside & ~ndimage.binary_erosion(self.inside)

    def places(self, pixels: Mask) -> Array:
        """Middles (n, 2) [m] of pixels."""
        row, column = np.nonzero(pixels)
        return self.low + self.pixel * (np.stack([column, row], axis=1) + 0.5)

    def around(self) -> Array:
        """The smallest height (ny, nx) [m] in a few pixels around each."""
        from scipy import ndimage

        return ndimage.minimum_filter(self.height, size=2 * _RIM + 1, mode="constant", cval=np.inf)


def seen(vertices: Array, triangles: NDArray[np.integer], turn: Array, pixels: int) -> Heights:
    """The heights of a surface that is turned first.

    Args:
        vertices: Positions (n, 3) [m].
        triangles: Vertex numbers (m, 3).
        turn: Matrix (3, 3).
        pixels: Along the longer side.
    """
    from scipy import ndimage

    turned = vertices @ turn.T
    low, high = turned.min(0), turned.max(0)
    pixel = float((high - low)[:2].max()) / pixels
    first = low[:2] - 2.5 * pixel
    width, height = (int(np.ceil(extent / pixel)) + 5 for extent in (high - low)[:2])
    nearest = np.full(width * height, np.inf)
    corners = turned[triangles]
    for found in raster.hits((corners[..., :2] - first) / pixel, width, height):
        np.minimum.at(nearest, found.pixel, np.einsum("nc,nc->n", found.weight, corners[found.triangle, :, 2]))
    # Walls that stand upright, and rims, are in no pixel's middle.
    points = _along(topology.feature_edges(turned, np.asarray(triangles), _ABRUPT), pixel)
    column, row = np.floor((points[:, :2] - first) / pixel).astype(int).T
    np.minimum.at(nearest, row * width + column, points[:, 2])
    seen_there = nearest.reshape(height, width)
    inside = np.asarray(ndimage.binary_fill_holes(np.isfinite(seen_there)))
    return Heights(turn, first, pixel, seen_there, inside)


def _along(edges: Array, step: float) -> Array:
    """Points (k, 3) [m] along edges (n, 2, 3) [m], two in a step or more."""
    count = np.ceil(2 * np.linalg.norm(edges[:, 1] - edges[:, 0], axis=1) / step).astype(int) + 1
    owner = np.repeat(np.arange(len(edges)), count)
    share = ((np.arange(len(owner)) - (np.cumsum(count) - count)[owner]) / (count[owner] - 1))[:, None]
    return (1 - share) * edges[owner, 0] + share * edges[owner, 1]

"""Masks over pixels: parts, distances, gaps. SciPy's, with types; it takes a while to import, so when needed."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]


def label_parts(mask: Mask) -> tuple[NDArray[np.int64], int]:
    """The number of the connected part that each pixel is in, from 1, 0 outside; and how many there are."""
    from scipy import ndimage

    found: Any = ndimage.label(mask)
    return found[0].astype(np.int64), int(found[1])


def distance(mask: Mask) -> Array:
    """Distance [pixels] of each pixel of a mask to the nearest that is not in it; 0 of those."""
    from scipy import ndimage

    return np.asarray(ndimage.distance_transform_edt(mask))


def close_gaps(mask: Mask, reach: float) -> Mask:
    """A mask with all gaps filled that are up to twice so many pixels wide."""
    wide = int(reach) + 1
    near = distance(~np.pad(mask, wide)) <= reach
    return (distance(near) > reach)[wide:-wide, wide:-wide] | mask


def fill_holes(mask: Mask) -> Mask:
    """A mask with what it surrounds."""
    from scipy import ndimage

    return np.asarray(ndimage.binary_fill_holes(mask), bool)


def dilate(mask: Mask, pixels: int) -> Mask:
    """A mask dilated by a number of steps; below 0 it is eroded."""
    from scipy import ndimage

    change = ndimage.binary_dilation if pixels > 0 else ndimage.binary_erosion
    return np.asarray(change(mask, iterations=abs(pixels)), bool)


def local_minimum(values: Array, pixels: int) -> Array:
    """The least value up to so many pixels away, along rows and columns."""
    from scipy import ndimage

    return np.asarray(ndimage.minimum_filter(values, size=2 * pixels + 1, mode="constant", cval=np.inf))


def fill_narrow_minima(values: Array, reach: float) -> Array:
    """Values with minima filled that are narrower than a disc with so many pixels as its radius: a grey closing."""
    from scipy import ndimage

    size = int(np.ceil(reach))
    rows, columns = np.mgrid[-size : size + 1, -size : size + 1]
    disc = np.hypot(rows, columns) <= reach
    return np.asarray(ndimage.grey_closing(values, footprint=disc, mode="nearest"))

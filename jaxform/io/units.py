"""The unit of length of a mold's file, guessed from its size."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

METRES, INCHES = 1.2, 18.0
"""Largest sizes of a part, as numbers, that are taken for metres, and for inches or centimetres."""
_CENTIMETRES = 60.0  # the same, up to which a part of so many millimetres may be one of so many centimetres
_ROUND, _OFF = 0.5, 1e-4  # of sides in centimetres, that are multiples of a half


class Units(NamedTuple):
    """A unit of length.

    Attributes:
        scale: The unit in metres.
        name: Name of the unit.
        others: Other units that the file may have, as `--scale` says them.
    """

    scale: float
    name: str
    others: str = ""


_IN_MM = "--scale 0.001 where it is in millimetres"
_IN_CM = "--scale 0.01 where it is in centimetres"
_IN_INCHES = "--scale 0.0254 where it is in inches"


def guess_units(box: NDArray[np.float64], scale: float | None = None) -> Units:
    """The unit of a part whose box is so many units (3,) large; the given one [m], where one is given."""
    guessed = _guess(box)
    if scale is None:
        return guessed
    return Units(scale, guessed.name if scale == guessed.scale else f"units of {scale:g} m")


def _guess(box: NDArray[np.float64]) -> Units:
    size = float(box.max())
    if size <= METRES:
        return Units(1.0, "metres")
    if size <= INCHES:
        halves = box / _ROUND
        # A part of 12 x 8 x 5 is drawn in centimetres, one of 4.72 x 3.15 x 1.97 is drawn in inches or converted.
        if np.all(np.abs(halves - np.round(halves)) <= _OFF * np.maximum(halves, 1.0)):
            return Units(0.01, "centimetres", f"give {_IN_MM}, {_IN_INCHES}")
        return Units(0.0254, "inches", f"give {_IN_MM}, {_IN_CM}")
    return Units(0.001, "millimetres", f"give {_IN_CM}" if size <= _CENTIMETRES else "")

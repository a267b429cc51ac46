"""The resolution of a shape's mesh: limits of its element size and of its number of elements."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from jaxform.core.errors import InputError

FEWEST_ELEMENTS, MOST_ELEMENTS = 4, 2_000_000


def as_number(value: Any) -> float:
    """The value as a float, NaN when it is no number."""
    if isinstance(value, bool) or not isinstance(value, int | float | np.integer | np.floating):
        return math.nan
    return float(value) if abs(value) < 1e300 else math.inf


def as_length(key: str, value: Any) -> float:
    """A positive length [m] that was given for a key."""
    number = as_number(value)
    if not (math.isfinite(number) and number > 0):
        raise InputError("is not a positive length", "give metres above 0", key, value)
    return number


def check_resolution(element_size: float | None, elements: int | None, *, largest: float) -> None:
    """Raises InputError unless an element size [m] that the shape allows, or a number of elements, is given."""
    if (element_size is None) == (elements is None):
        problem = "nothing says how fine the mesh is" if elements is None else "is given together with elements"
        raise InputError(problem, "give element_size or elements, one of them", "parison.element_size", element_size)
    if element_size is not None and as_length("parison.element_size", element_size) > largest:
        raise InputError(
            f"is larger than the shape ({largest:.6g} m)",
            "make it smaller",
            "parison.element_size",
            element_size,
        )
    if elements is not None and not FEWEST_ELEMENTS <= as_number(elements) <= MOST_ELEMENTS:
        remedy = f"use {FEWEST_ELEMENTS} to {MOST_ELEMENTS}"
        raise InputError("is not a possible number of elements", remedy, "parison.elements", elements)


def triangle_side(area: float, elements: float) -> float:
    """The side [m] of so many equilateral triangles that have an area [m^2] together."""
    return math.sqrt(4 / math.sqrt(3) * area / elements)


def check_count(count: float, element_size: float | None) -> None:
    """Raises InputError where a mesh would have too few elements, or too many."""
    if element_size is not None and not FEWEST_ELEMENTS <= count <= MOST_ELEMENTS:
        problem = f"gives {count:.3g} elements, not {FEWEST_ELEMENTS} to {MOST_ELEMENTS}"
        remedy = "make it smaller" if count < FEWEST_ELEMENTS else "make it larger"
        raise InputError(problem, remedy, "parison.element_size", element_size)

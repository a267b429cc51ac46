"""Places in words."""

from __future__ import annotations

from collections.abc import Iterable


def format_coordinate(value: float, factor: float = 1.0, digits: int = 4) -> str:
    """A coordinate [m], times a factor, without what rounding makes of 0, or its sign."""
    return f"{factor * round(float(value), 10) + 0.0:.{digits}g}"


def format_place(point: Iterable[float]) -> str:
    """A place [m] in words."""
    return f"({', '.join(map(format_coordinate, point))}) m"


def format_extent(low: Iterable[float], high: Iterable[float]) -> str:
    """The least and the largest coordinates [m] in words."""
    sides = zip(map(format_coordinate, low), map(format_coordinate, high), strict=True)
    return " x ".join(f"{least} to {largest}" for least, largest in sides) + " m"

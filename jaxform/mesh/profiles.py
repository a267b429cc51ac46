"""Profiles: a quantity that varies along one coordinate, on the host."""

from __future__ import annotations

from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike, NDArray

from jaxform.core.errors import InputError, warn_of

_KNOTS = "give places in m on the sheet, or turn it"
_NO_WIDTH, _WIDE = 1e-6, 20.0  # of the sheet's size; knots over so many times its width


@dataclass(frozen=True)
class Profile:
    """A quantity over a place: piecewise linear between knots, constant outside.

    Attributes:
        along: The place: 'radius' (distance from the z axis), 'x', 'y' or 'z' [m]; 'angle' about the z axis from x
            towards y, from 0 to 360 [degrees]; 'arc' along the meridian of a preform, from its pole [m].
        at: Places of the knots, increasing.
        value: The quantity at the knots, in its own unit.
        key: Its key in the scene file, for messages.
    """

    along: str
    at: tuple[float, ...]
    value: tuple[float, ...]
    key: str = field(default="profile", compare=False)

    def __post_init__(self) -> None:
        """Raises InputError for an unknown place, knots that do not increase, lengths that differ, or NaN."""
        if self.along not in ("radius", "x", "y", "z", "angle", "arc"):
            raise InputError("is not a coordinate", "use radius, x, y, z or angle", f"{self.key}.along", self.along)
        for name in ("at", "value"):
            object.__setattr__(self, name, _finite_tuple(f"{self.key}.{name}", getattr(self, name)))
        if len(self.at) != len(self.value):
            problem = f"has {len(self.value)} values for {len(self.at)} knots"
            raise InputError(problem, "give one value per knot", f"{self.key}.value", self.value)
        if any(right <= left for left, right in pairwise(self.at)):
            raise InputError("does not increase", "sort the knots, and give each only once", f"{self.key}.at", self.at)

    def coordinate(self, positions: NDArray[np.float64]) -> NDArray[np.float64]:
        """The place of positions [m] of shape (..., 3), shape (...), in the unit of the knots.

        Raises:
            InputError: Along 'arc', which positions alone do not tell.
        """
        if self.along == "radius":
            return np.hypot(positions[..., 0], positions[..., 1])
        if self.along == "angle":
            return np.degrees(np.arctan2(positions[..., 1], positions[..., 0])) % 360.0
        if self.along == "arc":
            problem, remedy = "is known of the thickness and temperature of a preform alone", "use z or radius"
            raise InputError(problem, remedy, f"{self.key}.along", self.along)
        return positions[..., "xyz".index(self.along)]

    def __call__(self, positions: NDArray[np.float64]) -> NDArray[np.float64]:
        """The quantity at positions [m] of shape (..., 3), shape (...)."""
        return np.interp(self.coordinate(positions), self.at, self.value)

    def over(self, positions: NDArray[np.float64], arc: NDArray[np.float64] | None = None) -> NDArray[np.float64]:
        """The quantity at the nodes (n, 3) [m] of a sheet.

        Args:
            positions: The nodes.
            arc: Their places (n,) [m] along the meridian of a preform; None for other sheets.

        Warns:
            InputWarning: If the knots hardly overlap the sheet, so that the quantity is constant or nearly so.
        """
        place = arc if self.along == "arc" and arc is not None else self.coordinate(positions)
        at, unit = np.asarray(self.at), "degrees" if self.along == "angle" else "m"
        low, high = float(place.min()), float(place.max())
        sheet = f"the sheet is from {low:.4g} to {high:.4g} {unit}"
        if min(self.value) == max(self.value):
            pass
        elif at[-1] <= low or at[0] >= high or high - low <= _NO_WIDTH * np.ptp(positions):
            warn_of(f"varies nowhere on the sheet: {sheet}", _KNOTS, key=f"{self.key}.at", value=self.at)
        elif at[-1] - at[0] > _WIDE * (high - low):
            warn_of(f"hardly varies on the sheet: {sheet}", _KNOTS, key=f"{self.key}.at", value=self.at)
        return np.interp(place, self.at, self.value)

    def positive(self) -> Profile:
        """The profile itself if all values are positive; raises InputError otherwise."""
        if min(self.value) <= 0:
            raise InputError("is not positive everywhere", "give values above 0", f"{self.key}.value", self.value)
        return self


def _finite_tuple(key: str, values: ArrayLike) -> tuple[float, ...]:
    try:
        array = np.asarray(values, dtype=np.float64)
    except (TypeError, ValueError):
        array = np.array(np.nan)
    if array.ndim != 1 or not array.size or not np.isfinite(array).all():
        raise InputError("is not a list of finite numbers", "give at least one number", key, values)
    return tuple(array.tolist())

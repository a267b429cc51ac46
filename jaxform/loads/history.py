"""A pressure history through knots."""

from __future__ import annotations

from typing import ClassVar

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike

from jaxform.core.errors import InputError
from jaxform.core.parameters import ranged_parameter
from jaxform.core.pytree import as_real, static
from jaxform.core.ranges import RANGES, as_numbers, check
from jaxform.loads.loading import Loading, loading

_INTERPOLATIONS = ("linear", "cubic-ramp")
_FEW_KNOTS = 256


@loading
class Pressure(Loading):
    """Pressure difference over time, held before the first and after the last knot.

    Attributes:
        time: Knots (n_knot,) [s], increasing.
        value: Pressure at the knots (n_knot,) [Pa].
        interpolation: "linear", or "cubic-ramp": between two knots it rises as the cube of the elapsed fraction.
    """

    follows_volume: ClassVar[bool] = False

    time: jax.Array = ranged_parameter(RANGES["pressure.time"])
    value: jax.Array = ranged_parameter(RANGES["pressure.value"])
    interpolation: str = static(default="linear")

    def at(self, time: jax.Array, volume: jax.Array | None = None) -> jax.Array:
        """Pressure [Pa] at any times [s], of their shape, whatever the volume."""
        if self.time.size == 1:
            return jnp.broadcast_to(self.value[0], jnp.shape(time))
        # Few knots are compared one by one: a search takes longer to compile than all of this.
        way = "compare_all" if self.time.size <= _FEW_KNOTS else "scan"
        knot = jnp.searchsorted(self.time, time, side="right", method=way)
        knot = jnp.clip(knot - 1, 0, self.time.size - 2)
        begin, end = self.time[knot], self.time[knot + 1]
        fraction = jnp.clip((time - begin) / (end - begin), 0.0, 1.0)
        if self.interpolation == "cubic-ramp":
            fraction = fraction**3
        return self.value[knot] + fraction * (self.value[knot + 1] - self.value[knot])

    def pushes(self, end_time: float, volume: float) -> np.ndarray:
        """Pressures [Pa] at the knots."""
        return np.asarray(self.value, float)


def make_pressure(time: ArrayLike, value: ArrayLike, interpolation: str = "linear") -> Pressure:
    """A pressure history through knots (n_knot,): times [s], increasing, and values [Pa].

    Raises:
        InputError: If the knots do not increase, are not finite, or do not match.
    """
    times = np.atleast_1d(as_numbers("pressure.time", time))
    values = np.atleast_1d(as_numbers("pressure.value", value))
    if times.shape != values.shape or times.ndim != 1 or not times.size:
        raise InputError(
            f"{times.size} times and {values.size} values do not match",
            "give one value per time",
            "pressure.value",
        )
    check("pressure.time", times)
    check("pressure.value", values)
    if interpolation not in _INTERPOLATIONS:
        raise InputError(
            "unknown", f"choose one of {', '.join(_INTERPOLATIONS)}", "pressure.interpolation", interpolation
        )
    return Pressure(as_real(times), as_real(values), interpolation)

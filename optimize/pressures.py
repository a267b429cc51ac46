"""The pressure's history as a variable."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxform import InputError, Pressure, Scene
from optimize.variables import (
    Bounds,
    apply_bounds,
    apply_step_limit,
    check_bounds,
    full_reach,
    invert_bounds,
    invert_step_limit,
)

_STEEPEST = {"linear": 1.0, "cubic-ramp": 3.0}  # the largest slope between two knots over the mean one


class PressureKnots:
    """Pressure at the knots of the scene's history, and the duration of the history.

    Args:
        scene: The scene; its own pressure is the start.
        bounds: Least and largest pressure [Pa].
        increasing: True if the pressure may not decrease from knot to knot.
        rate: Largest change from knot to knot [Pa/s], or None.
        held: True if the first knot keeps its value: else the history may start with a jump.
        end_time: Smallest and largest time of the last knot [s], with which all others are scaled; None for fixed
            times.

    Raises:
        InputError: If the scene has another loading, the bounds do not increase, or the history would outlast the
            simulation.
    """

    def __init__(
        self,
        scene: Scene,
        *,
        bounds: Bounds,
        increasing: bool = False,
        rate: float | None = None,
        held: bool = False,
        end_time: Bounds | None = None,
    ) -> None:
        """See the class."""
        check_bounds(bounds, positive=False)
        if not isinstance(scene.pressure, Pressure):
            remedy = 'use kind = "scale" with of = "gas.mass_flow", "gas.time", "gas.supply_pressure", ...'
            raise InputError("is not possible: the scene has no pressure history", remedy, "variable.kind", "pressure")
        self.bounds, self.increasing, self.rate, self.end_time = bounds, increasing, rate, end_time
        self._time = np.asarray(scene.pressure.time, float)
        self._steepest = _STEEPEST[scene.pressure.interpolation]
        present = np.asarray(scene.pressure.value, float)
        self._first = float(present[0]) if held else None
        self._check_first(knots=len(present))
        if rate is not None:
            self._check_rate(rate)
        timing = np.zeros(0) if end_time is None else self._start_of_time(end_time, float(scene.solver.end_time))
        knots = self._time if end_time is None else self._time * self._stretch(jnp.asarray(timing))
        self.start = np.concatenate([self._free(present, np.asarray(knots)), timing])
        self.reach = full_reach(self.start.size)

    def _check_rate(self, rate: float) -> None:
        if not 0.0 < rate < np.inf or len(self._time) < 2:
            remedy = "give Pa/s > 0 and a history of two knots or more"
            raise InputError("has no effect", remedy, "variable.rate", rate)

    def _check_first(self, knots: int) -> None:
        if self._first is not None and knots < 2:
            raise InputError("leaves no knot to design", "give a history of two knots or more", "variable.held", True)
        if self._first is not None and not self.bounds[0] <= self._first <= self.bounds[1]:
            problem = f"do not contain the history's first value, {self._first:g} Pa, which stays"
            raise InputError(problem, "widen them", "variable.bounds", self.bounds)

    def _start_of_time(self, end_time: Bounds, simulated: float) -> np.ndarray:
        last = float(self._time[-1])
        if not 0.0 < end_time[0] < end_time[1] or self._time[0] != 0.0:
            remedy = "give 0 < lower < upper, and a history from time 0"
            raise InputError("leaves no range to search", remedy, "variable.end_time", end_time)
        if end_time[1] > simulated * (1 + 1e-12):
            problem = f"is longer than the simulation, {simulated:g} s"
            raise InputError(problem, "raise solver.end_time in the scene", "variable.end_time", end_time)
        return np.atleast_1d(invert_bounds(last, end_time))

    def _free(self, present: np.ndarray, time: np.ndarray) -> np.ndarray:
        if self.rate is None and not self.increasing:
            return invert_bounds(self._design_values(present), self.bounds)
        change = np.asarray(self._changes(jnp.asarray(time)))
        return invert_step_limit(self._design_values(present), self.bounds, change, self._first, self.increasing)

    def _changes(self, time: jax.Array) -> jax.Array:
        """Largest difference of neighbouring knots (n_knot - 1,) [Pa]."""
        if self.rate is None:
            return jnp.full(time.size - 1, self.bounds[1] - self.bounds[0])
        return self.rate / self._steepest * jnp.diff(time)

    def _design_values(self, values: np.ndarray) -> np.ndarray:
        return values if self._first is None else values[1:]

    def _stretch(self, free: jax.Array) -> jax.Array:
        """The history's new end over its old one, of the last of the search's numbers."""
        assert self.end_time is not None
        return apply_bounds(free[-1], self.end_time) / self._time[-1]

    def _values(self, free: jax.Array, time: jax.Array) -> jax.Array:
        if self.rate is None and not self.increasing:
            rest = apply_bounds(free, self.bounds)
        else:
            rest = apply_step_limit(free, self.bounds, self._changes(time), self._first, self.increasing)
        return rest if self._first is None else jnp.concatenate([jnp.asarray([self._first]), rest])

    def changes(self, free: jax.Array) -> dict[str, jax.Array]:
        """Pressure (n_knot,) [Pa], and the knots' times (n_knot,) [s] where they are designed."""
        time = jnp.asarray(self._time)
        if self.end_time is None:
            return {"pressure.value": self._values(free, time)}
        time = time * self._stretch(free)
        return {"pressure.time": time, "pressure.value": self._values(free[:-1], time)}

    def shares(self, free: jax.Array) -> jax.Array:
        """Pressures, and the history's end where it is designed, as fractions of the range between their bounds."""
        low, high = self.bounds
        if self.end_time is None:
            return (self._values(free, jnp.asarray(self._time)) - low) / (high - low)
        pressures = self._values(free[:-1], jnp.asarray(self._time) * self._stretch(free))
        return jnp.append((pressures - low) / (high - low), apply_bounds(free[-1], (0.0, 1.0)))

    def document(self, free: jax.Array) -> dict[str, Any]:
        """The changes as dotted keys of a scene file, with lists."""
        return {path: np.asarray(values, float).tolist() for path, values in self.changes(free).items()}

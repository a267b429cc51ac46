"""A gas that is blown into the sheet at a given mass flow: its pressure follows from the enclosed volume."""

from __future__ import annotations

from typing import ClassVar

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike

from jaxform.core.errors import InputError
from jaxform.core.parameters import ranged_parameter
from jaxform.core.pytree import as_real
from jaxform.core.ranges import RANGES, as_numbers, check
from jaxform.loads.loading import Loading, loading


@loading
class Gas(Loading):
    """An ideal gas of constant temperature inside the sheet; its gauge pressure is m R T / (V + dead volume) - ambient.

    At first it is at ambient pressure. So the pressure is a result, and a sheet passes the maximum of its pressure as
    it grows. Mass flow, volumes and mass are those of the modelled part: of a quarter a quarter.

    Attributes:
        time: Knots (n_knot,) [s], increasing.
        mass_flow: Mass flow at the knots (n_knot,) [kg/s], linear between them and held before and after; negative
            where gas leaves.
        temperature: Temperature of the gas [K].
        gas_constant: Specific gas constant [J/(kg K)]: 287.06 of air.
        ambient_pressure: Absolute pressure outside [Pa].
        dead_volume: Volume of the gas beside that under the sheet [m^3]: of hoses, and under a flat sheet.
    """

    follows_volume: ClassVar[bool] = True

    time: jax.Array = ranged_parameter(RANGES["gas.time"])
    mass_flow: jax.Array = ranged_parameter(RANGES["gas.mass_flow"])
    temperature: jax.Array = ranged_parameter(RANGES["gas.temperature"])
    gas_constant: jax.Array = ranged_parameter(RANGES["gas.gas_constant"])
    ambient_pressure: jax.Array = ranged_parameter(RANGES["gas.ambient_pressure"])
    dead_volume: jax.Array = ranged_parameter(RANGES["gas.dead_volume"])

    def start(self, volume: jax.Array) -> jax.Array:
        """The mass of the gas at first [kg], at ambient pressure."""
        return self.ambient_pressure * (volume + self.dead_volume) / (self.gas_constant * self.temperature)

    def at(self, time: jax.Array, volume: jax.Array, own: jax.Array) -> jax.Array:
        """Gauge pressure [Pa] with an enclosed volume [m^3]; `own` is the mass at first [kg]."""
        mass = own + self.inflow(time)
        return mass * self.gas_constant * self.temperature / (volume + self.dead_volume) - self.ambient_pressure

    def inflow(self, time: jax.Array) -> jax.Array:
        """Mass that has flowed in [kg] until a time [s], from the start at 0."""
        until = lambda moment: jnp.clip(moment, self.time[0], self.time[-1])  # noqa: E731
        if self.time.size == 1:
            return self.mass_flow[0] * time
        width = jnp.diff(self.time)
        slope = jnp.diff(self.mass_flow) / width

        def between(moment: jax.Array) -> jax.Array:
            passed = jnp.clip(moment - self.time[:-1], 0.0, width)
            return jnp.sum(passed * (self.mass_flow[:-1] + 0.5 * slope * passed))

        before = self.mass_flow[0] * jnp.minimum(time, self.time[0])
        after = self.mass_flow[-1] * jnp.maximum(time - self.time[-1], 0.0)
        return before + between(until(time)) - between(until(jnp.zeros_like(time))) + after


def make_gas(
    time: ArrayLike,
    mass_flow: ArrayLike,
    *,
    temperature: float = 293.15,
    gas_constant: float = 287.06,
    ambient_pressure: float = 101325.0,
    dead_volume: float = 0.0,
) -> Gas:
    """A gas with a mass flow through knots (n_knot,): times [s], increasing, and flows [kg/s]; see `Gas`.

    Raises:
        InputError: If the knots do not increase, are not finite, or do not match; or if a number is out of its range.
    """
    times = np.atleast_1d(as_numbers("gas.time", time))
    flows = np.atleast_1d(as_numbers("gas.mass_flow", mass_flow))
    if times.shape != flows.shape or times.ndim != 1 or not times.size:
        problem = f"{times.size} times and {flows.size} mass flows do not match"
        raise InputError(problem, "give one mass flow per time", "gas.mass_flow")
    if times[0] < 0.0:
        raise InputError("begins before the simulation", "begin at 0 or later", "gas.time", float(times[0]))
    numbers = {
        "temperature": temperature,
        "gas_constant": gas_constant,
        "ambient_pressure": ambient_pressure,
        "dead_volume": dead_volume,
    }
    for name, value in {"time": times, "mass_flow": flows, **numbers}.items():
        check(f"gas.{name}", np.asarray(as_numbers(f"gas.{name}", value)))
    return Gas(as_real(times), as_real(flows), **{name: as_real(value) for name, value in numbers.items()})

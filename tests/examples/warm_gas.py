"""A gas with a temperature of its own, as a user writes it: it flows in warm, and cools as it makes room."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp

import jaxform


class Gas(NamedTuple):
    """Its mass [kg] and its temperature [K]."""

    mass: jax.Array
    temperature: jax.Array


@jaxform.loading
class WarmGas(jaxform.Loading):
    """An ideal gas that exchanges no heat: p (V0 + V) = m R T; the pressure is gauge.

    What flows in at a temperature T_in brings the enthalpy c_p T_in: half of it before the gas expands in a step, where
    T V^(R/c_v) is kept, and half afterwards, for second order in the step. Volumes and masses are those of the modelled
    part.

    Attributes:
        mass: Initial mass [kg].
        temperature: Initial temperature [K].
        inflow: Mass flow until the inflow's end [kg/s].
        inflow_time: End of the inflow [s].
        inflow_temperature: Temperature of the inflow [K].
        constant: R [J/(kg K)].
        capacity: c_v [J/(kg K)].
        dead_volume: Volume of the gas beside that under the sheet [m^3].
        outside: Absolute pressure outside [Pa].
    """

    mass: jax.Array = jaxform.parameter("kg", above=0.0)
    temperature: jax.Array = jaxform.parameter("K", above=0.0)
    inflow: jax.Array = jaxform.parameter("kg/s", least=0.0)
    inflow_time: jax.Array = jaxform.parameter("s", above=0.0)
    inflow_temperature: jax.Array = jaxform.parameter("K", above=0.0)
    constant: jax.Array = jaxform.parameter("J/(kg K)", above=0.0)
    capacity: jax.Array = jaxform.parameter("J/(kg K)", above=0.0)
    dead_volume: jax.Array = jaxform.parameter("m^3", above=0.0)
    outside: jax.Array = jaxform.parameter("Pa", least=0.0)

    def start(self, volume: jax.Array) -> Gas:
        """The gas before the first step."""
        return Gas(self.mass, self.temperature)

    def after(self, own: Gas, interval: jaxform.Interval) -> Gas:
        """The gas once it has expanded and more has flowed in."""
        begin = interval.time - interval.length
        inflow = self.inflow * (jnp.minimum(interval.time, self.inflow_time) - jnp.minimum(begin, self.inflow_time))
        filled = self._add_mass(own, 0.5 * inflow)
        before, volume = self.dead_volume + interval.before, self.dead_volume + interval.volume
        cooled = filled.temperature * (before / volume) ** (self.constant / self.capacity)
        return self._add_mass(Gas(filled.mass, cooled), 0.5 * inflow)

    def _add_mass(self, own: Gas, more: jax.Array) -> Gas:
        mass, ratio = own.mass + more, 1.0 + self.constant / self.capacity
        return Gas(mass, (own.mass * own.temperature + more * ratio * self.inflow_temperature) / mass)

    def at(self, time: jax.Array, volume: jax.Array, own: Gas) -> jax.Array:
        """Gauge pressure [Pa]."""
        return own.mass * self.constant * own.temperature / (self.dead_volume + volume) - self.outside

"""A gas that flows into the sheet from a supply through a valve, and out of it through a vent."""

from __future__ import annotations

from typing import ClassVar

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike

from jaxform.core.errors import InputError
from jaxform.core.parameters import ranged_parameter
from jaxform.core.pytree import as_real
from jaxform.core.ranges import RANGES, Range, as_numbers, check
from jaxform.loads.loading import Interval, Loading, loading

_LAMINAR = 2e-3
"""Relative pressure difference below which the flow is smooth in it: an isentropic flow has an infinite slope at 0."""
_FEW = 1e-3  # share of a relaxation time below which its exponential is a series


@loading
class GasSupply(Loading):
    """An ideal gas of constant temperature inside the sheet, behind a valve and a vent; its gauge pressure is a result.

    The valve lets gas flow in from the supply while its pressure is higher, and back otherwise; the vent connects the
    gas with the outside. Both are isentropic flows through an orifice [1]: with the pressures p1 > p2 the mass flow is
    C A p1 / sqrt(R T) sqrt(2 k / (k - 1) (r^(2 / k) - r^((k + 1) / k))) with r = p2 / p1, not less than the critical
    ratio (2 / (k + 1))^(k / (k - 1)), where it is choked. At first the gas is at ambient pressure. Areas, mass flow,
    volumes and mass are those of the modelled part: of a quarter a quarter.

    [1] A. H. Shapiro, The Dynamics and Thermodynamics of Compressible Fluid Flow, vol. 1, 1953, chapter 4.

    Attributes:
        time: Knots (n_knot,) [s], increasing; all values at them are linear between and held before and after.
        mass_flow: Mass flow besides that of valve and vent (n_knot,) [kg/s]; negative where gas leaves.
        supply_pressure: Gauge pressure of the supply (n_knot,) [Pa].
        valve: Opening of the valve (n_knot,), from 0 to 1.
        orifice_area: Area of the open valve [m^2].
        vent: Opening of the vent (n_knot,), from 0 to 1.
        vent_area: Area of the open vent [m^2].
        discharge_coefficient: C of valve and vent.
        heat_capacity_ratio: k of the gas.
        temperature: Temperature of the gas, also in the supply [K].
        gas_constant: Specific gas constant R [J/(kg K)].
        ambient_pressure: Absolute pressure outside [Pa].
        dead_volume: Volume of the gas beside that under the sheet [m^3].
    """

    follows_volume: ClassVar[bool] = True

    time: jax.Array = ranged_parameter(RANGES["gas.time"])
    mass_flow: jax.Array = ranged_parameter(RANGES["gas.mass_flow"])
    supply_pressure: jax.Array = ranged_parameter(RANGES["gas.supply_pressure"])
    valve: jax.Array = ranged_parameter(RANGES["gas.valve"])
    orifice_area: jax.Array = ranged_parameter(RANGES["gas.orifice_area"])
    vent: jax.Array = ranged_parameter(RANGES["gas.vent"])
    vent_area: jax.Array = ranged_parameter(RANGES["gas.vent_area"])
    discharge_coefficient: jax.Array = ranged_parameter(RANGES["gas.discharge_coefficient"])
    heat_capacity_ratio: jax.Array = ranged_parameter(RANGES["gas.heat_capacity_ratio"])
    temperature: jax.Array = ranged_parameter(RANGES["gas.temperature"])
    gas_constant: jax.Array = ranged_parameter(RANGES["gas.gas_constant"])
    ambient_pressure: jax.Array = ranged_parameter(Range("Pa", above=0.0))
    dead_volume: jax.Array = ranged_parameter(RANGES["gas.dead_volume"])

    @property
    def _specific_energy(self) -> jax.Array:
        """R T [J/kg]."""
        return self.gas_constant * self.temperature

    def start(self, volume: jax.Array) -> jax.Array:
        """The mass of the gas at first [kg], at ambient pressure."""
        return self.ambient_pressure * (volume + self.dead_volume) / self._specific_energy

    def at(self, time: jax.Array, volume: jax.Array, mass: jax.Array) -> jax.Array:
        """Gauge pressure [Pa] of a mass [kg] with an enclosed volume [m^3]."""
        return mass * self._specific_energy / (volume + self.dead_volume) - self.ambient_pressure

    def after(self, mass: jax.Array, interval: Interval) -> jax.Array:
        """The mass [kg] at the end of an interval: exponential in what the pressure does to the flow, of second order.

        It is stable however fast the pressure follows; however long the interval, no pressure passes those beside it.
        """
        length = interval.length
        middle = interval.time - 0.5 * length
        volume = 0.5 * (interval.before + interval.volume) + self.dead_volume
        supply = self.at_knots(self.supply_pressure, middle) + self.ambient_pressure
        valve = self.at_knots(self.valve, middle) * self.orifice_area
        vent = self.at_knots(self.vent, middle) * self.vent_area
        blown = self.at_knots(self.mass_flow, middle)

        def flow(mass: jax.Array) -> jax.Array:
            inside = mass * self._specific_energy / volume
            out = self.orifice_flow(self.ambient_pressure, inside)
            return blown + valve * self.orifice_flow(supply, inside) + vent * out

        rate, slope = jax.jvp(flow, (mass,), (jnp.ones_like(mass),))
        ends = jnp.stack([mass, *(p * volume / self._specific_energy for p in (supply, self.ambient_pressure))])
        low, high = ends.min() + jnp.minimum(blown, 0.0) * length, ends.max() + jnp.maximum(blown, 0.0) * length
        return jnp.clip(mass + rate * length * _mean_decay(-slope * length), low, high)

    def at_knots(self, values: jax.Array, time: jax.Array) -> jax.Array:
        """A quantity of the knots (n_knot,) at a time [s]."""
        return values[0] if self.time.size == 1 else jnp.interp(time, self.time, values)

    def orifice_flow(self, outside: jax.Array, inside: jax.Array) -> jax.Array:
        """Mass flow [kg/s] per area [m^2] from one absolute pressure to another [Pa], below 0 where it flows back."""
        higher = jnp.maximum(outside, inside)
        factor = self.discharge_coefficient * higher / jnp.sqrt(self._specific_energy)
        return factor * self._flow_function((outside - inside) / higher)

    def _flow_function(self, drop: jax.Array) -> jax.Array:
        """The flow function of the relative pressure drop; below `_LAMINAR` a cubic with its value and slope there."""
        k = self.heat_capacity_ratio
        choked = 1.0 - (2.0 / (k + 1.0)) ** (k / (k - 1.0))

        def isentropic(drop: jax.Array) -> jax.Array:
            ratio = 1.0 - drop
            return jnp.sqrt(2.0 * k / (k - 1.0) * (ratio ** (2.0 / k) - ratio ** ((k + 1.0) / k)))

        first = jnp.full_like(drop, _LAMINAR)
        value, slope = jax.jvp(isentropic, (first,), (jnp.ones_like(first),))
        bend, share = 0.5 * (slope * _LAMINAR - value), drop / _LAMINAR
        laminar, size = share * (value - bend + bend * share**2), jnp.abs(drop)
        return jnp.where(size < _LAMINAR, laminar, jnp.sign(drop) * isentropic(jnp.clip(size, _LAMINAR, choked)))


def _mean_decay(rate: jax.Array) -> jax.Array:
    """The mean of exp(-rate s) over s from 0 to 1."""
    small = jnp.abs(rate) < _FEW
    usual = jnp.where(small, 1.0, rate)
    return jnp.where(small, 1.0 - rate / 2.0 + rate**2 / 6.0, -jnp.expm1(-usual) / usual)


def make_gas_supply(
    time: ArrayLike,
    *,
    supply_pressure: ArrayLike = 0.0,
    orifice_area: float = 0.0,
    valve: ArrayLike = 1.0,
    vent_area: float = 0.0,
    vent: ArrayLike = 1.0,
    mass_flow: ArrayLike = 0.0,
    discharge_coefficient: float = 0.8,
    heat_capacity_ratio: float = 1.4,
    temperature: float = 293.15,
    gas_constant: float = 287.06,
    ambient_pressure: float = 101325.0,
    dead_volume: float = 0.0,
) -> GasSupply:
    """A gas behind a valve and a vent, with knots at times (n_knot,) [s], increasing; see `GasSupply`.

    Args:
        time: Knots.
        supply_pressure: Gauge pressure of the supply [Pa], a number or one for each knot.
        orifice_area: Area of the open valve [m^2].
        valve: Opening of the valve, from 0 to 1, a number or one for each knot.
        vent_area: Area of the open vent [m^2].
        vent: Opening of the vent, from 0 to 1, a number or one for each knot.
        mass_flow: Mass flow besides [kg/s], a number or one for each knot.
        discharge_coefficient: Of valve and vent.
        heat_capacity_ratio: Of the gas.
        temperature: Of the gas [K].
        gas_constant: [J/(kg K)].
        ambient_pressure: Absolute pressure outside [Pa].
        dead_volume: [m^3].

    Raises:
        InputError: If the knots do not increase, values do not match them, or a number is out of its range.
    """
    times = np.atleast_1d(as_numbers("gas.time", time))
    if times.ndim != 1 or not times.size:
        raise InputError("is not a list of times", "give increasing times in s", "gas.time")
    if times[0] < 0.0:
        raise InputError("begins before the simulation", "begin at 0 or later", "gas.time", float(times[0]))
    at_knots = {"mass_flow": mass_flow, "supply_pressure": supply_pressure, "valve": valve, "vent": vent}
    numbers = {
        "orifice_area": orifice_area,
        "vent_area": vent_area,
        "discharge_coefficient": discharge_coefficient,
        "heat_capacity_ratio": heat_capacity_ratio,
        "temperature": temperature,
        "gas_constant": gas_constant,
        "ambient_pressure": ambient_pressure,
        "dead_volume": dead_volume,
    }
    for name, value in {"time": times, **at_knots, **numbers}.items():
        allowed = Range("Pa", above=0.0) if name == "ambient_pressure" else None
        check(f"gas.{name}", np.asarray(as_numbers(f"gas.{name}", value)), allowed)
    values = {name: _at_each(f"gas.{name}", value, times.size) for name, value in at_knots.items()}
    return GasSupply(
        time=as_real(times),
        **{name: as_real(value) for name, value in {**values, **numbers}.items()},
    )


def _at_each(key: str, given: ArrayLike, count: int) -> np.ndarray:
    """One value for each knot (count,)."""
    values = np.asarray(given, float)
    if values.ndim and values.shape != (count,):
        raise InputError(f"has {values.size} values for {count} times", "give one per time, or one number", key)
    return np.broadcast_to(values, (count,))

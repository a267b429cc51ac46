"""A gas inside the sheet, or between it and the mold: its pressure follows from its mass and the enclosed volume."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Mapping
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike

from jaxform.core.errors import InputError
from jaxform.core.pytree import as_real, ranged_parameter, static
from jaxform.core.ranges import RANGES, Range, as_numbers, check
from jaxform.loads.loading import Interval, Loading, loading

_CLOSED_BY = ("clamp", "mold")
_ROUNDING = 16  # ulps of the ambient pressure, by which sampled pressures may be off


MassAndHeat = tuple[jax.Array, jax.Array]
"""State of a gas that exchanges no heat: its mass [kg], and its mass times its temperature [kg K]."""


@loading
class Gas(Loading):
    """An ideal gas with a mass flow, and perhaps a valve and a vent; its gauge pressure is m R T / V - ambient.

    Initially the gas is at ambient pressure. Its pressure is a result of the simulation, so that a growing sheet passes
    the maximum of its pressure. The gas is inside the sheet, or, closed by the mold, on its other side, where it
    resists the sheet: then its volume is the dead volume less that under the sheet. It has a constant temperature, or,
    adiabatic, its own: it exchanges no heat, and what flows in, from the supply or from outside, brings enthalpy at
    `temperature`.

    The valve lets gas flow in from the supply while its pressure is higher, and back otherwise; the vent connects the
    gas with the outside; see `orifice_flow`. Areas, mass flow, volumes and mass are those of the modelled part: of a
    quarter a quarter.

    Attributes:
        time: Knots (n_knot,) [s], increasing; all values at them are linear between and held before and after.
        mass_flow: Mass flow besides that of valve and vent (n_knot,) [kg/s]; negative where gas leaves.
        temperature: Initial temperature of the gas, and that of the gas that flows in [K].
        gas_constant: Specific gas constant R [J/(kg K)]: 287.06 of air.
        ambient_pressure: Absolute pressure outside [Pa].
        dead_volume: Volume of the gas beside that under the sheet [m^3]: of hoses, and under a flat sheet; closed by
            the mold, that of the mold's cavity, from which the volume under the sheet is taken.
        heat_capacity_ratio: k of the gas.
        supply_pressure: Gauge pressure of the supply (n_knot,) [Pa]; None, as the two that follow, without a valve.
        valve: Opening of the valve (n_knot,), from 0 to 1.
        orifice_area: Area of the open valve [m^2].
        vent: Opening of the vent (n_knot,), from 0 to 1; None, as its area, without a vent.
        vent_area: Area of the open vent [m^2].
        discharge_coefficient: Discharge coefficient of valve and vent.
        adiabatic: True if the gas exchanges no heat; else its temperature is constant.
        closed_by: The surface that closes the volume of the gas: "clamp" for that under the sheet, or "mold".
    """

    follows_volume: ClassVar[bool] = True

    time: jax.Array = ranged_parameter(RANGES["gas.time"])
    mass_flow: jax.Array = ranged_parameter(RANGES["gas.mass_flow"])
    temperature: jax.Array = ranged_parameter(RANGES["gas.temperature"])
    gas_constant: jax.Array = ranged_parameter(RANGES["gas.gas_constant"])
    ambient_pressure: jax.Array = ranged_parameter(RANGES["gas.ambient_pressure"])
    dead_volume: jax.Array = ranged_parameter(RANGES["gas.dead_volume"])
    heat_capacity_ratio: jax.Array | None = ranged_parameter(RANGES["gas.heat_capacity_ratio"], default=None)
    supply_pressure: jax.Array | None = ranged_parameter(RANGES["gas.supply_pressure"], default=None)
    valve: jax.Array | None = ranged_parameter(RANGES["gas.valve"], default=None)
    orifice_area: jax.Array | None = ranged_parameter(RANGES["gas.orifice_area"], default=None)
    vent: jax.Array | None = ranged_parameter(RANGES["gas.vent"], default=None)
    vent_area: jax.Array | None = ranged_parameter(RANGES["gas.vent_area"], default=None)
    discharge_coefficient: jax.Array | None = ranged_parameter(RANGES["gas.discharge_coefficient"], default=None)
    adiabatic: bool = static(default=False)
    closed_by: str = static(default="clamp")

    @property
    def _specific_energy(self) -> jax.Array:
        """R T [J/kg] of the initial gas, and of the gas that flows in."""
        return self.gas_constant * self.temperature

    def gas_volume(self, volume: jax.Array) -> jax.Array:
        """Volume of the gas [m^3], with an enclosed volume [m^3] under the sheet."""
        return volume + self.dead_volume if self.closed_by == "clamp" else self.dead_volume - volume

    def start(self, volume: jax.Array) -> jax.Array | MassAndHeat:
        """The mass of the gas at first [kg], at ambient pressure; with its heat where it is adiabatic."""
        mass = self.ambient_pressure * self.gas_volume(volume) / self._specific_energy
        return (mass, mass * self.temperature) if self.adiabatic else mass

    def at(self, time: jax.Array, volume: jax.Array, state: jax.Array | MassAndHeat) -> jax.Array:
        """Gauge pressure [Pa] on the sheet with an enclosed volume [m^3]; negative where the gas resists the sheet."""
        if isinstance(state, tuple):
            energy = state[1] * self.gas_constant
        elif self.discharge_coefficient is not None:
            energy = state * self._specific_energy
        else:
            energy = (state + self.inflow(time)) * self.gas_constant * self.temperature
        # A pump takes no more gas than there is.
        gauge = jnp.maximum(energy, 0.0) / self.gas_volume(volume) - self.ambient_pressure
        return gauge if self.closed_by == "clamp" else -gauge

    def pushes(self, end_time: float, volume: float) -> np.ndarray:
        """Sampled pressures [Pa]; a difference in the last digits of absolute pressures is 0."""
        found = Loading.pushes(self, end_time, volume)
        ambient = self.ambient_pressure
        return np.where(np.abs(found) <= _ROUNDING * float(jnp.finfo(ambient.dtype).eps) * float(ambient), 0.0, found)

    def after(self, state: jax.Array | MassAndHeat, interval: Interval) -> jax.Array | MassAndHeat:
        """The state at the end of an interval; a mass without valve and vent remains that at first."""
        if isinstance(state, tuple):
            return self._after_without_heat(state, interval)
        return state if self.discharge_coefficient is None else self._after_isothermal(state, interval)

    def inflow(self, time: jax.Array) -> jax.Array:
        """Mass that has flowed in [kg] until a time [s], from the start at 0; without that through valve and vent."""
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

    def at_knots(self, values: jax.Array, time: jax.Array) -> jax.Array:
        """A quantity of the knots (n_knot,) at a time [s]."""
        return values[0] if self.time.size == 1 else jnp.interp(time, self.time, values)

    def orifice_flow(
        self, outside: jax.Array, inside: jax.Array, specific_energy: jax.Array | None = None
    ) -> jax.Array:
        """Mass flow [kg/s] per area [m^2] through valve or vent from one absolute pressure to another [Pa]."""
        assert self.discharge_coefficient is not None and self.heat_capacity_ratio is not None
        energy = self._specific_energy if specific_energy is None else specific_energy
        return orifice_flow(outside, inside, self.discharge_coefficient, energy, self.heat_capacity_ratio)

    def _openings(self, time: jax.Array) -> list[tuple[jax.Array, jax.Array]]:
        """Absolute pressure outside [Pa] and open area [m^2] of valve and vent, those that it has, at a time [s]."""
        found = []
        if self.supply_pressure is not None:
            assert self.valve is not None and self.orifice_area is not None
            supply = self.at_knots(self.supply_pressure, time) + self.ambient_pressure
            found.append((supply, self.at_knots(self.valve, time) * self.orifice_area))
        if self.vent is not None and self.vent_area is not None:
            found.append((self.ambient_pressure, self.at_knots(self.vent, time) * self.vent_area))
        return found

    def _after_isothermal(self, mass: jax.Array, interval: Interval) -> jax.Array:
        """The mass [kg] at the end of an interval, by a second-order exponential integrator.

        It is stable for any stiffness of the pressure; in a long interval no pressure passes those that drive the flow.
        """
        length = interval.length
        middle = interval.time - 0.5 * length
        volume = self.gas_volume(0.5 * (interval.before + interval.volume))
        openings = self._openings(middle)
        blown = self.at_knots(self.mass_flow, middle)

        def flow(mass: jax.Array) -> jax.Array:
            inside, total = mass * self._specific_energy / volume, blown
            for outside, area in openings:
                total = total + area * self.orifice_flow(outside, inside)
            return total

        rate, slope = jax.jvp(flow, (mass,), (jnp.ones_like(mass),))
        ends = jnp.stack([mass, *(outside * volume / self._specific_energy for outside, _ in openings)])
        low, high = ends.min() + jnp.minimum(blown, 0.0) * length, ends.max() + jnp.maximum(blown, 0.0) * length
        return jnp.clip(mass + rate * length * mean_decay(-slope * length), jnp.maximum(low, 0.0), high)

    def _after_without_heat(self, state: MassAndHeat, interval: Interval) -> MassAndHeat:
        """The state at the end of an interval: half of the change of volume, then the flow, then the other half."""
        assert self.heat_capacity_ratio is not None
        power = self.heat_capacity_ratio - 1.0
        before, volume = self.gas_volume(interval.before), self.gas_volume(interval.volume)
        middle = 0.5 * (before + volume)
        mass, heat = state
        expanded = mass, heat * (before / middle) ** power
        mass, heat = self._fill(expanded, interval.time - 0.5 * interval.length, interval.length, middle)
        return mass, heat * (middle / volume) ** power

    def _fill(self, state: MassAndHeat, middle: jax.Array, length: jax.Array, volume: jax.Array) -> MassAndHeat:
        """The state after a flow of this length [s] about a time [s], at a constant volume [m^3]; of second order."""
        openings, blown = self._openings(middle), self.at_knots(self.mass_flow, middle)
        pressures, areas = (jnp.asarray([each[k] for each in openings]) for k in range(2))
        k = self.heat_capacity_ratio
        assert k is not None

        def rates(state: MassAndHeat) -> MassAndHeat:
            mass, heat = state
            temperature = _ratio(heat, mass)
            total, gained = blown, blown * jnp.where(blown > 0.0, self.temperature, temperature)
            if openings:
                inside = heat * self.gas_constant / volume
                upstream = jnp.where(pressures > inside, self.temperature, temperature)
                flows = areas * self.orifice_flow(pressures, inside, self.gas_constant * upstream)
                total, gained = total + jnp.sum(flows), gained + jnp.sum(flows * upstream)
            return total, k * gained

        rate = rates(state)
        change = jax.jvp(rates, (state,), (rate,))[1]
        old_mass, old_heat = state
        mass, heat = (
            old + one * length * mean_decay(-_ratio(two, one) * length)
            for old, one, two in zip(state, rate, change, strict=True)
        )
        ends = jnp.stack([old_heat, *(outside * volume / self.gas_constant for outside, _ in openings)])
        more = k * blown * length
        low = jnp.maximum(ends.min() + jnp.minimum(more, 0.0) * _ratio(old_heat, old_mass), 0.0)
        # A gas of which mass is taken out keeps no more heat than its mass can have.
        heat = jnp.where(mass > 0.0, jnp.clip(heat, low, ends.max() + jnp.maximum(more, 0.0) * self.temperature), 0.0)
        return jnp.maximum(mass, 0.0), heat


def _ratio(part: jax.Array, whole: jax.Array) -> jax.Array:
    """A quotient, 0 where its divisor is 0."""
    none = whole == 0.0
    return jnp.where(none, 0.0, part / jnp.where(none, 1.0, whole))


def make_gas(
    time: ArrayLike,
    mass_flow: ArrayLike = 0.0,
    *,
    supply_pressure: ArrayLike | None = None,
    orifice_area: float | None = None,
    valve: ArrayLike = 1.0,
    vent_area: float | None = None,
    vent: ArrayLike = 1.0,
    discharge_coefficient: float = 0.8,
    heat_capacity_ratio: float = 1.4,
    temperature: float = 293.15,
    gas_constant: float = 287.06,
    ambient_pressure: float = 101325.0,
    dead_volume: float = 0.0,
    adiabatic: bool = False,
    closed_by: str = "clamp",
) -> Gas:
    """A gas with knots at times (n_knot,) [s], increasing; with valve and vent where one of them is given; see `Gas`.

    Args:
        time: Knots.
        mass_flow: Mass flow into the modelled part [kg/s], a number or one for each knot.
        supply_pressure: Gauge pressure of the supply [Pa], a number or one for each knot; below 0, a vacuum, only where
            the gas is closed by the mold.
        orifice_area: Area of the open valve [m^2].
        valve: Opening of the valve, from 0 to 1, a number or one for each knot.
        vent_area: Area of the open vent [m^2].
        vent: Opening of the vent, from 0 to 1, a number or one for each knot.
        discharge_coefficient: Discharge coefficient of valve and vent.
        heat_capacity_ratio: Heat capacity ratio of the gas.
        temperature: Temperature of the gas [K].
        gas_constant: [J/(kg K)].
        ambient_pressure: Absolute pressure outside [Pa].
        dead_volume: [m^3].
        adiabatic: True if the gas exchanges no heat.
        closed_by: "clamp" or "mold".

    Raises:
        InputError: If the knots do not increase, values do not match them, or a number is out of its range.
    """
    times = np.atleast_1d(as_numbers("gas.time", time))
    if times.ndim != 1 or not times.size:
        raise InputError("is not a list of times", "give increasing times in s", "gas.time")
    if times[0] < 0.0:
        raise InputError("begins before the simulation", "begin at 0 or later", "gas.time", float(times[0]))
    if closed_by not in _CLOSED_BY:
        raise InputError("unknown", f"choose one of {', '.join(_CLOSED_BY)}", "gas.closed_by", closed_by)
    at_knots, numbers = {"mass_flow": mass_flow}, {"temperature": temperature, "gas_constant": gas_constant}
    numbers |= {"ambient_pressure": ambient_pressure, "dead_volume": dead_volume}
    through_valve = supply_pressure is not None or orifice_area is not None
    through_orifices = through_valve or vent_area is not None
    if through_valve:
        at_knots |= {"supply_pressure": 0.0 if supply_pressure is None else supply_pressure, "valve": valve}
        numbers |= {"orifice_area": orifice_area or 0.0}
    if vent_area is not None:
        at_knots, numbers = at_knots | {"vent": vent}, numbers | {"vent_area": vent_area}
    if through_orifices:
        numbers |= {"discharge_coefficient": discharge_coefficient}
    if through_orifices or adiabatic:
        numbers |= {"heat_capacity_ratio": heat_capacity_ratio}
    for name, value in {"time": times, **at_knots, **numbers}.items():
        allowed = Range("Pa", above=0.0) if name == "ambient_pressure" and (through_orifices or adiabatic) else None
        check(f"gas.{name}", np.asarray(as_numbers(f"gas.{name}", value)), allowed)
    if through_valve:
        _check_supply(at_knots["supply_pressure"], ambient_pressure, closed_by)
    values = {name: _at_each(f"gas.{name}", value, times.size) for name, value in at_knots.items()}
    arrays = {name: as_real(value) for name, value in {"time": times, **values, **numbers}.items()}
    return Gas(**arrays, adiabatic=bool(adiabatic), closed_by=closed_by)


def _check_supply(pressure: ArrayLike, ambient: float, closed_by: str) -> None:
    """Raises InputError for a supply of a vacuum inside the sheet, or below absolute zero pressure."""
    least, given = (0.0, "is below 0") if closed_by == "clamp" else (-ambient, "is not a pressure above vacuum")
    lowest = float(np.min(np.asarray(pressure, float)))
    if lowest < 0.0 and lowest <= least:
        remedy = 'give gauge pressures >= 0 [Pa]; a vacuum, above -ambient_pressure, needs closed_by = "mold"'
        raise InputError(given, remedy, "gas.supply_pressure", lowest)


def _at_each(key: str, given: ArrayLike, count: int) -> np.ndarray:
    """One value for each knot (count,)."""
    values = np.asarray(given, float)
    if values.ndim and values.shape != (count,):
        problem = f"has {values.size} values for {count} times, which do not match"
        raise InputError(problem, "give one per time, or one number", key)
    return np.broadcast_to(values, (count,))


# The flow of a gas through an orifice, such as a valve or a vent.

_LAMINAR = 2e-3
"""Relative pressure difference below which the flow is smooth in it: an isentropic flow has an infinite slope at 0."""
_FEW = 1e-3  # share of a relaxation time below which its exponential is a series


def orifice_flow(
    outside: jax.Array,
    inside: jax.Array,
    discharge_coefficient: jax.Array,
    specific_energy: jax.Array,
    heat_capacity_ratio: jax.Array,
) -> jax.Array:
    """Mass flow [kg/s] per area [m^2] from one absolute pressure to another [Pa], below 0 where it flows back.

    Isentropic [1]: with the pressures p1 > p2 it is C p1 / sqrt(R T) sqrt(2 k / (k - 1) (r^(2 / k) - r^((k + 1) / k)))
    with r = p2 / p1, not less than the critical ratio (2 / (k + 1))^(k / (k - 1)), where it is choked.

    [1] A. H. Shapiro, The Dynamics and Thermodynamics of Compressible Fluid Flow, vol. 1, 1953, chapter 4.

    Args:
        outside: The one pressure.
        inside: The other one.
        discharge_coefficient: C.
        specific_energy: R T [J/kg] of the gas where the pressure is higher.
        heat_capacity_ratio: k.
    """
    higher = jnp.maximum(outside, inside)
    factor = discharge_coefficient * higher / jnp.sqrt(specific_energy)
    return factor * _flow_function((outside - inside) / higher, heat_capacity_ratio)


def _flow_function(drop: jax.Array, k: jax.Array) -> jax.Array:
    """The flow function of the relative pressure drop; below `_LAMINAR` a cubic with its value and slope there."""
    choked = 1.0 - (2.0 / (k + 1.0)) ** (k / (k - 1.0))

    def isentropic(drop: jax.Array) -> jax.Array:
        ratio = 1.0 - drop
        return jnp.sqrt(2.0 * k / (k - 1.0) * (ratio ** (2.0 / k) - ratio ** ((k + 1.0) / k)))

    first = jnp.full_like(drop, _LAMINAR)
    value, slope = jax.jvp(isentropic, (first,), (jnp.ones_like(first),))
    bend, share = 0.5 * (slope * _LAMINAR - value), drop / _LAMINAR
    laminar, size = share * (value - bend + bend * share**2), jnp.abs(drop)
    return jnp.where(size < _LAMINAR, laminar, jnp.sign(drop) * isentropic(jnp.clip(size, _LAMINAR, choked)))


def mean_decay(rate: jax.Array) -> jax.Array:
    """The mean of exp(-rate s) over s from 0 to 1."""
    small = jnp.abs(rate) < _FEW
    usual = jnp.where(small, 1.0, rate)
    return jnp.where(small, 1.0 - rate / 2.0 + rate**2 / 6.0, -jnp.expm1(-usual) / usual)


# Loads on both sides of the sheet: a pressure or a gas inside it, and the gas between it and the mold.


@loading
class TwoSidedLoad(Loading):
    """A pressure history or a gas inside the sheet, and a gas on its other side, trapped in the mold.

    The pressure on the sheet is their difference. Numbers of the two have the paths `pressure.inside.value` and
    `pressure.trapped.vent_area`.

    Attributes:
        inside: The load inside the sheet.
        trapped: The gas between the sheet and the mold, closed by the mold.
    """

    follows_volume: ClassVar[bool] = True

    inside: Loading = dataclasses.field(metadata={"part": True})
    trapped: Gas = dataclasses.field(metadata={"part": True})

    def start(self, volume: jax.Array) -> Any:
        """The states of the two."""
        return self.inside.start(volume), self.trapped.start(volume)

    def after(self, state: Any, interval: Interval) -> Any:
        """The states of the two at the end of an interval."""
        inside, trapped = state
        inside = None if inside is None else self.inside.after(inside, interval)
        return inside, self.trapped.after(trapped, interval)

    def at(self, time: jax.Array, volume: jax.Array, state: Any) -> jax.Array:
        """Difference of the pressures [Pa]."""
        inside, trapped = state
        pushed = self.inside.at(time, volume, *(() if inside is None else (inside,)))
        return pushed + self.trapped.at(time, volume, trapped)

    def pushes(self, end_time: float, volume: float) -> np.ndarray:
        """The pressures [Pa] inside."""
        return self.inside.pushes(end_time, volume)


def make_two_sided_load(inside: Loading, trapped: Gas) -> TwoSidedLoad:
    """A load inside the sheet and the gas that it traps in the mold; see `TwoSidedLoad`.

    Raises:
        InputError: The second is no gas that is closed by the mold, or the first is one.
    """
    if not isinstance(trapped, Gas) or trapped.closed_by != "mold":
        raise InputError("is not a gas closed by the mold", 'use make_gas(..., closed_by="mold")', "pressure.trapped")
    if (
        not isinstance(inside, Loading)
        or isinstance(inside, TwoSidedLoad)
        or getattr(inside, "closed_by", "") == "mold"
    ):
        raise InputError("is not a load inside the sheet", "use make_pressure or make_gas", "pressure.inside")
    return TwoSidedLoad(inside, trapped)


# Loads of regions of the sheet, such as the gases of several cavities.


@loading
class RegionalLoad(Loading):
    """Loads of several regions of the sheet, such as the gases of several cavities, each with a volume of its own.

    The pressure on an element is the sum of the pressures of the regions that it belongs to. The borders of the regions
    do not move, so that each volume follows from the elements of its region alone. Numbers of a load have the path
    `pressure.NAME.mass_flow`.

    Attributes:
        loads: The load of each region.
        names: Their names; none in a padded scene.
        regions: True for the elements of the initial mesh that each load pushes (n_load, n_element); None in a padded
            scene.
        border_volume: Volume between the plane of each region's border and the origin (n_load,) [m^3], which the
            enclosed volumes contain and a gas does not fill.
    """

    follows_volume: ClassVar[bool] = True

    loads: tuple[Loading, ...] = dataclasses.field(metadata={"part": True})
    names: tuple[str, ...] = static(default=())
    regions: jax.Array | None = dataclasses.field(default=None, metadata={"part": True})
    border_volume: jax.Array | None = dataclasses.field(default=None, metadata={"part": True})

    @property
    def sides(self) -> list[np.ndarray]:
        """Masks (n_load,) of the loads inside the sheet and of those trapped in the mold, without an empty one."""
        trapped = np.array([getattr(load, "closed_by", "") == "mold" for load in self.loads])
        return [side for side in (~trapped, trapped) if side.any()]

    def index(self, name: str) -> int | None:
        """The index of the load of this name, or with this number as text; None where there is none."""
        if name in self.names:
            return self.names.index(name)
        return int(name) if name.isdecimal() and int(name) < len(self.loads) else None

    def start(self, volume: jax.Array) -> Any:
        """The states of the loads, with enclosed volumes (n_load,) [m^3]."""
        return tuple(load.start(own) for load, own in zip(self.loads, self.own_volumes(volume), strict=True))

    def after(self, state: Any, interval: Interval) -> Any:
        """The states of the loads at the end of an interval, whose volumes are (n_load,)."""
        before, volume = self.own_volumes(interval.before), self.own_volumes(interval.volume)
        return tuple(
            None if state is None else load.after(state, Interval(interval.time, interval.length, *own))
            for load, state, *own in zip(self.loads, state, before, volume, strict=True)
        )

    def at(self, time: jax.Array, volume: jax.Array, state: Any) -> jax.Array:
        """Pressures (n_load,) [Pa] of the loads."""
        rows = zip(self.loads, self.own_volumes(volume), state, strict=True)
        return jnp.stack([load.at(time, own, *(() if state is None else (state,))) for load, own, state in rows])

    def pushes(self, end_time: float, volume: Any) -> np.ndarray:
        """The pressures [Pa] of all loads, but of those trapped in the mold only where there are no others."""
        found = [
            (getattr(load, "closed_by", "") == "mold", load.pushes(end_time, float(own)))
            for load, own in zip(self.loads, self.own_volumes(np.asarray(volume)), strict=True)
        ]
        inside = [pressures for trapped, pressures in found if not trapped]
        return np.concatenate(inside or [pressures for _, pressures in found])

    def own_volumes(self, volume: Any) -> list[Any]:
        """The volume [m^3] of each region above the plane of its border."""
        own = volume if self.border_volume is None else volume - self.border_volume
        return [own[k] for k in range(len(self.loads))]


def make_regional_load(loads: Mapping[str, tuple[Loading, ArrayLike]]) -> RegionalLoad:
    """Loads of regions of the sheet, by name, each with a mask (n_element,) of the elements that it pushes.

    The nodes on the border of a region have to be clamped. A `Pressure` may push the whole sheet and gases closed by
    the mold its regions: the pressure on an element is the sum.

    Raises:
        InputError: There is no load, a name or a load is not possible, a region is empty, or two regions on the same
            side of the sheet have an element in common.
    """
    if not loads:
        raise InputError("has no load", "give {name: (load, mask of its elements)}", "pressure")
    taken = {*(each.name for each in dataclasses.fields(Gas)), "value", "inside", "trapped", "clamp", "mold"}
    for name, (load, _) in loads.items():
        if not name.replace("-", "_").isidentifier() or name in taken - {"inside"}:
            remedy = "use letters, digits, - and _, such as left or cavity-2, and no word that names a key of a gas"
            raise InputError("cannot be the name of a gas", remedy, "gas.name", name)
        if not isinstance(load, Loading) or isinstance(load, TwoSidedLoad | RegionalLoad):
            raise InputError("is not a load of a region", "use make_gas or make_pressure", f"gas.{name}")
    sizes = {np.shape(mask) for _, mask in loads.values()}
    if len(sizes) > 1 or len(sizes.pop()) != 1:
        raise InputError("do not fit together", "give a mask (n_element,) for each region", "pressure.regions")
    regions = np.stack([np.asarray(mask, bool) for _, mask in loads.values()])
    _check_regions(list(loads), [getattr(load, "closed_by", "clamp") for load, _ in loads.values()], regions)
    return RegionalLoad(tuple(load for load, _ in loads.values()), tuple(loads), jnp.asarray(regions))


def _check_regions(names: list[str], sides: list[str], regions: np.ndarray) -> None:
    """Raises InputError where a region (n_load, n_element) is empty, or shares elements with another on its side."""
    for name, own in zip(names, regions, strict=True):
        if not own.any():
            remedy = "compare the region with the extent of the sheet (`jaxform check`), or make elements smaller"
            raise InputError("holds the centroid of no element", remedy, f"gas.{name}.region")
    for one, other in itertools.combinations(range(len(names)), 2):
        common = np.flatnonzero(regions[one] & regions[other])
        if len(common) and sides[one] == sides[other]:
            problem = f"has {len(common)} elements in common with that of {names[other]}, the first is {common[0]}"
            remedy = "let the regions on one side of the sheet not overlap"
            raise InputError(problem, remedy, f"gas.{names[one]}.region")


def list_gases(load: Loading) -> dict[str, Gas]:
    """The gases of a load, by the key of a scene file that they have."""
    parts: dict[str, Any] = {"gas": load}
    if isinstance(load, TwoSidedLoad):
        both = isinstance(load.inside, Gas)
        parts = {"gas.clamp": load.inside, "gas.mold" if both else "gas": load.trapped}
    elif isinstance(load, RegionalLoad):
        parts = {f"gas.{name}": own for name, own in zip(load.names, load.loads, strict=True)}
    return {key: part for key, part in parts.items() if isinstance(part, Gas)}

"""Cooling of a hot sheet: to the air on both sides, and to the mold where it is in contact.

The temperature is the mean over the thickness. Where a conductivity is given it is taken to be a parabola over the
thickness, which is what it becomes once heat has crossed the wall; from its mean to either surface there is then a
resistance that follows from the heat through both.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import ClassVar, dataclass_transform

import jax
import jax.numpy as jnp

from jaxform.core.pytree import parameter, pytree, ranged_parameter, register_part, static
from jaxform.core.ranges import RANGES

_SHORT = 1e-3  # of the time that cooling takes: shorter times take a series


Touching = jax.Array | Sequence[tuple[jax.Array, jax.Array, jax.Array]]
"""Share (n,) of one side, in area and time, in contact with the mold; or the contact with each of several tools.

The latter is that share, the tool's heat transfer coefficient [W/(m^2 K)], and its temperature [degC].
"""


@pytree
class Cooling:
    """Heat transfer coefficients and heat capacity of the sheet.

    Attributes:
        heat_capacity: Specific heat capacity of the sheet [J/(kg K)].
        air: Heat transfer coefficient to the air, on both sides [W/(m^2 K)].
        air_temperature: Temperature of the air [degC].
        mold: Heat transfer coefficient to the mold, on the side in contact [W/(m^2 K)].
        mold_temperature: Temperature of the mold [degC].
        conductivity: Thermal conductivity of the sheet [W/(m K)]; None if its surfaces have its mean temperature.
    """

    heat_capacity: jax.Array = ranged_parameter(RANGES["cooling.heat_capacity"])
    air: jax.Array = ranged_parameter(RANGES["cooling.air"], default=0.0)
    air_temperature: jax.Array = ranged_parameter(RANGES["cooling.air_temperature"], default=20.0)
    mold: jax.Array = ranged_parameter(RANGES["cooling.mold"], default=0.0)
    mold_temperature: jax.Array = ranged_parameter(RANGES["cooling.mold_temperature"], default=20.0)
    conductivity: jax.Array | None = ranged_parameter(RANGES["cooling.conductivity"], default=None)

    def cooled(
        self, temperature: jax.Array, wall: jax.Array, touching: Touching, density: jax.Array, time: jax.Array
    ) -> jax.Array:
        """Temperatures [degC] after a time, exact where nothing else changes.

        Args:
            temperature: Mean over the thickness (n,) [degC].
            wall: Thickness (n,) [m].
            touching: Share (n,) of one side, in area and time, in contact with the mold, or that with each tool.
            density: [kg/m^3], a number or (n,).
            time: [s], a number or (n,).
        """
        rate, loss = self._rates(temperature, wall, touching, density)
        return temperature - time * loss * _mean_decay(time * rate)

    def pace(self, temperature: jax.Array, wall: jax.Array, touching: Touching, density: jax.Array) -> jax.Array:
        """Cooling rate (n,) [K/s] of walls; arguments as in `cooled`."""
        return self._rates(temperature, wall, touching, density)[1]

    def _rates(
        self, temperature: jax.Array, wall: jax.Array, touching: Touching, density: jax.Array
    ) -> tuple[jax.Array, jax.Array]:
        """Rate constants (n,) [1/s] of walls towards the ambient temperature, and their cooling rates [K/s]."""
        free = self._heat_transfer(self.air, self.air_temperature, wall)
        tools = touching
        if not isinstance(touching, Sequence):
            tools = [(touching, self.mold, self.mold_temperature)]
        conductance, drive = free
        for share, coefficient, other in tools:
            held = self._heat_transfer(coefficient, other, wall)
            conductance, drive = conductance + share * (held[0] - free[0]), drive + share * (held[1] - free[1])
        each = 1.0 / (density * self.heat_capacity * wall)
        return each * conductance, each * (conductance * temperature - drive)

    def _heat_transfer(
        self, other: jax.Array, other_temperature: jax.Array, wall: jax.Array
    ) -> tuple[jax.Array, jax.Array]:
        """Conductance [W/(m^2 K)] and heat flux offset [W/m^2] (n,) of both sides: air, and another medium.

        A parabola with the heat q and p through its surfaces has there temperatures that are (2 q - p) wall / 6 k and
        (2 p - q) wall / 6 k below its mean.
        """
        one, two = self.air, other
        a, b = jnp.zeros_like(wall), jnp.zeros_like(wall)
        if self.conductivity is not None:
            a, b = (each * wall / (6.0 * self.conductivity) for each in (one, two))
        scale = 1.0 / ((1.0 + 2.0 * a) * (1.0 + 2.0 * b) - a * b)
        one, two = scale * one * (1.0 + 3.0 * b), scale * two * (1.0 + 3.0 * a)
        return one + two, one * self.air_temperature + two * other_temperature


def _mean_decay(x: jax.Array) -> jax.Array:
    """(1 - exp(-x)) / x."""
    short, long = jnp.minimum(x, _SHORT), jnp.maximum(x, _SHORT)
    series = 1.0 - short * (1 / 2 - short * (1 / 6 - short * (1 / 24 - short / 120)))
    return jnp.where(x < _SHORT, series, -jnp.expm1(-long) / long)


# Time-temperature shift: effect of temperature on the relaxation times of Prony terms and on stiffness.

GAS_CONSTANT = 8.31446261815324  # J/(mol K)
_KELVIN = 273.15  # at 0 degC
_GLASS = 35.0  # natural logarithm of the largest factor: so much slower nothing moves within any run
_LEAST = 1e-3  # of the distance from a pole


class Shift:
    """A factor on relaxation times, by temperature; its class says whether stiffness goes with it.

    Attributes:
        kind: Its name.
        stiffens: True if the factor is one on all moduli too.
        reference: The temperature [degC] at which the law's numbers hold.
    """

    kind: ClassVar[str] = ""
    stiffens: ClassVar[bool] = False
    reference: jax.Array

    def factor(self, temperature: jax.Array) -> jax.Array:
        """The factor at temperatures [degC], of their shape."""
        raise NotImplementedError

    def coldest(self) -> jax.Array:
        """The temperature [degC] that the sheet must be above."""
        return jnp.full_like(self.reference, -_KELVIN)


@dataclass_transform(frozen_default=True, field_specifiers=(parameter, ranged_parameter, static))
def shift[T: Shift](cls: type[T]) -> type[T]:
    """Makes a class a shift: a frozen dataclass and a pytree, its numbers known to `replace` and to designs."""
    remedy = "derive it from Shift and define its factor"
    return register_part(cls, Shift, "factor", remedy, "material.shift", needed=("reference",))


@shift
class Wlf(Shift):
    """log10 a = -c1 (T - T_r) / (c2 + T - T_r) (M. L. Williams, R. F. Landel, J. D. Ferry, J. Am. Chem. Soc. 77, 1955).

    It shifts relaxation times, not moduli.

    Attributes:
        reference: T_r [degC].
        c1: First coefficient [-].
        c2: Second coefficient [K].
    """

    kind: ClassVar[str] = "wlf"
    reference: jax.Array = ranged_parameter(RANGES["material.shift.reference"])
    c1: jax.Array = ranged_parameter(RANGES["material.shift.c1"])
    c2: jax.Array = ranged_parameter(RANGES["material.shift.c2"])

    def factor(self, temperature: jax.Array) -> jax.Array:
        """The factor at temperatures [degC], of their shape."""
        above = temperature - self.reference
        # Where it has no value the sheet is glass.
        difference = jnp.maximum(self.c2 + above, _LEAST * self.c2)
        return jnp.exp(jnp.minimum(-jnp.log(10.0) * self.c1 * above / difference, _GLASS))

    def coldest(self) -> jax.Array:
        """The temperature [degC] at which the factor has a pole."""
        return self.reference - self.c2


@shift
class Arrhenius(Shift):
    """The shift ln a = E / R (1 / T - 1 / T_r) of relaxation times, T in kelvin.

    Attributes:
        reference: T_r [degC].
        activation_energy: E [J/mol].
    """

    kind: ClassVar[str] = "arrhenius"
    reference: jax.Array = ranged_parameter(RANGES["material.shift.reference"])
    activation_energy: jax.Array = ranged_parameter(RANGES["material.shift.activation_energy"])

    def factor(self, temperature: jax.Array) -> jax.Array:
        """The factor at temperatures [degC], of their shape."""
        inverse = 1.0 / (temperature + _KELVIN) - 1.0 / (self.reference + _KELVIN)
        return jnp.exp(jnp.minimum(self.activation_energy / GAS_CONSTANT * inverse, _GLASS))


@shift
class ArrheniusStiffness(Arrhenius):
    """The Arrhenius shift of times and of all moduli: those of the law, and those of its Prony terms.

    Attributes:
        reference: T_r [degC].
        activation_energy: E [J/mol].
    """

    kind: ClassVar[str] = "arrhenius-stiffness"
    stiffens: ClassVar[bool] = True


SHIFTS: dict[str, type[Shift]] = {"wlf": Wlf, "arrhenius": Arrhenius, "arrhenius-stiffness": ArrheniusStiffness}
"""Those that a scene file names."""

"""Time-temperature shift: effect of temperature on the relaxation times of Prony terms and on stiffness."""

from __future__ import annotations

from typing import ClassVar, dataclass_transform

import jax
import jax.numpy as jnp

from jaxform.core.parameters import parameter, ranged_parameter, register_part
from jaxform.core.pytree import static
from jaxform.core.ranges import RANGES

GAS_CONSTANT = 8.31446261815324  # J/(mol K)
_KELVIN = 273.15  # at 0 degC
_GLASS = 35.0  # natural logarithm of the largest factor: so much slower nothing moves within any run
_LEAST = 1e-3  # of the distance from a pole


class Shift:
    """A factor on relaxation times, by temperature; its class says whether stiffness goes with it.

    Attributes:
        kind: Its name.
        stiffens: Whether the factor is one on all moduli too.
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

    Of times alone: stiffness stays, a factor of 16 for 10 K near the reference.

    Attributes:
        reference: T_r [degC].
        c1: A number.
        c2: [K].
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
    """ln a = E / R (1 / T - 1 / T_r), T in kelvin; of times alone.

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

"""The Mooney-Rivlin laws of the paper."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from jaxform.core.pytree import parameter, ranged_parameter
from jaxform.core.ranges import RANGES
from jaxform.materials.law import Law, Slope, law


@law(model="mooney-rivlin")
class MooneyRivlin(Law):
    """W = c [(I1 - 3) + alpha (I2 - 3)], the paper's Eq. 2.

    Attributes:
        c: First coefficient [Pa], a number.
        alpha: Ratio of the second coefficient to the first, a number.
        density: Mass per volume [kg/m^3].
    """

    c: jax.Array = parameter("Pa", above=0.0)
    alpha: jax.Array = parameter(least=0.0)
    density: jax.Array = ranged_parameter(RANGES["material.density"])

    def energy(self, i1: jax.Array, i2: jax.Array) -> jax.Array:
        """Strain energy per reference volume [J/m^3], of the shape of the invariants."""
        return self.c * ((i1 - 3.0) + self.alpha * (i2 - 3.0))

    def slopes(self, i1: jax.Array, i2: jax.Array) -> tuple[jax.Array, Slope]:
        """dW/dI1 and dW/dI2 [Pa]."""
        return self.c, self.c * self.alpha

    def curvatures(self, i1: jax.Array, i2: jax.Array) -> tuple[Slope, Slope, Slope]:
        """d2W/dI1^2, d2W/dI1 dI2 and d2W/dI2^2 [Pa]: none."""
        return None, None, None

    def stiffness(self) -> jax.Array:
        """C of an equally stiff neo-Hookean sheet in small strain [Pa]."""
        return self.c * (1.0 + self.alpha)


@law(model="modified-mooney-rivlin")
class ModifiedMooneyRivlin(Law):
    """W = A01 (I1 - 3) + A02 (I2 - 3)^2, the paper's Eq. 13.

    Attributes:
        a01: First coefficient [Pa], a number.
        a02: Second coefficient [Pa], a number.
        density: Mass per volume [kg/m^3].
    """

    a01: jax.Array = parameter("Pa", above=0.0)
    a02: jax.Array = parameter("Pa", least=0.0)
    density: jax.Array = ranged_parameter(RANGES["material.density"])

    def energy(self, i1: jax.Array, i2: jax.Array) -> jax.Array:
        """Strain energy per reference volume [J/m^3], of the shape of the invariants."""
        return self.a01 * (i1 - 3.0) + self.a02 * jnp.square(i2 - 3.0)

    def slopes(self, i1: jax.Array, i2: jax.Array) -> tuple[jax.Array, Slope]:
        """dW/dI1 and dW/dI2 [Pa]."""
        return self.a01, 2.0 * self.a02 * (i2 - 3.0)

    def curvatures(self, i1: jax.Array, i2: jax.Array) -> tuple[Slope, Slope, Slope]:
        """d2W/dI1^2, d2W/dI1 dI2 and d2W/dI2^2 [Pa]."""
        return None, None, 2.0 * self.a02

    def stiffness(self) -> jax.Array:
        """C of an equally stiff neo-Hookean sheet in small strain [Pa]."""
        return self.a01

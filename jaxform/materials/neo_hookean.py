"""The neo-Hookean law."""

from __future__ import annotations

import jax

from jaxform.core.pytree import parameter, ranged_parameter
from jaxform.core.ranges import RANGES
from jaxform.materials.law import Law, Slope, law


@law(model="neo-hookean")
class NeoHookean(Law):
    """W = c (I1 - 3).

    Attributes:
        c: Half the shear modulus [Pa], a number.
        density: Mass per volume [kg/m^3].
    """

    c: jax.Array = parameter("Pa", above=0.0)
    density: jax.Array = ranged_parameter(RANGES["material.density"])

    def energy(self, i1: jax.Array, i2: jax.Array) -> jax.Array:
        """Strain energy per reference volume [J/m^3], of the shape of the invariants."""
        return self.c * (i1 - 3.0)

    def slopes(self, i1: jax.Array, i2: jax.Array) -> tuple[jax.Array, Slope]:
        """dW/dI1 and dW/dI2 [Pa]."""
        return self.c, None

    def curvatures(self, i1: jax.Array, i2: jax.Array) -> tuple[Slope, Slope, Slope]:
        """d2W/dI1^2, d2W/dI1 dI2 and d2W/dI2^2 [Pa]: none."""
        return None, None, None

    def stiffness(self) -> jax.Array:
        """C of an equally stiff neo-Hookean sheet in small strain [Pa]."""
        return self.c

"""Yeoh's law."""

from __future__ import annotations

import jax

from jaxform.core.pytree import parameter, ranged_parameter
from jaxform.core.ranges import RANGES
from jaxform.materials.law import Law, Slope, law


@law(model="yeoh")
class Yeoh(Law):
    """W = c1 (I1 - 3) + c2 (I1 - 3)^2 + c3 (I1 - 3)^3 (O. H. Yeoh, Rubber Chem. Technol. 63, 1990).

    Attributes:
        c1: Half the shear modulus in small strain [Pa].
        c2: Coefficient of the square [Pa].
        c3: Coefficient of the cube [Pa].
        density: Mass per volume [kg/m^3].
    """

    c1: jax.Array = parameter("Pa", above=0.0)
    c2: jax.Array = parameter("Pa", file_default=0.0)
    c3: jax.Array = parameter("Pa", least=0.0, file_default=0.0)
    density: jax.Array = ranged_parameter(RANGES["material.density"])

    def energy(self, i1: jax.Array, i2: jax.Array) -> jax.Array:
        """Strain energy per reference volume [J/m^3], of the shape of the invariants."""
        x = i1 - 3.0
        return x * (self.c1 + x * (self.c2 + x * self.c3))

    def slopes(self, i1: jax.Array, i2: jax.Array) -> tuple[jax.Array, Slope]:
        """dW/dI1 and dW/dI2 [Pa]."""
        x = i1 - 3.0
        return self.c1 + x * (2.0 * self.c2 + 3.0 * x * self.c3), None

    def curvatures(self, i1: jax.Array, i2: jax.Array) -> tuple[Slope, Slope, Slope]:
        """d2W/dI1^2, d2W/dI1 dI2 and d2W/dI2^2 [Pa]."""
        return 2.0 * self.c2 + 6.0 * self.c3 * (i1 - 3.0), None, None

    def stiffness(self) -> jax.Array:
        """C of an equally stiff neo-Hookean sheet in small strain [Pa]."""
        return self.c1

"""Yeoh's law, as a user writes it: the energy alone; slopes, the stable step and gradients follow from it."""

from __future__ import annotations

import jax

import jaxform


@jaxform.law
class Yeoh(jaxform.Law):
    """W = c1 (I1 - 3) + c2 (I1 - 3)^2 + c3 (I1 - 3)^3 (O. H. Yeoh, Rubber Chem. Technol. 63, 1990).

    Attributes:
        c1: Half the shear modulus in small strain [Pa].
        c2: Coefficient of the square [Pa].
        c3: Coefficient of the cube [Pa].
        density: Mass per volume [kg/m^3].
    """

    c1: jax.Array = jaxform.parameter("Pa", above=0.0)
    c2: jax.Array = jaxform.parameter("Pa")
    c3: jax.Array = jaxform.parameter("Pa", least=0.0)
    density: jax.Array = jaxform.parameter("kg/m^3", above=0.0)

    def energy(self, i1: jax.Array, i2: jax.Array) -> jax.Array:
        """Strain energy per reference volume [J/m^3]."""
        x = i1 - 3.0
        return x * (self.c1 + x * (self.c2 + x * self.c3))

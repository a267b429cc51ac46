"""Strain energies of incompressible rubber-like materials, as functions of the invariants (I1, I2).

Every law is a pytree whose parameters are leaves; its class is the static choice. A law answers for its energy and
for its slopes dW/dI1 and dW/dI2; a slope that the law never has is `None`, so that the step does not compute it
(decided by the law's name, never by a parameter's value: its gradient would silently be zero).
"""

from __future__ import annotations

import jax
import jax.numpy as jnp

from jaxform.pytree import pytree

Slope = jax.Array | None


@pytree
class NeoHookean:
    """W = c (I1 - 3).

    Attributes:
        c: Half the shear modulus [Pa], a number.
        density: Mass per volume [kg/m^3].
    """

    c: jax.Array
    density: jax.Array

    def energy(self, i1: jax.Array, i2: jax.Array) -> jax.Array:
        """Strain energy per reference volume [J/m^3], of the shape of the invariants."""
        return self.c * (i1 - 3.0)

    def slopes(self, i1: jax.Array, i2: jax.Array) -> tuple[jax.Array, Slope]:
        """dW/dI1 and dW/dI2 [Pa]."""
        return self.c, None

    def curvatures(self, i1: jax.Array, i2: jax.Array) -> Slope:
        """d2W/dI2^2 [Pa], the only second derivative that any of the laws has."""
        return None

    def stiffness(self) -> jax.Array:
        """C of an equally stiff neo-Hookean sheet in small strain [Pa]."""
        return self.c


@pytree
class MooneyRivlin:
    """W = c [(I1 - 3) + alpha (I2 - 3)], the paper's Eq. 2.

    Attributes:
        c: First coefficient [Pa], a number.
        alpha: Ratio of the second coefficient to the first, a number.
        density: Mass per volume [kg/m^3].
    """

    c: jax.Array
    alpha: jax.Array
    density: jax.Array

    def energy(self, i1: jax.Array, i2: jax.Array) -> jax.Array:
        """Strain energy per reference volume [J/m^3], of the shape of the invariants."""
        return self.c * ((i1 - 3.0) + self.alpha * (i2 - 3.0))

    def slopes(self, i1: jax.Array, i2: jax.Array) -> tuple[jax.Array, Slope]:
        """dW/dI1 and dW/dI2 [Pa]."""
        return self.c, self.c * self.alpha

    def curvatures(self, i1: jax.Array, i2: jax.Array) -> Slope:
        """d2W/dI2^2 [Pa]: none."""
        return None

    def stiffness(self) -> jax.Array:
        """C of an equally stiff neo-Hookean sheet in small strain [Pa]."""
        return self.c * (1.0 + self.alpha)


@pytree
class ModifiedMooneyRivlin:
    """W = A01 (I1 - 3) + A02 (I2 - 3)^2, the paper's Eq. 13.

    Attributes:
        a01: First coefficient [Pa], a number.
        a02: Second coefficient [Pa], a number.
        density: Mass per volume [kg/m^3].
    """

    a01: jax.Array
    a02: jax.Array
    density: jax.Array

    def energy(self, i1: jax.Array, i2: jax.Array) -> jax.Array:
        """Strain energy per reference volume [J/m^3], of the shape of the invariants."""
        return self.a01 * (i1 - 3.0) + self.a02 * jnp.square(i2 - 3.0)

    def slopes(self, i1: jax.Array, i2: jax.Array) -> tuple[jax.Array, Slope]:
        """dW/dI1 and dW/dI2 [Pa]."""
        return self.a01, 2.0 * self.a02 * (i2 - 3.0)

    def curvatures(self, i1: jax.Array, i2: jax.Array) -> Slope:
        """d2W/dI2^2 [Pa]."""
        return 2.0 * self.a02

    def stiffness(self) -> jax.Array:
        """C of an equally stiff neo-Hookean sheet in small strain [Pa]."""
        return self.a01


Material = NeoHookean | MooneyRivlin | ModifiedMooneyRivlin

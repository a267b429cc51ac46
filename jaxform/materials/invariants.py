"""Material models of the invariants I1 and I2: neo-Hookean, Mooney-Rivlin, Yeoh and Gent."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from jaxform.core.pytree import parameter, ranged_parameter
from jaxform.core.ranges import RANGES
from jaxform.materials.law import Law, Slope, law

_NEAREST = 0.01  # of the way to Gent's limit: from there on the energy continues with constant curvature


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


@law(model="gent")
class Gent(Law):
    """W = -mu j_max / 2 ln(1 - (I1 - 3) / j_max) (A. N. Gent, Rubber Chem. Technol. 69, 1996).

    The sheet does not stretch beyond a limit. From 99 % of it on, where the sheet is a hundred times as stiff as at
    first, the energy continues as a parabola: an explicit step may pass the limit, and the sheet must then be pulled
    back by a finite force.

    Attributes:
        mu: Shear modulus in small strain [Pa].
        j_max: Limit of I1 - 3.
        density: Mass per volume [kg/m^3].
    """

    mu: jax.Array = parameter("Pa", above=0.0)
    j_max: jax.Array = parameter(above=0.0)
    density: jax.Array = ranged_parameter(RANGES["material.density"])

    def energy(self, i1: jax.Array, i2: jax.Array) -> jax.Array:
        """Strain energy per reference volume [J/m^3], of the shape of the invariants."""
        inside, left, beyond = self._limit_terms(i1)
        within_limit = -0.5 * self.mu * self.j_max * jnp.log1p(-inside / self.j_max)
        slope = 0.5 * self.mu / left
        return within_limit + beyond * (slope + 0.5 * beyond * slope / (left * self.j_max))

    def slopes(self, i1: jax.Array, i2: jax.Array) -> tuple[jax.Array, Slope]:
        """dW/dI1 and dW/dI2 [Pa]."""
        _, left, beyond = self._limit_terms(i1)
        return 0.5 * self.mu / left * (1.0 + beyond / (left * self.j_max)), None

    def curvatures(self, i1: jax.Array, i2: jax.Array) -> tuple[Slope, Slope, Slope]:
        """d2W/dI1^2, d2W/dI1 dI2 and d2W/dI2^2 [Pa]."""
        _, left, _ = self._limit_terms(i1)
        return 0.5 * self.mu / (jnp.square(left) * self.j_max), None, None

    def stiffness(self) -> jax.Array:
        """C of an equally stiff neo-Hookean sheet in small strain [Pa]."""
        return 0.5 * self.mu

    def _limit_terms(self, i1: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
        """The part of I1 - 3 within the limit, the share of the limit that is then left, and the part beyond."""
        x = i1 - 3.0
        inside = jnp.minimum(x, (1.0 - _NEAREST) * self.j_max)
        return inside, 1.0 - inside / self.j_max, x - inside

"""Gent's law, with a limit to how far the chains stretch."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from jaxform.core.pytree import parameter, ranged_parameter
from jaxform.core.ranges import RANGES
from jaxform.materials.law import Law, Slope, law

_NEAREST = 0.01  # of the way to the limit is left, where the energy goes on with the curvature that it has there


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

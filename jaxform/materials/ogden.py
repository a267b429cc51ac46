"""Ogden's law: a sum of powers of the principal stretches."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxform.core.errors import InputError
from jaxform.core.parameters import within
from jaxform.core.ranges import OF_LAWS, RANGES
from jaxform.kernels.blocks import once
from jaxform.materials.law import PlaneLaw, law

# Of how alike both stretches are, cosh y - 1 with y = ln(l1 / l2): below it a series serves, whose derivatives are
# good; so many of its terms are as good as all for powers of up to 20.
_ALIKE, _TERMS = 1e-4, 5

_RANGES = OF_LAWS["ogden"]


@law
class Ogden(PlaneLaw):
    """W = sum of mu_p / alpha_p (l1^alpha_p + l2^alpha_p + l3^alpha_p - 3) (R. W. Ogden, Proc. R. Soc. A 326, 1972).

    With y = ln(l1 / l2) and D = (l1 l2)^2, so that l3 = D^(-1/2), and p = alpha / 2::

        W     = sum of mu / alpha (2 D^(p/2) cosh(p y) + D^(-p) - 3)
        dW/dT = sum of mu / 2 D^((p-1)/2) sinh(p y) / sinh(y)
        dW/dD = - sum of mu / 2 (D^(p/2-1) sinh((p-1) y) / sinh(y) + D^(-p-1))

    where T = l1^2 + l2^2 = 2 D^(1/2) cosh(y): all are smooth in T and D, equal stretches included.

    Attributes:
        mu: One number for each term (n,) [Pa].
        alpha: The powers (n,), of which none is 0.
        density: Mass per volume [kg/m^3].
    """

    mu: jax.Array = within(_RANGES["mu"], listed=True)
    alpha: jax.Array = within(_RANGES["alpha"], listed=True)
    density: jax.Array = within(RANGES["material.density"])

    def energy(self, trace: jax.Array, determinant: jax.Array) -> jax.Array:
        """Strain energy per reference volume [J/m^3], of the shape of both."""
        plane, total = _Plane(trace, determinant), jnp.zeros_like(trace)
        for mu, alpha in zip(self.mu, self.alpha, strict=True):
            power = plane.to(0.5 * alpha)
            # As above, of cosh(p y).
            cosine = power.cosine_before * plane.cosine + power.sines_before * plane.sine_squared
            total += mu / alpha * (2.0 * power.area * cosine + jnp.square(power.thickness) - 3.0)
        return total

    def slopes(self, trace: jax.Array, determinant: jax.Array) -> tuple[jax.Array, jax.Array]:
        """dW/dT and dW/dD [Pa]."""
        plane = _Plane(trace, determinant)
        by_trace, by_determinant = jnp.zeros_like(trace), jnp.zeros_like(trace)
        for mu, alpha in zip(self.mu, self.alpha, strict=True):
            power, half = plane.to(0.5 * alpha), 0.5 * mu
            # sinh(p y) = sinh((p - 1) y) cosh(y) + cosh((p - 1) y) sinh(y).
            sines = power.sines_before * plane.cosine + power.cosine_before
            # Else all of it would be worked out for each of the two again.
            first = half * power.area * sines
            second = half * (power.area * power.sines_before + jnp.square(power.thickness))
            by_trace, by_determinant = once((by_trace + first, by_determinant - second))
        return by_trace * plane.thickness, by_determinant * jnp.square(plane.thickness)

    def verify(self) -> None:
        """Raises InputError unless there are as many powers as moduli, none is 0, and the sheet is stiff at first."""
        mu, alpha = np.asarray(self.mu, float), np.asarray(self.alpha, float)
        if len(mu) != len(alpha):
            problem = f"has {len(alpha)} numbers, mu has {len(mu)}"
            raise InputError(problem, "give one for each term", "material.alpha")
        # Of zones each place is looked at.
        mu, alpha = np.broadcast_arrays(*(own if own.ndim > 1 else own[:, None] for own in (mu, alpha)))
        if not np.all(alpha):
            raise InputError("has a power of 0", "leave that term out", "material.alpha", alpha[:, 0].tolist())
        if np.any(soft := np.sum(mu * alpha, axis=0) <= 0):
            remedy = "let the sum of mu alpha, twice the shear modulus, be above 0"
            raise InputError("has no stiffness in small strain", remedy, "material.mu", mu[:, np.argmax(soft)].tolist())


class _Power(NamedTuple):
    """Of stretches to a power p: (l1 l2)^p and (l1 l2)^-p; cosh((p - 1) y), and sinh((p - 1) y) / sinh(y)."""

    area: jax.Array
    thickness: jax.Array
    cosine_before: jax.Array
    sines_before: jax.Array


class _Plane:
    """What powers of principal stretches are made of, element by element (n,)."""

    def __init__(self, trace: jax.Array, determinant: jax.Array) -> None:
        """Of the trace l1^2 + l2^2 and the determinant (l1 l2)^2."""
        area = jnp.sqrt(determinant)
        thickness = 1.0 / area
        excess = 0.5 * trace * thickness - 1.0  # of cosh y over 1; by rounding it may be below 0
        alike = excess < _ALIKE
        # Equal stretches have no derivative of y: there the series serves, and these are any numbers.
        square = excess * (excess + 2.0)
        sine = jnp.sqrt(jnp.where(alike, 1.0, square))
        stretch = jnp.where(alike, 1.0, 1.0 + excess) + sine  # exp(y)
        logs = _log(area), _log(stretch)
        # What all terms use is worked out once.
        made = once((thickness, excess, square, 0.5 / sine, 1.0 / stretch, *logs))
        self.thickness, self.excess, self.sine_squared, self._half_sine, self._shrink, *logs = made
        self._log_area, self._angle = logs
        self._alike, self.cosine, self._stretch = alike, 1.0 + self.excess, stretch

    def to(self, power: jax.Array) -> _Power:
        """Their power."""
        area, growth = once((jnp.exp(power * self._log_area), jnp.exp(power * self._angle)))
        inverse = 1.0 / (area * growth)
        before, after = growth * self._shrink, inverse * area * self._stretch  # exp((p - 1) y), and its inverse
        sines = jnp.where(self._alike, self._series(power - 1.0), (before - after) * self._half_sine)
        sines = once(sines)
        return _Power(area, inverse * growth, jnp.sqrt(1.0 + jnp.square(sines) * self.sine_squared), sines)

    def _series(self, power: jax.Array) -> jax.Array:
        """Chebyshev's U of the order `power` - 1 about 1, where it is sinh(power y) / sinh(y)."""
        total = jnp.ones_like(self.excess)
        for k in reversed(range(_TERMS)):
            factor = (jnp.square(power) - (k + 1) ** 2) / ((k + 1.5) * (k + 1) * 2.0)
            total = 1.0 + factor * self.excess * total
        return power * total


@jax.custom_jvp
def _log(values: jax.Array) -> jax.Array:
    """Logarithm of positive values, to rounding, by one step of Halley's method from that in single precision.

    XLA's CPU compiler has the exponential in vectors in double precision, the logarithm in single precision alone.
    """
    begin = jnp.log(values.astype(jnp.float32)).astype(values.dtype)
    grown = jnp.exp(begin)
    return begin + 2.0 * (values - grown) / (values + grown)


@_log.defjvp
def _log_change(values: tuple[jax.Array], changes: tuple[jax.Array]) -> tuple[jax.Array, jax.Array]:
    return _log(*values), changes[0] / values[0]

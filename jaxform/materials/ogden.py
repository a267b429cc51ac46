"""Ogden's law: a sum of powers of the principal stretches."""

from __future__ import annotations

import functools
from collections.abc import Iterable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.custom_derivatives import SymbolicZero

from jaxform.core.errors import InputError
from jaxform.core.parameters import within
from jaxform.core.ranges import OF_LAWS, RANGES
from jaxform.kernels.blocks import once
from jaxform.kernels.elementary import exp2, log2
from jaxform.materials.law import PlaneLaw, law

# Of how alike both stretches are, cosh y - 1 with y = ln(l1 / l2): below it a series serves, whose derivatives are
# good; so many of its terms are as good as all for powers of up to 20.
_ALIKE, _TERMS = 1e-4, 5
# The same of sinh(y)^2 where no derivative is needed: three terms serve.
_CLOSE, _LEAST = 1e-6, 1e-30
_LN_2 = 0.6931471805599453
_MOST = 500.0  # of log2 of a power: stretches beyond are cut

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
        slopes = _slopes if trace.dtype == jnp.float64 else _smooth_slopes
        return slopes(list(self.mu), list(self.alpha), trace, determinant)

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


@jax.custom_jvp
def _slopes(
    mu: list[jax.Array], alpha: list[jax.Array], trace: jax.Array, determinant: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """dW/dT and dW/dD in double precision, from powers of x1 = l1^2, x2 and x3 alone; as they are, not to be varied.

    With f(x) = dw/dx = sum of mu / 2 x^p, p = alpha / 2 - 1, and Q = (f(x1) - f(x2)) / (x1 - x2)::

        dW/dT = f(x2) + x1 Q,  dW/dD = -Q - f(x3) / D^2
    """
    inverse = 1.0 / determinant
    apart = jnp.maximum(0.25 * jnp.square(trace) * inverse - 1.0, _LEAST)  # sinh(y)^2; by rounding it may be below 0
    half = jnp.sqrt(apart * determinant)
    inverse, apart, half, larger = once((inverse, apart, half, 0.5 * trace + half))
    terms = [(0.5 * modulus, 0.5 * power - 1.0) for modulus, power in zip(mu, alpha, strict=True)]
    most = _MOST / (2.0 + functools.reduce(jnp.maximum, (jnp.abs(power) for _, power in terms)))
    product, first = once(tuple(jnp.clip(log2(values), -most, most) for values in (determinant, larger)))

    def slope(logs: jax.Array) -> jax.Array:
        return sum((half_modulus * exp2(power * logs) for half_modulus, power in terms), jnp.zeros_like(logs))

    def slope_of_slope(logs: jax.Array) -> jax.Array:
        """Q by the series of sinh(p y) / (p sinh y) in sinh(y)^2."""
        total = jnp.zeros_like(logs)
        for half_modulus, power in terms:
            square = jnp.square(power)
            series = 1.0 + apart * ((square - 1.0) / 6.0) * (1.0 + apart * ((square - 9.0) / 20.0))
            total += half_modulus * power * exp2((power - 1.0) * logs) * series
        return total

    alike = slope_of_slope(0.5 * product)
    f1, f2, f3, alike = once((slope(first), slope(product - first), slope(-product), alike))
    quotient = jnp.where(apart < _CLOSE, alike, (f1 - f2) * (0.5 / half))
    return f2 + larger * quotient, -quotient - f3 * jnp.square(inverse)


@functools.partial(_slopes.defjvp, symbolic_zeros=True)
def _slopes_change(at: tuple[Any, ...], changes: tuple[Any, ...]) -> tuple[Any, Any]:
    """The change of the form that is smooth at equal stretches, with what varies."""
    values, tree = jax.tree.flatten(at)
    given = jax.tree.leaves(changes)
    varied = [k for k, change in enumerate(given) if not isinstance(change, SymbolicZero)]

    def smooth(*those: jax.Array) -> tuple[jax.Array, jax.Array]:
        every = list(values)
        for k, value in zip(varied, those, strict=True):
            every[k] = value
        return _smooth_slopes(*jax.tree.unflatten(tree, every))

    change = jax.jvp(smooth, [values[k] for k in varied], [given[k] for k in varied])[1]
    return _slopes(*at), change


def _smooth_slopes(
    mu: Iterable[jax.Array], alpha: Iterable[jax.Array], trace: jax.Array, determinant: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """dW/dT and dW/dD, smooth in all."""
    plane = _Plane(trace, determinant)
    by_trace, by_determinant = jnp.zeros_like(trace), jnp.zeros_like(trace)
    for modulus, exponent in zip(mu, alpha, strict=True):
        power, half = plane.to(0.5 * exponent), 0.5 * modulus
        # sinh(p y) = sinh((p - 1) y) cosh(y) + cosh((p - 1) y) sinh(y).
        sines = power.sines_before * plane.cosine + power.cosine_before
        # Else all of it would be worked out for each of the two again.
        first = half * power.area * sines
        second = half * (power.area * power.sines_before + jnp.square(power.thickness))
        by_trace, by_determinant = once((by_trace + first, by_determinant - second))
    return by_trace * plane.thickness, by_determinant * jnp.square(plane.thickness)


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
        logs = _LN_2 * log2(area), _LN_2 * log2(stretch)
        # What all terms use is worked out once.
        made = once((alike, thickness, excess, square, 0.5 / sine, 1.0 / stretch, *logs))
        self._alike, self.thickness, self.excess, self.sine_squared, self._half_sine, self._shrink, *logs = made
        self._log_area, self._angle = logs
        self.cosine, self._stretch = 1.0 + self.excess, stretch

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

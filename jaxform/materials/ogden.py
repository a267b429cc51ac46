"""Ogden's law: a sum of powers of the principal stretches."""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.custom_derivatives import SymbolicZero

from jaxform.core.errors import InputError
from jaxform.core.pytree import parameter, ranged_parameter
from jaxform.core.ranges import RANGES
from jaxform.kernels.blocks import materialize
from jaxform.kernels.elementary import exp2, exp2m1, log2, log2p1
from jaxform.materials.law import PlaneLaw, law

# The stretches are nearly equal below this value of cosh y - 1, y = ln(l1 / l2): there a series is used, whose
# derivatives are accurate; so many of its terms are as good as all for powers of up to 20.
_ALIKE, _TERMS = 1e-4, 5
_LEAST = 1e-30  # of what is above 0 but for rounding
_LN_2 = 0.6931471805599453
_TOGETHER = 3  # how many terms share a division
_MOST = 900.0  # of log2 of so many powers' product: stretches beyond are cut


@law(model="ogden")
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

    mu: jax.Array = parameter("Pa", listed=True)
    alpha: jax.Array = parameter(least=-20.0, most=20.0, listed=True)
    density: jax.Array = ranged_parameter(RANGES["material.density"])

    def energy(self, trace: jax.Array, determinant: jax.Array) -> jax.Array:
        """Strain energy per reference volume [J/m^3], of the shape of both."""
        plane, total = _PlaneStretches(trace, determinant), jnp.zeros_like(trace)
        for mu, alpha in zip(self.mu, self.alpha, strict=True):
            area, thickness, cosine_before, sines_before = plane.to_power(0.5 * alpha)
            # As above, of cosh(p y).
            cosine = cosine_before * plane.cosine + sines_before * plane.sine_squared
            total += mu / alpha * (2.0 * area * cosine + jnp.square(thickness) - 3.0)
        return total

    def slopes(self, trace: jax.Array, determinant: jax.Array) -> tuple[jax.Array, jax.Array]:
        """dW/dT and dW/dD [Pa]."""
        slopes = _slopes if trace.dtype == jnp.float64 else _smooth_slopes
        return slopes(list(self.mu), list(self.alpha), trace, determinant)

    def curvatures(self, trace: jax.Array, determinant: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
        """d2W/dT2, d2W/dTdD and d2W/dD2 [Pa]."""
        curved = _slopes_and_curvatures if trace.dtype == jnp.float64 else _smooth_curvatures
        by_trace, mixed, by_determinant = curved(list(self.mu), list(self.alpha), trace, determinant)[2:]
        return by_trace, mixed, by_determinant

    def verify(self) -> None:
        """Raises InputError unless there are as many powers as moduli, none is 0, and the sheet is stiff at first."""
        mu, alpha = np.asarray(self.mu, float), np.asarray(self.alpha, float)
        if len(mu) != len(alpha):
            problem = f"has {len(alpha)} numbers, mu has {len(mu)}"
            raise InputError(problem, "give one for each term", "material.alpha")
        # With zones each place is examined.
        mu, alpha = np.broadcast_arrays(*(values if values.ndim > 1 else values[:, None] for values in (mu, alpha)))
        if not np.all(alpha):
            raise InputError("has an exponent of 0", "leave that term out", "material.alpha", alpha[:, 0].tolist())
        if np.any(soft := np.sum(mu * alpha, axis=0) <= 0):
            remedy = "the sum of mu alpha, twice the shear modulus, must be positive"
            raise InputError("has no stiffness at small strain", remedy, "material.mu", mu[:, np.argmax(soft)].tolist())


@jax.custom_jvp
def _slopes(
    mu: list[jax.Array], alpha: list[jax.Array], trace: jax.Array, determinant: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """dW/dT and dW/dD in double precision, by `_SlopePowers`."""
    return _SlopePowers(mu, alpha, trace, determinant).slopes()


@functools.partial(_slopes.defjvp, symbolic_zeros=True)
def _slopes_jvp(at: tuple[Any, ...], changes: tuple[Any, ...]) -> tuple[Any, Any]:
    """Along the strain by the second derivatives, along the law's numbers by the form that is smooth in all."""
    *numbers, trace, determinant = changes
    if isinstance(trace, SymbolicZero) and isinstance(determinant, SymbolicZero):
        return _slopes(*at), _jvp_of(_smooth_slopes, at, changes)
    *slopes, by_trace, mixed, by_determinant = _slopes_and_curvatures(*at)
    rise, growth = (0.0 if isinstance(change, SymbolicZero) else change for change in (trace, determinant))
    along = by_trace * rise + mixed * growth, mixed * rise + by_determinant * growth
    still = [SymbolicZero(jax.typeof(values).to_tangent_aval()) for values in at[2:]]
    if not all(isinstance(change, SymbolicZero) for change in jax.tree.leaves(numbers)):
        along = jax.tree.map(jnp.add, along, _jvp_of(_smooth_slopes, at, (*numbers, *still)))
    return tuple(slopes), along


@jax.custom_jvp
def _slopes_and_curvatures(
    mu: list[jax.Array], alpha: list[jax.Array], trace: jax.Array, determinant: jax.Array
) -> tuple[jax.Array, ...]:
    """The slopes, d2W/dT2, d2W/dTdD and d2W/dD2, by `_SlopePowers`."""
    powers = _SlopePowers(mu, alpha, trace, determinant)
    return *powers.slopes(), *powers.curvatures()


@functools.partial(_slopes_and_curvatures.defjvp, symbolic_zeros=True)
def _slopes_and_curvatures_jvp(at: tuple[Any, ...], changes: tuple[Any, ...]) -> tuple[Any, Any]:
    return _slopes_and_curvatures(*at), _jvp_of(_smooth_curvatures, at, changes)


def _jvp_of(function: Callable[..., Any], at: tuple[Any, ...], changes: tuple[Any, ...]) -> Any:
    """JVP of a function with respect to the arguments that have a tangent."""
    values, tree = jax.tree.flatten(at)
    given = jax.tree.leaves(changes)
    varied = [k for k, change in enumerate(given) if not isinstance(change, SymbolicZero)]

    def function_of_varied(*those: jax.Array) -> Any:
        every = list(values)
        for k, value in zip(varied, those, strict=True):
            every[k] = value
        return function(*jax.tree.unflatten(tree, every))

    return jax.jvp(function_of_varied, [values[k] for k in varied], [given[k] for k in varied])[1]


class _SlopePowers:
    """Derivatives from powers of x1 = l1^2 >= x2 and x3 = 1 / D alone: fast as they are, not to be varied.

    With f(x) = dw/dx = sum of c x^p, c = mu / 2, p = alpha / 2 - 1, and g(x) = x f'(x)::

        Q       = (f(x1) - f(x2)) / (x1 - x2)
        dW/dT   = f(x2) + x1 Q
        dW/dD   = -Q - f(x3) / D^2
        d2W/dT2 = (x1 g(x1) + x2 g(x2) - 2 D Q) / (x1 - x2)^2

    and so on. Where x1 and x2 are nearly alike Q is right to rounding; second derivatives are a series there.
    """

    def __init__(
        self, mu: Iterable[jax.Array], alpha: Iterable[jax.Array], trace: jax.Array, determinant: jax.Array
    ) -> None:
        """Computes the powers from T and D."""
        self._terms = [(0.5 * modulus, 0.5 * power - 1.0) for modulus, power in zip(mu, alpha, strict=True)]
        self._trace, self._determinant = trace, determinant
        # By rounding the difference may be below 0. What several loops use each is computed once, with one division.
        half = materialize(jnp.sqrt(jnp.maximum(0.25 * jnp.square(trace) - determinant, _LEAST * determinant)))
        both = materialize(0.5 / (determinant * half))
        self._half, self._larger = half, 0.5 * trace + half
        self._inverse, self._per_difference = 2.0 * half * both, determinant * both
        highest = functools.reduce(jnp.maximum, (jnp.abs(power) for _, power in self._terms))
        most = _MOST / (2.0 + _TOGETHER * highest)
        ratio = log2p1(2.0 * half * self._larger * self._inverse)  # log2 of x1 / x2
        product = jnp.clip(log2(determinant), -most, most)
        self._product, ratio = materialize((product, jnp.minimum(ratio, most)))
        # The smaller one of x1^p and x2^p, and what the other one is more: nothing is lost, however far apart they are.
        sizes = [(power, jnp.abs(power)) for _, power in self._terms]
        self._less = materialize([exp2(0.5 * (power * self._product - size * ratio)) for power, size in sizes])
        self._more = materialize(
            [less * exp2m1(size * ratio) for less, (_, size) in zip(self._less, sizes, strict=True)]
        )
        self._quotient = materialize(self._power_difference([c for c, _ in self._terms]) * self._per_difference)

    def _power_difference(self, weights: list[jax.Array]) -> jax.Array:
        """Sum of weights times x1^p - x2^p."""
        parts = zip(weights, self._terms, self._more, strict=True)
        return sum((weight * jnp.sign(p) * more for weight, (_, p), more in parts), jnp.zeros_like(self._half))

    def _second_powers(self, weights: list[jax.Array]) -> jax.Array:
        """Sum of weights times x2^p."""
        parts = zip(weights, self._terms, self._less, self._more, strict=True)
        terms = (weight * less + jnp.where(p < 0.0, weight, 0.0) * more for weight, (_, p), less, more in parts)
        return sum(terms, jnp.zeros_like(self._half))

    def _third_powers(self, weights: list[jax.Array]) -> jax.Array:
        """Sum of weights times x3^p = 1 / (x1 x2)^p: a division costs as much as three powers."""
        total, weighted = jnp.zeros_like(self._half), list(zip(weights, self._less, self._more, strict=True))
        for first in range(0, len(weighted), _TOGETHER):
            above, below = jnp.zeros_like(total), jnp.ones_like(total)
            for weight, less, more in weighted[first : first + _TOGETHER]:
                power = less * (less + more)
                above, below = above * power + weight * below, below * power
            total += above / below
        return total

    def slopes(self) -> tuple[jax.Array, jax.Array]:
        """dW/dT and dW/dD."""
        weights = [c for c, _ in self._terms]
        by_trace = self._second_powers(weights) + self._larger * self._quotient
        return by_trace, -self._quotient - self._third_powers(weights) * jnp.square(self._inverse)

    def curvatures(self) -> tuple[jax.Array, jax.Array, jax.Array]:
        """d2W/dT2, d2W/dTdD and d2W/dD2."""
        trace, inverse, larger, quotient = self._trace, self._inverse, self._larger, self._quotient
        tilted = [c * p for c, p in self._terms]
        at_smaller, change = materialize((self._second_powers(tilted), self._power_difference(tilted)))
        at_larger, smaller = at_smaller + change, self._determinant / larger
        third = self._third_powers([c * (p + 2.0) for c, p in self._terms]) * inverse**3
        share = jnp.square(self._per_difference)
        by_trace = (larger * at_larger + smaller * at_smaller - 2.0 * self._determinant * quotient) * share
        mixed = (trace * quotient - at_larger - at_smaller) * share
        by_determinant = ((smaller * at_larger + larger * at_smaller) * inverse - 2.0 * quotient) * share
        alike, *series = self._nearly_equal()
        found = zip((by_trace, mixed, by_determinant), series, strict=True)
        by_trace, mixed, by_determinant = (jnp.where(alike, near, far) for far, near in found)
        return by_trace, mixed, by_determinant + third

    def _nearly_equal(self) -> tuple[jax.Array, jax.Array, jax.Array, jax.Array]:
        """Mask of nearly equal x1 and x2, and the second derivatives there without the contribution of x3.

        With m = D^(1/2) and e = T / (2 m) - 1, f(x1) - f(x2) = sum of c m^p U_p(e) (x1 - x2) / m.
        """
        shrink = jnp.sqrt(self._inverse)
        excess, shrink = materialize((0.5 * self._trace * shrink - 1.0, shrink))
        by_trace = mixed = by_determinant = jnp.zeros_like(excess)
        for c, p in self._terms:
            power = 0.5 * c * exp2((0.5 * p) * self._product) * shrink
            value, slope = _series(p, excess)
            by_trace += power * _series(p + 1.0, excess)[1]
            mixed -= power * shrink * slope
            by_determinant += power * jnp.square(shrink) * ((1.0 + excess) * slope - (p - 1.0) * value)
        return excess < _ALIKE, by_trace, mixed, by_determinant


def _series(power: jax.Array, excess: jax.Array) -> tuple[jax.Array, jax.Array]:
    """sinh(power Y) / sinh(Y), Chebyshev's U of the order `power` - 1, in cosh(Y) - 1, and its slope."""
    total, slope = jnp.ones_like(excess), jnp.zeros_like(excess)
    for k in reversed(range(1, _TERMS + 1)):
        factor = (jnp.square(power) - k**2) / (k * (2 * k + 1))
        slope = factor * (total + excess * slope)
        total = 1.0 + factor * excess * total
    return power * total, power * slope


def _smooth_curvatures(mu: Any, alpha: Any, trace: jax.Array, determinant: jax.Array) -> tuple[jax.Array, ...]:
    """The slopes and their derivatives, smooth in all."""
    one = jnp.ones_like(trace)
    slopes, along = jax.jvp(lambda trace: _smooth_slopes(mu, alpha, trace, determinant), (trace,), (one,))
    across = jax.jvp(lambda determinant: _smooth_slopes(mu, alpha, trace, determinant)[1], (determinant,), (one,))[1]
    return *slopes, *along, across


def _smooth_slopes(
    mu: Iterable[jax.Array], alpha: Iterable[jax.Array], trace: jax.Array, determinant: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """dW/dT and dW/dD, smooth in all."""
    plane = _PlaneStretches(trace, determinant)
    by_trace, by_determinant = jnp.zeros_like(trace), jnp.zeros_like(trace)
    for modulus, exponent in zip(mu, alpha, strict=True):
        area, thickness, cosine_before, sines_before = plane.to_power(0.5 * exponent)
        half = 0.5 * modulus
        # sinh(p y) = sinh((p - 1) y) cosh(y) + cosh((p - 1) y) sinh(y).
        sines = sines_before * plane.cosine + cosine_before
        # Else all of it would be computed for each of the two again.
        first = half * area * sines
        second = half * (area * sines_before + jnp.square(thickness))
        by_trace, by_determinant = materialize((by_trace + first, by_determinant - second))
    return by_trace * plane.thickness, by_determinant * jnp.square(plane.thickness)


class _PlaneStretches:
    """Quantities for powers of principal stretches, element by element (n,)."""

    def __init__(self, trace: jax.Array, determinant: jax.Array) -> None:
        """Computes the quantities from the trace l1^2 + l2^2 and the determinant (l1 l2)^2."""
        area = jnp.sqrt(determinant)
        thickness = 1.0 / area
        excess = 0.5 * trace * thickness - 1.0  # of cosh y over 1; by rounding it may be below 0
        alike = excess < _ALIKE
        # Equal stretches have no derivative of y: there the series serves, and these are any numbers.
        square = excess * (excess + 2.0)
        sine = jnp.sqrt(jnp.where(alike, 1.0, square))
        stretch = jnp.where(alike, 1.0, 1.0 + excess) + sine  # exp(y)
        logs = _LN_2 * log2(area), _LN_2 * log2(stretch)
        # Quantities that all terms use are computed once.
        made = materialize((alike, thickness, excess, square, 0.5 / sine, 1.0 / stretch, *logs))
        self._alike, self.thickness, self.excess, self.sine_squared, self._half_sine, self._shrink, *logs = made
        self._log_area, self._angle = logs
        self.cosine, self._stretch = 1.0 + self.excess, stretch

    def to_power(self, power: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array, jax.Array]:
        """Powers p of the stretches: (l1 l2)^p and (l1 l2)^-p; cosh((p - 1) y), and sinh((p - 1) y) / sinh(y)."""
        area, growth = materialize((jnp.exp(power * self._log_area), jnp.exp(power * self._angle)))
        inverse = 1.0 / (area * growth)
        before, after = growth * self._shrink, inverse * area * self._stretch  # exp((p - 1) y), and its inverse
        sines = jnp.where(self._alike, _series(power - 1.0, self.excess)[0], (before - after) * self._half_sine)
        sines = materialize(sines)
        return area, inverse * growth, jnp.sqrt(1.0 + jnp.square(sines) * self.sine_squared), sines

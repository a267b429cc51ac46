"""Prony terms: stress on top of a law's that remembers how the sheet was strained; and Christensen's and Maxwell's.

The stress of each mode is kept for each element, as four numbers: the components 11, 12, 22 of the second Piola-
Kirchhoff stress in the basis of the element's initial edges [Pa/m^2], and that across the sheet [Pa], from which the
pressure follows that keeps the sheet free of stress across. (Four, not three: without the last a sphere that
should grow by 8.7 % grows by 12.4 %.)

Over a step the strain is taken to be linear in time, for which the recursion is exact. With k the step over the
mode's time, M what its stress follows, and x the stress::

    x_new = exp(-k) x_old + gain M_new - back M_old

so that r = exp(-k) x - back M is all that goes from step to step.
"""

from __future__ import annotations

import dataclasses
from typing import ClassVar, NamedTuple, Self, dataclass_transform

import jax
import jax.numpy as jnp

from jaxform.core.pytree import parameter, ranged_parameter, register_part, static
from jaxform.core.ranges import RANGES

Symmetric = tuple[jax.Array, jax.Array, jax.Array]
Rows = list[jax.Array]

_SHORT = 0.05  # of a mode's time: shorter steps take a series


class StrainState(NamedTuple):
    """Strain state of elements (n,): metric, inverse initial metric, trace and determinant of the plane strain."""

    metric: Symmetric
    inverse: Symmetric
    trace: jax.Array
    determinant: jax.Array

    @property
    def initial(self) -> Symmetric:
        """The initial metric."""
        a, b, c = self.inverse
        scale = 1.0 / self._inverse_area
        return c * scale, -b * scale, a * scale

    @property
    def present_inverse(self) -> Symmetric:
        """The inverse of the present metric."""
        a, b, c = self.metric
        scale = self._inverse_area / self.determinant
        return c * scale, -b * scale, a * scale

    @property
    def mixed_components(self) -> Symmetric:
        """The present metric with its components raised by the initial one: by the theorem of Cayley and Hamilton."""
        a, b, c = self.metric
        r, scale = self.inverse, self._inverse_area
        return self.trace * r[0] - scale * c, self.trace * r[1] + scale * b, self.trace * r[2] - scale * a

    @property
    def _inverse_area(self) -> jax.Array:
        a, b, c = self.inverse
        return a * c - b * b


Recursion = tuple[jax.Array, jax.Array, jax.Array]
"""Factors of a step for each mode (n_mode,): stress decay, gain, and weight of the old measure."""


class Modes:
    """Prony terms of one kind, a modulus and a time each; the kind is the class.

    Where temperature shifts them, both are of each element, (n_mode, n).

    Attributes:
        kind: Its name.
        modulus: One number for each mode (n_mode,) [Pa].
        time: Relaxation times (n_mode,) [s].
    """

    kind: ClassVar[str] = ""
    modulus: jax.Array
    time: jax.Array

    @staticmethod
    def measure(strained: StrainState) -> Rows:
        """The strain measure that the stress of a mode follows: 11, 12, 22 [1/m^2], and across."""
        raise NotImplementedError

    def recursion(self, step: jax.Array) -> Recursion:
        """The recursion factors of a step [s]."""
        raise NotImplementedError

    def initial_stress(self, inverse: jax.Array) -> jax.Array:
        """The stress (4 n_mode, n) of elements that were never strained, with this inverse metric (3, n)."""
        raise NotImplementedError

    def apply_shift(self, times: jax.Array, moduli: jax.Array) -> Self:
        """The modes of each element, with factors (n,) on times and moduli."""
        numbers = {"modulus": self.modulus[:, None] * moduli[None], "time": self.time[:, None] * times[None]}
        return dataclasses.replace(self, **numbers)  # pyright: ignore[reportArgumentType, reportReturnType, reportCallIssue]

    def limit_losses(self, step: jax.Array) -> Self:
        """The modes for `loss` over steps of a length [s]; too fast modes get an infinite relaxation time.

        A mode that relaxes in t loses t times the square of the strain rate. From its stress no more than the rounding
        of that, over t, would come; of the power it is less than the share t over the step.
        """
        time = _as_column(self.time, step)
        fast = step > time * jnp.finfo(time.dtype).eps ** -0.5
        return dataclasses.replace(self, time=jnp.where(fast, jnp.inf, time))  # pyright: ignore[reportArgumentType, reportReturnType, reportCallIssue]

    def energy(self, stress: list[Rows], strained: StrainState) -> jax.Array:
        """Stored energy of the modes (n,) [J/m^3], from the stress of each."""
        raise NotImplementedError

    def loss(self, stress: list[Rows], strained: StrainState) -> jax.Array:
        """Dissipated power of the modes (n,) [W/m^3]."""
        raise NotImplementedError

    def stiffening(self, larger: jax.Array, smaller: jax.Array) -> jax.Array:
        """Largest eigenvalue (n,) [Pa] of how the stress of all modes answers at once to strain, at these stretches."""
        raise NotImplementedError

    def stiffness(self) -> jax.Array:
        """C of an equally stiff neo-Hookean sheet in small strain, at once [Pa]."""
        raise NotImplementedError


@dataclass_transform(frozen_default=True, field_specifiers=(parameter, ranged_parameter, static))
def modes[T: Modes](cls: type[T]) -> type[T]:
    """Makes a class a kind of modes: a frozen dataclass and a pytree, its numbers known to `replace` and to designs."""
    remedy = "derive it from Modes and define its evolution"
    return register_part(cls, Modes, "measure", remedy, "material.viscous", needed=("modulus", "time"))


@modes
class Christensen(Modes):
    """S = integral of g1(t - s) dE/ds ds, E = (C - 1) / 2, g1 a sum of exponentials (the paper's reference 13).

    Attributes:
        modulus: Modulus of each term (n_mode,) [Pa]; half their sum is part of the instantaneous shear modulus.
        time: Relaxation times (n_mode,) [s].
    """

    kind: ClassVar[str] = "christensen"
    modulus: jax.Array = ranged_parameter(RANGES["material.viscous.modulus"], listed=True)
    time: jax.Array = ranged_parameter(RANGES["material.viscous.time"], listed=True)

    @staticmethod
    def measure(strained: StrainState) -> Rows:
        """The strain E, with its components raised by the initial metric."""
        plane = [0.5 * (new - old) for new, old in zip(strained.mixed_components, strained.inverse, strict=True)]
        return [*plane, 0.5 * (1.0 / strained.determinant - 1.0)]

    def recursion(self, step: jax.Array) -> Recursion:
        """The stress relaxes, and follows the strain."""
        left, lag = _relaxation_factors(step, self.time)
        gain = _as_column(self.modulus, lag) * (1.0 - lag)
        return left, gain, gain

    def initial_stress(self, inverse: jax.Array) -> jax.Array:
        """None."""
        return jnp.zeros((4 * len(self.modulus), inverse.shape[1]), inverse.dtype)

    def energy(self, stress: list[Rows], strained: StrainState) -> jax.Array:
        """Half the square of the stress over the modulus."""
        terms = (0.5 / modulus * _square(x, strained) for modulus, x in zip(self.modulus, stress, strict=True))
        return sum(terms, jnp.zeros_like(strained.determinant))

    def loss(self, stress: list[Rows], strained: StrainState) -> jax.Array:
        """The square of the stress over the viscosity."""
        rates = 1.0 / (self.modulus * self.time)
        terms = (rate * _square(x, strained) for rate, x in zip(rates, stress, strict=True))
        return sum(terms, jnp.zeros_like(strained.determinant))

    def stiffening(self, larger: jax.Array, smaller: jax.Array) -> jax.Array:
        """Grows with the square of the stretch."""
        area = jnp.square(larger * smaller)
        across = (1.0 / jnp.square(larger) + 1.0 / jnp.square(smaller)) / jnp.square(area)
        return jnp.sum(self.modulus, axis=0) * (jnp.square(larger) + across)

    def stiffness(self) -> jax.Array:
        """A quarter of the moduli."""
        return 0.25 * jnp.sum(self.modulus, axis=0)


@modes
class Maxwell(Modes):
    """S = sum of g A, dA/dt = (C^-1 - A) / time, initially A = 1: upper-convected Maxwell modes, for melts.

    The same is known as Lodge's rubber-like liquid and as K-BKZ without damping.

    Attributes:
        modulus: Modulus of each term (n_mode,) [Pa]; their sum is part of the instantaneous shear modulus.
        time: Relaxation times (n_mode,) [s].
    """

    kind: ClassVar[str] = "maxwell"
    modulus: jax.Array = ranged_parameter(RANGES["material.viscous.modulus"], listed=True)
    time: jax.Array = ranged_parameter(RANGES["material.viscous.time"], listed=True)

    @staticmethod
    def measure(strained: StrainState) -> Rows:
        """The inverse of C."""
        return [*strained.present_inverse, strained.determinant]

    def recursion(self, step: jax.Array) -> Recursion:
        """The stress goes towards that of a sheet that was always strained as it is."""
        left, lag = _relaxation_factors(step, self.time)
        modulus = _as_column(self.modulus, lag)
        return left, modulus * lag, modulus * (left - 1.0 + lag)

    def initial_stress(self, inverse: jax.Array) -> jax.Array:
        """The initial stress of the modes: that of unstrained rubber."""
        rows = jnp.concatenate([inverse, jnp.ones_like(inverse[:1])])
        modulus = self.modulus[:, None, :] if self.modulus.ndim == 2 else self.modulus[:, None, None]
        return (modulus * rows[None]).reshape(-1, inverse.shape[1])

    def energy(self, stress: list[Rows], strained: StrainState) -> jax.Array:
        """Stored energy of dumbbells: g / 2 (tr c - ln det c - 3) of the conformation c."""
        total = jnp.zeros_like(strained.determinant)
        for modulus, x in zip(self.modulus, stress, strict=True):
            trace, determinant, across = _conformation(modulus, x, strained)
            total += 0.5 * modulus * (trace + across - 3.0 - jnp.log(determinant * across))
        return total

    def loss(self, stress: list[Rows], strained: StrainState) -> jax.Array:
        """G / (2 time) (tr c + tr c^-1 - 6), from squares of c - 1: near equilibrium a difference would be rounding."""
        total = jnp.zeros_like(strained.determinant)
        g11, g12, g22 = strained.metric
        for modulus, time, x in zip(self.modulus, self.time, stress, strict=True):
            one = 1.0 / modulus
            a, b = one * (x[0] * g11 + x[1] * g12) - 1.0, one * (x[0] * g12 + x[1] * g22)
            c, d = one * (x[1] * g11 + x[2] * g12), one * (x[1] * g12 + x[2] * g22) - 1.0
            across = one * x[3] / strained.determinant - 1.0
            trace, determinant = a + d, a * d - b * c
            plane = a * a + d * d + 2.0 * b * c + trace * determinant
            plane, beside = plane / (1.0 + trace + determinant), across * across / (1.0 + across)
            total += 0.5 * modulus / time * (plane + beside)
        return total

    def stiffening(self, larger: jax.Array, smaller: jax.Array) -> jax.Array:
        """None: at once only the pressure answers."""
        return jnp.zeros_like(larger)

    def stiffness(self) -> jax.Array:
        """Half the moduli."""
        return 0.5 * jnp.sum(self.modulus, axis=0)


MODES: dict[str, type[Modes]] = {"christensen": Christensen, "maxwell": Maxwell}
"""Those that a scene file names."""


def _relaxation_factors(step: jax.Array, time: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Exp(-k), k the step over the times, and 1 - (1 - exp(-k)) / k: how far a mode lags behind."""
    k = step / _as_column(time, step)
    short = jnp.minimum(k, _SHORT)
    series = short * (1 / 2 - short * (1 / 6 - short * (1 / 24 - short * (1 / 120 - short / 720))))
    long = jnp.maximum(k, _SHORT)
    return jnp.exp(-k), jnp.where(k < _SHORT, series, 1.0 + jnp.expm1(-long) / long)


def _as_column(numbers: jax.Array, like: jax.Array) -> jax.Array:
    """Numbers (n_mode,), as (n_mode, 1) where the others are (n_mode, n)."""
    return numbers[:, None] if like.ndim > numbers.ndim > 0 else numbers


def _square(x: Rows, strained: StrainState) -> jax.Array:
    """The square (n,) [Pa^2] of a stress."""
    # In the plane that of the trace less twice the determinant.
    g = strained.initial
    trace = x[0] * g[0] + 2.0 * x[1] * g[1] + x[2] * g[2]
    determinant = (x[0] * x[2] - x[1] * x[1]) * (g[0] * g[2] - g[1] * g[1])
    return trace * trace - 2.0 * determinant + x[3] * x[3]


def _conformation(modulus: jax.Array, x: Rows, strained: StrainState) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Trace and determinant in the plane, and the eigenvalue across, of the conformation of a mode (n,)."""
    g, one = strained.metric, 1.0 / modulus
    trace = one * (x[0] * g[0] + 2.0 * x[1] * g[1] + x[2] * g[2])
    determinant = one * one * (x[0] * x[2] - x[1] * x[1]) * (g[0] * g[2] - g[1] * g[1])
    return trace, determinant, one * x[3] / strained.determinant

"""Parameters of a material model and of its Prony terms as a vector within bounds, for any registered model."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxform import Law
from jaxform.extend import LAWS, LEAST, MODES, MOST, Modes, Range, as_real, list_parameter_names, parameter_ranges

Array = np.ndarray

VISCOUS = "viscous."
"""Prefix of the names of the Prony terms' parameters."""
DENSITY = 1000.0
"""Density [kg/m^3] of a material while it is fitted: in a slow process it has no effect."""
_SMALLEST = 1e-9  # of the largest stress, a modulus that must be positive
_BEYOND = 10.0  # times the longest time of the data, or a part of the shortest, a relaxation time is
_LONGEST = 1e3  # a number that must be positive and is no modulus lies between this and its inverse, in the starts


@dataclass(frozen=True)
class Number:
    """One parameter of the vector.

    Attributes:
        name: Name in the table of the material; of Prony terms it starts with `viscous.`.
        place: Index in a list; None where it is no list.
        allowed: Its range.
        unit: Value of the parameter where the vector has 1, or 0 for a logarithm.
        logarithmic: True if the vector has its logarithm.
        lower, upper: Bounds in the vector.
        first: Bounds of a start in the vector.
    """

    name: str
    place: int | None
    allowed: Range
    unit: float
    logarithmic: bool
    lower: float
    upper: float
    first: tuple[float, float]

    @property
    def modulus(self) -> bool:
        """True for a modulus: stresses are proportional to all moduli together."""
        return self.allowed.unit == "Pa"

    @property
    def words(self) -> str:
        """Name with an index, such as mu[1], counted from 1."""
        return self.name if self.place is None else f"{self.name}[{self.place + 1}]"

    def value(self, free: float) -> float:
        """The value of the parameter."""
        return self.unit * float(np.exp(free) if self.logarithmic else free)


@dataclass(frozen=True)
class Numbers:
    """All fitted parameters.

    Attributes:
        law: Class of the material model.
        modes: Class of its Prony terms, or None.
        all: The parameters, in the order of the vector.
    """

    law: type[Law]
    modes: type[Modes] | None
    all: tuple[Number, ...]

    @property
    def lower(self) -> Array:
        """Lower bounds (n,)."""
        return np.array([number.lower for number in self.all])

    @property
    def upper(self) -> Array:
        """Upper bounds (n,)."""
        return np.array([number.upper for number in self.all])

    @property
    def moduli(self) -> Array:
        """Mask of the moduli (n,)."""
        return np.array([number.modulus for number in self.all])

    def values(self, free: Array) -> Array:
        """The parameters (n,) of a vector."""
        return np.array([number.value(x) for number, x in zip(self.all, free, strict=True)])

    def make(self, free: jax.Array) -> Law:
        """The material model of a vector (n,)."""
        units = as_real([number.unit for number in self.all])
        logarithmic = np.array([number.logarithmic for number in self.all])
        values = units * jnp.where(logarithmic, jnp.exp(jnp.where(logarithmic, free, 0.0)), free)
        of_law, of_modes = (
            {name: jnp.stack(value) if isinstance(value, list) else value for name, value in part.items()}
            for part in self.group(values)
        )
        law = self.law(**of_law, density=as_real(DENSITY))  # pyright: ignore[reportCallIssue]
        return law if self.modes is None else dataclasses.replace(law, viscous=self.modes(**of_modes))

    def group(self, values: Iterable[Any]) -> tuple[dict[str, Any], dict[str, Any]]:
        """The values (n,) of the material model and of its Prony terms, by name; those of a list as a list."""
        of_law: dict[str, Any] = {}
        of_modes: dict[str, Any] = {}
        for number, value in zip(self.all, values, strict=True):
            part, name = (of_modes if number.name.startswith(VISCOUS) else of_law), number.name.removeprefix(VISCOUS)
            if number.place is None:
                part[name] = value
            else:
                part.setdefault(name, []).append(value)
        return of_law, of_modes

    def order(self, free: Array) -> Array:
        """The vector with the model's terms in order, the largest first, and its Prony terms, the shortest first."""
        lists = {name: self._places(name) for name in dict.fromkeys(number.name for number in self.all)}
        terms = [places for name, places in lists.items() if len(places) > 1 and not name.startswith(VISCOUS)]
        modes = [places for name, places in lists.items() if name.startswith(VISCOUS)]
        made = free.copy()
        if terms:
            order = np.argsort(-np.abs(free[terms[0]]))
            made[np.array(terms)] = free[np.array(terms)[:, order]]
        if modes:
            order = np.argsort(free[lists[f"{VISCOUS}time"]])
            made[np.array(modes)] = free[np.array(modes)[:, order]]
        return made

    def _places(self, name: str) -> Array:
        """Indices in the vector of the parameters of one name."""
        return np.flatnonzero([number.name == name for number in self.all])

    def starts(self, count: int) -> Array:
        """Starting vectors (m, n), always the same ones; one alone where all numbers are moduli."""
        low, high = np.array([number.first for number in self.all]).T
        if np.all(self.moduli):
            return 0.5 * (low + high)[None]
        made = np.random.default_rng(0).uniform(low, high, (count, len(low)))
        made[0] = 0.5 * (low + high)
        return made


def make_numbers(
    model: str, terms: int, kind: str, modes: int, stress: float, times: tuple[float, float] | None
) -> Numbers:
    """The parameters of a material model and its Prony terms.

    Args:
        model: Name of the material model in `LAWS`.
        terms: Number of terms, where it has lists.
        kind: Kind of the terms in `MODES`.
        modes: Number of Prony terms; 0 for none.
        stress: The largest stress of the data [Pa].
        times: The shortest and the longest time of the data [s]; None where there are no modes.
    """
    law, listed = LAWS[model], list_parameter_names(LAWS[model])
    found = []
    for name, allowed in parameter_ranges(law).items():
        if name != "density":
            places = range(terms) if name in listed else (None,)
            found += [_number(name, place, allowed, stress) for place in places]
    if modes and times is not None:
        for name, allowed in parameter_ranges(MODES[kind]).items():
            found += [_of_mode(name, place, modes, allowed, stress, times) for place in range(modes)]
    return Numbers(law, MODES[kind] if modes else None, tuple(found))


def _number(name: str, place: int | None, allowed: Range, stress: float) -> Number:
    low = max((bound for bound in (allowed.above, allowed.least) if bound is not None), default=-np.inf)
    high, positive = np.inf if allowed.most is None else allowed.most, allowed.above == 0.0
    if allowed.unit == "Pa":
        lower = max(low / stress, _SMALLEST) if positive else low / stress
        return Number(name, place, allowed, stress, False, lower, high / stress, (1.0, 1.0))
    if positive:
        first = -np.log(_LONGEST), np.log(_LONGEST)
        return Number(name, place, allowed, 1.0, True, np.log(max(low, LEAST)), np.log(min(high, MOST)), first)
    return Number(name, place, allowed, 1.0, False, low, high, _initial_range(low, high))


def _initial_range(lower: float, upper: float) -> tuple[float, float]:
    """Initial search interval of a dimensionless parameter: the middle half of its bounds, or near the only one."""
    if np.isfinite(lower) and np.isfinite(upper):
        return lower + 0.25 * (upper - lower), upper - 0.25 * (upper - lower)
    if np.isfinite(lower):
        return lower, lower + 2.0
    return (upper - 2.0, upper) if np.isfinite(upper) else (-2.0, 2.0)


def _of_mode(name: str, place: int, count: int, allowed: Range, stress: float, times: tuple[float, float]) -> Number:
    if allowed.unit == "Pa":
        return Number(VISCOUS + name, place, allowed, stress, False, _SMALLEST, np.inf, (1.0, 1.0))
    # Each term has its part of the times, which are divided by equal factors.
    low, high = np.log(times)
    part = (high - low) / count
    begin = low + place * part
    # Much shorter ones have relaxed before the first row, much longer ones never do.
    lower, upper = low - np.log(_BEYOND), high + np.log(_BEYOND)
    return Number(VISCOUS + name, place, allowed, 1.0, True, lower, upper, (begin, begin + part))

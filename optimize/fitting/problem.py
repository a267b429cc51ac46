"""Weighted differences between a model's values for the tests and the measured ones, with their derivatives."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxform import Law
from optimize.fitting import bubble, states
from optimize.fitting.numbers import Numbers
from optimize.fitting.tables import LEAST_SHARE, Bubble, Pull, Table

Array = np.ndarray

WEIGHTS = ("relative", "absolute")
_LOW = 0.1  # the same share for bubbles: when they are low, the pressure goes with the cube of a height that is small
_UNKNOWN = 1e3  # a difference where there is no equilibrium


class Problem:
    """Tests, and the parameters to be fitted to them.

    Args:
        tables: The tests.
        numbers: The parameters.
        weights: "relative": each difference over what was measured there; "absolute": over the largest of the table.

    Attributes:
        tables: The tests.
        numbers: The parameters.
        slices: Slices of the vector of differences, one for each measured column of each table.
        used: Mask of the differences that count (m,): not those of unstrained rows.
    """

    def __init__(self, tables: Sequence[Table], numbers: Numbers, weights: str = "relative") -> None:
        """See the class."""
        self.tables, self.numbers = tuple(tables), numbers
        self.slices: list[tuple[Table, str, slice]] = []
        measured, scale, used = [], [], []
        for table in self.tables:
            for name, values in table.measured_columns.items():
                begin = sum(map(len, measured))
                self.slices.append((table, name, slice(begin, begin + len(values))))
                measured.append(values)
                share = 1.0 if weights == "absolute" else _LOW if isinstance(table, Bubble) else LEAST_SHARE
                scale.append(np.maximum(np.abs(values), share * np.abs(values).max()))
                used.append(_says_something(table))
        self.measured, self._scale = np.concatenate(measured), np.concatenate(scale)
        self.used = np.concatenate(used)
        kinds, data = tuple(map(_kind, self.tables)), [_data(table) for table in self.tables]
        self._both = functools.partial(_slopes_and_values, numbers, kinds, data=data)
        self._last: tuple[Array, Array, Array] | None = None

    def values(self, free: Array) -> Array:
        """Values of the material model (m,), in the units of the measured ones."""
        return self._slopes_and_values_at(free)[1]

    def _slopes_and_values_at(self, free: Array) -> tuple[Array, Array]:
        """Slopes (m, n) and values (m,)."""
        if self._last is None or not np.array_equal(self._last[0], free):
            slopes, values = self._both(jnp.asarray(free))
            self._last = free.copy(), np.asarray(slopes), np.asarray(values)
        return self._last[1:]

    def differences(self, free: Array) -> Array:
        """Weighted (m,); those of rows that do not count are 0."""
        found = (self.values(free) - self.measured) / self._scale
        return np.where(self.used, np.where(np.isfinite(found), found, _UNKNOWN), 0.0)

    def slopes(self, free: Array) -> Array:
        """Derivatives of the differences (m, n)."""
        found = self._slopes_and_values_at(free)[0] / self._scale[:, None]
        return np.where(self.used[:, None] & np.isfinite(found), found, 0.0)


def _says_something(table: Table) -> Array:
    """Mask of the rows (n,) that are strained."""
    if isinstance(table, Bubble):
        return np.ones(len(table.height), bool)
    return np.abs(table.stretch - 1.0) > 1e-9


def _data(table: Table) -> tuple[Any, ...]:
    if isinstance(table, Pull):
        return table.stretch, None if table.time is None else states.history(table.stretch, table.time)
    return (bubble.plan(table.height / table.radius, table.time),)


_BubbleKind = tuple[float, float, float, bool]
"""Properties of a bubble that a program is compiled for: thickness and radius of the sheet [m], largest pressure [Pa],
and whether walls are measured."""


def _kind(table: Table) -> str | _BubbleKind:
    """The state of a pull, or the properties of a bubble: with its data, all that the model's values depend on."""
    if isinstance(table, Pull):
        return table.state
    return table.sheet, table.radius, float(table.pressure.max()), table.thickness is not None


def _model_values(law: Law, kind: str | _BubbleKind, data: tuple[Any, ...]) -> jax.Array:
    """The material model's values for the measured columns of a table, one after the other."""
    if isinstance(kind, str):
        stretch, pulled = data
        return states.nominal_stress(law, kind, jnp.asarray(stretch), pulled)
    sheet, radius, largest, walled = kind
    over = sheet / radius
    (plan,) = data
    pressure, wall = bubble.inflate_bubble(law, plan, largest / over, law.viscous is not None)
    return jnp.concatenate([over * pressure, sheet * wall] if walled else [over * pressure])


@functools.partial(jax.jit, static_argnums=(0, 1))
def _slopes_and_values(
    numbers: Numbers, kinds: tuple[str | _BubbleKind, ...], free: jax.Array, data: list[tuple[Any, ...]]
) -> tuple[jax.Array, jax.Array]:
    """Both in one: to compile another program takes longer than all its calls. The same tests compile nothing again."""

    def model_values(free: jax.Array) -> tuple[jax.Array, jax.Array]:
        law = numbers.make(free)
        found = jnp.concatenate([_model_values(law, kind, columns) for kind, columns in zip(kinds, data, strict=True)])
        return found, found

    return jax.jacfwd(model_values, has_aux=True)(free)


def without_bubbles(tables: Sequence[Table]) -> list[Table]:
    """The tables with rough equibiaxial tests in place of bubbles: a bubble's pole, as if it were part of a sphere.

    The wall there is taken to be that of Hill's solution for metal where it was not measured (R. Hill, Phil. Mag. 41,
    1950); that is accurate to a few per cent up to a height of a radius.
    """
    return [_convert_to_pull(table) if isinstance(table, Bubble) else table for table in tables]


def _convert_to_pull(table: Bubble) -> Pull:
    curvature_radius = (table.radius**2 + table.height**2) / (2.0 * table.height)
    wall = table.thickness
    if wall is None:
        wall = table.sheet / np.square(1.0 + np.square(table.height / table.radius))
    stretch = np.maximum(np.sqrt(table.sheet / wall), 1.0 + 1e-3)
    stress = 0.5 * table.pressure * curvature_radius * stretch / table.sheet
    return Pull(table.name, "equibiaxial", "equibiaxial", stretch, stress, table.time)


def only_slow(tables: Sequence[Table]) -> list[Table]:
    """The tables without times, for a material model without Prony terms."""
    return [dataclasses.replace(table, time=None) for table in tables]

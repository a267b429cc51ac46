"""Stress of a sample in a test: its states, its path from row to row, and the stress along it."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from jaxform import Law
from jaxform.extend import (
    Overstress,
    advance_memory,
    initial_overstress,
    principal_nominal_stress,
    principal_overstress,
)

STATES = ("uniaxial", "equibiaxial", "pure-shear")
"""States of a pulled sheet: across the pull it is free, pulled as much, or held."""


_SMALL, _MOST_PARTS = 0.02, 500  # change of the stretch in a step, and how many steps a row may take


def crosswise(state: str, stretch: jax.Array) -> jax.Array:
    """The second stretch in the plane of the sheet in a state of `STATES`, of the shape of the first."""
    if state == "equibiaxial":
        return stretch
    return jnp.ones_like(stretch) if state == "pure-shear" else 1.0 / jnp.sqrt(stretch)


Path = tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.int64]]
"""The way of a test from row to row, in steps.

The stretch or height reached (n_step,), the time since the step before (n_step,) [s], and the indices of the steps that
are rows of the table (n,).
"""


def split_path(values: NDArray[np.float64], times: NDArray[np.float64], first: float, longest: float) -> Path:
    """The way to the values (n,) of rows at times (n,) [s], from `first` at 0, linear between; no step is longer."""
    begin, since = np.concatenate([[first], values[:-1]]), np.concatenate([[0.0], times[:-1]])
    found, steps, rows = [], [], []
    for low, high, early, late in zip(begin, values, since, times, strict=True):
        count = min(max(1, int(np.ceil(abs(high - low) / longest))), _MOST_PARTS)
        found += list(low + (high - low) * np.arange(1, count + 1) / count)
        steps += [(late - early) / count] * count
        rows.append(len(found) - 1)
    return np.array(found), np.array(steps), np.array(rows)


def history(stretch: NDArray[np.float64], time: NDArray[np.float64]) -> Path:
    """Stretch history of rows (n,): the first stretch is applied at time 0, and between rows it is linear in time [s].

    Its steps are so small that the recursions of the Prony terms are accurate to a few parts in ten thousand.
    """
    values, steps, rows = split_path(stretch, time, float(stretch[0]), _SMALL)
    return np.append(stretch[:1], values), np.append(0.0, steps), rows + 1


def nominal_stress(law: Law, state: str, stretch: jax.Array, pulled: Path | None = None) -> jax.Array:
    """Nominal stress (n,) [Pa] along the pull.

    Args:
        law: The material model; its Prony terms count where there is a history.
        state: One of `STATES`.
        stretch: Stretch along the pull (n,).
        pulled: History of these; None for a slow test.
    """
    modes = law.viscous
    if modes is None or pulled is None:
        return principal_nominal_stress(law, stretch, crosswise(state, stretch))[0]
    values, lengths, rows = pulled
    whole, steps = jnp.asarray(values), jnp.asarray(lengths)
    one, two = whole[:, None], crosswise(state, whole)[:, None]

    def row(past: Overstress, now: tuple[jax.Array, jax.Array, jax.Array]) -> tuple[Overstress, jax.Array]:
        one, two, step = now
        memory = advance_memory(modes, past, step)
        return principal_overstress(memory, one, two), principal_nominal_stress(law, one, two, memory)[0][0]

    return jax.lax.scan(row, initial_overstress(modes, 1), (one, two, steps))[1][jnp.asarray(rows)]

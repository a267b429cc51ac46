"""Stresses of a sheet that is strained alike everywhere, by the very functions that the simulator's elements use."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from jaxform import Law
from jaxform.materials import Modes
from jaxform.mechanics import constitutive
from jaxform.mechanics.constitutive import Overstress, Response, ViscousMemory

STATES = ("uniaxial", "equibiaxial", "pure-shear")
"""States of a pulled sheet: across the pull it is free, pulled as much, or held."""


_SMALL, _MOST_PARTS = 0.02, 500  # change of the stretch in a step, and how many steps a row may take


def crosswise(state: str, stretch: jax.Array) -> jax.Array:
    """The second stretch in the plane of the sheet in a state of `STATES`, of the shape of the first."""
    if state == "equibiaxial":
        return stretch
    return jnp.ones_like(stretch) if state == "pure-shear" else 1.0 / jnp.sqrt(stretch)


def nominal(
    law: Law, one: jax.Array, two: jax.Array, memory: ViscousMemory | None = None
) -> tuple[jax.Array, jax.Array]:
    """Nominal stresses [Pa] along two principal stretches (n,) in the plane, free across it.

    Args:
        law: The material model; of its Maxwell branches only what `memory` has counts.
        one: The first stretch.
        two: The second stretch.
        memory: Memory of the branches; None for the long-term stress.
    """
    none, unit = jnp.zeros_like(one), jnp.ones_like(one)
    metric = one * one, none, two * two
    inverse = jnp.stack([unit, none, unit])
    stress = constitutive.weighted_stress(metric, inverse, unit, Response(law.elastic, memory))
    return one * stress[0], two * stress[2]


def at_first(modes: Modes, count: int) -> Overstress:
    """The overstress of Maxwell branches at places (count,) that were never strained."""
    unit = jnp.ones((count,), modes.time.dtype)
    none = jnp.zeros_like(unit)
    inverse = jnp.stack([unit, none, unit])
    return constitutive.overstress(
        (unit, none, unit), inverse, constitutive.present_memory(modes.initial_stress(inverse), modes)
    )


def memory_after(modes: Modes, past: Overstress, step: jax.Array) -> ViscousMemory:
    """The memory of Maxwell branches after a step [s] with the strain linear in time; a step of 0 is a jump."""
    recursion = modes.recursion(step)
    return ViscousMemory(jnp.stack(past.updated_history(recursion)), recursion.gain, modes.kind)


def overstress(memory: ViscousMemory, one: jax.Array, two: jax.Array) -> Overstress:
    """The overstress of Maxwell branches with such a memory at places that now have these stretches (n,)."""
    none, unit = jnp.zeros_like(one), jnp.ones_like(one)
    return constitutive.overstress((one * one, none, two * two), jnp.stack([unit, none, unit]), memory)


class Path(NamedTuple):
    """Path of a test from row to row, in steps.

    Attributes:
        value: Stretch or height reached (n_step,).
        step: Time since the one before (n_step,) [s].
        row: Indices of the steps that are rows of the table (n,).
    """

    value: NDArray[np.float64]
    step: NDArray[np.float64]
    row: NDArray[np.int64]


def split_path(values: NDArray[np.float64], times: NDArray[np.float64], first: float, longest: float) -> Path:
    """The way to the values (n,) of rows at times (n,) [s], from `first` at 0, linear between; no step is longer."""
    begin, since = np.concatenate([[first], values[:-1]]), np.concatenate([[0.0], times[:-1]])
    found, steps, rows = [], [], []
    for low, high, early, late in zip(begin, values, since, times, strict=True):
        count = min(max(1, int(np.ceil(abs(high - low) / longest))), _MOST_PARTS)
        found += list(low + (high - low) * np.arange(1, count + 1) / count)
        steps += [(late - early) / count] * count
        rows.append(len(found) - 1)
    return Path(np.array(found), np.array(steps), np.array(rows))


def history(stretch: NDArray[np.float64], time: NDArray[np.float64]) -> Path:
    """Stretch history of rows (n,): the first stretch is applied at time 0, and between rows it is linear in time [s].

    Its steps are so small that the recursions of the Maxwell branches are accurate to a few parts in ten thousand.
    """
    after = split_path(stretch, time, float(stretch[0]), _SMALL)
    return Path(np.append(stretch[:1], after.value), np.append(0.0, after.step), after.row + 1)


def nominal_stress(law: Law, state: str, stretch: jax.Array, pulled: Path | None = None) -> jax.Array:
    """Nominal stress (n,) [Pa] along the pull.

    Args:
        law: The material model; its Maxwell branches count where there is a history.
        state: One of `STATES`.
        stretch: Stretch along the pull (n,).
        pulled: History of these; None for a slow test.
    """
    modes = law.viscous
    if modes is None or pulled is None:
        return nominal(law, stretch, crosswise(state, stretch))[0]
    whole, steps = jnp.asarray(pulled.value), jnp.asarray(pulled.step)
    one, two = whole[:, None], crosswise(state, whole)[:, None]

    def row(past: Overstress, now: tuple[jax.Array, jax.Array, jax.Array]) -> tuple[Overstress, jax.Array]:
        one, two, step = now
        memory = memory_after(modes, past, step)
        return overstress(memory, one, two), nominal(law, one, two, memory)[0][0]

    return jax.lax.scan(row, at_first(modes, 1), (one, two, steps))[1][jnp.asarray(pulled.row)]

"""Stresses of a sheet that is strained alike everywhere, by the very functions that the simulator's elements use."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from jaxform import Law
from jaxform.materials import Modes
from jaxform.mechanics import response
from jaxform.mechanics.response import Memory, Overstress, Response

STATES = ("uniaxial", "equibiaxial", "pure-shear")
"""How a sheet is pulled; across the pull it is free, pulled as much, or held."""


def crosswise(state: str, stretch: jax.Array) -> jax.Array:
    """The second stretch in the plane of the sheet in a state of `STATES`, of the shape of the first."""
    if state == "equibiaxial":
        return stretch
    return jnp.ones_like(stretch) if state == "pure-shear" else 1.0 / jnp.sqrt(stretch)


def nominal(law: Law, one: jax.Array, two: jax.Array, memory: Memory | None = None) -> tuple[jax.Array, jax.Array]:
    """Nominal stresses [Pa] along two principal stretches (n,) in the plane, free across it.

    Args:
        law: The law; of its viscous modes only what `memory` has counts.
        one: The first stretch.
        two: The second stretch.
        memory: What the modes remember; None for what is left in the end.
    """
    none, unit = jnp.zeros_like(one), jnp.ones_like(one)
    metric = one * one, none, two * two
    inverse = jnp.stack([unit, none, unit])
    stress = response.stress_of(metric, inverse, unit, Response(law.elastic, memory))
    return one * stress[0], two * stress[2]


def at_first(modes: Modes, count: int) -> Overstress:
    """The overstress of viscous modes at places (count,) that were never strained."""
    unit = jnp.ones((count,), modes.time.dtype)
    none = jnp.zeros_like(unit)
    inverse = jnp.stack([unit, none, unit])
    return response.overstress((unit, none, unit), inverse, response.present(modes.at_first(inverse), modes))


def memory_after(modes: Modes, past: Overstress, step: jax.Array) -> Memory:
    """The memory of modes after a step [s] over which the strain is linear in time; a step of 0 is a jump."""
    recursion = modes.recursion(step)
    return Memory(jnp.stack(past.kept(recursion)), recursion.gain, modes.kind)


def overstress(memory: Memory, one: jax.Array, two: jax.Array) -> Overstress:
    """The overstress of modes with such a memory at places that now have these stretches (n,)."""
    none, unit = jnp.zeros_like(one), jnp.ones_like(one)
    return response.overstress((one * one, none, two * two), jnp.stack([unit, none, unit]), memory)


def along(law: Law, state: str, stretch: jax.Array, time: jax.Array | None = None) -> jax.Array:
    """Nominal stress (n,) [Pa] along the pull.

    Args:
        law: The law; its viscous modes count where there are times.
        state: One of `STATES`.
        stretch: Along the pull (n,).
        time: Of each row (n,) [s], from 0, when nothing was strained: what the first row is strained came at 0 at
            once, and between rows the strain is linear in time. None for a slow test.
    """
    two = crosswise(state, stretch)
    modes = law.viscous
    if modes is None or time is None:
        return nominal(law, stretch, two)[0]
    # The jump at time 0, then the rows.
    one = jnp.concatenate([stretch[:1], stretch])[:, None]
    two = jnp.concatenate([two[:1], two])[:, None]
    steps = jnp.diff(jnp.concatenate([jnp.zeros(2), time]))

    def row(past: Overstress, now: tuple[jax.Array, jax.Array, jax.Array]) -> tuple[Overstress, jax.Array]:
        one, two, step = now
        memory = memory_after(modes, past, step)
        return overstress(memory, one, two), nominal(law, one, two, memory)[0][0]

    return jax.lax.scan(row, at_first(modes, 1), (one, two, steps))[1][1:]

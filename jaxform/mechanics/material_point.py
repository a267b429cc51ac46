"""Stress of a sheet that is strained alike everywhere, by the functions that the simulator's elements use."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from jaxform.materials import Law, Modes
from jaxform.mechanics import constitutive
from jaxform.mechanics.constitutive import Overstress, Response, ViscousMemory


def principal_nominal_stress(
    law: Law, one: jax.Array, two: jax.Array, memory: ViscousMemory | None = None
) -> tuple[jax.Array, jax.Array]:
    """Nominal stresses [Pa] along two principal stretches (n,) in the plane of the sheet, which is free across it.

    Args:
        law: The material model; of its Prony terms only what `memory` has counts.
        one: The first stretch.
        two: The second stretch.
        memory: Memory of the terms; None for the long-term stress.
    """
    none, unit = jnp.zeros_like(one), jnp.ones_like(one)
    metric = one * one, none, two * two
    inverse = jnp.stack([unit, none, unit])
    stress = constitutive.weighted_stress(metric, inverse, unit, Response(law.elastic, memory))
    return one * stress[0], two * stress[2]


def initial_overstress(modes: Modes, count: int) -> Overstress:
    """The overstress of Prony terms at points (count,) that were never strained."""
    unit = jnp.ones((count,), modes.time.dtype)
    none = jnp.zeros_like(unit)
    inverse = jnp.stack([unit, none, unit])
    memory = constitutive.present_memory(modes.initial_stress(inverse), modes)
    return constitutive.overstress((unit, none, unit), inverse, memory)


def advance_memory(modes: Modes, past: Overstress, step: jax.Array) -> ViscousMemory:
    """The memory of Prony terms after a step [s] with the strain linear in time; a step of 0 is a jump."""
    recursion = modes.recursion(step)
    return ViscousMemory(jnp.stack(past.updated_history(recursion)), recursion[1], modes.kind)


def principal_overstress(memory: ViscousMemory, one: jax.Array, two: jax.Array) -> Overstress:
    """The overstress of Prony terms with such a memory at points that now have these stretches (n,)."""
    none, unit = jnp.zeros_like(one), jnp.ones_like(one)
    return constitutive.overstress((one * one, none, two * two), jnp.stack([unit, none, unit]), memory)

"""What the parts of a bisected element inherit from it: the stress of its viscous modes, in their own edges' basis."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from jaxform.model.tables import Forest
from jaxform.sheet.discretization import Mesh


def inherited(memory: jax.Array, before: Mesh, after: Mesh, forest: Forest) -> jax.Array:
    """The stress of modes (4 n_mode, n_element) of a mesh's elements, from those of the mesh `before`; differentiable.

    A triangle (peak, a, b) has the parts (middle, peak, a) and (middle, b, peak): their edges are halves of the sum and
    the difference of its own, and so a stress has in their basis sums and differences of its components.
    """
    old = jnp.arange(before.element.size) < before.element_count
    slot = jnp.full(forest.bound.size, -1, jnp.int32)
    slot = slot.at[jnp.where(old, before.element, forest.bound.size)].set(
        jnp.arange(before.element.size, dtype=jnp.int32), mode="drop"
    )
    rows = memory.reshape(-1, 4, memory.shape[1])
    chain, triangle = [], after.element
    for _ in range(forest.depth):
        found = slot[triangle] >= 0
        part = jnp.where(found, -1, (triangle - forest.root_count) % 2)
        chain.append(part)
        triangle = jnp.where(found, triangle, jnp.maximum((triangle - forest.root_count) // 2, 0))
    a, mixed, b, across = jnp.moveaxis(rows[:, :, jnp.maximum(slot[triangle], 0)], 1, 0)
    for part in reversed(chain):
        sum_, difference = a + 2.0 * mixed + b, a - 2.0 * mixed + b
        one, two = part == 0, part == 1
        a, mixed, b = (
            jnp.where(one, sum_, jnp.where(two, difference, a)),
            jnp.where(one, b - a, jnp.where(two, a - b, mixed)),
            jnp.where(one, difference, jnp.where(two, sum_, b)),
        )
    return jnp.stack([a, mixed, b, across], axis=1).reshape(memory.shape[0], -1)

"""Inheritance of stress and other element quantities by the parts of a bisected element, and its basis."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp

from jaxform.model.tables import BisectionHierarchy
from jaxform.sheet.discretization import RefinedMesh


class Ancestry(NamedTuple):
    """The ancestors of a mesh's elements in an earlier mesh.

    Attributes:
        element: The element of the earlier mesh that each lies in (n_element,).
        parts: From that down to the element, in reverse: which part each bisection made it (n_element,), 0 or 1; -1
            where there was none.
    """

    element: jax.Array
    parts: list[jax.Array]


def find_ancestry(before: RefinedMesh, after: RefinedMesh, forest: BisectionHierarchy) -> Ancestry:
    """The ancestors of a mesh's elements in the mesh `before`."""
    old = jnp.arange(before.element.size) < before.element_count
    slot = jnp.full(forest.bound.size, -1, jnp.int32)
    slot = slot.at[jnp.where(old, before.element, forest.bound.size)].set(
        jnp.arange(before.element.size, dtype=jnp.int32), mode="drop"
    )
    parts, triangle = [], after.element
    for _ in range(forest.depth):
        found = slot[triangle] >= 0
        parts.append(jnp.where(found, -1, (triangle - forest.root_count) % 2))
        triangle = jnp.where(found, triangle, jnp.maximum((triangle - forest.root_count) // 2, 0))
    return Ancestry(jnp.maximum(slot[triangle], 0), parts)


def inherit_stress(memory: jax.Array, ancestors: Ancestry) -> jax.Array:
    """The stress of modes (4 n_mode, n_element) of a mesh's elements, from that of their ancestors; differentiable.

    A triangle (peak, a, b) has the parts (middle, peak, a) and (middle, b, peak): their edges are halves of the sum and
    the difference of its own, and so a stress has in their basis sums and differences of its components.
    """
    rows = memory.reshape(-1, 4, memory.shape[1])
    a, mixed, b, across = jnp.moveaxis(rows[:, :, ancestors.element], 1, 0)
    for part in reversed(ancestors.parts):
        sum_, difference = a + 2.0 * mixed + b, a - 2.0 * mixed + b
        one, two = part == 0, part == 1
        a, mixed, b = (
            jnp.where(one, sum_, jnp.where(two, difference, a)),
            jnp.where(one, b - a, jnp.where(two, a - b, mixed)),
            jnp.where(one, difference, jnp.where(two, sum_, b)),
        )
    return jnp.stack([a, mixed, b, across], axis=1).reshape(memory.shape[0], -1)

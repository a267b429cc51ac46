"""The nodal force of the sheet and its hand-written derivative, forward and reverse.

The force is a JAX primitive of its own. Plain automatic differentiation would store every intermediate of every
element at every step; here the derivative needs the positions alone and works the rest out again. A `custom_vjp`
would shut out forward mode, which least-squares columns and the search for the stable step need; the primitive has a
tangent (linear in its perturbations), the transpose of that tangent, and batching. `benchmarks/` times this against the
formulations that lost.
"""

from __future__ import annotations

from typing import Any

import jax

from jaxform.kernels.twice_differentiable import TwiceDifferentiable
from jaxform.mechanics.corners import Load, corner_force_tangent, corner_forces
from jaxform.mechanics.elements import Elements, allocate_corner_forces, nodal_sum
from jaxform.mechanics.force_vjp import corner_cotangents, zero_sums, zone_cotangents


def force(load: Load, elements: Elements) -> tuple[jax.Array, jax.Array]:
    """Nodal force (3, place) [N], internal and pressure together, and the enclosed volume [m^3].

    The volume is what the pressure works on: its derivative with respect to the positions of nodes that can move,
    times the pressure, is the nodal force of the pressure.
    """
    return _differentiated(load, elements)


def _force(load: Load, elements: Elements) -> tuple[jax.Array, jax.Array]:
    corners, volume = corner_forces(load, elements, allocate_corner_forces(load.positions, elements))
    return nodal_sum(corners, elements), volume


def _tangent(load: Load, elements: Elements, change: Load) -> tuple[jax.Array, jax.Array]:
    """Derivative of `_force` along `change`, linear in it; a missing part of `change` is None."""
    corners, volume = corner_force_tangent(load, elements, change, allocate_corner_forces(load.positions, elements))
    return nodal_sum(corners, elements), volume


def _cotangent(load: Load, elements: Elements, wanted: list[bool], nodal: Any, volume: Any) -> list[jax.Array | None]:
    """Transpose of `_tangent`: from cotangents of force and volume to those of the leaves of the load."""
    into = allocate_corner_forces(load.positions, elements) if wanted[0] else []
    if nodal is None:
        wanted = [wanted[0], *(False for _ in wanted[1:])]
    thickens, presses = wanted[1:3]
    corners, summed, sums = corner_cotangents(load, elements, wanted, nodal, volume, into, zero_sums(load, wanted))
    found: list[jax.Array | None] = [None] * len(wanted)
    if wanted[0]:
        found[0] = nodal_sum(corners, elements)
    if thickens:
        found[1] = summed[0][0] / load.thickness
    if presses:
        found[2] = sums.pop(0)
    numbers = zone_cotangents(load, wanted, summed) | dict(zip(load.response.single, sums, strict=False))
    for k, name in enumerate(load.response.numbers, 3):
        found[k] = numbers[name] if wanted[k] else None
    return found


_differentiated = TwiceDifferentiable("membrane_force", _force, _tangent, _cotangent)

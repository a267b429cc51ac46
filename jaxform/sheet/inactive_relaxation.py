"""Stress relaxation in inactive elements: viscous modes of elements whose nodes all stick."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from jaxform.core.pytree import pytree
from jaxform.materials import Modes
from jaxform.materials.viscous import StrainState
from jaxform.mechanics.constitutive import split_modes, strain_state
from jaxform.mechanics.elements import element_metrics
from jaxform.sheet.discretization import Discretization
from jaxform.sheet.packing import Packed


@pytree
class InactiveElements:
    """Elements that do not move from some time on; their strain is what it was.

    Attributes:
        element: Their numbers (room,), and others that do not count.
        counted: Whether each counts (room,).
        stress: Of their modes (4 n_mode, room).
        strained: How they are strained, (room,) each.
        volume: (room,) [m^3].
        since: The time [s].
        modes: The modes.
    """

    element: jax.Array
    counted: jax.Array
    stress: jax.Array
    strained: StrainState
    volume: jax.Array
    since: jax.Array
    modes: Modes

    def unpack_stress(self, memory: jax.Array, time: jax.Array) -> tuple[jax.Array, jax.Array]:
        """The stress of all elements (4 n_mode, n_element) at a time [s], and what these lost since [J].

        At constant strain modes lose what they stored.
        """
        recursion = self.modes.recursion(time - self.since)
        measure = self.modes.measure(self.strained)
        before, after = split_modes(self.stress), []
        for rows, left, gain, back in zip(before, *recursion, strict=True):
            after.append([left * x + (gain - back) * row for x, row in zip(rows, measure, strict=True)])
        lost = self.modes.energy(before, self.strained) - self.modes.energy(after, self.strained)
        into = jnp.where(self.counted, self.element, memory.shape[1])
        rows = jnp.stack([row for mode in after for row in mode])
        return memory.at[:, into].set(rows, mode="drop"), jnp.sum(jnp.where(self.counted, self.volume * lost, 0.0))


def inactive_elements(
    positions: jax.Array,
    memory: jax.Array,
    time: jax.Array,
    modes: Modes,
    discrete: Discretization,
    packed: Packed,
) -> InactiveElements:
    """The elements that are not packed, of a sheet with nodes at positions (3, n_node) [m]."""
    whole = discrete.whole
    elements, element = whole.elements, whole.element
    own = discrete.of_elements(element)
    return InactiveElements(
        element=element,
        counted=(elements.area > 0.0) & ~packed.kept[element],
        stress=memory[:, element],
        strained=strain_state(*element_metrics(positions, elements)),
        volume=elements.area * own.thickness,
        since=time,
        modes=own.modes or modes,
    )

"""Constitutive response of elements: stress of the material model, and overstress of Prony terms if any."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from jaxform.core.parameters import parameter_ranges
from jaxform.core.pytree import pytree, static
from jaxform.kernels.blocks import materialize
from jaxform.materials import MODES, Law, Modes, Recursion
from jaxform.materials.viscous import Rows, StrainState
from jaxform.mechanics.membrane import Metric, invariants, plus, relaxed_metric, stress, stress_factors


@pytree
class ViscousMemory:
    """History of the Prony terms of elements: mode k has the stress `history[k] + gain[k] M`, M its measure.

    Attributes:
        rest: (4 n_mode, n), four rows a mode; in loops over blocks a list of them.
        gain: (n_mode,), or of each element (n_mode, n).
        kind: Name of the kind of modes.
        only_slope: Whether `history` is the stress itself, and the gain says only how it answers to a change.
    """

    history: Any
    gain: jax.Array
    kind: str = static()
    only_slope: bool = static(default=False)


def present_memory(stress: jax.Array, modes: Modes) -> ViscousMemory:
    """The history of elements whose modes have this stress (4 n_mode, n) at present."""
    return ViscousMemory(stress, jnp.zeros_like(modes.modulus), modes.kind)


def instantaneous_memory(stress: jax.Array, modes: Modes) -> ViscousMemory:
    """The history with the instantaneous response of the modes to a change of the strain."""
    none = jnp.zeros((), modes.time.dtype)
    return ViscousMemory(stress, modes.recursion(none)[1], modes.kind, only_slope=True)


class Response(NamedTuple):
    """A law, without its Prony terms, and what elements remember; None where they have no such modes.

    Its numbers are those of the law and of the memory; those that vary are of each element (..., n).
    """

    material: Law
    memory: ViscousMemory | None = None

    @property
    def numbers(self) -> dict[str, jax.Array]:
        """All of them, by name, in the order of the leaves of a load."""
        found = {name: getattr(self.material, name) for name in parameter_ranges(self.material)}
        if self.memory is not None:
            found |= {"memory.rest": self.memory.history, "memory.gain": self.memory.gain}
        return found

    @property
    def zones(self) -> dict[str, jax.Array]:
        """Those that vary."""
        found = self.material.zones
        if self.memory is not None:
            found = found | {"memory.rest": self.memory.history}
            found |= {"memory.gain": self.memory.gain} if self.memory.gain.ndim == 2 else {}
        return found

    @property
    def single(self) -> dict[str, jax.Array]:
        """Those that do not vary."""
        zones = self.zones
        return {name: number for name, number in self.numbers.items() if name not in zones}

    def with_numbers(self, numbers: Mapping[str, jax.Array]) -> Response:
        """The response with other parameters."""
        of_law = {name: number for name, number in numbers.items() if not name.startswith("memory.")}
        memory = self.memory
        if memory is not None:
            rest, gain = numbers.get("memory.rest", memory.history), numbers.get("memory.gain", memory.gain)
            memory = ViscousMemory(rest, gain, memory.kind, memory.only_slope)
        return Response(self.material.with_zones(of_law), memory)


def weighted_stress(g: Metric, inverse: Any, weight: jax.Array, response: Response) -> Metric:
    """A0 h0 S^ab (n,): what multiplies the edges in the nodal forces."""
    a, b = stress_factors(g, inverse, response.material)
    s = stress(g, inverse, (weight * a, weight * b))
    return s if response.memory is None else plus(s, _scale(weight, overstress(g, inverse, response.memory).total))


def materialized_stress(
    g: Metric, inverse: Any, weight: jax.Array, response: Response
) -> tuple[Metric, Overstress | None]:
    """The weighted stress, materialized for all its uses, and the overstress of the modes."""
    memory = response.memory
    if memory is not None:
        g = materialize(g)
    factors = stress_factors(g, inverse, response.material)
    s = stress(g, inverse, materialize((weight * factors[0], weight * factors[1])))
    if memory is None:
        return materialize(s), None
    more = overstress(g, inverse, memory, materialize)
    return materialize(plus(s, _scale(weight, more.total))), more


def stress_and_change(
    g: Metric, change: Metric, inverse: Any, weight: jax.Array, response: Response
) -> tuple[Metric, Metric]:
    """A0 h0 S^ab, and its change along that of the metric (n,)."""

    def factors(g: Metric) -> tuple[jax.Array, jax.Array]:
        a, b = stress_factors(g, inverse, response.material)
        return weight * a, weight * b

    if response.material.held_taut:
        g = relaxed_metric(g, inverse)
    # Both divide; kept, they are computed once instead of for each of the six components.
    stress_pair, rate = materialize(jax.jvp(factors, (g,), (change,)))
    b = stress_pair[1]
    s = stress(g, inverse, stress_pair)
    ds = plus(stress(g, inverse, rate), (b * change[2], -b * change[1], b * change[0]))
    memory = response.memory
    if memory is not None:
        more, more_change = jax.jvp(lambda g: overstress(g, inverse, memory).total, (g,), (change,))
        s, ds = plus(s, _scale(weight, more)), plus(ds, _scale(weight, more_change))
    return materialize((s, ds))


def strain_state(g: Metric, inverse: Any) -> StrainState:
    """The strain state from which Prony terms compute their stress."""
    r = inverse[0], inverse[1], inverse[2]
    strain = invariants(g, r)
    return StrainState(g, r, strain.trace, strain.determinant)


class Overstress(NamedTuple):
    """Stress of the Prony terms.

    Attributes:
        total: Stress S^ab [Pa/m^2] of all, free across the sheet.
        modes: That of each by itself, four rows.
        measure: What it follows.
        strained: The strain.
    """

    total: Metric
    modes: list[Rows]
    measure: Rows
    strained: StrainState

    def updated_history(self, recursion: Recursion) -> Rows:
        """`ViscousMemory.history` (4 n_mode rows) for the next step, after a step with that recursion."""
        lefts, _, backs = recursion
        return [
            left * x - back * row
            for rows, left, back in zip(self.modes, lefts, backs, strict=True)
            for x, row in zip(rows, self.measure, strict=True)
        ]


def overstress(g: Metric, inverse: Any, memory: ViscousMemory, keep: Callable[[Any], Any] = lambda x: x) -> Overstress:
    """The overstress of Prony terms at a metric; `keep` is applied to values that are used more than once."""
    now = keep(strain_state(g, inverse))
    measure = keep(MODES[memory.kind].measure(now))
    followed = measure
    if memory.only_slope:
        followed = [row - jax.lax.stop_gradient(row) for row in measure]
    modes = keep(
        [
            [memory.history[4 * k + i] + gain * row for i, row in enumerate(followed)]
            for k, gain in enumerate(memory.gain)
        ]
    )
    return Overstress(plane_stress(modes, now), modes, measure, now)


def split_modes(memory: jax.Array) -> list[Rows]:
    """The stress of each mode, of rows (4 n_mode, n)."""
    return [list(memory[k : k + 4]) for k in range(0, len(memory), 4)]


def plane_stress(modes: list[Rows], now: StrainState) -> Metric:
    """The modes' stress in the plane with the pressure that takes away what they have across it."""
    one, mixed, two, across = (sum(rows[1:], rows[0]) for rows in zip(*modes, strict=True))
    pressure = across / now.determinant
    a, b, c = now.present_inverse
    return one - pressure * a, mixed - pressure * b, two - pressure * c


def _scale(factor: jax.Array, s: Metric) -> Metric:
    return factor * s[0], factor * s[1], factor * s[2]

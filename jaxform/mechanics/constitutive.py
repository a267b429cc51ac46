"""Constitutive response of elements: stress of the material model, and overstress of Prony terms if any."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from jaxform.core.pytree import parameter_ranges, pytree, static
from jaxform.kernels.blocks import materialize
from jaxform.materials import MODES, Law, Modes, PlaneLaw, Recursion
from jaxform.materials.viscous import Rows, StrainState
from jaxform.mechanics.membrane import (
    Invariants,
    Metric,
    Vector,
    edges,
    invariants,
    invert_metric,
    metric,
    plus,
    principal_stretches,
    relax_strain,
    relaxed_metric,
    stress,
    stress_factors,
)


@pytree
class ViscousMemory:
    """History of the Prony terms of elements: mode k has the stress `history[k] + gain[k] M`, M its measure.

    Attributes:
        history: (4 n_mode, n), four rows a mode; in loops over blocks a list of them.
        gain: (n_mode,), or of each element (n_mode, n).
        kind: Name of the kind of modes.
        only_slope: True if `history` is the stress itself, and the gain says only how it answers to a change.
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
            found |= {"memory.history": self.memory.history, "memory.gain": self.memory.gain}
        return found

    @property
    def zones(self) -> dict[str, jax.Array]:
        """Those that vary."""
        found = self.material.zones
        if self.memory is not None:
            found = found | {"memory.history": self.memory.history}
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
            rest, gain = numbers.get("memory.history", memory.history), numbers.get("memory.gain", memory.gain)
            memory = ViscousMemory(rest, gain, memory.kind, memory.only_slope)
        return Response(self.material.with_zones(of_law), memory)


def weighted_stress(g: Metric, inverse: Any, weight: jax.Array, response: Response) -> Metric:
    """A0 h0 S^ab (n,): what multiplies the edges in the nodal forces."""
    a, b = stress_factors(g, inverse, response.material)
    s = stress(g, inverse, (weight * a, weight * b))
    return s if response.memory is None else plus(s, _scale(weight, overstress(g, inverse, response.memory).total))


def materialize_stress(
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
        measure: Measure of strain that it relaxes to.
        strained: The strain.
    """

    total: Metric
    modes: list[Rows]
    measure: Rows
    strained: StrainState

    def advance_history(self, recursion: Recursion) -> Rows:
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


# Stress of a sheet that is strained alike everywhere, by the functions that the simulator's elements use.


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
    stress = weighted_stress(metric, inverse, unit, Response(law.elastic, memory))
    return one * stress[0], two * stress[2]


def initial_overstress(modes: Modes, count: int) -> Overstress:
    """The overstress of Prony terms at points (count,) that were never strained."""
    unit = jnp.ones((count,), modes.time.dtype)
    none = jnp.zeros_like(unit)
    inverse = jnp.stack([unit, none, unit])
    memory = present_memory(modes.initial_stress(inverse), modes)
    return overstress((unit, none, unit), inverse, memory)


def advance_memory(modes: Modes, past: Overstress, step: jax.Array) -> ViscousMemory:
    """The memory of Prony terms after a step [s] with the strain linear in time; a step of 0 is a jump."""
    recursion = modes.recursion(step)
    return ViscousMemory(jnp.stack(past.advance_history(recursion)), recursion[1], modes.kind)


def principal_overstress(memory: ViscousMemory, one: jax.Array, two: jax.Array) -> Overstress:
    """The overstress of Prony terms with such a memory at points that now have these stretches (n,)."""
    none, unit = jnp.zeros_like(one), jnp.ones_like(one)
    return overstress((one * one, none, two * two), jnp.stack([unit, none, unit]), memory)


# Stiffness of elements, which bounds the stable step.


@jax.jit
def shape_bound(inverse_reference: jax.Array, area: jax.Array) -> jax.Array:
    """Largest eigenvalue (n_element,) [1/m^2] of the gradients of a triangle's shape functions, 3 nodes lumped.

    lambda_G = (S + sqrt(S^2 - 3/A0^2))/2 with S = (sum of squared edge lengths)/(4 A0^2).
    """
    g11, g12, g22 = invert_metric((inverse_reference[0], inverse_reference[1], inverse_reference[2]))
    total = (2.0 * (g11 + g22 - g12)) / (4.0 * jnp.square(area))
    gap = jnp.square(total) - 3.0 / jnp.square(area)
    return 0.5 * (total + jnp.sqrt(jnp.maximum(gap, 0.0)))


def tangent_stiffness(strain: Invariants, material: Law) -> jax.Array:
    """Largest eigenvalue D (n_element,) [Pa] of d2W/dF2 at the present strain, in closed form.

    The candidates are the two of the block of stretches, the two shears and the two motions out of the plane:
    second derivatives of W by the stretches (a, b), and its slopes over sums and differences of them.
    """
    if material.tension_field:
        # A slack element may become taut before the window's end.
        strain, _ = relax_strain(strain)
    a, b = principal_stretches(strain)
    if isinstance(material, PlaneLaw):
        return _largest(_plane_law_moduli(strain, a, b, material))
    slope1, slope2 = material.slopes(strain.i1, strain.i2)
    p, q = a * b, 1.0 / (a * b) ** 3
    first_a, first_b = q * b / a, q * a / b
    terms = [2 + 6 * first_a, 2 + 6 * first_b, 4 * q, 2 + 2 * q, 2 - 2 * q, 2 - 2 * first_a, 2 - 2 * first_b]
    terms = [(0.0 if slope1 is None else slope1) * term for term in terms]
    if slope2 is not None:
        squares, inverse_a, inverse_b = a * a + b * b, 1.0 / a**4, 1.0 / b**4
        second = [2 * b * b + 6 * inverse_a, 2 * a * a + 6 * inverse_b, 4 * p]
        second += [2 * q * (squares + p) - 2 * p, 2 * p - 2 * q * (squares - p)]
        second += [2 * b * b - 2 * inverse_a, 2 * a * a - 2 * inverse_b]
        terms = [term + slope2 * extra for term, extra in zip(terms, second, strict=True)]
    for curvature, product in zip(material.curvatures(strain.i1, strain.i2), _slopes_by_stretches(a, b), strict=True):
        if curvature is not None:
            for k, part in enumerate(product):
                terms[k] = terms[k] + curvature * part
    return _largest(terms)


def _plane_law_moduli(strain: Invariants, a: jax.Array, b: jax.Array, material: PlaneLaw) -> list[jax.Array]:
    """The candidates of a law in trace and determinant: the block's (aa, bb, ab), then the others."""
    slope1, slope2 = material.slopes(strain.trace, strain.determinant)
    one, two = (2 * a, 2 * b), (2 * a * b * b, 2 * b * a * a)  # slopes of trace and determinant by the stretches
    out_of_plane = [2 * slope1 + 2 * side * side * slope2 for side in (b, a)]
    terms = [*out_of_plane, 4 * a * b * slope2]
    for curvature, first, second in zip(
        material.curvatures(strain.trace, strain.determinant), (one, one, two), (one, two, two), strict=True
    ):
        if curvature is not None:
            twice = 1.0 if first is second else 2.0
            terms[0] += twice * curvature * first[0] * second[0]
            terms[1] += twice * curvature * first[1] * second[1]
            terms[2] += 0.5 * twice * curvature * (first[0] * second[1] + first[1] * second[0])
    in_plane = [2 * slope1 + sign * 2 * a * b * slope2 for sign in (1.0, -1.0)]
    return [*terms, *in_plane, *out_of_plane]


def _largest(terms: list[jax.Array]) -> jax.Array:
    """The largest of these eigenvalues: of a block (11, 22, 12) both, and the others."""
    h11, h22, h12, *others = terms
    largest = 0.5 * (h11 + h22) + jnp.sqrt(0.25 * jnp.square(h11 - h22) + jnp.square(h12))
    for other in others:
        largest = jnp.maximum(largest, other)
    return largest


def _slopes_by_stretches(a: jax.Array, b: jax.Array) -> list[Vector]:
    """Products of the invariants' slopes by the stretches, (aa, bb, ab): of I1 and I1, I1 and I2, I2 and I2."""
    one = 2 * a - 2 / (a**3 * b * b), 2 * b - 2 / (b**3 * a * a)
    two = 2 * a * b * b - 2 / a**3, 2 * b * a * a - 2 / b**3
    squares = [(x[0] * x[0], x[1] * x[1], x[0] * x[1]) for x in (one, two)]
    mixed = 2 * one[0] * two[0], 2 * one[1] * two[1], one[0] * two[1] + one[1] * two[0]
    return [squares[0], mixed, squares[1]]


def viscous_stiffness(strain: Invariants, now: StrainState, stresses: list[Rows], modes: Modes) -> jax.Array:
    """Upper bound (n,) [Pa] of the Prony terms' part in the largest tangent eigenvalue, from their stresses.

    Three terms, each at its largest: the stress in the plane, the pressure that frees the sheet of stress across, and
    how the modes' own stress answers to strain.
    """
    larger, smaller = principal_stretches(strain)
    one, mixed, two = plane_stress(stresses, now)
    a, b, c = now.initial
    half = 0.5 * (one * a + 2.0 * mixed * b + two * c)
    determinant = (one * two - mixed * mixed) * (a * c - b * b)
    in_plane = half + jnp.sqrt(jnp.maximum(jnp.square(half) - determinant, 0.0))
    across = sum((rows[3] for rows in stresses), jnp.zeros_like(larger))
    pressure = 6.0 * jnp.maximum(across, 0.0) / (strain.determinant * jnp.square(smaller))
    return jnp.maximum(in_plane, 0.0) + pressure + modes.stiffening(larger, smaller)


def element_stiffness(
    positions: jax.Array | Vector,
    triangles: jax.Array,
    inverse_reference: jax.Array,
    bound: jax.Array,
    moving: jax.Array,
    material: Law,
    memory: jax.Array | None = None,
) -> jax.Array:
    """D lambda_G of each element (n_element,) [Pa/m^2], which bounds the stable step; 0 where immobile.

    Divided by the density where that varies.

    Args:
        positions: (3, n_node) [m].
        triangles: (3, n_element).
        inverse_reference: Inverse of the initial metric (3, n_element) [1/m^2].
        bound: Lambda_G (n_element,) [1/m^2].
        moving: Mask (n_element,).
        material: The law, its zones (n_element,).
        memory: The stress of its Prony terms (4 n_mode, n_element); None where it has none.
    """
    _, edge1, edge2 = edges(positions, triangles)
    edge1, edge2 = materialize((edge1, edge2))
    g = metric(edge1, edge2)
    strain = invariants(g, inverse_reference)
    found = tangent_stiffness(strain, material)
    if memory is not None and material.viscous is not None:
        found += viscous_stiffness(strain, strain_state(g, inverse_reference), split_modes(memory), material.viscous)
    found *= bound
    return jnp.where(moving, found / material.density if material.density.ndim else found, 0.0)


def stable_step(largest: jax.Array, material: Law) -> jax.Array:
    """Safe bound on the central-difference step [s], from the largest stiffness `element_stiffness`.

    dt <= 2/sqrt(3 D lambda_G/rho), which holds in tension. The thickness cancels between stiffness and lumped mass.
    Infinite where nothing can move.
    """
    square = 3.0 * largest
    return 2.0 / jnp.sqrt(square if material.density.ndim else square / material.density)

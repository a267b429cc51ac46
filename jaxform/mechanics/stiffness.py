"""Stiffness of elements, which bounds the stable step."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from jaxform.kernels.blocks import materialize
from jaxform.materials import Law, Modes, PlaneLaw
from jaxform.materials.viscous import Rows, StrainState
from jaxform.mechanics.constitutive import plane_stress, split_modes, strain_state
from jaxform.mechanics.membrane import (
    Invariants,
    Vector,
    edges,
    invariants,
    invert_metric,
    metric,
    principal_stretches,
    relax_strain,
)


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
        # What is slack may be taut before the window's end.
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

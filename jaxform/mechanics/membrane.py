"""The linear membrane triangle: kinematics, stress, energy and lumped mass.

Everything is component-first, (3, n), because that is twice as fast as (n, 3) inside the step; where vectors are
computed they are triples of (n,), since XLA turns each stacking into a loop with a branch in it. A metric is the
triple (11, 12, 22) of its components in the basis of the triangle's two edges from its first node.
"""

from __future__ import annotations

import functools
from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax.custom_derivatives import SymbolicZero

from jaxform.kernels.blocks import materialize, on_cpu
from jaxform.materials import Law, PlaneLaw
from jaxform.materials.tension_field import RelaxedStrain, relax_slack_strain

Metric = tuple[jax.Array, jax.Array, jax.Array]
Vector = tuple[jax.Array, jax.Array, jax.Array]


class Invariants(NamedTuple):
    """Invariants of the right Cauchy-Green tensor (n_element,): in-plane trace and determinant, I1, I2."""

    trace: jax.Array
    determinant: jax.Array
    i1: jax.Array
    i2: jax.Array


def gather(values: jax.Array, index: jax.Array) -> jax.Array:
    """Columns of (..., n_node) `values` at `index`, which the mesh guarantees to exist; it is not tested."""
    lead = tuple(range(values.ndim - 1))
    numbers = jax.lax.GatherDimensionNumbers(lead, (values.ndim - 1,), (values.ndim - 1,))
    # Without a sign, or XLA would look for negative ones all the same.
    index = index.astype(jnp.uint32)[..., None]
    return jax.lax.gather(values, index, numbers, (*values.shape[:-1], 1), mode="promise_in_bounds")


def gather_rows(rows: Sequence[jax.Array], index: jax.Array) -> list[jax.Array]:
    """Entries (n,) of several rows (n_node,) at the same places (n,), in one loop; as `gather_sum`."""
    return gather_sum(rows, index[None])


def gather_sum(rows: Sequence[jax.Array], index: jax.Array) -> list[jax.Array]:
    """Sums (n,) of the entries of several rows (n_node,) at places (k, n), over k, in one loop.

    XLA's CPU compiler makes a loop for each array that it computes, and each would take all indices apart again, which
    takes longer than to look up; only a reduction of several arrays is one loop for all of them.
    """
    if not on_cpu():
        return [jnp.sum(gather(row, index), axis=0) for row in rows]
    return _gather_sum_fused(list(rows), index)


@jax.custom_jvp
def _gather_sum_fused(rows: list[jax.Array], index: jax.Array) -> list[jax.Array]:
    # Else every entry would be cut out again, and looked up for every step of the loop.
    index = materialize(index)
    found = [gather(row, index) for row in rows]
    if len(index) == 1:
        # A sum over one alone would be seen through. Nothing is added, since minus nothing changes no number.
        found = [jnp.pad(values, ((0, 1), (0, 0)), constant_values=-0.0) for values in found]
    none = [jnp.asarray(-0.0, values.dtype) for values in found]
    add = lambda a, b: [x + y for x, y in zip(a, b, strict=True)]  # noqa: E731
    return jax.lax.reduce(found, none, add, (0,))


@functools.partial(_gather_sum_fused.defjvp, symbolic_zeros=True)
def _(primals: Any, tangents: Any) -> tuple[list[jax.Array], list[Any]]:
    """Linear in the rows; JAX's own derivative of such a reduction is no loop, and none where a row has no tangent."""
    (rows, index), (changes, _) = primals, tangents
    moving = [change for change in changes if not isinstance(change, SymbolicZero)]
    found, moved = _gather_sum_fused(rows, index), iter(_gather_sum_fused(moving, index) if moving else [])
    none = [SymbolicZero(jax.typeof(values).to_tangent_aval()) for values in found]
    pairs = zip(changes, none, strict=True)
    return found, [zero if isinstance(change, SymbolicZero) else next(moved) for change, zero in pairs]


def gather_columns(values: jax.Array | Vector, index: jax.Array) -> Vector:
    """`gather` of (3, n_node), component by component from one flat row, without copies or strides."""
    if isinstance(values, tuple):
        return vector(gather_rows(values, index))
    flat, size = values.reshape(-1), values.shape[1]
    x, y, z = (gather(flat, index + k * size) for k in range(3))
    return x, y, z


def vector(components: Iterable[jax.Array]) -> Vector:
    """Three components (n,) as a vector."""
    x, y, z = components
    return x, y, z


def edges(positions: jax.Array | Vector, triangles: jax.Array) -> tuple[Vector, Vector, Vector]:
    """First node and the two edges from it, each three times (n_element,) [m], of (3, n_node) and (3, n_element).

    Of positions row by row no derivative is taken, and the nodes' are kept for all their uses.
    """
    rows, look_up = unstack_rows(positions), gather_rows if isinstance(positions, tuple) else _gather_each
    first, second, third = (vector(look_up(rows, nodes)) for nodes in triangles)
    return first, minus(second, first), minus(third, first)


def _gather_each(rows: Sequence[jax.Array], index: jax.Array) -> list[jax.Array]:
    return [gather(row, index) for row in rows]


def unstack_rows(positions: jax.Array | Vector) -> Vector:
    """The rows of (3, n), taken apart once: for loops over blocks, which would do it again for each."""
    x, y, z = positions
    return x, y, z


def minus(a: jax.Array | Vector, b: jax.Array | Vector) -> Vector:
    """Difference of two vectors, component by component."""
    (x, y, z), (u, v, w) = a, b
    return x - u, y - v, z - w


def plus(a: jax.Array | Vector, b: jax.Array | Vector) -> Vector:
    """Sum of two vectors, component by component."""
    (x, y, z), (u, v, w) = a, b
    return x + u, y + v, z + w


def dot(a: jax.Array | Vector, b: jax.Array | Vector) -> jax.Array:
    """Scalar products of the columns of two vectors: (3, n) arrays or triples of (n,)."""
    if not isinstance(a, tuple | list) and not isinstance(b, tuple | list):
        # Two operations instead of seventeen, where no loop over steps waits for them.
        return jnp.sum(a * b, axis=0)
    (x, y, z), (u, v, w) = a, b
    return x * u + y * v + z * w


def cross(a: jax.Array | Vector, b: jax.Array | Vector) -> Vector:
    """Vector products of the columns of two vectors: (3, n) arrays or triples of (n,)."""
    (x, y, z), (u, v, w) = a, b
    return y * w - z * v, z * u - x * w, x * v - y * u


def metric(edge1: Vector, edge2: Vector) -> Metric:
    """Metric (g11, g12, g22) [m^2] of two edges, each three times (n_element,)."""
    return dot(edge1, edge1), dot(edge1, edge2), dot(edge2, edge2)


def _determinant(g: Metric) -> jax.Array:
    return g[0] * g[2] - g[1] * g[1]


def invert_metric(g: Metric) -> Metric:
    """The inverse of a metric."""
    scale = 1.0 / _determinant(g)
    return g[2] * scale, -g[1] * scale, g[0] * scale


@jax.jit
def reference_metric(positions: jax.Array, triangles: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Inverse metric (3, n_element) [1/m^2] and area (n_element,) [m^2] of the initial mesh."""
    g = metric(*edges(positions, triangles)[1:])
    return jnp.stack(invert_metric(g)), 0.5 * jnp.sqrt(_determinant(g))


def invariants(g: Metric, inverse_reference: jax.Array | Metric) -> Invariants:
    """Invariants of incompressible strain from the current metric and the inverse of the initial one."""
    r = inverse_reference
    trace = r[0] * g[0] + 2.0 * r[1] * g[1] + r[2] * g[2]
    return _invariants(trace, _determinant(g) * (r[0] * r[2] - r[1] * r[1]))


def _invariants(trace: jax.Array, determinant: jax.Array) -> Invariants:
    flexibility = _reciprocal(determinant)  # the only division
    return Invariants(trace, determinant, trace + flexibility, determinant + trace * flexibility)


def relax_strain(strain: Invariants) -> tuple[Invariants, RelaxedStrain]:
    """The strain of a sheet that goes slack, and what of it is."""
    square = jnp.square(0.5 * strain.trace) - strain.determinant
    return _relax_strain(strain, square)


def _relax_strain(strain: Invariants, square: jax.Array) -> tuple[Invariants, RelaxedStrain]:
    found = relax_slack_strain(strain.trace, strain.determinant, square)
    return _invariants(found.trace, found.determinant), found


@jax.custom_jvp
def _reciprocal(values: jax.Array) -> jax.Array:
    """One over values; its derivative is made of it, where JAX's own divides once more."""
    return 1.0 / values


@_reciprocal.defjvp
def _reciprocal_change(values: tuple[jax.Array], changes: tuple[jax.Array]) -> tuple[jax.Array, jax.Array]:
    reciprocal = _reciprocal(*values)
    return reciprocal, -jnp.square(reciprocal) * changes[0]


def _difference_squared(g: Metric, inverse_reference: jax.Array | Metric) -> jax.Array:
    """((l1^2 - l2^2) / 2)^2 (n,).

    From the components, since (T / 2)^2 - D loses half of the digits where the strain is little.
    """
    r = inverse_reference
    apart = 0.5 * (r[0] * g[0] - r[2] * g[2])
    return jnp.square(apart) + (r[0] * g[1] + r[1] * g[2]) * (r[1] * g[0] + r[2] * g[1])


def relaxed_metric(g: Metric, inverse_reference: jax.Array | Metric) -> Metric:
    """The metric of a sheet that is as wide as the tension in it would leave it, where it is slack."""
    strain = invariants(g, inverse_reference)
    _, found = _relax_strain(strain, _difference_squared(g, inverse_reference))
    present, initial = found.shares()
    first = invert_metric((inverse_reference[0], inverse_reference[1], inverse_reference[2]))
    a, b, c = (present * now + initial * then for now, then in zip(g, first, strict=True))
    return a, b, c


def stress_factors(g: Metric, inverse_reference: jax.Array | Metric, material: Law) -> tuple[jax.Array, jax.Array]:
    """A [Pa] and B [Pa/m^4], (n_element,), of the second Piola-Kirchhoff stress S^ab = A G^ab + B adj(g)^ab.

    Every isotropic law's stress is of this form: the slopes of its energy and one division give both factors, and
    the three components follow by one product each.
    """
    r = inverse_reference
    strain, scale = invariants(g, r), 2.0 * (r[0] * r[2] - r[1] * r[1])
    if not material.tension_field:
        return _factors(strain, scale, material)
    strain, found = _relax_strain(strain, _difference_squared(g, r))
    return found.factors(*_factors(strain, scale, material), scale)


def _factors(strain: Invariants, scale: jax.Array, material: Law) -> tuple[jax.Array, jax.Array]:
    trace, determinant, i1, i2 = strain
    if isinstance(material, PlaneLaw):
        by_trace, by_determinant = material.slopes(trace, determinant)
        return 2.0 * by_trace, scale * by_determinant
    slope1, slope2 = material.slopes(i1, i2)
    flexibility = _reciprocal(determinant)
    if slope1 is None:
        slope1 = jnp.zeros_like(trace)
    if slope2 is None:
        return 2.0 * slope1 * jnp.ones_like(trace), -scale * jnp.square(flexibility) * slope1
    if slope2.ndim > 0:
        slope2 = materialize(slope2)  # both factors would work it out again
    pull = slope1 + slope2 * trace
    return 2.0 * (slope1 + slope2 * flexibility), scale * (slope2 - jnp.square(flexibility) * pull)


def stress(g: Metric, inverse_reference: jax.Array | Metric, factors: tuple[jax.Array, jax.Array]) -> Metric:
    """Second Piola-Kirchhoff stress S^ab = 2 dW/dg_ab [Pa/m^2], components (11, 12, 22), from `stress_factors`."""
    a, b = factors
    r = inverse_reference
    return a * r[0] + b * g[2], a * r[1] - b * g[1], a * r[2] + b * g[0]


def strain_energy(
    positions: jax.Array,
    triangles: jax.Array,
    inverse_reference: jax.Array,
    volume: jax.Array,
    material: Law,
) -> jax.Array:
    """Strain energy of the sheet [J]; `volume` (n_element,) [m^3] is initial thickness times initial area."""
    strain = invariants(metric(*edges(positions, triangles)[1:]), inverse_reference)
    return jnp.sum(volume * energy_density(strain, material))


def energy_density(strain: Invariants, material: Law) -> jax.Array:
    """Strain energy per reference volume (n_element,) [J/m^3]."""
    if material.tension_field:
        strain, _ = relax_strain(strain)
    if isinstance(material, PlaneLaw):
        return material.energy(strain.trace, strain.determinant)
    return material.energy(strain.i1, strain.i2)


@jax.jit
def equibiaxial_energy(material: Law, square: jax.Array) -> jax.Array:
    """Strain energy per volume [J/m^3] where a sheet is stretched alike both ways, by roots of `square` (n,).

    Where the law has zones, of the mean of their numbers.
    """
    means = {name: jnp.mean(values, axis=-1) for name, values in material.zones.items()}
    return energy_density(_invariants(2.0 * square, jnp.square(square)), material.with_zones(means))


def principal_stretches(strain: Invariants) -> tuple[jax.Array, jax.Array]:
    """Larger and smaller in-plane stretch, each (n_element,), from the invariants."""
    mean = 0.5 * strain.trace
    spread = jnp.square(mean) - strain.determinant
    # Equal stretches have no derivative of their difference: the inner `where` keeps the root away from 0.
    root = jnp.where(spread > 0.0, jnp.sqrt(jnp.where(spread > 0.0, spread, 1.0)), 0.0)
    larger = jnp.sqrt(mean + root)
    return larger, jnp.sqrt(strain.determinant) / larger


def element_mean(values: jax.Array, triangles: jax.Array) -> jax.Array:
    """Mean over each triangle's nodes (..., n_element) of nodal values (..., n_node)."""
    return (values[..., triangles[0]] + values[..., triangles[1]] + values[..., triangles[2]]) / 3.0


def sum_to_nodes(values: jax.Array, triangles: jax.Array, node_count: int) -> jax.Array:
    """Sum (n_node,) over the adjacent triangles of values (n_element,)."""
    return jnp.zeros(node_count, values.dtype).at[triangles.ravel()].add(jnp.tile(values, 3))

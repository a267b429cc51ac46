"""The element force as it can be written in JAX: those that lost, and the one that `jaxform.force` holds.

Same mathematics, same sheet; what differs is how the nodes are looked up, what is kept from being worked out again, and
how the corners' shares come together. The table is in benchmarks/README.md.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from benchmarks.speed.sheets import ALPHA, PRESSURE, THICKNESS, C, Sheet
from jaxform.core.compilation import compile_function, compiler_options
from jaxform.kernels import blocks
from jaxform.materials import Law, MooneyRivlin
from jaxform.mechanics.corners import Load, corner_forces
from jaxform.mechanics.elements import Elements, GatherTable, allocate_corner_forces, gather_shares
from jaxform.mechanics.membrane import Vector, cross, metric, stress, stress_factors, unstack_rows, vector
from jaxform.model import tables
from jaxform.sheet import packing

LAW = MooneyRivlin(jnp.asarray(C), jnp.asarray(ALPHA), jnp.asarray(1.0))


def _corners(u: Any, w: Any, inverse: jax.Array, weight: jax.Array, keep: Callable[[Any], Any]) -> list[Vector]:
    """The shares of the three corners; `keep` decides what is worked out once."""
    u, w = keep((u, w))
    a, b = stress_factors(metric(u, w), inverse, LAW)
    s11, s12, s22 = keep(stress(metric(u, w), inverse, keep((weight * a, weight * b))))
    push = [PRESSURE / 6 * n for n in cross(u, w)]
    pull2, pull3 = ([s * x + t * y for x, y in zip(u, w, strict=True)] for s, t in ((s11, s12), (s12, s22)))
    first = (push[0] + pull2[0] + pull3[0], push[1] + pull2[1] + pull3[1], push[2] + pull2[2] + pull3[2])
    second = (push[0] - pull2[0], push[1] - pull2[1], push[2] - pull2[2])
    third = (push[0] - pull3[0], push[1] - pull3[1], push[2] - pull3[2])
    return [first, second, third]


def _free(values: Any) -> Any:
    return values


def node_rows(sheet: Sheet) -> Callable[[jax.Array], jax.Array]:
    """Positions (n_node, 3), one scatter of whole rows, nothing kept: as one would write it first."""
    triangles, inverse, weight = jnp.asarray(sheet.triangles), jnp.asarray(sheet.metric.T), _weight(sheet)

    def nodal(x: jax.Array) -> jax.Array:
        corner = x.T[triangles]
        u, w = corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]
        shares = jnp.stack([jnp.stack(share, axis=1) for share in _corners(u.T, w.T, inverse, weight, _free)], axis=1)
        return jnp.zeros_like(x.T).at[triangles].add(shares).T

    return nodal


def _columns(keep: Callable[[Any], Any]) -> Callable[[Sheet], Callable[[jax.Array], jax.Array]]:
    def build(sheet: Sheet) -> Callable[[jax.Array], jax.Array]:
        triangles, inverse, weight = jnp.asarray(sheet.triangles.T), jnp.asarray(sheet.metric.T), _weight(sheet)

        def nodal(x: jax.Array) -> jax.Array:
            first, second, third = (x.at[:, nodes].get(mode="promise_in_bounds") for nodes in triangles)
            total = jnp.zeros_like(x)
            shares = _corners(second - first, third - first, inverse, weight, keep)
            for nodes, share in zip(triangles, shares, strict=True):
                total = total.at[:, nodes].add(jnp.stack(share), mode="promise_in_bounds")
            return total

        return nodal

    return build


def nine_scatters(sheet: Sheet) -> Callable[[jax.Array], jax.Array]:
    """Rows one by one: nine lookups and nine scatters of vectors."""
    triangles, inverse, weight = jnp.asarray(sheet.triangles.T), jnp.asarray(sheet.metric.T), _weight(sheet)

    def nodal(x: jax.Array) -> jax.Array:
        first, second, third = ([row[nodes] for row in x] for nodes in triangles)
        u, w = ([a - b for a, b in zip(corner, first, strict=True)] for corner in (second, third))
        total = [jnp.zeros_like(row) for row in x]
        shares = _corners(u, w, inverse, weight, jax.lax.optimization_barrier)
        for nodes, share in zip(triangles, shares, strict=True):
            total = [row.at[nodes].add(part) for row, part in zip(total, share, strict=True)]
        return jnp.stack(total)

    return nodal


def gather_formulation(sheet: Sheet) -> Callable[[jax.Array], jax.Array]:
    """Nodes gather their shares, which lets XLA compile all steps into one function; no blocks."""
    triangles, inverse, weight = jnp.asarray(sheet.triangles.T), jnp.asarray(sheet.metric.T), _weight(sheet)
    elements = packed_formulation(sheet, paired=False).elements
    room, count = elements.triangles.shape[1], len(sheet.triangles)

    def nodal(x: jax.Array) -> jax.Array:
        first, second, third = ([row[nodes] for row in x] for nodes in triangles)
        u, w = ([a - b for a, b in zip(corner, first, strict=True)] for corner in (second, third))
        shares = jax.lax.optimization_barrier(_corners(u, w, inverse, weight, jax.lax.optimization_barrier))
        rows = [jnp.stack([jnp.pad(share[k], (0, room - count)) for share in shares]) for k in range(3)]
        found = gather_shares(jax.lax.optimization_barrier(rows), _shares(elements))
        return jnp.stack(found)[:, : x.shape[1]]

    return nodal


def packed_formulation(sheet: Sheet, *, paired: bool = True) -> packing.Packed:
    """The sheet as `jaxform` steps it; or with elements one by one, as where they are bisected."""
    geometry = tables.ReferenceGeometry(
        jnp.asarray(sheet.triangles.T), jnp.asarray(sheet.metric.T), jnp.asarray(sheet.area), jnp.zeros(3)
    )
    if paired:
        return packing.pack(None, geometry, packing.make_paired_assembly(sheet.positions, sheet.triangles))
    return packing.pack(None, geometry, packing.make_assembly(sheet.triangles, len(sheet.positions)))


def _shares(elements: Elements) -> GatherTable:
    return elements.slots, jnp.max(elements.row_count)


def _weight(sheet: Sheet) -> jax.Array:
    return jnp.asarray(sheet.area * THICKNESS)


LOSERS: dict[str, Callable[[Sheet], Callable[[jax.Array], jax.Array]]] = {
    "positions (n, 3), one scatter of rows": node_rows,
    "positions (3, n), three scatters, nothing kept": _columns(_free),
    "the same, edges and stress kept": _columns(jax.lax.optimization_barrier),
    "nine lookups, nine scatters, edges and stress kept": nine_scatters,
    "nodes gather their shares, no blocks": gather_formulation,
}


def stepper(nodal: Callable[[jax.Array], jax.Array], sheet: Sheet) -> Callable[[int], Any]:
    """Runs so many steps with a force, compiled at the highest level of optimization, which suits these better."""
    compliance = jnp.asarray(sheet.compliance.T)
    start = jnp.asarray(sheet.positions.T)

    def steps(x: jax.Array, compliance: jax.Array, count: jax.Array) -> jax.Array:
        def step(_: jax.Array, state: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
            x, v = state
            v = v + sheet.step * nodal(x) * compliance
            return x + sheet.step * v, v

        return jax.lax.fori_loop(0, count, step, (x, jnp.zeros_like(x)))[0]

    options = compiler_options() | {"xla_backend_optimization_level": 3}
    program = jax.jit(steps).lower(start, compliance, jnp.int32(1)).compile(options)
    return lambda count: program(start, compliance, jnp.int32(count))


def own_formulation(
    sheet: Sheet,
    dtype: Any = jnp.float64,
    block: int | None = None,
    law: Law = LAW,
    *,
    paired: bool = True,
) -> Callable[[int], Any]:
    """Runs so many steps with the force of `jaxform`, positions (3, n_node) of which come back."""
    usual = blocks.BLOCK
    blocks.BLOCK = packing.BLOCK = block or usual
    try:
        return _own(packed_formulation(sheet, paired=paired), sheet, dtype, law)
    finally:
        blocks.BLOCK = packing.BLOCK = usual


def _own(whole: packing.Packed, sheet: Sheet, dtype: Any, law: Law) -> Callable[[int], Any]:
    cast = lambda tree: jax.tree.map(lambda a: a.astype(dtype) if a.dtype == jnp.float64 else a, tree)  # noqa: E731
    whole = cast(whole)
    fixed = cast((whole.pack(jnp.asarray(sheet.compliance.T)), jnp.full(whole.element.size, THICKNESS), law))
    start = whole.pack(jnp.asarray(sheet.positions.T, dtype))
    step, pressure = jnp.asarray(sheet.step, dtype), jnp.asarray(PRESSURE, dtype)

    def steps(x: jax.Array, whole: packing.Packed, fixed: Any, count: jax.Array) -> jax.Array:
        compliance, thickness, law = fixed

        def advance(_: jax.Array, state: Any) -> Any:
            x, v, corners, volume = state
            load = Load(x, thickness, pressure, law)
            corners, volume = corner_forces(load, whole.elements, corners)
            nodal = gather_shares(corners, _shares(whole.elements))
            v = [w + step * f * c for w, f, c in zip(v, nodal, compliance, strict=True)]
            return vector(a + step * w for a, w in zip(x, v, strict=True)), v, corners, volume

        room = allocate_corner_forces(x, whole.elements)
        state = unstack_rows(x), list(jnp.zeros_like(x)), room, jnp.zeros((), dtype)
        return whole.unpack(jnp.stack(jax.lax.fori_loop(0, count, advance, state)[0]))

    program = compile_function(jax.jit(steps), start, whole, fixed, jnp.int32(1))
    return lambda count: program(start, whole, fixed, jnp.int32(count))

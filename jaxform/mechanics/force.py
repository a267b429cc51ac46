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
import jax.numpy as jnp

from jaxform.kernels.blocks import materialize, over_blocks
from jaxform.kernels.opaque_primitive import TwiceDifferentiable
from jaxform.mechanics.constitutive import stress_and_change, weighted_stress
from jaxform.mechanics.corners import (
    Load,
    corner_force_tangent,
    corner_forces,
    corner_shares,
    edge_forces,
    metric_change,
    pressure_share,
    scale,
)
from jaxform.mechanics.elements import (
    Corners,
    Elements,
    add_overflow,
    allocate_corner_forces,
    by_region,
    combine_pairs,
    edge_vectors,
    element_block,
    element_normals,
    nodal_sum,
    on_elements,
    orient,
    region_count,
    sum_regions,
    usage_factor,
)
from jaxform.mechanics.membrane import Vector, cross, dot, metric, minus, plus, unstack_rows

# The way back over the elements: from cotangents of the nodal forces to those of all that these depend on.


def corner_cotangents(
    load: Load,
    elements: Elements,
    wanted: list[bool],
    nodal: jax.Array | None,
    volume: jax.Array | None,
    into: Corners,
    summed: list[jax.Array],
    *,
    forces: bool = False,
) -> tuple[Corners, list[jax.Array], list[jax.Array]]:
    """Transpose of `corner_forces`' derivative, from cotangents of the nodal force (3, place) and of the volume.

    Args:
        load: Arguments of the force.
        elements: Its elements.
        wanted: Flags of the leaves of the load; of the material and the memory those of the response's numbers, in
            their order.
        nodal: Cotangent of the nodal force; None where there is none.
        volume: That of the volume; None where there is none.
        into: Workspace for corner forces, from `allocate_corner_forces`; empty where the positions' cotangent is not
            wanted.
        summed: Sums over steps that are added to, those of `zero_sums`.
        forces: True if `corner_forces` is computed along with it, since it shares most of the work; `into` then also
            holds the corners' forces, after their cotangents.

    Returns:
        The corners' cotangents, the sums, and the cotangents of the pressure and of all the response's numbers that
        do not vary, as far as they are wanted; with the forces the enclosed volume [m^3] comes last.
    """
    pushed = None if nodal is None else unstack_rows(nodal)
    looked = [unstack_rows(load.positions)] + ([] if pushed is None else [pushed])
    moves, thickens, presses = wanted[:3]
    response = load.response
    zones, single, wanted_zones = response.zones, response.single, _differentiated_zones(load, wanted)
    varies = any(want for name, want in zip(response.numbers, wanted[3:], strict=True) if name in single)

    def compute_block(*blocks: Any) -> Any:
        old, (block, thickness, zones) = (list(blocks[0]), blocks[1:]) if summed else ([], blocks)
        present = response.with_numbers(zones)
        (first, edge1, edge2), *pushes = sides = edge_vectors(block, *looked)
        normal, inverse, area = element_normals(sides[0], block), block.inverse_metric, block.area
        weight, pressure = area * thickness, pressure_share(load.pressure, block)
        sums: list[jax.Array] = []
        force_shares: list[Vector] = []
        first_cotangent = edge1_cotangent = edge2_cotangent = scale(jnp.zeros_like(area), normal)
        turn = first_cotangent
        if pushed is not None:
            w0, w1, w2 = pushes[0]
            total = plus(scale(3.0, w0), plus(w1, w2))
            g, g_change = metric(edge1, edge2), materialize(metric_change(edge1, edge2, w1, w2))
            s, ds = stress_and_change(g, g_change, inverse, weight, present)
            if forces:
                push = scale(on_elements(load.pressure, block.regions) / 6.0, normal)
                force_shares = corner_shares(push, *edge_forces(s, edge1, edge2))
            if moves:
                pull1, pull2 = edge_forces(ds, edge1, edge2)
                more1, more2 = edge_forces(s, w1, w2)
                edge1_cotangent = scale(-1.0, plus(pull1, more1))
                edge2_cotangent = scale(-1.0, plus(pull2, more2))
                turn = scale(pressure, total)
            # Minus half the change of the metric, against the derivative of the stress.
            half_change = (-0.5 * g_change[0], -g_change[1], -0.5 * g_change[2])
            if thickens:
                old[0] = [old[0][0] + dot(half_change, s)]
            if presses:
                sums.extend(by_region(dot(normal, total) / 6.0, block.regions))
            if varies or wanted_zones:
                spread = {name: zones[name] for name in wanted_zones}
                if varies:
                    # Each number of a list has a row.
                    spread |= {name: _rows(number, area.size) for name, number in single.items()}
                pull = jax.vjp(lambda p: weighted_stress(g, inverse, weight, present.with_numbers(p)), spread)[1]
                found = {name: list(rows.reshape(-1, area.size)) for name, rows in pull(half_change)[0].items()}
                for k, name in enumerate(wanted_zones, int(thickens)):
                    old[k] = [x + row for x, row in zip(old[k], found[name], strict=True)]
                if varies:
                    sums.extend(row for name in single for row in found[name])
        if volume is not None and moves:
            pushed_out = on_elements(volume, block.regions)
            share = usage_factor(area) * (pushed_out / 6.0)
            turn = plus(turn, scale(share, minus(first, elements.origin)))
            first_cotangent = scale(pushed_out / 6.0, normal)
        if forces:
            sums.extend(by_region(dot(minus(first, elements.origin), normal) / 6.0, block.regions))
        if not moves:
            return old, sums
        turn = materialize(orient(turn, block))
        cotangent1 = materialize(plus(edge1_cotangent, cross(edge2, turn)))
        cotangent2 = materialize(plus(edge2_cotangent, cross(turn, edge1)))
        first_cotangent = minus(minus(first_cotangent, cotangent1), cotangent2)
        corners = list(zip(first_cotangent, cotangent1, cotangent2, strict=True)) + force_shares
        return [*old, *combine_pairs(corners, block)], sums

    numbers = sum(number.size for number in single.values()) if varies else 0
    regions = region_count(elements.regions)
    count = 0 if pushed is None else (int(presses) + int(forces)) * regions + numbers
    inputs = element_block(elements), load.thickness, zones
    outputs = [*summed, *into]
    arrays, sums = over_blocks(compute_block, elements.block_count, inputs, outputs, sums=count, update=len(summed))
    corners = [array for k in range(len(summed), len(arrays), 3) for array in add_overflow(arrays[k : k + 3], elements)]
    if numbers and pushed is not None:
        begin = int(presses) * regions
        sums[begin : begin + numbers] = _order_sums(sums[begin : begin + numbers], list(single.values()))
    return corners, arrays[: len(summed)], sums


def zero_sums(load: Load, wanted: list[bool]) -> list[jax.Array]:
    """Initial zeros of the sums over steps to which `corner_cotangents` adds, element by element.

    Of the logarithm of the thickness (1, capacity) where that is wanted, then of each number of the response that
    varies and is wanted (k, capacity).
    """
    capacity, real = load.thickness.size, load.thickness.dtype
    zones = load.response.zones
    sizes = [zones[name].size // capacity for name in _differentiated_zones(load, wanted)]
    return [jnp.zeros((size, capacity), real) for size in ([1] if wanted[1] else []) + sizes]


def zone_cotangents(load: Load, wanted: list[bool], summed: list[jax.Array]) -> dict[str, jax.Array]:
    """Cotangents of the response's varying parameters that are wanted (..., capacity), by name."""
    names, zones = _differentiated_zones(load, wanted), load.response.zones
    zone_rows = summed[int(wanted[1]) :]
    return {name: rows.reshape(zones[name].shape) for name, rows in zip(names, zone_rows, strict=True)}


def _differentiated_zones(load: Load, wanted: list[bool]) -> list[str]:
    zones = load.response.zones
    return [name for name, want in zip(load.response.numbers, wanted[3:], strict=True) if want and name in zones]


def _rows(number: jax.Array, size: int) -> jax.Array:
    return jnp.broadcast_to(number[..., None], (*number.shape, size))


def _order_sums(sums: list[jax.Array], parameters: list[jax.Array]) -> list[jax.Array]:
    """Sums, one for each number, in the shapes of the parameters."""
    left = iter(sums)
    return [jnp.stack([next(left) for _ in p]) if p.ndim else next(left) for p in parameters]


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
        count = region_count(elements.regions)
        found[2], sums = sum_regions(sums[:count], elements.regions), sums[count:]
    numbers = zone_cotangents(load, wanted, summed) | dict(zip(load.response.single, sums, strict=False))
    for k, name in enumerate(load.response.numbers, 3):
        found[k] = numbers[name] if wanted[k] else None
    return found


_differentiated = TwiceDifferentiable("membrane_force", _force, _tangent, _cotangent)

"""The nodal force of the sheet and its hand-written derivative, forward and reverse.

The force is a JAX primitive of its own. Plain automatic differentiation would store every intermediate of every
element at every step; here the derivative needs the positions alone and works the rest out again. A `custom_vjp`
would shut out forward mode, which least-squares columns and the search for the stable step need; the primitive has a
tangent (linear in its perturbations), the transpose of that tangent, and batching.

All three work through the elements in blocks and write what each corner gets; the nodes then gather it. The barriers
keep XLA from working the element out anew for each of the nine components. `benchmarks/` times this against the
formulations that lost.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from jaxform.core.parameters import ranges_of
from jaxform.kernels.blocks import once, over_blocks
from jaxform.kernels.differentiated import Differentiated
from jaxform.materials import Law
from jaxform.mechanics.elements import (
    Corners,
    Elements,
    Own,
    no_corners,
    nodal_sum,
    normal_of,
    over_elements,
    own_of,
    sides_of,
    together,
    turned,
    used,
    with_overflow,
)
from jaxform.mechanics.membrane import (
    Metric,
    Vector,
    cross,
    dot,
    metric,
    minus,
    plus,
    rows_of,
    stress,
    stress_factors,
)


class Load(NamedTuple):
    """What the force depends on smoothly.

    Attributes:
        positions: (3, place) [m]; or its rows, where no derivative is taken.
        thickness: Initial thickness (room,) [m].
        pressure: A number [Pa].
        material: The law with its parameters; those that vary over the sheet for each element (..., room).
    """

    positions: Any
    thickness: jax.Array
    pressure: jax.Array
    material: Law


def force(load: Load, elements: Elements) -> tuple[jax.Array, jax.Array]:
    """Nodal force (3, place) [N], internal and pressure together, and the enclosed volume [m^3].

    The volume is what the pressure works on: its derivative with respect to the positions of nodes that can move,
    times the pressure, is the nodal force of the pressure.
    """
    return _differentiated(load, elements)


def corner_changes(load: Load, elements: Elements, moved: jax.Array, into: Corners) -> Corners:
    """Change of the corner forces [N] of each element as positions change by `moved` (3, place) [m].

    Not differentiable; written `into` room as by `corner_forces`.
    """
    none = jax.tree.map(lambda _: None, load)
    return _corner_changes(load, elements, none._replace(positions=moved), into)[0]


def corner_forces(load: Load, elements: Elements, into: Corners) -> tuple[Corners, jax.Array]:
    """The corner forces [N] of each element, and the enclosed volume [m^3]; not differentiable.

    It is written `into` room from `no_corners`: carried from step to step, it is neither cleared nor copied.
    """
    rows = rows_of(load.positions)

    def work(own: Own, thickness: jax.Array, zones: Any) -> Any:
        (sides,) = sides_of(own, rows)
        (first, edge1, edge2), normal = sides, normal_of(sides, own)
        inverse, area = own.inverse_metric, own.area
        g = metric(edge1, edge2)
        factors = stress_factors(g, inverse, load.material.with_zones(zones))
        factors = once((area * thickness * factors[0], area * thickness * factors[1]))
        s = once(stress(g, inverse, factors))
        push = _scaled(load.pressure / 6.0, normal)
        pull2, pull3 = _pulls(s, edge1, edge2)
        arm = minus(first, elements.origin)
        return together(_shares(push, pull2, pull3), own), [dot(arm, normal)]

    corners, (volume,) = over_elements(work, elements, (load.thickness, load.material.zones), into)
    return with_overflow(corners, elements), volume / 6.0


def _pressure_share(pressure: jax.Array, area: jax.Array) -> jax.Array:
    """A node's share of the pressure on an element (n,) [Pa]: nothing where the place is not in use."""
    return jnp.where(area > 0.0, pressure / 6.0, 0.0)


def _scaled(factor: jax.Array | float, v: Vector) -> Vector:
    return factor * v[0], factor * v[1], factor * v[2]


def _shares(push: Vector, pull2: Vector, pull3: Vector) -> list[Vector]:
    """The forces of the three corners, component by component."""
    return [(p + a + b, p - a, p - b) for p, a, b in zip(push, pull2, pull3, strict=True)]


def _pulls(s: Metric, edge1: Vector, edge2: Vector) -> tuple[Vector, Vector]:
    """S^1b e_b and S^2b e_b."""
    return (
        plus(_scaled(s[0], edge1), _scaled(s[1], edge2)),
        plus(_scaled(s[1], edge1), _scaled(s[2], edge2)),
    )


def _weighted_stress(g: Metric, inverse: jax.Array, weight: jax.Array, material: Law) -> Metric:
    """A0 h0 S^ab (n,): what multiplies the edges in the nodal forces."""
    a, b = stress_factors(g, inverse, material)
    return stress(g, inverse, (weight * a, weight * b))


def _stress_and_change(
    g: Metric, change: Metric, inverse: jax.Array, weight: jax.Array, material: Law
) -> tuple[Metric, Metric]:
    """A0 h0 S^ab, and its change along that of the metric (n,)."""

    def factors(g: Metric) -> tuple[jax.Array, jax.Array]:
        a, b = stress_factors(g, inverse, material)
        return weight * a, weight * b

    # Both divide; kept, they are worked out once instead of for each of the six components.
    own, rate = once(jax.jvp(factors, (g,), (change,)))
    b = own[1]
    s = stress(g, inverse, own)
    ds = plus(stress(g, inverse, rate), (b * change[2], -b * change[1], b * change[0]))
    return once((s, ds))


def _force(load: Load, elements: Elements) -> tuple[jax.Array, jax.Array]:
    corners, volume = corner_forces(load, elements, no_corners(load.positions, elements))
    return nodal_sum(corners, elements), volume


def _metric_change(edge1: Vector, edge2: Vector, w1: Vector, w2: Vector) -> Metric:
    return 2.0 * dot(edge1, w1), dot(edge1, w2) + dot(w1, edge2), 2.0 * dot(edge2, w2)


def _tangent(load: Load, elements: Elements, change: Load) -> tuple[jax.Array, jax.Array]:
    """Derivative of `_force` along `change`, linear in it; a missing part of `change` is None."""
    corners, volume = _corner_changes(load, elements, change, no_corners(load.positions, elements))
    return nodal_sum(corners, elements), volume


def _corner_changes(load: Load, elements: Elements, change: Load, into: Corners) -> tuple[Corners, jax.Array]:
    """As `corner_forces`, of the derivative along `change`."""
    moved = None if change.positions is None else rows_of(change.positions)
    looked = [rows_of(load.positions)] + ([] if moved is None else [moved])
    thickened = () if change.thickness is None else (change.thickness,)
    zones, changed_numbers = load.material.zones, _numbers_of(load.material, change.material)
    zone_changes = {name: changed_numbers.pop(name) for name in zones if name in changed_numbers}

    def work(own: Own, thickness: jax.Array, zones: Any, zone_changes: Any, *more: jax.Array) -> Any:
        material = load.material.with_zones(zones)
        (first, edge1, edge2), *changed = sides = sides_of(own, *looked)
        normal, inverse, area = normal_of(sides[0], own), own.inverse_metric, own.area
        g, weight, share = metric(edge1, edge2), area * thickness, _pressure_share(load.pressure, area)
        changes: list[Metric] = []
        pull2 = pull3 = push = _scaled(jnp.zeros_like(area), normal)
        volume = jnp.zeros_like(area)
        if moved is not None:
            w0, w1, w2 = changed[0]
            s, ds = _stress_and_change(g, _metric_change(edge1, edge2, w1, w2), inverse, weight, material)
            pull2, pull3 = _pulls(s, w1, w2)
            changes.append(ds)
            normal_change = turned(plus(cross(w1, edge2), cross(edge1, w2)), own)
            push = _scaled(share, normal_change)
            volume = used(area) * (dot(w0, normal) + dot(minus(first, elements.origin), normal_change))
        for thicker in more:
            changes.append(_weighted_stress(g, inverse, area * thicker, material))
        for name, tangent in (changed_numbers | zone_changes).items():
            changes.append(_along_number(g, inverse, weight, material, name, tangent))
        if changes:
            total = changes[0]
            for part in changes[1:]:
                total = plus(total, part)
            more2, more3 = _pulls(once(total), edge1, edge2)
            pull2, pull3 = plus(pull2, more2), plus(pull3, more3)
        if change.pressure is not None:
            push = plus(push, _scaled(change.pressure / 6.0, normal))
        pull2, pull3, push = once((pull2, pull3, push))
        return together(_shares(push, pull2, pull3), own), [volume]

    inputs = load.thickness, zones, zone_changes, *thickened
    corners, (volume,) = over_elements(work, elements, inputs, into)
    return with_overflow(corners, elements), volume / 6.0


def _numbers_of(material: Law, change: Any) -> dict[str, jax.Array]:
    """The changes of a law's numbers, by name, of a tree like it with None where there is none."""
    changes = jax.tree.structure(material).flatten_up_to(change)
    return {name: each for name, each in zip(ranges_of(material), changes, strict=True) if each is not None}


def _along_number(
    g: Metric, inverse: jax.Array, weight: jax.Array, material: Law, name: str, tangent: jax.Array
) -> Metric:
    """Change of the weighted stress along one number of the material."""

    def along(value: jax.Array) -> Metric:
        return _weighted_stress(g, inverse, weight, material.with_zones({name: value}))

    return jax.jvp(along, (getattr(material, name),), (tangent,))[1]


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
        load: What the force is worked out for.
        elements: Its elements.
        wanted: Which leaves of the load; of the material those of its numbers, in their order.
        nodal: Cotangent of the nodal force; None where there is none.
        volume: That of the volume; None where there is none.
        into: Room for corner forces, from `no_corners`; empty where the positions' cotangent is not wanted.
        summed: Sums over steps that are added to, those of `no_sums`.
        forces: Whether `corner_forces` is worked out along with it, since most of it is at hand; `into` then has room
            for the corners' cotangents and, after them, their forces.

    Returns:
        The corners' cotangents, the sums, and the cotangents of the pressure and of all the material's numbers that
        do not vary, as far as they are wanted; with the forces the enclosed volume [m^3] comes last.
    """
    pushed = None if nodal is None else rows_of(nodal)
    looked = [rows_of(load.positions)] + ([] if pushed is None else [pushed])
    moves, thickens, presses = wanted[:3]
    zones, names, wanted_zones = load.material.zones, _single(load.material), _wanted_zones(load, wanted)
    varies = any(want for name, want in zip(ranges_of(load.material), wanted[3:], strict=True) if name in names)

    def work(*blocks: Any) -> Any:
        old, (block, thickness, zones) = (list(blocks[0]), blocks[1:]) if summed else ([], blocks)
        material = load.material.with_zones(zones)
        (first, edge1, edge2), *pushes = sides = sides_of(block, *looked)
        normal, inverse, area = normal_of(sides[0], block), block.inverse_metric, block.area
        weight, pressure = area * thickness, _pressure_share(load.pressure, area)
        sums: list[jax.Array] = []
        own_shares: list[Vector] = []
        own = edge1_cotangent = edge2_cotangent = _scaled(jnp.zeros_like(area), normal)
        turn = own
        if pushed is not None:
            w0, w1, w2 = pushes[0]
            total = plus(_scaled(3.0, w0), plus(w1, w2))
            g, g_change = metric(edge1, edge2), once(_metric_change(edge1, edge2, w1, w2))
            s, ds = _stress_and_change(g, g_change, inverse, weight, material)
            if forces:
                own_shares = _shares(_scaled(load.pressure / 6.0, normal), *_pulls(s, edge1, edge2))
            if moves:
                pull1, pull2 = _pulls(ds, edge1, edge2)
                more1, more2 = _pulls(s, w1, w2)
                edge1_cotangent = _scaled(-1.0, plus(pull1, more1))
                edge2_cotangent = _scaled(-1.0, plus(pull2, more2))
                turn = _scaled(pressure, total)
            # Minus half the change of the metric, against the derivative of the stress.
            half_change = (-0.5 * g_change[0], -g_change[1], -0.5 * g_change[2])
            if thickens:
                old[0] = [old[0][0] + dot(half_change, s)]
            if presses:
                sums.append(dot(normal, total) / 6.0)
            if varies or wanted_zones:
                spread = {name: zones[name] for name in wanted_zones}
                if varies:
                    # Of a list of numbers each has a row.
                    spread |= {name: _rows(getattr(material, name), area.size) for name in names}
                pull = jax.vjp(lambda p: _weighted_stress(g, inverse, weight, material.with_zones(p)), spread)[1]
                found = {name: list(rows.reshape(-1, area.size)) for name, rows in pull(half_change)[0].items()}
                for k, name in enumerate(wanted_zones, int(thickens)):
                    old[k] = [x + own for x, own in zip(old[k], found[name], strict=True)]
                if varies:
                    sums.extend(row for name in names for row in found[name])
        if volume is not None and moves:
            share = used(area) * (volume / 6.0)
            turn = plus(turn, _scaled(share, minus(first, elements.origin)))
            own = _scaled(volume / 6.0, normal)
        if forces:
            sums.append(dot(minus(first, elements.origin), normal) / 6.0)
        if not moves:
            return old, sums
        turn = once(turned(turn, block))
        cotangent1 = once(plus(edge1_cotangent, cross(edge2, turn)))
        cotangent2 = once(plus(edge2_cotangent, cross(turn, edge1)))
        own = minus(minus(own, cotangent1), cotangent2)
        corners = list(zip(own, cotangent1, cotangent2, strict=True)) + own_shares
        return [*old, *together(corners, block)], sums

    parameters = [getattr(load.material, name) for name in names]
    numbers = sum(p.size for p in parameters) if varies else 0
    count = 0 if pushed is None else int(presses) + numbers + int(forces)
    inputs = own_of(elements), load.thickness, zones
    room = [*summed, *into]
    arrays, sums = over_blocks(work, elements.block_count, inputs, room, sums=count, update=len(summed))
    corners = [
        array for k in range(len(summed), len(arrays), 3) for array in with_overflow(arrays[k : k + 3], elements)
    ]
    if numbers and pushed is not None:
        begin = int(presses)
        sums[begin : begin + numbers] = _listed(sums[begin : begin + numbers], parameters)
    return corners, arrays[: len(summed)], sums


def no_sums(load: Load, wanted: list[bool]) -> list[jax.Array]:
    """What `corner_cotangents` adds to, element by element, where nothing was summed yet.

    Of the logarithm of the thickness (1, room) where that is wanted, then of each number of the law that varies and is
    wanted (k, room).
    """
    room, real = load.thickness.size, load.thickness.dtype
    sizes = [getattr(load.material, name).size // room for name in _wanted_zones(load, wanted)]
    return [jnp.zeros((size, room), real) for size in ([1] if wanted[1] else []) + sizes]


def zone_cotangents(load: Load, wanted: list[bool], summed: list[jax.Array]) -> dict[str, jax.Array]:
    """Of the law's numbers that vary and are wanted (..., room), by name, what they came to."""
    names = _wanted_zones(load, wanted)
    own = summed[int(wanted[1]) :]
    return {name: rows.reshape(getattr(load.material, name).shape) for name, rows in zip(names, own, strict=True)}


def _wanted_zones(load: Load, wanted: list[bool]) -> list[str]:
    zones = load.material.zones
    return [name for name, want in zip(ranges_of(load.material), wanted[3:], strict=True) if want and name in zones]


def _single(material: Law) -> list[str]:
    """The names of a law's numbers that do not vary over the sheet."""
    zones = material.zones
    return [name for name in ranges_of(material) if name not in zones]


def _rows(number: jax.Array, size: int) -> jax.Array:
    return jnp.broadcast_to(number[..., None], (*number.shape, size))


def _listed(sums: list[jax.Array], parameters: list[jax.Array]) -> list[jax.Array]:
    """Sums, one for each number, in the shapes of the parameters."""
    left = iter(sums)
    return [jnp.stack([next(left) for _ in p]) if p.ndim else next(left) for p in parameters]


def _cotangent(load: Load, elements: Elements, wanted: list[bool], nodal: Any, volume: Any) -> list[jax.Array | None]:
    """Transpose of `_tangent`: from cotangents of force and volume to those of the leaves of the load."""
    into = no_corners(load.positions, elements) if wanted[0] else []
    if nodal is None:
        wanted = [wanted[0], *(False for _ in wanted[1:])]
    thickens, presses = wanted[1:3]
    corners, summed, sums = corner_cotangents(load, elements, wanted, nodal, volume, into, no_sums(load, wanted))
    found: list[jax.Array | None] = [None] * len(wanted)
    if wanted[0]:
        found[0] = nodal_sum(corners, elements)
    if thickens:
        found[1] = summed[0][0] / load.thickness
    if presses:
        found[2] = sums.pop(0)
    numbers = zone_cotangents(load, wanted, summed) | dict(zip(_single(load.material), sums, strict=False))
    for k, name in enumerate(ranges_of(load.material), 3):
        found[k] = numbers[name] if wanted[k] else None
    return found


_differentiated = Differentiated("membrane_force", _force, _tangent, _cotangent)

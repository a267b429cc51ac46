"""The corner forces of the elements, their tangents, and the history of the Prony terms.

All loop over blocks of elements and write the force of each corner; the nodes then sum them. The barriers keep XLA from
recomputing an element for each of the nine components.
"""

from __future__ import annotations

import dataclasses
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from jaxform.kernels.blocks import materialize, over_blocks
from jaxform.materials import Law, Modes, Recursion
from jaxform.materials.viscous import Rows
from jaxform.mechanics.constitutive import (
    Overstress,
    Response,
    ViscousMemory,
    materialize_stress,
    overstress,
    stress_and_change,
    weighted_stress,
)
from jaxform.mechanics.elements import (
    Corners,
    ElementBlock,
    Elements,
    add_overflow,
    by_region,
    combine_pairs,
    edge_vectors,
    element_block,
    element_metrics,
    element_normals,
    map_elements,
    on_elements,
    orient,
    region_count,
    sum_regions,
    usage_factor,
)
from jaxform.mechanics.membrane import Metric, Vector, cross, dot, edges, metric, minus, plus, unstack_rows


class Load(NamedTuple):
    """Differentiable arguments of the force.

    Attributes:
        positions: (3, place) [m]; or its rows, where no derivative is taken.
        thickness: Initial thickness (capacity,) [m].
        pressure: A number [Pa]; of loads of regions (n_load,).
        material: The law with its parameters; those that vary over the sheet for each element (..., capacity).
        memory: History of the Prony terms (..., capacity); None without Prony terms.
    """

    positions: Any
    thickness: jax.Array
    pressure: jax.Array
    material: Law
    memory: ViscousMemory | None = None

    @property
    def response(self) -> Response:
        """The constitutive response of the elements."""
        return Response(self.material, self.memory)


def corner_force_changes(load: Load, elements: Elements, moved: jax.Array, into: Corners) -> Corners:
    """Change of the corner forces [N] of each element as positions change by `moved` (3, place) [m].

    Not differentiable; written into arrays as by `corner_forces`.
    """
    none = jax.tree.map(lambda _: None, load)
    return corner_force_tangent(load, elements, none._replace(positions=moved), into)[0]


def corner_forces(load: Load, elements: Elements, into: Corners) -> tuple[Corners, jax.Array]:
    """The corner forces [N] of each element, and the enclosed volume [m^3]; not differentiable.

    It is written `into` arrays of `allocate_corner_forces`: carried from step to step, they are neither cleared nor
    copied.
    """
    rows, response = unstack_rows(load.positions), load.response

    def compute_block(block: ElementBlock, thickness: jax.Array, zones: Any) -> Any:
        corners, volume, _ = _forces(
            rows, block, thickness, load.pressure, elements.origin, response.with_numbers(zones)
        )
        return combine_pairs(corners, block), by_region(volume, block.regions)

    count = region_count(elements.regions)
    corners, volumes = map_elements(compute_block, elements, (load.thickness, response.zones), into, count)
    return add_overflow(corners, elements), sum_regions(volumes, elements.regions) / 6.0


HistoryUpdate = tuple[jax.Array, jax.Array]
"""History of the elements after a step (4 n_mode, capacity), and the dissipated power [W]."""


def viscous_corner_forces(
    load: Load, elements: Elements, into: Corners, modes: Modes, recursion: Recursion
) -> tuple[Corners, jax.Array, HistoryUpdate]:
    """`corner_forces` and the history of the elements after a step with that recursion, updated in place."""
    rows, response, memory = unstack_rows(load.positions), load.response, load.memory
    assert memory is not None
    zones = {name: values for name, values in response.zones.items() if name != "memory.history"}

    def compute_block(
        old: Any, block: ElementBlock, thickness: jax.Array, zones: Any, varying: Any, block_modes: Any
    ) -> Any:
        # As they are: put together, the rows would be copied.
        present = response.with_numbers(zones | {"memory.history": old[0]})
        corners, volume, found = _forces(rows, block, thickness, load.pressure, elements.origin, present)
        assert found is not None
        rate = (block_modes or modes).loss(found.modes, found.strained)
        lost = jnp.where(block.area > 0.0, block.area * thickness * rate, 0.0)
        sums = [*by_region(volume, block.regions), lost]
        return [found.advance_history(_of_block(recursion, varying)), *combine_pairs(corners, block)], sums

    inputs = element_block(elements), load.thickness, zones, _varying_factors(recursion), _per_element_modes(modes)
    count = region_count(elements.regions) + 1
    (rest, *corners), (*volumes, loss) = over_blocks(
        compute_block, elements.block_count, inputs, [memory.history, *into], sums=count, update=1, kept=False
    )
    return add_overflow(corners, elements), sum_regions(volumes, elements.regions) / 6.0, (rest, loss)


def update_history(load: Load, elements: Elements, modes: Modes, recursion: Recursion) -> HistoryUpdate:
    """The history update alone, differentiable."""
    assert load.memory is not None
    found = overstress(*element_metrics(load.positions, elements), load.memory)
    rate = modes.loss(found.modes, found.strained)
    loss = jnp.where(elements.area > 0.0, elements.area * load.thickness * rate, 0.0)
    return jnp.stack(found.advance_history(recursion)), jnp.sum(loss)


def present_mode_stress(load: Load, elements: Elements, modes: Modes, *, differentiable: bool) -> HistoryUpdate:
    """The stress of the Prony terms at the present positions, and the dissipated power [W]."""
    assert load.memory is not None
    rows, memory = unstack_rows(load.positions), load.memory

    def compute_block(
        g: Metric, inverse: Any, volume: jax.Array, memory: ViscousMemory, modes: Modes
    ) -> tuple[Rows, jax.Array]:
        found = overstress(g, inverse, memory, materialize)
        lost = jnp.where(volume > 0.0, volume * modes.loss(found.modes, found.strained), 0.0)
        return [row for mode in found.modes for row in mode], lost

    if differentiable:
        stress, lost = compute_block(
            *element_metrics(load.positions, elements), elements.area * load.thickness, memory, modes
        )
        return jnp.stack(stress), jnp.sum(lost)
    zones = {"gain": memory.gain} if memory.gain.ndim == 2 else {}

    def update_block(old: Any, triangles: jax.Array, inverse: Any, volume: Any, zones: Any, block_modes: Any) -> Any:
        _, edge1, edge2 = edges(rows, triangles)
        present = dataclasses.replace(memory, history=old[0], **zones)
        stress, lost = compute_block(
            metric(edge1, edge2), inverse, volume[0] * volume[1], present, block_modes or modes
        )
        return [stress], [lost]

    inputs = (
        elements.triangles,
        elements.inverse_metric,
        (elements.area, load.thickness),
        zones,
        _per_element_modes(modes),
    )
    (stress,), (loss,) = over_blocks(
        update_block, elements.block_count, inputs, [memory.history], sums=1, update=1, kept=False
    )
    return stress, loss


def _per_element_modes(modes: Modes) -> Modes | None:
    """Modes that are different for each element."""
    return modes if modes.modulus.ndim == 2 else None


def _of_block(recursion: Recursion, varying: tuple[jax.Array | None, ...]) -> Recursion:
    """A recursion with the factors of a block of elements in place of those that vary."""
    left, gain, back = (whole if own is None else own for whole, own in zip(recursion, varying, strict=True))
    return left, gain, back


def _varying_factors(recursion: Recursion) -> tuple[jax.Array | None, ...]:
    """The factors of a recursion that vary over the elements; None in place of the others."""
    return tuple(factor if factor.ndim == 2 else None for factor in recursion)


def _forces(
    rows: Vector, block: ElementBlock, thickness: jax.Array, pressure: jax.Array, origin: jax.Array, response: Response
) -> tuple[list[Vector], jax.Array, Overstress | None]:
    """The corners' forces, six times the volume below, and what Prony terms do."""
    (sides,) = edge_vectors(block, rows)
    (first, edge1, edge2), normal = sides, element_normals(sides, block)
    g = metric(edge1, edge2)
    s, found = materialize_stress(g, block.inverse_metric, block.area * thickness, response)
    push = scale(on_elements(pressure, block.regions) / 6.0, normal)
    pull2, pull3 = edge_forces(s, edge1, edge2)
    arm = minus(first, origin)
    return corner_shares(push, pull2, pull3), dot(arm, normal), found


def pressure_share(pressure: jax.Array, block: ElementBlock) -> jax.Array:
    """A node's share of the pressure on an element (n,) [Pa]: nothing where the place is not in use."""
    return jnp.where(block.area > 0.0, on_elements(pressure, block.regions) / 6.0, 0.0)


def scale(factor: jax.Array | float, v: Vector) -> Vector:
    """A vector times a factor."""
    return factor * v[0], factor * v[1], factor * v[2]


def corner_shares(push: Vector, pull2: Vector, pull3: Vector) -> list[Vector]:
    """The forces of the three corners, component by component."""
    return [(p + a + b, p - a, p - b) for p, a, b in zip(push, pull2, pull3, strict=True)]


def edge_forces(s: Metric, edge1: Vector, edge2: Vector) -> tuple[Vector, Vector]:
    """S^1b e_b and S^2b e_b."""
    return (
        plus(scale(s[0], edge1), scale(s[1], edge2)),
        plus(scale(s[1], edge1), scale(s[2], edge2)),
    )


def metric_change(edge1: Vector, edge2: Vector, w1: Vector, w2: Vector) -> Metric:
    """Change of the metric as the edges change."""
    return 2.0 * dot(edge1, w1), dot(edge1, w2) + dot(w1, edge2), 2.0 * dot(edge2, w2)


def corner_force_tangent(load: Load, elements: Elements, change: Load, into: Corners) -> tuple[Corners, jax.Array]:
    """Directional derivative of `corner_forces` along `change`, a load with None for constant leaves."""
    moved = None if change.positions is None else unstack_rows(change.positions)
    looked = [unstack_rows(load.positions)] + ([] if moved is None else [moved])
    thickened = () if change.thickness is None else (change.thickness,)
    response, zones = load.response, load.response.zones
    changed = _parameter_changes(load, change)
    zone_changes = {name: changed.pop(name) for name in zones if name in changed}

    def compute_block(
        block: ElementBlock, thickness: jax.Array, zones: Any, zone_changes: Any, *more: jax.Array
    ) -> Any:
        present = response.with_numbers(zones)
        (first, edge1, edge2), *others = sides = edge_vectors(block, *looked)
        normal, inverse, area = element_normals(sides[0], block), block.inverse_metric, block.area
        g, weight, share = metric(edge1, edge2), area * thickness, pressure_share(load.pressure, block)
        changes: list[Metric] = []
        pull2 = pull3 = push = scale(jnp.zeros_like(area), normal)
        volume = jnp.zeros_like(area)
        if moved is not None:
            w0, w1, w2 = others[0]
            s, ds = stress_and_change(g, metric_change(edge1, edge2, w1, w2), inverse, weight, present)
            pull2, pull3 = edge_forces(s, w1, w2)
            changes.append(ds)
            normal_change = orient(plus(cross(w1, edge2), cross(edge1, w2)), block)
            push = scale(share, normal_change)
            volume = usage_factor(area) * (dot(w0, normal) + dot(minus(first, elements.origin), normal_change))
        for thicker in more:
            changes.append(weighted_stress(g, inverse, area * thicker, present))
        for name, tangent in (changed | zone_changes).items():
            changes.append(_parameter_tangent(g, inverse, weight, present, name, tangent))
        if changes:
            total = changes[0]
            for part in changes[1:]:
                total = plus(total, part)
            more2, more3 = edge_forces(materialize(total), edge1, edge2)
            pull2, pull3 = plus(pull2, more2), plus(pull3, more3)
        if change.pressure is not None:
            push = plus(push, scale(on_elements(change.pressure, block.regions) / 6.0, normal))
        pull2, pull3, push = materialize((pull2, pull3, push))
        return combine_pairs(corner_shares(push, pull2, pull3), block), by_region(volume, block.regions)

    inputs = load.thickness, zones, zone_changes, *thickened
    corners, volumes = map_elements(compute_block, elements, inputs, into, region_count(elements.regions))
    return add_overflow(corners, elements), sum_regions(volumes, elements.regions) / 6.0


def _parameter_changes(load: Load, change: Load) -> dict[str, jax.Array]:
    """The changes of the response's numbers that change, by name."""
    tree = load.material, load.memory
    changes = jax.tree.structure(tree).flatten_up_to((change.material, change.memory))
    return {name: each for name, each in zip(load.response.numbers, changes, strict=True) if each is not None}


def _parameter_tangent(
    g: Metric, inverse: jax.Array, weight: jax.Array, response: Response, name: str, tangent: jax.Array
) -> Metric:
    """Change of the weighted stress along one number of the response."""

    def stress_at(value: jax.Array) -> Metric:
        return weighted_stress(g, inverse, weight, response.with_numbers({name: value}))

    return jax.jvp(stress_at, (response.numbers[name],), (tangent,))[1]

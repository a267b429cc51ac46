"""The forces of elements on their corners, and how these change with all that they depend on.

All work through the elements in blocks and write what each corner gets; the nodes then gather it. The barriers keep XLA
from working the element out anew for each of the nine components.
"""

from __future__ import annotations

import dataclasses
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from jaxform.kernels.blocks import once, over_blocks
from jaxform.materials import Law, Modes, Recursion
from jaxform.materials.viscous import Rows
from jaxform.mechanics.elements import (
    Corners,
    Elements,
    Own,
    metrics_of,
    normal_of,
    over_elements,
    own_of,
    sides_of,
    together,
    turned,
    used,
    with_overflow,
)
from jaxform.mechanics.membrane import Metric, Vector, cross, dot, edges, metric, minus, plus, rows_of
from jaxform.mechanics.response import (
    Memory,
    Overstress,
    Response,
    overstress,
    stress_and_change,
    stress_of,
    stress_once,
)


class Load(NamedTuple):
    """What the force depends on smoothly.

    Attributes:
        positions: (3, place) [m]; or its rows, where no derivative is taken.
        thickness: Initial thickness (room,) [m].
        pressure: A number [Pa].
        material: The law with its parameters; those that vary over the sheet for each element (..., room).
        memory: What elements remember, (..., room); None where the law has no viscous modes.
    """

    positions: Any
    thickness: jax.Array
    pressure: jax.Array
    material: Law
    memory: Memory | None = None

    @property
    def response(self) -> Response:
        """How elements answer to strain."""
        return Response(self.material, self.memory)


def corner_changes(load: Load, elements: Elements, moved: jax.Array, into: Corners) -> Corners:
    """Change of the corner forces [N] of each element as positions change by `moved` (3, place) [m].

    Not differentiable; written `into` room as by `corner_forces`.
    """
    none = jax.tree.map(lambda _: None, load)
    return all_changes(load, elements, none._replace(positions=moved), into)[0]


def corner_forces(load: Load, elements: Elements, into: Corners) -> tuple[Corners, jax.Array]:
    """The corner forces [N] of each element, and the enclosed volume [m^3]; not differentiable.

    It is written `into` room from `no_corners`: carried from step to step, it is neither cleared nor copied.
    """
    rows, response = rows_of(load.positions), load.response

    def work(own: Own, thickness: jax.Array, zones: Any) -> Any:
        corners, volume, _ = _forces(rows, own, thickness, load.pressure, elements.origin, response.having(zones))
        return together(corners, own), [volume]

    corners, (volume,) = over_elements(work, elements, (load.thickness, response.zones), into)
    return with_overflow(corners, elements), volume / 6.0


class Remembered(NamedTuple):
    """What a step makes of what elements remember (4 n_mode, room), and the power that is lost [W]."""

    rest: jax.Array
    loss: jax.Array


def corner_forces_remembered(
    load: Load, elements: Elements, into: Corners, modes: Modes, recursion: Recursion
) -> tuple[Corners, jax.Array, Remembered]:
    """As `corner_forces`; with what elements remember after a step with that recursion, written where it was."""
    rows, response, memory = rows_of(load.positions), load.response, load.memory
    assert memory is not None
    zones = {name: values for name, values in response.zones.items() if name != "memory.rest"}
    varying, single = _split(recursion)

    def work(old: Any, own: Own, thickness: jax.Array, zones: Any, varying: Any, own_modes: Any) -> Any:
        # As they are: put together, the rows would be copied.
        present = response.having(zones | {"memory.rest": old[0]})
        corners, volume, found = _forces(rows, own, thickness, load.pressure, elements.origin, present)
        assert found is not None
        rate = (own_modes or modes).loss(found.modes, found.strained)
        lost = jnp.where(own.area > 0.0, own.area * thickness * rate, 0.0)
        return [found.kept(Recursion(**(varying | single))), *together(corners, own)], [volume, lost]

    inputs = own_of(elements), load.thickness, zones, varying, _varying(modes)
    (rest, *corners), (volume, loss) = over_blocks(
        work, elements.block_count, inputs, [memory.rest, *into], sums=2, update=1, kept=False
    )
    return with_overflow(corners, elements), volume / 6.0, Remembered(rest, loss)


def remembered(load: Load, elements: Elements, modes: Modes, recursion: Recursion) -> Remembered:
    """The same alone, differentiable."""
    assert load.memory is not None
    found = overstress(*metrics_of(load.positions, elements), load.memory)
    rate = modes.loss(found.modes, found.strained)
    loss = jnp.where(elements.area > 0.0, elements.area * load.thickness * rate, 0.0)
    return Remembered(jnp.stack(found.kept(recursion)), jnp.sum(loss))


def stresses_now(load: Load, elements: Elements, modes: Modes, *, differentiable: bool) -> Remembered:
    """The stress of the modes at these positions, in place of what is remembered, and the power that is lost."""
    assert load.memory is not None
    rows, memory = rows_of(load.positions), load.memory

    def work(g: Metric, inverse: Any, volume: jax.Array, memory: Memory, modes: Modes) -> tuple[Rows, jax.Array]:
        found = overstress(g, inverse, memory, once)
        lost = jnp.where(volume > 0.0, volume * modes.loss(found.modes, found.strained), 0.0)
        return [row for mode in found.modes for row in mode], lost

    if differentiable:
        stress, lost = work(*metrics_of(load.positions, elements), elements.area * load.thickness, memory, modes)
        return Remembered(jnp.stack(stress), jnp.sum(lost))
    zones = {"gain": memory.gain} if memory.gain.ndim == 2 else {}

    def of_block(old: Any, triangles: jax.Array, inverse: Any, volume: Any, zones: Any, own_modes: Any) -> Any:
        _, edge1, edge2 = edges(rows, triangles)
        present = dataclasses.replace(memory, rest=old[0], **zones)
        stress, lost = work(metric(edge1, edge2), inverse, volume[0] * volume[1], present, own_modes or modes)
        return [stress], [lost]

    inputs = elements.triangles, elements.inverse_metric, (elements.area, load.thickness), zones, _varying(modes)
    (stress,), (loss,) = over_blocks(
        of_block, elements.block_count, inputs, [memory.rest], sums=1, update=1, kept=False
    )
    return Remembered(stress, loss)


def _varying(modes: Modes) -> Modes | None:
    """Modes that are different for each element."""
    return modes if modes.modulus.ndim == 2 else None


def _split(recursion: Recursion) -> tuple[dict[str, jax.Array], dict[str, jax.Array]]:
    """What of it varies over the elements, and what does not."""
    parts = recursion._asdict()
    return {k: v for k, v in parts.items() if v.ndim == 2}, {k: v for k, v in parts.items() if v.ndim < 2}


def _forces(
    rows: Vector, own: Own, thickness: jax.Array, pressure: jax.Array, origin: jax.Array, response: Response
) -> tuple[list[Vector], jax.Array, Overstress | None]:
    """The corners' forces, six times the volume below, and what viscous modes do."""
    (sides,) = sides_of(own, rows)
    (first, edge1, edge2), normal = sides, normal_of(sides, own)
    g = metric(edge1, edge2)
    s, found = stress_once(g, own.inverse_metric, own.area * thickness, response)
    push = scaled(pressure / 6.0, normal)
    pull2, pull3 = pulls(s, edge1, edge2)
    arm = minus(first, origin)
    return shares_of(push, pull2, pull3), dot(arm, normal), found


def pressure_share(pressure: jax.Array, area: jax.Array) -> jax.Array:
    """A node's share of the pressure on an element (n,) [Pa]: nothing where the place is not in use."""
    return jnp.where(area > 0.0, pressure / 6.0, 0.0)


def scaled(factor: jax.Array | float, v: Vector) -> Vector:
    """A vector times a factor."""
    return factor * v[0], factor * v[1], factor * v[2]


def shares_of(push: Vector, pull2: Vector, pull3: Vector) -> list[Vector]:
    """The forces of the three corners, component by component."""
    return [(p + a + b, p - a, p - b) for p, a, b in zip(push, pull2, pull3, strict=True)]


def pulls(s: Metric, edge1: Vector, edge2: Vector) -> tuple[Vector, Vector]:
    """S^1b e_b and S^2b e_b."""
    return (
        plus(scaled(s[0], edge1), scaled(s[1], edge2)),
        plus(scaled(s[1], edge1), scaled(s[2], edge2)),
    )


def metric_change(edge1: Vector, edge2: Vector, w1: Vector, w2: Vector) -> Metric:
    """Change of the metric as the edges change."""
    return 2.0 * dot(edge1, w1), dot(edge1, w2) + dot(w1, edge2), 2.0 * dot(edge2, w2)


def all_changes(load: Load, elements: Elements, change: Load, into: Corners) -> tuple[Corners, jax.Array]:
    """As `corner_forces`, of the derivative along `change`, a load with None for what does not change."""
    moved = None if change.positions is None else rows_of(change.positions)
    looked = [rows_of(load.positions)] + ([] if moved is None else [moved])
    thickened = () if change.thickness is None else (change.thickness,)
    response, zones = load.response, load.response.zones
    changed = _changed_numbers(load, change)
    zone_changes = {name: changed.pop(name) for name in zones if name in changed}

    def work(own: Own, thickness: jax.Array, zones: Any, zone_changes: Any, *more: jax.Array) -> Any:
        present = response.having(zones)
        (first, edge1, edge2), *others = sides = sides_of(own, *looked)
        normal, inverse, area = normal_of(sides[0], own), own.inverse_metric, own.area
        g, weight, share = metric(edge1, edge2), area * thickness, pressure_share(load.pressure, area)
        changes: list[Metric] = []
        pull2 = pull3 = push = scaled(jnp.zeros_like(area), normal)
        volume = jnp.zeros_like(area)
        if moved is not None:
            w0, w1, w2 = others[0]
            s, ds = stress_and_change(g, metric_change(edge1, edge2, w1, w2), inverse, weight, present)
            pull2, pull3 = pulls(s, w1, w2)
            changes.append(ds)
            normal_change = turned(plus(cross(w1, edge2), cross(edge1, w2)), own)
            push = scaled(share, normal_change)
            volume = used(area) * (dot(w0, normal) + dot(minus(first, elements.origin), normal_change))
        for thicker in more:
            changes.append(stress_of(g, inverse, area * thicker, present))
        for name, tangent in (changed | zone_changes).items():
            changes.append(_along_number(g, inverse, weight, present, name, tangent))
        if changes:
            total = changes[0]
            for part in changes[1:]:
                total = plus(total, part)
            more2, more3 = pulls(once(total), edge1, edge2)
            pull2, pull3 = plus(pull2, more2), plus(pull3, more3)
        if change.pressure is not None:
            push = plus(push, scaled(change.pressure / 6.0, normal))
        pull2, pull3, push = once((pull2, pull3, push))
        return together(shares_of(push, pull2, pull3), own), [volume]

    inputs = load.thickness, zones, zone_changes, *thickened
    corners, (volume,) = over_elements(work, elements, inputs, into)
    return with_overflow(corners, elements), volume / 6.0


def _changed_numbers(load: Load, change: Load) -> dict[str, jax.Array]:
    """The changes of the response's numbers that change, by name."""
    tree = load.material, load.memory
    changes = jax.tree.structure(tree).flatten_up_to((change.material, change.memory))
    return {name: each for name, each in zip(load.response.numbers, changes, strict=True) if each is not None}


def _along_number(
    g: Metric, inverse: jax.Array, weight: jax.Array, response: Response, name: str, tangent: jax.Array
) -> Metric:
    """Change of the weighted stress along one number of the response."""

    def along(value: jax.Array) -> Metric:
        return stress_of(g, inverse, weight, response.having({name: value}))

    return jax.jvp(along, (response.numbers[name],), (tangent,))[1]

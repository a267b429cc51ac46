"""Cooling at window boundaries: the temperatures of the elements, and the material parameters at these.

Temperatures are updated at a window's begin, element by element and exactly for the present thickness. Inside a window
the material parameters are those of the temperature in its middle.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp

from jaxform.kernels.blocks import over_blocks
from jaxform.materials import Law
from jaxform.mechanics import membrane
from jaxform.mechanics.elements import Elements, masked_metrics
from jaxform.model.scene import Scene
from jaxform.sheet.active_set import ActiveSet
from jaxform.sheet.energy_balance import stored_energy
from jaxform.sheet.heat import ThermalState, at_temperature, temperature_change, tool_contact
from jaxform.sheet.state import PackedState, can_move


def cool_state(
    state: PackedState, scene: Scene, active: ActiveSet, *, differentiable: bool
) -> tuple[PackedState, ActiveSet]:
    """The state at a window boundary and the active set, with the present temperatures."""
    cooling, heat, initial, elements = scene.cooling, state.heat, active.initial, active.packed.elements
    if cooling is None or heat is None or initial is None:
        return state, active
    nodes, time, law = state.nodes, state.time, scene.material
    longest = scene.tables.longest_window * state.control.step_length
    positions, velocities = nodes.positions, nodes.velocities
    if not differentiable:
        positions, velocities = membrane.unstack_rows(positions), membrane.unstack_rows(velocities)
    numbers = (active.zones, active.modes) if law.shift is not None else None
    memory = state.memory if scene.stiffens else None

    def compute_block(own: Any, before: ThermalState, initial: Any, numbers: Any, memory: jax.Array | None) -> Any:
        (triangles, inverse, area, thickness), (first, first_zones) = own, initial
        _, *edges = membrane.edges(positions, triangles)
        there = can_move(nodes.stuck, triangles, area)
        determinant = membrane.invariants(*masked_metrics(there, membrane.metric(*edges), inverse)).determinant
        share, now = tool_contact(scene, nodes, triangles, before.time, time), jnp.broadcast_to(time, there.shape)
        density, wall = first_zones.get("density", law.density), thickness / jnp.sqrt(determinant)
        change = temperature_change(before, cooling, first, wall, share, density, time)
        share = tool_contact(scene, nodes, triangles, now, time)
        # The window is taken to be as long as the last one; a retried window begins as it did before.
        middle = time + 0.5 * jnp.minimum(time - before.time, longest)
        felt = temperature_change(ThermalState(change, now, change), cooling, first, wall, share, density, middle)
        due = there & (time > before.time)
        after = jax.tree.map(lambda new, old: jnp.where(due, new, old), ThermalState(change, now, felt), before)
        rows = [[after.change], [after.time], [after.felt]]
        sums, cooling_rate = [], jnp.where(there, jnp.abs(cooling.pace(first + change, wall, share, density)), 0.0)
        if numbers is not None:
            rows += _rows(at_temperature(law, first_zones, first + after.felt))
        if numbers is not None and scene.stiffens:
            ratio = _stiffness_factor(law, first, before, after)
            # Velocities are half a step behind the positions, and with the next step the new stress acts from there on.
            half = 0.5 * state.control.step_length
            _, *rates = membrane.edges(velocities, triangles)
            behind = (
                membrane.vector(x - half * v for x, v in zip(*pair, strict=True))
                for pair in zip(edges, rates, strict=True)
            )
            metrics, (zones, modes) = masked_metrics(there, membrane.metric(*behind), inverse), numbers
            sums = [area * thickness * (1.0 - ratio) * stored_energy(*metrics, law.with_zones(zones), modes, memory)]
        if memory is not None:
            rows.append([ratio * row for row in memory])
        return rows, [*sums, jax.lax.stop_gradient(cooling_rate)]

    own = elements.triangles, elements.inverse_metric, elements.area, active.thickness
    held, kinds = jax.tree.flatten((heat, numbers, memory))
    into = [values.reshape(-1, values.shape[-1]) for values in held]
    inputs = own, heat, initial, numbers, memory
    blocks, sums = elements.block_count, int(scene.stiffens)
    found, (*lost, cooling_rate) = over_blocks(
        compute_block, blocks, inputs, into, sums=sums, most=1, whole=differentiable
    )
    made = [values.reshape(old.shape) for values, old in zip(found, held, strict=True)]
    before, (heat, numbers, memory) = heat, jax.tree.unflatten(kinds, made)
    account = state.account
    if account.cooling_loss is not None:
        account = dataclasses.replace(account, cooling_loss=account.cooling_loss + sum(lost))
    if nodes.temperature is not None:
        change = _nodal_mean(heat.felt - before.felt, elements)
        state = state.replace_nodes(temperature=nodes.temperature + change)
    state = dataclasses.replace(
        state,
        heat=heat,
        memory=state.memory if memory is None else memory,
        account=account,
        control=dataclasses.replace(state.control, cooling_rate=cooling_rate),
    )
    if numbers is None:
        return state, active
    return state, dataclasses.replace(active, zones=numbers[0], modes=numbers[1])


def _nodal_mean(values: jax.Array, elements: Elements) -> jax.Array:
    """Mean (place,) at the nodes of values (capacity,) of their elements, by area; 0 where they have none."""
    area = elements.area
    rows = area, jnp.where(area > 0.0, area * values, 0.0)
    total, found = (membrane.sum_to_nodes(row, elements.triangles, elements.slots.shape[1]) for row in rows)
    return found / jnp.where(total > 0.0, total, 1.0)


def _rows(numbers: Any) -> list[list[jax.Array]]:
    """Numbers that vary (..., n), row by row."""
    return [list(values.reshape(-1, values.shape[-1])) for values in jax.tree.leaves(numbers)]


def _stiffness_factor(law: Law, first: jax.Array, before: ThermalState, after: ThermalState) -> jax.Array:
    """The factor (n,) on all moduli, and so on the stress of viscous modes and on what is stored."""
    assert law.shift is not None
    old, new = (law.shift.factor(first + heat.felt) for heat in (before, after))
    return new / old

"""Energies of the sheet, the work done on it, and the volume that it encloses or its rims sweep."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp

from jaxform.kernels.blocks import materialize, over_blocks
from jaxform.loads import Interval, LoadState, next_pressure
from jaxform.materials import Law, Modes
from jaxform.mechanics import membrane
from jaxform.mechanics.constitutive import split_modes, strain_state
from jaxform.mechanics.elements import Elements, by_region, element_metrics, region_count, sum_regions
from jaxform.model.scene import Scene
from jaxform.model.tables import ReferenceGeometry
from jaxform.sheet.discretization import NEVER, Discretization, RefinedMesh
from jaxform.sheet.packing import Packed
from jaxform.sheet.state import EnergyBalance, State


def kinetic_energy(state: State, mass: jax.Array) -> jax.Array:
    """Kinetic energy [J]."""
    return 0.5 * jnp.sum(mass * membrane.dot(state.nodes.velocities, state.nodes.velocities))


def strain_energy(state: State, scene: Scene, discrete: Discretization) -> jax.Array:
    """Strain energy [J]."""
    sheet, discrete = discrete.sheet, discrete.with_zones(state.heat, scene.material)
    volume = sheet.area * discrete.thickness
    material = scene.material.with_zones(discrete.zones)
    energy = membrane.strain_energy(state.nodes.positions, sheet.triangles, sheet.inverse_metric, volume, material)
    modes, whole = scene.material.viscous, discrete.whole
    if modes is None or state.memory is None:
        return energy
    elements = whole.elements
    now = strain_state(*element_metrics(whole.pack(state.nodes.positions), elements))
    thickness, _, varying = discrete.of_elements(whole.element)
    found = (varying or modes).energy(split_modes(state.memory[:, whole.element]), now)
    volume = elements.area * thickness
    return energy + jnp.sum(jnp.where(elements.area > 0.0, volume * found, 0.0))


def element_energy(
    positions: jax.Array,
    elements: Elements,
    thickness: jax.Array,
    material: Law,
    memory: jax.Array | None,
    counted: jax.Array | None = None,
) -> tuple[jax.Array, jax.Array]:
    """Strain energy [J], with that of viscous modes, and enclosed volume [m^3] of the elements; not differentiable.

    The volume is one number, or of loads of regions (n_load,).

    Args:
        positions: (3, place) [m].
        elements: The elements, of nodes at these places.
        thickness: Their initial thickness (capacity,) [m].
        material: Their law, its zones (capacity,).
        memory: The stress of its viscous modes (4 n_mode, capacity); None where it has none.
        counted: Those that count (capacity,); all by default.
    """
    rows, viscous = membrane.unstack_rows(positions), material.viscous
    varying = None if viscous is None or viscous.modulus.ndim == 1 else viscous

    def compute_block(
        own: Any, thickness: jax.Array, behaviour: Any, counted: Any, orientation: Any, regions: Any
    ) -> Any:
        zones, memory, modes = behaviour
        modes = modes or viscous
        triangles, inverse, area = own
        first, edge1, edge2 = membrane.edges(rows, triangles)
        edge1, edge2 = materialize((edge1, edge2))
        g = membrane.metric(edge1, edge2)
        energy = area * thickness * stored_energy(g, inverse, material.with_zones(zones), modes, memory)
        share = membrane.dot(membrane.minus(first, elements.origin), membrane.cross(edge1, edge2))
        share = share if orientation is None else orientation * share
        used = area > 0.0 if counted is None else counted & (area > 0.0)
        return [], [jnp.where(used, energy, 0.0), *by_region(jnp.where(used, share, 0.0), regions)]

    own = elements.triangles, elements.inverse_metric, elements.area
    inputs = own, thickness, (material.zones, memory, varying), counted, elements.orientation, elements.regions
    count = 1 + region_count(elements.regions)
    _, (energy, *volumes) = over_blocks(compute_block, elements.block_count, inputs, [], sums=count)
    return energy, sum_regions(volumes, elements.regions) / 6.0


def stored_energy(
    g: membrane.Metric, inverse: Any, material: Law, modes: Modes | None, memory: jax.Array | None
) -> jax.Array:
    """Strain energy of elements (n,) per reference volume [J/m^3], with that of viscous modes.

    Args:
        g: Present metric (n,).
        inverse: Inverse of the initial metric (3, n).
        material: Their law, its zones (n,).
        modes: Viscous modes; None without.
        memory: The stress of these (4 n_mode, n); None without.
    """
    density = membrane.energy_density(membrane.invariants(g, inverse), material)
    if modes is not None and memory is not None:
        density += modes.energy(split_modes(memory), strain_state(g, inverse))
    return density


def pressure_at(
    account: EnergyBalance, scene: Scene, time: jax.Array, length: jax.Array, volume: jax.Array | None
) -> LoadState:
    """The load state at a time [s], a `length` after the last step's begin [s], with the volume at that time [m^3].

    The energy balance is that of the last step; the volume is None where the pressure does not follow it.
    """
    if account.load_state is None or volume is None:
        return LoadState(scene.pressure.at(time, None), None)
    return next_pressure(scene.pressure, account.load_state, Interval(time, length, account.volume, volume))


def present_pressure(state: State, scene: Scene, volume: jax.Array | None) -> LoadState:
    """The present load state, with the enclosed volume [m^3]; None where the pressure does not follow it."""
    return pressure_at(state.account, scene, state.time, state.control.step_length, volume)


def last_pressure(state: State, scene: Scene, volume: jax.Array) -> jax.Array:
    """Mean pressure over the last step [Pa], with the volume that is enclosed now [m^3]."""
    last = state.account.load_state
    if last is None:
        return jnp.mean(scene.pressure.at(jnp.stack([state.time - state.control.step_length, state.time]), None))
    return 0.5 * (last.pressure + present_pressure(state, scene, volume).pressure)


def last_work(state: State, scene: Scene, volume: jax.Array) -> jax.Array:
    """External work of the last step [J], with the volume enclosed now [m^3]: the next force brings it."""
    return pressure_work(last_pressure(state, scene, volume), state.account.swept_volume(volume))


def pressure_work(pressure: jax.Array, swept: jax.Array) -> jax.Array:
    """Work [J] of a pressure [Pa] over a swept volume [m^3], or of those (n_load,) of all regions."""
    return pressure * swept if swept.ndim == 0 else jnp.sum(pressure * swept)


def enclosed_volume(
    positions: jax.Array, sheet: ReferenceGeometry | Elements, counted: jax.Array | float = 1.0
) -> jax.Array:
    """Volume [m^3] between the sheet, at positions (3, n_node) [m], and its origin; of the elements that count.

    Each counts as often as `counted` says, and against its nodes' order where that is negative. Where loads push
    regions of the sheet, it is the volume of each of these (n_load,).
    """
    first, edge1, edge2 = membrane.edges(positions, sheet.triangles)
    arm = membrane.minus(first, sheet.origin)
    counted = jnp.where(sheet.area > 0.0, counted, 0.0)
    shares = by_region(counted * membrane.dot(arm, membrane.cross(edge1, edge2)), sheet.regions)
    return sum_regions([jnp.sum(share) for share in shares], sheet.regions) / 6.0


def energy_rounding(scene: Scene, volume: jax.Array) -> jax.Array:
    """Rounding error [J] of the energy balance near rest: a volume [m^3] times the rounding of I1 - 3."""
    scale = jax.lax.stop_gradient(jnp.max(scene.law.stiffness_at_once()) * volume)
    return (1e-9 + 64 * jnp.finfo(scale.dtype).eps) * scale


# Volume swept by moving rims: the difference between pressure work and change of the enclosed volume.
#
# The volume is that of cones between the elements and the origin. As a rim moves, the cones' sides between it and the
# origin sweep a volume too, which the sheet does not push against: force times displacement is the pressure times what
# the sheet itself sweeps.


def rim_places(scene: Scene, mesh: RefinedMesh | None, packed: Packed) -> jax.Array | None:
    """Places of the ends of the rim's edges (2, n_edge), of one node where there is no such edge now; None without."""
    rim = scene.tables.rim
    if rim is None:
        return None
    if mesh is None or rim.triangle is None or scene.adaptivity is None:
        return packed.place[rim.ends]
    _, forest = scene.adaptivity
    roots, own = forest.root_count, rim.triangle
    parent = jnp.maximum(own - roots, 0) // 2
    there = (mesh.split_at[own] == NEVER) & ((own < roots) | (mesh.split_at[parent] != NEVER))
    return packed.place[jnp.where(there, mesh.place[rim.ends], 0)]


def rim_ends(positions: Any, places: jax.Array) -> jax.Array:
    """Positions (3, 2, n_edge) [m] of the rim's edges, from (3, place) or its rows, at places (2, n_edge)."""
    return jnp.stack([membrane.gather(row, places) for row in positions])


def rim_swept_volume(before: jax.Array, after: jax.Array, origin: jax.Array) -> jax.Array:
    """Volume [m^3] that the cones' sides sweep as the rim goes from one place to another (3, 2, n_edge) [m] each.

    What the sheet sweeps is the change of the enclosed volume and this.
    """
    way = membrane.unstack_rows(jnp.sum(after - before, axis=1))
    sides = [
        membrane.cross(*(membrane.unstack_rows(ends[:, k] - origin[:, None]) for k in range(2)))
        for ends in (before, after)
    ]
    return jnp.sum(membrane.dot(membrane.plus(*sides), way)) / 12.0

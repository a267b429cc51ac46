"""The active set: elements and nodes that can still move, in packed order; and stress relaxation in the others.

A run's state stays in this order from window to window. Elements that cannot move any more are not computed again.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp

from jaxform.contact.broad_phase import CandidateLists
from jaxform.core.pytree import pytree
from jaxform.kernels.blocks import BLOCK, Halves, lax_cond_once, over_blocks, split_halves, total
from jaxform.materials import Law, Modes
from jaxform.materials.viscous import StrainState
from jaxform.mechanics.constitutive import Response, ViscousMemory, split_modes, strain_state
from jaxform.mechanics.elements import Corners, FieldRule, element_metrics
from jaxform.model.scene import Scene
from jaxform.model.tables import Counts, ReferenceGeometry
from jaxform.sheet.discretization import Discretization, RefinedMesh, element_law
from jaxform.sheet.energy_balance import element_energy, enclosed_volume
from jaxform.sheet.heat import ThermalState
from jaxform.sheet.packing import Packed, pack
from jaxform.sheet.state import PackedState, State, can_move, immobile_nodes

# Stress relaxation in inactive elements: viscous modes of elements whose nodes all stick.


@pytree
class InactiveElements:
    """Elements whose strain is constant since they became inactive, in arrays of a fixed size.

    Attributes:
        element: Their numbers (capacity,).
        counted: True at places with an inactive element (capacity,).
        stress: Stress of their Prony terms (4 n_mode, capacity).
        strained: Their strain, (capacity,) each.
        volume: Their volume (capacity,) [m^3].
        since: Time of this stress [s].
        modes: The Prony terms.
    """

    element: jax.Array
    counted: jax.Array
    stress: jax.Array
    strained: StrainState
    volume: jax.Array
    since: jax.Array
    modes: Modes

    def unpack_stress(self, memory: jax.Array, time: jax.Array) -> tuple[jax.Array, jax.Array]:
        """The stress of all elements (4 n_mode, n_element) at a time [s], and what these lost since [J].

        At constant strain modes lose what they stored.
        """
        recursion = self.modes.recursion(time - self.since)
        measure = self.modes.measure(self.strained)
        before, after = split_modes(self.stress), []
        for rows, left, gain, back in zip(before, *recursion, strict=True):
            after.append([left * x + (gain - back) * row for x, row in zip(rows, measure, strict=True)])
        lost = self.modes.energy(before, self.strained) - self.modes.energy(after, self.strained)
        into = jnp.where(self.counted, self.element, memory.shape[1])
        rows = jnp.stack([row for mode in after for row in mode])
        return memory.at[:, into].set(rows, mode="drop"), jnp.sum(jnp.where(self.counted, self.volume * lost, 0.0))


def inactive_elements(
    positions: jax.Array,
    memory: jax.Array,
    time: jax.Array,
    modes: Modes,
    discrete: Discretization,
    packed: Packed,
) -> InactiveElements:
    """The elements that are not packed, of a sheet with nodes at positions (3, n_node) [m]."""
    whole = discrete.whole
    elements, element = whole.elements, whole.element
    thickness, _, varying = discrete.of_elements(element)
    return InactiveElements(
        element=element,
        counted=(elements.area > 0.0) & ~packed.kept[element],
        stress=memory[:, element],
        strained=strain_state(*element_metrics(positions, elements)),
        volume=elements.area * thickness,
        since=time,
        modes=varying or modes,
    )


@pytree
class Workspace:
    """Workspace arrays that are reused from window to window; they are written before they are read.

    Attributes:
        corners: Corner forces.
        basis: Lanczos vectors of the search for the stable step; None where the step is bounded by elements alone.
        lists: Candidate lists of each surface; None without surfaces.
    """

    corners: Corners
    basis: jax.Array | None
    lists: tuple[CandidateLists, ...] | None


@pytree
class ActiveSet:
    """The active elements and nodes, and the totals of the inactive ones, which do not move.

    Attributes:
        packed: Order of the active elements and nodes.
        thickness: Initial thickness of the elements (capacity,) [m].
        zones: Material parameters that vary over the sheet, of the elements (..., capacity), by name.
        modes: Prony terms of the elements (n_mode, capacity); None where they do not vary.
        bound: Largest eigenvalue of the elements' shape gradients (capacity,) [1/m^2].
        mass: Lumped mass of the nodes (place,) [kg].
        compliance: Mobility over mass (3, place) [1/kg].
        material_volume: Material volume of the active elements [m^3].
        inactive_volume: Volume enclosed by the inactive elements [m^3]; of regions with loads of their own (n_load,).
        inactive_energy: Strain energy of the inactive elements [J].
        memory: Stress of the Prony terms of all elements at the time of packing; None without Prony terms.
        inactive: Inactive elements with Prony terms; None where there are none.
        workspace: Arrays reused from window to window; None where each window allocates its own.
        heat: Temperature change of all elements at the time of packing, as in `State`; None where they do not cool.
        initial: Initial temperature of the elements (capacity,) [degC], and their zones without time-temperature shift;
            None where they do not cool.
    """

    packed: Packed
    thickness: jax.Array
    zones: dict[str, jax.Array]
    modes: Modes | None
    bound: jax.Array
    mass: jax.Array
    compliance: jax.Array
    material_volume: jax.Array
    inactive_volume: jax.Array
    inactive_energy: jax.Array
    memory: jax.Array | None = None
    inactive: InactiveElements | None = None
    workspace: Workspace | None = None
    heat: ThermalState | None = None
    initial: tuple[jax.Array, dict[str, jax.Array]] | None = None

    def volume(self, positions: jax.Array) -> jax.Array:
        """Volume [m^3] that the sheet encloses, with what is active at positions (3, place) [m]; differentiable."""
        elements = self.packed.elements
        counted = 1.0 if elements.orientation is None else elements.orientation
        return enclosed_volume(positions, elements, counted) + self.inactive_volume

    def pack_state(self, state: State) -> PackedState:
        """A state in packed order; at places beyond the nodes they stick."""

        def pack_values(values: jax.Array, rule: FieldRule) -> jax.Array:
            own = self.packed.pack(values)
            if rule.beyond is None:
                return own
            return own | ~self.packed.exists if rule.beyond is True else jnp.where(self.packed.exists, own, rule.beyond)

        memory = None if state.memory is None else state.memory[:, self.packed.element]
        heat = None if state.heat is None else state.heat.select(self.packed.element)
        return PackedState(
            dataclasses.replace(state, nodes=state.nodes.map_fields(pack_values), memory=memory, heat=heat)
        )

    def unpack_state(self, state: PackedState) -> State:
        """A state in the mesh's order."""
        nodes = state.nodes.map_fields(lambda values, _: self.packed.unpack(values))
        heat = (
            None
            if state.heat is None or self.heat is None
            else jax.tree.map(self._unpack_elements, self.heat, state.heat)
        )
        state = dataclasses.replace(state, nodes=nodes, heat=heat)
        return state if state.memory is None or self.memory is None else self._unpack_memory(state, self.memory)

    def _unpack_elements(self, values: jax.Array, own: jax.Array) -> jax.Array:
        """Values of all elements (..., n_element) with those of its own (..., capacity)."""
        place = jnp.where(self.packed.elements.area > 0.0, self.packed.element, values.shape[-1])
        return values.at[..., place].set(own, mode="drop")

    def _unpack_memory(self, state: State, memory: jax.Array) -> State:
        """Restores the memory of all elements from that of the packed ones and that at the time of packing."""
        account, before = state.account, state.account.viscous_loss
        if self.inactive is not None and before is not None:
            memory, lost = self.inactive.unpack_stress(memory, state.time)
            account = dataclasses.replace(account, viscous_loss=before + lost)
        return dataclasses.replace(
            state, memory=self._unpack_elements(memory, jnp.asarray(state.memory)), account=account
        )

    def response(self, material: Law, memory: ViscousMemory | None = None) -> Response:
        """The constitutive response of the active elements, for a scene with this material model."""
        return Response(material.elastic.with_zones(self.zones), memory)

    def viscous(self, material: Law) -> Modes | None:
        """The Prony terms of the active elements, for a scene with this material model."""
        return self.modes or material.viscous

    def law(self, material: Law) -> Law:
        """The material model of the active elements, for a scene with this one."""
        return element_law(material, self.zones, self.modes)


def pack_moving(immobile: jax.Array, mesh: RefinedMesh | None, scene: Scene, discrete: Discretization) -> Packed:
    """The elements and nodes of a window that begins with such nodes (n_node,) immobile."""
    if not scene.packs_moving:
        return discrete.whole
    sheet = discrete.sheet
    counts = scene.tables.counts if mesh is None else Counts(mesh.element_count, mesh.node_count)
    return pack(can_move(immobile, sheet.triangles, sheet.area), sheet, discrete.assembly, counts)


def active_set_of(state: State, scene: Scene, discrete: Discretization, *, differentiable: bool = False) -> ActiveSet:
    """The active set of a window that begins with a state in the mesh's order."""
    packed = pack_moving(immobile_nodes(state, scene), state.mesh, scene, discrete)
    present = discrete.with_zones(state.heat, scene.material)
    return _add_cooling(_make_active_set(packed, state, scene, present, differentiable=differentiable), state, discrete)


def whole_set(state: State, scene: Scene, discrete: Discretization) -> ActiveSet:
    """The active set of all elements and nodes, in the mesh's order."""
    none, whole = jnp.zeros((), discrete.mass.dtype), discrete.whole
    present = discrete.with_zones(state.heat, scene.material)
    masses = _add_masses(whole, present, _no_volume(discrete, none.dtype), none)
    return _add_cooling(_add_memory(masses, state, scene, present), state, discrete)


def _no_volume(discrete: Discretization, real: jnp.dtype) -> jax.Array:
    """No volume: one number, or where loads push regions of the sheet one for each (n_load,)."""
    regions = discrete.sheet.regions
    return jnp.zeros(() if regions is None else len(regions), real)


def repack(
    state: PackedState, scene: Scene, discrete: Discretization, active: ActiveSet, stale: jax.Array
) -> tuple[PackedState, ActiveSet]:
    """The state and the active set of the next window, packed again where the set is stale or a block too long."""
    if not scene.packs_moving and state.mesh is None:
        return state, active
    elements, immobile = active.packed.elements, immobile_nodes(state, scene)

    def compute_block(triangles: jax.Array, area: jax.Array) -> Any:
        moving = can_move(immobile, triangles, area)
        if elements.orientation is not None:
            # Both elements of a pair stay where either can move.
            either = jnp.logical_or(*split_halves(moving))
            moving = Halves(either, either).concatenate()
        return [], [moving.astype(area.dtype)]

    def pack_anew(pair: tuple[PackedState, ActiveSet]) -> tuple[PackedState, ActiveSet]:
        state = pair[1].unpack_state(pair[0])
        new = dataclasses.replace(active_set_of(state, scene, discrete), workspace=active.workspace)
        return new.pack_state(state), new

    if scene.packs_moving:
        _, (moving,) = over_blocks(compute_block, elements.block_count, (elements.triangles, elements.area), [], sums=1)
        stale |= moving.astype(jnp.int32) // BLOCK + 1 < elements.block_count
    return lax_cond_once(stale, pack_anew, (state, active))


def inactive_volume(positions: jax.Array, scene: Scene, discrete: Discretization, packed: Packed) -> jax.Array:
    """Volume [m^3] enclosed by what is not active, of positions (3, n_node) [m]; differentiable."""
    if not scene.packs_moving:
        return _no_volume(discrete, positions.dtype)
    return enclosed_volume(positions, discrete.sheet, jnp.where(packed.kept, 0.0, 1.0))


def _inactive_totals(
    state: State, scene: Scene, discrete: Discretization, packed: Packed
) -> tuple[jax.Array, jax.Array]:
    """Strain energy [J] and enclosed volume [m^3] of the inactive elements, not differentiable."""
    positions = state.nodes.positions
    if not scene.packs_moving:
        return jnp.zeros((), positions.dtype), _no_volume(discrete, positions.dtype)
    return totals_of(state, scene, discrete, ~packed.kept[discrete.whole.element])


def totals_of(
    state: State, scene: Scene, discrete: Discretization, counted: jax.Array | None = None
) -> tuple[jax.Array, jax.Array]:
    """Energy [J] and volume [m^3] of the counted elements (capacity,), in the whole set's order; not differentiable."""
    whole, memory = discrete.whole, state.memory
    thickness, zones, modes = discrete.with_zones(state.heat, scene.material).of_elements(whole.element)
    rows = None if memory is None else memory[:, whole.element]
    fixed = state.nodes.positions, whole.elements, thickness, element_law(scene.material, zones, modes), rows
    return element_energy(*jax.lax.stop_gradient(fixed), counted)


@jax.custom_jvp
def _attach_derivative(
    volume: jax.Array, positions: jax.Array, sheet: ReferenceGeometry, counted: jax.Array
) -> jax.Array:
    """The given volume [m^3], with the forward derivative of the volume of the counted elements."""
    return volume


@_attach_derivative.defjvp
def _(primals: Any, tangents: Any) -> tuple[jax.Array, jax.Array]:
    volume, positions, sheet, counted = primals
    moved = lambda positions: enclosed_volume(positions, sheet, counted)  # noqa: E731
    return volume, jax.jvp(moved, (positions,), (tangents[1],))[1]


def _make_active_set(
    packed: Packed, state: State, scene: Scene, discrete: Discretization, *, differentiable: bool
) -> ActiveSet:
    positions = state.nodes.positions
    energy, volume = _inactive_totals(state, scene, discrete, packed)
    if differentiable:
        volume = inactive_volume(positions, scene, discrete, packed)
    elif scene.packs_moving:
        # Second derivatives take this way as well.
        volume = _attach_derivative(volume, positions, discrete.sheet, jnp.where(packed.kept, 0.0, 1.0))
    return _add_memory(_add_masses(packed, discrete, volume, energy), state, scene, discrete)


def _add_memory(active: ActiveSet, state: State, scene: Scene, discrete: Discretization) -> ActiveSet:
    """Adds the history of the elements and the inactive elements whose stress relaxes."""
    modes, memory, inactive = scene.material.viscous, state.memory, None
    if modes is None or memory is None:
        return active
    if scene.packs_moving:
        inactive = inactive_elements(state.nodes.positions, memory, state.time, modes, discrete, active.packed)
    return dataclasses.replace(active, memory=memory, inactive=inactive)


def _add_cooling(active: ActiveSet, state: State, discrete: Discretization) -> ActiveSet:
    """Adds the thermal state and the initial properties that further cooling needs."""
    if discrete.temperature is None:
        return active
    element = active.packed.element
    zones = {name: own[..., element] for name, own in discrete.zones.items()}
    return dataclasses.replace(active, heat=state.heat, initial=(discrete.temperature[element], zones))


def _add_masses(
    packed: Packed, discrete: Discretization, inactive_volume: jax.Array, inactive_energy: jax.Array
) -> ActiveSet:
    thickness, zones, modes = discrete.of_elements(packed.element)
    return ActiveSet(
        packed=packed,
        thickness=thickness,
        zones=zones,
        modes=modes,
        bound=discrete.bound[packed.element],
        mass=packed.pack(discrete.mass),
        compliance=packed.pack(discrete.compliance),
        material_volume=jax.lax.stop_gradient(total(packed.elements.area * thickness)),
        inactive_volume=inactive_volume,
        inactive_energy=inactive_energy,
    )

"""Data of a window: its state, which changes from step to step, its constants, and the initial state of a run."""

from __future__ import annotations

import dataclasses
from typing import NamedTuple

import jax
import jax.numpy as jnp

from jaxform.adapt.remeshing import initial_mesh
from jaxform.contact.broad_phase import BroadPhaseCheck
from jaxform.contact.edge_contact import HeldSides, KnownSides, no_held_sides
from jaxform.contact.facet_slip import KnownFacets
from jaxform.contact.sliding import ToolEnergies
from jaxform.contact.sticking import FirstHits
from jaxform.core.pytree import as_real, pytree
from jaxform.loads import first_pressure
from jaxform.materials import Modes, Recursion
from jaxform.mechanics.elements import Corners, Nodes
from jaxform.model.scene import Scene
from jaxform.model.tables import SHORT_WINDOW
from jaxform.sheet.active_set import ActiveSet
from jaxform.sheet.discretization import RefinedMesh, discretize, present_discretization
from jaxform.sheet.energy_balance import enclosed_volume, strain_energy
from jaxform.sheet.heat import ThermalState, initial_heat
from jaxform.sheet.state import (
    Control,
    EnergyBalance,
    Replay,
    State,
    initial_node_state,
    noise_vector,
)


@pytree
class WindowState:
    """State that changes from step to step inside a window, in packed order.

    The memory is what elements remember from one step to the next (4 n_mode, room), before the first step and at the
    window's end the stress of their viscous modes; None where they have none. Positions (3, place) [m] are three rows
    where no derivative is taken: else they would be taken apart in every step. `landing_step` is the step in which
    a node landed, NEVER where it has not in this window, and the impact that of `sticking.Landing`, None where it is
    not kept.
    Whether another list of candidates is due, the last check of each surface, and the workspace for hits are None where
    contact is not searched for; the room for corner forces is None where derivatives are taken. The record is that of
    `sticking.Landing`. The facets that nodes lie on are kept where they may slide and no derivative is taken. The sides
    that are held at edges of tools are None where none can be.
    """

    nodes: Nodes
    fields: dict[str, jax.Array]
    account: EnergyBalance
    memory: jax.Array | None
    landing_step: jax.Array
    impact: jax.Array | None
    count: jax.Array
    halted: jax.Array
    stale: jax.Array | None
    check: tuple[BroadPhaseCheck, ...] | None
    room: Corners | None
    hits: FirstHits | None
    record: jax.Array | None = None
    facets: KnownFacets | None = None
    held: HeldSides | None = None

    @property
    def last_checks(self) -> tuple[BroadPhaseCheck, ...]:
        """The last broad-phase check of each surface, where contact is searched for."""
        assert self.check is not None
        return self.check


@pytree
class WindowData:
    """Constants of a window, in packed order.

    Attributes:
        active: The elements and nodes that are active.
        begin: Its begin [s].
        length: The step [s].
        bound: The elements' bound on it [s].
        most: How many steps it takes, unless it is cut short.
        row: Number of the row of a schedule that is followed, and the time that is left of it [s]; None where none is.
        wary: Whether no look at the nodes is trusted, since the last window was not taken.
        recursion: How viscous modes go over a step; None where there are none.
        losing: Viscous modes by which losses are counted; None where there are none.
        rim: Places of the ends of moving rims' edges (2, n_edge); None where there are none.
    """

    active: ActiveSet
    begin: jax.Array
    length: jax.Array
    bound: jax.Array
    max_count: jax.Array
    row: tuple[jax.Array, jax.Array] | None
    always_check: jax.Array
    recursion: Recursion | None
    losing: Modes | None = None
    rim: jax.Array | None = None


class KnownContact(NamedTuple):
    """Known contact of a window whose steps are recomputed, in packed order.

    The step in which each node landed (place,), NEVER where it did not, and on which triangle of all surfaces; and how
    many steps were taken. Where nodes may land more than once, the record of all landings instead. The sides that are
    held at the window's end, where any can be.
    """

    step: jax.Array
    chosen: jax.Array
    count: jax.Array
    record: jax.Array | None = None
    sides: KnownSides | None = None


ContactSearch = tuple[jax.Array, jax.Array, jax.Array]
"""Result of the contact search in a window.

The most pairs of node and triangle that it listed at once; whether any exceeded the capacity; and whether a node may
have missed the mold, out of its sphere or faster than it was checked.
"""


# The state in which a run begins: the sheet at rest, with what lies on the mold held there.


def _first_memory(scene: Scene, mesh: RefinedMesh | None, heat: ThermalState | None) -> jax.Array | None:
    """The stress of viscous modes (4 n_mode, n_element) of a sheet that was never strained; None without such."""
    modes, adaptivity, pairs = scene.material.viscous, scene.adaptivity, scene.tables.assembly.pairs
    if modes is None:
        return None
    if scene.material.shift is not None and scene.parison.temperature is not None:
        modes = present_discretization(scene, mesh, discretize(scene)).with_zones(heat, scene.material).modes or modes
    if mesh is not None and adaptivity is not None:
        _, forest = adaptivity
        return modes.initial_stress(forest.sheet.inverse_metric[:, mesh.element])
    # In the basis that elements are worked through in.
    return modes.initial_stress(scene.tables.sheet.inverse_metric if pairs is None else pairs.inverse_metric)


def _contact_temperature(scene: Scene, mesh: RefinedMesh | None) -> jax.Array | None:
    """The initial temperature of the nodes (n_node,) [degC]; None where no contact law needs it."""
    temperature = scene.parison.temperature
    if temperature is None or not any(surface.mold.contact.needs_temperature for surface in scene.surfaces):
        return None
    return temperature if mesh is None else temperature[mesh.node]


def initial_state(scene: Scene) -> State:
    """The sheet at rest in its initial shape."""
    mesh = None if scene.adaptivity is None else initial_mesh(scene, scene.adaptivity)
    positions, sheet = scene.parison.positions.T, scene.tables.sheet
    stuck, contact_time, wall, tool = initial_node_state(scene)
    fields = {name: own.start(scene.parison.positions) for name, own in scene.fields.items()}
    if mesh is not None:
        # Nodes that do not exist yet are held where the first node is.
        there = jnp.arange(mesh.node.size) < mesh.node_count
        stuck, contact_time, wall, tool = initial_node_state(scene, mesh.node)
        stuck, contact_time = stuck | ~there, jnp.where(there, contact_time, 0.0)
        wall = jnp.where(there, wall, 0)
        positions, fields = positions[:, mesh.node], {name: values[mesh.node] for name, values in fields.items()}
    zero, none = as_real(0.0), jnp.int32(0)
    elements = sheet.area.size if mesh is None else mesh.element.size
    heat = None if scene.cooling is None else initial_heat(elements)
    volume = enclosed_volume(positions, sheet)
    pressed = first_pressure(scene.pressure, volume) if scene.pressure.follows_volume else None
    state = State(
        nodes=Nodes(
            positions=positions,
            velocities=jnp.zeros_like(positions),
            stuck=stuck,
            contact_time=contact_time,
            wall=wall,
            tool=tool,
            temperature=_contact_temperature(scene, mesh),
            slip=jnp.zeros_like(positions[0]) if scene.slides else None,
            mode=noise_vector(positions) if scene.solver.sharp_step else None,
            fields=fields,
        ),
        account=EnergyBalance(
            volume,
            pressed,
            *[zero] * 8,
            viscous_loss=None if scene.material.viscous is None else zero,
            cooling_loss=zero if scene.stiffens else None,
            tool_work=zero if scene.moves else None,
            tool_last=zero if scene.moves else None,
            friction_loss=zero if scene.slides else None,
            rim=None if scene.tables.rim is None else zero,
            gravity_work=None if scene.solver.gravity is None else zero,
            by_tool=ToolEnergies(*((zero,) * len(numbers) for numbers in (scene.moving_tools, scene.rubbing_tools))),
            last_by_tool=(zero,) * len(scene.moving_tools),
        ),
        control=Control(
            step_length=zero,
            span=jnp.minimum(SHORT_WINDOW, jnp.int32(scene.tables.longest_window)),
            retries=none,
            bound=zero,
            sharpness=zero,
            rung=zero,
            last_length=zero,
            last_count=none,
            pace=None if scene.cooling is None else zero,
        ),
        replay=Replay(none, zero),
        mesh=mesh,
        memory=_first_memory(scene, mesh, heat),
        time=zero,
        steps=none,
        windows=none,
        shortened=none,
        status=none,
        heat=heat,
        held=no_held_sides(positions.shape[1], positions.dtype) if scene.tables.edges else None,
    )
    if scene.parison.pre_stretch is None:
        return state
    held = strain_energy(state, scene, present_discretization(scene, mesh, discretize(scene)))
    return dataclasses.replace(state, account=dataclasses.replace(state.account, pre_stretch_work=held))

"""Data of a window: its state, which changes from step to step, its constants, and the initial state of a run."""

from __future__ import annotations

import dataclasses
from typing import NamedTuple

import jax
import jax.numpy as jnp

from jaxform.adapt.element_bisection import initial_mesh
from jaxform.contact.broad_phase import PAIRS_PER_NODE, BroadPhaseCheck
from jaxform.contact.edge_contact import HeldSides, no_held_sides
from jaxform.contact.edge_forces import Inverse
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
from jaxform.sheet.scheme import begins_anew, unresolved_share
from jaxform.sheet.state import (
    Control,
    EnergyBalance,
    Replay,
    State,
    initial_node_state,
    noise_vector,
)

_SIDE_LINES = 16  # lines of nodes across a square sheet: as many sides can be held at edges before a run asks for more


@pytree
class WindowState:
    """State that changes from step to step inside a window, in packed order.

    Attributes:
        nodes: Nodal fields. Positions (3, place) [m] are three rows where no derivative is taken, one array elsewhere.
        fields: The scene's user-defined fields, by name.
        account: Energy balance so far.
        memory: History of the Prony terms (4 n_mode, capacity): their stress before the first step and at the window's
            end. None without Prony terms.
        landing_step: Step in which each node landed in this window (place,); NEVER for the others.
        impact: Impact of nodes that landed, as in `sticking.Landing`; None where it is not recorded.
        count: Steps taken.
        halted: True after a failure, or when all steps are taken: the remaining steps change nothing.
        stale: True where new lists of candidates are needed; None where contact is not searched for.
        check: Last broad-phase check of each surface; None where contact is not searched for.
        corners: Workspace for corner forces; None where derivatives are taken.
        hits: Workspace for first hits; None where contact is not searched for.
        record: All landings, as in `sticking.Landing`; None where they are not recorded.
        facets: Facets on which nodes lie; None where no node can slide, and where derivatives are taken.
        held: Element sides held at edges of tools; None where none can be.
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
    corners: Corners | None
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
        active: Active elements and nodes.
        begin: Time at the window's begin [s].
        length: Step length [s].
        bound: Bound of the elements on the step length [s].
        max_count: Number of steps, unless the window is halted earlier.
        row: Row of the schedule that is followed, and the time left in that row [s]; None without a schedule.
        always_check: True where every step searches contact: the last window was rejected.
        recursion: Factors that advance the Prony terms by a step; None without Prony terms.
        loss_modes: Prony terms for the viscous loss; None without Prony terms.
        rim: Places of the ends of moving rims' edges (2, n_edge); None without moving rims.
        edge_inverse: Inverse of the system of the sides held at the window's begin; None without sharp edges.
    """

    active: ActiveSet
    begin: jax.Array
    length: jax.Array
    bound: jax.Array
    max_count: jax.Array
    row: tuple[jax.Array, jax.Array] | None
    always_check: jax.Array
    recursion: Recursion | None
    loss_modes: Modes | None = None
    rim: jax.Array | None = None
    edge_inverse: Inverse | None = None


class KnownContact(NamedTuple):
    """Known contact of a window whose steps are recomputed, in packed order.

    Attributes:
        step: Step in which each node landed (place,); NEVER for the others.
        chosen: Triangle on which it landed (place,), numbered over all surfaces.
        count: Steps taken.
        record: All landings, where nodes may land more than once; else None.
        sides: Element sides held at edges of tools at the window's end, whose ends, edges and steps are used again;
            None where none can be.
    """

    step: jax.Array
    chosen: jax.Array
    count: jax.Array
    record: jax.Array | None = None
    sides: HeldSides | None = None


ContactSearch = tuple[jax.Array, jax.Array, jax.Array]
"""Result of the contact search in a window.

The largest number of listed pairs of node and triangle; True where a list exceeded the capacity; and True where a node
may have missed the mold, because it left its sphere or became faster than the check assumed.
"""


# The initial state of a run: the sheet at rest, nodes on the mold in contact.


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
    # In the basis in which forces are computed: pairs of elements have one of their own.
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
        # Nodes that are not inserted yet are fixed at the first node.
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
            unresolved=None if unresolved_share(scene) is None else zero,
            restarts=zero if begins_anew(scene) else None,
        ),
        control=Control(
            step_length=zero,
            window_steps=jnp.minimum(SHORT_WINDOW, jnp.int32(scene.tables.longest_window)),
            retries=none,
            bound=zero,
            sharpness=zero,
            base_length=zero,
            last_length=zero,
            last_count=none,
            cooling_rate=None if scene.cooling is None else zero,
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
        held=no_held_sides(_side_capacity(scene, positions), positions.dtype) if scene.tables.edges else None,
    )
    if scene.parison.pre_stretch is None:
        return state
    held = strain_energy(state, scene, present_discretization(scene, mesh, discretize(scene)))
    return dataclasses.replace(state, account=dataclasses.replace(state.account, pre_stretch_work=held))


def _side_capacity(scene: Scene, positions: jax.Array) -> int:
    """Capacity of sides held at edges: some lines of nodes (3, n_node), or more where a run asked for more pairs."""
    count = positions.shape[1]
    return min(count, int(_SIDE_LINES * count**0.5)) * scene.tables.pairs_per_node // PAIRS_PER_NODE

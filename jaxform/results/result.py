"""Result of a simulation: the formed part, its wall, its energies, and the sheet of a next stage."""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from jaxform.contact.sliding import ToolEnergies
from jaxform.core.pytree import abbreviate, as_real, marked_field_names, pytree, row_count
from jaxform.mechanics import membrane
from jaxform.mechanics.elements import FieldRule, Nodes
from jaxform.model.scene import Parison, Scene, make_parison
from jaxform.results.filling import Filling
from jaxform.results.recovery import nodal_ratio
from jaxform.sheet.discretization import Discretization, RefinedMesh, element_levels, present_discretization
from jaxform.sheet.energy_balance import (
    enclosed_volume,
    energy_rounding,
    kinetic_energy,
    last_work,
    present_pressure,
    strain_energy,
)
from jaxform.sheet.heat import ThermalState, temperature_change, tool_contact
from jaxform.sheet.scheme import present_energies
from jaxform.sheet.state import LOSS, Schedule, State, Status, WindowLog, is_at_rest, is_finished

# The energy balance of a run, and its checks.

_DRAG = 0.2  # how much the square of the share of damping changes the wall; measured by `make validate`
UNBALANCED = 0.01  # largest error of the energy balance, relative to the largest work


@pytree
class Energy:
    """Energy balance of the modelled part [J]; every term is computed by itself, none by difference.

    Attributes:
        strain: Strain energy at the end.
        kinetic: Kinetic energy at the end.
        external_work: Pressure forces times nodal displacements: the sum of P dV, unless an open rim moves.
        tool_work: Work of tools that move.
        gravity_work: Work of gravity.
        pre_stretch_work: Strain energy of the pre-stretched sheet at the start.
        damping_loss: Work done against damping, with the energy of modes that a jump of the forces excites and the
            time step does not resolve.
        contact_loss: Kinetic energy of the nodes when they stuck.
        refinement_loss: Strain and kinetic energy that new nodes took away.
        viscous_loss: Dissipation of the Prony terms.
        cooling_loss: Strain energy lost as the temperature softened the sheet, minus that gained as it stiffened.
        friction_loss: Dissipation by friction on tools.
        kinetic_peak: Largest kinetic energy at the end of a window; carries no derivative.
        peak_work: Largest magnitude of the work, external and of the tool, at the end of a window; carries no
            derivative.
        rounding: Error of the balance by rounding alone; carries no derivative.
        by_tool: Work of each tool that moves and friction loss of each with friction, where there are several such.
    """

    strain: jax.Array
    kinetic: jax.Array
    external_work: jax.Array
    tool_work: jax.Array
    gravity_work: jax.Array
    pre_stretch_work: jax.Array
    damping_loss: jax.Array = dataclasses.field(metadata=LOSS)
    contact_loss: jax.Array = dataclasses.field(metadata=LOSS)
    refinement_loss: jax.Array = dataclasses.field(metadata=LOSS)
    viscous_loss: jax.Array = dataclasses.field(metadata=LOSS)
    cooling_loss: jax.Array = dataclasses.field(metadata=LOSS)
    friction_loss: jax.Array = dataclasses.field(metadata=LOSS)
    kinetic_peak: jax.Array
    peak_work: jax.Array
    rounding: jax.Array
    by_tool: ToolEnergies = ToolEnergies()

    @property
    @jax.jit
    def balance_error(self) -> jax.Array:
        """Error of the energy balance, relative to the largest work; above 1 % the status is `UNBALANCED`.

        For work so small that rounding matters, it is relative to a hundred times the rounding.
        """
        kept = self.strain + self.kinetic + sum(getattr(self, name) for name in marked_field_names(self, LOSS))
        largest = jnp.maximum(jnp.abs(self.work), self.peak_work) + self.rounding / UNBALANCED
        return jnp.abs(kept - self.work) / largest

    @property
    def work(self) -> jax.Array:
        """Work done on the sheet by pressure, tools, gravity and pre-stretch."""
        return self.external_work + self.tool_work + self.gravity_work + self.pre_stretch_work

    @property
    @jax.jit
    def measurable(self) -> jax.Array:
        """True if the work was ever larger than its rounding error."""
        return jnp.maximum(jnp.abs(self.work), self.peak_work) > self.rounding

    @property
    @jax.jit
    def quasi_static_error(self) -> jax.Array:
        """Estimated relative error of the wall against the same process done slowly (0 where nothing moved).

        The largest kinetic energy over the external work, for inertia, plus a fifth of the square of the share that
        went into damping, for drag. For deep parts within a factor of about three (docs/accuracy.md), for shallow ones
        several times too high.
        """
        work = jnp.where(self.measurable, jnp.abs(self.work), jnp.inf)
        return self.kinetic_peak / work + _DRAG * jnp.square(self.damping_loss / work)


def warnings_of_no_work(energy: Energy) -> list[str]:
    """A sentence where the work of the pressure is below the resolution of the energy balance."""
    if bool(energy.measurable):
        return []
    work = max(abs(float(energy.work)), float(energy.peak_work))
    return [
        f"the sheet hardly moved: the pressure did {work:.2g} J of work, less than the {float(energy.rounding):.2g} J "
        "that the energy balance can resolve; raise the pressure or solver.end_time, check the units of "
        "material.density, or, where all of the sheet lies on the mold at the start, turn or move the mold"
    ]


NODAL, OF_ELEMENTS = {"of": "nodes"}, {"of": "elements"}
"""Marks for the fields of a result that have a value for each node, or for each element."""


@pytree
class Seconds:
    """Wall-clock time of `run` [s]: compiling, and the loop alone."""

    compile: float
    run: float


@pytree
class Result:
    """The formed part.

    Attributes:
        positions: Final node positions (n_node, 3) [m].
        reference: Initial node positions (n_node, 3) [m], in the same order, those of inserted nodes included.
        thickness: Final thickness at the nodes (n_node,) [m]: h/h0 by a linear least-squares fit to the adjacent
            elements, extrapolated at rims, times the initial thickness of the node; 0 where the node does not exist.
            See `jaxform.results.recovery`. With `Status.INPUT` nothing was simulated, and the thickness, volume and
            stretches of nodes and elements and the mass are NaN.
        active: Nodes that exist at the end (n_node,).
        stuck: Mask of the nodes that no longer move (n_node,): in contact, or clamped.
        contact_time: Time of contact of each node (n_node,) [s]; -1 where free, 0 where clamped.
        wall: Contact of a node (n_node,): one more than the number of the mold's triangle, negative if the node came
            from the side opposite to its normal; 0 without contact with the mold.
        tool_wall: The same of the tools besides the mold (n_node,), in the number of a triangle of the tool that the
            node touches; None where there are none.
        tool: Number of the tool that a node touches (n_node,), in the order of `Scene.surfaces`: the mold, where there
            is one, then the other tools; -1 without contact.
        slip: Length of the way that a node has slid along tools (n_node,) [m], over all times; None where nodes stick
            to all tools.
        fields: The scene's own nodal fields, by name (n_node,); 0 where the node does not exist.
        triangles: Node numbers of the elements (n_element, 3).
        level: Number of bisections of each from the scene's mesh (n_element,).
        used: Elements that exist at the end (n_element,); the others are unused capacity.
        element_volume: Their volume (n_element,) [m^3], which they keep; 0 where not used.
        element_thickness: Final thickness of the elements (n_element,) [m].
        stretches: Larger and smaller principal stretch of the elements (n_element, 2).
        velocities: Final node velocities (n_node, 3) [m/s].
        mass: Mass of the modelled part [kg].
        added_mass: Mass added to fine elements to keep the step long, relative to the mass.
        energy: The energy balance.
        time: Simulated time [s].
        steps, windows, shortened: Steps and windows taken, and windows that were rejected and retried.
        status: Bits of `jaxform.Status`; 0 when all went well.
        schedule: The decisions taken, for `simulate` to take them again.
        seconds: Wall-clock time where the host loop took it, else None.
        filling: Filling of the mold, if it was measured: `run` does so if it is uncertain; else None.
        temperature: Temperature at the nodes (n_node,) [degC] at the end time, if the sheet cools; None if it keeps its
            initial temperature.
        loading: Final state of the loading; None where it has none.
        pressures: Times [s] and pressures [Pa] (2, n), where `run` met a pressure that follows the enclosed volume; of
            loads of regions one row for each (1 + n_load, n).
        contacts: Times [s], and shares of the formed area on each of the scene's surfaces (1 + n_surface, n), where
            nodes may slide and `run` recorded them.
        contact_periods: Times at which nodes first came into contact with each surface, and the last of these at which
            one was (n_surface, 2) [s]; NaN for never, None where `contacts` is.
        contact_duration: Times for which each node has touched each surface (n_node, n_surface) [s], where nodes may
            slide and `run` recorded them: exact but for nodes that left, by up to a 120th of the end time each time.
        held_sides: Number of places where a side of an element is held at an edge of a tool; None where none can be.
        out_of_range: Numbers of the scene out of range, as bits of several words, in the order of
            `core.ranges.DESIGNABLE`; 0 if none. None for `run`, which refuses them.
    """

    positions: jax.Array = dataclasses.field(metadata=NODAL)
    reference: jax.Array = dataclasses.field(metadata=NODAL)
    thickness: jax.Array = dataclasses.field(metadata=NODAL)
    active: jax.Array = dataclasses.field(metadata=NODAL)
    stuck: jax.Array = dataclasses.field(metadata=NODAL)
    contact_time: jax.Array = dataclasses.field(metadata=NODAL)
    wall: jax.Array = dataclasses.field(metadata=NODAL)
    tool: jax.Array = dataclasses.field(metadata=NODAL)
    fields: dict[str, jax.Array] = dataclasses.field(metadata=NODAL)
    triangles: jax.Array
    level: jax.Array = dataclasses.field(metadata=OF_ELEMENTS)
    used: jax.Array = dataclasses.field(metadata=OF_ELEMENTS)
    element_volume: jax.Array = dataclasses.field(metadata=OF_ELEMENTS)
    element_thickness: jax.Array = dataclasses.field(metadata=OF_ELEMENTS)
    stretches: jax.Array = dataclasses.field(metadata=OF_ELEMENTS)
    velocities: jax.Array = dataclasses.field(metadata=NODAL)
    mass: jax.Array
    added_mass: jax.Array
    energy: Energy
    time: jax.Array
    steps: jax.Array
    windows: jax.Array
    shortened: jax.Array
    status: jax.Array
    schedule: Schedule | None = None
    seconds: Seconds | None = None
    filling: Filling | None = None
    loading: Any = None
    pressures: NDArray[np.float64] | None = None
    contacts: NDArray[np.float64] | None = None
    contact_periods: NDArray[np.float64] | None = None
    out_of_range: jax.Array | None = None
    temperature: jax.Array | None = dataclasses.field(default=None, metadata=NODAL)
    tool_wall: jax.Array | None = dataclasses.field(default=None, metadata=NODAL)
    held_sides: jax.Array | None = None
    slip: jax.Array | None = dataclasses.field(default=None, metadata=NODAL)
    contact_duration: NDArray[np.float64] | None = dataclasses.field(default=None, metadata=NODAL)

    def __repr__(self) -> str:
        """The size of the mesh, the time and steps simulated and the status, in one line."""
        parts = [f"{row_count(self.triangles)} elements", f"{row_count(self.positions)} nodes"]
        numbers = {"time": self.time, "steps": self.steps, "status": self.status}
        return f"Result({', '.join(parts + [f'{name}={abbreviate(value)}' for name, value in numbers.items()])})"

    def of(self, kind: dict[str, str], chosen: np.ndarray | slice) -> dict[str, Any]:
        """The nodal values, or those of elements, of the chosen ones alone: NumPy arrays by name."""
        names = marked_field_names(self, kind)
        return {name: jax.tree.map(lambda values: np.asarray(values)[chosen], getattr(self, name)) for name in names}


def make_result(
    state: State, scene: Scene, first: Discretization, taken: WindowLog | None = None, last: jax.Array | bool = False
) -> Result:
    """The result of a state; pure, so it can be traced.

    Args:
        state: The state.
        scene: The scene.
        first: The initial sheet.
        taken: The windows that were taken, as the first parts of a `Schedule`.
        last: True if the run has ended: its status tells whether the windows did not suffice, or the energy is out of
            balance, and a sheet that cannot move any more cools on until the end time.
    """
    now, adaptivity, mesh = present_discretization(scene, state.mesh, first), scene.adaptivity, state.mesh
    sheet = now.sheet
    _, edge1, edge2 = membrane.edges(state.nodes.positions, sheet.triangles)
    strain = membrane.invariants(membrane.metric(edge1, edge2), sheet.inverse_metric)
    # A wrinkled element is as thick as the material in its folds.
    relaxed = membrane.relax_strain(strain)[0] if scene.material.tension_field else strain
    ratio = 1.0 / jnp.sqrt(relaxed.determinant)
    count = now.mass.size
    counts = scene.tables.counts
    active, node, mobility = jnp.ones(count, bool), jnp.arange(count), scene.tables.mobility
    if counts is not None:
        active = node < counts.nodes
    reference = scene.parison.positions.T
    triangles, level, used = sheet.triangles, jnp.zeros(sheet.area.size, jnp.int32), sheet.area > 0.0
    if mesh is not None and adaptivity is not None:
        _, forest = adaptivity
        place = jnp.arange(forest.owner.size)
        first_nodes = forest.first_nodes if counts is None else counts.nodes
        active, node = (place < first_nodes) | (mesh.place > 0), mesh.place
        triangles, level = forest.sheet.triangles[:, mesh.element], element_levels(mesh.element, forest)
        reference, mobility = reference[:, mesh.node], forest.mobility[:, mesh.node]
    ratios = nodal_ratio(ratio, sheet, reference, mobility > 0.0)

    def nodal(values: jax.Array, otherwise: jax.Array | float) -> jax.Array:
        """Values in the order of the scene's nodes, and another value for nodes that do not exist."""
        return values if mesh is None else jnp.where(active, values[..., node], otherwise)

    def in_scene_order(values: jax.Array, rule: FieldRule) -> jax.Array:
        return nodal(values, scene.parison.positions.T if rule.absent is None else rule.absent)

    nodes = dataclasses.replace(state.nodes, mode=None).map_fields(in_scene_order)
    volume = enclosed_volume(state.nodes.positions, sheet)
    energy = _energy_of(state, scene, first, now, volume)
    status = jnp.where(last, _final_status(state, scene, energy), state.status)
    state = dataclasses.replace(state, status=status)
    change = _change_of_temperature(state, scene, now, ratio, last)
    return Result(
        positions=nodes.positions.T,
        reference=scene.parison.positions,
        thickness=nodal(ratios, 0.0) * scene.parison.thickness,
        active=active,
        stuck=nodes.stuck,
        contact_time=nodes.contact_time,
        wall=_wall_of_mold(nodes, scene),
        tool_wall=_wall_of_tools(nodes, scene),
        held_sides=None if state.held is None else state.held.count,
        tool=_touched_tool(nodes),
        slip=nodes.slip,
        fields=nodes.fields,
        triangles=triangles.T,
        level=level,
        used=used,
        element_volume=sheet.area * now.thickness,
        element_thickness=jnp.where(used, now.thickness * ratio, 0.0),
        stretches=jnp.stack(membrane.principal_stretches(strain), axis=1),
        velocities=nodes.velocities.T,
        mass=jnp.sum(now.zones.get("density", scene.material.density) * sheet.area * now.thickness),
        added_mass=_added_mass(scene, now, mesh),
        energy=energy,
        time=state.time,
        steps=state.steps,
        windows=state.windows,
        shortened=state.shortened,
        status=state.status,
        loading=None if state.account.load_state is None else present_pressure(state, scene, volume).state,
        schedule=None if taken is None else Schedule(*taken, None if mesh is None else mesh.split_at),
        temperature=None if change is None else nodal(change, 0.0) + jnp.asarray(scene.parison.temperature),
    )


def _energy_of(state: State, scene: Scene, first: Discretization, now: Discretization, volume: jax.Array) -> Energy:
    """The energy balance of a state that encloses a volume [m^3], of the initial sheet and that with its mesh."""
    account = state.account
    none = dict.fromkeys(("viscous_loss", "cooling_loss", "friction_loss"), jnp.zeros_like(state.time))
    kinetic, damped = _kinetic_energy(state, scene, now)
    # Damping and viscosity take the energy of fast modes that the steps do not resolve; else the modes keep it.
    losses, unresolved = (
        account.losses() | {"damping_loss": account.damping_loss + damped},
        _or_zero(account.unresolved),
    )
    if scene.solver.damping is not None:
        losses["damping_loss"] += unresolved
    elif account.viscous_loss is not None:
        losses["viscous_loss"] = account.viscous_loss + unresolved
    else:
        kinetic += unresolved
    return Energy(
        strain=strain_energy(state, scene, now),
        kinetic=kinetic,
        external_work=account.external_work + last_work(state, scene, volume),
        tool_work=_or_zero(account.total_tool_work),
        gravity_work=_or_zero(account.gravity_work),
        pre_stretch_work=_or_zero(account.pre_stretch_work),
        **(none | losses),
        kinetic_peak=account.kinetic_peak,
        peak_work=jax.lax.stop_gradient(account.peak_work),
        rounding=energy_rounding(scene, jnp.sum(first.sheet.area * first.thickness)),
        by_tool=account.total_by_tool,
    )


def _final_status(state: State, scene: Scene, energy: Energy) -> jax.Array:
    """The status of the last state: of one without a status, if its energy is out of balance."""
    status = state.status | jnp.where(is_finished(state, scene), 0, Status.WINDOWS_EXHAUSTED)
    # Not more than the limit, so that what is not a number is out of balance, too.
    balanced = energy.balance_error <= UNBALANCED
    return jnp.where((status == 0) & ~balanced, Status.UNBALANCED, status).astype(jnp.int32)


def _wall_of_mold(nodes: Nodes, scene: Scene) -> jax.Array:
    """The triangles of the mold that nodes touch (n_node,), as in `Nodes.wall`; 0 where they touch another tool."""
    if scene.mold is None:
        return jnp.zeros_like(nodes.wall)
    return nodes.wall if nodes.tool is None else jnp.where(nodes.tool == 0, nodes.wall, 0)


def _wall_of_tools(nodes: Nodes, scene: Scene) -> jax.Array | None:
    """Triangles of other tools that nodes touch (n_node,), as in `Nodes.wall`; None where there are no other tools."""
    if not scene.tools:
        return None
    return nodes.wall if scene.mold is None or nodes.tool is None else jnp.where(nodes.tool == 0, 0, nodes.wall)


def _touched_tool(nodes: Nodes) -> jax.Array:
    """The number of the tool that the nodes touch (n_node,), as in `Scene.surfaces`; -1 for none."""
    return jnp.where(nodes.wall == 0, -1, 0 if nodes.tool is None else nodes.tool)


def _kinetic_energy(state: State, scene: Scene, now: Discretization) -> tuple[jax.Array, jax.Array | float]:
    """Kinetic energy at the last window's end and the damping loss before it [J], as the balance has them."""
    found, exchanged, damped = present_energies(state, scene, now)
    # The same to rounding, but of a sheet that was refined or retried since: the value is the balance's.
    value = kinetic_energy(state, now.mass) - state.account.kinetic_excess
    return jax.lax.stop_gradient(value - found) + found + exchanged, damped


def _or_zero(term: jax.Array | None) -> jax.Array:
    return as_real(0.0) if term is None else term


def _change_of_temperature(
    state: State, scene: Scene, now: Discretization, ratio: jax.Array, last: jax.Array | bool
) -> jax.Array | None:
    """Change of the nodes' temperature (n_node,) [K] since the start: mean of their elements; None without cooling."""
    cooling, heat, sheet, nodes = scene.cooling, state.heat, now.sheet, state.nodes
    if cooling is None or heat is None or now.temperature is None:
        return None
    used, time = sheet.area > 0.0, state.time
    wall = now.thickness * jnp.where(used, ratio, 1.0)
    share = tool_contact(scene, nodes, sheet.triangles, heat.time, time)
    density = now.zones.get("density", scene.material.density)
    first = now.temperature
    change = temperature_change(heat, cooling, first, wall, share, density, time)
    # Contact does not change after that.
    since = jnp.broadcast_to(time, change.shape)
    share = tool_contact(scene, nodes, sheet.triangles, since, time)
    still = (state.status == 0) & is_at_rest(state, scene) & last
    end = jnp.where(still, jnp.maximum(scene.solver.end_time, time), time)
    change = temperature_change(ThermalState(change, since, change), cooling, first, wall, share, density, end)
    shares = jnp.stack([sheet.area, jnp.where(used, sheet.area * change, 0.0)])
    area, total = (membrane.sum_to_nodes(row, sheet.triangles, now.mass.size) for row in shares)
    return total / jnp.where(area > 0.0, area, 1.0)


def _added_mass(scene: Scene, now: Discretization, mesh: RefinedMesh | None) -> jax.Array:
    adaptivity, volume = scene.adaptivity, now.sheet.area * now.thickness
    if adaptivity is None or mesh is None:
        return jnp.zeros((), volume.dtype)
    _, forest = adaptivity
    return jnp.sum(volume * (forest.mass_scale[mesh.element] - 1.0)) / jnp.sum(volume)


def drop_unused(scene: Scene, result: Result) -> tuple[Scene, Result]:
    """The part with existing nodes and elements only, for pictures and files: drops unused capacity, on the host.

    A moving mold, and moving tools, are at their positions at that time.
    """
    if scene.surfaces:
        mold, tools = scene.mold, tuple(tool.at(float(result.time)) for tool in scene.tools)
        scene = dataclasses.replace(scene, mold=None if mold is None else mold.at(float(result.time)), tools=tools)
    if scene.refinement is None:
        return scene, result
    active, used = np.asarray(result.active), np.asarray(result.used)
    number = np.cumsum(active) - 1
    triangles = number[np.asarray(result.triangles)[used]].astype(np.int32)
    kept = result.of(NODAL, active) | result.of(OF_ELEMENTS, used)
    sheet = {name: np.asarray(getattr(scene.parison, name))[active] for name in ("positions", "thickness")}
    sheet |= {name: np.asarray(getattr(scene.parison, name))[active] for name in ("clamped", "fixed")}
    if scene.parison.temperature is not None:
        sheet["temperature"] = np.asarray(scene.parison.temperature)[active]
    parison: Any = dataclasses.replace(scene.parison, triangles=triangles, **sheet)  # pyright: ignore
    made: Any = dataclasses.replace(result, triangles=triangles, **kept)
    zones: Any = {name: np.asarray(values)[..., active] for name, values in scene.material.zones.items()}
    material = scene.material.with_zones(zones)
    return dataclasses.replace(scene, parison=parison, material=material, refinement=None), made


# A formed part as the sheet of the next stage.

Array = NDArray[np.float64]

_THINNEST = 0.5  # of the mean of its elements: below this a corrected nodal thickness is that mean


def parison_of(result: Result, scene: Scene) -> Parison:
    """The formed part as a parison, for `build_scene` of the next stage: its shape without stress, and its mass.

    The mesh has the nodes and elements that exist at the end. Nodes that are clamped at the end, and those on
    symmetry planes, keep their constraints. Material parameters that vary over the sheet are not part of a parison; the
    next scene needs them at the nodes of this parison, which are `result.active` of the former ones.

    Args:
        result: The part; not traced.
        scene: The simulated scene.

    Returns:
        The parison, with the final positions (n_node, 3) [m], and a nodal thickness (n_node,) [m] with the volume of
        the part to rounding.
    """
    kept, part = drop_unused(scene, result)
    positions, triangles = np.asarray(part.positions, float), np.asarray(part.triangles)
    temperature = kept.parison.temperature if part.temperature is None else part.temperature
    return make_parison(
        positions,
        triangles,
        _conserve_volume(
            np.asarray(part.thickness, float), positions, triangles, np.asarray(part.element_volume, float)
        ),
        np.asarray(kept.parison.clamped) & (np.asarray(part.contact_time) == 0.0),
        np.asarray(kept.parison.fixed),
        None if temperature is None else np.asarray(temperature),
        guided=kept.parison.guided,
    )


def _conserve_volume(thickness: Array, positions: Array, triangles: NDArray[np.integer], volume: Array) -> Array:
    """A nodal thickness (n_node,) [m] near the given one, whose elements have the given volume (n_element,) in all.

    An element's thickness is the mean of its nodes'. What it has too much or too little of its volume is shared out
    to its nodes, in proportion to their areas, so that the sum of all volumes is right. Where a node would become much
    thinner than its elements, all nodes have the mean of their elements by area, which conserves the sum as well.
    """
    corners = positions[triangles]
    area = 0.5 * np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)

    def lump(values: Array) -> Array:
        return np.bincount(triangles.ravel(), np.repeat(values / 3, 3), len(positions))

    mean = lump(volume) / lump(area)
    corrected = thickness + lump(volume - area * thickness[triangles].mean(1)) / lump(area)
    return corrected if np.all(corrected > _THINNEST * mean) else mean

"""The state of a simulation, its schedule and energy balance, and when it is finished."""

from __future__ import annotations

import dataclasses
import enum
from typing import Any, NewType, Self

import jax
import jax.numpy as jnp

from jaxform.contact.edge_contact import HeldSides
from jaxform.contact.sliding import ToolEnergies, on_surface
from jaxform.core.pytree import as_real, marked_field_names, pytree
from jaxform.loads import LoadState
from jaxform.mechanics import membrane
from jaxform.mechanics.elements import Nodes
from jaxform.model.scene import Scene
from jaxform.model.tables import SLACK
from jaxform.sheet.discretization import RefinedMesh
from jaxform.sheet.heat import ThermalState


class Status(enum.IntFlag):
    """Reasons why a run stopped early or is not to be trusted (UNBALANCED); no bit is set when all went well.

    `explain` says each in words. The status of a result is an integer of these bits: `result.status & Status.INPUT`.

    Attributes:
        NON_FINITE: A position or velocity is not finite; the state before that window is kept.
        UNSTABLE: The sheet holds more energy than was put in, or less.
        WINDOWS_EXHAUSTED: The steps that the run may take did not suffice to reach the end time.
        CONTACT_OVERFLOW: More pairs of node and mold triangle, or of side and edge, were found than the capacity.
        CONTACT_MISSED: A node moved so far in one step that it may have missed the mold.
        STOPPED: Stopped by the caller of `run`.
        REFINEMENT_OVERFLOW: Refinement needs more elements or nodes than the capacity.
        RUNAWAY: The sheet is ten thousand times as large as it was.
        UNBALANCED: The end was reached, but the energy balance misses more than 1 % of the work.
        INPUT: A number that was traced is out of its range. Nothing was simulated, and all walls are NaN.
        ESCAPED: The sheet left its mold.
        BURST: The sheet passed through itself; found by the host's loop, `run`, alone.
        UNFILLED: A fifth of the opening's depth, or more, is left open; found after the run on the host, by `run` and
            in the status of `summarize`, never by `simulate`.
    """

    NON_FINITE = 1
    UNSTABLE = 2
    WINDOWS_EXHAUSTED = 4
    CONTACT_OVERFLOW = 8
    CONTACT_MISSED = 16
    STOPPED = 32
    REFINEMENT_OVERFLOW = 64
    RUNAWAY = 128
    UNBALANCED = 256
    INPUT = 512
    ESCAPED = 1024
    BURST = 2048
    UNFILLED = 4096


WindowLog = tuple[jax.Array, jax.Array, jax.Array]
"""Step lengths, step counts and bounds of windows (n_window,), as in `Schedule`."""


@pytree
class Schedule:
    """The decisions of a run at its window boundaries; another run that is given them makes the same decisions.

    Attributes:
        lengths: Step length of each window (n_window,) [s].
        counts: Number of steps of each window (n_window,); 0 for windows that were rejected or not needed.
        bounds: Bound of the elements on the step length at the begin of each window (n_window,) [s].
        split_at: Window at whose begin each triangle of the forest was bisected (n_triangle,); None without refinement.
    """

    lengths: jax.Array
    counts: jax.Array
    bounds: jax.Array
    split_at: jax.Array | None

    def next_row(self, row: jax.Array) -> jax.Array:
        """The first row from `row` on that has steps; the number of rows where none has."""
        index = jnp.arange(self.counts.size, dtype=row.dtype)
        return jnp.min(jnp.where((index >= row) & (self.counts > 0), index, index.size))


LOSS = {"loss": True}
"""Marks energy that leaves the sheet: a term of the balance, of the same name in `Energy` and in the summary."""


@pytree
class EnergyBalance:
    """Energy balance of a run so far [J].

    Attributes:
        volume: Enclosed before the last step [m^3]; where loads push regions of the sheet, by each of these (n_load,).
        load_state: State of the loading before the last step; None where the pressure depends on the time alone.
        external_work: Work of the pressure: its forces times the nodes' displacements.
        damping_loss, contact_loss: Dissipated by damping, and by impacts on the mold.
        refinement_loss: Strain and kinetic energy that new nodes took away.
        peak_work: Largest magnitude of the external work.
        kinetic_peak: Largest kinetic energy at the end of a window.
        kinetic_excess: Kinetic energy half a step before the last window's end, less that at its end.
        imbalance: Energy held and lost beyond the external work, at the last window's end.
        viscous_loss: Dissipated by the Prony terms; None without Prony terms.
        cooling_loss: Strain energy lost as the temperature softened the sheet, less what it won as it stiffened;
            None where neither happens.
        tool_work: Done by the mold on what it holds, up to the last force; None where it rests.
        tool_last: Contribution of the present force to that, at the last window's end; None where it rests.
        friction_loss: Dissipated by friction; None where nodes stick to all tools.
        rim: Volume that moving rims swept since the last step's begin [m^3]; None where there are none.
        gravity_work: Done by gravity on the nodes; None where none acts.
        pre_stretch_work: Strain energy of the pre-stretched sheet when the run begins; None where it has no stress.
        by_tool: The parts of `tool_work` and `friction_loss` of each tool, where these are counted for each.
        last_by_tool: The same of `tool_last`.
        unresolved: Energy that steps do not resolve, as in `scheme.unresolved_energy`; None where it is not counted.
        restarts: The part of it from where motion began anew after the run's begin, as nodes were inserted or a clamp
            opened; None where neither happens. Windows that miss much of the rest are retried with shorter steps.
    """

    volume: jax.Array
    load_state: LoadState | None
    external_work: jax.Array
    damping_loss: jax.Array = dataclasses.field(metadata=LOSS)
    contact_loss: jax.Array = dataclasses.field(metadata=LOSS)
    refinement_loss: jax.Array = dataclasses.field(metadata=LOSS)
    peak_work: jax.Array
    kinetic_peak: jax.Array
    kinetic_excess: jax.Array
    imbalance: jax.Array
    viscous_loss: jax.Array | None = dataclasses.field(default=None, metadata=LOSS)
    cooling_loss: jax.Array | None = dataclasses.field(default=None, metadata=LOSS)
    tool_work: jax.Array | None = None
    tool_last: jax.Array | None = None
    rim: jax.Array | None = None
    gravity_work: jax.Array | None = None
    pre_stretch_work: jax.Array | None = None
    friction_loss: jax.Array | None = dataclasses.field(default=None, metadata=LOSS)
    by_tool: ToolEnergies = ToolEnergies()
    last_by_tool: tuple[jax.Array, ...] = ()
    unresolved: jax.Array | None = None
    restarts: jax.Array | None = None

    def swept_volume(self, volume: jax.Array) -> jax.Array:
        """Volume swept by the sheet since the begin of the last step [m^3], with the present enclosed volume [m^3]."""
        change = volume - self.volume
        return change if self.rim is None else change + self.rim

    @property
    def total_tool_work(self) -> jax.Array | None:
        """All the work of the tool [J]; None where it rests."""
        return None if self.tool_work is None or self.tool_last is None else self.tool_work + self.tool_last

    @property
    def total_by_tool(self) -> ToolEnergies:
        """All the energies of each tool, where they are counted for each [J]."""
        works = zip(self.by_tool.work, self.last_by_tool, strict=True)
        return self.by_tool._replace(work=tuple(done + last for done, last in works))

    @property
    def work(self) -> jax.Array:
        """Done on the sheet so far, by pressure, tool, gravity and pre-stretch [J]."""
        others = self.total_tool_work, self.gravity_work, self.pre_stretch_work
        return sum((term for term in others if term is not None), self.external_work)

    def losses(self) -> dict[str, jax.Array]:
        """The terms by which energy left, by name."""
        found = {name: getattr(self, name) for name in LOSSES}
        return {name: value for name, value in found.items() if value is not None}


LOSSES = marked_field_names(EnergyBalance, LOSS)


@pytree
class Control:
    """Data for choosing the step length and the window length.

    Attributes:
        step_length: Length of the last step [s]; 0 before the first.
        window_steps: Steps that the next window takes, unless it is cut short or the end is near.
        retries: Times that the present window was retried with half the step: it blew up, or may have missed the mold.
        bound, sharpness: The elements' bound on the step [s], and how many times as long the measured one is; 0 before.
        base_length: Step [s] of the last window before it was halved by retries or to divide the remaining time evenly;
            0 before the first window.
        last_length, last_count: Step length [s] and steps of the last window; no steps where it was rejected.
        cooling_rate: Largest cooling rate of the sheet [K/s]; None where it does not cool.
    """

    step_length: jax.Array
    window_steps: jax.Array
    retries: jax.Array
    bound: jax.Array
    sharpness: jax.Array
    base_length: jax.Array
    last_length: jax.Array
    last_count: jax.Array
    cooling_rate: jax.Array | None = None


@pytree
class Replay:
    """Position in the schedule that a run follows: the row of the next steps, and the elapsed time of it [s]."""

    row: jax.Array
    row_time: jax.Array


@pytree
class State:
    """The state of a simulation.

    Attributes:
        nodes: Its nodal fields, in the mesh's order; see `PackedState`.
        account: Its energy balance so far.
        control: Data for choosing step and window lengths.
        replay: Position in a schedule.
        mesh: Present triangles of the forest; None without refinement.
        memory: Stress of the Prony terms (4 n_mode, n_element), as in `materials.viscous`; None without Prony terms.
        time: [s].
        steps, windows, shortened: Steps and windows taken; windows that were rejected and retried.
        status: Bits of `Status`.
        heat: Temperature change of the elements by cooling; None where they do not cool.
        held: Sides that are held at sharp edges of tools; None where none can be.
    """

    nodes: Nodes
    account: EnergyBalance
    control: Control
    replay: Replay
    mesh: RefinedMesh | None
    memory: jax.Array | None
    time: jax.Array
    steps: jax.Array
    windows: jax.Array
    shortened: jax.Array
    status: jax.Array
    heat: ThermalState | None = None
    held: HeldSides | None = None

    @property
    def refined_mesh(self) -> RefinedMesh:
        """The mesh of a state of a scene that is refined."""
        assert self.mesh is not None
        return self.mesh

    def replace_nodes(self, **fields: Any) -> Self:
        """The state with other values of some nodal fields."""
        return dataclasses.replace(self, nodes=dataclasses.replace(self.nodes, **fields))


PackedState = NewType("PackedState", State)
"""A state in the packed order of `active_set.ActiveSet`, as windows have it: its nodes, and its memory."""


def initial_node_state(
    scene: Scene, node: jax.Array | None = None, *, opened: jax.Array | bool = False
) -> tuple[jax.Array, jax.Array, jax.Array, jax.Array | None]:
    """Initial state of these nodes (n,), or of all: immobile nodes and nodes in contact with the mold are stuck.

    Args:
        scene: The scene.
        node: Their numbers; None for all nodes.
        opened: True if the clamp is open: its nodes are then like all others.

    Returns:
        `stuck`, `contact_time` [s], `wall` and `tool`, as in `Nodes`.
    """
    mobility, touching, tool = scene.tables.mobility, scene.tables.initial_contact, scene.tables.initial_tool
    if node is not None:
        mobility, touching = mobility[:, node], None if touching is None else touching[node]
        tool = None if tool is None else tool[node]
    held = jnp.all(mobility == 0.0, axis=0)
    if scene.parison.clamp_until is not None:
        clamped = scene.parison.clamped if node is None else scene.parison.clamped[node]
        held |= clamped & ~jnp.asarray(opened)
    time = jnp.where(held, 0.0, as_real(-1.0))
    if len(scene.surfaces) > 1 and tool is None:
        tool = jnp.zeros(held.size, jnp.int32)
    if touching is None:
        return held, time, jnp.zeros(held.size, jnp.int32), tool
    touches = ~held & (touching != 0)
    sticks = touches
    for number, surface in enumerate(scene.surfaces):
        if not surface.mold.contact.sticks:
            sticks = sticks & ~(tool == number) if tool is not None else jnp.zeros_like(touches)
    # Earlier than any step, but later than the time of clamped nodes.
    first = jnp.where(touches, jnp.finfo(time.dtype).tiny, time)
    return held | sticks, first, jnp.where(touches, touching, 0), tool


def noise_vector(positions: jax.Array) -> jax.Array:
    """Pseudo-random directions (3, n_node), the same in every run, which contain every mode."""
    # The same for a node at any capacity.
    number = jnp.arange(3, dtype=jnp.uint32)[:, None] + 3 * jnp.arange(positions.shape[1], dtype=jnp.uint32)[None]
    mixed = (number + 1) * jnp.uint32(2654435761)
    mixed = (mixed ^ (mixed >> 15)) * jnp.uint32(2246822519)
    return (mixed >> 8).astype(positions.dtype) / 2**23 - 1.0


def clamp_is_open(state: State, scene: Scene) -> jax.Array:
    """True from the window boundary at which the clamp opens; always False where it never opens."""
    until = scene.parison.clamp_until
    if until is None:
        return jnp.asarray(False)
    return state.time + SLACK * state.control.last_length >= until


def next_stop(state: State, scene: Scene) -> jax.Array:
    """The time [s] at which the run ends, or before that the clamp opens: no window goes beyond it."""
    end, until = scene.solver.end_time, scene.parison.clamp_until
    return end if until is None else jnp.where(clamp_is_open(state, scene), end, jnp.minimum(end, until))


def is_finished(state: State, scene: Scene) -> jax.Array:
    """True where the end is reached, nothing can move, or an error was detected."""
    slack = 16 * jnp.finfo(state.time.dtype).eps
    done = (state.time >= scene.solver.end_time * (1.0 - slack)) | (state.status != 0)
    return done | is_at_rest(state, scene)


def is_at_rest(state: State, scene: Scene) -> jax.Array:
    """True where no node can move any more, so that a run ends before its time."""
    if not (scene.solver.end_early and scene.rests):
        return jnp.asarray(False)
    return jnp.all(immobile_nodes(state, scene))


def immobile_nodes(state: State, scene: Scene) -> jax.Array:
    """Nodes (n_node,) that never move again: they are clamped, or stick to a tool that rests from now on.

    A node rests with its tool from the step after the tool's last on. Times decide that, not velocities or
    displacements, which may be designed; and a window may end where the tool does: a knot that is a little later
    decides the same. A node that the clamp holds does not rest before that has been opened.
    """
    nodes, until = state.nodes, scene.parison.clamp_until
    immobile = nodes.stuck
    if until is not None:
        immobile = immobile & ((nodes.wall != 0) | (state.time >= until + state.control.last_length))
    for number, surface in enumerate(scene.surfaces):
        motion = surface.mold.motion
        if motion is not None:
            moving = state.time < motion.last_time + state.control.last_length
            immobile = immobile & ~(moving & (nodes.wall != 0) & on_surface(nodes.tool, number))
    return immobile


def can_move(immobile: jax.Array, triangles: jax.Array, area: jax.Array) -> jax.Array:
    """Elements (n_element,) in use of which a node can still move; immobile (n_node,), triangles (3, n_element)."""
    first, second, third = (membrane.gather(immobile, corner) for corner in triangles)
    return ~(first & second & third) & (area > 0.0)


def differentiable_leaves(state: State) -> State:
    """Mask of the leaves of a state that carry a derivative."""
    none: Any = jax.tree.map(lambda _: False, state)
    smooth: Any = state.nodes.map_fields(lambda _, rule: rule.smooth)
    pressed: Any = jax.tree.map(lambda x: jnp.issubdtype(x.dtype, jnp.inexact), state.account.load_state)
    terms = dict.fromkeys(("volume", "external_work", *state.account.losses()), True)
    if state.account.tool_work is not None:
        terms |= {"tool_work": True, "tool_last": True}
    optional = ("rim", "gravity_work", "pre_stretch_work", "unresolved")
    terms |= {name: True for name in optional if getattr(state.account, name) is not None}
    by_tool: Any = jax.tree.map(lambda _: True, (state.account.by_tool, state.account.last_by_tool))
    account = dataclasses.replace(
        none.account, **terms, load_state=pressed, by_tool=by_tool[0], last_by_tool=by_tool[1]
    )
    memory = None if state.memory is None else True
    heat = None if none.heat is None else dataclasses.replace(none.heat, change=True, felt=True)
    held = None if none.held is None else dataclasses.replace(none.held, share=True, point=True)
    return dataclasses.replace(none, nodes=smooth, account=account, memory=memory, heat=heat, held=held)

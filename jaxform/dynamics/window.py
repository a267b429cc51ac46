"""One window of steps.

Every loop uses the same window. Discrete decisions (the step length, the active elements, the nodes
tested against the mold) are made at window boundaries only, and are piecewise constant in the design; inside a window
all shapes are fixed and the state is continuous.
"""

from __future__ import annotations

import dataclasses
import functools
import operator
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from jaxform.contact import sticking
from jaxform.contact.broad_phase import CandidateLists, Candidates, allocate_lists, initial_check
from jaxform.contact.candidates import list_candidates
from jaxform.contact.facet_slip import begin_facets
from jaxform.dynamics.contact_step import any_missed, to_tool_frame
from jaxform.dynamics.edge_step import invert_at_begin, list_sides
from jaxform.dynamics.step import finalize_history, step, stop_landed_nodes
from jaxform.dynamics.timestep import (
    LEVELS_PER_OCTAVE,
    StepChoice,
    allocate_basis,
    choose_step,
    element_step_bound,
    max_step_count,
)
from jaxform.dynamics.window_end import end_of_window_energy, end_window
from jaxform.dynamics.window_state import ContactSearch, KnownContact, WindowData, WindowState
from jaxform.kernels.blocks import compile_as_one, entry
from jaxform.kernels.derivatives import save_decision
from jaxform.mechanics import membrane
from jaxform.mechanics.elements import Corners, allocate_corner_forces
from jaxform.model.scene import Scene
from jaxform.model.tables import SHORT_WINDOW, SLACK
from jaxform.sheet.active_set import ActiveSet, Workspace, active_set_of
from jaxform.sheet.cooling import cool_state
from jaxform.sheet.discretization import NEVER, Discretization
from jaxform.sheet.energy_balance import rim_places
from jaxform.sheet.scheme import pressures, velocity_steps
from jaxform.sheet.state import PackedState, Schedule, State, next_stop

_STIFFER = 0.95  # of a schedule's bound on the step: down to that, its steps are kept


def window(
    state: State,
    scene: Scene,
    discrete: Discretization,
    schedule: Schedule | None = None,
    *,
    differentiable: bool = True,
) -> State:
    """The state after a window of steps, with decisions made at its begin or given by a schedule.

    A design may move faster than the one whose schedule it follows: then the window is rejected and retried with
    shorter steps, as without a schedule. Without a derivative a halted window ends at once; with one its remaining
    steps change nothing.
    """
    active = active_set_of(state, scene, discrete, differentiable=differentiable)
    packed, active = cool_state(active.pack_state(state), scene, active, differentiable=differentiable)
    decisions = save_decision(_make_decisions(packed, scene, active, schedule))
    return active.unpack_state(step_window(packed, scene, active, decisions, differentiable=differentiable)[0])


def window_in_place(state: PackedState, scene: Scene, active: ActiveSet) -> tuple[PackedState, ActiveSet]:
    """Advances a state in packed order by a window, not differentiable; also returns the workspace for the next."""
    state, active = cool_state(state, scene, active, differentiable=False)
    chosen = choose_step(state, scene, active)

    def advance(carry: tuple[PackedState, Workspace | None]) -> tuple[PackedState, Workspace | None]:
        state, workspace = carry
        decisions = (*chosen[:3], workspace), None
        state, _, workspace = step_window(state, scene, active, decisions, differentiable=False)
        return state, workspace

    state, workspace = compile_as_one(advance, (state, chosen[3]), state.windows)
    return state, dataclasses.replace(active, workspace=workspace)


def allocate_workspace(active: ActiveSet, scene: Scene) -> ActiveSet:
    """The active set with a workspace for the arrays computed in every window."""
    places, elements = active.compliance, active.packed.elements
    basis = allocate_basis(places.shape[1], places.dtype) if scene.solver.sharp_step else None
    lists = _allocate_lists(scene, places) if scene.surfaces else None
    return dataclasses.replace(active, workspace=Workspace(allocate_corner_forces(places, elements), basis, lists))


def window_and_impacts(
    state: State, scene: Scene, discrete: Discretization, schedule: Schedule | None
) -> tuple[State, jax.Array, jax.Array | None]:
    """The state after a window, and the contacts that were made in it; not differentiable.

    Returns:
        The state; the step in which each node landed (n_node,), NEVER for the others; and the impacts (6 or 12,
        n_node), as in `sticking.Landing`, None without a mold.
    """
    active = active_set_of(state, scene, discrete)
    impacts, packed = bool(scene.surfaces), active.packed
    begin = active.pack_state(state)
    decisions = _make_decisions(begin, scene, active, schedule)
    end, current, _ = step_window(begin, scene, active, decisions, differentiable=False, impacts=impacts)
    # Nothing landed in a rejected window.
    landed = jnp.where(end.control.last_count > 0, packed.unpack(current.landing_step), NEVER)
    return active.unpack_state(end), landed, None if current.impact is None else packed.unpack(current.impact)


def step_window(
    state: PackedState,
    scene: Scene,
    active: ActiveSet,
    decisions: Decisions,
    *,
    differentiable: bool,
    impacts: bool = False,
) -> tuple[PackedState, WindowState, Workspace | None]:
    """The state after a window with given decisions, the window state at its end, and the workspace."""
    (length, max_count, (mode, bound, sharpness, base_length), workspace), row = decisions
    modes = active.viscous(scene.material)
    data = WindowData(
        active=active,
        begin=state.time,
        length=length,
        bound=bound,
        max_count=max_count,
        row=row,
        always_check=state.control.last_count == 0,
        recursion=None if modes is None else modes.recursion(length),
        loss_modes=None if modes is None else modes.limit_losses(length),
        rim=rim_places(scene, state.mesh, active.packed),
        edge_inverse=invert_at_begin(state, scene, active, length),
    )
    timing = state.time, state.control.step_length, length
    longest = scene.tables.step_capacity
    steps = *pressures(scene.pressure, timing, longest), velocity_steps(timing, longest)
    lists = None
    if differentiable:
        current, searched = _replay_steps(state, scene, data, steps)
    else:
        current, searched, lists = _advance(state, scene, data, steps, workspace, impacts)
    current = finalize_history(stop_landed_nodes(current, scene, data), scene, data)
    begin = dataclasses.replace(
        state,
        nodes=dataclasses.replace(state.nodes, mode=mode),
        control=dataclasses.replace(state.control, sharpness=sharpness, base_length=base_length),
    )
    end, corners = end_of_window_energy(current, scene, data)
    if workspace is not None:
        workspace = Workspace(corners, workspace.basis, lists)
    return end_window(begin, current, end, searched, scene, data), current, workspace


_Steps = tuple[jax.Array, ...]
"""Pressure, mean pressure [Pa] and velocity step [s] of all steps of a window, as in `step`."""
_Lists = tuple[CandidateLists, ...]
"""Workspace of the candidate lists of all surfaces."""
_Searching = tuple[WindowState, ContactSearch, _Lists]


def _advance(
    state: PackedState,
    scene: Scene,
    data: WindowData,
    steps: _Steps,
    workspace: Workspace | None,
    impacts: bool,
    recorded: bool = False,
) -> tuple[WindowState, ContactSearch | None, _Lists | None]:
    """The window state after its steps, with contact searched for; not differentiable."""
    if workspace is None:
        corners = allocate_corner_forces(state.nodes.positions, data.active.packed.elements)
    else:
        corners = workspace.corners
    current = _begin_window(state, scene, data, corners, impacts, recorded)
    current = _set_positions(current, membrane.unstack_rows(state.nodes.positions))
    if not scene.surfaces:
        current, searched, lists = _advance_until_halted(current, scene, data, steps), None, None
    else:
        lists = None if workspace is None else workspace.lists
        lists = _allocate_lists(scene, state.nodes.positions) if lists is None else lists
        current, searched, lists = _advance_over_lists(current, scene, data, steps, lists)
    return _set_positions(current, jnp.stack(current.nodes.positions)), searched, lists


def _advance_over_lists(
    current: WindowState, scene: Scene, data: WindowData, steps: _Steps, lists: _Lists
) -> tuple[WindowState, ContactSearch, _Lists]:
    """The window state after its steps with tools; candidates are listed again whenever the lists become stale."""
    count = len(scene.surfaces)

    def advance_with_lists(
        carry: tuple[WindowState, ContactSearch, _Lists],
    ) -> tuple[WindowState, ContactSearch, _Lists]:
        current, (most, overflow, any_before), lists = carry
        candidates = tuple(_list_candidates(current, scene, data, number, lists[number]) for number in range(count))
        full = functools.reduce(operator.or_, [listed.overflow for listed in candidates])
        current = dataclasses.replace(
            current, halted=current.halted | full, stale=jnp.asarray(False), check=(initial_check(),) * count
        )
        current = _advance_until_halted(current, scene, data, steps, candidates)
        missed = any_missed(current, candidates, scene, data)
        pairs = functools.reduce(jnp.maximum, [listed.count for listed in candidates], most)
        current = dataclasses.replace(current, halted=current.halted | missed)
        full = full if current.held is None else full | current.held.overflow
        found = pairs, overflow | full, any_before | missed
        return current, found, tuple(listed.lists for listed in candidates)

    none = jnp.int32(0), jnp.asarray(False), jnp.asarray(False)
    return jax.lax.while_loop(lambda carry: _continues(carry[0], data), advance_with_lists, (current, none, lists))


def _advance_until_halted(
    current: WindowState,
    scene: Scene,
    data: WindowData,
    steps: _Steps,
    candidates: tuple[Candidates, ...] | None = None,
) -> WindowState:
    """The window state after steps until the window ends or the lists of candidates become stale."""

    def continues(current: WindowState) -> jax.Array:
        more = _continues(current, data)
        return more if current.stale is None else more & ~current.stale

    def advance(current: WindowState) -> WindowState:
        return step(current, jax.tree.map(lambda x: entry(x, current.count), steps), scene, data, candidates)

    return jax.lax.while_loop(continues, advance, current)


def _continues(current: WindowState, data: WindowData) -> jax.Array:
    return (current.count < data.max_count) & ~current.halted


def _replay_steps(
    state: PackedState, scene: Scene, data: WindowData, steps: _Steps
) -> tuple[WindowState, ContactSearch | None]:
    """The window state after its steps, differentiable; with tools, contact is first searched without derivative."""
    searched = known = None
    current = _begin_window(state, scene, data)
    if scene.surfaces:
        found, searched, _ = _advance(*jax.lax.stop_gradient((state, scene, data, steps)), None, False, scene.slides)
        chosen = sticking.encode_landing(found.nodes.wall, found.nodes.tool, scene.surfaces)
        landings = KnownContact(found.landing_step, chosen, found.count, found.record, found.held)
        known, searched = save_decision((landings, searched))
        current = dataclasses.replace(current, halted=known.count == 0)
        if current.held is not None and known.sides is not None:
            sides = known.sides
            held = dataclasses.replace(
                current.held,
                ends=sides.ends,
                edge=sides.edge,
                step=sides.step,
                softness=jax.lax.stop_gradient(sides.softness),
                count=sides.count,
            )
            current = dataclasses.replace(current, held=held)
    current = _scan_in_chunks(lambda current, own: (step(current, own, scene, data, known), None), current, steps)
    return current, searched


def _set_positions(current: WindowState, positions: Any) -> WindowState:
    return dataclasses.replace(current, nodes=dataclasses.replace(current.nodes, positions=positions))


Decisions = tuple[StepChoice, tuple[jax.Array, jax.Array] | None]
"""Decisions at a window boundary: the steps, and where a schedule is followed their row, as in `WindowData`."""


def _make_decisions(state: PackedState, scene: Scene, active: ActiveSet, schedule: Schedule | None) -> Decisions:
    if schedule is None:
        return choose_step(state, scene, active), None
    row = schedule.next_row(state.replay.row)

    def from_schedule(state: PackedState, scene: Scene, active: ActiveSet) -> Decisions:
        length, count = schedule.lengths[row], schedule.counts[row]
        left = jnp.minimum(length * count - state.replay.row_time, jnp.maximum(scene.solver.end_time - state.time, 0.0))
        # Where the sheet is stiffer for its mass than that of the schedule, the steps are shorter by whole levels.
        bound = element_step_bound(state, scene, active)
        levels = jnp.ceil(jnp.log2(_STIFFER * schedule.bounds[row] / bound) * LEVELS_PER_OCTAVE) / LEVELS_PER_OCTAVE
        finer = jnp.exp2(jnp.maximum(levels, 0.0) + state.control.retries)
        rest = left
        if scene.parison.clamp_until is not None:
            rest = jnp.minimum(left, jnp.maximum(next_stop(state, scene) - state.time, 0.0))
        # The count of the schedule at the begin of a row; later the remaining time is divided evenly.
        steps = jnp.ceil(rest / length * finer - SLACK).astype(count.dtype)
        fresh = (steps == count) & (state.replay.row_time == 0.0)
        even = rest / jnp.maximum(steps, 1)
        length = jnp.where(fresh, jnp.minimum(length, even), even)
        most = jnp.clip(steps, 1, max_step_count(length, scene))
        limit = state.nodes.mode, bound, state.control.sharpness, state.control.base_length
        return (length, most, limit, None), (row, left)

    def beyond_schedule(state: PackedState, scene: Scene, active: ActiveSet) -> Decisions:
        return choose_step(state, scene, active), (row, jnp.full_like(state.time, jnp.inf))

    arguments = jax.lax.stop_gradient((state, scene, active))
    return jax.lax.cond(row < schedule.counts.size, from_schedule, beyond_schedule, *arguments)


def _begin_window(
    state: PackedState,
    scene: Scene,
    data: WindowData,
    corners: Corners | None = None,
    impacts: bool = False,
    recorded: bool = False,
) -> WindowState:
    """The window state before the first step; with a workspace for corner forces if no derivative is taken."""
    places, positions = data.active.mass.size, state.nodes.positions
    searches = bool(scene.surfaces) and corners is not None
    return WindowState(
        nodes=state.nodes.contact_fields(),
        fields=state.nodes.fields,
        account=state.account,
        memory=state.memory,
        landing_step=jnp.full(places, NEVER, jnp.int32),
        impact=jnp.zeros((12 if scene.lands_smoothly else 6, places), positions.dtype) if impacts else None,
        count=jnp.int32(0),
        halted=jnp.asarray(False),
        stale=jnp.asarray(False) if searches else None,
        check=(initial_check(),) * len(scene.surfaces) if searches else None,
        corners=corners,
        hits=sticking.no_hits(places, positions.dtype) if searches else None,
        record=jnp.full((scene.tables.step_capacity, places), -1, jnp.int32) if recorded else None,
        facets=begin_facets(state.nodes, data.active.compliance, scene.surfaces) if scene.slides and searches else None,
        held=None if state.held is None else state.held.at(data.active.packed.place),
    )


def _scan_in_chunks(advance: Callable[..., Any], current: WindowState, steps: tuple[jax.Array, ...]) -> WindowState:
    """The window state after all steps, differentiable; chunks of a long window are skipped once it is halted."""

    def scan_chunk(current: WindowState, steps: tuple[jax.Array, ...]) -> WindowState:
        return jax.lax.scan(advance, current, steps)[0]

    def skip_if_halted(current: WindowState, steps: tuple[jax.Array, ...]) -> tuple[WindowState, None]:
        return jax.lax.cond(current.halted, lambda current, _: current, scan_chunk, current, steps), None

    if len(steps[0]) <= SHORT_WINDOW:
        return scan_chunk(current, steps)
    chunks = jax.tree.map(lambda values: values.reshape(-1, SHORT_WINDOW), steps)
    return jax.lax.scan(skip_if_halted, current, chunks)[0]


def _list_candidates(
    current: WindowState, scene: Scene, data: WindowData, number: int, into: CandidateLists
) -> Candidates:
    """Candidates for the remaining steps of a window, of one surface."""
    places = to_tool_frame(current, scene, data, number)
    (positions, velocities), grid = jax.lax.stop_gradient((places, scene.surfaces[number].grid))
    listed = list_candidates(
        jnp.stack(positions),
        velocities,
        ~current.nodes.stuck,
        jax.lax.stop_gradient(data.length),
        data.max_count - current.count,
        grid,
        scene.solver.skip_far,
        into,
        data.active.packed.elements.node_block_count,
    )
    return list_sides(listed, current, scene, data, number) if scene.tables.edges else listed


def _allocate_lists(scene: Scene, positions: jax.Array) -> _Lists:
    lists = allocate_lists(positions.shape[1], positions.dtype, scene.tables.pairs_per_node)
    return (lists,) * len(scene.surfaces)

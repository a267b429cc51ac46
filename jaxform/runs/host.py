"""`run`: the loop on the host, which shows progress, can be stopped, and increases capacities."""

from __future__ import annotations

import dataclasses
import time
import warnings
from collections.abc import Callable, Sequence
from concurrent.futures import Future
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxform.adapt.refinement import can_enlarge_capacity, enlarge_capacity, refine_in_place
from jaxform.core.compilation import device_context, with_standard_promotion
from jaxform.core.errors import InputWarning
from jaxform.core.store import PACKAGE, PendingProgram, Store
from jaxform.dynamics.window import allocate_workspace, window_in_place
from jaxform.dynamics.window_state import initial_state
from jaxform.kernels.blocks import lax_cond_once
from jaxform.model.replacement import check_numbers, check_scene
from jaxform.model.scene import Scene
from jaxform.results.filling import may_be_unfilled
from jaxform.results.part import has_burst, warnings_of_part
from jaxform.results.result import Result, Seconds, make_result
from jaxform.results.summary import add_filling, warnings_of
from jaxform.results.tool_contact import ContactRecord
from jaxform.runs.padding import PaddedScene, pad_to_bucket
from jaxform.sheet.active_set import ActiveSet, repack, whole_set
from jaxform.sheet.discretization import Discretization, discretize, present_discretization
from jaxform.sheet.scheme import open_clamp
from jaxform.sheet.self_contact import stick_folds
from jaxform.sheet.state import PackedState, State, Status, WindowLog, is_finished

# Larger capacities where a run overflowed: for elements, for pairs near the mold, for windows. On the host.
#
# Sizes of compiled programs are planned when a scene is built. Where one does not suffice, the run keeps the state
# before the overflow, and continues in a program with a larger capacity.

_MORE_PAIRS, _MOST_PAIRS = 4, 2048  # times as many; and at most so many for each node


def enlarge_overflowed(
    scene: Scene, state: State, log: WindowLog, done: bool, most_steps: int
) -> tuple[Scene, State, WindowLog] | None:
    """The scene with a larger capacity of the kind that overflowed, and the run's state for it.

    None where nothing overflowed, or where no larger capacity is possible.

    Args:
        scene: The scene.
        state: State of the run.
        log: Log of its windows.
        done: True if the run is finished.
        most_steps: Limit on the steps of the run.
    """
    status, tables, adaptivity = int(state.status), scene.tables, scene.adaptivity
    if status == Status.REFINEMENT_OVERFLOW and adaptivity is not None and can_enlarge_capacity(adaptivity):
        return *enlarge_capacity(scene, adaptivity, state), log
    if status == Status.CONTACT_OVERFLOW and tables.pairs_per_node < _MOST_PAIRS:
        wider = dataclasses.replace(tables, pairs_per_node=_MORE_PAIRS * tables.pairs_per_node)
        # The window that overflowed does not count as failed.
        retries = jnp.maximum(state.control.retries - 1, 0)
        control = dataclasses.replace(state.control, retries=retries)
        # Either the pairs or the sides that are held at edges were too many.
        held = None if state.held is None else state.held.enlarge(_MORE_PAIRS)
        state = dataclasses.replace(state, status=jnp.zeros_like(state.status), control=control, held=held)
        return dataclasses.replace(scene, tables=wider), state, log
    if not done and int(state.windows) >= tables.window_count and int(state.steps) < most_steps:
        longer = dataclasses.replace(tables, window_count=2 * tables.window_count)
        rows = jax.tree.map(lambda row: jnp.asarray(np.append(row, np.zeros_like(row))), log)
        return dataclasses.replace(scene, tables=longer), state, rows
    return None


def remaining_windows(scene: Scene, state: State, most_steps: int) -> int:
    """Number of windows that a run may take until the end of its plan, or its limit on steps."""
    steps = most_steps - int(state.steps)
    return max(0, min(scene.tables.window_count - int(state.windows), -(-steps // int(scene.tables.longest_window))))


_UNFINISHED, _LAST = np.bool_(False), np.bool_(True)


@dataclasses.dataclass(frozen=True)
class Moment:
    """Progress that `run` reports to its caller after each window.

    Attributes:
        time: Simulated time [s].
        end_time: End of the simulation [s].
        steps: Steps taken.
        result: Function that returns the part in its present state.
        pressure: Pressure at the start of the last step [Pa], where it follows the enclosed volume, of loads of regions
            those by name; else None.
    """

    time: float
    end_time: float
    steps: int
    result: Callable[[], Result]
    pressure: float | dict[str, float] | None = None


@with_standard_promotion
def run(
    scene: Scene,
    *,
    on_window: Callable[[Moment], object] | None = None,
    on_end: Callable[[Result], object] | None = None,
    store: Store | None = None,
) -> Result:
    """Simulates a scene by a loop over windows on the host: the same numbers as `simulate`, without derivatives.

    The part is checked after the last step: the status says, too, whether the sheet burst, and whether it leaves the
    mold unfilled, unless the scene allows that (`Scene.fill`).

    Args:
        scene: The scene.
        on_window: Called after every window with a `Moment`; a true answer stops the run, and its status says so.
            Without it the whole loop is one call of a compiled program.
        on_end: Called with the result after the last step, before the part is compared with the mold, which can take
            seconds; its status is that of the steps alone.
        store: Store for traced programs between runs; none by default.

    Raises:
        InputError: If a number of the scene is out of its range.

    Warns:
        InputWarning: If the process was to be slow (`quasi_static`) and was not, the work of the pressure was below the
            resolution of the energy balance, nothing touched the mold, the sheet left the mold's box or passes through
            itself, or a free wall became implausibly thin.
    """
    check_scene(scene)
    check_numbers(scene)
    with device_context(scene.parison.positions) as placed:
        return placed(_run(scene, on_window, on_end, store or IN_MEMORY))


def _run(
    scene: Scene,
    on_window: Callable[[Moment], object] | None,
    on_end: Callable[[Result], object] | None,
    store: Store,
) -> Result:
    original, padded = scene, select_bucket(scene, store)
    scene, limit = padded.scene, original.solver.max_steps
    start = time.perf_counter()
    begin, advance, ending = programs(scene, store)
    state, first, log = begin(scene)
    loop_start, excluded = time.perf_counter(), 0.0
    follows = state.account.load_state is not None
    pressures: list[tuple[float, ...]] = []
    contacts = ContactRecord(len(original.surfaces), float(original.solver.end_time)) if original.slides else None
    at_once = on_window is None and not follows and contacts is None
    compiling = loop_start - start
    while left := remaining_windows(scene, state, limit):
        window_count = left if at_once else 1
        state, log, done = advance(state, scene, first, log, np.int32(window_count))
        enlarged = enlarge_overflowed(scene, state, log, bool(done), limit)
        if enlarged is not None:
            # One program for each size; the run goes on where it was.
            paused = time.perf_counter()
            scene, state, log = enlarged
            begin, advance, ending = programs(scene, store)
            first = begin(scene)[1]
            compiling += time.perf_counter() - paused
            excluded += time.perf_counter() - paused
            continue
        if follows:
            _record_pressure(pressures, state)
        if on_window is not None or contacts is not None:
            arguments = state, scene, first, log
            part = lambda a=arguments, program=ending: padded.result(program.result()(*a, _UNFINISHED))  # noqa: E731
            part_with_durations = lambda part=part: _with_durations(part(), contacts)  # noqa: E731
            moment = _moment(state, scene, part_with_durations, getattr(original.pressure, "names", ()))
            paused = time.perf_counter()
            if contacts is not None and not done:
                contacts.offer(moment.time, part)
            stop = on_window is not None and on_window(moment)
            excluded += time.perf_counter() - paused
            if stop:
                stopped = state.status | (0 if done else Status.STOPPED)
                state = dataclasses.replace(state, status=jnp.asarray(stopped, jnp.int32))
                break
        if done:
            break
    paused = time.perf_counter()
    make_final = ending.result()
    compiling += time.perf_counter() - paused
    excluded += time.perf_counter() - paused
    final = _with_durations(padded.result(make_final(state, scene, first, log, _LAST)), contacts)
    # The loop's time excludes that of the caller in between, such as for writing frames.
    seconds = Seconds(compiling, time.perf_counter() - loop_start - excluded)
    recorded = {
        "pressures": np.array(pressures).T if pressures else None,
        "contacts": None if contacts is None else contacts.rows(),
        "contact_periods": None if contacts is None else contacts.periods(),
    }
    final = dataclasses.replace(final, seconds=seconds, **recorded)
    if on_end is not None:
        on_end(final)
    if has_burst(final, original):
        final = dataclasses.replace(final, status=final.status | Status.BURST)
    if may_be_unfilled(final, original):
        final = add_filling(final, original)
    for sentence in (*warnings_of(final, original), *warnings_of_part(final, original)):
        warnings.warn(sentence, InputWarning, stacklevel=2, skip_file_prefixes=(str(PACKAGE),))
    return final


def _with_durations(result: Result, contacts: ContactRecord | None) -> Result:
    """The result with the times for which its nodes have touched each tool, where they are recorded."""
    return result if contacts is None else dataclasses.replace(result, contact_duration=contacts.durations(result))


def _record_pressure(pressures: list[tuple[float, ...]], state: State) -> None:
    """Adds the time [s] and the pressures [Pa] at the start of a state's last step, unless the window was rejected."""
    load = state.account.load_state
    assert load is not None
    time = float(state.time) - float(state.control.step_length)
    if not pressures or time > pressures[-1][0]:
        pressures.append((time, *np.atleast_1d(np.asarray(load.pressure, float)).tolist()))


def _moment(state: State, scene: Scene, result: Callable[[], Result], names: Sequence[str] = ()) -> Moment:
    load = state.account.load_state
    pressure = None if load is None else np.asarray(load.pressure, float)
    if pressure is not None:
        pressure = dict(zip(names, pressure.tolist(), strict=True)) if names else float(pressure)
    return Moment(float(state.time), float(scene.solver.end_time), int(state.steps), result, pressure)


# Programs of the host's loop: `begin` starts a run, `advance` takes windows, `result_of` makes the result.

IN_MEMORY = Store()
_ABOVE = 2  # next larger bucket sizes whose compiled programs are used for a smaller mesh too
_LARGE = 20_000  # elements, whose runs take as long as compiling: such a mesh has programs of its own


@jax.jit
def whole_run(scene: Scene) -> Result:
    """A whole run as one compiled function, without the loop on the host."""
    state, first, log = begin(scene)
    state, log, _ = advance(state, scene, first, log, jnp.int32(scene.tables.window_count))
    return result_of(state, scene, first, log, jnp.asarray(True))


@jax.jit
def result_of(
    state: State, scene: Scene, first: Discretization, log: WindowLog | None = None, last: jax.Array | bool = False
) -> Result:
    """The result of a state; that of the last one has its final status."""
    return make_result(state, scene, first, log, last)


@jax.jit
def begin(scene: Scene) -> tuple[State, Discretization, WindowLog]:
    """The initial state and discretization of a run, and empty arrays for the decisions of its windows."""
    count = scene.tables.window_count
    state = initial_state(scene)
    none = jnp.zeros(count, state.time.dtype)
    return state, discretize(scene), (none, jnp.zeros(count, jnp.int32), none)


@jax.jit
def advance(
    state: State, scene: Scene, first: Discretization, log: WindowLog, most: jax.Array
) -> tuple[State, WindowLog, jax.Array]:
    """The state after at most `most` windows, the log with theirs, and True if the run is finished."""

    def continues(carry: _LoopState) -> jax.Array:
        return (carry.count < most) & ~is_finished(carry.state, scene)

    def advance_window(carry: _LoopState) -> _LoopState:
        state, discrete, stale, active = carry.state, carry.discrete, carry.count == 0, carry.active
        if state.mesh is not None:
            before = state.mesh.element_count
            state, discrete, active = refine_in_place(state, scene, discrete, active)
            stale |= state.refined_mesh.element_count != before
            if active.inactive is not None and carry.active.inactive is not None:
                # Idle elements were brought up to date, so that their energy has changed.
                stale |= active.inactive.since > carry.active.inactive.since
        state, active = repack(state, scene, discrete, active, stale)
        state = open_clamp(state, scene, active)
        whole_window = lambda pair: window_in_place(stick_folds(pair[0], scene, pair[1]), scene, pair[1])  # noqa: E731
        after, active = unless_full(state.status, scene, whole_window, (state, active))
        at = state.windows
        log = jax.tree.map(lambda rows, row: rows.at[at].set(row), carry.log, latest_decisions(after))
        return _LoopState(after, discrete, active, log, carry.count + 1)

    discrete = present_discretization(scene, state.mesh, first, stepped=True)
    active = allocate_workspace(whole_set(state, scene, discrete), scene)
    loop_start = _LoopState(active.pack_state(state), discrete, active, log, jnp.int32(0))
    end = jax.lax.while_loop(continues, advance_window, loop_start)
    return end.active.unpack_state(end.state), end.log, is_finished(end.state, scene)


class _LoopState(NamedTuple):
    """State of the loop over windows: the state in packed order, the discretization, and its active set."""

    state: PackedState
    discrete: Discretization
    active: ActiveSet
    log: WindowLog
    count: jax.Array


def latest_decisions(state: State) -> WindowLog:
    """Decisions of the last window: step length, number of steps, and bound on the step length."""
    return state.control.last_length, state.control.last_count, state.control.bound


def unless_full[T](
    status: jax.Array, scene: Scene, advance: Callable[[T], T], state: T, cond: Callable[..., T] = lax_cond_once
) -> T:
    """The state after a window, unchanged if refinement overflowed: a run with a larger capacity continues from it."""
    return advance(state) if scene.refinement is None else cond(status == 0, advance, state)


def _request_programs(scene: Scene, store: Store) -> tuple[PendingProgram, PendingProgram, PendingProgram]:
    """The programs that begin a run, take windows and make its result, which are compiled concurrently.

    Compiling the longest starts as soon as the shapes of its arguments are known.
    """
    beginning = store.start_program(begin, scene)
    state, first, log = beginning[0]
    return (
        beginning,
        store.start_program(advance, state, scene, first, log, np.int32(1)),
        store.start_program(result_of, state, scene, first, log, np.bool_(True)),
    )


def programs(
    scene: Scene, store: Store
) -> tuple[
    Callable[[Scene], tuple[State, Discretization, WindowLog]],
    Callable[..., tuple[State, WindowLog, jax.Array]],
    Future[Callable[..., Result]],
]:
    """The compiled programs that begin a run and take windows, and the pending one that makes its result."""
    (_, beginning), (_, advancing), (_, ending) = _request_programs(scene, store)
    return beginning.result(), advancing.result(), ending


def select_bucket(scene: Scene, store: Store) -> PaddedScene:
    """The scene padded for a run: to its bucket sizes, or to larger ones where only their programs are compiled.

    A mesh that is not refined gives the same result at any capacity, its nodes to the last bit, sums to rounding.
    Padding by two more bucket sizes takes up to 7 % of a run; compiling takes seconds.
    """
    smallest = padded = pad_to_bucket(scene, recorded=True)
    fixed = padded.order is None or scene.refinement is not None or len(scene.parison.triangles) > _LARGE
    if fixed or store.shared or store.has_program(begin, padded.scene):
        return smallest
    for _ in range(_ABOVE):
        padded = pad_to_bucket(scene, len(padded.scene.parison.triangles), recorded=True)
        if _has_programs(padded.scene, store):
            return padded
    return smallest


def is_compiled(scene: Scene, store: Store, least: int | None = None) -> bool:
    """True if a run of a scene finds all its programs compiled, for its bucket sizes or at least `least` elements."""
    padded = select_bucket(scene, store) if least is None else pad_to_bucket(scene, least, recorded=True)
    return _has_programs(padded.scene, store)


def _has_programs(scene: Scene, store: Store) -> bool:
    """True if all programs for a padded scene are compiled."""
    if not store.has_program(begin, scene):
        return False
    (state, first, log), _ = store.start_program(begin, scene)
    ending = store.has_program(result_of, state, scene, first, log, np.bool_(True))
    return ending and store.has_program(advance, state, scene, first, log, np.int32(1))


def compile_for(scene: Scene, store: Store, least: int = 0) -> None:
    """Compiles and stores the programs for scenes of a kind and bucket sizes, for at least `least` elements."""
    for _, program in _request_programs(pad_to_bucket(scene, least, recorded=True).scene, store):
        program.result()


def start_programs(scene: Scene, store: Store) -> None:
    """Starts to compile the programs for a run of a scene; the run will find them in the store."""
    _request_programs(select_bucket(scene, store).scene, store)


def compile_advance(
    state: State, scene: Scene, first: Discretization, log: WindowLog
) -> Callable[..., tuple[State, WindowLog, jax.Array]]:
    """`advance`, compiled for the shapes of a run, in memory."""
    return IN_MEMORY.program(advance, state, scene, first, log, np.int32(1))

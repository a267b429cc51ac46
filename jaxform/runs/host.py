"""`run`: the loop on the host, which shows progress, can be stopped, and increases capacities."""

from __future__ import annotations

import dataclasses
import time
import warnings
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np

from jaxform.adapt.refinement import can_enlarge_capacity, enlarge_capacity
from jaxform.core.errors import InputWarning
from jaxform.core.promotion import device_context, with_standard_promotion
from jaxform.core.store import PACKAGE, Store
from jaxform.model.replacement import check_numbers, check_scene
from jaxform.model.scene import Scene
from jaxform.results.filling import may_be_unfilled
from jaxform.results.part_warnings import has_burst, warnings_of_part
from jaxform.results.result import Result, Seconds
from jaxform.results.summary import add_filling, warnings_of
from jaxform.results.tool_contact import contact_shares
from jaxform.runs.loop import IN_MEMORY, programs, select_bucket
from jaxform.sheet.state import State, Status, Taken

# Larger capacities where a run overflowed: for elements, for pairs near the mold, for windows. On the host.
#
# Sizes of compiled programs are planned when a scene is built. Where one does not suffice, the run keeps the state
# before the overflow, and continues in a program with a larger capacity.

_MORE_PAIRS, _MOST_PAIRS = 4, 2048  # times as many; and at most so many for each node


def enlarge_room(
    scene: Scene, state: State, taken: Taken, done: bool, most_steps: int
) -> tuple[Scene, State, Taken] | None:
    """The scene with a larger capacity of the kind that overflowed, and the run's state in it.

    None where nothing overflowed, or where a larger capacity would be of no use.

    Args:
        scene: The scene.
        state: State of the run.
        taken: Decisions of its windows.
        done: Whether the run is finished.
        most_steps: Limit on the steps of the run.
    """
    status, tables, adaptivity = int(state.status), scene.tables, scene.adaptivity
    if status == Status.REFINEMENT_OVERFLOW and adaptivity is not None and can_enlarge_capacity(adaptivity):
        return *enlarge_capacity(scene, adaptivity, state), taken
    if status == Status.CONTACT_OVERFLOW and tables.pairs_per_node < _MOST_PAIRS:
        wider = dataclasses.replace(tables, pairs_per_node=_MORE_PAIRS * tables.pairs_per_node)
        # The window that overflowed does not count as failed.
        retries = jnp.maximum(state.control.retries - 1, 0)
        control = dataclasses.replace(state.control, retries=retries)
        state = dataclasses.replace(state, status=jnp.zeros_like(state.status), control=control)
        return dataclasses.replace(scene, tables=wider), state, taken
    if not done and int(state.windows) >= tables.window_count and int(state.steps) < most_steps:
        longer = dataclasses.replace(tables, window_count=2 * tables.window_count)
        rows = jax.tree.map(lambda row: jnp.asarray(np.append(row, np.zeros_like(row))), taken)
        return dataclasses.replace(scene, tables=longer), state, rows
    return None


def remaining_windows(scene: Scene, state: State, most_steps: int) -> int:
    """Number of windows that a run may take until the end of its plan, or its limit on steps."""
    steps = most_steps - int(state.steps)
    return max(0, min(scene.tables.window_count - int(state.windows), -(-steps // int(scene.tables.longest_window))))


_RECORDS = 60  # of the contact in a run in which nodes slide
_GOING, _LAST = np.bool_(False), np.bool_(True)


@dataclasses.dataclass(frozen=True)
class Moment:
    """Progress that `run` reports to its caller after each window.

    Attributes:
        time: Simulated time [s].
        end_time: End of the simulation [s].
        steps: Steps taken.
        result: Function that returns the part in its present state.
        pressure: Pressure at the start of the last step [Pa], where it follows the enclosed volume; else None.
    """

    time: float
    end_time: float
    steps: int
    result: Callable[[], Result]
    pressure: float | None = None


@with_standard_promotion
def run(
    scene: Scene,
    *,
    on_window: Callable[[Moment], object] | None = None,
    on_end: Callable[[Result], object] | None = None,
    store: Store | None = None,
) -> Result:
    """Simulates a scene by the host's loop of the same windows; same numbers as `simulate`, no derivative.

    Its status says what is found after the run alone: that the sheet burst, and that the mold is not filled, unless
    the scene says that it need not be (`Scene.fill`).

    Args:
        scene: The scene.
        on_window: Called after every window with a `Moment`; a true answer stops the run, and its status says so.
            Without it the whole loop runs at once.
        on_end: Called with the result when the last step is taken, before the part is measured against the mold,
            which can take seconds; its status is that of the steps.
        store: Store for traced programs between runs; none by default.

    Raises:
        InputError: If a number of the scene is out of its range.

    Warns:
        InputWarning: If the solver is asked for a slow process (`quasi_static`) and this was none, the pressure moved
            nothing that could be measured, nothing touched the mold, the sheet left the mold's box or passes through
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
    own, room = scene, select_bucket(scene, store)
    scene, limit = room.scene, own.solver.max_steps
    began = time.perf_counter()
    begin, advance, result = programs(scene, store)
    state, first, taken = begin(scene)
    ready, telling = time.perf_counter(), 0.0
    follows = state.account.load_state is not None
    pressures: list[tuple[float, float]] = []
    contacts = _ContactRecord(own) if own.slides else None
    whole = on_window is None and not follows and contacts is None
    compiling = ready - began
    while left := remaining_windows(scene, state, limit):
        take = left if whole else 1
        state, taken, done = advance(state, scene, first, taken, np.int32(take))
        more = enlarge_room(scene, state, taken, bool(done), limit)
        if more is not None:
            # One program for each size; the run goes on where it was.
            paused = time.perf_counter()
            scene, state, taken = more
            begin, advance, result = programs(scene, store)
            first = begin(scene)[1]
            compiling += time.perf_counter() - paused
            telling += time.perf_counter() - paused
            continue
        if follows:
            _record_pressure(pressures, state)
        if on_window is not None or contacts is not None:
            now = state, scene, first, taken
            moment = _moment(state, scene, lambda now=now, made=result: room.result(made[1].result()(*now, _GOING)))
            told = time.perf_counter()
            if contacts is not None and not done:
                contacts.offer(moment)
            stop = on_window is not None and on_window(moment)
            telling += time.perf_counter() - told
            if stop:
                stopped = state.status | (0 if done else Status.STOPPED)
                state = dataclasses.replace(state, status=jnp.asarray(stopped, jnp.int32))
                break
        if done:
            break
    paused = time.perf_counter()
    made = result[1].result()
    compiling += time.perf_counter() - paused
    telling += time.perf_counter() - paused
    final = room.result(made(state, scene, first, taken, _LAST))
    # What the caller does in between, such as writing frames, is not the loop.
    seconds = Seconds(compiling, time.perf_counter() - ready - telling)
    recorded = {
        "pressures": np.array(pressures).T if pressures else None,
        "contacts": None if contacts is None else contacts.rows(),
        "contact_periods": None if contacts is None else contacts.periods(),
    }
    final = dataclasses.replace(final, seconds=seconds, **recorded)
    if on_end is not None:
        on_end(final)
    if has_burst(final, own):
        final = dataclasses.replace(final, status=final.status | Status.BURST)
    if may_be_unfilled(final, own):
        final = add_filling(final, own)
    for sentence in (*warnings_of(final, own), *warnings_of_part(final, own)):
        warnings.warn(sentence, InputWarning, stacklevel=2, skip_file_prefixes=(str(PACKAGE),))
    return final


class _ContactRecord:
    """Shares of the sheet on each tool, some tens of times in a run: where nodes slide, they also leave tools."""

    def __init__(self, scene: Scene) -> None:
        self._every = float(scene.solver.end_time) / _RECORDS
        self._count = len(scene.surfaces)
        self._times: list[float] = []
        self._shares: list[np.ndarray] = []
        self._periods = np.full((self._count, 2), np.nan)

    def offer(self, moment: Moment) -> None:
        """Records the shares, unless the last ones are recent."""
        if not self._times or moment.time >= self._times[-1] + self._every:
            result = moment.result()
            self._times.append(moment.time)
            self._shares.append(contact_shares(result, self._count))
            tool, landed = np.asarray(result.tool), np.asarray(result.contact_time, float)
            for number in np.unique(tool[tool >= 0]):
                first, _ = self._periods[number]
                self._periods[number] = np.fmin(first, landed[tool == number].min()), moment.time

    def rows(self) -> np.ndarray:
        """Times and shares (1 + count, n), from 0 on, when nothing has been formed yet."""
        shares = np.array(self._shares).reshape(-1, self._count)
        rows = np.concatenate([np.array(self._times)[:, None], shares], axis=1)
        return np.concatenate([np.zeros((1, 1 + self._count)), rows]).T

    def periods(self) -> np.ndarray:
        """When nodes first came into contact with each, and the last time they were (count, 2) [s]; NaN for never."""
        return self._periods


def _record_pressure(pressures: list[tuple[float, float]], state: State) -> None:
    """Adds the time [s] and the pressure [Pa] at the start of a state's last step, unless the window was rejected."""
    load = state.account.load_state
    assert load is not None
    time = float(state.time) - float(state.control.step_length)
    if not pressures or time > pressures[-1][0]:
        pressures.append((time, float(load.pressure)))


def _moment(state: State, scene: Scene, result: Callable[[], Result]) -> Moment:
    load = state.account.load_state
    pressure = None if load is None else float(load.pressure)
    return Moment(float(state.time), float(scene.solver.end_time), int(state.steps), result, pressure)

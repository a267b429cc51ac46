"""Loops over windows: `simulate`, which is pure and differentiable, `run`, the host's loop, and `simulate_batch`."""

from __future__ import annotations

import dataclasses
import functools
import os
import time
import warnings
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import ShapedArray, Tracer
from numpy.typing import ArrayLike

from jaxform.adjoint import Adjoint, adjoint_of
from jaxform.blocks import only_if
from jaxform.body import Body, body, present_body
from jaxform.derivatives import Rule, apart, recomputed
from jaxform.energy import UNBALANCED
from jaxform.errors import InputError, InputWarning
from jaxform.padding import on_rungs
from jaxform.ranges import RANGES, as_numbers
from jaxform.refinement import refined, refined_in_place
from jaxform.replacing import check_numbers, replace, with_stand_ins
from jaxform.result import Result, Seconds, make_result, warnings_of
from jaxform.reverse import carries
from jaxform.review import warnings_of_part
from jaxform.room import roomier, windows_left
from jaxform.scene import Scene
from jaxform.sealed import manual_axes
from jaxform.state import PackedState, Schedule, State, Status, Taken, finished, initial_state
from jaxform.stepping import energy_rounding, window_in_place, with_room
from jaxform.store import Soon, Store
from jaxform.working import Working, still_worked_through, wholly_worked_through

_IN_MEMORY = Store()


def simulate(scene: Scene, *, schedule: Schedule | None = None, adjoint: Adjoint | None = None) -> Result:
    """Simulates a scene; a pure function of its leaves: jit, vmap, jvp and grad apply.

    Differentiate through `replace`: first derivatives in either mode, second ones forward over either
    (`jax.hessian`). Where a number that was traced is out of its range nothing is simulated: the result is the sheet as
    it was at first, finite, with the thickness 0 where the given one is out of range, and its status says so.

    Args:
        scene: The scene.
        schedule: The decisions of an earlier run, from its result: taken as they are, the result is a smooth function
            of the design as far as contact is. Without it every run decides for itself.
        adjoint: How the reverse derivative is found (`Reversed`, `Checkpointed`, `Stored`); by default the fastest
            that the scene allows.

    Raises:
        InputError: The scene has a part that the chosen adjoint cannot go back over.
    """
    if any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves((scene, schedule))):
        return _simulate(scene, schedule, adjoint_of(scene, adjoint))
    room = on_rungs(scene)
    given = None if schedule is None else room.schedule(schedule)
    return room.result(_simulate(room.scene, given, adjoint_of(scene, adjoint)))


@functools.partial(jax.jit, static_argnums=2)
def _simulate(scene: Scene, schedule: Schedule | None, adjoint: Adjoint) -> Result:
    whole = functools.partial(_simulated, adjoint)
    if manual_axes(jax.tree.leaves((scene, schedule))):
        return apart(whole, scene, schedule)
    return whole(scene, schedule)


def _simulated(adjoint: Adjoint, scene: Scene, schedule: Schedule | None) -> Result:
    given, (scene, out_of_range) = scene, with_stand_ins(scene)
    first, state = body(scene), initial_state(scene)
    state = dataclasses.replace(state, status=jnp.where(out_of_range == 0, state.status, Status.INPUT))
    count = scene.tables.window_count
    if adjoint.windows > 1:
        several = _recomputed_windows(adjoint)
        groups = -(-count // adjoint.windows)
        state, taken = jax.lax.scan(lambda state, _: several(state, scene, first, schedule), state, length=groups)
        taken = jax.tree.map(lambda values: values.reshape(-1)[:count], taken)
    else:
        state, taken = _windows(state, scene, first, schedule, count=count, adjoint=adjoint)
    result = make_result(_closed(state, scene, first), scene, first, jax.lax.stop_gradient(taken))
    thick = RANGES["parison.thickness"].holds(given.parison.thickness)
    return dataclasses.replace(result, thickness=jnp.where(thick, result.thickness, 0.0), out_of_range=out_of_range)


def _windows(
    state: State, scene: Scene, first: Body, schedule: Schedule | None, *, count: int, adjoint: Adjoint
) -> tuple[State, Taken]:
    """So many windows, as far as there is anything to do."""

    def look(state: State) -> tuple[State, Body]:
        return refined(state, scene, present_body(scene, state.mesh, first), schedule)

    def take(state: State) -> State:
        state, now = adjoint.border(look)(state)

        def whole(state: State) -> State:
            return adjoint.window(state, scene, now, first, schedule)

        return _unless_full(state.status, scene, whole, state)

    def unless_finished(state: State, _: None) -> tuple[State, Taken]:
        done = finished(state, scene) | (state.windows >= scene.tables.window_count)
        state = jax.lax.cond(done, lambda state: state, take, state)
        return state, jax.tree.map(lambda value: jnp.where(done, jnp.zeros_like(value), value), _latest(state))

    return jax.lax.scan(unless_finished, state, length=count)


@functools.cache
def _recomputed_windows(adjoint: Adjoint) -> Rule:
    """So many windows of which the reverse derivative keeps the state before the first."""

    def like(state: State, *_: object) -> Any:
        return state, tuple(ShapedArray((adjoint.windows,), leaf.dtype) for leaf in _latest(state))

    def smooth(result: tuple[State, Taken]) -> Any:
        return carries(result[0]), jax.tree.map(lambda _: False, result[1])

    return recomputed(functools.partial(_windows, count=adjoint.windows, adjoint=adjoint), like, smooth)


def simulate_batch(scene: Scene, changes: Mapping[str, ArrayLike], *, workers: int | None = None) -> Result:
    """Simulates many designs of a scene: the results stacked, a design per row of every array.

    On the CPU the designs are shared out over threads, one after another on each, which is several times faster than
    one program for all of them; on other devices they run side by side. Not differentiable: map `simulate` for that.

    Args:
        scene: The scene.
        changes: New values at dotted paths, as `replace` takes them, with a row for each design (n_design, ...).
        workers: How many threads; one per core by default.

    Raises:
        InputError: If a path or a row does not fit the scene, or the numbers of rows differ.
    """
    rows = _rows(changes)
    if workers is not None and not (isinstance(workers, int) and workers > 0):
        raise InputError("must be a positive whole number", "leave it out for one per core", "workers", workers)
    designs = [replace(scene, {path: values[k] for path, values in rows.items()}) for k in range(_row_count(rows))]
    if jax.default_backend() != "cpu":
        return _side_by_side(scene, rows)
    rooms = [on_rungs(design, recorded=True) for design in designs]
    whole = _IN_MEMORY.program(_whole, rooms[0].scene)
    with ThreadPoolExecutor(workers or os.cpu_count()) as pool:
        results = list(pool.map(lambda room: room.result(whole(room.scene)), rooms))
    return jax.tree.map(lambda *values: jnp.asarray(np.stack(values)), *results)


def _rows(changes: Mapping[str, ArrayLike]) -> dict[str, np.ndarray]:
    """What is to be changed, as arrays with a row for each design."""
    if not isinstance(changes, Mapping):
        raise InputError("is no mapping of paths to rows of values", "stack a row per design", "changes", changes)
    if any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves(dict(changes))):
        raise InputError("is traced, but a batch is not differentiable", "map `simulate` for that", "changes")
    return {str(path): as_numbers(str(path), values) for path, values in changes.items()}


def _row_count(rows: Mapping[str, np.ndarray]) -> int:
    counts = {path: len(values) if values.ndim else 0 for path, values in rows.items()}
    if not rows or min(counts.values()) == 0 or len(set(counts.values())) > 1:
        raise InputError("needs as many rows for one path as for another", "stack a row per design", "changes", counts)
    return next(iter(counts.values()))


def _side_by_side(scene: Scene, rows: Mapping[str, ArrayLike]) -> Result:
    return jax.jit(jax.vmap(lambda rows: _whole(replace(scene, rows))))(dict(rows))


@jax.jit
def _whole(scene: Scene) -> Result:
    """A run without its host's loop."""
    state, first, taken = _begin(scene)
    state, taken, _ = _advance(state, scene, first, taken, jnp.int32(scene.tables.window_count))
    return make_result(_closed(state, scene, first), scene, first, taken)


@jax.jit
def _closed(state: State, scene: Scene, first: Body) -> State:
    """The last state; where the windows did not suffice, or energy was lost or won, its status says so."""
    short = jnp.where(finished(state, scene), 0, Status.WINDOWS_EXHAUSTED)
    least = energy_rounding(scene, jnp.sum(first.sheet.area * first.thickness))
    missing = jnp.abs(state.account.imbalance) > UNBALANCED * state.account.peak_work + least
    status = jnp.where((state.status | short) == 0, jnp.where(missing, Status.UNBALANCED, 0), state.status | short)
    return dataclasses.replace(state, status=status.astype(jnp.int32))


@dataclasses.dataclass(frozen=True)
class Moment:
    """What `run` tells its caller after each window.

    Attributes:
        time: Simulated time [s].
        end_time: When the simulation ends [s].
        steps: Steps taken.
        result: Call it for the part as it is now.
    """

    time: float
    end_time: float
    steps: int
    result: Callable[[], Result]


def run(scene: Scene, *, on_window: Callable[[Moment], object] | None = None, store: Store | None = None) -> Result:
    """Simulates a scene by the host's loop of the same windows; same numbers as `simulate`, no derivative.

    Args:
        scene: The scene.
        on_window: Called after every window with a `Moment`; a true answer stops the run, and its status says so.
            Without it the whole loop runs at once.
        store: Where traced programs are kept between runs; nowhere by default.

    Raises:
        InputError: If a number of the scene is out of its range.

    Warns:
        InputWarning: If the solver is asked for a slow process (`quasi_static`) and this was none, the pressure moved
            nothing that could be measured, nothing touched the mold, the sheet left the mold's box, or a free wall
            became thinner than makes any sense.
    """
    check_numbers(scene)
    own, room, store = scene, on_rungs(scene, recorded=True), store or _IN_MEMORY
    scene, limit = room.scene, own.solver.max_steps
    began = time.perf_counter()
    begin, advance, closed, result = _programs(scene, store)
    state, first, taken = begin(scene)
    ready, telling = time.perf_counter(), 0.0
    compiling = ready - began
    while left := windows_left(scene, state, limit):
        take = left if on_window is None else 1
        state, taken, done = advance(state, scene, first, taken, np.int32(take))
        more = roomier(scene, state, taken, bool(done), limit)
        if more is not None:
            # One program for each size; the run goes on where it was.
            paused = time.perf_counter()
            scene, state, taken = more
            begin, advance, closed, result = _programs(scene, store)
            first = begin(scene)[1]
            compiling += time.perf_counter() - paused
            telling += time.perf_counter() - paused
            continue
        if on_window is not None:
            now = state, scene, first, taken
            moment = _moment(state, scene, lambda now=now, made=result: room.result(made.ready()(*now)))
            told = time.perf_counter()
            stop = on_window(moment)
            telling += time.perf_counter() - told
            if stop:
                stopped = state.status | (0 if done else Status.STOPPED)
                state = dataclasses.replace(state, status=jnp.asarray(stopped, jnp.int32))
                break
        if done:
            break
    paused = time.perf_counter()
    close, made = closed.ready(), result.ready()
    compiling += time.perf_counter() - paused
    telling += time.perf_counter() - paused
    final = room.result(made(close(state, scene, first), scene, first, taken))
    # What the caller does in between, such as writing frames, is not the loop.
    seconds = Seconds(compiling, time.perf_counter() - ready - telling)
    for sentence in (*warnings_of(final, own), *warnings_of_part(final, own)):
        warnings.warn(sentence, InputWarning, stacklevel=2)
    return dataclasses.replace(final, seconds=seconds)


_make_result = jax.jit(make_result)


@jax.jit
def _begin(scene: Scene) -> tuple[State, Body, Taken]:
    count = scene.tables.window_count
    state = initial_state(scene)
    none = jnp.zeros(count, state.time.dtype)
    return state, body(scene), (none, jnp.zeros(count, jnp.int32), none, none)


@jax.jit
def _advance(state: State, scene: Scene, first: Body, taken: Taken, most: jax.Array) -> tuple[State, Taken, jax.Array]:
    """At most so many windows."""

    def going(carry: _Going) -> jax.Array:
        return (carry.count < most) & ~finished(carry.state, scene)

    def take(carry: _Going) -> _Going:
        state, now, stale = carry.state, carry.now, carry.count == 0
        if state.mesh is not None:
            before = state.mesh.element_count
            state, now = refined_in_place(state, scene, now, carry.working)
            assert state.mesh is not None
            stale |= state.mesh.element_count != before
        state, working = still_worked_through(state, scene, now, carry.working, stale)
        whole_window = lambda now: window_in_place(now[0], scene, now[1])  # noqa: E731
        after, working = _unless_full(state.status, scene, whole_window, (state, working), differentiable=False)
        at = state.windows
        taken = jax.tree.map(lambda rows, row: rows.at[at].set(row), carry.taken, _latest(after))
        return _Going(after, now, working, taken, carry.count + 1)

    now = present_body(scene, state.mesh, first, stepped=True)
    working = with_room(wholly_worked_through(now), scene)
    begun = _Going(working.taken(state), now, working, taken, jnp.int32(0))
    gone = jax.lax.while_loop(going, take, begun)
    return gone.working.put_back(gone.state), gone.taken, finished(gone.state, scene)


class _Going(NamedTuple):
    """What goes from window to window: with the state, in packed order, the body and what of it is worked through."""

    state: PackedState
    now: Body
    working: Working
    taken: Taken
    count: jax.Array


def _latest(state: State) -> Taken:
    """Of the last window."""
    return state.control.last_length, state.control.last_count, state.control.bound, state.control.last_duration


def _unless_full[T](
    status: jax.Array, scene: Scene, take: Callable[[T], T], now: T, *, differentiable: bool = True
) -> T:
    """A window, unless refinement found no room at its border: then the state is left for a run with more."""
    if scene.refinement is None:
        return take(now)
    return only_if(status == 0, take, now, differentiable=differentiable)


class _Programs(NamedTuple):
    """Compiled for a scene's sizes: what begins a run and takes windows; soon, what ends it and makes its result."""

    begin: Callable[[Scene], tuple[State, Body, Taken]]
    advance: Callable[..., tuple[State, Taken, jax.Array]]
    closed: Soon
    result: Soon


def _programs(scene: Scene, store: Store) -> _Programs:
    """Compiled side by side, the longest begun as soon as its arguments' shapes are known."""
    begin = store.soon(_begin, scene)
    state, first, taken = begin.shapes
    advance = store.soon(_advance, state, scene, first, taken, np.int32(1))
    closed = store.soon(_closed, state, scene, first)
    result = store.soon(_make_result, state, scene, first, taken)
    return _Programs(begin.ready(), advance.ready(), closed, result)


def is_compiled(scene: Scene, store: Store, least: int = 0) -> bool:
    """Whether a run of a scene, as if it had at least so many elements, finds all its programs compiled."""
    scene = on_rungs(scene, least, recorded=True).scene
    if not store.holds(_begin, scene):
        return False
    state, first, taken = store.soon(_begin, scene).shapes
    ending = store.holds(_closed, state, scene, first) and store.holds(_make_result, state, scene, first, taken)
    return ending and store.holds(_advance, state, scene, first, taken, np.int32(1))


def compile_for(scene: Scene, store: Store, least: int = 0) -> None:
    """Compiles what runs of scenes of a kind and rungs need, and keeps it; as if one had at least so many elements."""
    programs = _programs(on_rungs(scene, least, recorded=True).scene, store)
    programs.closed.ready()
    programs.result.ready()


def _compiled(state: State, scene: Scene, first: Body, taken: Taken) -> Callable[..., tuple[State, Taken, jax.Array]]:
    return _IN_MEMORY.program(_advance, state, scene, first, taken, np.int32(1))


def _moment(state: State, scene: Scene, result: Callable[[], Result]) -> Moment:
    return Moment(float(state.time), float(scene.solver.end_time), int(state.steps), result)

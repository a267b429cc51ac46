"""Loops over windows: `simulate`, which is pure and differentiable, `run`, the host's loop, and `simulate_batch`."""

from __future__ import annotations

import dataclasses
import functools
import os
import time
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike

from jaxform.body import Body, body, present_body
from jaxform.errors import InputError
from jaxform.refinement import refined
from jaxform.result import Result, Seconds, make_result
from jaxform.scene import Scene, replace
from jaxform.state import State, Status, finished, initial_state
from jaxform.stepping import window
from jaxform.store import Store


@functools.partial(jax.jit, static_argnames="windows_per_checkpoint")
def simulate(scene: Scene, *, windows_per_checkpoint: int = 1) -> Result:
    """Simulates a scene; a pure function of its leaves: jit, vmap, jvp and grad apply.

    Differentiate through `replace`.

    Args:
        scene: The scene.
        windows_per_checkpoint: What the reverse derivative stores. 1: the state at every window's border; the steps
            of a window are worked out again. More: the state at every so many borders; windows are worked out once
            more in between, for less memory. 0: every step, nothing is worked out again.
    """
    sheet_body = body(scene)
    count = scene.tables.window_count

    def unless_finished(state: State, _: None = None) -> tuple[State, None]:
        def take(state: State) -> State:
            state, now = refined(state, scene, present_body(scene, state.mesh, sheet_body))
            return window(state, scene, now)

        take = jax.checkpoint(take) if windows_per_checkpoint else take
        return jax.lax.cond(finished(state, scene) | (state.windows >= count), lambda state: state, take, state), None

    def several(state: State, _: None) -> tuple[State, None]:
        return jax.lax.scan(unless_finished, state, length=windows_per_checkpoint)

    state = initial_state(scene)
    if windows_per_checkpoint > 1:
        groups = -(-count // windows_per_checkpoint)
        state, _ = jax.lax.scan(jax.checkpoint(several), state, length=groups)
    else:
        state, _ = jax.lax.scan(unless_finished, state, length=count)
    return make_result(_closed(state, scene), scene, sheet_body)


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
    rows = {path: np.asarray(values) for path, values in changes.items()}
    counts = {path: len(values) if values.ndim else 0 for path, values in rows.items()}
    if not rows or min(counts.values()) == 0 or len(set(counts.values())) > 1:
        raise InputError("needs as many rows for one path as for another", "stack a row per design", "changes", counts)
    designs = [replace(scene, {path: values[k] for path, values in rows.items()}) for k in range(max(counts.values()))]
    if jax.default_backend() != "cpu":
        return _side_by_side(scene, rows)
    whole = _whole.lower(designs[0]).compile()
    with ThreadPoolExecutor(workers or os.cpu_count()) as pool:
        results = list(pool.map(lambda design: jax.block_until_ready(whole(design)), designs))
    return jax.tree.map(lambda *values: jnp.stack(values), *results)


def _side_by_side(scene: Scene, rows: Mapping[str, ArrayLike]) -> Result:
    return jax.jit(jax.vmap(lambda rows: _whole(replace(scene, rows))))(dict(rows))


@jax.jit
def _whole(scene: Scene) -> Result:
    """A run without its host's loop."""
    state, sheet_body = _begin(scene)
    state, _ = _advance(state, scene, sheet_body, jnp.int32(scene.tables.window_count))
    return make_result(_closed(state, scene), scene, sheet_body)


def _closed(state: State, scene: Scene) -> State:
    """The last state; where the windows did not suffice, its status says so."""
    short = jnp.where(finished(state, scene), 0, Status.WINDOWS_EXHAUSTED)
    return dataclasses.replace(state, status=(state.status | short).astype(jnp.int32))


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
    """
    began = time.perf_counter()
    store = store or Store()
    state, sheet_body = store.program(_begin, scene)(scene)
    take = 1 if on_window is not None else scene.tables.window_count
    advance = _compiled(state, scene, sheet_body, store)
    result = store.program(_make_result, state, scene, sheet_body)
    ready = time.perf_counter()
    left, telling = scene.tables.window_count, 0.0
    while left > 0:
        state, done = advance(state, scene, sheet_body, jnp.int32(take))
        left -= take
        if on_window is not None:
            moment = _moment(state, scene, functools.partial(result, state, scene, sheet_body))
            told = time.perf_counter()
            stop = on_window(moment)
            telling += time.perf_counter() - told
            if stop:
                stopped = state.status | (0 if done else Status.STOPPED)
                state = dataclasses.replace(state, status=jnp.asarray(stopped, jnp.int32))
                break
        if done:
            break
    final = result(_closed(state, scene), scene, sheet_body)
    jax.block_until_ready(final)
    # What the caller does in between, such as writing frames, is not the loop.
    seconds = Seconds(ready - began, time.perf_counter() - ready - telling)
    return dataclasses.replace(final, seconds=seconds)


_make_result = jax.jit(make_result)


@jax.jit
def _begin(scene: Scene) -> tuple[State, Body]:
    return initial_state(scene), body(scene)


@jax.jit
def _advance(state: State, scene: Scene, sheet_body: Body, most: jax.Array) -> tuple[State, jax.Array]:
    """At most so many windows."""

    def going(carry: tuple[State, Body, jax.Array]) -> jax.Array:
        return (carry[2] < most) & ~finished(carry[0], scene)

    def take(carry: tuple[State, Body, jax.Array]) -> tuple[State, Body, jax.Array]:
        state, now = refined(carry[0], scene, carry[1])
        return window(state, scene, now, differentiable=False), now, carry[2] + 1

    first = state, present_body(scene, state.mesh, sheet_body), jnp.int32(0)
    state = jax.lax.while_loop(going, take, first)[0]
    return state, finished(state, scene)


def _compiled(
    state: State, scene: Scene, sheet_body: Body, store: Store | None = None
) -> Callable[..., tuple[State, jax.Array]]:
    return (store or Store()).program(_advance, state, scene, sheet_body, jnp.int32(1))


def _moment(state: State, scene: Scene, result: Callable[[], Result]) -> Moment:
    return Moment(float(state.time), float(scene.solver.end_time), int(state.steps), result)

"""Loops over windows: `simulate`, which is pure and differentiable, and `run`, the host's loop of the same windows."""

from __future__ import annotations

import dataclasses
import functools
import time
from collections.abc import Callable

import jax
import jax.numpy as jnp

from jaxform.result import Result, Seconds, make_result
from jaxform.scene import Scene
from jaxform.state import Body, State, Status, body, finished, initial_state
from jaxform.stepping import window


@jax.jit
def simulate(scene: Scene) -> Result:
    """Simulates a scene; a pure function of its leaves: jit, vmap, jvp and grad apply.

    Differentiate through `replace`. The reverse derivative stores one state per window and works the steps inside a
    window out again.
    """
    sheet_body = body(scene)
    advance = jax.checkpoint(lambda state: window(state, scene, sheet_body))

    def unless_finished(state: State, _: None) -> tuple[State, None]:
        return jax.lax.cond(finished(state, scene), lambda state: state, advance, state), None

    state, _ = jax.lax.scan(unless_finished, initial_state(scene), length=scene.tables.window_count)
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


def run(scene: Scene, *, on_window: Callable[[Moment], object] | None = None) -> Result:
    """Simulates a scene by the host's loop of the same windows; same numbers as `simulate`, no derivative.

    Args:
        scene: The scene.
        on_window: Called after every window with a `Moment`; a true answer stops the run, and its status says so.
            Without it the whole loop runs at once.
    """
    began = time.perf_counter()
    state, sheet_body = jax.jit(_begin)(scene)
    take = 1 if on_window is not None else scene.tables.window_count
    advance = _compiled(state, scene, sheet_body)
    result = _make_result.lower(state, scene, sheet_body).compile()
    compiled = time.perf_counter()
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
    seconds = Seconds(compiled - began, time.perf_counter() - compiled - telling)
    return dataclasses.replace(final, seconds=seconds)


_make_result = jax.jit(make_result)


def _begin(scene: Scene) -> tuple[State, Body]:
    return initial_state(scene), body(scene)


@jax.jit
def _advance(state: State, scene: Scene, sheet_body: Body, most: jax.Array) -> tuple[State, jax.Array]:
    """At most so many windows."""

    def going(carry: tuple[State, jax.Array]) -> jax.Array:
        return (carry[1] < most) & ~finished(carry[0], scene)

    def take(carry: tuple[State, jax.Array]) -> tuple[State, jax.Array]:
        return window(carry[0], scene, sheet_body, differentiable=False), carry[1] + 1

    state, _ = jax.lax.while_loop(going, take, (state, jnp.int32(0)))
    return state, finished(state, scene)


def _compiled(state: State, scene: Scene, sheet_body: Body) -> Callable[..., tuple[State, jax.Array]]:
    return _advance.lower(state, scene, sheet_body, jnp.int32(1)).compile()


def _moment(state: State, scene: Scene, result: Callable[[], Result]) -> Moment:
    return Moment(float(state.time), float(scene.solver.end_time), int(state.steps), result)

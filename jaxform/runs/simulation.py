"""Loops over windows: `simulate`, which is pure and differentiable, `run`, the host's loop, and `simulate_batch`."""

from __future__ import annotations

import dataclasses
import functools
from typing import Any

import jax
import jax.numpy as jnp
from jax.core import ShapedArray, Tracer
from jax.custom_derivatives import SymbolicZero

from jaxform.adapt.refinement import refined, without_sides
from jaxform.adjoint.strategies import Adjoint, adjoint_of
from jaxform.core.errors import InputError
from jaxform.core.pytree import in_precision
from jaxform.core.rules import by_own_rules, on_device_of
from jaxform.dynamics.initial import initial_state
from jaxform.kernels.derivatives import Rule, apart, recomputed
from jaxform.kernels.sealed import manual_axes
from jaxform.model.replacing import check_scene, with_stand_ins
from jaxform.model.scene import Scene
from jaxform.results.result import Result, make_result
from jaxform.runs.loop import closed, latest, unless_full
from jaxform.runs.padding import on_rungs
from jaxform.sheet.discretization import Discretization, discretize, present_discretization
from jaxform.sheet.state import Schedule, State, Status, Taken, carries, finished


@by_own_rules
def simulate(scene: Scene, *, schedule: Schedule | None = None, adjoint: Adjoint | None = None) -> Result:
    """Simulates a scene; a pure function of its leaves: jit, vmap, jvp and grad apply.

    Differentiate through `replace`: first derivatives in either mode, second ones forward over either
    (`jax.hessian`). Where a number that was traced is out of its range nothing is simulated: the result has the sheet
    where it was at first and NaN for its walls, stretches, volumes and mass, so that a line search backs off; its
    status has the bit `Status.INPUT`.

    Args:
        scene: The scene.
        schedule: The decisions of an earlier run, from its result: taken as they are, the result is a smooth function
            of the design as far as contact is. Without it every run decides for itself.
        adjoint: How the reverse derivative is found (`Reversed`, `Checkpointed`, `Stored`); by default the fastest
            that the scene allows.

    Raises:
        InputError: The scene has a part that the chosen adjoint cannot go back over, a derivative is asked for with
            respect to the end time, or something is no scene or no schedule.
    """
    check_scene(scene)
    if schedule is not None and not isinstance(schedule, Schedule):
        raise InputError("is no schedule", "give that of a result: result.schedule", "schedule", schedule)
    schedule = in_precision(schedule)
    if isinstance(scene.solver.end_time, Tracer):
        end_time = _without_derivative(scene.solver.end_time)
        scene = dataclasses.replace(scene, solver=dataclasses.replace(scene.solver, end_time=end_time))
    if any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves((scene, schedule))):
        return _simulate(scene, schedule, adjoint_of(scene, adjoint))
    with on_device_of(scene.parison.positions) as placed:
        room = on_rungs(scene)
        given = None if schedule is None else room.schedule(schedule)
        return placed(room.result(_simulate(room.scene, given, adjoint_of(scene, adjoint))))


@jax.custom_jvp
def _without_derivative(end_time: jax.Array) -> jax.Array:
    """The same; how many steps there are depends on it, so no derivative says what a run for longer would give."""
    return end_time


@functools.partial(_without_derivative.defjvp, symbolic_zeros=True)
def _(primals: tuple[jax.Array], tangents: tuple[Any]) -> tuple[jax.Array, Any]:
    if not isinstance(tangents[0], SymbolicZero):
        remedy = "take differences, or design pressure.time within a fixed end_time"
        raise InputError("has no derivative: it decides how many steps there are", remedy, "solver.end_time")
    return primals[0], tangents[0]


@functools.partial(jax.jit, static_argnums=2)
def _simulate(scene: Scene, schedule: Schedule | None, adjoint: Adjoint) -> Result:
    whole = functools.partial(_simulated, adjoint)
    if manual_axes(jax.tree.leaves((scene, schedule))):
        return apart(whole, scene, schedule)
    return whole(scene, schedule)


def _simulated(adjoint: Adjoint, scene: Scene, schedule: Schedule | None) -> Result:
    scene, out_of_range = with_stand_ins(scene)
    first, state = discretize(scene), without_sides(initial_state(scene))
    state = dataclasses.replace(state, status=jnp.where(jnp.all(out_of_range == 0), state.status, Status.INPUT))
    count = scene.tables.window_count
    if adjoint.windows > 1:
        several = _recomputed_windows(adjoint)
        groups = -(-count // adjoint.windows)
        state, taken = jax.lax.scan(lambda state, _: several(state, scene, first, schedule), state, length=groups)
        taken = jax.tree.map(lambda values: values.reshape(-1)[:count], taken)
    else:
        state, taken = _windows(state, scene, first, schedule, count=count, adjoint=adjoint)
    result = make_result(closed(state, scene, first), scene, first, jax.lax.stop_gradient(taken), True)
    return _without_wall(dataclasses.replace(result, out_of_range=out_of_range), jnp.any(out_of_range != 0))


def _without_wall(result: Result, unknown: jax.Array) -> Result:
    """The result, with NaN for what the walls are judged by where that is unknown: the sheet at rest is perfectly even.

    What does not exist has 0, as ever.
    """

    def known(values: jax.Array, here: jax.Array) -> jax.Array:
        return jnp.where(unknown & here, jnp.nan, values)

    used = result.used
    return dataclasses.replace(
        result,
        thickness=known(result.thickness, result.active),
        element_thickness=known(result.element_thickness, used),
        element_volume=known(result.element_volume, used),
        stretches=known(result.stretches, used[:, None]),
        mass=jnp.where(unknown, jnp.nan, result.mass),
    )


def _windows(
    state: State, scene: Scene, first: Discretization, schedule: Schedule | None, *, count: int, adjoint: Adjoint
) -> tuple[State, Taken]:
    """So many windows, as far as there is anything to do."""

    def look(state: State) -> tuple[State, Discretization]:
        return refined(state, scene, present_discretization(scene, state.mesh, first), schedule)

    def take(state: State) -> State:
        state, now = adjoint.border(look)(state)

        def whole(state: State) -> State:
            return adjoint.window(state, scene, now, first, schedule)

        return unless_full(state.status, scene, whole, state, adjoint.only_if)

    def unless_finished(state: State, _: None) -> tuple[State, Taken]:
        done = finished(state, scene) | (state.windows >= scene.tables.window_count)
        state = adjoint.only_if(~done, take, state)
        return state, jax.tree.map(lambda value: jnp.where(done, jnp.zeros_like(value), value), latest(state))

    return jax.lax.scan(unless_finished, state, length=count)


@functools.cache
def _recomputed_windows(adjoint: Adjoint) -> Rule:
    """So many windows of which the reverse derivative keeps the state before the first."""

    def like(state: State, *_: object) -> Any:
        return state, tuple(ShapedArray((adjoint.windows,), leaf.dtype) for leaf in latest(state))

    def smooth(result: tuple[State, Taken]) -> Any:
        return carries(result[0]), jax.tree.map(lambda _: False, result[1])

    return recomputed(functools.partial(_windows, count=adjoint.windows, adjoint=adjoint), like, smooth)

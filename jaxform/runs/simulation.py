"""`simulate`, which is pure and differentiable, `sensitivity` and `simulate_batch`."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import ShapedArray, Tracer
from jax.custom_derivatives import SymbolicZero
from numpy.typing import ArrayLike, NDArray

from jaxform.adapt.refinement import drop_sides, refine
from jaxform.adjoint.strategies import Adjoint, choose_adjoint
from jaxform.core.compilation import device_context, with_standard_promotion
from jaxform.core.errors import InputError
from jaxform.core.installation import usable_cores
from jaxform.core.pytree import cast_to_precision
from jaxform.core.ranges import as_numbers
from jaxform.dynamics.window_state import initial_state
from jaxform.kernels.blocks import on_cpu
from jaxform.kernels.derivatives import DerivativeRule, as_single_operation, recompute
from jaxform.kernels.opaque_primitive import manual_axes
from jaxform.mesh.volumes import areas
from jaxform.model.replacement import check_scene, number_at, replace, sanitize_parameters
from jaxform.model.scene import Scene
from jaxform.results.result import Result, make_result
from jaxform.runs.host import IN_MEMORY, latest_decisions, unless_full, whole_run
from jaxform.runs.padding import pad_to_bucket
from jaxform.sheet.discretization import Discretization, discretize, present_discretization
from jaxform.sheet.scheme import open_clamp_of
from jaxform.sheet.self_contact import stick_folds_of
from jaxform.sheet.state import Schedule, State, Status, WindowLog, differentiable_leaves, is_finished


@with_standard_promotion
def simulate(scene: Scene, *, schedule: Schedule | None = None, adjoint: Adjoint | None = None) -> Result:
    """Simulates a scene; a pure function of its leaves: jit, vmap, jvp and grad apply.

    Differentiate through `replace`: first derivatives in either mode, second ones forward over either
    (`jax.hessian`). Where a traced parameter is out of its range nothing is simulated: the result has the initial shape
    of the sheet, NaN for its thickness, stretches, volumes and mass, so that a line search backs off, and the status
    bit `Status.INPUT`.

    Args:
        scene: The scene.
        schedule: The decisions of an earlier run, from its result. The run then makes the same decisions, and its
            result is a smooth function of the design where contact is. Without a schedule every run makes its own.
        adjoint: Strategy of the reverse derivative (`Reversed`, `Checkpointed`, `Stored`); by default the fastest
            that the scene allows.

    Raises:
        InputError: The chosen adjoint does not support the scene, a derivative with respect to the end time is asked
            for, or an argument is not a scene or not a schedule.
    """
    check_scene(scene)
    if schedule is not None and not isinstance(schedule, Schedule):
        raise InputError("is not a schedule", "give the schedule of a result: result.schedule", "schedule", schedule)
    schedule = cast_to_precision(schedule)
    if isinstance(scene.solver.end_time, Tracer):
        end_time = _refuse_derivative(scene.solver.end_time)
        scene = dataclasses.replace(scene, solver=dataclasses.replace(scene.solver, end_time=end_time))
    if any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves((scene, schedule))):
        return _simulate(scene, schedule, choose_adjoint(scene, adjoint))
    with device_context(scene.parison.positions) as placed:
        padded = pad_to_bucket(scene)
        schedule = None if schedule is None else padded.schedule(schedule)
        return placed(padded.result(_simulate(padded.scene, schedule, choose_adjoint(scene, adjoint))))


@jax.custom_jvp
def _refuse_derivative(end_time: jax.Array) -> jax.Array:
    """The end time, without a derivative: the number of steps depends on it, so that a derivative would be wrong."""
    return end_time


@functools.partial(_refuse_derivative.defjvp, symbolic_zeros=True)
def _(primals: tuple[jax.Array], tangents: tuple[Any]) -> tuple[jax.Array, Any]:
    if not isinstance(tangents[0], SymbolicZero):
        remedy = "use finite differences, or design pressure.time within a fixed end_time"
        raise InputError("has no derivative: it determines the number of steps", remedy, "solver.end_time")
    return primals[0], tangents[0]


@functools.partial(jax.jit, static_argnums=2)
def _simulate(scene: Scene, schedule: Schedule | None, adjoint: Adjoint) -> Result:
    all_windows = functools.partial(_simulate_windows, adjoint)
    if manual_axes(jax.tree.leaves((scene, schedule))):
        return as_single_operation(all_windows, scene, schedule)
    return all_windows(scene, schedule)


def _simulate_windows(adjoint: Adjoint, scene: Scene, schedule: Schedule | None) -> Result:
    """The result after all windows; nothing is simulated where a parameter is out of its range."""
    scene, out_of_range = sanitize_parameters(scene)
    first, state = discretize(scene), drop_sides(initial_state(scene))
    state = dataclasses.replace(state, status=jnp.where(jnp.all(out_of_range == 0), state.status, Status.INPUT))
    count = scene.tables.window_count
    if adjoint.windows > 1:
        several = _checkpointed_windows(adjoint)
        groups = -(-count // adjoint.windows)
        state, log = jax.lax.scan(lambda state, _: several(state, scene, first, schedule), state, length=groups)
        log = jax.tree.map(lambda values: values.reshape(-1)[:count], log)
    else:
        state, log = _windows(state, scene, first, schedule, count=count, adjoint=adjoint)
    result = make_result(state, scene, first, jax.lax.stop_gradient(log), True)
    return _mask_walls(dataclasses.replace(result, out_of_range=out_of_range), jnp.any(out_of_range != 0))


def _mask_walls(result: Result, unknown: jax.Array) -> Result:
    """The result, with NaN for the values of the wall where nothing was simulated.

    The initial sheet would otherwise look like a part with a perfectly even wall. Nodes and elements that do not exist
    keep the value 0.
    """

    def mask_unknown(values: jax.Array, here: jax.Array) -> jax.Array:
        return jnp.where(unknown & here, jnp.nan, values)

    used = result.used
    return dataclasses.replace(
        result,
        thickness=mask_unknown(result.thickness, result.active),
        element_thickness=mask_unknown(result.element_thickness, used),
        element_volume=mask_unknown(result.element_volume, used),
        stretches=mask_unknown(result.stretches, used[:, None]),
        mass=jnp.where(unknown, jnp.nan, result.mass),
    )


def _windows(
    state: State, scene: Scene, first: Discretization, schedule: Schedule | None, *, count: int, adjoint: Adjoint
) -> tuple[State, WindowLog]:
    """Up to `count` windows, until the run is finished."""

    def work_at_boundary(state: State) -> tuple[State, Discretization]:
        state, discrete = refine(state, scene, present_discretization(scene, state.mesh, first), schedule)
        return open_clamp_of(state, scene, discrete), discrete

    def advance(state: State) -> State:
        state, discrete = adjoint.apply_boundary(work_at_boundary)(state)

        def advance_window(state: State) -> State:
            return adjoint.window(stick_folds_of(state, scene, discrete), scene, discrete, first, schedule)

        return unless_full(state.status, scene, advance_window, state, adjoint.cond_once)

    def skip_if_finished(state: State, _: None) -> tuple[State, WindowLog]:
        done = is_finished(state, scene) | (state.windows >= scene.tables.window_count)
        state = adjoint.cond_once(~done, advance, state)
        return state, jax.tree.map(lambda value: jnp.where(done, jnp.zeros_like(value), value), latest_decisions(state))

    return jax.lax.scan(skip_if_finished, state, length=count)


@functools.cache
def _checkpointed_windows(adjoint: Adjoint) -> DerivativeRule:
    """Rule for `adjoint.windows` windows, of which the reverse derivative stores only the state before the first."""

    def like(state: State, *_: object) -> Any:
        return state, tuple(ShapedArray((adjoint.windows,), leaf.dtype) for leaf in latest_decisions(state))

    def smooth(result: tuple[State, WindowLog]) -> Any:
        return differentiable_leaves(result[0]), jax.tree.map(lambda _: False, result[1])

    return recompute(functools.partial(_windows, count=adjoint.windows, adjoint=adjoint), like, smooth)


def thinnest_wall(result: Result) -> jax.Array:
    """The smallest thickness at a node of the part [m]."""
    return jnp.min(jnp.where(result.active, result.thickness, jnp.inf))


@with_standard_promotion
def sensitivity(
    scene: Scene, function: Callable[[Result], jax.Array] = thinnest_wall, path: str = "parison.thickness"
) -> NDArray[np.float64]:
    """The derivative of a result with respect to a field over the sheet, per area: a map for `jaxform.plot.sheet`.

    It does not depend on how fine the mesh is: the change of the result is the integral, over the modelled sheet, of
    the map times a small change of the field.

    Args:
        scene: The scene; its mesh is not refined.
        function: Returns the scalar of a result that is differentiated; by default the thinnest wall [m].
        path: A field with a value at each node: the thickness or temperature of the parison, or a parameter of the
            material.

    Returns:
        Values (n_node,): the unit of the result over that of the field and m^2.

    Raises:
        InputError: If the mesh is refined, or there is no such field.
    """
    check_scene(scene)
    if scene.refinement is not None:
        raise InputError("is refined: its nodes change during the run", "leave refinement out", "scene")
    positions, triangles = np.asarray(scene.parison.positions, float), np.asarray(scene.parison.triangles)
    value = number_at(scene, path)
    if value is None or np.shape(value) not in ((), (len(positions),)):
        raise InputError("is not a field over the sheet", 'name one such as "parison.thickness"', "path", path)
    nodal = jnp.broadcast_to(jnp.asarray(value), len(positions))
    gradient = jax.grad(lambda field: function(simulate(replace(scene, {path: field}))))(nodal)
    nodal_area = np.bincount(triangles.reshape(-1), np.repeat(areas(positions, triangles) / 3.0, 3), len(positions))
    return np.asarray(gradient, float) / np.where(nodal_area > 0.0, nodal_area, np.inf)


@with_standard_promotion
def simulate_batch(scene: Scene, changes: Mapping[str, ArrayLike], *, workers: int | None = None) -> Result:
    """Simulates many designs of a scene: the results stacked, a design per row of every array.

    On the CPU the designs are shared out over threads, one after another on each, which is several times faster than
    one program for all of them; on other devices they run side by side. Not differentiable: map `simulate` for that.

    Args:
        scene: The scene.
        changes: New values at dotted paths, as `replace` takes them, with a row for each design (n_design, ...).
        workers: Number of threads; one per core by default.

    Raises:
        InputError: If a path or a row does not fit the scene, or the numbers of rows differ.
    """
    rows = _rows(changes)
    if workers is not None and not (isinstance(workers, int) and workers > 0):
        raise InputError("must be a positive whole number", "leave it out for one per core", "workers", workers)
    with device_context(scene.parison.positions) as placed:
        return placed(_results(scene, rows, workers))


def _results(scene: Scene, rows: dict[str, np.ndarray], workers: int | None) -> Result:
    """Results of the designs, stacked."""
    designs = [replace(scene, {path: values[k] for path, values in rows.items()}) for k in range(_row_count(rows))]
    if not on_cpu():
        return _simulate_designs(scene, {path: jnp.asarray(values) for path, values in rows.items()})
    padded = [pad_to_bucket(design, recorded=True) for design in designs]
    program = IN_MEMORY.program(whole_run, padded[0].scene)
    with ThreadPoolExecutor(workers or usable_cores()) as pool:
        results = list(pool.map(lambda design: design.result(program(design.scene)), padded))
    return jax.tree.map(lambda *values: jnp.asarray(np.stack(values)), *results)


def _rows(changes: Mapping[str, ArrayLike]) -> dict[str, np.ndarray]:
    """The changes, as arrays with a row for each design."""
    if not isinstance(changes, Mapping):
        raise InputError("is not a mapping of paths to rows of values", "stack a row per design", "changes", changes)
    if any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves(dict(changes))):
        raise InputError("is traced, but a batch is not differentiable", "map `simulate` for that", "changes")
    return {str(path): as_numbers(str(path), values) for path, values in changes.items()}


def _row_count(rows: Mapping[str, np.ndarray]) -> int:
    counts = {path: len(values) if values.ndim else 0 for path, values in rows.items()}
    if not rows or min(counts.values()) == 0 or len(set(counts.values())) > 1:
        raise InputError("needs the same number of rows for every path", "stack a row per design", "changes", counts)
    return next(iter(counts.values()))


@jax.jit
def _simulate_designs(scene: Scene, rows: dict[str, jax.Array]) -> Result:
    """All designs in one program, which serves every batch of as many designs of such a scene."""
    return jax.vmap(lambda row: whole_run(replace(scene, row)))(rows)

"""The whole run of the bowl beside that of plain C++, where its time goes, and its gradient.

`python -m benchmarks.speed bowl`. bowl.cpp takes the same mesh and mold and gives the same part. It is given the step
lengths of the run, so that the search for the stable step, and the energy balance, are no part of its time.
"""

from __future__ import annotations

import ctypes
import dataclasses
import functools
import time
import warnings
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike

import jaxform
from benchmarks.speed import peers
from benchmarks.speed.sheets import Array
from benchmarks.timing import best_in_turns, say, whole_loop
from jaxform import scene_files
from jaxform.contact.candidates import list_candidates
from jaxform.core.compilation import compile_function, compiler_options
from jaxform.dynamics.timestep import choose_step
from jaxform.dynamics.window import allocate_workspace, step_window
from jaxform.kernels.blocks import materialize
from jaxform.loads import Pressure
from jaxform.materials import MooneyRivlin
from jaxform.runs import host
from jaxform.sheet.active_set import ActiveSet, Workspace, active_set_of
from jaxform.sheet.state import PackedState, State
from jaxform.tools.search import touch_distance

ELEMENT_SIZE = 0.00295  # m: 1751 elements


def bowl(element_size: float = ELEMENT_SIZE) -> jaxform.Scene:
    """The built-in bowl with elements of another size [m]."""
    read = scene_files.read_scene("bowl")
    parison = read.data["parison"] | {"element_size": element_size}
    model = type(read.model).model_validate(read.data | {"parison": parison})
    return scene_files.build(dataclasses.replace(read, model=model))


def _pointer(array: np.ndarray) -> ctypes.c_void_p:
    return array.ctypes.data_as(ctypes.c_void_p)


def cpp_run(scene: jaxform.Scene, schedule: jaxform.Schedule) -> Callable[[], tuple[Array, int]] | None:
    """The run in C++ with the steps of a schedule: positions (n_node, 3) [m], and the number of its element steps.

    None where there is no compiler. The scene has one mold at rest to which the sheet sticks, a Mooney-Rivlin law, a
    damping, and a pressure with knots over time. The mold's grid is made once, as it is for a scene.
    """
    compiled = peers.load_functions("bowl")
    if compiled is None:
        return None
    sheet, grid, law, pressure = scene.tables.sheet, scene.tables.grid, scene.material, scene.pressure
    damping = scene.solver.damping
    assert scene.mold is not None and grid is not None and damping is not None
    assert isinstance(law, MooneyRivlin) and isinstance(pressure, Pressure)
    state, discrete, _ = host.begin(scene)

    def real(values: ArrayLike) -> np.ndarray:
        return np.ascontiguousarray(values, float)

    corner, width = np.asarray(grid.corner), float(grid.width)
    vertices, corners = real(scene.mold.vertices), np.ascontiguousarray(scene.mold.triangles, np.int32)
    box = real([corner, corner + width * np.asarray(grid.shape)])
    compiled.make_mold.restype = ctypes.c_void_p
    touch = ctypes.c_double(float(touch_distance(grid)))
    mold = compiled.make_mold(
        _pointer(vertices), ctypes.c_long(len(corners)), _pointer(corners), _pointer(box), ctypes.c_double(width), touch
    )
    arrays = [
        np.ascontiguousarray(sheet.triangles.T, np.int32),
        real(sheet.inverse_metric.T),
        real(sheet.area * discrete.thickness),
        real(discrete.compliance.T),
        np.ascontiguousarray(state.nodes.stuck, np.uint8),
    ]
    knots, values = real(pressure.time), real(pressure.value)
    taken = np.asarray(schedule.counts) > 0
    lengths, counts = real(schedule.lengths)[taken], np.ascontiguousarray(schedule.counts, np.int32)[taken]
    compiled.run_windows.restype = ctypes.c_long
    numbers = [ctypes.c_double(float(value)) for value in (law.c, law.alpha, damping)]

    def run() -> tuple[Array, int]:
        positions = np.array(scene.parison.positions, float)
        done = compiled.run_windows(
            *(ctypes.c_long(count) for count in (len(arrays[0]), len(positions))),
            *(_pointer(array) for array in (*arrays, positions)),
            *numbers,
            ctypes.c_long(len(knots)),
            _pointer(knots),
            _pointer(values),
            ctypes.c_void_p(mold),
            ctypes.c_long(len(lengths)),
            _pointer(lengths),
            _pointer(counts),
        )
        return positions, done

    return run


# Where the time of a run goes: parts of every window of the run, one window after the other in one program.

_Part = Callable[[PackedState, jaxform.Scene, ActiveSet, jax.Array, jax.Array], tuple[Any, Workspace | None]]
"""From the state before a window, its step's length and number of steps: what is found, and the workspace after it."""


class Windows(NamedTuple):
    """The windows of a run, stacked: the packed states before them, active sets, lengths [s] and numbers of steps."""

    states: PackedState
    active: ActiveSet
    lengths: jax.Array
    counts: jax.Array


def record_windows(scene: jaxform.Scene) -> Windows:
    """The windows of a run that were accepted."""
    state, discrete, log = host.begin(scene)
    advance = host.compile_advance(state, scene, discrete, log)
    pack = jax.jit(lambda state, scene, discrete: _pack(active_set_of(state, scene, discrete), state))
    rows, done = [], False
    while not done:
        packed, active = pack(state, scene, discrete)
        state, log, done = advance(state, scene, discrete, log, jnp.int32(1))
        if int(state.control.last_count) > 0:
            rows.append((packed, active, state.control.last_length, state.control.last_count))
    return Windows(*jax.tree.map(lambda *values: jnp.stack(values), *rows))


def _pack(active: ActiveSet, state: State) -> tuple[PackedState, ActiveSet]:
    return active.pack_state(state), active


def _steps(most: int | None = None) -> _Part:
    """All steps of a window, or at most so many, and its end."""

    def part(
        state: PackedState, scene: jaxform.Scene, active: ActiveSet, length: jax.Array, count: jax.Array
    ) -> tuple[Any, Workspace | None]:
        control = state.control
        limit = state.nodes.mode, control.bound, control.sharpness, control.base_length
        count = count if most is None else jnp.minimum(count, most)
        decisions = (length, count, limit, active.workspace), None
        end, _, workspace = step_window(state, scene, active, decisions, differentiable=False)
        return end, workspace

    return part


def _choose(
    state: PackedState, scene: jaxform.Scene, active: ActiveSet, length: jax.Array, count: jax.Array
) -> tuple[Any, Workspace | None]:
    *found, workspace = choose_step(state, scene, active)
    return found, workspace


def _list(
    state: PackedState, scene: jaxform.Scene, active: ActiveSet, length: jax.Array, count: jax.Array
) -> tuple[Any, Workspace | None]:
    nodes, workspace = state.nodes, active.workspace
    assert scene.tables.grid is not None and workspace is not None and workspace.lists is not None
    found = list_candidates(
        nodes.positions,
        nodes.velocities,
        ~nodes.stuck,
        length,
        count,
        scene.tables.grid,
        into=workspace.lists[0],
        blocks=active.packed.elements.node_block_count,
    )
    return found.count, dataclasses.replace(workspace, lists=(found.lists,))


def _nothing(
    state: PackedState, scene: jaxform.Scene, active: ActiveSet, *_: jax.Array
) -> tuple[Any, Workspace | None]:
    return (state, active.packed, active.thickness), active.workspace


def _over_windows(part: _Part, scene: jaxform.Scene, windows: Windows) -> Callable[[], Any]:
    """A part of every window of a run, as one call of a compiled program."""

    @functools.partial(jax.jit, compiler_options=compiler_options())
    def all_windows(windows: Windows, scene: jaxform.Scene, workspace: Workspace | None) -> Any:
        def once(k: jax.Array, carry: tuple[jax.Array, Workspace | None]) -> tuple[jax.Array, Workspace | None]:
            total, workspace = carry
            state, active, length, count = materialize(jax.tree.map(lambda values: values[k], windows))
            active = dataclasses.replace(active, workspace=workspace)
            found, workspace = part(state, scene, active, length, count)
            return total + sum(
                jnp.sum(leaf.ravel()[:1] * 1.0) for leaf in jax.tree.leaves(materialize(found))
            ), workspace

        return jax.lax.fori_loop(0, windows.counts.size, once, (jnp.zeros(()), workspace))[0]

    first = jax.tree.map(lambda values: values[0], windows.active)
    workspace = allocate_workspace(first, scene).workspace
    return lambda: all_windows(windows, scene, workspace)


def parts_of_windows(scene: jaxform.Scene) -> dict[str, Callable[[], Any]]:
    """The programs whose times `split_time` takes apart, by name."""
    windows = record_windows(scene)
    free = dataclasses.replace(scene, mold=None, tables=dataclasses.replace(scene.tables, grid=None))
    undamped = dataclasses.replace(free, solver=dataclasses.replace(free.solver, damping=None))
    parts: dict[str, tuple[_Part, jaxform.Scene]] = {
        "nothing": (_nothing, scene),
        "stable step": (_choose, scene),
        "list": (_list, scene),
        "windows": (_steps(), scene),
        "without contact": (_steps(), free),
        "without damping": (_steps(), undamped),
        "one step": (_steps(1), undamped),
    }
    return {name: _over_windows(*part, windows) for name, part in parts.items()}


def split_time(seconds: dict[str, float]) -> dict[str, float]:
    """The time of a run [s] by what takes it, which adds up to `run`, from the times of its parts."""
    own = {name: seconds[name] - seconds["nothing"] for name in ("stable step", "list", "windows", *_SWITCHED)}
    return {
        "forces and step": own["without damping"] - own["one step"],
        "damping and its loss": own["without contact"] - own["without damping"],
        "contact: checks, search, landing": own["windows"] - own["without contact"] - own["list"],
        "window boundary: list of candidates": own["list"],
        "window boundary: energy balance, first step": own["one step"],
        "window boundary: stable step": own["stable step"],
        "window boundary: packing, end test, the rest": seconds["loop"] - own["windows"] - own["stable step"],
        "start, result and checks on the host": seconds["run"] - seconds["loop"],
    }


_SWITCHED = "without contact", "without damping", "one step"
_ROUNDS = 40


def show_bowl(element_size: float = ELEMENT_SIZE, rounds: int = _ROUNDS) -> list[dict[str, Any]]:
    """The bowl's whole run beside plain C++, what its time is spent on, and value and gradient; CPU time."""
    scene = bowl(element_size)
    with warnings.catch_warnings(action="ignore"):
        result = jaxform.run(scene)
    assert int(result.status) == 0 and result.schedule is not None, jaxform.explain(result)
    runs: dict[str, Callable[[], Any]] = {"run": lambda: jaxform.run(scene), "loop": whole_loop(scene)}
    peer = cpp_run(scene, result.schedule)
    row: dict[str, Any] = {"elements": len(scene.parison.triangles), "steps": int(result.steps)}
    row["rms difference m"] = None
    if peer is not None:
        positions, moved = peer()
        row |= {"element steps": moved, "rms difference m": _rms(positions, result.positions)}
        runs["C++"] = lambda: peer()[1]
    with warnings.catch_warnings(action="ignore"):
        seconds = best_in_turns(runs | parts_of_windows(scene) | _gradient(scene), rounds, time.process_time)
    for name in ("run", "loop", "C++", "value and gradient"):
        row[name + " ms"] = 1e3 * seconds[name] if name in seconds else None
    if peer is not None:
        row["loop / C++"] = seconds["loop"] / seconds["C++"]
    row["value and gradient / loop"] = seconds["value and gradient"] / seconds["loop"]
    say(row)
    split = split_time(seconds)
    table = [{"part": part, "ms": 1e3 * taken, "share": taken / seconds["run"]} for part, taken in split.items()]
    table.append({"part": "sum", "ms": 1e3 * sum(split.values()), "share": sum(split.values()) / seconds["run"]})
    for part in table:
        say(part)
    return [row, *table]


def _rms(positions: Array, others: Any) -> float:
    return float(np.sqrt(np.mean(np.sum(np.square(positions - np.asarray(others)), axis=1))))


def _gradient(scene: jaxform.Scene) -> dict[str, Callable[[], Any]]:
    """Value and gradient of the wall's mean square by every thickness and pressure."""

    def loss(thickness: jax.Array, pressure: jax.Array) -> jax.Array:
        changed = jaxform.replace(scene, {"parison.thickness": thickness, "pressure.value": pressure})
        return jnp.mean(jnp.square(jaxform.simulate(changed).thickness))

    values = scene.parison.thickness, scene.pressure.value
    compiled = compile_function(jax.jit(jax.value_and_grad(loss, argnums=(0, 1))), *values)
    return {"value and gradient": lambda: compiled(*values)}

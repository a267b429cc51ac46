"""Speed: `make bench` prints every figure, writes out/bench/bench.json and pictures.

On one core, but for the batch and for the command's start, which take what there is. Times are the best of several
runs, all of one table in one process, one after another on an otherwise idle machine.
"""

from __future__ import annotations

import dataclasses
import functools
import json
import os
import platform
import subprocess
import sys
import tempfile
import time
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import jaxform
from benchmarks.speed import bowl, contact, formulations, peers, sheets
from benchmarks.timing import best_in_turns, best_seconds, one_core, say, whole_loop
from jaxform import molds
from jaxform.contact import candidates
from jaxform.core.compilation import compile_function, compiler_options
from jaxform.dynamics import timestep
from jaxform.dynamics import window as windows
from jaxform.materials import ModifiedMooneyRivlin, MooneyRivlin
from jaxform.model.tables import SHORT_WINDOW
from jaxform.runs import host
from jaxform.sheet import energy_balance
from jaxform.sheet.active_set import ActiveSet, active_set_of, pack_moving
from jaxform.sheet.discretization import Discretization
from jaxform.sheet.state import PackedState, State, can_move

SIZES = (128, 512, 2048, 8192, 32768, 131072)
_WORK = 1_200_000  # element steps in one timing
_MANY = 20  # rounds of what takes a tenth of a second: in fewer of them, what else the machine does shows
Table = list[dict[str, Any]]


def _per_step(runs: dict[str, Callable[[int], Any]], elements: int) -> dict[str, float]:
    """Nanoseconds per element and step of each, taken in turns."""
    count = max(16, _WORK // elements)
    seconds = best_in_turns({name: lambda run=run: run(count) for name, run in runs.items()})
    return {name: 1e9 * taken / count / elements for name, taken in seconds.items()}


def show_bare(sizes: tuple[int, ...] = SIZES) -> Table:
    """The bare step beside its peers, by size and precision."""
    table = []
    for size in sizes:
        sheet = sheets.sheet(size)
        count = len(sheet.triangles)
        single = jnp.float32
        runs: dict[str, Callable[[int], Any] | None] = {
            "C++": peers.cpp(sheet),
            "jaxform": formulations.own_formulation(sheet),
            "C++ float32": peers.cpp(sheet, np.float32),
            "jaxform float32": formulations.own_formulation(sheet, single),
            "numba": peers.with_numba(sheet),
            "NumPy": peers.with_numpy(sheet),
        }
        row: dict[str, Any] = {"elements": count}
        row |= dict.fromkeys(runs) | _per_step({name: run for name, run in runs.items() if run is not None}, count)
        row["jaxform / C++"] = None if row["C++"] is None else row["jaxform"] / row["C++"]
        table.append(row)
        say(row)
    sizes_done = [row["elements"] for row in table if row["elements"] >= 2000]
    if len(sizes_done) > 1:
        first, last = (next(row for row in table if row["elements"] == n) for n in (sizes_done[0], sizes_done[-1]))
        growth = 1 + np.log(last["jaxform"] / first["jaxform"]) / np.log(last["elements"] / first["elements"])
        print(f"growth exponent of the time of a step from {first['elements']} to {last['elements']}: {growth:.3f}")
    return table


def show_formulations(sizes: tuple[int, ...] = (2048, 32768)) -> Table:
    """Prints the cost of each way to write the force."""
    table = []
    for size in sizes:
        sheet = sheets.sheet(size)
        ways = {name: formulations.stepper(build(sheet), sheet) for name, build in formulations.LOSERS.items()}
        ways |= {
            f"jaxform, blocks of {block}": formulations.own_formulation(sheet, block=block)
            for block in (64, 96, 128, 256)
        }
        ways["jaxform, elements one by one"] = formulations.own_formulation(sheet, paired=False)
        if (loop := peers.cpp(sheet)) is not None:
            ways["plain C++"] = loop
        for name, cost in _per_step(ways, len(sheet.triangles)).items():
            table.append({"formulation": name, "elements": len(sheet.triangles), "ns": cost})
            say(table[-1])
    return table


def free_sheet(elements: int, steps: int, damping: float | None = None) -> jaxform.Scene:
    """A clamped square with 8 pressure knots and no mold, that takes about so many steps."""
    sheet = sheets.sheet(elements)
    rim = sheet.compliance[:, 0] == 0
    end = steps * sheet.step * 2.1

    def build(end: float) -> jaxform.Scene:
        return jaxform.build_scene(
            parison=jaxform.make_parison(sheet.positions, sheet.triangles, sheets.THICKNESS, rim),
            material=MooneyRivlin(jnp.asarray(sheets.C), jnp.asarray(sheets.ALPHA), jnp.asarray(1.0)),
            pressure=jaxform.make_pressure(np.linspace(0, end, 8), np.linspace(0, 0.04, 8)),
            solver=jaxform.make_solver(end_time=end, damping=damping),
        )

    taken = int(jaxform.run(build(end)).steps)
    return build(end * steps / taken)


def _loss(scene: jaxform.Scene, adjoint: jaxform.Adjoint | None) -> Callable[..., jax.Array]:
    def loss(thickness: jax.Array, pressure: jax.Array) -> jax.Array:
        changed = jaxform.replace(scene, {"parison.thickness": thickness, "pressure.value": pressure})
        return jnp.mean(jnp.square(jaxform.simulate(changed, adjoint=adjoint).thickness))

    return loss


def gradient_cost(
    scene: jaxform.Scene, adjoint: jaxform.Adjoint | None = None, *, forward_mode: bool = False
) -> dict[str, Any]:
    """Cost of value and gradient with respect to all thicknesses and pressures, and of one forward-mode column.

    Beside them as many bare steps of a sheet of about as many elements in a plain C++ loop.
    """
    elements = len(scene.parison.triangles)
    result = jaxform.run(scene)
    assert int(result.status) == 0, jaxform.explain(result)
    steps = int(result.steps)
    unit = 1e-9 * steps * elements
    values = scene.parison.thickness, scene.pressure.value
    begin = time.perf_counter()
    gradient = compile_function(jax.jit(jax.value_and_grad(_loss(scene, adjoint), argnums=(0, 1))), *values)
    compiling = time.perf_counter() - begin
    memory = gradient.memory_analysis()
    runs = {"run": whole_loop(scene), "value and gradient": lambda: gradient(*values)}
    if forward_mode:
        column = compile_function(jax.jit(lambda h, p: jax.jvp(_loss(scene, adjoint), (h, p), (h, p))), *values)
        runs["forward mode"] = lambda: column(*values)
    sheet = sheets.sheet(elements)
    if (compiled_loop := peers.cpp(sheet)) is not None:
        runs["C++"] = lambda: compiled_loop(steps)
    seconds = best_in_turns(runs, 3)
    row = {
        "elements": elements,
        "steps": steps,
        "adjoint": str(adjoint or jaxform.Reversed()),
        "compile s": compiling,
        "memory MB": None if memory is None else memory.temp_size_in_bytes / 1e6,
    }
    row |= {name: taken / unit for name, taken in seconds.items()}
    row["gradient / run"] = seconds["value and gradient"] / seconds["run"]
    if compiled_loop is not None:
        row["C++"] *= elements / len(sheet.triangles)
        row["gradient / C++"] = row["value and gradient"] / row["C++"]
    return row


def show_gradients(sizes: tuple[int, ...] = SIZES) -> Table:
    """By size: ns per element and step of the run, of value and gradient, and of forward mode."""
    table = []
    for size in sizes:
        table.append(gradient_cost(free_sheet(size, max(128, min(1024, 4_000_000 // size))), forward_mode=True))
        say(table[-1])
    return table


def show_memory(steps: tuple[int, ...] = (640, 2560, 10000), everything: int = 640) -> Table:
    """By number of steps and by what is stored: time and peak memory of the gradient for 2048 elements."""
    table = []
    for count in steps:
        scene = free_sheet(2048, count)
        stored = [jaxform.Stored()] if count <= everything else []
        for adjoint in (*stored, *(jaxform.Reversed(count) for count in (1, 4, 16))):
            table.append(gradient_cost(scene, adjoint))
            say(table[-1])
    return table


def skip_scenes() -> Iterator[tuple[str, jaxform.Scene]]:
    """The dish, the box with insert and a free disc."""
    yield "dish", jaxform.load("dish")
    yield "box with insert", contact.box(contact.mold_of(molds.box_insert()), 2000)
    yield "free sheet", free_sheet(2048, 2000, 1.0)


SKIPS: dict[str, dict[str, bool]] = {
    "all": {},
    "no skip_stuck": {"skip_stuck": False},
    "no skip_far": {"skip_far": False},
    "neither": {"skip_stuck": False, "skip_far": False},
    "no sharp_step": {"sharp_step": False},
    "no end_early": {"end_early": False},
}


def disable_skips(scene: jaxform.Scene, **switches: bool) -> jaxform.Scene:
    """The scene with some of what a window saves switched off."""
    return dataclasses.replace(scene, solver=dataclasses.replace(scene.solver, **switches))


def show_skips() -> Table:
    """Prints what every switch saves."""
    table = []
    for name, scene in skip_scenes():
        scenes = {switch: disable_skips(scene, **off) for switch, off in SKIPS.items()}
        ready = {switch: whole_loop(one) for switch, one in scenes.items()}
        seconds = best_in_turns(ready, _MANY)
        for switch, taken in seconds.items():
            row = {"scene": name, "switched": switch, "seconds": taken, "steps": int(jaxform.run(scenes[switch]).steps)}
            table.append(row | {"saved": 1 - seconds["all"] / taken})
            say(table[-1])
    return table


def moving_share(scene: jaxform.Scene) -> tuple[int, int]:
    """Element steps of elements that can move, and steps, of a run."""
    state, body, taken = host.begin(scene)
    advance = host.compile_advance(state, scene, body, taken)
    sheet = scene.tables.sheet
    count = jax.jit(lambda state: can_move(state.nodes.stuck, sheet.triangles, sheet.area).sum())
    moved, done = 0, False
    while not done:
        moving, before = int(count(state)), int(state.steps)
        state, taken, done = advance(state, scene, body, taken, jnp.int32(1))
        moved += moving * (int(state.steps) - before)
    return moved, int(state.steps)


def show_whole_run() -> Table:
    """The dish's whole run against the bare step of the elements that can move; float32 beside it.

    The bare step is that of the other tables, and the same with the dish's law, which takes more: it has a square.
    """
    sheet, scene = sheets.sheet(2048), jaxform.load("dish")
    elements, count = len(sheet.triangles), 500
    law = ModifiedMooneyRivlin(jnp.asarray(sheets.C), jnp.asarray(sheets.ALPHA), jnp.asarray(1.0))
    bare = {"bare": formulations.own_formulation(sheet), "with its law": formulations.own_formulation(sheet, law=law)}
    moved, steps = moving_share(scene)
    double = jaxform.run(scene)
    runs = {name: lambda run=run: run(count) for name, run in bare.items()}
    seconds = best_in_turns(runs | {"dish": whole_loop(scene)}, _MANY)
    cost = {name: 1e9 * seconds[name] / count / elements for name in bare}
    each = 1e9 * seconds["dish"] / moved
    with jax.enable_x64(False), warnings.catch_warnings(action="ignore"):
        single_scene = jaxform.load("dish")
        single = jaxform.run(single_scene)
        single_seconds = best_seconds(whole_loop(single_scene), _MANY)
    ratio = np.asarray(single.thickness, float) / np.asarray(double.thickness) - 1
    row = {
        "moving": moved / steps / len(scene.parison.triangles),
        "ns per moving element and step": each,
        "bare ns": cost["bare"],
        "run / bare": each / cost["bare"],
        "bare ns with its law": cost["with its law"],
        "run / bare with its law": each / cost["with its law"],
        "seconds": seconds["dish"],
        "float32 seconds": single_seconds,
        "float32 rms %": 100 * float(np.sqrt(np.mean(np.square(ratio)))),
    }
    say(row)
    return [row]


def with_windows_of(steps: int, scene: jaxform.Scene) -> jaxform.Scene:
    """A scene whose windows take no more steps."""
    return dataclasses.replace(scene, tables=dataclasses.replace(scene.tables, longest_window=steps))


def show_parts(window: int = 20) -> Table:
    """Cost of the parts of a step and of a short window's border on the dish [us], all elements moving."""
    scene = with_windows_of(SHORT_WINDOW, jaxform.load("dish"))
    state, body, taken = host.begin(scene)
    state = host.compile_advance(state, scene, body, taken)(state, scene, body, taken, jnp.int32(window))[0]
    free = dataclasses.replace(scene, mold=None, tables=dataclasses.replace(scene.tables, grid=None))
    undamped = dataclasses.replace(free, solver=dataclasses.replace(free.solver, damping=None))
    unsearched = dataclasses.replace(undamped, solver=dataclasses.replace(undamped.solver, sharp_step=False))

    def border(state: PackedState, scene: jaxform.Scene, active: ActiveSet) -> Any:
        return windows.window_in_place(state, with_windows_of(1, scene), active)

    def list_pairs(state: State, scene: jaxform.Scene, _: Any) -> Any:
        assert scene.tables.grid is not None
        return candidates.list_candidates(
            state.nodes.positions,
            state.nodes.velocities,
            ~state.nodes.stuck,
            state.control.step_length,
            jnp.int32(SHORT_WINDOW),
            scene.tables.grid,
        )

    def balance(state: State, scene: jaxform.Scene, active: ActiveSet) -> Any:
        return energy_balance.element_energy(
            state.nodes.positions, active.packed.elements, active.thickness, scene.material, None
        )

    parts: dict[str, tuple[Callable[..., Any], jaxform.Scene]] = {
        "nothing": (lambda state, *_: state.nodes.positions[0, 0], scene),
        "pack what can move": (lambda state, scene, _: _pack_scene(state, scene, body), scene),
        "choose the step": (timestep.choose_step, scene),
        "list the nodes near the mold": (list_pairs, scene),
        "energy account": (balance, scene),
        "window": (windows.window_in_place, scene),
        "window without contact": (windows.window_in_place, free),
        "and without damping": (windows.window_in_place, undamped),
        "and without the search for the step": (windows.window_in_place, unsearched),
        "window of one step": (border, scene),
        "window of one step without contact": (border, free),
        "and without damping and search": (border, unsearched),
    }
    sheet = sheets.sheet(2048)
    own, steps = formulations.own_formulation(sheet), _TIMES * SHORT_WINDOW
    runs = {name: _repeat(*part, state) for name, part in parts.items()}
    seconds = best_in_turns({"bare": lambda: own(steps)} | runs, 15)
    bare = seconds.pop("bare") * len(scene.parison.triangles) / len(sheet.triangles)
    nothing = seconds.pop("nothing")
    table = [{"part": "bare steps of as many elements", "us per window": 1e6 * bare / _TIMES}]
    table += [{"part": name, "us per window": 1e6 * (taken - nothing) / _TIMES} for name, taken in seconds.items()]
    for row in table:
        say(row)
    return table


_TIMES = 200  # in one program: called by itself a part takes longer to start than to work


def _pack_scene(state: State, scene: jaxform.Scene, body: Discretization) -> Any:
    # Read from the positions, so that it is not taken out of the loop; in packed order, where nothing sticks, it is a
    # list of as many nodes.
    stuck = state.nodes.positions[0, : body.mass.size] > 1e9
    return pack_moving(stuck, state.mesh, scene, body)


def _repeat(part: Callable[..., Any], scene: jaxform.Scene, state: State) -> Callable[[], jax.Array]:
    """A part, several times in one program, each time at positions that follow from what the last one gave."""
    if not scene.solver.sharp_step:
        state = state.replace_nodes(mode=None)

    @functools.partial(jax.jit, compiler_options=compiler_options())
    def several(state: State, scene: jaxform.Scene, active: ActiveSet) -> jax.Array:
        def once(_: jax.Array, last: jax.Array) -> jax.Array:
            moved = state.replace_nodes(positions=state.nodes.positions + 1e-30 * last)
            results = jax.tree.leaves(part(moved, scene, active))
            return sum((jnp.sum(result.ravel()[:3]) * 1.0 for result in results), jnp.zeros(()))

        return jax.lax.fori_loop(0, _TIMES, once, jnp.zeros(()))

    active = jax.jit(active_set_of)(state, scene, host.begin(scene)[1])
    taken = active.pack_state(state)
    return lambda: several(taken, scene, active)


def show_batch(count: int = 16) -> Table:
    """Designs per second, one after another on one core, and shared out over all."""
    scene = jaxform.load("dish-coarse")
    factors = np.linspace(0.8, 1.2, count)[:, None]
    changes = {"parison.thickness": factors * np.asarray(scene.parison.thickness)}
    cores = os.cpu_count() or 1

    def shard_designs(workers: int) -> Callable[[], jax.Array]:
        return lambda: jaxform.simulate_batch(scene, changes, workers=workers).positions

    seconds = best_in_turns({str(workers): shard_designs(workers) for workers in (1, cores)}, _MANY)
    table: Table = [{"workers": int(n), "designs per second": count / taken} for n, taken in seconds.items()]
    table[-1]["throughput over one"] = seconds["1"] / seconds[str(cores)]
    for row in table:
        say(row)
    return table


def show_start() -> Table:
    """Prints the command's time beside the run itself: the second run of a scene, with its programs in the cache."""
    with tempfile.TemporaryDirectory() as folder:
        command = [sys.executable, "-m", "jaxform.cli", "simulate", "dish", "--out", folder, "--force", "--quiet"]
        environment = os.environ | {"XDG_CACHE_HOME": f"{folder}-cache"}
        table = []
        for run in ("first", "second", "third"):
            begin = time.perf_counter()
            subprocess.run(command, check=True, env=environment)
            whole = time.perf_counter() - begin
            summary = json.loads(Path(folder, "summary.json").read_text())
            table.append({"run": run, "seconds": whole, "overhead": whole - summary["run_seconds"]})
            say(table[-1])
    return table


SECTIONS: dict[str, Callable[[], Table]] = {
    "bare": show_bare,
    "formulations": show_formulations,
    "gradients": show_gradients,
    "memory": show_memory,
    "skips": show_skips,
    "whole run": show_whole_run,
    "parts": show_parts,
    "bowl": bowl.show_bowl,
    "start": show_start,
    "batch": show_batch,
}


def main(names: list[str]) -> None:
    """Runs the named sections, or all, and writes what they found."""
    jax.config.update("jax_enable_x64", True)
    cores = os.sched_getaffinity(0) if hasattr(os, "sched_getaffinity") else None
    found: dict[str, Any] = {"machine": platform.machine(), "jax": jax.__version__}
    for name, section in SECTIONS.items():
        if names and name not in names:
            continue
        if name not in ("batch", "start"):
            one_core()
        elif cores is not None:
            os.sched_setaffinity(0, cores)
        print(f"{name}: {(section.__doc__ or '').splitlines()[0]}", flush=True)
        found[name] = section()
    folder = Path("out/bench")
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "bench.json").write_text(json.dumps(found, indent=2))
    from benchmarks.speed.pictures import draw

    draw(found, folder)
    print(f"written to {folder}")

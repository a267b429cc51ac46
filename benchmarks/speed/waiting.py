"""Time before the first step: for the first scene of a kind, for the next, and through the command.

Each part runs alone by name: `.venv/bin/python -m benchmarks.speed.waiting second room sweep command cold gradient`.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import time
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import jaxform
from benchmarks.speed.beside import SCENE, cup
from jaxform import molds, shapes
from jaxform.core.store import Store
from jaxform.mesh import meshes
from jaxform.model.scene import Scene
from jaxform.runs import host, padding
from jaxform.tools.molds import MoldShape

_COMPILED = "/jax/core/compile/backend_compile_duration"
_ROUNDS = 40
_compiled = [0]
_NAMES = ("dish", "soap-bottle", "box-insert", "dish-refined")


def profile_call(depth: float, angle: float, segments: int = 96) -> MoldShape:
    """A truncated cone of a depth [m] and an angle [degrees] under a disc of radius 0.1 m."""
    base = 0.1 - depth / np.tan(np.deg2rad(angle))
    return molds.revolved(profile=[[0.0, depth], [base, depth], [0.1, 0.0]], segments=segments)


def dish(
    depth: float, angle: float, elements: int, knots: int = 2, stiffness: float = 2e5, end_time: float = 0.24
) -> Scene:
    """A quarter of a disc blown into it."""
    sheet, wall = shapes.disc(radius=0.1, elements=elements, symmetry="quarter"), profile_call(depth, angle)
    return jaxform.build_scene(
        parison=jaxform.make_parison(sheet.positions, sheet.triangles, 1e-3, sheet.clamped, sheet.fixed),
        material=jaxform.MooneyRivlin(jnp.asarray(stiffness), jnp.asarray(0.1), jnp.asarray(1e3)),
        pressure=jaxform.make_pressure(np.linspace(0.0, 0.2, knots), np.linspace(0.0, 2e4, knots)),
        solver=jaxform.make_solver(end_time=end_time, damping=100.0),
        mold=jaxform.make_mold(wall.vertices, wall.triangles),
        name=f"{depth} {angle}",
    )


def measure_waiting(scene: Scene) -> tuple[float, float, int]:
    """Seconds to the end of the first window and of the whole run, and how many programs were compiled."""
    before, begin, first = _compiled[0], time.perf_counter(), []

    def look(_: jaxform.Moment) -> None:
        if not first:
            first.append(time.perf_counter() - begin)

    jaxform.run(scene, on_window=look)
    return first[0], time.perf_counter() - begin, _compiled[0] - before


def show_second() -> None:
    """The first scene of a kind, then others of it."""
    print("scene of a kind in one process: first step after [s], programs compiled", flush=True)
    for words, scene in (
        ("the first", dish(0.05, 70.0, 700)),
        ("another mesh", dish(0.05, 70.0, 950)),
        ("another mold profile", dish(0.07, 76.0, 700)),
        ("another number of knots", dish(0.05, 70.0, 700, knots=11)),
        ("another stiffness", dish(0.05, 70.0, 700, stiffness=3e5)),
    ):
        first, _, count = measure_waiting(scene)
        print(f"  {words}: {first:.3f} s, {count}", flush=True)


def _whole(scene: Scene, store: Store) -> Callable[[], Any]:
    """A run of a scene in arrays as they are, from its begin to its result, compiled beforehand."""
    begin, advance, pending = host.programs(scene, store)
    made, last = pending.result(), np.bool_(True)
    most = np.int32(scene.tables.window_count)

    def run() -> Any:
        state, first, taken = begin(scene)
        state, taken, _ = advance(state, scene, first, taken, most)
        return jax.block_until_ready(made(state, scene, first, taken, last))

    return run


def show_room() -> None:
    """Prints the cost of unused capacity at the begin and end of a bucket; runs alternate."""
    print("time of a run in padded arrays over that in arrays of its own size", flush=True)
    for elements in (520, 1020, 1080, 2350, 2430):
        scene, store = dish(0.05, 70.0, elements), Store()
        room = padding.pad_to_bucket(scene, recorded=True).scene
        runs, ratios = [_whole(each, store) for each in (scene, room)], []
        for run in runs:
            run()
        for _ in range(_ROUNDS):
            times = []
            for run in runs:
                begin = time.perf_counter()
                run()
                times.append(time.perf_counter() - begin)
            ratios.append(times[1] / times[0])
        count, wide = len(scene.parison.triangles), len(room.parison.triangles)
        print(f"  {count} elements in {wide}: {np.median(ratios):.3f}, of {times[0]:.4f} s", flush=True)


def show_sweep() -> None:
    """Twenty dishes of other depth, angle and size, load and all."""
    random, begin, ran = np.random.default_rng(0), time.perf_counter(), 0.0
    for _ in range(20):
        depth, angle = random.uniform(0.04, 0.08), random.uniform(65.0, 80.0)
        result = jaxform.run(dish(depth, angle, int(random.integers(600, 2000))))
        assert result.seconds is not None
        ran += result.seconds.run
    whole = time.perf_counter() - begin
    print(
        f"20 dishes: {whole:.1f} s, of which they ran {ran:.1f} s; {whole - ran:.1f} s beside (asked: 10)", flush=True
    )


def _scene_with_mold(folder: Path, elements: int, triangles: int) -> str:
    """A scene file with a mold of its own, in millimetres."""
    shape, mold = cup(triangles), folder / f"mold-{triangles}.stl"
    meshes.write_stl(mold, 1e3 * shape.vertices, shape.triangles)
    path = folder / f"scene-{elements}-{triangles}.toml"
    path.write_text(SCENE.format(elements=elements, mold=mold, scale=0.001, rise=0.2, end=0.24))
    return str(path)


def _command(source: str, cache: Path, out: Path) -> tuple[float, dict[str, Any]]:
    """Seconds of `jaxform simulate` as a whole process, and its summary."""
    words = [sys.executable, "-m", "jaxform.cli", "simulate", source, "--out", str(out), "--force", "--quiet"]
    begin = time.perf_counter()
    # Byte code is kept, as `make` has it: else every start compiles all libraries anew, for three seconds.
    environment = {**os.environ, "XDG_CACHE_HOME": str(cache), "PYTHONDONTWRITEBYTECODE": ""}
    subprocess.run(words, check=True, env=environment, stderr=subprocess.DEVNULL)
    seconds = time.perf_counter() - begin
    return seconds, json.loads((out / "summary.json").read_text())


def show_command() -> None:
    """The command: cold, then warm, beside its steps; then other scenes whose bucket sizes are known."""
    print("`jaxform simulate`, whole process less its steps [s]: cold, then the best of three warm", flush=True)
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place)
        known = [_scene_with_mold(folder, 900, 400), _scene_with_mold(folder, 900, 12_000)]
        for source in (*_NAMES, *known):
            cold, summary = _command(source, folder / "cache", folder / "out")
            warm = min(_baseline_seconds(source, folder) for _ in range(3))
            print(f"  {Path(source).stem}: {cold - summary['run_seconds']:.1f}, {warm:.2f}", flush=True)
        for source in (_scene_with_mold(folder, 1000, 700), _scene_with_mold(folder, 800, 9000)):
            print(
                f"  {Path(source).stem}, seen for the first time: {_baseline_seconds(source, folder):.2f}", flush=True
            )


def _baseline_seconds(source: str, folder: Path) -> float:
    seconds, summary = _command(source, folder / "cache", folder / "out")
    return seconds - summary["run_seconds"]


def show_cold() -> None:
    """Prints the waiting times of a run without a cache, after a first small one, which pays for the libraries."""
    measure_waiting(dish(0.05, 70.0, 20))
    print("first scene of a kind, nothing kept: first step after [s]", flush=True)
    for name in _NAMES:
        scene = jaxform.load(name)
        print(f"  {name}: {measure_waiting(scene)[0]:.1f} s", flush=True)


def show_gradient() -> None:
    """Value and gradient of a dish and of a refined one, nothing kept."""
    print("value and gradient, nothing kept: traced and compiled in [s], then worked out in [s]", flush=True)
    for name in ("dish-coarse", "dish", "dish-refined"):
        scene = jaxform.load(name)

        def value(thickness: jax.Array, scene: Scene = scene) -> jax.Array:
            result = jaxform.simulate(jaxform.replace(scene, {"parison.thickness": thickness}))
            return jnp.sum(jnp.square(jnp.where(result.active, result.thickness, 0.0)))

        begin = time.perf_counter()
        both = jax.jit(jax.value_and_grad(value)).lower(scene.parison.thickness)
        traced = time.perf_counter() - begin
        compiled = both.compile(jaxform.compiler_options())
        whole = time.perf_counter() - begin
        jax.block_until_ready(compiled(scene.parison.thickness))
        begin = time.perf_counter()
        jax.block_until_ready(compiled(scene.parison.thickness))
        print(f"  {name}: {whole:.1f} s ({traced:.1f} s traced), {time.perf_counter() - begin:.2f} s", flush=True)


PARTS = {
    "second": show_second,
    "room": show_room,
    "sweep": show_sweep,
    "command": show_command,
    "cold": show_cold,
    "gradient": show_gradient,
}


def main(names: list[str]) -> int:
    """Runs the named parts, or all."""
    jax.config.update("jax_enable_x64", True)
    jax.config.update("jax_enable_compilation_cache", False)
    warnings.simplefilter("ignore")

    def listen(event: str, duration_secs: float, **kwargs: str | int) -> None:
        _compiled[0] += event == _COMPILED

    jax.monitoring.register_event_duration_secs_listener(listen)
    if len(names) != 1:
        # Each in a process of its own: what one has compiled the others must not have.
        for name in names or PARTS:
            subprocess.run([sys.executable, "-m", "benchmarks.speed.waiting", name], check=True)
        return 0
    PARTS[names[0]]()
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))

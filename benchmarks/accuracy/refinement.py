"""Gain and cost of refinement: error against time, overhead, smoothness along a line. `make refine`."""

from __future__ import annotations

import dataclasses
import functools
import json
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.tri import LinearTriInterpolator, Triangulation

import jaxform
from benchmarks.accuracy.cases import away_from_corner, exact_ratio, rms
from benchmarks.timing import best_in_turns, one_core, say
from jaxform.adapt import refinement
from jaxform.dynamics import window as windows
from jaxform.io import files
from jaxform.model.scene import Scene
from jaxform.results.result import Result, drop_unused
from jaxform.runs import host
from jaxform.sheet import active_set, discretization
from jaxform.sheet.state import State, is_finished

Row = dict[str, Any]
_JUMP = 1e-6  # a second difference beyond it: a node grazes the mold, and lands now or some steps later
_GRID = 240  # points along each side at which walls are compared
_BLOCK = 0.04  # side of the panel's block [m]


def build(name: str, elements: int, limits: dict[str, Any], **changes: dict[str, Any]) -> Scene:
    """A built-in scene with another number of elements and other tables, refined where there are limits."""
    read = files.read_scene(name)
    data = {key: table for key, table in read.data.items() if key != "refinement"}
    changes |= {"parison": {"elements": elements} | changes.get("parison", {})}
    if limits:
        changes["refinement"] = limits
    for key, table in changes.items():
        data[key] = data.get(key, {}) | table
    data["parison"] = {key: value for key, value in data["parison"].items() if key != "element_size"}
    return files.build(dataclasses.replace(read, model=type(read.model).model_validate(data)))


def dish(elements: int, **limits: Any) -> Scene:
    """The dish under the pressure that fills its corner, as the exact solution does."""
    return build("dish-refined", elements, limits)


def box(elements: int, **limits: Any) -> Scene:
    """The box with insert at 20 kPa: the sheet has wrapped the insert, and small features sit in a large sheet."""
    return build("box-insert", elements, limits, pressure={"value": [0.0, 2.0e4]})


def tray(elements: int, **limits: Any) -> Scene:
    """A large shallow tray with a small block in the middle of its bottom."""
    mold = {"size": [0.6, 0.6], "depth": 0.06, "insert_size": [0.06, 0.06], "insert_height": 0.02}
    size, pressure = {"size": [0.6, 0.6]}, {"value": [0.0, 2.0e4]}
    return build("box-insert", elements, limits, mold=mold, parison=size, pressure=pressure)


def panel(elements: int, **limits: Any) -> Scene:
    """A large sheet that comes to lie on a flat bottom with a small block in its middle, and reaches no wall.

    A low pressure lays it down before a high one presses it on, or it would hit the block at 5 m/s.
    """
    pressure = {"time": [0.0, 0.01, 0.08, 0.24], "value": [0.0, 150.0, 300.0, 2.0e4]}
    wall = build("box-insert", elements, {}, parison={"size": [0.6, 0.6]}, pressure=pressure)
    shape = jaxform.molds.box_insert(size=[0.9, 0.9], depth=0.05, insert_size=[_BLOCK, _BLOCK], insert_height=0.012)
    return jaxform.build_scene(
        parison=wall.parison,
        material=wall.material,
        pressure=wall.pressure,
        solver=wall.solver,
        mold=jaxform.make_mold(shape.vertices - [0.15, 0.15, 0.0], shape.triangles),
        refinement=jaxform.make_refinement(interval=64, elements=8192, **limits) if limits else None,
    )


def wall_at_points(scene: Scene, result: Result, part: float = 1.0) -> np.ndarray:
    """The nodes' thickness [m], linear in between, at points of the initial quarter, or of a part in its middle."""
    scene, result = drop_unused(scene, result)
    start = np.asarray(scene.parison.positions)
    low, high = start.min(0), start.max(0)
    share = (np.arange(_GRID) + 0.5) / _GRID
    # The rectangles' planes of symmetry are at the upper ends.
    x, y = (high[k] - part * share * (high[k] - low[k]) for k in range(2))
    mesh = Triangulation(start[:, 0], start[:, 1], np.asarray(result.triangles))
    wall = LinearTriInterpolator(mesh, np.asarray(result.thickness))(*np.meshgrid(x, y))
    return np.ma.filled(wall, np.nan)


def exact_dish(scene: Scene, result: Result) -> float:
    """Relative rms error [%] of the dish's elements against the exact solution, the last of the corner left out."""
    reference = files.read_reference(files.read_scene("dish"))
    assert reference is not None
    scene, result = drop_unused(scene, result)
    triangles, start = np.asarray(result.triangles), np.asarray(scene.parison.positions)
    place = np.hypot(*start[triangles].mean(1)[:, :2].T)
    exact = exact_ratio(place, reference)
    ratio = np.asarray(result.element_thickness) / np.asarray(scene.parison.thickness)[triangles].mean(1)
    away = away_from_corner(place, reference)
    return 100 * rms((ratio / exact - 1)[away], np.asarray(result.element_volume)[away])


def run_timed(scene: Scene) -> tuple[Scene, Result, float]:
    """The scene with room for what its run needs, the part, and the seconds of the run."""
    first = jaxform.run(scene)
    scene = jaxform.fitted(scene, int(first.used.sum()))
    seconds = [jaxform.run(scene).seconds for _ in range(4)]
    return scene, jaxform.run(scene), min(each.run for each in seconds if each is not None)


def curve(make: Callable[..., Scene], error: Callable[[Scene, Result], float], cases: list[Row]) -> list[Row]:
    rows = []
    for case in cases:
        scene, part, seconds = run_timed(make(**case))
        limits = {key: value for key, value in case.items() if key != "elements"}
        rows.append(
            {
                "refined": str(limits) if limits else "",
                "elements": case["elements"],
                "final": int(part.used.sum()),
                "steps": int(part.steps),
                "error": error(scene, part),
                "seconds": seconds,
                "added mass": float(part.added_mass),
                "status": jaxform.explain(part),
            }
        )
        say(rows[-1])
    return rows


def against(make: Callable[..., Scene], elements: int, part: float = 1.0) -> Callable[[Scene, Result], float]:
    """Relative rms error [%] against a uniform mesh of so many elements, over the initial sheet or part of its quarter.

    Of the wall at the nodes: the elements' own would mostly tell how large they are.
    """
    scene = make(elements)
    fine = wall_at_points(scene, jaxform.run(scene), part)

    def error(scene: Scene, result: Result) -> float:
        return 100 * float(np.sqrt(np.nanmean(np.square(wall_at_points(scene, result, part) / fine - 1))))

    return error


def uniform(*counts: int) -> list[Row]:
    return [{"elements": count} for count in counts]


def show_dish() -> list[Row]:
    """The dish against the exact solution: uniform, and refined from 27 elements in the quarter."""
    refined = [
        {"elements": 27, "angle": angle, "max_level": level, "base_level": base}
        for angle, level, base in ((4.0, 4, 4), (4.0, 5, 0), (8.0, 5, 5), (4.0, 6, 0), (4.0, 6, 6))
    ]
    return curve(dish, exact_dish, uniform(100, 350, 1365, 3000) + refined)


def show_box() -> list[Row]:
    """The box with insert against 64 000 uniform elements: uniform, and refined from 126."""
    refined = [
        {"elements": 128, "angle": angle, "max_level": level, "base_level": level, "mass_scaling_levels": scaled}
        for angle, level, scaled in (
            (12.0, 4, 0),
            (8.0, 6, 0),
            (8.0, 6, 2),
            (12.0, 6, 0),
            (12.0, 6, 1),
            (12.0, 6, 2),
            (12.0, 6, 4),
        )
    ]
    return curve(box, against(box, 64000), uniform(128, 500, 2000, 6000) + refined)


def show_tray() -> list[Row]:
    """A large tray with a small block against 64 000 uniform elements: uniform, and refined from 126."""
    refined = [
        {"elements": 128, "angle": angle, "max_level": level, "base_level": level, "mass_scaling_levels": scaled}
        for angle, level, scaled in ((12.0, 4, 0), (12.0, 6, 0), (20.0, 6, 0), (12.0, 6, 2))
    ]
    return curve(tray, against(tray, 64000), uniform(128, 500, 2000, 6000) + refined)


def show_panel() -> list[Row]:
    """A large sheet over a small block against 128 000 uniform elements, where the block is: uniform, and refined."""
    refined = [
        {"elements": 1000, "angle": 20.0, "max_level": 4, "base_level": base, "proximity_factor": reach}
        | {"mass_scaling_levels": scaled}
        for base, reach, scaled in ((4, 2.0, 0), (6, 1.0, 2), (6, 2.0, 0), (6, 2.0, 2), (6, 3.0, 2))
    ]
    counts = uniform(500, 1000, 2000, 4000, 8000, 16000, 32000)
    return curve(panel, against(panel, 128000, 1.5 * _BLOCK / 0.3), counts + refined)


def show_overhead() -> list[Row]:
    """Prints the share of a run that surveying and refining the mesh takes."""
    rows = []
    for name, scene in (
        ("box-insert", box(128, angle=12.0, max_level=6, base_level=6, mass_scaling_levels=2)),
        ("dish", dish(27, angle=4.0, max_level=6, base_level=6)),
    ):
        scene, part, seconds = run_timed(scene)
        limits = scene.refinement
        assert limits is not None
        state, first, _ = host.begin(scene)
        look = jax.jit(functools.partial(_look, scene))
        advance = jax.jit(lambda state, now, scene=scene: windows.window(state, scene, now, differentiable=False))
        now, spent, growths = discretization.present_discretization(scene, state.mesh, first), 0.0, 0
        while not is_finished(state, scene):
            if refinement.is_refinement_due(state.windows, limits):
                # Calling the program, and copies of all it gives, take time too, which a run does not spend: so beside
                # it the same program at a border where it is not time to look.
                idle = dataclasses.replace(state, windows=state.windows + 1)
                parts = {"now": functools.partial(look, state, now), "idle": functools.partial(look, idle, now)}
                taken = best_in_turns(parts, 7)
                spent += taken["now"] - taken["idle"]
            before = _count(state)
            state, now = look(state, now)
            growths += _count(state) > before
            state = advance(state, now)
        rows.append({"scene": name, "seconds": seconds, "borders": int(part.windows), "growths": growths})
        rows[-1] |= {"refining": spent, "share": spent / seconds}
        say(rows[-1])
    return rows


def _look(
    scene: jaxform.Scene, state: State, now: discretization.Discretization
) -> tuple[State, discretization.Discretization]:
    packed = active_set.active_set_of(state, scene, now)
    refined, now, _ = refinement.refine_in_place(packed.pack_state(state), scene, now, packed)
    return packed.unpack_state(refined), now


def _count(state: State) -> int:
    assert state.mesh is not None
    return int(state.mesh.element_count)


def show_smoothness(points: int = 41, span: float = 2e-4, lines: int = 16) -> list[Row]:
    """The variance of a bowl's wall along lines in the space of designs: uniform mesh, replayed, live."""
    limits = {"angle": 4.0, "max_level": 3, "base_level": 3}
    rows = []
    for name, scene, replays in (
        ("uniform", build("bowl", 300, {}), False),
        ("replayed", build("bowl", 38, limits), True),
        ("live", build("bowl", 38, limits), False),
    ):
        start = scene.parison.thickness
        place = jnp.asarray(np.asarray(scene.parison.positions))
        schedule = jaxform.run(scene).schedule if replays else None

        @jax.jit
        def uneven(share: jax.Array, way: jax.Array, scene=scene, start=start, schedule=schedule) -> jax.Array:
            changed = jaxform.replace(scene, {"parison.thickness": start + share * way})
            part = jaxform.simulate(changed, schedule=schedule)
            area = part.element_volume / jnp.where(part.used, part.element_thickness, 1.0)
            mean = jnp.sum(part.element_volume) / jnp.sum(area)
            return jnp.sum(area * jnp.square(part.element_thickness / mean - 1.0)) / jnp.sum(area)

        shares = np.linspace(-0.5 * span, 0.5 * span, points)
        random, curves = np.random.default_rng(0), []
        for _ in range(lines):
            (a, b), (p, q) = random.uniform(10.0, 60.0, 2), random.uniform(0.0, 2 * np.pi, 2)
            way = start * jnp.sin(a * place[:, 0] + p) * jnp.cos(b * place[:, 1] + q)
            curves.append([float(uneven(jnp.asarray(share), way)) for share in shares])
        values = np.array(curves)
        second = np.abs(np.diff(values, 2, axis=1)).max(1) / values[:, points // 2]
        usual = int(np.argsort(second)[lines // 2])
        rows.append({"mesh": name, "second differences": second.tolist(), "shares": shares.tolist()})
        rows[-1] |= {"values": values[usual].tolist()}
        print(f"  {name}: largest second difference along {lines} lines, of the value: {np.min(second):.1g} to "
              f"{np.max(second):.1g}, {second[usual]:.1g} in the middle, {np.sum(second > _JUMP)} with a jump",
              flush=True)  # fmt: skip
    return rows


def draw(found: dict[str, list[Row]], folder: Path) -> None:
    """Error against time, and the objective along a line."""
    curves = [name for name in ("dish", "box", "tray", "panel") if name in found]
    if curves:
        figure, rooms = plt.subplots(1, len(curves), figsize=(5 * len(curves), 4), layout="constrained", squeeze=False)
        for axes, name in zip(rooms[0], curves, strict=True):
            kinds = {"uniform": ("o-", lambda row: not row["refined"]), "refined": ("s", lambda row: row["refined"])}
            for label, (style, kind) in kinds.items():
                points = [(row["seconds"], row["error"]) for row in found[name] if kind(row)]
                axes.plot(*zip(*points, strict=True), style, label=label)
            axes.set(xscale="log", yscale="log", title=name, xlabel="run [s]", ylabel="wall, rms error [%]")
            axes.grid(alpha=0.3, which="both")
            axes.legend(frameon=False)
        figure.savefig(folder / "refinement-error.png", dpi=110)
    if "smoothness" in found:
        figure, rooms = plt.subplots(1, 3, figsize=(13, 3.6), layout="constrained")
        for axes, row in zip(rooms, found["smoothness"], strict=True):
            values = np.array(row["values"])
            axes.plot(1e4 * np.array(row["shares"]), 1e6 * (values / values[len(values) // 2] - 1), ".-")
            axes.set(title=row["mesh"], xlabel="along the line [1e-4]", ylabel="variance, change [1e-6]")
            axes.grid(alpha=0.3)
        figure.savefig(folder / "refinement-smoothness.png", dpi=110)


SECTIONS: dict[str, Callable[[], list[Row]]] = {
    "dish": show_dish,
    "box": show_box,
    "tray": show_tray,
    "panel": show_panel,
    "overhead": show_overhead,
    "smoothness": show_smoothness,
}


def main(names: list[str]) -> None:
    """Runs the named sections, or all; writes JSON and pictures."""
    jax.config.update("jax_enable_x64", True)
    one_core()
    found: dict[str, list[Row]] = {}
    for name, section in SECTIONS.items():
        if not names or name in names:
            print(f"{name}: {section.__doc__}", flush=True)
            found[name] = section()
            jax.clear_caches()  # so many programs at once would be too many
    folder = Path("out/bench")
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "refinement.json").write_text(json.dumps(found, indent=2))
    draw(found, folder)
    print(f"written to {folder}")


if __name__ == "__main__":
    main(sys.argv[1:])

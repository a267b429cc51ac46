"""Accuracy against solutions that owe nothing to it, and what an error costs in time.

Run it with `make validate`, or parts of it by name: `python -m benchmarks.accuracy cases meshes dish box slow
gradient`; any other name draws the page alone. What a part finds goes into docs/accuracy.json; the page
docs/accuracy.md and its pictures are drawn from that file alone.
"""

from __future__ import annotations

import time
import warnings
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any

import jax
import numpy as np

import jaxform
import optimize
from benchmarks.accuracy import adaptation, cases, page, refinement
from benchmarks.pages import DOCS, Found, read_figures, store_figures
from benchmarks.timing import one_core
from jaxform.io import files
from jaxform.model.scene import Scene
from jaxform.results.result import Result

_FILE = DOCS / "accuracy.json"
_RUNS = 3  # of which the fastest is taken
_FINE = 64000  # elements of the box that the others are compared with


# --- Cases ------------------------------------------------------------------------------------------------------------


def show_cases(names: tuple[str, ...] = tuple(cases.CASES)) -> Found:
    """Every case at its three numbers of elements."""
    found = {}
    for name in names:
        began = time.perf_counter()
        found[name] = cases.show_convergence(cases.CASES[name])
        print(f"  {name}: {time.perf_counter() - began:.0f} s", flush=True)
    return found


# --- Error against time -----------------------------------------------------------------------------------------------


def measure_gradient(
    scene: Scene, error: Callable[[Scene, Result], float], group: str, label: str, default: bool
) -> Found:
    """A run's error [%] and its time [s], the fastest of some; room is left for no more elements than it needs."""
    part = jaxform.run(scene)
    if scene.refinement is not None:
        scene = jaxform.fitted(scene, int(part.used.sum()))
    parts = [jaxform.run(scene) for _ in range(_RUNS)]
    row = {
        "group": group,
        "label": label,
        "default": default,
        "elements": int(part.used.sum()),
        "steps": int(part.steps),
        "error": error(scene, parts[-1]),
        "seconds": min(cases.seconds(each) for each in parts),
        "quasi_static_error": float(part.energy.quasi_static_error),
        "added_mass": float(part.added_mass),
        "status": jaxform.explain(part),
    }
    print(f"  {group} {label}: {row['error']:.3f} %, {row['seconds']:.3f} s", flush=True)
    return row


def in_float32(make: Callable[[], Found]) -> Found:
    """Results made and measured in single precision."""
    jax.config.update("jax_enable_x64", False)
    try:
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", message="jaxform computes in float32")
            return make()
    finally:
        jax.config.update("jax_enable_x64", True)


def _vary_scene(scene: Scene, **factors: float) -> Scene:
    """The scene with another safety, or with ramp and damping times a factor."""
    if "safety" in factors:
        return replace(scene, solver=replace(scene.solver, safety=factors["safety"]))
    ramp, damping = factors.get("ramp", 1.0), factors.get("damping", 1.0)
    assert scene.solver.damping is not None
    return jaxform.replace(
        scene,
        {
            "pressure.time": ramp * np.asarray(scene.pressure.time),
            "solver.end_time": ramp * float(scene.solver.end_time),
            "solver.damping": damping * float(scene.solver.damping),
        },
    )


def _changes() -> Iterator[tuple[str, str, Found]]:
    """Variations at the default mesh, one thing at a time; the time step first."""
    for safety in (0.5, 0.7, 0.95):
        yield "safety", f"{safety}", {"safety": safety}
    for ramp in (0.25, 0.5, 2.0):
        yield "ramp", f"{ramp:g} times", {"ramp": ramp}
    for damping in (0.1, 0.3, 3.0, 10.0):
        yield "damping", f"{damping:g} times", {"damping": damping}


def _varied_rows(long: Scene, error: Callable[[Scene, Result], float]) -> list[Found]:
    """Runs of a scene that has windows for twice its time, with one thing changed at a time."""
    return [
        measure_gradient(_vary_scene(long, **change), error, group, label, False) for group, label, change in _changes()
    ]


def _longer(scene: Scene, factor: float = 4.0) -> Scene:
    """The same with windows for longer ramps and shorter steps."""
    return replace(scene, tables=replace(scene.tables, window_count=int(factor * scene.tables.window_count)))


def show_dish(sizes: tuple[int, ...] = (150, 350, 600, 1350, 2400)) -> list[Found]:
    """The dish against its exact cup: its elements' thickness, rms by material, the last of the corner left out."""
    read = files.read_scene("dish-refined").data
    default: Found = {"elements": read["parison"]["elements"]} | read["refinement"]
    error = refinement.exact_dish
    rows = [measure_gradient(refinement.dish(n), error, "uniform", f"{n}", False) for n in sizes]
    rows.append(measure_gradient(refinement.dish(**default), error, "refined", "as built in", True))
    rows += [
        measure_gradient(refinement.dish(**default | change), error, "refined", words, False)
        for change, words in (
            ({"max_level": 4, "base_level": 4, "mass_scaling_levels": 0}, "to level 4"),
            ({"base_level": 6, "mass_scaling_levels": 0}, "to level 6"),
            ({"base_level": 8, "mass_scaling_levels": 2}, "at the corner to level 8"),
            ({"angle": 4.0, "base_level": 6, "mass_scaling_levels": 0}, "to level 6, 4 degrees"),
        )
    ]
    rows += [
        measure_gradient(
            refinement.dish(**default | {"mass_scaling_levels": k}), error, "mass scaling", f"{k} levels", False
        )
        for k in (0, 2, 6)
    ]
    rows.append(
        in_float32(lambda: measure_gradient(refinement.dish(**default), error, "float32", "as built in", False))
    )
    return rows + _varied_rows(_longer(refinement.dish(**default)), error)


def show_box(sizes: tuple[int, ...] = (128, 500, 2000, 6000)) -> list[Found]:
    """The box with insert at 20 kPa against a uniform mesh of many elements, rms over the initial sheet."""
    read = files.read_scene("box-insert").data
    default: Found = {"elements": read["parison"]["elements"]} | read["refinement"]
    error = refinement.against(refinement.box, _FINE)
    rows = [measure_gradient(refinement.box(n), error, "uniform", f"{n}", False) for n in sizes]
    rows.append(measure_gradient(refinement.box(**default), error, "refined", "as built in", True))
    rows += [
        measure_gradient(refinement.box(**default | change), error, "refined", words, False)
        for change, words in (
            ({"max_level": 4, "base_level": 4}, "to level 4"),
            ({"angle": 8.0}, "to level 6, 8 degrees"),
        )
    ]
    rows += [
        measure_gradient(
            refinement.box(**default | {"mass_scaling_levels": k}), error, "mass scaling", f"{k} levels", False
        )
        for k in (0, 1, 4)
    ]
    rows.append(in_float32(lambda: measure_gradient(refinement.box(**default), error, "float32", "as built in", False)))
    return rows + _varied_rows(_longer(refinement.box(**default)), error)


# --- How slow is slow enough ------------------------------------------------------------------------------------------


def show_slow(
    names: tuple[str, ...] = ("dish-coarse", "cup-slow", "bowl"),
    ramps: tuple[float, ...] = (1.35, 0.666, 0.333, 0.166, 0.083, 0.04),
    dampings: tuple[float, ...] = (0.1, 0.3, 1.0, 3.0, 10.0),
    longest: float = 2.7,
) -> Found:
    """Prints the wall's deviation from the slow one, over ramp time and damping, beside what the energies predict."""
    found: Found = {}
    for name in names:
        rows: list[Found] = []
        slow = None
        for kind in ("cubic-ramp", "linear"):
            scene, damping = _ramp_scene(name, kind, longest)
            if slow is None:
                slow = jaxform.run(_end_values(scene, longest, damping))
            for ramp in ramps:
                rows += [
                    {"kind": kind, "ramp": ramp, "damping": share}
                    | measure_inertia(_end_values(scene, ramp, share * damping), slow)
                    for share in dampings
                ]
        found[name] = {"rows": rows, "damping": damping, "longest": longest}
        print(f"  {name}: {len(rows)} runs", flush=True)
    return found


def _ramp_scene(name: str, kind: str, longest: float) -> tuple[Scene, float]:
    """A built-in scene with a ramp of a kind, and its damping [1/s]."""
    document = files.read_scene(name)
    shape = {"time": [0.0, longest], "value": [0.0, document.data["pressure"]["value"][-1]], "interpolation": kind}
    solver = {"end_time": 1.15 * longest}
    elements = document.data["parison"].get("elements", 150)
    return refinement.build(name, elements, {}, pressure=shape, solver=solver), document.data["solver"]["damping"]


def _end_values(scene: Scene, ramp: float, damping: float) -> Scene:
    times = {"pressure.time": [0.0, ramp], "solver.end_time": 1.15 * ramp}
    return jaxform.replace(scene, times | {"solver.damping": damping})


def measure_inertia(scene: Scene, slow: Result) -> Found:
    """Deviation of a wall from the slow one, rms by material, with the energies that predict it."""
    result = jaxform.run(scene)
    energy, off = result.energy, np.asarray(result.element_thickness) / np.asarray(slow.element_thickness) - 1
    return {
        "error": cases.rms(off, np.asarray(result.element_volume)),
        "quasi_static_error": float(energy.quasi_static_error),
        "kinetic": float(energy.kinetic_peak / energy.external_work),
        "damped": float(energy.damping_loss / energy.external_work),
        "hit": float(energy.contact_loss / energy.external_work),
        "status": int(result.status),
    }


# --- Gradient ---------------------------------------------------------------------------------------------------------


def show_gradient(name: str = "dish-uniform-wall", sizes: tuple[float, ...] = (1e-4, 1e-5, 1e-6)) -> Found:
    """The gradient of a study's objective through the whole run against central differences, knot by knot."""
    study = optimize.load_study(name)
    return {"study": name, "sizes": list(sizes), "table": cases.gradient_sweep(study, list(sizes)).tolist()}


def show_meshes() -> Found:
    """Prints the time for an error on uniform, refined and adapted meshes, by cup."""
    return {name: adaptation.show_costs(name) for name in adaptation.CUPS}


PARTS: dict[str, Callable[[], Any]] = {
    "cases": show_cases,
    "meshes": show_meshes,
    "dish": show_dish,
    "box": show_box,
    "slow": show_slow,
    "gradient": show_gradient,
}


def main(names: list[str]) -> None:
    """Runs parts, keeps what they find, and writes the page."""
    jax.config.update("jax_enable_x64", True)
    one_core()
    for name in names or PARTS:
        if name in PARTS:
            print(f"{name}:", flush=True)
            began = time.perf_counter()
            found = PARTS[name]()
            store_figures(_FILE, name, {"found": found, "seconds": time.perf_counter() - began})
    page.write(read_figures(_FILE), DOCS)

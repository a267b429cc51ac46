"""Gain by adapted meshes: error and time of adapted and uniform runs of cup and dish, against the exact wall.

`python -m benchmarks.accuracy.adaptation [cup] [deep]`. The error is that of the whole wall at the pressure reached,
nothing cut, by initial area: of the elements and of the recovered wall at the nodes. An adapted run's time is that of
all its runs, and of the meshing between them; compiling is left out. The last line of each cup is the time of the
adapted run over that of a uniform mesh as accurate, by the nodes.
"""

from __future__ import annotations

import sys
import time
from typing import Any, NamedTuple

import jax
import numpy as np

import jaxform
from benchmarks.accuracy import cases
from benchmarks.timing import one_core
from jaxform.adapt import mesher
from jaxform.io import files
from jaxform.mesh.shapes import Sheet
from jaxform.model.scene import Scene
from jaxform.results.result import Result, drop_unused
from jaxform.results.size_field import edge_lines, wanted_sizes

_FIRST = 600  # elements of the mesh on which an adapted run begins
_PASSES = 2
_SIZES = (600, 2500, 10000)


class Row(NamedTuple):
    """A run: elements, relative errors of elements, nodes and the thinnest wall, and the time [s] of all its runs."""

    elements: int
    errors: dict[str, float]
    seconds: float


class Cup(NamedTuple):
    """A cup of the accuracy cases: its law, depth, pressure and table of the exact wall."""

    law: Any
    depth: float
    pressure: float
    table: str

    def scene(self, sheet: Sheet, refinement: Any = None) -> Scene:
        """The scene of a sheet of radius 1."""
        return cases.sheet_in_cup(sheet, self.law, self.depth, self.pressure, refinement=refinement)


def show_uniform(cup: Cup, elements: int) -> Row:
    """A run on a uniform mesh."""
    scene = cup.scene(_disc(elements))
    made = cases.cup_errors(scene, cup.table)
    return Row(made.elements, made.errors, made.seconds)


def show_adapted(cup: Cup, elements: int) -> Row:
    """A run on an adapted mesh, with the runs that it needs."""
    sheet, spent = _disc(min(_FIRST, elements)), 0.0
    for _ in range(_PASSES):
        scene = cup.scene(sheet)
        result = jaxform.run(scene)
        began = time.perf_counter()
        sheet = mesher.remesh(sheet, wanted_sizes(scene, result), elements, edge_lines(scene, result))
        spent += cases.seconds(result) + time.perf_counter() - began
    made = cases.cup_errors(cup.scene(sheet), cup.table)
    return Row(made.elements, made.errors, made.seconds + spent)


def _disc(elements: int) -> Sheet:
    return jaxform.shapes.disc(radius=1.0, elements=elements, symmetry="quarter")


# Time for an error on each kind of mesh, for the page of accuracy.

_UNIFORM, _ADAPTED = (600, 1250, 2500, 5000, 10000), (300, 600, 1250, 2500, 5000)
_LEVELS = ((2, 4), (4, 6), (6, 8), (6, 10))  # to which a sheet is refined where it bends, and at the corner


def show_costs(name: str) -> list[dict[str, Any]]:
    """Error at the nodes and CPU time [s] of a cup on uniform meshes, meshes refined in flight, and adapted ones."""
    cup, wall = CUPS[name], cases.exact_table(CUPS[name].table)

    def row(kind: str, scene: Scene, result: Result, spent: float, work: float) -> dict[str, Any]:
        scene, result = drop_unused(scene, result)
        radius = np.hypot(*np.asarray(scene.parison.positions)[:, :2].T)
        off = cases.nodal_ratio(scene, result) / cases.exact_ratio(radius, wall) - 1
        count, error = len(scene.parison.triangles), cases.rms(off, cases.nodal_area(scene))
        made = {"kind": kind, "elements": count, "error": error, "seconds": spent, "element_steps": work}
        print("  " + "  ".join(f"{key} {value}" for key, value in made.items()), flush=True)
        return made

    rows = []
    for elements in _UNIFORM:
        scene = cup.scene(_disc(elements))
        rows.append(row("uniform", scene, *_run_by_cpu(scene)))
    limits = files.read_scene("dish-refined").data["refinement"]
    for level, corner in _LEVELS:
        wanted = limits | {"max_level": level, "base_level": corner, "mass_scaling_levels": min(4, corner - 4)}
        scene = cup.scene(_disc(27), jaxform.make_refinement(**{"interval": 64, "elements": 8192} | wanted))
        scene = jaxform.fitted(scene, int(jaxform.run(scene).used.sum()))
        rows.append(row("refined in flight", scene, *_run_by_cpu(scene)))
    for elements in _ADAPTED:
        sheet, before, done = _disc(min(_FIRST, elements)), 0.0, 0.0
        for _ in range(_PASSES):
            scene = cup.scene(sheet)
            result, spent, work = _run_by_cpu(scene)
            began = time.process_time()
            sheet = mesher.remesh(sheet, wanted_sizes(scene, result), elements, edge_lines(scene, result))
            before, done = before + spent + time.process_time() - began, done + work
        scene = cup.scene(sheet)
        result, spent, work = _run_by_cpu(scene)
        rows.append(row("adapted, all its runs", scene, result, before + spent, done + work))
    return rows


def _run_by_cpu(scene: Scene) -> tuple[Result, float, float]:
    """A run, after one that compiles it; its CPU time [s], and its steps times its elements at the end."""
    jaxform.run(scene)
    began = time.process_time()
    result = jaxform.run(scene)
    return result, time.process_time() - began, float(result.steps) * float(np.asarray(result.used).sum())


def time_of_uniform(rows: list[Row], error: float, kind: str = "nodal thickness") -> float:
    """The time [s] of a uniform run of an error: by a power law through the two finest runs, for it is beyond most."""
    (coarse, fine), (early, late) = np.log(
        [[row.errors[kind] for row in rows[-2:]], [row.seconds for row in rows[-2:]]]
    )
    return float(np.exp(late + (np.log(error) - fine) * (late - early) / (fine - coarse)))


CUPS = {
    "cup": Cup(cases.mooney(0.0), 0.8, 40.0, "cup-at-40"),
    "deep": Cup(cases.paper_law(2.2e-6 / 0.143), 1.2, 30.0, "deep-cup-at-30"),
}


def _say(name: str, row: Row) -> None:
    shown = ", ".join(f"{key} {100 * value:.3f} %" for key, value in row.errors.items())
    print(f"  {name} {row.elements}: {shown}; {row.seconds:.2f} s", flush=True)


def main(names: list[str]) -> None:
    """Prints errors, times, orders and the ratio of times of some cups, by default of all."""
    jax.config.update("jax_enable_x64", True)
    one_core()
    for name in names or CUPS:
        cup = CUPS[name]
        print(f"{name}:", flush=True)
        rows: dict[str, list[Row]] = {"uniform": [], "adapted": []}
        for kind, show in (("uniform", show_uniform), ("adapted", show_adapted)):
            for elements in _SIZES:
                rows[kind].append(show(cup, elements))
                _say(kind, rows[kind][-1])
            counts = [row.elements for row in rows[kind]]
            for what in ("element thickness", "nodal thickness"):
                errors = [row.errors[what] for row in rows[kind]]
                print(f"  order, {what}: {cases.order(counts[::2], errors[::2])[0]:.2f} over all", flush=True)
        row = rows["adapted"][1]
        even = time_of_uniform(rows["uniform"], row.errors["nodal thickness"])
        print(f"  adapted over uniform of the same error: {row.seconds / even:.2f} of its time", flush=True)


if __name__ == "__main__":
    main(sys.argv[1:])

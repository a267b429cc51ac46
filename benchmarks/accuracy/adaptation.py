"""Gain by adapted meshes: error and time of adapted and uniform runs of cup and dish, against the exact wall.

`python -m benchmarks.accuracy.adaptation [cup] [deep] [deep-slow] [bound]`. The error is that of the whole wall at
the pressure reached, nothing cut, by initial area: of the elements and of the recovered wall at the nodes. An adapted
run's time is that of all its runs, and of the meshing between them; compiling is left out. The last line of each cup
is the time of the adapted run over that of a uniform mesh as accurate, by the nodes. `bound` prints the least error
of elements on any isotropic mesh.
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
from jaxform.adapt import mesher, smoothing
from jaxform.io import files
from jaxform.mesh.shapes import Sheet
from jaxform.mesh.volumes import areas
from jaxform.model.scene import Scene
from jaxform.results.result import drop_unused
from jaxform.results.size_field import beside_edges, edge_lines, wanted_sizes

_FIRST = 600  # elements of the mesh on which an adapted run begins
_PASSES = 2
_SIZES = (600, 2500, 10000)


class Row(NamedTuple):
    """A run: elements, relative errors of elements, nodes and the thinnest wall, and the time [s] of all its runs."""

    elements: int
    errors: dict[str, float]
    seconds: float


class Cup(NamedTuple):
    """A cup of the accuracy cases: law, depth, pressure, table of the exact wall, and the time in which that rises."""

    law: Any
    depth: float
    pressure: float
    table: str
    ramp: float = 60.0

    def scene(self, sheet: Sheet, refinement: Any = None) -> Scene:
        """The scene of a sheet of radius 1."""
        return cases.sheet_in_cup(sheet, self.law, self.depth, self.pressure, refinement=refinement, ramp=self.ramp)


def show_uniform(cup: Cup, elements: int) -> Row:
    """A run on a uniform mesh."""
    scene = cup.scene(_disc(elements))
    made = cases.cup_errors(scene, cup.table)
    return Row(made.elements, made.errors, made.seconds)


def show_adapted(cup: Cup, elements: int) -> Row:
    """A run on an adapted mesh, with the runs that it needs."""
    sheet, spent = _disc(min(_FIRST, elements)), 0.0
    for number in range(1, _PASSES + 1):
        scene = cup.scene(sheet)
        result = jaxform.run(scene)
        began = time.perf_counter()
        sheet = _adapted_sheet(sheet, scene, result, elements, last=number == _PASSES)
        spent += cases.seconds(result) + time.perf_counter() - began
    made = cases.cup_errors(cup.scene(sheet), cup.table)
    return Row(made.elements, made.errors, made.seconds + spent)


def _adapted_sheet(sheet: Sheet, scene: Scene, result: jaxform.Result, elements: int, *, last: bool) -> Sheet:
    """The sheet on the mesh that follows from a run, with its nodes moved for the wall if it is the last."""
    made = mesher.remesh(sheet, wanted_sizes(scene, result), elements, edge_lines(scene, result))
    if not last:
        return made
    return smoothing.smooth(made, sheet, np.asarray(result.positions, float), beside_edges(scene, result))


def _disc(elements: int) -> Sheet:
    return jaxform.shapes.disc(radius=1.0, elements=elements, symmetry="quarter")


# Time for an error on each kind of mesh, for the page of accuracy.

_UNIFORM, _ADAPTED = (600, 1250, 2500, 5000, 10000), (300, 600, 1250, 2500, 5000)
_LEVELS = ((2, 4), (4, 6), (6, 8), (6, 10))  # to which a sheet is refined where it bends, and at the corner
_ROUNDS = 5  # of which each run's least CPU time counts


class Chain(NamedTuple):
    """The runs that a wall takes: a kind of mesh, scenes of which the last has that wall, CPU time [s] of meshing."""

    kind: str
    scenes: list[Scene]
    meshing: float


def show_costs(name: str) -> list[dict[str, Any]]:
    """Error at the nodes and CPU time [s] of a cup on uniform meshes, meshes refined in flight, and adapted ones.

    A run's CPU time is the least of some, in rounds through all runs, so that what else the machine does in some
    minutes does not slow all repeats of one run.
    """
    cup, wall = CUPS[name], cases.exact_table(CUPS[name].table)
    chains = [Chain("uniform", [cup.scene(_disc(elements))], 0.0) for elements in _UNIFORM]
    chains += [Chain("refined in flight", [_refined_in_flight(cup, *levels)], 0.0) for levels in _LEVELS]
    chains += [_adapted_chain(cup, elements) for elements in _ADAPTED]
    results = [[jaxform.run(scene) for scene in chain.scenes] for chain in chains]
    seconds = [[[_cpu_time(scene) for scene in chain.scenes] for chain in chains] for _ in range(_ROUNDS)]
    rows = []
    for number, (chain, own) in enumerate(zip(chains, results, strict=True)):
        scene, result = drop_unused(chain.scenes[-1], own[-1])
        radius = np.hypot(*np.asarray(scene.parison.positions)[:, :2].T)
        off = cases.nodal_ratio(scene, result) / cases.exact_ratio(radius, wall) - 1
        made = {
            "kind": chain.kind,
            "elements": len(scene.parison.triangles),
            "error": cases.rms(off, cases.nodal_area(scene)),
            "seconds": chain.meshing + sum(map(min, zip(*(each[number] for each in seconds), strict=True))),
            "element_steps": sum(float(one.steps) * float(np.asarray(one.used).sum()) for one in own),
        }
        print("  " + "  ".join(f"{key} {value}" for key, value in made.items()), flush=True)
        rows.append(made)
    return rows


def _refined_in_flight(cup: Cup, level: int, corner: int) -> Scene:
    """A scene that is refined as the built-in dish is, up to levels, with room for the elements that it needs."""
    limits = files.read_scene("dish-refined").data["refinement"]
    wanted = limits | {"max_level": level, "base_level": corner, "mass_scaling_levels": min(4, corner - 4)}
    scene = cup.scene(_disc(27), jaxform.make_refinement(**{"interval": 64, "elements": 8192} | wanted))
    return jaxform.fitted(scene, int(jaxform.run(scene).used.sum()))


def _adapted_chain(cup: Cup, elements: int) -> Chain:
    """The scenes of a run on an adapted mesh: those by whose walls it is adapted, and the last."""
    sheet, meshing = _disc(min(_FIRST, elements)), 0.0
    scenes = [cup.scene(sheet)]
    for number in range(1, _PASSES + 1):
        result = jaxform.run(scenes[-1])
        began = time.process_time()
        sheet = _adapted_sheet(sheet, scenes[-1], result, elements, last=number == _PASSES)
        meshing += time.process_time() - began
        scenes.append(cup.scene(sheet))
    return Chain("adapted, all its runs", scenes, meshing)


def _cpu_time(scene: Scene) -> float:
    """The CPU time [s] of a run that has been compiled."""
    began = time.process_time()
    jaxform.run(scene)
    return time.process_time() - began


# The least error of constant-strain triangles.

_WALL = np.radians(80.0)  # of the cups
_FINE = 10_000  # elements of the uniform mesh on which the error over the size is measured
_RINGS = 40
_CORNER = 0.03  # initial radii on either side of the corner, whose elements are taken to cost and to miss nothing


def bound_of_elements(cup: Cup, elements: int) -> float:
    """The least relative rms error of the elements' thickness at their centroids, with exact nodes.

    A linear triangle misses the area ratio of a smooth map to first order in its size. With C the rms error over the
    side of equilateral triangles, n of them have at best the rms error (4 / (sqrt(3) n))^(1/2) times the integral of C
    over the sheet, with sides in proportion to C^(-1/2).
    """
    wall, sheet = cases.exact_table(cup.table), _disc(_FINE)
    initial, triangles = np.asarray(sheet.positions), np.asarray(sheet.triangles)
    formed, corner = _exact_positions(initial, wall, cup.depth)
    area = areas(initial, triangles)
    place = np.hypot(*initial[triangles].mean(1)[:, :2].T)
    miss = area / areas(formed, triangles) / cases.exact_ratio(place, wall) - 1.0
    ring = np.minimum((_RINGS * place).astype(int), _RINGS - 1)
    squares = np.bincount(ring, np.square(miss) * area) / np.bincount(ring, 4.0 / np.sqrt(3.0) * np.square(area))
    mid = (np.arange(_RINGS) + 0.5) / _RINGS
    counted = np.where(np.abs(mid - corner) > _CORNER, np.sqrt(squares) * 0.5 * np.pi * mid / _RINGS, 0.0)
    return float(np.sqrt(4.0 / np.sqrt(3.0) / elements) * counted.sum())


def _exact_positions(initial: np.ndarray, wall: dict[str, np.ndarray], depth: float) -> tuple[np.ndarray, float]:
    """Formed positions of points (n, 3) of the disc, by the mass of the exact wall; material radius of the corner."""
    radius = np.linspace(0.0, 1.0, 200_001)
    ring = 0.5 * (radius[1:] + radius[:-1]) * np.diff(radius)
    ring = ring / cases.exact_ratio(0.5 * (radius[1:] + radius[:-1]), wall)
    inside, bottom = np.append(0.0, np.cumsum(ring)), 1.0 - depth / np.tan(_WALL)
    on_bottom = np.sqrt(2.0 * inside)
    down = (1.0 - np.sqrt(np.maximum(1.0 - 2.0 * np.cos(_WALL) * (inside[-1] - inside), 0.0))) / np.cos(_WALL)
    lies = on_bottom <= bottom
    at, height = np.where(lies, on_bottom, 1.0 - down * np.cos(_WALL)), np.where(lies, depth, down * np.sin(_WALL))
    own = np.hypot(*initial[:, :2].T)
    share = np.interp(own, radius, at) / np.maximum(own, np.finfo(float).tiny)
    return np.column_stack([initial[:, :2] * share[:, None], np.interp(own, radius, height)]), float(radius[lies][-1])


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
SLOW = {"deep-slow": CUPS["deep"]._replace(ramp=120.0)}  # where 10 000 elements miss less than the inertia does


def _say(name: str, row: Row) -> None:
    shown = ", ".join(f"{key} {100 * value:.3f} %" for key, value in row.errors.items())
    print(f"  {name} {row.elements}: {shown}; {row.seconds:.2f} s", flush=True)


def main(names: list[str]) -> None:
    """Prints errors, times, orders and the ratio of times of some cups, by default of all."""
    jax.config.update("jax_enable_x64", True)
    one_core()
    for name in names or [*CUPS, *SLOW, "bound"]:
        if name == "bound":
            for each, cup in CUPS.items():
                bound = bound_of_elements(cup, _SIZES[1])
                print(f"elements of {each}, least error of any {_SIZES[1]} equilateral ones: {100 * bound:.2f} %")
            continue
        cup = (CUPS | SLOW)[name]
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

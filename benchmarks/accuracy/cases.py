"""Cases with exact or independent solutions, and by how much a run at a number of elements misses them.

`make validate` runs all of them at three numbers of elements; the tests import what they check from here. Lengths,
stiffness c and density are 1 and sheets 0.01 thick, so pressures are given in c h0 over the length.
"""

from __future__ import annotations

import csv
import dataclasses
import functools
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.tri import LinearTriInterpolator, Triangulation

import jaxform
import optimize
from benchmarks.accuracy import membranes
from jaxform import molds
from jaxform.model.scene import Scene
from jaxform.results import sections
from jaxform.results.recovery import one_sided_thickness, thinnest_recovered
from jaxform.results.result import Result
from jaxform.results.tool_contact import formed_areas
from optimize import solvers

# Sphere under a pressure step: alpha, P r0/(c h0), largest stretch, period in r0 sqrt(rho/c).
SPHERES = [
    (0.0, 1.0, 1.109534, 1.5437),
    (0.0, 2.0, 1.380933, 2.39501),
    (0.5, 2.0, 1.149911, 1.27136),
    (0.5, 5.0, 1.957665, 2.28205),
]
CUP_CORNER, DEEP_CORNER = 0.4806, 0.2986  # initial radii of what comes to lie at the corners of the two cups
THICKNESS = 0.01  # of the sheets
CORNER = 0.02  # of the arc, on both sides of a sharp corner, is left out: it fills at infinite pressure only


def real(value: float) -> jax.Array:
    """A number as a leaf of a scene."""
    return jnp.asarray(value, float)


def mooney(alpha: float) -> jaxform.MooneyRivlin:
    """Mooney-Rivlin law with c = 1 and density 1."""
    return jaxform.MooneyRivlin(real(1.0), real(alpha), real(1.0))


def paper_law(a02: float) -> jaxform.ModifiedMooneyRivlin:
    """The paper's law (Eq. 13) with A01 = 1 and density 1."""
    return jaxform.ModifiedMooneyRivlin(real(1.0), real(a02), real(1.0))


def scene_of(
    sheet: Any,
    material: Any,
    pressure: jaxform.Pressure,
    mold: jaxform.Mold | None = None,
    *,
    thickness: Any = THICKNESS,
    refinement: jaxform.Refinement | None = None,
    **solver: Any,
) -> Scene:
    """A scene of one of the library's sheets."""
    return jaxform.build_scene(
        parison=jaxform.make_parison(sheet.positions, sheet.triangles, thickness, sheet.clamped, sheet.fixed),
        material=material,
        pressure=pressure,
        solver=jaxform.make_solver(**solver),
        mold=mold,
        refinement=refinement,
    )


class Measured(NamedTuple):
    """A case at one number of elements: relative errors by quantity, and the time of one run [s]."""

    elements: int
    errors: dict[str, float]
    seconds: float


@functools.cache
def free_disc(elements: int, end_time: float = 60.0) -> Scene:
    """A quarter of a free disc whose law and pressure are put in with `disc_under`."""
    sheet = jaxform.shapes.disc(radius=1.0, elements=elements, symmetry="quarter")
    ramp = jaxform.make_pressure([0.0, 40.0], [0.0, 0.01])
    return scene_of(sheet, mooney(0.5), ramp, end_time=end_time, damping=1.0)


def disc_under(scene: Scene, alpha: float, pressure: float, **changes: float) -> Scene:
    """The free disc with another law and last pressure."""
    values = {"material.alpha": alpha, "pressure.value": [0.0, 0.01 * pressure]}
    return jaxform.replace(scene, values | {key.replace("_", ".", 1): value for key, value in changes.items()})


def disc_errors(elements: int, alpha: float, pole_stretch: float) -> tuple[dict[str, float], Result]:
    """Relative errors of a quarter of a free disc: pole height, nodal thickness at the pole, over all, at the rim."""
    exact = membranes.free_disc(alpha, pole_stretch)
    scene = disc_under(free_disc(elements), alpha, exact.pressure)
    result = jaxform.run(scene)
    radius = sections.initial_radius(scene)
    pole, rim = int(np.argmin(radius)), np.asarray(scene.parison.clamped)
    off = nodal_ratio(scene, result) / np.interp(radius, exact.radius, exact.thickness) - 1
    weight = nodal_area(scene)
    errors = {
        "pole height": float(result.positions[pole, 2]) / float(exact.height[0]) - 1,
        "pole thickness": float(off[pole]),
        "nodal thickness": rms(off, weight),
        "nodal thickness, inside": rms(off[~rim], weight[~rim]),
        "nodal thickness, rim": rms(off[rim], weight[rim]),
    }
    return errors, result


def nodal_ratio(scene: Scene, result: Result) -> np.ndarray:
    """h/h0 at the nodes (n_node,)."""
    return np.asarray(result.thickness) / np.asarray(scene.parison.thickness)


def nodal_area(scene: Scene) -> np.ndarray:
    """A third of the initial area of each node's elements (n_node,)."""
    positions, triangles = np.asarray(scene.parison.positions), np.asarray(scene.parison.triangles)
    first, second, third = positions[triangles].swapaxes(0, 1)
    area = np.linalg.norm(np.cross(second - first, third - first), axis=1) / 2
    return np.bincount(triangles.ravel(), np.repeat(area / 3, 3), len(positions))


def rms(off: np.ndarray, weight: np.ndarray) -> float:
    """Weighted root of the mean square."""
    return float(np.sqrt(np.average(np.square(off), weights=weight)))


def show_disc(elements: int) -> Measured:
    """Free discs of two models: their height, and the nodal thickness over the material."""
    found: dict[str, float] = {}
    for alpha, stretch in ((0.0, 1.2), (0.0, 1.5), (0.5, 1.5), (0.5, 2.0)):
        errors, result = disc_errors(elements, alpha, stretch)
        shown = (
            errors
            if (alpha, stretch) == (0.0, 1.5)
            else {name: errors[name] for name in ("pole height", "nodal thickness")}
        )
        found |= {f"alpha {alpha:g}, stretch {stretch:g}: {name}": value for name, value in shown.items()}
    return Measured(len(result.element_thickness), found, seconds(result))


def seconds(result: Result) -> float:
    """Time of the run's loop [s]."""
    assert result.seconds is not None
    return result.seconds.run


def limit_pressure(elements: int, within: float = 2e-4, hold: float = 400.0) -> tuple[float, float]:
    """The pressure P a/(c h0) beyond which a neo-Hookean disc runs away, by bisection, and the seconds of a run.

    A run raises the pressure slowly and holds it. Just beyond the limit a sheet lingers for a time that grows as the
    inverse root of the excess, so the hold sets how finely one can tell.
    """
    scene = free_disc(elements, 40.0 + hold)
    low, high, spent = 3.4, 4.2, 0.0
    pole = int(np.argmin(sections.initial_radius(scene)))
    while high / low - 1 > within:
        middle = 0.5 * (low + high)
        result = jaxform.run(disc_under(scene, 0.0, middle))
        away = int(result.status) != 0 or float(result.positions[pole, 2]) > 2.0
        low, high, spent = (low, middle, spent) if away else (middle, high, seconds(result))
    return 0.5 * (low + high), spent


def show_limit(elements: int) -> Measured:
    """The largest pressure at which a neo-Hookean disc comes to rest."""
    found, spent = limit_pressure(elements)
    count = len(free_disc(elements).parison.triangles)
    return Measured(count, {"limit pressure": found / membranes.limit_point() - 1}, spent)


def mean_stretch(scene: Scene, result: Result) -> float:
    """Square root of formed over initial area."""
    return float(np.sqrt(formed_areas(result).sum() / np.asarray(scene.tables.sheet.area).sum()))


def sphere_pressure(law: Any, stretch: float) -> float:
    """P r0/h0 of a closed sphere at a stretch: dW/dL / L^2 with W the energy of equal biaxial stretch."""
    slope = jax.grad(lambda s: law.energy(2 * s**2 + s**-4, s**4 + 2 * s**-2))
    return float(slope(real(stretch))) / stretch**2


def static_sphere_error(elements: int, law: Any, stretch: float) -> tuple[float, Result]:
    """Relative error of the mean stretch of a quarter of a closed sphere under slow pressure, and the part."""
    sheet = jaxform.shapes.sphere(radius=1.0, elements=elements, symmetry="quarter")
    ramp = jaxform.make_pressure([0.0, 20.0], [0.0, 0.01 * sphere_pressure(law, stretch)])
    scene = scene_of(sheet, law, ramp, end_time=40.0, damping=2.0)
    result = jaxform.run(scene)
    return mean_stretch(scene, result) / stretch - 1, result


def show_static_sphere(elements: int) -> Measured:
    """Closed spheres under slow pressure: three models, the modified one with A02/A01 = 0.01."""
    laws = {
        "neo-Hookean, stretch 1.2": (jaxform.NeoHookean(real(1.0), real(1.0)), 1.2),
        "Mooney-Rivlin, alpha 0.5, stretch 1.8": (mooney(0.5), 1.8),
        "the paper's modified law, stretch 1.2": (paper_law(0.01), 1.2),
    }
    found = {}
    for name, (law, stretch) in laws.items():
        found[name], result = static_sphere_error(elements, law, stretch)
    return Measured(len(result.element_thickness), found, seconds(result))


def show_dynamic_sphere(elements: int) -> Measured:
    """Closed spheres under a pressure step, undamped: largest stretch and period."""
    found = {}
    for case in SPHERES:
        largest, period, result = sphere_step_errors(elements, *case)
        where = f"alpha {case[0]}, P {case[1]}"
        found |= {f"{where}: largest stretch": largest, f"{where}: period": period}
    return Measured(len(result.element_thickness), found, seconds(result))


@functools.cache
def _step_sphere(elements: int) -> Scene:
    """A quarter of a sphere with windows for the longest of the periods at the highest stiffness."""
    sheet = jaxform.shapes.sphere(radius=1.0, elements=elements, symmetry="quarter")
    return scene_of(sheet, mooney(0.5), jaxform.make_pressure([0.0], [0.05]), end_time=2.4)


def sphere_step_errors(
    elements: int, alpha: float, pressure: float, largest: float, period: float
) -> tuple[float, float, Result]:
    """Relative errors of largest stretch and period of a quarter of a sphere under a pressure step, and a part.

    The motion is symmetric in time about its largest stretch, which a polynomial through seven runs finds.
    """
    changes = {"material.alpha": alpha, "pressure.value": [0.01 * pressure]}
    scene = jaxform.replace(_step_sphere(elements), changes)
    off = period / 2 * np.linspace(-0.1, 0.1, 7)
    ends = [jaxform.replace(scene, {"solver.end_time": period / 2 + late}) for late in off]
    parts = [jaxform.run(end) for end in ends]
    course = np.polyfit(off, [mean_stretch(end, part) for end, part in zip(ends, parts, strict=True)], 4)
    turns = np.roots(np.polyder(course))
    turn = turns[np.argmin(np.abs(turns))].real
    return float(np.polyval(course, turn) / largest - 1), float(2 * turn / period), parts[-1]


def away_from_corner(places: np.ndarray, reference: Mapping[str, np.ndarray]) -> np.ndarray:
    """Mask of the initial radii that lie off the last of the arc at the corner, where the exact wall is thinnest."""
    order = np.argsort(reference["initial_radius"])
    arc = np.interp(places, reference["initial_radius"][order], reference["arc"][order])
    corner = reference["arc"][np.argmin(reference["thickness_ratio"])]
    return np.abs(arc - corner) > CORNER * reference["arc"].max()


def exact_ratio(places: np.ndarray, reference: Mapping[str, np.ndarray]) -> np.ndarray:
    """The exact h/h0 at initial radii [m]."""
    order = np.argsort(reference["initial_radius"])
    return np.interp(places, reference["initial_radius"][order], reference["thickness_ratio"][order])


def wall_error(scene: Scene, result: Result, reference: Mapping[str, np.ndarray]) -> float:
    """Relative rms error of nodal h/h0 over the material, weighted by initial area, the corner left out."""
    places = sections.initial_radius(scene)
    off = nodal_ratio(scene, result) / exact_ratio(places, reference) - 1
    away = away_from_corner(places, reference)
    return rms(off[away], nodal_area(scene)[away])


def variation(scene: Scene, result: Result, reference: Mapping[str, np.ndarray]) -> float:
    """Coefficient of variation of the wall over the formed part, the corner left out."""
    places = sections.initial_radius(scene)[np.asarray(scene.parison.triangles)].mean(1)
    away = away_from_corner(places, reference)
    wall, area = np.asarray(result.element_thickness)[away], formed_areas(result)[away]
    mean = np.average(wall, weights=area)
    return float(np.sqrt(np.average(np.square(wall - mean), weights=area)) / mean)


@functools.cache
def exact_table(name: str) -> dict[str, np.ndarray]:
    """A table of benchmarks/accuracy/exact: columns by name."""
    with (Path(__file__).parent / "exact" / f"{name}.csv").open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    return {key: np.array([float(row[key]) for row in rows]) for key in rows[0]}


def with_ring(sheet: Any, corner: float) -> Any:
    """The disc with its rings moved, in proportion, so that one has the radius of what comes to lie at a corner."""
    radius = np.hypot(*sheet.positions[:, :2].T)
    rings = np.unique(radius.round(9))
    nearest = rings[np.argmin(np.abs(rings - corner))]
    moved = np.interp(radius, [0.0, nearest, 1.0], [0.0, corner, 1.0])
    factor = moved / np.where(radius > 0, radius, 1.0)
    return dataclasses.replace(sheet, positions=sheet.positions * factor[:, None])


def cup_scene(elements: int, law: Any, depth: float, corner: float, pressure: float) -> Scene:
    """A quarter of a disc into a truncated cone of 80 degrees, or without a corner into a cone of 60 degrees."""
    sheet = jaxform.shapes.disc(radius=1.0, elements=elements, symmetry="quarter")
    return sheet_in_cup(with_ring(sheet, corner) if corner else sheet, law, depth, pressure, bool(corner))


def sheet_in_cup(
    sheet: Any,
    law: Any,
    depth: float,
    pressure: float,
    bottom: bool = True,
    refinement: Any = None,
    ramp: float = 60.0,
) -> Scene:
    """A sheet of radius 1 into a cone of a depth, with a wall of 80 degrees where it has a bottom."""
    radius = 1.0 - depth / np.tan(np.radians(80.0))
    profile = [[0.0, depth], [radius, depth], [1.0, 0.0]] if bottom else [[0.0, depth], [1.0, 0.0]]
    mold = molds.revolved(profile=profile, segments=384)
    return scene_of(
        sheet,
        law,
        jaxform.make_pressure([0.0, ramp], [0.0, 0.01 * pressure], "cubic-ramp"),
        jaxform.make_mold(mold.vertices, mold.triangles, mold.dropped),
        refinement=refinement,
        end_time=ramp + 5.0,
        damping=2.0,
    )


def cup_errors(scene: Scene, name: str) -> Measured:
    """The wall of a cup against the exact one at the same pressure, nothing cut: nodes, elements, and the thinnest.

    Args:
        scene: The scene; lengths over the radius of its sheet.
        name: The table of the exact wall.
    """
    result = jaxform.run(scene)
    wall = exact_table(name)
    off, weight = nodal_ratio(scene, result) / exact_ratio(sections.initial_radius(scene), wall) - 1, nodal_area(scene)
    rim = np.asarray(scene.parison.clamped)
    ratio, places, area = element_ratios(scene, result)
    one_sided = np.asarray(one_sided_thickness(result, scene) / result.thickness)
    errors = {
        "nodal thickness": rms(off, weight),
        "nodal thickness, one-sided": rms((off + 1) * one_sided - 1, weight),
        "nodal thickness, rim": rms(off[rim], weight[rim]),
        "element thickness": rms(ratio / exact_ratio(places, wall) - 1, area),
        "thinnest wall": thinnest_recovered(result, scene)["recovered"] / THICKNESS / wall["thickness_ratio"].min() - 1,
    }
    return Measured(len(scene.parison.triangles), errors, seconds(result))


def element_ratios(scene: Scene, result: Result) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """h/h0 of the elements, the initial radius [m] of their centroids, and their initial area [m^2] (n_element,)."""
    triangles = np.asarray(scene.parison.triangles)
    places = np.hypot(*np.asarray(scene.parison.positions)[triangles].mean(1)[:, :2].T)
    initial = np.asarray(scene.parison.thickness)[triangles].mean(1)
    return np.asarray(result.element_thickness) / initial, places, np.asarray(scene.tables.sheet.area)


def show_cup(elements: int) -> Measured:
    """A neo-Hookean disc into a cup of 80 degrees, 0.8 radii deep, at P = 40 c h0/a."""
    return cup_errors(cup_scene(elements, mooney(0.0), 0.8, CUP_CORNER, 40.0), "cup-at-40")


def show_deep_cup(elements: int) -> Measured:
    """The dish's sheet of high-impact polystyrene into its cup of 80 degrees, 1.2 radii deep, at P = 30 A01 h0/a."""
    scene = cup_scene(elements, paper_law(2.2e-6 / 0.143), 1.2, DEEP_CORNER, 30.0)
    return cup_errors(scene, "deep-cup-at-30")


def show_cone(elements: int) -> Measured:
    """A neo-Hookean disc into a cone of 60 degrees, at nine tabled places but for the last two, near the apex."""
    scene = cup_scene(elements, mooney(0.0), float(np.tan(np.radians(60.0))), 0.0, 20.0)
    result = jaxform.run(scene)
    table = exact_table("cone")
    known = table["initial_radius"] > 0.15
    radius, expected = table["initial_radius"][known], table["thickness_ratio"][known]
    angle = np.linspace(0.02, np.pi / 2 - 0.02, 64)
    # On the rim's chords, where the exact radius would be outside the mesh.
    points = np.minimum(radius, 0.9999)[:, None, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    x, y = np.asarray(scene.parison.positions, float)[:, :2].T
    at = Triangulation(x, y, np.asarray(scene.parison.triangles))
    got = LinearTriInterpolator(at, nodal_ratio(scene, result))(points[..., 0], points[..., 1])
    off = np.ma.mean(got, axis=1).filled(np.nan) / expected - 1
    away = np.isfinite(off)
    return Measured(
        len(scene.parison.triangles),
        {"thickness at the tabled places": rms(off[away], np.ones(away.sum()))},
        seconds(result),
    )


@functools.cache
def _exact_rectangle(pressure: float, alpha: float, ratio: float) -> membranes.Rectangle:
    return membranes.rectangle(pressure, alpha, ratio)


def rectangle_errors(elements: int, pressure: float, alpha: float, ratio: float) -> Measured:
    """A clamped rectangle with sides 1 and a ratio, against polynomials of high degree in place of elements.

    Off the rim, where the polynomials have converged to 2e-4 (rms) of the thickness, and to 1e-5 of the height.
    """
    sheet = jaxform.shapes.rectangle(size=[ratio, 1.0], elements=elements, symmetry="quarter")
    ramp = jaxform.make_pressure([0.0, 20.0], [0.0, 0.01 * pressure])
    scene = scene_of(sheet, mooney(alpha), ramp, end_time=30.0, damping=2.0)
    result = jaxform.run(scene)
    exact = _exact_rectangle(pressure, alpha, ratio)
    off = nodal_ratio(scene, result) / exact.thickness(np.asarray(scene.parison.positions)[:, :2]) - 1
    weight, rim = nodal_area(scene), np.asarray(scene.parison.clamped)
    errors = {
        "height": float(np.asarray(result.positions)[:, 2].max()) / exact.height - 1,
        "nodal thickness": rms(off[~rim], weight[~rim]),
    }
    return Measured(len(scene.parison.triangles), errors, seconds(result))


def show_square(elements: int) -> Measured:
    """A clamped neo-Hookean square, against Ritz's method with polynomials: nothing is shared with the elements."""
    return rectangle_errors(elements, 4.0, 0.0, 1.0)


def show_rectangle(elements: int) -> Measured:
    """A clamped rectangle of 2 : 1 with alpha = 0.3, against the same method."""
    return rectangle_errors(elements, 4.0, 0.3, 2.0)


class Case(NamedTuple):
    """A case, at which numbers of elements it is run."""

    show: Callable[[int], Measured]
    sizes: tuple[int, int, int]


CASES: dict[str, Case] = {
    "free disc": Case(show_disc, (150, 600, 2400)),
    "limit point": Case(show_limit, (38, 150, 600)),
    "sphere, slow": Case(show_static_sphere, (62, 250, 1000)),
    "sphere, pressure step": Case(show_dynamic_sphere, (62, 250, 1000)),
    "cone": Case(show_cone, (150, 600, 2400)),
    "cup": Case(show_cup, (150, 600, 2400)),
    "deep cup": Case(show_deep_cup, (150, 600, 2400)),
    "square": Case(show_square, (128, 512, 2048)),
    "rectangle": Case(show_rectangle, (128, 512, 2048)),
}


def show_convergence(case: Case) -> dict[str, Any]:
    """A case at its three numbers of elements: errors, observed order of the last two in the element size, seconds."""
    rows = [case.show(size) for size in case.sizes]
    counts = [row.elements for row in rows]
    return {
        "what": str(case.show.__doc__),
        "elements": counts,
        "seconds": [row.seconds for row in rows],
        "errors": {name: [row.errors[name] for row in rows] for name in rows[0].errors},
        "order": {name: order(counts, [row.errors[name] for row in rows]) for name in rows[0].errors},
    }


def order(counts: list[int], errors: list[float]) -> list[float]:
    """Observed order in the element size between each number of elements and the next."""
    return [
        float(2 * np.log(abs(errors[k] / errors[k + 1])) / np.log(counts[k + 1] / counts[k]))
        for k in range(len(counts) - 1)
    ]


def gradient_sweep(study: optimize.Study, sizes: list[float]) -> np.ndarray:
    """Relative differences (knot, size) of the study's gradient and central differences, off its start."""
    search = solvers.Search(study, None, 1.0)
    free = search.start + 0.3 * np.random.default_rng(1).normal(size=search.start.size)
    slope = search(free).gradient
    table = np.zeros((free.size, len(sizes)))
    for k, direction in enumerate(np.eye(free.size)):
        for j, size in enumerate(sizes):
            up, down = (search(free + sign * size * direction).value for sign in (1, -1))
            table[k, j] = abs((up - down) / (2 * size) / slope[k] - 1)
    return table

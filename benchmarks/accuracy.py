"""Figures of accuracy against exact solutions, of the gradient against central differences, and of the built-in study.

Run it with `make accuracy`; it prints one line per figure. Nothing here decides a test; the tests import what they
check from here.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import jaxform
import optimize
from jaxform import files, sections
from jaxform.result import Result, formed_areas
from jaxform.scene import Scene
from optimize import solvers

# Clamped neo-Hookean and Mooney-Rivlin discs: alpha, pole stretch, P a/(c h0), pole height / a, pole h/h0.
DISCS = [
    (0.0, 1.2, 1.9985037, 0.53097607, 0.69444444),
    (0.0, 1.3, 2.6197363, 0.63795621, 0.59171598),
    (0.0, 1.4, 3.0224388, 0.72452979, 0.51020408),
    (0.0, 1.5, 3.2871637, 0.79878921, 0.44444444),
    (0.5, 1.5, 6.9792674, 0.88525982, 0.44444444),
]
# Sphere under a pressure step: alpha, P r0/(c h0), largest stretch, period in r0 sqrt(rho/c).
SPHERES = [
    (0.0, 1.0, 1.109534, 1.5437),
    (0.0, 2.0, 1.380933, 2.39501),
    (0.5, 2.0, 1.149911, 1.27136),
    (0.5, 5.0, 1.957665, 2.28205),
]
CORNER = 0.02  # of the arc, on both sides of a sharp corner, is left out: it fills at infinite pressure only


def real(value: float) -> jax.Array:
    """A number as a leaf of a scene."""
    return jnp.asarray(value, float)


def mooney(alpha: float) -> jaxform.MooneyRivlin:
    """Mooney-Rivlin law with c = 1 and density 1."""
    return jaxform.MooneyRivlin(real(1.0), real(alpha), real(1.0))


def scene_of(sheet: Any, material: Any, pressure: jaxform.Pressure, **solver: Any) -> Scene:
    """A free sheet of thickness 0.01."""
    return jaxform.build_scene(
        parison=jaxform.make_parison(sheet.positions, sheet.triangles, 0.01, sheet.clamped, sheet.fixed),
        material=material,
        pressure=pressure,
        solver=jaxform.make_solver(**solver),
    )


def disc_errors(
    elements: int, alpha: float, pressure: float, height: float, ratio: float
) -> tuple[float, float, Result]:
    """Relative errors of pole height and pole thickness of a quarter of a free disc, and the part."""
    sheet = jaxform.shapes.disc(radius=1.0, elements=elements, symmetry="quarter")
    ramp = jaxform.make_pressure([0.0, 40.0], [0.0, 0.01 * pressure])
    scene = scene_of(sheet, mooney(alpha), ramp, end_time=60.0, damping=1.0)
    result = jaxform.run(scene)
    pole = int(np.argmin(sections.initial_radius(scene)))
    got = float(result.positions[pole, 2]), float(result.thickness[pole]) / 0.01
    return got[0] / height - 1, got[1] / ratio - 1, result


def mean_stretch(scene: Scene, result: Result) -> float:
    """Square root of formed over initial area."""
    return float(np.sqrt(formed_areas(result).sum() / np.asarray(scene.tables.sheet.area).sum()))


def static_sphere_error(elements: int, a02: float, stretch: float) -> float:
    """Relative error of the stretch of a quarter of a sphere of the modified law (A01 = 1) under slow pressure."""
    i2 = stretch**4 + 2 / stretch**2
    slope = 4 * stretch - 4 / stretch**5 + 2 * a02 * (i2 - 3) * (4 * stretch**3 - 4 / stretch**3)
    law = jaxform.ModifiedMooneyRivlin(real(1.0), real(a02), real(1.0))
    sheet = jaxform.shapes.sphere(radius=1.0, elements=elements, symmetry="quarter")
    ramp = jaxform.make_pressure([0.0, 20.0], [0.0, 0.01 * slope / stretch**2])
    scene = scene_of(sheet, law, ramp, end_time=40.0, damping=2.0)
    return mean_stretch(scene, jaxform.run(scene)) / stretch - 1


def sphere_step_errors(
    elements: int, alpha: float, pressure: float, largest: float, period: float
) -> tuple[float, float]:
    """Relative errors of largest stretch and period of a quarter of a sphere under a pressure step.

    The motion is symmetric in time about its largest stretch, which a polynomial through seven runs finds.
    """
    sheet = jaxform.shapes.sphere(radius=1.0, elements=elements, symmetry="quarter")
    scene = scene_of(sheet, mooney(alpha), jaxform.make_pressure([0.0], [0.01 * pressure]), end_time=1.2 * period)
    off = period / 2 * np.linspace(-0.1, 0.1, 7)
    ends = [jaxform.replace(scene, {"solver.end_time": period / 2 + late}) for late in off]
    course = np.polyfit(off, [mean_stretch(end, jaxform.run(end)) for end in ends], 4)
    turns = np.roots(np.polyder(course))
    turn = turns[np.argmin(np.abs(turns))].real
    return float(np.polyval(course, turn) / largest - 1), float(2 * turn / period)


def away_from_corner(places: np.ndarray, reference: Mapping[str, np.ndarray]) -> np.ndarray:
    """Which initial radii lie off the last of the arc at the corner, where the exact wall is thinnest."""
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
    ratio = np.asarray(result.thickness) / np.asarray(scene.parison.thickness)
    error = ratio / exact_ratio(places, reference) - 1
    triangles, area = np.asarray(scene.parison.triangles), np.asarray(scene.tables.sheet.area)
    weight = sum(np.bincount(triangles[:, k], area, len(places)) for k in range(3))
    away = away_from_corner(places, reference)
    return float(np.sqrt(np.average(np.square(error[away]), weights=np.asarray(weight)[away])))


def variation(scene: Scene, result: Result, reference: Mapping[str, np.ndarray]) -> float:
    """Coefficient of variation of the wall over the formed part, the corner left out."""
    places = sections.initial_radius(scene)[np.asarray(scene.parison.triangles)].mean(1)
    away = away_from_corner(places, reference)
    wall, area = np.asarray(result.element_thickness)[away], formed_areas(result)[away]
    mean = np.average(wall, weights=area)
    return float(np.sqrt(np.average(np.square(wall - mean), weights=area)) / mean)


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


def main() -> None:
    """Prints every figure; about ten minutes on two cores."""
    jax.config.update("jax_enable_x64", True)
    for alpha, stretch, *exact in DISCS:
        height, ratio, result = disc_errors(500, alpha, *exact)
        count = 4 * len(result.element_thickness)
        print(
            f"free disc, {count} elements in the whole, alpha {alpha}, pole stretch {stretch}: "
            f"height {100 * height:+.3f} %, pole thickness {100 * ratio:+.3f} %"
        )
    heights = [abs(disc_errors(n, 0.0, *DISCS[3][2:])[0]) for n in (38, 150, 600)]
    order = np.log(heights[0] / heights[2]) / np.log(4.0)
    print(f"free disc, pole height at 38, 150, 600 elements in the quarter: order {order:.2f}")
    print(f"static sphere, modified law, A02/A01 = 0.01: {100 * static_sphere_error(500, 0.01, 1.2):+.3f} %")
    for case in SPHERES:
        largest, period = sphere_step_errors(1000, *case)
        print(
            f"sphere, pressure step, alpha {case[0]}, P {case[1]}: largest stretch {100 * largest:+.3f} %, "
            f"period {100 * period:+.3f} %"
        )
    _print_dish()
    _print_study()


def _print_dish() -> None:
    for name in ("dish-coarse", "dish"):
        document = files.read_scene(name)
        scene, reference = files.build(document), files.read_reference(document)
        assert reference is not None
        result = jaxform.run(scene)
        error = 100 * wall_error(scene, result, reference)
        print(
            f"{name}, {len(scene.parison.triangles)} elements in the quarter: h/h0 {error:.3f} % rms, "
            f"energy balance {100 * float(result.energy.balance_error):.5f} %"
        )


def _print_study() -> None:
    study = optimize.load_study("dish-uniform-wall")
    reference = files.read_reference(study.document)
    assert reference is not None
    sizes = [1e-3, 1e-4, 1e-5, 1e-6, 1e-7, 1e-8]
    print("gradient of dish-uniform-wall, relative difference to central differences by perturbation")
    print("knot  " + "  ".join(f"{size:7.0e}" for size in sizes) + "     best")
    for k, row in enumerate(gradient_sweep(study, sizes)):
        print(f"{k:4d}  " + "  ".join(f"{value:7.1e}" for value in row) + f"  {row.min():7.1e}")
    began = time.perf_counter()
    design = optimize.solve(study)
    spread = [
        100 * variation(scene, result, reference)
        for scene, result in ((design.first_scene, design.first_result), (design.scene, design.result))
    ]
    print(
        f"dish-uniform-wall: variation of the wall, corner left out, {spread[0]:.2f} % -> {spread[1]:.2f} %, "
        f"{len(design.history)} simulations with gradient, the time of {design.history[-1]['simulations']:.0f} "
        f"simulations, {time.perf_counter() - began:.0f} s with compilation"
    )


if __name__ == "__main__":
    sys.exit(main())

"""Gain of searches by gradient: figures of the built-in studies, and the search beside what people use instead.

Run it with `make design`, or parts of it by name: `python -m benchmarks.design recover mass pressure bottle
race-recover race-least-mass race-pressure`; any other name draws the page alone.
What a part finds goes into docs/design.json; the page and pictures in docs are drawn from that file alone.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import jax
import numpy as np

import jaxform
import optimize
from benchmarks.design import page
from benchmarks.design.controls import ramp, show_heaters, show_melt
from benchmarks.pages import DOCS, Found, read_figures, store_figures
from jaxform.io import catalog
from jaxform.mesh.grids import Profile
from optimize.search import Search
from optimize.wall_statistics import nodal_area

_FILE = DOCS / "design.json"
BOUNDS = (0.3e-4, 1.5e-3)  # m, of the dish's sheet
MINIMUM = 0.6e-4  # m, of the dish's wall
TOUCHING = 0.99  # of the formed area, from which a part counts as formed


# --- Studies ----------------------------------------------------------------------------------------------------------


def hidden_profile(knots: int) -> np.ndarray:
    """A sheet (knots,) [m] that nobody would guess: thick in the middle and near the rim, with a dip between."""
    place = np.linspace(0.0, 1.0, knots)
    return 1e-3 * (0.30 + 0.08 * np.cos(5.0 * place) - 0.06 * place + 0.03 * np.sin(17.0 * place))


def recovery(scene: jaxform.Scene, knots: int = 12, **options: Any) -> optimize.Study:
    """The wall that a known profile makes on the same mesh, sought from the scene's uniform sheet."""
    variable = optimize.ThicknessProfile(scene, along="radius", bounds=BOUNDS, knots=knots)
    return optimize.Study(
        scene, (variable,), optimize.Target(scene, wall_of(scene, variable, hidden_profile(knots))), **options
    )


def wall_of(scene: jaxform.Scene, variable: optimize.ThicknessProfile, values: np.ndarray) -> np.ndarray:
    """The wall (n_node,) [m] that a variable's profile makes with values (n,) [m] at its knots."""
    sheet = Profile(variable.along, tuple(variable.at), tuple(values))(np.asarray(scene.parison.positions, float))
    return np.asarray(jaxform.run(jaxform.replace(scene, {"parison.thickness": sheet})).thickness)


def equal_mass(row: Found) -> float:
    """Mass [g] of a row of a history if its sheet were as much thicker as its minimum asks for; walls are in ratio."""
    return 1e3 * row["mass"] * max(1.0, MINIMUM / row["wall_min"])


def deviation(row: Found) -> float:
    """Deviation from the target [%]."""
    return 100.0 * row["thickness_rms_error"]


_TO_THE_END: Found = {"gradient_tolerance": 1e-9, "tolerance": 0.0, "warm_start": 0}
"""Settings of searches that are to show how near a known sheet they come by themselves."""


# --- Figures of single studies ----------------------------------------------------------------------------------------


def show_recovery(scene: jaxform.Scene | None = None, knots: int = 12, iterations: tuple[int, int] = (20, 4)) -> Found:
    """Prints how fast a known profile is found."""
    scene = scene or jaxform.load("dish-coarse")
    found: Found = {"knots": knots, "elements": len(scene.parison.triangles), "hidden": hidden_profile(knots).tolist()}
    for method, most in zip(("lbfgs", "least-squares"), iterations, strict=True):
        design = optimize.solve(recovery(scene, knots, method=method, iterations=most, **_TO_THE_END))
        rows = [{name: row[name] for name in ("iteration", "thickness_rms_error", "simulations", "gradient_norm")}
                for row in design.history]  # fmt: skip
        found[method] = {"rows": rows, "gradient_error": design.gradient_error}
    return found


def show_mass(name: str = "dish-least-mass") -> Found:
    """Prints the mass that a study saves against a uniform sheet with the same thinnest wall, itself simulated."""
    study = optimize.load_study(name)
    began = time.perf_counter()
    design = optimize.solve(study)
    seconds = time.perf_counter() - began
    least = float(np.asarray(design.result.element_thickness).min())
    uniform = uniform_with(study.scene, least)
    return {
        "minimum": study.objective.uniform,
        "facts": design.summary(),
        "wall_min": least,
        "mass": float(design.result.mass),
        "uniform_mass": float(uniform.mass),
        "uniform_wall_min": float(np.asarray(uniform.element_thickness).min()),
        "saved": 1.0 - float(design.result.mass / uniform.mass),
        "seconds": seconds,
    }


def uniform_with(scene: jaxform.Scene, least: float) -> jaxform.Result:
    """The part of a uniform sheet whose thinnest wall is as given [m], by the secant rule on its thickness."""
    present = np.asarray(scene.parison.thickness)
    factor = 1.0
    for _ in range(6):
        result = jaxform.run(jaxform.replace(scene, {"parison.thickness": factor * present.mean()}))
        wall = float(np.asarray(result.element_thickness).min())
        if abs(wall / least - 1.0) < 1e-4:
            break
        factor *= least / wall
    return result


def show_bottle() -> Found | None:
    """Mass saved on the bottle, and how near a reachable wall is reached; None where the scene is not built in."""
    if "soap-bottle" not in catalog.built_in("scene"):
        return None
    found = show_mass("bottle-parison")
    study = optimize.load_study("bottle-parison")
    bounds = (0.8e-3, 4.0e-3)
    variable = optimize.ThicknessProfile(study.scene, along="y", bounds=bounds, knots=20)
    hidden = 1e-3 * (2.2 + 0.5 * np.cos(np.linspace(0.0, 9.0, 20)))
    wall = wall_of(study.scene, variable, hidden)
    target = optimize.Target(study.scene, wall)
    design = optimize.solve(optimize.Study(study.scene, (variable,), target, method="least-squares", iterations=4))
    area = np.asarray(nodal_area(design.result))
    apart = np.abs(np.asarray(design.result.thickness) / wall - 1.0)
    return found | {"mean_absolute_deviation": float(np.average(apart, weights=area)), "knots": 20}


def formed_part_at(result: jaxform.Result) -> float:
    """Time [s] at which so much of a part's area touches the mold that it counts as formed; infinite for never."""
    touched, area = np.asarray(result.contact_time), np.asarray(nodal_area(result))
    order = np.argsort(np.where(touched < 0, np.inf, touched))
    share = np.cumsum(area[order]) / area.sum()
    last = order[int(np.searchsorted(share, TOUCHING))]
    return float(touched[last]) if touched[last] >= 0 else float("inf")


def show_pressure(times: tuple[float, ...] = (3, 4, 5, 7, 10, 14, 20, 28, 40, 56, 80), iterations: int = 25) -> Found:
    """The designed schedule beside ramps that take longer and longer."""
    study = replace(optimize.load_study("pressure-schedule"), iterations=iterations)
    target: Any = study.objective
    slow = jaxform.load("cup-slow")
    most = float(np.asarray(slow.pressure.value).max())
    unit = float(np.sqrt(study.scene.material.density / 2e5) * 0.1)
    ramps: Found = {}
    for kind in ("linear", "cubic-ramp"):
        # The slow scene has the windows for the longest of them; the damping is that of the fast one.
        base = jaxform.replace(slow, {"solver.damping": np.asarray(study.scene.solver.damping)})
        rows = []
        for units in times:
            results = [jaxform.run(ramp(base, kind, units * unit, part * most)) for part in (0.5, 0.75, 1.0)]
            errors = [float(target.error(base, result)) for result in results]
            best = int(np.argmin(errors))
            rows.append({"units": units, "error": errors[best], "formed": formed_part_at(results[best]) / unit,
                         "kinetic": hit(results[best])})  # fmt: skip
        ramps[kind] = rows
    return {
        "unit": unit,
        "ramps": ramps,
        "designed": _design(study, target, unit),
    }


def _design(study: optimize.Study, target: optimize.Target, unit: float) -> Found:
    began = time.perf_counter()
    design = optimize.solve(study)
    return {
        "units": float(design.scene.solver.end_time) / unit,
        "error": float(target.error(design.scene, design.result)),
        "formed": formed_part_at(design.result) / unit,
        "kinetic": hit(design.result),
        "time": np.asarray(design.scene.pressure.time).tolist(),
        "value": np.asarray(design.scene.pressure.value).tolist(),
        "facts": design.summary(),
        "seconds": time.perf_counter() - began,
    }


def hit(result: jaxform.Result) -> float:
    """Kinetic energy with which the sheet hit the mold, over the work done."""
    return float((result.energy.contact_loss + result.energy.kinetic) / result.energy.external_work)


# --- The search beside others -----------------------------------------------------------------------------------------


@dataclass
class Case:
    """A study that several searches try.

    Attributes:
        title, unit: Name and unit of the figure that is minimized.
        study: With the methods and numbers of iterations of this package's searches.
        merit: The figure of a row of a history.
        own: Method and options by name.
    """

    title: str
    unit: str
    study: optimize.Study
    merit: Callable[[Found], float]
    own: dict[str, Found]


def cases() -> dict[str, Callable[[], Case]]:
    """The studies that are compared."""
    return {"recover": _recover_case, "least-mass": _mass_case, "pressure": _pressure_case}


def _recover_case() -> Case:
    study = recovery(jaxform.load("dish-coarse"), **_TO_THE_END)
    own = {
        "L-BFGS": {"method": "lbfgs", "iterations": 20},
        "least squares": {"method": "least-squares", "iterations": 4},
        "fixed point": {"method": "fixed-point", "iterations": 25},
    }
    return Case("dish, 12 knots: a wall that is known to be reachable", "deviation, rms [%]", study, deviation, own)


def _mass_case() -> Case:
    study = optimize.load_study("dish-least-mass")
    own = {
        "L-BFGS": {},
        "fixed point": {"method": "fixed-point", "iterations": 25, "warm_start": 0},
    }
    return Case("dish-least-mass, 12 knots", "mass at the minimum wall [g]", study, equal_mass, own)


def _pressure_case() -> Case:
    study = optimize.load_study("pressure-schedule")
    own = {"least squares": {}, "L-BFGS": {"method": "lbfgs", "iterations": 25}}
    return Case("pressure-schedule, 14 knots", "deviation, rms [%]", study, deviation, own)


def compare(case: Case, budget: int, others: tuple[str, ...] = ("Nelder-Mead", "CMA-ES", "random search")) -> Found:
    """Curves (simulations, best merit so far) of this package's searches and of others, from the same start."""
    curves = {}
    for name, options in case.own.items():
        design = optimize.solve(replace(case.study, **options))
        curves[name] = best_so_far([(row["simulations"], case.merit(row)) for row in design.history])
    for name in others:
        tried = Tried(case, budget)
        try:
            _OTHERS[name](tried)
        except _SpentError:
            pass
        curves[name] = best_so_far(tried.points)
    count = sum(variable.start.size for variable in case.study.variables)
    return {"title": case.title, "unit": case.unit, "variables": count, "budget": budget, "curves": curves}


def best_so_far(points: list[tuple[float, float]]) -> list[list[float]]:
    """Those points at which there is a new best."""
    kept: list[list[float]] = []
    for cost, merit in points:
        if np.isfinite(merit) and (not kept or merit < kept[-1][1]):
            kept.append([float(cost), float(merit)])
    return kept


class _SpentError(Exception):
    """The budget is spent."""


class Tried:
    """A case as a function of a search's numbers that counts its simulations and ends when they are spent."""

    def __init__(self, case: Case, budget: int) -> None:
        self._search = Search(replace(case.study, method="fixed-point"), None, 1.0)
        self._merit, self._budget = case.merit, budget
        self.points: list[tuple[float, float]] = []
        self.start = self._search.start

    def __call__(self, free: np.ndarray) -> float:
        """The merit; a large number where the simulation fails, since not all of them can do with infinity."""
        if len(self.points) >= self._budget:
            raise _SpentError
        point, _ = self._search.evaluate_forward(np.asarray(free, float))
        merit = self._merit(self._search.history[-1]) if np.isfinite(point.value) else 1e6
        self.points.append((len(self.points) + 1.0, merit))
        return merit


def nelder_mead(tried: Tried) -> None:
    """SciPy's, adapted to the number of variables."""
    from scipy.optimize import minimize

    options = {"maxfev": 10**6, "adaptive": True, "initial_simplex": None, "xatol": 1e-9, "fatol": 1e-12}
    minimize(tried, tried.start, method="Nelder-Mead", options=options)


def cma_es(tried: Tried) -> None:
    """Hansen's, with its own settings; the first step is 0.5, an eighth of the way between the bounds."""
    import cma  # pyright: ignore

    cma.fmin2(tried, tried.start, 0.5, {"verbose": -9, "seed": 1, "tolfun": 1e-12, "tolx": 1e-12})


def random_search(tried: Tried) -> None:
    """Normal about the best so far, half as wide after twenty in vain."""
    generator, best, width, idle = np.random.default_rng(1), tried.start, 1.0, 0
    least = tried(best)
    while True:
        trial = best + width * generator.normal(size=best.size)
        value = tried(trial)
        if value < least:
            best, least, idle = trial, value, 0
        else:
            idle += 1
        if idle == 20:
            width, idle = 0.5 * width, 0


_OTHERS: dict[str, Callable[[Tried], None]] = {
    "Nelder-Mead": nelder_mead,
    "CMA-ES": cma_es,
    "random search": random_search,
}


PARTS: dict[str, Callable[[], Found | None]] = {
    "recover": show_recovery,
    "mass": show_mass,
    "pressure": show_pressure,
    "bottle": show_bottle,
    "melt": show_melt,
    "heaters": show_heaters,
}
BUDGETS = {"recover": 1500, "least-mass": 1500, "pressure": 9000}  # simulations of each of the others


def main(names: list[str]) -> None:
    """Runs parts and races, keeps what they find, and writes the page."""
    jax.config.update("jax_enable_x64", True)
    races = {f"race-{name}": make for name, make in cases().items()}
    for name in names or [*PARTS, *races]:
        if name in PARTS:
            store_figures(_FILE, name, PARTS[name]())
        if name in races:
            case = name.removeprefix("race-")
            store_figures(_FILE, "searches", compare(races[name](), BUDGETS[case]), case=case)
        print(f"{name}: done", flush=True)
    page.write(read_figures(_FILE), DOCS)
    print((DOCS / "design.md").read_text())

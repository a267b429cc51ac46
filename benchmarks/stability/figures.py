"""Robustness: the edge of stability, energy over a million steps, random scenes, gradients, float32.

Run it with `make stability`, or parts of it by name: `python -m benchmarks.stability edge drift random gradients
float32 pinch`; any other name draws the page alone. What a part finds goes into docs/stability.json; docs/stability.md
and its pictures are drawn from that file alone.
"""

from __future__ import annotations

import dataclasses
import functools
import time
import warnings
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

import jaxform
from benchmarks.accuracy.cases import mooney, paper_law, real, scene_of
from benchmarks.pages import DOCS, Found, read_figures, store_figures
from benchmarks.stability import page, pinch, slopes, stress
from benchmarks.stability.random_scenes import FURTHER, NAMES, STRANGERS, VISCOUS, family_of
from jaxform import shapes
from jaxform.materials import Law
from jaxform.mechanics import force
from jaxform.mechanics.corners import Load
from jaxform.mesh.shapes import Sheet
from jaxform.model.scene import Scene
from jaxform.model.tables import LONG_WINDOW, SHORT_WINDOW
from jaxform.results.result import Result
from jaxform.results.tool_contact import wall_statistics
from jaxform.runs import host, simulation
from jaxform.sheet import packing
from jaxform.sheet.discretization import discretize
from jaxform.sheet.state import State, is_finished

_FILE = DOCS / "stability.json"
OUT = Path(__file__).parents[2] / "out" / "stability"
SEEDS = 2800
STEPS = 1_000_000


# --- The edge of stability --------------------------------------------------------------------------------------------


def sheets() -> dict[str, Sheet]:
    """Those on which the step is measured: plain, needle-like, and with a node ring that is much finer."""
    disc = shapes.disc(radius=1.0, elements=60, symmetry="quarter")
    found = {"disc": disc}
    for ratio in (10, 50):
        squeezed = disc.positions * [1.0, 1.0 / ratio, 1.0]
        found[f"disc squeezed 1:{ratio}"] = dataclasses.replace(disc, positions=squeezed)
    radius = np.linalg.norm(disc.positions[:, :2], axis=1, keepdims=True)
    found["disc graded to its middle"] = dataclasses.replace(disc, positions=disc.positions * radius**2)
    found["sphere"] = shapes.sphere(radius=1.0, elements=64, symmetry="quarter")
    return found


def laws() -> dict[str, Law]:
    """By name, with c = 1 and density 1."""
    found: dict[str, Law] = {"neo-Hookean": jaxform.NeoHookean(real(1.0), real(1.0))}
    return found | {f"alpha {alpha:g}": mooney(alpha) for alpha in (0.0, 0.1, 0.3, 0.5)} | {"modified": paper_law(0.01)}


def edge_scene(sheet: Sheet, law: Law, *, sudden: bool, ratio: float, pressure: float, end: float) -> Scene:
    """A free sheet of thickness 0.01 with other elements at random up to `ratio` thinner than their neighbours."""
    thin = np.where(np.random.default_rng(3).random(len(sheet.positions)) < 0.3, 1.0 / ratio, 1.0)
    times = [0.0, 1e-6] if sudden else [0.0, 0.8 * end]
    ramp = jaxform.make_pressure(times, [0.0, 0.01 * pressure])
    return scene_of(sheet, law, ramp, thickness=0.01 * thin, end_time=end, damping=1.0)


def _load_scene(state: State, scene: Scene) -> tuple[Load, packing.Packed, jax.Array]:
    """The whole sheet as it is: what makes its forces, its packed elements, and mobility over mass (3, place)."""
    discrete = discretize(scene)
    whole = packing.pack(None, scene.tables.sheet, scene.tables.assembly)
    load = Load(whole.pack(state.nodes.positions), discrete.thickness[whole.element], scene.pressure.at(state.time),
                scene.material)  # fmt: skip
    return load, whole, whole.pack(discrete.compliance)


@jax.jit
def true_limit(state: State, scene: Scene) -> jax.Array:
    """The longest stable step [s] of the assembled tangent, from all its eigenvalues."""
    load, whole, compliance = _load_scene(state, scene)
    count = state.nodes.positions.shape[1]
    tangent = jax.jacfwd(lambda x: force.force(load._replace(positions=x), whole.elements)[0])(load.positions)
    stiffness = -tangent[:, :count, :, :count].reshape(3 * count, 3 * count)
    root = jnp.sqrt(compliance[:, :count]).ravel()
    matrix = root[:, None] * stiffness * root[None, :]
    return 2.0 / jnp.sqrt(jnp.linalg.eigvalsh(0.5 * (matrix + matrix.T)).max())


def windows(scene: Scene, most: int = 10_000) -> Iterator[tuple[State, State]]:
    """The states before and after each window."""
    state, first, taken = host.begin(scene)
    for _ in range(min(most, scene.tables.window_count)):
        if bool(is_finished(state, scene)):
            return
        after, taken, _ = host.advance(state, scene, first, taken, jnp.int32(1))
        yield state, after
        state = after


def measure_edge(scene: Scene, most: int = 60) -> Found:
    """Step taken over the true limit at each window's begin, over safety; and over the limit at its end."""
    tables = dataclasses.replace(scene.tables, window_count=4096, longest_window=LONG_WINDOW)
    scene = dataclasses.replace(scene, tables=tables)
    begin, end, stretch, vain = [], [], 1.0, 0
    limit = float("nan")
    for before, after in windows(scene, most):
        limit = float(true_limit(before, scene))
        length = float(after.control.last_length)
        rest = float(scene.solver.end_time - before.time)
        if int(after.control.last_count) == 0:
            vain += 1
        elif length < 0.999 * rest / int(after.control.last_count) and int(before.control.retries) == 0:
            begin.append(length / (scene.solver.safety * limit))
            end.append(length / float(true_limit(after, scene)))
        stretch = max(stretch, float(np.asarray(_stretches(after, scene)).max()))
    return {"begin": begin, "end": end, "stretch": stretch, "vain": vain, "status": int(after.status)}


@jax.jit
def _stretches(state: State, scene: Scene) -> jax.Array:
    return simulation.make_result(state, scene, discretize(scene)).stretches


def blow_up(scene: Scene, most: int, factors: tuple[float, ...], steps: int = 4000) -> float:
    """The least of factors of the true limit at which a sheet, once inflated, leaves its shape; NaN where none."""
    *_, (_, state) = windows(scene, most)
    limit = float(true_limit(state, scene))
    load, whole, compliance = _load_scene(state, scene)

    @jax.jit
    def away(length: jax.Array) -> jax.Array:
        def step(_: int, moving: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
            x, v = moving
            v = v + length * compliance * force.force(load._replace(positions=x), whole.elements)[0]
            return x + length * v, v

        shake = 1e-9 * jax.random.normal(jax.random.key(0), load.positions.shape) * (compliance > 0)
        x, _ = jax.lax.fori_loop(0, steps, step, (load.positions + shake, jnp.zeros_like(load.positions)))
        return jnp.max(jnp.abs(x - load.positions))

    for factor in factors:
        if not float(away(jnp.asarray(factor * limit))) < 0.3:
            return factor
    return float("nan")


def show_edge() -> Found:
    """The step taken beside the true limit, over laws, stretches, shapes, thickness and pressure."""
    all_sheets, rows = sheets(), []
    cases = [("disc", law, False, 1.0, 2.5 if law == "neo-Hookean" or law == "alpha 0" else 8.0) for law in laws()]
    cases += [("disc", "alpha 0.5", False, 1.0, 60.0), ("disc", "modified", False, 1.0, 60.0)]
    cases += [("sphere", law, False, 1.0, 1.5) for law in ("neo-Hookean", "alpha 0.1", "alpha 0.5")]
    cases += [("sphere", "alpha 0.5", False, 1.0, 30.0)]
    cases += [(name, "alpha 0.1", False, 1.0, 4.0) for name in all_sheets if name not in ("disc", "sphere")]
    cases += [("disc", "alpha 0.1", False, ratio, 4.0 / ratio) for ratio in (5.0, 20.0)]
    cases += [("disc", "alpha 0.1", True, 1.0, 4.0), ("disc", "alpha 0.5", True, 1.0, 30.0)]
    for name, law, sudden, ratio, pressure in cases:
        scene = edge_scene(all_sheets[name], laws()[law], sudden=sudden, ratio=ratio, pressure=pressure, end=40.0)
        row = {"sheet": name, "law": law, "sudden": sudden, "ratio": ratio, "pressure": pressure}
        rows.append(row | measure_edge(scene))
        _say(f"{name}, {law}, sudden {sudden}, 1:{ratio:g}, {pressure:g}: stretch {rows[-1]['stretch']:.2f}, "
             f"{_span(rows[-1]['begin'])} of safety, end {_span(rows[-1]['end'])}")  # fmt: skip
    factors = (0.9, 0.95, 0.98, 1.0, 1.01, 1.02, 1.05, 1.1)
    observed = []
    for name, law, pressure in (("disc", "alpha 0.1", 4.0), ("disc", "alpha 0.5", 8.0), ("disc", "neo-Hookean", 2.0),
                                ("disc squeezed 1:10", "alpha 0.1", 4.0)):  # fmt: skip
        scene = edge_scene(all_sheets[name], laws()[law], sudden=False, ratio=1.0, pressure=pressure, end=40.0)
        observed.append({"sheet": name, "law": law, "factor": blow_up(scene, 400, factors)})
        _say(str(observed[-1]))
    return {"rows": rows, "observed": observed, "factors": factors, "safety": 0.9}


def _span(values: list[float]) -> str:
    return f"{min(values):.3f} to {max(values):.3f}" if values else "none"


# --- Energy over a million steps --------------------------------------------------------------------------------------


def undamped_cases() -> dict[str, tuple[str, Law, float]]:
    """Sheets that a sudden pressure lets swing, undamped: shape, material model, pressure."""
    laws: dict[str, Law] = {"neo-Hookean": mooney(0.0), "alpha 0.1": mooney(0.1), "Yeoh": yeoh()}
    pressures = {"neo-Hookean": 0.01, "alpha 0.1": 0.02, "Yeoh": 0.04}
    found: dict[str, tuple[str, Law, float]] = {
        f"{shape}, {name}": (shape, law, pressures[name]) for shape in ("disc", "sphere") for name, law in laws.items()
    }
    return found | {"small sphere, linear range": ("small sphere", mooney(0.1), 0.01)}


def yeoh() -> Law:
    """Yeoh's model, stiffening."""
    return jaxform.Yeoh(c1=real(1.0), c2=real(0.02), c3=real(0.002), density=real(1.0))


def ringing(steps: int, shape: str = "small sphere", law: Law | None = None, pressure: float = 0.01) -> Scene:
    """A small sheet that a sudden pressure lets ring, undamped, for so many steps or more."""
    sheets = {
        "disc": functools.partial(shapes.disc, elements=40),
        "sphere": functools.partial(shapes.sphere, elements=40),
        "small sphere": functools.partial(shapes.sphere, elements=16),
    }
    sheet = sheets[shape](radius=1.0, symmetry="quarter")
    loading = jaxform.make_pressure([0.0], [pressure])
    scene = scene_of(sheet, law or mooney(0.1), loading, end_time=10.0)
    _, after = next(windows(scene))
    return scene_of(sheet, law or mooney(0.1), loading, end_time=steps * float(after.control.base_length))


def measure_drift(scene: Scene, steps: int, points: int = 200) -> Found:
    """Error of the energy balance over time, over the largest work; and the largest stretch."""
    state, first, taken = host.begin(scene)
    rows, began, most = [], time.perf_counter(), max(1, steps // SHORT_WINDOW // points)
    stretch = 1.0
    while not bool(is_finished(state, scene)) and int(state.steps) < steps:
        state, taken, _ = host.advance(state, scene, first, taken, jnp.int32(most))
        result = host.result_of(state, scene, first, taken)
        energy = result.energy
        missed = float(energy.strain) + float(energy.kinetic) - float(energy.external_work)
        rows.append([int(state.steps), missed / float(energy.peak_work)])
        stretch = max(stretch, float(jnp.max(result.stretches)))
    return {"elements": len(scene.parison.triangles), "steps": int(state.steps), "rows": rows, "stretch": stretch,
            "status": int(state.status), "seconds": time.perf_counter() - began}  # fmt: skip


def show_drift(steps: int = STEPS) -> Found:
    """Discs and spheres of three material models; the small sphere in both precisions."""
    found = {name: measure_drift(ringing(steps, *case), steps) for name, case in undamped_cases().items()}
    with jax.enable_x64(False), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        found["small sphere, linear range, float32"] = measure_drift(ringing(steps), steps)
    for name, part in found.items():
        _say(f"{name}: {part['steps']} steps, misses {part['rows'][-1][1]:.1e} at the end, status {part['status']}")
    return found


# --- Random scenes ----------------------------------------------------------------------------------------------------


def show_random(count: int = SEEDS) -> Found:
    """Prints how so many random scenes end; the rows themselves are left in out/stability."""
    rows = stress.campaign(count, OUT / "random.jsonl")
    return summary_of(rows)


def summary_of(rows: list[Found]) -> Found:
    """Counts of classes and families, the seeds that did not end well, times."""
    classes = Counter(row["class"] for row in rows)
    ran = [row for row in rows if "seconds" in row and "family" in row]
    seconds = np.array([row["seconds"] for row in ran])
    good = [row for row in ran if row["class"] == "ok"]
    families: Found = {}
    for name in (*NAMES, *STRANGERS, *FURTHER, *VISCOUS):
        families[name] = dict(Counter(row["class"] for row in rows if family_of(row["seed"]) == name))
    slow = max(ran, key=lambda row: row["seconds"])
    tagged = dict(Counter(tag for row in ran for tag in row["tags"]).most_common())
    return {
        "count": len(rows),
        "classes": dict(classes),
        "families": families,
        "tags": tagged,
        "seeds": {name: [row["seed"] for row in rows if row["class"] == name] for name in classes if name != "ok"},
        "refusals": sorted({_words(row["refused"]) for row in rows if "refused" in row}),
        "seconds": {"median": float(np.median(seconds)), "max": float(seconds.max()), "slowest": slow["seed"]},
        "steps": {"median": float(np.median([r["steps"] for r in ran])), "max": max(r["steps"] for r in ran)},
        "balance": _percentiles([row["balance"] for row in good]),
        "elements_beyond": _percentiles([row["elements_beyond"] for row in good]),
        "stretch": _percentiles([row["stretch"] for row in good]),
    }


def _words(refused: str) -> str:
    """A refusal without its numbers."""
    return " ".join(word for word in refused.split() if not any(letter.isdigit() for letter in word))[:100]


def _percentiles(values: list[float]) -> Found:
    return {name: float(np.percentile(values, share)) for name, share in
            (("median", 50), ("95 %", 95), ("99 %", 99), ("max", 100))}  # fmt: skip


# --- float32 ----------------------------------------------------------------------------------------------------------


def show_float32(names: tuple[str, ...] = ("dish", "box-insert", "soap-bottle"), seeds: int = 50) -> Found:
    """Walls and times of both precisions, of built-in scenes and of random ones that end well in float64."""
    built = []
    for name in names:
        double = _run_timed(lambda name=name: jaxform.load(name))
        with jax.enable_x64(False):
            single = _run_timed(lambda name=name: jaxform.load(name))
        built.append({"scene": name} | _apart(double, single))
        _say(str(built[-1]))
    drawn, rows, seed = [], [], 0
    while len(drawn) < seeds:
        if (row := _in_both(seed)) is not None:
            drawn.append(row)
        seed += 1
    rows = [{"seed": row["seed"], "rms": row["rms"], "max": row["max"], "status": row["status"]} for row in drawn]
    return {"built": built, "random": rows}


def _in_both(seed: int) -> Found | None:
    """A seed in both precisions; None where it does not end well in float64, or is refused."""
    double = stress.ended_well(seed, 20_000, 6.0)
    if double is None:
        return None
    with jax.enable_x64(False):
        _, single = stress.run_drawn(stress.draw(seed))
    return {"seed": seed} | _apart((double[1], 1.0), (single, 1.0))


def _run_timed(make: Callable[[], Scene]) -> tuple[Result, float]:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        scene = make()
        results = [jaxform.run(scene) for _ in range(3)]
    return results[0], min(result.seconds.run for result in results if result.seconds)


def _apart(double: tuple[Result, float], single: tuple[Result, float]) -> Found:
    """The walls' difference at the nodes, relative; NaN where the meshes differ."""
    one, two = (np.asarray(result.thickness, float)[np.asarray(result.active)] for result, _ in (double, single))
    same = one.shape == two.shape and np.array_equal(double[0].active, single[0].active)
    apart = two / one - 1.0 if same else np.full(1, np.nan)
    return {
        "rms": float(np.sqrt(np.mean(np.square(apart)))),
        "max": float(np.abs(apart).max()),
        "mean": float(_mean_wall(single[0]) / _mean_wall(double[0]) - 1.0),
        "elements": [int(np.sum(result.used)) for result, _ in (double, single)],
        "seconds": [double[1], single[1]],
        "status": int(single[0].status),
    }


def _mean_wall(result: Result) -> float:
    return wall_statistics(result)["mean"]


def _say(words: str) -> None:
    print(words, flush=True)


PARTS: dict[str, Callable[[], Found]] = {
    "edge": show_edge,
    "drift": show_drift,
    "random": show_random,
    "gradients": slopes.show_gradients,
    "float32": show_float32,
    "pinch": pinch.measure,
}


def main(names: list[str]) -> None:
    """Runs parts, keeps what they find, and writes the page."""
    jax.config.update("jax_enable_x64", True)
    for name in names or PARTS:
        if name in PARTS:
            store_figures(_FILE, name, PARTS[name](), digits=5)
    page.write(read_figures(_FILE), DOCS)

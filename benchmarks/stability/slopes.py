"""Gradients of random scenes against central differences, how they grow along a run, and where they are rough."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import jaxform
from benchmarks.accuracy.cases import real, scene_of
from benchmarks.accuracy.refinement import box
from benchmarks.stability import stress
from benchmarks.stability.random_scenes import NAMES
from jaxform import molds, shapes
from jaxform.model.scene import Scene
from jaxform.sheet.state import Schedule

Found = dict[str, Any]
LEAVES = ("parison.thickness", "pressure.value")
SIZES = (1e-3, 1e-4, 1e-5, 1e-6, 1e-7)
CHOSEN = (
    "free disc",
    "free disc, no damping",
    "cup",
    "whole cup",
    "box",
    "free sphere",
    "sphere in a can",
    "refined cup",
)
LONGEST = 8000  # steps of a scene that is differentiated


def unevenness(result: jaxform.Result, wall: jax.Array) -> jax.Array:
    """Mean-square deviation of the wall from a wall [m], relative to that, weighted by volume."""
    apart = jnp.square(result.element_thickness / wall - 1.0)
    return jnp.sum(result.element_volume * apart) / jnp.sum(result.element_volume)


def _objective(scene: Scene, changes: dict[str, jax.Array], schedule: Schedule | None, wall: jax.Array) -> jax.Array:
    changed = jaxform.replace(scene, changes)
    return unevenness(jaxform.simulate(changed, schedule=schedule), wall)


@jax.jit
def value(scene: Scene, changes: dict[str, jax.Array], schedule: Schedule | None, wall: jax.Array) -> jax.Array:
    return _objective(scene, changes, schedule, wall)


@jax.jit
def slope(scene: Scene, changes: dict[str, jax.Array], schedule: Schedule | None, wall: jax.Array) -> Any:
    return jax.value_and_grad(_objective, argnums=1)(scene, changes, schedule, wall)


def compare(scene: Scene, schedule: Schedule, wall: jax.Array, seed: int) -> Found:
    """The gradient with respect to thickness and pressure along a random direction, and by differences."""
    random = np.random.default_rng(seed)
    present = {"parison.thickness": scene.parison.thickness, "pressure.value": scene.pressure.value}
    base, found = slope(scene, present, schedule, wall)
    row: Found = {"value": float(base), "finite": all(bool(jnp.all(jnp.isfinite(g))) for g in found.values())}
    for name in LEAVES:
        scale = present[name] if name == "parison.thickness" else jnp.max(jnp.abs(present[name]))
        direction = jnp.asarray(random.normal(size=present[name].shape)) * scale
        along = float(jnp.sum(found[name] * direction))
        apart = []
        for size in SIZES:
            ends = [value(scene, present | {name: present[name] + sign * size * direction}, schedule, wall)
                    for sign in (1.0, -1.0)]  # fmt: skip
            difference = float(ends[0] - ends[1]) / (2.0 * size)
            apart.append(abs(difference - along))
        row[name] = {"along": along, "apart": float(np.nanmin(apart)) / max(abs(along), 1e-8 * float(base), 1e-300)}
    return row


def growth(scene: Scene, schedule: Schedule, wall: jax.Array, shares: tuple[float, ...]) -> list[float]:
    """Norm of the gradient with respect to the relative thickness, where the run ends after shares of its time."""
    norms = []
    for share in shares:
        short = jaxform.replace(scene, {"solver.end_time": share * scene.solver.end_time})
        present = {"parison.thickness": scene.parison.thickness, "pressure.value": scene.pressure.value}
        _, found = slope(short, present, schedule, wall)
        norms.append(float(jnp.linalg.norm(found["parison.thickness"] * present["parison.thickness"])))
    return norms


def show_gradients(count: int = 100) -> Found:
    """Prints errors of gradients of random scenes that end well."""
    rows, curves, shares = [], [], (0.1, 0.25, 0.5, 0.75, 1.0)
    # Family by family, so that each is compiled for once and then forgotten.
    each = -(-count // len(CHOSEN))
    for name in CHOSEN:
        jax.clear_caches()
        done, seed = 0, NAMES.index(name)
        while done < each and len(rows) < count:
            seed += len(NAMES)
            found = stress.ended_well(seed, LONGEST, 20.0)
            if found is None:
                continue
            scene, result = found[0].scene, found[1]
            assert result.schedule is not None
            schedule, wall = result.schedule, mean_wall(result)
            row = {"seed": seed, "family": name} | compare(scene, schedule, wall, seed)
            rows.append(row)
            done += 1
            print(f"{name} {seed}: " + ", ".join(f"{row[leaf]['apart']:.1e}" for leaf in LEAVES), flush=True)
            if done <= 3:
                curves.append({"seed": seed, "family": name, "norms": growth(scene, schedule, wall, shares)})
    return {"rows": rows, "growth": {"shares": shares, "curves": curves}, "rough": roughness()}


def mean_wall(result: jaxform.Result) -> jax.Array:
    """The wall [m], weighted by volume."""
    return jnp.sum(result.element_volume * result.element_thickness) / jnp.sum(result.element_volume)


# --- Along a line -----------------------------------------------------------------------------------------------------


def cup(elements: int, limits: dict[str, Any] | None = None) -> Scene:
    """A damped cup, a quarter; refined where there are limits."""
    sheet = shapes.disc(radius=1.0, elements=elements, symmetry="quarter")
    mold = molds.revolved(profile=[[0.0, 0.5], [0.55, 0.5], [1.0, 0.0]], segments=48)
    return scene_of(
        sheet,
        jaxform.NeoHookean(real(1.0), real(1.0)),
        jaxform.make_pressure([0.0, 16.0], [0.0, 0.2], "cubic-ramp"),
        jaxform.make_mold(mold.vertices, mold.triangles),
        refinement=None if limits is None else jaxform.make_refinement(**limits),
        end_time=20.0,
        damping=2.0,
    )


def along_a_line(scene: Scene, *, replayed: bool, points: int = 30, span: float = 0.01) -> Found:
    """Value and slope along a line of sheets, a little thicker in the middle and thinner there; and their spread.

    The spread is that of the slopes about a smooth curve (a parabola), over their mean size.
    """
    result = jaxform.run(scene)
    wall = mean_wall(result)
    schedule = result.schedule if replayed else None
    radius = jnp.linalg.norm(scene.parison.positions[:, :2], axis=1)
    radius = radius / jnp.max(radius)
    direction = scene.parison.thickness * (1.0 - 2.0 * jnp.square(radius))
    line = np.linspace(-span, span, points)
    values, slopes = [], []
    for place in line:
        changes = {"parison.thickness": scene.parison.thickness + place * direction,
                   "pressure.value": scene.pressure.value}  # fmt: skip
        value, found = slope(scene, changes, schedule, wall)
        values.append(float(value))
        slopes.append(float(jnp.sum(found["parison.thickness"] * direction)))
    return {"line": line.tolist(), "values": values, "slopes": slopes} | spread(line, values, slopes)


def spread(line: np.ndarray, values: list[float], slopes: list[float]) -> Found:
    """Deviation of slopes from a smooth curve, and from differences of the values, over their mean size."""
    size = float(np.mean(np.abs(slopes)))
    smooth = np.polyval(np.polyfit(line, slopes, 2), line)
    differences = np.gradient(np.asarray(values), line)
    return {
        "spread": float(np.std(np.asarray(slopes) - smooth)) / size,
        "against_differences": float(np.median(np.abs(differences - slopes)[1:-1])) / size,
    }


def lines() -> dict[str, Callable[[], Found]]:
    """Cups and boxes whose slopes along a line are compared."""
    finer = {"angle": 8.0, "interval": 64, "max_level": 4, "base_level": 4, "elements": 512}

    def uniform(elements: int, replayed: bool) -> Found:
        return along_a_line(cup(elements), replayed=replayed)

    def slopes_at_levels(replayed: bool, at_rest: bool) -> Found:
        return along_a_line(cup(24, finer | {"at_rest": at_rest}), replayed=replayed)

    found = {f"{n} elements": functools.partial(uniform, n, False) for n in (24, 96, 384)}
    found["96 elements, replayed"] = functools.partial(uniform, 96, True)
    found["refined"] = functools.partial(slopes_at_levels, False, True)
    found["refined, replayed"] = functools.partial(slopes_at_levels, True, True)
    found["refined, replayed, new nodes in motion"] = functools.partial(slopes_at_levels, True, False)
    found["box with insert, 494 elements"] = functools.partial(_on_a_box, lambda: box(500))
    found["box with insert, refined"] = functools.partial(_on_a_box, lambda: _fitting("box-insert"))
    return found


def _on_a_box(make: Callable[[], Scene]) -> Found:
    return along_a_line(make(), replayed=True, span=1e-3)


def _fitting(name: str) -> Scene:
    """A built-in scene that is refined, with room for what it needs."""
    scene = jaxform.load(name)
    return jaxform.fitted(scene, int(jaxform.run(scene).used.sum()))


def roughness() -> Found:
    """Slopes along a line for several scenes."""
    found = {}
    for name, look in lines().items():
        found[name] = look()
        print(f"{name}: spread {found[name]['spread']:.1e}, against differences "
              f"{found[name]['against_differences']:.1e}", flush=True)  # fmt: skip
    return found


# --- By the time at which a process begins ----------------------------------------------------------------------------


def by_start(ramp: float, damping: float, smooth: bool, points: int = 6) -> float:
    """Slope of the logarithm of the wall's variance by the start of the pressure [1/s], rms over starts; ideally 0.

    A process that begins later forms the same part; nodes land at other places within a step. The sheet has 96
    elements, the pressure a ramp [s], and nodes land on curved paths or not.
    """
    scene = cup(96)
    scene = dataclasses.replace(scene, solver=dataclasses.replace(scene.solver, smooth_landing=smooth))
    scene = jaxform.replace(scene, {"solver.damping": real(damping)})

    @jax.jit
    def along(start: jax.Array) -> jax.Array:
        def variance(start: jax.Array) -> jax.Array:
            times = {"pressure.time": jnp.stack([start, start + ramp])}
            return jnp.log(jnp.var(jaxform.simulate(jaxform.replace(scene, times)).element_thickness))

        return jax.jvp(variance, (start,), (jnp.ones_like(start),))[1]

    slopes = [float(along(real(0.5 + 0.0071 * place))) for place in range(points)]
    return float(np.sqrt(np.mean(np.square(slopes))))


def show_starts() -> dict[str, list[float]]:
    """Slopes by the start of the pressure, on straight paths and on curved ones, for fast and slow ramps."""
    found = {}
    for ramp, damping in ((1.0, 0.2), (4.0, 2.0), (16.0, 2.0)):
        name = f"ramp {ramp:g} s, damping {damping:g} 1/s"
        found[name] = [by_start(ramp, damping, smooth) for smooth in (False, True)]
        print(f"{name}: {found[name][0]:.2e}, with smooth landing {found[name][1]:.2e}", flush=True)
    return found


# --- Slopes against secants -------------------------------------------------------------------------------------------

QUANTITIES = ("evenness", "thinnest wall")
_NEAR = (0.999, 1.0, 1.001)  # designs at which slopes are taken: they differ by chance


def preform(**solver: Any) -> Scene:
    """A preform blown into a bottle, a quarter: the scene in which slopes depart most from the trend."""
    angle = np.linspace(0.0, 0.5 * np.pi, 9)
    end = np.stack([0.011 * np.cos(angle), 0.055 + 0.011 * np.sin(angle)], 1)
    sheet = shapes.preform(profile=[(0.011, 0.0), *map(tuple, end)], elements=1000, symmetry="quarter")
    outside = [[0.0, 0.106], [0.012, 0.108], [0.024, 0.110], [0.029, 0.105], [0.030, 0.095], [0.030, 0.040],
               [0.026, 0.028], [0.0118, 0.010], [0.0114, 0.0], [0.0108, -0.0006]]  # fmt: skip
    mold = molds.revolved(profile=outside, segments=96)
    return scene_of(
        sheet,
        jaxform.Yeoh(c1=real(0.5e6), c2=real(5e3), c3=real(300.0), density=real(1300.0)),
        jaxform.make_pressure([0.0, 0.15], [0.0, 1.5e6], "cubic-ramp"),
        jaxform.make_mold(mold.vertices, mold.triangles),
        thickness=3e-3,
        end_time=0.18,
        damping=300.0,
        **solver,
    )


def looks(result: jaxform.Result, place: jax.Array) -> jax.Array:
    """Logarithms of the wall's mean-square deviation from its mean, relative to that, and of an element's wall (2,)."""
    area, wall = result.element_volume / result.element_thickness, result.element_thickness
    mean = jnp.sum(area * wall) / jnp.sum(area)
    uneven = jnp.sum(area * jnp.square(wall / mean - 1.0)) / jnp.sum(area)
    return jnp.log(jnp.stack([uneven, wall[place]]))


def directions(scene: Scene) -> tuple[list[str], np.ndarray]:
    """Names of six directions of relative thickness, and these (6, n_node): the scale, three random, two nodes."""
    random, free = np.random.default_rng(7), np.flatnonzero(~np.asarray(scene.parison.clamped))
    rows = [np.ones(scene.parison.thickness.size), *random.normal(size=(3, scene.parison.thickness.size))]
    rows += [np.eye(len(rows[0]))[node] for node in random.choice(free, 2, replace=False)]
    return ["scale", "random", "random", "random", "node", "node"], np.stack(rows)


def against_secants(scene: Scene, smooth: bool) -> tuple[list[Found], np.ndarray]:
    """Slopes at three designs and secants of 1 % of both quantities, direction by direction; and the wall [m].

    `apart` is the rms of slope less secant over the designs, `share` the same over the gradient's norm times the
    direction's. The thinnest wall is that of the element which is thinnest at the design: others become thinnest
    within 1 %, and the slope of a least value jumps there.
    """
    scene = dataclasses.replace(scene, solver=dataclasses.replace(scene.solver, smooth_landing=smooth))

    def run(log: jax.Array) -> jaxform.Result:
        return jaxform.simulate(jaxform.replace(scene, {"parison.thickness": scene.parison.thickness * jnp.exp(log)}))

    both = jax.jit(jax.grad(lambda log, weight, place: weight @ looks(run(log), place)))
    names, rows = directions(scene)
    zero, found = jnp.zeros(rows.shape[1]), []
    wall = run(zero).element_thickness
    place = jnp.argmin(wall)
    slopes = np.asarray([[both(zero + np.log(k), jnp.eye(2)[q], place) for k in _NEAR] for q in range(2)])
    ends = np.asarray([[looks(run(zero + sign * 0.01 * row), place) for row in rows] for sign in (1.0, -1.0)])
    secants = (ends[0] - ends[1]) / 0.02
    for q, quantity in enumerate(QUANTITIES):
        norm = float(np.sqrt(np.mean(np.sum(np.square(slopes[q]), axis=1))))
        for name, row, secant in zip(names, rows, secants[:, q], strict=True):
            along = slopes[q] @ row
            apart = float(np.sqrt(np.mean(np.square(along - secant))))
            share = apart / (norm * np.linalg.norm(row))
            meets = apart <= 0.1 * abs(secant) or share <= 0.01
            found.append({"quantity": quantity, "direction": name, "slopes": along.tolist(), "secant": float(secant),
                          "apart": apart, "share": share, "meets": bool(meets)})  # fmt: skip
    return found, np.asarray(wall)


def show_secants(*names: str) -> dict[str, list[Found]]:
    """Slopes against secants with nodes on straight and on curved paths, of the named scenes or of six."""
    found, made = {}, {"preform": preform, "preform, short steps": functools.partial(preform, safety=0.6)}
    for name in names or (*made, "dish-coarse", "cup-fast", "soap-bottle", "box-uniform"):
        scene = made[name]() if name in made else jaxform.load(name)
        walls = []
        for smooth in (False, True):
            jax.clear_caches()
            rows, wall = against_secants(scene, smooth)
            found[f"{name}, {'curved' if smooth else 'straight'}"] = rows
            walls.append(wall)
            for row in rows:
                values = ", ".join(f"{each:.4f}" for each in row["slopes"])
                print(f"{name} {'curved' if smooth else 'straight'}: {row['quantity']}, {row['direction']}: "
                      f"{values} against {row['secant']:.4f}, {100 * row['share']:.2f} % of the norm, "
                      f"{'meets' if row['meets'] else 'misses'}", flush=True)  # fmt: skip
        change = walls[1] / walls[0] - 1.0
        print(f"{name}: wall changes by {100 * np.sqrt(np.mean(change**2)):.3f} % rms, "
              f"thinnest by {100 * (walls[1].min() / walls[0].min() - 1.0):.3f} %", flush=True)  # fmt: skip
    return found

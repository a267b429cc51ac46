"""Random tubes that mold halves flatten and pinch: whether anything passes the parting plane, film is lost, or energy.

`python -m benchmarks.stability.pinch [COUNT]` runs so many scenes (200, about ten minutes): half a tube, and half a
bottle with a handle whose land closes on the parting plane; or a whole tube between two halves. Tubes differ in radius,
wall, length and place, bottles in width, neck and hole; they are turned in the parting plane, and close at 0.05 to 2
m/s. It prints the depth of the deepest node beyond the plane or a land, the change of the film's volume, the energy
balance, and how the runs ended.
"""

from __future__ import annotations

import sys
import time
import warnings
from collections import Counter

import jax
import numpy as np

import jaxform
from benchmarks.pages import Found
from jaxform import molds, shapes
from jaxform.core.pytree import as_real
from jaxform.results.summary import wrinkle_fraction
from jaxform.tools.parting import add_land


def scene(seed: int) -> jaxform.Scene:
    """A tube, and a mold half that closes on its symmetry plane, or two that close on the whole of it."""
    rng = np.random.default_rng(seed)
    half = seed % 3 != 2
    radius, wall = rng.uniform(0.008, 0.02), 10 ** rng.uniform(-3.3, -2.6)
    neck, body = rng.uniform(0.009, 0.015), rng.uniform(0.03, 0.045)
    hole = [rng.uniform(0.12, 0.22) * body, 0.01 + rng.uniform(0.0, 0.012)]
    bottle = molds.bottle_half(
        height=0.2,
        radius=body,
        neck_radius=min(max(neck, 0.21 * body), 0.49 * body),
        hole=hole,
        hole_center=[rng.uniform(0.25, 0.45) * body, rng.uniform(0.55, 0.65) * 0.2],
        element_size=0.009,
    )
    bottle, _ = add_land(bottle, 0.06)
    gap = radius + rng.uniform(0.001, 0.02)
    closed = gap / 10 ** rng.uniform(-1.3, 0.3)
    upright = molds.placed(bottle, rotate=[90.0, 0.0, 90.0])
    length, surfaces = rng.uniform(0.12, 0.22), list[jaxform.Mold]()
    for side in (1.0, -1.0)[: 1 if half else 2]:
        place = [gap, 0.0, rng.uniform(-0.02, 0.02)]
        shape = molds.placed(upright, rotate=[rng.uniform(-25.0, 25.0), 0.0, 0.0], translate=place)
        vertices = shape.vertices * [side, 1.0, 1.0]
        motion = jaxform.make_motion([-side, 0, 0], [0.0, closed], [0.0, gap])
        surfaces.append(jaxform.make_mold(vertices, shape.triangles, motion=motion, name="" if side > 0 else "other"))
    if half:
        plane = molds.placed(molds.plate(size=[0.6, 0.6]), rotate=[0.0, -90.0, 0.0], translate=[0.0, -0.3, -0.3])
        surfaces.append(jaxform.make_mold(plane.vertices, plane.triangles, name="parting-plane"))
    tube = shapes.tube(radius=radius, length=length, ends="guided", elements=300, symmetry="half" if half else "none")
    law = jaxform.MooneyRivlin(as_real(2e5), as_real(rng.uniform(0.05, 0.5)), as_real(1000.0), tension_field=True)
    scale = 2e5 * wall / radius
    air, blow = rng.uniform(0.0, 0.5) * scale, rng.uniform(0.0, 1.5) * scale
    return jaxform.build_scene(
        parison=jaxform.make_parison(tube.positions, tube.triangles, wall, tube.clamped, tube.fixed, guided=(2,)),
        material=law,
        pressure=jaxform.make_pressure([0.0, 0.5 * closed, closed], [0.0, air, blow]),
        solver=jaxform.make_solver(end_time=1.3 * closed + 0.01, damping=rng.uniform(50.0, 500.0)),
        mold=surfaces[0],
        tools=surfaces[1:],
        fill=False,
    )


def film_volume(made: jaxform.Scene, result: jaxform.Result) -> float:
    """Relative change of the volume of the film, from the area and thickness of its elements."""
    corners = np.asarray(result.positions)[np.asarray(result.triangles)]
    area = 0.5 * np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    slack = np.minimum(wrinkle_fraction(result), 1.0 - 1e-12)
    formed = float((area / (1.0 - slack) * np.asarray(result.element_thickness)).sum())
    start = float(np.asarray(made.tables.sheet.area).sum()) * float(np.asarray(made.parison.thickness)[0])
    return formed / start - 1.0


def beyond(made: jaxform.Scene, result: jaxform.Result) -> float:
    """Distance [m] of a node beyond the parting plane, or beyond the land of the half that closes from its side."""
    assert made.mold is not None
    x = np.asarray(result.positions)[:, 0]
    if made.tools[0].motion is None:
        return float(-x.min())
    held = np.asarray(result.tool)
    return float(max(np.max(-x[held == 0], initial=-1.0), np.max(x[held == 1], initial=-1.0)))


def measure(count: int = 200) -> Found:
    """Ends of so many scenes, and the largest depth [m], change of volume and error of the energy balance."""
    warnings.simplefilter("ignore")
    endings: Counter[str] = Counter()
    deepest, lost, balance, bad, begun = -np.inf, [], [], [], time.perf_counter()
    for seed in range(count):
        made = scene(seed)
        result = jaxform.run(made)
        ending = jaxform.explain(result)
        endings[ending.split(";")[0].split(", but")[0].split(":")[0]] += 1
        deep, change, error = beyond(made, result), film_volume(made, result), float(result.energy.balance_error)
        # Relative to all that air and tools do, since what they do to each other cancels.
        energy = result.energy
        error *= float(energy.peak_work) / max(
            abs(float(energy.external_work)), abs(float(energy.tool_work)), float(energy.peak_work)
        )
        deepest = max(deepest, deep)
        lost.append(abs(change))
        balance.append(error)
        if deep > 1e-9 * 0.2 or abs(change) > 1e-3 or error > 1e-2 or ending != "ok":
            bad.append(seed)
            print(f"{seed}: {ending}; beyond {deep:.2g} m, volume {change:.2g}, balance {error:.2g}", flush=True)
    print(f"{dict(endings)}; deepest node {deepest:.2g} m; volume {max(lost):.2g}; balance {max(balance):.2g}, median "
          f"{np.median(balance):.2g}; {time.perf_counter() - begun:.0f} s")  # fmt: skip
    return {
        "count": count,
        "endings": dict(endings),
        "bad": bad,
        "deepest": deepest,
        "volume": max(lost),
        "balance": {"max": max(balance), "median": float(np.median(balance))},
    }


def main(count: int) -> int:
    """Runs so many scenes; 1 if a node passes, film is lost or the energy balance misses a hundredth."""
    jax.config.update("jax_enable_x64", True)
    return int(bool(measure(count)["bad"]))


if __name__ == "__main__":
    sys.exit(main(int(sys.argv[1]) if len(sys.argv) > 1 else 200))

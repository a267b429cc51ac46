"""Runs on the device that JAX finds, a GPU for one: whole scenes, a gradient, batches of designs, large sheets.

python -m benchmarks.speed.devices [scenes gradient batches large]
JAX_PLATFORMS=cpu python -m benchmarks.speed.devices large        # the same on the processor
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import jaxform
from jaxform import shapes

SCENES = ("dish-coarse", "bowl", "dish-refined", "cup-melt", "soap-bottle")
BATCHES = (1, 16, 256)
SIZES = (2048, 32768, 131072, 524288)


def shortest(work: Callable[[], Any], rounds: int = 2) -> float:
    """The shortest time [s] of some calls, after one that compiles."""
    seconds = []
    for _ in range(rounds + 1):
        began = time.perf_counter()
        jax.block_until_ready(work())
        seconds.append(time.perf_counter() - began)
    return min(seconds[1:])


def scenes() -> None:
    """Prints steps, thinnest wall, energy balance and time of the built-in scenes."""
    for name in SCENES:
        scene = jaxform.load(name)
        result = jaxform.run(scene)
        wall = float(jnp.min(jnp.where(result.used, result.element_thickness, jnp.inf)))
        print(
            f"{name}: {jaxform.explain(result)}, {int(result.steps)} steps, thinnest wall {wall:.6g} m, balance "
            f"{float(result.energy.balance_error):.2g}, {shortest(lambda scene=scene: jaxform.run(scene)):.3f} s"
        )


def gradient() -> None:
    """Prints value, norm and time of the gradient of a wall's unevenness by the sheet's thickness."""
    scene = jaxform.load("dish-coarse")

    def unevenness(thickness: jax.Array) -> jax.Array:
        formed = jaxform.simulate(jaxform.replace(scene, {"parison.thickness": thickness})).thickness
        return jnp.var(formed) / jnp.mean(formed) ** 2

    both, at = jax.jit(jax.value_and_grad(unevenness)), scene.parison.thickness
    value, slope = both(at)
    print(
        f"gradient: {float(value):.15g}, norm {float(jnp.linalg.norm(slope)):.15g}, {shortest(lambda: both(at)):.3f} s"
    )


def batches() -> None:
    """Prints the time of batches of designs of the coarse dish."""
    scene, random = jaxform.load("dish-coarse"), np.random.default_rng(0)
    for count in BATCHES:
        rows = np.asarray(scene.parison.thickness) * (1.0 + 0.1 * random.uniform(-1.0, 1.0, (count, 1)))
        work = lambda rows=rows: jaxform.simulate_batch(scene, {"parison.thickness": rows}).thickness  # noqa: E731
        print(f"{count} designs: {shortest(work):.3f} s")


def large() -> None:
    """Prints the time of a step of free sheets of growing size."""
    for count in SIZES:
        sheet = shapes.disc(radius=1.0, elements=count, symmetry="quarter")
        scene = jaxform.build_scene(
            parison=jaxform.make_parison(sheet.positions, sheet.triangles, 0.01, sheet.clamped, sheet.fixed),
            material=jaxform.NeoHookean(jnp.asarray(1.0), jnp.asarray(1.0)),
            pressure=jaxform.make_pressure([0.0, 40.0], [0.0, 0.015]),
            solver=jaxform.make_solver(end_time=30.0 * np.sqrt(2048 / count), damping=1.0),
        )
        steps, elements = int(jaxform.run(scene).steps), len(sheet.triangles)
        step = shortest(lambda scene=scene: jaxform.run(scene)) / steps
        print(f"{elements} elements: {1e6 * step:.1f} us a step, {1e9 * step / elements:.3g} ns per element and step")


def main(names: list[str]) -> None:
    """Runs the parts that are named, or all."""
    jax.config.update("jax_enable_x64", True)
    print(jax.__version__, jax.devices(), flush=True)
    parts = {"scenes": scenes, "gradient": gradient, "batches": batches, "large": large}
    for name in names or parts:
        parts[name]()


if __name__ == "__main__":
    main(sys.argv[1:])

"""Cost of a second tool, a moving one and friction per step: `python -m benchmarks.speed.tools`.

A quarter of a disc is blown into a cup of 80 degrees. Beside the mold there is a plate behind the sheet, which nothing
touches: at rest, then moving away. Then nodes slide on the mold with friction. There no element is ever dropped, since
every node may slip again; so there is the mold alone without dropping, too. Times are per step, the least of several
runs in turn, in one process, after compiling; the ratios are to the mold alone.
"""

from __future__ import annotations

import dataclasses
import sys

import jax
import numpy as np

import jaxform
from jaxform import molds, shapes
from jaxform.core.pytree import as_real

_ROUNDS = 7


def scenes(elements: int) -> dict[str, jaxform.Scene]:
    """The scenes by name; all steps count, whether anything can still move or not."""
    sheet = shapes.disc(radius=1.0, elements=elements, symmetry="quarter")
    cup = molds.revolved(profile=[[0.0, 0.8], [0.859, 0.8], [1.0, 0.0]], segments=96)
    plate = np.array([[-2.0, -2.0, -0.3], [2.0, -2.0, -0.3], [2.0, 2.0, -0.3], [-2.0, 2.0, -0.3]])
    corners, thin, end = np.array([[0, 1, 2], [0, 2, 3]]), 0.01, 20.0
    away = jaxform.make_motion([0.0, 0.0, -1.0], [0.0, end], [0.0, 0.2])
    tools = {
        "mold alone": [],
        "and a plate at rest": [jaxform.make_mold(plate, corners)],
        "and a plate that moves": [jaxform.make_mold(plate, corners, motion=away)],
        "with friction on the mold": [],
    }
    return {
        name: jaxform.build_scene(
            parison=jaxform.make_parison(sheet.positions, sheet.triangles, thin, sheet.clamped, sheet.fixed),
            material=jaxform.MooneyRivlin(as_real(1.0), as_real(0.1), as_real(1.0)),
            pressure=jaxform.make_pressure([0.0, end], [0.0, 20.0 * thin]),
            solver=jaxform.make_solver(end_time=end, damping=1.0),
            mold=jaxform.make_mold(
                cup.vertices,
                cup.triangles,
                contact=jaxform.make_contact_law("coulomb", 0.2) if "friction" in name else None,
            ),
            tools=made,
            fill=False,
        )
        for name, made in tools.items()
    }


def _keep_all(scene: jaxform.Scene) -> jaxform.Scene:
    """The scene with elements in contact in every step."""
    return dataclasses.replace(scene, solver=dataclasses.replace(scene.solver, skip_stuck=False))


def measure(elements: int) -> dict[str, float]:
    """Times per step [s] of the scenes by name."""
    made = scenes(elements)
    made["mold alone, no element dropped"] = _keep_all(made["mold alone"])
    least = dict.fromkeys(made, np.inf)
    for _ in range(_ROUNDS):
        for name, scene in made.items():
            result = jaxform.run(scene)
            assert result.seconds is not None
            least[name] = min(least[name], result.seconds.run / int(result.steps))
    return least


def main(elements: int) -> int:
    """Measures and prints."""
    jax.config.update("jax_enable_x64", True)
    least = measure(elements)
    for name, seconds in least.items():
        print(f"{name}: {1e6 * seconds:.1f} us per step, {seconds / least['mold alone']:.2f}")
    return 0


if __name__ == "__main__":
    sys.exit(main(int(sys.argv[1]) if len(sys.argv) > 1 else 2400))

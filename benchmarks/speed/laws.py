"""Cost of a step with each law, viscous modes, zones, temperature and cooling, beside a neo-Hookean one.

    python -m benchmarks.speed.laws

A free quarter of a disc, so that nothing but the sheet is worked out; rounds alternate, and the shortest counts.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import jaxform
from jaxform import shapes
from jaxform.materials import Law

ELEMENTS, ROUNDS = 2048, 6


def laws(places: np.ndarray) -> dict[str, tuple[Law, Any]]:
    """Laws as stiff as one another in small strain, with the sheet's temperature, by name."""
    one, radius = jnp.asarray(1.0), np.linalg.norm(places, axis=1)
    modes = jnp.asarray([0.5, 0.5]), jnp.asarray([2.0, 20.0])
    shift = jaxform.ArrheniusStiffness(jnp.asarray(140.0), jnp.asarray(40e3))
    warm = 140.0 + 10.0 * radius
    return {
        "neo-Hookean": (jaxform.NeoHookean(one, one), None),
        "Mooney-Rivlin": (jaxform.MooneyRivlin(one, jnp.asarray(0.1), one), None),
        "Yeoh": (jaxform.Yeoh(one, jnp.asarray(0.01), jnp.asarray(1e-3), one), None),
        "Gent": (jaxform.Gent(jnp.asarray(2.0), jnp.asarray(60.0), one), None),
        "Ogden, 3 terms": (jaxform.Ogden(jnp.asarray([1.5, 0.003, -0.02]), jnp.asarray([1.3, 5.0, -2.0]), one), None),
        "tension field": (jaxform.NeoHookean(one, one, tension_field=True), None),
        "zones": (jaxform.NeoHookean(jnp.asarray(1.0 + 0.5 * radius**2), one), None),
        "temperature": (jaxform.NeoHookean(one, one, shift=shift), warm),
        "Christensen, 2 modes": (jaxform.NeoHookean(one, one, viscous=jaxform.Christensen(*modes)), None),
        "Maxwell, 2 modes": (jaxform.NeoHookean(one, one, viscous=jaxform.Maxwell(*modes)), None),
        "Maxwell, 2 modes, temperature": (
            jaxform.NeoHookean(one, one, viscous=jaxform.Maxwell(*modes), shift=shift),
            warm,
        ),
        "temperature, cooling": (jaxform.NeoHookean(one, one, shift=shift), warm),
    }


def main() -> None:
    """Prints the time of a step, and what it is over that of the first law."""
    jax.config.update("jax_enable_x64", True)
    sheet = shapes.disc(radius=1.0, elements=ELEMENTS, symmetry="quarter")
    cooling = jaxform.Cooling(*(jnp.asarray(number) for number in (1.0, 1e-5, 20.0)))
    scenes = {
        name: jaxform.build_scene(
            parison=jaxform.make_parison(
                sheet.positions, sheet.triangles, 0.01, sheet.clamped, sheet.fixed, temperature=temperature
            ),
            material=law,
            pressure=jaxform.make_pressure([0.0, 40.0], [0.0, 0.015]),
            solver=jaxform.make_solver(end_time=60.0, damping=1.0),
            cooling=cooling if "cooling" in name else None,
        )
        for name, (law, temperature) in laws(sheet.positions).items()
    }
    times = dict.fromkeys(scenes, np.inf)
    for _ in range(ROUNDS):
        for name, scene in scenes.items():
            result = jaxform.run(scene)
            assert int(result.status) == 0 and result.seconds is not None, name
            times[name] = min(times[name], result.seconds.run / int(result.steps))
    for name, seconds in times.items():
        print(f"{name:32} {1e6 * seconds:7.2f} us a step  {seconds / times['neo-Hookean']:5.2f}")


if __name__ == "__main__":
    main()

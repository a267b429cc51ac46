"""Designs of the process' own controls: the pressure's history of a melt, and the zones of a heater."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import jaxform
import optimize

Found = dict[str, Any]
_PRESSURES = (0.5e5, 1.0e5, 2.0e5, 3.0e5)  # at a ramp's end [Pa]


def ramp(scene: jaxform.Scene, kind: str, time: float, value: float) -> jaxform.Scene:
    """The scene with a ramp of a kind to a pressure [Pa] within a time [s], at which it ends."""
    shape = jaxform.make_pressure([0.0, time], [0.0, value], kind)
    return jaxform.replace(replace(scene, pressure=shape), {"solver.end_time": time})


def show_melt(times: tuple[float, ...] = (0.1, 0.2, 0.42, 1.0, 2.1, 4.2)) -> Found:
    """The designed schedule of a melt beside ramps as long and longer, each with the best of some final pressures."""
    study = optimize.load_study("cup-viscoelastic-schedule")
    target: Any = study.objective
    slow = jaxform.load("cup-melt-slow")
    ramps: Found = {}
    for kind in ("linear", "cubic-ramp"):
        rows = []
        for end in times:
            parts = [jaxform.run(ramp(slow, kind, end, pressure)) for pressure in _PRESSURES]
            full = [part for part in parts if float(jaxform.summarize(part, slow)["contact_fraction"]) > 0.99]
            errors = [float(target.error(slow, part)) for part in full]
            rows.append({"end": end, "error": min(errors, default=None)})
        ramps[kind] = rows
    design = optimize.solve(study)
    return {
        "ramps": ramps,
        "time": np.asarray(design.scene.pressure.time).tolist(),
        "by_hand": np.asarray(study.scene.pressure.value).tolist(),
        "by_hand_error": float(target.error(study.scene, jaxform.run(study.scene))),
        "value": np.asarray(design.scene.pressure.value).tolist(),
        "error": float(target.error(design.scene, design.result)),
        "facts": design.summary(),
        "knots_agree": _by_knots(study.scene, slow),
    }


def _by_knots(scene: jaxform.Scene, slow: jaxform.Scene, size: float = 1e-6) -> float:
    """Relative difference of the slopes by single knots to central differences of that share of them, the median."""
    wanted, first = jaxform.run(slow).element_thickness, jaxform.run(scene)

    @jax.jit
    @jax.value_and_grad
    def deviation(pressure: jax.Array) -> jax.Array:
        result = jaxform.simulate(jaxform.replace(scene, {"pressure.value": pressure}), schedule=first.schedule)
        return jnp.sum(result.element_volume * jnp.square(result.element_thickness / wanted - 1.0))

    at, found = np.asarray(scene.pressure.value), []
    slopes = np.asarray(deviation(jnp.asarray(at))[1])
    for knot, change in enumerate(np.diag(size * at)):
        ends = [float(deviation(jnp.asarray(at + sign * change))[0]) for sign in (1, -1)]
        found.append(abs((ends[0] - ends[1]) / (2 * size * at[knot]) / slopes[knot] - 1.0))
    return float(np.median(found))


def show_heaters() -> Found:
    """The dish whose sheet is heated in zones: the wall before and after."""
    return {"facts": optimize.solve(optimize.load_study("dish-heater-zones")).summary()}

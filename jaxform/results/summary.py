"""A part in numbers and words: the contents of summary.json, and what is warned of."""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
import numpy as np

from jaxform.core.pytree import as_real
from jaxform.core.words import place
from jaxform.loads import Pressure
from jaxform.materials.tension_field import taut
from jaxform.model.scene import Scene
from jaxform.results.energy import Energy, unmoved
from jaxform.results.explanation import explain
from jaxform.results.result import Result, Seconds
from jaxform.results.review import thinnest, warnings_of_part
from jaxform.results.sections import symmetry_planes
from jaxform.sheet.state import Status
from jaxform.tools.gaps import NO_GAP, Gap, widest_gap
from jaxform.tools.penetration import Penetration, penetration, resting_directions

SLOW_ENOUGH = 0.01  # what a process that should be slow may differ by, predicted, before it is warned of
_NODES_BEYOND = 1e-6  # of the sheet's size, that a node may be beyond the mold
_BRIDGED, _WIDE = 2.0, 0.025  # sides of an element, and of the mold's size, that a gap which stays open is wide
_ELEMENTS_BEYOND = 0.5  # of the longest side of an element, the same of an element


def formed_areas(result: Result) -> np.ndarray:
    """Final area (n_element,) [m^2] of the elements; 0 where not used."""
    volume, wall = np.asarray(result.element_volume, float), np.asarray(result.element_thickness, float)
    return volume / np.where(wall > 0.0, wall, 1.0)


def wrinkled(result: Result) -> np.ndarray:
    """How much of the sheet lies in folds (n_element,), where it is narrower than the tension in it would leave it.

    One less the area that the elements have over that of their material; of a law with `tension_field`.
    """
    larger, smaller = np.square(np.asarray(result.stretches, float)).T
    relaxed = taut(*map(jnp.asarray, (larger + smaller, larger * smaller, np.square(0.5 * (larger - smaller)))))
    return 1.0 - np.sqrt(larger * smaller / np.asarray(relaxed.determinant, float))


def wall_statistics(result: Result) -> dict[str, float]:
    """Least, mean and largest thickness [m] of the elements and its coefficient of variation, by formed area."""
    used = np.asarray(result.used)
    area, wall = formed_areas(result)[used], np.asarray(result.element_thickness, float)[used]
    mean = float(np.average(wall, weights=area))
    spread = float(np.sqrt(np.average(np.square(wall - mean), weights=area)))
    return {"min": float(wall.min()), "mean": mean, "max": float(wall.max()), "cv": spread / mean}


def summarize(result: Result, scene: Scene) -> dict[str, Any]:
    """The contents of summary.json as plain numbers and words."""
    area = formed_areas(result)
    seconds = result.seconds or Seconds(0.0, 0.0)
    kinds = [name for name in Energy.__dataclass_fields__ if name not in ("peak_work", "rounding")]
    energy = {name: float(getattr(result.energy, name)) for name in kinds}
    beyond, gap = penetrated(result, scene), unfilled(result, scene)
    slow = float(result.energy.quasi_static_error)
    return {
        "scene": scene.name,
        "status": explain(result),
        "elements_initial": len(scene.parison.triangles),
        "elements_final": int(np.asarray(result.used).sum()),
        "nodes_final": int(np.asarray(result.active).sum()),
        "time": float(result.time),
        "steps": int(result.steps),
        "windows": int(result.windows),
        "windows_shortened": int(result.shortened),
        "compile_seconds": seconds.compile,
        "run_seconds": seconds.run,
        "thickness": wall_statistics(result),
        "thinnest": thinnest(result, scene),
        "symmetry_planes": {"xyz"[axis]: level for axis, level in symmetry_planes(scene).items()},
        "contact_fraction": float(area[_touching(result)].sum() / area.sum()),
        **_wrinkles(result, scene, area),
        **_temperatures(result, scene),
        "mass": float(result.mass),
        "added_mass": float(result.added_mass),
        "penetration_max": beyond.elements,
        "penetration_place": beyond.place.tolist(),
        "gap_max": gap.width,
        "gap_place": gap.place.tolist(),
        # Under its older name as well.
        "energy": energy
        | {"balance_error": float(result.energy.balance_error), "quasi_static_error": slow, "haste": slow},
        "warnings": [
            *warnings_of(result, scene),
            *warnings_of_part(result, scene),
            *warnings_of_mold(result, scene, beyond),
            *warnings_of_gap(result, scene, gap),
        ],
    }


def _wrinkles(result: Result, scene: Scene, area: np.ndarray) -> dict[str, float]:
    """The share of the sheet that lies in folds, where its law lets it wrinkle."""
    return {"wrinkled_fraction": float(area @ wrinkled(result) / area.sum())} if scene.material.tension_field else {}


def _temperatures(result: Result, scene: Scene) -> dict[str, dict[str, float]]:
    """Least, mean (by mass) and largest temperature [degC] of a sheet that has one."""
    nodal = scene.parison.temperature if result.temperature is None else result.temperature
    if nodal is None:
        return {}
    used = np.asarray(result.used)
    corners = np.asarray(nodal, float)[np.asarray(result.triangles)[used]]
    mean = float(np.average(corners.mean(1), weights=np.asarray(result.element_volume, float)[used]))
    return {"temperature": {"min": float(corners.min()), "mean": mean, "max": float(corners.max())}}


def warnings_of(result: Result, scene: Scene) -> list[str]:
    """What to mind about a part that was formed as asked for: a sentence each, with the remedy."""
    still = int(result.status) == 0 and (scene.motion is not None or bool(np.any(scene.pushes())))
    return [*(unmoved(result.energy) if still else []), *_hasty(result, scene)]


def _hasty(result: Result, scene: Scene) -> list[str]:
    error = float(result.energy.quasi_static_error)
    if not scene.solver.quasi_static or not error > SLOW_ENOUGH:
        return []
    peak = float(result.energy.kinetic_peak / jnp.abs(result.energy.work))
    drag = error - peak
    what = (
        f"the kinetic energy came to {100 * peak:.2g} % of the work"
        if peak > drag
        else f"damping took {100 * float(result.energy.damping_loss / jnp.abs(result.energy.work)):.2g} % of the work"
    )
    linear = isinstance(scene.pressure, Pressure) and scene.pressure.interpolation == "linear"
    remedy = 'interpolation = "cubic-ramp" or ' if linear else ""
    remedy = f"raise the pressure more slowly ({remedy}later pressure.time and solver.end_time)"
    if scene.motion is not None:
        remedy += ", move the mold more slowly (later mold.motion.time)"
    remedy += ", or raise solver.damping" if peak > 4 * drag else ", or lower solver.damping" if drag > peak else ""
    return [
        f"this is no slow process (solver.quasi_static): {what}, so the wall may be about {100 * error:.2g} % off that "
        f"of one; {remedy}"
    ]


def warnings_of_mold(result: Result, scene: Scene, beyond: Penetration) -> list[str]:
    """A sentence where the part is so far beyond the mold that its shape is not to be trusted."""
    if scene.mold is None:
        return []
    corners = np.asarray(result.positions, float)[np.asarray(result.triangles)[np.asarray(result.used)]]
    side = float(np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max())
    size = float(np.ptp(np.asarray(scene.parison.positions), axis=0).max())
    if beyond.nodes <= _NODES_BEYOND * size and beyond.elements <= _ELEMENTS_BEYOND * side:
        return []
    return [
        f"the sheet is beyond the mold, deepest at {place(beyond.place)} with {beyond.elements:.3g} m: it hangs over "
        "the mold's rim, or its elements are too large for an edge; make the mold as wide as the sheet, or the "
        "elements smaller"
    ]


def penetrated(result: Result, scene: Scene) -> Penetration:
    """How far the formed part is beyond the mold; nowhere, where there is no mold."""
    positions = np.asarray(result.positions, float)
    if scene.mold is None or not np.isfinite(positions).all():
        return Penetration(0.0, 0.0, np.zeros(3))
    triangles = np.asarray(result.triangles)[np.asarray(result.used)]
    start = np.asarray(scene.parison.positions, float)
    resting = resting_directions(start, positions, triangles, scene.strongest_push())
    offset = _offset(result, scene)
    wall, grid = np.asarray(result.wall), scene.tables.grid
    found = penetration(positions - offset, triangles, wall, scene.mold, grid=grid, resting=resting)
    return found._replace(place=found.place + offset)


def unfilled(result: Result, scene: Scene) -> Gap:
    """The widest gap between the formed part and the mold before it; none where there is no mold, or no part."""
    positions, lost = np.asarray(result.positions, float), Status.RUNAWAY | Status.ESCAPED | Status.BURST
    if scene.mold is None or int(result.status) & lost or not np.isfinite(positions).all():
        return NO_GAP
    offset, triangles = _offset(result, scene), np.asarray(result.triangles)[np.asarray(result.used)]
    nodes = np.asarray(result.wall), np.asarray(scene.parison.clamped)
    gap = widest_gap(positions - offset, triangles, *nodes, scene.strongest_push(), scene.mold, scene.tables.grid)
    return gap._replace(place=gap.place + offset)


def warnings_of_gap(result: Result, scene: Scene, gap: Gap) -> list[str]:
    """A sentence where all nodes around a gap stick, so that no pressure would close it."""
    if scene.mold is None or gap.element < 0:
        return []
    nodes = np.asarray(result.triangles)[np.asarray(result.used)][gap.element]
    corners = np.asarray(scene.parison.positions, float)[nodes]
    side = float(np.linalg.norm(corners - np.roll(corners, 1, axis=0), axis=1).max())
    size = float(np.ptp(scene.mold.where_it_turns(), axis=0).max())
    if not np.asarray(result.stuck)[nodes].all() or gap.width <= max(_BRIDGED * side, _WIDE * size):
        return []
    return [
        f"the sheet sticks all around a place of the mold that is {gap.width:.3g} m before it, at {place(gap.place)}: "
        "its elements are too large to follow the mold there; add [refinement], or make parison.element_size smaller"
    ]


def _offset(result: Result, scene: Scene) -> np.ndarray:
    """How far the mold has moved (3,) [m]: its grid is of how it starts, from where a sheet is looked at."""
    return np.zeros(3) if scene.motion is None else np.asarray(scene.motion.offset(as_real(float(result.time))))


def _touching(result: Result) -> np.ndarray:
    """Elements with three stuck nodes (n_element,), at least one of which touches the mold."""
    triangles = np.asarray(result.triangles)
    stuck, touched = np.asarray(result.stuck)[triangles], (np.asarray(result.contact_time) > 0)[triangles]
    return stuck.all(1) & touched.any(1)

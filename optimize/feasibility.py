"""Goals that no design within the bounds can reach, found before a search, and limits that it broke, found after it.

Forming keeps the volume of every element, so the mean wall is the sheet's volume over the formed area. No surface that
spans a flat rim has less area than the flat sheet itself: there the mean wall is at most the largest thickness of the
sheet. A sheet that is not flat, or not held all round, may also shrink, but not to half its area.
"""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np

from jaxform import InputError, Result, Scene
from jaxform.extend import boundary_nodes, format_percent, mask_part, number_at
from optimize.designs import KEPT, Point, Study
from optimize.objectives import LeastMass, Objective, Target, Weighted
from optimize.sheets import ThicknessField, ThicknessProfile
from optimize.termination import Ending
from optimize.variables import Scale

_FLAT = 1e-9  # of the sheet's size
_SHRUNK = 2.0
_AT_BOUND = 0.98  # of the largest thickness that its bounds allow
_MOVED = 0.2  # of the largest number of the scene
_COSTS = ("iterations", "max_simulations", "minutes", "rounds")  # limits of the study on the search itself


def check(study: Study) -> None:
    """Raises InputError for a limit that no sheet within the bounds can satisfy."""
    thickest = _thickest(study)
    for key, part in _parts(study.objective):
        if isinstance(part, LeastMass) and part.minimum * (1.0 - KEPT) > thickest:
            _refuse(study, f"{key}.minimum", part.minimum, "the wall is thinner somewhere")
        if isinstance(part, Target) and part.limit is not None and _deviation(part, thickest) > part.limit:
            words = f"the wall deviates by {format_percent(_deviation(part, thickest), 3)} or more"
            _refuse(study, f"{key}.limit", part.limit, words)


def doubts(study: Study) -> list[str]:
    """A sentence for each variable whose start differs from the scene, and for each target that cannot be reached."""
    thickest = _thickest(study)
    return _moved_numbers(study) + [
        f"{key}.thickness cannot be reached: it is at least {float(np.min(part.nodal)):.3g} m everywhere, but the "
        f"mean wall of a sheet within the bounds is at most {thickest:.3g} m, {_deviation(part, thickest):.0%} less; "
        f"check its unit (m), or {_thicker(study)}"
        for key, part in _parts(study.objective)
        if isinstance(part, Target) and part.limit is None and _deviation(part, thickest) > 0.0
    ]


def _moved_numbers(study: Study) -> list[str]:
    """A sentence for each number of the scene that its variable cannot have, so that the search starts with another."""
    found = []
    for variable in study.variables:
        for path, values in variable.changes(jnp.asarray(variable.start)).items():
            old, new = (np.asarray(each, float) for each in (number_at(study.scene, path), values))
            if np.abs(new - old).max() > _MOVED * np.abs(old).max():
                found.append(
                    f"{path} is {_range(old)} in the scene, but the search starts with {_range(new)}, the nearest that "
                    "the variable's bounds and rate allow; check their units, or widen them"
                )
    return found


def _range(values: np.ndarray) -> str:
    low, high = f"{values.min():.4g}", f"{values.max():.4g}"
    return low if low == high else f"{low} to {high}"


def broken_limits(study: Study, scene: Scene, result: Result, best: Point, ending: Ending) -> str:
    """Description of the limits that a design's part breaks, by how much, and the remedy; empty where it keeps all."""
    result = mask_part(result, scene)
    # Where the mesh is refined, the part may be a little off the one that the search saw.
    allowed = KEPT if best.violation > KEPT else 2.0 * KEPT
    what, lower = [], []
    for key, part in _parts(study.objective):
        if isinstance(part, LeastMass):
            used = np.asarray(result.used)
            wall = float(np.asarray(result.element_thickness, float)[used].min())
            short = 1.0 - wall / part.minimum
            words = (
                f"the thinnest wall is {wall:.4g} m, {format_percent(short)} below {key}.minimum = {part.minimum:g} m"
            )
            name = f"{key}.minimum"
        elif isinstance(part, Target) and part.limit is not None:
            error = float(part.error(scene, result))
            short = error / part.limit - 1.0
            limit = format_percent(part.limit, 3)
            words = f"the wall deviates by {format_percent(error, 3)}, more than {key}.limit = {limit}"
            name = f"{key}.limit"
        else:
            continue
        if not short <= allowed:
            what.append(words)
            lower.append(f"lower {name}" if name.endswith("minimum") else f"raise {name}")
    if not what:
        return ""
    return "; ".join(
        [f"a limit is violated: {', and '.join(what)}", ", or ".join([*_remedies(study, scene, ending), *lower])]
    )


def _remedies(study: Study, scene: Scene, ending: Ending) -> list[str]:
    remedies = []
    if ending.by in _COSTS:
        remedies.append(f"raise solver.{ending.by}, at which the search stopped, and resume with --resume")
    sheet = np.asarray(scene.parison.thickness, float)
    at_bound = float(np.mean(sheet >= _AT_BOUND * _most(study)))
    if at_bound > 0.0:
        remedies.append(
            f"{_thicker(study)} (the sheet has its largest thickness at {format_percent(at_bound)} of its nodes)"
        )
    return remedies


def _refuse(study: Study, key: str, value: float, then: str) -> None:
    problem = (
        f"cannot be satisfied: the thickest sheet within the bounds has {_most(study):.4g} m and becomes no thicker on "
        f"average when it is formed, so {then}"
    )
    change = "lower it" if key.endswith("minimum") else "raise it"
    raise InputError(
        problem, f"{change} (its unit is {'m' if key.endswith('minimum') else '1'}), or {_thicker(study)}", key, value
    )


def _parts(objective: Objective) -> list[tuple[str, Objective]]:
    """The objectives, each with its key in the study."""
    if isinstance(objective, Weighted):
        return [(f"objective[{index}]", part) for index, (_, part) in enumerate(objective.parts)]
    return [("objective", objective)]


def _most(study: Study) -> float:
    """The largest thickness that a sheet within the bounds has anywhere [m]."""
    thickest = float(np.asarray(study.scene.parison.thickness).max())
    for variable in study.variables:
        if isinstance(variable, ThicknessProfile | ThicknessField):
            return float(variable.bounds[1])
        if isinstance(variable, Scale) and variable.of == "parison.thickness":
            return float(variable.bounds[1]) * thickest
    return thickest


def _thicker(study: Study) -> str:
    """Remedy for a sheet that cannot become thick enough."""
    for index, variable in enumerate(study.variables):
        of_sheet = isinstance(variable, Scale) and variable.of == "parison.thickness"
        if of_sheet or isinstance(variable, ThicknessProfile | ThicknessField):
            return f"raise the upper end of variable[{index}].bounds"
    return "let the sheet's thickness vary (a variable thickness-profile)"


def _thickest(study: Study) -> float:
    """Upper bound of the mean wall [m]."""
    return _most(study) * (1.0 if _spans_flat_rim(study.scene) else _SHRUNK)


def _spans_flat_rim(scene: Scene) -> bool:
    """True if the sheet is flat and its edges are held, or lie on planes of symmetry."""
    positions = np.asarray(scene.parison.positions, float)
    centred = positions - positions.mean(0)
    spread = np.linalg.svd(centred.T @ centred, compute_uv=False)
    rim = boundary_nodes(np.asarray(scene.parison.triangles))
    held = np.asarray(scene.parison.clamped) | np.asarray(scene.parison.fixed).any(1)
    return bool(spread[2] <= _FLAT * spread[0] and rim.size and held[rim].all())


def _deviation(part: Target, thickest: float) -> float:
    """Lower bound of the relative deviation (rms) from a target, if the mean wall is at most so thick [m]."""
    return max(1.0 - thickest / float(jnp.min(part.nodal)), 0.0)

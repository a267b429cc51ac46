"""A part in numbers and words: the contents of summary.json, its status and its warnings."""

from __future__ import annotations

import dataclasses
import operator
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer

from jaxform.core.compilation import with_standard_promotion
from jaxform.core.errors import InputError, format_percent, format_place
from jaxform.loads import Pressure, RegionalLoad
from jaxform.materials.tension_field import relax_slack_strain
from jaxform.mesh.topology import components
from jaxform.mesh.volumes import longest_sides
from jaxform.model.replacement import describe_out_of_range
from jaxform.model.scene import Scene
from jaxform.results.filling import FINER, measure_filling, remedy_of_opening, warnings_of_filling
from jaxform.results.part import restrict_to_part, rim_elements, thinnest_element, warnings_of_part
from jaxform.results.recovery import thinnest_recovered
from jaxform.results.result import Energy, Result, Seconds, warnings_of_no_work
from jaxform.results.sections import symmetry_planes
from jaxform.results.tool_contact import (
    contact_elements,
    formed_areas,
    measure_tool_penetration,
    summarize_tools,
    tool_label,
    wall_statistics,
)
from jaxform.sheet.state import Status
from jaxform.tools.mold import Mold
from jaxform.tools.penetration import Penetration

# The status of a run in words.

_WORDS = {
    Status.NON_FINITE: "a position or velocity is not finite; the result is the state before that window",
    Status.UNSTABLE: "unstable: the energy of the sheet does not match the work done on it",
    Status.WINDOWS_EXHAUSTED: "the limit on steps was reached before the end time",
    Status.CONTACT_OVERFLOW: "more pairs of node and triangle, or of side and edge, were found than the capacity holds",
    Status.CONTACT_MISSED: "a node moved so far in one step that it may have missed the mold",
    Status.STOPPED: "stopped by the caller",
    Status.REFINEMENT_OVERFLOW: "refinement asked for more elements or nodes than the capacity holds",
    Status.RUNAWAY: "the sheet expands without limit: it is ten thousand times its initial size",
    Status.ESCAPED: (
        "the sheet left its mold: it is outside their common bounding box by more than the size of that box"
    ),
    Status.BURST: "the sheet passed through itself and burst",
    Status.INPUT: "a parameter of the scene is out of its range, so nothing was simulated",
    Status.UNBALANCED: "the run reached its end, but its energy balance misses more than 1 % of the work",
    Status.UNFILLED: "the mold is not filled",
}
_REMEDIES = {
    Status.NON_FINITE: "lower solver.safety or the pressure",
    Status.UNSTABLE: "lower solver.safety, or raise the pressure more slowly",
    Status.WINDOWS_EXHAUSTED: "raise solver.max_steps or lower the pressure; `jaxform.simulate`, which plans its steps "
    "beforehand, needs a scene that is built with the end time and material that it simulates, `jaxform.run` does not",
    Status.CONTACT_OVERFLOW: "coarsen the mold, or use `jaxform.run`, which enlarges the capacity by itself",
    Status.CONTACT_MISSED: "lower solver.safety or the pressure",
    Status.REFINEMENT_OVERFLOW: "raise refinement.elements, or lower refinement.max_level",
    Status.RUNAWAY: "lower the pressure to what the sheet can carry, or add a mold",
    Status.ESCAPED: "look at sheet and mold with `jaxform check` (units, sides, holes), or lower the pressure",
    Status.BURST: "lower the pressure, widen narrow places of the mold, or set solver.self_contact where it folds",
    Status.INPUT: "keep designed parameters within their range, and free of NaN",
    Status.UNBALANCED: "lower solver.safety, raise solver.damping, or raise the pressure more slowly",
}


def explain(result: Result) -> Any:
    """The status in words: "ok", or what stopped the run, when and where, and what may help.

    For stacked results (of `vmap` or `simulate_batch`) a list with a sentence for each.

    Raises:
        InputError: If it is not a result, or is traced.
    """
    if not isinstance(result, Result):
        raise InputError("is not a result", "give a result of `simulate`, `run` or `simulate_batch`", "result", result)
    if any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves(result)):
        raise InputError(
            "is traced, so its values are not known yet", "call `explain` outside the traced function", "result"
        )
    count = np.shape(result.status)
    if not count:
        return _describe_status(result)
    # Each leaf is brought to the host once; what the host's loop adds is no array.
    leaves = jax.tree.map(np.asarray, dataclasses.replace(result, schedule=None, seconds=None, filling=None))
    return [explain(jax.tree.map(operator.itemgetter(k), leaves)) for k in range(count[0])]


def _describe_status(result: Result) -> str:
    status = int(result.status)
    if status == 0:
        return "ok"
    what = [
        words + (_describe_gap(result) if bit == Status.UNFILLED else "")
        for bit, words in _WORDS.items()
        if status & bit
    ]
    remedy = [words for bit, words in _REMEDIES.items() if status & bit]
    if status & Status.UNFILLED:
        remedy.append(remedy_of_opening(result))
    if status & Status.INPUT:
        return "; ".join([f"{what[0]}: {describe_out_of_range(np.asarray(result.out_of_range))}", *what[1:], *remedy])
    if status == Status.UNFILLED:
        return "; ".join([*what, *remedy])
    speed = np.linalg.norm(np.asarray(result.velocities), axis=1)
    node = int(np.argmax(speed))
    at = ", ".join(f"{value:.4g}" for value in np.asarray(result.positions)[node])
    where = f"at t = {float(result.time):.6g} s, fastest node {node} at ({at}) m with {speed[node]:.3g} m/s"
    return "; ".join([*what, where, *remedy])


def _describe_gap(result: Result) -> str:
    """Description of the gap that is left open: its width, place, and share of the depth; empty if not measured."""
    if result.filling is None:
        return ""
    left, depth = result.filling.left, result.filling.depth
    share = f"{100 * left.width / depth:.0f} % of the opening's depth of {depth:.3g} m"
    return f": {left.width:.3g} m remain at {format_place(left.place)}, {share}"


QUASI_STATIC_LIMIT = 0.01  # predicted quasi-static error above which a slow process is warned of
_NODES_BEYOND = 1e-6  # of the sheet's size: tolerated penetration of a node
_ELEMENTS_BEYOND = 0.5  # of the longest side of an element: tolerated penetration of the element


def wrinkle_fraction(result: Result) -> np.ndarray:
    """Share of the sheet that lies in wrinkles (n_element,), where it is narrower than its tension would leave it.

    One minus the ratio of the elements' area to that of their material; for a material with `tension_field`.
    """
    larger, smaller = np.square(np.asarray(result.stretches, float)).T
    relaxed = relax_slack_strain(
        *map(jnp.asarray, (larger + smaller, larger * smaller, np.square(0.5 * (larger - smaller))))
    )
    return 1.0 - np.sqrt(larger * smaller / np.asarray(relaxed.determinant, float))


PENDING = ("penetration_max", "penetration_place", "gap_max", "gap_place")
"""Keys of a summary that is written before the part is measured against mold and tools: they are null there."""


@with_standard_promotion
def summarize(result: Result, scene: Scene) -> dict[str, Any]:
    """The contents of summary.json as plain numbers and words."""
    result = add_filling(result, scene)
    beyond, filling = measure_penetration(result, scene), result.filling
    assert filling is not None
    measured = {
        "penetration_max": beyond.deepest,
        "penetration_place": beyond.deepest_place.tolist(),
        "gap_max": filling.gap.width,
        "gap_place": filling.gap.place.tolist(),
    }
    facts = _facts(result, scene)
    molds = [] if scene.mold is None else [(scene.mold, beyond)]
    others = enumerate(scene.tools, len(molds))
    each = [*molds, *((tool, measure_tool_penetration(result, scene, number)) for number, tool in others)]
    tools = [
        entry
        | {
            "penetration_max": found.deepest,
            "penetration_place": found.deepest_place.tolist() if found.deepest else None,
        }
        for entry, (_, found) in zip(facts["tools"], each, strict=True)
    ]
    warned = [
        *facts["warnings"],
        *warnings_of_part(result, scene),
        *(sentence for tool, found in each for sentence in _warnings_of_penetration(result, scene, found, tool)),
        *warnings_of_filling(result, scene, filling),
    ]
    return facts | measured | {"tools": tools, "warnings": warned}


@with_standard_promotion
def summarize_at_once(result: Result, scene: Scene) -> dict[str, Any]:
    """The summary without its slow entries: the keys of `PENDING` are null, and a warning says so."""
    unmeasured = (
        "the command was interrupted before the part was compared with the mold: penetration, gaps and folds are not "
        "known; run it again to get them"
    )
    facts = _facts(result, scene)
    return facts | {"warnings": [*facts["warnings"], unmeasured]}


def _facts(result: Result, scene: Scene) -> dict[str, Any]:
    """Entries of the summary that need no measurement against the mold."""
    area = formed_areas(result)
    seconds = result.seconds or Seconds(0.0, 0.0)
    kinds = [name for name in Energy.__dataclass_fields__ if name not in ("peak_work", "rounding", "by_tool")]
    energy = {name: float(getattr(result.energy, name)) for name in kinds}
    part, doubts = restrict_to_part(result, scene)
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
        "thickness": wall_statistics(part),
        "thinnest": thinnest_element(part, scene) | thinnest_recovered(part, scene),
        "symmetry_planes": {"xyz"[axis]: level for axis, level in symmetry_planes(scene).items()},
        "contact_fraction": float(area[contact_elements(result)].sum() / area.sum()),
        "tools": summarize_tools(result, scene),
        **({} if result.held_sides is None else {"held_sides": int(result.held_sides)}),
        **_wrinkles(result, scene, area),
        **_temperatures(result, scene),
        **_pressures(result, scene),
        "mass": float(part.mass),
        **({} if scene.part is None else {"sheet_mass": float(result.mass)}),
        **_flash(result, part, scene),
        "added_mass": float(result.added_mass),
        **dict.fromkeys(PENDING),
        "energy": energy | {"balance_error": float(result.energy.balance_error), "quasi_static_error": slow},
        "warnings": [*doubts, *warnings_of(result, scene)],
    }


def _flash(result: Result, part: Result, scene: Scene) -> dict[str, Any]:
    """Mass [kg] of the sheet that is no part, and of each connected piece of it the mass and the box (2, 3) [m]."""
    if scene.part is None:
        return {}
    outside = np.asarray(result.used) & ~np.asarray(part.used)
    triangles, positions = np.asarray(result.triangles)[outside], np.asarray(result.positions, float)
    volume = np.asarray(result.element_volume, float)
    density = (float(result.mass) - float(part.mass)) / max(volume[outside].sum(), np.finfo(float).tiny)
    pieces, parts = [], components(triangles, len(positions))
    for number in np.unique(parts[triangles[:, 0]]):
        here = parts[triangles[:, 0]] == number
        places = positions[triangles[here]].reshape(-1, 3)
        mass = float(density * volume[outside][here].sum())
        pieces.append({"mass": mass, "box": [places.min(0).tolist(), places.max(0).tolist()]})
    pieces.sort(key=lambda piece: -piece["mass"])
    return {"flash_mass": float(result.mass) - float(part.mass), "flash": pieces}


def _wrinkles(result: Result, scene: Scene, area: np.ndarray) -> dict[str, float]:
    """The share of the sheet that lies in wrinkles, where its material model allows them."""
    return (
        {"wrinkled_fraction": float(area @ wrinkle_fraction(result) / area.sum())}
        if scene.material.tension_field
        else {}
    )


def _pressures(result: Result, scene: Scene) -> dict[str, Any]:
    """The pressure over time, where it follows the enclosed volume; of gases of regions that of each, by name."""
    if result.pressures is None:
        return {}
    time, *values = result.pressures
    curves = [{"time": time.tolist(), "value": value.tolist()} for value in values]
    if not isinstance(scene.pressure, RegionalLoad):
        return {"pressure": curves[0]}
    found = {name: {"pressure": curve} for name, curve in zip(scene.pressure.names, curves, strict=True)}
    outside = found.pop("inside", None)
    return {**({} if outside is None else outside), "gases": found}


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
    """Warnings about a part that was formed as asked for: a sentence each, with the remedy."""
    still = int(result.status) & ~Status.UNFILLED == 0 and (scene.motion is not None or bool(np.any(scene.pushes())))
    return [*(warnings_of_no_work(result.energy) if still else []), *_warnings_of_inertia(result, scene)]


def _warnings_of_inertia(result: Result, scene: Scene) -> list[str]:
    error = float(result.energy.quasi_static_error)
    if not scene.solver.quasi_static or not error > QUASI_STATIC_LIMIT:
        return []
    peak = float(result.energy.kinetic_peak / jnp.abs(result.energy.work))
    drag, lost = error - peak, float(result.energy.damping_loss / jnp.abs(result.energy.work))
    reached, took = f"the kinetic energy reached {format_percent(peak)}", f"damping took {format_percent(lost)}"
    what = f"{reached if peak > drag else took} of the work"
    linear = isinstance(scene.pressure, Pressure) and scene.pressure.interpolation == "linear"
    remedy = 'interpolation = "cubic-ramp" or ' if linear else ""
    remedy = f"raise the pressure more slowly ({remedy}later pressure.time and solver.end_time)"
    if scene.motion is not None:
        remedy += ", move the mold more slowly (later mold.motion.time)"
    remedy += ", or raise solver.damping" if peak > 4 * drag else ", or lower solver.damping" if drag > peak else ""
    return [
        f"this process is not quasi-static (solver.quasi_static): {what}, so the wall may differ by about "
        f"{format_percent(error)} from that of a slow process; {remedy}"
    ]


def warnings_of_mold(result: Result, scene: Scene, beyond: Penetration) -> list[str]:
    """A sentence where the part penetrates the mold so far that its shape is unreliable."""
    return [] if scene.mold is None else _warnings_of_depth(result, scene, beyond, "the mold")


def _warnings_of_penetration(result: Result, scene: Scene, beyond: Penetration, tool: Mold) -> list[str]:
    """Sentences about the penetration of the mold, or of another tool, by the part."""
    name = "the mold" if tool is scene.mold else f"tool {tool_label(tool)}"
    return [
        *_warnings_of_depth(result, scene, beyond, name),
        *_warnings_of_ribs(beyond, scene, name),
        *_warnings_of_unmeasured(beyond, name),
    ]


def _warnings_of_depth(result: Result, scene: Scene, beyond: Penetration, name: str) -> list[str]:
    """A sentence where the part penetrates a tool so far that its shape, or its wall there, is unreliable."""
    corners = np.asarray(result.positions, float)[np.asarray(result.triangles)[np.asarray(result.used)]]
    side = float(longest_sides(corners).max())
    size = float(np.ptp(np.asarray(scene.parison.positions), axis=0).max())
    if beyond.nodes <= _NODES_BEYOND * size and beyond.elements <= _ELEMENTS_BEYOND * side:
        walls = np.asarray(result.element_thickness, float)[np.asarray(result.used)]
        found = _warnings_of_cut_edges(beyond, scene, corners, walls, name)
        rim = np.asarray(rim_elements(result, scene)) if found and name == "the mold" else np.zeros(1, bool)
        if not rim.any():
            return found
        # Where sheet is cut off along an edge, as flash at a cavity's rim, elements span it; the others are judged.
        inner = dataclasses.replace(result, used=np.asarray(result.used) & ~rim)
        corners, walls = corners[~rim[np.asarray(result.used)]], walls[~rim[np.asarray(result.used)]]
        return _warnings_of_cut_edges(measure_penetration(inner, scene), scene, corners, walls, name)
    return [
        f"the sheet penetrates {name}, by up to {beyond.elements:.3g} m at {format_place(beyond.place)}: it hangs "
        f"over its rim, or its elements are too large for an edge; {_remedy_of_depth(name)}"
    ]


def _remedy_of_depth(name: str) -> str:
    """The remedy where a sheet penetrates the tool of this name: a mold is as wide as it, another tool need not be."""
    if name == "the mold":
        return "make the mold as wide as the sheet, or the elements smaller"
    return f"{FINER}, add [refinement], or round the edge of {name}"


def _warnings_of_ribs(beyond: Penetration, scene: Scene, name: str) -> list[str]:
    """A sentence where the sheet passed through ribs or pins of a tool between its nodes."""
    ribs = beyond.ribs
    if not ribs.count:
        return []
    where = "in 1 place" if ribs.count == 1 else f"in about {ribs.count} places"
    return [
        f"the sheet passed through a rib or pin of {name} {where}; at {format_place(ribs.place)} it stands "
        f"{ribs.height:.3g} m above the sheet and is {ribs.width:.2g} m wide: contact is detected at nodes, and no "
        f"node met it; the wall is computed without it; {_remedy_at_edges(scene)}"
    ]


def _remedy_at_edges(scene: Scene) -> str:
    """Remedies for edges of tools that pass between nodes: the options that the scene can use and does not."""
    if scene.refinement is not None:
        return f"{FINER}, or refinement.max_level larger"
    finer = f"{FINER}, run `jaxform adapt`, or"
    if scene.solver.edge_contact:
        return f"{finer} replace solver.edge_contact by [refinement]"
    if scene.solver.smooth_landing:
        return FINER
    return f"set solver.edge_contact = true, {finer} add [refinement]"


def _warnings_of_unmeasured(beyond: Penetration, name: str) -> list[str]:
    """A sentence where elements are so large that they are not compared with a tool."""
    if not beyond.unmeasured:
        return []
    return [
        f"{beyond.unmeasured} elements became so large that they were not compared with {name}: penetration_max is "
        "that of the others; the sheet burst, or its elements are too few for it"
    ]


def _warnings_of_cut_edges(
    beyond: Penetration, scene: Scene, corners: np.ndarray, walls: np.ndarray, name: str
) -> list[str]:
    """A sentence where an element cuts a tool deeper than its wall is thick.

    Args:
        beyond: Penetration of the part into the tool, and its place.
        scene: The scene.
        corners: Corners of the elements (n_element, 3, 3) [m].
        walls: Their thickness (n_element,) [m].
        name: Name of the tool in the sentence.
    """
    nearest = int(np.argmin(np.linalg.norm(corners.mean(1) - beyond.place, axis=1)))
    if not beyond.elements > walls[nearest]:
        return []
    return [
        f"an element cuts an edge of {name}, {beyond.elements:.3g} m deep at {format_place(beyond.place)}, deeper "
        f"than its wall of {walls[nearest]:.3g} m: its nodes lie on both sides of the edge; {_remedy_at_edges(scene)}"
    ]


def measure_penetration(result: Result, scene: Scene) -> Penetration:
    """Penetration of the formed part into the mold; zero where there is no mold."""
    if scene.mold is None:
        return Penetration(0.0, 0.0, np.zeros(3))
    return measure_tool_penetration(result, scene, 0)


def add_filling(result: Result, scene: Scene) -> Result:
    """The result of a run with its filling of the mold, and `UNFILLED` in its status where it does not; on the host.

    A result that has it is returned unchanged. The status of a run that stopped says more; of a mold that need not be
    filled
    (`Scene.fill`) none is set.
    """
    if result.filling is not None:
        return result
    filling = measure_filling(result, scene)
    short = scene.fill and filling.is_unfilled and not int(result.status) & ~Status.UNBALANCED
    status = result.status | Status.UNFILLED if short else result.status
    return dataclasses.replace(result, filling=filling, status=status)

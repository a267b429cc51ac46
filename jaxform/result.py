"""What a simulation gives: the formed part, its wall thickness, energies, and the summary in numbers and words."""

from __future__ import annotations

import dataclasses
import operator
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer

from jaxform import membrane
from jaxform.body import Body, Mesh, levels, present_body
from jaxform.energy import Energy, unmoved
from jaxform.errors import InputError
from jaxform.loads import Pressure
from jaxform.nodes import Rule
from jaxform.penetration import Penetration, penetration, resting_directions
from jaxform.pytree import pytree
from jaxform.recovery import nodal_ratio
from jaxform.replacing import in_words
from jaxform.review import thinnest, warnings_of_part
from jaxform.scene import Scene
from jaxform.state import (
    Schedule,
    State,
    Status,
    Taken,
    enclosed_volume,
    kinetic_energy,
    last_work,
    strain_energy,
)
from jaxform.stepping import energy_rounding

SLOW_ENOUGH = 0.01  # what a process that should be slow may differ by, predicted, before it is warned of
_NODES_BEYOND = 1e-6  # of the sheet's size, that a node may be beyond the mold
_ELEMENTS_BEYOND = 0.5  # of the longest side of an element, the same of an element


@pytree
class Seconds:
    """Wall-clock time of `run` [s]: compiling, and the loop alone."""

    compile: float
    run: float


@pytree
class Result:
    """The formed part.

    Attributes:
        positions: Final node positions (n_node, 3) [m].
        thickness: Final thickness at the nodes (n_node,) [m]: the linear function that fits h/h0 of the adjacent
            elements best, at rims carried on from inside, times the node's initial thickness; 0 where the
            node does not exist. See `jaxform.recovery`.
        active: Nodes that exist at the end (n_node,).
        stuck: Nodes that do not move any more (n_node,).
        contact_time: When a node stuck (n_node,) [s]; -1 where free, 0 where clamped.
        wall: What a node sticks to (n_node,): one more than the number of the mold's triangle, negative where the node
            came from the far side of its normal; 0 where it does not touch the mold.
        fields: The scene's own nodal fields, by name (n_node,); 0 where the node does not exist.
        triangles: Node numbers of the elements (n_element, 3).
        level: How often each was bisected from the scene's mesh (n_element,).
        used: Elements that exist at the end (n_element,); the others have room only.
        element_volume: Their volume (n_element,) [m^3], which they keep; 0 where not used.
        element_thickness: Final thickness of the elements (n_element,) [m].
        stretches: Larger and smaller principal stretch of the elements (n_element, 2).
        velocities: Final node velocities (n_node, 3) [m/s].
        mass: Of the modelled part [kg].
        added_mass: What fine elements were given to keep the step long, relative to it.
        energy: The energy account.
        time: Simulated time [s].
        steps, windows, shortened: Steps and windows taken, and windows cut short by contact.
        status: Bits of `Status`; 0 when all went well.
        schedule: The decisions taken, for `simulate` to take them again.
        seconds: Wall-clock time where the host loop took it, else None.
        out_of_range: Which numbers of the scene were out of range, as bits, in the order of `replacing.DESIGNABLE`; 0
            where none was. None from the host's loop, which refuses them.
    """

    positions: jax.Array
    thickness: jax.Array
    active: jax.Array
    stuck: jax.Array
    contact_time: jax.Array
    wall: jax.Array
    fields: dict[str, jax.Array]
    triangles: jax.Array
    level: jax.Array
    used: jax.Array
    element_volume: jax.Array
    element_thickness: jax.Array
    stretches: jax.Array
    velocities: jax.Array
    mass: jax.Array
    added_mass: jax.Array
    energy: Energy
    time: jax.Array
    steps: jax.Array
    windows: jax.Array
    shortened: jax.Array
    status: jax.Array
    schedule: Schedule | None = None
    seconds: Seconds | None = None
    out_of_range: jax.Array | None = None


def make_result(state: State, scene: Scene, first: Body, taken: Taken | None = None) -> Result:
    """The result of a state; pure, so it can be traced.

    Args:
        state: The state.
        scene: The scene.
        first: The sheet as it was at first.
        taken: The windows that were taken, as the first parts of a `Schedule`.
    """
    now, forest, mesh = present_body(scene, state.mesh, first), scene.tables.forest, state.mesh
    sheet = now.sheet
    _, edge1, edge2 = membrane.edges(state.nodes.positions, sheet.triangles)
    strain = membrane.invariants(membrane.metric(edge1, edge2), sheet.inverse_metric)
    ratio = 1.0 / jnp.sqrt(strain.determinant)
    count = now.mass.size
    counts = scene.tables.counts
    active, node, mobility = jnp.ones(count, bool), jnp.arange(count), scene.tables.mobility
    if counts is not None:
        active = node < counts.nodes
    reference = scene.parison.positions.T
    triangles, level, used = sheet.triangles, jnp.zeros(sheet.area.size, jnp.int32), sheet.area > 0.0
    if mesh is not None and forest is not None:
        place = jnp.arange(forest.owner.size)
        first_nodes = forest.first_nodes if counts is None else counts.nodes
        active, node = (place < first_nodes) | (mesh.place > 0), mesh.place
        triangles, level = forest.sheet.triangles[:, mesh.element], levels(mesh.element, forest)
        reference, mobility = reference[:, mesh.node], forest.mobility[:, mesh.node]
    ratios = nodal_ratio(ratio, sheet, reference, mobility > 0.0)

    def nodal(values: jax.Array, otherwise: jax.Array | float) -> jax.Array:
        """In the order of the scene's nodes; what does not exist has another value."""
        return values if mesh is None else jnp.where(active, values[..., node], otherwise)

    def ordered(values: jax.Array, rule: Rule) -> jax.Array:
        return nodal(values, scene.parison.positions.T if rule.absent is None else rule.absent)

    nodes = dataclasses.replace(state.nodes, mode=None).mapped(ordered)

    return Result(
        positions=nodes.positions.T,
        thickness=nodal(ratios, 0.0) * scene.parison.thickness,
        active=active,
        stuck=nodes.stuck,
        contact_time=nodes.contact_time,
        wall=nodes.wall,
        fields=nodes.fields,
        triangles=triangles.T,
        level=level,
        used=used,
        element_volume=sheet.area * now.thickness,
        element_thickness=jnp.where(used, now.thickness * ratio, 0.0),
        stretches=jnp.stack(membrane.principal_stretches(strain), axis=1),
        velocities=nodes.velocities.T,
        mass=jnp.sum(scene.material.density * sheet.area * now.thickness),
        added_mass=_added_mass(scene, now, mesh),
        energy=Energy(
            strain=strain_energy(state, scene, now),
            kinetic=kinetic_energy(state, now.mass) - state.account.kinetic_excess,
            external_work=state.account.external_work
            + last_work(state, scene, enclosed_volume(state.nodes.positions, sheet)),
            **state.account.losses(),
            kinetic_peak=state.account.kinetic_peak,
            peak_work=jax.lax.stop_gradient(state.account.peak_work),
            rounding=energy_rounding(scene, jnp.sum(first.sheet.area * first.thickness)),
        ),
        time=state.time,
        steps=state.steps,
        windows=state.windows,
        shortened=state.shortened,
        status=state.status,
        schedule=None if taken is None else Schedule(*taken, None if mesh is None else mesh.split_at),
    )


def _added_mass(scene: Scene, now: Body, mesh: Mesh | None) -> jax.Array:
    forest, volume = scene.tables.forest, now.sheet.area * now.thickness
    if forest is None or mesh is None:
        return jnp.zeros((), volume.dtype)
    return jnp.sum(volume * (forest.heavier[mesh.element] - 1.0)) / jnp.sum(volume)


_WORDS = {
    Status.NON_FINITE: "a position or velocity is not finite; the state before that window is kept",
    Status.UNSTABLE: "unstable: the sheet holds more energy than was put in, or less",
    Status.WINDOWS_EXHAUSTED: "the steps that the run may take did not suffice to reach the end time",
    Status.CONTACT_OVERFLOW: "more pairs of node and mold triangle came near each other than there is room for",
    Status.CONTACT_MISSED: "a node moved so far in one step that it may have missed the mold",
    Status.STOPPED: "stopped by the caller",
    Status.REFINEMENT_OVERFLOW: "refinement asked for more elements or nodes than there is room for",
    Status.RUNAWAY: "the sheet ran away: it is ten thousand times as large as it was",
    Status.INPUT: "a number of the scene is out of its range, so nothing was simulated",
    Status.UNBALANCED: "the run reached its end, but its account of energy misses more than 1 % of the work",
}
_MENDS = {
    Status.NON_FINITE: "lower solver.safety or the pressure",
    Status.UNSTABLE: "lower solver.safety, or raise the pressure more slowly",
    Status.WINDOWS_EXHAUSTED: "raise solver.max_steps or lower the pressure; `jaxform.simulate`, which plans its steps "
    "beforehand, needs a scene that is built with the end time and material that it simulates, `jaxform.run` does not",
    Status.CONTACT_OVERFLOW: "coarsen the mold, or use `jaxform.run`, which makes room by itself",
    Status.CONTACT_MISSED: "lower solver.safety or the pressure",
    Status.REFINEMENT_OVERFLOW: "raise refinement.elements, or lower refinement.max_level",
    Status.RUNAWAY: "lower the pressure below what the sheet bears, or put it in a mold",
    Status.INPUT: "keep what is designed within its range, and free of NaN",
    Status.UNBALANCED: "lower solver.safety, raise solver.damping, or raise the pressure more slowly",
}


def explain(result: Result) -> Any:
    """The status in words: "ok", or what stopped the run, when and where, and what may help.

    Of results side by side (from `vmap` or `simulate_batch`) a list with a sentence for each.

    Raises:
        InputError: If it is no result, or one that is traced.
    """
    if not isinstance(result, Result):
        raise InputError("is no result", "give what `simulate`, `run` or `simulate_batch` returns", "result", result)
    if any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves(result)):
        raise InputError("is traced, its numbers are not known yet", "explain it outside of the function", "result")
    count = np.shape(result.status)
    if not count:
        return _explained(result)
    # Each leaf is brought to the host once; what the host's loop adds is no array.
    leaves = jax.tree.map(np.asarray, dataclasses.replace(result, schedule=None, seconds=None))
    return [explain(jax.tree.map(operator.itemgetter(k), leaves)) for k in range(count[0])]


def _explained(result: Result) -> str:
    status = int(result.status)
    if status == 0:
        return "ok"
    what = [words for bit, words in _WORDS.items() if status & bit]
    mend = [words for bit, words in _MENDS.items() if status & bit]
    if status & Status.INPUT:
        return "; ".join([f"{what[0]}: {in_words(int(result.out_of_range or 0))}", *what[1:], *mend])
    speed = np.linalg.norm(np.asarray(result.velocities), axis=1)
    node = int(np.argmax(speed))
    place = ", ".join(f"{value:.4g}" for value in np.asarray(result.positions)[node])
    where = f"at t = {float(result.time):.6g} s, fastest node {node} at ({place}) m with {speed[node]:.3g} m/s"
    return "; ".join([*what, where, *mend])


def only_used(scene: Scene, result: Result) -> tuple[Scene, Result]:
    """The part with the nodes and elements alone that exist, for pictures and files: room is left out on the host."""
    if scene.refinement is None:
        return scene, result
    active, used = np.asarray(result.active), np.asarray(result.used)
    number = np.cumsum(active) - 1
    triangles = number[np.asarray(result.triangles)[used]].astype(np.int32)
    nodal = {"positions", "thickness", "active", "stuck", "contact_time", "wall", "velocities"}
    of_elements = {"level", "used", "element_volume", "element_thickness", "stretches"}
    kept: dict[str, Any] = {name: np.asarray(getattr(result, name))[active] for name in nodal}
    kept |= {name: np.asarray(getattr(result, name))[used] for name in of_elements}
    kept["fields"] = {name: np.asarray(values)[active] for name, values in result.fields.items()}
    sheet = {name: np.asarray(getattr(scene.parison, name))[active] for name in ("positions", "thickness")}
    sheet |= {name: np.asarray(getattr(scene.parison, name))[active] for name in ("clamped", "fixed")}
    parison: Any = dataclasses.replace(scene.parison, triangles=triangles, **sheet)  # pyright: ignore
    made: Any = dataclasses.replace(result, triangles=triangles, **kept)
    return dataclasses.replace(scene, parison=parison, refinement=None), made


def formed_areas(result: Result) -> np.ndarray:
    """Final area (n_element,) [m^2] of the elements; 0 where not used."""
    volume, wall = np.asarray(result.element_volume, float), np.asarray(result.element_thickness, float)
    return volume / np.where(wall > 0.0, wall, 1.0)


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
    beyond = penetrated(result, scene)
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
        "contact_fraction": float(area[_touching(result)].sum() / area.sum()),
        "mass": float(result.mass),
        "added_mass": float(result.added_mass),
        "penetration_max": beyond.elements,
        "penetration_place": beyond.place.tolist(),
        "energy": energy | {"balance_error": float(result.energy.balance_error), "haste": float(result.energy.haste)},
        "warnings": [
            *warnings_of(result, scene),
            *warnings_of_part(result, scene),
            *warnings_of_mold(result, scene, beyond),
        ],
    }


def warnings_of(result: Result, scene: Scene) -> list[str]:
    """What to mind about a part that was formed as asked for: a sentence each, with the mend."""
    still = int(result.status) == 0 and bool(np.any(scene.pushes()))
    return [*(unmoved(result.energy) if still else []), *_hasty(result, scene)]


def _hasty(result: Result, scene: Scene) -> list[str]:
    haste = float(result.energy.haste)
    if not scene.solver.quasi_static or not haste > SLOW_ENOUGH:
        return []
    peak = float(result.energy.kinetic_peak / jnp.abs(result.energy.external_work))
    drag = haste - peak
    what = (
        f"the kinetic energy came to {100 * peak:.2g} % of the work"
        if peak > drag
        else f"damping took {100 * float(result.energy.damping_loss / jnp.abs(result.energy.external_work)):.2g} % of "
        "the work"
    )
    linear = isinstance(scene.pressure, Pressure) and scene.pressure.interpolation == "linear"
    mend = 'interpolation = "cubic-ramp" or ' if linear else ""
    mend = f"raise the pressure more slowly ({mend}later pressure.time and solver.end_time)"
    mend += ", or raise solver.damping" if peak > 4 * drag else ", or lower solver.damping" if drag > peak else ""
    return [
        f"this is no slow process (solver.quasi_static): {what}, so the wall may be about {100 * haste:.2g} % off that "
        f"of one; {mend}"
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
    place = ", ".join(f"{value:.4g}" for value in beyond.place)
    return [
        f"the sheet is beyond the mold, deepest at ({place}) m with {beyond.elements:.3g} m: it hangs over the mold's "
        "rim, or its elements are too large for an edge; make the mold as wide as the sheet, or the elements smaller"
    ]


def penetrated(result: Result, scene: Scene) -> Penetration:
    """How far the formed part is beyond the mold; nowhere, where there is no mold."""
    positions = np.asarray(result.positions, float)
    if scene.mold is None or not np.isfinite(positions).all():
        return Penetration(0.0, 0.0, np.zeros(3))
    triangles = np.asarray(result.triangles)[np.asarray(result.used)]
    pressures = scene.pushes()
    start, highest = np.asarray(scene.parison.positions, float), pressures[np.argmax(np.abs(pressures))]
    resting = resting_directions(start, positions, triangles, float(highest))
    return penetration(
        positions, triangles, np.asarray(result.wall), scene.mold, grid=scene.tables.grid, resting=resting
    )


def _touching(result: Result) -> np.ndarray:
    """Elements with three stuck nodes (n_element,), at least one of which touches the mold."""
    triangles = np.asarray(result.triangles)
    stuck, touched = np.asarray(result.stuck)[triangles], (np.asarray(result.contact_time) > 0)[triangles]
    return stuck.all(1) & touched.any(1)

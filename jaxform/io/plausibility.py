"""Checks of tools before a run: collisions, whether they reach the sheet and start outside it, their units."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from jaxform.core.errors import format_number, format_place, warn_of
from jaxform.loads import Gas, RegionalLoad, TwoSidedLoad, list_gases
from jaxform.materials import Cooling
from jaxform.materials.temperature import Wlf
from jaxform.mesh import topology
from jaxform.mesh.meshes import mirror_image
from jaxform.mesh.topology import distinct_rows
from jaxform.model.scene import ContactSurface, Scene, enclosed_volumes
from jaxform.results.sections import FLAT, symmetry_planes
from jaxform.tools.crossings import nodal_normals, proper_crossings
from jaxform.tools.distances import Distances
from jaxform.tools.mold import Mold, make_mold
from jaxform.tools.parting import find_beyond_land
from jaxform.tools.search import build_grid

Array = NDArray[np.float64]

_NEAR = 1e-4  # of the sheet's size: a tool that touches it at first may well pull it along
_TOUCH = 1e-6  # of the sheet's size: a tool that reaches beyond it by less touches it
_SAME = 1e-3  # of a distance: one that is as much less is nearer
_FARTHER = 0.02  # of the sheet's size, that a tool moves off
_TIMES = 21  # times at which the distance of a tool from the sheet is measured
_MOST_PLACES = 5000  # vertices of a tool whose distance from the sheet is measured
_MEETINGS = 41  # times, besides the knots of motions, at which two tools are compared
_ACROSS = 0.1  # of the longer side of a tool across a plane: the shorter one, at least
_UNLIKE = 0.02  # of that side, or of the sheet: what a tool lacks of its image, at least
_MOST_FRICTION = 5.0  # a coefficient of friction that is larger is hardly one
_BEHIND = 1e-3  # of the sheet's size: as near as that to its surface a place is on neither side


def words_of(tool: Mold) -> tuple[str, str]:
    """The name of a mold or tool in messages, and the key of its table in scene files."""
    return tool.describe(), f"tool.{tool.name}" if tool.name else "mold"


def motion_key(tool: Mold, name: str) -> str:
    """The key of a number of a mold's or tool's motion in scene files."""
    return f"tool.{tool.name}.{name}" if tool.name else f"mold.motion.{name}"


def end_of_way(scene: Scene, tool: Mold) -> float:
    """The time [s] from which on a tool rests, at most that at which the run ends."""
    end = float(scene.solver.end_time)
    return 0.0 if tool.motion is None else min(end, float(np.asarray(tool.motion.time)[-1]))


def warn_of_tools(scene: Scene, tools: Sequence[Mold], file: str = "") -> None:
    """Warns of some of a scene's tools that start in the sheet or never reach it, and of all that meet another one."""
    for tool in tools:
        _warn_of_start(scene, tool, file)
        _warn_of_reach(scene, tool, file)
        _warn_of_planes(scene, tool, file)
    for one, other, time, place in find_meetings(scene):
        when = "at the start" if time == 0.0 else f"at {time:.3g} s"
        problem = f"meets {words_of(one)[0]} {when}, near {format_place(place)}: they pass through each other"
        key = words_of(other)[1]
        remedy = f"change its motion ({motion_key(other, 'displacement')}) or its place ({key}.translate)"
        warn_of(problem, remedy, key=key, file=file)


def find_meetings(scene: Scene) -> list[tuple[Mold, Mold, float, Array]]:
    """The pairs of a scene's tools, the mold included, that pass through each other before the run ends.

    Returns:
        Of each pair the tool that comes first in the scene, the other one, the first of the compared times at which
        they meet [s], and a place where they do (3,) [m].
    """
    found = []
    # Half of a blow pin is beyond the plate in the symmetry plane, where nothing is simulated.
    surfaces = [surface for surface in scene.surfaces if _plane_of(scene, surface.mold) is None]
    for one, other in itertools.combinations(surfaces, 2):
        meeting = _find_meeting(scene, one, other)
        if meeting is not None:
            found.append((one.mold, other.mold, *meeting))
    return found


def _plane_of(scene: Scene, tool: Mold) -> int | None:
    """Axis of the symmetry plane in which a tool at rest lies, as that of a parting plane does; else None."""
    if tool.motion is not None:
        return None
    near = _SAME * float(np.ptp(_used_places(scene), axis=0).max())
    places = np.asarray(tool.vertices, float)[np.unique(np.asarray(tool.triangles))]
    planes = symmetry_planes(scene).items()
    return next((axis for axis, level in planes if np.abs(places[:, axis] - level).max() <= near), None)


def _find_meeting(scene: Scene, one: ContactSurface, other: ContactSurface) -> tuple[float, Array] | None:
    """The first of the compared times [s] at which two tools pass through each other, and a place there (3,) [m]."""
    end, motions = float(scene.solver.end_time), (one.mold.motion, other.mold.motion)
    times = [np.zeros(1)]
    for motion in filter(None, motions):
        knots = np.asarray(motion.time, float)
        times += [np.linspace(0.0, min(end, float(knots[-1])), _MEETINGS), knots[(knots > 0.0) & (knots <= end)]]
    compared = np.unique(np.concatenate(times))
    ways = [tool.mold.offset_at(compared) for tool in (one, other)]
    for time, at, there in zip(compared, *ways, strict=True):
        for edged, crossed, here, opposite in ((one, other, at, there), (other, one, there, at)):
            place = _crossing(edged, crossed, here - opposite)
            if place is not None:
                return float(time), place + opposite
    return None


def _crossing(edged: ContactSurface, crossed: ContactSurface, shift: Array) -> Array | None:
    """Middle (3,) [m] of an edge of a tool, moved by a shift (3,) [m], that crosses another tool; None without one.

    Both are in the frame of that other tool.
    """
    vertices = np.asarray(edged.mold.vertices, float) + shift
    there = np.asarray(crossed.mold.vertices, float)
    ends = vertices[topology.edges(np.asarray(edged.mold.triangles))[0]]
    beside = (ends.max(1) < there.min(0)) | (ends.min(1) > there.max(0))
    ends = ends[~beside.any(1)]
    if not len(ends):
        return None
    hit, _ = proper_crossings(ends[:, 0], ends[:, 1], crossed.mold, crossed.grid)
    return ends[hit[0]].mean(0) if len(hit) else None


def _used_places(scene: Scene) -> Array:
    """Places (n, 3) [m] of the sheet's nodes before the run."""
    return np.asarray(scene.parison.positions, float)[np.unique(np.asarray(scene.parison.triangles))]


def _warn_of_start(scene: Scene, tool: Mold, file: str) -> None:
    """Warns of a tool that starts in an element; building a scene refuses one that crosses sides of elements.

    A tool that touches the sheet has edges on one side of it. The sheet is moved to either side, since vertices of a
    tool that crosses it may lie in it: then edges at such a vertex cross it on both sides.
    """
    positions, triangles = np.asarray(scene.parison.positions, float), np.asarray(scene.parison.triangles)
    edge = topology.edges(np.asarray(tool.triangles))[0]
    ends = np.asarray(tool.vertices, float)[edge]
    normals = nodal_normals(positions, triangles)
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), np.finfo(float).tiny)
    crossing = []
    for side in (1.0, -1.0):
        sheet = make_mold(positions + side * _TOUCH * float(np.ptp(positions, axis=0).max()) * normals, triangles)
        grid = build_grid(np.asarray(sheet.vertices, float), np.asarray(sheet.triangles))
        crossing.append(np.unique(edge[proper_crossings(ends[:, 0], ends[:, 1], sheet, grid)[0]]))
    through = np.intersect1d(*crossing)
    if len(through):
        key, where = words_of(tool)[1], format_place(np.asarray(tool.vertices, float)[through[0]])
        warn_of(f"starts in the sheet, near {where}", f"move it ({key}.translate)", key=key, file=file)


def _warn_of_planes(scene: Scene, tool: Mold, file: str) -> None:
    """Warns of a tool across a symmetry plane whose sides differ: its image is beside it, and both meet the sheet."""
    places, key = np.asarray(tool.vertices, float), words_of(tool)[1]
    for axis, level in symmetry_planes(scene).items():
        beyond, before = _reach_across(places, axis, level)
        short, long = sorted((beyond, before))
        if _ACROSS * long < short < (1.0 - _UNLIKE) * long:
            problem = (
                f"reaches {1e3 * before:.3g} mm before the symmetry plane {'xyz'[axis]} = {level:g} m, and "
                f"{1e3 * beyond:.3g} mm beyond it, where its image is another tool"
            )
            remedy = f"put its middle into the plane ({key}.translate), or give the whole sheet"
            warn_of(problem, remedy, key=key, file=file)


def _reach_across(places: Array, axis: int, level: float) -> tuple[float, float]:
    """The distances [m] to which places (n, 3) reach on the lower and on the upper side of a plane across an axis."""
    return level - float(places[:, axis].min()), float(places[:, axis].max()) - level


def warn_of_images(scene: Scene, file: str = "") -> None:
    """Warns of a mold or tool on both sides of a symmetry plane that differs from its image in it.

    The part is simulated on the sheet's side alone. Of a flat sheet, the vertices before the sheet and its image count.
    """
    alike = _UNLIKE * float(np.ptp(np.asarray(scene.parison.positions, float), axis=0).max())
    for surface, (axis, level) in itertools.product(scene.surfaces, symmetry_planes(scene).items()):
        places, triangles = np.asarray(surface.mold.vertices, float), np.asarray(surface.mold.triangles)
        short, long = sorted(_reach_across(places, axis, level))
        told = surface.mold.name and short < (1.0 - _UNLIKE) * long  # by `_warn_of_planes`
        if short < _ACROSS * long or told:
            continue
        images = mirror_image(places, axis, level)
        asked = np.flatnonzero(_before_sheet(scene, places, axis, level) & ~_among(images, places, 1e-6 * long))
        asked = asked[:: 1 + len(asked) // _MOST_PLACES]
        if not len(asked):
            continue
        size = float(np.linalg.norm(np.ptp(np.concatenate([places, images[asked]]), axis=0)))
        away, at = Distances(places, triangles, size).largest(images[asked], alike)
        if at >= 0:
            key = words_of(surface.mold)[1]
            problem = (
                f"differs from its image in the symmetry plane {'xyz'[axis]} = {level:g} m by {1e3 * away:.3g} mm, "
                f"near {format_place(places[asked[at]])}; only the sheet's side of it is simulated"
            )
            remedy = f"give the whole sheet (parison.symmetry), or put its middle into the plane ({key}.translate)"
            warn_of(problem, remedy, key=key, file=file)


def _among(points: Array, places: Array, width: float) -> NDArray[np.bool_]:
    """True for points (n, 3) [m] that are in the same cell of a width [m] as a place (m, 3); a few are missed."""
    label = distinct_rows(np.round(np.concatenate([points, places]) / width).astype(np.int64))[2]
    return np.isin(label[: len(points)], label[len(points) :])


def _before_sheet(scene: Scene, places: Array, axis: int, level: float) -> NDArray[np.bool_]:
    """True for places (n, 3) [m] before a flat sheet or its image in a plane; for all, if the sheet is not flat."""
    sheet = np.asarray(scene.parison.positions, float)
    box = np.ptp(sheet, axis=0)
    if box.min() > FLAT * box.max():
        return np.ones(len(places), bool)
    whole = np.concatenate([sheet, mirror_image(sheet, axis, level)])
    inside = (places >= whole.min(0)) & (places <= whole.max(0))
    return np.delete(inside, int(np.argmin(box)), axis=1).all(1)


def _warn_of_reach(scene: Scene, tool: Mold, file: str) -> None:
    """Warns of a tool that the sheet cannot meet: it is behind the sheet, where nothing pushes the sheet, all the time.

    Where the pressure changes sign, gravity acts or another tool moves, the sheet may well come to it.
    """
    pushes = np.asarray(scene.pushes(), float)
    others_move = any(one.mold.motion is not None for one in scene.surfaces if one.mold is not tool)
    if others_move or scene.solver.gravity is not None or (pushes.min() < 0.0 < pushes.max()):
        return
    places = _used_places(scene)
    size = float(np.ptp(places, axis=0).max())
    away, behind = _ways_from_sheet(scene, tool)
    if min(away) <= _NEAR * size or not (behind or not np.any(pushes)):
        return
    _, key = words_of(tool)
    end = float(scene.solver.end_time)
    if tool.motion is not None and (begin := float(np.asarray(tool.motion.time)[0])) >= end:
        problem = f"never reaches the sheet: it begins to move at {begin:g} s, and the run ends at {end:g} s"
        warn_of(problem, f"let it begin earlier ({motion_key(tool, 'time')})", key=key, file=file)
        return
    if _way_left(scene, tool) > 0.0 or _passes_through(scene, tool):
        return  # what is left of its way is said of the motion
    side = "on the side from which the pressure pushes the sheet away, " if np.any(pushes) else ""
    remedy = f"move it nearer ({key}.translate), or farther along its way ({motion_key(tool, 'displacement')})"
    if _moves_off(away, size):
        remedy = f"reverse {motion_key(tool, 'direction')}, or move it to the other side of the sheet ({key}.translate)"
    warn_of(f"never reaches the sheet: it stays {side}at least {min(away):.3g} m from it", remedy, key=key, file=file)


def _passes_through(scene: Scene, tool: Mold) -> bool:
    """True if a tool crosses the initial sheet on its way, however far apart the times are at which it is looked at."""
    if tool.motion is None:
        return False
    positions, triangles = np.asarray(scene.parison.positions, float), np.asarray(scene.parison.triangles)
    shifts = tool.offset_at(np.linspace(0.0, end_of_way(scene, tool), _TIMES))
    far = shifts @ np.asarray(tool.motion.direction, float)
    first, last = shifts[np.argmin(far)], shifts[np.argmax(far)]
    sheet = make_mold(positions, triangles)
    for begin, shift, crossed in (
        (np.asarray(tool.vertices, float) + first, last - first, sheet),
        (_used_places(scene) - first, first - last, tool),
    ):
        grid = build_grid(np.asarray(crossed.vertices, float), np.asarray(crossed.triangles))
        if len(proper_crossings(begin, begin + shift, crossed, grid)[0]):
            return True
    return False


def _way_left(scene: Scene, tool: Mold) -> float:
    """Distance [m] of a tool from the end of its way when the run ends; 0 where it is nearly there."""
    if tool.motion is None:
        return 0.0
    times = np.asarray(tool.motion.time, float)
    now, last = tool.offset_at(np.array([min(float(scene.solver.end_time), times[-1]), times[-1]]))
    left, longest = float(np.linalg.norm(last - now)), float(np.abs(np.asarray(tool.motion.displacement, float)).max())
    return left if left > _FARTHER * longest else 0.0


def _ways_from_sheet(scene: Scene, tool: Mold) -> tuple[list[float], bool]:
    """Distances [m] of a tool from the initial sheet at times evenly from 0 to the end of its way.

    Also whether it is on the side opposite to the push in all of them.
    """
    positions, triangles = np.asarray(scene.parison.positions, float), np.asarray(scene.parison.triangles)
    sheet, vertices = _used_places(scene), np.asarray(tool.vertices, float)[np.unique(np.asarray(tool.triangles))]
    vertices = vertices[:: 1 + len(vertices) // _MOST_PLACES]
    size = float(np.ptp(np.concatenate([sheet, tool.where_it_turns()]), axis=0).max())
    of_tool, of_sheet = Distances(tool.vertices, tool.triangles, size), Distances(positions, triangles, size)
    corners = positions[triangles]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normal *= (-1.0 if scene.strongest_push() < 0 else 1.0) / np.linalg.norm(normal, axis=1, keepdims=True)
    away, behind = [], True
    times = np.linspace(0.0, end_of_way(scene, tool), _TIMES if tool.motion is not None else 1)
    for shift in tool.offset_at(times):
        nearest = of_tool.upper_bounds(sheet - shift).min(), of_sheet.upper_bounds(vertices + shift).min()
        away.append(float(min(nearest)))
        heights = heights_above(vertices + shift, corners.mean(1), normal)
        behind = behind and bool(np.all(heights < -_BEHIND * float(np.ptp(sheet, axis=0).max())))
    return away, behind


def heights_above(points: Array, middle: Array, unit: Array) -> Array:
    """Signed distances [m] of points (n, 3) [m] in front of the nearest elements with these centroids and normals."""
    from scipy.spatial import KDTree  # takes a tenth of a second to import

    nearest = KDTree(middle).query(points, workers=-1)[1]
    return np.einsum("ij,ij->i", points - middle[nearest], unit[nearest])


def _moves_off(away: list[float], size: float) -> bool:
    """True for the distances [m] of a tool that starts away from the sheet and only moves farther away."""
    farther = min(away) >= (1 - _SAME) * away[0] and away[-1] > away[0] + _FARTHER * size
    return farther and away[0] > _NEAR * size


def warn_of_land(scene: Scene, tables: Any, file: str) -> None:
    """Warns of a sheet that reaches, or is spread, beyond the land of a mold half, where nothing pinches it.

    Args:
        scene: The scene.
        tables: Validated tables of its file.
        file: The file that it was read from.
    """
    if scene.part is None:
        return
    given = [*([] if scene.mold is None else [tables.mold]), *tables.tool]
    masks = [*([] if scene.mold is None else [scene.part.walls]), *scene.part.tool_walls]
    points = _used_places(scene)
    spread = _spread(tables.parison, points)
    for surface, table, mask in zip(scene.surfaces, given, masks, strict=False):
        if table.land is None or mask is None:
            continue
        tool = surface.mold
        land = np.asarray(tool.triangles)[~np.asarray(mask)]
        vertices = tool.vertices_at(end_of_way(scene, tool))
        _warn_of_open_half(scene, tool, vertices[np.unique(land)], file)
        for places, words in ((points, "extends"), (spread, "is spread")):
            beyond = find_beyond_land(places, vertices, land)
            if beyond.any():
                problem = (
                    f"is too narrow for the sheet, which {words} to {format_place(places[beyond][0])}: what lies "
                    "beyond the land is not pinched, and the pressure blows it up"
                )
                warn_of(problem, "make it wider, or the sheet shorter", key=f"{words_of(tool)[1]}.land", file=file)
                break


def _warn_of_open_half(scene: Scene, tool: Mold, land: Array, file: str) -> None:
    """Warns of a mold half whose land (n, 3) [m] ends before the symmetry plane, where it would meet its image."""
    sides, size = np.ptp(land, axis=0), float(np.ptp(_used_places(scene), axis=0).max())
    axis = int(np.argmin(sides))
    level = symmetry_planes(scene).get(axis)
    if level is None or sides[axis] > _SAME * sides.max():
        return
    name, plane = words_of(tool)[0], f"the symmetry plane {'xyz'[axis]} = {level:g} m"
    gap = float(np.abs(land[:, axis] - level).min())
    if gap > _SAME * size:
        problem = f"the land of {name} ends {1e3 * gap:.3g} mm from {plane}, so that it pinches nothing"
        key = motion_key(tool, "displacement") if tool.motion is not None else f"{words_of(tool)[1]}.translate"
        warn_of(problem, "let it end in the plane", key=key, file=file)


def _spread(parison: Any, points: Array) -> Array:
    """Places (4, 3) [m] of the sides of a tube that is pressed flat, at the middle of its length; none of others."""
    if parison.shape != "tube":
        return np.zeros((0, 3))
    reach, level = 0.5 * np.pi * parison.radius, 0.5 * (points[:, 2].min() + points[:, 2].max())
    sides = np.array([[reach, 0.0], [-reach, 0.0], [0.0, reach], [0.0, -reach]])
    return np.column_stack([sides, np.full(4, level)])


def warn_of_motion(scene: Scene, file: str) -> None:
    """Warns of a mold that moves away from a sheet which it is not near to, and never comes nearer."""
    if scene.mold is None or scene.motion is None:
        return
    away = _ways_from_sheet(scene, scene.mold)[0]
    if not _moves_off(away, float(np.ptp(np.asarray(scene.parison.positions, float), axis=0).max())):
        return
    ends = f"{away[0]:.3g} m from the sheet at first, {away[-1]:.3g} m at {end_of_way(scene, scene.mold):.3g} s"
    warn_of(
        f"the mold moves, but not towards the sheet: {ends}",
        "reverse mold.motion.direction, or move the mold to the other side of the sheet (mold.translate)",
        key="mold.motion.direction",
        value=np.asarray(scene.motion.direction, float).tolist(),
        file=file,
    )


# Unit of length of a mold file, guessed; warnings of likely errors in other units. On the host.

_WEAK_MODES = 1e-3  # of the model's stiffness, Prony terms altogether
_KELVIN = 273.15
_APART = 120.0  # K, between a sheet's temperature and the shift's reference: where one is in kelvin, they are
_BELOW, _ABOVE = 60.0, 150.0  # K, by which a sheet may be below or above that reference in the same unit
_LIKE_KELVIN = 253.15  # degC of air or mold: as hot is hardly any, and 253 K is as cold
_IDLE_ENERGY = 500.0  # J/mol: plastics have 2e4 to 5e5
_COLD = 150.0  # K: no gas is blown in as cold
_RARE, _FAINT = 5000.0, 100.0  # Pa: no surroundings and no supply have less, but for a vacuum of 0
_ROOMY = 100.0  # cubes as wide as sheet and tools: no hoses and no cavity have more
_LATE = 100.0  # times the end of the run: no process is cut short as far before its last knot
_HEAVY = 500.0  # m/s^2: gravity is 9.81
_WAVE = 8.0  # times c over the density: the square of the speed of a wave along the sheet


def warn_of_units(scene: Scene, file: str = "") -> None:
    """Warns of likely unit errors in numbers of material, temperatures, loads, gravity, friction and motion."""
    _warn_of_modes(scene, file)
    _warn_of_shift(scene, file)
    if scene.cooling is not None and scene.parison.temperature is not None:
        _warn_of_surroundings(scene, scene.cooling, np.asarray(scene.parison.temperature, float), file)
    for key, gas in list_gases(scene.pressure).items():
        _warn_of_gas(scene, gas, key, file)
    _warn_of_times(scene, file)
    _warn_of_gravity(scene, file)
    _warn_of_friction(scene, file)
    _warn_of_motion(scene, file)


def _warn_of_times(scene: Scene, file: str) -> None:
    """Warns of a pressure or gas of which the last knot is so long after the run that its times are in another unit."""
    load, end = scene.pressure, float(scene.solver.end_time)
    loads: dict[str, Any] = {"pressure": load.inside if isinstance(load, TwoSidedLoad) else load}
    if isinstance(load, RegionalLoad):
        loads = {"pressure": next((part for part in load.loads if not isinstance(part, Gas)), None)}
    for key, part in {**loads, **list_gases(load)}.items():
        time = getattr(part, "time", None)
        if (key == "pressure" and isinstance(part, Gas)) or time is None:
            continue
        knots = np.atleast_1d(np.asarray(time, float))
        if knots[-1] > _LATE * end:
            problem = f"goes on to {knots[-1]:g} s, and the run ends at {end:g} s: is it in milliseconds?"
            warn_of(problem, "give s", key=f"{key}.time", value=knots.tolist(), file=file)


def _warn_of_gravity(scene: Scene, file: str) -> None:
    if scene.solver.gravity is None:
        return
    gravity = np.asarray(scene.solver.gravity, float)
    if np.linalg.norm(gravity) > _HEAVY:
        problem, remedy = "is very large: is it in mm/s^2?", "give m/s^2: 9.81 on the ground"
        warn_of(problem, remedy, key="solver.gravity", value=gravity.tolist(), file=file)


def _warn_of_friction(scene: Scene, file: str) -> None:
    for tool in (surface.mold for surface in scene.surfaces if surface.mold.contact.has_friction):
        most = float(np.max(np.asarray(tool.contact.friction)))  # pyright: ignore[reportAttributeAccessIssue]
        if most > _MOST_FRICTION:
            problem, remedy = "is a very large coefficient: is it in per cent?", f"give {0.01 * most:.4g} if it is"
            warn_of(problem, remedy, key=f"{words_of(tool)[1]}.friction", value=most, file=file)


def _warn_of_modes(scene: Scene, file: str) -> None:
    modes = scene.material.viscous
    if modes is None:
        return
    elastic, viscous = float(scene.law.elastic.stiffness().mean()), float(modes.stiffness().mean())
    if viscous < _WEAK_MODES * elastic:
        modulus = np.asarray(modes.modulus, float)
        problem = f"the Prony terms are {viscous / elastic:.1g} times as stiff as the elastic model: modulus is in Pa"
        remedy = "if they are relative moduli, as in Abaqus and Ansys, multiply them by the instantaneous shear modulus"
        warn_of(problem, remedy, key="material.viscous.modulus", value=modulus.tolist(), file=file)


def _warn_of_shift(scene: Scene, file: str) -> None:
    shift, temperature = scene.material.shift, scene.parison.temperature
    if shift is None or temperature is None:
        return
    reference, warmest = float(shift.reference), float(np.max(np.asarray(temperature)))
    if warmest > max(reference + _APART, _KELVIN) and -_BELOW <= warmest - _KELVIN - reference <= _ABOVE:
        problem = f"is {warmest - reference:.3g} K above the reference of the shift: is it in kelvin?"
        remedy = f"give degC: {warmest - _KELVIN:.4g}"
        warn_of(problem, remedy, key="parison.temperature", value=warmest, file=file)
    elif reference > max(warmest + _APART, _KELVIN) and -_BELOW <= warmest + _KELVIN - reference <= _ABOVE:
        problem = f"is {reference - warmest:.3g} K above the sheet's temperature: is it in kelvin?"
        remedy = f"give degC: {reference - _KELVIN:.4g}"
        warn_of(problem, remedy, key="material.shift.reference", value=reference, file=file)
    energy = None if isinstance(shift, Wlf) else getattr(shift, "activation_energy", None)
    if energy is not None and 0.0 < float(energy) < _IDLE_ENERGY:
        problem = "has almost no effect: is it in J/mol?"
        remedy = f"give {format_number(1e3 * float(energy), 4)} if it is in kJ"
        warn_of(problem, remedy, key="material.shift.activation_energy", value=float(energy), file=file)


def _warn_of_surroundings(scene: Scene, cooling: Cooling, temperature: np.ndarray, file: str) -> None:
    """Warns of air, a mold or a tool that is warmer than the sheet, or whose temperature looks like kelvin."""
    given = [("air", "cooling.air_temperature", cooling.air, cooling.air_temperature)]
    given.append(("a mold", "cooling.mold_temperature", cooling.mold, cooling.mold_temperature))
    for tool in scene.tools:
        if tool.temperature is not None:
            transfer = cooling.mold if tool.heat_transfer is None else tool.heat_transfer
            given.append(("a tool", f"tool.{tool.name}.temperature", transfer, tool.temperature))
    for name, key, transfer, degrees in given:
        value = float(degrees)
        hot, kelvin = value > temperature.min(), value > _LIKE_KELVIN
        if float(transfer) == 0.0 or not (hot or kelvin):
            continue
        problem = f"is above the sheet's temperature of {temperature.min():.4g} degC" if hot else f"is high for {name}"
        problem += ": is it in kelvin?" if kelvin else ""
        remedy = f"give degC: {value - _KELVIN:.4g}" if kelvin else "check that this is intended"
        warn_of(problem, remedy, key=key, value=value, file=file)


def _warn_of_gas(scene: Scene, gas: Gas, key: str, file: str) -> None:
    """Warns of numbers of a gas in other units than SI, and of a mass flow that takes out all of it."""
    size = float(
        np.ptp(np.concatenate([_used_places(scene), *(one.mold.vertices for one in scene.surfaces)]), axis=0).max()
    )
    least = {"temperature": (_COLD, "degC", "K"), "ambient_pressure": (_RARE, "bar or kPa", "Pa")}
    least["supply_pressure"] = (_FAINT, "bar or MPa", "Pa")
    most = {"orifice_area": (size**2, "mm^2", "m^2"), "vent_area": (size**2, "mm^2", "m^2")}
    most["dead_volume"] = (_ROOMY * size**3, "cm^3 or litres", "m^3")
    for name, (limit, likely, unit) in {**least, **most}.items():
        given = getattr(gas, name)
        value = 0.0 if given is None else float(np.abs(np.asarray(given, float)).max())
        if (0.0 < value < limit) if name in least else value > limit:
            problem = f"is very {'small' if name in least else 'large'}: is it in {likely}?"
            warn_of(problem, f"give {unit}", key=f"{key}.{name}", value=value, file=file)
    enclosed: Any = enclosed_volumes(scene.pressure, scene.parison)
    if isinstance(scene.pressure, RegionalLoad):
        enclosed = scene.pressure.own_volumes(enclosed)[scene.pressure.names.index(key.removeprefix("gas."))]
    pressures = gas.pushes(float(scene.solver.end_time), enclosed) * (1.0 if gas.closed_by == "clamp" else -1.0)
    if float(gas.mass_flow.min()) < 0.0 and pressures.min() <= -float(gas.ambient_pressure):
        problem = "takes out all of the gas before the run ends: its absolute pressure is 0 from then on"
        value = np.asarray(gas.mass_flow, float).tolist()
        warn_of(problem, "take out less (kg/s)", key=f"{key}.mass_flow", value=value, file=file)


def _warn_of_motion(scene: Scene, file: str) -> None:
    """Warns of a mold or tool that is faster than waves in the sheet, or still on its way when the run ends."""
    for tool in (surface.mold for surface in scene.surfaces):
        if tool.motion is None:
            continue
        time, end = np.asarray(tool.motion.time, float).tolist(), float(scene.solver.end_time)
        if time[0] < end and (left := _way_left(scene, tool)):
            problem = f"{words_of(tool)[0]} is {left:.3g} m from the end of its way when the run ends, at {end:g} s"
            remedy = "give the times in seconds, let it move earlier, or raise solver.end_time"
            warn_of(problem, remedy, key=motion_key(tool, "time"), value=time, file=file)
        speed = tool.motion.mean_speeds().max()
        wave = float(np.sqrt(_WAVE * scene.law.stiffness_at_once().mean() / scene.material.density.mean()))
        if speed > wave:
            problem = f"{words_of(tool)[0]} moves at {speed:.3g} m/s, faster than waves in the sheet ({wave:.3g} m/s)"
            remedy = "give times in seconds and displacements in metres, or move it more slowly"
            warn_of(problem, remedy, key=motion_key(tool, "time"), value=time, file=file)


# The unit of length of a mold's file, guessed from its size.

METRES, INCHES = 1.2, 18.0
"""Largest sizes of a part, as numbers, that are taken for metres, and for inches or centimetres."""
_CENTIMETRES = 60.0  # the same, up to which a part of so many millimetres may be one of so many centimetres
_ROUND, _OFF = 0.5, 1e-4  # of sides in centimetres, that are multiples of a half


Units = tuple[float, str, str]
"""A unit of length: in metres, its name, and other units that a file may have, as `--scale` says them; "" for none."""


_IN_MM = "--scale 0.001 where it is in millimetres"
_IN_CM = "--scale 0.01 where it is in centimetres"
_IN_INCHES = "--scale 0.0254 where it is in inches"


def guess_units(box: NDArray[np.float64], scale: float | None = None) -> Units:
    """The unit of a part whose box is so many units (3,) large; the given one [m], where one is given."""
    guessed = _guess(box)
    if scale is None:
        return guessed
    return scale, guessed[1] if scale == guessed[0] else f"units of {scale:g} m", ""


def _guess(box: NDArray[np.float64]) -> Units:
    size = float(box.max())
    if size <= METRES:
        return 1.0, "metres", ""
    if size <= INCHES:
        halves = box / _ROUND
        # A part of 12 x 8 x 5 is drawn in centimetres, one of 4.72 x 3.15 x 1.97 is drawn in inches or converted.
        if np.all(np.abs(halves - np.round(halves)) <= _OFF * np.maximum(halves, 1.0)):
            return 0.01, "centimetres", f"give {_IN_MM}, {_IN_INCHES}"
        return 0.0254, "inches", f"give {_IN_MM}, {_IN_CM}"
    return 0.001, "millimetres", f"give {_IN_CM}" if size <= _CENTIMETRES else ""

"""Survey of a scene before it runs, and warnings of likely errors: units, sides, holes, ribs, overlap, loads."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from jaxform.core.errors import format_extent, format_number, format_percent, format_place, warn_of
from jaxform.core.pytree import as_real, memoize
from jaxform.io.plausibility import (
    heights_above,
    warn_of_images,
    warn_of_land,
    warn_of_motion,
    warn_of_tools,
    warn_of_units,
)
from jaxform.io.surfaces import mirror_points
from jaxform.loads import TwoSidedLoad, list_gases
from jaxform.mechanics.membrane import equibiaxial_energy
from jaxform.mesh import outlines, raster, topology
from jaxform.mesh.grids import triangle_side
from jaxform.model.mesh_connectivity import warn_of_connectivity
from jaxform.model.scene import Scene
from jaxform.results import sections
from jaxform.tools.mold import Mold
from jaxform.tools.opening import rotation_to_z
from jaxform.tools.patches import cells_behind, find_side_holes
from jaxform.tools.ribs import Ribs, slender_feature

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

_ALIKE = 15.0  # times as large as the sheet, or as small, a mold may be
_SMALL = 60.0  # times smaller than the sheet, a tool may be
_GUESS = 5.0  # by which a mold in other units than m may be larger or smaller than the sheet
_SAMPLES = 10_000  # points on the mold, of which each is on one side of the sheet
_FLAT = 1e-3  # of the sheet's size: as near as that to its surface a mold lies on it
_HARDLY = 0.01  # of the mold's area, or of the sheet's
_BARE, _HOLE = 0.05, 0.025  # of the sheet, with no mold before it, and of its size, the radius of such a place
_EXPOSED = 0.2  # of the sheet, with mold only behind it
_MOST_STRETCHED = 6.0  # times, up to which a material model is checked
_FACING = 0.5  # length of the mean normal, from which a sheet can be seen from one side
_PIXELS = 200  # of the longer side of the sheet, for the overlap
_THIN, _THICK = 1.5e-5, 0.2  # of a sheet's size, its thickness
_LARGE = 20.0  # m
_LIGHT, _HEAVY = 10.0, 3e4  # kg/m^3
_WEAK, _STRONG = 1e-3, 1e5  # pressure, in units of stiffness times thickness over half the size


class Survey(NamedTuple):
    """Survey of a scene before it runs.

    Attributes:
        sheet: Least and largest coordinates (2, 3) [m] of the whole sheet, images in symmetry planes included.
        mold: The same of the mold; None without one.
        thinness: Mean thickness over the sheet's size.
        push: Unit vector (3,) in which the pressure pushes the sheet as a whole; shorter where the sheet is curved.
        outwards: True if a curved sheet is pushed away from its middle.
        changes_sign: True if the pressure pushes both ways in turn.
        ahead: Share of the mold's area on the side that the sheet is pushed to; 0 where it lies on the sheet.
        behind: Share on the other side.
        overlap: Share of the sheet that has mold before it, in the direction of the push; None where it is curved.
        exposed: Share of the sheet that has mold only behind it.
        bare: Radius [m] and middle (3,) [m] of the widest round spot of the sheet that has no mold before it; None
            where the sheet is curved.
    """

    sheet: Array
    mold: Array | None
    thinness: float
    push: Array
    outwards: bool
    changes_sign: bool
    ahead: float
    behind: float
    overlap: float | None
    exposed: float
    bare: tuple[float, Array] | None

    @property
    def faces(self) -> bool:
        """True if the sheet as a whole faces one direction."""
        return bool(np.linalg.norm(self.push) >= _FACING)

    @property
    def direction(self) -> str:
        """Direction in which the pressure pushes the sheet, in words."""
        if not self.faces:
            return "outwards" if self.outwards else "inwards"
        axis = int(np.argmax(np.abs(self.push)))
        if abs(self.push[axis]) > 0.97 * np.linalg.norm(self.push):
            return f"towards {'-+'[int(self.push[axis] > 0)]}{'xyz'[axis]}"
        return f"along {format_place(self.push / np.linalg.norm(self.push)).removesuffix(' m')}"


@memoize
def survey(scene: Scene) -> Survey:
    """The survey of a scene."""
    positions, triangles = np.asarray(scene.parison.positions, float), np.asarray(scene.parison.triangles)
    planes = sections.symmetry_planes(scene)
    used = positions[np.unique(triangles)]
    box = _box(used)
    for axis, level in planes.items():
        reach = np.abs(used[:, axis] - level).max()
        box[:, axis] = level - reach, level + reach
    corners = positions[triangles]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = np.linalg.norm(normal, axis=1)
    sign = _sign(scene)
    facing = sign * normal.sum(0) / area.sum()
    facing[list(planes)] = 0.0
    middle = corners.mean(1)
    center = 0.5 * (box[0] + box[1])
    outwards = float(np.einsum("ij,ij->", sign * normal, middle - center)) > 0
    knots = scene.pushes()
    both = bool(knots.min() < -0.05 * np.abs(knots).max() and knots.max() > 0.05 * np.abs(knots).max())
    thinness = float(np.asarray(scene.parison.thickness, float).mean()) / (box_size(box) or 1.0)
    ahead = behind = exposed = 0.0
    overlap = mold = bare = None
    if scene.mold is not None:
        walls = np.asarray(scene.mold.vertices, float)[np.asarray(scene.mold.triangles)]
        mold = _box(walls.reshape(-1, 3))
        points = _reflect_into_part(_sample_triangles(walls), planes, used)
        height = heights_above(points, middle, sign * normal / area[:, None])
        ahead, behind = (float((side * height > _FLAT * box_size(box)).mean()) for side in (1, -1))
        if np.linalg.norm(facing) >= _FACING:
            overlap, exposed, bare = _overlap(corners, walls, facing)
    return Survey(box, mold, thinness, facing, outwards, both, ahead, behind, overlap, exposed, bare)


def _box(points: Array) -> Array:
    return np.stack([points.min(0), points.max(0)])


def box_size(box: Array) -> float:
    """The longest side [m] of a box, given by its least and largest coordinates (2, 3) [m]."""
    return float((box[1] - box[0]).max())


def _sign(scene: Scene) -> float:
    """1 where the largest pressure pushes along the elements' normals, else -1."""
    return -1.0 if scene.strongest_push() < 0 else 1.0


def _sample_triangles(walls: Array) -> Array:
    """Points (n, 3) [m] all over triangles (m, 3, 3), each for as much area as another."""
    area = np.linalg.norm(np.cross(walls[:, 1] - walls[:, 0], walls[:, 2] - walls[:, 0]), axis=1)
    total = np.cumsum(area)
    k = np.arange(_SAMPLES)
    owner = np.minimum(np.searchsorted(total, (k + 0.5) / _SAMPLES * total[-1]), len(walls) - 1)
    # Two irrational steps spread the points of one triangle evenly.
    u, v = (k * 0.7548776662466927) % 1.0, (k * 0.5698402909980532) % 1.0
    root = np.sqrt(u)
    weight = np.stack([1 - root, root * (1 - v), root * v], axis=1)
    return np.einsum("nc,nck->nk", weight, walls[owner])


def _reflect_into_part(points: Array, planes: dict[int, float], used: Array) -> Array:
    """The points, or their images in the symmetry planes that lie on the side of the modelled part."""
    points = points.copy()
    for axis, level in planes.items():
        side = np.sign(used[:, axis].mean() - level)
        points[:, axis] = level + side * np.abs(points[:, axis] - level)
    return points


def _overlap(sheet: Array, walls: Array, facing: Array) -> tuple[float, float, tuple[float, Array]]:
    """Shares of a sheet (n, 3, 3) [m], seen along a direction, that have mold (m, 3, 3) before them, or only behind.

    Also radius and middle (3,) [m] of the widest round spot of it that has none before it.
    """
    axis = facing / np.linalg.norm(facing)
    across = np.linalg.svd(axis[None])[2][1:]
    flat, wall = sheet @ across.T, walls @ across.T
    low, high = flat.min((0, 1)), flat.max((0, 1))
    pixel = float((high - low).max()) / _PIXELS
    width, height = (max(1, round(float(extent) / pixel)) for extent in high - low)
    level, rise = np.full(width * height, -np.inf), sheet @ axis
    for _, covered, interpolate in raster.rasterize((flat - low) / pixel, width, height):
        np.maximum.at(level, covered, interpolate(rise))
    seen, near, along = np.isfinite(level), _FLAT * pixel * _PIXELS, walls @ axis
    before, behind = np.zeros_like(seen), np.zeros_like(seen)
    for _, covered, interpolate in raster.rasterize((wall - low) / pixel, width, height):
        away = interpolate(along) - level[covered]
        before[covered[away >= -near]] = True
        behind[covered[away < -near]] = True
    whole = max(1, int(seen.sum()))
    open_there = np.pad((seen & ~before).reshape(height, width), 1)
    away = outlines.distance(open_there)[1:-1, 1:-1].ravel()
    widest = int(np.argmax(away))
    row, column = divmod(widest, width)
    middle = (low + (np.array([column, row]) + 0.5) * pixel) @ across
    middle += (level[widest] if seen[widest] else 0.0) * axis
    bare = max(0.0, float(away[widest]) - 0.5) * pixel, middle
    return float((seen & before).sum() / whole), float((seen & behind & ~before).sum() / whole), bare


def warn_of_scene(scene: Scene, file: str = "", tables: Any = None) -> None:
    """Warns of likely errors in a scene that can be simulated: joints, units, sides, loads.

    Args:
        scene: The scene.
        file: The file that it was read from.
        tables: Validated tables of that file.
    """
    sheet = getattr(tables, "parison", None)
    path = getattr(sheet, "path", None)
    if path is not None:
        warn_of_connectivity(scene.parison, file, "parison.path", path)
    seen = survey(scene)
    _warn_of_sheet(scene, seen, file)
    _warn_of_law(scene, file)
    _warn_of_load(scene, seen, file)
    warn_of_units(scene, file)
    if seen.mold is not None:
        _warn_of_mold(scene, seen, file, getattr(tables, "mold", None), sheet)
    warn_of_images(scene, file)
    warn_of_motion(scene, file)
    if tables is not None:
        warn_of_land(scene, tables, file)
    given = [None] * len(scene.tools) if tables is None else tables.tool
    scales = [getattr(table, "scale", None) for table in given]
    sheet_scale = getattr(sheet, "scale", None)
    # A tool in other units also lies elsewhere.
    sized = [
        tool
        for tool, scale in zip(scene.tools, scales, strict=True)
        if not _warn_of_size(seen, tool, scale, sheet_scale, file)
    ]
    if sized:
        warn_of_tools(scene, sized, file)


def _warn_of_sheet(scene: Scene, seen: Survey, file: str) -> None:
    size = box_size(seen.sheet)
    if size > _LARGE:
        remedy = "give metres (parison.scale of a file, or its lengths)"
        warn_of(f"the sheet is {size:.4g} m wide: are its lengths in mm?", remedy, key="parison", file=file)
    if not _THIN <= seen.thinness <= _THICK:
        guess = " is it in mm?" if seen.thinness > _THICK else ""
        many = f"{seen.thinness:.3g} times the sheet's size of {size:.4g} m"
        remedy = "give thickness and sizes in m"
        mean = float(np.asarray(scene.parison.thickness, float).mean())
        warn_of(
            f"the thickness is {many}:{guess or ' is it a film?'}",
            remedy,
            key="parison.thickness",
            value=mean,
            file=file,
        )
    lightest, heaviest = float(scene.material.density.min()), float(scene.material.density.max())
    density = heaviest if lightest >= _LIGHT else lightest
    if not _LIGHT <= density <= _HEAVY:
        remedy = "give kg/m^3" + (f": {1e3 * density:.4g} if it is in g/cm^3" if 0.1 <= density < _LIGHT else "")
        warn_of("no plastic or rubber has such a density", remedy, key="material.density", value=density, file=file)


def _warn_of_law(scene: Scene, file: str) -> None:
    """Warns of a material model whose energy decreases with equibiaxial stretch: its stress is then compressive."""
    stretch = np.linspace(1.0, _MOST_STRETCHED, 501)
    energy = np.asarray(equibiaxial_energy(scene.law.elastic, as_real(np.square(stretch))), float)
    falls = np.flatnonzero(np.diff(energy) < 0.0)
    if len(falls):
        what = f"is unstable: its energy decreases beyond an equibiaxial stretch of {stretch[falls[0]]:.3g}"
        warn_of(what, "change its parameters, or keep the sheet below such stretches", key="material", file=file)


def _warn_of_load(scene: Scene, seen: Survey, file: str) -> None:
    stiffness = float(scene.law.stiffness_at_once().mean())
    largest = float(np.abs(scene.pushes()).max())
    load = largest / (2 * stiffness * seen.thinness)
    inside = scene.pressure.inside if isinstance(scene.pressure, TwoSidedLoad) else scene.pressure
    follows = inside.follows_volume
    units = "Pa, kg/s, m^2, m^3 and s" if follows else "Pa"
    if load < _WEAK:
        parison = scene.parison
        moves = scene.moves or (parison.clamp_until is not None and parison.pre_stretch is not None)
        if moves and not largest:
            return
        pascals = format_number(largest, 2)
        what = f"the pressure, up to {pascals} Pa, hardly moves the sheet" if largest else "there is no pressure"
        remedy = f"a sheet of this stiffness needs {stiffness * seen.thinness:.1g} Pa or more; give {units}"
    elif load > _STRONG:
        what = f"the pressure is {load:.1g} times what the sheet can carry"
        remedy = f"give {units}, and the stiffness in Pa"
    else:
        return
    key, value = ("gas", None) if follows else ("pressure.value", scene.pushes().tolist())
    warn_of(what, remedy, key=key, value=value, file=file)


def _warn_of_mold(scene: Scene, seen: Survey, file: str, table: Any, sheet_table: Any) -> None:
    """Warns once, for a mold in other units lies elsewhere too; a moving one may lie anywhere at first."""
    assert seen.mold is not None
    ratio = box_size(seen.mold) / (box_size(seen.sheet) or 1.0)
    boxes = f"mold {format_extent(*seen.mold)}, sheet {format_extent(*seen.sheet)}"
    if not 1 / _ALIKE <= ratio <= _ALIKE:
        scales = getattr(table, "scale", None), getattr(sheet_table, "scale", None)
        _tell_of_size("mold", "mold", ratio, *scales, boxes, file)
    elif scene.motion is not None:
        _warn_of_bare_around(scene, seen, file)
    elif _lies_on_mold(scene):
        problem = f"the whole sheet lies on the mold at the start, and stays there ({boxes})"
        remedy = "turn the mold, so that its open side faces the sheet (mold.rotate), or move it (mold.translate)"
        warn_of(problem, remedy, key="mold", file=file)
    elif not seen.changes_sign and (seen.exposed >= _EXPOSED or (seen.ahead < _HARDLY <= seen.behind)):
        _warn_of_side(scene, seen, boxes, file)
    elif seen.overlap is not None and seen.overlap + seen.exposed < _HARDLY:
        what = f"seen along the pressure ({seen.direction}), the mold does not face the sheet ({boxes})"
        warn_of(what, "move the mold (mold.translate)", key="mold", file=file)
    elif not seen.changes_sign and seen.overlap is not None and seen.bare is not None:
        _warn_of_bare(seen, seen.overlap, *seen.bare, file)


def _warn_of_size(seen: Survey, tool: Mold, scale: float | None, sheet_scale: float | None, file: str) -> bool:
    """Warns of a tool that seems to be in other units; a plug may be small. True if it does."""
    box = _box(np.asarray(tool.vertices, float))
    ratio = box_size(box) / (box_size(seen.sheet) or 1.0)
    if 1 / _SMALL <= ratio <= _ALIKE:
        return False
    boxes = f"tool {format_extent(*box)}, sheet {format_extent(*seen.sheet)}"
    _tell_of_size(f"tool {tool.name}", f"tool.{tool.name}", ratio, scale, sheet_scale, boxes, file)
    return True


def _tell_of_size(
    words: str, key: str, ratio: float, scale: float | None, sheet_scale: float | None, boxes: str, file: str
) -> None:
    """Warns of a mold or tool that is so many times as large as the sheet."""
    guess, remedy = _units(ratio, scale, sheet_scale)
    number = format_number(max(ratio, 1 / ratio), 3)
    times = f"{number} times the sheet" if ratio > 1 else f"{number} times smaller than the sheet"
    key = key if scale is None else f"{key}.scale"
    warn_of(f"the {words} is {times}{guess} ({boxes})", remedy, key=key, value=scale, file=file)


_REMEDY_OF_BARE = (
    "cover the hole or extend the mold, make the sheet as large as the opening, or, of a half or a quarter of a "
    "mold, give parison.symmetry"
)


def _lies_on_mold(scene: Scene) -> bool:
    """True if all nodes that are not clamped are in contact with a mold, to which they stick, from the start."""
    contact, nodes = scene.tables.initial_contact, np.unique(np.asarray(scene.parison.triangles))
    if scene.mold is None or contact is None or not scene.mold.contact.sticks or scene.tools:
        return False
    return bool((np.asarray(contact)[nodes] | np.asarray(scene.parison.clamped)[nodes]).astype(bool).all())


def _warn_of_bare_around(scene: Scene, seen: Survey, file: str) -> None:
    """Warns of sheet that a mold which moves alone has before it neither at first nor at rest: of no platen."""
    assert scene.mold is not None
    if scene.tools or seen.changes_sign or not seen.faces or not np.any(scene.pushes()):
        return
    rest = scene.mold.offset_at(np.array([float(scene.solver.end_time)]))[0]
    walls = np.asarray(scene.mold.vertices, float)[np.asarray(scene.mold.triangles)]
    corners = np.asarray(scene.parison.positions, float)[np.asarray(scene.parison.triangles)]
    overlap, _, bare = _overlap(corners, np.concatenate([walls, walls + rest]), seen.push)
    remedy = (
        "add a platen at the mold's base (a second file in mold.path, or a [[tool]]; `jaxform new` makes one), or make "
        "the sheet as large as the opening"
    )
    _warn_of_bare(seen, overlap, *bare, file, remedy)


def _warn_of_bare(
    seen: Survey, overlap: float, radius: float, middle: Array, file: str, remedy: str = _REMEDY_OF_BARE
) -> None:
    """Warns of sheet that the pressure would blow past the mold, or through it."""
    if 1 - overlap < _BARE and radius < _HOLE * box_size(seen.sheet):
        return
    share = f"{format_percent(1 - overlap, 3)} of the sheet has no mold in front of it"
    where = f"within {radius:.2g} m of {format_place(middle)} there is none"
    warn_of(f"{share}, {seen.direction}: {where}, so that nothing stops it there", remedy, key="mold", file=file)


def _warn_of_side(scene: Scene, seen: Survey, boxes: str, file: str) -> None:
    what = f"the pressure pushes the sheet {seen.direction}, away from the mold"
    share = (
        f"{format_percent(seen.ahead, 3)} of its area lies on that side, {format_percent(seen.behind, 3)} on the other"
    )
    gases = list_gases(scene.pressure).values()
    turned = "draw a vacuum (gas.supply_pressure below 0), " if any(gas.closed_by == "mold" for gas in gases) else ""
    turned = turned if gases else "turn the sign of pressure.value, "
    remedy = f"{turned}turn the sheet (parison.flip), or move or turn the mold"
    warn_of(f"{what}: {share} ({boxes})", remedy, key="mold", file=file)


def _units(ratio: float, scale: float | None, sheet_scale: float | None) -> tuple[str, str]:
    """Likely units, and the remedy, for a mold that is so many times as large as the sheet."""

    def fits(factor: float) -> bool:
        return 1 / _GUESS <= ratio * factor <= _GUESS

    known = {"millimetres": 1e-3, "inches": 0.0254, "centimetres": 0.01}
    for back in (False, True):
        factors = {units: 1 / factor if back else factor for units, factor in known.items()}
        fitting = sorted(
            filter(lambda units: fits(factors[units]), known), key=lambda units: _unit_mismatch(ratio, factors, units)
        )
        if back and scale is not None and scale != 1.0 and fits(1 / scale):
            return ": is its file already in metres?", "scale = 1"
        if back and scale is not None and fits(25.4):
            return ": inches?", f"scale = {25.4 * scale:.4g}"
        if fitting:
            units = fitting[0]
            given, whose = (sheet_scale, "parison.scale") if back else (scale, "scale")
            how = "give its lengths in metres" if given is None else f"{whose} = {given * known[units]:.4g}"
            return (f": is the sheet in {units}?" if back else f": {units}?"), how
    return "", "check the units of both: all lengths are in m"


def _unit_mismatch(ratio: float, factors: dict[str, float], units: str) -> float:
    """Misfit of units; millimetres, which most files have, come first."""
    return 0.0 if units == "millimetres" else abs(float(np.log(ratio * factors[units]))) + 1e-9


# A mold with holes in its side walls, which no view along the push shows. On the host, before a run.


_AFFORDABLE = 10_000  # elements, which a remedy may ask for
_LEAKS_PIXELS = 800  # of the longer side of the sheet


def warn_of_side_holes(scene: Scene, file: str = "") -> None:
    """Warns of holes in the side walls of a mold at rest, before which a flat sheet lies."""
    seen = survey(scene)
    if scene.mold is None or scene.motion is not None or not seen.faces or seen.changes_sign:
        return
    turn = rotation_to_z(seen.push / np.linalg.norm(seen.push))
    sheet, mold = (
        np.concatenate(mirror_points(scene, np.asarray(surface, float)[np.asarray(triangles)])) @ turn.T
        for surface, triangles in (
            (scene.parison.positions, scene.parison.triangles),
            (scene.mold.vertices, scene.mold.triangles),
        )
    )
    if np.ptp(sheet[..., 2]) > _FLAT * box_size(seen.sheet) or mold[..., 2].max() <= sheet[..., 2].min():
        return
    level = float(sheet[..., 2].min())
    holes = find_side_holes(cells_behind(mold, level, _region_before_mold(sheet[..., :2], mold, level)))
    if not holes:
        return
    what = "a hole in a side wall" if len(holes) == 1 else f"{len(holes)} holes in side walls"
    width, place = holes[0]
    where = f"{width:.2g} m wide at {format_place(place @ turn)}"
    largest = "" if len(holes) == 1 else "the largest "
    remedy = "close it in the file, or let `jaxform new` cover it: it writes covers.stl"
    warn_of(f"has {what}, {largest}{where}: the sheet would be blown through it", remedy, key="mold", file=file)


def _region_before_mold(sheet: Array, mold: Array, level: float) -> Callable[[Array], Mask]:
    """A function that masks the places (n, 2) [m] at which a sheet (m, 3, 2) [m] has mold (k, 3, 3) [m] before it."""
    low, high = sheet.min((0, 1)), sheet.max((0, 1))
    pixel = float((high - low).max()) / _LEAKS_PIXELS
    width, height = (max(1, round(float(extent) / pixel)) for extent in high - low)
    covered, before = np.zeros(width * height, bool), np.zeros(width * height, bool)
    for _, inside, _ in raster.rasterize((sheet - low) / pixel, width, height):
        covered[inside] = True
    for _, inside, interpolate in raster.rasterize((mold[..., :2] - low) / pixel, width, height):
        before[inside[interpolate(mold[..., 2]) >= level]] = True
    region = (covered & before).reshape(height, width)

    def over(places: Array) -> Mask:
        column, row = np.floor((places - low) / pixel).astype(np.int64).T
        inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
        return inside & region[np.clip(row, 0, height - 1), np.clip(column, 0, width - 1)]

    return over


# Check for ribs and pins of a mold that are thinner than the elements of the sheet. On the host, before a run.


def warn_of_thin_features(scene: Scene, file: str = "") -> None:
    """Warns of the highest rib or pin of the mold that may pass between the nodes of a nearly flat sheet.

    With edge contact sides are held at it; what passes through the sheet even so is found after the run.
    """
    side = finest_side(scene)
    found = None if scene.tables.edges else thin_feature(scene, side)
    if found is None:
        return
    problem = (
        f"has a rib or pin at {format_place(found.place)} that is {found.height:.2g} m high and at most "
        f"{found.width:.2g} m wide, and elements have sides of {side:.2g} m: it may pass through the "
        "sheet between its nodes"
    )
    wanted, area = 0.5 * found.width, float(np.sum(np.asarray(scene.tables.sheet.area, float)))
    near = "refine near it ([refinement])" if scene.refinement is None else "raise refinement.base_level"
    remedies = (
        [] if scene.refinement is not None else ["set solver.edge_contact = true, which holds the sheet at edges"]
    )
    if wanted >= triangle_side(area, _AFFORDABLE):
        remedies.append(f"make the elements smaller (parison.element_size = {wanted:.1g})")
    remedy = ", ".join([*remedies, f"or {near}"]) if remedies else near
    warn_of(problem, remedy, key="mold", file=file)


def finest_side(scene: Scene) -> float:
    """The median of the elements' longest sides [m], as short as refinement near the mold makes them."""
    corners = np.asarray(scene.parison.positions, float)[np.asarray(scene.parison.triangles)]
    longest = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(1)
    levels = 0 if scene.refinement is None else int(scene.refinement.base_level)
    # Two bisections halve a side.
    return float(np.median(longest)) * 0.5 ** (0.5 * levels)


def thin_feature(scene: Scene, side: float) -> Ribs | None:
    """The highest rib or pin of the mold that is thinner than elements with sides of a length [m]; None without one."""
    seen = survey(scene)
    if scene.mold is None or not seen.faces:
        return None
    positions = np.asarray(scene.parison.positions, float)
    sheet = positions[np.asarray(scene.parison.triangles)]
    mold = np.asarray(scene.mold.vertices, float)[np.asarray(scene.mold.triangles)]
    clamped, rim = np.asarray(scene.parison.clamped), topology.boundary_edges(np.asarray(scene.parison.triangles))
    # Nodes of a rim may be far apart where elements are of different sizes.
    along = topology.edge_points(positions[rim[clamped[rim].all(1)]], side)
    held = np.concatenate([positions[clamped], along]).astype(float)
    return slender_feature(sheet, mold, seen.push / np.linalg.norm(seen.push), side, held)

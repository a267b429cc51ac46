"""Visible surfaces of parts, sheets and molds, with images in symmetry planes, and their color ranges."""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np
from numpy.typing import NDArray

from jaxform.io.canvas import TO_EYE, DrawnSurface, View
from jaxform.mesh import meshes, topology
from jaxform.model.scene import Scene
from jaxform.results import sections
from jaxform.results.part import restrict_to_part
from jaxform.results.result import Result
from jaxform.tools.mold import Mold
from jaxform.tools.search import split_long_triangles

Array = NDArray[np.float64]

SHEET = "#5b9bd5"
MOLD_COLOR = "#606060"  # of its lines
_GREY, _MOLD_SHARE = 0.62, 0.55  # of the mold, and how much of it the paper lets through
_COVER_SHARE, _SHEET_SHARE = 0.15, 0.5  # the same of covers of its holes; and of a sheet over it, before the run
_TOOL_SHARE = 0.3  # the same of tools besides the mold
_TOOL_COLORS = ("#b5651d", "#7b4fa3", "#2e8b57", "#c2185b")
_MOLD_LINES = 2000  # triangles, above which a mold's outline is not drawn
_MOLD_PIECES = 20  # of its size, along a large triangle of the mold
_FLAT = 1e-3  # of the sheet's size: one that is as flat has a side that faces the mold
_FACING = 0.05  # of its area, the least by which a curved sheet faces along z
_TOO_LARGE = 2.5  # times as large as the part, a mold is left out


def part_view(
    scene: Scene, result: Result, scale: tuple[float, float], *, edges: bool = False, mark: Any = None
) -> View:
    """The part in colours of its wall, with the cut-off sheet and the mold behind it in grey.

    Args:
        scene: The simulated scene.
        result: The part, of used nodes and elements alone.
        scale: Range of the colours [mm].
        edges: Draw the elements' edges.
        mark: A place (3,) [m] to mark as the minimum, or None.
    """
    corners = 1e3 * np.asarray(result.positions, float)[np.asarray(scene.parison.triangles)]
    images = [1e3 * image for image in mirror_points(scene, corners / 1e3, open_front=True)]
    wall = 1e3 * np.asarray(result.element_thickness, float)
    in_part = np.asarray(restrict_to_part(result, scene)[0].used)
    wall = np.tile(np.where(in_part, wall, np.nan), len(images))
    part = DrawnSurface(np.concatenate(images), wall, edges=edges)
    mold, outline = _mold(scene, part.faces)
    place = None if mark is None else 1e3 * np.asarray(mark)
    turned, hangs = not sections.symmetry_planes(scene), _hangs(scene, result)
    behind, before = _tools(scene, part.faces, hangs, _TOOL_SHARE)
    return View([*mold, *behind, part, *before], outline, hangs, turned, scale, place)


def sheet_view(scene: Scene, covers: NDArray[np.bool_] | None = None) -> View:
    """The sheet before the first step, with the mold in grey behind it; one sees through both.

    Args:
        scene: The scene.
        covers: Mask (n_triangle,) of the mold's triangles that cover its holes, which hardly show; None without any.
    """
    corners = np.asarray(scene.parison.positions, float)[np.asarray(scene.parison.triangles)]
    faces = 1e3 * np.concatenate(mirror_points(scene, corners))
    paint = np.array([*bytes.fromhex(SHEET[1:])]) / 255
    sheet = DrawnSurface(faces, np.tile(paint, (len(faces), 1)), opaque=_SHEET_SHARE, edges=True)
    mold, outline = _mold(scene, faces, whole=True)
    if covers is not None and mold:
        mold = _split_covers(mold[0], covers)
    hangs = hangs_before(scene)
    behind, before = _tools(scene, faces, hangs, _SHEET_SHARE)
    return View([*mold, *behind, sheet, *before], outline, hangs, hangs)


def _split_covers(mold: DrawnSurface, covers: NDArray[np.bool_]) -> list[DrawnSurface]:
    """The mold (n, 3, 3) without its covers, and these, of which a mask (n_triangle,) says where they are."""
    images = np.tile(covers, len(mold.faces) // len(covers))
    parts = ((~images, mold.opaque), (images, _COVER_SHARE))
    return [mold._replace(faces=mold.faces[some], paint=mold.paint[some], opaque=share) for some, share in parts]


def hangs_before(scene: Scene) -> bool:
    """True if a sheet before the run is drawn with z down: a flat one over its tools, a preform with its neck on top.

    A cavity opens upwards then, a buck is below the sheet, and a plug above.
    """
    flat = bool(scene.surfaces) and is_flat(scene)
    return _push_along_z(scene) > (0.0 if flat else _FACING if scene.motion is not None or scene.tools else 1.0)


def is_flat(scene: Scene) -> bool:
    """True if the initial sheet lies in a plane z = const, or nearly."""
    start = np.asarray(scene.parison.positions, float)
    return bool(np.ptp(start[:, 2]) <= _FLAT * np.ptp(start, axis=0).max())


def _push_along_z(scene: Scene) -> float:
    """Direction in which the strongest pressure pushes the initial sheet: 1 along +z, -1 along -z, 0 of a tube."""
    corners = np.asarray(scene.parison.positions, float), np.asarray(scene.parison.triangles)
    normals = topology.doubled_normals(*corners)
    share = normals[:, 2].sum() / np.linalg.norm(normals, axis=1).sum()
    return float(share * np.sign(scene.strongest_push()))


def mirror_points(scene: Scene, points: Array, open_front: bool = False) -> list[Array]:
    """The points (..., 3) and their images in the symmetry planes, so that the whole part is seen.

    Args:
        scene: The scene, which knows the planes.
        points: Points in the modelled part.
        open_front: Leave one image out where there are four, for a look inside.
    """
    planes = sections.symmetry_planes(scene)
    images = []
    for flips in itertools.product((False, True), repeat=len(planes)):
        image = np.array(points)
        for (axis, place), flip in zip(planes.items(), flips, strict=True):
            if flip:
                image = meshes.mirror_image(image, axis, place)
        images.append(image)
    if not open_front or len(images) != 4:
        return images
    front = int(np.argmax([image.reshape(-1, 3).mean(0) @ TO_EYE for image in images]))
    return [image for k, image in enumerate(images) if k != front]


def _hangs(scene: Scene, result: Result) -> bool:
    """True if the part is drawn with z down: seen from the initial side of the sheet, in front of the mold.

    The view is into a cavity, or onto a buck. A freely inflated sheet stands up, unless it is cut open.
    """
    start = np.asarray(scene.parison.positions, float)
    rise = (np.asarray(result.positions, float) - start)[:, 2].mean()
    if scene.surfaces and is_flat(scene):
        along = _push_along_z(scene)
        return along > 0 if along else bool(rise < 0)
    return bool(np.asarray(scene.parison.clamped).any() and rise > 0 and sections.symmetry_planes(scene))


def _mold(scene: Scene, part: Array, whole: bool = False) -> tuple[list[DrawnSurface], Array | None]:
    """The mold and its outline behind a part (n, 3, 3) [mm], unless it is so large that nothing else would be seen."""
    if scene.mold is None or (_is_too_large(scene.mold, part) and not whole):
        return [], None
    vertices, triangles = np.asarray(scene.mold.vertices, float), np.asarray(scene.mold.triangles)
    walls, planes = vertices[triangles], sections.symmetry_planes(scene)
    crosses = _crosses_planes(scene, walls)
    opened = None
    if crosses and len(planes) == 2 and not whole:
        (one, at), (other, there) = planes.items()
        opened = (one, 1e3 * at), (other, 1e3 * there)
    images = [walls] if crosses else mirror_points(scene, walls, open_front=not whole)
    faces = 1e3 * np.concatenate(images)
    if opened is not None:
        faces = split_long_triangles(faces, _size(scene.mold) / _MOLD_PIECES)[0]
    outline = None
    if opened is None and len(triangles) <= _MOLD_LINES:
        outline = _outline(scene, vertices, triangles, crosses)
    return [DrawnSurface(faces, np.full((len(faces), 3), _GREY), _MOLD_SHARE, open_at=opened)], outline


def _size(tool: Mold) -> float:
    """Longest side of the box of a mold or tool [mm]."""
    used = np.asarray(tool.vertices, float)[np.unique(np.asarray(tool.triangles))]
    return 1e3 * float(np.ptp(used, axis=0).max())


def _is_too_large(tool: Mold, part: Array) -> bool:
    """True if of a part (n, 3, 3) [mm] nothing would be seen beside a mold or tool."""
    return _size(tool) > _TOO_LARGE * float(np.ptp(part, axis=(0, 1)).max())


def _crosses_planes(scene: Scene, walls: Array) -> bool:
    """True if triangles (n, 3, 3) [m] of a mold or tool lie on both sides of all symmetry planes: it is a whole one."""
    tolerance = 1e-6 * float(np.ptp(walls, axis=(0, 1)).max())
    return all(
        walls[..., k].min() < level - tolerance and walls[..., k].max() > level + tolerance
        for k, level in sections.symmetry_planes(scene).items()
    )


def tool_faces(scene: Scene, tool: Mold, shift: Array | float = 0.0) -> Array:
    """The triangles (n, 3, 3) [m] of a tool that has moved by a shift (3,) [m], unless it is whole with their images.

    The images in symmetry planes move as such: towards the tool where it moves towards the plane.
    """
    walls = np.asarray(tool.vertices, float)[np.asarray(tool.triangles)]
    moved = walls + shift
    return moved if _crosses_planes(scene, walls) else np.concatenate(mirror_points(scene, moved))


def _tools(scene: Scene, part: Array, hangs: bool, share: float) -> tuple[list[DrawnSurface], list[DrawnSurface]]:
    """The tools besides the mold behind a part (n, 3, 3) [mm], and those in front of it, which let it show through."""
    behind: list[DrawnSurface] = []
    before: list[DrawnSurface] = []
    low, high = part[..., 2].min(), part[..., 2].max()
    for tool, color in zip(scene.tools, tool_colors(len(scene.tools)), strict=True):
        if _is_too_large(tool, part):
            continue
        faces = 1e3 * tool_faces(scene, tool)
        paint = np.tile(np.array([*bytes.fromhex(color[1:])]) / 255, (len(faces), 1))
        # It is in front where it stands out of the part towards the eye, as a plug does out of a cup.
        below, above = low - faces[..., 2].min(), faces[..., 2].max() - high
        towards, away = (below, above) if hangs else (above, below)
        (before if towards > max(away, 0.0) else behind).append(DrawnSurface(faces, paint, share))
    return behind, before


def tool_colors(count: int) -> list[str]:
    """Colours of tools besides the mold, in all pictures."""
    return [_TOOL_COLORS[k % len(_TOOL_COLORS)] for k in range(count)]


def _outline(scene: Scene, vertices: Array, triangles: NDArray[Any], crosses: bool) -> Array:
    """The mold's sharp and free edges (n, 2, 3) [mm]."""
    lines = np.asarray(topology.feature_edges(vertices, triangles), np.float64)
    return 1e3 * np.concatenate([lines] if crosses else mirror_points(scene, lines, open_front=True))


# Ranges of colours for many numbers, and the points that the eye tells apart, for pictures and the report.

_FINENESS = 500  # points that the eye tells apart along a side of a diagram
_GROUPS, _ACROSS = 40, 0.02  # of nodes along the sheet; of its variance, what a field has within these at least
_MOVED = 0.02  # of the farthest way an element went: one that went less was not formed
_MOST = 0.98  # of the formed area, the colours tell apart; the thickest have one colour


def formed_elements(start: Array, end: Array, triangles: NDArray[np.integer]) -> NDArray[np.bool_]:
    """Mask of the elements (n,) that were formed, unlike a flange that stayed flat; all where none moved.

    Args:
        start: Initial positions (n_node, 3) [m].
        end: Final positions (n_node, 3) [m].
        triangles: Node numbers of the elements (n, 3).
    """
    way = np.linalg.norm((end - start)[triangles].mean(1), axis=1)
    moved = way >= _MOVED * way.max(initial=0.0)
    return moved | (not moved.any())


def counted_elements(
    start: Array, end: Array, triangles: NDArray[np.integer], part: NDArray[Any] | None
) -> NDArray[np.bool_]:
    """Mask like `formed_elements`, within a part's mask (n,) if given; the whole part where none of it moved."""
    formed = formed_elements(start, end, triangles)
    if part is None or not np.any(part):
        return formed
    in_part = np.asarray(part) != 0
    return formed & in_part if (formed & in_part).any() else in_part


def color_range(values: Array, area: Array, most: float = _MOST) -> tuple[float, float]:
    """Range that colours show, of values (n,) and their areas: from the least to one that most of the area is below."""
    order = np.argsort(values)
    share = np.cumsum(area[order]) / area.sum()
    last = min(int(np.searchsorted(share, most)), len(values) - 1)
    low, high = float(values.min()), float(values[order[last]])
    margin = 0.05 * max(abs(low), abs(high))
    return (low, high) if high - low > 0.02 * margin else (low - margin, high + margin)


def distinguishable_points(across: Array, up: Array) -> NDArray[np.int64]:
    """Indices of the points to draw, out of many: one in each place that the eye can distinguish."""
    cells = [np.round(_FINENESS * (x - x.min()) / (np.ptp(x) or 1.0)).astype(np.int64) for x in (across, up)]
    return np.unique(cells[0] * (_FINENESS + 1) + cells[1], return_index=True)[1]


def varies_across(place: Array, values: Array) -> bool:
    """True if values (n,) differ between nodes at nearly the same place (n,) along a sheet, as those of a field do."""
    left = []
    for group in _groups_along(place):
        along, own = place[group] - place[group].mean(), values[group] - values[group].mean()
        # A change that is even along the sheet is no difference across it.
        left.append(own - along * (along @ own) / max(float(along @ along), np.finfo(float).tiny))
    return bool(np.var(np.concatenate(left)) > _ACROSS * np.var(values))


def _groups_along(place: Array) -> list[NDArray[np.intp]]:
    """The numbers of nodes at nearly the same place (n,) along a sheet, group by group."""
    return np.array_split(np.argsort(place), max(1, min(_GROUPS, len(place) // 8)))


# Maps of the initial sheet: places of its nodes in a plane.

_TURNED = 0.01  # of what is drawn of a sheet, the most that may be turned over: else some of it hides behind the rest
_SEEN = 0.8  # of its area, the least that is seen of a sheet that is not unrolled
_AT_AXIS = 0.01  # of the largest distance from an axis: nodes that are nearer have no angle about it
_ROUND = 360.0  # degrees


def map_sheet(scene: Scene) -> tuple[Array, NDArray[np.int64], NDArray[np.int64], list[str]]:
    """The initial sheet in a plane: seen along its shortest side or, as a tube, unrolled about its longest.

    An unrolled sheet is drawn over the angle. Elements that lie across an angle of 180 degrees are there at both ends,
    and a node at the axis has an angle for each of its elements.

    Returns:
        Places (n, 2) [mm, or mm and degrees], the node (n,) at each, triangles (m, 3) of places, and labels of the
        axes.
    """
    start, triangles = np.asarray(scene.parison.positions, float), np.asarray(scene.parison.triangles, np.int64)
    order = np.argsort(np.ptp(start, axis=0))
    shown, along, across = np.sort(order[1:]), int(order[-1]), np.sort(order[:-1])
    seen, area = _signed_areas(start[:, shown], triangles), topology.doubled_normals(start, triangles)
    angles = _corner_angles(start[:, across] - [sections.middle_of(scene, int(axis)) for axis in across], triangles)
    unrolled = np.stack([1e3 * start[triangles, along], angles], axis=2)
    corners = np.arange(triangles.size).reshape(-1, 3)
    whole = np.abs(seen).sum() >= _SEEN * np.linalg.norm(area, axis=1).sum()
    if (whole and not _overlaps(seen)) or _overlaps(_signed_areas(unrolled.reshape(-1, 2), corners)):
        labels = [f"{'xyz'[axis]} [mm]" for axis in shown]
        return 1e3 * start[:, shown], np.arange(len(start)), triangles, labels
    over, under = (angles > 0.5 * _ROUND).any(1), (angles < -0.5 * _ROUND).any(1)
    turn = np.array([0.0, _ROUND])
    places = np.concatenate([unrolled, unrolled[over] - turn, unrolled[under] + turn]).reshape(-1, 2)
    node = np.concatenate([triangles, triangles[over], triangles[under]]).ravel()
    labels = [f"{'xyz'[along]} [mm]", f"angle about {'xyz'[along]} [degrees]"]
    return places, node, np.arange(len(node)).reshape(-1, 3), labels


def _signed_areas(places: Array, triangles: NDArray[np.int64]) -> Array:
    """Doubled areas (m,) of triangles (m, 3) of places (n, 2), negative where they turn to the right."""
    one, other = (places[triangles[:, k]] - places[triangles[:, 0]] for k in (1, 2))
    return one[:, 0] * other[:, 1] - one[:, 1] * other[:, 0]


def _overlaps(areas: Array) -> bool:
    """True where triangles of signed areas (m,), drawn in a plane, lie over one another."""
    turned = min(np.maximum(areas, 0.0).sum(), np.maximum(-areas, 0.0).sum())
    return bool(turned > _TURNED * np.abs(areas).sum())


def _corner_angles(away: Array, triangles: NDArray[np.int64]) -> Array:
    """Angles (m, 3) [degrees] of the corners of triangles, from nodes' vectors (n, 2) away from an axis.

    Those of a triangle are near to one another, also where that leads beyond 180 degrees.
    """
    distance = np.linalg.norm(away, axis=1)
    angle = np.degrees(np.arctan2(away[:, 1], away[:, 0]))
    corners = np.where(distance[triangles] > _AT_AXIS * distance.max(), angle[triangles], np.nan)
    known = np.take_along_axis(corners, np.isnan(corners).argmin(1)[:, None], axis=1)
    corners = known + (corners - known + 0.5 * _ROUND) % _ROUND - 0.5 * _ROUND  # of an element across 180 degrees
    there = ~np.isnan(corners)
    mean = np.where(there, corners, 0.0).sum(1) / np.maximum(there.sum(1), 1)
    return np.where(there, corners, mean[:, None])


def draw_map(axes: Any, scene: Scene, values: Array, **colors: Any) -> Any:
    """Draws values (n_node,) over the initial sheet in a plane, labels the axes, and returns what has the colours."""
    places, node, triangles, labels = map_sheet(scene)
    drawn = axes.tripcolor(*places.T, triangles, values[node], shading="gouraud", **colors)
    axes.set(xlabel=labels[0], ylabel=labels[1], aspect="equal" if len(node) == len(values) else "auto")
    if len(node) != len(values):
        axes.set(ylim=angle_range(places))
    axes.grid(False)
    return drawn


def angle_range(places: Array) -> list[float]:
    """The least and the largest angle [degrees] that is shown of an unrolled sheet (n, 2): one turn at most."""
    return [max(float(places[:, 1].min()), -0.5 * _ROUND), min(float(places[:, 1].max()), 0.5 * _ROUND)]

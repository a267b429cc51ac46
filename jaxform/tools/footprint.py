"""The planform of the sheet over a mold's opening, and the sheet itself in the plane of the rim. On the host."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from jaxform.core.errors import InputError
from jaxform.mesh import meshes, outlines, shapes, topology
from jaxform.mesh.meshes import Mesh
from jaxform.mesh.outlines import Circle, OrientedRectangle
from jaxform.mesh.shapes import Sheet
from jaxform.tools import opening
from jaxform.tools.opening import Heights, Opening

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
Integers = NDArray[np.integer]

_MARGIN = 0.03  # of the opening's width, that the sheet reaches over its edge, where there is a flange
_BARE = 2.5  # pixels: a flange that is narrower is none
_FULL = 0.75  # of a disc or rectangle, that must be opening
_ROUND, _SQUARE = 0.95, 0.998  # the same where there is no flange to lie on
_WITHIN = 0.998  # of a disc or rectangle, that must lie on the mold
_BRIDGE = 0.06  # of the opening's width, half of what parts two pockets of one opening
_SIMPLER = 0.5  # pixels, that an outline may be off
_ALIKE = 0.03  # of the area, by which a rim's polygon may differ from the visible outline


Planform = Circle | OrientedRectangle | Array
"""A sheet's planform in the plane of the view [m]: a disc, a rectangle, or corners (k, 2) counter-clockwise."""


def planform_polygon(planform: Planform) -> Array:
    """The corners (k, 2) [m] of a planform, counter-clockwise."""
    if isinstance(planform, Circle):
        angle = 2 * np.pi * np.arange(180) / 180
        return planform.center + planform.radius * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    if isinstance(planform, OrientedRectangle):
        share = np.array([[0, 0], [1, 0], [1, 1], [0, 1]])
        return planform.corner + share * planform.sides @ planform.axes
    return planform


def fit_planform(found: Opening, vertices: Array, triangles: Integers) -> tuple[Planform, bool]:
    """The planform of a sheet that covers an opening: a disc or rectangle where one fits, else an outline.

    Args:
        found: The opening.
        vertices: Vertices of the mold (n, 3) [m], not rotated.
        triangles: Vertex numbers (m, 3).

    Returns:
        The planform, and whether it is in contact with the mold all round, beyond the opening: it lies on a flange.

    Raises:
        InputError: The opening has no outline that a sheet can have.
    """
    points, flange = _edge_points(found, vertices), _has_flange(found)
    width = float(np.ptp(points, axis=0).min())
    full = outlines.close_gaps(found.cavity, _BRIDGE * width / found.view.pixel).sum() * found.view.pixel**2
    corners, view = outlines.hull(points), found.view
    margins = _margins(width, view.pixel) if flange else []
    if flange and not _is_connected(_rim_levels(found, points) > 0):
        full = max(full, outlines.area(corners))  # the sheet lies between pockets, too
    for fit in (_disc, _rectangle):
        shape = fit(corners, full, margins, view)
        if shape is not None:
            return shape, flange
    return _outline(points, found, vertices, triangles), flange


def outline(found: Opening, vertices: Array, triangles: Integers) -> Array:
    """The outline of an opening (k, 2) [m], whatever its shape, counter-clockwise in the plane of the view.

    Args:
        found: The opening.
        vertices: Vertices of the mold (n, 3) [m], not rotated.
        triangles: Vertex numbers (m, 3).

    Raises:
        InputError: The opening has no outline that a sheet can have.
    """
    return _outline(_edge_points(found, vertices), found, vertices, triangles)


def _has_flange(found: Opening) -> bool:
    """True when the mold reaches beyond the opening all round."""
    return not found.male and bool(outlines.distance(found.view.inside)[found.cavity].min() > _BARE)


def _edge_points(found: Opening, vertices: Array) -> Array:
    """Points (n, 2) [m] of which the hull is that of the opening."""
    view = found.view
    turned = vertices @ view.turn.T
    # Where the mesh has corners on the opening's edge, they say better than pixels where it is.
    level = turned[np.abs(turned[:, 2] - found.base) <= 2 * view.pixel, :2]
    column, row = np.clip((level - view.low) / view.pixel, 0, np.array(view.inside.shape[::-1]) - 1).astype(int).T
    exact = level[outlines.distance(~found.cavity)[row, column] <= 2]
    points = view.places(found.cavity)
    if len(exact) >= 3 and _hull_area(exact) > 0.97 * _hull_area(points):
        points = exact
    return points


def _hull_area(points: Array) -> float:
    spread = np.linalg.svd(points - points.mean(0), compute_uv=False)
    return outlines.area(outlines.hull(points)) if spread[1] > 1e-9 * spread[0] else 0.0


def _lies_on(view: Heights, planform: Planform) -> bool:
    """True when a planform lies on the mold."""
    wanted = view.inside_polygon(planform_polygon(planform))
    return bool(wanted.sum() and (wanted & view.inside).sum() >= _WITHIN * wanted.sum())


def _disc(corners: Array, full: float, margins: list[float], view: Heights) -> Circle | None:
    """A disc around a convex polygon (k, 2) [m] of which an area [m^2] is opening, with a margin if there are any."""
    around = outlines.smallest_circle(corners)
    if not margins:
        middles = 0.5 * (corners + np.roll(corners, -1, axis=0))
        inner = float(np.linalg.norm(middles - around.center, axis=1).min())
        round_enough = inner >= _ROUND * around.radius and full >= 0.9 * np.pi * inner**2
        return Circle(around.center, inner) if round_enough else None
    for margin in margins:
        disc = Circle(around.center, around.radius + margin)
        if full >= _FULL * np.pi * around.radius**2 and _lies_on(view, disc):
            return disc
    return None


def _rectangle(corners: Array, full: float, margins: list[float], view: Heights) -> OrientedRectangle | None:
    """A rectangle like `_disc`."""
    around = outlines.smallest_rectangle(corners)
    area = float(np.prod(around.sides))
    if not margins:
        square = outlines.area(corners) >= _SQUARE * area and full >= 0.97 * area
        return around if square else None
    for margin in margins:
        if full >= _FULL * area and _lies_on(view, around.enlarge(margin)):
            return around.enlarge(margin)
    return None


def _margins(width: float, pixel: float) -> list[float]:
    """Margins [m] to try, for an opening of a width [m] seen in pixels of a side [m]."""
    most = max(_MARGIN * width, 2 * pixel)
    return [most, 0.5 * most, 0.25 * most]


def _outline(points: Array, found: Opening, vertices: Array, triangles: Integers) -> Array:
    view = found.view
    rim = None if _has_flange(found) else _rim(found, vertices, triangles)
    if rim is not None:
        return rim
    values = _rim_levels(found, points)
    if not _is_connected(values > 0):
        values = _rim_levels(found, points, view.inside_polygon(outlines.hull(view.places(found.cavity))))
    polygon = outlines.contour(values, view.low, view.pixel)
    return _simplify(polygon, _SIMPLER * view.pixel)


def _rim_levels(found: Opening, points: Array, within: Mask | None = None) -> Array:
    """Distance [pixels] of each pixel within the outline of a sheet over an opening, or a mask, from that outline."""
    view = found.view
    margin = max(_MARGIN * float(np.ptp(points, axis=0).min()) / view.pixel, 2.0)
    covered = found.cavity if within is None else within
    return np.minimum(outlines.distance(view.inside) - 1.0, margin + 0.5 - outlines.distance(~covered))


def _simplify(polygon: Array, tolerance: float) -> Array:
    kept = outlines.essential_corners(polygon, np.full(len(polygon), tolerance), np.zeros(len(polygon), bool))
    return outlines.clean(polygon[kept])


def _is_connected(mask: Mask) -> bool:
    return outlines.label_parts(mask)[1] == 1


def _rim(found: Opening, vertices: Array, triangles: Integers) -> Array | None:
    """The open rim that surrounds the visible part of a shell, or None where there is none."""
    view = found.view
    turned = vertices @ view.turn.T
    edges = topology.boundary_edges(triangles)
    wanted = view.inside.sum() * view.pixel**2
    for loop in _loops(edges):
        polygon = turned[loop][:, :2]
        if abs(abs(outlines.area(polygon)) - wanted) > _ALIKE * wanted:
            continue
        try:
            return _simplify(outlines.clean(polygon), 0.1 * _SIMPLER * view.pixel)
        except InputError:
            continue
    return None


def _loops(edges: Integers) -> list[Integers]:
    """The closed lines (k,) of nodes that edges (n, 2) make, where two of them meet in each node."""
    neighbours: dict[int, list[int]] = {}
    for a, b in edges.tolist():
        neighbours.setdefault(a, []).append(b)
        neighbours.setdefault(b, []).append(a)
    loops = []
    while neighbours:
        start = next(iter(neighbours))
        way, at = [start], neighbours.pop(start)[0]
        while at in neighbours:
            way.append(at)
            ahead = [node for node in neighbours.pop(at) if node in neighbours]
            at = ahead[0] if ahead else start
        loops.append(np.array(way))
    return loops


# A sheet over the opening of a mold, in the plane of its rim. On the host.

WELD = 1e-5
"""Distance, relative to a mold's size, within which corners are one in the search for openings."""


def weld_mold(vertices: Array, triangles: NDArray[np.integer]) -> Mesh:
    """A mold for the search for openings: pieces that meet are joined."""
    mold = Mesh(vertices, triangles.astype(np.int32))
    return meshes.drop_degenerate(meshes.weld(mold, WELD * meshes.size(vertices)))[0]


def sheet_over_opening(
    vertices: Array,
    triangles: NDArray[np.integer],
    *,
    element_size: float | None = None,
    elements: int | None = None,
) -> Sheet:
    """A sheet over the opening of a mold, with normals into the mold, clamped along its edge.

    Where the opening has a flange, the sheet reaches over it by a little.

    Args:
        vertices: The mold's (n, 3) [m].
        triangles: Vertex numbers (m, 3).
        element_size: Length of the sheet's edges [m]; or
        elements: About how many triangles.

    Raises:
        InputError: The mold has no opening, or a number is out of range.
    """
    mold = weld_mold(vertices, triangles)
    found = opening.find_opening(mold.positions, mold.triangles)
    if found.male:
        raise InputError("the mold has no opening: a plug protrudes from it", "give polygon", "parison.mold_rim")
    polygon = outline(found, mold.positions, mold.triangles)
    sheet = shapes.outline(polygon=polygon, element_size=element_size, elements=elements)
    turn, shift = found.view.turn, np.array([0.0, 0.0, found.level])
    flat = sheet.snap
    assert flat is not None

    def snap(middles: Array, ends: Array, boundary: NDArray[np.bool_]) -> Array:
        return (flat(middles @ turn.T - shift, ends @ turn.T - shift, boundary) + shift) @ turn

    return replace(sheet, positions=(sheet.positions + shift) @ turn, snap=snap)

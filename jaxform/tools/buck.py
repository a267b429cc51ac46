"""Male molds: pose, undercuts, and the sheet and platen around them. On the host."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from jaxform.core.errors import InputError
from jaxform.mesh import meshes, outlines, topology
from jaxform.mesh.meshes import Mesh
from jaxform.mesh.outlines import Circle, OrientedRectangle
from jaxform.tools import covers, molds, opening
from jaxform.tools.footprint import Planform, planform_polygon
from jaxform.tools.opening import Heights, ViewedSurface

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

_COARSE = 120  # pixels of the longer side, to compare sides
_ROUGH = 0.02  # of the mold's size: what counts as one height of a base that is not flat, as the back of a scan
_STANDS, _FOOT = 0.5, 0.1  # of the visible area, that the base should be, and that a flat one is at least
_SAME = 0.98  # cosine between sides that are one
_ALIKE = 0.97  # of the best score: as good
_UPRIGHT = 0.35  # of the best score, from which the side that the file has upwards is chosen
_WIDEST = 0.985  # of the visible area, that lies above the height at which a mold without a base is cut
_GROUND = 0.1  # of the visible area, that a platen is at least
_MIDDLE = (0.3, 0.9)  # of the height, between which a mold without a base is cut
_THICK = 0.4  # of the body's height, how thick a platen is at most
_DIRECTIONS = ["+z", "+y", "+x", "-z", "-y", "-x"]


@dataclass(frozen=True)
class Buck:
    """A male mold and its pose.

    Attributes:
        view: The mold viewed from the sheet: rotated so that pressure pushes to +z.
        direction: Unit vector (3,) from the base to the side from which the sheet comes, in the file's axes.
        base: Height of the platen [m], after turning.
        top: Height of the first place that the sheet meets [m], after turning; less than the base.
        body: Pixels (ny, nx) of what stands above the base.
        on_platen: True if the mold has a platen around the body.
        flat: True if it has a base; else the platen is where it is widest.
        others: Names of other sides from which the sheet may be meant to come.
    """

    view: Heights
    direction: Array
    base: float
    top: float
    body: Mask
    on_platen: bool
    flat: bool
    others: list[str]

    @property
    def height(self) -> float:
        """Height of the body above the platen [m]."""
        return self.base - self.top

    @property
    def volume(self) -> float:
        """Volume of the body and of the space hidden below it [m^3]."""
        return float((self.base - self.view.height[self.body]).sum()) * self.view.pixel**2


class _Stand(NamedTuple):
    """A direction (3,) in which a mold may stand, the area of its base [m^2], and its share of the visible area.

    The base may be rough; `foot` is the flat share of it.
    """

    direction: Array
    area: float
    share: float
    foot: float

    @property
    def score(self) -> float:
        return self.area * self.share**2


def parse_direction(text: str) -> Array:
    """The unit vector (3,) that a text names: +x, -x, ..., +z, -z, or three numbers with commas.

    Raises:
        InputError: It is neither.
    """
    name = text.strip().lower()
    if len(name.lstrip("+-")) == 1 and name.lstrip("+-") in "xyz":
        unit = np.zeros(3)
        unit["xyz".index(name[-1])] = -1.0 if name[0] == "-" else 1.0
        return unit
    try:
        vector = np.array([float(part) for part in name.split(",")])
    except ValueError:
        vector = np.zeros(0)
    length = float(np.linalg.norm(vector))
    if vector.shape != (3,) or not np.isfinite(length) or length == 0:
        remedy = "give +x, -x, +y, -y, +z, -z or three numbers, such as --direction=0,0.5,1"
        raise InputError("is not a direction", remedy, "--direction", text)
    return vector / length


def direction_name(direction: Array) -> str:
    """A direction (3,) as --direction takes it."""
    axis = int(np.argmax(np.abs(direction)))
    if abs(direction[axis]) > 1 - 1e-6:
        return f"{'-' if direction[axis] < 0 else '+'}{'xyz'[axis]}"
    return ",".join(f"{float(x) + 0.0:.3g}" for x in np.round(direction, 3))


def find_buck(mold: Mesh, direction: Array | None = None) -> Buck:
    """Finds the pose of a male mold.

    Args:
        mold: Welded.
        direction: Unit vector (3,) to the side from which the sheet comes, in the file's axes; found by default.

    Raises:
        InputError: Nothing stands above a base.
    """
    surface, size = opening.make_viewed_surface(mold.positions, mold.triangles), meshes.size(mold.positions)
    stands = [_stand(surface, one, size) for one in ([direction] if direction is not None else directions(mold))]
    chosen, is_open = _choose_stand(stands), covers.find_rims(mold)
    if direction is None and chosen.share < _STANDS and is_open is not None:
        chosen = _stand(surface, covers.outward_direction(mold, is_open), size)
    others = [] if direction is not None else _other_directions(stands, chosen)
    return _place_mold(surface, chosen, size, others, is_open is not None)


def directions(mold: Mesh) -> list[Array]:
    """The directions (3,) in which a mold may stand: axes, then normals of flat faces and open rims, both ways."""
    chosen = [parse_direction(name) for name in _DIRECTIONS]
    for one in opening.plane_normals(mold.positions, mold.triangles):
        for signed in (one, -one):
            if max(float(signed @ other) for other in chosen) < 1 - 1e-6:
                chosen.append(signed)
    return chosen


def _stand(surface: ViewedSurface, direction: Array, size: float) -> _Stand:
    below = opening.view_heights(surface, opening.rotation_to_z(direction), _COARSE)
    lowest, seen = float(below.height.min()), float(below.inside.sum())
    foot, rough = (
        float(outlines.fill_holes(below.height <= lowest + tolerance * size).sum()) / seen
        for tolerance in (opening.FLAT, _ROUGH)
    )
    share = foot if foot >= _STANDS else rough
    return _Stand(direction, share * seen * below.pixel**2, share, foot)


def _choose_stand(stands: list[_Stand]) -> _Stand:
    """The side with the largest base that hides least; of those alike the first; upright as in the file, if it can."""
    good = [stand for stand in stands if stand.share >= _STANDS] or [stand for stand in stands if stand.foot >= _FOOT]
    if not good:
        # No base: on its side, so that most of it is visible.
        largest = max(stand.area / max(stand.share, 1e-9) for stand in stands)
        return next(s for s in stands if s.area / max(s.share, 1e-9) >= 0.9 * largest)
    best = max(stand.score for stand in good)
    upright = [stand for stand in good if stand.direction[2] > 1 - 1e-9 and stand.share > 0.95]
    if upright and upright[0].score >= _UPRIGHT * best:
        return upright[0]
    return next(stand for stand in good if stand.score >= _ALIKE * best)


def _other_directions(stands: list[_Stand], chosen: _Stand) -> list[str]:
    """Names of other sides that are as good, or better but not upright."""
    if chosen.share < _STANDS:
        return []
    least = _ALIKE * chosen.score
    alike = [chosen]
    for stand in stands:
        if stand.score >= least and max(float(stand.direction @ one.direction) for one in alike) < _SAME:
            alike.append(stand)
    return [direction_name(stand.direction) for stand in alike[1:6]]


def _place_mold(surface: ViewedSurface, stand: _Stand, size: float, others: list[str], is_open: bool) -> Buck:
    """The mold in the pose of a stand; an open surface ends above its base, whatever its rim is like."""
    view = opening.view_heights(surface, opening.rotation_to_z(-stand.direction), opening.FINE)
    tolerance = opening.FLAT * size
    level, share = view.edge_level(tolerance)
    ground = np.abs(view.height - level) <= tolerance
    body = view.inside & (view.height < level - tolerance)
    vertices, _, _ = surface
    lowest = float((vertices @ view.turn[2]).max())
    on_platen = share >= opening.RIM and body.any() and ground.sum() >= _GROUND * view.inside.sum()
    # A thick plate is the lower part of a stepped body.
    on_platen = bool(on_platen) and lowest - level <= _THICK * (level - float(view.height.min()))
    top, widest = float(view.height.min()), float(np.quantile(view.height[np.isfinite(view.height)], _WIDEST))
    # A body that is round below is cut where it is widest; one that widens upwards, or ends in a rough back, stands on
    # its end.
    low, high = (top + share * (lowest - top) for share in _MIDDLE)
    middle = low < widest < high
    flat = is_open or stand.foot >= _STANDS or not middle
    base = lowest
    if on_platen:
        base, flat = level, True
    elif not flat:
        base = widest
    if base - top <= tolerance:
        problem = f"the mold does not rise above a base as seen from {direction_name(stand.direction)}"
        remedy = "give another --direction, or --cavity where the sheet goes into a hollow"
        raise InputError(problem, remedy)
    body = view.inside & (view.height < base - tolerance)
    return Buck(view, stand.direction, base, top, body, on_platen, flat, others)


# Undercuts of a male mold: surfaces that are hidden from a sheet that comes from one side. On the host.

_LEVELS = 24
_SEEN = 3.0  # pixels: less is no undercut
_PIXELS = 480  # of the longer side


def deepest_undercut(buck: Buck, mold: Mesh) -> tuple[float, Array] | None:
    """The deepest undercut above the platen, where the mold recedes farthest below an overhang; None without one.

    Args:
        buck: The mold in its pose.
        mold: The mold (n, 3) [m], not turned, its rims closed.

    Returns:
        Its depth, sideways [m], and its place (3,) [m], in the file's axes.
    """
    turn = buck.view.turn
    corners = (mold.positions @ turn.T)[mold.triangles]
    view = opening.view_heights(opening.make_viewed_surface(mold.positions, mold.triangles), turn, _PIXELS)
    found = [_undercut_at(level, corners, view) for level in np.linspace(buck.top, buck.base, _LEVELS + 2)[1:-1]]
    depth, place = max(found, key=lambda one: one[0])
    return None if depth < _SEEN * view.pixel else (depth, place @ turn)


def _undercut_at(level: float, corners: Array, view: opening.Heights) -> tuple[float, Array]:
    """The depth [m] of the deepest undercut at a height [m], and its place (3,) [m] after turning."""
    wall = _section(level, corners, view)
    part, _ = outlines.label_parts(~wall)
    shadow = view.height < level - 0.5 * view.pixel
    depth = np.where((part == part[0, 0]) & ~wall, outlines.distance(shadow), 0.0)
    row, column = np.unravel_index(int(np.argmax(depth)), depth.shape)
    place = view.low + view.pixel * (np.array([column, row]) + 0.5)
    return float(depth[row, column]) * view.pixel, np.append(place, level)


def _section(level: float, corners: Array, view: opening.Heights) -> Mask:
    """The pixels (ny, nx) through which the surface passes at a height [m]."""
    # A level that meets corners exactly is moved off them.
    rise = corners[..., 2] - level
    rise = np.where(rise == 0, 1e-12 * view.pixel, rise)
    cut = corners[(rise.min(1) < 0) & (rise.max(1) > 0)]
    rise = rise[(rise.min(1) < 0) & (rise.max(1) > 0)]
    following = np.roll(rise, -1, axis=1)
    crossed = (rise < 0) != (following < 0)
    share = np.where(crossed, rise / np.where(crossed, rise - following, 1.0), 0.0)[..., None]
    points = cut + share * (np.roll(cut, -1, axis=1) - cut)
    # Two of the three sides of each are crossed.
    ends = points[crossed].reshape(-1, 2, 3)
    along = topology.edge_points(ends, view.pixel)
    wall = np.zeros(view.inside.shape, bool)
    column, row = np.floor((along[:, :2] - view.low) / view.pixel).astype(int).T
    wall[row, column] = True
    return wall


# The sheet and the platen around a male mold. On the host.

_ROUND = 0.9  # of the smallest circle round the body, that the body covers: the sheet is a disc
_STEEP = 0.5  # of what a body is higher than wide, by which the margin grows
_LEAST = 0.15  # of the body's width, the least margin
_NARROWER = (1.0, 0.85, 0.7, 0.6, 0.5, 0.4, 0.3, 0.25, 0.2)  # of the margin, that a platen of the mold's own may have
_NARROW, _INSET = 0.6, 0.01  # of the margin, below which the sheet covers the whole platen; less so much of its width
_WITHIN = 0.995  # of the sheet, that lies before a platen of the mold's own
_BEYOND = 0.03  # of the sheet's width, by which a platen reaches beyond the sheet
_RINGS, _SECTORS, _CELLS = 12, 72, 24  # of a platen's mesh: gaps are measured at its nodes


def fit_sheet(buck: Buck) -> tuple[Planform, float, Mesh | None]:
    """The sheet for a male mold, a disc or a rectangle with a margin of about the body's height, and the platen.

    Returns:
        The planform of the sheet, in the plane of the view; the distance from the body to the frame [m]; and the
        surface to be added around the body, as the mold's file has it [m], None where the mold has its own.
    """
    body = _around(buck)
    wide = 2 * body.radius if isinstance(body, Circle) else float(body.sides.min())
    height = buck.height
    margin = max(min(height, wide + _STEEP * max(height - wide, 0.0)), _LEAST * wide)
    if buck.on_platen:
        for share in _NARROWER:
            planform = _enlarge(body, share * margin)
            if _lies_before(planform, buck):
                return _platen_planform(planform, share, buck), share * margin, None
    planform = _enlarge(body, margin)
    mesh = _mesh(planform)
    turned = np.column_stack([mesh.positions[:, :2], np.full(len(mesh.positions), buck.base)])
    return planform, margin, Mesh(turned @ buck.view.turn, mesh.triangles)


def _lies_before(planform: Planform, buck: Buck) -> bool:
    """True when a sheet lies before the mold."""
    # Pixels outside of the view count too.
    polygon = planform_polygon(planform)
    wanted = abs(outlines.area(polygon)) / buck.view.pixel**2
    return bool((buck.view.inside_polygon(polygon) & buck.view.inside).sum() >= _WITHIN * wanted)


def _platen_planform(planform: Planform, share: float, buck: Buck) -> Planform:
    """The sheet over all of a platen that is narrow beside the body; else the one that there is."""
    corners = outlines.hull(buck.view.places(buck.view.inside))
    around = outlines.smallest_rectangle(corners)
    whole = around.enlarge(-_INSET * float(around.sides.min()))
    return whole if share < _NARROW and _lies_before(whole, buck) else planform


def _around(buck: Buck) -> Circle | OrientedRectangle:
    corners = outlines.hull(buck.view.places(outlines.fill_holes(buck.body)))
    circle = outlines.smallest_circle(corners)
    if abs(outlines.area(corners)) >= _ROUND * np.pi * circle.radius**2:
        return circle
    return outlines.smallest_rectangle(corners)


def _enlarge(shape: Circle | OrientedRectangle, margin: float) -> Circle | OrientedRectangle:
    return Circle(shape.center, shape.radius + margin) if isinstance(shape, Circle) else shape.enlarge(margin)


def _mesh(shape: Circle | OrientedRectangle | Array) -> Mesh:
    """A flat mesh in z = 0 that reaches beyond a disc or rectangle."""
    if isinstance(shape, Circle):
        radius = np.linspace(0.0, (1 + 2 * _BEYOND) * shape.radius, _RINGS + 1)
        disc = molds.revolved(profile=np.column_stack([radius, np.zeros(len(radius))]), segments=_SECTORS)
        return Mesh(disc.vertices + np.append(shape.center, 0.0), disc.triangles)
    assert isinstance(shape, OrientedRectangle)
    around = shape.enlarge(_BEYOND * float(shape.sides.min()))
    corners = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]]) * around.sides @ around.axes + around.corner
    flat = molds.MoldShape(np.insert(corners, 2, 0.0, axis=1), np.array([[0, 1, 2], [0, 2, 3]], np.int32))
    fine = molds.divided(flat, _CELLS)
    return meshes.drop_unused_nodes(Mesh(fine.vertices, fine.triangles))

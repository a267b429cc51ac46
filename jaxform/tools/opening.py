"""Openings of molds: the side of the cavity of a mold, or of its protruding body. On the host."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from jaxform.core.errors import InputError
from jaxform.mesh import meshes, outlines, planform, raster, topology
from jaxform.mesh.topology import distinct_rows

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
Integers = NDArray[np.integer]

FINE = 480
"""Number of pixels of the longer side of a mold's view."""
FLAT = 0.002
"""Difference that counts as one height, relative to the mold's size."""
_COARSE = 120  # pixels, to choose from where to look
RIM = 0.8
"""Share of a view's edge that is at one height, from which on it is a rim."""
HOLLOW = 5e-4
"""Least volume of a cavity, relative to the cube of the mold's size."""
_FAVOUR = 3.0  # times as much volume must stand out as is hollow, to be formed over instead of into
LEAST_RIM = 0.3
"""The same share, from which on a side is accepted with a warning."""
_OTHERS, _SAME = 0.2, 0.98  # of the best hollow, that others hold at least; cosine between sides that are one
_LEVELS = 25  # heights at which a rim is searched for at first
_ABOVE = 0.03  # of the area within a rim, that may stand above it: a few pins
_KEPT = 0.5  # of what a side seems to hold, that is within the rim at least
_ALSO = 0.1  # of what one hollow holds, that another beside it holds at least
_STEEP = 4.0  # times as deep as a place is away from the edge of its hollow: no sheet gets deeper
_NEARLY = 0.97  # of the best volume
_FACE = 0.01  # of the area, that a flat face is at least: of a scan none is
_FEW = 6  # directions of flat faces that are tried beside the axes
_SPECK = 0.005  # of a cavity's area: less is a hole for a bolt


class SideView(NamedTuple):
    """A view, the height of its rim [m], and the volumes [m^3] behind the rim and before it."""

    view: Heights
    level: float
    share: float
    hollow: float
    raised: float


@dataclass(frozen=True)
class Opening:
    """The opening of a mold, over which the sheet is clamped.

    Attributes:
        view: The mold viewed from the sheet: rotated so that pressure pushes to +z.
        level: Height of the clamp plane [m], after turning.
        base: Height [m] of the rim or of the base plate.
        cavity: Pixels (ny, nx) behind the clamp plane that are to be formed.
        male: True if the sheet is formed over a protruding mold, not into a cavity.
        rim: Share of the edge that is at the height of the rim.
        depth: Depth of the formed part [m].
        others: Unit vectors (3,) to other sides, in the file's axes, on which a cavity holds nearly as much.
    """

    view: Heights
    level: float
    base: float
    cavity: Mask
    male: bool
    rim: float
    depth: float
    others: tuple[Array, ...] = ()


def find_opening(
    vertices: Array, triangles: Integers, *, male: bool | None = None, direction: Array | None = None
) -> Opening:
    """The opening of a mold, or the body that protrudes from its base.

    Args:
        vertices: Positions (n, 3) [m], welded.
        triangles: Vertex numbers (m, 3).
        male: True to find the protruding body; by default the larger of cavity and body.
        direction: Unit vector (3,) to the side from which the sheet comes; by default the best of many.

    Raises:
        InputError: The mold has neither a cavity nor a protruding body on any side.
    """
    size = meshes.size(vertices)
    surface = make_viewed_surface(vertices, triangles)
    hollow, raised, others = opening_sides(surface, size, direction)
    male = is_male(hollow, raised) if male is None else male
    best = raised if male else hollow
    if max(best.hollow, best.raised) < HOLLOW * size**3 or best.share < LEAST_RIM:
        problem = "no opening was found: no side has a cavity within a level rim, nor a plug on a base"
        remedy = "give --drape where the sheet is formed over the mold, or --direction for the side it comes from"
        raise InputError(problem, remedy)
    view = view_heights(surface, best.view.turn, FINE)
    look = _view_side(view, size)
    if male:
        return _male(look, size)
    return replace(_female(_limit_to_rim(look, size), size), others=tuple(others))


def is_rimmed(vertices: Array, triangles: Integers) -> bool:
    """True when a mold (n, 3) [m], (m, 3), shows a cavity within a rim, or a plug on a base, from any side."""
    size = meshes.size(vertices)
    hollow, raised, _ = opening_sides(make_viewed_surface(vertices, triangles), size)
    best = raised if is_male(hollow, raised) else hollow
    return best.share >= RIM and max(best.hollow, best.raised) >= HOLLOW * size**3


def is_male(hollow: SideView, raised: SideView) -> bool:
    """True if the protruding volume of one side is much larger than the cavity of any."""
    return raised.raised > _FAVOUR * hollow.hollow


def opening_sides(
    surface: ViewedSurface, size: float, direction: Array | None = None
) -> tuple[SideView, SideView, list[Array]]:
    """The sides from which a mold may be formed.

    Args:
        surface: Surface of the mold.
        size: Size of the mold [m].
        direction: Unit vector (3,) to the only side that counts; all by default.

    Returns:
        The views of the most hollow side and of the one from which most stands out, and directions (3,) to other
        hollows.
    """
    turns = _candidate_rotations(*surface[:2]) if direction is None else [rotation_to_z(-direction)]
    outer = [_view_side(view_heights(surface, turn, _COARSE), size) for turn in turns]
    inner = [_limit_to_rim(look, size) for look in outer]
    hollow = _first_best(_has_rim(inner), lambda look: look.hollow)
    others = [-look.view.turn[2] for look in inner if look.share >= RIM and look.hollow >= _OTHERS * hollow.hollow]
    others = [side for side in others if side @ hollow.view.turn[2] > -_SAME]
    return hollow, _first_best(_has_rim(outer), lambda look: look.raised), others


def _has_rim(looks: list[SideView]) -> list[SideView]:
    return [look for look in looks if look.share >= RIM] or looks


def _first_best(looks: list[SideView], of: Callable[[SideView], float]) -> SideView:
    """The first of nearly equal views, which is along an axis: a flange that is a little uneven is not tilted."""
    return next(look for look in looks if of(look) >= _NEARLY * max(map(of, looks)))


def _female(look: SideView, size: float) -> Opening:
    view = look.view
    flange = view.height[np.abs(view.height - look.level) <= FLAT * size]
    deep = view.inside & ~(view.height <= look.level + FLAT * size)
    cavity = _remove_specks(deep, view.height)
    bottom = view.height[cavity & np.isfinite(view.height)]
    depth = float(bottom.max() - look.level) if len(bottom) else 0.0
    # The sheet lies before all of the flange, which may be uneven.
    return Opening(view, float(flange.min()), look.level, cavity, False, look.share, depth)


def _male(look: SideView, size: float) -> Opening:
    view = look.view
    top = float(view.height.min())
    return Opening(view, top, look.level, view.inside, True, look.share, look.level - top)


def _limit_to_rim(look: SideView, size: float) -> SideView:
    """The view within the rim of the largest cavity, without the surface outside that rim; else the view unchanged.

    Thus handles, lips and skirts do not count, and a rim may stand above the flange that surrounds it.
    """
    view, tolerance = look.view, FLAT * size
    level = _brim(view, tolerance)
    if level is None:
        return look
    candidate = _view_side(replace(view, inside=_enclosing_rims(view, level + tolerance, tolerance)), size)
    above = candidate.view.inside & (view.height < candidate.level - tolerance)
    if candidate.share < RIM or above.sum() > _ABOVE * candidate.view.inside.sum():
        return look
    as_high = abs(candidate.level - look.level) <= 2 * tolerance and candidate.hollow >= _KEPT * look.hollow
    more = look.hollow == 0 or candidate.hollow > max(look.hollow, look.raised / _FAVOUR)
    return candidate if as_high or more else look


def _brim(view: Heights, tolerance: float) -> float | None:
    """The height [m] up to which water stands in what holds most before it runs over; None where nothing holds any."""
    seen = view.height[np.isfinite(view.height)]
    levels = np.linspace(seen.min(), seen.max(), _LEVELS)
    held = np.array([_held_volume(view, level) for level in levels])
    best = int(np.argmax(held))
    if held[best] == 0:
        return None
    high, low = levels[max(best - 1, 0)], levels[best]
    while low - high > 0.5 * tolerance:
        middle = 0.5 * (low + high)
        high, low = (high, middle) if _held_volume(view, middle) >= held[best] else (middle, low)
    return float(low)


def _held_volume(view: Heights, level: float) -> float:
    """Volume [m pixels] of the water that is held when it stands at a height [m]."""
    ground = view.height <= level
    held = outlines.fill_holes(ground) & ~ground & np.isfinite(view.height)
    return float((view.height[held] - level).sum())


def _enclosing_rims(view: Heights, level: float, tolerance: float) -> Mask:
    """The pixels (ny, nx) of rims that reach to a height [m], with the hollows within, where those are large.

    What stands above a rim, beside the hollow, is left out: a handle that is higher.
    """
    ground = view.height <= level
    hollow = outlines.fill_holes(ground) & ~ground
    whole = outlines.fill_holes(hollow | (ground & (view.height >= level - 3 * tolerance)))
    part, count = outlines.label_parts(whole)
    held = hollow & np.isfinite(view.height)
    volume = np.bincount(part[held], view.height[held] - level, count + 1)
    return (volume >= _ALSO * volume.max())[part] & whole


def _remove_specks(deep: Mask, height: Array) -> Mask:
    """The mask without holes through a flange: small ones, and those without a bottom beside hollows with one."""
    part, count = outlines.label_parts(deep)
    area, bottom = (np.bincount(part[some], minlength=count + 1) for some in (deep, deep & np.isfinite(height)))
    large = area >= _SPECK * area.max()
    return (large & ((2 * bottom >= area) | (area == area.max())))[part] & deep


def _view_side(view: Heights, size: float) -> SideView:
    """The view of a side; its rim's height is the one that most of the edge has."""
    tolerance = FLAT * size
    level, share = view.edge_level(tolerance)
    some = view.inside & np.isfinite(view.height)
    deep = view.inside & (view.height > level + tolerance)
    rise, reach = view.height[some] - level, _STEEP * view.pixel * outlines.distance(deep)[some]
    cell = view.pixel**2
    hollow, raised = float(np.minimum(rise, reach)[rise > tolerance].sum()), float(-rise[rise < -tolerance].sum())
    # A rim with a few pins is one, and so is a base in which there are holes.
    return SideView(view, level, share, max(0.0, hollow - 4 * raised) * cell, raised * cell)


def _candidate_rotations(vertices: Array, triangles: Integers) -> list[Array]:
    """Rotations (3, 3) that turn each side from which a mold may be meant to be viewed towards -z."""
    axes = np.concatenate([np.eye(3)[::-1], -np.eye(3)[::-1]])
    chosen: list[Array] = list(axes)
    for direction in plane_normals(vertices, triangles):
        for signed in (direction, -direction):
            if max(float(signed @ other) for other in chosen) < 1 - 1e-6:
                chosen.append(signed)
    return [rotation_to_z(direction) for direction in chosen]


def plane_normals(vertices: Array, triangles: Integers) -> list[Array]:
    """Unit normals (3,) of flat faces with much area, and of the planes of long open rims."""
    return [*_flat(vertices, triangles), *_loops(vertices, triangles)]


def _flat(vertices: Array, triangles: Integers) -> list[Array]:
    """Normals (3,) that most of the area has."""
    corners = vertices[triangles]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = np.linalg.norm(normal, axis=1)
    unit = normal / area[:, None]
    unit *= np.where(unit[np.arange(len(unit)), np.argmax(np.abs(unit), axis=1)] < 0, -1.0, 1.0)[:, None]
    key, _, index, _ = distinct_rows(np.round(unit, 2))
    total = np.bincount(index, area, len(key))
    found = []
    for one in np.argsort(-total)[:_FEW]:
        if total[one] < _FACE * area.sum():
            break
        mean = (normal * np.sign(normal @ key[one])[:, None])[index == one].sum(0)
        found.append(mean / np.linalg.norm(mean))
    return found


def _loops(vertices: Array, triangles: Integers) -> list[Array]:
    """Normals (3,) of the planes in which the longest open rims lie."""
    edges, part = topology.open_rims(triangles, len(vertices))
    if not len(edges):
        return []
    length = np.linalg.norm(vertices[edges[:, 1]] - vertices[edges[:, 0]], axis=1)
    longest = np.argsort(-np.bincount(part, length))[:2]
    found = []
    for one in longest:
        points = vertices[np.unique(edges[part == one])]
        if len(points) >= 3:
            found.append(np.linalg.svd(points - points.mean(0), full_matrices=False)[2][2])
    return found


def rotation_to_z(direction: Array) -> Array:
    """The rotation (3, 3) by the smallest angle that turns a unit vector (3,) to +z."""
    x, y, z = (float(component) for component in direction)
    if z < -1 + 1e-12:
        return np.diag([1.0, -1.0, -1.0])
    cross = np.array([[0.0, 0.0, -x], [0.0, 0.0, -y], [x, y, 0.0]])
    turn = np.eye(3) + cross + cross @ cross / (1 + z)
    turn[np.abs(turn) < 1e-12] = 0.0
    return turn


# Heights of a surface as seen from a side: the nearest in each pixel, holes and rims included. On the host.

_RIM = 2  # pixels beside the surface in which its rim is searched for
_ABRUPT = 20.0  # degrees, from which a bend of the surface is an edge that may be thinner than a pixel


@dataclass(frozen=True)
class Heights:
    """A surface viewed along +z, from below, in square pixels.

    Attributes:
        turn: Rotation of the surface (3, 3) for a view along +z.
        low: Place of the first pixel's outer corner (2,) [m], after turning.
        pixel: Side of a pixel [m].
        height: The smallest z (ny, nx) [m] in each, after turning; infinite where there is nothing.
        inside: Pixels (ny, nx) that the surface covers or surrounds.
    """

    turn: Array
    low: Array
    pixel: float
    height: Array
    inside: Mask

    @property
    def edge(self) -> Mask:
        """Inner pixels that are next to the outside."""
        return self.inside & ~outlines.dilate(self.inside, -1)

    def places(self, pixels: Mask) -> Array:
        """Middles (n, 2) [m] of pixels."""
        row, column = np.nonzero(pixels)
        return self.low + self.pixel * (np.stack([column, row], axis=1) + 0.5)

    def sample(self, values: NDArray[Any], places: Array) -> NDArray[Any]:
        """The values (ny, nx) of the pixels that places (n, 2) [m] are in, or are nearest to."""
        column, row = np.floor((places - self.low) / self.pixel).astype(int).T
        return values[np.clip(row, 0, values.shape[0] - 1), np.clip(column, 0, values.shape[1] - 1)]

    def inside_polygon(self, polygon: Array) -> Mask:
        """The pixels (ny, nx) whose middles are in a polygon (k, 2) [m]."""
        places = self.places(np.ones_like(self.inside))
        return planform.inside(places, [polygon]).reshape(self.inside.shape)

    def edge_level(self, tolerance: float) -> tuple[float, float]:
        """The height [m] that most of the edge has, within a tolerance [m], and the share of the edge that has it."""
        at_edge = np.sort(self.local_minimum()[self.edge])
        many = np.searchsorted(at_edge, at_edge + 2 * tolerance, side="right") - np.arange(len(at_edge))
        first = int(np.argmax(many))
        return float(np.median(at_edge[first : first + many[first]])), float(many[first] / len(at_edge))

    def local_minimum(self) -> Array:
        """The smallest height (ny, nx) [m] in a few pixels around each."""
        return outlines.local_minimum(self.height, _RIM)


ViewedSurface = tuple[Array, NDArray[np.integer], Array]
"""A surface to be viewed: vertices (n, 3) [m], triangles (m, 3), and its rims and sharp edges (k, 2, 3) [m]."""


def make_viewed_surface(vertices: Array, triangles: NDArray[np.integer]) -> ViewedSurface:
    """A surface (n, 3) [m], (m, 3), with its edges."""
    return vertices, triangles, np.asarray(topology.feature_edges(vertices, triangles, _ABRUPT), np.float64)


def view_heights(looked_at: ViewedSurface, turn: Array, pixels: int) -> Heights:
    """The heights of a surface that is turned first.

    Args:
        looked_at: The surface.
        turn: Matrix (3, 3).
        pixels: Along the longer side.
    """
    vertices, triangles, edges = looked_at
    turned = vertices @ turn.T
    low, high = turned.min(0), turned.max(0)
    pixel = float((high - low)[:2].max()) / pixels
    first = low[:2] - 2.5 * pixel
    width, height = (int(np.ceil(extent / pixel)) + 5 for extent in (high - low)[:2])
    nearest = np.full(width * height, np.inf)
    corners = turned[triangles]
    for _, covered, interpolate in raster.rasterize((corners[..., :2] - first) / pixel, width, height):
        np.minimum.at(nearest, covered, interpolate(corners[..., 2]))
    # Walls that stand upright, and rims, are in no pixel's middle.
    points = topology.edge_points(edges @ turn.T, pixel)
    column, row = np.floor((points[:, :2] - first) / pixel).astype(int).T
    np.minimum.at(nearest, row * width + column, points[:, 2])
    seen_there = nearest.reshape(height, width)
    return Heights(turn, first, pixel, seen_there, outlines.fill_holes(np.isfinite(seen_there)))

"""Where a sheet is clamped on a mold: from which side the mold is hollow, or what stands out of it. On the host."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from jaxform.core.errors import InputError
from jaxform.mesh import masks, meshes, topology
from jaxform.mesh.rows import distinct
from jaxform.tools import heights
from jaxform.tools.heights import Heights

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
Integers = NDArray[np.integer]

FINE = 480
"""Pixels of the longer side, to look at a mold."""
FLAT = 0.002
"""Of the mold's size, what counts as one height."""
_COARSE = 120  # pixels, to choose from where to look
RIM = 0.8
"""Of the edge of what is seen, what is at one height: that is a rim."""
HOLLOW = 5e-4
"""Of the cube of the mold's size, the volume of what is a cavity."""
_FAVOUR = 3.0  # times as much volume must stand out as is hollow, to be formed over instead of into
LEAST_RIM = 0.3
"""The same share, of what is looked at with a warning."""
_STEPS = (0.0, 0.25, 0.5, 0.75, 0.9)  # of the height of what stands out, where a rim of its own is looked for
_NEARLY = 0.97  # of the best volume
_FACE = 0.01  # of the area, that a flat face is at least: of a scan none is
_FEW = 6  # directions of flat faces that are tried beside the axes
_SPECK = 0.005  # of a cavity's area: less is a hole for a bolt


class _Look(NamedTuple):
    """A view, the height of its rim [m], and the volumes [m^3] behind the rim and before it."""

    view: Heights
    level: float
    share: float
    hollow: float
    raised: float


@dataclass(frozen=True)
class Opening:
    """Where the sheet goes.

    Attributes:
        view: The mold as the sheet sees it: turned so that pressure pushes to +z.
        level: Height of the clamp plane [m], after turning.
        base: Height [m] of the rim or of the base plate.
        cavity: Pixels (ny, nx) behind the clamp plane that are to be formed.
        male: Whether the sheet is formed over what stands out, not into what is hollow.
        rim: Share of the edge that is at the height of the rim.
        depth: Of what is formed [m].
    """

    view: Heights
    level: float
    base: float
    cavity: Mask
    male: bool
    rim: float
    depth: float


def find(vertices: Array, triangles: Integers, *, male: bool | None = None, direction: Array | None = None) -> Opening:
    """The opening of a mold, or what stands out of its base.

    Args:
        vertices: Positions (n, 3) [m], welded.
        triangles: Vertex numbers (m, 3).
        male: Whether what stands out is looked for; by default what holds more.
        direction: Unit vector (3,) to the side from which the sheet comes; by default the best of many.

    Raises:
        InputError: The mold is neither hollow from any side nor does anything stand out of it.
    """
    size = meshes.size(vertices)
    surface = heights.surface(vertices, triangles)
    sides = sides_of(surface, size, direction)
    male = sides.male if male is None else male
    best = sides.raised if male else sides.hollow
    if max(best.hollow, best.raised) < HOLLOW * size**3 or best.share < LEAST_RIM:
        problem = "no opening was found: no side shows a cavity within a rim at one height, nor a plug on a base"
        remedy = "give --drape where the sheet is formed over the mold, or --direction for the side it comes from"
        raise InputError(problem, remedy)
    view = heights.seen(surface, best.view.turn, FINE)
    look = _look(view, size)
    return _male(look, size) if male else _female(_deeper(look, size), size)


def is_rimmed(vertices: Array, triangles: Integers) -> bool:
    """Whether a mold (n, 3) [m], (m, 3), shows a cavity within a rim, or a plug on a base, from any side."""
    size = meshes.size(vertices)
    sides = sides_of(heights.surface(vertices, triangles), size)
    best = sides.raised if sides.male else sides.hollow
    return best.share >= RIM and max(best.hollow, best.raised) >= HOLLOW * size**3


class Sides(NamedTuple):
    """The look at the most hollow side, and at the one from which most stands out."""

    hollow: _Look
    raised: _Look

    @property
    def male(self) -> bool:
        """Whether much more stands out than is hollow."""
        return self.raised.raised > _FAVOUR * self.hollow.hollow


def sides_of(surface: heights.Surface, size: float, direction: Array | None = None) -> Sides:
    """The sides from which a mold may be formed.

    Args:
        surface: The mold's.
        size: The mold's [m].
        direction: Unit vector (3,) to the only side that counts; all by default.
    """
    turns = _turns(surface.vertices, surface.triangles) if direction is None else [turned_up(-direction)]
    outer = [_look(heights.seen(surface, turn, _COARSE), size) for turn in turns]
    inner = [_deeper(look, size) for look in outer]
    hollow = _first_best(_rimmed(inner), lambda look: look.hollow)
    return Sides(hollow, _first_best(_rimmed(outer), lambda look: look.raised))


def _rimmed(looks: list[_Look]) -> list[_Look]:
    return [look for look in looks if look.share >= RIM] or looks


def _first_best(looks: list[_Look], of: Callable[[_Look], float]) -> _Look:
    """Of nearly the same the first, which is along an axis: a flange that is a little uneven is not tilted."""
    return next(look for look in looks if of(look) >= _NEARLY * max(map(of, looks)))


def _female(look: _Look, size: float) -> Opening:
    view = look.view
    flange = view.height[np.abs(view.height - look.level) <= FLAT * size]
    deep = view.inside & ~(view.height <= look.level + FLAT * size)
    cavity = _without_specks(deep)
    bottom = view.height[cavity & np.isfinite(view.height)]
    depth = float(bottom.max() - look.level) if len(bottom) else 0.0
    # The sheet lies before all of the flange, which may be uneven.
    return Opening(view, float(flange.min()), look.level, cavity, False, look.share, depth)


def _male(look: _Look, size: float) -> Opening:
    view = look.view
    top = float(view.height.min())
    return Opening(view, top, look.level, view.inside, True, look.share, look.level - top)


def _deeper(look: _Look, size: float) -> _Look:
    """The look within a rim of its own that a cavity has, above what surrounds it; else the look as it is.

    Such a rim stands out, and what it encloses holds more than it does itself.
    """
    view, best = look.view, look
    above = look.level - view.height[view.inside & (view.height < look.level - FLAT * size)]
    if not len(above):
        return look
    for share in _STEPS:
        crest = masks.filled(view.inside & (view.height < look.level - max(share * above.max(), FLAT * size)))
        part, count = masks.parts(crest)
        if not count:
            continue
        largest = part == 1 + np.argmax(np.bincount(part.ravel())[1:])
        own = _look(replace(view, inside=largest), size)
        if own.share >= RIM and own.hollow > max(best.hollow, look.raised):
            best = own
    return best


def _without_specks(deep: Mask) -> Mask:
    part, count = masks.parts(deep)
    area = np.bincount(part.ravel(), minlength=count + 1)
    area[0] = 0
    return (area >= _SPECK * area.max())[part] & deep


def _look(view: Heights, size: float) -> _Look:
    """The rim's height is the one that most of the edge has."""
    tolerance = FLAT * size
    level, share = view.edge_level(tolerance)
    rise = view.height[view.inside & np.isfinite(view.height)] - level
    cell = view.pixel**2
    hollow, raised = float(rise[rise > tolerance].sum()), float(-rise[rise < -tolerance].sum())
    # A rim with a few pins is one, and so is a base in which there are holes.
    return _Look(view, level, share, max(0.0, hollow - 4 * raised) * cell, raised * cell)


def _turns(vertices: Array, triangles: Integers) -> list[Array]:
    """Rotations (3, 3) that turn each side from which a mold may be meant to be seen towards -z."""
    axes = np.concatenate([np.eye(3)[::-1], -np.eye(3)[::-1]])
    chosen: list[Array] = list(axes)
    for direction in plane_normals(vertices, triangles):
        for signed in (direction, -direction):
            if max(float(signed @ other) for other in chosen) < 1 - 1e-6:
                chosen.append(signed)
    return [turned_up(direction) for direction in chosen]


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
    key, _, index, _ = distinct(np.round(unit, 2))
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


def turned_up(direction: Array) -> Array:
    """The rotation (3, 3) by the smallest angle that turns a unit vector (3,) to +z."""
    x, y, z = (float(component) for component in direction)
    if z < -1 + 1e-12:
        return np.diag([1.0, -1.0, -1.0])
    cross = np.array([[0.0, 0.0, -x], [0.0, 0.0, -y], [x, y, 0.0]])
    turn = np.eye(3) + cross + cross @ cross / (1 + z)
    turn[np.abs(turn) < 1e-12] = 0.0
    return turn

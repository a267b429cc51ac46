"""Curves across a formed part along which its thickness is drawn: meridians of discs, sections of other sheets."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from jaxform.mesh.topology import distinct_rows
from jaxform.model.scene import Scene

if TYPE_CHECKING:
    from jaxform.results.result import Result

Array = NDArray[np.float64]

FLAT = 0.05  # of its largest extent, up to which a sheet's smallest one is that of a flat one


class SectionCurve(NamedTuple):
    """Thickness of the wall along a curve in the formed part.

    Attributes:
        place: Points (n, 3) [m] in the formed part, in order.
        thickness: Thickness there (n,) [m].
        arc: Arc length (n,) [m] in the formed part.
        in_part: Mask (n,) of the points in the part that was asked for; None for all.
        label: Name of the curve.
        marked: Arc length [m] at the place through which it was to run; None where there is none.
    """

    place: Array
    thickness: Array
    arc: Array
    in_part: NDArray[np.bool_] | None = None
    label: str = ""
    marked: float | None = None

    @property
    def part_thickness(self) -> Array:
        """Thickness (n,) [m] in the part, NaN outside."""
        return self.thickness if self.in_part is None else np.where(self.in_part, self.thickness, np.nan)


def is_disc(scene: Scene) -> bool:
    """True if the initial sheet is flat and its clamped rim a circle about the z axis."""
    positions, clamped = np.asarray(scene.parison.positions), np.asarray(scene.parison.clamped)
    radius = np.hypot(positions[:, 0], positions[:, 1])
    if not clamped.any():
        return False
    size = radius.max()
    flat = np.ptp(positions[:, 2]) <= 1e-6 * size
    round_rim = np.ptp(radius[clamped]) <= 1e-3 * size
    return bool(flat and round_rim and radius[clamped].min() >= (1 - 1e-3) * size)


def initial_radius(scene: Scene) -> Array:
    """Distance of the nodes from the z axis in the initial sheet (n_node,) [m]."""
    positions = np.asarray(scene.parison.positions, float)
    return np.hypot(positions[:, 0], positions[:, 1])


def meridian_arc(scene: Scene, result: Result) -> Array:
    """Arc length (n_node,) [m] from the axis, in the formed part, of every node of a disc.

    It is that of the meridian through the nodes on the +x axis, as a function of the initial radius.
    """
    start, radius = np.asarray(scene.parison.positions, float), initial_radius(scene)
    on_axis = np.flatnonzero((np.abs(start[:, 1]) <= 1e-9 * radius.max()) & (start[:, 0] >= 0))
    if len(on_axis) < 2:
        on_axis = np.arange(len(start))
    order = on_axis[np.argsort(radius[on_axis])]
    return np.interp(radius, radius[order], arc_length(np.asarray(result.positions, float)[order]))


def curves(
    scene: Scene, result: Result, through: ArrayLike | None = None, part: ArrayLike | None = None
) -> list[SectionCurve]:
    """The curves to draw: all nodes of a disc over the meridian, else sections through the initial sheet.

    Args:
        scene: The simulated scene.
        result: The part.
        through: A place (3,) [m] in the initial sheet through which they run; its middle by default.
        part: Mask (n_element,) of the elements that are the part; all by default.
    """
    start = np.asarray(scene.parison.positions, float)
    if is_disc(scene):
        arc = meridian_arc(scene, result)
        order = np.argsort(arc)
        marked = None
        if through is not None:
            radius = initial_radius(scene)
            outwards = np.argsort(radius)
            marked = float(np.interp(np.hypot(*np.asarray(through)[:2]), radius[outwards], arc[outwards]))
        wall, place = np.asarray(result.thickness, float)[order], np.asarray(result.positions, float)[order]
        in_part = None if part is None else _nodes_of(scene, part)[order]
        return [SectionCurve(place, wall, arc[order], in_part, "all nodes", marked)]
    # Across the two longest sides of its box: along the third a sheet has next to no extent.
    extent = np.ptp(start, axis=0)
    longest = np.argsort(-extent, kind="stable").tolist()
    ordered = sorted(longest[:2], reverse=True)
    if extent[longest[2]] > FLAT * extent[longest[0]]:
        # Along a tube or preform first, then around it.
        ordered = [longest[1], longest[0]]
    found = []
    for axis in ordered:
        level = middle_of(scene, axis) if through is None else float(np.asarray(through)[axis])
        name = f"section {'xyz'[axis]} = {1e3 * level:.4g} mm of the initial sheet"
        pieces = cuts(scene, result, axis, level, part=part)
        if through is None:
            found += [piece._replace(label=name) for piece in pieces[:1]]
        elif pieces:
            found.append(_nearest(pieces, scene, result, np.asarray(through))._replace(label=name))
    return found


def _nearest(pieces: list[SectionCurve], scene: Scene, result: Result, through: Array) -> SectionCurve:
    """The piece of a section that passes nearest to a place [m] in the initial sheet."""
    corners = np.asarray(scene.parison.positions, float)[np.asarray(scene.parison.triangles)]
    element = int(np.argmin(np.linalg.norm(corners.mean(1) - through, axis=1)))
    place = np.asarray(result.positions, float)[np.asarray(scene.parison.triangles)[element]].mean(0)
    away = [np.linalg.norm(piece.place - place, axis=1) for piece in pieces]
    best = int(np.argmin([distance.min() for distance in away]))
    return pieces[best]._replace(marked=float(pieces[best].arc[np.argmin(away[best])]))


def _nodes_of(scene: Scene, part: ArrayLike) -> NDArray[np.bool_]:
    """Mask of the nodes (n_node,) of the elements in a mask (n_element,)."""
    nodes = np.zeros(len(np.asarray(scene.parison.positions)), bool)
    nodes[np.asarray(scene.parison.triangles)[np.asarray(part) != 0]] = True
    return nodes


def symmetry_planes(scene: Scene) -> dict[int, float]:
    """Axis and place [m] of the planes about which the modelled part is symmetric."""
    free = np.asarray(scene.parison.fixed) & ~np.asarray(scene.parison.clamped)[:, None]
    start = np.asarray(scene.parison.positions, float)
    mirrored = [k for k in range(3) if free[:, k].any() and k not in scene.parison.guided]
    return {k: float(np.median(start[free[:, k], k])) for k in mirrored}


def middle_of(scene: Scene, axis: int) -> float:
    """The place [m] of the initial sheet's middle along an axis, that of the whole sheet where half is modelled."""
    planes = symmetry_planes(scene)
    if axis in planes:
        return planes[axis]
    along = np.asarray(scene.parison.positions, float)[:, axis]
    return float(0.5 * (along.min() + along.max()))


def arc_length(places: Array) -> Array:
    """Arc length (n,) [m] of a line through places (n, 3) [m], from the first one."""
    return np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(places, axis=0), axis=1))])


def section(scene: Scene, result: Result, axis: int, level: float) -> list[tuple[Array, Array]]:
    """Cut of the initial sheet by the plane at `level` [m] across an axis, seen in the formed part.

    Returns:
        Arc length [m] and thickness [m] of each connected piece, the longest first; a closed one ends where it began.
    """
    return [(piece.arc, piece.thickness) for piece in cuts(scene, result, axis, level)]


def cuts(
    scene: Scene, result: Result, axis: int, level: float, *, formed: bool = False, part: ArrayLike | None = None
) -> list[SectionCurve]:
    """Cut of the initial sheet, or of the formed part itself, by the plane at `level` [m] across an axis.

    Args:
        scene: The simulated scene.
        result: The part.
        axis: 0, 1 or 2.
        level: Place of the plane [m].
        formed: Cut the formed part.
        part: Mask (n_element,) of the elements whose points the pieces mark as their own; None for no mark.

    Returns:
        Each connected piece, the longest first; a closed one ends where it began.
    """
    end = np.asarray(result.positions, float)
    start = end if formed else np.asarray(scene.parison.positions, float)
    height = start[:, axis] - level
    # A node in the plane counts as just above it, so that every triangle is cut in two edges or none.
    height[np.abs(height) <= 1e-9 * np.ptp(start, axis=0).max()] = _just_above(height)
    triangles = np.asarray(scene.parison.triangles)
    sides = np.sort(np.stack([triangles, np.roll(triangles, -1, axis=1)], axis=2), axis=2)
    cut = (height[sides[..., 0]] > 0) != (height[sides[..., 1]] > 0)
    crossed = cut.sum(1) == 2
    edge, _, index, _ = distinct_rows(sides[crossed][cut[crossed]])
    share = height[edge[:, 0]] / (height[edge[:, 0]] - height[edge[:, 1]])
    place = end[edge[:, 0]] + share[:, None] * (end[edge[:, 1]] - end[edge[:, 0]])
    wall = np.asarray(result.thickness, float)
    value = wall[edge[:, 0]] + share * (wall[edge[:, 1]] - wall[edge[:, 0]])
    in_part = None if part is None else _nodes_of(scene, part)[edge].all(1)
    pieces = [
        SectionCurve(place[path], value[path], arc_length(place[path]), None if in_part is None else in_part[path])
        for path in _chains(index.reshape(-1, 2))
    ]
    return sorted(pieces, key=lambda piece: -piece.arc[-1])


def cut_triangles(faces: Array, axis: int, level: float) -> Array:
    """Cut of triangles (n, 3, 3) by a plane across an axis: the ends of a line in each that it cuts, (k, 2, 3)."""
    above = faces[..., axis] >= level
    cut = above.any(1) & ~above.all(1)
    faces, above = faces[cut], above[cut]
    # The corner that is alone on its side comes first.
    lone = np.argmax(above != (above.sum(1) == 2)[:, None], axis=1)
    row = np.arange(len(faces))
    alone = faces[row, lone]
    ends = []
    for other in (faces[row, (lone + 1) % 3], faces[row, (lone + 2) % 3]):
        share = (level - alone[:, axis]) / (other[:, axis] - alone[:, axis])
        ends.append(alone + share[:, None] * (other - alone))
    return np.stack(ends, axis=1)


def _just_above(height: Array) -> float:
    """A height of the side on which the sheet lies, far below what can be seen."""
    side = 1.0 if height.max() <= -height.min() * 1e-9 or height.min() < 0 else -1.0
    return side * 1e-9 * float(np.abs(height).max())


def _chains(segments: NDArray[np.int64]) -> list[list[int]]:
    """Segments (n, 2) of points joined to paths; a closed path ends with its first point."""
    neighbours: dict[int, list[int]] = {}
    for a, b in segments.tolist():
        neighbours.setdefault(a, []).append(b)
        neighbours.setdefault(b, []).append(a)
    ends = [point for point, near in neighbours.items() if len(near) == 1]
    chains, seen = [], set[int]()
    for first in [*ends, *neighbours]:
        if first in seen:
            continue
        chain = [first]
        seen.add(first)
        while following := [point for point in neighbours[chain[-1]] if point not in seen]:
            chain.append(following[0])
            seen.add(following[0])
        if len(chain) > 2 and first in neighbours[chain[-1]]:
            chain.append(first)
        chains.append(chain)
    return chains

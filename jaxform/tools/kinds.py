"""Kinds of molds: a cavity, a buck over which the sheet is draped, an open tube. On the host."""

from __future__ import annotations

import itertools

import numpy as np
from numpy.typing import NDArray

from jaxform.core.errors import InputError
from jaxform.mesh import meshes, outlines, topology
from jaxform.mesh.meshes import Mesh
from jaxform.tools import buck, covers, footprint, opening
from jaxform.tools.buck import Buck
from jaxform.tools.opening import SideView

Array = NDArray[np.float64]
Integers = NDArray[np.integer]

_RECESS, _CAVITY = 0.01, 0.1  # of a solid's volume, that a hollow is at most on a buck, and at least in a cavity
_PLATEN, _WIDE = 1.0, 0.6  # of the body's area and height, that a flange around is at least, to be a platen
_LOWER = 0.01  # of the visible area, that may lie lower than a platen
_PIXELS, _LEVELS = 120, 16  # of the views and levels in which held water is measured
_BOTTOM = 0.1  # of the visible area, that the flat bottom of a cup is at least
_HANGS = -0.9  # of a direction's z, below which what bulges to there hangs


def classify(mold: Mesh) -> tuple[bool, str, Completion | None]:
    """The kind of a welded mold.

    Returns:
        Whether the mold is a buck; the other kind that it may be and how to request it, empty where it is clear; the
        rest of a cavity that is cut in a half or a quarter, with the planes.
    """
    size = meshes.size(mold.positions)
    hollow, raised, _ = opening.opening_sides(opening.make_viewed_surface(mold.positions, mold.triangles), size)
    rims = covers.find_rims(mold)
    if rims is None:
        return *_classify_solid(mold, hollow, raised, size), None
    completion = None if _has_rim(hollow, size) else find_completion(mold)
    if completion is not None:
        return False, "", completion
    return *_classify_shell(mold, rims, hollow, size), None


def _has_rim(hollow: SideView, size: float) -> bool:
    return hollow.share >= opening.RIM and hollow.hollow >= opening.HOLLOW * size**3


def _classify_solid(mold: Mesh, hollow: SideView, raised: SideView, size: float) -> tuple[bool, str]:
    volume = _volume(mold)
    share = _held_volume(mold) / volume if volume else np.inf
    if share > _CAVITY:
        return False, ""
    if share < _RECESS or (opening.is_male(hollow, raised) and raised.share >= opening.RIM):
        return True, ""
    if _has_rim(hollow, size):
        return False, "a solid with a shallow hollow: --drape forms over it"
    return True, "a solid with a recess: --cavity forms into that"


def _volume(mold: Mesh) -> float:
    """Volume of a solid as a buck [m^3]; that of its box where it is none."""
    try:
        return buck.find_buck(mold).volume
    except InputError:
        return float(np.prod(np.ptp(mold.positions, axis=0)))


def _held_volume(mold: Mesh) -> float:
    """The volume of water [m^3] that a mold holds on the side on which it holds most."""
    surface = opening.make_viewed_surface(mold.positions, mold.triangles)
    views = (opening.view_heights(surface, opening.rotation_to_z(-side), _PIXELS) for side in buck.directions(mold))
    return max(_held_volume_above(view) for view in views)


def _held_volume_above(view: opening.Heights) -> float:
    """The volume of water [m^3] held on the viewed side: the enclosed area at each height, integrated."""
    high, low = float(view.height.min()), float(view.height[np.isfinite(view.height)].max())
    levels = np.linspace(high, low, _LEVELS + 1)[1:]
    above = [view.height <= level for level in levels]
    pixels = sum(int((outlines.fill_holes(mask) & ~mask).sum()) for mask in above)
    return pixels * view.pixel**2 * (low - high) / _LEVELS


def _classify_shell(mold: Mesh, rims: list[Integers], hollow: SideView, size: float) -> tuple[bool, str]:
    direction = covers.outward_direction(mold, rims)
    outward = covers.faces_outward(mold, direction)
    if not _has_rim(hollow, size):
        # Without a rim at one height it is a scan, of the inside only where it faces inwards.
        inside = outward is False and hollow.share >= opening.LEAST_RIM
        other = "--drape forms over its outside" if inside else "--cavity forms into its inside"
        return not inside, f"an open surface with an uneven rim: {other}"
    if outward is False:
        return False, ""
    stands = buck.find_buck(mold, direction)
    if stands.on_platen:
        drape = bool(outward) and _is_platen(stands)
        return drape, "an open surface with a flange: " + _other_choice(drape)
    # An open bowl stands on its bottom, as a rule, and a buck on its rim; a cup has a flat bottom, a scan has none.
    flat = int((np.abs(stands.view.height - stands.top) <= opening.FLAT * size).sum())
    drape = bool(outward) and float(direction[2]) > _HANGS and flat < _BOTTOM * int(stands.view.inside.sum())
    return drape, "an open surface with an even rim: " + _other_choice(drape)


def _other_choice(drape: bool) -> str:
    return "--cavity forms into its other side" if drape else "--drape forms over its other side"


def _is_platen(stands: Buck) -> bool:
    """True when the surface around a body is as wide as a platen, and nothing lies lower."""
    view = stands.view
    lower = np.isfinite(view.height) & (view.height > stands.base + 2 * opening.FLAT * stands.height)
    if lower.sum() > _LOWER * view.inside.sum():
        return False
    ground, body = view.inside & ~stands.body, outlines.fill_holes(stands.body)
    reach = outlines.distance(view.inside)[stands.body].min() * view.pixel
    return bool(ground.sum() >= _PLATEN * body.sum() and reach >= _WIDE * stands.height)


# Tubes: bodies that are open from end to end. On the host.

_SHARE = 0.3  # of what a body covers and surrounds, seen along a tube, that one sees through at least
_DEEP = 1.0  # times the width of that opening: what is shorter is a frame, over whose opening a sheet is drawn
_TUBES_PIXELS = 120
_ALONG = np.cos(np.radians(3.0))  # to another direction, within which it is the same


def widest_tube(mold: Mesh) -> tuple[float, float, Array] | None:
    """The widest way through a mold [m] that is longer than it is wide; None where there is none.

    Returns:
        The width of the opening that one sees through [m], and length [m] and unit vector (3,) along it.
    """
    surface = opening.make_viewed_surface(mold.positions, mold.triangles)
    used = mold.positions[np.unique(mold.triangles)]
    found = []
    for direction in _directions(mold):
        view = opening.view_heights(surface, opening.rotation_to_z(direction), _TUBES_PIXELS)
        through = view.inside & ~np.isfinite(view.height)
        width, length = 2 * view.pixel * float(outlines.distance(through).max()), float(np.ptp(used @ direction))
        if through.sum() >= _SHARE * view.inside.sum() and length >= _DEEP * width:
            found.append((width, length, direction))
    return max(found, key=lambda tube: tube[0], default=None)


def refuse_tubes(mold: Mesh) -> None:
    """Raises an InputError where a mold [m] is a tube: a sheet over one end would be blown out of the other."""
    tube = widest_tube(mold)
    if tube is None:
        return
    width, length, direction = tube
    across = "xyz"[int(np.argmin(np.round(np.abs(direction), 6)))]
    size = f"{1e3 * width:.3g} mm wide and {1e3 * length:.3g} mm long"
    problem = f"is open from end to end: a tube, {size} inside"
    remedy = f"close one end, or give --drape --direction=+{across} for a sheet over its side"
    raise InputError(problem, remedy)


def _directions(mold: Mesh) -> list[Array]:
    """The axes (3,), then normals of flat faces and principal axes of the vertices that are beside them."""
    chosen, used = list(np.eye(3)), mold.positions[np.unique(mold.triangles)]
    principal = np.linalg.svd(used - used.mean(0), full_matrices=False)[2]
    for normal in (*opening.plane_normals(mold.positions, mold.triangles), *principal):
        if max(abs(float(normal @ other)) for other in chosen) < _ALONG:
            chosen.append(normal)
    return chosen


# Molds of which the file holds a half or a quarter: the planes that they are cut in, and the rest. On the host.

_CUT = 0.1  # of the length of open rims, what lies in a plane in which the mold is cut


Plane = tuple[int, float]
"""A plane across an axis, 0 to 2 for x to z, at a place [m] along it."""


def _mirror(mesh: Mesh, plane: Plane) -> Mesh:
    """The mesh mirrored in a plane."""
    return Mesh(meshes.mirror_image(mesh.positions, *plane), mesh.triangles[:, ::-1])


Completion = tuple[Mesh, list[Plane]]
"""The rest of a mold that is cut in a half or a quarter, and the planes in which it is cut."""


def _is_closed_by(mold: Mesh) -> bool:
    """True when the open edges of a mold are the rim of its opening: else its cut is taken for one."""
    edges, _ = topology.open_rims(mold.triangles, len(mold.positions))
    if not len(edges):
        return True
    found, size = opening.find_opening(mold.positions, mold.triangles), meshes.size(mold.positions)
    ends = mold.positions[edges]
    length = np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1)
    height = (ends @ found.view.turn[2]).mean(1)
    return bool(length[np.abs(height - found.base) <= opening.FLAT * size].sum() >= opening.RIM * length.sum())


def _length(edges: NDArray[np.floating]) -> float:
    """Total length [m] of edges (n, 2, k) [m]."""
    return float(np.linalg.norm(edges[:, 1] - edges[:, 0], axis=1).sum())


class _Lines:
    """The lines on which the surface of a mold ends, and those on which it bends sharply."""

    def __init__(self, mold: Mesh) -> None:
        self._open = mold.positions[topology.boundary_edges(mold.triangles)]
        self._sharp = topology.feature_edges(mold.positions, mold.triangles, rims=False)
        self._tolerance = opening.FLAT * meshes.size(mold.positions)

    def allow_plane(self, plane: Plane) -> bool:
        """True when the mold may be cut in a plane: it is open there, or has an edge inside of its outline there.

        Few planes meet this, and a test of one takes views of a mold twice as large from all sides.
        """
        if len(self._open):
            return _length(self._lines_in_plane(plane, self._open)) >= _CUT * _length(self._open)
        edges = self._lines_in_plane(plane, self._sharp)
        if not len(edges):
            return False
        low, high = edges.min((0, 1)) + self._tolerance, edges.max((0, 1)) - self._tolerance
        middles = edges.mean(1)
        return bool(((middles > low) & (middles < high)).all(1).any())

    def _lines_in_plane(self, plane: Plane, edges: NDArray[np.floating]) -> NDArray[np.floating]:
        """Those of edges (n, 2, 3) [m] that are in the plane (k, 2, 2), without the coordinate across it."""
        axis, level = plane
        there = (np.abs(edges[..., axis] - level) <= self._tolerance).all(1)
        return np.delete(edges[there], axis, axis=2)


def find_completion(mold: Mesh) -> Completion | None:
    """The images that complete an open mold which has a rim only together with them; None without such images.

    A closed solid is whole as it is.

    Args:
        mold: Welded; its box touches the planes [m].

    Returns:
        The rest, and the planes in which the mold is cut.
    """
    if topology.is_closed(mold.triangles) or opening.is_rimmed(mold.positions, mold.triangles):
        return None
    used = mold.positions[np.unique(mold.triangles)]
    lines = _Lines(mold)
    sides = [(axis, float(end[axis])) for end in (used.min(0), used.max(0)) for axis in range(3)]
    sides = [side for side in sides if lines.allow_plane(side)]
    pairs = [pair for pair in itertools.combinations(sides, 2) if pair[0][0] != pair[1][0]]
    for planes in [*((side,) for side in sides), *pairs]:
        images: list[Mesh] = []
        for plane in planes:
            images += [_mirror(part, plane) for part in [mold, *images]]
        whole = meshes.merge([mold, *images])
        whole = footprint.weld_mold(whole.positions, whole.triangles)
        if opening.is_rimmed(whole.positions, whole.triangles) and _is_closed_by(whole):
            return meshes.merge(images), list(planes)
    return None

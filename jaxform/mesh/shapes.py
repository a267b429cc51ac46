"""Sheets on the host: disc, rectangle, sphere, tube, preform, half a bottle's parison, and a user's surface."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from jaxform.core.errors import InputError, format_coordinate
from jaxform.mesh import grids, meridian, meshes, outlines, planform, topology, volumes
from jaxform.mesh.bisection import Snap
from jaxform.mesh.grids import Profile, as_length, check_count, check_resolution, triangle_side
from jaxform.mesh.meshes import Mesh

# Surfaces of a user's own as sheets: what they must be, where they are held, and their symmetry planes.

PLANE_TOLERANCE = 1e-6
"""Distance from a symmetry plane up to which a node is on it, relative to the size: float32 files round."""


def check_surface(mesh: Mesh) -> None:
    """Raises InputError where triangles are degenerate or turned, or three meet at an edge."""
    bad = np.flatnonzero(meshes.find_degenerate(mesh.positions, mesh.triangles))
    many = topology.nonmanifold_edges(mesh.triangles)
    against = topology.inconsistent_edges(mesh.triangles)
    if bad.size:
        problem = f"{bad.size} degenerate triangles (no area, or a repeated node), the first is number {bad[0]}"
        raise InputError(problem, "remove them from the mesh", key="parison.path")
    if len(many):
        problem = f"{len(many)} edges belong to more than two triangles, the first {_place(mesh, many[0])}"
        raise InputError(problem, "a parison is one surface: remove inner walls and copies", key="parison.path")
    if len(against):
        problem = f"inverted triangles at {len(against)} edges, the first {_place(mesh, against[0])}"
        raise InputError(problem, "orient the triangles so that all normals agree", key="parison.path")


def _place(mesh: Mesh, edge: NDArray[np.int64]) -> str:
    return "at (" + ", ".join(format_coordinate(x, digits=6) for x in mesh.positions[edge].mean(axis=0)) + ") m"


def parse_plane(text: str) -> tuple[int, float]:
    """Axis and place [m] of a symmetry plane that is written `x`, which is x = 0, or `x=0.15`.

    Raises:
        InputError: It is no such plane.
    """
    axis, equals, place = text.partition("=")
    try:
        level = float(place) if equals else 0.0
    except ValueError:
        level = math.nan
    if axis.strip() not in ("x", "y", "z") or not abs(level) <= meshes.LARGEST:
        raise InputError("is not a symmetry plane", 'name planes as in ["x", "y"], or with their place, ["x=0.15"]')
    return "xyz".index(axis.strip()), level


def snap_to_planes(
    positions: NDArray[np.float64], planes: Sequence[str]
) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Positions moved exactly onto the planes they are on, and which components those hold."""
    key, positions, fixed = "parison.planes", positions.copy(), np.zeros(positions.shape, dtype=bool)
    tolerance = PLANE_TOLERANCE * meshes.size(positions)
    for plane in planes:
        try:
            axis, level = parse_plane(plane)
        except InputError as error:
            raise replace(error, key=key, value=list(planes)) from None
        name, away = f"{'xyz'[axis]} = {level:g}", positions[:, axis] - level
        on = np.abs(away) <= tolerance
        if not on.any():
            raise InputError(f"no node lies on {name}", "cut the mesh there or leave the plane out", key, planes)
        if away[~on].min(initial=0.0) < 0 < away[~on].max(initial=0.0):
            problem = f"nodes lie on both sides of {name}"
            raise InputError(problem, "keep the mesh of one side only or leave the plane out", key, planes)
        positions[on, axis] = level
        fixed[:, axis] = on
    return positions, fixed


def snap_corners(corners: NDArray[np.float64], planes: Sequence[str]) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """A polygon's corners (k, 2) [m] in z = 0 moved exactly onto the planes, and which components (k, 3) those hold."""
    moved, fixed = snap_to_planes(np.insert(corners, 2, 0.0, axis=1), planes)
    # Corners beside the one of two planes may be the same now.
    apart = (moved != np.roll(moved, -1, axis=0)).any(1)
    return moved[apart, :2], fixed[apart]


def clamped_nodes(mesh: Mesh, clamp: str, rim: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Nodes (n_node,) that never move, as `clamp` says."""
    key, clamped = "parison.clamp", np.zeros(len(mesh.positions), dtype=bool)
    if clamp == "boundary":
        clamped[rim] = True
    elif clamp.startswith("field:"):
        name = clamp.removeprefix("field:")
        if name not in mesh.fields:
            known = ", ".join(sorted(mesh.fields)) or "none"
            raise InputError("the mesh has no such field", f"its fields: {known}", key, clamp)
        if not np.isfinite(mesh.fields[name]).all() or not mesh.fields[name].any():
            raise InputError("the field marks no node", "set it to 1 at clamped nodes, 0 elsewhere", key, clamp)
        clamped = mesh.fields[name] != 0
    elif clamp != "none":
        raise InputError("is not a way to clamp", "use boundary, none or field:NAME", key, clamp)
    return clamped


Symmetry = Literal["none", "half", "quarter"]
PARTS: dict[str, int] = {"none": 1, "half": 2, "quarter": 4}
"""Number of copies of the modelled part that make the whole."""
PLANES: dict[str, tuple[int, ...]] = {"none": (), "half": (0,), "quarter": (0, 1)}
"""Components of the position that the cut planes fix."""


@dataclass(frozen=True)
class Sheet:
    """The middle surface of a parison, cut and clamped.

    Attributes:
        positions: Node positions [m], shape (n, 3), float64.
        triangles: Node indices, right-hand rule about the direction of pressure, shape (m, 3), int32.
        clamped: Nodes that never move, shape (n,), bool.
        fixed: Components of the nodes that symmetry planes hold, shape (n, 3), bool.
        fields: Scalars at the nodes by name, shape (n,), float64.
        guided: Axes (0 to 2) along which the ends are guided: they stay in planes that are no planes of symmetry.
        cell_fields: Scalars of the triangles by name, shape (m,), float64.
        snap: Puts the middles (k, 3) of edges with ends (k, 2, 3) [m] on the true surface or rim, told which (k,) are
            on the boundary; None where edges are straight.
    """

    positions: NDArray[np.float64]
    triangles: NDArray[np.int32]
    clamped: NDArray[np.bool_]
    fixed: NDArray[np.bool_]
    fields: dict[str, NDArray[np.float64]] = field(default_factory=dict)
    snap: Snap | None = None
    guided: tuple[int, ...] = ()
    cell_fields: dict[str, NDArray[np.float64]] = field(default_factory=dict)


def disc(
    *,
    radius: float,
    element_size: float | Profile | None = None,
    elements: int | None = None,
    symmetry: Symmetry = "none",
) -> Sheet:
    """A round sheet about the origin in z = 0 with normals +z and a clamped rim.

    Ring i of n has radius i R / n and about 6 i segments (see `jaxform.mesh.grids`), 3 i in a half and about 1.5 i in
    a quarter. Where the element size is a profile over the radius, rings are that far apart and their segments that
    long, in proportion.

    Args:
        radius: R [m].
        element_size: Length of the edges [m], a number or a profile along the radius; or
        elements: About how many triangles, in the modelled part.
        symmetry: 'half' keeps x >= 0, 'quarter' x >= 0 and y >= 0.

    Returns:
        The sheet; nodes run ring by ring from the centre, counter-clockwise.

    Raises:
        InputError: A number is out of range, or not just one of `element_size` and `elements` is given.
    """
    density = 6 / _parts(symmetry)
    radius = as_length("parison.radius", radius)
    if isinstance(element_size, Profile):
        radii, segments = grids.graded_rings(radius, element_size, density)
    else:
        check_resolution(element_size, elements, largest=radius)
        ring_count = grids.round_count(radius / element_size if element_size else math.sqrt((elements or 0) / density))
        if elements and symmetry != "none":
            ring_count = max(2, ring_count)
        check_count(density * ring_count**2, element_size)
        segments = [math.floor(density * ring + 0.5) for ring in range(ring_count + 1)]
        radii = radius * (np.arange(ring_count + 1) / ring_count)
    if symmetry == "none":
        return _spokeless_disc(radii, segments)
    ring_count = len(segments) - 1
    arcs = [grids.ring(r, count, symmetry) for r, count in zip(radii, segments, strict=True)]
    starts = np.cumsum([0, *map(len, arcs)])
    bands = [grids.zip_rings(starts[k], segments[k], starts[k + 1], segments[k + 1], False) for k in range(ring_count)]
    clamped = np.arange(starts[-1]) >= starts[-2]
    return replace(_sheet(np.concatenate(arcs), np.concatenate(bands), clamped, symmetry), snap=_snap_to_rim(radius))


def _spokeless_disc(radii: NDArray[np.float64], segments: Sequence[int]) -> Sheet:
    """A whole disc with rings at radii (n + 1,) [m], the first 0, and about so many segments."""
    staggered = grids.staggered_rings(segments[1:])
    nodes = [ring.positions(radius) for radius, ring in zip(radii[1:], staggered, strict=True)]
    positions = np.concatenate([np.zeros((1, 3)), *nodes])
    clamped = np.arange(len(positions)) >= len(positions) - len(nodes[-1])
    return replace(_sheet(positions, grids.triangles(staggered), clamped, "none"), snap=_snap_to_rim(float(radii[-1])))


def _snap_to_rim(radius: float) -> Snap:
    """Middles of the rim's chords go to the circle."""

    def snap(
        middles: NDArray[np.float64], ends: NDArray[np.float64], boundary: NDArray[np.bool_]
    ) -> NDArray[np.float64]:
        on_rim = boundary & (np.abs(np.hypot(ends[..., 0], ends[..., 1]) - radius) <= 1e-9 * radius).all(1)
        return np.where(on_rim[:, None], _scale_to_radius(middles, radius), middles)

    return snap


def _scale_to_radius(points: NDArray[np.float64], radius: float) -> NDArray[np.float64]:
    distance = np.linalg.norm(points, axis=1, keepdims=True)
    return points * radius / np.where(distance > 0, distance, 1.0)


def rectangle(
    *,
    size: Sequence[float],
    element_size: float | None = None,
    elements: int | None = None,
    symmetry: Symmetry = "none",
    lines: Sequence[Sequence[float]] = ((), ()),
) -> Sheet:
    """A sheet over [0, a] x [0, b] in z = 0 with normals +z and clamped outer edges.

    Near-square cells, their diagonals alternating.

    Args:
        size: The sides a, b [m] of the whole.
        element_size: Length of the cells' sides [m]; or
        elements: About how many triangles, in the modelled part.
        symmetry: 'half' keeps [0, a/2] x [0, b], 'quarter' [0, a/2] x [0, b/2]; cut edges are free in their
            plane.
        lines: Places along x, and along y [m], at which edges of elements lie on a line across the sheet.

    Returns:
        The sheet; nodes run along y first.

    Raises:
        InputError: A number is out of range, or not just one of `element_size` and `elements` is given.
    """
    _parts(symmetry)
    if not isinstance(size, Sequence | np.ndarray) or len(size) != 2:
        raise InputError("is not two lengths", "give [a, b] in m", key="parison.size", value=size)
    whole = [as_length("parison.size", side) for side in size]
    extent = [side / 2 if axis in PLANES[symmetry] else side for axis, side in enumerate(whole)]
    check_resolution(element_size, elements, largest=min(extent))
    cells = grids.cell_counts(extent, element_size, elements)
    # An even number between clamped edges: then no diagonal cuts off a corner, where it would never move.
    cells = [n if axis in PLANES[symmetry] else n + n % 2 for axis, n in enumerate(cells)]
    check_count(2 * math.prod(cells), element_size)

    along = [length * (np.arange(n + 1) / n) for length, n in zip(extent, cells, strict=True)]
    for axis, places in enumerate(lines):
        if inner := sorted(place for place in set(places) if 0.0 < place < extent[axis]):
            along[axis] = _grid_through(inner, extent[axis], cells[axis], axis in PLANES[symmetry])
    cells = [len(places) - 1 for places in along]
    check_count(2 * math.prod(cells), element_size)
    x, y = along
    x, y = (grid.ravel() for grid in np.meshgrid(x, y, indexing="ij"))
    positions = np.stack([x, y, np.zeros(len(x))], axis=1)
    clamped = (positions[:, :2] == 0).any(axis=1)
    for axis in range(2):
        if axis not in PLANES[symmetry]:
            clamped |= positions[:, axis] == extent[axis]
    return _sheet(positions, grids.union_jack(*cells), clamped, symmetry, cut_at=extent)


def _grid_through(lines: Sequence[float], length: float, count: int, free_end: bool) -> NDArray[np.float64]:
    """Places from 0 to a length through lines in between [m], evenly between two: about `count` cells, even numbers."""
    stops = [0.0, *lines, length]
    shares = [max(1, round(count * (end - begin) / length)) for begin, end in itertools.pairwise(stops)]
    shares = [n if free_end and k == len(lines) else n + n % 2 for k, n in enumerate(shares)]
    spans = zip(itertools.pairwise(stops), shares, strict=True)
    return np.concatenate([*(np.linspace(begin, end, n, endpoint=False) for (begin, end), n in spans), [length]])


def sphere(
    *,
    radius: float,
    element_size: float | None = None,
    elements: int | None = None,
    symmetry: Symmetry = "none",
) -> Sheet:
    """A closed sphere about the origin with outward normals, nothing clamped.

    An octahedron on the axes, each edge divided in n, mapped by direction ~ sin(pi/2 x barycentric): no
    triangle has over 1.8 times the area of another, and no angle is below 45 degrees.

    Args:
        radius: Radius [m].
        element_size: Length of the edges [m]; or
        elements: About how many triangles, in the modelled part.
        symmetry: 'half' keeps x >= 0, 'quarter' x >= 0 and y >= 0.

    Returns:
        The sheet.

    Raises:
        InputError: A number is out of range, or not just one of `element_size` and `elements` is given.
    """
    parts = _parts(symmetry)
    radius = as_length("parison.radius", radius)
    arc = radius * math.pi / 2
    check_resolution(element_size, elements, largest=arc)
    division = grids.round_count(arc / element_size if element_size else math.sqrt((elements or 0) * parts / 8))
    if elements and symmetry == "quarter":
        division = max(2, division)
    check_count(8 * division**2 / parts, element_size)

    octants = [(a, b, c) for a in (1, -1) for b in (1, -1) for c in (1, -1)]
    kept = [signs for signs in octants if all(signs[axis] > 0 for axis in PLANES[symmetry])]
    corners = np.concatenate([grids.octant(division, signs) for signs in kept])
    lattice, index = np.unique(corners.reshape(-1, 3), axis=0, return_inverse=True)
    direction = np.sin(np.pi / 2 * lattice / division)
    positions = radius * direction / np.linalg.norm(direction, axis=1, keepdims=True)
    sheet = _sheet(positions, index.reshape(-1, 3), np.zeros(len(positions), dtype=bool), symmetry)
    return replace(sheet, snap=lambda middles, _, __: _scale_to_radius(middles, radius))


Ends = Literal["clamped", "guided", "free"]


def tube(
    *,
    radius: float | Profile,
    length: float,
    ends: Ends | Sequence[Ends] = "clamped",
    element_size: float | None = None,
    elements: int | None = None,
    symmetry: Symmetry = "none",
) -> Sheet:
    """A round tube about the z axis from z = 0 to the length, with outward normals.

    Near-square cells, their diagonals alternating; the nodes are on the circle.

    Args:
        radius: Radius [m], a number or a profile along z, as flare and die swell make it.
        length: Length [m].
        ends: `clamped`: the two end rings never move; `guided`: they stay in their planes and are free in these, as
            those of a part of a long tube, or of a parison that mold halves flatten; `free`: nothing holds them. One
            for both ends, or two: for the end at z = 0 and for that at the length.
        element_size: Length of the cells' sides [m]; or
        elements: About how many triangles, in the modelled part.
        symmetry: 'half' keeps x >= 0, 'quarter' x >= 0 and y >= 0.

    Returns:
        The sheet; nodes run along z first.

    Raises:
        InputError: A number is out of range, or not just one of `element_size` and `elements` is given.
    """
    parts = _parts(symmetry)
    length = as_length("parison.length", length)
    if isinstance(radius, Profile):
        if radius.along != "z":
            raise InputError("a tube's radius varies along z", "use z", f"{radius.key}.along", radius.along)
        profile = radius.positive()
    else:
        profile = Profile("z", (0.0,), (as_length("parison.radius", radius),), "parison.radius")
    both = [ends, ends] if isinstance(ends, str) else list(ends)
    if len(both) != 2 or any(end not in ("clamped", "guided", "free") for end in both):
        raise InputError(
            "is not a kind of ends", "use clamped, guided or free, for both or one for each", "parison.ends", ends
        )
    heights = np.linspace(0.0, length, 1001)
    arc = 2.0 * math.pi / parts * float(np.interp(heights, profile.at, profile.value).mean())
    check_resolution(element_size, elements, largest=min(arc, length))
    around, along = grids.cell_counts([arc, length], element_size, elements)
    # Diagonals alternate: a closed ring has an even number of cells, and between clamped ends none is cut off.
    around = max(around + around % 2, 4) if symmetry == "none" else max(around, 2)
    along += along % 2
    check_count(2 * around * along, element_size)

    turn = 2.0 * math.pi / parts * (np.arange(around + 1) / around) - (0.5 * math.pi if symmetry == "half" else 0.0)
    x, y = np.cos(turn), np.sin(turn)
    if symmetry != "none":
        x[-1] = 0.0
        (x if symmetry == "half" else y)[0] = 0.0
    triangles, heights = grids.union_jack(around, along), length * (np.arange(along + 1) / along)
    if symmetry == "none":
        x, y, triangles = x[:-1], y[:-1], triangles % (around * (along + 1))
    positions = np.stack([np.repeat(x, along + 1), np.repeat(y, along + 1), np.tile(heights, len(x))], axis=1)
    positions[:, :2] *= profile.over(positions)[:, None]
    at_end = [positions[:, 2] == height for height in (0.0, length)]
    clamped, guided = (
        np.logical_or.reduce([there & (end == kind) for there, end in zip(at_end, both, strict=True)])
        for kind in ("clamped", "guided")
    )
    sheet = _sheet(positions, triangles, clamped, symmetry)
    sheet.fixed[:, 2] |= guided
    sheet = replace(sheet, guided=(2,) if guided.any() else ())
    return replace(sheet, snap=lambda middles, _, __: _scale_to_cylinder(middles, profile(middles)))


def _scale_to_cylinder(points: NDArray[np.float64], radius: NDArray[np.float64]) -> NDArray[np.float64]:
    """Points (n, 3) [m] moved to distances (n,) [m] from the z axis."""
    factor = radius / np.linalg.norm(points[:, :2], axis=1)
    return points * np.stack([factor, factor, np.ones(len(points))], axis=1)


def preform(
    *,
    profile: ArrayLike,
    element_size: float | None = None,
    elements: int | None = None,
    symmetry: Symmetry = "none",
) -> Sheet:
    """A preform: a profile turned about the z axis, closed at the pole and clamped at its open neck; outward normals.

    Rings lie about an element size apart along the profile, one on each of its corners, with segments of that length,
    as those of a disc: triangles at the pole are as large as others. In a half or quarter, diagonals alternate between
    rings with as many segments.

    Args:
        profile: Points r, z [m] of the middle of the wall, from the pole (r = 0) to the neck or from the neck to the
            pole, shape (k, 2).
        element_size: Length of the edges [m]; or
        elements: About how many triangles, in the modelled part.
        symmetry: 'half' keeps x >= 0, 'quarter' x >= 0 and y >= 0.

    Returns:
        The sheet; nodes run ring by ring from the pole. Its field `arc` (n,) is the distance from the pole along the
        profile [m]. New nodes of a refined mesh go to the surface of revolution.

    Raises:
        InputError: The profile does not reach the axis with one end, has a negative radius, crosses itself or encloses
            no volume; a number is out of range, or not just one of `element_size` and `elements` is given.
    """
    parts = _parts(symmetry)
    turned = meridian.make_meridian(profile)
    check_resolution(element_size, elements, largest=turned.length)
    # A triangle has half a segment times the distance of rings: pi / DENSITY sizes squared.
    share = turned.area / parts * meridian.DENSITY / math.pi
    size = element_size if element_size else math.sqrt(share / (elements or 1))
    check_count(share / size**2, element_size)
    positions, triangles, ring_of = meridian.turn_rings(turned, size, symmetry, parts)
    if turned.volume > 0.0:
        triangles = triangles[:, [0, 2, 1]]
    sheet = _sheet(positions, triangles, ring_of == ring_of[-1], symmetry)
    return replace(sheet, fields={"arc": turned.nearest(positions)}, snap=turned.snap)


def bottle_half(
    *,
    height: float = 0.23,
    radius: float = 0.04,
    neck_radius: float = 0.014,
    hole: Sequence[float] = (0.0075, 0.027),
    element_size: float = 0.0071,
    swell: float = 0.3,
    neck_swell: float | None = None,
    inset: float = 1.0e-3,
) -> Sheet:
    """Half of a flattened parison in the mold of half a bottle: pinched along its outline and round the handle's hole.

    Args:
        height: Height of the bottle, from the bottom, y = 0, to the neck [m].
        radius: Radius of the bottle's body [m].
        neck_radius: [m].
        hole: Half width and half height of the handle's hole [m].
        element_size: Length of the edges [m] in the plane of the outline, halved in narrow parts.
        swell: Degree to which it is blown up already: 0 is flat, 1 the bottle.
        neck_swell: The same at the neck, which a blow pin holds round; by default as elsewhere.
        inset: Distance inside the bottle's outline at which it is pinched [m].

    Returns:
        The sheet, z >= 0, outward normals, clamped all along its edge.

    Raises:
        InputError: A number is out of range, or the parts do not fit into each other.
    """
    for key, share in (("swell", swell), ("neck_swell", swell if neck_swell is None else neck_swell)):
        if not 0 < share < 1:
            raise InputError(
                "is not a fraction of the bottle", "give a number between 0 and 1", f"parison.{key}", share
            )
    if not 0 < inset <= 0.3 * hole[0]:
        raise InputError("does not fit the bottle", f"use up to {0.3 * hole[0]:.4g} m", "parison.inset", inset)
    from jaxform.mesh import bottle

    shape = bottle.Bottle(height, radius, neck_radius, (hole[0], hole[1]))
    try:
        positions, triangles = bottle.half_bottle(shape, element_size, swell=swell, neck_swell=neck_swell, inset=inset)
    except InputError as error:
        raise replace(error, key=f"parison.{error.key}") from None
    clamped = np.isin(np.arange(len(positions)), topology.boundary_nodes(triangles))
    return Sheet(positions, triangles, clamped, np.zeros(positions.shape, dtype=bool))


def _parts(symmetry: str) -> int:
    if symmetry not in PARTS:
        raise InputError("is not a symmetry", f"use {', '.join(PARTS)}", "parison.symmetry", symmetry)
    return PARTS[symmetry]


def _sheet(
    positions: NDArray[np.float64],
    triangles: NDArray[np.integer],
    clamped: NDArray[np.bool_],
    symmetry: str,
    cut_at: Sequence[float] = (0.0, 0.0),
) -> Sheet:
    fixed = np.zeros(positions.shape, dtype=bool)
    for axis in PLANES[symmetry]:
        fixed[:, axis] = positions[:, axis] == cut_at[axis]
    return Sheet(positions, triangles.astype(np.int32), clamped, fixed)


def cut_sheet(sheet: Sheet, level: topology.Level) -> Sheet:
    """A sheet, without fields, with edges of elements along the line where a level is 0; see `topology.cut_along`."""
    positions, triangles, ends = topology.cut_along(sheet.positions, sheet.triangles, level)
    return _with_new_nodes(sheet, positions, triangles, ends)


def clamp_borders(sheet: Sheet, region: NDArray[np.integer], *, cut: bool) -> Sheet:
    """A sheet whose nodes between triangles of different regions (m,) are clamped, as a clamp grid holds it.

    Args:
        sheet: The sheet.
        region: A number for each triangle.
        cut: True to cut inner edges between clamped nodes in their middle, so that every element can move.
    """
    low, high = (np.full(len(sheet.positions), start) for start in (region.max(), region.min()))
    np.minimum.at(low, sheet.triangles, region[:, None])
    np.maximum.at(high, sheet.triangles, region[:, None])
    held = replace(sheet, clamped=sheet.clamped | (low < high))
    if not cut:
        return held
    inner = [topology.edges(sheet.triangles[region == number]) for number in np.unique(region)]
    chords = np.concatenate([edge[(count == 2) & held.clamped[edge].all(1)] for edge, count in inner])
    chords = chords[np.lexsort(chords.T[::-1])]  # in the order of all edges, whatever their region
    middles = sheet.positions[chords].mean(1)
    made = _with_new_nodes(held, *topology.split_edges(sheet.positions, sheet.triangles, chords, middles), chords)
    return replace(made, clamped=np.append(held.clamped, np.zeros(len(chords), bool)))


def _with_new_nodes(
    sheet: Sheet, positions: NDArray[np.float64], triangles: NDArray[np.integer], ends: NDArray[np.int64]
) -> Sheet:
    """A sheet with another mesh, whose new nodes cut edges (k, 2); those on the rim are held as their ends are."""
    rim = np.isin(np.arange(len(sheet.positions), len(positions)), topology.boundary_nodes(triangles))
    clamped = np.append(sheet.clamped, rim & sheet.clamped[ends].all(1))
    fixed = np.concatenate([sheet.fixed, rim[:, None] & sheet.fixed[ends].all(1)])
    return replace(
        sheet, positions=positions, triangles=triangles.astype(np.int32), clamped=clamped, fixed=fixed, fields={}
    )


def outline(
    *,
    polygon: ArrayLike,
    element_size: float | None = None,
    elements: int | None = None,
    planes: Sequence[str] = (),
) -> Sheet:
    """A sheet of any planform in z = 0 with normals +z, clamped along its edge, off the symmetry planes.

    Args:
        polygon: Corners x, y [m] in either order, shape (k, 2).
        element_size: Length of the edges [m], less where the planform is narrow; or
        elements: About how many triangles.
        planes: 'x' means that the polygon is cut at x = 0, and the rest is its image.

    Returns:
        The sheet. New nodes of a refined rim go to the polygon.

    Raises:
        InputError: A number is out of range, or the polygon crosses itself, has no area, or is too narrow.
    """
    corners = outlines.clean(polygon)
    check_resolution(element_size, elements, largest=float(np.ptp(corners, axis=0).min()))
    area = outlines.area(corners)
    size = element_size if element_size else triangle_side(area, elements or 1)
    check_count(4 / math.sqrt(3) * area / size**2, element_size)
    corners, fixed = snap_corners(corners, planes)
    at_cut_ends = (fixed != np.roll(fixed, 1, axis=0)).any(1) | (fixed != np.roll(fixed, -1, axis=0)).any(1)
    points, triangles = planform.fill_polygon(corners, size, at_cut_ends)
    sheet = from_mesh(Mesh(np.insert(points, 2, 0.0, axis=1), triangles), planes=planes)
    return replace(sheet, snap=planform.snap_to_polygon(corners))


def from_mesh(mesh: Mesh, *, flip: bool = False, clamp: str = "boundary", planes: Sequence[str] = ()) -> Sheet:
    """A user's mesh as a sheet: welded and checked.

    Args:
        mesh: The mesh, positions in m.
        flip: Turn the normals round.
        clamp: Nodes that never move: 'boundary' (open edges off the symmetry planes), 'none', or 'field:NAME'
            (where that field of the mesh is not zero).
        planes: Symmetry planes: 'x' means that the mesh is cut at x = 0, 'x=0.15' that it is at 0.15 m.

    Returns:
        The sheet, with the fields of the mesh.

    Raises:
        InputError: Triangles without area, with normals that disagree or three to an edge; a plane without
            nodes or with nodes on both sides; an open part that nothing clamps; nothing left to move; no such
            field.
    """
    mesh = meshes.weld(mesh)
    check_surface(mesh)
    positions, fixed = snap_to_planes(mesh.positions, planes)
    rim = topology.boundary_edges(mesh.triangles)
    # An edge is cut, not open, when one plane holds both its ends; rim corners are ends of open edges too.
    rim = rim[~(fixed[rim[:, 0]] & fixed[rim[:, 1]]).any(axis=1)]
    clamped = clamped_nodes(mesh, clamp, rim)
    part = topology.components(mesh.triangles, len(positions))
    loose = np.setdiff1d(part[rim], part[clamped])
    if loose.size:
        node = int(rim[np.isin(part[rim[:, 0]], loose), 0][0])
        where = ", ".join(f"{x:.6g}" for x in positions[node])
        problem = f"unclamped open parison: nothing constrains the part with the open edge at ({where}) m"
        raise InputError(problem, "clamp its boundary, close it, or name its symmetry planes", "parison.clamp", clamp)
    if clamped.all():
        raise InputError("clamps every node", "refine the mesh or clamp less", "parison.clamp", clamp)
    triangles = mesh.triangles[:, [0, 2, 1]] if flip else mesh.triangles
    nodal = volumes.nodal_fields(mesh)
    return Sheet(positions, triangles, clamped, fixed, nodal, cell_fields=mesh.cell_fields)

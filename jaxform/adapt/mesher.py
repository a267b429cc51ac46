"""Remeshing of a sheet with elements of given sizes, by Mmg. On the host.

Mmg preserves the references of boundary edges, which here encode their constraints: clamped, in a symmetry plane, free.
New nodes on the boundary get the constraint of their edge. Mmg puts nodes of boundaries and curved surfaces on its own
reconstruction of them; they are moved onto the true shape (`Sheet.snap`), or else onto the old mesh.

(Dapogny, Dobrzynski, Frey: Three-dimensional adaptive domain remeshing, implicit domain meshing, and applications to
free and moving boundary problems, J. Comput. Phys. 262 (2014) 358-378.)
"""

from __future__ import annotations

import contextlib
import importlib
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from jaxform.core.errors import InputError
from jaxform.mesh import topology
from jaxform.mesh.shapes import Sheet
from jaxform.mesh.volumes import areas, longest_sides
from jaxform.tools.distances import Distances, interpolate, signed_weights, weights

Array = NDArray[np.float64]
Index = NDArray[np.int64]
Mask = NDArray[np.bool_]

_GRADATION = 1.3  # ratio of the lengths of neighbouring edges, at most
_SMOOTH = 60.0  # degrees, below which edges of a curved surface are none of it, but of its triangles
_CORNER = 30.0  # degrees by which a boundary turns where it has a corner
_STRAIGHT = 1e-3  # radians, up to which it is straight
_DEVIATION = 0.05  # of the sheet's size, how far Mmg's curves may be from the old ones: sizes are given, not found so
_ROUNDS = 8  # of Mmg, until the number of elements is right
_SHORT_OF = 0.95  # of the elements that are wanted, as many as are enough
_SAME = 1e-9  # of the sheet's size: nodes as near are one
_PAIRS = 1_000_000  # of points and edges, processed together
_NOWHERE = np.zeros((0, 3))
_EQUILATERAL = 4.0 / np.sqrt(3.0)  # elements of unit side in a unit of area


def load_mmg() -> Any:
    """The module of Mmg.

    Raises:
        InputError: It is not installed.
    """
    try:
        return importlib.import_module("mmgpy")
    except ImportError:
        problem = "needs Mmg, which is not installed"
        raise InputError(problem, "pip install mmgpy (or jaxform[adapt])", "parison.adapt") from None


def remesh(sheet: Sheet, size: Array, elements: int, lines: Sequence[Array] = (), *, keep_lines: bool = True) -> Sheet:
    """A sheet with a new mesh.

    Boundary nodes stay where the boundary turns or is held in another way from there on; a node that is clamped inside,
    and a triangle of clamped nodes, stay as they are. No edge inside joins two nodes of a clamped boundary, so that
    every element moves. Fields are interpolated linearly.

    Args:
        sheet: The sheet.
        size: Lengths of the edges at its nodes (n_node,) [m], up to a common factor.
        elements: Largest number of triangles of the new mesh; it has at least nine tenths of that, unless the number
            jumps over these, as it can for a sheet of many equal parts.
        lines: Lines (k, 3) [m] on the sheet that are to be edges of the new mesh; left out where it cannot have them.
        keep_lines: False leaves out nodes of lines where elements between them are low, for these set the step of all.

    Returns:
        The sheet on its new mesh.

    Raises:
        InputError: Mmg is not installed, or cannot mesh the sheet with so few elements.
    """
    load_mmg()
    size = _scale_to_count(sheet, np.asarray(size, float), elements)
    if lines:
        with contextlib.suppress(InputError):
            find = _search_count if keep_lines else _search_with_lines
            return find(sheet, size, elements, lines)
    return _search_count(sheet, size, elements, ())


_LOW = 0.17  # of the height that elements of a size have: a lower one between nodes of lines costs many steps
_CLEARINGS = 8  # meshes without such nodes, at most
_CLEAR = 1.0  # of the size there, how far from such an element nodes of lines are left out


def _search_with_lines(sheet: Sheet, size: Array, elements: int, lines: Sequence[Array]) -> Sheet:
    """As `_search_count`; nodes of lines are left out where an element between them would be low."""
    low = _NOWHERE
    made = _search_count(sheet, size, elements, lines)
    for _ in range(_CLEARINGS):
        middle = made.positions[made.triangles].mean(1)
        height = _heights(made.positions, made.triangles) / _OldMesh(sheet).at(size, middle)
        found = middle[height < _LOW * np.median(height)]
        if not len(found):
            break
        low = np.concatenate([low, found])
        made = _search_count(sheet, size, elements, lines, low)
    return made


def _search_count(sheet: Sheet, size: Array, elements: int, lines: Sequence[Array], low: Array = _NOWHERE) -> Sheet:
    """The sheet on a mesh with at most so many elements, and nearly as many, by sizes up to a common factor.

    Nodes of lines near places (k, 3) [m] are left out.
    """
    best: Sheet | None = None
    factor, few, many = 1.0, np.inf, 0.0  # of the sizes: the present one, and those with few enough and too many
    for _ in range(_ROUNDS):
        made = _remesh_once(*_insert_points(sheet, size, lines, low)) if lines else _remesh_once(sheet, size)
        count = len(made.triangles)
        if count <= elements and (best is None or count > len(best.triangles)):
            best = made
        if _SHORT_OF * elements <= count <= elements:
            break
        few, many = (min(few, factor), many) if count <= elements else (few, max(many, factor))
        ratio = np.sqrt(count / (0.975 * elements))
        if few < np.inf and many > 0.0 and not many < factor * ratio < few:
            # The number jumps there: on the way back it would only be found again.
            ratio = np.sqrt(few * many) / factor
        size, factor = size * ratio, factor * ratio
    if best is None:
        problem = f"is too few elements for this sheet: its boundary needs {len(made.triangles)}"
        raise InputError(problem, "allow more elements", "parison.adapt.elements", elements)
    return best


def _scale_to_count(sheet: Sheet, size: Array, elements: int) -> Array:
    """Sizes (n_node,) [m] by which a mesh has about so many elements."""
    density = np.mean(1.0 / np.square(size)[sheet.triangles], axis=1)
    return size * np.sqrt(_EQUILATERAL * np.sum(areas(sheet.positions, sheet.triangles) * density) / elements)


_NONE = np.zeros(0, np.int64), np.zeros((0, 2), np.int64)


def _remesh_once(sheet: Sheet, size: Array, line_nodes: tuple[Index, Index] = _NONE) -> Sheet:
    """The remeshed sheet; nodes of lines (k,) stay where they are, and pairs of them (m, 2) are joined by edges."""
    required, pairs = line_nodes
    edge = topology.boundary_edges(sheet.triangles)
    kinds, reference = np.unique(_holds(sheet, edge), axis=0, return_inverse=True)
    points, triangles, edges, references = _call_mmg(sheet, size, edge, reference.ravel(), required)
    if len(pairs):
        triangles = _join_nodes(
            points, triangles, np.asarray(KDTree(points).query(sheet.positions[pairs])[1], np.int64), _SLIVER
        )
    return _held_sheet(sheet, _Boundary(edge, kinds, reference.ravel()), points, triangles, edges, references)


def _holds(sheet: Sheet, edge: Index) -> Array:
    """Constraints of boundary edges (k, 7): 1 if both ends are clamped, held along x, y, z; and the place [m] there."""
    fixed = sheet.fixed[edge].all(1)
    level = np.where(fixed, sheet.positions[edge[:, 0]], 0.0)
    return np.concatenate([sheet.clamped[edge].all(1)[:, None], fixed, level], axis=1).astype(float)


class _Boundary:
    """The old boundary: its edges (k, 2), kinds of holding (m, 7), and which of these each has (k,)."""

    def __init__(self, edge: Index, kinds: Array, kind: Index) -> None:
        self.edge, self.kinds, self.kind = edge, kinds, kind


def _call_mmg(
    sheet: Sheet, size: Array, edge: Index, reference: Index, required: Index
) -> tuple[Array, Index, Index, Index]:
    """Points (n, 3) [m], triangles (m, 3), boundary edges (k, 2) and their references (k,) of Mmg's mesh."""
    mmgpy, flat = load_mmg(), bool(np.ptp(sheet.positions[:, 2]) == 0.0)
    mesh = mmgpy.MmgMesh2D() if flat else mmgpy.MmgMeshS()
    mesh.set_mesh_size(vertices=len(sheet.positions), triangles=len(sheet.triangles), edges=len(edge))
    mesh.set_vertices(np.ascontiguousarray(sheet.positions[:, : 2 if flat else 3]))
    mesh.set_triangles(np.ascontiguousarray(sheet.triangles, np.int32))
    if len(edge):
        # Zero would be no reference at all.
        mesh.set_edges(np.ascontiguousarray(edge, np.int32), (reference + 1).astype(np.int32))
    own, corners = _required_nodes(sheet, edge, reference)
    if len(corners):
        mesh.set_corners(corners.astype(np.int32))
    required = np.union1d(own, required)
    if len(required):
        mesh.set_required_vertices(required.astype(np.int32))
    still = np.flatnonzero(sheet.clamped[sheet.triangles].all(1))
    if len(still):
        mesh.set_required_triangles(still.astype(np.int32))
    mesh.set_field("metric", size[:, None])
    extent = float(np.ptp(sheet.positions, axis=0).max())
    angle = {} if flat else {"ar": _SMOOTH}
    options = dict(
        hmin=0.5 * float(size.min()),
        hmax=2.0 * float(size.max()),
        hgrad=_GRADATION,
        hausd=_DEVIATION * extent,
        verbose=-1,
        **angle,
    )
    try:
        mesh.remesh(**options)
    except RuntimeError as error:
        problem = f"Mmg cannot mesh the sheet ({error})"
        raise InputError(problem, "begin with another mesh", "parison.adapt") from None
    points, triangles = np.asarray(mesh.get_vertices(), float), np.asarray(mesh.get_triangles(), np.int64)
    edges, references = mesh.get_edges_with_refs() if len(edge) else (np.zeros((0, 2)), np.zeros(0))
    if flat:
        points = np.column_stack([points, np.full(len(points), sheet.positions[0, 2])])
    return points, triangles, np.asarray(edges, np.int64), np.asarray(references, np.int64) - 1


def _required_nodes(sheet: Sheet, edge: Index, reference: Index) -> tuple[Index, Index]:
    """Nodes that stay where they are, and the corners among them.

    Nodes where a boundary turns or is held in another way from there on; where nothing says what the true boundary is,
    those at each of its bends; and clamped nodes inside.
    """
    count = len(sheet.positions)
    way = sheet.positions[edge[:, 1]] - sheet.positions[edge[:, 0]]
    way /= np.linalg.norm(way, axis=1, keepdims=True)
    ends, number = edge.T.ravel(), np.tile(np.arange(len(edge)), 2)
    order = np.argsort(ends, kind="stable")
    pair = number[order].reshape(-1, 2) if (np.bincount(ends, minlength=count) % 2 == 0).all() else number[order]
    if pair.ndim == 1 or (np.bincount(ends, minlength=count) > 2).any():
        return np.unique(ends), np.unique(ends)  # boundaries that meet at a node: all of them stay
    node, (one, other) = ends[order][::2], pair.T
    sense = np.where(edge[one, 1] == node, 1.0, -1.0) * np.where(edge[other, 0] == node, 1.0, -1.0)
    straight = np.clip(np.sum(way[one] * way[other], axis=1) * sense, -1.0, 1.0)
    turn = np.arccos(straight)
    corner = (turn > np.radians(_CORNER)) | (reference[one] != reference[other])
    bend = corner if sheet.snap is not None else corner | (turn > _STRAIGHT)
    inside = np.setdiff1d(np.flatnonzero(sheet.clamped), ends)
    return np.concatenate([node[bend], inside]), node[corner]


def _held_sheet(
    sheet: Sheet, boundary: _Boundary, points: Array, triangles: Index, edges: Index, references: Index
) -> Sheet:
    """The new mesh with the constraints of the old one, its nodes moved onto the true shape."""
    clamped, fixed = np.zeros(len(points), bool), np.zeros(points.shape, bool)
    for number, kind in enumerate(boundary.kinds):
        nodes = np.unique(edges[references == number])
        clamped[nodes] |= bool(kind[0])
        fixed[nodes] |= kind[1:4].astype(bool)
    points = _place_nodes(sheet, boundary, points, edges, references)
    inside = np.setdiff1d(np.flatnonzero(sheet.clamped), boundary.edge)
    if len(inside):
        away, node = KDTree(sheet.positions[inside]).query(points)
        same = away <= _SAME * np.ptp(sheet.positions, axis=0).max()
        clamped |= same
        points = np.where(same[:, None], sheet.positions[inside][node], points)
    points, triangles = _cut_chords(points, triangles, edges, clamped)
    added = len(points) - len(clamped)
    return replace(
        sheet,
        positions=points,
        triangles=triangles.astype(np.int32),
        clamped=np.append(clamped, np.zeros(added, bool)),
        fixed=np.concatenate([fixed, np.zeros((added, 3), bool)]),
        fields=carry_fields(sheet, points),
        cell_fields={},
    )


def _place_nodes(sheet: Sheet, boundary: _Boundary, points: Array, edges: Index, references: Index) -> Array:
    """The points (n, 3) [m] on the true surface and boundary, and exactly in their symmetry planes."""
    points = points.copy()
    if np.ptp(sheet.positions[:, 2]) > 0.0:
        on_old = _OldMesh(sheet).nearest(points) if sheet.snap is None else points
        points = _snap(sheet, on_old, np.repeat(on_old[:, None], 2, axis=1), rim=False)
    for number, kind in enumerate(boundary.kinds):
        nodes = np.unique(edges[references == number])
        if not kind[1:4].any():
            place, ends = _on_edges(sheet.positions[boundary.edge[boundary.kind == number]], points[nodes])
            points[nodes] = place if sheet.snap is None else _snap(sheet, points[nodes], ends, rim=True)
    for kind, number in zip(boundary.kinds, range(len(boundary.kinds)), strict=True):
        nodes = np.unique(edges[references == number])
        for axis in np.flatnonzero(kind[1:4]):
            points[nodes, axis] = kind[4 + axis]
    return points


def _snap(sheet: Sheet, points: Array, ends: Array, *, rim: bool) -> Array:
    """Points (n, 3) [m], near edges with ends (n, 2, 3) [m], moved onto the true shape of the sheet."""
    return points if sheet.snap is None else sheet.snap(points, ends, np.full(len(points), rim))


def _on_edges(edges: Array, points: Array) -> tuple[Array, Array]:
    """The places (n, 3) [m] on edges (k, 2, 3) [m] nearest to points (n, 3), and the ends (n, 2, 3) of those edges."""
    begin, way = edges[:, 0], edges[:, 1] - edges[:, 0]
    square = np.sum(way * way, axis=1)
    places, nearest = np.empty_like(points), np.empty(len(points), np.int64)
    for part in np.array_split(np.arange(len(points)), 1 + len(points) * len(edges) // _PAIRS):
        away = points[part, None] - begin
        share = np.clip(np.sum(away * way, axis=2) / square, 0.0, 1.0)
        off = np.sum(np.square(away - share[..., None] * way), axis=2)
        nearest[part] = np.argmin(off, axis=1)
        chosen = nearest[part], np.take_along_axis(share, nearest[part][:, None], axis=1)
        places[part] = begin[chosen[0]] + chosen[1] * way[chosen[0]]
    return places, edges[nearest]


class _OldMesh:
    """The mesh before: the places nearest to points, and nodal values there."""

    def __init__(self, sheet: Sheet) -> None:
        self.sheet = sheet
        self.distances = Distances(sheet.positions, sheet.triangles, float(np.ptp(sheet.positions, axis=0).max()))

    def nearest(self, points: Array) -> Array:
        """The nearest places (n, 3) [m]."""
        return self.distances.nearest(points).place

    def at(self, values: Array, points: Array) -> Array:
        """Nodal values (n_node, ...) there (n, ...)."""
        found, triangles = self.distances.nearest(points), self.sheet.triangles
        weight = weights(found.place, self.sheet.positions[triangles[found.triangle]])
        return interpolate(values, triangles, found.triangle, weight)


def carry_fields(sheet: Sheet, points: Array) -> dict[str, Array]:
    """The sheet's nodal fields at points (n, 3) [m], linear within its triangles."""
    if not sheet.fields:
        return {}
    values = _OldMesh(sheet).at(np.stack(list(sheet.fields.values()), axis=1), points)
    return dict(zip(sheet.fields, values.T, strict=True))


def _cut_chords(points: Array, triangles: Index, edges: Index, clamped: Mask) -> tuple[Array, Index]:
    """The mesh with each inner edge that joins two clamped nodes of the boundary cut in its middle."""
    sides, base = topology.edges(triangles)[0], len(points)
    rim = np.unique(edges)
    joins = clamped[sides].all(1) & np.isin(sides, rim).all(1)
    joins &= ~np.isin(sides @ [base, 1], np.sort(edges, axis=1) @ [base, 1])
    if not joins.any():
        return points, triangles
    chords = sides[joins]
    return topology.split_edges(points, triangles, chords, points[chords].mean(1))


_LEFT = 0.3  # of the area of a triangle, or of two, which each keeps when nodes move
_FLATTEST = 0.4  # of the height of low triangles, which each keeps when nodes move: the lowest sets the step of all
_SMALL = 0.05  # share of the triangles which are low


def move_nodes(sheet: Sheet, places: Array, pairs: Index) -> Sheet:
    """The sheet with its nodes at other places, on its surface and in its symmetry planes.

    Nodes that are clamped, or on another boundary, stay, and so does one of which a triangle would become a sliver, or
    so low that steps become much shorter.

    Args:
        sheet: The sheet.
        places: The places (n_node, 3) [m].
        pairs: Pairs of nodes (m, 2) which are joined by turning the side between them, where both were moved.
    """
    rim = np.unique(topology.boundary_edges(sheet.triangles))
    still = sheet.clamped.copy()
    still[rim] |= ~sheet.fixed[rim].any(1)
    places = np.where(still[:, None] | sheet.fixed, sheet.positions, places)
    places = to_surface(sheet, places)
    wanted = np.flatnonzero((places != sheet.positions).any(1))
    normal = topology.doubled_normals(sheet.positions, sheet.triangles)
    square, points = np.sum(normal * normal, axis=1), sheet.positions.copy()
    height, around = _heights(points, sheet.triangles), _triangles_of_nodes(sheet.triangles, len(points))
    lowest = _FLATTEST * float(np.quantile(height, _SMALL))
    least = np.minimum(height, lowest)
    for node in wanted[np.argsort(np.linalg.norm(places - sheet.positions, axis=1)[wanted])]:
        own = around[node]
        last, points[node] = points[node].copy(), places[node]
        new = topology.doubled_normals(points, sheet.triangles[own])
        flat = np.sum(new * normal[own], axis=1) < _LEFT * square[own]
        if (flat | (_heights(points, sheet.triangles[own]) < least[own])).any():
            points[node] = last
    there = (points == places).all(1)
    pairs = pairs[there[pairs].all(1)]
    triangles = _join_nodes(points, np.asarray(sheet.triangles, np.int64), pairs, _LEFT, lowest)
    return replace(sheet, positions=points, triangles=triangles.astype(np.int32), fields=carry_fields(sheet, points))


def to_surface(sheet: Sheet, places: Array) -> Array:
    """Places (n_node, 3) [m] of a sheet's nodes, on its true surface and in its symmetry planes."""
    moved = (places != sheet.positions).any(1)
    if not moved.any() or np.ptp(sheet.positions[:, 2]) == 0.0:
        return places
    on_old = _OldMesh(sheet).nearest(places[moved])
    on_surface = places.copy()
    on_surface[moved] = _snap(sheet, on_old, np.repeat(on_old[:, None], 2, axis=1), rim=False)
    return np.where(sheet.fixed, sheet.positions, on_surface)


def divide_sides(sheet: Sheet, ends: Index, share: Array, elements: int) -> Sheet:
    """The sheet with new nodes on sides of its triangles, the first ones first, as far as these may be so many.

    A triangle is divided once, and only where each part is as high as the lowest triangle: steps become hardly shorter.

    Args:
        sheet: The sheet.
        ends: The ends (k, 2) of the sides.
        share: The places (k,) on them, from 0 at the first end to 1 at the second.
        elements: Largest number of triangles.
    """
    beside, height = _triangles_of_sides(sheet.triangles), _heights(sheet.positions, sheet.triangles)
    places = sheet.positions[ends[:, 0]] + share[:, None] * (sheet.positions[ends[:, 1]] - sheet.positions[ends[:, 0]])
    on_rim = np.array([len(beside.get((min(pair), max(pair)), [])) == 1 for pair in ends], bool)
    fixed = sheet.fixed[ends].all(1) & on_rim[:, None]
    places = np.where(fixed, places, _snap(sheet, places, sheet.positions[ends], rim=False))
    chosen, divided, count = list[int](), np.zeros(len(sheet.triangles), bool), len(sheet.triangles)
    for number, (pair, place) in enumerate(zip(ends, places, strict=True)):
        own = beside.get((min(pair), max(pair)), [])  # none where it was turned
        if not own or sheet.clamped[pair].all() or divided[own].any() or count + len(own) > elements:
            continue
        parts = topology.split_edges(sheet.positions, sheet.triangles[own], pair[None], place[None])
        if _heights(*parts).min() >= height.min():
            chosen.append(number)
            divided[own], count = True, count + len(own)
    points, triangles = topology.split_edges(sheet.positions, sheet.triangles, ends[chosen], places[chosen])
    return replace(
        sheet,
        positions=points,
        triangles=triangles.astype(np.int32),
        clamped=np.append(sheet.clamped, np.zeros(len(chosen), bool)),
        fixed=np.concatenate([sheet.fixed, fixed[chosen]]),
        fields=carry_fields(sheet, points),
        cell_fields={},
    )


def _triangles_of_sides(triangles: NDArray[np.integer]) -> dict[tuple[int, int], list[int]]:
    """The numbers of the triangles beside each side, smaller end first."""
    beside: dict[tuple[int, int], list[int]] = {}
    for number, corners in enumerate(triangles.tolist()):
        for one, other in zip(corners, corners[1:] + corners[:1], strict=True):
            beside.setdefault((min(one, other), max(one, other)), []).append(number)
    return beside


def _heights(points: Array, triangles: NDArray[np.integer]) -> Array:
    """The lowest heights (m,) [m] of triangles."""
    return 2.0 * areas(points, triangles) / longest_sides(points[triangles])


# Lines that are to be edges of the new mesh: nodes along them, as far apart as the sizes say, are put into the old mesh
# as vertices that Mmg keeps. Between two that are about a size apart, an equilateral mesh has an edge.

_APART = 0.6  # of the size: nodes of different lines are no nearer
_OFF_RIM = 0.5  # of the size: nodes are no nearer to the boundary; where it is not clamped, they are put on it
_TOGETHER = 1.6  # of the size: points of a line that are no farther apart are joined
_SLIVER = 0.1  # of the area of two triangles, which each is larger than when the edge between them has been turned
_ON_SIDE = 0.1  # share of a triangle's height: a point as near to a side divides the side, not the triangle


def _space_points(sheet: Sheet, old: _OldMesh, size: Array, lines: Sequence[Array]) -> tuple[Array, Index]:
    """Points (n, 3) [m] along lines, about a size apart, and pairs (m, 2) of those that follow one another on a line.

    The ends of all lines are chosen first, then what is between them. A point as near to another one as to be left out
    is replaced by it in its line.
    """
    along = np.split(old.at(size, np.concatenate(lines)), np.cumsum([len(line) for line in lines])[:-1])
    found = []
    for number, (line, own) in enumerate(zip(lines, along, strict=True)):
        each = np.linalg.norm(np.diff(line, axis=0), axis=1) / (0.5 * (own[1:] + own[:-1]))
        arc = np.append(0.0, np.cumsum(each))
        at = np.linspace(0.0, arc[-1], max(1, round(arc[-1])) + 1)
        # Three coordinates and the size there; the line, the place on it, and whether it is between the ends.
        values = [np.interp(at, arc, row) for row in (*line.T, own)]
        found.append(np.stack([*values, np.full_like(at, number), at, (at > 0.0) & (at < arc[-1])], axis=1))
    points = _move_to_rim(sheet, np.concatenate(found))
    points = points[np.argsort(points[:, 6], kind="stable")]
    chosen, same = np.zeros((0, 3)), []
    for *place, apart in points[:, :4].tolist():
        away = np.linalg.norm(chosen - place, axis=1)
        is_new = not len(chosen) or away.min() > _APART * apart
        same.append(len(chosen) if is_new else int(np.argmin(away)))
        chosen = np.concatenate([chosen, [place]]) if is_new else chosen
    order = np.lexsort((points[:, 5], points[:, 4]))
    pairs, of = np.array(same, np.int64)[np.stack([order[:-1], order[1:]], axis=1)], points[order]
    near = np.linalg.norm(chosen[pairs[:, 0]] - chosen[pairs[:, 1]], axis=1) < _TOGETHER * of[1:, 3]
    return chosen, pairs[near & (pairs[:, 0] != pairs[:, 1]) & (of[1:, 4] == of[:-1, 4])]


def _move_to_rim(sheet: Sheet, points: Array) -> Array:
    """The points (k, ...), places [m] and sizes [m], without those near a clamped boundary; near another one, on it."""
    edge = topology.boundary_edges(sheet.triangles)
    clamped = sheet.clamped[edge].all(1)
    for kind in (clamped, ~clamped):
        if kind.any() and len(points):
            place, _ = _on_edges(sheet.positions[edge[kind]], points[:, :3])
            near = np.linalg.norm(place - points[:, :3], axis=1) < _OFF_RIM * points[:, 3]
            points[near, :3] = np.where(kind is clamped, np.nan, place[near])
            points = points[np.isfinite(points[:, 0])]
    return points


def _insert_points(
    sheet: Sheet, size: Array, lines: Sequence[Array], low: Array
) -> tuple[Sheet, Array, tuple[Index, Index]]:
    """The sheet and its sizes with nodes along lines; the numbers of these, and pairs of those to be joined.

    Nodes within a size of places (k, 3) [m] are left out.
    """
    old = _OldMesh(sheet)
    points, pairs = _space_points(sheet, old, size, lines)
    if len(points) and len(low):
        away, nearest = KDTree(low).query(points)
        stays = away > _CLEAR * old.at(size, low)[nearest]
        pairs = (np.cumsum(stays) - 1)[pairs[stays[pairs].all(1)]]
        points = points[stays]
    if not len(points):
        return sheet, size, _NONE
    division = _Division(sheet)
    owner = old.distances.nearest(points).triangle
    nodes = [division.add(place, triangle) for place, triangle in zip(points, owner.tolist(), strict=True)]
    numbers = np.array([-1 if node is None else node for node in nodes])
    pairs = numbers[pairs]
    positions, held = np.array(division.positions), np.array(division.held)
    made = replace(
        sheet,
        positions=positions,
        triangles=np.array(division.triangles, np.int32),
        clamped=held[:, 0],
        fixed=held[:, 1:],
        fields=carry_fields(sheet, positions),
        cell_fields={},
    )
    added = positions[len(sheet.positions) :]
    there = np.unique(numbers[numbers >= 0]), pairs[(pairs >= 0).all(1) & (pairs[:, 0] != pairs[:, 1])]
    return made, np.append(size, old.at(size, added)), there


def _triangles_of_nodes(triangles: NDArray[np.integer], count: int) -> list[Index]:
    """The numbers (k,) of the triangles of each node, in ascending order."""
    corners = triangles.ravel()
    last = np.cumsum(np.bincount(corners, minlength=count))[:-1]
    return np.split(np.argsort(corners, kind="stable") // 3, last)


def _join_nodes(points: Array, triangles: Index, pairs: Index, least: float, lowest: float = 0.0) -> Index:
    """The triangles with edges between pairs of nodes (m, 2), where turning the edge between leaves no sliver.

    Each new triangle has a share of both areas, at least, and a height [m].
    """
    triangles = triangles.copy()
    joined = {(int(min(pair)), int(max(pair))) for pair in pairs}
    around = _triangles_of_nodes(triangles, len(points)) if joined else []
    for a, b in joined:
        of_a, of_b = around[a], around[b]
        if len(np.intersect1d(of_a, of_b)):
            continue
        for one in of_a:
            k = int(np.flatnonzero(triangles[one] == a)[0])
            c, d = int(triangles[one][(k + 1) % 3]), int(triangles[one][(k + 2) % 3])
            other = [n for n in of_b if {c, d} <= set(triangles[n].tolist())]
            new = np.array([[a, c, b], [a, b, d]])
            if (
                other
                and (min(c, d), max(c, d)) not in joined
                and _turn_alike(points, new, triangles[[one, other[0]]], least)
                and _heights(points, new).min() >= lowest
            ):
                triangles[[one, other[0]]] = new
                around[a], around[b] = np.union1d(of_a, other[0]), np.union1d(of_b, one)
                around[c], around[d] = np.setdiff1d(around[c], other[0]), np.setdiff1d(around[d], one)
                break
    return triangles


def _turn_alike(points: Array, new: Index, old: Index, least: float) -> bool:
    """True if new triangles (2, 3) are on the same side as the old ones, each at least a share of their area."""
    normals = [topology.doubled_normals(points, triangles) for triangles in (new, old)]
    total = normals[1].sum(0)
    return bool((normals[0] @ total > least * (total @ total)).all())


class _Division:
    """A mesh whose triangles and sides are divided at points, one after the other."""

    def __init__(self, sheet: Sheet) -> None:
        self.positions: list[Array] = list(sheet.positions)
        self.triangles: list[list[int]] = sheet.triangles.tolist()
        self.held: list[Mask] = list(np.column_stack([sheet.clamped, sheet.fixed]))
        self.owner = list(range(len(self.triangles)))
        self.parts = [[k] for k in self.owner]
        self.at_side: dict[tuple[int, int], set[int]] = {}
        for number in self.owner:
            self._register(number)

    def _sides(self, number: int) -> list[tuple[int, int]]:
        a, b, c = self.triangles[number]
        return [(min(ends), max(ends)) for ends in ((b, c), (c, a), (a, b))]

    def _register(self, number: int) -> None:
        for side in self._sides(number):
            self.at_side.setdefault(side, set()).add(number)

    def _replace(self, number: int, parts: list[list[int]]) -> None:
        """Puts parts in the place of a triangle."""
        for side in self._sides(number):
            self.at_side[side].discard(number)
        others = range(len(self.triangles), len(self.triangles) + len(parts) - 1)
        self.triangles[number] = parts[0]
        self.triangles += parts[1:]
        self.owner += [self.owner[number]] * len(others)
        self.parts[self.owner[number]] += others
        for part in (number, *others):
            self._register(part)

    def add(self, place: Array, triangle: int) -> int | None:
        """The number of the node at a place (3,) [m] in one of the first triangles; None where there can be none."""
        parts = self.parts[triangle]
        corners = np.array([[self.positions[k] for k in self.triangles[part]] for part in parts])
        shares = signed_weights(place[None], corners)
        best = int(np.argmax(shares.min(1)))
        number, share = parts[best], shares[best]
        k = int(np.argmin(share))
        if share.max() > 1.0 - _SAME:
            return self.triangles[number][int(np.argmax(share))]
        side = self._sides(number)[k]
        beside = [other for other in self.at_side[side] if other != number]
        if share[k] > _ON_SIDE:
            return self._divide(place, side, [number], whole=True)
        if not beside:
            first, second = (self.positions[end] for end in side)
            way = second - first
            place = first + np.clip((place - first) @ way / (way @ way), 0.0, 1.0) * way
            node = self._divide(place, side, [number])
            if node is not None:
                self.held[node] = self.held[side[0]] & self.held[side[1]]
            return node
        return self._divide(place, side, [number, *beside]) or self._divide(place, side, [number], whole=True)

    def _divide(self, place: Array, side: tuple[int, int], triangles: list[int], *, whole: bool = False) -> int | None:
        """The node that divides triangles, joined to all of their sides or all but one; None if a part turned over."""
        node = len(self.positions)
        new = []
        for number in triangles:
            corners, normal = self.triangles[number], self._normal(self.triangles[number])
            parts = [
                [node, a, b]
                for a, b in ((corners[k], corners[(k + 1) % 3]) for k in range(3))
                if whole or (min(a, b), max(a, b)) != side
            ]
            if any(self._normal(part, place) @ normal <= _SAME * (normal @ normal) for part in parts):
                return None
            new.append((number, parts))
        for number, parts in new:
            self._replace(number, parts)
        self.positions.append(place)
        self.held.append(np.zeros(4, bool))
        return node

    def _normal(self, corners: list[int], place: Array | None = None) -> Array:
        """Twice a triangle's area times its normal [m^2]; its first corner is at the place, if one is given."""
        a, b, c = (self.positions[k] if place is None or k < len(self.positions) else place for k in corners)
        return np.cross(b - a, c - a)

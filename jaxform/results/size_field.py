"""Sizes that the elements of an adapted mesh should have, from the wall of a run.

An element's thickness misses the true one to first order in its size, the recovered one to second order: their
difference is an estimate of the error (Zienkiewicz, Zhu: A simple error estimator and adaptive procedure for practical
engineering analysis, Int. J. Numer. Meth. Eng. 24 (1987) 337-357). The error over the size, g, depends on the wall, not
on the mesh. For elements of size s the mean square error is the integral of (g s)^2, and their number that of 1/s^2:
the best sizes are in proportion to the inverse root of g. They are somewhat smaller where g is large, since nodes
that land there one after the other resolve the wall too. At a corner g has no limit, and is the larger the finer the
mesh on which it is found; but the smallest elements set the step of all. So sizes have a limit, relative to their mean.

An element has no kink. Where the sheet bends over a sharp edge of a tool, the line of the initial sheet that has come
to lie there should be one of nodes. Elements across an edge do not show where that line is, for they are stretched
alike on both sides of it: the elements beside them that lie on the tool do. At a clamp the line is known.
"""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from jaxform.mesh import topology
from jaxform.mesh.volumes import longest_sides
from jaxform.model.scene import Scene
from jaxform.results.result import Result
from jaxform.tools.distances import Distances, interpolate, nearest_places, signed_weights, weights
from jaxform.tools.mold import Mold

Array = NDArray[np.float64]

_POWER = 0.75  # of the rate, by which sizes fall
_LEAST = 0.02  # of the mean rate, the least that counts
_REACH = 0.5  # of an element's longest side, from an edge, over which the element is drawn
_STEP = 0.25  # of a formed element's side, between points of an edge that are looked up
_MOST_POINTS = 20_000  # of edges of a tool
_JUMP = 2.0  # of an initial element's side, between such points on the sheet: more is no line
_LEVEL = 0.1  # of an element's longest side, how far an edge may be from its plane for it to lie on a face at the edge
_CONE = 1e-3  # sine by which a place is between two faces, at least
_SMALLEST = 0.3  # of the size that as many equal elements would have, the least
_LIMITINGS = 8  # until the size of equal elements, which grows with the smallest, hardly changes
_SMOOTHINGS = 2  # of the squares of the rates: one element's says little


def wanted_sizes(scene: Scene, result: Result) -> Array:
    """Sizes of elements at the nodes (n_node,), up to a common factor: small where the error of the wall is large."""
    triangles, area = np.asarray(scene.parison.triangles), np.asarray(scene.tables.sheet.area, float)
    rate = np.square(element_errors(scene, result)) / area
    for _ in range(_SMOOTHINGS):
        nodal = _mean_at_nodes(rate, triangles, area, len(scene.parison.thickness))
        rate = nodal[triangles].mean(1)
    floor = np.square(_LEAST) * np.average(rate, weights=area)
    return _limit_sizes(np.maximum(nodal, max(floor, np.finfo(float).tiny)) ** (-0.5 * _POWER), triangles, area)


def _limit_sizes(size: Array, triangles: Any, area: Array) -> Array:
    """The sizes (n_node,), none of which is much smaller than that of as many equal elements."""
    for _ in range(_LIMITINGS):
        density = np.mean(1.0 / np.square(size)[triangles], axis=1)
        size = np.maximum(size, _SMALLEST / np.sqrt(np.average(density, weights=area)))
    return size


def element_errors(scene: Scene, result: Result) -> Array:
    """Estimated relative errors of the elements' thickness (n_element,): its logarithm less that of the recovered."""
    triangles = np.asarray(scene.parison.triangles)
    start = np.asarray(scene.parison.thickness, float)
    recovered = np.log(np.asarray(result.thickness, float) / start)[triangles].mean(1)
    return np.log(np.asarray(result.element_thickness, float) / start[triangles].mean(1)) - recovered


def mean_error(scene: Scene, result: Result) -> float:
    """The estimated relative rms error of the elements' thickness, by initial area."""
    return float(np.sqrt(np.average(np.square(element_errors(scene, result)), weights=scene.tables.sheet.area)))


def _mean_at_nodes(values: Array, triangles: Any, area: Array, count: int) -> Array:
    """Means by initial area over the elements of each node (n_node,)."""
    weight = np.bincount(triangles.ravel(), np.repeat(area, 3), count)
    total = np.bincount(triangles.ravel(), np.repeat(values * area, 3), count)
    return total / np.where(weight > 0.0, weight, 1.0)


def _mean_sides(points: Array, triangles: Any) -> Array:
    """Means (n_node,) [m] of the longest sides of each node's elements, with nodes at points (n_node, 3) [m]."""
    return _mean_at_nodes(longest_sides(points[triangles]), triangles, np.ones(len(triangles)), len(points))


def edge_lines(scene: Scene, result: Result) -> list[Array]:
    """Lines (k, 3) [m] on the initial sheet that have come to lie on sharp convex edges of tools to which it sticks."""
    molds = [(number, surface.mold) for number, surface in enumerate(scene.surfaces) if surface.mold.contact.sticks]
    return [line for number, mold in molds for line in _lines_at_edges(mold, number, scene, result)]


def _lines_at_edges(mold: Mold, number: int, scene: Scene, result: Result) -> list[Array]:
    """The lines that lie on edges of one tool, in whose frame edges and sheet are compared."""
    vertices = np.asarray(mold.vertices, float)
    edges = topology.sharp_edges(vertices, np.asarray(mold.triangles))
    if not edges.size:
        return []
    start, triangles = np.asarray(scene.parison.positions, float), np.asarray(scene.parison.triangles)
    formed = np.asarray(result.positions, float) - mold.offset_at(float(result.time))
    sides = longest_sides(formed[triangles])
    places, edge, path = _points_on_paths(vertices, edges, _STEP * float(np.median(sides)))
    found = Distances(formed, triangles, _REACH * float(sides.max())).nearest(places)
    weight = weights(found.place, formed[triangles[found.triangle]])
    on_sheet = interpolate(start, triangles, found.triangle, weight)
    touches = (np.asarray(result.stuck) & (np.asarray(result.tool) == number))[triangles]
    beside = touches.any(1) & ~touches.all(1) & ~np.asarray(scene.parison.clamped)[triangles].any(1)
    crossed = np.flatnonzero(beside[found.triangle])
    known, continued = _continue_held(places[crossed], triangles[touches.all(1)], formed, start)
    on_sheet[crossed[known]] = continued[known]
    near = (found.distance <= _REACH * sides[found.triangle]) & _is_convex(vertices, edges[:, edge], on_sheet)
    jump = np.linalg.norm(np.diff(on_sheet, axis=0), axis=1)
    breaks = ~near[1:] | ~near[:-1] | (path[1:] != path[:-1])
    breaks |= jump > _JUMP * longest_sides(start[triangles])[found.triangle[1:]]
    runs = np.split(np.arange(len(places)), np.flatnonzero(breaks) + 1)
    return [on_sheet[run] for run in runs if len(run) > 1]


def _continue_held(places: Array, held: Any, formed: Array, start: Array) -> tuple[Any, Array]:
    """Places (n, 3) [m] on the initial sheet, by the map of the nearest held element to it, continued beyond that.

    Args:
        places: Points (n, 3) [m] of edges of a tool.
        held: Elements (m, 3) that lie on the tool.
        formed: The formed nodes (n_node, 3) [m].
        start: The initial ones.

    Returns:
        Mask of the points (n,) that are near a held element and in its plane; the places (n, 3).
    """
    if not (len(places) and len(held)):
        return np.zeros(len(places), bool), np.zeros((len(places), 3))
    sides = longest_sides(formed[held])
    found = Distances(formed, held, float(sides.max())).nearest(places)
    corners = formed[held[found.triangle]]
    weight = signed_weights(places, corners)
    away = np.linalg.norm(np.einsum("nk,nki->ni", weight, corners) - places, axis=1)
    side = sides[found.triangle]
    return (found.distance <= side) & (away <= _LEVEL * side), interpolate(start, held, found.triangle, weight)


def _points_on_paths(vertices: Array, edges: NDArray[np.integer], step: float) -> tuple[Array, Any, Any]:
    """Points (n, 3) [m] along edges (4, n_edge), one after the other; the edge and the path (n,) that each is of."""
    number = {(a, b): k for k, (a, b) in enumerate(np.sort(edges[:2].T, axis=1).tolist())}
    paths = topology.edge_paths(edges[:2].T, _corners(vertices, edges[:2].T))
    length = np.linalg.norm(vertices[edges[1]] - vertices[edges[0]], axis=1).sum()
    step = max(step, float(length) / _MOST_POINTS)
    points, owner = [], []
    for path in paths:
        corners = vertices[path]
        arc = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(corners, axis=0), axis=1)))
        at = np.linspace(0.0, arc[-1], int(np.ceil(arc[-1] / step)) + 1)
        points.append(np.stack([np.interp(at, arc, row) for row in corners.T], axis=1))
        along = np.array([number[min(ends), max(ends)] for ends in itertools.pairwise(path)])
        owner.append(along[np.clip(np.searchsorted(arc, at) - 1, 0, len(along) - 1)])
    return np.concatenate(points), np.concatenate(owner), np.repeat(np.arange(len(paths)), [len(x) for x in points])


def _corners(vertices: Array, edges: NDArray[np.integer]) -> NDArray[np.int64]:
    """The vertices (k,) where two edges (n, 2) meet at an angle."""
    ends, ways = edges.T.ravel(), vertices[edges[:, 1]] - vertices[edges[:, 0]]
    ways = ways / np.maximum(np.linalg.norm(ways, axis=1, keepdims=True), np.finfo(float).tiny)
    total = np.zeros(vertices.shape)
    np.add.at(total, ends, np.concatenate([ways, -ways]))
    # Two unit vectors away from a vertex: their sum is long where the edges are not in line.
    return np.flatnonzero(np.linalg.norm(total, axis=1) > 2.0 * np.sin(np.radians(0.5 * topology.SHARPEST_FACETS)))


def _is_convex(vertices: Array, edges: NDArray[np.integer], places: Array) -> NDArray[np.bool_]:
    """True for edges (4, n) that are convex as seen from places (n, 3) [m] of the sheet: not between both faces."""
    begin, end, *thirds = (vertices[row] for row in edges)
    along = end - begin
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    away, *ways = (way - np.sum(way * along, axis=1)[:, None] * along for way in (x - begin for x in (places, *thirds)))
    size = np.linalg.norm(away, axis=1)
    ways = [way / np.linalg.norm(way, axis=1, keepdims=True) for way in ways]
    # Shares of the two faces' directions in the way to the place: both positive between them.
    mixed, one, other = np.sum(ways[0] * ways[1], axis=1), *(np.sum(way * away, axis=1) for way in ways)
    return (one - mixed * other <= _CONE * size) | (other - mixed * one <= _CONE * size)


# Nodes moved on the initial sheet, so that they land on sharp edges, not beside them.

_BESIDE = 0.5  # of the mean formed side at a node: it is moved onto an edge no farther away
_CUT_EDGE = 0.02  # of it: an element that cuts a tool deeper has a convex edge of that beside it
_AT_CORNER = 0.3  # of the mean formed side at a node: it is moved onto a corner no farther away
_ALONG = 0.8  # cosine to the edge, of a way between nodes that follow one another on it
_KINK = 2.0  # of the mean formed side at a node: the kink over an edge no farther away is in its patch
_ROUNDING = 1e-9  # of a distance, by which points are looked up farther away
_ON_EDGE = 0.002  # of it: an element as near to the place of an edge is held there, or has a node there


def places_at_edges(scene: Scene, result: Result, depth: Array) -> tuple[Array, NDArray[np.int64]]:
    """Places on the initial sheet (n_node, 3) [m] of its nodes, moved so that those near sharp edges land on them.

    A node that has come to lie before an edge is moved by what lies between: its elements on that side have the stretch
    with which they landed. Of one that went past the edge, an element lies over the edge, and shows the place.

    Args:
        scene: The scene.
        result: Its result.
        depth: Depths (n_tool, n_element) [m] of the elements in each tool, as of `measure_cuts`.

    Returns:
        The places, and pairs (m, 2) of moved nodes which follow one another on an edge and have a side between them.
    """
    places, pairs = np.asarray(scene.parison.positions, float).copy(), [np.zeros((0, 2), np.int64)]
    for number, surface in enumerate(scene.surfaces):
        if surface.mold.contact.sticks:
            moved, node, goal, along = _moves_to_edges(surface.mold, number, scene, result, depth[number])
            places[node] = moved
            pairs.append(_pairs_across_sides(scene, node, goal, along))
    return places, np.concatenate(pairs)


def _pairs_across_sides(scene: Scene, node: NDArray[np.int64], goal: Array, along: Array) -> NDArray[np.int64]:
    """Pairs (m, 2) of nodes (k,) on both sides of a side that follow one another on an edge.

    Args:
        scene: The scene.
        node: The nodes (k,).
        goal: Places on edges at which they are to land (k, 3) [m].
        along: Unit vectors (k, 3) along those edges; zero at a corner, where edges meet.
    """
    triangles, count = np.asarray(scene.parison.triangles, np.int64), len(scene.parison.positions)
    opposite = topology.opposite_nodes(triangles)
    way, place = np.zeros((count, 3)), np.zeros((count, 3))
    way[node], place[node] = along, goal
    between = place[opposite[:, 1]] - place[opposite[:, 0]]
    between /= np.maximum(np.linalg.norm(between, axis=1, keepdims=True), np.finfo(float).tiny)
    along_both = np.abs(np.einsum("nek,nk->ne", way[opposite], between))
    at_corner = ~way[opposite].any(2)
    return opposite[(along_both > _ALONG).any(1) & ((along_both > _ALONG) | at_corner).all(1)]


def _moves_to_edges(
    mold: Mold, number: int, scene: Scene, result: Result, depth: Array
) -> tuple[Array, NDArray[np.int64], Array, Array]:
    """The moves onto edges of one tool, from depths (n_element,) [m] of the elements in it.

    A node in contact with another tool does not lie before an edge of this one.

    Returns:
        Places on the initial sheet (k, 3) [m] that land on the edges, the nodes (k,) which are to be there, where they
        land (k, 3) [m], and unit vectors along the edges (k, 3), zero at corners, where edges meet.
    """
    vertices = np.asarray(mold.vertices, float)
    edges = topology.sharp_edges(vertices, np.asarray(mold.triangles))
    start = np.asarray(scene.parison.positions, float)
    if not edges.size:
        return start[:0], np.zeros(0, np.int64), start[:0], start[:0]
    formed = np.asarray(result.positions, float) - mold.offset_at(float(result.time))
    node, size, goal, along = _goals_on_edges(vertices, edges, scene, formed, depth)
    place, over_edge = _places_that_land(scene, formed, node, size, goal)
    lies = (np.asarray(result.stuck) & (np.asarray(result.tool) == number))[node] | over_edge
    return place[lies], node[lies], goal[lies], along[lies]


def _goals_on_edges(
    vertices: Array, edges: NDArray[np.integer], scene: Scene, formed: Array, depth: Array
) -> tuple[NDArray[np.int64], Array, Array, Array]:
    """The nodes near edges (4, n_edge) of a tool that are to land on them.

    Args:
        vertices: Vertices of the tool (n_vertex, 3) [m].
        edges: Its sharp edges (4, n_edge).
        scene: The scene.
        formed: The formed nodes (n_node, 3) [m], in the tool's frame.
        depth: Depths (n_element,) [m] of the elements in the tool.

    Returns:
        The nodes (k,), the mean sides (k,) [m] of their formed elements, the places (k, 3) [m] where they are to land,
        and unit vectors along the edges there (k, 3), zero at corners.
    """
    start, triangles = np.asarray(scene.parison.positions, float), np.asarray(scene.parison.triangles)
    size = _mean_sides(formed, triangles)
    goal, edge = _nearest_on_edges(formed, vertices, edges, _BESIDE * float(size.max()))
    near = (np.linalg.norm(goal - formed, axis=1) <= _BESIDE * size) & ~np.asarray(scene.parison.clamped)
    # From above, an edge that runs down is between its faces as a concave one is: elements that cut show which it is.
    cut = np.zeros(len(start), bool)
    cut[triangles[depth > _CUT_EDGE * size[triangles].mean(1)]] = True
    near &= _is_convex(vertices, edges[:, edge], start) | cut
    at_corner = _move_to_corners(goal, formed, np.where(near, size, 0.0), vertices[_corners(vertices, edges[:2].T)])
    node = np.flatnonzero(near)
    way = (vertices[edges[1]] - vertices[edges[0]])[edge[node]]
    length = np.maximum(np.linalg.norm(way, axis=1, keepdims=True), np.finfo(float).tiny)
    return node, size[node], goal[node], np.where(at_corner[node, None], 0.0, way / length)


def _places_that_land(
    scene: Scene, formed: Array, node: NDArray[np.int64], size: Array, goal: Array
) -> tuple[Array, NDArray[np.bool_]]:
    """Places on the initial sheet (k, 3) [m] that land at the goals of nodes, by one of their elements each.

    That is the one which lies over the goal or, where the node lies before it, the one on the far side of the node.

    Args:
        scene: The scene.
        formed: The formed nodes (n_node, 3) [m].
        node: The nodes (k,), in order.
        size: Mean sides (k,) [m] of their formed elements.
        goal: Their goals (k, 3) [m].

    Returns:
        The places, and the mask (k,) of those over which an element lies.
    """
    start, triangles = np.asarray(scene.parison.positions, float), np.asarray(scene.parison.triangles)
    element, corner = np.nonzero(np.isin(triangles, node))
    owner = np.searchsorted(node, triangles[element, corner])
    corners = formed[triangles[element]]
    weight = signed_weights(goal[owner], corners)
    inside = weights(nearest_places(goal[owner], corners), corners)
    off = np.linalg.norm(np.einsum("nc,nck->nk", inside, corners) - goal[owner], axis=1) / size[owner]
    # An element on the far side of the node has the largest weight at that corner.
    before = np.where(off <= _ON_EDGE, np.inf, weight[np.arange(len(owner)), corner])
    order = np.lexsort((off, -before, owner))
    first = order[np.searchsorted(owner[order], np.arange(len(node)))]
    place = np.einsum("nc,nck->nk", weight[first], start[triangles[element[first]]])
    return place, np.isinf(before[first])


def _move_to_corners(goal: Array, formed: Array, size: Array, corners: Array) -> NDArray[np.bool_]:
    """Puts the goal of the node nearest to each corner (k, 3) [m] onto it, if it is near for its size (n_node,) [m].

    Returns:
        Mask of these nodes (n_node,).
    """
    chosen = np.zeros(len(goal), bool)
    if len(corners):
        away, nearest = KDTree(formed).query(corners)
        there = away <= _AT_CORNER * size[nearest]
        goal[nearest[there]], chosen[nearest[there]] = corners[there], True
    return chosen


def beside_edges(scene: Scene, result: Result) -> NDArray[np.bool_]:
    """Mask of the nodes (n_node,) that ended near a sharp edge of a tool to which the sheet sticks."""
    triangles, beside = np.asarray(scene.parison.triangles), np.zeros(len(scene.parison.positions), bool)
    for surface in scene.surfaces:
        mold, vertices = surface.mold, np.asarray(surface.mold.vertices, float)
        edges = topology.sharp_edges(vertices, np.asarray(mold.triangles))
        if mold.contact.sticks and edges.size:
            formed = np.asarray(result.positions, float) - mold.offset_at(float(result.time))
            size = _mean_sides(formed, triangles)
            place, _ = _nearest_on_edges(formed, vertices, edges, _KINK * float(size.max()))
            beside |= np.linalg.norm(place - formed, axis=1) <= _KINK * size
    return beside


def _nearest_on_edges(
    points: Array, vertices: Array, edges: NDArray[np.integer], reach: float
) -> tuple[Array, NDArray[np.int64]]:
    """Places on edges (4, n_edge) nearest to points (n, 3) [m], and those edges (n,); infinitely far beyond a reach."""
    places, nearest, least = np.full_like(points, np.inf), np.zeros(len(points), np.int64), np.full(len(points), reach)
    begins, ends = vertices[edges[0]], vertices[edges[1]]
    radius = 0.5 * np.linalg.norm(ends - begins, axis=1) + reach
    around = KDTree(points).query_ball_point(0.5 * (begins + ends), radius * (1.0 + _ROUNDING))
    for number, (begin, end, near) in enumerate(zip(begins, ends, around, strict=True)):
        candidates, way = np.array(near, np.int64), end - begin
        share = np.clip((points[candidates] - begin) @ way / max(float(way @ way), np.finfo(float).tiny), 0.0, 1.0)
        place = begin + share[:, None] * way
        away = np.linalg.norm(points[candidates] - place, axis=1)
        nearer = away < least[candidates]
        chosen = candidates[nearer]
        places[chosen], nearest[chosen], least[chosen] = place[nearer], number, away[nearer]
    return places, nearest


# Sides of elements that cut edges of tools, at which new nodes are to be.

_CUT, _CUT_OF_WALL = 0.05, 0.5  # of the first thickness, and of the wall: elements that cut deeper get a node there
_MIDDLE = 0.3  # of a side, the least share of it on either side of a new node


def cut_sides(
    scene: Scene, result: Result, depth: Array, corner_share: Array
) -> tuple[NDArray[np.int64], Array, float]:
    """The sides nearest to the deepest places of elements that cut a tool too deep, the deepest first.

    An element cuts an edge the deepest at one of its sides; one that cuts several tools counts where it is deepest.

    Args:
        scene: The scene.
        result: Its result.
        depth: Depths (n_tool, n_element) [m] of the elements in each tool, as of `measure_cuts`.
        corner_share: Shares (n_tool, n_element, 3) of their corners at the deepest places.

    Returns:
        The ends (k, 2) of the sides, the shares (k,) of the second end at the places, and the deepest cut over the
        depth from which elements count.
    """
    triangles = np.asarray(scene.parison.triangles, np.int64)
    tool, element = depth.argmax(0), np.arange(len(triangles))
    first = np.asarray(scene.parison.thickness, float)[triangles].mean(1)
    ratio = depth.max(0) / np.minimum(_CUT * first, _CUT_OF_WALL * np.asarray(result.element_thickness, float))
    order = np.argsort(-ratio, kind="stable")[: np.count_nonzero(ratio > 1.0)]
    shares = corner_share[tool, element][order]
    corner = (np.argmin(shares, axis=1)[:, None] + np.array([1, 2])) % 3
    one, other = np.take_along_axis(shares, corner, axis=1).T
    ends = np.take_along_axis(triangles[order], corner, axis=1)
    return ends, np.clip(other / (one + other), _MIDDLE, 1.0 - _MIDDLE), float(ratio.max())

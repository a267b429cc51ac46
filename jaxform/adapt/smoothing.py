"""Smoothing of an adapted mesh: nodes move within the sheet so that linear triangles miss the wall least. On the host.

A linear triangle with exact nodes misses the area ratio at its centroid to first order in its size. Of a smooth map u
of the sheet with the gradient F (3, 2) and second derivatives H, a triangle with sides e_1, e_2, e_3 and area A misses
the logarithm of the ratio by

    -(S(e_1) + S(e_2) + S(e_3)) / (12 A),    S(v) = H[v, v] . F (F^T F)^-1 (n x v),

with n the sheet's normal: linear interpolation takes from F a sixth of the sum over the sides of H[e, e] times the
gradient of the shape function opposite to it, n x e / (2 A). For an equilateral triangle this goes as the cosine of
three times its direction: it is zero in one direction, and largest 30 degrees from that. A mesh generator gives
triangles of the right size in any direction. Moving their nodes by about a side, with nearly the same areas, removes
much of the error. So it does in a run, whose nodes are not exact: they miss their places by less than the triangles do.

S depends on lengths alone: the products of H with the columns of F are Christoffel symbols of the metric C = F^T F,

    H_ab . F_c = (dC_bc/dx_a + dC_ac/dx_b - dC_ab/dx_c) / 2,

however the formed sheet bends. The square of a formed side is C[e, e] at its middle, up to the fourth power of its
length. So C and its slopes are those of a linear function fitted around each node to the squares of formed sides. Where
the fit misses as much as a share of its slopes, as at a kink or in a corner of the tool, there is no S, and nodes stay.

(Diaz, Kikuchi, Taylor: A method of grid optimization for finite element methods, Comput. Methods Appl. Mech. Eng. 41
(1983) 29-45: nodes are moved for the least interpolation error. The form above is derived here.)
"""

from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize
from scipy.sparse import csr_array

from jaxform.adapt import mesher
from jaxform.mesh import topology
from jaxform.mesh.shapes import Sheet
from jaxform.tools.crossings import nodal_normals
from jaxform.tools.distances import Distances, interpolate, weights

Array = NDArray[np.float64]
Index = NDArray[np.int64]
Mask = NDArray[np.bool_]

_LEAST_SIDES = 14  # of a fit with nine unknowns
_ROUGH = 0.6  # of the slopes' part of a fit, what it may miss: 0.1 to 0.3 in smooth regions, 0.5 to 2 at kinks
_TOGETHER = 2048  # nodes whose fits are made together
_SEARCHES = 2  # of which each finds the form anew where the elements are
_ITERATIONS = 60  # of a search
_FARTHEST = 0.5  # of the size of a node's largest element, how far a search moves it along each axis
_SIZE = 1.1  # ratio of an element's area to the one that was asked for, up to which nothing is paid
_SHAPE = 0.7  # shape quality of elements, 1 for equilateral ones, from which on nothing is paid
_SIZE_PRICE, _SHAPE_PRICE = 25.0, 250.0  # of the mean squares beyond, in mean square errors of the mesh to begin with
_WORST = 0.35  # quality, below which no element may come
_RIDGE = 1e-12  # that keeps fits of too few nodes solvable
_INFINITE = 1e30  # value of a mesh with turned triangles, which a line search can take


def smooth(sheet: Sheet, old: Sheet, formed: Array, kinks: Mask | None = None) -> Sheet:
    """The sheet with its inner nodes, and those in symmetry planes, at places where elements miss the wall less.

    Args:
        sheet: The sheet on its new mesh.
        old: The sheet on the mesh of a run.
        formed: The nodes (n_node, 3) [m] of that run as it ended.
        kinks: Mask of those (n_node,) where the map is known to have kinks: around them nodes stay.

    Returns:
        The sheet. No element has a poor shape that had a better one before.
    """
    form, smooth_there = cubic_forms(old, formed)
    if kinks is not None:
        smooth_there &= ~kinks
    points, triangles = np.asarray(sheet.positions, float), np.asarray(sheet.triangles, np.int64)
    objective = _Objective(points, triangles)
    for _ in range(_SEARCHES):
        objective.use_forms(*_forms_of_elements(old, form, smooth_there, points[triangles].mean(1)), points)
        if objective.error <= 0.0:
            return sheet
        points = _search(objective, points, _directions(sheet, objective.counted))
    points = _put_back(sheet, mesher.to_surface(sheet, points))
    return replace(sheet, positions=points, fields=mesher.carry_fields(sheet, points))


def _put_back(sheet: Sheet, points: Array) -> Array:
    """The moved nodes (n_node, 3) [m]; those of elements that would turn over or become poor are where they were."""
    triangles, before = np.asarray(sheet.triangles, np.int64), np.asarray(sheet.positions, float)
    normals, least = topology.doubled_normals(before, triangles), qualities(before, triangles)
    least, points = np.minimum(_WORST, least), points.copy()
    for _ in range(len(triangles)):
        turned = np.sum(topology.doubled_normals(points, triangles) * normals, axis=1) <= 0.0
        bad = triangles[turned | (qualities(points, triangles) < least)].ravel()
        if (points[bad] == before[bad]).all():
            break
        points[bad] = before[bad]
    return points


def qualities(points: Array, triangles: NDArray[np.integer]) -> Array:
    """Shape qualities (n_element,), 1 for equilateral triangles, 0 for flat ones."""
    sides = points[np.roll(triangles, -1, axis=1)] - points[triangles]
    area = np.linalg.norm(topology.doubled_normals(points, triangles), axis=1)
    return 2.0 * np.sqrt(3.0) * area / np.sum(np.square(sides), axis=(1, 2))


# The cubic form, by the metric around each node.


def cubic_forms(sheet: Sheet, formed: Array) -> tuple[Array, Mask]:
    """The forms S of the map from a sheet to its formed nodes (n_node, 3) [m], and where the map is smooth.

    Returns:
        Symmetric tensors C (n_node, 3, 3, 3) [1/m] with S(v) = C[v, v, v]; mask of the nodes (n_node,) at which the
        map is smooth. The others' tensors say nothing.
    """
    points = np.asarray(sheet.positions, float)
    frame, sides = _tangents(points, sheet.triangles), topology.edges(sheet.triangles)[0]
    around = _sides_around(sides, len(points))
    ways = points[sides[:, 1]] - points[sides[:, 0]]
    lengths = np.sum(np.square(formed[sides[:, 1]] - formed[sides[:, 0]]), axis=1) / np.sum(np.square(ways), axis=1)
    fits = []
    for nodes in np.array_split(np.arange(len(points)), 1 + len(points) // _TOGETHER):
        owner, side = around[nodes].nonzero()
        middle = points[sides[side]].mean(1) - points[nodes[owner]]
        at, along = (np.einsum("kai,ki->ka", frame[nodes[owner]], each) for each in (middle, ways[side]))
        along /= np.maximum(np.linalg.norm(along, axis=1, keepdims=True), np.finfo(float).tiny)
        fits.append(_fit_metric(lengths[side], at, along, owner, len(nodes)))
    metric, slope, known = (np.concatenate(each) for each in zip(*fits, strict=True))
    tensor = _tensors(metric, slope, frame)
    known &= np.isfinite(tensor).all((1, 2, 3))
    return np.where(known[:, None, None, None], tensor, 0.0), known


def _sides_around(sides: Index, count: int) -> csr_array:
    """The sides (n_node, n_side), as entries, whose ends are both at most two sides away from a node."""
    every = np.arange(count)
    one, other = np.concatenate([every, *sides.T]), np.concatenate([every, *sides.T[::-1]])
    near = csr_array((np.ones(len(one)), (one, other)), shape=(count, count))
    two = csr_array(near @ near)
    two.data[:] = 1.0
    number = np.repeat(np.arange(len(sides)), 2)
    ends = csr_array((np.ones(sides.size), (sides.ravel(), number)), shape=(count, len(sides)))
    return csr_array(two @ ends) > 1.0


def _fit_metric(lengths: Array, middles: Array, ways: Array, owner: Index, count: int) -> tuple[Array, Array, Mask]:
    """The metric at nodes and its slopes, by a linear function fitted to the sides around each.

    Args:
        lengths: Ratios (k,) of the formed length of a side to the initial one, squared.
        middles: The middles (k, 2) [m] of the initial sides in their node's tangent plane, from the node on.
        ways: Unit vectors (k, 2) along them.
        owner: The node (k,) of each, in ascending order.
        count: Number of nodes, n.

    Returns:
        The metric (n, 2, 2), its derivatives (n, 2, 2, 2) [1/m], the last index that of the coordinate, and the mask
        of the nodes (n,) whose fit holds.
    """
    sides = np.bincount(owner, minlength=count)
    total = csr_array((np.ones(len(owner)), (owner, np.arange(len(owner)))), shape=(count, len(owner)))
    scale = np.sqrt((total @ np.sum(np.square(middles), axis=1)) / np.maximum(sides, 1))
    scale = np.maximum(scale, np.finfo(float).tiny)
    at, (x, y) = middles / scale[owner, None], ways.T
    # Unknowns: xx, xy and yy of the metric, each with its value and two slopes.
    basis = np.stack([x * x, 2.0 * x * y, y * y], axis=1)[:, :, None] * np.insert(at, 0, 1.0, axis=1)[:, None]
    rows, weight = basis.reshape(-1, 9), np.exp(-2.0 * np.sum(np.square(at), axis=1))
    weighed = weight[:, None] * rows
    moments = (total @ (weighed[:, :, None] * rows[:, None]).reshape(-1, 81)).reshape(-1, 9, 9)
    right = (total @ (weighed * lengths[:, None]))[..., None]
    found = np.linalg.solve(moments + _RIDGE * np.eye(9), right).reshape(-1, 3, 3)
    parts = basis * found[owner]
    missed, sloped = np.sum(parts, axis=(1, 2)) - lengths, np.sum(parts[..., 1:], axis=(1, 2))
    off, part = (total @ (weight * np.square(each)) for each in (missed, sloped))
    entries = found[:, _ENTRIES]
    metric, slope = entries[..., 0], entries[..., 1:] / scale[:, None, None, None]
    return metric, slope, (sides >= _LEAST_SIDES) & (off <= _ROUGH**2 * part) & (np.linalg.det(metric) > 0.0)


_ENTRIES = np.array([[0, 1], [1, 2]])  # of a symmetric matrix, by the number of its indices that are 1


def _tangents(points: Array, triangles: NDArray[np.integer]) -> Array:
    """Two unit vectors (n_node, 2, 3) that span the tangent plane at each node, right-handed with its normal."""
    normal = nodal_normals(points, triangles)
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), np.finfo(float).tiny)
    axis = np.eye(3)[np.argmin(np.abs(normal), axis=1)]
    one = np.cross(axis, normal)
    one /= np.maximum(np.linalg.norm(one, axis=1, keepdims=True), np.finfo(float).tiny)
    return np.stack([one, np.cross(normal, one)], axis=1)


def _tensors(metric: Array, slope: Array, frame: Array) -> Array:
    """The form's tensors (n, 3, 3, 3) from the metric (n, 2, 2) and its slopes (n, 2, 2, 2) in tangent frames."""
    first = 0.5 * (np.einsum("nbca->nabc", slope) + np.einsum("nacb->nabc", slope) - slope)
    adjugate = np.stack([metric[:, 1, 1], -metric[:, 0, 1], -metric[:, 1, 0], metric[:, 0, 0]], -1).reshape(-1, 2, 2)
    with np.errstate(all="ignore"):
        second = first @ (adjugate / np.linalg.det(metric)[:, None, None])[:, None]
    # The normal times v is (-v_y, v_x).
    own = np.stack([second[..., 1], -second[..., 0]], axis=-1)
    own = sum(own.transpose(0, *order) for order in itertools.permutations((1, 2, 3))) / 6.0
    return np.einsum("nabc,nai,nbj,nck->nijk", own, frame, frame, frame, optimize=True)


def _forms_of_elements(old: Sheet, form: Array, smooth_there: Mask, centroids: Array) -> tuple[Array, Mask]:
    """The forms of elements (m, 3, 3, 3) with centroids (m, 3) [m], and mask of those where the map is smooth."""
    positions, triangles = np.asarray(old.positions, float), np.asarray(old.triangles, np.int64)
    found = Distances(positions, triangles, float(np.ptp(positions, axis=0).max())).nearest(centroids)
    weight = weights(found.place, positions[triangles[found.triangle]])
    own = interpolate(form.reshape(len(form), -1), triangles, found.triangle, weight)
    return own.reshape(-1, 3, 3, 3), smooth_there[triangles[found.triangle]].all(1)


def _directions(sheet: Sheet, counted: Mask) -> Array:
    """Two vectors (n_node, 2, 3) [1] along which each node may move; zeros where it stays.

    Inside, where the map of all its elements is smooth, those of the tangent plane; in a symmetry plane, along that.
    """
    triangles, points = np.asarray(sheet.triangles, np.int64), np.asarray(sheet.positions, float)
    frame = _tangents(points, triangles)
    edge = topology.boundary_edges(triangles)
    held = np.zeros((len(points), 4))
    np.add.at(held, edge.ravel(), np.repeat(np.column_stack([sheet.fixed[edge].all(1), np.ones(len(edge))]), 2, axis=0))
    in_plane = (held[:, :3] == 2.0) & (held[:, 3:] == 2.0)
    slides = (in_plane.sum(1) == 1) & (sheet.fixed.sum(1) == 1)
    free = (held[:, 3] == 0.0) & ~sheet.fixed.any(1)
    along = np.cross(np.cross(frame[:, 0], frame[:, 1]), in_plane.astype(float))
    length = np.linalg.norm(along, axis=1, keepdims=True)
    line = np.stack([along / np.maximum(length, np.finfo(float).tiny), np.zeros(points.shape)], axis=1)
    stays = sheet.clamped.copy()
    stays[triangles[~counted]] = True
    ways = np.where(slides[:, None, None], line, np.where(free[:, None, None], frame, 0.0))
    return np.where(stays[:, None, None], 0.0, ways)


# The search for the places.


class _Objective:
    """The mean square error of a mesh over that to begin with, and prices of bad shapes and of changed areas.

    Attributes:
        counted: Mask of the elements (m,) where the map is smooth.
        error: Mean square error of these, to begin with; 0 where there is none.
    """

    def __init__(self, points: Array, triangles: Index) -> None:
        self.triangles, self.error = triangles, 0.0
        self.normals = topology.doubled_normals(points, triangles)
        self.areas = np.linalg.norm(self.normals, axis=1)
        self.counted = np.zeros(len(triangles), bool)

    def use_forms(self, form: Array, counted: Mask, points: Array) -> None:
        """Sets the forms (m, 3, 3, 3) of the elements, and those that count (m,), for nodes at points (n, 3) [m]."""
        self.form, self.counted = np.where(counted[:, None, None, None], form, 0.0), counted
        if self.error == 0.0:
            sides = self._sides(points)
            self.error = float(np.sum(np.square(self._cubes(sides)[0]) / self.areas))

    def _sides(self, points: Array) -> Array:
        corners = points[self.triangles]
        return np.roll(corners, 1, axis=1) - np.roll(corners, -1, axis=1)

    def _cubes(self, sides: Array) -> tuple[Array, Array]:
        """The sums of S over the sides (m,), and their derivatives by the sides (m, 3, 3)."""
        twice = np.einsum("mkij,mkj->mki", np.einsum("mijl,mkl->mkij", self.form, sides), sides)
        return np.sum(twice * sides, axis=(1, 2)), 3.0 * twice

    def __call__(self, points: Array) -> tuple[float, Array]:
        """The objective at points (n, 3) [m], infinite where a triangle turns over, and its gradient (n, 3)."""
        sides = self._sides(points)
        normal = np.cross(sides[:, 2], -sides[:, 1])
        if (np.sum(normal * self.normals, axis=1) <= 0.0).any():
            return np.inf, np.zeros(points.shape)
        area = np.linalg.norm(normal, axis=1)
        cube, by_side = self._cubes(sides)
        square = np.sum(np.square(sides), axis=(1, 2))
        quality = 2.0 * np.sqrt(3.0) * area / square
        flat = np.maximum(_SHAPE - quality, 0.0) / quality
        grown = np.log(area / self.areas)
        beyond = np.sign(grown) * np.maximum(np.abs(grown) - np.log(_SIZE), 0.0)
        size, shape = (price / len(area) for price in (_SIZE_PRICE, _SHAPE_PRICE))
        value = np.sum(cube**2 / area) / self.error + size * np.sum(beyond**2) + shape * np.sum(flat**2)
        by_quality = -2.0 * shape * flat * _SHAPE / quality**2
        by_area = -(cube**2) / area**2 / self.error + (2.0 * size * beyond + by_quality * quality) / area
        by_side = by_side * (2.0 * cube / area / self.error)[:, None, None]
        by_side -= 2.0 * (by_quality * quality / square)[:, None, None] * sides
        # A side runs from the second to the third of the other corners; a doubled area grows by n x side per corner.
        by_corner = np.roll(by_side, -1, axis=1) - np.roll(by_side, 1, axis=1)
        by_corner += by_area[:, None, None] * np.cross((normal / area[:, None])[:, None], sides)
        gradient = np.zeros(points.shape)
        np.add.at(gradient, self.triangles.ravel(), by_corner.reshape(-1, 3))
        return float(value), gradient


def _search(objective: _Objective, points: Array, ways: Array) -> Array:
    """The points (n, 3) [m], moved along two vectors each (n, 2, 3) so that the objective is least."""
    size = np.zeros(len(points))
    np.maximum.at(size, objective.triangles.ravel(), np.repeat(np.sqrt(objective.areas), 3))
    ways = ways * size[:, None, None]

    def value(moves: Array) -> tuple[float, Array]:
        found, gradient = objective(points + np.einsum("na,nai->ni", moves.reshape(-1, 2), ways))
        return min(found, _INFINITE), np.einsum("ni,nai->na", gradient, ways).ravel()

    limits = [(-_FARTHEST, _FARTHEST)] * (2 * len(points))
    options = {"maxiter": _ITERATIONS, "maxfun": 2 * _ITERATIONS}
    found = minimize(value, np.zeros(2 * len(points)), jac=True, method="L-BFGS-B", bounds=limits, options=options)
    return points + np.einsum("na,nai->ni", found.x.reshape(-1, 2), ways)

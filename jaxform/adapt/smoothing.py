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

F and H are those of a quadratic polynomial fitted around each node. Where the fit misses the map by more than a share
of its quadratic part, as at a kink, a corner of the tool or the end of a contact, there is no H, and nodes stay.

(Diaz, Kikuchi, Taylor: A method of grid optimization for finite element methods, Comput. Methods Appl. Mech. Eng. 41
(1983) 29-45: nodes are moved for the least interpolation error. The form above is derived here.)
"""

from __future__ import annotations

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

_LEAST_NODES = 9  # of a fit with six unknowns
_ROUGH = 0.15  # of the quadratic part of a fit, what it may miss: 0.03 to 0.12 in smooth regions, 0.2 to 1 at corners
_SEARCHES = 2  # of which each finds the form anew where the elements are
_ITERATIONS = 60  # of a search
_FARTHEST = 0.5  # of the size of a node's largest element, how far a search moves it along each axis
_SIZE = 1.1  # ratio of an element's area to the one that was asked for, up to which nothing is paid
_SHAPE = 0.7  # shape quality of elements, 1 for equilateral ones, from which on nothing is paid
_SIZE_PRICE, _SHAPE_PRICE = 25.0, 250.0  # of the mean squares beyond, in mean square errors of the mesh to begin with
_WORST = 0.35  # quality, below which no element may come
_RIDGE = 1e-12  # that keeps fits of too few nodes solvable
_INFINITE = 1e30  # value of a mesh with turned triangles, which a line search can take


def smooth(sheet: Sheet, old: Sheet, formed: Array) -> Sheet:
    """The sheet with its inner nodes, and those in symmetry planes, at places where elements miss the wall less.

    Args:
        sheet: The sheet on its new mesh.
        old: The sheet on the mesh of a run.
        formed: The nodes (n_node, 3) [m] of that run as it ended.

    Returns:
        The sheet. No element has a poor shape that had a better one before.
    """
    form, smooth_there = cubic_forms(old, formed)
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


# The cubic form, by a quadratic polynomial around each node.


def cubic_forms(sheet: Sheet, formed: Array) -> tuple[Array, Mask]:
    """The forms S of the map from a sheet to its formed nodes (n_node, 3) [m], and where the map is smooth.

    Returns:
        Symmetric tensors C (n_node, 3, 3, 3) [1/m] with S(v) = C[v, v, v]; mask of the nodes (n_node,) at which the
        map is smooth. The others' tensors say nothing.
    """
    points = np.asarray(sheet.positions, float)
    node, other, begin = _patches(sheet.triangles, len(points))
    frame = _tangents(points, sheet.triangles)
    own = np.einsum("nai,ni->na", frame[node], points[other] - points[node])
    count = np.diff(np.append(begin, len(node)))
    scale = np.sqrt(np.add.reduceat(np.sum(own * own, axis=1), begin) / count)
    own = own / np.maximum(scale, np.finfo(float).tiny)[node, None]
    x, y = own.T
    basis = np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], axis=1)
    weight = np.exp(-2.0 * np.sum(own * own, axis=1))[:, None]
    moments = np.add.reduceat(weight[..., None] * basis[:, :, None] * basis[:, None], begin)
    right = np.add.reduceat(weight[..., None] * basis[:, :, None] * formed[other][:, None], begin)
    coefficients = np.linalg.solve(moments + _RIDGE * np.eye(6), right)
    missed = np.einsum("nk,nki->ni", basis, coefficients[node]) - formed[other]
    bent = np.einsum("nk,nki->ni", basis[:, 3:], coefficients[node, 3:])
    mean = np.add.reduceat(weight * bent, begin) / np.add.reduceat(weight, begin)
    off, part = (np.add.reduceat(np.sum(weight * np.square(x), axis=1), begin) for x in (missed, bent - mean[node]))
    tensor = _tensors(coefficients / scale[:, None, None] ** np.array([0, 1, 1, 2, 2, 2])[:, None], frame)
    fits = (count >= _LEAST_NODES) & (off <= _ROUGH**2 * part) & np.isfinite(tensor).all((1, 2, 3))
    return np.where(fits[:, None, None, None], tensor, 0.0), fits


def _patches(triangles: NDArray[np.integer], count: int) -> tuple[Index, Index, Index]:
    """Pairs (k,) of nodes at most two sides apart, each with itself too, sorted by the first; where each begins."""
    every = np.arange(count)
    one = np.append(every, np.repeat(triangles.ravel(), 3))
    other = np.append(every, np.repeat(triangles, 3, axis=0).ravel())
    near = csr_array((np.ones(len(other)), (one, other)), shape=(count, count))
    two = csr_array(near @ near)
    begin, there = np.asarray(two.indptr, np.int64), np.asarray(two.indices, np.int64)
    return np.repeat(every, np.diff(begin)), there, begin[:-1]


def _tangents(points: Array, triangles: NDArray[np.integer]) -> Array:
    """Two unit vectors (n_node, 2, 3) that span the tangent plane at each node, right-handed with its normal."""
    normal = nodal_normals(points, triangles)
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), np.finfo(float).tiny)
    axis = np.eye(3)[np.argmin(np.abs(normal), axis=1)]
    one = np.cross(axis, normal)
    one /= np.maximum(np.linalg.norm(one, axis=1, keepdims=True), np.finfo(float).tiny)
    return np.stack([one, np.cross(normal, one)], axis=1)


def _tensors(coefficients: Array, frame: Array) -> Array:
    """The form's tensors (n, 3, 3, 3) from coefficients (n, 6, 3) of 1, x, y, x^2, xy, y^2 in tangent frames."""
    gradient = coefficients[:, 1:3].swapaxes(1, 2)
    metric = gradient.swapaxes(1, 2) @ gradient
    with np.errstate(all="ignore"):
        determinant = metric[:, 0, 0] * metric[:, 1, 1] - metric[:, 0, 1] ** 2
        adjugate = np.stack([metric[:, 1, 1], -metric[:, 0, 1], -metric[:, 0, 1], metric[:, 0, 0]], -1)
        inverse = gradient @ (adjugate.reshape(-1, 2, 2) / determinant[:, None, None])
    # Rows: of x^2, 2 xy and y^2 in H[v, v], their products with both columns of F (F^T F)^-1.
    xx, xy, yy = np.einsum("nki,nic->knc", coefficients[:, 3:] * np.array([2.0, 1.0, 2.0])[:, None], inverse)
    thirds = np.stack([xx[:, 1], (2.0 * xy[:, 1] - xx[:, 0]) / 3.0, (yy[:, 1] - 2.0 * xy[:, 0]) / 3.0, -yy[:, 0]])
    own = np.moveaxis(thirds[_ENTRIES], 3, 0)
    return np.einsum("nabc,nai,nbj,nck->nijk", own, frame, frame, frame, optimize=True)


_ENTRIES = np.sum(np.indices((2, 2, 2)), axis=0)  # of a symmetric tensor, by the number of its indices that are 1


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

"""The sheet's thickness as a variable: profiles along a place, and nodal fields of a smoothness."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from scipy import interpolate, optimize, sparse

from jaxform import InputError, Profile, Scene
from jaxform.extend import extend_values, symmetry_planes
from optimize.variables import (
    Bounds,
    apply_log_bounds,
    apply_step_limit,
    check_bounds,
    full_reach,
    invert_log_bounds,
    invert_step_limit,
)

Array = np.ndarray

_CONTROLS_PER_LENGTH = 2.0  # a field's numbers stand half a smoothness apart
_MOST_CONTROLS = 2000
_MOST_EASE = 4.0
_ON_BOUND = 1e-4  # of the way between the bounds
_HOLD = 1e-6  # weight by which numbers are held to the mean


class _SheetMap:
    """Thickness that is a fixed linear map of bounded numbers; a row of the map sums to 1, so it keeps their bounds."""

    def __init__(self, scene: Scene, weights: Array, bounds: Bounds, change: Array | None = None) -> None:
        self.bounds, self._change = bounds, change
        self._weights = jnp.asarray(weights)
        self._ease = _ease(scene, weights)
        self.reach = full_reach(weights.shape[1]) / self._ease
        self._first_nodes = scene.first_nodes
        self.start = self.nearest(np.asarray(scene.parison.thickness, float))

    def _values(self, free: jax.Array) -> jax.Array:
        free = free * self._ease
        if self._change is None:
            return apply_log_bounds(free, self.bounds)
        return apply_step_limit(free, self.bounds, self._change)

    def changes(self, free: jax.Array) -> dict[str, jax.Array]:
        """Nodal thickness (n_node,) [m]."""
        return {"parison.thickness": self._weights @ self._values(free)}

    def shares(self, free: jax.Array) -> jax.Array:
        """Values (n,) as fractions of the range between their bounds."""
        return (self._values(free) - self.bounds[0]) / (self.bounds[1] - self.bounds[0])

    def document(self, free: jax.Array) -> dict[str, Any]:
        """Thickness at the nodes of the mesh (n_node,) [m], before it is refined."""
        return {"parison.thickness": np.asarray(self.changes(free)["parison.thickness"], float)[: self._first_nodes]}

    def nearest(self, thickness: Array) -> Array:
        """The search's numbers that come closest to a nodal thickness (n_node,) [m], by least squares."""
        weights, mean = np.asarray(self._weights), float(np.mean(thickness))
        low, high = self.bounds[0] / mean, self.bounds[1] / mean
        values = _least_squares(weights, thickness / mean, (low, high))
        # Both end a little inside of bounds that the sheet lies on.
        values = np.where(values - low < _ON_BOUND * (high - low), low, values)
        values = np.where(high - values < _ON_BOUND * (high - low), high, values)
        if self._change is None:
            return invert_log_bounds(mean * values, self.bounds) / self._ease
        return invert_step_limit(mean * values, self.bounds, self._change) / self._ease


def _least_squares(weights: Array, wanted: Array, bounds: Bounds) -> Array:
    """Numbers (n,) within bounds whose weighted sums (n_node, n) come closest to values (n_node,) about 1.

    They are held to 1, hardly: a number that no node feels has no best value.
    """
    count = weights.shape[1]
    target = np.append(wanted, np.full(count, _HOLD))
    wide = count > len(weights)
    if wide:  # not in the time of the number of numbers cubed
        rows: Any = sparse.vstack([sparse.csr_matrix(weights), _HOLD * sparse.eye(count)])
        left, size, right = np.linalg.svd(weights, full_matrices=False)
        values = 1.0 + right.T @ (size / (size**2 + _HOLD**2) * (left.T @ (wanted - weights.sum(1))))
    else:
        rows = np.concatenate([weights, _HOLD * np.eye(count)])
        values = np.linalg.lstsq(rows, target, rcond=None)[0]
    # That is exact and quick, where the bounds do not matter.
    if np.all((values >= bounds[0]) & (values <= bounds[1])):
        return values
    return optimize.lsq_linear(rows, target, bounds, lsq_solver="lsmr" if wide else None).x


def _ease(scene: Scene, weights: Array) -> Array:
    """Scale factors of the search's numbers (n,), so that all have about the same effect on the part.

    The effect of one is proportional to the root of its material; a search without curvature would move those in the
    middle of a disc too little.
    """
    triangles, area = np.asarray(scene.parison.triangles), np.asarray(scene.tables.sheet.area)
    nodal = np.bincount(triangles.ravel(), np.repeat(area / 3.0, 3), len(weights))
    share = nodal @ np.square(weights)
    return np.clip(np.sqrt(share.mean() / np.maximum(share, 1e-300)), 1.0 / _MOST_EASE, _MOST_EASE)


class ThicknessProfile(_SheetMap):
    """Initial thickness along a place in the initial sheet.

    Args:
        scene: The scene whose sheet is designed; its own thickness is the start.
        along: "radius", "x", "y" or "z".
        bounds: Least and largest thickness [m].
        knots: Number of knots (of zones), evenly placed over the sheet; or
        at: Their places [m], increasing (of zones, their boundaries).
        interpolation: "linear" between knots; "cubic", a B-spline with the knots' values as coefficients, within the
            same bounds and slopes; "zones" of constant thickness.
        slope: Largest change of thickness along the place [m/m]; None for any.

    Raises:
        InputError: If the bounds do not increase, neither or both of `knots` and `at` are given, or they are not
            possible with the interpolation.
    """

    def __init__(
        self,
        scene: Scene,
        *,
        along: str,
        bounds: Bounds,
        knots: int | None = None,
        at: Sequence[float] | None = None,
        interpolation: str = "linear",
        slope: float | None = None,
    ) -> None:
        """See the class."""
        check_bounds(bounds)
        if (knots is None) == (at is None):
            raise InputError("needs knots or at", "give one of the two", "variable.knots", knots)
        if slope is not None and interpolation == "zones":
            raise InputError(
                "cannot be combined with zones, which are discontinuous",
                "leave one of them out",
                "variable.slope",
                slope,
            )
        self.along, self.interpolation = along, interpolation
        first = first_positions(scene)
        place = Profile(along, (0.0, 1.0), (0.0, 1.0)).coordinate(first)
        if interpolation == "linear":
            place = Profile(along, (0.0, 1.0), (0.0, 1.0)).coordinate(np.asarray(scene.parison.positions, float))
        self.at, weights = _place_knots(place, knots, at, interpolation)
        if interpolation != "linear":
            weights = spread_to_forest(scene, weights)
        super().__init__(scene, weights, bounds, None if slope is None else slope * np.diff(self.at))

    def document(self, free: jax.Array) -> dict[str, Any]:
        """The profile as a table, or, where a table cannot express it, at the nodes of the mesh (n_node,) [m]."""
        if self.interpolation != "linear":
            return super().document(free)
        value = np.asarray(self._values(free), float).tolist()
        return {"parison.thickness": {"along": self.along, "at": self.at.tolist(), "value": value}}


def _place_knots(
    place: Array, knots: int | None, at: Sequence[float] | None, interpolation: str
) -> tuple[Array, Array]:
    """Places of the knots, or the boundaries of zones, and the weight of each number at each node (n_node, n)."""
    if interpolation == "cubic":
        return _spline(place, knots, at)
    count = (knots or 2) + (interpolation == "zones")
    where = np.linspace(place.min(), place.max(), count) if at is None else np.asarray(at, float)
    if interpolation == "zones":
        zone = np.clip(np.searchsorted(where, place, side="right") - 1, 0, len(where) - 2)
        return where, np.eye(len(where) - 1)[zone]
    return where, np.stack([np.interp(place, where, row) for row in np.eye(len(where))], axis=1)


def _spline(place: Array, knots: int | None, at: Sequence[float] | None) -> tuple[Array, Array]:
    """Cubic B-splines: not negative and 1 together, so the spline keeps bounds and slopes of the numbers."""
    if knots is None or knots < 4:
        remedy = "give the number of knots, at least 4"
        raise InputError("is not possible with these knots", remedy, "variable.interpolation", "cubic")
    low, high = place.min(), place.max()
    inner = np.linspace(low, high, knots - 2)
    edges = np.concatenate([[low] * 3, inner, [high] * 3])
    inside = np.clip(place, low, high)
    weights = interpolate.BSpline.design_matrix(inside, edges, 3).toarray()
    return np.array([edges[k + 1 : k + 4].mean() for k in range(knots)]), weights


class ThicknessField(_SheetMap):
    """Initial thickness at every node of the mesh, no finer than a length.

    The variables are values at nodes about half that length apart; each node has their mean, weighted by distance (with
    their images in the symmetry planes, so that the field is smooth across them).

    Args:
        scene: The scene whose sheet is designed; its own thickness is the start.
        bounds: Least and largest thickness [m].
        smoothness: The length [m]; 0 for an independent value at every node of the mesh.

    Raises:
        InputError: If the bounds do not increase, or the length is negative or far below the mesh's.
    """

    def __init__(self, scene: Scene, *, bounds: Bounds, smoothness: float = 0.0) -> None:
        """See the class."""
        check_bounds(bounds)
        if not (0.0 <= smoothness < np.inf):
            raise InputError("is not a length", "give metres, 0 for none", "variable.smoothness", smoothness)
        positions = first_positions(scene)
        self.smoothness = smoothness
        self.controls = np.arange(len(positions)) if smoothness == 0.0 else _spaced_nodes(positions, smoothness)
        if len(self.controls) > _MOST_CONTROLS:
            problem = f"leaves {len(self.controls)} values to design"
            raise InputError(problem, "give a larger length", "variable.smoothness", smoothness)
        weights = np.eye(len(positions)) if smoothness == 0.0 else self._kernel(scene, positions)
        super().__init__(scene, spread_to_forest(scene, weights), bounds)

    def _kernel(self, scene: Scene, positions: Array) -> Array:
        weights = np.zeros((len(positions), len(self.controls)))
        for image in images(scene, positions[self.controls]):
            square = np.square(positions[:, None] - image[None]).sum(2)
            weights += np.exp(-square / (0.5 * self.smoothness**2))
        return weights / weights.sum(1, keepdims=True)


def _spaced_nodes(positions: Array, smoothness: float) -> Array:
    """Nodes (n,) of which none is nearer to another than what a number needs, and no node is farther from all."""
    distance = np.full(len(positions), np.inf)
    chosen: list[int] = []
    next_one = int(np.argmin(positions @ np.array([1.0, 1.0, 1.0])))
    while distance[next_one] > smoothness / _CONTROLS_PER_LENGTH or not chosen:
        chosen.append(next_one)
        distance = np.minimum(distance, np.linalg.norm(positions - positions[next_one], axis=1))
        next_one = int(np.argmax(distance))
    return np.sort(np.asarray(chosen))


def images(scene: Scene, points: Array) -> list[Array]:
    """Points (n, 3) [m] and their images in the scene's symmetry planes."""
    images = [points]
    for axis, level in symmetry_planes(scene).items():
        flip = np.where(np.arange(3) == axis, -1.0, 1.0)
        images += [image * flip + 2 * level * (np.arange(3) == axis) for image in images]
    return images


def first_positions(scene: Scene) -> Array:
    """Initial positions of the mesh's nodes before it is refined (n, 3) [m]."""
    return np.asarray(scene.parison.positions, float)[: scene.first_nodes]


def spread_to_forest(scene: Scene, weights: Array) -> Array:
    """Weights at the mesh's nodes (n, k), extended to all nodes that refinement may insert (n_node, k)."""
    forest = scene.tables.forest
    return weights if forest is None else extend_values(weights, np.asarray(forest.ends).T, forest.depth)

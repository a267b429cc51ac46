"""Heater zones: a grid of heaters over the sheet, whose powers the sheet's temperature follows."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from scipy import optimize

import jaxform
from jaxform import InputError, Scene
from jaxform.extend import number_at
from optimize.sheets import first_positions, images, spread_to_forest
from optimize.variables import Bounds, apply_bounds, check_bounds, full_reach, invert_bounds

_PARTS = 4  # of a heater's side, over which its view factor is summed up
_MOST = 400  # heaters


class HeaterZones:
    """A field of the sheet set by heaters: each node has the mean of their settings, weighted by view factors.

    The heaters are the rectangles of a grid over the sheet's extent in x and y, at a distance from it along z; of a
    part of a sheet that is cut along symmetry planes the other heaters are images of these.

    Args:
        scene: The scene; the settings that are closest to its own values are the start.
        grid: Heaters along x and along y.
        distance: Distance from the heaters to the sheet [m]: the larger, the smoother the field; 0 for zones with sharp
            boundaries.
        bounds: Least and largest setting, in the unit of the number.
        of: The designed field: "parison.temperature", or a parameter of the material, such as "material.c".

    Raises:
        InputError: If the bounds do not increase, the grid has too few heaters or too many, the distance is negative,
            or
            the scene has no such number.
    """

    def __init__(
        self,
        scene: Scene,
        *,
        grid: Sequence[int],
        distance: float,
        bounds: Bounds,
        of: str = "parison.temperature",
    ) -> None:
        """See the class."""
        check_bounds(bounds, positive=False)
        if len(grid) != 2 or min(grid) < 1 or not 2 <= int(np.prod(grid)) <= _MOST:
            raise InputError(f"needs 2 to {_MOST} heaters", "give their number along x and y", "variable.grid", grid)
        if not 0.0 <= distance < np.inf:
            raise InputError("is not a distance", "give metres, 0 for none", "variable.distance", distance)
        present = number_at(scene, of)
        if of == "parison.temperature" and present is None:
            remedy = "give the scene parison.temperature and [material.shift]"
            raise InputError("the sheet has no temperature", remedy, "variable.of", of)
        jaxform.replace(scene, {of: 1.0 if present is None else present})  # says what the scene has instead
        name = of.removeprefix("material.")
        cell = np.asarray(present, float)
        listed = name not in scene.material.zones and cell.ndim > 0
        if of != "parison.temperature" and (not hasattr(scene.material, name) or listed or cell.ndim > 1):
            remedy = "design parison.temperature, or a parameter of the material that is not a list"
            raise InputError("does not vary over the sheet", remedy, "variable.of", of)
        self.of, self.bounds, self.grid = of, bounds, (int(grid[0]), int(grid[1]))
        self._first_nodes = scene.first_nodes
        weights = _view_factors(scene, self.grid, distance)
        self._weights = jnp.asarray(spread_to_forest(scene, weights))
        start = np.broadcast_to(cell, (len(self._weights),))[: self._first_nodes]
        hold = 1e-6 * np.eye(
            weights.shape[1]
        )  # towards the mean, hardly: a heater that no node feels has no best value
        wanted = np.concatenate([start, np.full(len(hold), 1e-6 * start.mean())])
        settings = optimize.lsq_linear(np.concatenate([weights, hold]), wanted, bounds).x
        self.start, self.reach = invert_bounds(settings, bounds), full_reach(settings.size)

    def settings(self, free: ArrayLike) -> jax.Array:
        """Settings of the heaters (n,), those of one y after the other, x first."""
        return apply_bounds(jnp.asarray(free), self.bounds)

    def changes(self, free: jax.Array) -> dict[str, jax.Array]:
        """The number at the nodes (n_node,)."""
        return {self.of: self._weights @ self.settings(free)}

    def shares(self, free: jax.Array) -> jax.Array:
        """Settings (n,) as fractions of the range between their bounds."""
        return apply_bounds(free, (0.0, 1.0))

    def document(self, free: jax.Array) -> dict[str, Any]:
        """The number at the nodes of the mesh (n_node,), before it is refined."""
        return {self.of: np.asarray(self.changes(free)[self.of], float)[: self._first_nodes]}


def _view_factors(scene: Scene, grid: tuple[int, int], distance: float) -> np.ndarray:
    """View factors of each heater at each node of the mesh (n_node, n), normalized to a sum of 1 at each node.

    A small piece of sheet sees a small piece of heater, parallel to it, as cos^2 / (pi r^2) of its area.
    """
    places = first_positions(scene)
    low, high = places[:, :2].min(0), places[:, :2].max(0)
    side = (high - low) / np.asarray(grid)
    number = np.stack(np.meshgrid(*map(np.arange, grid), indexing="xy"), axis=-1).reshape(-1, 2)
    if distance == 0.0:
        cell = np.clip(((places[:, :2] - low) / side).astype(int), 0, np.asarray(grid) - 1)
        return np.eye(len(number))[cell[:, 0] + grid[0] * cell[:, 1]]
    inside = (np.stack(np.meshgrid(*[np.arange(_PARTS)] * 2), axis=-1).reshape(-1, 2) + 0.5) / _PARTS
    points = (low + side * (number[:, None] + inside[None])).reshape(-1, 2)
    seen = np.zeros((len(places), len(points)))
    for image in images(scene, np.column_stack([points, np.zeros(len(points))])):
        square = np.square(places[:, None, :2] - image[None, :, :2]).sum(2)
        seen += np.square(distance / (distance**2 + square))
    factors = seen.reshape(len(places), len(number), -1).sum(2)
    return factors / factors.sum(1, keepdims=True)

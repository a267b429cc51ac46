"""The sheet that every code of `make bench` steps: a clamped square of triangles, blown up by pressure."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.floating]

C, ALPHA, PRESSURE = 1.0, 0.1, 0.05
THICKNESS = 0.01


class Sheet(NamedTuple):
    """A square of side 1 m, its density 1 kg/m^3.

    Attributes:
        positions: (n_node, 3) [m].
        triangles: (n_element, 3).
        metric: Inverse of the initial metric (n_element, 3) [1/m^2].
        area: (n_element,) [m^2].
        compliance: One over the lumped mass (n_node, 3) [1/kg], 0 on the rim.
        step: A stable step [s].
    """

    positions: Array
    triangles: NDArray[np.int32]
    metric: Array
    area: Array
    compliance: Array
    step: float


def sheet(elements: int) -> Sheet:
    """About so many elements, in rows of pairs, the nodes inside moved at random so that no two are alike."""
    side = max(2, round((elements / 2) ** 0.5))
    x, y = np.meshgrid(np.linspace(0, 1, side + 1), np.linspace(0, 1, side + 1), indexing="ij")
    positions = np.stack([x.ravel(), y.ravel(), 0 * x.ravel()], axis=1)
    inside = np.all((positions[:, :2] > 0) & (positions[:, :2] < 1), axis=1)
    positions[inside, :2] += np.random.default_rng(0).uniform(-0.2, 0.2, (inside.sum(), 2)) / side
    i, j = np.meshgrid(np.arange(side), np.arange(side), indexing="ij")
    a = (i * (side + 1) + j).ravel()
    pairs = np.stack([a, a + side + 1, a + side + 2, a, a + side + 2, a + 1], axis=1)
    triangles = pairs.reshape(-1, 3).astype(np.int32)
    first, second, third = (positions[triangles[:, k]] for k in range(3))
    u, w = second - first, third - first
    g11, g12, g22 = (np.einsum("ij,ij->i", *pair) for pair in ((u, u), (u, w), (w, w)))
    determinant = g11 * g22 - g12**2
    area = 0.5 * np.sqrt(determinant)
    mass = np.bincount(triangles.ravel(), np.repeat(area * THICKNESS / 3, 3), len(positions))
    compliance = np.where(inside, 1 / mass, 0.0)[:, None] * np.ones(3)
    metric = np.stack([g22, -g12, g11], axis=1) / determinant[:, None]
    return Sheet(positions, triangles, metric, area, compliance, 0.06 / side)

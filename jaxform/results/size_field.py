"""Sizes that the elements of an adapted mesh should have, from the wall of a run.

An element's thickness misses the true one to first order in its size, the recovered one to second order: their
difference is an estimate of the error (Zienkiewicz, Zhu: A simple error estimator and adaptive procedure for practical
engineering analysis, Int. J. Numer. Meth. Eng. 24 (1987) 337-357). The error over the size, g, depends on the wall, not
on the mesh. For elements of size s the mean square error is the integral of (g s)^2, and their number that of 1/s^2:
the best sizes are in proportion to the inverse root of g. They are somewhat smaller where g is large, since nodes
that land there one after the other resolve the wall too.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from jaxform.model.scene import Scene
from jaxform.results.result import Result

Array = NDArray[np.float64]

_POWER = 0.6  # of the rate, by which sizes fall
_LEAST = 0.02  # of the mean rate, the least that counts
_SMOOTHINGS = 2  # of the squares of the rates: one element's says little


def wanted_sizes(scene: Scene, result: Result) -> Array:
    """Sizes of elements at the nodes (n_node,), up to a common factor: small where the error of the wall is large."""
    triangles, area = np.asarray(scene.parison.triangles), np.asarray(scene.tables.sheet.area, float)
    rate = np.square(element_errors(scene, result)) / area
    for _ in range(_SMOOTHINGS):
        nodal = _mean_at_nodes(rate, triangles, area, len(scene.parison.thickness))
        rate = nodal[triangles].mean(1)
    floor = np.square(_LEAST) * np.average(rate, weights=area)
    return np.maximum(nodal, max(floor, np.finfo(float).tiny)) ** (-0.5 * _POWER)


def element_errors(scene: Scene, result: Result) -> Array:
    """Estimated relative errors of the elements' thickness (n_element,): its logarithm less that of the recovered."""
    triangles = np.asarray(scene.parison.triangles)
    start = np.asarray(scene.parison.thickness, float)
    recovered = np.log(np.asarray(result.thickness, float) / start)[triangles].mean(1)
    return np.log(np.asarray(result.element_thickness, float) / start[triangles].mean(1)) - recovered


def _mean_at_nodes(values: Array, triangles: Any, area: Array, count: int) -> Array:
    """Means by initial area over the elements of each node (n_node,)."""
    weight = np.bincount(triangles.ravel(), np.repeat(area, 3), count)
    total = np.bincount(triangles.ravel(), np.repeat(values * area, 3), count)
    return total / np.where(weight > 0.0, weight, 1.0)

"""Triangles over plane regions: they follow the rim, fill it, and are regular."""

import numpy as np
import pytest

from jaxform.mesh import planform, topology

pytestmark = pytest.mark.quick


def polygon_area(loop: np.ndarray) -> float:
    following = np.roll(loop, -1, axis=0)
    return abs(float(np.sum(loop[:, 0] * following[:, 1] - loop[:, 1] * following[:, 0])) / 2)


def circle(radius: float, size: float) -> np.ndarray:
    angle = np.linspace(0, 2 * np.pi, 2000)
    curve = radius * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    return planform.resample(curve, lambda at: np.full(len(at), size))[:-1]


@pytest.mark.parametrize("graded", [False, True])
def test_a_ring_is_filled_with_regular_triangles(graded):
    loops = [circle(1.0, 0.1), circle(0.4, 0.1 / (1 + graded))]

    def size(at: np.ndarray) -> np.ndarray:
        return np.where(graded & (np.linalg.norm(at, axis=1) < 0.6), 0.05, 0.1)

    points, triangles = planform.triangulate(loops, size)
    corner = points[triangles]
    edge1, edge2 = corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]
    areas = 0.5 * (edge1[:, 0] * edge2[:, 1] - edge1[:, 1] * edge2[:, 0])
    assert areas.min() > 0
    np.testing.assert_allclose(areas.sum(), polygon_area(loops[0]) - polygon_area(loops[1]), rtol=1e-12)
    rim = sum(map(len, loops))
    np.testing.assert_array_equal(points[:rim], np.concatenate(loops))
    np.testing.assert_array_equal(topology.boundary_nodes(triangles), np.arange(rim))
    sides = np.linalg.norm(corner - np.roll(corner, 1, axis=1), axis=2)
    # Area against that of the equilateral triangle with the same sides' mean square.
    quality = areas / (np.sqrt(3) / 4 * np.mean(sides**2, axis=1))
    assert quality.min() > 0.5 and np.median(quality) > 0.9


def test_curves_that_the_triangles_cannot_follow_are_refused():
    needle = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 0.01], [0.5, 0.001], [0.0, 0.01]])
    with pytest.raises(ValueError):
        planform.triangulate([circle(2.0, 0.2), needle], lambda at: np.full(len(at), 0.2))

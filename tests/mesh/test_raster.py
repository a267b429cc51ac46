"""Values at pixels, row by row or one by one, are those of the triangle's plane."""

from __future__ import annotations

import numpy as np
import pytest

from jaxform.mesh import raster

pytestmark = pytest.mark.quick


def test_values_and_weights_at_pixels_are_linear_in_the_triangle() -> None:
    random = np.random.default_rng(5)
    width, height = 40, 30
    corners = random.uniform([-5.0, -5.0], [45.0, 35.0], (60, 3, 2))
    slope, level = random.normal(size=(60, 1, 2)), random.normal(size=(60, 1))
    values = (slope * corners).sum(2) + level
    pairs = 0
    for triangle, pixel, interpolate in raster.rasterize(corners, width, height):
        row, column = np.divmod(pixel, width)
        middle = np.stack([column, row], axis=1) + 0.5
        wanted = (slope[triangle, 0] * middle).sum(1) + level[triangle, 0]
        np.testing.assert_allclose(interpolate(values), wanted, atol=1e-9)
        weights = raster.weights(corners, triangle, pixel, width)
        np.testing.assert_allclose(weights.sum(0), 1.0, atol=1e-12)
        assert weights.min() > -1e-8
        np.testing.assert_allclose((weights.T * values[triangle]).sum(1), wanted, atol=1e-8)
        pairs += len(pixel)
    assert pairs > 1000

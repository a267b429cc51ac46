"""Nodal thickness from that of the elements."""

from __future__ import annotations

import dataclasses

import jax.numpy as jnp
import numpy as np

import jaxform
from jaxform.results.recovery import nodal_ratio
from tests import scenes


def _recovered(sheet: jaxform.shapes.Sheet, slope: tuple[float, float]) -> tuple[np.ndarray, np.ndarray]:
    """At the nodes what is found from the elements' values of a linear function, and that function."""
    parison = jaxform.make_parison(sheet.positions, sheet.triangles, 0.01, sheet.clamped, sheet.fixed)
    scene = jaxform.build_scene(
        parison=parison,
        material=scenes.mooney(0.1),
        pressure=jaxform.make_pressure([0.0], [0.0]),
        solver=jaxform.make_solver(end_time=1.0),
    )
    function = 1.0 + np.asarray(sheet.positions)[:, :2] @ slope
    values = jnp.asarray(function[np.asarray(sheet.triangles)].mean(1))
    mobile = scene.tables.mobility > 0.0
    return np.asarray(nodal_ratio(values, scene.tables.sheet, scene.parison.positions.T, mobile)), function


def test_a_linear_wall_is_found_on_an_uneven_mesh() -> None:
    sheet = jaxform.shapes.disc(radius=1.0, elements=200)
    positions = np.array(sheet.positions)
    inside = ~np.asarray(sheet.clamped)
    positions[inside, :2] += np.random.default_rng(5).uniform(-0.03, 0.03, (inside.sum(), 2))
    positions[:, 0] *= 1.0 + 0.3 * positions[:, 0]  # finer on one side
    found, function = _recovered(dataclasses.replace(sheet, positions=positions), (0.3, -0.2))
    size = np.sqrt(np.pi / 200)
    assert np.abs(found - function).max() < 0.02 * 0.3 * size


def test_on_a_symmetry_plane_the_wall_has_no_slope_across_it() -> None:
    """The images behind the planes belong to it: an even function is found, at the planes too."""
    quarter = jaxform.shapes.disc(radius=1.0, elements=400, symmetry="quarter")
    x, y = np.asarray(quarter.positions)[:, :2].T
    found, _ = _recovered(quarter, (0.0, 0.0))
    np.testing.assert_allclose(found, 1.0, rtol=1e-12)
    found, function = _recovered(quarter, (0.3, 0.0))
    across, inside = x == 0.0, ~np.asarray(quarter.clamped)
    along = (y == 0.0) & ~across & inside
    assert np.all(found[across & inside] > function[across & inside] + 1e-3)  # its images make it a roof
    np.testing.assert_allclose(found[along], function[along], atol=1e-3)

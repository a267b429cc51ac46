"""Nodal thickness from that of the elements."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxform
from jaxform.results.recovery import nodal_ratio
from tests import scenes

pytestmark = pytest.mark.quick


def _at_nodes(sheet: jaxform.shapes.Sheet) -> Callable[[jax.Array], jax.Array]:
    """The function that gives a sheet's values at the nodes from those of its elements."""
    parison = jaxform.make_parison(sheet.positions, sheet.triangles, 0.01, sheet.clamped, sheet.fixed)
    scene = jaxform.build_scene(
        parison=parison,
        material=scenes.mooney(0.1),
        pressure=jaxform.make_pressure([0.0], [0.0]),
        solver=jaxform.make_solver(end_time=1.0),
    )
    mobile = scene.tables.mobility > 0.0
    return lambda ratio: nodal_ratio(ratio, scene.tables.sheet, scene.parison.positions.T, mobile)


def _recover(sheet: jaxform.shapes.Sheet, slope: tuple[float, float]) -> tuple[np.ndarray, np.ndarray]:
    """At the nodes what is found from the elements' values of a linear function, and that function."""
    function = 1.0 + np.asarray(sheet.positions)[:, :2] @ slope
    values = jnp.asarray(function[np.asarray(sheet.triangles)].mean(1))
    return np.asarray(_at_nodes(sheet)(values)), function


def test_a_linear_wall_is_found_on_an_uneven_mesh() -> None:
    sheet = jaxform.shapes.disc(radius=1.0, elements=200)
    positions = np.array(sheet.positions)
    inside = ~np.asarray(sheet.clamped)
    positions[inside, :2] += np.random.default_rng(5).uniform(-0.03, 0.03, (inside.sum(), 2))
    positions[:, 0] *= 1.0 + 0.3 * positions[:, 0]  # finer on one side
    found, function = _recover(dataclasses.replace(sheet, positions=positions), (0.3, -0.2))
    size = np.sqrt(np.pi / 200)
    assert np.abs(found - function).max() < 0.02 * 0.3 * size


def test_on_a_symmetry_plane_the_wall_has_no_slope_across_it() -> None:
    """The images behind the planes belong to it: an even function is found, at the planes too."""
    quarter = jaxform.shapes.disc(radius=1.0, elements=400, symmetry="quarter")
    x, y = np.asarray(quarter.positions)[:, :2].T
    found, _ = _recover(quarter, (0.0, 0.0))
    np.testing.assert_allclose(found, 1.0, rtol=1e-12)
    found, function = _recover(quarter, (0.3, 0.0))
    across, inside = x == 0.0, ~np.asarray(quarter.clamped)
    along = (y == 0.0) & ~across & inside
    assert np.all(found[across & inside] > function[across & inside] + 1e-3)  # its images make it a roof
    np.testing.assert_allclose(found[along], function[along], atol=1e-3)


def test_a_rim_that_lies_flat_is_not_as_steep_as_the_wall_behind_it() -> None:
    """As on a flange: what is carried to the rim is no further from its elements' mean than as they differ."""
    sheet = jaxform.shapes.rectangle(size=(1.0, 0.8), elements=400)
    middles = np.asarray(sheet.positions)[np.asarray(sheet.triangles)].mean(1)[:, :2]
    clamped = np.asarray(sheet.clamped)
    at_rim = clamped[np.asarray(sheet.triangles)].any(1)
    ratio = jnp.asarray(np.where(at_rim, 1.0, 0.7 - 0.3 * np.abs(middles[:, 0] - 0.5)))
    at_nodes = _at_nodes(sheet)
    found = np.asarray(at_nodes(ratio))
    np.testing.assert_allclose(found[clamped], 1.0, atol=1e-5)
    # And there is a slope to differentiate, where elements are alike too.
    slope = jax.grad(lambda ratio: at_nodes(ratio)[clamped].sum())(ratio)
    change = np.random.default_rng(2).uniform(-1.0, 1.0, ratio.size)
    ends = [float(at_nodes(ratio + sign * 1e-9 * change)[clamped].sum()) for sign in (1, -1)]
    np.testing.assert_allclose(slope @ change, (ends[0] - ends[1]) / 2e-9, rtol=1e-4)


@pytest.mark.filterwarnings("ignore:jaxform computes in float32")
def test_one_process_may_use_both_precisions() -> None:
    walls = []
    for double in (True, False, True):
        with jax.enable_x64(double):
            wall = jaxform.simulate(scenes.free_disc(40, 0.3, scenes.mooney(0.1), end_time=1.0)).thickness
            assert wall.dtype == (np.float64 if double else np.float32)
            walls.append(np.asarray(wall, float))
    np.testing.assert_array_equal(walls[0], walls[2])
    np.testing.assert_allclose(walls[0], walls[1], rtol=1e-5)

"""Nodal thickness from that of the elements."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxform
from benchmarks.accuracy import cases
from jaxform.results.recovery import nodal_ratio, one_sided_thickness
from jaxform.results.size_field import wanted_sizes
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


@pytest.mark.long
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


def _cup_part(mold: Any) -> tuple[Any, jaxform.Scene, np.ndarray]:
    """A part whose elements have the exact wall of a cup on average, and which touches two faces; and that wall."""
    table = cases.exact_table("cup-at-40")
    sheet = jaxform.shapes.disc(radius=1.0, elements=610, symmetry="quarter")
    scene = jaxform.build_scene(
        parison=jaxform.make_parison(sheet.positions, sheet.triangles, 0.01, sheet.clamped, sheet.fixed),
        material=scenes.mooney(0.1),
        pressure=jaxform.make_pressure([0.0], [0.0]),
        solver=jaxform.make_solver(end_time=1.0),
        mold=jaxform.make_mold(mold.vertices, mold.triangles),
    )
    positions, triangles = np.asarray(sheet.positions), np.asarray(sheet.triangles)

    def ratio(places: np.ndarray) -> np.ndarray:
        return cases.exact_ratio(np.hypot(places[..., 0], places[..., 1]), table)

    weight = np.random.default_rng(4).dirichlet(np.ones(3), 400)
    of_elements = 1.0 / np.mean(1.0 / ratio(np.einsum("qk,eki->eqi", weight, positions[triangles])), axis=1)
    height = np.asarray(mold.vertices)[np.asarray(mold.triangles)][..., 2].mean(1)
    radius = np.hypot(*positions[:, :2].T)
    corner = float(table["initial_radius"][np.argmin(table["thickness_ratio"])])
    touched = np.where(radius < corner, np.argmax(height), np.argmin(height)) + 1
    mobile = scene.tables.mobility > 0.0
    nodal = nodal_ratio(jnp.asarray(of_elements), scene.tables.sheet, scene.parison.positions.T, mobile)
    part = SimpleNamespace(
        triangles=jnp.asarray(triangles),
        used=jnp.ones(len(triangles), bool),
        thickness=0.01 * nodal,
        element_thickness=jnp.asarray(0.01 * of_elements),
        element_volume=0.01 * scene.tables.sheet.area,
        wall=jnp.asarray(touched, jnp.int32),
        tool=jnp.asarray(np.where(touched > 0, 0, -1)),
        tool_wall=None,
    )
    return part, scene, 0.01 * ratio(positions)


def test_a_wall_with_a_cusp_is_found_from_either_side() -> None:
    """The elements round a node at the cusp are thicker than it on both sides: a function through them all is, too."""
    cup = jaxform.molds.revolved(profile=[[0.0, 0.5], [0.5, 0.5], [1.0, 0.0]], segments=48)
    part, scene, exact = _cup_part(cup)
    found, before = np.asarray(one_sided_thickness(part, scene)), np.asarray(part.thickness)
    area = cases.nodal_area(scene)
    assert cases.rms(found / exact - 1.0, area) < 0.6 * cases.rms(before / exact - 1.0, area)
    assert (found == before).mean() > 0.7  # elsewhere it is that
    _check_slope(part, scene)


def _check_slope(part: Any, scene: jaxform.Scene) -> None:
    """Compares the derivative by the elements' thickness with differences, where no two of them are alike."""

    def total(thickness: jax.Array) -> jax.Array:
        other: Any = SimpleNamespace(**vars(part) | {"element_thickness": thickness})
        return jnp.sum(one_sided_thickness(other, scene))

    uneven, way = np.random.default_rng(2).uniform(-1.0, 1.0, (2, part.element_thickness.size))
    start = part.element_thickness * (1.0 + 1e-2 * uneven)
    way = start * way
    slope = float(jax.grad(total)(start) @ way)
    assert (total(start + 1e-6 * way) - total(start - 1e-6 * way)) / 2e-6 == pytest.approx(slope, rel=1e-5)


def test_without_sharp_edges_the_wall_is_as_it_was() -> None:
    bowl = jaxform.molds.revolved(profile=[[np.sin(a), np.cos(a)] for a in np.linspace(0.0, np.pi / 2, 9)], segments=48)
    part, scene, _ = _cup_part(bowl)
    assert one_sided_thickness(part, scene) is part.thickness


def test_elements_at_a_cusp_are_not_much_smaller_than_those_of_an_even_mesh() -> None:
    """The smallest set the step of all, and a cusp asks for the smaller ones the finer the mesh that shows it."""
    bowl = jaxform.molds.revolved(profile=[[np.sin(a), np.cos(a)] for a in np.linspace(0.0, np.pi / 2, 9)], segments=48)
    part, scene, _ = _cup_part(bowl)
    middles = np.asarray(scene.parison.positions)[np.asarray(scene.parison.triangles)].mean(1)
    jump = np.where(np.hypot(*(middles[:, :2] - 0.3).T) < 0.1, 3.0, 1.0)
    part.element_thickness, part.thickness = 0.002 * jump, 0.002 + 0.0 * part.thickness
    size = wanted_sizes(scene, part)
    # As many equal elements have the size whose inverse square is the mean of those.
    density = np.mean(1.0 / np.square(size)[np.asarray(scene.parison.triangles)], axis=1)
    even = 1.0 / np.sqrt(np.average(density, weights=np.asarray(scene.tables.sheet.area)))
    assert 0.29 * even < size.min() < 0.4 * even < even < size.max()

"""The thinnest recovered wall and its scatter: of walls that are known, and of a cup around its corner."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest

import jaxform
from benchmarks.accuracy import cases
from jaxform import molds, shapes
from jaxform.model.scene import Scene
from jaxform.results.recovery import is_axisymmetric, thinnest_recovered

CUP = [[0.0, 0.5], [0.5, 0.5], [1.0, 0.0]]


def _scene(mold: Any, symmetry: Any = "none", thickness: Any = 0.01, elements: int = 600) -> Scene:
    sheet = shapes.disc(radius=1.0, elements=elements, symmetry=symmetry)
    return jaxform.build_scene(
        parison=jaxform.make_parison(sheet.positions, sheet.triangles, thickness, sheet.clamped, sheet.fixed),
        material=jaxform.NeoHookean(jnp.asarray(1.0), jnp.asarray(1.0)),
        pressure=jaxform.make_pressure([0.0, 1.0], [0.0, 0.01]),
        solver=jaxform.make_solver(end_time=1.0, damping=1.0),
        mold=None if mold is None else jaxform.make_mold(mold.vertices, mold.triangles),
    )


def _part(scene: Scene, wall: np.ndarray) -> Any:
    """A part that stays where it was, with a wall (n_node,) [m], as far as the scatter looks at it."""
    triangles = np.asarray(scene.parison.triangles)
    return SimpleNamespace(
        triangles=triangles,
        used=np.ones(len(triangles), bool),
        positions=np.asarray(scene.parison.positions),
        thickness=wall,
        element_thickness=wall[triangles].mean(1),
    )


def _wavy(scene: Scene, depth: float) -> np.ndarray:
    """Thinnest at 0.55 of the radius, where it goes up and down by a share, three times around."""
    x, y = np.asarray(scene.parison.positions)[:, :2].T
    return 0.01 * (1.0 + np.abs(np.hypot(x, y) - 0.55)) * (1.0 + depth * np.cos(3 * np.arctan2(y, x)))


@pytest.mark.parametrize(("symmetry", "elements"), [("none", 2400), ("half", 1200)])
def test_scatter_around_a_ring_is_that_of_its_thickness(symmetry: str, elements: int) -> None:
    scene = _scene(molds.revolved(profile=CUP, segments=48), symmetry, elements=elements)
    wall = _wavy(scene, 0.02)
    found = thinnest_recovered(_part(scene, wall), scene)
    assert found["scatter_of"] == "ring"
    assert found["recovered"] == wall.min()
    initial = np.asarray(scene.parison.thickness)[np.argmin(wall)]
    assert found["recovered_ratio"] == pytest.approx(wall.min() / initial)
    assert np.hypot(*found["recovered_place"][:2]) == pytest.approx(0.55, abs=0.03)
    # The root of the mean square of a cosine, within what the least of two nodes takes off its tops.
    assert found["scatter"] == pytest.approx(0.02 / np.sqrt(2), rel=0.1)
    # A wall that is as thin all around has none.
    assert thinnest_recovered(_part(scene, _wavy(scene, 0.0)), scene)["scatter"] < 1e-12


def test_scatter_elsewhere_is_that_of_the_elements_at_the_place() -> None:
    tray = molds.box_insert(size=[2.2, 2.2], depth=0.3, insert_size=[0.4, 0.4], insert_height=0.1)
    tray = SimpleNamespace(vertices=tray.vertices - np.array([1.1, 1.1, 0.0]), triangles=tray.triangles)
    scene = _scene(tray)
    assert not is_axisymmetric(scene)
    wall = _wavy(scene, 0.02)
    node = int(np.argmin(wall))
    wall[node] *= 0.99
    part = _part(scene, wall)
    found = thinnest_recovered(part, scene)
    assert found["scatter_of"] == "patch"
    there = part.element_thickness[(part.triangles == node).any(1)]
    assert found["scatter"] == pytest.approx(there.std() / there.mean(), rel=0.1)
    # Elements that do not count are ignored.
    part.used = ~(part.triangles == node).any(1)
    assert thinnest_recovered(part, scene)["recovered"] > found["recovered"]


def test_what_is_axisymmetric() -> None:
    cup = molds.revolved(profile=CUP, segments=48)
    beside = SimpleNamespace(vertices=cup.vertices + np.array([0.05, 0.0, 0.0]), triangles=cup.triangles)
    assert is_axisymmetric(_scene(None)) and is_axisymmetric(_scene(cup, "quarter"))
    assert not is_axisymmetric(_scene(beside))
    x, y = shapes.disc(radius=1.0, elements=600).positions[:, :2].T
    assert is_axisymmetric(_scene(cup, thickness=0.01 * (1.0 + np.hypot(x, y))))
    assert not is_axisymmetric(_scene(cup, thickness=0.01 * (1.5 + x)))


@pytest.mark.long
def test_a_cup_is_as_thin_all_around_its_corner() -> None:
    """With six segments more on each ring than on the last it is 5 % thinner on six spokes, and scatters by 2 %."""
    table = cases.exact_table("cup")
    corner = float(table["initial_radius"][np.argmin(table["thickness_ratio"])])
    sheet = cases.with_ring(shapes.disc(radius=1.0, elements=2400), corner)
    bottom = 1.0 - 0.8 / np.tan(np.radians(80.0))
    mold = molds.revolved(profile=[[0.0, 0.8], [bottom, 0.8], [1.0, 0.0]], segments=384)
    scene = cases.scene_of(
        sheet,
        cases.mooney(0.0),
        jaxform.make_pressure([0.0, 60.0], [0.0, 0.4], "cubic-ramp"),
        jaxform.make_mold(mold.vertices, mold.triangles, mold.dropped),
        end_time=65.0,
        damping=2.0,
    )
    result = jaxform.run(scene)
    found = thinnest_recovered(result, scene)
    assert int(result.status) == 0 and found["scatter_of"] == "ring"
    assert found["scatter"] < 2e-3, found
    # And the wall is right away from the corner.
    assert cases.wall_error(scene, result, table) < 0.012

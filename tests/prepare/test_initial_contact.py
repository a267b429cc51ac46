"""Begin of a run at the mold: flanges in the sheet's plane, and what is seen along lines of sight."""

from __future__ import annotations

import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxform
from jaxform.contact import ray_crossings
from jaxform.mesh import bisection
from jaxform.model.scene import Scene
from jaxform.prepare.initial_contact import find_initial_bisections
from jaxform.results.summary import measure_penetration
from jaxform.tools.search import build_grid
from tests import scenes

RIM = 0.6  # of the opening [m], in a disc of radius 1


def flange_scene(gap: float = 0.0, turn: int = 1, level: int = 0, **options: Any) -> Scene:
    """A quarter disc over a cup whose flange lies so far above it [m], with its triangles turned either way."""
    sheet = jaxform.shapes.disc(radius=1.0, elements=60, symmetry="quarter")
    profile = [[0.0, 0.4 + gap], [0.45, 0.4 + gap], [RIM, gap], [1.1, gap]]
    cup = jaxform.molds.revolved(profile=profile, segments=48)
    chosen: dict[str, Any] = {"angle": 12.0, "interval": 64, "elements": 700, "max_level": level} | options
    return jaxform.build_scene(
        parison=jaxform.make_parison(sheet.positions, sheet.triangles, 0.01, sheet.clamped, sheet.fixed),
        material=jaxform.NeoHookean(*(scenes.real(value) for value in (1.0, 1.0))),
        pressure=jaxform.make_pressure([0.0, 48.0], [0.0, 0.2], "cubic-ramp"),
        solver=jaxform.make_solver(end_time=54.0, damping=2.0),
        mold=jaxform.make_mold(cup.vertices, cup.triangles[:, ::turn]),
        fill=False,
        refinement=jaxform.make_refinement(**chosen) if level else None,
    )


def lying(scene: Scene) -> np.ndarray:
    assert scene.tables.initial_contact is not None
    return np.asarray(scene.tables.initial_contact)


@pytest.mark.parametrize("gap", [0.0, 1e-9, -1e-9, 1e-6, -1e-6])
def test_what_is_on_the_flange_lies_there_on_the_side_that_is_pushed(gap: float) -> None:
    for turn in (1, -1):
        scene = flange_scene(gap, turn)
        places, wall = np.asarray(scene.parison.positions), lying(scene)
        radius = np.hypot(places[:, 0], places[:, 1])
        on_it = radius > RIM + 1e-9
        np.testing.assert_array_equal(wall != 0, on_it)
        assert scene.mold is not None
        corners = np.asarray(scene.mold.vertices)[np.asarray(scene.mold.triangles)[np.abs(wall[on_it]) - 1]]
        normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])[:, 2]
        # The sheet is below, since the pressure pushes it up.
        np.testing.assert_array_equal(np.sign(wall[on_it]), -np.sign(normal))
        np.testing.assert_allclose(places[on_it, 2], gap, atol=1e-15)
        state, _ = scenes.begin_run(scene)
        clamped = np.asarray(scene.parison.clamped)
        np.testing.assert_array_equal(state.nodes.stuck, on_it | clamped)
        assert np.all(np.asarray(state.nodes.contact_time)[on_it & ~clamped] > 0)


def test_a_sheet_that_is_through_the_flange_is_refused() -> None:
    with pytest.raises(jaxform.InputError, match="initially penetrates the mold"):
        flange_scene(-2e-3)


def test_a_flange_beyond_a_hundredth_of_the_thickness_is_flown_to() -> None:
    assert flange_scene(2e-4).tables.initial_contact is None


def test_the_edge_of_the_opening_is_fine_at_once_and_no_node_hangs() -> None:
    scene = flange_scene(level=4)
    forest, tables = scene.tables.forest, scene.tables
    assert forest is not None and forest.fine_at_once is not None and tables.grid is not None
    split = np.zeros(forest.bound.size, bool)
    split[np.asarray(forest.fine_at_once)] = True
    partner, parent = np.asarray(forest.partner), (np.arange(split.size) - forest.root_count) // 2
    assert np.all(split[partner[split]])
    assert np.all(split[parent[split & (np.arange(split.size) >= forest.root_count)]])
    # Every element that lies on the flange in part is as fine as it may be.
    whole = np.concatenate([np.ones(forest.root_count, bool), np.repeat(split, 2)[: split.size - forest.root_count]])
    active = np.flatnonzero(whole & ~split)
    corners = np.asarray(forest.sheet.triangles).T[active]
    lies, clamped = (lying(scene) != 0)[corners], np.asarray(scene.parison.clamped)[corners]
    partly = (lies & ~clamped).any(1) & ~(lies | clamped).all(1)
    level = np.floor(np.log2(active / forest.root_count + 1)).astype(int)
    assert partly.sum() > 10 and np.all(level[partly] >= 4)
    # A smaller area is not asked for.
    planted = bisection.build_forest(
        np.asarray(scene.parison.positions)[: scene.first_nodes], np.asarray(scene.parison.triangles), 4
    )
    limited = jaxform.make_refinement(angle=12.0, interval=64, max_level=4, elements=700, min_area=1.0)
    assert len(find_initial_bisections(planted, tables.initial_contact, limited, None, tables.grid)) == 0


@functools.cache
def run_on_flange(gap: float, level: int) -> tuple[Scene, jaxform.Result]:
    scene = flange_scene(gap, level=level)
    return scene, jaxform.run(scene)


@pytest.mark.long
@pytest.mark.parametrize("gap", [1e-6, -1e-6, 3e-3])
def test_a_flange_forms_the_same_part_wherever_rounding_puts_it(gap: float) -> None:
    walls = []
    for place in (0.0, gap):
        scene, part = run_on_flange(place, 2)
        assert int(part.status) == 0
        thickness, radius = np.asarray(part.thickness), np.hypot(*np.asarray(scene.parison.positions)[:, :2].T)
        assert float(part.thickness.max()) < 0.0102
        first = np.arange(len(thickness)) < scene.first_nodes
        walls.append(thickness[first & (radius < RIM)])
        assert measure_penetration(part, scene).nodes < 1e-7
    # To rounding it is the same run; what has to fly to the flange forms the same part, but for the corner's elements.
    np.testing.assert_allclose(walls[1], walls[0], rtol=1e-6 if abs(gap) < 1e-4 else 0.05)
    np.testing.assert_allclose(walls[1].mean(), walls[0].mean(), rtol=0.02)


def box(turn: int) -> tuple[np.ndarray, np.ndarray]:
    """A closed box from (0, 0, 0) to (1, 1, 1), of which every other triangle may turn the other way."""
    vertices = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], float)
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    triangles = np.array([(q[0], q[k], q[k + 1]) for q in quads for k in (1, 2)])
    triangles[::2] = triangles[::2, ::turn]
    return vertices, triangles


@pytest.mark.parametrize("turn", [1, -1])
def test_ways_cross_a_closed_box_as_often_as_their_ends_say(turn: int) -> None:
    vertices, triangles = box(turn)
    grid = build_grid(vertices, triangles)
    ends = np.random.default_rng(3).uniform(-0.6, 1.6, (2, 3, 700))
    # Some along the edges between two triangles, and through a vertex.
    ends[:, :, 0] = [[0.5, 0.5, 0.5], [1.5, 0.5, 0.5]]
    ends[:, :, 1] = [[0.5, 0.5, 0.5], [1.5, 1.5, 1.5]]
    ends[:, :, 2] = [[-0.5, 0.5, 0.5], [1.5, 0.5, 0.5]]
    found = jax.jit(ray_crossings.ray_crossings)(*map(jnp.asarray, ends), jnp.ones(700, bool), grid)
    count, triangle, side = map(np.asarray, found)
    inside = np.all((ends > 0) & (ends < 1), axis=1)
    np.testing.assert_array_equal(count % 2 == 1, inside[0] != inside[1])
    assert count[:3].tolist() == [1, 1, 2] and count.max() == 2
    # The triangle that is crossed last is told with the side from which the way comes.
    crossed = count > 0
    triangle, side = triangle[crossed], side[crossed]
    corners = vertices[triangles[triangle]]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    path = (ends[1] - ends[0]).T[crossed]
    np.testing.assert_array_equal(side, -np.sign(np.einsum("ij,ij->i", path, normal)))


def test_ways_that_are_not_wanted_see_nothing() -> None:
    vertices, triangles = box(1)
    begin, end = jnp.full((3, 5), 0.5), jnp.full((3, 5), 3.0)
    count, triangle, _ = ray_crossings.ray_crossings(begin, end, jnp.arange(5) == 2, build_grid(vertices, triangles))
    assert count.tolist() == [0, 0, 1, 0, 0] and triangle.tolist()[:2] == [-1, -1]

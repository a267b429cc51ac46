"""Sticking contact against a brute-force oracle, and the places where it could leak."""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh

import jaxform
from benchmarks.speed import contact as figures
from jaxform import molds, shapes
from jaxform.contact import broad_phase, candidates
from jaxform.dynamics import contact_step
from jaxform.dynamics import window as windows
from jaxform.kernels.blocks import BLOCK
from jaxform.prepare import scene_builder
from jaxform.results.summary import measure_penetration
from jaxform.runs import host
from jaxform.sheet.state import State
from jaxform.tools import search
from jaxform.tools.mold import Mold
from jaxform.tools.penetration import penetration, point_triangle_distance
from jaxform.tools.search import CLASSES, FarCells, SearchGrid, build_grid, cell_of
from jaxform.tools.surface_walk import ContactSurface
from tests import scenes


def _shape(name: str) -> Mold:
    if name == "cup":
        shape = molds.revolved(profile=[[0.0, 1.0], [0.7, 1.0], [1.0, 0.0]], segments=24)
    elif name == "ribs":
        shape = molds.revolved(
            profile=[[0.0, 1.0], [0.3, 1.0], [0.31, 0.6], [0.4, 0.6], [0.41, 1.0], [0.9, 1.0], [1.0, 0.0]],
            segments=40,
        )
    elif name == "slivers":
        shape = molds.revolved(profile=[[0.0, 1.0], [0.7, 1.0], [1.0, 0.0], [0.8, -0.1]], segments=1500)
    else:
        corners = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], float)
        faces = [[0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1], [2, 3, 7], [2, 7, 6]]
        return jaxform.make_mold(corners, np.array(faces))
    return jaxform.make_mold(shape.vertices, shape.triangles)


def _mixed_triangles() -> Mold:
    """Two huge triangles, and on them a ball of tiny ones."""
    ball = trimesh.creation.icosphere(subdivisions=2, radius=0.01)
    plane = np.array([[-1.0, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]])
    vertices = np.concatenate([plane, np.asarray(ball.vertices) + np.array([0.2, 0.1, 0.005])])
    return jaxform.make_mold(vertices, np.concatenate([[[0, 1, 2], [0, 2, 3]], np.asarray(ball.faces) + 4]))


def _tangled_cup() -> Mold:
    """The open cup with a fin on its bottom (three triangles to an edge), copies, and every other triangle turned."""
    cup = molds.revolved(profile=[[0.0, 1.0], [0.7, 1.0], [1.0, 0.0]], segments=24)
    triangles = cup.triangles.copy()
    triangles[::2] = triangles[::2, ::-1]
    fin = np.array([[0, 1, len(cup.vertices)]])
    vertices = np.concatenate([cup.vertices, [[0.4, 0.1, 0.7]]])
    wall = jaxform.make_mold(vertices, np.concatenate([triangles, fin, triangles[:7]]))
    assert wall.dropped == 7
    return wall


_MOLDS = {
    "mixed": _mixed_triangles,
    "tangled": _tangled_cup,
    "fine torus": lambda: figures.mold_from_mesh(
        trimesh.creation.torus(1.0, 0.3, major_sections=200, minor_sections=100)
    ),
    **{name: figures.MOLDS[name] for name in ("box-insert", "bottle-half", "ribs", "icosphere")},
}


@pytest.mark.parametrize("name", scenes.short_first(_MOLDS, 2))
def test_random_paths_land_where_brute_force_says(name: str) -> None:
    # Brute force goes through forty thousand triangles for each path there.
    found = figures.compare(_MOLDS[name](), 1024 if name == "fine torus" else 4096, seed=3)
    assert 0.1 < found.hits / found.paths < 0.9
    assert found.missed == found.invented == 0
    assert found.worst_beta < 1e-12
    assert found.worst_place < 1e-14


def _walk(begin: jax.Array, end: jax.Array, wall: Mold, grid: SearchGrid) -> tuple[jax.Array, jax.Array]:
    landing, well = figures.walk(begin, end, wall, grid)
    assert well
    return landing.nodes.positions, landing.nodes.stuck


@pytest.mark.parametrize("name", scenes.short_first(["mixed", "tangled", "box-insert"]))
def test_nodes_that_land_one_by_one_land_as_all_at_once(name: str) -> None:
    """As a run without derivatives puts them there, and as one with derivatives does."""
    wall = _MOLDS[name]()
    grid = build_grid(np.asarray(wall.vertices), np.asarray(wall.triangles))
    begin, end = (jnp.asarray(place.T) for place in figures.random_paths(wall, grid, figures.BATCH, seed=8))
    (one, well), (all_at_once, _) = (figures.walk(begin, end, wall, grid, differentiable=way) for way in (False, True))
    assert well and 20 < int(one.nodes.stuck.sum()) < 110
    for value, expected in zip(jax.tree.leaves(one), jax.tree.leaves(all_at_once), strict=True):
        np.testing.assert_allclose(value, expected, rtol=1e-12, atol=1e-14)
    assert one.impact is not None
    before = np.concatenate([begin, end - begin])
    np.testing.assert_allclose(one.impact, np.where(one.nodes.stuck, before, 0.0), rtol=1e-12, atol=1e-14)


@pytest.mark.parametrize("name", ["cup", "ribs", "box", "slivers"])
def test_cells_know_a_true_bound_and_list_all_that_is_in_reach(name: str) -> None:
    wall = _shape(name)
    grid = build_grid(np.asarray(wall.vertices), np.asarray(wall.triangles))
    corners = np.asarray(wall.vertices)[np.asarray(wall.triangles)]
    points = np.random.default_rng(4).uniform(-1.5, 1.6, (400, 3))
    bound = np.asarray(search.cell_bounds(jnp.asarray(points.T), grid)[1])
    for point, least in zip(points, bound, strict=True):
        distance = point_triangle_distance(np.broadcast_to(point, (len(corners), 3)), corners)
        assert least <= distance.min() + 1e-12
    _check_lists(grid, grid, corners)


def test_nodes_that_fly_far_over_a_fine_mold_meet_what_brute_force_finds() -> None:
    shape = molds.divided(molds.revolved(profile=[[0.0, 1.0], [0.7, 1.0], [1.0, 0.0]], segments=24), 20)
    wall = jaxform.make_mold(shape.vertices, shape.triangles)
    near_by = build_grid(shape.vertices, shape.triangles)
    grid = build_grid(shape.vertices, shape.triangles, travel=2 * float(near_by.reach))
    assert near_by.far is None and grid.far is not None
    assert float(grid.farthest) > 2 * float(grid.reach)
    corners = wall.vertices[wall.triangles]
    _check_lists(grid.far, grid, np.asarray(corners))
    begin, end = figures.random_paths(wall, grid, 128, seed=6)
    assert np.mean(np.linalg.norm(end - begin, axis=1) > 2 * float(grid.reach)) > 0.2
    # Few at a time, so that all their pairs find room.
    parts = [
        _walk(jnp.asarray(b.T), jnp.asarray(e.T), wall, grid)
        for b, e in zip(*(np.split(x, 8) for x in (begin, end)), strict=True)
    ]
    place, stuck = (np.concatenate([np.asarray(part[k]) for part in parts], axis=-1) for k in (0, 1))
    beta = np.asarray(figures.brute_force(jnp.asarray(begin), jnp.asarray(end), corners))
    met = np.isfinite(beta)
    assert 0.1 < met.mean() < 0.9
    np.testing.assert_array_equal(np.asarray(stuck), met)
    meeting = begin + np.where(met, beta, 1.0)[:, None] * (end - begin)
    np.testing.assert_allclose(np.asarray(place).T, meeting, atol=1e-13)


def _check_lists(cells: SearchGrid | FarCells, grid: SearchGrid, corners: np.ndarray) -> None:
    """Each cell lists all that is in its reach of it, and its first classes all that is in a part of it."""
    points = np.random.default_rng(4).uniform(-1.5, 1.6, (400, 3))
    places = np.asarray(cell_of(jnp.asarray(points.T), cells))
    start, ends = np.asarray(cells.start), np.asarray(cells.ends).reshape(-1, CLASSES)
    listed = np.asarray(grid.number)[np.asarray(grid.listed)]
    for point, number in zip(points, places, strict=True):
        distance = point_triangle_distance(np.broadcast_to(point, (len(corners), 3)), corners)
        for kind, end in enumerate(ends[number]):
            within = np.flatnonzero(distance < float(cells.reach) * (kind + 1) / CLASSES)
            assert len(np.setdiff1d(within, listed[start[number] : end])) == 0


def _aim(wall: Mold, targets: np.ndarray, normal: np.ndarray, half: float) -> tuple[np.ndarray, np.ndarray]:
    grid = build_grid(np.asarray(wall.vertices), np.asarray(wall.triangles))
    begin, end = targets - half * normal, targets + half * normal
    place, stuck = _walk(jnp.asarray(begin.T), jnp.asarray(end.T), wall, grid)
    return np.asarray(place).T, np.asarray(stuck)


def test_no_path_leaks_through_shared_edges_and_vertices() -> None:
    wall = _shape("cup")
    corners = np.asarray(wall.vertices)[np.asarray(wall.triangles)]
    bottom = corners[np.all(np.abs(corners[..., 2] - 1.0) < 1e-12, axis=1)]
    share = np.random.default_rng(5).uniform(0.01, 0.95, (len(bottom), 1))
    on_edges = bottom[:, 0] + share * (bottom[:, 1] - bottom[:, 0])
    targets = np.concatenate([on_edges, [[0.0, 0.0, 1.0]]])  # the vertex that all of the fan share
    place, stuck = _aim(wall, targets, np.array([0.0, 0.0, 1.0]), 0.02)
    assert stuck.all()
    np.testing.assert_allclose(place, targets, atol=1e-12)


def test_of_two_walls_in_one_step_the_first_counts() -> None:
    near = np.array([[-1.0, -1, 0], [1, -1, 0], [0, 1, 0]])
    wall = jaxform.make_mold(np.concatenate([near, near + np.array([0, 0, 0.01])]), np.array([[3, 4, 5], [0, 2, 1]]))
    place, stuck = _aim(wall, np.array([[0.0, 0.0, 0.005]]), np.array([0.0, 0.0, 1.0]), 0.02)
    assert stuck.all()
    np.testing.assert_allclose(place[0], [0, 0, 0], atol=1e-15)


def test_a_node_that_starts_on_the_wall_stays_there() -> None:
    wall = _shape("cup")
    place, stuck = _aim(wall, np.array([[0.2, 0.1, 0.99]]), np.array([0.0, 0.0, 1.0]), -0.01)
    assert stuck.all()
    np.testing.assert_allclose(place[0], [0.2, 0.1, 1.0], atol=1e-14)


def test_a_parallel_path_beside_the_wall_is_free() -> None:
    wall = _shape("cup")
    place, stuck = _aim(wall, np.array([[0.2, 0.1, 0.999]]), np.array([1.0, 0.0, 0.0]), 0.02)
    assert not stuck.any()
    np.testing.assert_allclose(place[0], [0.22, 0.1, 0.999], atol=1e-15)


def test_the_mold_s_orientation_does_not_matter() -> None:
    wall = _shape("ribs")
    turned = jaxform.make_mold(np.asarray(wall.vertices), np.asarray(wall.triangles)[:, ::-1])
    random = np.random.default_rng(6)
    begin = random.uniform(-1, 1, (500, 3))
    end = begin + random.uniform(-0.03, 0.03, (500, 3))
    results = []
    for one in (wall, turned):
        grid = build_grid(np.asarray(one.vertices), np.asarray(one.triangles))
        results.append(_walk(jnp.asarray(begin.T), jnp.asarray(end.T), one, grid))
    np.testing.assert_array_equal(results[0][1], results[1][1])
    np.testing.assert_allclose(results[0][0], results[1][0], atol=1e-13)


def test_a_path_that_hardly_leaves_the_plane_lands_where_it_crosses() -> None:
    wall = _shape("cup")
    grid = build_grid(np.asarray(wall.vertices), np.asarray(wall.triangles))
    begin, end = np.array([[0.2, 0.1, 1.0 - 1e-7]]), np.array([[0.203, 0.1, 1.0 + 2e-7]])
    place, stuck = _walk(jnp.asarray(begin.T), jnp.asarray(end.T), wall, grid)
    assert stuck.all()
    np.testing.assert_allclose(np.asarray(place).T, [[0.201, 0.1, 1.0]], atol=1e-11)


def _with_mold(mold: Mold) -> jaxform.Scene:
    """The cup's sheet before another mold."""
    scene = scenes.cup()
    sheet = np.asarray(scene.parison.positions), np.asarray(scene.parison.triangles)
    tables = dataclasses.replace(scene.tables, grid=scene_builder._search_grid(mold, *sheet))
    return dataclasses.replace(scene, mold=mold, tables=tables)


def test_a_sheet_whose_rim_lies_on_the_mold_s_flange_comes_off_it() -> None:
    """The flange is in the sheet's plane; only the clamped rim may count as touching it at the start."""
    bare = jaxform.run(scenes.cup())
    flange = molds.revolved(profile=[[0.0, 0.5], [0.55, 0.5], [1.0, 0.0], [1.3, 0.0]], segments=48)
    flanged = jaxform.run(_with_mold(figures.mold_of(flange)))
    assert jaxform.explain(flanged) == "ok"
    np.testing.assert_allclose(flanged.thickness, bare.thickness, rtol=1e-3)
    touched = np.asarray(flanged.contact_time) > 0
    assert np.asarray(flanged.contact_time)[touched].min() > 1.0


def test_inverted_copied_and_open_triangles_make_the_same_part() -> None:
    mold = scenes.cup().mold
    assert mold is not None
    triangles = np.asarray(mold.triangles).copy()
    triangles[::3] = triangles[::3, [0, 2, 1]]
    untidy = jaxform.make_mold(np.asarray(mold.vertices), np.concatenate([triangles, triangles[:5]]))
    assert untidy.dropped == 5
    result = jaxform.run(_with_mold(untidy))
    expected = jaxform.run(scenes.cup())
    np.testing.assert_allclose(result.positions, expected.positions, atol=1e-12)


@pytest.mark.long
def test_what_is_tested_only_when_reached_is_the_same_as_tested_always(monkeypatch: pytest.MonkeyPatch) -> None:
    scene = scenes.cup()

    def take_windows() -> State:
        state, body, _ = host.begin(scene)
        advance = jax.jit(lambda state: windows.window(state, scene, body, differentiable=False))
        for _ in range(25):
            state = advance(state)
        return state

    skipping = take_windows()
    monkeypatch.setattr(
        contact_step,
        "find_active_pairs",
        lambda *args: (broad_phase.all_blocks(args[3]), broad_phase.find_active_pairs(*args)[1]),
    )
    monkeypatch.setattr(
        contact_step, "check_nodes", lambda *args: (jnp.asarray(True), broad_phase.check_nodes(*args)[1])
    )
    always = take_windows()
    assert 0 < int((skipping.nodes.wall != 0).sum())
    scenes.assert_same(skipping.nodes.positions, always.nodes.positions)
    np.testing.assert_array_equal(skipping.nodes.wall, always.nodes.wall)


def _retry(result: jaxform.Result) -> int:
    assert result.schedule is not None
    return int(np.sum((np.asarray(result.schedule.counts) == 0) & (np.asarray(result.schedule.lengths) > 0)))


def _run_blind() -> jaxform.Result:
    """The cup, in a process whose looks at the mold do not look ahead."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(broad_phase, "_AHEAD", 0.0)
        patch.setattr(contact_step, "LOOK_EVERY", 16)
        patch.setattr(candidates, "LOOK_EVERY", 0)
        return jaxform.run(scenes.cup())


@pytest.mark.long
def test_what_touches_between_two_looks_unseen_is_retried() -> None:
    """A search that does not look ahead always finds the first nodes to touch too late."""
    scene = scenes.cup()
    seen, blind = jaxform.run(scene), scenes.call_elsewhere(_run_blind)
    assert jaxform.explain(blind) == "ok"
    assert _retry(seen) < _retry(blind)
    assert measure_penetration(blind, scene).nodes < 1e-12
    np.testing.assert_allclose(blind.thickness, seen.thickness, rtol=2e-2)


def _list_nodes(tool: ContactSurface) -> broad_phase.Candidates:
    """A list of nodes near the mold, on random paths."""
    begin, end = (
        jnp.asarray(place.T[:, :BLOCK]) for place in figures.random_paths(tool.mold, tool.grid, BLOCK, seed=2)
    )
    step, free = jnp.asarray(1 / 16), jnp.ones(BLOCK, bool)
    return candidates.list_candidates(begin, end - begin, free, step, jnp.int32(16), tool.grid)


@pytest.mark.long
def test_where_pairs_find_no_room_lists_are_shorter_and_nothing_is_missed(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    scene = scenes.cup()
    (surface,) = scene.surfaces
    roomy, wide = jaxform.run(scene), _list_nodes(surface)
    # Room for 128 pairs, of a scene that is traced as it is: `run` would give it more.
    monkeypatch.setattr(broad_phase, "_LEAST_ROOM", 128)
    narrow = dataclasses.replace(scene, tables=dataclasses.replace(scene.tables, pairs_per_node=1))
    monkeypatch.setattr(broad_phase, "PAIRS_PER_NODE", 1)
    monkeypatch.setattr(broad_phase, "_CANDIDATES", 1)
    tight, slim = jax.jit(jaxform.simulate)(narrow), _list_nodes(surface)
    assert int(wide.count) > slim.lists.node.size - broad_phase.TEST_BLOCK and not (wide.overflow or slim.overflow)
    assert np.all(slim.limit_square < wide.limit_square)  # so that nodes leave their spheres sooner
    assert jaxform.explain(tight) == "ok"
    assert measure_penetration(tight, scene).nodes < 1e-12
    np.testing.assert_allclose(tight.thickness, roomy.thickness, rtol=1e-9)


def _roof(slope: float) -> Mold:
    """Two half planes that meet along the y axis at z = 0, `slope` up on both sides."""
    vertices = np.array([[x, y, slope * abs(x)] for y in (-3, 3) for x in (-3, 0, 3)], float)
    return jaxform.make_mold(vertices, np.array([[0, 1, 4], [0, 4, 3], [1, 2, 5], [1, 5, 4]]))


@pytest.mark.parametrize("slope, depth", [(-1.0, np.sqrt(0.5)), (1.0, 0.0)])
@pytest.mark.parametrize("turned", [False, True])
def test_an_element_over_a_convex_edge_is_seen_and_one_in_a_corner_is_not(
    slope: float, depth: float, turned: bool
) -> None:
    wall = _roof(slope)
    if turned:
        wall = dataclasses.replace(wall, triangles=wall.triangles.at[1].set(wall.triangles[1, ::-1]))
    # A flat strip from slope to slope, whose nodes came from above.
    nodes = np.array([[-1.0, 0, slope], [1, 0, slope], [1, 2, slope], [-1, 2, slope]])
    corners = np.asarray(wall.vertices)[np.asarray(wall.triangles)]
    up = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])[:, 2]
    on = np.array([0, 2, 2, 0])
    stuck_to = np.where(up[on] > 0, 1, -1) * (on + 1)
    beyond = penetration(nodes, np.array([[0, 1, 2], [0, 2, 3]]), stuck_to, wall)
    assert beyond.nodes < 1e-14
    np.testing.assert_allclose(beyond.elements, depth, atol=1e-12)
    if depth:
        np.testing.assert_allclose(beyond.place[[0, 2]], [0.0, slope], atol=1e-12)


def test_beyond_the_rim_of_an_open_mold_there_is_no_wall() -> None:
    wall = _roof(0.0)
    nodes = np.array([[2.0, 0, 0], [4, 0, -0.5], [4, 1, -0.5]])
    beyond = penetration(nodes, np.array([[0, 1, 2]]), np.array([3, 0, 0]), wall)
    assert beyond.elements < 0.3  # where it passes below the plate, not its end 0.5 below and beside it


def test_no_node_passes_the_box_or_the_bottle() -> None:
    for scene in (
        figures.box(figures.mold_of(molds.box_insert()), 150),
        figures.bottle(figures.mold_of(molds.bottle_half()), 0.012),
    ):
        result = jaxform.run(dataclasses.replace(scene, fill=False))
        assert jaxform.explain(result) == "ok"
        assert (np.asarray(result.wall) != 0).sum() > 10
        assert scene.tables.grid is not None
        assert measure_penetration(result, scene).nodes < 1e-12 * float(scene.tables.grid.size)


def test_the_same_surface_in_more_triangles_makes_the_same_part() -> None:
    block = molds.box_insert()
    assert figures.same_part(lambda mold: figures.box(mold, 150), block, molds.divided(block, 2)) < 1e-9


def test_gradient_with_respect_to_the_mold_s_vertices() -> None:
    """The whole mold is stretched along its depth; the differences rebuild the scene."""
    scene = scenes.cup()
    mold = scene.mold
    assert mold is not None
    stretch = mold.vertices * jnp.asarray([0.0, 0.0, 1.0])
    random = jnp.asarray(np.random.default_rng(2).uniform(0.5, 1.0, scene.parison.thickness.shape))

    def measure(vertices: jax.Array, scene: jaxform.Scene) -> jax.Array:
        moved = dataclasses.replace(scene, mold=dataclasses.replace(mold, vertices=vertices))
        return jnp.vdot(random, jaxform.simulate(moved).thickness)

    both = jax.jit(jax.value_and_grad(measure))
    slope = float(jnp.vdot(both(mold.vertices, scene)[1], stretch))

    def rebuilt(by: float) -> float:
        wall = jaxform.make_mold(np.asarray(mold.vertices + by * stretch), np.asarray(mold.triangles))
        return float(both(wall.vertices, _with_mold(wall))[0])

    deviations = [abs((rebuilt(h) - rebuilt(-h)) / (2 * h) / slope - 1) for h in (1e-5, 1e-6, 1e-7)]
    assert slope < 0  # deeper is thinner
    assert min(deviations) < 1e-5


def test_a_half_parison_lies_in_its_mold() -> None:
    sheet = shapes.bottle_half()
    assert 780 <= len(sheet.triangles) <= 820
    scene = figures.bottle(figures.mold_of(molds.bottle_half()), 0.0071)
    assert np.asarray(scene.parison.clamped).sum() > 50


@pytest.mark.long
def test_a_shot_that_flies_out_of_its_list_is_retried_and_hits() -> None:
    """A sudden pressure that moves the sheet far in its first steps; the window that missed something is repeated."""
    sudden = {"pressure.value": [3.0, 3.0], "solver.end_time": 3.0, "solver.damping": 1.0}
    scene = jaxform.replace(scenes.cup(), sudden)
    result = jaxform.run(scene)
    assert jaxform.explain(result) == "ok"
    assert int(result.shortened) > 0
    assert measure_penetration(result, scene).nodes < 1e-12
    assert float(np.asarray(result.positions)[:, 2].max()) <= 0.5 + 1e-12
    assert np.asarray(result.stuck).mean() > 0.8
    whole = jax.jit(jaxform.simulate)(scene)
    np.testing.assert_allclose(result.positions, whole.positions, atol=1e-9)


@pytest.mark.parametrize("turned", [(), (0,), (1, 3), (0, 1, 2, 3)])
def test_sampled_depths_do_not_depend_on_how_triangles_of_a_mold_turn(turned: tuple[int, ...]) -> None:
    """Two ridges, which are pieces of a mold, above a sheet; points before and beyond their faces."""
    ridge = np.array([[x, y, z] for x, z in ((0.0, 0.0), (-1.0, 2.0), (1.0, 2.0)) for y in (-9.0, 9.0)])
    triangles = np.array([[0, 1, 2], [1, 3, 2], [0, 4, 1], [1, 4, 5]])
    triangles[list(turned)] = triangles[list(turned), ::-1]
    pieces = (
        np.concatenate([ridge, ridge + np.array([9.0, 0.0, 0.0])]),
        np.concatenate([triangles, triangles[:, ::-1] + 6]),
    )
    mold = figures.mold_towards(*pieces, points=np.array([[0.5, 0.0, -3.0], [9.5, 0.0, -3.0]]))
    points = np.array([[0.0, 0.0, 1.0], [0.0, 0.1, -1.0], [9.0, 0.0, 1.0], [9.0, 0.1, -1.0]])
    found = figures.signed_distances(mold, points, together=2)
    np.testing.assert_allclose(found, [-1.0 / np.sqrt(5.0), 1.0] * 2)

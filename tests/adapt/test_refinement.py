"""Refinement in the run: what new nodes bring and take, replay, room, gradients, batches."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxform
from jaxform.adapt import element_bisection, refinement
from jaxform.core.errors import InputError
from jaxform.io import output
from jaxform.mesh import meshes, topology
from jaxform.model.scene import Scene
from jaxform.model.tables import BisectionHierarchy
from jaxform.results import result, summary
from jaxform.results.result import Result
from jaxform.sheet import discretization
from jaxform.sheet.discretization import NEVER
from jaxform.sheet.state import Schedule, State
from tests import scenes


def cup(elements: int = 192, **options: float) -> Scene:
    """The cup of the other tests, coarse at first."""
    coarse = scenes.cup(20, 12.0)
    assert coarse.mold is not None
    chosen = {"angle": 5.0, "interval": 64, "max_level": 2, "base_level": 2, "elements": elements} | options
    return jaxform.build_scene(
        parison=coarse.parison,
        material=coarse.material,
        pressure=coarse.pressure,
        solver=coarse.solver,
        mold=coarse.mold,
        fill=False,
        refinement=jaxform.make_refinement(**chosen),  # pyright: ignore[reportArgumentType]
    )


@pytest.fixture(scope="module")
def scene() -> Scene:
    return cup()


@pytest.fixture(scope="module")
def live(scene: Scene) -> Result:
    """A simulation of the scene as it is; `run` has it in the room of its bucket."""
    return jax.jit(jaxform.simulate)(scene)


def bisect_at_random(
    scene: Scene, seed: int
) -> tuple[State, State, discretization.Discretization, discretization.Discretization]:
    """A state moved and set in motion at random, and the same with elements bisected at random, three times."""
    random = np.random.default_rng(seed)
    thickness = np.asarray(scene.parison.thickness) * random.uniform(0.5, 1.5, scene.parison.thickness.size)
    scene = jaxform.replace(scene, {"parison.thickness": thickness})
    state, first = scenes.begin_run(scene)
    stuck = state.nodes.stuck
    free = ~stuck & (jnp.arange(stuck.size) < scene.tables.forest.first_nodes)  # pyright: ignore
    shape = state.nodes.positions.shape
    state = state.replace_nodes(
        positions=state.nodes.positions + jnp.where(free, jnp.asarray(random.normal(0, 0.01, shape)), 0.0),
        velocities=jnp.where(free, jnp.asarray(random.normal(0, 1, shape)), 0.0) * (first.compliance > 0),
    )
    forest = scene.tables.forest
    assert forest is not None
    after, now = state, first
    for _ in range(3):
        mesh = after.mesh
        assert mesh is not None
        wanted = jnp.asarray(random.uniform(size=mesh.element.size) < 0.2) & (
            discretization.element_levels(mesh.element, forest) < 2
        )
        after, now = scenes.bisect_scene(scene, after, now, wanted)
    return state, after, first, now


def lists_of(mesh: discretization.RefinedMesh, forest: BisectionHierarchy) -> None:
    """Checks the lists of a mesh against what is bisected."""
    split, count = np.asarray(mesh.split_at) != NEVER, int(mesh.element_count)
    element, number = np.asarray(mesh.element)[:count], np.arange(len(split))
    parent = (number - forest.root_count) // 2
    active = np.flatnonzero(((number < forest.root_count) | split[parent]) & ~split)
    np.testing.assert_array_equal(np.sort(element), active)
    triangles = np.asarray(forest.sheet.triangles)[:, element]
    node, places = np.asarray(mesh.node)[: int(mesh.node_count)], np.asarray(mesh.place)
    np.testing.assert_array_equal(np.sort(node), np.unique(triangles))
    np.testing.assert_array_equal(places[node], np.arange(len(node)))
    half = np.asarray(forest.half_edges)[:, element]
    side = np.full(forest.half_edge_count, -1)
    side[half] = np.arange(count)
    np.testing.assert_array_equal(mesh.side, side)
    np.testing.assert_array_equal(element_bisection.add_sides(mesh, forest).side, side)
    corner, room = np.asarray(mesh.corner), mesh.corner_count
    np.testing.assert_array_equal(np.bincount(places[triangles].ravel(), minlength=room.size), room)
    np.testing.assert_array_equal((corner >= 0).sum(0), room)
    for k in range(3):
        np.testing.assert_array_equal(
            corner[np.asarray(mesh.row)[k, :count], places[triangles[k]]], 4 * np.arange(count) + k
        )


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_new_nodes_keep_mass_and_in_flight_momentum_whatever_the_thickness(seed: int) -> None:
    # Nothing clamped and no mold: a sphere. Its new nodes lie on it, beyond their edges.
    sheet = jaxform.shapes.sphere(radius=1.0, elements=32, symmetry="none")
    scene = scenes.refinable(sheet, 200)
    before, after, first, now = bisect_at_random(scene, seed)
    assert before.mesh is not None and after.mesh is not None
    assert int(after.mesh.element_count) > int(before.mesh.element_count) == 32
    assert scene.tables.forest is not None
    lists_of(after.mesh, scene.tables.forest)

    def there(state: State) -> jax.Array:
        assert state.mesh is not None
        return jnp.arange(state.nodes.stuck.size) < state.mesh.node_count

    mass, new_mass = (jnp.where(there(s), b.mass, 0.0) for s, b in ((before, first), (after, now)))
    np.testing.assert_allclose(jnp.sum(new_mass), jnp.sum(mass), rtol=1e-13)
    assert first.volumes is not None
    np.testing.assert_allclose(jnp.sum(new_mass), jnp.sum(first.volumes[-32 * 4 :]), rtol=1e-13)
    momentum, new_momentum = (jnp.sum(m * s.nodes.velocities, axis=1) for m, s in ((mass, before), (new_mass, after)))
    np.testing.assert_allclose(new_momentum, momentum, atol=1e-14 * float(jnp.sum(mass)))
    # A flat cut changes no element's strain; what is lost is kinetic energy alone.
    kinetic = [0.5 * jnp.sum(m * jnp.sum(s.nodes.velocities**2, 0)) for m, s in ((mass, before), (new_mass, after))]
    assert 0 < float(after.account.refinement_loss) == pytest.approx(float(kinetic[0] - kinetic[1]), rel=1e-9)


def over_a_block(reach: float, gap: float = 0.0005, **options: Any) -> Scene:
    """A flat sheet half a millimetre over a block that is a tenth as wide, or so far over it [m]."""
    sheet = jaxform.shapes.rectangle(size=[0.6, 0.6], elements=128, symmetry="quarter")
    box = jaxform.molds.box_insert(size=[0.9, 0.9], depth=0.05, insert_size=[0.06, 0.06], insert_height=0.0495)
    top = np.unique(box.vertices[:, 2])[1]  # of the block; the rim is at 0 and the bottom below
    limits: dict[str, Any] = {"angle": 90.0, "interval": 64, "max_level": 0, "elements": 4000}
    return jaxform.build_scene(
        parison=jaxform.make_parison(sheet.positions, sheet.triangles, 1e-3, sheet.clamped, sheet.fixed),
        material=scenes.mooney(0.1, 1e5),
        pressure=jaxform.make_pressure([0.0, 0.1], [0.0, 1e3]),
        solver=jaxform.make_solver(end_time=0.1),
        mold=jaxform.make_mold(box.vertices - [0.15, 0.15, top - gap], box.triangles),
        fill=False,
        refinement=jaxform.make_refinement(base_level=6, proximity_factor=reach, **limits | options),
    )


def look_at(scene: Scene) -> tuple[discretization.Discretization, np.ndarray, np.ndarray, np.ndarray]:
    """After looks enough: the body, its elements' levels, their distance to a bend and their longest side [m]."""
    state, now = scenes.begin_run(scene)
    for _ in range(6):
        state, now = scenes.survey_of(state, scene, now)
    forest, mold, mesh = scene.tables.forest, scene.mold, state.mesh
    assert forest is not None and mold is not None and mesh is not None
    lists_of(mesh, forest)
    count = int(mesh.element_count)
    corners = np.asarray(state.nodes.positions).T[np.asarray(now.sheet.triangles)[:, :count]]
    side = np.linalg.norm(corners - np.roll(corners, 1, axis=0), axis=2).max(0)
    begin, end = topology.feature_edges(
        np.asarray(mold.vertices), np.asarray(mold.triangles), 10.0, rims=False
    ).swapaxes(0, 1)
    away, along = corners.mean(0)[:, None] - begin, end - begin
    share = np.clip((away * along).sum(2) / (along**2).sum(1), 0.0, 1.0)
    distance = np.linalg.norm(away - share[..., None] * along, axis=2).min(1)
    return now, np.asarray(discretization.element_levels(mesh.element, forest))[:count], distance, side


@pytest.mark.parametrize("reach", scenes.short_first([1.0, 2.0]))
def test_what_is_near_a_bend_becomes_as_fine_as_it_should_be(reach: float) -> None:
    scene = over_a_block(reach)
    assert scene.tables.forest is not None and scene.tables.forest.bend is not None and scene.tables.grid is not None
    parts = int(scene.tables.forest.bend.parts)
    slack = 2 * float(scene.tables.grid.width) / parts
    assert slack < 0.02
    _, level, distance, side = look_at(scene)
    near = distance + slack < reach * side
    assert np.all(level[near] >= 6) and np.sum(level >= 6) > 50
    # Coarse elements are far from all bends, and no fine element is.
    assert np.all(level[distance - slack > 0.3 * reach] == 0)
    _, coarse, *_ = look_at(over_a_block(reach, min_area=float(scene.tables.sheet.area[0]) / 9))
    assert coarse.max() < level.max()


def flying_at_first(scene: Scene) -> Scene:
    """The scene as if its sheet came from afar: nothing lies on the mold, or is fine at once."""
    forest = scene.tables.forest
    assert forest is not None
    tables = dataclasses.replace(
        scene.tables, initial_contact=None, forest=dataclasses.replace(forest, fine_at_once=None)
    )
    return dataclasses.replace(scene, tables=tables)


@pytest.mark.parametrize("at_rest", scenes.short_first([True, False]))
def test_new_nodes_near_the_mold_begin_at_rest_if_wanted_and_others_move_as_their_edges_did(at_rest: bool) -> None:
    scene = flying_at_first(over_a_block(2.0, at_rest=at_rest))
    before, now = scenes.begin_run(scene)
    upwards = jnp.where(before.nodes.stuck, 0.0, 1.0) * jnp.array([[0.1], [-0.2], [1.0]])
    before = before.replace_nodes(velocities=upwards)
    state, _ = scenes.survey_of(before, scene, now)
    forest, grid, old, mesh = scene.tables.forest, scene.tables.grid, before.mesh, state.mesh
    assert forest is not None and grid is not None and old is not None and mesh is not None
    new = np.arange(int(old.node_count), int(mesh.node_count))
    ends = np.asarray(mesh.place)[np.asarray(forest.ends)[:, np.asarray(mesh.node)[new]]]
    begin, end = (np.asarray(before.nodes.positions)[:, at] for at in ends)
    middle = 0.5 * (begin + end)
    # The block ends half a millimetre above the sheet; what is not over it is nearest to its sides.
    beside = np.maximum(np.abs(middle[:2] - 0.3) - 0.03, 0.0)
    distance = np.sqrt(beside[0] ** 2 + beside[1] ** 2 + 0.0005**2)
    size = np.minimum(np.linalg.norm(end - begin, axis=0), float(grid.reach))
    share = np.clip(2.0 * distance / size - 1.0, 0.0, 1.0)
    kept = share**2 * (3.0 - 2.0 * share) if at_rest else np.ones(len(new))
    held = np.asarray(forest.mobility)[:, np.asarray(mesh.node)[new]].max(0) == 0.0
    velocities = 0.5 * sum(np.asarray(upwards)[:, at] for at in ends) * np.where(held, 0.0, kept)
    np.testing.assert_allclose(np.asarray(state.nodes.velocities)[:, new], velocities, atol=1e-12)
    if at_rest:
        assert np.any(kept == 0.0) and np.any(kept == 1.0)


@pytest.mark.long
def test_a_sheet_that_lies_on_the_mold_is_refined_with_a_finite_gradient() -> None:
    scene = flying_at_first(over_a_block(2.0, gap=0.0))
    before, now = scenes.begin_run(scene)

    @jax.jit
    @jax.value_and_grad
    def swiftness(positions: jax.Array) -> jax.Array:
        moving = before.replace_nodes(positions=positions, velocities=jnp.ones_like(positions))
        moving = refinement.drop_sides(moving)
        return jnp.sum(jnp.square(refinement.refine(moving, scene, now)[0].nodes.velocities))

    value, slope = swiftness(before.nodes.positions)
    assert float(value) > 0.0 and np.all(np.isfinite(slope)) and np.any(np.asarray(slope) != 0.0)


def test_a_larger_reach_takes_more_elements() -> None:
    assert len(look_at(over_a_block(1.0))[1]) < len(look_at(over_a_block(2.0))[1])


def test_a_run_refines_balances_and_is_what_simulate_gives(scene: Scene, live: Result) -> None:
    ran = jaxform.run(scene)
    assert jaxform.explain(live) == "ok"
    assert len(scene.parison.triangles) * 3 < int(live.used.sum()) == int(ran.used.sum())
    assert set(np.unique(np.asarray(live.level)[np.asarray(live.used)])) >= {1, 2}
    np.testing.assert_allclose(ran.positions, live.positions, atol=1e-12)
    np.testing.assert_allclose(ran.thickness, live.thickness, atol=1e-14)
    np.testing.assert_allclose(ran.contact_time, live.contact_time, rtol=1e-9, atol=1e-11)
    count = int(live.used.sum())
    for name in ("triangles", "level", "used"):
        np.testing.assert_array_equal(getattr(ran, name)[:count], getattr(live, name)[:count], err_msg=name)
    for name in ("active", "wall"):
        np.testing.assert_array_equal(getattr(ran, name), getattr(live, name), err_msg=name)
    assert ran.schedule is not None and ran.schedule.split_at is not None and scene.tables.forest is not None
    assert ran.schedule.split_at.shape == scene.tables.forest.partner.shape
    # New nodes that begin at rest lose their energy at half a step from where it is counted.
    assert float(live.energy.balance_error) < 2e-3
    forest = scene.tables.forest
    assert forest is not None
    deepest = np.asarray(forest.sheet.area)[-(forest.root_count << forest.depth) :].sum()
    assert float(live.mass) == pytest.approx(deepest * 0.01, rel=1e-12)  # density 1
    assert summary.measure_penetration(live, scene).nodes < 1e-9
    active = np.asarray(live.active)
    assert np.isfinite(np.asarray(live.positions)).all() and np.isfinite(np.asarray(live.thickness)).all()
    assert (np.asarray(live.thickness)[active] > 0).all() and not np.asarray(live.thickness)[~active].any()
    np.testing.assert_array_equal(np.unique(np.asarray(live.triangles)[np.asarray(live.used)]), np.flatnonzero(active))


@jax.jit
def replay_unevenness(share: jax.Array, way: jax.Array, scene: Scene, schedule: Schedule) -> tuple[jax.Array, Result]:
    """Unevenness of the wall when the replayed sheet is so much thicker; and the part."""
    changed = jaxform.replace(scene, {"parison.thickness": scene.parison.thickness + share * way})
    part = jaxform.simulate(changed, schedule=schedule)
    area = part.element_volume / jnp.where(part.used, part.element_thickness, 1.0)
    mean = jnp.sum(part.element_volume) / jnp.sum(area)
    return jnp.sum(area * jnp.square(part.element_thickness / mean - 1.0)) / jnp.sum(area), part


def replay_of(scene: Scene, live: Result) -> Result:
    assert live.schedule is not None
    return replay_unevenness(scenes.real(0.0), scene.parison.thickness, scene, live.schedule)[1]


@pytest.mark.long
def test_a_replay_is_the_run_that_was_recorded(scene: Scene, live: Result) -> None:
    again = replay_of(scene, live)
    for name in ("used", "steps", "stuck"):
        np.testing.assert_array_equal(getattr(again, name), getattr(live, name), err_msg=name)
    for name in ("positions", "thickness", "velocities"):
        np.testing.assert_allclose(getattr(again, name), getattr(live, name), atol=1e-12, err_msg=name)
    schedule = live.schedule
    assert isinstance(schedule, Schedule) and int((schedule.counts > 0).sum()) == int(again.windows)
    assert int(again.windows) < int(live.windows)  # one was rejected
    assert schedule.split_at is not None and int((schedule.split_at != NEVER).sum()) > 10


def _volume_and_area(part: Result) -> tuple[float, float]:
    """Volume and formed area of the elements that there are."""
    used = np.asarray(part.used)
    volume, wall = np.asarray(part.element_volume)[used], np.asarray(part.element_thickness)[used]
    return float(volume.sum()), float((volume / wall).sum())


@pytest.mark.long
@pytest.mark.parametrize(("factor", "end_time"), [(0.6, 12.0), (1.0, 20.0)])
def test_a_replay_goes_on_where_its_schedule_does_not_fit(
    scene: Scene, live: Result, factor: float, end_time: float
) -> None:
    """A thinner sheet flies faster, out of windows that were long enough; and a longer run has more of them."""
    changed = jaxform.replace(scene, {"parison.thickness": factor * scene.parison.thickness})
    changed = jaxform.replace(changed, {"solver.end_time": end_time})
    again, own = replay_of(changed, live), jaxform.run(changed)
    assert jaxform.explain(again) == jaxform.explain(own) == "ok"
    assert float(again.time) == pytest.approx(float(own.time), rel=0.1)
    assert float(again.energy.balance_error) < 5e-3
    assert summary.measure_penetration(again, changed).nodes < 1e-9
    (volume, area), (own_volume, own_area) = _volume_and_area(again), _volume_and_area(own)
    assert volume == pytest.approx(own_volume, rel=1e-9)
    assert area == pytest.approx(own_area, rel=0.05)


def test_a_replay_is_smooth_along_a_line(scene: Scene, live: Result) -> None:
    """Its gradient: tests/runs/test_features.py."""
    start, schedule = scene.parison.thickness, live.schedule
    way = jnp.asarray(np.random.default_rng(0).normal(size=start.shape)) * start
    assert schedule is not None
    # With new nodes that move as their edges did it jumps by 1e-4 where a node lands before or after a border.
    shares = np.linspace(-1e-4, 1e-4, 41)
    values = np.array([float(replay_unevenness(scenes.real(share), way, scene, schedule)[0]) for share in shares])
    assert np.ptp(values) > 1e-4 * values[20]
    assert np.abs(np.diff(values, 2)).max() < 1e-7 * values[20]


@pytest.mark.long
def test_a_sheet_that_is_refined_in_fast_flight_has_exact_gradients() -> None:
    """A disc under a sudden pressure: its wall, the work, and what damping and new nodes take away."""
    sheet = jaxform.shapes.disc(radius=1.0, elements=40, symmetry="quarter")
    scene = jaxform.build_scene(
        parison=jaxform.make_parison(sheet.positions, sheet.triangles, 0.01, sheet.clamped, sheet.fixed),
        material=scenes.mooney(0.1),
        pressure=jaxform.make_pressure([0.0], [0.01]),
        solver=jaxform.make_solver(end_time=5.0, damping=0.1),
        refinement=jaxform.make_refinement(angle=3.0, interval=64, max_level=2, elements=800),
    )
    base = jaxform.run(scene)
    assert int(base.status) == 0 and int(base.used.sum()) > 1.5 * len(sheet.triangles)

    def shares(part: Result) -> jax.Array:
        energy = part.energy
        losses = energy.refinement_loss, energy.damping_loss
        return jnp.stack([*losses, energy.external_work, jnp.sum(jnp.square(part.thickness))])

    @jax.jit
    def measure(thickness: jax.Array) -> jax.Array:
        part = jaxform.simulate(jaxform.replace(scene, {"parison.thickness": thickness}), schedule=base.schedule)
        return jnp.sum(shares(part) / shares(base))

    assert jaxform.check_gradient(measure, scene.parison.thickness, steps=(1e-5, 1e-6)).error < 1e-6


@pytest.mark.long
def test_a_batch_is_single_runs(scene: Scene) -> None:
    factors = np.array([0.8, 1.0, 1.2])
    rows = {"parison.thickness": factors[:, None] * np.asarray(scene.parison.thickness)}
    together = jax.jit(jax.vmap(lambda rows: jaxform.simulate(jaxform.replace(scene, rows))))(
        jax.tree.map(jnp.asarray, rows)
    )
    for k, factor in enumerate(factors):
        alone = jaxform.run(jaxform.replace(scene, {"parison.thickness": factor * scene.parison.thickness}))
        np.testing.assert_array_equal(together.used[k], alone.used)
        np.testing.assert_allclose(together.positions[k], alone.positions, atol=1e-10)


@pytest.mark.long
def test_too_little_room_is_told_and_a_run_takes_more(live: Result) -> None:
    small = cup(96)  # becomes the room of the other tests
    short = jax.jit(jaxform.simulate)(small)
    assert "capacity" in jaxform.explain(short) and "refinement.elements" in jaxform.explain(short)
    larger = jaxform.run(small)
    assert jaxform.explain(larger) == "ok"
    assert int(larger.used.sum()) == int(live.used.sum())
    np.testing.assert_allclose(larger.positions, live.positions, atol=1e-12)


def test_files_and_pictures_have_the_nodes_that_exist(scene: Scene, live: Result, tmp_path: Path) -> None:
    output.write_part(scene, live, tmp_path / "final.vtu")
    mesh = meshes.read_mesh(tmp_path / "final.vtu")
    assert len(mesh.triangles) == int(live.used.sum()) and len(mesh.positions) == int(live.active.sum())
    shown, part = result.drop_unused(scene, live)
    np.testing.assert_array_equal(mesh.triangles, part.triangles)
    np.testing.assert_allclose(mesh.positions, part.positions)
    facts = jaxform.summarize(live, scene)
    assert facts["elements_initial"] == len(scene.parison.triangles) < facts["elements_final"]
    assert facts["nodes_final"] == len(mesh.positions) == len(shown.parison.positions)


@pytest.mark.parametrize(
    ("options", "key"),
    [
        ({"angle": 0.0}, "angle"),
        ({"max_level": 0}, "max_level"),
        ({"max_level": 30}, "max_level"),
        ({"interval": 0}, "interval"),
        ({"jump": 0.0}, "jump"),
        ({"min_area": -1.0}, "min_area"),
        ({"proximity_factor": 0.0}, "proximity_factor"),
    ],
)
def test_limits_out_of_range_are_told(options: dict[str, float], key: str) -> None:
    usual = {"angle": 5.0, "interval": 64, "max_level": 2, "elements": 100}
    with pytest.raises(InputError) as caught:
        jaxform.make_refinement(**usual | options)  # pyright: ignore[reportArgumentType]
    assert caught.value.key == f"refinement.{key}"


def test_room_for_less_than_the_first_mesh_is_refused() -> None:
    with pytest.raises(InputError, match="initial elements") as caught:
        cup(10)
    assert caught.value.key == "refinement.elements"

"""Scenes in the room of the ladder of sizes: the same results, nothing read beyond, nothing compiled twice."""

from __future__ import annotations

import dataclasses
import gc
import weakref
from collections.abc import Callable, Iterator
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import jaxform
from benchmarks.speed import waiting
from jaxform.core.store import Store
from jaxform.kernels import capacities
from jaxform.runs import host, padding
from jaxform.sheet.discretization import NEVER
from jaxform.sheet.state import Schedule
from tests.scenes import assert_same, cup

pytestmark = pytest.mark.filterwarnings("ignore:nothing touched the mold", "ignore:.*hardly moved")

_COMPILED = "/jax/core/compile/backend_compile_duration"


def dish(depth: float, elements: int, **options: Any) -> jaxform.Scene:
    """A quarter of a disc blown into a truncated cone of that depth [m], for less than half of the time."""
    return waiting.dish(depth, 65.0, elements, end_time=0.1, **options)


def refined_scene(elements: int) -> jaxform.Scene:
    """The same, refined where it bends."""
    scene = dish(0.05, elements)
    return jaxform.build_scene(
        parison=scene.parison,
        material=scene.material,
        pressure=scene.pressure,
        solver=scene.solver,
        mold=scene.mold,
        fill=False,
        refinement=jaxform.make_refinement(angle=4.0, interval=64, max_level=2, elements=300),
    )


@pytest.fixture
def compilations() -> Iterator[Callable[[], int]]:
    """Number of programs that were compiled, or loaded compiled, so far."""
    count = [0]

    def listen(event: str, duration_secs: float, **kwargs: str | int) -> None:
        count[0] += event == _COMPILED

    jax.monitoring.register_event_duration_secs_listener(listen)
    yield lambda: count[0]
    jax.monitoring.unregister_event_duration_listener(listen)


def test_a_second_scene_of_a_kind_compiles_nothing(compilations: Callable[[], int]) -> None:
    jaxform.run(dish(0.05, 60))
    before = compilations()
    for other in (dish(0.06, 80), dish(0.04, 120, knots=9), dish(0.05, 60, stiffness=3.0e5)):
        jaxform.run(other)
    assert compilations() == before


@pytest.mark.long
def test_programs_for_more_elements_serve_a_smaller_mesh(compilations: Callable[[], int]) -> None:
    """With the same result, nodes to the last bit; not those of three bucket sizes more."""
    first, second = (capacities.element_capacity(1), capacities.element_capacity(capacities.element_capacity(1)))
    scene, larger, store = dish(0.05, 77), dish(0.05, first + 40), Store()
    assert first < len(larger.parison.triangles) < second and not host.is_compiled(scene, store)
    jaxform.run(larger, store=store)
    before = compilations()
    assert host.is_compiled(scene, store) and not host.is_compiled(scene, store, 0)
    served = jaxform.run(scene, store=store)
    assert compilations() == before
    alone = jaxform.run(scene, store=Store())
    for name in ("positions", "thickness", "contact_time", "wall", "triangles", "steps"):
        assert_same(getattr(served, name), getattr(alone, name))
    assert float(served.energy.strain) == pytest.approx(float(alone.energy.strain), rel=1e-13)
    fourth = padding.pad_to_bucket(scene, capacities.element_capacity(second), recorded=True).scene
    host.programs(fourth, far := Store())
    assert len(host.select_bucket(scene, far).scene.parison.triangles) == first


@pytest.mark.long
def test_a_jitted_function_of_padded_scenes_is_traced_once(compilations: Callable[[], int]) -> None:
    scenes = [jaxform.padded(dish(0.05, 60)), jaxform.padded(dish(0.06, 90, knots=5))]
    assert jax.tree.structure(scenes[0]) == jax.tree.structure(scenes[1])
    traced = []

    @jax.jit
    def thinnest(scene: jaxform.Scene) -> jax.Array:
        traced.append(1)
        result = jaxform.simulate(scene)
        return jnp.min(jnp.where(result.active, result.thickness, jnp.inf))

    first, before = float(thinnest(scenes[0])), compilations()
    assert float(thinnest(scenes[1])) < first  # it is deeper
    assert len(traced) == 1 and compilations() == before


@pytest.mark.long
@pytest.mark.parametrize("make", [lambda: dish(0.05, 60), lambda: refined_scene(40)], ids=["uniform", "refined"])
def test_nothing_is_read_beyond(make: Callable[[], jaxform.Scene]) -> None:
    """Other nodes, other triangles of the mold and other entries of lists there change no bit."""
    room = padding.pad_to_bucket(make())
    assert room.order is not None
    scene, own = room.scene, room.original
    whole = host.whole_run
    expected = whole(scene)
    beyond = np.ones(len(scene.parison.positions), bool)
    beyond[room.order.node] = False
    assert beyond.any() and scene.mold is not None and own.mold is not None and scene.tables.grid is not None

    def perturb(values: Any, where: Any) -> jax.Array:
        return jnp.where(where.reshape(-1, *[1] * (np.ndim(values) - 1)), 7.0 + 0.5 * jnp.asarray(values), values)

    mold, grid = scene.mold, scene.tables.grid
    other_rows = np.arange(len(mold.triangles)) >= len(own.mold.triangles)
    vertices = perturb(mold.vertices, np.arange(len(mold.vertices)) >= len(own.mold.vertices))
    grid = dataclasses.replace(
        grid, frames=perturb(grid.frames, other_rows), outlines=perturb(grid.outlines, other_rows)
    )
    parison = dataclasses.replace(
        scene.parison,
        positions=perturb(scene.parison.positions, beyond),
        thickness=perturb(scene.parison.thickness, beyond),
    )
    changed = dataclasses.replace(
        scene,
        parison=parison,
        mold=dataclasses.replace(mold, vertices=vertices),
        tables=dataclasses.replace(scene.tables, grid=grid),
    )
    found = whole(changed)
    for name in ("thickness", "contact_time", "velocities", "element_thickness", "steps", "windows", "mass"):
        assert_same(getattr(found, name), getattr(expected, name))
    inside = ~beyond & np.asarray(expected.active)
    assert_same(np.asarray(found.positions)[inside], np.asarray(expected.positions)[inside])
    assert np.array_equal(found.active, inside)


def test_a_mesh_as_large_as_a_rung_has_an_element_to_spare(monkeypatch: pytest.MonkeyPatch) -> None:
    """Pairs that are none are of an element without area."""
    scene = dish(0.05, 60)
    monkeypatch.setattr(capacities, "_block_multiple", lambda count, _: count)
    room = padding.pad_to_bucket(scene).scene
    pairs = room.tables.assembly.pairs
    assert pairs is not None and room.tables.counts is not None and room.tables.counts.pairs is not None
    none = np.asarray(pairs.element)[0, int(room.tables.counts.pairs) :]
    assert len(none) and np.all(np.asarray(room.tables.sheet.area)[none] == 0.0)
    assert np.all(np.asarray(pairs.element)[1, int(room.tables.counts.pairs) :] == -1)


def test_a_schedule_of_a_refined_scene_goes_into_room_and_comes_back() -> None:
    room = padding.pad_to_bucket(refined_scene(40))
    order, rows = room.order, room.original.tables.window_count
    assert order is not None and order.triangle is not None
    steps, split = jnp.arange(1, rows + 1, dtype=jnp.int32), jnp.arange(len(order.triangle), dtype=jnp.int32)
    own = Schedule(1e-3 * steps, steps, 2e-3 * steps, split)
    there = room.schedule(own)
    split_there = np.asarray(there.split_at)
    np.testing.assert_array_equal(split_there[order.triangle], split)
    others = np.delete(split_there, order.triangle)
    assert len(others) and np.all(others == NEVER) and np.all(there.counts[rows:] == 0)
    back = room._schedule(there, order)
    for name in ("lengths", "counts", "bounds", "split_at"):
        np.testing.assert_array_equal(getattr(back, name), getattr(own, name), err_msg=name)


def test_frames_and_stops_see_the_scene_itself() -> None:
    scene, seen = dish(0.05, 60), []

    def look(moment: jaxform.Moment) -> bool:
        seen.append(moment.result())
        return len(seen) == 3

    result = jaxform.run(scene, on_window=look)
    assert len(seen) == 3
    for each in (*seen, result):
        assert each.positions.shape == scene.parison.positions.shape
        assert each.triangles.shape == scene.parison.triangles.shape


@pytest.mark.long
def test_what_has_room_already_keeps_it() -> None:
    scene = jaxform.padded(dish(0.05, 60))
    assert jaxform.padded(scene) is scene
    result = jaxform.run(scene)
    assert result.thickness.shape == scene.parison.thickness.shape
    assert int(result.active.sum()) < len(result.active)


def test_what_scenes_share_is_padded_once_while_it_is_there() -> None:
    scene = dish(0.05, 60)
    other = jaxform.replace(scene, {"parison.thickness": 2e-3, "material.c": 3e5})
    rooms = [padding.pad_to_bucket(each, recorded=True).scene for each in (scene, other)]
    assert rooms[0].tables is rooms[1].tables and rooms[0].mold is rooms[1].mold
    assert np.all(np.asarray(rooms[1].parison.thickness) == 2e-3)
    assert padding.pad_to_bucket(scene).scene.tables.window_count != rooms[0].tables.window_count
    gone = weakref.ref(rooms[0].tables), weakref.ref(rooms[0].mold)
    del scene, other, rooms
    gc.collect()
    assert gone[0]() is None and gone[1]() is None


def test_a_search_grid_is_padded_once_for_all_sizes_of_a_sheet() -> None:
    """Its cells' lists take far longer to copy than a sheet's arrays, and `check` asks for three sizes."""
    scene = dish(0.05, 60)
    smaller, larger = (padding.pad_to_bucket(scene, least).scene for least in (0, 2000))
    assert len(smaller.parison.triangles) < len(larger.parison.triangles)
    one, other = smaller.tables.grid, larger.tables.grid
    assert one is not None and other is not None
    for name in ("bound", "start", "ends", "listed", "outlines", "frames"):
        assert getattr(one, name).unsafe_buffer_pointer() == getattr(other, name).unsafe_buffer_pointer()


def test_what_can_be_written_into_is_padded_anew() -> None:
    scene = dish(0.05, 60)
    assert scene.mold is not None
    vertices = np.array(scene.mold.vertices)
    scene = dataclasses.replace(scene, mold=dataclasses.replace(scene.mold, vertices=vertices))
    first = padding.pad_to_bucket(scene).scene.mold
    vertices += 1e-3
    second = padding.pad_to_bucket(scene).scene.mold
    assert first is not None and second is not None
    np.testing.assert_allclose(second.vertices, np.asarray(first.vertices) + 1e-3)


def test_a_traced_scene_is_not_padded() -> None:
    with pytest.raises(jaxform.InputError, match="is traced"):
        jax.jit(jaxform.padded)(cup())


@given(st.integers(1, 3_000_000), st.integers(0, 3_000_000))
def test_rungs_hold_what_they_are_for(count: int, more: int) -> None:
    ladders: list[Callable[[int], int]] = [
        capacities.element_capacity,
        capacities.root_capacity,
        capacities.refined_capacity,
        capacities.knot_capacity,
        capacities.window_capacity,
        capacities.mold_triangle_capacity,
        capacities.cell_capacity,
        capacities.cell_list_capacity,
        lambda count: capacities.node_capacity(count, 1000),
        lambda count: capacities.pair_capacity(count, 1000),
    ]
    for ladder in ladders:
        room = ladder(count)
        assert count <= room <= max(ladder(1), 4 * count)
        assert ladder(room + more) >= room
    assert capacities.node_capacity(count, 1000) > count and capacities.pair_capacity(count, 1000) > count
    edges = capacities.half_edge_capacity(count, 1000)
    assert edges % 2 == 0 and edges >= count + 2

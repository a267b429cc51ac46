"""Saved work changes nothing: packing, blocks, checkpoints and batches give the numbers of plain runs."""

from __future__ import annotations

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxform
from benchmarks.speed.bench import disable_skips
from jaxform import molds, shapes
from jaxform.core.pytree import as_real
from jaxform.dynamics import timestep
from jaxform.dynamics.window_state import initial_state
from jaxform.kernels import blocks
from jaxform.mechanics import force, membrane
from jaxform.mechanics.corners import Load
from jaxform.model.tables import ReferenceGeometry
from jaxform.prepare import planning
from jaxform.runs import host, simulation
from jaxform.sheet import packing
from jaxform.sheet.active_set import active_set_of
from jaxform.sheet.discretization import discretize
from jaxform.sheet.energy_balance import element_energy
from jaxform.sheet.state import is_finished, noise_vector
from tests import scenes


@pytest.mark.parametrize("switch", scenes.short_first(["skip_stuck", "skip_far", "end_early"]))
def test_the_result_is_the_same_with_a_skip_off(switch: str) -> None:
    """The steps are held to the elements' bound: the search for the highest mode depends on what is packed away."""
    scene = disable_skips(scenes.cup(), sharp_step=False)
    on, off = jaxform.run(scene), jaxform.run(disable_skips(scene, **{switch: False}))
    assert jaxform.explain(on) == jaxform.explain(off) == "ok"
    if switch == "skip_stuck":
        assert int(on.steps) == int(off.steps)
    # Larger balls halt other windows, so that other steps are taken.
    tolerance = 1e-12 if switch != "skip_far" else 2e-4
    np.testing.assert_allclose(on.positions, off.positions, rtol=0, atol=tolerance)
    np.testing.assert_allclose(on.thickness, off.thickness, rtol=20 * tolerance)
    np.testing.assert_allclose(on.energy.external_work, off.energy.external_work, rtol=20 * tolerance)
    np.testing.assert_array_equal(on.stuck, off.stuck)


def _pushed_and_blown(law: jaxform.ContactLaw) -> jaxform.Scene:
    """A disc that a plug with this contact law pushes, half draws back and lets rest; then it is blown into a cup."""
    sheet = shapes.disc(radius=1.0, elements=100, symmetry="quarter")
    cup = molds.revolved(profile=[[0.0, 0.6], [0.859, 0.6], [1.0, 0.0]], segments=48)
    plug = molds.revolved(profile=[[0.0, -0.01], [0.3, -0.06], [0.35, -0.61]], segments=32)
    motion = jaxform.make_motion([0.0, 0.0, 1.0], [0.0, 3.6, 12.0], [0.0, 0.4, 0.2])
    return jaxform.build_scene(
        parison=jaxform.make_parison(sheet.positions, sheet.triangles, 0.01, sheet.clamped, sheet.fixed),
        material=jaxform.MooneyRivlin(as_real(1.0), as_real(0.1), as_real(1.0)),
        pressure=jaxform.make_pressure([0.0, 4.0, 12.0], [0.0, 0.0, 0.14]),
        solver=jaxform.make_solver(end_time=16.0, damping=2.0),
        mold=jaxform.make_mold(cup.vertices, cup.triangles),
        tools=[jaxform.make_mold(plug.vertices, plug.triangles, motion=motion, contact=law)],
        fill=False,
    )


@pytest.mark.long
@pytest.mark.parametrize("law", [jaxform.Stick(), jaxform.Coulomb(as_real(0.3))], ids=["sticks", "slides"])
def test_what_sticks_to_a_tool_at_rest_is_packed_away_while_others_move_or_nodes_slide(law: jaxform.ContactLaw) -> None:
    scene = disable_skips(_pushed_and_blown(law), sharp_step=False)
    on, off = jaxform.run(scene), jaxform.run(disable_skips(scene, skip_stuck=False))
    assert jaxform.explain(on) == jaxform.explain(off) == "ok" and int(on.steps) == int(off.steps)
    assert np.any(on.tool == 0) and (np.any(on.tool == 1) if law.sticks else float(on.energy.friction_loss) > 0.0)
    np.testing.assert_allclose(on.positions, off.positions, rtol=0, atol=1e-12)
    np.testing.assert_allclose(on.thickness, off.thickness, rtol=2e-11)
    np.testing.assert_array_equal(on.tool, off.tool)
    for name in ("external_work", "tool_work", "friction_loss", "damping_loss"):
        np.testing.assert_allclose(getattr(on.energy, name), getattr(off.energy, name), rtol=1e-10, atol=1e-18)
    state, first, taken = host.begin(scene)
    carried, left, held = 0, np.zeros(0, bool), np.zeros(0, bool)
    while not bool(is_finished(state, scene)):
        state, taken, _ = host.advance(state, scene, first, taken, jnp.int32(4))
        left = np.asarray(active_set_of(state, scene, first).packed.kept)
        held = np.asarray(state.nodes.stuck)[np.asarray(scene.parison.triangles)].all(1)
        carried = max(carried, np.sum(held & left))
    # In the end no element is left whose nodes all stick, but for the second of a pair; before, the plug carried some.
    assert np.sum(left) < 0.6 * left.size and np.sum(held & left) < 0.1 * left.size
    assert carried > 3 or not law.sticks


@pytest.mark.long
def test_a_run_with_a_tool_ends_when_nothing_can_move_any_more() -> None:
    """Also where the tool carries nodes: not before that has come to rest."""
    sheet = shapes.disc(radius=1.0, elements=24, symmetry="quarter")
    plate = np.array([[-2.0, -2.0, 0.0], [2.0, -2.0, 0.0], [2.0, 2.0, 0.0], [-2.0, 2.0, 0.0]])
    away = jaxform.make_motion([0.0, 0.0, 1.0], [0.0, 5.0], [0.0, 0.2])
    scene = jaxform.build_scene(
        parison=jaxform.make_parison(sheet.positions, sheet.triangles, 0.01, sheet.clamped, sheet.fixed),
        material=scenes.mooney(0.1),
        pressure=jaxform.make_pressure([0.0], [0.0]),
        solver=jaxform.make_solver(end_time=20.0),
        tools=[jaxform.make_mold(plate, np.array([[0, 1, 2], [0, 2, 3]]), motion=away)],
        fill=False,
    )
    result = jaxform.run(scene)
    assert jaxform.explain(result) == "ok" and 5.0 < float(result.time) < 10.0
    free = ~np.asarray(sheet.clamped)
    np.testing.assert_allclose(np.asarray(result.positions)[free, 2], 0.2, rtol=1e-12)
    assert not np.asarray(result.velocities).any()


def test_what_sticks_is_packed_away() -> None:
    scene = scenes.cup()
    state, discrete, _ = host.begin(scene)
    moving = np.zeros(scene.tables.sheet.area.size, bool)
    moving[[3, 4, 40]] = True
    packed = packing.pack(jnp.asarray(moving), scene.tables.sheet, scene.tables.assembly)
    elements = packed.elements
    assert int(elements.block_count) == int(elements.node_block_count) == 1
    # Both elements of a pair stay where either can move.
    pairs = scene.tables.assembly.pairs
    assert pairs is not None
    both = np.unique(np.asarray(pairs.element)[:, np.asarray(pairs.pair)[moving]])
    moving[both[both >= 0]] = True
    np.testing.assert_array_equal(packed.kept, moving)
    np.testing.assert_array_equal(np.sort(packed.element[elements.area > 0]), np.flatnonzero(moving))
    kept = np.unique(np.asarray(scene.parison.triangles)[moving])
    np.testing.assert_array_equal(np.sort(packed.node[: len(kept)]), kept)
    np.testing.assert_array_equal(packed.unpack(packed.pack(state.nodes.positions)), state.nodes.positions)
    # The force on the nodes of these elements is that of these elements alone.
    random = np.random.default_rng(0).normal(0, 0.05, state.nodes.positions.shape)
    positions = state.nodes.positions + random
    load = Load(packed.pack(positions), discrete.thickness[packed.element], scenes.real(0.1), scene.material)
    got, volume = force.force(load, elements)
    whole = packing.pack(None, scene.tables.sheet, scene.tables.assembly)
    thickness = jnp.where(jnp.asarray(moving), discrete.thickness, 0.0)[whole.element]
    area, orientation = (
        jnp.where(jnp.asarray(moving)[whole.element], values, 0.0)
        for values in (whole.elements.area, jnp.asarray(whole.elements.orientation))
    )
    full = Load(whole.pack(positions), thickness, scenes.real(0.1), scene.material)
    expected, all_volume = force.force(full, dataclasses.replace(whole.elements, area=area, orientation=orientation))
    np.testing.assert_allclose(packed.unpack(got), whole.unpack(expected), atol=1e-15)
    np.testing.assert_allclose(volume, all_volume, rtol=1e-12)


@pytest.mark.parametrize("paired", scenes.short_first([False, True]))
@pytest.mark.parametrize("backend", scenes.short_first(["cpu", "another"]))
def test_a_node_of_many_elements_hands_its_surplus_to_a_list(
    backend: str, paired: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A fan of 40 triangles around one node, beside a sheet that makes a deep table dear."""
    sheet = shapes.rectangle(size=(1.0, 1.0), elements=900)
    angle = np.linspace(0, 2 * np.pi, 41)[:-1]
    rim = np.stack([np.cos(angle), np.sin(angle), np.ones(40)], axis=1)
    hub, first = len(sheet.positions), len(sheet.positions) + 1
    fan = np.stack([np.full(40, hub), first + np.arange(40), first + (np.arange(40) + 1) % 40], axis=1)
    triangles = np.concatenate([sheet.triangles, fan]).astype(np.int32)
    positions = np.concatenate([sheet.positions, [[0.0, 0.0, 1.0]], rim])
    if paired:
        assembly = packing.make_paired_assembly(positions, triangles)
    else:
        assembly = packing.make_assembly(triangles, len(positions))
    assert assembly.table.shape[0] < (20 if paired else 40)
    assert set(np.asarray(assembly.overflow_node)) == {hub}
    inverse, area = membrane.reference_metric(jnp.asarray(positions.T), jnp.asarray(triangles.T))
    moved = jnp.asarray(positions.T * 1.1 + np.random.default_rng(1).normal(0, 0.003, positions.T.shape))
    law = scenes.mooney(0.3)

    def energy(x: jax.Array, kept: np.ndarray) -> jax.Array:
        return membrane.strain_energy(x, jnp.asarray(triangles.T), inverse, 0.01 * area * kept, law)

    monkeypatch.setattr(blocks.jax, "default_backend", lambda: backend)
    # Also where the hub's first elements, in its row of the table, or all but the last few, are packed away.
    everything, tabled = np.ones(len(triangles), bool), assembly.table.shape[0]
    for packed_away in (0, 1, tabled, tabled + 3):
        kept = everything.copy()
        kept[len(sheet.triangles) :][:packed_away] = False
        mesh = ReferenceGeometry(jnp.asarray(triangles.T), inverse, area, jnp.zeros(3))
        packed = packing.pack(jnp.asarray(kept) if packed_away else None, mesh, assembly)
        load = Load(packed.pack(moved), jnp.full(packed.element.size, 0.01), scenes.real(0.0), law)
        got = packed.unpack(force.force(load, packed.elements)[0])
        expected = -jax.grad(energy)(moved, np.asarray(packed.kept))
        np.testing.assert_allclose(got, expected, atol=1e-12 * float(jnp.abs(expected).max()))


def _run_without_blocks() -> jaxform.Result:
    """The cup, in a process of another device's ways: whole arrays are worked through at once."""
    scene = scenes.cup()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(blocks.jax, "default_backend", lambda: "another")
        return jaxform.run(scene)


@pytest.mark.long
def test_without_blocks_the_force_is_the_same() -> None:
    in_blocks, whole = jaxform.run(scenes.cup()), scenes.call_elsewhere(_run_without_blocks)
    assert int(whole.steps) == int(in_blocks.steps)
    np.testing.assert_allclose(whole.positions, in_blocks.positions, atol=1e-11)


@pytest.mark.long
def test_the_measured_step_is_close_below_the_true_limit() -> None:
    """In every window of a run, against many more iterations; and the result is that of the elements' bound."""
    scene = scenes.free_disc(60, 2.0, scenes.mooney(0.5))
    ratios = []

    @jax.jit
    def limit(positions: jax.Array, pressure: jax.Array) -> jax.Array:
        discrete = discretize(scene)
        whole = packing.pack(None, scene.tables.sheet, scene.tables.assembly)
        load = Load(whole.pack(positions.T), discrete.thickness[whole.element], pressure, scene.material)
        count = positions.shape[0]
        tangent = jax.jacfwd(lambda x: force.force(load._replace(positions=x), whole.elements)[0])(load.positions)
        stiffness = -tangent[:, :count, :, :count].reshape(3 * count, 3 * count)
        root = jnp.sqrt(discrete.compliance).ravel()
        matrix = root[:, None] * stiffness * root[None, :]
        return 2.0 / jnp.sqrt(jnp.linalg.eigvalsh(0.5 * (matrix + matrix.T)).max())

    before = [0.0, 0]

    def on_window(moment: jaxform.Moment) -> None:
        now = moment.result()
        if int(now.windows) % 4 == 1:
            step = (float(now.time) - before[0]) / (int(now.steps) - before[1])
            ratios.append(step / float(limit(now.positions, scene.pressure.at(now.time))))
        before[:] = float(now.time), int(now.steps)

    sharp = jaxform.run(scene, on_window=on_window)
    assert jaxform.explain(sharp) == "ok"
    assert len(ratios) > 2
    assert 0.75 < min(ratios[:-1]) <= max(ratios) < 0.95
    plain = jaxform.run(disable_skips(scene, sharp_step=False))
    assert int(sharp.steps) < 0.8 * int(plain.steps)
    np.testing.assert_allclose(sharp.positions, plain.positions, atol=1e-3)


@jax.jit
def _first_step(scene: jaxform.Scene) -> tuple[jax.Array, timestep.StepLimit]:
    state = initial_state(scene)
    active = active_set_of(state, scene, discretize(scene))
    length, _, limit, _ = timestep.choose_step(active.pack_state(state), scene, active)
    return length, limit


def test_the_first_step_is_not_cold() -> None:
    scene = scenes.free_disc(60, 2.0, scenes.mooney(0.1))
    sharp, (mode, _, sharpness, _) = _first_step(scene)
    assert mode is not None and 1.1 < float(sharpness) < 2.0
    plain = disable_skips(scene, sharp_step=False)
    bound, (mode, _, _, _) = _first_step(plain)
    assert mode is None
    assert 1.1 < float(sharp / bound) < 2.0
    # The message of `check` is found on the host. The step is on the ladder.
    assert 0.85 < float(bound) / planning.first_step(plain) <= 1.0


@pytest.mark.long
def test_the_slope_of_a_batch_is_that_of_its_designs_whatever_is_stored() -> None:
    scene = disable_skips(scenes.free_disc(60, 2.0, scenes.mooney(0.1), end_time=10.0), sharp_step=False)

    def wall(thickness: jax.Array, pressure: jax.Array, adjoint: jaxform.Adjoint | None = None) -> jax.Array:
        changed = jaxform.replace(scene, {"parison.thickness": thickness, "pressure.value": pressure})
        return jnp.mean(jnp.square(jaxform.simulate(changed, adjoint=adjoint).thickness)) * 1e4

    def together(rows: jax.Array, pressure: jax.Array) -> jax.Array:
        return jnp.sum(jax.vmap(wall, (0, None))(rows, pressure))

    rows = jnp.stack([factor * scene.parison.thickness for factor in (0.9, 1.0, 1.2)])
    slope, pressing = jax.jit(jax.grad(together, argnums=(0, 1)))(rows, scene.pressure.value)
    alone = jax.jit(jax.grad(functools.partial(wall, adjoint=jaxform.Reversed(windows=3)), argnums=(0, 1)))
    single = [alone(row, scene.pressure.value) for row in rows]
    np.testing.assert_allclose(slope, [row for row, _ in single], rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(pressing, sum(p for _, p in single), rtol=1e-9, atol=1e-12)


@pytest.mark.long
def test_a_batch_gives_the_results_of_single_runs() -> None:
    scene = scenes.cup()
    factors = np.array([0.8, 1.0, 1.25])
    rows = {"parison.thickness": factors[:, None] * np.asarray(scene.parison.thickness)}
    rows["pressure.value"] = np.stack([np.asarray(scene.pressure.value)] * 3)
    together = jaxform.simulate_batch(scene, rows, workers=2)
    beside = simulation._simulate_designs(scene, {path: jnp.asarray(values) for path, values in rows.items()})
    for k in range(3):
        alone = jaxform.run(jaxform.replace(scene, {path: values[k] for path, values in rows.items()}))
        scenes.assert_same(together.thickness[k], alone.thickness)
        assert int(together.steps[k]) == int(alone.steps) == int(beside.steps[k])
        np.testing.assert_allclose(beside.thickness[k], alone.thickness, rtol=1e-9)


@pytest.mark.parametrize(
    "rows",
    [{}, {"pressure.value": 1.0}, {"pressure.value": np.ones((2, 2)), "material.c": np.ones(3)}],
)
def test_a_batch_refuses_rows_that_do_not_match(rows: dict[str, np.ndarray]) -> None:
    with pytest.raises(jaxform.InputError, match="rows"):
        jaxform.simulate_batch(scenes.cup(), rows)


@pytest.mark.skipif(jax.default_backend() != "cpu", reason="other devices work on all blocks at once")
def test_blocks_in_use_are_worked_through_and_no_others() -> None:
    values = jnp.arange(4.0 * blocks.BLOCK)
    start = jnp.full((1, values.size), -1.0)
    for count in (0, 1, 3):
        (got,), (total,) = blocks.over_blocks(
            lambda x: ([(2.0 * x,)], [x]), jnp.int32(count), (values,), [start], sums=1
        )
        used = count * blocks.BLOCK
        np.testing.assert_array_equal(got[0, :used], 2 * values[:used])
        assert np.all(np.asarray(got[0, used:]) == -1.0)
        assert float(total) == float(values[:used].sum())


@pytest.mark.skipif(jax.default_backend() != "cpu", reason="other devices work on all blocks at once")
def test_a_block_gets_its_own_number_and_the_largest_of_all_is_found() -> None:
    size = blocks.BLOCK
    values, own = jnp.arange(4.0 * size) % 200, np.asarray([3.0, 1.0, 2.0, 9.0])
    for count in (0, 1, 3, 4):
        used = np.asarray(values).reshape(4, size)[:count] * own[:count, None]
        expected = used.max(initial=0.0)
        _, (total, largest, least) = blocks.over_blocks(
            lambda x, factor: ([], [x, factor * x, -x]),
            jnp.int32(count),
            (values, blocks.PerBlock(jnp.asarray(own))),
            [],
            sums=1,
            most=2,
        )
        assert float(total) == float(values[: count * blocks.BLOCK].sum())
        assert float(largest) == expected
        assert float(least) == 0.0


@pytest.mark.parametrize("backend", ["cpu", "another"])
def test_values_are_lowered_where_a_new_one_is_lower(backend: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(blocks.jax, "default_backend", lambda: backend)
    values, places = jnp.asarray([4.0, 4.0, 4.0]), jnp.asarray([2, 0, 2, 1])
    got = blocks.scatter_min(values, places, jnp.asarray([3.0, 5.0, 1.0, 0.0]), jnp.int32(3))
    np.testing.assert_array_equal(got, [4.0, 4.0, 1.0])


def test_a_state_comes_back_from_the_packed_order_as_it_was() -> None:
    """Also from that of a sheet of which most sticks, some nodes of which have many elements."""
    scene = scenes.cup()
    start, discrete = scenes.begin_run(scene)
    stuck = start.nodes.stuck | (jnp.linalg.norm(start.nodes.positions, axis=0) < 0.6)
    assert 5 < int(jnp.sum(~stuck)) < stuck.size / 2
    velocities = jnp.where(stuck, 0.0, noise_vector(start.nodes.positions))
    state = start.replace_nodes(stuck=stuck, velocities=velocities, mode=noise_vector(start.nodes.positions))
    active = active_set_of(state, scene, discrete)
    taken = active.pack_state(state)
    assert not np.array_equal(active.packed.place, np.arange(stuck.size))
    for got, expected in zip(jax.tree.leaves(active.unpack_state(taken)), jax.tree.leaves(state), strict=True):
        np.testing.assert_array_equal(got, expected)
    # The inactive elements make up for what the account leaves out.
    whole = discrete.whole
    thickness = discrete.thickness[whole.element]
    energy, volume = element_energy(state.nodes.positions * 1.1, whole.elements, thickness, scene.material, None)
    moved = state.replace_nodes(positions=state.nodes.positions * 1.1)
    active = active_set_of(moved, scene, discrete)
    elements = active.packed.elements
    own, inside = element_energy(
        active.pack_state(moved).nodes.positions, elements, active.thickness, scene.material, None
    )
    assert 0.0 < float(own) < float(energy)
    np.testing.assert_allclose(own + active.inactive_energy, energy, rtol=1e-13)
    np.testing.assert_allclose(inside + active.inactive_volume, volume, rtol=1e-13, atol=1e-16)


def test_a_part_of_a_longer_array_is_read_and_written_where_it_is() -> None:
    size = 2 * blocks.BLOCK
    long = jnp.arange(6.0 * size).reshape(2, 3 * size)
    written, (updated,) = jnp.zeros((2, 3 * size)), (jnp.ones((1, size)),)
    new, _ = blocks.over_blocks(
        lambda old, part: ([[old[0][0] + part[0]], list(part)], []),
        jnp.int32(2),
        (blocks.ArraySlice(long, jnp.int32(size), size),),
        [updated, blocks.ArraySlice(written, jnp.int32(2 * size), size)],
        update=1,
    )
    np.testing.assert_array_equal(new[0][0], 1.0 + long[0, size : 2 * size])
    np.testing.assert_array_equal(new[1], written.at[:, 2 * size :].set(long[:, size : 2 * size]))


def test_replaced_switches_are_static() -> None:
    scene = scenes.cup()
    assert dataclasses.replace(scene.solver, skip_stuck=False).skip_stuck is False
    assert jax.tree.structure(scene) != jax.tree.structure(disable_skips(scene, skip_stuck=False))

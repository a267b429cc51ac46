"""Nodal fields that a user adds: carried through steps, contact, packing, refinement, padding, batches and output."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any, cast

import jax
import jax.numpy as jnp
import meshio
import numpy as np
import pytest

import jaxform
from jaxform import shapes
from jaxform.core.errors import InputError
from jaxform.io import output
from jaxform.sheet.state import Status
from tests import scenes
from tests.examples.cooling import Cooling
from tests.scenes import real

AIR, MOLD = 0.02, 0.3  # 1/s


def cooling(initial: Any, air: float = AIR, mold: float = MOLD) -> Cooling:
    return Cooling(jnp.asarray(initial, float), real(air), real(mold), real(20.0), real(10.0))


@pytest.fixture(scope="module")
def cup() -> jaxform.Scene:
    """The shared cup with a sheet that is hotter where x is larger."""
    plain = scenes.cup()
    return jaxform.build_scene(
        parison=plain.parison,
        material=plain.material,
        pressure=plain.pressure,
        solver=plain.solver,
        mold=plain.mold,
        fill=False,
        fields={"temperature": cooling(150.0 + 30.0 * np.asarray(plain.parison.positions)[:, 0])},
    )


@pytest.fixture(scope="module")
def cup_result(cup: jaxform.Scene) -> jaxform.Result:
    return jaxform.run(cup)


@pytest.mark.long
def test_a_field_follows_each_node_through_contact(cup: jaxform.Scene, cup_result: jaxform.Result) -> None:
    """Newton's cooling in closed form: in the air until the node touches, then on the mold to the end."""
    began = np.asarray(cast("Any", cup.fields["temperature"]).initial)
    end, touched = float(cup_result.time), np.asarray(cup_result.contact_time)
    assert np.isclose(end, float(cup.solver.end_time)) and np.mean(touched > 0) > 0.5
    until = np.where(touched > 0, touched, end)
    hot = 20.0 + (began - 20.0) * np.exp(-AIR * until)
    expected = np.where(touched > 0, 10.0 + (hot - 10.0) * np.exp(-MOLD * (end - until)), hot)
    length = end / float(cup_result.steps)
    np.testing.assert_allclose(cup_result.fields["temperature"], expected, rtol=0, atol=150.0 * MOLD * 2 * length)


@pytest.mark.long
def test_a_field_that_nothing_reads_changes_nothing(cup_result: jaxform.Result) -> None:
    plain = scenes.cup()
    without_skips = dataclasses.replace(plain, solver=dataclasses.replace(plain.solver, skip_stuck=False))
    usual = jaxform.run(without_skips)
    assert usual.fields == {}
    np.testing.assert_allclose(cup_result.positions, usual.positions, rtol=0, atol=1e-9)
    np.testing.assert_allclose(cup_result.thickness, usual.thickness, rtol=1e-7)


def test_a_batch_carries_it(cup: jaxform.Scene, cup_result: jaxform.Result) -> None:
    own = cup_result.fields["temperature"]
    rates = np.asarray([MOLD, 2 * MOLD])
    batch = jaxform.simulate_batch(cup, {"fields.temperature.mold_rate": rates})
    assert batch.fields["temperature"].shape == (2, own.size)
    np.testing.assert_allclose(batch.fields["temperature"][0], own, rtol=0, atol=1e-9)
    assert np.all(np.asarray(batch.fields["temperature"][1]) <= np.asarray(own) + 1e-9)


def test_new_nodes_have_the_mean_of_their_edge() -> None:
    """A field that is linear in the initial place stays so at every node that refinement inserts."""
    sheet = shapes.rectangle(size=(1.0, 1.0), elements=24)
    x, y = sheet.positions[:, 0], sheet.positions[:, 1]
    scene = jaxform.build_scene(
        parison=jaxform.make_parison(sheet.positions, sheet.triangles, 0.01, sheet.clamped, sheet.fixed),
        material=scenes.mooney(0.1),
        pressure=jaxform.make_pressure([0.0, 16.0], [0.0, 0.08]),
        solver=jaxform.make_solver(end_time=24.0, damping=1.0),
        refinement=jaxform.make_refinement(angle=3.0, interval=64, max_level=4, elements=600),
        fields={"place": cooling(3.0 + 2.0 * x - y, air=0.0, mold=0.0)},
    )
    result = jaxform.run(scene)
    active, places = np.asarray(result.active), np.asarray(scene.parison.positions)
    assert int(result.status) == 0 and active.sum() > 3 * len(x)
    values = np.asarray(result.fields["place"])
    np.testing.assert_allclose(values[active], (3.0 + 2.0 * places[:, 0] - places[:, 1])[active], rtol=1e-13)
    assert np.all(values[~active] == 0.0)


def test_what_cannot_be_stepped_backwards_is_named(cup: jaxform.Scene) -> None:
    plain = scenes.cup()
    assert plain.reversible and not plain.irreversible_parts
    assert plain.mold is not None
    motion = jaxform.Motion(jnp.array([0.0, 0.0, 1.0]), jnp.array([0.0, 1.0]), jnp.array([0.0, 0.01]))
    moving = dataclasses.replace(plain, mold=dataclasses.replace(plain.mold, motion=motion))
    assert moving.irreversible_parts == ["the mold moves"]
    assert cup.irreversible_parts == ["it has user-defined fields"]


def test_the_reversed_scheme_is_refused_in_words(cup: jaxform.Scene) -> None:
    with pytest.raises(InputError, match="backwards: it has user-defined fields"):
        jaxform.simulate(cup, adjoint=jaxform.Reversed())
    with pytest.raises(InputError, match="not an adjoint strategy"):
        jaxform.simulate(cup, adjoint=cast("Any", 1))
    with pytest.raises(InputError, match="positive whole number"):
        jaxform.Checkpointed(windows=0)


def test_files_have_it(cup: jaxform.Scene, cup_result: jaxform.Result, tmp_path: Path) -> None:
    output.write_result(cup, cup_result, tmp_path)
    read = meshio.read(tmp_path / "final.vtu")
    np.testing.assert_allclose(read.point_data["temperature"], cup_result.fields["temperature"], rtol=1e-12)
    output.write_sheet(cup, tmp_path / "sheet.vtu")
    began = cast("Any", cup.fields["temperature"]).initial
    np.testing.assert_allclose(meshio.read(tmp_path / "sheet.vtu").point_data["temperature"], began, rtol=1e-12)


@jaxform.field
class Height(jaxform.Field):
    """The highest place of each node so far: it stays as it is where a node sticks."""

    rests = True
    floor: jax.Array = jaxform.parameter("m")

    def start(self, positions: jax.Array) -> jax.Array:
        return jnp.maximum(positions[:, 2], self.floor)

    def after(self, values: jax.Array, step: jaxform.Surroundings) -> jax.Array:
        return jnp.maximum(values, step.positions[2])


@jaxform.field
class Short(jaxform.Field):
    """Starts with three values whatever the mesh is."""

    def start(self, positions: jax.Array) -> jax.Array:
        return jnp.ones(3)


@pytest.mark.long
def test_a_field_that_rests_lets_what_sticks_be_skipped() -> None:
    plain = scenes.cup()
    scene = dataclasses.replace(plain, fields={"highest": Height(real(-1.0))})
    assert scene.packs_moving and not dataclasses.replace(scene, fields={"t": cooling(1.0)}).packs_moving
    result = jaxform.run(scene)
    highest, z = np.asarray(result.fields["highest"]), np.asarray(result.positions)[:, 2]
    stuck = np.asarray(result.contact_time) > 0
    np.testing.assert_allclose(highest[stuck], z[stuck], atol=2e-3)
    assert np.all(highest >= z - 1e-12)


def test_numbers_out_of_range_are_told(cup: jaxform.Scene) -> None:
    with pytest.raises(InputError, match=r"fields\.temperature\.air_rate.*must not be negative"):
        jaxform.replace(cup, {"fields.temperature.air_rate": -1.0})
    with pytest.raises(InputError, match=r"no such parameter.*fields\.temperature\.air"):
        jaxform.replace(cup, {"fields.temperature.aire": 1.0})


@pytest.mark.long
def test_a_traced_number_out_of_range_is_a_status(cup: jaxform.Scene) -> None:
    """The same for a law's number is in tests/materials/test_laws.py."""
    bad = jax.jit(lambda rate: jaxform.simulate(jaxform.replace(cup, {"fields.temperature.air_rate": rate})))(-1.0)
    assert int(bad.status) == Status.INPUT and np.all(np.isfinite(np.asarray(bad.fields["temperature"])))
    assert "air_rate" in jaxform.explain(bad)


@pytest.mark.parametrize(
    ("fields", "words"),
    [
        ({"temperature": cooling(np.ones(3))}, r"fields\.temperature\.initial.*one at each node"),
        ({"thickness": cooling(1.0)}, "cannot be a field's name"),
        ({"a b": cooling(1.0)}, "cannot be a field's name"),
        ({"contact_duration_plug": cooling(1.0)}, "cannot be a field's name"),
        ({"temperature": Short()}, r"fields\.temperature: starts with values of shape \(3,\)"),
        ({"temperature": 3.0}, r"fields\.temperature.*is not a field"),
        ({"temperature": cooling(-300.0)}, r"fields\.temperature\.initial.*at least -273\.15"),
    ],
)
def test_what_is_no_field_is_refused_in_words(fields: Any, words: str) -> None:
    plain = scenes.cup()
    with pytest.raises(InputError, match=words):
        jaxform.build_scene(
            parison=plain.parison, material=plain.material, pressure=plain.pressure, solver=plain.solver, fields=fields
        )
    with pytest.raises(InputError, match="is not a field"):
        jaxform.field(cast("Any", type("Nothing", (), {})))

"""Variables: whatever the unbounded numbers are, bounds, slopes and rates hold; the scene's own values come back."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxform
import optimize
from jaxform.io import files, scene_rewriting
from jaxform.mesh.grids import Profile
from optimize.variables import (
    apply_bounds,
    apply_log_bounds,
    apply_step_limit,
    invert_bounds,
    invert_log_bounds,
    invert_step_limit,
)
from tests import scenes
from tests.examples.cooling import Cooling

pytestmark = pytest.mark.quick

BOUNDS = (0.005, 0.02)


def _thickness(variable: optimize.ThicknessProfile | optimize.ThicknessField, free: np.ndarray) -> np.ndarray:
    return np.asarray(variable.changes(jnp.asarray(free))["parison.thickness"])


@pytest.mark.parametrize("into, back", [(apply_bounds, invert_bounds), (apply_log_bounds, invert_log_bounds)])
def test_bounds_hold_for_any_number_and_the_map_can_be_undone(into: Any, back: Any) -> None:
    free = jnp.asarray([-80.0, -1.0, 0.0, 2.0, 80.0])
    inside = into(free, (2.0, 5.0))
    assert np.all((inside >= 2.0) & (inside <= 5.0))
    values = np.array([2.1, 3.0, 4.9])
    np.testing.assert_allclose(into(jnp.asarray(back(values, (2.0, 5.0))), (2.0, 5.0)), values, rtol=1e-12)
    assert np.all(np.isfinite(back(np.array([2.0, 5.0]), (2.0, 5.0))))


@pytest.mark.parametrize("rising", [False, True])
@pytest.mark.parametrize("first", [None, 2.5])
def test_limits_between_neighbours_hold_and_the_map_can_be_undone(rising: bool, first: float | None) -> None:
    change = np.array([0.5, 0.2, 1.0, 0.4])
    count = 4 if first is not None else 5
    for seed in range(20):
        free = 4 * np.random.default_rng(seed).normal(size=count)
        values = np.asarray(apply_step_limit(jnp.asarray(free), (2.0, 5.0), change, first, rising))
        steps = np.diff(values if first is None else [first, *values])
        assert np.all((values >= 2.0) & (values <= 5.0)) and np.all(np.abs(steps) <= change + 1e-12)
        assert not rising or np.all(steps >= 0)
    calm = np.array([2.6, 2.7, 2.85, 3.2, 3.3])[:count]
    again = apply_step_limit(
        jnp.asarray(invert_step_limit(calm, (2.0, 5.0), change, first, rising)), (2.0, 5.0), change, first, rising
    )
    np.testing.assert_allclose(again, calm, rtol=1e-9)


def test_a_thickness_profile_is_piecewise_linear_and_starts_from_the_scene() -> None:
    scene = scenes.cup()
    variable = optimize.ThicknessProfile(scene, along="radius", bounds=BOUNDS, at=[0.0, 0.4, 1.0])
    np.testing.assert_allclose(_thickness(variable, variable.start), scene.parison.thickness, rtol=1e-9)
    free = jnp.asarray([-1.0, 2.0, 0.5])
    table = variable.document(free)["parison.thickness"]
    expected = Profile("radius", tuple(table["at"]), tuple(table["value"]))(np.asarray(scene.parison.positions))
    np.testing.assert_allclose(variable.changes(free)["parison.thickness"], expected, rtol=1e-12)


def test_a_cubic_profile_stays_in_bounds_and_slopes_and_is_smooth() -> None:
    scene = scenes.cup()
    variable = optimize.ThicknessProfile(
        scene, along="radius", bounds=BOUNDS, knots=7, interpolation="cubic", slope=0.02
    )
    np.testing.assert_allclose(_thickness(variable, variable.start), scene.parison.thickness, rtol=1e-6)
    place = np.linalg.norm(np.asarray(scene.parison.positions)[:, :2], axis=1)
    order = np.argsort(place)
    gaps = np.diff(place[order])
    wide = gaps > 1e-3
    for seed in range(10):
        values = _thickness(variable, 5 * np.random.default_rng(seed).normal(size=7))
        assert np.all((values >= BOUNDS[0]) & (values <= BOUNDS[1]))
        assert np.abs(np.diff(values[order])[wide] / gaps[wide]).max() <= 0.02 + 1e-9


@pytest.mark.parametrize("bounds", [BOUNDS, (0.009, 0.011)])
def test_more_knots_than_nodes_do_not_take_the_time_of_their_number_cubed(
    monkeypatch: pytest.MonkeyPatch, bounds: tuple[float, float]
) -> None:
    def dense(rows: np.ndarray, *_: Any, **__: Any) -> None:
        raise AssertionError(f"{rows.shape} is solved as a dense matrix")

    scene = scenes.cup()
    place = np.linalg.norm(np.asarray(scene.parison.positions)[:, :2], axis=1)
    wanted = 0.01 * (1.0 + 0.2 * np.sin(3.0 * place))
    monkeypatch.setattr(np.linalg, "lstsq", dense)
    variable = optimize.ThicknessProfile(scene, along="radius", bounds=bounds, knots=300)
    found = _thickness(variable, variable.nearest(wanted))
    np.testing.assert_allclose(found, np.clip(wanted, *bounds), rtol=1e-3 if bounds == BOUNDS else 0.02)


def test_zones_are_of_one_thickness_each() -> None:
    scene = scenes.cup()
    variable = optimize.ThicknessProfile(
        scene, along="x", bounds=BOUNDS, at=[0.0, 0.3, 0.6, 1.0], interpolation="zones"
    )
    place = np.asarray(scene.parison.positions)[:, 0]
    edges = [(-0.1, 0.3), (0.3, 0.6), (0.6, 2.0)]
    wanted = np.select([(place >= low) & (place < high) for low, high in edges], [0.006, 0.014, 0.009])
    np.testing.assert_allclose(_thickness(variable, variable.nearest(wanted)), wanted, rtol=1e-5)
    values = _thickness(variable, np.array([-1.0, 0.0, 1.0]))
    assert [np.ptp(values[(place >= low) & (place < high)]) for low, high in edges] == [0.0, 0.0, 0.0]
    assert len(np.unique(values)) == 3


def test_a_field_is_as_smooth_as_it_is_told_and_as_symmetric_as_the_scene() -> None:
    scene = scenes.cup()
    positions = np.asarray(scene.parison.positions)[:, :2]
    free = optimize.ThicknessField(scene, bounds=BOUNDS)
    assert free.start.size == len(positions)
    rough = []
    for smoothness in (0.4, 1.0):
        variable = optimize.ThicknessField(scene, bounds=BOUNDS, smoothness=smoothness)
        assert 1 < variable.start.size < len(positions)
        np.testing.assert_allclose(_thickness(variable, variable.start), scene.parison.thickness, rtol=1e-5)
        values = _thickness(variable, 5 * np.random.default_rng(1).normal(size=variable.start.size))
        assert np.all((values >= BOUNDS[0]) & (values <= BOUNDS[1]))
        apart = np.linalg.norm(positions[:, None] - positions[None], axis=2)
        near = (apart > 0) & (apart < 0.3)
        rough.append((np.abs(values[:, None] - values[None])[near] / apart[near]).max())
    # A jump from bound to bound within about a length is the steepest there can be.
    assert rough[1] < rough[0] / 1.5 and rough[1] < 2 * (BOUNDS[1] - BOUNDS[0]) / 1.0


def test_a_field_of_a_refined_scene_comes_back_from_its_file(tmp_path: Path) -> None:
    text = (
        '[parison]\nshape = "rectangle"\nsize = [0.3, 0.2]\nelements = 40\nthickness = 1e-3\n'
        '[material]\nmodel = "neo-hookean"\nc = 1e5\ndensity = 1e3\n[pressure]\ntime = [0.0]\nvalue = [1e3]\n'
        "[refinement]\nmax_level = 2\n[solver]\nend_time = 0.01\n"
    )
    (tmp_path / "scene.toml").write_text(text)
    document = files.read_scene(tmp_path / "scene.toml")
    scene = files.build(document)
    variable = optimize.ThicknessField(scene, bounds=(5e-4, 2e-3), smoothness=0.06)
    free = 2 * np.random.default_rng(3).normal(size=variable.start.size)
    scene_rewriting.write_scene(document, variable.document(jnp.asarray(free)), tmp_path)
    again = files.load(tmp_path / "best.toml")
    np.testing.assert_allclose(again.parison.thickness, _thickness(variable, free), rtol=1e-6)


@pytest.mark.parametrize("increasing", [False, True])
@pytest.mark.parametrize("rate", [None, 0.05])
def test_pressure_knots(increasing: bool, rate: float | None) -> None:
    scene = scenes.cup()
    variable = optimize.PressureKnots(scene, bounds=(-0.1, 0.4), increasing=increasing, rate=rate, held=True)
    start = np.asarray(variable.changes(jnp.asarray(variable.start))["pressure.value"])
    np.testing.assert_allclose(start, scene.pressure.value, atol=2e-3)
    for seed in range(20):
        free = 5 * np.random.default_rng(seed).normal(size=variable.start.size)
        value = np.asarray(variable.changes(jnp.asarray(free))["pressure.value"])
        assert np.all((value >= -0.1) & (value <= 0.4))
        assert not increasing or value[1] >= value[0]
        if rate is not None:
            # The history rises as the cube of time: three times as steep in the end as on average.
            assert 3 * abs(value[1] - value[0]) / 16.0 <= rate + 1e-12
        assert value[0] == 0.0  # held


def test_a_history_s_end_is_designed_and_keeps_the_rate() -> None:
    scene = scenes.cup()
    variable = optimize.PressureKnots(scene, bounds=(0.0, 0.4), rate=0.05, held=True, end_time=(4.0, 20.0))
    start = variable.changes(jnp.asarray(variable.start))
    np.testing.assert_allclose(start["pressure.time"], scene.pressure.time, rtol=1e-9)
    for seed in range(10):
        changes = variable.changes(jnp.asarray(5 * np.random.default_rng(seed).normal(size=variable.start.size)))
        time, value = (np.asarray(changes[f"pressure.{name}"]) for name in ("time", "value"))
        assert 4.0 <= time[-1] <= 20.0 and time[0] == 0.0
        assert 3 * np.abs(np.diff(value) / np.diff(time)).max() <= 0.05 + 1e-12
    slope = jax.jacobian(lambda free: variable.changes(free)["pressure.time"][-1])(jnp.asarray(variable.start))
    assert slope[-1] > 0 and not np.any(slope[:-1])


def test_a_scale_multiplies_a_number_of_the_scene() -> None:
    scene = scenes.cup()
    for path in ("material.c", "parison.thickness", "pressure.value", "solver.damping"):
        variable = optimize.Scale(scene, of=path, bounds=(0.5, 3.0))
        part, name = path.split(".")
        present = np.asarray(getattr(getattr(scene, part), name))
        np.testing.assert_allclose(variable.changes(jnp.asarray(variable.start))[path], present, rtol=1e-12)
        free = jnp.asarray([0.7])
        factor = float(apply_bounds(free, (0.5, 3.0))[0])
        np.testing.assert_allclose(variable.changes(free)[path], factor * present, rtol=1e-12)
        np.testing.assert_allclose(
            variable.document(free)[path], factor * present if name == "value" else factor * present.flat[0]
        )
    for path, words in (
        ("material.alpha", "no such parameter"),
        ("mold", "choose one of"),
        ("pressure.time", "is a time"),
    ):
        with pytest.raises(jaxform.InputError, match=words):
            optimize.Scale(scene, of=path, bounds=(0.5, 3.0))


def test_a_scale_multiplies_a_number_of_a_field() -> None:
    plain, numbers = scenes.cup(), (150.0, 0.02, 0.3, 20.0, 10.0)
    parts: Any = {"parison": plain.parison, "material": plain.material, "pressure": plain.pressure}
    fields: Any = {"temperature": Cooling(*map(scenes.real, numbers))}
    scene = jaxform.build_scene(solver=plain.solver, mold=plain.mold, fields=fields, **parts)
    variable = optimize.Scale(scene, of="fields.temperature.mold_rate", bounds=(0.5, 3.0))
    found = variable.changes(jnp.asarray(variable.start))["fields.temperature.mold_rate"]
    np.testing.assert_allclose(found, 0.3, rtol=1e-12)


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda s: optimize.ThicknessProfile(s, along="radius", bounds=(0.02, 0.01), knots=3), "bounds"),
        (lambda s: optimize.ThicknessProfile(s, along="radius", bounds=BOUNDS), "knots"),
        (
            lambda s: optimize.ThicknessProfile(s, along="radius", bounds=BOUNDS, knots=3, interpolation="cubic"),
            "at least 4",
        ),
        (
            lambda s: optimize.ThicknessProfile(s, along="x", bounds=BOUNDS, knots=3, interpolation="zones", slope=1.0),
            "slope",
        ),
        (lambda s: optimize.ThicknessField(s, bounds=BOUNDS, smoothness=-1.0), "smoothness"),
        (lambda s: optimize.PressureKnots(s, bounds=(0.1, 0.4), rate=1.0, held=True), "first value"),
        (lambda s: optimize.PressureKnots(s, bounds=(0.1, 0.4), held=True), "first value"),
        (lambda s: optimize.PressureKnots(s, bounds=(0.0, 0.4), rate=-1.0), "rate"),
        (lambda s: optimize.PressureKnots(s, bounds=(0.0, 0.4), end_time=(1.0, 99.0)), "end_time"),
        (lambda s: optimize.Scale(s, of="material.c", bounds=(0.0, 1.0)), "bounds"),
    ],
)
def test_what_leaves_no_room_is_refused(make: object, words: str) -> None:
    with pytest.raises(jaxform.InputError, match=words):
        make(scenes.cup())  # pyright: ignore

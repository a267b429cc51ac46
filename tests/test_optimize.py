"""Inverse design: variables stay in their bounds, the objective's gradient is right, the search finds what is there."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxform
import optimize
from jaxform.profiles import Profile
from optimize import objectives, solvers
from optimize.variables import bounded, unbounded
from tests import scenes


def test_bounds_hold_for_any_number_and_the_map_can_be_undone() -> None:
    free = jnp.asarray([-80.0, -1.0, 0.0, 2.0, 80.0])
    inside = bounded(free, (2.0, 5.0))
    assert np.all((inside >= 2.0) & (inside <= 5.0))
    values = np.array([2.1, 3.0, 4.9])
    np.testing.assert_allclose(bounded(jnp.asarray(unbounded(values, (2.0, 5.0))), (2.0, 5.0)), values, rtol=1e-12)


def test_a_thickness_profile_is_piecewise_linear_and_starts_from_the_scene() -> None:
    scene = scenes.cup()
    variable = optimize.ThicknessProfile(scene, along="radius", bounds=(0.005, 0.02), at=[0.0, 0.4, 1.0])
    start = variable.changes(jnp.asarray(variable.start))["parison.thickness"]
    np.testing.assert_allclose(start, scene.parison.thickness, rtol=1e-9)
    free = jnp.asarray([-1.0, 2.0, 0.5])
    table = variable.document(free)["parison.thickness"]
    expected = Profile("radius", tuple(table["at"]), tuple(table["value"]))(np.asarray(scene.parison.positions))
    np.testing.assert_allclose(variable.changes(free)["parison.thickness"], expected, rtol=1e-12)


@pytest.mark.parametrize("increasing", [False, True])
def test_pressure_knots(increasing: bool) -> None:
    scene = scenes.cup()
    variable = optimize.PressureKnots(scene, bounds=(-0.1, 0.4), increasing=increasing)
    start = np.asarray(variable.changes(jnp.asarray(variable.start))["pressure.value"])
    np.testing.assert_allclose(start, scene.pressure.value, atol=2e-3)
    for seed in range(20):
        free = 5 * np.random.default_rng(seed).normal(size=2)
        value = np.asarray(variable.changes(jnp.asarray(free))["pressure.value"])
        assert np.all((value >= -0.1) & (value <= 0.4))
        assert not increasing or value[1] >= value[0]


def test_targets_in_all_their_forms() -> None:
    scene = scenes.cup()
    result = jaxform.run(scene)
    profile = Profile("radius", (0.0, 1.0), (0.004, 0.008))
    start, end = (np.asarray(x) for x in (scene.parison.positions, result.positions))
    initial = objectives.Target(scene, profile).wanted(result)
    final = objectives.Target(scene, profile, initial=False).wanted(result)
    np.testing.assert_allclose(initial, profile(start), rtol=1e-12)
    np.testing.assert_allclose(final, profile(end), rtol=1e-12)
    assert np.abs(np.asarray(initial) - np.asarray(final)).max() > 1e-4
    own = objectives.Target(scene, np.asarray(result.thickness))
    assert float(own(scene, result)) == 0.0
    np.testing.assert_allclose(float(objectives.Target(scene, result.thickness / 1.1)(scene, result)), 0.01, rtol=1e-9)


@pytest.mark.parametrize("target", [-1.0, 0.0, np.nan, np.ones(3)])
def test_bad_targets(target: float | np.ndarray) -> None:
    with pytest.raises(jaxform.InputError, match=r"objective\.thickness"):
        objectives.Target(scenes.cup(), target)


def _study(**options: float) -> optimize.Study:
    """The wall that a known profile makes, sought from a uniform sheet."""
    scene = scenes.cup()
    variable = optimize.ThicknessProfile(scene, along="radius", bounds=(0.004, 0.03), knots=4)
    hidden = variable.changes(jnp.asarray(unbounded(np.array([0.015, 0.012, 0.01, 0.008]), (0.004, 0.03))))
    wall = jaxform.run(jaxform.replace(scene, hidden)).thickness
    return optimize.Study(scene, (variable,), optimize.Target(scene, np.asarray(wall)), **options)  # pyright: ignore


def test_the_search_recovers_a_known_profile() -> None:
    rows: list[dict[str, float]] = []
    design = optimize.solve(_study(iterations=25, tolerance=1e-6), rows.append)
    assert design.history == rows
    best = min(rows, key=lambda row: row["objective"])
    assert rows[0]["thickness_rms_error"] > 0.1
    assert best["thickness_rms_error"] < 5e-3
    found = design.changes["parison.thickness"]["value"]
    np.testing.assert_allclose(found, [0.015, 0.012, 0.01, 0.008], rtol=0.03)
    np.testing.assert_allclose(float(design.result.mass), best["mass"], rtol=1e-9)


def test_the_study_s_gradient_equals_central_differences() -> None:
    search = solvers.Search(_study(), None, 1.0)
    free = np.array([0.3, -0.2, 0.1, -0.4])
    slope = search(free).gradient
    for k, direction in enumerate(np.eye(4)):
        differences = []
        for size in (1e-4, 1e-5, 1e-6):
            differences.append(
                (search(free + size * direction).value - search(free - size * direction).value) / 2 / size
            )
        assert min(abs(difference / slope[k] - 1) for difference in differences) < 1e-5


def test_a_failed_simulation_is_a_step_to_shorten() -> None:
    """A search that is told that the far half of its first step fails ends with a better design all the same."""
    study = _study(iterations=3)
    search = solvers.Search(study, None, 1.0)
    first = search(study.variables[0].start)
    honest, calls = search._compute, []

    def failing(free: jax.Array, scene: jaxform.Scene, schedule: None) -> object:
        (value, report), gradient = honest(free, scene, schedule)
        calls.append(len(calls))
        if len(calls) == 2:
            value = jnp.asarray(jnp.nan)
        return (value, report), gradient

    search._compute = failing  # pyright: ignore
    message = solvers._lbfgs(search, study)
    assert "iterations" in message
    assert np.inf in [row["objective"] for row in search.history]
    assert search.best is not None and search.best.value < 0.5 * first.value


def test_an_interrupted_search_keeps_its_best_design() -> None:
    def interrupt(row: dict[str, float]) -> None:
        if row["evaluation"] == 2:
            raise KeyboardInterrupt

    design = optimize.solve(_study(iterations=25), interrupt)
    assert design.message == "interrupted"
    assert len(design.history) == 3
    np.testing.assert_allclose(float(design.result.mass), min(design.history, key=lambda r: r["objective"])["mass"])


def test_a_scene_that_fails_is_refused() -> None:
    with pytest.raises(jaxform.InputError, match="fails"):
        import dataclasses

        study = _study()
        tables = dataclasses.replace(study.scene.tables, window_count=2)
        optimize.solve(dataclasses.replace(study, scene=dataclasses.replace(study.scene, tables=tables)))

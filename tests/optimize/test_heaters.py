"""Heater zones: view factors, bounds, the start, files, and a study that evens the wall."""

from __future__ import annotations

import dataclasses
import functools
from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest

import jaxform
import optimize
from jaxform.io import plots
from optimize.search import Search
from optimize.sensitivity_check import numbers_at_bounds
from tests import scenes
from tests.scenes import real


@functools.cache
def _scene(temperature: float | None = 140.0) -> jaxform.Scene:
    plain = scenes.cup()
    warm = None if temperature is None else jnp.full_like(plain.parison.thickness, temperature)
    shift = None if temperature is None else jaxform.ArrheniusStiffness(real(140.0), real(60e3))
    return jaxform.build_scene(
        material=jaxform.NeoHookean(real(1.0), real(1.0), shift=shift),
        parison=dataclasses.replace(plain.parison, temperature=warm),
        pressure=jaxform.make_pressure([0.0, 16.0], [0.0, 0.3]),
        solver=plain.solver,
        mold=plain.mold,
        fill=False,
    )


def _field(variable: optimize.HeaterZones, free: Any) -> np.ndarray:
    return np.asarray(variable.changes(jnp.asarray(free))[variable.of])


def test_a_node_sees_the_heaters_above_it_the_most() -> None:
    scene = _scene()
    x, y, _ = np.asarray(scene.parison.positions).T
    for distance, share in ((0.0, 0.999), (0.05, 0.85), (1.0, 0.26)):
        variable = optimize.HeaterZones(scene, grid=(2, 2), distance=distance, bounds=(100.0, 180.0))
        np.testing.assert_allclose(_field(variable, variable.start), 140.0, rtol=1e-4)
        one = _field(variable, np.array([20.0, -20.0, -20.0, -20.0]))
        below = (x < 0.3) & (y < 0.3)
        far = (x > 0.7) | (y > 0.7)
        assert np.all((one > 100.0 - 1e-6) & (one < 180.0 + 1e-6))
        assert one[below].mean() > 100.0 + 80.0 * share and one[far].mean() < one[below].mean()
        if distance == 0.0:
            assert set(np.round(one, 3)) == {100.0, 180.0}


def test_the_heaters_of_a_part_are_images_of_one_another() -> None:
    """A field of a quarter is level across its cuts: to the second order, as an even function is."""
    variable = optimize.HeaterZones(_scene(), grid=(3, 3), distance=0.3, bounds=(100.0, 180.0))
    values = _field(variable, np.random.default_rng(0).normal(size=9))
    x, y, _ = np.asarray(_scene().parison.positions).T
    line = np.flatnonzero(np.abs(y) < 1e-9)
    order = line[np.argsort(x[line])]
    first = values[order[1]] - values[order[0]]
    whole = np.abs(np.diff(values[order])).max()
    assert abs(first) < 0.6 * whole


def test_of_a_number_of_the_law() -> None:
    variable = optimize.HeaterZones(_scene(None), grid=(2, 3), distance=0.1, bounds=(0.5, 2.0), of="material.c")
    np.testing.assert_allclose(_field(variable, variable.start), 1.0, rtol=1e-3)
    assert variable.document(jnp.asarray(variable.start))["material.c"].shape == (len(_scene().parison.positions),)
    search = Search(optimize.Study(_scene(None), (variable,), optimize.Uniform()), None, 1.0)
    (row,) = numbers_at_bounds(search, search.reach)
    assert row["kind"] == "heater-zones" and row["upper"] == list(range(6)) and row["unmoved"] == []


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"grid": (1, 1)}, "variable.grid"),
        ({"grid": (30, 30)}, "variable.grid"),
        ({"distance": -1.0}, "variable.distance = -1.0"),
        ({"bounds": (160.0, 120.0)}, "variable.bounds"),
        ({"of": "solver.damping"}, "variable.of = 'solver.damping'.*does not vary"),
        ({"of": "material.hardness"}, "material.hardness.*no such parameter"),
    ],
)
def test_what_is_wrong_is_refused_in_words(options: dict[str, Any], words: str) -> None:
    given = {"grid": (2, 2), "distance": 0.1, "bounds": (120.0, 160.0)} | options
    with pytest.raises(jaxform.InputError, match=words):
        optimize.HeaterZones(_scene(), **given)
    with pytest.raises(jaxform.InputError, match="the sheet has no temperature"):
        optimize.HeaterZones(_scene(None), grid=(2, 2), distance=0.1, bounds=(1.0, 2.0))


@pytest.mark.long
def test_heaters_even_the_wall(tmp_path: Any) -> None:
    """Cool where the cup is thin, in the middle; and the picture of a study maps the temperature."""
    scene = _scene()
    variable = optimize.HeaterZones(scene, grid=(3, 3), distance=0.1, bounds=(120.0, 160.0))
    cool = np.array([-3.0, -1.0, 2.0, -1.0, 0.0, 2.0, 2.0, 2.0, 2.0])
    design = jaxform.replace(scene, variable.changes(jnp.asarray(cool)))
    before, after = (scene, jaxform.run(scene)), (design, jaxform.run(design))
    variation = [jaxform.summarize(result, own)["thickness"]["cv"] for own, result in (before, after)]
    assert variation[1] < 0.95 * variation[0]
    assert plots._designed_field(scene, design) == ("parison.temperature", "temperature of the sheet [°C]")
    plots.design_picture(tmp_path / "design.png", before, after)
    assert (tmp_path / "design.png").stat().st_size > 20_000

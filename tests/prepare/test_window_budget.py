"""Planned numbers of windows: for laws that stiffen steeply no more than a few times what they take."""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxform
from jaxform import molds, shapes
from jaxform.materials import Law
from jaxform.model.scene import Scene
from jaxform.model.tables import LONG_WINDOW, SHORT_WINDOW
from jaxform.prepare import planning
from tests import scenes
from tests.scenes import real


@jaxform.law
class Fung(jaxform.Law):
    """An exponential law, as tissue and filled rubber have it."""

    c: jax.Array = jaxform.parameter("Pa", above=0.0)
    b: jax.Array = jaxform.parameter("", above=0.0)
    density: jax.Array = jaxform.parameter("kg/m^3", above=0.0)

    def energy(self, i1: jax.Array, i2: jax.Array) -> jax.Array:
        return self.c / (2 * self.b) * jnp.expm1(self.b * (i1 - 3.0))


def balloon(law: Law, pressure: float = 4000.0) -> Scene:
    sheet = shapes.sphere(radius=0.05, elements=128)
    return jaxform.build_scene(
        parison=jaxform.make_parison(sheet.positions, sheet.triangles, 1e-3, sheet.clamped, sheet.fixed),
        material=law,
        pressure=jaxform.make_pressure([0.0, 0.1], [0.0, pressure], "cubic-ramp"),
        solver=jaxform.make_solver(end_time=0.3, damping=100.0),
    )


def fung(b: float, c: float = 1e5) -> Law:
    return Fung(real(c), real(b), real(1000.0))


def cup(j_max: float, end_time: float = 200.0, damping: float = 2.0) -> Scene:
    """Gent's law into a cup, in a time that needs more windows than there is always room for."""
    sheet = shapes.disc(radius=1.0, elements=200, symmetry="quarter")
    mold = molds.revolved(profile=[[0.0, 0.5], [0.55, 0.5], [1.0, 0.0]], segments=48)
    return jaxform.build_scene(
        parison=jaxform.make_parison(sheet.positions, sheet.triangles, 0.01, sheet.clamped, sheet.fixed),
        material=jaxform.Gent(mu=real(2.0), j_max=real(j_max), density=real(1.0)),
        pressure=jaxform.make_pressure([0.0, 0.8 * end_time], [0.0, 0.2], "cubic-ramp"),
        solver=jaxform.make_solver(end_time=end_time, damping=damping),
        mold=jaxform.make_mold(mold.vertices, mold.triangles),
    )


@pytest.mark.long
@pytest.mark.parametrize("b", scenes.short_first([0.1, 0.5]))
def test_an_exponential_law_is_planned_for_the_stretch_that_it_will_meet(b: float) -> None:
    """It was refused, for the steps that a stretch of 6 would ask for."""
    scene = balloon(fung(b))
    result = jaxform.simulate(scene)
    assert int(result.status) == 0
    reached = float(jnp.max(result.stretches))
    expected = planning.expected_stretch(scene.parison, scene.material, np.array([4000.0]), None)
    assert reached < expected < 1.5 * reached
    # No more than all scenes have room for.
    assert scene.tables.window_count <= 128 + 32


def test_the_sheet_bears_the_expected_pressure_at_the_expected_stretch() -> None:
    """Twice P = h0 W'(s) / (r s^2) of a sphere; neo-Hookean spheres bear none beyond their limit point."""
    law, parison = fung(0.2), balloon(fung(0.2)).parison
    stretch = planning.expected_stretch(parison, law, np.array([0.0, -4000.0]), None)
    slope = jax.grad(lambda s: law.energy(2 * s**2 + s**-4, jnp.zeros(())))(stretch)
    np.testing.assert_allclose(1e-3 * slope / (0.05 * stretch**2), 2 * 4000.0, rtol=0.25)
    assert planning.expected_stretch(parison, scenes.mooney(0.0, 1e5), np.array([4000.0]), None) == 6.0


@pytest.mark.parametrize("j_max", scenes.short_first([25.0, 60.0]))
def test_a_law_with_a_limit_has_room_for_a_few_times_the_windows_that_it_takes(j_max: float) -> None:
    """It had room for hundreds of times as many, which reverse derivatives pay for; neo-Hookean: four times."""
    scene = cup(j_max)
    result = jaxform.run(scene)
    assert int(result.status) == 0 and np.mean(np.asarray(result.contact_time) > 0) > 0.3
    steps = int(np.sum(np.asarray(result.schedule.counts)))  # pyright: ignore[reportOptionalMemberAccess]
    assert SHORT_WINDOW * scene.tables.window_count < 6 * steps
    assert planning.stiffens_steeply(scene.material) and scene.tables.longest_window == LONG_WINDOW


def test_laws_that_do_not_stiffen_steeply_are_planned_for_as_before() -> None:
    for law in (scenes.mooney(0.0), scenes.mooney(0.5), jaxform.Yeoh(real(1.0), real(0.0), real(0.0), real(1.0))):
        assert not planning.stiffens_steeply(law)
    tables = scenes.cup().tables
    assert int(tables.planned) == np.iinfo(np.int32).max


@pytest.mark.long
def test_windows_become_longer_where_fewer_were_planned_than_short_ones_would_take() -> None:
    scene = cup(60.0, 60.0, damping=0.2)
    plain: Any = jaxform.run(scene)
    steps = int(plain.steps)
    least = 2 * steps // LONG_WINDOW
    hasty = dataclasses.replace(scene.tables, planned=np.int32(least), longest_window=np.int32(LONG_WINDOW))
    result = jaxform.run(dataclasses.replace(scene, tables=hasty))
    assert int(result.status) == 0 and int(result.windows) < 0.6 * int(plain.windows)
    counts = np.asarray(result.schedule.counts)  # pyright: ignore[reportOptionalMemberAccess]
    assert np.sum(counts == LONG_WINDOW) > 0.5 * np.sum(counts > 0)
    np.testing.assert_allclose(result.thickness, plain.thickness, rtol=0.02)

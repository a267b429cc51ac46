"""Gravity and pre-stretch: sag against the membrane solution, work, gradients, and input that is refused."""

from __future__ import annotations

import functools
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxform
from jaxform import shapes
from tests import scenes


def _sheet(stretch: float, elements: int, symmetry: Any = "quarter", frame: float = 1.0) -> jaxform.Parison:
    """A disc that has the radius of the frame once it is stretched."""
    sheet = shapes.disc(radius=frame / stretch, elements=elements, symmetry=symmetry)
    stretches = None if stretch == 1.0 else [stretch, stretch]
    return jaxform.make_parison(
        sheet.positions, sheet.triangles, 0.01, sheet.clamped, sheet.fixed, pre_stretch=stretches
    )


def _sag(gravity: float, stretch: float = 1.0, elements: int = 200, **parts: Any) -> jaxform.Scene:
    """A neo-Hookean sheet in a round frame of radius 1 that hangs by its weight; units of rho g a / c."""
    given = {"pressure": jaxform.make_pressure([0.0], [0.0]), "material": scenes.mooney(0.0)} | parts
    return jaxform.build_scene(
        parison=_sheet(stretch, elements),
        solver=jaxform.make_solver(end_time=40.0, damping=1.0, gravity=[0.0, 0.0, -gravity]),
        **given,
    )


# Pole height, and thickness over the initial one at pole and rim. G = 0.5 and, stretched by 1.05, G = 0.2:
# r T1 sin(psi) = G x^2 / 2 along the meridian, integrated with two tolerances.
@pytest.mark.parametrize(
    ("gravity", "stretch", "expected"),
    scenes.short_first(
        [(0.2, 1.05, (0.083556996, 0.89983906, 0.90163749)), (0.5, 1.0, (0.276717745, 0.91673704, 0.93908200))]
    ),
)
def test_sheet_sags_as_the_membrane_solution(gravity: float, stretch: float, expected: tuple[float, ...]) -> None:
    result = jaxform.run(_sag(gravity, stretch, elements=400))
    positions, thickness = np.asarray(result.positions), np.asarray(result.thickness) / 0.01
    radius = np.linalg.norm(positions[:, :2], axis=1)
    pole = int(np.argmin(radius))
    found = -positions[pole, 2], thickness[pole], thickness[radius > 0.999].mean()
    np.testing.assert_allclose(found, expected, rtol=5e-3)
    assert int(result.status) == 0
    energy = result.energy
    assert float(energy.balance_error) < 2e-3
    # All that gravity and the frame did is strain, or went into damping.
    assert float(energy.gravity_work) > 0.0 == float(energy.external_work)
    assert (float(energy.pre_stretch_work) > 0.0) == (stretch > 1.0)


def test_a_pre_stretched_sheet_without_loads_stays_as_it_is() -> None:
    scene = jaxform.build_scene(
        parison=_sheet(1.3, 60),
        material=scenes.mooney(0.1),
        pressure=jaxform.make_pressure([0.0], [0.0]),
        solver=jaxform.make_solver(end_time=1.0, damping=1.0),
    )
    result = jaxform.run(scene)
    np.testing.assert_allclose(result.positions, scene.parison.positions, atol=1e-12)
    np.testing.assert_allclose(result.element_thickness, 0.01 / 1.3**2, rtol=1e-12)
    np.testing.assert_allclose(result.stretches, 1.3, atol=1e-7)  # of equal ones, to the root of rounding
    np.testing.assert_allclose(result.energy.strain, result.energy.pre_stretch_work, rtol=1e-12)
    assert int(result.status) == 0


@pytest.mark.long
def test_pre_stretch_is_that_of_a_refined_sheet_too() -> None:
    limits = jaxform.make_refinement(angle=1.5, interval=64, max_level=2, elements=400)
    plain, refined = (jaxform.run(_sag(2.0, 1.1, 60, refinement=each)) for each in (None, limits))
    assert len(refined.triangles[np.asarray(refined.used)]) > len(plain.triangles)
    np.testing.assert_allclose(refined.mass, plain.mass, rtol=1e-12)
    np.testing.assert_allclose(refined.energy.pre_stretch_work, plain.energy.pre_stretch_work, rtol=1e-12)
    low, fine = (float(np.asarray(result.positions)[:, 2].min()) for result in (plain, refined))
    np.testing.assert_allclose(low, fine, rtol=0.02)
    assert float(refined.energy.balance_error) < 5e-3


@functools.cache
def _vacuum_scene(damping: float | None) -> jaxform.Scene:
    """A pre-stretched sheet that gravity and a vacuum draw into a cup below it."""
    mold = jaxform.molds.revolved(profile=[[0.0, -0.35], [0.55, -0.35], [1.0, 0.0]], segments=24)
    return jaxform.build_scene(
        parison=_sheet(1.02, 60),
        material=scenes.mooney(0.1),
        pressure=jaxform.make_pressure([0.0, 4.0], [0.0, -0.02]),
        solver=jaxform.make_solver(end_time=6.0, damping=damping, gravity=[0.0, 0.0, -0.5]),
        mold=jaxform.make_mold(mold.vertices, mold.triangles, mold.dropped),
        fill=False,
    )


@pytest.mark.long
@pytest.mark.parametrize("damping", [None, 1.0])
def test_gradients_with_gravity_are_those_of_differences(damping: float | None) -> None:
    scene = _vacuum_scene(damping)
    base = jaxform.run(scene)
    assert int(np.asarray(base.stuck).sum()) > 20, "it has to meet the mold"
    weight = jnp.asarray(np.random.default_rng(0).normal(size=base.thickness.shape))

    @functools.partial(jax.jit, static_argnames="adjoint")
    @functools.partial(jax.value_and_grad, has_aux=True)
    def both(numbers: jax.Array, adjoint: jaxform.Adjoint | None = None) -> tuple[jax.Array, jaxform.Result]:
        scale, c, density, down, aside = numbers
        changes = {"parison.thickness": scene.parison.thickness * scale, "material.c": c, "material.density": density}
        changes["solver.gravity"] = jnp.stack([aside, jnp.zeros_like(aside), down])
        result = jaxform.simulate(jaxform.replace(scene, changes), schedule=base.schedule, adjoint=adjoint)
        energy = result.energy
        works = energy.gravity_work + energy.strain + 0.1 * energy.pre_stretch_work
        return jnp.sum(weight * (100.0 * result.thickness + result.positions[:, 2])) + 1e4 * works, result

    numbers = jnp.asarray([1.0, 1.0, 1.0, -0.5, 0.0])
    (_, result), found = both(numbers)
    np.testing.assert_allclose(result.positions, base.positions, atol=1e-12)
    steps = 1e-6 * jnp.eye(len(numbers))
    differences = [(both(numbers + step)[0][0] - both(numbers - step)[0][0]) / 2e-6 for step in steps]
    np.testing.assert_allclose(found, differences, atol=1e-7 * float(jnp.abs(found).max()))
    if damping is not None:
        np.testing.assert_allclose(found, both(numbers, jaxform.Checkpointed())[1], rtol=1e-11)


_SAG = """
[parison]
shape = "disc"
radius = 0.15
elements = 100
thickness = 2.0e-3
pre_stretch = [1.02, 1.02]
[material]
model = "neo-hookean"
c = 2.0e4
density = 1000.0
[solver]
end_time = 0.5
damping = 15.0
gravity = [0.0, 0.0, -9.81]
"""


def test_scene_file_needs_no_pressure_where_gravity_acts(tmp_path: Path) -> None:
    file = tmp_path / "sag.toml"
    file.write_text(_SAG)
    scene = jaxform.load(file)
    radius = np.linalg.norm(np.asarray(scene.parison.positions), axis=1).max()
    np.testing.assert_allclose(radius, 0.15 * 1.02, rtol=0.02)
    np.testing.assert_allclose(scene.pushes(), -1000.0 * 2e-3 * 9.81)


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("gravity = [0.0, 0.0, -9.81]", "", "nothing else moves the sheet"),
        ("[0.0, 0.0, -9.81]", "[0.0, -9.81]", "solver.gravity"),
        ("[1.02, 1.02]", "[0.9, 1.0]", "parison.pre_stretch"),
        ("[1.02, 1.02]", "[1.02]", "parison.pre_stretch"),
        ('"disc"', '"sphere"', "parison.pre_stretch"),
        ("[solver]", "[refinement]\nmax_level = 2\nmass_scaling_levels = 1\n[solver]", "mass scaling"),
    ],
)
def test_bad_gravity_and_pre_stretch_are_refused(tmp_path: Path, old: str, new: str, words: str) -> None:
    file = tmp_path / "sag.toml"
    file.write_text(_SAG.replace(old, new))
    with pytest.raises(jaxform.InputError, match=words):
        jaxform.load(file)


def test_a_sheet_that_is_not_flat_has_no_pre_stretch() -> None:
    sheet = shapes.sphere(radius=1.0, elements=60)
    with pytest.raises(jaxform.InputError, match="not flat"):
        jaxform.make_parison(sheet.positions, sheet.triangles, 0.01, sheet.clamped, pre_stretch=[1.1, 1.1])

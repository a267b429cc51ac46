"""Rims that are not clamped: the work of the pressure is its force times the way, whatever the rim does."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxform
from jaxform import molds, shapes
from jaxform.model.scene import Scene
from jaxform.results.result import Result
from tests import scenes
from tests.scenes import real

RUBBER = jaxform.NeoHookean(real(1.0), real(1.0))


def strip(shift: float = 0.0, **parts: Any) -> Scene:
    """Half a strip of length 2 and width 0.2 under pressure, clamped at its ends alone."""
    sheet = shapes.rectangle(size=[1.0, 0.2], elements=40)
    x = sheet.positions[:, 0]
    clamped, fixed = x > 1.0 - 1e-12, np.zeros((len(x), 3), bool)
    fixed[:, 0] = x < 1e-12
    if shift:
        fixed, clamped = np.zeros_like(fixed), clamped | (x < 1e-12)
    positions = sheet.positions + shift * np.array([0.3, -1.0, 2.0])
    given: dict[str, Any] = {"end_time": 20.0, "damping": 1.0} | parts.pop("solver", {})
    return jaxform.build_scene(
        parison=jaxform.make_parison(positions, sheet.triangles, 0.01, clamped, fixed),
        material=RUBBER,
        pressure=jaxform.make_pressure([0.0, 15.0], [0.0, 0.02]),
        solver=jaxform.make_solver(**given),
        **parts,
    )


def ring(rows: int, around: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A quarter of a tube of radius 1 and length 0.3: positions, triangles and azimuths."""
    angle, height = np.meshgrid(np.linspace(0.0, np.pi / 2, around + 1), np.linspace(0.0, 0.3, rows + 1))
    positions = np.stack([np.cos(angle), np.sin(angle), height], -1).reshape(-1, 3)
    positions[np.abs(positions) < 1e-12] = 0.0
    corner = (np.arange(rows)[:, None] * (around + 1) + np.arange(around)).ravel()
    across = corner + around + 2
    first, second = np.stack([corner, corner + 1, across], 1), np.stack([corner, across, across - 1], 1)
    return positions, np.concatenate([first, second]), angle.ravel()


def tube(ends: str, pressure: float, **options: Any) -> Scene:
    """A quarter of a tube whose ends stay in their planes, or whose upper end is free."""
    positions, triangles, _ = ring(2, 12)
    fixed = positions == 0.0
    if ends == "between planes":
        fixed[:, 2] |= positions[:, 2] > 0.3 - 1e-12
    return jaxform.build_scene(
        parison=jaxform.make_parison(positions, triangles, 0.01, np.zeros(len(positions), bool), fixed),
        material=RUBBER,
        pressure=jaxform.make_pressure([0.0, 60.0], [0.0, 0.01 * pressure]),
        solver=jaxform.make_solver(end_time=80.0, damping=1.0),
        **options,
    )


def balance(result: Result) -> float:
    assert int(result.status) == 0 and int(result.shortened) == 0, jaxform.explain(result)
    return float(result.energy.balance_error)


def test_a_strip_with_free_edges_balances_and_where_the_origin_is_does_not_matter() -> None:
    """A cone's volume has 2/3 of what a cylinder's surface sweeps: the run ended "unstable"."""
    plain = jaxform.run(strip())
    assert balance(plain) < 1e-3
    near, far = (jaxform.run(strip(shift)) for shift in (1e-9, 0.7))
    assert balance(far) < 1e-3
    np.testing.assert_allclose(far.energy.external_work, near.energy.external_work, rtol=1e-6)


@pytest.mark.parametrize("ends", scenes.short_first(["between planes", "free"]))
def test_a_tube_with_open_ends_does_the_work_of_the_exact_solution(ends: str) -> None:
    """A ring of free length or not: P = 2 c h0 (...) / r0, whose work is the strain energy of the exact stretch."""
    pressure = 0.8
    result = jaxform.run(tube(ends, pressure))
    assert balance(result) < 1e-3
    # Plane strain: 1 - s**-4 = p / 2. Free ends: along the axis the stretch is s**-1/2, and s**0.5 (1 - s**-3) = p / 2.
    lengths = np.linspace(1.0, 2.0, 100_001)
    found = 1 - lengths**-4 if ends == "between planes" else lengths**0.5 * (1 - lengths**-3)
    stretch = lengths[np.argmin(np.abs(found[:50_000] - pressure / 2))]
    radius = np.linalg.norm(np.asarray(result.positions)[:, :2], axis=1)
    np.testing.assert_allclose(radius.mean(), stretch, rtol=5e-3)
    axial = 1.0 if ends == "between planes" else stretch**-0.5
    energy = (stretch**2 + axial**2 + (stretch * axial) ** -2 - 3) * 0.01 * 0.3 * np.pi / 2
    # Slowly: what is lost by damping is small, and counted.
    work = float(result.energy.external_work - result.energy.damping_loss)
    np.testing.assert_allclose(work, energy, rtol=2e-2)


@pytest.mark.long
def test_a_refined_sheet_with_a_free_edge_balances() -> None:
    refinement = jaxform.make_refinement(angle=2.0, interval=64, max_level=2, elements=200)
    result = jaxform.run(strip(refinement=refinement))
    assert int(jnp.sum(result.used)) > 40
    assert balance(result) < 5e-3


@pytest.fixture(scope="module")
def floor_scene() -> Scene:
    """The strip onto a floor."""
    floor = molds.revolved(profile=[[0.0, 0.2], [3.0, 0.2]], segments=24)
    return strip(mold=jaxform.make_mold(floor.vertices, floor.triangles), solver={"end_time": 18.0})


@pytest.mark.long
def test_the_ways_to_go_back_agree_and_equal_differences(floor_scene: Scene) -> None:
    run = jaxform.run(floor_scene)
    assert np.any(np.asarray(run.contact_time) > 0) and balance(run) < 1e-2

    def figure(numbers: dict[str, jax.Array], adjoint: Any) -> jax.Array:
        result = jaxform.simulate(jaxform.replace(floor_scene, numbers), schedule=run.schedule, adjoint=adjoint)
        return 1e3 * result.energy.external_work + jnp.mean(jnp.square(result.positions))

    weights = 1.0 + np.arange(floor_scene.parison.thickness.size) / floor_scene.parison.thickness.size
    at = {"pressure.value": floor_scene.pressure.value, "parison.thickness": floor_scene.parison.thickness}
    at["material.c"] = jnp.asarray(floor_scene.material.c)  # pyright: ignore[reportAttributeAccessIssue]
    at["solver.damping"] = jnp.asarray(floor_scene.solver.damping)
    both_ways = [jax.jit(jax.value_and_grad(lambda x, way=way: figure(x, way))) for way in
                 (jaxform.Reversed(), jaxform.Checkpointed())]  # fmt: skip
    slopes = [each(at)[1] for each in both_ways]
    for path, expected in slopes[1].items():
        np.testing.assert_allclose(slopes[0][path], expected, rtol=1e-7, atol=1e-10 * float(jnp.abs(expected).max()))
    for path, way in {"pressure.value": 0.02, "parison.thickness": 0.01 * weights, "material.c": 1.0}.items():
        step = 1e-6
        both = [float(both_ways[1](at | {path: at[path] + sign * step * way})[0]) for sign in (1, -1)]
        along = float(jnp.sum(slopes[0][path] * way))
        assert abs(along) > 1e-4
        np.testing.assert_allclose(along, (both[0] - both[1]) / (2 * step), rtol=1e-5)


def test_clamped_and_closed_sheets_count_by_volume_alone() -> None:
    """A part that a scene does not use is absent from its program."""
    disc, ball = shapes.disc(radius=1.0, elements=40, symmetry="quarter"), shapes.sphere(radius=1.0, elements=40)
    for sheet in (disc, ball, shapes.rectangle(size=[1.0, 0.5], elements=40, symmetry="quarter")):
        scene = jaxform.build_scene(
            parison=jaxform.make_parison(sheet.positions, sheet.triangles, 0.01, sheet.clamped, sheet.fixed),
            material=RUBBER,
            pressure=jaxform.make_pressure([0.0], [0.01]),
            solver=jaxform.make_solver(end_time=1.0),
        )
        assert scene.tables.rim is None
    assert strip().tables.rim is not None

"""Mold halves that close on a parison: nothing passes the parting plane or the land, and films that meet there weld."""

from __future__ import annotations

import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxform
from jaxform import InputError, molds, shapes
from jaxform.core.pytree import as_real
from jaxform.prepare.component_validation import set_behind_plane
from jaxform.results.part import part_elements
from jaxform.results.summary import wrinkle_fraction

GAP, CLOSED, WALL = 0.025, 0.1, 2.0e-3


def _plate(x: float, **options: Any) -> jaxform.Mold:
    """A plate across x, larger than the parison."""
    made = molds.placed(molds.plate(size=[0.3, 0.3]), rotate=[0.0, -90.0, 0.0], translate=[x, -0.15, -0.1])
    return jaxform.make_mold(made.vertices, made.triangles, **options)


def _closing(direction: float) -> jaxform.Motion:
    return jaxform.make_motion([direction, 0, 0], [0.0, CLOSED], [0.0, GAP])


def _scene(symmetry: str, mold: jaxform.Mold, tools: list[jaxform.Mold]) -> jaxform.Scene:
    """A tube that is flattened completely, with air in it while plates close."""
    tube = shapes.tube(radius=0.016, length=0.1, ends="guided", elements=300, symmetry=symmetry)  # pyright: ignore
    law = jaxform.MooneyRivlin(as_real(2e5), as_real(0.1), as_real(1000.0), tension_field=True)
    return jaxform.build_scene(
        parison=jaxform.make_parison(tube.positions, tube.triangles, WALL, tube.clamped, tube.fixed, guided=(2,)),
        material=law,
        pressure=jaxform.make_pressure([0.0, 0.5 * CLOSED, CLOSED], [0.0, 2e3, 2e4]),
        solver=jaxform.make_solver(end_time=1.2 * CLOSED, damping=200.0),
        mold=mold,
        tools=tools,
        fill=False,
    )


@functools.cache
def _half() -> jaxform.Scene:
    return _scene("half", _plate(GAP, motion=_closing(-1.0)), [_plate(0.0, name="parting-plane")])


def _volume(scene: jaxform.Scene, result: jaxform.Result) -> float:
    corners = np.asarray(result.positions)[np.asarray(result.triangles)]
    area = 0.5 * np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    # Where the film is slack, it has more area than its elements.
    return float((area / (1.0 - wrinkle_fraction(result)) * np.asarray(result.element_thickness)).sum())


def test_a_half_closes_on_the_parting_plane() -> None:
    scene = _half()
    result = jaxform.run(scene)
    # Air and tools do a hundred times the work that remains.
    assert jaxform.explain(result) == "ok" and float(result.energy.balance_error) < 1e-2
    x, y, _ = np.asarray(result.positions).T
    # Flat, and on neither side of the plane.
    assert np.abs(x).max() < 1e-10
    # Pinched without a stretch, it is half as wide as its circumference is long, but for what air does to it.
    np.testing.assert_allclose(np.ptp(y), np.pi * 0.016, rtol=0.05)
    start = float(np.asarray(scene.tables.sheet.area).sum()) * WALL
    np.testing.assert_allclose(_volume(scene, result), start, rtol=1e-9)


@pytest.mark.long
def test_two_halves_close_on_a_whole_tube_as_one_on_its_half() -> None:
    both = _scene("none", _plate(GAP, motion=_closing(-1.0)), [_plate(-GAP, name="other", motion=_closing(1.0))])
    result = jaxform.run(both)
    assert jaxform.explain(result) == "ok" and float(result.energy.balance_error) < 1e-2
    assert np.abs(np.asarray(result.positions)[:, 0]).max() < 1e-10
    half = jaxform.run(_half())
    np.testing.assert_allclose(
        np.ptp(np.asarray(result.positions)[:, 1]), np.ptp(np.asarray(half.positions)[:, 1]), rtol=0.02
    )
    assert set(np.asarray(result.tool).tolist()) <= {-1, 0, 1}


@pytest.mark.long
def test_nodes_in_the_symmetry_plane_stay_there_and_others_weld_to_it() -> None:
    # Without a land the tube is thrown at the plane by a pressure from outside.
    scene = jaxform.replace(_half(), {"pressure.value": jnp.array([0.0, -4e4, -4e4])})
    result = jaxform.run(scene)
    x, fixed = np.asarray(result.positions)[:, 0], np.asarray(scene.parison.fixed)[:, 0]
    assert np.all(x[fixed] == 0.0) and x.min() > -1e-10
    welded = (np.asarray(result.tool) == 1) & np.asarray(result.stuck)
    assert welded.sum() > 10 and not np.any(welded & fixed)


@pytest.mark.long
def test_derivatives_go_through_the_pinch() -> None:
    scene = _half()

    def mean_wall(x: jax.Array) -> jax.Array:
        height = scene.parison.positions[:, 2] / 0.1
        assert scene.mold is not None and scene.mold.motion is not None
        changed = {
            "parison.thickness": scene.parison.thickness * (1.0 + x[0] * height),
            "mold.motion.time": scene.mold.motion.time * (1.0 + jnp.array([0.0, 1.0]) * x[1]),
            "pressure.value": scene.pressure.value * (1.0 + x[2]),
        }
        result = jaxform.simulate(jaxform.replace(scene, changed))
        return 1e3 * jnp.mean(jnp.square(result.element_thickness / WALL)) + 1e3 * jnp.mean(result.positions[:, 1] ** 2)

    value = jax.jit(mean_wall)
    slope = np.asarray(jax.jit(jax.grad(mean_wall))(jnp.zeros(3)))
    for k, each in enumerate(slope):
        step = 3e-8 * np.eye(3)[k]
        secant = (float(value(jnp.asarray(step))) - float(value(jnp.asarray(-step)))) / 6e-8
        np.testing.assert_allclose(each, secant, rtol=1e-5)


@pytest.mark.quick
@pytest.mark.parametrize("displacement", [[0.0, GAP + 1e-3], [0.0, GAP, 0.5 * GAP]])
def test_a_half_may_not_pass_the_plane_or_leave_it(displacement: list[float]) -> None:
    times = np.linspace(0.0, CLOSED, len(displacement))
    mold = _plate(GAP, motion=jaxform.make_motion([-1, 0, 0], times, displacement))
    with pytest.raises(InputError, match="symmetry plane"):
        _scene("half", mold, [])


@pytest.mark.quick
def test_only_a_tool_in_the_symmetry_plane_is_set_behind_it() -> None:
    tube = shapes.tube(radius=0.016, length=0.1, elements=300, symmetry="half")
    parison = jaxform.make_parison(tube.positions, tube.triangles, WALL, tube.clamped, tube.fixed)
    behind = np.asarray(set_behind_plane(_plate(0.0), parison).vertices)[:, 0]
    assert np.all(behind < 0.0) and np.all(behind > -1e-12)
    for other in (_plate(1e-3), _plate(0.0, motion=jaxform.make_motion([0, 0, 1], [0, 1], [0, 1e-3]))):
        assert set_behind_plane(other, parison) is other


def test_flash_lies_on_the_land_and_is_no_part() -> None:
    scene = jaxform.load("extrusion-bottle")
    result = jaxform.run(scene)
    summary = jaxform.summarize(result, scene)
    assert summary["status"] == "ok" and summary["warnings"] == []
    np.testing.assert_allclose(summary["mass"] + summary["flash_mass"], summary["sheet_mass"], rtol=1e-12)
    positions, part = np.asarray(result.positions), np.asarray(part_elements(result, scene))
    assert positions[:, 0].min() > -1e-10 and summary["energy"]["balance_error"] < 1e-4
    height = positions[np.asarray(result.triangles)].mean(1)[:, 2] - 0.03
    assert not np.any(part & (height < -2e-3))  # the tail
    tail, *others = summary["flash"]
    assert (
        tail["box"][1][2] < 0.032
        and others
        and sum(each["mass"] for each in summary["flash"]) == pytest.approx(summary["flash_mass"])
    )
    island = [piece for piece in others if piece["box"][0][2] > 0.14 and abs(piece["box"][0][1]) < 0.01]
    assert len(island) == 1
    # The paper's walls: thinner by 60 % in the body, 20 % in the neck, 50 % in the bottom, 50 to 60 % in the handle.
    corners = positions[np.asarray(result.triangles)]
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1) * part
    y, thinner = corners.mean(1)[:, 1], 100 * (1 - np.asarray(result.element_thickness) / 2.25e-3)
    places = {
        "body": ((height > 0.03) & (height < 0.1), 60, 60),
        "neck": ((height > 0.213) & (height < 0.225), 20, 20),
        "bottom": (height < 0.006, 50, 50),
        "handle": ((height > 0.135) & (height < 0.17) & (y > 0.016), 50, 60),
    }
    for name, (there, low, high) in places.items():
        mean = np.average(thinner[there], weights=area[there])
        assert low - 8 <= mean <= high + 8, (name, mean)

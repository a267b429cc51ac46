"""The built-in stretch-blow bottle: it fills its mold without a warning, and rod and air compete as they should."""

from __future__ import annotations

import jax
import numpy as np
import pytest

import jaxform


@pytest.fixture(scope="module")
def scene() -> jaxform.Scene:
    return jaxform.load("stretch-blow-bottle")


@pytest.fixture(scope="module")
def blown(scene: jaxform.Scene) -> jaxform.Result:
    return jaxform.run(scene)


def _area(positions: jax.Array, triangles: jax.Array) -> np.ndarray:
    corners = np.asarray(positions, float)[np.asarray(triangles)]
    return 0.5 * np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)


@pytest.mark.long
def test_bottle_fills_its_mold_without_a_warning(scene: jaxform.Scene, blown: jaxform.Result) -> None:
    summary = jaxform.summarize(blown, scene)
    assert summary["status"] == "ok" and summary["warnings"] == []
    assert summary["contact_fraction"] == 1.0 and summary["energy"]["balance_error"] < 1e-4
    free = ~np.asarray(scene.parison.clamped)
    assert np.all(np.asarray(blown.tool)[free] == 0), "all lie on the mold, none on the rod"
    # A quarter of 19 g, which is all there was.
    rubber = _area(scene.parison.positions, scene.parison.triangles) * np.asarray(scene.parison.thickness)[
        np.asarray(scene.parison.triangles)
    ].mean(1)
    np.testing.assert_allclose(float(blown.mass), 1330.0 * rubber.sum(), rtol=1e-9)
    assert 0.017 < 4.0 * float(blown.mass) < 0.021
    wall = np.asarray(blown.element_thickness)
    np.testing.assert_allclose(wall * _area(blown.positions, scene.parison.triangles), rubber, rtol=1e-9)


@pytest.mark.long
def test_pressure_has_two_stages_below_those_of_the_supply(blown: jaxform.Result) -> None:
    assert blown.pressures is not None
    time, pressure = blown.pressures
    pre_blow = pressure[(time > 0.04) & (time < 0.16)]
    assert 3e5 < pre_blow.max() < 8e5
    assert np.abs(pressure[time < 0.03]).max() < 5e3, "the valve is closed: what the rod makes room for"
    # The run ends when the whole sheet lies on the mold.
    assert 2.5e6 < pressure[-1] < 3.0e6 and pressure[-1] == pressure.max()


@pytest.mark.long
def test_wall_is_more_even_the_farther_the_rod_is_ahead(scene: jaxform.Scene, blown: jaxform.Result) -> None:
    quick = jaxform.replace(scene, {"tools.rod.motion.time": [0.0, 0.08]})
    late = jaxform.replace(scene, {"pressure.time": [0.0, 0.06, 0.07, 0.16, 0.17]})
    walls = [jaxform.summarize(jaxform.run(each), each)["thickness"] for each in (quick, late)]
    usual = jaxform.summarize(blown, scene)["thickness"]
    for wall in walls:
        assert wall["cv"] < 0.9 * usual["cv"] and wall["min"] > 1.1 * usual["min"]

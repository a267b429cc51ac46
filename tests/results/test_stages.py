"""A formed part as the next parison: its mass to rounding, its initial positions, and texts of one line."""

from __future__ import annotations

import jax
import numpy as np
import pytest

import jaxform
from jaxform import Result, Scene
from tests import scenes

SCENE = scenes.FILE.replace("end_time = 0.05", "end_time = 0.15")
REFINED = SCENE + "[refinement]\nangle = 4.0\ninterval = 64\nmax_level = 2\nbase_level = 1\n"


@pytest.fixture(scope="module", params=[SCENE, REFINED], ids=["uniform", "refined"])
def stage_result(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> tuple[Scene, Result]:
    path = tmp_path_factory.mktemp("stage") / "scene.toml"
    path.write_text(request.param)
    scene = jaxform.load(path)
    return scene, jaxform.run(scene)


def _volumes(parison: jaxform.Parison) -> np.ndarray:
    corners = np.asarray(parison.positions)[np.asarray(parison.triangles)]
    area = 0.5 * np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    return area * np.asarray(parison.thickness)[np.asarray(parison.triangles)].mean(1)


@pytest.mark.long
def test_the_next_parison_has_the_volume_of_the_part(stage_result: tuple[Scene, Result]) -> None:
    scene, result = stage_result
    volume = np.asarray(result.element_volume)
    assert volume[np.asarray(result.used)].size > 30
    parison = jaxform.parison_of(result, scene)
    np.testing.assert_allclose(_volumes(parison).sum(), volume.sum(), rtol=1e-14)
    # Not all elements have their share of the mean: the thickness is that of the part, element by element.
    used = volume[np.asarray(result.used)]
    np.testing.assert_allclose(_volumes(parison), used, rtol=0.25)
    assert np.std(np.asarray(parison.thickness)) > 0.1 * np.mean(np.asarray(parison.thickness))


def test_the_next_parison_is_a_scene_of_the_same_mass(stage_result: tuple[Scene, Result]) -> None:
    scene, result = stage_result
    following = jaxform.build_scene(
        parison=jaxform.parison_of(result, scene),
        material=scene.material,
        pressure=jaxform.make_pressure([0.0], [0.0]),
        solver=jaxform.make_solver(end_time=1.0, damping=1.0),
    )
    # A quarter is cut at the same planes, and its rim is clamped.
    assert np.asarray(following.parison.fixed).any(0).tolist() == [True, True, False]
    rim = np.asarray(following.parison.positions)[np.asarray(following.parison.clamped)]
    np.testing.assert_allclose(np.hypot(*rim[:, :2].T), 0.1)
    np.testing.assert_allclose(scenes.at_rest(following).mass, result.mass, rtol=1e-12)


def test_reference_positions_are_those_of_the_same_nodes(stage_result: tuple[Scene, Result]) -> None:
    result = stage_result[1]
    used = np.asarray(result.used)
    start = np.asarray(result.reference)[np.asarray(result.triangles)[used]]
    end = np.asarray(result.positions)[np.asarray(result.triangles)[used]]

    def area(corners: np.ndarray) -> np.ndarray:
        return 0.5 * np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)

    # Incompressible: each element's area and thickness say how much it was stretched from its reference.
    wall, stretches = np.asarray(result.element_thickness)[used], np.asarray(result.stretches)[used]
    np.testing.assert_allclose(area(end) / area(start), stretches.prod(1), rtol=1e-9)
    np.testing.assert_allclose(area(end) * wall, np.asarray(result.element_volume)[used], rtol=1e-9)


def test_a_scene_and_its_result_are_one_short_line(stage_result: tuple[Scene, Result]) -> None:
    scene, result = stage_result
    for one in (scene, result, scene.parison, scene.material, result.energy):
        assert "\n" not in repr(one) and len(repr(one)) < 400
    assert repr(scene).startswith("Scene('small': ") and "mold of" in repr(scene)
    assert f"{len(result.triangles)} elements" in repr(result) and "status=0" in repr(result)
    # Trees of anything have a text: JAX makes some of its own, and prints them in its errors.
    assert "? elements" in repr(jax.tree.map(lambda _: None, scene))
    assert "float64[2]" in repr(jax.tree.map(lambda leaf: np.stack([leaf, leaf]), scene))

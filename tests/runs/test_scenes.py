"""The paper's scenes: as functions they are the scene files, their numbers arrive, and the bottle fills its mold."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxform
from jaxform import scenes, shapes

pytestmark = pytest.mark.quick

FUNCTIONS: dict[str, Callable[..., jaxform.Scene]] = {
    "dish": scenes.dish,
    "box-insert": scenes.box_insert,
    "soap-bottle": scenes.soap_bottle,
}

# Values of wrong types, behind the type checker's back.
ANY: dict[Any, Any] = {"x": "x", 3: 3}


def _mold(scene: jaxform.Scene) -> np.ndarray:
    assert scene.mold is not None
    return np.asarray(scene.mold.vertices)


@pytest.mark.parametrize("name", FUNCTIONS)
def test_without_arguments_each_function_is_its_scene_file(name: str) -> None:
    from_file, made = jaxform.load(name), FUNCTIONS[name]()
    assert jax.tree.structure(from_file) == jax.tree.structure(made)
    for one, other in zip(jax.tree.leaves(from_file), jax.tree.leaves(made), strict=True):
        np.testing.assert_array_equal(one, other)


def test_a_dish_has_the_sizes_that_it_is_given() -> None:
    scene = scenes.dish(radius=0.1, depth=0.06, wall_angle=70.0, elements=100, thickness=2e-3, refinement=False)
    vertices, radius = _mold(scene), np.hypot(*_mold(scene)[:, :2].T)
    assert vertices[:, 2].max() == 0.06
    np.testing.assert_allclose(radius.max(), 0.1)
    np.testing.assert_allclose(radius[vertices[:, 2] > 0.05].max(), 0.1 - 0.06 / math.tan(math.radians(70.0)))
    np.testing.assert_allclose(np.asarray(scene.parison.positions)[:, 0].max(), 0.1)
    np.testing.assert_array_equal(scene.parison.thickness, 2e-3)
    assert 80 < len(scene.parison.triangles) < 120


def test_what_is_not_given_keeps_its_proportions() -> None:
    whole = _mold(scenes.dish())
    np.testing.assert_allclose(_mold(scenes.dish(radius=0.12954)), whole, rtol=1e-12)
    upright = _mold(scenes.dish(wall_angle=90))
    np.testing.assert_allclose(np.hypot(*upright[:, :2].T)[upright[:, 2] > 0.1].max(), 0.12954)


def test_a_box_and_its_sheet_share_the_opening() -> None:
    scene = scenes.box_insert(size=(0.2, 0.1), depth=0.05, insert_size=(0.08, 0.04), insert_height=0.02, draft=5)
    vertices = _mold(scene)
    np.testing.assert_allclose(np.ptp(vertices, axis=0), [0.2, 0.1, 0.05])
    np.testing.assert_allclose(np.asarray(scene.parison.positions).max(0), [0.1, 0.05, 0.0])
    lid = vertices[np.isclose(vertices[:, 2], 0.03)]
    np.testing.assert_allclose(np.ptp(lid[:, 0]), 0.08 - 2 * 0.02 * math.tan(math.radians(5)))
    assert scenes.box_insert(refinement=False).refinement is None


def test_a_bottle_and_its_parison_have_one_shape() -> None:
    scene = scenes.soap_bottle(height=0.3, radius=0.05, element_size=0.012, swell=0.5)
    np.testing.assert_allclose(_mold(scene)[:, 1].max(), 0.3)
    np.testing.assert_allclose(np.asarray(scene.parison.positions)[:, 1].max(), 0.3, atol=1e-3)
    assert 0.048 < np.asarray(scene.parison.positions)[:, 0].max() < 0.05


def test_the_blow_pin_holds_the_parison_open_at_the_neck_alone() -> None:
    made = [np.asarray(scenes.soap_bottle(neck_swell=swell).parison.positions) for swell in (0.3, 0.6)]
    flat, open_neck = made
    at_neck = np.isclose(flat[:, 1], 0.23)
    np.testing.assert_allclose(open_neck[at_neck, 2], 2 * flat[at_neck, 2], atol=1e-12)
    assert 0.5 * 0.014 < open_neck[at_neck, 2].max() < 0.65 * 0.014
    below = flat[:, 1] < 0.8 * 0.23 - 0.01
    np.testing.assert_array_equal(open_neck[below], flat[below])


def test_tables_are_merged_with_those_of_the_file() -> None:
    scene = scenes.dish(pressure=4206.0, material={"a01": np.float32(2e5)})
    np.testing.assert_allclose(scene.pressure.value, [0.0, 4206.0])
    assert scene.pressure.interpolation == "cubic-ramp"
    assert isinstance(scene.material, jaxform.ModifiedMooneyRivlin)
    np.testing.assert_allclose([scene.material.a01, scene.material.a02], [2e5, 2.2])
    other = scenes.dish(material={"model": "neo-hookean", "c": 1e5}, refinement={"max_level": 2})
    assert isinstance(other.material, jaxform.NeoHookean) and float(other.material.density) == 1050.0
    assert other.refinement is not None and other.refinement.max_level == 2


@pytest.mark.parametrize(
    ("make", "parts"),
    [
        (lambda: scenes.dish(depth=2.0), ("depth = 2.0", "no bottom", "wall_angle above 86.3")),
        (lambda: scenes.dish(radius=-1), ("radius = -1", "number above 0")),
        (lambda: scenes.dish(wall_angle=math.nan), ("wall_angle = nan", "at most 90")),
        (lambda: scenes.dish(elements=9, element_size=0.1), ("element_size = 0.1", "one of them")),
        (lambda: scenes.box_insert(insert_height=1.0), ("mold.insert_height = 1.0", "0.08", "lower it")),
        (lambda: scenes.box_insert(size=[1]), ("parison.size = [1]", "at least 2")),
        (lambda: scenes.soap_bottle(hole=(0.1, 0.1)), ("hole[0] = 0.1", "0.004 to 0.01")),
        (lambda: shapes.bottle_half(neck_swell=1.2), ("parison.neck_swell = 1.2", "between 0 and 1")),
        (lambda: scenes.soap_bottle(material={"c": "x"}), ("material.c = 'x'", "is not a number", "give a number")),
        (lambda: scenes.soap_bottle(pressure=ANY["x"]), ("pressure = 'x'", "give Pa")),
        (lambda: scenes.dish(material={"model": "neo-hookean"}), ("material.c", "is missing")),
        (lambda: scenes.dish(refinement={"angel": 3.0}), ("refinement.angel", "did you mean angle?")),
        (lambda: scenes.dish(refinement=ANY[3]), ("refinement = 3", "give keys of [refinement]")),
    ],
)
def test_bad_values_name_key_value_and_mend(make: Callable[[], Any], parts: tuple[str, ...]) -> None:
    with pytest.raises(jaxform.InputError) as caught:
        make()
    line = str(caught.value)
    assert all(part in line for part in parts) and "\n" not in line


def test_a_traced_size_says_what_to_do_instead() -> None:
    with pytest.raises(jaxform.InputError, match=r"thickness.*jaxform\.replace"):
        jax.jit(lambda h: scenes.dish(thickness=h).parison.thickness)(jnp.float64(1e-3))


@pytest.mark.long
def test_the_bottle_fills_its_mold_and_keeps_its_accounts() -> None:
    scene = scenes.soap_bottle()
    assert scene.mold is not None
    assert abs(len(scene.parison.triangles) - 802) < 10 and abs(len(scene.mold.triangles) - 1215) < 15
    part = jaxform.run(scene)
    found = jaxform.summarize(part, scene)
    assert found["status"] == "ok"
    assert found["contact_fraction"] > 0.98
    assert found["energy"]["balance_error"] < 1e-3
    assert found["penetration_max"] < 1e-3
    # The rubber keeps its volume: that of the wall, measured on the formed triangles, is the parison's.
    corners = np.asarray(part.positions)[np.asarray(part.triangles)]
    start = np.asarray(scene.parison.positions)[np.asarray(scene.parison.triangles)]
    np.testing.assert_allclose(_areas(corners) @ part.element_thickness, 2.25e-3 * _areas(start).sum(), rtol=1e-9)
    np.testing.assert_allclose(np.ptp(corners[..., 1]), 0.23, rtol=0.01)


def _areas(corners: np.ndarray) -> np.ndarray:
    edges = corners[:, 1:] - corners[:, :1]
    return 0.5 * np.linalg.norm(np.cross(edges[:, 0], edges[:, 1]), axis=1)

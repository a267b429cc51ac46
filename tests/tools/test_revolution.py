"""Bodies of revolution: axis and profile of bottles that are turned, hollow, indented; bodies that are not round."""

from __future__ import annotations

import numpy as np
import pytest

from jaxform.core.errors import InputError
from jaxform.mesh import meshes
from jaxform.mesh.meshes import Mesh
from jaxform.tools import bottles, molds, revolution
from tests.cli.test_new_extrusion import squat

pytestmark = pytest.mark.quick

# From the middle of an indented bottom to the neck, and across it.
PROFILE = [[0.0, 0.004], [0.02, 0.0], [0.028, 0.003], [0.03, 0.01], [0.03, 0.1], [0.012, 0.15], [0.011, 0.18]]


def _bottle(rotate: tuple[float, float, float], closed: bool = True, wall: float = 0.0, segments: int = 64) -> Mesh:
    """A bottle turned and moved; with a wall it is the solid that the bottle is, open at its neck."""
    outside = np.array(PROFILE)
    if wall:
        inside = np.array([[0.0, 0.006], [0.026, 0.006], [0.028, 0.012], [0.028, 0.1], [0.01, 0.15], [0.009, 0.18]])
        profile = np.concatenate([outside, inside[::-1]])
    else:
        profile = np.concatenate([outside, [[0.0, 0.18]]]) if closed else outside
    shape = molds.revolved(profile=profile, segments=segments)
    return meshes.weld(Mesh(shape.vertices @ molds.rotation(np.array(rotate)).T + [0.1, -0.2, 0.03], shape.triangles))


@pytest.mark.parametrize(
    ("rotate", "closed", "wall"),
    [((0, 0, 0), True, 0.0), ((90, 0, 0), True, 0.0), ((25, -40, 70), False, 0.0), ((180, 10, 0), True, 1e-3)],
)
def test_axis_and_profile_of_a_turned_bottle(rotate: tuple[float, float, float], closed: bool, wall: float) -> None:
    found = revolution.find_revolution(_bottle(rotate, closed, wall))
    turn, shift = molds.rotation(np.array(rotate, float)), np.array([0.1, -0.2, 0.03])
    np.testing.assert_allclose(found.axis, turn @ [0.0, 0.0, -1.0], atol=1e-6)
    np.testing.assert_allclose(found.origin, turn @ [0.0, 0.0, 0.18] + shift, atol=1e-5)
    assert found.variation < 5e-3
    np.testing.assert_allclose([found.length, found.radius, found.neck], [0.18, 0.03, 0.011], rtol=2e-3)
    # The side, and the indentation of the bottom.
    side = found.profile[np.argmax(found.profile[:, 1]) :][::-1]
    heights = np.array([0.01, 0.05, 0.079, 0.1, 0.165])
    np.testing.assert_allclose(
        np.interp(heights, side[:, 1], side[:, 0]),
        np.interp(0.18 - heights, *np.array(PROFILE)[2:].T[::-1]),
        atol=4e-4,
    )
    np.testing.assert_allclose(found.profile[0], [0.0, 0.176], atol=4e-4)
    assert len(found.profile) < 20 and found.profile[-1, 1] == 0.0


def test_bodies_that_are_not_round_are_refused() -> None:
    for shape in (molds.plate(size=[0.1, 0.05]), molds.box_insert(), molds.bottle_half()):
        with pytest.raises(InputError, match="is not a body of revolution"):
            revolution.find_revolution(meshes.weld(Mesh(shape.vertices, shape.triangles)))


def test_a_cone_a_cup_a_box_and_a_stepped_buck_are_no_bottles() -> None:
    cup, cone = [[0.0, 0.0], [0.03, 0.0], [0.025, 0.1], [0.0, 0.1]], [[0.0, 0.0], [0.03, 0.0], [0.0, 0.1]]
    steps = [[0.0, 0.0], [0.06, 0.0], [0.058, 0.03], [0.02, 0.032], [0.019, 0.06], [0.0, 0.06]]
    shapes = [molds.box_insert(), *(molds.revolved(profile=profile, segments=48) for profile in (cup, cone, steps))]
    assert "round body with a neck" in bottles.describe_bottle(_bottle((30, 0, 0)))
    assert not any(bottles.describe_bottle(meshes.weld(Mesh(shape.vertices, shape.triangles))) for shape in shapes)


@pytest.mark.parametrize(
    ("kind", "words"),
    [
        ("jar", "a round body with"),
        ("flask", "a body with a neck,"),
        ("jug", "and a handle"),
    ],
)
def test_bottles_that_are_wider_than_tall_and_jugs_look_like_bottles(kind: str, words: str) -> None:
    mesh = squat(kind)
    found = bottles.describe_bottle(Mesh(1e-3 * mesh.positions, mesh.triangles, {}))
    assert words in found and ("stretch-blow" in found) == (kind != "jug")

"""Ribs and pins thinner than the elements are found before a run, with place and size; what is wide enough is not."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from jaxform.tools.ribs import Ribs, slender_feature

PUSH = np.array([0.0, 0.0, -1.0])
SIDE = 0.008


def _sheet() -> tuple[np.ndarray, np.ndarray]:
    """A square sheet of 100 mm at z = 0.03 in elements of 8 mm, and its rim."""
    x = np.linspace(-0.05, 0.05, 14)
    grid = np.stack([*np.meshgrid(x, x, indexing="ij"), np.full((14, 14), 0.03)], axis=2)
    a, b, c, d = grid[:-1, :-1], grid[1:, :-1], grid[1:, 1:], grid[:-1, 1:]
    corners = np.concatenate([np.stack([a, b, c], 2).reshape(-1, 3, 3), np.stack([a, c, d], 2).reshape(-1, 3, 3)])
    rim = np.abs(corners).reshape(-1, 3)[:, :2].max(1) > 0.0499
    return corners, corners.reshape(-1, 3)[rim]


def _find_ribs(*bodies: trimesh.Trimesh, side: float = SIDE) -> Ribs | None:
    """Ribs that are found among bodies that stand on a floor of 120 mm, 30 mm below the sheet."""
    floor = trimesh.creation.box(extents=(0.12, 0.12, 0.01))
    floor.apply_translation((0.0, 0.0, -0.005))
    sheet, rim = _sheet()
    corners = np.concatenate([np.asarray(body.triangles) for body in (floor, *bodies)])
    return slender_feature(sheet, corners, PUSH, side, rim)


def _box(x: float, y: float, height: float, at: tuple[float, float] = (0.0, 0.0)) -> trimesh.Trimesh:
    body = trimesh.creation.box(extents=(x, y, height))
    body.apply_translation((*at, height / 2))
    return body


@pytest.mark.parametrize("width", [0.0002, 0.002, 0.006])
@pytest.mark.parametrize("turned", [0.0, 0.6])
def test_a_rib_has_its_height_width_and_place(width: float, turned: float) -> None:
    rib = _box(width, 0.06, 0.018)
    rib.apply_transform(trimesh.transformations.rotation_matrix(turned, (0, 0, 1)))
    rib.apply_translation((0.011, -0.007, 0.0))
    found = _find_ribs(rib)
    assert found is not None
    np.testing.assert_allclose(found.height, 0.018, rtol=1e-6)
    # To two pixels of an eighth of an element at each side.
    assert width - 1e-9 <= found.width <= width + 0.5 * SIDE + 1e-3
    np.testing.assert_allclose(found.place[2], 0.018, rtol=1e-6)
    along = np.array([-np.sin(turned), np.cos(turned)])
    away = (found.place[:2] - [0.011, -0.007]) @ np.array([along[1], -along[0]])
    assert abs(away) < 0.5 * width + 0.25 * SIDE


def test_the_highest_is_named_and_a_pin_counts() -> None:
    pin = trimesh.creation.cylinder(radius=0.001, height=0.025)
    pin.apply_translation((0.02, 0.02, 0.0125))
    found = _find_ribs(_box(0.002, 0.06, 0.018), pin)
    assert found is not None
    np.testing.assert_allclose(found.height, 0.025, rtol=1e-6)
    np.testing.assert_allclose(found.place[:2], 0.02, atol=SIDE / 4)


@pytest.mark.parametrize(
    "body",
    [
        _box(0.03, 0.03, 0.02),  # a block, with its corners
        _box(0.003, 0.06, 0.006),  # lower than the nodes beside it follow
        trimesh.creation.icosphere(radius=0.02),
        trimesh.creation.cone(radius=0.02, height=0.025),
    ],
    ids=["block", "low", "ball", "cone"],
)
def test_what_an_element_can_lie_on_is_no_rib(body: trimesh.Trimesh) -> None:
    assert _find_ribs(body) is None


def test_finer_elements_lie_on_it() -> None:
    rib = _box(0.006, 0.06, 0.018)
    assert _find_ribs(rib) is not None
    assert _find_ribs(rib, side=0.003) is None


def test_a_wall_beside_the_clamped_rim_is_the_molds_own() -> None:
    walls = [_box(0.002, 0.1, 0.03, at=(sign * 0.049, 0.0)) for sign in (-1, 1)]
    assert _find_ribs(*walls) is None

"""The land of a mold half: flat, around the cavity and in the holes of its outline, with the cavity's vertices."""

from __future__ import annotations

import numpy as np
import pytest

from jaxform import InputError, molds
from jaxform.mesh import topology
from jaxform.tools.parting import add_land, find_parting_plane

pytestmark = pytest.mark.quick


def _area(vertices: np.ndarray, triangles: np.ndarray) -> float:
    corners = vertices[triangles]
    return float(
        0.5 * np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1).sum()
    )


def test_land_of_a_bowl_fills_the_rectangle_around_it() -> None:
    bowl = molds.revolved(profile=[[0.0, 0.05], [0.06, 0.05], [0.08, 0.0]], segments=48)
    made, count = add_land(bowl, 0.02)
    land = made.triangles[-count:]
    circle = 0.5 * 48 * 0.08**2 * np.sin(2 * np.pi / 48)
    np.testing.assert_allclose(_area(made.vertices, land), 0.2**2 - circle, rtol=1e-12)
    assert np.all(made.vertices[land][..., 2] == 0.0)
    # The rim is open no more: only the rectangle's sides are.
    middle = made.vertices[topology.boundary_edges(made.triangles)].mean(1)
    np.testing.assert_allclose(np.abs(middle[:, :2]).max(1), 0.1)
    assert len(topology.nonmanifold_edges(made.triangles)) == 0


def test_land_of_a_bottle_has_an_island_and_ends_at_the_neck() -> None:
    half = molds.bottle_half(hole_center=[0.0085, 0.152], handle_edge=0.03, element_size=0.008)
    made, count = add_land(half, 0.03)
    middle = made.vertices[made.triangles[-count:]].mean(1)
    in_hole = (np.abs(middle[:, 0] - 0.0085) < 0.0075) & (np.abs(middle[:, 1] - 0.152) < 0.02)
    assert in_hole.sum() >= 3
    low, high = made.vertices[:, 1].min(), made.vertices[:, 1].max()
    assert high == pytest.approx(0.23) and low == pytest.approx(-0.03)
    edges = made.vertices[topology.boundary_edges(made.triangles)]
    outside = (np.abs(edges[..., 0]) > 0.069).all(1) | (edges[..., 1] < -0.029).all(1)
    # Open are the rectangle's sides and the neck, where the land ends.
    np.testing.assert_allclose(edges[~outside][..., 1], 0.23)


@pytest.mark.parametrize("turn", [[90.0, 0.0, 90.0], [0.0, 180.0, 0.0]])
def test_land_lies_in_the_parting_plane_of_a_turned_mold(turn: list[float]) -> None:
    bowl = molds.revolved(profile=[[0.0, 0.05], [0.06, 0.05], [0.08, 0.0]], segments=24)
    turned = molds.placed(bowl, rotate=turn, translate=[0.1, 0.2, 0.3])
    axis, level = find_parting_plane(turned)
    made, count = add_land(turned, 0.02)
    np.testing.assert_allclose(made.vertices[made.triangles[-count:]][..., axis], level, atol=1e-15)
    straight, _ = add_land(bowl, 0.02)
    np.testing.assert_allclose(_area(made.vertices, made.triangles), _area(straight.vertices, straight.triangles))


def test_a_mold_that_is_open_in_no_plane_has_no_land() -> None:
    for surface in (
        molds.rod(radius=0.01, length=0.05),
        molds.placed(molds.plate(radius=0.1), rotate=[30.0, 0.0, 0.0]),
    ):
        with pytest.raises(InputError, match="open in a plane") as found:
            add_land(surface, 0.02)
        assert found.value.key == "mold.land"

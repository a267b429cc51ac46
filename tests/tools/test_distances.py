"""The nearest places of a surface, against all pairs of points and triangles."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import pytest
from numpy.typing import NDArray

from jaxform.mesh import shapes
from jaxform.tools.distances import Distances, point_triangle_distance


class _Surface(NamedTuple):
    vertices: NDArray[np.float64]
    triangles: NDArray[np.integer]


def _bowl() -> _Surface:
    """An open paraboloid with one triangle far longer than the others."""
    sheet = shapes.disc(radius=1.0, elements=120)
    vertices = np.array(sheet.positions)
    vertices[:, 2] = vertices[:, 0] ** 2 + vertices[:, 1] ** 2
    rim = len(vertices)
    vertices = np.concatenate([vertices, [[3.0, 0.0, 1.0], [3.0, 0.2, 1.0], [1.5, 0.1, 1.2]]])
    return _Surface(vertices, np.concatenate([sheet.triangles, [[rim, rim + 1, rim + 2]]]))


def test_the_nearest_place_is_that_of_all_triangles() -> None:
    surface, random = _bowl(), np.random.default_rng(0)
    points = random.uniform([-1.5, -1.5, -0.5], [3.0, 1.5, 1.5], (400, 3))
    found = Distances(surface.vertices, surface.triangles, 2.0).nearest(points)
    corners = surface.vertices[surface.triangles]
    every = np.stack([point_triangle_distance(points, np.broadcast_to(one, (400, 3, 3))) for one in corners], axis=1)
    np.testing.assert_allclose(found.distance, every.min(1), rtol=1e-12)
    np.testing.assert_allclose(every[np.arange(400), found.triangle], every.min(1), rtol=1e-12)
    np.testing.assert_allclose(np.linalg.norm(points - found.place, axis=1), found.distance, rtol=1e-9, atol=1e-15)


def test_what_lies_beyond_an_open_rim_is_told() -> None:
    surface, angle = _bowl(), np.linspace(0.1, 6.1, 50)
    around = np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)
    found = Distances(surface.vertices, surface.triangles, 0.5).nearest(1.2 * around + [0, 0, 1.2])
    assert found.at_rim.all()
    inner = Distances(surface.vertices, surface.triangles, 0.5).nearest(0.5 * around + [0, 0, 0.3])
    assert not inner.at_rim.any()


def test_far_away_it_is_near_the_nearest_all_the_same() -> None:
    """Farther than was asked for: no nearer than the nearest, and not farther by more than a triangle is large."""
    surface = _bowl()
    points = np.array([[0.0, 0.0, 9.0], [-7.0, 2.0, 0.0], [5.0, -5.0, 5.0]])
    found = Distances(surface.vertices, surface.triangles, 0.1).nearest(points)
    corners = surface.vertices[surface.triangles]
    every = np.stack([point_triangle_distance(points, np.broadcast_to(one, (3, 3, 3))) for one in corners], axis=1)
    assert (found.distance >= every.min(1) - 1e-12).all() and (found.distance <= every.min(1) + 0.4).all()


def _fan_and_bowl() -> _Surface:
    """The bowl over a fan of 400 slivers from one vertex, as long as it is wide; both are open."""
    bowl, angle = _bowl(), np.linspace(0.0, 2 * np.pi, 400, endpoint=False)
    hub, rim = len(bowl.vertices), len(bowl.vertices) + 1 + np.arange(400)
    fan = np.stack([np.full(400, hub), rim, np.roll(rim, -1)], axis=1)
    around = np.stack([2.0 * np.cos(angle), 2.0 * np.sin(angle), np.full(400, -0.5)], axis=1)
    vertices = np.concatenate([bowl.vertices, [[0.0, 0.0, -0.5]], around])
    return _Surface(vertices, np.concatenate([bowl.triangles, fan]))


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("farthest", [0.2, 5.0])
def test_the_largest_distance_is_that_of_all_points(seed: int, farthest: float) -> None:
    """Points about slivers and beyond rims, at which a distance is none; too far ones as well."""
    surface, random = _fan_and_bowl(), np.random.default_rng(seed)
    points = random.uniform([-2.5, -2.5, -1.0], [3.0, 2.5, 1.5], (600, 3))
    every = Distances(surface.vertices, surface.triangles, farthest).exact(points)
    corners = surface.vertices[surface.triangles]
    least = np.min([point_triangle_distance(points, np.broadcast_to(one, (600, 3, 3))) for one in corners], axis=0)
    within = every > 0
    assert within.any() and not within.all()
    np.testing.assert_allclose(every[within], least[within], rtol=1e-12)
    value, found = Distances(surface.vertices, surface.triangles, farthest).largest(points)
    assert value == every.max() and every[found] == value
    assert Distances(surface.vertices, surface.triangles, farthest).largest(points, value) == (value, -1)


def test_few_points_are_measured_for_the_largest_distance(monkeypatch: pytest.MonkeyPatch) -> None:
    """Over long slivers the nearest piece's middle says little: 20 000 points, of which some hundred are measured."""
    asked: list[int] = []
    exact = Distances.exact

    def count(self: Distances, points: NDArray[np.float64]) -> NDArray[np.float64]:
        asked.append(len(points))
        return exact(self, points)

    monkeypatch.setattr(Distances, "exact", count)
    angle = np.linspace(0.0, 2 * np.pi, 1500, endpoint=False)
    around = np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)
    rim = 1 + np.arange(len(angle))
    fan = np.stack([np.zeros_like(rim), rim, np.roll(rim, -1)], axis=1)
    surface = _Surface(np.concatenate([np.zeros((1, 3)), around]), fan)
    where = np.random.default_rng(0).uniform(-0.6, 0.6, (20_000, 2))
    height = 0.02 + 0.01 * np.cos(4 * where[:, 0]) * np.cos(4 * where[:, 1])
    value, found = Distances(surface.vertices, surface.triangles, 0.5).largest(np.column_stack([where, height]))
    assert value == pytest.approx(height.max(), rel=1e-12) and found == np.argmax(height)
    assert sum(asked) < 1000

"""Molds of slivers as long as they are, as CAD writes turned parts: what is measured is bounded, and as of others."""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest
from numpy.typing import NDArray

import jaxform
from jaxform.mesh import shapes
from jaxform.tools import distances, molds, search
from jaxform.tools.molds import MoldShape
from jaxform.tools.penetration import penetration, self_intersecting_elements
from jaxform.tools.search import CLASSES, build_grid, cell_of

Array = NDArray[np.float64]


def _turn(sections: int, heights: int = 1) -> MoldShape:
    """A conical cup with a thin wall and a finely rounded lip; its walls may be cut into rings."""
    outwards = np.linspace([0.03, 0.1], [0.04, 0.0], heights + 1)
    angle = np.linspace(0, np.pi, 10)
    lip = np.stack([0.0415 - 0.0015 * np.cos(angle), -0.0015 * np.sin(angle)], axis=1)
    back = np.linspace([0.043, 0.0], [0.031, 0.102], heights + 1)
    profile = np.concatenate([[[0.0, 0.1]], outwards, lip[1:-1], back, [[0.0, 0.102]]])
    return molds.revolved(profile=profile, segments=sections)


def _fan(count: int) -> tuple[Array, NDArray[np.int64]]:
    """Slivers from one vertex all around."""
    angle = 2 * np.pi * np.arange(count) / count
    rim = np.stack([0.1 * np.cos(angle), 0.1 * np.sin(angle), np.zeros(count)], axis=1)
    k = np.arange(count)
    return np.concatenate([rim, [[0.0, 0.0, 0.05]]]), np.stack([np.full(count, count), k, (k + 1) % count], axis=1)


@pytest.mark.parametrize("shape", ["turned", "fan"])
def test_cells_of_slivers_list_all_in_reach_and_few_more_are_compared(
    shape: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    cup = _turn(1000)
    vertices, triangles = (cup.vertices, np.asarray(cup.triangles)) if shape == "turned" else _fan(20_000)
    compared, measured = [], search._distances

    def count(local: search._Local, triangle: NDArray[np.int64], *middle: Any) -> Any:
        compared.append(len(triangle))
        return measured(local, triangle, *middle)

    monkeypatch.setattr(search, "_distances", count)
    grid = build_grid(vertices, triangles)
    listed = len(np.asarray(grid.listed))
    assert listed <= 8_000_000 and sum(compared) <= 2.5 * listed
    corners = vertices[triangles]
    random = np.random.default_rng(0)
    # Near the slivers, all along.
    weight = random.dirichlet(np.ones(3), 60)
    points = np.einsum("nc,nck->nk", weight, corners[random.integers(0, len(corners), 60)])
    points += random.normal(scale=0.002, size=points.shape)
    start, ends = np.asarray(grid.start), np.asarray(grid.ends).reshape(-1, CLASSES)
    named = np.asarray(grid.number)[np.asarray(grid.listed)]
    for point, cell in zip(points, np.asarray(cell_of(jnp.asarray(points.T), grid)), strict=True):
        away = distances.point_triangle_distance(np.broadcast_to(point, (len(corners), 3)), corners)
        assert float(grid.bound[cell]) <= away.min() + 1e-12
        for kind, end in enumerate(ends[cell]):
            within = np.flatnonzero(away < float(grid.reach) * (kind + 1) / CLASSES)
            assert not len(np.setdiff1d(within, named[start[cell] : end]))


def test_a_sheet_is_as_deep_in_a_cup_of_slivers_as_in_one_of_small_triangles() -> None:
    sheet = shapes.disc(radius=0.0415, elements=300)
    positions = np.array(sheet.positions)
    radius = np.linalg.norm(positions[:, :2], axis=1)
    # Down to the middle of the floor, but a little through the wall.
    positions[:, 2] = 0.08 * np.clip(1.2 - radius / 0.0345, 0.0, 1.0)
    positions[:, :2] *= 1.02
    found = []
    for heights in (1, 40):
        shape = _turn(400, heights)
        mold = jaxform.make_mold(shape.vertices, shape.triangles)
        none = np.zeros(len(positions), np.int64)
        found.append(penetration(positions, np.asarray(sheet.triangles), none, mold))
    assert found[0].elements > 1e-4
    np.testing.assert_allclose(found[0].elements, found[1].elements, rtol=1e-9)
    np.testing.assert_allclose(found[0].nodes, found[1].nodes, rtol=1e-9, atol=1e-12)


def test_pieces_that_distances_are_looked_up_in_are_bounded_and_the_farthest_is_exact() -> None:
    shape = _turn(2000)
    surface = distances.Distances(shape.vertices, shape.triangles, 1e-3)
    assert sum(len(owner) for _, _, owner in surface.groups) <= 400_000
    random = np.random.default_rng(1)
    points = random.uniform([-0.05, -0.05, 0.0], [0.05, 0.05, 0.11], (3000, 3))
    every = surface.exact(points)
    best, which = surface.largest(points)
    assert best == every.max() > 5e-4 and every[which] == best
    assert surface.largest(points[:0]) == (0.0, -1)


def test_of_a_sheet_that_burst_the_largest_elements_are_not_compared_and_counted(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    sheet = shapes.disc(radius=0.1, elements=400)
    triangles, flat = np.asarray(sheet.triangles), np.array(sheet.positions)
    dome = molds.divided(molds.revolved(profile=[[0.0, 0.05], [0.07, 0.05], [0.1, 0.0]], segments=24), 8)
    mold = jaxform.make_mold(dome.vertices, dome.triangles)
    none = np.zeros(len(flat), np.int64)
    burst = flat + np.random.default_rng(0).normal(scale=0.1, size=flat.shape)
    assert penetration(burst, triangles, none, mold).unmeasured == 0
    monkeypatch.setattr("jaxform.tools.penetration._MOST_PIECES", 20_000)
    assert penetration(flat, triangles, none, mold).unmeasured == 0
    found = penetration(burst, triangles, none, mold)
    assert 0 < found.unmeasured < len(triangles)
    asked = np.arange(len(triangles))
    every = self_intersecting_elements(burst, triangles, asked)
    assert len(every) > 350
    monkeypatch.setattr("jaxform.tools.penetration._MOST_PAIRS", 1000)
    np.testing.assert_array_equal(self_intersecting_elements(burst, triangles, asked), every[every < 300])

"""Penetration and gaps of crumpled sheets: the bounded search against one that measures everything."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from jaxform import molds, shapes
from jaxform.tools import crossings
from jaxform.tools.distances import Distances
from jaxform.tools.gaps import mold_points, widest_gap
from jaxform.tools.mold import Mold, make_mold
from jaxform.tools.penetration import penetration
from jaxform.tools.search import build_grid


def _cup() -> Mold:
    """A thin-walled cup turned of slivers as long as its wall."""
    profile = np.array([[0.0, 0.08], [0.07, 0.08], [0.095, 0.0], [0.1, 0.0], [0.072, 0.083], [0.0, 0.083]])
    shape = molds.revolved(profile=profile, segments=300)
    return make_mold(shape.vertices, shape.triangles)


def _dome() -> Mold:
    angle = np.linspace(0.0, 0.5 * np.pi, 12)
    profile = np.stack([0.1 * np.sin(angle), 0.06 * np.cos(angle)], axis=1)
    shape = molds.revolved(profile=profile, segments=40)
    return make_mold(shape.vertices, shape.triangles)


def _crumple(seed: int, scale: float) -> tuple[NDArray[np.float64], NDArray[np.integer]]:
    sheet = shapes.disc(radius=0.1, elements=150)
    positions = np.array(sheet.positions)
    positions[:, 2] += 0.05 * (1 - (np.hypot(*positions[:, :2].T) / 0.1) ** 2)
    positions += np.random.default_rng(seed).normal(scale=scale, size=positions.shape)
    return positions, sheet.triangles


def _measure_all(
    self: Distances,
    points: NDArray[np.float64],
    measure: Callable[[NDArray[np.int64]], float],
    above: float = 0.0,
    beyond: Any = 0.0,
) -> None:
    if len(points):
        measure(np.arange(len(points)))


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("scale", [0.001, 0.01, 0.05])
@pytest.mark.parametrize("make", [_cup, _dome])
def test_what_is_left_out_is_never_the_deepest_nor_the_widest(
    make: Callable[[], Mold], scale: float, seed: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    mold, (positions, triangles) = make(), _crumple(seed, scale)
    free, unclamped = np.zeros(len(positions), int), np.zeros(len(positions), bool)
    cut = penetration(positions, triangles, free, mold)
    gaps = [widest_gap(positions, triangles, free, unclamped, push, mold) for push in (1.0, -1.0)]
    monkeypatch.setattr(Distances, "search_largest", _measure_all)
    whole = penetration(positions, triangles, free, mold)
    assert (cut.nodes, cut.elements) == (whole.nodes, whole.elements) and whole.elements > 0
    for push, gap in zip((1.0, -1.0), gaps, strict=True):
        every = widest_gap(positions, triangles, free, unclamped, push, mold, places=mold_points(mold))
        assert gap.width == every.width and gap.element == every.element


@pytest.mark.parametrize("make", [_cup, _dome])
def test_elements_as_large_as_the_mold_are_cut_small_only_near_it(
    make: Callable[[], Mold], monkeypatch: pytest.MonkeyPatch
) -> None:
    """All pairs of scattered elements that cut each other are found, and few of their pieces are looked at."""
    counts: list[int] = []
    cut_small = crossings.short_pieces

    def count(*arguments: Any) -> Any:
        found = cut_small(*arguments)
        counts.append(len(found[0]))
        return found

    monkeypatch.setattr(crossings, "short_pieces", count)
    mold, (positions, triangles) = make(), _crumple(0, 0.05)
    corners, grid = positions[triangles], build_grid(np.asarray(mold.vertices, float), np.asarray(mold.triangles))
    walls = np.asarray(mold.vertices, float)[np.asarray(mold.triangles)]
    pairs = [np.stack(part) for part in crossings.near_pairs(corners, walls, grid)]
    piece, triangle = np.concatenate(pairs, axis=1)
    found = set(zip(piece.tolist(), triangle.tolist(), strict=True))
    for element, one in enumerate(corners):
        cut = crossings.intersect(np.broadcast_to(one, walls.shape), walls)
        assert all((element, wall) in found for wall in np.flatnonzero(cut).tolist())
    low = np.asarray(grid.corner)
    everywhere, _ = cut_small(corners, float(grid.reach), low, low + float(grid.width) * np.asarray(grid.shape))
    assert sum(counts) < 0.4 * len(everywhere), (counts, len(everywhere))

"""Depth of a sheet beyond the mold: against winding numbers on closed molds, and where sides are not plain."""

from __future__ import annotations

import functools

import numpy as np
import pytest
import trimesh

import jaxform
from jaxform import molds, shapes
from jaxform.tools.crossings import near_pairs
from jaxform.tools.distances import point_triangle_distance
from jaxform.tools.mold import Mold
from jaxform.tools.penetration import _lattice, element_depths, penetration, resting_directions
from jaxform.tools.search import SearchGrid, build_grid

CLOSED = {
    "ball": lambda: trimesh.creation.icosphere(subdivisions=2),
    "box": lambda: trimesh.creation.box(extents=(1.3, 0.9, 1.0)),
    "pin": lambda: trimesh.creation.cylinder(radius=0.31, height=1.7, sections=24),
    "torus": lambda: trimesh.creation.torus(0.7, 0.3, major_sections=24, minor_sections=12),
    "two balls": lambda: trimesh.util.concatenate(
        [trimesh.creation.icosphere(subdivisions=1, radius=0.4).apply_translation([x, 0.1, 0.0]) for x in (-0.5, 0.5)]
    ),
}


def _winding(points: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """Winding numbers (n,) of points by solid angles (van Oosterom, Strackee 1983)."""
    total = np.zeros(len(points))
    for a, b, c in corners:
        a, b, c = a - points, b - points, c - points
        la, lb, lc = (np.linalg.norm(v, axis=1) for v in (a, b, c))
        dot = [np.einsum("ij,ij->i", p, q) for p, q in ((a, b), (b, c), (c, a))]
        triple = np.einsum("ij,ij->i", a, np.cross(b, c))
        total += 2 * np.arctan2(triple, la * lb * lc + dot[0] * lc + dot[1] * la + dot[2] * lb)
    return total / (4 * np.pi)


def _distance(points: np.ndarray, corners: np.ndarray) -> np.ndarray:
    shape = len(points), len(corners)
    every = point_triangle_distance(np.repeat(points, shape[1], axis=0), np.tile(corners, (shape[0], 1, 1)))
    return every.reshape(shape).min(1)


def _drape(corners: np.ndarray, cells: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A wavy square sheet whose nodes inside of a mold are put up or down onto it: nodes, triangles, walls."""
    line = np.linspace(-1.3, 1.3, cells + 1)
    x, y = (grid.ravel() for grid in np.meshgrid(line, line, indexing="ij"))
    nodes = np.stack([x, y, 0.02 + 0.07 * np.sin(3 * x + y)], axis=1)
    number = np.arange(len(nodes)).reshape(cells + 1, cells + 1)
    a, b, c, d = (part.ravel() for part in (number[:-1, :-1], number[1:, :-1], number[1:, 1:], number[:-1, 1:]))
    wall = np.zeros(len(nodes), int)
    for node in np.flatnonzero(_winding(nodes, corners) > 0.5):
        hits = [(abs(z - nodes[node, 2]), z, t) for t, z in _vertical_hits(nodes[node, :2], corners)]
        _, nodes[node, 2], wall[node] = min(hits)
        wall[node] += 1
    return nodes, np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)]), wall


def _vertical_hits(place: np.ndarray, corners: np.ndarray) -> list[tuple[int, float]]:
    base = corners[:, 0, :2]
    edges = corners[:, 1:, :2] - base[:, None]
    area = edges[:, 0, 0] * edges[:, 1, 1] - edges[:, 0, 1] * edges[:, 1, 0]
    with np.errstate(all="ignore"):
        away = place - base
        g = (away[:, 0] * edges[:, 1, 1] - away[:, 1] * edges[:, 1, 0]) / area
        d = (edges[:, 0, 0] * away[:, 1] - edges[:, 0, 1] * away[:, 0]) / area
        hit = np.flatnonzero((area != 0) & (g >= 0) & (d >= 0) & (g + d <= 1))
    rise = corners[hit, 1:, 2] - corners[hit, :1, 2]
    z = corners[hit, 0, 2] + g[hit] * rise[:, 0] + d[hit] * rise[:, 1]
    return list(zip(hit.tolist(), z.tolist(), strict=True))


def _mold(corners: np.ndarray) -> Mold:
    vertices, index = np.unique(corners.reshape(-1, 3), axis=0, return_inverse=True)
    return jaxform.make_mold(vertices, index.reshape(-1, 3))


@pytest.mark.parametrize("cells", [9, 16])
@pytest.mark.parametrize("name", CLOSED)
def test_depth_on_closed_molds_is_that_of_winding_numbers(name: str, cells: int) -> None:
    """The triangles of the mold turn either way; what a node sticks to knows which."""
    corners = np.asarray(CLOSED[name]().triangles)
    nodes, triangles, wall = _drape(corners, cells)
    assert np.count_nonzero(wall) >= 4
    turned = np.random.default_rng(1).random(len(corners)) < 0.5
    mixed = np.where(turned[:, None, None], corners[:, ::-1], corners)
    found = penetration(nodes, triangles, np.where(turned[np.maximum(wall - 1, 0)], -wall, wall), _mold(mixed))
    assert found.nodes < 1e-12
    points = np.einsum("pc,tck->tpk", _lattice(6), nodes[triangles]).reshape(-1, 3)
    points = np.unique(points.round(9), axis=0)
    points = points[np.abs(points[:, :2]).max(1) < 1.01]
    points = points[_winding(points, corners) > 0.5]
    depth = _distance(points, corners).max()
    assert depth > 1e-3
    np.testing.assert_allclose(found.elements, depth, atol=1e-5)
    np.testing.assert_allclose(_distance(found.place[None], corners), found.elements, rtol=1e-9)
    each, share = element_depths(nodes, triangles, wall, _mold(corners), np.zeros_like(nodes))
    np.testing.assert_allclose(each.max(), found.elements, rtol=1e-9)
    cut = each > 1e-9
    deepest = np.einsum("ec,eck->ek", share, nodes[triangles])[cut]
    assert (_winding(deepest, corners) > 0.5).all()
    np.testing.assert_allclose(_distance(deepest, corners), each[cut], rtol=1e-9)
    assert _winding(found.place[None], corners) > 0.5


@functools.cache
def _flanged_cup(radius: float, upward: float) -> tuple[Mold, SearchGrid]:
    profile = [[0.0, 0.05], [0.9 * radius, 0.05], [radius, 0.0], [0.07, 0.0]]
    shape = molds.revolved(profile=np.array(profile) * [1.0, upward], segments=96)
    return jaxform.make_mold(shape.vertices, shape.triangles), build_grid(shape.vertices, shape.triangles)


@pytest.mark.parametrize("offset", [0.0, 1e-9, -1e-9, 1e-6, -1e-6])
@pytest.mark.parametrize("upward", [1.0, -1.0])
def test_a_free_dome_over_a_flange_in_the_sheet_s_plane_is_not_beyond_the_mold(offset: float, upward: float) -> None:
    """Whatever is said of the side on which the sheet began, where it lies on the flange."""
    sheet = shapes.disc(radius=0.06, element_size=0.006)
    start = sheet.positions + np.array([0.0, 0.0, offset])
    square = (start[:, :2] ** 2).sum(1)
    free, nodes = square < 0.0359**2, start.copy()
    nodes[free, 2] += upward * 0.03 * (1 - square[free] / 0.036**2)
    resting = resting_directions(start, nodes, sheet.triangles, upward)
    assert np.count_nonzero(resting.any(1)) == np.count_nonzero(~free)
    for told in (-1, 0, 1):
        wide, narrow = _flanged_cup(0.0361, upward), _flanged_cup(0.018, upward)
        on_flange = np.flatnonzero(np.asarray(wide[0].vertices)[np.asarray(wide[0].triangles), 2].max(1) == 0)[0]
        wall = np.where(free, 0, told * (on_flange + 1))
        found = penetration(nodes, sheet.triangles, wall, wide[0], grid=wide[1], resting=resting)
        assert max(found.nodes, found.elements) < 2e-6
        # It would be through the flange of a narrower one.
        found = penetration(nodes, sheet.triangles, wall, narrow[0], grid=narrow[1], resting=resting)
        assert min(found.nodes, found.elements) > 0.005


@pytest.mark.parametrize(("stretches", "segments"), [(1, 48), (24, 200)])
def test_elements_are_compared_with_few_triangles_however_many_there_are(stretches: int, segments: int) -> None:
    """A sheet lies on a cone of 96 or 9600 triangles, nine times as many elements at a time."""
    rings = np.linspace(0.02, 0.1, stretches + 1)
    shape = molds.revolved(profile=np.stack([rings, 0.12 - rings], axis=1), segments=segments)
    corners, grid = shape.vertices[shape.triangles], build_grid(shape.vertices, shape.triangles)
    counts = []
    for size in (0.009, 0.003, 0.001):
        sheet = shapes.disc(radius=0.1, element_size=size)
        nodes = sheet.positions + np.array([0.0, 0.0, 0.12])
        nodes[:, 2] -= np.hypot(nodes[:, 0], nodes[:, 1])
        pairs = sum(len(piece) for piece, _ in near_pairs(nodes[sheet.triangles], corners, grid))
        counts.append(pairs / len(sheet.triangles))
    assert counts[0] > counts[1] > counts[2]
    assert counts[2] < 6

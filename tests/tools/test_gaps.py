"""Distance of a sheet from the mold before it, on parts whose gaps are known."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from jaxform import shapes
from jaxform.tools.gaps import NO_GAP, widest_gap
from jaxform.tools.mold import Mold, make_mold
from jaxform.tools.penetration import penetration

SHEET = shapes.rectangle(size=(1.0, 1.0), element_size=0.08)


def _solid(low: list[float], high: list[float]) -> trimesh.Trimesh:
    return trimesh.creation.box(bounds=[low, high])


def _block() -> Mold:
    """A solid block of which four walls and a bottom, at z = 1, surround a pocket that is 1 wide."""
    walls = [
        _solid([-0.4, -0.4, 0.0], [0.0, 1.4, 1.3]),
        _solid([1.0, -0.4, 0.0], [1.4, 1.4, 1.3]),
        _solid([0.0, -0.4, 0.0], [1.0, 0.0, 1.3]),
        _solid([0.0, 1.0, 0.0], [1.0, 1.4, 1.3]),
        _solid([0.0, 0.0, 1.0], [1.0, 1.0, 1.3]),
    ]
    finer = [wall.subdivide() for wall in walls]
    vertices = np.concatenate([wall.vertices for wall in finer])
    first = np.cumsum([0, *(len(wall.vertices) for wall in finer[:-1])])
    faces = np.concatenate([wall.faces + start for wall, start in zip(finer, first, strict=True)])
    return make_mold(vertices, faces.astype(np.int32))


def _lying_at(height: float) -> np.ndarray:
    positions = np.array(SHEET.positions)
    positions[:, 2] = height
    return positions


@pytest.mark.parametrize("height", [0.3, 0.9])
def test_a_flat_sheet_over_the_bottom_of_a_pocket(height: float) -> None:
    positions = _lying_at(height)
    # Clear of the walls, on which it would lie.
    positions[:, :2] = 0.5 + 0.99 * (positions[:, :2] - 0.5)
    free = np.zeros(len(positions), int)
    clamped = np.zeros(len(positions), bool)
    found = widest_gap(positions, SHEET.triangles, free, clamped, 2.0, _block())
    # The bottom's corners are a little farther away than the sheet is high; what is outside of the block is hidden.
    assert 1.0 - height <= found.width <= np.hypot(1.0 - height, 0.01 * np.sqrt(0.5)) + 1e-12
    assert found.place[2] == 1.0
    assert np.linalg.norm(positions[SHEET.triangles[found.element], :2].mean(0) - found.place[:2]) < 0.2
    # Pushed the other way it has nothing before it.
    assert widest_gap(positions, SHEET.triangles, free, clamped, -2.0, _block()) == NO_GAP
    # Nor does it look from its clamped edge.
    whole = widest_gap(positions, SHEET.triangles, free, ~clamped, 2.0, _block())
    assert whole == NO_GAP


def test_what_is_beside_a_sheet_is_no_gap() -> None:
    plate = _solid([1.5, 0.0, -0.5], [2.5, 1.0, 0.7])
    mold = make_mold(np.asarray(plate.vertices), np.asarray(plate.faces, np.int32))
    none = np.zeros(len(SHEET.positions), int)
    assert widest_gap(_lying_at(0.0), SHEET.triangles, none, none > 0, 1.0, mold) == NO_GAP


def _angle() -> Mold:
    """A floor in z = 0, normals +z, and a wall in x = 0, normals +x, whose common edge has a corner in its middle."""
    vertices = np.array([[x, y, z] for x, z in ((0, 0), (1, 0), (0, 1)) for y in (0.0, 0.5, 1.0)], float)
    floor = [[k, k + 3, k + 4] for k in range(2)] + [[k, k + 4, k + 1] for k in range(2)]
    wall = [[k, k + 1, k + 7] for k in range(2)] + [[k, k + 7, k + 6] for k in range(2)]
    return make_mold(vertices, np.array(floor + wall, np.int32))


@pytest.mark.parametrize("sharp", [False, True])
def test_an_edge_that_elements_span_is_a_gap_or_a_cut(sharp: bool) -> None:
    """A square whose elements stick to both walls of an angle, half a diagonal from its edge.

    Pushed into the angle it bridges it; pushed over the edge from the other side it is beyond both walls.
    """
    nodes = np.array([[0.4, 0.3, 0.0], [0.4, 0.7, 0.0], [0.0, 0.7, 0.4], [0.0, 0.3, 0.4]])
    triangles, wall = np.array([[0, 1, 2], [0, 2, 3]]), np.array([1, 2, 6, 5])
    # The sheet's normals point away from the edge.
    push, side = (1.0, -1) if sharp else (-1.0, 1)
    gap = widest_gap(nodes, triangles, side * wall, np.zeros(4, bool), push, _angle())
    cut = penetration(nodes, triangles, side * wall, _angle()).elements
    if sharp:
        assert gap.width < 1e-9 and cut == pytest.approx(0.2, rel=1e-9)
    else:
        assert gap.width == pytest.approx(0.4 * np.sqrt(0.5), rel=1e-9) and cut == 0.0
        np.testing.assert_allclose(gap.place, [0.0, 0.5, 0.0], atol=1e-12)


def test_an_eye_that_another_wall_parts_from_its_node_sees_nothing() -> None:
    """A sheet that folds from a rib onto the wall of a round hole: it must not look out of the block from within it."""
    ring = trimesh.creation.annulus(r_min=1.0, r_max=3.0, height=1.0, sections=12)
    inner = ring.vertices[np.abs(np.linalg.norm(ring.vertices[:, :2], axis=1) - 1.0) < 1e-9, :2]
    at_wall = inner[0]
    next_one = min(inner, key=lambda place: abs(np.cross([*at_wall, 0], [*place, 0])[2] - np.sin(np.pi / 6)))
    half = np.array([0.0, 0.0, 0.5])

    def edge(place: np.ndarray, half: np.ndarray) -> np.ndarray:
        return np.append(place, 0.0) + np.array([-half, half])

    rib = np.concatenate([edge(0.5 * at_wall, half), edge(at_wall, half)])
    faces = np.concatenate([ring.faces, len(ring.vertices) + np.array([[0, 2, 3], [0, 3, 1]])])
    mold = make_mold(np.concatenate([ring.vertices, rib]), faces.astype(np.int32))
    on_wall = at_wall + 0.3 * (next_one - at_wall)
    nodes = np.concatenate([edge(place, 0.4 * half) for place in (0.9 * at_wall, 0.99 * at_wall, on_wall)])
    triangles = np.array([[0, 2, 3], [0, 3, 1], [2, 4, 5], [2, 5, 3]])
    middle = np.array([*on_wall, 0.0])
    normals, centers = np.asarray(ring.face_normals), ring.triangles_center
    facet = np.argmin(np.linalg.norm(centers - middle, axis=1) + 10 * (normals @ -middle < 0.5))
    # The rib's normal points away from the side on which the sheet lies; pressure acts towards the rib and the wall.
    walls = np.array([-(1 + len(ring.faces))] * 4 + [1 + facet] * 2)
    found = widest_gap(nodes, triangles, walls, walls == 0, 1.0, mold)
    assert found.width < 0.05, found

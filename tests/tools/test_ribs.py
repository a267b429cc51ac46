"""Ribs and pins between the nodes of a sheet, which it passes through; and edges of the mold, which are no ribs."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

import jaxform
from jaxform.tools.crossings import Ways
from jaxform.tools.penetration import Penetration, penetration
from jaxform.tools.ribs import Ribs, find_ribs
from jaxform.tools.search import build_grid

Array = NDArray[np.float64]
Integers = NDArray[np.integer]

_FLOOR = np.array([[-1.0, -1.0, 0.0], [1.0, -1.0, 0.0], [1.0, 1.0, 0.0], [-1.0, 1.0, 0.0]])


def _block(low: tuple[float, float, float], high: tuple[float, float, float], draft: float = 0.0) -> Array:
    """Triangles (12, 3, 3) of a box, narrower at its top by a draft on each side."""
    corner = np.array([[(low, high)[i][0], (low, high)[j][1], (low, high)[k][2]] for i, j, k in np.ndindex(2, 2, 2)])
    middle = 0.5 * (np.array(low) + np.array(high))[:2]
    upper = corner[:, 2] == high[2]
    corner[upper, :2] -= draft * np.sign(corner[upper, :2] - middle)
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    return np.array([corner[list(t)] for q in quads for t in ((q[0], q[1], q[2]), (q[0], q[2], q[3]))])


def _sheet(divisions: int = 8) -> tuple[Array, Integers]:
    """A square of side 1.6 on the floor; its elements have sides of 0.2 and diagonals."""
    x, y = np.meshgrid(*2 * [np.linspace(-0.8, 0.8, divisions + 1)], indexing="ij")
    k = np.arange((divisions + 1) ** 2).reshape(divisions + 1, -1)
    a, b, c, d = k[:-1, :-1].ravel(), k[1:, :-1].ravel(), k[1:, 1:].ravel(), k[:-1, 1:].ravel()
    return np.stack([x.ravel(), y.ravel(), 0 * x.ravel()], 1), np.concatenate([np.c_[a, b, c], np.c_[a, c, d]])


def _penetration(*blocks: Array, lying: bool = True, turn: bool = False) -> Penetration:
    """Penetration of a sheet that lies, from above, on a floor of which blocks stand up."""
    walls = np.concatenate([_FLOOR[[[0, 1, 2], [0, 2, 3]]], *blocks])
    if turn:
        walls[1::2] = walls[1::2, ::-1]
    mold = jaxform.make_mold(walls.reshape(-1, 3), np.arange(3 * len(walls)).reshape(-1, 3))
    positions, triangles = _sheet()
    number = 1 + (positions[:, 1] > positions[:, 0]) * 1
    # The floor's second triangle may be turned: what sticks to it came from the side of its back.
    wall = np.where((number == 2) & turn, -number, number)
    return penetration(positions, triangles, wall if lying else 0 * wall, mold)


@pytest.mark.parametrize(
    ("width", "height", "draft"), [(0.002, 0.5, 0.0), (0.05, 0.3, 0.0), (0.15, 0.4, 0.0), (0.05, 0.3, 0.015)]
)
@pytest.mark.parametrize("turn", [False, True])
def test_a_rib_between_the_nodes_is_as_high_as_it_is(width: float, height: float, draft: float, turn: bool) -> None:
    rib = _block((0.1 - width / 2, -0.75, -0.1), (0.1 + width / 2, 0.75, height), draft)
    found = _penetration(rib, turn=turn)
    # Eight elements beside each other along it, with a side and a diagonal each; the ends are between nodes too.
    assert 12 <= found.ribs.count <= 17
    np.testing.assert_allclose(found.ribs.height, height, rtol=0.02)
    assert found.deepest == found.ribs.height > found.elements
    assert abs(found.ribs.place[0] - 0.1) < width and abs(found.ribs.place[2]) < 1e-5
    assert 0.9 * (width - 2 * draft) < found.ribs.width < 1.6 * width


def test_a_pin_within_an_element_is_found_by_the_edges_that_come_through() -> None:
    found = _penetration(_block((0.13, 0.05, -0.1), (0.15, 0.07, 0.6)))
    assert found.ribs.count == 1
    np.testing.assert_allclose(found.ribs.height, 0.6, rtol=1e-3)
    np.testing.assert_allclose(found.ribs.place, [0.14, 0.06, 0.0], atol=5e-3)


def _rises_between(away: Array, *, noise: float = 0.0) -> Ribs:
    """Ribs, or noise, that a sheet on the floor passed through, whose nodes have directions off the mold (3,).

    The rib is 0.05 wide and 0.3 high.
    """
    rib = _block((0.075, -0.75, -0.1), (0.125, 0.75, 0.3))
    if noise:
        bumps = [(x, y) for x in np.arange(-0.69, 0.7, 0.2) for y in np.arange(-0.69, 0.7, 0.1)]
        rib = np.concatenate([_block((x, y, -0.1), (x + 0.004, y + 0.06, noise)) for x, y in bumps])
    walls = np.concatenate([_FLOOR[[[0, 1, 2], [0, 2, 3]]], rib])
    mold = jaxform.make_mold(walls.reshape(-1, 3), np.arange(3 * len(walls)).reshape(-1, 3))
    positions, triangles = _sheet()
    positions = positions + np.array([0.0, 0.0, 1e-6])
    corners = np.asarray(mold.vertices, float)[np.asarray(mold.triangles)]
    grid = build_grid(np.asarray(mold.vertices, float), np.asarray(mold.triangles))
    ways = Ways(triangles, positions[triangles], corners, grid)
    sticks = np.ones(len(positions), bool)
    return find_ribs(positions, np.tile(away / np.linalg.norm(away), (len(positions), 1)), sticks, ways)


def test_the_lid_of_a_bottle_at_the_rim_of_a_parison_is_no_pin() -> None:
    """The clamped ring of a tube lies in the lid of a closed bottle: a fan of its edges ends at each of its sides."""

    def circle(radius: float, count: int, z: float, turned: float = 0.0) -> Array:
        angle = 2 * np.pi * np.arange(count) / count + turned
        return np.stack([radius * np.cos(angle), radius * np.sin(angle), np.full(count, z)], axis=1)

    around, k = circle(0.01, 96, 0.2), np.arange(12)
    beside, below = np.roll(around, -1, axis=0), around - [0.0, 0.0, 0.03]
    neck = [(around, below, beside), (beside, below, np.roll(below, -1, axis=0))]
    lid = np.concatenate([np.stack(one, axis=1) for one in ((around, beside, np.tile([0, 0, 0.2], (96, 1))), *neck)])
    following = (k + 1) % 12
    triangles = np.concatenate([np.c_[k, following, following + 12], np.c_[k, following + 12, k + 12]])
    mold = jaxform.make_mold(lid.reshape(-1, 3), np.arange(3 * len(lid)).reshape(-1, 3))
    grid = build_grid(np.asarray(mold.vertices, float), np.asarray(mold.triangles))
    cut = 0
    # Rounding decides which edges seem to come through.
    for turned in np.linspace(0.0, 0.5, 40):
        lower = circle(0.0099998, 12, 0.1963, turned)
        positions = np.concatenate([circle(0.00749, 12, 0.2, turned), lower])
        ways = Ways(triangles, positions[triangles], lid, grid)
        inwards = -positions * [1.0, 1.0, 0.0] / np.linalg.norm(positions[:, :2], axis=1, keepdims=True)
        assert find_ribs(positions, inwards, np.ones(24, bool), ways).count == 0
        cut += len(ways.element)
    assert cut > 0


@pytest.mark.parametrize("along", [0.0, 0.6, 2.0])
def test_a_rib_is_measured_square_to_the_sheet_where_nodes_look_along_it(along: float) -> None:
    """Some nodes beside the end of a rib stick to it, and the way off the mold leads along the rib."""
    found = _rises_between(np.array([0.3, along, 1.0]))
    assert 12 <= found.count <= 17
    np.testing.assert_allclose(found.height, 0.3, rtol=1e-3)


def test_a_rib_that_leans_is_as_high_as_its_top_is_above_the_sheet() -> None:
    rib = _block((0.075, -0.75, -0.1), (0.125, 0.75, 0.3))
    rib[..., 0] += 0.5 * (rib[..., 2] - 0.0)
    found = _penetration(rib)
    assert found.ribs.count >= 12
    np.testing.assert_allclose(found.ribs.height, 0.3, rtol=0.02)


def _beside(block: Array, pull: Array | None) -> Ribs:
    """Ribs that a sheet on a wall, x = 0, passed through where a block comes out of that."""
    wall = np.array([[0.0, -1.0, 0.0], [0.0, 1.0, 0.0], [0.0, 1.0, 2.0], [0.0, -1.0, 2.0]])[[[0, 1, 2], [0, 2, 3]]]
    walls = np.concatenate([wall, block])
    mold = jaxform.make_mold(walls.reshape(-1, 3), np.arange(3 * len(walls)).reshape(-1, 3))
    flat, triangles = _sheet()
    sheet = np.column_stack([0.0 * flat[:, 0], flat[:, 1], 0.9 + flat[:, 0]])
    return penetration(sheet, triangles, 1 + (sheet[:, 2] > 1 + sheet[:, 1]), mold, pull=pull).ribs


def test_a_rib_that_runs_into_a_wall_is_as_high_as_it_is_above_the_floor() -> None:
    rib, up = _block((-0.1, 0.05, -0.1), (1.5, 0.1, 0.3)), np.array([0.0, 0.0, 1.0])
    np.testing.assert_allclose(_beside(rib, None).height, 1.5, rtol=1e-3)
    assert _beside(rib, up).height <= 0.3


def test_a_ridge_up_a_wall_is_as_high_as_it_stands_off_it() -> None:
    ridge, up = _block((-0.1, 0.05, -0.1), (0.3, 0.1, 1.9)), np.array([0.0, 0.0, 1.0])
    for pull in (None, up):
        found = _beside(ridge, pull)
        assert found.count >= 8
        np.testing.assert_allclose(found.height, 0.3, rtol=1e-3)


def test_noise_that_is_far_lower_than_an_element_is_wide_is_no_rib() -> None:
    """Bumps of a scan are as high as they are wide, and make no wall thinner."""
    up = np.array([0.0, 0.0, 1.0])
    assert _rises_between(up, noise=0.008).count == 0
    assert _rises_between(up, noise=0.08).count > 20


def test_what_is_lower_than_it_is_wide_or_below_the_sheet_is_no_rib() -> None:
    assert _penetration(_block((0.02, -0.75, -0.1), (0.18, 0.75, 0.05))).ribs.count == 0
    assert _penetration(_block((0.08, -0.75, -0.3), (0.12, 0.75, -0.01))).ribs.count == 0
    assert _penetration().ribs.count == 0


def test_a_convex_edge_that_elements_cut_is_no_rib() -> None:
    """A sheet over a right-angled edge, and over the ridge of a roof, with nodes on both faces."""
    positions, triangles = _sheet()
    for fall in (np.inf, 1.5, 0.7):
        # It lies on the floor where x < 0.1 and on the face beyond it, which falls so steeply; it cuts the edge there.
        beyond = np.maximum(positions[:, 0] - 0.1, 0.0)
        x, z = np.minimum(positions[:, 0], 0.1), -beyond
        if np.isfinite(fall):
            scale = 1 / np.hypot(1, fall)
            x, z = x + beyond * scale, -beyond * scale * fall
        sheet = np.stack([x, positions[:, 1], z], axis=1)
        down = np.array([0.0, 0.0, -2.0]) if not np.isfinite(fall) else np.array([2.0, 0.0, -2.0 * fall])
        edge = np.array([[0.1, -2.0, 0.0], [0.1, 2.0, 0.0]])
        back = np.array([-3.0, 0.0, 0.0])
        faces = np.array(
            [
                [edge[0] + back, edge[0], edge[1]],
                [edge[0] + back, edge[1], edge[1] + back],
                [edge[0], edge[0] + down, edge[1] + down],
                [edge[0], edge[1] + down, edge[1]],
            ]
        )
        mold = jaxform.make_mold(faces.reshape(-1, 3), np.arange(12).reshape(-1, 3))
        normal = np.cross(faces[:, 1] - faces[:, 0], faces[:, 2] - faces[:, 0])
        assert (normal[:, 2] >= -1e-12).all()
        wall = np.where(positions[:, 0] < 0.1, 1, 3)
        found = penetration(sheet, triangles, wall, mold)
        assert found.elements > 0.01, fall
        assert found.ribs.count == 0, (fall, found)

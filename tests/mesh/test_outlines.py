"""Sheets of any planform: they cover the polygon once and can move everywhere; bad polygons are told with the place."""

import numpy as np
import pytest

from jaxform.core.errors import InputError
from jaxform.mesh import bisection, outlines, shapes, topology
from jaxform.mesh.shapes import Sheet

pytestmark = pytest.mark.quick

L_SHAPE = [[0.0, 0.0], [0.2, 0.0], [0.2, 0.1], [0.1, 0.1], [0.1, 0.2], [0.0, 0.2]]


def areas(sheet: Sheet) -> np.ndarray:
    corner = sheet.positions[sheet.triangles]
    normal = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    np.testing.assert_array_equal(normal[:, :2], 0.0)
    return 0.5 * normal[:, 2]


def angles(sheet: Sheet) -> np.ndarray:
    corner = sheet.positions[sheet.triangles]
    side = np.roll(corner, -1, axis=1) - corner
    unit = side / np.linalg.norm(side, axis=2, keepdims=True)
    return np.degrees(np.arccos(np.clip(-np.einsum("tki,tki->tk", unit, np.roll(unit, 1, axis=1)), -1, 1)))


def check_moves(sheet: Sheet) -> None:
    """The edge is clamped, and no other edge joins two clamped nodes: each element has a node that moves."""
    edge, count = topology.edges(sheet.triangles)
    np.testing.assert_array_equal(np.flatnonzero(sheet.clamped), topology.boundary_nodes(sheet.triangles))
    assert not sheet.clamped[edge[count == 2]].all(1).any()


def circle(corners: int, radius: float = 0.1) -> np.ndarray:
    turn = 2 * np.pi * np.arange(corners) / corners
    return radius * np.stack([np.cos(turn), np.sin(turn)], axis=1)


def star() -> np.ndarray:
    points = circle(10)
    points[1::2] *= 0.3
    return points


def comb() -> np.ndarray:
    teeth = [[[3 * k, 10], [3 * k + 1, 10], [3 * k + 1, 2], [3 * k + 3, 2]] for k in range(4)]
    return 0.01 * np.array([*np.concatenate(teeth), [12, 0], [0, 0]], float)


NECK = 0.1 * np.array(
    [[0, 0], [1, 0], [1, 0.46], [2, 0.46], [2, 0], [3, 0], [3, 1], [2, 1], [2, 0.54], [1, 0.54], [1, 1], [0, 1]]
)
NEEDLE = np.where(abs(NECK - 0.05) < 0.005, 0.05 + 0.02 * (NECK - 0.05), NECK)
SLIT = 0.1 * np.array([[0, 0], [2, 0], [2, 1], [1.01, 1], [1, 0.2], [0.99, 1], [0, 1]])
STEP = 0.1 * np.array([[0, 0], [1, 0], [1, 1e-5], [2, 1e-5], [2, 1], [0, 1]])


@pytest.mark.parametrize(
    ("polygon", "least_angle"),
    [(L_SHAPE, 25), (L_SHAPE[::-1], 25), (star(), 15), (comb(), 15), (NECK, 15), (SLIT, 10), (STEP, 25)],
)
def test_a_polygon_is_covered_once_and_can_move(polygon, least_angle):
    sheet = shapes.outline(polygon=polygon, element_size=0.01)
    whole = abs(outlines.area(np.array(polygon)))
    # The star's tips of 23 degrees end where they are narrower than a third of an element.
    np.testing.assert_allclose(areas(sheet).sum(), whole, rtol=0.02 if len(polygon) == 10 else 1e-4)
    assert areas(sheet).min() > 0 and angles(sheet).min() > least_angle
    check_moves(sheet)


def test_corners_on_a_line_and_repeated_ones_change_nothing():
    plain = shapes.outline(polygon=L_SHAPE, element_size=0.02)
    more = [L_SHAPE[0], [0.05, 0.0], [0.1, 0.0], *L_SHAPE[1:3], L_SHAPE[2], *L_SHAPE[3:], L_SHAPE[0]]
    same = shapes.outline(polygon=more, element_size=0.02)
    np.testing.assert_array_equal(same.positions, plain.positions)
    np.testing.assert_array_equal(same.triangles, plain.triangles)


def test_many_corners_make_no_small_elements_and_refinement_goes_to_them():
    polygon = circle(5000)
    sheet = shapes.outline(polygon=polygon, elements=150)
    assert 120 < len(sheet.triangles) < 200
    check_moves(sheet)
    forest = bisection.build_forest(
        sheet.positions, sheet.triangles, 4, clamped=sheet.clamped, fixed=sheet.fixed, snap=sheet.snap
    )
    np.testing.assert_allclose(np.linalg.norm(forest.positions[forest.clamped], axis=1), 0.1, rtol=1e-6)


def test_a_polygon_that_is_cut_at_symmetry_planes_is_free_there():
    # A rounding error off the plane, as files have it, and two corners where the planes meet.
    quarter = [[1e-8, 0.0], [0.1, 0.0], [0.1, 0.05], [0.05, 0.1], [-1e-10, 0.1], [0.0, 2e-8]]
    sheet = shapes.outline(polygon=quarter, element_size=0.01, planes=["x", "y"])
    x, y, _ = sheet.positions.T
    np.testing.assert_array_equal(sheet.fixed, np.stack([x == 0, y == 0, np.zeros(len(x), bool)], axis=1))
    on_rim = np.isclose(x, 0.1) | np.isclose(y, 0.1) | np.isclose(x + y, 0.15)
    np.testing.assert_array_equal(sheet.clamped, on_rim)
    np.testing.assert_allclose(areas(sheet).sum(), 0.1**2 - 0.05**2 / 2, rtol=1e-6)
    forest = bisection.build_forest(
        sheet.positions, sheet.triangles, 2, clamped=sheet.clamped, fixed=sheet.fixed, snap=sheet.snap
    )
    assert forest.fixed.sum() > sheet.fixed.sum()
    np.testing.assert_array_equal(forest.positions[forest.fixed], 0.0)


@pytest.mark.parametrize(
    ("polygon", "words"),
    [
        ([[0, 0], [0.1, 0.1], [0.1, 0], [0, 0.1]], "crosses or touches itself at (0.05, 0.05)"),
        ([[0, 0], [0.2, 0], [0.2, 0.1], [0.1, 0], [0, 0.1]], "crosses or touches itself at (0.1, 0)"),
        (
            [[0, 0], [0.1, 0], [0.1, 0.1], [0.1, 0.05], [0.1, 0.2], [0, 0.2]],
            "crosses or touches itself at (0.1, 0.075)",
        ),
        ([[0, 0], [0.1, 0], [0.2, 0]], "encloses no area"),
        ([[0, 0], [0.1, 0], [0.1, np.nan]], "is not a list of points"),
        ([[0, 0], [1]], "is not a list of points"),
        (NEEDLE, "much narrower than an element (0.01 m)"),
    ],
)
def test_bad_polygons_are_refused(polygon, words):
    with pytest.raises(InputError) as told:
        shapes.outline(polygon=polygon, element_size=0.01)
    assert words in str(told.value) and "parison.polygon" in str(told.value)


def test_sizes_that_do_not_fit_are_refused():
    with pytest.raises(InputError, match="larger than the shape"):
        shapes.outline(polygon=L_SHAPE, element_size=0.3)
    with pytest.raises(InputError, match="not a possible number"):
        shapes.outline(polygon=L_SHAPE, elements=1)
    with pytest.raises(InputError, match="both sides of x = 0"):
        shapes.outline(polygon=np.array(L_SHAPE) - [0.1, 0.0], element_size=0.02, planes=["x"])


def test_shapes_round_points():
    turned = outlines.OrientedRectangle(np.array([0.3, -0.2]), np.array([0.2, 0.1]), 0.4)
    corners = turned.corner + np.array([[0, 0], [1, 0], [1, 1], [0, 1]]) * turned.sides @ turned.axes
    found = outlines.smallest_rectangle(outlines.hull(corners))
    np.testing.assert_allclose(found.corner, turned.corner, atol=1e-9)
    np.testing.assert_allclose([*found.sides, found.angle], [*turned.sides, turned.angle], atol=1e-9)
    around = outlines.smallest_circle(circle(7) + np.array([2.0, 3.0]))
    np.testing.assert_allclose([*around.center, around.radius], [2.0, 3.0, 0.1], atol=1e-4)


def test_a_contour_follows_the_values():
    x, y = np.meshgrid(np.arange(60) + 0.5, np.arange(50) + 0.5)
    line = outlines.contour(15.0**2 - (x - 30) ** 2 - (y - 25) ** 2, np.array([1.0, 2.0]), 0.1)
    np.testing.assert_allclose(np.linalg.norm(line - [4.0, 4.5], axis=1), 1.5, rtol=2e-3)
    np.testing.assert_allclose(outlines.area(line), np.pi * 1.5**2, rtol=5e-3)

"""Shapes of molds: revolved profiles, a user's mesh turned and moved, bad input."""

import math
from itertools import pairwise

import numpy as np
import pytest

from jaxform import shapes
from jaxform.core.errors import InputError
from jaxform.mesh import topology
from jaxform.mesh.meshes import Mesh
from jaxform.tools.molds import bottle_half, box_insert, divided, from_mesh, revolved

pytestmark = pytest.mark.quick

CUP = [[0.0, 0.05], [0.055, 0.05], [0.1, 0.0]]
BOX = Mesh(
    np.array([[x, y, z] for x in (0, 1) for y in (0, 2) for z in (0, 3)], float),
    np.array([[0, 1, 3], [0, 3, 2], [0, 4, 5], [0, 5, 1], [0, 2, 6], [0, 6, 4]], np.int32),
)


def area(mold) -> float:
    corner = mold.vertices[mold.triangles]
    return float(np.linalg.norm(np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]), axis=1).sum() / 2)


def characteristic(mold) -> int:
    return len(mold.vertices) - len(topology.edges(mold.triangles)[0]) + len(mold.triangles)


def frustum(points) -> float:
    """Area of the revolved profile (Pappus)."""
    return sum(math.pi * (a[0] + b[0]) * math.dist(a, b) for a, b in pairwise(points))


def test_cup():
    mold = revolved(profile=CUP, segments=12)
    assert mold.vertices.shape == (25, 3) and mold.triangles.shape == (36, 3)
    assert mold.vertices.dtype == np.float64 and mold.triangles.dtype == np.int32 and mold.dropped == 0
    assert characteristic(mold) == 1
    assert len(topology.inconsistent_edges(mold.triangles)) == 0 == len(topology.nonmanifold_edges(mold.triangles))
    r = np.hypot(mold.vertices[:, 0], mold.vertices[:, 1])
    np.testing.assert_allclose(r, [0, *[0.055] * 12, *[0.1] * 12], rtol=1e-15)
    np.testing.assert_array_equal(mold.vertices[:, 2], [0.05] * 13 + [0.0] * 12)
    np.testing.assert_array_equal(mold.vertices[[1, 13]], [[0.055, 0, 0.05], [0.1, 0, 0]])
    rim = topology.boundary_nodes(mold.triangles)
    np.testing.assert_array_equal(rim, np.arange(13, 25))


@pytest.mark.parametrize("points", [CUP, [[0.02, 0.0], [0.05, 0.3]], [[0, 0], [1, 0.5], [0, 1]]])
def test_area_converges_with_order_two(points):
    error = [frustum(points) - area(revolved(profile=points, segments=n)) for n in (16, 32, 64)]
    order = np.log2(np.array(error[:-1]) / error[1:])
    assert np.all(np.abs(order - 2) < 0.05), order


def test_normals_of_a_profile_that_runs_outwards_point_up():
    mold = revolved(profile=[[0, 0], [1, 0], [2, 0]], segments=7)
    corner = mold.vertices[mold.triangles]
    assert np.all(np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])[:, 2] > 0)


def test_open_and_closed_profiles():
    tube = revolved(profile=[[0.02, 0.0], [0.02, 0.3]], segments=10)
    assert characteristic(tube) == 0 and len(topology.boundary_edges(tube.triangles)) == 20
    spindle = revolved(profile=[[0, 0], [1, 0.5], [0, 1]], segments=3)
    assert spindle.triangles.shape == (6, 3) and len(spindle.vertices) == 5
    assert topology.is_closed(spindle.triangles) and characteristic(spindle) == 2


@pytest.mark.parametrize(
    ("profile", "problem"),
    [
        ([], "list of points"),
        ([[0, 1]], "has 1 points"),
        ([[0, 1], [-0.1, 0]], "negative radius"),
        ([[0, 1], [0.1, 1], [0.1, 1]], "point twice"),
        ([[0, 1], [0, 2], [1, 2]], "along the axis"),
        ([[0, 1], [1, math.nan]], "list of points"),
        ([[0, 1, 2], [1, 2, 3]], "list of points"),
        ([[0, 1], [1]], "list of points"),
        ("cup", "list of points"),
    ],
)
def test_bad_profiles(profile, problem):
    with pytest.raises(InputError, match=problem) as caught:
        revolved(profile=profile, segments=12)
    assert caught.value.key == "mold.profile" and caught.value.value == profile and caught.value.remedy


@pytest.mark.parametrize("segments", [2, 0, -5, 3.5, math.nan, "12", True, 10**6])
def test_bad_segments(segments):
    with pytest.raises(InputError) as caught:
        revolved(profile=CUP, segments=segments)
    assert caught.value.key == "mold.segments" and caught.value.remedy


def test_from_mesh_turns_about_x_then_y_then_z_and_then_moves():
    mesh = Mesh(np.array([[1, 2, 3], [4, 0, 0], [0, 5, 0.0]]), np.array([[0, 1, 2]], np.int32))
    mold = from_mesh(mesh, rotate=(90, 0, 90), translate=(10, 20, 30))
    # About x: (x, -z, y); about z after it: (z, x, y).
    np.testing.assert_array_equal(mold.vertices, [[13, 21, 32], [10, 24, 30], [10, 20, 35]])
    mold = from_mesh(mesh, rotate=(0, 90, 0))
    np.testing.assert_array_equal(mold.vertices, [[3, 2, -1], [0, 0, -4], [0, 5, 0]])


def test_rotation_by_any_angles_keeps_lengths_and_hand():
    ball = shapes.sphere(radius=1.0, elements=50)
    mold = from_mesh(Mesh(ball.positions, ball.triangles), rotate=(12, -34, 156.7))
    np.testing.assert_allclose(mold.vertices @ mold.vertices.T, ball.positions @ ball.positions.T, atol=1e-14)
    corner = mold.vertices[mold.triangles]
    assert np.all(np.linalg.det(corner) > 0)


def test_from_mesh_welds_and_counts_what_it_drops():
    corners = BOX.positions[BOX.triangles].reshape(-1, 3)
    bad = [[0, 0, 0], [1, 0, 0], [0.5, 0, 0]]
    soup = np.concatenate([corners, bad, corners[:3]])
    mold = from_mesh(Mesh(soup, np.arange(len(soup), dtype=np.int32).reshape(-1, 3)))
    assert mold.dropped == 2
    assert len(mold.vertices) == 7 and mold.triangles.shape == (6, 3)
    assert area(mold) == pytest.approx(2 * 3 + 1 * 3 + 1 * 2)


def test_nothing_left():
    flat = Mesh(np.zeros((3, 3)), np.array([[0, 1, 2]], np.int32))
    with pytest.raises(InputError, match="none of its 1 triangles has an area") as caught:
        from_mesh(flat)
    assert caught.value.key == "mold.path"


@pytest.mark.parametrize("values", [(1, 2), (1, 2, math.nan), "abc", 3.0, None, (1, 2, "x")])
@pytest.mark.parametrize("option", ["translate", "rotate"])
def test_bad_translate_and_rotate(option, values):
    with pytest.raises(InputError) as caught:
        from_mesh(BOX, **{option: values})
    assert caught.value.key == f"mold.{option}" and caught.value.remedy


def test_box_with_insert_is_the_paper_s_26_triangles():
    mold = box_insert(size=[0.3, 0.2], depth=0.08, insert_size=[0.12, 0.08], insert_height=0.04)
    assert mold.triangles.shape == (26, 3)
    walls, insert_walls = 2 * (0.3 + 0.2) * 0.08, 2 * (0.12 + 0.08) * 0.04
    assert area(mold) == pytest.approx(0.3 * 0.2 + walls + insert_walls)
    assert characteristic(mold) == 1 and len(topology.inconsistent_edges(mold.triangles)) == 0
    rim = mold.vertices[topology.boundary_nodes(mold.triangles)]
    np.testing.assert_allclose(
        sorted(map(tuple, rim)), [(0, 0, 0), (0, 0.2, 0), (0.3, 0, 0), (0.3, 0.2, 0)], atol=1e-15
    )
    np.testing.assert_allclose(mold.vertices.max(0), [0.3, 0.2, 0.08])


def test_draft_leans_the_walls_back():
    mold = box_insert(draft=10.0)
    slope = math.tan(math.radians(10.0))
    floor = mold.vertices[np.isclose(mold.vertices[:, 2], 0.08)]
    top = mold.vertices[np.isclose(mold.vertices[:, 2], 0.04)]
    assert floor[:, 0].min() == pytest.approx(0.08 * slope)
    assert np.ptp(top[:, 0]) == pytest.approx(0.12 - 2 * 0.04 * slope)


def test_divided_keeps_the_surface_and_its_connections():
    mold = box_insert()
    finer = divided(mold, 3)
    assert len(finer.triangles) == 9 * 26 and area(finer) == pytest.approx(area(mold))
    assert characteristic(finer) == 1 and len(topology.inconsistent_edges(finer.triangles)) == 0
    assert divided(mold, 1) is mold


def test_bottle_has_a_handle_with_a_hole_and_the_size_it_is_asked_for():
    mold = bottle_half()
    assert 1150 <= len(mold.triangles) <= 1280
    assert characteristic(mold) == 0  # a disc with one hole
    assert len(topology.inconsistent_edges(mold.triangles)) == 0 == len(topology.nonmanifold_edges(mold.triangles))
    np.testing.assert_allclose(mold.vertices.min(0), [-0.04, 0.0, 0.0], atol=1e-4)
    np.testing.assert_allclose(mold.vertices.max(0)[:2], [0.04, 0.23], atol=1e-4)
    assert 0.036 < mold.vertices[:, 2].max() < 0.041
    # A ray through the hole meets nothing, one through the grip does.
    corner = mold.vertices[mold.triangles][..., :2]
    assert not covers(corner, [0.41 * 0.04, 0.66 * 0.23]) and covers(corner, [0.032, 0.66 * 0.23])


def covers(corner: np.ndarray, point: list[float]) -> bool:
    a, b, c = np.moveaxis(corner, 1, 0)
    turn = [(q[:, 0] - p[:, 0]) * (point[1] - p[:, 1]) - (q[:, 1] - p[:, 1]) * (point[0] - p[:, 0])
            for p, q in ((a, b), (b, c), (c, a))]  # fmt: skip
    return bool(np.any(np.all(np.array(turn) > 0, axis=0)))


def test_the_bottle_does_not_depend_on_its_mesh():
    """Its area comes from below, at second order."""
    sizes = [area(bottle_half(element_size=size)) for size in (0.008, 0.004, 0.002)]
    assert sizes[0] < sizes[1] < sizes[2] and (sizes[2] - sizes[1]) < 0.5 * (sizes[1] - sizes[0])


def test_a_parison_lies_inside_its_bottle():
    sheet, mold = shapes.bottle_half(swell=0.6), bottle_half()
    assert sheet.positions[:, 2].max() < 0.7 * mold.vertices[:, 2].max()
    assert np.all(sheet.clamped == np.isin(np.arange(len(sheet.positions)), topology.boundary_nodes(sheet.triangles)))
    corner = sheet.positions[sheet.triangles]
    assert np.all(np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])[:, 2] > -1e-9)


@pytest.mark.parametrize(
    "make, key",
    [
        (lambda: box_insert(insert_size=[0.4, 0.1]), "mold.insert_size"),
        (lambda: box_insert(insert_height=0.08), "mold.insert_height"),
        (lambda: box_insert(draft=70.0), "mold.draft"),
        (lambda: box_insert(draft=59.0), "mold.insert_size"),
        (lambda: box_insert(depth=-1.0), "mold.depth"),
        (lambda: box_insert(size=[1.0]), "mold.size"),
        (lambda: box_insert(divisions=0), "mold.divisions"),
        (lambda: bottle_half(neck_radius=0.03), "mold.neck_radius"),
        (lambda: bottle_half(height=0.05), "mold.height"),
        (lambda: bottle_half(hole=(0.02, 0.02)), "mold.hole[0]"),
        (lambda: bottle_half(element_size=0.03), "mold.element_size"),
        (lambda: bottle_half(element_size=math.nan), "mold.element_size"),
        (lambda: shapes.bottle_half(swell=1.0), "parison.swell"),
        (lambda: shapes.bottle_half(inset=0.01), "parison.inset"),
        (lambda: shapes.bottle_half(radius=-1.0), "parison.radius"),
    ],
)
def test_parts_that_do_not_fit_are_named(make, key):
    with pytest.raises(InputError) as error:
        make()
    assert error.value.key == key


def test_orientations_tell_which_triangles_turn_the_same_way():
    mold = revolved(profile=CUP, segments=12)
    turned = mold.triangles.copy()
    chosen = np.arange(len(turned)) % 3 == 1
    turned[chosen] = turned[chosen, ::-1]
    part, sign = topology.orientations(turned)
    assert part.max() == 0
    np.testing.assert_array_equal(sign * sign[0] < 0, chosen ^ chosen[0])
    both = np.concatenate([turned, turned + len(mold.vertices)])
    assert topology.orientations(both)[0].max() == 1

"""Openings of molds are found from any side, and the sheet that is laid over them fits."""

from __future__ import annotations

import numpy as np
import pytest

from jaxform.core.errors import InputError
from jaxform.mesh import meshes, topology
from jaxform.mesh.meshes import Mesh
from jaxform.mesh.outlines import Circle, OrientedRectangle
from jaxform.tools import covers, footprint, molds, opening

pytestmark = pytest.mark.quick

TURNS = [(0.0, 0.0, 0.0), (180.0, 0.0, 0.0), (0.0, 90.0, 0.0), (30.0, -50.0, 110.0)]


def cup(segments: int = 40) -> Mesh:
    """A bare cup, z from 0 to 0.05, open at z = 0, its radius there 0.04."""
    shape = molds.revolved(profile=[[0.0, 0.05], [0.03, 0.05], [0.04, 0.0]], segments=segments)
    return Mesh(shape.vertices, shape.triangles)


def flanged_cup() -> Mesh:
    """The cup with a flange to a radius of 0.06."""
    shape = molds.revolved(profile=[[0.0, 0.05], [0.03, 0.05], [0.04, 0.0], [0.06, 0.0]], segments=40)
    return Mesh(shape.vertices, shape.triangles)


def box(low: tuple[float, ...], high: tuple[float, ...], *, lid: bool = True) -> Mesh:
    """A box, with or without its side at the lowest z."""
    at = np.array([[x, y, z] for z in (0, 1) for y in (0, 1) for x in (0, 1)], float)
    quads = [(4, 5, 7, 6), (0, 1, 5, 4), (1, 3, 7, 5), (3, 2, 6, 7), (2, 0, 4, 6), *([(0, 2, 3, 1)] if lid else [])]
    triangles = [t for a, b, c, d in quads for t in ((a, b, c), (a, c, d))]
    return Mesh(np.array(low) + at * (np.array(high) - low), np.array(triangles, np.int32))


def l_tray() -> Mesh:
    """A bare tray, an L of 0.2 m with arms 0.1 m wide, 0.03 m deep."""
    corners = np.array([[0, 0], [0.2, 0], [0.2, 0.1], [0.1, 0.1], [0.1, 0.2], [0, 0.2]])
    points = np.concatenate([np.insert(corners, 2, z, axis=1) for z in (0.0, 0.03)])
    number = np.arange(6)
    following = (number + 1) % 6
    walls = [np.stack([number, following, following + 6], 1), np.stack([number, following + 6, number + 6], 1)]
    bottom = np.array([[6, 7, 8], [6, 8, 9], [6, 9, 10], [6, 10, 11]])
    return Mesh(points, np.concatenate([*walls, bottom]).astype(np.int32))


def turn(mold: Mesh, degrees: tuple[float, ...]) -> Mesh:
    moved = mold.positions @ molds.rotation(np.array(degrees)).T + [0.3, -0.2, 0.5]
    return Mesh(moved, mold.triangles)


@pytest.mark.parametrize("degrees", TURNS)
def test_a_cup_is_found_from_its_open_side(degrees):
    mold = turn(flanged_cup(), degrees)
    found = opening.find_opening(mold.positions, mold.triangles)
    into = molds.rotation(np.array(degrees))[:, 2]
    np.testing.assert_allclose(found.view.turn @ into, [0, 0, 1], atol=1e-6)
    assert not found.male and found.rim == 1.0
    origin = found.view.turn @ [0.3, -0.2, 0.5]
    np.testing.assert_allclose([found.level, found.depth], [origin[2], 0.05], atol=1e-6)
    sheet, flange = footprint.fit_planform(found, mold.positions, mold.triangles)
    assert isinstance(sheet, Circle) and flange
    np.testing.assert_allclose(sheet.center, origin[:2], atol=2e-4)
    assert 0.0405 < sheet.radius < 0.045
    assert covers.cover(found, footprint.planform_polygon(sheet), mold).mesh is None


def test_a_bare_cup_has_a_disc_inside_its_rim():
    mold = cup(16)
    found = opening.find_opening(mold.positions, mold.triangles)
    sheet, flange = footprint.fit_planform(found, mold.positions, mold.triangles)
    assert isinstance(sheet, Circle) and not flange
    np.testing.assert_allclose(sheet.radius, 0.04 * np.cos(np.pi / 16), rtol=1e-3)


def test_a_tray_has_a_rectangle_and_an_l_its_outline():
    mold = turn(box((0, 0, 0), (0.2, 0.1, 0.03), lid=False), (0.0, 0.0, 20.0))
    found = opening.find_opening(mold.positions, mold.triangles)
    sheet, _ = footprint.fit_planform(found, mold.positions, mold.triangles)
    assert isinstance(sheet, OrientedRectangle)
    np.testing.assert_allclose(np.sort(sheet.sides), [0.1, 0.2], rtol=1e-9)
    np.testing.assert_allclose(abs(np.degrees(sheet.angle)), 20.0, rtol=1e-6)
    mold = l_tray()
    found = opening.find_opening(mold.positions, mold.triangles)
    sheet, _ = footprint.fit_planform(found, mold.positions, mold.triangles)
    seen = {
        tuple(corner) for corner in np.round(footprint.planform_polygon(sheet) @ found.view.turn[:2, :2], 9).tolist()
    }
    assert seen == {(0, 0), (0.2, 0), (0.2, 0.1), (0.1, 0.1), (0.1, 0.2), (0, 0.2)}


def _pockets(middles: list[tuple[float, float]]) -> Mesh:
    """A flange of 0.24 x 0.18 m with round pockets of 0.02 m radius, 0.015 m deep: a height field of 2 mm."""
    x, y = np.meshgrid(np.linspace(-0.12, 0.12, 121), np.linspace(-0.09, 0.09, 91), indexing="ij")
    inside = np.any([np.hypot(x - a, y - b) < 0.02 for a, b in middles], axis=0)
    points = np.stack([x, y, np.where(inside, 0.015, 0.0)], axis=-1).reshape(-1, 3)
    first = (np.arange(120)[:, None] * 91 + np.arange(90)).ravel()
    quads = np.stack([first, first + 91, first + 92, first + 1], axis=1)
    return Mesh(points, np.concatenate([quads[:, :3], quads[:, [0, 2, 3]]]).astype(np.int32))


def test_pockets_on_one_flange_have_a_rectangle_where_they_fill_it_and_else_their_hull():
    """The hull of two staggered rows was the sheet, with dozens of corners, on a flange that is a rectangle."""
    rows = _pockets([(-0.07, 0.04), (0.0, 0.04), (0.07, 0.04), (-0.04, -0.04), (0.04, -0.04)])
    corner = _pockets([(-0.07, -0.05), (0.07, -0.05), (-0.07, 0.05)])
    found = opening.find_opening(rows.positions, rows.triangles)
    sheet, flange = footprint.fit_planform(found, rows.positions, rows.triangles)
    assert isinstance(sheet, OrientedRectangle) and flange
    # The pockets' box, whose edges lie on the grid, and a margin of 3 % of its width.
    np.testing.assert_allclose(np.sort(sheet.sides), np.array([0.124, 0.184]) + 2 * 0.03 * 0.124, atol=1e-3)
    found = opening.find_opening(corner.positions, corner.triangles)
    assert isinstance(footprint.fit_planform(found, corner.positions, corner.triangles)[0], np.ndarray)


def test_a_sheet_over_the_rim_lies_in_its_plane_with_normals_into_the_mold():
    mold = turn(l_tray(), TURNS[3])
    sheet = footprint.sheet_over_opening(mold.positions, mold.triangles, elements=100)
    axes = molds.rotation(np.array(TURNS[3]))
    np.testing.assert_allclose((sheet.positions - [0.3, -0.2, 0.5]) @ axes[:, 2], 0.0, atol=1e-9)
    corner = sheet.positions[sheet.triangles]
    normal = 0.5 * np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    np.testing.assert_allclose(normal.sum(0), 0.03 * axes[:, 2], atol=1e-9)
    assert sheet.snap is not None
    ends = sheet.positions[topology.boundary_edges(sheet.triangles)]
    middles = ends.mean(1)
    np.testing.assert_allclose(sheet.snap(middles, ends, np.ones(len(ends), bool)), middles, atol=1e-9)


def test_a_plug_is_formed_over_within_walls():
    mold = meshes.merge([box((0, 0, 0.04), (0.2, 0.16, 0.05)), box((0.05, 0.05, 0.0), (0.15, 0.11, 0.04))])
    found = opening.find_opening(mold.positions, mold.triangles)
    assert found.male
    np.testing.assert_allclose(found.view.turn[2], [0, 0, 1], atol=1e-12)
    np.testing.assert_allclose([found.level, found.depth], [0.0, 0.04], atol=1e-9)
    sheet, _ = footprint.fit_planform(found, mold.positions, mold.triangles)
    walls = covers.cover(found, footprint.planform_polygon(sheet), mold)
    assert isinstance(sheet, OrientedRectangle) and walls.mesh is not None
    np.testing.assert_allclose(walls.gaps, 0.72, rtol=1e-6)
    np.testing.assert_allclose(walls.mesh.positions.min(0), [0.0, 0.0, 0.0], atol=1e-6)
    np.testing.assert_allclose(walls.mesh.positions.max(0), [0.2, 0.16, 0.04], atol=1e-6)
    with pytest.raises(InputError, match=r"mold_rim.*a plug protrudes"):
        footprint.sheet_over_opening(mold.positions, mold.triangles, elements=100)


def test_holes_are_covered_and_seams_are_none():
    whole = turn(flanged_cup(), TURNS[1])
    lowest = whole.positions[whole.triangles][..., 2].max(1)
    gone = np.flatnonzero(lowest < 0.4501)[3:6]
    holed = Mesh(whole.positions, np.delete(whole.triangles, gone, axis=0))
    found = opening.find_opening(holed.positions, holed.triangles)
    polygon = footprint.planform_polygon(footprint.fit_planform(found, holed.positions, holed.triangles)[0])
    closed = covers.cover(found, polygon, holed)
    assert closed.mesh is not None and closed.holes == 1
    corner = closed.mesh.positions[closed.mesh.triangles]
    area = 0.5 * np.linalg.norm(np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]), axis=1).sum()
    lost = whole.positions[whole.triangles[gone]]
    np.testing.assert_allclose(
        area, 0.5 * np.linalg.norm(np.cross(lost[:, 1] - lost[:, 0], lost[:, 2] - lost[:, 0]), axis=1).sum(), rtol=1e-9
    )
    # The same mold in two pieces that do not share their corners.
    lower = whole.positions[whole.triangles][..., 2].max(1) < 0.5 - 1e-9
    pieces = meshes.merge(
        [Mesh(whole.positions, whole.triangles[~lower]), Mesh(whole.positions, whole.triangles[lower])]
    )
    apart = Mesh(pieces.positions + np.linspace(0, 1e-7, len(pieces.positions))[:, None], pieces.triangles)
    found = opening.find_opening(apart.positions, apart.triangles)
    assert covers.cover(found, polygon, apart).mesh is None


def test_what_has_no_opening_is_refused():
    cube = box((0, 0, 0), (0.1, 0.1, 0.1))
    with pytest.raises(InputError, match="no opening was found"):
        opening.find_opening(cube.positions, cube.triangles)


@pytest.mark.parametrize("degrees", [*TURNS, (10.0, 90.0, 0.0), (-170.0, -90.0, 0.0), (0.0, 0.0, 180.0)])
def test_angles_give_the_rotation_back(degrees):
    matrix = molds.rotation(np.array(degrees))
    np.testing.assert_allclose(molds.rotation(molds.angles(matrix)), matrix, atol=1e-12)

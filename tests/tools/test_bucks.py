"""Male molds: what is taken for one, how it stands, the platen that it gets, and how deep it is undercut."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
import trimesh

from jaxform.core.errors import InputError, InputWarning
from jaxform.io import scene_choices
from jaxform.mesh import meshes
from jaxform.mesh.meshes import Mesh
from jaxform.mesh.outlines import Circle, OrientedRectangle
from jaxform.tools import buck, covers, footprint, kinds, molds


def unite(*solids: trimesh.Trimesh) -> trimesh.Trimesh:
    """Several shells in one mesh."""
    starts = np.cumsum([0, *(len(solid.vertices) for solid in solids)])
    faces = [solid.faces + start for solid, start in zip(solids, starts, strict=False)]
    return trimesh.Trimesh(np.concatenate([solid.vertices for solid in solids]), np.concatenate(faces), process=False)


def as_mesh(solid: trimesh.Trimesh) -> Mesh:
    return footprint.weld_mold(np.array(solid.vertices, float), np.array(solid.faces, np.int32))


def drafted_block(top: float = 0.7, chamfer: float = 0.0) -> trimesh.Trimesh:
    """A block of 0.12 x 0.08 x 0.04 on z = 0, its top smaller by a factor, perhaps with a chamfer round it."""
    base = np.array([[-0.06, -0.04, 0], [0.06, -0.04, 0], [0.06, 0.04, 0], [-0.06, 0.04, 0]])
    up = base * [top, top, 1] + [0, 0, 0.04 - chamfer]
    rings = [base, up] if not chamfer else [base, up, up - [0, 0, -chamfer] - chamfer * np.sign(up) * [1, 1, 0]]
    return trimesh.convex.convex_hull(np.concatenate(rings))


def dome(segments: int = 24, rough: float = 0.0) -> Mesh:
    """An open half of an ellipsoid 0.1 x 0.08 x 0.05 that faces outwards, its rim rough by so much [m]."""
    shape = molds.revolved(profile=[[np.sin(a), np.cos(a)] for a in np.linspace(0, 0.5 * np.pi, 10)], segments=segments)
    points = shape.vertices * [0.05, 0.04, 0.05]
    at_rim = points[:, 2] < 1e-9
    angle = np.arctan2(points[:, 1], points[:, 0])
    points[:, 2] -= np.where(at_rim, rough * (1.5 + np.sin(3 * angle)), 0.0)
    return footprint.weld_mold(points, outwards(points, shape.triangles))


def outwards(points: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """Triangles (m, 3) of a surface round (0, 0, -1) that turn so that they face away from there."""
    corners = points[triangles]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    turned = np.sum(normal * (corners.mean(1) - np.array([0, 0, -1])), axis=1) < 0
    return np.where(turned[:, None], triangles[:, ::-1], triangles)


def round_bottle() -> trimesh.Trimesh:
    """A solid bottle of oval sections, 0.11 high, of facets 9 degrees wide."""
    profile = [[0, 0], [24, 0], [28, 4], [28, 82], [20, 90], [9, 90], [9, 110], [0, 110]]
    solid = trimesh.creation.revolve(1e-3 * np.array(profile), sections=40)
    solid.vertices[:, 1] *= 16 / 28
    return solid


def on_platen() -> trimesh.Trimesh:
    """A cone 0.06 high, of radius 0.04 and 0.02, on a slab of 0.2 x 0.2 whose upper side is z = 0."""
    slab = trimesh.creation.box(bounds=[[-0.1, -0.1, -0.01], [0.1, 0.1, 0.0]])
    angle = np.linspace(0, 2 * np.pi, 48, endpoint=False)
    rings = [
        np.stack([r * np.cos(angle), r * np.sin(angle), np.full(48, z)], axis=1) for r, z in ((0.04, 0), (0.02, 0.06))
    ]
    return unite(slab, trimesh.convex.convex_hull(np.concatenate(rings)))


def split_and_mix(solid: trimesh.Trimesh) -> trimesh.Trimesh:
    """The same with corners of each triangle's own, some of which turn the other way."""
    faces = np.arange(3 * len(solid.faces)).reshape(-1, 3)
    faces[::3] = faces[::3, ::-1]
    return trimesh.Trimesh(solid.vertices[solid.faces].reshape(-1, 3), faces, process=False)


BUCKS = {
    "box": as_mesh(trimesh.creation.box([0.12, 0.08, 0.03])),
    "drafted": as_mesh(drafted_block()),
    "chamfered": as_mesh(drafted_block(1.0, 0.01)),
    "cylinder": as_mesh(trimesh.creation.cylinder(0.04, 0.06, sections=48)),
    "cone on platen": as_mesh(on_platen()),
    "dome": dome(),
    "rough dome": dome(rough=0.004),
    "split and mixed": as_mesh(split_and_mix(drafted_block())),
    "two": as_mesh(unite(drafted_block(), drafted_block().apply_translation([0.2, 0, 0]))),
    "open below": as_mesh(
        trimesh.Trimesh(drafted_block().vertices, drafted_block().faces[drafted_block().face_normals[:, 2] > -0.9])
    ),
}


@pytest.mark.parametrize("name", BUCKS)
def test_bucks_stand_on_their_base(name):
    mold = BUCKS[name]
    is_male, doubt, _ = kinds.classify(mold)
    # A block that is open below may be a tray as well.
    assert is_male or (name == "open below" and "--drape" in doubt)
    found = buck.find_buck(mold)
    np.testing.assert_allclose(found.direction, [0, 0, 1], atol=1e-6)
    low = 0.0 if name == "cone on platen" else mold.positions[:, 2].min()
    np.testing.assert_allclose(found.height, mold.positions[:, 2].max() - low, rtol=1e-6)
    assert found.flat and found.on_platen == (name == "cone on platen")
    made = scene_choices.drape(mold, None)
    assert made.undercut is None
    # All that is open is closed down to the platen.
    added = [] if made.added is None else [made.added]
    assert (made.platen is None) == (name == "cone on platen")
    assert np.isclose(meshes.merge([mold, *added]).positions[:, 2].min(), mold.positions[:, 2].min(), atol=1e-9)


@pytest.mark.parametrize("degrees", [(180.0, 0.0, 0.0), (0.0, 90.0, 0.0), (30.0, -50.0, 110.0)])
@pytest.mark.parametrize("name", ["drafted", "cone on platen", "rough dome"])
def test_bucks_are_found_in_any_pose(name, degrees):
    turn, mold = molds.rotation(np.array(degrees)), BUCKS[name]
    turned = Mesh(mold.positions @ turn.T + [0.3, -0.2, 0.5], mold.triangles)
    assert kinds.classify(turned)[0]
    found = buck.find_buck(turned)
    # A rim that is rough has no plane to the last digit.
    np.testing.assert_allclose(found.direction, turn[:, 2], atol=0.05 if name == "rough dome" else 1e-5)


def _cavities() -> dict[str, Mesh]:
    block = molds.box_insert(size=(0.1, 0.08), depth=0.03, insert_size=(0.03, 0.02), insert_height=0.01)
    pocket = Mesh(block.vertices, block.triangles)
    flanged = molds.revolved(profile=[[0.0, 0.03], [0.06, 0.03], [0.08, 0.0], [0.1, 0.0]], segments=60)
    walls = [[0.0, 0.0], [0.04, 0.0], [0.05, 0.05], [0.048, 0.05], [0.038, 0.002], [0.0, 0.002]]
    cup = molds.revolved(profile=walls, segments=48)
    return {
        "pocket": pocket,
        "flanged": Mesh(flanged.vertices, flanged.triangles),
        "cup of two sides": Mesh(cup.vertices, cup.triangles),
        "bowl that faces inwards": Mesh(dome().positions, dome().triangles[:, ::-1]),
    }


@pytest.mark.parametrize("name", _cavities())
def test_cavities_are_no_bucks(name):
    mold = _cavities()[name]
    assert not kinds.classify(footprint.weld_mold(mold.positions, mold.triangles))[0]


def test_what_is_doubtful_names_the_other_kind():
    assert "--cavity" in kinds.classify(BUCKS["dome"])[1]
    flanged = _cavities()["flanged"]
    assert "--drape" in kinds.classify(flanged)[1]
    # Either end of a cylinder will do for a base.
    assert buck.find_buck(BUCKS["cylinder"]).others == ["-z"] and buck.find_buck(BUCKS["drafted"]).others == []


def test_other_sides_are_named_once_not_for_each_facet_of_a_round_body():
    others = buck.find_buck(as_mesh(round_bottle())).others
    sides = [buck.parse_direction(name) for name in others]
    assert others and max(a @ b for a, b in itertools.combinations(sides, 2)) < 0.98


@pytest.mark.parametrize(
    ("solid", "words"),
    [(round_bottle(), "times as high as it is wide"), (trimesh.creation.icosphere(radius=0.03), "no flat base")],
    ids=["bottle", "ball"],
)
def test_what_may_be_a_bottle_is_told_how_it_is_blown(solid: trimesh.Trimesh, words: str):
    with pytest.warns(InputWarning, match=f"{words}.*--process extrusion-blow or stretch-blow"):
        scene_choices.warn(scene_choices.drape(as_mesh(solid), None), 1.0)


def test_the_sheet_reaches_about_the_height_beyond_the_buck():
    planform, _, platen = buck.fit_sheet(buck.find_buck(BUCKS["box"]))
    assert isinstance(planform, OrientedRectangle) and platen is not None
    np.testing.assert_allclose(np.sort(planform.sides), [0.14, 0.18], atol=1e-3)
    np.testing.assert_allclose(platen.positions[:, 2], -0.015, atol=1e-9)
    assert (np.ptp(platen.positions, axis=0)[:2] > [0.18, 0.14]).all()
    for name, tolerance in (("cylinder", 1e-3), ("cone on platen", 0.011)):
        planform = buck.fit_sheet(buck.find_buck(BUCKS[name]))[0]
        assert isinstance(planform, Circle)
        np.testing.assert_allclose(planform.radius, 0.1, atol=tolerance)


def test_an_undercut_is_measured_sideways():
    """A mushroom whose hat reaches 0.02 over its stem, and the drafted block upside down."""
    stem = trimesh.creation.cylinder(0.03, 0.04, sections=64).apply_translation([0, 0, 0.02])
    hat = trimesh.creation.cylinder(0.05, 0.01, sections=64).apply_translation([0, 0, 0.045])
    mold = as_mesh(unite(stem, hat))
    found = buck.deepest_undercut(buck.find_buck(mold, buck.parse_direction("+z")), mold)
    assert found is not None
    depth, place = found
    np.testing.assert_allclose(depth, 0.02, atol=6e-4)
    assert np.isclose(np.linalg.norm(place[:2]), 0.03, atol=1e-3) and 0 < place[2] < 0.04
    assert buck.deepest_undercut(buck.find_buck(BUCKS["drafted"]), BUCKS["drafted"]) is None
    down = buck.deepest_undercut(buck.find_buck(BUCKS["drafted"], buck.parse_direction("-z")), BUCKS["drafted"])
    assert down is not None
    np.testing.assert_allclose(down[0], 0.15 * 0.12, rtol=0.1)


def test_a_void_inside_is_no_undercut():
    outer = drafted_block()
    inner = trimesh.creation.box([0.04, 0.03, 0.02]).apply_translation([0, 0, 0.02])
    mold = as_mesh(unite(outer, inner))
    assert buck.deepest_undercut(buck.find_buck(mold), mold) is None


def test_a_scan_is_closed_by_walls_and_its_holes_by_covers():
    mold = dome(rough=0.004)
    high = np.argsort(-mold.positions[mold.triangles][..., 2].mean(1))
    holed = footprint.weld_mold(mold.positions, np.delete(mold.triangles, high[30:34], axis=0))
    made = scene_choices.drape(holed, None)
    assert made.holes == 1 and made.platen is not None and made.added is not None
    found = covers.find_rims(footprint.weld_mold(mold.positions, mold.triangles))
    assert found is not None and len(found) == 1
    walls, fans = covers.close_rims(mold, found, made.buck.view.turn, made.buck.base)
    assert len(walls) == 1 and not fans
    # The walls go down to the platen from every edge of the rim.
    assert np.isclose(walls[0].positions[:, 2].max(), made.buck.base)
    assert 2 * len(found[0]) - 6 <= len(walls[0].triangles) <= 2 * len(found[0])


def test_a_ball_has_no_base_and_is_cut_at_its_equator():
    ball = as_mesh(trimesh.creation.icosphere(subdivisions=3, radius=0.05))
    assert kinds.classify(ball)[0]
    found = buck.find_buck(ball)
    assert not found.flat and abs(found.height - 0.05) < 0.01


@pytest.mark.parametrize(
    ("text", "direction"),
    [("+z", [0, 0, 1]), ("-x", [-1, 0, 0]), ("y", [0, 1, 0]), ("0,3,4", [0, 0.6, 0.8]), ("-Z", [0, 0, -1])],
)
def test_directions(text, direction):
    np.testing.assert_allclose(buck.parse_direction(text), direction)
    np.testing.assert_allclose(
        buck.parse_direction(buck.direction_name(buck.parse_direction(text))), direction, atol=1e-9
    )


@pytest.mark.parametrize("text", ["", "up", "0,0,0", "1,2", "1,nan,0", "+w"])
def test_what_is_no_direction(text):
    with pytest.raises(InputError, match="is not a direction; give"):
        buck.parse_direction(text)

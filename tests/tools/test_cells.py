"""Holes in side walls are found and covered, bottles are seen: what no view along the push shows."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from benchmarks.strangers import file_molds
from benchmarks.strangers.file_molds import KINDS
from jaxform.core.errors import InputError
from jaxform.mesh import meshes, volumes
from jaxform.mesh.meshes import Mesh
from jaxform.tools import covers, footprint, kinds, molds, opening, patches

TURNS = [(0.0, 0.0, 0.0), (90.0, 0.0, 30.0), (25.0, -50.0, 110.0)]


def mold(name: str, degrees: tuple[float, ...] = (0.0, 0.0, 0.0), fine: float = 0.5) -> Mesh:
    """One of the strangers' molds [m], turned."""
    made = KINDS[name].made(fine)
    return footprint.weld_mold(
        1e-3 * np.asarray(made.vertices) @ molds.rotation(np.array(degrees)).T, np.asarray(made.faces)
    )


def close_bowl(shape: Mesh) -> tuple[opening.Opening, np.ndarray, covers.Covers]:
    found = opening.find_opening(shape.positions, shape.triangles, male=False)
    polygon = footprint.planform_polygon(footprint.fit_planform(found, shape.positions, shape.triangles)[0])
    return found, polygon, covers.cover(found, polygon, shape)


def behind(shape: Mesh, found: opening.Opening, polygon: np.ndarray, added: Mesh | None) -> patches.CellGrid:
    """The cells behind a sheet, with what covers the mold."""
    whole = shape if added is None else meshes.merge([shape, added])
    return patches.cells((whole.positions @ found.view.turn.T)[whole.triangles], polygon, found)


@pytest.mark.parametrize("degrees", TURNS)
def test_holes_in_the_side_walls_of_a_solid_tray_are_covered_in_the_plane_of_the_wall(degrees):
    shape = mold("tray with holes in its walls", degrees)
    found, polygon, added = close_bowl(shape)
    assert added.mesh is not None and (added.holes, added.sides, added.gaps) == (2, 2, 0.0)
    places = added.mesh.positions @ molds.rotation(np.array(degrees))
    # The walls' inner sides are at x = -0.095 and 0.095, the holes 0.04 by 0.012.
    cell = behind(shape, found, polygon, None).width
    np.testing.assert_allclose(np.abs(places[:, 0]), 0.095, atol=0.5 * cell)
    area = volumes.areas(added.mesh.positions, added.mesh.triangles).sum()
    assert 2 * 0.04 * 0.012 <= area <= 2 * (0.04 + 6 * cell) * (0.012 + 6 * cell)
    assert behind(shape, found, polygon, None).leaks.any()
    assert not behind(shape, found, polygon, added.mesh).leaks.any()


@pytest.mark.parametrize(("name", "sides", "holes"), [("crate", 60, 60), ("basket", 40, 52), ("cup with slots", 8, 8)])
def test_nothing_leaks_from_what_has_many_holes(name, sides, holes):
    shape = mold(name)
    found, polygon, added = close_bowl(shape)
    assert (added.sides, added.holes) == (sides, holes)
    assert not behind(shape, found, polygon, added.mesh).leaks.any()
    # Covers lie on the walls or span holes in them, and do not stand in the hollow.
    assert added.mesh is not None
    near = meshes.merge([shape, added.mesh])
    assert np.ptp(near.positions, axis=0) == pytest.approx(np.ptp(shape.positions, axis=0), rel=1e-9)


def test_a_curved_wall_is_continued_by_its_covers():
    shape = mold("cup with slots", fine=1.0)
    _, _, added = close_bowl(shape)
    assert added.mesh is not None
    radius = np.hypot(*added.mesh.positions[:, :2].T)
    # Between the chord of a slot, 34 degrees wide at most, and the wall's inner side.
    assert radius.min() > 0.027 * np.cos(np.radians(8)) and radius.max() < 0.0275


@pytest.mark.parametrize("name", ["cup", "mug", "bowl", "six pockets", "cup with a rolled lip", "cup with a skirt"])
def test_whole_walls_are_not_covered(name):
    _, _, added = close_bowl(mold(name))
    assert added.mesh is None and added.hidden < 0.02


@pytest.mark.parametrize(
    ("name", "radius", "depth"),
    [
        ("mug", 0.0225, 0.055),
        ("bowl with two ears", 0.057, 0.042),
        ("cup with a rolled lip", 0.0296, 0.069),
        ("cup with a skirt", 0.030, 0.052),
    ],
)
@pytest.mark.parametrize("degrees", [TURNS[0], TURNS[2]])
def test_handles_lips_and_skirts_are_no_part_of_the_cavity(name, radius, depth, degrees):
    shape = mold(name, degrees, fine=1.0)
    found = opening.find_opening(shape.positions, shape.triangles, male=False)
    into = molds.rotation(np.array(degrees)) @ [0.0, 0.0, -1.0]
    np.testing.assert_allclose(found.view.turn @ into, [0, 0, 1], atol=1e-3)
    assert found.rim == 1.0
    size = np.ptp(shape.positions @ molds.rotation(np.array(degrees)), axis=0).max()
    assert found.depth == pytest.approx(depth, abs=2 * opening.FLAT * size)
    assert found.cavity.sum() * found.view.pixel**2 == pytest.approx(np.pi * radius**2, rel=0.05)


def _weld(*parts: Any) -> Mesh:
    whole = meshes.merge([Mesh(1e-3 * np.asarray(part.vertices), np.asarray(part.faces)) for part in parts])
    return footprint.weld_mold(whole.positions, whole.triangles)


def pan() -> Mesh:
    """A pan, 0.042 deep within a radius of 0.117, whose handle is as high as its rim and longer than it is wide."""
    profile = [[0, 0], [110, 0], [120, 45], [117, 45], [107, 3], [0, 3]]
    return _weld(file_molds.turn_mesh(profile, 120), file_molds.box([118, -10, 38], [300, 10, 45]))


def high_handled() -> Mesh:
    """A cup, 0.055 deep within a radius of 0.0225, whose handle stands above its rim."""
    return _weld(KINDS["cup"].made(1.0), file_molds.box([24, -4, 25], [50, 4, 66]))


def rolled_bowl() -> Mesh:
    """An open shell whose rim, at a radius of 0.084, is rolled until it points down and in."""
    angle = np.linspace(np.pi, -np.pi / 2, 12)
    lip = np.stack([84 + 4 * np.cos(angle), 30 + 4 * np.sin(angle)], axis=1)
    return _weld(file_molds.turn_mesh(np.concatenate([[[0, 0], [50, 0]], lip]), 96))


@pytest.mark.parametrize(
    ("shape", "radius", "depth"),
    [(pan(), 0.117, 0.042), (high_handled(), 0.0225, 0.055), (rolled_bowl(), 0.082, 0.0335)],
)
def test_neither_long_nor_high_handles_nor_the_end_of_a_lip_are_covered_or_counted(shape, radius, depth):
    found, _, added = close_bowl(shape)
    assert added.mesh is None and added.holes == 0
    assert found.depth == pytest.approx(depth, rel=0.03)
    assert found.cavity.sum() * found.view.pixel**2 == pytest.approx(np.pi * radius**2, rel=0.06)


@pytest.mark.parametrize("degrees", TURNS)
def test_a_bottle_is_refused_with_what_to_do_instead(degrees):
    shape = mold("hollow bottle", degrees, fine=1.0)
    with pytest.raises(
        InputError, match=r"is a bottle: its cavity is about .. mm wide behind a neck of.*--drape --direction=\+[xyz] "
    ):
        patches.refuse_bottles(shape)
    found = patches.widest_chamber(shape)
    assert found is not None
    # Within two cells of what they are.
    assert found[:2] == (pytest.approx(0.061, abs=0.004), pytest.approx(0.021, abs=0.004))


def test_a_mold_that_is_hollow_on_two_sides_names_the_other():
    shape = mold("cup with a skirt", (25.0, -50.0, 110.0))
    found = opening.find_opening(shape.positions, shape.triangles, male=False)
    (other,) = found.others
    np.testing.assert_allclose(other, found.view.turn[2], atol=1e-3)
    again = opening.find_opening(shape.positions, shape.triangles, male=False, direction=other)
    np.testing.assert_allclose(again.view.turn[2], -other, atol=1e-3)
    mug = mold("mug")
    assert again.depth > 0 and not opening.find_opening(mug.positions, mug.triangles, male=False).others


def test_the_mouth_of_a_bottle_is_closed_for_a_sheet_over_its_outside():
    shape = mold("hollow bottle", fine=1.0)
    (lid,) = patches.close_necks(shape)
    # Over the mouth, to its edge, and not far into the neck, 0.021 wide and 0.03 long.
    assert lid.positions[:, 2].min() > 0.2 - 0.011 and lid.positions[:, 2].max() < 0.201
    assert 0.009 < np.hypot(*lid.positions[:, :2].T).max() < 0.0125
    assert patches.widest_chamber(meshes.merge([shape, lid])) is None
    assert patches.close_necks(mold("mug")) == []


@pytest.mark.parametrize("name", [name for name in KINDS if name != "hollow bottle"])
def test_nothing_else_is_a_bottle(name):
    shape = mold(name)
    assert patches.widest_chamber(shape) is None


@pytest.mark.parametrize("name", ["hollow bottle", "solid bottle", "jerry can", "tube", "cylinder buck"])
def test_a_closed_solid_is_never_completed(name):
    assert kinds.find_completion(mold(name)) is None

"""Warnings about a scene before it runs: units, sides, overlap, loads."""

from __future__ import annotations

import re
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import jaxform
from jaxform import InputWarning, molds, shapes
from jaxform.io import files, plots
from jaxform.io.canvas import new_figure
from jaxform.io.scene_checks import survey, warn_of_scene
from jaxform.mesh import grids, meshes
from tests import scenes

pytestmark = pytest.mark.quick

CUP = [[0.0, 0.05], [0.055, 0.05], [0.1, 0.0]]
FLANGED = [[0.0, 0.05], [0.03, 0.05], [0.04, 0.0], [0.12, 0.0]]


def _collect_warnings(folder: Path, text: str) -> list[str]:
    """Warnings where a scene is loaded."""
    (folder / "scene.toml").write_text(text)
    with warnings.catch_warnings(record=True) as heard:
        warnings.simplefilter("always")
        jaxform.load(folder / "scene.toml")
    assert all(warning.category is InputWarning for warning in heard)
    return [str(warning.message) for warning in heard]


def _with_profile(profile: list[list[float]]) -> str:
    return scenes.FILE.replace("[[0.0, 0.05], [0.055, 0.05], [0.1, 0.0]]", str(profile))


def _with_file(keys: str) -> str:
    begin, end = scenes.FILE.index('shape = "revolved"'), scenes.FILE.index("[solver]")
    return scenes.FILE.replace(scenes.FILE[begin:end], f'shape = "file"\npath = "cup.stl"\n{keys}\n')


@pytest.mark.parametrize(
    ("units", "keys", "words"),
    [
        (1.0, "", ""),
        (1e3, "", "1000 times the sheet: millimetres?"),
        (1e3, "", "scale = 0.001"),
        (1e3, "scale = 1e-3", ""),
        (1 / 0.0254, "", "inches? "),
        (1 / 0.0254, "", "scale = 0.0254"),
        (1 / 0.0254, "scale = 1e-3", "inches? "),
        (1 / 0.0254, "scale = 1e-3", "scale = 0.0254"),
        (1e2, "", "centimetres? "),
        (1.0, "scale = 1e-3", "is its file already in metres?"),
    ],
)
def test_a_mold_in_other_units_is_named_with_its_scale(tmp_path: Path, units: float, keys: str, words: str) -> None:
    cup = molds.revolved(profile=np.array(CUP) * units, segments=24)
    meshes.write_stl(tmp_path / "cup.stl", cup.vertices, cup.triangles)
    told = _collect_warnings(tmp_path, _with_file(keys))
    assert len(told) == bool(words)
    assert not words or (words in told[0] and "mold.scale" in told[0] and "scene.toml" in told[0])


@pytest.mark.parametrize(
    ("symmetry", "shift", "words"),
    [
        ("quarter", 0.0, []),
        ("quarter", 5e-3, ["differs from its image in the symmetry plane y = 0 m by 5 mm, near "]),
        ("half", 5e-3, []),
        ("none", 5e-3, []),
    ],
)
def test_a_mold_that_its_symmetry_plane_does_not_mirror(
    tmp_path: Path, symmetry: str, shift: float, words: list[str]
) -> None:
    """A cup meshed without symmetry, with a thing beside the sheet, and a floor that is deeper on one side of y = 0."""
    cup = molds.revolved(profile=CUP, segments=49)
    places = cup.vertices + np.array([0.0, 0.0, shift]) * (
        (cup.vertices[:, 2:] > 0.04) & (cup.vertices[:, 1:2] < -1e-3)
    )
    beside = np.array([[0.2, 0.2, 0.0], [0.25, 0.2, 0.0], [0.2, 0.25, 0.01]])
    triangles = np.concatenate([cup.triangles, [[len(places), len(places) + 1, len(places) + 2]]])
    meshes.write_stl(tmp_path / "cup.stl", np.concatenate([places, beside]), triangles)
    text = re.sub(r'symmetry = "\w+"', f'symmetry = "{symmetry}"', _with_file("fill = false"))
    assert f'symmetry = "{symmetry}"' in text
    told = _collect_warnings(tmp_path, text)
    assert len(told) == len(words), told
    assert all(expected in text for text, expected in zip(told, words, strict=True))


def test_a_sheet_in_millimetres_in_a_mold_in_metres(tmp_path: Path) -> None:
    sheet = shapes.rectangle(size=(100.0, 80.0), elements=40)
    meshes.write_vtu(tmp_path / "sheet.vtu", sheet.positions, sheet.triangles)
    begin, end = scenes.FILE.index('shape = "disc"'), scenes.FILE.index("[material]")
    text = scenes.FILE.replace(scenes.FILE[begin:end], 'shape = "file"\npath = "sheet.vtu"\nthickness = 1.0\n')
    told = _collect_warnings(tmp_path, text)
    assert "the sheet is 100 m wide" in told[0] and "is the sheet in millimetres?" in told[1]
    assert "parison.scale = 0.001" in told[1]


@pytest.mark.parametrize(("profile", "above"), [(CUP, 0.0), (FLANGED, 0.0), (FLANGED, -1e-3)])
def test_a_mold_on_the_wrong_side(tmp_path: Path, profile: list[list[float]], above: float) -> None:
    """Also where its flange is in the sheet's plane or a little behind it, as in molds from CAD."""
    wrong, right = (_with_profile([[r, side * (z - above)] for r, z in profile]) for side in (-1, 1))
    told = _collect_warnings(tmp_path, wrong)
    assert len(told) == 1 and "towards +z, away from the mold" in told[0]
    assert _collect_warnings(tmp_path, right) == []
    both = wrong.replace("value = [0.0, 2.0e4]", "value = [-1.0e4, 2.0e4]")
    assert _collect_warnings(tmp_path, both) == []
    assert _collect_warnings(tmp_path, wrong.replace("value = [0.0, 2.0e4]", "value = [0.0, -2.0e4]")) == []


def test_shares_of_the_mold_and_of_the_sheet() -> None:
    """Half a square sheet hangs over a plate; a quarter of the mold's area is on the other side."""
    sheet = shapes.rectangle(size=(1.0, 1.0), elements=200)
    plate = np.array([[0.5, -1, 0.1], [3.5, -1, 0.1], [3.5, 2, 0.1], [0.5, 2, 0.1]])
    corners = np.concatenate([plate, plate * [0.25, 1, -1] + [-1, 0, 0]])
    scene = jaxform.build_scene(
        parison=jaxform.make_parison(sheet.positions, sheet.triangles, 0.01, sheet.clamped, sheet.fixed),
        material=scenes.mooney(0.1),
        pressure=jaxform.make_pressure([0.0, 1.0], [0.0, 0.02]),
        solver=jaxform.make_solver(end_time=1.0),
        mold=jaxform.make_mold(corners, np.array([[0, 1, 2], [0, 2, 3], [4, 5, 6], [4, 6, 7]])),
    )
    seen = survey(scene)
    assert seen.ahead is not None and seen.behind is not None
    np.testing.assert_allclose([seen.ahead, seen.behind], [0.8, 0.2], atol=0.01)
    assert seen.overlap is not None and seen.exposed is not None
    np.testing.assert_allclose([seen.overlap, seen.exposed], [0.5, 0.0], atol=0.01)
    assert seen.direction == "towards +z" and seen.faces
    np.testing.assert_allclose(seen.sheet[1], [1.0, 1.0, 0.0])


def test_a_sphere_is_pushed_outwards_and_sees_the_mold_all_round() -> None:
    sheet = shapes.sphere(radius=1.0, elements=200, symmetry="quarter")
    ball = shapes.sphere(radius=2.0, elements=200)
    scene = jaxform.build_scene(
        parison=jaxform.make_parison(sheet.positions, sheet.triangles, 0.01, sheet.clamped, sheet.fixed),
        material=scenes.mooney(0.1),
        pressure=jaxform.make_pressure([0.0, 1.0], [0.0, 0.02]),
        solver=jaxform.make_solver(end_time=1.0),
        mold=jaxform.make_mold(ball.positions, ball.triangles),
    )
    seen = survey(scene)
    assert (seen.direction, seen.faces, seen.ahead, seen.behind) == ("outwards", False, 1.0, 0.0)
    np.testing.assert_allclose(seen.sheet, [[-1.0] * 3, [1.0] * 3])
    drawn_in = survey(jaxform.replace(scene, {"pressure.value": [0.0, -0.02]}))
    assert (drawn_in.direction, drawn_in.ahead, drawn_in.behind) == ("inwards", 0.0, 1.0)


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("thickness = 1.0e-3", "thickness = 1.0", "is it in mm?"),
        ("thickness = 1.0e-3", "thickness = 1.0e-6", "parison.thickness"),
        ("density = 1000.0", "density = 1.05", "1050 if it is in g/cm^3"),
        ("[0.0, 2.0e4]", "[0.0, 0.2]", "hardly moves"),
        ("[0.0, 2.0e4]", "[0.0, 0.0]", "there is no pressure"),
        ("c = 0.2e6", "c = 0.2", "times what the sheet can carry"),
    ],
)
def test_numbers_out_of_any_sense(tmp_path: Path, old: str, new: str, words: str) -> None:
    assert old in scenes.FILE
    text = scenes.FILE.replace(old, new)
    told = _collect_warnings(tmp_path, text.replace("end_time = 0.05", "end_time = 1.0e-4"))
    assert any(words in sentence for sentence in told), told


def test_a_mold_beside_the_sheet(tmp_path: Path) -> None:
    cup = molds.revolved(profile=CUP, segments=24)
    meshes.write_stl(tmp_path / "cup.stl", cup.vertices, cup.triangles)
    told = _collect_warnings(tmp_path, _with_file("translate = [0.35, 0.35, 0.0]"))
    assert len(told) == 1 and "the mold does not face the sheet" in told[0]


@pytest.mark.parametrize("name", ["dish-coarse", "bowl", "box-insert", "cup-fast", "soap-bottle"])
def test_nothing_is_said_of_the_built_in_scenes(name: str) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        files.load(name)


@pytest.mark.parametrize("hole", [0.0, 0.02, 0.1])
def test_a_hole_in_the_mold_is_told_with_its_place(hole: float) -> None:
    """A flat ring under a disc, with a hole about (0.2, 0.1)."""
    sheet = shapes.disc(radius=0.5, elements=400)
    angle = 2 * np.pi * np.arange(48) / 48
    ring = np.stack([np.cos(angle), np.sin(angle), np.zeros(48)], axis=1)
    around = np.array([0.2, 0.1, 0.0]) + hole * ring
    corners = np.concatenate([ring, around]) + np.array([0.0, 0.0, 0.1])
    k = np.arange(48)
    after = (k + 1) % 48
    walls = np.concatenate([np.stack([k, after, after + 48], 1), np.stack([k, after + 48, k + 48], 1)])
    scene = jaxform.build_scene(
        parison=jaxform.make_parison(sheet.positions, sheet.triangles, 0.01, sheet.clamped, sheet.fixed),
        material=jaxform.MooneyRivlin(*map(scenes.real, (2e5, 0.1, 1e3))),
        pressure=jaxform.make_pressure([0.0, 1.0], [0.0, 2e3]),
        solver=jaxform.make_solver(end_time=1.0),
        mold=jaxform.make_mold(corners, walls),
    )
    bare = survey(scene).bare
    assert bare is not None
    radius, middle = bare
    assert radius == pytest.approx(hole, abs=0.006)
    if hole < 0.1:
        warn_of_scene(scene)
        return
    np.testing.assert_allclose(middle, [0.2, 0.1, 0.0], atol=0.01)
    with pytest.warns(
        jaxform.InputWarning, match=r"4\S* % of the sheet has no mold in front of it.*within 0\.09\d m of"
    ):
        warn_of_scene(scene)


_BUCK_ALONE = """
[mold]
shape = "revolved"
profile = {profile}
rotate = [180.0, 0.0, 0.0]
translate = [0.0, 0.0, 0.051]
fill = false
[mold.motion]
direction = [0.0, 0.0, -1.0]
time = [0.0, 0.1]
displacement = [0.0, 0.0508]
"""


@pytest.mark.parametrize(("platen", "value"), [(0.12, 2.0e4), (0.0, 2.0e4), (0.0, 0.0)])
def test_a_buck_without_a_platen(tmp_path: Path, platen: float, value: float) -> None:
    """The sheet beside a buck is blown past it; without a pressure the buck alone does the work."""
    profile = [[0.0, 0.05], [0.04, 0.05], [0.04, 0.0], [platen, 0.0]][: 4 if platen else 3]
    begin, end = scenes.FILE.index("[mold]"), scenes.FILE.index("[solver]")
    text = scenes.FILE.replace(scenes.FILE[begin:end], _BUCK_ALONE.format(profile=profile)).replace("2.0e4", str(value))
    told = _collect_warnings(tmp_path, text.replace("end_time = 0.05", "end_time = 0.2"))
    bare = [words for words in told if "of the sheet has no mold in front of it, towards +z" in words]
    assert len(bare) == (not platen and value > 0.0), told
    for words in bare:
        assert float(words.split("mold: ")[1].split(" %")[0]) == pytest.approx(84.0, abs=0.5)
        assert "add a platen" in words


def test_a_sheet_on_the_closed_side_of_a_mold(tmp_path: Path) -> None:
    """A mug on its base, over whose base the sheet lies: no node ever moves."""
    told = _collect_warnings(tmp_path, _with_profile([[0.0, 0.0], [0.12, 0.0], [0.12, 0.05]]))
    assert len(told) == 1 and "the whole sheet lies on the mold at the start" in told[0] and "mold.rotate" in told[0]


def test_a_law_that_lets_go_is_told_with_the_stretch(tmp_path: Path) -> None:
    law = 'model = "yeoh"\nc1 = 2e5\nc2 = {c2}\nc3 = 0.0\n'
    text = scenes.FILE.replace('model = "mooney-rivlin"\nc = 0.2e6\nalpha = 0.1\n', law)
    assert _collect_warnings(tmp_path, text.format(c2=1e3)) == []
    # dW/dI1 = c1 + 2 c2 (I1 - 3) is zero at I1 = 13: 2 x^2 + x^-4 for x = 2.546.
    told = _collect_warnings(tmp_path, text.format(c2=-1e4))
    assert len(told) == 1 and "is unstable: its energy decreases beyond an equibiaxial stretch of 2.55" in told[0]


_BUCK = """
[parison]
shape = "disc"
radius = 0.1
elements = 60
thickness = 1.0e-3
[material]
model = "neo-hookean"
c = 2.0e5
density = 1000.0
[pressure]
time = [0.0, 1.0]
value = [0.0, 1.0e4]
[mold]
shape = "revolved"
profile = [[0.0, {gap}], [0.03, {gap}], [0.04, 0.05], [0.1, 0.05]]
segments = 24
[mold.motion]
direction = [0.0, 0.0, {way}]
time = [0.0, 0.5]
displacement = [0.0, {far}]
[solver]
end_time = 1.0
"""


def _cut(scene: jaxform.Scene) -> Any:
    """Axes with the cut of a scene's picture."""
    axes = new_figure(8, 7.5, "").add_axes((0.1, 0.1, 0.8, 0.8))
    plots._draw_cut(axes, scene, survey(scene))
    return axes


@pytest.mark.parametrize(
    ("gap", "way", "far", "warned"),
    [(0.001, 1.0, 0.05, True), (0.02, 2.0, 0.03, True), (0.001, -1.0, 0.05, False), (0.02, -1.0, 0.3, False)],
)
def test_a_mold_that_moves_off_is_warned_of_and_where_it_ends_is_drawn(
    tmp_path: Path, gap: float, way: float, far: float, warned: bool
) -> None:
    """Not one that comes to the sheet, nor one that goes through it and far beyond."""
    file = tmp_path / "buck.toml"
    file.write_text(_BUCK.format(gap=gap, way=way, far=far))
    with warnings.catch_warnings(record=True) as heard:
        warnings.simplefilter("always")
        scene = jaxform.load(file)
    told = [str(one.message) for one in heard if "mold.motion.direction" in str(one.message)]
    assert len(told) == warned
    if warned:
        assert f"{gap:.3g} m from the sheet at first, {gap + far:.3g} m at 0.5 s" in told[0] and str(file) in told[0]
    axes = _cut(scene)
    drawn = {line.get_label(): np.concatenate(line.get_segments()) for line in axes.collections}
    shift = drawn["mold at the end"] - drawn["mold"]
    np.testing.assert_allclose(shift, np.broadcast_to([0.0, 1e3 * far * np.sign(way)], shift.shape), atol=1e-6)
    # The buck is below the sheet, though z is up in the scene.
    assert axes.yaxis_inverted()


_TRAY = """
[parison]
shape = "rectangle"
size = [0.12, 0.1]
element_size = 0.01
thickness = 1e-3
[material]
model = "neo-hookean"
c = 1e5
density = 1000.0
[pressure]
time = [0.0, 1.0]
value = [0.0, 1e4]
[mold]
shape = "file"
path = "tray.stl"
[solver]
end_time = 1.0
"""


@pytest.mark.parametrize(("pockets", "level"), [(((0.02, 0.04), (0.06, 0.08)), 30.0), (((0.03, 0.07),), 50.0)])
def test_a_tray_is_cut_through_its_pockets(
    tmp_path: Path, pockets: tuple[tuple[float, float], ...], level: float
) -> None:
    """Not along the web between them; where the middle is as deep, there. The cavity opens upwards in the picture."""
    x, y = np.meshgrid(np.linspace(-0.01, 0.13, 57), np.linspace(-0.01, 0.11, 49), indexing="ij")
    deep = np.any([(y > low) & (y < high) for low, high in pockets], axis=0) & (x > 0.02) & (x < 0.1)
    points = np.stack([x, y, np.where(deep, 0.03, 0.0)], axis=-1).reshape(-1, 3)
    meshes.write_stl(tmp_path / "tray.stl", points, grids.union_jack(56, 48))
    (tmp_path / "tray.toml").write_text(_TRAY)
    axes = _cut(jaxform.load(tmp_path / "tray.toml"))
    assert abs(float(axes.get_title().split()[-2]) - level) <= 10.0
    mold = {line.get_label(): np.concatenate(line.get_segments()) for line in axes.collections}["mold"]
    np.testing.assert_allclose([mold[:, 1].min(), mold[:, 1].max()], [0.0, 30.0], atol=1e-4)
    assert axes.yaxis_inverted()


def test_arrows_of_the_pressure_stand_on_a_tube(tmp_path: Path) -> None:
    """They are the normals of its wall, whatever its length."""
    sheet = 'shape = "tube"\nradius = 0.02\nlength = 0.2\nelement_size = 0.01\n'
    text = sheet.join(_TRAY.split('shape = "rectangle"\nsize = [0.12, 0.1]\nelement_size = 0.01\n'))
    text = text[: text.index("[mold]")] + text[text.index("[solver]") :]
    (tmp_path / "tube.toml").write_text(text)
    axes = _cut(jaxform.load(tmp_path / "tube.toml"))
    arrows = np.array([np.subtract(arrow.xy, arrow.xyann) * np.sign(arrow.xyann) for arrow in axes.texts])
    assert len(arrows) == 7
    np.testing.assert_allclose(arrows[:, 1], 0.0, atol=1e-6)
    assert np.all(arrows[:, 0] > 10.0)
    assert not axes.yaxis_inverted()

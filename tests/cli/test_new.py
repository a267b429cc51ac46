"""`jaxform new`: its folder is a scene with the sheet over the opening of the mold, whatever the pose of the mold."""

from __future__ import annotations

import os
import shutil
import tomllib
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from jaxform.cli import command, session
from jaxform.core.errors import InputError
from jaxform.io import files, scene_text, scene_wizard
from jaxform.io.scene_checks import survey
from jaxform.mesh import meshes
from jaxform.mesh.meshes import Mesh
from jaxform.tools import molds

pytestmark = pytest.mark.quick


@pytest.fixture(autouse=True, scope="module")
def _own_cache() -> Iterator[None]:
    """The command keeps compiled programs; the tests keep theirs to themselves."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(session, "cache_folder", lambda: None)
        yield


def write(path: Path, mold: Mesh, unit: float, degrees: tuple[float, ...] = (0.0, 0.0, 0.0)) -> Path:
    """An STL file in a unit [m], turned, and far from the origin."""
    moved = mold.positions @ molds.rotation(np.array(degrees)).T + [0.5, -0.3, 0.2]
    meshes.write_stl(path, moved / unit, mold.triangles)
    return path


def dish(*, hole: bool = False) -> Mesh:
    """Open at z = 0, to a radius of 0.08 within a flange to 0.1, 0.03 deep, perhaps with a hole in its bottom."""
    profile = [[0.01 if hole else 0.0, 0.03], [0.06, 0.03], [0.08, 0.0], [0.1, 0.0]]
    shape = molds.revolved(profile=profile, segments=60)
    return Mesh(shape.vertices, shape.triangles)


@pytest.mark.parametrize(
    ("unit", "degrees", "words"),
    [
        (0.001, (0.0, 0.0, 0.0), "millimetres"),
        (0.0254, (180.0, 0.0, 0.0), "inches"),
        (1.0, (20.0, 100.0, -40.0), "metres"),
    ],
)
def test_the_opening_is_in_z_0_and_the_mold_behind_it(tmp_path, capfd, unit, degrees, words):
    mold = write(tmp_path / "dish.stl", dish(), unit, degrees)
    folder = tmp_path / "scene"
    assert command.main(["new", str(folder), "--mold", str(mold)]) == 0
    said = capfd.readouterr()
    assert (
        said.err == "" and f"assumed to be {words}" in said.out and f"jaxform check {folder / 'scene.toml'}" in said.out
    )
    # Numbers that are inches may be meant as millimetres.
    assert ("give --scale 0.001 where it is in millimetres" in said.out) == (words == "inches")
    assert sorted(path.name for path in folder.iterdir()) == ["dish.stl", "scene.toml", "study.toml"]
    assert (folder / "dish.stl").read_bytes() == mold.read_bytes()
    scene = files.load(folder / "scene.toml")
    assert scene.mold is not None
    walls = np.asarray(scene.mold.vertices)
    radius = np.linalg.norm(walls[:, :2], axis=1)
    np.testing.assert_allclose(
        np.interp(radius, [0.0, 0.06, 0.08, 0.1], [0.03, 0.03, 0.0, 0.0]), walls[:, 2], atol=2e-4
    )
    seen = survey(scene)
    assert 0.081 < seen.sheet[1, 0] < 0.09 and seen.direction == "towards +z" and seen.behind == 0.0
    assert seen.overlap is not None and seen.overlap > 0.999
    study = files.read_study(folder / "study.toml")
    assert study.scene.data == tomllib.loads((folder / "scene.toml").read_text())


def _boxes(depths: list[float], widths: list[float] | None = None) -> Mesh:
    """Pockets 0.1 long, and as wide if nothing else is given, side by side in a flange, with upright walls."""
    sides, corners = [], np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])

    def level(low: list[float], high: list[float], height: float) -> None:
        flat = np.array(low) + corners * np.subtract(high, low)
        sides.append(np.column_stack([flat, np.full(4, height)]))

    widths = widths or [0.1] * len(depths)
    begins = [0.02 * (k + 1) + sum(widths[:k]) for k in range(len(depths) + 1)]
    for y, high in ((0.0, 0.02), (0.12, 0.14)):
        level([0.0, y], [begins[-1], high], 0.0)
    for x in begins:
        level([x - 0.02, 0.02], [x, 0.12], 0.0)
    for x, width, depth in zip(begins, widths, depths, strict=False):
        level([x, 0.02], [x + width, 0.12], depth)
        rim = [[x, 0.02], [x + width, 0.02], [x + width, 0.12], [x, 0.12]]
        for a, b in zip(rim, rim[1:] + rim[:1], strict=True):
            sides.append(np.array([[*a, 0.0], [*b, 0.0], [*b, depth], [*a, depth]]))
    triangles = [[4 * k + i for i in half] for k in range(len(sides)) for half in ((0, 1, 2), (0, 2, 3))]
    return Mesh(np.concatenate(sides), np.array(triangles))


@pytest.mark.parametrize("degrees", [(0.0, 0.0, 0.0), (180.0, 0.0, 0.0), (20.0, 100.0, -40.0)])
def test_a_pocket_half_as_deep_as_another_is_one_pocket(tmp_path, degrees):
    """Its bottom lies half way down, where pockets are looked for: rounding once made thousands of it."""
    made = scene_wizard.draft([write(tmp_path / "clam.stl", _boxes([0.06, 0.03]), 0.001, degrees)])
    assert made.pocket == pytest.approx(0.05, rel=0.03) and made.levels == 0
    assert made.draw == pytest.approx(1 + 0.06 / 0.05 * 2, rel=0.03)


def test_small_pockets_count_together(tmp_path):
    made = scene_wizard.draft([write(tmp_path / "row.stl", _boxes([0.06] * 5), 0.001)])
    assert made.pocket == pytest.approx(0.05, rel=0.03)


def test_a_slit_is_left_open(tmp_path, capfd):
    """The sheet would go in at one place first, and meet itself."""
    mold = write(tmp_path / "slit.stl", _boxes([0.04, 0.04], [0.1, 0.006]), 0.001)
    made, plain = scene_wizard.draft([mold]), scene_wizard.draft([write(tmp_path / "box.stl", _boxes([0.04]), 0.001)])
    assert made.slit == pytest.approx(0.003, rel=0.2) and plain.slit is None
    assert made.pocket == pytest.approx(0.05, rel=0.03) and made.pressure < 0.5 * plain.pressure
    assert command.main(["new", str(tmp_path / "scene"), "--mold", str(mold)]) == 0
    assert "has slits about 5.5 mm wide" in capfd.readouterr().err
    assert (
        "Not enough to blow the sheet into slits about 5.5 mm wide" in (tmp_path / "scene" / "scene.toml").read_text()
    )


def test_a_hole_is_closed_and_what_is_given_counts(tmp_path, capfd):
    mold = write(tmp_path / "dish.stl", dish(hole=True), 0.001)
    folder = tmp_path / "scene"
    assert command.main(["new", str(folder), "--mold", str(mold), "--scale", "0.002", "--thickness", "0.0015"]) == 0
    assert "covers.stl closes 1 hole\n" in capfd.readouterr().out
    document = files.read_scene(folder / "scene.toml")
    assert document.data["parison"]["thickness"] == 0.0015 and document.data["mold"]["scale"] == 0.002
    scene = files.build(document)
    assert scene.mold is not None
    corner = np.asarray(scene.mold.vertices)[np.asarray(scene.mold.triangles)]
    lid = corner[np.linalg.norm(corner[..., :2], axis=2).max(1) < 0.0201]
    area = 0.5 * np.linalg.norm(np.cross(lid[:, 1] - lid[:, 0], lid[:, 2] - lid[:, 0]), axis=1).sum()
    np.testing.assert_allclose(area, 30 * 0.02**2 * np.sin(2 * np.pi / 60), rtol=1e-4)
    np.testing.assert_allclose(lid[..., 2], 0.06, atol=1e-6)


def test_a_rib_thinner_than_elements_is_met_by_edge_contact(tmp_path, capfd, monkeypatch):
    """A ring 0.8 mm wide and 18 mm high on the dish's bottom: sides are held at its edges, and nothing warns.

    At one 3 mm wide no side needs to be held, but the sheet folds at it, too. Each file is written once, though the
    scene is built from its mold before it is written.
    """
    copied, copy = [], shutil.copyfile
    monkeypatch.setattr(shutil, "copyfile", lambda source, target: copied.append(target) or copy(source, target))
    for name, width in (("smooth", 0.0), ("wide", 3e-3), ("ribbed", 8e-4)):
        low, high, ring = 0.0305 - 0.5 * width, 0.0305 + 0.5 * width, name == "ribbed"
        rib = [[low, 0.03], [low, 0.012], [high, 0.012], [high, 0.03]] if width else []
        shape = molds.revolved(profile=[[0.0, 0.03], *rib, [0.06, 0.03], [0.08, 0.0], [0.1, 0.0]], segments=60)
        mold = write(tmp_path / f"{name}.stl", Mesh(shape.vertices, shape.triangles), 1.0)
        folder = tmp_path / name
        assert command.main(["new", str(folder), "--mold", str(mold)]) == 0
        said = capfd.readouterr()
        text = (folder / "scene.toml").read_text()
        assert ("edge_contact = true" in text) is ring
        assert ("self_contact = true" in text) is (width > 0.0), "the sheet folds where it hangs over ribs"
        assert ("a rib or pin thinner than elements" in said.out) is ring
        assert said.err == ""
        assert command.main(["check", str(folder / "scene.toml")]) == 0
        said = capfd.readouterr()
        assert said.err == "" and ("as long with sides at sharp edges" in said.out) is ring
    assert len(copied) == 3


def test_a_folder_with_files_is_kept(tmp_path, capfd):
    mold = write(tmp_path / "dish.stl", dish(), 0.001)
    assert command.main(["new", str(tmp_path), "--mold", str(mold)]) == 2
    assert f"FOLDER = '{tmp_path}': exists and is not empty" in capfd.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ["dish.stl"]
    before = mold.read_bytes()
    # The mold that exists already is the scene's.
    assert command.main(["new", str(tmp_path), "--mold", str(mold), "--force", "--quiet"]) == 0
    assert mold.read_bytes() == before and capfd.readouterr().out == ""


def test_molds_that_are_in_the_folder_are_not_overwritten(tmp_path, capfd):
    folder, whole = tmp_path / "scene", dish()
    flange = np.linalg.norm(whole.positions[whole.triangles][..., :2], axis=2).min(1) > 0.079
    paths = [tmp_path / "a.stl", folder / "a.stl"]
    folder.mkdir()
    for path, some in zip(paths, (~flange, flange), strict=True):
        write(path, Mesh(whole.positions, whole.triangles[some]), 0.001)
    before = [path.read_bytes() for path in paths]
    assert command.main(["new", str(folder), "--mold", *map(str, paths), "--force"]) == 0
    assert [path.read_bytes() for path in paths] == before
    assert (folder / "a-2.stl").read_bytes() == before[0]
    assert files.read_scene(folder / "scene.toml").data["mold"]["path"] == ["a-2.stl", "a.stl"]
    # The covers of holes have a name of their own.
    holed = write(folder / "covers.stl", dish(hole=True), 0.001)
    before = [holed.read_bytes(), (folder / "scene.toml").read_bytes()]
    capfd.readouterr()
    assert command.main(["new", str(folder), "--mold", str(holed), "--force"]) == 2
    error = capfd.readouterr().err
    assert "--mold = " in error and "would be overwritten by the covers" in error and error.count("\n") == 1
    assert [holed.read_bytes(), (folder / "scene.toml").read_bytes()] == before


def test_names_that_are_no_text_are_written_as_text(tmp_path):
    paths = [tmp_path / part / os.fsdecode(b"a\xff.stl") for part in ("one", "two")]
    for path in paths:
        path.parent.mkdir()
        path.touch()
    assert scene_text._names(tmp_path, paths) == ["a?.stl", "a?-2.stl"]


def test_bad_input_is_told_in_one_line(tmp_path, capfd):
    flat = tmp_path / "flat.stl"
    meshes.write_stl(flat, np.array([[0, 0, 0], [9, 0, 0], [9, 9, 0], [0, 9, 0]], float), [[0, 1, 2], [0, 2, 3]])
    for given, words in (
        (["--mold", str(flat)], "no opening was found"),
        (["--mold", str(tmp_path / "none.stl")], "does not exist"),
        (["--mold", str(flat), "--scale", "0"], "--scale = 0.0"),
        (["--mold", str(flat), "--thickness", "nan"], "--thickness = nan"),
        ([], "--mold"),
    ):
        assert command.main(["new", str(tmp_path / "scene"), *given]) == 2
        error = capfd.readouterr().err
        assert words in error and error.count("\n") == 1
    assert not (tmp_path / "scene").exists()


SCENE = """
[parison]
shape = "outline"
thickness = 1.0e-3
elements = 60
{}
[material]
model = "neo-hookean"
c = 0.2e6
density = 1000.0
[pressure]
time = [0.0]
value = [1.0e4]
[mold]
shape = "revolved"
profile = [[0.0, 0.06], [0.06, 0.06], [0.08, 0.02]]
segments = 24
[solver]
end_time = 0.1
"""


def outline(tmp_path: Path, lines: str) -> files.SceneDocument:
    (tmp_path / "scene.toml").write_text(SCENE.format(lines))
    return files.read_scene(tmp_path / "scene.toml")


def test_a_folder_after_the_mold_is_said_to_come_before_it(tmp_path, capfd):
    mold, folder = write(tmp_path / "dish.stl", dish(), 0.001), tmp_path / "scene"
    assert command.main(["new", "--mold", str(mold), str(folder)]) == 2
    assert "FOLDER, which has to be named before --mold" in capfd.readouterr().err
    assert not folder.exists()


def test_an_outline_in_a_scene_file(tmp_path):
    scene = files.build(outline(tmp_path, "polygon = [[-0.05, -0.05], [0.05, -0.05], [0.05, 0.05], [-0.05, 0.05]]"))
    positions = np.asarray(scene.parison.positions)
    np.testing.assert_array_equal(positions[:, 2], 0.0)
    np.testing.assert_array_equal(scene.parison.clamped, np.isclose(abs(positions).max(1), 0.05))
    scene = files.build(outline(tmp_path, "mold_rim = true"))
    positions, clamped = np.asarray(scene.parison.positions), np.asarray(scene.parison.clamped)
    np.testing.assert_allclose(positions[:, 2], 0.02, atol=1e-9)
    # On the rim's 24 sides, or on their chords where an element is longer than a side.
    radius = np.linalg.norm(positions[clamped, :2], axis=1)
    assert radius.max() < 0.08 * (1 + 1e-9) and radius.min() > 0.08 * np.cos(np.pi / 24) * 0.999


@pytest.mark.parametrize(
    ("lines", "words"),
    [
        ("", "parison.polygon: no planform is given"),
        ("polygon = [[0, 0], [1, 0], [0, 1]]\nmold_rim = true", "parison.polygon: is given together with mold_rim"),
        ("polygon = [[0.0, 0.0], [1.0, 0.0]]", "parison.polygon = [[0.0, 0.0], [1.0, 0.0]]: is too short"),
        ('mold_rim = true\nplanes = ["x"]', "parison.planes = ['x']: is not possible with mold_rim"),
        ("polygon = [[0.0, 0.0], [0.1, 0.1], [0.1, 0.0], [0.0, 0.1]]", "crosses or touches itself at (0.05, 0.05) m"),
    ],
)
def test_wrong_outlines_in_a_scene_file(tmp_path, lines, words):
    with pytest.raises(InputError) as told:
        files.build(outline(tmp_path, lines))
    assert words in str(told.value) and "scene.toml" in str(told.value)


def _sector(share: float) -> Mesh:
    """So much of the dish, from the half plane y = 0, x > 0 on."""
    profile = np.array([[0.0, 0.03], [0.06, 0.03], [0.08, 0.0], [0.1, 0.0]])
    angle = 2 * np.pi * share * np.arange(round(60 * share) + 1) / round(60 * share)
    points = np.stack([np.outer(np.cos(angle), profile[:, 0]), np.outer(np.sin(angle), profile[:, 0])], axis=2)
    points = np.dstack([points, np.broadcast_to(profile[:, 1], points.shape[:2])]).reshape(-1, 3)
    place = np.arange(len(points)).reshape(len(angle), 4)
    a, b, c, d = place[:-1, :-1], place[:-1, 1:], place[1:, :-1], place[1:, 1:]
    triangles = np.concatenate([np.stack(corners, 2).reshape(-1, 3) for corners in ((a, b, d), (a, d, c))])
    return Mesh(points, triangles.astype(np.int32))


@pytest.mark.parametrize(("share", "planes"), [(0.5, ["y"]), (0.25, ["x", "y"])])
def test_a_mold_that_is_cut_is_completed(tmp_path, capfd, share, planes):
    # Triangles without an area, at the axis, are left out.
    mesh = _sector(share)
    corners = mesh.positions[mesh.triangles]
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    mold = write(tmp_path / "cut.stl", Mesh(mesh.positions, mesh.triangles[area > 1e-12]), 0.001)
    folder = tmp_path / "scene"
    assert command.main(["new", str(folder), "--mold", str(mold)]) == 0
    said = capfd.readouterr().err
    # The file is moved away from the origin.
    levels = {"x": "500.0", "y": "-300.0"}
    assert f"looks cut in {' and '.join(f'{axis} = {levels[axis]}' for axis in planes)}: images.stl" in said
    document = files.read_scene(folder / "scene.toml")
    assert document.data["mold"]["path"] == ["cut.stl", "images.stl"]
    scene = files.build(document)
    assert scene.mold is not None
    walls = np.asarray(scene.mold.vertices)[np.unique(np.asarray(scene.mold.triangles))]
    radius = np.linalg.norm(walls[:, :2], axis=1)
    np.testing.assert_allclose(
        np.interp(radius, [0.0, 0.06, 0.08, 0.1], [0.03, 0.03, 0.0, 0.0]), walls[:, 2], atol=2e-4
    )
    # As much of it on either side of both planes.
    np.testing.assert_allclose([walls[:, :2].min(0), walls[:, :2].max(0)], [[-0.1, -0.1], [0.1, 0.1]], atol=2e-4)
    assert 0.081 < survey(scene).sheet[1, 0] < 0.09


@pytest.mark.parametrize("step", [0.001, 0.005, 0.02])
def test_the_rim_around_the_cavity_is_clamped_on_not_a_lower_flange(tmp_path, capfd, step):
    profile = [[0.0, 0.03], [0.03, 0.03], [0.04, 0.0], [0.046, 0.0], [0.046, step], [0.07, step]]
    ringed = molds.revolved(profile=profile, segments=60)
    mold = write(tmp_path / "ringed.stl", Mesh(ringed.vertices, ringed.triangles), 0.001)
    folder = tmp_path / "scene"
    assert command.main(["new", str(folder), "--mold", str(mold)]) == 0
    said = capfd.readouterr()
    assert said.err == "" and "drawn 30 mm deep" in said.out and "covers" not in said.out
    scene = files.load(folder / "scene.toml")
    assert scene.mold is not None and np.asarray(scene.mold.vertices)[:, 2].min() == pytest.approx(0.0, abs=1e-6)
    assert 0.0405 < survey(scene).sheet[1, 0] < 0.046


def test_a_flange_that_is_a_little_uneven_is_not_tilted(tmp_path, capfd):
    shape = dish()
    uneven = shape.positions + np.random.default_rng(1).normal(0.0, 1e-5, shape.positions.shape)
    mold = write(tmp_path / "dish.stl", Mesh(uneven, shape.triangles), 0.001)
    assert command.main(["new", str(tmp_path / "scene"), "--mold", str(mold)]) == 0
    said = capfd.readouterr()
    assert said.err == "" and "pushed along (0, 0, 1) of the file" in said.out and "clamped on the flange" in said.out

"""`jaxform new --process stretch-blow`: scenes for bottles that run the first time, and what is refused."""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import pytest

import jaxform
from jaxform.cli.command import main
from jaxform.mesh import meshes, topology
from jaxform.mesh.meshes import Mesh
from jaxform.tools import bottles, molds, revolution
from tests.cli.test_new_extrusion import SQUARE, loft, squat, with_handle

BOTTLE = [[0, 6], [20, 5], [32, 0], [42, 3], [45, 10], [45, 190], [30, 250], [13.5, 285], [13.5, 300], [0, 300]]


def _write(path: Path, profile: list[list[float]], rotate: list[float] | None = None, segments: int = 48) -> Path:
    """An STL of a bottle, in the unit of the profile, turned and moved."""
    shape = molds.revolved(profile=profile, segments=segments)
    turn = molds.rotation(np.array(rotate or [0.0, 0.0, 0.0]))
    meshes.write_stl(path, shape.vertices @ turn.T + [12.0, -7.0, 3.0], shape.triangles)
    return path


def _new(folder: Path, mold: Path, *more: str) -> int:
    return main(["new", str(folder), "--mold", str(mold), "--quiet", *more])


@pytest.mark.long
def test_scene_of_a_turned_bottle_in_millimetres_runs_the_first_time(tmp_path: Path) -> None:
    mold, folder = _write(tmp_path / "large.stl", BOTTLE, [90.0, 0.0, 20.0]), tmp_path / "new"
    assert _new(folder, mold, "--process", "stretch-blow") == 0
    scene = jaxform.load(folder / "scene.toml")  # warnings are errors here
    assert scene.mold is not None
    np.testing.assert_allclose(np.ptp(np.asarray(scene.mold.vertices), axis=0), [0.09, 0.09, 0.303], rtol=3e-3)
    assert main(["simulate", str(folder / "scene.toml"), "--out", str(tmp_path / "out"), "--quiet"]) == 0
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert summary["status"] == "ok" and summary["warnings"] == [] and summary["contact_fraction"] > 0.999
    # A wall of some half a millimetre, as wanted; the bottle is a quarter of it.
    assert 0.4e-3 < summary["thickness"]["mean"] < 0.7e-3 and 0.05 < 4.0 * summary["mass"] < 0.075


OVAL = [(z, 1.1 * a, 0.75 * b, 1.0) for z, a, b, _ in SQUARE[:-3]]
OVAL += [(188, 12.5, 12.5, 1.0), (195, 12, 12, 1.0), (215, 12, 12, 1.0)]
TURN = molds.rotation(np.array([25.0, 40.0, 70.0]))


def _turn(mesh: Mesh) -> Mesh:
    """The mesh turned, off the origin."""
    return Mesh(mesh.positions @ TURN.T + [50.0, -60.0, 70.0], mesh.triangles, {})


@pytest.mark.long
@pytest.mark.parametrize("kind", ["oval", "square"])
def test_scene_of_a_bottle_that_is_not_round_is_right_the_first_time(tmp_path: Path, kind: str) -> None:
    mesh, folder = _turn(loft(SQUARE if kind == "square" else OVAL)), tmp_path / "new"
    meshes.write_stl(tmp_path / "bottle.stl", mesh.positions, mesh.triangles)
    assert _new(folder, tmp_path / "bottle.stl", "--process", "stretch-blow") == 0
    scene = jaxform.load(folder / "scene.toml")  # warnings are errors here
    assert scene.mold is not None
    places = np.asarray(scene.mold.vertices)
    wide = sorted(np.ptp(places[:, :2], axis=0))
    np.testing.assert_allclose(wide, [0.054, 0.07] if kind == "square" else [0.0405, 0.077], rtol=1e-3)
    np.testing.assert_allclose([places[:, 2].min(), places[:, 2].max()], [-0.00213, 0.2107], rtol=5e-3)
    if kind == "oval":
        return
    assert main(["simulate", str(folder / "scene.toml"), "--out", str(tmp_path / "out"), "--quiet"]) == 0
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    # A node stays free in the sharp corner of the bottom.
    assert summary["status"] == "ok" and summary["warnings"] == [] and summary["contact_fraction"] > 0.99
    assert summary["penetration_max"] < 0.5 * summary["thickness"]["mean"] and summary["energy"]["balance_error"] < 1e-2
    assert 0.35e-3 < summary["thickness"]["mean"] < 0.55e-3


@pytest.mark.long
def test_of_a_bottle_no_more_is_modelled_than_its_symmetry_asks() -> None:
    square = loft(SQUARE)
    quarter = bottles.find_body(_turn(square))
    assert quarter.symmetry == "quarter"
    # Turned back: the axes of the file, either way round, and the planes of symmetry in x and y.
    np.testing.assert_allclose(np.abs(quarter.rotation @ TURN).max(axis=1), 1.0, rtol=1e-6)
    one_sided = square.positions + np.outer(np.sin(square.positions[:, 2] / 215 * np.pi) ** 2, [4.0, 0.0, 0.0])
    half = bottles.find_body(_turn(Mesh(one_sided, square.triangles, {})))
    assert half.symmetry == "half"
    np.testing.assert_allclose(np.abs(half.rotation[0] @ TURN), [0.0, 1.0, 0.0], atol=1e-3)
    way = square.positions[:, 2] / 215 * np.pi
    twisted = square.positions + np.stack([4.0 * np.sin(way) ** 2, 4.0 * np.sin(way) * np.sin(2 * way), 0 * way], 1)
    assert bottles.find_body(Mesh(twisted, square.triangles, {})).symmetry == "none"


def test_half_of_a_closed_bottle_as_a_solid_is_the_whole_bottle() -> None:
    """A half that is closed by the face of its cut, of a bottle with a wall: its outside, and nothing of the cut."""
    half = squat("half jar")
    found = bottles.find_body(Mesh(half.positions @ TURN.T, half.triangles, {}))
    revolved, neck = revolution.mean_revolution(found.mesh)
    assert found.symmetry == "quarter" and topology.count_handles(found.mesh.triangles) == 0
    np.testing.assert_allclose([revolved.radius, revolved.length, neck], [60.0, 0.98 * 86.0, 36.0], rtol=5e-3)
    np.testing.assert_allclose(found.rotation[2] @ TURN, [0.0, 0.0, -1.0], atol=1e-3)


def test_a_handle_is_refused_with_the_process_that_can_make_it(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    mesh = _turn(with_handle())
    meshes.write_stl(tmp_path / "bottle.stl", mesh.positions, mesh.triangles)
    assert _new(tmp_path / "new", tmp_path / "bottle.stl", "--process", "stretch-blow") == 2
    error = capsys.readouterr().err
    assert "handle" in error and "--process extrusion-blow" in error and error.count("\n") == 1


def test_a_flask_whose_narrow_sides_are_too_far_from_its_neck_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    mesh = squat("flask")
    meshes.write_stl(tmp_path / "flask.stl", mesh.positions, mesh.triangles)
    assert _new(tmp_path / "new", tmp_path / "flask.stl", "--process", "stretch-blow") == 2
    error = capsys.readouterr().err
    # 70 mm from the axis, by a preform of 10.5 mm; of the mean section, which is 38 mm wide, 3.8 times.
    assert "stretched 6.7 times" in error and error.count("\n") == 1


def test_findings_are_printed(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    mold = _write(tmp_path / "large.stl", BOTTLE, segments=96)
    assert main(["new", str(tmp_path / "new"), "--mold", str(mold), "--process", "stretch-blow"]) == 0
    text = capsys.readouterr().out
    assert re.search(r"300 mm long, (90|89\.\d) mm wide with a neck of (27|26\.9) mm", text)
    assert "neck at (12, -7, 303) along (0, 0, -1)" in text
    assert (tmp_path / "new" / "study.toml").exists()


def test_without_a_process_a_solid_bottle_is_said_to_look_like_one(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    mold = _write(tmp_path / "small.stl", [[0, 0], [20, 0], [20, 60], [9, 70], [9, 80], [0, 80]])
    assert main(["new", str(tmp_path / "new"), "--mold", str(mold)]) == 0
    assert "a round body with a neck" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("profile", "more", "words"),
    [
        (BOTTLE, ["--process", "extrusion-blow", "--drape"], "--drape"),
        (BOTTLE, ["--process", "stretch-blow", "--drape"], "--drape"),
        (BOTTLE, ["--process", "stretch-blow", "--plug", "auto"], "--plug"),
        (BOTTLE, ["--process", "stretch-blow", "--thickness", "-1"], "--thickness"),
        (
            BOTTLE,
            ["--process", "stretch-blow", "--thickness", "1"],
            "--thickness = 1.0: is not less than the radius of",
        ),
        (BOTTLE, ["--process", "extrusion-blow", "--thickness", "0.5"], "is not less than the radius of the parison"),
        (BOTTLE, ["--drape", "--direction=+x", "--thickness", "3"], "is not less than the width of the sheet"),
        ([[0, 0], [30, 0], [29, 100], [0, 100]], ["--process", "stretch-blow"], "has no neck"),
        ([[0, 0], [60, 0], [60, 90], [5, 120], [5, 130], [0, 130]], ["--process", "stretch-blow"], "neck is narrow"),
    ],
)
def test_what_cannot_be_stretch_blown_is_refused_in_a_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], profile: list[list[float]], more: list[str], words: str
) -> None:
    mold = _write(tmp_path / "one.stl", profile)
    status = _new(tmp_path / "new", mold, *more)
    error = capsys.readouterr().err
    assert status == 2 and words in error and error.count("\n") == 1
    assert not (tmp_path / "new").exists()


def test_a_box_is_no_bottle_and_thermoforming_is_what_it_was(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    shape = molds.box_insert()
    meshes.write_stl(tmp_path / "box.stl", shape.vertices, shape.triangles)
    assert _new(tmp_path / "bottle", tmp_path / "box.stl", "--process", "stretch-blow") == 2
    assert "is not a body of revolution" in capsys.readouterr().err
    written = []
    for name, more in (("one", []), ("other", ["--process", "thermoforming"])):
        assert _new(tmp_path / name, tmp_path / "box.stl", *more) == 0
        written.append((tmp_path / name / "scene.toml").read_text())
    assert written[0] == written[1]

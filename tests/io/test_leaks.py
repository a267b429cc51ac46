"""Holes in side walls of a mold, before which a sheet lies, are named before a run with place and size."""

from __future__ import annotations

import warnings
from pathlib import Path

import numpy as np
import pytest

import jaxform
from benchmarks.strangers import file_molds
from jaxform import molds, shapes
from jaxform.cli import command, simulate_command
from jaxform.io import files
from jaxform.io.scene_checks import warn_of_side_holes
from jaxform.tools.molds import rotation
from tests import scenes

SCENE = """
[parison]
shape = "rectangle"
size = [{size}]
elements = 200
thickness = 1.0e-3
{sheet}
[material]
model = "mooney-rivlin"
c = 0.2e6
alpha = 0.1
density = 1000.0
[pressure]
time = [0.0, 0.1]
value = [0.0, 4.0e4]
[mold]
shape = "file"
path = "mold.stl"
scale = 0.001
rotate = [180.0, 0.0, 0.0]
translate = [{place}]
[solver]
end_time = 0.12
damping = 100.0
"""
# Axis across the walls, range along them and range of height [mm].
WINDOWS = [(0, -20.0, 20.0, 12.0, 24.0)]
NOTCH = [(1, -15.0, 15.0, 25.0, 40.0)]


def _write(folder: Path, holes: list[tuple[int, float, float, float, float]], *, quarter: bool = False) -> Path:
    """A box of 200 x 120 x 40 mm with walls of 5 mm, upside down over a sheet as large as its opening."""
    file_molds._wall_mesh([100.0, 60.0], 40.0, 5.0, holes).export(folder / "mold.stl")
    sheet = 'symmetry = "quarter"' if quarter else ""
    path = folder / "scene.toml"
    path.write_text(SCENE.format(size="0.19, 0.11", sheet=sheet, place="0.095, 0.055, 0.04"))
    return path


def _complaints(path: Path) -> list[str]:
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        warn_of_side_holes(files.build(files.read_scene(str(path))), str(path))
    return [str(one.message) for one in told if "hole" in str(one.message)]


@pytest.mark.parametrize("quarter", [False, True])
def test_windows_in_the_walls_are_named_where_they_are(tmp_path: Path, quarter: bool) -> None:
    (said,) = _complaints(_write(tmp_path, WINDOWS, quarter=quarter))
    assert "2 holes in side walls" in said and "let `jaxform new` cover it" in said
    size, place = said.split("the largest ")[1].split(" m wide at (")
    where = np.array([float(number) for number in place.split(")")[0].split(",")])
    assert float(size) == pytest.approx(0.04, abs=0.003)
    # The walls' inner sides are at x = 0 and 0.19, the windows 16 to 28 mm behind the sheet.
    assert min(abs(where[0]), abs(where[0] - 0.19)) < 0.003
    np.testing.assert_allclose(where[1:], [0.055, 0.022], atol=0.002)


def test_a_notch_in_the_rim_is_a_hole_too(tmp_path: Path) -> None:
    (said,) = _complaints(_write(tmp_path, NOTCH))
    assert "2 holes in side walls" in said


def test_a_whole_box_and_one_at_a_distance_have_none(tmp_path: Path) -> None:
    path = _write(tmp_path, [])
    assert _complaints(path) == []
    # The sheet is 5 mm before the rim, open all round.
    path.write_text(path.read_text().replace("0.055, 0.04]", "0.055, 0.045]"))
    assert _complaints(path) == []


@pytest.mark.parametrize(("radius", "windows"), [(0.06, False), (0.05, False), (0.06, True)])
def test_a_sheet_as_wide_as_the_flange_is_blown_through_windows_alone(radius: float, windows: bool) -> None:
    """Cells on a flange's rim, of which it has less than half, are no hole."""
    shape = molds.revolved(profile=[[0.0, 0.072], [0.031, 0.072], [0.0375, 0.0], [0.06, 0.0]], segments=96)
    middle = shape.vertices[shape.triangles].mean(1)
    cut = (np.abs(middle[:, 0]) > 0.9 * np.hypot(*middle[:, :2].T)) & (0.01 < middle[:, 2]) & (middle[:, 2] < 0.07)
    sheet = shapes.disc(radius=radius, elements=300, symmetry="quarter")
    scene = jaxform.build_scene(
        parison=jaxform.make_parison(sheet.positions, sheet.triangles, 1e-3, sheet.clamped, sheet.fixed),
        material=scenes.mooney(0.1),
        pressure=jaxform.make_pressure([0.0, 0.1], [0.0, 0.2]),
        solver=jaxform.make_solver(end_time=0.12, damping=100.0),
        mold=jaxform.make_mold(shape.vertices, shape.triangles[~cut] if windows else shape.triangles),
    )
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        warn_of_side_holes(scene)
    said = [str(one.message) for one in told if "side wall" in str(one.message)]
    assert len(said) == windows and all("the largest 0.071 m wide" in words for words in said)


def test_the_command_says_so(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    assert command.main(["check", str(_write(tmp_path, WINDOWS))]) == 0
    assert "2 holes in side walls" in capfd.readouterr().err


def test_a_simulation_says_so_too(tmp_path: Path) -> None:
    document, warned = files.read_scene(str(_write(tmp_path, WINDOWS))), []
    simulate_command._warn_of_scene(files.build(document), document, warned)
    assert sum("2 holes in side walls" in words for words in warned) == 1


def test_which_way_the_sheet_is_pushed_does_not_matter(tmp_path: Path) -> None:
    """A scene in Python, of a sheet in x = 0 that is pushed towards -x."""
    shape = file_molds._wall_mesh([100.0, 60.0], 40.0, 5.0, WINDOWS)
    turn = rotation(np.array([0.0, -90.0, 0.0]))
    flat = jaxform.shapes.rectangle(size=(0.19, 0.11), elements=200)
    places = 1e-3 * np.asarray(shape.vertices) * [1, -1, -1] + [0.095, 0.055, 0.04]
    scene = jaxform.build_scene(
        parison=jaxform.make_parison(flat.positions @ turn.T, flat.triangles, 1e-3, flat.clamped),
        material=scenes.mooney(0.1),
        pressure=jaxform.make_pressure([0.0, 0.1], [0.0, 0.2]),
        solver=jaxform.make_solver(end_time=0.12, damping=100.0),
        mold=jaxform.make_mold(places @ turn.T, np.asarray(shape.faces)),
    )
    with pytest.warns(jaxform.InputWarning, match="2 holes in side walls"):
        warn_of_side_holes(scene)

"""Messages before and after a run: `check` of scenes and studies, warnings, and the files of the part."""

from __future__ import annotations

import json
import threading
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import meshio
import numpy as np
import pytest
from PIL import Image

import jaxform
from jaxform.cli import check_command, command, session
from jaxform.core.store import Store
from jaxform.io import files
from jaxform.mesh.meshes import read_mesh
from jaxform.runs import host
from tests import scenes

WRONG = scenes.FILE.replace("[[0.0, 0.05], [0.055, 0.05], [0.1, 0.0]]", "[[0.0, -0.05], [0.055, -0.05], [0.1, 0.0]]")
STUDY = """
scene = "scene.toml"
[[variable]]
kind = "thickness-profile"
along = "radius"
knots = 3
bounds = [5.0e-4, 2.0e-3]
[objective]
kind = "least-mass"
minimum = 0.0005
[solver]
method = "adam"
iterations = 17
"""


@pytest.fixture(autouse=True, scope="module")
def _own_cache() -> Iterator[None]:
    """The command keeps compiled programs; the tests keep theirs to themselves."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(session, "cache_folder", lambda: None)
        yield


def test_check_shows_a_mold_on_the_wrong_side(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "scene.toml").write_text(WRONG)
    out = tmp_path / "out"
    assert command.main(["check", str(tmp_path / "scene.toml"), "--out", str(out)]) == 0
    said = capfd.readouterr()
    for words in (
        "sheet with its images: -0.1 to 0.1 x -0.1 to 0.1 x 0 to 0 m",
        "thickness is 0.005 times its size",
        "1 piece, 1 rim, 9 of 30 nodes clamped, 11 on symmetry planes",
        "up to 20000 Pa, pushes the sheet towards +z",
        "-0.1 to 0.1 x -0.1 to 0.1 x -0.05 to 0 m",
        "0 % of the mold's area lies on that side",
        "first step",
        "GB of memory",
    ):
        assert words in said.out, said.out
    lines = said.err.splitlines()
    assert len(lines) == 1 and lines[0].startswith("jaxform: warning: ") and "away from the mold" in lines[0]
    assert [path.name for path in out.iterdir()] == ["check.png"]
    with Image.open(out / "check.png") as picture:
        assert picture.size == (1600, 750)


def test_check_reads_studies(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "scene.toml").write_text(scenes.FILE)
    (tmp_path / "study.toml").write_text(STUDY)
    assert command.main(["check", str(tmp_path / "study.toml")]) == 0
    said = capfd.readouterr()
    assert said.err == ""
    assert "variable: thickness-profile, along radius, knots 3, bounds [0.0005, 0.002]" in said.out
    assert "objective: least-mass" in said.out and "minimum 0.0005" in said.out
    assert "search: adam, iterations 17" in said.out and "40 elements" in said.out
    (tmp_path / "study.toml").write_text(STUDY.replace("knots = 3", "knots = 0"))
    assert command.main(["check", str(tmp_path / "study.toml")]) == 2
    assert "study.toml" in capfd.readouterr().err
    # Studies that optimize refuses before it begins.
    thin = STUDY.replace("minimum = 0.0005", "minimum = 0.01")
    assert thin != STUDY
    (tmp_path / "study.toml").write_text(thin)
    assert command.main(["check", str(tmp_path / "study.toml")]) == 2
    assert "study.toml: objective.minimum = 0.01: cannot be satisfied" in capfd.readouterr().err


def test_check_of_a_study_whose_target_is_another_scene_runs_nothing(capfd: pytest.CaptureFixture[str]) -> None:
    assert command.main(["check", "pressure-schedule"]) == 0
    said = capfd.readouterr()
    assert "objective: target" in said.out and "cup-slow" in said.out and said.err == ""


def test_what_simulate_warns_of_is_in_its_summary(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "scene.toml").write_text(WRONG + "[output]\nframes = 3\n")
    out = tmp_path / "out"
    assert command.main(["simulate", str(tmp_path / "scene.toml"), "--out", str(out), "--quiet"]) == 0
    lines = [line.removeprefix("jaxform: warning: ") for line in capfd.readouterr().err.splitlines()]
    summary = json.loads((out / "summary.json").read_text())
    assert summary["warnings"] == lines and len(set(lines)) == len(lines) == 3
    for line, words in zip(lines, ("away from the mold", "nothing touched", "left the mold's box"), strict=True):
        assert words in line
    _check_files(out, summary)


def test_the_scene_is_warned_of_before_the_run(
    tmp_path: Path, capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    ended, run, look_over = threading.Event(), host.run, files.review_scene

    def run_and_say(*args: Any, **kwargs: Any) -> jaxform.Result:
        result = run(*args, **kwargs)
        ended.set()
        return result

    def look_over_afterwards(*args: Any) -> None:
        assert ended.wait(200)
        look_over(*args)

    monkeypatch.setattr(host, "run", run_and_say)
    monkeypatch.setattr(files, "review_scene", look_over_afterwards)
    (tmp_path / "scene.toml").write_text(WRONG)
    assert command.main(["simulate", str(tmp_path / "scene.toml"), "--out", str(tmp_path / "out"), "--quiet"]) == 0
    first, second, third = capfd.readouterr().err.splitlines()
    assert "away from the mold" in first and "nothing touched" in second and "left the mold's box" in third


def _check_files(out: Path, summary: dict) -> None:
    """The formed part and the mold as meshes, the sheet as the first frame, and the thinnest place."""
    part, mold, stl = meshio.read(out / "final.vtu"), meshio.read(out / "mold.vtu"), read_mesh(out / "formed.stl")
    faces = part.cells[0].data
    np.testing.assert_allclose(stl.positions[stl.triangles], part.points[faces], atol=1e-7)
    assert mold.points[:, 2].min() == -0.05 and len(mold.cells[0].data) == 144
    thin = int(np.argmin(part.cell_data["thickness"][0]))
    found = summary["thinnest"]
    np.testing.assert_allclose(found["thickness"], part.cell_data["thickness"][0][thin])
    np.testing.assert_allclose(found["formed"], part.points[faces[thin]].mean(0))
    np.testing.assert_allclose(found["initial"], part.point_data["reference"][faces[thin]].mean(0))
    names = sorted(path.name for path in (out / "frames").iterdir())
    assert names == ["frame_0000.vtu", "frame_0001.vtu", "frame_0002.vtu"]
    first = meshio.read(out / "frames" / names[0])
    np.testing.assert_array_equal(first.points, part.point_data["reference"])
    assert set(first.point_data) == set(part.point_data) and set(first.cell_data) == set(part.cell_data)
    np.testing.assert_allclose(first.cell_data["thickness"][0], 1e-3)
    assert 'timestep="0.0"' in (out / "frames.pvd").read_text()


def test_python_users_hear_before_and_after(tmp_path: Path) -> None:
    (tmp_path / "scene.toml").write_text(WRONG)
    with pytest.warns(jaxform.InputWarning, match="away from the mold"):
        scene = jaxform.load(tmp_path / "scene.toml")
    with warnings.catch_warnings(record=True) as heard:
        warnings.simplefilter("always")
        result = jaxform.run(scene)
    assert all(warning.category is jaxform.InputWarning for warning in heard) and len(heard) == 2
    assert [str(warning.message) for warning in heard] == jaxform.summarize(result, scene)["warnings"]


def test_time_to_compile_grows_with_what_the_scene_has(tmp_path: Path) -> None:
    """A closing half with two plates has 1.78 times the program of a cup, and compiles 2.2 times as long."""
    seconds = []
    for name in ("cup-slow", "extrusion-bottle"):
        document = files.read_scene(name)
        lines = list(check_command.scene_lines(document, files.build(document), Store(tmp_path)))
        seconds.append(next(float(line.split()[4]) for line in lines if line.startswith("compiles first")))
    assert seconds[0] == 6.0 and 2.0 < seconds[1] / seconds[0] < 2.4

"""The command line: what it writes, and that bad input is one clear line and exit status 2."""

from __future__ import annotations

import argparse
import json
import os
import re
import subprocess
import sys
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jax
import meshio
import numpy as np
import pytest
from PIL import Image

import jaxform
import optimize
from jaxform import molds
from jaxform.cli import command, session
from jaxform.io import files
from tests import scenes

SCENE = scenes.FILE

STUDY = """
scene = "scene.toml"
[[variable]]
kind = "thickness-profile"
along = "radius"
knots = 3
bounds = [5.0e-4, 2.0e-3]
[[variable]]
kind = "pressure"
bounds = [-1.0, 4.0e4]
increasing = true
[objective]
kind = "target"
thickness = 0.9e-3
[solver]
method = "{method}"
iterations = 2
"""


@pytest.fixture(autouse=True, scope="module")
def _own_cache() -> Iterator[None]:
    """The command keeps compiled programs; the tests keep theirs to themselves."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(session, "cache_folder", lambda: None)
        yield


def _write(folder: Path, text: str = SCENE, name: str = "scene.toml") -> Path:
    path = folder / name
    path.write_text(text)
    return path


def _picture_size(path: Path) -> tuple[int, int]:
    with Image.open(path) as picture:
        assert len(picture.convert("RGB").getcolors(1 << 24) or []) > 20  # not blank
        return picture.size


def _assert_refused(capfd: pytest.CaptureFixture[str], *arguments: str) -> str:
    """The one line on standard error of a command that must exit with 2."""
    assert command.main(list(arguments)) == 2
    captured = capfd.readouterr()
    assert captured.out == ""
    lines = captured.err.splitlines()
    assert len(lines) == 1, captured.err
    return lines[0]


def test_simulate_writes_what_the_contract_says(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    scene_file = _write(tmp_path, SCENE + "[output]\nframes = 3\n")
    out = tmp_path / "out"
    assert command.main(["simulate", str(scene_file), "--out", str(out)]) == 0
    captured = capfd.readouterr()
    assert "status: ok" in captured.out
    assert captured.err == ""
    summary = json.loads((out / "summary.json").read_text())
    assert summary["status"] == "ok"
    for key in (
        "elements_initial",
        "elements_final",
        "nodes_final",
        "steps",
        "windows",
        "compile_seconds",
        "run_seconds",
        "contact_fraction",
        "mass",
        "penetration_max",
    ):
        assert summary[key] >= 0, key
    assert set(summary["thickness"]) == {"min", "mean", "max", "cv"}
    assert set(summary["energy"]) == {
        "strain",
        "kinetic",
        "external_work",
        "tool_work",
        "gravity_work",
        "pre_stretch_work",
        "damping_loss",
        "contact_loss",
        "refinement_loss",
        "viscous_loss",
        "cooling_loss",
        "friction_loss",
        "kinetic_peak",
        "balance_error",
        "quasi_static_error",
    }
    assert summary["energy"]["balance_error"] < 1e-2
    part = meshio.read(out / "final.vtu")
    assert set(part.point_data) == {"reference", "thickness", "initial_thickness", "contact_time", "tool"}
    assert set(part.cell_data) == {"thickness", "stretch_1", "stretch_2", "level"}
    np.testing.assert_allclose(part.point_data["initial_thickness"], 1e-3)
    wall, first, second = (part.cell_data[key][0] for key in ("thickness", "stretch_1", "stretch_2"))
    np.testing.assert_allclose(wall * first * second, 1e-3, rtol=1e-9)
    rim = np.hypot(*part.point_data["reference"][:, :2].T) > 0.0999
    np.testing.assert_allclose(part.points[rim], part.point_data["reference"][rim], atol=1e-15)
    assert np.all(part.point_data["contact_time"][rim] == 0)
    assert np.array_equal(part.point_data["tool"], np.where(part.point_data["contact_time"] > 0, 0, -1))
    assert (out / "frames.pvd").read_text().count("<DataSet") == 3
    assert len(list((out / "frames").glob("*.vtu"))) == 3
    assert _picture_size(out / "thickness.png") == (1600, 700)
    assert _picture_size(out / "process.png") == (1100, 600)  # pressure and contact
    assert summary["symmetry_planes"] == {"x": 0.0, "y": 0.0}
    assert (out / "simulated.toml").read_text() == scene_file.read_text()
    page = (out / "report.html").read_text()
    assert f"{1e3 * summary['thickness']['min']:.4g} mm" in page
    (out / "report.html").unlink()
    assert command.main(["report", str(out)]) == 0
    assert capfd.readouterr().out == f"report in {out / 'report.html'}\n"
    assert (out / "report.html").read_text() == page
    assert f"DIR = '{tmp_path}': holds no summary.json" in _assert_refused(capfd, "report", str(tmp_path))
    # Files of an earlier run are not taken for this one's.
    scene_file.write_text(re.sub(r"\[mold\].*?\[solver\]", "[solver]", SCENE, flags=re.DOTALL))
    assert command.main(["simulate", str(scene_file), "--out", str(out), "--force", "--quiet"]) == 0
    assert not (out / "frames.pvd").exists() and not (out / "mold.vtu").exists()


@pytest.mark.parametrize("place", ["results.summary.measure_penetration", "runs.host.warnings_of_part"])
def test_what_is_stopped_while_it_measures_keeps_its_part(
    tmp_path: Path, capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, place: str
) -> None:
    """Ctrl-C in any measure after the last step: the files are there, and say what is not known."""

    def interrupt(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    out = tmp_path / "out"
    monkeypatch.setattr(f"jaxform.{place}", interrupt)
    assert command.main(["simulate", str(_write(tmp_path)), "--out", str(out)]) == session.INTERRUPTED
    assert "Traceback" not in capfd.readouterr().err
    summary = json.loads((out / "summary.json").read_text())
    assert summary["status"] == "ok" and summary["thickness"]["min"] > 0
    assert all(summary[key] is None for key in ("penetration_max", "penetration_place", "gap_max", "gap_place"))
    assert "interrupted before" in summary["warnings"][-1]
    assert len(meshio.read(out / "final.vtu").points) == summary["nodes_final"]
    monkeypatch.undo()
    assert command.main(["report", str(out)]) == 0
    # A second run finds all programs.
    assert command.main(["simulate", str(_write(tmp_path)), "--out", str(out), "--force"]) == 0
    summary = json.loads((out / "summary.json").read_text())
    assert summary["penetration_max"] is not None and summary["gap_max"] is not None
    assert not any("interrupted before" in sentence for sentence in summary["warnings"])


def test_what_takes_longer_than_a_moment_is_named(
    capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    begun = threading.Event()
    monkeypatch.setattr(session, "_MOMENT", 0.0)
    monkeypatch.setattr("builtins.print", lambda *words, **_: (sys.stdout.write(str(words[0])), begun.set()))
    with session.report_waiting(argparse.Namespace(quiet=False), "comparing the part"):
        assert begun.wait(30)
    assert "comparing the part ..." in capfd.readouterr().out
    # A wait in two parts, before and after files are written, is reported once; another one, too.
    arguments = argparse.Namespace(quiet=False)
    for words in ("comparing the part", "comparing the part", "drawing the part"):
        begun.clear()
        with session.report_waiting(arguments, words):
            begun.wait(0.5)
    assert capfd.readouterr().out == "comparing the part ...drawing the part ..."
    begun.clear()
    with session.report_waiting(argparse.Namespace(quiet=True), "comparing the part"):
        pass
    assert not begun.is_set()


def test_results_of_which_no_report_can_be_made_are_a_warning(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    session.write_report(tmp_path)
    assert "warning: there is no report.html: " in capfd.readouterr().err


def test_the_box_with_an_insert_tells_where_an_element_cuts_its_edge(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    """Coarse elements hang over the insert's edges; the place is one of them."""
    text = SCENE.replace('shape = "disc"\nradius = 0.1', 'shape = "rectangle"\nsize = [0.3, 0.2]')
    mold = text[text.index('shape = "revolved"') : text.index("[solver]")]
    text = text.replace(mold, 'shape = "box-insert"\nfill = false\n').replace("end_time = 0.05", "end_time = 0.15")
    out = tmp_path / "out"
    assert command.main(["simulate", str(_write(tmp_path, text)), "--out", str(out)]) == 0
    summary = json.loads((out / "summary.json").read_text())
    x, y, z = summary["penetration_place"]
    assert summary["thickness"]["mean"] < summary["penetration_max"] < 0.02
    assert 0.08 < x < 0.16 and 0.05 < y < 0.11 and 0.039 < z < 0.06
    sentence = next(words for words in summary["warnings"] if "cuts an edge of the mold" in words)
    assert sentence in capfd.readouterr().err and "set solver.edge_contact = true" in sentence


def test_a_mold_from_an_stl_file_in_mm_with_its_triangles_turned_makes_the_same_part(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    shape = molds.revolved(profile=[[0.0, 50.0], [55.0, 50.0], [100.0, 0.0]], segments=48)
    turned = shape.triangles.copy()
    turned[::2] = turned[::2, ::-1]
    mold = meshio.Mesh(shape.vertices, [("triangle", np.concatenate([turned, turned[:1]]))])
    mold.write(tmp_path / "cup.stl", binary=True)
    begin, end = SCENE.index('shape = "revolved"'), SCENE.index("[solver]")
    from_file = SCENE.replace(SCENE[begin:end], 'shape = "file"\npath = "cup.stl"\nscale = 1.0e-3\n')
    longer = [text.replace("end_time = 0.05", "end_time = 0.2") for text in (SCENE, from_file)]
    built_in, own = (files.load(_write(tmp_path, text)) for text in longer)
    assert own.mold is not None and own.mold.dropped == 1
    one, other = jaxform.run(built_in), jaxform.run(own)
    assert np.asarray(one.contact_time).max() > 0
    # STL holds single precision.
    np.testing.assert_allclose(other.thickness, one.thickness, rtol=1e-4)


@pytest.mark.parametrize("dtype", scenes.short_first(["float64", "float32"]))
def test_both_precisions_run_the_dish(tmp_path: Path, capfd: pytest.CaptureFixture[str], dtype: str) -> None:
    try:
        assert command.main(["simulate", "dish-coarse", "--out", str(tmp_path), "--dtype", dtype, "--quiet"]) == 0
    finally:
        jax.config.update("jax_enable_x64", True)
    summary = json.loads((tmp_path / "summary.json").read_text())
    np.testing.assert_allclose(summary["thickness"]["mean"], 9.098e-5, rtol=2e-3)
    assert summary["contact_fraction"] > 0.9


def test_quiet_says_nothing_and_force_overwrites(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    scene_file, out = _write(tmp_path), tmp_path / "out"
    out.mkdir()
    (out / "mine.txt").write_text("keep")
    line = _assert_refused(capfd, "simulate", str(scene_file), "--out", str(out))
    assert "--force" in line and str(out) in line
    assert command.main(["simulate", str(scene_file), "--out", str(out), "--force", "--quiet"]) == 0
    captured = capfd.readouterr()
    assert captured.out + captured.err == ""
    assert (out / "mine.txt").read_text() == "keep"


def test_an_unstable_run_exits_with_3_and_keeps_what_it_has(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    free = SCENE.replace(SCENE[SCENE.index("[mold]") : SCENE.index("[solver]")], "")
    blast = free.replace("value = [0.0, 2.0e4]", "value = [1.0e9, 1.0e9]").replace("damping = 100.0\n", "")
    out = tmp_path / "out"
    assert command.main(["simulate", str(_write(tmp_path, blast)), "--out", str(out)]) == 3
    captured = capfd.readouterr()
    assert len([line for line in captured.err.splitlines() if "warning" not in line]) == 1
    summary = json.loads((out / "summary.json").read_text())
    assert summary["status"] != "ok" and "at t =" in summary["status"]
    assert {"final.vtu", "thickness.png", "report.html"} <= {path.name for path in out.iterdir()}


def test_check_runs_no_step_and_names_what_is_skipped(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    free = SCENE[: SCENE.index("[mold]")] + "[solver]\nend_time = 0.05\n"
    assert command.main(["check", str(_write(tmp_path, free))]) == 0
    text = capfd.readouterr().out
    for words in ("40 elements", "no mold", "damping (none given)", "frames"):
        assert words in text, text
    assert "quasi-static process" not in text
    assert list(tmp_path.iterdir()) == [tmp_path / "scene.toml"]


def test_a_wish_for_a_slow_process(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    wrong = _write(tmp_path, SCENE + 'quasi_static = "yes"\n', "wrong.toml")
    line = _assert_refused(capfd, "check", str(wrong))
    assert "wrong.toml" in line and "solver.quasi_static" in line and "yes" in line
    # The whole pressure within a hundredth of the time that the scene takes for it.
    hasty = SCENE.replace("[0.0, 0.2]", "[0.0, 0.002]") + "quasi_static = true\n"
    scene_file, out = _write(tmp_path, hasty), tmp_path / "out"
    assert command.main(["check", str(scene_file)]) == 0
    assert "quasi-static process" in capfd.readouterr().out
    assert command.main(["simulate", str(scene_file), "--out", str(out), "--quiet"]) == 0
    lines = capfd.readouterr().err.splitlines()
    assert len(lines) == 1 and "not quasi-static" in lines[0] and "pressure.time" in lines[0]
    summary = json.loads((out / "summary.json").read_text())
    assert summary["warnings"] == [lines[0].removeprefix("jaxform: warning: ")]
    assert summary["energy"]["quasi_static_error"] > 0.01


def test_scenes_lists_all_and_each_can_be_checked(capfd: pytest.CaptureFixture[str]) -> None:
    assert command.main(["scenes"]) == 0
    text = capfd.readouterr().out
    for name in ("dish", "dish-coarse", "bowl", "dish-uniform-wall"):
        assert name in text
    assert len({line.index("jaxform") for line in text.splitlines()}) == 1, "columns are aligned"
    for name in ("dish", "bowl"):
        assert command.main(["check", name]) == 0


def test_an_interruption_before_any_design_says_how_to_go_on(
    tmp_path: Path, capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    _write(tmp_path)
    study, out = _write(tmp_path, STUDY.format(method="lbfgs") + "starts = 3\n", "study.toml"), tmp_path / "out"
    recorded = [0, 0]

    def interrupt_search(*_: object, journal: Any, **__: object) -> None:
        for number, count in enumerate(recorded, 1):
            own = journal.of_start(number)
            for k in range(count):
                own.ask("gradient", [float(k)], lambda: {"value": 1.0})
        raise KeyboardInterrupt

    monkeypatch.setattr("optimize.solve", interrupt_search)
    for counts, expected in (
        ([0, 0], "interrupted before anything was recorded"),
        ([2, 3], "interrupted; 5 evaluations are recorded: resume with --resume"),
    ):
        recorded[:] = counts
        arguments = ["optimize", str(study), "--out", str(out), "--quiet", "--force"]
        assert command.main(arguments) == session.INTERRUPTED
        assert capfd.readouterr().err == f"jaxform: {expected}\n"


@pytest.mark.long
def test_an_interrupted_search_says_how_to_go_on_and_does(
    tmp_path: Path, capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    _write(tmp_path)
    study, out = _write(tmp_path, STUDY.format(method="lbfgs"), "study.toml"), tmp_path / "out"
    write = optimize.write_history

    def interrupt(path: Path, rows: list[dict[str, Any]]) -> None:
        write(path, rows)
        if len(rows) == 2 and not asked:
            asked.append(1)
            raise KeyboardInterrupt

    asked: list[int] = []
    monkeypatch.setattr("optimize.write_history", interrupt)
    assert command.main(["optimize", str(study), "--out", str(out)]) == 0
    told = capfd.readouterr().out
    assert "stopped by interrupted" in told and "continues from here with --resume" in told
    assert command.main(["optimize", str(study), "--out", str(out), "--resume"]) == 0
    told = capfd.readouterr().out
    assert "reused from the journal" in told and "--resume" not in told


@pytest.mark.parametrize("method", scenes.short_first(["lbfgs", "adam"]))
def test_optimize_writes_a_better_scene_that_runs(
    tmp_path: Path, capfd: pytest.CaptureFixture[str], method: str
) -> None:
    _write(tmp_path)
    study, out = _write(tmp_path, STUDY.format(method=method), "study.toml"), tmp_path / "out"
    assert command.main(["optimize", str(study), "--out", str(out), "--quiet"]) == 0
    assert capfd.readouterr().err == ""
    rows = np.genfromtxt(out / "history.csv", delimiter=",", names=True)
    assert rows.dtype.names is not None
    assert set(rows.dtype.names) == {
        "evaluation",
        "objective",
        "thickness_rms_error",
        "wall_min",
        "wall_mean",
        "wall_cv",
        "mass",
        "gradient_norm",
        "iteration",
        "simulations",
        "seconds",
    }
    assert rows["objective"].min() < 0.7 * rows["objective"][0]
    assert np.all(np.diff(rows["simulations"]) > 0)
    best = files.load(out / "best.toml")
    again = jaxform.run(best)
    summary = json.loads((out / "summary.json").read_text())
    np.testing.assert_allclose(float(again.mass), summary["mass"], rtol=1e-12)
    wall = np.asarray(again.element_thickness)
    np.testing.assert_allclose(wall.min(), summary["thickness"]["min"], rtol=1e-9)
    assert np.all(np.diff(np.asarray(best.pressure.value)) >= 0)
    page = (out / "report.html").read_text()
    assert "The search" in page and "best.toml" in page and (out / "start.vtu").exists()
    for picture in ("convergence.png", "thickness.png", "design.png"):
        assert _picture_size(out / picture)[0] >= 1200


BAD = [
    ("radius = 0.1", "radius = -0.1", "parison.radius"),
    ("elements = 40", 'elements = "40"', "parison.elements"),
    ("elements = 40", "elemnts = 40", "elements"),
    ("thickness = 1.0e-3", "thickness = -1.0e-3", "parison.thickness"),
    ("thickness = 1.0e-3", "thickness = nan", "parison.thickness"),
    (
        "thickness = 1.0e-3",
        'thickness = {along="radius", at=[0.0, 0.1], value=[1e-3, -1e-3]}',
        "parison.thickness",
    ),
    (
        "thickness = 1.0e-3",
        'thickness = {along="radius", at=[0.1, 0.0], value=[1e-3, 1e-3]}',
        "parison.thickness",
    ),
    ("thickness = 1.0e-3", 'thickness = {file="nowhere.vtu", field="h"}', "nowhere.vtu"),
    ("time = [0.0, 0.2]", "time = [0.2, 0.0]", "pressure.time"),
    ("time = [0.0, 0.2]", "time = [0.0, 0.1, 0.2]", "pressure"),
    ('model = "mooney-rivlin"', 'model = "ogden"', "material.c"),
    ('model = "mooney-rivlin"', 'model = "hookean"', "material.model"),
    ("alpha = 0.1", "", "alpha"),
    ('shape = "disc"', 'shape = "cone"', "parison.shape"),
    ('shape = "revolved"', 'shape = "box-insert"', "mold.profile"),
    ("[solver]", "[refinement]\nmax_level = 40\n[solver]", "refinement.max_level"),
    ("[solver]", "[refinement]\nangel = 4.0\n[solver]", "refinement.angel"),
    ("elements = 40", "elements = 20000\nrefinement.max_level = 14", "parison.refinement"),
    ("[parison]", "refinement = { max_level = 14, angle = -1.0 }\n[parison]", "refinement.angle"),
    ("[0.0, 0.05], [0.055, 0.05], [0.1, 0.0]", "[0.0, 0.02], [0.05, -0.02]", "mold"),
    ("end_time = 0.05", "end_time = 0.0", "solver.end_time"),
    ("end_time = 0.05", "end_time = 1.0e9", "solver.end_time"),
    ("[solver]", "[solver", "TOML"),
    ("[material]", "[materials]", "material"),
]


@pytest.mark.parametrize(("old", "new", "words"), BAD)
def test_bad_scene_is_one_line_that_names_the_place(
    tmp_path: Path, capfd: pytest.CaptureFixture[str], old: str, new: str, words: str
) -> None:
    assert old in SCENE
    scene_file = _write(tmp_path, SCENE.replace(old, new, 1))
    line = _assert_refused(capfd, "check", str(scene_file))
    assert words in line, line
    assert "scene.toml" in line, line


def _mesh_scene(what: str, path: str) -> str:
    if what == "mold":
        return SCENE.replace(
            SCENE[SCENE.index('shape = "revolved"') : SCENE.index("[solver]")],
            f'shape = "file"\npath = "{path}"\n',
        )
    begin, end = SCENE.index('shape = "disc"'), SCENE.index("[material]")
    return SCENE.replace(SCENE[begin:end], f'shape = "file"\npath = "{path}"\nthickness = 1e-3\n')


@pytest.mark.parametrize("what", ["mold", "parison"])
@pytest.mark.parametrize("content", [None, b"", b"no mesh at all", bytes(range(256)) * 3])
def test_a_file_that_is_no_mesh(
    tmp_path: Path, capfd: pytest.CaptureFixture[str], what: str, content: bytes | None
) -> None:
    if content is not None:
        (tmp_path / "part.stl").write_bytes(content)
    line = _assert_refused(capfd, "check", str(_write(tmp_path, _mesh_scene(what, "part.stl"))))
    assert f"{what}.path" in line and "part.stl" in line, line


@pytest.mark.parametrize(
    ("triangles", "words"),
    [
        ([[0, 1, 2], [1, 2, 3]], "invert"),
        ([[0, 1, 2], [0, 1, 4]], "degenerate"),
        ([[0, 1, 2], [1, 3, 2], [1, 2, 5]], ""),
    ],
)
def test_a_parison_file_with_bad_triangles(
    tmp_path: Path, capfd: pytest.CaptureFixture[str], triangles: list[list[int]], words: str
) -> None:
    points = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0], [0.5, 0, 0], [0.6, 0.6, 1]], float) * 0.1
    meshio.Mesh(points, [("triangle", np.array(triangles))]).write(tmp_path / "part.vtu")
    line = _assert_refused(capfd, "check", str(_write(tmp_path, _mesh_scene("parison", "part.vtu"))))
    assert words in line.lower() and "parison" in line, line


def test_an_unclamped_open_parison(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    points = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0]], float) * 0.1
    meshio.Mesh(points, [("triangle", np.array([[0, 1, 2], [1, 3, 2]]))]).write(tmp_path / "part.vtu")
    text = _mesh_scene("parison", "part.vtu").replace("thickness = 1e-3", 'clamp = "none"\nthickness = 1e-3')
    line = _assert_refused(capfd, "check", str(_write(tmp_path, text)))
    assert "clamp" in line, line


@pytest.mark.parametrize(
    "arguments",
    [
        ["simulate", "no-such-scene", "--out", "x"],
        ["simulate", "dish"],
        ["fly"],
        [],
        ["simulate", "dish", "--out", "x", "--dtype", "float16"],
        ["optimize", "dish", "--out", "x"],
    ],
)
def test_bad_arguments(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str], arguments: list[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    _assert_refused(capfd, *arguments)
    assert not (tmp_path / "x").exists()


def test_an_output_folder_that_is_a_file_or_cannot_be_made(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    scene_file = _write(tmp_path)
    blocked = tmp_path / "file"
    blocked.write_text("")
    assert "file" in _assert_refused(capfd, "simulate", str(scene_file), "--out", str(blocked))
    assert "--out" in _assert_refused(capfd, "simulate", str(scene_file), "--out", str(blocked / "below"))
    assert "--out" in _assert_refused(capfd, "simulate", str(scene_file), "--out", "/proc/nowhere")


def test_a_reader_who_leaves_early_stops_nothing() -> None:
    read, write = os.pipe()
    os.close(read)
    with os.fdopen(write) as nobody:
        command = [sys.executable, "-m", "jaxform", "scenes"]
        done = subprocess.run(command, stdout=nobody, stderr=subprocess.PIPE, text=True)
    assert (done.returncode, done.stderr) == (0, "")


_INTERRUPT_IMPORTS = """
import os, signal, sys

class Interrupt:  # as a library that hides what is raised while it is imported
    def find_spec(self, name, *_):
        if name == sys.argv[1]:
            try:
                os.kill(os.getpid(), signal.SIGINT)
            except KeyboardInterrupt:
                pass

signal.signal(signal.SIGINT, signal.default_int_handler)
sys.meta_path.insert(0, Interrupt())
from jaxform.cli import main
sys.exit(main(["check", "dish"]))
"""


@pytest.mark.parametrize("module", ["jaxform.cli.command", "jax"])
def test_an_interruption_while_modules_are_imported_ends_the_command(module: str) -> None:
    command = [sys.executable, "-c", _INTERRUPT_IMPORTS, module]
    done = subprocess.run(command, capture_output=True, text=True)
    assert (done.returncode, done.stdout, done.stderr) == (130, "", "jaxform: interrupted\n")


def test_help_and_the_list_of_scenes_need_no_jax() -> None:
    words = "import sys; from jaxform.cli import main; main(['scenes']); sys.exit('jax' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", words], capture_output=True).returncode == 0
    # All names are there all the same.
    assert {"load", "simulate", "scenes"} < set(dir(jaxform))
    assert all(getattr(jaxform, name) is not None for name in jaxform.__all__)


def test_help_describes_every_argument_of_every_command() -> None:
    subcommands = next(action for action in command._parser()._actions if isinstance(action.choices, dict)).choices
    assert isinstance(subcommands, dict) and len(subcommands) > 10
    silent = [
        f"{name} {action.dest}" for name, sub in subcommands.items() for action in sub._actions if not action.help
    ]
    assert not silent

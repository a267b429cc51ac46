"""Study files: every kind of table is read, what is wrong is one line, and a kill loses nothing."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

import jaxform
import optimize
from jaxform.cli import command, session
from jaxform.io import catalog, files, schema
from jaxform.io.validation import validate
from tests import scenes

SCENE = (
    scenes.FILE.replace(
        "time = [0.0, 0.2]\nvalue = [0.0, 2.0e4]", "time = [0.0, 0.1, 0.2]\nvalue = [0.0, 1.0e4, 2.0e4]"
    )
    .replace("segments = 48", "segments = 24")
    .replace("end_time = 0.05", "end_time = 0.22")
)
PROFILE = 'kind = "thickness-profile"\nalong = "radius"\nknots = 4\nbounds = [5e-4, 2e-3]\n'
TARGET = '[objective]\nkind = "target"\nthickness = 6e-4\n'


def _write(folder: Path, variables: list[str], objective: str = TARGET, solver: str = 'method = "lbfgs"') -> Path:
    (folder / "scene.toml").write_text(SCENE)
    tables = "".join(f"[[variable]]\n{table}\n" for table in variables)
    path = folder / "study.toml"
    path.write_text(f'scene = "scene.toml"\n{tables}{objective}[solver]\n{solver}')
    return path


def test_every_kind_of_variable_and_objective_is_read(tmp_path: Path) -> None:
    variables = [
        PROFILE + 'interpolation = "cubic"\nslope = 0.05',
        'kind = "pressure"\nbounds = [0.0, 4e4]\nrate = 3e5\nend_time = [0.05, 0.22]\nincreasing = true',
        'kind = "scale"\nof = "material.c"\nbounds = [0.5, 2.0]',
        'kind = "scale"\nof = "material.density"\nbounds = [0.5, 2.0]',
    ]
    objective = (
        '[[objective]]\nkind = "uniform"\nweight = 2.0\n[[objective]]\nkind = "least-mass"\n'
        "minimum = 3e-4\nflash = true\n"
        '[[objective]]\nkind = "forming-time"\n[[objective]]\nkind = "kinetic-energy"\n'
        '[[objective]]\nkind = "target"\nthickness = { scene = "scene.toml" }\nlimit = 0.1\n'
    )
    path = _write(tmp_path, variables, objective, 'method = "adam"\nrounds = 3\ngoal = 1e-3\n')
    study = optimize.load_study(path)
    kinds = [type(variable).__name__ for variable in study.variables]
    assert kinds == ["ThicknessProfile", "PressureKnots", "Scale", "Scale"]
    assert (study.method, study.rounds, study.goal) == ("adam", 3, 1e-3)
    assert isinstance(study.objective, optimize.Weighted)
    parts = study.objective.parts
    assert [type(part).__name__ for _, part in parts] == [
        "Uniform",
        "LeastMass",
        "FormingTime",
        "KineticEnergy",
        "Target",
    ]
    assert [weight for weight, _ in parts] == [2.0, 1.0, 1.0, 1.0, 1.0]
    assert isinstance(parts[1][1], optimize.LeastMass) and parts[1][1].flash
    # The wall that the same scene makes is no deviation of its own.
    result = jaxform.run(study.scene)
    assert float(parts[4][1].error(study.scene, result)) < 1e-12


FIELD = 'kind = "thickness-field"\nbounds = [5e-4, 2e-3]\n'
BAD = [
    ([PROFILE + "slope = -1.0"], TARGET, "", "variable[0].slope"),
    ([PROFILE + 'interpolation = "quintic"'], TARGET, "", "variable[0].interpolation"),
    ([PROFILE + 'interpolation = "zones"\nslope = 1.0'], TARGET, "", "variable[0].slope"),
    ([FIELD + "smoothness = -0.1"], TARGET, "", "variable[0].smoothness"),
    ([FIELD + "smothness = 0.1"], TARGET, "", "did you mean smoothness"),
    (['kind = "pressure"\nbounds = [0.0, 4e4]\nend_time = [0.1, 0.5]'], TARGET, "", "longer than the simulation"),
    (['kind = "scale"\nof = "material.a01"\nbounds = [0.5, 2.0]'], TARGET, "", "no such parameter"),
    (['kind = "scale"\nof = "colour"\nbounds = [0.5, 2.0]'], TARGET, "", "choose one of"),
    (['kind = "scale"\nof = "material.c"\nbounds = [0.5, 2.0]'] * 2, TARGET, "", "given twice"),
    ([PROFILE], '[objective]\nkind = "least-mas"\n', "", "did you mean least-mass"),
    ([PROFILE], '[objective]\nkind = "least-mass"\n', "", "objective.minimum"),
    ([PROFILE], '[[objective]]\nkind = "uniform"\nweight = 0.0\n', "", "objective[0].weight"),
    ([PROFILE], TARGET.replace("6e-4", '{ scene = "nowhere" }'), "", "objective.thickness.scene"),
    ([PROFILE], TARGET, 'method = "simplex"', "solver.method"),
    ([PROFILE], TARGET, 'method = "least-squares"\nlearning_rate = 0.1', "learning_rate"),
    ([PROFILE, FIELD], TARGET, "", "two variables"),
    ([PROFILE], '[objective]\nkind = "least-mass"\nminimum = 3e-4\n', 'method = "least-squares"', "sum of squares"),
]


@pytest.mark.parametrize(("variables", "objective", "solver", "words"), BAD)
def test_what_is_wrong_is_one_line(
    tmp_path: Path, capfd: pytest.CaptureFixture[str], variables: list[str], objective: str, solver: str, words: str
) -> None:
    path = _write(tmp_path, variables, objective, solver or 'method = "lbfgs"')
    assert command.main(["optimize", str(path), "--out", str(tmp_path / "out"), "--quiet"]) == 2
    lines = capfd.readouterr().err.splitlines()
    assert len(lines) == 1 and words in lines[0] and "study.toml" in lines[0], lines


def test_the_command_goes_on_after_a_kill(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(session, "cache_folder", lambda: None)
    solver = 'method = "fixed-point"\niterations = 3'
    path, out = _write(tmp_path, [FIELD + "smoothness = 0.05"], TARGET, solver), tmp_path / "out"
    # There is nothing to go on with yet.
    assert command.main(["optimize", str(path), "--out", str(out), "--resume"]) == 0
    told = capfd.readouterr().err
    assert "--resume" in told and "a new one is started" in told and told.count("warning") == 1
    warnings = json.loads((out / "summary.json").read_text())["warnings"]
    assert any("a new one is started" in sentence for sentence in warnings)
    assert json.loads((out / "design.json").read_text())["warnings"] == warnings
    whole = np.genfromtxt(out / "history.csv", delimiter=",", names=True)
    notes = out / "search.jsonl"
    lines = notes.read_text().splitlines(keepends=True)
    assert len(lines) == 1 + len(whole)
    notes.write_text("".join(lines[:3]))
    refused = command.main(["optimize", str(path), "--out", str(out)])
    assert refused == 2 and "--out" in capfd.readouterr().err
    assert command.main(["optimize", str(path), "--out", str(out), "--resume"]) == 0
    assert "2 evaluations were reused" in capfd.readouterr().out
    again = np.genfromtxt(out / "history.csv", delimiter=",", names=True)
    scenes.assert_same(again["objective"], whole["objective"])
    facts = json.loads((out / "design.json").read_text())
    described = (Path(__file__).parents[2] / "docs" / "reference" / "summary.md").read_text()
    assert not [key for key in facts if f"`{key}`" not in described]
    assert facts["after"]["objective"] == again["objective"].min() and facts["gradient_error"] is None
    np.testing.assert_allclose(
        float(jaxform.run(files.load(out / "best.toml")).mass), facts["after"]["mass"], rtol=1e-9
    )
    (tmp_path / "study.toml").write_text(path.read_text().replace("6e-4", "7e-4"))
    assert command.main(["optimize", str(path), "--out", str(out), "--resume"]) == 2
    assert "another study" in capfd.readouterr().err


@pytest.mark.long
def test_starts_on_two_processes_are_those_of_one(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    solver = 'method = "fixed-point"\niterations = 1\nstarts = 3'
    path = _write(tmp_path, [FIELD + "smoothness = 0.05"], TARGET, solver)
    tables = []
    for workers in ("1", "2"):
        out = tmp_path / workers
        assert command.main(["optimize", str(path), "--out", str(out), "--workers", workers]) == 0
        assert "of 3 starts end within 10 %" in capfd.readouterr().out
        tables.append(np.genfromtxt(out / "starts.csv", delimiter=",", names=True, dtype=None, encoding="utf-8"))
        assert list(tables[-1]["start"]) == [1, 2, 3] and set(tables[-1]["status"]) == {"ok"}
        summary = json.loads((out / "summary.json").read_text())["design"]
        assert [row["objective"] for row in summary["starts"]] == list(tables[-1]["objective"])
        assert summary["after"]["objective"] == tables[-1]["objective"].min()
        history = np.genfromtxt(out / "history.csv", delimiter=",", names=True)
        assert history["objective"].min() == tables[-1]["objective"].min()
    # The tests compile with other settings than the processes that they start: all but the last bits are the same.
    np.testing.assert_allclose(tables[0]["objective"], tables[1]["objective"], rtol=1e-10)
    # A study that is begun anew removes what could be taken for its own later.
    path.write_text(path.read_text().replace("starts = 3", "starts = 1"))
    assert command.main(["optimize", str(path), "--out", str(tmp_path / "1"), "--force"]) == 0
    assert not (tmp_path / "1" / "starts.csv").exists() and not list((tmp_path / "1").glob("search.*.jsonl"))


def test_every_built_in_study_is_valid_and_so_is_its_scene() -> None:
    scenes = catalog.built_in("scene")
    for name, path in catalog.built_in("study").items():
        model = validate(schema.StudyFile, catalog.read(path, "study")[2], name)
        assert model.description
        if model.scene in scenes:
            assert files.read_study(name).scene.name == model.scene

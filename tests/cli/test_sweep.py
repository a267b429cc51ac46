"""The command `jaxform sweep`: same bits on any number of workers, nothing compiled twice, nothing lost or repeated."""

from __future__ import annotations

import csv
import json
import multiprocessing
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from PIL import Image

from jaxform.cli import command
from tests import scenes

ROOT = Path(__file__).parents[2]
DEPTHS = [0.035, 0.04, 0.045, 0.05, 0.055, 0.06, 0.065, 0.07]
HEADER = "mold.profile[0][1],mold.profile[1][1],parison.thickness,solver.max_steps"
_NOT_OF_THE_DESIGN = ("seconds",)


@pytest.fixture(autouse=True, scope="module")
def cache(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """A cache of its own for the workers, cold at first."""
    folder = tmp_path_factory.mktemp("cache")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_CACHE_HOME", str(folder))
        patch.delenv("JAX_COMPILATION_CACHE_DIR")
        yield folder / "jaxform"


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A scene and a table of designs: molds of other depths, one design that is wrong and one that is stopped."""
    made = tmp_path_factory.mktemp("sweep")
    (made / "scene.toml").write_text(scenes.FILE)
    rows = [f"{depth},{depth},{1e-3 + 1e-4 * (k % 3)}," for k, depth in enumerate(DEPTHS)]
    rows[2:2] = ["0.05,0.05,-1e-3,", "0.05,0.05,1e-3,20"]
    (made / "table.csv").write_text("\n".join([HEADER, *rows]) + "\n")
    return made


def _arguments(folder: Path, out: Path, *more: str) -> list[str]:
    table = str(folder / "table.csv")
    return ["sweep", table, "--scene", str(folder / "scene.toml"), "--out", str(out), "--quiet", *more]


def _rows(out: Path) -> list[dict[str, str]]:
    with (out / "results.csv").open(newline="") as file:
        return list(csv.DictReader(file))


def _facts(out: Path) -> dict[str, object]:
    return json.loads((out / "sweep.json").read_text())


def _without_times(rows: list[dict[str, str]]) -> list[dict[str, str]]:
    return [{key: text for key, text in row.items() if key not in _NOT_OF_THE_DESIGN} for row in rows]


@pytest.fixture(scope="module")
def sweep_folder(folder: Path, cache: Path) -> Path:
    """The results of two workers on a cold cache."""
    out = folder / "two"
    assert command.main(_arguments(folder, out, "--workers", "2")) == 0
    return out


def test_each_design_is_a_row_and_what_fails_is_named(sweep_folder: Path) -> None:
    rows = _rows(sweep_folder)
    assert [row["design"] for row in rows] == [str(k) for k in range(1, 11)]
    wrong, stopped = rows[2], rows[3]
    assert wrong["status"].startswith("parison.thickness = -0.001: is too small") and wrong["wall_min"] == ""
    assert "limit on steps" in stopped["status"] and float(stopped["wall_min"]) > 0
    good = rows[:2] + rows[4:]
    assert {row["status"] for row in good} == {"ok"}
    assert [float(row["mold.profile[0][1]"]) for row in good] == DEPTHS
    for row in good:
        summary = json.loads((sweep_folder / row["folder"] / "summary.json").read_text())
        for name, text in {"wall_min": "min", "wall_mean": "mean", "wall_cv": "cv"}.items():
            assert float(row[name]) == summary["thickness"][text]
        assert float(row["mass"]) == summary["mass"] and row["flash_mass"] == ""
        assert summary["scene"] == f"small, design {row['design']}"
        assert (sweep_folder / row["folder"] / "final.vtu").exists()
    facts = _facts(sweep_folder)
    assert (facts["designs"], facts["ok"], facts["failed"], facts["computed"]) == (10, 8, 2, 9)
    assert {"mold.profile[0][1]": "m", "wall_min": "m", "mass": "kg"}.items() <= dict(facts["units"]).items()  # type: ignore


def test_two_workers_on_a_cold_cache_compile_nothing_twice(sweep_folder: Path, cache: Path) -> None:
    kept = [path.name for path in (cache / "compiled").iterdir() if path.name.endswith("-cache")]
    # Each program was compiled in one process: another would have counted it, too, or kept it under another name.
    assert _facts(sweep_folder)["programs_compiled"] == len(kept) > 3
    assert sum(name.startswith("jit_advance") for name in kept) == 1


@pytest.mark.long
def test_one_worker_gives_the_same_bits_and_compiles_nothing(folder: Path, sweep_folder: Path) -> None:
    out = folder / "one"
    assert command.main(_arguments(folder, out, "--workers", "1")) == 0
    assert _without_times(_rows(out)) == _without_times(_rows(sweep_folder))
    assert _facts(out)["programs_compiled"] == 0
    for row in _rows(out):
        if row["folder"]:
            one, two = ((place / row["folder"] / "final.vtu").read_bytes() for place in (out, sweep_folder))
            assert one == two


def test_simulate_gives_the_same_bits(folder: Path, sweep_folder: Path) -> None:
    scene = sweep_folder / "designs" / "0005" / "simulated.toml"
    out = folder / "alone"
    done = subprocess.run(
        [sys.executable, "-m", "jaxform.cli", "simulate", str(scene), "--out", str(out), "--quiet"],
        env=os.environ | {"PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        check=False,
    )
    assert (done.returncode, done.stderr) == (0, "")
    assert (out / "final.vtu").read_bytes() == (sweep_folder / "designs" / "0005" / "final.vtu").read_bytes()


@pytest.mark.long
def test_a_worker_that_is_killed_costs_nothing_that_is_recorded(folder: Path, sweep_folder: Path) -> None:
    out = folder / "killed"
    killed: list[int] = []

    def kill() -> None:
        while not killed:
            time.sleep(0.005)
            if (out / "results.csv").exists() and len((out / "results.csv").read_text().splitlines()) > 3:
                for process in multiprocessing.active_children():
                    if process.pid is not None:
                        os.kill(process.pid, signal.SIGKILL)
                        killed.append(process.pid)

    killer = threading.Thread(target=kill, daemon=True)
    killer.start()
    assert command.main(_arguments(folder, out, "--workers", "2")) == 0
    killer.join(timeout=10)
    assert killed
    assert _without_times(_rows(out)) == _without_times(_rows(sweep_folder))
    assert _facts(out)["computed"] == 9


@pytest.mark.long
def test_a_client_that_is_killed_goes_on_where_it_was(folder: Path, sweep_folder: Path) -> None:
    out = folder / "stopped"
    known = os.environ | {"PYTHONPATH": str(ROOT)}
    line = [sys.executable, "-m", "jaxform.cli", *_arguments(folder, out, "--workers", "1")]
    with subprocess.Popen(line, env=known) as client:
        while not (out / "results.csv").exists() or len(_rows(out)) < 4:
            assert client.poll() is None
            time.sleep(0.005)
        client.kill()
    before = {row["digest"]: row for row in _rows(out)}
    assert 4 <= len(before) < 10
    with (out / "results.csv").open("a") as file:
        file.write("9,0.06,0.0")  # as if it had been writing
    assert command.main(_arguments(folder, out, "--workers", "2", "--resume")) == 0
    after = _rows(out)
    # The times are those of the first computation, too.
    assert [row for row in after if row["digest"] in before] == sorted(
        before.values(), key=lambda row: int(row["design"])
    )
    assert _facts(out)["computed"] == 10 - len(before)
    assert _without_times(after) == _without_times(_rows(sweep_folder))


@pytest.mark.long
def test_an_interruption_says_how_to_go_on(folder: Path, sweep_folder: Path) -> None:
    out = folder / "interrupted"
    known = os.environ | {"PYTHONPATH": str(ROOT)}
    # So many rows that the sweep does not end before it is interrupted.
    table = folder / "long.csv"
    table.write_text("\n".join([HEADER, *(f"0.05,0.05,{1e-3 + 1e-6 * k}," for k in range(300))]) + "\n")
    line = [sys.executable, "-m", "jaxform.cli", "sweep", str(table), *_arguments(folder, out, "--workers", "1")[2:]]
    with subprocess.Popen(line, env=known, stderr=subprocess.PIPE, text=True, start_new_session=True) as client:
        # At the first row.
        while not (out / "results.csv").exists() or len(_rows(out)) < 1:
            assert client.poll() is None
            time.sleep(0.001)
        os.killpg(client.pid, signal.SIGINT)
        _, words = client.communicate(timeout=60)
    assert client.returncode == 130
    (said,) = words.splitlines()
    assert said == f"jaxform: interrupted; {len(_rows(out))} rows are recorded: resume with --resume"


@pytest.mark.long
def test_each_row_can_be_a_search(folder: Path, sweep_folder: Path, tmp_path: Path) -> None:
    study = """
scene = "scene.toml"
[[variable]]
kind = "thickness-field"
bounds = [5.0e-4, 2.0e-3]
[objective]
kind = "target"
thickness = 0.9e-3
[solver]
method = "fixed-point"
iterations = 3
[sweep]
[[sweep.variable]]
path = "mold.profile[0][1]"
values = [0.045, 0.05]
"""
    (tmp_path / "scene.toml").write_text(scenes.FILE)
    (tmp_path / "study.toml").write_text(study)
    out = tmp_path / "out"
    options = ["--out", str(out), "--quiet", "--workers", "1"]
    assert command.main(["sweep", str(tmp_path / "study.toml"), "--optimize", *options]) == 0
    rows = _rows(out)
    assert [row["status"] for row in rows] == ["ok", "ok"]
    for row in rows:
        assert 0 < float(row["thickness_rms_error"]) < 0.05 and float(row["objective"]) > 0
        found = json.loads((out / row["folder"] / "design.json").read_text())
        assert found["after"]["thickness_rms_error"] == float(row["thickness_rms_error"])
        assert found["before"]["thickness_rms_error"] > 2 * found["after"]["thickness_rms_error"]
        assert (out / row["folder"] / "best.toml").exists()
    # Without a search it is another design: nothing of the one is taken for the other.
    assert command.main(["sweep", str(tmp_path / "study.toml"), "--resume", *options]) == 0
    assert _facts(out)["computed"] == 2


@pytest.mark.long
def test_a_table_that_has_changed_is_gone_on_with(folder: Path, sweep_folder: Path, tmp_path: Path) -> None:
    lines = (folder / "table.csv").read_text().splitlines()
    (tmp_path / "scene.toml").write_text(scenes.FILE)
    (tmp_path / "table.csv").write_text("\n".join([lines[0], lines[6], lines[5], "0.052,0.052,1.0e-3,", lines[5]]))
    out = tmp_path / "out"
    assert command.main(_arguments(folder, out, "--workers", "1")) == 0
    before = {row["digest"]: row for row in _rows(out)}
    assert command.main(_arguments(tmp_path, out, "--workers", "1", "--resume")) == 0
    rows = _rows(out)
    assert [row["design"] for row in rows] == ["1", "2", "3", "4"] and _facts(out)["computed"] == 1
    for row in (rows[0], rows[1], rows[3]):
        assert row | {"design": ""} == before[row["digest"]] | {"design": ""}
    # Its number is taken by the folder of a design that is still there, or it is free.
    assert rows[2]["folder"] not in {rows[0]["folder"], rows[1]["folder"]} and rows[3] == rows[1] | {"design": "4"}
    summary = json.loads((out / rows[2]["folder"] / "summary.json").read_text())
    assert float(rows[2]["wall_min"]) == summary["thickness"]["min"]
    with (out / "earlier.csv").open(newline="") as file:
        assert len(list(csv.DictReader(file))) == 8
    # Begun anew, nothing of the sweep before is left that could be taken for the new one's.
    (tmp_path / "table.csv").write_text("\n".join(lines[:2]))
    assert command.main(_arguments(tmp_path, out, "--workers", "1", "--force")) == 0
    assert [path.name for path in (out / "designs").iterdir()] == ["0001"] and len(_rows(out)) == 1


def test_the_pictures_show_something_and_a_click_opens_the_part(sweep_folder: Path) -> None:
    for name in ("thinnest_wall.png", "main_effects.png", "scatter_matrix.png"):
        with Image.open(sweep_folder / name) as picture:
            assert len(picture.convert("RGB").getcolors(1 << 24) or []) > 20
    page = (sweep_folder / "report.html").read_text()
    assert page.count("data-part=") == 9 and 'data-part="designs/0001/report.html"' in page
    for name in ("thinnest_wall.png", "main_effects.png", "scatter_matrix.png"):
        assert f'src="{name}"' in page
    assert "http" not in page.replace("http-equiv", "")


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["table.csv", "--out", "x"], "name one with --scene"),
        (["none.csv", "--scene", "dish", "--out", "x"], "none.csv"),
        (["table.csv", "--scene", "dish", "--out", "x", "--workers", "0"], "is not a number of processes"),
        (["table.csv", "--scene", "scene.toml", "--out", "x", "--optimize"], "no objective for --optimize"),
        (["dish-uniform-wall", "--out", "x"], "sweep: is missing"),
        (["table.csv", "--scene", "scene.toml", "--out", "x", "--scheduler", "tcp://127.0.0.1:9"], "--scheduler"),
        (["table.csv", "--scene", "scene.toml", "--out", "."], "exists and is not empty"),
    ],
)
def test_bad_input_is_one_line(
    folder: Path, arguments: list[str], words: str, capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(folder)
    assert command.main(["sweep", *arguments]) == 2
    captured = capfd.readouterr()
    assert captured.out == "" and len(captured.err.splitlines()) == 1 and words in captured.err

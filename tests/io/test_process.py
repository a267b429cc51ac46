"""The process over time, and what results tell of tools: of a run in which the sheet slides on a plug."""

from __future__ import annotations

import csv
import json
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import meshio
import numpy as np
import pytest
from PIL import Image

from jaxform.cli import command, session
from jaxform.core.store import Store
from jaxform.io import files, process
from jaxform.io.report import stored_results
from jaxform.results.summary import contact_shares, contact_shares_over_time
from tests import scenes

PRESSURE = "[pressure]\ntime = [0.0, 0.02, 0.04]\nvalue = [0.0, 0.0, 3.0e4]\n"
PLUG = """
[[tool]]
name = "plug"
shape = "rod"
radius = 0.03
length = 0.05
translate = [0.0, 0.0, -0.001]
direction = [0, 0, 1]
time = [0.0, 0.02]
displacement = [0.0, 0.03]
contact = "coulomb"
friction = 0.3
[output]
frames = 3
"""


@pytest.fixture(autouse=True, scope="module")
def _own_cache() -> Iterator[None]:
    """The command keeps compiled programs; the tests keep theirs to themselves."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(session, "cache_folder", lambda: None)
        yield


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Results of a sheet that a plug pushes, then a pressure."""
    folder = tmp_path_factory.mktemp("process")
    given = "[pressure]\ntime = [0.0, 0.2]\nvalue = [0.0, 2.0e4]\n"
    assert given in scenes.FILE
    (folder / "scene.toml").write_text(scenes.FILE.replace(given, PRESSURE) + PLUG)
    (folder / "out").mkdir()
    for stale in ("tool_old.vtu", "mold.vtu"):
        (folder / "out" / stale).write_text("of what was here before")
    assert command.main(["simulate", str(folder / "scene.toml"), "--out", str(folder / "out"), "--force"]) == 0
    return folder / "out"


def _rows(folder: Path) -> dict[str, np.ndarray]:
    with (folder / "process.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    return {name: np.array([float(row[name]) for row in rows]) for name in rows[0]}


def test_the_table_has_pressure_displacements_and_contact(folder: Path) -> None:
    rows, summary = _rows(folder), json.loads((folder / "summary.json").read_text())
    assert list(rows) == ["time", "pressure", "displacement_plug", "contact_mold", "contact_plug"]
    time = rows["time"]
    assert time[0] == 0.0 and np.all(np.diff(time) > 0.0) and {0.02, 0.04} <= set(time)
    np.testing.assert_allclose(time[-1], summary["time"], rtol=1e-8)
    np.testing.assert_allclose(rows["pressure"], 3e4 * np.clip((time - 0.02) / 0.02, 0.0, 1.0), atol=1e-3)
    share = np.clip(time / 0.02, 0.0, 1.0)
    np.testing.assert_allclose(rows["displacement_plug"], 0.03 * share**2 * (3 - 2 * share), atol=1e-9)
    contact = rows["contact_mold"] + rows["contact_plug"]
    np.testing.assert_allclose(contact[-1], summary["contact_fraction"], atol=1e-8)
    # Only the plug is touched until the pressure rises, then the mold.
    assert rows["contact_mold"][time <= 0.02].max() == 0.0 < rows["contact_plug"][time <= 0.02].max()
    assert rows["contact_mold"][-1] > 0.9 and rows["contact_plug"][-1] < rows["contact_plug"].max()
    with Image.open(folder / "process.png") as picture:
        assert picture.size[0] == 1100


def test_results_tell_which_tool_holds_a_node(folder: Path) -> None:
    final = meshio.read(folder / "final.vtu")
    tool, radius = final.point_data["tool"], np.hypot(*final.points[:, :2].T)
    assert set(np.unique(tool)) <= {-1, 0, 1} and {-1, 0} <= set(np.unique(tool))
    on_mold = np.interp(radius[tool == 0], [0.0, 0.055, 0.1], [0.05, 0.05, 0.0])
    np.testing.assert_allclose(final.points[tool == 0, 2], on_mold, atol=2e-4)  # the mold has 48 facets
    assert np.all(tool[final.point_data["contact_time"] == 0.0] == -1)  # clamped
    first = meshio.read(folder / "frames" / "frame_0000.vtu")
    assert np.all(first.point_data["tool"] == -1)


def test_tools_are_written_where_they_are(folder: Path) -> None:
    names = {path.name for path in folder.iterdir()}
    assert {"tool_plug.vtu", "mold.vtu"} <= names and "tool_old.vtu" not in names
    tips = [meshio.read(folder / "frames" / f"tool_plug_{k:04d}.vtu").points[:, 2].max() for k in range(3)]
    listed = (folder / "frames.pvd").read_text()
    times = [float(part.split('"')[0]) for part in listed.split('timestep="')[4:]]
    share = np.clip(np.array(times) / 0.02, 0.0, 1.0)
    np.testing.assert_allclose(tips, -0.001 + 0.03 * share**2 * (3 - 2 * share), atol=1e-9)
    assert [f'part="1" file="frames/tool_plug_{k:04d}.vtu"' in listed for k in range(3)] == [True] * 3
    assert meshio.read(folder / "tool_plug.vtu").points[:, 2].max() == pytest.approx(0.029)
    assert "mold_0000.vtu" not in listed


def test_the_report_has_the_tool_and_the_process(folder: Path) -> None:
    results = stored_results.read_results(folder)
    assert [tool.name for tool in results.tools] == ["plug"] and results.tools[0].motion is not None
    assert len(results.process) == len(_rows(folder)["time"])
    assert (folder / "report.html").is_file()


def test_contact_over_time_ends_with_that_of_the_end() -> None:
    """Of four elements of one area: one on the mold since 1 s, one on the plug since 2 s, one clamped, one free."""
    made: Any = SimpleNamespace(
        triangles=np.array([[0, 1, 2], [3, 4, 5], [6, 6, 6], [7, 8, 9]]),
        stuck=np.array([1, 1, 1, 0, 0, 0, 1, 0, 0, 0], bool),
        tool=np.array([0, 0, -1, 1, 1, 1, -1, -1, -1, 1]),
        contact_time=np.array([0.5, 1.0, 0.0, 1.0, 2.0, 1.5, 0.0, -1.0, -1.0, 1.0]),
        element_volume=np.ones(4),
        element_thickness=np.ones(4),
    )
    np.testing.assert_allclose(contact_shares(made, 2), [0.25, 0.25])
    found = contact_shares_over_time(made, np.array([0.0, 0.9, 1.0, 1.9, 2.0, 9.0]), 2)
    np.testing.assert_allclose(found, [[0, 0, 0.25, 0.25, 0.25, 0.25], [0, 0, 0, 0, 0.25, 0.25]])


def test_a_process_without_change_has_no_picture(tmp_path: Path) -> None:
    (tmp_path / "scene.toml").write_text(scenes.FILE.replace("value = [0.0, 2.0e4]", "value = [1.0e4, 1.0e4]"))
    scene = files.build_unchecked(files.read_scene(tmp_path / "scene.toml"), Store())
    ended: Any = SimpleNamespace(time=0.05, pressures=None, contacts=None)
    assert process.process_history(scene, ended) is None
    for name in (process.TABLE, process.PICTURE):
        (tmp_path / name).write_text("of what was here before")
    process.write_process(None, tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["scene.toml"]

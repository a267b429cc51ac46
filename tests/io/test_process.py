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

from jaxform.cli import command, session, simulate_command
from jaxform.core.store import Store
from jaxform.io import canvas, files, process
from jaxform.io.report import charts, contents, stored_results
from jaxform.mesh import meshes
from jaxform.results.tool_contact import contact_shares, contact_shares_over_time
from tests import browser, scenes
from tests.io.test_report import _parcel

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
    text = scenes.FILE.replace(given, PRESSURE).replace("end_time = 0.05", "end_time = 0.04")
    (folder / "scene.toml").write_text(text + PLUG)
    (folder / "out").mkdir()
    for stale in ("tool_old.vtu", "mold.vtu"):
        (folder / "out" / stale).write_text("of what was here before")
    assert command.main(["simulate", str(folder / "scene.toml"), "--out", str(folder / "out"), "--force"]) == 0
    return folder / "out"


def _areas(corners: np.ndarray) -> np.ndarray:
    return 0.5 * np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)


def _rows(folder: Path) -> dict[str, np.ndarray]:
    with (folder / "process.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    return {name: np.array([float(row[name]) for row in rows]) for name in rows[0]}


def test_the_table_has_pressure_displacements_and_contact(folder: Path) -> None:
    rows, summary = _rows(folder), json.loads((folder / "summary.json").read_text())
    assert list(rows) == ["time", "pressure", "displacement_plug", "contact_mold", "contact_plug"]
    time = rows["time"]
    # The run ends when the whole sheet sticks to the mold, before its end time.
    assert time[0] == 0.0 and np.all(np.diff(time) > 0.0) and 0.02 in time and 0.02 < time[-1] < 0.04
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
    ((name, _, motion),) = results.tools
    assert name == "plug" and motion is not None
    assert len(results.process) == len(_rows(folder)["time"])
    assert (folder / "report.html").is_file()


def test_the_report_colours_elements_by_the_tool_that_they_touch(folder: Path) -> None:
    facts, arrays = _parcel(folder / "report.html")
    (quantity,) = [each for each in facts["quantities"] if each["key"] == "tool"]
    assert quantity["names"] == ["mold", "plug"] and (quantity["low"], quantity["high"]) == (0.0, 1.0)
    part = meshes.read_mesh(folder / "final.vtu")
    found = arrays["part0.tool"][:, 0]
    assert set(np.unique(found)) == {0.0}
    area, wall = _areas(part.positions[part.triangles]), part.cell_fields["thickness"]
    summary = json.loads((folder / "summary.json").read_text())
    mold, plug = summary["tools"]
    assert (mold["name"], plug["name"]) == ("mold", "plug")
    assert area[found == 0].sum() / area.sum() == pytest.approx(mold["contact_fraction"], rel=1e-6)
    assert wall[found == 0].min() == pytest.approx(mold["thickness"]["min"], rel=1e-6)
    assert mold["contact_fraction"] + plug["contact_fraction"] == pytest.approx(summary["contact_fraction"])
    # The plug touches the flat sheet when it has gone a millimetre, and is the only one at half time.
    met = 0.02 * next(root.real for root in np.roots([-2.0, 3.0, 0.0, -1.0 / 30.0]) if 0.0 < root.real < 1.0)
    assert plug["contact_period"][0] == pytest.approx(met, rel=0.05)
    assert (
        0.02 < plug["contact_period"][1] < 0.03
        and 0.02 < mold["contact_period"][0]
        and mold["contact_period"][1] == summary["time"]
    )
    first, half = arrays["part1.tool"], arrays["part2.tool"]
    assert np.isnan(first).all() and not np.any(half == 0.0)
    assert plug["work"] == summary["energy"]["tool_work"] > 0.0 == mold["work"]
    assert plug["friction_loss"] == summary["energy"]["friction_loss"] > 0.0 == mold["friction_loss"]
    page = (folder / "report.html").read_text()
    row = page[page.index('<th scope="row">plug</th>') :]
    assert f">{plug['work']:.3g}<" in row[: row.index("</tr>")]


def test_the_contact_of_a_tool_in_words() -> None:
    tool = {"name": "plug", "contact_fraction": 0.0, "contact_fraction_max": 0.25, "contact_period": [0.1, 0.3]}
    tool |= {"work": 0.5, "friction_loss": None}
    told = "plug: in contact from 0.1 to 0.3 s, with 25 % of the area at most and 0 % at the end; work 0.5 J"
    assert simulate_command._contact_words(tool) == told
    assert simulate_command._contact_words(tool | {"contact_period": None}) == "plug: never touches the sheet"


def test_which_tool_an_element_touches() -> None:
    """On the mold, on the plug, between both, with a clamped corner, clamped, and with a free corner."""
    tool = np.array([0.0, 0.0, 0.0, 1.0, 1.0, 1.0, -1.0, -1.0])
    time = np.array([1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 0.0, -1.0])
    triangles = np.array([[0, 1, 2], [3, 4, 5], [1, 2, 3], [0, 1, 6], [6, 6, 6], [0, 1, 7]], np.int32)
    places = np.zeros((8, 3))
    nodal = {"tool": tool, "contact_time": time}
    part = stored_results.StoredPart(places, places, triangles, nodal, {})
    np.testing.assert_array_equal(part.touched_tools, [0.0, 1.0, 1.0, 0.0, np.nan, np.nan])
    old = part._replace(nodal={"contact_time": time})  # of a version without it
    assert np.isnan(old.touched_tools).all()


def test_a_browser_names_the_tool_that_was_clicked_on(folder: Path, tmp_path: Path) -> None:
    if browser.find_browser() is None:
        pytest.skip("no Chromium or Chrome on this machine")
    with browser.browser(tmp_path) as page:
        page.visit(folder / "report.html", "document.documentElement?.dataset.ready")
        options = page.value("[...document.getElementById('quantity').options].map(({text}) => text)")
        number = options.index("tool in contact")
        change = f"it.value = '{number}', it.dispatchEvent(new Event('change'))"
        page.value(f"(it => ({change}))(document.getElementById('quantity'))")
        page.frame()
        names = page.value("[...document.querySelectorAll('#bar .ticks span')].map(({textContent}) => textContent)")
        assert names == ["mold", "plug"]
        page.value("document.getElementById('canvas').focus()")
        page.key("Enter")
        page.frame()
        words = page.value("document.getElementById('reading').innerText").split("\n")
        assert words[words.index("tool in contact") + 1] in ("mold", "none")
        assert page.complaints == []


def test_contact_over_time_ends_with_that_of_the_end() -> None:
    """Four elements of one area: one on the mold since 1 s, one on the plug since 2 s, one clamped, one free."""
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


def test_the_opening_of_the_clamp_is_marked(tmp_path: Path) -> None:
    constant = scenes.FILE.replace("value = [0.0, 2.0e4]", "value = [1.0e4, 1.0e4]")
    given = constant.replace("thickness = 1.0e-3", "thickness = 1.0e-3\nclamp_until = 0.03")
    (tmp_path / "simulated.toml").write_text(given)
    scene = files.build_unchecked(files.read_scene(tmp_path / "simulated.toml"), Store())
    # All of the sheet is free, at the end and before.
    free = {"stuck": np.zeros(3, bool), "tool": np.full(3, -1), "contact_time": np.full(3, -1.0)}
    sheet = {"triangles": np.array([[0, 1, 2]]), "element_volume": np.ones(1), "element_thickness": np.ones(1)}
    ended: Any = SimpleNamespace(time=0.05, pressures=None, contacts=None, **free, **sheet)
    history = process.process_history(scene, ended)
    assert history is not None and history.release == 0.03
    # A run that ends before says nothing of it, nor has it another process.
    ended.time = 0.02
    assert process.process_history(scene, ended) is None
    process.write_process(history, tmp_path)
    lines = []
    for drawn in (history, history._replace(release=None)):
        canvas.draw_process(tmp_path / "drawn.png", drawn)
        with Image.open(tmp_path / "drawn.png") as picture:
            marked = np.abs(np.asarray(picture.convert("RGB")).astype(int) - [140, 45, 4]).sum(2) < 60
        lines.append(np.flatnonzero(marked.sum(0) > 100))  # broken, through both panels
    # At three fifths of the axes, which begin after the labels.
    assert np.all((0.6 < lines[0] / 1100) & (lines[0] / 1100 < 0.64)) and lines[0].size and not lines[1].size
    rows, parcel = stored_results._rows(tmp_path / "process.csv"), contents.Parcel()
    release = stored_results._release_time(stored_results._tables(given)["parison"])
    marks = [charts._process(rows[:count], release, parcel)[0]["marked"] for count in (len(rows), len(rows) // 2)]
    assert marks == [[[0.03, "the clamp opens"]], []]


def test_a_process_without_change_has_no_picture(tmp_path: Path) -> None:
    (tmp_path / "scene.toml").write_text(scenes.FILE.replace("value = [0.0, 2.0e4]", "value = [1.0e4, 1.0e4]"))
    scene = files.build_unchecked(files.read_scene(tmp_path / "scene.toml"), Store())
    ended: Any = SimpleNamespace(time=0.05, pressures=None, contacts=None)
    assert process.process_history(scene, ended) is None
    for name in (process.TABLE, process.PICTURE):
        (tmp_path / name).write_text("of what was here before")
    process.write_process(None, tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["scene.toml"]

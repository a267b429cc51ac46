"""Filling of the mold by the part: of sheets whose gaps and depths are known, and through the command."""

from __future__ import annotations

import dataclasses
import json
import re
import weakref
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest
import trimesh

import jaxform
from jaxform import molds, shapes
from jaxform.cli import command, session
from jaxform.results import filling
from jaxform.results.filling import may_be_unfilled, measure_filling
from jaxform.results.result import Result
from jaxform.results.summary import summarize
from jaxform.sheet.state import Status
from jaxform.tools import gaps
from jaxform.tools.gaps import find_facing, mold_points
from jaxform.tools.mold import make_mold
from jaxform.tools.search import build_grid
from tests import scenes

DEPTH = 0.5


@pytest.fixture(autouse=True, scope="module")
def _own_cache() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(session, "cache_folder", lambda: None)
        yield


def _lower(result: Result, scene: jaxform.Scene, height: float) -> Result:
    """The sheet as it was at first, but its inner nodes pushed to a height [m] in the cup, as far as that has room."""
    positions = np.array(scene.parison.positions, float)
    radius = np.linalg.norm(positions[:, :2], axis=1)
    positions[:, 2] = np.minimum(height, (1.0 - radius) * DEPTH / 0.45)
    return dataclasses.replace(result, positions=jnp.asarray(positions))


@pytest.fixture(scope="module")
def at_rest() -> tuple[jaxform.Scene, Result]:
    scene = dataclasses.replace(scenes.cup(), fill=True)
    return scene, scenes.at_rest(scene)


@pytest.mark.parametrize(("share", "unfilled"), [(0.0, True), (0.7, True), (0.85, False), (0.9, False)])
def test_a_fifth_of_the_depth_left_open_is_a_status(
    at_rest: tuple[jaxform.Scene, Result], share: float, unfilled: bool
) -> None:
    scene, first = at_rest
    part = _lower(first, scene, share * DEPTH)
    summary = summarize(part, scene)
    # A coarse sheet bridges the edge of the bottom.
    assert (1.0 - share) * DEPTH <= summary["gap_max"] * (1 + 1e-9) <= (1.0 - share) * DEPTH + 0.02
    assert (summary["status"] != "ok") == unfilled
    if unfilled:
        words = re.search(
            r"not filled: (\S+) m remain at \(.*\) m, (\S+) % of the opening's depth of 0.5 m; raise",
            summary["status"],
        )
        assert words and float(words[1]) == pytest.approx((1.0 - share) * DEPTH, rel=0.02)
        assert float(words[2]) == pytest.approx(100 * (1.0 - share), rel=0.02)
    # A scene that need not be filled says so; nothing pushes a sheet anywhere without pressure.
    assert summarize(part, dataclasses.replace(scene, fill=False))["status"] == "ok"
    still = jaxform.replace(scene, {"pressure.value": np.zeros(2)})
    assert summarize(part, still)["status"] == "ok" and summarize(part, still)["gap_max"] == 0.0
    # A run that stopped says why, not that it left the mold open.
    stopped = dataclasses.replace(part, status=jnp.int32(Status.STOPPED))
    assert summarize(stopped, scene)["status"].startswith("stopped by the caller")


def test_a_gap_wider_than_an_element_is_warned_of_unless_the_mold_need_not_be_filled() -> None:
    sheet = shapes.disc(radius=1.0, element_size=0.06, symmetry="quarter")
    plain = scenes.cup()
    scene = jaxform.build_scene(
        parison=jaxform.make_parison(sheet.positions, sheet.triangles, 0.01, sheet.clamped, sheet.fixed),
        material=plain.material,
        pressure=plain.pressure,
        solver=plain.solver,
        mold=plain.mold,
    )
    first = scenes.at_rest(scene)
    for share, warned in ((0.84, True), (0.92, False)):
        part = _lower(first, scene, share * DEPTH)
        summary = summarize(part, scene)
        sentences = [words for words in summary["warnings"] if "the mold is not filled: " in words]
        assert summary["status"] == "ok" and bool(sentences) == warned
        if warned:
            assert "% of the opening's depth; raise the pressure" in sentences[0]
            open_mold = summarize(part, dataclasses.replace(scene, fill=False))
            assert not any("not filled" in words for words in open_mold["warnings"])


@pytest.mark.filterwarnings("ignore:nothing touched the mold")
def test_a_run_says_it_and_simulate_stays_pure() -> None:
    scene = jaxform.replace(scenes.cup(), {"pressure.value": np.array([0.0, 1e-3])})
    ran = jaxform.run(dataclasses.replace(scene, fill=True))
    assert int(ran.status) == Status.UNFILLED and "the mold is not filled: 0.384 m remain at" in jaxform.explain(ran)
    # Three times the pressure took 0.06 mm of 7.9 mm away before elements held at ribs; smaller elements 2 mm.
    for held, remedy in ((0, "raise the pressure"), (3, "make the elements smaller")):
        own = dataclasses.replace(ran, held_sides=jnp.int32(held))
        words = jaxform.explain(own).split("; ")[1]
        assert words.startswith(remedy) and ("held at edges" in words) is bool(held)
        assert summarize(own, dataclasses.replace(scene, fill=True))["status"].split("; ")[1] == words
    assert int(jaxform.run(scene).status) == 0
    assert int(jaxform.simulate(dataclasses.replace(scene, fill=True)).status) == 0


def _sheet(size: float = 1.0) -> tuple[np.ndarray, np.ndarray]:
    flat = shapes.rectangle(size=(size, size), element_size=0.1 * size)
    return np.asarray(flat.positions, float), np.asarray(flat.triangles)


def _depth(solids: list[trimesh.Trimesh], *, push: float = 1.0, size: float = 1.0) -> float:
    one: Any = trimesh.util.concatenate([solid.subdivide() for solid in solids])
    mold = make_mold(np.asarray(one.vertices), np.asarray(one.faces, np.int32))
    grid = build_grid(np.asarray(mold.vertices, float), np.asarray(mold.triangles))
    found = find_facing(*_sheet(size), push, mold, grid)
    assert found is not None
    return found.depth(mold_points(mold))


def _box(low: list[float], high: list[float]) -> trimesh.Trimesh:
    return trimesh.creation.box(bounds=[low, high])


def test_the_depth_is_that_of_what_the_sheet_is_to_reach() -> None:
    floor, shelf = _box([0, 0, 0.6], [1, 1, 0.9]), _box([0, 0, 0.2], [0.4, 1, 0.3])
    # Not the back of the floor at 0.9, nor what a shelf hides, nor what is beside or behind the sheet.
    assert _depth([floor]) == pytest.approx(0.6)
    assert _depth([_box([0, 0, 0.2], [1, 1, 0.3]), floor]) == pytest.approx(0.2)
    assert _depth([shelf, floor]) == pytest.approx(0.6)
    assert _depth([floor, _box([1.5, 0, 1.0], [2.5, 1, 1.2]), _box([0, 0, -2.0], [1, 1, -1.8])]) == pytest.approx(0.6)
    assert _depth([_box([0, 0, -0.7], [1, 1, -0.5]), floor], push=-1.0) == pytest.approx(0.5)
    # A buck on a platen: what is between its head and the platen is an undercut, the platen the deepest.
    buck = [
        _box([0.3, 0.3, 0.1], [0.7, 0.7, 0.2]),
        _box([0.45, 0.45, 0.2], [0.55, 0.55, 0.5]),
        _box([-1, -1, 0.5], [2, 2, 0.6]),
    ]
    assert _depth(buck) == pytest.approx(0.5)


def test_closed_sheets_have_no_direction() -> None:
    ball = shapes.sphere(radius=0.3, elements=80)
    mold = molds.revolved(profile=[[0.0, 0.5], [1.0, 0.5]], segments=12)
    grid = build_grid(np.asarray(mold.vertices, float), np.asarray(mold.triangles))
    made = make_mold(mold.vertices, mold.triangles)
    assert find_facing(np.asarray(ball.positions), np.asarray(ball.triangles), 1.0, made, grid) is None


@pytest.mark.parametrize(("fill", "status"), [("", 3), ("fill = false", 0)])
def test_the_command_ends_with_status_3_unless_the_scene_says_otherwise(
    fill: str, status: int, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    text = scenes.FILE.replace("fill = false", fill).replace("end_time = 0.05", "end_time = 0.01")
    (tmp_path / "scene.toml").write_text(text)
    out = tmp_path / "out"
    assert command.main(["simulate", str(tmp_path / "scene.toml"), "--out", str(out), "--quiet"]) == status
    summary = json.loads((out / "summary.json").read_text())
    assert summary["status"].startswith("the mold is not filled" if status else "ok")
    assert ("the mold is not filled" in capfd.readouterr().err) == bool(status)


STUDY = """
scene = "scene.toml"
[[variable]]
kind = "thickness-profile"
along = "radius"
knots = 3
bounds = [5.0e-4, 2.0e-3]
[objective]
kind = "uniform"
[solver]
method = "fixed-point"
iterations = 2
"""


def test_a_search_passes_through_designs_that_do_not_fill_and_ends_with_the_status_of_its_best_one(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    text = scenes.FILE.replace("fill = false", "").replace("end_time = 0.05", "end_time = 0.01")
    (tmp_path / "scene.toml").write_text(text)
    (tmp_path / "study.toml").write_text(STUDY)
    out = tmp_path / "out"
    assert command.main(["optimize", str(tmp_path / "study.toml"), "--out", str(out), "--quiet"]) == 3
    rows = (out / "history.csv").read_text().splitlines()
    assert len(rows) > 2 and all("inf" not in row for row in rows)
    summary = json.loads((out / "summary.json").read_text())
    assert summary["status"].startswith("the mold is not filled")
    assert "jaxform: the mold is not filled" in capfd.readouterr().err
    assert command.main(["simulate", str(out / "best.toml"), "--out", str(out / "again"), "--quiet"]) == 3
    # A mold that need not be filled is no failure of either.
    (tmp_path / "scene.toml").write_text(text.replace("segments = ", "fill = false\nsegments = "))
    assert command.main(["optimize", str(tmp_path / "study.toml"), "--out", str(out), "--quiet", "--force"]) == 0


def test_a_mold_that_was_never_reached_is_warned_of_whatever_the_status(
    at_rest: tuple[jaxform.Scene, Result],
) -> None:
    scene, first = at_rest
    summary = summarize(first, scene)
    assert "not filled" in summary["status"]
    assert any("nothing touched the mold" in words for words in summary["warnings"])


@pytest.mark.parametrize("share", [0.0, 0.5, 0.78, 0.82, 0.9])
@pytest.mark.parametrize("moved", [0.0, 0.05])
def test_what_a_run_does_not_measure_is_filled(
    at_rest: tuple[jaxform.Scene, Result], share: float, moved: float
) -> None:
    """The quick answer is never that a part fills its mold where the measurement says that it does not."""
    scene, first = at_rest
    part = _lower(first, scene, share * DEPTH)
    noise = np.random.default_rng(0).normal(scale=moved, size=part.positions.shape)
    part = dataclasses.replace(part, positions=part.positions + jnp.asarray(noise))
    assert may_be_unfilled(part, scene) or not measure_filling(part, scene).is_unfilled
    if not moved and share not in (0.78, 0.82):
        assert may_be_unfilled(part, scene) == measure_filling(part, scene).is_unfilled == (share < 0.8)


@pytest.mark.filterwarnings("ignore:nothing touched the mold", "ignore:.*not filled")
def test_runs_that_fill_their_mold_look_for_the_opening_once_and_measure_nothing(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    scene = dataclasses.replace(scenes.cup(), fill=True)
    found: list[int] = []
    find = gaps.find_facing

    def count(*arguments: Any) -> Any:
        found.append(1)
        return find(*arguments)

    monkeypatch.setattr(gaps, "find_facing", count)
    monkeypatch.setattr(filling, "_openings", weakref.WeakKeyDictionary())
    monkeypatch.setattr(gaps, "widest_gap", None)
    monkeypatch.setattr(filling, "widest_gap", None)
    for thickness in (1.0, 1.1):
        thicker = jaxform.replace(scene, {"parison.thickness": thickness * scene.parison.thickness})
        part = _lower(scenes.at_rest(thicker), thicker, 0.9 * DEPTH)
        assert not may_be_unfilled(part, thicker)
    assert len(found) == 1
    # Where the sheet starts elsewhere, or is pushed the other way, the opening is another one.
    higher = dataclasses.replace(scene.parison, positions=scene.parison.positions + jnp.array([0.0, 0.0, 0.01]))
    suction = jaxform.replace(scene, {"pressure.value": -scene.pressure.value})
    monkeypatch.undo()
    monkeypatch.setattr(gaps, "find_facing", count)
    monkeypatch.setattr(filling, "_openings", weakref.WeakKeyDictionary())
    found.clear()
    assert not may_be_unfilled(_lower(scenes.at_rest(scene), scene, 0.9 * DEPTH), scene)
    for count_of, other in ((2, dataclasses.replace(scene, parison=higher)), (3, suction)):
        may_be_unfilled(_lower(scenes.at_rest(other), other, 0.9 * DEPTH), other)
        assert len(found) == count_of

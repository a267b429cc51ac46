"""The part of a formed sheet: what counts in statistics, objectives, files and exports, and what is cut off."""

from __future__ import annotations

import csv
import dataclasses
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import meshio
import numpy as np
import pytest
import trimesh

import jaxform
import optimize
from jaxform import molds
from jaxform.cli import command, session
from jaxform.core.errors import InputError
from jaxform.io import export, files, plots
from jaxform.results.part import mask_part, part_elements, rim_elements
from jaxform.results.result import Result
from jaxform.results.summary import summarize
from jaxform.results.tool_contact import formed_areas
from optimize.search import Search
from optimize.wall_statistics import wall
from tests import scenes


@pytest.fixture(autouse=True, scope="module")
def _own_cache() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(session, "cache_folder", lambda: None)
        yield


@pytest.fixture(scope="module")
def cone() -> tuple[jaxform.Scene, Result]:
    """A cone of the cup's sheet with walls of known, different thickness."""
    scene = scenes.cup()
    first = scenes.at_rest(scene)
    positions = np.array(scene.parison.positions, float)
    positions[:, 2] = 0.5 * (1.0 - np.linalg.norm(positions[:, :2], axis=1))
    count = len(np.asarray(first.triangles))
    walls = jnp.asarray(0.01 * np.linspace(0.5, 1.0, count))
    return scene, dataclasses.replace(first, positions=jnp.asarray(positions), element_thickness=walls)


def _by_hand(scene: jaxform.Scene, result: Result, mine: np.ndarray) -> dict[str, float]:
    area, walls = formed_areas(result)[mine], np.asarray(result.element_thickness)[mine]
    mean = float((area @ walls) / area.sum())
    mass = float(np.asarray(result.element_volume)[mine].sum() * float(scene.material.density))
    return {"min": walls.min(), "mean": mean, "max": walls.max(), "mass": mass}


PARTS: dict[str, Any] = {
    "trim": {"trim": ("z", 0.2, "above")},
    "below": {"trim": ("x", 0.4, "below")},
    "box": {"box": [[-1.0, 0.2, 0.1], [0.9, 1.0, 1.0]]},
    "both": {"box": [[-1.0, -1.0, -1.0], [0.5, 1.0, 1.0]], "trim": ("z", 0.2, "above")},
}


@pytest.mark.parametrize("name", PARTS)
def test_the_summary_and_what_a_search_reports_are_of_the_part(cone: tuple[jaxform.Scene, Result], name: str) -> None:
    plain, result = cone
    scene = dataclasses.replace(plain, part=jaxform.make_part(**PARTS[name]))
    middle = np.asarray(result.positions)[np.asarray(result.triangles)].mean(1)
    given, mine = PARTS[name], np.ones(len(middle), bool)
    if "box" in given:
        low, high = np.asarray(given["box"])
        mine &= ((middle >= low) & (middle <= high)).all(1)
    if "trim" in given:
        axis, at, keep = given["trim"]
        along = middle[:, "xyz".index(axis)]
        mine &= along >= at if keep == "above" else along <= at
    assert 0 < mine.sum() < len(mine)
    np.testing.assert_array_equal(part_elements(result, scene), mine)
    np.testing.assert_array_equal(jax.jit(part_elements)(result, scene), mine)
    hand, summary, whole = _by_hand(scene, result, mine), summarize(result, scene), summarize(result, plain)
    for key in ("min", "mean", "max"):
        assert summary["thickness"][key] == pytest.approx(hand[key], rel=1e-12)
    assert summary["thinnest"]["thickness"] == pytest.approx(hand["min"])
    assert summary["mass"] == pytest.approx(hand["mass"], rel=1e-12) and summary["sheet_mass"] == whole["mass"]
    assert "sheet_mass" not in whole and whole["thickness"]["min"] == float(result.element_thickness.min())
    reported = wall(mask_part(result, scene))
    assert [float(reported[key]) for key in ("least", "mean", "mass")] == pytest.approx(
        [hand[key] for key in ("min", "mean", "mass")]
    )


def test_elements_span_the_rim_where_they_have_nodes_in_the_part_and_off_it(
    cone: tuple[jaxform.Scene, Result],
) -> None:
    plain, result = cone
    inside = np.asarray(result.positions)[:, 2] > 0.2
    formed = dataclasses.replace(result, wall=jnp.where(jnp.asarray(inside), 1, 2))
    scene = dataclasses.replace(plain, part=jaxform.make_part(walls=np.array([True, False])))
    corners = inside[np.asarray(result.triangles)]
    expected = corners.any(1) & ~corners.all(1)
    assert 0 < expected.sum() < len(expected)
    np.testing.assert_array_equal(rim_elements(formed, scene), expected)
    assert not np.any(rim_elements(formed, plain))


def test_objectives_count_the_part_alone_and_a_scene_without_one_is_as_it_was(
    cone: tuple[jaxform.Scene, Result],
) -> None:
    plain, result = cone
    assert mask_part(result, plain) is result
    scene = dataclasses.replace(plain, part=jaxform.make_part(trim=("z", 0.2, "above")))
    mine = np.asarray(part_elements(result, scene))
    area, walls = formed_areas(result)[mine], np.asarray(result.element_thickness)[mine]
    spread = (area @ np.square(walls - area @ walls / area.sum())) / area.sum() / (area @ walls / area.sum()) ** 2

    def judge(objective: optimize.Objective) -> tuple[float, dict[str, Any]]:
        study = optimize.Study(scene, (), objective)
        search = object.__new__(Search)
        search.study = study
        value, report = search.judge(scene, result, None)
        return float(value), report

    value, report = judge(optimize.Uniform())
    assert value == pytest.approx(spread, rel=1e-12)
    # A fixed point changes the part alone: elsewhere the sheet stays as it is.
    nodes = np.unique(np.asarray(result.triangles)[mine])
    others = np.setdiff1d(np.arange(len(report["ratio"])), nodes)
    assert len(others) and np.all(np.asarray(report["ratio"])[others] == 1.0)
    least = optimize.LeastMass(scene, 0.0075)
    assert judge(least)[0] == pytest.approx(_by_hand(scene, result, mine)["mass"] / least._first_mass)
    excess, weight = least.constraints(scene, mask_part(result, scene))
    assert np.all(np.asarray(weight)[~mine] == 0.0) and float(jnp.sum(weight)) == pytest.approx(1.0)
    np.testing.assert_allclose(np.asarray(excess)[mine], 1.0 - walls / 0.0075)
    # With flash the mass is that of the whole sheet, and the limit is the part's as before.
    counted = optimize.LeastMass(scene, 0.0075, flash=True)
    assert judge(counted)[0] == pytest.approx(1.0, rel=1e-12) and judge(least)[0] < 0.9
    np.testing.assert_array_equal(counted.constraints(scene, mask_part(result, scene))[0], excess)


@pytest.mark.parametrize("densities", [False, True])
def test_only_a_mass_with_flash_depends_on_the_sheet_outside_the_part(
    cone: tuple[jaxform.Scene, Result], densities: bool
) -> None:
    plain, result = cone
    scene = dataclasses.replace(plain, part=jaxform.make_part(trim=("z", 0.2, "above")))
    count = scene.parison.thickness.size
    if densities:
        dense = jnp.asarray(np.random.default_rng(0).uniform(900.0, 1100.0, count))
        material = dataclasses.replace(scene.material, density=dense)
        scene = dataclasses.replace(scene, material=material)
    triangles, thickness = np.asarray(scene.parison.triangles), np.asarray(scene.parison.thickness)
    corners = np.asarray(scene.parison.positions)[triangles]
    area = 0.5 * np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    density = np.broadcast_to(np.asarray(scene.material.density), count)[triangles].mean(1)
    mass = float((density * area * thickness[triangles].mean(1)).sum())
    by_hand = np.bincount(triangles.ravel(), np.repeat(density * area / 3.0, 3), count) / mass

    def value(change: jax.Array, flash: bool) -> jax.Array:
        changed = jaxform.replace(scene, {"parison.thickness": scene.parison.thickness + change})
        return optimize.LeastMass(scene, 0.0075, flash=flash)(changed, mask_part(result, changed))

    slope = np.asarray(jax.grad(value)(jnp.zeros(count), True))
    np.testing.assert_allclose(slope, by_hand, rtol=1e-9)
    assert np.all(slope[np.unique(triangles)] > 0.0)


@pytest.mark.long
def test_the_gradient_of_an_objective_over_the_part_is_that_of_central_differences() -> None:
    scene = dataclasses.replace(scenes.cup(), part=jaxform.make_part(trim=("z", 0.1, "above")))
    schedule, objective = jaxform.run(scene).schedule, optimize.Uniform()

    def value(thickness: jax.Array) -> jax.Array:
        changed = jaxform.replace(scene, {"parison.thickness": thickness})
        return objective(changed, mask_part(jaxform.simulate(changed, schedule=schedule), changed))

    program, thickness = jax.jit(jax.value_and_grad(value)), scene.parison.thickness
    slope = program(thickness)[1]
    change = 1e-6 * np.random.default_rng(0).normal(size=thickness.shape) * thickness
    difference = (program(thickness + change)[0] - program(thickness - change)[0]) / 2
    np.testing.assert_allclose(jnp.vdot(slope, change), difference, rtol=1e-7)


def test_a_part_that_holds_nothing_is_warned_of_and_a_search_of_it_refused(
    cone: tuple[jaxform.Scene, Result],
) -> None:
    plain, result = cone
    scene = dataclasses.replace(plain, part=jaxform.make_part(trim=("z", 0.9, "above")))
    summary = summarize(result, scene)
    assert any("no element of the formed sheet is in [part]" in words for words in summary["warnings"])
    assert summary["thickness"] == summarize(result, plain)["thickness"]


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({}, "part: is empty"),
        ({"box": [[0, 0, 0], [1, 1, 0]]}, "part.box .* has no inside"),
        ({"box": [0, 1]}, "part.box .* is not a box"),
        ({"trim": ("w", 0.0, "above")}, "part.trim.axis .* is not an axis"),
        ({"trim": ("z", np.nan, "above")}, "part.trim.at .* is not finite"),
        ({"trim": ("z", 0.0, "over")}, "part.trim.keep .* is not a side"),
    ],
)
def test_parts_that_make_no_sense_are_refused(given: dict[str, Any], words: str) -> None:
    with pytest.raises(InputError, match=words.replace(" .* ", r".*")):
        jaxform.make_part(**given)


def test_what_is_cut_off_is_grey(cone: tuple[jaxform.Scene, Result], tmp_path: Path) -> None:
    plain, result = cone
    scene = dataclasses.replace(plain, part=jaxform.make_part(trim=("z", 0.2, "above")))
    view = plots.part_picture(scene, result).view
    count = len(np.asarray(result.triangles))
    cut_off = ~np.asarray(part_elements(result, scene))
    paint = view.surfaces[-1].paint
    np.testing.assert_array_equal(np.isnan(paint), np.tile(cut_off, len(paint) // count))
    assert np.isfinite(plots.part_picture(plain, result).view.surfaces[-1].paint).all()
    plots.thickness_picture(tmp_path / "part.png", scene, result)


def _folder(folder: Path) -> Path:
    """A cup and the flange around it in two files, and a scene whose part is the cup."""
    cup = trimesh.creation.cylinder(radius=0.06, height=0.02, sections=24)
    inside = cup.faces[(cup.triangles[:, :, 2] < 0.009).any(1)]
    vertices = cup.vertices * [1.0, 1.0, -1.0] + [0.0, 0.0, 0.0101]
    trimesh.Trimesh(vertices, inside).export(folder / "cup.stl")
    trimesh.creation.annulus(r_min=0.0605, r_max=0.12, height=0.01, sections=24).apply_translation(
        [0.0, 0.0, 0.0051]
    ).export(folder / "flange.stl")
    text = scenes.FILE[: scenes.FILE.index("[mold]")].replace("elements = 40", "elements = 150")
    (folder / "scene.toml").write_text(
        text
        + """
[mold]
shape = "file"
path = ["cup.stl", "flange.stl"]
fill = false
[part]
molds = ["cup.stl"]
[solver]
end_time = 0.1
damping = 100.0
"""
    )
    return folder / "scene.toml"


def test_the_command_writes_and_exports_what_touches_the_molds_that_are_named(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    scene_file, out = _folder(tmp_path), tmp_path / "out"
    scene = jaxform.load(scene_file)
    assert scene.part is not None and scene.part.walls is not None and scene.mold is not None
    walls, middles = np.asarray(scene.part.walls), np.asarray(scene.mold.vertices)[np.asarray(scene.mold.triangles)]
    radius = np.linalg.norm(middles[..., :2], axis=2).max(1)
    np.testing.assert_array_equal(walls, radius < 0.0602)
    assert command.main(["check", str(scene_file)]) == 0
    assert "part: molds [cup.stl];" in capfd.readouterr().out
    assert command.main(["simulate", str(scene_file), "--out", str(out), "--quiet"]) == 0
    mesh = meshio.read(out / "final.vtu")
    mine = mesh.cell_data["part"][0] != 0
    middle = mesh.points[mesh.cells[0].data].mean(1)
    # All of the bottom, nothing of the flange.
    inner, outer = np.linalg.norm(middle[:, :2], axis=1) < 0.045, np.linalg.norm(middle[:, :2], axis=1) > 0.065
    assert inner.any() and outer.any() and mine[inner & (middle[:, 2] > 0.019)].all() and not mine[outer].any()
    summary = json.loads((out / "summary.json").read_text())
    thickness = mesh.cell_data["thickness"][0]
    assert summary["thickness"]["min"] == pytest.approx(thickness[mine].min())
    assert (
        summary["thickness"]["max"] == pytest.approx(thickness[mine].max()) and summary["mass"] < summary["sheet_mass"]
    )
    assert len(export.read_wall(out).triangles) == mine.sum()
    assert len(export.read_wall(out, whole=True).triangles) == len(mine)
    wall_file = tmp_path / "wall.csv"
    exported = ["export", str(out), "--to", "csv", "--out", str(wall_file), "--quiet"]
    assert command.main(exported) == 0
    rows = len(wall_file.read_text().splitlines())
    assert command.main([*exported, "--whole-sheet", "--force"]) == 0
    assert len(wall_file.read_text().splitlines()) > rows
    # The scene that is kept beside the results has the same part.
    again = jaxform.load(out / "simulated.toml")
    assert again.part is not None
    np.testing.assert_array_equal(again.part.walls, walls)
    text = scene_file.read_text()
    scenes.assert_refused(
        tmp_path, text.replace('["cup.stl"]', '["mug.stl"]'), r"part\.molds.*not a file of the mold.*cup\.stl"
    )
    scenes.assert_refused(tmp_path, text.replace('molds = ["cup.stl"]', ""), "part.*is empty")


def test_what_touches_nothing_belongs_to_what_is_next_to_it(cone: tuple[jaxform.Scene, Result]) -> None:
    """Nodes within a radius stick to the part's triangle, or to another; those further out are free up to the clamp."""
    plain, result = cone
    radius = np.linalg.norm(np.asarray(result.positions)[:, :2], axis=1)
    triangles, sticks = np.asarray(result.triangles), radius < 0.51
    assert plain.mold is not None
    chosen = np.arange(len(plain.mold.triangles)) == 0
    scene = dataclasses.replace(plain, part=jaxform.make_part(walls=chosen))
    part, other = (
        np.asarray(part_elements(dataclasses.replace(result, wall=jnp.asarray(np.where(sticks, wall, 0))), scene))
        for wall in (-1, 2)
    )
    middle, free = radius[triangles].mean(1), ~sticks[triangles].any(1)
    assert part[sticks[triangles].all(1)].all() and not part[middle > 0.85].any() and not other.any()
    assert (part & free).any() and (~part & free).any()


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


def test_a_search_is_over_the_part_and_its_columns_are_those_of_its_summary(tmp_path: Path) -> None:
    text = scenes.FILE.replace("end_time = 0.05", "end_time = 0.03")
    table = '[part]\ntrim = { axis = "z", at = 0.01, keep = "above" }\n[solver]'
    (tmp_path / "scene.toml").write_text(text.replace("[solver]", table))
    (tmp_path / "study.toml").write_text(STUDY)
    out = tmp_path / "out"
    assert command.main(["optimize", str(tmp_path / "study.toml"), "--out", str(out), "--quiet"]) == 0
    rows = list(csv.DictReader((out / "history.csv").read_text().splitlines()))
    summary = json.loads((out / "summary.json").read_text())
    best = min(rows, key=lambda row: float(row["objective"]))
    for column, value in (("wall_min", summary["thickness"]["min"]), ("wall_cv", summary["thickness"]["cv"])):
        assert float(best[column]) == pytest.approx(value, rel=1e-9)
    assert float(best["mass"]) == pytest.approx(summary["mass"], rel=1e-9) and summary["mass"] < summary["sheet_mass"]
    assert float(best["objective"]) == pytest.approx(summary["thickness"]["cv"] ** 2, rel=1e-9)
    assert jaxform.load(out / "best.toml").part is not None


def _turn(folder: Path, profile: list[list[float]]) -> Path:
    shape = molds.revolved(profile=profile, segments=24)
    path = folder / "mold.stl"
    trimesh.Trimesh(shape.vertices, shape.triangles).export(path)
    return path


@pytest.mark.parametrize(
    ("profile", "keep", "covered"),
    [
        ([[0.0, 0.03], [0.04, 0.03], [0.05, 0.0], [0.08, 0.0]], "above", False),  # a cup with a flange
        ([[0.01, 0.03], [0.04, 0.03], [0.05, 0.0], [0.08, 0.0]], "above", True),  # with a hole in its bottom
        ([], "below", False),  # a buck, closed, on its flat base
    ],
)
def test_new_says_what_the_part_is(profile: list[list[float]], keep: str, covered: bool, tmp_path: Path) -> None:
    if profile:
        path = _turn(tmp_path, profile)
    else:
        path = tmp_path / "mold.stl"
        trimesh.creation.cylinder(radius=0.03, height=0.04, sections=24).export(path)
    out, kind = tmp_path / "first", ["--cavity" if profile else "--drape"]
    assert command.main(["new", str(out), "--mold", str(path), "--scale", "1.0", "--quiet", *kind]) == 0
    document = files.read_scene(out / "scene.toml")
    table = document.model.part
    assert table is not None and table.trim is not None and table.trim.axis == "z" and table.trim.keep == keep
    # Just into the opening, or up the buck.
    assert 0.0 < (table.trim.at if keep == "above" else -table.trim.at) < 0.004
    assert table.molds == (["mold.stl"] if covered else None)
    part = files.build(document).part
    assert part is not None and (part.walls is not None) == covered
    if part.walls is not None:
        assert 0 < int(part.walls.sum()) < len(part.walls)

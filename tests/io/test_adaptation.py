"""Scenes on meshes adapted to their wall: the command, the files that it writes, refusals, accuracy, gradients."""

from __future__ import annotations

import io
import json
import pickle
import re
import sys
import zipfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxform
from benchmarks.accuracy import cases
from jaxform.adapt import mesher
from jaxform.cli import main
from jaxform.core.errors import InputError, InputWarning
from jaxform.core.store import Arrays
from jaxform.io import adaptation, files, geometry, scene_rewriting
from jaxform.mesh import meshes
from jaxform.mesh.shapes import Sheet
from jaxform.model.scene import Scene
from jaxform.sheet.state import Status
from jaxform.sweeps import designs, evaluation
from tests import scenes

pytest.importorskip("mmgpy")

CUP = """
name = "cup"
[parison]
shape = "disc"
radius = 1.0
elements = {elements}
symmetry = "quarter"
thickness = {thickness}
{adapt}
[material]
model = "neo-hookean"
c = 1.0e6
density = 1000.0
[pressure]
time = [0.0, 1.8974]
value = [0.0, 4.0e5]
interpolation = "cubic-ramp"
[mold]
shape = "revolved"
profile = [[0.0, 0.8], [0.85893842, 0.8], [1.0, 0.0]]
segments = 384
fill = false
[solver]
end_time = 2.0555
damping = 63.246
"""
"""The cup of the accuracy cases at P = 40 c h0/a, with units of time of 1/31.6 s."""


def _write(folder: Path, adapt: str = "", *, elements: int = 150, thickness: str = "0.01", rest: str = "") -> Path:
    path = folder / "scene.toml"
    path.write_text(CUP.format(adapt=adapt, elements=elements, thickness=thickness) + rest)
    return path


def _errors(scene: Scene) -> tuple[float, float]:
    """Relative rms errors of the elements' and the nodes' thickness, nothing cut."""
    result = jaxform.run(scene)
    assert jaxform.explain(result) == "ok"
    wall = cases.exact_table("cup-at-40")
    ratio, places, area = cases.element_ratios(scene, result)
    radius = np.hypot(*np.asarray(scene.parison.positions)[:, :2].T)
    nodal = cases.nodal_ratio(scene, result) / cases.exact_ratio(radius, wall) - 1
    return cases.rms(ratio / cases.exact_ratio(places, wall) - 1, area), cases.rms(nodal, cases.nodal_area(scene))


@pytest.mark.long
def test_the_command_writes_a_scene_that_is_more_accurate(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    profile = '{ along = "radius", at = [0.0, 1.0], value = [0.01, 0.01] }'
    path = _write(tmp_path, thickness=profile)
    assert main(["adapt", str(path), "--out", str(tmp_path / "out"), "--elements", "600"]) == 0
    told = capsys.readouterr().out
    before, after = (float(x) for x in re.findall(r"error of their wall ([\d.]+) %", told))
    assert before > 2 * after
    document = files.read_scene(tmp_path / "out" / "adapted.toml")
    assert document.model.parison.adapt is None and document.model.parison.mesh is not None
    adapted, uniform = files.build(document), files.build(files.read_scene(_write(tmp_path, elements=600)))
    assert 540 <= len(adapted.parison.triangles) <= 600 <= len(uniform.parison.triangles)
    for got, even in zip(_errors(adapted), _errors(uniform), strict=True):
        assert got < 0.012 < 0.6 * even, (got, even)
    # The key in the scene gives the same mesh.
    scene = files.build(files.read_scene(_write(tmp_path, "adapt = { elements = 600 }", thickness=profile)))
    np.testing.assert_array_equal(scene.parison.positions, adapted.parison.positions)


def test_the_command_tells_of_each_run_also_of_a_mesh_that_is_kept(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    runs = np.array([[60.0, 0.12, -1.0, 0.0, 0.0], [80.0, 0.03, 7.0, 0.25, 2.0], [84.0, 0.03, 0.0, 0.0, 0.0]])

    facts = [
        {"elements": 60, "estimated_error": 0.12},
        {"elements": 80, "estimated_error": 0.03, "nodes_moved": 7, "farthest_move": 0.25, "nodes_added": 2},
        {"elements": 84, "estimated_error": 0.03, "nodes_moved": 0, "farthest_move": 0.0, "nodes_added": 0},
    ]

    def make(document: object, sheet: Sheet, store: object, tell: Callable[[np.ndarray], None]) -> Arrays:
        for run in runs:
            tell(run)
        return {**adaptation._arrays(sheet), adaptation._RUNS: runs}

    monkeypatch.setattr(adaptation, "_make", make)
    path, out = _write(tmp_path, elements=60), tmp_path / "out"
    for _ in range(2):
        assert main(["adapt", str(path), "--out", str(out), "--force"]) == 0
        told = capsys.readouterr().out
        assert told.startswith("simulating with the initial mesh of ")
        assert "run 1 with 60 elements: estimated error of their wall 12 %\n" in told
        words = "error of their wall 3 %; 7 nodes moved onto sharp edges, by up to 0.25 of an element"
        assert f"{words}; 2 nodes added on sides that cut edges\n" in told
        assert json.loads((out / "summary.json").read_text())["runs"] == facts
    # So does a run of a scene which asks for such a mesh.
    path = _write(tmp_path, "adapt = { elements = 100 }", elements=60)
    for _ in range(2):
        assert main(["simulate", str(path), "--out", str(out), "--force"]) == 0
        assert "run 2 with 80 elements: " in capsys.readouterr().out
        assert json.loads((out / "summary.json").read_text())["adaptation"] == facts


@pytest.mark.parametrize(("edges", "moves", "elements"), [(0, 0, [2500, 2500]), (3, 1, [2500, 2400])])
def test_nodes_are_moved_and_elements_left_for_new_ones_where_tools_have_edges(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, edges: int, moves: int, elements: list[int]
) -> None:
    scene, moved = SimpleNamespace(tables=SimpleNamespace(edges=(np.zeros((4, edges)),))), list[Sheet]()
    most = list[int]()

    def mesh(sheet: Sheet, _: object, elements: int, *__: object, **___: object) -> Sheet:
        most.append(elements)
        return sheet

    def move(document: object, sheet: Sheet, *_: object) -> Sheet:
        moved.append(sheet)
        return sheet

    monkeypatch.setattr(adaptation, "_move_to_edges", move)
    monkeypatch.setattr(adaptation, "_run_pass", lambda *_: (scene, SimpleNamespace(positions=None)))
    monkeypatch.setattr(adaptation.mesher, "remesh", mesh)
    monkeypatch.setattr(adaptation.smoothing, "smooth", lambda sheet, *_: sheet)
    for name, value in {"mean_error": 0.1, "edge_lines": [], "wanted_sizes": None, "beside_edges": None}.items():
        monkeypatch.setattr(adaptation.size_field, name, lambda *_, value=value: value)
    path = _write(tmp_path, "adapt = { passes = 2 }", elements=60, rest="edge_contact = true\n")
    document, told = files.read_scene(path), list[np.ndarray]()
    first = geometry.build_sheet(adaptation.without_adaptation(document))
    adaptation._make(document, first, None, told.append)
    assert len(told) == 2 and len(moved) == moves and most == elements


@pytest.mark.parametrize(
    ("worst", "taken", "runs", "errors"),
    [
        ((3.0, 0.0), "moved", 2, ()),  # nothing cuts after the first move: no second one
        ((3.0, 4.0, 0.0), "divided", 3, ()),  # deeper than before: the mesh before, with new nodes
        ((3.0, 4.0, 2.0, 1.5), "divided thrice", 4, ()),
        ((3.0, 4.0, 5.0), "first", 3, ()),  # deeper with new nodes, too: without them
        ((3.0, 2.0, 2.5, 0.0), "moved, divided", 4, ()),
        # Each move makes some elements lower: no more of them.
        ((3.0, 2.0, 1.5, 1.2), "moved twice, divided twice", 4, ()),
        # Deeper, but the wall is much better, or hardly.
        ((3.0, 4.0, 0.0), "moved twice", 3, (0.06, 0.03, 0.03)),
        ((3.0, 4.0, 0.0), "divided", 3, (0.06, 0.05, 0.05)),
    ],
)
def test_moves_that_make_a_cut_deeper_are_taken_back(
    monkeypatch: pytest.MonkeyPatch, worst: tuple[float, ...], taken: str, runs: int, errors: tuple[float, ...]
) -> None:
    triangles = np.array([[0, 1, 2]], np.int32)
    first = Sheet(np.eye(3), triangles, np.zeros(3, bool), np.zeros((3, 3), bool))
    scene = SimpleNamespace(
        tables=SimpleNamespace(sheet=SimpleNamespace(area=np.ones(1))), parison=SimpleNamespace(triangles=triangles)
    )
    left, left_errors, told = list(worst), list(errors or [0.1] * len(worst)), list[tuple[float, ...]]()
    some = np.array([[0, 1]]), np.array([0.5])
    none = np.zeros((0, 2), np.int64), np.zeros(0)

    def cut(*_: object) -> tuple[np.ndarray, np.ndarray, float]:
        depth = left.pop(0)
        ends, share = some if depth > 1.0 else none
        return ends, share, depth

    def move(sheet: Sheet, *_: object) -> Sheet:
        return replace(sheet, positions=sheet.positions + 1.0)

    def divide(sheet: Sheet, ends: np.ndarray, *_: object) -> Sheet:
        return replace(sheet, positions=np.append(sheet.positions, [[0.0] * 3], 0) - 10.0) if len(ends) else sheet

    monkeypatch.setattr(adaptation, "_run_pass", lambda *_: (scene, None))
    monkeypatch.setattr(adaptation, "measure_cuts", lambda *_: (np.zeros((1, 1)), np.zeros((1, 1, 3))))
    monkeypatch.setattr(adaptation.size_field, "cut_sides", cut)
    monkeypatch.setattr(adaptation.size_field, "mean_error", lambda *_: left_errors.pop(0))
    monkeypatch.setattr(adaptation.size_field, "places_at_edges", lambda *_: ())
    monkeypatch.setattr(adaptation.mesher, "move_nodes", move)
    monkeypatch.setattr(adaptation.mesher, "divide_sides", divide)
    document: Any = None
    made = adaptation._move_to_edges(document, first, None, (1, 40), lambda *run: told.append(run))
    by = {"first": 0.0, "moved": 1.0, "divided": -10.0, "divided thrice": -30.0}
    by |= {"moved, divided": -9.0, "moved twice": 2.0, "moved twice, divided twice": -18.0}
    np.testing.assert_array_equal(made.positions[:3], np.eye(3) + by[taken])
    assert len(told) == runs


def test_a_best_design_keeps_the_mesh_that_it_was_found_on(tmp_path: Path) -> None:
    document = files.read_scene(_write(tmp_path, "adapt = { elements = 200, passes = 1 }", elements=60))
    sheet = geometry.build_sheet(document)
    thickness = 0.01 + 0.001 * sheet.positions[:, 0]
    (tmp_path / "best").mkdir()
    path = scene_rewriting.write_scene(document, {"parison.thickness": thickness}, tmp_path / "best")
    best = files.read_scene(path)
    again = geometry.build_sheet(best)
    np.testing.assert_array_equal(again.positions, sheet.positions)
    np.testing.assert_array_equal(again.triangles, sheet.triangles)
    np.testing.assert_array_equal(again.clamped, sheet.clamped)
    np.testing.assert_array_equal(again.fixed, sheet.fixed)
    np.testing.assert_allclose(files.build(best).parison.thickness, thickness, rtol=1e-12)


def test_designs_of_a_sweep_are_simulated_on_one_mesh_which_their_folders_have(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = _write(tmp_path, "adapt = { elements = 200, passes = 1 }", elements=60)
    (tmp_path / "table.csv").write_text("material.c\n1.0e6\n1.2e6\n1.5e6\n")
    made, make = list[int](), adaptation._make
    monkeypatch.setattr(adaptation, "_make", lambda *given: made.append(1) or make(*given))
    monkeypatch.setattr(adaptation, "_recent", {})
    setting, results = evaluation.Setting(client=evaluation.this_process()), list[np.ndarray]()
    for design in designs.make_designs(designs.read_table(tmp_path / "table.csv"), path):
        outcome = evaluation.simulate_design((pickle.loads(pickle.dumps(designs.name_scene(design))), setting))
        assert outcome.status == "ok"
        with zipfile.ZipFile(io.BytesIO(outcome.value[1])) as archive:
            archive.extractall(tmp_path / str(design.number))
        scene = files.read_scene(tmp_path / str(design.number) / "simulated.toml")
        results.append(geometry.build_sheet(scene).positions)
        # The folder has all that its scene needs.
        assert scene.model.parison.adapt is None and scene.data["material"]["c"] == design.values["material.c"]
    assert len(made) == 1
    own = geometry.build_sheet(files.read_scene(path)).positions
    for positions in results:
        np.testing.assert_array_equal(positions, own)


def test_by_default_the_mesh_has_no_fewer_elements_than_the_first(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(adaptation, "_ELEMENTS", 60)
    first = len(geometry.build_sheet(files.read_scene(_write(tmp_path, elements=120))).triangles)
    document = files.read_scene(_write(tmp_path, "adapt = { passes = 1 }", elements=120))
    assert 0.9 * first <= len(geometry.build_sheet(document).triangles) <= first


@pytest.mark.parametrize(
    ("adapt", "rest", "words"),
    [
        ("adapt = { elements = 5 }", "", r"parison\.adapt\.elements = 5: .*20"),
        ("adapt = { passes = 0 }", "", r"parison\.adapt\.passes = 0: .*1"),
        ("adapt = { goal = 'x' }", "", r"parison\.adapt\.goal.*"),
        ("adapt = {}", "[refinement]\nangle = 4.0\n", r"parison\.adapt.*together with \[refinement\].* one of the two"),
        ('mesh = "none.vtu"', "", r"parison\.mesh.*none\.vtu.*"),
    ],
)
def test_bad_values_are_refused(tmp_path: Path, adapt: str, rest: str, words: str) -> None:
    with pytest.raises(InputError, match=words):
        files.build(files.read_scene(_write(tmp_path, adapt, rest=rest)))


def test_without_mmg_it_is_said_what_to_install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    document = files.read_scene(_write(tmp_path, "adapt = { elements = 321 }", elements=60))
    monkeypatch.setitem(sys.modules, "mmgpy", None)
    with pytest.raises(InputError, match=r"parison\.adapt: needs Mmg, which is not installed; pip install mmgpy"):
        files.build(document)


def test_a_mesh_of_another_sheet_is_refused(tmp_path: Path) -> None:
    document = files.read_scene(_write(tmp_path, "adapt = { elements = 200, passes = 1 }", elements=60))
    scene_rewriting.write_scene(document, {}, tmp_path, "adapted.toml")
    text = (tmp_path / "adapted.toml").read_text().replace("radius = 1.0", "radius = 1.2")
    (tmp_path / "adapted.toml").write_text(text)
    with pytest.raises(InputError, match=r"parison\.mesh.*not a mesh of this sheet.*run `jaxform adapt` again"):
        files.build(files.read_scene(tmp_path / "adapted.toml"))


def test_too_few_elements_are_a_warning_each_time(tmp_path: Path) -> None:
    document = files.read_scene(_write(tmp_path, "adapt = { elements = 20, passes = 1 }", elements=20))
    words = r"parison\.adapt\.elements = (\d+): is too few elements: .* is about (\d+) %; allow about (\d+)"
    for _ in range(2):  # made, and kept from then on
        with pytest.warns(InputWarning, match=words) as caught:
            geometry.build_sheet(document)
        found = re.search(words, str(caught[0].message))
        assert found is not None
        used, percent, wanted = (int(x) for x in found.groups())
        assert used <= 20 and percent >= 10 and wanted >= 4 * used


def test_a_run_that_stops_has_no_mesh(tmp_path: Path) -> None:
    path = _write(tmp_path, "adapt = {}", elements=60)
    path.write_text(path.read_text().replace("damping = 63.246", "damping = 63.246\nmax_steps = 100"))
    with pytest.raises(InputError, match=r"parison\.adapt: adaptation pass 1 stopped: .* without parison\.adapt first"):
        files.build(files.read_scene(path))


@pytest.mark.parametrize("status", [Status.ESCAPED, Status.BURST, Status.UNFILLED, Status.UNBALANCED])
def test_the_wall_of_a_sheet_that_is_no_part_gives_no_mesh(tmp_path: Path, status: Status) -> None:
    result = scenes.at_rest(files.build(files.read_scene(_write(tmp_path, elements=60))))
    ended = replace(result, status=jnp.int32(status))
    if status in (Status.UNFILLED, Status.UNBALANCED):
        adaptation._check_end(ended, 1)
        return
    with pytest.raises(InputError, match=r"parison\.adapt: adaptation pass 1 stopped: the sheet "):
        adaptation._check_end(ended, 1)


def test_fields_of_a_mesh_file_are_those_of_the_file_after_every_pass(tmp_path: Path) -> None:
    """Each mesh in between would smooth a field; and its name may be any, also one that adaptation uses itself."""
    document = files.read_scene(_write(tmp_path, elements=60))
    sheet = geometry.build_sheet(document)
    thickness = 0.01 * (1.0 + 0.2 * np.random.default_rng(1).uniform(-1.0, 1.0, len(sheet.positions)))
    meshes.write_vtu(tmp_path / "own.vtu", sheet.positions, sheet.triangles, {"runs": thickness, "clamped": thickness})
    disc = "\n".join(['shape = "disc"', "radius = 1.0", "elements = 60", 'symmetry = "quarter"', "thickness = 0.01"])
    path = tmp_path / "scene.toml"
    scene, found = path.read_text(), []
    assert disc in scene
    for given in ('"field:runs"', '{ file = "own.vtu", field = "clamped" }'):
        own = f'shape = "file"\npath = "own.vtu"\nplanes = ["x", "y"]\nthickness = {given}\n'
        path.write_text(scene.replace(disc, own + "adapt = { elements = 200, passes = 2 }"))
        found.append(files.build(files.read_scene(path)).parison)
    one, other = found
    np.testing.assert_allclose(one.positions, other.positions, atol=1e-12)  # of runs that agree to rounding
    np.testing.assert_allclose(one.thickness, other.thickness, rtol=1e-12)


def test_a_new_mesh_has_no_fields_of_the_triangles_of_the_old_one(tmp_path: Path) -> None:
    sheet = geometry.build_sheet(files.read_scene(_write(tmp_path, elements=60)))
    marked = replace(sheet, cell_fields={"left": np.ones(len(sheet.triangles))})
    made = mesher.remesh(marked, np.ones(len(sheet.positions)), 100)
    meshes.write_vtu(tmp_path / "made.vtu", made.positions, made.triangles, geometry.sheet_fields(made))
    for each in (made, geometry.read_sheet_mesh(marked, tmp_path / "made.vtu")):
        assert all(len(values) == len(each.triangles) for values in each.cell_fields.values())


@pytest.mark.long
def test_the_adapted_mesh_differentiates(tmp_path: Path) -> None:
    scene = files.build(files.read_scene(_write(tmp_path, "adapt = { elements = 150, passes = 1 }", elements=60)))

    def uneven(thickness: jax.Array) -> jax.Array:
        wall = jaxform.simulate(jaxform.replace(scene, {"parison.thickness": thickness})).thickness
        return jnp.sum(jnp.square(wall / jnp.mean(wall) - 1.0))

    start = jnp.asarray(scene.parison.thickness)
    way = start * np.random.default_rng(3).uniform(-1.0, 1.0, start.size)
    slope = float(jax.jit(jax.grad(uneven))(start) @ way)
    value = jax.jit(uneven)
    up, down = (float(value(start + sign * 1e-8 * way)) for sign in (1, -1))
    assert (up - down) / 2e-8 == pytest.approx(slope, rel=1e-5)


def test_the_scene_that_it_begins_with(tmp_path: Path) -> None:
    document = files.read_scene(_write(tmp_path, "adapt = {}"))
    first = adaptation.without_adaptation(document)
    assert first.model.parison.adapt is None and first.path == document.path
    wanted = adaptation.adaptable(first, passes=3).model.parison.adapt
    assert wanted is not None and (wanted.elements, wanted.passes) == (None, 3)

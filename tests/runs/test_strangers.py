"""The strangers' molds, files and scenes of the benchmarks are what they say. No step is run."""

from __future__ import annotations

import warnings
from collections import Counter
from pathlib import Path

import numpy as np
import pytest

from benchmarks.stability import random_scenes, stress
from benchmarks.strangers import cad, cad_molds, flanges, scenes
from jaxform.core.errors import InputError
from jaxform.io import files, schema
from jaxform.mesh import meshes, topology


def test_the_sweep_of_flanges_is_spread_over_all_that_varies() -> None:
    chosen = flanges.cases()
    assert len(set(chosen)) == len(chosen) == 60
    assert not flanges.scene_of(chosen[2]).fill  # walls are compared at one pressure, which leaves corners open
    for field, values in (("mold", 3), ("distance", 8), ("width", 3), ("level", 4)):
        counts = Counter(getattr(case, field) for case in chosen)
        assert len(counts) == values
        assert min(counts.values()) >= 0.75 * 60 / values


@pytest.mark.parametrize("name", flanges.TOOLS)
def test_a_flanged_mold_has_its_flange_in_the_sheets_plane_and_its_opening_where_it_says(name: str) -> None:
    made = flanges.tool(name)
    corners = made.shape.vertices[made.shape.triangles]
    flange = corners[np.all(corners[..., 2] == 0.0, axis=1)]
    extent = np.abs(flange.reshape(-1, 3))
    assert extent[:, 0].max() == pytest.approx(made.flange[0], rel=1e-6)
    # The only open edges are those round the flange: nothing leaks between the mold's parts.
    rim = made.shape.vertices[topology.boundary_edges(made.shape.triangles)].reshape(-1, 3)
    assert np.abs(rim[:, 2]).max() == 0.0
    assert np.all(np.abs(rim[:, :2]).max(1) > made.opening[0])
    # No ring or row of nodes of any sheet lies on the opening.
    for width in flanges.WIDTHS:
        for size in made.element_size.values():
            places = flanges._sheet(flanges._extent(made, width), size).positions
            x = places[np.abs(places[:, 1]) < 1e-12, 0]
            assert np.abs(x - made.opening[0]).min() > 0.01 * size


def test_what_makes_a_scene_of_the_sweep_wrong() -> None:
    right = flanges.Found("ok", 0.009, 1.0, 0.0, False, 100, 1000, 1.0)
    assert right.right
    for wrong in ({"status": "unstable"}, {"rms": 0.011}, {"rms": np.nan}, {"thickest": 1.5}, {"warned": True}):
        assert not right._replace(**wrong).right
    case = flanges.cases()[0]
    line = flanges.summary([(case, right), (case, right._replace(status="unstable", rms=3.0))])
    assert line.startswith("1 of 2 stable, worst rms 0.90 %, 1 of 2 right")


def test_random_scenes_of_strangers_leave_the_others_as_they_were() -> None:
    assert random_scenes.family_of(7) == "free sphere"
    assert random_scenes.family_of(1190) == "cup"
    later = {random_scenes.family_of(seed) for seed in range(random_scenes.STRANGERS_FROM, 2000)}
    assert later == set(random_scenes.STRANGERS)
    assert not later & set(random_scenes.NAMES)


def test_units_that_are_off_are_a_thousand_times_off_and_must_be_told() -> None:
    seen = set()
    for seed in range(6):
        tags: list[str] = []
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            try:
                scene = scenes.own_meshes("own mold", np.random.default_rng(seed), tags)
            except InputError:
                continue  # a tiny mold that the sheet starts through
        assert scene.mold is not None
        sizes = [np.ptp(np.asarray(x)[:, :2], axis=0).max() for x in (scene.mold.vertices, scene.parison.positions)]
        off = abs(np.log10(sizes[0] / sizes[1])) > 2
        assert off == (scenes.OFF in tags)
        seen.add(off)
    assert seen == {True, False}
    row = {"tags": [scenes.OFF], "status": 0, "finite": True, "balance": 0.0, "warned": False, "done": 1.0,
           "nodes_beyond": 0.0, "elements_beyond": 0.0, "stuck": 0.0}  # fmt: skip
    assert stress.classify(row | {"told": []}) == "wrong units, no warning"
    assert stress.classify(row | {"told": ["nothing touched the mold"]}) == "ok"


def _pieces() -> list[cad_molds.Surface]:
    points = np.array([[0, 0, 0], [10, 0, 0], [10, 10, 0], [0, 10, 0], [20, 0, 5], [20, 10, 5.0], [99, 99, 99]])
    quad, triangles = np.array([[0, 1, 2, 3]]), np.array([[1, 4, 5], [1, 5, 2]])
    return [cad_molds.Surface(points, [quad]), cad_molds.Surface(points, [triangles])]


@pytest.mark.parametrize("ending", ["stl", "obj", "msh"])
def test_a_surface_comes_back_from_its_file(tmp_path: Path, ending: str) -> None:
    surface = cad_molds._join(_pieces())
    assert len(surface.points) == 6
    path = tmp_path / f"mold.{ending}"
    if ending == "stl":
        surface = cad_molds.Surface(surface.points, [np.array([[0, 1, 2], [0, 2, 3]]), surface.faces[1]])
    cad_molds.write_surface(path, surface)
    mesh = meshes.read_mesh(path, scale=0.001)
    corners = mesh.positions[mesh.triangles]
    area = 0.5 * np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1).sum()
    assert len(corners) == 4
    assert area == pytest.approx(1e-4 * (1 + np.sqrt(1.25)), rel=1e-6)


def test_pieces_that_do_not_share_points_stay_apart() -> None:
    one, two = _pieces()
    joined = cad_molds._join([one, cad_molds.Surface(two.points.copy(), two.faces)])
    assert len(joined.points) == 8
    np.testing.assert_array_equal(joined.points[joined.faces[1]], two.points[two.faces[0]])


@pytest.mark.parametrize("name", cad.PARTS)
@pytest.mark.parametrize("refined", [False, True])
def test_the_scene_files_of_parts_from_cad_are_valid(tmp_path: Path, name: str, refined: bool) -> None:
    path = tmp_path / "scene.toml"
    path.write_text(cad.scene_text(cad.PARTS[name], name, "mold.stl", refined))
    model = files.read_scene(path).model
    assert (model.refinement is not None) == refined
    assert isinstance(model.mold, schema.FileMold) and model.mold.scale == 0.001
    # Parts are compared at one pressure, which leaves corners open: a run that asks for more would end with 3.
    assert model.mold.fill is False


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        ({}, True),
        ({"warnings": ["an element cuts an edge of the mold, 0.0013 m deep"]}, True),
        ({"warnings": ["the sheet passed through a rib"]}, False),
        ({"simulate": 3}, False),
        ({"mass": 0.01}, False),
        ({"asymmetry": 0.02}, False),
    ],
)
def test_a_scene_of_cad_runs_well_where_it_warns_of_cuts_alone(change: cad.Row, expected: bool) -> None:
    row = {"simulate": 0, "mass": 1e-4, "in the file": 0.0, "asymmetry": 1e-3, "warnings": []}
    assert cad.well(row | change) is expected


def test_mass_and_symmetry_are_told_from_the_file_that_a_user_sees(tmp_path: Path) -> None:
    x, y = (grid.ravel() for grid in np.meshgrid(np.linspace(0, 0.2, 9), np.linspace(0, 0.14, 9)))
    flat = np.column_stack([x, y, 0 * x])
    a = (np.arange(8)[:, None] * 9 + np.arange(8)).ravel()
    triangles = np.concatenate([np.stack([a, a + 1, a + 10], 1), np.stack([a, a + 10, a + 9], 1)])
    part = cad.PARTS["six pockets"]
    for lean, symmetric in ((0.0, True), (0.2, False)):
        wall = part.thickness * (1 + lean * (x / 0.2 - 0.5))
        nodal = {"reference": flat, "thickness": wall}
        meshes.write_vtu(tmp_path / "final.vtu", flat, triangles, nodal, {"thickness": wall[triangles].mean(1)})
        mass = 1000.0 * part.thickness * 0.2 * 0.14
        found = cad.measure_part(tmp_path / "final.vtu", part, mass)
        assert found["mass"] == pytest.approx(0.0, abs=1e-12)
        assert found["in the file"] == pytest.approx(0.0, abs=1e-12)
        assert (found["asymmetry"] < 0.01) == symmetric

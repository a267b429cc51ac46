"""The wall for other programs: volumes and fields with known answers, what the files say, and CalculiX where it is."""

from __future__ import annotations

import csv
import json
import re
import shutil
import subprocess
import xml.etree.ElementTree as ElementTree
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import meshio
import numpy as np
import pytest
from numpy.typing import NDArray

from jaxform import shapes
from jaxform.cli import command, export_command
from jaxform.core.errors import InputError, InputWarning
from jaxform.io import export, previous_results
from jaxform.io.export import WallSurface, mapping
from jaxform.mesh import meshes, topology
from jaxform.mesh.meshes import Mesh
from jaxform.mesh.volumes import areas, conserve_volume, nodal_fields
from jaxform.tools.molds import rotation
from tests import scenes

Array = NDArray[np.float64]

RADIUS, HEIGHT, MIDDLE = 0.1, 0.04, 1.0e-3  # of a paraboloid of revolution, and its thickness at the pole


def _grid(many: tuple[int, int], place: Callable[[Array, Array], list[Array]]) -> tuple[Array, NDArray[np.int32]]:
    """A regular mesh of the unit square, put somewhere."""
    u, v = np.meshgrid(*(np.linspace(0, 1, n + 1) for n in many), indexing="ij")
    number = np.arange(u.size).reshape(u.shape)
    a, b, c, d = (number[i, j].ravel() for i in (slice(-1), slice(1, None)) for j in (slice(-1), slice(1, None)))
    triangles = np.concatenate([np.stack([a, c, d], 1), np.stack([a, d, b], 1)])
    return np.stack(place(u.ravel(), v.ravel()), axis=1), triangles.astype(np.int32)


def _bowl(elements: int, radius: float = RADIUS, symmetry: shapes.Symmetry = "none") -> Mesh:
    sheet = shapes.disc(radius=radius, elements=elements, symmetry=symmetry)
    positions = np.array(sheet.positions)
    positions[:, 2] = HEIGHT * (1 - (positions[:, 0] ** 2 + positions[:, 1] ** 2) / RADIUS**2)
    return Mesh(positions, sheet.triangles)


def _thickness(positions: Array) -> Array:
    return MIDDLE * (1 - 0.7 * (positions[:, 0] ** 2 + positions[:, 1] ** 2) / RADIUS**2)


def _wall(mesh: Mesh, thickness: Array, **options: object) -> WallSurface:
    positions, triangles = mesh.positions, mesh.triangles
    elements = thickness[triangles].mean(1)
    reference = positions * [1, 1, 0]
    held = np.ones(len(positions), bool)
    return WallSurface(positions, triangles, thickness, elements, reference, held, **options)  # pyright: ignore[reportArgumentType]


def _form(elements: int, symmetry: shapes.Symmetry = "none") -> WallSurface:
    mesh = _bowl(elements, symmetry=symmetry)
    planes = {0: 0.0, 1: 0.0} if symmetry == "quarter" else {}
    return _wall(mesh, _thickness(mesh.positions), planes=planes)


def _exact(radius: float) -> tuple[float, float]:
    """Area and volume of the paraboloid's wall up to a radius, by quadrature."""
    edge = np.linspace(0, radius, 20_001)
    r = 0.5 * (edge[1:] + edge[:-1])
    area = 2 * np.pi * r * np.sqrt(1 + (2 * HEIGHT * r / RADIUS**2) ** 2) * edge[1]
    return float(area.sum()), float(area @ (MIDDLE * (1 - 0.7 * r**2 / RADIUS**2)))


def test_nodal_thickness_has_the_volume_of_the_elements() -> None:
    random = np.random.default_rng(0)
    mesh = _bowl(80)
    nodal, elements = _thickness(mesh.positions), random.uniform(1e-4, 1e-3, len(mesh.triangles))
    found = conserve_volume(mesh.positions, mesh.triangles, nodal, elements)
    area = areas(mesh.positions, mesh.triangles)
    assert area @ found[mesh.triangles].mean(1) == pytest.approx(area @ elements, rel=1e-12)
    assert found.min() > 0
    # Where both agree nothing changes.
    same = conserve_volume(mesh.positions, mesh.triangles, nodal, nodal[mesh.triangles].mean(1))
    np.testing.assert_allclose(same, nodal, rtol=1e-12)


@pytest.mark.parametrize("elements", [250, 3000])
def test_a_wall_on_another_mesh_of_its_surface_keeps_volume_and_field(elements: int) -> None:
    wall, mesh = _form(1000), _bowl(elements)
    mapped, coverage = mapping.map_wall(wall, mesh, "mesh")
    assert mapped.volume == pytest.approx(wall.volume, rel=1e-3)
    assert areas(mesh.positions, mesh.triangles) @ mapped.element_thickness == pytest.approx(wall.volume, rel=1e-3)
    assert mapped.volume == pytest.approx(_exact(RADIUS)[1], rel=3e-3)  # 1000 flat triangles
    assert coverage.mesh > 0.995 and coverage.part > 0.995
    # The surface of 250 triangles is a hundredth smaller, so the wall is as much thicker.
    np.testing.assert_allclose(mapped.thickness, _thickness(mesh.positions), rtol=0.015)
    # The bowl was formed straight upwards.
    np.testing.assert_allclose(mapped.reference, mesh.positions * [1, 1, 0], atol=1e-3)


def test_a_mesh_that_covers_some_of_the_part_gets_that_much_of_its_volume() -> None:
    """Half a strip that is 1 mm thick at one end and 2 mm at the other: 1.25 mm in the mean."""
    half = Mesh(*_grid((7, 3), lambda u, v: [0.05 * u, 0.02 * v, 0 * u]))
    mapped, coverage = mapping.map_wall(_strip((20, 8)), half, "mesh")
    assert mapped.volume == pytest.approx(0.05 * 0.02 * 1.25e-3, rel=1e-3)
    assert coverage.part == pytest.approx(1.25 / 3, rel=1e-3) and coverage.mesh == 1.0
    np.testing.assert_allclose(mapped.thickness, 1e-3 * (1 + half.positions[:, 0] / 0.1), rtol=1e-3)


def test_a_mesh_that_goes_beyond_the_part_is_warned_of_with_its_share_and_distance() -> None:
    wall, mesh = _form(1000), _bowl(4000, radius=0.12)
    with pytest.warns(InputWarning, match=r"% of the mesh's area does not lie on the formed part") as told:
        mapped, coverage = mapping.map_wall(wall, mesh, "mesh")
    assert coverage.mesh == pytest.approx(_exact(RADIUS)[0] / _exact(0.12)[0], rel=5e-3)
    low = HEIGHT * (1 - 1.2**2)
    assert coverage.farthest == pytest.approx(np.hypot(0.02, low), rel=0.02)
    assert f": its farthest place is {1e3 * coverage.farthest:.3g} mm away;" in str(told[0].message)
    with pytest.warns(InputWarning, match=r"all of it is within 0\.9\d+ mm of it, but some is beyond its rim;"):
        mapping.map_wall(wall, _bowl(4000, radius=0.101), "mesh")
    inner = np.hypot(*mesh.positions[:, :2].T) < 0.09
    np.testing.assert_allclose(mapped.thickness[inner], _thickness(mesh.positions[inner]), rtol=0.01)


def test_a_quarter_is_completed_by_its_images() -> None:
    quarter = _form(60, "quarter")
    assert set(quarter.edge_sets()) == {"RIM", "SYM_X", "SYM_Y"}
    half = export.mirror(quarter, 0, 0.0)
    assert set(half.edge_sets()) == {"RIM", "SYM_Y"}
    whole = export.mirror(half, 1, 0.0)
    assert whole.volume == pytest.approx(4 * quarter.volume, rel=1e-12)
    assert not len(topology.inconsistent_edges(whole.triangles))
    rim = np.hypot(*whole.positions[whole.edge_sets()["RIM"]][:, :2].T)
    np.testing.assert_allclose(rim, RADIUS, rtol=1e-9)
    assert set(whole.edge_sets()) == {"RIM"}
    with pytest.warns(InputWarning, match=r"--mirror x=0 y=0 makes it whole"):
        mapping.map_wall(quarter, _bowl(300), "mesh")
    with pytest.raises(InputError, match="both sides"):
        export.mirror(whole, 0, 0.0)
    with pytest.raises(InputError, match="no node of the part lies"):
        export.mirror(quarter, 0, -0.01)


def _move(mesh: Mesh, far: float) -> Mesh:
    return Mesh(mesh.positions + np.full(3, far), mesh.triangles)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda mesh: Mesh(1e3 * mesh.positions, mesh.triangles), "--scale"),
        (lambda mesh: _move(mesh, 0.5), "almost no part of the mesh lies within"),
        (lambda mesh: meshes.merge([mesh, _move(mesh, 1e-4)]), "give one side of the wall only"),
    ],
)
def test_a_mesh_that_is_no_wall_of_this_part_is_refused(change: Callable[[Mesh], Mesh], words: str) -> None:
    with pytest.raises(InputError, match=words):
        mapping.map_wall(_form(200), change(_bowl(200)), "mesh")


def test_a_mesh_of_less_surface_than_the_part_has_is_told_so() -> None:
    mesh = _bowl(200)
    part = meshes.merge([mesh, _move(mesh, 1e-4), _move(mesh, 2e-4)])
    with pytest.raises(InputError, match="follows the whole part: this one omits") as told:
        mapping.map_wall(_wall(part, _thickness(part.positions)), mesh, "mesh")
    assert "both" not in str(told.value)


def _strip(many: tuple[int, int]) -> WallSurface:
    """100 mm by 20 mm, from 1 to 2 mm thick; clamped at x = 0."""
    mesh = Mesh(*_grid(many, lambda u, v: [0.1 * u, 0.02 * v, 0 * u]))
    return _wall(mesh, 1e-3 * (1 + mesh.positions[:, 0] / 0.1), words=("a strip",))


def _volume_of(positions: Array, triangles: NDArray[np.integer], thickness: Array) -> float:
    return float(areas(positions, triangles) @ thickness[triangles].mean(1))


def _nodal(text: str) -> Array:
    lines = text.split("*NODAL THICKNESS\n")[1].splitlines()
    return np.array([float(line.split(",")[1]) for line in lines])


@pytest.mark.parametrize("name", ["abaqus", "calculix"])
def test_an_input_file_says_what_the_wall_is(tmp_path: Path, name: str) -> None:
    wall, path = _strip((5, 2)), tmp_path / "wall.inp"
    export.write_wall(wall, path, name)
    text = path.read_text()
    # As meshio calls the element with six nodes.
    path.write_text(text.replace("TYPE=S6", "TYPE=STRI65"))
    mesh = meshio.read(path)
    corners = mesh.cells[0].data[:, :3]
    assert mesh.cells[0].type == ("triangle" if name == "abaqus" else "triangle6")
    assert _volume_of(mesh.points, corners, _nodal(text)) == pytest.approx(0.1 * 0.02 * 1.5e-3, rel=1e-6)
    assert "** Units: SI" in text and "*SHELL SECTION, ELSET=WALL, MATERIAL=WALL, NODAL THICKNESS" in text
    # Nodes of straight sides, in their middle where there are any.
    sides = 10 if name == "calculix" else 5
    assert len(mesh.point_sets["MIN_X"]) == (5 if name == "calculix" else 3)
    assert len(mesh.point_sets["MIN_Y"]) == sides + 1
    np.testing.assert_array_equal(mesh.points[mesh.point_sets["MAX_X"], 0], 0.1)
    assert len(mesh.point_sets["RIM"]) == 2 * sides + 2 * (4 if name == "calculix" else 2)
    between = " and 37 in the middles of sides" if name == "calculix" else ""
    assert f"** 18 nodes{between}, 20 triangles" in text and len(mesh.points) == (55 if between else 18)
    if name == "calculix":
        middle = mesh.points[mesh.cells[0].data[:, 3:]]
        expected = 0.5 * (mesh.points[corners] + mesh.points[np.roll(corners, -1, axis=1)])
        np.testing.assert_allclose(middle, expected, atol=1e-12)


def test_a_radioss_file_has_its_numbers_in_their_columns(tmp_path: Path) -> None:
    wall, path = _strip((5, 2)), tmp_path / "wall.rad"
    export.write_wall(wall, path, "radioss")
    blocks: dict[str, list[str]] = {}
    for line in path.read_text().splitlines():
        if line.startswith("/"):
            blocks[line] = []
        elif not line.startswith("#"):
            blocks[list(blocks)[-1]].append(line)
    nodes = np.array([[float(line[10 + 20 * k : 30 + 20 * k]) for k in range(3)] for line in blocks["/NODE"]])
    cells = np.array([[int(line[10 * k : 10 * k + 10]) for k in range(4)] for line in blocks["/SH3N/1"]])
    thick = np.array([float(line[80:100]) for line in blocks["/SH3N/1"]])
    np.testing.assert_allclose(nodes, wall.positions, atol=1e-12)
    assert areas(nodes, cells[:, 1:] - 1) @ thick == pytest.approx(0.1 * 0.02 * 1.5e-3, rel=1e-9)
    assert all(line[40:60] == 20 * " " and float(line[60:80]) == 0 for line in blocks["/SH3N/1"])
    assert [int(blocks["/PART/1"][1][10 * k : 10 * k + 10]) for k in range(3)] == [1, 1, 0]
    assert float(blocks["/PROP/SHELL/1"][3][20:40]) == pytest.approx(1.5e-3)
    groups = {lines[0]: " ".join(lines[1:]).split() for name, lines in blocks.items() if name.startswith("/GRNOD")}
    assert [int(number) - 1 for number in groups["RIM"]] == wall.edge_sets()["RIM"].tolist()


def test_a_table_and_a_mesh_have_the_thickness_at_each_place(tmp_path: Path) -> None:
    wall = _strip((5, 2))
    export.write_wall(wall, tmp_path / "wall.csv", "csv")
    export.write_wall(wall, tmp_path / "wall.vtu", "vtu")
    rows = list(csv.DictReader((tmp_path / "wall.csv").read_text().splitlines()))
    assert len(rows) == 18
    for row in rows:
        assert float(row["thickness_m"]) == pytest.approx(1e-3 * (1 + float(row["x_m"]) / 0.1), rel=1e-9)
        assert float(row["reference_y_m"]) == float(row["y_m"])
    mesh = meshio.read(tmp_path / "wall.vtu")
    np.testing.assert_array_equal(mesh.point_data["thickness"], wall.thickness)
    np.testing.assert_array_equal(mesh.cell_data["thickness"][0], wall.element_thickness)
    np.testing.assert_array_equal(np.flatnonzero(mesh.point_data["MAX_X"]), [15, 16, 17])
    assert "Units: SI" in (tmp_path / "wall.vtu").read_text()


_DECK = """*INCLUDE, INPUT=wall.inp
*MATERIAL, NAME=WALL
*ELASTIC
1e9, 0.
*BOUNDARY
{held}
*STEP
*STATIC
{load}
*NODE PRINT, NSET=MIN_X, TOTALS=ONLY
RF
*NODE PRINT, NSET=MAX_X
U
*END STEP
"""


def _calculix(folder: Path, wall: WallSurface, held: str, load: str) -> tuple[Array, Array]:
    """The total force (3,) at the small end and the mean displacement (3,) of the other one, as CalculiX finds them."""
    solver = _solver()
    export.write_wall(wall, folder / "wall.inp", "calculix")
    return _solve(solver, folder, _DECK.format(held=held, load=load))


def _solver() -> str:
    found = shutil.which("ccx") or shutil.which("ccx_dynamic")
    if found is None:
        pytest.skip("CalculiX (ccx) is not installed")
    return found


def _solve(solver: str, folder: Path, deck: str) -> tuple[Array, Array]:
    """The total force (3,) and the mean of the displacements (3,), NaN where none are printed."""
    (folder / "run.inp").write_text(deck)
    done = subprocess.run([solver, "-i", "run"], cwd=folder, capture_output=True, text=True, timeout=60)
    assert "Job finished" in done.stdout, done.stdout[-1000:]
    rows = [line.split() for line in (folder / "run.dat").read_text().splitlines()]
    totals = [row for row in rows if len(row) == 3 and "E" in row[0]]
    moved = [row[1:] for row in rows if len(row) == 4 and row[0].isdigit()]
    return np.array(totals[0], float), np.array(moved, float).mean(0) if moved else np.full(3, np.nan)


def test_calculix_presses_the_bottle_as_the_page_says(tmp_path: Path) -> None:
    solver = _solver()
    page = (Path(__file__).parents[2] / "docs" / "how-to" / "export.md").read_text()
    deck = page[page.index("*INCLUDE, INPUT=wall.inp") : page.index("*END STEP")] + "*END STEP\n"
    said = float(re.search(r"force at the bottom: ([\d.]+) N", page)[1])  # pyright: ignore
    folder = tmp_path / "bottle"
    assert command.main(["simulate", "soap-bottle", "--out", str(folder), "--quiet"]) == 0
    assert command.main(["export", str(folder), "--to", "calculix", "--mirror", "z=0", "--quiet"]) == 0
    assert _solve(solver, folder, deck)[0][1] == pytest.approx(said, rel=0.005)


def test_calculix_pulls_a_strip_of_varying_thickness_as_hard_as_the_formula(tmp_path: Path) -> None:
    held = "NODES, 3, 3\nMIN_X, 1, 2"
    force, moved = _calculix(tmp_path, _strip((10, 4)), held, "*BOUNDARY\nMAX_X, 1, 1, 1e-5")
    assert moved[0] == pytest.approx(1e-5)
    # In series: E b over the integral of 1/h.
    assert -force[0] == pytest.approx(1e9 * 0.02 * 1e-5 / (0.1 / 1e-3 * np.log(2)), rel=1e-3)


def test_calculix_bends_a_strip_as_far_as_the_formula(tmp_path: Path) -> None:
    strip = _strip((10, 2))
    even = replace(strip, thickness=np.full(33, 1e-3))
    load = "*CLOAD\n31, 3, 0.0025\n32, 3, 0.005\n33, 3, 0.0025"
    force, moved = _calculix(tmp_path, even, "MIN_X, 1, 6", load)
    assert -force[2] == pytest.approx(0.01, rel=1e-4)
    assert moved[2] == pytest.approx(0.01 * 0.1**3 / (3 * 1e9 * 0.02 * 1e-3**3 / 12), rel=0.01)


@pytest.fixture
def results(tmp_path: Path) -> Path:
    """A folder as a run of a quarter leaves it."""
    folder = tmp_path / "run"
    folder.mkdir()
    wall = _form(60, "quarter")
    flat = wall.positions * [1, 1, 0]
    held = np.hypot(*flat[:, :2].T) > 0.999 * RADIUS
    data = {"reference": flat, "thickness": wall.thickness, "contact_time": np.where(held, 0.0, -1.0)}
    meshes.write_vtu(
        folder / "final.vtu", wall.positions, wall.triangles, data, {"thickness": 1.1 * wall.element_thickness}
    )
    summary = {"scene": "b\u00f6wl---\x1b\n*NODE", "status": "ok", "symmetry_planes": {"x": 0.0, "y": 0.0}}
    (folder / "summary.json").write_text(json.dumps(summary))
    return folder


def test_the_command_writes_a_completed_part_onto_a_mesh_in_mm(
    results: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    target = _bowl(400)
    meshes.write_stl(tmp_path / "part.stl", 1e3 * target.positions, target.triangles)
    arguments = ["export", str(results), "--to", "vtu", "--mirror", "x", "y=0"]
    onto = ["--onto", str(tmp_path / "part.stl"), "--scale", "0.001", "--out", str(tmp_path / "on.vtu")]
    assert command.main(arguments) == 0
    assert command.main([*arguments, *onto]) == 0
    captured = capfd.readouterr()
    assert captured.err == "" and "on.vtu" in captured.out
    for path in (results / "wall.vtu", tmp_path / "on.vtu"):
        mesh = meshio.read(path)
        volume = _volume_of(mesh.points, mesh.cells[0].data, mesh.point_data["thickness"])
        assert volume == pytest.approx(4 * 1.1 * _form(60, "quarter").volume, rel=1e-3)
    assert command.main([*arguments, "--quiet", "--force"]) == 0
    assert capfd.readouterr().out == ""
    # A name with a line feed does not become a line of its own.
    # Nor is one with dashes or marks of a terminal any less a comment.
    assert "<!-- wall of b\\xf6wl- - - *NODE, exported by jaxform" in (results / "wall.vtu").read_text()
    ElementTree.parse(results / "wall.vtu")


_SCENE = """
[parison]
shape = "disc"
radius = {radius}
elements = 60
thickness = 1e-3
[material]
model = "neo-hookean"
c = 1e5
density = 1000.0
[pressure]
time = [0.0, 1.0]
value = [0.0, 1.0]
[mold]
shape = "file"
path = "mold.stl"
scale = 0.001
rotate = [180.0, 0.0, 30.0]
translate = [0.01, 0.02, 0.3]
[solver]
end_time = 1.0
"""


def _solid(inner: Mesh, thick: float) -> tuple[Array, NDArray[np.int64]]:
    """A closed bowl so thick (n, 3) [m], the given one its inside."""
    outer = inner.positions + np.array([0.0, 0.0, thick])
    outer[:, :2] *= 1 + thick / RADIUS
    rim, count = topology.boundary_edges(inner.triangles), len(inner.positions)
    sides = [np.column_stack([rim[:, 0], rim[:, 1], rim[:, 1] + count])]
    sides.append(np.column_stack([rim[:, 0], rim[:, 1] + count, rim[:, 0] + count]))
    return np.concatenate([inner.positions, outer]), np.concatenate(
        [inner.triangles[:, ::-1], inner.triangles + count, *sides]
    ).astype(np.int64)


@pytest.mark.parametrize("closed", [True, False])
@pytest.mark.parametrize("copy", [True, False])
def test_a_mold_in_its_own_coordinates_is_placed_as_the_scene_did(
    results: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str], closed: bool, copy: bool
) -> None:
    """The mold's file itself, or another mesh in its coordinates; of a closed solid the touched side alone."""
    inner = _bowl(400)
    places, triangles = _solid(inner, 0.004) if closed else (inner.positions, np.asarray(inner.triangles))
    placed = rotation(np.array([180.0, 0.0, 30.0]))
    own = 1e3 * (places - np.array([0.01, 0.02, 0.3])) @ placed
    meshes.write_stl(results / "mold.stl", own, triangles)
    if not copy:
        own = own + 0.005  # mm, so that the file is another
    meshes.write_stl(tmp_path / "target.stl", own, triangles)
    (results / "simulated.toml").write_text(_SCENE.format(radius=RADIUS))
    out = tmp_path / "on.vtu"
    arguments = ["export", str(results), "--to", "vtu", "--mirror", "x", "y=0", "--out", str(out), "--force"]
    arguments += ["--onto", str(tmp_path / "target.stl")]
    assert command.main(arguments) == 0
    said = capfd.readouterr().out
    assert ("the mold's own file" if copy else "in the coordinates of the mold's file") in said
    mesh = meshio.read(out)
    # In the file's own coordinates, in m.
    back = mesh.points @ placed.T + np.array([0.01, 0.02, 0.3])
    nearest = np.linalg.norm(back[:, None] - inner.positions[None], axis=2).min(1)
    assert (nearest < 1e-5).mean() > 0.98
    full = 4 * 1.1 * _form(60, "quarter").volume
    assert _volume_of(mesh.points, mesh.cells[0].data, mesh.point_data["thickness"]) == pytest.approx(full, rel=5e-3)
    if closed:
        assert "gets no wall" in said
    # In the scene's coordinates it is somewhere else.
    capfd.readouterr()
    assert command.main([*arguments, "--pose", "scene", "--scale", "0.001"]) == 2
    assert "mold's file" not in capfd.readouterr().out


@pytest.mark.parametrize(
    ("summary", "height"),
    [('{"time": 0.02}', 0.15), ('{"time": 0.01}', 0.115625), ("{}", 0.1648), ('{"time": []}', 0.1648)],
)
def test_the_pose_of_a_moving_mold_is_that_at_the_end_of_the_run(tmp_path: Path, summary: str, height: float) -> None:
    """Not that at its last knot, which the run may not have reached."""
    motion = "[mold.motion]\ndirection = [0.0, 0.0, 3.0]\ntime = [0.0, 0.04]\ndisplacement = [0.0, 0.1]\n"
    mold = 'shape = "file"\npath = "mold.stl"\ntranslate = [0.0, 0.0, 0.1]\n'
    begin, end = (scenes.FILE.index(word) for word in ('shape = "revolved"', "[solver]"))
    (tmp_path / "simulated.toml").write_text(
        scenes.FILE[:begin] + mold + motion + scenes.FILE[end:].replace("0.05", "0.024")
    )
    (tmp_path / "summary.json").write_text(summary)
    pose = mapping.read_pose(tmp_path)
    assert pose is not None
    np.testing.assert_allclose(pose.shift, [0.0, 0.0, height], rtol=1e-12)


def test_a_pose_without_a_mold_from_a_file_is_refused(
    results: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    target = _bowl(100)
    meshes.write_stl(tmp_path / "part.stl", target.positions, target.triangles)
    said = _assert_refused(capfd, str(results), "--to", "vtu", "--onto", str(tmp_path / "part.stl"), "--pose", "file")
    assert "--pose" in said and "no mold from a file" in said
    assert "--onto" in _assert_refused(capfd, str(results), "--to", "vtu", "--pose", "file")


def _assert_refused(capfd: pytest.CaptureFixture[str], *arguments: str) -> str:
    assert command.main(["export", *arguments]) == 2
    captured = capfd.readouterr()
    assert captured.out == "" and len(captured.err.splitlines()) == 1, captured
    return captured.err


def test_bad_arguments_are_one_line(results: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    (results / "wall.csv").touch()
    (tmp_path / "bad.stl").write_text("solid")
    folder = str(results)
    for more, words in (
        (["--to", "nastran"], "invalid choice"),
        (["--to", "csv"], "exists already; choose another file or give --force"),
        (["--to", "vtu", "--scale", "0.001"], "--scale = 0.001: is given without a mesh; give --onto"),
        (["--to", "vtu", "--mirror", "w"], "--mirror = 'w': is not a plane"),
        (["--to", "vtu", "--mirror", "x=nan"], "is not a plane"),
        (["--to", "vtu", "--mirror", "x", "x"], "lies on both sides"),
        (["--to", "vtu", "--onto", str(tmp_path / "no.stl")], "--onto = "),
        (["--to", "vtu", "--onto", str(tmp_path / "bad.stl")], "is not a readable STL file"),
        (["--to", "vtu", "--onto", str(tmp_path / "bad.stl"), "--scale", "-1"], "--scale = -1.0"),
        (["--to", "vtu", "--onto", str(results / "final.vtu"), "--scale", "0.001"], "times as large as the part"),
        (["--to", "vtu", "--out", str(tmp_path / "no" / "w.vtu")], "cannot be written"),
        (["--to", "vtu", "--out", str(tmp_path)], "is a folder"),
    ):
        assert words in _assert_refused(capfd, folder, *more), more
    assert not (results / "wall.vtu").exists()


def test_what_lies_in_folds_is_part_of_the_volume(tmp_path: Path) -> None:
    """A strip that was pulled to 1.44 times its length, then pushed together to half the width it then had."""
    length, width, sheet, density = 0.1, 0.02, 1e-3, 900.0
    mass = density * length * width * sheet
    mesh = Mesh(*_grid((6, 3), lambda u, v: [1.44 * length * u, 0.5 * width / 1.2 * v, 0 * u]))
    # Incompressible: as the square root of the pull, both width and thickness shrink.
    nodal, cells = np.full(len(mesh.positions), sheet / 1.2), np.full(len(mesh.triangles), sheet / 1.2)
    data = {"thickness": cells, "wrinkled": np.full(len(mesh.triangles), 0.5)}
    meshes.write_vtu(tmp_path / "final.vtu", mesh.positions, mesh.triangles, {"thickness": nodal}, data)
    with pytest.warns(InputWarning, match="up to 50 % of an element lies in folds"):
        wall = export.read_wall(tmp_path)
    assert wall.volume == pytest.approx(mass / density, rel=1e-12)
    assert areas(mesh.positions, mesh.triangles) @ wall.element_thickness == pytest.approx(mass / density, rel=1e-12)
    # And so it is as the sheet of a next stage.
    with pytest.warns(InputWarning, match="up to 50 % of an element lies in folds"):
        found = nodal_fields(meshes.read_mesh(tmp_path / "final.vtu"))["thickness"]
    assert _volume_of(mesh.positions, mesh.triangles, found) == pytest.approx(mass / density, rel=1e-12)
    data["wrinkled"][0] = np.nan
    meshes.write_vtu(tmp_path / "final.vtu", mesh.positions, mesh.triangles, {"thickness": nodal}, data)
    with pytest.raises(InputError, match=r"final\.vtu: wrinkled: is not finite everywhere"):
        export.read_wall(tmp_path)


@pytest.mark.parametrize("field", [{}, {"thickness": np.array([1.0, np.nan, 1.0])}, {"thickness": np.zeros(3)}])
def test_a_folder_without_a_wall_is_refused(
    tmp_path: Path, field: dict[str, Array], capfd: pytest.CaptureFixture[str]
) -> None:
    assert "no final.vtu" in _assert_refused(capfd, str(tmp_path), "--to", "csv")
    meshes.write_vtu(tmp_path / "final.vtu", np.eye(3), [[0, 1, 2]], field)
    assert "thickness" in _assert_refused(capfd, str(tmp_path), "--to", "csv")
    (tmp_path / "summary.json").write_text("[")
    assert "summary.json" in _assert_refused(capfd, str(tmp_path), "--to", "csv")


def test_a_run_that_stopped_is_warned_of(results: Path, capfd: pytest.CaptureFixture[str]) -> None:
    (results / "summary.json").write_text(json.dumps({"scene": "bowl", "status": "unstable at 0.1 s"}))
    assert command.main(["export", str(results), "--to", "csv"]) == 0
    assert "unstable at 0.1 s" in capfd.readouterr().err


def test_planes_that_are_nowhere_are_none() -> None:
    """JSON may have an integer that is too large for a float, and infinity."""
    planes = {"x": 10**400, "y": np.inf, "z": 0.25, "w": 1.0}
    assert previous_results.symmetry_planes({"symmetry_planes": planes}) == {2: 0.25}


def test_the_command_knows_all_formats() -> None:
    assert tuple(export.FORMATS) == export_command.FORMATS


@pytest.mark.parametrize(("ending", "form"), [(".inp", "abaqus"), (".bdf", "nastran"), (".mesh", "medit")])
def test_meshes_of_other_programs_are_taken(tmp_path: Path, ending: str, form: str) -> None:
    mesh, path = _bowl(100), tmp_path / f"part{ending}"
    # Short numbers: meshio cannot write others into the fields of Nastran.
    mesh = Mesh(np.round(mesh.positions, 5), mesh.triangles)
    meshio.Mesh(np.round(1e3 * mesh.positions, 2), [("triangle", mesh.triangles)]).write(path, file_format=form)
    found = mapping.read_target(path, 1e-3)
    np.testing.assert_allclose(found.positions, mesh.positions, atol=1e-7)
    np.testing.assert_array_equal(found.triangles, mesh.triangles)
    with pytest.raises(InputError, match="not a known mesh format"):
        meshes.read_mesh(path)
    path.write_bytes(path.read_bytes()[:300])
    with pytest.raises(InputError, match="--onto"):
        mapping.read_target(path, 1e-3)


def test_an_input_file_that_takes_in_others_is_not_read(tmp_path: Path) -> None:
    path = tmp_path / "part.inp"
    path.write_text(f"*Include, input={path}\n")
    with pytest.raises(InputError, match=r"includes other files \(\*INCLUDE\)"):
        mapping.read_target(path, 1.0)

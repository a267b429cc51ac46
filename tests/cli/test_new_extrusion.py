"""`jaxform new --process extrusion-blow`: scenes for bottles of several kinds that run the first time."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import shapely

import jaxform
from jaxform.cli.command import main
from jaxform.mesh import grids, meshes, topology
from jaxform.mesh.meshes import Mesh
from jaxform.tools import molds, parting
from jaxform.tools.bottles import block_cavities, clip, find_bottle, find_outside

ROUND = [[0, 6], [20, 5], [32, 0], [42, 3], [45, 10], [45, 190], [30, 250], [13.5, 285], [13.5, 300], [0, 300]]
HOLLOW = [*ROUND[:-1], [12, 300], [12, 284], [28.5, 249], [43.5, 190], [43.5, 11], [32, 2], [20, 6.5], [0, 7.5]]
SQUARE = [(0, 28, 20, 0.6), (3, 33, 25, 0.4), (8, 35, 27, 0.35), *((z, 35, 27, 0.35) for z in range(20, 150, 10))]
SQUARE += [
    (160, 33, 25, 0.45),
    (170, 27, 21, 0.6),
    (180, 18, 17, 0.85),
    (188, 13, 13, 1),
    (195, 12, 12, 1),
    (215, 12, 12, 1),
]


def _square() -> Mesh:
    return loft(SQUARE)


def loft(sections: Sequence[Sequence[float]]) -> Mesh:
    """A closed bottle from rings of superellipses: z, half widths, and exponent."""
    angle = 2 * np.pi * np.arange(64) / 64
    cosine, sine = np.cos(angle), np.sin(angle)
    rings = [
        np.stack([a * np.sign(cosine) * abs(cosine) ** e, b * np.sign(sine) * abs(sine) ** e, 0 * angle + z], axis=1)
        for z, a, b, e in sections
    ]
    here, last = np.arange(64), 64 * (len(rings) - 1)
    after = (here + 1) % 64
    bands = [
        np.stack([here, after, after + 64, here, after + 64, here + 64], 1) + 64 * k for k in range(len(rings) - 1)
    ]
    ends = [
        np.stack([0 * here + last + 64, after, here], 1),
        np.stack([0 * here + last + 65, here + last, after + last], 1),
    ]
    middles = [[0, 0, sections[0][0]], [0, 0, sections[-1][0]]]
    triangles = np.concatenate([np.concatenate(bands).reshape(-1, 3), *ends])
    return Mesh(np.concatenate([*rings, middles]), triangles.astype(np.int32), {})


WAIST = [(0, 20, 20, 0.7), (2, 27, 27, 0.5), (6, 31, 31, 0.42), (60, 32, 32, 0.38), (80, 28, 28, 0.41)]
WAIST += [(95, 25, 25, 0.44), (110, 28, 28, 0.41), (130, 32, 32, 0.38), (172, 32, 32, 0.38), (186, 24, 24, 0.65)]
WAIST += [(201, 14, 14, 1), (206, 13, 13, 1), (228, 13, 13, 1)]
NEAR = {"neck_radius": 0.018, "hole_center": [0.0085, 0.152], "handle_edge": 0.03, "element_size": 0.005}
FAR = {"neck_radius": 0.012, "element_size": 0.005}


def with_handle(**sizes: Any) -> Mesh:
    """The whole of the bottle with a handle, closed at its neck, along y."""
    half = molds.bottle_half(**(sizes or NEAR))
    image = Mesh(half.vertices * [1, 1, -1], half.triangles[:, ::-1], {})
    whole = meshes.weld(meshes.merge([Mesh(half.vertices, half.triangles, {}), image]))
    rim = np.insert(topology.boundary_edges(whole.triangles), 2, len(whole.positions), axis=1)
    positions = np.concatenate([whole.positions, [[0.0, 0.23, 0.0]]])
    return Mesh(1e3 * positions, np.concatenate([whole.triangles, rim]).astype(np.int32), {})


def _bottle(kind: str) -> Mesh:
    if kind == "far handle":
        return with_handle(**FAR)
    if kind == "waist":
        return loft(WAIST)
    if kind == "half":
        return clip(_square(), np.array([0.0, 1.0, 0.0]), 0.0, keep_below=False)
    shape = molds.revolved(profile=ROUND if kind == "round" else HOLLOW, segments=48)
    turn = molds.rotation(np.array([20.0, 35.0, 10.0]))
    return Mesh(shape.vertices @ turn.T + [5.0, 6.0, 7.0], shape.triangles, {})


def _new(folder: Path, bottle: Mesh, *more: str) -> int:
    meshes.write_stl(folder / "bottle.stl", bottle.positions, bottle.triangles)
    mold = str(folder / "bottle.stl")
    return main(["new", str(folder / "new"), "--mold", mold, "--process", "extrusion-blow", "--quiet", *more])


@pytest.mark.long
@pytest.mark.parametrize("kind", ["waist", "half", "far handle"])
def test_scene_runs_the_first_time(tmp_path: Path, kind: str) -> None:
    assert _new(tmp_path, _bottle(kind)) == 0
    scene = jaxform.load(tmp_path / "new" / "scene.toml")  # warnings are errors here
    assert main(["simulate", str(tmp_path / "new" / "scene.toml"), "--out", str(tmp_path / "out"), "--quiet"]) == 0
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert summary["status"] == "ok" and summary["warnings"] == [] and summary["contact_fraction"] > 0.99
    assert summary["flash_mass"] > 0.05 * summary["mass"]
    # Beside the body nothing is pinched: the parison is narrower than the cavity when it closes.
    boxes = np.array([piece["box"] for piece in summary["flash"]])
    assert kind == "far handle" or np.ptp(boxes[:, :, 2], axis=1).max() < 0.06
    # To reach a handle, it is wider than the neck.
    wide = float(np.ptp(np.asarray(scene.parison.positions)[:, 1]))
    assert (wide > 2.0 * FAR["neck_radius"]) == (kind == "far handle")
    # The part's mass is that of its mean wall on the mold, but for what corners leave open.
    assert scene.mold is not None
    mean = summary["mass"] / (950.0 * _area(meshes.read_mesh(tmp_path / "new" / "half.stl")))
    np.testing.assert_allclose(summary["thickness"]["mean"], mean, rtol=0.1)


def _area(mesh: Mesh) -> float:
    corners = mesh.positions[mesh.triangles]
    across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    return float(0.5 * np.linalg.norm(across, axis=1).sum())


@pytest.mark.quick
def test_of_a_bottle_with_a_wall_the_outside_is_taken() -> None:
    halves = [find_bottle(meshes.weld(_bottle(kind))) for kind in ("round", "hollow")]
    for name in ("length", "neck", "area"):
        one, other = (getattr(half, name) for half in halves)
        np.testing.assert_allclose(other, one, rtol=2e-3)


@pytest.mark.long
def test_half_is_completed_and_lies_as_the_whole() -> None:
    whole, half = find_bottle(_square()), find_bottle(meshes.weld(_bottle("half")))
    np.testing.assert_allclose([half.length, half.neck, half.area], [whole.length, whole.neck, whole.area], rtol=1e-6)
    assert np.all(half.mesh.positions[:, 0] >= 0.0)
    # The parting plane is the one along which the bottle is widest.
    np.testing.assert_allclose(np.ptp(whole.mesh.positions, axis=0)[:2], [27.0, 70.0], rtol=1e-3)


@pytest.mark.quick
@pytest.mark.parametrize("cut", ["open", "solid", "neck"])
def test_a_half_is_completed_however_it_lies(cut: str) -> None:
    """A half that is open, closed by a face, or open at the neck, too: as the upright whole, where it is turned."""
    upright, turn = _square(), molds.rotation(np.array([25.0, 40.0, 70.0]))
    mesh = clip(upright, np.array([0.0, 1.0, 0.0]), 0.0, keep_below=False)
    if cut == "solid":
        edges = topology.boundary_edges(mesh.triangles)
        positions = np.concatenate([mesh.positions, [[0.0, 0.0, 100.0]]])
        face = np.insert(edges[:, ::-1], 2, len(mesh.positions), axis=1).astype(np.int32)
        mesh = Mesh(positions, np.concatenate([mesh.triangles, face]), {})
    if cut == "neck":
        mesh = clip(mesh, np.array([0.0, 0.0, 1.0]), 214.9, keep_below=True)
    # As a file in single precision has it.
    places = (mesh.positions @ turn.T + [310.0, -45.0, 12.0]).astype(np.float32).astype(float)
    found, axis, _, low, end = find_outside(meshes.weld(Mesh(places, mesh.triangles, {})))
    np.testing.assert_allclose(axis, turn[:, 2], atol=1e-3)
    whole = find_outside(upright)
    np.testing.assert_allclose(end - low, whole[4] - whole[3], rtol=2e-3)
    np.testing.assert_allclose(_area(found), _area(whole[0]), rtol=2e-3)
    assert len(topology.boundary_edges(found.triangles)) > 0 and topology.count_handles(found.triangles) == 0


@pytest.mark.quick
@pytest.mark.parametrize("rotate", [(0.0, 0.0, 0.0), (25.0, 40.0, 70.0)])
def test_a_can_with_flat_sides_is_no_half_and_a_handle_does_not_tilt_the_axis(rotate: tuple[float, ...]) -> None:
    turn = molds.rotation(np.array(rotate))
    can = loft([(0, 60, 40, 1e-9), (150, 60, 40, 1e-9), (155, 16, 16, 1), (175, 16, 16, 1)])
    for mesh, along, length in ((can, 2, 175.0), (with_handle(), 1, 230.0)):
        found, axis, _, low, end = find_outside(meshes.weld(Mesh(mesh.positions @ turn.T, mesh.triangles, {})))
        np.testing.assert_allclose(axis, turn[:, along], atol=5e-3)
        np.testing.assert_allclose(end - low, 0.99 * length, rtol=5e-3)
        assert np.ptp(found.positions @ turn, axis=0)[0] < 130.0, "not mirrored at a side"


JAR = [[0, 3], [40, 2], [52, 0], [58, 3], [60, 10], [60, 52], [56, 62], [42, 70], [36, 72], [36, 86], [0, 86]]
HOLLOW_JAR = [*JAR[:-1], [34, 86], [34, 71], [41, 68.5], [55, 60.5], [58, 51], [58, 11], [52, 2.2], [40, 4], [0, 5]]
FLASK = [(0, 60, 14, 0.6), (3, 68, 19, 0.5), (8, 70, 20, 0.5), (60, 70, 20, 0.5), (75, 66, 19.5, 0.55)]
FLASK += [(86, 48, 18, 0.7), (92, 26, 15, 0.9), (95, 13, 13, 1), (98, 12, 12, 1), (115, 12, 12, 1)]


def squat(kind: str) -> Mesh:
    """A bottle that is wider than tall, along z; half of it, closed by the face of the cut, for "half jar"."""
    if kind == "flask":
        return loft(FLASK)
    if kind == "jug":
        x, y, z = with_handle(**NEAR | {"neck_radius": 0.012}).positions.T
        return Mesh(np.stack([z, x, 0.3 * y], axis=1), with_handle(**NEAR | {"neck_radius": 0.012}).triangles, {})
    shape = molds.revolved(profile=JAR if kind == "jar" else HOLLOW_JAR, segments=48)
    whole = meshes.weld(Mesh(shape.vertices, shape.triangles, {}))
    if kind == "jar":
        return whole
    half = clip(whole, np.array([0.0, 1.0, 0.0]), 0.0, keep_below=False)
    edges = half.positions[topology.boundary_edges(half.triangles)]
    part = shapely.get_parts(shapely.polygonize([shapely.LineString(edge[:, [0, 2]]) for edge in edges]))
    flat = shapely.get_coordinates(shapely.constrained_delaunay_triangles(part[0])).reshape(-1, 4, 2)[:, :3]
    places = np.insert(flat.reshape(-1, 2), 1, 0.0, axis=1)
    face = Mesh(places, np.arange(len(places)).reshape(-1, 3).astype(np.int32), {})
    return meshes.weld(meshes.merge([half, face]))


@pytest.mark.quick
@pytest.mark.parametrize(("kind", "length"), [("jar", 86.0), ("flask", 115.0), ("jug", 69.0), ("half jar", 86.0)])
def test_the_axis_of_a_bottle_that_is_wider_than_tall_runs_through_its_neck(kind: str, length: float) -> None:
    upright = squat(kind)
    if kind == "half jar":
        assert topology.is_closed(upright.triangles)
    for rotate in ((0.0, 0.0, 0.0), (25.0, 40.0, 70.0), (-110.0, 15.0, 200.0)):
        turn = molds.rotation(np.array(rotate))
        places = (upright.positions @ turn.T + [31.0, -45.0, 120.0]).astype(np.float32).astype(float)
        found, axis, _, low, end = find_outside(meshes.weld(Mesh(places, upright.triangles, {})))
        np.testing.assert_allclose(axis, turn[:, 2], atol=5e-3)
        np.testing.assert_allclose(end - low, 0.99 * length, rtol=5e-3)
        assert topology.count_handles(found.triangles) == (kind == "jug")


@pytest.mark.quick
def test_a_flask_gets_a_parison_wider_than_its_neck_and_the_air_for_it(tmp_path: Path) -> None:
    assert _new(tmp_path, squat("flask")) == 0
    scene = jaxform.load(tmp_path / "new" / "scene.toml")  # warnings are errors here
    # Blown to the bottle's width of 140 mm from the flattened parison: 3.2 times, 4.6 times from one within the neck.
    wide = float(np.ptp(np.asarray(scene.parison.positions)[:, 1]))
    assert 3.0 < 0.140 / (0.5 * np.pi * wide) < 3.5 and wide > 1.1 * 0.024
    assert float(np.max(np.asarray(scene.pressure.value))) > 5e6


@pytest.mark.quick
def test_halves_that_differ_and_boxes_are_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    bent = _square()
    x, y, z = bent.positions.T
    bent = Mesh(
        np.stack([x + 0.2 * np.maximum(y, 0.0) * (z < 150), y + 8e-4 * np.minimum(z - 150, 0) ** 2, z], 1),
        bent.triangles,
        {},
    )
    assert _new(tmp_path, bent) == 2
    assert "no plane of symmetry" in capsys.readouterr().err
    box = molds.box_insert()
    assert _new(tmp_path, Mesh(1e3 * box.vertices, box.triangles, {})) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1 and "--mold" in error
    assert not (tmp_path / "new").exists()


def test_a_handle_that_no_parison_within_the_bottle_reaches_is_a_warning(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    mesh = with_handle(**FAR)
    # The side without a handle, to which a parison may reach, is no wider than the neck.
    x, y, z = mesh.positions.T
    places = np.stack([np.maximum(x, -12.0 - 0.01 * np.abs(x)), y, z], axis=1)
    assert _new(tmp_path, Mesh(places, mesh.triangles, {})) == 0
    assert "the handle may stay empty" in capsys.readouterr().err


def _face(corners: Any, polygon: Any) -> list[Any]:
    """Triangles (3, 3) of a polygon in a plane, of which `corners` gives the places."""
    pieces = shapely.get_parts(shapely.constrained_delaunay_triangles(polygon))
    return [corners(np.array(piece.exterior.coords)[:3]) for piece in pieces]


def _outwards(corners: Any, middle: Any) -> Any:
    """Triangles (n, 3, 3) whose normals point away from a place (3,)."""
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    inwards = np.einsum("ij,ij->i", normal, corners.mean(1) - middle) < 0
    return np.where(inwards[:, None, None], corners[:, ::-1], corners)


def _block(bottle: Mesh, wall: float = 15.0) -> Mesh:
    """A solid block, x >= 0, with the half of a bottle as its cavity, which is open at the neck."""
    half = find_bottle(bottle).mesh
    shape, _ = parting.add_land(molds.MoldShape(half.positions, half.triangles), wall)
    far, top = half.positions[:, 0].max() + wall, half.positions[:, 2].max()
    neck = shapely.MultiPoint(half.positions[np.isclose(half.positions[:, 2], top), :2]).convex_hull
    low, high = shape.vertices.min(0), shape.vertices.max(0)
    side = shapely.box(0.0, low[1], far, high[1])
    faces = _face(lambda at: np.column_stack([at, np.full(3, top)]), side.difference(neck))
    faces += _face(lambda at: np.column_stack([at, np.full(3, low[2])]), side)
    faces += _face(lambda at: np.column_stack([np.full(3, far), at]), shapely.box(low[1], low[2], high[1], top))
    for level in (low[1], high[1]):
        wide = shapely.box(0.0, low[2], far, top)
        faces += _face(lambda at, level=level: np.insert(at, 1, level, axis=1), wide)
    outer = np.concatenate([np.array(faces), shape.vertices[shape.triangles[len(half.triangles) :]]])
    outer = _outwards(outer, 0.5 * np.array([far, low[1] + high[1], low[2] + top]))
    # The cavity's normals point into it, away from the material.
    corners = np.concatenate([outer, half.positions[half.triangles][:, ::-1]]).reshape(-1, 3)
    return meshes.weld(Mesh(corners, np.arange(len(corners), dtype=np.int32).reshape(-1, 3), {}), 1e-6)


@pytest.mark.parametrize("halves", ["one", "closed", "open", "turned"])
def test_of_the_blocks_of_a_mold_the_cavity_is_the_bottle(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], halves: str
) -> None:
    """As a tool maker's file has it: the half is that of the bottle itself. Turned, closed blocks end in a corner."""
    block = _block(_square())
    turn = molds.rotation(np.array([25.0 if halves == "turned" else 0.0, 0.0, 0.0]))
    apart = 30.0 if halves == "open" else 0.0
    parts = [block, Mesh(block.positions * [-1.0, 1.0, 1.0] - [apart, 0.0, 0.0], block.triangles[:, ::-1], {})]
    for number, part in enumerate(parts):
        meshes.write_stl(tmp_path / f"half{number}.stl", part.positions @ turn.T, part.triangles)
    files = [str(tmp_path / f"half{number}.stl") for number in range(1 if halves == "one" else 2)]
    folder = tmp_path / "bottle"
    assert main(["new", str(folder), "--process", "extrusion-blow", "--mold", *files]) == 0
    assert "taken as blocks of a mold, of which the cavity is the bottle" in capsys.readouterr().out
    made, half = meshes.read_mesh(folder / "half.stl"), find_bottle(_square())
    np.testing.assert_allclose(np.ptp(made.positions, axis=0), 1e-3 * np.ptp(half.mesh.positions, axis=0), rtol=0.02)
    assert _area(made) == pytest.approx(1e-6 * half.area, rel=0.02)


def _tray(pockets: Sequence[tuple[float, float]]) -> Mesh:
    """A solid block with pockets 25 mm deep between these places along x [mm]."""
    x, y = np.meshgrid(np.arange(0.0, 205.0, 5.0), np.arange(0.0, 85.0, 5.0), indexing="ij")
    deep = np.any([(x > low) & (x < high) for low, high in pockets], axis=0) & (y > 15.0) & (y < 65.0)
    flat = np.stack([x.ravel(), y.ravel()], axis=1)
    upper = np.column_stack([flat, np.where(deep, -25.0, 0.0).ravel()])
    triangles = grids.union_jack(40, 16)
    one, other = topology.boundary_edges(triangles).T
    below = len(upper)
    sides = np.concatenate([np.stack([one, one + below, other], 1), np.stack([other, one + below, other + below], 1)])
    places = np.concatenate([upper, np.column_stack([flat, np.full(below, -60.0)])])
    around = _outwards(places[np.concatenate([triangles + below, sides])], np.array([100.0, 40.0, -30.0]))
    corners = np.concatenate([upper[triangles], around]).reshape(-1, 3)
    return meshes.weld(Mesh(corners, np.arange(len(corners), dtype=np.int32).reshape(-1, 3), {}), 1e-6)


@pytest.mark.quick
def test_pockets_of_a_tray_and_bottles_themselves_are_no_cavities() -> None:
    whole = _square()
    bottles = [whole, clip(whole, np.array([1.0, 0.0, 0.0]), 0.0, keep_below=False), meshes.weld(_bottle("hollow"))]
    assert [len(block_cavities([mesh])) for mesh in bottles] == [0, 0, 0]
    (pocket,) = block_cavities([_tray([(45.0, 155.0)])])
    np.testing.assert_allclose(np.ptp(pocket.positions, axis=0), [110.0, 50.0, 25.0])
    assert not block_cavities([_tray([(15.0, 85.0), (115.0, 185.0)])])

"""Triangle meshes in and out: every format, every kind of bad file, welding, cleaning, topology."""

import contextlib
import struct
from pathlib import Path
from xml.etree import ElementTree

import meshio
import numpy as np
import pytest

from jaxform import shapes
from jaxform.core.errors import InputError
from jaxform.mesh import meshes, topology
from jaxform.mesh.meshes import Mesh, drop_degenerate, drop_fins, read_mesh, weld, write_pvd, write_vtu

pytestmark = pytest.mark.quick

FORMATS = [
    *("stl-ascii", "stl-binary", "obj", "off", "vtk-ascii", "vtk-binary"),
    *("ply-ascii", "ply-binary", "vtu", "msh22-ascii", "msh41-binary"),
]
BALL = shapes.sphere(radius=0.05, elements=128)
SQUARE = Mesh(np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], float), np.array([[0, 1, 2], [0, 2, 3]], np.int32))


def write(folder: Path, kind: str, cells=None, positions=BALL.positions, **data) -> Path:
    """Writes the ball with meshio, which tells its opinions on standard output and error."""
    name, _, flavour = kind.partition("-")
    path = folder / f"{kind}.{name[:3]}"
    options: dict = {"binary": flavour == "binary"} if flavour in ("ascii", "binary") else {}
    file_format = {"msh22": "gmsh22", "msh41": "gmsh"}.get(name, name)
    if name[:3] == "msh":
        options["file_format"] = file_format
    mesh = meshio.Mesh(positions, cells or [("triangle", BALL.triangles.astype(np.int64))], point_data=data)
    with contextlib.redirect_stdout(None), contextlib.redirect_stderr(None):
        mesh.write(path, **options)
    return path


def areas(mesh) -> np.ndarray:
    corner = mesh.positions[mesh.triangles]
    return np.linalg.norm(np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]), axis=1) / 2


def volume(mesh) -> float:
    corner = mesh.positions[mesh.triangles]
    return float(np.einsum("ij,ij->", corner[:, 0], np.cross(corner[:, 1], corner[:, 2])) / 6)


def assert_refused(path: Path, capfd) -> InputError:
    with pytest.raises(InputError) as caught:
        read_mesh(path)
    printed = capfd.readouterr()
    assert (printed.out, printed.err) == ("", "")
    assert caught.value.value == str(path)
    assert "\n" not in str(caught.value)
    return caught.value


@pytest.mark.parametrize("kind", FORMATS)
def test_round_trip(tmp_path, capfd, kind):
    mesh = weld(read_mesh(write(tmp_path, kind), scale=2.0))
    assert capfd.readouterr() == ("", "")
    assert mesh.positions.dtype == np.float64 and mesh.triangles.dtype == np.int32
    assert len(mesh.positions) == len(BALL.positions) and len(mesh.triangles) == len(BALL.triangles)
    # Triangle by triangle, whatever the numbering of the nodes: STL holds float32, the others double.
    tolerance = 1e-7 if "stl" in kind else 1e-12
    got, expected = mesh.positions[mesh.triangles], 2 * BALL.positions[BALL.triangles]
    np.testing.assert_allclose(got, expected, rtol=0, atol=0.1 * tolerance)
    assert volume(mesh) == pytest.approx(8 * volume(BALL), rel=10 * tolerance)
    assert topology.is_closed(mesh.triangles) and len(topology.inconsistent_edges(mesh.triangles)) == 0


@pytest.mark.parametrize("kind", ["ply-ascii", "ply-binary", "vtk-ascii", "vtk-binary", "vtu", "msh41-binary"])
def test_scalars_become_fields_and_vectors_do_not(tmp_path, kind):
    heat = BALL.positions[:, 2] * 1000 + 140
    vectors = {} if kind[:3] == "ply" else {"velocity": BALL.positions.copy()}
    mesh = read_mesh(write(tmp_path, kind, heat=heat, **vectors))
    assert set(mesh.fields) == {"heat"}
    np.testing.assert_allclose(mesh.fields["heat"], mesh.positions[:, 2] * 1000 + 140, rtol=1e-12)


def test_quads_are_split_and_lines_and_solids_ignored(tmp_path):
    cells = [("line", [[0, 1]]), ("quad", [[0, 1, 2, 3]]), ("tetra", [[0, 1, 2, 4]])]
    positions = np.array([*SQUARE.positions, [0, 0, 1]])
    mesh = read_mesh(write(tmp_path, "vtu", cells, positions))
    assert mesh.triangles.tolist() == [[0, 1, 2], [0, 2, 3]]
    assert areas(mesh).sum() == pytest.approx(1.0)


def test_curved_faces_are_refused_not_dropped(tmp_path, capfd):
    positions = np.array([[0, 0, 0], [2, 0, 0], [0, 2, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], float)
    cells = [("triangle", [[0, 1, 2]]), ("triangle6", [[0, 1, 2, 3, 4, 5]])]
    assert "curved" in assert_refused(write(tmp_path, "vtu", cells, positions), capfd).problem


def test_obj_of_a_modelling_program(tmp_path):
    # More normals than nodes, texture coordinates, groups, a pentagon: meshio alone refuses it.
    path = tmp_path / "house.obj"
    nodes = "v 0 0 0\nv 1 0 0\nv 1 1 0 \nv 0.5 1.5 0\nv 0 1 0\n"
    path.write_text("o house\n" + nodes + "vn 0 0 1\n" * 9 + "vt 0 0\ng wall\ns off\nf 1/1/1 2/1/2 3/1/3 4//4 5//5\n")
    assert areas(read_mesh(path)).sum() == pytest.approx(1.25)


def test_ply_with_the_other_name_of_the_face_list(tmp_path):
    path = write(tmp_path, "ply-binary")
    path.write_bytes(path.read_bytes().replace(b"vertex_indices", b"vertex_index"))
    assert len(read_mesh(path).triangles) == len(BALL.triangles)


def test_upper_case_suffix(tmp_path):
    path = write(tmp_path, "stl-binary")
    assert len(read_mesh(path.rename(tmp_path / "BALL.STL")).triangles) == len(BALL.triangles)


@pytest.mark.parametrize("suffix", meshes.FORMATS)
@pytest.mark.parametrize("content", ["random", "empty", "text", "zeros", "long text"])
def test_garbage_is_an_input_error_and_prints_nothing(tmp_path, capfd, suffix, content):
    path = tmp_path / f"garbage{suffix}"
    path.write_bytes(
        {
            "random": np.random.default_rng(3).bytes(5000),
            "empty": b"",
            "text": b"solid advice: this is no mesh\n",
            "zeros": bytes(84),
            "long text": b"v 1 2 3 is a line of a letter,\nf is for facet normal.\n" * 50,
        }[content]
    )
    error = assert_refused(path, capfd)
    assert ("is empty" in error.problem) == (content == "empty")


HEADERS = {
    ".stl": b"solid x\n",
    ".ply": b"ply\nformat binary_little_endian 1.0\nelement vertex 9\nproperty float x\nproperty float y\n"
    b"property float z\nelement face 7\nproperty list uchar int vertex_indices\nend_header\n",
    ".vtu": b'<?xml version="1.0"?><VTKFile type="UnstructuredGrid" version="0.1"><UnstructuredGrid>',
    ".msh": b"$MeshFormat\n4.1 1 8\n\x01\x00\x00\x00\n$EndMeshFormat\n$Nodes\n",
    ".obj": b"v 0 0 0\nv 1 0 0\n",
    ".off": b"OFF\n9 7 0\n0 0 0\n",
    ".vtk": b"# vtk DataFile Version 4.2\nx\nBINARY\nDATASET POLYDATA\nPOINTS 9 float\n",
}


@pytest.mark.parametrize("suffix", meshes.FORMATS)
@pytest.mark.parametrize("seed", range(3))
def test_garbage_behind_a_good_beginning(tmp_path, capfd, suffix, seed):
    path = tmp_path / f"garbage{suffix}"
    path.write_bytes(HEADERS[suffix] + np.random.default_rng(seed).bytes(1000))
    assert assert_refused(path, capfd).remedy


@pytest.mark.parametrize("kind", [kind for kind in FORMATS if kind != "obj"])
@pytest.mark.parametrize("kept", [0.05, 0.3, 0.6, 0.9, 0.97])
def test_truncated(tmp_path, capfd, kind, kept):
    path = write(tmp_path, kind)
    content = path.read_bytes()
    path.write_bytes(content[: int(kept * len(content))])
    assert assert_refused(path, capfd).remedy


@pytest.mark.filterwarnings("ignore::jaxform.core.errors.InputWarning")
@pytest.mark.parametrize("kind", FORMATS)
def test_damaged_files_give_a_mesh_or_an_input_error(tmp_path, capfd, kind):
    rng = np.random.default_rng(11)
    path = write(tmp_path, kind)
    content = np.frombuffer(path.read_bytes(), np.uint8)
    outcome = {"mesh": 0, "refused": 0}
    for _ in range(40):
        damaged = content.copy()
        # Half of the damage in the header, where it does most.
        reach = rng.choice([min(400, len(content)), len(content)])
        damaged[rng.integers(0, reach, 3)] = rng.integers(0, 256, 3)
        path.write_bytes(damaged.tobytes())
        try:
            mesh = read_mesh(path)
        except InputError as error:
            assert error.value == str(path)
            outcome["refused"] += 1
        else:
            assert np.isfinite(mesh.positions).all() and len(mesh.triangles) > 0
            assert 0 <= mesh.triangles.min() and mesh.triangles.max() < len(mesh.positions)
            outcome["mesh"] += 1
    assert capfd.readouterr() == ("", "")
    assert outcome["refused"] > 0, outcome


def test_obj_cut_before_its_faces(tmp_path, capfd):
    path = write(tmp_path, "obj")
    content = path.read_bytes()
    path.write_bytes(content[: content.index(b"\nf ")])
    assert assert_refused(path, capfd).problem == "has no triangles"


def test_ascii_stl_cut_between_facets(tmp_path, capfd):
    path = write(tmp_path, "stl-ascii")
    text = path.read_text()
    path.write_text(text[: text.rindex("endfacet") + 9])
    assert "is incomplete" in assert_refused(path, capfd).problem


def test_not_a_file(tmp_path, capfd):
    (tmp_path / "folder.stl").mkdir()
    (tmp_path / "mesh.step").write_text("ISO-10303-21;")
    assert assert_refused(tmp_path / "absent.stl", capfd).problem == "does not exist"
    assert "folder" in assert_refused(tmp_path / "folder.stl", capfd).problem
    assert ".vtu" in assert_refused(tmp_path / "mesh.step", capfd).remedy


@pytest.mark.parametrize("number", ["nan", "inf", "1e400"])
def test_coordinates_that_are_not_finite(tmp_path, capfd, number):
    path = tmp_path / "bad.obj"
    path.write_text(f"v 0 0 0\nv 1 0 0\nv 0 {number} 0\nf 1 2 3\n")
    assert "not finite (node 2)" in assert_refused(path, capfd).problem


@pytest.mark.parametrize("corner", ["0", "4", "-4", "99999999999"])
def test_nodes_that_do_not_exist(tmp_path, capfd, corner):
    path = tmp_path / "bad.obj"
    path.write_text(f"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 {corner}\n")
    assert "do not exist" in assert_refused(path, capfd).problem


def test_only_points_or_lines(tmp_path, capfd):
    assert assert_refused(write(tmp_path, "vtu", [("line", [[0, 1]])]), capfd).problem == "has no triangles"


@pytest.mark.parametrize("scale", [0, -1.0, float("nan"), float("inf")])
def test_scale(tmp_path, scale):
    with pytest.raises(InputError, match="scale"):
        read_mesh(write(tmp_path, "obj"), scale=scale)


def test_weld_merges_pairs_across_any_rounding_boundary():
    rng = np.random.default_rng(0)
    soup = BALL.positions[BALL.triangles].reshape(-1, 3)
    soup = soup + rng.uniform(-1, 1, soup.shape) * 1e-11
    soup_mesh = Mesh(soup, np.arange(len(soup), dtype=np.int32).reshape(-1, 3), {"z": soup[:, 2].copy()})
    assert len(weld(soup_mesh, tolerance=0.0).positions) == len(soup)
    mesh = weld(soup_mesh)
    assert len(mesh.positions) == len(BALL.positions) and topology.is_closed(mesh.triangles)
    np.testing.assert_array_equal(mesh.fields["z"], mesh.positions[:, 2])
    np.testing.assert_allclose(mesh.positions[mesh.triangles], BALL.positions[BALL.triangles], atol=3e-11)


def test_weld_leaves_a_clean_mesh_alone_and_drops_unused_nodes():
    clean = weld(Mesh(BALL.positions, BALL.triangles))
    np.testing.assert_array_equal(clean.positions, BALL.positions)
    np.testing.assert_array_equal(clean.triangles, BALL.triangles)
    extra = np.concatenate([[[9.0, 9, 9]], SQUARE.positions])
    mesh = weld(Mesh(extra, SQUARE.triangles + np.int32(1), {"i": np.arange(5.0)}))
    np.testing.assert_array_equal(mesh.positions, SQUARE.positions)
    assert mesh.fields["i"].tolist() == [1, 2, 3, 4]


def test_weld_tolerance_is_relative_to_the_size():
    for unit in (1e-9, 1.0, 1e6):
        near = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 0, 1e-10], [1, 1, 1e-10], [0, 1, 0]]) * unit
        mesh = weld(Mesh(near, np.array([[0, 1, 2], [3, 4, 5]], np.int32)))
        assert len(mesh.positions) == 4
        np.testing.assert_array_equal(mesh.triangles, SQUARE.triangles)


@pytest.mark.parametrize("unit", [1e-200, 1e-3, 1.0, 1e200])
def test_drop_degenerate(unit):
    positions = unit * np.array([*SQUARE.positions, [0.5, 0, 0], [0.5, 1e-8, 0], [5, 5, 5]])
    triangles = [[0, 1, 2], [0, 2, 3], [2, 0, 1], [0, 2, 1], [3, 3, 1], [0, 4, 1], [0, 1, 5], [6, 6, 6]]
    mesh, count = drop_degenerate(Mesh(positions, np.array(triangles, np.int32)))
    assert count == 6
    np.testing.assert_array_equal(mesh.triangles, SQUARE.triangles)
    np.testing.assert_array_equal(mesh.positions, unit * SQUARE.positions)


def test_fins_are_dropped_from_both_sides_and_plates_given_from_both_sides_stay():
    a, b, _ = BALL.triangles[7]
    n = len(BALL.positions)
    # A fin on an edge, one that hangs on it, and a piece apart.
    fins = [[a, b, n], [b, a, n], [b, n + 1, n], [n, n + 1, b]]
    plate = [[n + 2, n + 3, n + 4], [n + 3, n + 2, n + 4]]
    positions = np.concatenate([BALL.positions, np.eye(5, 3) + 3.0])
    whole = drop_fins(Mesh(positions, np.array([*BALL.triangles, *fins, *plate], np.int32)))
    assert len(whole.triangles) == len(BALL.triangles) + 2
    np.testing.assert_array_equal(whole.triangles[:-2], BALL.triangles)
    copy = Mesh(positions, np.array([*BALL.triangles, BALL.triangles[7]], np.int32))
    np.testing.assert_array_equal(drop_fins(copy).triangles, copy.triangles)


def test_a_slender_triangle_stays():
    positions = np.array([[0, 0, 0], [1, 0, 0], [0.5, 1e-4, 0]])
    assert drop_degenerate(Mesh(positions, np.array([[0, 1, 2]], np.int32)))[1] == 0


def test_write_vtu_keeps_everything(tmp_path):
    path = tmp_path / "out.vtu"
    point_data = {"thickness": np.linspace(1, 2, len(BALL.positions)), "reference": 2 * BALL.positions}
    cell_data = {"level": np.arange(len(BALL.triangles), dtype=np.int32), "stuck": BALL.triangles[:, 0] > 5}
    write_vtu(path, BALL.positions, BALL.triangles, point_data, cell_data)
    back = meshio.read(path)
    np.testing.assert_array_equal(back.points, BALL.positions)
    np.testing.assert_array_equal(back.cells_dict["triangle"], BALL.triangles)
    for name, value in point_data.items():
        np.testing.assert_array_equal(back.point_data[name], value)
    for name, value in cell_data.items():
        np.testing.assert_array_equal(back.cell_data[name][0], value)


def test_write_pvd_lists_times_and_escaped_names(tmp_path):
    frames = [(0.0, "frames/0.vtu"), (0.1, 'a "b" & <c>.vtu')]
    write_pvd(tmp_path / "frames.pvd", frames)
    root = ElementTree.parse(tmp_path / "frames.pvd").getroot()
    assert root.attrib["type"] == "Collection"
    rows = [(float(row.attrib["timestep"]), row.attrib["file"]) for row in root.iter("DataSet")]
    assert rows == frames


def test_edges_of_a_square():
    edge, count = topology.edges(SQUARE.triangles)
    assert edge.tolist() == [[0, 1], [0, 2], [0, 3], [1, 2], [2, 3]]
    assert count.tolist() == [1, 2, 1, 1, 1]
    assert topology.boundary_nodes(SQUARE.triangles).tolist() == [0, 1, 2, 3]
    assert not topology.is_closed(SQUARE.triangles)
    assert not topology.is_closed(SQUARE.triangles[:0])


def test_open_rims_are_numbered_without_gaps():
    # Nodes 0 and 4 are in no triangle, so that the parts of the mesh have other numbers than its rims.
    edge, rim = topology.open_rims(np.array([[1, 2, 3], [5, 6, 7], [5, 7, 8]]), 9)
    assert edge.tolist() == [[1, 2], [1, 3], [2, 3], [5, 6], [5, 8], [6, 7], [7, 8]]
    assert rim.tolist() == [0, 0, 0, 1, 1, 1, 1]


def test_points_along_edges_have_both_ends_and_those_of_a_point_are_it():
    edges = np.array([[[0, 0, 0], [1, 0, 0]], [[2, 3, 4], [2, 3, 4]], [[0, 0, 0], [0, 0.3, 0]]], float)
    points = topology.edge_points(edges, 1.0)
    expected = [[0, 0, 0], [0.5, 0, 0], [1, 0, 0], [2, 3, 4], [2, 3, 4], [0, 0, 0], [0, 0.3, 0]]
    np.testing.assert_allclose(points, expected, atol=1e-15)


def test_boundary_of_a_disc_is_its_rim():
    disc = shapes.disc(radius=1.0, elements=96)
    np.testing.assert_array_equal(topology.boundary_nodes(disc.triangles), np.flatnonzero(disc.clamped))


def test_orientation_and_manifold():
    flipped = np.array([[0, 1, 2], [0, 3, 2]])
    assert topology.inconsistent_edges(SQUARE.triangles).tolist() == []
    assert topology.inconsistent_edges(flipped).tolist() == [[0, 2]]
    assert topology.nonmanifold_edges(flipped).tolist() == []
    three = np.array([[0, 1, 2], [1, 0, 3], [0, 1, 4]])
    assert topology.nonmanifold_edges(three).tolist() == [[0, 1]]
    assert topology.inconsistent_edges(three).tolist() == [[0, 1]]


def test_components():
    triangles = np.array([[0, 1, 2], [4, 5, 6], [2, 1, 3]])
    part = topology.components(triangles, 7)
    assert len(set(part[:4])) == 1 and len(set(part[4:])) == 1 and part[0] != part[4]


def test_binary_stl_that_begins_like_an_ascii_one(tmp_path):
    path = tmp_path / "odd.stl"
    facet = struct.pack("<12fH", 0, 0, 1, 0, 0, 0, 1, 0, 0, 0, 1, 0, 0)
    path.write_bytes(b"solid binary".ljust(80) + struct.pack("<I", 1) + facet)
    assert areas(read_mesh(path)).tolist() == [0.5]

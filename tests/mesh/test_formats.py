"""Mesh files of programs: each is read as what was written, or refused in words that say why."""

from __future__ import annotations

import os
import resource
import struct
import warnings
from pathlib import Path
from typing import Any

import meshio
import numpy as np
import pytest
import trimesh

from jaxform import molds
from jaxform.core import disk
from jaxform.core.errors import InputError, InputWarning
from jaxform.io import files, geometry, scene_rewriting
from jaxform.mesh import meshes
from jaxform.mesh.meshes import Mesh, read_mesh
from tests import scenes

pytestmark = pytest.mark.quick

CUP = molds.revolved(profile=[[0.0, 0.05], [0.06, 0.05], [0.1, 0.0]], segments=12)
POINTS, FACES = CUP.vertices, CUP.triangles
SOUP = POINTS[FACES]


def _read(folder: Path, name: str, content: str | bytes, **options: Any) -> Mesh:
    path = folder / name
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    return read_mesh(path, **options)


def _assert_refused(folder: Path, name: str, content: str | bytes) -> str:
    with pytest.raises(InputError) as caught:
        _read(folder, name, content)
    assert name in str(caught.value) and "\n" not in str(caught.value)
    return str(caught.value)


def _same(mesh: Mesh, rtol: float = 1e-7) -> None:
    """The cup, triangle by triangle."""
    np.testing.assert_allclose(mesh.positions[mesh.triangles], SOUP, rtol=0, atol=0.1 * rtol)


def _area(mesh: Mesh) -> np.ndarray:
    corners = mesh.positions[mesh.triangles]
    return np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]).sum(axis=0) / 2


def _ascii_stl(name: str = "cup", end: str = "endsolid cup\n") -> str:
    facets = []
    for corners in SOUP:
        vertices = "".join(f"      vertex {x:.9e} {y:.9e} {z:.9e}\n" for x, y, z in corners)
        facets.append(f"  facet normal 0 0 0\n    outer loop\n{vertices}    endloop\n  endfacet\n")
    return f"solid {name}\n" + "".join(facets) + end


def _binary_stl(header: bytes = b"cup", soup: np.ndarray = SOUP) -> bytes:
    facets = b"".join(struct.pack("<12fH", 0, 0, 0, *corners.ravel(), 0) for corners in soup)
    return header.ljust(80, b"\0") + struct.pack("<I", len(soup)) + facets


@pytest.mark.parametrize(
    "text",
    [
        _ascii_stl(),
        _ascii_stl().upper(),
        _ascii_stl(end="\nendsolid\n\n\n"),
        _ascii_stl(end="end solid cup"),
        "\n  " + _ascii_stl().replace("\n", "\n\n"),
        _ascii_stl().replace("\n", "\r\n").replace("  ", "\t"),
        "\ufeff" + _ascii_stl("vertex of a facet"),
        _ascii_stl("").replace("  ", ""),
        _ascii_stl().replace("\n", "\r"),
    ],
)
def test_ascii_stl_however_it_is_spaced_and_spelt(tmp_path: Path, text: str) -> None:
    _same(_read(tmp_path, "cup.stl", text))


def test_two_solids_in_one_ascii_stl(tmp_path: Path) -> None:
    mesh = _read(tmp_path, "cup.stl", _ascii_stl() + _ascii_stl("again"))
    np.testing.assert_allclose(mesh.positions[mesh.triangles], np.concatenate([SOUP, SOUP]), atol=1e-9)


@pytest.mark.parametrize("header", [b"cup", b"solid cup", b"solid facet normal 0 0 0\nouter loop"])
def test_binary_stl_whatever_its_header_says(tmp_path: Path, header: bytes) -> None:
    _same(_read(tmp_path, "cup.stl", _binary_stl(header)))


def test_bytes_after_the_last_triangle_of_an_stl_are_left_out_with_a_word(tmp_path: Path) -> None:
    with pytest.warns(InputWarning, match="has 7 bytes after the last of its 36 triangles"):
        mesh = _read(tmp_path, "cup.stl", _binary_stl() + b"\0trails")
    _same(mesh)


@pytest.mark.parametrize("count", [0, 2**32 - 1])
@pytest.mark.parametrize("header", [b"cup", b"solid cup"])
def test_a_binary_stl_of_which_the_count_was_not_filled_in_is_read(tmp_path: Path, count: int, header: bytes) -> None:
    content = _binary_stl(header)
    with pytest.warns(InputWarning, match="gives no number of triangles, and has 36"):
        mesh = _read(tmp_path, "cup.stl", content[:80] + struct.pack("<I", count) + content[84:])
    _same(mesh)
    _assert_refused(tmp_path, "cup.stl", content[:80] + struct.pack("<I", count) + content[84:-7])


@pytest.mark.parametrize("end", ["\n", "\r\n", "\r"])
@pytest.mark.parametrize("ending", [".obj", ".off"])
def test_comments_after_a_line_and_line_ends_of_any_system(tmp_path: Path, ending: str, end: str) -> None:
    points = ["{!r} {!r} {!r} # a place".format(*map(float, place)) for place in POINTS]
    if ending == ".obj":
        lines = [f"v {line}" for line in points] + [f"f {a + 1}//1 {b + 1} {c + 1} # a face" for a, b, c in FACES]
    else:
        lines = ["OFF", f"{len(POINTS)} {len(FACES)} 0", *points, *(f"3 {a} {b} {c} # a face" for a, b, c in FACES)]
    _same(_read(tmp_path, f"cup{ending}", end.join(["# a cup", *lines, ""])))


@pytest.mark.parametrize("header", [b"cup", b"solid cup", b"solid facet"])
def test_a_binary_stl_that_is_cut_says_how_much_is_there(tmp_path: Path, header: bytes) -> None:
    words = _assert_refused(tmp_path, "cup.stl", _binary_stl(header)[:-60])
    assert ("34 of 36 triangles" in words) or (header == b"solid facet" and "is incomplete" in words)


@pytest.mark.parametrize("name", ["cup.step", "cup.STP", "cup.igs", "cup.sldprt"])
def test_geometry_of_a_cad_program_is_refused_with_the_way_to_a_mesh(tmp_path: Path, name: str) -> None:
    words = _assert_refused(tmp_path, name, "ISO-10303-21;\nHEADER;\n")
    assert "no triangles" in words and "export the part as STL" in words


@pytest.mark.parametrize("name", ["cup.3mf", "cup.GLB", "cup.gltf"])
def test_files_of_printers_and_renderers_are_refused_with_the_way_to_a_mesh(tmp_path: Path, name: str) -> None:
    words = _assert_refused(tmp_path, name, "PK")
    assert "holds parts with placements" in words and "export the part as STL" in words


def test_an_ascii_stl_that_is_cut_is_refused(tmp_path: Path) -> None:
    text = _ascii_stl()
    for end in (text.rindex("endsolid"), text.rindex("endloop"), text.rindex("vertex") + 20, len(text) // 2):
        assert "is incomplete" in _assert_refused(tmp_path, "cup.stl", text[:end])


def _obj(face: str = "f {} {} {}\n", relative: bool = False) -> str:
    positions = [f"v {x:.9e} {y:.9e} {z:.9e}\n" for x, y, z in POINTS]
    shift = -len(POINTS) if relative else 1
    return "".join(positions) + "".join(face.format(*(corners + shift)) for corners in FACES)


@pytest.mark.parametrize(
    "text",
    [
        _obj(),
        _obj(relative=True),
        _obj().replace(" ", "\t"),
        _obj().replace("f ", "f\t").replace("v ", " v \t"),
        _obj("f {0}/{0}/{0} {1}/{1}/{1} {2}/{2}/{2}\n"),
        "mtllib x\nvn 0 0 1\n" + _obj("f {0}//1 {1}//1 {2}//1\n"),
        _obj("f {0}/{0} {1}/{1} \\\n {2}/{2}\n"),
        _obj().replace("\n", "\r\n"),
        _obj().replace("\nf", " 0.5 0.5 0.5\ng a\nusemtl b\ns 1\nf", 1),
    ],
)
def test_obj_however_it_is_spaced_and_numbered(tmp_path: Path, text: str) -> None:
    _same(_read(tmp_path, "cup.obj", text))


def test_relative_numbers_of_an_obj_count_from_what_was_read_so_far(tmp_path: Path) -> None:
    text = "".join("".join(f"v {x:.9e} {y:.9e} {z:.9e}\n" for x, y, z in corners) + "f -3 -2 -1\n" for corners in SOUP)
    _same(_read(tmp_path, "cup.obj", text))


def test_an_obj_that_is_cut_is_told_of(tmp_path: Path) -> None:
    text = _obj()
    with pytest.warns(InputWarning, match=r"has \d+ of 25 positions that no face uses"):
        _read(tmp_path, "cup.obj", text[: text.index("\nf ") + 40])
    with pytest.warns(InputWarning, match="ends within a line"):
        _read(tmp_path, "cup.obj", text[:-1])
    assert "has a face with 2 corners" in _assert_refused(tmp_path, "cup.obj", text[: text.rindex(" ")])
    assert "is incomplete" in _assert_refused(tmp_path, "cup.obj", text[: text.index("\nv ", 200) + 8])


def _quads() -> tuple[np.ndarray, np.ndarray]:
    x, y = np.meshgrid(np.arange(4.0), np.arange(3.0), indexing="ij")
    points = np.stack([x.ravel(), y.ravel(), 0.1 * x.ravel()], axis=1)
    corner = np.arange(12).reshape(4, 3)
    faces = np.stack([corner[:-1, :-1], corner[1:, :-1], corner[1:, 1:], corner[:-1, 1:]], axis=-1)
    return points, faces.reshape(-1, 4)


@pytest.mark.parametrize("ending", ["obj", "off", "ply", "vtk", "vtu", "msh"])
def test_quads_become_two_triangles_each(tmp_path: Path, ending: str) -> None:
    points, quads = _quads()
    path = tmp_path / f"sheet.{ending}"
    if ending == "off":
        rows = [f"4 {a} {b} {c} {d} 0.1 0.2 0.3\n" for a, b, c, d in quads]
        path.write_text("OFF 12 6 0\n" + "".join(f"{x} {y} {z}\n" for x, y, z in points) + "# faces\n" + "".join(rows))
    elif ending == "obj":
        rows = ["f " + " ".join(map(str, quad + 1)) + "\n" for quad in quads]
        path.write_text("".join(f"v {x} {y} {z}\n" for x, y, z in points) + "".join(rows))
    else:
        meshio.Mesh(points, [("quad", quads)]).write(path, file_format="gmsh" if ending == "msh" else None)
    mesh = read_mesh(path)
    expected = np.concatenate([quads[:, None, [0, 1, 2]], quads[:, None, [0, 2, 3]]], axis=1).reshape(-1, 3)
    np.testing.assert_array_equal(mesh.triangles, expected)
    np.testing.assert_allclose(mesh.positions, points, atol=1e-12)


OUTLINES = {
    "kite": [[0, 0], [1, 0], [0.2, 0.2], [0, 1]],
    "corner": [[0, 0], [2, 0], [2, 1], [1, 1], [1, 3], [0, 3]],
    "u": [[0, 0], [3, 0], [3, 3], [2, 3], [2, 1], [1, 1], [1, 3], [0, 3]],
    "spiral": [[0, 0], [5, 0], [5, 5], [1, 5], [1, 2], [3, 2], [3, 3], [2, 3], [2, 4], [4, 4], [4, 1], [0, 1]],
    "ring": [[0, 0], [3, 0], [3, 3], [0, 3], [0, 0], [1, 1], [1, 2], [2, 2], [2, 1], [1, 1]],
}


@pytest.mark.parametrize("name", OUTLINES)
@pytest.mark.parametrize("turned", [False, True])
def test_a_face_that_is_not_convex_is_covered_once(tmp_path: Path, name: str, turned: bool) -> None:
    outline = np.array(OUTLINES[name][:: -1 if turned else 1], float)
    x, y = outline.T
    area = 0.5 * np.sum(x * np.roll(y, -1) - y * np.roll(x, -1))
    for shift in range(len(outline)):
        rolled = np.roll(outline, shift, axis=0)
        points = np.stack([rolled[:, 0], 0.6 * rolled[:, 1], 0.8 * rolled[:, 1]], axis=1)
        triangles, owner = meshes.split(points, np.arange(len(points)), np.array([len(points)]))
        corners = points[triangles]
        normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]) @ [0, -0.8, 0.6] / 2
        assert len(triangles) == len(points) - 2 and not owner.any()
        np.testing.assert_allclose(normal.sum(), area, rtol=1e-9)
        assert np.all(normal * np.sign(area) > -1e-9)


POLYDATA = {
    "POLYGONS 2 9\n4 0 1 4 3 3 1 2 4\n": [[0, 1, 4], [0, 4, 3], [1, 2, 4]],
    "VERTICES 1 2\n1 0\nLINES 1 3\n2 0 1\nPOLYGONS 1 4\n3 1 2 4\n": [[1, 2, 4]],
    "TRIANGLE_STRIPS 1 5\n4 0 1 3 4\n": [[0, 1, 3], [3, 1, 4]],
}


@pytest.mark.parametrize("section", POLYDATA)
@pytest.mark.parametrize("binary", [False, True])
def test_legacy_vtk_of_a_surface(tmp_path: Path, section: str, binary: bool) -> None:
    points = np.array([[0, 0, 0], [1, 0, 0], [2, 0, 0], [0, 1, 0], [1, 1, 0.5]])
    cells = sum(int(line.split()[1]) for line in section.splitlines() if line[0].isalpha())
    first = b"# vtk DataFile Version 3.0\nsheet\n" + (b"BINARY" if binary else b"ASCII") + b"\nDATASET POLYDATA\n"

    def numbers(values: object, kind: str) -> bytes:
        array = np.asarray(values).ravel()
        return array.astype(kind).tobytes() + b"\n" if binary else (" ".join(map(str, array)) + "\n").encode()

    content = first + b"POINTS 5 float\n" + numbers(points, ">f4")
    for head, values in zip(section.splitlines()[::2], section.splitlines()[1::2], strict=True):
        content += head.encode() + b"\n"
        content += numbers(list(map(int, values.split())), ">i4")
    content += b"CELL_DATA %d\nSCALARS level int 1\nLOOKUP_TABLE default\n" % cells + numbers(range(cells), ">i4")
    content += b"POINT_DATA 5\nNORMALS n float\n" + numbers(np.ones(15), ">f4")
    content += b"FIELD FieldData 1\nheat 1 5 double\n" + numbers([10.0, 11, 12, 13, 14], ">f8")
    mesh = _read(tmp_path, "sheet.vtk", content)
    expected = POLYDATA[section]
    assert mesh.triangles.tolist() == expected
    np.testing.assert_array_equal(mesh.positions, points)
    assert mesh.fields["heat"].tolist() == [10, 11, 12, 13, 14]
    levels = {2: [0, 0, 1], 3: [2], 1: [0, 0]}[cells]
    assert mesh.cell_fields["level"].tolist() == levels


@pytest.mark.parametrize("version", ["vtk42", "vtk51"])
@pytest.mark.parametrize("binary", [False, True])
def test_legacy_vtk_of_an_unstructured_grid(tmp_path: Path, version: str, binary: bool) -> None:
    height = np.linspace(1.0, 2.0, len(POINTS))
    mesh = meshio.Mesh(POINTS, [("line", [[0, 1]]), ("triangle", FACES)], point_data={"h": height})
    mesh.cell_data = {"level": [np.array([7]), np.arange(len(FACES))]}
    mesh.write(tmp_path / "cup.vtk", file_format=version, binary=binary)
    back = read_mesh(tmp_path / "cup.vtk")
    _same(back, 1e-12)
    np.testing.assert_allclose(back.fields["h"], height, rtol=1e-12)
    np.testing.assert_array_equal(back.cell_fields["level"], np.arange(len(FACES)))


def test_what_trimesh_writes(tmp_path: Path) -> None:
    box = trimesh.creation.box((0.1, 0.2, 0.3))
    for name in ("box.stl", "box.obj", "box.off", "box.ply"):
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            box.export(tmp_path / name)
            mesh = read_mesh(tmp_path / name)
        np.testing.assert_allclose(mesh.positions[mesh.triangles], box.triangles, atol=1e-8)
    box.export(tmp_path / "ascii.stl", file_type="stl_ascii")
    mesh = read_mesh(tmp_path / "ascii.stl")
    np.testing.assert_allclose(mesh.positions[mesh.triangles], box.triangles, atol=1e-8)


@pytest.mark.parametrize("ending", ["vtk", "vtu", "msh"])
def test_solids_alone_are_no_surface(tmp_path: Path, ending: str) -> None:
    points = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], float)
    solid = meshio.Mesh(points, [("tetra", [[0, 1, 2, 3]])])
    solid.write(tmp_path / f"solid.{ending}", file_format="gmsh" if ending == "msh" else None)
    with pytest.raises(InputError, match="has solids but no surface; extract their surface"):
        read_mesh(tmp_path / f"solid.{ending}")


def test_a_vtk_image_is_no_surface(tmp_path: Path) -> None:
    text = "# vtk DataFile Version 3.0\nx\nASCII\nDATASET STRUCTURED_POINTS\nDIMENSIONS 9999 9999 9999\n"
    assert "structured_points" in _assert_refused(tmp_path, "image.vtk", text)


@pytest.mark.parametrize(("factor", "words"), [(1e-30, "1e-09"), (1e12, "1e+06")])
def test_a_mesh_of_no_possible_size_is_refused(tmp_path: Path, factor: float, words: str) -> None:
    line = _assert_refused(tmp_path, "cup.stl", _binary_stl(soup=SOUP * factor))
    assert "give a scale" in line and words in line


def test_a_node_that_no_triangle_uses_may_be_anywhere(tmp_path: Path) -> None:
    points = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [np.nan, 0, 0]])
    height = np.array([1.0, 2.0, 3.0, np.nan])
    meshes.write_vtu(tmp_path / "a.vtu", points, [[0, 1, 2]], {"h": height})
    assert geometry.nodal_field(tmp_path / "a.vtu", "h", points[:3]).tolist() == [1, 2, 3]
    meshes.write_vtu(tmp_path / "b.vtu", points, [[0, 1, 2]], {"h": np.array([1.0, np.nan, 3.0, 1.0])})
    with pytest.raises(InputError, match="not finite"):
        geometry.nodal_field(tmp_path / "b.vtu", "h", points[:3])


@pytest.mark.parametrize("welded", [True, False])
def test_data_of_triangles_go_to_the_nodes_by_area(tmp_path: Path, welded: bool) -> None:
    points = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 3, 0]], float)
    triangles = np.array([[0, 1, 2], [0, 2, 3]])  # 0.5 and 1.5
    soup = points[triangles].reshape(-1, 3)
    shown = (points, triangles) if welded else (soup, np.arange(6).reshape(2, 3))
    meshes.write_vtu(tmp_path / "a.vtu", *shown, cell_data={"thickness": np.array([1e-3, 2e-3])})
    wall = geometry.nodal_field(tmp_path / "a.vtu", "thickness", points)
    np.testing.assert_allclose(wall, [1.75e-3, 1e-3, 1.75e-3, 2e-3], rtol=1e-12)


def test_cell_data_as_the_thickness_of_a_parison(tmp_path: Path) -> None:
    points = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [0.5, 0.5, 0]]) * 0.07
    triangles = np.array([[0, 1, 4], [1, 2, 4], [2, 3, 4], [3, 0, 4]])
    meshes.write_vtu(tmp_path / "p.vtu", points, triangles, cell_data={"wall": np.arange(1.0, 5.0) * 1e-3})
    begin, end = scenes.FILE.index('shape = "disc"'), scenes.FILE.index("[material]")
    parison = 'shape = "file"\npath = "p.vtu"\nthickness = "field:wall"\n'
    (tmp_path / "scene.toml").write_text(scenes.FILE.replace(scenes.FILE[begin:end], parison))
    scene = files.load(tmp_path / "scene.toml")
    np.testing.assert_allclose(scene.parison.thickness, [2.5e-3, 1.5e-3, 2.5e-3, 3.5e-3, 2.5e-3], rtol=1e-12)


def _mold_scene(path: str) -> str:
    begin, end = scenes.FILE.index('shape = "revolved"'), scenes.FILE.index("[solver]")
    return scenes.FILE.replace(scenes.FILE[begin:end], f'shape = "file"\npath = {path}\n')


def test_several_mold_files_are_one_mold(tmp_path: Path) -> None:
    (tmp_path / "half").mkdir()
    half = len(FACES) // 2
    (tmp_path / "a.stl").write_bytes(_binary_stl(soup=SOUP[:half]))
    meshio.Mesh(POINTS, [("triangle", FACES[half:])]).write(tmp_path / "half" / "b.ply")
    (tmp_path / "whole.stl").write_bytes(_binary_stl())
    (tmp_path / "two.toml").write_text(_mold_scene('["a.stl", "half/b.ply"]'))
    (tmp_path / "one.toml").write_text(_mold_scene('"whole.stl"'))
    two, one = (files.load(tmp_path / name) for name in ("two.toml", "one.toml"))
    assert two.mold is not None and one.mold is not None
    np.testing.assert_allclose(
        np.asarray(two.mold.vertices)[two.mold.triangles], np.asarray(one.mold.vertices)[one.mold.triangles], atol=1e-8
    )
    written = scene_rewriting.write_scene(files.read_scene(tmp_path / "two.toml"), {}, tmp_path / "half")
    again = files.load(written)
    assert again.mold is not None
    np.testing.assert_array_equal(again.mold.vertices, two.mold.vertices)


@pytest.mark.parametrize(
    ("paths", "words"), [('["a.stl", "nowhere.stl"]', "nowhere.stl"), ("[]", "too short"), ("[1]", "path[0]")]
)
def test_a_list_of_mold_files_with_a_wrong_one(tmp_path: Path, paths: str, words: str) -> None:
    (tmp_path / "a.stl").write_bytes(_binary_stl())
    (tmp_path / "scene.toml").write_text(_mold_scene(paths))
    with pytest.raises(InputError) as caught:
        files.load(tmp_path / "scene.toml")
    assert words in str(caught.value) and "mold.path" in str(caught.value), caught.value


@pytest.mark.parametrize("name", ["zero.stl", "pipe.stl", "long" * 80 + ".stl", "null\0.stl", "huge.stl", "folder.stl"])
def test_what_is_no_regular_file_is_refused_at_once(tmp_path: Path, name: str) -> None:
    (tmp_path / "zero.stl").symlink_to("/dev/zero")
    os.mkfifo(tmp_path / "pipe.stl")
    (tmp_path / "folder.stl").mkdir()
    with (tmp_path / "huge.stl").open("wb") as file:
        file.truncate(disk.MOST_MESH + 1)
    used = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with pytest.raises(InputError):
        read_mesh(disk.expand_path("x", tmp_path).with_name(name) if "\0" not in name else f"{tmp_path}/{name}")
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - used < 100_000  # kB

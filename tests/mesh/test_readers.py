"""Mesh files as other programs write them: properties by name, parts, groups and fields that meshio takes wrongly."""

from __future__ import annotations

import itertools
import struct
import warnings
from pathlib import Path

import numpy as np
import pytest

from jaxform import molds
from jaxform.core.errors import InputError, InputWarning
from jaxform.mesh.meshes import Mesh, read_mesh

CUP = molds.revolved(profile=[[0.0, 0.05], [0.06, 0.05], [0.1, 0.0]], segments=12)
POINTS, FACES = np.asarray(CUP.vertices, float), np.asarray(CUP.triangles)
QUAD_POINTS = np.array([[0.0, 0, 0], [1, 0, 0], [2, 0, 0], [0, 1, 0], [1, 1, 0.5], [2, 1, 0]])
QUADS = np.array([[0, 1, 4, 3], [1, 2, 5, 4]])
SPLIT = [[0, 1, 4], [0, 4, 3], [1, 2, 5], [1, 5, 4]]


def _read(folder: Path, name: str, content: str | bytes) -> Mesh:
    path = folder / name
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        return read_mesh(path, further=True)


def _assert_refused(folder: Path, name: str, content: str | bytes) -> str:
    with pytest.raises(InputError) as caught:
        _read(folder, name, content)
    words = str(caught.value)
    assert name in words and "\n" not in words and "is incomplete" not in words
    return words


def _same(mesh: Mesh, atol: float = 1e-7) -> None:
    """The cup, triangle by triangle."""
    np.testing.assert_allclose(mesh.positions[mesh.triangles], POINTS[FACES], rtol=0, atol=atol)


def _rows(*columns: np.ndarray | list[object]) -> str:
    return "".join(" ".join(map(str, row)) + "\n" for row in zip(*columns, strict=True))


# --- PLY ------------------------------------------------------------------------------------------------------------

_VERTEX = {
    "plain": "xyz",
    "confidence before z": ["x", "y", "confidence", "z"],
    "normals first": ["nx", "ny", "nz", "x", "y", "z"],
    "z first": "zxy",
}
_FACE: dict[str, list[str]] = {
    "plain": ["list uchar int vertex_indices"],
    "other name and types": ["list uint8 uint32 vertex_index"],
    "texture coordinates behind": ["list uchar int vertex_indices", "list uchar float texcoord"],
    "material before": ["int material_index", "list uchar int vertex_indices"],
    "texture coordinates before": ["list uchar float texcoord", "list uchar int vertex_indices"],
}
_TYPES = {"uchar": "u1", "uint8": "u1", "int": "i4", "uint32": "u4", "float": "f4", "double": "f8", "ushort": "u2"}


def _ply(
    vertex: str = "plain", face: str = "plain", order: str = "ascii", faces: list[list[int]] | None = None
) -> bytes:
    """The cup, or with faces of one's own the quadrilaterals' points, with an element for edges between them."""
    points, rows_of = (POINTS, FACES.tolist()) if faces is None else (QUAD_POINTS, faces)
    named = dict(zip("xyz", points.T, strict=True))
    head = [f"format {order} 1.0", "comment made by hand", f"element vertex {len(points)}"]
    head += [f"property double {name}" for name in _VERTEX[vertex]]
    head += ["element edge 2", "property int vertex1", "property int vertex2", "property list ushort float way"]
    head += [f"element face {len(rows_of)}", *(f"property {line}" for line in _FACE[face]), "end_header"]
    rows: list[tuple[str, list[float]]] = [
        ("f8", [float(named.get(name, np.full(len(points), 0.7))[k]) for name in _VERTEX[vertex]])
        for k in range(len(points))
    ]
    parts = [part for _, row in rows for part in (("f8", row),)]
    for k in range(2):  # lists of one and of two numbers
        parts += [("i4", [k, k + 1]), ("u2", [k + 1]), ("f4", [0.5] * (k + 1))]
    for corners in rows_of:
        for line in _FACE[face]:
            words = line.split()
            if words[0] == "list":
                values = corners if words[3].startswith("vertex") else [0.25] * (2 * len(corners))
                parts += [(_TYPES[words[1]], [len(values)]), (_TYPES[words[2]], values)]
            else:
                parts.append((_TYPES[words[0]], [3]))
    text = ("ply\n" + "\n".join(head) + "\n").encode()
    if order == "ascii":
        return text + b"\n".join(" ".join(map(repr, values)).encode() for _, values in parts) + b"\n"
    mark = "<" if "little" in order else ">"
    return text + b"".join(np.array(values).astype(mark + kind).tobytes() for kind, values in parts)


_ORDERS = ("ascii", "binary_little_endian", "binary_big_endian")


@pytest.mark.parametrize("order", _ORDERS)
@pytest.mark.parametrize(
    ("vertex", "face"), [*((name, "plain") for name in _VERTEX), *(("plain", name) for name in _FACE)]
)
def test_a_ply_is_taken_by_names_whatever_else_it_has(tmp_path: Path, vertex: str, face: str, order: str) -> None:
    mesh = _read(tmp_path, "cup.ply", _ply(vertex, face, order))
    _same(mesh)
    assert ("confidence" in mesh.fields) == (vertex == "confidence before z")
    assert ("material_index" in mesh.cell_fields) == (face == "material before")


@pytest.mark.parametrize("order", _ORDERS)
@pytest.mark.parametrize("face", _FACE)
def test_a_ply_with_triangles_and_quadrilaterals(tmp_path: Path, face: str, order: str) -> None:
    mesh = _read(tmp_path, "mixed.ply", _ply("z first", face, order, [[0, 1, 4, 3], [1, 2, 4]]))
    np.testing.assert_array_equal(mesh.positions, QUAD_POINTS)
    assert mesh.triangles.tolist() == [[0, 1, 4], [0, 4, 3], [1, 2, 4]]


def test_a_ply_with_a_polygon_of_more_than_127_corners(tmp_path: Path) -> None:
    """The number of corners is a byte without a sign."""
    angle = np.linspace(0.0, 2.0 * np.pi, 201)[:-1]
    points = np.stack([np.cos(angle), np.sin(angle), 0.0 * angle], axis=1)
    head = "ply\nformat binary_little_endian 1.0\nelement vertex 200\n" + "".join(
        f"property double {x}\n" for x in "xyz"
    )
    head += "element face 1\nproperty list uchar int vertex_indices\nend_header\n"
    body = points.astype("<f8").tobytes() + bytes([200]) + np.arange(200).astype("<i4").tobytes()
    mesh = _read(tmp_path, "disc.ply", head.encode() + body)
    corners = mesh.positions[mesh.triangles]
    area = 0.5 * np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    np.testing.assert_allclose([len(area), area.sum()], [198, 100.0 * np.sin(np.pi / 100.0)], rtol=1e-12)


def test_a_ply_with_line_ends_of_windows_and_strips(tmp_path: Path) -> None:
    _same(_read(tmp_path, "cup.ply", _ply().replace(b"\n", b"\r\n")))
    head, _, body = _ply(order="binary_little_endian").partition(b"end_header\n")
    _same(_read(tmp_path, "cup.ply", head.replace(b"\n", b"\r\n") + b"end_header\r\n" + body))
    text = "ply\nformat ascii 1.0\nelement vertex 5\nproperty float x\nproperty float y\nproperty float z\n"
    text += "element tristrips 1\nproperty list int int vertex_indices\nend_header\n"
    text += _rows(*QUAD_POINTS[:5].T) + "8 0 1 3 4 -1 1 2 4\n"
    assert _read(tmp_path, "strips.ply", text).triangles.tolist() == [[0, 1, 3], [3, 1, 4], [1, 2, 4]]


@pytest.mark.parametrize("order", _ORDERS)
@pytest.mark.parametrize("faces", [None, [[0, 1, 4, 3], [1, 2, 4]]])
def test_a_ply_that_is_cut_says_how_much_is_there(tmp_path: Path, order: str, faces: list[list[int]] | None) -> None:
    content = _ply(order=order, faces=faces)
    end = content.rstrip(b"\n").rfind(b" ") if order == "ascii" else -2
    count = 36 if faces is None else 2
    assert f"{count - 1} of its {count} items `face`" in _assert_refused(tmp_path, "cup.ply", content[:end])
    body = content.index(b"end_header") + 30
    assert f"of its {25 if faces is None else 6} items `vertex`" in _assert_refused(tmp_path, "cup.ply", content[:body])
    assert "end_header" in _assert_refused(tmp_path, "cup.ply", content[:50])


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ((b"ply\n", b"plx\n"), "does not begin with `ply`"),
        ((b"property double z", b"property double w"), "no positions x, y, z"),
        ((b"property list uchar int", b"property list uchar itn"), "property list uchar itn"),
        ((b"format ascii 1.0", b"format binary 1.0"), "no format"),
        ((b"element face 36", b"element face many"), "element face many"),
        ((b"element face 36", b"element patch 36"), "has no triangles"),
    ],
)
def test_a_ply_that_is_none_says_why(tmp_path: Path, change: tuple[bytes, bytes], words: str) -> None:
    content = _ply()
    assert change[0] in content and words in _assert_refused(tmp_path, "cup.ply", content.replace(*change))


# --- OBJ ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("spare", [False, True])
def test_a_byte_order_mark_hides_no_position_of_an_obj(tmp_path: Path, spare: bool) -> None:
    text = "\ufeff" + "".join(f"v {x} {y} {z}\n" for x, y, z in POINTS) + spare * "v 0 0 0\n"
    text += "".join(f"f {a} {b} {c}\n" for a, b, c in FACES + 1)
    if not spare:
        _same(_read(tmp_path, "cup.obj", text))
        return
    (tmp_path / "cup.obj").write_text(text, encoding="utf-8")
    with pytest.warns(InputWarning, match="has 1 of 26 positions that no face uses"):
        _same(read_mesh(tmp_path / "cup.obj"))


# --- Abaqus and CalculiX --------------------------------------------------------------------------------------------


def _nodes(points: np.ndarray = POINTS, first: int = 1, space: str = " ") -> str:
    return "".join(f"{first + k},{space}{x!r}, {y!r}, {z!r}\n" for k, (x, y, z) in enumerate(points.tolist()))


def _elements(faces: np.ndarray = FACES, first: int = 1) -> str:
    return "".join(f"{k + 1}, {', '.join(str(n + first) for n in face)}\n" for k, face in enumerate(faces))


FORTRAN = "".join(f"{k}, " + ", ".join(f"{x:.17E}" for x in row) + "\n" for k, row in enumerate(POINTS.tolist(), 1))
FORTRAN = FORTRAN.replace("E", "D")
"""The nodes with exponents as Fortran writes those of double precision."""

PLAIN = f"*Heading\n a line, of text\n*Node\n{_nodes()}*Element, type=S3\n{_elements()}"


@pytest.mark.parametrize(
    "text",
    [
        PLAIN,
        PLAIN.lower(),
        PLAIN.upper(),
        PLAIN.replace("\n", "\r\n"),
        PLAIN.replace(_nodes(), FORTRAN),
        PLAIN.replace("type=S3", "type = M3D3, elset=wall"),
        PLAIN.replace("type=S3", "ELSET=a b,\nTYPE=SFM3D3"),
        PLAIN.replace("*Element", "** a comment among the nodes\n\n*Node, nset=more\n99, 0, 0\n*Element"),
        PLAIN.replace("*Node\n1,", "*Node\n** a comment\n1,", 1).replace("*Element, type", "*ELEMENT,TYPE"),
        PLAIN
        + "*Nset, nset=odd, generate\n1, 25, 2\n*Elset, elset=e\n1, 2\n*Shell Section, elset=e\n0.001, 5\n*Step\n",
        PLAIN
        + "*Element, type=MASS\n900, 1\n*Element, type=SPRINGA\n901, 1, 2\n*Element, type=C3D4\n902, 1, 2, 3, 4\n",
        f"*Part, name=W\n{PLAIN}*End Part\n*Assembly, name=A\n*Instance, name=W-1, part=w\n*End Instance\n"
        "*Node\n1, 0., 0., 0.\n*Nset, nset=RP, internal\n1,\n*End Assembly\n",
        f"*Assembly, name=A\n*Instance, name=W-1, part=W\n{PLAIN}*End Instance\n*End Assembly\n".replace(
            "*Instance, name=W-1, part=W", "*Instance, name=W-1"
        ),
    ],
)
def test_an_input_file_of_abaqus_however_it_is_written(tmp_path: Path, text: str) -> None:
    _same(_read(tmp_path, "cup.inp", text))


def _halves(assembly: str, shift: float = 0.0) -> str:
    """The cup's faces in two parts, each with all nodes and numbers of its own."""
    parts = ""
    for name, faces, first in (("A", FACES[:20], 1), ("B", FACES[20:], 7)):
        nodes = _nodes(POINTS - [0, 0, shift * (name == "B")], first)
        parts += f"*Part, name={name}\n*Node\n{nodes}*Element, type=S3\n{_elements(faces, first)}*End Part\n"
    return parts + assembly


def test_parts_of_abaqus_keep_their_numbers_and_places(tmp_path: Path) -> None:
    _same(_read(tmp_path, "two.inp", _halves("")))
    begin, end = "*Assembly, name=Assembly\n", "*End Assembly\n"
    one = "*Instance, name=A-1, part=A\n*End Instance\n"
    plain = "*Instance, name=B-1, part=B\n*End Instance\n"
    moved = "*Instance, name=B-1, part=B\n0., 0., 0.25\n*End Instance\n"
    _same(_read(tmp_path, "two.inp", _halves(begin + one + plain + end)))
    _same(_read(tmp_path, "two.inp", _halves(begin + one + moved + end, shift=0.25)))
    mesh = _read(tmp_path, "two.inp", _halves(begin + one + end))
    np.testing.assert_allclose(mesh.positions[mesh.triangles], POINTS[FACES[:20]], atol=1e-12)


def test_an_instance_is_shifted_and_then_turned_about_its_axis(tmp_path: Path) -> None:
    """By 90 degrees about an axis along +z through (1, 0): (x, y) goes to (1 - y, x - 1)."""
    place = "0.2, 0., 0.\n1., 0., 0., 1., 0., 1., 90.\n"
    text = f"*Part, name=W\n{PLAIN}*End Part\n*Assembly, name=A\n*Instance, name=W-1, part=W\n{place}*End Instance\n"
    mesh = _read(tmp_path, "cup.inp", text)
    x, y, z = (POINTS + np.array([0.2, 0, 0])).T
    np.testing.assert_allclose(mesh.positions, np.stack([1 - y, x - 1, z], axis=1), atol=1e-12)


@pytest.mark.parametrize("kind", ["S4", "S4R", "M3D4", "R3D4", "s4rs"])
def test_quadrilaterals_of_abaqus_are_two_triangles_each(tmp_path: Path, kind: str) -> None:
    text = f"*NODE\n{_nodes(QUAD_POINTS)}*ELEMENT, TYPE={kind}\n{_elements(QUADS)}"
    assert _read(tmp_path, "q.inp", text).triangles.tolist() == SPLIT


@pytest.mark.parametrize(("kind", "corners"), [("STRI65", 3), ("S6", 3), ("S8R", 4), ("S8R5", 4), ("M3D6", 3)])
def test_of_elements_with_nodes_on_their_sides_the_corners_are_taken(tmp_path: Path, kind: str, corners: int) -> None:
    path = tmp_path / "s.inp"
    row = [1, *range(1, corners + 1), *range(5, 5 + corners)]
    first, second = ", ".join(map(str, row[:5])), ", ".join(map(str, row[5:]))  # goes on in the next line
    points = np.concatenate([QUAD_POINTS[[0, 1, 4, 3]], QUAD_POINTS[:4] + 0.5])
    path.write_text(f"*NODE\n{_nodes(points)}*ELEMENT, TYPE={kind}\n{first},\n{second}\n")
    with pytest.warns(InputWarning, match="1 elements with mid-side nodes, of which only the corners are used"):
        mesh = read_mesh(path, further=True)
    assert mesh.triangles.tolist() == [[0, 1, 2], [0, 2, 3]][: corners - 2]


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (("*Element", "*Ngen\n1, 9, 1\n*Element"), "generates nodes (*NGEN)"),
        (("*Element", "*SYSTEM\n0, 0, 1, 1\n*Element"), "local coordinates (*SYSTEM)"),
        (("*Node\n", "*Node, system=C\n"), "local coordinates (*NODE, SYSTEM=C)"),
        (("*Node\n", "*Node, input=nodes.txt\n"), "other files (*NODE, INPUT=nodes.txt)"),
        (("*Element", "*Elgen\n1, 2\n*Element"), "generates elements (*ELGEN)"),
        (("*Node\n", "*Include, input=a.inp\n*Node\n"), "other files (*INCLUDE)"),
        (("*Node\n", "*Parameter\na = 1\n*Node\n"), "parameters (*PARAMETER)"),
        (("1, 1, 2", "1, 1, 77, 2"), "element 1 of type S3 with 4 nodes"),
        (("*Node\n1,", "*Node\n100,"), "element 1 of node 1, which does not exist"),
        (("type=S3", "type=C3D4"), "has solids but no surface"),
        (("type=S3", "type=B31"), "has no triangles"),
        (("*Node\n1,", "*Node\n<a>,"), "words instead of numbers (<a>"),
    ],
)
def test_an_input_file_that_is_more_than_a_mesh_is_refused_by_name(
    tmp_path: Path, change: tuple[str, str], words: str
) -> None:
    order = PLAIN.replace(f"1, {FACES[0][0] + 1}, {FACES[0][1] + 1}", "1, 1, 2") if change[0] == "1, 1, 2" else PLAIN
    assert change[0] in order and words in _assert_refused(tmp_path, "cup.inp", order.replace(*change, 1))


# --- Nastran and OptiStruct -----------------------------------------------------------------------------------------


def _short(number: float) -> str:
    """In eight characters, without the letter of the exponent."""
    text = f"{number:.6f}"[:8]
    return text if abs(number) >= 1e-3 or number == 0 else f"{number:.1e}".replace("e-0", "-").replace("e-", "-")


def _bulk(field: str, points: np.ndarray = POINTS, faces: np.ndarray = FACES) -> str:
    name = {3: "CTRIA3", 4: "CQUAD4"}[faces.shape[1]]
    lines = []
    for k, (x, y, z) in enumerate(points):
        if field == "small":
            lines.append(f"GRID    {k + 1:<8}        {_short(x):>8}{_short(y):>8}{_short(z):>8}")
        elif field == "large":
            lines.append(f"GRID*   {k + 1:<16}{0:<16}{x:16.8e}{y:16.8e}*G{k}\n*G{k:<6}{z:16.8e}")
        else:
            lines.append(f"grid,{k + 1},,{x!r},{y!r},{z!r}".replace("np.float64(", "").replace(")", ""))
    for k, face in enumerate(faces + 1):
        nodes = face.tolist()
        if field == "small":
            lines.append(f"{name:<8}{k + 1:<8}{1:<8}" + "".join(f"{node:<8}" for node in nodes) + "$ one")
        elif field == "large":
            first, second = "".join(f"{n:<16}" for n in [k + 1, 1, *nodes[:2]]), "".join(f"{n:<16}" for n in nodes[2:])
            lines.append(f"{name + '*':<8}{first}+E\n*E      {second}")
        else:
            lines.append(f"{name},{k + 1},1," + ",".join(map(str, nodes)))
    return "\n".join(lines) + "\n"


@pytest.mark.parametrize("field", ["small", "large", "free"])
@pytest.mark.parametrize("ending", [".bdf", ".nas", ".fem"])
def test_bulk_data_in_all_fields_with_and_without_its_begin(tmp_path: Path, field: str, ending: str) -> None:
    bulk = _bulk(field)
    head = "SOL 101\nCEND\nTITLE = GRID\nGRID = 7\nBEGIN BULK\n$ a comment\nMAT1    1       2.1+11          0.3\n"
    atol = 6e-6 if field == "small" else 1e-9
    for text in ("$ Created by Gmsh\n" + bulk, head + bulk + "ENDDATA\nGRID    1       9       0.      0.      0.\n"):
        mesh = _read(tmp_path, f"cup{ending}", text)
        _same(mesh, atol)
    mesh = _read(tmp_path, f"q{ending}", _bulk(field, QUAD_POINTS, QUADS))
    assert mesh.triangles.tolist() == SPLIT


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (("grid,1,,", "grid,1,2,"), "GRID, coordinate system 2"),
        (("grid,1,,", "GRDSET,,5\ngrid,1,,"), "GRDSET, coordinate system 5"),
        (("grid,1,,", "include 'a.bdf'\ngrid,1,,"), "other files (INCLUDE)"),
        (("grid,1,,", "grid,1,,x"), "grid point 1 with coordinates that are not numbers"),
        (("grid,1,,", "grid,100,,"), "elements of node 1, which does not exist"),
        (("grid,2,,", "=,*1,=\ngrid,2,,"), "repeats cards"),
        (("CTRIA3", "CTETRA"), "has solids but no surface"),
    ],
)
def test_bulk_data_that_is_more_than_a_mesh_is_refused_by_name(
    tmp_path: Path, change: tuple[str, str], words: str
) -> None:
    text = _bulk("free")
    assert change[0] in text
    assert words in _assert_refused(
        tmp_path, "cup.bdf", text.replace(*change) if change[0] == "CTRIA3" else text.replace(*change, 1)
    )


def test_shells_of_nastran_with_nodes_on_their_sides_give_their_corners(tmp_path: Path) -> None:
    points = np.concatenate([QUAD_POINTS, QUAD_POINTS + 0.25])
    text = _bulk("free", points, np.array([[0, 1, 4, 3]])).replace(
        "CQUAD4,1,1,1,2,5,4", "CQUAD8,1,1,1,2,5,4,7,8\n,9,10"
    )
    (tmp_path / "q.bdf").write_text(text)
    with pytest.warns(InputWarning, match="1 elements with mid-side nodes"):
        assert read_mesh(tmp_path / "q.bdf", further=True).triangles.tolist() == SPLIT[:2]


# --- Gmsh -----------------------------------------------------------------------------------------------------------

_GROUPS = '$PhysicalNames\n1\n2 7 "wall"\n$EndPhysicalNames\n'
_ENTITIES = "$Entities\n0 0 2 0\n1 0 0 0 1 1 1 1 7 0\n2 0 0 0 1 1 1 0 0\n$EndEntities\n"


def _msh(
    version: str, order: str, parametric: bool = False, faces: np.ndarray = FACES, points: np.ndarray = POINTS
) -> bytes:
    """Nodes with numbers from 11 on two surfaces, of which the first one is in a physical group; lines and solids."""
    new, binary = version.startswith("4"), order != ""
    long, half = ("u8" if new else "i4"), len(faces) // 2

    def numbers(kind: str, *values: object) -> bytes:
        flat = np.concatenate([np.ravel(np.asarray(value)) for value in values])
        if not binary:
            return (" ".join(repr(value) for value in flat.tolist()) + "\n").encode()
        return flat.astype(order + kind).tobytes()

    one = np.array([1], order + "i4").tobytes() + b"\n" if binary else b""
    content = f"$MeshFormat\n{version} {int(binary)} 8\n".encode() + one + b"$EndMeshFormat\n" + _GROUPS.encode()
    tags = np.arange(11, 11 + len(points))
    kind, blocks = {3: 2, 4: 3}[faces.shape[1]], (faces[:half] + 11, faces[half:] + 11)
    wide = np.concatenate([points, np.full((len(points), 2), 0.5)], axis=1) if parametric else points
    if new:
        content += b"" if binary else _ENTITIES.encode()
        size = [2, len(points)] if version == "4.0" else [2, len(points), 11, 10 + len(points)]
        content += b"$Nodes\n" + numbers(long, size)
        for entity, part in ((1, slice(0, 5)), (2, slice(5, None))):
            head = [entity, 2] if version == "4.0" else [2, entity]
            content += numbers("i4", head, [int(parametric)]) + numbers(long, [len(tags[part])])
            if version == "4.0":
                for tag, row in zip(tags[part], wide[part], strict=True):
                    item = f"{tag} {' '.join(map(repr, row.tolist()))}\n".encode()
                    content += numbers("i4", [tag]) + numbers("f8", row) if binary else item
            else:
                content += numbers(long, tags[part]) + numbers("f8", wide[part])
        content += b"\n$EndNodes\n$Elements\n" + numbers(long, [3, len(faces) + 1, 1, 99][: len(size)])
        content += (
            numbers("i4", [1, 1, 1]) + numbers(long, [1]) + numbers("i4" if version == "4.0" else long, [1, 11, 12])
        )
        for entity, block in zip((1, 2), blocks, strict=True):
            head = [entity, 2] if version == "4.0" else [2, entity]
            content += numbers("i4", head, [kind]) + numbers(long, [len(block)])
            rows = np.column_stack([np.arange(len(block)) + 2, block])
            content += numbers("i4" if version == "4.0" else long, rows)
        return content + b"\n$EndElements\n"
    name = b"ParametricNodes" if parametric else b"Nodes"
    content += b"$" + name + f"\n{len(points)}\n".encode()
    for tag, row in zip(tags, points, strict=True):
        tail = [[2, 1], [0.5, 0.5]] if parametric else []
        if binary:
            content += numbers("i4", [tag]) + numbers("f8", row)
            content += numbers("i4", tail[0]) + numbers("f8", tail[1]) if parametric else b""
        else:
            content += f"{tag} {' '.join(map(repr, row.tolist()))}{' 2 1 0.5 0.5' * parametric}\n".encode()
    content += b"\n$End" + name + f"\n$Elements\n{len(faces) + 1}\n".encode()
    if binary:
        content += numbers("i4", [1, 1, 2, 1, 0, 1, 11, 12])
        for entity, block in zip((1, 2), blocks, strict=True):
            rows = np.column_stack(
                [np.arange(len(block)) + 2, np.full(len(block), 7), np.full(len(block), entity), block]
            )
            content += numbers("i4", [kind, len(block), 2], rows)
    else:
        content += b"1 1 2 0 1 11 12\n"
        for k, face in enumerate(faces + 11):
            content += f"{k + 2} {kind} 2 7 1 {' '.join(map(str, face))}\n".encode()
    return content + b"\n$EndElements\n"


@pytest.mark.parametrize("version", ["2.2", "4.0", "4.1"])
@pytest.mark.parametrize("order", ["", "<", ">"])
@pytest.mark.parametrize("parametric", [False, True])
def test_meshes_of_gmsh_with_some_surfaces_in_groups(
    tmp_path: Path, version: str, order: str, parametric: bool
) -> None:
    _same(_read(tmp_path, "cup.msh", _msh(version, order, parametric)))
    mesh = _read(tmp_path, "q.msh", _msh(version, order, parametric, QUADS, QUAD_POINTS))
    assert mesh.triangles.tolist() == SPLIT
    np.testing.assert_array_equal(mesh.positions, QUAD_POINTS)


def test_a_mesh_of_gmsh_in_its_first_version(tmp_path: Path) -> None:
    text = f"$NOD\n{len(POINTS)}\n" + _rows(np.arange(1, 26), *POINTS.T) + "$ENDNOD\n$ELM\n36\n"
    text += "".join(f"{k + 1} 2 1 1 3 {a} {b} {c}\n" for k, (a, b, c) in enumerate(FACES + 1)) + "$ENDELM\n"
    _same(_read(tmp_path, "cup.msh", text))


@pytest.mark.parametrize("order", ["", "<"])
def test_data_at_nodes_of_gmsh_are_fields(tmp_path: Path, order: str) -> None:
    content = _msh("2.2", order) + b'$NodeData\n1\n"wall"\n1\n0.0\n3\n0\n1\n25\n'
    for k in range(25):
        pair = struct.pack("<id", k + 11, 0.5 * k) if order else f"{k + 11} {0.5 * k}\n".encode()
        content += pair
    mesh = _read(tmp_path, "cup.msh", content + b"\n$EndNodeData\n")
    np.testing.assert_array_equal(mesh.fields["wall"], 0.5 * np.arange(25))


def test_a_mesh_of_gmsh_that_is_cut_or_curved_or_of_another_version_says_so(tmp_path: Path) -> None:
    for version, order in itertools.product(("2.2", "4.1"), ("", "<")):
        content = _msh(version, order)
        assert "section $Elements has no end" in _assert_refused(tmp_path, "cup.msh", content[:-15])
        short = content[: content.index(b"$EndElements") - 60] + content[content.index(b"$EndElements") :]
        assert "truncated: a section has fewer numbers" in _assert_refused(tmp_path, "cup.msh", short)
    assert "version 3.0 of the MSH format" in _assert_refused(
        tmp_path, "cup.msh", _msh("2.2", "").replace(b"2.2 0 8", b"3.0 0 8")
    )
    curved = _msh("2.2", "").replace(b"1 1 2 0 1 11 12", b"1 9 2 0 1 11 12 13 14 15 16")
    assert "curved faces" in _assert_refused(tmp_path, "cup.msh", curved)
    solid = "$MeshFormat\n2.2 0 8\n$EndMeshFormat\n$Nodes\n4\n1 0 0 0\n2 1 0 0\n3 0 1 0\n4 0 0 1\n$EndNodes\n"
    assert "solids but no surface" in _assert_refused(
        tmp_path, "s.msh", solid + "$Elements\n1\n1 4 2 0 1 1 2 3 4\n$EndElements\n"
    )
    missing = _msh("2.2", "").replace(b"\n11 ", b"\n99 ", 1)
    assert "elements of node 11, which does not exist" in _assert_refused(tmp_path, "cup.msh", missing)
    assert "no section $MeshFormat" in _assert_refused(tmp_path, "cup.msh", "hello\n")

"""A reader of legacy VTK files (.vtk): surfaces (POLYDATA) and unstructured grids, ASCII and binary, versions 1 to 5.

meshio reads no POLYDATA, which is what surfaces are exported as.
"""

from __future__ import annotations

import re
from typing import Any

import numpy as np
from numpy.typing import NDArray

from jaxform.core.errors import InputError
from jaxform.mesh.facets import Faces, missing_surface_error

Index = NDArray[np.int64]
_TYPES = {
    "char": "i1",
    "unsigned_char": "u1",
    "short": "i2",
    "unsigned_short": "u2",
    "int": "i4",
    "unsigned_int": "u4",
    "vtkidtype": "i4",
    "long": "i8",
    "unsigned_long": "u8",
    "vtktypeint64": "i8",
    "float": "f4",
    "double": "f8",
}
VERTEX, LINE, TRIANGLE, STRIP, POLYGON, PIXEL, QUAD = 1, 3, 5, 6, 7, 8, 9
_STRAIGHT = (TRIANGLE, STRIP, POLYGON, PIXEL, QUAD)
_CURVED = (22, 23, 28, 34, 36, 69, 70)
_FIRST_SOLID = 10
_NUMBERED = (0, VERTEX, LINE, POLYGON, STRIP)  # the order in which cells of a surface are numbered
_OF_POLYDATA = {"VERTICES": VERTEX, "LINES": LINE, "POLYGONS": POLYGON, "TRIANGLE_STRIPS": STRIP}
_TUPLES = {"VECTORS": 3, "NORMALS": 3, "TENSORS": 9, "GLOBAL_IDS": 1, "PEDIGREE_IDS": 1}


class _VtkFile:
    """A file's content, a position in it that advances, and what was read so far.

    A block of cells is their type, the offsets of their corners, and the corners.
    """

    def __init__(self, content: bytes) -> None:
        self.content, self.place, self.binary, self.version = content, 0, False, 0.0
        self.points: NDArray[Any] | None = None
        self.blocks: list[tuple[int, Index, Index]] = []
        self.types: Index | None = None
        self.data: dict[str, dict[str, NDArray[Any]]] = {"POINT_DATA": {}, "CELL_DATA": {}}
        self.active, self.tuples = "", 0

    def raw_line(self) -> str:
        end = self.content.find(b"\n", self.place)
        end = len(self.content) if end < 0 else end
        line = self.content[self.place : end]
        self.place = min(end + 1, len(self.content))
        return line.decode("latin-1").strip()

    def words(self) -> list[str]:
        """The words of the next line that is not blank; none at the end."""
        while self.place < len(self.content):
            if words := self.raw_line().split():
                return words
        return []

    def numbers(self, count: int, kind: str) -> NDArray[Any]:
        if not 0 <= count <= len(self.content) - self.place:
            raise ValueError("truncated")
        return self._binary(count, kind) if self.binary else self._text(count, kind)

    def _binary(self, count: int, kind: str) -> NDArray[Any]:
        dtype = np.dtype(_TYPES[kind.lower()]).newbyteorder(">")
        values = np.frombuffer(self.content, dtype, count, self.place)
        self.place += values.nbytes
        return values.astype(dtype.newbyteorder("="))

    def _text(self, count: int, kind: str) -> NDArray[Any]:
        reach = 32 * count + 64
        while True:
            window = self.content[self.place : self.place + reach]
            words = window.split(None, count) if count else [window]
            whole = self.place + reach >= len(self.content)
            # One more than wanted shows that the last one is not cut by the window.
            if len(words) > count or whole:
                break
            reach *= 2
        if len(words) < count:
            raise ValueError("truncated")
        self.place += len(window) - (len(words[count]) if len(words) > count else 0)
        numeric = np.float64 if _TYPES[kind.lower()][0] == "f" else np.int64
        return np.array(words[:count]).astype(np.float64).astype(numeric) if count else np.zeros(0, numeric)


def read_vtk(content: bytes, name: str) -> Faces:
    """The faces of a legacy VTK file, with data at nodes and in faces; points, lines and solids are left out.

    Raises:
        InputError: It is another kind of data set, or has curved faces or solids alone.
    """
    read = _VtkFile(content)
    found = re.match(r"# vtk DataFile Version (\d+\.\d+)", read.raw_line(), re.IGNORECASE)
    if not found:
        raise ValueError("no header")
    read.version = float(found[1])
    read.raw_line()
    read.binary = {"ASCII": False, "BINARY": True}[read.raw_line().upper()]
    while words := read.words():
        _section(read, words)
    return _faces(read)


def _section(read: _VtkFile, words: list[str]) -> None:
    word = words[0].upper()
    if word == "DATASET":
        if words[1].upper() not in ("POLYDATA", "UNSTRUCTURED_GRID"):
            raise InputError(f"is not a surface but a {words[1].lower()}", "extract the surface and export it")
    elif word == "POINTS":
        read.points = read.numbers(3 * int(words[1]), words[2]).reshape(-1, 3)
    elif word in _OF_POLYDATA or word == "CELLS":
        _cells(read, int(words[1]), int(words[2]), _OF_POLYDATA.get(word, 0))
    elif word == "CELL_TYPES":
        read.types = read.numbers(int(words[1]), "int").astype(np.int64)
    elif word in read.data:
        read.active, read.tuples = word, int(words[1])
    elif word == "METADATA":
        while read.raw_line():
            pass
    elif word == "FIELD":
        for _ in range(int(words[2])):
            _field(read)
    else:
        _attribute(read, word, words)


def _cells(read: _VtkFile, first: int, second: int, kind: int) -> None:
    if read.version >= 5:
        starts = read.numbers(first, read.words()[1]).astype(np.int64)
        corners = read.numbers(second, read.words()[1]).astype(np.int64)
        if not len(starts):
            return
    else:
        starts, corners = _split_cell_list(read.numbers(second, "int").astype(np.int64), first)
    if starts[0] != 0 or starts[-1] != len(corners) or (np.diff(starts) < 0).any():
        raise ValueError("the corners of the cells do not match")
    read.blocks.append((kind, starts, corners))


def _split_cell_list(mixed: Index, count: int) -> tuple[Index, Index]:
    """Starts (count + 1,) and corners of cells given as number of corners, corners, number of corners, ..."""
    heads, place = np.zeros(count + 1, np.int64), 0
    for cell in range(count):
        heads[cell] = place
        place += 1 + max(int(mixed[place]), 0)
    heads[count] = place
    keep = np.ones(len(mixed), bool)
    keep[heads[:-1]] = False
    return heads - np.arange(count + 1), mixed[keep]


def _field(read: _VtkFile) -> None:
    words = read.words()
    if words[0].upper() == "METADATA":
        while read.raw_line():
            pass
        words = read.words()
    name, size, count, kind = words
    if kind.lower() == "string":
        for _ in range(int(count)):
            read.raw_line()
        return
    values = read.numbers(int(size) * int(count), kind)
    if read.active:
        read.data[read.active][name] = values


def _attribute(read: _VtkFile, word: str, words: list[str]) -> None:
    if word == "SCALARS":
        size = int(words[3]) if len(words) > 3 else 1
        before = read.place
        if read.words()[:1] != ["LOOKUP_TABLE"]:
            read.place = before
        read.data[read.active][words[1]] = read.numbers(size * read.tuples, words[2])
    elif word in _TUPLES:
        read.numbers(_TUPLES[word] * read.tuples, words[2])
    elif word == "TEXTURE_COORDINATES":
        read.numbers(int(words[2]) * read.tuples, words[3])
    elif word == "COLOR_SCALARS":
        read.numbers(int(words[2]) * read.tuples, "unsigned_char" if read.binary else "float")
    elif word == "LOOKUP_TABLE":
        read.numbers(4 * int(words[2]), "unsigned_char" if read.binary else "float")
    else:
        raise ValueError(f"unknown section {word}")


def _faces(read: _VtkFile) -> Faces:
    if read.points is None or not read.blocks:
        raise InputError("has no triangles", "export the surface as triangles")
    blocks = sorted(read.blocks, key=lambda block: _NUMBERED.index(block[0]))
    kinds = np.concatenate([np.full(len(starts) - 1, kind) for kind, starts, _ in blocks])
    if read.types is not None:
        kinds = read.types
    counts = np.concatenate([np.diff(starts) for _, starts, _ in blocks])
    corners = np.concatenate([corners for _, _, corners in blocks])
    if len(kinds) != len(counts):
        raise ValueError("not as many types as cells")
    if np.isin(kinds, _CURVED).any():
        raise InputError("has curved faces", "export it with straight triangles")
    start = np.cumsum(counts) - counts
    faces = [
        (cell, face)
        for cell in np.flatnonzero(np.isin(kinds, _STRAIGHT))
        for face in _cell_faces(int(kinds[cell]), corners[start[cell] : start[cell] + counts[cell]])
    ]
    if not faces:
        raise missing_surface_error(solid=bool((kinds >= _FIRST_SOLID).any()))
    cell = np.array([cell for cell, _ in faces])
    return Faces(
        read.points,
        np.concatenate([face for _, face in faces]),
        np.array([len(face) for _, face in faces]),
        read.data["POINT_DATA"],
        {name: values[cell] for name, values in read.data["CELL_DATA"].items() if len(values) == len(kinds)},
    )


def _cell_faces(kind: int, corners: Index) -> list[Index]:
    """The faces that a cell is: a strip is many triangles, every second one turned."""
    if kind == PIXEL:
        return [corners[[0, 1, 3, 2]]]
    if kind != STRIP:
        return [corners]
    return [corners[k : k + 3] if k % 2 == 0 else corners[[k + 1, k, k + 2]] for k in range(len(corners) - 2)]

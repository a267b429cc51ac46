"""The reader of Gmsh's MSH files: nodes and elements of versions 1, 2, 4.0 and 4.1, text and binary; on the host.

Physical groups, entities and partitions are left alone. Why not meshio's: it refuses files in which only some entities
are in a physical group, parametric nodes and most files of version 4.0.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from jaxform.core.errors import InputError
from jaxform.mesh.facets import Faces, locate_numbers, missing_surface_error

Array = NDArray[Any]

# fmt: off
_NODES = {
    1: 2, 2: 3, 3: 4, 4: 4, 5: 8, 6: 6, 7: 5, 8: 3, 9: 6, 10: 9, 11: 10, 12: 27, 13: 18, 14: 14, 15: 1, 16: 8, 17: 20,
    18: 15, 19: 13, 20: 9, 21: 10, 22: 12, 23: 15, 24: 15, 25: 21, 26: 4, 27: 5, 28: 6, 29: 20, 30: 35, 31: 56, 36: 16,
    37: 25, 38: 36, 42: 28, 43: 36, 44: 45, 45: 55, 46: 66, 47: 49, 48: 64, 49: 81, 50: 100, 51: 121, 71: 84, 72: 120,
    73: 165, 74: 220, 75: 286, 90: 40, 91: 75, 92: 64, 93: 125, 94: 216, 95: 343, 96: 512, 97: 729, 98: 1000,
    106: 126, 107: 196, 108: 288, 109: 405, 110: 550, 118: 30, 119: 55,
}  # of each type of element
_CURVED = (9, 10, 16, 20, 21, 22, 23, 24, 25, 36, 37, 38, 42, 43, 44, 45, 46, 47, 48, 49, 50, 51)
_SOLID = (*range(4, 8), *range(11, 15), *range(17, 20), 29, 30, 31, *range(71, 76), *range(90, 99), *range(106, 120))
# fmt: on
_TRIANGLE, _QUADRILATERAL = 2, 3
_SECTION = re.compile(rb"\$([A-Za-z]\w*)[ \t]*\r?\n?")


class _TextSection:
    """The numbers of a text section of a file of some version."""

    binary = False

    def __init__(self, content: bytes, version: float) -> None:
        self.content, self.version, self.place = content, version, 0

    @cached_property
    def numbers(self) -> Array:
        return np.array(self.content.split()).astype(np.float64)

    def take(self, count: int, kind: str) -> Array:
        if not 0 <= count <= len(self.numbers) - self.place:
            raise _truncation_error()
        self.place += count
        found = self.numbers[self.place - count : self.place]
        return found if kind == "f8" else found.astype(np.int64)


class _BinarySection:
    """The numbers of a binary section, whose length follows from these numbers alone."""

    binary = True

    def __init__(self, content: bytes, place: int, version: float, order: str, size: int) -> None:
        self.content, self.place, self.version, self.order, self.size = content, place, version, order, size

    def take(self, count: int, kind: str) -> Array:
        dtype = np.dtype(self.order + (f"u{self.size}" if kind == "size" else kind))
        if not 0 <= count <= (len(self.content) - self.place) // dtype.itemsize:
            raise _truncation_error()
        found = np.frombuffer(self.content, dtype, count, self.place)
        self.place += found.nbytes
        return found.astype(np.float64 if kind == "f8" else np.int64)

    def line(self) -> bytes:
        end = self.content.find(b"\n", self.place)
        line = self.content[self.place : end if end >= 0 else None]
        self.place += len(line) + 1
        return line


def _truncation_error() -> InputError:
    return InputError("is truncated: a section has fewer numbers than it declares", "export or copy it again")


def read_msh(content: bytes, name: str) -> Faces:
    """The triangles and quadrilaterals of an MSH file, with its scalar data at nodes and in elements.

    Raises:
        InputError: It is of another version, has curved faces or no faces, or its end is cut off.
    """
    version, order, size = 1.0, "", 8
    nodes: list[tuple[Array, Array]] = []
    elements: list[tuple[int, Array, Array]] = []
    data: dict[str, dict[str, tuple[Array, Array]]] = {"NodeData": {}, "ElementData": {}}
    place, found = 0, False
    while head := _SECTION.search(content, place):
        name, place = head[1].decode(), head.end()
        if name[:3].upper() == "END":
            continue
        found = found or name in ("MeshFormat", "NOD")
        end = _section_end(content, place, name)
        if name == "MeshFormat":
            version, order, size = _format(content[place:end])
        text = _TextSection(content[place:end], version)
        section = _BinarySection(content, place, version, order, size) if order else text
        place = end
        if name in ("Nodes", "NOD"):
            nodes += _nodes(section)
        elif name == "ParametricNodes":
            nodes += _parametric_nodes(section)
        elif name in ("Elements", "ELM"):
            elements += _elements(section)
        elif name in data:
            data[name] |= _binary_data(section) if isinstance(section, _BinarySection) else _text_data(section)
        else:
            continue
        place = section.place if isinstance(section, _BinarySection) else end
    if not found:
        raise InputError("has no section $MeshFormat, as an MSH file of Gmsh has", "save it from Gmsh as MSH")
    return _faces(nodes, elements, data)


def _section_end(content: bytes, place: int, name: str) -> int:
    """The end in the content of a section's text that begins at a place."""
    end = content.find(b"$End" + name.encode() if name not in ("NOD", "ELM") else b"$END" + name.encode(), place)
    if end < 0:
        raise InputError(f"is truncated: its section ${name} has no end", "export or copy it again")
    return end


def _format(section: bytes) -> tuple[float, str, int]:
    """The version, the order of bytes ("" for text), and the size of large integers."""
    words = section.split(b"\n", 1)
    number, binary, width = words[0].split()[:3]
    version, size = float(number), int(width)
    if not (2.0 <= version < 3.0 or 4.0 <= version < 4.2) or size not in (4, 8):
        problem = f"is of version {number.decode('latin-1')} of the MSH format, which is not read"
        raise InputError(problem, "save it as version 2.2 or 4.1 (Mesh.MshFileVersion)")
    order = {b"\1\0\0\0": "<", b"\0\0\0\1": ">"}[bytes(words[1][:4])] if int(binary) else ""
    return version, order, size


def _count(numbers: Any) -> int:
    """The number at the head of a section: in binary files of version 2 a line of text."""
    if isinstance(numbers, _BinarySection):
        return int(numbers.line())
    return int(numbers.take(1, "i4")[0])


def _nodes(numbers: Any) -> Iterator[tuple[Array, Array]]:
    """Numbers (n,) and positions (n, 3) of nodes, block by block."""
    if numbers.version < 4.0:
        yield _numbered_nodes(numbers, _count(numbers), 3) if numbers.binary else _text_nodes_v2(numbers.content)
        return
    old = numbers.version < 4.1
    blocks = int(numbers.take(2 if old else 4, "size")[0])
    for _ in range(blocks):
        head = numbers.take(3, "i4")
        dimension, parametric = (int(head[1]), int(head[2])) if old else (int(head[0]), int(head[2]))
        count = int(numbers.take(1, "size")[0])
        width = 3 + (max(dimension, 0) if parametric else 0)
        if old:
            yield _numbered_nodes(numbers, count, width)
        else:
            labels = numbers.take(count, "size")
            yield labels, numbers.take(count * width, "f8").reshape(count, width)[:, :3]


def _numbered_nodes(numbers: Any, count: int, width: int) -> tuple[Array, Array]:
    """Nodes that are a number and coordinates each, of which the first three are those in space."""
    if isinstance(numbers, _BinarySection):
        item = np.dtype([("number", numbers.order + "i4"), ("place", numbers.order + "f8", (width,))])
        rows = np.frombuffer(numbers.take(count * item.itemsize, "u1").astype(np.uint8).tobytes(), item)
        return rows["number"].astype(np.int64), rows["place"][:, :3].astype(np.float64)
    rows = numbers.take(count * (1 + width), "f8").reshape(count, 1 + width)
    return rows[:, 0].astype(np.int64), rows[:, 1:4]


def _text_nodes_v2(section: bytes) -> tuple[Array, Array]:
    """Nodes in text, a line each: number, x, y, z, and where they are parametric entity and parameters."""
    count, *rows = [line.split(None, 4)[:4] for line in section.split(b"\n") if line.strip()]
    table = np.array(rows[: int(count[0])]).astype(np.float64).reshape(-1, 4)
    if len(table) < int(count[0]):
        raise _truncation_error()
    return table[:, 0].astype(np.int64), table[:, 1:]


def _parametric_nodes(numbers: Any) -> Iterator[tuple[Array, Array]]:
    """Nodes of version 2 with, after x, y, z, dimension and number of their entity, and its parameters."""
    if not numbers.binary and numbers.version < 4.0:
        yield _text_nodes_v2(numbers.content)
        return
    for _ in range(_count(numbers)):
        label = numbers.take(1, "i4")
        yield label, numbers.take(3, "f8")[None]
        numbers.take({1: 1, 2: 2}.get(int(numbers.take(2, "i4")[0]), 0), "f8")


def _width(kind: int) -> int:
    if kind not in _NODES:
        raise InputError(f"has elements of Gmsh's type {kind}, which is not read", "save a mesh of first order")
    return _NODES[kind]


def _elements(numbers: Any) -> Iterator[tuple[int, Array, Array]]:
    """Type, numbers (n,) and nodes (n, k) of elements, block by block."""
    if numbers.version < 4.0:
        yield from _binary_elements_v2(numbers) if numbers.binary else _text_elements_v2(numbers)
        return
    old = numbers.version < 4.1
    blocks = int(numbers.take(2 if old else 4, "size")[0])
    for _ in range(blocks):
        kind = int(numbers.take(3, "i4")[2])
        count, width = int(numbers.take(1, "size")[0]), 1 + _width(kind)
        rows = numbers.take(count * width, "i4" if old else "size").reshape(count, width)
        yield kind, rows[:, 0], rows[:, 1:]


def _binary_elements_v2(numbers: _BinarySection) -> Iterator[tuple[int, Array, Array]]:
    left = _count(numbers)
    while left > 0:
        kind, count, tags = (int(number) for number in numbers.take(3, "i4"))
        if count < 1 or tags < 0:
            raise _truncation_error()
        width = 1 + tags + _width(kind)
        rows = numbers.take(count * width, "i4").reshape(count, width)
        yield kind, rows[:, 0], rows[:, 1 + tags :]
        left -= count


def _text_elements_v2(numbers: _TextSection) -> Iterator[tuple[int, Array, Array]]:
    rows: dict[int, list[Array]] = {}
    for _ in range(_count(numbers)):
        number, kind, tags = numbers.take(3, "i4")
        if numbers.version < 2.0:  # physical group, entity, number of nodes
            numbers.take(2, "i4")
        elif tags > 0:
            numbers.take(int(tags), "i4")
        rows.setdefault(int(kind), []).append(np.append(number, numbers.take(_width(int(kind)), "i4")))
    for kind, found in rows.items():
        table = np.array(found)
        yield kind, table[:, 0], table[:, 1:]


def _text_data(section: _TextSection) -> dict[str, tuple[Array, Array]]:
    """Numbers (n,) and values (n,) by the name of the data; none where it has several components."""
    lines = section.content.split(b"\n")
    strings = int(lines[0])
    label = lines[1].strip().strip(b'"').decode("latin-1") if strings else ""
    numbers = _TextSection(b"\n".join(lines[1 + strings :]), section.version)
    numbers.take(int(numbers.take(1, "i4")[0]), "f8")
    components, count = (int(number) for number in numbers.take(int(numbers.take(1, "i4")[0]), "i4")[1:3])
    if components != 1:
        return {}
    rows = numbers.take(2 * count, "f8").reshape(count, 2)
    return {label: (rows[:, 0].astype(np.int64), rows[:, 1])}


def _binary_data(numbers: _BinarySection) -> dict[str, tuple[Array, Array]]:
    """Numbers (n,) and values (n,) by the name of the data; none where it has several components or no name."""
    strings = [numbers.line() for _ in range(min(int(numbers.line()), 100))]
    for _ in range(min(int(numbers.line()), 100)):
        numbers.line()
    integers = [int(numbers.line()) for _ in range(min(int(numbers.line()), 100))]
    components, count = integers[1:3]
    item = np.dtype([("number", numbers.order + "i4"), ("value", numbers.order + "f8", (components,))])
    rows = np.frombuffer(numbers.take(count * item.itemsize, "u1").astype(np.uint8).tobytes(), item)
    if components != 1 or not strings:
        return {}
    label = strings[0].strip().strip(b'"').decode("latin-1")
    return {label: (rows["number"].astype(np.int64), rows["value"][:, 0].astype(np.float64))}


def _faces(
    nodes: list[tuple[Array, Array]],
    elements: list[tuple[int, Array, Array]],
    data: dict[str, dict[str, tuple[Array, Array]]],
) -> Faces:
    if not sum(len(numbers) for numbers, _ in nodes):
        raise InputError("has no nodes", "save the mesh, not the geometry alone")
    kinds = list(dict.fromkeys(kind for kind, _, _ in elements))
    curved = [kind for kind in kinds if kind in _CURVED]
    if curved:
        problem = f"has curved faces (elements of second or higher order, Gmsh's type {curved[0]})"
        raise InputError(problem, "save a mesh of first order (Mesh.ElementOrder = 1)")
    # Triangles come first, whatever their order in the file.
    straight = [block for wanted in (_TRIANGLE, _QUADRILATERAL) for block in elements if block[0] == wanted]
    if not straight:
        raise missing_surface_error(solid=any(kind in _SOLID for kind in kinds))
    numbers, places = _sort_nodes(*(np.concatenate(part) for part in zip(*nodes, strict=True)))
    cells = np.concatenate([number for _, number, _ in straight]).astype(np.int64)
    corners = [locate_numbers(found.astype(np.int64).reshape(-1), numbers) for _, _, found in straight]
    counts = [np.full(len(found), found.shape[1]) for _, _, found in straight]
    return Faces(
        places,
        np.concatenate(corners),
        np.concatenate(counts),
        {label: _look_up(numbers, *pair) for label, pair in data["NodeData"].items()},
        {label: _look_up(cells, *pair) for label, pair in data["ElementData"].items()},
    )


def _sort_nodes(numbers: Array, places: Array) -> tuple[Array, Array]:
    """Nodes by their number, each once."""
    found, first = np.unique(numbers, return_index=True)
    return found, places[first]


def _look_up(wanted: Array, there: Array, values: Array) -> Array:
    """Values of the numbers that are wanted (n,); NaN where none is given."""
    found = np.full(len(wanted), np.nan)
    if len(there):
        order = np.argsort(there)
        at = np.minimum(np.searchsorted(there[order], wanted), len(there) - 1)
        here = there[order][at] == wanted
        found[here] = values[order][at][here]
    return found

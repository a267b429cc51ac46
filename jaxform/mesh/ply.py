"""The reader of PLY files: elements and properties by the names that the header gives them; on the host.

Why not a library's: meshio takes properties by their order and refuses further elements and lists; trimesh refuses
binary files with both triangles and quadrilaterals as cut off.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from jaxform.core.errors import InputError
from jaxform.mesh.facets import Faces, missing_surface_error

Array = NDArray[Any]

_TYPES = {
    **dict.fromkeys(("char", "int8"), "i1"),
    **dict.fromkeys(("uchar", "uint8"), "u1"),
    **dict.fromkeys(("short", "int16"), "i2"),
    **dict.fromkeys(("ushort", "uint16"), "u2"),
    **dict.fromkeys(("int", "int32"), "i4"),
    **dict.fromkeys(("uint", "uint32"), "u4"),
    **dict.fromkeys(("long", "int64"), "i8"),
    **dict.fromkeys(("ulong", "uint64"), "u8"),
    **dict.fromkeys(("float", "float32"), "f4"),
    **dict.fromkeys(("double", "float64"), "f8"),
}
_ORDERS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
_CORNERS = ("vertex_indices", "vertex_index")


_Property = tuple[str, str, str]
"""Name and type of a number of each item; or of a list of numbers, whose count has the last type, "" of no list."""


@dataclass
class _Element:
    """A table of the file; of a list it keeps the counts of the items, and the numbers of all behind each other."""

    name: str
    count: int
    properties: list[_Property] = field(default_factory=list)
    scalars: dict[str, Array] = field(default_factory=dict)
    lists: dict[str, tuple[Array, Array]] = field(default_factory=dict)


def read_ply(content: bytes, name: str) -> Faces:
    """The faces of a PLY file, text or binary, with the numbers at its vertices and of its faces as data.

    Other elements and lists are left out; triangle strips are divided.

    Raises:
        InputError: It is no PLY file, its vertices have no x, y and z, it has no faces, or its end is cut off.
    """
    order, elements, body = _header(content)
    table = _PlyBinary(body, order) if order else _PlyText(body)
    for element in elements:
        table.read(element)
    by_name = {element.name: element for element in elements}
    vertices = by_name.get("vertex")
    if vertices is None or not {"x", "y", "z"} <= vertices.scalars.keys():
        raise InputError("has no positions x, y, z at its vertices", "export it again as PLY, STL or OBJ")
    points = np.stack([vertices.scalars[axis].astype(np.float64) for axis in "xyz"], axis=1)
    data = {key: values for key, values in vertices.scalars.items() if key not in ("x", "y", "z")}
    counts, corners, cells = _faces(by_name)
    return Faces(points, corners.astype(np.int64), counts.astype(np.int64), data, cells)


def _header(content: bytes) -> tuple[str, list[_Element], bytes]:
    """The order of bytes ("" for text), the elements, and what follows the header."""
    if not content.removeprefix(b"\xef\xbb\xbf").lstrip()[:3].lower() == b"ply":
        raise InputError("does not begin with `ply`, as a PLY file does", "export or copy it again")
    head, end, body = content.partition(b"end_header")
    if not end:
        raise InputError("has a header without `end_header`", "export or copy it again")
    body = body.lstrip(b" \t")
    body = body[2:] if body.startswith(b"\r\n") else body[1:]
    order, elements = None, []
    for line in head.decode("latin-1").splitlines():
        words = line.split()
        if words[:1] == ["format"] and len(words) > 1:
            order = _ORDERS.get(words[1])
        elif words[:1] == ["element"] and len(words) == 3 and words[2].isdecimal():
            elements.append(_Element(words[1], int(words[2])))
        elif words[:1] == ["property"] and elements:
            elements[-1].properties.append(_property(words, line))
        elif words[:1] in (["element"], ["property"]):
            raise InputError(f"has a header line that is not understood ({line.strip()[:60]})", "export it again")
    if order is None:
        raise InputError(f"has no format in its header, one of {', '.join(_ORDERS)}", "export it again")
    return order, elements, body


def _property(words: list[str], line: str) -> _Property:
    types = words[2:4] if words[1] == "list" else words[1:2]
    if len(words) != len(types) * 2 + 1 or not all(kind in _TYPES for kind in types):
        raise InputError(f"has a header line that is not understood ({line.strip()[:60]})", "export it again")
    if words[1] == "list":
        return words[4], _TYPES[types[1]], _TYPES[types[0]]
    return words[2], _TYPES[types[0]], ""


def _truncation_error(element: _Element, there: int) -> InputError:
    problem = f"is truncated: {there} of its {element.count} items `{element.name}` are present"
    return InputError(problem, "export or copy it again")


def _fill_element(element: _Element, columns: list[Array], counts: list[Array]) -> None:
    """Sets the numbers of an element; of scalars the columns are (n,), of lists all their numbers."""
    for (name, _, count_type), column, count in zip(element.properties, columns, counts, strict=True):
        if count_type:
            element.lists[name] = (count, column)
        else:
            element.scalars[name] = column


class _PlyBinary:
    """The numbers of a binary file."""

    def __init__(self, body: bytes, order: str) -> None:
        self.body, self.order, self.place = body, order, 0

    def read(self, element: _Element) -> None:
        if not self._read_uniform(element):
            self._read_each(element)

    def _read_uniform(self, element: _Element) -> bool:
        """Reads items whose lists are as long as those of the first one; False where they are not."""
        if not element.properties or not element.count:
            _fill_element(element, *_empty_columns(element))
            return True
        lengths, place = [], self.place
        for _, number_type, count_type in element.properties:
            length = 1
            if count_type:
                kind = np.dtype(self.order + count_type)
                if place + kind.itemsize > len(self.body):
                    raise _truncation_error(element, 0)
                length = int(np.frombuffer(self.body, kind, 1, place)[0])
                place += kind.itemsize
            if length < 0 or place + length > len(self.body):
                return False
            lengths.append(length)
            place += length * np.dtype(number_type).itemsize
        fields: list[Any] = []
        for k, ((_, number_type, count_type), length) in enumerate(zip(element.properties, lengths, strict=True)):
            fields += [(f"n{k}", self.order + count_type)] if count_type else []
            fields.append((f"v{k}", self.order + number_type, (length,)))
        item = np.dtype(fields)
        there = (len(self.body) - self.place) // item.itemsize
        listed = any(count_type for _, _, count_type in element.properties)
        if there < element.count and not listed:
            raise _truncation_error(element, there)
        if there < element.count:
            return False
        rows = np.frombuffer(self.body, item, element.count, self.place)
        counts = [rows[f"n{k}"] if kind else np.zeros(0) for k, (_, _, kind) in enumerate(element.properties)]
        if any((count != length).any() for count, length in zip(counts, lengths, strict=True)):
            return False
        self.place += rows.nbytes
        _fill_element(element, [rows[f"v{k}"].reshape(-1) for k in range(len(lengths))], counts)
        return True

    def _read_each(self, element: _Element) -> None:
        columns: list[list[Array]] = [[] for _ in element.properties]
        counts: list[list[int]] = [[] for _ in element.properties]
        kinds = [np.dtype(self.order + number_type) for _, number_type, _ in element.properties]
        heads = [np.dtype(self.order + kind) if kind else None for _, _, kind in element.properties]
        place = self.place
        for item in range(element.count):
            for k, (kind, head) in enumerate(zip(kinds, heads, strict=True)):
                length = 1
                if head is not None and place + head.itemsize <= len(self.body):
                    length = int(np.frombuffer(self.body, head, 1, place)[0])
                    place += head.itemsize
                if length < 0 or place + length * kind.itemsize > len(self.body):
                    raise _truncation_error(element, item)
                counts[k].append(length)
                columns[k].append(np.frombuffer(self.body, kind, length, place))
                place += length * kind.itemsize
        self.place = place
        _fill_element(element, [np.concatenate(column) for column in columns], [np.array(count) for count in counts])


class _PlyText:
    """The numbers of a text file, which follow each other whatever the lines are."""

    def __init__(self, body: bytes) -> None:
        try:
            self.numbers = np.array(body.split()).astype(np.float64)
        except ValueError:
            raise InputError("has words instead of numbers", "export it again") from None
        self.place = 0

    def read(self, element: _Element) -> None:
        if not element.properties or not element.count:
            _fill_element(element, *_empty_columns(element))
            return
        if not self._read_uniform(element):
            self._read_each(element)

    def _read_uniform(self, element: _Element) -> bool:
        """Reads items whose lists are as long as those of the first one; False where they are not."""
        starts, place = [], 0
        for _, _, count_type in element.properties:
            place += bool(count_type)
            length = self._length(self.place + place - 1) if count_type else 1
            starts.append((place, length))
            place += length
        listed = [place - 1 for (place, _), (_, _, kind) in zip(starts, element.properties, strict=True) if kind]
        there = (len(self.numbers) - self.place) // place if place else 0
        if there < element.count and not listed:
            raise _truncation_error(element, there)
        if there < element.count:
            return False
        rows = self.numbers[self.place : self.place + element.count * place].reshape(element.count, place)
        if (rows[:, listed] != rows[:1, listed]).any():
            return False
        self.place += rows.size
        columns = [
            _cast(rows[:, at : at + length].reshape(-1), prop) for (at, length), prop in _pair_starts(starts, element)
        ]
        _fill_element(element, columns, [rows[:, at - 1].astype(np.int64) for at, _ in starts])
        return True

    def _length(self, place: int) -> int:
        """A list's length; more than there is of anything where the file ends before it, or it is none."""
        if place >= len(self.numbers) or not 0 <= self.numbers[place] <= len(self.numbers):
            return len(self.numbers) + 1
        return int(self.numbers[place])

    def _read_each(self, element: _Element) -> None:
        columns: list[list[Array]] = [[] for _ in element.properties]
        counts: list[list[int]] = [[] for _ in element.properties]
        place = self.place
        for item in range(element.count):
            for k, (_, _, count_type) in enumerate(element.properties):
                length = self._length(place) if count_type else 1
                place += bool(count_type)
                if place + length > len(self.numbers):
                    raise _truncation_error(element, item)
                counts[k].append(length)
                columns[k].append(self.numbers[place : place + length])
                place += length
        self.place = place
        joined = [_cast(np.concatenate(column), prop) for column, prop in zip(columns, element.properties, strict=True)]
        _fill_element(element, joined, [np.array(count) for count in counts])


def _pair_starts(starts: list[tuple[int, int]], element: _Element) -> zip[tuple[tuple[int, int], _Property]]:
    return zip(starts, element.properties, strict=True)


def _cast(numbers: Array, prop: _Property) -> Array:
    _, number_type, _ = prop
    return numbers if number_type.startswith("f") else numbers.astype(np.int64)


def _empty_columns(element: _Element) -> tuple[list[Array], list[Array]]:
    empty: list[Array] = [np.zeros(0) for _ in element.properties]
    return empty, [np.zeros(0, np.int64) for _ in element.properties]


def _faces(elements: dict[str, _Element]) -> tuple[Array, Array, dict[str, Array]]:
    """Corners of each face, the corners of all, and the numbers of the faces."""
    faces = elements.get("face")
    if faces is not None and faces.count:
        lists = {name: pair for name, pair in faces.lists.items() if pair[1].dtype.kind in "iu"}
        name = next((name for name in _CORNERS if name in lists), next(iter(lists), ""))
        if name:
            return *lists[name], dict(faces.scalars)
    strips = elements.get("tristrips")
    if strips is not None and strips.lists:
        triangles = _strips(next(iter(strips.lists.values()))[1].astype(np.int64))
        return np.full(len(triangles), 3), triangles.reshape(-1), {}
    raise missing_surface_error(solid=False)


def _strips(corners: Array) -> Array:
    """The triangles (m, 3) of strips, of which each ends at a number below 0; every second one is turned."""
    found = [np.zeros((0, 3), np.int64)]
    ends = [-1, *np.flatnonzero(corners < 0), len(corners)]
    for begin, end in itertools.pairwise(ends):
        strip = corners[begin + 1 : end]
        if len(strip) < 3:
            continue
        rows = np.stack([strip[:-2], strip[1:-1], strip[2:]], axis=1)
        rows[1::2] = rows[1::2, [1, 0, 2]]
        distinct = (rows[:, 0] != rows[:, 1]) & (rows[:, 1] != rows[:, 2]) & (rows[:, 0] != rows[:, 2])
        found.append(rows[distinct])
    return np.concatenate(found)

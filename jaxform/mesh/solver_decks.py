"""Readers of other programs' input files: Abaqus' and CalculiX' INP, and Nastran's bulk data.

Keywords of INP in any case, comments, parts with numbers of their own, instances with translation and rotation. What
makes nodes or elements elsewhere, or in other coordinates, is refused by name. Why not meshio's: of two parts it gives
all elements the nodes of the second, and it refuses lower case, comments between nodes and elements such as M3D3.
"""

from __future__ import annotations

import itertools
import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from jaxform.core.errors import InputError, warn_of
from jaxform.mesh.facets import Faces, locate_numbers, missing_surface_error

Array = NDArray[np.float64]

_SURFACE = re.compile(r"(?:STRI|S|M3D|SFM3D|R3D|DS|F3D|CPS|CPE|CPEG|WARPF?2D)(65|3|4|6|8|9)(?:[A-Z]\w*)?")
_NODES = {"3": (3, 3), "4": (4, 4), "6": (6, 3), "65": (6, 3), "8": (8, 4), "9": (9, 4)}
"""Numbers of all nodes and of corners, which come first, by the number in a surface element's name."""
_SOLID = re.compile(r"(?:C3D|CCL|CSS|SC[68]|DC3D|AC3D|COH3D|EC3D|FC3D|PC3D|Q3D)\w*")
_ELSEWHERE = {
    "INCLUDE": "includes other files",
    "MANIFEST": "includes other files",
    "PARAMETER": "has parameters",
    "SYSTEM": "has nodes in local coordinates",
    "NGEN": "generates nodes",
    "NFILL": "generates nodes",
    "NCOPY": "generates nodes",
    "NMAP": "generates nodes",
    "ELGEN": "generates elements",
    "ELCOPY": "generates elements",
    "SYMMETRIC MODEL GENERATION": "generates elements",
}
"""Keywords of what a file of plain nodes and elements does not have."""
_PLACED = 7  # numbers that turn an instance: two points of an axis, and degrees


@dataclass
class _Scope:
    """Nodes and faces with numbers of their own: a part, an instance, the assembly, or a file without parts."""

    nodes: dict[int, tuple[float, float, float]] = field(default_factory=dict)
    faces: list[tuple[int, list[int]]] = field(default_factory=list)
    solid: bool = False
    curved: int = 0


def read_inp(content: bytes, name: str) -> Faces:
    """The surface elements of an input file; of those with nodes on their sides the corners, with a warning.

    Raises:
        InputError: Nodes or elements are generated or in other files or coordinates, some node is missing, or there
            are no surface elements.
    """
    scopes = _scopes(content)
    if curved := sum(scope.curved for scope in scopes):
        warn_of(f"has {curved} elements with mid-side nodes, of which only the corners are used", value=name)
    points: list[tuple[float, float, float]] = []
    corners: list[int] = []
    counts: list[int] = []
    for scope in scopes:
        index = dict(zip(scope.nodes, itertools.count(len(points))))
        points += scope.nodes.values()
        for label, face in scope.faces:
            try:
                corners += [index[node] for node in face]
            except KeyError as missing:
                problem = f"has an element {label} of node {missing}, which does not exist"
                raise InputError(problem, "export it again, with all its nodes") from None
            counts.append(len(face))
    if not counts:
        raise missing_surface_error(solid=any(scope.solid for scope in scopes))
    return Faces(np.array(points).reshape(-1, 3), np.array(corners, np.int64), np.array(counts, np.int64))


def _keywords(content: bytes) -> Iterator[tuple[str, dict[str, str], list[list[str]]]]:
    """Each keyword in capitals with its parameters, and the words of its data lines."""
    head, data = "", []
    text = content.decode("utf-8-sig", errors="replace")
    for line in text.splitlines():
        line = line.strip()
        if not line or line.startswith("**"):
            continue
        if line.startswith("*"):
            if head:
                yield *_split(head), data
            head, data = line, []
        elif head.endswith(","):
            head += line
        else:
            data.append([word.strip() for word in line.split(",")])
    if head:
        yield *_split(head), data


def _split(line: str) -> tuple[str, dict[str, str]]:
    word, *options = line[1:].split(",")
    pairs = (option.partition("=") for option in options)
    named = {" ".join(key.split()).upper(): value.strip().strip('"') for key, _, value in pairs}
    return " ".join(word.split()).upper(), named


def _scopes(content: bytes) -> list[_Scope]:
    """The lines outside of parts, those of the assembly, and its instances; parts as they are without any instance."""
    top, assembly = _Scope(), _Scope()
    scope = top
    parts: dict[str, _Scope] = {}
    instances: list[tuple[str, _Scope, list[list[float]]]] = []  # name of the part, its additions, what moves it
    for word, options, data in _keywords(content):
        _check_plain(word, options)
        if word == "PART":
            scope = parts.setdefault(options.get("NAME", "").upper(), _Scope())
        elif word == "INSTANCE":
            scope = _Scope()
            instances.append((options.get("PART", "").upper(), scope, [_numbers(row) for row in data]))
        elif word in ("ASSEMBLY", "END INSTANCE"):
            scope = assembly
        elif word in ("END PART", "END ASSEMBLY"):
            scope = top
        elif word == "NODE":
            for row in data:
                label, *place = _numbers(row)
                x, y, z = (*place[:3], 0.0, 0.0, 0.0)[:3]
                scope.nodes[int(label)] = x, y, z
        elif word == "ELEMENT":
            _add_elements(scope, options.get("TYPE", "").upper(), data)
    placed = [_place_instance(parts, *instance) for instance in instances]
    return [top, assembly, *(placed or parts.values())]


def _check_plain(word: str, options: dict[str, str]) -> None:
    remedy = "give one file with the mesh as plain nodes and elements, or export it as STL"
    if _ELSEWHERE.get(word):
        raise InputError(f"{_ELSEWHERE[word]} (*{word})", remedy)
    if word in ("NODE", "ELEMENT") and "INPUT" in options:
        raise InputError(f"includes other files (*{word}, INPUT={options['INPUT']})", remedy)
    if word == "NODE" and options.get("SYSTEM", "R").upper() not in ("R", "RECTANGULAR"):
        raise InputError(f"has nodes in local coordinates (*NODE, SYSTEM={options['SYSTEM']})", remedy)
    if word == "INSTANCE" and ("LIBRARY" in options or "INSTANCE" in options):
        raise InputError("includes an instance of other results (*INSTANCE, LIBRARY)", remedy)


def _numbers(words: list[str]) -> list[float]:
    try:
        return [float(word.lower().replace("d", "e")) for word in words if word]
    except ValueError:
        raise InputError(f"has words instead of numbers ({', '.join(words)[:60]})", "export or copy it again") from None


def _add_elements(scope: _Scope, kind: str, data: list[list[str]]) -> None:
    """Elements of one type; a row goes on in the next one until all nodes are there."""
    found = _SURFACE.fullmatch(kind)
    if not found:
        scope.solid |= bool(_SOLID.fullmatch(kind))
        return
    count, used = _NODES[found[1]]
    row: list[int] = []
    for words in data:
        row += [int(number) for number in _numbers(words)]
        if len(row) < 1 + count:
            continue
        if len(row) > 1 + count:
            raise InputError(f"has an element {row[0]} of type {kind} with {len(row) - 1} nodes", "export it again")
        scope.faces.append((row[0], row[1 : 1 + used]))
        scope.curved += used < count
        row = []
    if row:
        raise InputError(f"has an element {row[0]} of type {kind} with {len(row) - 1} nodes", "export it again")


def _place_instance(parts: dict[str, _Scope], name: str, content: _Scope, numbers: list[list[float]]) -> _Scope:
    """A part with what its instance adds, its nodes translated, then turned about an axis, as the numbers say."""
    part = parts.get(name)
    if part is None and not content.nodes:
        raise InputError(f"has an instance of part {name!r}, which does not exist", "export it again")
    part = part or _Scope()
    scope = _Scope(part.nodes | content.nodes, part.faces + content.faces, part.solid, part.curved)
    if not numbers or not scope.nodes:
        return scope
    places = np.array(list(scope.nodes.values()))
    shift = (*numbers[0], 0.0, 0.0, 0.0)[:3] if len(numbers[0]) <= 3 else None
    turns = [row for row in numbers if len(row) == _PLACED]
    if shift is None or len(numbers) != 1 + len(turns) or len(turns) > 1:
        raise InputError(f"has an instance of part {name!r} whose position is not understood", "export it again")
    places = places + np.array(shift)
    for row in turns:
        places = _rotate(places, np.array(row[:3]), np.array(row[3:6]), row[6])
    moved = (tuple(row) for row in places.tolist())
    nodes: Any = dict(zip(scope.nodes, moved, strict=True))
    return _Scope(nodes, scope.faces, scope.solid, scope.curved)


def _rotate(places: Array, begin: Array, end: Array, degrees: float) -> Array:
    """Places (n, 3) turned about the axis from one point to another, by the right-hand rule."""
    axis = (end - begin) / np.linalg.norm(end - begin)
    angle, arms = np.radians(degrees), places - begin
    along = np.outer(arms @ axis, axis)
    return begin + along + np.cos(angle) * (arms - along) + np.sin(angle) * np.cross(axis, arms)


# The reader of bulk data of Nastran and OptiStruct (BDF, NAS, FEM): grid points and shells; on the host.

_SHELLS = {"CTRIA3": 3, "CTRIAR": 3, "CTRIA6": 3, "CQUAD4": 4, "CQUADR": 4, "CQUAD8": 4, "CQUAD": 4, "CSHEAR": 4}
"""Cards of shells and membranes and their corners, which come first."""
_CURVED = ("CTRIA6", "CQUAD8", "CQUAD")
_SOLIDS = ("CTETRA", "CHEXA", "CPENTA", "CPYRAM", "CPYRA")
_BULK = re.compile(r"^[ \t]*BEGIN[ \t]+BULK.*$|^[ \t]*BEGIN[ \t]*$", re.IGNORECASE | re.MULTILINE)
_EXPONENT = re.compile(r"(?<=[\d.])([+-]\d+)$")  # 3.5-18 is 3.5e-18
_INCLUDE = re.compile(r"^[ \t]*INCLUDE\b", re.IGNORECASE | re.MULTILINE)
_WIDTH, _FIELDS = 8, 8


def read_bdf(content: bytes, name: str) -> Faces:
    """The triangles and quadrilaterals of bulk data; of those with nodes on their sides the corners, with a warning.

    Raises:
        InputError: It includes other files, has nodes in local coordinates, repeats cards by `=`, has no shells, or
            some node is missing.
    """
    text = content.decode("utf-8-sig", errors="replace")
    if _INCLUDE.search(text):
        raise InputError("includes other files (INCLUDE)", "give one file that has the mesh")
    nodes: dict[int, list[float]] = {}
    corners: list[int] = []
    counts: list[int] = []
    curved, solid = 0, False
    for card, fields in _cards(text):
        if card == "GRID":
            nodes[_parse_integer(fields[0], card)] = _parse_position(fields)
        elif card in _SHELLS:
            count = _SHELLS[card]
            corners += [_parse_integer(field, card) for field in fields[2 : 2 + count]]
            counts.append(count)
            curved += card in _CURVED and any(fields[2 + count : 2 + 2 * count])
        elif card == "GRDSET" and fields[1] not in ("", "0"):
            raise _coordinate_system_error(card, fields[1])
        solid |= card in _SOLIDS
    if curved:
        warn_of(f"has {curved} elements with mid-side nodes, of which only the corners are used", value=name)
    if not counts or not nodes:
        raise missing_surface_error(solid=solid)
    numbers = np.array(sorted(nodes))
    points = np.array([nodes[number] for number in numbers.tolist()])
    return Faces(points, locate_numbers(np.array(corners, np.int64), numbers), np.array(counts, np.int64))


def _cards(text: str) -> Iterator[tuple[str, list[str]]]:
    """Each card's name in capitals and its fields, at least eight, those of its continuations behind them."""
    begin = _BULK.search(text)
    name, fields = "", []
    for line in text[begin.end() if begin else 0 :].splitlines():
        line = line.partition("$")[0].rstrip()
        if not line:
            continue
        if line[0] == "=":
            raise InputError(f"repeats cards ({line[:40]})", "export it again with all its cards")
        head, row = _row(line)
        if head == "ENDDATA":
            break
        if head and head[0] not in "+*":
            if name:
                yield name, _pad(fields)
            name, fields = head.rstrip("*"), row
        else:
            fields += row
    if name:
        yield name, _pad(fields)


def _pad(fields: list[str]) -> list[str]:
    return fields + [""] * (2 * _FIELDS - len(fields))


def _row(line: str) -> tuple[str, list[str]]:
    """The first field of a line in capitals and the fields behind it: four where they are large, else eight."""
    if "," in line:
        head, *row = (word.strip() for word in line.split(","))
        count = _FIELDS // 2 if "*" in head else _FIELDS
        return head.upper(), (row + [""] * count)[:count]
    line = line.expandtabs(_WIDTH)
    head = line[:_WIDTH].strip().upper()
    width, count = (2 * _WIDTH, _FIELDS // 2) if "*" in head else (_WIDTH, _FIELDS)
    return head, [line[_WIDTH + k * width : _WIDTH + (k + 1) * width].strip() for k in range(count)]


def _parse_integer(field: str, card: str) -> int:
    try:
        return int(field)
    except ValueError:
        raise InputError(f"has {field!r} for a number in a card {card}", "export or copy it again") from None


def _parse_position(fields: list[str]) -> list[float]:
    if fields[1] not in ("", "0"):
        raise _coordinate_system_error("GRID", fields[1])
    try:
        return [float(_EXPONENT.sub(r"e\1", field.lower().replace("d", "e")) or 0.0) for field in fields[2:5]]
    except ValueError:
        problem = f"has a grid point {fields[0]} with coordinates that are not numbers ({', '.join(fields[2:5])})"
        raise InputError(problem, "export or copy it again") from None


def _coordinate_system_error(card: str, system: str) -> InputError:
    problem = f"has nodes in local coordinates ({card}, coordinate system {system})"
    return InputError(problem, "export it with all nodes in the basic coordinate system")

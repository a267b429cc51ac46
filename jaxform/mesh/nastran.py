"""The reader of bulk data of Nastran and OptiStruct (BDF, NAS, FEM): grid points and shells; on the host.

Small, large and free fields, with or without BEGIN BULK. Why not meshio's: it refuses files without BEGIN BULK, as Gmsh
writes them, and comments and cards that it does not know.
"""

from __future__ import annotations

import re
from collections.abc import Iterator

import numpy as np

from jaxform.core.errors import InputError, warn_of
from jaxform.mesh.facets import Faces, locate_numbers, missing_surface_error

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

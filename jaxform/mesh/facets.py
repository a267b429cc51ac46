"""Readers of STL, OBJ and OFF, as the programs write them that people draw molds with; on the host.

Each takes the content of a file and returns its faces. What they raise beside InputError (ValueError, IndexError and
the like) means that the content is no such file.

Why not a library's: trimesh (5.2) reads most of these in half to a fifth of the time, but it refuses binary STL files
with bytes behind the last triangle, loses the first position of an OBJ file behind a byte order mark, refuses binary
PLY files of triangles and quadrilaterals, and does not tell where an OBJ file is cut off.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from jaxform.core.errors import InputError, warn_of


@dataclass(frozen=True)
class Faces:
    """The faces that were read from a mesh file.

    Attributes:
        points: Node positions in the unit of the file, shape (n, 2) or more.
        corners: Node indices of all faces, one face after the other, shape (counts.sum(),).
        counts: Corners of each face, shape (f,).
        point_data: Data at the nodes by name, n of them.
        cell_data: Data of the faces by name, f of them.
    """

    points: NDArray[Any]
    corners: NDArray[np.int64]
    counts: NDArray[np.int64]
    point_data: dict[str, NDArray[Any]] = field(default_factory=dict)
    cell_data: dict[str, NDArray[Any]] = field(default_factory=dict)


def missing_surface_error(*, solid: bool) -> InputError:
    """The error for a file without faces."""
    if solid:
        return InputError("has solids but no surface", "extract their surface, and export that as triangles")
    return InputError("has no triangles", "export the surface as triangles")


def locate_numbers(wanted: NDArray[np.int64], numbers: NDArray[np.int64]) -> NDArray[np.int64]:
    """Indices (n,) of the elements' node numbers in the sorted numbers of all nodes.

    Raises:
        InputError: Some are not there.
    """
    at = np.minimum(np.searchsorted(numbers, wanted), len(numbers) - 1)
    missing = wanted[numbers[at] != wanted]
    if missing.size:
        raise InputError(
            f"has elements of node {missing[0]}, which does not exist", "export it again with all its nodes"
        )
    return at


_FACET = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
_UNCOUNTED = (0, 2**32 - 1)  # written for the number of facets by programs that do not know it when they begin
_VERTEX = re.compile(rb"^[ \t]*vertex[ \t]+(\S+)[ \t]+(\S+)[ \t]+(\S+)[ \t\r]*$", re.MULTILINE | re.IGNORECASE)


def read_stl(content: bytes, name: str) -> Faces:
    """The facets of an STL file, binary or ASCII, nodes not welded."""
    count = int.from_bytes(content[80:84], "little")
    there, rest = divmod(max(len(content) - 84, 0), _FACET.itemsize)
    if count in _UNCOUNTED and there and not rest and b"\0" in content[84:]:
        words = f"gives no number of triangles, and has {there}"
        warn_of(words, "export it again if triangles are missing", value=name)
        count = there
    expected = 84 + _FACET.itemsize * count
    # Where ASCII has its letters, the number of a binary file is larger than any file.
    if len(content) >= 84 and count and len(content) >= expected:
        if len(content) > expected:
            words = f"has {len(content) - expected} bytes after the last of its {count} triangles, which are left out"
            warn_of(words, "export it again if triangles are missing", value=name)
        return _unwelded_faces(np.frombuffer(content, _FACET, count, 84)["corners"].astype(np.float64))
    text = _unify_line_ends(content)
    lower = text.lower()
    if b"facet" in lower[:100_000] and lower.lstrip(b"\xef\xbb\xbf \t\r\n").startswith(b"solid"):
        return _unwelded_faces(_ascii_corners(text, lower))
    if len(content) >= 84 and count and b"\0" in content:
        problem = f"is not an ASCII STL file, and is incomplete as a binary one: {there} of {count} triangles"
        raise InputError(problem, "export or copy it again")
    raise ValueError("neither binary nor ASCII STL")


def _unify_line_ends(content: bytes) -> bytes:
    """Text whose lines end as on Unix, from any system."""
    return content.replace(b"\r\n", b"\n").replace(b"\r", b"\n")


def _ascii_corners(content: bytes, lower: bytes) -> NDArray[np.float64]:
    corners = np.array(_VERTEX.findall(content)).astype(np.float64)
    facets, loops = (len(re.findall(rb"^[ \t]*" + word, lower, re.MULTILINE)) for word in (b"facet", b"endloop"))
    # The end is said once for each solid; after the last facet of all, where none is cut off.
    ended = re.search(rb"^[ \t]*end ?solid", lower[max(lower.rfind(b"endfacet"), 0) :], re.MULTILINE)
    if not ended or not len(corners) == 3 * facets == 3 * loops:
        raise ValueError("truncated")
    return corners.reshape(-1, 3, 3)


def _unwelded_faces(corners: NDArray[np.float64]) -> Faces:
    count = len(corners)
    return Faces(corners.reshape(-1, 3), np.arange(3 * count), np.full(count, 3, np.int64))


def read_obj(content: bytes, name: str) -> Faces:
    """The positions and faces of an OBJ file; normals, textures, materials, lines and curves are left out."""
    text = _unify_line_ends(content).decode("utf-8-sig", errors="replace").replace("\\\n", " ")
    points: list[list[float]] = []
    corners: list[int] = []
    counts: list[int] = []
    for line in text.split("\n"):
        words = line.partition("#")[0].split()
        if not words or words[0] not in ("v", "f"):
            continue
        if words[0] == "v":
            x, y, z = map(float, words[1:4])
            points.append([x, y, z])
            continue
        numbers = [int(word.partition("/")[0]) for word in words[1:]]
        if len(numbers) < 3:
            raise InputError(f"has a face with {len(numbers)} corners ({line.strip()[:40]})", "export or copy it again")
        # Below zero: counted back from the last position so far. Above: from 1.
        corners += [number - 1 if number > 0 else len(points) + number if number else -1 for number in numbers]
        counts.append(len(numbers))
    faces = Faces(np.array(points).reshape(-1, 3), np.array(corners, np.int64), np.array(counts, np.int64))
    _warn_of_a_cut(faces, text, name)
    return faces


def _warn_of_a_cut(faces: Faces, text: str, name: str) -> None:
    """Warns of a file that may be cut off: OBJ has no end marker, but positions come before their faces."""
    unused = len(faces.points) - len(np.unique(faces.corners))
    if len(faces.counts) and unused > 0:
        problem = f"has {unused} of {len(faces.points)} positions that no face uses"
        warn_of(problem, "check that the end of the file is not cut off", value=name)
    elif len(faces.counts) and text[-1:] not in ("\n", "\0") and text.rpartition("\n")[2][:1] == "f":
        warn_of("ends within a line", "check that the end of the file is not cut off", value=name)


_OFF_HEADER = re.compile(r"(?:ST)?C?N?OFF\b[ \t]*(.*)", re.IGNORECASE)


def read_off(content: bytes, name: str) -> Faces:
    """The positions and faces of an OFF file; colours, normals and textures are left out."""
    lines = (line.partition("#")[0].split() for line in _unify_line_ends(content).decode("utf-8-sig").split("\n"))
    rows = [words for words in lines if words]
    header = _OFF_HEADER.fullmatch(" ".join(rows[0]))
    if not header:
        raise ValueError("no header")
    rows[:1] = [header[1].split()] if header[1] else []
    point_count, face_count = int(rows[0][0]), int(rows[0][1])
    if min(point_count, face_count) < 0 or len(rows) < 1 + point_count + face_count:
        raise ValueError("truncated")
    points = np.array([list(map(float, words[:3])) for words in rows[1 : 1 + point_count]])
    numbers = [list(map(int, words[: 1 + int(words[0])])) for words in rows[1 + point_count :][:face_count]]
    if any(len(row) != 1 + row[0] for row in numbers):
        raise ValueError("truncated")
    corners = np.array([number for row in numbers for number in row[1:]], np.int64)
    return Faces(points, corners, np.array([row[0] for row in numbers], np.int64))

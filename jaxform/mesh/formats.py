"""Mesh files of all formats to their faces: each by the reader that reads it right, within bounds of memory."""

from __future__ import annotations

import contextlib
import io
import os
import threading
import warnings
from collections.abc import Callable, Collection, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from jaxform.core import disk
from jaxform.core.errors import InputError, InputWarning
from jaxform.mesh import facets, gmsh, legacy_vtk, ply, solver_decks
from jaxform.mesh.facets import Faces
from jaxform.mesh.meshes import REEXPORT

FURTHER = (".inp", ".bdf", ".nas", ".fem", ".mesh")
"""Endings of other programs' input files: Abaqus' and CalculiX', Nastran's and OptiStruct's, Medit's."""
_GEOMETRY = (
    *(".step", ".stp", ".iges", ".igs", ".brep", ".x_t", ".x_b", ".sat", ".jt", ".dxf", ".dwg", ".3dm"),
    *(".sldprt", ".sldasm", ".ipt", ".iam", ".catpart", ".catproduct", ".prt", ".par", ".fcstd", ".f3d"),
)
"""Endings of what CAD programs write that is no mesh."""
_SCENES = (".3mf", ".amf", ".glb", ".gltf", ".dae", ".fbx", ".blend", ".wrl", ".x3d", ".3ds", ".usd", ".usdz")
"""Endings of what printers and renderers read."""
_ROOM, _ROOM_PER_BYTE = 500_000_000, 60  # of memory for meshio, beside what the process has
_limiting = threading.Lock()


def read_faces(path: Path, further: bool = False) -> Faces:
    """The faces that a mesh file has, of one of `meshes.FORMATS` or, on request, of `FURTHER`.

    Raises:
        InputError: The file is missing, too large, or no mesh of the format of its ending.
    """
    value = str(path)
    ending = path.suffix.lower()
    readers = _READERS | _FURTHER if further else _READERS
    if ending not in readers and not os.path.isdir(path):
        raise _unknown_format_error(ending, readers, value)
    content = disk.read_bytes(path, disk.MOST_MESH)
    if not content:
        raise InputError("is empty", REEXPORT, value=value)
    try:
        with _silence() as messages:
            faces = readers[ending](content, value)
    except InputError as error:
        raise replace(error, value=value) from None
    # meshio raises all kinds of errors on bad input, and exits; so do the readers, a few kinds.
    except (Exception, SystemExit):
        problem = f"is not a readable {ending[1:].upper()} file or is incomplete"
        raise InputError(problem, REEXPORT, value=value) from None
    for words in messages:
        warnings.warn(words.message, stacklevel=2)
    return faces


def _unknown_format_error(ending: str, readers: Collection[str], value: str) -> InputError:
    problem, remedy = "is not a known mesh format", f"use one of {', '.join(readers)}"
    if ending in _GEOMETRY:
        problem += ": the native geometry of a CAD program, which has no triangles"
        remedy = f"export the part as STL from the CAD program, or {remedy}"
    elif ending in _SCENES:
        problem += ": it holds parts with placements, colours and the like"
        remedy = f"export the part as STL from the program that wrote it, or {remedy}"
    return InputError(problem, remedy, value=value)


@contextlib.contextmanager
def _silence() -> Iterator[list[warnings.WarningMessage]]:
    """Nothing printed, no warning but ours; those it gives when it ends."""
    nowhere, ours = io.StringIO(), []
    with (
        contextlib.redirect_stdout(nowhere),
        contextlib.redirect_stderr(nowhere),
        warnings.catch_warnings(record=True) as caught,
        np.errstate(all="ignore"),
    ):
        warnings.simplefilter("ignore")
        warnings.simplefilter("always", InputWarning)
        yield ours
        ours += caught


@contextlib.contextmanager
def _limit_memory(extra: int) -> Iterator[None]:
    """Lets the process take so many bytes more, where the system can: meshio believes every number in a file."""
    try:
        import resource

        used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    except (ImportError, OSError, ValueError):
        yield
        return
    with _limiting:
        soft, hard = resource.getrlimit(resource.RLIMIT_AS)
        wanted = used + extra
        allowed = [limit for limit in (soft, hard) if limit != resource.RLIM_INFINITY]
        resource.setrlimit(resource.RLIMIT_AS, (min([wanted, *allowed]), hard))
        try:
            yield
        finally:
            resource.setrlimit(resource.RLIMIT_AS, (soft, hard))


def _meshio_reader(file_format: str) -> Callable[[bytes, str], Faces]:
    def read(content: bytes, name: str) -> Faces:
        import meshio

        with _limit_memory(_ROOM + _ROOM_PER_BYTE * len(content)):
            raw = meshio.read(name, file_format=file_format)
        if np.ndim(raw.points) != 2 or not len(raw.points):
            raise ValueError("no points")
        return _faces(raw)

    return read


def _faces(raw: Any) -> Faces:
    """Ignoring a face with curved sides would leave a hole; points, lines and solids may be ignored."""
    kept, corners, counts = [], [np.zeros(0, np.int64)], [np.zeros(0, np.int64)]
    for index, block in enumerate(raw.cells):
        if block.type in ("triangle", "quad") or block.type.startswith("polygon"):
            rows = np.asarray(block.data, dtype=np.int64)
            kept.append(index)
            corners.append(rows.reshape(-1))
            counts.append(np.full(len(rows), rows.shape[1]))
        elif block.type.startswith(("triangle", "quad")):
            raise InputError(f"has curved faces ({block.type})", "export it with straight triangles")
    if not kept:
        raise facets.missing_surface_error(solid=any(block.dim == 3 for block in raw.cells))
    data = {
        name: np.concatenate([np.asarray(blocks[index]) for index in kept])
        for name, blocks in raw.cell_data.items()
        if all(np.ndim(blocks[index]) == np.ndim(blocks[kept[0]]) for index in kept)
    }
    return Faces(raw.points, np.concatenate(corners), np.concatenate(counts), dict(raw.point_data), data)


_READERS: dict[str, Callable[[bytes, str], Faces]] = {
    ".stl": facets.read_stl,
    ".obj": facets.read_obj,
    ".off": facets.read_off,
    ".ply": ply.read_ply,
    ".vtk": legacy_vtk.read_vtk,
    ".vtu": _meshio_reader("vtu"),
    ".msh": gmsh.read_msh,
}
_FURTHER: dict[str, Callable[[bytes, str], Faces]] = {
    ".inp": solver_decks.read_inp,
    ".bdf": solver_decks.read_bdf,
    ".nas": solver_decks.read_bdf,
    ".fem": solver_decks.read_bdf,
    ".mesh": _meshio_reader("medit"),
}

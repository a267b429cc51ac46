"""Triangle meshes in and out, cleaned and examined, on the host: the only importer of meshio."""

from __future__ import annotations

import contextlib
import io
import math
import re
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from xml.sax.saxutils import quoteattr

import numpy as np
from numpy.typing import ArrayLike, NDArray

from jaxform import topology
from jaxform.errors import InputError

FORMATS = {".stl": "stl", ".obj": "obj", ".ply": "ply", ".vtu": "vtu", ".msh": "gmsh"}
WELD_TOLERANCE = 1e-9
"""Distance below which nodes are one, relative to the diagonal of the bounding box."""
REFERENCE = ("reference.x", "reference.y", "reference.z")
"""Fields of a mesh that was formed, as the components of its point data `reference`: initial positions [m]."""
DEGENERATE_HEIGHT = 1e-6
"""Height below which a triangle has no area, relative to its longest side: the noise of float32 files."""
_REEXPORT = "export it again as STL, OBJ, PLY, VTU or MSH"


@dataclass(frozen=True)
class Mesh:
    """A triangle mesh.

    Attributes:
        positions: Node positions [m], shape (n, 3), float64.
        triangles: Node indices of each triangle, right-hand rule, shape (m, 3), int32.
        fields: Scalars at the nodes by name, shape (n,), float64, in the units of the file.
    """

    positions: NDArray[np.float64]
    triangles: NDArray[np.int32]
    fields: dict[str, NDArray[np.float64]] = field(default_factory=dict)


def read_mesh(path: str | Path, *, scale: float = 1.0) -> Mesh:
    """The triangles of an STL, OBJ, PLY, VTU or MSH (Gmsh) file.

    Quadrilaterals and polygons are split in triangles, points, lines and solids are ignored.

    Args:
        path: The file; its ending tells the format.
        scale: Metres per unit of length of the file.

    Returns:
        Positions [m] of shape (n, 3), triangles of shape (m, 3) and the scalar point data as fields of shape
        (n,), nodes as the file has them (not welded).

    Raises:
        InputError: The file is missing or no mesh, has no triangles, coordinates that are not finite, or
            triangles of nodes that do not exist.
    """
    if not (np.isreal(scale) and np.isfinite(scale) and scale > 0):
        raise InputError("is not a positive number", "give the metres per unit of the file", key="scale", value=scale)
    path = Path(path)
    raw = _parse(path, _content(path))
    positions = _coordinates(path, raw.points, float(scale))
    triangles = _surface(path, raw.cells)
    if triangles.size and (triangles.min() < 0 or triangles.max() >= len(positions)):
        raise InputError("has triangles of nodes that do not exist", _REEXPORT, value=str(path))
    return Mesh(positions, triangles.astype(np.int32), _scalars(raw.point_data, len(positions)))


def weld(mesh: Mesh, tolerance: float | None = None) -> Mesh:
    """Merges coincident nodes and drops those that no triangle uses.

    Args:
        mesh: Any triangle mesh.
        tolerance: Distance [m] up to which nodes are one; by default 1e-9 of the bounding box's diagonal.

    Returns:
        The same triangles over the first node of each cluster, the order of the nodes kept.
    """
    if tolerance is None:
        tolerance = WELD_TOLERANCE * size(mesh.positions)
    from scipy.spatial import KDTree  # takes a tenth of a second to import

    # Exact copies first: an STL file has six of each node, and the search below lists pairs.
    unique, first, inverse = np.unique(mesh.positions, axis=0, return_index=True, return_inverse=True)
    pairs = KDTree(unique).query_pairs(tolerance, output_type="ndarray") if len(unique) else np.zeros((0, 2), int)
    cluster = topology.connected(pairs[:, 0], pairs[:, 1], len(unique)) if len(unique) else inverse
    leader = np.full(len(unique), len(mesh.positions), dtype=np.int64)
    np.minimum.at(leader, cluster, first)
    merged = leader[cluster[inverse.reshape(-1)]]
    return _used(mesh, merged[mesh.triangles])


def drop_degenerate(mesh: Mesh) -> tuple[Mesh, int]:
    """Drops triangles without area and copies of triangles, and the nodes that are then unused.

    Returns:
        The cleaned mesh, and how many triangles went.
    """
    bad = degenerate(mesh.positions, mesh.triangles)
    return _used(mesh, mesh.triangles[~bad]), int(bad.sum())


def degenerate(positions: NDArray[np.float64], triangles: NDArray[np.integer]) -> NDArray[np.bool_]:
    """Which triangles have a repeated node, (relative) no area, or the nodes of an earlier triangle.

    Args:
        positions: Node positions [m], shape (n, 3).
        triangles: Node indices, shape (m, 3).

    Returns:
        Mask of shape (m,).
    """
    # Scaled to the box, so that no unit of length makes the squares below overflow or vanish.
    corners = (positions / (size(positions) or 1.0))[triangles]
    sides = corners[:, [1, 2, 0]] - corners
    longest_squared = np.max(np.sum(sides**2, axis=2), axis=1, initial=0.0)
    doubled_area = np.linalg.norm(np.cross(sides[:, 0], sides[:, 1]), axis=1)
    ordered = np.sort(triangles, axis=1)
    repeated = (ordered[:, 0] == ordered[:, 1]) | (ordered[:, 1] == ordered[:, 2])
    copied = np.ones(len(triangles), dtype=bool)
    copied[np.unique(ordered, axis=0, return_index=True)[1]] = False
    return repeated | copied | (doubled_area <= DEGENERATE_HEIGHT * longest_squared)


def size(positions: NDArray[np.float64]) -> float:
    """Diagonal of the bounding box [m] of positions of shape (n, 3); 0 of no positions."""
    return math.hypot(*np.ptp(positions, axis=0)) if len(positions) else 0.0


def write_vtu(
    path: str | Path,
    positions: ArrayLike,
    triangles: ArrayLike,
    point_data: Mapping[str, ArrayLike] | None = None,
    cell_data: Mapping[str, ArrayLike] | None = None,
) -> None:
    """Writes a mesh with data as VTU, which ParaView and meshio open.

    Args:
        path: File to write, replaced if it is there.
        positions: Node positions [m], shape (n, 3).
        triangles: Node indices, shape (m, 3).
        point_data: Values at the nodes by name, shape (n,) or (n, k).
        cell_data: Values in the triangles by name, shape (m,) or (m, k).
    """
    import meshio

    mesh = meshio.Mesh(
        np.asarray(positions, dtype=np.float64),
        [("triangle", np.asarray(triangles, dtype=np.int64))],
        point_data={name: _plain(value) for name, value in (point_data or {}).items()},
        cell_data={name: [_plain(value)] for name, value in (cell_data or {}).items()},
    )
    meshio.write(str(path), mesh, file_format="vtu")


def write_pvd(path: str | Path, frames: Sequence[tuple[float, str]]) -> None:
    """Writes the list of frames that ParaView plays.

    Args:
        path: File to write, replaced if it is there.
        frames: Time [s] and file name of each frame, relative to the folder of `path`.
    """
    rows = [f'    <DataSet timestep="{float(time)!r}" file={quoteattr(name)}/>' for time, name in frames]
    lines = ['<?xml version="1.0"?>', '<VTKFile type="Collection" version="0.1">', "  <Collection>"]
    Path(path).write_text("\n".join([*lines, *rows, "  </Collection>", "</VTKFile>", ""]), encoding="utf-8")


def _used(mesh: Mesh, triangles: NDArray[np.integer]) -> Mesh:
    kept, renumbered = np.unique(triangles, return_inverse=True)
    kept = kept.astype(np.int64)
    fields = {name: value[kept] for name, value in mesh.fields.items()}
    return Mesh(mesh.positions[kept], renumbered.reshape(-1, 3).astype(np.int32), fields)


def _plain(value: ArrayLike) -> NDArray[Any]:
    array = np.asarray(value)
    return array.astype(np.int8) if array.dtype == bool else array


def _content(path: Path) -> bytes:
    value = str(path)
    if path.is_dir():
        raise InputError("is a folder, not a mesh file", "name the file in it", value=value)
    if path.suffix.lower() not in FORMATS:
        raise InputError("is of no known mesh format", f"use one of {', '.join(FORMATS)}", value=value)
    if not path.is_file():
        raise InputError("does not exist", "correct the path", value=value)
    try:
        return path.read_bytes()
    except OSError as error:
        raise InputError(f"cannot be read ({error.strerror})", "check its permissions", value=value) from None


def _parse(path: Path, content: bytes) -> Any:
    """What meshio makes of the file; it prints, warns, exits and raises all kinds of errors on bad input."""
    silence = io.StringIO()
    try:
        with (
            contextlib.redirect_stdout(silence),
            contextlib.redirect_stderr(silence),
            warnings.catch_warnings(),
            np.errstate(all="ignore"),
        ):
            warnings.simplefilter("ignore")
            import meshio

            source = _PREPARE[path.suffix.lower()](path, content)
            raw = meshio.read(source, file_format=FORMATS[path.suffix.lower()])
            _check_complete(path, content, raw)
            return raw
    except (Exception, SystemExit):
        kind = path.suffix[1:].upper()
        problem = "is empty" if not content else f"is not a readable {kind} file, or not all of it is there"
        raise InputError(problem, _REEXPORT, value=str(path)) from None


def _check_complete(path: Path, content: bytes, raw: Any) -> None:
    if np.ndim(raw.points) != 2 or not len(raw.points):
        raise ValueError("no points")
    # Of a truncated PLY file meshio reads what is left, without a word.
    if path.suffix.lower() == ".ply":
        faces, nodes = (re.search(rb"element %s (\d+)" % name, content) for name in (b"face", b"vertex"))
        if faces and nodes and (int(faces[1]), int(nodes[1])) != (sum(map(len, raw.cells)), len(raw.points)):
            raise ValueError("fewer elements than the header says")


def _whole_stl(path: Path, content: bytes) -> str:
    # A binary file says how long it is, an ascii file says where it ends.
    binary = len(content) >= 84 and len(content) == 84 + 50 * int.from_bytes(content[80:84], "little")
    if not binary and b"endsolid" not in content[-4096:]:
        raise ValueError("truncated")
    return str(path)


def _obj_faces(path: Path, content: bytes) -> io.StringIO:
    # Positions and faces only: meshio refuses files with more (or fewer) normals than nodes, and most have.
    text = content.decode("utf-8", errors="replace").replace("\\\n", " ")
    return io.StringIO("\n".join(line for line in map(str.strip, text.splitlines()) if line[:2] in ("v ", "f ")))


def _ply_header(path: Path, content: bytes) -> io.BytesIO:
    # Without its end meshio looks for it for ever; and it knows only one of the two names of the face list.
    head, end, body = content.partition(b"end_header")
    if not end:
        raise ValueError("no end of the header")
    return io.BytesIO(re.sub(rb"vertex_index\b", b"vertex_indices", head) + end + body)


def _whole_msh(path: Path, content: bytes) -> str:
    if b"$EndElements" not in content:
        raise ValueError("truncated")
    return str(path)


_PREPARE: dict[str, Callable[[Path, bytes], Any]] = {
    ".stl": _whole_stl,
    ".obj": _obj_faces,
    ".ply": _ply_header,
    ".vtu": lambda path, content: str(path),
    ".msh": _whole_msh,
}


def _coordinates(path: Path, points: Any, scale: float) -> NDArray[np.float64]:
    with np.errstate(all="ignore"):
        points = np.asarray(points, dtype=np.float64)[:, :3]
        positions = np.zeros((len(points), 3))
        positions[:, : points.shape[1]] = points * scale
    if not np.isfinite(positions).all():
        node = int(np.flatnonzero(~np.isfinite(positions).all(axis=1))[0])
        raise InputError(f"has coordinates that are not finite (node {node})", _REEXPORT, value=str(path))
    return positions


def _surface(path: Path, blocks: Any) -> NDArray[np.int64]:
    """The faces as triangles, shape (m, 3); ignoring a face with curved sides would leave a hole."""
    fans = [np.zeros((0, 3), np.int64)]
    for block in blocks:
        if block.type in ("triangle", "quad") or block.type.startswith("polygon"):
            corners = np.asarray(block.data, dtype=np.int64)
            fans += [corners[:, [0, k, k + 1]] for k in range(1, corners.shape[1] - 1)]
        elif block.type.startswith(("triangle", "quad")):
            raise InputError(f"has curved faces ({block.type})", "export it with straight triangles", value=str(path))
    triangles = np.concatenate(fans)
    if not len(triangles):
        raise InputError("has no triangles", "export the surface as triangles", value=str(path))
    return triangles


def _scalars(point_data: Mapping[str, Any], node_count: int) -> dict[str, NDArray[np.float64]]:
    arrays = {name: np.asarray(value) for name, value in point_data.items()}
    initial = arrays.get(REFERENCE[0].partition(".")[0])
    if initial is not None and initial.shape == (node_count, 3):
        arrays |= dict(zip(REFERENCE, initial.T, strict=True))
    arrays = {name: value.reshape(-1) for name, value in arrays.items() if value.size == node_count}
    with np.errstate(all="ignore"):
        return {name: value.astype(np.float64) for name, value in arrays.items() if value.dtype.kind in "biuf"}

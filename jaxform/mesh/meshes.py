"""Triangle meshes in and out: read, cleaned, cut into triangles, examined. On the host."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any
from xml.sax.saxutils import quoteattr

import numpy as np
from numpy.typing import ArrayLike, NDArray

from jaxform.core.errors import InputError
from jaxform.mesh import topology
from jaxform.mesh.topology import distinct_rows

Array = NDArray[np.float64]
Index = NDArray[np.int64]

FORMATS = (".stl", ".obj", ".ply", ".off", ".vtk", ".vtu", ".msh")
WELD_TOLERANCE = 1e-9
"""Distance below which nodes are one, relative to the diagonal of the bounding box."""
REEXPORT = "export it again as STL, OBJ, PLY, OFF, VTK, VTU or MSH"
"""The remedy for a file that cannot be read."""
REFERENCE = ("reference.x", "reference.y", "reference.z")
"""Fields of a mesh that was formed, as the components of its point data `reference`: initial positions [m]."""
DEGENERATE_HEIGHT = 1e-6
"""Height below which a triangle has no area, relative to its longest side: the noise of float32 files."""
LARGEST, SMALLEST = 1e6, 1e-9
"""Coordinates up to which, and a size [m] from which a mesh can be meant."""


@dataclass(frozen=True)
class Mesh:
    """A triangle mesh.

    Attributes:
        positions: Node positions [m], shape (n, 3), float64.
        triangles: Node indices of each triangle, right-hand rule, shape (m, 3), int32.
        fields: Scalars at the nodes by name, shape (n,), float64, in the units of the file.
        cell_fields: Scalars in the triangles by name, shape (m,), float64.
    """

    positions: NDArray[np.float64]
    triangles: NDArray[np.int32]
    fields: dict[str, NDArray[np.float64]] = field(default_factory=dict)
    cell_fields: dict[str, NDArray[np.float64]] = field(default_factory=dict)


def read_mesh(path: str | Path, *, scale: float = 1.0, further: bool = False) -> Mesh:
    """The triangles of an STL, OBJ, PLY, OFF, VTK (legacy), VTU or MSH (Gmsh) file.

    Quadrilaterals and polygons are split in triangles, points, lines and solids are ignored.

    Args:
        path: The file; its ending defines the format.
        scale: Metres per unit of length of the file.
        further: True if input files of other programs are read too: Abaqus' and CalculiX' INP, Nastran's BDF, NAS and
            FEM, Medit's MESH.

    Returns:
        Positions [m] of shape (n, 3), triangles of shape (m, 3), the scalar point data as fields of shape (n,) and
        the scalar cell data as cell fields of shape (m,); nodes as the file has them (not welded).

    Raises:
        InputError: The file is missing or no mesh, has no triangles, coordinates that are not finite or of no
            possible size, or triangles of nodes that do not exist.
    """
    from jaxform.mesh import facets, formats  # readers of all formats, which only files need

    if not (np.isreal(scale) and np.isfinite(scale) and scale > 0):
        raise InputError("is not a positive number", "give the metres per unit of the file", key="scale", value=scale)
    path = Path(path)
    faces = formats.read_faces(path, further)
    count = len(faces.points)
    if not (faces.counts >= 3).any():
        raise replace(facets.missing_surface_error(solid=False), value=str(path))
    if faces.corners.size and (faces.corners.min() < 0 or faces.corners.max() >= count):
        raise InputError("has triangles of nodes that do not exist", REEXPORT, value=str(path))
    positions = _finite(path, faces.points, np.unique(faces.corners), float(scale))
    try:
        triangles, owner = split(positions, faces.corners, faces.counts)
    except InputError as error:
        raise replace(error, value=str(path)) from None
    cells = {name: values[owner] for name, values in _scalars(faces.cell_data, len(faces.counts)).items()}
    return Mesh(positions, triangles.astype(np.int32), _scalars(faces.point_data, count), cells)


def merge(parts: Sequence[Mesh]) -> Mesh:
    """Several meshes as one, without their fields; nodes are not welded."""
    starts = np.cumsum([0, *(len(part.positions) for part in parts)])
    triangles = [part.triangles + start for part, start in zip(parts, starts, strict=False)]
    return Mesh(np.concatenate([part.positions for part in parts]), np.concatenate(triangles).astype(np.int32))


def nodal_fields(mesh: Mesh) -> dict[str, NDArray[np.float64]]:
    """The fields at the nodes (n,), and where only the triangles have one, its mean over those around by area.

    Nodes that no triangle with an area uses get NaN from the triangles.
    """
    corners = mesh.positions[mesh.triangles]
    doubled = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    count, weight = len(mesh.positions), np.repeat(doubled / (doubled.max(initial=0.0) or 1.0), 3)

    def sum_to_nodes(values: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.bincount(mesh.triangles.reshape(-1), values, count)

    with np.errstate(all="ignore"):
        found = {
            name: sum_to_nodes(weight * np.repeat(x, 3)) / sum_to_nodes(weight) for name, x in mesh.cell_fields.items()
        }
    return found | mesh.fields


def box_sides(mesh: Mesh) -> NDArray[np.float64]:
    """Sides of the bounding box of a mesh (3,) [m], of the nodes that it uses."""
    return np.ptp(mesh.positions[np.unique(mesh.triangles)], axis=0)


def mirror_image(points: ArrayLike, axis: int, level: float) -> Array:
    """The image of points (..., 3) [m] in the plane across an axis, 0 to 2 for x to z, at a place [m] along it."""
    image = np.array(points)
    image[..., axis] = 2.0 * level - image[..., axis]
    return image


def weld(mesh: Mesh, tolerance: float | None = None) -> Mesh:
    """Merges coincident nodes and drops unused ones.

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
    unique, first, inverse, _ = distinct_rows(mesh.positions)
    pairs = KDTree(unique).query_pairs(tolerance, output_type="ndarray") if len(unique) else np.zeros((0, 2), int)
    cluster = topology.connected_parts(pairs[:, 0], pairs[:, 1], len(unique)) if len(unique) else inverse
    leader = np.full(len(unique), len(mesh.positions), dtype=np.int64)
    np.minimum.at(leader, cluster, first)
    return drop_unused_nodes(replace(mesh, triangles=leader[cluster[inverse]][mesh.triangles]))


def drop_degenerate(mesh: Mesh) -> tuple[Mesh, int]:
    """Drops triangles without area and copies of triangles, and the nodes that are then unused.

    Returns:
        The cleaned mesh, and the number of dropped triangles.
    """
    bad = find_degenerate(mesh.positions, mesh.triangles)
    cells = {name: value[~bad] for name, value in mesh.cell_fields.items()}
    return drop_unused_nodes(replace(mesh, triangles=mesh.triangles[~bad], cell_fields=cells)), int(bad.sum())


def find_degenerate(positions: NDArray[np.float64], triangles: NDArray[np.integer]) -> NDArray[np.bool_]:
    """Finds the triangles with a repeated node, (relatively) no area, or the nodes of an earlier triangle.

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
    copied[distinct_rows(ordered)[1]] = False
    return repeated | copied | (doubled_area <= DEGENERATE_HEIGHT * longest_squared)


def drop_fins(mesh: Mesh) -> Mesh:
    """Drops fins of a welded surface: two triangles of the same nodes, back to back, on an edge of two others.

    Programs that make a mesh coarser leave them. `drop_degenerate` would leave one of the two, and the surface no
    longer closed. A surface of which all triangles are given from both sides remains.
    """
    triangles = mesh.triangles
    _, _, same, count = distinct_rows(np.sort(triangles, axis=1))
    turned = triangles[np.arange(len(triangles))[:, None], (np.argmin(triangles, axis=1)[:, None] + [0, 1, 2]) % 3]
    signs = np.where(turned[:, 1] < turned[:, 2], 1, -1)
    paired = (count[same] == 2) & (np.bincount(same, signs)[same] == 0)
    if not paired.any():
        return mesh
    sides = np.sort(triangles[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    _, _, edge, _ = distinct_rows(sides)
    # Fins that hang together are dropped together, where one of them stands on two other triangles.
    of_pair = edge.reshape(-1, 3)[paired]
    others = np.bincount(edge, np.repeat(~paired, 3))
    part = topology.connected_parts(of_pair[:, [0, 0]].ravel(), of_pair[:, [1, 2]].ravel(), len(others))
    stands = np.zeros(part.max() + 1, bool)
    stands[part[of_pair[others[of_pair] >= 2.0]]] = True
    paired[paired] = stands[part[of_pair[:, 0]]]
    return drop_unused_nodes(replace(mesh, triangles=triangles[~paired]))


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


def write_stl(path: str | Path, positions: ArrayLike, triangles: ArrayLike) -> None:
    """Writes a surface as binary STL, in metres and single precision, which CAD and slicers open.

    Args:
        path: File to write, replaced if it is there.
        positions: Node positions [m], shape (n, 3).
        triangles: Node indices, shape (m, 3).
    """
    corners = np.asarray(positions, np.float64)[np.asarray(triangles)]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    length = np.linalg.norm(normal, axis=1, keepdims=True)
    facets = np.zeros(len(corners), [("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("spare", "<u2")])
    facets["normal"], facets["corners"] = normal / np.where(length > 0, length, 1.0), corners
    head = b"jaxform, metres".ljust(80)
    Path(path).write_bytes(head + len(facets).to_bytes(4, "little") + facets.tobytes())


def write_pvd(path: str | Path, frames: Sequence[tuple[float, str]], *beside: Sequence[tuple[float, str]]) -> None:
    """Writes the list of frames that ParaView plays.

    Args:
        path: File to write, replaced if it is there.
        frames: Time [s] and file name of each frame, relative to the folder of `path`.
        beside: Times [s] and file names of what is shown beside the frames, such as moving tools: a list for each.
    """
    rows = [
        f'    <DataSet timestep="{float(time)!r}"{part} file={quoteattr(name)}/>'
        for part, shown in [("", frames), *((f' part="{number}"', each) for number, each in enumerate(beside, 1))]
        for time, name in shown
    ]
    lines = ['<?xml version="1.0"?>', '<VTKFile type="Collection" version="0.1">', "  <Collection>"]
    Path(path).write_text("\n".join([*lines, *rows, "  </Collection>", "</VTKFile>", ""]), encoding="utf-8")


def drop_unused_nodes(mesh: Mesh) -> Mesh:
    """The mesh without the nodes that no triangle uses."""
    kept, renumbered = np.unique(mesh.triangles, return_inverse=True)
    kept = kept.astype(np.int64)
    fields = {name: value[kept] for name, value in mesh.fields.items()}
    return Mesh(mesh.positions[kept], renumbered.reshape(-1, 3).astype(np.int32), fields, mesh.cell_fields)


def _plain(value: ArrayLike) -> NDArray[Any]:
    array = np.asarray(value)
    return array.astype(np.int8) if array.dtype == bool else array


def _finite(path: Path, points: Any, used: NDArray[np.int64], scale: float) -> NDArray[np.float64]:
    """Positions [m] (n, 3); nodes that nothing uses may be anywhere, and those that are nowhere are put at 0."""
    value = str(path)
    with np.errstate(all="ignore"):
        points = np.asarray(points, dtype=np.float64)[:, :3]
        positions = np.zeros((len(points), 3))
        positions[:, : points.shape[1]] = points * scale
    found = positions[used]
    if not np.isfinite(found).all():
        node = int(used[~np.isfinite(found).all(axis=1)][0])
        raise InputError(f"has coordinates that are not finite (node {node})", REEXPORT, value=value)
    largest, extent = float(np.abs(found).max()), size(found)
    if largest > LARGEST:
        problem = f"has coordinates of up to {largest:.3g} m"
        raise InputError(problem, f"give a scale that keeps them under {LARGEST:g} m", value=value)
    if extent < SMALLEST:
        problem = f"is {extent:.3g} m large"
        raise InputError(problem, f"give a scale that makes it larger than {SMALLEST:g} m", value=value)
    return np.where(np.isfinite(positions), positions, 0.0)


def _scalars(data: Mapping[str, Any], count: int) -> dict[str, NDArray[np.float64]]:
    arrays = {name: np.asarray(value) for name, value in data.items()}
    initial = arrays.get(REFERENCE[0].partition(".")[0])
    if initial is not None and initial.shape == (count, 3):
        arrays |= dict(zip(REFERENCE, initial.T, strict=True))
    arrays = {name: value.reshape(-1) for name, value in arrays.items() if value.size == count}
    with np.errstate(all="ignore"):
        return {name: value.astype(np.float64) for name, value in arrays.items() if value.dtype.kind in "biuf"}


# Faces with any number of corners, cut in triangles that cover them once; on the host.

_MOST_CORNERS = 2000  # of a face that no fan covers: the search for ears takes time with their square
_FLAT = 1e-9  # a triangle's area, relative to its face's, down to which it may point the wrong way


def split(positions: Array, corners: Index, counts: Index) -> tuple[Index, Index]:
    """Cuts faces in triangles: fans where one covers the face (all convex faces), ears where none does.

    Args:
        positions: Node positions, shape (n, 3).
        corners: The node indices of all faces, one face after the other, shape (counts.sum(),).
        counts: Corners of each face, shape (f,); faces of fewer than three are left out.

    Returns:
        Triangles in the order of the faces and turning as they do, shape (m, 3), and the face of each, shape (m,).

    Raises:
        InputError: A face with very many corners is not convex.
    """
    start = np.cumsum(counts) - counts
    triangles: list[Index] = [np.zeros((0, 3), np.int64)]
    owner: list[Index] = [np.zeros(0, np.int64)]
    for count in np.unique(counts[counts >= 3]):
        face = np.flatnonzero(counts == count)
        fans = _triangulate_faces(positions, corners[start[face, None] + np.arange(count)])
        triangles.append(fans.reshape(-1, 3))
        owner.append(np.repeat(face, count - 2))
    joined = np.concatenate(owner)
    order = np.argsort(joined, kind="stable")
    return np.concatenate(triangles)[order], joined[order]


def _triangulate_faces(positions: Array, faces: Index) -> Index:
    """The triangles (f, k - 2, 3) of faces (f, k)."""
    fans = _fan(faces)
    if faces.shape[1] == 3:
        return fans
    # Scaled to the box of the faces, so that no unit of length makes the products overflow or vanish.
    used = positions[faces]
    scaled = (used - used.min((0, 1))) / (np.ptp(used, axis=(0, 1)).max() or 1.0)
    for index in np.flatnonzero(~_fan_covers(scaled, np.broadcast_to(_fan(_numbers(faces)), fans.shape))):
        fans[index] = faces[index][_triangulate_face(scaled[index])]
    return fans


def _numbers(faces: Index) -> Index:
    return np.arange(faces.shape[1])[None]


def _fan(faces: Index) -> Index:
    """Triangles (f, k - 2, 3) from the first corner of each face (f, k)."""
    count = faces.shape[1]
    second = np.arange(1, count - 1)
    return faces[:, np.stack([np.zeros_like(second), second, second + 1], axis=1)]


def _fan_covers(corners: Array, triangles: Index) -> NDArray[np.bool_]:
    """True for faces with corners (f, k, 3) of whose triangles (f, t, 3) none has the opposite orientation."""
    points = np.take_along_axis(corners[:, :, None], triangles.reshape(len(corners), -1)[..., None, None], axis=1)
    points = points.reshape(*triangles.shape, 3)
    normal = np.cross(points[:, :, 1] - points[:, :, 0], points[:, :, 2] - points[:, :, 0])
    # The sum is the face's own, twice its area, whichever triangles it is cut in.
    whole = normal.sum(axis=1)
    along = np.einsum("ftx,fx->ft", normal, whole)
    return (along >= -_FLAT * np.einsum("fx,fx->f", whole, whole)[:, None]).all(axis=1)


def _triangulate_face(corners: Array) -> Index:
    """Triangles (k - 2, 3) of a face with corners (k, 3) that a fan from the first corner does not cover."""
    count = len(corners)
    if count > _MOST_CORNERS:
        raise InputError(f"has a face with {count} corners that is not convex", "export the surface as triangles")
    for first in range(1, count):
        fan = _fan((first + np.arange(count)[None]) % count)
        if _fan_covers(corners[None], fan)[0]:
            return fan[0]
    return _ears(_project(corners))


def _project(corners: Array) -> Array:
    """Corners (k, 2) in the plane of the face, turning to the left."""
    normal = np.cross(corners, np.roll(corners, -1, axis=0)).sum(axis=0)
    axis = int(np.argmax(np.abs(normal)))
    plane = corners[:, [(axis + 1) % 3, (axis + 2) % 3]]
    return plane if normal[axis] >= 0 else plane[:, ::-1]


def _ears(plane: Array) -> Index:
    """Triangles (k - 2, 3) of a simple polygon (k, 2): cuts off the corner whose triangle holds no other corner."""
    left, triangles = list(range(len(plane))), []
    while len(left) > 3:
        place = next((k for k in range(len(left)) if _is_ear(plane, left, k)), 0)
        triangles.append([left[place - 1], left[place], left[(place + 1) % len(left)]])
        del left[place]
    return np.array([*triangles, left])


def _is_ear(plane: Array, left: list[int], place: int) -> bool:
    ends = left[place - 1], left[place], left[(place + 1) % len(left)]
    a, b, c = plane[list(ends)]
    if _turn(a, b, c) <= 0:
        return False
    others = plane[[k for k in left if k not in ends]]
    # Corners that lie on those of the ear, where a hole was joined to the rim, do not stand in the way.
    others = others[~(others[:, None] == plane[list(ends)]).all(axis=2).any(axis=1)]
    inside = (_turn(a, b, others) >= 0) & (_turn(b, c, others) >= 0) & (_turn(c, a, others) >= 0)
    return not inside.any()


def _turn(a: Array, b: Array, c: Array) -> Array:
    """Twice the area of the triangles a, b, c: above 0 where they turn to the left."""
    return (b[..., 0] - a[..., 0]) * (c[..., 1] - a[..., 1]) - (b[..., 1] - a[..., 1]) * (c[..., 0] - a[..., 0])

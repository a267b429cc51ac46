"""The wall of a formed part as other programs take it: a surface with a thickness at its nodes, read from results."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from jaxform.core import disk, release
from jaxform.core.errors import InputError, warn_of
from jaxform.io import previous_results
from jaxform.mesh import meshes, topology
from jaxform.mesh.meshes import Mesh
from jaxform.mesh.volumes import add_fold_volume, areas, conserve_volume

Array = NDArray[np.float64]
Index = NDArray[np.integer]

_ON_PLANE = 1e-6  # of the part's size, as parisons from a file have it
_AT_END = 1e-3  # the same of its ends
_NO_RESULTS = "name a folder that `jaxform simulate` or `jaxform optimize` wrote"


@dataclass(frozen=True)
class WallSurface:
    """A wall as a surface of triangles.

    Attributes:
        positions: Positions of the nodes [m], shape (n, 3).
        triangles: Node numbers from 0, shape (m, 3).
        thickness: Thickness at the nodes [m], shape (n,), linear between them: area times thickness is the volume of
            the wall.
        element_thickness: Thickness of the triangles [m], shape (m,), with the same volume.
        reference: Position of each node in the initial sheet [m], shape (n, 3).
        held: Mask of the nodes (n,) that were clamped, or in contact with the mold from the start.
        planes: Axis and place [m] of the symmetry planes at which the part is cut.
        words: Description of the wall, line by line, for the head of a file.
    """

    positions: Array
    triangles: Index
    thickness: Array
    element_thickness: Array
    reference: Array
    held: NDArray[np.bool_]
    planes: Mapping[int, float] = field(default_factory=dict)
    words: tuple[str, ...] = ()

    @property
    def volume(self) -> float:
        """Area times nodal thickness [m^3]."""
        return float(areas(self.positions, self.triangles) @ self.thickness[self.triangles].mean(1))

    def node_sets(self) -> dict[str, Index]:
        """The nodes of all sets that are not empty: those of `edge_sets`, then those of `end_sets`."""
        return self.edge_sets() | end_sets(self.positions)

    def edge_sets(self) -> dict[str, Index]:
        """The nodes of the rim that was clamped, RIM, and on symmetry planes, SYM_X, SYM_Y, SYM_Z; none empty."""
        edge = topology.boundary_edges(self.triangles)
        tolerance = _ON_PLANE * meshes.size(self.positions)
        found, cut = {}, np.zeros(len(edge), bool)
        for axis, level in self.planes.items():
            here = (np.abs(self.positions[edge, axis] - level) <= tolerance).all(axis=1)
            found[f"SYM_{'XYZ'[axis]}"] = np.unique(edge[here])
            cut |= here
        rim = np.unique(edge[~cut])
        return {name: nodes for name, nodes in {"RIM": rim[self.held[rim]], **found}.items() if len(nodes)}


def read_wall(folder: Path, whole: bool = False) -> WallSurface:
    """The wall that a run or a search left in a folder: of the part, where the scene says which that is.

    Args:
        folder: Folder of the results.
        whole: Take the whole sheet instead.

    Raises:
        InputError: The folder has no results, or they are damaged.

    Warns:
        InputWarning: The run was stopped before its end, or some of the wall lies in folds.
    """
    path = folder / "final.vtu"
    if not disk.is_file(path):
        raise InputError("has no final.vtu", _NO_RESULTS, value=str(folder))
    summary = previous_results.read_summary(folder)
    mesh = meshes.read_mesh(path)
    if not whole:
        mesh = _part(mesh)
    try:
        nodal = _positive(mesh.fields, "thickness")
        # Older files, or those of other programs, may lack data of the elements.
        known = "thickness" in mesh.cell_fields
        elements = _positive(mesh.cell_fields, "thickness") if known else nodal[mesh.triangles].mean(1)
        elements = add_fold_volume(mesh, elements, str(path))
    except InputError as error:
        raise error.with_context(file=str(path)) from None
    status = summary.get("status", "ok")
    if status != "ok":
        warn_of(f"the run did not complete: {status}", "the wall is the one at that time", file=str(folder))
    return WallSurface(
        mesh.positions,
        mesh.triangles,
        conserve_volume(mesh.positions, mesh.triangles, nodal, elements),
        elements,
        _reference(mesh),
        mesh.fields.get("contact_time", np.zeros(len(mesh.positions))) == 0.0,
        previous_results.symmetry_planes(summary),
        (f"wall of {summary.get('scene', 'a formed part')}, exported by jaxform {release.version()}",),
    )


def _part(mesh: Mesh) -> Mesh:
    """The elements of the part, and their nodes; the mesh unchanged where it does not mark them, or marks none."""
    in_part = mesh.cell_fields.get("part", np.zeros(0)) != 0
    if not in_part.any() or in_part.all():
        return mesh
    nodes, triangles = np.unique(mesh.triangles[in_part], return_inverse=True)
    fields = {name: values[nodes] for name, values in mesh.fields.items()}
    cells = {name: values[in_part] for name, values in mesh.cell_fields.items()}
    return replace(
        mesh,
        positions=mesh.positions[nodes],
        triangles=triangles.reshape(-1, 3).astype(mesh.triangles.dtype),
        fields=fields,
        cell_fields=cells,
    )


def _positive(fields: Mapping[str, Array], name: str) -> Array:
    if name not in fields:
        known = ", ".join(sorted(fields)) or "none"
        raise InputError(f"has no field {name} (its fields: {known})", _NO_RESULTS)
    values = fields[name]
    if not (np.isfinite(values) & (values > 0)).all():
        raise InputError(f"has a {name} that is not a positive number", "run the scene again")
    return values


def _reference(mesh: Mesh) -> Array:
    if all(name in mesh.fields for name in meshes.REFERENCE):
        return np.stack([mesh.fields[name] for name in meshes.REFERENCE], axis=1)
    return mesh.positions


def end_sets(positions: Array) -> dict[str, Index]:
    """The nodes at the ends of a part along each axis, MIN_X to MAX_Z, to within a thousandth of its size."""
    near, found = _AT_END * meshes.size(positions), {}
    for axis, name in enumerate("XYZ"):
        along = positions[:, axis]
        found[f"MIN_{name}"] = np.flatnonzero(along <= along.min() + near)
        found[f"MAX_{name}"] = np.flatnonzero(along >= along.max() - near)
    return found


def mirror(wall: WallSurface, axis: int, level: float) -> WallSurface:
    """The wall and its image in a plane, joined there.

    Raises:
        InputError: No node lies on the plane, or there are some on both sides.
    """
    away, tolerance = wall.positions[:, axis] - level, _ON_PLANE * meshes.size(wall.positions)
    on = np.abs(away) <= tolerance
    name, value = "--mirror", f"{'xyz'[axis]}={level:g}"
    if not on.any():
        raise InputError("no node of the part lies on this plane", "name the plane that it is cut at", name, value)
    if away.min() < -tolerance and away.max() > tolerance:
        raise InputError("the part lies on both sides of this plane", "mirror a part that is cut there", name, value)
    count = len(away)
    image = np.where(on, np.arange(count), count - 1 + np.cumsum(~on))

    def reflect(points: Array, place: float | Array) -> Array:
        points = points.copy()
        points[:, axis] = 2.0 * place - points[:, axis]
        return points[~on]

    positions = wall.positions.copy()
    positions[on, axis] = level
    planes = {key: place for key, place in wall.planes.items() if key != axis}
    return replace(
        wall,
        positions=np.concatenate([positions, reflect(positions, level)]),
        # Turned, so that all normals agree.
        triangles=np.concatenate([wall.triangles, image[wall.triangles][:, [0, 2, 1]]]),
        thickness=np.concatenate([wall.thickness, wall.thickness[~on]]),
        element_thickness=np.tile(wall.element_thickness, 2),
        reference=np.concatenate([wall.reference, reflect(wall.reference, level)]),
        held=np.concatenate([wall.held, wall.held[~on]]),
        planes=planes,
        words=(*wall.words, f"with its image in the plane {value} m"),
    )

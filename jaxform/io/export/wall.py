"""The wall of a formed part as other programs take it: a surface with a thickness at its nodes, read from results."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from jaxform.core import disk, installation
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
        (f"wall of {summary.get('scene', 'a formed part')}, exported by jaxform {installation.version()}",),
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

    positions = wall.positions.copy()
    positions[on, axis] = level
    planes = {key: place for key, place in wall.planes.items() if key != axis}
    return replace(
        wall,
        positions=np.concatenate([positions, meshes.mirror_image(positions[~on], axis, level)]),
        # Turned, so that all normals agree.
        triangles=np.concatenate([wall.triangles, image[wall.triangles][:, [0, 2, 1]]]),
        thickness=np.concatenate([wall.thickness, wall.thickness[~on]]),
        element_thickness=np.tile(wall.element_thickness, 2),
        reference=np.concatenate([wall.reference, meshes.mirror_image(wall.reference[~on], axis, level)]),
        held=np.concatenate([wall.held, wall.held[~on]]),
        planes=planes,
        words=(*wall.words, f"with its image in the plane {value} m"),
    )


# Writers of walls, a function for each format, and the head and rows that the text formats share.


def head(wall: WallSurface, middles: int = 0) -> list[str]:
    """Lines that describe the content of a file, without the marks of comments.

    Args:
        wall: The wall that is written.
        middles: Number of mid-side nodes in the file, besides those of the wall.
    """
    low, high = (1e3 * float(value) for value in (wall.thickness.min(), wall.thickness.max()))
    # Names of scenes and files may have any characters; solvers read comments in one line and ASCII.
    words = [" ".join(line.encode("ascii", "backslashreplace").decode().split()) for line in wall.words]
    between = f" and {middles} in the middles of sides" if middles else ""
    return [
        *("".join(filter(str.isprintable, line)) for line in words),
        "Units: SI (m, kg, s, N, Pa); thickness in m",
        f"{len(wall.positions)} nodes{between}, {len(wall.triangles)} triangles, {low:.4g} to {high:.4g} mm thick, "
        f"volume {wall.volume:.6g} m3",
    ]


def _rows(numbers: NDArray[np.integer], many: int, form: str, between: str = "") -> Iterator[str]:
    """Numbers as text, so many in a row, each in a form such as `%10d`."""
    for start in range(0, len(numbers), many):
        yield between.join(form % number for number in numbers[start : start + many])


def _table(form: str, *columns: NDArray[np.generic]) -> Iterator[str]:
    """A row of text for each row of columns (n,) or (n, k)."""
    flat = [part for column in columns for part in np.atleast_2d(column.T)]
    for values in zip(*(column.tolist() for column in flat), strict=True):
        yield form % values


MATERIAL = "WALL"
"""Name of the section's material, which the file that includes this one defines."""


def write_abaqus(path: Path, wall: WallSurface) -> None:
    """Writes the wall for Abaqus: S3, ELSET and material WALL, NSET NODES and those of the wall."""
    sections = _keywords(wall, "S3", wall.triangles, wall.positions, wall.thickness, wall.node_sets(), ", 5")
    path.write_text("\n".join(sections) + "\n", encoding="utf-8")


def _keywords(
    wall: WallSurface,
    kind: str,
    elements: NDArray[np.integer],
    positions: NDArray[np.float64],
    thickness: NDArray[np.float64],
    sets: Mapping[str, NDArray[np.integer]],
    more: str = "",
) -> Iterator[str]:
    """Lines of an input file.

    Args:
        wall: The wall that the head describes.
        kind: Type of the elements, such as `S3`.
        elements: Node numbers from 0 (m, k).
        positions: Positions of the nodes (n, 3) [m].
        thickness: Thickness at the nodes (n,) [m].
        sets: Node numbers by name.
        more: Text after the thickness in the section's line.
    """
    number = np.arange(1, len(positions) + 1)
    yield from (f"** {line}" for line in head(wall, len(positions) - len(wall.positions)))
    yield f"** Sets: NSET {', '.join(['NODES', *sets])}; ELSET WALL. Define *MATERIAL, NAME={MATERIAL} yourself."
    yield "*NODE, NSET=NODES"
    yield from _table("%d, %.10g, %.10g, %.10g", number, positions)
    yield f"*ELEMENT, TYPE={kind}, ELSET=WALL"
    form = ", ".join(["%d"] * (1 + elements.shape[1]))
    yield from _table(form, np.arange(1, len(elements) + 1), elements + 1)
    for name, nodes in sets.items():
        yield f"*NSET, NSET={name}"
        yield from _rows(nodes + 1, 8, "%d", ", ")
    yield f"*SHELL SECTION, ELSET=WALL, MATERIAL={MATERIAL}, NODAL THICKNESS"
    yield f"{thickness.mean():.6g}{more}"
    yield "*NODAL THICKNESS"
    yield from _table("%d, %.8g", number, thickness)


def write_calculix(path: Path, wall: WallSurface) -> None:
    """Writes the wall for CalculiX: S6, ELSET and material WALL, NSET NODES and those of the wall.

    CalculiX makes wedges of its shells. Those of S3 have straight sides alone and bend three to four times too stiffly
    (measured at a strip of ten elements), those of S6 bend right; so every side gets a node in its middle.
    """
    edge, _ = topology.edges(wall.triangles)
    count = len(wall.positions)
    side = np.sort(np.stack([wall.triangles, np.roll(wall.triangles, -1, axis=1)], axis=2), axis=2)
    base = np.array([count, 1], np.int64)
    middle = count + np.searchsorted(edge @ base, side.astype(np.int64) @ base)
    rim = np.isin(edge @ base, topology.boundary_edges(wall.triangles) @ base)
    positions = np.concatenate([wall.positions, wall.positions[edge].mean(1)])
    sets = {
        name: np.concatenate([nodes, count + np.flatnonzero(rim & np.isin(edge, nodes).all(axis=1))])
        for name, nodes in wall.edge_sets().items()
    }
    lines = _keywords(
        wall,
        "S6",
        np.concatenate([wall.triangles, middle], axis=1),
        positions,
        np.concatenate([wall.thickness, wall.thickness[edge].mean(1)]),
        sets | end_sets(positions),
    )
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")


def write_radioss(path: Path, wall: WallSurface) -> None:
    """Writes the wall for Radioss, block format: /PART/1 with /PROP/SHELL/1 and /MAT/.../1, a /GRNOD for each set."""
    path.write_text("\n".join(_radioss_blocks(wall)) + "\n", encoding="utf-8")


def _radioss_blocks(wall: WallSurface) -> Iterator[str]:
    number, sets = np.arange(1, len(wall.positions) + 1), wall.node_sets()
    yield "#RADIOSS STARTER"
    yield from (f"# {line}" for line in head(wall))
    yield "# Part 1 (wall) has property 1 and material 1: define /MAT/.../1 yourself."
    yield "/NODE"
    yield from _table("%10d%20.12g%20.12g%20.12g", number, wall.positions)
    yield from ("/PART/1", "wall", f"{1:10d}{1:10d}{0:10d}")
    yield from ("/PROP/SHELL/1", "wall", *_radioss_property(float(wall.element_thickness.mean())))
    yield "/SH3N/1"
    yield "#  sh3n_ID  node_ID1  node_ID2  node_ID3" + f"{'Phi':>40}{'Thick':>20}"
    form = "%10d%10d%10d%10d" + 20 * " " + f"{0:20d}" + "%20.10g"
    yield from _table(form, np.arange(1, len(wall.triangles) + 1), wall.triangles + 1, wall.element_thickness)
    for place, (name, nodes) in enumerate(sets.items(), start=1):
        yield from (f"/GRNOD/NODE/{place}", name)
        yield from _rows(nodes + 1, 10, "%10d")


def _radioss_property(thickness: float) -> list[str]:
    """Cards of a shell property: all flags as Radioss chooses them, five points through the thickness."""
    zero = f"{0:10d}"
    return [
        "#   Ishell    Ismstr     Ish3n    Idrill",
        4 * zero,
        f"#{'hm':>19}{'hf':>20}{'hr':>20}{'dm':>20}{'dn':>20}",
        5 * f"{0:20d}",
        f"#{'N':>9}{'Istrain':>10}{'Thick':>20}{'Ashear':>20}{'Ithick':>20}{'Iplas':>10}",
        f"{5:10d}{zero}{thickness:20.10g}{0:20d}{'':10}{zero}{zero}",
    ]


COLUMNS = "x_m,y_m,z_m,thickness_m,reference_x_m,reference_y_m,reference_z_m"
"""The first row; every column in m."""


def write_csv(path: Path, wall: WallSurface) -> None:
    """Writes a row per node: place, thickness, and place in the initial sheet."""
    form = ",".join(["%.10g"] * 7)
    lines = [COLUMNS, *_table(form, wall.positions, wall.thickness, wall.reference)]
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")


def write_vtu(path: Path, wall: WallSurface) -> None:
    """Writes point data `thickness` and `reference` [m], cell data `thickness`, and a mark (0 or 1) for each set."""
    marks = {}
    for name, nodes in wall.node_sets().items():
        marks[name] = np.zeros(len(wall.positions), np.int8)
        marks[name][nodes] = 1
    data = {"thickness": wall.thickness, "reference": wall.reference, **marks}
    meshes.write_vtu(path, wall.positions, wall.triangles, data, {"thickness": wall.element_thickness})
    first, _, rest = path.read_bytes().partition(b"\n")
    # No two dashes may follow each other in a comment.
    said = "".join(f"<!-- {re.sub('-(?=-)', '- ', line)} -->\n" for line in head(wall))
    path.write_bytes(first + b"\n" + said.encode() + rest)

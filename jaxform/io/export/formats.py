"""Writers of walls, a function for each format, and the head and rows that the text formats share.

Abaqus and CalculiX get shells with nodal thickness, Radioss shells with a thickness each: files to be included in one
that has material and steps. VTU is for ParaView, meshio and all that read it, CSV for spreadsheets.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from jaxform.io.export.wall import WallSurface, end_sets
from jaxform.mesh import meshes, topology


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

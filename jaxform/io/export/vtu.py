"""VTU: the wall for ParaView, meshio and all that read it."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from jaxform.io.export import text
from jaxform.io.export.wall import WallSurface
from jaxform.mesh import meshes


def write(path: Path, wall: WallSurface) -> None:
    """Writes point data `thickness` and `reference` [m], cell data `thickness`, and a mark (0 or 1) for each set."""
    marks = {}
    for name, nodes in wall.node_sets().items():
        marks[name] = np.zeros(len(wall.positions), np.int8)
        marks[name][nodes] = 1
    data = {"thickness": wall.thickness, "reference": wall.reference, **marks}
    meshes.write_vtu(path, wall.positions, wall.triangles, data, {"thickness": wall.element_thickness})
    first, _, rest = path.read_bytes().partition(b"\n")
    # No two dashes may follow each other in a comment.
    said = "".join(f"<!-- {re.sub('-(?=-)', '- ', line)} -->\n" for line in text.head(wall))
    path.write_bytes(first + b"\n" + said.encode() + rest)

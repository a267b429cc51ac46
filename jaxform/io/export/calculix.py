"""CalculiX: six-node shells with nodal thickness, to be included in an input file that has material and steps.

CalculiX makes wedges of its shells. Those of S3 have straight sides alone and bend three to four times too stiffly
(measured at a strip of ten elements), those of S6 bend right; so every side gets a node in its middle.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from jaxform.io.export import abaqus
from jaxform.io.export.wall import WallSurface, end_sets
from jaxform.mesh import topology


def write(path: Path, wall: WallSurface) -> None:
    """Writes the wall for CalculiX: S6, ELSET and material WALL, NSET NODES and those of the wall."""
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
    lines = abaqus.keywords(
        wall,
        "S6",
        np.concatenate([wall.triangles, middle], axis=1),
        positions,
        np.concatenate([wall.thickness, wall.thickness[edge].mean(1)]),
        sets | end_sets(positions),
    )
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")

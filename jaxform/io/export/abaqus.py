"""Abaqus: three-node shells with nodal thickness, to be included in an input file that has material and steps."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from jaxform.io.export import text
from jaxform.io.export.wall import WallSurface

MATERIAL = "WALL"
"""Name of the section's material, which the file that includes this one defines."""


def write(path: Path, wall: WallSurface) -> None:
    """Writes the wall for Abaqus: S3, ELSET and material WALL, NSET NODES and those of the wall."""
    sections = keywords(wall, "S3", wall.triangles, wall.positions, wall.thickness, wall.node_sets(), ", 5")
    path.write_text("\n".join(sections) + "\n", encoding="utf-8")


def keywords(
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
    yield from (f"** {line}" for line in text.head(wall, len(positions) - len(wall.positions)))
    yield f"** Sets: NSET {', '.join(['NODES', *sets])}; ELSET WALL. Define *MATERIAL, NAME={MATERIAL} yourself."
    yield "*NODE, NSET=NODES"
    yield from text.table("%d, %.10g, %.10g, %.10g", number, positions)
    yield f"*ELEMENT, TYPE={kind}, ELSET=WALL"
    form = ", ".join(["%d"] * (1 + elements.shape[1]))
    yield from text.table(form, np.arange(1, len(elements) + 1), elements + 1)
    for name, nodes in sets.items():
        yield f"*NSET, NSET={name}"
        yield from text.rows(nodes + 1, 8, "%d", ", ")
    yield f"*SHELL SECTION, ELSET=WALL, MATERIAL={MATERIAL}, NODAL THICKNESS"
    yield f"{thickness.mean():.6g}{more}"
    yield "*NODAL THICKNESS"
    yield from text.table("%d, %.8g", number, thickness)

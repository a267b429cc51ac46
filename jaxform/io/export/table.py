"""CSV: the nodes as a table, for spreadsheets and programs of one's own."""

from __future__ import annotations

from pathlib import Path

from jaxform.io.export import text
from jaxform.io.export.wall import WallSurface

COLUMNS = "x_m,y_m,z_m,thickness_m,reference_x_m,reference_y_m,reference_z_m"
"""The first row; every column in m."""


def write(path: Path, wall: WallSurface) -> None:
    """Writes a row per node: place, thickness, and place in the initial sheet."""
    form = ",".join(["%.10g"] * 7)
    lines = [COLUMNS, *text.table(form, wall.positions, wall.thickness, wall.reference)]
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")

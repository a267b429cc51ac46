"""Radioss: three-node shells with a thickness each, to be included in a starter file that has the material."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from jaxform.io.export import text
from jaxform.io.export.wall import WallSurface


def write(path: Path, wall: WallSurface) -> None:
    """Writes the wall for Radioss, block format: /PART/1 with /PROP/SHELL/1 and /MAT/.../1, a /GRNOD for each set."""
    path.write_text("\n".join(_blocks(wall)) + "\n", encoding="utf-8")


def _blocks(wall: WallSurface) -> Iterator[str]:
    number, sets = np.arange(1, len(wall.positions) + 1), wall.node_sets()
    yield "#RADIOSS STARTER"
    yield from (f"# {line}" for line in text.head(wall))
    yield "# Part 1 (wall) has property 1 and material 1: define /MAT/.../1 yourself."
    yield "/NODE"
    yield from text.table("%10d%20.12g%20.12g%20.12g", number, wall.positions)
    yield from ("/PART/1", "wall", f"{1:10d}{1:10d}{0:10d}")
    yield from ("/PROP/SHELL/1", "wall", *_property(float(wall.element_thickness.mean())))
    yield "/SH3N/1"
    yield "#  sh3n_ID  node_ID1  node_ID2  node_ID3" + f"{'Phi':>40}{'Thick':>20}"
    form = "%10d%10d%10d%10d" + 20 * " " + f"{0:20d}" + "%20.10g"
    yield from text.table(form, np.arange(1, len(wall.triangles) + 1), wall.triangles + 1, wall.element_thickness)
    for place, (name, nodes) in enumerate(sets.items(), start=1):
        yield from (f"/GRNOD/NODE/{place}", name)
        yield from text.rows(nodes + 1, 10, "%10d")


def _property(thickness: float) -> list[str]:
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

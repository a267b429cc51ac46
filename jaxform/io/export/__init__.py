"""Walls for the next analysis: names and writers of formats. A new format is a file and a line here."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

from jaxform.core.disk import atomic_path
from jaxform.io.export import abaqus, calculix, radioss, table, vtu
from jaxform.io.export.wall import WallSurface, mirror, read_wall


class Format(NamedTuple):
    """A format of files.

    Attributes:
        ending: Ending of its files' names.
        write: Writes a wall to a path.
    """

    ending: str
    write: Callable[[Path, WallSurface], None]


FORMATS = {
    "abaqus": Format(".inp", abaqus.write),
    "calculix": Format(".inp", calculix.write),
    "radioss": Format(".rad", radioss.write),
    "vtu": Format(".vtu", vtu.write),
    "csv": Format(".csv", table.write),
}
"""Formats by their names for `jaxform export --to`."""


def write_wall(wall: WallSurface, path: Path, name: str) -> None:
    """Writes a wall in the format of that name.

    Raises:
        InputError: The file cannot be written.
    """
    with atomic_path(path, "choose another file (--out)") as fresh:
        FORMATS[name].write(fresh, wall)


__all__ = ["FORMATS", "Format", "WallSurface", "mirror", "read_wall", "write_wall"]

"""Walls for the next analysis: names and writers of formats. A new format is a function and a line here."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from jaxform.core.disk import atomic_path
from jaxform.io.export import wall
from jaxform.io.export.wall import WallSurface, mirror, read_wall

FORMATS: dict[str, tuple[str, Callable[[Path, WallSurface], None]]] = {
    "abaqus": (".inp", wall.write_abaqus),
    "calculix": (".inp", wall.write_calculix),
    "radioss": (".rad", wall.write_radioss),
    "vtu": (".vtu", wall.write_vtu),
    "csv": (".csv", wall.write_csv),
}
"""The ending of files and the function that writes a wall to a path, by the name of the format in `export --to`."""


def write_wall(wall: WallSurface, path: Path, name: str) -> None:
    """Writes a wall in the format of that name.

    Raises:
        InputError: The file cannot be written.
    """
    _, write = FORMATS[name]
    with atomic_path(path, "or choose another file (--out)") as fresh:
        write(fresh, wall)


__all__ = ["FORMATS", "WallSurface", "mirror", "read_wall", "write_wall"]

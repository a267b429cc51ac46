"""The command `jaxform export`: the wall of a formed part for the next analysis, on its own mesh or on the user's."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from jaxform.cli import session
from jaxform.core import disk
from jaxform.core.errors import InputError

if TYPE_CHECKING:
    from jaxform.io.export import Wall

FORMATS = ("abaqus", "calculix", "radioss", "vtu", "csv")
"""Those of `jaxform.io.export`, which takes NumPy to import."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds what `jaxform export` takes."""
    parser.add_argument("folder", metavar="DIR", type=Path, help="results of `jaxform simulate` or `jaxform optimize`")
    parser.add_argument("--to", required=True, choices=FORMATS, help="what it is written for")
    words = "a mesh of your own to carry the wall over to, in place of the formed one"
    parser.add_argument("--onto", metavar="MESH", type=Path, help=words)
    words = "the whole sheet, with what the scene's [part] cuts off"
    parser.add_argument("--whole-sheet", action="store_true", help=words)
    words = "metres per unit of length of MESH: 0.001 for millimetres (default 1)"
    parser.add_argument("--scale", metavar="METRES", type=float, help=words)
    words = "symmetry planes in which the part is completed: x, y or z, or the place as well, as x=0.15 (m)"
    parser.add_argument("--mirror", metavar="PLANE", nargs="+", default=[], help=words)
    parser.add_argument("--out", metavar="FILE", type=Path, help="what is written (default: wall.* in DIR)")
    parser.add_argument("--force", action="store_true", help="overwrite FILE")
    parser.add_argument("--quiet", action="store_true", help="print errors only")


def export(arguments: argparse.Namespace) -> int:
    """Runs `jaxform export` with its arguments and returns its exit status.

    Raises:
        InputError: There are no results, the mesh does not lie on the part, or the file cannot be written.
    """
    from jaxform.io import export

    if arguments.scale is not None and arguments.onto is None:
        raise InputError("is there without a mesh", "give --onto as well", "--scale", arguments.scale)
    path = _path(arguments, export.FORMATS[arguments.to].ending)
    wall = export.read_wall(arguments.folder, arguments.whole_sheet)
    for plane in arguments.mirror:
        wall = export.mirrored(wall, *_plane(plane, wall))
    said = []
    if arguments.onto is not None:
        from jaxform.io.export import mapping

        scale = 1.0 if arguments.scale is None else arguments.scale
        mesh = mapping.read_target(disk.located(arguments.onto), scale)
        wall, coverage = mapping.onto(wall, mesh, str(arguments.onto))
        said.append(str(coverage))
    export.write_wall(wall, path, arguments.to)
    _tell(arguments, wall, said, path)
    return session.DONE


def _path(arguments: argparse.Namespace, ending: str) -> Path:
    path = arguments.folder / f"wall{ending}" if arguments.out is None else disk.located(arguments.out)
    if path.is_dir():
        raise InputError("is a folder", "name a file", "--out", str(path))
    if path.exists() and not arguments.force:
        raise InputError("is there already", "choose another file or give --force", "--out", str(path))
    return path


def _plane(text: str, wall: Wall) -> tuple[int, float]:
    """Axis and place [m] of a plane such as `x` or `x=0.15`; without a place that of the run, or 0."""
    from jaxform.mesh.surfaces import plane_of

    try:
        axis, level = plane_of(text)
    except InputError:
        raise InputError("is no plane", "give x, y or z, or a place as x=0.15 (m)", "--mirror", text) from None
    return axis, level if "=" in text else wall.planes.get(axis, 0.0)


def _tell(arguments: argparse.Namespace, wall: Wall, said: list[str], path: Path) -> None:
    from jaxform.io.export import text

    if arguments.quiet:
        return
    for line in [*said, text.head(wall)[-1], f"written to {path}"]:
        session.say(line)

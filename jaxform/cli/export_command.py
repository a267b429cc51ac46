"""The command `jaxform export`: the wall of a formed part for the next analysis, on its own mesh or on the user's."""

from __future__ import annotations

import argparse
import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

from jaxform.cli import session
from jaxform.core import disk
from jaxform.core.errors import InputError, format_percent

if TYPE_CHECKING:
    import numpy as np

    from jaxform.io.export import WallSurface
    from jaxform.mesh.meshes import Mesh

FORMATS = ("abaqus", "calculix", "radioss", "vtu", "csv")
"""Names of the formats of `jaxform.io.export`, whose import needs NumPy."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds the arguments of `jaxform export`."""
    parser.add_argument(
        "folder", metavar="DIR", type=Path, help="folder of results of `jaxform simulate` or `jaxform optimize`"
    )
    parser.add_argument("--to", required=True, choices=FORMATS, help="file format")
    words = "mesh onto which the wall is mapped, instead of the formed mesh"
    parser.add_argument("--onto", metavar="MESH", type=Path, help=words)
    words = "export the whole sheet, including what the scene's [part] cuts off"
    parser.add_argument("--whole-sheet", action="store_true", help=words)
    words = (
        "coordinates of MESH: those of the scene, or those of the mold's file, before [mold] scales, "
        "rotates and moves it"
    )
    words += " (default: the ones in which MESH lies on the part; the mold's file is recognized)"
    parser.add_argument("--pose", choices=("scene", "file"), help=words)
    words = "metres per unit of length of MESH: 0.001 for millimetres (default 1, or the mold's)"
    parser.add_argument("--scale", metavar="METRES", type=float, help=words)
    words = "symmetry planes at which the part is mirrored: x, y or z, or with a position, as in x=0.15 (m)"
    parser.add_argument("--mirror", metavar="PLANE", nargs="+", default=[], help=words)
    parser.add_argument("--out", metavar="FILE", type=Path, help="output file (default: wall.* in DIR)")
    parser.add_argument("--force", action="store_true", help="overwrite FILE")
    parser.add_argument("--quiet", action="store_true", help="print warnings and errors only")


def export(arguments: argparse.Namespace) -> int:
    """Runs `jaxform export` with its arguments and returns its exit status.

    Raises:
        InputError: There are no results, the mesh does not lie on the part, or the file cannot be written.
    """
    from jaxform.io import export

    for name in ("scale", "pose"):
        if getattr(arguments, name) is not None and arguments.onto is None:
            raise InputError("is given without a mesh", "give --onto as well", f"--{name}", getattr(arguments, name))
    ending, _ = export.FORMATS[arguments.to]
    path = _path(arguments, ending)
    wall = export.read_wall(arguments.folder, arguments.whole_sheet)
    for plane in arguments.mirror:
        wall = export.mirror(wall, *_plane(plane, wall))
    said = []
    if arguments.onto is not None:
        wall, said = _map_wall(arguments, wall)
    export.write_wall(wall, path, arguments.to)
    _tell(arguments, wall, said, path)
    return session.DONE


def _map_wall(arguments: argparse.Namespace, wall: WallSurface) -> tuple[WallSurface, list[str]]:
    """The wall on the given mesh, in its coordinates, and notes about it."""
    from jaxform.io.export import mapping
    from jaxform.mesh import meshes

    path, name = disk.expand_path(arguments.onto), str(arguments.onto)
    mesh, place, said = _target(arguments, wall, path)
    posed = dataclasses.replace(mesh, positions=place(mesh.positions))
    reach = mapping.FARTHEST * meshes.size(wall.positions)
    from_mold = bool(said)
    side, nodes, share = mapping.contact_side(wall, posed, reach, whole=not from_mold)
    if share < 1.0:
        said.append(
            f"of {name}, the side on which the sheet lies is written, {format_percent(share, 3)} of its area; "
            "the rest, another side or too far from the part, gets no wall"
        )
    carried, coverage = mapping.map_wall(wall, side, name)
    if from_mold:
        # Planes of symmetry are the scene's.
        carried = dataclasses.replace(carried, positions=mesh.positions[nodes], planes={})
    return carried, [*said, str(coverage)]


def _target(
    arguments: argparse.Namespace, wall: WallSurface, path: Path
) -> tuple[Mesh, Callable[[np.ndarray], np.ndarray], list[str]]:
    """The given mesh [m], the pose that moves it into the scene, and a sentence where these differ."""
    from jaxform.io.export import mapping

    given = 1.0 if arguments.scale is None else arguments.scale
    mold_pose = None if arguments.pose == "scene" else mapping.read_pose(arguments.folder)
    if mold_pose is None and arguments.pose == "file":
        problem, remedy = "the scene in DIR has no mold from a file", "give --pose scene"
        raise InputError(problem, remedy, "--pose", arguments.pose)
    if mold_pose is not None:
        scaled = mapping.read_target(path, mold_pose.scale if arguments.scale is None else given)
        known = arguments.pose == "file" or mold_pose.contains_file(path)
        words = (
            "is the mold's own file"
            if mold_pose.contains_file(path)
            else "is taken to be in the coordinates of the mold's file"
        )
        if known or mapping.fits_better_posed(
            wall, scaled, mold_pose.place(scaled.positions), mapping.read_target(path, given)
        ):
            return (
                scaled,
                mold_pose.place,
                [f"{arguments.onto} {words}: it is placed as [mold] says (--pose scene overrides this)"],
            )
    return mapping.read_target(path, given), lambda places: places, []


def _path(arguments: argparse.Namespace, ending: str) -> Path:
    path = arguments.folder / f"wall{ending}" if arguments.out is None else disk.expand_path(arguments.out)
    if path.is_dir():
        raise InputError("is a folder", "name a file", "--out", str(path))
    if path.exists() and not arguments.force:
        raise InputError("exists already", "choose another file or give --force", "--out", str(path))
    return path


def _plane(text: str, wall: WallSurface) -> tuple[int, float]:
    """Axis and place [m] of a plane such as `x` or `x=0.15`; without a place that of the run, or 0."""
    from jaxform.mesh.shapes import parse_plane

    try:
        axis, level = parse_plane(text)
    except InputError:
        raise InputError("is not a plane", "give x, y or z, or a place as x=0.15 (m)", "--mirror", text) from None
    return axis, level if "=" in text else wall.planes.get(axis, 0.0)


def _tell(arguments: argparse.Namespace, wall: WallSurface, said: list[str], path: Path) -> None:
    from jaxform.io.export.wall import head

    if arguments.quiet:
        return
    for line in [*said, head(wall)[-1], f"written to {path}"]:
        session.say(line)

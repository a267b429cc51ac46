"""`jaxform new`: a folder with a first scene for a mold."""

from __future__ import annotations

import argparse
import shlex
import tomllib
import warnings
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from jaxform.cli import defer_interrupts, session
from jaxform.core import disk
from jaxform.core.errors import InputError, format_number, redirect_warnings, warn_of

if TYPE_CHECKING:
    from jaxform.io.scene_choices import Draft

_LEAST, _MOST = 1e-9, 1e3  # m
_LARGE = 3.0  # of a part in metres, which may be one of a few inches
_DRAWN = 0.75  # times the width, above which a plug is the rule
_DEEP = 1.5  # times the width, above which hardly anything is thermoformed
_NARROW = 0.05  # of the sheet's width, below which a plug is hardly meant to be as it is
_FOLDING = 2.0  # sides of an element: ribs and pins as narrow as that fold the sheet, whether nodes meet them or not
_SHORT = 0.99  # of a plug's usual way: below it the mold is in its way


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds the arguments of `jaxform new`."""
    parser.add_argument("folder", metavar="FOLDER", type=Path, help="folder for scene.toml and study.toml")
    parser.add_argument("--mold", metavar="FILE", nargs="+", required=True, help="the mesh files of the mold")
    parser.add_argument(
        "--plug", metavar="FILE", help="the mesh file of a plug that pushes the sheet first; auto: made from the cavity"
    )
    parser.add_argument("--scale", metavar="M", type=float, help="metres per unit of the files; guessed by default")
    kind = parser.add_mutually_exclusive_group()
    kind.add_argument("--drape", action="store_true", help="form the sheet over the mold (a male mold)")
    kind.add_argument("--cavity", action="store_true", help="form the sheet into the mold; detected by default")
    parser.add_argument(
        "--direction", metavar="SIDE", help="side from which the sheet comes: +z, -x ... or X,Y,Z in the file's axes"
    )
    parser.add_argument(
        "--process",
        choices=["vacuum", "pressure", "thermoforming", "stretch-blow", "extrusion-blow"],
        help="forming process; vacuum (the default, also thermoforming) is limited to 0.9 bar; stretch-blow: a bottle "
        "from a preform, extrusion-blow: from a tube between closing mold halves",
    )
    parser.add_argument(
        "--thickness", metavar="M", type=float, help="thickness of the sheet [m]; by default in proportion to its width"
    )
    parser.add_argument("--quiet", action="store_true", help="print warnings and errors only")
    parser.add_argument("--force", action="store_true", help="overwrite files in FOLDER")


def start(arguments: argparse.Namespace) -> int:
    """Writes the folder, prints the findings and the next command; returns the exit status."""
    say = (lambda _: None) if arguments.quiet else session.say
    for key in ("scale", "thickness"):
        _check_positive(f"--{key}", getattr(arguments, key))
    if arguments.process in ("stretch-blow", "extrusion-blow"):
        return _start_bottle(arguments, say)
    with defer_interrupts():
        from jaxform.io import scene_text, scene_wizard

    paths = [disk.expand_path(name) for name in arguments.mold]
    choices = _choices(arguments)
    try:
        made = scene_wizard.draft(paths, **choices)
    except InputError as error:
        raise error.with_context(key="--mold") from None
    _open_folder(arguments)

    def hold_ribs(made: Draft, text: str) -> Draft:
        slender, thin = _has_thin_features(text, arguments.folder)
        return replace(made, edge_contact=thin and not made.levels, self_contact=made.self_contact or slender)

    files, made = scene_text.write(arguments.folder, paths, made, hold_ribs)
    _warn(made)
    for line in _lines(made):
        say(line)
    return _say_next(arguments, files, say)


def _has_thin_features(text: str, folder: Path) -> tuple[bool, bool]:
    """True if the mold of a scene has a rib or pin that folds its sheet; and if it may also pass between its nodes.

    Then the mold has sharp edges, at which elements can be held.

    Args:
        text: The scene's file.
        folder: Folder of the files that it names.
    """
    from jaxform.io import files, scene_checks
    from jaxform.mesh import topology

    with warnings.catch_warnings(), redirect_warnings(lambda _: None):
        warnings.simplefilter("ignore")
        try:
            scene = files.build_unchecked(files.validate_scene(tomllib.loads(text), "scene.toml", folder.resolve()))
        except InputError:  # `check` says what it is
            return False, False
    mold, side = scene.mold, scene_checks.finest_side(scene)
    if mold is None or not topology.sharp_edges(np.asarray(mold.vertices), np.asarray(mold.triangles)).size:
        return False, False
    thin = scene_checks.thin_feature(scene, side) is not None
    return thin or scene_checks.thin_feature(scene, _FOLDING * side) is not None, thin


def _start_bottle(arguments: argparse.Namespace, say: Callable[[str], None]) -> int:
    """Writes a folder for a bottle that is blow moulded; returns the exit status."""
    for key in ("plug", "drape", "cavity", "direction"):
        if (given := getattr(arguments, key)) not in (None, False):
            raise InputError(f"is not possible with --process {arguments.process}", "leave it out", f"--{key}", given)
    from jaxform.io import bottle_wizard, extrusion_wizard

    paths = [disk.expand_path(name) for name in arguments.mold]
    stretched = arguments.process == "stretch-blow"
    draft = bottle_wizard.draft_bottle if stretched else extrusion_wizard.draft_extrusion
    try:
        made, lines = draft(paths, arguments.scale, arguments.thickness)
    except InputError as error:
        raise error.with_context(key="--mold") from None
    _open_folder(arguments)
    files = bottle_wizard.write_files(arguments.folder, made)
    for line in lines:
        say(line)
    return _say_next(arguments, files, say)


def _open_folder(arguments: argparse.Namespace) -> None:
    try:
        session.open_folder(arguments.folder, arguments.force)
    except InputError as error:
        raise replace(error, key="FOLDER") from None


def _say_next(arguments: argparse.Namespace, files: Sequence[Path], say: Callable[[str], None]) -> int:
    """Prints the files that were written and the next commands; returns the exit status."""
    scene, study = (shlex.quote(str(path)) for path in files[:2])
    say(f"wrote {', '.join(path.name for path in files)} into {arguments.folder}")
    say("next:")
    for line in (
        f"jaxform check {scene} --out {shlex.quote(str(arguments.folder / 'check'))}",
        f"jaxform simulate {scene} --out {shlex.quote(str(arguments.folder / 'formed'))}",
        f"jaxform optimize {study} --out {shlex.quote(str(arguments.folder / 'design'))}",
    ):
        say(f"    {line}")
    return session.DONE


def _choices(arguments: argparse.Namespace) -> dict[str, Any]:
    """The user's choices, as keywords of `scene_wizard.draft`."""
    from jaxform.tools import buck

    direction = None if arguments.direction is None else buck.parse_direction(arguments.direction)
    drape = True if arguments.drape else False if arguments.cavity else None
    process, plug = "pressure" if arguments.process == "pressure" else "vacuum", arguments.plug
    path = plug if plug is None or plug == "auto" else disk.expand_path(plug)
    sizes = {"scale": arguments.scale, "thickness": arguments.thickness}
    return sizes | {"drape": drape, "direction": direction, "process": process, "plug": path}


def _check_positive(key: str, value: float | None) -> None:
    if value is not None and not _LEAST < value < _MOST:
        raise InputError("is not a plausible length in metres", f"give {_LEAST:g} to {_MOST:g}", key, value)


def _warn(made: Draft) -> None:
    """Warns of findings that the user may not intend."""
    from jaxform.io import plausibility, scene_choices, scene_text
    from jaxform.tools import opening

    found, largest = made.found, float(made.size.max())
    if made.guessed and plausibility.METRES < largest <= _LARGE:
        problem = f"its bounding box is {largest:.4g} units long: assumed to be in {made.units}"
        warn_of(problem, "give --scale 1 if it is in metres", key="--mold")
    if made.rest is not None:
        problem = (
            f"looks cut in {scene_text.cut_planes_text(made.planes, made.scale)}: {scene_text.IMAGES} completes it"
        )
        warn_of(
            problem, "look at check.png; if the mold is meant to be like this, write the scene by hand", key="--mold"
        )
    if made.drape is not None:
        scene_choices.warn(made.drape, made.scale)
        return
    if found.depth > _DEEP * made.width:
        problem = f"is {found.depth / made.width:.2g} times as deep as the sheet is wide: its bottom gets very thin"
        warn_of(
            problem,
            "let a plug push the sheet first (--plug auto), form a wider sheet, or expect unfilled corners",
            key="--mold",
        )
    if made.plug is not None and max(made.plug.size[:2]) < _NARROW * made.width:
        wide = 1e3 * max(made.plug.size[:2])
        problem = f"is {wide:.2g} mm wide, {made.width / max(1e-3 * wide, 1e-30):.2g} times less than the sheet"
        warn_of(problem, "give it in the units of the mold's file", key="--plug")
    if made.slit is not None:
        problem = f"has {scene_text.slits_text(made.slit)}, more than twice as deep as wide: they are left open"
        warn_of(problem, "widen them, or raise pressure.value and check whether the sheet touches itself", key="--mold")
    if found.rim < opening.RIM:
        problem = f"only {100 * found.rim:.0f} % of the edge around the opening is at one height"
        warn_of(problem, "look at check.png: the sheet is clamped in one plane", key="--mold")


def _lines(made: Draft) -> Iterator[str]:
    from jaxform.io import scene_choices, scene_text
    from jaxform.tools import plugs

    box = " x ".join(f"{side:.4g}" for side in made.size)
    otherwise = made.other_units or "--scale overrides this"
    yield f"the mold's bounding box is {box} in its file's units, assumed to be {made.units} ({otherwise})"
    yield from _cavity_lines(made) if made.drape is None else scene_choices.lines(made.drape)
    if made.doubt:
        yield f"it is {made.doubt}"
    yield f"sheet: {scene_text.shape_text(made)}, {scene_text.size_text(made)}, {_clamp_words(made)}"
    if made.drape is None and made.plug is None and _DRAWN * made.width < made.found.depth <= _DEEP * made.width:
        yield "so deep a draw leaves the bottom thin: `--plug auto` makes a plug that pushes the sheet first"
    if made.drape is None and made.covers.mesh is not None:
        yield f"{scene_text.COVERS} closes {scene_text.covers_text(made)}"
    if made.plug is not None:
        size, what = made.plug.size, "made from the cavity" if made.plug.path is None else "of its file"
        short = made.plug.stroke < _SHORT * plugs.DEPTH * made.found.depth
        yield (
            f"plug: {what}, {1e3 * size[0]:.3g} x {1e3 * size[1]:.3g} mm wide, goes "
            f"{1e3 * made.plug.stroke:.3g} mm within {made.stroke_time:.3g} s"
            f"{', until it is near the mold' if short else ''}; its friction is a guess"
        )
    yield (
        f"guessed: thickness {1e3 * made.thickness:.3g} mm, {format_number(made.pressure, 3)} Pa within "
        f"{made.ramp:.3g} s; the material is a placeholder"
    )
    if made.is_limited:
        yield f"{scene_text.vacuum_text(made)} (--process pressure)"
    if made.edge_contact:
        yield "it has a rib or pin thinner than elements: solver.edge_contact holds the sheet at sharp edges"


def _cavity_lines(made: Draft) -> Iterator[str]:
    from jaxform.tools import buck

    x, y, z = made.found.view.turn.T[:, 2]
    yield (
        f"its opening was found; the sheet is pushed along ({x:.3g}, {y:.3g}, {z:.3g}) of the file, which is "
        "+z of the scene"
    )
    if made.found.others:
        sides = " or ".join(f"--direction={buck.direction_name(side)}" for side in made.found.others)
        yield f"it is hollow on other sides too: {sides}"


def _clamp_words(made: Draft) -> str:
    depth = 1e3 * made.found.depth
    if made.drape is not None:
        return f"clamped {1e3 * made.drape.margin:.3g} mm around the buck, which is {depth:.3g} mm high"
    return f"clamped {'on the flange' if made.flange else 'along the rim'}; drawn {depth:.3g} mm deep"

"""`jaxform new`: a folder with a first scene for a mold."""

from __future__ import annotations

import argparse
from collections.abc import Iterator

from jaxform.cli import session
from jaxform.core import disk
from jaxform.core.errors import InputError, warn_of


def start(arguments: argparse.Namespace) -> int:
    """Writes the folder, says what was found and what to run next; returns the exit status."""
    say = (lambda _: None) if arguments.quiet else session.say
    for key in ("scale", "thickness"):
        _check_positive(f"--{key}", getattr(arguments, key))
    from jaxform.io import drafting, firstscene

    paths = [disk.located(name) for name in arguments.mold]
    try:
        made = drafting.draft(paths, arguments.scale, arguments.thickness)
    except InputError as error:
        raise error.within(key="--mold") from None
    session.open_folder(arguments.folder, arguments.force)
    files = firstscene.write(arguments.folder, paths, made)
    _warn(made)
    for line in _lines(made):
        say(line)
    scene, study = files[:2]
    say(f"wrote {', '.join(path.name for path in files)} into {arguments.folder}")
    say("next:")
    for line in (
        f"jaxform check {scene} --out {arguments.folder / 'check'}",
        f"jaxform simulate {scene} --out {arguments.folder / 'formed'}",
        f"jaxform optimize {study} --out {arguments.folder / 'design'}",
    ):
        say(f"    {line}")
    return session.DONE


def _check_positive(key: str, value: float | None) -> None:
    if value is not None and not 0 < value < 1e6:
        raise InputError("is not a positive number", "give metres", key, value)


def _warn(made) -> None:
    """Of what was found and may be meant otherwise."""
    found = made.found
    if found.rim < 0.8:
        problem = f"only {100 * found.rim:.0f} % of the edge around the opening is at one height"
        warn_of(problem, "look at check.png: the sheet is clamped in one plane", key="--mold")


def _lines(made) -> Iterator[str]:
    from jaxform.io import firstscene

    found = made.found
    box = " x ".join(f"{side:.4g}" for side in made.size)
    yield f"the mold's box is {box} in its file's units, taken for {made.units} (--scale says otherwise)"
    x, y, z = found.view.turn.T[:, 2]
    what = "a plug stands out of its base" if found.male else "its opening is found"
    yield f"{what}; the sheet is pushed along ({x:.3g}, {y:.3g}, {z:.3g}) of the file, +z of the scene"
    kind = made.planform.shape.__class__.__name__.lower().replace("circle", "disc").replace("ndarray", "outline")
    where = "on the flange" if made.planform.flange else "along the rim"
    where = "around the plug" if found.male else where
    yield f"sheet: a {kind}, {1e3 * made.width:.3g} mm wide, clamped {where}; drawn {1e3 * found.depth:.3g} mm deep"
    if made.covers.mesh is not None:
        yield f"{firstscene.COVERS} closes {firstscene.covered(made)}"
    yield (
        f"guessed: thickness {1e3 * made.thickness:.3g} mm, {made.pressure:.3g} Pa within {made.ramp:.3g} s; "
        "the material is a placeholder"
    )

"""The files of a first scene: scene.toml with a comment on each choice, study.toml, the mold and its covers."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Collection, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from jaxform.core.disk import atomic_path
from jaxform.core.errors import InputError, format_percent
from jaxform.io.scene_choices import ALPHA, DENSITY, FRICTION, STIFFNESS, Draft, clearance
from jaxform.io.scene_rewriting import inline
from jaxform.mesh import meshes
from jaxform.mesh.meshes import Mesh
from jaxform.mesh.outlines import Circle, OrientedRectangle
from jaxform.tools.kinds import Plane
from jaxform.tools.plugs import WIDTH

COVERS, IMAGES, PLATEN, PLUG = "covers.stl", "images.stl", "platen.stl", "plug.stl"
"""Names of the files of a mold's covers, of the images that complete a cut mold, of a buck's platen and of a plug."""

ADAPT = "# adapt = {}  # elements where the wall needs them, found by two runs; pip install mmgpy"
"""The comment on adapted meshes in a new scene."""

_CONTENT = {
    COVERS: "the covers of the mold's holes",
    IMAGES: "the images that complete the mold",
    PLATEN: "the platen on which the mold stands",
}


def write(
    folder: Path, paths: Sequence[Path], made: Draft, revise: Callable[[Draft, str], Draft] = lambda made, _: made
) -> tuple[list[Path], Draft]:
    """Writes a first scene into a folder that is there.

    The mold is copied beside the scene: the folder then runs wherever it is put, and a part that is exported again
    does not change a scene whose numbers were made for the one before.

    Args:
        folder: The folder.
        paths: The files of the mold.
        made: The choices.
        revise: A function for better choices, of these and the text of scene.toml, when the meshes are in the folder.

    Returns:
        The files, scene.toml first, and the choices that are in them.

    Raises:
        InputError: A file cannot be written, or a file of the mold would be overwritten.
    """
    own_plug = [] if made.plug is None or made.plug.path is None else [made.plug.path]
    sources = [*paths, *own_plug]
    added = _added_meshes(made)
    added |= {PLUG: made.plug.mesh} if made.plug is not None and made.plug.mesh is not None else {}
    copies = _names(folder, sources, added)
    names, plug = copies[: len(paths)], copies[-1] if own_plug else PLUG
    for name in added:
        if _is_one_of(folder / name, sources):
            problem = f"would be overwritten by {_CONTENT.get(name, 'the plug')}"
            raise InputError(problem, "give it another name", "--mold", str(folder / name))
    for path, name in zip(sources, copies, strict=True):
        if not _is_one_of(folder / name, [path]):
            with atomic_path(folder / name) as fresh:
                shutil.copyfile(path, fresh)
    for name, mesh in added.items():
        with atomic_path(folder / name) as fresh:
            meshes.write_stl(fresh, mesh.positions / (1.0 if name == PLUG else made.scale), mesh.triangles)
    made = revise(made, scene_text(made, names, plug))
    files = {"scene.toml": scene_text(made, names, plug), "study.toml": study_text(made)}
    for name, text in files.items():
        with atomic_path(folder / name) as fresh:
            fresh.write_text(text, encoding="utf-8")
    return [folder / name for name in [*files, *copies, *added]], made


def _added_meshes(made: Draft) -> dict[str, Mesh]:
    """Meshes beside the mold's own, by the names of their files."""
    closing = COVERS if made.drape is None else PLATEN
    meshes_of = {IMAGES: made.rest, closing: made.covers.mesh}
    return {name: mesh for name, mesh in meshes_of.items() if mesh is not None}


def cut_planes_text(planes: Sequence[Plane], scale: float) -> str:
    """The planes in which a mold is cut, as its file has them, in words."""
    return " and ".join(f"{'xyz'[axis]} = {_number(level / scale, 4)}" for axis, level in planes)


def _names(folder: Path, paths: Sequence[Path], written: Collection[str] = ()) -> list[str]:
    """File names for the copies in a folder, each once, and none by which a copy overwrites another file's original.

    Nor is a name one of what is always, or now, `written`.
    """
    names: list[str] = []
    written = {*_CONTENT, *written}
    for path in paths:
        # A name on disk may be no text.
        plain, count = Path(path.name.encode("utf-8", "replace").decode()), 1
        name, others = plain.name, [other for other in paths if not other.samefile(path)]
        while name in names or name in written or _is_one_of(folder / name, others):
            count += 1
            name = f"{plain.stem}-{count}{plain.suffix}"
        names.append(name)
    return names


def _is_one_of(file: Path, paths: Sequence[Path]) -> bool:
    """True if a file exists and is one of these paths, by any name."""
    return file.exists() and any(path.samefile(file) for path in paths)


def scene_text(made: Draft, names: Sequence[str], plug: str = PLUG) -> str:
    """The scene file, for molds and a plug of these names beside it."""
    return "\n".join(
        [
            "# Written by `jaxform new`. SI units everywhere: m, s, kg, Pa.",
            f"name = {inline(Path(names[0]).stem)}",
            *_parison(made),
            *_material(),
            *_pressure(made),
            *_mold(made, names),
            *_tool(made, plug),
            *_refinement(made),
            *_part(made, names),
            *_solver(made),
            "",
        ]
    )


def _parison(made: Draft) -> list[str]:
    shape = made.planform
    where = "on the flange" if made.flange else "along the rim"
    if made.drape is not None:
        where = f"in a frame {_number(1e3 * made.drape.margin, 3)} mm around the buck, which is behind it"
    if isinstance(shape, Circle):
        shape_lines = ['shape = "disc"', f"radius = {_number(shape.radius)}"]
    elif isinstance(shape, OrientedRectangle):
        shape_lines = ['shape = "rectangle"', f"size = [{', '.join(map(_number, shape.sides))}]"]
    else:
        shape_lines = ['shape = "outline"', "polygon = [", *_corners(made.polygon), "]"]
    return [
        "",
        f"# The sheet lies in z = 0, clamped {where}.",
        "[parison]",
        *shape_lines,
        f"element_size = {_number(made.element_size)}",
        *([] if made.levels else [ADAPT]),
        f"thickness = {_number(made.thickness)}  # a guess from the width of the sheet: give yours",
    ]


def _corners(polygon: NDArray[np.float64]) -> list[str]:
    pairs = [f"[{_number(x)}, {_number(y)}]" for x, y in polygon]
    return [f"    {', '.join(pairs[k : k + 5])}," for k in range(0, len(pairs), 5)]


def _material() -> list[str]:
    return [
        "",
        "# A placeholder, some hot thermoplastic: give the model and parameters of your material. In a slow process",
        "# the wall depends on alpha, hardly on c.",
        "[material]",
        'model = "mooney-rivlin"',
        f"c = {_number(STIFFNESS)}",
        f"alpha = {_number(ALPHA)}",
        f"density = {_number(DENSITY)}",
    ]


def _pressure(made: Draft) -> list[str]:
    begin = made.stroke_time
    knots = [0.0, begin, begin + made.ramp] if begin else [0.0, made.ramp]
    values = [0.0] * (len(knots) - 1) + [made.pressure]
    return [
        "",
        *_filling_comments(made),
        *([] if made.plug is None else ["# It rises when the plug has come to rest."]),
        "# It rises so slowly that inertia has almost no effect, and pushes towards +z, into the mold.",
        "[pressure]",
        f"time = [{', '.join(map(_number, knots))}]",
        f"value = [{', '.join(map(_number, values))}]",
        'interpolation = "cubic-ramp"',
    ]


def _filling_comments(made: Draft) -> list[str]:
    """Comments on the corners that the pressure fills."""
    if made.is_limited:
        return [f"# {vacuum_text(made).capitalize()}.", "# --process pressure has no such limit."]
    if made.slit is not None:
        return [
            f"# Not enough to blow the sheet into {slits_text(made.slit)}: change it in proportion to c and thickness.",
        ]
    return ["# Enough to fill corners down to one element: change it in proportion to c and thickness."]


def vacuum_text(made: Draft) -> str:
    """Description of the corners that a vacuum fills."""
    radius, bar = 1e3 * made.corner(made.pressure), 1e-5 * made.pressure
    fills = f"a vacuum of {bar:.2g} bar fills corners down to a radius of about {radius:.2g} mm"
    return f"{fills}; down to one element needs {1e-5 * made.filling:.2g} bar"


def _mold(made: Draft, names: Sequence[str]) -> list[str]:
    files, lines = [*names, *_added_meshes(made)], []
    if made.rest is not None:
        lines += [
            f"# The mold is cut in {cut_planes_text(made.planes, made.scale)} of its file: {IMAGES} completes it."
        ]
    if made.drape is not None and made.covers.mesh is not None:
        holes = f" and closes {covers_text(made)}" if made.covers.holes else ""
        lines += [f"# {PLATEN} is the platen below the male mold, with vacuum at its surface{holes}."]
    elif made.covers.mesh is not None:
        lines += [
            f"# {COVERS} closes the holes through which the sheet would be blown ({covers_text(made)}).",
            "# Remove it if a hole is intended.",
        ]
    path = inline(files if len(files) > 1 else files[0])
    box = " x ".join(_number(side, 4) for side in made.size)
    return [
        "",
        f"# The file's bounding box is {box}: assumed to be in {made.units}. {_pose(made)}",
        *lines,
        "[mold]",
        'shape = "file"',
        f"path = {path}",
        f"scale = {_number(made.scale)}",
        f"rotate = [{', '.join(_number(angle, 12) for angle in made.rotate)}]",
        f"translate = [{', '.join(_number(shift, 10) for shift in made.translate)}]",
        *_motion(made),
    ]


def _pose(made: Draft) -> str:
    if made.drape is None:
        return "Turned and moved so that the opening is in z = 0."
    return "Turned and moved so that the top of the mold is behind z = 0."


def _motion(made: Draft) -> list[str]:
    """The table of a buck's motion into the sheet, as lines; empty for a cavity."""
    if made.drape is None:
        return []
    return [
        "",
        "# Mold and platen move into the sheet until the platen is at the frame. Then the pressure rises.",
        "[mold.motion]",
        "direction = [0.0, 0.0, -1.0]",
        f"time = [0.0, {_number(made.stroke_time)}]",
        f"displacement = [0.0, {_number(made.drape.stroke(made.thickness), 6)}]",
    ]


def _tool(made: Draft, name: str) -> list[str]:
    """The table of the plug, as lines; empty without one."""
    if made.plug is None:
        return []
    setup = made.plug
    share = (setup.stroke - clearance(made.thickness)) / made.found.depth
    kind = ["# The plug goes into the cavity first. It is in the axes of the mold's file."]
    pose = [
        f"scale = {_number(made.scale)}",
        f"rotate = [{', '.join(_number(angle, 12) for angle in made.rotate)}]",
        f"translate = [{', '.join(_number(shift, 10) for shift in setup.translate)}]",
    ]
    if setup.mesh is not None:
        kind = [
            "# The plug goes into the cavity first. It was made by an offset of the cavity with a rounded edge, "
            f"{100 * WIDTH:.0f} %",
            "# as wide at the widest place; its file is in metres, in the axes of the scene.",
        ]
        pose = []
    return [
        "",
        *kind,
        f"# Its end is at {format_percent(share, 3)} of the cavity's depth when the pressure begins to rise.",
        "[[tool]]",
        'name = "plug"',
        'shape = "file"',
        f"path = {inline(name)}",
        *pose,
        "direction = [0.0, 0.0, 1.0]",
        f"time = [0.0, {_number(made.stroke_time)}]",
        f"displacement = [0.0, {_number(setup.stroke, 6)}]",
        'contact = "coulomb"  # the sheet slides on it with friction; "stick" and "slide" are the extremes',
        f"friction = {_number(FRICTION)}  # a guess: 0.1 for felt, 0.4 for rubber-like plugs",
    ]


def slits_text(half: float) -> str:
    """Slits of half a width [m], in words."""
    return f"slits about {2e3 * half:.2g} mm wide"


def shape_text(made: Draft) -> str:
    """The shape of the sheet, in words."""
    if isinstance(made.planform, Circle):
        return "a disc"
    return "a rectangle" if isinstance(made.planform, OrientedRectangle) else "an outline"


def size_text(made: Draft) -> str:
    """The size of the sheet, in words."""
    if isinstance(made.planform, OrientedRectangle):
        return " x ".join(f"{1e3 * side:.3g}" for side in made.planform.sides) + " mm"
    return f"{1e3 * made.width:.3g} mm wide"


def covers_text(made: Draft) -> str:
    """Description of the openings that the covers close."""
    holes, gaps = made.covers.holes, made.covers.gaps
    some = [f"{holes} hole{'s' if holes > 1 else ''}{_wall_holes_text(made)}"] if holes else []
    if gaps:
        some.append(f"{_number(1e3 * gaps, 3)} mm of the sheet's edge without a rim below")
    return " and ".join(some)


def _wall_holes_text(made: Draft) -> str:
    holes, sides = made.covers.holes, made.covers.sides
    if not sides:
        return ""
    return (
        f", {sides} of them in side walls" if sides < holes else f" in {'side walls' if sides > 1 else 'a side wall'}"
    )


def _part(made: Draft, names: Sequence[str]) -> list[str]:
    """The table [part], as lines; it excludes the sheet on flange, platen and covers."""
    near = min(made.thickness, 0.1 * made.found.depth)
    on, at, side = "the platen", -near, "below"
    if made.drape is None:
        on, at, side = "the flange", made.found.base - made.found.level + near, "above"
    covered = made.drape is None and made.covers.mesh is not None
    files = [*names, *([] if made.rest is None else [IMAGES])]
    return [
        "",
        (
            f"# What is not on {on}{' or the covers' if covered else ''}: the part to which statistics and the "
            "objective refer."
        ),
        "[part]",
        f'trim = {{ axis = "z", at = {_number(at, 4)}, keep = "{side}" }}',
        *([f"molds = {inline(files)}"] if covered else []),
    ]


def _refinement(made: Draft) -> list[str]:
    if not made.levels:
        return []
    return [
        "",
        "# Some pockets are small compared to the sheet: elements near the mold's edges are bisected before contact.",
        "[refinement]",
        f"max_level = {made.levels}",
        f"base_level = {made.levels}",
    ]


def _solver(made: Draft) -> list[str]:
    return [
        "",
        "[solver]",
        f"end_time = {_number(made.stroke_time + 1.2 * made.ramp, 3)}",
        f"damping = {_number(made.damping)}",
        *(
            []
            if made.plug is None
            else ["safety = 0.6  # shorter steps lose less energy where the sheet slides over edges"]
        ),
        "quasi_static = true  # warn if inertia or damping affects the wall",
        *(
            ["edge_contact = true  # hold elements at the edges of ribs that pass between their nodes"]
            * made.edge_contact
        ),
        # Over ribs of a cavity the sheet folds as it does over a male mold.
        *(
            ["self_contact = true  # where the sheet folds, both films weld (a web)"]
            * (made.self_contact or made.drape is not None)
        ),
    ]


def study_text(made: Draft) -> str:
    """A study of the scene: the sheet that makes an even wall."""
    if isinstance(made.planform, Circle):
        kind = ['kind = "thickness-profile"', 'along = "radius"', "knots = 8"]
    else:
        kind = ['kind = "thickness-field"', f"smoothness = {_number(0.15 * made.width, 2)}  # m"]
    low, high = 0.5 * made.thickness, 2.5 * made.thickness
    return "\n".join(
        [
            "# Written by `jaxform new`: the thickness of the sheet for the most even wall.",
            'scene = "scene.toml"',
            "",
            "[[variable]]",
            *kind,
            f"bounds = [{_number(low, 3)}, {_number(high, 3)}]  # m",
            "",
            "[objective]",
            'kind = "uniform"',
            "",
            "[solver]",
            'method = "lbfgs"',
            "warm_start = 3",
            "iterations = 10",
            "",
        ]
    )


def _number(value: float, digits: int = 7) -> str:
    """The number as TOML's float, in few digits."""
    text = f"{float(value) + 0.0:.{digits}g}"
    return text if any(mark in text for mark in ".en") else f"{text}.0"

"""A first scene of stretch-blow moulding for the surface of a bottle: preform, rod, air and mold."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from jaxform.core.disk import atomic_path
from jaxform.core.errors import InputError
from jaxform.io.plausibility import Units, guess_units
from jaxform.io.scene_choices import choose_thickness, round_digits
from jaxform.io.scene_rewriting import inline
from jaxform.mesh import meshes
from jaxform.mesh.meridian import make_meridian
from jaxform.mesh.meshes import Mesh
from jaxform.tools import bottles, footprint, revolution
from jaxform.tools.bottles import BottleBody
from jaxform.tools.revolution import Revolution

Array = NDArray[np.float64]

_WALL = 0.0146  # mean wall of the bottle over its radius: 0.44 mm at 60 mm
_AXIAL = 2.1  # stretch along the axis
_FIT, _BODY = 0.92, 0.95  # radius of the preform at its neck over that of the mold, and of its body over that
_THIN = 0.7  # of the preform's thickness, that it is thick in its neck
_SHARE = 0.35  # of the body's radius, that the preform is thick at most
_ROD = 0.63  # radius of the rod over that of the preform
_NECK = 1.15  # times its least radius: where the bottle is as wide, its neck ends
_TOP = 0.25  # of the length, in which the neck is
_NARROW, _HOOP = 0.85, 5.0  # radius of a neck over that of the body at most; largest stretch around that is written
_GAP = 0.025  # of the radius: between rod and preform at first, and twice that between rod and mold in the end
_POINTS = 8  # of the round end
_LIMIT, _SPARE = 25.0, 1.7  # of Gent's model; and at least so many times I1 - 3 of the mean stretches
_ELEMENTS, _MORE = 600, 1500  # of a quarter; the second for a bottle that is not round
_MOLD = "mold.stl"
_BLOCKS = "taken as blocks of a mold, of which the cavity is the bottle"
_MODELLED = {"quarter": ("a quarter", 1), "half": ("half", 2), "none": ("all", 4)}  # of a bottle, and in quarters
_RADIUS, _VOLUME, _ORIFICE, _DEAD = 0.03, 4.2e-4, 1.0e-5, 5.0e-6  # of the built-in bottle, whose air fits it


Files = tuple[dict[str, str], dict[str, Mesh]]
"""Texts and meshes of a first scene, by the names of their files."""


def draft_bottle(
    paths: Sequence[Path], scale: float | None = None, thickness: float | None = None
) -> tuple[Files, list[str]]:
    """A first scene for a bottle, whose files are its inside, its outside, or both.

    Args:
        paths: The mesh files.
        scale: Metres per unit of the files; guessed by default.
        thickness: Thickness of the preform [m]; by default for a usual wall.

    Returns:
        Its files, and lines of text on the findings and choices.

    Raises:
        InputError: A file cannot be read, or is no bottle with a neck and without a handle.
    """
    surfaces, units, extent = read_bottle(paths, scale)
    (outside, body), told = find_in(surfaces, _find_body)
    neck = _neck_radius(body) if outside is None else revolution.mean_revolution(outside.mesh)[1]
    if neck > _NARROW * body.radius:
        problem = (
            f"has no neck: it is {2e3 * neck:.3g} mm wide at its narrow end and {2e3 * body.radius:.3g} mm elsewhere"
        )
        raise InputError(problem, "leave --process out for a sheet that is formed into it")
    around = body.radius / (neck * _FIT * _BODY)
    farthest = around if outside is None else around * _farthest(outside) / body.radius
    if farthest > _HOOP:
        problem = (
            f"would be stretched {farthest:.2g} times in hoop direction: its neck is narrow compared with its body"
        )
        raise InputError(problem, "write the scene by hand from stretch-blow-bottle, with a wider preform")
    preform = _preform(body, neck)
    gain = make_meridian(body.profile).area / make_meridian(preform).area
    usual = min(_WALL * body.radius * gain, _SHARE * neck * _FIT * _BODY)
    thick = choose_thickness(thickness, usual, float(preform[:, 0].max()), "the radius of the preform")
    shoulder = _shoulder(body, neck)
    along = (body.length - shoulder) / (float(preform[:, 1].max()) - shoulder)
    scene = _scene(paths, body, preform, thick, thick / gain, (around, along), outside)
    lines = [describe_box(units, extent), *told, _describe_axis(units, body, outside)]
    lines += _describe(body, preform, thick, thick / gain, (around, along))
    surfaces = {} if outside is None else {_MOLD: outside.mesh}
    return ({"scene.toml": scene, "study.toml": _STUDY}, surfaces), lines


def _find_body(surface: Mesh) -> tuple[BottleBody | None, Revolution]:
    """The outside of a bottle that is not round, else None; and the body of revolution that it is, or nearly is."""
    try:
        return None, revolution.find_revolution(surface)
    except InputError:
        pass
    try:
        outside = bottles.find_body(surface)
    except InputError as error:
        raise replace(error, problem=f"is not a body of revolution, and {error.problem}") from None
    return outside, revolution.mean_revolution(outside.mesh)[0]


def read_bottle(paths: Sequence[Path], scale: float | None) -> tuple[list[Mesh], Units, Array]:
    """The welded surface [m] of some files and those of each, their units, and the sides of the whole in these (3,)."""
    parts = [meshes.read_mesh(path) for path in paths]
    raw = parts[0] if len(parts) == 1 else meshes.merge(parts)
    extent = np.ptp(raw.positions[np.unique(raw.triangles)], axis=0)
    units = guess_units(extent, scale)
    surfaces = []
    for mesh in (raw, *parts):
        welded = meshes.drop_fins(meshes.weld(mesh, footprint.WELD * meshes.size(raw.positions)))
        surfaces.append(footprint.weld_mold(welded.positions * units[0], welded.triangles))
    return surfaces, units, extent


def find_in[Found](surfaces: Sequence[Mesh], find: Callable[[Mesh], Found]) -> tuple[Found, list[str]]:
    """A bottle that a function finds: in the surface of a bottle, or in the cavity of mold blocks.

    Args:
        surfaces: Surfaces of `read_bottle` [m].
        find: The function.

    Returns:
        The bottle, and a line of text where it is the cavity of blocks.

    Raises:
        InputError: The function finds none in either.
    """
    whole, *parts = surfaces
    cavities = bottles.block_cavities(parts)
    # The narrow end of closed blocks may be a corner of theirs, which is no neck.
    first = cavities[:1] if cavities and bottles.neck_error(cavities[0]) < bottles.neck_error(whole) else []
    for cavity in first:
        with contextlib.suppress(InputError):
            return find(cavity), [_BLOCKS]
    try:
        return find(whole), []
    except InputError:
        for cavity in cavities[len(first) :]:
            with contextlib.suppress(InputError):
                return find(cavity), [_BLOCKS]
        raise


def _neck_radius(body: Revolution) -> float:
    """Least radius [m] of a bottle near its neck."""
    near = body.profile[:, 1] <= _TOP * body.length
    return float(body.profile[near, 0].min())


def _farthest(outside: BottleBody) -> float:
    """The largest distance [m] of a bottle's surface from its axis."""
    return float(np.linalg.norm(outside.mesh.positions[:, :2], axis=1).max())


def _preform(body: Revolution, neck: float) -> Array:
    """The middle of the preform's wall: straight in the neck, then narrower, with a round end."""
    shoulder = _shoulder(body, neck)
    end = shoulder + (body.length - shoulder) / _AXIAL
    top, radius, straight = neck * _FIT, neck * _FIT * _BODY, 0.8 * shoulder
    angle = np.linspace(0.0, 0.5 * math.pi, _POINTS)
    rounded = np.stack([radius * np.cos(angle), end - radius + radius * np.sin(angle)], axis=1)
    rounded[-1, 0] = 0.0
    narrower = min(straight + 0.1 * (end - shoulder), end - 1.1 * radius)
    return np.concatenate([[[top, 0.0], [top, straight], [radius, narrower]], rounded])


def _shoulder(body: Revolution, neck: float) -> float:
    """The height [m] at which a neck of this radius ends: the bottle is wider from there on."""
    side = body.profile[::-1]
    wide = int(np.argmax(side[:, 0] > _NECK * neck))
    (r, z), (s, t) = side[wide - 1], side[wide]
    return float(z + (t - z) * (_NECK * neck - r) / (s - r))


def write_files(folder: Path, files: Files) -> list[Path]:
    """Writes the files of a first scene into a folder that is there, and returns their paths."""
    texts, surfaces = files
    for name, text in texts.items():
        with atomic_path(folder / name) as fresh:
            fresh.write_text(text, encoding="utf-8")
    for name, surface in surfaces.items():
        with atomic_path(folder / name) as fresh:
            meshes.write_stl(fresh, surface.positions, surface.triangles)
    return [folder / name for name in (*texts, *surfaces)]


def _volume(body: Revolution) -> float:
    """Volume of the bottle [m^3]."""
    return abs(make_meridian(body.profile).volume)


def _describe_axis(units: Units, body: Revolution, outside: BottleBody | None) -> str:
    """A line on the axis that was found, and how much of the bottle is modelled."""
    origin, axis = (body.origin, body.axis) if outside is None else (outside.origin, outside.rotation[2])
    (x, y, z), (a, b, c) = np.round(origin / units[0], 4) + 0.0, np.round(axis, 4) + 0.0
    place = f"the axis from its neck at ({x:g}, {y:g}, {z:g}) along ({a:g}, {b:g}, {c:g}) of the file"
    if outside is None:
        return f"it is round about {place}"
    x, y, z = np.round(outside.rotation[0], 4) + 0.0
    return f"it has {place}; {_MODELLED[outside.symmetry][0]} of it is modelled, x is ({x:g}, {y:g}, {z:g}) of the file"


def _describe(
    body: Revolution, preform: Array, thickness: float, wall: float, stretches: tuple[float, float]
) -> Iterator[str]:
    """Lines on what was chosen; the arguments are those of `_scene`."""
    yield (
        f"it is {1e3 * body.length:.3g} mm long, {2e3 * body.radius:.3g} mm wide with a neck of "
        f"{2e3 * body.neck:.3g} mm, and holds {1e6 * _volume(body):.3g} ml"
    )
    mass, end = 1.33e6 * make_meridian(preform).area * thickness, float(preform[:, 1].max())
    around, along = stretches
    yield (
        f"preform: {1e3 * end:.3g} mm long, {1e3 * thickness:.3g} mm thick, {mass:.3g} g; stretched "
        f"{around:.2g} times in hoop direction and {along:.2g} times along the axis, to a mean wall of "
        f"{1e3 * wall:.2g} mm"
    )
    yield "guessed: preform, rod, air and times; the material is a placeholder"


def describe_box(units: Units, size: Array) -> str:
    """The bounding box of a bottle, of this size (3,) in its file's units, and what these were taken for."""
    box, (_, name, others) = " x ".join(f"{side:.4g}" for side in size), units
    told = others or "--scale overrides this"
    return f"the bottle's bounding box is {box} in its file's units, assumed to be {name} ({told})"


def _points(points: Array) -> str:
    """Points (k, 2) [m] as rows of TOML."""
    rows = [f"[{r:.6g}, {z:.6g}]" for r, z in np.round(points, 6) + 0.0]
    lines = [", ".join(rows[k : k + 5]) for k in range(0, len(rows), 5)]
    return "[\n" + "".join(f"    {line},\n" for line in lines) + "]"


def _thickness(preform: Array, thickness: float) -> str:
    """The thickness along z, thinner in the neck."""
    at = [round(float(z), 6) for z in preform[1:3, 1]]
    return inline({"along": "z", "at": at, "value": [round_digits(_THIN * thickness), thickness]})


def _scene(
    paths: Sequence[Path],
    body: Revolution,
    preform: Array,
    thickness: float,
    wall: float,
    stretches: tuple[float, float],
    outside: BottleBody | None,
) -> str:
    """The scene file.

    Args:
        paths: The mesh files.
        body: The bottle's surface [m]; of one that is not round, the body of revolution with its mean section.
        preform: Points r, z [m] of the preform from the neck to the round end (k, 2).
        thickness: Thickness of the preform [m].
        wall: Mean wall of the bottle [m].
        stretches: Mean stretches of the body around and along the axis.
        outside: The outside of a bottle that is not round; None for a round one.
    """
    around, along = stretches
    symmetry = "quarter" if outside is None else outside.symmetry
    modelled = _MODELLED[symmetry][1]
    share = _volume(body) / _VOLUME * modelled
    gap, end = _GAP * body.radius, float(preform[:, 1].max())
    start = end - gap
    bottom = float(body.profile[0, 1])
    stroke = bottom - 2.0 * gap - start
    # As much as the built-in bottle's wall over its radius, but not less than its air.
    pressure = max(1.0, wall / (_WALL * body.radius))
    limit = max(_LIMIT, _SPARE * (around**2 + along**2 - 3.0))
    mold = np.concatenate([body.profile, [[body.profile[-1, 0], -0.01 * body.length]]])
    values = {
        "name": inline(Path(paths[0]).stem),
        "file": paths[0].name,
        "preform": _points(preform),
        "thickness": _thickness(preform, thickness),
        "limit": f"{limit:.3g}",
        "supply": inline([round_digits(8e5 * pressure)] * 4 + [round_digits(4e6 * pressure)]),
        "orifice": f"{_ORIFICE * share:.3g}",
        "dead": f"{_DEAD * share:.3g}",
        "elements": str((_ELEMENTS if outside is None else _MORE) * modelled),
        "symmetry": symmetry,
        "part": _MODELLED[symmetry][0],
        "mold": fill_template(_ROUND, {"profile": _points(mold)}) if outside is None else _OUTSIDE,
        "rod": f"{_ROD * float(preform[2:, 0].max()):.4g}",
        "length": f"{1.2 * body.length:.4g}",
        "start": f"{start:.6g}",
        "stroke": f"{stroke:.6g}",
    }
    return fill_template(_SCENE, values)


def fill_template(text: str, values: dict[str, str]) -> str:
    """A text in which each <key> is its value."""
    for key, value in values.items():
        text = text.replace(f"<{key}>", value)
    return text


_SCENE = """# Written by `jaxform new --process stretch-blow` for <file>. SI units everywhere: m, s, kg, Pa.
# A rod stretches the preform to the bottom of the mold; air blows it up meanwhile, then presses it into the mold. The
# neck is at z = 0; the axis is z.
name = <name>

# The middle of the preform's wall, from the neck to the round end.
[parison]
shape = "preform"
profile = <preform>
elements = <elements>
symmetry = "<symmetry>"
thickness = <thickness>  # m
temperature = 105.0

# A placeholder for PET: `jaxform fit` fits the parameters to your tests.
[material]
model = "gent"
mu = 1.0e6
j_max = <limit>
density = 1330.0

[material.viscous]
kind = "maxwell"
modulus = [1.5e6, 6.0e5]
time = [0.02, 0.2]

[material.shift]
kind = "wlf"
reference = 105.0
c1 = 11.03
c2 = 81.6

# Pre-blow with a fifth of the valve, then the blow. The orifice is that of <part> of the valve.
[gas]
time = [0.0, 0.05, 0.06, 0.16, 0.17]
supply_pressure = <supply>  # Pa, gauge
orifice_area = <orifice>  # m^2
valve = [0.0, 0.0, 0.2, 0.2, 1.0]
dead_volume = <dead>  # m^3

<mold>
[[tool]]
name = "rod"
shape = "rod"
radius = <rod>
length = <length>
translate = [0.0, 0.0, <start>]
direction = [0.0, 0.0, 1.0]
time = [0.0, 0.1]
displacement = [0.0, <stroke>]
contact = "coulomb"
friction = 0.2

[solver]
end_time = 0.3
damping = 100.0
"""

_ROUND = """# The outside of the file's surface, from the middle of the bottom to the neck.
[mold]
shape = "revolved"
profile = <profile>
segments = 96
"""

_OUTSIDE = f"""# The outside of the file's surface, without the rim of its neck.
[mold]
shape = "file"
path = "{_MOLD}"
"""

_STUDY = """# Written by `jaxform new --process stretch-blow`: the times of rod and air for an even wall.
scene = "scene.toml"

[[variable]]
kind = "scale"
of = "tool.rod.time"
bounds = [0.6, 1.25]

[[variable]]
kind = "scale"
of = "gas.time"
bounds = [0.75, 1.35]

[objective]
kind = "uniform"

[solver]
method = "lbfgs"
iterations = 3
"""

"""A first scene of extrusion blow moulding for the surface of a bottle: tube, closing mold half, air."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from jaxform.core.errors import warn_of
from jaxform.io.bottle_wizard import Files, describe_box, fill_template, find_in, read_bottle
from jaxform.io.scene_choices import choose_thickness, round_digits
from jaxform.io.scene_rewriting import inline
from jaxform.mesh import topology
from jaxform.tools import bottles
from jaxform.tools.bottles import HalfBottle

Array = NDArray[np.float64]

HALF = "half.stl"
_FIT, _WIDE_FIT = 0.8, 0.92  # radius of the parison over that of the neck; the second for a bottle with a handle
_ELEMENTS, _MORE, _MANY = 2000, 3000, 6000  # the second for a bottle with a handle, the third for one farther away
_WALL = 0.025  # mean wall of the bottle over the radius of a cylinder of its length and area
_SHARE = 0.4  # of the parison's radius, that it is thick at most
_TAIL, _LAND = 0.12, 0.2  # of the bottle's length: parison below the bottom, and the land's width
_GAP = 0.15  # of the parison's radius, between it and the mold half at first
_REACH, _COVER = 0.2, 0.67  # of a handle's width, over which the flattened parison lies at least, and is to lie
_BLOWN = 3.5  # width of a bottle over that of the flattened parison, at most
_CORNERS = 4.0  # times as much air for a bottle that is wider: its corners are stretched far, and bear more
_PINCHED = 1.15  # radius of a parison that is wider than the neck over that of the neck, at least
_WITHIN = 0.95  # of the bottle's width beside its axis, that the flattened parison reaches at most
_BELOW = 0.002  # of the length, between the end of a parison that is wider than the neck and that of the mold
_ABOVE = 1e-4  # of the length, between the mold and the blow pin
_C, _DENSITY = 2.0e5, 950.0  # of the placeholder
_SUPPORT, _BLOW, _LEAST = 0.07, 28.0, 8.0e5  # air, over c h / r; and the blow in Pa at least
# The air when the halves meet. A tube that cannot become longer is blown up without limit by 2 (1 + alpha) c h / r,
# here 3: less leaves it narrower than the cavity, and only a parison that is narrow for a handle needs more.
_SPREAD, _HANDLE_SPREAD, _WIDE_SPREAD = 2.5, 3.5, 2.0


def draft_extrusion(
    paths: Sequence[Path], scale: float | None = None, thickness: float | None = None
) -> tuple[Files, list[str]]:
    """A first scene for a bottle, whose files are its inside, its outside, both, or half of these.

    Args:
        paths: The mesh files.
        scale: Metres per unit of the files; guessed by default.
        thickness: Thickness of the parison [m]; by default for a usual wall.

    Returns:
        Its files, and lines of text on the findings and choices.

    Raises:
        InputError: A file cannot be read, or is no bottle with a neck and a plane of symmetry.

    Warns:
        InputWarning: The flattened parison does not reach a handle.
    """
    surfaces, units, extent = read_bottle(paths, scale)
    half, told = find_in(surfaces, bottles.find_bottle)
    holes = _find_holes(half)
    radius = _choose_radius(half, holes)
    gain = half.area / (math.pi * radius * half.length)
    usual = _WALL * half.area / (math.pi * half.length) * gain
    thick = choose_thickness(thickness, min(usual, _SHARE * radius), radius, "the radius of the parison")
    _warn_of_handles(holes, radius)
    texts = {"scene.toml": _scene(paths, half, radius, thick, bool(holes)), "study.toml": _study(thick)}
    lines = [describe_box(units, extent), *told, *_describe(half, radius, thick, thick / gain, len(holes))]
    return (texts, {HALF: half.mesh}), lines


def _find_holes(half: HalfBottle) -> list[tuple[float, float, float]]:
    """The handle's holes in the outline of the half, in the parting plane.

    Returns:
        For each hole the distances from the axis [m] between which it lies, and the outer edge of the handle there.
    """
    positions = half.mesh.positions
    edges, part = topology.open_rims(half.mesh.triangles, len(positions))
    outline = positions[edges]
    flat = (outline[..., 0] == 0.0).all(1)
    found = []
    for number in np.unique(part):
        loop = outline[part == number]
        if not flat[part == number].all():
            continue
        y, z = loop[..., 1], loop[..., 2]
        side = 1.0 if y.mean() > 0.0 else -1.0
        beside = (part != number) & flat & (np.abs(outline[..., 2].mean(1) - z.mean()) <= 0.25 * np.ptp(z))
        edge = float((side * outline[beside][..., 1]).max(initial=0.0))
        found.append((float((side * y).min()), float((side * y).max()), edge))
    return found


def _choose_radius(half: HalfBottle, holes: list[tuple[float, float, float]]) -> float:
    """The parison's radius [m]: within the neck, or wider for a handle that it does not reach, or for a wide bottle."""
    usual = (_WIDE_FIT if holes else _FIT) * half.neck
    least = float(np.ptp(half.mesh.positions[:, 1])) / (math.pi * _BLOWN)
    usual = max(usual, least if least <= _WIDE_FIT * half.neck else max(least, _PINCHED * half.neck))
    reach = max((inner + _REACH * (outer - inner) for _, inner, outer in holes), default=0.0)
    if 0.5 * math.pi * usual >= reach:
        return round_digits(usual)
    wanted = max(inner + _COVER * (outer - inner) for _, inner, outer in holes)
    beside = float(np.abs([half.mesh.positions[:, 1].min(), half.mesh.positions[:, 1].max()]).min())
    return round_digits(max(usual, min(wanted, _WITHIN * beside) / (0.5 * math.pi)))


def _warn_of_handles(holes: list[tuple[float, float, float]], radius: float) -> None:
    """Warns of handles that the flattened parison, which is a tube of a radius [m], does not reach."""
    reach = 0.5 * math.pi * radius
    for _, inner, outer in holes:
        if reach < inner + _REACH * (outer - inner):
            problem = (
                f"has a handle from {1e3 * inner:.3g} to {1e3 * outer:.3g} mm beside its axis, and the flattened "
                f"parison reaches {1e3 * reach:.3g} mm: the handle may stay empty"
            )
            warn_of(problem, "give the parison a larger radius (parison.radius), or a wider neck", key="--mold")


def _describe(half: HalfBottle, radius: float, thickness: float, wall: float, hole_count: int) -> Iterator[str]:
    """Lines on the findings and choices: radius and thickness of the parison, and the bottle's mean wall [m]."""
    (a, b, c), (d, e, f) = (np.round(row, 4) + 0.0 for row in (half.rotation[2], half.rotation[0]))
    yield (
        f"its neck is at the end along ({a:g}, {b:g}, {c:g}) of the file; the normal of its parting plane is along "
        f"({d:g}, {e:g}, {f:g})"
    )
    wide = float(np.ptp(half.mesh.positions[:, 1]))
    holes = f", with {hole_count} hole{'s' if hole_count > 1 else ''} beside a handle" if hole_count else ""
    size = f"{1e3 * half.length:.3g} mm long and {1e3 * wide:.3g} mm wide"
    yield f"it is {size}, with a neck of {2e3 * half.neck:.3g} mm{holes}"
    wider = f", wider than the neck, {'to reach the handle' if hole_count else 'as the bottle is wide'},"
    wider = wider if radius > half.neck else ","
    mass = 2e3 * _DENSITY * math.pi * radius * half.length * (1.0 + _TAIL) * thickness
    yield (
        f"parison: {2e3 * radius:.3g} mm wide{wider} {1e3 * thickness:.3g} mm thick, {mass:.3g} g with its flash; "
        f"for a mean wall of {1e3 * wall:.2g} mm"
    )
    yield "guessed: parison, closing, air and times; the material is a placeholder"


def _scene(paths: Sequence[Path], half: HalfBottle, radius: float, thickness: float, has_handle: bool) -> str:
    """The scene file, of a parison of this radius and thickness [m]."""
    tail, wide = _TAIL * half.length, _LAND * half.length
    gap = round_digits((1.0 + _GAP) * radius)
    is_wide = radius > half.neck
    air, spread = _C * thickness / radius, _HANDLE_SPREAD if has_handle else _SPREAD
    elements = _MORE if has_handle else _ELEMENTS
    if is_wide:
        spread, elements = _WIDE_SPREAD if has_handle else _SPREAD, _MANY
    low, high = half.mesh.positions.min(0), half.mesh.positions.max(0)
    blow = _BLOW * (_CORNERS if is_wide and not has_handle else 1.0)
    width = float(high[1] - low[1]) + 2.0 * wide
    values = {
        "name": inline(Path(paths[0]).stem),
        "file": paths[0].name,
        "radius": f"{radius:.6g}",
        "elements": str(elements),
        "length": f"{half.length * (1.0 - _BELOW * is_wide) + tail:.6g}",
        "end": "guided" if is_wide else "clamped",
        "held": "both are pinched: it is wider than the neck" if is_wide else "the machine holds the upper end",
        "thickness": f"{thickness:.6g}",
        "pressure": inline([0.0, *(round_digits(air * share) for share in (_SUPPORT, spread))])[:-1]
        + f", {round_digits(max((1.0 + 0.5 * is_wide) * _LEAST, blow * air)):.6g}]",
        "half": HALF,
        "land": f"{wide:.6g}",
        "gap": f"{gap:.6g}",
        "tail": f"{tail:.6g}",
        "plate": inline([round(half.length + tail + 0.1 * half.length, 6), round(width, 6)]),
        "corner": inline([0.0, round(float(low[1]) - wide, 6), round(-0.05 * half.length, 6)]),
        "pin": f"{1.1 * half.neck:.6g}",
        "top": f"{half.length + tail:.6g}",
        # A little above the mold, whose file is rounded.
        "above": f"{half.length * (1.0 + _ABOVE) + tail:.6g}",
    }
    return fill_template(_SCENE, values)


def _study(thickness: float) -> str:
    bounds = inline([round_digits(0.3 * thickness), round_digits(2.5 * thickness)])
    return fill_template(_STUDY, {"bounds": bounds})


_SCENE = """# Written by `jaxform new --process extrusion-blow` for <file>. SI units everywhere: m, s, kg, Pa.
# A tube hangs between two mold halves, of which one is modelled, with half of the tube. It closes on the parting plane,
# x = 0, and pinches the tube; what lies on its land is flash, and no part. Then air blows the tube into the mold.
# The axis is z; the bottle's bottom is at z = <tail>, its neck at z = <top>.
name = <name>

[parison]
shape = "tube"
radius = <radius>
length = <length>
elements = <elements>
symmetry = "half"
ends = ["guided", "<end>"]  # <held>
thickness = <thickness>  # m

# A placeholder: `jaxform fit` fits the parameters to your tests.
[material]
model = "mooney-rivlin"
c = 2.0e5
alpha = 0.5
density = 950.0
tension_field = true

# Support air, air that spreads the tube until the halves meet, then the blow.
[pressure]
time = [0.0, 0.11, 0.2, 0.3]
value = <pressure>  # Pa

# Half of the bottle's outside, without the rim of its neck, and its land.
[mold]
shape = "file"
path = "<half>"
land = <land>
translate = [<gap>, 0.0, <tail>]

[mold.motion]
direction = [-1.0, 0.0, 0.0]
time = [0.0, 0.2]
displacement = [0.0, <gap>]

[[tool]]
name = "parting-plane"
shape = "plate"
size = <plate>
rotate = [0.0, -90.0, 0.0]
translate = <corner>

[[tool]]
name = "blow-pin"
shape = "plate"
radius = <pin>
translate = [0.0, 0.0, <above>]

[solver]
end_time = 0.34
damping = 200.0
"""

_STUDY = """# Written by `jaxform new --process extrusion-blow`: the parison's wall along its length for an even bottle.
scene = "scene.toml"

[[variable]]
kind = "thickness-profile"
along = "z"
knots = 8
bounds = <bounds>

[objective]
kind = "uniform"

[solver]
method = "lbfgs"
iterations = 4
"""

"""A first scene for a mold: its units, the sheet's place, mesh and thickness, and a pressure that fills it slowly."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from jaxform.core.errors import InputError
from jaxform.io import scene_choices
from jaxform.io.geometry import error_context
from jaxform.io.plausibility import guess_units
from jaxform.io.scene_choices import PROCESSES, Draft, Plug, choose_thickness, clearance, round_digits
from jaxform.mesh import meshes, outlines
from jaxform.mesh.grids import triangle_side
from jaxform.mesh.meshes import Mesh
from jaxform.mesh.outlines import Circle, OrientedRectangle
from jaxform.tools import bottles, covers, footprint, kinds, molds, opening, patches, plugs
from jaxform.tools.covers import Covers
from jaxform.tools.footprint import Planform, planform_polygon
from jaxform.tools.opening import Opening

Array = NDArray[np.float64]

_THICKNESS = 0.008  # of the sheet's width
_ELEMENTS, _MOST = 8000, 16000  # about how many, and where pockets are small
_DRAPED = 12000  # the same over a buck, at whose foot they are stretched
_ACROSS = 16  # elements across the smallest pocket
_SPECK = 0.02  # of the cavity's area: the smallest parts that are less together are no pockets
_LEVEL = 0.01  # of the cavity's depth: what is at one height, but for rounding
_RESOLVED = 2.0  # pixels: half the width below which a part of the cavity is not seen as it is
_SLIT, _SLIT_AREA = 4.0, 0.25  # a slit's depth in half widths at least, and at most of the cavity's area


def draft(
    paths: Sequence[Path],
    *,
    scale: float | None = None,
    thickness: float | None = None,
    drape: bool | None = None,
    direction: Array | None = None,
    process: str = PROCESSES[0],
    plug: Path | Literal["auto"] | None = None,
) -> Draft:
    """A first scene for a mold.

    Args:
        paths: The mesh files that are the mold.
        scale: Metres per unit of the files; by default guessed from the mold's size.
        thickness: Thickness of the sheet [m]; by default in proportion to its width.
        drape: True if the mold is a buck; by default as it seems.
        direction: Unit vector (3,) to the side from which the sheet comes, in the file's axes; found by default.
        process: One of `PROCESSES`.
        plug: The mesh file of a plug, or "auto" for one that is made by an offset of the cavity; None without one.

    Raises:
        InputError: A file cannot be read, or the mold has no opening and nothing stands out of it.
    """
    parts = [meshes.read_mesh(path) for path in paths]
    raw = parts[0] if len(parts) == 1 else meshes.merge(parts)
    extent = np.ptp(raw.positions[np.unique(raw.triangles)], axis=0)
    unit, units, other_units = guess_units(extent, scale)
    mold = footprint.weld_mold(raw.positions * unit, raw.triangles)
    is_male, doubt, completion = _classify(mold, drape, direction)
    rest, planes = completion or (None, ())
    known: dict[str, Any] = {
        "scale": unit,
        "units": units,
        "other_units": other_units,
        "guessed": scale is None,
        "size": extent,
        "process": process,
        "planes": planes,
        "doubt": doubt,
    }
    if is_male:
        if plug is not None:
            problem, remedy = "pushes a sheet into a cavity, and this mold is male", "leave it out, or give --cavity"
            raise InputError(problem, remedy, "--plug", str(plug))
        return _draft_buck(mold, thickness, direction, known)
    return _draft_cavity(mold, rest, thickness, direction, plug, known)


def _classify(mold: Mesh, drape: bool | None, direction: Array | None) -> tuple[bool, str, kinds.Completion | None]:
    """The kind of a mold as the user wants it or as it seems, see `kinds.classify`."""
    if drape is not None:
        completion = None if drape or direction is not None else kinds.find_completion(mold)
        return drape, "", completion
    patches.refuse_bottles(mold)
    kinds.refuse_tubes(mold)
    is_male, doubt, completion = kinds.classify(mold)
    return is_male, (bottles.describe_bottle(mold) if is_male else "") or doubt, completion


def _draft_cavity(
    mold: Mesh,
    rest: Mesh | None,
    thickness: float | None,
    direction: Array | None,
    plug: Path | Literal["auto"] | None,
    known: dict[str, Any],
) -> Draft:
    """A first scene in which a sheet is formed into a cavity, from the `known` fields of its `Draft`."""
    if rest is not None:
        whole = meshes.merge([mold, rest])
        mold = footprint.weld_mold(whole.positions, whole.triangles)
    found = opening.find_opening(mold.positions, mold.triangles, male=False, direction=direction)
    planform, flange = footprint.fit_planform(found, mold.positions, mold.triangles)
    rotate, translate, polygon = _place(found, planform)
    area = abs(outlines.area(polygon))
    width = _width(polygon, area)
    pocket, slit = _pockets(found)
    pocket = min(pocket, 0.5 * width)
    thickness = choose_thickness(thickness, _THICKNESS * width, width, "the width of the sheet")
    return Draft(
        **known,
        rotate=rotate,
        translate=translate,
        polygon=polygon,
        found=found,
        planform=planform,
        flange=flange,
        rest=rest,
        covers=covers.cover(found, planform_polygon(planform), mold),
        width=width,
        pocket=pocket,
        slit=slit,
        thickness=thickness,
        element_size=_element_size(pocket, area, _ELEMENTS),
        plug=None if plug is None else _plug(found, plug, known["scale"], thickness, (rotate, translate)),
    )


def _plug(
    found: Opening, path: Path | Literal["auto"], scale: float, thickness: float, place: tuple[Array, Array]
) -> Plug:
    """The plug that the user wants, before the sheet; `place` is the rotation [degrees] and translation of the mold."""
    start, turn, (rotate, translate) = clearance(thickness), found.view.turn, place
    to_scene = molds.rotation(rotate) @ turn.T
    level = np.array([0.0, 0.0, found.level])
    if path == "auto":
        made, stroke = plugs.offset_plug(found, start)
        positions = (made.positions + level) @ to_scene.T + translate
        return Plug(meshes.box_sides(made), stroke, None, replace(made, positions=positions), np.zeros(3))
    with error_context("", "--plug"):
        own = meshes.weld(meshes.read_mesh(path, scale=scale))
        stroke, shift = plugs.place_plug(replace(own, positions=own.positions @ turn.T - level), found, start)
    moved = replace(own, positions=own.positions @ turn.T - level + shift)
    return Plug(meshes.box_sides(moved), stroke, path, None, np.round(translate + to_scene @ shift, 9) + 0.0)


def _draft_buck(mold: Mesh, thickness: float | None, direction: Array | None, known: dict[str, Any]) -> Draft:
    """A first scene in which a sheet is draped over a buck, from the `known` fields of its `Draft`."""
    made = scene_choices.drape(mold, direction)
    planform = made.planform
    outline = planform_polygon(planform)
    area = abs(outlines.area(outline))
    width = _width(outline, area)
    thickness = choose_thickness(thickness, _THICKNESS * width, width, "the width of the sheet")
    found = made.opening(thickness)
    rotate, translate, polygon = _place(found, planform)
    return Draft(
        **known,
        rotate=rotate,
        translate=translate,
        polygon=polygon,
        found=found,
        planform=planform,
        flange=True,
        rest=None,
        covers=Covers(made.added, made.holes, 0.0),
        width=width,
        pocket=made.narrowest,
        slit=None,
        thickness=thickness,
        element_size=_element_size(made.narrowest, area, _DRAPED),
        drape=made,
    )


def _element_size(pocket: float, area: float, elements: float) -> float:
    """Element size [m], by half the narrowest width [m] and the sheet's area [m^2], for about so many elements."""
    fine = max(2 * pocket / _ACROSS, triangle_side(area, _MOST))
    return round_digits(min(fine, triangle_side(area, elements)))


def _place(found: Opening, planform: Planform) -> tuple[Array, Array, Array]:
    """Placement of the mold that puts the sheet in the plane of zero height.

    Returns:
        The mold's rotation [degrees] and translation [m], (3,) each, and the sheet's polygon (k, 2) [m] there.
    """
    axes = planform.axes if isinstance(planform, OrientedRectangle) else np.eye(2)
    turn = np.eye(3)
    turn[:2, :2] = axes
    rotate = np.round(molds.angles(turn @ found.view.turn), 9) + 0.0
    exact = molds.rotation(rotate)
    # In the plane of the view, then as the mold is turned in the scene.
    if isinstance(planform, Circle):
        origin = planform.center
    elif isinstance(planform, OrientedRectangle):
        origin = planform.corner
    else:
        origin = 0.5 * (planform.min(0) + planform.max(0))
    at = exact @ found.view.turn.T @ np.append(origin, found.level)
    polygon = (planform_polygon(planform) - origin) @ axes.T
    return rotate, np.round(-at, 9) + 0.0, polygon


def _width(polygon: Array, area: float) -> float:
    """Width of a planform [m]: the shorter side of the rectangle round it, less where it fills that poorly."""
    sides = outlines.smallest_rectangle(outlines.hull(polygon)).sides
    return float(min(sides.min(), area / sides.max() * 1.2))


def _pockets(found: Opening) -> tuple[float, float | None]:
    """Half the widths [m] of the narrowest pockets, and of the widest slits, None where there are none.

    They are measured at the clamp plane and half way down.
    """
    view = found.view
    halves, slits = [0.5 * view.pixel * min(view.inside.shape)], []
    for share in () if found.male else (0.0, 0.5):
        level = found.level + (share + _LEVEL) * found.depth
        deep = found.cavity & ~(view.height <= level)
        part, count = outlines.label_parts(deep)
        area, half, bottom = np.bincount(part.ravel()), np.zeros(count + 1), np.full(count + 1, level)
        np.maximum.at(half, part, outlines.distance(deep))
        np.maximum.at(bottom, part, np.minimum(view.height, found.level + found.depth))
        smallest = 1 + np.argsort(half[1:])
        seen = (np.cumsum(area[smallest]) > _SPECK * deep.sum()) & (half[smallest] >= _RESOLVED)
        wide = view.pixel * half
        slit = (bottom - level > _SLIT * wide) & (area < _SLIT_AREA * found.cavity.sum())
        halves += wide[smallest][seen & ~slit[smallest]].tolist()
        slits += wide[smallest][seen & slit[smallest]].tolist()
    return min(halves), max(slits, default=None)

"""A first scene for a mold: its units, where the sheet lies, how fine and thick it is, what fills it slowly."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from jaxform.io import draping
from jaxform.io.draping import Drape
from jaxform.io.units import Units, guess_units
from jaxform.mesh import contours, masks, meshes
from jaxform.mesh.contours import Circle, Rectangle
from jaxform.mesh.meshes import Mesh
from jaxform.mesh.resolution import triangle_side
from jaxform.tools import covers, footprint, halves, kinds, molds, opening, rims
from jaxform.tools.covers import Covers
from jaxform.tools.footprint import Planform
from jaxform.tools.halves import Rest
from jaxform.tools.opening import Opening

Array = NDArray[np.float64]

STIFFNESS, ALPHA, DENSITY = 0.02e6, 0.1, 1000.0
"""Of the placeholder material, a hot thermoplastic sheet: c [Pa], alpha, density [kg/m^3]."""
VACUUM = 0.9e5
"""The pressure difference [Pa] that a vacuum has at most."""
PROCESSES = ("vacuum", "pressure")
"""What pushes the sheet: a vacuum, of at most 0.9 bar, or compressed air."""
_THICKNESS = 0.008  # of the sheet's width
_ELEMENTS, _MOST = 8000, 16000  # about how many, and where pockets are small
_ACROSS, _FEWEST = 16, 6  # elements across the smallest pocket; with fewer the mesh is refined
_CORNER = 0.5  # elements: the radius to which corners are filled, so that stiffer materials fill them too
_RE_ENTRANT = (
    1.3  # the same of an outline, over whose re-entrant edges a sheet folds, and blows up where it is not held
)
_SPECK = 0.02  # of the cavity's area: the smallest parts that are less together are no pockets
_LEVEL = 0.01  # of the cavity's depth: what is at one height, but for rounding
_RESOLVED = 2.0  # pixels: half the width below which a part of the cavity is not seen as it is
_SLIT, _SLIT_AREA = 4.0, 0.25  # a slit's depth in half widths at least, and at most of the cavity's area
_SLOW = 40.0  # ramp, over half the sheet's width times sqrt(density / stiffness)
_SHALLOW, _LONGEST = 1.0, 16.0  # by how much longer where the width is many times the depth
_DAMPING = 2.0  # the same times the damping
_STROKE, _PRESSING = 25.0, 40.0  # the same of the mold's motion, and of the ramp after it


@dataclass(frozen=True)
class Draft:
    """The choices of a first scene.

    Attributes:
        scale: Metres per unit of the mold's file.
        units: The same in words, and what else it may be.
        guessed: Whether the scale was.
        size: Box of the mold as it is in the file (3,).
        rotate: Of the mold [degrees] (3,).
        translate: Of the mold [m] (3,).
        found: The opening.
        planform: Of the sheet, where the mold is in the view.
        polygon: Of the sheet (k, 2) [m] where the scene has it.
        rest: What completes a mold that is cut in a half or a quarter, as its file has it [m]; None where it is whole.
        covers: What closes the mold, as its file has it [m].
        width: Of the sheet [m], the shorter way.
        pocket: Half the width of the smallest pocket [m].
        slit: The same of the widest slits, which are left open; None where there are none.
        thickness: Of the sheet [m].
        element_size: [m]
        process: What pushes the sheet, one of `PROCESSES`.
        drape: How the sheet is draped over a buck; None for a cavity.
        doubt: What the mold may be as well; empty where that is clear.
    """

    scale: float
    units: Units
    guessed: bool
    size: Array
    rotate: Array
    translate: Array
    found: Opening
    planform: Planform
    polygon: Array
    rest: Rest | None
    covers: Covers
    width: float
    pocket: float
    slit: float | None
    thickness: float
    element_size: float
    process: str = PROCESSES[0]
    drape: Drape | None = None
    doubt: str = ""

    @property
    def pressure(self) -> float:
        """The pressure [Pa]: what fills the corners, at most what a vacuum has where that pushes.

        At most what a slit bears too, as thick as the sheet is at first: blown into one it goes in at one place,
        spreads below what is still above it, and meets itself.
        """
        bearable = np.inf if self.slit is None else 2 * STIFFNESS * self.thickness / self.slit
        return _rounded(min(self.filling, bearable, self._most))

    @property
    def filling(self) -> float:
        """The pressure [Pa] that fills the corners down to about an element: 2 T / r of a radius r and a tension T."""
        folds = isinstance(self.planform.shape, np.ndarray)
        return 2 * self._tension / ((_RE_ENTRANT if folds else _CORNER) * self.element_size)

    @property
    def limited(self) -> bool:
        """Whether a vacuum has less than the pressure that fills the corners."""
        return self.pressure == self._most

    def corner(self, pressure: float) -> float:
        """The radius [m] down to which a pressure [Pa] fills corners."""
        return 2 * self._tension / pressure

    @property
    def _most(self) -> float:
        return VACUUM if self.process == PROCESSES[0] else np.inf

    @property
    def _tension(self) -> float:
        """T = 2 c h (1 + alpha stretch^2) [N/m] of a Mooney-Rivlin sheet at large equal stretches.

        These are taken twice as large as those of the sheet's area on average.
        """
        return 2 * STIFFNESS * self.thickness * (1 + ALPHA * 2 * self.draw)

    @property
    def draw(self) -> float:
        """About how many times its area the sheet gets: bottom and walls of the cavity over its opening."""
        return 1.0 + 2 * self.found.depth / self.pocket if self.drape is None else self.drape.draw

    @property
    def ramp(self) -> float:
        """How long the pressure rises [s]."""
        if self.drape is not None:
            return _rounded(_PRESSING * self._time)
        # A shallow mold is touched early, and until then the pressure has to rise as slowly.
        shallow = min(_SHALLOW * 0.5 * self.width / max(self.found.depth, 1e-12), _LONGEST)
        return _rounded(_SLOW * (1.0 + shallow) * self._time)

    @property
    def stroke_time(self) -> float:
        """How long the mold moves before the pressure rises [s]; 0 where it rests."""
        return 0.0 if self.drape is None else _rounded(_STROKE * self._time)

    @property
    def damping(self) -> float:
        """Of the solver [1/s]."""
        return _rounded(_DAMPING / self._time)

    @property
    def levels(self) -> int:
        """How often elements near bends of the mold are bisected: 0 where the mesh is fine enough."""
        # Two bisections halve an element's sides.
        return 2 if self.element_size > 2 * self.pocket / _FEWEST else 0

    @property
    def _time(self) -> float:
        return 0.5 * self.width * float(np.sqrt(DENSITY / STIFFNESS))


@dataclass(frozen=True)
class Wishes:
    """What the user says of a first scene; None where it is to be found.

    Attributes:
        scale: Metres per unit of the files; by default guessed from the mold's size.
        thickness: Of the sheet [m]; by default in proportion to its width.
        drape: Whether the mold is a buck.
        direction: Unit vector (3,) to the side from which the sheet comes, in the file's axes.
        process: One of `PROCESSES`.
    """

    scale: float | None = None
    thickness: float | None = None
    drape: bool | None = None
    direction: Array | None = None
    process: str = PROCESSES[0]


def draft(paths: Sequence[Path], wishes: Wishes | None = None) -> Draft:
    """A first scene for a mold.

    Args:
        paths: The mesh files that are the mold.
        wishes: What the user says.

    Raises:
        InputError: A file cannot be read, or the mold has no opening and nothing stands out of it.
    """
    wishes = wishes or Wishes()
    parts = [meshes.read_mesh(path) for path in paths]
    raw = parts[0] if len(parts) == 1 else meshes.merged(parts)
    extent = np.ptp(raw.positions[np.unique(raw.triangles)], axis=0)
    units = guess_units(extent, wishes.scale)
    read = _Read(rims.welded(raw.positions * units.scale, raw.triangles), extent, units, wishes)
    verdict = _verdict(read.mold, wishes)
    if verdict.drape:
        return replace(_draped(read), doubt=verdict.doubt)
    return replace(_formed(read), doubt=verdict.doubt)


class _Read(NamedTuple):
    """A mold, welded [m], its box as the file has it, and what is said of it."""

    mold: Mesh
    extent: Array
    units: Units
    wishes: Wishes


def _verdict(mold: Mesh, wishes: Wishes) -> kinds.Verdict:
    return kinds.judge(mold) if wishes.drape is None else kinds.Verdict(wishes.drape, "")


def _formed(read: _Read) -> Draft:
    """A first scene in which a sheet is formed into a cavity."""
    mold, wishes = read.mold, read.wishes
    rest = halves.rest(mold) if wishes.direction is None else None
    if rest is not None:
        whole = meshes.merged([mold, rest.mesh])
        mold = rims.welded(whole.positions, whole.triangles)
    found = opening.find(mold.positions, mold.triangles, male=False, direction=wishes.direction)
    planform = footprint.fit(found, mold.positions, mold.triangles)
    rotate, translate, polygon = _placed(found, planform)
    area = abs(contours.outlines.area(polygon))
    width = _width(polygon, area)
    pockets = _pockets(found)
    pocket = min(pockets.half, 0.5 * width)
    return Draft(
        scale=read.units.scale,
        units=read.units,
        guessed=wishes.scale is None,
        size=read.extent,
        rotate=rotate,
        translate=translate,
        found=found,
        planform=planform,
        polygon=polygon,
        rest=rest,
        covers=covers.cover(found, planform.polygon, mold),
        width=width,
        pocket=pocket,
        slit=pockets.slit,
        thickness=wishes.thickness or _rounded(_THICKNESS * width),
        element_size=_element_size(pocket, area),
        process=wishes.process,
    )


def _draped(read: _Read) -> Draft:
    """A first scene in which a sheet is draped over a buck."""
    wishes = read.wishes
    made = draping.drape(read.mold, wishes.direction)
    planform = made.site.planform
    area = abs(contours.outlines.area(planform.polygon))
    width = _width(planform.polygon, area)
    thickness = wishes.thickness or _rounded(_THICKNESS * width)
    found = made.opening(thickness)
    rotate, translate, polygon = _placed(found, planform)
    return Draft(
        scale=read.units.scale,
        units=read.units,
        guessed=wishes.scale is None,
        size=read.extent,
        rotate=rotate,
        translate=translate,
        found=found,
        planform=planform,
        polygon=polygon,
        rest=None,
        covers=Covers(made.added, made.holes, 0.0),
        width=width,
        pocket=made.narrowest,
        slit=None,
        thickness=thickness,
        element_size=_element_size(made.narrowest, area),
        process=wishes.process,
        drape=made,
    )


def _element_size(pocket: float, area: float) -> float:
    """[m], by half the width of what is narrowest [m] and the sheet's area [m^2]."""
    fine = max(2 * pocket / _ACROSS, triangle_side(area, _MOST))
    return _rounded(min(fine, triangle_side(area, _ELEMENTS)))


def _placed(found: Opening, planform: Planform) -> tuple[Array, Array, Array]:
    """How the mold is turned [degrees] and moved [m], and the sheet's polygon (k, 2) [m] where it then is."""
    shape = planform.shape
    axes = shape.axes if isinstance(shape, Rectangle) else np.eye(2)
    turn = np.eye(3)
    turn[:2, :2] = axes
    rotate = np.round(molds.angles(turn @ found.view.turn), 9) + 0.0
    exact = molds.rotation(rotate)
    # In the plane of the view, then as the mold is turned in the scene.
    if isinstance(shape, Circle):
        origin = shape.center
    elif isinstance(shape, Rectangle):
        origin = shape.corner
    else:
        origin = 0.5 * (shape.min(0) + shape.max(0))
    at = exact @ found.view.turn.T @ np.append(origin, found.level)
    polygon = (planform.polygon - origin) @ axes.T
    return rotate, np.round(-at, 9) + 0.0, polygon


def _width(polygon: Array, area: float) -> float:
    """Of a planform [m]: the shorter side of the rectangle round it, less where it fills that badly."""
    sides = contours.smallest_rectangle(contours.hull(polygon)).sides
    return float(min(sides.min(), area / sides.max() * 1.2))


class _Pockets(NamedTuple):
    """Half the widths [m] of the narrowest pockets, and of the widest slits, None where there are none."""

    half: float
    slit: float | None


def _pockets(found: Opening) -> _Pockets:
    """At the clamp plane and half way down."""
    view = found.view
    halves, slits = [0.5 * view.pixel * min(view.inside.shape)], []
    for share in () if found.male else (0.0, 0.5):
        level = found.level + (share + _LEVEL) * found.depth
        deep = found.cavity & ~(view.height <= level)
        part, count = masks.parts(deep)
        area, half, bottom = np.bincount(part.ravel()), np.zeros(count + 1), np.full(count + 1, level)
        np.maximum.at(half, part, masks.distance(deep))
        np.maximum.at(bottom, part, np.minimum(view.height, found.level + found.depth))
        smallest = 1 + np.argsort(half[1:])
        seen = (np.cumsum(area[smallest]) > _SPECK * deep.sum()) & (half[smallest] >= _RESOLVED)
        wide = view.pixel * half
        slit = (bottom - level > _SLIT * wide) & (area < _SLIT_AREA * found.cavity.sum())
        halves += wide[smallest][seen & ~slit[smallest]].tolist()
        slits += wide[smallest][seen & slit[smallest]].tolist()
    return _Pockets(min(halves), max(slits, default=None))


def _rounded(value: float) -> float:
    return float(f"{value:.2g}")

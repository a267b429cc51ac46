"""The choices of a first scene from the geometry of the mold: material, pressure, times, the set-up of a drape."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from jaxform.core.errors import InputError, warn_of
from jaxform.mesh import meshes, outlines
from jaxform.mesh.meshes import Mesh
from jaxform.tools import buck, covers, patches
from jaxform.tools.buck import Buck
from jaxform.tools.covers import Covers
from jaxform.tools.footprint import Planform
from jaxform.tools.kinds import Plane
from jaxform.tools.opening import Opening

Array = NDArray[np.float64]

# A first scene in which a sheet is draped over a male mold: the frame, the platen, the way of the mold.

_REST = 0.1  # of the sheet's thickness, between the platen and the frame in the end
_SHARES = (0.1, 0.5, 0.9)  # of the height, at which the narrowest part of the body is looked for
_SLENDER = 2.5  # times its width: a higher body is not draped without webs that pass through each other
_BOTTLE = "for a bottle use --process extrusion-blow or stretch-blow"
_SPECK = 0.02  # of the body's area: the smallest parts that are less together do not count


@dataclass(frozen=True)
class Drape:
    """A buck and its surroundings: platen, covers and undercut.

    Attributes:
        buck: The buck in its orientation.
        planform: Planform of the sheet, in the plane of the view.
        margin: Distance from the body to the frame [m].
        platen: The surface added around the body, in the file's axes [m]; None where the mold has its own.
        added: Additions to the mold, in its file's axes [m]: platen, walls down to it, covers on holes; None where
            there are none.
        holes: Number of covered holes.
        undercut: Depth [m] and place (3,) [m] of the deepest one, in the file's axes; None where there is none.
    """

    buck: Buck
    planform: Planform
    margin: float
    platen: Mesh | None
    added: Mesh | None
    holes: int
    undercut: tuple[float, Array] | None

    @property
    def narrowest(self) -> float:
        """Half the width of the body's narrowest part [m]."""
        view, found = self.buck.view, []
        for share in _SHARES:
            part, count = outlines.label_parts(view.height <= self.buck.top + share * self.buck.height)
            half, area = np.zeros(count + 1), np.bincount(part.ravel(), minlength=count + 1)
            np.maximum.at(half, part, outlines.distance(part > 0))
            order = 1 + np.argsort(half[1:])
            counted = np.cumsum(area[order]) > _SPECK * area[1:].sum()
            found.append(float(half[order][counted].min()))
        return max(found) * view.pixel

    @property
    def draw(self) -> float:
        """Approximate area stretch of the sheet, which also lines the sides of the body."""
        return 1.0 + 2 * self.buck.height / max(self.narrowest + self.margin, 1e-12)

    def stroke(self, thickness: float) -> float:
        """Stroke of the mold [m] for a sheet of this thickness [m]: until the frame is on the platen."""
        return self.buck.height + clearance(thickness) - _REST * thickness

    def opening(self, thickness: float) -> Opening:
        """The mold as an opening to form into, with the sheet at its clamp plane, before the mold moves."""
        level = self.buck.top - clearance(thickness)
        return Opening(self.buck.view, level, self.buck.base, self.buck.body, True, 1.0, self.buck.height)


def choose_thickness(given: float | None, usual: float, largest: float, words: str) -> float:
    """The thickness of a sheet [m]: the given one, or a usual one, rounded.

    Args:
        given: That of the option --thickness [m].
        usual: A usual one [m].
        largest: Length [m] that it has to be less than.
        words: Name of that length in the message.

    Raises:
        InputError: The given one is not less than that length.
    """
    if given is None:
        return round_digits(usual)
    if given >= largest:
        problem = f"is not less than {words}, {largest:.3g} m"
        raise InputError(problem, "give the thickness in metres", "--thickness", given)
    return given


def clearance(thickness: float) -> float:
    """Initial clearance [m] between a sheet of this thickness [m] and the top of the mold."""
    return 0.5 * thickness


def drape(mold: Mesh, direction: Array | None) -> Drape:
    """Setup for draping a sheet over a welded mold, from a given side (3,), in the file's axes, or from the best one.

    Raises:
        InputError: Nothing stands above a base.
    """
    lids = patches.close_necks(mold)
    stands = buck.find_buck(meshes.merge([mold, *lids]), direction)
    planform, margin, platen = buck.fit_sheet(stands)
    rims = covers.find_rims(mold)
    turn = stands.view.turn
    walls, fans = ([], []) if rims is None else covers.close_rims(mold, rims, turn, stands.base)
    closing = [*lids, *(Mesh(part.positions @ turn, part.triangles) for part in [*walls, *fans])]
    deepest = buck.deepest_undercut(stands, meshes.merge([mold, *closing]))
    parts = [*([] if platen is None else [platen]), *closing]
    added = meshes.merge(parts) if parts else None
    return Drape(stands, planform, margin, platen, added, len(fans) + len(lids), deepest)


def warn(made: Drape, scale: float) -> None:
    """Warns of places that the sheet cannot reach, and of a mold without a base."""
    if made.undercut is not None:
        depth, where = made.undercut
        place = ", ".join(f"{x:.4g}" for x in where / scale)
        problem = (
            f"is undercut by up to {1e3 * depth:.3g} mm, at ({place}) of the file: "
            "the sheet does not touch it there, and the part cannot be released"
        )
        warn_of(problem, "close it in the mold, or give another --direction", key="--mold")
    slender = made.buck.height / (2 * max(made.narrowest, 1e-12))
    if slender > _SLENDER:
        problem = (
            f"is {slender:.2g} times as high as it is wide, and the sheet's area grows to about {made.draw:.2g} times: "
            "it folds into webs there, thins and may burst"
        )
        remedy = f"lay it down with another --direction, or form it in parts; {_BOTTLE}"
        warn_of(problem, remedy, key="--mold")
    if not made.buck.flat:
        problem = "has no flat base: the platen is placed where it is widest, and nothing below is formed"
        remedy = f"give the side from which the sheet comes (--direction), or cut the mold flat; {_BOTTLE}"
        warn_of(problem, remedy, key="--mold")


def lines(made: Drape) -> Iterator[str]:
    """Description of the setup, line by line."""
    side = buck.direction_name(made.buck.direction)
    on = "on the platen of the file" if made.platen is None else "on an added platen (platen.stl)"
    yield f"taken as a male mold, {on}: the sheet comes from {side} of the file and is draped over it"
    if made.buck.others:
        yield f"other orientations are possible: --direction={' or --direction='.join(made.buck.others)}"
    if made.holes:
        yield f"platen.stl closes {made.holes} hole{'s' if made.holes > 1 else ''} too"


STIFFNESS, ALPHA, DENSITY = 0.02e6, 0.1, 1000.0
"""Parameters of the placeholder material, a hot thermoplastic sheet: c [Pa], alpha, density [kg/m^3]."""
VACUUM = 0.9e5
"""The pressure difference [Pa] that a vacuum has at most."""
PROCESSES = ("vacuum", "pressure")
"""Sources of the pressure: a vacuum, of at most 0.9 bar, or compressed air."""
_CORNER = 0.5  # elements: the radius to which corners are filled, so that stiffer materials fill them too
_RE_ENTRANT = (
    1.3  # the same of an outline, over whose re-entrant edges a sheet folds, and blows up where it is not held
)
_FEWEST = 6  # elements across the smallest pocket; with fewer the mesh is refined
_SLOW = 40.0  # ramp, over half the sheet's width times sqrt(density / stiffness)
_SHALLOW, _LONGEST = 1.0, 16.0  # by how much longer where the width is many times the depth
_DAMPING = 2.0  # the same times the damping
_STROKE, _PRESSING = 25.0, 40.0  # the same of the mold's motion, and of the ramp after it


FRICTION = 0.2
"""Coefficient of friction of a plug in a first scene."""


@dataclass(frozen=True)
class Plug:
    """A plug of a first scene.

    Attributes:
        size: Sides of its box (3,) [m], in the axes of the view.
        stroke: The way [m] that it goes into the cavity.
        path: The user's file; None for one that was made by an offset of the cavity.
        mesh: The plug that was made, in the axes of the scene [m], where it starts; None for a user's.
        translate: Translation [m] (3,) of a user's file in the scene.
    """

    size: Array
    stroke: float
    path: Path | None
    mesh: Mesh | None
    translate: Array


@dataclass(frozen=True)
class Draft:
    """The choices of a first scene.

    Attributes:
        scale: Metres per unit of the mold's file.
        units: Name of the unit.
        other_units: Other units that the file may have, in words; empty where it is clear.
        guessed: True if the scale was guessed.
        size: Box of the mold as it is in the file (3,).
        rotate: Rotation of the mold [degrees] (3,).
        translate: Translation of the mold [m] (3,).
        found: The opening.
        planform: Planform of the sheet, in the axes of the view.
        flange: True if it lies on the mold all round, beyond the opening.
        polygon: Polygon of the sheet (k, 2) [m] in the scene.
        rest: Images that complete a mold cut in a half or a quarter, as its file has it [m]; None where it is whole.
        planes: The planes in which the mold is cut, as its file has it [m].
        covers: Covers that close the mold, as its file has it [m].
        width: Width of the sheet [m], the shorter side.
        pocket: Half the width of the smallest pocket [m].
        slit: Half the width of the widest slits [m], which are left open; None where there are none.
        thickness: Thickness of the sheet [m].
        element_size: Size of the elements [m].
        process: Source of the pressure, one of `PROCESSES`.
        drape: Setup for draping over a buck; None for a cavity.
        plug: The plug that pushes the sheet first; None without one.
        doubt: Alternative kind of the mold; empty where that is clear.
        edge_contact: True where the mold has ribs thinner than elements, at whose edges sides are held.
        self_contact: True where the mold has ribs or pins at which the sheet folds.
    """

    scale: float
    units: str
    other_units: str
    guessed: bool
    size: Array
    rotate: Array
    translate: Array
    found: Opening
    planform: Planform
    flange: bool
    polygon: Array
    rest: Mesh | None
    planes: Sequence[Plane]
    covers: Covers
    width: float
    pocket: float
    slit: float | None
    thickness: float
    element_size: float
    process: str = PROCESSES[0]
    drape: Drape | None = None
    plug: Plug | None = None
    doubt: str = ""
    edge_contact: bool = False
    self_contact: bool = False

    @property
    def pressure(self) -> float:
        """The pressure [Pa] that fills the corners, limited to that of a vacuum where that is the source.

        At most what a slit bears too, as thick as the sheet is at first: blown into one it goes in at one place,
        spreads below what is still above it, and meets itself.
        """
        bearable = np.inf if self.slit is None else 2 * STIFFNESS * self.thickness / self.slit
        return round_digits(min(self.filling, bearable, self._most))

    @property
    def filling(self) -> float:
        """The pressure [Pa] that fills the corners down to about an element: 2 T / r of a radius r and a tension T."""
        # A higher pressure would blow up what spans the foot of a buck, too.
        folds = self.drape is not None or isinstance(self.planform, np.ndarray)
        return 2 * self._tension / ((_RE_ENTRANT if folds else _CORNER) * self.element_size)

    @property
    def is_limited(self) -> bool:
        """True if a vacuum has less than the pressure that fills the corners."""
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
        """Approximate area stretch of the sheet: bottom and walls of the cavity over its opening."""
        return 1.0 + 2 * self.found.depth / self.pocket if self.drape is None else self.drape.draw

    @property
    def ramp(self) -> float:
        """Rise time of the pressure [s]."""
        if self.drape is not None:
            return round_digits(_PRESSING * self._time)
        # A shallow mold is touched early, and until then the pressure has to rise as slowly.
        shallow = min(_SHALLOW * 0.5 * self.width / max(self.found.depth, 1e-12), _LONGEST)
        return round_digits(_SLOW * (1.0 + shallow) * self._time)

    @property
    def stroke_time(self) -> float:
        """Duration of the motion of mold or plug before the pressure rises [s]; 0 where there is none."""
        moves = self.drape is not None or self.plug is not None
        return round_digits(_STROKE * self._time) if moves else 0.0

    @property
    def damping(self) -> float:
        """Damping of the solver [1/s]."""
        return round_digits(_DAMPING / self._time)

    @property
    def levels(self) -> int:
        """Levels of bisection for elements near bends of the mold; 0 where the mesh is fine enough."""
        # Two bisections halve an element's sides.
        return 2 if self.element_size > 2 * self.pocket / _FEWEST else 0

    @property
    def _time(self) -> float:
        return 0.5 * self.width * float(np.sqrt(DENSITY / STIFFNESS))


def round_digits(value: float) -> float:
    """The number to two digits, as one would choose it."""
    return float(f"{value:.2g}")

"""The choices of a first scene: material, pressure and times, from the geometry of the mold."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from jaxform.io.drape_setup import Drape
from jaxform.io.units import Units
from jaxform.tools.covers import Covers
from jaxform.tools.footprint import Planform
from jaxform.tools.halves import MoldCompletion
from jaxform.tools.opening import Opening

Array = NDArray[np.float64]

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


@dataclass(frozen=True)
class Draft:
    """The choices of a first scene.

    Attributes:
        scale: Metres per unit of the mold's file.
        units: The unit in words, and its alternatives.
        guessed: Whether the scale was guessed.
        size: Box of the mold as it is in the file (3,).
        rotate: Rotation of the mold [degrees] (3,).
        translate: Translation of the mold [m] (3,).
        found: The opening.
        planform: Planform of the sheet, in the axes of the view.
        polygon: Polygon of the sheet (k, 2) [m] in the scene.
        rest: Images that complete a mold cut in a half or a quarter, as its file has it [m]; None where it is whole.
        covers: Covers that close the mold, as its file has it [m].
        width: Width of the sheet [m], the shorter side.
        pocket: Half the width of the smallest pocket [m].
        slit: Half the width of the widest slits [m], which are left open; None where there are none.
        thickness: Thickness of the sheet [m].
        element_size: Size of the elements [m].
        process: Source of the pressure, one of `PROCESSES`.
        drape: Setup for draping over a buck; None for a cavity.
        doubt: Alternative kind of the mold; empty where that is clear.
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
    rest: MoldCompletion | None
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
        folds = self.drape is not None or isinstance(self.planform.shape, np.ndarray)
        return 2 * self._tension / ((_RE_ENTRANT if folds else _CORNER) * self.element_size)

    @property
    def limited(self) -> bool:
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
        """Duration of the mold's motion before the pressure rises [s]; 0 where it rests."""
        return 0.0 if self.drape is None else round_digits(_STROKE * self._time)

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


@dataclass(frozen=True)
class UserChoices:
    """The user's choices for a first scene; None where a choice is left to the program.

    Attributes:
        scale: Metres per unit of the files; by default guessed from the mold's size.
        thickness: Thickness of the sheet [m]; by default in proportion to its width.
        drape: Whether the mold is a buck.
        direction: Unit vector (3,) to the side from which the sheet comes, in the file's axes.
        process: One of `PROCESSES`.
    """

    scale: float | None = None
    thickness: float | None = None
    drape: bool | None = None
    direction: Array | None = None
    process: str = PROCESSES[0]


def round_digits(value: float) -> float:
    """The number to two digits, as one would choose it."""
    return float(f"{value:.2g}")

"""A first scene in which a sheet is draped over a male mold: the frame, the platen, the way of the mold."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from jaxform.core.errors import warn_of
from jaxform.mesh import masks, meshes
from jaxform.mesh.meshes import Mesh
from jaxform.tools import buck, chambers, platen, scans, undercut
from jaxform.tools.buck import Buck
from jaxform.tools.opening import Opening
from jaxform.tools.platen import Site
from jaxform.tools.undercut import Undercut

Array = NDArray[np.float64]

_REST = 0.1  # of the sheet's thickness, between the platen and the frame in the end
_SHARES = (0.1, 0.5, 0.9)  # of the height, at which the narrowest part of the body is looked for
_SPECK = 0.02  # of the body's area: the smallest parts that are less together do not count


@dataclass(frozen=True)
class Drape:
    """A buck and its surroundings: platen, covers and undercut.

    Attributes:
        buck: The buck in its orientation.
        site: Place of the sheet.
        added: Additions to the mold, in its file's axes [m]: platen, walls down to it, covers on holes; None where
            there are none.
        holes: Number of covered holes.
        undercut: The deepest one, in the file's axes [m]; None where there is none.
    """

    buck: Buck
    site: Site
    added: Mesh | None
    holes: int
    undercut: Undercut | None

    @property
    def narrowest(self) -> float:
        """Half the width of the body's narrowest part [m]."""
        view, found = self.buck.view, []
        for share in _SHARES:
            part, count = masks.label_parts(view.height <= self.buck.top + share * self.buck.height)
            half, area = np.zeros(count + 1), np.bincount(part.ravel(), minlength=count + 1)
            np.maximum.at(half, part, masks.distance(part > 0))
            order = 1 + np.argsort(half[1:])
            counted = np.cumsum(area[order]) > _SPECK * area[1:].sum()
            found.append(float(half[order][counted].min()))
        return max(found) * view.pixel

    @property
    def draw(self) -> float:
        """Approximate area stretch of the sheet, which also lines the sides of the body."""
        return 1.0 + 2 * self.buck.height / max(self.narrowest + self.site.margin, 1e-12)

    def stroke(self, thickness: float) -> float:
        """Stroke of the mold [m] for a sheet of this thickness [m]: until the frame is on the platen."""
        return self.buck.height + clearance(thickness) - _REST * thickness

    def opening(self, thickness: float) -> Opening:
        """The mold as an opening to form into, with the sheet at its clamp plane, before the mold moves."""
        level = self.buck.top - clearance(thickness)
        return Opening(self.buck.view, level, self.buck.base, self.buck.body, True, 1.0, self.buck.height)


def clearance(thickness: float) -> float:
    """Initial clearance [m] between a sheet of this thickness [m] and the top of the mold."""
    return 0.5 * thickness


def drape(mold: Mesh, direction: Array | None) -> Drape:
    """Setup for draping a sheet over a welded mold, from a given side (3,), in the file's axes, or from the best one.

    Raises:
        InputError: Nothing stands above a base.
    """
    lids = chambers.close_necks(mold)
    stands = buck.find_buck(meshes.merge([mold, *lids]), direction)
    site = platen.fit_site(stands)
    rims = scans.find_rims(mold)
    turn = stands.view.turn
    walls, fans = ([], []) if rims is None else scans.close_rims(mold, rims, turn, stands.base)
    closing = [*lids, *(Mesh(part.positions @ turn, part.triangles) for part in [*walls, *fans])]
    deepest = undercut.deepest_undercut(stands, meshes.merge([mold, *closing]))
    parts = [*([] if site.platen is None else [site.platen]), *closing]
    return Drape(stands, site, meshes.merge(parts) if parts else None, len(fans) + len(lids), deepest)


def warn(made: Drape, scale: float) -> None:
    """Warns of what the sheet cannot reach, and of a mold without a base."""
    if made.undercut is not None:
        place = ", ".join(f"{x:.4g}" for x in made.undercut.place / scale)
        problem = (
            f"is undercut by up to {1e3 * made.undercut.depth:.3g} mm, at ({place}) of the file: "
            "the sheet does not lie on it there, and the part does not come off"
        )
        warn_of(problem, "close it in the mold, or give another --direction", key="--mold")
    if not made.buck.flat:
        problem = "has no flat base: the platen lies where it is widest, and what is below is not formed"
        warn_of(problem, "give --direction for the side from which the sheet comes, or cut the mold flat", key="--mold")


def lines(made: Drape) -> Iterator[str]:
    """Description of the setup, line by line."""
    side = buck.direction_name(made.buck.direction)
    on = "on the platen of the file" if made.site.platen is None else "on a platen that is added (platen.stl)"
    yield f"taken for a buck, {on}: the sheet comes from {side} of the file and is draped over it"
    if made.buck.others:
        yield f"it may stand otherwise too: --direction={' or --direction='.join(made.buck.others)}"
    if made.holes:
        yield f"platen.stl closes {made.holes} hole{'s' if made.holes > 1 else ''} too"

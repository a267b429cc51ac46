"""Warnings of likely errors in a formed part, and its thinnest place: found after the run, on the host."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from jaxform.core.errors import format_place
from jaxform.loads import list_gases
from jaxform.model.scene import Scene
from jaxform.results import sections
from jaxform.results.part import part_elements
from jaxform.sheet.state import Status
from jaxform.tools import folding

if TYPE_CHECKING:
    from jaxform.results.result import Result

Array = NDArray[np.float64]

_OUTSIDE = 0.02  # of the mold's size, that a sheet may reach out of its box
_NEXT_TO = 1e-4  # of the sheet's size
_MOST_ASKED = 3000  # elements checked for passing through the sheet
_TORN = 0.01  # of the initial thickness: a thinner free wall is implausible
# Of the initial thickness, of a wall on the mold. Sheets are drawn to some 10 times their area; 50 times leaves a film
# of 20 um of 1 mm.
_THIN = 0.02


def thinnest_element(result: Result, scene: Scene) -> dict[str, Any]:
    """The thickness [m] of the thinnest element, and where its middle is: `formed` and `initial` (3,) [m]."""
    walls = np.where(np.asarray(result.used), np.asarray(result.element_thickness, float), np.inf)
    nodes = np.asarray(result.triangles)[int(np.argmin(walls))]
    return {
        "thickness": float(np.min(walls)),
        "formed": np.asarray(result.positions, float)[nodes].mean(0).tolist(),
        "initial": np.asarray(scene.parison.positions, float)[nodes].mean(0).tolist(),
    }


def warnings_of_part(result: Result, scene: Scene) -> list[str]:
    """A sentence for each likely error in a part, with the remedy."""
    # Of a run that broke off, but for a sheet that ran away, the status says more.
    reported = Status.RUNAWAY | Status.ESCAPED | Status.BURST | Status.UNBALANCED | Status.UNFILLED
    broken = int(result.status) & ~reported
    if broken or not np.isfinite(np.asarray(result.positions)).all():
        return []
    return [
        *_warnings_of_no_contact(result, scene),
        *_warnings_of_trapped_gas(result, scene),
        *_warnings_of_escape(result, scene),
        *_warnings_of_tearing(result),
        *_warnings_of_thinning(result, scene),
        *_warnings_of_crossing(result, scene),
    ]


def _warnings_of_no_contact(result: Result, scene: Scene) -> list[str]:
    if scene.mold is None:
        return []
    initial, active = np.asarray(scene.parison.positions, float), np.asarray(result.active)
    moved = np.linalg.norm(np.asarray(result.positions, float) - initial, axis=1)
    # Nodes on the mold, or next to it, stick to it in the first step.
    far = moved > _NEXT_TO * np.ptp(initial, axis=0).max()
    if ((np.asarray(result.contact_time) > 0) & far & active).any() or np.asarray(result.stuck)[active].all():
        return []
    return [
        "nothing touched the mold after the start; look at sheet and mold with `jaxform check` (units, "
        "sides), or raise pressure.value or solver.end_time"
    ]


def _warnings_of_trapped_gas(result: Result, scene: Scene) -> list[str]:
    """A warning of gas in the mold that holds the sheet off it."""
    trapped = any(gas.closed_by == "mold" for gas in list_gases(scene.pressure))
    if not trapped or not int(result.status) & Status.UNFILLED:
        return []
    return [
        "the gas between the sheet and the mold holds the sheet off the mold; give it a vent, or a larger one "
        "(gas.vent_area), or more time to leave"
    ]


def _warnings_of_escape(result: Result, scene: Scene) -> list[str]:
    """Warnings of a sheet that left both the mold's box and its own initial one."""
    if scene.mold is None:
        return []
    initial = np.asarray(scene.parison.positions, float)
    active = np.flatnonzero(np.asarray(result.active))
    now, walls = np.asarray(result.positions, float)[active], scene.mold.where_it_turns()
    boxes = [*_images(scene, walls), initial]
    low, high = np.min([box.min(0) for box in boxes], axis=0), np.max([box.max(0) for box in boxes], axis=0)
    beyond = np.maximum(low - now, now - high).max(1)
    farthest = int(np.argmax(beyond))
    if not beyond[farthest] > _OUTSIDE * np.ptp(walls, axis=0).max():
        return []
    return [
        f"the sheet left the mold's box, by {beyond[farthest]:.3g} m at {format_place(now[farthest])}; look at sheet "
        "and mold with `jaxform check`: does the mold face the pressure, is it as wide as the sheet, and "
        "without a hole?"
    ]


def _images(scene: Scene, walls: Array) -> list[Array]:
    """The mold's vertices and their images in the symmetry planes: a mold may be cut there or not."""
    images = [walls]
    for axis, level in sections.symmetry_planes(scene).items():
        image = walls.copy()
        image[:, axis] = 2 * level - image[:, axis]
        images.append(image)
    return images


def has_burst(result: Result, scene: Scene) -> bool:
    """True if a run reached its end although its sheet was blown through itself.

    A film is then stretched unrealistically far, and intersects the surface that it passed through.
    """
    if int(result.status) or scene.mold is None or not np.isfinite(np.asarray(result.positions)).all():
        return False
    return bool(len(_unreliable_elements(result, _ratio(result)))) and bool(len(_crossing_elements(result, scene)))


def _ratio(result: Result) -> Array:
    """Ratio of the elements' thickness to the initial one (n_element,)."""
    return 1.0 / np.maximum(np.prod(np.asarray(result.stretches, float), axis=1), 1e-300)


def _unreliable_elements(result: Result, ratio: Array) -> NDArray[np.int64]:
    return np.flatnonzero(np.asarray(result.used) & ~_on_mold(result) & (ratio < _TORN))


def _on_mold(result: Result) -> NDArray[np.bool_]:
    """Mask of the elements (n_element,) of which a node is in contact."""
    return (np.asarray(result.wall) != 0)[np.asarray(result.triangles)].any(1)


def _crossing_elements(result: Result, scene: Scene) -> NDArray[np.int64]:
    """Elements with a free node that cut another part of a sheet in a mold; of very many the thinnest are asked."""
    none = np.zeros(0, np.int64)
    if scene.mold is None:
        return none
    used = np.flatnonzero(np.asarray(result.used))
    triangles = np.asarray(result.triangles)[used]
    free = np.flatnonzero(~np.asarray(result.stuck)[triangles].all(1))
    asked = free[np.argsort(_ratio(result)[used[free]], kind="stable")[:_MOST_ASKED]]
    return used[folding.self_intersecting_elements(np.asarray(result.positions, float), triangles, asked)]


def _warnings_of_crossing(result: Result, scene: Scene) -> list[str]:
    found = _crossing_elements(result, scene)
    # Flash folds where it is pinched, up to the seam; what is no part is cut off.
    triangles = np.asarray(result.triangles)
    cut_off = np.asarray(result.used) & ~np.asarray(part_elements(result, scene))
    found = found[~np.isin(triangles[found], triangles[cut_off]).any(1)]
    if not len(found):
        return []
    nodes = triangles[found[np.argmin(_ratio(result)[found])]]
    where = format_place(np.asarray(result.positions, float)[nodes].mean(0))
    joins = scene.solver.self_contact
    cause = "" if joins else ", and self-contact is not simulated"
    remedy = "" if joins else "set solver.self_contact = true, which welds the sides of a fold, "
    return [
        f"the sheet passes through itself with {len(found)} elements, at {where}: it folds there, or two of its sides "
        f"meet{cause}; the wall is not reliable there; {remedy}lower pressure.value, or widen narrow places of the mold"
    ]


def _warnings_of_tearing(result: Result) -> list[str]:
    triangles, ratio = np.asarray(result.triangles), _ratio(result)
    torn = _unreliable_elements(result, ratio)
    if not len(torn):
        return []
    worst = torn[np.argmin(ratio[torn])]
    where = format_place(np.asarray(result.positions, float)[triangles[worst]].mean(0))
    count = f"{len(torn)} elements without contact are" if len(torn) > 1 else "an element without contact is"
    return [
        f"{count} stretched unrealistically: down to {100 * ratio[worst]:.2g} % of the initial thickness at "
        f"{where}; lower pressure.value or the end time, or put the mold where it stops the sheet"
    ]


def _warnings_of_thinning(result: Result, scene: Scene) -> list[str]:
    """A warning where the part's wall on the mold is implausibly thin; free walls have `_warnings_of_tearing`."""
    triangles, ratio = np.asarray(result.triangles), _ratio(result)
    thin = np.asarray(part_elements(result, scene)) & _on_mold(result) & (ratio < _THIN)
    if not thin.any():
        return []
    worst = int(np.argmin(np.where(thin, ratio, np.inf)))
    where = format_place(np.asarray(result.positions, float)[triangles[worst]].mean(0))
    wall = float(np.asarray(result.element_thickness, float)[worst])
    return [
        f"the wall is down to {100 * ratio[worst]:.2g} % of the initial thickness ({wall:.2g} m) at {where}, an area "
        f"draw ratio of {1 / ratio[worst]:.3g}: no material withstands that; make the mold shallower, round its "
        "corners, or form a wider sheet"
    ]

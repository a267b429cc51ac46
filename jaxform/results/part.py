"""The part of a formed sheet: the elements that statistics, objectives and pictures count."""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from jaxform.core.errors import format_percent, format_place
from jaxform.loads import list_gases
from jaxform.mechanics import membrane
from jaxform.mesh import meshes
from jaxform.model.part import Part
from jaxform.model.scene import Scene
from jaxform.results import sections
from jaxform.results.result import Result
from jaxform.sheet.state import Status
from jaxform.tools import penetration

_RINGS = 64  # elements over which contact is extended to nodes that touch nothing


def part_elements(result: Result, scene: Scene) -> Any:
    """Mask of the elements (n_element,) of the part, by the scene's `Part`; without one, all that are used.

    Traced or not; piecewise constant in the design.
    """
    part, used = scene.part, jnp.asarray(result.used)
    if part is None:
        return used
    triangles = jnp.asarray(result.triangles)
    mine = used & part.holds(jnp.asarray(result.positions)[triangles].mean(1))
    if part.by_contact:
        mine &= jnp.sum(_shares(result, scene, part)[triangles], axis=1) > 0
    return mine


def rim_elements(result: Result, scene: Scene) -> Any:
    """Mask of the elements (n_element,) that span the rim of the part by contact: some nodes in it, others not."""
    part = scene.part
    if part is None or not part.by_contact:
        return jnp.zeros(len(result.triangles), bool)
    of_corners = _shares(result, scene, part)[jnp.asarray(result.triangles)] > 0
    return of_corners.any(1) & ~of_corners.all(1)


def _shares(result: Result, scene: Scene, part: Part) -> Any:
    """Assignment of nodes to the part (n_node,): 1 on its triangles of mold and tools, -1 on others and where clamped.

    Nodes that touch nothing, as in corners that are not filled, or a tool whose contact does not matter, take the mean
    of those around them, iteratively.
    """
    used = jnp.asarray(result.used)
    held = jnp.asarray(scene.parison.clamped)
    first = jnp.where(held, -1.0, 0.0)
    touched = [(part.walls, result.wall)]
    first_tool = 0 if scene.mold is None else 1
    for number, mask in enumerate(part.tool_walls, first_tool):
        touched.append((mask, jnp.where(result.tool == number, jnp.asarray(result.tool_wall), 0)))
    for mask, wall in touched:
        if mask is not None:
            chosen = mask[jnp.clip(jnp.abs(wall) - 1, 0, mask.size - 1)]
            first = jnp.where(wall != 0, jnp.where(chosen, 1.0, -1.0), first)
            held |= wall != 0
    corners = jnp.asarray(result.triangles)
    count = membrane.sum_to_nodes(jnp.where(used, 1.0, 0.0), corners.T, held.size)

    def spread(_: int, shares: Any) -> Any:
        means = jnp.where(used, shares[corners].mean(1), 0.0)
        around = membrane.sum_to_nodes(means, corners.T, held.size) / jnp.maximum(count, 1.0)
        return jnp.where(held, first, around)

    return jax.lax.fori_loop(0, _RINGS, spread, first)


def mask_part(result: Result, scene: Scene) -> Result:
    """The result in which the part alone counts: other elements have neither volume nor wall, and the mass is its own.

    The same result where the scene has no `Part`. Pure, so it can be traced.
    """
    if scene.part is None:
        return result
    mine, density = part_elements(result, scene), jnp.asarray(scene.material.density)
    volume = jnp.where(mine, result.element_volume, 0.0)
    dense = density[jnp.asarray(result.triangles)].mean(1) if density.ndim else density
    return dataclasses.replace(
        result,
        used=mine,
        element_volume=volume,
        element_thickness=jnp.where(mine, result.element_thickness, 0.0),
        mass=jnp.sum(dense * volume),
    )


def restrict_to_part(result: Result, scene: Scene) -> tuple[Result, list[str]]:
    """The result of `mask_part`, on the host; if no element is in the part, the whole sheet, and a sentence on that."""
    if scene.part is None:
        return result, []
    part = mask_part(result, scene)
    if np.asarray(part.used).any():
        return part, []
    return result, [
        "no element of the formed sheet is in [part], so all results are those of the whole sheet; compare part.box, "
        "part.trim and part.molds with where the sheet is (they are in formed positions, m)"
    ]


# Warnings of likely errors in a formed part, and its thinnest place: found after the run, on the host.

if TYPE_CHECKING:
    from jaxform.results.result import Result

Array = NDArray[np.float64]

_OUTSIDE = 0.02  # of the mold's size, that a sheet may reach out of its box
_NEXT_TO = 1e-4  # of the sheet's size
_MOST_ASKED = 3000  # elements checked for passing through the sheet
_TORN = 0.01  # of the initial thickness: a thinner free wall is implausible
# Share of the initial thickness. Treloar's rubber bears 4.45 in two directions, 20 times its area; between two
# entanglements the chains of polystyrene are straight at 4.2, those of most other thermoplastics sooner.
_THIN = 0.05


def thinnest_element(result: Result, scene: Scene) -> dict[str, Any]:
    """The thickness [m] of the thinnest element, its `ratio` to the initial one, and where its middle is.

    Places are `formed` and `initial` (3,) [m].
    """
    walls = np.where(np.asarray(result.used), np.asarray(result.element_thickness, float), np.inf)
    thinnest = int(np.argmin(walls))
    nodes = np.asarray(result.triangles)[thinnest]
    return {
        "thickness": float(walls[thinnest]),
        "ratio": float(_ratio(result)[thinnest]),
        "formed": np.asarray(result.positions, float)[nodes].mean(0).tolist(),
        "initial": np.asarray(scene.parison.positions, float)[nodes].mean(0).tolist(),
    }


def warnings_of_part(result: Result, scene: Scene) -> list[str]:
    """A sentence for each likely error in a part, with the remedy."""
    # The status of a run that broke off says more, unless the sheet ran away.
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
    if scene.mold is None or (result.held_sides is not None and int(result.held_sides)):
        return []
    initial, active = np.asarray(scene.parison.positions, float), np.asarray(result.active)
    moved = np.linalg.norm(np.asarray(result.positions, float) - initial, axis=1)
    # Nodes on the mold, or next to it, stick to it in the first step.
    far = moved > _NEXT_TO * np.ptp(initial, axis=0).max()
    if ((np.asarray(result.contact_time) > 0) & far & active).any() or np.asarray(result.stuck)[active].all():
        return []
    return [
        "nothing touched the mold after the start; look at sheet and mold with `jaxform check` (units, "
        "sides), or raise the pressure or solver.end_time"
    ]


def _warnings_of_trapped_gas(result: Result, scene: Scene) -> list[str]:
    """A warning of gas in the mold that holds the sheet off it."""
    trapped = any(gas.closed_by == "mold" for gas in list_gases(scene.pressure).values())
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
        images.append(meshes.mirror_image(walls, axis, level))
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
    """Elements with a free node that cut another part of a sheet in a mold; of many only the thinnest are tested."""
    none = np.zeros(0, np.int64)
    if scene.mold is None:
        return none
    used = np.flatnonzero(np.asarray(result.used))
    triangles = np.asarray(result.triangles)[used]
    free = np.flatnonzero(~np.asarray(result.stuck)[triangles].all(1))
    asked = free[np.argsort(_ratio(result)[used[free]], kind="stable")[:_MOST_ASKED]]
    return used[penetration.self_intersecting_elements(np.asarray(result.positions, float), triangles, asked)]


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
        f"meet{cause}; the wall is not reliable there; {remedy}lower the pressure, or widen narrow places of the mold"
    ]


def _warnings_of_tearing(result: Result) -> list[str]:
    triangles, ratio = np.asarray(result.triangles), _ratio(result)
    torn = _unreliable_elements(result, ratio)
    if not len(torn):
        return []
    worst = int(torn[np.argmin(ratio[torn])])
    where = format_place(np.asarray(result.positions, float)[triangles[worst]].mean(0))
    count = f"{len(torn)} elements without contact are" if len(torn) > 1 else "an element without contact is"
    return [
        f"{count} stretched unrealistically: down to {format_percent(ratio[worst])} of the initial thickness at "
        f"{where}; lower the pressure or the end time, or put the mold where it stops the sheet"
    ]


def _warnings_of_thinning(result: Result, scene: Scene) -> list[str]:
    """A warning where the wall of a part is implausibly thin; of free walls the thinnest have `_warnings_of_tearing`.

    A balloon, which no tool stops, is stretched as its material model says.
    """
    if not scene.surfaces:
        return []
    triangles, ratio = np.asarray(result.triangles), _ratio(result)
    thin = np.asarray(part_elements(result, scene)) & (ratio < _THIN)
    thin[_unreliable_elements(result, ratio)] = False
    if not thin.any():
        return []
    worst = int(np.argmin(np.where(thin, ratio, np.inf)))
    where = format_place(np.asarray(result.positions, float)[triangles[worst]].mean(0))
    wall = float(np.asarray(result.element_thickness, float)[worst])
    return [
        f"the wall is down to {format_percent(ratio[worst])} of the initial thickness ({wall:.2g} m) at {where}, an "
        f"area draw ratio of {1 / ratio[worst]:.3g}: polymers withstand up to about {1 / _THIN:.0f}, and material "
        "models are fitted to less; make the mold shallower, round its corners, form a wider sheet, or push it with "
        "a plug"
    ]

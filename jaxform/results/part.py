"""The part of a formed sheet: the elements that statistics, objectives and pictures count."""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxform.mechanics import membrane
from jaxform.model.part import Part
from jaxform.model.scene import Scene
from jaxform.results.result import Result

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

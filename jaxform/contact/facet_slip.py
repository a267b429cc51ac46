"""The most frequent step of sliding nodes: each stays within its triangle, whose geometry is stored.

`sliding.slide_nodes` looks triangles up and follows nodes over edges. In most steps a node crosses none: then its
triangle is the one of the step before, and all nodes of a block are moved side by side.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from jaxform.contact.sliding import ContactLosses, SlideInput, mobile_components, on_surface
from jaxform.kernels.blocks import materialize
from jaxform.mechanics.elements import Nodes
from jaxform.mechanics.membrane import Vector, cross, dot, minus, vector
from jaxform.tools.mold import ToolFrame, tool_offset, tool_velocity
from jaxform.tools.surface_walk import LEAST, OUT, ContactSurface, facets


class KnownFacets(NamedTuple):
    """Geometry of the triangles that nodes lie on without sticking, in the tools' frames.

    Attributes:
        wall, tool: The contact (n,) for which it holds, as in `Nodes`; the wall is 0 where none is known.
        geometry: First corner [m], unit normal on the nodes' side, the vectors [1/m] whose products with a point's
            offset from that corner are its barycentric coordinates at the second and third one, and the vector within
            the nodes' symmetry planes whose product with the normal is 1 (15, n).
    """

    wall: jax.Array
    tool: jax.Array | None
    geometry: jax.Array

    def holds(self, wall: jax.Array, tool: jax.Array | None) -> jax.Array:
        """Nodes (n,) with this contact of which the geometry is known."""
        same = self.wall == wall
        return same if self.tool is None or tool is None else same & (self.tool == tool)

    def vectors(self) -> list[Vector]:
        """First corner, normal and the three further vectors, three times (n,) each."""
        return [vector(self.geometry[k : k + 3]) for k in range(0, 15, 3)]


def find_facets(
    wall: jax.Array, tool: jax.Array | None, mobile: Vector, surfaces: tuple[ContactSurface, ...]
) -> KnownFacets:
    """The geometry of the triangles that nodes (n,) with this contact lie on; mobile is 1 where they may move, else 0.

    Of nodes that touch nothing, or cannot move along the normal, none is known.
    """
    geometry, square = jnp.zeros((15, wall.size), mobile[0].dtype), jnp.zeros_like(mobile[0])
    side = jnp.where(wall < 0, -1, 1)
    for number, surface in enumerate(surfaces):
        if surface.mold.contact.sticks:
            continue
        here = (wall != 0) & on_surface(tool, number)
        corners, area_vector, normal = facets(surface.mold, jnp.where(here, jnp.abs(wall) - 1, 0), side)
        first, second, third = corners
        area = dot(area_vector, area_vector)
        duals = cross(minus(third, first), area_vector), cross(area_vector, minus(second, first))
        free = sum(c * n * n for c, n in zip(mobile, normal, strict=True))
        within = (c * n / jnp.where(free > LEAST, free, 1.0) for c, n in zip(mobile, normal, strict=True))
        rows = [*first, *normal, *(x / area for dual in duals for x in dual), *within]
        geometry, square = jnp.where(here, jnp.stack(rows), geometry), jnp.where(here, free, square)
    return KnownFacets(jnp.where(square > LEAST, wall, 0), tool, geometry)


def begin_facets(nodes: Nodes, compliance: jax.Array, surfaces: tuple[ContactSurface, ...]) -> KnownFacets:
    """The facets that nodes (n,) lie on when a window begins; compliance (3, n) [1/kg]."""
    wall = jnp.where(nodes.stuck, 0, nodes.wall)
    return find_facets(wall, nodes.tool, mobile_components(compliance), surfaces)


def slide_within_facets(
    nodes: SlideInput,
    known: KnownFacets,
    steps: tuple[jax.Array, jax.Array],
    surfaces: tuple[ContactSurface, ...],
    frames: tuple[ToolFrame | None, ...],
    damping: jax.Array | None,
) -> tuple[tuple[Vector, Vector], jax.Array, ContactLosses, jax.Array]:
    """Advances sliding nodes by a step, as `slide_nodes` does, where they neither leave the tool nor cross an edge.

    Args:
        nodes: The nodes.
        known: The triangles that they lie on.
        steps: Time step of the velocity update, and the step length [s].
        surfaces: The surfaces, in the order of `Scene.surfaces`.
        frames: Their frames in the step; None of those at rest.
        damping: Mass-proportional damping [1/s].

    Returns:
        Positions [m] and velocities [m/s] after the step, three times (n,), valid only for nodes that stay within
        their triangles; the mask of these nodes: the other sliding nodes are moved by `slide_nodes`; the losses; and
        the distance that the nodes slide [m].
    """
    velocity_step, length = steps
    first, normal, second, third, within = known.vectors()
    carrier, offset = tool_velocity(frames, nodes.tool), tool_offset(frames, nodes.tool)
    trial = nodes.free if carrier is None else minus(nodes.free, carrier)
    outward = materialize(dot(trial, normal))
    along = materialize(vector(w - outward * q for w, q in zip(trial, within, strict=True)))
    slip = materialize(_limit_slip(along, -outward, nodes, surfaces))
    on_tool = slip if carrier is None else vector(w + c for w, c in zip(slip, carrier, strict=True))
    end = materialize(vector(x + length * v for x, v in zip(nodes.positions, on_tool, strict=True)))
    away = minus(end if offset is None else minus(end, offset), first)
    height, gamma, delta = materialize((dot(away, normal), dot(away, second), dot(away, third)))
    inside = (gamma >= -OUT) & (delta >= -OUT) & (gamma + delta <= 1.0 + OUT)
    stays = materialize(nodes.sliding & known.holds(nodes.wall, nodes.tool) & inside & (outward <= 0.0))
    place = vector(x - height * q for x, q in zip(end, within, strict=True))
    moves = _moving(nodes.tool, surfaces, frames)
    losses = _losses(nodes, on_tool, normal, carrier, velocity_step, damping, moves)
    return (place, on_tool), stays, losses, length * jnp.sqrt(dot(slip, slip))


def _losses(
    nodes: SlideInput,
    velocities: Vector,
    normal: Vector,
    carrier: Any,
    velocity_step: jax.Array,
    damping: jax.Array | None,
    moves: jax.Array | bool,
) -> ContactLosses:
    """Losses (n,) [J] as `sliding` has them, from the changes of the velocities by the tool."""
    rate: jax.Array | float = 0.0 if damping is None else damping
    mean = vector(0.5 * (new + old) for new, old in zip(velocities, nodes.velocities, strict=True))
    scale = nodes.mass * (1.0 + 0.5 * velocity_step * rate)
    impulse = vector(scale * (new - free) for new, free in zip(velocities, nodes.free, strict=True))
    slip = mean if carrier is None else minus(mean, carrier)
    pushed = dot(impulse, normal) * dot(slip, normal)
    work: jax.Array | float = 0.0 if carrier is None else dot(impulse, vector(carrier)) + jnp.where(moves, pushed, 0.0)
    return ContactLosses(
        work=work,
        friction=pushed - dot(impulse, slip),
        impact=jnp.where(moves, 0.0, -pushed),
        damping=velocity_step * rate * nodes.mass * dot(mean, mean),
    )


def _limit_slip(along: Vector, push: jax.Array, nodes: SlideInput, surfaces: tuple[ContactSurface, ...]) -> Vector:
    """The slip (n,) by the contact law of the surface that each node lies on, three times (n,) [m/s]."""
    slip = along
    for number, surface in enumerate(surfaces):
        if surface.mold.contact.sticks:
            continue
        here, law = on_surface(nodes.tool, number), surface.mold.contact.at(nodes.temperature)
        own = law.limit_slip(along, push)
        slip = own if here is True else vector(jnp.where(here, new, old) for new, old in zip(own, slip, strict=True))
    return slip


def _moving(
    tool: jax.Array | None, surfaces: tuple[ContactSurface, ...], frames: tuple[ToolFrame | None, ...]
) -> jax.Array | bool:
    """Nodes (n,) in contact with a tool that moves, as a mask."""
    sliding = [k for k, surface in enumerate(surfaces) if not surface.mold.contact.sticks]
    moving = [k for k in sliding if frames[k] is not None]
    if len(moving) in (0, len(sliding)):
        return bool(moving)
    found = jnp.asarray(False)
    for number in moving:
        found = found | on_surface(tool, number)
    return found

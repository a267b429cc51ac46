"""The usual step of nodes that lie on tools: each stays within its triangle, whose geometry is known.

`sliding.slide_nodes` looks triangles up and follows nodes over edges. In most steps a node crosses none: then its
triangle is the one of the step before, and all nodes of a block are moved side by side.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp

from jaxform.contact.sliding import (
    ContactLosses,
    LyingNodes,
    contact_losses,
    move_within_planes,
    on_surface,
)
from jaxform.kernels.blocks import materialize
from jaxform.mechanics.membrane import Vector, cross, dot, minus, vector
from jaxform.mechanics.nodes import Nodes
from jaxform.tools.motion import ToolFrame, tool_offset, tool_velocity
from jaxform.tools.surface_walk import OUT, ContactSurface, facets, project_on_plane


class KnownFacets(NamedTuple):
    """Geometry of the triangles that nodes lie on without sticking, in the tools' frames.

    Attributes:
        wall, tool: The contact (n,) for which it holds, as in `Nodes`; the wall is 0 where none is known.
        geometry: First corner [m], unit normal on the nodes' side, and the vectors [1/m] whose products with a point's
            offset from that corner are its barycentric coordinates at the second and third one (12, n).
    """

    wall: jax.Array
    tool: jax.Array | None
    geometry: jax.Array

    def holds(self, wall: jax.Array, tool: jax.Array | None) -> jax.Array:
        """Nodes (n,) with this contact of which the geometry is known."""
        same = self.wall == wall
        return same if self.tool is None or tool is None else same & (self.tool == tool)

    def vectors(self) -> tuple[Vector, Vector, Vector, Vector]:
        """First corner, normal and both further vectors, three times (n,) each."""
        first, normal, second, third = (vector(self.geometry[k : k + 3]) for k in range(0, 12, 3))
        return first, normal, second, third


def find_facets(wall: jax.Array, tool: jax.Array | None, surfaces: tuple[ContactSurface, ...]) -> KnownFacets:
    """The geometry of the triangles that nodes (n,) with this contact lie on; of others arbitrary."""
    real = surfaces[0].mold.vertices.dtype
    geometry = jnp.zeros((12, wall.size), real)
    side = jnp.where(wall < 0, -1, 1)
    for number, surface in enumerate(surfaces):
        if surface.mold.contact.sticks:
            continue
        here = (wall != 0) & on_surface(tool, number)
        own = facets(surface.mold, jnp.where(here, jnp.abs(wall) - 1, 0), side)
        first, second, third = own.corners
        square = dot(own.area_vector, own.area_vector)
        duals = cross(minus(third, first), own.area_vector), cross(own.area_vector, minus(second, first))
        rows = [*first, *own.normal, *(x / square for dual in duals for x in dual)]
        geometry = jnp.where(here, jnp.stack(rows), geometry)
    return KnownFacets(wall, tool, geometry)


def begin_facets(nodes: Nodes, surfaces: tuple[ContactSurface, ...]) -> KnownFacets:
    """The facets that nodes (n,) lie on when a window begins."""
    return find_facets(jnp.where(nodes.stuck, 0, nodes.wall), nodes.tool, surfaces)


class SlidWithin(NamedTuple):
    """The nodes (n,) after a step within their triangles: positions [m], velocities [m/s], and the losses.

    It is right for the nodes that stay within theirs; the others that lie on a tool are moved by `slide_nodes`.
    """

    positions: Vector
    velocities: Vector
    stays: jax.Array
    losses: ContactLosses


def slide_within_facets(
    nodes: LyingNodes,
    known: KnownFacets,
    steps: tuple[jax.Array, jax.Array],
    surfaces: tuple[ContactSurface, ...],
    frames: tuple[ToolFrame | None, ...],
    damping: jax.Array | None,
) -> SlidWithin:
    """Takes nodes over a step as `slide_nodes` does, where they neither leave the tool nor cross an edge.

    Args:
        nodes: The nodes.
        known: The triangles that they lie on.
        steps: The step that the velocity takes, and the step [s].
        surfaces: The surfaces, in the order of `Scene.surfaces`.
        frames: Their frames in the step; None of those at rest.
        damping: Mass-proportional damping [1/s].
    """
    kick, length = steps
    first, normal, second, third = known.vectors()
    carrier, offset = tool_velocity(frames, nodes.tool), tool_offset(frames, nodes.tool)
    trial = nodes.free if carrier is None else minus(nodes.free, carrier)
    along = materialize(project_on_plane(trial, normal, nodes.mobile))
    push = -dot(minus(trial, along), normal)
    slip = materialize(_limit_slip(along, push, nodes.tool, surfaces))
    on_tool = slip if carrier is None else vector(w + c for w, c in zip(slip, carrier, strict=True))
    end = materialize(vector(x + length * v for x, v in zip(nodes.positions, on_tool, strict=True)))
    away = minus(end if offset is None else minus(end, offset), first)
    height, gamma, delta = materialize((dot(away, normal), dot(away, second), dot(away, third)))
    inside = (gamma >= -OUT) & (delta >= -OUT) & (gamma + delta <= 1.0 + OUT)
    stays = materialize(nodes.lies & known.holds(nodes.wall, nodes.tool) & inside & (dot(trial, normal) <= 0.0))
    back = materialize(move_within_planes(height, normal, nodes.mobile))
    still = vector(jnp.zeros_like(nodes.mass) for _ in range(3))
    losses = contact_losses(
        nodes, on_tool, normal, still if carrier is None else carrier, kick, damping,
        moves=_moving(nodes.tool, surfaces, frames),
    )  # fmt: skip
    return SlidWithin(minus(end, back), on_tool, stays, losses)


def _limit_slip(along: Vector, push: jax.Array, tool: jax.Array | None, surfaces: tuple[ContactSurface, ...]) -> Vector:
    """The slip (n,) by the contact law of the surface that each node lies on, three times (n,) [m/s]."""
    slip = along
    for number, surface in enumerate(surfaces):
        if surface.mold.contact.sticks:
            continue
        here, own = on_surface(tool, number), surface.mold.contact.limit_slip(along, push)
        slip = own if here is True else vector(jnp.where(here, new, old) for new, old in zip(own, slip, strict=True))
    return slip


def _moving(
    tool: jax.Array | None, surfaces: tuple[ContactSurface, ...], frames: tuple[ToolFrame | None, ...]
) -> jax.Array | bool:
    """Nodes (n,) that lie on a tool that moves."""
    sliding = [k for k, surface in enumerate(surfaces) if not surface.mold.contact.sticks]
    moving = [k for k in sliding if frames[k] is not None]
    if len(moving) in (0, len(sliding)):
        return bool(moving)
    found = jnp.asarray(False)
    for number in moving:
        found = found | on_surface(tool, number)
    return found

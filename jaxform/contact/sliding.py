"""Contact without sticking: nodes slide on a tool by its contact law, and leave it where it would have to pull them."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from jaxform.mechanics.elements import Nodes
from jaxform.mechanics.membrane import Vector, dot, minus, plus, vector
from jaxform.tools.mold import ToolFrame
from jaxform.tools.search import touch_distance
from jaxform.tools.surface_walk import ContactSurface, Glide, facets, move_along, project_on_plane

_CLEAR = 4.0  # times the distance at which a node touches: where one that leaves a surface begins


class SlideInput(NamedTuple):
    """Nodes (n,) before a step in which some slide on tools, and the same step without contact.

    Attributes:
        positions, velocities: Before the step, three times (n,) [m], [m/s].
        free: Velocities after it without contact, three times (n,) [m/s].
        nodal: Forces without contact, three times (n,) [N].
        mass: [kg].
        mobile: 1 where a component may change, else 0, three times (n,).
        wall, tool: Contact triangle and tool, as in `Nodes`.
        sliding: True for nodes that touch a tool and do not stick to it.
        temperature: As in `Nodes`.
    """

    positions: Vector
    velocities: Vector
    free: Vector
    nodal: Vector
    mass: jax.Array
    mobile: Vector
    wall: jax.Array
    tool: jax.Array | None
    sliding: jax.Array
    temperature: jax.Array | None = None

    @classmethod
    def from_nodes(
        cls, nodes: Nodes, free: Any, nodal: Any, masses: tuple[jax.Array, Any], sliding: jax.Array
    ) -> SlideInput:
        """From nodes before the step, free velocities and forces, three times (n,), and mass and compliance."""
        before = vector(nodes.positions), vector(nodes.velocities)
        mass, compliance = masses
        mobile = mobile_components(compliance)
        return cls(
            *before, vector(free), vector(nodal), mass, mobile, nodes.wall, nodes.tool, sliding, nodes.temperature
        )


def mobile_components(compliance: Any) -> Vector:
    """1 where a component of nodes' velocities may change, else 0, three times (n,), from their compliance [1/kg]."""
    return vector(jnp.where(c > 0.0, 1.0, 0.0) for c in compliance)


class ContactLosses(NamedTuple):
    """Energies of nodes (n,) in a step [J]: work of the tool, and losses by friction, impact and damping."""

    work: Any = 0.0
    friction: Any = 0.0
    impact: Any = 0.0
    damping: Any = 0.0


class ToolEnergies(NamedTuple):
    """Work of tools that move and losses by friction on tools that rub [J], of each tool.

    They are counted for each tool where there are several such; see `Scene.moving_tools` and `Scene.rubbing_tools`.
    """

    work: tuple[Any, ...] = ()
    friction: tuple[Any, ...] = ()


def split_by_tool(values: jax.Array | float, tool: jax.Array | None, numbers: tuple[int, ...]) -> list[jax.Array]:
    """Values (n,) of the nodes that touch each of these tools, 0 at the others; one vector for each tool."""
    return [jnp.where(tool == number, values, 0.0) for number in numbers]


class SlideResult(NamedTuple):
    """Nodes (n,) after a step in which they may have slid.

    Attributes:
        positions: Positions [m].
        velocities: Velocities [m/s].
        wall: Contact triangles, as in `Nodes`.
        left: True where a node left the surface.
        over: True where it left the surface over a ridge or a rim, up to which it slid.
        losses: Energies of the step.
        distance: Slip distance in the step [m].
    """

    positions: Vector
    velocities: Vector
    wall: jax.Array
    left: jax.Array
    over: jax.Array
    losses: ContactLosses
    distance: jax.Array


def sliding_nodes(stuck: jax.Array, wall: jax.Array) -> jax.Array:
    """Nodes (n,) that touch a tool without sticking to it, as a mask."""
    return ~stuck & (wall != 0)


def on_surface(tool: jax.Array | None, number: int) -> jax.Array | bool:
    """Nodes (n,) that touch the surface of this number, if they touch any; `tool` is None where there is one only."""
    return True if tool is None else tool == number


def slide_nodes(
    nodes: SlideInput,
    steps: tuple[jax.Array, jax.Array],
    surfaces: tuple[ContactSurface, ...],
    frames: tuple[ToolFrame | None, ...],
    damping: jax.Array | None,
    *,
    differentiable: bool,
) -> SlideResult:
    """The nodes after a step in which those marked `sliding` slide on their tools; the others move without contact.

    The normal force is the one that keeps a node from moving into the tool; where it would have to pull, the node
    leaves. From it the contact law gives the friction, and the node moves along the surface with the remaining slip.

    Args:
        nodes: The nodes.
        steps: Time step of the velocity update, and the step length [s].
        surfaces: The surfaces, in the order of `Scene.surfaces`.
        frames: Their frames in the step; None for surfaces at rest.
        damping: Mass-proportional damping [1/s].
        differentiable: True if loops have a fixed number of passes, so that JAX can differentiate them.
    """
    moved = vector(x + steps[1] * v for x, v in zip(nodes.positions, nodes.free, strict=True))
    none = jnp.zeros_like(nodes.mass)
    found = SlideResult(
        moved,
        nodes.free,
        nodes.wall,
        nodes.sliding & False,
        nodes.sliding & False,
        ContactLosses(none, none, none, none),
        none,
    )
    for number, (surface, frame) in enumerate(zip(surfaces, frames, strict=True)):
        if surface.mold.contact.sticks:
            continue
        here = nodes.sliding & on_surface(nodes.tool, number)
        own = _slide_on(nodes, here, steps, surface, frame, damping, differentiable=differentiable)
        found = jax.tree.map(lambda new, old, here=here: jnp.where(here, new, old), own, found)
    return found


def _slide_on(
    nodes: SlideInput,
    here: jax.Array,
    steps: tuple[jax.Array, jax.Array],
    surface: ContactSurface,
    frame: ToolFrame | None,
    damping: jax.Array | None,
    *,
    differentiable: bool,
) -> SlideResult:
    """The nodes after the step; those marked `here` (n,) slide on this surface."""
    velocity_step, length = steps
    surface = surface.at(nodes.temperature)
    carrier = vector(jnp.zeros_like(nodes.mass) + (0.0 if frame is None else frame.velocity[k]) for k in range(3))
    offset = vector(
        (0.0 * c if frame is None else frame.offset[k] - length * c) for k, c in enumerate(carrier)
    )  # when the step begins
    triangle, side = jnp.where(here, jnp.abs(nodes.wall) - 1, 0), jnp.where(nodes.wall < 0, -1, 1)
    _, _, normal = facets(surface.mold, triangle, side)
    trial = minus(nodes.free, carrier)
    outward = dot(trial, normal)
    leaves = outward > 0.0
    slip = project_on_plane(trial, normal, nodes.mobile)
    given = minus(trial, slip)  # what the tool takes away, along the normal
    push = jnp.where(leaves, 0.0, -dot(given, normal))
    slip = surface.mold.contact.limit_slip(slip, push)
    # Direction in which the nodes are pressed: that of the change of the velocity relative to the tool.
    held = dot(minus(nodes.velocities, carrier), normal)
    pressed = plus(minus(nodes.free, nodes.velocities), vector(held * n for n in normal))
    left = jnp.where(here & ~leaves, length, 0.0)
    start = Glide.start(minus(nodes.positions, offset), slip, triangle, side, left)
    end = move_along(surface, start, pressed, nodes.mobile, differentiable=differentiable)
    (last_corner, *_), _, last_normal = facets(surface.mold, end.triangle, end.side)
    height = dot(minus(end.position, last_corner), last_normal)
    place = minus(end.position, _within_planes(height, last_normal, nodes.mobile))
    # A node that leaves begins a little off the surface, where its side is certain.
    gap = _CLEAR * touch_distance(surface.grid)
    clear = vector(jnp.where(end.off, gap * c * n, 0.0) for c, n in zip(nodes.mobile, end.outward, strict=True))
    there = vector(x + a + o + length * c for x, a, o, c in zip(place, clear, offset, carrier, strict=True))
    away = _within_planes(gap, normal, nodes.mobile)
    flown = vector(x + a + length * v for x, a, v in zip(nodes.positions, away, nodes.free, strict=True))
    positions = vector(jnp.where(leaves, f, x) for f, x in zip(flown, there, strict=True))
    on_tool = vector(jnp.where(leaves, f, w + c) for f, w, c in zip(nodes.free, slip, carrier, strict=True))
    velocities = vector(jnp.where(leaves, f, w + c) for f, w, c in zip(nodes.free, end.velocity, carrier, strict=True))
    losses = _losses(nodes, on_tool, normal, carrier, velocity_step, damping, moves=frame is not None)
    # A tool that moves does work where it turns a node's way.
    turned = nodes.mass * dot(minus(velocities, on_tool), carrier)
    # Friction acts along the distance slid: none in a valley, where the next face stops the node.
    whole = length * jnp.sqrt(dot(slip, slip))
    missed = losses.friction * jnp.where(
        whole > end.distance, 1.0 - end.distance / jnp.where(whole > 0.0, whole, 1.0), 0.0
    )
    friction = losses.friction - missed + nodes.mass * end.rubbed
    # Work of the forces along the bent path, less that along the mean velocities.
    means = (0.5 * length * (v + w) for v, w in zip(on_tool, velocities, strict=True))
    bent = dot(nodes.nodal, minus(minus(positions, nodes.positions), vector(means)))
    return SlideResult(
        positions,
        velocities,
        jnp.where(leaves | end.off, 0, end.side * (end.triangle + 1)),
        leaves | end.off,
        end.off,
        losses._replace(
            work=losses.work + turned,
            friction=friction,
            impact=losses.impact + nodes.mass * end.lost + bent + missed,
        ),
        end.distance,
    )


def _within_planes(far: jax.Array, normal: Vector, mobile: Vector) -> Vector:
    """A displacement by so much along a normal that leaves nodes on their symmetry planes, three times (n,) [m]."""
    square = sum(c * n * n for c, n in zip(mobile, normal, strict=True))
    scale = jnp.where(square > 0.0, far / jnp.where(square > 0.0, square, 1.0), 0.0)
    return vector(scale * c * n for c, n in zip(mobile, normal, strict=True))


def _losses(
    nodes: SlideInput,
    velocities: Vector,
    normal: Vector,
    carrier: Vector,
    velocity_step: jax.Array,
    damping: jax.Array | None,
    *,
    moves: bool,
) -> ContactLosses:
    """Work and losses (n,) [J] of a velocity update after which the nodes have these velocities."""
    mean = vector(0.5 * (new + old) for new, old in zip(velocities, nodes.velocities, strict=True))
    rate = 0.0 if damping is None else damping
    quads = zip(velocities, nodes.velocities, nodes.nodal, mean, nodes.mobile, strict=True)
    impulse = vector(
        c * (nodes.mass * (new - old) - velocity_step * f + velocity_step * rate * nodes.mass * v)
        for new, old, f, v, c in quads
    )
    # Along the normal a node moves as the tool does, but for the tool's acceleration in the step.
    slip, along = minus(mean, carrier), dot(impulse, normal)
    pushed = along * dot(slip, normal)
    friction = pushed - dot(impulse, slip)
    return ContactLosses(
        work=dot(impulse, carrier) + (pushed if moves else 0.0),
        friction=friction,
        impact=jnp.zeros_like(nodes.mass) if moves else -pushed,
        damping=velocity_step * rate * nodes.mass * dot(mean, mean),
    )


def land_and_slide(
    surface: ContactSurface,
    point: Vector,
    velocities: Vector,
    wall: jax.Array,
    left: jax.Array,
    mobile: Vector,
    *,
    differentiable: bool,
) -> tuple[Vector, Vector, jax.Array, jax.Array]:
    """Landing of nodes (n,): they lose their velocity into the surface, and slide on by its contact law.

    Args:
        surface: The surface.
        point: Points at which they touch it, three times (n,) [m].
        velocities: Velocities there, relative to the surface, three times (n,) [m/s].
        wall: Contact triangles and sides, as in `Nodes`.
        left: Remaining time of the step [s]; 0 for nodes that do not land.
        mobile: 1 where a component may change, else 0, three times (n,).
        differentiable: True if loops have a fixed number of passes.

    Returns:
        Positions [m] and velocities [m/s] in the frame of the surface, three times (n,), `wall`, and how far
        they slide on [m].
    """
    triangle, side = jnp.maximum(jnp.abs(wall) - 1, 0), jnp.where(wall < 0, -1, 1)
    _, _, normal = facets(surface.mold, triangle, side)
    slip = project_on_plane(velocities, normal, mobile)
    push = jnp.maximum(-dot(minus(velocities, slip), normal), 0.0)
    slip = surface.mold.contact.limit_slip(slip, push)
    start = Glide.start(point, slip, triangle, side, left)
    end = move_along(surface, start, minus(velocities, slip), mobile, differentiable=differentiable)
    # A node does not leave the surface in the step in which it lands.
    (last_corner, *_), _, last_normal = facets(surface.mold, end.triangle, end.side)
    off = end.off
    height = dot(minus(end.position, last_corner), last_normal)
    place = minus(end.position, _within_planes(height, last_normal, mobile))
    place = vector(jnp.where(off, p, x) for p, x in zip(point, place, strict=True))
    new = vector(jnp.where(off, s, v) for s, v in zip(slip, end.velocity, strict=True))
    wall = jnp.where(off, wall, end.side * (end.triangle + 1))
    return place, new, wall, jnp.where(off, 0.0, end.distance)

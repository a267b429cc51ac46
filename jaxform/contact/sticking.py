"""Landing of nodes: which cross which triangle of a tool in a step, and where (paper, 3.2).

Only the listed pairs that the broad phase selects are tested. The choice of the triangle carries no gradient; the
landing point is then computed differentiably from it, and since it is the point where the path meets the triangle, its
gradient is that of the time of impact.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxform.contact.broad_phase import TEST_BLOCK, Candidates, DueBlocks
from jaxform.contact.sliding import land_and_slide, mobile_components, on_surface
from jaxform.kernels.blocks import entry, lax_cond_once, materialize, put, read_rows, slice_at
from jaxform.mechanics.elements import Nodes
from jaxform.mechanics.membrane import Vector, cross, dot, gather, gather_columns, minus, plus, unstack_rows
from jaxform.tools.mold import Mold, ToolFrame
from jaxform.tools.search import touch_distance
from jaxform.tools.surface_walk import ContactSurface

_SOONEST = 1e-6  # of a step: a node that touches as it starts is no clamped one, whose contact time is 0


def _paths_meet(
    before: Vector, after: Vector, planes: list[jax.Array], touch: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Beta and whether the path from `before` to `after` meets the triangle, pair by pair (Eqs 9-12).

    A node within `touch` of the plane touches it, whichever way it goes; the triangle's edges are inclusive, so that
    no path leaks between two triangles.
    """
    d, normal, dual1, dual2 = ((planes[k], planes[k + 1], planes[k + 2]) for k in range(0, 12, 3))
    away = minus(before, d)
    height = dot(away, normal)
    fall = height - dot(minus(after, d), normal)
    level = fall == 0.0
    beta = jnp.clip(height / jnp.where(level, 1.0, fall), 0.0, 1.0)
    touches = jnp.abs(height) <= touch
    crosses = ~level & (height * (height - fall) <= 0.0)
    x, y, z = (beta * way for way in minus(after, before))
    point = plus(away, (x, y, z))
    gamma, delta = dot(point, dual1), dot(point, dual2)
    tolerance = 1e3 * jnp.finfo(beta.dtype).eps
    inside = (gamma >= -tolerance) & (delta >= -tolerance) & (gamma + delta <= 1.0 + tolerance)
    return beta, (touches | crosses) & inside


class Landing(NamedTuple):
    """Nodes after contact, and the energies of their impacts.

    Attributes:
        nodes: Nodal fields.
        step: Step in which each node came into contact (n_node,).
        loss: Kinetic energy lost by impacts so far [J].
        impact: Position [m] before that step, and velocity [m/s], of nodes that landed (6, n_node); where they land on
            curved paths also `ContactStep.curve`, and the position after that step [m] (12, n_node). None where they
            are not recorded.
        work: Work of moving tools on nodes that came into contact [J]; None where all tools rest.
        record: Triangle on which each node landed in each step (n_step, n_node), as in `encode_landing`; -1 for none.
            None where it is not recorded.
        works: Work of each moving tool, where there are several [J].
    """

    nodes: Nodes
    step: jax.Array
    loss: jax.Array
    impact: jax.Array | None = None
    work: jax.Array | None = None
    record: jax.Array | None = None
    works: tuple[jax.Array, ...] = ()


class ContactStep(NamedTuple):
    """A step: its length [s], the time at its end [s], its number in the window, and the frames of the surfaces.

    Where nodes land on curved paths, `curve` is the change of the nodes' velocities in the step times its length
    (3, n_node) [m], and `damping` the solver's [1/s]. `impulse` is that of the forces on the nodes (3, n_node)
    [N s] over its length; None where the contact loss is the kinetic energy alone.
    """

    length: jax.Array
    end: jax.Array
    number: jax.Array
    frames: tuple[ToolFrame | None, ...] = (None,)
    curve: jax.Array | None = None
    damping: jax.Array | None = None
    impulse: jax.Array | None = None


FlightForces = tuple[jax.Array, jax.Array | None]
"""`ContactStep.impulse` and `ContactStep.curve` of a node (3, 1); the latter None where paths are straight."""


def apply_contact(
    landing: Landing,
    step: ContactStep,
    due: Sequence[DueBlocks],
    mass: tuple[jax.Array, jax.Array | None],
    candidates: Sequence[Candidates],
    surfaces: tuple[ContactSurface, ...],
    known: Sequence[jax.Array],
    workspace: FirstHits,
    flight: Callable[[jax.Array, jax.Array], FlightForces] | None = None,
) -> tuple[Landing, FirstHits]:
    """Moves the nodes that crossed a surface in this step to where they met it; not differentiable.

    Args:
        landing: The nodes after the step without contact; `loss` is the kinetic energy lost so far [J].
        step: The step. The positions before it follow from the velocities and its length, so that they need not be
            copied.
        due: Blocks of the list of each surface with nodes that can touch it in this step.
        mass: Nodal masses (n_node,) [kg], and compliances (3, n_node) [1/kg] where nodes may slide or a tool
            moves.
        candidates: Candidates of each surface.
        surfaces: The surfaces.
        known: Nodes in contact with each surface, from `touches_already`.
        workspace: Workspace for the first hits, from `no_hits`. It is returned unchanged.
        flight: Gives the forces on a node from its number and velocity (3, 1) [m/s]; None where they are not counted.
    """
    count = sum(count for _, count in due)
    return lax_cond_once(
        jnp.asarray(count) > 0,
        lambda both: _place_hit_nodes(*both, step, mass, candidates, due, surfaces, known, flight),
        (landing, workspace),
    )


def apply_known_contact(
    landing: Landing,
    step: ContactStep,
    chosen: jax.Array,
    mass: tuple[jax.Array, jax.Array | None],
    surfaces: tuple[ContactSurface, ...],
) -> Landing:
    """Moves nodes to where each lands on its chosen triangle in this step, by `place_on_surfaces`; differentiable."""

    def place(landing: Landing, step: ContactStep, mass: tuple[jax.Array, jax.Array | None], surfaces: Any) -> Landing:
        return place_on_surfaces(landing, step, mass, surfaces, chosen, differentiable=True)

    any_lands = jnp.any(chosen >= 0)
    return jax.lax.cond(any_lands, jax.checkpoint(place), lambda landing, *_: landing, landing, step, mass, surfaces)


def first_numbers(surfaces: tuple[ContactSurface, ...]) -> list[int]:
    """The number of each surface's first triangle, where those of all surfaces are counted one after the other."""
    return np.cumsum([0, *(len(surface.mold.triangles) for surface in surfaces)]).tolist()


def encode_landing(wall: jax.Array, tool: jax.Array | None, surfaces: tuple[ContactSurface, ...]) -> jax.Array:
    """The triangle (n,) of all surfaces that nodes touch, from `Nodes.wall` and `Nodes.tool`; -1 for none."""
    first: Any = 0 if tool is None else jnp.asarray(first_numbers(surfaces)[:-1], jnp.int32)[tool]
    return jnp.where(wall != 0, first + jnp.abs(wall) - 1, -1)


def _path_ends(nodes: Nodes, length: jax.Array, frame: ToolFrame | None, node: jax.Array) -> tuple[Vector, Vector]:
    """Begin and end of nodes' (n,) paths in a step of a length [s], each three times (n,) [m].

    They are in the frame of the tool, which is None where that rests; the nodes are at their ends.
    """
    # The barriers keep the values that are looked up, and those computed from them, for all their uses.
    looked_up = gather_columns(nodes.positions, node), gather_columns(nodes.velocities, node)
    after, velocities = materialize(looked_up)
    if frame is not None:
        after, velocities = materialize((frame.places(after), frame.speeds(velocities)))
    x, y, z = (a - length * v for a, v in zip(after, velocities, strict=True))
    return materialize((x, y, z)), after


_SlidingParts = tuple[jax.Array, jax.Array]
"""The triangle (n_node,) that nodes lie on, -1 for none, and the connected part (n_triangle,) of triangles."""


def _on_same_part(sliding_parts: _SlidingParts, node: jax.Array, triangle: jax.Array) -> jax.Array:
    """Pairs (n,) of a sliding node and a triangle of the part that it slides on: not tested."""
    lies_on, part = sliding_parts
    on = gather(lies_on, node)
    return (on >= 0) & (gather(part, jnp.maximum(on, 0)) == gather(part, triangle))


def _sliding_parts(nodes: Nodes, number: int, surface: ContactSurface) -> _SlidingParts | None:
    if surface.part is None:
        return None
    sliding = ~nodes.stuck & (nodes.wall != 0) & on_surface(nodes.tool, number)
    return jnp.where(sliding, jnp.abs(nodes.wall) - 1, -1), surface.part


def _block(
    number: jax.Array,
    path_ends: Callable[[jax.Array], tuple[Vector, Vector]],
    touches: jax.Array,
    candidates: Candidates,
    touch: jax.Array,
    sliding_parts: _SlidingParts | None,
) -> tuple[jax.Array, jax.Array, jax.Array, jax.Array]:
    """Node, triangle, beta and whether they meet, (block,) each, of one block of pairs."""
    # Once: else every loop over the block looks the number up for every entry.
    first = materialize(number * TEST_BLOCK)

    node, triangle = (
        slice_at(pairs, first, TEST_BLOCK) for pairs in (candidates.lists.node, candidates.lists.triangle)
    )
    planes = read_rows(candidates.lists.planes.reshape(-1), len(candidates.lists.planes), first, TEST_BLOCK)
    beta, meets = _paths_meet(*path_ends(node), planes, touch)
    used = first + jnp.arange(TEST_BLOCK) < candidates.count
    blocked = gather(touches, node)
    if sliding_parts is not None:
        blocked |= _on_same_part(sliding_parts, node, triangle)
    return node, triangle, beta, meets & used & ~blocked


FirstHits = tuple[jax.Array, jax.Array, jax.Array, jax.Array]
"""The first triangles that nodes meet in a step.

The least beta, infinite where none is met, and its triangle (n_node,), then -1; the nodes that meet any, as a list,
and their number.
"""


def no_hits(node_count: int, real: jnp.dtype) -> FirstHits:
    """Workspace without hits; each step leaves it without hits again, so that it is allocated once."""
    number, listed = jnp.full(node_count, -1, jnp.int32), jnp.zeros(node_count + 1, jnp.int32)
    return jnp.full(node_count, jnp.inf, real), number, listed, jnp.int32(0)


def _first_hits(
    path_ends: Callable[[jax.Array], tuple[Vector, Vector]],
    touches: jax.Array,
    candidates: Candidates,
    due: DueBlocks,
    touch: jax.Array,
    found: FirstHits,
    first: int,
    sliding_parts: _SlidingParts | None,
) -> FirstHits:
    """The triangle that each node meets first in this step, counted from `first`; an earlier hit of the step is kept.

    Of two that are met at the same time, the one with the higher number is always taken.
    """

    def more(carry: tuple[jax.Array, FirstHits]) -> jax.Array:
        return carry[0] < due[1]

    def choose(carry: tuple[jax.Array, FirstHits]) -> tuple[jax.Array, FirstHits]:
        k, found = carry
        node, triangle, beta, meets = _block(entry(due[0], k), path_ends, touches, candidates, touch, sliding_parts)
        return k + 1, _update_hits(found, materialize((node, first + triangle, beta, meets)))

    return jax.lax.while_loop(more, choose, (jnp.int32(0), found))[1]


def _update_hits(found: FirstHits, block: tuple[jax.Array, jax.Array, jax.Array, jax.Array]) -> FirstHits:
    """The hits so far, updated with a block's pairs that meet: one by one, since they are few.

    A scatter would keep XLA from compiling the window's steps into one function.
    """
    node, triangle, beta, meets = block
    index = jnp.arange(TEST_BLOCK)

    def next_one(after: jax.Array) -> jax.Array:
        return jnp.min(jnp.where(meets & (index > after), index, TEST_BLOCK))

    def more(carry: tuple[jax.Array, FirstHits]) -> jax.Array:
        return carry[0] < TEST_BLOCK

    def take(carry: tuple[jax.Array, FirstHits]) -> tuple[jax.Array, FirstHits]:
        k, (best, chosen, nodes, count) = carry
        here = entry(node, k)
        # All is read before anything is written (docs/explanation/kernels.md).
        pair = k, here, entry(beta, k), entry(triangle, k), entry(best, here), entry(chosen, here)
        k, here, own, number, least, last = materialize(pair)
        better = (own < least) | (own == least) & (number > last)
        # A node that is listed already is overwritten by the next one.
        nodes = put(nodes, here[None], count)
        best = put(best, jnp.where(better, own, least)[None], here)
        chosen = put(chosen, jnp.where(better, number, last)[None], here)
        return next_one(k), (best, chosen, nodes, count + (last < 0))

    return jax.lax.while_loop(more, take, (next_one(jnp.asarray(-1)), found))[1]


def _place_hit_nodes(
    landing: Landing,
    workspace: FirstHits,
    step: ContactStep,
    mass: tuple[jax.Array, jax.Array | None],
    candidates: Sequence[Candidates],
    due: Sequence[DueBlocks],
    surfaces: tuple[ContactSurface, ...],
    known: Sequence[jax.Array],
    flight: Callable[[jax.Array, jax.Array], FlightForces] | None,
) -> tuple[Landing, FirstHits]:
    """The landing of the nodes that met a surface, one after the other, since they are few; not differentiable."""
    nodes, met = landing.nodes, workspace
    for number, (surface, first) in enumerate(zip(surfaces, first_numbers(surfaces), strict=False)):
        path_ends = functools.partial(_path_ends, nodes, step.length, step.frames[number])
        touch = touch_distance(surface.grid)
        met = _first_hits(
            path_ends,
            known[number],
            candidates[number],
            due[number],
            touch,
            met,
            first,
            _sliding_parts(nodes, number, surface),
        )

    beta, chosen, listed, count = met

    def place_hit_node(
        k: jax.Array, carry: tuple[Landing, jax.Array, jax.Array]
    ) -> tuple[Landing, jax.Array, jax.Array]:
        landing, beta, chosen = carry
        node = entry(listed, k)

        def read_node(values: jax.Array) -> jax.Array:
            return values if values.ndim == 0 else slice_at(values, node, 1)

        def write_node(values: jax.Array, new: jax.Array) -> jax.Array:
            return new if values.ndim == 0 else put(values, new, node)

        record = landing.record
        landing = landing._replace(record=None)
        # All is read before anything is written (docs/explanation/kernels.md).
        old, masses, triangle = materialize(
            (jax.tree.map(read_node, landing), jax.tree.map(read_node, mass), read_node(chosen))
        )
        this = step
        if flight is not None:
            impulse, curve = materialize(flight(node, old.nodes.velocities))
            this = step._replace(impulse=impulse, curve=curve)
        new = place_on_surfaces(old, this, masses, surfaces, triangle, differentiable=False)
        nodes = dataclasses.replace(new.nodes, positions=unstack_rows(new.nodes.positions))
        landing = jax.tree.map(write_node, landing, new._replace(nodes=nodes))
        if record is not None:
            places = record.shape[1]
            flat = put(record.reshape(-1), triangle.astype(record.dtype), step.number * places + node)
            landing = landing._replace(record=flat.reshape(record.shape))
        beta, chosen = put(beta, jnp.full_like(beta[:1], jnp.inf), node), put(chosen, jnp.full_like(triangle, -1), node)
        return landing, beta, chosen

    landing, beta, chosen = jax.lax.fori_loop(0, count, place_hit_node, (landing, beta, chosen))
    return landing, (beta, chosen, listed, jnp.int32(0))


def touches_already(nodes: Nodes, number: int, surface: ContactSurface, over: jax.Array | None = None) -> jax.Array:
    """Nodes (n,) that are not tested against a surface: they are stuck, or lie on it, or just went over its edge."""
    if surface.mold.contact.sticks:
        return nodes.stuck
    # Where a surface has several parts, nodes that lie on one are tested against the others, pair by pair.
    touched = nodes.wall != 0 if surface.part is None else jnp.zeros_like(nodes.stuck)
    return nodes.stuck | (touched if over is None else touched | over) & on_surface(nodes.tool, number)


def place_on_surfaces(
    landing: Landing,
    step: ContactStep,
    mass: tuple[jax.Array, jax.Array | None],
    surfaces: tuple[ContactSurface, ...],
    chosen: jax.Array,
    *,
    differentiable: bool,
) -> Landing:
    """The landing on the chosen triangles (n_node,), counted over all surfaces, -1 where there is none."""
    firsts = first_numbers(surfaces)
    if len(surfaces) == 1:
        return _place_on_surface(landing, step, mass, surfaces[0], 0, chosen, differentiable=differentiable)
    for number, surface in enumerate(surfaces):
        here = (chosen >= firsts[number]) & (chosen < firsts[number + 1])
        own = jnp.where(here, chosen - firsts[number], -1)
        before = landing.work
        landing = _place_on_surface(landing, step, mass, surface, number, own, differentiable=differentiable)
        if before is not None and landing.work is not None and landing.works and surface.mold.motion is not None:
            place = sum(each.mold.motion is not None for each in surfaces[:number])
            works = list(landing.works)
            works[place] = works[place] + (landing.work - before)
            landing = landing._replace(works=tuple(works))
    return landing


def _place_on_surface(
    landing: Landing,
    step: ContactStep,
    masses: tuple[jax.Array, jax.Array | None],
    surface: ContactSurface,
    number: int,
    chosen: jax.Array,
    *,
    differentiable: bool,
) -> Landing:
    """The landing on the chosen triangles (n_node,) of a surface, -1 where there is none; differentiable."""
    lands, nodes, (mass, compliance) = chosen >= 0, landing.nodes, masses
    after, velocities = jnp.asarray(nodes.positions), nodes.velocities
    frame, work, mold = step.frames[number], landing.work, surface.mold
    if frame is not None:
        after, velocities = jnp.stack(frame.places(after)), jnp.stack(frame.speeds(velocities))
    before = after - step.length * velocities
    point, above, beta = _landing_point(before, after, mold, jnp.maximum(chosen, 0), lands)
    # Signed, one more than the triangle's number: positive where the node came from the side of its normal.
    wall = jnp.where(above < 0, -1, 1) * (chosen + 1)
    loss = 0.5 * mass * dot(velocities, velocities)
    flight = [before, velocities]
    new: Any = 0.0
    slip = nodes.slip
    if not mold.contact.sticks and compliance is not None:
        left = jnp.where(lands, (1.0 - beta) * step.length, 0.0)
        mobile = mobile_components(compliance)
        flying = unstack_rows(point), unstack_rows(velocities)
        place, speed, wall, distance = land_and_slide(
            surface.at(nodes.temperature), *flying, wall, left, mobile, differentiable=differentiable
        )
        lost = 0.5 * (dot(flying[1], flying[1]) - dot(speed, speed))
        point, new, loss = jnp.stack(place), jnp.stack(speed), mass * lost
        slip = None if slip is None else slip + jnp.where(lands, distance, 0.0)
    if frame is not None and work is not None:
        # The tool gives them its own velocity; what they had beside it is lost.
        offset, speed = frame.offset[:, None], frame.velocity[:, None]
        work = work + jnp.sum(jnp.where(lands, mass * dot(new - velocities, speed), 0.0))
        point, new = point + offset, new + speed
        after, velocities = jnp.asarray(nodes.positions), nodes.velocities
        if compliance is not None:
            # A tool does not carry nodes out of a symmetry plane that it closes on.
            mobile = jnp.stack(mobile_components(compliance)) > 0.0
            point, new = jnp.where(mobile, point, after), jnp.where(mobile, new, velocities)
    if step.impulse is not None:
        # A node on another tool has a force of that, too.
        impulse = jnp.where(nodes.wall == 0, step.impulse, 0.0)
        loss = loss + (beta - 0.5) * dot(impulse, velocities - new)
    if step.curve is not None:
        point, new, beta = _land_on_curve(before, after, step, mold, jnp.maximum(chosen, 0), lands)
        flight += [step.curve, point]
    time = step.end - (1.0 - jnp.maximum(beta, _SOONEST)) * step.length
    return Landing(
        nodes=dataclasses.replace(
            nodes,
            positions=jnp.where(lands, point, after),
            velocities=jnp.where(lands, new, velocities),
            stuck=nodes.stuck | lands if mold.contact.sticks else nodes.stuck,
            contact_time=jnp.where(lands, time, nodes.contact_time),
            wall=jnp.where(lands, wall, nodes.wall),
            tool=None if nodes.tool is None else jnp.where(lands, number, nodes.tool),
            slip=slip,
        ),
        step=jnp.where(lands, step.number, landing.step),
        loss=landing.loss + jnp.sum(jnp.where(lands, loss, 0.0)),
        impact=None if landing.impact is None else jnp.where(lands, jnp.concatenate(flight), landing.impact),
        work=work,
        record=landing.record,
        works=landing.works,
    )


def _landing_point(
    before: jax.Array, after: jax.Array, mold: Mold, triangle: jax.Array, lands: jax.Array
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """M of the paper's Eq. 9, (3, n_node) [m], differentiable in the path and the mold.

    Also the height of the path's begin over the triangle (n_node,), of which the sign alone counts, and beta (n_node,).
    """
    d, e, f = (mold.vertices[mold.triangles[triangle, k]].T for k in range(3))
    edge1, edge2 = e - d, f - d
    normal = cross(edge1, edge2)
    height = dot(before - d, normal)
    fall = -dot(after - before, normal)
    # A path within the plane touches it where it begins; both `where` keep its gradient finite.
    crosses = lands & (fall != 0.0)
    ratio = height / jnp.where(crosses, fall, 1.0)
    beta = jnp.where(crosses, jnp.clip(ratio, 0.0, 1.0), 0.0)
    # A node that touches the plane, but does not cross it, is on the side on which it begins, whichever way it goes.
    return before + beta[None] * (after - before), jnp.where(height != 0.0, height, fall), beta


def _land_on_curve(
    before: jax.Array, after: jax.Array, step: ContactStep, mold: Mold, triangle: jax.Array, lands: jax.Array
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Position (3, n_node) [m] and velocity [m/s] after landing on a curved path, and beta (n_node,).

    The path is the parabola with the accelerations of the step. Its end is the landing point M and, for one step, a
    little more: (beta - beta^2) / 2 of the step's displacement. So the mean position of the node over time, and with
    it the force on its neighbours, is that of a node that stops where it lands; the velocity returns it to M. Neither
    depends on the time of landing within a step, to second order.
    """
    assert step.curve is not None
    d, e, f = (mold.vertices[mold.triangles[triangle, k]].T for k in range(3))
    normal = cross(e - d, f - d)
    height, way = dot(before - d, normal), after - before
    fall, bend = -dot(way, normal), dot(step.curve, normal)
    # The first root of height - beta fall + beta (beta - 1) / 2 bend, from the side on which the node is.
    side = jnp.where(fall < 0.0, -1.0, 1.0)
    height, slope, bend = side * height, side * (fall + 0.5 * bend), side * bend
    square = jnp.square(slope) - 2.0 * height * bend
    crosses = lands & (height > 0.0) & (square > 0.0)
    root = slope + jnp.sqrt(jnp.where(crosses, square, 1.0))
    crosses &= root > 0.0
    beta = jnp.where(crosses, jnp.clip(2.0 * height / jnp.where(crosses, root, 1.0), 0.0, 1.0), 0.0)
    point = before + beta * way + 0.5 * beta * (beta - 1.0) * step.curve
    more = 0.5 * beta * (1.0 - beta) * (way + (beta - 0.5) * step.curve)
    half = 0.0 if step.damping is None else 0.5 * step.damping * step.length
    # A halted window goes on with steps of no length, in which nothing lands.
    length = jnp.where(step.length > 0.0, step.length, 1.0)
    return point + more, -(1.0 + half) / ((1.0 - half) * length) * more, beta

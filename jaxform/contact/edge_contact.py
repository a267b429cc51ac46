"""Contact of the sheet's sides with sharp edges of tools: a side that would pass an edge is held there.

Only nodes meet triangles (`contact.sticking`): a side between two nodes could pass through a rib that stands between
them. Here the sides near an edge are compared with it, segment against segment. Where a side crosses it from the
outside in a step, the point of the side sticks to the point of the edge that it meets, for good, and moves along with
the tool.

The constraint is linear in the positions of the side's ends: (1 - s) x_i + s x_j stays at the point; its forces are in
`contact.edge_forces`. A side is straight: one with an end in contact is held only where less than half of it hangs over
the edge, for else it would keep the sheet off the tool by more than it cuts it.

Which side meets which edge, and when, is a decision without derivative; the share s and the point are computed from the
time of impact, differentiably.
"""

from __future__ import annotations

import dataclasses
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from jaxform.contact.broad_phase import TEST_BLOCK, Candidates, NearSides
from jaxform.core.pytree import pytree
from jaxform.kernels.blocks import (
    compact_indices,
    entry,
    lax_cond_once,
    materialize,
    over_blocks,
    put,
    slice_at,
)
from jaxform.mechanics.corners import scale
from jaxform.mechanics.elements import Nodes
from jaxform.mechanics.membrane import Vector, cross, dot, gather, gather_columns, minus, plus, vector
from jaxform.tools.mold import Mold, ToolFrame
from jaxform.tools.surface_walk import ContactSurface

NOT_HELD = jnp.iinfo(jnp.int32).max
"""The step of an unused entry of held sides."""
SOFTNESS = 3e-5  # of its ends' own way in the step in which a side is first held: more may be held than can be
_APART = 0.2  # of a side: two points that are held on it are no nearer to each other
OVERHANG = 0.5  # of a side with a node in contact: it is held only where less of it hangs over the edge
_CONE = 1e-6  # sine by which the common normal may leave the cone between both faces' normals, besides a step's way
_EDGE_GROUP = 16  # edges for which near sides are found together
_WIDER = 1.25  # times the spheres that nodes are expected to stay in


@pytree
class HeldSides:
    """Sides that are held at sharp edges (room,); those beyond the count are not.

    Attributes:
        ends: The nodes at both ends (2, room).
        share: Place of the point along the side (room,): 0 at the first end, 1 at the second.
        point: The point at which the side is held (3, room) [m], in the frame of the tool.
        edge: The number of the edge, counted over all surfaces (room,).
        step: The step of the window in which it was first held (room,); -1 before, NOT_HELD where it is not.
        softness: Compliance (room,) of each as a spring, times the mass that its ends oppose to it [s^2].
        force: Holding force of the last step (3, room) [N], from which the next one is solved.
        count: Number of held sides; above the capacity (room,) some are missing, and the window is rejected.
    """

    ends: jax.Array
    share: jax.Array
    point: jax.Array
    edge: jax.Array
    step: jax.Array
    softness: jax.Array
    force: jax.Array
    count: jax.Array

    def at(self, place: jax.Array) -> HeldSides:
        """The same with the nodes at other places (n_node,), before the first step of a window."""
        step = jnp.where(self.step == NOT_HELD, self.step, -1)
        return dataclasses.replace(self, ends=gather(place, self.ends), step=step)

    @property
    def overflow(self) -> jax.Array:
        """True where more sides are to be held than there is capacity for."""
        return self.count > self.share.size

    def has_end(self, count: int) -> jax.Array:
        """True for those of so many nodes (count,) that are the end of a held side."""
        held = jnp.where(self.step == NOT_HELD, count, self.ends)
        return jnp.zeros(count, bool).at[held.ravel()].set(True, mode="drop")

    def enlarge(self, times: int) -> HeldSides:
        """The same with several times the capacity."""
        room = self.share.size
        free = no_held_sides((times - 1) * room, self.share.dtype)
        return jax.tree.map(lambda own, more: jnp.concatenate([own, more], axis=-1) if own.ndim else own, self, free)


def no_held_sides(room: int, real: jnp.dtype) -> HeldSides:
    """No side is held; there is capacity for some."""
    none = jnp.zeros(room, jnp.int32)
    return HeldSides(
        ends=jnp.zeros((2, room), jnp.int32),
        share=jnp.zeros(room, real),
        point=jnp.zeros((3, room), real),
        edge=none,
        step=jnp.full(room, NOT_HELD, jnp.int32),
        softness=jnp.zeros(room, real),
        force=jnp.zeros((3, room), real),
        count=jnp.int32(0),
    )


# Intersections of sides and edges.


_Meetings = tuple[jax.Array, jax.Array, Vector]
"""Mask of the pairs whose side passes the edge in a step (n,), the share of the side there, and the point [m]."""

_Corners = tuple[Vector, Vector, Vector, Vector]
"""Begin and end of edges, then the third corner of either face there, each three times (n,) [m]."""


def edge_corners(mold: Mold, edges: jax.Array, number: jax.Array) -> _Corners:
    """The corners at edges with these numbers (n,), of the edges (4, n_edge) of a tool; differentiable."""
    begin, end, one, other = (vector(mold.vertices[edges[k, number]].T) for k in range(4))
    return begin, end, one, other


def _across(way: Vector, along: Vector) -> Vector:
    """Unit vectors (n,) of ways, without what they have along unit vectors."""
    rest = minus(way, scale(dot(way, along), along))
    square = dot(rest, rest)
    return scale(1.0 / jnp.sqrt(jnp.where(square > 0.0, square, 1.0)), rest)


def _is_between_faces(places: Vector, corners: _Corners) -> jax.Array:
    """True for places (n,) in the wedge of less than 180 degrees between the faces at an edge.

    A side with both ends there is in it as a whole, so that it cannot pass the edge from outside.
    """
    start, end, *thirds = corners
    along, _ = _unit(minus(end, start))
    ways = [_across(minus(third, start), along) for third in thirds]
    away = minus(places, start)
    mixed, one, other = dot(*ways), dot(ways[0], away), dot(ways[1], away)
    # Their shares of the two directions are both positive; what is along the edge has none.
    return (one - mixed * other > 0.0) & (other - mixed * one > 0.0)


def _unit(a: Vector) -> tuple[Vector, jax.Array]:
    square = dot(a, a)
    there = square > 0.0
    return scale(jnp.where(there, 1.0, 0.0) / jnp.sqrt(jnp.where(there, square, 1.0)), a), there


def _oriented_normal(side: Vector, along: Vector, outward: Vector) -> tuple[Vector, jax.Array]:
    """The common unit normals (n,) of sides and edges, on the edges' outer side; and whether there is one."""
    normal, there = _unit(cross(side, along))
    return scale(jnp.where(dot(normal, outward) < 0.0, -1.0, 1.0), normal), there


def _meet(before: tuple[Vector, Vector], after: tuple[Vector, Vector], corners: _Corners) -> _Meetings:
    """The meetings of sides and edges, pair by pair, from the ends' paths in a step, in the tool's frame."""
    start, end, *thirds = corners
    edge = minus(end, start)
    along, there = _unit(edge)
    ways = [_across(minus(third, start), along) for third in thirds]
    outward = scale(-1.0, plus(*ways))
    normal0, turns0 = _oriented_normal(minus(before[1], before[0]), along, outward)
    normal1, turns1 = _oriented_normal(minus(after[1], after[0]), along, outward)
    gap0, gap1 = dot(minus(before[0], start), normal0), dot(minus(after[0], start), normal1)
    passes = there & turns0 & turns1 & (gap0 >= 0.0) & (gap1 < 0.0)
    beta = jnp.where(passes, gap0 / jnp.where(passes, gap0 - gap1, 1.0), 0.0)
    first, second = (plus(scale(1.0 - beta, a), scale(beta, b)) for a, b in zip(before, after, strict=True))
    side, away = minus(second, first), minus(first, start)
    a, b, c = dot(side, side), dot(side, edge), dot(edge, edge)
    d, e = dot(side, away), dot(edge, away)
    area = a * c - b * b
    passes &= area > 0.0
    area = jnp.where(passes, area, 1.0)
    share, far = (b * e - c * d) / area, (a * e - b * d) / area
    passes &= (share > 0.0) & (share < 1.0) & (far >= 0.0) & (far <= 1.0)
    paths = [minus(x, y) for x, y in zip(after, before, strict=True)]
    square = jnp.maximum(*(dot(path, path) for path in paths))
    farthest = jnp.sqrt(square)
    # Both points are apart by no more than the way of the ends. Where side and edge are parallel, both are rounding:
    # the ends alone meet the tool there.
    apart = minus(plus(away, scale(share, side)), scale(far, edge))
    passes &= dot(apart, apart) <= square
    # A line that touches the edge from outside has its normal between those of both faces. Where it has met another
    # edge of a face in the same step, it is beyond that by no more than the way of its ends.
    for third, way in zip(thirds, ways, strict=True):
        width = dot(minus(third, start), way)
        passes &= dot(normal1, way) * width <= farthest + _CONE * width
    return passes, share, plus(start, scale(far, edge))


# Search for sides that meet edges, while a list of candidates is valid; not differentiable.


_Listed = tuple[jax.Array, jax.Array, jax.Array]
"""Sides (room,), the edge that each can meet, and how many there are."""


def list_near_sides(
    candidates: Candidates,
    stuck: jax.Array,
    triangles: jax.Array,
    used: jax.Array,
    mold: Mold,
    edges: jax.Array,
    speed: jax.Array | float,
) -> NearSides:
    """Lists the sides of elements that can meet a sharp edge while the candidates are valid.

    Args:
        candidates: Those of the surface, with the spheres in which nodes are expected to stay.
        stuck: Nodes (n_node,) that do not move by themselves.
        triangles: Places of the elements' nodes (3, n_element).
        used: Elements (n_element,) that there are.
        mold: The tool.
        edges: Its sharp edges (4, n_edge).
        speed: Way of the tool while the list is valid [m]: nodes that stick elsewhere move by it in the tool's frame.
    """
    center, radius = candidates.lists.spheres[0][:3], candidates.lists.spheres[0][3]
    wide = _WIDER * radius + speed
    begin, end = (jnp.concatenate([triangles[(k + turn) % 3] for k in range(3)]) for turn in (0, 1))
    moves = jnp.tile(used, 3) & ~(stuck[begin] & stuck[end])
    one, other = center[:, begin], center[:, end]
    middle, half = 0.5 * (one + other), 0.5 * (other - one)
    within = jnp.maximum(wide[begin], wide[end])
    reach = jnp.sqrt(dot(half, half)) + within
    room, number = 2 * candidates.lists.node.size, edges.shape[1]
    listed = jnp.zeros(room + TEST_BLOCK, jnp.int32)

    def add_group(group: jax.Array, found: _Listed) -> _Listed:
        """Adds the pairs of some edges that are near to each other: with the sides near to the box around them."""
        first = group * _EDGE_GROUP
        rows = edges[:2, jnp.minimum(first + jnp.arange(_EDGE_GROUP), number - 1)]
        ends = mold.vertices[rows].reshape(-1, 3)
        low, high = (bound(ends, axis=0)[:, None] for bound in (jnp.min, jnp.max))
        gap = jnp.maximum(jnp.maximum(low - middle, middle - high), 0.0)
        near = moves & (dot(gap, gap) <= reach * reach)
        sides, count = materialize(compact_indices(near, near.size + TEST_BLOCK))
        last = jnp.minimum(first + _EDGE_GROUP, number)
        return jax.lax.fori_loop(first, last, lambda k, found: add_edge(k, found, sides, count), found)

    def add_edge(k: jax.Array, found: _Listed, sides: jax.Array, count: jax.Array) -> _Listed:
        corners = edge_corners(mold, edges, k[None])
        a, b = (jnp.stack(corner) for corner in corners[:2])
        square = dot(b - a, b - a)

        def test(block: jax.Array, found: _Listed) -> _Listed:
            own = slice_at(sides, block * TEST_BLOCK, TEST_BLOCK)
            gap = segment_gaps(one[:, own], 2.0 * half[:, own], a, b - a)
            between = [_is_between_faces(vector(x[:, own]), corners) for x in (one, other)]
            near = (gap <= jnp.square(within[own])) & (square > 0.0) & ~(between[0] & between[1])
            near &= block * TEST_BLOCK + jnp.arange(TEST_BLOCK) < count
            place, more = compact_indices(near, TEST_BLOCK)
            side, edge, total = found
            at = jnp.minimum(total, room)
            return put(side, own[place], at), put(edge, jnp.full_like(place, k), at), total + more

        return jax.lax.fori_loop(0, -(-count // TEST_BLOCK), test, found)

    none = listed, listed, jnp.int32(0)
    side, edge, count = jax.lax.fori_loop(0, -(-number // _EDGE_GROUP), add_group, none)
    ends = jnp.stack([begin[side], end[side]])
    overflow, count = count > room, jnp.minimum(count, room)
    return NearSides(ends, edge, count, center, jnp.where(stuck, jnp.inf, radius * radius), overflow)


def segment_gaps(start: jax.Array, side: jax.Array, begin: jax.Array, edge: jax.Array) -> jax.Array:
    """Squares (n,) [m^2] of the distances between segments from points (3, n) [m] along (3, n), and one edge.

    Ericson: Real-Time Collision Detection (2005), 5.1.9.
    """
    away = start - begin
    a, b, c = dot(side, side), dot(side, edge), dot(edge, edge)
    d, e = dot(side, away), dot(edge, away)
    area, whole, length = a * c - b * b, jnp.where(a > 0.0, a, 1.0), jnp.where(c > 0.0, c, 1.0)
    share = jnp.clip(jnp.where(area > 0.0, (b * e - c * d) / jnp.where(area > 0.0, area, 1.0), 0.0), 0.0, 1.0)
    far = jnp.clip((b * share + e) / length, 0.0, 1.0)
    share = jnp.clip((b * far - d) / whole, 0.0, 1.0)
    gap = away + share * side - far * edge
    return dot(gap, gap)


def leaves_list(near: NearSides, places: Any, blocks: jax.Array) -> jax.Array:
    """True where a node, at places three times (n_node,) [m], leaves the sphere for which sides were listed."""

    def compute_block(places: Any, center: jax.Array, square: jax.Array) -> Any:
        away = minus(vector(places), vector(center))
        return [], [dot(away, away) > square]

    _, (gone,) = over_blocks(compute_block, blocks, (vector(places), near.center, near.square), [], sums=1)
    return gone > 0


class SidePaths(NamedTuple):
    """The nodes' paths in a step: positions before contact, and after it, velocities before it; length and frame."""

    flown: Any
    landed: Any
    velocities: jax.Array
    length: jax.Array
    frame: ToolFrame | None

    def ends(self, node: jax.Array) -> tuple[Vector, Vector]:
        """Begin and end of paths of nodes (n,), in the tool's frame."""
        flown, landed = gather_columns(self.flown, node), gather_columns(self.landed, node)
        velocities = gather_columns(self.velocities, node)
        if self.frame is not None:
            flown, landed = self.frame.places(flown), self.frame.places(landed)
            velocities = self.frame.speeds(velocities)
        before = vector(x - self.length * v for x, v in zip(flown, velocities, strict=True))
        return before, vector(landed)


def find_held_sides(
    held: HeldSides,
    near: NearSides,
    paths: SidePaths,
    nodes: Nodes,
    surface: ContactSurface,
    edges: jax.Array,
    first: int,
    number: jax.Array,
) -> HeldSides:
    """The held sides, with those that pass an edge of the surface in this step.

    Args:
        held: Those so far.
        near: The list.
        paths: The nodes' paths.
        nodes: The nodes after contact.
        surface: The surface.
        edges: Its sharp edges (4, n_edge).
        first: Number of the first of them, counted over all surfaces.
        number: Number of the step.
    """

    def more(carry: tuple[jax.Array, HeldSides]) -> jax.Array:
        return carry[0] * TEST_BLOCK < near.count

    def test(carry: tuple[jax.Array, HeldSides]) -> tuple[jax.Array, HeldSides]:
        k, held = carry
        begin = materialize(k * TEST_BLOCK)
        one, other, edge = (slice_at(row, begin, TEST_BLOCK) for row in (near.ends[0], near.ends[1], near.edge))
        (before_one, after_one), (before_other, after_other) = paths.ends(one), paths.ends(other)
        corners = edge_corners(surface.mold, edges, edge)
        passes, share, point = _meet((before_one, before_other), (after_one, after_other), corners)
        stuck = gather(nodes.stuck, one), gather(nodes.stuck, other)
        hangs = jnp.where(stuck[0], 1.0 - share, jnp.where(stuck[1], share, 0.0))
        passes = passes & ~(stuck[0] & stuck[1]) & (hangs <= OVERHANG)
        passes &= begin + jnp.arange(TEST_BLOCK) < near.count
        pairs = materialize((one, other, first + edge, (passes, share, point)))
        return k + 1, lax_cond_once(jnp.any(passes), lambda held: _add_sides(held, *pairs, number, paths.length), held)

    return jax.lax.while_loop(more, test, (jnp.int32(0), held))[1]


def _add_sides(
    held: HeldSides,
    one: jax.Array,
    other: jax.Array,
    edge: jax.Array,
    found: _Meetings,
    number: jax.Array,
    length: jax.Array,
) -> HeldSides:
    """Adds the sides that pass, one by one, unless they are held near there; beyond the capacity they only count."""
    passes, shares, points = found
    softness = (SOFTNESS * jnp.square(length)).astype(held.softness.dtype)

    def add(k: jax.Array, held: HeldSides) -> HeldSides:
        i, j, share = entry(one, k), entry(other, k), entry(shares, k)
        there = held.step != NOT_HELD
        same = (held.ends[0] == i) & (held.ends[1] == j)
        turned = (held.ends[0] == j) & (held.ends[1] == i)
        place = jnp.where(turned, 1.0 - held.share, held.share)
        known = jnp.any(there & (same | turned) & (jnp.abs(place - share) < _APART))
        meets = entry(passes, k) & ~known
        takes = meets & (held.count < held.share.size)
        at = jnp.minimum(held.count, held.share.size - 1)

        def write(values: jax.Array, new: jax.Array) -> jax.Array:
            return put(values, jnp.where(takes, new[..., None], slice_at(values, at, 1)), at)

        values = jnp.stack([i, j]), share, jnp.stack([entry(x, k) for x in points]), entry(edge, k), number, softness
        values, held = materialize((values, held))
        return HeldSides(
            write(held.ends, values[0]),
            write(held.share, values[1]),
            write(held.point, values[2]),
            write(held.edge, values[3]),
            write(held.step, values[4]),
            write(held.softness, values[5]),
            held.force,
            held.count + meets,
        )

    return jax.lax.fori_loop(0, TEST_BLOCK, add, held)


def hold_known_sides(
    held: HeldSides,
    known: HeldSides,
    paths: SidePaths,
    surface: ContactSurface,
    edges: jax.Array,
    first: int,
    number: jax.Array,
) -> HeldSides:
    """The held sides, with the known ones that pass an edge of the surface in this step; differentiable."""
    here = (known.step == number) & (known.edge >= first) & (known.edge < first + edges.shape[1])

    def place(held: HeldSides) -> HeldSides:
        (before_one, after_one), (before_other, after_other) = (paths.ends(end) for end in known.ends)
        own = jnp.where(here, known.edge - first, 0)
        corners = edge_corners(surface.mold, edges, own)
        _, share, point = _meet((before_one, before_other), (after_one, after_other), corners)
        point = jnp.where(here, jnp.stack(point), held.point)
        return dataclasses.replace(held, share=jnp.where(here, share, held.share), point=point)

    return jax.lax.cond(jnp.any(here), jax.checkpoint(place), lambda held: held, held)

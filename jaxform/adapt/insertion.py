"""Insertion of new nodes at a window boundary, and their contact with the mold.

The middle of an element's side may penetrate the mold where the element cut a corner of it. This is detected from the
side's ends, which are on the near side: the path from them crosses the mold. Such a node is moved to the nearest place
of the mold. A new node on the mold sticks if both ends of its edge do; one before the mold is free; one that was in
contact at the start of the run still is.

Places are assigned in order, and an edge's ends come before its middle: new nodes are processed in blocks of places,
and only as far as there are any.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp

from jaxform.contact.ray_crossings import Crossings, ray_crossings
from jaxform.contact.sliding import on_surface
from jaxform.kernels.blocks import BLOCK, compact_indices, lax_cond_once, put, slice_at
from jaxform.kernels.derivatives import save_decision
from jaxform.mechanics.elements import Nodes
from jaxform.mechanics.membrane import cross, dot, unstack_rows, vector
from jaxform.model.scene import Adaptivity, Scene
from jaxform.model.tables import BisectionHierarchy
from jaxform.sheet.discretization import RefinedMesh
from jaxform.sheet.state import State, clamp_is_open, initial_node_state
from jaxform.tools import search
from jaxform.tools.mold import Mold, ToolFrame
from jaxform.tools.search import SearchGrid, cell_of
from jaxform.tools.search import distance as distance_to
from jaxform.tools.surface_walk import ContactSurface, project_on_plane

# The nearest place of the mold: of points, and on a chosen triangle, differentiably.

_LANES = 64  # nodes that are processed together


def nearest_triangle(positions: jax.Array, wanted: jax.Array, grid: SearchGrid) -> tuple[jax.Array, jax.Array]:
    """The nearest triangle to each wanted node; of equally near ones, the one that faces it most squarely.

    Returns:
        Its number (n,), -1 where none is within reach, and its distance (n,) [m].
    """
    count = positions.shape[1]
    rows = -(-count // _LANES) * _LANES
    node, total = compact_indices(wanted, rows)
    cells = cell_of(positions, grid)
    tie = 1e-9 * grid.size
    # Number and distance of the triangle, and the height over its plane.
    none = jnp.int32(-1), jnp.asarray(jnp.inf, positions.dtype), jnp.asarray(0.0, positions.dtype)

    def more_nodes(carry: tuple[jax.Array, list[jax.Array]]) -> jax.Array:
        return carry[0] < total

    def search_nodes(carry: tuple[jax.Array, list[jax.Array]]) -> tuple[jax.Array, list[jax.Array]]:
        first, found = carry
        lane = slice_at(node, first, _LANES)
        point, cell = positions[:, lane], cells[lane]
        begin = grid.start[cell]
        length = jnp.where(first + jnp.arange(_LANES) < total, grid.start[cell + 1] - begin, 0)

        def more(carry: tuple[jax.Array, list[jax.Array]]) -> jax.Array:
            return carry[0] < jnp.max(length)

        def compare(carry: tuple[jax.Array, list[jax.Array]]) -> tuple[jax.Array, list[jax.Array]]:
            k, best = carry
            _, least, highest = best
            row = grid.listed[jnp.where(k < length, begin + k, 0)]
            frame = grid.frames[row]
            distance, height = distance_to(point, frame), dot(point - frame[:, :3].T, frame[:, 3:6].T)
            closer = distance < least - tie
            squarer = (distance <= least + tie) & (jnp.abs(height) > jnp.abs(highest))
            take = (k < length) & (closer | squarer)
            new = grid.number[row], distance, height
            return k + 1, [jnp.where(take, a, b) for a, b in zip(new, best, strict=True)]

        start = [jnp.broadcast_to(value, (_LANES,)) for value in none]
        _, best = jax.lax.while_loop(more, compare, (jnp.int32(0), start))
        mine = jnp.where(first + jnp.arange(_LANES) < total, lane, count)
        return first + _LANES, [old.at[mine].set(new, mode="drop") for old, new in zip(found, best[:2], strict=True)]

    nothing = [jnp.full(count, value) for value in none[:2]]
    _, (triangle, distance) = jax.lax.while_loop(more_nodes, search_nodes, (jnp.int32(0), nothing))
    return triangle, distance


def closest_place(positions: jax.Array, mold: Mold, triangle: jax.Array, lands: jax.Array) -> jax.Array:
    """The point (3, n) [m] of each node's triangle that is nearest to it; differentiable where it `lands`."""
    d, e, f = (mold.vertices[mold.triangles[triangle, k]].T for k in range(3))
    edge1, edge2 = e - d, f - d
    normal = jnp.stack(cross(edge1, edge2))
    square = dot(normal, normal)
    away = jnp.where(lands, positions - d, 0.0)
    gamma = dot(cross(away, edge2), normal) / square
    delta = dot(cross(edge1, away), normal) / square
    flat = d + gamma[None] * edge1 + delta[None] * edge2
    inside = (gamma >= 0) & (delta >= 0) & (gamma + delta <= 1)
    candidates = [_on_segment(positions, *ends) for ends in ((d, e), (e, f), (f, d))]
    best = candidates[0]
    for other in candidates[1:]:
        gaps = [positions - point for point in (other, best)]
        nearer = dot(gaps[0], gaps[0]) < dot(gaps[1], gaps[1])
        best = jnp.where(nearer, other, best)
    return jnp.where(inside, flat, best)


def _on_segment(points: jax.Array, begin: jax.Array, end: jax.Array) -> jax.Array:
    along = end - begin
    return begin + jnp.clip(dot(points - begin, along) / dot(along, along), 0.0, 1.0)[None] * along


_BEFORE = 64  # times the distance at which a node touches, before its triangle: where the path of one in contact begins
_BACKWARD = 0.5  # cosine: a place that is that far from where the sheet is, is on the back of a thin part
_CALM = 0.5  # of its edge: a new node that is nearer to the mold is at rest; from a whole one on it moves as it would


class _Insertions(NamedTuple):
    """A block of places from `begin` on: which (n,) have a new node, which node, and the places of its edge's ends."""

    begin: jax.Array
    new: jax.Array
    node: jax.Array
    ends: tuple[jax.Array, jax.Array]
    differentiable: bool

    def block_of(self, values: jax.Array) -> jax.Array:
        """The block of values (..., n_place)."""
        return slice_at(values, self.begin, self.new.size)

    def put(self, values: jax.Array, inserted: jax.Array) -> jax.Array:
        """The values with others at the new nodes' places."""
        return put(values, jnp.where(self.new, inserted, self.block_of(values)), self.begin)

    def join_ends(self, outside: list[jax.Array], join: Callable[..., jax.Array], depth: int) -> jax.Array:
        """Joins the values (..., n) at both ends of the edges: `outside`, or where an end is new, its own join."""
        inside = [jnp.clip(end - self.begin, 0, self.new.size - 1) for end in self.ends]
        newer = [self.new & (end >= self.begin) & self.new[at] for end, at in zip(self.ends, inside, strict=True)]

        def join_again(current: jax.Array) -> jax.Array:
            triples = zip(newer, inside, outside, strict=True)
            return join(*(jnp.where(new, current[..., at], other) for new, at, other in triples))

        def is_waiting(waiting: jax.Array) -> jax.Array:
            waits = [new & waiting[at] for new, at in zip(newer, inside, strict=True)]
            return waits[0] | waits[1]

        def generation(carry: tuple[jax.Array, jax.Array], _: None) -> tuple[tuple[jax.Array, jax.Array], None]:
            current, waiting = carry
            return (
                lax_cond_once(jnp.any(waiting), join_again, current, differentiable=True),
                is_waiting(waiting),
            ), None

        start = join(*outside), newer[0] | newer[1]
        if self.differentiable:
            # At most as often as there can be generations at one window boundary; mostly there are one or two.
            return jax.lax.scan(generation, start, length=depth)[0][0]
        return jax.lax.while_loop(
            lambda carry: jnp.any(carry[1]), lambda carry: (join_again(carry[0]), is_waiting(carry[1])), start
        )[0]


def insert_nodes(
    state: State,
    mesh: RefinedMesh,
    scene: Scene,
    adaptivity: Adaptivity,
    volumes: jax.Array,
    *,
    differentiable: bool = True,
) -> State:
    """The state with the additional nodes of a finer mesh: their places, velocities, and whether they stick.

    Args:
        state: The state, with its own mesh.
        mesh: The finer mesh.
        scene: The scene.
        adaptivity: Its adaptive refinement.
        volumes: Volumes of all triangles of the forest (n_triangle,) [m^3].
        differentiable: True if loops have as many passes as the capacity; else they end with the new nodes.
    """
    (_, forest), old, surfaces = adaptivity, state.refined_mesh, scene.surfaces
    size = min(BLOCK, mesh.node.size)

    def make_insertions(block: jax.Array) -> _Insertions:
        nominal = old.node_count + block * size
        begin = jnp.minimum(nominal, mesh.node.size - size)
        place = begin + jnp.arange(size)
        new = (place >= nominal) & (place < mesh.node_count)
        node = slice_at(mesh.node, begin, size)
        first, second = (jnp.where(new, mesh.place[end], place) for end in forest.ends[:, node])
        return _Insertions(begin, new, node, (first, second), differentiable)

    def map_blocks(nodes: Nodes, work: Callable[[Nodes, _Insertions], Nodes]) -> Nodes:
        if not differentiable:
            blocks = -(-(mesh.node_count - old.node_count) // size)
            return jax.lax.fori_loop(0, blocks, lambda block, nodes: work(nodes, make_insertions(block)), nodes)

        def one(nodes: Nodes, block: jax.Array) -> tuple[Nodes, None]:
            any_left = old.node_count + block * size < mesh.node_count
            return lax_cond_once(
                any_left, lambda nodes: work(nodes, make_insertions(block)), nodes, differentiable=True
            ), None

        return jax.lax.scan(one, nodes, jnp.arange(-(-mesh.node.size // size)))[0]

    def older(place: jax.Array) -> jax.Array:
        """The places (n,) themselves where nodes were before; else that of an end of their edge, or of an end's."""

        def move_up(place: jax.Array) -> jax.Array:
            return jnp.where(place < old.node_count, place, mesh.place[forest.ends[0, mesh.node[place]]])

        return jax.lax.while_loop(lambda place: jnp.any(place >= old.node_count), move_up, place)

    # The loop over blocks carries no more than it changes.
    frames, nodes = present_frames(state, scene), dataclasses.replace(state.nodes, mode=None)
    # If all nodes that move stick to one tool, its frame is used, in which they rest.
    frame = frames[0] if len(frames) == 1 else None
    if frame is not None:
        nodes = _to_frame(nodes, frame)
    opened = clamp_is_open(state, scene)
    nodes = map_blocks(
        nodes, lambda nodes, insertions: _interpolate_nodes(nodes, insertions, scene, forest, volumes, frame, opened)
    )
    for number, own in enumerate(frames):
        surface = surfaces[number]

        def place(
            nodes: Nodes, insertions: _Insertions, surface: ContactSurface = surface, number: int = number
        ) -> Nodes:
            return _place_on_surface(nodes, insertions, surface, number, adaptivity, older, state.time)

        if own is not None and frame is None:
            nodes = _to_frame(nodes, own)
        nodes = map_blocks(nodes, place)
        if own is not None:
            nodes = _to_frame(nodes, ToolFrame(-own.offset, -own.velocity))
    return dataclasses.replace(state, nodes=nodes).replace_nodes(mode=state.nodes.mode)


def present_frames(state: State, scene: Scene) -> tuple[ToolFrame | None, ...]:
    """The frames of the surfaces at the present time; None of those at rest."""
    return scene.frames(state.time - state.control.last_length, state.time)


def _to_frame(nodes: Nodes, frame: ToolFrame) -> Nodes:
    positions, velocities = jnp.stack(frame.places(nodes.positions)), jnp.stack(frame.speeds(nodes.velocities))
    return dataclasses.replace(nodes, positions=positions, velocities=velocities)


def _interpolate_nodes(
    nodes: Nodes,
    insertions: _Insertions,
    scene: Scene,
    forest: BisectionHierarchy,
    volumes: jax.Array,
    frame: ToolFrame | None,
    opened: jax.Array,
) -> Nodes:
    """The nodes with the block's new ones in the middle of their edges, moving as these did.

    A bisection takes from the edge's ends the mass of the parts that they do not belong to any more: with velocities
    weighted by these the momentum is kept exactly.
    """
    # Displacements, not positions: a new node's initial place may be off its edge, at a rim that is round.
    reference = scene.parison.positions
    begins = [jnp.where(insertions.new, reference[end].T, 0.0) for end in forest.ends[:, insertions.node]]
    moved = [nodes.positions[:, end] - begin for end, begin in zip(insertions.ends, begins, strict=True)]
    middle = insertions.join_ends(moved, lambda first, second: 0.5 * (first + second), forest.depth)
    weight = _weight(volumes, forest.owner[insertions.node], forest.ends[0, insertions.node], forest)
    velocities = insertions.join_ends(
        [nodes.velocities[:, end] for end in insertions.ends],
        lambda first, second: weight[None] * first + (1.0 - weight)[None] * second,
        forest.depth,
    )
    stuck, contact_time, wall, tool = initial_node_state(scene, insertions.node, opened=opened)
    moves, speeds = jnp.where(stuck, 0.0, middle), jnp.where(stuck, 0.0, velocities)
    if frame is not None:
        # In the frame of the tool the clamped nodes move.
        clamped = stuck & (wall == 0)
        moves = jnp.where(clamped, -frame.offset[:, None], moves)
        speeds = jnp.where(clamped, -frame.velocity[:, None], speeds)

    def insert_field(name: str, values: jax.Array) -> jax.Array:
        ends = [values[end] for end in insertions.ends]
        return insertions.put(values, insertions.join_ends(ends, scene.fields[name].between, forest.depth))

    return dataclasses.replace(
        nodes,
        positions=insertions.put(nodes.positions, reference[insertions.node].T + moves),
        velocities=insertions.put(nodes.velocities, speeds),
        stuck=insertions.put(nodes.stuck, stuck),
        # A node that slides may have left the tool that it touched at the start.
        contact_time=insertions.put(nodes.contact_time, jnp.where(stuck, contact_time, -1.0)),
        wall=insertions.put(nodes.wall, jnp.where(stuck, wall, 0)),
        tool=None if nodes.tool is None or tool is None else insertions.put(nodes.tool, tool),
        temperature=None
        if nodes.temperature is None
        else insertions.put(nodes.temperature, _mean_of_ends(nodes.temperature, insertions)),
        slip=None if nodes.slip is None else insertions.put(nodes.slip, _mean_of_ends(nodes.slip, insertions)),
        fields={name: insert_field(name, values) for name, values in nodes.fields.items()},
    )


def _mean_of_ends(values: jax.Array, insertions: _Insertions) -> jax.Array:
    """The mean (n,) of values (n_node,) at the ends of the edges that the new nodes divide."""
    return 0.5 * (values[insertions.ends[0]] + values[insertions.ends[1]])


def _weight(volumes: jax.Array, owner: jax.Array, end: jax.Array, forest: BisectionHierarchy) -> jax.Array:
    """Share (n,) of an edge's first end in the velocity of its middle: of the mass that both lose."""
    lost = jnp.zeros((2, owner.size), volumes.dtype)
    for triangle, there in ((owner, True), (forest.partner[owner], forest.partner[owner] != owner)):
        children = 2 * triangle + forest.root_count
        # The first child keeps the edge's begin, the second its end; each end loses the other's part.
        parts = volumes[jnp.minimum(children + 1, volumes.size - 1)], volumes[jnp.minimum(children, volumes.size - 1)]
        turned = forest.sheet.triangles[1, triangle] != end
        lost += jnp.where(there, jnp.stack([jnp.where(turned, parts[1], parts[0]), jnp.where(turned, *parts)]), 0.0)
    return lost[0] / (lost[0] + lost[1])


def _place_on_surface(
    nodes: Nodes,
    insertions: _Insertions,
    surface: ContactSurface,
    number: int,
    adaptivity: Adaptivity,
    older: Callable[[jax.Array], jax.Array],
    time: jax.Array,
) -> Nodes:
    """The nodes with the block's new ones put on a surface where they touch or penetrate it; near it, at rest.

    Args:
        nodes: The nodes, in the frame of the surface.
        insertions: The block of new ones.
        surface: The surface, of this number in the scene.
        number: The number.
        adaptivity: The adaptive refinement.
        older: Function that returns the places (n,) of nodes from before of which those at places (n,) descend.
        time: The present time [s].
    """
    (mold, grid, _), (limits, forest) = surface, adaptivity
    touching = jnp.where(on_surface(nodes.tool, number), nodes.wall, 0)
    points, stuck = insertions.block_of(nodes.positions), insertions.block_of(nodes.stuck)
    free, places = insertions.new & ~stuck, jax.lax.stop_gradient(points)
    if nodes.tool is not None or not mold.contact.sticks:
        free &= insertions.block_of(nodes.wall) == 0
    closest, distance = save_decision(nearest_triangle(places, free, grid))
    begin, (crossed, last, side) = save_decision(
        _paths_from_sheet(places, free, nodes, touching, [older(end) for end in insertions.ends], surface)
    )
    touches = free & (distance <= search.touch_distance(grid))
    beyond = free & ~touches & (crossed % 2 == 1)
    ends = [nodes.stuck[at] | (touching[at] != 0) for at in insertions.ends]
    held = insertions.join_ends(ends, lambda first, second: stuck | beyond | touches & first & second, forest.depth)
    lands = insertions.new & held & ~stuck
    # The nearest triangle, and the one that the way from the sheet crosses last, in one go.
    both, known = jnp.append(closest, last), jnp.append(free & (closest >= 0), free & (last >= 0))
    nearest, front = jnp.split(closest_place(jnp.tile(points, 2), mold, jnp.maximum(both, 0), known), 2, axis=1)
    turned = beyond & _is_behind(nearest - places, closest, last, side, mold)
    chosen = jnp.where(turned, jnp.maximum(last, 0), closest)
    triangle, flies = jnp.maximum(chosen, 0), free & ~lands & (chosen >= 0)
    point = jnp.where(turned, front, nearest)
    velocities = insertions.block_of(nodes.velocities)
    if mold.contact.sticks:
        velocities = jnp.where(lands, 0.0, velocities)
    else:
        mobile = vector(jnp.ones_like(distance) for _ in range(3))
        slip = project_on_plane(unstack_rows(velocities), unstack_rows(_normal(mold, triangle)), mobile)
        velocities = jnp.where(lands, jnp.stack(slip), velocities)
    if limits.at_rest:
        edge = nodes.positions[:, insertions.ends[0]] - nodes.positions[:, insertions.ends[1]]
        length = jnp.sqrt(jnp.where(insertions.new, dot(edge, edge), 1.0))
        gap, size = jnp.where(flies, points - point, 1.0), jnp.minimum(length, grid.reach)
        velocities = jnp.where(flies, _velocity_share(gap, size), 1.0)[None] * velocities
    # It is on the side of the place where its path begins; the path to one beyond may begin at another triangle.
    above = jnp.where(beyond, -_height(places, mold, triangle), _height(begin, mold, triangle))
    side = jnp.where(above < 0.0, -1, 1)

    def put_landed(values: jax.Array, landed: jax.Array | int) -> jax.Array:
        return insertions.put(values, jnp.where(lands, landed, insertions.block_of(values)))

    return dataclasses.replace(
        nodes,
        positions=insertions.put(nodes.positions, jnp.where(lands, point, points)),
        velocities=insertions.put(nodes.velocities, velocities),
        stuck=insertions.put(nodes.stuck, stuck | lands if mold.contact.sticks else stuck),
        contact_time=put_landed(nodes.contact_time, time),
        wall=put_landed(nodes.wall, side * (triangle + 1)),
        tool=None if nodes.tool is None else put_landed(nodes.tool, number),
    )


def _paths_from_sheet(
    points: jax.Array,
    free: jax.Array,
    nodes: Nodes,
    wall: jax.Array,
    older: list[jax.Array],
    surface: ContactSurface,
) -> tuple[jax.Array, Crossings]:
    """Paths to new nodes at points (3, n) [m] from an older node, which is on the sheet's side of the mold.

    A path begins at a free one of two older nodes, at places (n,), if there is one, else at one with a known contact
    triangle, a little before that.

    Returns:
        Where the paths begin (3, n) [m], and their crossings with the mold.
    """
    mold, grid, _ = surface
    first, second = older
    stuck = nodes.stuck
    worse = stuck[first] & (~stuck[second] | (wall[first] == 0) & (wall[second] != 0))
    place = jnp.where(worse, second, first)
    there, triangle = wall[place], jnp.maximum(jnp.abs(wall[place]) - 1, 0)
    off = _BEFORE * search.touch_distance(grid) * jnp.sign(there)
    begin = jax.lax.stop_gradient(nodes.positions[:, place] + off[None] * _normal(mold, triangle))
    way = begin - points
    _, bound = search.cell_bounds(points, grid)
    return begin, ray_crossings(begin, points, free & (jnp.square(bound) <= dot(way, way)), grid)


def _is_behind(gap: jax.Array, nearest: jax.Array, last: jax.Array, side: jax.Array, mold: Mold) -> jax.Array:
    """True for points (n,) beyond the mold whose nearest triangle, at a gap (3, n) [m], is the back of a thin part.

    Also where no nearest triangle is known. The front is the triangle that the path from the sheet crosses last, from
    the side `side`, as in `Crossings`.
    """
    gap = jax.lax.stop_gradient(gap)
    front = jax.lax.stop_gradient(_normal(mold, jnp.maximum(last, 0)))
    return (nearest < 0) | (side * dot(gap, front) < -_BACKWARD * jnp.sqrt(dot(gap, gap)))


def _normal(mold: Mold, triangle: jax.Array) -> jax.Array:
    """Unit normals (3, n) of the mold's triangles (n,)."""
    d, e, f = (mold.vertices[mold.triangles[triangle, k]].T for k in range(3))
    normal = jnp.stack(cross(e - d, f - d))
    return normal / jnp.sqrt(dot(normal, normal))[None]


def _height(points: jax.Array, mold: Mold, triangle: jax.Array) -> jax.Array:
    """Height (n,) [m] of points (3, n) over the planes of triangles (n,)."""
    return jax.lax.stop_gradient(dot(points - mold.vertices[mold.triangles[triangle, 0]].T, _normal(mold, triangle)))


def _velocity_share(gap: jax.Array, size: jax.Array) -> jax.Array:
    """Share (n,) of its velocity that a new node keeps with a gap (3, n) to the mold, beside sizes (n,) [m].

    Otherwise a replay would jump where a node comes into contact just before a window boundary or just after.
    """
    # Bounded before the root is taken, which has no slope at 0.
    distance = jnp.sqrt(jnp.maximum(dot(gap, gap), jnp.square(_CALM * size)))
    share = jnp.clip((distance / size - _CALM) / (1.0 - _CALM), 0.0, 1.0)
    return share * share * (3.0 - 2.0 * share)

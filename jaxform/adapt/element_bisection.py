"""Bisection of the forest's triangles in the compiled program: closure, updated lists, inherited quantities.

Triangles are processed one by one, in loops that end with the last: few of many are bisected at a window boundary. XLA
compiles such loops without scatters into one function each, so that a triangle takes well under a microsecond; all
lists change in place, and nothing is as long as the forest. There is nothing to differentiate here.
"""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp

from jaxform.core.pytree import pytree
from jaxform.kernels.blocks import materialize
from jaxform.mesh import bisection
from jaxform.model.scene import Adaptivity, Scene
from jaxform.model.tables import BisectionHierarchy
from jaxform.sheet.discretization import NEVER, RefinedMesh, first_mesh, half_edge_elements


@pytree
class Queue:
    """Triangles to be bisected.

    Attributes:
        triangle: Their numbers (capacity,), ascending, so that parents precede their parts; then the largest number.
        count: Their number; it exceeds the capacity where some are missing.
        node_count: Number of nodes that they add.
    """

    triangle: jax.Array
    count: jax.Array
    node_count: jax.Array


def empty_queue(capacity: int) -> Queue:
    """A queue without triangles."""
    return Queue(jnp.full(capacity, NEVER, jnp.int32), jnp.int32(0), jnp.int32(0))


def make_queue(found: jax.Array, count: jax.Array, forest: BisectionHierarchy | bisection.TriangleForest) -> Queue:
    """A queue of triangles (capacity,) of which the first `count` are used, in any order; closed already."""
    there = jnp.arange(found.size) < count
    triangle = jnp.sort(jnp.where(there, found, NEVER))
    triangle_found = jnp.where(there, found, 0)
    # Two triangles share the new node in the middle of the edge between them.
    return Queue(
        triangle,
        count,
        jnp.sum(there & (triangle_found <= jnp.asarray(forest.partner)[triangle_found]), dtype=jnp.int32),
    )


_Growing = tuple[jax.Array, jax.Array, jax.Array]
"""Windows of bisection, the queue with a spare entry, and its count, while it is closed."""


def close_queue(
    split_at: jax.Array,
    wanted: jax.Array,
    count: jax.Array,
    forest: BisectionHierarchy | bisection.TriangleForest,
    window: jax.Array,
) -> tuple[jax.Array, Queue]:
    """Windows of the triangles' bisection (n_triangle,), closed so that no node hangs; and the queue of the new ones.

    With a triangle its partner and its parent are bisected. This is the least such set, so that it does not depend on
    the order of the wanted triangles.

    Args:
        split_at: The window at whose boundary each triangle was bisected; NEVER where it was not.
        wanted: Numbers of triangles (capacity,); unused entries are n_triangle or more.
        count: Number of these that are processed.
        forest: The forest.
        window: The present one.
    """
    capacity, last = wanted.size, split_at.size - 1
    partner = jnp.asarray(forest.partner)

    def push(growing: _Growing, triangle: jax.Array, meant: jax.Array | bool) -> _Growing:
        split_at, queue, count = growing
        number = jnp.clip(triangle, 0, last)
        before = _read_entry(split_at, number)
        new = meant & (before == NEVER)
        split_at = _write_entry(split_at, jnp.where(new, window, before), number)
        # The last entry is for triangles that are not added.
        queue = _write_entry(queue, number, jnp.where(new, jnp.minimum(count, capacity), capacity))
        return split_at, queue, count + new.astype(jnp.int32)

    def ask(i: jax.Array, carry: _Growing) -> _Growing:
        triangle = _read_entry(wanted, i)
        return push(carry, triangle, triangle <= last)

    def follow(carry: tuple[jax.Array, _Growing]) -> tuple[jax.Array, _Growing]:
        i, growing = carry
        triangle = _read_entry(growing[1], jnp.minimum(i, capacity))
        growing = push(growing, _read_entry(partner, triangle), True)
        return i + 1, push(growing, (triangle - forest.root_count) // 2, triangle >= forest.root_count)

    start = split_at, jnp.zeros(capacity + 1, jnp.int32), jnp.int32(0)
    growing = jax.lax.fori_loop(0, count, ask, start)
    _, (split_at, queue, found) = jax.lax.while_loop(
        lambda carry: carry[0] < carry[1][2], follow, (jnp.int32(0), growing)
    )
    return split_at, make_queue(queue[:capacity], found, forest)


def bisect_mesh(mesh: RefinedMesh, queue: Queue, forest: BisectionHierarchy) -> RefinedMesh:
    """The mesh with the queue's triangles bisected, within the capacity; `split_at` is left to the caller."""

    def bisect(i: jax.Array, mesh: RefinedMesh) -> RefinedMesh:
        triangle = _read_entry(queue.triangle, i)
        mesh, middle = _add_middle_node(mesh, _read_entry(forest.middle, triangle))
        mesh, element = _split_element(mesh, triangle, forest)
        places = [_read_entry(mesh.place, _read_entry(forest.sheet.triangles, k, triangle)) for k in range(3)]
        return _add_corners(mesh, places, middle, element)

    return jax.lax.fori_loop(0, queue.count, bisect, mesh)


def add_sides(mesh: RefinedMesh, forest: BisectionHierarchy) -> RefinedMesh:
    """The mesh with `side`, from the elements that there are."""
    return dataclasses.replace(mesh, side=half_edge_elements(mesh.element, mesh.element_count, forest))


def initial_mesh(scene: Scene, adaptivity: Adaptivity) -> RefinedMesh:
    """The mesh at the start of a run: that of the scene, refined at once where its tables say so."""
    mesh, (_, forest) = first_mesh(scene, adaptivity), adaptivity
    if forest.fine_at_once is None:
        return mesh
    found = forest.fine_at_once
    queue = make_queue(found, jnp.sum(found < NEVER, dtype=jnp.int32), forest)
    split_at = mesh.split_at.at[found].set(0, mode="drop")
    return dataclasses.replace(bisect_mesh(mesh, queue, forest), split_at=split_at)


# One entry is read and written as a slice, which XLA does in place; `.at` would make it a scatter. What is read before
# a list is written to goes through a barrier together, or XLA would copy the list.


def _read_entry(values: jax.Array, *index: jax.Array | int) -> jax.Array:
    place = [jnp.asarray(i, jnp.int32) for i in index]
    return materialize(jax.lax.dynamic_slice(values, place, (1,) * values.ndim)).reshape(())


def _write_entry(values: jax.Array, new: jax.Array | int, *index: jax.Array | int) -> jax.Array:
    one = jnp.asarray(new, values.dtype).reshape((1,) * values.ndim)
    return jax.lax.dynamic_update_slice(values, one, [jnp.asarray(i, jnp.int32) for i in index])


def _add_middle_node(mesh: RefinedMesh, node: jax.Array) -> tuple[RefinedMesh, jax.Array]:
    """The mesh with the middle node of an edge, which may exist already, and the place of that node."""
    before = _read_entry(mesh.place, node)
    place = jnp.where(before == 0, mesh.node_count, before)
    return dataclasses.replace(
        mesh,
        place=_write_entry(mesh.place, place, node),
        node=_write_entry(mesh.node, node, place),
        node_count=mesh.node_count + (before == 0).astype(jnp.int32),
    ), place


def _split_element(mesh: RefinedMesh, triangle: jax.Array, forest: BisectionHierarchy) -> tuple[RefinedMesh, jax.Array]:
    """The mesh with two triangles for one, and which element that was; the second part comes last in the list."""
    half_edges, first = forest.half_edges, 2 * triangle + forest.root_count
    last, cut = mesh.element_count, _read_entry(half_edges, 1, triangle)
    element, cut = materialize((_read_entry(mesh.sides, _read_entry(half_edges, 0, triangle)), cut))
    side = _write_entry(mesh.sides, -1, cut)
    for part, number in ((first, element), (first + 1, last)):
        for k in range(3):
            side = _write_entry(side, number, _read_entry(half_edges, k, part))
    elements = _write_entry(_write_entry(mesh.element, first, element), first + 1, last)
    return dataclasses.replace(mesh, element=elements, element_count=last + 1, side=side), element


def _add_corners(mesh: RefinedMesh, places: list[jax.Array], middle: jax.Array, element: jax.Array) -> RefinedMesh:
    """The mesh with the corners of both parts, (middle, peak, a) and (middle, b, peak), at their nodes."""
    peak, a, b = places
    last, corner, row = mesh.element_count - 1, mesh.corner, mesh.row
    rows, counts = (
        [_read_entry(row, k, element) for k in range(3)],
        [_read_entry(mesh.corner_count, node) for node in (middle, peak)],
    )
    (peak_row, a_row, b_row), (middle_row, second_row) = materialize((rows, counts))
    count = _write_entry(_write_entry(mesh.corner_count, middle_row + 2, middle), second_row + 1, peak)
    for number, corners in (
        (element, ((middle, middle_row), (peak, peak_row), (a, a_row))),
        (last, ((middle, middle_row + 1), (b, b_row), (peak, second_row))),
    ):
        for k, (node, slot) in enumerate(corners):
            corner = _write_entry(corner, 4 * number + k, slot, node)
            row = _write_entry(row, slot, k, number)
    return dataclasses.replace(mesh, corner=corner, corner_count=count, row=row)


# Inheritance of stress and other element quantities by the parts of a bisected element, and its basis.


def find_ancestry(
    before: RefinedMesh, after: RefinedMesh, forest: BisectionHierarchy
) -> tuple[jax.Array, list[jax.Array]]:
    """The ancestors of a mesh's elements in the mesh `before`.

    Returns:
        The element of the earlier mesh that each lies in (n_element,); and from that down to the element, in reverse,
        which part each bisection made it (n_element,), 0 or 1, -1 where there was none.
    """
    old = jnp.arange(before.element.size) < before.element_count
    slot = jnp.full(forest.bound.size, -1, jnp.int32)
    slot = slot.at[jnp.where(old, before.element, forest.bound.size)].set(
        jnp.arange(before.element.size, dtype=jnp.int32), mode="drop"
    )
    parts, triangle = [], after.element
    for _ in range(forest.depth):
        found = slot[triangle] >= 0
        parts.append(jnp.where(found, -1, (triangle - forest.root_count) % 2))
        triangle = jnp.where(found, triangle, jnp.maximum((triangle - forest.root_count) // 2, 0))
    return jnp.maximum(slot[triangle], 0), parts


def inherit_stress(memory: jax.Array, element: jax.Array, parts: list[jax.Array]) -> jax.Array:
    """The stress of modes (4 n_mode, n_element) of a mesh's elements, from that of their ancestors; differentiable.

    A triangle (peak, a, b) has the parts (middle, peak, a) and (middle, b, peak): their edges are halves of the sum and
    the difference of its own, and so a stress has in their basis sums and differences of its components.

    Args:
        memory: Stress of the ancestors' mesh.
        element: The ancestors, from `find_ancestry`.
        parts: The parts taken from each ancestor down to the element, from `find_ancestry`.
    """
    rows = memory.reshape(-1, 4, memory.shape[1])
    a, mixed, b, across = jnp.moveaxis(rows[:, :, element], 1, 0)
    for part in reversed(parts):
        sum_, difference = a + 2.0 * mixed + b, a - 2.0 * mixed + b
        one, two = part == 0, part == 1
        a, mixed, b = (
            jnp.where(one, sum_, jnp.where(two, difference, a)),
            jnp.where(one, b - a, jnp.where(two, a - b, mixed)),
            jnp.where(one, difference, jnp.where(two, sum_, b)),
        )
    return jnp.stack([a, mixed, b, across], axis=1).reshape(memory.shape[0], -1)

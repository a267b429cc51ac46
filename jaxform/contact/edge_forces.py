"""Forces that hold sides of the sheet at sharp edges of tools: a linear system in every step.

After a step the ends of the held sides (`contact.edge_contact`) are moved so that all of them pass through their points
at once, with the least kinetic energy. The impulses at the points follow from a symmetric system: two points affect
each other where their sides share a node, as neighbours along an edge do. So the momentum is kept, and the order of
the sides does not matter.

Conjugate gradients solve it, from the forces of the last step on. Along an edge with many sides the system is badly
conditioned, for more may be held there than nodes can follow. So they are preconditioned by the inverse of the system
at the window's begin, the same one for all components: a side that is held since then, and an end that came into
contact, cost about two passes more each.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from jaxform.contact.edge_contact import OVERHANG, SOFTNESS, HeldSides
from jaxform.kernels.blocks import entry, lax_cond_once, materialize, on_cpu, put, slice_at
from jaxform.mechanics.membrane import gather, gather_columns, vector

_MOST_PASSES, _ACCURACY = 1000, 1e-9  # of the solver: passes, and what is left of the gaps
_ROUNDINGS = 64  # that the gaps are accurate to, in float32
_FADE = 100.0  # steps, as long as that in which a side was first held: its force falls to 1/e of it once it is let go
_MOST_INVERTED = 1024  # sides in the inverse; those beyond have the diagonal
_INVERTED = (32, 64, 96, 128, 192, 256, 384, 512, 768)  # sides for which there is an inverse of that size
_SHIFT = 1000  # roundings, by which the diagonal is enlarged: the rounded inverse is positive
_TOGETHER = 4  # rows of the inverse that are added at once


Inverse = tuple[jax.Array, jax.Array]
"""Inverse (n, n) of a system that is scaled to ones on its diagonal, and the scale (room,) [kg^0.5], 0 for sides that
are not in it: there it is the identity."""


def invert_system(held: HeldSides, compliance: jax.Array, immovable: jax.Array, length: jax.Array) -> Inverse | None:
    """The inverse of the system of sides that are held when a window begins; None if there is no capacity for four.

    Args:
        held: The held sides.
        compliance: Compliance of the nodes (3, n_node) [1/kg].
        immovable: Nodes (n_node,) that constraints do not move.
        length: The step length [s].
    """
    size = min(held.share.size, _MOST_INVERTED) // _TOGETHER * _TOGETHER
    if not size:
        return None
    largest = jnp.max(compliance, axis=0, keepdims=True)
    free, _, moves = _mobilities(held, held.step < 0, largest, immovable)
    there, ways = free[0], [move[0] for move in moves]
    weights = 1.0 - held.share, held.share
    diagonal = sum(w * way for w, way in zip(weights, ways, strict=True)) * (1.0 + held.softness / (length * length))
    root = jnp.where(there, 1.0 / jnp.sqrt(jnp.where(there, diagonal, 1.0)), 0.0)
    shift = _SHIFT * float(jnp.finfo(root.dtype).eps)

    def invert(most: int) -> jax.Array:
        system = jnp.zeros((most, most), root.dtype)
        for end, way in zip(held.ends, ways, strict=True):
            for other, weight in zip(held.ends, weights, strict=True):
                same = end[:most, None] == other[:most]
                system = system + jnp.where(same, (root * way)[:most, None] * (root * weight)[:most], 0.0)
        inside = _invert(jnp.where(jnp.eye(most, dtype=bool), 1.0 + shift, system), jnp.minimum(held.count, most))
        return jnp.eye(size, dtype=root.dtype).at[:most, :most].set(inside)

    sizes = [*(most for most in _INVERTED if most < size), size]
    branches = [lambda: jnp.eye(size, dtype=root.dtype), *(functools.partial(invert, most) for most in sizes)]
    return jax.lax.switch(jnp.searchsorted(jnp.array([0, *sizes[:-1]]), held.count), branches), root


def _invert(matrix: jax.Array, count: jax.Array) -> jax.Array:
    """The inverse of a positive matrix (n, n), which is the identity beyond its first rows, `count` of them.

    On the CPU by elimination in place: a library's threads, which wait busily for more, would take the cores of other
    runs.
    """
    if not on_cpu():
        return jnp.linalg.inv(matrix)
    size = len(matrix)
    index = jnp.arange(size)

    def eliminate(k: jax.Array, flat: jax.Array) -> jax.Array:
        row = slice_at(flat, k * size, size)
        row = materialize(jnp.where(index == k, 1.0, row) / entry(row, k))

        def subtract(i: jax.Array, flat: jax.Array) -> jax.Array:
            own = slice_at(flat, i * size, size)
            own, factor = materialize((own, entry(own, k)))
            new = jnp.where(index == k, 0.0, own) - factor * row
            return put(flat, jnp.where(i == k, row, new), i * size)

        # All rows, not just those that there are: where their number differs between scenes that are computed at once,
        # JAX would copy the matrix for each row.
        return jax.lax.fori_loop(0, size, subtract, flat)

    return jax.lax.fori_loop(0, count, eliminate, matrix.ravel()).reshape(size, size)


def values_at_ends(nodal: Any, held: HeldSides) -> list[jax.Array]:
    """Velocities (3, room) [m/s] of either end of the held sides, from those of the nodes; or positions."""
    return [jnp.stack(gather_columns(nodal, end)) for end in held.ends]


def _values_at_points(nodal: Any, held: HeldSides) -> jax.Array:
    """Positions (3, room) [m] of the points at which sides are held, from those of the nodes."""
    one, other = values_at_ends(nodal, held)
    return (1.0 - held.share) * one + held.share * other


class HeldNodes(NamedTuple):
    """Nodes after a step in which sides were held: positions and velocities; the loss, and work at each side [J].

    Also what the holding forces (3, room) [N] take of the damping loss, per damping and velocity step [J], which was
    counted for velocities without them.
    """

    positions: Any
    velocities: jax.Array
    loss: jax.Array
    work: jax.Array
    damped: jax.Array
    force: jax.Array


def hold_sides(
    positions: Any,
    velocities: jax.Array,
    before: list[jax.Array],
    held: HeldSides,
    compliance: jax.Array,
    immovable: jax.Array,
    steps: tuple[jax.Array, jax.Array],
    carrier: tuple[jax.Array, jax.Array],
    number: jax.Array,
    inverse: Inverse | None = None,
    *,
    differentiable: bool,
) -> HeldNodes:
    """Moves the ends of held sides so that these pass through the points where they are held.

    An end in contact passes its part of a push on to the tool: loss and work are those of the ends that move freely.

    Args:
        positions: After the step as if nothing were held, three times (n_node,) [m].
        velocities: In the step, (3, n_node) [m/s].
        before: `values_at_ends` of the velocities before the step.
        held: The held sides.
        compliance: Compliance of the nodes (3, n_node) [1/kg].
        immovable: Nodes (n_node,) that constraints do not move.
        steps: Time [s] over which a force accelerates nodes in the step, less with damping, and the step length [s];
            nothing is moved where that is 0.
        carrier: Displacement at the step's end [m] and velocity (3, room) [m/s] of the tool of each side.
        number: Number of the step.
        inverse: As of `invert_system`; None for the diagonal only.
        differentiable: True if JAX can differentiate it.
    """
    weights, scatter = (1.0 - held.share, held.share), differentiable or not on_cpu()
    accelerated, length = steps
    active = (held.step < number) & (length > 0.0)
    free, released, moves = _mobilities(held, active, compliance, immovable)
    mobility = sum(w * move for w, move in zip(weights, moves, strict=True))

    # A force gives a push by both steps. A side gives as much way to it whatever they are: a spring that hardened with
    # shorter steps would throw nodes, and give energy.
    per_force = jnp.where(length > 0.0, accelerated * length, 1.0)
    give = held.softness / per_force * mobility

    def displace(push: jax.Array) -> jax.Array:
        """Displacements (3, room) of the held points by such pushes at all of them."""
        nodes = _add_at_ends(jnp.zeros_like(compliance), [move * push for move in moves], held, scatter)
        return jnp.where(free, _values_at_points(nodes, held) + give * push, push)

    let_go = jnp.where(released, per_force * _fade(held, length), 0.0)
    falls = functools.partial(_add_at_ends, changes=[move * let_go for move in moves], held=held, scatter=scatter)
    ahead = lax_cond_once(jnp.any(released), falls, positions, differentiable=differentiable)
    gap = jnp.where(free, held.point + carrier[0] - _values_at_points(ahead, held), 0.0)
    scaling = jax.lax.stop_gradient(jnp.where(free, 1.0 / jnp.where(free, mobility, 1.0), 1.0))
    precondition = functools.partial(_precondition, free=free, scaling=scaling, inverse=inverse, held=held)
    solve = functools.partial(_conjugate_gradients, scaling=scaling, precondition=precondition)
    if differentiable:
        push = jax.lax.custom_linear_solve(displace, gap, solve, symmetric=True)
    else:
        # The forces of the last step are nearly those of this one.
        push = solve(displace, gap, start=jnp.where(free, per_force * held.force, gap))
    push = push + let_go
    impulse, speed = push / jnp.where(length > 0.0, length, 1.0), carrier[1]
    new = _add_at_ends(velocities, [move * impulse for move in moves], held, scatter)
    parts = [jnp.where(move > 0.0, weight, 0.0) for weight, move in zip(weights, moves, strict=True)]
    earlier, flown, later = (
        sum(part * end for part, end in zip(parts, ends, strict=True))
        for ends in (before, values_at_ends(velocities, held), values_at_ends(new, held))
    )
    carried = sum(parts) * speed
    return HeldNodes(
        positions=_add_at_ends(positions, [move * push for move in moves], held, scatter),
        velocities=new,
        loss=-jnp.sum(impulse * (0.5 * (earlier + later) - carried)),
        work=jnp.sum(impulse * carried, axis=0),
        damped=0.25 * jnp.sum(impulse * (earlier + flown)),
        force=jnp.where(length > 0.0, push / per_force, held.force),
    )


def _mobilities(
    held: HeldSides, active: jax.Array, compliance: jax.Array, immovable: jax.Array
) -> tuple[jax.Array, jax.Array, list[jax.Array]]:
    """The components of held points that are held, and that are let go (3, room), and the ends' mobilities.

    The mobilities are how far either end goes by a push there [1/kg]. A side with one end in contact is no longer held
    where most of it hangs over the edge.
    """
    weights = 1.0 - held.share, held.share
    own = [jnp.where(gather(immovable, end), 0.0, jnp.stack(gather_columns(compliance, end))) for end in held.ends]
    mobile = [jnp.any(c > 0.0, axis=0) for c in own]
    hangs = jnp.where(mobile[0], jnp.where(mobile[1], 0.0, weights[1]), weights[0])
    moves = [w * c for w, c in zip(weights, own, strict=True)]
    mobile_points = active & (weights[0] * moves[0] + weights[1] * moves[1] > 0.0)
    free, released = mobile_points & (hangs <= OVERHANG), mobile_points & (hangs > OVERHANG)
    return free, released, [jnp.where(mobile_points, move, 0.0) for move in moves]


def _fade(held: HeldSides, length: jax.Array) -> jax.Array:
    """The holding forces (3, room) [N] of sides that are let go, in a step of a length [s], from those before it."""
    soft = held.softness > 0.0
    rate = jnp.where(soft, jnp.sqrt(SOFTNESS / jnp.where(soft, held.softness, 1.0)) / _FADE, jnp.inf)
    return jnp.exp(-jnp.where(length > 0.0, length, 1.0) * rate) * held.force


def _precondition(
    residual: jax.Array, free: jax.Array, scaling: jax.Array, inverse: Inverse | None, held: HeldSides
) -> jax.Array:
    """Pushes (3, room) that displace held points by about the residual gaps (3, room) [m].

    Args:
        residual: The gaps; 0 where a point is not moved.
        free: Components of the held points that are moved (3, room).
        scaling: The inverse of the system's diagonal (3, room) [kg].
        inverse: As of `invert_system`.
        held: The held sides.
    """
    if inverse is None:
        return scaling * residual
    matrix, root = inverse
    size, root = len(matrix), jnp.where(root > 0.0, root, jnp.sqrt(scaling))
    scaled = root * residual
    first, flat = scaled[:, :size], matrix.ravel()

    def add(k: jax.Array, found: list[jax.Array]) -> list[jax.Array]:
        begin = k * _TOGETHER
        rows = [slice_at(flat, (begin + j) * size, size) for j in range(_TOGETHER)]
        gaps = [slice_at(first, begin, _TOGETHER)[c] for c in range(3)]
        return [row + sum(gap[j] * rows[j] for j in range(_TOGETHER)) for row, gap in zip(found, gaps, strict=True)]

    if on_cpu():
        # No product of matrices, which would be a call (docs/explanation/kernels.md).
        count = (jnp.minimum(held.count, size) + _TOGETHER - 1) // _TOGETHER
        first = jnp.stack(jax.lax.fori_loop(0, count, add, list(jnp.zeros_like(first))))
    else:
        first = first @ matrix
    return jnp.where(free, root * jnp.concatenate([first, scaled[:, size:]], axis=1), residual)


class _Pushes(NamedTuple):
    """Pushes (3, room) so far, residual gaps, the next direction, the residual's squares in both preconditioners."""

    count: jax.Array
    push: jax.Array
    residual: jax.Array
    direction: jax.Array
    square: jax.Array
    left: jax.Array


def _conjugate_gradients(
    displace: Callable[[jax.Array], jax.Array],
    gap: jax.Array,
    scaling: jax.Array,
    precondition: Callable[[jax.Array], jax.Array],
    start: jax.Array | None = None,
) -> jax.Array:
    """The pushes (3, room) that displace held points by the gaps (3, room) [m].

    What is left of the gaps, weighted by the inverse of the diagonal (3, room), is the same share of them wherever the
    pushes start.
    """
    residual = gap if start is None else gap - displace(start)
    ahead = precondition(residual)
    push = jnp.zeros_like(gap) if start is None else start
    square, left = jnp.sum(residual * ahead), jnp.sum(residual * scaling * residual)
    first = _Pushes(jnp.int32(0), push, residual, ahead, square, left)
    least = max(_ACCURACY, _ROUNDINGS * float(jnp.finfo(gap.dtype).eps)) ** 2 * jnp.sum(gap * scaling * gap)

    def is_inaccurate(pushes: _Pushes) -> jax.Array:
        return (pushes.count < _MOST_PASSES) & (pushes.left > least)

    def improve(pushes: _Pushes) -> _Pushes:
        count, push, residual, direction, before, _ = pushes
        displaced = displace(direction)
        size = jnp.sum(direction * displaced)
        step = before / jnp.where(size > 0.0, size, jnp.inf)
        residual = residual - step * displaced
        ahead = precondition(residual)
        square, left = jnp.sum(residual * ahead), jnp.sum(residual * scaling * residual)
        return _Pushes(count + 1, push + step * direction, residual, ahead + square / before * direction, square, left)

    return jax.lax.while_loop(is_inaccurate, improve, first).push


def _add_at_ends(values: Any, changes: list[jax.Array], held: HeldSides, scatter: bool) -> Any:
    """Values (k, n_node), or k rows of them, with the changes (k, room) of either end of the held sides added."""
    first, second = held.ends
    if scatter and isinstance(values, tuple):
        return vector(_add_at_ends(jnp.stack(values), changes, held, scatter))
    if scatter:
        array: jax.Array = values
        return array.at[:, first].add(changes[0]).at[:, second].add(changes[1])

    def add(k: jax.Array, rows: list[jax.Array]) -> list[jax.Array]:
        # One by one, and all is read before anything is written (docs/explanation/kernels.md).
        for end, change in zip(held.ends, changes, strict=True):
            node = entry(end, k)
            new = materialize([entry(row, node) + entry(own, k) for row, own in zip(rows, change, strict=True)])
            rows = [put(row, value[None], node) for row, value in zip(rows, new, strict=True)]
        return rows

    rows: Any = jax.lax.fori_loop(0, jnp.minimum(held.count, held.share.size), add, list(values))
    return vector(rows) if isinstance(values, tuple) else jnp.stack(rows)

"""Contact of the sheet with itself at window boundaries: in a fold, two films that meet back to back stick.

A sheet that is pushed over a convex corner has more width there than it needs: it folds, the pressure presses both
flanks of the fold together, and hot films weld; thermoformers call it a web. Without self-contact the flanks pass
through each other, and the pressure blows up the part that is then inside out.

Nodes that are near a sharp fold are compared with all elements. One that is within a wall of the back of another film
sticks where it is, as a node on the mold does. This spreads along the fold from boundary to boundary.
"""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp

from jaxform.kernels.blocks import compact_indices
from jaxform.kernels.derivatives import save_decision
from jaxform.mechanics import membrane
from jaxform.mechanics.elements import Elements
from jaxform.mechanics.membrane import Vector, cross, dot, gather_columns, minus, vector
from jaxform.model.scene import Scene
from jaxform.sheet.active_set import ActiveSet, active_set_of
from jaxform.sheet.discretization import Discretization
from jaxform.sheet.state import PackedState, State, can_move

_SHARP = 0.7  # cosine: an element is at a fold where its normal is further from the mean one at a node
_RINGS = 16  # of elements around such ones, in which nodes may touch: flanks may meet first far from the ridge
_BACK = -0.7  # cosine: films are back to back where their normals are more opposed
_REACH = 4.0  # walls of the other film, from middle to middle: so near films touch, for elements are many walls wide
_INSIDE = 0.3  # of an element's side, by which a node may be beside it
_BATCH = 16  # nodes that are compared with all elements at once


def stick_folds(state: PackedState, scene: Scene, active: ActiveSet) -> PackedState:
    """The state at a window boundary, in which nodes stick that touch another film in a fold; differentiable.

    Without `solver.self_contact` no node sticks, nor while a tool moves: a node between films and tool could not follow
    both.
    """
    if not scene.solver.self_contact:
        return state
    nodes, elements = jax.lax.stop_gradient((state.nodes, active.packed.elements))
    touch = _touching_nodes(nodes.positions, nodes.stuck, elements, jax.lax.stop_gradient(active.thickness))
    for frame in scene.frames(state.time, state.time + state.control.last_length):
        if frame is not None:
            touch &= jnp.all(frame.velocity == 0.0)
    touch, velocities = save_decision(touch), state.nodes.velocities
    kinetic = 0.5 * active.mass * dot(velocities, velocities)
    loss = state.account.contact_loss + jnp.sum(jnp.where(touch, kinetic, 0.0))
    return dataclasses.replace(
        state,
        nodes=dataclasses.replace(
            state.nodes,
            velocities=jnp.where(touch, 0.0, velocities),
            stuck=state.nodes.stuck | touch,
            contact_time=jnp.where(touch, state.time, state.nodes.contact_time),
        ),
        account=dataclasses.replace(state.account, contact_loss=loss),
    )


def stick_folds_of(state: State, scene: Scene, discrete: Discretization) -> State:
    """`stick_folds` of a state in the mesh's order."""
    if not scene.solver.self_contact:
        return state
    active = active_set_of(state, scene, discrete)
    return active.unpack_state(stick_folds(active.pack_state(state), scene, active))


def _touching_nodes(positions: jax.Array, stuck: jax.Array, elements: Elements, thickness: jax.Array) -> jax.Array:
    """Free nodes (place,) near a fold that touch the back of another film; `thickness` is the initial one [m]."""
    triangles, count = elements.triangles, stuck.size
    there = can_move(stuck, triangles, elements.area)
    first, *edges = membrane.edges(positions, triangles)
    turned = 1.0 if elements.orientation is None else elements.orientation
    area_vector = vector(jnp.where(there, turned * x, 0.0) for x in cross(*edges))
    size = jnp.sqrt(dot(area_vector, area_vector))
    normal = _scale(area_vector, size)
    mean = vector(membrane.sum_to_nodes(x, triangles, count) for x in area_vector)
    mean = _scale(mean, jnp.sqrt(dot(mean, mean)))
    straight = [dot(normal, gather_columns(mean, corner)) >= _SHARP for corner in triangles]
    near = _surround(there & ~(straight[0] & straight[1] & straight[2]), there, triangles, count)
    wall = 2.0 * thickness * elements.area / jnp.where(size > 0.0, size, 1.0)
    asked, total = compact_indices(near & ~stuck, count + _BATCH)

    def compare(carry: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        begin, touch = carry
        own = jax.lax.dynamic_slice(asked, (begin,), (_BATCH,))
        node, place = vector(x[:, None] for x in gather_columns(mean, own)), gather_columns(positions, own)
        back = there & (dot(node, normal) < _BACK) & (triangles[:, None, :] != own[:, None]).all(0)
        away = minus(vector(x[:, None] for x in place), first)
        found = back & (jnp.abs(dot(away, normal)) < _REACH * wall) & _is_beside(away, edges)
        real = begin + jnp.arange(_BATCH) < total
        return begin + _BATCH, touch.at[own].max(real & found.any(1))

    none = jnp.int32(0), jnp.zeros(count, bool)
    return jax.lax.while_loop(lambda carry: carry[0] < total, compare, none)[1]


def _scale(vectors: Vector, length: jax.Array) -> Vector:
    """Unit vectors; 0 where there is no length."""
    return vector(x / jnp.where(length > 0.0, length, 1.0) for x in vectors)


def _surround(elements: jax.Array, there: jax.Array, triangles: jax.Array, count: int) -> jax.Array:
    """Nodes (count,) of these elements (capacity,), and of those around them that are there."""
    for _ in range(_RINGS):
        nodes = jnp.zeros(count, bool).at[triangles].max(elements)
        elements = there & nodes[triangles].any(0)
    return jnp.zeros(count, bool).at[triangles].max(elements)


def _is_beside(away: Vector, edges: list[Vector]) -> jax.Array:
    """True where points (n, n_element), seen from an element's first node, are above or below it, or nearly so."""
    one, other = edges
    a, b, c = dot(one, one), dot(one, other), dot(other, other)
    along, across = dot(away, one), dot(away, other)
    scale = a * c - b * b
    scale = jnp.where(scale > 0.0, scale, 1.0)
    gamma, delta = (c * along - b * across) / scale, (a * across - b * along) / scale
    return (gamma > -_INSIDE) & (delta > -_INSIDE) & (gamma + delta < 1.0 + _INSIDE)

"""The way back over the steps in which nodes landed on the mold."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp

from jaxform.adjoint.backward import AdjointStep, BackwardNodes, ReverseWindow, force_cotangent
from jaxform.contact import sticking
from jaxform.kernels import blocks
from jaxform.kernels.blocks import compact_indices, materialize
from jaxform.mechanics.membrane import unstack_rows
from jaxform.mechanics.nodes import Nodes
from jaxform.tools.mold import Mold


def pull_back_landings(
    nodes: BackwardNodes,
    before: jax.Array,
    turn: AdjointStep,
    at: tuple[jax.Array, jax.Array],
    mold: Mold,
    now: ReverseWindow,
    loss: jax.Array,
) -> BackwardNodes:
    """Goes back over the landings of a step, for the nodes that landed: one by one, each to where it was `before`.

    `at` is what nodes stick to in the end (place,), as in `State`, and the window's begin [s].
    """
    wall, begin_time = at
    number, time = turn.number, begin_time + (turn.number + 1) * turn.length
    places, count = compact_indices(now.landing_step == number, now.landing_step.size)

    def one(k: jax.Array, nodes: BackwardNodes) -> BackwardNodes:
        place = blocks.entry(places, k)

        def read_node(values: jax.Array) -> jax.Array:
            return blocks.slice_at(values, place, 1)

        def write_node(values: jax.Array, new: jax.Array) -> jax.Array:
            return blocks.put(values, new, place)

        def land(after: jax.Array, velocity: jax.Array, mass: jax.Array, corners: jax.Array) -> Any:
            free, none = jnp.zeros(1, bool), jnp.zeros(1, jnp.int32)
            flying = sticking.Landing(
                Nodes(after, velocity, free, jnp.zeros_like(mass), none, None, {}), none, jnp.zeros_like(time)
            )
            triangle = Mold(corners, jnp.arange(3, dtype=jnp.int32)[None])
            there = sticking.place_on_mold(
                flying, sticking.ContactStep(turn.length, time, number), mass, triangle, none
            )
            return there.nodes.positions, there.nodes.contact_time, there.loss

        # All is read before anything is written (docs/explanation/kernels.md).
        old = materialize(jax.tree.map(read_node, nodes._replace(damping=None, vertices=None)))
        begin = read_node(before)
        triangle = mold.triangles[jnp.abs(read_node(wall)[0]) - 1]
        after = begin + turn.length * old.speeds
        _, pull = jax.vjp(land, after, old.speeds, read_node(now.mass), mold.vertices[triangle])
        position, velocity, mass, corners = pull((old.positions, old.contact_time, loss))
        velocity = velocity + turn.length * position
        force = force_cotangent(unstack_rows(velocity), unstack_rows(read_node(now.compliance)), turn.kick, now)
        return BackwardNodes(
            at=write_node(nodes.at, begin),
            speeds=nodes.speeds,
            positions=write_node(nodes.positions, position),
            velocities=write_node(nodes.velocities, velocity),
            force=write_node(nodes.force, jnp.stack(force)),
            mass=write_node(nodes.mass, old.mass + mass),
            compliance=nodes.compliance,
            contact_time=write_node(nodes.contact_time, jnp.zeros_like(old.contact_time)),
            damping=nodes.damping,
            vertices=None if nodes.vertices is None else nodes.vertices.at[triangle].add(corners),
        )

    return jax.lax.fori_loop(0, count, one, nodes)

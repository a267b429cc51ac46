"""The way back over what moving rims sweep, from one step to the one before."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from jaxform.adjoint.backward import AdjointStep, BackwardNodes, ReverseWindow, force_cotangent
from jaxform.kernels.blocks import materialize
from jaxform.mechanics.membrane import unstack_rows
from jaxform.sheet.rim import rim_ends, rim_swept_volume


def rim_end_positions(nodes: BackwardNodes, places: jax.Array) -> jax.Array:
    """Positions of the rim's ends (3, 2, n_edge) [m], read before the nodes are stepped back."""
    return materialize(rim_ends(nodes.at, places))


def pull_back_rim(
    nodes: BackwardNodes,
    before: jax.Array,
    after: jax.Array,
    turn: AdjointStep,
    places: jax.Array,
    now: ReverseWindow,
    cotangent: jax.Array,
) -> tuple[BackwardNodes, jax.Array, jax.Array]:
    """Adds what the rim swept in the earlier step has of the cotangents, for the step's end.

    Args:
        nodes: At the earlier step's begin; those that land in it, at its end.
        before: Of nodes that landed, before that step (3, place) [m].
        after: The rim's ends at the step's end (3, 2, n_edge) [m].
        turn: The steps.
        places: Of the rim's ends (2, n_edge).
        now: The window.
        cotangent: Of the volume swept.

    Returns:
        The nodes; the cotangents of the rim's ends at the step's begin (3, 2, n_edge), for `add_rim_cotangents` once
        all nodes are there; and the volume that the rim swept [m^3].
    """
    landed = now.landing_step[places]
    begin = jnp.where(landed == turn.number, rim_ends(before, places), rim_ends(nodes.at, places))
    origin = now.packed.elements.origin
    swept, pull = jax.vjp(lambda begin, after: rim_swept_volume(begin, after, origin), begin, after)
    early, late = pull(cotangent)
    speeds = turn.length * jnp.where(landed > turn.number, late, 0.0)
    compliance = rim_ends(now.compliance, places)
    force = jnp.stack(force_cotangent(unstack_rows(speeds), unstack_rows(compliance), turn.kick, now))
    nodes = add_rim_cotangents(nodes, late, places)
    velocities, power = nodes.velocities.at[:, places].add(speeds), nodes.force.at[:, places].add(force)
    return nodes._replace(velocities=velocities, force=power), early, swept


def add_rim_cotangents(nodes: BackwardNodes, cotangents: jax.Array, places: jax.Array) -> BackwardNodes:
    """Adds cotangents of the positions of the rim's ends (3, 2, n_edge)."""
    return nodes._replace(positions=nodes.positions.at[:, places].add(cotangents))

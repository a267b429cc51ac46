"""The way back over what moving rims sweep, from one step to the one before."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from jaxform.adjoint.backward import BackwardNodes, Turn, Window, force_cotangent
from jaxform.kernels.blocks import once
from jaxform.mechanics.membrane import rows_of
from jaxform.sheet.rim import rim_ends, swept_by_rim


def ends_of(nodes: BackwardNodes, places: jax.Array) -> jax.Array:
    """Where the rim's ends are (3, 2, n_edge) [m], read before the nodes go back."""
    return once(rim_ends(nodes.at, places))


def back_over_rim(
    nodes: BackwardNodes,
    before: jax.Array,
    after: jax.Array,
    turn: Turn,
    places: jax.Array,
    now: Window,
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
        The nodes; the cotangents of the rim's ends at the step's begin (3, 2, n_edge), for `at_rim` once all nodes are
        there; and the volume that the rim swept [m^3].
    """
    landed = now.landed[places]
    begin = jnp.where(landed == turn.number, rim_ends(before, places), rim_ends(nodes.at, places))
    origin = now.packed.elements.origin
    swept, pull = jax.vjp(lambda begin, after: swept_by_rim(begin, after, origin), begin, after)
    early, late = pull(cotangent)
    speeds = turn.length * jnp.where(landed > turn.number, late, 0.0)
    compliance = rim_ends(now.compliance, places)
    force = jnp.stack(force_cotangent(rows_of(speeds), rows_of(compliance), turn.kick, now))
    nodes = at_rim(nodes, late, places)
    velocities, power = nodes.velocities.at[:, places].add(speeds), nodes.force.at[:, places].add(force)
    return nodes._replace(velocities=velocities, force=power), early, swept


def at_rim(nodes: BackwardNodes, cotangents: jax.Array, places: jax.Array) -> BackwardNodes:
    """With more of the cotangents of the positions of the rim's ends (3, 2, n_edge)."""
    return nodes._replace(positions=nodes.positions.at[:, places].add(cotangents))

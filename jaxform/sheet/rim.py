"""Volume swept by moving rims: the difference between pressure work and change of the enclosed volume.

The volume is that of cones between the elements and the origin. As a rim moves, the cones' sides between it and the
origin sweep a volume too, which the sheet does not push against: force times displacement is the pressure times what
the sheet itself sweeps.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp

from jaxform.mechanics import membrane
from jaxform.model.scene import Scene
from jaxform.sheet.discretization import NEVER, RefinedMesh
from jaxform.sheet.packing import Packed


def rim_places(scene: Scene, mesh: RefinedMesh | None, packed: Packed) -> jax.Array | None:
    """Places of the ends of the rim's edges (2, n_edge), of one node where there is no such edge now; None without."""
    rim = scene.tables.rim
    if rim is None:
        return None
    if mesh is None or rim.triangle is None or scene.adaptivity is None:
        return packed.place[rim.ends]
    roots, own = scene.adaptivity.forest.root_count, rim.triangle
    parent = jnp.maximum(own - roots, 0) // 2
    there = (mesh.split_at[own] == NEVER) & ((own < roots) | (mesh.split_at[parent] != NEVER))
    return packed.place[jnp.where(there, mesh.place[rim.ends], 0)]


def rim_ends(positions: Any, places: jax.Array) -> jax.Array:
    """Positions (3, 2, n_edge) [m] of the rim's edges, from (3, place) or its rows, at places (2, n_edge)."""
    return jnp.stack([membrane.gather(row, places) for row in positions])


def rim_swept_volume(before: jax.Array, after: jax.Array, origin: jax.Array) -> jax.Array:
    """Volume [m^3] that the cones' sides sweep as the rim goes from one place to another (3, 2, n_edge) [m] each.

    What the sheet sweeps is the change of the enclosed volume and this.
    """
    way = membrane.unstack_rows(jnp.sum(after - before, axis=1))
    sides = [
        membrane.cross(*(membrane.unstack_rows(ends[:, k] - origin[:, None]) for k in range(2)))
        for ends in (before, after)
    ]
    return jnp.sum(membrane.dot(membrane.plus(*sides), way)) / 12.0

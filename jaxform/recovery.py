"""Thickness at the nodes from that of the elements.

The mean over a node's elements is of second order in the element size where they lie evenly round it, since what flat
triangles miss alternates from one to the next. At a rim or on a symmetry plane they lie on one side, nothing cancels,
and the mean is of first order only: there the values inside are carried on to the boundary by their gradient.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp

from jaxform.membrane import edges, sum_to_nodes
from jaxform.scene import Sheet

_MOST = 2.0  # how far from the mean a value may be carried, as a factor: past a sharp bend the gradient means little


def nodal_ratio(ratio: jax.Array, sheet: Sheet, positions: jax.Array, free: jax.Array) -> jax.Array:
    """Elements' h/h0 at the nodes (n_node,): the mean by initial area, at held nodes carried there from inside.

    Args:
        ratio: h/h0 of the elements (n_element,).
        sheet: Initial geometry.
        positions: Initial positions (3, n_node) [m].
        free: Nodes (n_node,) that no clamp and no symmetry plane holds.
    """
    mean = _mean(ratio, sheet.area, sheet, free.size)
    foot, slope, known = _lines(mean, sheet, positions, free)

    def around(values: jax.Array) -> jax.Array:
        """Sum over the corners of the elements of each node, by initial area."""
        return sum_to_nodes(sheet.area * sum(values[corner] for corner in sheet.triangles), sheet.triangles, free.size)

    count = around(known.astype(mean.dtype))
    carried = around(foot) + sum(around(part) * x for part, x in zip(slope, positions, strict=True))
    carried = jnp.clip(carried / jnp.where(count > 0.0, count, 1.0), mean / _MOST, _MOST * mean)
    return jnp.where(free | (count == 0.0), mean, carried)


def _mean(values: jax.Array, weight: jax.Array, sheet: Sheet, count: int) -> jax.Array:
    """Weighted mean (n_node,) over the adjacent elements; 0 where there is no weight."""
    total = sum_to_nodes(weight, sheet.triangles, count)
    return sum_to_nodes(weight * values, sheet.triangles, count) / jnp.where(total > 0.0, total, 1.0)


def _lines(
    values: jax.Array, sheet: Sheet, positions: jax.Array, free: jax.Array
) -> tuple[jax.Array, list[jax.Array], jax.Array]:
    """At free nodes the linear function that fits best: at the origin (n_node,), its gradient, and where it is known.

    Gradients are those of elements whose three nodes are all free; held nodes' values are not good enough.
    """
    first, second, third = sheet.triangles
    _, edge1, edge2 = edges(positions, sheet.triangles)
    rise1, rise2 = values[second] - values[first], values[third] - values[first]
    g11, g12, g22 = sheet.inverse_metric
    along1, along2 = g11 * rise1 + g12 * rise2, g12 * rise1 + g22 * rise2
    inside = jnp.where(free[first] & free[second] & free[third], sheet.area, 0.0)
    known = free & (sum_to_nodes(inside, sheet.triangles, free.size) > 0.0)
    gradients = [along1 * a + along2 * b for a, b in zip(edge1, edge2, strict=True)]
    slope = [jnp.where(known, _mean(part, inside, sheet, free.size), 0.0) for part in gradients]
    foot = values - sum(part * x for part, x in zip(slope, positions, strict=True))
    return jnp.where(known, foot, 0.0), slope, known

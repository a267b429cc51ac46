"""Thickness at the nodes from that of the elements.

A node's elements say what the thickness is at their middles. Where these lie evenly round the node their mean is of
second order in the element size, since what flat triangles miss alternates from one to the next. Where a mesh changes
its fineness they do not, and the mean is of first order only; so the linear function that fits them best is taken,
which is the mean where they lie evenly. On a symmetry plane their images belong to them. At a rim all lie on one side,
nothing cancels, and the functions of the nodes inside are carried on to there; but no further from the mean than as the
elements at the rim differ, like a slope limiter: what lies flat on a flange is not as steep as the wall behind it.

(Zienkiewicz, Zhu: The superconvergent patch recovery, Int. J. Numer. Meth. Eng. 33 (1992) 1331-1364.)
"""

from __future__ import annotations

import jax
import jax.numpy as jnp

from jaxform.mechanics.membrane import Vector, dot, edges, sum_to_nodes
from jaxform.model.tables import Sheet

_MOST = 2.0  # how far from the mean a value may be carried, as a factor: past a sharp bend the gradient means little
_SPREADS = 6.0  # how far a value may be carried to a rim, in standard deviations there: a linear function needs 3
_RIDGE = 1e-3  # of the middles' square distance: a gradient across them, where they lie in a plane or on a line, is 0
_EVEN = 1e-6  # h/h0 that differ by less are alike; a root has no slope at 0


def nodal_ratio(ratio: jax.Array, sheet: Sheet, positions: jax.Array, mobile: jax.Array) -> jax.Array:
    """Elements' h/h0 at the nodes (n_node,): the best linear fit by initial area, carried from inside to clamped nodes.

    Args:
        ratio: h/h0 of the elements (n_element,).
        sheet: Initial geometry.
        positions: Initial positions (3, n_node) [m].
        mobile: Along which axes (3, n_node) each node can move: along none where it is clamped, and not along the
            normal of a symmetry plane.
    """
    mean, variance, fit, slope = _fits(ratio, sheet, positions, mobile)
    free = jnp.any(mobile, axis=0)

    def around(values: jax.Array, of: jax.Array) -> jax.Array:
        """Sum over the corners of that kind of the elements of each node, by initial area."""
        those = jnp.where(of, values, 0.0)
        return sum_to_nodes(sheet.area * sum(those[corner] for corner in sheet.triangles), sheet.triangles, of.size)

    x, y, z = positions
    ones, foot = jnp.ones_like(fit), fit - dot(slope, (x, y, z))
    inside, at_rim = around(ones, free), around(ones, ~free)
    carried = around(foot, free) + sum(around(part, free) * along for part, along in zip(slope, (x, y, z), strict=True))
    carried /= jnp.where(inside > 0.0, inside, 1.0)
    reach = _SPREADS * jnp.sqrt(around(variance, ~free) / jnp.where(at_rim > 0.0, at_rim, 1.0) + _EVEN**2)
    value = jnp.where(free | (inside == 0.0), fit, jnp.clip(carried, mean - reach, mean + reach))
    return jnp.clip(value, mean / _MOST, _MOST * mean)


def _fits(
    values: jax.Array, sheet: Sheet, positions: jax.Array, mobile: jax.Array
) -> tuple[jax.Array, jax.Array, jax.Array, Vector]:
    """At the nodes their elements' mean and variance, and value and gradient of the linear function that fits best."""
    _, edge1, edge2 = edges(positions, sheet.triangles)
    middles = [
        [(p * a + q * b) / 3.0 for a, b in zip(edge1, edge2, strict=True)] for p, q in ((1, 1), (-2, 1), (1, -2))
    ]

    def moments(x: jax.Array, y: jax.Array, z: jax.Array) -> jax.Array:
        """What the elements, whose middles (n_element,) lie there from a corner, add to its sums (14, n_element)."""
        rows = [jnp.ones_like(values), values, x, y, z, x * x, y * y, z * z, y * z, z * x, x * y]
        return sheet.area[None] * jnp.stack([*rows, values * x, values * y, values * z])

    shares = jnp.concatenate([moments(*middle) for middle in middles], axis=1)
    corners = sheet.triangles.ravel()
    sums = jnp.zeros((len(shares), mobile.shape[1]), values.dtype).at[:, corners].add(shares)
    area = jnp.where(sums[:1] > 0.0, sums[:1], 1.0)
    mean, *first, xx, yy, zz, yz, zx, xy, rise_x, rise_y, rise_z = sums[1:] / area
    squares = jnp.tile(sheet.area, 3) * (jnp.tile(values, 3) - mean[corners]) ** 2
    variance = jnp.zeros_like(mean).at[corners].add(squares) / area[0]
    # The images behind a symmetry plane: what is odd in the distance from it cancels.
    x, y, z = (jnp.where(along, part, 0.0) for along, part in zip(mobile, first, strict=True))
    size = xx + yy + zz
    size = jnp.where(size > 0.0, size, 1.0)

    def scaled(part: jax.Array, a: int, b: int) -> jax.Array:
        return jnp.where(mobile[a] & mobile[b], part, 0.0) / size

    diagonal = (xx - x * x) / size + _RIDGE, (yy - y * y) / size + _RIDGE, (zz - z * z) / size + _RIDGE
    mixed = scaled(yz - y * z, 1, 2), scaled(zx - z * x, 2, 0), scaled(xy - x * y, 0, 1)
    right = scaled(rise_x - mean * x, 0, 0), scaled(rise_y - mean * y, 1, 1), scaled(rise_z - mean * z, 2, 2)
    slope = _solved(diagonal, mixed, right)
    return mean, variance, mean - dot(slope, (x, y, z)), slope


def _solved(diagonal: Vector, mixed: Vector, right: Vector) -> Vector:
    """Solves symmetric 3x3 systems (n,), with the entries xx, yy, zz and yz, zx, xy."""
    (a, b, c), (d, e, f) = diagonal, mixed
    aa, bb, cc = b * c - d * d, a * c - e * e, a * b - f * f
    ab, ac, bc = d * e - f * c, f * d - b * e, e * f - a * d
    determinant = a * aa + f * ab + e * ac
    x, y, z = (dot(row, right) / determinant for row in ((aa, ab, ac), (ab, bb, bc), (ac, bc, cc)))
    return x, y, z

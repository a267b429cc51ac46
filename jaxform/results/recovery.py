"""Thickness at the nodes from that of the elements, and its scatter around rings.

The elements around a node have the thickness at their centroids. Where the centroids are evenly distributed around the
node, their mean is of second order in the element size, since the errors of flat triangles alternate in sign. Where the
element size changes, the mean is of first order only; so the best linear fit is evaluated, which is the mean where the
centroids are evenly distributed. On a symmetry plane the mirror images of the elements count as well. At a rim all
elements are on one side and no errors cancel: the fits of the nodes inside are extrapolated, but no further from the
mean than the range of the elements at the rim, like a slope limiter, since a flange is not as steep as the wall.

(Zienkiewicz, Zhu: The superconvergent patch recovery, Int. J. Numer. Meth. Eng. 33 (1992) 1331-1364.)
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from jaxform.mesh import topology
from jaxform.model.scene import Scene
from jaxform.model.tables import ReferenceGeometry
from jaxform.results import sections

if TYPE_CHECKING:
    from jaxform.results.result import Result

Array = NDArray[np.float64]

_MOST = 2.0  # how far from the mean a value may be carried, as a factor: past a sharp bend the gradient means little
_SPREADS = 6.0  # how far a value may be carried to a rim, in standard deviations there: a linear function needs 3
_RIDGE = 1e-3  # of the middles' square distance: a gradient across them, where they lie in a plane or on a line, is 0
_MOMENTS = np.array([[0, 3, 5], [3, 1, 4], [5, 4, 2]], np.int32)  # a symmetric matrix of xx, yy, zz, xy, yz, zx
_EVEN = 1e-6  # h/h0 that differ by less are alike; a root has no slope at 0


def nodal_ratio(ratio: jax.Array, sheet: ReferenceGeometry, positions: jax.Array, mobile: jax.Array) -> jax.Array:
    """Elements' h/h0 at the nodes (n_node,): the best linear fit by initial area, carried from inside to clamped nodes.

    Args:
        ratio: h/h0 of the elements (n_element,).
        sheet: Initial geometry.
        positions: Initial positions (3, n_node) [m].
        mobile: Along which axes (3, n_node) each node can move: along none where it is clamped, and not along the
            normal of a symmetry plane.
    """
    mean, variance, fit, slope = _fits(ratio, sheet.triangles, sheet.area, positions, mobile)
    free = jnp.any(mobile, axis=0)
    # Sums over the corners of the elements of each node, by initial area: of those that are free, and of the others.
    foot = fit - jnp.sum(slope * positions, axis=0)
    of_free = jnp.where(free[None], jnp.stack([jnp.ones_like(fit), foot, *slope]), 0.0)
    of_others = jnp.where(free[None], 0.0, jnp.stack([jnp.ones_like(fit), variance]))
    at_corners = jnp.concatenate([of_free, of_others])[:, sheet.triangles]
    shares = jnp.repeat(sheet.area[None, None] * jnp.sum(at_corners, axis=1, keepdims=True), 3, axis=1)
    inside, carried, *rises, at_rim, spread = _sums_at_nodes(shares, sheet.triangles, free.size)
    carried += jnp.sum(jnp.stack(rises) * positions, axis=0)
    carried /= jnp.where(inside > 0.0, inside, 1.0)
    reach = _SPREADS * jnp.sqrt(spread / jnp.where(at_rim > 0.0, at_rim, 1.0) + _EVEN**2)
    value = jnp.where(free | (inside == 0.0), fit, jnp.clip(carried, mean - reach, mean + reach))
    return jnp.clip(value, mean / _MOST, _MOST * mean)


def _sums_at_nodes(shares: jax.Array, triangles: jax.Array, count: int) -> jax.Array:
    """Sums (k, n_node) of the elements' contributions to their corners (k, 3, n_element)."""
    flat = shares.reshape(len(shares), -1)
    return jnp.zeros((len(shares), count), shares.dtype).at[:, triangles.ravel()].add(flat)


def _fits(
    values: jax.Array, triangles: jax.Array, area: jax.Array, positions: jax.Array, mobile: jax.Array
) -> tuple[jax.Array, jax.Array, jax.Array, jax.Array]:
    """Mean and variance of each node's elements, and value and gradient (3, n_node) of the best linear function.

    Whole arrays at once: a result is made once a run, and is a tenth of what is compiled.
    """
    corners = positions[:, triangles]
    away = jnp.mean(corners, axis=1, keepdims=True) - corners  # of an element's middle, from each of its corners
    one, value = jnp.ones_like(away[:1]), jnp.broadcast_to(values, (1, *away.shape[1:]))
    squares, mixed = away * away, away * jnp.roll(away, -1, axis=0)
    shares = area[None, None] * jnp.concatenate([one, value, away, value * away, squares, mixed])
    sums = _sums_at_nodes(shares, triangles, mobile.shape[1])
    around = jnp.where(sums[0] > 0.0, sums[0], 1.0)
    means = sums / around[None]
    mean, first, rise, second = means[1], means[2:5], means[5:8], means[8:][_MOMENTS]
    off = area[None] * jnp.square(value[0] - mean[triangles])
    variance = _sums_at_nodes(off[None], triangles, mobile.shape[1])[0] / around
    # The images behind a symmetry plane: what is odd in the distance from it cancels.
    first = jnp.where(mobile, first, 0.0)
    size = jnp.sum(means[8:11], axis=0)
    size = jnp.where(size > 0.0, size, 1.0)
    axes = np.eye(3, dtype=values.dtype)[:, :, None]
    even = (mobile[:, None] & mobile[None]) | (axes == 1.0)
    matrix = jnp.where(even, second - first[:, None] * first[None], 0.0) / size[None, None] + _RIDGE * axes
    slope = _solve(matrix, jnp.where(mobile, rise - mean[None] * first, 0.0) / size[None])
    return mean, variance, mean - jnp.sum(slope * first, axis=0), slope


def _solve(matrix: jax.Array, right: jax.Array) -> jax.Array:
    """Solves symmetric 3x3 systems, (3, 3, n) and (3, n): the rows' vector products are the inverse's columns."""
    one, other = jnp.roll(matrix, -1, axis=0), jnp.roll(matrix, -2, axis=0)
    columns = jnp.roll(one, -1, axis=1) * jnp.roll(other, -2, axis=1)
    columns -= jnp.roll(one, -2, axis=1) * jnp.roll(other, -1, axis=1)
    return jnp.sum(columns * right[:, None], axis=0) / jnp.sum(matrix[0] * columns[0], axis=0)[None]


# The wall where it has kinks: at the end of contact, and at sharp edges of tools. The elements round a node are on both
# sides of it there. Beside the node's linear function those of its neighbours are carried to it, which are of one side,
# and count the more the better they fit their elements; each no further than the elements round the node differ.
#
# (Hu, Shu: Weighted essentially non-oscillatory schemes on triangular meshes, J. Comput. Phys. 150 (1999) 97-127.)

_NOISE = 1e-2  # of the wall, by which elements differ from any linear function, since their nodes land one by one


def one_sided_thickness(result: Result, scene: Scene) -> jax.Array:
    """The recovered wall at the nodes (n_node,) [m], which may have kinks where contact ends and at sharp edges.

    It is `result.thickness` but at the nodes of elements whose nodes touch different smooth parts of tools, or of which
    only some touch one. Where no tool has sharp edges it is `result.thickness`. Differentiable.

    Args:
        result: The part.
        scene: Its scene; the vertices of its tools have values.
    """
    contact = _touched_parts(result, scene)
    if contact is None:
        return result.thickness
    adaptivity = scene.adaptivity
    mobile = (scene.tables.mobility if adaptivity is None else adaptivity[1].mobility) > 0.0
    positions, triangles = scene.parison.positions.T, result.triangles.T
    one, other, last = (positions[:, corner] for corner in triangles)
    area = 0.5 * jnp.linalg.norm(jnp.cross(other - one, last - one, axis=0), axis=0)
    area = jnp.where(result.used, area, 0.0)
    ratio = jnp.where(result.used, result.element_thickness * area, 1.0)
    ratio /= jnp.where(result.used, result.element_volume, 1.0)
    at_kink = jnp.any(contact[triangles] != contact[triangles[:1]], axis=0) & result.used
    near = jnp.zeros(contact.size, bool).at[triangles].max(at_kink[None]) & jnp.any(mobile, axis=0)
    value = _one_sided_ratio(ratio, triangles, area, positions, mobile) * scene.parison.thickness
    return jnp.where(near, value, result.thickness)


def _touched_parts(result: Result, scene: Scene) -> jax.Array | None:
    """The smooth part of a tool that each node touches (n_node,), from 1, 0 for none; None without sharp edges."""
    shapes = [(np.asarray(one.mold.vertices, float), np.asarray(one.mold.triangles)) for one in scene.surfaces]
    if not any(topology.sharp_edges(*shape).size for shape in shapes):
        return None
    touched, first = jnp.zeros(result.wall.shape, jnp.int32), 1
    for number, shape in enumerate(shapes):
        parts = topology.smooth_parts(*shape)
        triangle = result.wall if scene.mold is not None and number == 0 else result.tool_wall
        assert triangle is not None
        part = first + jnp.asarray(parts)[jnp.maximum(jnp.abs(triangle.astype(jnp.int32)) - 1, 0)]
        touched = jnp.where((result.tool == number) & (triangle != 0), part, touched)
        first += int(parts.max()) + 1
    return touched


def _one_sided_ratio(
    ratio: jax.Array, triangles: jax.Array, area: jax.Array, positions: jax.Array, mobile: jax.Array
) -> jax.Array:
    """Elements' h/h0 at the nodes (n_node,): a mean of the linear functions of a node and its neighbours there."""
    count = mobile.shape[1]
    mean, _, fit, slope = _fits(ratio, triangles, area, positions, mobile)
    corners = positions[:, triangles]
    middle = jnp.mean(corners, axis=1, keepdims=True)
    missed = ratio - (fit[triangles] + jnp.sum(slope[:, triangles] * (middle - corners), axis=0))
    around, off = _sums_at_nodes(area * jnp.stack([jnp.ones_like(missed), jnp.square(missed)]), triangles, count)
    off = off / jnp.where(around > 0.0, around, 1.0) + jnp.square(_NOISE * mean) + jnp.finfo(ratio.dtype).tiny
    # The function of a node without freedom is none: its elements lie on one side.
    trust = jnp.where(jnp.any(mobile, axis=0), around / off, 0.0)
    low = jnp.full(count, jnp.inf, ratio.dtype).at[triangles].min(ratio[None])
    high = jnp.full(count, -jnp.inf, ratio.dtype).at[triangles].max(ratio[None])
    total = jnp.zeros((2, count), ratio.dtype)
    for turn in range(3):
        source = jnp.roll(triangles, turn, axis=0)
        way = corners - positions[:, source]
        there = fit[source] + jnp.sum(slope[:, source] * way, axis=0)
        there = jnp.clip(there, low[triangles], high[triangles])
        total += _sums_at_nodes(trust[source] * jnp.stack([jnp.ones_like(there), there]), triangles, count)
    return total[1] / jnp.where(total[0] > 0.0, total[0], 1.0)


# The thinnest recovered wall of a part, and how much the wall scatters around it: found after the run, on the host.
#
# One element's thickness is of first order in the element size, and of many elements the thinnest is the one that
# misses most. The recovered thickness at the nodes is of second order (see `jaxform.results.recovery`).


_ALIKE = 1e-6  # of the size: radii and heights that differ by less are those of one ring
_ROUND = 12  # nodes or vertices to a whole ring, at least, that is round
_BAND = 0.75  # of an element's side, on both sides of the thinnest node's ring, in which nodes are of it
_SECTOR = 1.5  # of the same, along the ring, whose least wall is one value of the ring
_FEWEST = 3  # values without which there is no scatter around a ring


def thinnest_recovered(result: Result, scene: Scene) -> dict[str, Any]:
    """The least recovered thickness of the nodes that are not clamped, its place, and the scatter around it.

    Returns:
        `recovered` [m], `recovered_ratio` to the initial thickness there, `recovered_place` (3,) [m] in the part,
        `scatter` (the relative standard deviation), and
        `scatter_of`: 'ring' where sheet and mold are round, and it is that of the least recovered thickness around the
        axis; 'patch' elsewhere, where it is that of the elements which meet at the node, by initial area.
    """
    triangles = np.asarray(result.triangles)[np.asarray(result.used)]
    nodes, wall = np.unique(triangles), np.asarray(result.thickness, float)
    # To a clamped rim the wall is carried on from inside, which is no better than the elements there.
    inner = nodes[~np.asarray(scene.parison.clamped)[nodes]]
    candidates = inner if len(inner) else nodes
    node = int(candidates[np.argmin(wall[candidates])])
    around = _around_ring(scene, nodes, triangles, wall, node) if is_axisymmetric(scene) else np.zeros(0)
    of_ring = len(around) >= _FEWEST
    return {
        "recovered": float(wall[node]),
        "recovered_ratio": float(wall[node] / np.asarray(scene.parison.thickness, float)[node]),
        "recovered_place": np.asarray(result.positions, float)[node].tolist(),
        "scatter": _spread(around, np.ones(len(around))) if of_ring else _spread(*_patch(result, scene, node)),
        "scatter_of": "ring" if of_ring else "patch",
    }


def is_axisymmetric(scene: Scene) -> bool:
    """True if a round sheet of axisymmetric thickness is formed freely or in a mold of revolution about the z axis."""
    if not sections.is_disc(scene):
        return False
    whole = 2 ** len(sections.symmetry_planes(scene))
    parison = scene.parison
    sheet, thickness = np.asarray(parison.positions, float), np.asarray(parison.thickness, float)
    if np.ptp(thickness) > _ALIKE * thickness.max():
        rings = np.stack([np.hypot(*sheet[:, :2].T) / np.ptp(sheet), thickness / thickness.max()], axis=1)
        if not _is_ring_pattern(rings, rings[:, 0] > _ALIKE, 2):
            return False
    if scene.mold is None:
        return True
    mold = scene.mold.where_it_turns()
    rings = np.stack([np.hypot(*mold[:, :2].T), mold[:, 2]], axis=1) / np.ptp(mold)
    return _is_ring_pattern(rings, rings[:, 0] > _ALIKE, _ROUND // whole)


def _is_ring_pattern(values: Array, off_axis: NDArray[np.bool_], fewest: int) -> bool:
    """True if each of the values (n, 2) off the axis occurs at least `fewest` times."""
    _, count = np.unique((values[off_axis] / _ALIKE).round(), axis=0, return_counts=True)
    return bool((count >= fewest).all())


def _around_ring(scene: Scene, nodes: NDArray[np.int64], triangles: NDArray[np.int64], wall: Array, node: int) -> Array:
    """The least recovered thickness (k,) of each sector of the ring of a node."""
    sheet = np.asarray(scene.parison.positions, float)
    corners = sheet[triangles[(triangles == node).any(1)]]
    side = float(np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).mean())
    radius, angle = np.hypot(*sheet[nodes, :2].T), np.arctan2(sheet[nodes, 1], sheet[nodes, 0]) % (2 * np.pi)
    ring = float(np.hypot(*sheet[node, :2]))
    of_ring = np.abs(radius - ring) <= _BAND * side
    count = int(2 * np.pi * ring / (_SECTOR * side))
    if not count:
        return np.zeros(0)
    sector = np.minimum((angle[of_ring] / (2 * np.pi) * count).astype(int), count - 1)
    least = np.full(count, np.inf)
    np.minimum.at(least, sector, wall[nodes][of_ring])
    return least[np.isfinite(least)]


def _patch(result: Result, scene: Scene, node: int) -> tuple[Array, Array]:
    """Thickness (k,) [m] and initial area (k,) [m^2] of the elements at a node."""
    triangles = np.asarray(result.triangles)
    at_node = np.asarray(result.used) & (triangles == node).any(1)
    corners = np.asarray(scene.parison.positions, float)[triangles[at_node]]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    return np.asarray(result.element_thickness, float)[at_node], 0.5 * np.linalg.norm(normal, axis=1)


def _spread(values: Array, weight: Array) -> float:
    """The standard deviation over the mean."""
    mean = np.average(values, weights=weight)
    return float(np.sqrt(np.average(np.square(values - mean), weights=weight)) / mean)

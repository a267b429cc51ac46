"""Motion of nodes along a triangulated surface: from triangle to triangle, never off it."""

from __future__ import annotations

import dataclasses
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from jaxform.mechanics.membrane import Vector, cross, dot, minus, vector
from jaxform.tools.mold import Mold
from jaxform.tools.search import SearchGrid


def signed_neighbors(triangles: NDArray[np.integer]) -> NDArray[np.int32]:
    """The triangles (n_triangle, 3) beside each side of a triangle, counted from 1; 0 where there is none.

    Side k goes from corner k to the next one. A neighbor whose corners turn the other way round is negative. Where
    more than two triangles meet, a side has no neighbor: a node that slides there leaves the surface.
    """
    count = len(triangles)
    begin, end = triangles.ravel(), np.roll(triangles, -1, axis=1).ravel()
    low, high = np.minimum(begin, end).astype(np.int64), np.maximum(begin, end).astype(np.int64)
    key = low * (int(triangles.max()) + 1) + high
    _, place, each = np.unique(key, return_inverse=True, return_counts=True)
    order = np.argsort(place, kind="stable")
    first = np.concatenate([[0], np.cumsum(each)[:-1]])[each == 2]
    one, other = order[first], order[first + 1]
    sign = np.where(begin[one] == begin[other], -1, 1)
    found = np.zeros(3 * count, np.int32)
    found[one], found[other] = sign * (other // 3 + 1), sign * (one // 3 + 1)
    return found.reshape(count, 3)


def connected_parts(neighbors: NDArray[np.int32]) -> NDArray[np.int32]:
    """The number of the part (n_triangle,) that each triangle is connected to, from triangle to neighbor."""
    triangle, side = np.nonzero(neighbors)
    edges = np.ones(len(triangle)), (triangle, np.abs(neighbors[triangle, side]) - 1)
    return connected_components(coo_array(edges, shape=(len(neighbors),) * 2), directed=False)[1].astype(np.int32)


_MOST_SIDES = 8  # that a node crosses in a step, at most
OUT = 1e-12  # of a triangle's height: a node that is no further out is inside
_STEEP = 1e-9  # sine: faces that are turned less are one plane
LEAST = 1e-12  # of a normal's square that symmetry planes leave


class ContactSurface(NamedTuple):
    """A tool that the sheet can touch, and its search structure.

    Where nodes slide, also the neighbors of its triangles (n_triangle, 3), and where these are not all connected, as a
    fourth column, the part that each belongs to.
    """

    mold: Mold
    grid: SearchGrid
    neighbors: jax.Array | None = None

    def at(self, temperature: jax.Array | None) -> ContactSurface:
        """The surface with the contact law of nodes at temperatures (n,) [degC]."""
        law = self.mold.contact
        if not law.needs_temperature:
            return self
        return self._replace(mold=dataclasses.replace(self.mold, contact=law.at(temperature)))

    @property
    def part(self) -> jax.Array | None:
        """The connected part (n_triangle,) of each triangle; None where there is one, or no node slides."""
        if self.neighbors is None or self.mold.contact.sticks or self.neighbors.shape[1] < 4:
            return None
        return self.neighbors[:, 3]


class Glide(NamedTuple):
    """Nodes (n,) on a surface, in its frame.

    Attributes:
        position: Three times (n,) [m].
        velocity: Along the surface, three times (n,) [m/s].
        triangle: The triangle that they are on.
        side: 1 on the side of its normal, -1 on the other.
        left: The part of the step that is left (n,) [s].
        off: True where they have left the surface; they wait at that point.
        outward: A direction off the surface there, three times (n,).
        lost: Kinetic energy over mass that they lost in valleys [J/kg].
        rubbed: The same by friction on the faces that they ran into there [J/kg].
        distance: Length of their path [m].
    """

    position: Vector
    velocity: Vector
    triangle: jax.Array
    side: jax.Array
    left: jax.Array
    off: jax.Array
    outward: Vector
    lost: jax.Array
    rubbed: jax.Array
    distance: jax.Array

    @classmethod
    def start(cls, position: Vector, velocity: Vector, triangle: jax.Array, side: jax.Array, left: jax.Array) -> Glide:
        """Nodes that begin on these triangles."""
        none = jnp.zeros_like(left)
        return cls(position, velocity, triangle, side, left, none > 0.0, (none, none, none), none, none, none)


Facets = tuple[tuple[Vector, Vector, Vector], Vector, Vector]
"""Triangles of nodes (n,): their corners, vectors along their normals, and unit normals on the nodes' side."""


def facets(mold: Mold, triangle: jax.Array, side: jax.Array) -> Facets:
    """The triangles (n,) of a tool, seen from one of their sides."""
    first, second, third = (vector(mold.vertices[mold.triangles[triangle, k]].T) for k in range(3))
    area_vector = cross(minus(second, first), minus(third, first))
    size = jnp.sqrt(dot(area_vector, area_vector))
    return (first, second, third), area_vector, vector(side * x / size for x in area_vector)


def project_on_plane(velocity: Vector, normal: Vector, mobile: Vector) -> Vector:
    """Velocities within a plane (n,) and the nodes' symmetry planes; mobile is 1 where a component may change, else 0.

    What is taken away is along the normal, but for what symmetry planes hold.
    """
    within = vector(c * w for c, w in zip(mobile, velocity, strict=True))
    square = sum(c * n * n for c, n in zip(mobile, normal, strict=True))
    free = square > LEAST
    share = jnp.where(free, dot(within, normal) / jnp.where(free, square, 1.0), 0.0)
    return vector(jnp.where(free, w - share * c * n, 0.0) for w, c, n in zip(within, mobile, normal, strict=True))


def move_along(
    surface: ContactSurface,
    start: Glide,
    pressed: Vector,
    mobile: Vector,
    *,
    differentiable: bool,
) -> Glide:
    """Moves nodes (n,) along a surface for the rest of a step, from triangle to triangle.

    Over a ridge a node goes round with its speed where it is pressed onto the next face; else, as at a rim, it leaves
    the surface, and flies straight on from the next step on. In a valley it loses the speed into the next face, which
    rubs it by that push; where it would not get up that for longer than a step, it goes along the valley.

    Args:
        surface: The surface, with its neighbors.
        start: The nodes.
        pressed: Change of their velocities in the step by the forces, three times (n,) [m/s].
        mobile: 1 where a component of the velocity may change, else 0, three times (n,).
        differentiable: True if loops have a fixed number of passes.
    """

    def cross_sides(glide: Glide) -> Glide:
        return _advance(surface, glide, pressed, mobile)

    if differentiable:

        def advance(glide: Glide, _: None) -> tuple[Glide, None]:
            return jax.lax.cond(jnp.any(glide.left > 0.0), cross_sides, lambda glide: glide, glide), None

        return jax.lax.scan(advance, start, length=_MOST_SIDES)[0]

    def goes_on(carry: tuple[jax.Array, Glide]) -> jax.Array:
        return (carry[0] < _MOST_SIDES) & jnp.any(carry[1].left > 0.0)

    return jax.lax.while_loop(goes_on, lambda carry: (carry[0] + 1, cross_sides(carry[1])), (jnp.int32(0), start))[1]


def _advance(surface: ContactSurface, glide: Glide, pressed: Vector, mobile: Vector) -> Glide:
    """The nodes at the first side that they come to, on the next triangle; or where they are at the end of the step."""
    mold, neighbors = surface.mold, surface.neighbors
    assert neighbors is not None
    here = facets(mold, glide.triangle, glide.side)
    corners, _, here_normal = here
    way = vector(glide.left * w for w in glide.velocity)
    corner, share = _first_side(glide.position, way, here)
    leaves = share < 1.0
    share = jnp.where(leaves, share, 1.0)
    place = vector(x + share * d for x, d in zip(glide.position, way, strict=True))
    left = jnp.where(leaves, (1.0 - share) * glide.left, 0.0)

    number = neighbors.reshape(-1)[neighbors.shape[1] * glide.triangle + (corner + 1) % 3]
    beyond, other_side = jnp.maximum(jnp.abs(number) - 1, 0), jnp.where(number < 0, -glide.side, glide.side)
    there_corners, _, there_normal = facets(mold, beyond, other_side)
    begin, end = (_select(corners, (corner + k) % 3) for k in (1, 2))
    edge = minus(end, begin)
    length = jnp.sqrt(dot(edge, edge))
    edge = vector(x / length for x in edge)
    inward = cross(there_normal, edge)
    middle = vector((a + b + c) / 3.0 for a, b, c in zip(*there_corners, strict=True))
    turned = jnp.where(dot(minus(middle, begin), inward) < 0.0, -1.0, 1.0)
    inward = vector(turned * x for x in inward)

    velocity = glide.velocity
    along = dot(velocity, edge)
    rest = minus(velocity, vector(along * x for x in edge))
    square = dot(rest, rest)
    across = jnp.sqrt(jnp.where(square > 0.0, square, 1.0))
    rise = dot(velocity, there_normal)
    ridge = rise > _STEEP * across
    flies = leaves & ((number == 0) | ridge & (dot(pressed, there_normal) > 0.0))
    crosses = leaves & ~flies

    round_it = vector(along * e + across * m for e, m in zip(edge, inward, strict=True))
    up_it = project_on_plane(velocity, there_normal, mobile)
    # In the valley, from which the next face leads up: a node that would be back within the step is at rest there.
    back = jnp.maximum(-dot(pressed, inward), 0.0)
    stays = ~ridge & (dot(up_it, inward) <= back)
    within = vector(along * e for e in edge)
    new = vector(jnp.where(ridge, r, jnp.where(stays, w, u)) for r, w, u in zip(round_it, within, up_it, strict=True))
    target = vector(jnp.where(stays, a, b) for a, b in zip(here_normal, there_normal, strict=True))
    new = project_on_plane(new, target, mobile)
    # Both faces push what stays in the valley, the first one less than before.
    cosine = jax.lax.stop_gradient(jnp.clip(dot(here_normal, there_normal), -1.0, 1.0))
    half_turn = jnp.sqrt((1.0 - cosine) / jnp.maximum(1.0 + cosine, LEAST))
    taken = minus(velocity, new)
    push = jnp.sqrt(jnp.maximum(dot(taken, taken), jnp.finfo(along.dtype).tiny)) * jnp.where(stays, half_turn, 1.0)
    free = new
    new = _select_where(ridge, new, mold.contact.limit_slip(new, push))
    crosses_valley = crosses & ~ridge
    lost = jnp.where(crosses_valley, 0.5 * (dot(velocity, velocity) - dot(free, free)), 0.0)
    rubbed = jnp.where(crosses_valley, 0.5 * (dot(free, free) - dot(new, new)), 0.0)
    alone = number == 0
    away = vector(a + jnp.where(alone, 0.0, b) for a, b in zip(here_normal, there_normal, strict=True))
    moves_over = crosses & ~stays
    return Glide(
        position=place,
        velocity=vector(jnp.where(crosses, n, w) for n, w in zip(new, velocity, strict=True)),
        triangle=jnp.where(moves_over, beyond, glide.triangle),
        side=jnp.where(moves_over, other_side, glide.side),
        left=jnp.where(flies | glide.off, 0.0, left),
        off=glide.off | flies,
        outward=vector(jnp.where(flies, a, b) for a, b in zip(away, glide.outward, strict=True)),
        lost=glide.lost + lost,
        rubbed=glide.rubbed + rubbed,
        distance=glide.distance + share * _length(way),
    )


def _select_where(chosen: jax.Array, new: Vector, old: Vector) -> Vector:
    """The new vectors (n,) where they are chosen, else the old ones."""
    return vector(jnp.where(chosen, one, other) for one, other in zip(new, old, strict=True))


def _length(way: Vector) -> jax.Array:
    """The length (n,) of vectors; its derivative is 0 where they have none."""
    square = dot(way, way)
    return jnp.where(square > 0.0, jnp.sqrt(jnp.where(square > 0.0, square, 1.0)), 0.0)


def _first_side(position: Vector, way: Vector, here: Facets) -> tuple[jax.Array, jax.Array]:
    """The corner (n,) opposite to the side that a way leaves a triangle through, and at which share of it; else inf."""
    (first, second, third), area_vector, _ = here
    square = dot(area_vector, area_vector)
    away, edge1, edge2 = minus(position, first), minus(second, first), minus(third, first)
    duals = cross(edge2, area_vector), cross(area_vector, edge1)
    gamma, delta = (dot(away, dual) / square for dual in duals)
    gamma_rate, delta_rate = (dot(way, dual) / square for dual in duals)
    shares, rates = (1.0 - gamma - delta, gamma, delta), (-gamma_rate - delta_rate, gamma_rate, delta_rate)

    def reach(share: jax.Array, rate: jax.Array) -> jax.Array:
        goes_out = (share + rate < -OUT) & (rate < 0.0)
        return jnp.where(goes_out, jnp.maximum(share, 0.0) / jnp.where(goes_out, -rate, 1.0), jnp.inf)

    reached = [reach(*each) for each in zip(shares, rates, strict=True)]
    least = jnp.minimum(jnp.minimum(reached[0], reached[1]), reached[2])
    corner = jnp.where(reached[0] == least, 0, jnp.where(reached[1] == least, 1, 2))
    return corner, least


def _select(corners: tuple[Vector, Vector, Vector], number: jax.Array) -> Vector:
    """The corner of this number (n,)."""
    triples = zip(*corners, strict=True)
    return vector(jnp.where(number == 0, a, jnp.where(number == 1, b, c)) for a, b, c in triples)

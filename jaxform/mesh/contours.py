"""Plane shapes round points and masks: smallest circle and rectangle, contours, closed rims. On the host."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from jaxform.mesh import outlines

Array = NDArray[np.float64]
Integers = NDArray[np.integer]

_ROUNDS = 4000  # of the search for the smallest circle: its radius is then right to one in so many
_NEARLY = 0.99  # of the area of a rectangle along the axes, above which one that is turned is not worth it


class Circle(NamedTuple):
    """Centre (2,) and radius [m]."""

    center: Array
    radius: float


class OrientedRectangle(NamedTuple):
    """A corner (2,) [m], the sides a, b [m] from it, and by how much the first leans to the left of x [rad]."""

    corner: Array
    sides: Array
    angle: float

    @property
    def axes(self) -> Array:
        """Unit vectors along the sides (2, 2), one a row."""
        cosine, sine = np.cos(self.angle), np.sin(self.angle)
        return np.array([[cosine, sine], [-sine, cosine]])

    def enlarge(self, margin: float) -> OrientedRectangle:
        """The rectangle enlarged by a margin [m] on each side."""
        return OrientedRectangle(self.corner - margin * self.axes.sum(0), self.sides + 2 * margin, self.angle)


def hull(points: Array) -> Array:
    """The corners (k, 2) [m] of the convex hull of points (n, 2) [m], counter-clockwise."""
    from scipy.spatial import ConvexHull

    return points[ConvexHull(points).vertices]


def smallest_circle(points: Array) -> Circle:
    """The smallest circle round points (n, 2) [m], nearly (Badoiu and Clarkson's steps towards the farthest point)."""
    low, high = points.min(0), points.max(0)
    center = 0.5 * (low + high)
    for k in range(1, _ROUNDS):
        farthest = points[np.argmax(np.sum((points - center) ** 2, axis=1))]
        center = center + (farthest - center) / (k + 1) ** (1 if k > 20 else 2)
    return Circle(center, float(np.linalg.norm(points - center, axis=1).max()))


def smallest_rectangle(corners: Array) -> OrientedRectangle:
    """The smallest rectangle round a convex polygon (k, 2) [m]; along the axes, where that is hardly larger."""
    side = np.roll(corners, -1, axis=0) - corners
    angles = np.unique(np.round(np.append(np.arctan2(side[:, 1], side[:, 0]) % (np.pi / 2), 0.0), 9))
    found = [_rectangle_at(corners, float(angle)) for angle in angles]
    best, straight = min(found, key=_size), found[0]
    return best if _size(best) < _NEARLY * _size(straight) else straight


def _rectangle_at(corners: Array, angle: float) -> OrientedRectangle:
    # Of the four ways to say the same rectangle the one that turns least.
    turned = angle - np.pi / 2 if angle > np.pi / 4 else angle
    axes = OrientedRectangle(np.zeros(2), np.zeros(2), turned).axes
    along = corners @ axes.T
    return OrientedRectangle(along.min(0) @ axes, np.ptp(along, axis=0), turned)


def _size(rectangle: OrientedRectangle) -> float:
    return float(np.prod(rectangle.sides))


def contour(values: Array, low: Array, pixel: float) -> Array:
    """The longest closed line (k, 2) [m] round where values are above 0, counter-clockwise; none is at the edge.

    Args:
        values: Values in the middles of square pixels (ny, nx).
        low: The outer corner of the first pixel (2,) [m].
        pixel: Their side [m].
    """
    rows, columns = values.shape
    value = np.where(values == 0, -1e-12, values).ravel()
    number = np.arange(rows * columns).reshape(rows, columns)
    a, b, c, d = number[:-1, :-1], number[:-1, 1:], number[1:, 1:], number[1:, :-1]
    triangles = np.concatenate([np.stack([x.ravel() for x in t], axis=1) for t in ((a, b, c), (a, c, d))])
    above = value[triangles] > 0
    mixed = above.any(1) & ~above.all(1)
    triangles, above = triangles[mixed], above[mixed]
    # Turned so that the first corner is alone on its side; the line then runs with what is above on its left.
    alone = np.argmax(above == (above.sum(1) == 1)[:, None], axis=1)
    first, second, third = (np.take_along_axis(triangles, ((alone + k) % 3)[:, None], axis=1)[:, 0] for k in range(3))
    up = value[first] > 0
    other, one = np.where(up, second, third), np.where(up, third, second)
    count = len(value)
    keys = [np.minimum(first, node) * count + np.maximum(first, node) for node in (other, one)]
    loop = max(closed_loops(*keys), key=len)
    # The two nodes of each edge, whose number is made of theirs.
    ends = np.divmod(loop, count)
    share = value[ends[0]] / (value[ends[0]] - value[ends[1]])
    middle = [np.stack([node % columns, node // columns], axis=1) + 0.5 for node in ends]
    points = low + pixel * (middle[0] + share[:, None] * (middle[1] - middle[0]))
    return points if outlines.area(points) > 0 else points[::-1]


def closed_loops(begin: Integers, end: Integers) -> list[Integers]:
    """The closed ways (k,) through numbers, each of which begins one step and ends one."""
    following = dict(zip(begin.tolist(), end.tolist(), strict=True))
    loops = []
    while following:
        start, at = following.popitem()
        way = [start]
        while at != start and at in following:
            way.append(at)
            at = following.pop(at)
        if at == start:
            loops.append(np.array(way))
    return loops

"""Plane shapes: polygons cleaned and simplified, contours, smallest circle and rectangle, and masks over pixels.

On the host.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from jaxform.core.errors import InputError
from jaxform.mesh.topology import positions_in_rows

Array = NDArray[np.float64]
Index = NDArray[np.int64]
Integers = NDArray[np.integer]

MOST_CORNERS = 20_000
_SAME = 1e-9  # of the polygon's size: corners as near as that are one
_SHARP = 30.0  # degrees, below which a corner is blunted
_CHUNK = 4_000_000  # pairs of sides processed together


def area(corners: Array) -> float:
    """Area [m^2] of a polygon (n, 2) [m], below 0 where it runs clockwise."""
    # About a corner of its own: far from the origin the products are large and their differences rounded.
    x, y = (corners - corners[0]).T
    return 0.5 * float(x @ np.roll(y, -1) - y @ np.roll(x, -1))


def clean(polygon: Any, key: str = "parison.polygon") -> Array:
    """The corners (k, 2) [m] of a simple polygon, counter-clockwise, repeated ones left out.

    Args:
        polygon: Corners (n, 2) [m] in either order; the last may repeat the first.
        key: Its key, for messages.

    Raises:
        InputError: Fewer than three corners or too many, numbers that are not finite, no area, or sides that cross or
            touch each other.
    """
    try:
        corners = np.asarray(polygon, np.float64)
    except (TypeError, ValueError):
        corners = np.zeros(0)
    if corners.ndim != 2 or corners.shape[-1] != 2 or not np.isfinite(corners).all():
        raise InputError("is not a list of points", "give [[x, y], ...] in m", key, polygon)
    if len(corners) > MOST_CORNERS:
        raise InputError(f"has {len(corners)} corners", f"give at most {MOST_CORNERS}", key)
    size = float(np.ptp(corners, axis=0).max(initial=0.0)) if len(corners) else 0.0
    apart = np.linalg.norm(corners - np.roll(corners, -1, axis=0), axis=1) > _SAME * size
    corners = _drop_collinear(corners[apart])
    middle = corners.mean(0) if len(corners) else 0.0
    if len(corners) < 3 or np.linalg.svd(corners - middle, compute_uv=False)[1] <= _SAME * size:
        raise InputError("encloses no area", "give three corners or more, not on one line", key, polygon)
    place = crossing_point(corners)
    if place is not None:
        where = f"({place[0]:.6g}, {place[1]:.6g}) m"
        raise InputError(f"crosses or touches itself at {where}", "move the corners apart there", key)
    return corners if area(corners) > 0 else corners[::-1].copy()


def _drop_collinear(corners: Array) -> Array:
    """The polygon without the corners that lie on the line between their neighbours."""
    before, after = corners - np.roll(corners, 1, axis=0), np.roll(corners, -1, axis=0) - corners
    turn = np.abs(before[:, 0] * after[:, 1] - before[:, 1] * after[:, 0])
    onwards = np.einsum("ij,ij->i", before, after) > 0
    flat = onwards & (turn <= 1e-14 * np.linalg.norm(before, axis=1) * np.linalg.norm(after, axis=1))
    return corners[~flat]


def crossing_point(corners: Array, *, closed: bool = True) -> Array | None:
    """A place (2,) [m] where two sides that are not neighbours meet, or neighbours lie on each other; None if none.

    Args:
        corners: Corners (n, 2) [m].
        closed: True if a side joins the last corner to the first.
    """
    count = len(corners) if closed else len(corners) - 1
    begin, end = corners[:count], np.roll(corners, -1, axis=0)[:count]
    low, high = np.minimum(begin, end), np.maximum(begin, end)
    order = np.argsort(low[:, 0], kind="stable")
    last = np.searchsorted(low[order, 0], high[order, 0], side="right")
    beside = last - np.arange(count) - 1
    for part in np.array_split(np.arange(count), 1 + int(beside.sum()) // _CHUNK):
        one = np.repeat(part, beside[part])
        other = positions_in_rows(beside[part]) + one + 1
        one, other = order[one], order[other]
        near = (low[one, 1] <= high[other, 1]) & (low[other, 1] <= high[one, 1])
        one, other = one[near], other[near]
        met = _sides_meet(begin[one], end[one], begin[other], end[other])
        step = np.abs(other - one)
        joined = (step == 1) | (closed & (step == count - 1))
        met[joined] = _sides_overlap(begin, end, one[joined], other[joined])
        if met.any():
            return _meeting_point(*(side[index[met][0]] for index in (one, other) for side in (begin, end)))
    return None


def _sides_meet(a: Array, b: Array, c: Array, d: Array) -> NDArray[np.bool_]:
    """True where sides from a to b and from c to d (n, 2), whose boxes overlap, cross or touch."""
    one, other = _turn(a, b, c) * _turn(a, b, d), _turn(c, d, a) * _turn(c, d, b)
    return (one <= 0) & (other <= 0)


def _sides_overlap(begin: Array, end: Array, one: Index, other: Index) -> NDArray[np.bool_]:
    """True where two sides that share a corner overlap: the second goes straight back."""
    flat = np.abs(_turn(begin[one], end[one], begin[other]) + _turn(begin[one], end[one], end[other]))
    ahead, back = end[one] - begin[one], end[other] - begin[other]
    length = np.linalg.norm(ahead, axis=1) * np.linalg.norm(back, axis=1)
    return (flat <= 1e-12 * length) & (np.einsum("ij,ij->i", ahead, back) < 0)


def _meeting_point(a: Array, b: Array, c: Array, d: Array) -> Array:
    """The intersection (2,) of two sides, or the middle of their overlap."""
    along, across = b - a, d - c
    turned = along[0] * across[1] - along[1] * across[0]
    if turned == 0:
        ends = np.stack([a, b, c, d])
        return ends[np.argsort(ends @ along)][1:3].mean(0)
    return a + along * ((c - a)[0] * across[1] - (c - a)[1] * across[0]) / turned


def _turn(a: Array, b: Array, c: Array) -> Array:
    return (b[..., 0] - a[..., 0]) * (c[..., 1] - a[..., 1]) - (b[..., 1] - a[..., 1]) * (c[..., 0] - a[..., 0])


def blunt(corners: Array, width: float, kept: NDArray[np.bool_]) -> tuple[Array, NDArray[np.bool_]]:
    """The polygon with its sharp corners cut off where it is so wide [m], and which corners (k,) were kept before."""
    before, after = np.roll(corners, 1, axis=0) - corners, np.roll(corners, -1, axis=0) - corners
    lengths = np.stack([np.linalg.norm(before, axis=1), np.linalg.norm(after, axis=1)])
    cosine = np.einsum("ij,ij->i", before, after) / np.prod(lengths, axis=0)
    convex = _turn(np.roll(corners, 1, axis=0), corners, np.roll(corners, -1, axis=0)) > 0
    angle = np.arccos(np.clip(cosine, -1.0, 1.0))
    back = 0.5 * width / np.sin(0.5 * np.maximum(angle, 1e-9))
    sharp = convex & ~kept & (angle < np.radians(_SHARP)) & (2 * back < lengths.min(0))
    cut = [side * (back / length)[:, None] for side, length in zip((before, after), lengths, strict=True)]
    made = np.stack([corners + np.where(sharp[:, None], side, 0.0) for side in cut], axis=1).reshape(-1, 2)
    there = np.stack([np.ones_like(sharp), sharp], axis=1).ravel()
    return made[there], np.repeat(kept, 2)[there]


def essential_corners(corners: Array, tolerance: Array, forced: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """The corners (k,) without which the polygon would be off by more than the tolerance (k,) [m]."""
    count = len(corners)
    kept = forced.copy()
    kept[np.argmax(np.linalg.norm(corners - corners.mean(0), axis=1))] = True
    first = int(np.flatnonzero(kept)[0])
    kept[np.argmax(np.linalg.norm(corners - corners[first], axis=1))] = True
    ends = np.flatnonzero(kept)
    spans = list(zip(ends, np.append(ends[1:], ends[0] + count), strict=True))
    while spans:
        begin, end = spans.pop()
        between = np.arange(begin + 1, end) % count
        if not len(between):
            continue
        off = _distance_to_side(corners[between], corners[begin % count], corners[end % count]) / tolerance[between]
        worst = int(np.argmax(off))
        if off[worst] > 1:
            kept[between[worst]] = True
            spans += [(begin, begin + 1 + worst), (begin + 1 + worst, end)]
    # Three corners enclose an area where two do not.
    if kept.sum() < 3:
        one, other = np.flatnonzero(kept)
        kept[np.argmax(np.abs(_turn(corners[one], corners[other], corners)))] = True
    return kept


def _distance_to_side(points: Array, begin: Array, end: Array) -> Array:
    """Distance (n,) [m] of points (n, 2) to a side."""
    side = end - begin
    share = np.clip((points - begin) @ side / max(float(side @ side), 1e-300), 0.0, 1.0)
    return np.linalg.norm(points - begin - share[:, None] * side, axis=1)


# Plane shapes round points and masks: smallest circle and rectangle, contours, closed rims. On the host.


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
    # The rectangle has four descriptions; this is the one with the smallest angle.
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
    return points if area(points) > 0 else points[::-1]


def closed_loops(begin: Integers, end: Integers) -> list[Integers]:
    """The closed ways (k,) through numbers, each of which starts one step and ends one."""
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


# Masks over pixels: parts, distances, gaps. SciPy's, with types; it takes a while to import, so when needed.

Mask = NDArray[np.bool_]


def label_parts(mask: Mask) -> tuple[NDArray[np.int64], int]:
    """The number of the connected part that each pixel is in, from 1, 0 outside; and how many there are."""
    from scipy import ndimage

    found: Any = ndimage.label(mask)
    return found[0].astype(np.int64), int(found[1])


def distance(mask: Mask) -> Array:
    """Distance [pixels] of each pixel of a mask to the nearest that is not in it; 0 of those."""
    from scipy import ndimage

    return np.asarray(ndimage.distance_transform_edt(mask))


def close_gaps(mask: Mask, reach: float) -> Mask:
    """A mask with all gaps filled that are up to twice so many pixels wide."""
    wide = int(reach) + 1
    near = distance(~np.pad(mask, wide)) <= reach
    return (distance(near) > reach)[wide:-wide, wide:-wide] | mask


def fill_holes(mask: Mask) -> Mask:
    """A mask with what it surrounds."""
    from scipy import ndimage

    return np.asarray(ndimage.binary_fill_holes(mask), bool)


def dilate(mask: Mask, pixels: int) -> Mask:
    """A mask dilated by a number of steps; below 0 it is eroded."""
    from scipy import ndimage

    change = ndimage.binary_dilation if pixels > 0 else ndimage.binary_erosion
    return np.asarray(change(mask, iterations=abs(pixels)), bool)


def local_minimum(values: Array, pixels: int) -> Array:
    """The least value up to so many pixels away, along rows and columns."""
    from scipy import ndimage

    return np.asarray(ndimage.minimum_filter(values, size=2 * pixels + 1, mode="constant", cval=np.inf))


def fill_narrow_minima(values: Array, reach: float) -> Array:
    """Values with minima filled that are narrower than a disc with so many pixels as its radius: a grey closing."""
    from scipy import ndimage

    size = int(np.ceil(reach))
    rows, columns = np.mgrid[-size : size + 1, -size : size + 1]
    disc = np.hypot(rows, columns) <= reach
    return np.asarray(ndimage.grey_closing(values, footprint=disc, mode="nearest"))

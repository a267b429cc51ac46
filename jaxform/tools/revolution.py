"""Bodies of revolution: the axis of a surface, and the profile of its outside. On the host."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from jaxform.core.errors import InputError
from jaxform.mesh.meshes import Mesh
from jaxform.tools.bottle_axis import axis_candidates, flat_faces

Array = NDArray[np.float64]

_HALF_PLANES = 16  # through the axis, in which the profile is found
_FIRST = 0.0123  # angle of the first of them: no vertex of a regular mesh lies in it
_LEVELS = 400  # along the axis, and along the radius, at which the outside is found
ROUND = 0.04  # of the radius, its variation around the axis, root mean square, in a body of revolution at most
_FINE = 0.002  # of the body's length, by which a simplified profile deviates at most
_ENDS = 1e-6  # of the length, left out at both ends, where caps are


class Revolution(NamedTuple):
    """A body of revolution.

    Attributes:
        origin: Intersection of the axis and the plane of the narrow end, the neck (3,) [m].
        axis: Unit vector along the axis from the neck to the other end (3,).
        profile: Points r, z [m] of the outside, z from the neck on, from the axis at the far end to the neck (k, 2).
        variation: Variation of the radius around the axis, relative, root mean square.
    """

    origin: Array
    axis: Array
    profile: Array
    variation: float

    @property
    def length(self) -> float:
        """Length along the axis [m]."""
        return float(self.profile[:, 1].max())

    @property
    def radius(self) -> float:
        """Largest radius [m]."""
        return float(self.profile[:, 0].max())

    @property
    def neck(self) -> float:
        """Radius of the neck at its end [m]."""
        return float(self.profile[-1, 0])


def find_revolution(mesh: Mesh) -> Revolution:
    """The body of revolution that a welded surface [m] is, with the neck at its narrower end.

    Raises:
        InputError: It is none.
    """
    corners = mesh.positions[mesh.triangles]
    area = 0.5 * np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    middle = (area @ corners.mean(1)) / area.sum()
    ways = axis_candidates(mesh, flat_faces(mesh.positions[np.unique(mesh.triangles)]))
    best = min((_sections(corners, middle, way) for way in ways), key=lambda found: found[2])
    axis, outside, variation = best
    if variation > ROUND:
        varies = f"its radius varies by {100 * variation:.0f} % around the best axis"
        problem = f"is not a body of revolution: {varies if np.isfinite(variation) else 'it surrounds no axis'}"
        raise InputError(problem, "give a bottle that is round, or write the scene by hand from stretch-blow-bottle")
    return _from_neck(corners, middle, axis, outside, variation)


def _in_bottle_frame(points: Array, middle: Array, axis: Array) -> Array:
    """Points (..., 3) with the axis as z and the middle as origin."""
    other = np.eye(3)[np.argmin(np.abs(axis))]
    across = np.cross(axis, other)
    across /= np.linalg.norm(across)
    frame: Array = np.asarray([across, np.cross(axis, across), axis], np.float64)
    return (points - middle) @ frame.T


def _segments(corners: Array, angle: float) -> Array:
    """Sections (n, 2, 2) [m] of triangles (m, 3, 3) about z with a half-plane at an angle: ends r, z."""
    cos, sin = np.cos(angle), np.sin(angle)
    along = corners[..., 0] * cos + corners[..., 1] * sin
    off = corners[..., 1] * cos - corners[..., 0] * sin
    cut = (off.min(1) < 0.0) & (off.max(1) > 0.0)
    along, off, height = along[cut], off[cut], corners[cut, :, 2]
    after = np.roll(np.arange(3), -1)
    crosses = off * off[:, after] < 0.0
    share = np.where(crosses, off / np.where(crosses, off - off[:, after], 1.0), 0.0)
    ends = np.stack([x + share * (x[:, after] - x) for x in (along, height)], axis=2)
    two = crosses.sum(1) == 2
    found = ends[two][crosses[two]].reshape(-1, 2, 2)
    return found[found[..., 0].max(1) > 0.0]


def _extreme(segments: Array, levels: Array, level_of: int, value_of: int, largest: bool) -> Array:
    """Largest or smallest value (k,) of segments (n, 2, 2) where they cross each level (k,); NaN where none does."""
    one, other = segments[:, 0, level_of][:, None], segments[:, 1, level_of][:, None]
    crosses = (np.minimum(one, other) <= levels) & (levels <= np.maximum(one, other)) & (one != other)
    share = np.clip((levels - one) / np.where(one != other, other - one, 1.0), 0.0, 1.0)
    first = segments[:, 0, value_of][:, None]
    values = first + share * (segments[:, 1, value_of][:, None] - first)
    found = np.where(crosses, values, -np.inf if largest else np.inf)
    found = found.max(0, initial=-np.inf) if largest else found.min(0, initial=np.inf)
    return np.where(np.isfinite(found), found, np.nan)


def _sections(corners: Array, middle: Array, axis: Array) -> tuple[Array, Array, float]:
    """An axis, the outer radius (levels, 2) over the height along it, and its variation around, relative."""
    turned = _in_bottle_frame(corners, middle, axis)
    low, high = turned[..., 2].min(), turned[..., 2].max()
    levels = np.linspace(low, high, _LEVELS + 1)
    inner = np.clip(levels, low + _ENDS * (high - low), high - _ENDS * (high - low))
    angles = _FIRST + 2.0 * np.pi * np.arange(_HALF_PLANES) / _HALF_PLANES
    radius = np.stack([_extreme(_segments(turned, angle), inner, 1, 0, True) for angle in angles])
    if np.isnan(radius).any():
        return axis, np.stack([np.nan_to_num(radius).max(0), levels], 1), np.inf
    outer = radius.max(0)
    variation = float(np.sqrt(np.mean(np.square(radius - radius.mean(0))) / np.mean(np.square(outer))))
    return axis, np.stack([outer, levels], axis=1), variation


def _from_neck(corners: Array, middle: Array, axis: Array, outside: Array, variation: float) -> Revolution:
    """The body with z from the neck on."""
    tenth = _LEVELS // 10
    if outside[:tenth, 0].mean() > outside[-tenth:, 0].mean():
        axis, outside = -axis, (outside * [1.0, -1.0])[::-1]
    origin = middle + outside[0, 1] * axis
    turned = _in_bottle_frame(corners, origin, axis)
    side = outside - [0.0, outside[0, 1]]
    length = side[-1, 1]
    # Seen from below, the bottom: from the axis to the ring on which the body stands.
    angles = _FIRST + 2.0 * np.pi * np.arange(_HALF_PLANES) / _HALF_PLANES
    levels = np.linspace(0.0, side[:, 0].max(), _LEVELS + 1)[1:-1]
    segments = [_segments(turned, angle) for angle in angles]
    bottom = np.nanmax(np.stack([_extreme(each, levels, 0, 1, True) for each in segments]), axis=0)
    stands = int(np.flatnonzero(bottom >= bottom.max() - 1e-4 * length)[-1])
    base = np.stack([levels, bottom], axis=1)[: stands + 1]
    above = side[side[:, 1] < bottom[stands] - _FINE * length]
    points = np.concatenate([[[0.0, base[0, 1]]], base, above[::-1]])
    return Revolution(origin, axis, simplify(points, _FINE * length), variation)


def mean_revolution(mesh: Mesh) -> tuple[Revolution, float]:
    """The body of revolution with the mean section of a surface [m] about z, from the neck at z = 0 on; its neck.

    Returns:
        The body, and the least distance [m] of the surface from the axis in its upper quarter.
    """
    corners = mesh.positions[mesh.triangles]
    length = float(mesh.positions[:, 2].max())
    levels = np.linspace(0.0, length, _LEVELS + 1)
    angles = _FIRST + 2.0 * np.pi * np.arange(_HALF_PLANES) / _HALF_PLANES
    segments = [_segments(corners, angle) for angle in angles]
    radius = np.stack([_extreme(each, levels, 1, 0, True) for each in segments])
    side = np.stack([np.sqrt(np.nanmean(np.square(radius[:, :-1]), axis=0)), levels[:-1]], axis=1)
    near = max(float(side[:, 0].max()) / _LEVELS, 1e-9)
    bottom = np.nanmax([_extreme(each, np.array([near]), 0, 1, True)[0] for each in segments])
    # The side down to where it turns in, then straight to the middle of the bottom.
    last = int(np.flatnonzero(side[:, 0] >= 0.5 * side[:, 0].max())[-1])
    points = np.concatenate([[[0.0, bottom]], side[last::-1]])
    profile = simplify(points, _FINE * length)
    variation = float(np.sqrt(np.nanmean(np.square(radius[:, :-1] - side[:, 0])) / np.mean(np.square(side[:, 0]))))
    neck = float(np.nanmin(radius[:, levels <= 0.25 * length]))
    return Revolution(np.zeros(3), np.eye(3)[2], profile, variation), neck


def simplify(points: Array, tolerance: float) -> Array:
    """The points (k, 2) of a line (n, 2) without which it would deviate by more than a tolerance."""
    kept = np.zeros(len(points), dtype=bool)
    kept[[0, -1]] = True
    waiting = [(0, len(points) - 1)]
    while waiting:
        begin, end = waiting.pop()
        if end - begin < 2:
            continue
        way, away = points[end] - points[begin], points[begin + 1 : end] - points[begin]
        share = np.clip(away @ way / max(float(way @ way), 1e-300), 0.0, 1.0)
        distance = np.linalg.norm(away - share[:, None] * way, axis=1)
        if distance.max() > tolerance:
            farthest = begin + 1 + int(np.argmax(distance))
            kept[farthest] = True
            waiting += [(begin, farthest), (farthest, end)]
    return points[kept]

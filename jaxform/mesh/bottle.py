"""Half of a soap bottle with a handle: its mold, and the flattened parison pinched along the same outline.

Both are lifted from one plane outline with a hole. The lift follows from the solution u of -div grad u = 1 in the
outline, u = 0 along it: where the outline is a strip of half width R, sqrt(2 u + |grad u|^2) is R and |grad u| the
distance from the middle, which is all that is needed to lift the strip to half a tube. Where strips meet, as at the
ends of the handle, u blends them smoothly.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import PchipInterpolator
from scipy.sparse import coo_array
from scipy.sparse.linalg import spsolve

from jaxform.core.errors import InputError
from jaxform.mesh import planform

Array = NDArray[np.float64]

# The outline from the neck down the right side, round the bottom and up the left side: x in radii, y in heights,
# below 0 in radii. Where x is None it is the neck's.
_OUTLINE: list[tuple[float | None, float]] = [
    *((None, 1.0), (None, 0.922), (0.44, 0.887), (0.7, 0.852), (0.9, 0.8), (0.98, 0.717), (0.99, 0.61)),
    *((1.0, 0.478), (1.0, 0.348), (1.0, 0.087), (1.0, 0.009), (0.925, -0.3), (0.7, -0.55), (0.3, -0.65)),
    *((0.0, -0.65), (-0.3, -0.65), (-0.7, -0.55), (-0.925, -0.3), (-1.0, 0.009), (-1.0, 0.087), (-1.0, 0.348)),
    *((-0.975, 0.478), (-0.875, 0.61), (-0.7, 0.717), (-0.5, 0.81), (-0.39, 0.87), (None, 0.922), (None, 1.0)),
]
_BOTTOM = 1.3  # radii of the outline, from its lowest point up, that are bent round to make a flat bottom
_SHOULDER, _NECK = 0.8, 0.922  # heights where the one ends and the other starts
_HANDLE = 0.45  # height from which on the outline may be drawn in to the handle's outer edge
_HOLE = (0.41, 0.66)  # its middle: x in radii, y in heights
_LEAN = 0.07  # of the hole to the left, per length upwards
_SAMPLES = 4000  # of a smooth curve


@dataclass(frozen=True)
class Bottle:
    """The outer shape of a bottle.

    Attributes:
        height: Height from bottom to neck [m].
        radius: Radius of the body [m].
        neck_radius: [m].
        hole: Half width and half height of the handle's hole [m].
        hole_center: Its middle: distance from the axis and height [m]; None for 0.41 radii and 0.66 heights.
        handle_edge: Distance of the handle's outer edge from the axis [m]; None for nearly the body's radius.
    """

    height: float = 0.23
    radius: float = 0.04
    neck_radius: float = 0.014
    hole: tuple[float, float] = (0.0075, 0.027)
    hole_center: tuple[float, float] | None = None
    handle_edge: float | None = None

    @property
    def middle_of_hole(self) -> Array:
        """The middle (2,) [m] of the handle's hole."""
        return np.array(self.hole_center or np.multiply(_HOLE, (self.radius, self.height)), float)

    def check(self) -> None:
        """Raises InputError where the parts do not fit into each other."""
        sizes = {"height": self.height, "radius": self.radius, "neck_radius": self.neck_radius}
        for key, value in sizes.items():
            if not (np.isfinite(value) and value > 0):
                raise InputError("is not a positive length", "give metres above 0", key, value)
        limits = {
            "height": (self.height, 3 * self.radius, 20 * self.radius),
            "neck_radius": (self.neck_radius, 0.2 * self.radius, 0.5 * self.radius),
            "hole[0]": (self.hole[0], 0.1 * self.radius, 0.25 * self.radius),
            "hole[1]": (self.hole[1], 0.04 * self.height, 0.14 * self.height),
            "handle_edge": (self.handle_edge or self.radius, self.middle_of_hole[0] + 2 * self.hole[0], self.radius),
            "hole_center[0]": (self.middle_of_hole[0], 0.2 * self.radius, 0.5 * self.radius),
            "hole_center[1]": (self.middle_of_hole[1], 0.5 * self.height, 0.7 * self.height),
        }
        for key, (value, least, most) in limits.items():
            if not least <= value <= most:
                raise InputError("does not fit the bottle", f"use {least:.4g} to {most:.4g} m", key, value)


def half_bottle(
    shape: Bottle, element_size: float, *, swell: float = 1.0, neck_swell: float | None = None, inset: float = 0.0
) -> tuple[Array, NDArray]:
    """Half a bottle, z >= 0, neck open at y = height, or the parison that lies in it.

    Args:
        shape: The bottle.
        element_size: Length of the edges [m], before the lift, halved where the bottle is narrow.
        swell: 1 for the bottle, less for a flatter sheet with the same outline.
        neck_swell: The same at the neck's open edge, from the shoulder up on the way there; by default as below.
        inset: Distance by which the outline is drawn in [m].

    Returns:
        Positions (n, 3) [m] and triangles (m, 3) with outward normals.

    Raises:
        InputError: The parts of the bottle do not fit into each other, or the elements are too large for it.
    """
    shape.check()
    if not 0 < element_size <= 0.5 * shape.radius:
        remedy = f"use up to {0.5 * shape.radius:.4g} m"
        raise InputError("does not fit the bottle", remedy, "element_size", element_size)
    lift = _lift(shape)
    try:
        points, triangles, rim, top = _mesh_outline(shape, lambda at: element_size * _fineness(lift(at), shape), inset)
    except ValueError as error:
        raise InputError(f"too large: {error}", "make it smaller", "element_size", element_size) from None
    u, slope = np.split(lift(points), [1], axis=1)
    distance = np.linalg.norm(slope, axis=1)
    width = np.sqrt(2 * np.maximum(u[:, 0], 0.0) + distance**2)
    angle = 0.5 * np.pi * distance / width
    outwards = np.where(distance > 0, np.sin(angle) / np.where(angle > 0, 2 / np.pi * angle, 1.0), 0.5 * np.pi)
    share = swell + (_neck_fraction(points[:, 1], shape) * (neck_swell - swell) if neck_swell is not None else 0.0)
    height = share * width * np.cos(angle)
    place = points - slope * (share * (outwards - 1.0))[:, None]
    place[rim], height[rim] = points[rim], 0.0
    place[top, 1] = points[top, 1]
    return np.column_stack([place[:, 0], _flatten_bottom(place[:, 1], shape), height]), triangles


def _neck_fraction(y: Array, shape: Bottle) -> Array:
    """0 up to the shoulder, 1 from where the neck starts."""
    way = np.clip((y / shape.height - _SHOULDER) / (_NECK - _SHOULDER), 0.0, 1.0)
    return way**2 * (3.0 - 2.0 * way)


def _flatten_bottom(y: Array, shape: Bottle) -> Array:
    """The outline's lower end drawn up so that the round bottom becomes a flat one."""
    bent = _BOTTOM * shape.radius
    above = y + 0.5 * bent
    return np.where(above < bent, above**2 / (2 * bent), y)


def _fineness(lift: Array, shape: Bottle) -> Array:
    """1 in the body, 0.5 in narrow parts such as the handle."""
    width = np.sqrt(2 * np.maximum(lift[:, 0], 0.0) + (lift[:, 1:] ** 2).sum(1))
    return np.clip(width / (0.4 * shape.radius), 0.5, 1.0)


def _mesh_outline(shape: Bottle, size: planform.Size, inset: float) -> tuple[Array, NDArray, NDArray, NDArray]:
    """Points, triangles, and masks of the points on the outline and on the neck's open edge."""
    side = planform.resample(_side(shape, inset), size)
    top = planform.resample(side[[-1, 0]], size)[1:-1]
    hole = planform.resample(_hole(shape, inset), size)[:-1]
    points, triangles = planform.triangulate([np.concatenate([side, top]), hole], size)
    number = np.arange(len(points))
    on_top = (number >= len(side)) & (number < len(side) + len(top))
    on_rim = (number < len(side) + len(top) + len(hole)) & ~on_top
    return points, triangles, on_rim, on_top


def _side(shape: Bottle, inset: float) -> Array:
    """The outline but for the neck's edge, drawn in sideways and up."""
    x = np.array([shape.neck_radius if x is None else x * shape.radius for x, _ in _OUTLINE])
    x[-2:] *= -1.0
    # The shoulder is nowhere narrower than the neck.
    shoulder = np.array([y > _SHOULDER for _, y in _OUTLINE])
    x[shoulder] = np.sign(x[shoulder]) * np.maximum(np.abs(x[shoulder]), shape.neck_radius)
    handle = np.array([y > _HANDLE for _, y in _OUTLINE])
    x[handle] = np.minimum(x[handle], np.inf if shape.handle_edge is None else shape.handle_edge)
    y = np.array([y * (shape.height if y > 0 else shape.radius) for _, y in _OUTLINE])
    rank = np.concatenate([[0.0], np.cumsum(np.hypot(np.diff(x), np.diff(y)))])
    fine = np.linspace(0.0, rank[-1], _SAMPLES)
    curve = np.stack([PchipInterpolator(rank, along)(fine) for along in (x, y)], axis=1)
    return _offset_inward(curve, inset)


def _hole(shape: Bottle, inset: float) -> Array:
    angle = np.linspace(0.0, 2 * np.pi, _SAMPLES)
    # A superellipse: longer straight sides than an ellipse.
    c, s = (np.sign(part) * np.abs(part) ** 0.8 for part in (np.cos(angle), np.sin(angle)))
    x, y = (shape.hole[0] + inset) * c, (shape.hole[1] + inset) * s
    center = shape.middle_of_hole
    return np.stack([center[0] + x - _LEAN * y, center[1] + y], axis=1)


def _offset_inward(curve: Array, inset: float) -> Array:
    """A curve (n, 2), clockwise about the inside, moved to its right; its ends stay level."""
    along = np.gradient(curve, axis=0)
    along[[0, -1], 0] = 0.0
    normal = np.stack([along[:, 1], -along[:, 0]], axis=1)
    return curve + inset * normal / np.linalg.norm(normal, axis=1, keepdims=True)


@functools.lru_cache(maxsize=8)
def _lift(shape: Bottle) -> Callable[[Array], Array]:
    """U and its gradient, (n, 3), at points (n, 2) [m]; solved on a fine mesh of its own, whatever mesh asks."""
    size = shape.hole[0] / 3
    points, triangles, rim, _ = _mesh_outline(shape, lambda at: np.full(len(at), size), 0.0)
    u = _torsion(points, triangles, rim)
    gradient, area = _gradients(points, triangles)
    slope = np.einsum("kij,ik->ij", gradient, u[triangles])
    weight = np.bincount(triangles.ravel(), np.repeat(area, 3))
    nodal = [np.bincount(triangles.ravel(), np.repeat(area * slope[:, k], 3)) / weight for k in range(2)]
    return planform.interpolator(points, np.column_stack([u, *nodal]))


def _torsion(points: Array, triangles: NDArray, rim: NDArray) -> Array:
    """U with -div grad u = 1, 0 on the rim, by linear elements."""
    gradient, area = _gradients(points, triangles)
    i, j = (index.ravel() for index in np.meshgrid(range(3), range(3)))
    value = area * np.einsum("knd,knd->kn", gradient[i], gradient[j])
    matrix = coo_array((value.ravel(), (triangles.T[i].ravel(), triangles.T[j].ravel()))).tocsc()
    load = np.bincount(triangles.ravel(), np.repeat(area / 3, 3))
    u = np.zeros(len(points))
    free = np.flatnonzero(~rim)
    u[free] = np.asarray(spsolve(matrix[free][:, free], load[free]))
    return u


def _gradients(points: Array, triangles: NDArray) -> tuple[Array, Array]:
    """Gradients (3, m, 2) [1/m] of the shape functions and areas (m,) [m^2]."""
    corner = points[triangles]
    opposite = np.stack([corner[:, (k + 2) % 3] - corner[:, (k + 1) % 3] for k in range(3)])
    area = 0.5 * (opposite[0, :, 0] * opposite[1, :, 1] - opposite[0, :, 1] * opposite[1, :, 0])
    return np.stack([-opposite[..., 1], opposite[..., 0]], axis=2) / (2 * area[:, None]), area

"""Plugs that push a sheet into a cavity before the pressure: an offset of the cavity, or a user's mesh put before it.

All places are in the axes in which a cavity is viewed, with z from the plane in which the sheet is clamped, positive
into the cavity. On the host.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from jaxform.core.errors import InputError
from jaxform.mesh import outlines
from jaxform.mesh.meshes import Mesh
from jaxform.tools.opening import Opening

Array = NDArray[np.float64]

DEPTH, WIDTH = 0.8, 0.75
"""Depth to which a plug goes, and its width, as shares of the cavity's."""
_ROUNDING = 0.3  # of the plug's half width, the radius between its end and its side
_SHANK = 0.2  # of the depth, by which it reaches out of the cavity in the end
_ANGLES, _RINGS, _AROUND = 72, 14, 24
_GAP = 0.03  # of the depth, that is left between a user's plug and the mold
_LEAST = 0.1  # of the depth, that a plug goes at least


def offset_plug(found: Opening, clearance: float) -> tuple[Mesh, float]:
    """A plug in the shape of a cavity, narrower and less deep, with a rounded edge.

    Its outline keeps a distance of an eighth of the cavity's width from the cavity's, as seen from the widest place;
    its end is at `DEPTH` of the least depth within that distance, so that it is nowhere nearer to the mold.

    Args:
        found: The cavity.
        clearance: Distance [m] from the sheet at which it starts.

    Returns:
        Its surface, where it starts, and the way [m] that it goes into the cavity.
    """
    room = outlines.distance(found.cavity) * found.view.pixel
    off = (1.0 - WIDTH) * room.max()
    center = _middle(found, room)
    angle = 2 * np.pi * np.arange(_ANGLES) / _ANGLES
    way = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    reach = _reach(found, room, center, way, off)
    share = np.sin(np.linspace(0.0, 0.5 * np.pi, _RINGS + 1))[1:]
    # (ring, angle, 2); the middle is a point of its own.
    rings = center + share[:, None, None] * (reach[:, None] * way)
    places = np.concatenate([center[None], rings.reshape(-1, 2)])
    depth = DEPTH * _least_depth(found, places, off)
    rounding = np.minimum(_ROUNDING * reach, 0.5 * depth.max())
    inwards = rounding - np.minimum((1.0 - share[:, None]) * reach, rounding)
    lower = rounding - np.sqrt(np.maximum(np.square(rounding) - np.square(inwards), 0.0))
    z = np.maximum(depth - np.concatenate([[0.0], lower.ravel()]), 0.0)
    deepest, top = float(z.max()), -_SHANK * float(z.max())
    surface = np.column_stack([places, z])
    back = np.column_stack([rings[-1], np.full(_ANGLES, top)])
    vertices = np.concatenate([surface, back, [[*center, top]]])
    stroke = deepest + clearance
    return Mesh(vertices - [0.0, 0.0, stroke], _closed_rings(_RINGS + 1, _ANGLES), {}), stroke


def _middle(found: Opening, room: Array) -> Array:
    """The middle (2,) [m] of the places of a cavity that are farthest from its outline: a slot has many."""
    farthest = room >= room.max() * (1.0 - 1e-2)
    parts, _ = outlines.label_parts(farthest)
    places = found.view.places(parts == np.argmax(np.bincount(parts.ravel())[1:]) + 1)
    middle = places.mean(0)
    # The middle of a ring is none of its places.
    return places[int(np.argmin(np.linalg.norm(places - middle, axis=1)))]


def _reach(found: Opening, room: Array, center: Array, way: Array, off: float) -> Array:
    """Distances (n,) [m] from the middle, along ways (n, 2), to where the outline is nearer than an offset [m]."""
    step = 0.5 * found.view.pixel
    far = step * np.arange(1, int(2.0 * max(room.shape)) + 1)
    free = found.view.sample(room, (center + far[:, None, None] * way).reshape(-1, 2)).reshape(len(far), -1) >= off
    reach = np.asarray(far[np.argmin(free, axis=0)] - step, float)
    # Pixels make a jagged outline: a mean of neighbours, of which none is farther than it may be.
    least = np.min([np.roll(reach, k) for k in (-1, 0, 1)], axis=0)
    return np.asarray(np.mean([np.roll(least, k) for k in (-1, 0, 1)], axis=0), np.float64)


def _least_depth(found: Opening, places: Array, off: float) -> Array:
    """The least depth (n,) [m] of a cavity within a distance [m] of places (n, 2) [m]."""
    angle = 2 * np.pi * np.arange(_AROUND) / _AROUND
    around = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    beside = np.concatenate([[[0.0, 0.0]], 0.5 * off * around, off * around])
    return np.min([_depth(found, places + shift) for shift in beside], axis=0)


def _depth(found: Opening, places: Array) -> Array:
    """The depth (n,) [m] of a cavity at places (n, 2) [m]; 0 beside it, and its whole depth in holes."""
    depth = np.where(found.cavity, np.minimum(found.view.height - found.level, found.depth), 0.0)
    return found.view.sample(depth, places)


def _closed_rings(rings: int, count: int) -> NDArray[np.int32]:
    """Triangles of a first vertex, rings of vertices about it, and a last vertex that closes the last ring."""
    here = np.arange(count)
    there = (here + 1) % count
    fan = np.stack([np.zeros(count, int), 1 + here, 1 + there], axis=1)
    bands = [fan]
    for ring in range(rings - 1):
        one, other = 1 + ring * count, 1 + (ring + 1) * count
        bands.append(np.stack([one + here, other + here, other + there], axis=1))
        bands.append(np.stack([one + here, other + there, one + there], axis=1))
    last = 1 + (rings - 1) * count
    bands.append(np.stack([last + there, last + here, np.full(count, 1 + rings * count)], axis=1))
    return np.concatenate(bands).astype(np.int32)


def place_plug(mesh: Mesh, found: Opening, clearance: float) -> tuple[float, Array]:
    """The stroke of a user's plug: from its own place, or from the middle of the cavity if it is beside the cavity.

    It goes to `DEPTH` of the cavity's depth, or less far, where it would meet the mold.

    Args:
        mesh: The plug, in the axes of the view, z from the clamp plane.
        found: The cavity.
        clearance: Distance [m] from the sheet at which it starts.

    Returns:
        The way [m] that it goes into the cavity, and the translation (3,) [m] to where it starts.

    Raises:
        InputError: It does not fit into the cavity.
    """
    used = mesh.positions[np.unique(mesh.triangles)]
    low, high = used.min(0), used.max(0)
    middle = 0.5 * (low + high)[:2]
    shift = np.array([0.0, 0.0, -clearance - high[2]])
    if not found.view.sample(found.cavity, middle[None])[0]:
        shift[:2] = _middle(found, outlines.distance(found.cavity)) - middle
    points = np.concatenate([used, mesh.positions[mesh.triangles].mean(1)]) + shift
    free = _depth(found, points[:, :2]) - points[:, 2] - _GAP * found.depth
    stroke = min(DEPTH * found.depth + clearance, float(free.min()))
    if stroke < _LEAST * found.depth:
        sides = " x ".join(f"{1e3 * side:.3g}" for side in high - low)
        problem = (
            f"does not fit into the cavity: it is {sides} mm large, of which {1e3 * max(stroke, 0.0):.2g} mm go in"
        )
        remedy = "give it in the axes and units of the mold's file, with its end towards the bottom, or --plug auto"
        raise InputError(problem, remedy)
    return stroke, shift

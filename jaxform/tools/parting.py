"""The land of a mold half: the flat face around its cavity, in the parting plane, between which the sheet is pinched.

On the host.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from jaxform.core.errors import InputError
from jaxform.mesh import meshes, topology
from jaxform.tools.kinds import Plane
from jaxform.tools.molds import MoldShape

Array = NDArray[np.float64]

_FLAT = 1e-6  # of the mold's size: vertices that are as near to a plane lie in it
_RIM = 0.5  # of the length of the open edges, that lies in the parting plane at least
_BEYOND = 1e-3  # of the land's size: what reaches less far beyond it lies on it
_LEAST = 1e-9  # of the land's area: a smaller piece comes from rounding


def find_parting_plane(shape: MoldShape) -> Plane:
    """The plane across x, y or z in which most of the open edges of a mold half lie.

    Raises:
        InputError: The mold has no open edge, or less than half of their length is in such a plane.
    """
    edges = topology.boundary_edges(shape.triangles)
    used = shape.vertices[np.unique(shape.triangles)]
    near, best = _FLAT * meshes.size(used), (0.0, (0, 0.0))
    ends = shape.vertices[edges]
    length = np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1)
    for axis in range(3):
        for level in (used[:, axis].min(), used[:, axis].max()):
            there = (np.abs(ends[..., axis] - level) <= near).all(1)
            best = max(best, (float(length[there].sum()), (axis, float(level))), key=lambda each: each[0])
    if not len(edges) or best[0] < _RIM * length.sum():
        raise InputError(
            "needs a mold half that is open in a plane across x, y or z",
            "give one half, cut in the parting plane (rotate turns it), or leave the land out",
            "mold.land",
        )
    return best[1]


def add_land(shape: MoldShape, width: float) -> tuple[MoldShape, int]:
    """A mold half with its land: the flat face in the parting plane around the cavity and in the holes of its outline.

    The land is a rectangle that is wider by `width` than the cavity on all sides, but for that on which the cavity is
    open between ends of its edge in the plane, as at a bottle's neck. It shares the vertices of the cavity's edge.

    Args:
        shape: The mold half, open in a plane across x, y or z.
        width: Width of the land [m].

    Returns:
        The mold half with the land's triangles last, and their number.

    Raises:
        InputError: The mold is not open in such a plane, or its edge there crosses itself.
    """
    import shapely  # takes a tenth of a second to import

    plane = find_parting_plane(shape)
    across = [axis for axis in range(3) if axis != plane[0]]
    corners = shape.vertices[:, across]
    loops, openings = _outlines(shape, plane)
    cavity = shapely.Polygon()
    for loop in loops:
        outline = shapely.Polygon(corners[loop])
        if not outline.is_valid:
            raise InputError("needs a cavity whose edge does not cross itself", "repair the mesh", "mold.land", width)
        cavity = cavity.symmetric_difference(outline)
    low, high = np.array(cavity.bounds).reshape(2, 2)
    # Its sides are divided, so that the triangles are not all as long as the land.
    land = shapely.segmentize(shapely.box(*(low - width), *(high + width)), width).difference(cavity)
    for ends in openings:
        land = land.difference(_before_opening(corners[ends], cavity, float(np.ptp([low, high])) + 2 * width))
    pieces = [piece for piece in shapely.get_parts(land) if piece.area > _LEAST * land.area]
    triangles = shapely.get_parts(shapely.constrained_delaunay_triangles(pieces)) if pieces else []
    triangles = shapely.get_parts(np.asarray(triangles))
    flat = shapely.get_coordinates(triangles).reshape(-1, 4, 2)[:, :3]
    return _join(shape, plane, flat)


def find_beyond_land(points: Array, vertices: Array, land: NDArray[np.integer]) -> NDArray[np.bool_]:
    """Mask (n,) of the points (n, 3) [m] that lie beyond a land, seen along the normal of its plane.

    Args:
        points: The points.
        vertices: Vertices (k, 3) [m] of the mold half.
        land: The triangles (m, 3) of its land, all in a plane across an axis; others are no land: the mask is empty.
    """
    places = vertices[np.unique(land)]
    sides = np.ptp(places, axis=0)
    across, near = np.arange(3) != int(np.argmin(sides)), _BEYOND * sides.max()
    if sides.min() > near:
        return np.zeros(len(points), bool)
    low, high = places.min(0) - near, places.max(0) + near
    return ((points < low) | (points > high))[:, across].any(1)


def _outlines(shape: MoldShape, plane: Plane) -> tuple[list[NDArray[np.int64]], list[NDArray[np.int64]]]:
    """The closed loops (k,) of vertices of the cavity's edge in the plane, and the two ends (2,) of each opening.

    A chain of edges that leaves the plane, as at a neck, is closed by the straight line between its ends.
    """
    edges = topology.boundary_edges(shape.triangles)
    near = _FLAT * meshes.size(shape.vertices[np.unique(shape.triangles)])
    axis, level = plane
    there = (np.abs(shape.vertices[edges][..., axis] - level) <= near).all(1)
    beside: dict[int, list[int]] = {}
    for one, other in edges[there].tolist():
        beside.setdefault(one, []).append(other)
        beside.setdefault(other, []).append(one)
    if any(len(each) > 2 for each in beside.values()):
        raise InputError("needs a cavity whose edge does not touch itself", "repair the mesh", "mold.land")
    loops, openings, left = [], [], set(beside)
    starts = [vertex for vertex, each in beside.items() if len(each) == 1]
    for start in [*starts, *beside]:
        if start not in left:
            continue
        chain = [start]
        left.discard(start)
        while following := [vertex for vertex in beside[chain[-1]] if vertex in left]:
            chain.append(following[0])
            left.discard(following[0])
        if len(beside[start]) == 1:
            openings.append(np.array([chain[0], chain[-1]]))
        loops.append(np.array(chain))
    return loops, openings


def _before_opening(ends: Array, cavity, far: float):
    """The strip before an opening between two ends (2, 2) [m], away from the cavity; all of that side where it ends."""
    import shapely

    width = np.linalg.norm(ends[1] - ends[0])
    along = (ends[1] - ends[0]) / width
    normal = np.array([-along[1], along[0]])
    if cavity.contains(shapely.Point(ends.mean(0) + 1e-3 * width * normal)):
        normal = -normal
    beyond = (shapely.get_coordinates(cavity) - ends[0]) @ normal
    beside = far if beyond.max() <= _FLAT * far else 0.0
    first, last = ends[0] - beside * along, ends[1] + beside * along
    return shapely.Polygon([first, last, last + far * normal, first + far * normal])


def _join(shape: MoldShape, plane: Plane, flat: Array) -> tuple[MoldShape, int]:
    """The mold with triangles (n, 3, 2) [m] in the plane, which share its vertices."""
    places = np.insert(flat.reshape(-1, 2), *plane, axis=1)
    vertices = np.concatenate([shape.vertices, places])
    triangles = len(shape.vertices) + np.arange(len(places)).reshape(-1, 3)
    _, index = np.unique(vertices, axis=0, return_inverse=True)
    # Each place has the number of the first vertex that lies there.
    first = np.full(index.max() + 1, len(vertices))
    np.minimum.at(first, index, np.arange(len(vertices)))
    triangles = first[index[triangles]]
    triangles = triangles[~meshes.find_degenerate(vertices, triangles)]
    joined = np.concatenate([shape.triangles, triangles]).astype(np.int32)
    kept, renumbered = np.unique(joined, return_inverse=True)
    return MoldShape(vertices[kept], renumbered.reshape(-1, 3).astype(np.int32), shape.dropped), len(triangles)

"""Sharp edges of a tool: where two of its triangles meet at an angle. On the host."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

SHARPEST_FACETS = 30.0  # degrees: facets of a round surface turn by less from one to the next


def sharp_edges(vertices: NDArray[np.floating], triangles: NDArray[np.integer]) -> NDArray[np.int32]:
    """The edges at which the surface turns by more than the limit, (4, n_edge).

    Of each the vertices at its ends, then the third vertex of either triangle. Edges of one triangle, as along the rim
    of an open mold, and of more than two are not among them.

    Args:
        vertices: Vertices (n_vertex, 3) [m].
        triangles: Their numbers (n_triangle, 3), of either orientation.
    """
    corners = np.asarray(vertices, float)
    faces = np.asarray(triangles, np.int64)
    begin, end, third = (np.roll(faces, -k, axis=1).ravel() for k in range(3))
    low, high = np.minimum(begin, end), np.maximum(begin, end)
    _, place, each = np.unique(low * (int(faces.max(initial=0)) + 1) + high, return_inverse=True, return_counts=True)
    order = np.argsort(place, kind="stable")
    first = np.concatenate([[0], np.cumsum(each)[:-1]])[each == 2].astype(np.int64)
    one, other = order[first], order[first + 1]
    a, b = low[one], high[one]
    found = np.stack([a, b, third[one], third[other]])
    along = corners[b] - corners[a]
    along /= np.maximum(np.linalg.norm(along, axis=1), 1e-300)[:, None]
    # The faces' directions away from the edge: opposite to each other where the surface is flat.
    ways = [corners[c] - corners[a] for c in found[2:]]
    ways = [way - np.einsum("ij,ij->i", way, along)[:, None] * along for way in ways]
    sizes = [np.maximum(np.linalg.norm(way, axis=1), 1e-300) for way in ways]
    cosine = -np.einsum("ij,ij->i", *ways) / (sizes[0] * sizes[1])
    return found[:, cosine < np.cos(np.radians(SHARPEST_FACETS))].astype(np.int32)

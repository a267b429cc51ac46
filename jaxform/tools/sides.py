"""Nodes of a sheet that are beyond the mold. On the host.

A path inside an element from one place to another changes sides as often as it crosses the mold. Nodes in contact with
the mold are on the side from which they came; from them sides are propagated over the sheet, node by node.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from jaxform.mesh import topology
from jaxform.mesh.rows import unique_ascending
from jaxform.tools.crossings import crosses, intersect, near_pairs
from jaxform.tools.search import SearchGrid

Array = NDArray[np.float64]
Integers = NDArray[np.integer]

_APART = 1e-7  # of an element, how far inside it a way begins: it may end at an edge of the mold, but not run along it
_CHUNK = 300_000  # paths and triangles processed together


def nodal_normals(positions: Array, triangles: Integers) -> Array:
    """Sums (n_node, 3) [m^2] of the normals of the elements round each node, each twice as long as its area."""
    corners = positions[triangles]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    return np.stack([np.bincount(triangles.ravel(), np.repeat(part, 3), len(positions)) for part in normal.T], axis=1)


def contact_normals(wall: Integers, mold_corners: Array) -> Array:
    """Unit normals (n, 3) of the mold, on the side from which nodes came that stick to `wall` (n,), nowhere 0."""
    corners = mold_corners[np.abs(wall) - 1]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    return normal * (np.sign(wall) / np.linalg.norm(normal, axis=1))[:, None]


class Ways:
    """Paths inside the elements that the mold cuts.

    Attributes:
        element: The elements (n_cut,), in order.
        triangles: Their nodes (n_cut, 3).
    """

    def __init__(self, triangles: Integers, corners: Array, mold_corners: Array, grid: SearchGrid) -> None:
        """Finds the elements, with corners (n_element, 3, 3) [m], that the mold cuts."""
        keys = [np.zeros(0, np.int64)]
        for element, triangle in near_pairs(corners, mold_corners, grid):
            cut = intersect(corners[element], mold_corners[triangle])
            keys.append(element[cut] * len(mold_corners) + triangle[cut])
        element, self._triangle = np.divmod(unique_ascending(np.concatenate(keys)), len(mold_corners))
        self.element, self._first, self._count = np.unique(element, return_index=True, return_counts=True)
        self.triangles, self._mold_corners = triangles[self.element], mold_corners
        self._corners = corners[self.element]
        inside = np.random.default_rng(0).uniform(0.1, 1.0, (len(self.element), 3, 3))
        inside /= inside.sum(2, keepdims=True)
        self._begin = self._corners + _APART * (np.einsum("esc,eck->esk", inside, self._corners) - self._corners)

    def pairs(self) -> tuple[Integers, Integers]:
        """All pairs of a cut element, as in `element`, and a triangle of the mold that cuts it, element by element."""
        return np.repeat(np.arange(len(self.element)), self._count), self._triangle

    def cross_oddly(self, row: Integers, shares: Array) -> NDArray[np.bool_]:
        """True where paths cross the mold an odd number of times.

        Args:
            row: Cut elements (n,), as in `element`.
            shares: Shares of their corners in the places where paths end (p, 3).

        Returns:
            Mask (n, 3, p) of the paths from each of the three corners to each place.
        """
        ends = np.einsum("pc,nck->npk", shares, self._corners[row])
        count = self._count[row]
        owner = np.repeat(np.arange(len(row)), count)
        pair = np.repeat(self._first[row] - np.cumsum(count) + count, count) + np.arange(len(owner))
        result = np.zeros((len(row), 3, len(shares)), np.int64)
        for part in np.array_split(np.arange(len(owner)), 1 + len(owner) * 3 * len(shares) // _CHUNK):
            one, corner, place = (
                index.ravel() for index in np.meshgrid(part, range(3), range(len(shares)), indexing="ij")
            )
            element = owner[one]
            begin, end = self._begin[row[element], corner], ends[element, place]
            met = crosses(begin, end, self._mold_corners[self._triangle[pair[one]]])
            np.add.at(result, (element[met], corner[met], place[met]), 1)
        return result % 2 == 1


def penetrating_nodes(
    triangles: Integers, ways: Ways, landed: NDArray[np.bool_], trust: NDArray[np.floating]
) -> NDArray[np.bool_]:
    """Mask (n_node,) of the nodes that are beyond the mold.

    Args:
        triangles: The sheet's elements (n_element, 3).
        ways: Paths inside the elements that the mold cuts.
        landed: Nodes (n_node,) in contact with the mold, on the side from which they came. Where there are none, most
            of the sheet is on its right side.
        trust: Weights of the nodes in the vote on their neighbours' side (n_node,).
    """
    edge, weight = _sides_of_edges(triangles, ways, landed)
    if not np.any(weight < 0):
        return np.zeros(len(landed), bool)
    from scipy.sparse import coo_array

    count = len(landed)
    rows, columns = np.concatenate([edge[:, 0], edge[:, 1]]), np.concatenate([edge[:, 1], edge[:, 0]])
    graph = coo_array((np.concatenate([weight, weight]), (rows, columns)), shape=(count, count)).tocsr()
    side = np.where(landed | _majority_side(edge, weight, landed), trust, 0.0)
    unknown = np.flatnonzero(side == 0)
    while len(unknown):
        # A node is on the side of most of its neighbours that are known.
        told = np.sign((graph @ side)[unknown])
        if not told.any():
            break
        side[unknown] = told * trust[unknown]
        unknown = unknown[told == 0]
    return side < 0


def _sides_of_edges(triangles: Integers, ways: Ways, landed: NDArray[np.bool_]) -> tuple[NDArray[np.int64], Array]:
    """Edges (n, 2) of the sheet, and 1 (n,) where both ends are on one side of the mold, -1 where not, 0 unknown."""
    edge, _ = topology.edges(triangles)
    total, asked = np.zeros(len(edge)), np.zeros(len(edge), bool)
    # Edges between nodes in contact add no information.
    row = np.flatnonzero(~landed[ways.triangles].all(1))
    odd = ways.cross_oddly(row, np.eye(3))
    name = np.array([len(landed), 1], np.int64)
    known = edge @ name
    for k in range(3):
        for other in ((k + 1) % 3, (k + 2) % 3):
            ends = np.sort(ways.triangles[row][:, [k, other]], axis=1) @ name
            place = np.searchsorted(known, ends)
            np.add.at(total, place, np.where(odd[:, k, other], -1.0, 1.0))
            asked[place] = True
    return edge, np.where(asked, np.sign(total), 1.0)


def _majority_side(edge: NDArray[np.int64], weight: Array, landed: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Mask (n_node,) of the largest group on one side of the mold, in each part of the sheet without contact."""
    count = len(landed)
    part = topology.connected_parts(edge[:, 0], edge[:, 1], count)
    one, other = edge[weight > 0].T
    together = topology.connected_parts(one, other, count)
    rank = np.bincount(together, minlength=count)[together] * count - together  # of two as large, one
    most = np.zeros(count, np.int64)
    np.maximum.at(most, part, rank)
    elsewhere = np.ones(count, bool)
    elsewhere[part[landed]] = False
    return elsewhere[part] & (rank == most[part])

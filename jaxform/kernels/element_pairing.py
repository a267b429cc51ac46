"""Elements in pairs that share an edge: four nodes are looked up for two elements, where each by itself needs three."""

from __future__ import annotations

import numpy as np


def pair_elements(triangles: np.ndarray) -> np.ndarray:
    """Pairs (2, n_pair) of elements that share an edge; -1 for the second of one that is left over.

    Whoever has one neighbour left is paired first, so that few are left over; else an element takes the neighbour with
    the fewest others, and of these the one with the nearest number.

    Args:
        triangles: Node numbers (n_element, 3).
    """
    beside = _neighbors(triangles)
    left, partner = [len(others) for others in beside], [-1] * len(beside)
    lonely, rest = [e for e, count in enumerate(left) if count == 1], iter(range(len(beside)))
    while (element := lonely.pop() if lonely else next(rest, None)) is not None:
        if partner[element] >= 0:
            continue
        free = [other for other in beside[element] if partner[other] < 0]
        ranked = [(left[other], abs(other - element), other) for other in free]
        other = min(ranked)[2] if ranked else element
        partner[element], partner[other] = other, element
        for taken in {element, other}:
            for near in beside[taken]:
                left[near] -= 1
                if left[near] == 1 and partner[near] < 0:
                    lonely.append(near)
    second = np.asarray(partner)
    first = np.flatnonzero(second >= np.arange(len(second)))
    return np.stack([first, np.where(second[first] == first, -1, second[first])])


def _neighbors(triangles: np.ndarray) -> list[list[int]]:
    """Elements that share an edge with each; where more than two share one, some of them."""
    count = len(triangles)
    ends = np.sort(np.concatenate([triangles[:, [k, (k + 1) % 3]] for k in range(3)]), axis=1).astype(np.int64)
    name = ends[:, 1] * (int(ends.max(initial=0)) + 1) + ends[:, 0]
    order = np.argsort(name, kind="stable")
    same = np.flatnonzero(name[order[1:]] == name[order[:-1]])
    both = np.stack([order[same] % count, order[same + 1] % count], axis=1)
    both = both[both[:, 0] != both[:, 1]]
    own, others = both.ravel(), both[:, ::-1].ravel()
    by_owner = np.argsort(own, kind="stable")
    listed, end = others[by_owner].tolist(), np.cumsum(np.bincount(own, minlength=count)).tolist()
    return [listed[begin:stop] for begin, stop in zip([0, *end[:-1]], end, strict=True)]


def rotate_to_common_edge(triangles: np.ndarray, pairs: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The elements' nodes (n_element, 3) in such an order that those of a pair begin with their common edge.

    And for each element whether its order is still that of its normal, 1, or has been reversed, -1.
    """
    corners, sign = triangles.copy(), np.ones(len(triangles))
    one, other = pairs[:, pairs[1] >= 0]
    apex, beyond = (_opposite_corner(triangles[a], triangles[b]) for a, b in ((one, other), (other, one)))
    for element, place in ((one, apex), (other, beyond)):
        at = place[:, None] + np.array([1, 2, 3])
        corners[element] = np.take_along_axis(triangles[element], at % 3, axis=1)
    against = corners[one, 0] != corners[other, 0]
    flipped = other[against]
    corners[flipped] = corners[flipped][:, [1, 0, 2]]
    sign[flipped] = -1.0
    return corners, sign


def _opposite_corner(own: np.ndarray, others: np.ndarray) -> np.ndarray:
    """The corner (n,) of triangles (n, 3) whose node is none of the others' (n, 3)."""
    return np.argmin((own[:, :, None] == others[:, None, :]).any(axis=2), axis=1)

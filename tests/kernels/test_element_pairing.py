"""Elements in pairs that share an edge."""

from __future__ import annotations

import numpy as np
import pytest

from jaxform import shapes
from jaxform.sheet import packing

pytestmark = pytest.mark.quick

STRIP = np.array([[0, 1, 2], [1, 3, 2], [2, 3, 4], [3, 5, 4], [4, 5, 6]])
FAN = np.array([[0, 1, 2], [0, 1, 3], [0, 1, 4], [5, 6, 7]])  # three at one edge, and one apart


def meshes() -> list[np.ndarray]:
    disc = shapes.disc(radius=1.0, elements=300).triangles
    mixed = disc[np.random.default_rng(0).permutation(len(disc))]
    mixed[::3] = mixed[::3, ::-1]
    return [STRIP, FAN, disc, mixed, shapes.rectangle(size=(1.0, 1.0), elements=200).triangles]


@pytest.mark.parametrize("triangles", meshes())
def test_every_element_is_in_one_pair_and_pairs_begin_with_their_common_edge(triangles: np.ndarray) -> None:
    pairs = packing.pair_elements(triangles)
    np.testing.assert_array_equal(np.sort(pairs[pairs >= 0]), np.arange(len(triangles)))
    corners, turn = packing.rotate_to_common_edge(triangles, pairs)
    np.testing.assert_array_equal(np.sort(corners, axis=1), np.sort(triangles, axis=1))
    one, other = pairs[:, pairs[1] >= 0]
    np.testing.assert_array_equal(corners[one, :2], corners[other, :2])
    assert np.all(corners[one, 2] != corners[other, 2])
    # An element that is not reversed is only rotated.
    for own, now, sign in zip(triangles, corners, turn, strict=True):
        order = [list(own).index(node) for node in now]
        assert sign == (1.0 if order in ([0, 1, 2], [1, 2, 0], [2, 0, 1]) else -1.0)


@pytest.mark.parametrize(("triangles", "most"), list(zip(meshes(), [1, 2, 6, 6, 0], strict=True)))
def test_few_elements_are_left_over(triangles: np.ndarray, most: int) -> None:
    assert np.count_nonzero(packing.pair_elements(triangles)[1] < 0) <= most

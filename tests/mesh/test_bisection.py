"""The forest: whatever is marked, the mesh has no hanging node, keeps its area, and its angles stay wide."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import Delaunay

from jaxform import shapes
from jaxform.adapt.element_bisection import Queue, close_queue
from jaxform.core.errors import InputError
from jaxform.mesh import bisection, topology
from jaxform.mesh.bisection import TriangleForest
from jaxform.sheet.discretization import NEVER

pytestmark = pytest.mark.quick

DEPTH = 4


def random_mesh(seed: int, count: int) -> tuple[np.ndarray, np.ndarray]:
    """A square with points inside at random, none of its triangles a sliver."""
    random = np.random.default_rng(seed)
    rim = np.linspace(0, 1, 4)
    corners = np.array([(x, y) for x in rim for y in rim if min(x, y) == 0 or max(x, y) == 1])
    inside = [corners]
    while sum(map(len, inside)) < len(corners) + count:
        point = random.uniform(0.1, 0.9, (1, 2))
        if np.linalg.norm(np.concatenate(inside) - point, axis=1).min() > 0.5 / np.sqrt(count + 12):
            inside.append(point)
        count -= 1 if random.uniform() < 0.05 else 0
    points = np.concatenate(inside)
    triangles = Delaunay(points).simplices
    u, w = points[triangles[:, 1]] - points[triangles[:, 0]], points[triangles[:, 2]] - points[triangles[:, 0]]
    flat = u[:, 0] * w[:, 1] - u[:, 1] * w[:, 0]
    triangles = np.where((flat < 0)[:, None], triangles[:, ::-1], triangles)[np.abs(flat) > 1e-9]
    return np.column_stack([points, np.zeros(len(points))]), triangles


def parents(forest: TriangleForest) -> np.ndarray:
    index, roots = np.arange(len(forest.triangles)), forest.root_count
    return np.where(index < roots, index, (index - roots) // 2)


def plain_closure(split: np.ndarray, forest: TriangleForest) -> np.ndarray:
    """One triangle after the other, from the definition."""
    split, todo = split.copy(), np.flatnonzero(split).tolist()
    parent = parents(forest)
    while todo:
        triangle = todo.pop()
        for other in (forest.partner[triangle], parent[triangle]):
            if not split[other]:
                split[other] = True
                todo.append(other)
    return split


def active_of(split: np.ndarray, forest: TriangleForest) -> np.ndarray:
    return (split[parents(forest)] | (np.arange(len(split)) < forest.root_count)) & ~split


def marked_mesh(forest: TriangleForest, seed: int, rounds: int) -> np.ndarray:
    random, split = np.random.default_rng(seed), np.zeros(len(forest.triangles), bool)
    for _ in range(rounds):
        active = active_of(split, forest)
        marks = active & (random.uniform(size=len(split)) < random.choice([0.05, 0.3])) & (forest.middle >= 0)
        split = plain_closure(split | marks, forest)
    return split


def areas(positions: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    a, b, c = np.moveaxis(positions[triangles], 1, 0)
    return 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1)


def least_angle(positions: np.ndarray, triangles: np.ndarray) -> float:
    corners = positions[triangles]
    sides = np.roll(corners, -1, axis=1) - corners
    length = np.linalg.norm(sides, axis=2)
    cosine = -np.einsum("tkc,tkc->tk", sides, np.roll(sides, 1, axis=1)) / (length * np.roll(length, 1, axis=1))
    return float(np.degrees(np.arccos(np.clip(cosine, -1, 1))).min())


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 10**6), st.integers(0, 12), st.integers(1, 8))
def test_any_marks_give_a_conforming_mesh(seed: int, count: int, rounds: int) -> None:
    positions, triangles = random_mesh(seed, count)
    forest = bisection.build_forest(positions, triangles, DEPTH)
    split = marked_mesh(forest, seed, rounds)
    assert not split[forest.middle < 0].any()  # an even depth suffices
    active = active_of(split, forest)
    mesh = forest.triangles[active]
    used = np.unique(mesh)
    # No node hangs: no used node is the middle of a side of the mesh.
    sides = {tuple(side) for side in topology.edges(mesh)[0].tolist()}
    ends = np.sort(forest.ends[used], axis=1)
    assert not any(tuple(pair) in sides for pair in ends.tolist() if pair[0] != pair[1])
    assert not len(topology.nonmanifold_edges(mesh)) and not len(topology.inconsistent_edges(mesh))
    assert areas(forest.positions, mesh).sum() == pytest.approx(areas(positions, triangles).sum(), rel=1e-12)
    assert least_angle(forest.positions, mesh) >= 0.5 * least_angle(positions, triangles) - 1e-6
    # At every node the triangles in use have different slots.
    slots = mesh.ravel() * 1000 + forest.corner_slots[active].ravel()
    assert len(np.unique(slots)) == slots.size
    # Half edges pair up neighbours, and what is left is the boundary.
    half = forest.half_edges[active].ravel()
    alone = np.sort(np.stack([mesh, np.roll(mesh, -1, axis=1)], 2).reshape(-1, 2)[~np.isin(half ^ 1, half)], axis=1)
    np.testing.assert_array_equal(np.unique(alone, axis=0), topology.boundary_edges(mesh))


def test_closure_in_the_program_is_the_plain_one_and_does_not_depend_on_the_order() -> None:
    positions, triangles = random_mesh(3, 8)
    forest = bisection.build_forest(positions, triangles, DEPTH)
    random = np.random.default_rng(0)
    number = np.arange(len(forest.triangles))

    @jax.jit
    def close(marks: jax.Array, split: jax.Array) -> tuple[jax.Array, Queue]:
        split_at = jnp.where(split, 0, NEVER)
        return close_queue(split_at, jnp.where(marks, number, NEVER), jnp.int32(number.size), forest, jnp.int32(7))

    for _ in range(20):
        split = marked_mesh(forest, int(random.integers(10**6)), 3)
        marks = active_of(split, forest) & (random.uniform(size=len(split)) < 0.1) & (forest.middle >= 0)
        expected = plain_closure(split | marks, forest)
        split_at, queue = close(jnp.asarray(marks), jnp.asarray(split))
        np.testing.assert_array_equal(split_at, np.where(split, 0, np.where(expected, 7, NEVER)))
        new = np.flatnonzero(expected & ~split)
        np.testing.assert_array_equal(queue.triangle[: int(queue.count)], new)
        assert int(queue.count) == len(new) and int(queue.node_count) == len(np.unique(forest.middle[new]))
        one_by_one = split
        for triangle in random.permutation(np.flatnonzero(marks)):
            one_by_one = plain_closure(one_by_one | (np.arange(len(split)) == triangle), forest)
        np.testing.assert_array_equal(one_by_one, expected)


def test_children_halve_their_parent_and_nodes_know_their_edge() -> None:
    positions, triangles = random_mesh(1, 6)
    forest = bisection.build_forest(positions, triangles, DEPTH)
    area, inner = areas(forest.positions, forest.triangles), np.flatnonzero(forest.middle >= 0)
    children = 2 * inner + forest.root_count
    np.testing.assert_allclose(area[children], 0.5 * area[inner], rtol=1e-12)
    np.testing.assert_allclose(area[children + 1], 0.5 * area[inner], rtol=1e-12)
    np.testing.assert_array_equal(np.bincount(forest.level()), len(triangles) << np.arange(DEPTH + 1))
    np.testing.assert_array_equal(np.sort(forest.ends[forest.middle[inner]]), np.sort(forest.triangles[inner, 1:]))
    np.testing.assert_array_equal(forest.partner[forest.partner], np.arange(len(area)))
    values = forest.positions[: len(positions)] @ [1.0, 2.0, 3.0]
    extended = bisection.extend_values(values, forest.ends, forest.depth)
    np.testing.assert_allclose(extended, forest.positions @ [1.0, 2.0, 3.0], atol=1e-12)


def test_a_disc_s_rim_stays_round_clamped_and_on_its_planes() -> None:
    sheet = shapes.disc(radius=0.1, elements=27, symmetry="quarter")
    forest = bisection.build_forest(
        sheet.positions, sheet.triangles, 4, clamped=sheet.clamped, fixed=sheet.fixed, snap=sheet.snap
    )
    radius = np.hypot(*forest.positions[:, :2].T)
    assert forest.clamped.sum() > 3 * sheet.clamped.sum()
    np.testing.assert_allclose(radius[forest.clamped], 0.1, rtol=1e-12)
    assert radius[~forest.clamped].max() < 0.0999
    for axis in range(2):
        np.testing.assert_array_equal(forest.fixed[:, axis], forest.positions[:, axis] == 0)


def test_what_is_clamped_as_a_whole_stays_so() -> None:
    positions = np.array([[x, y, 0.0] for x in range(4) for y in range(2)])
    cell = np.array([[0, 2, 3], [0, 3, 1]])
    triangles = np.concatenate([cell + 2 * k for k in range(3)])
    clamped = np.zeros(8, bool)
    clamped[:6] = True  # two cells of three: the free nodes are those at x = 3
    forest = bisection.build_forest(positions, triangles, 2, clamped=clamped)
    x = forest.positions[:, 0]
    assert forest.clamped[x <= 2].all() and not forest.clamped[x > 2].any()


def test_a_mesh_that_cannot_be_refined_is_refused() -> None:
    positions = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1.0]])
    with pytest.raises(InputError, match="more than two"):
        bisection.build_forest(positions, np.array([[0, 1, 2], [1, 0, 3], [0, 1, 4]]), 2)
    with pytest.raises(InputError, match="opposite"):
        bisection.build_forest(positions, np.array([[0, 1, 2], [0, 1, 3]]), 2)
    with pytest.raises(InputError, match="would have") as caught:
        bisection.build_forest(positions, np.array([[0, 1, 2]]), 30)
    assert caught.value.key == "refinement.max_level"

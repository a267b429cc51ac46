"""Sticking contact against a brute-force oracle, and the places where it could leak."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxform
from jaxform import contact, molds
from jaxform import near as nearness
from jaxform.mold import Mold
from jaxform.penetration import point_triangle_distance
from jaxform.search import SearchGrid, build_grid


def _shape(name: str) -> Mold:
    if name == "cup":
        shape = molds.revolved(profile=[[0.0, 1.0], [0.7, 1.0], [1.0, 0.0]], segments=24)
    elif name == "ribs":
        shape = molds.revolved(
            profile=[[0.0, 1.0], [0.3, 1.0], [0.31, 0.6], [0.4, 0.6], [0.41, 1.0], [0.9, 1.0], [1.0, 0.0]],
            segments=40,
        )
    else:
        corners = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], float)
        faces = [[0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1], [2, 3, 7], [2, 7, 6]]
        return jaxform.make_mold(corners, np.array(faces))
    return jaxform.make_mold(shape.vertices, shape.triangles)


def _oracle(begin: np.ndarray, end: np.ndarray, wall: Mold) -> np.ndarray:
    """Least beta (n,) over all triangles, infinite where none is met."""
    corners = np.asarray(wall.vertices)[np.asarray(wall.triangles)]
    d, edge1, edge2 = corners[:, 0], corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    least = np.full(len(begin), np.inf)
    for k in range(len(begin)):
        # Eq. 11: beta NN' + gamma DE + delta DF = DN', with N' the begin and N the end.
        matrix = np.stack([np.broadcast_to(begin[k] - end[k], d.shape), edge1, edge2], axis=2)
        solvable = np.abs(np.linalg.det(matrix)) > 1e-14
        beta, gamma, delta = np.linalg.solve(matrix[solvable], (begin[k] - d[solvable])[..., None])[..., 0].T
        hit = (beta >= 0) & (beta <= 1) & (gamma >= 0) & (delta >= 0) & (gamma + delta <= 1)
        least[k] = beta[hit].min(initial=np.inf)
    return least


@jax.jit
def _walk(begin: jax.Array, end: jax.Array, wall: Mold, grid: SearchGrid) -> tuple[jax.Array, ...]:
    """One step of all nodes from begin to end, (3, n), as the simulation takes it."""
    count = begin.shape[1]
    free = jnp.zeros(count, bool)
    near = nearness.list_near(begin, end - begin, ~free, jnp.asarray(1.0), jnp.asarray(0.0), grid)
    reached, _ = nearness.watch(end, free, near)
    flying = contact.Landing(
        end, end - begin, free, jnp.full(count, -1.0), jnp.zeros(count, jnp.int32), jnp.asarray(0.0)
    )
    landed = contact.land(begin, flying, reached, jnp.ones(count), jnp.asarray(1.0), near, wall, grid)
    return landed.positions, landed.stuck, near.overflow | nearness.left(end, near), landed.loss


@pytest.mark.parametrize("name", ["cup", "ribs", "box"])
def test_random_paths_land_where_brute_force_says(name: str) -> None:
    wall = _shape(name)
    grid = build_grid(np.asarray(wall.vertices), np.asarray(wall.triangles))
    random = np.random.default_rng(3)
    corners = np.asarray(wall.vertices)[np.asarray(wall.triangles)]
    share = random.dirichlet([1.0, 1.0, 1.0], 3000)
    on_wall = np.einsum("ij,ijk->ik", share, corners[random.integers(len(corners), size=3000)])
    begin = on_wall + 0.4 * float(grid.reach) * random.uniform(-1, 1, (3000, 3))
    path = random.normal(size=begin.shape)
    path *= float(grid.reach) * random.uniform(0, 1, (3000, 1)) / np.linalg.norm(path, axis=1, keepdims=True)
    place, stuck, lost, loss = _walk(jnp.asarray(begin.T), jnp.asarray((begin + path).T), wall, grid)
    least = _oracle(begin, begin + path, wall)
    assert not lost
    assert 500 < np.isfinite(least).sum() < 2500
    np.testing.assert_array_equal(np.asarray(stuck), np.isfinite(least))
    expected = begin + np.where(np.isfinite(least), least, 1.0)[:, None] * path
    np.testing.assert_allclose(np.asarray(place).T, expected, atol=1e-12)
    hit = np.isfinite(least)
    np.testing.assert_allclose(float(loss), 0.5 * np.sum(np.square(path[hit])), rtol=1e-12)


@pytest.mark.parametrize("name", ["cup", "ribs", "box"])
def test_cells_know_a_true_bound_and_list_all_that_is_in_reach(name: str) -> None:
    wall = _shape(name)
    grid = build_grid(np.asarray(wall.vertices), np.asarray(wall.triangles))
    corners = np.asarray(wall.vertices)[np.asarray(wall.triangles)]
    points = np.random.default_rng(4).uniform(-1.5, 1.6, (400, 3))
    cell = np.asarray(nearness._cells(jnp.asarray(points.T), grid))
    start, listed = np.asarray(grid.start), np.asarray(grid.number)[np.asarray(grid.listed)]
    for point, number in zip(points, cell, strict=True):
        distance = point_triangle_distance(np.broadcast_to(point, (len(corners), 3)), corners)
        assert float(grid.bound[number]) <= distance.min() + 1e-12
        missing = np.setdiff1d(np.flatnonzero(distance < float(grid.reach)), listed[start[number] : start[number + 1]])
        assert len(missing) == 0


def _aimed(wall: Mold, targets: np.ndarray, normal: np.ndarray, half: float) -> tuple[np.ndarray, np.ndarray]:
    grid = build_grid(np.asarray(wall.vertices), np.asarray(wall.triangles))
    begin, end = targets - half * normal, targets + half * normal
    place, stuck, *_ = _walk(jnp.asarray(begin.T), jnp.asarray(end.T), wall, grid)
    return np.asarray(place).T, np.asarray(stuck)


def test_no_path_leaks_through_shared_edges_and_vertices() -> None:
    wall = _shape("cup")
    corners = np.asarray(wall.vertices)[np.asarray(wall.triangles)]
    bottom = corners[np.all(np.abs(corners[..., 2] - 1.0) < 1e-12, axis=1)]
    share = np.random.default_rng(5).uniform(0.01, 0.95, (len(bottom), 1))
    on_edges = bottom[:, 0] + share * (bottom[:, 1] - bottom[:, 0])
    targets = np.concatenate([on_edges, [[0.0, 0.0, 1.0]]])  # the vertex that all of the fan share
    place, stuck = _aimed(wall, targets, np.array([0.0, 0.0, 1.0]), 0.02)
    assert stuck.all()
    np.testing.assert_allclose(place, targets, atol=1e-12)


def test_of_two_walls_in_one_step_the_first_counts() -> None:
    near = np.array([[-1.0, -1, 0], [1, -1, 0], [0, 1, 0]])
    wall = jaxform.make_mold(np.concatenate([near, near + np.array([0, 0, 0.01])]), np.array([[3, 4, 5], [0, 2, 1]]))
    place, stuck = _aimed(wall, np.array([[0.0, 0.0, 0.005]]), np.array([0.0, 0.0, 1.0]), 0.02)
    assert stuck.all()
    np.testing.assert_allclose(place[0], [0, 0, 0], atol=1e-15)


def test_a_node_that_starts_on_the_wall_stays_there() -> None:
    wall = _shape("cup")
    place, stuck = _aimed(wall, np.array([[0.2, 0.1, 0.97]]), np.array([0.0, 0.0, 1.0]), -0.03)
    assert stuck.all()
    np.testing.assert_allclose(place[0], [0.2, 0.1, 1.0], atol=1e-14)


def test_a_parallel_path_beside_the_wall_is_free() -> None:
    wall = _shape("cup")
    place, stuck = _aimed(wall, np.array([[0.2, 0.1, 0.999]]), np.array([1.0, 0.0, 0.0]), 0.02)
    assert not stuck.any()
    np.testing.assert_allclose(place[0], [0.22, 0.1, 0.999], atol=1e-15)


def test_the_mold_s_orientation_does_not_matter() -> None:
    wall = _shape("ribs")
    turned = jaxform.make_mold(np.asarray(wall.vertices), np.asarray(wall.triangles)[:, ::-1])
    random = np.random.default_rng(6)
    begin = random.uniform(-1, 1, (500, 3))
    end = begin + random.uniform(-0.03, 0.03, (500, 3))
    results = []
    for one in (wall, turned):
        grid = build_grid(np.asarray(one.vertices), np.asarray(one.triangles))
        results.append(_walk(jnp.asarray(begin.T), jnp.asarray(end.T), one, grid))
    np.testing.assert_array_equal(results[0][1], results[1][1])
    np.testing.assert_allclose(results[0][0], results[1][0], atol=1e-13)

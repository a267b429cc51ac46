"""A branch with a derivative of its own, against JAX's."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxform.kernels.branches import branch

COUNT = 5
START, TABLE = jnp.linspace(0.1, 0.5, 3), jnp.linspace(0.5, 1.5, COUNT + 1)


def of_jax(asked: jax.Array, work: Callable[[Any], Any], value: Any) -> Any:
    return jax.lax.cond(asked, work, lambda value: value, value)


def walk(choose: Callable[..., Any], start: jax.Array, table: jax.Array, limit: jax.Array) -> jax.Array:
    """A few passes, of which only those below a limit do anything; the work reads of a table."""

    def step(carry: tuple[jax.Array, jax.Array], number: jax.Array) -> tuple[Any, None]:
        def work(carry: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
            x, seen = carry
            return jnp.sin(x) * table[seen] + x**2 * table[seen + 1], seen + 1

        return choose(number < limit, work, carry), None

    return jnp.sum(jax.lax.scan(step, (start, jnp.int32(0)), jnp.arange(COUNT))[0][0])


@pytest.mark.parametrize("limit", [0, 2, COUNT])
def test_derivatives_are_those_of_jax(limit: int) -> None:
    def derivatives(choose: Callable[..., Any]) -> Any:
        def both(x: jax.Array, table: jax.Array) -> jax.Array:
            return walk(choose, x, table, jnp.int32(limit))

        return [
            jax.value_and_grad(both, (0, 1))(START, TABLE),
            jax.jacfwd(both)(START, TABLE),
            jax.hessian(both)(START, TABLE),
            jax.vmap(jax.grad(both), (0, None))(jnp.stack([START, 2 * START]), TABLE),
            jax.grad(lambda x: jnp.sum(jax.vmap(both, (0, None))(x, TABLE)))(jnp.stack([START, 2 * START])),
        ]

    mine, its = derivatives(branch), derivatives(of_jax)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-14, atol=1e-15), mine, its)


def test_side_by_side_each_takes_its_own_way() -> None:
    limits = jnp.arange(COUNT + 1)

    def slopes(choose: Callable[..., Any]) -> jax.Array:
        slope = jax.grad(lambda x, limit: walk(choose, x, TABLE, limit))
        return jax.vmap(slope, (None, 0))(START, limits)

    np.testing.assert_allclose(slopes(branch), slopes(of_jax), rtol=1e-14)


def test_only_what_carries_a_derivative_is_gone_back_over() -> None:
    def both(x: jax.Array, y: jax.Array) -> jax.Array:
        value = branch(jnp.asarray(True), lambda pair: (pair[0] * y, pair[1] * y), (x, x), lambda _: (True, False))
        return value[0] + value[1]

    assert jax.grad(both, 1)(jnp.asarray(2.0), jnp.asarray(3.0)) == 2.0


def test_what_is_linearized_can_be_called_mapped_transposed_and_differentiated() -> None:
    """As solvers of others do: they map the linear function, or transpose it, inside of a jit."""
    limit = jnp.int32(2)

    def derivatives(choose: Callable[..., Any]) -> Any:
        def figure(x: jax.Array) -> jax.Array:
            return walk(choose, x, TABLE, limit) * x

        def tangent(x: jax.Array, way: jax.Array) -> jax.Array:
            return jax.linearize(figure, x)[1](way)

        def jacobian(x: jax.Array) -> jax.Array:
            return jax.vmap(jax.linearize(figure, x)[1])(jnp.eye(x.size))

        def gradient(x: jax.Array) -> jax.Array:
            value, push = jax.linearize(figure, x)
            return jax.linear_transpose(push, x)(value)[0]

        def curvature(x: jax.Array) -> jax.Array:
            return jax.vmap(jax.linearize(jax.grad(lambda x: jnp.sum(figure(x))), x)[1])(jnp.eye(x.size))

        ways = [jacobian, gradient, curvature, lambda x: tangent(x, x), lambda x: jax.jvp(jacobian, (x,), (TABLE[:3],))]
        return [way(START) for way in ways] + [jax.jit(way)(START) for way in ways]

    mine, its = derivatives(branch), derivatives(of_jax)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-13, atol=1e-15), mine, its)
    expected = jax.jacfwd(lambda x: walk(of_jax, x, TABLE, limit) * x)(START)
    np.testing.assert_allclose(mine[0], expected.T, rtol=1e-13)


def test_a_reverse_derivative_of_a_reverse_one_is_refused_in_words() -> None:
    gradient = jax.grad(lambda x: walk(branch, x, TABLE, jnp.int32(2)))
    with pytest.raises(NotImplementedError, match=r"jax\.hessian"):
        jax.grad(lambda x: jnp.sum(gradient(x)))(START)
    push = jax.linearize(gradient, START)[1]
    with pytest.raises(NotImplementedError, match=r"jax\.hessian"):
        jax.linear_transpose(push, START)(START)

"""A gradient check finds a right gradient right, a wrong one wrong, and says so for every step of its ladder."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxform


def _smooth(numbers: dict[str, jax.Array]) -> jax.Array:
    return jnp.sum(jnp.sin(numbers["a"])) * jnp.exp(numbers["b"])


@jax.custom_jvp
def _wrong(x: jax.Array) -> jax.Array:
    return jnp.sum(x**3)


@_wrong.defjvp
def _(primals: tuple[jax.Array], tangents: tuple[jax.Array]) -> tuple[jax.Array, jax.Array]:
    (x,), (way,) = primals, tangents
    return _wrong(x), jnp.vdot(3.03 * x**2, way)


def test_a_right_gradient_of_a_tree_agrees_at_second_order() -> None:
    numbers = {"a": jnp.asarray([0.3, 1.2, -2.0]), "b": jnp.asarray(0.7)}
    found = jaxform.check_gradient(_smooth, numbers, steps=(1e-1, 1e-2, 1e-3, 1e-5))
    assert found.error < 1e-9
    # A step ten times smaller, an error a hundred times smaller.
    np.testing.assert_allclose(found.errors[0] / found.errors[1:3], [1e2, 1e4], rtol=0.1)


def test_a_direction_of_ones_own_is_taken() -> None:
    numbers = {"a": jnp.asarray([0.3, 1.2]), "b": jnp.asarray(0.0)}
    found = jaxform.check_gradient(_smooth, numbers, direction={"a": [1.0, 0.0], "b": 0.0})
    np.testing.assert_allclose(found.slope, np.cos(0.3), rtol=1e-12)
    with pytest.raises(jaxform.InputError, match="shape"):
        jaxform.check_gradient(_smooth, numbers, direction={"a": [1.0, 0.0, 0.0], "b": 0.0})


def test_a_wrong_gradient_is_seen_at_every_step() -> None:
    found = jaxform.check_gradient(_wrong, jnp.asarray([1.0, 2.0]))
    np.testing.assert_allclose(found.errors, 0.03 / 3.03, rtol=1e-2)
    assert len(repr(found).splitlines()) == 3 + len(found.steps)


def test_single_precision_numbers_keep_their_precision() -> None:
    found = jaxform.check_gradient(lambda x: jnp.sum(jnp.sin(x)), jnp.asarray([0.5, 1.0], jnp.float32))
    assert 1e-8 < found.error < 1e-2


@pytest.mark.parametrize("steps", [(), (0.0,), (-1e-3, 1e-3)])
def test_steps_that_are_none_are_refused(steps: tuple[float, ...]) -> None:
    with pytest.raises(jaxform.InputError, match="positive"):
        jaxform.check_gradient(lambda x: x, jnp.asarray(1.0), steps=steps)


def test_the_slope_of_a_ripple_is_told_from_the_secants() -> None:
    """A ripple that is a ten-thousandth of the value has ten times its slope."""

    def ripple(x: jax.Array) -> jax.Array:
        return x + 1e-4 * jnp.sin(1e5 * x)

    found = jaxform.check_gradient(ripple, jnp.asarray(1.0), direction=jnp.asarray(1.0))
    assert found.error < 1e-3
    exact = 1.0 + 10.0 * np.cos(1e5)
    np.testing.assert_allclose(found.slope, exact, rtol=1e-10)
    assert len(found.secants) == 5
    steps = np.array([1e-2, 1e-3, 1e-4, 1e-5, 1e-6])
    secants = 1.0 + 1e-4 * np.cos(1e5) * np.sin(1e5 * steps) / steps
    np.testing.assert_allclose(found.secants, secants, rtol=1e-6)
    apart = np.abs(secants - exact) / np.maximum(np.abs(secants), abs(exact))
    assert found.secant_error == pytest.approx(float(apart.max()), rel=1e-6)
    assert "% apart" in repr(found).splitlines()[-1]
    smooth = jaxform.check_gradient(lambda x: x**2, jnp.asarray(1.0), direction=jnp.asarray(1.0))
    assert smooth.secant_error < 1e-4

"""Powers and logarithms in vectors beside those of NumPy, in extended precision."""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxform.kernels import elementary

EXPONENTS = np.concatenate([np.linspace(-1000.0, 1000.0, 40_001), np.linspace(-2.0, 2.0, 4001), [0.5, -0.5, 0.0]])
POSITIVE = np.concatenate([np.exp(np.linspace(-700.0, 700.0, 40_001)), np.linspace(0.5, 2.0, 4001)])


def test_powers_of_two_to_rounding() -> None:
    got = np.asarray(jax.jit(elementary.exp2)(EXPONENTS), np.longdouble)
    assert np.abs(got / np.exp2(EXPONENTS.astype(np.longdouble)) - 1.0).max() < 1e-15


def test_logarithms_to_rounding() -> None:
    got = np.asarray(jax.jit(elementary.log2)(POSITIVE), np.longdouble)
    right = np.log2(POSITIVE.astype(np.longdouble))
    assert np.abs(got - right).max() < 1e-15 * np.abs(right).max()
    near = np.abs(right) < 1.0
    assert np.abs(got - right)[near].max() < 1e-15
    assert np.abs(got / np.where(right == 0.0, 1.0, right) - 1.0)[near & (np.abs(right) > 1e-3)].max() < 1e-12


def test_of_next_to_nothing_to_rounding() -> None:
    """2^x - 1 and log2(1 + x)."""
    little = 10.0 ** np.linspace(-300.0, 0.0, 3001)
    of_power = np.concatenate([EXPONENTS, little, -little])
    right = np.expm1(of_power * np.log(np.longdouble(2.0)))
    got = np.asarray(jax.jit(elementary.exp2m1)(of_power), np.longdouble)
    assert np.all(got[right == 0.0] == 0.0)
    assert np.abs(got / np.where(right == 0.0, 1.0, right) - 1.0)[right != 0.0].max() < 3e-15
    of_sum = np.concatenate([little, np.exp(np.linspace(0.0, 600.0, 40_001)), np.linspace(0.0, 4.0, 4001)[1:]])
    right = np.log1p(of_sum.astype(np.longdouble)) / np.log(np.longdouble(2.0))
    got = np.asarray(jax.jit(elementary.log2p1)(of_sum), np.longdouble)
    assert np.abs(got / right - 1.0).max() < 1e-15
    assert elementary.log2p1(jnp.zeros(1))[0] == 0.0


@pytest.mark.parametrize("function", [elementary.exp2, elementary.log2, elementary.exp2m1, elementary.log2p1])
def test_what_is_no_number_stays_none(function: Callable[[jax.Array], jax.Array]) -> None:
    for precision in (np.float64, np.float32):
        assert np.isnan(function(jnp.asarray([np.nan, 1.0], precision))[0])


def test_single_precision() -> None:
    values = np.linspace(0.1, 9.0, 100, dtype=np.float32)
    np.testing.assert_allclose(elementary.exp2(jnp.asarray(values)), np.exp2(values), rtol=1e-6)
    np.testing.assert_allclose(elementary.log2(jnp.asarray(values)), np.log2(values), rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(elementary.exp2m1(jnp.asarray(values)), np.exp2(values) - 1, rtol=1e-5)
    np.testing.assert_allclose(elementary.log2p1(jnp.asarray(values)), np.log2(1 + values), rtol=1e-5)


def test_derivatives_both_ways_and_twice() -> None:
    at = jnp.asarray(1.7)
    for function, first, second in (
        (elementary.exp2, np.log(2.0) * 2**1.7, np.log(2.0) ** 2 * 2**1.7),
        (elementary.log2, 1.0 / (1.7 * np.log(2.0)), -1.0 / (1.7**2 * np.log(2.0))),
        (elementary.exp2m1, np.log(2.0) * 2**1.7, np.log(2.0) ** 2 * 2**1.7),
        (elementary.log2p1, 1.0 / (2.7 * np.log(2.0)), -1.0 / (2.7**2 * np.log(2.0))),
    ):
        np.testing.assert_allclose(jax.grad(function)(at), first, rtol=1e-14)
        np.testing.assert_allclose(jax.jacfwd(jax.grad(function))(at), second, rtol=1e-14)
        np.testing.assert_allclose(jax.hessian(function)(at), second, rtol=1e-14)

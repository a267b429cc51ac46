"""Frozen trees: what is found of one is remembered as long as it is there."""

import gc
import weakref

import jax
import jax.numpy as jnp

from jaxform.core.pytree import memoize, pytree


@pytree
class _Pair:
    one: jax.Array
    other: jax.Array


def test_what_is_found_of_a_tree_is_remembered_while_it_lives() -> None:
    looked_at = []

    @memoize
    def total(pair: _Pair) -> float:
        looked_at.append(id(pair))
        return float(pair.one + pair.other)

    first, alike = (_Pair(jnp.asarray(1.0), jnp.asarray(2.0)) for _ in range(2))
    assert [total(first), total(first), total(alike), total(first)] == [3.0] * 4
    assert looked_at == [id(first), id(alike)]
    gone = weakref.ref(first)
    del first
    gc.collect()
    assert gone() is None

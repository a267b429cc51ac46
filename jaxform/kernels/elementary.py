"""Elementary functions in double precision, to rounding, from additions and products that run in vectors.

XLA's CPU compiler has no logarithm in vectors in double precision, and an exponential that is right for any number.
These work on the bits of a number, 2^k m: k is in its own bits, the rest is a short polynomial. They are accurate in
the given ranges; NaN stays NaN. In other precisions they are JAX's.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp

from jaxform.kernels.blocks import materialize

_ONE, _HALF_ROOT = 0x3FF0000000000000, 0x3FE6A09E667F3BCD  # the bits of 1 and of 2^(-1/2)
_FRACTION = 52  # how many bits it has
# Added to a whole number k it has the bits of k as its own last ones.
_SHIFT, _SHIFT_BITS = 6755399441055744.0, 0x4338000000000000
_LN_2 = 0.6931471805599453
# Interpolated at Chebyshev's points: 2^x and (2^x - 1) / x up to x = 1/2, and log2((1 + x) / (1 - x)) / x in x^2 up to
# that of 2^(1/2).
_EXP2 = (
    1.0,
    0.69314718055995,
    0.24022650695910097,
    0.05550410866444766,
    0.009618129107606885,
    0.001333355823017503,
    0.00015403530441741856,
    1.5252657254071693e-05,
    1.3215442584382707e-06,
    1.020869152579221e-07,
    7.072586657066206e-09,
)
_EXP2M1 = (
    0.6931471805599462,
    0.24022650695910075,
    0.05550410866465167,
    0.009618129107618665,
    0.0013333558200794592,
    0.00015403530424776529,
    1.5252672924850737e-05,
    1.3215451633221434e-06,
    1.0205905413765595e-07,
    7.070977866508139e-09,
)
_ATANH = (
    2.885390081777927,
    0.9617966939243325,
    0.577078017247236,
    0.41219840190016577,
    0.3206163989221177,
    0.26144389073771435,
    0.24292051755312075,
)


@jax.custom_jvp
def exp2(values: jax.Array) -> jax.Array:
    """2^x of values from -1000 to 1000."""
    if values.dtype != jnp.float64:
        return jnp.exp2(values)
    shifted = values + _SHIFT
    left = values - (shifted - _SHIFT)
    power = jax.lax.shift_left(_bits(shifted), jnp.int64(_FRACTION))
    return _number(_bits(_polynomial(_EXP2, left)) + power)


@exp2.defjvp
def _exp2_change(values: tuple[jax.Array], changes: tuple[jax.Array]) -> tuple[jax.Array, jax.Array]:
    power = exp2(*values)
    return power, power * (_LN_2 * changes[0])


@jax.custom_jvp
def exp2m1(values: jax.Array) -> jax.Array:
    """2^x - 1 of values from -1000 to 1000, to rounding where x is next to nothing too."""
    if values.dtype != jnp.float64:
        return jnp.expm1(_LN_2 * values)
    shifted = values + _SHIFT
    left = values - (shifted - _SHIFT)
    scale = _number(jax.lax.shift_left(_bits(shifted), jnp.int64(_FRACTION)) + _ONE)
    return scale * (left * _polynomial(_EXP2M1, left)) + (scale - 1.0)


@exp2m1.defjvp
def _exp2m1_change(values: tuple[jax.Array], changes: tuple[jax.Array]) -> tuple[jax.Array, jax.Array]:
    growth = exp2m1(*values)
    return growth, (1.0 + growth) * (_LN_2 * changes[0])


@jax.custom_jvp
def log2(values: jax.Array) -> jax.Array:
    """log2 x of positive, normal values."""
    if values.dtype != jnp.float64:
        return jnp.log2(values)
    raised = jax.lax.shift_right_logical(_bits(values) + (_ONE - _HALF_ROOT), jnp.int64(_FRACTION))
    power = _number(raised + _SHIFT_BITS) - (_SHIFT + (_ONE >> _FRACTION))
    near = values * _number(2 * _ONE - jax.lax.shift_left(raised, jnp.int64(_FRACTION)))
    share = (near - 1.0) / (near + 1.0)
    return power + share * _polynomial(_ATANH, share * share)


@log2.defjvp
def _log2_change(values: tuple[jax.Array], changes: tuple[jax.Array]) -> tuple[jax.Array, jax.Array]:
    return log2(*values), changes[0] / (_LN_2 * values[0])


@jax.custom_jvp
def log2p1(values: jax.Array) -> jax.Array:
    """log2(1 + x) of normal values from 0 on, to rounding where x is next to nothing too."""
    if values.dtype != jnp.float64:
        return jnp.log1p(values) / _LN_2
    values = materialize(values)
    total = 1.0 + values
    # The sum's rounding error; above 2 it is negligible beside the logarithm.
    lost = jnp.where(total < 2.0, values - (total - 1.0), 0.0)
    return log2(total) + lost * (1.0 / _LN_2)


@log2p1.defjvp
def _log2p1_change(values: tuple[jax.Array], changes: tuple[jax.Array]) -> tuple[jax.Array, jax.Array]:
    return log2p1(*values), changes[0] / (_LN_2 * (1.0 + values[0]))


def _polynomial(terms: tuple[float, ...], at: jax.Array) -> jax.Array:
    total = jnp.full_like(at, terms[-1])
    for term in reversed(terms[:-1]):
        total = total * at + term
    return total


def _bits(values: jax.Array) -> jax.Array:
    return jax.lax.bitcast_convert_type(values, jnp.int64)


def _number(bits: jax.Array) -> jax.Array:
    return jax.lax.bitcast_convert_type(bits, jnp.float64)

"""The flow of a gas through an orifice, such as a valve or a vent."""

from __future__ import annotations

import jax
import jax.numpy as jnp

_LAMINAR = 2e-3
"""Relative pressure difference below which the flow is smooth in it: an isentropic flow has an infinite slope at 0."""
_FEW = 1e-3  # share of a relaxation time below which its exponential is a series


def orifice_flow(
    outside: jax.Array,
    inside: jax.Array,
    discharge_coefficient: jax.Array,
    specific_energy: jax.Array,
    heat_capacity_ratio: jax.Array,
) -> jax.Array:
    """Mass flow [kg/s] per area [m^2] from one absolute pressure to another [Pa], below 0 where it flows back.

    Isentropic [1]: with the pressures p1 > p2 it is C p1 / sqrt(R T) sqrt(2 k / (k - 1) (r^(2 / k) - r^((k + 1) / k)))
    with r = p2 / p1, not less than the critical ratio (2 / (k + 1))^(k / (k - 1)), where it is choked.

    [1] A. H. Shapiro, The Dynamics and Thermodynamics of Compressible Fluid Flow, vol. 1, 1953, chapter 4.

    Args:
        outside: The one pressure.
        inside: The other one.
        discharge_coefficient: C.
        specific_energy: R T [J/kg] of the gas where the pressure is higher.
        heat_capacity_ratio: k.
    """
    higher = jnp.maximum(outside, inside)
    factor = discharge_coefficient * higher / jnp.sqrt(specific_energy)
    return factor * _flow_function((outside - inside) / higher, heat_capacity_ratio)


def _flow_function(drop: jax.Array, k: jax.Array) -> jax.Array:
    """The flow function of the relative pressure drop; below `_LAMINAR` a cubic with its value and slope there."""
    choked = 1.0 - (2.0 / (k + 1.0)) ** (k / (k - 1.0))

    def isentropic(drop: jax.Array) -> jax.Array:
        ratio = 1.0 - drop
        return jnp.sqrt(2.0 * k / (k - 1.0) * (ratio ** (2.0 / k) - ratio ** ((k + 1.0) / k)))

    first = jnp.full_like(drop, _LAMINAR)
    value, slope = jax.jvp(isentropic, (first,), (jnp.ones_like(first),))
    bend, share = 0.5 * (slope * _LAMINAR - value), drop / _LAMINAR
    laminar, size = share * (value - bend + bend * share**2), jnp.abs(drop)
    return jnp.where(size < _LAMINAR, laminar, jnp.sign(drop) * isentropic(jnp.clip(size, _LAMINAR, choked)))


def mean_decay(rate: jax.Array) -> jax.Array:
    """The mean of exp(-rate s) over s from 0 to 1."""
    small = jnp.abs(rate) < _FEW
    usual = jnp.where(small, 1.0, rate)
    return jnp.where(small, 1.0 - rate / 2.0 + rate**2 / 6.0, -jnp.expm1(-usual) / usual)

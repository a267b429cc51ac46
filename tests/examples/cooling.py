"""The sheet's temperature, as a user writes it: it cools in the air, and faster on the mold."""

from __future__ import annotations

import jax
import jax.numpy as jnp

import jaxform


@jaxform.field
class Cooling(jaxform.Field):
    """dT/dt = -k (T - T0), with the rate and temperature of the air while a node is free, of the mold once it sticks.

    Attributes:
        initial: At each node before the first step [degC].
        air_rate, mold_rate: k [1/s].
        air, mold: T0 [degC].
    """

    initial: jax.Array = jaxform.parameter("degC", least=-273.15, nodal=True)
    air_rate: jax.Array = jaxform.parameter("1/s", least=0.0)
    mold_rate: jax.Array = jaxform.parameter("1/s", least=0.0)
    air: jax.Array = jaxform.parameter("degC", least=-273.15)
    mold: jax.Array = jaxform.parameter("degC", least=-273.15)

    def start(self, positions: jax.Array) -> jax.Array:
        """Temperature [degC] before the first step."""
        return self.initial

    def after(self, values: jax.Array, step: jaxform.Surroundings) -> jax.Array:
        """Temperature [degC] at the end of a step."""
        touches = step.contact_time > 0.0
        around = jnp.where(touches, self.mold, self.air)
        rate = jnp.where(touches, self.mold_rate, self.air_rate)
        return around + (values - around) * jnp.exp(-rate * step.length)

"""A sealed gas under the sheet, as a user writes it: the pressure falls as the sheet makes room."""

from __future__ import annotations

import jax
import jax.numpy as jnp

import jaxform


@jaxform.loading
class SealedGas(jaxform.Loading):
    """p (V0 + V) = n R T: an isothermal gas that flows in for a while and is then shut off; the pressure is gauge.

    Volumes and contents are those of the modelled part: of a quarter a quarter.

    Attributes:
        initial: n R T at first [J].
        content: n R T in the end [J].
        inflow_time: Duration of the inflow [s].
        dead_volume: Volume of the gas beside that under the sheet [m^3].
        outside: Absolute pressure outside [Pa].
    """

    initial: jax.Array = jaxform.parameter("J", above=0.0)
    content: jax.Array = jaxform.parameter("J", above=0.0)
    inflow_time: jax.Array = jaxform.parameter("s", above=0.0)
    dead_volume: jax.Array = jaxform.parameter("m^3", above=0.0)
    outside: jax.Array = jaxform.parameter("Pa", above=0.0)

    def at(self, time: jax.Array, volume: jax.Array) -> jax.Array:
        """Gauge pressure [Pa]."""
        share = jnp.clip(time / self.inflow_time, 0.0, 1.0)
        content = self.initial + share * (self.content - self.initial)
        return content / (self.dead_volume + volume) - self.outside

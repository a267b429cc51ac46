"""A sheet that goes slack instead of being compressed: the relaxed energy of tension-field theory.

A membrane bears no compression: it wrinkles, on a scale far below that of an element. Its energy is then the least
that any width across the wrinkles gives (A. C. Pipkin, IMA J. Appl. Math. 36, 1986): with principal stretches
l1 >= l2 that of uniaxial tension l1 where l2 < l1^(-1/2), and none where l1 < 1 as well.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp

from jaxform.kernels.blocks import materialize

_LEAST = 1e-30  # of a difference squared


class RelaxedStrain(NamedTuple):
    """The strain in the plane with the width that a strip in uniaxial tension has, where the sheet is slack.

    Attributes:
        trace: l1^2 + l2^2 (n,).
        determinant: (l1 l2)^2 (n,).
        slack: Mask of elements where the sheet is narrower than that (n,).
        larger: The larger principal value l1^2 as it is (n,).
        half: Half of l1^2 - l2^2 as it is (n,), where it is slack.
        turn: Change of the energy with l1^2, over that with the trace at constant determinant, and over
            l1^2 - l2^2 (n,).
    """

    trace: jax.Array
    determinant: jax.Array
    slack: jax.Array
    larger: jax.Array
    half: jax.Array
    turn: jax.Array

    def factors(self, a: jax.Array, b: jax.Array, scale: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Those of the relaxed sheet's stress, from those of this strain; as in `membrane.stress_factors`.

        The slopes of l1^2 by trace and determinant are l1^2 / (l1^2 - l2^2) and -1 / (l1^2 - l2^2).
        """
        # Next to no strain rounding decides; both nearly cancel, so it must decide the same for both.
        slack, pull = materialize((self.slack, a * self.turn))
        return jnp.where(slack, pull * self.larger, a), jnp.where(slack, -0.5 * scale * pull, b)

    def shares(self) -> tuple[jax.Array, jax.Array]:
        """Weights of the present and of the initial metric in the metric of the relaxed strain (n,)."""
        pulled = jnp.maximum(self.larger, 1.0)
        slack, share = materialize((self.slack, 0.5 * (pulled - self.determinant / pulled) / self.half))
        return jnp.where(slack, share, 1.0), jnp.where(slack, pulled - share * self.larger, 0.0)


def relax_slack_strain(trace: jax.Array, determinant: jax.Array, square: jax.Array) -> RelaxedStrain:
    """Relaxed strain (n,), of l1^2 + l2^2, (l1 l2)^2 and ((l1^2 - l2^2) / 2)^2."""
    mean = 0.5 * trace
    # Equal stretches have no derivative of their difference; where they are slack nothing is pulled.
    half = jnp.sqrt(jnp.maximum(square, _LEAST))
    larger = mean + half
    pulled = jnp.maximum(larger, 1.0)
    narrow = jnp.sqrt(pulled)  # the determinant of uniaxial tension
    slack = determinant < narrow
    # In slack elements they differ by at least that; at almost no strain, rounding errors would hide it.
    half = jnp.maximum(half, 0.5 * (pulled - narrow))
    # One division for both.
    width, twice = pulled * narrow, 2.0 * half
    both = 1.0 / (width * twice)
    inverse = both * twice
    return RelaxedStrain(
        trace=jnp.where(slack, pulled + pulled * inverse, trace),
        determinant=jnp.where(slack, narrow, determinant),
        slack=slack,
        larger=larger,
        half=half,
        turn=(width - 1.0) * both,
    )

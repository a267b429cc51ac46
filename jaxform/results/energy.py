"""The energy balance of a run, and its checks."""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp

from jaxform.core.pytree import marked_field_names, pytree
from jaxform.sheet.state import LOSS

_DRAG = 0.2  # how much the square of the share of damping changes the wall; measured by `make validate`
UNBALANCED = 0.01  # largest error of the energy balance, relative to the largest work


@pytree
class Energy:
    """Energy balance of the modelled part [J]; every term is computed by itself, none by difference.

    Attributes:
        strain: Strain energy at the end.
        kinetic: Kinetic energy at the end.
        external_work: Pressure forces times nodal displacements: the sum of P dV, unless an open rim moves.
        tool_work: Work of the moving mold.
        damping_loss: Work done against damping.
        contact_loss: Kinetic energy of the nodes when they stuck.
        refinement_loss: Strain and kinetic energy that new nodes took away.
        viscous_loss: Dissipation of the Maxwell branches.
        cooling_loss: Strain energy lost as the temperature softened the sheet, minus that gained as it stiffened.
        kinetic_peak: Largest kinetic energy at the end of a window.
        peak_work: Largest magnitude of the work, external and of the tool, at the end of a window; carries no
            derivative.
        rounding: Error of the balance by rounding alone; carries no derivative.
    """

    strain: jax.Array
    kinetic: jax.Array
    external_work: jax.Array
    tool_work: jax.Array
    damping_loss: jax.Array = dataclasses.field(metadata=LOSS)
    contact_loss: jax.Array = dataclasses.field(metadata=LOSS)
    refinement_loss: jax.Array = dataclasses.field(metadata=LOSS)
    viscous_loss: jax.Array = dataclasses.field(metadata=LOSS)
    cooling_loss: jax.Array = dataclasses.field(metadata=LOSS)
    kinetic_peak: jax.Array
    peak_work: jax.Array
    rounding: jax.Array

    @property
    @jax.jit
    def balance_error(self) -> jax.Array:
        """Error of the energy balance, relative to the largest work; above 1 % the status is `UNBALANCED`.

        For work so small that rounding matters, it is relative to a hundred times the rounding.
        """
        kept = self.strain + self.kinetic + sum(getattr(self, name) for name in marked_field_names(self, LOSS))
        largest = jnp.maximum(jnp.abs(self.work), self.peak_work) + self.rounding / UNBALANCED
        return jnp.abs(kept - self.work) / largest

    @property
    def work(self) -> jax.Array:
        """Work done on the sheet by the pressure and by the moving mold."""
        return self.external_work + self.tool_work

    @property
    @jax.jit
    def measurable(self) -> jax.Array:
        """True if the work was ever larger than its rounding error."""
        return jnp.maximum(jnp.abs(self.work), self.peak_work) > self.rounding

    @property
    @jax.jit
    def quasi_static_error(self) -> jax.Array:
        """Estimated relative error of the wall against the same process done slowly (0 where nothing moved).

        The largest kinetic energy over the external work, for inertia, plus a fifth of the square of the share that
        went into damping, for drag. For deep parts within a factor of about three (docs/accuracy.md), for shallow ones
        several times too high.
        """
        work = jnp.where(self.measurable, jnp.abs(self.work), jnp.inf)
        return self.kinetic_peak / work + _DRAG * jnp.square(self.damping_loss / work)

    @property
    def haste(self) -> jax.Array:
        """An older name of `quasi_static_error`."""
        return self.quasi_static_error


def warnings_of_no_work(energy: Energy) -> list[str]:
    """A sentence where the pressure did so little work that nothing moved which could be measured."""
    if bool(energy.measurable):
        return []
    work = max(abs(float(energy.work)), float(energy.peak_work))
    return [
        f"the sheet hardly moved: the pressure did {work:.2g} J of work, less than the {float(energy.rounding):.2g} J "
        "that the energy balance can resolve; raise pressure.value or solver.end_time, or check the units of "
        "material.density"
    ]

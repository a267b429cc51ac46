"""User-defined nodal fields of a scene; one is added as a class decorated with `field`."""

from __future__ import annotations

from typing import ClassVar, NamedTuple, dataclass_transform

import jax
import jax.numpy as jnp

from jaxform.core.pytree import parameter, ranged_parameter, register_part, static


class Surroundings(NamedTuple):
    """The nodal context that a field is given at the end of a step.

    Attributes:
        time: Time at the end of the step [s].
        length: Length of the step [s].
        positions, velocities: Nodal positions and velocities (3, n_node) [m], [m/s].
        stuck: Nodes (n_node,) that do not move any more.
        contact_time: Time of contact of each node (n_node,) [s]; -1 where free, 0 where clamped.
    """

    time: jax.Array
    length: jax.Array
    positions: jax.Array
    velocities: jax.Array
    stuck: jax.Array
    contact_time: jax.Array


class Field:
    """A scalar at the sheet's nodes, carried through steps, contact and refinement into the result.

    A field is a pytree whose numbers are leaves. It defines its initial values and their change in a step::

        @jaxform.field
        class Cooling(jaxform.Field):
            initial: jax.Array = jaxform.parameter("degC", nodal=True)
            rate: jax.Array = jaxform.parameter("1/s", least=0.0)

            def start(self, positions):
                return self.initial

            def after(self, values, step):
                return values * jnp.exp(-self.rate * step.length)

    With `build_scene(fields={"temperature": ...})` it is in `Result.fields` and in final.vtu under that name, and
    `replace` and gradients know its parameters, such as fields.temperature.rate. A run orders its nodes differently:
    the value at a node may depend on data of the same node only. Gradients use checkpoints.

    Attributes:
        rests: True if values are constant at nodes in contact. Otherwise these are computed in each step.
    """

    rests: ClassVar[bool] = False

    def start(self, positions: jax.Array) -> jax.Array:
        """Values (n_node,) before the first step, of a parison with initial positions (n_node, 3) [m]."""
        raise NotImplementedError

    def after(self, values: jax.Array, step: Surroundings) -> jax.Array:
        """Values (n_node,) at the end of a step; by default unchanged."""
        return values

    def between(self, first: jax.Array, second: jax.Array) -> jax.Array:
        """Values (n,) of new nodes in the middle of edges, from those at the edges' ends; by default their mean."""
        return 0.5 * (first + second)


@dataclass_transform(frozen_default=True, field_specifiers=(parameter, ranged_parameter, static))
def field[T: Field](cls: type[T]) -> type[T]:
    """Makes a class a field: a frozen dataclass and a pytree, its numbers known to `replace` and to designs.

    Raises:
        InputError: It does not derive from `Field`, does not define `start`, or has an undeclared parameter.
    """
    remedy = "derive it from jaxform.Field and define its initial value, `start`"
    return register_part(cls, Field, "start", remedy, "fields")


def advance_fields(fields: dict[str, Field], values: dict[str, jax.Array], step: Surroundings) -> dict[str, jax.Array]:
    """The values of all fields at the end of a step."""
    return {
        name: jnp.broadcast_to(fields[name].after(current, step), current.shape) for name, current in values.items()
    }

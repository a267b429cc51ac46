"""The nodal fields of a run, each declared once with how it passes from one list of nodes to another.

Packing, capacity for more nodes, their insertion and the result follow from what is declared here. A scene may carry
fields of its own (`jaxform.field`); they are under their names in `Nodes.fields`.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from jaxform.core.pytree import pytree
from jaxform.kernels.blocks import over_blocks
from jaxform.mechanics.membrane import dot


class FieldRule(NamedTuple):
    """Rule for transferring a nodal field from one list of nodes to another.

    Attributes:
        smooth: Whether it carries a derivative.
        beyond: Its value at places where there is no node; None where any will do.
        absent: Its value in a result at nodes that do not exist; None where the result has their initial value.
    """

    smooth: bool = False
    beyond: Any = None
    absent: Any = None


@pytree
class Nodes:
    """Nodal fields, in the mesh's order or in the packed one of `active_set.ActiveSet`.

    Attributes:
        positions: (3, n_node) [m]; inside a window's loop row by row, where no derivative is taken.
        velocities: (3, n_node) [m/s], half a step behind the positions.
        stuck: Nodes (n_node,) that have no motion of their own any more: clamped, or on a tool to which they stick.
        contact_time: When a node touched a tool (n_node,) [s]; -1 where free, 0 where clamped.
        wall: What a node touches (n_node,): one more than the number of the tool's triangle, negative where the node
            came from the far side of its normal; 0 where it touches none.
        tool: The number of the tool that a node touches (n_node,), as in `Scene.surfaces`, or touched last; None where
            there is one at most.
        mode: Of the highest frequency (3, n_node); None where it is not measured.
        fields: The scene's own, by name (n_node,).
    """

    positions: Any = dataclasses.field(metadata={"rule": FieldRule(smooth=True)})
    velocities: jax.Array = dataclasses.field(metadata={"rule": FieldRule(smooth=True, beyond=0.0, absent=0.0)})
    stuck: jax.Array = dataclasses.field(metadata={"rule": FieldRule(beyond=True, absent=False)})
    contact_time: jax.Array = dataclasses.field(metadata={"rule": FieldRule(smooth=True, absent=-1.0)})
    wall: jax.Array = dataclasses.field(metadata={"rule": FieldRule(beyond=0, absent=0)})
    mode: jax.Array | None = dataclasses.field(metadata={"rule": FieldRule()})
    fields: dict[str, jax.Array] = dataclasses.field(metadata={"rule": FieldRule(smooth=True, absent=0.0)})
    tool: jax.Array | None = dataclasses.field(default=None, metadata={"rule": FieldRule(beyond=0, absent=-1)})

    def map_fields(self, function: Callable[[Any, FieldRule], Any]) -> Nodes:
        """The nodes with a function applied to each field and its rule."""
        made = {
            part.name: jax.tree.map(lambda values, rule=part.metadata["rule"]: function(values, rule), values)
            for part in dataclasses.fields(self)
            for values in [getattr(self, part.name)]
        }
        return dataclasses.replace(self, **made)

    def contact_fields(self) -> Nodes:
        """The fields that contact uses: all but the mode and the scene's own fields."""
        return dataclasses.replace(self, mode=None, fields={})

    def pad(self, count: int) -> Nodes:
        """The nodes with capacity for `count` of them."""

        def pad_field(values: jax.Array, rule: FieldRule) -> jax.Array:
            shape = *values.shape[:-1], count - values.shape[-1]
            return jnp.concatenate([values, jnp.full(shape, rule.beyond or 0, values.dtype)], axis=-1)

        return self.map_fields(pad_field)


def highest_speed(velocities: jax.Array, blocks: jax.Array) -> jax.Array:
    """The highest speed [m/s] of nodes with velocities (3, n_node) in `blocks` blocks; not differentiable."""
    _, (square,) = over_blocks(lambda v: ([], [dot(v, v)]), blocks, (velocities,), [], most=1)
    return jnp.sqrt(square)

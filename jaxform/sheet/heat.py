"""Temperature change of the elements, and their material model at the present temperature."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from jaxform.core.pytree import as_real, pytree
from jaxform.materials import Cooling, Law, Modes, Touching
from jaxform.mechanics import membrane
from jaxform.mechanics.elements import Nodes
from jaxform.model.scene import Scene


@pytree
class ThermalState:
    """Temperature change of elements (n,) by cooling.

    An element whose nodes all stick keeps its material parameters, on which nothing depends any more; its further
    cooling is computed on demand.

    Attributes:
        change: Change of the temperature since the run began [K].
        time: Time up to which it is computed [s].
        felt: Change of the temperature in the middle of the window, for the material parameters [K].
    """

    change: jax.Array
    time: jax.Array
    felt: jax.Array

    def select(self, element: jax.Array) -> ThermalState:
        """The thermal state of the elements with these numbers."""
        return ThermalState(self.change[element], self.time[element], self.felt[element])


def initial_heat(elements: int) -> ThermalState:
    """The thermal state of this number of elements at the begin of a run."""
    return ThermalState(*jnp.zeros((3, elements), as_real(0.0).dtype))


def at_temperature(
    material: Law, zones: dict[str, jax.Array], temperature: jax.Array | None
) -> tuple[dict[str, jax.Array], Modes | None]:
    """All varying parameters and the modes of elements with these zones at temperatures (n,) [degC].

    The modes are None where they do not vary.
    """
    if temperature is None or material.shift is None:
        return zones, None
    law = material.with_zones(zones).at(temperature)
    return law.zones, law.viscous


def tool_contact(scene: Scene, nodes: Nodes, triangles: jax.Array, begin: jax.Array, end: jax.Array) -> Touching:
    """Share (n,) of elements' area and of the time from `begin` (n,) to `end` [s] in contact with mold or each tool.

    Where `begin` is `end`, it is the share of the area in contact at that time.
    """
    warmth = scene.tool_warmth
    if warmth is None:
        return _contact_share(nodes, triangles, begin, end, None)
    shares = (_contact_share(nodes, triangles, begin, end, number) for number in range(len(warmth)))
    return [(share, *own) for share, own in zip(shares, warmth, strict=True)]


def _contact_share(
    nodes: Nodes, triangles: jax.Array, begin: jax.Array, end: jax.Array, number: int | None
) -> jax.Array:
    """The share (n,) for the tool of this number; None of the only one."""
    passed = end > begin
    whole, share = jnp.where(passed, end - begin, 1.0), jnp.zeros_like(begin)
    for corner in triangles:
        since = jnp.clip((end - membrane.gather(nodes.contact_time, corner)) / whole, 0.0, 1.0)
        touches = membrane.gather(nodes.wall, corner) != 0
        if number is not None and nodes.tool is not None:
            touches &= membrane.gather(nodes.tool, corner) == number
        share += jnp.where(touches, jnp.where(passed, since, 1.0), 0.0)
    return share / 3.0


def temperature_change(
    heat: ThermalState,
    cooling: Cooling,
    first: jax.Array,
    wall: jax.Array,
    share: Touching,
    density: jax.Array,
    time: jax.Array,
) -> jax.Array:
    """The change of the temperature (n,) [K] since the run began, at a later time [s].

    Args:
        heat: The thermal state of the elements (n,).
        cooling: The cooling of the scene.
        first: Their initial temperature (n,) [degC].
        wall: Their thickness (n,) [m].
        share: Their contact with tools.
        density: [kg/m^3], a number or (n,).
        time: The later time [s], a number or (n,).
    """
    return cooling.cooled(first + heat.change, wall, share, density, jnp.maximum(time - heat.time, 0.0)) - first

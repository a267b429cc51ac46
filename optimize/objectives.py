"""What is wanted of the formed part, as one number to make small; and what is reported beside it."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike

from jaxform import InputError, Result, Scene
from jaxform.profiles import Profile


class Target:
    """Come close to a final thickness.

    The objective is the square of the relative deviation of the wall from the target, averaged over the formed area.

    Args:
        scene: The scene that is designed.
        thickness: The target [m]: a number, a field (n_node,), or a `Profile` (along a place in the formed part, or,
            with `initial`, in the initial sheet).
        initial: Whether the profile's place is that in the initial sheet.

    Attributes:
        uniform: The target where it is one number, else None [m].

    Raises:
        InputError: If a target is not positive or does not fit the mesh.
    """

    def __init__(self, scene: Scene, thickness: ArrayLike | Profile, *, initial: bool = True) -> None:
        """See the class."""
        self.uniform = float(thickness) if isinstance(thickness, int | float) else None
        self._profile = thickness.positive() if isinstance(thickness, Profile) else None
        if isinstance(thickness, Profile):
            if initial:
                self._profile, thickness = None, thickness(np.asarray(scene.parison.positions))
            else:
                thickness = thickness.value[0]
        count = scene.parison.thickness.size
        given = np.asarray(thickness, float)
        if given.shape not in ((), (count,)):
            raise InputError(f"has shape {given.shape}", f"give shape ({count},)", "objective.thickness")
        if not np.all(np.isfinite(given) & (given > 0)):
            raise InputError("must be positive", "give metres > 0", "objective.thickness")
        self._nodal = jnp.asarray(np.broadcast_to(given, (count,)))

    def wanted(self, result: Result) -> jax.Array:
        """The target at the nodes (n_node,) [m]."""
        if self._profile is None:
            return self._nodal
        positions = result.positions
        if self._profile.along == "radius":
            # The axis has no direction; the inner `where` keeps the root's slope finite there.
            square = jnp.square(positions[:, 0]) + jnp.square(positions[:, 1])
            place = jnp.where(square > 0, jnp.sqrt(jnp.where(square > 0, square, 1.0)), 0.0)
        else:
            place = positions[:, "xyz".index(self._profile.along)]
        return jnp.interp(place, jnp.asarray(self._profile.at), jnp.asarray(self._profile.value))

    def __call__(self, scene: Scene, result: Result) -> jax.Array:
        """Mean square of the relative deviation over the formed area."""
        deviation = result.thickness / self.wanted(result) - 1.0
        weight = nodal_area(result)
        return jnp.sum(weight * jnp.square(deviation)) / jnp.sum(weight)


def formed_area(result: Result) -> jax.Array:
    """Final area of the elements (n_element,) [m^2]: an element keeps its volume; 0 where it does not exist."""
    return result.element_volume / jnp.where(result.used, result.element_thickness, 1.0)


def nodal_area(result: Result) -> jax.Array:
    """Final area that belongs to each node (n_node,) [m^2]: a third of that of its elements."""
    share = formed_area(result) / 3.0
    area = jnp.zeros_like(result.thickness)
    for corner in result.triangles.T:
        area = area.at[corner].add(share)
    return area


class Wall(NamedTuple):
    """What is reported of a part: least and mean wall [m], coefficient of variation, mass [kg], status bits."""

    least: jax.Array
    mean: jax.Array
    variation: jax.Array
    mass: jax.Array
    status: jax.Array


def wall(scene: Scene, result: Result) -> Wall:
    """Statistics of the wall over the formed area; traced."""
    area, thickness = formed_area(result), result.element_thickness
    mean = jnp.sum(area * thickness) / jnp.sum(area)
    variance = jnp.sum(area * jnp.square(thickness - mean)) / jnp.sum(area)
    return Wall(
        jnp.min(jnp.where(result.used, thickness, jnp.inf)), mean, jnp.sqrt(variance) / mean, result.mass, result.status
    )

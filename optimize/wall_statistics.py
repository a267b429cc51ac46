"""Statistics of a formed wall, traced: areas, and the values that are reported of every design."""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp

import jaxform
from jaxform import Result, Scene


def formed_area(result: Result) -> jax.Array:
    """Final area of the elements (n_element,) [m^2]: an element keeps its volume; 0 where it does not exist."""
    return result.element_volume / jnp.where(result.used, result.element_thickness, 1.0)


def nodal_area(result: Result) -> jax.Array:
    """Final area that belongs to each node (n_node,) [m^2]: a third of that of its elements."""
    return _to_nodes(result, formed_area(result))


def nodal_volume(result: Result) -> jax.Array:
    """Volume that belongs to each node (n_node,) [m^3]: a third of that of its elements."""
    return _to_nodes(result, result.element_volume)


def sheet_mass(scene: Scene) -> jax.Array:
    """Mass [kg] of the initial sheet, all that becomes flash or is cut from the part included; traced."""
    triangles, density = jnp.asarray(scene.parison.triangles), jnp.asarray(scene.material.density)
    volume = jnp.asarray(scene.tables.sheet.area) * jnp.asarray(scene.parison.thickness)[triangles].mean(1)
    return jnp.sum(volume * (density[triangles].mean(1) if density.ndim else density))


def _to_nodes(result: Result, values: jax.Array) -> jax.Array:
    shares = jnp.tile(values / 3.0, 3)
    return jnp.zeros(result.thickness.size, values.dtype).at[result.triangles.T.ravel()].add(shares)


def wall(result: Result) -> dict[str, jax.Array]:
    """Reported values of a part: least and mean wall [m], coefficient of variation, mass [kg], status bits; traced.

    The mean and the variation are those over the formed area.
    """
    area, thickness = formed_area(result), result.element_thickness
    mean = jnp.sum(area * thickness) / jnp.sum(area)
    variance = jnp.sum(area * jnp.square(thickness - mean)) / jnp.sum(area)
    return {
        "least": jnp.min(jnp.where(result.used, thickness, jnp.inf)),
        "mean": mean,
        "variation": jnp.sqrt(variance) / mean,
        "mass": result.mass,
        "status": result.status,
    }


def formed_part(scene: Scene) -> Result:
    """The part of a scene, whether or not it fills the mold: on the way of a search that is no failure."""
    return jaxform.run(dataclasses.replace(scene, fill=False))

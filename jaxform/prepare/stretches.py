"""Estimate of a sheet's largest stretch: for laws that stiffen steeply, whose steps depend on it. On the host."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

from jaxform.core.pytree import as_real
from jaxform.materials import Law
from jaxform.mechanics import membrane
from jaxform.model.scene import Parison
from jaxform.tools.mold import Mold

LARGEST_STRETCH = 6.0  # that windows are planned for at most
_MARGIN = 2.0  # of the pressure, for a sheet that swings beyond its equilibrium


def expected_stretch(parison: Parison, material: Law, pushes: np.ndarray, mold: Mold | None) -> float:
    """The stretch that a sheet reaches over most of its area, at most `LARGEST_STRETCH`.

    The pressure stretches it no further than a sphere of its size that is in equilibrium, and a mold no further than
    to its own surface.

    Args:
        parison: The sheet.
        material: Its law.
        pushes: Pressures of the process [Pa].
        mold: The mold; None for free inflation.
    """
    extents = _extents(np.asarray(parison.positions, float), parison)
    far = LARGEST_STRETCH
    if mold is None or mold.motion is None:
        load = _MARGIN * float(np.max(np.abs(pushes), initial=0.0)) * 0.5 * extents[1]
        far = float(_bearable_stretch(material, as_real(load / float(np.min(np.asarray(parison.thickness))))))
    if mold is None:
        return far
    both = _extents(np.concatenate([np.asarray(parison.positions, float), mold.where_it_turns()]), parison)
    across = 1.0 + 2.0 * (both[2] - extents[2]) / extents[1]
    across = min(across, both[2] / extents[2]) if extents[2] > 0.0 else across
    return min(far, max(*(both[:2] / extents[:2]), across))


def _extents(places: np.ndarray, parison: Parison) -> np.ndarray:
    """Lengths (3,) [m] along the axes of places (n, 3) [m], longest first, with what symmetry planes stand for."""
    on_plane = np.asarray(parison.fixed) & ~np.asarray(parison.clamped)[:, None]
    planes = [own[there].mean() if there.any() else np.nan for own, there in zip(
        np.asarray(parison.positions, float).T, on_plane.T, strict=True)]  # fmt: skip
    whole = 2.0 * np.abs(places - planes).max(0)
    return np.sort(np.where(on_plane.any(0), whole, np.ptp(places, axis=0)))[::-1]


@jax.jit
def _bearable_stretch(material: Law, load: jax.Array) -> jax.Array:
    """The largest stretch [-] at which a sphere does not bear a load, its pressure times radius over thickness [Pa]."""
    stretches = jnp.linspace(1.0, LARGEST_STRETCH, 101)

    def largest_stretch(zones: dict[str, jax.Array]) -> jax.Array:
        law = material.with_zones(zones)

        def density(stretch: jax.Array) -> jax.Array:
            square, none, one = jnp.square(stretch), jnp.zeros_like(stretch), jnp.ones_like(stretch)
            strain = membrane.invariants((square, none, square), jnp.stack([one, none, one]))
            return membrane.energy_density(strain, law)

        slope = jax.vmap(jax.grad(density))(stretches)
        yields = slope < load * jnp.square(stretches)  # beyond a limit, where it is no number, nothing does
        # One stretch further, at which it does bear it.
        return jnp.max(jnp.where(yields, jnp.append(stretches[1:], LARGEST_STRETCH), 1.0))

    zones = material.zones
    return largest_stretch(zones) if not zones else jnp.max(jax.vmap(largest_stretch, in_axes=-1)(zones))

"""Gradients of whole runs by the numbers of a load, held against central differences."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import jaxform


def assert_slopes_are_differences(
    scene: jaxform.Scene, values: dict[str, jax.Array], least: float, relative_step: float = 1e-5, **how: Any
) -> None:
    """Asserts that slopes by numbers at paths of a scene equal differences to 1e-5, and are larger than the least.

    The step is relative to the numbers; a small one meets no change of the order in which nodes come into contact.
    Further arguments are those of `jaxform.simulate`, such as `adjoint`.
    """
    base = jaxform.run(scene)
    assert int(base.status) == 0
    weight = jnp.asarray(np.random.default_rng(1).normal(size=base.positions.shape))

    def measure(numbers: dict[str, jax.Array]) -> jax.Array:
        result = jaxform.simulate(jaxform.replace(scene, numbers), schedule=base.schedule, **how)
        return jnp.sum(weight * result.positions) + 100.0 * result.thickness.mean()

    both = jax.jit(jax.value_and_grad(measure))
    slopes = both(values)[1]
    for path, present in values.items():
        way = jnp.resize(jnp.asarray([0.0, 1.0, -0.5, 0.8]), present.shape) if present.ndim else 1.0
        step = relative_step * float(jnp.abs(present).max())
        ahead, behind = (both({**values, path: present + sign * step * way})[0] for sign in (1.0, -1.0))
        found = float(jnp.sum(slopes[path] * way))
        assert abs(found) > least, path
        np.testing.assert_allclose(found, float(ahead - behind) / (2.0 * step), rtol=1e-5, err_msg=path)

"""Memory of the reverse derivative of a run."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import pytest

import jaxform
from tests import scenes


def kept_by_loops(jaxpr: Any, length: int) -> int:
    """Count of the numbers that loops of a length keep of all their passes."""
    total = 0
    for equation in jaxpr.eqns:
        for inner in jax.tree.leaves(list(equation.params.values()), is_leaf=lambda value: hasattr(value, "eqns")):
            total += kept_by_loops(inner, length) if hasattr(inner, "eqns") else 0
        if equation.primitive.name == "scan" and equation.params["length"] == length:
            total += sum(v.aval.size for v in equation.outvars if v.aval.shape[:1] == (length,))
    return total


@pytest.mark.parametrize(
    ("adjoint", "least", "most"),
    scenes.short_first([(jaxform.Reversed(), 10, 50), (jaxform.Checkpointed(), 6, 15)]),
    ids=["reversed", "checkpointed"],
)
def test_the_scene_is_kept_once_for_all_windows(adjoint: Any, least: int, most: int) -> None:
    """A window keeps so many numbers a node: positions and velocities, six, at the least."""
    scene = jaxform.load("dish-coarse")

    def objective(thickness: jax.Array) -> jax.Array:
        formed = jaxform.simulate(jaxform.replace(scene, {"parison.thickness": thickness}), adjoint=adjoint)
        return jnp.sum(jnp.square(formed.thickness))

    count = scene.tables.window_count
    kept = kept_by_loops(jax.make_jaxpr(jax.grad(objective))(scene.parison.thickness), count)
    whole, nodes = sum(leaf.size for leaf in jax.tree.leaves(scene)), len(scene.parison.positions)
    assert least * nodes < kept / count < most * nodes < 0.1 * whole

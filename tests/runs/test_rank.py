"""No array is spread over more axes than it has without a word: a row for a column would be a silent wrong answer."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxform
from jaxform import shapes
from jaxform.runs import host, padding
from tests import scenes
from tests.examples.cooling import Cooling
from tests.examples.sealed_gas import SealedGas
from tests.scenes import real


def _refined_scene() -> jaxform.Scene:
    plain, sheet = scenes.cup(), shapes.disc(radius=1.0, elements=24, symmetry="quarter")
    return jaxform.build_scene(
        parison=jaxform.make_parison(sheet.positions, sheet.triangles, 0.01, sheet.clamped, sheet.fixed),
        material=jaxform.Ogden(jnp.asarray([2.0, 0.1]), jnp.asarray([2.0, 4.0]), real(1.0)),
        pressure=plain.pressure,
        solver=plain.solver,
        mold=plain.mold,
        fill=False,
        refinement=jaxform.make_refinement(angle=5.0, interval=64, max_level=2, base_level=2, jump=0.3, elements=1024),
    )


def _own_parts() -> jaxform.Scene:
    """A gas, and a field."""
    plain = scenes.cup()
    field = Cooling(real(150.0), real(0.02), real(0.3), real(20.0), real(10.0))
    gas = SealedGas(*map(real, (1.0, 1.5, 2.0, 1.0, 1.0)))
    parts: dict[str, Any] = {"parison": plain.parison, "material": plain.material, "mold": plain.mold}
    return jaxform.build_scene(solver=plain.solver, pressure=gas, fields={"temperature": field}, **parts)


@pytest.mark.long
@pytest.mark.parametrize("make", [scenes.cup, _refined_scene, _own_parts])
def test_every_program_says_along_which_axes(make: Callable[[], jaxform.Scene]) -> None:
    scene = make()
    room = padding.pad_to_bucket(scene, recorded=True).scene

    def whole_run(scene: jaxform.Scene) -> jaxform.Result:
        state, first, taken = host.begin(scene)
        state, taken, _ = host.advance(state, scene, first, taken, np.int32(1))
        return host.result_of(state, scene, first, taken, last=True)

    def wall(thickness: jax.Array) -> jax.Array:
        design = jaxform.replace(scene, {"parison.thickness": thickness})
        return jnp.sum(jaxform.simulate(design).thickness)

    thickness = scene.parison.thickness
    with jax.numpy_rank_promotion("raise"):
        jax.make_jaxpr(whole_run)(room)
        jax.make_jaxpr(lambda h: jax.jvp(wall, (h,), (h,)))(thickness)
        jax.make_jaxpr(jax.grad(wall))(thickness)

"""JAX's settings, as users choose them: precision switched later, strict promotion of types, another device."""

from __future__ import annotations

import os
import subprocess
import sys
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxform
import optimize
from tests import scenes
from tests.runs.test_rank import _own_parts, _refined_scene

_ROOT = Path(__file__).parents[2]


def _small() -> jaxform.Scene:
    return scenes.free_disc(24, 1.0, scenes.mooney(0.1), end_time=1.0)


def _mean(scene: jaxform.Scene) -> Callable[[jax.Array], jax.Array]:
    def mean(factor: jax.Array) -> jax.Array:
        changed = jaxform.replace(scene, {"parison.thickness": factor * scene.parison.thickness})
        return jnp.mean(jaxform.simulate(changed).thickness)

    return mean


_WORK: dict[str, Callable[[jaxform.Scene], Any]] = {
    "run": jaxform.run,
    "simulate": jaxform.simulate,
    "jit": lambda scene: jax.jit(jaxform.simulate)(scene),
    "grad": lambda scene: jax.grad(lambda c: jaxform.simulate(jaxform.replace(scene, {"material.c": c})).mass)(1.0),
    "batch": lambda scene: jaxform.simulate_batch(scene, {"solver.end_time": [0.1, 0.2]}),
    "replace": lambda scene: jaxform.replace(scene, {"solver.end_time": 0.1}),
    "padded": jaxform.padded,
}


@pytest.mark.parametrize("double", [False, True])
@pytest.mark.parametrize("name", _WORK)
def test_a_scene_of_another_precision_is_refused_in_one_line(name: str, double: bool) -> None:
    with jax.enable_x64(double), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        scene = _small()
    own, now = ("float64", "float32") if double else ("float32", "float64")
    words = f"^scene: was built in {own}, and JAX computes in {now}.*; load or build the scene again"
    with jax.enable_x64(not double), pytest.raises(jaxform.InputError, match=words):
        _WORK[name](scene)


def _parts() -> dict[str, Any]:
    """Those of a cup, made now."""
    given, sheet = scenes.cup().mold, jaxform.shapes.disc(radius=1.0, elements=24, symmetry="quarter")
    assert given is not None
    return {
        "parison": jaxform.make_parison(sheet.positions, sheet.triangles, 0.01, sheet.clamped, sheet.fixed),
        "material": scenes.mooney(0.1),
        "pressure": jaxform.make_pressure([0.0, 1.0], [0.0, 1.0]),
        "solver": jaxform.make_solver(end_time=0.5, damping=1.0),
        "mold": jaxform.make_mold(np.asarray(given.vertices), np.asarray(given.triangles)),
    }


def test_parts_that_were_made_in_another_precision_make_a_scene_of_the_present_one() -> None:
    scenes.cup()
    with jax.enable_x64(False), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        old = _parts()
        schedule = jax.eval_shape(jaxform.simulate, jaxform.build_scene(**old)).schedule
    new = _parts()
    assert old["mold"].vertices.dtype == jnp.float32
    scene, same = jaxform.build_scene(**old), jaxform.build_scene(**new)
    kinds = [leaf.dtype for leaf in jax.tree.leaves(scene)]
    assert kinds == [leaf.dtype for leaf in jax.tree.leaves(same)]
    zeros = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), schedule)
    made = jax.eval_shape(lambda scene: jaxform.simulate(scene, schedule=zeros), scene)
    assert made.thickness.dtype == jnp.float64
    # An object of the present precision stays the same: what was made of it is found again.
    assert same.mold is new["mold"]


def test_a_study_of_another_precision_is_refused_in_one_line() -> None:
    with jax.enable_x64(False), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        study = optimize.load_study("dish-uniform-wall")
    with pytest.raises(jaxform.InputError, match=r"^scene: was built in float32"):
        optimize.solve(study)


@pytest.mark.long
@pytest.mark.parametrize("make", [scenes.cup, _refined_scene, _own_parts])
def test_strict_promotion_of_types_is_for_code_of_ones_own(make: Callable[[], jaxform.Scene]) -> None:
    """From the parts of a scene to the compiler's input, second derivatives included; nothing is compiled."""
    with jax.numpy_dtype_promotion("strict"):
        scene = make()
        mean = _mean(scene)
        jax.jit(jax.value_and_grad(mean)).lower(1.0)
        jax.jit(lambda way: jax.jvp(jax.grad(mean), (1.0,), (way,))[1]).lower(1.0)
        jax.jit(lambda at: jax.vmap(jax.linearize(mean, at)[1])(jnp.eye(1)[0])).lower(1.0)


@pytest.mark.long
def test_strict_promotion_of_types_changes_no_number() -> None:
    scene = _small()
    expected = jaxform.run(scene), jax.value_and_grad(_mean(scene))(1.0)
    with jax.numpy_dtype_promotion("strict"):
        found = jaxform.run(_small()), jax.value_and_grad(_mean(scene))(1.0)
    jax.tree.map(lambda a, b: a == b or pytest.fail(f"{a} {b}"), expected[1], found[1])
    assert (expected[0].thickness == found[0].thickness).all()


_DEVICES = """
import jax
jax.config.update("jax_enable_x64", True)
jax.config.update("jax_platforms", "cpu")
jax.config.update("jax_num_cpu_devices", 2)
import jax.numpy as jnp
import numpy as np
import jaxform
from tests.runs.test_settings import _mean, _small

first, second = jax.devices()

def where(tree):
    return {device for leaf in jax.tree.leaves(tree) if isinstance(leaf, jax.Array) for device in leaf.devices()}

scene = _small()
moved = jax.device_put(scene, second)
works = {
    "run": lambda scene: jaxform.run(scene, on_window=lambda now: now.result() and False),
    "simulate": lambda scene: jaxform.simulate(jaxform.replace(scene, {"pressure.value": scene.pressure.value})),
    "padded": jaxform.padded,
    "batch": lambda scene: jaxform.simulate_batch(scene, {"solver.end_time": [1.0, 0.5]}),
    "gradient": lambda scene: jax.grad(lambda h: jnp.mean(jaxform.simulate(jaxform.replace(scene, {
        "parison.thickness": h})).thickness))(scene.parison.thickness),
}
for name, work in works.items():
    there, here = work(moved), work(scene)
    assert where(there) == {second}, name
    assert where(here) == {first}, name
    for a, b in zip(jax.tree.leaves(there), jax.tree.leaves(here)):
        if isinstance(a, jax.Array):
            np.testing.assert_array_equal(a, b, name)
with jax.default_device(second):
    assert where(jaxform.run(_small())) == {second}
"""


@pytest.mark.long
def test_a_result_is_on_the_device_of_its_scene() -> None:
    known = os.environ | {
        "PYTHONPATH": os.pathsep.join([str(_ROOT), os.environ.get("PYTHONPATH", "")]),
        "XLA_FLAGS": f"{os.environ.get('XLA_FLAGS', '')} --xla_backend_optimization_level=0",
    }
    done = subprocess.run([sys.executable, "-c", _DEVICES], capture_output=True, text=True, env=known, timeout=900)
    assert done.returncode == 0, done.stderr[-3000:]

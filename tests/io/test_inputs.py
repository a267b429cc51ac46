"""Numbers that cannot be simulated: refused in words where they are known, a status where they are traced."""

from __future__ import annotations

import functools
import os
import subprocess
import sys
import tomllib
import typing
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from packaging.requirements import Requirement
from pydantic import TypeAdapter, ValidationError

import jaxform
from jaxform.core.ranges import RANGES
from jaxform.io import schema
from jaxform.model.replacing import DESIGNABLE, check_numbers
from jaxform.results import energy, summary
from jaxform.sheet.state import Status
from tests import scenes

_PROJECT = Path(__file__).parents[2] / "pyproject.toml"


@functools.cache
def _small() -> jaxform.Scene:
    return scenes.free_disc(24, 1.0, scenes.mooney(0.1), end_time=4.0)


_BAD = {
    "parison.thickness": [0.0, -1e-3],
    "pressure.time": [[0.0, 0.0], [1.0, 0.5]],
    "pressure.value": [],
    "material.c": [0.0, -1.0],
    "material.alpha": [-1e-9, -1.0],
    "material.density": [0.0, -1.0],
    "solver.end_time": [0.0, -1.0],
    "solver.damping": [-1e-9, -1.0],
}
_CASES = [(path, value) for path, values in _BAD.items() for value in [*values, np.nan, np.inf]]


@pytest.mark.parametrize(("path", "value"), _CASES)
def test_replace_refuses_what_no_file_may_hold(path: str, value: Any) -> None:
    with pytest.raises(jaxform.InputError) as caught:
        jaxform.replace(_small(), {path: value})
    assert str(caught.value).startswith(f"{path} = ")
    assert caught.value.remedy


_FILES = {
    "material.c": (schema.NeoHookean, "c"),
    "material.alpha": (schema.MooneyRivlin, "alpha"),
    "material.a01": (schema.ModifiedMooneyRivlin, "a01"),
    "material.a02": (schema.ModifiedMooneyRivlin, "a02"),
    "material.density": (schema.NeoHookean, "density"),
    "parison.thickness": (schema.Disc, "thickness"),
} | {
    path: (getattr(schema, path.split(".")[0].capitalize()), path.split(".")[1])
    for path in RANGES
    if path.startswith(("solver", "refinement"))
}


@pytest.mark.parametrize("path", sorted(_FILES))
def test_files_take_their_ranges_from_the_same_declaration(path: str) -> None:
    table, name = _FILES[path]
    allowed = RANGES[path]
    field, made = table.model_fields[name], typing.cast(Any, typing.Annotated)
    kind: Any = schema.Thickness if name == "thickness" else made[field.annotation, field]
    taken = TypeAdapter(kind)
    step = 1 if allowed.count else 1e-9
    edges = [(allowed.above, False), (allowed.least, True), (allowed.most, True)]
    edges += [(edge - step, False) for edge in (allowed.above, allowed.least) if edge is not None]
    edges += [(allowed.most + step, False)] if allowed.most is not None else []
    for edge, good in edges:
        if edge is None:
            continue
        assert bool(allowed.holds(edge)) == good
        try:
            taken.validate_python(edge)
        except ValidationError:
            assert not good, (path, edge)
        else:
            assert good, (path, edge)


def test_constructors_refuse_what_is_out_of_range() -> None:
    for name, value in (("end_time", 0.0), ("damping", -1.0), ("safety", 1.5), ("damping", "1"), ("end_time", [1, 2])):
        with pytest.raises(jaxform.InputError, match=f"^solver.{name}"):
            jaxform.make_solver(**{"end_time": 1.0, name: value})  # pyright: ignore
    with pytest.raises(jaxform.InputError, match=r"refinement.interval = 2.5: is not a whole number"):
        jaxform.make_refinement(angle=5.0, interval=2.5, max_level=2, elements=9)  # pyright: ignore
    with pytest.raises(jaxform.InputError, match=r"refinement.scaled_levels = 3: is more than the 2 levels"):
        jaxform.make_refinement(angle=5.0, interval=32, max_level=1, base_level=2, elements=9, scaled_levels=3)
    with pytest.raises(jaxform.InputError, match=r"pressure.value.*complex"):
        jaxform.make_pressure([0.0, 1.0], [0.0, 1j])  # pyright: ignore


_KINDS = [
    (None, "no array of numbers"),
    ("1.0", "a text"),
    (["1", "2"], "a text"),
    ([1j, 2.0], "complex"),
    ([True, False], "true or false"),
    (np.array([None, 1.0]), "no array of numbers"),
    ([[0.0, 1.0], [0.0]], "rows of different lengths"),
    ({}, "no array of numbers"),
    (10**400, "no array of numbers"),
    (jnp.asarray([1j, 2.0]), "complex"),
]


@pytest.mark.parametrize(("value", "words"), _KINDS)
def test_what_is_no_number_is_refused_in_words(value: Any, words: str) -> None:
    for take in (jaxform.replace, jaxform.simulate_batch):
        with pytest.raises(jaxform.InputError, match=rf"^pressure.value.*{words}"):
            take(_small(), {"pressure.value": value})


def test_batches_that_do_not_fit_are_refused_in_words() -> None:
    rows = np.ones((2, 2))
    for changes, words in (
        ({}, "as many rows"),
        ({"pressure.value": rows, "material.c": np.ones(3)}, "as many rows"),
        ({"pressure.value": np.ones((2, 3))}, "shape"),
        ({"pressure.value": [[0.0, 1.0], [0.0, np.nan]]}, "not finite"),
        (None, "no mapping"),
    ):
        with pytest.raises(jaxform.InputError, match=words):
            jaxform.simulate_batch(_small(), changes)  # pyright: ignore
    with pytest.raises(jaxform.InputError, match="workers = 0"):
        jaxform.simulate_batch(_small(), {"pressure.value": rows}, workers=0)
    with pytest.raises(jaxform.InputError, match="not differentiable"):
        jax.eval_shape(lambda rows: jaxform.simulate_batch(_small(), {"pressure.value": rows}), rows)


_TRACED: list[tuple[dict[str, Any], list[str]]] = [
    ({"parison.thickness": (3, -1e-4)}, ["parison.thickness [m] must be finite and positive"]),
    ({"parison.thickness": (3, np.nan)}, ["parison.thickness"]),
    ({"parison.thickness": (slice(None), np.nan)}, ["parison.thickness"]),
    ({"pressure.time": (1, -1.0)}, ["pressure.time [s] must be finite and increase"]),
    ({"pressure.value": (1, np.inf)}, ["pressure.value [Pa] must be finite"]),
    ({"material.c": (..., -1.0)}, ["material.c"]),
    ({"material.alpha": (..., -1.0)}, ["material.alpha must be finite and not be negative"]),
    ({"material.density": (..., 0.0), "solver.damping": (..., -1.0)}, ["material.density", "solver.damping"]),
    ({"solver.end_time": (..., np.nan)}, ["solver.end_time"]),
]


def test_traced_numbers_out_of_range_are_a_status_of_their_own() -> None:
    scene = _small()
    numbers = {path: getattr(getattr(scene, path.split(".")[0]), path.split(".")[1]) for path in _BAD}
    work = jax.jit(lambda changes: jaxform.simulate(jaxform.replace(scene, changes)))
    good = work(numbers)
    assert jaxform.explain(good) == "ok"
    assert float(good.positions[:, 2].max()) > 0.1
    for changes, words in _TRACED:
        bad = work(numbers | {path: numbers[path].at[at].set(value) for path, (at, value) in changes.items()})
        assert int(bad.status) == Status.INPUT
        for leaf in jax.tree.leaves(bad):
            assert np.all(np.isfinite(leaf)), changes
        np.testing.assert_array_equal(bad.positions, scene.parison.positions)
        at = changes.get("parison.thickness", (slice(0), 0.0))[0]
        np.testing.assert_allclose(bad.thickness, scene.parison.thickness.at[at].set(0.0), rtol=1e-12)
        sentence = jaxform.explain(bad)
        for word in words:
            assert word in sentence
        assert sum(path in sentence for path in DESIGNABLE) == len(words)
    both = jax.tree.map(lambda *leaves: np.stack(leaves), good, bad)
    assert jaxform.explain(both) == ["ok", jaxform.explain(bad)]


def test_the_host_refuses_what_a_trace_let_through() -> None:
    scene = jax.jit(lambda c: jaxform.replace(_small(), {"material.c": c}))(-1.0)
    for work in (check_numbers, jaxform.run):
        with pytest.raises(jaxform.InputError, match=r"material.c = -1.0: must be positive"):
            work(scene)


@pytest.mark.parametrize("other", [None, "ok", np.zeros(3)])
def test_only_results_are_explained(other: Any) -> None:
    with pytest.raises(jaxform.InputError, match="is no result"):
        jaxform.explain(other)


def test_a_sheet_that_hardly_moves_is_warned_of_and_balanced() -> None:
    scene = jaxform.replace(_small(), {"material.density": 1e30})
    with pytest.warns(UserWarning, match=r"the sheet hardly moved.*material.density"):
        part = jaxform.run(scene)
    assert float(part.energy.balance_error) < energy.UNBALANCED
    assert float(part.energy.quasi_static_error) == 0.0
    assert any("hardly moved" in sentence for sentence in jaxform.summarize(part, scene)["warnings"])
    still = jaxform.replace(_small(), {"pressure.value": 0.0})
    assert summary.warnings_of(part, still) == []


_SHARDED = """
import jax, sys
jax.config.update("jax_enable_x64", True)
jax.config.update("jax_platforms", "cpu")
jax.config.update("jax_num_cpu_devices", 2)
import jax.numpy as jnp, numpy as np, jaxform
from jax.sharding import Mesh, PartitionSpec
from tests.io.test_inputs import _small

scene = _small()
mesh = Mesh(np.array(jax.devices()), ("device",))
assert mesh.size == 2

def figure(wall):
    return jnp.sum(jaxform.simulate(jaxform.replace(scene, {"parison.thickness": wall})).thickness)

shared = jax.shard_map(
    jax.vmap(jax.value_and_grad(figure)), mesh=mesh, in_specs=PartitionSpec("device"), out_specs=PartitionSpec("device")
)
wall = scene.parison.thickness
way = jnp.cos(jnp.arange(wall.size)) * wall
walls = jnp.stack([wall, wall + 1e-4 * way, wall - 1e-4 * way, wall.at[2].set(jnp.nan)])
quickly = {"xla_backend_optimization_level": 0, "xla_llvm_disable_expensive_passes": True}
values, slopes = jax.jit(shared).lower(walls).compile(quickly)(walls)
difference = (values[1] - values[2]) / 2e-4
np.testing.assert_allclose(slopes[0] @ way, difference, rtol=1e-6)
assert np.all(np.isfinite(values)) and np.all(np.isfinite(slopes))
print(float(values[0]).hex())
"""


def test_shard_map_shares_designs_out_with_their_gradients() -> None:
    """On two devices made of the processor, with JAX's defaults; a design out of range spoils no other gradient."""
    known = os.environ | {"PYTHONPATH": os.pathsep.join([str(_PROJECT.parent), os.environ.get("PYTHONPATH", "")])}
    done = subprocess.run([sys.executable, "-c", _SHARDED], capture_output=True, text=True, env=known, timeout=900)
    assert done.returncode == 0, done.stderr[-3000:]
    alone = float(jnp.sum(jaxform.run(_small()).thickness))
    np.testing.assert_allclose(float.fromhex(done.stdout.split()[-1]), alone, rtol=1e-9)


def test_jax_is_within_the_bound_that_the_project_states() -> None:
    """Raising the installed version past it must be a decision."""
    stated = tomllib.loads(_PROJECT.read_text())
    (bound,) = [Requirement(text) for text in stated["project"]["dependencies"] if Requirement(text).name == "jax"]
    assert bound.specifier.contains(jax.__version__)
    assert {clause.operator for clause in bound.specifier} == {">=", "<"}
    (locked,) = [Requirement(text) for text in stated["tool"]["uv"]["constraint-dependencies"]]
    assert locked.name == "jax" and locked.specifier.contains(jax.__version__)

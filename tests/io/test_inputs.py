"""Numbers that cannot be simulated: refused in words where they are known, a status where they are traced."""

from __future__ import annotations

import dataclasses
import functools
import json
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
import optax
import pytest
from packaging.requirements import Requirement
from pydantic import TypeAdapter, ValidationError

import jaxform
from jaxform.core.pytree import parameter_ranges
from jaxform.core.ranges import RANGES
from jaxform.io import files, output, schema
from jaxform.io.schema.scene import Gravity
from jaxform.materials import LAWS
from jaxform.model.replacement import DESIGNABLE, check_numbers, number_at
from jaxform.results import result as result_module
from jaxform.results import summary
from jaxform.sheet.state import Status
from tests import scenes

pytestmark = pytest.mark.quick

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


_FILES = (
    {"parison.thickness": (schema.Disc, RANGES["parison.thickness"])}
    | {
        path: (getattr(schema, path.split(".")[0].capitalize() + "Table"), allowed)
        for path, allowed in RANGES.items()
        if path.startswith(("solver", "refinement"))
    }
    | {
        f"{model}.{name}": (schema.material_table(model, law), allowed)
        for model, law in LAWS.items()
        for name, allowed in parameter_ranges(law).items()
    }
)


@pytest.mark.parametrize("path", sorted(_FILES))
def test_files_take_their_ranges_from_the_same_declaration(path: str) -> None:
    (table, allowed), name = _FILES[path], path.partition(".")[2]
    field, made = table.model_fields[name], typing.cast(Any, typing.Annotated)
    kind: Any = schema.Thickness if name == "thickness" else made[field.annotation, field]
    if path.startswith("ogden") and name != "density":
        kind = typing.get_args(field.annotation)[0]  # of one entry of the list
    if path == "solver.gravity":
        kind = Gravity
    taken = TypeAdapter(kind)
    step = 1 if allowed.count else 1e-9
    edges = [(allowed.above, False), (allowed.least, True), (allowed.most, True)]
    edges += [(edge - step, False) for edge in (allowed.above, allowed.least) if edge is not None]
    edges += [(allowed.most + step, False)] if allowed.most is not None else []
    for edge, good in edges:
        if edge is None:
            continue
        assert bool(allowed.contains(edge)) == good
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
    with pytest.raises(jaxform.InputError, match=r"refinement.mass_scaling_levels = 3: is more than the 2 levels"):
        jaxform.make_refinement(angle=5.0, interval=32, max_level=1, base_level=2, elements=9, mass_scaling_levels=3)
    with pytest.raises(jaxform.InputError, match=r"pressure.value.*complex"):
        jaxform.make_pressure([0.0, 1.0], [0.0, 1j])  # pyright: ignore


def test_older_names_of_keys_are_accepted_with_a_warning() -> None:
    limits: dict[str, typing.Any] = {"angle": 5.0, "interval": 32, "max_level": 2, "elements": 9}
    with pytest.warns(jaxform.InputWarning, match=r"refinement.base_reach = 2.0: is the older name of refinement.prox"):
        old = jaxform.make_refinement(**limits, base_reach=2.0)
    with pytest.warns(
        jaxform.InputWarning, match=r"refinement.scaled_levels = 1: is the older name of refinement.mass"
    ):
        assert jaxform.make_refinement(**limits, scaled_levels=1).mass_scaling_levels == 1
    assert float(old.proximity_factor) == 2.0
    with pytest.raises(TypeError, match="base_reech"):
        jaxform.make_refinement(**limits, base_reech=2.0)


def test_older_names_of_keys_in_files(tmp_path: Path) -> None:
    path, refined = tmp_path / "scene.toml", "[refinement]\nmax_level = 2\nscaled_levels = 1\n"
    path.write_text(scenes.FILE + refined)
    with pytest.warns(jaxform.InputWarning, match=r"scene.toml: refinement.scaled_levels = 1: is the older name"):
        document = files.read_scene(path)
    assert document.model.refinement is not None and document.model.refinement.mass_scaling_levels == 1
    assert document.data["refinement"] == {"max_level": 2, "mass_scaling_levels": 1}
    path.write_text(scenes.FILE + refined + "mass_scaling_levels = 1\n")
    with pytest.raises(jaxform.InputError, match=r"scene.toml: refinement.scaled_levels = 1: .*, which is given, too"):
        files.read_scene(path)
    with pytest.warns(jaxform.InputWarning, match=r"refinement.base_reach"):
        made = jaxform.scenes.dish(elements=60, refinement={"base_reach": 0.5, "max_level": 2, "base_level": 2})
    assert made.refinement is not None and float(made.refinement.proximity_factor) == 0.5


_KINDS = [
    (None, "not an array of numbers"),
    ("1.0", "a string"),
    (["1", "2"], "a string"),
    ([1j, 2.0], "complex"),
    ([True, False], "true or false"),
    (np.array([None, 1.0]), "not an array of numbers"),
    ([[0.0, 1.0], [0.0]], "rows of different lengths"),
    ({}, "not an array of numbers"),
    (10**400, "not an array of numbers"),
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
        ({}, "same number of rows"),
        ({"pressure.value": rows, "material.c": np.ones(3)}, "same number of rows"),
        ({"pressure.value": np.ones((2, 3))}, "shape"),
        ({"pressure.value": [[0.0, 1.0], [0.0, np.nan]]}, "not finite"),
        (None, "not a mapping"),
    ):
        with pytest.raises(jaxform.InputError, match=words):
            jaxform.simulate_batch(_small(), changes)  # pyright: ignore
    with pytest.raises(jaxform.InputError, match="workers = 0"):
        jaxform.simulate_batch(_small(), {"pressure.value": rows}, workers=0)
    with pytest.raises(jaxform.InputError, match="not differentiable"):
        jax.eval_shape(lambda rows: jaxform.simulate_batch(_small(), {"pressure.value": rows}), rows)


_WALLS = ("thickness", "element_thickness", "element_volume", "stretches", "mass")
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


@pytest.mark.long
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
        walls = {name: getattr(bad, name) for name in _WALLS}
        assert all(np.all(np.isnan(values)) for values in walls.values()), changes
        for leaf in jax.tree.leaves(dataclasses.replace(bad, **dict.fromkeys(_WALLS))):
            assert np.all(np.isfinite(leaf)), changes
        np.testing.assert_array_equal(bad.positions, scene.parison.positions)
        sentence = jaxform.explain(bad)
        for word in words:
            assert word in sentence
        assert sum(f"{path} " in sentence for path in DESIGNABLE) == len(words)
    both = jax.tree.map(lambda *leaves: np.stack(leaves), good, bad)
    assert jaxform.explain(both) == ["ok", jaxform.explain(bad)]


def _unevenness(result: jaxform.Result) -> jax.Array:
    """As users write it: by the elements' formed areas."""
    area = result.element_volume / result.element_thickness
    mean = jnp.sum(area * result.element_thickness) / jnp.sum(area)
    return jnp.sum(area * (result.element_thickness / mean - 1.0) ** 2) / jnp.sum(area)


@pytest.mark.long
def test_a_line_search_backs_off_from_a_design_out_of_range() -> None:
    """The sheet at rest is as even as can be: for a search that counts it, no design would be better."""
    scene = _small()

    @jax.jit
    def value(time: jax.Array) -> jax.Array:
        return _unevenness(jaxform.simulate(jaxform.replace(scene, {"pressure.time": time})))

    good = scene.pressure.time
    crossing = good.at[0].set(1.01 * good[-1])
    assert float(value(good)) > 1e-6
    assert not float(value(crossing)) < float(value(good))
    slope = jnp.zeros_like(good).at[0].set(-1.0)  # downhill is where the times cross
    search = optax.scale_by_backtracking_linesearch(max_backtracking_steps=12)
    step, state = search.update(
        crossing - good, search.init(good), good, value=value(good), grad=1e-9 * slope, value_fn=value
    )
    assert float(np.abs(np.asarray(step)).max()) < float(jnp.abs(crossing - good).max())
    value_there: Any = optax.tree.get(state, "value")
    assert np.isfinite(float(value(good + np.asarray(step)))) and np.isfinite(float(value_there))


@pytest.mark.long
def test_of_a_batch_only_the_design_out_of_range_has_no_wall_and_gradients_raise_nothing() -> None:
    scene, stiffness = _small(), number_at(_small(), "material.c")
    factors = jnp.asarray([1.0, -1.0, 1.1])

    def value(factor: jax.Array) -> tuple[jax.Array, jaxform.Result]:
        result = jaxform.simulate(jaxform.replace(scene, {"material.c": factor * stiffness}))
        return _unevenness(result), result

    (values, results), slopes = jax.jit(jax.vmap(jax.value_and_grad(value, has_aux=True)))(factors)
    np.testing.assert_array_equal(np.isnan(values), [False, True, False])
    np.testing.assert_array_equal(np.isnan(results.mass), [False, True, False])
    assert results.status.tolist() == [0, jaxform.Status.INPUT, 0]
    assert np.isfinite(np.asarray(slopes)[[0, 2]]).all()
    np.testing.assert_allclose(values[0], value(jnp.asarray(1.0))[0], rtol=1e-9)


@pytest.mark.long
def test_a_summary_of_a_design_out_of_range_is_valid_json(tmp_path: Path) -> None:
    scene = _small()
    bad = jax.jit(lambda c: jaxform.simulate(jaxform.replace(scene, {"material.c": c})))(-1.0)
    output.write_json(tmp_path / "summary.json", jaxform.summarize(bad, scene))

    def refuse(word: str) -> None:
        raise AssertionError(f"{word} is no JSON")

    kept = json.loads((tmp_path / "summary.json").read_text(), parse_constant=refuse)
    assert kept["thickness"] == dict.fromkeys(("min", "mean", "max", "cv")) and kept["mass"] is None
    assert "material.c" in kept["status"]


def test_the_host_refuses_what_a_trace_let_through() -> None:
    scene = jax.jit(lambda c: jaxform.replace(_small(), {"material.c": c}))(-1.0)
    for work in (check_numbers, jaxform.run):
        with pytest.raises(jaxform.InputError, match=r"material.c = -1.0: must be positive"):
            work(scene)


@pytest.mark.parametrize("other", [None, "ok", np.zeros(3)])
def test_only_results_are_explained(other: Any) -> None:
    with pytest.raises(jaxform.InputError, match="is not a result"):
        jaxform.explain(other)


def test_a_sheet_that_hardly_moves_is_warned_of_and_balanced() -> None:
    scene = jaxform.replace(_small(), {"material.density": 1e30})
    with pytest.warns(UserWarning, match=r"the sheet hardly moved.*material.density"):
        part = jaxform.run(scene)
    assert float(part.energy.balance_error) < result_module.UNBALANCED
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
assert np.all(np.isfinite(values[:3])) and np.isnan(values[3]) and np.all(np.isfinite(slopes[:3]))
print(float(values[0]).hex())
"""


@pytest.mark.long
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

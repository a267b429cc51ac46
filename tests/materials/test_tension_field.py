"""Sheets that go slack instead of being compressed, against the least energy, exact shapes and differences."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import jax
import jax.numpy as jnp
import meshio
import numpy as np
import pytest

import jaxform
from jaxform import shapes
from jaxform.core.errors import InputError
from jaxform.io import files, output
from jaxform.mechanics import constitutive, membrane
from jaxform.results import tool_contact
from tests import scenes
from tests.scenes import real

MOONEY = jaxform.MooneyRivlin(real(1.0), real(0.1), real(1.0), tension_field=True)
OGDEN = jaxform.Ogden(jnp.asarray([1.6, 0.2]), jnp.asarray([1.5, 4.0]), real(1.0), tension_field=True)
NEO_HOOKEAN = jaxform.NeoHookean(real(1.0), real(1.0), tension_field=True)
LAWS = pytest.mark.parametrize("law", [MOONEY, OGDEN], ids=["mooney-rivlin", "ogden"])
FLAT = pytest.mark.parametrize("law", [NEO_HOOKEAN, MOONEY, OGDEN], ids=["neo-hookean", "mooney-rivlin", "ogden"])
COUNT = 200
UNIT = jnp.ones(COUNT), jnp.zeros(COUNT), jnp.ones(COUNT)
SKEWED = 1.4 * UNIT[0], -0.3 * UNIT[0], 0.8 * UNIT[0]  # inverse of an initial metric


def gradients() -> jax.Array:
    """Random deformation gradients (3, 2, n) from slack in all directions to taut."""
    random = np.random.default_rng(3)
    return jnp.asarray(random.normal(size=(3, 2, COUNT)) * random.uniform(0.2, 2.0, COUNT))


def metric_of(gradient: jax.Array) -> membrane.Metric:
    c = jnp.einsum("kin,kjn->ijn", gradient, gradient)
    return c[0, 0], c[0, 1], c[1, 1]


G = metric_of(gradients())


def density(g: membrane.Metric, law: jaxform.Law, initial: membrane.Metric = UNIT) -> jax.Array:
    return membrane.energy_density(membrane.invariants(g, initial), law)


def stress(g: membrane.Metric, law: jaxform.Law, initial: membrane.Metric) -> membrane.Metric:
    return membrane.stress(g, initial, membrane.stress_factors(g, initial, law))


@FLAT
@pytest.mark.parametrize("size", [0.0, 1e-16, 1e-13, 1e-10, 1e-7])
def test_next_to_no_strain_is_next_to_no_stress(law: jaxform.Law, size: float) -> None:
    """Rounding says what is slack; each of several loops that XLA makes of it must hear the same."""
    sheet = shapes.disc(radius=1.0, elements=2048, symmetry="quarter")
    flat, triangles = jnp.asarray(sheet.positions).T, jnp.asarray(sheet.triangles).T
    initial, _ = membrane.reference_metric(flat, triangles)
    moved = flat + size * np.random.default_rng(1).normal(size=flat.shape)

    def stresses(positions: jax.Array) -> membrane.Metric:
        own = initial[0], initial[1], initial[2]
        return stress(membrane.metric(*membrane.edges(positions, triangles)[1:]), law, own)

    # As it is compiled for users: with products and sums in one, rounded here so and there so.
    compiled = jax.jit(stresses).lower(moved).compile({"xla_backend_optimization_level": 2})
    inverse = np.abs(initial).max(0)
    for own in compiled(moved):
        # Edges are a fiftieth of the radius.
        assert np.abs(np.asarray(own) / inverse).max() < 2e-13 + 1e4 * size


@LAWS
def test_the_energy_is_the_least_of_all_wider_strains(law: jaxform.Law) -> None:
    """Wrinkles take up length in both directions: Pipkin's relaxed energy."""
    plain = dataclasses.replace(law, tension_field=False)
    more = np.concatenate([np.linspace(0.0, 1.5, 101), [3.0, 8.0]])
    first, second = (
        np.asarray(own)[:, None, None] for own in membrane.principal_stretches(membrane.invariants(G, UNIT))
    )
    a, b = np.broadcast_arrays(first + more[:, None], second + more)
    strain = membrane._invariants(jnp.asarray((a**2 + b**2).ravel()), jnp.asarray(((a * b) ** 2).ravel()))
    least = np.asarray(membrane.energy_density(strain, plain)).reshape(COUNT, -1).min(1)
    # The widths stand 0.015 apart, about a minimum.
    np.testing.assert_allclose(density(G, law), least, rtol=1e-3, atol=1e-3)


@LAWS
def test_the_stress_is_the_derivative_of_the_energy(law: jaxform.Law) -> None:
    slopes = jax.jit(jax.grad(lambda g: density(g, law, SKEWED).sum()))(G)
    expected = 2.0 * slopes[0], slopes[1], 2.0 * slopes[2]
    np.testing.assert_allclose(stress(G, law, SKEWED), expected, rtol=1e-9, atol=1e-11)


def test_a_sheet_that_is_not_strained_or_slack_all_over_has_no_stress() -> None:
    share = jnp.resize(jnp.asarray([1.0, 1.0 - 1e-15, 0.7, 1e-6]), (COUNT,))
    g = share, jnp.zeros(COUNT), share
    change = 0.3 * share, 0.1 * share, -0.2 * share
    found, slopes = jax.jvp(lambda g: stress(g, MOONEY, UNIT), (g,), (change,))
    np.testing.assert_allclose(found, 0.0, atol=1e-14)
    assert np.isfinite(np.asarray(slopes)).all()


@LAWS
def test_the_bound_on_the_step_is_that_of_the_sheet_once_it_is_taut(law: jaxform.Law) -> None:
    """Not below the largest eigenvalue of the exact second derivative, and equal to it where nothing is slack."""

    def one(x: jax.Array) -> jax.Array:
        c = x.T @ x
        strain = membrane.invariants((c[:1, 0], c[:1, 1], c[1:, 1]), (UNIT[0][:1], UNIT[1][:1], UNIT[2][:1]))
        return membrane.energy_density(strain, law)[0]

    hessians = jax.jit(jax.vmap(jax.hessian(one)))(gradients().transpose(2, 0, 1))
    largest = np.linalg.eigvalsh(np.asarray(hessians).reshape(COUNT, 6, 6)).max(1)
    strain = membrane.invariants(G, UNIT)
    bound = np.asarray(constitutive.tangent_stiffness(strain, law))
    assert np.all(largest <= bound * (1 + 1e-9))
    taut = ~np.asarray(membrane.relax_strain(strain)[1].slack)
    assert 20 < taut.sum() < COUNT - 20
    np.testing.assert_allclose(largest[taut], bound[taut], rtol=1e-8)


def test_the_metric_of_the_taut_sheet_has_the_strain_that_the_slack_one_is_relaxed_to() -> None:
    found = membrane.invariants(membrane.relaxed_metric(G, SKEWED), SKEWED)
    expected, _ = membrane.relax_strain(membrane.invariants(G, SKEWED))
    np.testing.assert_allclose(found, expected, rtol=1e-7)


def balloon(law: jaxform.Law, elements: int, end_time: float = 60.0) -> jaxform.Scene:
    """An eighth of two discs of radius 1 that are joined along their rims, blown up by little pressure."""
    sheet = shapes.disc(radius=1.0, elements=elements, symmetry="quarter")
    fixed = np.array(sheet.fixed)
    fixed[np.asarray(sheet.clamped), 2] = True
    free = np.zeros(len(sheet.positions), bool)
    parison = jaxform.make_parison(sheet.positions, sheet.triangles, 0.01, free, fixed)
    return jaxform.build_scene(
        parison=parison,
        material=law,
        pressure=jaxform.make_pressure([0.0, 1.0], [0.0, 0.02 * 0.01]),
        solver=jaxform.make_solver(end_time=end_time, damping=0.3),
    )


def test_two_discs_become_a_mylar_balloon() -> None:
    """Without stretch its radius is 0.7627 of theirs, half its height 0.4568 (W. Paulsen, Am. Math. Mon. 101, 1994).

    Its rim wrinkles; a sheet that bears compression cannot become so.
    """
    scene = balloon(MOONEY, 250)
    result = jaxform.run(scene)
    assert jaxform.explain(result) == "ok"
    places = np.asarray(result.positions)
    radius, height = np.hypot(*places[:, :2].T).max(), places[:, 2].max()
    np.testing.assert_allclose([radius, height], [0.7627, 0.4568], rtol=0.02)
    told = jaxform.summarize(result, scene)
    assert told["energy"]["balance_error"] < 1e-3
    # Half its surface is pi^2 / 2 times the square of its radius; the rest of the discs' lies in folds.
    np.testing.assert_allclose(told["wrinkled_fraction"], 1.0 - np.pi / 2 * 0.7627**2, atol=0.005)


@pytest.mark.long
def test_a_file_asks_for_it_and_the_part_tells_of_its_wrinkles(tmp_path: Path) -> None:
    path = tmp_path / "scene.toml"
    path.write_text(scenes.FILE.replace("[material]\n", "[material]\ntension_field = true\n"))
    scene = jaxform.load(path)
    assert scene.material.tension_field
    result = jaxform.run(scene)
    told = output.write_result(scene, result, tmp_path)
    found = meshio.read(tmp_path / "final.vtu").cell_data["wrinkled"][0]
    assert found.min() >= -1e-12 and found.max() < 1.0
    assert told["wrinkled_fraction"] == json.loads((tmp_path / "summary.json").read_text())["wrinkled_fraction"]
    area = tool_contact.formed_areas(result)
    np.testing.assert_allclose(told["wrinkled_fraction"], area @ found / area.sum(), rtol=1e-9)


def test_viscous_modes_cannot_go_slack(tmp_path: Path) -> None:
    path = tmp_path / "scene.toml"
    text = scenes.FILE.replace("[material]\n", "[material]\ntension_field = true\n")
    path.write_text(text + '[material.viscous]\nkind = "maxwell"\nmodulus = [1e5]\ntime = [0.1]\n')
    with pytest.raises(InputError, match=r"scene\.toml.*material\.tension_field.*Prony terms"):
        files.build(files.read_scene(path))

"""The membrane force: it comes from its energy, and its own derivatives are those of its plain formula."""

from __future__ import annotations

import dataclasses
import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxform
from jaxform import shapes
from jaxform.core.compilation import compile_function
from jaxform.kernels import blocks
from jaxform.materials import Law
from jaxform.mechanics import constitutive, force, membrane
from jaxform.mechanics.corners import Load
from jaxform.mechanics.elements import Elements
from jaxform.model.tables import ReferenceGeometry
from jaxform.sheet import packing
from tests import scenes
from tests.scenes import mooney, real

ONE_BY_ONE_AND_IN_PAIRS = pytest.mark.parametrize("paired", [False, True])

LAWS = [
    jaxform.NeoHookean(real(1.3), real(1.0)),
    mooney(0.2, 1.3),
    jaxform.ModifiedMooneyRivlin(real(1.3), real(0.05), real(1.0)),
]


# Each law one way, and one of them in both.
LAWS_IN_BOTH_WAYS = pytest.mark.parametrize(
    ("law", "paired"),
    scenes.short_first([(LAWS[0], False), (LAWS[2], True), (LAWS[1], True), (LAWS[2], False)], 2),
)


def _case(law: Law, *, paired: bool = False, seed: int = 0) -> tuple[Load, Elements]:
    disc = shapes.disc(radius=1.0, elements=40, symmetry="quarter")
    random = np.random.default_rng(seed)
    start = jnp.asarray(disc.positions.T)
    triangles = jnp.asarray(disc.triangles.T)
    inverse, area = membrane.reference_metric(start, triangles)
    moved = 1.2 * start + 0.05 * random.normal(size=start.shape)
    thickness = jnp.asarray(0.01 * random.uniform(0.5, 1.5, area.size))
    sheet = ReferenceGeometry(triangles, inverse, area, jnp.zeros(3))
    if paired:
        assembly = packing.make_paired_assembly(disc.positions, disc.triangles)
    else:
        assembly = packing.make_assembly(disc.triangles, len(disc.positions))
    packed = packing.pack(None, sheet, assembly)
    assert (packed.elements.orientation is not None) == paired
    return Load(packed.pack(moved), thickness[packed.element], real(0.3), law), packed.elements


def _random_like(tree: object, seed: int) -> object:
    random = np.random.default_rng(seed)
    return jax.tree.map(lambda leaf: jnp.asarray(random.normal(size=leaf.shape)), tree)


@pytest.mark.parametrize("backend", ["cpu", "another"])
@pytest.mark.parametrize("depth", [1, 2, 6])
def test_rows_are_looked_up_together_and_summed(depth: int, backend: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(membrane.jax, "default_backend", lambda: backend)
    random = np.random.default_rng(depth)
    rows = random.normal(size=(3, 20))
    rows[:, 0] = [0.0, -0.0, np.nan]
    index = random.integers(0, 20, (depth, 50))
    index[:, 0] = 0
    got = jax.jit(membrane.gather_sum)([jnp.asarray(row) for row in rows], jnp.asarray(index))
    expected = functools.reduce(np.add, [rows[:, places] for places in index])
    np.testing.assert_allclose(got, expected, rtol=1e-13, atol=1e-13)
    if depth == 1:
        alone = membrane.gather_rows([jnp.asarray(row) for row in rows], jnp.asarray(index[0]))
        np.testing.assert_array_equal(alone, rows[:, index[0]])
        assert backend != "cpu" or np.signbit(alone[1][0])


@ONE_BY_ONE_AND_IN_PAIRS
def test_the_longest_vectors_change_no_number(paired: bool) -> None:
    load, sheet = _case(LAWS[2], paired=paired)
    work = jax.jit(force.force)
    usual, longest = work(load, sheet), compile_function(work, load, sheet)(load, sheet)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-14, atol=1e-17), usual, longest)


@LAWS_IN_BOTH_WAYS
def test_internal_force_is_minus_the_slope_of_the_energy(law: Law, paired: bool) -> None:
    load, sheet = _case(law, paired=paired)
    load = load._replace(pressure=real(0.0))

    def energy(positions: jax.Array) -> jax.Array:
        volume = sheet.area * load.thickness
        return membrane.strain_energy(positions, sheet.triangles, sheet.inverse_metric, volume, law)

    expected = -jax.grad(energy)(load.positions)
    np.testing.assert_allclose(force.force(load, sheet)[0], expected, atol=1e-13 * float(jnp.abs(expected).max()))


@ONE_BY_ONE_AND_IN_PAIRS
def test_pressure_force_is_pressure_times_the_slope_of_the_volume_inside(paired: bool) -> None:
    load, sheet = _case(LAWS[0], paired=paired)
    soft = load._replace(thickness=0.0 * load.thickness)
    slope = jax.grad(lambda x: force.force(soft._replace(positions=x), sheet)[1])(load.positions)
    inner = np.setdiff1d(np.asarray(sheet.triangles), _boundary(sheet))
    assert len(inner) > 5
    got = force.force(soft, sheet)[0]
    np.testing.assert_allclose(got[:, inner], load.pressure * slope[:, inner], atol=1e-14)


def _boundary(sheet: Elements) -> np.ndarray:
    from jaxform.mesh import topology

    return topology.boundary_nodes(np.asarray(sheet.triangles.T)[np.asarray(sheet.area) > 0])


@LAWS_IN_BOTH_WAYS
def test_tangent_and_cotangent_equal_those_of_the_plain_formula(law: Law, paired: bool) -> None:
    _compare_derivatives(*_case(law, paired=paired))


def test_tangent_and_cotangent_by_numbers_that_vary_over_the_sheet() -> None:
    load, sheet = _case(LAWS[1], paired=True)
    random = np.random.default_rng(4)
    zones = {"c": random.uniform(1.0, 1.5, load.thickness.size), "alpha": random.uniform(0.1, 0.2, load.thickness.size)}
    law = load.material.with_zones({name: jnp.asarray(values) for name, values in zones.items()})
    _compare_derivatives(load._replace(material=law), sheet)


@jax.jit
def _derivatives(load: Load, sheet: Elements, change: Load, weights: tuple[jax.Array, jax.Array]) -> tuple[Any, ...]:
    """Values and tangents of the force, those of the plain formula, and the cotangents of both."""
    own = jax.jvp(lambda load: force.force(load, sheet), (load,), (change,))
    plain = jax.jvp(lambda load: force._force(load, sheet), (load,), (change,))
    own_pull = jax.vjp(lambda load: force.force(load, sheet), load)[1](weights)
    nodal, volume = jax.jacfwd(lambda load: force._force(load, sheet))(load)
    plain_pull = jax.tree.map(lambda f, v: jnp.tensordot(weights[0], f, 2) + weights[1] * v, nodal, volume)
    return own, plain, own_pull, plain_pull


def _compare_derivatives(load: Load, sheet: Elements) -> None:
    weights = jnp.asarray(np.random.default_rng(2).normal(size=load.positions.shape)), real(0.7)
    own, plain, own_pull, plain_pull = _derivatives(load, sheet, _random_like(load, 1), weights)
    for got, expected in zip(jax.tree.leaves(own), jax.tree.leaves(plain), strict=True):
        np.testing.assert_allclose(got, expected, rtol=1e-12, atol=1e-13)
    for got, expected in zip(jax.tree.leaves(own_pull), jax.tree.leaves(plain_pull), strict=True):
        np.testing.assert_allclose(got, expected, rtol=1e-11, atol=1e-12)


@ONE_BY_ONE_AND_IN_PAIRS
def test_batches_equal_single_calls(paired: bool) -> None:
    load, sheet = _case(LAWS[1], paired=paired)
    batch = jnp.stack([load.positions, 1.1 * load.positions])
    loss = jax.value_and_grad(lambda x: jnp.sum(jnp.square(force.force(load._replace(positions=x), sheet)[0])))
    values, slopes = jax.vmap(loss)(batch)
    for k in range(2):
        value, slope = loss(batch[k])
        np.testing.assert_allclose(values[k], value, rtol=1e-13)
        np.testing.assert_allclose(slopes[k], slope, rtol=1e-11, atol=1e-13)


def test_no_derivative_with_respect_to_the_initial_mesh_is_an_error_not_a_zero() -> None:
    load, sheet = _case(LAWS[0])
    with pytest.raises(TypeError, match="initial mesh"):
        jax.grad(lambda area: jnp.sum(force.force(load, dataclasses.replace(sheet, area=area))[0]))(sheet.area)


@pytest.mark.parametrize("backend", scenes.short_first(["cpu", "another"]))
def test_pairs_get_what_their_elements_get_one_by_one(backend: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """On a sheet of several blocks, and a mesh whose elements are not all turned the same way."""
    sheet = shapes.rectangle(size=(1.0, 1.0), elements=400)
    random = np.random.default_rng(0)
    triangles = sheet.triangles.copy()
    triangles[::7] = triangles[::7, [1, 0, 2]]
    start = jnp.asarray(sheet.positions.T)
    inverse, area = membrane.reference_metric(start, jnp.asarray(triangles.T))
    tables = ReferenceGeometry(jnp.asarray(triangles.T), inverse, area, jnp.zeros(3))
    moved = 1.2 * start + jnp.asarray(0.01 * random.normal(size=start.shape))
    thickness, weights = (
        jnp.asarray(random.uniform(0.01, 0.02, area.size)),
        jnp.asarray(random.normal(size=start.shape)),
    )
    monkeypatch.setattr(blocks.jax, "default_backend", lambda: backend)
    found = []
    for assembly in (
        packing.make_assembly(triangles, len(sheet.positions)),
        packing.make_paired_assembly(sheet.positions, triangles),
    ):
        packed = packing.pack(None, tables, assembly)

        def packed_force(
            moved: jax.Array, thickness: jax.Array, packed: packing.Packed = packed
        ) -> tuple[jax.Array, jax.Array]:
            load = Load(packed.pack(moved), thickness[packed.element], real(0.3), LAWS[1])
            nodal, volume = force.force(load, packed.elements)
            return packed.unpack(nodal), volume

        value, pull = jax.vjp(packed_force, moved, thickness)
        found.append((value, pull((weights, real(0.7)))))
    for got, expected in zip(*map(jax.tree.leaves, found), strict=True):
        np.testing.assert_allclose(got, expected, rtol=0, atol=1e-12 * float(jnp.abs(expected).max()))


@pytest.mark.parametrize("law", LAWS)
@pytest.mark.parametrize("stretch", [(1.0, 1.0), (1.5, 1.5), (3.0, 2.0), (1.2, 4.0)])
def test_tangent_stiffness_is_the_largest_eigenvalue(law: Law, stretch: tuple[float, float]) -> None:
    def energy(gradient: jax.Array) -> jax.Array:
        c = gradient.T @ gradient
        strain = membrane.invariants((c[0, 0], c[0, 1], c[1, 1]), jnp.asarray([1.0, 0.0, 1.0]))
        return law.energy(strain.i1, strain.i2)

    gradient = jnp.asarray([[stretch[0], 0.0], [0.0, stretch[1]], [0.0, 0.0]])
    hessian = jax.hessian(energy)(gradient).reshape(6, 6)
    strain = membrane.invariants(
        (jnp.asarray(stretch[0] ** 2), jnp.asarray(0.0), jnp.asarray(stretch[1] ** 2)),
        jnp.asarray([1.0, 0.0, 1.0]),
    )
    got = constitutive.tangent_stiffness(strain, law)
    np.testing.assert_allclose(got, np.linalg.eigvalsh(hessian).max(), rtol=1e-9)


def test_stable_step_bounds_the_true_limit_closely() -> None:
    """Against the eigenvalues of the assembled tangent: never above the limit, and not far below it."""
    load, sheet = _case(LAWS[1])
    start = jnp.asarray(shapes.disc(radius=1.0, elements=40, symmetry="quarter").positions.T)
    count = start.shape[1]
    load = load._replace(
        positions=load.positions.at[:, :count].set(1.3 * start),
        pressure=real(0.0),
        thickness=0.01 + 0.0 * load.thickness,
    )
    share = sheet.area * load.thickness / 3.0
    mass = membrane.sum_to_nodes(share, sheet.triangles, count)
    tangent = jax.jacobian(lambda x: force.force(load._replace(positions=x), sheet)[0])(load.positions)
    size = start.size
    assembled = -tangent[:, :count, :, :count].reshape(size, size)
    root = np.tile(1 / np.sqrt(np.asarray(mass)), 3)
    limit = 2 / np.sqrt(np.linalg.eigvalsh(root[:, None] * assembled * root[None, :]).max())
    bound = constitutive.shape_bound(sheet.inverse_metric, sheet.area)
    moving = sheet.area > 0
    stiff = constitutive.element_stiffness(
        load.positions, sheet.triangles, sheet.inverse_metric, bound, moving, load.material
    )
    step = constitutive.stable_step(jnp.max(stiff), load.material)
    assert 0.6 * limit < float(step) <= limit

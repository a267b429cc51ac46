"""Second derivatives: of the force, and of whole runs, equal to central differences of the first ones."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxform
from jaxform.mechanics import force
from jaxform.mechanics.corners import Load
from tests import scenes
from tests.mechanics.test_force import LAWS, _case, _random_like

_QUICKLY = {"xla_backend_optimization_level": 0, "xla_llvm_disable_expensive_passes": True}
_WAY = jnp.asarray([0.3, -0.5, 0.7, 0.2])


@pytest.mark.long
@pytest.mark.parametrize("paired", scenes.short_first([False, True]))
def test_second_derivatives_of_the_force_are_those_of_its_plain_formula(paired: bool) -> None:
    """The plain formula in forward mode twice; by hand in every order that there is."""
    load, sheet = _case(LAWS[2], paired=paired)
    first, second = _random_like(load, 1), _random_like(load, 2)
    weights = jnp.asarray(np.random.default_rng(3).normal(size=load.positions.shape)), scenes.real(0.7)

    def figure(work: Callable[..., Any], load: Load) -> jax.Array:
        nodal, volume = work(load, sheet)
        return jnp.vdot(weights[0], nodal) + weights[1] * volume

    def along(work: Callable[..., Any], load: Load) -> jax.Array:
        return jax.jvp(lambda load: figure(work, load), (load,), (first,))[1]

    own, plain = lambda load: along(force.force, load), lambda load: along(force._force, load)
    expected = jax.jvp(plain, (load,), (second,))[1]
    forward = jax.jvp(own, (load,), (second,))[1]
    np.testing.assert_allclose(forward, expected, rtol=1e-11)
    reverse = jax.grad(own)(load)
    over_reverse = jax.jvp(jax.grad(lambda load: figure(force.force, load)), (load,), (first,))[1]
    for found in (reverse, over_reverse):
        np.testing.assert_allclose(
            sum(map(jnp.vdot, jax.tree.leaves(found), jax.tree.leaves(second))), expected, rtol=1e-11
        )


def _bound_steps(scene: jaxform.Scene) -> jaxform.Scene:
    """With the steps bounded element by element, which is less to compile."""
    return dataclasses.replace(scene, solver=dataclasses.replace(scene.solver, sharp_step=False))


def _figure(scene: jaxform.Scene) -> Callable[[jax.Array], jax.Array]:
    """A figure of four factors, on thickness, pressure, density and damping; all that carries a derivative counts."""
    numbers = {
        "parison.thickness": scene.parison.thickness,
        "pressure.value": scene.pressure.value,
        "material.density": scene.material.density,
        "solver.damping": scene.solver.damping,
    }

    def figure(factors: jax.Array) -> jax.Array:
        changes = {path: factor * number for factor, (path, number) in zip(factors, numbers.items(), strict=True)}
        result = jaxform.simulate(jaxform.replace(scene, changes))
        energy = result.energy
        lost = energy.contact_loss + energy.damping_loss + 0.1 * energy.external_work
        return jnp.mean(jnp.square(result.thickness / 0.005 - 1)) + lost + 1e-2 * jnp.mean(result.contact_time)

    return figure


def _compile(function: Callable[[jax.Array], Any]) -> Callable[[jax.Array], Any]:
    return jax.jit(function).lower(jnp.ones(4)).compile(_QUICKLY)


@pytest.mark.long
def test_hessian_equals_central_differences_of_the_gradient_through_contact() -> None:
    """`jax.hessian` is `jacfwd` of `jacrev`; here the gradient is asked for as well."""
    figure = _figure(_bound_steps(scenes.cup(elements=24)))

    def gradient(factors: jax.Array) -> tuple[jax.Array, jax.Array]:
        slope = jax.jacrev(figure)(factors)
        return slope, slope

    both, at = _compile(jax.jacfwd(gradient, has_aux=True)), jnp.ones(4)
    hessian = np.asarray(both(at)[0])
    ways = 1e-5 * jnp.eye(4)
    differences = np.asarray([(both(at + way)[1] - both(at - way)[1]) / 2e-5 for way in ways]).T
    assert np.abs(hessian).min() > 1e-4
    np.testing.assert_allclose(hessian, differences, rtol=1e-7, atol=1e-8)
    np.testing.assert_allclose(hessian, hessian.T, rtol=1e-9, atol=1e-12)


@pytest.mark.long
def test_forward_and_reverse_mode_over_forward_mode_equal_central_differences() -> None:
    figure = _figure(_bound_steps(scenes.free_disc(24, 1.0, scenes.mooney(0.1), end_time=8.0)))

    def along(factors: jax.Array) -> jax.Array:
        return jax.jvp(figure, (factors,), (_WAY,))[1]

    at, step = jnp.ones(4), 1e-5 * _WAY
    for both in (jax.value_and_grad(along), lambda at: jax.jvp(along, (at,), (_WAY,))):
        work = _compile(both)
        difference = float((work(at + step)[0] - work(at - step)[0]) / 2e-5)
        found = np.asarray(work(at)[1])
        np.testing.assert_allclose(found @ _WAY if found.ndim else found, difference, rtol=1e-7)


def test_reverse_mode_over_reverse_mode_is_refused_in_a_sentence() -> None:
    figure = _figure(_bound_steps(scenes.free_disc(24, 1.0, scenes.mooney(0.1), end_time=8.0)))
    with pytest.raises(NotImplementedError, match=r"^the gradient of a simulation.*jax\.hessian\(f\)"):
        jax.eval_shape(jax.grad(lambda at: jnp.sum(jax.grad(figure)(at))), jnp.ones(4))


def _walls(factors: jax.Array, scene: jaxform.Scene, adjoint: jaxform.Adjoint | None = None) -> jax.Array:
    """Some walls of a cup, and what damping took, by factors on thickness and pressure."""
    changes = {
        "parison.thickness": factors[0] * scene.parison.thickness,
        "pressure.value": factors[1] * scene.pressure.value,
    }
    result = jaxform.simulate(jaxform.replace(scene, changes), adjoint=adjoint)
    return jnp.append(result.thickness[:6], result.energy.damping_loss)


_AT = jnp.asarray([1.05, 0.95])


@functools.cache
def _columns() -> np.ndarray:
    """In forward mode, one factor after the other."""
    scene = _bound_steps(scenes.cup(elements=24))
    along = jax.jit(lambda way: jax.jvp(lambda factors: _walls(factors, scene), (_AT,), (way,))[1])
    return np.stack([along(way) for way in jnp.eye(2)])


@pytest.mark.long
@pytest.mark.parametrize("adjoint", [jaxform.Reversed(), jaxform.Checkpointed()])
def test_a_simulation_is_linearized_as_least_squares_of_others_do_it(adjoint: jaxform.Adjoint) -> None:
    """Gauss and Newton's step: the linear function mapped over a basis, and transposed, inside of a jit.

    What is stored changes the transposed function alone.
    """
    scene, mapped = _bound_steps(scenes.cup(elements=24)), isinstance(adjoint, jaxform.Reversed)

    def step(factors: jax.Array) -> tuple[jax.Array, jax.Array | None, jax.Array]:
        value, push = jax.linearize(lambda factors: _walls(factors, scene, adjoint), factors)
        columns = jax.vmap(push)(jnp.eye(2)) if mapped else None
        slope = jax.linear_transpose(push, factors)(value)[0]
        return value, columns, slope

    value, columns, slope = jax.jit(step).lower(_AT).compile(_QUICKLY)(_AT)
    if mapped:
        np.testing.assert_allclose(columns, _columns(), rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(slope, _columns() @ value, rtol=1e-7)
    assert np.abs(_columns()).max(axis=1).min() > 1e-6

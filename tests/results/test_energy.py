"""The account of energy: every term that is registered enters the balance and the summary."""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxform
from jaxform.core.pytree import marked_field_names
from jaxform.results.result import Energy
from jaxform.sheet.state import LOSS, LOSSES
from tests import scenes


def test_every_loss_of_a_run_is_one_of_its_result() -> None:
    assert marked_field_names(Energy, LOSS) == LOSSES
    result = jaxform.run(scene := scenes.cup())
    assert set(LOSSES) <= set(jaxform.summarize(result, scene)["energy"])


@pytest.mark.parametrize("name", LOSSES)
def test_every_loss_enters_the_balance(name: str) -> None:
    parts = {part.name: jnp.asarray(1.0) for part in dataclasses.fields(Energy) if part.name != "by_tool"}
    total = 2.0 + len(LOSSES)  # strain, kinetic energy and all losses; tool, gravity and pre-stretch did 1 each
    pressure = jnp.asarray(total - 3.0)
    given: dict[str, Any] = parts | {"external_work": pressure, "peak_work": pressure, "rounding": jnp.zeros(())}
    energy = Energy(**given)
    np.testing.assert_allclose(energy.balance_error, 0.0, atol=1e-15)
    other = dataclasses.replace(energy, **{name: jnp.asarray(2.0)})
    np.testing.assert_allclose(other.balance_error, 1.0 / total, rtol=1e-12)
    idle = dataclasses.replace(energy, tool_work=jnp.asarray(0.0))
    np.testing.assert_allclose(idle.balance_error, 1.0 / (total - 1.0), rtol=1e-12)


@pytest.mark.long
@pytest.mark.parametrize("over_mold", [False, True])
def test_the_derivative_of_the_kinetic_energy_is_that_of_differences(over_mold: bool) -> None:
    scene = scenes.cup(60, 9.0) if over_mold else scenes.free_disc(60, 2.0, scenes.mooney(0.1), 0.3, end_time=7.0)
    base = jaxform.run(scene)
    assert float(base.energy.kinetic) > 0.0

    def kinetic(scale: jax.Array) -> jax.Array:
        changed = jaxform.replace(scene, {"material.c": scale})
        return jaxform.simulate(changed, schedule=base.schedule).energy.kinetic

    value, slope = jax.jit(kinetic), float(jax.jit(jax.grad(kinetic))(jnp.asarray(1.0)))
    np.testing.assert_allclose(value(jnp.asarray(1.0)), base.energy.kinetic, rtol=1e-9)
    difference = (float(value(jnp.asarray(1.0 + 1e-5))) - float(value(jnp.asarray(1.0 - 1e-5)))) / 2e-5
    np.testing.assert_allclose(slope, difference, rtol=1e-6)


def _shot(factor: float) -> jaxform.Scene:
    """The cup under a pressure so many times higher: its sheet strikes the mold, and most of the work is lost there."""
    scene = scenes.cup()
    return jaxform.replace(scene, {"pressure.value": factor * scene.pressure.value})


@pytest.mark.parametrize("factor", [256.0, 2048.0])
def test_a_sheet_that_strikes_its_mold_balances(factor: float) -> None:
    """The loss of a landing is the kinetic energy at the time of impact, not at the middle of the step."""
    energy = jaxform.run(_shot(factor)).energy
    assert float(energy.contact_loss / energy.external_work) > 0.3
    assert float(energy.balance_error) < 1e-3


@pytest.mark.long
@pytest.mark.parametrize("key", ["parison.thickness", "pressure.value", "solver.damping"])
def test_the_derivative_of_the_contact_loss_is_that_of_differences(key: str) -> None:
    scene = _shot(64.0)
    start = jnp.asarray({"parison.thickness": 0.01, "pressure.value": 12.8, "solver.damping": 2.0}[key])
    whole = {
        "parison.thickness": scene.parison.thickness,
        "pressure.value": scene.pressure.value,
        "solver.damping": scene.solver.damping,
    }[key]

    def lost(value: jax.Array) -> jax.Array:
        changed = jaxform.replace(scene, {key: whole * value / start})
        return jaxform.simulate(changed).energy.contact_loss

    value, slope = jax.jit(lost), float(jax.jit(jax.grad(lost))(start))
    np.testing.assert_allclose(value(start), jaxform.run(scene).energy.contact_loss, rtol=1e-9)
    way = 1e-6 * start
    difference = (float(value(start + way)) - float(value(start - way))) / float(2.0 * way)
    np.testing.assert_allclose(slope, difference, rtol=1e-6)

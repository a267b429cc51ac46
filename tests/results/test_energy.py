"""The account of energy: every term that is registered enters the balance and the summary."""

from __future__ import annotations

import dataclasses

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
    parts = {part.name: jnp.asarray(1.0) for part in dataclasses.fields(Energy)}
    work = jnp.asarray(1.0 + len(LOSSES))  # with the tool's as much as strain, kinetic energy and all losses
    energy = Energy(**(parts | {"external_work": work, "peak_work": work, "rounding": jnp.zeros(())}))
    np.testing.assert_allclose(energy.balance_error, 0.0, atol=1e-15)
    other = dataclasses.replace(energy, **{name: jnp.asarray(2.0)})
    np.testing.assert_allclose(other.balance_error, 1.0 / (work + 1.0), rtol=1e-12)
    idle = dataclasses.replace(energy, tool_work=jnp.asarray(0.0))
    np.testing.assert_allclose(idle.balance_error, 1.0 / work, rtol=1e-12)

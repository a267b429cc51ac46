"""Energy of fast modes that a sudden pressure excites, and that a step hardly resolves: it is in the balance."""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest

import jaxform
from jaxform import shapes
from jaxform.tools.contact_law import make_contact_law
from tests import scenes

_SOFT = jaxform.NeoHookean(scenes.real(1.0), scenes.real(1.0))


def _disc(pressure: float, end: float, damping: float | None, elements: int = 40, **parts: Any) -> jaxform.Scene:
    """A quarter of a disc under a sudden constant pressure."""
    sheet, stretched = shapes.disc(radius=1.0, elements=elements, symmetry="quarter"), parts.pop("pre_stretch", None)
    given = sheet.positions, sheet.triangles, 0.01, sheet.clamped, sheet.fixed
    return jaxform.build_scene(
        parison=jaxform.make_parison(*given, pre_stretch=stretched),
        material=parts.pop("material", _SOFT),
        pressure=jaxform.make_pressure([0.0], [pressure]),
        solver=jaxform.make_solver(end_time=end, damping=damping, safety=parts.pop("safety", 0.9)),
        **parts,
    )


def _missed(result: jaxform.Result) -> float:
    """Energy held and lost beyond the work, over the work of the pressure."""
    energy = result.energy
    lost = energy.damping_loss + energy.viscous_loss
    return float((energy.strain + energy.kinetic + lost - energy.work) / energy.external_work)


@pytest.mark.parametrize("end", [1.7, 40.0])
def test_the_balance_of_a_linear_sheet_is_exact_in_motion_and_at_rest(end: float) -> None:
    """A stretched disc hardly moves under so small a pressure: its tangent is constant, whatever the step."""
    result = jaxform.run(_disc(1e-5, end, 0.5, pre_stretch=[1.3, 1.3]))
    energy = result.energy
    assert jaxform.explain(result) == "ok"
    assert float(energy.kinetic / energy.external_work) > 0.1 or end > 20.0
    assert abs(_missed(result)) < 1e-6


@pytest.mark.parametrize("end", [1.7, 40.0])
def test_the_balance_of_an_undamped_linear_sheet_with_prony_terms_is_exact(end: float) -> None:
    """Out of its plane a stretched disc does not feel them, and keeps its fast modes for good."""
    modes = jaxform.Christensen(jnp.asarray([0.5]), jnp.asarray([0.5]))
    law = jaxform.NeoHookean(scenes.real(1.0), scenes.real(1.0), viscous=modes)
    result = jaxform.run(_disc(1e-5, end, None, pre_stretch=[1.3, 1.3], material=law))
    assert float(result.energy.kinetic / result.energy.external_work) > 0.5
    assert abs(_missed(result)) < 1e-6


@pytest.mark.filterwarnings("ignore:nothing touched the mold")
def test_the_balance_of_an_undamped_linear_sheet_beside_a_tool_it_could_slide_on_is_exact() -> None:
    corners, law = np.array([[-2.0, -2.0, 5.0], [2.0, -2.0, 5.0], [0.0, 2.0, 5.0]]), make_contact_law("slide")
    mold = jaxform.make_mold(corners, np.array([[0, 1, 2]]), contact=law)
    result = jaxform.run(_disc(1e-5, 40.0, None, pre_stretch=[1.3, 1.3], mold=mold, fill=False))
    assert float(result.energy.kinetic / result.energy.external_work) > 0.5
    assert abs(_missed(result)) < 1e-6


def test_a_sphere_that_is_loaded_at_once_balances() -> None:
    sphere = scenes.sphere(60, 1.0, _SOFT, [0.0], end_time=20.0, damping=0.5)
    result = jaxform.run(sphere)
    assert jaxform.explain(result) == "ok"
    assert abs(_missed(result)) < 5e-3


def test_the_balance_of_a_disc_that_is_loaded_at_once_is_of_second_order() -> None:
    coarse, fine = (jaxform.run(_disc(0.01, 50.0, 5.0, safety=safety)) for safety in (0.9, 0.45))
    ratio = np.asarray(fine.steps) / np.asarray(coarse.steps)
    assert ratio > 1.8 and abs(_missed(coarse)) < 5e-4
    np.testing.assert_allclose(_missed(coarse) / _missed(fine), ratio**2, rtol=0.15)

"""Against exact solutions; the cases and their errors are those that benchmarks/accuracy.py prints."""

from __future__ import annotations

import numpy as np
import pytest

import jaxform
from benchmarks import accuracy
from jaxform import files


@pytest.mark.parametrize("case", [accuracy.DISCS[0], accuracy.DISCS[1], accuracy.DISCS[4]])
def test_free_disc(case: tuple[float, ...]) -> None:
    alpha, _, *exact = case
    height, ratio, result = accuracy.disc_errors(500, alpha, *exact)
    assert jaxform.explain(result) == "ok"
    assert float(result.energy.balance_error) < 1e-4
    assert max(abs(height), abs(ratio)) < 3e-3


def test_pole_height_converges_at_second_order() -> None:
    # At pole stretch 1.5, where the error of the height is well above what time integration leaves.
    alpha, _, *exact = accuracy.DISCS[3]
    sizes = (38, 150, 600)
    errors = [abs(accuracy.disc_errors(n, alpha, *exact)[0]) for n in sizes]
    order = np.log(errors[0] / errors[-1]) / np.log(np.sqrt(sizes[-1] / sizes[0]))
    assert order > 1.8, errors


def test_static_sphere_of_the_modified_law() -> None:
    # Below the sphere's limit point, beyond which the pressure does not fix the stretch.
    assert abs(accuracy.static_sphere_error(500, 0.01, 1.2)) < 3e-3


@pytest.mark.parametrize("case", accuracy.SPHERES)
def test_sphere_under_a_pressure_step(case: tuple[float, float, float, float]) -> None:
    largest, period = accuracy.sphere_step_errors(1000, *case)
    assert abs(largest) < 3e-3
    assert abs(period) < 5e-3


@pytest.mark.parametrize(("name", "most"), [("dish-coarse", 0.02), ("dish", 0.008)])
def test_dish_against_the_exact_cup(name: str, most: float) -> None:
    document = files.read_scene(name)
    scene, reference = files.build(document), files.read_reference(document)
    assert reference is not None
    result = jaxform.run(scene)
    assert jaxform.explain(result) == "ok"
    assert float(result.energy.balance_error) < 1e-2
    assert accuracy.wall_error(scene, result, reference) < most

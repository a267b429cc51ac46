"""Against exact solutions; the cases and their errors are those that `make validate` runs at three sizes each."""

from __future__ import annotations

import functools

import pytest

import jaxform
from benchmarks.accuracy import cases
from jaxform.io import files
from jaxform.results.result import Result, drop_unused
from tests import scenes

SIZES = (38, 150, 600)


@functools.cache
def _disc(elements: int, alpha: float, stretch: float) -> tuple[dict[str, float], Result]:
    return cases.disc_errors(elements, alpha, stretch)


@pytest.mark.parametrize("case", scenes.short_first([((0.0, 1.2),), ((0.0, 1.3),), ((0.5, 1.5),)]))
def test_free_disc(case: tuple[float, float]) -> None:
    errors, result = _disc(SIZES[-1], *case)
    assert jaxform.explain(result) == "ok"
    assert float(result.energy.balance_error) < 1e-4
    assert max(abs(errors[name]) for name in ("pole height", "pole thickness")) < 3e-3


def test_a_free_disc_converges_at_second_order() -> None:
    # At pole stretch 1.5, where errors are well above what time integration leaves.
    rows = [_disc(elements, 0.0, 1.5) for elements in SIZES]
    counts = [len(result.element_thickness) for _, result in rows]
    order = {name: cases.order(counts, [errors[name] for errors, _ in rows])[-1] for name in rows[0][0]}
    assert order["pole height"] > 1.8, order
    assert order["nodal thickness"] > 1.8 and order["nodal thickness, inside"] > 1.8, order
    assert order["nodal thickness, rim"] > 1.3, order


def test_static_sphere_of_the_modified_law() -> None:
    # Below the sphere's limit point, beyond which the pressure does not fix the stretch.
    error, _ = cases.static_sphere_error(500, cases.paper_law(0.01), 1.2)
    assert abs(error) < 3e-3


@pytest.mark.parametrize("case", scenes.short_first([(case,) for case in cases.SPHERES]))
def test_sphere_under_a_pressure_step(case: tuple[float, float, float, float]) -> None:
    largest, period, _ = cases.sphere_step_errors(1000, *case)
    assert abs(largest) < 3e-3
    assert abs(period) < 5e-3


@pytest.mark.parametrize(
    ("name", "most"), scenes.short_first([("dish-coarse", 0.02), ("dish", 0.004), ("dish-refined", 0.005)])
)
def test_dish_against_the_exact_cup(name: str, most: float) -> None:
    document = files.read_scene(name)
    scene, reference = files.build(document), files.read_reference(document)
    assert reference is not None
    result = jaxform.run(scene)
    assert jaxform.explain(result) == "ok"
    assert float(result.energy.balance_error) < 1e-2
    assert cases.wall_error(*drop_unused(scene, result), reference) < most

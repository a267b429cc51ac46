"""Against exact solutions. The figures are those of the references that the issue names, kept here as numbers."""

from __future__ import annotations

import numpy as np
import pytest

import jaxform
from jaxform.result import formed_areas
from tests import scenes

# Clamped disc under slow pressure: alpha, P a/(c h0), pole height / a, pole h/h0 (an exact ODE).
DISC = [
    (0.0, 1.9985037, 0.53097607, 0.69444444),
    (0.0, 2.6197363, 0.63795621, 0.59171598),
    (0.5, 6.9792674, 0.88525982, 0.44444444),
]


def _disc_error(elements: int, alpha: float, pressure: float, height: float, ratio: float) -> tuple[float, float]:
    scene = scenes.free_disc(elements, pressure, scenes.mooney(alpha))
    result = jaxform.run(scene)
    assert jaxform.explain(result) == "ok"
    assert float(result.energy.balance_error) < 1e-4
    node = scenes.pole(scene)
    got = float(result.positions[node, 2]), float(result.thickness[node]) / 0.01
    return got[0] / height - 1, got[1] / ratio - 1


@pytest.mark.parametrize(("alpha", "pressure", "height", "ratio"), DISC)
def test_free_disc(alpha: float, pressure: float, height: float, ratio: float) -> None:
    errors = _disc_error(500, alpha, pressure, height, ratio)
    assert max(map(abs, errors)) < 3e-3, errors


def test_pole_height_converges_at_second_order() -> None:
    # At pole stretch 1.5, where the error of the height is well above what time integration leaves.
    sizes = (38, 150, 600)
    pressure, height, ratio = 3.2871637, 0.79878921, 0.44444444
    errors = [abs(_disc_error(n, 0.0, pressure, height, ratio)[0]) for n in sizes]
    order = np.log(errors[0] / errors[-1]) / np.log(np.sqrt(sizes[-1] / sizes[0]))
    assert order > 1.8, errors


def _mean_stretch(scene: jaxform.Scene, result: jaxform.Result) -> float:
    return float(np.sqrt(formed_areas(result, scene).sum() / np.asarray(scene.tables.sheet.area).sum()))


def test_static_sphere_of_the_modified_law() -> None:
    stretch, a02 = (
        1.2,
        0.01,
    )  # below the sphere's limit point, beyond which the pressure does not fix the stretch
    i2 = stretch**4 + 2 / stretch**2
    slope = 4 * stretch - 4 / stretch**5 + 2 * a02 * (i2 - 3) * (4 * stretch**3 - 4 / stretch**3)
    law = jaxform.ModifiedMooneyRivlin(scenes.real(1.0), scenes.real(a02), scenes.real(1.0))
    scene = scenes.sphere(500, slope / stretch**2, law, [0.0, 20.0], end_time=40.0, damping=2.0)
    result = jaxform.run(scene)
    assert jaxform.explain(result) == "ok"
    assert abs(_mean_stretch(scene, result) / stretch - 1) < 3e-3


@pytest.mark.parametrize(
    ("alpha", "pressure", "largest", "period"),
    [
        (0.0, 1.0, 1.109534, 1.5437),
        (0.0, 2.0, 1.380933, 2.39501),
        (0.5, 2.0, 1.149911, 1.27136),
        (0.5, 5.0, 1.957665, 2.28205),
    ],
)
def test_sphere_under_a_pressure_step(alpha: float, pressure: float, largest: float, period: float) -> None:
    scene = scenes.sphere(1000, pressure, scenes.mooney(alpha), [0.0], end_time=1.2 * period)
    off = period / 2 * np.linspace(-0.1, 0.1, 7)
    course = np.polyfit(off, [_stretch_at(scene, period / 2 + late) for late in off], 4)
    turns = np.roots(np.polyder(course))
    turn = turns[np.argmin(np.abs(turns))].real
    assert abs(np.polyval(course, turn) / largest - 1) < 3e-3
    # The motion is symmetric in time about its largest stretch.
    assert abs(2 * turn / period) < 5e-3


def _stretch_at(scene: jaxform.Scene, time: float) -> float:
    result = jaxform.run(jaxform.replace(scene, {"solver.end_time": time}))
    assert jaxform.explain(result) == "ok"
    assert float(result.energy.balance_error) < 1e-2
    return _mean_stretch(scene, result)

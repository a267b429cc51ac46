"""The basis of `make validate`: its reference solutions, the quasi-static error and its warning, and the page."""

from __future__ import annotations

import dataclasses
import json
import warnings
from pathlib import Path

import numpy as np
import pytest

import jaxform
from benchmarks.accuracy import cases, cups, membranes, page, validate
from jaxform.results.summary import QUASI_STATIC_LIMIT, warnings_of
from tests import scenes


def test_shooting_gives_the_tabled_discs_and_the_limit_point() -> None:
    table = cases.exact_table("discs")
    for row in range(0, len(table["alpha"]), 3):
        disc = membranes.free_disc(table["alpha"][row], table["pole_stretch"][row])
        got = disc.pressure, disc.height[0], disc.thickness[-1]
        names = ("P_a_over_c_h0", "pole_height_over_a", "rim_h_over_h0")
        np.testing.assert_allclose(got, [table[name][row] for name in names], rtol=1e-6)
    np.testing.assert_allclose(membranes.limit_point(), 3.758347, rtol=1e-6)


@pytest.mark.long
def test_the_spectral_rectangle_converges_and_the_elements_agree_with_it() -> None:
    pressure, alpha, ratio = 4.0, 0.3, 2.0
    coarse, fine = (membranes.rectangle(pressure, alpha, ratio, degree, 24) for degree in (4, 5))
    np.testing.assert_allclose(coarse.height, fine.height, rtol=1e-3)
    places = np.array([[1.0, 0.5], [0.4, 0.3]])
    np.testing.assert_allclose(coarse.thickness(places), fine.thickness(places), rtol=2e-3)
    measured = cases.rectangle_errors(128, pressure, alpha, ratio)
    assert abs(measured.errors["height"]) < 4e-3 and measured.errors["nodal thickness"] < 0.01


@pytest.mark.long
@pytest.mark.filterwarnings("ignore:the wall is down to")  # near the apex it goes to zero
def test_sticking_in_a_cone() -> None:
    measured = cases.show_cone(600)
    assert measured.errors["thickness at the tabled places"] < 0.005


def _hurry(ramp: float) -> jaxform.Scene:
    """The cup with a ramp of so many units."""
    scene = scenes.cup(end_time=50.0)
    solver = dataclasses.replace(scene.solver, quasi_static=True)
    times = {"pressure.time": [0.0, ramp], "solver.end_time": 1.25 * ramp}
    return jaxform.replace(dataclasses.replace(scene, solver=solver), times)


def test_a_fast_process_is_warned_of_and_a_slow_one_is_not() -> None:
    with pytest.warns(UserWarning, match=r"not quasi-static .* raise the pressure more slowly"):
        fast = jaxform.run(_hurry(4.0))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        slow = jaxform.run(_hurry(40.0))
    assert float(slow.energy.quasi_static_error) < QUASI_STATIC_LIMIT < float(fast.energy.quasi_static_error)
    off = np.asarray(fast.element_thickness) / np.asarray(slow.element_thickness) - 1
    moved = cases.rms(off, np.asarray(fast.element_volume))
    # A shallow cup, whose wall deviates less than that of the deep ones from which the prediction comes.
    assert moved < float(fast.energy.quasi_static_error) < 20 * moved
    assert warnings_of(fast, scenes.cup(end_time=50.0)) == []


@pytest.mark.long
def test_the_quasi_static_error_is_the_same_in_both_loops() -> None:
    scene = scenes.cup()
    pure, run = jaxform.simulate(scene), jaxform.run(scene)
    assert float(run.energy.kinetic_peak) > float(run.energy.kinetic) >= 0
    np.testing.assert_allclose(pure.energy.kinetic_peak, run.energy.kinetic_peak, rtol=1e-9)


def test_the_page_is_drawn_from_its_figures(tmp_path: Path) -> None:
    found = json.loads((validate.DOCS / "accuracy.json").read_text())
    parts = set(found) - {"measured"}
    assert set(validate.PARTS) == parts
    assert parts == {part.partition(":")[0] for part in found["measured"]}
    page.write(found, tmp_path)
    assert (tmp_path / "accuracy.md").read_text() == (validate.DOCS / "accuracy.md").read_text()
    pictures = {path.name for path in tmp_path.glob("*.png")}
    assert {
        "convergence.png",
        "precision-dish.png",
        "precision-box.png",
        "quasi-static-error.png",
        "ramps.png",
    } <= pictures
    assert all((tmp_path / name).stat().st_size > 10_000 and (validate.DOCS / name).exists() for name in pictures)


def test_sticking_in_a_cup_gives_the_tabled_walls() -> None:
    """A reference wall at P = 20.1006 that a code of its own gave, and the committed one at P = 40."""
    wall, later = cups.stick_in_cup(cups.Law(), cups.Cup(0.8), [20.1006, 40.0], steps=16)
    np.testing.assert_allclose(wall.edges, [0.43954, 0.52379], rtol=2e-4)
    np.testing.assert_allclose(wall.thinnest, 0.26050, rtol=1e-3)
    known = {0.0: 0.4439555, 0.3211385: 0.3460282, 0.4341472: 0.2670929, 0.4816602: 0.2633078, 0.7027139: 0.5146422}
    np.testing.assert_allclose(wall.at(np.array(list(known))), list(known.values()), rtol=2e-3)
    table = cases.exact_table("cup-at-40")
    np.testing.assert_allclose(later.at(table["initial_radius"]), table["thickness_ratio"], rtol=4e-3)
    assert abs(np.mean(later.edges) - cases.CUP_CORNER) < 2e-3


@pytest.mark.long
def test_the_cups_wall_at_the_pressure_reached() -> None:
    """Nothing is cut: with an edge of elements at the corner its whole wall is right, at the corner too."""
    errors = cases.show_cup(600).errors
    assert errors["nodal thickness"] < 0.02 and errors["nodal thickness, rim"] < 0.005, errors
    assert abs(errors["thinnest wall"]) < 0.08, errors

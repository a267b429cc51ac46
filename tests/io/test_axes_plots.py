"""Diagrams in axes of one's own: they draw the numbers of the part there, and return the axes."""

from __future__ import annotations

import matplotlib.pyplot as plt
import numpy as np
import pytest

import jaxform
from tests import scenes


@pytest.fixture(scope="module")
def part() -> tuple[jaxform.Scene, jaxform.Result]:
    scene = scenes.cup()
    return scene, scenes.at_rest(scene)


def test_the_wall_is_drawn_at_every_place_of_the_sheet(part: tuple[jaxform.Scene, jaxform.Result]) -> None:
    scene, result = part
    _, ax = plt.subplots()
    assert jaxform.plot.wall(result, scene, ax, color="k", label="flat") is ax
    arc, wall = np.asarray(ax.lines[0].get_data())
    np.testing.assert_allclose(wall, 10.0)  # mm: nothing has moved yet
    assert arc[0] == 0.0
    np.testing.assert_allclose(arc[-1], 1e3)
    assert ax.lines[0].get_label() == "flat"


def test_values_on_the_sheet_have_colours_about_zero(part: tuple[jaxform.Scene, jaxform.Result]) -> None:
    scene, _ = part
    _, ax = plt.subplots()
    x = np.asarray(scene.parison.positions)[:, 0]
    assert jaxform.plot.sheet(scene, x - 0.25, ax, label="x") is ax
    np.testing.assert_allclose(ax.collections[0].get_clim(), (-0.75, 0.75))
    assert ax.get_aspect() == 1.0
    with pytest.raises(jaxform.InputError, match="one value per node"):
        jaxform.plot.sheet(scene, x[:-1], ax)


def test_the_part_is_drawn_in_three_dimensions_alone(part: tuple[jaxform.Scene, jaxform.Result]) -> None:
    scene, result = part
    made = jaxform.plot.part(result, scene, limits=(5.0, 15.0))
    assert made.name == "3d" and made.figure.axes[1].get_ylim() == (5.0, 15.0)  # the colour bar
    with pytest.raises(jaxform.InputError, match="3d"):
        jaxform.plot.part(result, scene, plt.subplots()[1])


def test_pressure_and_search_are_drawn(part: tuple[jaxform.Scene, jaxform.Result]) -> None:
    scene, _ = part
    ax = jaxform.plot.pressure(scene)
    time, pressure = np.asarray(ax.lines[0].get_data())
    np.testing.assert_allclose((time[-1], pressure[-1]), (20e3, 0.2e-3))  # ms, kPa
    rows = [{"simulations": 1.0, "objective": 4.0}, {"simulations": 5.0, "objective": 1.0}]
    ax = jaxform.plot.convergence(rows)
    np.testing.assert_array_equal(np.asarray(ax.lines[0].get_data()), [[1.0, 5.0], [4.0, 1.0]])
    rows = [row | {"thickness_rms_error": 0.1 / row["simulations"]} for row in rows]
    np.testing.assert_allclose(np.asarray(jaxform.plot.convergence(rows).lines[0].get_data())[1], [10.0, 2.0])

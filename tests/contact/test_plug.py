"""A disc that a plug pushes while it sticks, and that is blown then, against its exact meridian."""

from __future__ import annotations

import numpy as np
import pytest

import jaxform
from benchmarks.accuracy import plugs
from jaxform import shapes


def test_the_reference_has_the_known_values_of_a_flat_plug() -> None:
    """Thickness beside a plug of radius 0.3 pushed by 0.6, at radii 0.6 and 0.8 and at the rim (shared reference)."""
    known = {0.0: (0.76903661, 0.80682643, 0.82946625), 1.0: (0.7386404, 0.7812765, 0.8191899),
             3.0: (0.6521651, 0.7065700, 0.7821970)}  # fmt: skip
    for pressure, walls in known.items():
        found = plugs.free_wall(0.3, 0.3, 0.6, (1.61, 1.0), pressure)(np.array([0.6, 0.8, 1.0]))
        np.testing.assert_allclose(found, walls, rtol=1e-5)


@pytest.fixture(scope="module")
def landing() -> plugs.Landing:
    return plugs.push_hemisphere()


@pytest.mark.long
@pytest.mark.parametrize(("depth", "pressure"), [(0.325, 0.0), (0.495, 1.0)])
def test_disc_pushed_by_a_hemispherical_plug_to_which_it_sticks(
    depth: float, pressure: float, landing: plugs.Landing
) -> None:
    """The last ring of nodes on the plug is beside the line of contact, which only a ring can resolve."""
    sheet = shapes.disc(radius=1.0, element_size=0.05, symmetry="quarter")
    scene = plugs.plug_scene(sheet, plugs.round_plug(), depth, pressure)
    result = jaxform.run(scene)
    assert jaxform.explain(result) == "ok" and float(result.energy.balance_error) < 1e-4
    found = plugs.wall_errors(scene, result, plugs.hemisphere_wall(landing, depth, pressure))
    assert found.rms < 0.008
    rings = [np.average(found.error[near], weights=found.area[near]) for low in np.arange(0.3, 1.0, 0.1)
             for near in [(found.radius >= low) & (found.radius < low + 0.1)]]  # fmt: skip
    assert np.abs(rings).max() < 0.004

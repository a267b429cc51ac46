"""Numbers of a law that vary over the sheet: exact parts, gradients, refinement, files and designs."""

from __future__ import annotations

from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxform
import optimize
from benchmarks.accuracy import cases
from jaxform.io import files, scene_rewriting
from tests import scenes
from tests.scenes import real


def _radius(scene: jaxform.Scene) -> np.ndarray:
    return np.linalg.norm(np.asarray(scene.parison.positions), axis=1)


def _stiffening_law(scene: jaxform.Scene) -> jaxform.Scene:
    """With c = 1 + R^2 / 2."""
    return jaxform.replace(scene, {"material.c": 1.0 + 0.5 * np.square(_radius(scene))})


def test_a_free_disc_of_two_stiffnesses_in_one() -> None:
    """Height of the pole and wall at P = 3 c h0/a, from the exact membrane."""
    scene = _stiffening_law(scenes.free_disc(700, 3.0, scenes.mooney(0.1)))
    result = jaxform.run(scene)
    assert int(result.status) == 0
    np.testing.assert_allclose(result.positions[scenes.pole(scene), 2], 0.5814991, rtol=2e-3)
    places = _radius(scene)[np.asarray(scene.parison.triangles)].mean(1)
    wall = np.asarray(result.element_thickness) / 0.01
    for place, exact in ((0.25, 0.627919), (0.5, 0.6835812), (0.75, 0.7655924)):
        near = np.abs(places - place) < 0.05
        found = np.polyfit(places[near] - place, wall[near], 1)[1]
        np.testing.assert_allclose(found, exact, rtol=5e-3)
    assert float(jaxform.summarize(result, scene)["energy"]["balance_error"]) < 1e-3


@pytest.mark.long
def test_a_cup_of_a_sheet_that_is_stiffer_outside() -> None:
    """The wall over the material, away from the corner, within 0.8 % of the exact cup of 80 degrees."""
    scene = _stiffening_law(cases.cup_scene(600, scenes.mooney(0.1), 0.8, 0.45, 40.0))
    result, places = jaxform.run(scene), _radius(scene)
    assert int(result.status) == 0
    ratio = np.asarray(result.thickness) / np.asarray(scene.parison.thickness)
    exact = {0.02: 0.40814, 0.1: 0.3931, 0.2: 0.36449, 0.3: 0.32692, 0.7: 0.5286, 0.8: 0.63704, 0.9: 0.73418}
    off = []
    for place, wall in exact.items():
        near = np.abs(places - place) < 0.08
        off.append(np.polyfit(places[near] - place, ratio[near], min(2, near.sum() // 3))[-1] / wall - 1)
    assert np.sqrt(np.mean(np.square(off))) < 8e-3


@pytest.mark.long
def test_only_the_product_of_stiffness_and_thickness_counts_in_a_slow_process() -> None:
    # The density is a number for each node too, as in the next test, whose programs it then has.
    stiff = jaxform.replace(_stiffening_law(scenes.cup()), {"material.density": np.ones(len(_radius(scenes.cup())))})
    profile = 1.0 + 0.5 * np.square(_radius(stiff))
    thick = jaxform.replace(scenes.cup(), {"parison.thickness": 0.01 * profile})
    walls = [np.asarray(jaxform.run(scene).stretches) for scene in (stiff, thick)]
    np.testing.assert_allclose(walls[0], walls[1], rtol=0.05)
    assert np.sqrt(np.mean(np.square(walls[0] / walls[1] - 1))) < 5e-3


def test_zones_of_one_value_are_no_zones() -> None:
    plain, count = scenes.cup(), len(scenes.cup().parison.positions)
    even = jaxform.replace(plain, {"material.c": np.ones(count), "material.density": np.ones(count)})
    one, other = jaxform.run(plain), jaxform.run(even)
    assert int(one.steps) == int(other.steps)
    np.testing.assert_allclose(other.positions, one.positions, rtol=0, atol=1e-12)
    np.testing.assert_allclose(other.mass, one.mass, rtol=1e-12)


def test_numbers_become_zones_and_numbers_again() -> None:
    scene = scenes.cup()
    count = len(scene.parison.positions)
    zoned = jaxform.replace(scene, {"material.c": np.full(count, 2.0)})
    assert zoned.material.zones["c"].shape == (count,)
    assert not jaxform.replace(zoned, {"material.c": 3.0}).material.zones
    for path, value, words in (
        ("material.c", np.ones(count - 1), rf"give shape \(\) or \({count},\)"),
        ("material.c", np.full(count, -1.0), "must be positive"),
    ):
        with pytest.raises(jaxform.InputError, match=words):
            jaxform.replace(scene, {path: value})
    with pytest.raises(jaxform.InputError, match=rf"^material.density: has shape \(3,\).*\({count}\)"):
        law = jaxform.NeoHookean(real(1.0), jnp.ones(3))
        jaxform.build_scene(material=law, parison=scene.parison, pressure=scene.pressure, solver=scene.solver)


def test_a_law_of_ones_own_takes_zones() -> None:
    """Its slopes and its stable step follow from the energy alone."""

    @jaxform.law
    class Plain(jaxform.Law):
        c: jax.Array = jaxform.parameter("Pa", above=0.0)
        density: jax.Array = jaxform.parameter("kg/m^3", above=0.0)

        def energy(self, i1: jax.Array, i2: jax.Array) -> jax.Array:
            return self.c * (i1 - 3.0)

    values = 1.0 + np.linspace(0.0, 1.0, 24)
    own, known = (law(jnp.asarray(values), real(1.0)) for law in (Plain, jaxform.NeoHookean))
    np.testing.assert_allclose(own.stiffness(), known.stiffness())


FILE = """
[parison]
shape = "disc"
radius = 0.1
elements = 24
symmetry = "quarter"
thickness = 1.0e-3
[material]
{material}
density = 1000.0
[pressure]
time = [0.0, 0.1]
value = [0.0, 3.0e3]
[solver]
end_time = 0.02
damping = 100.0
"""
_PROFILE = '{ along = "radius", at = [0.0, 0.1], value = [1.0e5, 2.0e5] }'


def test_zones_in_a_file_and_designed_back_into_one(tmp_path: Path) -> None:
    path = tmp_path / "scene.toml"
    path.write_text(FILE.format(material=f'model = "ogden"\nmu = [{_PROFILE}, 1e3]\nalpha = [1.5, 5.0]'))
    document = files.read_scene(path)
    scene = files.build(document)
    places = np.linalg.norm(np.asarray(scene.parison.positions), axis=1)
    np.testing.assert_allclose(scene.material.zones["mu"], [1e5 + 1e6 * places, np.full(len(places), 1e3)])
    for folder in ("best", "moved"):
        (tmp_path / folder).mkdir()
    variable = optimize.Scale(scene, of="material.mu", bounds=(0.5, 2.0))
    free = jnp.asarray(variable.start) + 0.3
    scene_rewriting.write_scene(document, variable.document(free), tmp_path / "best")
    again = files.load(tmp_path / "best" / "best.toml")
    np.testing.assert_allclose(again.material.zones["mu"], variable.changes(free)["material.mu"], rtol=1e-6)
    # And once more from there, into another folder.
    written = files.read_scene(tmp_path / "best" / "best.toml")
    scene_rewriting.write_scene(written, {}, tmp_path / "moved")
    moved = files.load(tmp_path / "moved" / "best.toml")
    np.testing.assert_array_equal(moved.material.zones["mu"], again.material.zones["mu"])


@pytest.mark.parametrize(
    ("material", "words"),
    [
        ('model = "neo-hookean"\nc = { along = "radius", at = [0.0, 0.1], value = [1e5, -1e5] }', "c.value = -100000"),
        ('model = "neo-hookean"\nc = { along = "radius", at = [0.1, 0.0], value = [1e5, 1e5] }', "c.at.*not increase"),
        ('model = "neo-hookean"\nc = "field:hot"', "material.c = 'field:hot'.*no such field"),
        ('model = "neo-hookean"\nc = { file = "no.vtu", field = "c" }', "material.c.file.*no.vtu"),
        ('model = "ogden"\nmu = [1e5, "hot"]\nalpha = [2, 5]', r"material.mu\[1\] = 'hot'.*is not a number"),
    ],
)
def test_zones_that_are_wrong_are_refused_in_words(tmp_path: Path, material: str, words: str) -> None:
    scenes.assert_refused(tmp_path, FILE.format(material=material), words)

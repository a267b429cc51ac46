"""Temperature: shifts against their formulas and against laws with other numbers, files and messages.

Gradients by the temperature and the numbers of a shift are taken where the sheet cools as well, in test_cooling.py.
"""

from __future__ import annotations

import dataclasses
import functools
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest

import jaxform
import optimize
from jaxform.io import files, output, scene_rewriting
from jaxform.mesh import meshes
from tests import scenes
from tests.scenes import real

FACTOR = 1.33487285  # of 40 kJ/mol, from 140 to 130 degC


def _arrhenius(kind: Any) -> jaxform.Law:
    return kind(real(140.0), real(40e3))


def test_shifts_against_their_formulas() -> None:
    wlf = jaxform.Wlf(real(100.0), real(17.44), real(51.6))
    np.testing.assert_allclose(jnp.log10(wlf.factor(real(130.0))), -6.411765, rtol=1e-7)
    for kind in (jaxform.Arrhenius, jaxform.ArrheniusStiffness):
        np.testing.assert_allclose(kind(real(140.0), real(40e3)).factor(real(130.0)), FACTOR, rtol=1e-8)
        np.testing.assert_allclose(kind(real(140.0), real(40e3)).factor(real(140.0)), 1.0, rtol=1e-12)


@functools.cache
def _cup(viscous: Any, shift: Any, temperature: float | None) -> jaxform.Scene:
    plain = scenes.cup()
    modes = None if viscous is None else viscous(jnp.asarray([1.0, 0.5]), jnp.asarray([2.0, 20.0]))
    law = jaxform.NeoHookean(real(1.0), real(1.0), viscous=modes, shift=shift and shift(real(140.0), real(40e3)))
    warm: Any = None
    if temperature is not None:
        places = np.asarray(plain.parison.positions)
        warm = jnp.asarray(temperature + 10.0 * places[:, 0] * (temperature != 130.0))
    return jaxform.build_scene(
        material=law,
        parison=dataclasses.replace(plain.parison, temperature=warm),
        pressure=jaxform.make_pressure([0.0, 16.0], [0.0, 0.3]),
        solver=plain.solver,
        mold=plain.mold,
        fill=False,
    )


@pytest.mark.long
@pytest.mark.parametrize(
    ("viscous", "shift"),
    [
        (jaxform.Christensen, jaxform.Arrhenius),
        (jaxform.Maxwell, jaxform.ArrheniusStiffness),
    ],
)
def test_an_even_temperature_is_another_law(viscous: Any, shift: Any) -> None:
    warm = jaxform.run(_cup(viscous, shift, 130.0))
    plain = _cup(viscous, None, None)
    stiffer = FACTOR if shift is jaxform.ArrheniusStiffness else 1.0
    numbers: dict[str, Any] = {"material.c": stiffer}
    if plain.material.viscous is not None:
        numbers["material.viscous.modulus"] = stiffer * plain.material.viscous.modulus
        numbers["material.viscous.time"] = FACTOR * plain.material.viscous.time
    same = jaxform.run(jaxform.replace(plain, numbers))
    assert int(warm.steps) == int(same.steps) and int(warm.status) == 0
    np.testing.assert_allclose(warm.positions, same.positions, rtol=0, atol=1e-9)
    np.testing.assert_allclose(warm.energy.viscous_loss, same.energy.viscous_loss, rtol=1e-6, atol=1e-15)


@pytest.mark.long
def test_the_warm_side_becomes_thin() -> None:
    """A quarter that is warmer towards x, against its own mirror image."""
    slopes = []
    for temperature in (135.0, 130.0):
        scene = _cup(None, jaxform.ArrheniusStiffness, temperature)
        x, y, _ = np.asarray(scene.parison.positions).T
        wall = np.asarray(jaxform.run(scene).thickness) / 0.01
        inside = np.hypot(x, y) < 0.9
        slopes.append(np.polyfit((x - y)[inside], wall[inside], 1)[0])
    assert slopes[0] < -0.01 and abs(slopes[1]) < 1e-3


FILE = """
[parison]
shape = "disc"
radius = 0.1
elements = 24
symmetry = "quarter"
thickness = 1.0e-3
{temperature}
[material]
model = "neo-hookean"
c = 1.0e5
density = 1000.0
{shift}
[pressure]
time = [0.0, 0.1]
value = [0.0, 3.0e3]
[solver]
end_time = 0.02
damping = 100.0
"""
_WARM = 'temperature = { along = "radius", at = [0.0, 0.1], value = [150.0, 120.0] }'
_WLF = 'shift = { kind = "wlf", reference = 100.0, c1 = 17.44, c2 = 51.6 }'
_STIFF = 'shift = { kind = "arrhenius-stiffness", reference = 140.0, activation_energy = 4.0e4 }'


@pytest.mark.parametrize("refined", scenes.short_first([False, True]))
def test_temperature_in_a_file_and_in_the_part(tmp_path: Path, refined: bool) -> None:
    path = tmp_path / "scene.toml"
    path.write_text(
        FILE.format(temperature=_WARM, shift=_STIFF) + "[refinement]\nmax_level = 2\nangle = 0.5\n" * refined
    )
    document = files.read_scene(path)
    scene = files.build(document)
    assert isinstance(scene.material.shift, jaxform.ArrheniusStiffness)
    result = jaxform.run(scene)
    output.write_part(scene, result, tmp_path / "final.vtu")
    part = meshes.read_mesh(tmp_path / "final.vtu")
    start = np.stack([part.fields[name] for name in meshes.REFERENCE], axis=1)
    np.testing.assert_allclose(part.fields["temperature"], 150.0 - 300.0 * np.hypot(*start[:, :2].T), rtol=1e-6)
    variable = optimize.Scale(scene, of="parison.temperature", bounds=(0.9, 1.1))
    scene_rewriting.write_scene(document, variable.document(jnp.asarray(variable.start) + 0.5), tmp_path)
    again = files.load(tmp_path / "best.toml")
    expected = variable.changes(jnp.asarray(variable.start) + 0.5)["parison.temperature"]
    assert again.parison.temperature is not None
    # At nodes that refinement may make the file's field is linear, the profile is not quite.
    first = scene.first_nodes
    np.testing.assert_allclose(again.parison.temperature[:first], expected[:first], rtol=1e-6)
    np.testing.assert_allclose(again.parison.temperature, expected, rtol=1e-2)


@pytest.mark.parametrize(
    ("temperature", "shift", "words"),
    [
        ("", _WLF, "parison.temperature: is missing"),
        ("temperature = 40.0", _WLF, "parison.temperature = 40.0: is not above 48.4 degC"),
        ("temperature = -300.0", _WLF, "parison.temperature = -300.0"),
        ('temperature = "field:hot"', _WLF, "parison.temperature = 'field:hot'"),
        (_WARM, 'shift = { kind = "log", reference = 100.0 }', "material.shift.kind = 'log'"),
        (_WARM, 'shift = { kind = "wlf", reference = 100.0, c1 = 17.44 }', "material.shift.c2: is missing"),
        (_WARM, 'shift = { kind = "arrhenius", reference = 1e2, activation_energy = -1.0 }', "activation_energy = -1"),
    ],
)
def test_what_is_wrong_is_refused_in_words(tmp_path: Path, temperature: str, shift: str, words: str) -> None:
    scenes.assert_refused(tmp_path, FILE.format(temperature=temperature, shift=shift), words)


def test_a_temperature_that_changes_nothing_is_told(tmp_path: Path) -> None:
    path = tmp_path / "scene.toml"
    path.write_text(FILE.format(temperature=_WARM, shift=""))
    with pytest.warns(jaxform.InputWarning, match=r"parison.temperature.*has no effect.*material.shift"):
        files.load(path)

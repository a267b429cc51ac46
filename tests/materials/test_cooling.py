"""Cooling: walls against exact solutions, a stiffening sphere against its own equation, gradients, files, messages."""

from __future__ import annotations

import dataclasses
import functools
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import integrate
from scipy import optimize as search

import jaxform
import optimize
from jaxform import molds, shapes
from jaxform.io import files, output, scene_rewriting
from jaxform.mechanics.elements import Nodes
from jaxform.mesh import meshes
from jaxform.sheet import heat
from tests import scenes
from tests.scenes import real

ENERGY, REFERENCE = 40e3, 140.0
MODULUS, TIME = [1.0, 0.5], [2.0, 20.0]


def _cooling(**numbers: float) -> jaxform.Cooling:
    usual = {"heat_capacity": 1.0, "air_temperature": 20.0, "mold_temperature": 30.0} | numbers
    given: dict[str, Any] = {name: real(value) for name, value in usual.items()}
    return jaxform.Cooling(**given)


def _wall_cooled(cooling: jaxform.Cooling, touching: float, time: Any) -> np.ndarray:
    return np.asarray(cooling.cooled(real(140.0), real(0.01), real(touching), real(1.0), jnp.asarray(time)))


def test_a_wall_cools_exponentially() -> None:
    times = np.array([0.0, 1e-6, 0.1, 1.0, 1e3])
    cooling = _cooling(air=0.02, mold=0.03)
    np.testing.assert_allclose(_wall_cooled(cooling, 0.0, times), 20.0 + 120.0 * np.exp(-4.0 * times), rtol=1e-12)
    # Air on one side and mold on the other: towards the mean of both by their coefficients.
    np.testing.assert_allclose(_wall_cooled(cooling, 1.0, times), 26.0 + 114.0 * np.exp(-5.0 * times), rtol=1e-12)
    np.testing.assert_allclose(_wall_cooled(_cooling(), 1.0, times), 140.0)


@pytest.mark.parametrize(("biot", "error"), [(0.1, 1e-3), (1.0, 0.015), (5.0, 0.09)])
def test_a_thick_wall_cools_as_a_slab_conducts(biot: float, error: float) -> None:
    """A slab cooled at one side: its slowest mode is that of the exact series within what a parabola can tell."""
    conductivity = 0.2
    cooling = _cooling(mold=biot * conductivity / 0.01, mold_temperature=0.0, conductivity=conductivity)
    root = search.root_scalar(lambda z: z * np.tan(z) - biot, bracket=(1e-9, 0.5 * np.pi - 1e-9)).root
    seconds = 0.01**2 / conductivity
    pace = -np.log(_wall_cooled(cooling, 1.0, seconds) / 140.0)
    np.testing.assert_allclose(pace, root**2, rtol=error)
    plain = -np.log(_wall_cooled(dataclasses.replace(cooling, conductivity=None), 1.0, seconds) / 140.0)
    assert abs(pace - root**2) < 0.06 * abs(plain - root**2)


@pytest.mark.long
def test_a_flange_on_the_mold_and_a_sheet_at_rest_cool_as_walls_do() -> None:
    """Without pressure: the ring that lies on the mold by that, the rest by the air, each exactly."""
    sheet = shapes.disc(radius=1.0, elements=200, symmetry="quarter")
    mold = molds.revolved(profile=[[0.0, 0.5], [0.6, 0.5], [0.65, 0.0], [1.0, 0.0]], segments=48)
    cooling = _cooling(air=0.02, mold=0.03)
    scene = jaxform.build_scene(
        parison=jaxform.make_parison(sheet.positions, sheet.triangles, 0.01, sheet.clamped, sheet.fixed, 140.0),
        material=jaxform.NeoHookean(real(1.0), real(1.0)),
        pressure=jaxform.make_pressure([0.0, 1.0], [0.0, 0.0], "cubic-ramp"),
        solver=jaxform.make_solver(end_time=0.3, damping=1.0),
        mold=jaxform.make_mold(mold.vertices, mold.triangles),
        fill=False,
        cooling=cooling,
    )
    with pytest.warns(jaxform.InputWarning, match="nothing touched"):
        result = jaxform.run(scene)
    time, place = float(result.time), np.linalg.norm(np.asarray(scene.parison.positions), axis=1)
    inside, ring = place < 0.5, (place > 0.8) & (place < 0.9)
    assert inside.any() and ring.any() and time > 0.0
    np.testing.assert_allclose(_warmth(result)[inside], _wall_cooled(cooling, 0.0, time), rtol=1e-9)
    np.testing.assert_allclose(_warmth(result)[ring], _wall_cooled(cooling, 1.0, time), rtol=1e-9)


def _factor(temperature: Any) -> Any:
    return np.exp(ENERGY / 8.31446261815324 * (1.0 / (temperature + 273.15) - 1.0 / (REFERENCE + 273.15)))


def _own_sphere(pressure: float, air: float, end: float) -> np.ndarray:
    """Radius and temperature of a sphere that stiffens, by an ordinary differential equation of its own."""
    modulus, time = np.asarray(MODULUS), np.asarray(TIME)

    def slope(now: float, y: np.ndarray) -> np.ndarray:
        stretch, speed, warm, plane, across = y[0], y[1], y[2], y[3:5], y[5:7]
        shift = _factor(warm)
        stress = shift * (2.0 + modulus @ plane - (2.0 + modulus @ across) / stretch**6)
        cooling = -2.0 * air * (warm - 20.0) * stretch**2 / 0.01
        rates = (stretch**-2 - plane) / (time * shift), (stretch**4 - across) / (time * shift)
        return np.concatenate([[speed, pressure * now / 3.0 * stretch**2 - 2.0 * stretch * stress, cooling], *rates])

    found = integrate.solve_ivp(slope, (0.0, end), [1.0, 0.0, REFERENCE, 1, 1, 1, 1], rtol=1e-9, atol=1e-9)
    return found.y[[0, 2], -1]


def test_a_sphere_that_stiffens_as_it_cools() -> None:
    """Rubber with Maxwell's modes under a rising pressure: stretch, temperature, and the balance of energy."""
    modes = jaxform.Maxwell(jnp.asarray(MODULUS), jnp.asarray(TIME))
    shift = jaxform.ArrheniusStiffness(real(REFERENCE), real(ENERGY))
    law = jaxform.NeoHookean(real(1.0), real(1.0), viscous=modes, shift=shift)
    plain = scenes.sphere(512, 2.0, scenes.mooney(0.0), [0.0, 3.0], end_time=3.0)
    scene = jaxform.build_scene(
        parison=dataclasses.replace(plain.parison, temperature=jnp.full_like(plain.parison.thickness, REFERENCE)),
        material=law,
        pressure=plain.pressure,
        solver=plain.solver,
        cooling=_cooling(air=5e-4),
    )
    for end in (1.5, 3.0):
        result = jaxform.run(jaxform.replace(scene, {"solver.end_time": end}))
        radius, warm = _own_sphere(2.0, 5e-4, end)
        assert warm < 125.0
        found = np.linalg.norm(np.asarray(result.positions), axis=1).mean()
        np.testing.assert_allclose(found, radius, atol=2e-3)
        np.testing.assert_allclose(np.mean(_warmth(result)), warm, rtol=5e-4)
        assert float(result.energy.balance_error) < 1e-3 and float(result.energy.cooling_loss) < 0.0


@functools.cache
def _cup(skip_stuck: bool = True) -> jaxform.Scene:
    """A sheet that cools by a fifth of its warmth while it is formed, and stiffens."""
    plain = scenes.cup(60, 6.0)
    modes = jaxform.Maxwell(jnp.asarray(MODULUS[:1]), jnp.asarray(TIME[:1]))
    shift = jaxform.ArrheniusStiffness(real(REFERENCE), real(ENERGY))
    places = np.asarray(plain.parison.positions)
    return jaxform.build_scene(
        parison=dataclasses.replace(plain.parison, temperature=jnp.asarray(135.0 + 10.0 * places[:, 0])),
        material=jaxform.NeoHookean(real(1.0), real(1.0), viscous=modes, shift=shift),
        pressure=jaxform.make_pressure([0.0, 16.0], [0.0, 0.8]),
        solver=dataclasses.replace(plain.solver, skip_stuck=skip_stuck, safety=real(0.7)),
        mold=plain.mold,
        fill=False,
        cooling=_cooling(air=1e-4, mold=1e-3, conductivity=1e-5),
    )


def _warmth(result: jaxform.Result) -> jax.Array:
    assert result.temperature is not None
    return result.temperature


@pytest.mark.long
def test_what_sticks_cools_and_relaxes_whether_it_is_stepped_on_or_not() -> None:
    skipped, stepped = (jaxform.run(_cup(skip)) for skip in (True, False))
    assert int(skipped.status) == int(stepped.status) == 0
    np.testing.assert_allclose(skipped.positions, stepped.positions, rtol=0, atol=1e-12)
    np.testing.assert_allclose(skipped.energy.strain, stepped.energy.strain, rtol=1e-9)
    np.testing.assert_allclose(skipped.energy.viscous_loss, stepped.energy.viscous_loss, rtol=1e-3)
    np.testing.assert_allclose(_warmth(skipped), _warmth(stepped), rtol=1e-9)
    np.testing.assert_allclose(skipped.energy.cooling_loss, stepped.energy.cooling_loss, rtol=1e-9)


def _all_stuck(end: float) -> jaxform.Scene:
    """A disc that lies on its mold with all nodes at 13, and cools by the mold alone."""
    sheet = shapes.disc(radius=1.0, elements=40, symmetry="quarter")
    mold = molds.revolved(profile=[[0.0, 0.3], [0.7, 0.3], [1.0, 0.0]], segments=48)
    return jaxform.build_scene(
        parison=jaxform.make_parison(sheet.positions, sheet.triangles, 0.01, sheet.clamped, sheet.fixed, 150.0),
        material=jaxform.NeoHookean(real(1.0), real(1.0)),
        pressure=jaxform.make_pressure([0.0, 20.0], [0.0, 0.4], "cubic-ramp"),
        solver=jaxform.make_solver(end_time=end, damping=2.0),
        mold=jaxform.make_mold(mold.vertices, mold.triangles),
        cooling=_cooling(heat_capacity=1000.0, mold=1.0, mold_temperature=60.0),
    )


@jax.jit
@functools.partial(jax.value_and_grad, has_aux=True)
def _mean_warmth(mold: jax.Array, scene: jaxform.Scene) -> tuple[jax.Array, jaxform.Result]:
    result = jaxform.simulate(jaxform.replace(scene, {"cooling.mold": mold}))
    return jnp.mean(_warmth(result)), result


@pytest.mark.long
@pytest.mark.parametrize("end", [25.0, 40.0])
def test_what_sticks_early_has_the_temperature_of_the_end_time(end: float) -> None:
    """It was that of the border at which the last node had stuck, whatever the end time."""
    # Both of one scene, so that they share programs.
    scene = jaxform.replace(_all_stuck(40.0), {"solver.end_time": end})
    result = jaxform.run(scene)
    assert int(result.status) == 0 and float(result.time) < 20.0
    triangles, wall = np.asarray(result.triangles), np.asarray(result.element_thickness)
    since = np.where(np.asarray(result.wall) != 0, end - np.asarray(result.contact_time), 0.0)
    # Newton's law for each element, over as much of its area and as long as it touches the mold.
    own = 60.0 + 90.0 * np.exp(-since[triangles].mean(1) / (1000.0 * wall))
    area = np.asarray(scene.tables.sheet.area)
    sums = [np.bincount(triangles.ravel(), np.repeat(x, 3), len(since)) for x in (area * own, area)]
    np.testing.assert_allclose(_warmth(result), sums[0] / sums[1], atol=0.2)
    # A simulation has it too, with its gradient.
    at, step = real(1.0), 1e-5
    (_, simulated), slope = _mean_warmth(at, scene)
    np.testing.assert_allclose(_warmth(simulated), _warmth(result), rtol=1e-9)
    ends = [_mean_warmth(at + sign * step, scene)[0][0] for sign in (1, -1)]
    np.testing.assert_allclose(slope, (ends[0] - ends[1]) / (2 * step), rtol=1e-6)
    assert float(slope) < -1.0


def test_the_air_is_as_warm_as_the_reference_says_where_a_file_does_not_say(tmp_path: Path) -> None:
    (tmp_path / "scene.toml").write_text(FILE.format(cooling="heat_capacity = 2000.0\nair = 10.0\nmold = 5.0"))
    with pytest.warns(jaxform.InputWarning, match="no mold"):
        cooling = files.load(tmp_path / "scene.toml").cooling
    assert cooling is not None and float(cooling.air_temperature) == float(cooling.mold_temperature) == 20.0


def test_an_element_touches_by_the_share_of_its_nodes_and_of_the_time() -> None:
    """One node touches all the time, one half of it, one later; of the other element one node alone touches."""
    since, wall = jnp.asarray([0.0, 1.0, 2.5, 0.0]), jnp.asarray([1, -2, 3, 0], jnp.int32)
    nodes = Nodes(jnp.zeros((3, 4)), jnp.zeros((3, 4)), wall != 0, since, wall, None, {})
    triangles, end = jnp.asarray([[0, 0], [1, 3], [2, 3]]), jnp.full(2, 2.0)
    np.testing.assert_allclose(heat._contact_share(nodes, triangles, jnp.zeros(2), end, None), [0.5, 1.0 / 3.0])
    np.testing.assert_allclose(heat._contact_share(nodes, triangles, end, end, None), [1.0, 1.0 / 3.0])


def test_below_a_shift_the_sheet_is_glass() -> None:
    wlf = jaxform.Wlf(real(100.0), real(17.44), real(51.6))
    factors, slopes = jax.vmap(jax.value_and_grad(wlf.factor))(jnp.asarray([130.0, 100.0, 60.0, 48.4, 20.0]))
    assert np.all(np.diff(factors) >= 0.0) and np.all(np.isfinite(factors)) and np.all(np.isfinite(slopes))


FILE = """
[parison]
shape = "disc"
radius = 0.1
elements = 24
symmetry = "quarter"
thickness = 1.0e-3
temperature = 140.0
[material]
model = "neo-hookean"
c = 1.0e5
density = 1000.0
[pressure]
time = [0.0, 0.1]
value = [0.0, 3.0e3]
[solver]
end_time = 0.02
damping = 100.0
[cooling]
{cooling}
"""
_DEEP = '[mold]\nshape = "revolved"\nprofile = [[0.0, 0.1], [0.1, 0.0]]\nsegments = 48\nfill = false\n'
_AIR = "heat_capacity = 2000.0\nair = 50.0\nair_temperature = 20.0\n"


def _deep_scene(tmp_path: Path) -> files.SceneDocument:
    path = tmp_path / "scene.toml"
    # Over a mold under a ramp as other sheets here, whose programs it then has.
    ramp = FILE.format(cooling=_AIR).replace(
        "value = [0.0, 3.0e3]", 'value = [0.0, 3.0e3]\ninterpolation = "cubic-ramp"'
    )
    path.write_text(ramp + _DEEP)
    return files.read_scene(path)


@pytest.mark.long
def test_the_part_of_a_file_with_cooling_has_its_temperature(tmp_path: Path) -> None:
    """The file of a part is compared with the part for each feature in tests/runs/test_features.py."""
    scene = files.build(_deep_scene(tmp_path))
    with pytest.warns(jaxform.InputWarning, match="nothing touched"):
        result = jaxform.run(scene)
    output.write_part(scene, result, tmp_path / "final.vtu")
    written = meshes.read_mesh(tmp_path / "final.vtu").fields["temperature"]
    np.testing.assert_allclose(written, _warmth(result), rtol=1e-12)
    assert 120.0 < jaxform.summarize(result, scene)["temperature"]["max"] < 139.9


def test_a_design_of_cooling_is_written_into_the_scene(tmp_path: Path) -> None:
    document = _deep_scene(tmp_path)
    variable = optimize.Scale(files.build(document), of="cooling.air", bounds=(0.5, 2.0))
    scene_rewriting.write_scene(document, variable.document(jnp.asarray(variable.start) + 0.5), tmp_path)
    again, expected = files.load(tmp_path / "best.toml"), variable.changes(jnp.asarray(variable.start) + 0.5)
    assert again.cooling is not None
    np.testing.assert_allclose(again.cooling.air, expected["cooling.air"])


@pytest.mark.parametrize(
    ("cooling", "words"),
    [
        ("air = 10.0\nair_temperature = 20.0", "cooling.heat_capacity: is missing"),
        ("heat_capacity = 2000.0", "cooling.air = 0.0: cools nothing"),
        (_AIR.replace("50.0", "-1.0"), "cooling.air = -1.0: is too small"),
        (_AIR + "conductivity = 0.0", "cooling.conductivity = 0.0"),
        (_AIR + "wind = 1.0", "cooling.wind"),
    ],
)
def test_what_is_wrong_is_refused_in_words(tmp_path: Path, cooling: str, words: str) -> None:
    scenes.assert_refused(tmp_path, FILE.format(cooling=cooling), words)


def test_what_is_doubtful_is_told(tmp_path: Path) -> None:
    path = tmp_path / "scene.toml"
    path.write_text(FILE.format(cooling=_AIR + "mold = 5.0\nmold_temperature = 20.0"))
    with pytest.warns(jaxform.InputWarning, match=r"cooling.mold.*no mold"):
        files.load(path)
    shift = 'shift = { kind = "wlf", reference = 100.0, c1 = 17.44, c2 = 51.6 }\n'
    shift += 'viscous = { kind = "maxwell", modulus = [1.0e5], time = [0.1] }\ndensity'
    path.write_text(FILE.format(cooling=_AIR).replace("density", shift))
    with pytest.warns(jaxform.InputWarning, match=r"cooling.air_temperature = 20.0.*below 48.4 degC"):
        files.load(path)
    path.write_text(FILE.format(cooling=_AIR).replace("temperature = 140.0\n", "", 1))
    with pytest.raises(jaxform.InputError, match=r"parison.temperature: is missing.*\[cooling\]"):
        files.load(path)

"""Gases with a temperature of their own, and gases that the sheet traps in the mold: closed forms, ODEs, gradients."""

from __future__ import annotations

import json
import tomllib
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.optimize import brentq

import jaxform
from jaxform import shapes
from jaxform.cli.command import main
from jaxform.io import files
from jaxform.io.scene_rewriting import write_scene
from jaxform.loads import first_pressure, next_pressure
from optimize.variables import Scale
from tests import scenes
from tests.loads.slopes import assert_slopes_are_differences

AMBIENT, R, WARM, K = 101325.0, 287.06, 293.15, 1.4
SEALED: dict[str, Any] = {"gas_constant": 1.0, "temperature": 1.0, "ambient_pressure": 0.5}


def _follow(load: jaxform.Loading, volumes: np.ndarray, length: float) -> np.ndarray:
    """Pressures on the sheet while the enclosed volume takes these values, at equal intervals [s]."""

    def step(carry: Any, number: jax.Array) -> Any:
        state, before = carry
        volume = jnp.asarray(volumes)[number]
        later = next_pressure(load, state, jaxform.Interval(number * length, jnp.asarray(length), before, volume))
        return (later, volume), later.pressure

    start = first_pressure(load, jnp.asarray(volumes[0]))
    begun = start, jnp.asarray(volumes[0])
    return np.append(start.pressure, jax.lax.scan(step, begun, jnp.arange(1, len(volumes)))[1])


@pytest.mark.quick
@pytest.mark.parametrize(("adiabatic", "power"), [(False, 1.0), (True, K)])
def test_trapped_gas_resists_by_its_closed_form(adiabatic: bool, power: float) -> None:
    volumes = np.array([0.1, 0.5, 0.3, 0.95, 0.2])
    trapped = jaxform.make_gas([0.0], dead_volume=1.0, adiabatic=adiabatic, closed_by="mold", **SEALED)
    found = _follow(trapped, volumes, 0.01)
    np.testing.assert_allclose(found, 0.5 - 0.5 * (0.9 / (1.0 - volumes)) ** power, rtol=1e-12, atol=1e-15)
    inside = jaxform.make_gas([0.0], dead_volume=0.4, adiabatic=adiabatic, **SEALED)
    both = _follow(jaxform.make_two_sided_load(inside, trapped), volumes, 0.01)
    np.testing.assert_allclose(both - found, 0.5 * (0.5 / (0.4 + volumes)) ** power - 0.5, rtol=1e-12, atol=1e-14)


def _flow(outside: float, inside: float, warm: float) -> float:
    high, low = max(outside, inside), min(outside, inside)
    ratio = max(low / high, (2.0 / (K + 1.0)) ** (K / (K - 1.0)))
    size = np.sqrt(max(0.0, 2.0 * K / (K - 1.0) * (ratio ** (2.0 / K) - ratio ** ((K + 1.0) / K))))
    return float(np.sign(outside - inside) * 0.8 * high / np.sqrt(R * warm) * size)


def test_adiabatic_gas_is_blown_expands_and_is_vented_as_its_ode_has_it() -> None:
    """Filled at 6 bar while its volume doubles, and a mass flow besides; then vented: mass and energy by scipy."""
    knots, valve, vent = [0.0, 0.02, 0.1, 0.12, 0.5], [0.0, 1.0, 1.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0, 1.0]
    blown = [0.0, 1e-4, 2e-4, 0.0, -2e-4]
    given: dict[str, Any] = {
        "supply_pressure": 6e5,
        "orifice_area": 4e-6,
        "valve": valve,
        "vent_area": 3e-6,
        "vent": vent,
    }
    gas = jaxform.make_gas(knots, blown, dead_volume=5e-5, adiabatic=True, **given)
    size = lambda time: 1e-4 * np.minimum(1.0, time / 0.15) ** 2  # noqa: E731

    def rise(time: float, state: np.ndarray) -> list[float]:
        mass, energy = state  # energy is m c_v T
        volume, warm = 5e-5 + size(time), energy * (K - 1.0) / (R * mass)
        inside = mass * R * warm / volume
        flows = [float(np.interp(time, knots, blown))]
        for pressure, area, opening in ((6e5 + AMBIENT, 4e-6, valve), (AMBIENT, 3e-6, vent)):
            upstream = WARM if pressure > inside else warm
            flows.append(area * np.interp(time, knots, opening) * _flow(pressure, inside, upstream))
        enthalpy = sum(flow * (WARM if flow > 0.0 else warm) for flow in flows) * R * K / (K - 1.0)
        growth = 2e-4 * time / 0.15**2 if time < 0.15 else 0.0
        return [sum(flows), enthalpy - inside * growth]

    times = np.linspace(0.0, 0.4, 41)
    mass = AMBIENT * 5e-5 / (R * WARM)
    begun = [mass, mass * R * WARM / (K - 1.0)]
    exact = solve_ivp(rise, (0.0, 0.4), begun, t_eval=times, rtol=1e-9, atol=1e-13, max_step=5e-4)
    expected = exact.y[1] * (K - 1.0) / (5e-5 + size(times))
    warm = exact.y[1] * (K - 1.0) / (R * exact.y[0])
    assert warm.max() > 1.2 * WARM and warm.min() < 0.9 * WARM and expected.max() > 5e5

    def follow_pressure(count: int) -> np.ndarray:
        return _follow(gas, size(np.linspace(0.0, 0.4, 40 * count + 1)), 0.01 / count)[::count] + AMBIENT

    apart = (times < 0.12) & (times > 0.0)
    np.testing.assert_allclose(follow_pressure(400)[1:], expected[1:], rtol=3e-4)
    np.testing.assert_allclose(follow_pressure(400)[apart], expected[apart], rtol=3e-6)
    errors = [np.abs(follow_pressure(count) - expected)[apart].max() for count in (5, 10, 20)]
    assert np.log2(errors[0] / errors[1]) > 1.7 and np.log2(errors[1] / errors[2]) > 1.7, "of second order"


def _sphere(load: jaxform.Loading, end_time: float, elements: int) -> jaxform.Scene:
    """A quarter of a neo-Hookean sphere of radius 1; pressures in units of c."""
    sheet = shapes.sphere(radius=1.0, elements=elements, symmetry="quarter")
    return jaxform.build_scene(
        parison=jaxform.make_parison(sheet.positions, sheet.triangles, 0.01, sheet.clamped, sheet.fixed),
        material=scenes.mooney(0.0),
        pressure=load,
        solver=jaxform.make_solver(end_time=end_time, damping=1.0),
    )


@pytest.mark.long
@pytest.mark.parametrize(("adiabatic", "power"), scenes.short_first([(False, 1.0), (True, K)]))
def test_sphere_is_stopped_by_the_air_around_it(adiabatic: bool, power: float) -> None:
    """Past the limit point of its membrane, in a closed chamber of 4 times its volume: the air there holds it."""
    sheet = shapes.sphere(radius=1.0, elements=400, symmetry="quarter")
    volume = np.linalg.det(sheet.positions[sheet.triangles]).sum() / 6.0
    around: dict[str, Any] = {"adiabatic": adiabatic, "closed_by": "mold", "gas_constant": 1.0, "temperature": 1.0}
    trapped = jaxform.make_gas([0.0], dead_volume=4.0 * volume, ambient_pressure=0.05, **around)
    inside = jaxform.make_pressure([0.0, 60.0], [0.0, 0.05])
    result = jaxform.run(_sphere(jaxform.make_two_sided_load(inside, trapped), 100.0, 400))
    assert int(result.status) == 0 and float(result.energy.balance_error) < 1e-3

    def excess(stretch: float) -> float:
        membrane = 4.0 * 0.01 * (1.0 / stretch - stretch**-7)
        return 0.05 - membrane - 0.05 * ((3.0 / (4.0 - stretch**3)) ** power - 1.0)

    stretch = float(brentq(excess, 1.01, 1.58))  # pyright: ignore[reportArgumentType]
    np.testing.assert_allclose(np.linalg.norm(np.asarray(result.positions), axis=1), stretch, rtol=5e-3)
    assert result.pressures is not None
    np.testing.assert_allclose(result.pressures[1][-1], 0.04 * (1.0 / stretch - stretch**-7), rtol=2e-2)


@pytest.mark.long
def test_gradients_of_gases_on_both_sides_are_those_of_differences() -> None:
    knots = [0.0, 1.0, 4.0, 5.0]
    air: dict[str, Any] = {"temperature": 1.0, "gas_constant": 1.0, "ambient_pressure": 0.05, "adiabatic": True}
    blown: dict[str, Any] = {"supply_pressure": 0.06, "orifice_area": 0.1, "valve": [0.1, 0.8, 0.8, 0.1]}
    still: dict[str, Any] = {**air, "adiabatic": False}
    inside = jaxform.make_gas(knots, [0.0, 2e-3, 1e-3, 0.0], dead_volume=0.3, **blown, **still)
    trapped = jaxform.make_gas([0.0, 6.0], vent_area=0.03, vent=[0.2, 1.0], dead_volume=4.0, closed_by="mold", **air)
    scene = _sphere(jaxform.make_two_sided_load(inside, trapped), 7.0, 60)
    of_both = ("temperature", "dead_volume", "ambient_pressure", "heat_capacity_ratio", "time")
    paths = [f"pressure.{side}.{name}" for side in ("inside", "trapped") for name in of_both]
    paths += ["pressure.inside.valve", "pressure.inside.mass_flow", "pressure.trapped.vent_area"]
    values = {path: getattr(inside if ".inside." in path else trapped, path.rpartition(".")[2]) for path in paths}
    assert_slopes_are_differences(scene, values, least=1e-6)


_CUP = """
[parison]
shape = "disc"
radius = 0.05
elements = 150
symmetry = "quarter"
thickness = 1.0e-3
[material]
model = "mooney-rivlin"
c = 2.0e5
alpha = 0.1
density = 1000.0
<load>
[mold]
shape = "revolved"
profile = [[0.0, 0.03], [0.04, 0.03], [0.05, 0.0]]
segments = 32
[solver]
end_time = 0.1
damping = 300.0
"""
_VOLUME = 0.25 * np.pi * 0.03 * (0.05**2 + 0.05 * 0.04 + 0.04**2) / 3.0  # of a quarter of the cup
_PRESSURE = "[pressure]\ntime = [0.0, 0.05]\nvalue = [0.0, 8.0e4]\n"
_AIR = f"closed_by = 'mold'\ndead_volume = {_VOLUME:.6g}\n"


def _form(load: str, folder: Path) -> dict[str, Any]:
    """The summary of a cup that is formed by a load."""
    folder.mkdir()
    (folder / "cup.toml").write_text(_CUP.replace("<load>", load))
    main(["simulate", str(folder / "cup.toml"), "--out", str(folder / "out"), "--quiet"])
    return json.loads((folder / "out" / "summary.json").read_text())


@pytest.mark.long
def test_air_in_the_mold_keeps_the_sheet_off_it_unless_it_is_vented(tmp_path: Path) -> None:
    sealed = _form(f"{_PRESSURE}[gas]\n{_AIR}vent_area = 0.0\n", tmp_path / "sealed")
    vented = _form(f"{_PRESSURE}[gas]\n{_AIR}vent_area = 2.0e-5\n", tmp_path / "vented")
    pulled = _form(f"[gas]\n{_AIR}supply_pressure = -8.0e4\norifice_area = 2.0e-5\n", tmp_path / "vacuum")
    assert "not filled" in sealed["status"] and any("gas.vent_area" in warning for warning in sealed["warnings"])
    assert sealed["contact_fraction"] < 0.5 < 0.95 < min(vented["contact_fraction"], pulled["contact_fraction"])
    assert all(each["energy"]["balance_error"] < 1e-2 for each in (sealed, vented, pulled))
    assert all(each["status"] == "ok" and not each["warnings"] for each in (vented, pulled))
    np.testing.assert_allclose(pulled["thickness"]["mean"], vented["thickness"]["mean"], rtol=1e-2)


def test_a_supply_above_0_between_sheet_and_mold_is_told_to_draw(tmp_path: Path) -> None:
    """It pushes the sheet away from the mold; there is no pressure whose sign could be turned."""
    file = tmp_path / "cup.toml"
    file.write_text(
        _CUP.replace("<load>", f"[gas]\n{_AIR}time = [0.0, 0.05]\nsupply_pressure = 5e4\norifice_area = 1e-6\n")
    )
    with pytest.warns(jaxform.InputWarning, match="away from the mold") as told:
        jaxform.load(file)
    (words,) = [str(one.message) for one in told if "away from the mold" in str(one.message)]
    assert "gas.supply_pressure below 0" in words and "pressure.value" not in words
    assert "e+02 %" not in words


def test_two_gases_of_a_file_and_their_numbers_in_a_study(tmp_path: Path) -> None:
    inner = "[[gas]]\ntime = [0.0, 0.05]\nmass_flow = [1e-3, 0.0]\ndead_volume = 2e-5\nadiabatic = true\n"
    file = tmp_path / "cup.toml"
    file.write_text(_CUP.replace("<load>", f"[[gas]]\n{_AIR}vent_area = 1e-6\n{inner}"))
    scene = jaxform.load(file)
    assert isinstance(scene.pressure, jaxform.TwoSidedLoad) and scene.pressure.trapped.closed_by == "mold"
    scaled = Scale(scene, of="gas.mold.vent_area", bounds=(0.5, 2.0))
    free = jnp.asarray(scaled.start)
    assert list(scaled.changes(free)) == ["pressure.trapped.vent_area"]
    np.testing.assert_allclose(scaled.changes(free)["pressure.trapped.vent_area"], 1e-6, rtol=1e-12)
    assert list(scaled.document(free)) == ["gas.mold.vent_area"]
    assert list(Scale(scene, of="gas.clamp.mass_flow", bounds=(0.5, 2.0)).document(free)) == ["gas.clamp.mass_flow"]
    for path, place, side in (("gas.mold.vent_area", 0, 5e-6), ("gas.clamp.dead_volume", 1, 3e-5)):
        written = write_scene(files.read_scene(file), {path: side}, tmp_path)
        changed = tomllib.loads(written.read_text())["gas"]
        assert changed[place][path.rpartition(".")[2]] == side and len(changed) == 2
        assert isinstance(jaxform.load(written).pressure, jaxform.TwoSidedLoad)


@pytest.mark.parametrize(
    ("load", "words"),
    [
        (f"{_PRESSURE}[gas]\ntime = [0.0]\nmass_flow = [1e-3]\n", r"gas.*\[pressure\]"),
        (f"{_PRESSURE}[[gas]]\n{_AIR}[[gas]]\n{_AIR}", r"gas.*same side"),
        (f"{_PRESSURE}[gas]\nclosed_by = 'mold'\n", r"gas\.dead_volume.*cavity"),
        (f"[gas]\n{_AIR}supply_pressure = -2e5\norifice_area = 1e-5\n", r"gas\.supply_pressure.*vacuum"),
        ("[gas]\nmass_flow = [1e-3]\ndead_volume = 1e-5\n", r"gas\.time.*missing"),
        (f"[gas]\n{_AIR}heat_capacity_ratio = 1.3\n", r"gas\.heat_capacity_ratio.*no effect"),
    ],
)
def test_bad_loads_are_refused(load: str, words: str, tmp_path: Path) -> None:
    file = tmp_path / "cup.toml"
    file.write_text(_CUP.replace("<load>", load))
    with pytest.raises(jaxform.InputError, match=words):
        jaxform.load(file)


def test_gas_in_a_mold_that_moves_is_refused(tmp_path: Path) -> None:
    file = tmp_path / "cup.toml"
    text = _CUP.replace("<load>", f"{_PRESSURE}[gas]\n{_AIR}")
    moving = "[mold.motion]\ndirection = [0, 0, -1]\ntime = [0.0, 0.1]\ndisplacement = [0.0, 0.01]\n[solver]"
    file.write_text(text.replace("[solver]", moving))
    with pytest.raises(jaxform.InputError, match=r"gas.*moves"):
        jaxform.load(file)

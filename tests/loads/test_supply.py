"""A gas behind a valve and a vent: against an ODE of a rigid vessel and closed forms, gradients, refused input."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import jaxform
from jaxform import shapes
from jaxform.cli.command import main
from jaxform.loads import first_pressure, next_pressure
from optimize.variables import Scale
from tests import scenes
from tests.loads.slopes import assert_slopes_are_differences

AMBIENT, RT, VESSEL = 101325.0, 287.06 * 293.15, 1e-4
KNOTS = [0.0, 0.02, 0.1, 0.12, 0.5, 0.52]
VALVE, VENT = [0.0, 0.3, 0.3, 1.0, 1.0, 0.0], [0.0, 0.0, 0.0, 0.0, 0.0, 1.0]
SUPPLY = [6e5, 6e5, 6e5, 3e6, 3e6, 3e6]


def _vessel(**changes: Any) -> jaxform.Gas:
    """Pre-blow at 6 bar, blow at 30 bar, then the vent; of a rigid vessel of 0.1 l."""
    given: dict[str, Any] = {
        "dead_volume": VESSEL,
        "supply_pressure": SUPPLY,
        "orifice_area": 4e-6,
        "valve": VALVE,
        "vent_area": 3e-6,
        "vent": VENT,
    }
    return jaxform.make_gas(KNOTS, **(given | changes))


def _fill(gas: jaxform.Gas, count: int, end: float) -> np.ndarray:
    """Gauge pressures (count,) [Pa] of the vessel after equal steps."""
    length, none = jnp.asarray(end / count), jnp.asarray(0.0)

    def step(state: Any, number: jax.Array) -> Any:
        later = next_pressure(gas, state, jaxform.Interval((number + 1) * length, length, none, none))
        return later, later.pressure

    return np.asarray(jax.lax.scan(step, first_pressure(gas, none), jnp.arange(count))[1])


def _isentropic(outside: float, inside: float) -> float:
    """Mass flow per area through an orifice of C = 0.8, of air."""
    high, low = max(outside, inside), min(outside, inside)
    ratio = max(low / high, (2.0 / 2.4) ** 3.5)
    flow = np.sqrt(max(0.0, 7.0 * (ratio ** (2.0 / 1.4) - ratio ** (2.4 / 1.4))))
    return float(np.sign(outside - inside) * 0.8 * high / np.sqrt(RT) * flow)


def _exact(times: np.ndarray) -> np.ndarray:
    def rise(time: float, mass: np.ndarray) -> list[float]:
        inside = float(mass[0]) * RT / VESSEL
        supply = float(np.interp(time, KNOTS, SUPPLY)) + AMBIENT
        flow = 4e-6 * np.interp(time, KNOTS, VALVE) * _isentropic(supply, inside)
        return [float(flow + 3e-6 * np.interp(time, KNOTS, VENT) * _isentropic(AMBIENT, inside))]

    start = [AMBIENT * VESSEL / RT]
    solved = solve_ivp(rise, (0.0, times[-1]), start, t_eval=times, rtol=1e-9, atol=1e-14, max_step=1e-3)
    return solved.y[0] * RT / VESSEL - AMBIENT


def test_vessel_is_filled_and_vented_as_its_ode_has_it() -> None:
    times = np.linspace(0.01, 0.8, 80)
    expected = _exact(times)
    assert expected.max() > 2.999e6 and expected[7] < 1e5 and expected[-1] < 0.3 * expected.max()
    found = _fill(_vessel(), 8000, 0.8)[99::100]
    np.testing.assert_allclose(found, expected, rtol=3e-4)
    # Far from equal pressures the flow is the isentropic one itself, choked and unchoked.
    apart = times < 0.22
    np.testing.assert_allclose(found[apart], expected[apart], rtol=2e-6)
    assert expected[apart].max() > 0.55 * 3.1e6, "past the critical ratio"
    errors = [np.abs(_fill(_vessel(), 80 * n, 0.8)[n - 1 :: n] - expected)[apart].max() for n in (2, 4, 8)]
    assert np.log2(errors[0] / errors[1]) > 1.7 and np.log2(errors[1] / errors[2]) > 1.7, "of second order"


def test_long_steps_do_not_pass_the_supply() -> None:
    """Steps of a hundred times the time in which the vessel fills, forwards and back through the valve."""
    gas = _vessel(orifice_area=4e-3, valve=1.0, vent=0.0, supply_pressure=[6e5, 6e5, 3e6, 3e6, 2e5, 2e5])
    pressure = _fill(gas, 40, 0.8)
    assert np.all(pressure >= 0.0) and np.all(pressure <= 3e6 * (1.0 + 1e-12))
    np.testing.assert_allclose(pressure[[0, 5, 39]], [6e5, 3e6, 2e5], rtol=2e-2)
    sampled = gas.pushes(0.8, 0.0)
    assert sampled.max() <= 3e6 * (1.0 + 1e-12) and sampled.max() > 2.9e6


@pytest.mark.quick
def test_flow_is_smooth_at_equal_pressures_and_odd() -> None:
    gas = _vessel()
    flow = jax.jit(jax.vmap(jax.value_and_grad(lambda inside: gas.orifice_flow(jnp.asarray(1e6), inside))))
    inside = 1e6 + np.array([-4000.0, -2000.1, -1999.9, -100.0, -1e-3, 0.0, 1e-3, 100.0])
    value, slope = map(np.asarray, flow(jnp.asarray(inside)))
    np.testing.assert_allclose(value[0], _isentropic(1e6, inside[0]), rtol=1e-12)
    np.testing.assert_allclose([value[1], slope[1]], [value[2], slope[2]], rtol=3e-4)
    np.testing.assert_allclose(slope[4:7], slope[5], rtol=1e-6)
    assert value[5] == 0.0 and np.all(slope < 0.0)
    np.testing.assert_allclose(value[3], -value[7], rtol=3e-4)
    choked = gas.orifice_flow(jnp.asarray(1e6), jnp.asarray([1e5, 3e5, 5.28e5]))
    np.testing.assert_allclose(choked, 0.8 * 1e6 * np.sqrt(1.4 / RT * (2.0 / 2.4) ** 6.0), rtol=1e-6)


def _sphere(end_time: float, elements: int, **given: Any) -> jaxform.Scene:
    """A quarter of a closed Mooney-Rivlin sphere of radius 1, with pressures in units of c; R T = 1."""
    sheet = shapes.sphere(radius=1.0, elements=elements, symmetry="quarter")
    gas = jaxform.make_gas(temperature=1.0, gas_constant=1.0, ambient_pressure=0.05, **given)
    return jaxform.build_scene(
        parison=jaxform.make_parison(sheet.positions, sheet.triangles, 0.01, sheet.clamped, sheet.fixed),
        material=scenes.mooney(0.1),
        pressure=gas,
        solver=jaxform.make_solver(end_time=end_time, damping=1.0),
    )


@pytest.mark.long
def test_sphere_comes_to_the_pressure_of_its_supply_and_back_through_the_vent() -> None:
    stretch = 1.2
    supply = 4.0 * 0.01 * (1.0 / stretch - stretch**-7) * (1.0 + 0.1 * stretch**2)
    valve = {"valve": [1.0, 1.0, 0.0, 0.0], "vent_area": 0.1, "vent": [0.0, 0.0, 0.0, 1.0]}
    given = {"time": [0.0, 60.0, 60.1, 60.2], "supply_pressure": supply, "orifice_area": 0.1, **valve}
    full = jaxform.run(_sphere(60.0, 400, **given))
    assert int(full.status) == 0 and float(full.energy.balance_error) < 1e-3
    np.testing.assert_allclose(np.linalg.norm(np.asarray(full.positions), axis=1), stretch, rtol=8e-3)
    assert full.pressures is not None
    np.testing.assert_allclose(full.pressures[1][-1], supply, rtol=1e-3)
    empty = jaxform.run(_sphere(160.0, 400, **given))
    np.testing.assert_allclose(np.linalg.norm(np.asarray(empty.positions), axis=1), 1.0, rtol=5e-3)


@pytest.mark.long
def test_gradients_of_a_run_are_those_of_differences() -> None:
    given = {"time": [0.0, 1.0, 4.0, 5.0], "valve": [0.1, 0.8, 0.8, 0.1], "vent": [0.1, 0.1, 0.1, 0.9]}
    scene = _sphere(7.0, 60, supply_pressure=0.03, orifice_area=0.1, vent_area=0.03, dead_volume=0.3, **given)
    names = ("time", "supply_pressure", "valve", "vent", "orifice_area", "vent_area", "discharge_coefficient")
    present = {f"pressure.{name}": getattr(scene.pressure, name) for name in (*names, "heat_capacity_ratio")}
    assert_slopes_are_differences(scene, present, least=1e-8)


_BUBBLE = """
[parison]
shape = "preform"
profile = [[0.0, 0.0], [0.008, 0.002], [0.01, 0.01], [0.01, 0.05]]
elements = 100
symmetry = "quarter"
thickness = 1.0e-3
[material]
model = "mooney-rivlin"
c = 2.0e5
alpha = 0.1
density = 1000.0
[gas]
time = [0.0, 0.02, 0.03]
supply_pressure = [3.0e4, 3.0e4, 6.0e4]
orifice_area = 1.0e-6
valve = [0.2, 0.2, 1.0]
[solver]
end_time = 0.06
damping = 300.0
"""


def test_a_scene_with_a_supply_runs_in_two_stages(tmp_path: Path) -> None:
    file = tmp_path / "bubble.toml"
    file.write_text(_BUBBLE)
    assert main(["simulate", str(file), "--out", str(tmp_path / "out"), "--quiet"]) == 0
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    time, pressure = (np.asarray(summary["pressure"][key]) for key in ("time", "value"))
    assert summary["status"] == "ok" and 6.0e4 >= pressure.max() > 3.5e4
    assert np.interp(0.02, time, pressure) <= 1.2e4


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("orifice_area = 1.0e-6\n", "", r"gas\.orifice_area.*missing"),
        ("supply_pressure = [3.0e4, 3.0e4, 6.0e4]\n", "", r"gas\.mass_flow.*supply"),
        ("[3.0e4, 3.0e4, 6.0e4]", "[3.0e4, 3.0e4]", r"gas\.supply_pressure.*2 values for 3 times"),
        ("valve = [0.2, 0.2, 1.0]", "valve = [0.2, 0.2, 1.5]", r"gas\.valve"),
        ("valve = [0.2, 0.2, 1.0]", "valve = [0.2]", r"gas\.valve.*1 values for 3 times"),
        ("valve = [0.2, 0.2, 1.0]", "vent = [0.0, 0.0, 1.0]", r"gas\.vent_area.*missing"),
        ("6.0e4]", "-6.0e4]", r"gas\.supply_pressure"),
        ("orifice_area = 1.0e-6", "orifice_area = -1.0e-6", r"gas\.orifice_area"),
        ("[solver]", "discharge_coefficient = 2.0\n[solver]", r"gas\.discharge_coefficient"),
        (
            "supply_pressure = [3.0e4, 3.0e4, 6.0e4]\norifice_area = 1.0e-6\nvalve = [0.2, 0.2, 1.0]",
            "mass_flow = [1.0e-5, 0.0, 0.0]\nheat_capacity_ratio = 1.3",
            r"gas\.heat_capacity_ratio.*no effect",
        ),
        ("[0.0, 0.02, 0.03]", "[0.0, 0.02, 0.02]", r"gas\.time"),
        ("[0.0, 0.02, 0.03]", "[-0.1, 0.02, 0.03]", r"gas\.time.*before the simulation"),
    ],
)
def test_bad_supplies_of_files_are_refused(tmp_path: Path, old: str, new: str, words: str) -> None:
    file = tmp_path / "bubble.toml"
    assert old in _BUBBLE
    file.write_text(_BUBBLE.replace(old, new))
    with pytest.raises(jaxform.InputError, match=words):
        jaxform.load(file)


def test_numbers_of_the_gas_are_scaled_by_the_keys_of_the_file(tmp_path: Path) -> None:
    file = tmp_path / "bubble.toml"
    file.write_text(_BUBBLE)
    scene = jaxform.load(file)
    for key, present in (("gas.time", [0.0, 0.02, 0.03]), ("gas.orifice_area", 1.0e-6)):
        variable = Scale(scene, of=key, bounds=(0.5, 2.0))
        free = jnp.asarray(variable.reach)  # the upper bound
        path = key.replace("gas", "pressure")
        np.testing.assert_allclose(variable.changes(free)[path], 2.0 * np.asarray(present))
        np.testing.assert_allclose(variable.document(free)[key], 2.0 * np.asarray(present))
    with pytest.raises(jaxform.InputError, match=r"variable\.of = .gas\.flow.*not a number of the scene"):
        Scale(scene, of="gas.flow", bounds=(0.5, 2.0))


def test_pressure_knots_of_a_gas_are_refused(tmp_path: Path) -> None:
    file, study = tmp_path / "bubble.toml", tmp_path / "study.toml"
    file.write_text(_BUBBLE)
    study.write_text(
        'scene = "bubble.toml"\n[[variable]]\nkind = "pressure"\nbounds = [0.0, 1.0e5]\n'
        '[objective]\nkind = "uniform"\n[solver]\nmethod = "lbfgs"\n'
    )
    assert main(["optimize", str(study), "--out", str(tmp_path / "out"), "--quiet"]) == 2

"""Numbers that are hardly meant: relative Prony moduli, kelvin, kJ, air that heats, molds faster than waves."""

from __future__ import annotations

import json
import re
import warnings
from pathlib import Path

import numpy as np
import pytest

import jaxform
from jaxform.cli.command import main
from tests import scenes

VISCOUS = '[material.viscous]\nkind = "{kind}"\nmodulus = {modulus}\ntime = [0.02, 0.2]\n'
WLF = '[material.shift]\nkind = "wlf"\nreference = {reference}\nc1 = 17.44\nc2 = 51.6\n'
ARRHENIUS = '[material.shift]\nkind = "{kind}"\nreference = {reference}\nactivation_energy = {energy}\n'
COOLING = (
    "[cooling]\nheat_capacity = 2000.0\nair = 20.0\nair_temperature = {air}\nmold = 500.0\nmold_temperature = {mold}\n"
)
PASCALS = VISCOUS.format(kind="maxwell", modulus=[5e4, 2e4])


def _scene(further: str, temperature: float | None = None) -> str:
    text = scenes.FILE.replace("[pressure]", further + "[pressure]")
    given = "" if temperature is None else f"\ntemperature = {temperature}"
    return text.replace("thickness = 1.0e-3", "thickness = 1.0e-3" + given)


def _collect_warnings(folder: Path, text: str) -> list[str]:
    (folder / "scene.toml").write_text(text)
    with warnings.catch_warnings(record=True) as heard:
        warnings.simplefilter("always")
        jaxform.load(folder / "scene.toml")
    return [str(warning.message) for warning in heard]


DOUBTFUL = {
    "relative": (VISCOUS.format(kind="christensen", modulus=[0.4, 0.3]), None, "viscous.modulus = [0.4, 0.3]"),
    "relative melt": (VISCOUS.format(kind="maxwell", modulus=[40.0, 9.0]), None, "modulus is in Pa"),
    "kelvin": (PASCALS + WLF.format(reference=100.0), 393.0, "parison.temperature = 393.0: is 293 K above"),
    "kelvin, warmer": (PASCALS + WLF.format(reference=140.0), 433.15, "give degC: 160"),
    "kelvin of the reference": (
        PASCALS + ARRHENIUS.format(kind="arrhenius", reference=413.0, energy=4e4), 150.0, "give degC: 139.9"),
    "kJ": (PASCALS + ARRHENIUS.format(kind="arrhenius", reference=140.0, energy=40.0), 150.0, "give 40000 if"),
    "kJ of stiffness": (
        ARRHENIUS.format(kind="arrhenius-stiffness", reference=140.0, energy=86.0), 150.0, "is it in J/mol"),
    "hot air": (COOLING.format(air=298.0, mold=60.0), 150.0, "air_temperature = 298.0: is above the sheet"),
    "hot mold": (COOLING.format(air=25.0, mold=333.0), 150.0, "give degC: 59.85"),
    "a hot oven": (COOLING.format(air=180.0, mold=60.0), 150.0, "is above the sheet's temperature of 150 degC; check"),
}  # fmt: skip


@pytest.mark.parametrize("name", DOUBTFUL)
def test_numbers_in_other_units_are_told(tmp_path: Path, name: str) -> None:
    further, temperature, words = DOUBTFUL[name]
    (told,) = _collect_warnings(tmp_path, _scene(further, temperature))
    assert words in told


@pytest.mark.parametrize(
    ("further", "temperature"),
    [
        (PASCALS + WLF.format(reference=100.0), 160.0),
        # PET at 280 degC above its glass transition, polycarbonate, PEEK.
        (PASCALS + ARRHENIUS.format(kind="arrhenius", reference=75.0, energy=6e4), 280.0),
        (PASCALS + WLF.format(reference=150.0), 210.0),
        (PASCALS + ARRHENIUS.format(kind="arrhenius", reference=360.0, energy=6e4), 370.0),
        (VISCOUS.format(kind="maxwell", modulus=[4e3, 1e3]) + COOLING.format(air=25.0, mold=140.0), 150.0),
    ],
)
def test_usual_numbers_are_not(tmp_path: Path, further: str, temperature: float) -> None:
    assert not _collect_warnings(tmp_path, _scene(further, temperature))


GAS = """[[gas]]
time = [0.0]
mass_flow = [{mass_flow}]
supply_pressure = {supply_pressure}
orifice_area = {orifice_area}
temperature = {temperature}
ambient_pressure = {ambient_pressure}
dead_volume = {dead_volume}
[[gas]]
closed_by = "mold"
vent_area = {vent_area}
dead_volume = 4e-4
"""
USUAL = {
    "mass_flow": 0.0,
    "supply_pressure": 8e5,
    "orifice_area": 1e-6,
    "temperature": 293.15,
    "ambient_pressure": 101325.0,
    "dead_volume": 1e-5,
    "vent_area": 1e-5,
}


@pytest.mark.parametrize(
    ("key", "given", "words"),
    [
        ("temperature", 20.0, "gas.clamp.temperature = 20.0: is very small: is it in degC"),
        ("ambient_pressure", 1.013, "is it in bar or kPa"),
        ("supply_pressure", 8.0, "gas.clamp.supply_pressure = 8.0: .* bar or MPa"),
        ("orifice_area", 1.0, "orifice_area = 1.0: is very large: is it in mm"),
        ("vent_area", 2.0, "gas.mold.vent_area = 2.0: .* mm"),
        ("dead_volume", 10.0, "dead_volume = 10.0: .* litres"),
        ("mass_flow", -1.0, "gas.clamp.mass_flow = .*: takes out all of the gas"),
        (None, None, None),
    ],
)
def test_numbers_of_gases_in_other_units_are_told(tmp_path: Path, key: str, given: float, words: str | None) -> None:
    begin, end = (scenes.FILE.index(word) for word in ("[pressure]", "[mold]"))
    numbers = USUAL | ({} if key is None else {key: given})
    told = _collect_warnings(tmp_path, scenes.FILE[:begin] + GAS.format(**numbers) + scenes.FILE[end:])
    # A gas that hardly moves the sheet, or pulls it off the mold, is told as well.
    assert len(told) == (words is not None) + (key in ("dead_volume", "mass_flow"))
    assert words is None or any(re.search(words, line) for line in told), told
    assert key != "dead_volume" or re.search(r"scene.toml: gas: the pressure, up to 0.72 Pa, hardly moves", told[0])


def test_a_tool_with_a_temperature_in_kelvin_is_told(tmp_path: Path) -> None:
    plug = '[[tool]]\nname = "plug"\nshape = "plate"\nradius = 0.02\ntranslate = [0.0, 0.0, -0.01]\ntemperature = {}\n'
    plug += "direction = [0.0, 0.0, 1.0]\ntime = [0.0, 0.05]\ndisplacement = [0.0, 0.02]\n"
    cooling = COOLING.format(air=25.0, mold=60.0)
    told = [
        _collect_warnings(tmp_path, _scene(PASCALS + cooling + plug.format(value), 150.0)) for value in (333.0, 60.0)
    ]
    assert len(told[0]) == 1 and "tool.plug.temperature = 333.0: " in told[0][0] and "give degC: 59.85" in told[0][0]
    assert not told[1]


def test_a_coefficient_of_friction_in_per_cent_is_told(tmp_path: Path) -> None:
    slippery = 'contact = "coulomb"\nfriction = {}\n[solver]'
    percent, usual = (
        _collect_warnings(tmp_path, scenes.FILE.replace("[solver]", slippery.format(value))) for value in (30.0, 0.3)
    )
    assert not usual and len(percent) == 1 and "mold.friction = 30.0: " in percent[0] and "give 0.3" in percent[0]


def test_a_mold_faster_than_waves_is_told(tmp_path: Path) -> None:
    motion = "[mold.motion]\ndirection = [0.0, 0.0, 1.0]\ntime = [0.0, {time}]\ndisplacement = [0.0, 0.03]\n[solver]"
    slow, slip = (
        _collect_warnings(tmp_path, scenes.FILE.replace("[solver]", motion.format(time=time))) for time in (0.01, 1e-4)
    )
    assert not slow and len(slip) == 1 and "moves at 300 m/s, faster than waves in the sheet" in slip[0]


def test_the_summary_has_such_warnings(tmp_path: Path) -> None:
    (tmp_path / "scene.toml").write_text(_scene(DOUBTFUL["relative"][0]).replace("end_time = 0.05", "end_time = 0.001"))
    main(["simulate", str(tmp_path / "scene.toml"), "--out", str(tmp_path / "out"), "--quiet"])
    told = json.loads((tmp_path / "out" / "summary.json").read_text())["warnings"]
    assert any("modulus is in Pa" in sentence for sentence in told)
    assert np.sum(["modulus is in Pa" in sentence for sentence in told]) == 1


SLOW_GAS = "[gas]\ntime = [0.0, 100.0]\nmass_flow = [0.0, 1e-3]\ndead_volume = 1e-4\n"


def test_times_in_milliseconds_and_gravity_in_millimetres_are_told(tmp_path: Path) -> None:
    """A plug alone may move the sheet; a pressure in bar beside it is a slip, none is not."""
    begin, end = scenes.FILE.index("[pressure]"), scenes.FILE.index("[mold]")
    pressure = "[pressure]\ntime = [0.0, {}]\nvalue = [0.0, {}]\n"
    plug = (
        '[[tool]]\nname = "plug"\nshape = "rod"\nradius = 0.02\nlength = 0.05\ntranslate = [0.0, 0.0, -0.001]\n'
        "direction = [0.0, 0.0, 1.0]\ntime = [0.0, 0.05]\ndisplacement = [0.0, 0.03]\n"
    )
    heavy = scenes.FILE.replace("[solver]", "[solver]\ngravity = [0.0, 0.0, -9810.0]")
    for load, further, words in (
        (pressure.format(200.0, 2e4), "", r"pressure\.time = .*: goes on to 200 s, .* milliseconds\?; give s"),
        (SLOW_GAS, "", r"gas\.time = .*: goes on to 100 s, and the run ends at"),
        (pressure.format(0.1, 0.5), plug, r"the pressure, up to 0\.5 Pa, hardly moves the sheet"),
        (pressure.format(0.1, 0.0), plug, ""),
    ):
        told = _collect_warnings(tmp_path, scenes.FILE[:begin] + load + scenes.FILE[end:] + further)
        assert [bool(re.search(words, text)) for text in told] == [True] * bool(words), told
    (told,) = _collect_warnings(tmp_path, heavy)
    assert re.search(r"solver\.gravity = .*: is very large: is it in mm/s\^2", told)

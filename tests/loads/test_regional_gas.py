"""Gases of several cavities: against a scene for each, the border between them, gradients, files, refused input."""

from __future__ import annotations

import dataclasses
import json
import tomllib
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxform
from jaxform import shapes
from jaxform.cli.command import main
from jaxform.dynamics.timestep import element_step_bound
from jaxform.dynamics.window_state import initial_state
from jaxform.extend import number_at
from jaxform.io import files, geometry
from jaxform.io.scene_rewriting import file_key, replacement_path, write_scene
from jaxform.mesh import meshes, topology, volumes
from jaxform.model.scene import enclosed_volumes
from jaxform.sheet.active_set import active_set_of
from jaxform.sheet.discretization import discretize
from jaxform.sweeps import designs
from jaxform.sweeps.designs import set_value
from tests import scenes
from tests.loads.slopes import assert_slopes_are_differences

SIDE = 0.1


def _gas(start: float, flow: float = 8e-3, slower: float = 1.0, **given: Any) -> jaxform.Gas:
    """A gas that is blown in within 40 ms from a start on [s], or slower in all."""
    times = slower * np.array([start, start + 0.02, start + 0.04])
    given = {"dead_volume": 1e-4} | given
    return jaxform.make_gas(times, [0.0, flow / slower, 0.0], **given)


def _two_cavities(left: jaxform.Gas, right: jaxform.Gas, end_time: float = 0.1, **given: Any) -> jaxform.Scene:
    """A sheet over two square cavities, clamped between them."""
    sheet = shapes.rectangle(size=[2 * SIDE, SIDE], element_size=SIDE / 4, lines=([SIDE], []))
    first = sheet.positions[sheet.triangles].mean(1)[:, 0] < SIDE
    sheet = shapes.clamp_borders(sheet, first.astype(int), cut=False)
    load = jaxform.make_regional_load({"left": (left, first), "right": (right, ~first)})
    return _build(sheet, load, end_time, **given)


def _one_cavity(gas: jaxform.Loading, end_time: float = 0.1) -> jaxform.Scene:
    return _build(shapes.rectangle(size=[SIDE, SIDE], element_size=SIDE / 4), gas, end_time)


def _build(sheet: shapes.Sheet, load: jaxform.Loading, end_time: float, **given: Any) -> jaxform.Scene:
    return jaxform.build_scene(
        parison=jaxform.make_parison(sheet.positions, sheet.triangles, 1e-3, sheet.clamped, sheet.fixed),
        material=jaxform.MooneyRivlin(c=2e5, alpha=0.1, density=1000.0),  # pyright: ignore
        pressure=load,
        solver=jaxform.make_solver(end_time=end_time, damping=50.0),
        **given,
    )


def test_two_cavities_are_two_scenes() -> None:
    gases = _gas(0.0), _gas(0.03, 5e-3)
    both = jaxform.run(_two_cavities(*gases))
    assert int(both.status) == 0 and float(both.energy.balance_error) < 5e-3
    assert both.pressures is not None and both.pressures.shape[0] == 3
    assert np.all(np.argmax(both.pressures[1:], axis=1) > 0)
    wall, half = np.asarray(both.element_thickness), both.element_thickness.size // 2
    # With the same steps, also where the one cavity alone would take longer ones.
    ones = [jaxform.simulate(_one_cavity(gas), schedule=both.schedule) for gas in gases]
    for k, one in enumerate(ones):
        assert int(one.status) == 0 and int(one.steps) == int(both.steps)
        np.testing.assert_allclose(wall[k * half :][:half], one.element_thickness, rtol=1e-9)
    works = [float(one.energy.external_work) for one in ones]
    np.testing.assert_allclose(float(both.energy.external_work), sum(works), rtol=1e-9)
    assert min(works) > 0.1 * max(works)
    assert wall[:half].min() < 0.9 * wall[half:].min(), "more gas, thinner wall"


def test_largest_of_the_gases_bounds_the_step() -> None:
    """A cavity beside another, whose gas is as stiff or softer, takes no shorter steps for it."""

    @jax.jit
    def bound(scene: jaxform.Scene) -> jax.Array:
        state, discrete = initial_state(scene), discretize(scene)
        active = active_set_of(state, scene, discrete)
        return element_step_bound(active.pack_state(state), scene, active)

    one, stiff = bound(_one_cavity(_gas(0.0))), bound(_one_cavity(jaxform.make_gas([0.0], [0.0], dead_volume=1e-7)))
    assert stiff < 0.5 * one
    np.testing.assert_allclose(bound(_two_cavities(_gas(0.0), _gas(0.0))), one, rtol=1e-12)
    mixed = _two_cavities(_gas(0.0), jaxform.make_gas([0.0], [0.0], dead_volume=1e-7))
    np.testing.assert_allclose(bound(mixed), stiff, rtol=1e-12)


@pytest.mark.long
@pytest.mark.parametrize("adjoint", [jaxform.Checkpointed(), jaxform.Stored()])
def test_gradients_by_numbers_of_each_gas_are_those_of_differences(adjoint: jaxform.Adjoint) -> None:
    valve = {"supply_pressure": 3e4, "orifice_area": 2e-4, "valve": [0.1, 0.9, 0.3], "adiabatic": True}
    scene = _two_cavities(_gas(0.0), _gas(0.01, 4e-3, **valve), end_time=0.05)
    names = ["left.mass_flow", "left.time", "left.dead_volume", "right.mass_flow", "right.time", "right.dead_volume"]
    paths = [f"pressure.{name}" for name in (*names, "right.valve", "right.supply_pressure")]
    assert_slopes_are_differences(scene, {path: number_at(scene, path) for path in paths}, least=1e-9, adjoint=adjoint)


@pytest.mark.parametrize("slower", [pytest.param(4.0, marks=pytest.mark.long), 1.0])
def test_pinned_border_may_refine(slower: float) -> None:
    """New nodes on the border of two regions are held as its own, and new elements belong to their parents' region.

    In a fast blow the new nodes are set in motion with modes that the first step hardly resolves.
    """
    refinement = jaxform.make_refinement(angle=4.0, interval=50, max_level=2, elements=400)
    gases = _gas(0.0, slower=slower), _gas(0.03, 5e-3, slower=slower)
    scene = _two_cavities(*gases, end_time=0.1 * slower, refinement=refinement)
    forest = scene.tables.forest
    assert forest is not None and forest.sheet.regions is not None
    places = np.asarray(scene.parison.positions)
    on_border = np.abs(places[:, 0] - SIDE) < 1e-9
    assert on_border.sum() > 5 and not np.asarray(forest.mobility)[:, on_border].any()
    middles = places[np.asarray(forest.sheet.triangles).T].mean(1)
    np.testing.assert_array_equal(np.asarray(forest.sheet.regions)[0], middles[:, 0] < SIDE)
    result = jaxform.run(scene)
    assert int(result.status) == 0 and float(result.energy.balance_error) < 5e-3
    assert int(np.asarray(result.used).sum()) > len(scene.parison.triangles), "it was refined"
    held = on_border & np.asarray(result.active)
    np.testing.assert_array_equal(np.asarray(result.positions)[held], places[held])


@pytest.mark.long
def test_one_disc_of_two_passes_the_limit_point() -> None:
    """Two neo-Hookean discs, p_atm a / (c h0) = 50, over dead volumes of a^3: one gas grows more than the other."""
    disc = shapes.disc(radius=1.0, elements=150)

    def gas(growth: float) -> jaxform.Gas:
        flow = growth * 0.5 / 300.0
        return jaxform.make_gas([0.0], flow, temperature=1.0, gas_constant=1.0, ambient_pressure=0.5, dead_volume=1.0)

    def scene(positions: np.ndarray, count: int, load: jaxform.Loading) -> jaxform.Scene:
        triangles = np.concatenate([disc.triangles + k * len(disc.positions) for k in range(count)])
        return jaxform.build_scene(
            parison=jaxform.make_parison(positions, triangles, 0.01, np.tile(disc.clamped, count)),
            material=scenes.mooney(0.0),
            pressure=load,
            solver=jaxform.make_solver(end_time=300.0, damping=1.0),
        )

    gases, first = (gas(9.0), gas(1.5)), np.arange(2 * len(disc.triangles)) < len(disc.triangles)
    away = np.array([1.5, 0.0, 0.0])
    places = np.concatenate([disc.positions - away, disc.positions + away])
    load = jaxform.make_regional_load({"left": (gases[0], first), "right": (gases[1], ~first)})
    both = jaxform.run(scene(places, 2, load))
    assert int(both.status) == 0 and float(both.energy.balance_error) < 5e-3 and both.pressures is not None
    pressures = both.pressures[1:]
    for own, pressure in zip(gases, pressures, strict=True):
        one = jaxform.run(scene(disc.positions, 1, own))
        assert one.pressures is not None
        np.testing.assert_allclose(pressure.max(), one.pressures[1].max(), rtol=1e-3)
        np.testing.assert_allclose(pressure[-1], one.pressures[1][-1], rtol=1e-3)
    past, before = pressures
    assert past[-1] < 0.97 * past.max() and np.argmax(past) < 0.8 * len(past), "past the limit point"
    assert before[-1] == before.max() and before[-1] < past.max(), "before the limit point"


# Scene files.

_FILE = """
[parison]
{parison}
thickness = 1.0e-3
[material]
model = "neo-hookean"
c = 2.0e5
density = 1000.0
{more}
[[gas]]
name = "left"
region = {left}
time = [0.0, 0.02, 0.04]
mass_flow = [0.0, 8.0e-3, 0.0]
dead_volume = 1.0e-4
[[gas]]
{name}
region = {right}
time = [0.03, 0.05, 0.07]
mass_flow = [0.0, 5.0e-3, 0.0]
dead_volume = 1.0e-4
[solver]
end_time = 0.1
damping = 50.0
"""
_RECTANGLE = 'shape = "rectangle"\nsize = [0.2, 0.1]\nelement_size = 0.025'
_LEFT, _RIGHT = '{ along = "x", between = [0.0, 0.1] }', '{ along = "x", between = [0.1, 0.2] }'


def _write(path: Path, **changes: str) -> Path:
    given = {"parison": _RECTANGLE, "left": _LEFT, "right": _RIGHT, "name": 'name = "right"', "more": ""} | changes
    path.write_text(_FILE.format(**given))
    return path


@pytest.mark.long
def test_scene_file_has_a_curve_for_each_gas(tmp_path: Path) -> None:
    path = _write(tmp_path / "two.toml", name="")
    assert main(["simulate", str(path), "--out", str(tmp_path / "out"), "--quiet"]) == 0
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert summary["status"] == "ok" and "pressure" not in summary and list(summary["gases"]) == ["left", "gas2"]
    peak = {name: max(gas["pressure"]["value"]) for name, gas in summary["gases"].items()}
    assert peak["left"] > 1e3 and peak["gas2"] > 1e3
    head, *rows = (tmp_path / "out" / "process.csv").read_text().splitlines()
    assert head == "time,pressure_left,pressure_gas2"
    first = [float(cell) for cell in rows[0].split(",")]
    assert first[1] > 0.3 * peak["left"] and abs(first[2]) < 0.05 * peak["gas2"], "the second begins later"
    assert (tmp_path / "out" / "process.png").stat().st_size > 1000


@pytest.mark.quick
@pytest.mark.parametrize("parison", [
    _RECTANGLE,
    'shape = "rectangle"\nsize = [0.4, 0.1]\nelement_size = 0.025\nsymmetry = "half"',
    'shape = "outline"\npolygon = [[0.0, 0.0], [0.2, 0.0], [0.2, 0.08], [0.11, 0.1], [0.0, 0.1]]\nelement_size = 0.012',
    'shape = "disc"\nradius = 0.15\nelement_size = 0.013',
])  # fmt: skip
def test_borders_are_edges_and_clamped(parison: str, tmp_path: Path) -> None:
    left = '{ along = "x", between = [-0.2, 0.093] }'
    right = '{ along = "x", between = [0.093, 0.2] }'
    document = files.read_scene(_write(tmp_path / "two.toml", parison=parison, left=left, right=right))
    sheet = geometry.build_sheet(document)
    x = sheet.positions[:, 0]
    corners = x[sheet.triangles] - 0.093
    assert not np.any((corners.min(1) < -1e-9) & (corners.max(1) > 1e-9)), "no element lies on both sides"
    on_border = np.abs(x - 0.093) < 1e-9
    assert on_border.sum() > 3 and sheet.clamped[on_border].all()
    assert not sheet.clamped[sheet.triangles].all(1).any(), "every element can move"
    rim = topology.boundary_nodes(sheet.triangles)
    assert not np.any(sheet.clamped & ~on_border & ~np.isin(np.arange(len(x)), rim)), "nothing else is clamped"
    masks = geometry.gas_regions(document, sheet)
    np.testing.assert_array_equal(masks["left"], ~masks["right"])
    sides = sheet.positions[sheet.triangles] - np.roll(sheet.positions[sheet.triangles], 1, axis=1)
    longest = np.linalg.norm(sides, axis=2).max(1)
    assert (2.0 * volumes.areas(sheet.positions, sheet.triangles) / longest).min() > 0.08 * np.median(longest)


def test_regions_of_a_mesh_file_are_marked_by_a_field(tmp_path: Path) -> None:
    sheet = shapes.rectangle(size=[2 * SIDE, SIDE], element_size=SIDE / 4)
    first = sheet.positions[sheet.triangles].mean(1)[:, 0] < SIDE
    cells = {"cavity": np.where(first, 1.0, 2.0)}
    meshes.write_vtu(tmp_path / "sheet.vtu", sheet.positions, sheet.triangles, {}, cells)
    given = {"parison": 'shape = "file"\npath = "sheet.vtu"', "left": '"field:cavity=1"', "right": '"field:cavity=2"'}
    scene = files.load(_write(tmp_path / "two.toml", **given))
    np.testing.assert_array_equal(np.asarray(scene.pressure.regions)[0], first)
    held = np.asarray(scene.parison.clamped) & (np.abs(sheet.positions[:, 0] - SIDE) < 1e-9)
    assert held.sum() == 5
    # Conditions along a coordinate are possible, too; the mesh keeps its edges, and a border beside them is warned of.
    given |= {"left": '{ along = "x", between = [0.0, 0.09] }', "right": '{ along = "x", between = [0.09, 0.2] }'}
    with pytest.warns(jaxform.InputWarning, match="borders without edges of the mesh"):
        files.load(_write(tmp_path / "beside.toml", **given))


_OVER = '{ along = "x", between = [0.05, 0.2] }'


@pytest.mark.quick
@pytest.mark.parametrize(("changes", "words"), [
    ({"right": _OVER}, r"gas\.left\.region: has \d+ elements in common with that of right"),
    ({"right": '{ along = "x", between = [0.3, 0.4] }'}, r"gas\.right\.region = .*: holds the centroid of no .* 0.2 m"),
    ({"right": '{ along = "x", between = [0.2, 0.1] }'}, r"gas\.right\.region\.between = .*: does not increase"),
    ({"right": '{ along = "angle", between = [0.1, 0.2] }'}, r"gas\.right\.region\.along = .*: is unknown"),
    ({"right": '"field:cavity"'}, r"gas\.right\.region = .*: is possible for a mesh file alone"),
    ({"right": '"cavity"'}, r"gas\.right\.region = .*: is not a region"),
    ({"name": 'name = "left"'}, r"gas\[1\]\.name = .*: is the name of another gas"),
    ({"name": 'name = "mass_flow"'}, r"gas\[1\]\.name = .*: cannot be the name of a gas"),
    ({"parison": 'shape = "tube"\nradius = 0.02\nlength = 0.2\nelement_size = 0.01'}, "is not possible for a tube"),
    ({"parison": _RECTANGLE + "\nadapt = {}"}, r"parison\.adapt = .*: does not keep the borders"),
    ({"more": "[pressure]\ntime = [0.0]\nvalue = [1.0]"}, "given together with .pressure., on the same side"),
])  # fmt: skip
def test_regions_that_are_not_possible_are_refused(changes: dict[str, str], words: str, tmp_path: Path) -> None:
    with pytest.raises(jaxform.InputError, match=words):
        files.load(_write(tmp_path / "two.toml", **changes))


@pytest.mark.quick
def test_border_that_nothing_holds_is_refused() -> None:
    sheet = shapes.rectangle(size=[2 * SIDE, SIDE], element_size=SIDE / 4)
    first = sheet.positions[sheet.triangles].mean(1)[:, 0] < SIDE
    load = jaxform.make_regional_load({"left": (_gas(0.0), first), "right": (_gas(0.0), ~first)})
    with pytest.raises(jaxform.InputError, match=r"gas\.left\.region: has a border that can move, at .*0\.1"):
        _build(sheet, load, 0.1)


@pytest.mark.quick
def test_tables_of_gases_are_found_by_name(tmp_path: Path) -> None:
    document = files.read_scene(_write(tmp_path / "two.toml"))
    changes = {"gas.right.dead_volume": 3e-4, "gas.left.mass_flow": [0.0, 1e-3, 0.0]}
    tables = tomllib.loads(write_scene(document, changes, tmp_path).read_text())["gas"]
    assert [table["dead_volume"] for table in tables] == [1e-4, 3e-4]
    assert tables[0]["mass_flow"] == [0.0, 1e-3, 0.0] and tables[0]["region"]["between"] == [0.0, 0.1]
    data = {"gas": [{"name": "left"}, {"closed_by": "mold"}]}
    set_value(data, "gas.left.vent_area", 1.0)
    set_value(data, "gas.gas2.vent_area", 2.0)
    set_value(data, "gas.mold.dead_volume", 3.0)
    assert data["gas"][0] == {"name": "left", "vent_area": 1.0}
    assert data["gas"][1] == {"closed_by": "mold", "vent_area": 2.0, "dead_volume": 3.0}
    with pytest.raises(jaxform.InputError, match="its gases are left, gas2"):
        set_value(data, "gas.right.vent_area", 1.0)


@pytest.mark.quick
@pytest.mark.parametrize(("column", "words"), [
    ("gas.middle.dead_volume", r"table\.csv: gas\.middle\.dead_volume: is not a gas of the scene; .* are left, gas2"),
    ("gas[2].dead_volume", r"table\.csv: gas\[2\]\.dead_volume: is not there: the scene's list has 2 elements"),
])  # fmt: skip
def test_sweep_of_a_gas_that_is_none_is_refused_as_a_whole(column: str, words: str, tmp_path: Path) -> None:
    scene, table = _write(tmp_path / "two.toml", name=""), tmp_path / "table.csv"
    table.write_text("gas.gas2.dead_volume,gas.left.mass_flow[1]\n2e-4,6e-3\n3e-4,7e-3\n")
    documents = [design.document for design in designs.make_designs(designs.read_table(table), scene)]
    assert [one.model.gases[1].dead_volume for one in documents if one] == [2e-4, 3e-4]
    model = files.read_scene(scene).model
    units = [designs.unit_of(model, f"gas.{key}") for key in ("gas2.dead_volume", "left.mass_flow[1]")]
    assert units == ["m^3", "kg/s"]
    table.write_text(f"{column}\n2e-4\n3e-4\n")
    with pytest.raises(jaxform.InputError, match=words):
        designs.make_designs(designs.read_table(table), scene)


@pytest.mark.quick
@pytest.mark.parametrize("symmetry", ["none", "half"])
def test_volume_under_a_region_is_above_its_border(symmetry: Any) -> None:
    """The gas of a flat region fills no volume but the dead one, wherever the sheet is, and that under a raised one."""
    sheet = shapes.rectangle(size=[4 * SIDE, SIDE], element_size=SIDE / 4, symmetry=symmetry, lines=([SIDE], []))
    first = sheet.positions[sheet.triangles].mean(1)[:, 0] < SIDE
    sheet = shapes.clamp_borders(sheet, first.astype(int), cut=False)
    held = sheet.clamped | sheet.fixed.any(1)
    raised = np.where(held, 0.0, 0.01 * (sheet.positions[:, 0] > SIDE))
    places = sheet.positions + [0.0, 0.3, 0.7] + raised[:, None] * [0.0, 0.0, 1.0]
    load = jaxform.make_regional_load({"left": (_gas(0.0), first), "right": (_gas(0.0), ~first)})
    scene = _build(dataclasses.replace(sheet, positions=places), load, 0.1)
    left, right = scene.pressure.own_volumes(enclosed_volumes(scene.pressure, scene.parison))
    corners = places[sheet.triangles][~first]
    under = np.abs(np.linalg.det(np.where([True, True, False], corners, 1.0))) / 2.0 * (corners[..., 2] - 0.7).mean(1)
    np.testing.assert_allclose([left, right], [0.0, under.sum()], atol=1e-12)
    assert right > 1e-5


@pytest.mark.long
def test_air_is_trapped_in_each_cavity_under_one_pressure() -> None:
    """A pressure on the whole sheet and a gas closed by the mold in each cavity are two scenes with both."""
    pressure = jaxform.make_pressure([0.0, 0.02], [0.0, 3e4])
    airs = [jaxform.make_gas([0.0], closed_by="mold", dead_volume=size, vent_area=1e-5) for size in (1e-3, 4e-4)]
    sheet = shapes.rectangle(size=[2 * SIDE, SIDE], element_size=SIDE / 4, lines=([SIDE], []))
    first = sheet.positions[sheet.triangles].mean(1)[:, 0] < SIDE
    sheet = shapes.clamp_borders(sheet, first.astype(int), cut=False)
    whole = {"inside": (pressure, np.ones(len(first), bool)), "left": (airs[0], first), "right": (airs[1], ~first)}
    both = jaxform.run(_build(sheet, jaxform.make_regional_load(whole), 0.04))
    assert int(both.status) == 0 and float(both.energy.balance_error) < 5e-3
    assert both.pressures is not None and both.pressures[1].max() == 3e4 and both.pressures[2:].max() <= 0.0
    wall, half, works = np.asarray(both.element_thickness), first.size // 2, []
    for k, air in enumerate(airs):
        one = jaxform.simulate(_one_cavity(jaxform.make_two_sided_load(pressure, air), 0.04), schedule=both.schedule)
        works.append(float(one.energy.external_work))
        np.testing.assert_allclose(wall[k * half :][:half], one.element_thickness, rtol=1e-9)
    np.testing.assert_allclose(float(both.energy.external_work), sum(works), rtol=1e-9)
    assert wall[:half].min() < 0.99 * wall[half:].min(), "more room, thinner wall"


@pytest.mark.quick
def test_numbers_of_a_gas_have_its_name() -> None:
    scene = _two_cavities(_gas(0.0), _gas(0.03))
    assert replacement_path("gas.right.dead_volume") == "pressure.right.dead_volume"
    assert file_key("pressure.right.dead_volume") == "gas.right.dead_volume"
    new = jaxform.replace(scene, {"pressure.right.dead_volume": 3e-4})
    assert [float(load.dead_volume) for load in new.pressure.loads] == [1e-4, 3e-4]
    with pytest.raises(jaxform.InputError, match=r"pressure\.middle\.dead_volume"):
        jaxform.replace(scene, {"pressure.middle.dead_volume": 3e-4})
    with pytest.raises(jaxform.InputError, match="must not be negative"):
        jaxform.replace(scene, {"pressure.left.dead_volume": -1.0})


@pytest.mark.long
def test_batch_varies_a_number_of_one_gas() -> None:
    scene = _two_cavities(_gas(0.0), _gas(0.03, 5e-3), end_time=0.03)
    dead = jnp.asarray([1e-4, 3e-4])
    batch = jaxform.simulate_batch(scene, {"pressure.left.dead_volume": dead})
    assert not np.any(batch.status)
    for k, volume in enumerate(dead):
        one = jaxform.run(jaxform.replace(scene, {"pressure.left.dead_volume": volume}))
        np.testing.assert_allclose(batch.thickness[k], one.thickness, rtol=1e-6)
    assert float(jnp.ptp(batch.thickness.min(axis=1))) > 1e-6

"""A clamp that opens: exact motions of what it lets go, gradients, refined meshes, and input that is refused."""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxform
from jaxform import molds, shapes
from tests import scenes


def _disc(stretch: float, elements: int = 40) -> jaxform.Parison:
    sheet = shapes.disc(radius=0.05, elements=elements, symmetry="quarter")
    return jaxform.make_parison(
        sheet.positions, sheet.triangles, 1e-3, sheet.clamped, sheet.fixed, pre_stretch=[stretch] * 2, clamp_until=0.02
    )


def _scene(parison: jaxform.Parison, damping: float | None, end: float, **parts: Any) -> jaxform.Scene:
    given = {
        "pressure": jaxform.make_pressure([0.0], [0.0]),
        "material": jaxform.NeoHookean(*map(jnp.asarray, (2e5, 1000.0))),
    }
    return jaxform.build_scene(
        parison=parison, solver=jaxform.make_solver(end_time=end, damping=damping), **(given | parts)
    )


def test_a_pre_stretched_sheet_that_is_let_go_has_its_unstretched_size_again() -> None:
    scene = _scene(_disc(1.2), 1000.0, 0.06)
    result = jaxform.run(scene)
    stretched, energy = np.asarray(scene.parison.positions), result.energy
    np.testing.assert_allclose(np.asarray(result.positions)[:, :2], stretched[:, :2] / 1.2, atol=1e-9)
    np.testing.assert_allclose(result.thickness, 1e-3, rtol=1e-6)
    assert int(result.status) == 0 and not np.asarray(result.stuck).any()
    assert (np.asarray(result.contact_time) == -1.0).all()
    # All of the strain energy went into damping. What lets go at once excites modes that a step hardly resolves.
    np.testing.assert_allclose(energy.damping_loss, energy.pre_stretch_work, rtol=0.01)
    formed = jaxform.parison_of(result, scene)
    assert not np.asarray(formed.clamped).any()


@pytest.mark.parametrize(
    ("stretch", "damping"), scenes.short_first([(1.02, None), (1.02, 30.0), (1.2, 300.0), (1.2, None)])
)
def test_the_energy_that_is_set_free_at_once_is_accounted_for(stretch: float, damping: float | None) -> None:
    result = jaxform.run(_scene(_disc(stretch), damping, 0.06))
    assert int(result.status) == 0
    assert float(result.energy.balance_error) < (1e-3 if damping is None else 5e-3)


def _bar(count: int, stretch: float, until: float) -> jaxform.Parison:
    """A strip along x from 0 to 1 m whose nodes move along x alone; fixed at x = 0, and clamped at x = 1."""
    across, along = np.meshgrid([0.0, 1.0 / count], np.linspace(0.0, 1.0, count + 1), indexing="ij")
    positions = np.stack([along.ravel(), across.ravel(), 0.0 * along.ravel()], axis=1)
    first, above = np.arange(count), count + 1 + np.arange(count)
    triangles = np.concatenate([np.stack([first, first + 1, above], 1), np.stack([first + 1, above + 1, above], 1)])
    fixed = np.ones((len(positions), 3), bool)
    fixed[positions[:, 0] > 0.0, 0] = False
    clamped = positions[:, 0] == 1.0
    return jaxform.make_parison(
        positions, triangles, 1e-3, clamped, fixed, pre_stretch=[stretch, 1.0], clamp_until=until
    )


@pytest.mark.long
def test_a_strip_that_is_let_go_oscillates_as_a_bar() -> None:
    # Across it nothing moves: the tangent of c (x^2 + 1 / x^2 - 2) at x = 1 is 8 c.
    speed, until, strain = np.sqrt(8.0 * 2e5 / 1000.0), 0.01, 1e-4
    parison, period = _bar(40, 1.0 + strain, until), 4.0 / speed
    scene = _scene(parison, None, until + 2.125 * period)
    result = jaxform.run(scene)
    rest = np.asarray(parison.positions)[:, 0] / (1.0 + strain)
    moved = np.asarray(result.positions)[:, 0] - rest
    # In the uniform strain the lowest mode sin(pi x / 2) has the amplitude 8 / pi^2 of the end.
    along = np.argsort(rest[:41])
    amplitude = 2.0 * np.trapezoid((moved[:41] * np.sin(0.5 * np.pi * rest[:41]))[along], rest[:41][along])
    expected = 8.0 / np.pi**2 * strain * np.cos(2.0 * np.pi * 2.125)
    np.testing.assert_allclose(amplitude, expected, rtol=5e-3)
    assert int(result.status) == 0 and float(result.energy.balance_error) < 2e-3
    # Until the clamp opens nothing moves; what the symmetry fixes is not freed.
    assert np.asarray(result.stuck).sum() == 2


def _drape_scene(parison: jaxform.Parison) -> jaxform.Scene:
    """A pre-stretched sheet that is blown against a plate, and let go while the pressure is highest."""
    plate = molds.revolved(profile=[[0.0, 0.012], [0.07, 0.012]], segments=24)
    pressure = jaxform.make_pressure([0.0, 0.02, 0.03], [0.0, 2e4, 0.0])
    mold = jaxform.make_mold(plate.vertices, plate.triangles)
    return _scene(parison, 300.0, 0.03, pressure=pressure, mold=mold, fill=False)


@pytest.mark.long
def test_a_sheet_let_go_over_a_mold_has_exact_gradients() -> None:
    scene = _drape_scene(_disc(1.05))
    result = jaxform.run(scene)
    landed, rim = np.asarray(result.contact_time), np.asarray(scene.parison.clamped)
    assert int(result.status) == 0 and float(result.energy.balance_error) < 5e-3
    # The rim is free, and lands after the clamp is open: the run does not end early before that.
    assert (landed[rim] > 0.02).all() and (landed < 0.02).any()
    np.testing.assert_array_equal(jaxform.simulate(scene).positions, result.positions)
    thickness, schedule = np.asarray(scene.parison.thickness), result.schedule
    batch = jaxform.simulate_batch(scene, {"parison.thickness": [thickness, 1.1 * thickness]})
    np.testing.assert_array_equal(np.asarray(batch.positions)[0], result.positions)
    weight = np.random.default_rng(0).standard_normal(result.positions.shape)

    @jax.jit
    @jax.value_and_grad
    def measure(values: jax.Array) -> jax.Array:
        end = jaxform.simulate(jaxform.replace(scene, {"parison.thickness": values}), schedule=schedule)
        losses = end.energy.damping_loss + end.energy.contact_loss
        return jnp.sum(weight * end.positions) + 1e2 * jnp.sum(weight[:, 0] * end.thickness) + losses

    _, slope = measure(thickness)
    step = 1e-5 * thickness * np.random.default_rng(1).standard_normal(thickness.shape)
    difference = 0.5 * (float(measure(thickness + step)[0]) - float(measure(thickness - step)[0]))
    np.testing.assert_allclose(difference, float(slope @ step), rtol=1e-5)


@pytest.mark.long
def test_a_mesh_that_is_refined_is_let_go_as_a_whole() -> None:
    limits = jaxform.make_refinement(angle=1.0, interval=1, max_level=2, base_level=0, elements=400)
    parts = {"pressure": jaxform.make_pressure([0.0, 0.02, 0.021], [0.0, 2e4, 0.0]), "refinement": limits}
    scene = _scene(_disc(1.05, 16), 300.0, 0.1, **parts)
    result = jaxform.run(scene)
    used, thickness = np.asarray(result.active), np.asarray(result.thickness)
    clamped = np.asarray(scene.parison.clamped) & used
    # Nodes that came to be on the clamped rim are let go, too.
    assert clamped[scene.first_nodes :].any() and not np.asarray(result.stuck)[used].any()
    np.testing.assert_allclose(thickness[used], 1e-3, rtol=1e-3)
    np.testing.assert_allclose(result.mass, float(jaxform.simulate(scene).mass), rtol=1e-13)


_FILE = """
[parison]
shape = "disc"
radius = 0.05
elements = 40
symmetry = "quarter"
thickness = 1.0e-3
pre_stretch = [1.05, 1.05]
clamp_until = 0.02
[material]
model = "neo-hookean"
c = 2.0e5
density = 1000.0
[solver]
end_time = 0.03
damping = 300.0
"""
_GAS = "[gas]\ntime = [0.0, 0.1]\nmass_flow = [0.0, 1e-5]\ndead_volume = 1e-5\n[solver]"


def test_a_scene_file_opens_the_clamp(tmp_path: Path) -> None:
    file = tmp_path / "frame.toml"
    # Without a pressure the pre-stretch alone moves the sheet.
    file.write_text(_FILE)
    assert float(np.asarray(jaxform.load(file).parison.clamp_until)) == 0.02
    file.write_text(_FILE.replace("clamp_until = 0.02", "clamp_until = 0.03"))
    with pytest.warns(jaxform.InputWarning, match="the clamp does not open before the end at 0.03 s"):
        jaxform.load(file)


_CUP = 'shape = "revolved"\nprofile = [[0.0, 0.02], [0.03, 0.02], [0.05, 0.0]]\nsegments = 12\nfill = false'
_MOLD = f"[mold]\n{_CUP}\n[solver]"


@pytest.mark.parametrize(
    ("values", "mold", "words"),
    [
        ("[0.0, 1e4, 1e4]", False, "nothing holds the sheet"),
        ("[0.0, 1e4, 2e4]", True, "still rises after the clamp has opened"),
        ("[0.0, 1e4, 1e4]", True, ""),
        ("[0.0, 1e4, 0.0]", False, ""),
        ("[0.0, 0.0, 0.0]", False, ""),
    ],
)
def test_a_pressure_that_blows_away_a_sheet_that_was_let_go_is_warned_of(
    tmp_path: Path, values: str, mold: bool, words: str
) -> None:
    pressure = f"[pressure]\ntime = [0.0, 0.02, 0.03]\nvalue = {values}\n[solver]"
    text = _FILE.replace("[solver]", pressure)
    (tmp_path / "frame.toml").write_text(text.replace("[solver]", _MOLD) if mold else text)
    with warnings.catch_warnings(record=True) as found:
        warnings.simplefilter("always")
        jaxform.load(tmp_path / "frame.toml")
    told = [str(one.message) for one in found if "parison.clamp_until" in str(one.message)]
    assert (len(told) == 1 and words in told[0]) if words else not told


def test_landing_smoothly_on_nothing_is_warned_of(tmp_path: Path) -> None:
    (tmp_path / "frame.toml").write_text(_FILE.replace("[solver]", "[solver]\nsmooth_landing = true"))
    with pytest.warns(jaxform.InputWarning, match="smooth_landing = True: has no effect"):
        jaxform.load(tmp_path / "frame.toml")


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("clamp_until = 0.02", "clamp_until = 0.0", "parison.clamp_until = 0.0"),
        ("clamp_until = 0.02", "", "nothing else moves the sheet"),
        ("[solver]", _GAS, "parison.clamp_until.*lets out the gas"),
        ('shape = "disc"', 'shape = "sphere"', "parison"),
    ],
)
def test_a_clamp_that_cannot_open_is_refused(tmp_path: Path, old: str, new: str, words: str) -> None:
    file = tmp_path / "frame.toml"
    file.write_text(_FILE.replace(old, new))
    with pytest.raises(jaxform.InputError, match=words):
        jaxform.load(file)


def test_a_closed_sheet_has_no_clamp_to_open() -> None:
    sheet = shapes.sphere(radius=1.0, elements=60)
    with pytest.raises(jaxform.InputError, match="no node is clamped"):
        jaxform.make_parison(sheet.positions, sheet.triangles, 0.01, sheet.clamped, clamp_until=1.0)

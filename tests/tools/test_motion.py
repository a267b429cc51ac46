"""A mold that moves: what sticks to it goes with it, and its work is in the account."""

from __future__ import annotations

import dataclasses
import re
from pathlib import Path
from xml.etree import ElementTree

import jax
import jax.numpy as jnp
import meshio
import numpy as np
import pytest
from scipy import optimize

import jaxform
from jaxform.core.errors import InputError
from jaxform.io import output
from jaxform.io.output import Frames
from jaxform.io.report import stored_results
from jaxform.prepare import planning
from jaxform.results.result import Result, drop_unused
from jaxform.runs.arrays import extend_knots
from tests import scenes

RADIUS, THICKNESS, RISE = 0.1, 1e-3, 0.05
FILE = """
[parison]
shape = "disc"
radius = 0.1
element_size = 0.008
symmetry = "quarter"
thickness = 1.0e-3
[material]
model = "mooney-rivlin"
c = 2.0e5
alpha = 0.1
density = 1000.0
[pressure]
time = [0.0]
value = [0.0]
[mold]
shape = "revolved"
profile = [[0.0, -0.002], [0.042, -0.002], [0.047, -0.06]]
segments = 96
[mold.motion]
direction = [0.0, 0.0, 2.0]
time = [0.0, 0.2]
displacement = [0.0, 0.052]
[solver]
end_time = 0.25
damping = 100.0
"""


def plug(folder: Path, further: str = "", **changed: str) -> jaxform.Scene:
    """A quarter of a clamped disc over a flat plug that stands 2 mm below it."""
    text = FILE + further
    for name, value in changed.items():
        text = re.sub(rf"^{name} = .*", f"{name} = {value}", text, flags=re.MULTILINE)
    path = folder / "plug.toml"
    path.write_text(text)
    return jaxform.load(path)


@pytest.fixture(scope="module")
def plug_result(tmp_path_factory: pytest.TempPathFactory) -> tuple[jaxform.Scene, Result]:
    scene = plug(tmp_path_factory.mktemp("plug"))
    return scene, jaxform.run(scene)


def test_a_motion_is_smooth_and_never_beyond_its_knots() -> None:
    motion = jaxform.make_motion([0.0, 3.0, 0.0], [0.0, 1.0, 2.0, 3.0], [0.0, 2.0, 2.0, -1.0])
    times = jnp.linspace(-0.5, 3.5, 801)
    way = jax.vmap(motion.offset)(times)[:, 1]
    speed = jax.vmap(jax.jacfwd(motion.offset))(times)[:, 1]
    assert float(way.max()) <= 2.0 and float(way.min()) >= -1.0
    np.testing.assert_allclose(jax.vmap(motion.offset)(jnp.arange(4.0))[:, 1], [0.0, 2.0, 2.0, -1.0], atol=1e-12)
    assert float(jnp.abs(jnp.diff(speed)).max()) < 0.1 and float(jnp.abs(speed).max()) < float(motion.highest_speed())
    np.testing.assert_allclose(speed[jnp.array([0, 100, 300, 500, 700, 800])], 0.0, atol=1e-9)
    fine = jax.vmap(jaxform.make_motion([0, 1, 0], [0.0, 1.0, 3.0], [0.0, 1.0, 3.0]).offset)(times)[:, 1]
    assert float(jnp.diff(fine).min()) >= 0.0


def test_how_fast_a_mold_is_from_a_time_on() -> None:
    """Three times the mean speed to the next knot, up to where it becomes faster; nothing where it rests."""
    motion = jaxform.make_motion([0.0, 0.0, 1.0], [0.0, 1.0, 2.0, 4.0, 5.0], [0.0, 0.0, 3.0, 4.0, 4.0])
    bounds = {0.5: (0.0, 1.0), 1.0 - 1e-15: (9.0, np.inf), 1.5: (9.0, np.inf), 2.0: (1.5, np.inf), 4.5: (0.0, np.inf)}
    for time, expected in (bounds | {9.0: (0.0, np.inf)}).items():
        assert tuple(map(float, motion.speed_from(jnp.asarray(time)))) == expected


@pytest.mark.long
@pytest.mark.parametrize(
    ("time", "displacement", "most"),
    scenes.short_first([("[0.0, 0.02]", "[0.0, 0.052]", 1.6), ("[0.0, 0.2, 0.205]", "[0.0, 0.0, 0.052]", 2.2)]),
    ids=["rests at the end", "waits first"],
)
def test_a_plug_shortens_the_steps_while_it_moves_alone(
    tmp_path: Path, time: str, displacement: str, most: float
) -> None:
    """It did from begin to end. What it does is the same."""
    scene = plug(tmp_path, time=time, displacement=displacement, value=str([0.0] * (time.count(",") + 1)))
    result = jaxform.run(scene)
    assert int(result.status) == 0 and float(result.energy.balance_error) < 0.01
    assert np.any(np.asarray(result.wall) != 0)
    assert scene.mold is not None
    held = np.asarray(result.wall) != 0
    np.testing.assert_allclose(np.asarray(result.positions)[held, 2].max(), RISE, atol=1e-9)
    step, end = 1.6 * planning.first_step(scene), float(scene.solver.end_time)
    moving = planning.tool_steps(scene.motion, scene.tables.grid, end, step)
    # As `jaxform check` has it.
    assert int(result.steps) < most * (end / step + moving)


def _annulus(inner: float) -> np.ndarray:
    """Places and h/h0 along an annulus whose inner rim is lifted: the least energy of straight elements."""
    reference = np.linspace(inner, RADIUS, 201)
    middle, length = 0.5 * (reference[1:] + reference[:-1]), np.diff(reference)

    def stretches(inside: jax.Array) -> tuple[jax.Array, jax.Array]:
        r = jnp.concatenate([reference[:1], inside[0], reference[-1:]])
        z = jnp.concatenate([jnp.full(1, RISE), inside[1], jnp.zeros(1)])
        along = jnp.sqrt(jnp.diff(r) ** 2 + jnp.diff(z) ** 2) / length
        return along, 0.5 * (r[1:] + r[:-1]) / middle

    def energy(flat: jax.Array) -> jax.Array:
        squares = [jnp.square(each) for each in stretches(flat.reshape(2, -1))]
        third = 1.0 / (squares[0] * squares[1])
        i1 = squares[0] + squares[1] + third
        i2 = squares[0] * squares[1] + third * (squares[0] + squares[1])
        return jnp.sum(middle * length * (i1 - 3.0 + 0.1 * (i2 - 3.0)))

    start = np.stack([reference[1:-1], RISE * (RADIUS - reference[1:-1]) / (RADIUS - inner)]).ravel()
    found = optimize.minimize(jax.jit(energy), start, jac=jax.jit(jax.grad(energy)), method="L-BFGS-B",
                              options={"maxiter": 20000, "maxfun": 40000, "ftol": 1e-15, "gtol": 1e-12})  # fmt: skip
    one, other = stretches(jnp.asarray(found.x.reshape(2, -1)))
    return np.stack([middle, 1.0 / np.asarray(one * other)])


def test_a_plug_that_lifts_a_disc_stretches_it_as_least_energy_does(plug_result: tuple[jaxform.Scene, Result]) -> None:
    """The plug's flat top holds what lies over it; from there to the rim the sheet is an annulus without load."""
    scene, result = plug_result
    assert int(result.status) == 0 and float(result.energy.balance_error) < 1e-3
    assert float(result.energy.external_work) == 0.0 and float(result.energy.tool_work) > 0.1
    start, held = np.asarray(scene.parison.positions), np.asarray(result.wall) != 0
    radius = np.linalg.norm(start[:, :2], axis=1)
    np.testing.assert_allclose(np.asarray(result.positions)[held] - start[held], [[0.0, 0.0, RISE]] * held.sum(),
                               atol=1e-12)  # fmt: skip
    np.testing.assert_array_equal(np.asarray(result.positions)[np.asarray(scene.parison.clamped)],
                                  start[np.asarray(scene.parison.clamped)])  # fmt: skip
    inner = radius[held].max()
    place, ratio = _annulus(float(inner))
    free = np.flatnonzero((radius > inner + 0.004) & ~np.asarray(scene.parison.clamped))
    off = np.asarray(result.thickness)[free] / THICKNESS / np.interp(radius[free], place, ratio) - 1.0
    assert np.sqrt(np.mean(np.square(off))) < 0.01
    lifted = np.asarray(result.positions)[~held & (radius < inner)]
    assert len(lifted) == 0


@pytest.mark.long
def test_a_refined_sheet_on_a_plug(tmp_path: Path) -> None:
    """New nodes between held ones are held as well, on its top or its side; clamped ones stay where they are."""
    scene = plug(tmp_path, "[refinement]\nangle = 3.0\ninterval = 64\nmax_level = 2\n", element_size="0.016")
    shown, result = drop_unused(scene, jaxform.run(scene))
    assert int(result.status) == 0 and len(result.triangles) > 1.5 * scene.first_nodes
    assert float(result.energy.balance_error) < 2e-3
    start, now, held = (np.asarray(a) for a in (shown.parison.positions, result.positions, result.wall))
    below, radius = RISE - now[held != 0, 2], np.linalg.norm(now[held != 0, :2], axis=1)
    beside = radius / (0.042 + below * 0.005 / 0.058)  # of a side with 96 facets
    assert np.all((np.abs(below) < 1e-12) | (np.abs(beside - 0.5 * (1 + np.cos(np.pi / 96))) < 3e-4))
    rim = np.asarray(shown.parison.clamped)
    np.testing.assert_array_equal(now[rim], start[rim])
    inside = np.linalg.norm(start[:, :2], axis=1) < 0.03
    assert np.all(held[inside] != 0)


def test_files_have_the_mold_where_it_is_in_the_end(plug_result: tuple[jaxform.Scene, Result], tmp_path: Path) -> None:
    scene, result = plug_result
    summary = output.write_result(scene, result, tmp_path)
    assert summary["warnings"] == [] and summary["penetration_max"] < 1e-9
    np.testing.assert_allclose(summary["energy"]["tool_work"], result.energy.tool_work)
    np.testing.assert_allclose(meshio.read(tmp_path / "mold.vtu").points[:, 2].max(), RISE, atol=1e-12)
    shown, _ = drop_unused(scene, result)
    assert shown.mold is not None and float(np.asarray(shown.mold.vertices)[:, 2].max()) == pytest.approx(RISE)


@pytest.mark.parametrize(
    ("direction", "time", "displacement", "words"),
    [
        ([0, 0, 0], [0, 1], [0, 1], r"mold\.motion\.direction.*is not a direction"),
        (
            [0, 0, 1],
            [0, 1],
            [0.1, 1],
            r"mold\.motion\.displacement.*does not start with a displacement of 0.*translate",
        ),
        ([0, 0, 1], [0, 1, 2], [0, 1], "3 times and 2 displacements"),
        ([0, 0, 1], [1, 0], [0, 1], "do not increase"),
        ([0, 0, 1], [0, 1], [0, np.nan], "not finite"),
    ],
)
def test_what_is_no_motion_is_refused_in_words(direction: list, time: list, displacement: list, words: str) -> None:
    with pytest.raises(InputError, match=words):
        jaxform.make_motion(direction, time, displacement)


def test_a_mold_must_move_along_the_symmetry_planes(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"across a symmetry plane \(normal to x\)"):
        plug(tmp_path, direction="[1.0, 0.0, 1.0]")
    with pytest.raises(
        InputError, match=r"plug\.toml.*mold\.motion\.displacement.*does not start with a displacement of 0"
    ):
        plug(tmp_path, displacement="[0.01, 0.052]")


def test_frames_show_the_mold_where_it_is(plug_result: tuple[jaxform.Scene, Result], tmp_path: Path) -> None:
    scene, result = plug_result
    assert scene.mold is not None
    frames = Frames(tmp_path, 2)
    frames.begin(scene)
    frames.finish(scene, result)
    listed = [item.attrib for item in ElementTree.parse(tmp_path / "frames.pvd").getroot().iter("DataSet")]
    molds = [item for item in listed if item.get("part") == "1"]
    assert len(listed) == 4 and [float(item["timestep"]) for item in molds] == [0.0, float(result.time)]
    for item in molds:
        places = meshio.read(tmp_path / item["file"]).points
        np.testing.assert_allclose(places, scene.mold.vertices_at(float(item["timestep"])), atol=1e-12)
    assert np.ptp([meshio.read(tmp_path / item["file"]).points[:, 2].max() for item in molds]) > 0.05
    shown, count = stored_results._frames(
        tmp_path, stored_results._part(tmp_path / listed[1]["file"]), float(result.time)
    )
    assert (len(shown), count) == (1, 2)


@pytest.mark.quick
def test_a_motion_rests_from_its_last_knot_on_whatever_the_displacements_are() -> None:
    held = jaxform.make_motion([0, 0, 1], [0.0, 1.0, 3.0], [0.0, 0.5, 0.5])
    # A later knot of the same displacement may be designed; those of the padding may not.
    assert float(held.last_time) == 3.0
    time, displacement = extend_knots(np.asarray(held.time), np.asarray(held.displacement))
    assert len(time) > 3
    padded = dataclasses.replace(held, time=jnp.asarray(time), displacement=jnp.asarray(displacement))
    assert float(padded.last_time) == 3.0


@pytest.mark.parametrize("length", [1e-200, 1.0, 1e200])
def test_a_direction_may_have_any_length(length: float) -> None:
    """Its square is no double where it is as short or long."""
    motion = jaxform.make_motion([0.0, 3.0 * length, -4.0 * length], [0.0, 1.0], [0.0, 1.0])
    np.testing.assert_allclose(motion.direction, [0.0, 0.6, -0.8], rtol=1e-15)

"""Small scenes that several tests share, so that each shape compiles once."""

from __future__ import annotations

import functools
import importlib
import multiprocessing
from collections.abc import Callable, Iterable
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxform
from jaxform import molds, shapes
from jaxform.adapt import element_bisection, refinement
from jaxform.io import files
from jaxform.materials import Law
from jaxform.mesh.shapes import Sheet
from jaxform.model.scene import Scene
from jaxform.results.result import Result
from jaxform.runs import host
from jaxform.runs.padding import pad_to_bucket
from jaxform.sheet import active_set
from jaxform.sheet.discretization import NEVER, Discretization
from jaxform.sheet.state import State

FILE = """
name = "small"
[parison]
shape = "disc"
radius = 0.1
elements = 40
symmetry = "quarter"
thickness = 1.0e-3
[material]
model = "mooney-rivlin"
c = 0.2e6
alpha = 0.1
density = 1000.0
[pressure]
time = [0.0, 0.2]
value = [0.0, 2.0e4]
[mold]
shape = "revolved"
profile = [[0.0, 0.05], [0.055, 0.05], [0.1, 0.0]]
segments = 48
fill = false
[solver]
end_time = 0.05
damping = 100.0
"""


def assert_same(actual: Any, expected: Any) -> None:
    """To the last bit on the CPU; elsewhere, where sums are in any order, to rounding."""
    if jax.default_backend() == "cpu":
        np.testing.assert_array_equal(actual, expected)
    else:
        np.testing.assert_allclose(actual, expected, rtol=1e-11, atol=1e-13)


def assert_slopes(
    objective: Callable[[dict[str, jax.Array]], tuple[jax.Array, dict[str, jax.Array]]],
    numbers: dict[str, jax.Array],
    size: float = 1e-5,
) -> jax.Array:
    """The slopes by all numbers, against one central difference along a random direction; returns the value.

    The objective gives value and slopes, compiled once. The largest change is about `size` of a number. Each number's
    change is scaled so that it adds as much to the difference as every other: one wrong slope in `n` is then seen as
    well as with a difference of its own, by a bound that is `n` times as sharp.
    """
    value, slopes = objective(numbers)
    random = {name: np.random.default_rng(1).standard_normal(part.shape) * part for name, part in numbers.items()}
    shares = {name: float(jnp.vdot(slopes[name], way)) for name, way in random.items()}
    assert all(shares.values()), shares
    least = min(map(abs, shares.values()))
    changes = {name: size * least / shares[name] * way for name, way in random.items()}
    ends = [float(objective({name: numbers[name] + sign * changes[name] for name in numbers})[0]) for sign in (1, -1)]
    np.testing.assert_allclose(size * least * len(numbers), (ends[0] - ends[1]) / 2, rtol=1e-6 / len(numbers))
    return value


def _configure() -> None:
    """Makes a new process compile and compute as the tests do."""
    importlib.import_module("tests.conftest")


def call_elsewhere[T](function: Callable[[], T]) -> T:
    """The result of a module's function in a new process, to which JAX's memory of traced functions is confined."""
    spawn = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(1, mp_context=spawn, initializer=_configure) as fresh:
        return fresh.submit(function).result()


def begin_run(scene: Scene) -> tuple[State, Discretization]:
    """The first state and the sheet, each operation of which would be a program of its own."""
    return host.begin(scene)[:2]


def at_rest(scene: Scene) -> Result:
    """The part before the first step; by programs for all scenes of its bucket sizes."""
    room = pad_to_bucket(scene)
    state, sheet = begin_run(room.scene)
    return room.result(host.result_of(state, room.scene, sheet))


def assert_refused(folder: Path, text: str, words: str, named: str = "scene.toml") -> None:
    """A scene file with that text, in the folder, is refused in words that match; they name what is to be named."""
    path = folder / "scene.toml"
    path.write_text(text)
    with pytest.raises(jaxform.InputError, match=words) as caught:
        files.load(path)
    assert named in str(caught.value)


def short_first(values: Iterable[Any], count: int = 1) -> list[Any]:
    """Parameters of a test of which `make test` takes the first, and `make test-all` the others, too."""
    given = [value if isinstance(value, tuple) else (value,) for value in values]
    return [pytest.param(*one, marks=[pytest.mark.long] if k >= count else []) for k, one in enumerate(given)]


def real(value: float) -> jnp.ndarray:
    return jnp.asarray(value, float)


def mooney(alpha: float, c: float = 1.0) -> Law:
    return jaxform.MooneyRivlin(real(c), real(alpha), real(1.0))


def free_disc(
    elements: int, pressure: float, material: Law, damping: float | None = 1.0, end_time: float = 60.0
) -> jaxform.Scene:
    """A quarter of a free disc of radius 1 and thickness 0.01, inflated slowly; pressure in units of c h0/a."""
    sheet = shapes.disc(radius=1.0, elements=elements, symmetry="quarter")
    return jaxform.build_scene(
        parison=jaxform.make_parison(sheet.positions, sheet.triangles, 0.01, sheet.clamped, sheet.fixed),
        material=material,
        pressure=jaxform.make_pressure([0.0, 40.0], [0.0, 0.01 * pressure]),
        solver=jaxform.make_solver(end_time=end_time, damping=damping),
    )


def sphere(elements: int, pressure: float, material: Law, time: list[float], **options: Any) -> jaxform.Scene:
    """A quarter of a closed sphere of radius 1 and thickness 0.01; pressure in units of c h0/r."""
    sheet = shapes.sphere(radius=1.0, elements=elements, symmetry="quarter")
    knots = [0.0, 0.01 * pressure] if len(time) == 2 else [0.01 * pressure]
    return jaxform.build_scene(
        parison=jaxform.make_parison(sheet.positions, sheet.triangles, 0.01, sheet.clamped, sheet.fixed),
        material=material,
        pressure=jaxform.make_pressure(time, knots),
        solver=jaxform.make_solver(**options),
    )


@functools.cache
def cup(elements: int = 60, end_time: float = 20.0) -> jaxform.Scene:
    """A neo-Hookean disc into a truncated cone, a quarter; it touches bottom and wall within the time."""
    sheet = shapes.disc(radius=1.0, elements=elements, symmetry="quarter")
    mold = molds.revolved(profile=[[0.0, 0.5], [0.55, 0.5], [1.0, 0.0]], segments=48)
    return jaxform.build_scene(
        parison=jaxform.make_parison(sheet.positions, sheet.triangles, 0.01, sheet.clamped, sheet.fixed),
        material=jaxform.NeoHookean(real(1.0), real(1.0)),
        pressure=jaxform.make_pressure([0.0, 16.0], [0.0, 0.2], "cubic-ramp"),
        solver=jaxform.make_solver(end_time=end_time, damping=2.0),
        mold=jaxform.make_mold(mold.vertices, mold.triangles, mold.dropped),
        fill=False,
    )


def loaded_scene(pressure: jaxform.Loading) -> jaxform.Scene:
    """The cup under another loading."""
    plain = cup()
    parts = {"parison": plain.parison, "material": plain.material, "solver": plain.solver, "mold": plain.mold}
    return jaxform.build_scene(pressure=pressure, **parts)  # pyright: ignore[reportArgumentType]


def pole(scene: jaxform.Scene) -> int:
    return int(np.argmin(np.linalg.norm(np.asarray(scene.parison.positions)[:, :2], axis=1)))


def refinable(sheet: Sheet, elements: int) -> Scene:
    """A sheet without mold or pressure, with room for so many elements."""
    return jaxform.build_scene(
        parison=jaxform.make_parison(sheet.positions, sheet.triangles, 0.01, sheet.clamped, sheet.fixed),
        material=mooney(0.1),
        pressure=jaxform.make_pressure([0.0], [0.0]),
        solver=jaxform.make_solver(end_time=1.0),
        refinement=jaxform.make_refinement(angle=5.0, interval=64, max_level=2, elements=elements),
    )


@jax.jit
def bisect_scene(scene: Scene, state: State, sheet: Discretization, wanted: jax.Array) -> tuple[State, Discretization]:
    """A state with wanted elements (element_room,) bisected, and what that asks for; and its body."""
    mesh, adaptivity = state.refined_mesh, scene.adaptivity
    assert adaptivity is not None
    numbers = jnp.where(wanted, mesh.element, NEVER)
    found = element_bisection.close_queue(mesh.split_at, numbers, mesh.element_count, adaptivity[1], state.windows)
    return refinement._bisect_queue(state, scene, adaptivity, sheet, *found, None)


@jax.jit
def survey_of(state: State, scene: Scene, sheet: Discretization) -> tuple[State, Discretization]:
    """A state in the mesh's order after a window boundary at which a run surveys the mesh."""
    packed = active_set.active_set_of(state, scene, sheet)
    refined, sheet, packed = refinement.refine_in_place(packed.pack_state(state), scene, sheet, packed)
    return packed.unpack_state(refined), sheet

"""Figures of tools, contact laws and gravity: what is asked of each, and what is measured.

`python -m benchmarks.accuracy.tools [PART ...]`; without names all parts but `price` and `scenes`, which are times and
want a machine that does nothing else. A part prints a row of a table for each figure.
"""

from __future__ import annotations

import functools
import sys
import time
import warnings
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import jaxform
from benchmarks.accuracy import plugs
from benchmarks.accuracy.cases import THICKNESS, mooney, real, rms
from benchmarks.speed import tools as prices
from benchmarks.stability import tools as random_tools
from jaxform import shapes
from jaxform.adapt import mesher
from jaxform.mesh.shapes import Sheet
from jaxform.model.replacement import number_at
from jaxform.results import size_field


class Figure(NamedTuple):
    """A measured figure, the largest value that is asked, and a unit, % of fractions."""

    name: str
    measured: float
    asked: float
    unit: str = "%"

    def row(self) -> str:
        """A row of a table in Markdown."""
        scale = 100.0 if self.unit == "%" else 1.0
        asked, found = (f"{scale * value:.2g} {self.unit}".strip() for value in (self.asked, self.measured))
        return f"| {self.name} | {asked} | {found} | {'yes' if self.measured <= self.asked else 'NO'} |"


Figures = Iterator[Figure]


def _run(scene: jaxform.Scene) -> jaxform.Result:
    """The result of a run that ends well.

    Raises:
        RuntimeError: It does not.
    """
    result = jaxform.run(scene)
    if (ending := jaxform.explain(result)) != "ok":
        raise RuntimeError(ending)
    return result


# --- Plugs ------------------------------------------------------------------------------------------------------------

_PUSHES = ((0.4, 0.0), (0.6, 0.0), (1.0, 0.0), (0.6, 1.0), (0.6, 3.0))  # depth and pressure of a flat plug
_RINGS, _NO_RING = 2400, 2281  # elements of discs with and without a ring of nodes at the flat plug's edge
_MOST = 2500  # elements of an adapted disc


def _disc(elements: int) -> Sheet:
    return shapes.disc(radius=1.0, elements=elements, symmetry="quarter")


def _adapt(make: Callable[[Sheet], jaxform.Scene], sheet: Sheet, passes: int = 2) -> Sheet:
    """The sheet after as many runs as `parison.adapt` takes by default."""
    for _ in range(passes):
        scene = make(sheet)
        result = _run(scene)
        lines = size_field.edge_lines(scene, result)
        sheet = mesher.remesh(sheet, size_field.wanted_sizes(scene, result), _MOST, lines)
    return sheet


def measure_flat() -> Figures:
    """A flat plug, on a mesh with a ring of nodes at its edge, and on one adapted from a mesh without."""
    for depth, pressure in _PUSHES:
        wall, make = plugs.flat_wall(depth, pressure), functools.partial(_push_flat, depth, pressure)
        for name, sheet in (("a ring at its edge", _disc(_RINGS)), ("adapted", _adapt(make, _disc(_NO_RING)))):
            scene = make(sheet)
            error = plugs.wall_errors(scene, _run(scene), wall).rms
            blown = f", blown by {pressure:g}" if pressure else ""
            yield Figure(f"flat plug, {depth:g} deep{blown}; {len(sheet.triangles)} elements, {name}", error, 0.008)


def _push_flat(depth: float, pressure: float, sheet: Sheet) -> jaxform.Scene:
    return plugs.plug_scene(sheet, plugs.flat_plug(), depth, pressure)


def measure_hemisphere() -> Figures:
    """A hemispherical plug, at depths at which its line of contact is and is not a ring of nodes."""
    landing, sheet = plugs.push_hemisphere(), _disc(_RINGS)
    for depth, pressure in ((0.325, 0.0), (0.4, 0.0), (0.495, 0.0), (0.495, 1.0), (0.495, 3.0)):
        scene = plugs.plug_scene(sheet, plugs.round_plug(), depth, pressure)
        wall = plugs.hemisphere_wall(landing, depth, pressure)
        error = plugs.wall_errors(scene, _run(scene), wall).rms
        blown = f", blown by {pressure:g}" if pressure else ""
        yield Figure(f"hemispherical plug, {depth:g} deep{blown}; {len(sheet.triangles)} elements", error, 0.008)


# --- Friction ---------------------------------------------------------------------------------------------------------

PLATE_WALLS = {0.0: [0.631376, 0.631376, 0.636591, 0.746505], 5.0: [0.7243, 0.6919, 0.6354, 0.7433]}
"""Exact h/h0 at initial radii 0.05, 0.2, 0.5 and 0.9 of a disc blown against a plate, by its friction; 5 sticks."""


def plate(height: float = 0.0, half: float = 2.0) -> tuple[np.ndarray, np.ndarray]:
    """Vertices and triangles of a square at a height."""
    corners = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], float) * half
    return corners + np.array([0.0, 0.0, height]), np.array([[0, 1, 2], [0, 2, 3]])


def blown_on_plate(friction: float, elements: int = 150) -> jaxform.Scene:
    """A disc blown slowly against a plate at half its radius."""
    sheet = _disc(elements)
    return jaxform.build_scene(
        parison=jaxform.make_parison(sheet.positions, sheet.triangles, THICKNESS, sheet.clamped, sheet.fixed),
        material=mooney(0.1),
        pressure=jaxform.make_pressure([0.0, 48.0], [0.0, 4.0 * THICKNESS]),
        solver=jaxform.make_solver(end_time=60.0, damping=1.0),
        mold=jaxform.make_mold(*plate(0.5), contact=jaxform.make_contact_law("coulomb", friction)),
        fill=False,
    )


def wall_at(scene: jaxform.Scene, result: jaxform.Result, radii: tuple[float, ...], width: float) -> np.ndarray:
    """h/h0 at initial radii, by parabolas through the elements as near as the width."""
    radius = np.linalg.norm(np.asarray(scene.parison.positions)[np.asarray(result.triangles)].mean(1), axis=1)
    thin = np.asarray(result.element_thickness) / THICKNESS
    near = [(at, np.abs(radius - at) < width) for at in radii]
    return np.array([np.polyval(np.polyfit(radius[those] - at, thin[those], 2), 0.0) for at, those in near])


def measure_plate() -> Figures:
    """A disc against a plate, which it slides on or sticks to."""
    for friction, walls in PLATE_WALLS.items():
        scene = blown_on_plate(friction, 600)
        error = wall_at(scene, _run(scene), (0.05, 0.2, 0.5, 0.9), 0.08) / np.array(walls) - 1.0
        yield Figure(f"disc against a plate, friction {friction:g}", rms(error, np.ones(4)), 0.01)


def cylinder(turn: float, parts: int) -> tuple[np.ndarray, np.ndarray]:
    """Vertices and triangles of a part of a cylinder of radius 1 that is round by an angle [rad], in so many facets."""
    each = turn / parts
    angle, radius = (np.arange(-2, parts + 4) - 0.5) * each, 1 / np.cos(each / 2)
    ring = radius * np.stack([np.sin(angle), 0 * angle, np.cos(angle)], 1)
    count, low = len(angle), np.arange(len(angle) - 1)
    triangles = np.concatenate(
        [np.stack([low, low + 1, count + low + 1], 1), np.stack([low, count + low + 1, count + low], 1)]
    )
    return np.concatenate([ring - [0, 1, 0], ring + np.array([0, 1, 0])]), triangles


def strip_over_cylinder(friction: float, turn: float, parts: int) -> jaxform.Scene:
    """A strip, clamped at one end and drawn over a cylinder by a jaw that sticks to the other one.

    The cylinder has so many facets, and the strip as many elements on it.
    """
    each, lead = turn / parts, 10
    step, angle = 2 * np.tan(each / 2), np.arange(parts + 1) * each
    arc = np.stack([np.sin(angle), 0 * angle, np.cos(angle)], 1)
    away = np.arange(1, lead + 1)[:, None] * step
    tangent = np.array([np.cos(turn), 0.0, -np.sin(turn)])
    line = np.concatenate([(arc[0] - away * [1.0, 0.0, 0.0])[::-1], arc, arc[-1] + away * tangent])
    count, low = len(line), np.arange(len(line) - 1)
    places = np.concatenate([line - [0, step / 2, 0], line + np.array([0, step / 2, 0])])
    triangles = np.concatenate(
        [np.stack([low, count + low + 1, low + 1], 1), np.stack([low, count + low, count + low + 1], 1)]
    )
    clamped, fixed = np.zeros(2 * count, bool), np.zeros((2 * count, 3), bool)
    clamped[[0, count]], fixed[:, 1] = True, True
    across, end = np.array([0.0, 1.0, 0.0]), line[-1]
    jaw = np.array([end + k * step * tangent + s * across for k, s in ((-0.4, -1), (3, -1), (3, 1), (-0.4, 1))])
    rest, law = 60.0, jaxform.make_contact_law("coulomb", friction)
    pull = jaxform.make_motion(tangent, [0.0, rest], [0.0, 1.0])
    return jaxform.build_scene(
        parison=jaxform.make_parison(places, triangles, THICKNESS, clamped, fixed),
        material=jaxform.NeoHookean(real(1.0), real(1.0)),
        pressure=jaxform.make_pressure([0.0], [0.0]),
        solver=jaxform.make_solver(end_time=rest, damping=2.0),
        tools=[
            jaxform.make_mold(*cylinder(turn, parts), contact=law, name="cylinder"),
            jaxform.make_mold(jaw, plate()[1], name="jaw", motion=pull),
        ],
        fill=False,
    )


def tension_ratio(scene: jaxform.Scene, result: jaxform.Result) -> float:
    """Tension of a strip at the jaw over that at the clamp."""
    stretch, count = np.asarray(result.stretches)[:, 0], len(scene.parison.positions) // 2
    tension = 2 * (stretch - stretch**-3.0)  # per c h0, as wide as before
    return float(tension[[count - 3, 2 * count - 4]].mean() / tension[[1, count]].mean())


def facet_error(friction: float, turn: float, parts: int) -> float:
    """The relative error of a tension ratio that is expected of so many facets over an angle [rad], either way.

    A node on a facet is pressed by the turn of the sheet on both its sides, a and b, and ln of the ratio is
    mu (a + b) + (1 + mu^2) (b^2 - a^2) / 2 there. Nodes lie anywhere on facets of an angle e, which so add as much as
    (1 + mu^2) e^2 / 2 each, of either sign: over turn / e facets the root of the sum of squares.
    """
    angle = turn / parts
    return (1 + friction**2) * angle**1.5 * np.sqrt(turn / 12)


_FACETS = 128


def measure_capstan() -> Figures:
    """The ratio of tensions of a strip drawn over a cylinder, against Euler's."""
    for friction in (0.1, 0.3, 1.0):
        for degrees in (45, 90, 180):
            turn = np.radians(degrees)
            scene = strip_over_cylinder(friction, turn, _FACETS)
            error = abs(tension_ratio(scene, _run(scene)) / np.exp(friction * turn) - 1.0)
            expected = f"{_FACETS} facets, of which {100 * facet_error(friction, turn, _FACETS):.1g} % is expected"
            yield Figure(f"capstan, friction {friction:g}, {degrees} degrees; {expected}", error, 0.01)


def sheet_on_slope(slope: float, friction: float, end_time: float) -> jaxform.Scene:
    """A free sheet that lies on a plate and is pulled along it by a share of its weight."""
    sheet = shapes.rectangle(size=[1.0, 1.0], elements=24)
    free = np.zeros(len(sheet.positions), bool)
    law = jaxform.make_contact_law("coulomb", friction)
    return jaxform.build_scene(
        parison=jaxform.make_parison(sheet.positions, sheet.triangles, THICKNESS, free),
        material=mooney(0.1),
        pressure=jaxform.make_pressure([0.0], [0.0]),
        solver=jaxform.make_solver(end_time=end_time, gravity=[1e-3 * slope, 0.0, -1e-3]),
        mold=jaxform.make_mold(*plate(half=9.0), contact=law),
        fill=False,
    )


def measure_drift() -> Figures:
    """The way of a sheet below the cone of friction in a hundred thousand steps."""
    trial, steps = _run(sheet_on_slope(0.2999, 0.3, 10.0)), 101_000
    scene = sheet_on_slope(0.2999, 0.3, 10.0 * steps / int(trial.steps))
    result = _run(scene)
    assert (np.asarray(result.tool) == 0).all(), "it has to lie on the plate"
    moved = float(np.abs(np.asarray(result.positions) - np.asarray(scene.parison.positions)).max())
    yield Figure(f"drift below the cone in {int(result.steps)} steps, of the size", moved, 1e-15, "")


# --- Gravity ----------------------------------------------------------------------------------------------------------

_SAGS = {(0.05, 1.0): (0.122181348, 0.98124409, 0.98802979), (0.5, 1.0): (0.276717745, 0.91673704, 0.93908200),
         (0.2, 1.05): (0.083556996, 0.89983906, 0.90163749)}  # fmt: skip
"""Exact sag, and h/h0 at pole and rim, by rho g a / c and the pre-stretch."""


def sag(gravity: float, stretch: float, elements: int) -> jaxform.Scene:
    """A neo-Hookean sheet in a round frame of radius 1 that hangs by its weight."""
    sheet = shapes.disc(radius=1.0 / stretch, elements=elements, symmetry="quarter")
    stretches = None if stretch == 1.0 else [stretch, stretch]
    return jaxform.build_scene(
        parison=jaxform.make_parison(
            sheet.positions, sheet.triangles, THICKNESS, sheet.clamped, sheet.fixed, pre_stretch=stretches
        ),
        material=mooney(0.0),
        pressure=jaxform.make_pressure([0.0], [0.0]),
        solver=jaxform.make_solver(end_time=40.0, damping=1.0, gravity=[0.0, 0.0, -gravity]),
        fill=False,
    )


def measure_gravity() -> Figures:
    """The largest error of sag, and thickness at pole and rim, of sheets that hang by their weight."""
    for (gravity, stretch), exact in _SAGS.items():
        result = _run(sag(gravity, stretch, 600))
        positions, thin = np.asarray(result.positions), np.asarray(result.thickness) / THICKNESS
        radius = np.linalg.norm(positions[:, :2], axis=1)
        pole = int(np.argmin(radius))
        found = np.array([-positions[pole, 2], thin[pole], thin[radius > 0.999].mean()])
        yield Figure(f"sag, rho g a / c = {gravity:g}, pre-stretch {stretch:g}", _largest(found / exact - 1.0), 0.005)


def _largest(values: Any) -> float:
    return float(np.abs(values).max())


# --- Gradients --------------------------------------------------------------------------------------------------------

_STEPS = (1e-4, 1e-5, 1e-6)  # of central differences, relative to the numbers


def plug_and_blow(
    law: jaxform.ContactLaw,
    elements: int = 100,
    material: Any = None,
    cooling: jaxform.Cooling | None = None,
    refinement: jaxform.Refinement | None = None,
) -> jaxform.Scene:
    """A disc that slides on a flat plug, and is blown off it then."""
    sheet, warm = _disc(elements), None if cooling is None else 140.0
    flat = plugs.flat_plug()
    lowered = np.asarray(flat.vertices) - [0.0, 0.0, 0.05]
    way = jaxform.make_motion([0, 0, 1], [0.0, 1.0, 10.0], [0.0, 0.04, 0.65])  # it comes to the sheet after 1
    return jaxform.build_scene(
        parison=jaxform.make_parison(
            sheet.positions, sheet.triangles, THICKNESS, sheet.clamped, sheet.fixed, temperature=warm
        ),
        pressure=jaxform.make_pressure([0.0, 10.0, 16.0], [0.0, 0.0, 2.0 * THICKNESS]),
        solver=jaxform.make_solver(end_time=16.0, damping=2.0),
        tools=[jaxform.make_mold(lowered, flat.triangles, contact=law, motion=way, name="plug")],
        material=material or mooney(0.1),
        cooling=cooling,
        refinement=refinement,
        fill=False,
    )


def gradient_errors(scene: jaxform.Scene) -> dict[str, float]:
    """Relative differences of slopes by the plug's numbers and central differences, by what is changed.

    Each is the least over some steps: larger ones change the order in which nodes come into contact, and rounding
    spoils smaller ones.
    """
    ran = jaxform.run(scene)
    paths = {"way": "motion.displacement", "timing": "motion.time", "friction": "contact.friction"}
    numbers = {name: number_at(scene, f"tools.plug.{path}") for name, path in paths.items()}
    ways = {name: (name, value) for name, value in numbers.items()}
    ways["position"] = "way", jnp.full_like(numbers["way"], 0.6).at[0].set(0.0)  # from before it comes to the sheet on

    def objective(numbers: dict[str, jax.Array]) -> jax.Array:
        changes = {f"tools.plug.{paths[name]}": value for name, value in numbers.items()}
        result = jaxform.simulate(jaxform.replace(scene, changes), schedule=ran.schedule)
        return 100.0 * (result.thickness[0] + jnp.sum(jnp.where(result.active, result.thickness, 0.0) ** 2))

    value, slopes = jax.jit(objective), jax.jit(jax.grad(objective))(numbers)
    found = {}
    for name, (of, way) in ways.items():
        slope = float(jnp.vdot(slopes[of], way))
        ends = [[float(value(numbers | {of: numbers[of] + sign * h * way})) for sign in (1, -1)] for h in _STEPS]
        differences = [(up - down) / (2 * h) for (up, down), h in zip(ends, _STEPS, strict=True)]
        found[name] = min(abs(each / slope - 1.0) for each in differences)
    return found


def _gradient_scenes() -> dict[str, Callable[[], jaxform.Scene]]:
    """Scenes whose gradients are measured."""
    law = jaxform.make_contact_law("coulomb", 0.2)
    modes = jaxform.Christensen(jnp.asarray([1.0, 0.5]), jnp.asarray([2.0, 20.0]))
    warm = jaxform.make_contact_law("coulomb", [0.1, 0.4], temperature=[60.0, 140.0])
    return {
        "stick, slip and release": lambda: plug_and_blow(law),
        "with viscous modes": lambda: plug_and_blow(
            law, material=jaxform.NeoHookean(real(1.0), real(1.0), viscous=modes)
        ),
        "with cooling, friction over temperature": lambda: plug_and_blow(
            warm, cooling=jaxform.Cooling(real(100.0), mold=real(7.0))
        ),
        "refined": lambda: plug_and_blow(
            law, 40, refinement=jaxform.make_refinement(angle=6.0, max_level=2, interval=64, elements=600)
        ),
    }


def measure_gradients() -> Figures:
    """Gradients by a plug's way, timing, position and friction, of one scene of each kind."""
    for scene_name, make in _gradient_scenes().items():
        for name, error in gradient_errors(make()).items():
            yield Figure(f"gradient by {name}: {scene_name}", error, 1e-5, "")


# --- Energy, random scenes, prices ------------------------------------------------------------------------------------

_BUILT_IN = ("plug-assist-cup", "plug-assist-cup-slow", "drape-block")


def measure_energy() -> Figures:
    """Errors of the energy balance of scenes with tools and friction, over the largest work."""
    scenes: dict[str, Callable[[], jaxform.Scene]] = {
        "a strip over a cylinder, friction 1": lambda: strip_over_cylinder(1.0, np.pi, _FACETS),
        "a plug with friction": lambda: plug_and_blow(jaxform.make_contact_law("coulomb", 0.2), 600),
    }
    scenes |= {name: functools.partial(jaxform.load, name) for name in _BUILT_IN}
    for name, make in scenes.items():
        yield Figure(f"energy balance, {name}", float(_run(make()).energy.balance_error), 0.005)


def measure_random(count: int = 125) -> Figures:
    """Random scenes of one to four tools of mixed laws."""
    found = random_tools.measure(count)
    total = count * len(random_tools.KINDS)
    yield Figure(f"deepest node in any tool, {total} random scenes", max(found.deepest, 0.0), 1e-9, "")
    yield Figure("energy balance, largest of these", max(found.balance), 0.005)


def measure_price() -> Figures:
    """Prices per step of a further tool, one that moves, and friction, over the mold alone."""
    seconds = prices.measure(2400)
    asked = {"and a plate at rest": 1.1, "and a plate that moves": 1.2, "with friction on the mold": 1.15}
    for name, most in asked.items():
        alone = "mold alone, no element dropped" if "friction" in name else "mold alone"
        yield Figure(f"step of a mold {name}, over {alone}", seconds[name] / seconds[alone], most, "x")


def measure_scenes() -> Figures:
    """Times of built-in scenes after compiling, the lesser of two."""
    for name in _BUILT_IN:
        scene = jaxform.load(name)
        _run(scene)
        times = [seconds.run for _ in range(2) if (seconds := _run(scene).seconds)]
        yield Figure(f"{name}, after compiling", min(times), 2.0, "s")


PARTS: dict[str, Callable[[], Figures]] = {
    "flat": measure_flat,
    "hemisphere": measure_hemisphere,
    "plate": measure_plate,
    "capstan": measure_capstan,
    "drift": measure_drift,
    "gravity": measure_gravity,
    "gradients": measure_gradients,
    "energy": measure_energy,
    "random": measure_random,
    "price": measure_price,
    "scenes": measure_scenes,
}
_TIMES = ("price", "scenes")


def main(names: list[str]) -> int:
    """Prints a table of the parts' figures; 1 if one is missed, 2 of a name that is none."""
    if unknown := [name for name in names if name not in PARTS]:
        print(f"{', '.join(unknown)}: no such part; there are {', '.join(PARTS)}", file=sys.stderr)
        return 2
    jax.config.update("jax_enable_x64", True)
    warnings.simplefilter("ignore", UserWarning)
    missed = False
    print("| figure | asked | measured | met |\n|---|---|---|---|", flush=True)
    for name in names or [part for part in PARTS if part not in _TIMES]:
        began = time.perf_counter()
        for figure in PARTS[name]():
            missed |= not figure.measured <= figure.asked
            print(figure.row(), flush=True)
        print(f"{name}: {time.perf_counter() - began:.0f} s", file=sys.stderr, flush=True)
    return int(missed)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))

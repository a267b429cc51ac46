"""Random scenes, many of them nasty: some families of one static shape each, all else drawn from a seed.

What a program is compiled for (number of nodes, law, kind of pressure, room) belongs to the family; node positions,
thickness, material, pressure, mold and times are drawn. Molds of a family have the same number of triangles, and their
search structures are put into arrays of one size, so that a family compiles once.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
from numpy.random import Generator

import jaxform
from benchmarks.strangers import scenes
from jaxform import molds, shapes
from jaxform.core.pytree import as_real
from jaxform.core.store import Store
from jaxform.materials import MODES, Law, Modes
from jaxform.mesh.shapes import Sheet
from jaxform.model.tables import LONG_WINDOW, SHORT_WINDOW
from jaxform.prepare import planning
from jaxform.tools import search

WINDOWS = 1500  # room for a run's schedule; scenes that plan for more are shortened
_CELLS = 36  # along each side of a mold's grid
_LISTED = 1 << 19
_MOLDS = 16  # of a family; more would take their time in preparing
_STORE = Store(Path(__file__).parents[2] / "out" / "stability" / "molds")


@dataclass
class Drawn:
    """A random scene.

    Attributes:
        family: Its family's name.
        scene: With room for `WINDOWS` windows.
        planned: Windows that it would have by itself.
        tags: Its unusual properties.
    """

    family: str
    scene: jaxform.Scene
    planned: int
    tags: list[str] = field(default_factory=list)


@dataclass(frozen=True)
class Family:
    """Common properties of the scenes of a family.

    Attributes:
        sheet: A sheet of size 1.
        law: As scene files name it.
        mold: Draws a mold for a sheet of size 1, or None.
        damped: True if there is damping.
        interpolation: Interpolation of the pressure.
        safety: Safety factor of the solver.
        refinement: Its static limits; None without.
        sharp: True if the step is computed by Lanczos' method.
        viscous: Kind of its viscous modes; None without.
        warm: True if its law varies over the sheet, and it has a temperature.
        cools: True if the temperature falls.
        wrinkles: True if its law has a tension field.
    """

    sheet: Callable[[], Sheet]
    law: str
    mold: Callable[[Generator, list[str]], molds.MoldShape] | None = None
    damped: bool = True
    interpolation: str = "linear"
    safety: float = 0.9
    refinement: dict[str, Any] | None = None
    sharp: bool = True
    viscous: str | None = None
    warm: bool = False
    cools: bool = False
    wrinkles: bool = False


def draw(seed: int) -> Drawn:
    """The scene of a seed.

    Raises:
        jaxform.InputError: Where the scene is refused.
    """
    name, random = family_of(seed), np.random.default_rng(seed)
    tags: list[str] = []
    if name == "file":
        return normalise(name, scenes.from_file(random, tags), tags)
    if name in scenes.OWN_MESHES:
        return normalise(name, scenes.own_meshes(name, random, tags), tags)
    return _draw_one(name, FAMILIES[name], random)


def family_of(seed: int) -> str:
    """The name of a seed's family: from `STRANGERS_FROM` on, those that a stranger's files look like.

    From `FURTHER_FROM` on, those of further laws; from `VISCOUS_FROM` on, those that are viscous, or warm; from
    `COOLING_FROM` on, those that cool, or wrinkle.
    """
    names = NAMES if seed < STRANGERS_FROM else STRANGERS if seed < FURTHER_FROM else FURTHER
    names = names if seed < VISCOUS_FROM else VISCOUS if seed < COOLING_FROM else COOLING
    return names[seed % len(names)]


def _draw_one(name: str, family: Family, random: Generator) -> Drawn:
    tags: list[str] = []
    # A mold is prepared once, for sheets of size 1.
    size, c = 10 ** random.uniform(-2.0, 0.3) if family.mold is None else 1.0, 10 ** random.uniform(4.0, 7.0)
    density, thin = random.uniform(300.0, 3000.0), 10 ** random.uniform(-3.5, -1.5)
    sheet = family.sheet()
    positions = size * _distort(sheet, family, random, tags)
    thickness = size * thin * _thickness(positions / size, random, tags)
    unit, scale = size * np.sqrt(density / c), c * thin
    end, knots = _pressure(unit, scale, random, tags)
    material, damping = _material(family.law, c, density, random, tags), None
    temperature = None
    if family.viscous is not None:
        material = dataclasses.replace(material, viscous=_modes(family.viscous, c, unit, random, tags))
    if family.warm:
        zones = as_real(c * np.exp(random.uniform(0.1, 1.0) * np.sin(positions @ random.normal(0.0, 3.0 / size, 3))))
        material = dataclasses.replace(material.with_zones({"c": zones}), shift=_shift(random, tags))
        temperature = random.uniform(120.0, 160.0, len(positions))
    cooling = _cooling(size * thin, density, unit, random, tags) if family.cools else None
    if family.wrinkles:
        material = dataclasses.replace(material, tension_field=True)
    if family.damped:
        damping = 0.0 if random.random() < 0.1 else 10 ** random.uniform(-2.0, 1.3) / unit
    mold = None
    if family.mold is not None:
        of_mold = np.random.default_rng([list(FAMILIES).index(name), int(random.integers(_MOLDS))])
        mold = _make_scene(family.mold(of_mold, tags), size, of_mold, tags)
    refinement = None
    if family.refinement is not None:
        jump = {} if "jump" not in family.refinement else {"jump": random.uniform(0.05, 1.0)}
        limits: dict[str, Any] = family.refinement | jump
        area = float(10 ** random.uniform(-7.0, -3.0) * size**2)
        refinement = jaxform.make_refinement(angle=random.uniform(1.0, 40.0), min_area=area, **limits)
    scene = jaxform.build_scene(
        parison=jaxform.make_parison(
            positions, sheet.triangles, thickness, sheet.clamped, sheet.fixed, temperature=temperature
        ),
        material=material,
        pressure=jaxform.make_pressure(*knots, family.interpolation),
        solver=jaxform.make_solver(end_time=end, damping=damping, safety=family.safety),
        mold=mold,
        refinement=refinement,
        cooling=cooling,
        store=_STORE,
        name=name,
    )
    scene = dataclasses.replace(scene, solver=dataclasses.replace(scene.solver, sharp_step=family.sharp))
    return normalise(name, scene, tags)


def normalise(name: str, scene: jaxform.Scene, tags: list[str]) -> Drawn:
    """The scene in its family's static shape, shortened where it would take too many windows."""
    planned = scene.tables.window_count
    if planned > WINDOWS:
        share = 0.9 * WINDOWS / planned
        changes = {"solver.end_time": share * np.asarray(scene.solver.end_time)}
        scene = jaxform.replace(scene, changes | {"pressure.time": share * np.asarray(scene.pressure.time)})
        planned = planning.plan_windows(scene.tables.bound, scene.law, scene.solver)
        planned = min(planned + planning.spare_windows(scene.tables.grid), WINDOWS)
        tags.append("shortened")
    grid = None if scene.mold is None else _common_grid(scene)
    longest = np.int32(LONG_WINDOW if scene.refinement is None else SHORT_WINDOW)
    tables = dataclasses.replace(scene.tables, grid=grid, window_count=WINDOWS, longest_window=longest)
    if tables.forest is not None and tables.forest.bend is not None and scene.mold is not None and grid is not None:
        forest = dataclasses.replace(tables.forest, bend=planning.bends(scene.mold, grid))
        tables = dataclasses.replace(tables, forest=forest)
    return Drawn(name, dataclasses.replace(scene, tables=tables), planned, tags)


def _common_grid(scene: jaxform.Scene) -> search.SearchGrid:
    """The search structure of the scene's mold, with more cells around it and room in its lists."""
    grid, mold = scene.tables.grid, scene.mold
    assert grid is not None and mold is not None
    shape = np.full(3, _CELLS)
    assert np.all(shape >= np.asarray(grid.shape)), grid.shape
    middle = np.asarray(grid.corner) + 0.5 * float(grid.width) * np.asarray(grid.shape)
    corner = middle - 0.5 * float(grid.width) * shape
    frame = search.CellFrame(corner, float(grid.width), float(grid.reach), shape)
    corners = np.asarray(mold.vertices, float)[np.asarray(mold.triangles)][np.asarray(grid.number)]
    place = np.array([*frame.corner, frame.width, frame.reach])
    lists = _STORE.arrays("grid", (corners, place, frame.shape), lambda: search._lists(corners, frame))
    room = _LISTED * -(-len(lists["listed"]) // _LISTED)
    return dataclasses.replace(
        grid,
        corner=as_real(corner),
        bound=as_real(lists["bound"]),
        start=jnp.asarray(lists["start"]),
        ends=jnp.asarray(lists["ends"]),
        listed=jnp.asarray(np.pad(lists["listed"], (0, room - len(lists["listed"])))),
        far=None,
        shape=jnp.asarray(shape, jnp.int32),
    )


# --- What is drawn ----------------------------------------------------------------------------------------------------


def _distort(sheet: Sheet, family: Family, random: Generator, tags: list[str]) -> np.ndarray:
    """Node positions (n_node, 3): as they are, squeezed, graded towards a corner, or shaken."""
    positions = np.array(sheet.positions)
    kind = random.choice(["plain", "squeezed", "graded", "shaken", "shaken"])
    if family.refinement is not None or kind == "plain":
        return positions  # the forest's shape depends on which edges are longest
    tags.append(str(kind))
    if kind == "squeezed":
        return positions * [1.0, 1.0 / random.uniform(2.0, 50.0), 1.0]
    if kind == "graded":
        power = random.uniform(1.5, 4.0)
        if np.ptp(positions[:, 2]) > 0.0:
            return positions
        length = np.linalg.norm(positions[:, :2], axis=1, keepdims=True)
        high = max(float(length.max()), 1e-9)
        return positions * (np.maximum(length / high, 1e-9) ** (power - 1.0))
    corners = positions[sheet.triangles]
    shortest = np.full(len(positions), np.inf)
    height = _least_height(corners)
    for k in range(3):
        np.minimum.at(shortest, sheet.triangles[:, k], height)
    away = random.uniform(-1.0, 1.0, positions.shape) * (random.uniform(0.1, 0.49) * shortest[:, None])
    away[sheet.clamped | (random.random(len(positions)) < 0.3)] = 0.0
    away = np.where(sheet.fixed, 0.0, away)
    if np.ptp(positions[:, 2]) == 0.0:
        away[:, 2] = 0.0
    return positions + away


def _least_height(corners: np.ndarray) -> np.ndarray:
    """Least height of triangles (n, 3, 3)."""
    longest = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(1)
    cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    return np.linalg.norm(cross, axis=1) / longest


def _thickness(positions: np.ndarray, random: Generator, tags: list[str]) -> np.ndarray:
    """At nodes (n_node,), about 1."""
    kind = random.choice(["uniform", "smooth", "random", "spot", "extreme"], p=[0.3, 0.25, 0.25, 0.1, 0.1])
    tags.append(f"{kind} thickness")
    count = len(positions)
    if kind == "uniform":
        return np.ones(count)
    if kind == "smooth":
        wave = random.normal(0.0, 3.0, 3)
        return np.exp(random.uniform(0.1, 1.0) * np.sin(positions @ wave + random.uniform(0.0, 6.0)))
    if kind == "random":
        return np.exp(random.uniform(0.1, 1.5) * random.uniform(-1.0, 1.0, count))
    values = np.ones(count)
    power = 3.0 if kind == "extreme" else 1.0
    values[random.integers(count)] = 10 ** (random.choice([-1.0, 1.0]) * power)
    return values


def _pressure(
    unit: float, scale: float, random: Generator, tags: list[str]
) -> tuple[float, tuple[np.ndarray, np.ndarray]]:
    """End time [s] and six knots of pressure, times [s] and values [Pa]."""
    end = unit * 10 ** random.uniform(0.3, 1.5)
    top = scale * 10 ** random.uniform(-1.0, 1.6)
    time = end * np.array([0.0, 0.2, 0.4, 0.6, 0.8, 0.95])
    kind = random.choice(["ramp", "sudden", "jumps", "back", "negative", "random"])
    tags.append(f"{kind} pressure")
    if kind == "ramp":
        return end, (time, top * np.linspace(0.0, 1.0, 6))
    if kind == "sudden":
        return end, (time, np.full(6, top))
    if kind == "jumps":
        begin = end * np.sort(random.uniform(0.0, 0.9, 3))
        return end, (np.stack([begin, begin + 1e-6 * end], 1).ravel(), top * np.repeat(random.random(4), 2)[1:7])
    if kind == "back":
        return end, (time, top * np.array([0.0, 1.0, 0.5, 0.1, -0.2, 0.0]))
    if kind == "negative":
        return end, (time, -top * np.linspace(0.0, 1.0, 6))
    return end, (time, top * random.normal(0.3, 1.0, 6))


def _material(law: str, c: float, density: float, random: Generator, tags: list[str]) -> Law:
    rho = as_real(density)
    if law == "neo-hookean":
        return jaxform.NeoHookean(as_real(c), rho)
    if law == "mooney-rivlin":
        alpha = 0.0 if random.random() < 0.2 else random.uniform(0.0, 0.5)
        tags.append("alpha = 0" if alpha == 0 else "alpha")
        return jaxform.MooneyRivlin(as_real(c), as_real(alpha), rho)
    if law == "yeoh":
        c2, c3 = c * random.uniform(-0.05, 0.1), c * 10 ** random.uniform(-4.0, -2.0)
        return jaxform.Yeoh(as_real(c), as_real(c2), as_real(c3), rho)
    if law == "gent":
        return jaxform.Gent(as_real(2 * c), as_real(10 ** random.uniform(0.3, 2.0)), rho)
    if law == "ogden":
        # Every term is stiff by itself, whichever way its power goes.
        alpha = random.choice([-1.0, 1.0], 3) * random.uniform([1.0, 0.5, 0.5], [3.0, 8.0, 4.0])
        return jaxform.Ogden(as_real(2 * c * np.array([0.9, 0.01, 0.1]) / alpha), as_real(alpha), rho)
    return jaxform.ModifiedMooneyRivlin(as_real(c), as_real(c * 10 ** random.uniform(-4.0, -1.0)), rho)


def _modes(kind: str, c: float, unit: float, random: Generator, tags: list[str]) -> Modes:
    """Two modes: from soft to far stiffer than the law, and from far shorter than a step to longer than the run."""
    modulus, time = c * 10 ** random.uniform(-1.5, 1.5, 2), unit * 10 ** random.uniform(-4.0, 3.0, 2)
    tags.append("stiff modes" if modulus.max() > 5.0 * c else "modes")
    tags += ["short modes"] * bool(time.min() < 1e-2 * unit)
    return MODES[kind](**{"modulus": as_real(modulus), "time": as_real(time)})


def _shift(random: Generator, tags: list[str]) -> jaxform.ArrheniusStiffness:
    energy = 10 ** random.uniform(3.5, 5.2)
    tags.append("steep shift" if energy > 5e4 else "shift")
    return jaxform.ArrheniusStiffness(as_real(140.0), as_real(energy))


def _cooling(wall: float, density: float, unit: float, random: Generator, tags: list[str]) -> jaxform.Cooling:
    """As fast as a wave passes over the sheet, to a thousand times as slow; with any temperature around."""
    capacity = 2000.0
    air, on_mold = density * capacity * wall / (unit * 10 ** random.uniform(0.0, 3.0, 2))
    around = random.uniform(-50.0, 200.0, 2)
    conductivity = wall * air * 10 ** random.uniform(-1.5, 1.0) if random.random() < 0.5 else None
    tags += ["cools fast"] * bool(air * unit > 0.1 * density * capacity * wall)
    given = {"heat_capacity": capacity, "air": air, "air_temperature": around[0]}
    given |= {"mold": on_mold, "mold_temperature": around[1], "conductivity": conductivity}
    numbers: dict[str, Any] = {name: as_real(value) for name, value in given.items() if value is not None}
    return jaxform.Cooling(**numbers)


def _make_scene(mold: molds.MoldShape, size: float, random: Generator, tags: list[str]) -> jaxform.Mold:
    """The mold for a sheet of that size; some with triangles that turn any way, shaken, or where the sheet is."""
    vertices, triangles = size * np.array(mold.vertices), np.array(mold.triangles)
    if random.random() < 0.4:
        turned = random.random(len(triangles)) < 0.5
        triangles[turned] = triangles[turned][:, ::-1]
        tags.append("turned mold")
    if random.random() < 0.25:
        shaken = 0.02 * size * random.uniform(-1.0, 1.0, vertices.shape) * [1.0, 1.0, 0.0]
        vertices = vertices + np.where(np.abs(vertices[:, 2:]) > 1e-9, shaken, 0.0)
        tags.append("shaken mold")
    if random.random() < 0.08:
        vertices[:, 2] -= size * random.uniform(0.0, 0.3)
        tags.append("mold in the sheet")
    return dataclasses.replace(jaxform.make_mold(vertices, triangles), dropped=0)


def _cup(random: Generator, tags: list[str]) -> molds.MoldShape:
    """A cup, 24 facets, whose profile has four points; some with an undercut, a bump or too small an opening."""
    depth, floor = random.uniform(0.15, 1.5), random.uniform(0.1, 0.95)
    middle, opening = random.uniform(0.2, 0.95), 1.0
    kind = random.choice(["cup", "undercut", "bump", "small", "wide"])
    tags.append(f"{kind} mold")
    bottom, radius = depth, floor + (opening - floor) * (1 - middle)
    if kind == "undercut":
        floor, radius = 1.3 * floor, min(radius, floor)
    if kind == "bump":
        bottom = depth * random.uniform(0.1, 0.8)
    rim = 0.0
    if kind == "small":
        opening, rim = random.uniform(0.5, 0.9), 0.02
        floor, radius = opening * floor, opening * radius
    if kind == "wide":
        opening, rim = 1.6, -0.05
    profile = [[0.0, bottom], [floor, depth], [radius, middle * depth], [opening, rim]]
    return molds.revolved(profile=profile, segments=24)


def _box(random: Generator, tags: list[str]) -> molds.MoldShape:
    """A box with a raised block for a sheet 1.5 by 1; some of them smaller than the sheet, or larger."""
    share = float(random.choice([0.8, 1.0, 1.0, 1.0, 1.2]))
    if share != 1.0:
        tags.append("box of another size")
    depth, block = random.uniform(0.1, 0.6), random.uniform(0.2, 0.5)
    mold = molds.box_insert(
        size=(1.5 * share, share),
        depth=depth,
        insert_size=(1.5 * share * block, share * block),
        insert_height=depth * random.uniform(0.1, 0.95),
        draft=random.uniform(0.0, 5.0),
    )
    shift = np.array([0.75 * (1.0 - share), 0.5 * (1.0 - share), 0.0 if share == 1.0 else random.uniform(-0.05, 0.05)])
    return dataclasses.replace(mold, vertices=mold.vertices + shift)


def _can(random: Generator, tags: list[str]) -> molds.MoldShape:
    """A closed can around a sphere of radius 1."""
    radius, top, bottom = (random.uniform(1.2, 3.0) for _ in range(3))
    profile = [[0.0, top], [radius, top * random.uniform(0.7, 1.0)], [radius * 1.01, -bottom * 0.8], [0.0, -bottom]]
    return molds.revolved(profile=profile, segments=24)


def _hill(random: Generator, tags: list[str]) -> molds.MoldShape:
    """A hill that a sheet 1.5 by 1 is blown onto."""
    height, level = random.uniform(0.0, 0.3), random.uniform(0.3, 0.6)
    mold = molds.revolved(profile=[[0.0, level - height], [0.2, level - 0.5 * height], [0.4, level], [2.0, level]],
                          segments=24)  # fmt: skip
    return dataclasses.replace(mold, vertices=mold.vertices + np.array([0.75, 0.5, 0.0]))


def _disc(elements: int, symmetry: Any) -> Callable[[], Sheet]:
    return lambda: shapes.disc(radius=1.0, elements=elements, symmetry=symmetry)


def _rectangle(elements: int, symmetry: Any) -> Callable[[], Sheet]:
    return lambda: shapes.rectangle(size=(1.5, 1.0), elements=elements, symmetry=symmetry)


def _sphere(elements: int) -> Callable[[], Sheet]:
    return lambda: shapes.sphere(radius=1.0, elements=elements, symmetry="quarter")


_NEO, _MOONEY, _MODIFIED = "neo-hookean", "mooney-rivlin", "modified-mooney-rivlin"
_FINER = {"interval": 64, "max_level": 4, "elements": 1024, "jump": None}
_NEAR = {"interval": 128, "max_level": 3, "base_level": 4, "elements": 400}

FAMILIES: dict[str, Family] = {
    "free disc": Family(_disc(60, "quarter"), _MOONEY),
    "free disc, no damping": Family(_disc(60, "quarter"), _NEO, damped=False, interpolation="cubic-ramp"),
    "cup": Family(_disc(60, "quarter"), _MOONEY, _cup),
    "whole cup": Family(_disc(96, "none"), _NEO, _cup, interpolation="cubic-ramp"),
    "cup at the limit": Family(_disc(60, "half"), _MOONEY, _cup, damped=False, safety=1.0),
    "box": Family(_rectangle(120, "none"), _MOONEY, _box),
    "hill": Family(_rectangle(80, "half"), _MODIFIED, _hill, sharp=False),
    "free sphere": Family(_sphere(64), _MODIFIED, damped=False),
    "sphere in a can": Family(_sphere(64), _NEO, _can),
    "refined cup": Family(_disc(24, "quarter"), _NEO, _cup, refinement=_FINER),
    "refined box": Family(_rectangle(48, "quarter"), _MOONEY, _box, refinement=_NEAR, damped=False),
    "flanged cup": Family(_disc(60, "quarter"), _MOONEY, scenes.flanged_cup),
    "flanged tray": Family(_rectangle(120, "none"), _NEO, scenes.flanged_tray),
    "refined flanged cup": Family(_disc(24, "quarter"), _MOONEY, scenes.flanged_cup, refinement=_NEAR),
    "refined flanged tray": Family(_rectangle(48, "quarter"), _MOONEY, scenes.flanged_tray, refinement=_NEAR),
    "Ogden cup": Family(_disc(60, "quarter"), "ogden", _cup),
    "free sphere, Ogden": Family(_sphere(64), "ogden", damped=False),
    "refined box, Yeoh": Family(_rectangle(48, "quarter"), "yeoh", _box, refinement=_NEAR),
    "free disc, Yeoh": Family(_disc(60, "quarter"), "yeoh", damped=False),
    "whole cup, Gent": Family(_disc(96, "none"), "gent", _cup),
    "free sphere, Gent": Family(_sphere(64), "gent"),
    "cup, Christensen": Family(_disc(60, "quarter"), _MOONEY, _cup, viscous="christensen"),
    "free sphere, Maxwell": Family(_sphere(64), _NEO, damped=False, viscous="maxwell"),
    "refined box, Maxwell": Family(_rectangle(48, "quarter"), _MOONEY, _box, refinement=_NEAR, viscous="maxwell"),
    "box in zones": Family(_rectangle(120, "none"), _MOONEY, _box, warm=True),
    "refined cup, warm": Family(_disc(24, "quarter"), _NEO, _cup, refinement=_FINER, viscous="christensen", warm=True),
    "cup, cooling": Family(_disc(60, "quarter"), _MOONEY, _cup, warm=True, cools=True),
    "free sphere, cooling": Family(_sphere(64), _NEO, damped=False, viscous="christensen", warm=True, cools=True),
    "refined box, cooling": Family(
        _rectangle(48, "quarter"), _MOONEY, _box, refinement=_NEAR, viscous="maxwell", warm=True, cools=True
    ),
    "hill, wrinkling": Family(_rectangle(80, "half"), _MODIFIED, _hill, wrinkles=True),
    "free sphere, wrinkling": Family(_sphere(64), "ogden", damped=False, wrinkles=True),
    "refined cup, wrinkling": Family(
        _disc(24, "quarter"), _NEO, _cup, refinement=_FINER, warm=True, cools=True, wrinkles=True
    ),
}
COOLING = tuple(name for name, family in FAMILIES.items() if family.cools or family.wrinkles)
STRANGERS = (*(name for name in FAMILIES if "flanged" in name), *scenes.OWN_MESHES)
FURTHER = tuple(
    name for name, family in FAMILIES.items() if family.law in ("ogden", "yeoh", "gent") and name not in COOLING
)
VISCOUS = tuple(
    name for name, family in FAMILIES.items() if (family.viscous is not None or family.warm) and name not in COOLING
)
NAMES = (*(name for name in FAMILIES if name not in (*STRANGERS, *FURTHER, *VISCOUS, *COOLING)), "file")
# The seeds before each keep the families that they had.
STRANGERS_FROM, FURTHER_FROM, VISCOUS_FROM, COOLING_FROM = 1200, 2000, 2400, 3000

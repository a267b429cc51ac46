"""Molds whose flange lies in the sheet's plane, or a rounding error beside it: is every run stable and right?

`python -m benchmarks.strangers.flanges` runs 60 of the 288 scenes that three molds, eight distances of the flange,
three widths of the sheet and four levels of refinement make, spread evenly over them; `--few` runs 12 and `--all`
runs all. A sheet that lies on the flange is held there, so the wall inside the opening is that of a sheet clamped along
the opening: a fine uniform mesh of that sheet, which meets no flange at all, is what each is compared with. No ring or
row of the sheets' nodes lies on the opening, so elements span its edge; up to half of one of them is drawn into the
cavity.
"""

from __future__ import annotations

import functools
import sys
import time
import warnings
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from scipy.spatial import KDTree

import jaxform
from benchmarks.strangers.scenes import tray
from jaxform import molds, shapes
from jaxform.mesh import topology
from jaxform.model.scene import Scene
from jaxform.results.result import Result
from jaxform.results.summary import measure_penetration, warnings_of_mold
from jaxform.tools.molds import MoldShape

DISTANCES = (0.0, 1e-9, -1e-9, 1e-6, -1e-6, 1e-5, 1e-4, 1e-3)
"""Distances of the flange from the sheet's plane, on the side that the pressure pushes to [m]."""
WIDTHS = ("wider", "equal", "narrower")
"""The sheet's, beside the flange's."""
LEVELS = (0, 2, 4, 6)
"""Levels of refinement; the coarser the first mesh, the higher."""
THICKNESS = 1.0e-3  # m
TOLERANCE = 0.01  # of the wall, rms
_STRIDE, _COUNT = 179, 60  # through all scenes: no two factors go together
_CORNER = 0.02  # of the arc, beside sharp edges of the mold, is left out
_SHARP = 20.0  # degrees
_FINE = 0.0006  # m, elements of what is compared with
_THICKER = 1.01  # how much thicker than the sheet a wall may be: nodes are put where edges meet the mold
_GRID = 300  # points along each side of the opening's quarter


@dataclass(frozen=True)
class Tool:
    """A mold with a flange at z = 0.

    Attributes:
        shape: The mold.
        opening: Radius, or half sides, of the opening [m].
        flange: The same of the flange.
        arc: Length [m] of the wall from the middle of the bottom to the opening.
        element_size: First elements [m] by level.
        pressure: At the end [Pa].
    """

    shape: MoldShape
    opening: tuple[float, ...]
    flange: tuple[float, ...]
    arc: float
    element_size: dict[int, float]
    pressure: float


class Case(NamedTuple):
    """One scene of the sweep."""

    mold: str
    distance: float
    width: str
    level: int


class Found(NamedTuple):
    """The outcome of a scene: status in words, rms of the wall [relative], and what else was wrong."""

    status: str
    rms: float
    thickest: float
    beyond: float
    warned: bool
    elements: int
    steps: int
    seconds: float

    @property
    def right(self) -> bool:
        """True if the run was stable and its wall is right."""
        return self.status == "ok" and self.rms <= TOLERANCE and self.thickest <= _THICKER and not self.warned


def cup() -> Tool:
    """A drawn cup of 96 facets: opening 75 mm, depth 72 mm."""
    profile = [[0.0, 0.072], [0.031, 0.072], [0.0375, 0.0], [0.06, 0.0]]
    sizes = {0: 0.0007, 2: 0.0014, 4: 0.0028, 6: 0.0052}
    return Tool(molds.revolved(profile=profile, segments=96), (0.0375,), (0.06,), 0.103, sizes, 4.0e4)


def beaded_cup() -> Tool:
    """A cup with a groove under its rim and a fillet at its bottom, in float32 millimetres, as an STL file has it."""
    bead, fillet = np.radians(np.linspace(-90, 90, 9)), np.radians(np.linspace(85, 0, 9))
    groove = np.column_stack([37.5 + 1.5 * np.cos(bead), 5.5 - 2.5 * np.sin(bead)])
    round_bottom = np.column_stack([29.0 + 2.0 * np.cos(fillet), 73.0 + 2.0 * np.sin(fillet)])
    bottom = np.column_stack([np.linspace(0.0, 28.0, 20), np.full(20, 75.0)])
    wall = np.linspace([31.0, 73.0], [37.5, 9.5], 40)[1:]
    flange = np.column_stack([np.linspace(37.5, 60.0, 9), np.zeros(9)])
    shape = molds.revolved(profile=np.concatenate([bottom, round_bottom, wall, groove, flange]), segments=96)
    vertices = 1e-3 * shape.vertices.astype(np.float32).astype(float)
    sizes = {0: 0.0006, 2: 0.0012, 4: 0.0024, 6: 0.0045}
    return Tool(MoldShape(vertices, shape.triangles), (0.0375,), (0.06,), 0.105, sizes, 4.0e4)


def box() -> Tool:
    """A tray of 18 triangles whose flange is four long trapezoids: opening 100 by 70 mm, depth 25 mm."""
    half = [(0.07, 0.055), (0.05, 0.035), (0.045, 0.030)]
    sizes = {0: 0.0007, 2: 0.0014, 4: 0.0028, 6: 0.0052}
    return Tool(tray(half, [0.0, 0.0, 0.025]), half[1], half[0], 0.07, sizes, 4.0e4)


TOOLS = {"cup": cup, "beaded cup": beaded_cup, "box": box}


@functools.cache
def tool(name: str) -> Tool:
    """A mold by name."""
    return TOOLS[name]()


def cases(count: int = _COUNT) -> list[Case]:
    """So many of all scenes, spread over them."""
    every = [Case(*case) for case in _product()]
    return [every[_STRIDE * k % len(every)] for k in range(min(count, len(every)))]


def _product() -> list[tuple[str, float, str, int]]:
    return [(m, d, w, n) for m in TOOLS for w in WIDTHS for n in LEVELS for d in DISTANCES]


def _sheet(extent: tuple[float, ...], element_size: float) -> shapes.Sheet:
    """The quarter of a sheet about the origin of that radius, or those half sides [m]."""
    if len(extent) == 1:
        return shapes.disc(radius=extent[0], element_size=element_size, symmetry="quarter")
    sheet = shapes.rectangle(size=[2 * side for side in extent], element_size=element_size, symmetry="quarter")
    # Turned about z, so that its symmetry planes go through the origin as a disc's do.
    turned = np.where(sheet.fixed[:, :2], 0.0, np.array(extent) - sheet.positions[:, :2])
    return shapes.Sheet(np.column_stack([turned, sheet.positions[:, 2]]), sheet.triangles, sheet.clamped, sheet.fixed)


def _extent(made: Tool, width: str) -> tuple[float, ...]:
    # The sheet's margin is a share of the flange's width, or lies beyond it.
    add = {"wider": 0.3, "equal": 0.0, "narrower": -0.35}[width]
    return tuple(f + add * (f - o) for f, o in zip(made.flange, made.opening, strict=True))


def _scene(sheet: shapes.Sheet, shape: MoldShape, pressure: float, name: str, **limits: Any) -> Scene:
    def real(value: float) -> jax.Array:
        return jnp.asarray(value, float)

    return jaxform.build_scene(
        parison=jaxform.make_parison(sheet.positions, sheet.triangles, THICKNESS, sheet.clamped, sheet.fixed),
        material=jaxform.MooneyRivlin(real(0.2e6), real(0.1), real(1050.0)),
        pressure=jaxform.make_pressure([0.0, 0.1], [0.0, pressure]),
        solver=jaxform.make_solver(end_time=0.11, damping=200.0),
        mold=jaxform.make_mold(shape.vertices, shape.triangles),
        refinement=jaxform.make_refinement(interval=64, **limits) if limits else None,
        name=name,
        fill=False,  # the walls at one pressure are compared
    )


def scene_of(case: Case) -> Scene:
    """The scene of a case.

    Raises:
        jaxform.InputError: If it is refused.
    """
    made = tool(case.mold)
    sheet = _sheet(_extent(made, case.width), made.element_size[case.level])
    shape = MoldShape(made.shape.vertices + np.array([0.0, 0.0, case.distance]), made.shape.triangles)
    limits: dict[str, Any] = {}
    if case.level:
        limits = {"angle": 4.0, "max_level": case.level, "base_level": case.level, "elements": 16384}
    return _scene(sheet, shape, made.pressure, " ".join(map(str, case)), **limits)


class Reference(NamedTuple):
    """Places inside the opening (n, 2) [m] and the wall there (n,) [m]."""

    place: np.ndarray
    wall: np.ndarray


@functools.cache
def reference(name: str) -> Reference:
    """The wall of a fine uniform sheet that is clamped along the opening; without what is beside sharp edges."""
    made = tool(name)
    corners = made.shape.vertices[made.shape.triangles]
    cavity = made.shape.triangles[corners[..., 2].max(1) > 1e-6]
    scene = _scene(_sheet(made.opening, _FINE), MoldShape(made.shape.vertices, cavity), made.pressure, name)
    result = jaxform.run(scene)
    assert int(result.status) == 0, jaxform.explain(result)
    share = (np.arange(_GRID) + 0.5) / _GRID
    x, y = np.meshgrid(*(share * side for side in (made.opening * 2)[:2]))
    place = np.column_stack([x.ravel(), y.ravel()])
    if len(made.opening) == 1:
        # The rim of the sheet is made of chords.
        place = place[np.hypot(*place.T) < 0.999 * made.opening[0]]
    wall, there = wall_at(scene, result, place)
    kept = _beside_edges(made, there) > _CORNER * made.arc
    return Reference(place[kept], wall[kept])


def _beside_edges(made: Tool, there: np.ndarray) -> np.ndarray:
    """Distances (n,) [m] of places (n, 3) from the mold's sharp edges."""
    ends = topology.feature_edges(made.shape.vertices, made.shape.triangles, _SHARP, rims=False)
    share = np.linspace(0.0, 1.0, 100)[:, None, None]
    return KDTree(((1 - share) * ends[:, 0] + share * ends[:, 1]).reshape(-1, 3)).query(there)[0]


def wall_at(scene: Scene, result: Result, place: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Thickness (n,) [m] at initial places (n, 2) [m], linear between nodes, and where these are now (n, 3) [m]."""
    from matplotlib.tri import Triangulation

    start, triangles = np.asarray(scene.parison.positions), np.asarray(result.triangles)[np.asarray(result.used)]
    found = np.asarray(Triangulation(start[:, 0], start[:, 1], triangles).get_trifinder()(*place.T), int)
    assert np.all(found >= 0), "a place is not in the sheet"
    inside = triangles[found]
    edges = (start[inside[:, 1:]] - start[inside[:, :1]])[..., :2]
    share = np.linalg.solve(edges.transpose(0, 2, 1), (place - start[inside[:, 0], :2])[..., None])[..., 0]
    weight = np.column_stack([1 - share.sum(1), share])
    there = np.einsum("nk,nkc->nc", weight, np.asarray(result.positions)[inside])
    return np.einsum("nk,nk->n", weight, np.asarray(result.thickness)[inside]), there


def examine(case: Case) -> Found:
    """Runs a case and compares its wall."""
    fine, began = reference(case.mold), time.perf_counter()
    try:
        scene = scene_of(case)
    except jaxform.InputError as problem:
        return Found(f"refused: {problem}", np.nan, np.nan, np.nan, False, 0, 0, time.perf_counter() - began)
    result = jaxform.run(scene)
    seconds = time.perf_counter() - began
    wall, _ = wall_at(scene, result, fine.place)
    beyond = measure_penetration(result, scene)
    used = np.asarray(result.used)
    return Found(
        jaxform.explain(result).split(";")[0],
        float(np.sqrt(np.mean(np.square(wall / fine.wall - 1)))),
        float(np.asarray(result.element_thickness)[used].max() / THICKNESS),
        beyond.elements,
        bool(warnings_of_mold(result, scene, beyond)),
        int(used.sum()),
        int(result.steps),
        seconds,
    )


def sweep(chosen: list[Case]) -> list[tuple[Case, Found]]:
    """Runs cases one after another in this process; a line each."""
    rows = []
    for case in chosen:
        found = examine(case)
        rows.append((case, found))
        print(
            f"{case.mold:10} {case.distance:7.0e} m, {case.width:8}, level {case.level}: "
            f"{'right' if found.right else 'WRONG'}, wall {100 * found.rms:.2f} % rms, thickest {found.thickest:.3f}, "
            f"beyond {1e3 * found.beyond:.3f} mm{' (warned)' if found.warned else ''}, {found.elements} elements, "
            f"{found.steps} steps, {found.seconds:.1f} s"
            + ("" if found.status == "ok" else f"; {found.status}"),
            flush=True,
        )  # fmt: skip
    return rows


def summary(rows: list[tuple[Case, Found]]) -> str:
    """The sweep in a line."""
    stable = [found for _, found in rows if found.status == "ok"]
    worst = max((found.rms for found in stable), default=np.nan)
    right = sum(found.right for _, found in rows)
    slowest = max(found.seconds for _, found in rows)
    return (
        f"{len(stable)} of {len(rows)} stable, worst rms {100 * worst:.2f} %, {right} of {len(rows)} right, "
        f"slowest scene {slowest:.1f} s"
    )


def main(options: list[str]) -> int:
    """Runs the sweep; 1 where a scene went wrong."""
    jax.config.update("jax_enable_x64", True)
    warnings.simplefilter("ignore")
    count = 12 if "--few" in options else len(_product()) if "--all" in options else _COUNT
    rows = sweep(cases(count))
    print(summary(rows))
    return int(not all(found.right for _, found in rows))


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))

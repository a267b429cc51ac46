"""Figures of contact: hits against brute force, what a step and the search structure cost, gradients, penetration.

Run it with `make contact`, or parts of it by name: `python -m benchmarks.speed.contact costs waffles`; it prints one
line per figure. Nothing here decides a test; the tests import what they check from here.
"""

from __future__ import annotations

import dataclasses
import functools
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import trimesh

import jaxform
from benchmarks.timing import best_in_turns, whole_loop
from jaxform import molds, shapes
from jaxform.contact import broad_phase, candidates, sticking
from jaxform.core.store import Store
from jaxform.dynamics import window
from jaxform.io import files
from jaxform.kernels.blocks import BLOCK
from jaxform.mechanics import membrane
from jaxform.mechanics.elements import Nodes
from jaxform.mesh import topology
from jaxform.model.scene import Scene
from jaxform.results.summary import measure_penetration
from jaxform.tools.mold import Mold
from jaxform.tools.search import SearchGrid, build_grid
from jaxform.tools.surface_walk import ContactSurface

BATCH = 128  # paths that are looked at together: few, so that all their pairs find room


def real(value: float) -> jax.Array:
    """A number as a leaf of a scene."""
    return jnp.asarray(value, float)


def mold_of(shape: molds.MoldShape) -> Mold:
    """The shape as a mold."""
    return jaxform.make_mold(shape.vertices, shape.triangles)


def mold_from_mesh(mesh: trimesh.Trimesh) -> Mold:
    """A mesh of the mesh library as a mold."""
    return jaxform.make_mold(np.asarray(mesh.vertices), np.asarray(mesh.faces))


MOLDS: dict[str, Callable[[], Mold]] = {
    "box-insert": lambda: mold_of(molds.box_insert()),
    "bottle-half": lambda: mold_of(molds.bottle_half()),
    "ribs": lambda: mold_of(
        molds.revolved(
            profile=[[0, 1], [0.3, 1], [0.31, 0.6], [0.4, 0.6], [0.41, 1.0], [0.9, 1.0], [1.0, 0.0]], segments=40
        )
    ),
    "icosphere": lambda: mold_from_mesh(trimesh.creation.icosphere(subdivisions=3)),
    "annulus": lambda: mold_from_mesh(trimesh.creation.annulus(r_min=0.3, r_max=1.0, height=0.2, sections=250)),
    "torus": lambda: mold_from_mesh(trimesh.creation.torus(1.0, 0.3, major_sections=400, minor_sections=250)),
}


class Paths(NamedTuple):
    """Results of random paths beside those of brute force."""

    triangles: int
    paths: int
    hits: int
    missed: int
    invented: int
    worst_beta: float
    worst_place: float


def random_paths(wall: Mold, grid: SearchGrid, count: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Begin and end (count, 3) of paths near the wall, about as many across it as not."""
    random = np.random.default_rng(seed)
    corners = np.asarray(wall.vertices)[np.asarray(wall.triangles)]
    on_wall = np.einsum(
        "ij,ijk->ik", random.dirichlet([1.0, 1.0, 1.0], count), corners[random.integers(len(corners), size=count)]
    )
    reach = float(grid.farthest)
    begin = on_wall + 0.4 * reach * random.uniform(-1, 1, (count, 3))
    path = random.normal(size=begin.shape)
    path *= reach * random.uniform(0.01, 1, (count, 1)) / np.linalg.norm(path, axis=1, keepdims=True)
    return begin, begin + path


@functools.partial(jax.jit, static_argnames="differentiable")
def walk(
    begin: jax.Array, end: jax.Array, wall: Mold, grid: SearchGrid, *, differentiable: bool = False
) -> tuple[sticking.Landing, jax.Array]:
    """One step of all nodes from begin to end (3, n), as a simulation takes it: the landing; is all well?"""
    count = begin.shape[1]
    begin, end = (jnp.pad(place, ((0, 0), (0, -count % BLOCK))) for place in (begin, end))
    stuck, way, once = jnp.arange(begin.shape[1]) >= count, end - begin, jnp.asarray(1.0)
    window = candidates.list_candidates(begin, way, ~stuck, once / 16, jnp.int32(16), grid)
    due = broad_phase.find_active_pairs(end, stuck, stuck, window, jnp.int32(stuck.size // BLOCK))[0]
    none, mass = jnp.zeros(stuck.size, jnp.int32), jnp.ones(stuck.size)
    nodes = Nodes(membrane.unstack_rows(end), way, stuck, -mass, none, None, {})
    flying = sticking.Landing(nodes, none, jnp.asarray(0.0), jnp.zeros((6, stuck.size)))
    now = sticking.ContactStep(once, once, jnp.int32(0))
    room = sticking.no_hits(stuck.size, end.dtype)
    landed, _ = sticking.apply_contact(
        flying, now, [due], (mass, None), [window], (ContactSurface(wall, grid),), [stuck], room
    )
    nodes = dataclasses.replace(landed.nodes, positions=jnp.asarray(landed.nodes.positions))
    landed = landed._replace(nodes=nodes)
    if differentiable:
        flying = flying._replace(nodes=dataclasses.replace(flying.nodes, positions=end))
        landed = sticking.apply_known_contact(
            flying, now, jnp.abs(landed.nodes.wall) - 1, (mass, None), (ContactSurface(wall, grid),)
        )
    well = ~(
        window.overflow
        | jnp.any(
            broad_phase.may_have_missed(end, stuck, broad_phase.list_spheres(window), broad_phase.initial_check())
        )
    )
    return jax.tree.map(lambda values: values[..., :count] if values.ndim else values, landed), well


@jax.jit
def brute_force(begin: jax.Array, end: jax.Array, corners: jax.Array) -> jax.Array:
    """Least beta (n,) of paths (n, 3) over all triangles (m, 3, 3), infinite where none is met: Eqs 11 and 12."""
    path = end - begin

    def nearer(least: jax.Array, corner: jax.Array) -> tuple[jax.Array, None]:
        # Cramer's rule on beta NN' + gamma DE + delta DF = DN' of one triangle with all paths.
        d, e, f = corner
        first, second, third, right = -path, e - d, f - d, begin - d
        across = jnp.cross(second, third)
        determinant = first @ across
        flat = determinant == 0.0
        scale = 1.0 / jnp.where(flat, 1.0, determinant)
        beta = (right @ across) * scale
        gamma = jnp.sum(first * jnp.cross(right, third), axis=1) * scale
        delta = jnp.sum(first * jnp.cross(second, right), axis=1) * scale
        hit = ~flat & (beta >= 0) & (beta <= 1) & (gamma >= 0) & (delta >= 0) & (gamma + delta <= 1)
        return jnp.minimum(least, jnp.where(hit, beta, jnp.inf)), None

    return jax.lax.scan(nearer, jnp.full(len(begin), jnp.inf), corners)[0]


def compare(wall: Mold, count: int, seed: int = 0) -> Paths:
    """Random paths through the search structure and by brute force."""
    grid = build_grid(np.asarray(wall.vertices), np.asarray(wall.triangles))
    begin, end = random_paths(wall, grid, -(-count // BATCH) * BATCH, seed)
    landed, stuck = np.empty_like(begin), np.empty(len(begin), bool)
    for first in range(0, len(begin), BATCH):
        part = slice(first, first + BATCH)
        landing, well = walk(jnp.asarray(begin[part].T), jnp.asarray(end[part].T), wall, grid)
        assert well, "the pairs did not find room"
        landed[part], stuck[part] = np.asarray(landing.nodes.positions).T, landing.nodes.stuck
    corners = wall.vertices[wall.triangles]
    least = np.concatenate(
        [
            np.asarray(brute_force(b, e, corners))
            for b, e in zip(*(np.array_split(x, 8) for x in (begin, end)), strict=True)
        ]
    )
    met, path = np.isfinite(least), end - begin
    both = met & stuck
    beta = np.einsum("ij,ij->i", landed - begin, path)[both] / np.einsum("ij,ij->i", path, path)[both]
    gap = np.linalg.norm(landed[both] - (begin + least[:, None] * path)[both], axis=1) / float(grid.size)
    worst = float(np.abs(beta - least[both]).max()), float(gap.max())
    return Paths(
        len(wall.triangles), len(begin), int(met.sum()), int((met & ~stuck).sum()), int((stuck & ~met).sum()), *worst
    )


def show_paths() -> None:
    """Hits of random paths, mold by mold."""
    for name, make in MOLDS.items():
        wall = make()
        found = compare(wall, 1_000_000 if len(wall.triangles) <= 2100 else 10_000)
        print(
            f"{name:12} {found.triangles:7} triangles, {found.paths:8} paths, {found.hits:7} hits: "
            f"{found.missed} missed, {found.invented} invented, beta within {found.worst_beta:.1e}, "
            f"place within {found.worst_place:.1e} of the size",
            flush=True,
        )


def bottle(mold: Mold | None, element_size: float = 0.0071) -> Scene:
    """Half a bottle's parison blown into a mold, or freely."""
    sheet = shapes.bottle_half(element_size=element_size)
    return jaxform.build_scene(
        parison=jaxform.make_parison(sheet.positions, sheet.triangles, 2.25e-3, sheet.clamped, sheet.fixed),
        material=jaxform.MooneyRivlin(real(0.2e6), real(0.5), real(1350.0)),
        pressure=jaxform.make_pressure([0.0, 0.1], [0.0, 2.0e5]),
        solver=jaxform.make_solver(end_time=0.12, damping=200.0),
        mold=mold,
        name="bottle",
    )


def box(mold: Mold | None, elements: int = 300) -> Scene:
    """A quarter of a sheet drawn over the box with an insert."""
    sheet = shapes.rectangle(size=[0.3, 0.2], elements=elements, symmetry="quarter")
    return jaxform.build_scene(
        parison=jaxform.make_parison(sheet.positions, sheet.triangles, 2.0e-3, sheet.clamped, sheet.fixed),
        material=jaxform.MooneyRivlin(real(0.2e6), real(0.1), real(1000.0)),
        pressure=jaxform.make_pressure([0.0, 0.2], [0.0, 2.0e4]),
        solver=jaxform.make_solver(end_time=0.24, damping=100.0),
        mold=mold,
        name="box",
    )


def step_times(scenes: dict[str, Scene], rounds: int = 7) -> dict[str, float]:
    """Microseconds per step of whole runs, compiled, the best of so many rounds; the scenes take turns."""
    loops = {name: whole_loop(scene) for name, scene in scenes.items()}
    seconds = best_in_turns(loops, rounds)
    return {name: 1e6 * seconds[name] / int(loop().steps) for name, loop in loops.items()}


def show_costs() -> None:
    """Time per step without mold, with the bottle's and with it in 200 000 triangles, and the builds."""
    shape = molds.bottle_half()
    fine = molds.divided(shape, 13)
    began = time.perf_counter()
    build_grid(fine.vertices, fine.triangles)
    print(f"search structure of {len(fine.triangles)} triangles: {time.perf_counter() - began:.1f} s")
    coarse_name, fine_name = (str(len(s.triangles)) for s in (shape, fine))
    scenes = {"none": bottle(None), coarse_name: bottle(mold_of(shape)), fine_name: bottle(mold_of(fine))}
    times = step_times(scenes)
    print(
        f"time per step, {len(scenes['none'].parison.triangles)} elements: {times['none']:.1f} us without mold, "
        f"{times[coarse_name]:.1f} us with {coarse_name} triangles ({times[coarse_name] / times['none']:.2f} x), "
        f"{times[fine_name]:.1f} us with {fine_name} ({times[fine_name] / times[coarse_name]:.2f} x that)",
        flush=True,
    )


WAFFLES = {2240: (40, 28), 19_992: (119, 84), 100_016: (266, 188), 200_032: (376, 266)}
"""Cells along both sides of the waffle mold, by its number of triangles."""

_SIDES = 0.16, 0.12  # of the sheet over it [m]


def waffle_mold(cells: tuple[int, int]) -> molds.MoldShape:
    """A mold of hills and hollows."""
    a, b = _SIDES
    x, y = np.meshgrid(*(np.linspace(-0.01, side + 0.01, n + 1) for side, n in zip((a, b), cells, strict=True)),
                       indexing="ij")  # fmt: skip
    rim = np.clip(5 * np.maximum(np.abs(2 * x / a - 1), np.abs(2 * y / b - 1)) - 4, 0.0, 1.0)
    height = (1 - rim) * (0.03 + 0.006 * np.cos(6 * np.pi * x / a) * np.cos(4 * np.pi * y / b))
    number = np.arange(x.size).reshape(x.shape)
    corner = number[:-1, :-1].ravel(), number[1:, :-1].ravel(), number[1:, 1:].ravel(), number[:-1, 1:].ravel()
    triangles = np.concatenate([np.stack([corner[k] for k in three], 1) for three in ((0, 1, 2), (0, 2, 3))])
    vertices = np.stack([x, y, height], -1).reshape(-1, 3).astype(np.float32)  # as an STL has them
    return molds.MoldShape(vertices.astype(float), triangles.astype(np.int32))


def waffle(mold: molds.MoldShape, *, refined: bool) -> Scene:
    """A sheet drawn onto a mold of hills and hollows, meshed finely or coarsely."""
    sheet = shapes.rectangle(size=_SIDES, element_size=0.005 if refined else 0.0025)
    refinement = jaxform.make_refinement(angle=12.0, interval=100, max_level=4, elements=16384) if refined else None
    return jaxform.build_scene(
        parison=jaxform.make_parison(sheet.positions, sheet.triangles, 1.0e-3, sheet.clamped, sheet.fixed),
        material=jaxform.MooneyRivlin(real(0.2e6), real(0.1), real(1000.0)),
        pressure=jaxform.make_pressure([0.0, 0.3], [0.0, 3.0e4], "cubic-ramp"),
        solver=jaxform.make_solver(end_time=0.32, damping=100.0),
        mold=mold_of(mold),
        refinement=refinement,
    )


def show_waffles(rounds: int = 5) -> None:
    """Time per step and of the whole run on finer and finer molds, and how many windows are cut short.

    A refined sheet has more elements on a finer mold, which shows more of the waves. Where that mold is the coarsest
    one with its triangles divided, the sheet is the same: what is left is what the triangles cost.
    """
    finer = {count: waffle_mold(cells) for count, cells in WAFFLES.items()}
    coarsest = finer[min(finer)]
    same = [molds.divided(coarsest, parts) for parts in (1, 3, 7, 9)]
    one_surface = {len(shape.triangles): shape for shape in same}
    for words, shapes_of, refined in (
        ("uniform", finer, False),
        ("refined", finer, True),
        ("refined, one surface", one_surface, True),
    ):
        loops = {count: whole_loop(waffle(shape, refined=refined)) for count, shape in shapes_of.items()}
        seconds = best_in_turns({str(count): loop for count, loop in loops.items()}, rounds)
        first = min(loops)
        per_step = {count: seconds[str(count)] / int(loop().steps) for count, loop in loops.items()}
        for count, loop in loops.items():
            state = loop()
            print(
                f"waffle, {words}, {count} triangles: {1e6 * per_step[count]:.1f} us per "
                f"step ({per_step[count] / per_step[first]:.2f} x), run {seconds[str(count)]:.3f} s "
                f"({seconds[str(count)] / seconds[str(first)]:.2f} x), {int(state.steps)} steps, "
                f"{int(state.windows)} windows, {int(state.shortened)} shortened, status {int(state.status)}",
                flush=True,
            )


def wall_gradient(scene: Scene, seed: int = 0) -> tuple[float, list[float]]:
    """Derivative of a smooth measure of the wall along a random thickness direction, and its differences' deviations.

    The deviations, relative, are of central differences over 1e-4 to 1e-8 of the thickness.
    """
    thickness = scene.parison.thickness
    direction = thickness * np.random.default_rng(seed).uniform(0.5, 1.0, thickness.shape)

    def measure(thickness: jax.Array) -> jax.Array:
        result = jaxform.simulate(jaxform.replace(scene, {"parison.thickness": thickness}))
        return jnp.mean(jnp.square(result.thickness / jnp.mean(scene.parison.thickness)))

    both = jax.jit(jax.value_and_grad(measure))  # a program for the value alone would take longer to compile
    slope = float(jnp.vdot(both(thickness)[1], direction))
    deviations = []
    for size in (1e-4, 1e-5, 1e-6, 1e-7, 1e-8):
        up, down = (float(both(thickness + sign * size * direction)[0]) for sign in (1, -1))
        deviations.append(abs((up - down) / (2 * size) / slope - 1))
    return slope, deviations


def show_gradients() -> None:
    """Gradients through contact on the box and on the bottle against central differences."""
    for scene in (box(mold_of(molds.box_insert())), bottle(mold_of(molds.bottle_half()))):
        slope, deviations = wall_gradient(scene)
        words = ", ".join(f"{deviation:.1e}" for deviation in deviations)
        print(f"{scene.name}: gradient {slope:.6g}, differences over 1e-4 ... 1e-8 deviate by {words}", flush=True)


def show_penetration() -> None:
    """Prints how far nodes and elements are beyond the mold in each scene."""
    scenes = [jaxform.load(name) for name in ("bowl", "dish-coarse", "dish")]
    scenes += [box(mold_of(molds.box_insert()), elements) for elements in (150, 600, 2400)]
    scenes += [bottle(mold_of(molds.bottle_half()), size) for size in (0.0071, 0.004)]
    for scene in scenes:
        result = jaxform.run(scene)
        assert scene.tables.grid is not None
        beyond = measure_penetration(result, scene)
        print(
            f"{scene.name}: {len(scene.parison.triangles)} elements, {jaxform.explain(result)}: nodes beyond the mold "
            f"by {beyond.nodes / float(scene.tables.grid.size):.1e} of its size, "
            f"elements by {1e3 * beyond.elements:.3g} mm",
            flush=True,
        )


def sampled_depths(scene: Scene, result: jaxform.Result, divisions: int = 8) -> np.ndarray:
    """Depth [m] of the deepest of some points of each element (n_element,) in the mold, whose triangles may be turned.

    It shares no code with `measure_penetration`: the nearest place of each triangle, and the side of the normals there.
    Points whose nearest place is on the rim of an open mold are left out.
    """
    assert scene.mold is not None
    start = np.asarray(scene.parison.positions)[~np.asarray(scene.parison.clamped)]
    mold = mold_towards(np.asarray(scene.mold.vertices), np.asarray(scene.mold.triangles), start)
    shares = np.array([[divisions - i - j, i, j] for i in range(divisions + 1) for j in range(divisions + 1 - i)])
    corners = np.asarray(result.positions)[np.asarray(result.triangles)]
    points = np.einsum("pc,eck->epk", shares / divisions, corners).reshape(-1, 3)
    depth = np.nan_to_num(-signed_distances(mold, points, len(shares)), nan=-np.inf)
    return depth.reshape(len(corners), -1).max(1)


def mold_towards(vertices: np.ndarray, triangles: np.ndarray, points: np.ndarray) -> trimesh.Trimesh:
    """The mold with triangles turned so that normals face points (n, 3) [m], those of the sheet before it moves.

    The triangles of a piece are turned alike from one to the next across the sides that two of them share. The side of
    a piece is that of the point which is the farthest from it, of those whose nearest place is not on its rim.
    """
    mold = trimesh.Trimesh(vertices, triangles, process=False)
    mold.merge_vertices()
    piece, turn = topology.orientations(np.asarray(mold.faces))
    faces = np.where(turn[:, None] < 0, mold.faces[:, ::-1], mold.faces)
    for own in (piece == number for number in np.unique(piece)):
        away = np.nan_to_num(signed_distances(trimesh.Trimesh(mold.vertices, faces[own], process=False), points))
        if away[np.abs(away).argmax()] < 0.0:
            faces[own] = faces[own, ::-1]
    return trimesh.Trimesh(mold.vertices, faces, process=False)


def signed_distances(mold: trimesh.Trimesh, points: np.ndarray, together: int = 64) -> np.ndarray:
    """Distances [m] of points (n, 3), positive on the side of the normals; NaN where the nearest place is on a rim."""
    triangle, place = nearest_triangles(mold, points, together)
    weight = trimesh.triangles.points_to_barycentric(mold.triangles[triangle], place)
    on_corner, normals = weight < 1e-7, mold.face_normals
    side, count = np.unique(mold.edges_sorted, axis=0, return_inverse=True, return_counts=True)[1:]
    side = side.reshape(-1, 3)  # the side k begins at the corner k
    by_side, by_vertex = np.zeros((len(count), 3)), np.zeros(mold.vertices.shape)
    np.add.at(by_side, side, normals[:, None])
    np.add.at(by_vertex, mold.faces, normals[:, None] * mold.face_angles[..., None])
    is_rim = np.zeros(len(mold.vertices), bool)
    is_rim[mold.edges[count[side.ravel()] == 1]] = True
    own_side = side[triangle, (on_corner.argmax(1) + 1) % 3]
    vertex = mold.faces[triangle, weight.argmax(1)]
    zeros = on_corner.sum(1)[:, None]
    normal = np.where(zeros == 0, normals[triangle], np.where(zeros == 1, by_side[own_side], by_vertex[vertex]))
    at_rim = np.where(zeros[:, 0] == 0, False, np.where(zeros[:, 0] == 1, count[own_side] == 1, is_rim[vertex]))
    away = points - place
    signed = np.sign(np.einsum("ij,ij->i", away, normal)) * np.linalg.norm(away, axis=1)
    return np.where(at_rim, np.nan, signed)


def nearest_triangles(mold: trimesh.Trimesh, points: np.ndarray, together: int) -> tuple[np.ndarray, np.ndarray]:
    """The triangles (n,) nearest to points (n, 3) [m], and the nearest places (n, 3), by comparison with all near ones.

    Of so many points together, in a sphere of radius r, none is nearest to a triangle that is farther from the centre
    by more than 2 r than the nearest one.
    """
    triangle, place = np.zeros(len(points), int), np.zeros_like(points)
    for first in range(0, len(points), together):
        own = points[first : first + together]
        centre = 0.5 * (own.min(0) + own.max(0))
        radius = np.linalg.norm(own - centre, axis=1).max()
        far = np.linalg.norm(_closest(mold.triangles, centre[None])[:, 0] - centre, axis=1)
        near = np.flatnonzero(far <= (far.min() + 2.0 * radius) * (1.0 + 1e-9))
        found = _closest(mold.triangles[near], own)
        best = np.linalg.norm(found - own, axis=2).argmin(0)
        triangle[first : first + together] = near[best]
        place[first : first + together] = found[best, np.arange(len(own))]
    return triangle, place


def _closest(triangles: np.ndarray, points: np.ndarray) -> np.ndarray:
    """The places (m, n, 3) on triangles (m, 3, 3) nearest to points (n, 3) [m]."""
    pairs = np.repeat(triangles, len(points), axis=0), np.tile(points, (len(triangles), 1))
    return trimesh.triangles.closest_point(*pairs).reshape(len(triangles), -1, 3)


_RIBBED = [[0.0, 0.05], [0.015, 0.05], [0.0155, 0.03], [0.0205, 0.03], [0.021, 0.05], [0.045, 0.05], [0.05, 0.0]]
_RIBBED_SCENE = {
    "parison": {"shape": "disc", "radius": 0.05, "elements": 300, "thickness": 1e-3},
    "material": {"model": "mooney-rivlin", "c": 2e5, "alpha": 0.1, "density": 1000.0},
    "pressure": {"time": [0.0, 0.1], "value": [0.0, 1e5]},
    "mold": {"shape": "revolved", "profile": _RIBBED, "segments": 48, "fill": False},
    "solver": {"end_time": 0.12, "damping": 100.0},
}


def show_edges(elements: int = 2500) -> None:
    """Prints how deep elements cut molds with sharp edges, by sampled points, with edge contact and adapted in a pass.

    Asked: box 0.3 mm, bottle 0.2 mm, ribbed cup its wall.
    """
    documents = {name: files.read_scene(name) for name in ("box-uniform", "soap-bottle")}
    documents["ribbed cup"] = files.validate_scene(_RIBBED_SCENE, "ribbed cup", Path.cwd())
    for name, document in documents.items():
        for adapt in (None, {"elements": elements, "passes": 1}):
            parison = document.data["parison"] | ({} if adapt is None else {"adapt": adapt})
            changed = {"parison": parison, "solver": document.data["solver"] | {"edge_contact": True}}
            scene = files.build(files.validate_scene(document.data | changed, document.file, document.folder))
            result = jaxform.run(scene)
            depth, wall = sampled_depths(scene, result), np.asarray(result.element_thickness)
            deepest = int(depth.argmax())
            print(
                f"{name}, {len(depth)} elements, {'uniform' if adapt is None else 'adapted'}: "
                f"{1e3 * depth[deepest]:.3f} mm deep, where the wall is {1e3 * wall[deepest]:.3f} mm; "
                f"{int((depth > wall).sum())} elements deeper than their wall; {int(result.steps)} steps",
                flush=True,
            )


def show_held(elements: int = 2500) -> None:
    """Prints what a run takes in which many sides are held, with an inverse for their forces and with the diagonal."""
    document = files.validate_scene(_RIBBED_SCENE, "ribbed cup", Path.cwd())
    parison = document.data["parison"] | {"adapt": {"elements": elements}}
    changed = {"parison": parison, "solver": document.data["solver"] | {"edge_contact": True}}
    scene = files.build(files.validate_scene(document.data | changed, document.file, document.folder))
    stores, walls, inverted = {"the inverse": Store(), "the diagonal": Store()}, [], window.invert_at_begin
    try:
        for name, store in stores.items():
            jax.clear_caches()
            window.invert_at_begin = inverted if name == "the inverse" else lambda *_: None
            result = jaxform.run(scene, store=store)
            walls.append(np.asarray(result.element_thickness))
        runs = {name: functools.partial(_run_whole, scene, store) for name, store in stores.items()}
        times = best_in_turns(runs, rounds=3)
    finally:
        window.invert_at_begin = inverted
    print(
        f"ribbed cup, {len(walls[0])} elements, {int(result.held_sides or 0)} held sides, {int(result.steps)} steps: "
        f"{times['the inverse']:.2f} s with the inverse, {times['the diagonal']:.2f} s with the diagonal; walls differ "
        f"by {np.abs(walls[1] / walls[0] - 1).max():.1e}",
        flush=True,
    )


def _run_whole(scene: Scene, store: Store) -> None:
    np.asarray(jaxform.run(scene, store=store).positions)


def same_part(scene: Callable[[Mold], Scene], coarse: molds.MoldShape, fine: molds.MoldShape) -> float:
    """Largest difference of the wall, relative, between runs with two meshes of one mold."""
    walls = [np.asarray(jaxform.run(scene(mold_of(shape))).thickness) for shape in (coarse, fine)]
    return float(np.abs(walls[1] / walls[0] - 1).max())


def show_finer_molds() -> None:
    """The same part against a mold meshed twice as fine, with the same surface and with a rounder one."""
    block, half = molds.box_insert(), molds.bottle_half()
    finer = molds.bottle_half(element_size=0.5 * 0.00595)
    print(f"box, flat facets divided: wall within {same_part(box, block, molds.divided(block, 2)):.1e}")
    print(f"bottle, flat facets divided: wall within {same_part(bottle, half, molds.divided(half, 2)):.1e}")
    walls = [np.asarray(jaxform.run(bottle(mold_of(shape))).thickness) for shape in (half, finer)]
    spread = np.sqrt(np.mean(np.square(walls[1] / walls[0] - 1)))
    print(
        f"bottle, {len(half.triangles)} and {len(finer.triangles)} triangles on the round shape: rms {spread:.1e}",
        flush=True,
    )


PARTS: dict[str, Callable[[], None]] = {
    "costs": show_costs,
    "waffles": show_waffles,
    "paths": show_paths,
    "gradients": show_gradients,
    "penetration": show_penetration,
    "edges": show_edges,
    "held": show_held,
    "finer": show_finer_molds,
}


def main(names: list[str]) -> int:
    """Prints the named figures, or all."""
    jax.config.update("jax_enable_x64", True)
    for name in names or PARTS:
        PARTS[name]()
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))

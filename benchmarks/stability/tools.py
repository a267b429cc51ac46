"""Random scenes with one to four tools that move through a sheet: whether a node ever is beyond one.

`python -m benchmarks.stability.tools [COUNT]` runs so many scenes of each kind (125, so 500 in all, about ten minutes)
and prints how deep the deepest node is in any tool at the end, and how the runs ended. Tools are closed and convex
(balls, boxes, rods, turned at random, their triangles of either orientation), so that depths are exact.
"""

from __future__ import annotations

import sys
import time
import warnings
from collections import Counter
from typing import NamedTuple

import jax
import numpy as np
import trimesh
from numpy.random import Generator
from numpy.typing import NDArray

import jaxform
from jaxform import shapes
from jaxform.core.pytree import as_real

Array = NDArray[np.float64]
KINDS = ("c", "cc", "sfc", "cscf")
"""Contact laws of the tools of a scene: c with friction, f without, s sticks. A kind is compiled once."""
_PLACES = [(0.5, 0.5), (1.5, 0.5), (0.5, 1.5), (1.5, 1.5)]  # so far apart that tools do not meet


def _body(rng: Generator, size: float) -> tuple[Array, NDArray[np.int64]]:
    """Vertices (n, 3) and triangles of a convex body about the origin."""
    bodies = (
        lambda: trimesh.creation.icosphere(2, 1.0),
        lambda: trimesh.creation.box((1.6, 1.6, 1.6)),
        lambda: trimesh.creation.cylinder(0.8, 1.6, sections=16),
    )
    made = bodies[rng.integers(len(bodies))]()
    turn = trimesh.transformations.random_rotation_matrix(rng.random(3))[:3, :3]
    triangles = np.array(made.faces)
    turned = rng.random(len(triangles)) < 0.5
    triangles[turned] = triangles[turned][:, ::-1]
    return size * np.asarray(made.vertices) @ turn.T, triangles


def depth(places: Array, tool: jaxform.Mold, time: float) -> Array:
    """Depths (n,) [m] of places (n, 3) [m] in a convex tool at a time [s]; negative outside."""
    vertices, triangles = tool.vertices_at(time), np.asarray(tool.triangles)
    corners, middle = vertices[triangles], vertices.mean(0)
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normal /= np.linalg.norm(normal, axis=1)[:, None]
    normal *= np.sign(np.einsum("ij,ij->i", normal, corners[:, 0] - middle))[:, None]
    return np.min(np.einsum("ij,ij->i", normal, corners[:, 0])[None] - places @ normal.T, axis=1)


def scene(seed: int, kind: str) -> jaxform.Scene:
    """A square sheet and tools from either side of it, that go through its plane and part of the way back."""
    rng = np.random.default_rng(seed)
    sheet = shapes.rectangle(size=[2.0, 2.0], elements=int(rng.integers(120, 260)))
    thin, end, tools = 10 ** rng.uniform(-2.5, -1.7), rng.uniform(4.0, 15.0), []
    laws = {
        "c": lambda: jaxform.make_contact_law("coulomb", rng.uniform(0.0, 1.0) * (rng.random() < 0.8)),
        "f": lambda: jaxform.make_contact_law("slide"),
        "s": lambda: jaxform.make_contact_law("stick"),
    }
    for place, law in zip(rng.permutation(_PLACES), kind, strict=False):
        vertices, triangles = _body(rng, rng.uniform(0.12, 0.25))
        up, gap = rng.choice([-1, 1]), rng.uniform(0.0, 0.3)
        vertices = vertices + np.append(place, -up * (np.abs(vertices[:, 2]).max() + gap))
        way = np.array([rng.uniform(-0.2, 0.2), rng.uniform(-0.2, 0.2), up])
        times, far = [0.0, rng.uniform(0.3, 0.8) * end, end], rng.uniform(0.0, 0.9)
        motion = jaxform.make_motion(way, times, [0.0, far, far * rng.uniform(0.0, 1.0)])
        tools.append(jaxform.make_mold(vertices, triangles, motion=motion, contact=laws[law]()))
    pressure = jaxform.make_pressure([0.0, end * rng.uniform(0.2, 1.0)], [0.0, rng.uniform(-3.0, 3.0) * thin])
    return jaxform.build_scene(
        parison=jaxform.make_parison(sheet.positions, sheet.triangles, thin, sheet.clamped, sheet.fixed),
        material=jaxform.MooneyRivlin(as_real(1.0), as_real(0.1), as_real(1.0)),
        pressure=pressure,
        solver=jaxform.make_solver(end_time=end, damping=rng.uniform(0.3, 3.0)),
        tools=tools,
        fill=False,
    )


def deepest(made: jaxform.Scene, result: jaxform.Result) -> float:
    """The depth [m] of the deepest node in any tool; negative where none is in one."""
    places = np.asarray(result.positions)[np.asarray(result.active)]
    return max(float(depth(places, tool, float(result.time)).max()) for tool in made.tools)


class Campaign(NamedTuple):
    """The depth [m] of the deepest node in any tool, negative where none is in one, and each run's energy balance."""

    deepest: float
    balance: list[float]


def measure(count: int) -> Campaign:
    """Runs so many scenes of each kind; says how they ended, and each that did not end well."""
    worst, balance, begun = -np.inf, [], time.perf_counter()
    for kind in KINDS:
        endings: Counter[str] = Counter()
        for seed in range(count):
            made = scene(seed, kind)
            result = jaxform.run(made)
            endings[jaxform.explain(result).split(";")[0].split(", but")[0]] += 1
            deep, error = deepest(made, result), float(result.energy.balance_error)
            worst = max(worst, deep)
            balance.append(error)
            if deep > 1e-9 or int(result.status):
                _say(f"{kind} {seed}: {jaxform.explain(result)}; deepest {deep:.2g} m, balance {error:.2g}")
        seconds = time.perf_counter() - begun
        _say(f"{len(kind)} tools ({kind}): {dict(endings)}; deepest node {worst:.2g} m; {seconds:.0f} s")
    return Campaign(worst, balance)


def _say(words: str) -> None:
    print(words, file=sys.stderr, flush=True)


def main(count: int) -> int:
    """Runs so many scenes of each kind and prints what was found; 1 if a node is beyond a tool."""
    jax.config.update("jax_enable_x64", True)
    warnings.simplefilter("ignore")
    found = measure(count)
    print(f"deepest node {found.deepest:.2g} m")
    print(f"energy balance: median {np.median(found.balance):.2g}, largest {max(found.balance):.2g}")
    return int(found.deepest > 1e-9)


if __name__ == "__main__":
    sys.exit(main(int(sys.argv[1]) if len(sys.argv) > 1 else 125))

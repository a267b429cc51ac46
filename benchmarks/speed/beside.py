"""Times of a command beside the steps, in seconds: load, check, penetration, VTU and pictures of large sheets.

And of molds of 100 000 triangles of any shape: slivers as long as the wall, a fan of them from one vertex, small ones
all over; and of a sheet that burst.
"""

from __future__ import annotations

import dataclasses
import sys
import tempfile
import time
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import numpy as np

import jaxform
from jaxform.cli import check_command
from jaxform.core.store import Store
from jaxform.io import files, output, plots
from jaxform.mesh import meshes
from jaxform.results.filling import measure_filling
from jaxform.results.part import warnings_of_part
from jaxform.results.summary import measure_penetration
from jaxform.runs import padding
from jaxform.tools.molds import MoldShape, revolved

SIZES = (100_000, 400_000)  # elements
MOLDS = (300, 200_000)  # triangles
_LIMITS = {100_000: 5.0, 400_000: 20.0}  # seconds, of all together
_ANY, _ASKED = 6000, 5.0  # elements of the sheet over molds of any shape, and the seconds asked for
_THROWN = 0.03  # m, how far the nodes of a sheet that burst are thrown about


def cup(triangles: int) -> MoldShape:
    """A conical cup of about so many triangles under a disc of radius 0.1 m."""
    stretches = max(1, round(np.sqrt(triangles / 300)))
    radius = np.concatenate([np.linspace(0, 0.055, stretches + 1), np.linspace(0.055, 0.1, stretches + 1)[1:]])
    profile = np.stack([radius, np.interp(radius, [0.055, 0.1], [0.05, 0.0])], axis=1)
    return revolved(profile=profile, segments=round(triangles / (4 * stretches - 1)))


def turn_mold(triangles: int) -> MoldShape:
    """A cup with a thin wall as CAD writes it: fine at the lip, slivers as long as the wall."""
    angle = np.linspace(0, np.pi, 10)
    lip = np.stack([0.0975 - 0.0025 * np.cos(angle), -0.0025 * np.sin(angle)], axis=1)
    profile = np.concatenate([[[0.0, 0.08], [0.07, 0.08]], lip, [[0.072, 0.083], [0.0, 0.083]]])
    return revolved(profile=profile, segments=round(triangles / (2 * len(profile) - 4)))


def fan(triangles: int) -> MoldShape:
    """Slivers from one vertex all around."""
    return revolved(profile=np.array([[0.0, 0.05], [0.1, 0.0]]), segments=triangles)


def dome(triangles: int) -> MoldShape:
    """Half a flattened ball, of about equal triangles."""
    stretches = max(2, round(np.sqrt(triangles / 4)))
    angle = np.linspace(0.0, 0.5 * np.pi, stretches + 1)
    return revolved(profile=np.stack([0.1 * np.sin(angle), 0.06 * np.cos(angle)], axis=1), segments=2 * stretches)


def burst(result: jaxform.Result) -> jaxform.Result:
    """A part whose nodes within its rim are thrown about, as those of a sheet that burst."""
    positions = np.array(result.positions)
    inside = np.hypot(*positions[:, :2].T) < 0.08
    positions[inside] += np.random.default_rng(0).normal(scale=_THROWN, size=(int(inside.sum()), 3))
    return dataclasses.replace(result, positions=jax.numpy.asarray(positions))


SCENE = """
[parison]
shape = "disc"
radius = 0.1
elements = {elements}
thickness = 1.0e-3
[material]
model = "mooney-rivlin"
c = 0.2e6
alpha = 0.1
density = 1000.0
[pressure]
time = [0.0, {rise}]
value = [0.0, 2.0e4]
[mold]
shape = "file"
path = "{mold}"
scale = {scale}
[solver]
end_time = {end}
damping = 100.0
"""


def run_timed(what: str, work: Callable[[], Any]) -> tuple[Any, float]:
    """The result of the work, and its time [s], which is printed."""
    begin, used = time.perf_counter(), time.process_time()
    found = work()
    seconds, used = time.perf_counter() - begin, time.process_time() - used
    print(f"  {what}: {seconds:.2f} s, {used:.2f} s of processors", flush=True)
    return found, seconds


def show(
    elements: int,
    shape: MoldShape,
    folder: Path,
    end: float | None = None,
    become: Callable[[jaxform.Result], jaxform.Result] = lambda result: result,
) -> None:
    """Prints the seconds of each part for a sheet and a mold; the run itself, of a few steps or to an end, is none."""
    mold = folder / "mold.vtu"
    meshes.write_vtu(mold, shape.vertices, shape.triangles)
    scene_file = folder / "scene.toml"
    rise, end = (1e-4, 3e-2 / np.sqrt(elements)) if end is None else (0.8 * end, end)
    scene_file.write_text(SCENE.format(elements=elements, mold=mold, scale=1.0, rise=rise, end=end))
    document = files.read_scene(scene_file)
    scene, load = run_timed("load", lambda: files.build(document))
    assert scene.mold is not None
    print(f"  {len(scene.parison.triangles)} elements, {len(scene.mold.triangles)} mold triangles", flush=True)
    _, check = run_timed("check, beside loading", lambda: list(check_command.scene_lines(document, scene, Store())))
    _, roomy = run_timed("padded arrays", lambda: padding.pad_to_bucket(scene, recorded=True))
    result = become(jaxform.run(scene))
    _, through = run_timed("penetration", lambda: measure_penetration(result, scene))
    _, apart = run_timed("gaps", lambda: measure_filling(result, scene))
    _, told = run_timed("warnings", lambda: warnings_of_part(result, scene))
    _, written = run_timed("VTU", lambda: output.write_part(scene, result, folder / "final.vtu"))
    _, drawn = run_timed("pictures", lambda: plots.thickness_picture(folder / "thickness.png", scene, result, None))
    total = load + check + roomy + through + apart + told + written + drawn
    limit = _LIMITS.get(elements, _ASKED)
    asked = f" (asked: {limit:g} s)" if len(scene.mold.triangles) > 300 or elements in _LIMITS else ""
    print(f"  together: {total:.2f} s{asked}", flush=True)


_CASES: list[tuple[str, Callable[[int], MoldShape], Callable[[jaxform.Result], jaxform.Result]]] = [
    ("a turned cup of slivers", turn_mold, lambda result: result),
    ("a fan of slivers", fan, lambda result: result),
    ("a dome", dome, lambda result: result),
    ("a burst sheet over a dome", dome, burst),
]


def main() -> int:
    """Prints all; the first is a small sheet, which pays for the libraries."""
    jax.config.update("jax_enable_x64", True)
    warnings.simplefilter("ignore")
    print("200 elements, a mold of 300 triangles:", flush=True)
    with tempfile.TemporaryDirectory() as folder:
        show(200, cup(300), Path(folder))
    for name, make, become in _CASES:
        print(f"{_ANY} elements, {name} of 100 000 triangles:", flush=True)
        with tempfile.TemporaryDirectory() as folder:
            show(_ANY, make(100_000), Path(folder), end=0.1, become=become)
    for elements in SIZES:
        for triangles in MOLDS:
            print(f"{elements} elements, a mold of {triangles} triangles:", flush=True)
            with tempfile.TemporaryDirectory() as folder:
                show(elements, cup(triangles), Path(folder))
    return 0


if __name__ == "__main__":
    sys.exit(main())

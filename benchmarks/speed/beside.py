"""What a command does beside the steps, in seconds: load, check, penetration, VTU and pictures of large sheets."""

from __future__ import annotations

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
from jaxform.cli import checking
from jaxform.core.store import Store
from jaxform.io import files, output, plots
from jaxform.mesh import meshes
from jaxform.results.filling import filling_of
from jaxform.results.review import warnings_of_part
from jaxform.results.summary import penetrated
from jaxform.runs import padding
from jaxform.tools.molds import MoldShape, revolved

SIZES = (100_000, 400_000)  # elements
MOLDS = (300, 200_000)  # triangles
_LIMITS = {100_000: 5.0, 400_000: 20.0}  # seconds, of all together


def cup(triangles: int) -> MoldShape:
    """A conical cup of about so many triangles under a disc of radius 0.1 m."""
    stretches = max(1, round(np.sqrt(triangles / 300)))
    radius = np.concatenate([np.linspace(0, 0.055, stretches + 1), np.linspace(0.055, 0.1, stretches + 1)[1:]])
    profile = np.stack([radius, np.interp(radius, [0.055, 0.1], [0.05, 0.0])], axis=1)
    return revolved(profile=profile, segments=round(triangles / (4 * stretches - 1)))


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


def timed(what: str, work: Callable[[], Any]) -> tuple[Any, float]:
    """What the work gives, and its seconds, which are printed."""
    begin = time.perf_counter()
    found = work()
    seconds = time.perf_counter() - begin
    print(f"  {what}: {seconds:.2f} s", flush=True)
    return found, seconds


def show(elements: int, triangles: int, folder: Path) -> None:
    """Prints the seconds of each part for a sheet and a mold; the run itself, of a few steps, does not count."""
    shape = cup(triangles)
    mold = folder / "mold.vtu"
    meshes.write_vtu(mold, shape.vertices, shape.triangles)
    scene_file = folder / "scene.toml"
    scene_file.write_text(
        SCENE.format(elements=elements, mold=mold, scale=1.0, rise=1e-4, end=3e-2 / np.sqrt(elements))
    )
    document = files.read_scene(scene_file)
    scene, load = timed("load", lambda: files.build(document))
    assert scene.mold is not None
    print(f"  {len(scene.parison.triangles)} elements, {len(scene.mold.triangles)} mold triangles", flush=True)
    _, check = timed("check, beside loading", lambda: list(checking.scene_lines(document, scene, Store())))
    _, roomy = timed("arrays of their rungs", lambda: padding.on_rungs(scene, recorded=True))
    result = jaxform.run(scene)
    _, through = timed("penetration", lambda: penetrated(result, scene))
    _, apart = timed("gaps", lambda: filling_of(result, scene))
    _, told = timed("warnings", lambda: warnings_of_part(result, scene))
    _, written = timed("VTU", lambda: output.write_part(scene, result, folder / "final.vtu"))
    _, drawn = timed("pictures", lambda: plots.thickness_picture(folder / "thickness.png", scene, result, None))
    total = load + check + roomy + through + apart + told + written + drawn
    asked = f" (asked: {_LIMITS[elements]:g} s)" if elements in _LIMITS else ""
    print(f"  together: {total:.2f} s{asked}", flush=True)


def main() -> int:
    """Prints all; the first is a small sheet, which pays for the libraries."""
    jax.config.update("jax_enable_x64", True)
    warnings.simplefilter("ignore")
    print("200 elements, a mold of 300 triangles:", flush=True)
    with tempfile.TemporaryDirectory() as folder:
        show(200, 300, Path(folder))
    for elements in SIZES:
        for triangles in MOLDS:
            print(f"{elements} elements, a mold of {triangles} triangles:", flush=True)
            with tempfile.TemporaryDirectory() as folder:
                show(elements, triangles, Path(folder))
    return 0


if __name__ == "__main__":
    sys.exit(main())

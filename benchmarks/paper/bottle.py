"""The soap bottle: how thin each region becomes, and how far that depends on what the paper does not state.

`make scenes` prints both tables and writes out/bench/scenes.json; a few minutes, most of it compilation.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import jax
import numpy as np

import jaxform
from benchmarks.timing import say
from jaxform import scenes
from jaxform.mesh.bottle import Bottle
from jaxform.model.scene import Scene
from jaxform.results.result import Result
from jaxform.results.summary import summarize
from jaxform.results.tool_contact import formed_areas

Row = dict[str, Any]
PAPER = {"body": "60", "neck": "20", "bottom": "about 50", "handle": "50 to 60"}
"""Thinning [%] that the paper states (4.3)."""
HANDLE_MIDDLE = 0.8
"""Place of the cut through the handle: x over the radius of the bottle."""


def regions(positions: np.ndarray, shape: Bottle) -> dict[str, np.ndarray]:
    """Masks of the places (n, 3) [m] of the formed bottle that belong to each region."""
    x, height = positions[:, 0], positions[:, 1] / shape.height
    # The hole's middle, and how far up and down of it the handle is a plain rod.
    beside_hole = np.abs(height - 0.66) < 0.8 * shape.hole[1] / shape.height
    return {
        "body": (height > 0.13) & (height < 0.45),
        "neck": height > 0.93,
        "bottom": height < 0.05,
        "handle": beside_hole & (x > 0.41 * shape.radius + shape.hole[0]),
    }


def thinning(scene: Scene, result: Result) -> Row:
    """1 - h/h0 [%] of each region: all its rubber over all its formed area, against the parison's."""
    corners = np.asarray(result.positions)[np.asarray(result.triangles)]
    area, volume = formed_areas(result), np.asarray(result.element_volume)
    start = float(np.asarray(scene.parison.thickness).mean())
    found = regions(corners.mean(1), Bottle())
    return {name: 100 * (1 - volume[part].sum() / area[part].sum() / start) for name, part in found.items()}


def spread(result: Result, scene: Scene) -> Row:
    """Least and largest thinning [%] of the elements of each region."""
    corners = np.asarray(result.positions)[np.asarray(result.triangles)]
    lost = 100 * (1 - np.asarray(result.element_thickness) / float(np.asarray(scene.parison.thickness).mean()))
    found = regions(corners.mean(1), Bottle())
    return {name: [float(lost[part].min()), float(lost[part].max())] for name, part in found.items()}


def show_thinning(scene: Scene, result: Result) -> list[Row]:
    """Thinning of each region beside the paper's."""
    mean, ends = thinning(scene, result), spread(result, scene)
    rows = [{"region": name, "ours": mean[name], "from to": ends[name], "paper": PAPER[name]} for name in PAPER]
    for row in rows:
        say(row)
    return rows


def geometry(scene: Scene) -> Row:
    """Bounds by geometry alone: areas [m^2] of the mold and of what it covers of the parting plane.

    A parison that is clamped along the whole outline cannot be smaller than the outline is flat; so the mean wall
    cannot be thinner than h0 times the flat area over the mold's.
    """
    assert scene.mold is not None
    corners = np.asarray(scene.mold.vertices)[np.asarray(scene.mold.triangles)]
    normal = 0.5 * np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    whole, flat = float(np.linalg.norm(normal, axis=1).sum()), float(abs(normal[:, 2].sum()))
    row = {"mold area": whole, "flat area": flat, "largest mean thinning": 100 * (1 - flat / whole)}
    say(row)
    return row


def _row(words: str, scene: Scene, result: Result, base: np.ndarray | None) -> Row:
    found = summarize(result, scene)
    wall = np.asarray(result.thickness)
    change = None
    if base is not None and wall.shape == base.shape:
        change = 100 * float(np.sqrt(np.mean(np.square(wall / base - 1))))
    row = {"changed": words} | thinning(scene, result)
    row |= {"touches": 100 * found["contact_fraction"], "wall change": change, "status": found["status"]}
    say(row)
    return row


def _process(scene: Scene) -> dict[str, dict[str, Any]]:
    """Names of changes to the process, and the numbers they put in."""
    pressure, time = np.asarray(scene.pressure.value), np.asarray(scene.pressure.time)
    c, density = (float(getattr(scene.material, name)) for name in ("c", "density"))
    end, damping = float(scene.solver.end_time), float(np.asarray(scene.solver.damping))
    return {
        "as built in": {},
        "half the pressure": {"pressure.value": 0.5 * pressure},
        "twice the pressure": {"pressure.value": 2 * pressure},
        "twice the pressure and c": {"pressure.value": 2 * pressure, "material.c": 2 * c},
        "ramp in half the time": {"pressure.time": 0.5 * time},
        "ramp in twice the time": {"pressure.time": 2 * time, "solver.end_time": 2 * end},
        "half the density": {"material.density": 0.5 * density},
        "twice the density": {"material.density": 2 * density},
        "quarter of the damping": {"solver.damping": 0.25 * damping},
        "four times the damping": {"solver.damping": 4 * damping},
        "alpha = 0.1": {"material.alpha": 0.1},
    }


def show_dependence(scene: Scene) -> list[Row]:
    """Thinning of each region with other choices, and the rms change of the wall over the nodes."""
    changes = _process(scene)
    paths = sorted({path for change in changes.values() for path in change})
    value = {path: getattr(getattr(scene, path.split(".")[0]), path.split(".")[1]) for path in paths}
    rows = {
        path: np.stack([np.asarray(change.get(path, value[path])) for change in changes.values()]) for path in paths
    }
    batch = jaxform.simulate_batch(scene, rows)
    parts = [jax.tree.map(lambda values, k=k: values[k], batch) for k in range(len(changes))]
    base = np.asarray(parts[0].thickness)
    found = [_row(words, scene, part, base) for words, part in zip(changes, parts, strict=True)]
    shapes: dict[str, dict[str, Any]] = {
        "swell 0.05": {"swell": 0.05},
        "swell 0.1": {"swell": 0.1},
        "swell 0.5": {"swell": 0.5},
        "swell 0.7": {"swell": 0.7},
        "neck_swell 0.6": {"neck_swell": 0.6},
        "neck_swell 0.3, flat as elsewhere": {"neck_swell": 0.3},
        "inset 0.6 mm": {"inset": 0.6e-3},
        "inset 2 mm": {"inset": 2.0e-3},
        "elements and mold in half the size": {"element_size": 0.5 * 0.00706, "mold_element_size": 0.003},
        "mold in half the size": {"mold_element_size": 0.003},
    }
    for words, options in shapes.items():
        other = scenes.soap_bottle(**options)
        same_nodes = words.startswith(("swell", "neck", "mold"))
        found.append(_row(words, other, jaxform.run(other), base if same_nodes else None))
    return found


def tables() -> dict[str, Any]:
    """All of them, as the JSON file has them."""
    scene = scenes.soap_bottle()
    part = jaxform.run(scene)
    return {
        "thinning": show_thinning(scene, part),
        "geometry": geometry(scene),
        "dependence": show_dependence(scene),
    }


def main() -> None:
    """Prints the tables; writes JSON."""
    jax.config.update("jax_enable_x64", True)
    found = tables()
    folder = Path("out/bench")
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "scenes.json").write_text(json.dumps(found, indent=2))
    print(f"written to {folder}")


if __name__ == "__main__":
    main()

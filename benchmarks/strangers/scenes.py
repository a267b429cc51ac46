"""Random scenes from files; what a stranger brings: flanges in the sheet's plane, own meshes, units that are off."""

from __future__ import annotations

import dataclasses
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.random import Generator

import jaxform
from jaxform import molds, shapes
from jaxform.mesh.shapes import Sheet

OFF = "units off"
"""The tag of a scene whose sheet and mold differ a thousand times in size."""
OWN_MESHES = ("own mold", "own parison")
"""Families that are read from files."""


def _flange(random: Generator, tags: list[str]) -> float:
    """Distance of a flange from the sheet's plane: none, what rounding makes of it, or a little."""
    tags.append("flange")
    return float(random.choice([0.0, 0.0, 1e-9, -1e-9, 1e-6, -1e-6, 1e-5, 1e-4, 1e-3]))


def flanged_cup(random: Generator, tags: list[str]) -> molds.MoldShape:
    """A cup, 24 facets, in a plate that is wider, as wide or narrower than the sheet."""
    opening, depth, z = random.uniform(0.3, 0.75), random.uniform(0.1, 0.8), _flange(random, tags)
    floor, plate = opening * random.uniform(0.3, 0.98), float(random.choice([0.85, 1.0, 1.3]))
    profile = [[0.0, z + depth], [floor, z + depth], [opening, z], [plate, z]]
    return molds.revolved(profile=profile, segments=24)


def flanged_tray(random: Generator, tags: list[str]) -> molds.MoldShape:
    """A rectangular hollow in a plate, for a sheet 1.5 by 1; 18 triangles."""
    z, plate = _flange(random, tags), float(random.choice([0.9, 1.0, 1.2]))
    opening = random.uniform(0.4, 0.8)
    sides = plate, opening, opening * random.uniform(0.6, 0.98)
    depth = random.uniform(0.05, 0.3)
    shape = tray([(side * 0.75, side * 0.5) for side in sides], [z, z, z + depth])
    return dataclasses.replace(shape, vertices=shape.vertices + np.array([0.75, 0.5, 0.0]))


def tray(half_sides: Sequence[tuple[float, float]], heights: Sequence[float]) -> molds.MoldShape:
    """A rectangular hollow about the z axis, from the plate's rim to its bottom: 18 triangles for three rectangles."""
    corner = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])
    rings = [np.column_stack([corner * sides, np.full(4, z)]) for sides, z in zip(half_sides, heights, strict=True)]
    k, after = np.arange(4), (np.arange(4) + 1) % 4
    halves = [(k, after, after + 4), (k, after + 4, k + 4)]
    bands = [np.stack(half, 1) + 4 * ring for ring in range(len(rings) - 1) for half in halves]
    bottom = np.array([[0, 1, 2], [0, 2, 3]]) + 4 * (len(rings) - 1)
    return molds.MoldShape(np.concatenate(rings), np.concatenate([*bands, bottom]).astype(np.int32))


_FILE = """
[parison]
shape = "disc"
radius = {radius}
elements = 40
symmetry = "half"
thickness = {{ along = "radius", at = [0.0, {radius}], value = [{first}, {last}] }}
[material]
model = "mooney-rivlin"
c = {c}
alpha = {alpha}
density = {density}
[pressure]
time = [0.0, {end}]
value = [0.0, {top}]
[solver]
end_time = {end}
damping = {damping}
"""


def from_file(random: Generator, tags: list[str]) -> jaxform.Scene:
    """A scene file; in some, a number is nonsense.

    Raises:
        jaxform.InputError: Where the scene is refused.
    """
    radius, c, density = 10 ** random.uniform(-2.0, 0.0), 10 ** random.uniform(4.0, 6.0), random.uniform(500.0, 2000.0)
    unit, thin = radius * np.sqrt(density / c), radius * 10 ** random.uniform(-3.0, -1.5)
    numbers: dict[str, Any] = {
        "radius": radius,
        "first": thin,
        "last": thin * random.uniform(0.2, 5.0),
        "c": c,
        "alpha": random.uniform(0.0, 0.5),
        "density": density,
        "end": unit * random.uniform(3.0, 20.0),
        "top": c * thin / radius * 10 ** random.uniform(-1.0, 1.0),
        "damping": random.uniform(0.0, 5.0) / unit,
    }
    if random.random() < 0.25:
        key = str(random.choice(["radius", "first", "c", "alpha", "density", "end", "damping"]))
        numbers[key] = random.choice(["-1.0", "nan", "inf", '"thick"', "[]"])
        tags.append("nonsense")
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "scene.toml"
        path.write_text(_FILE.format(**numbers), encoding="utf-8")
        return dataclasses.replace(jaxform.load(path), name="file")


_STRANGER = """
[parison]
{sheet}
[material]
model = "neo-hookean"
c = {c}
density = {density}
[pressure]
time = [0.0, {end}]
value = [0.0, {top}]
[mold]
shape = "file"
path = "mold.stl"
scale = {scale}
[solver]
end_time = {end}
damping = {damping}
"""
_OWN = 'shape = "file"\npath = "sheet.obj"\nscale = {scale}\nplanes = ["x", "y"]\nthickness = {thin}'
_BUILT_IN = 'shape = "disc"\nradius = {radius}\nelements = 60\nsymmetry = "quarter"\nthickness = {thin}'


def own_meshes(name: str, random: Generator, tags: list[str]) -> jaxform.Scene:
    """A scene file with a mold, and perhaps a sheet, from mesh files in millimetres; some forget to say that.

    Raises:
        jaxform.InputError: Where the scene is refused.
    """
    radius, c, density = 10 ** random.uniform(-1.7, 0.0), 10 ** random.uniform(4.0, 6.0), random.uniform(500.0, 2000.0)
    unit, thin = radius * np.sqrt(density / c), radius * 10 ** random.uniform(-2.7, -1.5)
    mold = flanged_cup(random, tags)
    scales = {"scale": "0.001", "own": "0.001"}
    if random.random() < 0.4:
        forgot = "own" if name == "own parison" and random.random() < 0.5 else "scale"
        scales[forgot] = str(random.choice(["1.0", "1.0e-6"]))
        tags.append(OFF)
    end = unit * random.uniform(20.0, 60.0)
    sheet = _OWN.format(scale=scales["own"], thin=thin)
    numbers: dict[str, Any] = {
        "sheet": sheet if name == "own parison" else _BUILT_IN.format(radius=radius, thin=thin),
        "c": c,
        "density": density,
        "end": end,
        "top": c * thin / radius * 10 ** random.uniform(-0.3, 1.0),
        "damping": random.uniform(0.5, 5.0) / unit,
        "scale": scales["scale"],
    }
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "scene.toml"
        path.write_text(_STRANGER.format(**numbers), encoding="utf-8")
        _write_stl(path.with_name("mold.stl"), 1000.0 * radius * mold.vertices[mold.triangles])
        if name == "own parison":
            _write_obj(
                path.with_name("sheet.obj"), shapes.disc(radius=1000.0 * radius, elements=60, symmetry="quarter")
            )
        return dataclasses.replace(jaxform.load(path), name=name)


def _write_stl(path: Path, corners: np.ndarray) -> None:
    """Triangles (m, 3, 3) as a binary STL file."""
    record = np.zeros(len(corners), dtype=[("normal", "<3f4"), ("corners", "<9f4"), ("rest", "<u2")])
    record["corners"] = corners.reshape(-1, 9)
    path.write_bytes(bytes(80) + np.uint32(len(corners)).tobytes() + record.tobytes())


def _write_obj(path: Path, sheet: Sheet) -> None:
    lines = [f"v {x:.6f} {y:.6f} {z:.6f}" for x, y, z in sheet.positions]
    lines += [f"f {a} {b} {c}" for a, b, c in sheet.triangles + 1]
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")

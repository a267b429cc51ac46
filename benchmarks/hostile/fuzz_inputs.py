"""Inputs that `benchmarks.hostile.fuzz` damages: good ones with a few places changed at random."""

from __future__ import annotations

import contextlib
import functools
import os
import random
import re
import shutil
import tempfile
from collections.abc import Callable
from pathlib import Path

SCENE = """name = "small"
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
interpolation = "linear"
[mold]
shape = "revolved"
profile = [[0.0, 0.05], [0.055, 0.05], [0.1, 0.0]]
segments = 24
[solver]
end_time = 0.05
damping = 100.0
safety = 0.9
[output]
frames = 0
"""
_RECTANGLE = 'shape = "rectangle"\nsize = [0.1, 0.2]\nelement_size = 0.03'
_INSERT = 'shape = "box-insert"\nsize = [0.1, 0.2]\ndepth = 0.05\ninsert_size = [0.03, 0.05]\ninsert_height = 0.02'
_FILE_MOLD = 'shape = "file"\npath = "cup.stl"\nscale = 1.0e-3\ntranslate = [0.0, 0.0, 0.01]\nrotate = [0.0, 0.0, 90.0]'
_FILE_SHEET = 'shape = "file"\npath = "sheet.vtu"\nscale = 1.0\nflip = false\nclamp = "boundary"\nplanes = []'
_PROFILE = 'thickness = { along = "radius", at = [0.0, 0.1], value = [1.0e-3, 2.0e-3] }'
_REFINED = "[refinement]\nangle = 5.0\ninterval = 64\nmax_level = 2\nmin_area = 1.0e-7\nelements = 200\n[solver]"
STUDY = """scene = "scene.toml"
[[variable]]
kind = "thickness-profile"
along = "radius"
knots = 3
bounds = [5.0e-4, 2.0e-3]
[[variable]]
kind = "pressure"
bounds = [-1.0, 4.0e4]
increasing = true
[objective]
kind = "target"
thickness = 0.9e-3
[solver]
method = "lbfgs"
iterations = 2
tolerance = 1.0e-3
"""


def _between(text: str, begin: str, end: str, new: str) -> str:
    first = text.index(begin)
    return text[:first] + new + "\n" + text[text.index(end, first) :]


SCENES = [
    SCENE,
    _between(SCENE, 'shape = "disc"', "thickness", _RECTANGLE).replace("[solver]", _REFINED),
    _between(_between(SCENE, 'shape = "disc"', "thickness", _RECTANGLE), 'shape = "revolved"', "[solver]", _INSERT),
    _between(SCENE, 'shape = "revolved"', "[solver]", _FILE_MOLD).replace("thickness = 1.0e-3", _PROFILE),
    _between(SCENE, 'shape = "disc"', "thickness", _FILE_SHEET).replace("1.0e-3", '"field:thickness"', 1),
    _between(SCENE, "[mold]", "[solver]", "").replace("thickness = 1.0e-3", _PROFILE),
]
NUMBERS = [
    *("0", "-1", "1", "1e300", "-1e300", "1e-300", "1e-30", "1e30", "1e12", "nan", "inf", "-inf", "1e400", "-0.0"),
    *("9223372036854775807", "9223372036854775808", "1" * 5000, "0x" + "f" * 400, "2147483648", "1_000", "1e-12"),
    *("true", '""', '"x"', "[]", "{}", "[[]]", "1979-05-27", "[0.0]", "'0.1'", "1e6", "1000000", "3"),
]
LINES = ["a." * 100_000 + "a = 1", "a = " + "[" * 5000, "[" + "a." * 5000 + "a]", "\x00", "=", "[a]", "k = 1"]
WORDS = [
    "",
    "disc",
    "file",
    "nowhere",
    "~nosuch/x",
    "a" * 5000,
    "\\u0000",
    "../" * 400,
    "/dev/zero",
    ".",
    "é\u200f",
    "x",
]


def damaged_file(chance: random.Random, folder: Path) -> list[str]:
    """A scene or a study with one to four places changed."""
    _neighbours(folder)
    scene, study = chance.choice(SCENES), STUDY
    is_study = chance.random() < 0.3
    for _ in range(chance.choice([1, 1, 1, 2, 4])):
        if is_study and chance.random() < 0.8:
            study = chance.choice(CHANGES)(chance, study)
        else:
            scene = chance.choice(CHANGES)(chance, scene)
    (folder / "scene.toml").write_bytes(_bytes(chance, scene))
    (folder / "study.toml").write_bytes(_bytes(chance, study))
    return ["study", str(folder / "study.toml")] if is_study else ["check", str(folder / "scene.toml")]


def _neighbours(folder: Path) -> None:
    """The files that scenes name."""
    (folder / "cup.stl").write_bytes(_meshes()["cup.stl"])
    (folder / "sheet.vtu").write_bytes(_meshes()["sheet.vtu"])


def _bytes(chance: random.Random, text: str) -> bytes:
    content = text.encode()
    return _broken_bytes(chance, content) if chance.random() < 0.05 else content


def _number(chance: random.Random, text: str) -> str:
    places = list(re.finditer(r"(?<![\w.\"])-?\d[\w.+-]*", text))
    if not places:
        return text
    place = chance.choice(places)
    new = chance.choice(NUMBERS)
    if chance.random() < 0.4:
        # So that what is checked where the scene is built is reached too.
        with contextlib.suppress(ValueError, OverflowError):
            value = float(place[0]) * chance.choice([0.5, 2.0, 10.0, 0.1, 1e3, 1e-3, 1e6, 1e-6, -1.0])
            new = str(int(value)) if place[0].isdigit() else repr(value)
    elif chance.random() < 0.3:
        new = f"{float(f'1e{chance.randint(-20, 20)}') * chance.uniform(-10, 10):.3g}"
    return text[: place.start()] + new + text[place.end() :]


def _word(chance: random.Random, text: str) -> str:
    places = list(re.finditer(r'"[^"\n]*"', text))
    if not places:
        return text
    place = chance.choice(places)
    return text[: place.start()] + f'"{chance.choice(WORDS)}"' + text[place.end() :]


def _line(chance: random.Random, text: str) -> str:
    lines = text.split("\n")
    at, other = chance.randrange(len(lines)), chance.randrange(len(lines))
    action = chance.randrange(4)
    if action == 0:
        del lines[at]
    elif action == 1:
        lines.insert(at, lines[other])
    elif action == 2:
        lines[at], lines[other] = lines[other], lines[at]
    else:
        lines[at] = chance.choice(
            [
                ".".join(["a"] * 100_000) + " = 1",
                "a = " + "[" * 5000,
                "[" + "a." * 5000 + "a]",
                "\x00",
                "=",
                "[a]",
                "k = 1",
            ]
        )
    return "\n".join(lines)


def _list(chance: random.Random, text: str) -> str:
    places = list(re.finditer(r"\[[^\[\]\n]*\]", text))
    place = chance.choice(places) if places else None
    if place is None:
        return text
    items = place[0][1:-1].split(",")
    chance.shuffle(items)
    items = chance.choice([items[:-1], items * 2, items, [*items, chance.choice(NUMBERS)], items * 3000])
    return text[: place.start()] + "[" + ",".join(items) + "]" + text[place.end() :]


def _cut(chance: random.Random, text: str) -> str:
    return text[: chance.randrange(len(text) + 1)]


CHANGES: list[Callable[[random.Random, str], str]] = [_number, _number, _number, _number, _word, _line, _list, _cut]


def damaged_mesh(chance: random.Random, folder: Path) -> list[str]:
    """A mesh with bytes, numbers or parts changed, as a mold or as a parison."""
    _neighbours(folder)
    name = chance.choice(sorted(_meshes()))
    content = _meshes()[name]
    for _ in range(chance.choice([1, 1, 2, 5])):
        content = chance.choice([_broken_bytes, _broken_bytes, _broken_text, _broken_number])(chance, content)
    if chance.random() < 0.1:
        name = f"odd.{chance.choice(['stl', 'obj', 'ply', 'off', 'vtk', 'vtu', 'msh'])}"
    (folder / name).write_bytes(content)
    if chance.random() < 0.5:
        text = SCENES[3].replace("cup.stl", name)
    else:
        text = (
            SCENES[4]
            .replace("sheet.vtu", name)
            .replace('"field:thickness"', chance.choice(["1e-3", '"field:thickness"']))
        )
    (folder / "scene.toml").write_text(text)
    return ["check", str(folder / "scene.toml")]


@functools.cache
def _meshes() -> dict[str, bytes]:
    """A cup in mm and a sheet in m, in all formats."""
    import meshio
    import numpy as np

    from jaxform import molds, shapes
    from jaxform.mesh import meshes

    cup = molds.revolved(profile=[[0.0, 50.0], [55.0, 50.0], [100.0, 0.0]], segments=12)
    sheet = shapes.disc(radius=0.1, elements=24)
    thickness = {"thickness": np.full(len(sheet.positions), 1e-3)}
    found = {}
    with tempfile.TemporaryDirectory() as name, contextlib.redirect_stdout(None), contextlib.redirect_stderr(None):
        folder = Path(name)
        meshes.write_vtu(folder / "sheet.vtu", sheet.positions, sheet.triangles, thickness)
        for part, positions, triangles in (
            ("cup", cup.vertices, cup.triangles),
            ("sheet", sheet.positions, sheet.triangles),
        ):
            mesh = meshio.Mesh(positions, [("triangle", triangles.astype(np.int64))])
            mesh.write(folder / f"{part}.stl", binary=True)
            mesh.write(folder / f"{part}-text.stl", binary=False)
            mesh.write(folder / f"{part}.ply", binary=True)
            mesh.write(folder / f"{part}-text.ply", binary=False)
            mesh.write(folder / f"{part}.obj")
            mesh.write(folder / f"{part}.off")
            mesh.write(folder / f"{part}.msh", file_format="gmsh", binary=True)
            mesh.write(folder / f"{part}-text.msh", file_format="gmsh22", binary=False)
            for version in ("vtk42", "vtk51"):
                mesh.write(folder / f"{part}-{version}.vtk", file_format=version, binary=True)
                mesh.write(folder / f"{part}-{version}-text.vtk", file_format=version, binary=False)
        for path in folder.iterdir():
            found[path.name] = path.read_bytes()
    return found


def _broken_bytes(chance: random.Random, content: bytes) -> bytes:
    """A few bytes changed (half of them near the begin), a piece cut out, doubled, filled, or the end cut off."""
    data, action = bytearray(content), chance.randrange(6)
    reach = chance.choice([min(400, len(data)), len(data)])
    at = chance.randrange(reach + 1)
    length = chance.choice([1, 4, 50, 1000])
    if action <= 1:
        for _ in range(chance.choice([1, 3, 20])):
            if data:
                data[chance.randrange(max(reach, 1))] = chance.randrange(256)
    elif action == 2:
        del data[at : at + length]
    elif action == 3:
        data[at:at] = data[at : at + length] * chance.choice([1, 100])
    elif action == 4:
        data[at : at + length] = bytes([chance.choice([0, 255, 32, 57])]) * length
    else:
        del data[chance.randrange(len(data) + 1) :]
    return bytes(data)


def _broken_text(chance: random.Random, content: bytes) -> bytes:
    """Lines moved, doubled or left out."""
    lines = content.split(b"\n")
    at, other = chance.randrange(len(lines)), chance.randrange(len(lines))
    lines[at : at + chance.randrange(3)] = [lines[other]] * chance.randrange(3)
    return b"\n".join(lines)


def _broken_number(chance: random.Random, content: bytes) -> bytes:
    """A number that is written out, replaced."""
    places = list(re.finditer(rb"(?<![\w.])-?\d[\d.e+-]*", content[:20_000]))
    if not places:
        return content
    place = chance.choice(places[: chance.choice([10, len(places)])])
    return content[: place.start()] + chance.choice(NUMBERS).encode() + content[place.end() :]


CACHE = Path(tempfile.gettempdir()) / f"jaxform-fuzz-{os.getuid()}"


def prepare() -> None:
    """A cache as a command leaves it, for `damaged_cache`."""
    import subprocess
    import sys

    shutil.rmtree(CACHE, ignore_errors=True)
    CACHE.mkdir(mode=0o700)
    (CACHE / "scene.toml").write_text(SCENE)
    without = {name: value for name, value in os.environ.items() if name != "JAX_COMPILATION_CACHE_DIR"}
    command = [sys.executable, "-m", "jaxform.cli", "check", str(CACHE / "scene.toml"), "--quiet"]
    subprocess.run(command, env={**without, "XDG_CACHE_HOME": str(CACHE / "cache")}, check=True)


def damaged_cache(chance: random.Random, folder: Path) -> list[str]:
    """A cache whose files are cut, changed, emptied, swapped, or are folders."""
    import jax
    from jax.experimental.compilation_cache import compilation_cache

    shutil.copytree(CACHE / "cache", folder / "cache")
    (folder / "scene.toml").write_text(SCENE)
    files = sorted(path for path in (folder / "cache").rglob("*") if path.is_file())
    for _ in range(chance.choice([1, 3, len(files)])):
        path, other = chance.choice(files), chance.choice(files)
        action = chance.randrange(4)
        if action == 0:
            path.write_bytes(_broken_bytes(chance, path.read_bytes()))
        elif action == 1:
            path.write_bytes(chance.randbytes(chance.choice([0, 10, 10_000])))
        elif action == 2:
            one, two = path.read_bytes(), other.read_bytes()
            path.write_bytes(two)
            other.write_bytes(one)
        elif path != other:
            path.replace(path.with_suffix(".moved"))
            other.replace(path)
            path.with_suffix(".moved").replace(other)
    os.environ["XDG_CACHE_HOME"] = str(folder / "cache")
    os.environ.pop("JAX_COMPILATION_CACHE_DIR", None)
    compilation_cache.reset_cache()
    jax.clear_caches()
    return ["check", str(folder / "scene.toml")]

"""The Python on the pages: it runs in a fresh process, and what was run once compiles nothing the second time."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from jaxform import molds, shapes
from jaxform.cli import check_command
from jaxform.core.store import Store
from jaxform.io import files
from jaxform.mesh import meshes
from tests import scenes

ROOT = Path(__file__).parents[2]
_BLOCK = re.compile(r"^```python\n(.*?)^```", re.DOTALL | re.MULTILINE)
_PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
PAGES = [
    str(page.relative_to(ROOT)) for page in _PAGES if "_generated" not in page.parts and _BLOCK.search(page.read_text())
]

# Definitions stay as they are: a function that is defined anew is another one to JAX.
_TWICE = """
import ast, json, os, sys
import jax

compiled = [0]
jax.monitoring.register_event_duration_secs_listener(
    lambda event, *_, **__: compiled.__setitem__(0, compiled[0] + event.endswith("backend_compile_duration"))
)
space, counts = {"__name__": "page"}, []
given = json.load(sys.stdin)
jax.devices()  # reads the flags
os.environ["XLA_FLAGS"] = os.environ.pop("XLA_FLAGS_BEFORE")
if given["quickly"]:
    from jaxform.core import compilation
    compilation._LEVEL = 0
for text in given["blocks"]:
    first = ast.parse(text)
    kept = (ast.FunctionDef, ast.ClassDef, ast.Import, ast.ImportFrom)
    again = ast.Module([part for part in first.body if not isinstance(part, kept)], [])
    for part in (first, again):
        before = compiled[0]
        exec(compile(part, "page", "exec"), space)
        counts.append(compiled[0] - before)
print(json.dumps([counts[::2], counts[1::2]]))
"""


def _run(blocks: list[str], folder: Path, *, quickly: bool = True) -> tuple[list[list[int]], list[str]]:
    """The programs that JAX compiles for each block, the first time and the second, in a new process; and its output.

    Quickly: it imports what compiles for `run` first, to compile as the tests do, whose programs it then finds.
    """
    before = os.environ.get("XLA_FLAGS", "")
    known = os.environ | {
        "PYTHONPATH": os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")]),
        "XLA_FLAGS": f"{before} --xla_backend_optimization_level=0",
        "XLA_FLAGS_BEFORE": before,
    }
    command = [sys.executable, "-W", "error", "-W", "ignore:Error (reading|writing) persistent", "-c", _TWICE]
    given = json.dumps({"blocks": blocks, "quickly": quickly})
    done = subprocess.run(
        command, cwd=folder, env=known, input=given, capture_output=True, text=True, timeout=900, check=False
    )
    assert done.returncode == 0, done.stderr[-3000:]
    *printed, counts = done.stdout.splitlines()
    return json.loads(counts), printed


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """With the files that pages read: tests of a material."""
    shutil.copy(ROOT / "tests" / "optimize" / "treloar" / "uniaxial.csv", tmp_path)
    stretch = np.linspace(1.2, 4.0, 12)
    rows = np.column_stack([stretch, 0.4e6 * (stretch - stretch**-3)])
    np.savetxt(tmp_path / "strip.csv", rows, delimiter=",", header="stretch,stress", comments="")
    return tmp_path


SHORT = ["README.md", "docs/how-to/extend.md"]
"""The page that is tried first, and one that differentiates no run, so that little compiles."""


@pytest.mark.parametrize("page", scenes.short_first(sorted(PAGES, key=lambda page: page not in SHORT), len(SHORT)))
def test_the_python_of_a_page_runs_and_compiles_nothing_the_second_time(page: str, folder: Path) -> None:
    blocks = _BLOCK.findall((ROOT / page).read_text())
    (first, second), printed = _run(blocks, folder)
    assert second == [0] * len(blocks), first
    if page == "README.md":
        before, after = map(float, printed[0].split())
        assert after < before


_JITTED = """
import jax
import jax.numpy as jnp
import jaxform

jax.config.update("jax_enable_x64", True)
scene = jaxform.scenes.dish(elements=40)


def mean(factor):
    changed = jaxform.replace(scene, {"parison.thickness": factor * scene.parison.thickness})
    return jnp.mean(jaxform.simulate(changed).thickness)


jitted = jax.jit(mean)
"""
_CALL = "assert float(jitted(jnp.asarray(1.0))) > 0.0"


@pytest.mark.long
def test_a_jitted_script_compiles_once_though_simulate_is_first_used_inside_the_trace(tmp_path: Path) -> None:
    """No module that is imported then may add to what JAX compares when it looks for a traced function."""
    ((_, first), (_, second)), _ = _run([_JITTED, _CALL], tmp_path, quickly=False)
    assert first > 0 and second == 0


_TABLES = re.compile(r"^```toml\n(.*?)^```", re.DOTALL | re.MULTILINE)
_BASE = """
parison = { shape = "disc", radius = 0.1, elements = 300, thickness = 1e-3 }
material = { model = "mooney-rivlin", c = 0.2e6, alpha = 0.1, density = 1000.0 }
pressure = { time = [0.0, 0.2], value = [0.0, 2.0e4] }
mold = { shape = "revolved", profile = [[0.0, 0.05], [0.055, 0.05], [0.1, 0.0]] }
solver = { end_time = 0.24, damping = 100.0 }
"""
_WARM = """
parison.temperature = 140.0
material.shift = { kind = "arrhenius-stiffness", reference = 140.0, activation_energy = 4.0e4 }
"""
_TOLD = {
    "temperature": _WARM,
    "heater-zones": _WARM,
    "[cooling]": _WARM,
    "orifice_area": 'parison = { shape = "tube", radius = 0.02, length = 0.1, elements = 200, thickness = 1e-3 }',
    "region =": 'parison = { shape = "rectangle", size = [0.2, 0.1], elements = 300, thickness = 1e-3 }',
    "molds =": 'mold = { shape = "file", path = "cup.stl", scale = 0.001 }',
    "closed_by": _BASE,
    '= "field:': 'parison = { shape = "file", path = "sheet.vtu" }',
}
"""Tables that a page gives in words around a block with a text in it; the last that fits counts."""
_STUDY = """
scene = "scene.toml"
variable = [{ kind = "pressure", bounds = [0.0, 3e4] }]
objective = { kind = "uniform" }
solver = { method = "lbfgs" }
"""
TABLES = [
    pytest.param(text, id=f"{page.stem}-{number}")
    for page in _PAGES
    if "_generated" not in page.parts
    for number, text in enumerate(_TABLES.findall(page.read_text()))
]


def _write_files(folder: Path) -> None:
    """The files that tables on the pages name."""
    for name, profile in (("cup", [[0.0, 50], [55, 50], [100, 0], [115, 0]]), ("block", [[0, 50], [40, 50], [45, 0]])):
        shape = molds.revolved(profile=profile, segments=48)
        meshes.write_stl(folder / f"{name}.stl", shape.vertices, shape.triangles)
    plate = shapes.rectangle(size=(300.0, 300.0), elements=8)
    meshes.write_stl(folder / "platen.stl", plate.positions - [150.0, 150.0, 0.0], plate.triangles)
    disc = shapes.disc(radius=0.1, elements=300)
    ones = np.ones(len(disc.positions))
    fields = {"thickness": 1e-3 * ones, "alpha": 0.1 * ones}
    quarter = shapes.disc(radius=0.1, elements=100, symmetry="quarter")
    (folder / "out" / "first").mkdir(parents=True)
    for name in ("sheet", "measured"):
        meshes.write_vtu(folder / f"{name}.vtu", disc.positions, disc.triangles, fields)
    first = {"thickness": np.full(len(quarter.positions), 1e-3)}
    meshes.write_vtu(folder / "out" / "first" / "final.vtu", quarter.positions, quarter.triangles, first)
    half = shapes.rectangle(size=(150.0, 100.0), elements=200)
    meshes.write_vtu(folder / "parison.vtu", half.positions, half.triangles)
    power = _BLOCK.findall((ROOT / "docs" / "how-to" / "extend.md").read_text())[0]
    (folder / "power.py").write_text(power)


def _scene_around(text: str) -> dict[str, Any]:
    """The tables of a scene that a block stands in."""
    whole = tomllib.loads(_BASE)
    for told, tables in _TOLD.items():
        if told in text:
            whole = _merge(whole, tomllib.loads(tables))
    if "[gas]" in text and "[pressure]" not in text:
        del whole["pressure"]
    return whole


def _merge(whole: dict[str, Any], tables: dict[str, Any]) -> dict[str, Any]:
    """The tables with those of a block, which complete one of the same shape and model and replace another."""
    merged = dict(whole)
    for name, table in tables.items():
        known: Any = whole.get(name)
        completes = isinstance(known, dict) and isinstance(table, dict) and not table.keys() & {"shape", "kind"}
        if completes and "density" not in table and table.get("model") in {None, known.get("model")}:
            merged[name] = known | table
        else:
            merged[name] = table
    if merged.get("parison", {}).get("shape") in {"tube", "preform"} and "mold" not in tables:
        merged.pop("mold", None)
    return merged


@pytest.mark.filterwarnings("ignore::jaxform.InputWarning")  # a table may not suit what it is completed with
@pytest.mark.parametrize("text", TABLES)
def test_the_tables_of_a_page_are_taken_as_they_stand(
    text: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A reader copies them; a study with `hops` and a limit, which the page of studies began with, was refused."""
    monkeypatch.chdir(tmp_path)
    _write_files(tmp_path)
    (tmp_path / "scene.toml").write_text(_toml(_scene_around(text)))
    # Keys without a table are examples of one key each, of the sheet.
    keys = [line for line in text.splitlines() if line.strip()]
    blocks = [text] if re.search(r"^\[|^scene", text, re.MULTILINE) else [f"[parison]\n{line}" for line in keys]
    for block in blocks:
        tables = tomllib.loads(block)
        if tables.keys() & {"scene", "variable", "sweep"}:
            (tmp_path / "study.toml").write_text(_toml(_merge(tomllib.loads(_STUDY), tables)))
            if "sweep" not in tables:
                check_command.read_study("study.toml", Store(None))
            continue
        (tmp_path / "scene.toml").write_text(_toml(_merge(_scene_around(block), tables)))
        document = files.read_scene("scene.toml")
        if "adapt" not in tables.get("parison", {}):  # which simulates
            files.build(document)


def _toml(tables: dict[str, Any]) -> str:
    return "\n".join(f"{key} = {_value(value)}" for key, value in tables.items())


def _value(value: Any) -> str:
    if isinstance(value, dict):
        return f"{{ {', '.join(f'{key} = {_value(item)}' for key, item in value.items())} }}"
    if isinstance(value, list):
        return f"[{', '.join(map(_value, value))}]"
    return json.dumps(value)

"""The Python on the pages: it runs in a fresh process, and what was run once compiles nothing the second time."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

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

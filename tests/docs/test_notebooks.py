"""The notebooks run, in small, and what is committed of them tells nothing of a machine."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import nbformat
import pytest

ROOT = Path(__file__).parents[2]
NAMES = [path.stem for path in sorted((ROOT / "notebooks").glob("*.ipynb"))]


def _outputs(notebook: Any) -> list[Any]:
    return [out for cell in notebook.cells if cell.cell_type == "code" for out in cell.outputs]


def _pictures(notebook: Any) -> int:
    return sum("image/png" in out.get("data", {}) for out in _outputs(notebook))


@pytest.fixture(scope="module")
def small(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with all notebooks, run in small by one process: what two of them compile is compiled once."""
    folder = tmp_path_factory.mktemp("notebooks")
    command = [sys.executable, "-m", "benchmarks.notebooks", "--small", "--out", str(folder)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr[-3000:]
    return folder


@pytest.mark.parametrize("name", NAMES)
def test_a_notebook_runs_and_shows_what_the_committed_one_shows(name: str, small: Path) -> None:
    kept = nbformat.read(ROOT / "notebooks" / f"{name}.ipynb", as_version=4)
    made = nbformat.read(small / f"{name}.ipynb", as_version=4)
    assert [cell.source for cell in made.cells] == [cell.source for cell in kept.cells]
    assert _pictures(made) == _pictures(kept) >= 2


@pytest.mark.parametrize("name", NAMES)
def test_a_committed_notebook_is_clean(name: str) -> None:
    kept = nbformat.read(ROOT / "notebooks" / f"{name}.ipynb", as_version=4)
    nbformat.validate(kept)
    texts = [str(out.get("text", "")) + str(out.get("data", {}).get("text/plain", "")) for out in _outputs(kept)]
    assert not any(re.search(r"/(home|root|tmp|usr|work)/|Warning", text) for text in texts)
    # One cell holds what a quick check replaces.
    assert [cell.metadata for cell in kept.cells if cell.metadata] == [{"tags": ["parameters"]}]
    assert all(out.output_type != "error" for out in _outputs(kept))


def test_there_are_nine_without_branches_for_a_check() -> None:
    assert [name[:2] for name in NAMES] == [f"{number:02d}" for number in range(1, 10)]
    texts = [(ROOT / "notebooks" / f"{name}.ipynb").read_text(encoding="utf-8") for name in NAMES]
    assert not [text for text in texts if "if small" in text or "from jaxform.io" in text]

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


def _assert_notebooks_run(names: list[str], folder: Path) -> None:
    """Runs notebooks in small by one process, so that what two of them compile is compiled once."""
    command = [sys.executable, "-m", "benchmarks.notebooks", "--small", "--out", str(folder), *names]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr[-3000:]
    for name in names:
        kept = nbformat.read(ROOT / "notebooks" / f"{name}.ipynb", as_version=4)
        made = nbformat.read(folder / f"{name}.ipynb", as_version=4)
        assert [cell.source for cell in made.cells] == [cell.source for cell in kept.cells]
        assert _pictures(made) == _pictures(kept) >= 2


def test_the_first_notebook_runs_and_shows_what_the_committed_one_shows(tmp_path: Path) -> None:
    _assert_notebooks_run(NAMES[:1], tmp_path)


@pytest.mark.long
def test_the_others_run_and_show_what_the_committed_ones_show(tmp_path: Path) -> None:
    _assert_notebooks_run(NAMES[1:], tmp_path)


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

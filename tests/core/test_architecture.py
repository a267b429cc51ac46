"""The packages: which may import which, and how long a module may be."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[2]


def test_packages_import_those_below_them_alone() -> None:
    code = "import sys; from importlinter.cli import lint_imports_command; lint_imports_command()"
    done = subprocess.run(
        [sys.executable, "-c", code, "--no-logo", "--no-cache"], cwd=ROOT, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stdout


def test_only_kernels_ask_for_barriers_or_the_backend() -> None:
    for path in (ROOT / "jaxform").rglob("*.py"):
        text = path.read_text()
        if path.parent.name != "kernels":
            assert "optimization_barrier" not in text, path
        if path.parent.name not in ("kernels", "core"):
            assert "default_backend" not in text, path

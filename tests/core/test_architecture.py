"""The packages: which may import which, and how long a module may be."""

from __future__ import annotations

import importlib
import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

pytestmark = pytest.mark.quick

ROOT = Path(__file__).parents[2]


def test_packages_import_those_below_them_alone() -> None:
    code = "import sys; from importlinter.cli import lint_imports_command; lint_imports_command()"
    done = subprocess.run(
        [sys.executable, "-c", code, "--no-logo", "--no-cache"], cwd=ROOT, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stdout


def test_code_built_on_jaxform_uses_its_public_modules() -> None:
    contracts = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["importlinter"]["contracts"]
    forbidden = next(one for one in contracts if one.get("source_modules") == ["optimize"])
    packages = {path.parent.name for path in (ROOT / "jaxform").glob("*/__init__.py")} - {"scenes"}
    assert set(forbidden["forbidden_modules"]) == {f"jaxform.{name}" for name in packages}
    public = {"", *(path.stem for path in (ROOT / "jaxform").glob("*.py")), "scenes"}
    for folder in ("optimize", "tests/examples"):
        for path in (ROOT / folder).rglob("*.py"):
            # Imports for types and inside of functions count here, too.
            found = re.findall(r"^\s*(?:from|import) jaxform\.?([\w]*)", path.read_text(), re.MULTILINE)
            assert set(found) <= public, path


def test_public_modules_name_what_they_have() -> None:
    for name in ("extend", "scene_files", "shapes", "molds", "plot"):
        module = importlib.import_module(f"jaxform.{name}")
        assert all(hasattr(module, one) for one in module.__all__)


def test_only_kernels_ask_for_barriers_or_the_backend() -> None:
    for path in (ROOT / "jaxform").rglob("*.py"):
        text = path.read_text()
        if path.parent.name != "kernels":
            assert "optimization_barrier" not in text, path
        if path.parent.name not in ("kernels", "core"):
            assert "default_backend" not in text, path

"""The packages: which may import which, and how many modules and records there may be."""

from __future__ import annotations

import ast
import importlib
import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

pytestmark = pytest.mark.quick

ROOT = Path(__file__).parents[2]
_MOST_RECORDS, _MOST_MODULES = 120, 200


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


def _records(path: Path) -> list[str]:
    """Names of the named tuples and data classes of a module."""
    classes = [one for one in ast.walk(ast.parse(path.read_text())) if isinstance(one, ast.ClassDef)]
    return [
        one.name
        for one in classes
        if "NamedTuple" in map(ast.unparse, one.bases)
        or any("dataclass" in ast.unparse(decorator) for decorator in one.decorator_list)
    ]


def test_records_and_modules_stay_few() -> None:
    # A record that only carries values between two functions, or a module of one function, belongs elsewhere.
    modules = list((ROOT / "jaxform").rglob("*.py"))
    names = [name for path in [*modules, *(ROOT / "optimize").rglob("*.py")] for name in _records(path)]
    assert len(modules) <= _MOST_MODULES
    assert len(names) <= _MOST_RECORDS
    assert len(set(names)) == len(names)


_PUBLIC_PARTICIPLES = {"cooled", "divided", "fitted", "guarded", "padded", "placed", "revolved"}
_PARTICIPLE = re.compile(r"_?([a-z]+ed|begun|carried|gone|kept|known|made|seen|taken|told)")


def test_functions_are_not_named_by_participles() -> None:
    """Names are verbs in the imperative, or nouns; public names stay."""
    folders = ("jaxform", "optimize", "benchmarks", "tools")
    found = {
        node.name: path
        for folder in folders
        for path in (ROOT / folder).rglob("*.py")
        for node in ast.walk(ast.parse(path.read_text()))
        if isinstance(node, ast.FunctionDef) and _PARTICIPLE.fullmatch(node.name)
    }
    assert found.keys() == _PUBLIC_PARTICIPLES


def _documented_attributes(one: ast.ClassDef) -> list[str]:
    """Names in the section "Attributes" of a class's docstring."""
    _, _, section = (ast.get_docstring(one) or "").partition("\nAttributes:\n")
    lines = re.findall(r"^    (\w+(?:, \w+)*):", section, re.MULTILINE)
    return [name for line in lines for name in line.split(", ")]


def test_documented_attributes_are_those_of_the_record() -> None:
    paths = [path for folder in ("jaxform", "optimize") for path in (ROOT / folder).rglob("*.py")]
    for path in paths:
        for one in ast.walk(ast.parse(path.read_text())):
            if not isinstance(one, ast.ClassDef) or not (documented := _documented_attributes(one)):
                continue
            fields = [
                part.target.id
                for part in one.body
                if isinstance(part, ast.AnnAssign) and isinstance(part.target, ast.Name) and part.target.id[0] != "_"
            ]
            # A class with a base documents what it inherits, too.
            if fields and (not one.bases or "NamedTuple" in map(ast.unparse, one.bases)):
                assert set(documented) == set(fields), f"{path}: {one.name}"


def test_a_run_needs_half_of_the_records() -> None:
    code = (
        "import sys, jaxform.runs.host; print(*(m.__file__ for n, m in sys.modules.items() if n.startswith('jaxform')))"
    )
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True)
    assert sum(len(_records(Path(path))) for path in done.stdout.split()) <= _MOST_RECORDS // 2

"""Installed files: the wheel has every file, and its metadata say what the code relies on."""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
import tomllib
import zipfile
from importlib import metadata
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.specifiers import SpecifierSet

from jaxform.cli import command

ROOT = Path(__file__).parents[2]
_PACKAGES = ("jaxform", "optimize")
_BUILD = "import sys; from setuptools import build_meta; build_meta.build_wheel(sys.argv[1])"


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> zipfile.ZipFile:
    """Built from a copy, without a network or an environment of its own."""
    source, built = tmp_path_factory.mktemp("source"), tmp_path_factory.mktemp("built")
    for name in _PACKAGES:
        shutil.copytree(ROOT / name, source / name, ignore=shutil.ignore_patterns("__pycache__"))
    for name in ("pyproject.toml", "README.md", "LICENSE", "MANIFEST.in"):
        shutil.copy(ROOT / name, source)
    command_line = [sys.executable, "-W", "ignore", "-c", _BUILD, str(built)]
    done = subprocess.run(command_line, cwd=source, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr[-2000:]
    return zipfile.ZipFile(next(built.glob("*.whl")))


def test_the_wheel_has_every_file_of_the_packages_and_nothing_else(wheel: zipfile.ZipFile) -> None:
    files = {path for name in _PACKAGES for path in (ROOT / name).rglob("*") if path.is_file()}
    expected = {path.relative_to(ROOT).as_posix() for path in files if "__pycache__" not in path.parts}
    found = {name for name in wheel.namelist() if ".dist-info/" not in name}
    assert found == expected
    assert {"jaxform/py.typed", "optimize/py.typed", "jaxform/__init__.pyi", "jaxform/scenes/dish.toml"} <= found
    assert "optimize/studies/dish-uniform-wall.toml" in found


def test_the_wheel_says_what_it_is(wheel: zipfile.ZipFile) -> None:
    names = {name.rpartition("/")[2]: name for name in wheel.namelist() if ".dist-info/" in name}
    entries = wheel.read(names["entry_points.txt"]).decode()
    assert "jaxform = jaxform.cli:main" in entries
    said = wheel.read(names["METADATA"]).decode()
    assert re.search(r"^License-Expression: Apache-2\.0$", said, re.MULTILINE)
    assert "LICENSE" in names


def test_jax_is_bounded_above_and_the_one_here_is_within() -> None:
    wanted = [Requirement(text) for text in metadata.requires("jaxform") or []]
    (bound,) = (one.specifier for one in wanted if one.name == "jax" and one.marker is None)
    assert any(part.operator == "<" for part in bound)
    assert metadata.version("jax") in bound
    with (ROOT / "pyproject.toml").open("rb") as file:
        tables = tomllib.load(file)
    # The lock is made under the same bound, and the metadata are those of this file.
    (declared,) = (text for text in tables["project"]["dependencies"] if text.startswith("jax"))
    assert Requirement(declared).specifier == bound
    (locked,) = tables["tool"]["uv"]["constraint-dependencies"]
    for version in ("0.11.9", "0.12.0", "0.12.99", "0.13.0"):
        assert (version in bound) == (version in Requirement(locked).specifier), version


def test_one_version_everywhere(capfd: pytest.CaptureFixture[str]) -> None:
    with (ROOT / "pyproject.toml").open("rb") as file:
        version = tomllib.load(file)["project"]["version"]
    with pytest.raises(SystemExit) as ended:
        command.main(["--version"])
    assert ended.value.code == 0
    assert capfd.readouterr().out == f"jaxform {version}\n"
    cited = re.search(r"^version: (.*)$", (ROOT / "CITATION.cff").read_text(), re.MULTILINE)
    assert cited is not None and cited[1] == version


def test_python_is_bounded_below_by_what_the_code_is_checked_for() -> None:
    with (ROOT / "pyproject.toml").open("rb") as file:
        tables = tomllib.load(file)
    assert SpecifierSet(tables["project"]["requires-python"]) == SpecifierSet(
        f">={tables['tool']['pyright']['pythonVersion']}"
    )

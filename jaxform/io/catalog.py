"""Lookup of scene and study files, and their text as tables. Imports nothing heavy."""

from __future__ import annotations

import difflib
import importlib.util
import os
import re
import tomllib
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

from jaxform.core import disk
from jaxform.core.errors import InputError

Kind = Literal["scene", "study"]
_MOST_PARTS = 50  # of a dotted key; two are used
_LONG_KEY = re.compile(rf"""(?<![\w-])(?>(?>[\w-]+|"[^"\n]*"|'[^'\n]*')[ \t]*\.[ \t]*){{{_MOST_PARTS},}}""")


def built_in(kind: Kind) -> dict[str, Path]:
    """The built-in scenes or studies: name and file."""
    folders = _folders(kind)
    return {path.stem: path for folder in folders for path in sorted(folder.glob("*.toml"))}


def read(name_or_path: str | Path, kind: Kind, folder: Path | None = None) -> tuple[str, Path, dict[str, Any]]:
    """The tables of a built-in scene or study, or of a file.

    Args:
        name_or_path: A built-in name or the path of a TOML file.
        kind: The kind to look for.
        folder: Base of a relative path; by default the working directory.

    Returns:
        The name in messages, the path of the file, and its tables.

    Raises:
        InputError: There is no such file, it cannot be read, or it is not TOML.
    """
    name = str(name_or_path)
    known = built_in(kind)
    if name in known:
        return f"{name} (built-in {kind})", known[name], _tables(known[name], name)
    path = disk.expand_path(name, folder)
    if not disk.is_file(path):
        raise _missing_file_error(name, path, kind, known)
    return str(path), path, _tables(path, str(path))


def kind_of(name_or_path: str | Path) -> Kind:
    """The kind of a name or file: "scene" or "study"; a scene where it is neither."""
    name = str(name_or_path)
    if name in built_in("scene"):
        return "scene"
    if name in built_in("study"):
        return "study"
    try:
        tables = read(name, "scene")[2]
    except InputError:
        return "scene"
    return "study" if "parison" not in tables and {"scene", "variable", "objective"} & set(tables) else "scene"


def descriptions(kind: Kind) -> dict[str, str]:
    """Name and description of each built-in scene or study."""
    return {name: str(read(name, kind)[2].get("description", "")) for name in built_in(kind)}


def _folders(kind: Kind) -> list[Path]:
    if kind == "scene":
        return [Path(__file__).parents[1] / "scenes"]
    # The studies are data of another package, which is looked up, not imported.
    spec = importlib.util.find_spec("optimize")
    return [Path(place) / "studies" for place in (spec and spec.submodule_search_locations) or ()]


def _missing_file_error(name: str, path: Path, kind: Kind, known: Iterable[str]) -> InputError:
    if os.path.isdir(path):
        return InputError("is a folder", f"name the {kind}'s .toml file in it", value=name)
    close = difflib.get_close_matches(name, list(known), n=1)
    built = f"did you mean {close[0]}?" if close else f"the built-in ones are {', '.join(known) or 'none'}"
    return InputError(f"is neither a file nor a built-in {kind}", built, value=name)


def _tables(path: Path, file: str) -> dict[str, Any]:
    try:
        text = disk.read_text(path)
    except InputError as error:
        # The file is the subject, not a value in it.
        raise replace(error, value=None, file=file) from None
    _check_keys(text, file)
    try:
        tables = tomllib.loads(text)
        _check_integers(tables, "", file)
    except RecursionError:
        raise InputError("cannot be read (nested too deeply)", "check the file", file=file) from None
    except tomllib.TOMLDecodeError as error:
        raise InputError(f"is not valid TOML: {error}", "correct that line", file=file) from None
    except InputError:
        raise
    except ValueError:
        # Python converts no more than some thousand digits.
        raise InputError("has a number with too many digits", "correct that line", file=file) from None
    return tables


def _check_keys(text: str, file: str) -> None:
    """Raises for a dotted key so long that reading it takes time and memory quadratic in the number of its parts."""
    found = _LONG_KEY.search(text)
    if found:
        line = text.count("\n", 0, found.start()) + 1
        problem = f"has a dotted key of more than {_MOST_PARTS} parts (line {line})"
        raise InputError(problem, "correct that line", file=file)


def _check_integers(value: Any, key: str, file: str) -> None:
    """Raises for integers that TOML does not have: no array holds them, and the longest cannot even be printed."""
    if isinstance(value, dict):
        for name, item in value.items():
            _check_integers(item, f"{key}.{name}" if key else name, file)
    elif isinstance(value, list):
        for item in value:
            _check_integers(item, key, file)
    elif isinstance(value, int) and not -(2**63) <= value < 2**63:
        raise InputError("has a number with too many digits", "give one of 64 bits at most", key=key, file=file)

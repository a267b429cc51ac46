"""Where scene and study files are found, and their text as tables. Imports nothing heavy."""

from __future__ import annotations

import difflib
import importlib.util
import tomllib
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from jaxform.errors import InputError

Kind = Literal["scene", "study"]


@dataclass(frozen=True)
class Source:
    """A scene or study file that was read.

    Attributes:
        file: What to call it in messages.
        path: Where it is.
        data: Its tables, as they stand in the file.
    """

    file: str
    path: Path
    data: dict[str, Any]


def built_in(kind: Kind) -> dict[str, Path]:
    """The built-in scenes or studies: name and file."""
    folders = _folders(kind)
    return {path.stem: path for folder in folders for path in sorted(folder.glob("*.toml"))}


def read(name_or_path: str | Path, kind: Kind, folder: Path | None = None) -> Source:
    """The tables of a built-in scene or study, or of a file.

    Args:
        name_or_path: A built-in name or the path of a TOML file.
        kind: What is looked for.
        folder: What a relative path is relative to; by default the working directory.

    Raises:
        InputError: There is no such file, it cannot be read, or it is not TOML.
    """
    name = str(name_or_path)
    known = built_in(kind)
    if name in known:
        return Source(f"{name} (built-in {kind})", known[name], _tables(known[name], name))
    path = (folder or Path()) / Path(name).expanduser()
    if not path.is_file():
        raise _missing(name, path, kind, known)
    return Source(str(path), path, _tables(path, str(path)))


def kind_of(name_or_path: str | Path) -> Kind:
    """Whether a name or file is a scene or a study; what is neither counts as a scene."""
    name = str(name_or_path)
    if name in built_in("scene"):
        return "scene"
    if name in built_in("study"):
        return "study"
    try:
        tables = read(name, "scene").data
    except InputError:
        return "scene"
    return "study" if "parison" not in tables and {"scene", "variable", "objective"} & set(tables) else "scene"


def descriptions(kind: Kind) -> dict[str, str]:
    """Name and description of each built-in scene or study."""
    return {name: str(read(name, kind).data.get("description", "")) for name in built_in(kind)}


def _folders(kind: Kind) -> list[Path]:
    if kind == "scene":
        return [Path(__file__).parent / "scenes"]
    # The studies are data of another package, which is looked up, not imported.
    spec = importlib.util.find_spec("optimize")
    return [Path(place) / "studies" for place in (spec and spec.submodule_search_locations) or ()]


def _missing(name: str, path: Path, kind: Kind, known: Iterable[str]) -> InputError:
    if path.is_dir():
        return InputError("is a folder", f"name the {kind}'s .toml file in it", value=name)
    close = difflib.get_close_matches(name, list(known), n=1)
    built = f"did you mean {close[0]}?" if close else f"the built-in ones are {', '.join(known) or 'none'}"
    return InputError(f"is neither a file nor a built-in {kind}", built, value=name)


def _tables(path: Path, file: str) -> dict[str, Any]:
    try:
        return tomllib.loads(path.read_text(encoding="utf-8-sig"))
    except tomllib.TOMLDecodeError as error:
        raise InputError(f"is not valid TOML: {error}", "correct that place", file=file) from None
    except UnicodeDecodeError:
        raise InputError("is not a text file in UTF-8", "save it as UTF-8", file=file) from None
    except (OSError, RecursionError) as error:
        problem = getattr(error, "strerror", None) or "nested too deeply"
        raise InputError(f"cannot be read ({problem})", "check the file", file=file) from None

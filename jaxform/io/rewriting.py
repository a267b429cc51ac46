"""Scene files written again, with other numbers, so that they run from another folder."""

from __future__ import annotations

import copy
import json
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from jaxform.core import disk
from jaxform.core.writing import whole
from jaxform.io.files import SceneDocument, _sheet
from jaxform.mesh import meshes

_PATHS = ("parison.path", "parison.thickness.file", "mold.path", "output.reference")


def write_scene(
    document: SceneDocument, changes: Mapping[str, Any], folder: str | Path, name: str = "best.toml"
) -> Path:
    """Writes a scene file with changes that runs from its new folder.

    Args:
        document: The scene to change.
        changes: New values at dotted keys: plain values, or arrays; a nodal parison.thickness [m] of shape
            (n_node,) goes into a mesh file beside the scene file.
        folder: Where to write.
        name: The name of the scene file.

    Returns:
        The path of the scene file.
    """
    folder = Path(folder)
    data = copy.deepcopy(document.data)
    data.setdefault("name", document.name)
    for key in _PATHS:
        _rewrite_path(data, key, document.folder)
    for key, value in changes.items():
        if key == "parison.thickness" and np.ndim(value) == 1 and not isinstance(value, str | dict):
            value = _write_field(document, np.asarray(value), folder / f"{Path(name).stem}-thickness.vtu")
        _put(data, key, value.tolist() if isinstance(value, np.ndarray | np.generic) else value)
    path = folder / name
    with whole(path) as fresh:
        fresh.write_text(_toml(data), encoding="utf-8")
    return path


def _rewrite_path(data: dict[str, Any], key: str, folder: Path) -> None:
    *sections, last = key.split(".")
    table: Any = data
    for section in sections:
        table = table.get(section) if isinstance(table, dict) else None
    if isinstance(table, dict) and last in table:
        names = table[last]
        moved = [str(disk.located(name, folder)) for name in ([names] if isinstance(names, str) else names)]
        table[last] = moved[0] if isinstance(names, str) else moved


def _write_field(document: SceneDocument, value: NDArray[Any], path: Path) -> dict[str, str]:
    sheet = _sheet(document)
    with whole(path) as fresh:
        meshes.write_vtu(fresh, sheet.positions, sheet.triangles, {"thickness": np.asarray(value, float)})
    return {"file": path.name, "field": "thickness"}


def _put(data: dict[str, Any], key: str, value: Any) -> None:
    *sections, last = key.split(".")
    for section in sections:
        data = data.setdefault(section, {})
    data[last] = value


def _toml(data: Mapping[str, Any]) -> str:
    """Numbers, texts, lists and tables, two levels of which become sections."""
    plain = [f"{_key(key)} = {_inline(value)}" for key, value in data.items() if not isinstance(value, dict)]
    lines = list(plain)
    for section, table in data.items():
        if isinstance(table, dict):
            lines += ["", f"[{_key(section)}]"]
            lines += [f"{_key(key)} = {_inline(value)}" for key, value in table.items()]
    return "\n".join(lines) + "\n"


def _key(key: str) -> str:
    return key if re.fullmatch(r"[A-Za-z0-9_-]+", key) else _inline(key)


def _inline(value: Any) -> str:
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, str):
        # TOML's escapes include those of JSON; only this one character is allowed there and not here.
        return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
    if isinstance(value, dict):
        return "{ " + ", ".join(f"{_key(key)} = {_inline(item)}" for key, item in value.items()) + " }"
    if isinstance(value, list | tuple):
        return "[" + ", ".join(map(_inline, value)) + "]"
    return repr(value)

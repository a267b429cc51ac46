"""Scene files written again, with other numbers, so that they run from another folder."""

from __future__ import annotations

import copy
import json
import re
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from jaxform.core import disk
from jaxform.core.disk import atomic_path
from jaxform.mesh import meshes

if TYPE_CHECKING:
    from jaxform.io.files import SceneDocument

_PATHS = ("parison.path", "parison.mesh", "material.model_file", "mold.path", "part.molds", "output.reference")


def write_scene(
    document: SceneDocument, changes: Mapping[str, Any], folder: str | Path, name: str = "best.toml"
) -> Path:
    """Writes a scene file with changes that runs from its new folder.

    Args:
        document: The scene to change.
        changes: New values at dotted keys: plain values, or arrays; arrays of what varies over the sheet,
            parison.thickness (n_node,) [m] and numbers of the material (..., n_node), go into mesh files beside the
            scene file.
        folder: Folder to write to.
        name: The name of the scene file.

    Returns:
        The path of the scene file.
    """
    folder = Path(folder)
    data = _relocate_paths(document)[0]
    if document.model.parison.adapt is not None:
        # Other numbers would get another mesh: the scene keeps the one that it was designed on.
        data["parison"] |= {"mesh": _write_sheet(document, folder / f"{Path(name).stem}.vtu")}
        del data["parison"]["adapt"]
    for key, value in changes.items():
        part, _, number = key.partition(".")
        varies = part == "material" and isinstance(value, np.ndarray) and value.ndim > 0
        whole_sheet = key in ("parison.thickness", "parison.temperature")
        if varies or (whole_sheet and not isinstance(value, str | dict) and np.ndim(value) == 1):
            value = _write_fields(document, np.asarray(value), number, folder / f"{Path(name).stem}-{number}.vtu")
        _put(data, key, value.tolist() if isinstance(value, np.ndarray | np.generic) else value)
    path = folder / name
    with atomic_path(path) as fresh:
        fresh.write_text(_toml(data), encoding="utf-8")
    return path


def keep_scene(document: SceneDocument, folder: str | Path, name: str = "simulated.toml") -> Path:
    """Writes a scene file as it is, but for its paths: it runs from its new folder, and keeps its comments.

    One that is simulated on the adapted mesh of another scene names that mesh, which is written beside it.

    Args:
        document: The scene.
        folder: Folder to write to.
        name: The name of the scene file.

    Returns:
        The path of the scene file.
    """
    if document.mesh_of is not None:
        return write_scene(document, {}, folder, name)
    data, moved = _relocate_paths(document)
    text = disk.read_text(document.path) if document.path is not None else ""
    if "name" not in document.data:
        text = f"name = {inline(document.name)}\n{text}"
    for old, new in moved.items():
        text = text.replace(f'"{old}"', inline(new)).replace(f"'{old}'", inline(new))
    with atomic_path(Path(folder) / name) as fresh:
        fresh.write_text(text if _has_tables(text, data) else _toml(data), encoding="utf-8")
    return Path(folder) / name


def referenced_files(document: SceneDocument) -> list[Path]:
    """The paths of all files that a scene names, whether they exist or not."""
    return [Path(path) for path in _relocate_paths(document)[1].values()]


def _has_tables(text: str, data: Mapping[str, Any]) -> bool:
    """True if a text is TOML with exactly these tables."""
    try:
        return tomllib.loads(text) == data
    except ValueError:
        return False


def _relocate_paths(document: SceneDocument) -> tuple[dict[str, Any], dict[str, str]]:
    """The tables of a scene with its name and with paths that hold from everywhere, and these paths by the old ones."""
    data, moved = copy.deepcopy(document.data), {}
    data.setdefault("name", document.name)
    for key in [*_PATHS, *_field_files(data), *_tool_files(data)]:
        moved |= _rewrite_path(data, key, document.folder)
    return data, moved


def _field_files(data: Mapping[str, Any]) -> list[str]:
    """The keys of all mesh files that fields are in."""
    found = []
    for section in ("parison", "material"):
        for key, value in data.get(section, {}).items():
            items = {f"{section}.{key}": value} if isinstance(value, dict) else {}
            if isinstance(value, list):
                items = {f"{section}.{key}.{k}": item for k, item in enumerate(value)}
            found += [f"{path}.file" for path, item in items.items() if isinstance(item, dict) and "file" in item]
    return found


def _tool_files(data: Mapping[str, Any]) -> list[str]:
    """The keys of all mesh files of tools."""
    tables = data.get("tool", [])
    return [f"tool.{k}.path" for k, table in enumerate(tables) if isinstance(table, dict) and "path" in table]


def _rewrite_path(data: dict[str, Any], key: str, folder: Path) -> dict[str, str]:
    """Makes the paths at a dotted key hold from everywhere; returns them by the old ones."""
    *sections, last = key.split(".")
    table: Any = data
    for section in sections:
        inner = table.get(section) if isinstance(table, dict) else None
        table = table[int(section)] if isinstance(table, list) else inner
    if not isinstance(table, dict) or last not in table:
        return {}
    names = table[last]
    moved = {name: str(disk.expand_path(name, folder)) for name in ([names] if isinstance(names, str) else names)}
    table[last] = moved[names] if isinstance(names, str) else [moved[name] for name in names]
    return moved


def _write_sheet(document: SceneDocument, path: Path) -> str:
    """Writes the mesh of a document's sheet; returns its entry in the scene file."""
    from jaxform.io.geometry import build_sheet, sheet_fields

    sheet = build_sheet(document)
    with atomic_path(path) as fresh:
        meshes.write_vtu(fresh, sheet.positions, sheet.triangles, sheet_fields(sheet))
    return path.name


def _write_fields(document: SceneDocument, values: NDArray[Any], number: str, path: Path) -> Any:
    """Writes values (n_node,), or a list of such, as fields of the mesh; returns their entry in the scene file."""
    from jaxform.io.geometry import build_sheet  # takes JAX to import, which `inline` alone does not need

    sheet = build_sheet(document)
    names = [number] if values.ndim == 1 else [f"{number}_{k + 1}" for k in range(len(values))]
    fields = dict(zip(names, np.atleast_2d(np.asarray(values, float)), strict=True))
    with atomic_path(path) as fresh:
        meshes.write_vtu(fresh, sheet.positions, sheet.triangles, fields)
    tables = [{"file": path.name, "field": name} for name in names]
    return tables[0] if values.ndim == 1 else tables


def _put(data: dict[str, Any], key: str, value: Any) -> None:
    *sections, last = key.split(".")
    if sections[:1] == ["tool"] and (place := _find_tool(data.get("tool"), sections[1])) is not None:
        data, sections = data["tool"][place], sections[2:]
    if sections[:1] == ["gas"] and len(sections) == 2:
        tables = data["gas"] if isinstance(data["gas"], list) else [data["gas"]]
        place = _find_gas(tables, sections[1])
        ours = [] if place is None else [tables[place]]
        # Without a gas inside the sheet, its pressure history is there.
        data, sections = (ours or [data.setdefault("pressure", {})])[0], []
    for section in sections:
        data = data.setdefault(section, {})
    table = data.get(last)
    data[last] = table | {"value": value} if last == "friction" and isinstance(table, dict) else value


def _find_tool(tables: Any, name: str) -> int | None:
    from jaxform.io.schema import find_tool  # takes pydantic to import, which `inline` alone does not need

    return find_tool(tables, name)


def _find_gas(tables: Any, name: str) -> int | None:
    from jaxform.io.schema import find_gas  # as above

    return find_gas(tables, name)


def _toml(data: Mapping[str, Any]) -> str:
    """Numbers, texts, lists and tables, two levels of which become sections, as do lists of tables."""
    sections = {key: value for key, value in data.items() if isinstance(value, dict) or _is_of_tables(value)}
    lines = [f"{_key(key)} = {inline(value)}" for key, value in data.items() if key not in sections]
    for section, tables in sections.items():
        head = f"[{_key(section)}]" if isinstance(tables, dict) else f"[[{_key(section)}]]"
        for table in [tables] if isinstance(tables, dict) else tables:
            lines += ["", head, *(f"{_key(key)} = {inline(value)}" for key, value in table.items())]
    return "\n".join(lines) + "\n"


def _is_of_tables(value: Any) -> bool:
    return isinstance(value, list) and bool(value) and all(isinstance(item, dict) for item in value)


# Numbers that a scene has at another place than its file.

_MOTION = ("direction", "time", "displacement")
_SIDES = {"clamp": "inside", "mold": "trapped"}  # loads of a `TwoSidedLoad`, by what closes the gas


def replacement_path(key: str) -> str:
    """The path for `jaxform.replace` of a key of a scene file.

    tool.plug.friction is tools.plug.contact.friction, gas.mass_flow is pressure.mass_flow, where there are loads on
    both sides, gas.mold.vent_area is pressure.trapped.vent_area, and of the gas of a region gas.left.mass_flow is
    pressure.left.mass_flow.
    """
    steps = key.split(".")
    if steps[0] == "tool" and len(steps) == 3:
        part = {"friction": "contact"} | dict.fromkeys(_MOTION, "motion")
        return ".".join(["tools", steps[1], *([part[steps[2]]] if steps[2] in part else []), steps[2]])
    if steps[0] == "gas":
        return ".".join(["pressure", *(_SIDES.get(step, step) for step in steps[1:])])
    return "mold.contact.friction" if key == "mold.friction" else key


def file_key(path: str) -> str:
    """The key of a scene file of a path of `jaxform.replace`: the inverse of `replacement_path`."""
    found = re.fullmatch(r"tools\.([^.]+)\.(?:motion|contact)\.(\w+)", path)
    if found is not None:
        return f"tool.{found[1]}.{found[2]}"
    section, _, name = path.partition(".")
    if section == "pressure" and name.removeprefix("inside.") == "value":
        return "pressure.value"
    if section == "pressure" and name != "time":
        sides = {side: closed_by for closed_by, side in _SIDES.items()}
        return ".".join(["gas", *(sides.get(step, step) for step in name.split("."))])
    return "mold.friction" if path == "mold.contact.friction" else path


def _key(key: str) -> str:
    return key if re.fullmatch(r"[A-Za-z0-9_-]+", key) else inline(key)


def inline(value: Any) -> str:
    """A value as TOML in one line: a number, a text, a list or a table."""
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, str):
        # TOML's escapes include those of JSON; only this one character is allowed there and not here.
        return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
    if isinstance(value, dict):
        return "{ " + ", ".join(f"{_key(key)} = {inline(item)}" for key, item in value.items()) + " }"
    if isinstance(value, list | tuple):
        return "[" + ", ".join(map(inline, value)) + "]"
    return repr(value)

"""Tables of designs: rows of values at paths of a scene file, each made a scene document of its own."""

from __future__ import annotations

import copy
import csv
import dataclasses
import hashlib
import io
import itertools
import json
import re
import tomllib
import warnings
from collections.abc import Callable, Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from jaxform.core import disk
from jaxform.core.errors import InputError, truncate_text, warn_of
from jaxform.core.ranges import RANGES
from jaxform.io import catalog, files, scene_rewriting, schema
from jaxform.io.files import SceneDocument
from jaxform.io.schema import SweepTable, SweepVariableTable
from jaxform.io.schema.study import MOST_DESIGNS
from jaxform.io.validation import NO_KEY, validate

SCENE = "scene"
"""Column of a table that names the scene of each row."""
_DECIMAL_COMMA = re.compile(r"[-+]?\d*,\d+(?:[eE][-+]?\d+)?")
_NUMBER = re.compile(r"[-+]?(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?")
_WHOLE = re.compile(r"[-+]?\d{1,18}")
_STEP = re.compile(r"([A-Za-z_][A-Za-z0-9_-]*)((?:\[-?\d+\])*)")
_ALTERNATIVES = (("parison.elements", "parison.element_size"),)
_UNITS = {allowed.unit for allowed in RANGES.values()} | {"Pa", "K", "degrees", "m^2"}
Step = str | int


@dataclasses.dataclass(frozen=True)
class DesignRow:
    """A row of a sweep.

    Attributes:
        number: Its place in the sweep, from 1.
        values: Its values by path; all others are those of the scene.
        document: Its scene; None if that cannot be simulated.
        error: The error of the row, in one line; empty without one.
        digest: Hash of all that determines its result: values, scene, and contents of the files that it names.
    """

    number: int
    values: dict[str, Any]
    document: SceneDocument | None
    error: str
    digest: str


@dataclasses.dataclass(frozen=True)
class Rows:
    """A table of designs, read from a file or sampled.

    Attributes:
        file: Its name in messages.
        folder: Base of relative paths in it.
        paths: Its columns.
        rows: Values by path.
    """

    file: str
    folder: Path
    paths: list[str]
    rows: list[dict[str, Any]]


def read_table(path: str | Path, folder: Path | None = None) -> Rows:
    """The rows of a table of designs in CSV; an empty cell leaves what the scene has.

    The columns are separated by commas, semicolons or tabs. A cell is a number, true, false, a list or table as in a
    scene file, or else a text.

    Raises:
        InputError: It cannot be read, or it is no table with a header of paths and rows below it.
    """
    place = disk.expand_path(path, folder)
    text, file = disk.read_text(place), str(path)
    first = text.partition("\n")[0]
    mark = next((mark for mark in (",", ";", "\t") if mark in first), ",")
    try:
        lines = list(csv.reader(io.StringIO(text, newline=""), delimiter=mark, strict=True))
    except csv.Error as error:
        raise InputError(f"is not a table: {error}", "separate its cells by commas", file=file) from None
    numbered = [(number, line) for number, line in enumerate(lines, 1) if any(cell.strip() for cell in line)]
    if not numbered:
        raise InputError("is empty", "give a header of paths, such as mold.depth, and a row per design", file=file)
    paths = _header([cell.strip() for cell in numbered[0][1]], file)
    rows = [_row(paths, line, number, file) for number, line in numbered[1:]]
    if not rows:
        raise InputError("has no designs", "add a row per design below the header", file=file)
    if len(rows) > MOST_DESIGNS:
        raise InputError(f"has {len(rows)} designs", f"give at most {MOST_DESIGNS}", file=file)
    return Rows(file, place.resolve().parent, paths, rows)


def _header(cells: list[str], file: str) -> list[str]:
    for number, cell in enumerate(cells, 1):
        if not cell:
            raise InputError(f"has no name for column {number}", "give the path of a number of the scene", file=file)
        if cell in cells[: number - 1]:
            raise InputError("occurs twice", "keep one of the columns", key=cell, file=file)
        with files.error_context(file):
            parse_path(cell)
    return cells


def _row(paths: list[str], line: list[str], number: int, file: str) -> dict[str, Any]:
    if len(line) != len(paths):
        problem = f"has {len(line)} cells in line {number}, and {len(paths)} columns in its header"
        raise InputError(problem, "give a cell for each column; put a list in quotes", file=file)
    for path, cell in zip(paths, line, strict=True):
        if _DECIMAL_COMMA.fullmatch(cell.strip()):
            problem = f"has a decimal comma in line {number}"
            raise InputError(problem, "write numbers with a point, or a list in brackets", path, cell, file=file)
    return {path: parse_cell(cell) for path, cell in zip(paths, line, strict=True) if cell.strip()}


def parse_cell(text: str) -> Any:
    """The value of a cell: a number, true, false, a list or table as in a scene file, or else the text itself."""
    text = text.strip()
    if _WHOLE.fullmatch(text):
        return int(text)
    if _NUMBER.fullmatch(text):
        return float(text)
    if text in ("true", "false"):
        return text == "true"
    if text[:1] in "[{\"'" and "\n" not in text:
        try:
            return tomllib.loads(f"value = {text}")["value"]
        except (ValueError, RecursionError):
            return text
    return text


def parse_path(path: str) -> list[Step]:
    """The steps of a path: names of tables, keys and tools, and numbers of list elements, from 0 (-1 is the last).

    Raises:
        InputError: It is no path.
    """
    steps: list[Step] = []
    for part in path.split("."):
        found = _STEP.fullmatch(part)
        if found is None:
            remedy = "write it as mold.depth, or pressure.value[1] for an element of a list"
            raise InputError("is not a path of a scene file", remedy, key=path if path.isprintable() else ascii(path))
        steps += [found[1], *map(int, re.findall(r"-?\d+", found[2]))]
    return steps


_NO_LIST = "is not a list in the scene"
_NO_TABLE = "does not belong to a table of the scene"
_NO_TOOL = "is not a tool of the scene"
_NO_GAS = "is not a gas of the scene"
_NO_ELEMENT = "is not there: the scene's list has"
_MISNAMED = _NO_LIST, _NO_TABLE, _NO_TOOL, _NO_GAS, _NO_ELEMENT
"""Beginnings of the messages on paths that do not exist in the scene, for any value."""


def set_value(data: dict[str, Any], path: str, value: Any) -> None:
    """Puts a value at a path of the tables of a scene file; tables that are missing are made.

    Raises:
        InputError: What is there on the way is no table, or no list with such an element.
    """
    steps = parse_path(path)
    place: Any = data
    following: Any
    step: Any
    for step, following in zip(steps, [*steps[1:], None], strict=True):
        if isinstance(step, str) and steps[0] in _NAMED and (tables := _as_list(place)) is not None:
            step = _named_index(steps[0], tables, step, path)
        if isinstance(step, int):
            if not isinstance(place, list):
                raise InputError(_NO_LIST, "name the key alone, or write a list there", path)
            if not -len(place) <= step < len(place):
                problem = f"{_NO_ELEMENT} {len(place)} elements"
                raise InputError(problem, "count from 0, or -1 for the last", path)
        elif not isinstance(place, dict):
            raise InputError(_NO_TABLE, "name the key alone, or write a table there", path)
        entries: Any = place  # a table or a list
        if following is None:
            entries[step] = value
        elif isinstance(place, dict):
            if step == "tool" and step not in place:
                raise InputError(f"{_NO_TOOL}, which has none", "add it to the scene as [[tool]]", path)
            if isinstance(following, int) and step not in place:
                raise InputError(_NO_LIST, "name the key alone, or write a list there", path)
            place = place.setdefault(step, {})
        else:
            place = entries[step]


def _as_list(value: Any) -> list[Any] | None:
    """The value, if it is a list."""
    return value if isinstance(value, list) else None


_NAMED = {
    "tool": (schema.find_tool, schema.tool_name, _NO_TOOL, "tools"),
    "gas": (schema.find_gas, schema.gas_name, _NO_GAS, "gases"),
}
"""Sections that are lists of tables, with functions for the index of a name and the name of a table, and two words."""


def _named_index(kind: str, tables: list[Any], name: str, path: str) -> int:
    """The index of the tool or gas of this name; of a gas also by what closes it.

    Raises:
        InputError: There is none.
    """
    find, name_of, problem, word = _NAMED[kind]
    number = find(tables, name)
    if number is None:
        known = [name_of(table, k) for k, table in enumerate(tables, 1)]
        raise InputError(problem, f"its {word} are {', '.join(known) or 'none'}", path)
    return number


def make_designs(table: Rows, scene: str | Path | None, base: Path | None = None, about: str = "") -> list[DesignRow]:
    """The designs of a table, each with its scene, validated.

    Args:
        table: Their values.
        scene: Scene of those that name none in the column `scene`: a built-in name or a path; None without one.
        base: Base of a relative path of that scene; by default the working directory.
        about: Further input that determines the results, for the digest.

    Raises:
        InputError: The scene is invalid for every row, or a column is not a key in any row.
    """
    read = cache(lambda name, folder: catalog.read(name, "scene", folder))
    hashed = cache(_file_digest)
    found = []
    errors: list[InputError] = []
    for number, values in enumerate(table.rows, 1):
        document: SceneDocument | None = None
        name, folder = (values[SCENE], table.folder) if SCENE in values else (scene, base)
        if name is None:
            remedy = "name one with --scene, or in a column scene"
            raise InputError(f"has no scene for design {number}", remedy, file=table.file)
        try:
            document = _document(table, values, read, str(name), folder)
            error = ""
        except InputError as caught:
            errors.append(caught)
            error = truncate_text(str(dataclasses.replace(caught, file="")))
        found.append(DesignRow(number, values, document, error, _digest(document, name, values, about, hashed)))
    if errors and len(errors) == len(found):
        _refuse(table, errors)
    return found


def _document(
    table: Rows, values: Mapping[str, Any], read: Callable[..., Any], name: str, folder: Path | None
) -> SceneDocument:
    """The scene of a row, validated; an adapted mesh is that of the scene with those values that change a shape."""
    document = _apply_values(table, values, read, name, folder)
    shaping = {path: value for path, value in values.items() if path == SCENE or _changes_shape(path)}
    if document.model.parison.adapt is None or len(shaping) == len(values):
        return document
    try:
        return dataclasses.replace(document, mesh_of=_apply_values(table, shaping, read, name, folder))
    except InputError:
        return document  # without its other values the scene is none


_SHAPES = ("parison", "mold", "tool")
_NO_SHAPE = {"thickness", "temperature", "clamp_until", "contact", "friction", "fill", "heat_transfer", "time"}
"""Keys of these sections that change neither the sheet's mesh nor the shape of tools, or where they come to lie."""


def _changes_shape(path: str) -> bool:
    """True if a value at a path changes the shape of the sheet or of tools, or how its mesh is made."""
    first, *steps = parse_path(path)
    return first in _SHAPES and _NO_SHAPE.isdisjoint(steps)


def describe_meshes(table: Rows, designs: Sequence[DesignRow]) -> str:
    """A sentence on the adapted meshes that designs are simulated on; empty where no scene asks for one."""
    documents = [design.document for design in designs if design.document is not None]
    adapted = [one.mesh_of or one for one in documents if one.model.parison.adapt is not None]
    if not adapted:
        return ""
    count = len({_determining_data(one) for one in adapted})
    if count == 1:
        return f"one mesh for all {len(adapted)} designs, adapted to the scene's wall (parison.adapt)"
    columns = [path for path in table.paths if path == SCENE or _changes_shape(path)]
    return (
        f"{count} meshes for {len(adapted)} designs: each shape of sheet and tools ({', '.join(columns)}) has its own, "
        "adapted to its wall with the scene's other values (parison.adapt); results of different meshes also differ by "
        "the errors of these"
    )


def _apply_values(
    table: Rows, values: Mapping[str, Any], read: Callable[..., Any], name: str, folder: Path | None
) -> SceneDocument:
    """The scene of this name with values of a row, validated."""
    file, path_of_scene, tables = read(name, folder)
    data = copy.deepcopy(tables)
    for one, other in [pair for given in _ALTERNATIVES for pair in (given, given[::-1])]:
        if one in values and other not in values and isinstance(data.get("parison"), dict):
            data["parison"].pop(other.rpartition(".")[2], None)
    places = [table.folder, path_of_scene.resolve().parent]
    for path, value in values.items():
        if path != SCENE:
            set_value(data, path, _relocate(path, value, places))
    return files.validate_scene(data, file, places[1], path_of_scene)


def _relocate(path: str, value: Any, places: Sequence[Path]) -> Any:
    """A value of a table, its files sought beside the table, then beside the scene."""
    if isinstance(value, dict):
        return {key: _relocate(f"{path}.{key}", item, places) for key, item in value.items()}
    last = [step for step in parse_path(path) if isinstance(step, str)][-1]
    if last not in ("path", "file", "reference", "model_file") or path.endswith("shift.reference"):
        return value
    if isinstance(value, list):
        return [_relocate(path, item, places) for item in value]
    if not isinstance(value, str):
        return value
    candidates = [disk.expand_path(value, place) for place in places]
    return str(next((one for one in candidates if disk.is_file(one)), candidates[0]))


def _digest(
    document: SceneDocument | None, name: Any, values: Mapping[str, Any], about: str, hashed: Callable[[Path], str]
) -> str:
    """Hash of all that determines a design's result but the version of the program."""
    digest = hashlib.sha256(about.encode())
    if document is None:
        digest.update(json.dumps([str(name), values], sort_keys=True, default=str).encode())
        return digest.hexdigest()[:16]
    for one in (document, document.mesh_of):
        if one is not None:
            digest.update(_determining_data(one).encode())
            for path in scene_rewriting.referenced_files(one):
                digest.update(hashed(path).encode())
    return digest.hexdigest()[:16]


def _determining_data(document: SceneDocument) -> str:
    """The tables of a scene that determine its result, as text."""
    data = {key: value for key, value in document.data.items() if key not in ("name", "description")}
    return json.dumps(data, sort_keys=True, default=str)


def _file_digest(path: Path) -> str:
    """Hash of a file's content; empty where it cannot be read."""
    try:
        return hashlib.sha256(disk.read_bytes(path, disk.MOST_MESH)).hexdigest()
    except InputError:
        return ""


def _refuse(table: Rows, errors: list[InputError]) -> None:
    """Raises InputError for an error of the scene or of a column that is the same in all rows."""
    first = errors[0]
    columns = [re.sub(r"\[-?\d+\]", "", path) for path in table.paths]
    key = re.sub(r"\[-?\d+\]", "", first.key)
    in_column = any(key == path or key.startswith(f"{path}.") or path.startswith(f"{key}.") for path in columns)
    same = all((error.key, error.problem) == (first.key, first.problem) for error in errors)
    misnamed = first.problem == NO_KEY or first.problem.startswith(_MISNAMED)
    if not same or (in_column and not misnamed):
        return
    raise dataclasses.replace(first, file=table.file) if in_column else first


def read_sweep(name_or_path: str | Path) -> tuple[tuple[str, Path, dict[str, Any]], str | None, Rows]:
    """A study file with a sweep.

    Returns:
        Its name in messages, the base of relative paths in it and its tables; the scene that it names; and the designs
        that it asks for.

    Raises:
        InputError: There is no such study, a key or value in it is wrong, or its table cannot be read.
    """
    file, path, data = catalog.read(name_or_path, "study")
    model = validate(schema.SweepFile, data, file)
    folder, table = path.resolve().parent, model.sweep
    with files.error_context(file):
        if table.table is not None:
            rows = read_table(table.table, folder)
        else:
            columns = [variable.path for variable in table.variable]
            for column in columns:
                parse_path(column)
            rows = Rows(file, folder, columns, sample(table))
    return (file, folder, data), model.scene, rows


def name_scene(design: DesignRow) -> SceneDocument:
    """The scene of a design, with the design's number in its name."""
    document = design.document
    assert document is not None
    name = document.name if "name" in design.values else f"{document.name}, design {design.number}"
    model = document.model.model_copy(update={"name": name})
    return dataclasses.replace(document, data={**document.data, "name": name}, model=model)


def unit_of(model: Any, path: str) -> str:
    """The unit of the quantity at a path of a validated scene file, as its description gives it; empty without one."""
    unit, place, steps = "", model, parse_path(path)
    for step in steps:
        if isinstance(step, str) and _as_list(place) is None:
            line = re.search(rf"^ +{step}: .*$", _description(type(place), step), re.MULTILINE)
            found = [words for words in re.findall(r"\[([^][]+)\]", line[0] if line else "") if words in _UNITS]
            unit = found[0] if found else unit
        place = _step_into(place, step, steps[0])
    return unit


def number_of(model: Any, path: str) -> float | None:
    """The number at a path of a validated scene file; None where there is another value, or none."""
    place, steps = model, parse_path(path)
    for step in steps:
        place = _step_into(place, step, steps[0])
    return float(place) if isinstance(place, int | float) and not isinstance(place, bool) else None


def complete_rows(
    rows: Sequence[Mapping[str, Any]], designs: Sequence[DesignRow], paths: Sequence[str]
) -> list[dict[str, Any]]:
    """Rows of results in which an empty cell of a variable has the number of the design's scene.

    Args:
        rows: The rows, of which `design` is the number of the design.
        designs: The designs.
        paths: Columns of the variables.
    """
    models = {str(design.number): design.document.model for design in designs if design.document is not None}
    complete = []
    for row in rows:
        model = models.get(str(row.get("design", "")))
        empty = [path for path in paths if model is not None and row.get(path) in (None, "")]
        found = {path: number_of(model, path) for path in empty}
        complete.append({**row, **{path: f"{number:.17g}" for path, number in found.items() if number is not None}})
    return complete


def _step_into(place: Any, step: Step, first: Step) -> Any:
    """The value that a table or list has at a step of a path, whose `first` step is given; None without it."""
    tables = _as_list(place)
    if tables is None and not isinstance(step, int):
        return getattr(place, step, None)
    index = _NAMED.get(str(first), _NAMED["tool"])[0](tables, step) if isinstance(step, str) else step
    there = tables is not None and index is not None and -len(tables) <= index < len(tables)
    return tables[index] if there and tables and index is not None else None


def _description(table: type, key: str) -> str:
    """The lines on a key in the docstrings of a table's class and of those that it derives from."""
    texts = [one.__doc__ or "" for one in table.__mro__]
    joined = [re.sub(r"\n {12,}(?=\S)", " ", text) for text in texts]
    return next((text for text in joined if re.search(rf"^ +{key}: ", text, re.MULTILINE)), "")


# Designs of experiments: full factorials, Latin hypercubes and Sobol sequences over the variables of a sweep.

MOST_SOBOL = 21_201
"""Variables of a Sobol sequence for which SciPy has direction numbers."""


def sample(table: SweepTable) -> list[dict[str, Any]]:
    """The designs of a sweep's table: values by path, in the units of the scene file.

    Points of a Latin hypercube and of a Sobol sequence (scrambled) are those of `scipy.stats.qmc`.

    Raises:
        InputError: There are too many designs.

    Warns:
        InputWarning: A Sobol sequence has a number of designs that is not a power of two.
    """
    paths = [variable.path for variable in table.variable]
    if table.method == "factorial":
        levels = [_levels(variable) for variable in table.variable]
        count = int(np.prod([float(len(values)) for values in levels]))
        if count > MOST_DESIGNS:
            remedy = 'take fewer levels or variables, or method = "sobol"'
            raise InputError(f"makes {count} designs, more than {MOST_DESIGNS}", remedy, "sweep.method", table.method)
        return [dict(zip(paths, row, strict=True)) for row in itertools.product(*levels)]
    columns = [
        [_place(variable, float(share)) for share in shares]
        for variable, shares in zip(table.variable, _shares(table).T, strict=True)
    ]
    return [dict(zip(paths, row, strict=True)) for row in zip(*columns, strict=True)]


def _shares(table: SweepTable) -> np.ndarray:
    """Points in the unit cube (n_design, n_variable)."""
    from scipy.stats import qmc  # takes half a second to import

    count, dimension = table.designs or 0, len(table.variable)
    if table.method == "latin-hypercube":
        return qmc.LatinHypercube(dimension, rng=table.seed).random(count)
    if count & (count - 1):
        lower = 1 << (count.bit_length() - 1)
        words = f"is not a power of two: the points of a Sobol sequence are balanced for {lower} or {2 * lower}"
        warn_of(words, "choose one of these", key="sweep.designs", value=count)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # SciPy's own words for the same
        return qmc.Sobol(dimension, rng=table.seed).random(count)


def _levels(variable: SweepVariableTable) -> Sequence[Any]:
    """The values of a variable in a full factorial."""
    if variable.values is not None:
        return variable.values
    shares = np.linspace(0.0, 1.0, variable.levels)
    return list(dict.fromkeys(_place(variable, float(share)) for share in shares))


def _place(variable: SweepVariableTable, share: float) -> Any:
    """The value at a share between 0 and 1 of a variable's range."""
    if variable.values is not None:
        return variable.values[min(int(share * len(variable.values)), len(variable.values) - 1)]
    assert variable.bounds is not None
    low, high = variable.bounds
    least, most = int(np.ceil(low)), int(np.floor(high))
    if variable.integer and variable.scale == "linear":
        # Each whole number has the same share, the two at the ends included.
        return min(least + int(share * (most - least + 1)), most)
    if share in (0.0, 1.0):
        value = (low, high)[int(share)]  # the logarithm's inverse misses them by rounding
    elif variable.scale == "log":
        value = float(low * (high / low) ** share)
    else:
        value = float(low + share * (high - low))
    return min(max(round(value), least), most) if variable.integer else value

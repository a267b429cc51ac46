"""Tables of test data: CSV files with a header, in SI units, and the meaning of their columns."""

from __future__ import annotations

import csv
import difflib
import io
import re
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from jaxform import InputError
from jaxform.extend import warn_of
from jaxform.scene_files import expand_path, read_text
from optimize.fitting.states import STATES

Array = np.ndarray

LEAST_SHARE = 1e-3
"""Smallest value for relative differences, relative to the largest of a table."""
KINDS = (*STATES, "relaxation", "bubble")
_ALSO = {"tension": "uniaxial", "biaxial": "equibiaxial", "planar": "pure-shear"}
_UNITS = {
    "stretch": ("", "-", "1"),
    "strain": ("", "-", "1"),
    "stress": ("Pa",),
    "cauchy_stress": ("Pa",),
    "time": ("s",),
    "pressure": ("Pa",),
    "height": ("m",),
    "thickness": ("m",),
}
_EXAMPLES = {"stretch": ("2.0", "a ratio of lengths"), "radius": ("0.05", "in m"), "thickness": ("0.001", "in m")}
_SETTINGS = ("kind", "state", *_EXAMPLES)
_MOST_ROWS, _MOST_HEIGHTS = 20_000, 1000
_PER_CENT = 10.0  # as a strain: a larger one is probably given in per cent
_FARTHEST = 100.0  # a stretch, or its inverse, beyond which the column has something else
_SLACK = 0.02  # as a strain: so much strain needs a stress
_SOFT = 200.0  # Pa: the largest stress of a table below which it is rather in MPa
_TALL = 20.0  # radii: a bubble this high is given in another unit


@dataclass(frozen=True)
class Pull:
    """A test in which a sheet is strained alike everywhere.

    Attributes:
        name: Name in messages and results.
        kind: One of `KINDS`.
        state: One of `STATES`.
        stretch: Stretch along the pull (n,).
        stress: Nominal stress along the pull (n,) [Pa].
        time: Time of each row (n,) [s], the sheet unstrained before 0; None where it is not given.
    """

    name: str
    kind: str
    state: str
    stretch: Array
    stress: Array
    time: Array | None

    @property
    def measured_columns(self) -> dict[str, Array]:
        """The measured columns that a fit is compared with, by name."""
        return {"stress": self.stress}


@dataclass(frozen=True)
class Bubble:
    """A test in which a clamped disc is inflated.

    Attributes:
        name: Name in messages and results.
        height: Height of the pole above the rim (n,) [m].
        pressure: Pressure (n,) [Pa].
        thickness: Thickness at the pole (n,) [m]; None where it is not given.
        time: Time of each row (n,) [s], the sheet flat at 0 and inflated from then on; None where it is not given.
        radius: Radius of the disc [m].
        sheet: Thickness of the sheet before the test [m].
        kind: Name of the kind of test.
    """

    name: str
    height: Array
    pressure: Array
    thickness: Array | None
    time: Array | None
    radius: float
    sheet: float
    kind: str = field(default="bubble", init=False)

    @property
    def measured_columns(self) -> dict[str, Array]:
        """The measured columns that a fit is compared with, by name."""
        more = {} if self.thickness is None else {"thickness": self.thickness}
        return {"pressure": self.pressure, **more}


Table = Pull | Bubble


def read_table(source: str) -> Table:
    """A table of a CSV file, named by its path or as `KIND=PATH`.

    Raises:
        InputError: There is no such file, or its type of test is unknown.
    """
    kind, path = _split(source)
    # Characters that no text file can hold would stop the results later.
    name = " ".join(str(path).encode("utf-8", "backslashreplace").decode().split())
    try:
        columns, settings = _parse(read_text(path), name)
        kind = kind or _kind(path, columns, settings)
        if kind == "bubble":
            return _bubble(name, columns, settings)
        return _pull(name, kind, columns, settings)
    except InputError as error:
        raise error.with_context(file=name) from None


def _split(source: str) -> tuple[str, Path]:
    """The kind that is written before a path, and the path."""
    before, _, after = source.partition("=")
    if after and recognize_kind(before):
        return recognize_kind(before), expand_path(after)
    return "", expand_path(source)


def recognize_kind(word: str) -> str:
    """The kind of test that a word names; empty for none."""
    word = word.strip().lower().replace("_", "-")
    return _ALSO.get(word, word if word in KINDS else "")


def _kind(path: Path, columns: dict[str, Array], settings: dict[str, str]) -> str:
    remedy = (
        f"write it before the path, as in uniaxial={path.name}, or in a line `# kind = ...`; types: {', '.join(KINDS)}"
    )
    if "kind" in settings:
        if not recognize_kind(settings["kind"]):
            raise InputError("is not a type of test", remedy, "kind", settings["kind"])
        return recognize_kind(settings["kind"])
    if {"pressure", "height"} <= set(columns):
        return "bubble"
    stem = path.stem.lower().replace("_", "-")
    found = {recognize_kind(word) for word in (*KINDS, *_ALSO) if word in stem and word != "tension"}
    # The others are tension too.
    found = found or ({"uniaxial"} if "tension" in stem else set())
    if len(found) != 1:
        raise InputError("names more than one type of test" if found else "does not name its type of test", remedy)
    return found.pop()


def _parse(text: str, name: str) -> tuple[dict[str, Array], dict[str, str]]:
    """The columns of a table, (n,) each, and its settings, which stand in lines that start with #."""
    settings: dict[str, str] = {}
    lines: list[tuple[int, str]] = []
    for count, line in enumerate(text.split("\n"), 1):
        setting = re.fullmatch(r"#\s*([a-z_]+)\s*=\s*(.*?)\s*", line)
        if setting:
            settings[setting[1]] = setting[2]
        elif line.strip() and not line.startswith("#"):
            lines.append((count, line))
    if not lines:
        raise InputError("is empty", "give a line of column names, then a row of numbers for each measurement")
    _check_settings(settings, name)
    header = lines[0][1]
    mark = max(",;\t", key=header.count)
    names = [_column(cell, name) for cell in _cells(header, mark)]
    if len(set(names)) < len(names):
        raise InputError("has two columns of the same name", "rename one of them", value=header)
    if len(lines) - 1 > _MOST_ROWS:
        raise InputError(f"has {len(lines) - 1} rows", f"give up to {_MOST_ROWS}, every tenth for instance")
    if len(lines) == 1:
        raise InputError("has no rows", "give a row of numbers for each measurement")
    rows = np.array([_row(cells, mark, names, count) for count, cells in lines[1:]]).reshape(-1, len(names))
    return dict(zip(names, rows.T, strict=True)), settings


def _cells(line: str, mark: str) -> list[str]:
    try:
        return [cell.strip() for cell in next(csv.reader(io.StringIO(line), delimiter=mark))]
    except csv.Error as error:
        raise InputError(f"has a line that is not CSV ({error})", "save it as plain CSV", value=line[:80]) from None


def _column(cell: str, name: str) -> str:
    """The name in a cell such as `stress [Pa]`, with its unit checked."""
    match = re.fullmatch(r"([^\[(]*?)\s*(?:[\[(](.*?)[\])])?", cell)
    word, unit = (match[1].lower(), match[2]) if match else (cell, None)
    if _number(word) is not None:
        raise InputError("has no line of column names", "start with a line of column names", value=cell)
    units = _UNITS.get(word)
    if units is None:
        close = difflib.get_close_matches(word, _UNITS, n=1)
        remedy = f"did you mean {close[0]}?" if close else f"the known columns are {', '.join(_UNITS)}"
        warn_of("is an unknown column and is ignored", remedy, value=cell, file=name)
    elif unit is not None and unit.strip() not in units:
        wanted = units[0] or "the ratio of lengths"
        raise InputError(f"is in {unit.strip()}", f"give it in {wanted}; units are not converted", word)
    return word


def _check_settings(settings: dict[str, str], name: str) -> None:
    for key in settings:
        if key not in _SETTINGS and (close := difflib.get_close_matches(key, _SETTINGS, n=1)):
            warn_of("is not a setting", f"did you mean {close[0]}?", key=key, value=settings[key], file=name)


def _row(line: str, mark: str, names: list[str], count: int) -> list[float]:
    cells = _cells(line, mark)
    if len(cells) != len(names):
        problem = f"has {len(cells)} cells in line {count}, and {len(names)} columns"
        raise InputError(problem, "give one number for each column, with a decimal point", value=line[:80])
    numbers = []
    for word, cell in zip(names, cells, strict=True):
        number = _number(cell)
        if number is None and word in _UNITS:
            raise InputError(f"is not a finite number in line {count}", "correct or remove the line", word, cell)
        numbers.append(np.nan if number is None else number)
    return numbers


def _number(cell: str) -> float | None:
    try:
        number = float(cell)
    except ValueError:
        return None
    return number if abs(number) < 1e30 else None


def _setting(settings: dict[str, str], key: str) -> float:
    """A positive number of the settings."""
    example, unit = _EXAMPLES[key]
    remedy = f"write a line such as `# {key} = {example}`, {unit}"
    if key not in settings:
        raise InputError("is missing", remedy, key)
    number = _number(settings[key].split("#")[0].strip())
    if number is None or number <= 0.0:
        raise InputError("is not a positive number", remedy, key, settings[key])
    return number


def _pull(name: str, kind: str, columns: dict[str, Array], settings: dict[str, str]) -> Pull:
    state = recognize_kind(settings.get("state", "uniaxial")) if kind == "relaxation" else kind
    if state not in STATES:
        raise InputError("is not a stress state", f"use {', '.join(STATES)}", "state", settings["state"])
    stretch = _stretch(name, columns, settings)
    keys = [key for key in ("stress", "cauchy_stress") if key in columns]
    if len(keys) != 1:
        problem = "has both stress and cauchy_stress" if keys else "has no column stress"
        raise InputError(problem, "give stress (nominal) or cauchy_stress [Pa]")
    stress = columns[keys[0]] / (stretch if keys[0] == "cauchy_stress" else 1.0)
    time = columns.get("time")
    if time is None and kind == "relaxation":
        raise InputError("has no column time", "add it, in s")
    if time is not None:
        _check_times(time)
    if time is not None and time[-1] <= 0.0:
        raise InputError("has no time after 0", "give rows at later times", "time", float(time[-1]))
    _warn_of_doubtful_stress(name, keys[0], stretch, stress)
    # A row without strain says nothing, unless it is part of a history.
    used = np.abs(stretch - 1.0) > 1e-9 if time is None else np.ones(len(stretch), bool)
    if not used.any() or not np.any(np.abs(stretch - 1.0) > 1e-9):
        raise InputError("has no row with a strain", "give stretches that differ from 1")
    return Pull(name, kind, state, stretch[used], stress[used], time)


def _stretch(name: str, columns: dict[str, Array], settings: dict[str, str]) -> Array:
    given = [key for key in ("stretch", "strain") if key in columns]
    if not given and "stretch" in settings:
        rows = len(next(iter(columns.values())))
        columns, given = {"stretch": np.full(rows, _setting(settings, "stretch"))}, ["stretch"]
    if len(given) != 1:
        problem = "has both stretch and strain" if given else "has neither stretch nor strain"
        raise InputError(problem, "give stretch (1 without strain) or strain (0 without strain)")
    values = columns[given[0]]
    if given[0] == "strain":
        if values.max() > _PER_CENT:
            warn_of(f"goes up to {values.max():.4g}", "divide by 100 if it is in per cent", key="strain", file=name)
        values = 1.0 + values
    if values.min() <= 0.0:
        remedy = "name the column strain if it is 0 in the unstrained state"
        raise InputError("has a stretch that is not above 0", remedy, given[0], float(columns[given[0]].min()))
    farthest = values[np.argmax(np.abs(np.log(values)))]
    if not 1.0 / _FARTHEST <= farthest <= _FARTHEST:
        percent = (
            "divide by 100 if it is in per cent"
            if given[0] == "strain"
            else "give the ratio of length to initial length"
        )
        raise InputError(f"reaches a stretch of {farthest:.4g}, more than any sheet withstands", percent, given[0])
    return values


def _check_times(time: Array) -> None:
    if time[0] < 0.0:
        raise InputError("starts before 0, when the sample is not strained yet", "start at 0", "time", float(time[0]))
    back = np.flatnonzero(np.diff(time) <= 0.0)
    if len(back):
        raise InputError(
            "does not increase", "sort the rows by time, and give each time once", "time", float(time[back[0] + 1])
        )


def _warn_of_doubtful_stress(name: str, key: str, stretch: Array, stress: Array) -> None:
    """Warns of likely errors in a table."""
    largest = float(np.abs(stress).max())
    if 0.0 < largest < _SOFT:
        warn_of(f"is {largest:.4g} Pa at most", "give it in Pa, if it is in MPa", key=key, file=name)
    if not largest:
        raise InputError("is 0 throughout", "give the stress in Pa", key)
    slack = (np.abs(stretch - 1.0) > _SLACK) & (np.abs(stress) < LEAST_SHARE * largest)
    if slack.any():
        problem = f"is {stress[slack][0]:.4g} Pa at a stretch of {stretch[slack][0]:.4g}"
        warn_of(problem, "leave out rows in which the sample is slack or has torn", key=key, file=name)
    against = (stretch - 1.0) * stress < 0.0
    if against.any() and np.abs(stress[against]).max() > 0.01 * largest:
        problem = f"is {stress[against][0]:.4g} Pa at a stretch of {stretch[against][0]:.4g}"
        warn_of(problem, "stress is positive in tension; is the column stretch a strain?", key=key, file=name)


def _bubble(name: str, columns: dict[str, Array], settings: dict[str, str]) -> Bubble:
    for key in ("pressure", "height"):
        if key not in columns:
            raise InputError(f"has no column {key}", f"add it, in {_UNITS[key][0]}")
    if len(columns["height"]) > _MOST_HEIGHTS:
        raise InputError(f"has {len(columns['height'])} rows", f"give up to {_MOST_HEIGHTS}, every tenth for instance")
    radius, sheet = _setting(settings, "radius"), _setting(settings, "thickness")
    height, pressure, time = columns["height"], columns["pressure"], columns.get("time")
    if height.min() < 0.0:
        raise InputError("is below 0", "give the pole's height above the rim", "height", float(height.min()))
    if (tallest := float(height.max())) > _TALL * radius:
        raise InputError(f"is {tallest / radius:.4g} times the radius", "give both in m", "height", tallest)
    used = (height > 1e-6 * radius) & (pressure > 0.0)
    if not used.any():
        raise InputError("has no row in which the sheet is inflated", "give pressures and heights above 0")
    thickness = columns.get("thickness")
    if thickness is not None and (thickness[used].min() <= 0.0 or thickness[used].max() > 1.2 * sheet):
        problem = (
            f"is from {thickness[used].min():.4g} to {thickness[used].max():.4g} m, and the sheet has {sheet:.4g} m"
        )
        raise InputError(problem, "give the wall thickness at the pole, in m", "thickness")
    wall = None if thickness is None else thickness[used]
    since = None if time is None else _since_flat(time, height, used)
    return Bubble(name, height[used], pressure[used], wall, since, radius, sheet)


def _since_flat(time: Array, height: Array, used: Array) -> Array:
    """Times [s] of the rows that are used, counted from the last one before them: a flat sheet has no memory."""
    _check_times(time)
    first = int(np.argmax(used))
    if not used[first:].all():
        later = first + int(np.argmin(used[first:]))
        problem = f"is flat, or has no pressure, at {time[later]:.4g} s, after it was inflated"
        remedy = "let time be 0 at the start of the inflation, and leave out such rows"
        raise InputError(problem, remedy, "height", float(height[later]))
    return time[first:] - (time[first - 1] if first else 0.0)

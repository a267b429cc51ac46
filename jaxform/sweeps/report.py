"""The report of a sweep: its pictures, and the HTML page."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from html import escape
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from jaxform.core.disk import atomic_path
from jaxform.io import canvas
from jaxform.sweeps.records import Row, number

NAME = "report.html"
_PICTURES = {
    "thinnest_wall.png": "Thinnest wall against each variable",
    "main_effects.png": "Main effects",
    "scatter_matrix.png": "Scatter matrix",
}
_SHOWN = {"m": (1e3, "mm"), "kg": (1e3, "g"), "Pa": (1e-3, "kPa")}
_HIDDEN = ("folder", "digest")


def write_report(
    folder: Path, facts: Mapping[str, Any], columns: Sequence[str], rows: Sequence[Row], pictures: Sequence[str]
) -> Path:
    """Writes report.html into the folder of a sweep, and returns its path.

    Args:
        folder: The folder.
        facts: Contents of sweep.json.
        columns: Columns of results.csv.
        rows: Its rows.
        pictures: Names of the pictures in the folder.

    Raises:
        InputError: It cannot be written.
    """
    shown = [column for column in columns if column not in _HIDDEN]
    drawn = "".join(
        f'<figure class="card"><figcaption>{_PICTURES[name]}</figcaption>'
        f'<a href="{name}"><img src="{name}" alt="{_PICTURES[name]}"></a></figure>'
        for name in pictures
    )
    parts = {
        "title": escape(f"{Path(str(facts['source'])).name}: jaxform sweep"),
        "name": escape(Path(str(facts["source"])).name),
        "counts": _counts(facts),
        "head": "".join(_heading(column, facts["units"].get(column, "")) for column in shown),
        "rows": "\n".join(_row(row, shown, facts["units"]) for row in rows),
        "pictures": drawn,
    }
    text = resources.files(__name__.rpartition(".")[0]).joinpath("sweep.html").read_text(encoding="utf-8")
    page = re.sub(r"@(\w+)@", lambda found: parts[found[1]], text)
    with atomic_path(folder / NAME) as fresh:
        fresh.write_text(page, encoding="utf-8")
    return folder / NAME


def _counts(facts: Mapping[str, Any]) -> str:
    failed = f", <b class=bad>{facts['failed']} failed</b>" if facts["failed"] else ""
    return f"{facts['designs']} designs: {facts['ok']} ok{failed}"


def _heading(column: str, unit: str) -> str:
    shown = "%" if column in ("wall_cv", "contact_fraction") else _SHOWN.get(unit, (1.0, unit))[1]
    words = f"{escape(column)}<small>{escape(f' [{shown}]' if shown else '')}</small>"
    return f'<th scope="col"><button>{words}</button></th>'


def _row(row: Row, columns: Sequence[str], units: Mapping[str, str]) -> str:
    """A row of the table; a click opens the report of its part, where there is one."""
    opens = f' data-part="{escape(row["folder"])}/report.html" tabindex="0"' if row["folder"] else ""
    kind = "" if row["status"] == "ok" else ' class="bad"'
    cells = "".join(_cell(row[column], column, units.get(column, "")) for column in columns)
    return f"<tr{kind}{opens}>{cells}</tr>"


def _cell(text: str, column: str, unit: str) -> str:
    value = number(text)
    if value is None:
        whole, short = escape(text), escape(text if len(text) < 60 else f"{text[:57]}...")
        return f'<td title="{whole}" data-value="{whole}">{short}</td>'
    factor = 100.0 if column in ("wall_cv", "contact_fraction") else _SHOWN.get(unit, (1.0, unit))[0]
    return f'<td class=number data-value="{value!r}">{factor * value:.4g}</td>'


# Pictures of a sweep: main effects, a scatter matrix, and the thinnest wall against each variable.

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

RESPONSES = ("wall_min", "wall_mean", "wall_cv", "mass")
_WORDS = {
    "wall_min": ("thinnest wall", 1e3, "mm"),
    "wall_mean": ("mean wall", 1e3, "mm"),
    "wall_cv": ("coefficient of variation", 100.0, "%"),
    "mass": ("mass", 1e3, "g"),
    "m": ("", 1e3, "mm"),
    "Pa": ("", 1e-3, "kPa"),
}
_MOST_VARIABLES = 8
_WIDE = 30.0  # ratio of the largest to the least value from which a scale is logarithmic
_MOST_CATEGORIES = 24
_MOST_LEVELS, _GROUPS = 12, 5  # more values of a variable than that are grouped into so many groups of the same size
_GOOD, _DOUBTFUL, _FAILED, _MEAN = "#0072b2", "#8b939d", "#c02626", "#d55e00"


@dataclass(frozen=True)
class Axis:
    """A column of the table as numbers to draw.

    Attributes:
        label: Its name and unit.
        values: A number for each row (n_row,); NaN where there is none.
        names: Names of the values 0, 1, ... of a column of texts; empty for numbers.
    """

    label: str
    values: Array
    names: tuple[str, ...] = ()

    @property
    def logarithmic(self) -> bool:
        """True if the range of the values is so large that a linear scale hides the small ones."""
        known = self.values[np.isfinite(self.values)]
        return not self.names and bool(known.min() > 0 and known.max() > _WIDE * known.min())

    @property
    def line(self) -> str:
        """Style of a line through means: none between texts, which have no order."""
        return "none" if self.names else "-"


def draw_all(folder: Path, paths: Sequence[str], rows: Sequence[Row], units: Mapping[str, str]) -> list[str]:
    """Draws the pictures that the results allow for, and returns their names.

    Args:
        folder: Folder of the sweep.
        paths: Columns of the variables.
        rows: Rows of results.csv.
        units: Units of the columns.
    """
    good = np.array([row["status"] == "ok" for row in rows])
    responses = {name: _response(name, rows) for name in RESPONSES}
    drawable = good & np.isfinite(responses["wall_min"].values)
    found = [_variable(path, rows, units.get(path, "")) for path in paths]
    variables = [axis for axis in found if axis is not None and _varies(axis.values[drawable])]
    if not variables or drawable.sum() < 2:
        return []
    variables, left_out = _strongest(variables, responses["wall_min"].values, drawable)
    note = f" (the {len(variables)} variables with the largest effect of {len(variables) + left_out})" * bool(left_out)
    _draw_thinnest(folder / "thinnest_wall.png", variables, responses["wall_min"], good, note)
    _draw_effects(folder / "main_effects.png", variables, list(responses.values()), drawable, note)
    _draw_matrix(folder / "scatter_matrix.png", variables[:5], list(responses.values()), drawable)
    return ["thinnest_wall.png", "main_effects.png", "scatter_matrix.png"]


def _varies(values: Array) -> bool:
    return len(np.unique(values[np.isfinite(values)])) > 1


def _response(name: str, rows: Sequence[Row]) -> Axis:
    words, factor, unit = _WORDS[name]
    values = [number(row.get(name)) for row in rows]
    return Axis(f"{words} [{unit}]", np.array([np.nan if one is None else factor * one for one in values]))


def _variable(path: str, rows: Sequence[Row], unit: str) -> Axis | None:
    """A variable to draw; None where it does not vary, or has too many texts."""
    texts = [row.get(path, "") for row in rows]
    if len(set(texts)) < 2:
        return None
    values = [number(text) for text in texts]
    label = f"{path} [{unit}]" if unit else path
    if all(value is not None for value, text in zip(values, texts, strict=True) if text):
        _, factor, shown = _WORDS.get(unit, ("", 1.0, unit))
        label = f"{path} [{shown}]" if shown else path
        return Axis(label, np.array([np.nan if value is None else factor * value for value in values]))
    names = tuple(dict.fromkeys(texts))
    if len(names) > _MOST_CATEGORIES:
        return None
    short = tuple(_short(name) for name in names)
    return Axis(label, np.array([float(names.index(text)) for text in texts]), short)


def _short(name: str) -> str:
    name = Path(name).name if "/" in name and not name.startswith(("{", "[")) else name
    return (name if len(name) <= 18 else f"{name[:8]}...{name[-8:]}") or "as in the scene"


def _strongest(variables: list[Axis], response: Array, good: Mask) -> tuple[list[Axis], int]:
    """The variables to draw, in their order, and how many are left out: those with the least effect."""
    if len(variables) <= _MOST_VARIABLES:
        return variables, 0
    effect = [np.ptp(_means(variable, response, good)[1]) for variable in variables]
    chosen = np.sort(np.argsort(effect)[::-1][:_MOST_VARIABLES])
    return [variables[k] for k in chosen], len(variables) - _MOST_VARIABLES


def _means(variable: Axis, response: Array, good: Mask) -> tuple[Array, Array]:
    """Values of a variable, or of groups of neighbouring ones, and the mean response of each."""
    known = good & np.isfinite(variable.values) & np.isfinite(response)
    values, found = variable.values[known], response[known]
    levels = np.unique(values)
    if len(levels) <= _MOST_LEVELS:
        groups = [values == level for level in levels]
    else:
        order = np.argsort(values, kind="stable")
        groups = [np.isin(np.arange(len(values)), part) for part in np.array_split(order, _GROUPS)]
    return np.array([values[group].mean() for group in groups]), np.array([found[group].mean() for group in groups])


def _set_scale(axes: Any, variable: Axis, *, up: bool = False) -> None:
    """Sets the names or the scale of an axis."""
    if variable.logarithmic:
        (axes.set_yscale if up else axes.set_xscale)("log")
    if variable.names:
        ticks: dict[str, Any] = {} if up else {"rotation": 35, "ha": "right"}
        (axes.set_yticks if up else axes.set_xticks)(range(len(variable.names)), variable.names, fontsize=8, **ticks)
        (axes.set_ylim if up else axes.set_xlim)(-0.5, len(variable.names) - 0.5)


def _draw_thinnest(path: Path, variables: Sequence[Axis], wall: Axis, good: Mask, note: str) -> None:
    """The thinnest wall of each design over each variable; designs that failed are marked at the bottom."""
    across = min(len(variables), 4)
    down = -(-len(variables) // across)
    figure = canvas.new_figure(max(4.2 * across, 6.0), 3.6 * down + 0.9, f"Thinnest wall of each design{note}")
    cells = figure.subplots(down, across, squeeze=False).ravel()
    known = np.isfinite(wall.values)
    for axes, variable in zip(cells, variables, strict=False):
        axes.plot(variable.values[good & known], wall.values[good & known], "o", color=_GOOD, markersize=5, label="ok")
        doubtful, failed = ~good & known, ~good & ~known
        if doubtful.any():
            x, y = variable.values[doubtful], wall.values[doubtful]
            axes.plot(x, y, "o", color=_FAILED, markerfacecolor="none", markersize=5, label="not ok")
        if failed.any():
            bottom = np.zeros(int(failed.sum()))
            axes.plot(variable.values[failed], bottom, "x", color=_FAILED, markersize=6, label="failed")
        means: dict[str, Any] = {"color": _MEAN, "linestyle": variable.line, "marker": "_" if variable.names else None}
        axes.plot(*_means(variable, wall.values, good), linewidth=2, markersize=16, label="mean", **means)
        axes.set(xlabel=variable.label, ylabel=wall.label)
        _set_scale(axes, variable)
    for axes in cells[len(variables) :]:
        axes.set_visible(False)
    cells[0].legend(frameon=False, fontsize=8)
    figure.tight_layout()
    canvas.save(figure, path)


def _draw_effects(path: Path, variables: Sequence[Axis], responses: Sequence[Axis], good: Mask, note: str) -> None:
    """The mean of each result over each variable, on one scale per result: a steep line is a strong effect."""
    title = f"Main effects: mean over all other variables{note}"
    figure = canvas.new_figure(max(3.0 * len(variables), 6.0), 2.4 * len(responses) + 0.9, title)
    cells = figure.subplots(len(responses), len(variables), squeeze=False, sharey="row", sharex="col")
    for row, response in zip(cells, responses, strict=True):
        mean = float(np.nanmean(response.values[good]))
        for axes, variable in zip(row, variables, strict=True):
            axes.axhline(mean, color=_DOUBTFUL, linewidth=1, linestyle="--")
            means = _means(variable, response.values, good)
            axes.plot(*means, marker="o", linestyle=variable.line, color=_GOOD, markersize=4)
            axes.grid(alpha=0.25)
            axes.spines[["top", "right"]].set_visible(False)
            axes.margins(y=0.15)
        row[0].set_ylabel(response.label)
    for axes, variable in zip(cells[-1], variables, strict=True):
        axes.set_xlabel(variable.label)
        _set_scale(axes, variable)
    figure.tight_layout()
    _save(figure, path)


def _draw_matrix(path: Path, variables: Sequence[Axis], responses: Sequence[Axis], good: Mask) -> None:
    """Every variable and result over every other; on the diagonal how they are distributed."""
    every = [*variables, *responses]
    figure = canvas.new_figure(1.9 * len(every) + 0.6, 1.9 * len(every) + 0.6, "")
    cells = figure.subplots(len(every), len(every), squeeze=False)
    for i, up in enumerate(every):
        for j, across in enumerate(every):
            axes = cells[i, j]
            x, y = across.values[good], up.values[good]
            if i == j:
                _draw_distribution(axes, across, x[np.isfinite(x)])
                axes.set_yticks([])
            else:
                shown = i >= len(variables) > j
                axes.plot(x, y, "o", color=_GOOD if shown else _DOUBTFUL, markersize=3, alpha=0.8)
            axes.tick_params(labelsize=7, which="both", labelbottom=i == len(every) - 1, labelleft=j == 0 and i > 0)
            _set_scale(axes, across)
            if i != j:
                _set_scale(axes, up, up=True)
            if i == len(every) - 1:
                axes.set_xlabel(across.label, fontsize=8)
            if j == 0:
                axes.set_ylabel(up.label, fontsize=8)
    figure.tight_layout(pad=0.6)
    _save(figure, path)


def _draw_distribution(axes: Any, column: Axis, values: Array) -> None:
    """Draws a histogram of the designs' values."""
    count = min(12, max(4, len(values) // 4))
    edges: Any = np.linspace(values.min(), values.max(), count + 1)
    if column.names:
        edges = np.arange(len(column.names) + 1) - 0.5
    elif column.logarithmic:
        edges = np.geomspace(values.min(), values.max(), count + 1)
    axes.hist(values, bins=edges, color=_DOUBTFUL)


def _save(figure: Any, path: Path) -> None:
    """Writes a figure whose diagrams keep their ranges."""
    with atomic_path(path) as fresh:
        figure.savefig(fresh, dpi=100, metadata={"Software": None}, format="png")

"""The files of a fit: the table of the material for a scene, its rows, and the picture of data and fit."""

from __future__ import annotations

import csv
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from jaxform.core.atomic_write import atomic_path
from jaxform.io.canvas import new_figure, save
from jaxform.io.plots import AFTER
from jaxform.io.scene_rewriting import inline

Array = NDArray[np.float64]

_COLORS = (AFTER, "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#7f7f7f")


class FitCurve(NamedTuple):
    """One measured column and its fit.

    Attributes:
        panel: Label of the y axis; curves with the same one share a diagram.
        across: The label of the x axis.
        label: Name of the curve.
        at: Places of the measurements (n,), in the unit of the label.
        measured: Measured values (n,), in the unit of the panel's label.
        fitted: Fitted values (n,), in the same unit.
        line: Places and values (k,) each of the line to draw; None for the fitted rows.
        logarithmic: Whether the x axis is logarithmic.
    """

    panel: str
    across: str
    label: str
    at: Array
    measured: Array
    fitted: Array
    line: tuple[Array, Array] | None = None
    logarithmic: bool = False


def material_text(table: Mapping[str, Any], words: Sequence[str]) -> str:
    """The table `[material]` as TOML, its Maxwell branches as `[material.viscous]`, below comments of a line each."""
    lines = ["# " + " ".join(text.split()) for text in words]
    lines += ["[material]", *(f"{key} = {inline(value)}" for key, value in table.items() if key != "viscous")]
    if "viscous" in table:
        lines += ["[material.viscous]", *(f"{key} = {inline(value)}" for key, value in table["viscous"].items())]
    return "\n".join(lines) + "\n"


def write_material(path: Path, table: Mapping[str, Any], words: Sequence[str]) -> None:
    """Writes what `material_text` gives."""
    with atomic_path(path) as fresh:
        fresh.write_text(material_text(table, words), encoding="utf-8")


def write_rows(path: Path, names: Sequence[str], rows: Iterable[Sequence[Any]]) -> None:
    """Writes rows as CSV."""
    with atomic_path(path) as fresh, fresh.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(names)
        writer.writerows(rows)


def fit_picture(path: Path, title: str, curves: Sequence[FitCurve]) -> None:
    """Measurements as dots and the fit as lines, a diagram for each kind of test; below, their differences.

    Args:
        path: Path of the PNG.
        title: Title above all diagrams.
        curves: Measured and fitted curves.
    """
    panels = list(dict.fromkeys((curve.panel, curve.across) for curve in curves))
    figure = new_figure(max(8.0, 6.5 * len(panels)), 8.0, title)
    grid = figure.subplots(2, len(panels), squeeze=False, height_ratios=(3, 1), sharex="col")
    for (upper, lower), panel in zip(grid.T, panels, strict=True):
        own = [curve for curve in curves if (curve.panel, curve.across) == panel]
        for curve, color in zip(own, _cycle_colors(len(own)), strict=True):
            _draw(upper, lower, curve, color)
        upper.set(ylabel=panel[0])
        lower.set(xlabel=panel[1], ylabel="fit less measured [%]", xscale="log" if own[0].logarithmic else "linear")
        lower.axhline(0.0, color="#7f7f7f", linewidth=0.8)
        upper.legend(frameon=False)
    figure.tight_layout()
    save(figure, path)


def _cycle_colors(count: int) -> list[str]:
    return [_COLORS[k % len(_COLORS)] for k in range(count)]


def _draw(upper: Any, lower: Any, curve: FitCurve, color: str) -> None:
    label = curve.label.replace("$", r"\$")  # or it would be taken for a formula
    upper.plot(curve.at, curve.measured, "o", color=color, markersize=4, alpha=0.7, label=label)
    line = curve.line or (curve.at, curve.fitted)
    upper.plot(*line, "-", color=color, linewidth=1.6)
    told = curve.measured != 0.0
    off = 100.0 * (curve.fitted[told] / curve.measured[told] - 1.0)
    lower.plot(curve.at[told], off, "o-", color=color, markersize=3, linewidth=0.8)

"""Figures and the picture of a formed part, from arrays alone: what a process that only draws imports, without JAX."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from jaxform.core.disk import atomic_path
from jaxform.io import views

Array = NDArray[np.float64]

_DPI = 100


class Line(NamedTuple):
    """A line or points of a diagram: places (n,), and matplotlib's keywords for their style."""

    across: Array
    up: Array
    style: dict[str, Any]


class PartPicture(NamedTuple):
    """A formed part in colours of its wall (n_element,) [mm], with a title, beside a diagram of the wall.

    Attributes:
        title: Title of the picture.
        view: The part.
        wall: Thickness of its elements (n_element,) [mm].
        lines: Lines of the diagram, thickness [mm] over a place.
        across: What the place is, and its unit.
    """

    title: str
    view: views.View
    wall: Array
    lines: list[Line]
    across: str


def draw_part(path: str | Path, part: PartPicture) -> None:
    """Draws a picture of a formed part as PNG."""
    figure = new_figure(16, 7, part.title)
    colors = views.draw(figure.add_axes((0.0, 0.04, 0.47, 0.84), projection="3d"), part.view)
    draw_bar(figure, colors, figure.add_axes((0.475, 0.2, 0.012, 0.5)), "wall thickness [mm]", [part.wall])
    axes = figure.add_axes((0.58, 0.12, 0.39, 0.74))
    for line in part.lines:
        axes.plot(line.across, line.up, **line.style)
    axes.set(xlabel=part.across, ylabel="wall thickness [mm]")
    if axes.lines:
        axes.legend(frameon=False)
    save(figure, path)


def warm_up() -> None:
    """Imports and sets up the libraries for drawing, which takes half the time of a first picture."""
    new_figure(1, 1, "").add_axes((0, 0, 1, 1), projection="3d")


def new_figure(width: float, height: float, title: str) -> Any:
    """A figure of some width and height, in hundreds of pixels, which needs no display."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), dpi=_DPI)
    FigureCanvasAgg(figure)
    if title:
        figure.suptitle(title, fontsize=14)
    return figure


def draw_bar(figure: Any, colors: Any, axes: Any, label: str, walls: Sequence[Array]) -> None:
    """The colour bar, which marks whether walls [mm] are thinner or thicker than its range."""
    every = np.concatenate(walls)
    below, above = every.min() < 0.999 * colors.norm.vmin, every.max() > 1.001 * colors.norm.vmax
    extend = "both" if below and above else "min" if below else "max" if above else "neither"
    figure.colorbar(colors, cax=axes, label=label, extend=extend)


def save(figure: Any, path: str | Path) -> None:
    """Writes a figure as PNG, its diagrams with a grid, from 0 where all is positive."""
    for axes in figure.axes:
        if axes.name != "3d" and axes.lines:  # neither a view nor a colour bar
            axes.grid(alpha=0.25)
            if axes.get_yscale() == "linear" and axes.get_aspect() == "auto" and axes.dataLim.y0 >= 0:
                axes.set_ylim(0.0, 1.08 * axes.dataLim.y1)
            axes.spines["top"].set_visible(False)
    with atomic_path(path) as fresh:
        figure.savefig(fresh, dpi=_DPI, metadata={"Software": None})

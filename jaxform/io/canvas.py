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


Line = tuple[Array, Array, dict[str, Any]]
"""A line or points of a diagram: places along both axes (n,), and matplotlib's keywords for their style."""


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


class ProcessHistory(NamedTuple):
    """A process at times (n,) [s].

    Attributes:
        title: Title of the picture.
        time: The times [s], from 0 to the end of the run.
        pressure: Pressure (n,) [Pa].
        displacements: Displacement (n,) [m] along the way of each tool that moves, the mold included, by name.
        contact: Share (n,) of the formed area in contact with each tool, the mold first, by name.
        colors: Colours of the tools, by name.
        moves: Begin and end [s] of the spans in which a tool moves, by its name.
    """

    title: str
    time: Array
    pressure: Array
    displacements: dict[str, Array]
    contact: dict[str, Array]
    colors: dict[str, str]
    moves: dict[str, list[tuple[float, float]]]


def draw_process(path: str | Path, process: ProcessHistory) -> None:
    """Draws the picture of a process as PNG: panels for pressure, displacements and contact over one axis of time."""
    panels = [_draw_pressure, *([_draw_displacements] if process.displacements else [])]
    panels += [_draw_contact] if process.contact else []
    figure = new_figure(11, 1.2 + 2.4 * len(panels), process.title)
    grid = figure.subplots(len(panels), 1, sharex=True, squeeze=False)[:, 0]
    unit, words = (1e3, "ms") if process.time[-1] < _SHORT else (1.0, "s")
    for axes, panel in zip(grid, panels, strict=True):
        for name, spans in process.moves.items():
            for begin, end in spans:
                axes.axvspan(unit * begin, unit * end, color=process.colors[name], alpha=0.07, linewidth=0)
        panel(axes, process, unit * process.time)
        axes.grid(alpha=0.25)
        axes.spines[["top", "right"]].set_visible(False)
        axes.margins(x=0.0)
    grid[-1].set_xlabel(f"time [{words}]")
    figure.align_ylabels(grid)
    figure.tight_layout()
    with atomic_path(path) as fresh:
        figure.savefig(fresh, dpi=_DPI, metadata={"Software": None})


_SHORT = 0.2  # s: a shorter process is drawn over milliseconds
_PRESSURE = "#0072b2"


def _draw_pressure(axes: Any, process: ProcessHistory, time: Array) -> None:
    largest = float(np.nanmax(np.abs(process.pressure), initial=0.0))
    factor, unit = (1e-5, "bar") if largest >= 1e6 else (1e-3, "kPa") if largest >= 1e3 else (1.0, "Pa")
    axes.plot(time, factor * process.pressure, color=_PRESSURE, linewidth=2)
    axes.fill_between(time, 0.0, factor * process.pressure, color=_PRESSURE, alpha=0.12, linewidth=0)
    axes.set_ylabel(f"pressure [{unit}]")
    if np.nanmin(process.pressure, initial=0.0) >= 0.0:
        axes.set_ylim(0.0, 1.12 * (factor * largest or 1.0))


def _draw_displacements(axes: Any, process: ProcessHistory, time: Array) -> None:
    for name, far in process.displacements.items():
        axes.plot(time, 1e3 * far, color=process.colors[name], linewidth=2, label=name)
    axes.axhline(0.0, color="#7f7f7f", linewidth=0.6)
    axes.set_ylabel("displacement [mm]")
    axes.margins(y=0.12)
    axes.legend(frameon=False, loc="best")


def _draw_contact(axes: Any, process: ProcessHistory, time: Array) -> None:
    """The shares of all tools, one above the other; the upper edge is the contact fraction."""
    names = list(process.contact)
    shares = [100 * process.contact[name] for name in names]
    total = np.sum(shares, axis=0)
    colors = [process.colors[name] for name in names]
    labels = [_contact_words(name, share) for name, share in zip(names, shares, strict=True)]
    axes.stackplot(time, *shares, colors=colors, alpha=0.45, labels=labels, linewidth=0)
    axes.plot(time, total, color="#303030", linewidth=1.2)
    axes.set_ylabel("area in contact [%]")
    axes.set_ylim(0.0, max(100.0, 1.02 * float(total.max())))
    axes.legend(frameon=False, loc="upper left")


def _contact_words(name: str, share: Array) -> str:
    """Label of the share (n,) [%] of the area on a tool."""
    last, most = float(share[-1]), float(share.max())
    at_most = f", at most {most:.3g} %" if most > last + 0.1 else ""
    return f"{name}: {last:.3g} % at the end{at_most}"


def draw_pictures(part: tuple[Path, PartPicture], process: tuple[Path, ProcessHistory] | None) -> None:
    """Draws the picture of a part and, where there is one, that of its process."""
    draw_part(*part)
    if process is not None:
        draw_process(*process)


def draw_part(path: str | Path, part: PartPicture) -> None:
    """Draws a picture of a formed part as PNG."""
    figure = new_figure(16, 7, part.title)
    colors = views.draw(figure.add_axes((0.0, 0.04, 0.47, 0.84), projection="3d"), part.view)
    draw_bar(figure, colors, figure.add_axes((0.475, 0.2, 0.012, 0.5)), "wall thickness [mm]", [part.wall])
    axes = figure.add_axes((0.58, 0.12, 0.39, 0.74))
    for across, up, style in part.lines:
        axes.plot(across, up, **style)
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

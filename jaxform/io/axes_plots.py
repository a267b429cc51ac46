"""Diagrams in the caller's axes: each function draws into `ax`, or into new axes of pyplot, and returns the axes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from jaxform.core.errors import InputError
from jaxform.core.pytree import as_real
from jaxform.io import canvas, plots, surfaces
from jaxform.io.surfaces import distinguishable_points
from jaxform.model.scene import Scene
from jaxform.results import sections
from jaxform.results.result import Result, drop_unused

_SIGNED, _PLAIN = "RdBu", "viridis"


def part(
    result: Result,
    scene: Scene,
    ax: Any = None,
    *,
    edges: bool = False,
    mold: bool = True,
    limits: tuple[float, float] | None = None,
    bar: bool = True,
) -> Any:
    """Draws the formed part in colours of its wall, with the mold in grey behind it.

    Args:
        result: The part.
        scene: The simulated scene.
        ax: Matplotlib axes with `projection="3d"`; new ones by default.
        edges: True if the elements' edges are drawn.
        mold: True if the mold is drawn.
        limits: Range of the colours [mm]; by default that of the formed elements.
        bar: True if a colour bar is added.

    Returns:
        The axes.

    Raises:
        InputError: If the axes are not three-dimensional.
    """
    ax = _axes(ax, projection="3d")
    if ax.name != "3d":
        raise InputError("is not a three-dimensional axes", 'make it with projection="3d"', "ax", ax.name)
    scene, result = drop_unused(scene, result)
    view = surfaces.part_view(scene, result, limits or plots.wall_scale([(scene, result)]), edges=edges)
    colors = canvas.draw(ax, view if mold else view._replace(surfaces=view.surfaces[-1:], outline=None))
    if bar:
        ax.figure.colorbar(colors, ax=ax, label="wall thickness [mm]", shrink=0.6, pad=0.18)
    return ax


def wall(result: Result, scene: Scene, ax: Any = None, **style: Any) -> Any:
    """Draws the wall over the arc length: all nodes of a disc over its meridian, else the first section.

    Of a scene with a `Part` that alone is drawn.

    Args:
        result: The part.
        scene: The simulated scene.
        ax: Matplotlib axes; new ones by default.
        style: Keywords of matplotlib's `plot`, such as `color` and `label`.

    Returns:
        The axes.
    """
    ax, (scene, result) = _axes(ax), drop_unused(scene, result)
    curve = plots.curves_of_part(scene, result)[0]
    disc = sections.is_disc(scene)
    shown = distinguishable_points(curve.arc, curve.thickness) if disc else slice(None)
    look = {"marker": "o", "linestyle": "none", "markersize": 3.5, "alpha": 0.6} if disc else {}
    ax.plot(1e3 * curve.arc[shown], 1e3 * curve.part_thickness[shown], **(look | {"label": curve.label} | style))
    where = "arc length from the axis" if disc else "arc length along the section"
    ax.set(xlabel=f"{where} [mm]", ylabel="wall thickness [mm]", ylim=(0.0, None))
    return ax


def sheet(scene: Scene, values: ArrayLike | None = None, ax: Any = None, *, label: str = "", bar: bool = True) -> Any:
    """Draws values at the nodes over the initial sheet, by default the initial thickness.

    A sheet is seen along its shortest side; one that hides itself then, as a tube, is unrolled about its longest.
    Values of both signs have colours that are white at 0.

    Args:
        scene: The scene.
        values: Values at the nodes (n_node,), such as a gradient with respect to the thickness.
        ax: Matplotlib axes; new ones by default.
        label: Label of the colour bar.
        bar: True if a colour bar is added.

    Returns:
        The axes.

    Raises:
        InputError: If there is not one value for each node.
    """
    ax = _axes(ax)
    if values is None:
        values, label = 1e3 * np.asarray(scene.parison.thickness, float), label or "initial thickness [mm]"
    numbers = np.asarray(values, float)
    count = len(scene.parison.positions)
    if numbers.shape != (count,):
        problem = f"needs one value per node: {count}, not {numbers.shape}"
        raise InputError(problem, "give as many as `scene.parison.thickness` has", "values")
    colors: dict[str, Any] = {"cmap": _PLAIN}
    if numbers.min() < 0.0 < numbers.max():
        most = np.abs(numbers).max()
        colors = {"cmap": _SIGNED, "vmin": -most, "vmax": most}
    drawn = surfaces.draw_map(ax, scene, numbers, **colors)
    if bar:
        ax.figure.colorbar(drawn, ax=ax, label=label)
    return ax


def pressure(scene: Scene, ax: Any = None, **style: Any) -> Any:
    """Draws the pressure over time, of a loading that follows from the time alone.

    Args:
        scene: The scene.
        ax: Matplotlib axes; new ones by default.
        style: Keywords of matplotlib's `plot`, such as `color` and `label`.

    Returns:
        The axes.

    Raises:
        InputError: If the pressure depends on the volume, and so is known after a run only.
    """
    if scene.pressure.follows_volume:
        remedy = "draw what `run` records with `on_window`"
        raise InputError("depends on the enclosed volume", remedy, "pressure", type(scene.pressure).__name__)
    ax = _axes(ax)
    time = np.linspace(0.0, float(scene.solver.end_time), 400)
    ax.plot(1e3 * time, np.asarray(scene.pressure.at(as_real(time))) / 1e3, **style)
    ax.set(xlabel="time [ms]", ylabel="pressure [kPa]")
    return ax


def convergence(history: Sequence[Mapping[str, Any]], ax: Any = None, **style: Any) -> Any:
    """Draws the gain of a search over its cost: the deviation from the target, else the objective.

    Args:
        history: Rows of the search, `Design.history`, with the columns of history.csv.
        ax: Matplotlib axes; new ones by default.
        style: Keywords of matplotlib's `plot`, such as `color` and `label`.

    Returns:
        The axes.
    """
    ax = _axes(ax)
    cost, objective = plots.column(history, "simulations"), plots.column(history, "objective")
    error = 100 * plots.column(history, "thickness_rms_error")
    deviates = bool(np.isfinite(error).any())
    ax.plot(cost, error if deviates else objective, **({"marker": "o", "markersize": 4} | style))
    words = "deviation from the target, rms [%]" if deviates else "objective"
    ax.set(xlabel="cost in simulations", ylabel=words, yscale="log")
    return ax


def _axes(ax: Any, **options: Any) -> Any:
    """The axes, or new ones of a new figure."""
    if ax is not None:
        return ax
    import matplotlib.pyplot as plt

    return plt.figure().add_subplot(**options)

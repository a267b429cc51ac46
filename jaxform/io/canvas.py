"""Figures, surfaces seen from outside, and the picture of a formed part, from arrays alone, without JAX."""

from __future__ import annotations

import functools
import itertools
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from jaxform.core.disk import atomic_path
from jaxform.core.errors import format_percent
from jaxform.mesh import raster

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
        across: Label of the place, with its unit.
    """

    title: str
    view: View
    wall: Array
    lines: list[Line]
    across: str


class ProcessHistory(NamedTuple):
    """A process at times (n,) [s].

    Attributes:
        title: Title of the picture.
        time: The times [s], from 0 to the end of the run.
        pressures: Pressures (n,) [Pa] by name: one without a name, or those of the gases of regions.
        displacements: Displacement (n,) [m] along the way of each tool that moves, the mold included, by name.
        contact: Share (n,) of the formed area in contact with each tool, the mold first, by name.
        colors: Colours of the tools, by name.
        moves: Begin and end [s] of the spans in which a tool moves, by its name.
        release: Time [s] at which the clamp opens; None where it does not before the end.
    """

    title: str
    time: Array
    pressures: dict[str, Array]
    displacements: dict[str, Array]
    contact: dict[str, Array]
    colors: dict[str, str]
    moves: dict[str, list[tuple[float, float]]]
    release: float | None


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
        if process.release is not None:
            axes.axvline(unit * process.release, color=_RELEASE, linewidth=1.4, linestyle="--")
        axes.grid(alpha=0.25)
        axes.spines[["top", "right"]].set_visible(False)
        axes.margins(x=0.0)
    if process.release is not None:
        _label_release(grid[0], unit * process.release, f"the clamp opens at {unit * process.release:.3g} {words}")
    grid[-1].set_xlabel(f"time [{words}]")
    figure.align_ylabels(grid)
    figure.tight_layout()
    with atomic_path(path) as fresh:
        figure.savefig(fresh, dpi=_DPI, metadata={"Software": None})


_SHORT = 0.2  # s: a shorter process is drawn over milliseconds
PRESSURE_COLORS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9")
_RELEASE = "#8c2d04"


def _label_release(axes: Any, time: float, words: str) -> None:
    """Writes above the panel that the clamp opens, on the side where the line of that time leaves more room."""
    low, high = axes.get_xlim()
    side = "left" if time < 0.5 * (low + high) else "right"
    axes.text(time, 1.02, words, transform=axes.get_xaxis_transform(), ha=side, va="bottom", color=_RELEASE)


def _draw_pressure(axes: Any, process: ProcessHistory, time: Array) -> None:
    together = np.stack(list(process.pressures.values()))
    largest = float(np.nanmax(np.abs(together), initial=0.0))
    factor, unit = (1e-5, "bar") if largest >= 1e6 else (1e-3, "kPa") if largest >= 1e3 else (1.0, "Pa")
    colors = itertools.cycle(PRESSURE_COLORS)
    for (name, pressure), color in zip(process.pressures.items(), colors, strict=False):
        axes.plot(time, factor * pressure, color=color, linewidth=2, label=name)
        if len(together) == 1:
            axes.fill_between(time, 0.0, factor * pressure, color=color, alpha=0.12, linewidth=0)
    axes.set_ylabel(f"pressure [{unit}]")
    if np.nanmin(together, initial=0.0) >= 0.0:
        axes.set_ylim(0.0, 1.12 * (factor * largest or 1.0))
    if len(together) > 1:
        axes.legend(frameon=False, loc="best")


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
    shares = [process.contact[name] for name in names]
    total = 100 * np.sum(shares, axis=0)
    colors = [process.colors[name] for name in names]
    labels = [_contact_words(name, share) for name, share in zip(names, shares, strict=True)]
    axes.stackplot(time, *(100 * share for share in shares), colors=colors, alpha=0.45, labels=labels, linewidth=0)
    axes.plot(time, total, color="#303030", linewidth=1.2)
    axes.set_ylabel("area in contact [%]")
    axes.set_ylim(0.0, max(100.0, 1.02 * float(total.max())))
    axes.legend(frameon=False, loc="upper left")


def _contact_words(name: str, share: Array) -> str:
    """Label of the share (n,) of the area on a tool, over time."""
    last, most = float(share[-1]), float(share.max())
    at_most = f", at most {format_percent(most, 3)}" if most > last + 0.001 else ""
    return f"{name}: {format_percent(last, 3)} at the end{at_most}"


def draw_pictures(part: tuple[Path, PartPicture], process: tuple[Path, ProcessHistory] | None) -> None:
    """Draws the picture of a part and, where there is one, that of its process."""
    draw_part(*part)
    if process is not None:
        draw_process(*process)


def draw_part(path: str | Path, part: PartPicture) -> None:
    """Draws a picture of a formed part as PNG."""
    figure = new_figure(16, 7, part.title)
    colors = draw(figure.add_axes((0.0, 0.04, 0.47, 0.84), projection="3d"), part.view)
    draw_bar(figure, colors, figure.add_axes((0.482, 0.2, 0.012, 0.5)), "wall thickness [mm]", [part.wall])
    axes = figure.add_axes((0.6, 0.12, 0.38, 0.74))
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


# Surfaces seen from outside, drawn in matplotlib's 3-D axes pixel by pixel. Knows arrays alone, and no JAX.

TO_EYE = np.array([1.0, -1.0, 0.0])
MINIMUM = "#d00000"
_COLORS = "viridis"  # reads the same to all eyes, and in grey
_CUT_OFF = 0.82  # grey of what is formed with the part, but cut off it
_LIGHT = np.array([0.35, -0.5, 0.79])
_FINER, _MANY = 2, 150_000  # pixels of the surfaces along one of the picture; triangles from which it is one
_TALL, _FITS = 0.8, 4  # times as high as wide, a view is measured before it is drawn, so often at most
_BESIDE = 10.0  # points from the axis of a tall view to its label, beside the ticks; 4 otherwise
_LINE, _LINED = 0.7, 5.0  # pixels: half an element's edge, and how high an element is whose edges are drawn


class DrawnSurface(NamedTuple):
    """A surface to draw.

    Attributes:
        faces: Triangles (n, 3, 3) [mm].
        paint: Their colours (n, 3), or numbers (n,) that colours show; NaN is grey.
        opaque: Their opacity, 0 to 1.
        edges: True if their edges are drawn.
        open_at: Two axes and places [mm]: what lies between the eye and both planes is left out.
    """

    faces: Array
    paint: Array
    opaque: float = 1.0
    edges: bool = False
    open_at: tuple[tuple[int, float], tuple[int, float]] | None = None


class View(NamedTuple):
    """Content of a view from outside.

    Attributes:
        surfaces: Surfaces, from back to front.
        outline: Lines (n, 2, 3) [mm] behind them, thin and grey; None where there are none.
        hangs: True if z points down, for a view into a hanging part, or onto one that stands up towards -z.
        turned: True if y is reversed as well, so that the view is no mirror image: for parts without symmetry.
        scale: Range of the values that colours show.
        mark: A place (3,) [mm] to mark as the minimum, or None.
    """

    surfaces: list[DrawnSurface]
    outline: Array | None = None
    hangs: bool = False
    turned: bool = False
    scale: tuple[float, float] = (0.0, 1.0)
    mark: Array | None = None


def draw(axes: Any, view: View) -> Any:
    """Draws a view in matplotlib's 3-D axes; returns what a colour bar needs."""
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import Normalize

    colors = ScalarMappable(Normalize(*view.scale, clip=True), _COLORS)
    if view.outline is not None:
        _draw_outline(axes, view.outline)
    _draw_surfaces(axes, [_color_faces(surface, colors) for surface in view.surfaces], view.hangs, view.turned)
    if view.mark is not None:
        axes.plot(*view.mark[:, None], "o", color=MINIMUM, mec="white", mew=1.2, ms=8, zorder=5)
    return colors


def _color_faces(surface: DrawnSurface, colors: Any) -> DrawnSurface:
    """The surface with colours for its values, and grey where there is none."""
    if surface.paint.ndim == 2:
        return surface
    paint = np.asarray(colors.to_rgba(surface.paint))[:, :3]
    return surface._replace(paint=np.where(np.isfinite(surface.paint)[:, None], paint, _CUT_OFF))


def _draw_outline(axes: Any, lines: Array) -> None:
    from mpl_toolkits.mplot3d.art3d import Line3DCollection

    axes.computed_zorder = False
    axes.add_collection3d(Line3DCollection(lines, colors="#00000040", linewidths=0.6, zorder=0.5), autolim=False)


def _draw_surfaces(axes: Any, surfaces: list[DrawnSurface], hangs: bool, turned: bool) -> None:
    axes.computed_zorder = False
    for order, surface in enumerate(surfaces):
        axes.add_artist(_scenery(surface, zorder=float(order)))
    points = np.concatenate([surface.faces.reshape(-1, 3) for surface in surfaces])
    low, high = points.min(0), points.max(0)
    size = np.maximum(high - low, 0.02 * (high - low).max())
    axes.set_box_aspect(size, zoom=1.0)
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), zlim=(low[2], high[2] + 1e-9))
    if hangs:
        axes.set_zlim(high[2] + 1e-9, low[2])
    if hangs and turned:
        axes.set_ylim(high[1], low[1])
    axes.view_init(elev=36 if hangs else 24, azim=-45)
    axes.tick_params(labelsize=8)
    axes.locator_params(nbins=4)
    axes.set_xlabel("x [mm]", fontsize=9)
    axes.set_ylabel("y [mm]", fontsize=9)
    tall = size[2] > _TALL * size[:2].max()
    # The ticks of a tall view are beside the middle of the axis, where the label is.
    axes.set_zlabel("z [mm]", fontsize=9, labelpad=_BESIDE if tall else None)
    if tall:
        _fit(axes, size)


def _fit(axes: Any, size: Array) -> None:
    """Makes a tall view smaller until its ticks and labels are in its place in the figure."""
    scenery, place = [artist for artist in axes.artists if artist.get_visible()], axes.bbox
    for artist in scenery:
        artist.set_visible(False)
    zoom = 1.0
    for _ in range(_FITS):
        axes.figure.draw_without_rendering()
        extent = axes.get_tightbbox(axes.figure.canvas.get_renderer())
        # Labels stay as large as they are, so a view shrinks a little more than its box.
        beyond = max(
            (extent.y1 - extent.y0) / place.height,
            (extent.x1 - extent.x0) / place.width,
            1.0 + 2 * max(place.y0 - extent.y0, extent.y1 - place.y1) / place.height,
        )
        if beyond <= 1.0:
            break
        zoom /= beyond
        axes.set_box_aspect(size, zoom=zoom)
    for artist in scenery:
        artist.set_visible(True)


def _scenery(surface: DrawnSurface, zorder: float) -> Any:
    """An artist that draws a surface as an image over its axes."""
    from matplotlib.artist import Artist

    class Scenery(Artist):
        def draw(self, renderer: Any) -> None:
            axes: Any = self.axes
            low = np.maximum(np.floor(axes.bbox.min), 0)
            high = np.minimum(np.ceil(axes.bbox.max), np.ceil(axes.figure.bbox.max))
            width, height = (int(extent) for extent in high - low)
            pixels, depth = _project(axes, surface.faces)
            finer = _FINER if len(surface.faces) <= _MANY else 1
            image = _image(surface, finer * (pixels - low), depth, width, height, finer)
            context = renderer.new_gc()
            renderer.draw_image(context, float(low[0]), float(low[1]), np.round(255 * image).astype(np.uint8))
            context.restore()

    artist = Scenery()
    artist.set_zorder(zorder)
    return artist


def _project(axes: Any, faces: Array) -> tuple[Array, Array]:
    """Corners (n, 3, 2) in pixels of the figure, from its lower left, and their depth (n, 3)."""
    x, y, z = (np.ascontiguousarray(faces[..., k]).ravel() for k in range(3))
    across, up, depth, away = (row[0] * x + row[1] * y + row[2] * z + row[3] for row in np.asarray(axes.M))
    pixels = axes.transData.transform(np.stack([across / away, up / away], axis=1))
    return pixels.reshape(-1, 3, 2), (depth / away).reshape(-1, 3)


def _image(surface: DrawnSurface, corners: Array, depth: Array, width: int, height: int, finer: int) -> Array:
    """Colours of a surface and its coverage (height, width, 4), sampled in so many times as many pixels.

    The corners are in these finer pixels. Partly covered pixels are less opaque.
    """
    faces, wide = surface.faces, finer * width
    kept = None if surface.open_at is None else _is_behind(surface)
    nearest = raster.nearest_in_pixels(corners, depth, wide, finer * height, kept)
    hit = np.flatnonzero(nearest >= 0)
    triangle = nearest[hit]
    # Few of many triangles are visible.
    seen = np.zeros(len(faces), bool)
    seen[triangle] = True
    a, b, c = (faces[seen, corner] for corner in range(3))
    normal = np.cross(b - a, c - a)
    length = np.linalg.norm(normal, axis=1)
    bright = np.zeros(len(faces))
    bright[seen] = 0.72 + 0.28 * np.abs(normal @ _LIGHT) / np.where(length > 0, length, 1.0)
    paint = surface.paint[triangle] * bright[triangle, None]
    if surface.edges:
        paint[_is_on_edge(corners, triangle, raster.weights(corners, triangle, hit, wide))] *= 0.6
    pixel = hit // (wide * finer) * width + hit % wide // finer
    sums = [np.bincount(pixel, part, width * height) for part in (*paint.T, np.ones(len(hit)))]
    covered = sums.pop()
    shares = [total / np.maximum(covered, 1.0) for total in sums]
    image = np.stack([*shares, surface.opaque / finer**2 * covered], axis=1)
    return image.reshape(height, width, 4)


def _is_behind(surface: DrawnSurface) -> Callable[[raster.Interpolation], NDArray[np.bool_]]:
    """A function for the mask of a cut-open surface's pixels that are not between the eye and both planes."""

    def is_visible(interpolate: raster.Interpolation) -> NDArray[np.bool_]:
        # As the triangles are small, perspective hardly bends them.
        front = [
            TO_EYE[axis] * (interpolate(surface.faces[:, :, axis]) - place) > 0 for axis, place in surface.open_at or ()
        ]
        return ~np.logical_and.reduce(front)

    return is_visible


def _is_on_edge(corners: Array, triangle: NDArray[np.integer], weights: Array) -> NDArray[np.bool_]:
    """Mask of pixels (n,), with weights (3, n), on the edges of triangles that are large enough to show them."""
    side = corners[:, [2, 0, 1]] - corners[:, [1, 2, 0]]
    one, other = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    twice = np.abs(one[:, 0] * other[:, 1] - one[:, 1] * other[:, 0])
    tall = twice[:, None] / np.maximum(np.linalg.norm(side, axis=2), 1e-12)
    away = functools.reduce(np.minimum, [w * side[triangle] for w, side in zip(weights, tall.T, strict=True)])
    return (away < _LINE) & (tall.min(1) > _LINED * _FINER)[triangle]

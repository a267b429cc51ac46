"""Pictures: the formed part with its wall, the search, and a design before and after. The only user of matplotlib."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from jaxform import sections, topology
from jaxform.pytree import as_real
from jaxform.result import Result, explain, only_used, wall_statistics
from jaxform.scene import Scene

Array = NDArray[np.float64]
Part = tuple[Scene, Result]

_COLORS = "viridis"  # reads the same to all eyes, and in grey
_BEFORE, _AFTER, _EXACT = "#7f7f7f", "#0072b2", "#d55e00"
_DPI = 100
_KEPT = 5e-3  # of a limit, by which it may be broken
_LIGHT = np.array([0.35, -0.5, 0.79])
_MOLD_LINES = 2000  # triangles, above which a mold's outline is not drawn


def thickness_picture(
    path: str | Path, scene: Scene, result: Result, reference: Mapping[str, Any] | None = None
) -> None:
    """The formed part in colours of its wall, and the wall along a meridian or section.

    Args:
        path: Where the PNG goes.
        scene: What was simulated.
        result: The part.
        reference: An exact solution to dot over it: `initial_radius` [m], `arc` [m] from the axis, `thickness_ratio`.
    """
    scene, result = only_used(scene, result)
    figure = _figure(16, 7, _title(scene, result))
    view = figure.add_axes((0.0, 0.04, 0.47, 0.84), projection="3d")
    colors = _draw_part(view, scene, result, _scale([result]))
    bar = figure.add_axes((0.475, 0.2, 0.012, 0.5))
    figure.colorbar(colors, cax=bar, label="wall thickness [mm]")
    axes = figure.add_axes((0.58, 0.12, 0.39, 0.74))
    _draw_wall(axes, scene, result, reference)
    _save(figure, path)


def convergence_picture(path: str | Path, history: Sequence[Mapping[str, Any]]) -> None:
    """Deviation from the target (the objective where there is none), and the wall, over what a search took.

    Args:
        path: Where the PNG goes.
        history: Rows of the search, with the columns of history.csv.
    """
    figure = _figure(14, 5.5, "")
    left, right = figure.subplots(1, 2)
    spent = _column(history, "simulations")
    error, words = 100 * _column(history, "thickness_rms_error"), "deviation from the target, rms [%]"
    if not np.isfinite(error).any():
        error, words = _column(history, "objective"), "objective"
    left.plot(spent, error, "o", color=_BEFORE, markersize=4, label="each simulation")
    if "violation" in history[0]:
        kept = _column(history, "violation") <= _KEPT
        left.plot(spent[kept], error[kept], "o", color=_AFTER, markersize=5, label="limits kept")
    else:
        left.plot(spent, np.fmin.accumulate(error), "-", color=_AFTER, label="best so far")
    left.set(yscale="log", xlabel="cost in simulations", ylabel=words)
    left.legend(frameon=False)
    right.plot(spent, 1e3 * _column(history, "wall_mean"), "-", color=_AFTER, label="mean wall [mm]")
    right.plot(spent, 1e3 * _column(history, "wall_min"), "--", color=_AFTER, label="thinnest wall [mm]")
    right.set(xlabel="cost in simulations", ylabel="wall thickness [mm]")
    twin = right.twinx()
    twin.plot(spent, 100 * _column(history, "wall_cv"), "-", color=_EXACT, label="variation [%]")
    twin.set(ylabel="variation of the wall [%]")
    twin.spines["top"].set_visible(False)
    right.legend(handles=[*right.lines, *twin.lines], frameon=False, loc="center right")
    figure.tight_layout()
    _save(figure, path)


def design_picture(path: str | Path, before: Part, after: Part, target: float | None = None) -> None:
    """A design before and after: parts, initial thickness, wall and pressure.

    Args:
        path: Where the PNG goes.
        before: Scene and part to begin with.
        after: Scene and part of the design.
        target: Wall thickness that is wanted everywhere [m], or None.
    """
    before, after = only_used(*before), only_used(*after)
    figure = _figure(16, 12, "")
    scale = _scale([before[1], after[1]])
    for place, words, part in ((0.0, "before", before), (0.46, "after", after)):
        view = figure.add_axes((place, 0.46, 0.45, 0.47), projection="3d")
        colors = _draw_part(view, *part, scale)
        figure.text(place + 0.225, 0.955, _part_words(words, part), ha="center", fontsize=13)
    figure.colorbar(colors, cax=figure.add_axes((0.925, 0.52, 0.012, 0.34)), label="wall thickness [mm]")
    same = np.array_equal(before[0].pressure.value, after[0].pressure.value)
    count = 2 if same else 3
    width = 0.93 / count
    places = [(0.065 + k * width, 0.07, width - 0.075, 0.34) for k in range(count)]
    _draw_initial(figure.add_axes(places[0]), before[0], after[0])
    _draw_walls(figure.add_axes(places[1]), before, after, target)
    if not same:
        _draw_pressures(figure.add_axes(places[2]), before[0], after[0])
    _save(figure, path)


def stages_picture(path: str | Path, scene: Scene, results: Sequence[Result]) -> None:
    """The part at several times, side by side, in colours of its wall.

    Args:
        path: Where the PNG goes.
        scene: What was simulated.
        results: The part at each time.
    """
    parts = [only_used(scene, result) for result in results]
    figure, scale = _figure(5.5 * len(parts), 5.5, scene.name), _scale([part for _, part in parts])
    for k, (shown, part) in enumerate(parts):
        view = figure.add_axes((0.95 * k / len(parts), 0.02, 0.95 / len(parts), 0.84), projection="3d")
        colors = _draw_part(view, shown, part, scale, edges=True)
        words = f"t = {1e3 * float(part.time):.4g} ms, {len(part.triangles)} elements"
        figure.text(0.95 * (k + 0.5) / len(parts), 0.88, words, ha="center", fontsize=12)
    figure.colorbar(colors, cax=figure.add_axes((0.96, 0.25, 0.005, 0.45)), label="wall [mm]")
    _save(figure, path)


def warm_up() -> None:
    """Imports and sets up what a picture needs, half of what a first one takes."""
    _figure(1, 1, "").add_axes((0, 0, 1, 1), projection="3d")


def _figure(width: float, height: float, title: str) -> Any:
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), dpi=_DPI)
    FigureCanvasAgg(figure)
    if title:
        figure.suptitle(title, fontsize=14)
    return figure


def _save(figure: Any, path: str | Path) -> None:
    for axes in figure.axes:
        if axes.name != "3d" and axes.lines:  # neither a view nor a colour bar
            axes.grid(alpha=0.25)
            if axes.get_yscale() == "linear" and axes.dataLim.y0 >= 0:
                axes.set_ylim(0.0, 1.08 * axes.dataLim.y1)
            axes.spines["top"].set_visible(False)
    figure.savefig(path, dpi=_DPI, metadata={"Software": None})


def _title(scene: Scene, result: Result) -> str:
    wall = wall_statistics(result)
    numbers = ", ".join(f"{words} {1e3 * wall[key]:.3g}" for key, words in _STATISTICS)
    text = f"{scene.name}: wall {numbers} mm (variation {100 * wall['cv']:.3g} %)"
    status = explain(result)
    return text if status == "ok" else f"{text}\nnot finished: {status.split(';')[0]}"


_STATISTICS = (("min", "least"), ("mean", "mean"), ("max", "largest"))


def _part_words(words: str, part: Part) -> str:
    result = part[1]
    wall = wall_statistics(result)
    return (
        f"{words}: variation {100 * wall['cv']:.3g} %, wall {1e3 * wall['min']:.3g} to {1e3 * wall['max']:.3g} mm, "
        f"{1e3 * float(result.mass):.3g} g"
    )


def _scale(results: Sequence[Result]) -> tuple[float, float]:
    """Range of the colours [mm], shared by all that are drawn."""
    walls = np.concatenate([np.asarray(result.element_thickness, float) for result in results])
    low, high = 1e3 * float(walls.min()), 1e3 * float(walls.max())
    return (low, high) if high > 1.001 * low else (0.95 * low, 1.05 * high)


def mirrored(scene: Scene, points: Array, open_front: bool = False) -> list[Array]:
    """The points (..., 3) and their images in the symmetry planes, so that the whole part is seen.

    Args:
        scene: The scene, which knows the planes.
        points: In the modelled part.
        open_front: Leave one image out where there are four, for a look inside.
    """
    planes = sections.symmetry_planes(scene)
    images = []
    for flips in itertools.product((False, True), repeat=len(planes)):
        image = np.array(points)
        for (axis, place), flip in zip(planes.items(), flips, strict=True):
            if flip:
                image[..., axis] = 2 * place - image[..., axis]
        images.append(image)
    # The second of four is the one between the eye and the rest.
    return [images[0], *images[2:]] if open_front and len(images) == 4 else images


def _draw_part(axes: Any, scene: Scene, result: Result, scale: tuple[float, float], edges: bool = False) -> Any:
    """The part as shaded triangles, with their edges where asked for; returns what a colour bar needs."""
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import Normalize
    from mpl_toolkits.mplot3d.art3d import Poly3DCollection

    colors = ScalarMappable(Normalize(*scale), _COLORS)
    corners = 1e3 * np.asarray(result.positions, float)[np.asarray(scene.parison.triangles)]
    faces = np.concatenate([1e3 * image for image in mirrored(scene, corners / 1e3, open_front=True)])
    copies = len(faces) // len(corners)
    paint = np.asarray(colors.to_rgba(1e3 * np.asarray(result.element_thickness, float)))
    paint = np.tile(paint, (copies, 1))
    normal = np.cross(faces[:, 1] - faces[:, 0], faces[:, 2] - faces[:, 0])
    length = np.linalg.norm(normal, axis=1, keepdims=True)
    bright = 0.72 + 0.28 * np.abs((normal / np.where(length > 0, length, 1.0)) @ _LIGHT)
    paint[:, :3] *= bright[:, None]
    lines: Any = "#00000060" if edges else paint
    axes.add_collection3d(Poly3DCollection(faces, facecolors=paint, edgecolors=lines, linewidths=0.2))
    _draw_outline(axes, scene)
    _set_box(axes, faces.reshape(-1, 3), hangs=_hangs(scene, result))
    return colors


def _hangs(scene: Scene, result: Result) -> bool:
    """Whether the part is drawn hanging, so that one looks into it: sheets that rose from a plane."""
    rise = np.asarray(result.positions, float)[:, 2] - np.asarray(scene.parison.positions, float)[:, 2]
    return bool(np.asarray(scene.parison.clamped).any() and rise.mean() > 0 and sections.symmetry_planes(scene))


def _draw_outline(axes: Any, scene: Scene) -> None:
    """The mold's sharp and free edges, thin and grey, behind the modelled part and its images alike."""
    from mpl_toolkits.mplot3d.art3d import Line3DCollection

    if scene.mold is None or len(scene.mold.triangles) > _MOLD_LINES:
        return
    edges = topology.feature_edges(np.asarray(scene.mold.vertices, float), np.asarray(scene.mold.triangles))
    axes.add_collection3d(Line3DCollection(1e3 * edges, colors="#00000030", linewidths=0.6))


def _set_box(axes: Any, points: Array, hangs: bool) -> None:
    low, high = points.min(0), points.max(0)
    size = np.maximum(high - low, 0.02 * (high - low).max())
    axes.set_box_aspect(size, zoom=1.0)
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), zlim=(low[2], high[2] + 1e-9))
    if hangs:
        axes.set_zlim(high[2] + 1e-9, low[2])
    axes.view_init(elev=36 if hangs else 24, azim=-45)
    axes.tick_params(labelsize=8)
    axes.locator_params(nbins=4)
    axes.set_xlabel("x [mm]", fontsize=9)
    axes.set_ylabel("y [mm]", fontsize=9)
    axes.set_zlabel("z [mm]", fontsize=9)


def _draw_wall(axes: Any, scene: Scene, result: Result, reference: Mapping[str, Any] | None) -> None:
    """Wall thickness over arc length, or over the initial radius with the exact solution in dots.

    With an exact solution the place is that in the initial sheet: flat elements cut a sharp corner short, and beyond
    it the arc lengths of the two would no longer name the same place.
    """
    disc = sections.is_disc(scene)
    if reference is not None and disc:
        _draw_exact(axes, scene, result, reference)
        return
    for curve, color in zip(sections.curves(scene, result), (_AFTER, _EXACT), strict=False):
        style = {"marker": "o", "linestyle": "none", "markersize": 3.5, "alpha": 0.6} if disc else {}
        axes.plot(1e3 * curve.arc, 1e3 * curve.thickness, color=color, label=curve.label, **style)
    where = "arc length from the axis" if disc else "arc length along the section"
    axes.set(xlabel=f"{where} [mm]", ylabel="wall thickness [mm]")
    if axes.lines:
        axes.legend(frameon=False)


def _draw_exact(axes: Any, scene: Scene, result: Result, reference: Mapping[str, Any]) -> None:
    place, wall = 1e3 * sections.initial_radius(scene), 1e3 * np.asarray(result.thickness, float)
    axes.plot(place, wall, "o", color=_AFTER, markersize=4, alpha=0.6, label="simulated, all nodes")
    initial = 1e3 * float(np.asarray(scene.parison.thickness).mean())
    order = np.argsort(np.asarray(reference["initial_radius"]))
    radius, ratio = (np.asarray(reference[key], float)[order] for key in ("initial_radius", "thickness_ratio"))
    axes.plot(1e3 * radius, initial * ratio, ":", color=_EXACT, linewidth=2.5, label="exact solution")
    axes.set(
        xlabel="place along the meridian: radius in the initial sheet [mm]",
        ylabel="wall thickness [mm]",
    )
    axes.legend(frameon=False)


def _draw_initial(axes: Any, before: Scene, after: Scene) -> None:
    disc = sections.is_disc(before)
    along = int(np.argmax(np.ptp(np.asarray(before.parison.positions, float), axis=0)))
    for scene, color, words in ((before, _BEFORE, "before"), (after, _AFTER, "after")):
        place = sections.initial_radius(scene) if disc else np.asarray(scene.parison.positions, float)[:, along]
        order = np.argsort(place)
        thickness = np.asarray(scene.parison.thickness, float)[order]
        line: dict[str, Any] = {"linewidth": 2} if disc else {"linestyle": "none", "marker": ".", "markersize": 4}
        axes.plot(1e3 * place[order], 1e3 * thickness, color=color, label=words, **line)
    where = "initial radius" if disc else f"initial {'xyz'[along]}"
    axes.set(xlabel=f"{where} [mm]", ylabel="initial thickness [mm]")
    axes.legend(frameon=False)


def _draw_walls(axes: Any, before: Part, after: Part, target: float | None) -> None:
    for (scene, result), color, words in ((before, _BEFORE, "before"), (after, _AFTER, "after")):
        for curve in sections.curves(scene, result)[:1]:
            axes.plot(1e3 * curve.arc, 1e3 * curve.thickness, ".", color=color, markersize=4, label=words)
    if target is not None:
        axes.axhline(1e3 * target, color=_EXACT, linestyle="--", label="target")
    axes.set(xlabel="arc length in the part [mm]", ylabel="wall thickness [mm]")
    axes.legend(frameon=False)


def _draw_pressures(axes: Any, before: Scene, after: Scene) -> None:
    for scene, color, words in ((before, _BEFORE, "before"), (after, _AFTER, "after")):
        time = np.linspace(0.0, float(scene.solver.end_time), 400)
        axes.plot(time, np.asarray(scene.pressure.at(as_real(time))) / 1e3, color=color, label=words, linewidth=2)
    axes.set(xlabel="time [s]", ylabel="pressure [kPa]")
    axes.legend(frameon=False)


def _column(history: Sequence[Mapping[str, Any]], name: str) -> Array:
    """A column as numbers, NaN where it is empty or infinite."""
    values = [row.get(name) for row in history]
    numbers = np.array([np.nan if value in (None, "") else float(value) for value in values])
    return np.where(np.isfinite(numbers), numbers, np.nan)

"""Pictures: a scene before it runs, the formed part with its wall, the search, a design before and after."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from jaxform.core.errors import format_coordinate, format_percent
from jaxform.core.pytree import parameter_ranges
from jaxform.io import canvas
from jaxform.io.canvas import MINIMUM, Line, PartPicture, draw, new_figure, save
from jaxform.io.process import pressures_over_time
from jaxform.io.scene_checks import Survey, box_size, survey
from jaxform.io.surfaces import (
    MOLD_COLOR,
    SHEET,
    color_range,
    counted_elements,
    distinguishable_points,
    draw_map,
    hangs_before,
    mirror_points,
    part_view,
    sheet_view,
    tool_colors,
    tool_faces,
    varies_across,
)
from jaxform.model.replacement import number_at
from jaxform.model.scene import Scene
from jaxform.results import sections
from jaxform.results.part import restrict_to_part, thinnest_element
from jaxform.results.result import Result, drop_unused
from jaxform.results.summary import explain
from jaxform.results.tool_contact import formed_areas, tool_label, wall_statistics
from jaxform.tools.mold import Mold, Motion

Array = NDArray[np.float64]
Part = tuple[Scene, Result]

_BEFORE, AFTER, _EXACT = "#7f7f7f", "#0072b2", "#d55e00"
_FAINT = {"color": "#c8c8c8", "alpha": 0.7, "zorder": 1}  # of what is formed with the part, but cut off it
_POINTS = {"marker": "o", "linestyle": "none"}
_KEPT = 5e-3  # of a limit, by which it may be broken


def thickness_picture(
    path: str | Path, scene: Scene, result: Result, reference: Mapping[str, Any] | None = None
) -> None:
    """The formed part in colours of its wall, and the wall along a meridian or section.

    Args:
        path: Path of the PNG.
        scene: The simulated scene.
        result: The part.
        reference: An exact solution to dot over it: `initial_radius` [m], `arc` [m] from the axis, `thickness_ratio`.
    """
    canvas.draw_part(path, part_picture(scene, result, reference))


def part_picture(scene: Scene, result: Result, reference: Mapping[str, Any] | None = None) -> PartPicture:
    """Content of a formed part's picture, as arrays; the arguments are those of `thickness_picture`."""
    scene, result = drop_unused(scene, result)
    part = restrict_to_part(result, scene)[0]
    thin = thinnest_element(part, scene)
    view = part_view(scene, result, wall_scale([(scene, result)]), mark=thin["formed"])
    return PartPicture(_title(scene, part), view, _wall(part), *_lines(scene, result, thin, reference))


def convergence_picture(path: str | Path, history: Sequence[Mapping[str, Any]]) -> None:
    """Deviation from the target (the objective where there is none), and the wall, over the cost of a search.

    Args:
        path: Path of the PNG.
        history: Rows of the search, with the columns of history.csv.
    """
    figure = canvas.new_figure(14, 5.5, "")
    left, right = figure.subplots(1, 2)
    spent = column(history, "simulations")
    error, words = 100 * column(history, "thickness_rms_error"), "deviation from the target, rms [%]"
    if not np.isfinite(error).any():
        error, words = column(history, "objective"), "objective"
    left.plot(spent, error, "o", color=_BEFORE, markersize=4, label="each simulation")
    if "violation" in history[0]:
        kept = column(history, "violation") <= _KEPT
        left.plot(spent[kept], error[kept], "o", color=AFTER, markersize=5, label="limits kept")
    else:
        left.plot(spent, np.fmin.accumulate(error), "-", color=AFTER, label="best so far")
    left.set(yscale="log", xlabel="cost in simulations", ylabel=words)
    left.legend(frameon=False)
    right.plot(spent, 1e3 * column(history, "wall_mean"), "-", color=AFTER, label="mean wall [mm]")
    right.plot(spent, 1e3 * column(history, "wall_min"), "--", color=AFTER, label="minimum of the wall [mm]")
    right.set(xlabel="cost in simulations", ylabel="wall thickness [mm]")
    twin = right.twinx()
    twin.plot(spent, 100 * column(history, "wall_cv"), "-", color=_EXACT, label="coefficient of variation [%]")
    twin.set(ylabel="coefficient of variation [%]")
    twin.spines["top"].set_visible(False)
    right.legend(handles=[*right.lines, *twin.lines], frameon=False, loc="center right")
    figure.tight_layout()
    canvas.save(figure, path)


def design_picture(path: str | Path, before: Part, after: Part, target: float | None = None) -> None:
    """A design before and after: parts, initial thickness, wall and pressure; the tools' ways where only these change.

    Args:
        path: Path of the PNG.
        before: Initial scene and part.
        after: Scene and part of the design.
        target: Uniform target thickness [m], or None.
    """
    designed, given = _designed_field(before[0], after[0]), (before[0], after[0])
    before, after = drop_unused(*before), drop_unused(*after)
    figure = canvas.new_figure(16, 12, "")
    scale = wall_scale([before, after])
    for place, words, part in ((0.0, "before", before), (0.46, "after", after)):
        view = figure.add_axes((place, 0.46, 0.45, 0.47), projection="3d")
        colors = canvas.draw(view, part_view(*part, scale))
        figure.text(place + 0.225, 0.955, _part_words(words, part), ha="center", fontsize=13)
    bar = figure.add_axes((0.925, 0.52, 0.012, 0.34))
    walls = [_wall(restrict_to_part(result, scene)[0]) for scene, result in (before, after)]
    canvas.draw_bar(figure, colors, bar, "wall thickness [mm]", walls)
    time = np.linspace(0.0, max(float(scene.solver.end_time) for scene, _ in (before, after)), 400)
    pressures = [pressures_over_time(*part, time) for part in (before, after)]
    rows = [np.stack(list(each.values())) for each in pressures]
    same = bool(np.isnan(rows).any()) or np.array_equal(rows[0], rows[1])
    count = 2 if same else 3
    width = 0.93 / count
    places = [(0.065 + k * width, 0.07, width - 0.075, 0.34) for k in range(count)]
    fresh = figure.add_axes(places[0])
    if designed is not None:
        _draw_field(figure, fresh, after[0], *designed)
    elif _moving_tools(given[1]) and np.array_equal(given[0].parison.thickness, given[1].parison.thickness):
        _draw_ways(fresh, *given)
    else:
        _draw_initial(fresh, before[0], after[0])
    _draw_walls(figure.add_axes(places[1]), before, after, target)
    if not same:
        _draw_pressures(figure.add_axes(places[2]), time, *pressures)
    canvas.save(figure, path)


def stages_picture(path: str | Path, scene: Scene, results: Sequence[Result]) -> None:
    """The part at several times, side by side, in colours of its wall.

    Args:
        path: Path of the PNG.
        scene: The simulated scene.
        results: The part at each time.
    """
    parts = [drop_unused(scene, result) for result in results]
    figure, scale = canvas.new_figure(5.5 * len(parts), 5.5, scene.name), wall_scale(parts[-1:])
    for k, (shown, part) in enumerate(parts):
        view = figure.add_axes((0.95 * k / len(parts), 0.02, 0.95 / len(parts), 0.84), projection="3d")
        colors = canvas.draw(view, part_view(shown, part, scale, edges=True))
        words = f"t = {1e3 * float(part.time):.4g} ms, {len(part.triangles)} elements"
        figure.text(0.95 * (k + 0.5) / len(parts), 0.88, words, ha="center", fontsize=12)
    bar = figure.add_axes((0.96, 0.25, 0.005, 0.45))
    canvas.draw_bar(
        figure, colors, bar, "wall [mm]", [_wall(restrict_to_part(part, shown)[0]) for shown, part in parts]
    )
    canvas.save(figure, path)


def _title(scene: Scene, result: Result) -> str:
    wall = wall_statistics(result)
    numbers = ", ".join(f"{words} {1e3 * wall[key]:.3g}" for key, words in _STATISTICS)
    text = f"{scene.name}: wall {numbers} mm (coefficient of variation {format_percent(wall['cv'], 3)})"
    status = explain(result)
    return text if status == "ok" else f"{text}\nnot finished: {status.split(';')[0]}"


_STATISTICS = (("min", "minimum"), ("mean", "mean"), ("max", "maximum"))


def _part_words(words: str, part: Part) -> str:
    result = restrict_to_part(part[1], part[0])[0]
    wall = wall_statistics(result)
    return (
        f"{words}: coefficient of variation {format_percent(wall['cv'], 3)}\n"
        f"wall minimum {1e3 * wall['min']:.3g}, maximum {1e3 * wall['max']:.3g} mm, {1e3 * float(result.mass):.3g} g"
    )


def wall_scale(parts: Sequence[Part]) -> tuple[float, float]:
    """Range of the colours [mm], shared by all drawn parts: of formed elements, not of flanges that stayed flat."""
    walls, areas = [], []
    for scene, result in parts:
        start, end = np.asarray(scene.parison.positions, float), np.asarray(result.positions, float)
        in_part = None if scene.part is None else np.asarray(restrict_to_part(result, scene)[0].used)
        formed = counted_elements(start, end, np.asarray(result.triangles), in_part)
        walls.append(np.asarray(result.element_thickness, float)[formed])
        areas.append(formed_areas(result)[formed])
    return color_range(1e3 * np.concatenate(walls), np.concatenate(areas))


def _wall(result: Result) -> Array:
    """Thickness of the elements that are used (n,) [mm]."""
    return 1e3 * np.asarray(result.element_thickness, float)[np.asarray(result.used)]


def _lines(
    scene: Scene, result: Result, thin: Mapping[str, Any], reference: Mapping[str, Any] | None
) -> tuple[list[Line], str]:
    """Wall thickness over arc length, or over the initial radius with the exact solution in dots; the label of that.

    With an exact solution the place is that in the initial sheet: flat elements cut a sharp corner short, and beyond
    it the arc lengths of the two would no longer name the same place.
    """
    disc = sections.is_disc(scene)
    if reference is not None and disc:
        return _exact(scene, result, thin, reference)
    lines = []
    for curve, color in zip(curves_of_part(scene, result, thin["initial"]), (AFTER, _EXACT), strict=False):
        style = _POINTS | {"markersize": 3.5, "alpha": 0.6} if disc else {}
        shown = distinguishable_points(curve.arc, curve.thickness) if disc else slice(None)
        arc = 1e3 * curve.arc[shown]
        if curve.in_part is not None and not curve.in_part.all():
            label = "_" if lines else "cut off the part"
            lines.append((arc, 1e3 * curve.thickness[shown], style | _FAINT | {"label": label}))
        lines.append((arc, 1e3 * curve.part_thickness[shown], style | {"color": color, "label": curve.label}))
        if curve.marked is not None:
            lines.append(_mark(1e3 * curve.marked, thin, lines))
    where = "arc length from the axis" if disc else "arc length along the section"
    return lines, f"{where} [mm]"


def curves_of_part(scene: Scene, result: Result, through: ArrayLike | None = None) -> list[sections.SectionCurve]:
    """The curves of `jaxform.results.sections.curves`, which know which of their points are the scene's `Part`."""
    in_part = None if scene.part is None else np.asarray(restrict_to_part(result, scene)[0].used)
    return sections.curves(scene, result, through, in_part)


def _mark(arc: float, thin: Mapping[str, Any], lines: Sequence[Line] = ()) -> Line:
    """The thinnest place, named once among the lines."""
    where = ", ".join(format_coordinate(x, 1e3, 3) for x in thin["formed"])
    named = any(style["label"].startswith("minimum") for _, _, style in lines)
    label = "_" if named else f"minimum {1e3 * thin['thickness']:.3g} mm, at ({where}) mm"
    look = {"color": MINIMUM, "markeredgecolor": "white", "markeredgewidth": 1.2, "markersize": 9, "zorder": 5}
    return np.array([arc]), np.array([1e3 * thin["thickness"]]), _POINTS | look | {"label": label}


def _exact(
    scene: Scene, result: Result, thin: Mapping[str, Any], reference: Mapping[str, Any]
) -> tuple[list[Line], str]:
    place, wall = 1e3 * sections.initial_radius(scene), 1e3 * np.asarray(result.thickness, float)
    shown = distinguishable_points(place, wall)
    look = {"color": AFTER, "markersize": 4, "alpha": 0.6, "label": "simulated, all nodes"}
    nodes = place[shown], wall[shown], _POINTS | look
    initial = 1e3 * float(np.asarray(scene.parison.thickness).mean())
    mark = _mark(1e3 * float(np.hypot(*thin["initial"][:2])), thin)
    order = np.argsort(np.asarray(reference["initial_radius"]))
    radius, ratio = (np.asarray(reference[key], float)[order] for key in ("initial_radius", "thickness_ratio"))
    dotted = {"linestyle": ":", "color": _EXACT, "linewidth": 2.5, "label": "exact solution"}
    lines = [nodes, mark, (1e3 * radius, initial * ratio, dotted)]
    return lines, "place along the meridian: radius in the initial sheet [mm]"


def _moving_tools(scene: Scene) -> list[tuple[Mold, Motion]]:
    """The mold and the tools that move, with their motions."""
    tools = [tool for tool in (scene.mold, *scene.tools) if tool is not None]
    return [(tool, tool.motion) for tool in tools if tool.motion is not None]


def _draw_ways(axes: Any, before: Scene, after: Scene) -> None:
    """Displacements of the tools that move over time, and the friction of each that has one number for it."""
    for scene, color, words in ((before, _BEFORE, "before"), (after, AFTER, "after")):
        for tool, motion in _moving_tools(scene):
            time = np.linspace(0.0, float(scene.solver.end_time), 201)
            far = tool.offset_at(time) @ np.asarray(motion.direction, float)
            friction = np.ravel(getattr(tool.contact, "friction", []))
            law = f", friction {friction[0]:.3g}" if len(friction) == 1 else ""
            axes.plot(time, 1e3 * far, color=color, linewidth=2, label=f"{tool_label(tool)} {words}{law}")
    axes.set(xlabel="time [s]", ylabel="displacement [mm]")
    axes.margins(y=0.2)
    axes.legend(frameon=False, loc="lower right")


def _draw_initial(axes: Any, before: Scene, after: Scene) -> None:
    disc = sections.is_disc(before)
    for scene, color, words in ((before, _BEFORE, "before"), (after, AFTER, "after")):
        place = _places_along(scene)[0]
        order = np.argsort(place)
        thickness = np.asarray(scene.parison.thickness, float)[order]
        shown = np.sort(distinguishable_points(place[order], thickness))
        line: dict[str, Any] = {"linewidth": 2} if disc else {"linestyle": "none", "marker": ".", "markersize": 4}
        axes.plot(1e3 * place[order][shown], 1e3 * thickness[shown], color=color, label=words, **line)
    axes.set(xlabel=f"{_places_along(after)[1]} [mm]", ylabel="initial thickness [mm]")
    axes.legend(frameon=False)


def _designed_field(before: Scene, after: Scene) -> tuple[str, str] | None:
    """Key and label of the field over the sheet that was changed; None without one, or where the thickness was.

    The thickness is a field where it is none of the place along which it would be drawn.
    """
    if not np.array_equal(before.parison.thickness, after.parison.thickness):
        varies = varies_across(_places_along(after)[0], np.asarray(after.parison.thickness, float))
        return ("parison.thickness", "initial thickness [mm]") if varies else None
    varying = {f"material.{name}": name for name, values in after.material.zones.items() if values.ndim == 1}
    units = {name: allowed.unit for name, allowed in parameter_ranges(after.material).items()}
    words = {key: f"{name} over the sheet" + f" [{units[name]}]" * bool(units[name]) for key, name in varying.items()}
    for key, text in ({"parison.temperature": "temperature of the sheet [°C]"} | words).items():
        new, old = number_at(after, key), number_at(before, key)
        if new is not None and (old is None or not np.array_equal(new, old)):
            return key, text
    return None


def _places_along(scene: Scene) -> tuple[Array, str]:
    """Places of the nodes along the initial sheet (n_node,) [m], of a disc their radius, and the name of these."""
    if sections.is_disc(scene):
        return sections.initial_radius(scene), "initial radius"
    positions = np.asarray(scene.parison.positions, float)
    along = int(np.argmax(np.ptp(positions, axis=0)))
    return positions[:, along], f"initial {'xyz'[along]}"


def _draw_field(figure: Any, axes: Any, scene: Scene, key: str, words: str) -> None:
    """A map of the values at a key of a scene (n_node,) over the sheet before it is formed."""
    values = np.asarray(number_at(scene, key), float)
    values = 1e3 * values if key == "parison.thickness" else values
    drawn = draw_map(axes, scene, values, cmap="inferno")
    axes.set_title(words)
    figure.colorbar(drawn, ax=axes, fraction=0.05, pad=0.03)


def _draw_walls(axes: Any, before: Part, after: Part, target: float | None) -> None:
    through = thinnest_element(restrict_to_part(after[1], after[0])[0], after[0])["initial"]
    for (scene, result), color, words in ((before, _BEFORE, "before"), (after, AFTER, "after")):
        for curve in curves_of_part(scene, result, through)[:1]:
            shown = distinguishable_points(curve.arc, curve.thickness)
            wall = 1e3 * curve.part_thickness[shown]
            axes.plot(1e3 * curve.arc[shown], wall, ".", color=color, markersize=4, label=words)
    if target is not None:
        axes.axhline(1e3 * target, color=_EXACT, linestyle="--", label="target")
    axes.set(xlabel="arc length in the part [mm]", ylabel="wall thickness [mm]")
    axes.legend(frameon=False)


def _draw_pressures(axes: Any, time: Array, before: dict[str, Array], after: dict[str, Array]) -> None:
    for values, color, words in ((before, _BEFORE, "before"), (after, AFTER, "after")):
        for (name, value), line in zip(values.items(), itertools.cycle(("-", "--", ":", "-.")), strict=False):
            label = f"{name} {words}".strip()
            axes.plot(time, value / 1e3, line, color=color, label=label, linewidth=2)
    axes.set(xlabel="time [s]", ylabel="pressure [kPa]")
    axes.legend(frameon=False)


def column(history: Sequence[Mapping[str, Any]], name: str) -> Array:
    """A column as numbers, NaN where it is empty or infinite."""
    values = [row.get(name) for row in history]
    numbers = np.array([np.nan if value in (None, "") else float(value) for value in values])
    return np.where(np.isfinite(numbers), numbers, np.nan)


# The picture of a scene before it runs: the sheet in the mold.

_ARROW = 0.08  # of what is drawn, an arrow of the pressure is long
_MOVED = 0.02  # of the farthest displacement: a tool that moved as much less again is not where it was farthest
_LEVELS = 25  # places across the sheet at which the depth of the mold is looked at
_DEEPER = 1.25  # times the mean depth of the mold in the middle, for a cut elsewhere
_MUCH = 8.0  # times as large as the sheet, a mold leaves a dot of it


def check_picture(
    path: str | Path, scene: Scene, warned: Sequence[str] = (), covers: NDArray[np.bool_] | None = None
) -> None:
    """The sheet in the mold before the first step, from outside and cut in the middle, and the direction of the push.

    Args:
        path: Path of the PNG.
        scene: The scene to simulate.
        warned: Warnings to write over it.
        covers: Mask (n_triangle,) of the mold's triangles that cover its holes, through which one sees.
    """
    seen = survey(scene)
    figure = new_figure(16, 7.5, f"{scene.name}: the pressure pushes the sheet {seen.direction}")
    view = figure.add_axes((0.0, 0.02, 0.5, 0.82), projection="3d")
    draw(view, sheet_view(scene, covers))
    _draw_cut(figure.add_axes((0.57, 0.12, 0.4, 0.68)), scene, seen)
    for line, words in enumerate(warned[:3]):
        text = words if len(words) < 190 else f"{words[:187]}..."
        figure.text(0.5, 0.925 - 0.028 * line, f"warning: {text}", ha="center", color=MINIMUM, fontsize=9)
    save(figure, path)


def _draw_cut(axes: Any, scene: Scene, seen: Survey) -> None:
    """Sheet and mold where a plane cuts them, at the deepest cavity; arrows show where the pressure pushes."""
    from matplotlib.collections import LineCollection

    push = int(np.argmax(np.abs(seen.push))) if seen.faces else 2
    low, high = seen.sheet
    across = max((k for k in range(3) if k != push), key=lambda k: high[k] - low[k])
    axis = 3 - push - across
    middle = 1e3 * _deepest_level(scene, seen, axis, across)
    level = middle + 0.1 * box_size(seen.sheet)  # mm and m: a ten-thousandth beside the nodes in the middle
    sheet = np.asarray(scene.parison.positions, float)[np.asarray(scene.parison.triangles)]
    lines = [("sheet", SHEET, 2.5, "-", 1e3 * np.concatenate(mirror_points(scene, sheet)))]
    lines += [(*line, 1e3 * faces) for *line, faces in _tool_lines(scene)]
    cuts = [(*line, sections.cut_triangles(faces, axis, level)[..., [across, push]]) for *line, faces in lines]
    for name, color, width, style, cut in [*cuts[1:], cuts[0]]:
        collection = LineCollection(list(cut), colors=color, linewidths=width, linestyles=style, label=name)
        axes.add_collection(collection)
    of_sheet = cuts[0][-1]
    axes.autoscale()
    _draw_push(axes, of_sheet, seen, [across, push])
    if seen.mold is not None and box_size(seen.mold) > _MUCH * box_size(seen.sheet) and len(of_sheet):
        dot = of_sheet.mean((0, 1))
        axes.plot(*dot[:, None], "o", color=SHEET, ms=5)
        axes.annotate("the sheet", dot, (12, 12), textcoords="offset points", color=AFTER)
    axes.margins(0.08)
    axes.set_aspect("equal", adjustable="datalim")
    if push == 2 and hangs_before(scene):
        # A buck stands below the sheet in every machine.
        axes.invert_yaxis()
    axes.set_title(f"cut at {'xyz'[axis]} = {middle + 0.0:.4g} mm", fontsize=11)
    axes.set(xlabel=f"{'xyz'[across]} [mm]", ylabel=f"{'xyz'[push]} [mm]")
    axes.legend(frameon=False, loc="upper right")


def _tool_lines(scene: Scene) -> Iterator[tuple[str, str, float, str, Array]]:
    """Name, colour, width and style of the lines of mold and tools, at the start and the end, and their triangles."""
    colors = (MOLD_COLOR, *tool_colors(len(scene.tools)))[0 if scene.mold is not None else 1 :]
    for tool, color in zip([surface.mold for surface in scene.surfaces], colors, strict=True):
        name, faces = tool.name or "mold", tool_faces(scene, tool)
        yield name, color, 1.8, "-", faces
        if tool.motion is not None:
            end = tool.motion.offset_at(float(scene.solver.end_time))
            farthest = _farthest(tool.motion, float(scene.solver.end_time))
            if np.linalg.norm(farthest - end) > _MOVED * np.linalg.norm(farthest):
                yield f"{name}, farthest", color, 1.2, ":", tool_faces(scene, tool, farthest)
            yield (
                f"{name} at the end",
                "#a06020" if tool is scene.mold else color,
                1.4,
                "--",
                tool_faces(scene, tool, end),
            )


def _farthest(motion: Motion, end: float) -> Array:
    """The displacement (3,) [m] at the knot before an end [s] at which a tool is farthest from its start."""
    far, time = np.asarray(motion.displacement, float), np.asarray(motion.time, float)
    before = np.abs(np.where(time <= end, far, 0.0))
    return far[int(np.argmax(before))] * np.asarray(motion.direction, float)


def _deepest_level(scene: Scene, seen: Survey, axis: int, across: int) -> float:
    """Coordinate [m] of the plane across an axis that cuts the deepest cavities: the middle if it is nearly as deep.

    A web between the cavities of a tray may be in the middle, where the mold is flat.
    """
    low, high = seen.sheet
    middle = float(0.5 * (low + high)[axis])
    if scene.mold is None or scene.motion is not None or not seen.faces or 2 in (axis, across):
        return middle
    ahead = np.sign(seen.push[2])
    faces = np.asarray(scene.mold.vertices, float)[np.asarray(scene.mold.triangles)]
    shares = (0.5 + np.arange(_LEVELS)) / _LEVELS
    levels = (low + shares[:, None] * (high - low))[:, axis] + 1e-4 * box_size(seen.sheet)
    places = (low + shares[:, None] * (high - low))[:, across]
    start = float(ahead * (high if ahead > 0 else low)[2])
    depths = np.array(
        [_mean_depth(sections.cut_triangles(faces, axis, at)[..., [across, 2]], places, ahead, start) for at in levels]
    )
    at_middle = depths[_LEVELS // 2]
    return middle if depths.max() <= _DEEPER * at_middle else float(levels[int(np.argmax(depths))])


def _mean_depth(cut: Array, places: Array, ahead: float, start: float) -> float:
    """Mean depth [m] of a mold's cut (n, 2, 2) before places (m,) of the sheet, which lies at a height `start`.

    Places without mold before them have no depth.
    """
    cut = np.take_along_axis(cut, np.argsort(cut[..., :1], axis=1), axis=1)
    begin, end = cut[:, 0, None], cut[:, 1, None]
    width = np.where(end[..., 0] > begin[..., 0], end[..., 0] - begin[..., 0], 1.0)
    height = ahead * (begin[..., 1] + (places - begin[..., 0]) / width * (end[..., 1] - begin[..., 1])) - start
    hit = (begin[..., 0] <= places) & (places < end[..., 0]) & (height >= -1e-9)
    depth = np.where(hit, height, np.inf).min(0, initial=np.inf)
    return float(np.where(np.isfinite(depth), depth, 0.0).mean())


def _draw_push(axes: Any, cut: Array, seen: Survey, plane: list[int]) -> None:
    """Some arrows from the cut (n, 2, 2) [mm] of a sheet, in the plane of two axes, along the push.

    A sheet that is not pushed along one direction is pushed across its cut, away from the middle or towards it.
    """
    if not len(cut):
        return
    middle, along = cut.mean(1), cut[:, 1] - cut[:, 0]
    order = np.argsort(middle[:, 0])
    some = order[np.linspace(0, len(order) - 1, 9).round().astype(int)[1:-1]]
    size = box_size(seen.sheet)
    if seen.mold is not None and box_size(seen.mold) < _MUCH * size:
        size = box_size(seen.mold)
    if seen.faces:
        way = np.tile((seen.push / np.linalg.norm(seen.push))[plane], (len(some), 1))
    else:
        across = along[some][:, ::-1] * [1.0, -1.0]
        away = np.sign(np.sum(across * (middle[some] - middle.mean(0)), axis=1, keepdims=True))
        way = away * across / np.maximum(np.linalg.norm(across, axis=1, keepdims=True), 1e-12)
        way = way if seen.outwards else -way
    tip = middle[some] + _ARROW * 1e3 * size * way
    for begin, end in zip(middle[some], tip, strict=True):
        axes.annotate("", end, begin, arrowprops={"arrowstyle": "->", "color": AFTER, "lw": 1.4})
    axes.update_datalim(tip)

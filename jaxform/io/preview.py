"""The picture of a scene before it runs: the sheet in the mold."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from jaxform.core.pytree import as_real
from jaxform.io.canvas import new_figure, save
from jaxform.io.plots import AFTER
from jaxform.io.scene_checks import Survey, survey
from jaxform.io.surfaces import SHEET, hangs_before, mirror_points, sheet_view
from jaxform.io.views import MINIMUM, draw
from jaxform.model.scene import Scene
from jaxform.results import sections

Array = NDArray[np.float64]

_ARROW = 0.08  # of what is drawn, an arrow of the pressure is long
_AT_END = "mold at the end"
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
    """Sheet and mold where a plane through the sheet's middle cuts them; arrows show where the pressure pushes."""
    from matplotlib.collections import LineCollection

    push = int(np.argmax(np.abs(seen.push))) if seen.faces else 2
    extent = seen.sheet.high - seen.sheet.low
    across = max((k for k in range(3) if k != push), key=lambda k: extent[k])
    axis = 3 - push - across
    middle = 1e3 * 0.5 * (seen.sheet.low + seen.sheet.high)[axis]
    level = middle + 0.1 * seen.sheet.size  # mm and m: a ten-thousandth beside the nodes in the middle
    sheet = np.asarray(scene.parison.positions, float)[np.asarray(scene.parison.triangles)]
    lines = {"sheet": sections.cut_triangles(1e3 * np.concatenate(mirror_points(scene, sheet)), axis, level)}
    if scene.mold is not None:
        walls = np.asarray(scene.mold.vertices, float)[np.asarray(scene.mold.triangles)]
        lines["mold"] = sections.cut_triangles(1e3 * np.concatenate(mirror_points(scene, walls)), axis, level)
    if scene.motion is not None and "mold" in lines:
        end = 1e3 * np.asarray(scene.motion.offset(as_real(float(scene.solver.end_time))), float)
        moved = 1e3 * np.concatenate(mirror_points(scene, walls)) + end
        lines[_AT_END] = sections.cut_triangles(moved, axis, level)
    styles = (("mold", "#606060", 1.8, "-"), (_AT_END, "#a06020", 1.4, "--"), ("sheet", SHEET, 2.5, "-"))
    for name, color, width, style in styles:
        if name in lines:
            drawn = lines[name][..., [across, push]]
            collection = LineCollection(list(drawn), colors=color, linewidths=width, linestyles=style, label=name)
            axes.add_collection(collection)
    axes.autoscale()
    _draw_push(axes, lines["sheet"][..., [across, push]].mean(1), [across, push], seen)
    if seen.mold is not None and seen.mold.size > _MUCH * seen.sheet.size and len(lines["sheet"]):
        dot = lines["sheet"][..., [across, push]].mean((0, 1))
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


def _draw_push(axes: Any, middle: Array, plane: list[int], seen: Survey) -> None:
    """Some arrows from places (n, 2) [mm] on the sheet, in the plane of two axes, along the push."""
    if not len(middle):
        return
    order = np.argsort(middle[:, 0])
    some = middle[order[np.linspace(0, len(order) - 1, 9).round().astype(int)[1:-1]]]
    shown = seen.mold if seen.mold is not None and seen.mold.size < _MUCH * seen.sheet.size else seen.sheet
    if seen.faces:
        way = np.tile((seen.push / np.linalg.norm(seen.push))[plane], (len(some), 1))
    else:
        away = some - middle.mean(0)
        away /= np.maximum(np.linalg.norm(away, axis=1, keepdims=True), 1e-12)
        way = away if seen.outwards else -away
    tip = some + _ARROW * 1e3 * shown.size * way
    for begin, end in zip(some, tip, strict=True):
        axes.annotate("", end, begin, arrowprops={"arrowstyle": "->", "color": AFTER, "lw": 1.4})
    axes.update_datalim(tip)

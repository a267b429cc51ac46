"""Pictures of plug-assisted thermoforming in docs/how-to/plug-assist.md, from our own runs.

The wall of a cup by speed and friction of the plug: `python -m benchmarks.design.plugs`. The cup before and after the
study plug-timing, as an animation: the same with `best.toml` of the folder that `jaxform optimize plug-timing` wrote.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any, cast

import jax
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.collections import LineCollection
from matplotlib.colors import Normalize
from PIL import Image

import jaxform
from benchmarks.pages import DOCS, save
from benchmarks.timing import say
from jaxform.io import files
from jaxform.model.scene import Scene
from jaxform.results import sections
from jaxform.results.result import Result
from jaxform.results.summary import summarize
from jaxform.tools.mold import Mold

Array = np.ndarray[Any, Any]
_COLORS = "#999999", "#56b4e9", "#0072b2", "#d55e00"
_FRAMES, _LONG = 40, 2500  # of the animation, and how long it shows the end [ms]
_THICKEST = 1.0  # mm, end of the scale of colours


def without_plug() -> Scene:
    """The cup of plug-assist-cup formed by vacuum alone."""
    document = files.read_scene("plug-assist-cup")
    tables = {key: value for key, value in document.data.items() if key != "tool"}
    return files.build_unchecked(files.validate_scene(tables, "vacuum.toml", document.folder))


def with_friction(name: str, friction: float) -> Scene:
    """A built-in scene with another friction of its plug."""
    return jaxform.replace(jaxform.load(name), {"tools.plug.contact.friction": friction})


def draw_walls() -> None:
    """Wall thickness from the middle of the bottom to the rim; a table of it on standard output."""
    kinds = {
        "vacuum alone": without_plug(),
        "0.2 s, no friction": with_friction("plug-assist-cup", 0.0),
        "0.2 s, friction 0.4 (plug-assist-cup)": jaxform.load("plug-assist-cup"),
        "1 s, friction 0.4 (plug-assist-cup-slow)": jaxform.load("plug-assist-cup-slow"),
    }
    figure, axes = plt.subplots(figsize=(8.0, 4.4), layout="constrained")
    bottom = wall = 0.0
    for color, (words, scene) in zip(_COLORS, kinds.items(), strict=True):
        result = jaxform.run(scene)
        cut = sections.curves(scene, result)[0]
        radius, depth = np.hypot(cut.place[:, 0], cut.place[:, 1]), cut.place[:, 2]
        bottom, wall = cut.arc[radius < 0.026].max(), cut.arc[depth < 0.056].min()
        found = summarize(result, scene)["thickness"]
        middle = 1e3 * cut.thickness[radius < 0.02].mean()
        say({"plug": words, "bottom_mm": middle, "min_mm": 1e3 * found["min"], "cv": found["cv"]})
        # All nodes of a ring are one place of the cup.
        arc, order = np.unique(np.round(1e3 * cut.arc, 6), return_inverse=True)
        mean = np.bincount(order, cut.thickness) / np.bincount(order)
        axes.plot(arc, 1e3 * mean, color=color, label=f"{words}: {100 * found['cv']:.0f} %")
    axes.axvspan(1e3 * bottom, 1e3 * wall, color="#00000010", linewidth=0)
    for place, words in ((500 * bottom, "bottom"), (500 * (bottom + wall), "corner"), (1e3 * wall + 30.0, "side wall")):
        axes.text(place, 0.985, words, transform=axes.get_xaxis_transform(), ha="center", va="top", color="#555555")
    axes.set(
        xlabel="arc length from the middle of the bottom [mm]",
        ylabel="wall thickness [mm]",
        ylim=(0, None),
        xlim=(0, None),
    )
    axes.legend(
        title="time of the plug, friction: coefficient of variation", loc="upper left", bbox_to_anchor=(0.0, 0.93)
    )
    axes.grid(alpha=0.25)
    axes.spines[["top", "right"]].set_visible(False)
    save(figure, DOCS / "plug-walls.png")


# The animation: two cups side by side, cut open.


def outline(tool: Mold, time: float) -> Array:
    """Half of a tool's outline (n, 2) [mm], radius and height, from its end or bottom on; tools are turned about z."""
    places = tool.vertices_at(time)[np.unique(np.asarray(tool.triangles))]
    rings = np.unique(np.round(1e6 * np.stack([np.hypot(places[:, 0], places[:, 1]), places[:, 2]], 1)), axis=0) / 1e3
    rings = rings[np.lexsort((rings[:, 0], -rings[:, 1]))]
    # The edge alone of the far end of a rod.
    far = rings[:, 1] == rings[:, 1].min()
    return rings[~far | (rings[:, 0] == rings[far, 0].max())]


def mirror(points: Array) -> Array:
    """A meridian (n, 2) from the rim on the one side to the rim on the other (2 n, 2)."""
    return np.concatenate([points[::-1] * [-1.0, 1.0], points])


def meridian(scene: Scene, positions: Array, thickness: Array) -> tuple[Array, Array]:
    """Places (n, 2) [mm] and thickness (n,) [mm] of the nodes on the x axis, from the middle outwards."""
    start = np.asarray(scene.parison.positions, float)
    line = np.flatnonzero(np.abs(start[:, 1]) < 1e-9)
    line = line[np.argsort(start[line, 0])]
    return 1e3 * positions[line][:, [0, 2]], 1e3 * thickness[line]


def watch(scene: Scene) -> tuple[list[tuple[float, Array, Array]], Result]:
    """Time [s], meridian and its thickness after each window, and the end."""
    seen = [
        (0.0, *meridian(scene, *(np.asarray(x, float) for x in (scene.parison.positions, scene.parison.thickness))))
    ]

    def look(moment: Any) -> None:
        part = moment.result()
        seen.append(
            (moment.time, *meridian(scene, np.asarray(part.positions, float), np.asarray(part.thickness, float)))
        )

    return seen, jaxform.run(scene, on_window=look)


def draw_cup(axes: Any, scene: Scene, seen: tuple[float, Array, Array], colors: Normalize) -> None:
    """The cup cut open: mold, plug, and the sheet, whose line is coloured by its wall and wide where that is thick."""
    time, place, thickness = seen
    assert scene.mold is not None
    mold = mirror(outline(scene.mold, time))
    axes.fill_between(mold[:, 0], mold[:, 1], 68.0, color="#d8d8d8", linewidth=0)
    axes.plot(*mold.T, color="#606060", linewidth=1.0)
    for tool in scene.tools:
        axes.fill(*mirror(outline(tool, time)).T, color="#c89060", linewidth=0)
    points, wall = mirror(place), np.concatenate([thickness[::-1], thickness])
    middle = 0.5 * (wall[1:] + wall[:-1])
    lines = LineCollection(list(np.stack([points[:-1], points[1:]], 1)), cmap="viridis", norm=colors)
    lines.set_array(middle)
    lines.set_linewidth((1.2 + 7.0 * middle).tolist())
    lines.set_capstyle("round")
    axes.add_collection(lines)
    axes.set(xlim=(-46, 46), ylim=(68, -24), aspect="equal")
    axes.set_axis_off()


def settings_of(scene: Scene) -> str:
    """Way, time and friction of the plug, in words."""
    motion, law = scene.tools[0].motion, cast(Any, scene.tools[0].contact)
    assert motion is not None
    far, time = (float(np.asarray(values)[-1]) for values in (motion.displacement, motion.time))
    return f"{1e3 * far:.1f} mm in {time:.2f} s, friction {float(np.asarray(law.friction)):.2g}"


def animate(scenes: Sequence[Scene], path: Path) -> None:
    """The forming of two cups side by side as a GIF."""
    runs = [watch(scene) for scene in scenes]
    evenness = [summarize(end, scene)["thickness"]["cv"] for scene, (_, end) in zip(scenes, runs, strict=True)]
    colors, drawn = Normalize(0.0, _THICKEST), []
    figure = plt.figure(figsize=(7.2, 4.0), dpi=90)
    canvas: Any = figure.canvas
    for time in np.linspace(0.0, float(scenes[0].solver.end_time), _FRAMES):
        figure.clear()
        for k, (scene, (seen, _)) in enumerate(zip(scenes, runs, strict=True)):
            axes = figure.add_axes((0.45 * k, 0.02, 0.44, 0.8))
            now = seen[int(np.argmin([abs(one[0] - time) for one in seen]))]
            draw_cup(axes, scene, now, colors)
            head = f"{('before', 'after')[k]}: coefficient of variation {100 * evenness[k]:.0f} %"
            figure.text(0.45 * k + 0.22, 0.93, head, ha="center", fontsize=10, weight="bold")
            figure.text(0.45 * k + 0.22, 0.87, settings_of(scene), ha="center", fontsize=9)
        figure.text(0.445, 0.05, f"{time:.2f} s", ha="center", fontsize=10)
        scale = plt.cm.ScalarMappable(colors, "viridis")
        figure.colorbar(scale, cax=figure.add_axes((0.91, 0.15, 0.015, 0.6)), label="wall [mm]")
        canvas.draw()
        drawn.append(np.asarray(canvas.buffer_rgba())[..., :3].copy())
    plt.close(figure)
    palette = Image.fromarray(np.concatenate(drawn[::4])).quantize(256, Image.Quantize.MAXCOVERAGE)
    first, *others = (Image.fromarray(one).quantize(palette=palette, dither=Image.Dither.NONE) for one in drawn)
    lasts = [90] * len(others) + [_LONG]
    first.save(path, save_all=True, append_images=others, duration=lasts, loop=0)


def main(designs: list[str]) -> None:
    """Draws the walls, or of a design's scene file the animation."""
    jax.config.update("jax_enable_x64", True)
    if not designs:
        draw_walls()
    for design in designs:
        animate([jaxform.load("plug-assist-cup"), jaxform.load(design)], DOCS / "plug-timing.gif")


if __name__ == "__main__":
    main(sys.argv[1:])

"""The paper's figures from our own runs, and an animation of each scene: `make paper`.

Writes pictures and docs/scenes.json, and puts the tables of that file into docs/scenes.md, between their marks.
Parts run alone by name: a scene, or a step of pictures, tables and counts.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any

import jax
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.cm import ScalarMappable
from matplotlib.collections import LineCollection
from matplotlib.colors import Normalize
from matplotlib.patheffects import withStroke
from mpl_toolkits.mplot3d.art3d import Poly3DCollection
from PIL import Image

import jaxform
from benchmarks.accuracy import cases
from benchmarks.pages import DOCS, read_figures, save, store_figures
from benchmarks.paper import bottle as bottle_tables
from benchmarks.timing import best_in_turns, one_core, say, whole_loop
from jaxform import scenes
from jaxform.core.errors import format_percent
from jaxform.core.store import Store
from jaxform.io import files, surfaces
from jaxform.model.scene import Scene
from jaxform.results import sections
from jaxform.results.result import Result, drop_unused
from jaxform.results.summary import summarize
from jaxform.results.tool_contact import wall_statistics

Row = dict[str, Any]
Part = tuple[Scene, Result]
OURS, THEIRS, LINE = "#0072b2", "#d55e00", "#333333"
PAPER: dict[str, Row] = {
    "dish": {"elements": (27, 996), "mold": 63},
    "box-insert": {"elements": (128, 3752), "mold": 26},
    "soap-bottle": {"elements": (802, 802), "mold": 1215},
}
"""Counts that the paper states (4.1 to 4.3)."""
_STAGES, _FRAMES = 4, 24
_LOOK = 16  # steps between two looks at a part
_ROOM = {"dish": (0.0, 0.0, 0.88, 0.94), "box-insert": (-0.06, -0.2, 1.0, 1.3), "soap-bottle": (0.0, 0.0, 0.8, 0.94)}
"""Area of an animation in which the part is drawn; the colour bar is beside it."""
_LIGHT = np.array([0.35, -0.62, 0.70])


def dish() -> Scene:
    """The dish as in the paper, refined from 27 elements."""
    return jaxform.load("dish-refined")


SCENES: dict[str, Callable[[], Scene]] = {
    "dish": dish,
    "box-insert": scenes.box_insert,
    "soap-bottle": scenes.soap_bottle,
}


# --- Runs -----------------------------------------------------------------------------------------------------------


def run_watched(scene: Scene) -> list[Part]:
    """The part after every window, each with the elements that are there.

    Windows are short where they do not decide what is refined.
    """
    parts: list[Part] = []
    if scene.refinement is None:
        scene = dataclasses.replace(scene, tables=dataclasses.replace(scene.tables, longest_window=np.int32(_LOOK)))
    jaxform.run(scene, on_window=lambda moment: parts.append(drop_unused(scene, moment.result())))
    return parts


def evenly(parts: Sequence[Part], count: int) -> list[Part]:
    """So many of the parts, the last among them, between which the mean wall falls by about the same."""
    wall = np.minimum.accumulate([wall_statistics(part)["mean"] for _, part in parts])
    levels = np.linspace(float(np.asarray(parts[0][0].parison.thickness).mean()), wall[-1], count + 1)[1:]
    found = np.minimum(np.searchsorted(-wall, -levels - 1e-12 * wall[0]), len(parts) - 1)
    found[-1] = len(parts) - 1
    return [parts[k] for k in found]


def time_run(scene: Scene) -> Result:
    """A run for which nothing is compiled yet; what was for the pictures would come for nothing."""
    jax.clear_caches()
    return jaxform.run(scene, store=Store())


def count_table_rows(name: str, scene: Scene, first: Result) -> Row:
    """Elements and seconds of a scene's first run, and how long others take on this process's cores."""
    assert first.seconds is not None and scene.mold is not None
    mold = len(scene.mold.triangles)
    scene = jaxform.fitted(scene, int(first.used.sum()))
    seconds = best_in_turns({name: whole_loop(scene)}, 3)[name]
    found = summarize(first, scene)
    row = {key: found[key] for key in ("status", "elements_initial", "elements_final", "steps", "contact_fraction")}
    row |= {key: found[key] for key in ("penetration_max", "added_mass")} | {"mold": mold}
    row |= {"balance_error": found["energy"]["balance_error"]}
    row |= {"compile_seconds": first.seconds.compile, "run_seconds": seconds, "wall_error": None}
    if name == "dish":
        table = files.read_reference(files.read_scene(scene.name))
        assert table is not None
        row["wall_error"] = cases.wall_error(*drop_unused(scene, jaxform.run(scene)), table)
    say({"scene": scene.name} | row)
    return {"scene": scene.name} | row


# --- Drawing --------------------------------------------------------------------------------------------------------


def surface(axes: Any, corners: np.ndarray, values: np.ndarray, colors: ScalarMappable, edges: bool = False) -> None:
    """Triangles (n, 3, 3) painted by values (n,), shaded, without frame."""
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    length = np.linalg.norm(normal, axis=1, keepdims=True)
    bright = 0.7 + 0.3 * np.abs((normal / np.where(length > 0, length, 1.0)) @ _LIGHT)
    paint = np.asarray(colors.to_rgba(values))
    paint[:, :3] *= bright[:, None]
    lines: Any = "#00000050" if edges else paint
    # A view's own room is square; a bottle is not.
    made = Poly3DCollection(corners, facecolors=paint, edgecolors=lines, linewidths=0.25, clip_on=False)
    axes.add_collection3d(made)
    axes.set_axis_off()


def frame(axes: Any, low: np.ndarray, high: np.ndarray, **view: Any) -> None:
    """The box that is seen and where from; the same for all pictures of a scene."""
    hangs = view.pop("hangs", False)
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), zlim=(high[2], low[2]) if hangs else (low[2], high[2]))
    axes.set_box_aspect(high - low, zoom=view.pop("zoom", 1.3))
    axes.view_init(**view)


def faces(scene: Scene, part: Result, *, whole: bool = True) -> tuple[np.ndarray, np.ndarray]:
    """Triangles (n, 3, 3) [mm] of the part and its images, and h/h0 of each (n,)."""
    triangles = np.asarray(scene.parison.triangles)
    corners = 1e3 * np.asarray(part.positions, float)[triangles]
    if scene.name == "soap-bottle":
        images = [upright(corners), upright(corners * [1.0, 1.0, -1.0])] if whole else [upright(corners)]
    else:
        images = [1e3 * image for image in surfaces.mirror_points(scene, corners / 1e3, open_front=whole)]
    return np.concatenate(images), np.tile(reduce_surface(scene, part), len(images))


def upright(points: np.ndarray) -> np.ndarray:
    """Places (..., 3) with y upwards as pictures have z."""
    return np.stack([points[..., 0], -points[..., 2], points[..., 1]], axis=-1)


def reduce_surface(scene: Scene, part: Result) -> np.ndarray:
    """h/h0 of the elements (n,)."""
    start = np.asarray(scene.parison.thickness, float)[np.asarray(scene.parison.triangles)].mean(1)
    return np.asarray(part.element_thickness, float) / start


def view_of(name: str) -> Row:
    """The direction from which each scene is viewed."""
    if name == "soap-bottle":
        return {"elev": 14, "azim": -60, "zoom": 1.25}
    # Hanging, with the quarter in front left out: one looks into it. Seen over its corner a box is wider than a dish.
    return {"elev": 36, "azim": -45, "zoom": 0.95 if name.startswith("box") else 1.1, "hangs": True}


def colors_of(parts: Sequence[Part]) -> ScalarMappable:
    """One scale of h/h0 for all."""
    walls = np.concatenate([reduce_surface(*part) for part in parts])
    return ScalarMappable(Normalize(float(walls.min()), float(walls.max())), "viridis")


def finish_axes(axes: Any, **words: Any) -> None:
    axes.set(**words)
    axes.grid(alpha=0.25)
    axes.spines[["top", "right"]].set_visible(False)


def save_figure(figure: Any, name: str) -> None:
    save(figure, DOCS / name)


def stages(name: str, parts: Sequence[Part]) -> None:
    """Four stages (paper, Figs 8 and 12)."""
    shown = evenly(parts, _STAGES)
    figure = plt.figure(figsize=(3.6 * _STAGES, 5.0 if name == "soap-bottle" else 3.6))
    colors, (low, high) = colors_of(shown), bounds(parts)
    for k, (scene, part) in enumerate(shown):
        view: Any = figure.add_axes((0.94 * k / _STAGES, 0.0, 0.94 / _STAGES, 0.9), projection="3d")
        surface(view, *faces(scene, part), colors, edges=True)
        frame(view, low, high, **view_of(name))
        words = f"{1e3 * float(part.time):.4g} ms, {len(part.triangles)} elements"
        figure.text(0.94 * (k + 0.5) / _STAGES, 0.92, words, ha="center", fontsize=11)
    figure.colorbar(colors, cax=figure.add_axes((0.945, 0.2, 0.008, 0.6)), label="h / h$_0$")
    save_figure(figure, f"{name.split('-')[0] if name != 'soap-bottle' else 'bottle'}-stages.png")


def bounds(parts: Sequence[Part]) -> tuple[np.ndarray, np.ndarray]:
    """Corners [mm] of the box that holds all that is drawn."""
    points = faces(*parts[-1])[0].reshape(-1, 3)
    return points.min(0), points.max(0)


def animation(name: str, parts: Sequence[Part]) -> None:
    """The forming of the part as a GIF."""
    shown = evenly(parts, _FRAMES)
    tall = name == "soap-bottle"
    figure = plt.figure(figsize=(3.6, 4.6) if tall else (6.4, 4.2))
    colors, (low, high) = colors_of(shown), bounds(parts)
    figure.set_dpi(80)
    drawn: list[np.ndarray] = []
    canvas: Any = figure.canvas
    for scene, part in shown:
        figure.clear()
        view: Any = figure.add_axes(_ROOM[name], projection="3d")
        surface(view, *faces(scene, part), colors, edges=True)
        frame(view, low, high, **view_of(name))
        figure.text(0.45, 0.94, f"t = {1e3 * float(part.time):5.1f} ms", ha="center", fontsize=10)
        room = figure.add_axes((0.8, 0.2, 0.03, 0.6) if tall else (0.88, 0.2, 0.018, 0.6))
        figure.colorbar(colors, cax=room, label="h / h$_0$")
        canvas.draw()
        drawn.append(np.asarray(canvas.buffer_rgba())[..., :3].copy())
    plt.close(figure)
    # One palette for all, or a colour would change, or be lost from the bar, as soon as few pixels have it.
    palette = Image.fromarray(np.concatenate(drawn)).quantize(256, Image.Quantize.MAXCOVERAGE)
    first, *others = (Image.fromarray(one).quantize(palette=palette, dither=Image.Dither.NONE) for one in drawn)
    lasts = [100] * len(others) + [900]  # ms
    first.save(DOCS / f"{name}.gif", save_all=True, append_images=others, duration=lasts, loop=0)


# --- The dish (4.1) -------------------------------------------------------------------------------------------------


def exact_dish() -> Row:
    """The exact solution by initial radius: h/h0, arc [m], radial and hoop stretch."""
    table = files.read_reference(files.read_scene("dish"))
    assert table is not None
    radius, arc, ratio = (table[key] for key in files.REFERENCE_COLUMNS)
    radial = np.gradient(arc, radius)
    return {"radius": radius, "arc": arc, "ratio": ratio, "radial": radial, "hoop": 1 / (radial * ratio)}


def directional_stretches(scene: Scene, part: Result) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Initial radius [m] of the elements' middles, and their radial and hoop stretch, (n,) each."""
    triangles = np.asarray(scene.parison.triangles)
    start, end = (np.asarray(x, float)[triangles] for x in (scene.parison.positions, part.positions))
    before, after = (np.stack([x[:, 1] - x[:, 0], x[:, 2] - x[:, 0]], axis=2) for x in (start, end))
    gradient = after @ np.linalg.inv(before[:, :2])
    middle = start.mean(1)[:, :2]
    radius = np.hypot(*middle.T)
    outwards = middle / radius[:, None]
    around = np.stack([-outwards[:, 1], outwards[:, 0]], axis=1)
    radial, hoop = (np.linalg.norm(np.einsum("nij,nj->ni", gradient, way), axis=1) for way in (outwards, around))
    return radius, radial, hoop


def draw_dish(parts: Sequence[Part]) -> None:
    """Thickness over arc length (Fig. 9), stretches over initial radius (Fig. 10)."""
    scene, part = parts[-1]
    exact = exact_dish()
    figure, (left, middle, right) = plt.subplots(1, 3, figsize=(14, 4.2), layout="constrained")
    ratio = np.asarray(part.thickness) / np.asarray(scene.parison.thickness)
    arc = 1e3 * sections.meridian_arc(scene, part)
    left.plot(arc, ratio, "o", color=OURS, markersize=3.5, alpha=0.6, label=f"{len(part.triangles)} elements, nodes")
    left.plot(1e3 * exact["arc"], exact["ratio"], color=THEIRS, label="exact")
    finish_axes(left, xlabel="arc length from the axis [mm]", ylabel="h / h$_0$", ylim=(0, None))
    radius, radial, hoop = directional_stretches(scene, part)
    for axes, ours, name in ((middle, radial, "radial"), (right, hoop, "hoop")):
        axes.plot(1e3 * radius, ours, "o", color=OURS, markersize=3, alpha=0.5, label="elements")
        axes.plot(1e3 * exact["radius"], exact[name], color=THEIRS, label="exact")
        finish_axes(axes, xlabel="initial radius [mm]", ylabel=f"{name} stretch", ylim=(0, None))
    for axes in (left, middle, right):
        axes.legend(frameon=False)
    save_figure(figure, "dish-figures.png")


# --- The box (4.2) --------------------------------------------------------------------------------------------------


def draw_box(parts: Sequence[Part]) -> None:
    """Thickness map (Fig. 13); shape and thickness in the symmetry planes (Fig. 14)."""
    scene, part = parts[-1]
    figure = plt.figure(figsize=(8, 5.2))
    colors, (low, high) = colors_of(parts[-1:]), bounds(parts)
    view: Any = figure.add_axes((0.0, 0.0, 0.88, 1.0), projection="3d")
    surface(view, *faces(scene, part), colors)
    frame(view, low, high, **view_of(scene.name) | {"elev": 44})
    figure.colorbar(colors, cax=figure.add_axes((0.88, 0.2, 0.02, 0.6)), label="h / h$_0$")
    save_figure(figure, "box-thickness.png")
    figure, rooms = plt.subplots(2, 2, figsize=(12, 6), layout="constrained", height_ratios=(1, 1.2))
    for (shape, wall), axis in zip(rooms.T, (1, 0), strict=True):
        level = sections.symmetry_planes(scene)[axis]
        cut = sections.cuts(scene, part, axis, level)[0]
        along = 1 - axis
        colored_line(shape, 1e3 * cut.place[:, along], 1e3 * cut.place[:, 2], cut.thickness, colors, scene)
        finish_axes(shape, xlabel=f"{'xy'[along]} [mm]", ylabel="z [mm]", aspect="equal")
        shape.invert_yaxis()
        shape.set_title(f"plane {'xy'[axis]} = {1e3 * level:g} mm ({'yx'[axis]}z), from rim to middle", fontsize=11)
        arc = cut.arc if cut.place[0, along] < cut.place[-1, along] else cut.arc[-1] - cut.arc
        wall.plot(1e3 * arc, 1e3 * cut.thickness, color=OURS)
        finish_axes(wall, xlabel="arc length from the rim [mm]", ylabel="wall thickness [mm]", ylim=(0, None))
    save_figure(figure, "box-sections.png")


def colored_line(axes: Any, x: np.ndarray, y: np.ndarray, wall: np.ndarray, colors: Any, scene: Scene) -> None:
    """A line in the colours of h/h0."""
    points = np.stack([x, y], axis=1)
    lines = LineCollection(list(np.stack([points[:-1], points[1:]], axis=1)), cmap=colors.cmap, norm=colors.norm)
    lines.set_array(0.5 * (wall[:-1] + wall[1:]) / float(np.asarray(scene.parison.thickness).mean()))
    lines.set_linewidth(4)
    axes.add_collection(lines)
    axes.autoscale()


# --- The bottle (4.3) -----------------------------------------------------------------------------------------------


def bottle_lines(scene: Scene, part: Result) -> dict[str, sections.SectionCurve]:
    """A-B-C up the middle, a-b-c through the handle: cuts through the formed part from the bottom up."""
    places = {"A-B-C": 0.0, "a-b-c": bottle_tables.HANDLE_MIDDLE * 0.04}
    found = {}
    for name, x in places.items():
        cut = sections.cuts(scene, part, 0, x, formed=True)[0]
        if cut.place[0, 1] >= cut.place[-1, 1]:
            place = cut.place[::-1]
            cut = sections.SectionCurve(place, cut.thickness[::-1], sections.arc_length(place))
        found[name] = cut
    return found


def draw_bottle(parts: Sequence[Part]) -> None:
    """Reduced thickness from two sides (Fig. 17) and along two lines (Fig. 18)."""
    scene, part = parts[-1]
    lines = bottle_lines(scene, part)
    figure = plt.figure(figsize=(9, 6))
    colors, (low, high) = colors_of(parts[-1:]), bounds(parts)
    for k, view in enumerate(({"elev": 8, "azim": -90}, {"elev": 14, "azim": -35})):
        room: Any = figure.add_axes((0.44 * k, 0.0, 0.46, 1.0), projection="3d", computed_zorder=False)
        surface(room, *faces(scene, part), colors, edges=True)
        frame(room, low, high, zoom=1.3, **view)
        for name, cut in lines.items():
            place = upright(1e3 * cut.place)
            room.plot(*place.T, color="white", linewidth=1.8, clip_on=False)
            for letter, share in zip(name.split("-"), (0.02, 0.45, 0.85 if name == "a-b-c" else 0.97), strict=True):
                at = place[np.searchsorted(cut.arc, share * cut.arc[-1])]
                room.text(
                    *at, letter, color="white", fontsize=13, path_effects=[withStroke(linewidth=3, foreground=LINE)]
                )
    figure.colorbar(colors, cax=figure.add_axes((0.9, 0.2, 0.02, 0.6)), label="h / h$_0$")
    save_figure(figure, "bottle-thickness.png")
    figure, rooms = plt.subplots(1, 2, figsize=(12, 4), layout="constrained", sharey=True)
    for axes, (name, cut) in zip(rooms, lines.items(), strict=True):
        axes.plot(1e3 * cut.arc, 1e3 * cut.thickness, ".-", color=OURS)
        finish_axes(axes, xlabel="arc length from the bottom [mm]", ylabel="wall thickness [mm]", ylim=(0, None))
        axes.set_title(name)
    save_figure(figure, "bottle-lines.png")


DRAWINGS: dict[str, Callable[[Sequence[Part]], None]] = {
    "dish": draw_dish,
    "box-insert": draw_box,
    "soap-bottle": draw_bottle,
}


# --- The page -------------------------------------------------------------------------------------------------------


def table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A table in Markdown."""
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def count_table(found: Row) -> str:
    """Counts and seconds beside the paper's counts."""
    head = ["scene", "elements", "paper", "mold triangles", "paper", "steps", "run [s]", "compile [s]"]
    rows = []
    for name, row in found["counts"].items():
        begin, end = PAPER[name]["elements"]
        ours = f"{row['elements_initial']} to {row['elements_final']}"
        numbers = [str(row["mold"]), str(PAPER[name]["mold"]), str(row["steps"])]
        seconds = [f"{row['run_seconds']:.2f}", f"{row['compile_seconds']:.0f}"]
        rows.append([f"`{row['scene']}`", ours, f"{begin} to {end}", *numbers, *seconds])
    return table(head, rows)


def check_table(found: Row) -> str:
    """The table of checks of each run."""
    head = ["scene", "status", "touches the mold", "deepest an element cuts it", "energy balance within", "mass added"]
    head.append("nodal wall against the exact one, rms")
    rows = [
        [
            f"`{row['scene']}`",
            row["status"],
            f"{100 * row['contact_fraction']:.1f} %",
            f"{1e3 * row['penetration_max']:.2g} mm",
            f"{format_percent(row['balance_error'], 1)}",
            f"{format_percent(row['added_mass'])}",
            "" if row["wall_error"] is None else f"{format_percent(row['wall_error'])}",
        ]
        for row in found["counts"].values()
    ]
    return table(head, rows)


def thinning_table(found: Row) -> str:
    """The bottle's regions beside the paper's."""
    rows = [
        [row["region"], f"{row['ours']:.0f}", "{:.0f} to {:.0f}".format(*row["from to"]), row["paper"]]
        for row in found["thinning"]
    ]
    rows.append(["whole, had the parison been flat", f"{found['geometry']['largest mean thinning']:.0f}", "", ""])
    return table(["region", "thinning [%]", "its elements", "paper [%]"], rows)


def dependence_table(found: Row) -> str:
    """The table of what the bottle's wall depends on."""
    names = [*bottle_tables.PAPER, "touches"]
    rows = []
    for row in found["dependence"]:
        change = "" if row["wall change"] is None else f"{row['wall change']:.2g}"
        rows.append([row["changed"], *[f"{row[name]:.1f}" for name in names], change])
    return table(["changed", *[f"{name} [%]" for name in names], "wall, rms change [%]"], rows)


TABLES: dict[str, Callable[[Row], str]] = {
    "counts": count_table,
    "checks": check_table,
    "thinning": thinning_table,
    "dependence": dependence_table,
}


def with_tables(text: str, found: Row) -> str:
    """The page with its tables made anew, each between its marks.

    Raises:
        ValueError: The page lacks a mark.
    """
    for name, make in TABLES.items():
        if ("counts" if name == "checks" else name) not in found:
            continue
        begin, end = f"<!-- {name} -->\n", f"<!-- end of {name} -->"
        before, _, rest = text.partition(begin)
        _, found_end, after = rest.partition(end)
        if not found_end:
            raise ValueError(f"the page has no marks {begin.strip()} and {end}")
        text = before + begin + make(found) + "\n" + end + after
    return text


def draw(name: str, scene: Scene) -> None:
    """All pictures of a scene."""
    parts = run_watched(scene)
    stages(name, parts)
    DRAWINGS[name](parts)
    if name == "soap-bottle":
        # It moves within a few windows: with a fifth of the step there are enough to look at.
        solver = dataclasses.replace(scene.solver, safety=0.2 * scene.solver.safety)
        parts = run_watched(dataclasses.replace(scene, solver=solver))
    animation(name, parts)


def main(names: list[str]) -> None:
    """Runs what is named, of the scenes and of the steps (pictures, tables, counts), and writes the page."""
    jax.config.update("jax_enable_x64", True)
    path, page = DOCS / "scenes.json", DOCS / "scenes.md"
    steps = {"pictures", "tables", "counts"}
    wanted = steps & set(names) or steps
    chosen = {name: make for name, make in SCENES.items() if name in names or not set(SCENES) & set(names)}
    if "pictures" in wanted:
        for name, make in chosen.items():
            draw(name, make())
    if "tables" in wanted and "soap-bottle" in chosen:
        for part, found in bottle_tables.tables().items():
            store_figures(path, part, found)
    if "counts" in wanted:
        made = {name: make() for name, make in chosen.items()}
        firsts = {name: time_run(scene) for name, scene in made.items()}
        one_core()
        for name, scene in made.items():
            store_figures(path, "counts", count_table_rows(name, scene, firsts[name]), case=name)
    page.write_text(with_tables(page.read_text(), read_figures(path)))

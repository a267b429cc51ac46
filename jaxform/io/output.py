"""Results on disk: summary.json, final.vtu, frames, and the files of a fit."""

from __future__ import annotations

import csv
import json
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
from numpy.typing import NDArray

from jaxform.core.disk import atomic_path
from jaxform.core.errors import InputError
from jaxform.io.canvas import new_figure, save
from jaxform.io.plots import AFTER
from jaxform.io.scene_rewriting import inline
from jaxform.mesh import meshes
from jaxform.model.scene import Parison, Scene
from jaxform.results.part import part_elements
from jaxform.results.result import Result, drop_unused
from jaxform.results.summary import summarize, summarize_at_once, wrinkle_fraction
from jaxform.results.tool_contact import contact_durations
from jaxform.runs.host import Moment
from jaxform.sheet.state import initial_node_state
from jaxform.tools.mold import Mold

Array = NDArray[np.float64]


def write_result(
    scene: Scene,
    result: Result,
    folder: str | Path,
    warned: Sequence[str] = (),
    amend: Callable[[dict[str, Any]], dict[str, Any]] | None = None,
    *,
    there: bool = False,
) -> dict[str, Any]:
    """Writes the part into a folder that exists: summary.json, final.vtu, formed.stl, mold.vtu and tool_NAME.vtu.

    The files come first; measured values then complete the summary, so that nothing is lost by an interruption.

    Args:
        scene: The simulated scene.
        result: The part.
        folder: Folder for the files.
        warned: Warnings that were given before; they come first in the summary's.
        amend: Function that changes the summary before it is written; none by default.
        there: True if `write_at_once` has written the files already.

    Returns:
        The summary.
    """
    if not there:
        write_at_once(scene, result, folder, warned, amend)
    return _write_summary(Path(folder), summarize(result, scene), warned, amend)


def write_at_once(
    scene: Scene,
    result: Result,
    folder: str | Path,
    warned: Sequence[str] = (),
    amend: Callable[[dict[str, Any]], dict[str, Any]] | None = None,
) -> None:
    """Writes the files of `write_result`, with a summary in which measured values are null, and a warning of that."""
    folder = Path(folder)
    _write_summary(folder, summarize_at_once(result, scene), warned, amend)
    write_part(scene, result, folder / "final.vtu")
    shown, part = drop_unused(scene, result)
    with atomic_path(folder / "formed.stl") as fresh:
        meshes.write_stl(fresh, np.asarray(part.positions), np.asarray(shown.parison.triangles))
    tools = {file_stem(surface.mold): surface.mold for surface in scene.surfaces}
    for stale in [folder / "mold.vtu", *folder.glob("tool_*.vtu")]:
        if stale.stem not in tools:
            stale.unlink(missing_ok=True)  # of what was here before
    for stem, tool in tools.items():
        _write_tool(tool, float(result.time), folder / f"{stem}.vtu")


def file_stem(tool: Mold) -> str:
    """Name of the files of a mold or tool, without its ending."""
    return f"tool_{tool.name}" if tool.name else "mold"


def _write_tool(tool: Mold, time: float, path: Path) -> None:
    """Writes a mold or tool at its position at a time [s]."""
    with atomic_path(path) as fresh:
        meshes.write_vtu(fresh, tool.vertices_at(time), np.asarray(tool.triangles))


def _write_summary(
    folder: Path,
    summary: dict[str, Any],
    warned: Sequence[str],
    amend: Callable[[dict[str, Any]], dict[str, Any]] | None,
) -> dict[str, Any]:
    """Writes the amended summary of a part, with earlier warnings first, and returns it."""
    summary = summary | {"warnings": [*warned, *summary["warnings"]]}
    if amend is not None:
        summary = amend(summary)
    summary["warnings"] = list(dict.fromkeys(summary["warnings"]))
    write_json(folder / "summary.json", summary)
    return summary


def write_json(path: Path, facts: dict[str, Any]) -> None:
    """Writes plain numbers, words, lists and tables; null for numbers that are not finite."""
    text = json.dumps(_valid(facts), indent=2, allow_nan=False)
    with atomic_path(path) as fresh:
        fresh.write_text(text + "\n", encoding="utf-8")


def write_part(scene: Scene, result: Result, path: str | Path) -> None:
    """Writes the part as a mesh with data: initial position, thicknesses, contact time, tool, stretches, level."""
    scene, result = drop_unused(scene, result)
    stretches = np.asarray(result.stretches, float)
    point_data = {
        "reference": np.asarray(scene.parison.positions, float),
        "thickness": np.asarray(result.thickness, float),
        "initial_thickness": np.asarray(scene.parison.thickness, float),
        "contact_time": np.asarray(result.contact_time, float),
        "tool": np.asarray(result.tool, np.int32),
        **({} if result.slip is None else {"slip_distance": np.asarray(result.slip, float)}),
        **_durations(scene, contact_durations(result, len(scene.surfaces))),
        **_temperature(scene.parison, len(result.thickness), result.temperature),
        **{name: np.asarray(values, float) for name, values in result.fields.items()},
    }
    cell_data = {
        "thickness": np.asarray(result.element_thickness, float),
        "stretch_1": stretches[:, 0],
        "stretch_2": stretches[:, 1],
        "level": np.asarray(result.level, np.int32),
        **({} if scene.part is None else {"part": np.asarray(part_elements(result, scene), np.int32)}),
        **({"wrinkled": wrinkle_fraction(result)} if scene.material.tension_field else {}),
    }
    with atomic_path(path) as fresh:
        meshes.write_vtu(
            fresh, np.asarray(result.positions), np.asarray(scene.parison.triangles), point_data, cell_data
        )


def _temperature(parison: Parison, count: int, now: jax.Array | None = None) -> dict[str, np.ndarray]:
    """The sheet's temperature [degC] at its first nodes, where it has one: the present one, or the initial one."""
    temperature = parison.temperature if now is None else now
    return {} if temperature is None else {"temperature": np.asarray(temperature, float)[:count]}


def _durations(scene: Scene, durations: np.ndarray | None) -> dict[str, np.ndarray]:
    """Times (n_node, n_surface) [s] for which nodes have touched each tool, by name; none where all stick to one."""
    if durations is None or not (scene.slides or len(scene.surfaces) > 1):
        return {}
    names = ["mold"] * (scene.mold is not None) + [tool.name or str(number) for number, tool in enumerate(scene.tools)]
    return {f"contact_duration_{name}": durations[:, number] for number, name in enumerate(names)}


def write_sheet(scene: Scene, path: str | Path) -> None:
    """Writes the sheet before the first step, with the same data as `write_part`."""
    parison = scene.parison
    first, triangles = scene.first_nodes, np.asarray(parison.triangles)
    positions, thickness = np.asarray(parison.positions, float)[:first], np.asarray(parison.thickness, float)[:first]
    one = np.ones(len(triangles))
    meshes.write_vtu(
        path,
        positions,
        triangles,
        point_data={
            "reference": positions,
            "thickness": thickness,
            "initial_thickness": thickness,
            "contact_time": np.where(np.asarray(parison.clamped)[:first], 0.0, -1.0),
            "tool": _initial_tool(scene)[:first],
            **({"slip_distance": np.zeros(first)} if scene.slides else {}),
            **_durations(scene, np.zeros((first, len(scene.surfaces)))),
            **_temperature(parison, first),
            **{name: np.asarray(field.start(parison.positions), float)[:first] for name, field in scene.fields.items()},
        },
        cell_data={
            "thickness": thickness[triangles].mean(1),
            "stretch_1": one,
            "stretch_2": one,
            "level": np.zeros(len(triangles), np.int32),
            **({"wrinkled": np.zeros(len(triangles))} if scene.material.tension_field else {}),
        },
    )


def _initial_tool(scene: Scene) -> NDArray[np.int32]:
    """The number of the tool that nodes touch before the first step (n_node,), as in `Scene.surfaces`; -1 for none."""
    _, _, wall, tool = initial_node_state(scene)
    return np.where(np.asarray(wall) == 0, -1, 0 if tool is None else np.asarray(tool)).astype(np.int32)


@dataclass
class Frames:
    """Writes frames of the part at even intervals, from the sheet before the first step to the end.

    A single frame is that of the end. A mold and tools that move are written at their positions in each of them.

    Attributes:
        folder: Folder of frames.pvd, and of the folder of the frames.
        count: Number of frames.
        times: Times of the frames written so far [s].
        failure: The error that stopped writing; reported at the end, when the results are written.
    """

    folder: Path
    count: int
    times: list[float] = field(default_factory=list)
    failure: OSError | InputError | None = None

    def begin(self, scene: Scene) -> None:
        """Writes the sheet before the first step, where there is more than one frame; a previous list is removed."""
        (self.folder / "frames.pvd").unlink(missing_ok=True)
        if self.count > 1:
            write_sheet(scene, self._next(scene, 0.0))

    def offer(self, scene: Scene, moment: Moment) -> None:
        """Writes a frame if one is due; the last one is left to `finish`."""
        written = len(self.times)
        if written < self.count - 1 and moment.time >= written * moment.end_time / (self.count - 1):
            try:
                write_part(scene, moment.result(), self._next(scene, moment.time))
            except (OSError, InputError) as error:
                self.count, self.failure = 0, error

    def finish(self, scene: Scene, result: Result) -> None:
        """Writes the last frame, where frames are wanted and it is not there yet, and the list of all.

        Raises:
            OSError: A frame could not be written, now or before.
            InputError: The same.
        """
        if self.failure is not None:
            raise self.failure
        if not self.count:
            return
        if not self.times or self.times[-1] < float(result.time):
            write_part(scene, result, self._next(scene, float(result.time)))
        moving = [self._list_frames(file_stem(tool)) for tool in _moving_tools(scene)]
        with atomic_path(self.folder / "frames.pvd") as fresh:
            meshes.write_pvd(fresh, self._list_frames("frame"), *moving)

    def _list_frames(self, what: str) -> list[tuple[float, str]]:
        return [(time, f"frames/{_name(what, index)}") for index, time in enumerate(self.times)]

    def _next(self, scene: Scene, time: float) -> Path:
        """Path for the frame at a time [s]; writes those of tools that move."""
        folder, index = self.folder / "frames", len(self.times)
        folder.mkdir(exist_ok=True)
        self.times.append(time)
        for tool in _moving_tools(scene):
            _write_tool(tool, time, folder / _name(file_stem(tool), index))
        return folder / _name("frame", index)


def _name(what: str, index: int) -> str:
    return f"{what}_{index:04d}.vtu"


def _moving_tools(scene: Scene) -> list[Mold]:
    """The mold and the tools of a scene that move."""
    return [surface.mold for surface in scene.surfaces if surface.mold.motion is not None]


def _valid(value: Any) -> Any:
    """A copy with null for numbers that are not finite, which JSON does not have."""
    if isinstance(value, dict):
        return {key: _valid(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_valid(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


# The files of a fit: the table of the material for a scene, its rows, and the picture of data and fit.


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
        logarithmic: True if the x axis is logarithmic.
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
    """The table `[material]` as TOML, its Prony terms as `[material.viscous]`, below comments of a line each."""
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
        panel_curves = [curve for curve in curves if (curve.panel, curve.across) == panel]
        for curve, color in zip(panel_curves, _cycle_colors(len(panel_curves)), strict=True):
            _draw(upper, lower, curve, color)
        upper.set(ylabel=panel[0])
        lower.set(
            xlabel=panel[1], ylabel="fit less measured [%]", xscale="log" if panel_curves[0].logarithmic else "linear"
        )
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
    nonzero = curve.measured != 0.0
    off = 100.0 * (curve.fitted[nonzero] / curve.measured[nonzero] - 1.0)
    lower.plot(curve.at[nonzero], off, "o-", color=color, markersize=3, linewidth=0.8)

"""Results to disk: summary.json, final.vtu, frames."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from jaxform import meshes
from jaxform.result import Result, only_used, summarize
from jaxform.scene import Scene
from jaxform.simulation import Moment
from jaxform.writing import whole


def write_result(
    scene: Scene,
    result: Result,
    folder: str | Path,
    amend: Callable[[dict[str, Any]], dict[str, Any]] | None = None,
) -> dict[str, Any]:
    """Writes summary.json and final.vtu into a folder that exists; returns the summary, amended on request."""
    folder = Path(folder)
    summary = summarize(result, scene)
    if amend is not None:
        summary = amend(summary)
    write_json(folder / "summary.json", summary)
    write_part(scene, result, folder / "final.vtu")
    return summary


def write_json(path: Path, facts: dict[str, Any]) -> None:
    """Writes plain numbers, words, lists and tables; null for numbers that are not finite."""
    text = json.dumps(_valid(facts), indent=2, allow_nan=False)
    with whole(path) as fresh:
        fresh.write_text(text + "\n", encoding="utf-8")


def write_part(scene: Scene, result: Result, path: str | Path) -> None:
    """Writes the part as a mesh with data: initial position, thicknesses, time of contact, stretches, level."""
    scene, result = only_used(scene, result)
    stretches = np.asarray(result.stretches, float)
    point_data = {
        "reference": np.asarray(scene.parison.positions, float),
        "thickness": np.asarray(result.thickness, float),
        "initial_thickness": np.asarray(scene.parison.thickness, float),
        "contact_time": np.asarray(result.contact_time, float),
    }
    cell_data = {
        "thickness": np.asarray(result.element_thickness, float),
        "stretch_1": stretches[:, 0],
        "stretch_2": stretches[:, 1],
        "level": np.asarray(result.level, np.int32),
    }
    with whole(path) as fresh:
        meshes.write_vtu(
            fresh, np.asarray(result.positions), np.asarray(scene.parison.triangles), point_data, cell_data
        )


@dataclass
class Frames:
    """Writes the part every so often: so many frames, evenly from the first window's end to the end.

    Attributes:
        folder: Where frames.pvd goes, and the folder of the frames.
        count: How many.
        times: Of the frames written so far [s].
    """

    folder: Path
    count: int
    times: list[float] = field(default_factory=list)

    def offer(self, scene: Scene, moment: Moment) -> None:
        """Writes a frame if one is due; the last one is left to `finish`."""
        written = len(self.times)
        if written < self.count - 1 and moment.time >= written * moment.end_time / (self.count - 1):
            self._write(scene, moment.result())

    def finish(self, scene: Scene, result: Result) -> None:
        """Writes the last frame, where frames are wanted and it is not there yet, and the list of all."""
        if not self.count:
            return
        if not self.times or self.times[-1] < float(result.time):
            self._write(scene, result)
        names = [f"frames/{_frame_name(index)}" for index in range(len(self.times))]
        with whole(self.folder / "frames.pvd") as fresh:
            meshes.write_pvd(fresh, list(zip(self.times, names, strict=True)))

    def _write(self, scene: Scene, result: Result) -> None:
        (self.folder / "frames").mkdir(exist_ok=True)
        write_part(scene, result, self.folder / "frames" / _frame_name(len(self.times)))
        self.times.append(float(result.time))


def _frame_name(index: int) -> str:
    return f"frame_{index:04d}.vtu"


def _valid(value: Any) -> Any:
    """The same with null for numbers that are not finite, which JSON does not have."""
    if isinstance(value, dict):
        return {key: _valid(item) for key, item in value.items()}
    return None if isinstance(value, float) and not math.isfinite(value) else value

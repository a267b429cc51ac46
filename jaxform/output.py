"""Results to disk: summary.json, final.vtu, frames."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from jaxform import meshes
from jaxform.errors import InputError
from jaxform.result import Result, only_used, summarize
from jaxform.scene import Scene
from jaxform.simulation import Moment


def write_result(scene: Scene, result: Result, folder: str | Path) -> dict[str, Any]:
    """Writes summary.json and final.vtu into a folder that exists; returns the summary."""
    folder = Path(folder)
    summary = summarize(result, scene)
    write_json(folder / "summary.json", summary)
    write_part(scene, result, folder / "final.vtu")
    return summary


def write_json(path: Path, facts: dict[str, Any]) -> None:
    """Writes plain numbers, words, lists and tables; null for numbers that are not finite."""
    text = json.dumps(_valid(facts), indent=2, allow_nan=False)
    path.write_text(text + "\n", encoding="utf-8")


def write_part(scene: Scene, result: Result, path: str | Path) -> None:
    """Writes the part as a mesh with data: initial position, thicknesses, time of contact, stretches, level."""
    scene, result = only_used(scene, result)
    stretches = np.asarray(result.stretches, float)
    meshes.write_vtu(
        path,
        np.asarray(result.positions),
        np.asarray(scene.parison.triangles),
        point_data={
            "reference": np.asarray(scene.parison.positions, float),
            "thickness": np.asarray(result.thickness, float),
            "initial_thickness": np.asarray(scene.parison.thickness, float),
            "contact_time": np.asarray(result.contact_time, float),
        },
        cell_data={
            "thickness": np.asarray(result.element_thickness, float),
            "stretch_1": stretches[:, 0],
            "stretch_2": stretches[:, 1],
            "level": np.asarray(result.level, np.int32),
        },
    )


@dataclass
class Frames:
    """Writes the part every so often: so many frames, evenly from the first window's end to the end.

    Attributes:
        folder: Where frames.pvd goes, and the folder of the frames.
        count: How many.
        times: Of the frames written so far [s].
        failure: Why no more can be written; told at the end, when the results are safe.
    """

    folder: Path
    count: int
    times: list[float] = field(default_factory=list)
    failure: OSError | InputError | None = None

    def offer(self, scene: Scene, moment: Moment) -> None:
        """Writes a frame if one is due; the last one is left to `finish`."""
        written = len(self.times)
        if written < self.count - 1 and moment.time >= written * moment.end_time / (self.count - 1):
            try:
                self._write(scene, moment.result())
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
            self._write(scene, result)
        names = [f"frames/{_frame_name(index)}" for index in range(len(self.times))]
        meshes.write_pvd(self.folder / "frames.pvd", list(zip(self.times, names, strict=True)))

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

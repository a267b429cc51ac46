"""The process over time: pressure, displacements of tools, and contact; as a table, and as one picture."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from jaxform.core.disk import atomic_path
from jaxform.core.pytree import as_real
from jaxform.io.canvas import ProcessHistory
from jaxform.io.surfaces import MOLD_COLOR, tool_colors
from jaxform.loads import RegionalLoad, TwoSidedLoad, sample_pressure
from jaxform.model.scene import Scene
from jaxform.results.result import Result
from jaxform.results.tool_contact import contact_shares, contact_shares_over_time, tool_label
from jaxform.tools.mold import Mold

Array = NDArray[np.float64]

TABLE, PICTURE = "process.csv", "process.png"
"""Names of the files in a folder of results."""
_TIMES = 241  # of the table, besides the knots of pressure and motions


def process_history(scene: Scene, result: Result) -> ProcessHistory | None:
    """The process of a run; None where nothing changes over time: constant pressure, tools at rest, clamp closed."""
    tools = [surface.mold for surface in scene.surfaces]
    time = _times(scene, tools, float(result.time))
    pressures = pressures_over_time(scene, result, time)
    release = _release_time(scene, float(time[-1]))
    if not scene.moves and not any(np.ptp(pressure) for pressure in pressures.values()) and release is None:
        return None
    displacements = {
        tool_label(tool): tool.offset_at(time) @ np.asarray(tool.motion.direction, float)
        for tool in tools
        if tool.motion is not None
    }
    contact, names = _contact(result, time, len(tools)), [tool_label(tool) for tool in tools]
    colors = [MOLD_COLOR] * (scene.mold is not None) + tool_colors(len(scene.tools))
    return ProcessHistory(
        title=f"{scene.name}: the process",
        time=time,
        pressures=pressures,
        displacements=displacements,
        contact=dict(zip(names, contact, strict=True)),
        colors=dict(zip(names, colors, strict=True)),
        moves=_moving_spans(tools, float(time[-1])),
        release=release,
    )


def _release_time(scene: Scene, end: float) -> float | None:
    """Time [s] at which the clamp opens; None where it does not before an end [s]."""
    until = scene.parison.clamp_until
    return None if until is None or float(until) >= end else float(until)


def _moving_spans(tools: Sequence[Mold], end: float) -> dict[str, list[tuple[float, float]]]:
    """Begin and end [s] of the spans before an end [s] in which each tool moves, by its name."""
    moves = {}
    for tool in tools:
        if tool.motion is not None:
            time, far = np.asarray(tool.motion.time, float), np.asarray(tool.motion.displacement, float)
            spans = [(time[k], time[k + 1]) for k in np.flatnonzero(np.diff(far)) if time[k] < end]
            moves[tool_label(tool)] = [(float(a), min(float(b), end)) for a, b in spans]
    return moves


def _times(scene: Scene, tools: Sequence[Mold], end: float) -> Array:
    """Times (n,) [s] of the table: even ones, and the knots of pressure and motions."""
    knots = [np.asarray(tool.motion.time, float) for tool in tools if tool.motion is not None]
    load = scene.pressure
    parts = (load.inside, load.trapped) if isinstance(load, TwoSidedLoad) else (load,)
    for part in load.loads if isinstance(load, RegionalLoad) else parts:
        own = getattr(part, "time", None)
        knots += [] if own is None else [np.atleast_1d(np.asarray(own, float))]
    found = np.concatenate([np.linspace(0.0, end, _TIMES), *knots])
    return np.unique(found[(found >= 0.0) & (found <= end)])


def pressures_over_time(scene: Scene, result: Result, time: Array) -> dict[str, Array]:
    """Pressures (n,) [Pa] at times (n,) [s] by name: of loads of regions theirs, of all others one without a name.

    They are those of the run where they follow the volume, NaN if it recorded none.
    """
    names = scene.pressure.names if isinstance(scene.pressure, RegionalLoad) else ("",)
    if result.pressures is not None:
        recorded, *rows = result.pressures
        return {name: np.interp(time, recorded, row) for name, row in zip(names, rows, strict=True)}
    if scene.pressure.follows_volume:
        return {name: np.full(len(time), np.nan) for name in names}
    return {"": np.asarray(sample_pressure(scene.pressure, as_real(time)), float)}


def _contact(result: Result, time: Array, count: int) -> Array:
    """Shares (count, n) of the formed area in contact with each of so many tools."""
    if result.contacts is None:
        return contact_shares_over_time(result, time, count)
    recorded, *shares = np.concatenate([result.contacts, _now(result, count)], axis=1)
    return np.array([np.interp(time, recorded, share) for share in shares]).reshape(count, len(time))


def _now(result: Result, count: int) -> Array:
    """The time [s] and the shares at the end, (1 + count, 1)."""
    return np.concatenate([[float(result.time)], contact_shares(result, count)])[:, None]


def write_process(history: ProcessHistory | None, folder: Path) -> None:
    """Writes process.csv into a folder of results; without a process, removes table and picture of an earlier run."""
    path = folder / TABLE
    if history is None:
        for name in (TABLE, PICTURE):
            (folder / name).unlink(missing_ok=True)
        return
    columns = {"time": history.time}
    columns |= {f"pressure_{name}" if name else "pressure": values for name, values in history.pressures.items()}
    columns |= {f"displacement_{name}": values for name, values in history.displacements.items()}
    columns |= {f"contact_{name}": values for name, values in history.contact.items()}
    rows = np.stack(list(columns.values()), axis=1)
    lines = [",".join(columns), *(",".join("" if np.isnan(x) else f"{x:.9g}" for x in row) for row in rows)]
    with atomic_path(path) as fresh:
        fresh.write_text("\n".join(lines) + "\n", encoding="utf-8")

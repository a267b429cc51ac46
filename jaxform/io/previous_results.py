"""Results of an earlier run that later runs need, read from its folder."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from jaxform.core import disk
from jaxform.core.errors import InputError, warn_of
from jaxform.mesh.meshes import LARGEST
from jaxform.mesh.shapes import parse_plane

AGAIN = "name the folder that `jaxform simulate` or `jaxform optimize` wrote, or run it again"
"""Remedy of results that are missing or damaged."""
SUMMARY = "summary.json"
"""The file's name in a folder of results."""
_PART = "final.vtu"
_SAME = 1e-6  # m: planes as near as that are one


def read_summary(folder: Path) -> dict[str, Any]:
    """The summary in a folder of results; empty where there is none.

    Raises:
        InputError: It cannot be read, or is no JSON table.
    """
    path = folder / SUMMARY
    if not disk.is_file(path):
        return {}
    text = disk.read_text(path)
    try:
        found = json.loads(text)
    except (ValueError, RecursionError):
        raise InputError("is not valid JSON", AGAIN, file=str(path)) from None
    if not isinstance(found, dict):
        raise InputError("is not a table", AGAIN, file=str(path))
    return found


def symmetry_planes(summary: Mapping[str, Any]) -> dict[int, float]:
    """Axis and place [m] of the planes at which a part is cut."""
    found = summary.get("symmetry_planes")
    known = found.items() if isinstance(found, dict) else ()
    return {
        "xyz".index(axis): float(level)
        for axis, level in known
        # JSON may have integers that no float can hold, and numbers that are not finite.
        if axis in ("x", "y", "z") and isinstance(level, float | int) and abs(level) <= LARGEST
    }


def check_planes(path: Path, scale: float, planes: Sequence[str]) -> None:
    """Warns where a parison is the part of an earlier run, and is held at its cuts otherwise than that was.

    Args:
        path: The parison's file.
        scale: Factor on its coordinates.
        planes: Its symmetry planes, as the scene file names them.
    """
    if path.name != _PART:
        return
    try:
        summary = read_summary(path.parent)
    except InputError:
        return
    if "symmetry_planes" not in summary:
        return
    earlier = symmetry_planes(summary)
    wanted = {axis: scale * level for axis, level in earlier.items()}
    given = dict(map(parse_plane, planes))
    if wanted.keys() == given.keys() and all(abs(given[axis] - wanted[axis]) <= _SAME for axis in wanted):
        return
    names = ", ".join(f'"{"xyz"[axis]}={level:.9g}"' for axis, level in wanted.items())
    problem = f"the part of that run is cut at planes = [{names}] (its {SUMMARY})"
    remedy = "name the same planes: otherwise its cut edges are clamped, or its rim is free"
    warn_of(problem, remedy, key="parison.planes", value=list(planes))

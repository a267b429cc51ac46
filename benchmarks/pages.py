"""Common parts of the pages under docs/: a file of figures, kept part by part, and pictures."""

from __future__ import annotations

import datetime
import json
from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt

DOCS = Path(__file__).parent.parent / "docs"
Found = dict[str, Any]
_MEASURED = "measured"  # on which day each part was


def read_figures(path: Path) -> Found:
    """The figures so far; none where there is no file."""
    return json.loads(path.read_text()) if path.exists() else {}


def store_figures(path: Path, name: str, found: Any, *, case: str = "", digits: int | None = None) -> None:
    """Puts a part, or a case of it, into the file, which another part may have written in the meantime.

    Args:
        path: The file.
        name: The part.
        found: Its figures.
        case: The part's case; the part itself by default.
        digits: Digits of the numbers that are kept; all by default.
    """
    parts = read_figures(path)
    rounded = found if digits is None else _round(found, digits)
    if case:
        parts.setdefault(name, {})[case] = rounded
    else:
        parts[name] = rounded
    parts.setdefault(_MEASURED, {})[f"{name}: {case}" if case else name] = datetime.date.today().isoformat()
    path.write_text(json.dumps(parts, indent=1) + "\n", encoding="utf-8")


def days(found: Found) -> str:
    """A sentence that says when the parts were measured, the latest first; nothing where that is not known."""
    names: dict[str, list[str]] = {}
    for name, day in found.get(_MEASURED, {}).items():
        names.setdefault(day, []).append(name)
    latest = [(datetime.date.fromisoformat(day), names[day]) for day in sorted(names, reverse=True)]
    return "".join(f"Measured on {day.day} {day:%B %Y}: {', '.join(sorted(parts))}.\n" for day, parts in latest)


def _round(value: Any, digits: int) -> Any:
    if isinstance(value, dict):
        return {key: _round(part, digits) for key, part in value.items()}
    if isinstance(value, list | tuple):
        return [_round(part, digits) for part in value]
    return float(f"{value:.{digits}g}") if isinstance(value, float) else value


def save(figure: Any, path: Path) -> None:
    """Writes a picture, the same bytes each time, and closes it."""
    figure.savefig(path, dpi=110, metadata={"Software": None})
    plt.close(figure)

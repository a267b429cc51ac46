"""The page of a sweep: its table, whose rows open the part of the design by a click, and its pictures."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from html import escape
from importlib import resources
from pathlib import Path
from typing import Any

from jaxform.core.disk import atomic_path
from jaxform.sweeps.records import Row, number

NAME = "report.html"
_PICTURES = {
    "thinnest_wall.png": "Thinnest wall against each variable",
    "main_effects.png": "Main effects",
    "scatter_matrix.png": "Scatter matrix",
}
_SHOWN = {"m": (1e3, "mm"), "kg": (1e3, "g"), "Pa": (1e-3, "kPa")}
_HIDDEN = ("folder", "digest")


def write_report(
    folder: Path, facts: Mapping[str, Any], columns: Sequence[str], rows: Sequence[Row], pictures: Sequence[str]
) -> Path:
    """Writes report.html into the folder of a sweep, and returns its path.

    Args:
        folder: The folder.
        facts: Contents of sweep.json.
        columns: Columns of results.csv.
        rows: Its rows.
        pictures: Names of the pictures in the folder.

    Raises:
        InputError: It cannot be written.
    """
    shown = [column for column in columns if column not in _HIDDEN]
    drawn = "".join(
        f'<figure class="card"><figcaption>{_PICTURES[name]}</figcaption>'
        f'<a href="{name}"><img src="{name}" alt="{_PICTURES[name]}"></a></figure>'
        for name in pictures
    )
    parts = {
        "title": escape(f"{Path(str(facts['source'])).name}: jaxform sweep"),
        "name": escape(Path(str(facts["source"])).name),
        "counts": _counts(facts),
        "head": "".join(_heading(column, facts["units"].get(column, "")) for column in shown),
        "rows": "\n".join(_row(row, shown, facts["units"]) for row in rows),
        "pictures": drawn,
    }
    text = resources.files(__name__.rpartition(".")[0]).joinpath("sweep.html").read_text(encoding="utf-8")
    page = re.sub(r"@(\w+)@", lambda found: parts[found[1]], text)
    with atomic_path(folder / NAME) as fresh:
        fresh.write_text(page, encoding="utf-8")
    return folder / NAME


def _counts(facts: Mapping[str, Any]) -> str:
    failed = f", <b class=bad>{facts['failed']} failed</b>" if facts["failed"] else ""
    return f"{facts['designs']} designs: {facts['ok']} ok{failed}"


def _heading(column: str, unit: str) -> str:
    shown = "%" if column in ("wall_cv", "contact_fraction") else _SHOWN.get(unit, (1.0, unit))[1]
    words = f"{escape(column)}<small>{escape(f' [{shown}]' if shown else '')}</small>"
    return f'<th scope="col"><button>{words}</button></th>'


def _row(row: Row, columns: Sequence[str], units: Mapping[str, str]) -> str:
    """A row of the table; a click opens the report of its part, where there is one."""
    opens = f' data-part="{escape(row["folder"])}/report.html" tabindex="0"' if row["folder"] else ""
    kind = "" if row["status"] == "ok" else ' class="bad"'
    cells = "".join(_cell(row[column], column, units.get(column, "")) for column in columns)
    return f"<tr{kind}{opens}>{cells}</tr>"


def _cell(text: str, column: str, unit: str) -> str:
    value = number(text)
    if value is None:
        whole, short = escape(text), escape(text if len(text) < 60 else f"{text[:57]}...")
        return f'<td title="{whole}" data-value="{whole}">{short}</td>'
    factor = 100.0 if column in ("wall_cv", "contact_fraction") else _SHOWN.get(unit, (1.0, unit))[0]
    return f'<td class=number data-value="{value!r}">{factor * value:.4g}</td>'

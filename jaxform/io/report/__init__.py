"""The report: one HTML file with the part in three dimensions, its diagrams and its tables, which needs no network.

It is made from the files in a folder of results. `stored_results` reads them, `contents` and `charts` pack the data
that the scripts draw, `charts` also finds the measuring points, `page` writes text and tables; the scripts unpack
(`unpack.js`), draw (`view.js`, `part.js`, `chart.js`) and answer (`page.js`).
"""

from __future__ import annotations

from html import escape
from importlib import resources
from pathlib import Path

import numpy as np

from jaxform.core.disk import atomic_path
from jaxform.io.report import page
from jaxform.io.report.charts import measuring_points, pack_charts
from jaxform.io.report.contents import Parcel, pack_parts
from jaxform.io.report.stored_results import Results, read_results

NAME = "report.html"
_SCRIPTS = ("unpack", "chart", "map", "part", "shaders", "view", "words", "overlay", "controls", "page")


def write_report(folder: str | Path) -> Path:
    """Writes report.html into a folder of results, from the files that are there.

    Args:
        folder: Folder of results of `jaxform simulate` or `jaxform optimize`.

    Returns:
        The path of the report.

    Raises:
        InputError: The folder holds no results, a file there is damaged, or the report cannot be written.
    """
    folder = Path(folder)
    results = read_results(folder)
    with np.errstate(all="ignore"):
        text = _page(results)
    with atomic_path(folder / NAME) as fresh:
        fresh.write_text(text, encoding="utf-8")
    return folder / NAME


def _page(results: Results) -> str:
    """The text of the page."""
    points = measuring_points(results.part, results.summary)
    parcel = Parcel()
    facts = pack_parts(results, parcel) | {
        "charts": pack_charts(results, parcel),
        "frame_count": results.frame_count,
        "points": [point.description() for point in points],
        "thinnest": results.summary["thickness"]["min"],
        "thickest": results.summary["thickness"]["max"],
    }
    design, tools = page.design(results.summary), page.tools(results)
    parts = {
        "title": escape(f"{results.summary['scene']}: jaxform report"),
        "style": _text("page.css"),
        "heading": page.heading(results),
        "quality": page.quality(results),
        "measure": page.to_measure(points),
        "tools": f'<div class="columns"><section class="card">{tools}</section></div>' if tools else "",
        "design": f"<section class=card>{design}</section>" if design else "",
        "energy": page.energy(results.summary),
        "scene": page.scene(results),
        "parcel": parcel.text(facts),
        "scripts": "\n".join(_text(f"{name}.js") for name in _SCRIPTS),
    }
    return "".join(parts[piece] if place % 2 else piece for place, piece in enumerate(_text("page.html").split("@")))


def _text(name: str) -> str:
    return resources.files(__name__).joinpath(name).read_text(encoding="utf-8")

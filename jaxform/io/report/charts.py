"""Diagrams of the report: the wall along sections, measuring points, and the history of a search."""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from types import SimpleNamespace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from jaxform.io.canvas import PRESSURE_COLORS
from jaxform.io.report.contents import Parcel, by_first_use, symmetry_of
from jaxform.io.report.stored_results import Results, StoredPart
from jaxform.io.surfaces import (
    MOLD_COLOR,
    angle_range,
    counted_elements,
    distinguishable_points,
    map_sheet,
    tool_colors,
    varies_across,
)
from jaxform.mesh import topology
from jaxform.results import sections
from jaxform.results.sections import SectionCurve

Array = NDArray[np.float64]
Chart = dict[str, Any]

# Measuring points for a first part, and its wall along sections, from stored results.

_ALIKE = 0.02  # of the mean, by which the wall of a representative place may differ from it


class MeasuringPoint(NamedTuple):
    """A place to measure the wall at.

    Attributes:
        name: Name of the place.
        chosen: Criterion of its choice, in words.
        thickness: Thickness of the wall there [m].
        formed, initial: The middle of the element (3,) [m], in the part and in the initial sheet.
    """

    name: str
    chosen: str
    thickness: float
    formed: list[float]
    initial: list[float]

    def description(self) -> dict[str, Any]:
        """Its name and place, for the view."""
        return {"name": self.name, "formed": self.formed}


def measuring_points(part: StoredPart, summary: Mapping[str, Any]) -> list[MeasuringPoint]:
    """Three places to measure on a first part: the thinnest, the thickest that was formed, and a representative one.

    Args:
        part: The part.
        summary: The contents of summary.json, which knows the thinnest place and the mean wall.
    """
    thin, mean = summary["thinnest"], summary["thickness"]["mean"]
    walls = part.cells["thickness"]
    formed = np.flatnonzero(counted_elements(part.reference, part.positions, part.triangles, part.part_mask))
    thickest = int(formed[np.argmax(walls[formed])])
    points = [
        MeasuringPoint("thinnest", "the thinnest element", thin["thickness"], thin["formed"], thin["initial"]),
        _point("thickest", "the thickest of the formed elements", part, thickest),
    ]
    if mean:
        words = f"the formed element within {100 * _ALIKE:.0f} % of the mean wall around which the wall varies least"
        points.append(_point("representative", words, part, _representative(part, formed, mean)))
    return points


def wall_curves(part: StoredPart, symmetry: Mapping[str, float], through: ArrayLike) -> list[sections.SectionCurve]:
    """The curves of `jaxform.results.sections.curves`, which know the part, through a place [m] in the initial sheet.

    Args:
        part: The part.
        symmetry: Place [m] of the symmetry planes by the name of their axis.
        through: The place (3,) [m].
    """
    result: Any = SimpleNamespace(positions=part.positions, thickness=part.nodal["thickness"])
    mask = part.part_mask
    return sections.curves(_scene(part, symmetry), result, through, None if mask is None else mask != 0)


def is_disc(part: StoredPart, symmetry: Mapping[str, float]) -> bool:
    """True if the initial sheet is flat and its rim a circle about the z axis."""
    return sections.is_disc(_scene(part, symmetry))


def _scene(part: StoredPart, symmetry: Mapping[str, float]) -> Any:
    """The sheet as sections take it from a scene, as far as the file of the part tells."""
    fixed = np.zeros((len(part.reference), 3), bool)
    for axis, on_plane in _nodes_on_planes(part, symmetry):
        fixed[:, axis] = on_plane
    sheet = {"positions": part.reference, "triangles": part.triangles, "fixed": fixed, "guided": ()}
    return SimpleNamespace(parison=SimpleNamespace(**sheet, clamped=_clamped_nodes(part, symmetry)))


def _point(name: str, chosen: str, part: StoredPart, element: int) -> MeasuringPoint:
    nodes = part.triangles[element]
    formed, initial = (places[nodes].mean(0).tolist() for places in (part.positions, part.reference))
    return MeasuringPoint(name, chosen, float(part.cells["thickness"][element]), formed, initial)


def _representative(part: StoredPart, formed: NDArray[np.int64], mean: float) -> int:
    """The element, of those whose wall is nearly the mean, at whose corners the wall differs least for its size."""
    away = np.abs(part.cells["thickness"][formed] / mean - 1.0)
    alike = formed[away <= max(_ALIKE, float(away.min()))]
    corners = part.positions[part.triangles[alike]]
    size = np.linalg.norm(np.ptp(corners, axis=1), axis=1)
    change = np.ptp(part.nodal["thickness"][part.triangles[alike]], axis=1)
    return int(alike[np.argmin(change / np.maximum(size, 1e-300))])


def _clamped_nodes(part: StoredPart, symmetry: Mapping[str, float]) -> NDArray[np.bool_]:
    """Nodes (n_node,) of the rim that were held from the start: ends of edges in no symmetry plane."""
    edges = topology.boundary_edges(part.triangles)
    for _, on_plane in _nodes_on_planes(part, symmetry):
        edges = edges[~on_plane[edges].all(1)]
    rim = np.zeros(len(part.positions), bool)
    rim[edges.ravel()] = True
    return rim & (part.nodal["contact_time"] == 0.0)


def _nodes_on_planes(part: StoredPart, symmetry: Mapping[str, float]) -> list[tuple[int, NDArray[np.bool_]]]:
    """Axes of the symmetry planes, and the nodes (n_node,) of the initial sheet on each."""
    near = 1e-6 * float(np.ptp(part.reference, axis=0).max())
    axes = {"xyz".index(name): level for name, level in symmetry.items()}
    return [(axis, np.abs(part.reference[:, axis] - level) <= near) for axis, level in axes.items()]


_KEPT = 5e-3  # of a limit, by which it may be broken


_EVEN = 1e-6  # of a field's largest value, by which it may vary where it is one number
_DESIGNED = {
    "initial_thickness": ("initial thickness [mm]", 1e3),
    "temperature": ("temperature of the sheet [°C]", 1.0),
}


def pack_charts(results: Results, parcel: Parcel) -> list[Chart]:
    """Packs the points of the diagrams; returns their titles, axes and lines, as plain numbers and words."""
    charts = [_wall(results, parcel)]
    if results.start is not None:
        charts += _initial(results.start, results.part, symmetry_of(results), parcel)
    if results.process:
        charts += _process(results.process, results.release, parcel)
    if results.history:
        charts += _history(results.history, parcel)
    return [chart for chart in charts if chart["series"] or "map" in chart]


_CUT_OFF = "#c8c8c8"  # of the wall beyond the part


def _wall(results: Results, parcel: Parcel) -> Chart:
    """The wall over arc length; of a search that of the start beside it."""
    symmetry, thin = symmetry_of(results), results.summary["thinnest"]
    through = np.array([np.nan if x is None else x for x in thin["initial"]], float)
    curves = wall_curves(results.part, symmetry, through)
    named = [(curve.label, "after", curve) for curve in curves]
    if results.start is not None:
        named = [("best design", "after", curve) for curve in curves[:1]]
        named += [("start", "before", curve) for curve in wall_curves(results.start, symmetry, through)[:1]]
    disc = any(curve.label == "all nodes" for curve in curves)
    series, beyond = [], []
    for number, (label, role, curve) in enumerate(named):
        line = {"label": label, "role": role if number == 0 or results.start else "other", "dots": _is_cloud(curve)}
        kept = _visible_points(curve.arc, curve.thickness, line["dots"])
        # The number of the part in the view.
        line |= {"places": f"chart.places{number}", "part": 0 if role == "after" else 1}
        parcel.add(line["places"], curve.place[kept])
        arc, wall = 1e3 * curve.arc[kept], 1e3 * curve.thickness[kept]
        if curve.in_part is not None and not curve.in_part.all():
            words = "" if beyond else "cut off the part"
            beyond.append(line | {"label": words, "color": _CUT_OFF} | _pack(parcel, f"beyond{number}", arc, wall))
        line |= _pack(parcel, f"wall{number}", arc, 1e3 * curve.part_thickness[kept])
        marked = curve.marked
        if role == "after" and marked is not None and np.isfinite(marked) and thin["thickness"] is not None:
            line["mark"] = [1e3 * marked, 1e3 * thin["thickness"], "thinnest"]
        series.append(line)
    where = "arc length from the axis" if disc else "arc length along the section"
    title = "Wall along the meridian" if disc else "Wall along sections through the thinnest place"
    return _chart(title, f"{where} [mm]", "wall thickness [mm]", [*beyond, *series], zero=True)


def _initial(start: StoredPart, best: StoredPart, symmetry: Mapping[str, float], parcel: Parcel) -> list[Chart]:
    """Chart of the thickness or temperature that the search changed, over the initial sheet; empty without one.

    A field is a map, anything else points along the sheet.
    """
    changed = [name for name in _DESIGNED if name in best.nodal and not _same(start.nodal.get(name), best.nodal[name])]
    if not changed:
        return []
    (words, factor), name = _DESIGNED[changed[0]], changed[0]
    disc, along = is_disc(best, symmetry), int(np.argmax(np.ptp(best.reference, axis=0)))
    place = np.hypot(*best.reference[:, :2].T) if disc else best.reference[:, along]
    if varies_across(place, best.nodal[name]):
        return _maps(start, best, name, symmetry, parcel)
    series = []
    for role, label, part in (("after", "best design", best), ("before", "start", start)):
        if name not in part.nodal:
            continue
        place = np.hypot(*part.reference[:, :2].T) if disc else part.reference[:, along]
        kept = _visible_points(place, part.nodal[name], dots=True)
        points = _pack(parcel, f"initial.{role}", 1e3 * place[kept], factor * part.nodal[name][kept])
        series.append({"label": label, "role": role, "dots": True, **points})
    where = "initial radius" if disc else f"initial {'xyz'[along]}"
    return [_chart("The initial sheet", f"{where} [mm]", words, series, zero=factor > 1.0)]


def _maps(start: StoredPart, best: StoredPart, name: str, symmetry: Mapping[str, float], parcel: Parcel) -> list[Chart]:
    """Maps of a designed field over the initial sheet: of the best design, and of the start if it varies, too.

    They have one range of colours.
    """
    words, factor = _DESIGNED[name]
    parts = [part for part in (best, start) if name in part.nodal]
    fields = [factor * part.nodal[name] for part in parts]
    low, high = (float(end(np.concatenate(fields))) for end in (np.min, np.max))
    varies = [number for number, field in enumerate(fields) if np.ptp(field) > _EVEN * np.abs(field).max()]
    legend = f"start: {fields[1].mean():.4g} everywhere" if 1 not in varies and len(fields) == 2 else ""
    titles = ["The initial sheet" + ", best design" * (len(varies) == 2), "The initial sheet, start"]
    charts = []
    for number in varies:
        drawn, labels = _pack_map(_scene(parts[number], symmetry), fields[number], parcel, f"map{number}")
        drawn |= {"low": low, "high": high, "words": words}
        charts.append(
            _chart(titles[number], labels[0], labels[1], []) | {"map": drawn, "legend": legend if number == 0 else ""}
        )
    return charts


def _pack_map(scene: Any, field: Array, parcel: Parcel, name: str) -> tuple[dict[str, Any], list[str]]:
    """Packs a map of values (n_node,) over the initial sheet in a plane; its description, and labels of the axes."""
    places, node, triangles, labels = map_sheet(scene)
    triangles, first = by_first_use(triangles)
    parcel.add_triangles(f"{name}.triangles", triangles)
    parcel.add(f"{name}.points", np.column_stack([places, field[node]])[first])
    described = {"triangles": f"{name}.triangles", "points": f"{name}.points"}
    return described | {"angles": angle_range(places) if len(node) != len(field) else None}, labels


def _same(one: Array | None, other: Array) -> bool:
    return one is not None and np.array_equal(one, other)


def _process(rows: Sequence[dict[str, str]], release: float | None, parcel: Parcel) -> list[Chart]:
    """The process over time: pressure, displacements of tools, and shares of the area in contact with each.

    The time [s] at which the clamp opens is marked where it is within that of the rows.
    """
    time = _column(rows, "time")
    pressures = {name: _column(rows, name) for name in rows[0] if name and name.split("_")[0] == "pressure"}
    largest = max(float(np.nanmax(np.abs(values), initial=0.0)) for values in pressures.values())
    factor, unit = (1e-3, "kPa") if largest >= 1e3 else (1.0, "Pa")
    lines = [
        _line(name.removeprefix("pressure_"), color)
        | _pack(parcel, "process.p" if name == "pressure" else f"process.{name}", time, factor * values)
        for (name, values), color in zip(pressures.items(), itertools.cycle(PRESSURE_COLORS), strict=False)
    ]
    charts = [("Process: pressure", f"pressure [{unit}]", lines)]
    kinds = (
        ("displacement", "Process: displacement of tools", "displacement [mm]", 1e3),
        ("contact", "Process: contact", "area in contact [%]", 100.0),
    )
    colors = _colors_of_tools(rows)
    for kind, title, words, factor in kinds:
        names = [name.removeprefix(f"{kind}_") for name in rows[0] if name and name.startswith(f"{kind}_")]
        series = [
            _line(name, colors[name])
            | _pack(parcel, f"process.{kind}_{name}", time, factor * _column(rows, f"{kind}_{name}"))
            for name in names
        ]
        charts.append((title, words, series))
    marked = [] if release is None or release >= time[-1] else [[release, "the clamp opens"]]
    return [_chart(title, "time [s]", words, series, zero=True) | {"marked": marked} for title, words, series in charts]


def _line(label: str, color: str) -> dict[str, Any]:
    """A line of a diagram of the process, without its points."""
    return {"label": label, "role": "after", "color": color, "dots": False}


def _colors_of_tools(rows: Sequence[dict[str, str]]) -> dict[str, str]:
    """Colours of the mold and the tools by their names, as in the pictures and in all diagrams of the process."""
    # All are in the columns of contact, in their order; a table of other columns has them by their motion.
    kinds = ("contact_", "displacement_")
    names = dict.fromkeys(
        name.removeprefix(kind) for kind in kinds for name in rows[0] if name and name.startswith(kind)
    )
    tools = [name for name in names if name != "mold"]
    return {"mold": MOLD_COLOR, **dict(zip(tools, tool_colors(len(tools)), strict=True))}


def _history(rows: Sequence[dict[str, str]], parcel: Parcel) -> list[Chart]:
    spent = _column(rows, "simulations")
    error, words = 100 * _column(rows, "thickness_rms_error"), "deviation from the target, rms [%]"
    if not np.isfinite(error).any():
        error, words = _column(rows, "objective"), "objective"
    search = [
        {"label": "each simulation", "role": "before", "dots": True, **_pack(parcel, "search.all", spent, error)},
        _good(rows, spent, error, parcel),
    ]
    walls = []
    for role, label, name in (("after", "mean wall", "wall_mean"), ("other", "thinnest wall", "wall_min")):
        points = _pack(parcel, f"search.{name}", spent, 1e3 * _column(rows, name))
        walls.append({"label": label, "role": role, "dots": False, **points})
    cost = "cost in simulations"
    return [
        _chart("History of the search", cost, words, search, log=True),
        _chart("Wall thickness during the search", cost, "wall thickness [mm]", walls, zero=True),
    ]


def _good(rows: Sequence[dict[str, str]], spent: Array, error: Array, parcel: Parcel) -> dict[str, Any]:
    """The simulations that keep all limits, or the best so far where there are none."""
    if "violation" in rows[0]:
        kept = _column(rows, "violation") <= _KEPT
        return {"label": "limits kept", "role": "after", "dots": True} | _pack(
            parcel, "search.kept", spent[kept], error[kept]
        )
    best = np.fmin.accumulate(np.where(error > 0, error, np.nan))
    return {"label": "best so far", "role": "after", "dots": False} | _pack(parcel, "search.best", spent, best)


def _chart(title: str, x: str, y: str, series: list[dict[str, Any]], *, zero: bool = False, log: bool = False) -> Chart:
    return {"title": title, "x": x, "y": y, "series": series, "zero": zero, "log": log}


def _pack(parcel: Parcel, name: str, across: Array, up: Array) -> dict[str, str]:
    """Packs points; returns the names of their arrays."""
    parcel.add(f"chart.{name}", np.stack([across, up], axis=1))
    return {"points": f"chart.{name}"}


def _is_cloud(curve: SectionCurve) -> bool:
    """True if the points of a curve are all nodes, which form no line."""
    return curve.label == "all nodes"


def _visible_points(across: Array, up: Array, dots: bool) -> NDArray[np.int64]:
    """Indices of the points that are drawn: all of a line, and of dots those that can be distinguished."""
    return np.sort(distinguishable_points(across, up)) if dots and len(across) else np.arange(len(across))


def _column(rows: Sequence[dict[str, str]], name: str) -> Array:
    """A column as numbers, NaN where it is empty, infinite or no number."""

    def number(text: str | None) -> float:
        try:
            value = float(text or "nan")
        except ValueError:
            return math.nan
        return value if math.isfinite(value) else math.nan

    return np.array([number(row.get(name)) for row in rows])

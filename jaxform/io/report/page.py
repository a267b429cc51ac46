"""The text and tables of the page, as HTML; scripts of the page add the drawings."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from html import escape
from typing import Any

from jaxform.core.errors import format_coordinate, format_number
from jaxform.io.report.charts import MeasuringPoint
from jaxform.io.report.contents import symmetry_of
from jaxform.io.report.stored_results import Results

_ENERGY = {
    "strain": "strain energy at the end",
    "kinetic": "kinetic energy at the end",
    "damping_loss": "damping",
    "contact_loss": "contact: kinetic energy of nodes at first contact",
    "refinement_loss": "refinement: kinetic energy lost to new nodes",
    "viscous_loss": "viscous dissipation",
    "friction_loss": "friction",
    "tool_work": "work of tools",
    "gravity_work": "work of gravity",
    "pre_stretch_work": "strain energy of the pre-stretched sheet",
}
_WHOLE = {1: "half", 2: "a quarter", 3: "an eighth"}  # of the part is modelled, by the number of symmetry planes
_LEAST = 1e-4  # a share below which only this bound is written
_NOTHING = "\N{EN DASH}"


def number(value: Any, factor: float = 1.0, digits: int = 4) -> str:
    """A number in a few digits; a dash for a missing number."""
    if not isinstance(value, int | float) or isinstance(value, bool):
        return _NOTHING
    return format_number(factor * value + 0.0, digits)


def heading(results: Results) -> str:
    """The name, the status, the numbers that are asked for first, and the warnings."""
    summary = results.summary
    status = str(summary["status"])
    good = status == "ok"
    kind = "search for a design" if results.start is not None or summary.get("design") is not None else "simulation"
    counts = (
        f"{number(summary.get('elements_final'), digits=9)} elements, {number(summary.get('steps'), digits=9)} steps"
    )
    badge = f'<span class="status {"good" if good else "bad"}">{"ok" if good else "problem"}</span>'
    lines = [
        f"<h1>{escape(str(summary['scene']))} {badge}</h1>",
        f'<p class="quiet">{kind}, {counts}, {number(summary.get("time"))} s of process time</p>',
        "" if good else f'<p class="alert" role="alert">{escape(status)}</p>',
        _warnings(summary["warnings"]),
        f'<div class="tiles">{"".join(_tiles(results))}</div>',
    ]
    return "\n".join(line for line in lines if line)


def _warnings(warned: Sequence[str]) -> str:
    if not warned:
        return ""
    items = "".join(f"<li>{escape(str(words))}</li>" for words in warned)
    title = "1 warning" if len(warned) == 1 else f"{len(warned)} warnings"
    return f'<section class="warnings" aria-label="warnings"><h2>{title}</h2><ul>{items}</ul></section>'


def _tiles(results: Results) -> Iterable[str]:
    summary = results.summary
    wall = summary["thickness"]
    first = summary["design"]["before"] if results.start is not None else {}
    yield _tile("thinnest wall", number(wall["min"], 1e3), "mm", first.get("wall_min"), 1e3)
    yield _tile("mean wall", number(wall["mean"], 1e3), "mm", first.get("wall_mean"), 1e3)
    yield _tile("coefficient of variation", number(wall["cv"], 100, 3), "%", first.get("wall_cv"), 100)
    yield _tile("mass", number(_whole_mass(results), 1e3), "g", _times(first.get("mass"), results), 1e3)
    if results.mold is not None or results.tools:
        yield _tile(f"in contact with {_tool_words(results)}", number(summary["contact_fraction"], 100, 3), "%")
    yield _tile("energy balance error", _small(summary["energy"].get("balance_error")), "%")


def _tool_words(results: Results) -> str:
    if results.mold is None:
        return "tools"
    return "mold and tools" if results.tools else "the mold"


def _tile(label: str, value: str, unit: str, before: Any = None, factor: float = 1.0) -> str:
    was = "" if before is None else f'<span class="was">start {number(before, factor, 3)}</span>'
    return (
        f'<div class="tile"><span class="label">{label}</span><span class="value">{value} <small>{unit}</small></span>'
        f"{was}</div>"
    )


def _thin_wall(thin: Mapping[str, Any], wall: str, ratio: str) -> str:
    """A thinnest wall, and its share of the initial thickness where the summary knows it."""
    share = f", {number(thin[ratio], 100, 3)} % of the initial thickness" if thin.get(ratio) is not None else ""
    return f"{number(thin[wall], 1e3)} mm{share}"


def _recovered_rows(thin: Mapping[str, Any]) -> list[tuple[str, str]]:
    """The rows of the thinnest recovered wall; none of a summary that does not know it."""
    if thin.get("recovered") is None:
        return []
    around = "around its ring" if thin.get("scatter_of") == "ring" else "among the elements there"
    return [
        ("thinnest wall, recovered from the elements", _thin_wall(thin, "recovered", "recovered_ratio")),
        ("&emsp;position in the part", _place(thin.get("recovered_place") or [])),
        (f"&emsp;scatter {around}", f"{number(thin.get('scatter'), 100, 2)} %"),
    ]


def quality(results: Results) -> str:
    """The table of the key figures of a part."""
    summary = results.summary
    wall, thin = summary["thickness"], summary["thinnest"]
    planes = len(symmetry_of(results))
    mass = f"{number(_whole_mass(results), 1e3)} g"
    if planes:
        mass += f" ({_WHOLE[planes]} of it is modelled: {number(summary['mass'], 1e3)} g)"
    rows = [
        ("thinnest element", _thin_wall(thin, "thickness", "ratio")),
        ("&emsp;position in the part", _place(thin["formed"])),
        ("&emsp;position in the initial sheet", _place(thin["initial"])),
        *_recovered_rows(thin),
        ("mean wall, weighted by formed area", f"{number(wall['mean'], 1e3)} mm"),
        ("coefficient of variation", f"{number(wall['cv'], 100)} %"),
        ("thickest wall", f"{number(wall['max'], 1e3)} mm"),
        ("mass", mass),
    ]
    if summary.get("sheet_mass") is not None:
        whole = 2**planes * summary["sheet_mass"]
        rows.append(("&emsp;of the whole sheet", f"{number(whole, 1e3)} g"))
    if results.mold is not None or results.tools:
        rows.append(
            (
                f"share of the formed area in contact with {_tool_words(results)}",
                f"{number(summary['contact_fraction'], 100)} %",
            )
        )
    if summary.get("penetration_max"):
        where = _place(summary.get("penetration_place") or [])
        rows.append(
            (
                "largest penetration of an element into the mold",
                f"{number(summary['penetration_max'], 1e3, 3)} mm, at {where}",
            )
        )
    if summary.get("gap_max"):
        where = _place(summary.get("gap_place") or [])
        rows.append(("largest gap to the mold", f"{number(summary['gap_max'], 1e3, 3)} mm, at {where}"))
    body = "".join(f'<tr><th scope="row">{name}</th><td>{value}</td></tr>' for name, value in rows)
    return f"<h2>The part</h2><table>{body}</table>"


def tools(results: Results) -> str:
    """The table of mold and tools; nothing where there are no tools besides a mold that rests."""
    figures = results.summary.get("tools", [])
    if len(figures) < 2 and results.motion is None and not results.tools:
        return ""
    rows = "".join(
        f'<tr><th scope="row">{escape(str(tool["name"]))}</th>'
        + "".join(f"<td class=number>{value}</td>" for value in _tool_values(tool))
        + "</tr>"
        for tool in figures
    )
    words = (
        "",
        "contact at the end [%]",
        "at most [%]",
        "from&ndash;to [s]",
        "wall there, least / mean [mm]",
        "work [J]",
        "friction [J]",
        "penetration [mm]",
    )
    head = "".join(f'<th scope="col">{text}</th>' for text in words)
    return (
        f"<h2>Mold and tools</h2><table><thead><tr>{head}</tr></thead><tbody>{rows}</tbody></table>"
        '<p class="quiet">Contact as a share of the formed area; energies of the modelled part, a dash where they are '
        "known only of all tools together.</p>"
    )


def _tool_values(tool: Mapping[str, Any]) -> Iterable[str]:
    """The values of a row of the table of tools, in the order of its head."""
    wall = tool.get("thickness") or {}
    yield number(tool.get("contact_fraction"), 100, 3)
    yield number(tool.get("contact_fraction_max"), 100, 3)
    yield "&ndash;".join(number(time, digits=3) for time in tool.get("contact_period") or []) or _NOTHING
    yield f"{number(wall.get('min'), 1e3, 3)} / {number(wall.get('mean'), 1e3, 3)}" if wall else _NOTHING
    yield number(tool.get("work"), digits=3)
    yield number(tool.get("friction_loss"), digits=3)
    yield number(tool.get("penetration_max"), 1e3, 2)


def to_measure(points: Sequence[MeasuringPoint]) -> str:
    """The table of places to measure on a first part, which can be shown in the view, and how they were chosen."""
    rows = "".join(
        f'<tr><td><button class="mark" data-point="{index}" aria-label="show the {point.name} place">{index + 1}'
        f"</button></td><td>{point.name}</td><td class=number>{number(point.thickness, 1e3)}</td>"
        f"<td>{_place(point.formed, '')}</td><td>{_place(point.initial, '')}</td></tr>"
        for index, point in enumerate(points)
    )
    words = ("", "place", "wall [mm]", "in the part, x y z [mm]", "in the sheet, x y z [mm]")
    head = "".join(f'<th scope="col">{text}</th>' for text in words)
    chosen = "".join(f"<li>{escape(point.chosen)}</li>" for point in points)
    return (
        f"<h2>Where to measure the first part</h2><table><thead><tr>{head}</tr></thead><tbody>{rows}</tbody></table>"
        f'<p class="quiet">How they were chosen:</p><ol class="quiet">{chosen}</ol>'
    )


def energy(summary: Mapping[str, Any]) -> str:
    """The energy balance with a bar for each term, and its error."""
    account = summary["energy"]
    works = [
        account.get("external_work"),
        *(account.get(name, 0.0) for name in ("tool_work", "gravity_work", "pre_stretch_work")),
    ]
    total = abs(sum(work for work in works if isinstance(work, int | float)))
    terms = [("work of the pressure", works[0])]
    terms += [(words, account[key]) for key, words in _ENERGY.items() if account.get(key)]
    rows = "".join(_energy_row(words, value, total) for words, value in terms)
    missed, slow = _small(account.get("balance_error")), _small(account.get("quasi_static_error"))
    note = (
        f"The energy balance error is {missed} % of the work. The wall deviates by about {slow} % "
        "from that of the quasi-static process."
    )
    head = '<tr><th scope="col">term</th><th scope="col">energy [J]</th><th scope="col">share of the work</th></tr>'
    return (
        f"<h2>Energy balance</h2><table class=energy><thead>{head}</thead><tbody>{rows}</tbody></table>"
        f'<p class="quiet">{note} Energies are those of the modelled part.</p>'
    )


def _energy_row(words: str, value: Any, total: float) -> str:
    share = abs(value) / total if isinstance(value, int | float) and total else None
    width = 100 * min(share or 0.0, 1.0)
    signed = -share if share and share >= _LEAST and value < 0.0 else share
    bar = f'<span class="bar"><i style="width:{width:.3g}%"></i></span>{_small(signed)} %'
    return f'<tr><th scope="row">{words}</th><td class=number>{number(value)}</td><td>{bar}</td></tr>'


def design(summary: Mapping[str, Any]) -> str:
    """The table of a design before and after the search; nothing for a simulation."""
    found = summary.get("design")
    if not found:
        return ""
    first, best = found["before"], found["after"]
    rows = (
        ("deviation from the target, rms [%]", "thickness_rms_error", 100),
        ("objective", "objective", 1),
        ("thinnest wall [mm]", "wall_min", 1e3),
        ("mean wall [mm]", "wall_mean", 1e3),
        ("coefficient of variation [%]", "wall_cv", 100),
        ("mass [g], of the modelled part", "mass", 1e3),
    )
    body = "".join(
        f'<tr><th scope="row">{words}</th><td class=number>{number(first.get(key), factor)}</td>'
        f"<td class=number>{number(best.get(key), factor)}</td></tr>"
        for words, key, factor in rows
        if first.get(key) is not None or best.get(key) is not None
    )
    head = '<tr><th scope="col"></th><th scope="col">start</th><th scope="col">best design</th></tr>'
    cost = f"{number(found.get('evaluations'))} simulations with and without gradient, the time of "
    cost += (
        f"{number(found.get('simulations'), digits=3)} simulations; stopped by {escape(str(found.get('stopped_by')))}"
    )
    return (
        f"<h2>The search</h2><table><thead>{head}</thead><tbody>{body}</tbody></table>"
        f'<p class="quiet">{cost}: {escape(str(found.get("message")))}.</p>'
    )


def scene(results: Results) -> str:
    """The text of the scene file; nothing where there is none."""
    if results.scene is None:
        return ""
    name, text = results.scene
    return f"<details class=card><summary>The scene: {escape(name)}</summary><pre>{escape(text)}</pre></details>"


def _small(share: Any) -> str:
    """A share in per cent; below a hundredth of one, only that bound."""
    return "&lt; 0.01" if isinstance(share, int | float) and 0 <= share < _LEAST else number(share, 100, 3)


def _place(point: Sequence[Any], unit: str = " mm") -> str:
    """A place given in [m], in mm."""
    if len(point) != 3 or None in point:
        return _NOTHING
    return f"{', '.join(format_coordinate(x, 1e3) for x in point)}{unit}"


def _whole_mass(results: Results) -> float | None:
    return _times(results.summary["mass"], results)


def _times(mass: Any, results: Results) -> float | None:
    """Mass of the whole part, from that of the modelled part; None where it is no number."""
    return mass * 2 ** len(symmetry_of(results)) if isinstance(mass, int | float) else None

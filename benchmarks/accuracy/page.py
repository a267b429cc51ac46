"""The page docs/accuracy.md and its pictures, drawn from what `benchmarks.accuracy` found; no number stands here."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np

from benchmarks.pages import Found, days, save
from jaxform.results.summary import QUASI_STATIC_LIMIT


def write(found: Found, folder: Path) -> None:
    """Writes accuracy.md, and the pictures of what was found."""
    text = [_HEAD, days(found)]
    text += [section(found[name]["found"], folder) for name, section in _SECTIONS.items() if name in found]
    spent = ", ".join(f"{name} {found[name]['seconds']:.0f} s" for name in _SECTIONS if name in found)
    text.append(f"\nTaken on one core, compiling included: {spent}.\n")
    (folder / "accuracy.md").write_text("\n".join(text), encoding="utf-8")


_HEAD = """# Accuracy, and what an error costs

`make validate` makes this page and its pictures from docs/accuracy.json, which it writes; parts of it by name:
`.venv/bin/python -m benchmarks.accuracy cases`. Errors are relative, in per cent; *order* is that in the element size,
from each mesh to the next; *time* is that of one run on the finest mesh, after compiling, on one core.
"""


# --- Cases ------------------------------------------------------------------------------------------------------------


def _cases(found: Found, folder: Path) -> str:
    _draw_cases(found, folder / "convergence.png")
    lines = [
        "## Against exact and independent solutions\n",
        "Discs, spheres, cups and the cone are compared with solutions of the equations along the meridian; the square "
        "and the rectangle with polynomials of high degree that make the energy stationary "
        "(benchmarks/accuracy/membranes.py). Thickness is compared by the root of the mean square over the material. "
        "The wall of a cup is compared with the exact one at the pressure reached (benchmarks/accuracy/cups.py), with "
        "nothing left out: the corner is open there, and the wall is thinnest beside it.\n",
        "![Error over element size](convergence.png)\n",
    ]
    for name, case in found.items():
        counts = " | ".join(f"{count} elements" for count in case["elements"])
        lines += [
            f"**{name[0].upper()}{name[1:]}**. {case['what']} Time: {case['seconds'][-1]:.2g} s.\n",
            f"| | {counts} | order |",
            f"|---|{'---|' * len(case['elements'])}---|",
        ]
        for quantity, errors in case["errors"].items():
            shown = " | ".join(_format_signed(error, quantity) for error in errors)
            lines.append(f"| {quantity} | {shown} | {', '.join(_order(value) for value in case['order'][quantity])} |")
        lines.append("")
    return "\n".join([*lines, _orders(found)])


def _format_signed(error: float, quantity: str) -> str:
    return f"{100 * error:.2g} %" if "thickness" in quantity and "pole" not in quantity else f"{100 * error:+.2g} %"


def _order(value: float) -> str:
    return f"{value:.1f}"


def _orders(found: Found) -> str:
    """Orders of the nodal thickness by the two finest meshes: where it is the second, and where not."""
    inside = [
        orders[-1] for case in found.values() for name, orders in case["order"].items() if name.endswith("inside")
    ]
    rim = {
        case_name: errors[-1]
        for case_name, case in found.items()
        for name, errors in case["errors"].items()
        if name.endswith("rim")
    }
    if not (inside and rim):
        return ""
    rims = ", ".join(f"{name} {100 * error:.2g} %" for name, error in rim.items())
    return (
        f"Inside the free disc the nodal thickness converges with order {max(inside):.1f}, although the thickness of "
        "each triangle is constant: the errors of neighbours cancel in the linear function that fits the elements of a "
        "node best. On a clamped rim they do not cancel; there the functions of the nodes inside are extrapolated. "
        f"Errors on the rim alone, with the finest meshes: {rims}. The wall of a cup has a kink at its corner: across "
        "it no uniform mesh is of second order.\n"
    )


def _draw_cases(found: Found, path: Path) -> None:
    figure, axes = plt.subplots(figsize=(7.6, 4.8), layout="constrained")
    for mark, (name, case) in zip("os^vDP*Xh", found.items(), strict=False):
        quantity = _main(case)
        size = np.sqrt(1 / np.array(case["elements"]))
        axes.plot(size, 100 * np.abs(case["errors"][quantity]), f"{mark}-", label=f"{name}: {_short(quantity)}")
    size = np.array([0.02, 0.16])
    axes.plot(size, 60 * size**2, "k--", linewidth=1, label="second order")
    axes.set(xscale="log", yscale="log", xlabel="element size over sheet (1 / root of elements)", ylabel="error [%]")
    axes.set_xticks([0.02, 0.03, 0.05, 0.1, 0.15], ["0.02", "0.03", "0.05", "0.1", "0.15"])
    axes.set_xticks([], minor=True)
    axes.grid(alpha=0.3, which="both")
    axes.legend(frameon=False, fontsize=8, loc="center left", bbox_to_anchor=(1, 0.5))
    save(figure, path)


def _main(case: Found) -> str:
    """The quantity that stands for a case: nodal thickness where there is one, else the first."""
    names = list(case["errors"])
    return next((name for name in names if name.endswith("nodal thickness")), names[0])


def _short(quantity: str) -> str:
    return quantity.split(": ")[-1]


# --- Kinds of meshes --------------------------------------------------------------------------------------------------

_CUPS = {"cup": "cup, depth 0.8 radii", "deep": "the dish's cup, depth 1.2 radii"}
_KINDS = {"uniform": "oC0", "refined in flight": "sC1", "adapted, all its runs": "^C2"}


def _meshes(found: Found, folder: Path) -> str:
    _draw_meshes(found, folder / "meshes.png")
    lines = [
        "## What an error costs: uniform, refined, adapted\n",
        "Cups of 80 degrees, against the exact wall at the pressure reached, nothing cut: rms at the nodes by initial "
        "area, over the CPU time of whole runs on one core after compiling. Each run's is the least of five, in rounds "
        "through all runs, and of this process alone: two measurements on a busy machine (30 November 2026) agreed to "
        "7 %. An adapted run's time is that of three runs and of the meshing between them; later runs on its mesh cost "
        "the last of these alone. Measured before the last mesh's nodes moved for the wall and sizes followed the "
        "error more, which changed these errors by -6 to +8 % ([refinement](explanation/refinement.md)). Refined in "
        "flight: the table of `dish-refined`, to fewer or as many levels.\n",
        "![Error over CPU time on three kinds of mesh](meshes.png)\n",
        "| | | elements | error | CPU time | elements times steps |",
        "|---|---|---|---|---|---|",
    ]
    for name, rows in found.items():
        for row in rows:
            cells = [_CUPS[name], row["kind"], str(row["elements"]), f"{100 * row['error']:.2f} %"]
            cells += [f"{row['seconds']:.2g} s", f"{row['element_steps'] / 1e6:.3g} million"]
            lines.append("| " + " | ".join(cells) + " |")
    return "\n".join([*lines, "", *(_gain(name, rows) for name, rows in found.items())])


def _gain(name: str, rows: list[Found]) -> str:
    """Ratio of the times of the adapted run of some 2500 elements and of a uniform one as accurate."""
    adapted = [row for row in rows if row["kind"].startswith("adapted")]
    chosen = min(adapted, key=lambda row: abs(row["elements"] - 2500))
    share = chosen["seconds"] / _cost_of_uniform(rows, chosen["error"])
    return (
        f"With {chosen['elements']} adapted elements ({_CUPS[name]}) the error is {100 * chosen['error']:.2f} %, in "
        f"{share:.2f} of the CPU time of a uniform mesh as accurate, by the power law through its three finest.\n"
    )


def _cost_of_uniform(rows: list[Found], error: float) -> float:
    """CPU time [s] of a uniform mesh with an error, by a power law through the three finest."""
    fine = [row for row in rows if row["kind"] == "uniform"][-3:]
    slope, foot = np.polyfit(np.log([row["error"] for row in fine]), np.log([row["seconds"] for row in fine]), 1)
    return float(np.exp(foot + slope * np.log(error)))


def _draw_meshes(found: Found, path: Path) -> None:
    figure, panels = plt.subplots(
        1, len(found), figsize=(5.4 * len(found), 4.4), layout="constrained", squeeze=False, sharey=True
    )
    for axes, (name, rows) in zip(panels[0], found.items(), strict=True):
        for kind, (mark, *color) in _KINDS.items():
            own = [row for row in rows if row["kind"] == kind]
            time, error = ([row[key] for row in own] for key in ("seconds", "error"))
            axes.plot(time, 100 * np.array(error), f"{mark}-", color="".join(color), label=kind, markersize=6)
            for row in own:
                place = row["seconds"], 100 * row["error"]
                axes.annotate(str(row["elements"]), place, (4, 5), textcoords="offset points", fontsize=7)
        axes.set(xscale="log", yscale="log", title=_CUPS[name], xlabel="CPU time, one core [s]")
        axes.set_yticks([0.1, 0.2, 0.5, 1, 2, 5], ["0.1", "0.2", "0.5", "1", "2", "5"])
        axes.set_yticks([], minor=True)
        low, high = axes.get_xlim()
        ticks = [tick for tick in (0.02, 0.05, 0.1, 0.2, 0.5, 1, 2, 5, 10, 20, 50) if low <= tick <= high]
        axes.set_xticks(ticks, [f"{tick:g}" for tick in ticks])
        axes.set_xticks([], minor=True)
        axes.grid(alpha=0.3)
    panels[0][0].set_ylabel("error of the wall at the nodes, rms [%]")
    panels[0][-1].legend(frameon=False, fontsize=9, title="numbers: elements at the end", title_fontsize=8)
    save(figure, path)


# --- Error against time -----------------------------------------------------------------------------------------------


def _precision(name: str, words: str) -> Any:
    def section(rows: list[Found], folder: Path) -> str:
        picture = f"precision-{name}.png"
        _draw_precision(rows, folder / picture)
        lines = [
            f"## What an error costs: {name}\n",
            f"{words} The default is in bold; the others change one thing of it.\n",
            f"![Error over time, {name}]({picture})\n",
            "| | | elements | steps | error | time | quasi-static error | mass added |",
            "|---|---|---|---|---|---|---|---|",
        ]
        for row in rows:
            cells = [row["group"], row["label"], row["elements"], row["steps"], f"{row['error']:.2f} %"]
            cells += [
                f"{row['seconds']:.3f} s",
                f"{100 * row['quasi_static_error']:.2g} %",
                f"{100 * row['added_mass']:.0f} %",
            ]
            if row["status"] != "ok":
                cells[4] = "stopped"
            lines.append("| " + " | ".join(f"**{c}**" if row["default"] else str(c) for c in cells) + " |")
        return "\n".join([*lines, "", *_front(rows)])

    return section


# The reasons why runs that are as good and faster are no default.
_WHY_NOT = {
    "mass scaling": "mass that is added is felt where a process is fast",
    "float32": "gradients in float32 are coarse",
}


def _front(rows: list[Found]) -> list[str]:
    """Runs that are both faster and better than the default one, and runs that are faster and as good."""
    good = [row for row in rows if row["status"] == "ok"]
    default = next((row for row in good if row["default"]), None)
    if default is None:
        return []
    better = [r for r in good if r["error"] < 0.98 * default["error"] and r["seconds"] < 0.98 * default["seconds"]]
    alike = [
        r
        for r in good
        if r not in better and r["error"] < 1.02 * default["error"] and r["seconds"] < 0.9 * default["seconds"]
    ]

    def describe_runs(runs: list[Found]) -> str:
        return "; ".join(
            f"{r['group']} {r['label']} ({r['error']:.2f} %, {r['seconds'] / default['seconds']:.2f} of the time)"
            for r in runs
        )

    lines = ["No run of these is both faster and more accurate than the default.\n"]
    if better:
        lines = [
            f"Faster and more accurate than the default, by more than two per cent in both: {describe_runs(better)}.\n"
        ]
    if alike:
        reasons = [_WHY_NOT[group] for group in dict.fromkeys(r["group"] for r in alike) if group in _WHY_NOT]
        lines.append(
            f"As accurate to two per cent, and more than a tenth faster: {describe_runs(alike)}."
            + (f" No defaults, since {' and '.join(reasons)}." if reasons else "")
            + "\n"
        )
    return lines


_MARKS = {
    "uniform": "o",
    "refined": "s",
    "mass scaling": "P",
    "float32": "X",
    "safety": "v",
    "ramp": "D",
    "damping": "^",
}


def _draw_precision(rows: list[Found], path: Path) -> None:
    figure, axes = plt.subplots(figsize=(7.4, 4.6), layout="constrained")
    good = [row for row in rows if row["status"] == "ok"]
    for group, style in _MARKS.items():
        points = [(row["seconds"], row["error"]) for row in good if row["group"] == group]
        if points:
            axes.plot(*zip(*points, strict=True), style, label=group, markersize=7, alpha=0.85)
    default = [(row["seconds"], row["error"]) for row in good if row["default"]]
    if default:
        axes.plot(*default[0], "o", markersize=17, fillstyle="none", color="k", markeredgewidth=1.6, label="default")
    axes.set(xscale="log", yscale="log", xlabel="time of a run [s]", ylabel="error of the wall, rms [%]")
    _plain_ticks(axes.yaxis, [row["error"] for row in good])
    _plain_ticks(axes.xaxis, [row["seconds"] for row in good])
    axes.grid(alpha=0.3, which="both")
    axes.legend(frameon=False, fontsize=9, loc="center left", bbox_to_anchor=(1, 0.5))
    save(figure, path)


def _plain_ticks(axis: Any, values: list[float]) -> None:
    """Ticks at 1, 2 and 5 times powers of ten, without exponents."""
    ticks = [k * 10.0**power for power in range(-4, 4) for k in (1, 2, 5)]
    inside = [tick for tick in ticks if 0.6 * min(values) < tick < 1.7 * max(values)]
    axis.set_ticks(inside, [f"{tick:g}" for tick in inside])
    axis.set_ticks([], minor=True)


# --- How slow is slow enough ------------------------------------------------------------------------------------------


def _slow(found: Found, folder: Path) -> str:
    _draw_quasi_static_error(found, folder / "quasi-static-error.png")
    _draw_ramps(found, folder / "ramps.png")
    rows = [row for part in found.values() for row in part["rows"] if row["status"] == 0 and row["error"] > 0]
    seen = [row for row in rows if 5e-4 < row["error"] < 0.3]
    ratio = np.array([row["quasi_static_error"] / row["error"] for row in seen])
    seen_by = {name: [row for row in part["rows"] if row in seen] for name, part in found.items()}
    low, middle, high = np.percentile(ratio, [5, 50, 95])
    off = [row for row in rows if row["error"] > 2 * QUASI_STATIC_LIMIT]
    fine = [row for row in rows if row["error"] < 0.5 * QUASI_STATIC_LIMIT]
    lines = [
        "## How slow is slow enough\n",
        "In a slow process the wall depends on neither pressure nor stiffness. The picture shows its deviation from "
        "the wall of a slow process, on the same mesh, over the time of the ramp. A ramp by the cube of time needs a "
        "fraction of the time of a linear one, and too little damping costs as much as too much of it.\n",
        "![Deviation over ramp time](ramps.png)\n",
        "A run predicts it: `energy.quasi_static_error` in summary.json"
        " is the largest kinetic energy at the end of a window, over "
        "the work done, plus a fifth of the square of the share of the work that damping took. "
        f"Over {len(seen)} runs that are off by 0.05 to 30 %, the prediction is {middle:.1f} times the "
        f"deviation (median), and {low:.2f} to {high:.1f} times in 90 % of them.\n",
        "![Predicted and true deviation](quasi-static-error.png)\n",
        f"Medians by scene: {_middles(seen_by)}. For a shallow part the prediction is too high.\n"
        if len(seen_by) > 2
        else "",
        f"With `quasi_static = true` in [solver] a run that predicts more than {100 * QUASI_STATIC_LIMIT:.2g} % says "
        f"so, with what to do. Of the {len(off)} runs that are off by more than {200 * QUASI_STATIC_LIMIT:.2g} % it "
        f"warns of {_warning_count(off)}, and of {_warning_count(fine)} of the {len(fine)} that are off by less than "
        f"{50 * QUASI_STATIC_LIMIT:.2g} %. The kinetic energy that "
        "is left at the end, or with which the sheet hits the mold, predicts worse: "
        f"the latter is off by a factor of {_spread(seen, 'hit'):.0f} either way in 90 % of them, the peak alone by "
        f"{_spread(seen, 'kinetic'):.1f}, the sum above by {_spread(seen, 'quasi_static_error'):.1f}.\n",
        "With the damping of the built-in scenes:\n",
        "| | ramp [s] | damping [1/s] | deviation | predicted | kinetic peak | damped | hit |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for name, part in found.items():
        for row in part["rows"]:
            if row["damping"] == 1.0:
                cells = [f"{name}, {row['kind']}", f"{row['ramp']:g}", f"{row['damping'] * part['damping']:g}"]
                cells += [_percent(row[key]) for key in ("error", "quasi_static_error", "kinetic", "damped", "hit")]
                lines.append("| " + " | ".join(cells) + " |")
    return "\n".join([*lines, ""])


def _middles(rows: dict[str, list[Found]]) -> str:
    """The median of predicted over true deviation, by scene."""
    return ", ".join(
        f"{name} {np.median([row['quasi_static_error'] / row['error'] for row in own]):.2g}"
        for name, own in rows.items()
    )


def _warning_count(rows: list[Found]) -> int:
    return sum(row["quasi_static_error"] > QUASI_STATIC_LIMIT for row in rows)


def _spread(rows: list[Found], key: str) -> float:
    """The factor about their median within which 90 % of the ratios to the true deviation lie."""
    ratio = np.log([max(row[key], 1e-12) / row["error"] for row in rows])
    low, high = np.percentile(ratio, [5, 95])
    return float(np.exp(0.5 * (high - low)))


def _draw_quasi_static_error(found: Found, path: Path) -> None:
    figure, axes = plt.subplots(figsize=(6.4, 4.8), layout="constrained")
    for mark, (name, part) in zip("os^", found.items(), strict=False):
        for kind, color in (("cubic-ramp", "C0"), ("linear", "C1")):
            rows = [row for row in part["rows"] if row["kind"] == kind and row["error"] > 0 and row["status"] == 0]
            points = [(100 * row["quasi_static_error"], 100 * row["error"]) for row in rows]
            axes.plot(*zip(*points, strict=True), mark, color=color, alpha=0.7, label=f"{name}, {kind}", markersize=6)
    line = np.array([0.01, 100.0])
    axes.plot(line, line, "k-", linewidth=1)
    axes.fill_between(line, line / 3, 3 * line, color="k", alpha=0.07, linewidth=0, label="within a factor of 3")
    axes.axvline(100 * QUASI_STATIC_LIMIT, color="C3", linestyle="--", linewidth=1.2, label="warned of from here")
    axes.set(xscale="log", yscale="log", xlim=(0.01, 100), ylim=(0.01, 300))
    axes.set(xlabel="predicted by the energies [%]", ylabel="deviation from the slow wall, rms [%]")
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_ticks([0.01, 0.1, 1, 10, 100], ["0.01", "0.1", "1", "10", "100"])
    axes.grid(alpha=0.3)
    axes.legend(frameon=False, fontsize=8)
    save(figure, path)


def _draw_ramps(found: Found, path: Path) -> None:
    figure, rooms = plt.subplots(1, len(found), figsize=(5.2 * len(found), 4.2), layout="constrained", squeeze=False)
    for axes, (name, part) in zip(rooms[0], found.items(), strict=True):
        for kind, line in (("cubic-ramp", "-"), ("linear", "--")):
            for color, share in (("C2", 0.1), ("C0", 1.0), ("C3", 10.0)):
                rows = [row for row in part["rows"] if row["kind"] == kind and row["damping"] == share]
                if rows:
                    points = [(row["ramp"], 100 * row["error"]) for row in rows]
                    label = f"{kind}, {share * part['damping']:g} / s"
                    axes.plot(*zip(*points, strict=True), f"o{line}", color=color, label=label, markersize=4)
        ramps = sorted({row["ramp"] for row in part["rows"]})
        axes.set(xscale="log", yscale="log", title=name, xlabel="time of the ramp [s]")
        axes.set_ylabel("deviation from the slow wall, rms [%]")
        axes.set_xticks(ramps, [f"{ramp:g}" for ramp in ramps])
        axes.set_xticks([], minor=True)
        axes.grid(alpha=0.3)
        axes.legend(frameon=False, fontsize=8)
    save(figure, path)


# --- Gradient ---------------------------------------------------------------------------------------------------------


def _gradient(found: Found, _: Path) -> str:
    best = np.min(found["table"], axis=1)
    sizes = " | ".join(f"{size:.0e}" for size in found["sizes"])
    lines = [
        "## The gradient\n",
        f"Of the objective of `{found['study']}` through the whole run, contact included, against central differences: "
        f"the relative difference is at most {best.max():.0e} over {best.size} knots, each at the best of these "
        "perturbations; larger ones reorder the landing of nodes, smaller ones drown in rounding.\n",
        f"| knot | {sizes} |",
        f"|---|{'---|' * len(found['sizes'])}",
    ]
    lines += [f"| {k} | " + " | ".join(f"{value:.0e}" for value in row) + " |" for k, row in enumerate(found["table"])]
    return "\n".join([*lines, ""])


def _percent(value: float) -> str:
    return f"{100 * value:.2g} %" if abs(value) < 0.1 else f"{100 * value:.0f} %"


_SECTIONS = {
    "cases": _cases,
    "meshes": _meshes,
    "dish": _precision(
        "dish",
        "Against the exact cup, rms over the material of the elements' thickness, the last of the corner left out; the "
        "pressure is that of `dish-refined`, which fills the corner so far.",
    ),
    "box": _precision(
        "box",
        "The box with insert at 20 kPa, rms over the initial sheet against a fine uniform mesh of this simulator, "
        "so that only what depends on the mesh is seen to the full.",
    ),
    "slow": _slow,
    "gradient": _gradient,
}

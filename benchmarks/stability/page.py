"""The page docs/stability.md and its pictures, drawn from what `benchmarks.stability` found; no number stands here."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np

from benchmarks.pages import Found, days, save
from jaxform.sheet.state import Status

_LEAVES = {"parison.thickness": "thickness", "pressure.value": "pressure"}
_SHOWN = 12  # seeds of a class


def write(found: Found, folder: Path) -> None:
    """Writes stability.md, and the pictures of those parts that there are."""
    text = [_HEAD, days(found)]
    for name, section in _SECTIONS.items():
        if found.get(name):
            text.append(section(found[name], folder))
    (folder / "stability.md").write_text("\n".join(text), encoding="utf-8")


_HEAD = """# Robustness

Written by `make stability` from docs/stability.json; change neither by hand.
"""


def _edge(found: Found, folder: Path) -> str:
    rows = found["rows"]
    begin, end = (np.concatenate([row[name] for row in rows]) for name in ("begin", "end"))
    lower = np.maximum(begin, end / found["safety"])
    lines = [
        "## The edge of stability\n",
        "The true limit is that of the assembled tangent, pressure included, from all its eigenvalues. *At the start* "
        "is the step taken over the true limit times the solver's safety, as it was when the window began; *at the "
        "end* is the step over the true limit itself, without safety, as it had become when the window ended: above 1 "
        "the window ran unstably for a while. *Retried* windows were repeated with half the step. The last "
        "steps, which divide the rest of the time, are left out.\n",
        "| sheet | material | pressure [c h/a] | thickness between neighbours | stretch up to | windows | at the start "
        "| at the end | retried |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    for row in rows:
        sudden = ", sudden" if row["sudden"] else ""
        lines.append(
            f"| {row['sheet']} | {row['law']} | {row['pressure']:g}{sudden} | 1:{row['ratio']:g} "
            f"| {row['stretch']:.2f} | {len(row['begin'])} | {_range(row['begin'])} | {_range(row['end'])} "
            f"| {row['vain']} |"
        )
    why = ": another mode has become the highest, which the search has not found yet; the safety covers that"
    missed = why if begin.max() > 1 else ""
    lines += [
        "",
        f"At the start {_share(begin > 1)} of the windows are above 1, the largest is {begin.max():.3f}{missed}. "
        f"{_share(begin < 0.9)} are below 0.9, most of them since the sheet is about to stiffen: over the lower of the "
        f"limits at begin and end, times the safety, {_share(lower < 0.9)} of the steps are below 0.9. "
        f"{_share(end > 1)} of the windows end above the true limit, the worst at {end.max():.3f}: a sheet that snaps "
        "through stiffens within one window. The energy balance detects this at the window's end, "
        "and the window is retried.\n",
        "Observed: an inflated sheet, at rest, is stepped at factors of its true limit until it leaves its shape.\n",
        "| sheet | material | stays at | leaves at |",
        "|---|---|---|---|",
    ]
    for row in found["observed"]:
        below = max((factor for factor in found["factors"] if not factor >= row["factor"]), default=float("nan"))
        lines.append(f"| {row['sheet']} | {row['law']} | {below:g} | {row['factor']:g} |")
    figure, axes = plt.subplots(figsize=(7, 3.6), layout="constrained")
    bins = np.linspace(0.6, 1.15, 45).tolist()
    axes.hist(np.clip(begin, 0.6, 1.15), bins, alpha=0.7, label="at the start, relative to limit times safety")
    axes.hist(np.clip(end, 0.6, 1.15), bins, alpha=0.5, label="at the end, relative to the limit")
    axes.axvline(1.0, color="black", linewidth=1)
    axes.set(xlabel="step, relative to the limit", ylabel="windows")
    _save(figure, axes, folder / "stability-edge.png")
    return "\n".join([*lines, "\n![Steps over the limit](stability-edge.png)\n"])


def _drift(found: Found, folder: Path) -> str:
    figure, axes = plt.subplots(figsize=(7, 3.6), layout="constrained")
    lines = [
        "## Energy over many steps\n",
        "Discs and spheres oscillate without damping under a sudden pressure, at the default safety. Discs swing "
        "through their plane, and after a while the energy is shared by all modes. *Missing* is strain and kinetic "
        "energy less the work done, over the largest work. *Swing* is the largest less the least of all values. "
        "Without damping the step is 0.45 of that with damping, and never increases, since nearer the limit the fast "
        "modes of a nonlinear sheet gain energy at any constant step: the disc of the first row at 0.8, 0.7 and 0.6 of "
        "the limit of the flat sheet bursts within 2000, 14 000 and 160 000 steps.\n",
        "| | elements | stretch up to | steps | ended as | swing | mean of the first tenth | of the last | drift |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    for name, part in found.items():
        steps, missed = np.array(part["rows"]).T
        tenth = max(1, len(missed) // 10)
        first, last = missed[:tenth].mean(), missed[-tenth:].mean()
        lines.append(
            f"| {name} | {part['elements']} | {part['stretch']:.2f} | {part['steps']} "
            f"| {_endings_table(part['status'])} | {np.ptp(missed):.1e} | {first:.1e} | {last:.1e} "
            f"| {last - first:.1e} |"
        )
        axes.plot(steps, missed, ".-", linewidth=0.6, markersize=3, label=name)
    axes.set(xlabel="steps", ylabel="energy missing, over the largest work")
    axes.axhline(0.0, color="black", linewidth=0.8)
    _save(figure, axes, folder / "stability-drift.png")
    return "\n".join([*lines, "\n![Energy over time](stability-drift.png)\n"])


def _random(found: Found, folder: Path) -> str:
    seconds, steps = found["seconds"], found["steps"]
    classes = sorted(found["classes"].items(), key=lambda item: -item[1])
    strangers = (
        "; from seed 1200 on flanges in the sheet's plane or a rounding error beside it, own mesh files, and four in "
        "ten of those with units a thousand times off"
        if "own mold" in found["families"]
        else ""
    )
    lines = [
        "## Random scenes\n",
        f"{found['count']} seeds, {sum(map(bool, found['families'].values()))} of {len(found['families'])} families of "
        "one static shape each; all else is drawn: nodes "
        "shaken, squeezed up to 1:50 or graded, thickness with spots down to a thousandth or up to a thousand times, "
        "pressure that jumps, pulls or turns negative, molds with triangles that turn any way, with undercuts, too "
        f"small, or where the sheet is, no damping, invalid scene files{strangers}. Each ends in one of these "
        "ways:\n",
        "| how it ended | scenes | seeds |",
        "|---|---|---|",
    ]
    for name, count in classes:
        seeds = found["seeds"].get(name, [])
        shown = ", ".join(map(str, seeds[:_SHOWN])) + (", ..." if len(seeds) > _SHOWN else "")
        lines.append(f"| {name} | {count} | {shown} |")
    lines += [
        "",
        "*ok* means: finite, the energy balance correct to one per cent of the largest work, no node beyond the mold, "
        "no element deeper in it than half the longest side, and the end reached or everything stuck. A name without "
        "*status ok* is what the run reported itself: its status, or the warning that the sheet hangs over a mold too "
        "small for it. One with *status ok* would be a wrong result without a warning, and so would *wrong units, "
        "no warning*. *At rest and said so*: all of the sheet lay on the mold from the start, or nothing pressed on "
        "it; the energy balance of no work is rounding, and the run warned that nothing moved.\n",
        f"A scene takes {seconds['median']:.2g} s (median) and {steps['median']:.0f} steps; the slowest, "
        f"seed {seconds['slowest']}, {seconds['max']:.0f} s with its compilation. Of those that end well, 99 % miss "
        f"less than {_percent(found['balance']['99 %'])} of the energy and have elements at most "
        f"{_percent(found['elements_beyond']['99 %'])} of the longest side beyond the mold.\n",
        "| family | " + " | ".join(name for name, _ in classes) + " |",
        "|---" * (len(classes) + 1) + "|",
    ]
    for family, counts in found["families"].items():
        lines.append(f"| {family} | " + " | ".join(str(counts.get(name, 0)) for name, _ in classes) + " |")
    figure, axes = plt.subplots(figsize=(8, 4.2), layout="constrained")
    left = np.zeros(len(found["families"]))
    for name, _ in classes:
        counts = np.array([family.get(name, 0) for family in found["families"].values()], float)
        axes.barh(list(found["families"]), counts, left=left, label=name)
        left += counts
    axes.invert_yaxis()
    axes.set_xlabel("scenes")
    _save(figure, axes, folder / "stability-random.png", outside=True)
    return "\n".join([*lines, "\n![How random scenes end](stability-random.png)\n"])


def _gradients(found: Found, folder: Path) -> str:
    rows = found["rows"]
    lines = [
        "## Gradients of random scenes\n",
        f"{len(rows)} of the scenes that end well, replayed with their schedules: the gradient of the wall's "
        "mean-square deviation, weighted by volume, along a random direction against the best of some differences.\n",
        f"All finite: {'yes' if all(row['finite'] for row in rows) else 'no'}.\n",
        "| with respect to | median | 90 % | worst | above 1e-4 |",
        "|---|---|---|---|---|",
    ]
    for leaf, words in _LEAVES.items():
        apart = np.array([row[leaf]["apart"] for row in rows])
        bad = [f"{row['seed']} ({row['family']})" for row in rows if not row[leaf]["apart"] < 1e-4]
        lines.append(
            f"| {words} | {np.median(apart):.0e} | {np.percentile(apart, 90):.0e} | {apart.max():.0e} | {len(bad)}"
            f"{': ' if bad else ''}{', '.join(bad[:_SHOWN])} |"
        )
    figure, (left, right) = plt.subplots(1, 2, figsize=(11, 4.0), layout="constrained")
    families = list(dict.fromkeys(curve["family"] for curve in found["growth"]["curves"]))
    for k, family in enumerate(families):
        curves = [curve["norms"] for curve in found["growth"]["curves"] if curve["family"] == family]
        drawn = left.plot(found["growth"]["shares"], np.maximum(curves, 1e-12).T, "o-", color=f"C{k}", markersize=4)
        drawn[0].set_label(family)
    left.legend(fontsize=7)
    left.set(yscale="log", xlabel="share of the time", ylabel="norm of the gradient by the relative thickness")
    for name, line in found["rough"].items():
        right.plot(line["line"], np.array(line["slopes"]) / np.mean(np.abs(line["slopes"])), ".-", label=name)
    right.set(xlabel="place on the line", ylabel="slope over its mean size")
    left.grid(alpha=0.3)
    _save(figure, right, folder / "stability-gradients.png", outside=True)
    lines += [
        "",
        "How rough slopes are: the slope is computed at points of a line of sheets. *Spread* is the deviation of "
        "the slopes from a parabola, over their mean size; *against differences* how far they are from the "
        "differences of the values between these points (median). Cups are smooth, refined or not. A box that is "
        "refined in flight is not: new nodes near the mold begin at rest or on it, elements between them are "
        "compressed, and a compressed membrane buckles at a rate of thousands per second, which makes derivatives "
        "useless; on a uniform mesh no element of that box buckles. So search on a uniform mesh, as the study "
        "`box-insert-field` does, and refine what was found. A sheet that a pressure pushes back or pulls loses its"
        " tension and buckles on any mesh: its gradient grows by orders of magnitude along the run (left).\n",
        "| scene | spread | against differences |",
        "|---|---|---|",
    ]
    for name, line in found["rough"].items():
        lines.append(f"| {name} | {line['spread']:.1e} | {line['against_differences']:.1e} |")
    return "\n".join([*lines, "\n![Growth and roughness](stability-gradients.png)\n"])


def _float32(found: Found, _: Path) -> str:
    lines = [
        "## float32\n",
        "The walls of float32 compared with those of float64.\n",
        "| scene | wall, rms | largest | mean wall | elements | time over float64's |",
        "|---|---|---|---|---|---|",
    ]
    for row in found["built"]:
        double, single = row["seconds"]
        count = " and ".join(str(n) for n in sorted(set(row["elements"])))
        lines.append(
            f"| {row['scene']} | {_apart(row['rms'])} | {_apart(row['max'])} | {_percent(row['mean'])} | {count} "
            f"| {single / double:.2f} |"
        )
    rows = found["random"]
    rms = np.array([row["rms"] for row in rows if row["rms"] is not None and np.isfinite(row["rms"])])
    stopped = [row["seed"] for row in rows if row["status"]]
    bad = [row["seed"] for row in rows if not row["rms"] < 1e-2]
    lines += [
        "",
        f"Of {len(rows)} random scenes that end well in float64 the walls differ by {_percent(np.median(rms))} rms "
        f"(median), {_percent(np.percentile(rms, 90))} (90th percentile) and {_percent(rms.max())} (worst). "
        f"{len(stopped)} stop with a status in float32 ({_seeds(stopped)}); {len(bad)} differ by more than a per "
        f"cent or have another mesh ({_seeds(bad)}).\n",
    ]
    return "\n".join(lines)


def _endings_table(status: int) -> str:
    return "ok" if status == 0 else str(Status(status).name).lower().replace("_", " ").replace("|", " and ")


def _seeds(seeds: Iterable[int]) -> str:
    return ", ".join(map(str, seeds)) or "none"


def _save(figure: Any, axes: Any, path: Path, *, outside: bool = False) -> None:
    axes.grid(alpha=0.3)
    if outside:
        axes.legend(frameon=False, fontsize=8, loc="upper left", bbox_to_anchor=(1.0, 1.0))
    else:
        axes.legend(frameon=False, fontsize=8)
    save(figure, path)


def _range(values: list[float]) -> str:
    return f"{min(values):.3f} to {max(values):.3f}" if values else "none"


def _share(which: np.ndarray) -> str:
    return _percent(float(np.mean(which)))


def _apart(value: float) -> str:
    return "other mesh" if value is None or not np.isfinite(value) else _percent(value)


def _percent(value: float) -> str:
    return f"{100 * value:.2g} %" if abs(value) < 0.1 else f"{100 * value:.1f} %"


def _pinch(found: Found, folder: Path) -> str:
    ended = ", ".join(f"{name}: {number}" for name, number in found["endings"].items())
    bad = (
        f" Seeds that miss one of these, or end with a status: {', '.join(map(str, found['bad']))}."
        if found["bad"]
        else ""
    )
    return "\n".join([
        "\n## Mold halves that pinch a tube\n",
        f"{found['count']} random scenes: half a tube, and half a bottle with a handle whose land closes on the "
        "parting plane; or a whole tube between two halves. Tubes differ in radius, wall, length and place, bottles in "
        "width, neck and hole; they are turned in the parting plane, and close at 0.05 to 2 m/s. Required: no node "
        "beyond plane or land by more than 1e-9 of the size, the film's volume kept to 1e-3, and the energy balance to "
        f"one per cent of what air and tools do.{bad}\n",
        "| how they ended | deepest node beyond plane or land [m] | change of the film's volume | energy balance, "
        "worst | median |",
        "|---|---|---|---|---|",
        f"| {ended} | {found['deepest']:.1e} | {found['volume']:.1e} | {found['balance']['max']:.1e} "
        f"| {found['balance']['median']:.1e} |\n",
    ])  # fmt: skip


_SECTIONS = {
    "edge": _edge,
    "drift": _drift,
    "random": _random,
    "gradients": _gradients,
    "float32": _float32,
    "pinch": _pinch,
}

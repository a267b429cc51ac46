"""Pictures of what `make bench` found."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt


def draw(found: dict[str, Any], folder: Path) -> None:
    """One picture per section that has one, of the sections that were run."""
    for name, picture in (("bare", _bare), ("gradients", _gradients), ("memory", _memory), ("skips", _skips)):
        if found.get(name):
            figure, axes = plt.subplots(figsize=(7, 4.2), layout="constrained")
            picture(axes, found[name])
            figure.savefig(folder / f"{name}.png", dpi=130)
            plt.close(figure)


def _lines(axes: Any, table: list[dict[str, Any]], names: list[str]) -> None:
    for name in names:
        points = [(row["elements"], row[name]) for row in table if row.get(name) is not None]
        if points:
            axes.plot(*zip(*points, strict=True), marker="o", label=name)
    axes.set(xscale="log", yscale="log", xlabel="elements", ylabel="ns per element and step")
    axes.grid(alpha=0.3, which="both")
    axes.legend(frameon=False)


def _bare(axes: Any, table: list[dict[str, Any]]) -> None:
    _lines(axes, table, ["NumPy", "numba", "C++", "C++ float32", "jaxform", "jaxform float32"])
    axes.set_title("The bare step on one core")


def _gradients(axes: Any, table: list[dict[str, Any]]) -> None:
    _lines(axes, table, ["run", "forward mode", "value and gradient"])
    axes.set_title("A whole run, and its derivatives")


def _memory(axes: Any, table: list[dict[str, Any]]) -> None:
    for adjoint in dict.fromkeys(row["adjoint"] for row in table):
        rows = [row for row in table if row["adjoint"] == adjoint]
        axes.plot([row["steps"] for row in rows], [row["memory MB"] for row in rows], marker="o", label=adjoint)
    axes.set(xscale="log", yscale="log", xlabel="steps", ylabel="memory of the gradient [MB]")
    axes.set_title("Value and gradient of 2048 elements")
    axes.grid(alpha=0.3, which="both")
    axes.legend(frameon=False)


def _skips(axes: Any, table: list[dict[str, Any]]) -> None:
    scenes = list(dict.fromkeys(row["scene"] for row in table))
    switches = list(dict.fromkeys(row["switched"] for row in table))
    for k, switch in enumerate(switches):
        rows = [row for row in table if row["switched"] == switch]
        base = {row["scene"]: row["seconds"] for row in table if row["switched"] == "all"}
        height = [row["seconds"] / base[row["scene"]] for row in rows]
        axes.bar([scenes.index(row["scene"]) + 0.13 * (k - 2.5) for row in rows], height, 0.12, label=switch)
    axes.set_xticks(range(len(scenes)), scenes)
    axes.set_ylabel("time over that with all on")
    axes.set_title("What a window saves")
    axes.legend(frameon=False, ncols=2)

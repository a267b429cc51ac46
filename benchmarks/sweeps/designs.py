"""Sixty-four designs, molds of other depths among them, on one and on two workers; and the memory of a worker."""

from __future__ import annotations

import csv
import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np

DEPTHS, THICKNESSES = 8, 8
SCENE = """
name = "sweep"
[parison]
shape = "disc"
radius = 0.1
elements = {elements}
symmetry = "quarter"
thickness = 1.0e-3
[material]
model = "mooney-rivlin"
c = 0.2e6
alpha = 0.1
density = 1000.0
[pressure]
time = [0.0, 0.2]
value = [0.0, 2.0e4]
[mold]
shape = "revolved"
profile = [[0.0, 0.05], [0.055, 0.05], [0.1, 0.0]]
segments = 96
[solver]
end_time = 0.24
damping = 100.0
"""


def show_designs(elements: int = 1500) -> dict[str, Any]:
    """Bits, programs and time of one and of two workers, each with a cache of its own, cold at first and then warm."""
    found: dict[str, Any] = {}
    tables = {}
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        _write(folder, elements)
        for workers in (1, 2):
            cold = _sweep(folder, workers, folder / f"cache{workers}")
            warm = _sweep(folder, workers, folder / f"cache{workers}")
            tables[workers] = _rows(folder / "out")
            found[f"{workers} workers"] = {
                "ok": cold["ok"],
                "programs compiled": cold["programs_compiled"],
                "programs compiled the second time": warm["programs_compiled"],
                "seconds from the first row to the last": warm["between"],
            }
    times = [found[f"{workers} workers"]["seconds from the first row to the last"] for workers in (1, 2)]
    compiled = [found[f"{workers} workers"]["programs compiled"] for workers in (1, 2)]
    return found | {
        "same bits": tables[1] == tables[2],
        "programs compiled twice": compiled[1] - compiled[0],
        "ratio beyond compiling": times[0] / times[1],
    }


def _write(folder: Path, elements: int) -> None:
    """The scene and its table: eight depths of the mold by eight thicknesses of the sheet."""
    (folder / "scene.toml").write_text(SCENE.format(elements=elements))
    rows = [
        f"{depth},{depth},{thickness}"
        for depth in np.linspace(0.04, 0.06, DEPTHS)
        for thickness in np.linspace(0.8e-3, 1.2e-3, THICKNESSES)
    ]
    (folder / "table.csv").write_text("\n".join(["mold.profile[0][1],mold.profile[1][1],parison.thickness", *rows]))


def _sweep(folder: Path, workers: int, cache: Path) -> dict[str, Any]:
    """The contents of a sweep's sweep.json, and the time between its first row and its last [s]."""
    known = {key: text for key, text in os.environ.items() if key != "JAX_COMPILATION_CACHE_DIR"}
    command = [sys.executable, "-m", "jaxform.cli", "sweep", "table.csv", "--scene", "scene.toml", "--out", "out"]
    command += ["--force", "--quiet", "--workers", str(workers)]
    (folder / "out" / "results.csv").unlink(missing_ok=True)
    moments: list[tuple[float, int]] = []
    with subprocess.Popen(command, cwd=folder, env=known | {"XDG_CACHE_HOME": str(cache)}) as process:
        while process.poll() is None:
            path = folder / "out" / "results.csv"
            count = path.read_bytes().count(b"\n") - 1 if path.exists() else 0
            if count > 0 and (not moments or count > moments[-1][1]):
                moments.append((time.perf_counter(), count))
            time.sleep(0.01)
    if process.returncode:
        raise SystemExit("the sweep fails")
    facts = json.loads((folder / "out" / "sweep.json").read_text())
    return facts | {"between": moments[-1][0] - moments[0][0]}


def _rows(folder: Path) -> list[dict[str, str]]:
    """The rows of results.csv without their times."""
    with (folder / "results.csv").open(newline="") as file:
        return [{name: text for name, text in row.items() if name != "seconds"} for row in csv.DictReader(file)]


def show_memory(elements: int = 10_000) -> dict[str, Any]:
    """The largest resident memory [GB] of a worker that compiles and simulates a sheet of so many elements."""
    known = {key: text for key, text in os.environ.items() if key != "JAX_COMPILATION_CACHE_DIR"}
    found: dict[str, Any] = {}
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "scene.toml").write_text(SCENE.format(elements=elements))
        (folder / "table.csv").write_text("parison.thickness,solver.end_time\n1.0e-3,\n1.1e-3,\n")
        for words in ("cold cache", "warm cache"):
            command = [sys.executable, "-m", "jaxform.cli", "sweep", "table.csv", "--scene", "scene.toml", "--force"]
            command += ["--out", "out", "--quiet", "--workers", "1"]
            most: dict[int, int] = {}
            with subprocess.Popen(command, cwd=folder, env=known | {"XDG_CACHE_HOME": name}) as process:
                while process.poll() is None:
                    for pid in _children(process.pid):
                        most[pid] = max(most.get(pid, 0), _peak(pid))
                    time.sleep(0.05)
            facts = json.loads((folder / "out" / "sweep.json").read_text())
            found[words] = {"elements": elements, "ok": facts["ok"], "GB": max(most.values()) / 1e6}
    return found


def _children(pid: int) -> list[int]:
    """Processes that a process has started."""
    try:
        return [int(child) for child in Path(f"/proc/{pid}/task/{pid}/children").read_text().split()]
    except OSError:
        return []


def _peak(pid: int) -> int:
    """The largest resident memory that a process has had [kB]; 0 where it has ended."""
    try:
        lines = Path(f"/proc/{pid}/status").read_text().splitlines()
    except OSError:
        return 0
    return next((int(line.split()[1]) for line in lines if line.startswith("VmHWM:")), 0)

"""The stress run: every random scene ends well, or stops with the right status; no hang, no silent wrong answer.

A worker process takes the scenes one after another and writes a line of JSON for each; a watchdog ends a worker that is
silent for too long, writes down a hang, and starts another at the next scene.
"""

from __future__ import annotations

import dataclasses
import json
import subprocess
import sys
import time
import warnings
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import jaxform
from benchmarks.stability.random_scenes import Drawn, draw
from benchmarks.strangers.scenes import OFF
from jaxform.results.result import Result
from jaxform.results.summary import measure_penetration, summarize, warnings_of_mold
from jaxform.runs import host
from jaxform.runs.padding import pad_to_bucket
from jaxform.sheet.state import LOSSES, State, Status, is_finished

Row = dict[str, Any]
LIMIT = 60.0  # s for a scene
SILENCE = 240.0  # s for a scene, its compilation, and the process's start
UNBALANCED = 0.01  # of the largest work
_AT_ONCE = 100  # windows between two looks at the clock


def run_drawn(drawn: Drawn, limit: float = LIMIT) -> tuple[State, Result]:
    """Runs a scene as `jaxform.run` does, with the windows that were planned, within a time limit."""
    room, left = pad_to_bucket(drawn.scene, recorded=True), drawn.planned
    scene = room.scene
    state, first, taken = host.begin(scene)
    host.compile_advance(state, scene, first, taken)  # not counted
    began = time.perf_counter()
    while left > 0 and not bool(is_finished(state, scene)):
        most = min(left, _AT_ONCE)
        state, taken, _ = host.compile_advance(state, scene, first, taken)(state, scene, first, taken, jnp.int32(most))
        left -= most
        if time.perf_counter() - began > limit:
            state = dataclasses.replace(state, status=jnp.int32(state.status | Status.STOPPED))
    return state, room.result(host.result_of(state, scene, first, taken, last=True))


def examine(drawn: Drawn, state: State, result: Result) -> Row:
    """Numbers that tell whether a run was right; lengths relative to the sheet's size."""
    positions, wall = np.asarray(result.positions, float), np.asarray(result.element_thickness, float)
    used = np.asarray(result.used)
    size = float(np.ptp(np.asarray(drawn.scene.parison.positions), axis=0).max())
    corners = positions[np.asarray(result.triangles)[used]]
    side = float(np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max())
    energy = result.energy
    held = sum(float(getattr(energy, name)) for name in ("strain", "kinetic", *LOSSES))
    peak = max(float(state.account.peak_work), 1e-300)
    values = [np.asarray(leaf) for leaf in jax.tree.leaves(dataclasses.replace(result, schedule=None))]
    finite = all(np.isfinite(v).all() for v in values if v.dtype.kind == "f")
    through = measure_penetration(result, drawn.scene) if finite else None
    return {
        "status": int(result.status),
        "finite": bool(finite and (wall[used] > 0).all()),
        "balance": abs(held - float(energy.external_work)) / peak,
        "rounding": float(energy.rounding) / peak,
        "reported": float(energy.balance_error),
        "stretch": float(np.asarray(result.stretches)[used].max()) if finite else -1.0,
        "warned": bool(through and warnings_of_mold(result, drawn.scene, through)),
        "nodes_beyond": through.nodes / size if through else -1.0,
        "elements_beyond": through.elements / side if through else -1.0,
        "done": float(result.time / drawn.scene.solver.end_time),
        "stuck": float(np.asarray(result.stuck)[np.asarray(result.active)].mean()),
        "steps": int(result.steps),
        "windows": int(result.windows),
        "shortened": int(result.shortened),
        "elements": int(used.sum()),
    }


def ended_well(seed: int, steps: int, stretch: float) -> tuple[Drawn, Result] | None:
    """A seed's scene and its part; None where it is refused, does not end well, or goes beyond these limits."""
    try:
        drawn = draw(seed)
    except jaxform.InputError:
        return None
    state, result = run_drawn(drawn)
    row = examine(drawn, state, result)
    well = classify(row) == "ok" and row["steps"] <= steps and row["stretch"] <= stretch
    return (drawn, result) if well else None


def classify(row: Row) -> str:
    """In a word or two how a scene ended."""
    if "refused" in row:
        return "refused"
    if "error" in row:
        return "error"
    if "hang" in row or row["status"] & Status.STOPPED:
        return "hang"
    if row["status"]:
        return " and ".join(bit.name.lower().replace("_", " ") for bit in Status if bit.name and row["status"] & bit)
    if not row["finite"]:
        return "not finite, status ok"
    if OFF in row.get("tags", []) and not row["told"]:
        return "wrong units, no warning"
    if row["balance"] > UNBALANCED:
        # Without work there is nothing to be balanced but rounding; a run has to say that nothing moved.
        said = row["balance"] <= row.get("rounding", 0.0) and bool(row.get("told"))
        return "at rest and said so" if said else "unbalanced, status ok"
    if row["warned"]:
        return "warned of the mold"
    if row["nodes_beyond"] > 1e-6 or row["elements_beyond"] > 0.5:
        return "through the mold, status ok"
    if row["done"] < 1.0 - 1e-9 and row["stuck"] < 1.0:
        return "ended early, status ok"
    return "ok"


def one(seed: int) -> Row:
    """The outcome of a seed."""
    row: Row = {"seed": seed}
    began = time.perf_counter()
    with warnings.catch_warnings(record=True) as heard:
        warnings.simplefilter("always")
        try:
            drawn = draw(seed)
        except jaxform.InputError as problem:
            return row | {"refused": str(problem), "seconds": 0.0}
    row |= {"family": drawn.family, "tags": drawn.tags, "building": time.perf_counter() - began}
    began = time.perf_counter()
    state, result = run_drawn(drawn)
    jax.block_until_ready(result.positions)
    row["seconds"] = time.perf_counter() - began
    told = [str(warning.message) for warning in heard] + summarize(result, drawn.scene)["warnings"]
    return row | examine(drawn, state, result) | {"told": told}


def work(first: int, end: int, path: Path) -> None:
    """Appends a line for each seed from `first` to before `end`."""
    jax.config.update("jax_enable_x64", True)
    jax.config.update("jax_compilation_cache_dir", str(path.with_suffix(".cache")))
    warnings.simplefilter("ignore")
    with path.open("a") as file:
        for seed in range(first, end):
            try:
                row = one(seed)
            except Exception as problem:
                row = {"seed": seed, "error": f"{type(problem).__name__}: {problem}"[:300]}
            row["class"] = classify(row)
            file.write(json.dumps(row) + "\n")
            file.flush()


def campaign(count: int, path: Path) -> list[Row]:
    """The rows of so many seeds; goes on where an earlier one was stopped."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.touch()
    while (first := len(_rows(path))) < count:
        command = [sys.executable, "-m", "benchmarks.stability.stress", str(first), str(count), str(path)]
        with subprocess.Popen(command) as worker:
            seen, since = first, time.monotonic()
            while worker.poll() is None:
                time.sleep(1.0)
                now = len(_rows(path))
                if now > seen:
                    seen, since = now, time.monotonic()
                elif time.monotonic() - since > SILENCE:
                    worker.kill()
                    _give_up(path, "silent")
                    break
            else:
                if worker.returncode:
                    _give_up(path, f"the process ended with {worker.returncode}")
    return _rows(path)[:count]


def _give_up(path: Path, words: str) -> None:
    """Writes down that the next scene hangs, or kills its process."""
    row = {"seed": len(_rows(path)), "hang": words, "class": "hang"}
    with path.open("a") as file:
        file.write(json.dumps(row) + "\n")


def _rows(path: Path) -> list[Row]:
    return [json.loads(line) for line in path.read_text().splitlines() if line.endswith("}")]


if __name__ == "__main__":
    work(int(sys.argv[1]), int(sys.argv[2]), Path(sys.argv[3]))

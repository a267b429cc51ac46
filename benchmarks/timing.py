"""Timing and output of the benchmarks."""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from jaxform.model.scene import Scene
from jaxform.runs import host
from jaxform.sheet.state import State


def one_core() -> None:
    """Keeps this process on one core, where the system can."""
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, {max(os.sched_getaffinity(0))})


def best_seconds(run: Callable[[], Any], repeats: int = 5) -> float:
    """The shortest of a few runs [s], after one to warm up."""
    return best_in_turns({"": run}, repeats)[""]


def best_in_turns(
    runs: dict[str, Callable[[], Any]], rounds: int = 7, clock: Callable[[], float] = time.perf_counter
) -> dict[str, float]:
    """The shortest of a few runs [s] of each, by a clock; they take turns, so that timing noise is the same for all."""
    for run in runs.values():
        jax.block_until_ready(run())
    best = dict.fromkeys(runs, float("inf"))
    for _ in range(rounds):
        for name, run in runs.items():
            begin = clock()
            jax.block_until_ready(run())
            best[name] = min(best[name], clock() - begin)
    return best


def whole_loop(scene: Scene) -> Callable[[], State]:
    """The whole loop of a scene's run, compiled; it gives the last state."""
    begun = host.begin(scene)
    advance, most = host.compile_advance(begun[0], scene, *begun[1:]), jnp.int32(scene.tables.window_count)
    return lambda: advance(begun[0], scene, *begun[1:], most)[0]


def say(row: dict[str, Any]) -> None:
    print("  " + "  ".join(f"{key} {_words(value)}" for key, value in row.items()), flush=True)


def _words(value: Any) -> str:
    return f"{value:.4g}" if isinstance(value, float) else "-" if value is None else str(value)

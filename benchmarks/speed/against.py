"""This checkout beside another one: what a bare step, a whole run and a gradient cost in each.

`.venv/bin/python -m benchmarks.speed.against OTHER [ROUNDS [NAME ...]]`: OTHER is the folder of another checkout, of an
older commit for instance; names choose among the runs. Each has a process of its own that has everything compiled; they
take turns, run by run, on one core. What one of them cannot do is said and left out. Where a process's arrays lie in
memory makes it some per cent slower or faster as long as it lives, so there are several pairs of processes, one after
the other. The ratio of a pair is the median over the rounds of what both took one after the other; the ratio that
counts is the median of the pairs'. Of a whole run the loop is also looked at alone: before and after it a run checks
what it was given and what came out.
"""

from __future__ import annotations

import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

_HERE = Path(__file__).parents[2]
_ROUNDS, _PAIRS = 7, 5
_SERVE = "--serve"


def _makers() -> dict[str, Callable[[], Callable[[], Any]]]:
    """Functions that make what is timed, by the public interface alone, as it was and is."""
    import jax
    import jax.numpy as jnp

    import jaxform
    from jaxform import shapes

    jax.config.update("jax_enable_x64", True)

    def bare_steps() -> Callable[[], Any]:
        sheet = shapes.disc(radius=0.1, elements=9600, symmetry="quarter")
        free = jaxform.build_scene(
            parison=jaxform.make_parison(sheet.positions, sheet.triangles, 1e-3, sheet.clamped, sheet.fixed),
            material=jaxform.MooneyRivlin(jnp.asarray(2e5), jnp.asarray(0.1), jnp.asarray(1e3)),
            pressure=jaxform.make_pressure([0.0, 0.2], [0.0, 1e3]),
            solver=jaxform.make_solver(end_time=0.05, damping=100.0),
        )
        return lambda: jaxform.run(free)

    def whole(name: str) -> Callable[[], Any]:
        scene = jaxform.load(name)
        return lambda: jaxform.run(scene)

    def gradient(name: str, side_by_side: int = 0) -> Callable[[], Any]:
        scene = jaxform.load(name)

        def objective(thickness: Any) -> Any:
            formed = jaxform.simulate(jaxform.replace(scene, {"parison.thickness": thickness}))
            return jnp.sum(jnp.square(formed.thickness))

        thickness, function = scene.parison.thickness, jax.value_and_grad(objective)
        if side_by_side:
            thickness, function = thickness * jnp.linspace(0.9, 1.1, side_by_side)[:, None], jax.vmap(function)
        compiled = jax.jit(function).lower(thickness).compile(jaxform.compiler_options())
        return lambda: compiled(thickness)

    return {
        "bare steps": bare_steps,
        **{name: lambda name=name: whole(name) for name in ("dish", "soap-bottle", "box-insert", "dish-refined")},
        "gradient": lambda: gradient("dish-coarse"),
        "four gradients, mapped": lambda: gradient("dish-coarse", 4),
        "refined gradient": lambda: gradient("dish-refined"),
        "melt gradient": lambda: gradient("cup-melt"),
    }


def _serve(names: list[str]) -> None:
    """Times what is asked for by name, line by line; first says what each took to load, compile and run once [s]."""
    import jax

    warnings.simplefilter("ignore")
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, {max(os.sched_getaffinity(0))})
    makers, runs, took = _makers(), {}, {}
    for name in names or makers:
        begin = time.perf_counter()
        try:
            runs[name] = makers[name]()
            jax.block_until_ready(runs[name]())
        except Exception as error:  # what an older checkout cannot do yet
            print(f"{name}: {type(error).__name__}: {error}", file=sys.stderr, flush=True)
            continue
        took[name] = time.perf_counter() - begin
    print(json.dumps(took), flush=True)
    for line in sys.stdin:
        begin = time.perf_counter()
        found = jax.block_until_ready(runs[line.strip()]())
        whole = time.perf_counter() - begin
        loop = getattr(found, "seconds", None)
        print(json.dumps({"": whole} | ({", loop": loop.run} if loop else {})), flush=True)


def _start_server(folder: Path, names: list[str], programs: str) -> subprocess.Popen[str]:
    """A process that times the package in a folder; of this checkout it sees this file alone.

    What it compiles is kept in the folder `programs`, for the next such process.
    """
    kept = {"JAX_COMPILATION_CACHE_DIR": programs, "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0.1"}
    return subprocess.Popen(
        [sys.executable, "-P", str(Path(__file__)), _SERVE, *names],
        env=os.environ | {"PYTHONPATH": str(folder)} | kept,
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )


def _answer(process: subprocess.Popen[str]) -> Any:
    assert process.stdout is not None
    return json.loads(process.stdout.readline())


def _time_answer(process: subprocess.Popen[str], name: str) -> dict[str, float]:
    """Time of a run [s] by the suffix of its name: all of it, and its loop alone."""
    assert process.stdin is not None
    print(name, file=process.stdin, flush=True)
    return _answer(process)


class Pair(NamedTuple):
    """Times of two processes, of this checkout and of the other [s]: run by run, and for the first time."""

    rounds: dict[str, list[list[dict[str, float]]]]
    first: list[dict[str, float]]

    def ratio(self, name: str, part: str) -> float:
        """Ratio of this checkout's time to the other's."""
        return statistics.median(mine[part] / its[part] for mine, its in self.rounds[name])


def _measure_pair(other: Path, rounds: int, names: list[str], programs: str) -> Pair:
    """Times of two new processes, in turns."""
    processes = [_start_server(folder, names, programs) for folder in (_HERE, other)]
    first = [_answer(process) for process in processes]
    both = [name for name in first[0] if name in first[1]]
    taken = {name: [[_time_answer(process, name) for process in processes] for _ in range(rounds)] for name in both}
    for process in processes:
        process.terminate()
        process.wait()
    return Pair(taken, first)


def main(arguments: list[str]) -> int:
    """Prints for each run the least times [s] of this checkout and of the other, and their ratio."""
    from benchmarks.timing import say

    if not arguments:
        print(__doc__)
        return 2
    other, rounds = Path(arguments[0]).resolve(), int(arguments[1]) if len(arguments) > 1 else _ROUNDS
    with tempfile.TemporaryDirectory() as programs:
        pairs = [_measure_pair(other, rounds, arguments[2:], programs) for _ in range(_PAIRS)]
    # Only the first pair of processes had to compile.
    first = pairs[0].first
    for name in pairs[0].rounds:
        taken = [both for pair in pairs for both in pair.rounds[name]]
        for part in taken[0][0]:
            best = [min(times[part] for times in own) for own in zip(*taken, strict=True)]
            ratios = sorted(pair.ratio(name, part) for pair in pairs)
            spread = {"ratio": statistics.median(ratios), "least": ratios[0], "most": ratios[-1]}
            say({name + part: best[0], "other": best[1], **spread})
        say({"  the first time": first[0][name], "other": first[1][name]})
    return 0


if __name__ == "__main__":
    sys.exit(_serve(sys.argv[2:]) if sys.argv[1:2] == [_SERVE] else main(sys.argv[1:]))

"""This checkout beside another one: what a bare step, a whole run and a gradient cost in each.

`.venv/bin/python -m benchmarks.speed.against OTHER [ROUNDS]`: OTHER is the folder of another checkout, of an older
commit for instance. Each has a process of its own that has everything compiled; they take turns, run by run, on one
core. The ratio is the median over the rounds of what both took one after the other.
"""

from __future__ import annotations

import json
import os
import statistics
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

_HERE = Path(__file__).parents[2]
_ROUNDS = 15
_SERVE = "--serve"


def _runs() -> dict[str, Callable[[], Any]]:
    """What is timed, by the public face alone, as it was and is."""
    import jax
    import jax.numpy as jnp

    import jaxform
    from jaxform import shapes

    jax.config.update("jax_enable_x64", True)
    sheet = shapes.disc(radius=0.1, elements=9600, symmetry="quarter")
    free = jaxform.build_scene(
        parison=jaxform.make_parison(sheet.positions, sheet.triangles, 1e-3, sheet.clamped, sheet.fixed),
        material=jaxform.MooneyRivlin(jnp.asarray(2e5), jnp.asarray(0.1), jnp.asarray(1e3)),
        pressure=jaxform.make_pressure([0.0, 0.2], [0.0, 1e3]),
        solver=jaxform.make_solver(end_time=0.05, damping=100.0),
    )
    coarse = jaxform.load("dish-coarse")

    def objective(thickness: Any) -> Any:
        formed = jaxform.simulate(jaxform.replace(coarse, {"parison.thickness": thickness}))
        return jnp.sum(jnp.square(formed.thickness))

    thickness = coarse.parison.thickness
    several = thickness * jnp.linspace(0.9, 1.1, 4)[:, None]
    gradient, mapped = (
        jax.jit(function).lower(argument).compile(jaxform.compiler_options())
        for function, argument in (
            (jax.value_and_grad(objective), thickness),
            (jax.vmap(jax.value_and_grad(objective)), several),
        )
    )
    scenes = {name: jaxform.load(name) for name in ("dish", "soap-bottle", "box-insert", "dish-refined")}
    whole = {name: lambda scene=scene: jaxform.run(scene).positions for name, scene in scenes.items()}
    slopes = {"gradient": lambda: gradient(thickness), "four gradients, mapped": lambda: mapped(several)}
    return {"bare steps": lambda: jaxform.run(free).positions, **whole, **slopes}


def _serve() -> None:
    """Times what is asked for by name, line by line."""
    import jax

    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, {max(os.sched_getaffinity(0))})
    runs = _runs()
    for run in runs.values():
        jax.block_until_ready(run())
    print(json.dumps(list(runs)), flush=True)
    for line in sys.stdin:
        begin = time.perf_counter()
        jax.block_until_ready(runs[line.strip()]())
        print(time.perf_counter() - begin, flush=True)


def _served(folder: Path) -> subprocess.Popen[str]:
    """A process that times the package in a folder; of this checkout it sees this file alone."""
    return subprocess.Popen(
        [sys.executable, "-P", str(Path(__file__)), _SERVE],
        env=os.environ | {"PYTHONPATH": str(folder)},
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )


def _answer(process: subprocess.Popen[str]) -> Any:
    assert process.stdout is not None
    return json.loads(process.stdout.readline())


def _timed(process: subprocess.Popen[str], name: str) -> float:
    assert process.stdin is not None
    print(name, file=process.stdin, flush=True)
    return _answer(process)


def main(arguments: list[str]) -> int:
    """Prints for each run the times [s] of this checkout and of the other, and their ratio."""
    from benchmarks.timing import say

    if not arguments:
        print(__doc__)
        return 2
    other, rounds = Path(arguments[0]).resolve(), int(arguments[1]) if len(arguments) > 1 else _ROUNDS
    processes = [_served(_HERE), _served(other)]
    names, theirs = (_answer(process) for process in processes)
    assert names == theirs
    for name in names:
        pairs = [[_timed(process, name) for process in processes] for _ in range(rounds)]
        best = [min(times) for times in zip(*pairs, strict=True)]
        ratio = statistics.median(mine / its for mine, its in pairs)
        say({name: best[0], "other": best[1], "ratio": ratio, "of the best": best[0] / best[1]})
    for process in processes:
        process.terminate()
    return 0


if __name__ == "__main__":
    sys.exit(_serve() if sys.argv[1:] == [_SERVE] else main(sys.argv[1:]))

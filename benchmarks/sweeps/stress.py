"""A sweep on a Dask cluster whose workers are killed every few seconds, and whose client is killed, too.

Two hundred tiny designs are computed on four workers; every tenth diverges. Each start of a design is noted in
a file, and so is the moment at which its row is recorded: what starts after it was recorded is computed again.
"""

from __future__ import annotations

import csv
import json
import logging
import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from concurrent.futures import Executor, ThreadPoolExecutor
from pathlib import Path
from threading import Event, Thread
from typing import Any

import numpy as np

from jaxform.core import disk
from jaxform.sweeps.records import Records
from jaxform.sweeps.workers import connect, evaluate

DESIGNS, WORKERS, EVERY, LASTS = 200, 4, 3.0, 0.4  # seconds between kills, and that a design takes
_SCENE = "dish-coarse"


def describe(task: tuple[int, str, float]) -> dict[str, float]:
    """Numbers to the last bit, after a moment; every tenth design diverges. It needs no JAX: workers start at once."""
    number, folder, lasts = task
    with (Path(folder) / f"{number}.log").open("a") as file:
        file.write(f"{time.time()}\n")
    time.sleep(lasts)
    if number % 10 == 3:
        raise FloatingPointError(f"design {number} diverges")
    places = np.random.default_rng(number).standard_normal(1000)
    return {"root": float(np.sqrt(number)), "norm": float(np.linalg.norm(np.sin(places)))}


def sweep(
    folder: Path, executor: Executor, lasts: float = LASTS, on_row: Callable[[int], object] = lambda number: None
) -> None:
    """Computes and records all designs, as `jaxform sweep --resume` does; what is recorded is not computed again."""
    out = folder / "out"
    out.mkdir(parents=True, exist_ok=True)
    records = Records(out, ["number"], ["root", "norm", "seconds"], resume=True)
    for digest in records.rows:
        on_row(int(digest))
    left = [number for number in range(DESIGNS) if str(number) not in records.rows]
    for place, outcome in evaluate(describe, [(number, str(folder), lasts) for number in left], executor):
        number = left[place]
        head = {"design": number + 1, "number": number, "status": outcome.status, "digest": str(number)}
        records.append(head | {"seconds": outcome.seconds} | (outcome.value or {}))
        on_row(number)
    records.finish((str(number), {}) for number in range(DESIGNS))


def client(address: str, folder: Path) -> None:
    """A process that begins the sweep, and can be killed; notes when each row was recorded, or read again."""
    with connect(address) as executor, (folder / "recorded.log").open("a", buffering=1) as file:
        sweep(folder, executor, on_row=lambda number: file.write(f"{number} {time.time()}\n"))


def show_stress(kill_client: bool) -> dict[str, Any]:
    """Runs the sweep, killing a worker every few seconds, and its client in the middle; compares with a serial one."""
    from distributed import LocalCluster

    logging.getLogger("distributed").setLevel(logging.CRITICAL)
    with tempfile.TemporaryDirectory() as name, ThreadPoolExecutor(1) as one:
        folder, alone = Path(name) / "stress", Path(name) / "serial"
        folder.mkdir()
        alone.mkdir()
        options: dict[str, Any] = {"threads_per_worker": 1, "dashboard_address": None}
        cluster: Any
        with LocalCluster(WORKERS, silence_logs=logging.CRITICAL, **options) as cluster:
            kills = _kill_workers(cluster)
            began = time.perf_counter()
            command = [sys.executable, "-m", "benchmarks.sweeps.stress", cluster.scheduler_address]
            ends = 0
            while True:
                process = subprocess.Popen([*command, str(folder)])
                if kill_client and not ends:
                    while process.poll() is None and len(_record_times(folder)) < DESIGNS // 2:
                        time.sleep(0.05)
                    process.kill()
                ends += 1
                if process.wait() == 0:
                    break
                if ends > 3:
                    raise SystemExit("the client does not end")
            seconds = time.perf_counter() - began
            killed = kills()
        sweep(alone, one, 0.0)
        found, serial = _rows(folder), _rows(alone)
        times = {number: _starts(folder, number) for number in range(DESIGNS)}
        recorded = _record_times(folder)
    again = [number for number in range(DESIGNS) if any(moment > recorded[number] for moment in times[number])]
    failed = [row for row in found if row["status"] != "ok"]
    return {
        "designs": DESIGNS,
        "workers killed": killed,
        "clients killed": int(kill_client),
        "lost": DESIGNS - len({row["digest"] for row in found}),
        "recorded and computed again": len(again),
        "started more than once, before they were recorded": sum(len(moments) > 1 for moments in times.values()),
        "failed": len(failed),
        "failures named": sum(row["status"].startswith("FloatingPointError: design") for row in failed),
        "same bits as serial": found == serial,
        "seconds": round(seconds, 1),
    }


def _kill_workers(cluster: Any) -> Callable[[], int]:
    """Kills a worker every few seconds until the function is called that gives their number."""
    stop, count, chance = Event(), [0], random.Random(0)

    def running() -> set[int]:
        """Processes of workers that run; one that is killed while it starts is given up by its nanny."""
        there = set(cluster.scheduler.workers)
        nannies = [nanny for nanny in list(cluster.workers.values()) if nanny.worker_address in there]
        return {nanny.pid for nanny in nannies if nanny.pid and nanny.status.name == "running"}

    def kill() -> None:
        before: set[int] = set()
        while not stop.wait(EVERY):
            steady = sorted(before & running())
            if steady:
                os.kill(chance.choice(steady), signal.SIGKILL)
                count[0] += 1
            before = running()
            cluster.scale(WORKERS)  # nannies give up where starting takes long; others take their place

    thread = Thread(target=kill, daemon=True)
    thread.start()

    def end() -> int:
        stop.set()
        thread.join()
        return count[0]

    return end


def _starts(folder: Path, number: int) -> list[float]:
    path = folder / f"{number}.log"
    return [float(line) for line in path.read_text().split()] if path.exists() else []


def _record_times(folder: Path) -> dict[int, float]:
    """The time at which each design was recorded first."""
    path = folder / "recorded.log"
    found: dict[int, float] = {}
    for line in path.read_text().splitlines() if path.exists() else []:
        place, _, moment = line.partition(" ")
        if moment:
            found.setdefault(int(place), float(moment))
    return found


def _rows(folder: Path) -> list[dict[str, str]]:
    """The rows of results.csv without their times."""
    with (folder / "out" / "results.csv").open(newline="") as file:
        return [{name: text for name, text in row.items() if name != "seconds"} for row in csv.DictReader(file)]


def show_cold() -> dict[str, Any]:
    """Four local workers on a cold cache: what they write to standard error, and the programs that they compile."""
    found: dict[str, Any] = {}
    for workers in (1, 4):
        with tempfile.TemporaryDirectory() as name:
            table = Path(name) / "table.csv"
            depths = np.linspace(0.045, 0.055, 8)
            lines = [f"{depth},{depth}" for depth in depths]
            table.write_text("\n".join(["mold.profile[0][1],mold.profile[1][1]", *lines]))
            out = Path(name) / "out"
            known = {key: text for key, text in os.environ.items() if key != "JAX_COMPILATION_CACHE_DIR"}
            command = [sys.executable, "-m", "jaxform.cli", "sweep", str(table), "--scene", _SCENE, "--out", str(out)]
            done = subprocess.run(
                [*command, "--workers", str(workers)],
                env=known | {"XDG_CACHE_HOME": str(Path(name) / "cache")},
                capture_output=True,
                text=True,
                check=True,
            )
            facts = json.loads((out / "sweep.json").read_text())
            kept = list((Path(name) / "cache").rglob(f"{disk.COMPILED}/*-cache"))
            found[f"{workers} workers"] = {
                "standard error": done.stderr,
                "failed": facts["failed"],
                "programs compiled": facts["programs_compiled"],
                "programs in the cache": len(kept),
            }
    return found


if __name__ == "__main__":
    client(sys.argv[1], Path(sys.argv[2]))

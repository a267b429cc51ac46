"""Losses by `kill -9` at random moments: the command is killed, run again, and must end as if nothing had happened.

Run it with `make killed`, or `python -m benchmarks.hostile.killed COUNT`: so many kills of `simulate` (then again with
--force) and of `optimize` (then --resume). Looked at after each kill: is every file that is there whole? And after the
second run: is the exit status 0, are all answers known that the journal had, and are best.toml, or mesh and summary,
those of a run that nobody killed?
"""

from __future__ import annotations

import csv
import json
import os
import random
import re
import signal
import subprocess
import sys
import tempfile
import time
import tomllib
from collections import Counter
from pathlib import Path
from typing import Any

import meshio

_SCENE = """
[parison]
shape = "disc"
radius = 0.1
elements = 120
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
segments = 48
[solver]
end_time = 0.2
damping = 100.0
[output]
frames = 8
"""
_STUDY = """
scene = "scene.toml"
[[variable]]
kind = "thickness-profile"
along = "radius"
knots = 4
bounds = [5.0e-4, 2.0e-3]
[objective]
kind = "target"
thickness = 6.0e-4
[solver]
method = "lbfgs"
warm_start = 2
iterations = 8
"""
_AGAIN = {"simulate": "--force", "optimize": "--resume"}
_SOURCE = {"simulate": "scene.toml", "optimize": "study.toml"}
_TIMED = re.compile(r"seconds|^design$")  # of a summary, what differs from run to run


def kills(folder: Path, command: str, count: int, seed: int = 1) -> Counter[str]:
    """Kills a command so many times.

    Args:
        folder: Folder of scene, study and results.
        command: "simulate" or "optimize".
        count: Number of kills.
        seed: Seed of the random moments.

    Returns:
        How many were killed before their end, had written results, left a file that is not whole, failed when they were
        run again, lost an answer, or ended differently; and how many answers were known in all.
    """
    _run(folder, command, "whole").wait()
    begun = time.perf_counter()
    whole = _run(folder, command, "whole", "--force")
    whole.wait()
    seconds = time.perf_counter() - begun
    expected, moments, found = _outcome(folder / "whole"), random.Random(seed), Counter(kills=count)
    for number in range(count):
        name = f"{command}-{number}"
        process = _run(folder, command, name)
        try:
            process.wait(moments.uniform(0.0, seconds))
        except subprocess.TimeoutExpired:
            os.kill(process.pid, signal.SIGKILL)
            found["before the end"] += 1
        process.communicate()
        out = folder / name
        found["with results"] += out.is_dir() and any(not file.name.startswith(".") for file in out.iterdir())
        found["files not whole"] += len(halves(out))
        answers = _answers(out)
        again = _run(folder, command, name, _AGAIN[command])
        words = again.communicate()[0]
        known = re.search(r"(\d+) answers were known", words)
        found["failed again"] += again.returncode != 0
        found["answers lost"] += command == "optimize" and answers > int(known[1] if known else 0)
        found["answers known"] += answers
        found["different"] += again.returncode != 0 or _outcome(out) != expected
    return found


def _run(folder: Path, command: str, name: str, *options: str) -> subprocess.Popen[str]:
    words = [sys.executable, "-m", "jaxform.cli", command, _SOURCE[command], "--out", name, *options]
    return subprocess.Popen(
        words,
        cwd=folder,
        env=os.environ | {"XDG_CACHE_HOME": str(folder / "cache"), "PYTHONPATH": os.pathsep.join(sys.path)},
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )


def halves(out: Path) -> list[str]:
    """Files of results that are there and not whole."""
    readers = {
        ".json": lambda path: json.loads(path.read_text()),
        ".toml": lambda path: tomllib.loads(path.read_text()),
        ".vtu": meshio.read,
        ".csv": _table,
        ".pvd": lambda path: path.read_text().rindex("</VTKFile>"),
    }
    bad = []
    for path in sorted(out.rglob("*")) if out.is_dir() else []:
        if path.suffix not in readers or path.name.startswith("."):
            continue
        try:
            readers[path.suffix](path)
        except (Exception, SystemExit):
            bad.append(path.name)
    return bad


def _table(path: Path) -> None:
    with path.open(newline="") as file:
        rows = list(csv.reader(file))
    if not path.read_text().endswith("\n") or len({len(row) for row in rows}) != 1:
        raise ValueError("a row is cut")


def _answers(out: Path) -> int:
    """Whole answers in the journal that a kill left."""
    path = out / "search.jsonl"
    return max(path.read_bytes().count(b"\n") - 1, 0) if path.exists() else 0


def _outcome(out: Path) -> dict[str, Any]:
    """Results that must not depend on kills: the best design, the mesh, and the summary without times."""
    summary = json.loads((out / "summary.json").read_text())
    same: dict[str, Any] = {key: value for key, value in summary.items() if not _TIMED.search(key)}
    # Killed before its first answer, a search has nothing to go on with, and says so.
    same["warnings"] = [sentence for sentence in summary["warnings"] if not sentence.startswith("--resume")]
    same["mesh"] = (out / "final.vtu").read_bytes()
    same["best"] = (out / "best.toml").read_text() if (out / "best.toml").exists() else ""
    same["frames"] = sorted(path.name for path in (out / "frames").glob("*.vtu"))
    return same


def main(names: list[str]) -> int:
    """Prints a row for each command; 1 where anything was lost."""
    count, bad = int(names[0]) if names else 40, 0
    columns = ("kills", "before the end", "with results", "files not whole", "failed again", "answers known",
               "answers lost", "different")  # fmt: skip
    print("| command | " + " | ".join(columns) + " |")
    print("|---|" + "---|" * len(columns))
    for command in _AGAIN:
        with tempfile.TemporaryDirectory() as name:
            folder = Path(name)
            (folder / "scene.toml").write_text(_SCENE)
            (folder / "study.toml").write_text(_STUDY)
            found = kills(folder, command, count)
        bad += sum(found[key] for key in ("files not whole", "failed again", "answers lost", "different"))
        print(f"| {command} | " + " | ".join(str(found[column]) for column in columns) + " |", flush=True)
    return int(bad > 0)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))

"""Damaged input in thousands: nothing may end in a traceback, hang, or take memory without bounds.

`make fuzz` writes scene and study files, meshes and caches, each with a few places changed at random but the same in
every run, and gives them to `jaxform check`, or to what it does before it compiles a step, in worker processes that
watch time and memory. What is asked: 0 tracebacks, 0 commands over 30 s, 0 over 2 GB.
`python -m benchmarks.hostile.fuzz meshes=100` runs that many of one kind; `meshes:17` one case, in this process.

A new kind of input is a function in KINDS: it writes a damaged input into a folder and returns the command's
arguments.
"""

from __future__ import annotations

import collections
import contextlib
import io
import json
import os
import random
import subprocess
import sys
import tempfile
import threading
import time
import traceback
import warnings
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

from benchmarks.hostile import fuzz_inputs

MOST_SECONDS, MOST_BYTES = 30.0, 2_000_000_000
_ROOM = 6_000_000_000  # of memory for a worker: so that what runs away does not take the machine with it
_CASES_PER_WORKER = 100  # programs that were compiled stay in a process

Make = Callable[[random.Random, Path], list[str]]
KINDS: dict[str, tuple[int, Make]] = {
    "files": (2000, fuzz_inputs.damaged_file),
    "meshes": (1000, fuzz_inputs.damaged_mesh),
    "caches": (100, fuzz_inputs.damaged_cache),
}
"""Number of cases of each kind, and the function that makes one."""


_SELDOM = {"files": 20, "meshes": 20}
"""Kinds of which one in so many is given to `check`: it compiles a step, which takes ten times as long as the rest."""


def run_case(kind: str, number: int) -> dict[str, Any]:
    """One command with damaged input, in this process: its exit status, or the traceback; seconds (of CPU), bytes more.

    The bytes are the most in use at once beyond those in use before.
    """
    with tempfile.TemporaryDirectory() as folder:
        arguments = KINDS[kind][1](random.Random(f"{kind} {number}"), Path(folder))
        if arguments[0] == "check" and kind in _SELDOM and number % _SELDOM[kind]:
            arguments[0] = "scene"
        _forget_peak()
        begin, before = time.process_time(), _peak()
        outcome = _outcome(arguments)
        seconds = time.process_time() - begin
    return {"kind": kind, "number": number, **outcome, "seconds": seconds, "bytes": _peak() - before}


def _outcome(arguments: list[str]) -> dict[str, Any]:
    from jaxform.cli import command
    from jaxform.core.errors import InputWarning

    out, err = io.StringIO(), io.StringIO()
    try:
        with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err), warnings.catch_warnings():
            # Warnings of doubtful input; all others are printed, which counts as a fault.
            warnings.simplefilter("ignore", InputWarning)
            status = command.main(arguments) if arguments[0] == "check" else _load(*arguments)
    except BaseException:
        return {"status": -1, "words": traceback.format_exc()}
    lines = [line for line in err.getvalue().splitlines() if not line.startswith("jaxform: warning: ")]
    if status not in (0, 2) or (status == 2 and len(lines) != 1):
        return {"status": -1, "words": f"status {status}, {len(lines)} lines on standard error: {lines[:5]}"}
    return {"status": status, "words": "\n".join(lines)}


def _load(what: str, path: str) -> int:
    """Does what a command does before it compiles a step."""
    import optimize
    from jaxform.core.errors import InputError
    from jaxform.io import files

    try:
        if what == "study":
            optimize.load_study(path)
        else:
            document = files.read_scene(path)
            files.read_reference(document)
            files.build(document)
    except InputError as error:
        print(error, file=sys.stderr)
        return 2
    return 0


def _forget_peak() -> None:
    with contextlib.suppress(OSError):
        Path("/proc/self/clear_refs").write_text("5")


def _peak() -> int:
    """Most bytes in use since `_forget_peak`, where the system tells."""
    with contextlib.suppress(OSError):
        for line in Path("/proc/self/status").read_text().splitlines():
            if line.startswith("VmHWM:"):
                return 1024 * int(line.split()[1])
    return 0


def run_worker(kind: str, numbers: list[int]) -> Iterator[dict[str, Any]]:
    """Cases in a process of their own, which is ended when one takes too long; the rest go to another."""
    while numbers:
        command = [sys.executable, "-m", "benchmarks.hostile.fuzz", "--worker", kind, *map(str, numbers)]
        with (
            tempfile.TemporaryFile("w+") as errors,
            subprocess.Popen(command, stdout=subprocess.PIPE, stderr=errors, text=True, env=_environment()) as worker,
        ):
            assert worker.stdout is not None
            watch = _Watch(worker)
            for line in worker.stdout:
                watch.rest()
                done = json.loads(line)
                if "begin" not in done:
                    numbers = numbers[1:]
                    yield done
            watch.stop()
            worker.wait()
            errors.seek(0)
            words = (
                "over time" if watch.fired else f"the process ended with {worker.returncode}: {errors.read()[-2000:]}"
            )
        if numbers:
            hung = {"seconds": MOST_SECONDS if watch.fired else 0.0, "bytes": 0, "words": words}
            yield {"kind": kind, "number": numbers[0], "status": -2 if watch.fired else -1, **hung}
            numbers = numbers[1:]


def _environment() -> dict[str, str]:
    """The environment of the commands, in which cases share compiled programs."""
    programs = {
        "JAX_COMPILATION_CACHE_DIR": str(fuzz_inputs.CACHE / "programs"),
        "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0",
        "JAX_PERSISTENT_CACHE_MIN_ENTRY_SIZE_BYTES": "0",
    }
    return {**os.environ, **programs}


class _Watch:
    """Ends a process that works on one thing for too long, or sleeps; on a busy machine it may wait for its turn."""

    def __init__(self, worker: subprocess.Popen[str]) -> None:
        self.fired, self._worker = False, worker
        self._begin, self._asleep, self._ended = 0.0, 0, threading.Event()
        self.rest()
        threading.Thread(target=self._look, daemon=True).start()

    def rest(self) -> None:
        self._begin, self._asleep = _state(self._worker.pid)[1], 0

    def stop(self) -> None:
        self._ended.set()

    def _look(self) -> None:
        before = self._begin
        while not self._ended.wait(1.0):
            state, seconds = _state(self._worker.pid)
            self._asleep = self._asleep + 1 if state == "S" and seconds == before else 0
            before = seconds
            if seconds - self._begin > MOST_SECONDS + 5 or self._asleep > 2 * MOST_SECONDS:
                self.fired = True
                self._worker.kill()
                return


def _state(process: int) -> tuple[str, float]:
    """State of a process, R for running or S for sleeping, and its CPU time [s]."""
    try:
        facts = Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()
    except OSError:
        return "", 0.0
    return facts[0], (int(facts[11]) + int(facts[12])) / os.sysconf("SC_CLK_TCK")


def _work(kind: str, numbers: list[int]) -> None:
    """The worker: a line of JSON for each case."""
    import resource

    import jax

    import jaxform.io.files  # noqa: F401  (so that the first case is not charged with it)

    jax.config.update("jax_enable_x64", True)
    used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (used + _ROOM, used + _ROOM))
    told = os.fdopen(os.dup(1), "w")
    for number in numbers:
        print(json.dumps({"begin": number}), file=told, flush=True)
        print(json.dumps(run_case(kind, number)), file=told, flush=True)


def run(wanted: dict[str, int], workers: int = 2, first: int = 0) -> list[dict[str, Any]]:
    """So many cases of each kind, in workers; prints what went wrong as it comes."""
    batches = [
        (kind, list(range(begin, min(begin + _CASES_PER_WORKER, first + count))))
        for kind, count in wanted.items()
        for begin in range(first, first + count, _CASES_PER_WORKER)
    ]

    def work(batch: tuple[str, list[int]]) -> list[dict[str, Any]]:
        found = []
        for case in run_worker(*batch):
            found.append(case)
            if faults(case):
                print(f"{case['kind']}:{case['number']} {', '.join(faults(case))}\n{case['words']}", flush=True)
        return found

    fuzz_inputs.prepare()
    with ThreadPoolExecutor(workers) as pool:
        return [case for cases in pool.map(work, batches) for case in cases]


def faults(case: dict[str, Any]) -> list[str]:
    """Faults of a case."""
    marks = {
        "traceback": case["status"] == -1,
        "hang": case["status"] == -2 or case["seconds"] > MOST_SECONDS,
        "memory": case["bytes"] > MOST_BYTES,
    }
    return [name for name, there in marks.items() if there]


def main(arguments: list[str]) -> int:
    """Prints a table: how many of each kind, what came of them, the longest time and the most memory."""
    if arguments[:1] == ["--worker"]:
        _work(arguments[1], list(map(int, arguments[2:])))
        return 0
    if arguments and ":" in arguments[0]:
        kind, number = arguments[0].split(":")
        fuzz_inputs.prepare()
        print(json.dumps(run_case(kind, int(number)), indent=2).replace("\\n", "\n"))
        return 0
    wanted = {kind: count for kind, (count, _) in KINDS.items()}
    if unknown := {part.partition("=")[0] for part in arguments} - set(KINDS):
        print(f"there are {', '.join(KINDS)}, but not {', '.join(sorted(unknown))}")
        return 2
    if arguments:
        wanted = {kind: int(count or wanted[kind]) for kind, _, count in (part.partition("=") for part in arguments)}
    begin = time.time()
    cases = run(wanted)
    print("kind     cases  done  refused  tracebacks  hangs  over 2 GB  longest  most memory")
    wrong = 0
    for kind in wanted:
        own = [case for case in cases if case["kind"] == kind]
        status = collections.Counter(case["status"] for case in own)
        marks = collections.Counter(mark for case in own for mark in faults(case))
        wrong += sum(marks.values())
        longest, most = max(case["seconds"] for case in own), max(case["bytes"] for case in own)
        print(
            f"{kind:8} {len(own):5} {status[0]:5} {status[2]:8} {marks['traceback']:11} {marks['hang']:6} "
            f"{marks['memory']:10} {longest:6.1f} s {most / 1e6:9.0f} MB"
        )
    print(f"in {(time.time() - begin) / 60:.1f} minutes")
    return int(wrong > 0)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))

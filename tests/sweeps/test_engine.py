"""The engine of a sweep: what fails or is killed is one outcome, and what is done is not done again."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections import Counter
from concurrent.futures import CancelledError, Executor, Future, ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pytest

import jaxform
from jaxform.sweeps import workers
from jaxform.sweeps.workers import LocalWorkers, Outcome, evaluate

ROOT = Path(__file__).parents[2]
Task = tuple[int, str, str]


def note(folder: str, number: int) -> int:
    """Notes that a task is computed; returns how often it was, this time included."""
    with (Path(folder) / f"{number}.log").open("ab", buffering=0) as file:
        file.write(b"%d\n" % os.getpid())
    return (Path(folder) / f"{number}.log").read_text().count("\n")


def compute(task: Task) -> Any:
    """The square of a number, or what else the task says happens."""
    number, what, folder = task
    times = note(folder, number)
    if what == "raise":
        raise ValueError("two\nlines")
    if what == "refuse":
        raise jaxform.InputError("is wrong", "mend it", "material.c", -1, "scene.toml")
    if what == "memory":
        raise MemoryError
    if what == "local":
        return lambda: None
    if what == "own":
        return Outcome("burst", number)
    if what == "die" or (what == "die once" and times == 1):
        os.kill(os.getpid(), signal.SIGKILL)
    if what == "slow":
        time.sleep(60.0)
    if what == "starve":
        import resource

        used = int(Path("/proc/self/statm").read_text().split()[0]) * os.sysconf("SC_PAGE_SIZE")
        resource.setrlimit(resource.RLIMIT_AS, (used + (1 << 27), resource.getrlimit(resource.RLIMIT_AS)[1]))
        return len(jaxform.shapes.disc(radius=0.1, elements=2_000_000).triangles)
    return number**2


def _tasks(folder: Path, **special: str) -> list[Task]:
    return [(k, special.get(f"n{k}", ""), str(folder)) for k in range(8)]


def _times(folder: Path) -> Counter[int]:
    return Counter({int(path.stem): path.read_text().count("\n") for path in folder.glob("*.log")})


def _evaluate(tasks: list[Task], workers: int = 2) -> dict[int, Outcome]:
    with LocalWorkers(workers) as executor:
        found = list(evaluate(compute, tasks, executor))
    assert sorted(place for place, _ in found) == list(range(len(tasks)))
    return dict(found)


def test_what_fails_is_named_and_the_others_go_on(tmp_path: Path) -> None:
    tasks = _tasks(tmp_path, n1="raise", n2="refuse", n3="memory", n4="local", n5="own")
    found = _evaluate(tasks)
    assert {k: found[k].value for k in (0, 6, 7)} == {0: 0, 6: 36, 7: 49}
    assert found[0].status == "ok" and found[1].status == "ValueError: two lines"
    assert found[2].status == "material.c = -1: is wrong; mend it"
    assert "not enough memory" in found[3].status and "pickle" in found[4].status
    assert (found[5].status, found[5].value) == ("burst", 5)


def test_a_process_that_is_killed_loses_one_call_which_is_repeated_once(tmp_path: Path) -> None:
    found = _evaluate(_tasks(tmp_path, n2="die once", n5="die"))
    assert found[5] == Outcome(workers.LOST)
    assert {k: one.value for k, one in found.items() if k != 5} == {k: k**2 for k in range(8) if k != 5}
    assert _times(tmp_path) == Counter({k: 2 if k in (2, 5) else 1 for k in range(8)})


def test_with_one_worker_it_is_the_same(tmp_path: Path) -> None:
    found = _evaluate(_tasks(tmp_path, n0="die", n7="die once"), workers=1)
    assert found[0].status == workers.LOST and found[7].value == 49
    assert _times(tmp_path) == Counter({k: 2 if k in (0, 7) else 1 for k in range(8)})


@pytest.mark.skipif(not Path("/proc/self/statm").exists(), reason="needs Linux")
def test_a_mesh_that_is_too_large_for_the_memory_is_a_row(tmp_path: Path) -> None:
    found = _evaluate(_tasks(tmp_path, n3="starve"))
    assert "not enough memory" in found[3].status and found[3].value is None
    assert {k: one.value for k, one in found.items() if k != 3} == {k: k**2 for k in range(8) if k != 3}


@pytest.mark.parametrize(
    ("error", "words"),
    [
        (CancelledError("0a cancelled\nthe connection is lost"), r"accepts no more tasks \(the connection is lost\)"),
        (ModuleNotFoundError("No module named 'jaxform'", name="jaxform"), "has a worker that lacks this program"),
        (ModuleNotFoundError("No module named 'jaxform.x'", name="jaxform.x"), "has a worker that lacks this program"),
    ],
)
def test_what_is_wrong_with_all_workers_ends_the_sweep(error: Exception, words: str, tmp_path: Path) -> None:
    class Broken(Executor):
        def submit(self, fn: Any, /, *args: Any, **kwargs: Any) -> Future[Any]:
            future: Future[Any] = Future()
            future.set_exception(error)
            return future

    with pytest.raises(jaxform.InputError, match=words):
        list(evaluate(compute, _tasks(tmp_path), Broken()))


def test_executors_of_others_do(tmp_path: Path) -> None:
    with ThreadPoolExecutor(3) as executor:
        found = dict(evaluate(compute, _tasks(tmp_path, n1="raise"), executor))
    assert found[1].status.startswith("ValueError") and found[3].value == 9
    with pytest.raises(jaxform.InputError, match="accepts no more tasks"):
        list(evaluate(compute, _tasks(tmp_path), executor))


def limits(_: int) -> list[str | None]:
    return [os.environ.get(name) for name in ("NPROC", "OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS")]


def test_workers_share_the_cores(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("jaxform.sweeps.workers.usable_cores", lambda: 7)
    monkeypatch.setenv("OMP_NUM_THREADS", "5")
    with LocalWorkers(3) as executor:
        found = [outcome.value for _, outcome in evaluate(limits, [0, 1], executor)]
    assert found == [["2", "2", "2"]] * 2
    assert os.environ["OMP_NUM_THREADS"] == "5" and "NPROC" not in os.environ


_CLIENT = """
import sys
from tests.sweeps.test_engine import compute
from jaxform.sweeps.workers import LocalWorkers, evaluate
if __name__ == "__main__":
    tasks = [(0, "slow", sys.argv[1]), (1, "slow", sys.argv[1])]
    with LocalWorkers(2) as executor:
        list(evaluate(compute, tasks, executor))
"""


def _running(pid: int) -> bool:
    try:
        os.kill(pid, 0)
        return not Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].startswith(" Z")
    except OSError:
        return False


@pytest.mark.skipif(not hasattr(signal, "SIGKILL"), reason="there is no such signal")
@pytest.mark.parametrize("how", ["SIGKILL", pytest.param("SIGINT", marks=pytest.mark.long)])
def test_workers_end_with_the_process_that_began(tmp_path: Path, how: str) -> None:
    (tmp_path / "client.py").write_text(_CLIENT)
    command = [sys.executable, str(tmp_path / "client.py"), str(tmp_path)]
    known = os.environ | {"PYTHONPATH": str(ROOT)}
    with subprocess.Popen(command, env=known, stderr=subprocess.DEVNULL, start_new_session=True) as client:
        while sum(_times(tmp_path).values()) < 2:
            assert client.poll() is None
            time.sleep(0.05)
        workers = [int(path.read_text()) for path in tmp_path.glob("*.log")]
        assert all(map(_running, workers))
        os.killpg(client.pid, signal.SIGINT) if how == "SIGINT" else client.kill()
        client.wait(timeout=120)
    patience = time.monotonic() + 120
    while any(map(_running, workers)):
        assert time.monotonic() < patience
        time.sleep(0.05)

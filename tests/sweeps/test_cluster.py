"""A sweep on a Dask cluster, one worker of which is killed: nothing is lost, and nothing recorded is computed again."""

from __future__ import annotations

import logging
import os
import signal
import time
from importlib.metadata import PackageNotFoundError
from pathlib import Path
from types import SimpleNamespace
from typing import Any, ClassVar

import pytest

import jaxform
from jaxform.core.errors import redirect_warnings
from jaxform.sweeps import workers
from tests.sweeps.test_engine import note

distributed = pytest.importorskip("distributed")
dask = pytest.importorskip("dask")
pytestmark = pytest.mark.filterwarnings("ignore")  # those of Dask are its own


def compute(task: tuple[int, str]) -> int:
    """The square of a number, after a moment; every tenth fails."""
    number, folder = task
    note(folder, number)
    time.sleep(0.2)
    if number % 10 == 3:
        raise ValueError(f"number {number} diverges")
    return number**2


def _count(folder: Path, number: int) -> int:
    return (folder / f"{number}.log").read_text().count("\n")


@pytest.fixture(scope="module")
def cluster() -> Any:
    logging.getLogger("distributed").setLevel(logging.CRITICAL)
    with distributed.LocalCluster(2, threads_per_worker=1, dashboard_address=None) as cluster:
        yield cluster


@pytest.fixture(scope="module")
def address(cluster: Any) -> str:
    return cluster.scheduler_address


@pytest.mark.long
def test_a_killed_worker_costs_nothing_that_is_recorded(address: str, tmp_path: Path) -> None:
    with workers.connect(address) as executor:
        pids = list(executor._client.run(os.getpid).values())
        recorded: dict[int, int] = {}
        outcomes: dict[int, workers.Outcome] = {}
        for place, outcome in workers.evaluate(compute, [(k, str(tmp_path)) for k in range(40)], executor):
            assert place not in outcomes
            outcomes[place], recorded[place] = outcome, _count(tmp_path, place)
            if len(outcomes) == 8:
                os.kill(pids[0], signal.SIGKILL)
    assert sorted(outcomes) == list(range(40))
    for k, outcome in outcomes.items():
        failed = k % 10 == 3
        assert outcome.value == (None if failed else k**2)
        assert outcome.status == (f"ValueError: number {k} diverges" if failed else "ok")
    assert {k: _count(tmp_path, k) for k in outcomes} == recorded


def test_a_client_is_an_executor(address: str, tmp_path: Path) -> None:
    with distributed.Client(address) as client:
        found = jaxform.sweep(["dish-coarse", {"solver.safety": -1.0}], _name, scene="dish-coarse", executor=client)
        assert client.status == "running"
    assert [outcome.value for outcome in found] == ["dish-coarse", None]
    assert "solver.safety = -1.0" in found[1].status


def test_a_cluster_without_workers_is_waited_for_aloud(
    address: str, cluster: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(workers, "_PATIENCE", 0.5)
    cluster.scale(0)
    told: list[str] = []

    def tell(sentence: str) -> None:
        told.append(sentence)
        cluster.scale(2)

    with workers.connect(address) as executor, redirect_warnings(tell):
        while executor._client.nthreads():
            time.sleep(0.05)
        found = dict(workers.evaluate(compute, [(k, str(tmp_path)) for k in range(4)], executor))
    assert len(told) == 1 and f"'{address}': has no workers yet" in told[0] and f"dask worker {address}" in told[0]
    assert [found[k].value for k in range(4)] == [0, 1, 4, None]


def test_workers_with_another_jaxform_or_none_are_named(address: str, monkeypatch: pytest.MonkeyPatch) -> None:
    class Bare:
        scheduler = SimpleNamespace(address="tcp://there:8786")
        answers: ClassVar[dict[str, Any]] = {"tcp://a:1": PackageNotFoundError("jaxform"), "tcp://b:1": OSError("gone")}

        def nthreads(self) -> dict[str, int]:
            return dict.fromkeys(self.answers, 1)

        def run(self, *_: Any, workers: list[str], on_error: str) -> dict[str, Any]:
            assert on_error == "return"
            return {worker: self.answers[worker] for worker in workers}

    with pytest.raises(jaxform.InputError, match=r"tcp://there:8786.*a worker, tcp://a:1, with no jaxform, and this"):
        workers.DaskWorkers(Bare())
    del Bare.answers["tcp://a:1"]
    workers.DaskWorkers(Bare())  # what does not answer has just ended
    monkeypatch.setattr(workers.installation, "version", lambda: "9.9")
    with pytest.raises(jaxform.InputError, match=r"with jaxform [\d.]+, and this process has jaxform 9\.9; install"):
        workers.connect(address)


def fill(task: tuple[int, str]) -> int:
    """A number; the third takes memory until it is killed for it."""
    number, folder = task
    note(folder, number)
    taken = []
    while number == 2:
        taken.append(bytearray(b"x") * (1 << 26))
        time.sleep(0.05)
    return number


def test_a_worker_that_its_cluster_kills_for_its_memory_is_a_row(tmp_path: Path) -> None:
    options: dict[str, Any] = {"threads_per_worker": 1, "dashboard_address": None, "memory_limit": "900MB"}
    with dask.config.set({"distributed.scheduler.allowed-failures": 0}), distributed.LocalCluster(1, **options) as one:
        with workers.connect(one.scheduler_address) as executor:
            found = dict(workers.evaluate(fill, [(k, str(tmp_path)) for k in range(4)], executor))
    assert found[2] == workers.Outcome(workers.LOST) and "lack of memory" in workers.LOST
    assert [found[k].value for k in (0, 1, 3)] == [0, 1, 3]
    assert _count(tmp_path, 2) == 2  # once more, alone


def _name(scene: jaxform.Scene) -> str:
    return scene.name


@pytest.mark.long
def test_without_a_scheduler_there_is_one_line() -> None:
    with pytest.raises(jaxform.InputError, match=r"--scheduler = 'tcp://127.0.0.1:9': cannot be reached"):
        workers.connect("tcp://127.0.0.1:9")

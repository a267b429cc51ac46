"""A sweep on a Dask cluster, one worker of which is killed: nothing is lost, and nothing recorded is computed again."""

from __future__ import annotations

import logging
import os
import signal
import time
from pathlib import Path
from typing import Any

import pytest

import jaxform
from jaxform.sweeps import engine, workers
from tests.sweeps.test_engine import note

distributed = pytest.importorskip("distributed")
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
def address() -> Any:
    logging.getLogger("distributed").setLevel(logging.CRITICAL)
    with distributed.LocalCluster(2, threads_per_worker=1, dashboard_address=None) as cluster:
        yield cluster.scheduler_address


def test_a_killed_worker_costs_nothing_that_is_recorded(address: str, tmp_path: Path) -> None:
    with workers.connect(address) as executor:
        pids = list(executor._client.run(os.getpid).values())
        recorded: dict[int, int] = {}
        outcomes: dict[int, engine.Outcome] = {}
        for place, outcome in engine.evaluate(compute, [(k, str(tmp_path)) for k in range(40)], executor):
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


def _name(scene: jaxform.Scene) -> str:
    return scene.name


def test_without_a_scheduler_there_is_one_line() -> None:
    with pytest.raises(jaxform.InputError, match=r"--scheduler = 'tcp://127.0.0.1:9': cannot be reached"):
        workers.connect("tcp://127.0.0.1:9")

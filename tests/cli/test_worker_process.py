"""The process beside a command: what it is asked for is done, there or here."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from jaxform.cli import command
from jaxform.cli.worker_process import WorkerCaller, make_caller


def _note(path: Path) -> None:
    """Says in which process it was called."""
    path.write_text(str(os.getpid()))


def _fail_elsewhere(path: Path, own: int) -> None:
    if os.getpid() != own:
        raise MemoryError
    _note(path)


def test_what_it_is_asked_for_is_done_there_and_what_it_cannot_do_here(tmp_path: Path) -> None:
    path, own = tmp_path / "note", str(os.getpid())
    with make_caller("json", "JSONDecoder", wanted=True) as ask:
        if not isinstance(ask, WorkerCaller):
            pytest.skip("one core")
        ask.start_call(_note, path)()
        assert path.read_text() not in ("", own)
        ask.start_call(_fail_elsewhere, path, os.getpid())()
        assert path.read_text() == own
        path.unlink()
        ask.start_call(lambda: _note(path))()  # cannot be sent
        assert path.read_text() == own
        with pytest.raises(FileNotFoundError):
            ask.start_call(_note, tmp_path / "nowhere" / "note")()
        ask.start_call(_note, path)()  # it goes on after a failure
        assert path.read_text() != own


def test_what_it_is_asked_for_after_its_end_is_done_here(tmp_path: Path) -> None:
    other = WorkerCaller("json", "JSONDecoder")
    other.end()
    other.start_call(_note, tmp_path / "note")()
    assert (tmp_path / "note").read_text() == str(os.getpid())


def test_none_is_started_where_none_is_wanted() -> None:
    with make_caller("json", "JSONDecoder", wanted=False) as ask:
        assert not isinstance(ask, WorkerCaller) and not ask.elsewhere


@pytest.mark.long
def test_a_command_of_its_own_process_writes_the_same_picture(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    words = ["simulate", "cup-fast", "--quiet", "--out"]
    whole = [sys.executable, "-m", "jaxform.cli", *words, str(tmp_path / "there")]
    done = subprocess.run(whole, capture_output=True, text=True)
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")
    assert command.main([*words, str(tmp_path / "here")]) == 0
    one, other = (np.asarray(Image.open(tmp_path / place / "thickness.png")) for place in ("there", "here"))
    # Programs are compiled otherwise here, so that numbers differ by rounding.
    assert one.shape == other.shape and np.mean(one != other) < 1e-3

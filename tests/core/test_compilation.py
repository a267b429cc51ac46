"""Programs that a script compiles are there for the next process."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

import jaxform
from tests import scenes

_SCRIPT = """
import sys
import jax
import jax.numpy as jnp
import jaxform

seen = []
jax.monitoring.register_event_listener(lambda event, **_: seen.append(event.rpartition("/")[2]))
jnp.arange(3.0)  # compiled before it was asked for: JAX would settle that nothing is kept
before = jaxform.keep_programs(*sys.argv[1:])
assert jaxform.keep_programs() == before
del seen[:]
print(float(jax.jit(lambda x: jnp.sum(jnp.sin(x) * 3.7))(jnp.ones(17))))
print(before, seen.count("cache_hits"), seen.count("cache_misses"))
"""


def _run(*arguments: str, **environment: str) -> tuple[str, list[str]]:
    known = {name: value for name, value in os.environ.items() if not name.startswith("JAX_")}
    root = str(Path(__file__).parents[2])
    command = [sys.executable, "-W", "error", "-c", _SCRIPT, *arguments]
    known |= {"PYTHONPATH": root, **environment}
    done = subprocess.run(command, capture_output=True, text=True, env=known, timeout=300, check=False)
    assert done.returncode == 0, done.stderr[-3000:]
    value, said = done.stdout.splitlines()
    return value, said.split()


@pytest.mark.parametrize("named", scenes.short_first([False, True]))
def test_programs_of_a_script_are_found_by_the_next_process(tmp_path: Path, named: bool) -> None:
    folder = tmp_path / "own" if named else tmp_path / "jaxform" / "compiled"
    arguments = [str(folder)] if named else []
    first, before = _run(*arguments, XDG_CACHE_HOME=str(tmp_path))
    second, after = _run(*arguments, XDG_CACHE_HOME=str(tmp_path))
    assert first == second
    assert before[0] == after[0] == str(folder)
    assert before[1] == "0" and int(before[2]) > 0
    assert after[2] == "0" and int(after[1]) == int(before[2])
    assert folder.stat().st_mode & 0o077 == 0
    # A file that somebody else has put there under a known name is not run.
    for program in folder.glob("*-cache"):
        program.write_bytes(b"another")
    assert _run(*arguments, XDG_CACHE_HOME=str(tmp_path))[0] == first


def test_where_jax_keeps_programs_already_they_stay(tmp_path: Path) -> None:
    _, said = _run(JAX_COMPILATION_CACHE_DIR=str(tmp_path / "its"), XDG_CACHE_HOME=str(tmp_path))
    assert said[0] == str(tmp_path / "its") and list((tmp_path / "its").glob("*-cache"))
    assert not (tmp_path / "jaxform").exists()


def test_a_folder_that_cannot_be_made_is_refused(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    for name in (str(tmp_path / "file"), "a\0b"):
        with pytest.raises(jaxform.InputError, match=r"^folder = .*cannot be written.*choose another folder"):
            jaxform.keep_programs(name)

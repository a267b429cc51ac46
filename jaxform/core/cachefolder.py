"""The cache folder of the command between runs: a folder that only the user can write to."""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import stat
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from jaxform.core.errors import warn_of

COMPILED, MADE = "compiled", "made"
_RECORD = "record.json"


def user_cache_folder() -> Path | None:
    """`jaxform` in the user's cache folder, with a folder for compiled programs and one for what else was made.

    None where there is no home, it cannot be written, or somebody else could put something into it: programs that are
    kept there are run.
    """
    try:
        named = os.environ.get("XDG_CACHE_HOME", "")
        # One that is not absolute is to be passed over, says the standard that named it.
        folder = (Path(named) if os.path.isabs(named) else Path.home() / ".cache") / "jaxform"
        for place in (folder, folder / COMPILED, folder / MADE):
            place.mkdir(mode=0o700, parents=True, exist_ok=True)
            if not _belongs_to_user(place):
                problem = "is not used as a cache: others own it or can write to it"
                warn_of(problem, "make it yours alone (chown, chmod go-w), or remove it", value=str(place))
                return None
    # Without HOME, a user whom the system does not know has none.
    except (OSError, RuntimeError, ValueError):
        return None
    return folder


def _belongs_to_user(folder: Path) -> bool:
    if not hasattr(os, "geteuid"):
        return True
    status = folder.stat()
    return status.st_uid == os.geteuid() and not status.st_mode & (stat.S_IWGRP | stat.S_IWOTH)


@contextlib.contextmanager
def guard_folder(folder: Path) -> Iterator[None]:
    """Sees to it that JAX finds under each name in a folder what it wrote there itself.

    JAX believes what it reads: a program under the name of another would be run. What differs in size or date from
    what was there at the end of the last run is removed, so that it is compiled anew; all of it, where the record of
    that is damaged.
    """
    record = folder / _RECORD
    known = _read(record)
    for name, facts in _facts(folder).items():
        if known is None or known.get(name, facts) != facts:
            with contextlib.suppress(OSError):
                (folder / name).unlink()
    try:
        yield
    finally:
        with contextlib.suppress(OSError):
            fresh = record.with_suffix(f".{os.getpid()}")
            facts = _facts(folder)
            fresh.write_text(json.dumps({"seal": _checksum(facts), "facts": facts}), encoding="utf-8")
            fresh.replace(record)


def _read(record: Path) -> dict[str, Any] | None:
    """The record of the last run: empty where there is no record, None where it is damaged."""
    try:
        content = json.loads(record.read_bytes())
    except FileNotFoundError:
        return {}
    except (OSError, ValueError, RecursionError):
        return None
    whole = isinstance(content, dict) and content.get("seal") == _checksum(content.get("facts"))
    return content["facts"] if whole and isinstance(content["facts"], dict) else None


def _checksum(facts: Any) -> str:
    return hashlib.sha256(json.dumps(facts, sort_keys=True).encode()).hexdigest()


def _facts(folder: Path) -> dict[str, list[int]]:
    """Size and date of each program."""
    try:
        with os.scandir(folder) as files:
            found = {file.name: file.stat() for file in files if file.name.endswith("-cache")}
    except OSError:
        return {}
    return {name: [status.st_size, status.st_mtime_ns] for name, status in found.items()}

"""Files: bounded reads of files that a user names, atomic writes, and the cache folder."""

from __future__ import annotations

import contextlib
import errno
import hashlib
import io
import json
import os
import stat
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from jaxform.core import errors
from jaxform.core.errors import InputError, warn_of

MOST_TEXT = 32_000_000
"""Bytes of a scene, a study or a table: a thousand times what people write."""
MOST_MESH = 1_000_000_000
"""Bytes of a mesh: some four million triangles as text."""
_PAGE = 1 << 20  # read of files that do not tell their size


def expand_path(name: str | Path, folder: str | Path | None = None) -> Path:
    """The path of a name in a file or on the command line; `~` is the user's home.

    Args:
        name: As the user wrote it.
        folder: Base of a relative name; by default the working directory.

    Raises:
        InputError: The name is not valid for a file, or there is no such home folder.
    """
    text = str(name)
    if "\0" in text:
        raise InputError("contains a NUL character, which a file name cannot contain", "correct the path", value=text)
    try:
        return Path(folder or "") / Path(text).expanduser()
    except RuntimeError:
        raise InputError("names an unknown home folder", "write the whole path", value=text) from None


def is_file(path: Path) -> bool:
    """True where the path exists and is not a folder; False as well where no file can have this name."""
    return os.path.exists(path) and not os.path.isdir(path)


def read_bytes(path: Path, most: int, name: str | Path | None = None) -> bytes:
    """The content of a regular file.

    Args:
        path: The file.
        most: Bytes above which nothing is read, and the file refused.
        name: Name of the file in messages; by default its path.

    Raises:
        InputError: There is no such file, it is a folder, a device or a pipe, too large, or cannot be read.
    """
    value = str(path if name is None else name)
    try:
        status = path.stat()
        _check_kind(status, most, value)
        expected = max(status.st_size, _PAGE)
        with path.open("rb") as file:
            content = file.read(expected + 1)
    except InputError:
        raise
    except OSError as error:
        raise _unreadable(error, value) from None
    except ValueError:
        raise InputError("is not a valid file name", "correct the path", value=value) from None
    if len(content) > expected:
        raise InputError("changes while it is read", "wait until it is written", value=value)
    return content


def read_text(path: Path, most: int = MOST_TEXT, name: str | Path | None = None) -> str:
    """The text of a regular file in UTF-8, a byte order mark left out, lines ended by a line feed.

    Raises:
        InputError: As `read_bytes`, or it is not such a text.
    """
    try:
        text = read_bytes(path, most, name).decode("utf-8-sig")
    except UnicodeDecodeError:
        value = str(path if name is None else name)
        raise InputError("is not a text file in UTF-8", "save it as UTF-8", value=value) from None
    return text.replace("\r\n", "\n")


def _check_kind(status: os.stat_result, most: int, value: str) -> None:
    if stat.S_ISDIR(status.st_mode):
        raise InputError("is a folder", "name the file in it", value=value)
    if not stat.S_ISREG(status.st_mode):
        raise InputError("is a device, a pipe or a socket", "name a file", value=value)
    if status.st_size > most:
        problem = f"is too large ({status.st_size / 1e6:.4g} MB, at most {most / 1e6:.4g} MB are read)"
        raise InputError(problem, "check that it is the right file", value=value)


def _unreadable(error: OSError, value: str) -> InputError:
    if error.errno in (errno.ENOENT, errno.ENOTDIR):
        return InputError("does not exist", "correct the path", value=value)
    if error.errno == errno.ENAMETOOLONG:
        return InputError("has too long a name", "correct the path", value=value)
    return InputError(f"cannot be read ({error_reason(error)})", "check the file and its permissions", value=value)


def error_reason(error: BaseException) -> str:
    """The reason why a system call failed, in a few words."""
    return getattr(error, "strerror", None) or str(error) or type(error).__name__


# Files that are there whole or not at all: written beside their place, and moved to it when they are complete.

PREFIX = ".jaxform-"
"""Prefix of the names of incomplete files: a killed process may leave them, the next one overwrites them."""


@contextlib.contextmanager
def atomic_path(path: str | Path, next_step: str = "or choose another folder") -> Iterator[Path]:
    """Yields a temporary path; the file written there then replaces `path` completely, or not at all.

    Args:
        path: The file, replaced if it is there.
        next_step: As of `write_error`.

    Raises:
        InputError: The disk is full, the folder is gone or may not be written.
    """
    path = Path(path)
    fresh = path.with_name(PREFIX + path.name)
    try:
        yield fresh
        fresh.replace(path)
    except BaseException as error:
        with contextlib.suppress(OSError):
            fresh.unlink(missing_ok=True)
        if isinstance(error, OSError):
            raise write_error(path, error, next_step) from None
        raise


def write_error(path: str | Path, error: OSError, next_step: str) -> InputError:
    """The error in words of a file that cannot be written.

    Args:
        path: The file.
        error: The system's error, from which the first part of the remedy follows, such as "free disk space".
        next_step: The other part, after a comma: what to do then, or instead.
    """
    remedy = f"{errors.remedy_of_writing(error)}, {next_step}"
    return InputError(f"cannot be written ({error.strerror or error})", remedy, file=str(path))


def write_all(file: io.FileIO, content: bytes) -> None:
    """Writes all of the bytes; raises the system's own OSError where only some of them can be written."""
    while content:
        content = content[file.write(content) :]


# The cache folder of the command between runs: a folder that only the user can write to.

COMPILED, MADE, LOCKS = "compiled", "made", "locks"
_RECORD = "record.json"


def user_cache_folder() -> Path | None:
    """`jaxform` in the user's cache folder, with a folder for compiled programs and one for other results.

    None if there is no home, it cannot be written, or other users could write into it: programs stored there are
    executed.
    """
    try:
        named = os.environ.get("XDG_CACHE_HOME", "")
        # One that is not absolute is to be passed over, says the standard that named it.
        folder = (Path(named) if os.path.isabs(named) else Path.home() / ".cache") / "jaxform"
        for place in (folder, folder / COMPILED, folder / MADE):
            place.mkdir(mode=0o700, parents=True, exist_ok=True)
            if not _belongs_to_user(place):
                problem = "is not used as a cache: other users own it or can write to it"
                warn_of(
                    problem,
                    "make yourself its only owner and writer (chown, chmod go-w), or remove it",
                    value=str(place),
                )
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
    """Ensures that JAX reads only files of a folder that it wrote there itself.

    JAX does not verify what it reads: a program under the name of another would be executed. A file that differs in
    size or date from the record of the last run is removed, so that it is recompiled; all files, if the record is
    damaged.
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


@contextlib.contextmanager
def exclusive(folder: Path | None, name: str = "all") -> Iterator[None]:
    """Lets one process at a time inside, of those that use a cache folder on this machine.

    The end of a process releases it. Where files cannot be locked (on Windows, for example) it has no effect.
    """
    with contextlib.ExitStack() as stack:
        with contextlib.suppress(ImportError, OSError):
            import fcntl

            if folder is not None:
                (folder / LOCKS).mkdir(mode=0o700, exist_ok=True)
                file = stack.enter_context((folder / LOCKS / name).open("wb"))
                fcntl.flock(file, fcntl.LOCK_EX)
        yield


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

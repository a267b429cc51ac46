"""The one place where files that a user names are found and read, within bounds."""

from __future__ import annotations

import errno
import os
import stat
from pathlib import Path

from jaxform.core.errors import InputError

MOST_TEXT = 32_000_000
"""Bytes of a scene, a study or a table: a thousand times what people write."""
MOST_MESH = 1_000_000_000
"""Bytes of a mesh: some four million triangles as text."""
_PAGE = 1 << 20  # read of files that do not tell their size


def expand_path(name: str | Path, folder: str | Path | None = None) -> Path:
    """The path of a name in a file or on the command line; `~` is the user's home.

    Args:
        name: As the user wrote it.
        folder: What a relative name is relative to; by default the working directory.

    Raises:
        InputError: No file can have such a name, or there is no such home.
    """
    text = str(name)
    if "\0" in text:
        raise InputError("has a NUL character, which no file's name may have", "correct the path", value=text)
    try:
        return Path(folder or "") / Path(text).expanduser()
    except RuntimeError:
        raise InputError("names a home folder that is not known", "write the whole path", value=text) from None


def is_file(path: Path) -> bool:
    """True where the path exists and is not a folder; False as well where no file can have this name."""
    return os.path.exists(path) and not os.path.isdir(path)


def read_bytes(path: Path, most: int, name: str | Path | None = None) -> bytes:
    """The content of a regular file.

    Args:
        path: Where it is.
        most: Bytes above which nothing is read, and the file refused.
        name: What to call it in messages; by default its path.

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
        raise InputError("is no possible name of a file", "correct the path", value=value) from None
    if len(content) > expected:
        raise InputError("grows while it is read", "wait until it is written", value=value)
    return content


def read_text(path: Path, most: int = MOST_TEXT, name: str | Path | None = None) -> str:
    """The text of a regular file in UTF-8, a byte order mark left out, lines ended by a line feed.

    Raises:
        InputError: As `read_bytes`, or it is no such text.
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

"""Files that are there whole or not at all: written beside their place, and moved to it when they are complete."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from pathlib import Path

from jaxform.core.errors import InputError

PREFIX = ".jaxform-"
"""How names of files begin that are no results yet: what was killed may leave them, what comes next overwrites them."""


@contextlib.contextmanager
def atomic_path(path: str | Path, remedy: str = "make room, or choose another folder") -> Iterator[Path]:
    """Gives a path to write to; what was written there then replaces the file at `path`, or nothing does.

    Args:
        path: The file, replaced if it is there.
        remedy: What to do where it cannot be written, for the message.

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
            raise write_error(path, error, remedy) from None
        raise


def write_error(path: str | Path, error: OSError, remedy: str) -> InputError:
    """The error in words of a file that cannot be written."""
    return InputError(f"cannot be written ({error.strerror or error})", remedy, file=str(path))

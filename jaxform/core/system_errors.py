"""One-line descriptions of errors of the system or the machine: not of the input alone, nor of the program."""

from __future__ import annotations

import errno

from jaxform.core.errors import truncate_text

_NO_ROOM = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)


def describe_system_error(error: BaseException) -> str | None:
    """A description of the error and its remedy; None for an error that only a programmer can fix."""
    if isinstance(error, OSError):
        return _describe_os_error(error)
    if isinstance(error, RecursionError):
        return "the input is nested too deeply; simplify it"
    # XLA's is a RuntimeError, told by its words alone.
    if isinstance(error, MemoryError) or "RESOURCE_EXHAUSTED" in str(error):
        return "there is not enough memory; use fewer elements, a lower max_level or a coarser mold"
    return None


def _describe_os_error(error: OSError) -> str:
    what = " ".join((error.strerror or str(error) or type(error).__name__).split())
    place = f"{truncate_text(error.filename)}: " if isinstance(error.filename, str) else ""
    if error.errno in _NO_ROOM:
        return f"{place}{what}; make room, or choose another folder"
    if isinstance(error, FileNotFoundError):
        return f"{place}{what}; somebody has removed it meanwhile, or the folder it is in"
    return f"{place}{what}; check the file, its folder and their permissions"

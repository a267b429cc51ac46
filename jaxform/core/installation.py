"""The installed version of jaxform, and the number of processor cores to use."""

from __future__ import annotations

import os

SHARE = "NPROC"
"""Environment variable with the number of cores that a process shall use; XLA reads it, too."""


def usable_cores() -> int:
    """Number of processor cores that this process shall use: its share, or those that it may use."""
    share = os.environ.get(SHARE, "")
    if share.isdecimal() and int(share) > 0:
        return int(share)
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


# The installed version.

UNKNOWN = "of unknown version"


def version() -> str:
    """The version of the installed package."""
    from importlib import metadata  # takes a hundredth of a second, and few commands need it

    try:
        return metadata.version("jaxform")
    except metadata.PackageNotFoundError:  # on the path without being installed
        return UNKNOWN

"""The installed version of jaxform."""

from __future__ import annotations

UNKNOWN = "of unknown version"


def version() -> str:
    """The version, as the installed package tells it."""
    from importlib import metadata  # takes a hundredth of a second, and few commands need it

    try:
        return metadata.version("jaxform")
    except metadata.PackageNotFoundError:  # on the path without being installed
        return UNKNOWN

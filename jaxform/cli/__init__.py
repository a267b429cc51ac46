"""The command, a file for each part of it. It alone knows both jaxform and optimize."""

from __future__ import annotations

import contextlib
import signal
import sys
from collections.abc import Iterator, Sequence

__all__ = ["main"]

INTERRUPTED = 130


def main(argv: Sequence[str] | None = None) -> int:
    """Runs one command, that of the process where no arguments are given, and returns its exit status."""
    try:
        with defer_interrupts():
            from jaxform.cli import command
        return command.main(argv)
    except KeyboardInterrupt:
        print("jaxform: interrupted", file=sys.stderr)
        return INTERRUPTED


@contextlib.contextmanager
def defer_interrupts() -> Iterator[None]:
    """Defers Ctrl-C to its end: libraries that are being imported hide it or abort the process.

    A process that is started inside is not interrupted at all.
    """
    if not hasattr(signal, "pthread_sigmask"):
        yield
        return
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)

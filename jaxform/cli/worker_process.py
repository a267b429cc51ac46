"""A second process that draws the pictures of a command, concurrently with its other work.

Python runs one thread at a time, and to import what a picture needs takes as long as to load the programs of a run.
"""

from __future__ import annotations

import contextlib
import gc
import importlib
import multiprocessing
import pickle
import signal
from collections.abc import Callable, Iterator
from multiprocessing import resource_tracker
from multiprocessing.connection import Connection
from typing import Any

from jaxform.cli import defer_interrupts
from jaxform.core.installation import usable_cores

_NO_ANSWER = (OSError, EOFError)  # where the other process is no more


class DirectCaller:
    """Executes calls in this process, when their results are requested."""

    elsewhere = False
    """True if another process computes the calls."""

    def start_call(self, function: Callable[..., object], *arguments: Any) -> Callable[[], object]:
        """A function that executes the call and returns its result."""
        return lambda: function(*arguments)


class WorkerCaller(DirectCaller):
    """Another process that prepares for calls, then executes them one after the other.

    A call that fails there for any reason is repeated in this process, which raises its errors.

    Args:
        module: A module that it imports.
        ready: Function of that module that it calls first, to import and set up what calls need.
    """

    elsewhere = True

    def __init__(self, module: str, ready: str) -> None:
        """See the class."""
        context = multiprocessing.get_context("spawn")
        self._here, there = context.Pipe()
        self._process = context.Process(target=_serve, args=(there, module, ready), daemon=True)
        resource_tracker.ensure_running()  # as a process is started, which would let interrupts through
        # Not interrupted by Ctrl-C, it still draws the computed results.
        with defer_interrupts():
            self._process.start()
        there.close()

    def start_call(self, function: Callable[..., object], *arguments: Any) -> Callable[[], object]:
        """Calls a function of a module there; each call must be waited for before the next one."""
        sent = False
        with contextlib.suppress(*_NO_ANSWER, pickle.PicklingError, AttributeError, TypeError):
            self._here.send((function, arguments))
            sent = True

        def wait() -> None:
            done = False
            with contextlib.suppress(*_NO_ANSWER):
                done = sent and self._here.recv()
            if not done:
                function(*arguments)

        return wait

    def end(self) -> None:
        """Ends the process at once."""
        self._process.kill()
        self._process.join()
        self._here.close()


@contextlib.contextmanager
def make_caller(module: str, ready: str, wanted: bool) -> Iterator[DirectCaller]:
    """Yields a caller of a module's functions: in another process, where one is wanted and available."""
    other = None
    if wanted and usable_cores() > 1:
        with contextlib.suppress(OSError):
            other = WorkerCaller(module, ready)
    try:
        yield other or DirectCaller()
    finally:
        if other is not None:
            other.end()


def _serve(asked: Connection, module: str, ready: str) -> None:
    """Serves calls in the worker process until the connection closes."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    gc.disable()
    with contextlib.suppress(*_NO_ANSWER):
        getattr(importlib.import_module(module), ready)()
        while True:
            function, arguments = asked.recv()
            try:
                function(*arguments)
                done = True
            except Exception:
                done = False  # the parent process calls again, and reports the error
            asked.send(done)

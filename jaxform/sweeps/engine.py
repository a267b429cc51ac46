"""The evaluation of many designs by an executor: each gives an outcome, whatever happens to the others."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, CancelledError, Executor, Future, wait
from dataclasses import dataclass, replace
from typing import Any

from jaxform.core.errors import InputError, describe_system_error
from jaxform.sweeps.workers import is_lost_worker

OK = "ok"
LOST = (
    "the process that computed it ended, twice: it was killed, as a system without memory does, or it crashed; use "
    "fewer elements, or fewer workers"
)
RESUME = "start its workers again, then resume; rows that are recorded stay so"
_MOST_WORDS = 600
_PATIENCE = 5.0  # s, after which the workers are looked at, once more each time
_PACKAGES = ("jaxform", "optimize")


@dataclass(frozen=True)
class Outcome:
    """The outcome of one design of a sweep.

    Attributes:
        status: "ok", or what failed, in one line.
        value: What the function returned; None where it raised.
        seconds: Wall-clock time that it took [s].
    """

    status: str
    value: Any = None
    seconds: float = 0.0


def guarded(function: Callable[[Any], Any], argument: Any) -> Outcome:
    """The outcome of a call; an error is its status. A function that returns an `Outcome` says its own status."""
    began = time.perf_counter()
    try:
        value = function(argument)
    except Exception as error:
        return Outcome(describe_error(error), None, time.perf_counter() - began)
    seconds = time.perf_counter() - began
    return Outcome(value.status, value.value, seconds) if isinstance(value, Outcome) else Outcome(OK, value, seconds)


def describe_error(error: BaseException) -> str:
    """An error in one line, without the name of the scene file where it names a key."""
    if isinstance(error, InputError):
        words: str | None = str(replace(error, file="") if error.key else error)
    else:
        words = describe_system_error(error)
    text = " ".join((words or f"{type(error).__name__}: {error}").split())
    return text if len(text) <= _MOST_WORDS else f"{text[:_MOST_WORDS]} ..."


def evaluate(
    function: Callable[[Any], Any], arguments: Sequence[Any], executor: Executor
) -> Iterator[tuple[int, Outcome]]:
    """Yields the place and the outcome of each argument, in the order in which they arrive.

    A call whose process ends is repeated once, when all others are done, with nothing beside it; if it ends again, its
    outcome says so.

    Raises:
        InputError: The executor is broken: it has no processes any more and starts none, or its workers have another
            version of this program.

    Warns:
        InputWarning: The executor is a cluster that has no workers, which are waited for.
    """
    width = getattr(executor, "width", len(arguments))
    watch = _Watch(executor)
    waiting, lost = deque(enumerate(arguments)), []
    running: dict[Future[Outcome], tuple[int, Any]] = {}
    while waiting or running:
        while waiting and len(running) < width:
            place, argument = waiting.popleft()
            running[_submit(executor, function, argument)] = place, argument
        for done in watch.wait(list(running)):
            place, argument = running.pop(done)
            if is_lost_worker(done.exception()):
                lost.append((place, argument))
            else:
                yield place, _outcome(done)
    for place, argument in lost:
        again = _submit(executor, function, argument)
        watch.wait([again])
        gone = is_lost_worker(again.exception())
        yield place, Outcome(LOST) if gone else _outcome(again)


class _Watch:
    """Waits for calls, and has an executor that can do so look after its workers meanwhile (`look`)."""

    def __init__(self, executor: Executor) -> None:
        self._look: Callable[[], object] = getattr(executor, "look", lambda: None)
        self._last = time.monotonic()

    def wait(self, running: Sequence[Future[Outcome]]) -> set[Future[Outcome]]:
        """Those calls that are done, one at least.

        Raises:
            InputError: The workers cannot be used, or the connection to them is lost.
        """
        done: set[Future[Outcome]] = set()
        while not done:
            done = wait(running, timeout=_PATIENCE, return_when=FIRST_COMPLETED).done
            if time.monotonic() - self._last >= _PATIENCE:
                self._look()
                self._last = time.monotonic()
        for one in done:
            _check_workers(one)
        return done


def _check_workers(done: Future[Outcome]) -> None:
    """Raises where a call has failed for a reason that is none of its own."""
    error = CancelledError() if done.cancelled() else done.exception()
    if isinstance(error, CancelledError):
        words = str(error).splitlines()[-1] if str(error) else "it was shut down"
        raise InputError(f"takes no more work ({words})", RESUME, "executor")
    if isinstance(error, ModuleNotFoundError) and (error.name or "").partition(".")[0] in _PACKAGES:
        problem = f"has a worker that lacks this program or has another version of it ({error})"
        raise InputError(problem, "install the same jaxform on all workers", "executor")


def _submit(executor: Executor, function: Callable[[Any], Any], argument: Any) -> Future[Outcome]:
    try:
        return executor.submit(guarded, function, argument)
    except RuntimeError as error:  # BrokenProcessPool is one; so is what an executor raises that was shut down
        problem = f"takes no more work ({error})"
        remedy = "give workers = N instead: processes that end are then replaced; rows that are recorded stay so"
        raise InputError(problem, remedy, "executor") from None


def _outcome(done: Future[Outcome]) -> Outcome:
    """The outcome of a call; what kept it from being sent there and back is its status."""
    error = done.exception()
    return done.result() if error is None else Outcome(describe_error(error))

"""The evaluation of many designs by an executor: each gives an outcome, whatever happens to the others."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Executor, Future, wait
from dataclasses import dataclass, replace
from typing import Any

from jaxform.core.errors import InputError, describe_system_error
from jaxform.sweeps.workers import is_lost_worker

OK = "ok"
LOST = (
    "the process that computed it ended, twice: it was killed, as a system without memory does, or it crashed; use "
    "fewer elements, or fewer workers"
)
_MOST_WORDS = 600


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
        InputError: The executor is broken: it has no processes any more and starts none.
    """
    width = getattr(executor, "width", len(arguments))
    waiting, lost = deque(enumerate(arguments)), []
    running: dict[Future[Outcome], tuple[int, Any]] = {}
    while waiting or running:
        while waiting and len(running) < width:
            place, argument = waiting.popleft()
            running[_submit(executor, function, argument)] = place, argument
        for done in wait(running, return_when=FIRST_COMPLETED).done:
            place, argument = running.pop(done)
            if is_lost_worker(done.exception()):
                lost.append((place, argument))
            else:
                yield place, _outcome(done)
    for place, argument in lost:
        again = _submit(executor, function, argument)
        gone = is_lost_worker(again.exception())
        yield place, Outcome(LOST) if gone else _outcome(again)


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

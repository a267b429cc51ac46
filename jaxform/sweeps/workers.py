"""Executors of a sweep: spawned processes of this machine, or the workers of a Dask cluster.

Imports nothing heavy: a process that is spawned reads this module before its threads are limited.
"""

from __future__ import annotations

import contextlib
import logging
import multiprocessing
import os
import queue
import signal
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import (
    FIRST_COMPLETED,
    BrokenExecutor,
    CancelledError,
    Executor,
    Future,
    ProcessPoolExecutor,
    ThreadPoolExecutor,
    wait,
)
from dataclasses import dataclass, replace
from importlib import metadata
from importlib.metadata import PackageNotFoundError
from threading import Thread
from typing import Any

from jaxform.core import installation
from jaxform.core.errors import InputError, describe_system_error, warn_of
from jaxform.core.installation import SHARE, usable_cores

_GATHERERS = 16  # results that are brought from a cluster at a time
_THREADS = (SHARE, "OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "VECLIB_MAXIMUM_THREADS")
"""Environment variables by which XLA (the first) and libraries of linear algebra learn how many threads to start."""


class LocalWorkers(Executor):
    """Spawned processes, one design at a time in each, that share the cores.

    Each is a `ProcessPoolExecutor` of one process: one that ends breaks its own pool alone, which is replaced, and the
    design that it was at is known. They end with this process, however that ends.

    Args:
        count: Number of processes.
        environment: Environment variables of the processes, besides those that limit their threads.
    """

    def __init__(self, count: int, environment: Mapping[str, str] | None = None) -> None:
        """See the class."""
        self.width = count
        threads = str(max(1, usable_cores() // count))
        self._environment = {**dict.fromkeys(_THREADS, threads), **(environment or {})}
        self._context = multiprocessing.get_context("spawn")
        self._alive, self._alive_here = self._context.Pipe(duplex=False)
        self._idle: queue.SimpleQueue[ProcessPoolExecutor] = queue.SimpleQueue()
        self._pools = [self._make_pool() for _ in range(count)]
        for pool in self._pools:
            self._idle.put(pool)

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        """The future of a call in an idle process; waits for one."""
        pool = self._idle.get()
        with _environment(self._environment):
            future = pool.submit(fn, *args, **kwargs)
        future.add_done_callback(lambda done: self._release(pool, done))
        return future

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        """Ends the processes at once."""
        self._alive_here.close()
        for pool in self._pools:
            pool.shutdown(wait=False, cancel_futures=True)

    def _make_pool(self) -> ProcessPoolExecutor:
        return ProcessPoolExecutor(1, self._context, _begin_process, (self._alive,))

    def _release(self, pool: ProcessPoolExecutor, done: Future[Any]) -> None:
        """Marks a process as idle; one that ended is replaced first."""
        if not done.cancelled() and isinstance(done.exception(), BrokenExecutor):
            fresh = self._make_pool()
            # The broken one is not shut down: this is called while it holds its lock, and it has no process any more.
            self._pools = [fresh if one is pool else one for one in self._pools]
            pool = fresh
        self._idle.put(pool)


def _begin_process(alive: Any) -> None:
    """Sets up a spawned process: Ctrl-C is for its parent alone, and it ends when that does."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)

    def watch() -> None:
        with contextlib.suppress(OSError, EOFError):
            alive.recv()  # nothing is sent: it returns when the other end is closed
        os._exit(1)

    Thread(target=watch, daemon=True).start()


@contextlib.contextmanager
def _environment(values: Mapping[str, str]) -> Iterator[None]:
    """Environment variables that processes started inside inherit; those of this process are put back."""
    before = {name: os.environ.get(name) for name in values}
    os.environ.update(values)
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value


class DaskWorkers(Executor):
    """The workers of a Dask cluster.

    A result is fetched as soon as it is available, and then released on the cluster: Dask would compute a retained
    result again if the worker that holds it ended.

    Args:
        client: A `distributed.Client`.

    Raises:
        InputError: A worker has another version of jaxform, or none.
    """

    width = 1000
    """Designs that are submitted at a time: more than a cluster has workers."""

    def __init__(self, client: Any) -> None:
        """See the class."""
        self._client = client
        # Dask calls back on one thread, which must not wait for a result that is lost and computed again.
        self._gatherers = ThreadPoolExecutor(_GATHERERS)
        self._known: set[str] = set()  # workers that have the right version
        self._waiting = False
        self._check_versions()

    @property
    def address(self) -> str:
        """Address of the scheduler."""
        return str(self._client.scheduler.address)

    def look(self) -> None:
        """Checks that there are workers, and that new ones have this version of jaxform.

        Raises:
            InputError: One has not, or the scheduler is gone.

        Warns:
            InputWarning: There are none; once each time this happens.
        """
        count = self._check_versions()
        if not count and not self._waiting:
            problem = "has no workers yet: the sweep waits for them"
            warn_of(
                problem,
                f"start some with `dask worker {self.address}`, or end this with Ctrl-C",
                key="scheduler",
                value=self.address,
            )
        self._waiting = not count

    def _check_versions(self) -> int:
        """Number of workers; raises where one that was not asked before has another version of jaxform than this."""
        try:
            present = set(self._client.nthreads())
            fresh = sorted(present - self._known)
            found = self._ask(fresh) if fresh else {}
        except (OSError, TimeoutError, CancelledError) as error:
            problem = f"is disconnected ({str(error).splitlines()[0] if str(error) else type(error).__name__})"
            raise InputError(problem, "start it again, then resume", "scheduler", self.address) from None
        own = installation.version()
        for worker, has in found.items():
            if has != own:
                what = f"has a worker, {worker}, with {_name(has)}, and this process has {_name(own)}"
                remedy = "install the same version on all workers"
                raise InputError(what, remedy, "scheduler", self.address)
        self._known |= set(found)
        return len(present)

    def _ask(self, workers: list[str]) -> dict[str, str]:
        """The versions of jaxform of those workers that answer; asked by the standard library, as some may lack it."""
        told = self._client.run(metadata.version, "jaxform", workers=workers, on_error="return")
        told |= {worker: installation.UNKNOWN for worker, one in told.items() if isinstance(one, PackageNotFoundError)}
        return {worker: one for worker, one in told.items() if isinstance(one, str)}

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        """The future of a call on a worker."""
        result: Future[Any] = Future()
        result.set_running_or_notify_cancel()
        # Two designs of one scene are two tasks, even if Dask finds their arguments equal.
        remote = self._client.submit(fn, *args, **kwargs, pure=False)

        def gather(done: Any) -> None:
            try:
                result.set_result(done.result())
            except BaseException as error:  # for whoever waits
                result.set_exception(error)
            finally:
                done.release()

        remote.add_done_callback(lambda done: self._gatherers.submit(gather, done))
        return result

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        """Closes the connection; the cluster goes on."""
        self._gatherers.shutdown(wait=False, cancel_futures=True)
        self._client.close()


def _name(version: str) -> str:
    return "no jaxform" if version == installation.UNKNOWN else f"jaxform {version}"


def connect(address: str) -> DaskWorkers:
    """The workers of the Dask scheduler at an address, such as tcp://host:8786.

    Raises:
        InputError: Dask is not installed, there is no such scheduler, or a worker has another version of jaxform.
    """
    try:
        from distributed import Client  # pyright: ignore[reportMissingImports]
    except ImportError:
        remedy = "install it: pip install 'jaxform[cluster]'"
        raise InputError("needs Dask, which is not installed", remedy, "--scheduler", address) from None
    # Its messages on lost connections are replaced by one line.
    for name in [name for name in logging.root.manager.loggerDict if name.partition(".")[0] == "distributed"]:
        logging.getLogger(name).setLevel(logging.CRITICAL)
    try:
        client = Client(address, timeout="15s")
    except (OSError, ValueError, TimeoutError) as error:
        problem = f"cannot be reached ({str(error).splitlines()[0] if str(error) else type(error).__name__})"
        raise InputError(problem, "start `dask scheduler`, and give its address", "--scheduler", address) from None
    return DaskWorkers(client)


def is_lost_worker(error: BaseException | None) -> bool:
    """True if a call has no result because its process ended."""
    return isinstance(error, BrokenExecutor) or type(error).__name__ == "KilledWorker"


# The evaluation of many designs by an executor: each gives an outcome, whatever happens to the others.

OK = "ok"
LOST = (
    "the process that computed it ended twice: the system killed it for lack of memory, or it crashed; use "
    "fewer elements, or fewer workers"
)
RESUME = "start its workers again, then resume; recorded rows are kept"
_MOST_WORDS = 600
_PATIENCE = 5.0  # s, after which the workers are looked at, once more each time
_PACKAGES = ("jaxform", "optimize")


@dataclass(frozen=True)
class Outcome:
    """The outcome of one design of a sweep.

    Attributes:
        status: "ok", or what failed, in one line.
        value: Return value of the function; None where it raised.
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
    """Raises where a call has failed for a reason other than its design."""
    error = CancelledError() if done.cancelled() else done.exception()
    if isinstance(error, CancelledError):
        words = str(error).splitlines()[-1] if str(error) else "it was shut down"
        raise InputError(f"accepts no more tasks ({words})", RESUME, "executor")
    if isinstance(error, ModuleNotFoundError) and (error.name or "").partition(".")[0] in _PACKAGES:
        problem = f"has a worker that lacks this program or has another version of it ({error})"
        raise InputError(problem, "install the same jaxform on all workers", "executor")


def _submit(executor: Executor, function: Callable[[Any], Any], argument: Any) -> Future[Outcome]:
    try:
        return executor.submit(guarded, function, argument)
    except RuntimeError as error:  # BrokenProcessPool is one; so is what an executor raises that was shut down
        problem = f"accepts no more tasks ({error})"
        remedy = "give workers = N instead: processes that end are then replaced; recorded rows are kept"
        raise InputError(problem, remedy, "executor") from None


def _outcome(done: Future[Outcome]) -> Outcome:
    """The outcome of a call; an error of sending it or its result is the status."""
    error = done.exception()
    return done.result() if error is None else Outcome(describe_error(error))

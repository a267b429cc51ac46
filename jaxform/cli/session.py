"""Common parts of the commands: precision, cache, output folder, progress bar, and messages on the two streams."""

from __future__ import annotations

import argparse
import contextlib
import gc
import os
import sys
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

from jaxform.cli import INTERRUPTED as INTERRUPTED
from jaxform.cli import defer_interrupts
from jaxform.cli.worker_process import DirectCaller, make_caller
from jaxform.core import disk
from jaxform.core.disk import PREFIX
from jaxform.core.errors import InputError

if TYPE_CHECKING:
    from concurrent.futures import Future

    from jaxform.core.store import Store
    from jaxform.io.canvas import ProcessHistory
    from jaxform.model.scene import Scene
    from jaxform.results.result import Result

DONE, BAD_INPUT, STOPPED = 0, 2, 3
_SELDOM = (100_000, 50, 50)
"""Thresholds of garbage collection: with the usual ones a short run would spend a tenth of its time on imports."""
_MOMENT = 1.0  # s, after which a wait is reported
COMPARING = "comparing the part with the mold; its files are written already"
"""The words for this wait, which begins in the run and goes on while results are written."""
guard = contextlib.ExitStack()
"""Context of a command that holds the folder of compiled programs."""


def prepare(arguments: argparse.Namespace, subject: str = "") -> tuple[Callable[[str], None], Store]:
    """Sets the precision and the cache; returns the function that prints for people, and the store.

    The programs of the last run of the `subject` are loaded concurrently from now on.
    """
    with defer_interrupts():
        import jax

        from jaxform.core.store import Store

    # Asked for on the command line, so the reminder that Python users get is not needed.
    warnings.filterwarnings("ignore", message="jaxform computes in float32")
    jax.config.update("jax_enable_x64", arguments.dtype == "float64")
    # Without source lines, which are of no use here, programs are a tenth smaller and faster to load.
    jax.config.update("jax_traceback_in_locations_limit", 0)
    folder = cache_folder()
    if folder is not None:
        use_compile_cache(folder / disk.COMPILED)
    store = Store(None if folder is None else folder / disk.MADE)
    if subject:
        store.preload(subject)
    gc.freeze()
    if arguments.own_process:
        gc.set_threshold(*_SELDOM)
    gc.enable()
    return (lambda _: None) if arguments.quiet else say, store


def cache_folder() -> Path | None:
    """The folder in the user's cache folder; None if that is not private, or cannot be written."""
    return disk.user_cache_folder()


def use_compile_cache(folder: Path) -> None:
    """Stores compiled programs between runs, in a folder or in that of the environment variable."""
    import warnings

    from jaxform.core.compilation import keep_programs, keep_programs_in

    if os.environ.get("JAX_COMPILATION_CACHE_DIR"):
        keep_programs()
    else:
        keep_programs_in(folder, guard)
    # A program that cannot be stored or read is compiled again; on a full disk there would be a warning for each.
    warnings.filterwarnings("ignore", message="Error (reading|writing) persistent compilation cache entry")


def open_folder(folder: Path, force: bool) -> None:
    """Makes the output folder, or refuses before anything is computed."""
    if disk.is_file(folder):
        raise InputError("is a file", "name a folder", "--out", str(folder))
    try:
        # A process that was killed may have left an incomplete file, which is no result.
        results = (file for file in folder.iterdir() if not file.name.startswith(PREFIX)) if folder.exists() else ()
        if any(results) and not force:
            raise InputError("exists and is not empty", "choose another folder or give --force", "--out", str(folder))
        folder.mkdir(parents=True, exist_ok=True)
        probe = folder / f"{PREFIX}writes"
        probe.touch()
        probe.unlink()
    except InputError:
        raise
    except (OSError, ValueError) as error:
        problem = f"cannot be written ({disk.error_reason(error)})"
        raise InputError(problem, "choose another folder", "--out", str(folder)) from None


@contextlib.contextmanager
def progress(show: bool, words: str) -> Iterator[Callable[[float, str], None] | None]:
    """A bar on a terminal, none in a pipe: yields a function of the fraction done and a few words, or None."""
    if not (show and sys.stderr.isatty()):
        yield None
        return
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        TextColumn("{task.fields[note]}"),
        TimeElapsedColumn(),
    )
    with Progress(*columns, console=Console(stderr=True)) as progress:
        task = progress.add_task(words, total=1.0, note="compiling")
        yield lambda fraction, note: progress.update(task, completed=fraction, note=note)


@contextlib.contextmanager
def report_waiting(arguments: argparse.Namespace, words: str) -> Iterator[None]:
    """Reports a long wait once in a command, even if it has several parts."""
    from threading import Timer

    reported = vars(arguments).setdefault("reported", set())

    def report() -> None:
        if words not in reported:
            reported.add(words)
            say(f"{words} ...")

    timer = Timer(_MOMENT, report)
    timer.daemon = True
    if not arguments.quiet:
        timer.start()
    try:
        yield
    finally:
        timer.cancel()


@contextlib.contextmanager
def run_in_background[T](work: Callable[[], T]) -> Iterator[Future[T]]:
    """Executes a function on another thread; much of a run, and of writing, is spent outside of Python."""
    from concurrent.futures import ThreadPoolExecutor

    with ThreadPoolExecutor(1) as pool:
        yield pool.submit(work)


def start_picture(arguments: argparse.Namespace) -> contextlib.AbstractContextManager[DirectCaller]:
    """A caller that draws a picture concurrently, in another process where this process is the command's."""
    return make_caller("jaxform.io.canvas", "warm_up", arguments.own_process)


def picture(
    arguments: argparse.Namespace,
    scene: Scene,
    result: Result,
    reference: dict[str, Any] | None,
    history: ProcessHistory | None = None,
    draw: DirectCaller | None = None,
) -> tuple[Callable[[], object], bool]:
    """The function that waits for the pictures of a part and its process, and whether another process draws them."""
    from jaxform.io import canvas, plots, process

    part = arguments.out / "thickness.png", plots.part_picture(scene, result, reference)
    over_time = None if history is None else (arguments.out / process.PICTURE, history)
    caller = draw or DirectCaller()
    return caller.start_call(canvas.draw_pictures, part, over_time), caller.elsewhere


def write_part(
    arguments: argparse.Namespace,
    scene: Scene,
    result: Result,
    picture: tuple[Callable[[], object], bool],
    amend: Callable[[dict[str, Any]], dict[str, Any]] | None = None,
    then: Callable[[], object] = lambda: None,
    *,
    there: bool = False,
) -> dict[str, Any]:
    """Writes files, what is to be written `then`, and the picture; gives the warnings not given before.

    The summary is amended on request. The part may be there already (`output.write_at_once`).
    """
    from jaxform.io import output

    folder, warned = arguments.out, list(arguments.warned)
    wait_for_picture, elsewhere = picture

    def write() -> tuple[dict[str, Any], Exception | None]:
        with report_waiting(arguments, COMPARING):
            summary = output.write_result(scene, result, folder, warned, amend, there=there)
        return summary, _failure(then) if elsewhere else None

    with run_in_background(write) as written, report_waiting(arguments, "drawing the part"):
        wait_for_picture()
    summary, failure = written.result()
    if not elsewhere:
        # To read files back, a process limits its memory; not while it draws.
        failure = _failure(then)
    for sentence in summary["warnings"]:
        if sentence not in warned:
            warn(sentence)
    if failure is not None:
        raise failure
    return summary


def _failure(work: Callable[[], object]) -> Exception | None:
    """The error that prevented writing; it is reported after everything else."""
    try:
        work()
    except (OSError, InputError) as error:
        return error
    return None


def write_report(folder: Path) -> None:
    """Writes the report; if it cannot be made from the results, a warning gives the reason."""
    from jaxform.io import report

    try:
        report.write_report(folder)
    except InputError as error:
        warn(f"there is no {report.NAME}: {error}")


def exit_status(result: Result) -> int:
    """The exit status of a run; prints to standard error why it stopped."""
    from jaxform.results.summary import explain

    if int(result.status):
        print(f"jaxform: {explain(result)}", file=sys.stderr)
        return STOPPED
    return DONE


def add_precision(parser: argparse.ArgumentParser) -> None:
    """Adds the option for the precision of the computation."""
    words = "precision of the computation; float64 by default"
    parser.add_argument("--dtype", choices=("float64", "float32"), default="float64", help=words)


def say(words: str) -> None:
    """Prints a line; if the output is closed, the command continues without it."""
    try:
        print(words, flush=True)
    except UnicodeEncodeError:
        print(words.encode("ascii", "backslashreplace").decode(), flush=True)
    except BrokenPipeError:
        # All that is still to come goes nowhere, what Python flushes at the end included.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def warn(sentence: str) -> None:
    """Prints a warning to standard error, --quiet or not."""
    print(f"jaxform: warning: {sentence}", file=sys.stderr)

"""The command `jaxform sweep`: many designs on many processes, their table, pictures and report."""

from __future__ import annotations

import argparse
import contextlib
import os
import shutil
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Executor
from pathlib import Path
from typing import Any

from jaxform.cli import defer_interrupts, session
from jaxform.core import disk
from jaxform.core.errors import warn_of
from jaxform.core.installation import usable_cores
from jaxform.io import catalog

_MOST_NAMED = 20  # failed designs


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds the arguments of the command."""
    parser.add_argument("source", metavar="STUDY_OR_TABLE", help="a study with [sweep] (.toml), or a table (.csv)")
    parser.add_argument("--out", metavar="DIR", required=True, type=Path, help="folder for the results")
    parser.add_argument("--scene", metavar="SCENE", help="the scene that a table changes: a name or a .toml file")
    words = "processes of this machine (default: one per core); each uses its share of the cores"
    where = parser.add_mutually_exclusive_group()
    where.add_argument("--workers", metavar="N", type=process_count, help=words)
    words = "address of a Dask scheduler, such as tcp://host:8786; needs jaxform[cluster]"
    where.add_argument("--scheduler", metavar="ADDRESS", help=words)
    words = "resume the sweep in DIR; recorded rows are not computed again"
    parser.add_argument("--resume", action="store_true", help=words)
    words = "search for the best design of each row, by variables, objective and solver of the study"
    parser.add_argument("--optimize", action="store_true", help=words)
    parser.add_argument("--quiet", action="store_true", help="print warnings and errors only")
    session.add_precision(parser)
    parser.add_argument("--force", action="store_true", help="overwrite results in DIR")


def process_count(text: str) -> int:
    """The number of processes that a command line asks for."""
    if not text.isdecimal() or not 0 < int(text) <= 4096:
        raise argparse.ArgumentTypeError(f"{text!r} is not a number of processes; give 1 or more")
    return int(text)


def sweep(arguments: argparse.Namespace) -> int:
    """Runs `jaxform sweep` with its arguments and returns its exit status.

    Raises:
        InputError: The study, table or scene is wrong, or rows can no longer be written to disk.
    """
    began, say = time.perf_counter(), (lambda _: None) if arguments.quiet else session.say
    with defer_interrupts():
        from jaxform.sweeps import records
        from jaxform.sweeps.records import DESIGNS, head, record_designs

    task = _task(arguments)
    found = task.designs
    folder: Path = arguments.out
    there = os.path.exists(folder / records.NAME)
    if arguments.resume and not there:
        warn_of("contains no sweep to resume: a new one is started", key="--resume", value=str(folder))
    session.open_folder(folder, arguments.force or (arguments.resume and there))
    if not arguments.resume:
        shutil.rmtree(folder / DESIGNS, ignore_errors=True)  # of another sweep, with --force
    (folder / DESIGNS).mkdir(exist_ok=True)
    if task.meshes:
        say(task.meshes)
    kept = records.Records(folder, task.paths, task.measures, arguments.resume)
    with _executor(arguments, len(found)) as (executor, setting), _bar(not arguments.quiet, len(found)) as show:
        try:
            progress = record_designs(
                found, task.function, lambda design: task.argument(design, setting), executor, kept, show
            )
        except KeyboardInterrupt:
            words = f"interrupted; {len(records.read_rows(kept.path))} rows are recorded: resume with --resume"
            print(f"jaxform: {words}", file=sys.stderr, flush=True)
            return session.INTERRUPTED
    rows = kept.finish((design.digest, head(design)) for design in found)
    _finish(arguments, task, kept.columns, rows, progress, time.perf_counter() - began)
    for row in [row for row in rows if row["status"] != "ok"][:_MOST_NAMED]:
        say(f"design {row['design']} failed: {row['status']}")
    good = progress.total - progress.failed
    say(f"{good} of {progress.total} designs ok, {progress.failed} failed; {progress.computed} computed now")
    say(f"results in {folder}: results.csv, report.html and pictures")
    return session.DONE


class _Task:
    """The computation that a sweep does for each design.

    Attributes:
        designs: The designs.
        paths: Columns of their values.
        measures: Columns of their results, with units.
        function: The function that a worker calls.
        argument: Its argument for a design.
        meshes: A sentence on their adapted meshes; empty without any.
    """

    def __init__(self, table: Any, designs: list[Any], measures: dict[str, str], function: Callable[..., Any]):
        from jaxform.sweeps.designs import describe_meshes

        self.designs, self.paths, self.measures, self.function = designs, table.paths, measures, function
        self.meshes = describe_meshes(table, designs)
        self.study: Any = None

    def argument(self, design: Any, setting: Any) -> Any:
        """The argument of a worker's function for a design."""
        from jaxform.sweeps.designs import name_scene

        document = name_scene(design)
        return (document, setting) if self.study is None else (document, setting, self.study)


def _task(arguments: argparse.Namespace) -> _Task:
    """The computation that the arguments ask for."""
    from jaxform.sweeps import designs
    from jaxform.sweeps.evaluation import simulate_design
    from jaxform.sweeps.records import MEASURES

    source, scene = arguments.source, arguments.scene
    study = None
    if str(source).endswith(".toml") or source in catalog.built_in("study"):
        study, named, table = designs.read_sweep(source)
        base = None
        if scene is None:
            scene, base = named, study[1]
    else:
        table, base = designs.read_table(source), None
    about = arguments.dtype
    if arguments.optimize:
        from jaxform.cli import optimize_command

        search = optimize_command.search_of(study, arguments.source)
        about = f"{about} {optimize_command.search_digest(search[2])}"
        made = designs.make_designs(table, scene, base, about)
        task = _Task(table, made, MEASURES | optimize_command.MEASURES, optimize_command.optimize_design)
        task.study = search
        return task
    made = designs.make_designs(table, scene, base, about)
    return _Task(table, made, MEASURES, simulate_design)


@contextlib.contextmanager
def _executor(arguments: argparse.Namespace, count: int) -> Iterator[tuple[Executor, Any]]:
    """Yields the executor of a sweep of so many designs, and how its workers compute; ends it whatever happens."""
    from jaxform.sweeps import workers
    from jaxform.sweeps.evaluation import Setting

    if arguments.scheduler is not None:
        executor: Executor = workers.connect(arguments.scheduler)
        setting = Setting(arguments.dtype)
    else:
        executor = workers.LocalWorkers(arguments.workers or max(1, min(usable_cores(), count)))
        setting = Setting(arguments.dtype, str(_cache_folder()))
    try:
        yield executor, setting
    finally:
        executor.shutdown(wait=False, cancel_futures=True)


def _cache_folder() -> Path:
    """The folder of programs that workers share, guarded until the command ends; without a cache a temporary one."""
    folder = session.cache_folder()
    if folder is None:
        folder = Path(session.guard.enter_context(tempfile.TemporaryDirectory(prefix="jaxform-")))
    elif not os.environ.get("JAX_COMPILATION_CACHE_DIR"):
        session.guard.enter_context(disk.guard_folder(folder / disk.COMPILED))
    return folder


@contextlib.contextmanager
def _bar(show: bool, total: int) -> Iterator[Callable[[Any], None]]:
    """A bar on a terminal, with the time left and the failures so far; none in a pipe."""
    if not (show and sys.stderr.isatty()):
        yield lambda _: None
        return
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    columns = (
        TextColumn("designs"),
        BarColumn(),
        MofNCompleteColumn(),
        TextColumn("{task.fields[failed]} failed"),
        TextColumn("time left"),
        TimeRemainingColumn(),
    )
    with Progress(*columns, console=Console(stderr=True)) as bar:
        task = bar.add_task("designs", total=total, failed=0)
        yield lambda progress: bar.update(task, completed=progress.done, failed=progress.failed)


def _finish(
    arguments: argparse.Namespace, task: _Task, columns: list[str], rows: list[Any], progress: Any, seconds: float
) -> None:
    """Writes what is made of the whole table: its units, pictures, the report, and results.parquet."""
    from jaxform.io.output import write_json
    from jaxform.sweeps import records, report
    from jaxform.sweeps.designs import complete_rows, unit_of

    folder: Path = arguments.out
    documents = [design.document for design in task.designs if design.document is not None]
    units = {path: unit_of(documents[0].model, path) if documents else "" for path in task.paths} | task.measures
    parquet = records.write_parquet(folder, columns, rows, units)
    facts = {
        "source": str(arguments.source),
        "designs": progress.total,
        "ok": progress.total - progress.failed,
        "failed": progress.failed,
        "computed": progress.computed,
        "programs_compiled": progress.compiled,
        "seconds": seconds,
        "units": {column: units.get(column, "") for column in columns},
        "variables": task.paths,
    }
    write_json(folder / "sweep.json", facts | ({"meshes": task.meshes} if task.meshes else {}))
    drawn = report.draw_all(folder, task.paths, complete_rows(rows, task.designs, task.paths), units)
    report.write_report(folder, facts, columns, rows, drawn)
    if not parquet and not arguments.quiet:
        session.say(f"{records.PARQUET} needs pyarrow, which is not installed: pip install 'jaxform[sweep]'")

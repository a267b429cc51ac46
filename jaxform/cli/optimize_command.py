"""The command `jaxform optimize`: a search, its progress, and its files."""

from __future__ import annotations

import argparse
import contextlib
import hashlib
import json
import os
import sys
import tempfile
import time
import warnings
from collections.abc import Callable, Iterator
from concurrent.futures import Executor
from pathlib import Path
from typing import TYPE_CHECKING, Any

from jaxform.cli import session
from jaxform.core.errors import InputError, InputWarning, format_percent, warn_of

if TYPE_CHECKING:
    from jaxform.io.files import SceneDocument
    from jaxform.sweeps.evaluation import Setting
    from jaxform.sweeps.workers import Outcome

STARTS = "starts.csv"
_SAME = 0.1  # of the objective, within which two starts lead to the same


def optimize_study(arguments: argparse.Namespace) -> int:
    """Runs `jaxform optimize` with its arguments and returns its exit status.

    Raises:
        InputError: The input is bad, or the search can no longer be written to disk.
    """
    say, store = session.prepare(arguments)
    import optimize
    from jaxform.io import files

    study = optimize.load_study(arguments.source, store)
    reference = files.read_reference(study.document)
    folder: Path = arguments.out
    notes = folder / "search.jsonl"
    if arguments.resume and not os.path.exists(notes):
        problem, remedy = (
            "contains no search to resume: a new one is started",
            "name the folder of the interrupted search",
        )
        warn_of(problem, remedy, key="--resume", value=str(folder))
    session.open_folder(folder, arguments.force or (arguments.resume and os.path.exists(notes)))
    if not arguments.resume:
        _remove_journals(folder)
    journal = optimize.Journal(notes, f"{study.digest} {arguments.dtype}", arguments.resume)
    rows: list[dict[str, Any]] = []
    ended: list[dict[str, Any]] = []
    with _executor(arguments) as executor, session.progress(not arguments.quiet, "designing") as bar:

        def on_evaluation(row: dict[str, Any]) -> None:
            rows.append(row)
            # Rewritten each time: a search that is killed leaves its results so far.
            optimize.write_history(folder / "history.csv", rows)
            if bar is not None:
                done = len(ended) + min(row["iteration"] / study.iterations, 1.0)
                bar(done / study.starts, _progress_words(row))

        def on_start(row: dict[str, Any]) -> None:
            rows.clear()
            ended.append(row)
            optimize.write_starts(folder / STARTS, sorted(ended, key=lambda row: row["start"]))
            say(f"start {row['start']}, {len(ended)} of {study.starts} done: {_start_words(row)}")
            if bar is not None:
                bar(len(ended) / study.starts, f"{len(ended)} of {study.starts} starts")

        def on_check(error: float) -> None:
            say(f"gradient along one direction: relative difference to central differences {error:.1e}{_doubt(error)}")

        def on_warning(sentence: str) -> None:
            arguments.warned.append(sentence)
            session.warn(sentence)

        if executor is not None and study.starts > 1:
            say(f"{study.starts} searches on {arguments.workers} processes")
        try:
            # Warnings about intermediate designs are not shown; the summary of the last one has its own.
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", InputWarning)
                design = optimize.solve(
                    study,
                    on_evaluation,
                    on_check=on_check,
                    on_warning=on_warning,
                    on_wait=say,
                    on_start=on_start,
                    journal=journal,
                    executor=executor,
                )
        except InputError as error:
            raise error.with_context(file=study.file) from None
        except KeyboardInterrupt:
            print(f"jaxform: {_interruption_words(folder)}", file=sys.stderr, flush=True)
            return session.INTERRUPTED
    if journal.replayed:
        say(f"{journal.replayed} evaluations were reused from the journal")
    optimize.write_history(folder / "history.csv", design.history)
    _write_design(arguments, study, design, reference)
    _tell_design(say, design, study.goal, folder)
    return _exit_status(design)


@contextlib.contextmanager
def _executor(arguments: argparse.Namespace) -> Iterator[Executor | None]:
    """Yields the processes of the command, ended whatever happens; None where one is enough: this one."""
    if arguments.workers == 1:
        yield None
        return
    from jaxform.sweeps.workers import LocalWorkers

    executor = LocalWorkers(arguments.workers)
    try:
        yield executor
    finally:
        executor.shutdown(wait=False, cancel_futures=True)


def _remove_journals(folder: Path) -> None:
    """Removes the table and journals of another study's starts, which could otherwise be resumed later."""
    for path in [folder / STARTS, *folder.glob("search.*.jsonl")]:
        with contextlib.suppress(OSError):
            path.unlink()


def _interruption_words(folder: Path) -> str:
    """The remedy after an interruption before any search had a design, in words."""
    count = 0
    for path in folder.glob("search*.jsonl"):
        with contextlib.suppress(OSError):
            with path.open("rb") as file:
                count += sum(1 for _ in file) - 1  # the first line names the study
    if not count:
        return "interrupted before anything was recorded"
    return f"interrupted; {count} evaluations are recorded: resume with --resume"


_DOUBTFUL = 1e-3  # relative difference of a gradient to differences


def _doubt(error: float) -> str:
    """A clause on a gradient that differs from differences; empty where it does not."""
    if error <= _DOUBTFUL:
        return ""
    return (
        "; the objective may jump between designs very near to each other, where nodes land in another order: "
        "the gradient is then the slope between two jumps, not that of a larger change"
    )


def _start_words(row: dict[str, Any]) -> str:
    return row["status"] if row["objective"] == "" else f"objective {row['objective']:.4g}, {row['status']}"


def _exit_status(design: Any) -> int:
    """The exit status: stopped where `simulate` of the best design would be, or where that breaks a limit."""
    status = session.exit_status(design.result)
    if design.broken:
        print(f"jaxform: {design.broken}", file=sys.stderr)
        return session.STOPPED
    return status


def _progress_words(row: dict[str, Any]) -> str:
    error = row["thickness_rms_error"]
    what = f"objective {row['objective']:.4g}" if error == "" else f"deviation {format_percent(error, 3)}"
    return (
        f"evaluation {row['evaluation']}, {what}, thinnest wall {1e3 * row['wall_min']:.3g} mm, "
        f"{1e3 * row['mass']:.4g} g"
    )


def _write_design(arguments: argparse.Namespace, study: Any, design: Any, reference: dict[str, Any] | None) -> None:
    from jaxform.io import output, plots, process, scene_rewriting

    folder: Path = arguments.out
    scene_rewriting.write_scene(study.document, design.changes, folder)
    exact = reference if not _changes_sheet(design.changes) else None

    def write_rest() -> None:
        output.write_part(design.first_scene, design.first_result, folder / "start.vtu")
        process.write_process(history, folder)
        session.write_report(folder)

    history = process.process_history(design.scene, design.result)
    picture = session.picture(arguments, design.scene, design.result, exact, history)
    summary = session.write_part(arguments, design.scene, design.result, picture, design.amend_summary, then=write_rest)
    plots.convergence_picture(folder / "convergence.png", design.history)
    before, after = (design.first_scene, design.first_result), (design.scene, design.result)
    plots.design_picture(folder / "design.png", before, after, study.objective.uniform)
    _write_facts(folder, summary)


def _write_facts(folder: Path, summary: dict[str, Any]) -> None:
    """Writes design.json: the facts of the search, with all warnings of the summary, also those of the best part."""
    from jaxform.io import output

    output.write_json(folder / "design.json", summary["design"] | {"warnings": summary["warnings"]})


def _changes_sheet(changes: dict[str, Any]) -> bool:
    """True if changes to the sheet invalidate an exact solution for the scene."""
    return any(key.startswith(("parison.", "material.")) for key in changes)


def _compare_starts(design: Any, goal: float | None) -> str:
    """The number of starts that reach the goal or, where none is set or reached, the same objective; in words."""
    found = [row["objective"] for row in design.starts if row["objective"] != ""]
    if goal is not None and design.objective <= goal:
        there = sum(value <= goal for value in found)
        return f"{there} of {len(design.starts)} starts reach the goal of {goal:.4g} ({STARTS})"
    near = sum(value <= (1.0 + _SAME) * design.objective for value in found)
    failed = len(design.starts) - len(found)
    others = f", the others with up to {max(found):.4g}" if near < len(found) else ""
    return (
        f"{near} of {len(design.starts)} starts end within {100 * _SAME:.0f} % of the best objective{others}; "
        f"{failed} failed ({STARTS})"
    )


def _tell_design(say: Callable[[str], None], design: Any, goal: float | None, folder: Path) -> None:
    facts = design.summary()
    first, best = facts["before"], facts["after"]
    if best["thickness_rms_error"] is not None:
        say(
            f"deviation from the target {format_percent(first['thickness_rms_error'], 3)} -> "
            f"{format_percent(best['thickness_rms_error'], 3)}"
        )
    say(
        f"thinnest wall {1e3 * first['wall_min']:.4g} -> {1e3 * best['wall_min']:.4g} mm, coefficient of "
        f"variation {format_percent(first['wall_cv'], 3)} -> {format_percent(best['wall_cv'], 3)}, "
        f"mass {1e3 * first['mass']:.4g} -> {1e3 * best['mass']:.4g} g, "
        f"objective {first['objective']:.4g} -> {best['objective']:.4g}"
    )
    if facts["secants"]:
        ends = [f"{name} {found['slope']:.3g}, {found['secant']:.3g}" for name, found in facts["secants"].items()]
        say(f"slope along the gradient and secant over 1 % of the bounds: {'; '.join(ends)}")
    for row in facts["at_bounds"]:
        count = len(row["lower"]) + len(row["upper"])
        say(f"at their bounds: {count} of {row['numbers']} numbers of variable[{row['variable']}] ({row['kind']})")
    if design.starts:
        say(_compare_starts(design, goal))
    if facts["multiplier"] is not None:
        # The violations are reported with the status.
        kept = "violated" if design.broken else f"satisfied to {format_percent(facts['violation'])}"
        say(
            f"limits are {kept}; multiplier {facts['multiplier']:.3g}: improvement of the objective per relative "
            "change of the limit"
        )
    if facts["price"] is not None:
        say(
            f"the last 10 % of the improvement took the time of {facts['price']['simulations_for_the_last_tenth']:.0f} "
            f"simulations, the first 90 % that of {facts['price']['simulations_for_nine_tenths']:.0f}"
        )
    if facts["warm_start"]:
        say(f"{facts['warm_start']} fixed-point updates were done first (solver.warm_start)")
    say(
        f"{facts['evaluations']} simulations with and without gradient (the time of {facts['simulations']:.0f} "
        f"simulations, {facts['seconds']:.0f} s); stopped by {facts['stopped_by']}: {facts['message']}; results in "
        f"{folder}"
    )
    if design.stopped_by == "interrupted":
        say("the search continues from here with --resume")


# Searches in a sweep (`jaxform sweep --optimize`): the best design of each search is a row of the results.

MEASURES = {"objective": "", "thickness_rms_error": "", "violation": "", "simulations": ""}
"""Columns of the results of a search in a sweep, besides those of the simulated best design, and their units."""
_SEARCH = ("variable", "objective", "solver")


def search_of(study: tuple[str, Path, dict[str, Any]] | None, source: str) -> tuple[str, Path, dict[str, Any]]:
    """The search that a study describes, for scenes of a sweep.

    Returns:
        The name of the study in messages, the base of its relative paths, and its tables but the sweep.

    Raises:
        InputError: It is a table of designs alone, or a table of the search is missing or wrong.
    """
    from jaxform.io import schema
    from jaxform.io.validation import validate

    if study is None:
        remedy = "name the table in a study (sweep.table), with variables, an objective and a solver"
        raise InputError("is a table, which has no objective for --optimize", remedy, value=source)
    file, folder, tables = study
    data = {key: value for key, value in tables.items() if key != "sweep"}
    validate(schema.StudyFile, {"scene": "any", **data}, file)
    return file, folder, data


def search_digest(data: dict[str, Any]) -> str:
    """Hash of those tables of a search that determine its result."""
    determining = json.dumps([data.get(key) for key in _SEARCH], sort_keys=True, default=str)
    return hashlib.sha256(determining.encode()).hexdigest()


def optimize_design(task: tuple[SceneDocument, Setting, tuple[str, Path, dict[str, Any]]]) -> Outcome:
    """The best design that a search finds for a scene document: its results and files, and its status in words.

    Raises:
        InputError: The scene cannot be simulated, or the search does not fit it.
    """
    import optimize
    from jaxform.io import schema
    from jaxform.io.files import StudyDocument
    from jaxform.io.validation import validate
    from jaxform.sweeps import evaluation
    from jaxform.sweeps.workers import Outcome

    document, setting, (file, base, data) = task
    before, warned = evaluation.count_compiled(), []
    worker = store, _ = evaluation.set_up(setting)
    model = validate(schema.StudyFile, {"scene": document.name, **data}, file)
    with evaluation.compile_once(worker, search_digest(data)), evaluation.tell_warnings(warned.append):
        began = time.perf_counter()
        study = optimize.build_study(StudyDocument(file, base, data, model, document), store)
        with tempfile.TemporaryDirectory(prefix="jaxform-") as name:
            folder = Path(name)
            design = optimize.solve(study, on_warning=warned.append)
            summary = _write_files(folder, document, design, warned)
            archive = evaluation.pack(folder)
    found = design.summary()
    measures = evaluation.measures_of(summary) | {"seconds": time.perf_counter() - began}
    measures |= {name: found["after"][name] for name in ("objective", "thickness_rms_error")}
    measures |= {"violation": found["violation"], "simulations": found["simulations"]}
    return Outcome(design.status, (measures, archive, evaluation.count_compiled() - before))


def _write_files(folder: Path, document: SceneDocument, design: Any, warned: list[str]) -> dict[str, Any]:
    """Writes the files of `jaxform optimize` except its pictures; returns the summary."""
    import optimize
    from jaxform.io import output, scene_rewriting

    scene_rewriting.write_scene(document, design.changes, folder)
    summary = output.write_result(
        design.scene, design.result, folder, list(dict.fromkeys(warned)), design.amend_summary
    )
    output.write_part(design.first_scene, design.first_result, folder / "start.vtu")
    optimize.write_history(folder / "history.csv", design.history)
    _write_facts(folder, summary)
    return summary

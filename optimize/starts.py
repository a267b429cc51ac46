"""Several starts: whole searches from points spread evenly within the bounds, in line or on the workers of an executor.

The first search begins at the scene's own design. Each has a journal of its own, so that a study that is resumed, or
given more starts, repeats nothing.
"""

from __future__ import annotations

import csv
import dataclasses
import functools
import pickle
import warnings
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Executor
from pathlib import Path
from typing import Any

import numpy as np

from jaxform import InputError, InputWarning
from jaxform.extend import MOST_SOBOL, Outcome, WorkerSetting, compile_once, evaluate, guarded, set_up, worker_setting
from jaxform.scene_files import atomic_path
from optimize import sensitivity_check
from optimize.designs import KEPT, Study
from optimize.journal import Answer, Journal
from optimize.search import Search
from optimize.solvers import Design, Row, check, solve_once
from optimize.wall_statistics import formed_part

COLUMNS = ("start", "objective", "status", "simulations", "seconds")


def solve(
    study: Study,
    on_evaluation: Callable[[Row], object] | None = None,
    *,
    on_check: Callable[[float], object] | None = None,
    on_warning: Callable[[str], object] | None = None,
    on_wait: Callable[[str], object] | None = None,
    on_start: Callable[[Row], object] | None = None,
    journal: Journal | None = None,
    executor: Executor | None = None,
) -> Design:
    """Searches for the best design, from each of the study's starts.

    Args:
        study: The design study.
        on_evaluation: Called with every row of the history as it comes; a true answer ends the search. Searches of an
            executor do not call it.
        on_check: Called with the gradient's relative difference to central differences, before each search.
        on_warning: Called with each warning about the study, a sentence.
        on_wait: Called with a message before the initial scene is simulated and programs are compiled.
        on_start: Called with a row of `starts.COLUMNS` as each of several searches ends.
        journal: Journal on disk, so that a killed search can be resumed; none by default.
        executor: A `concurrent.futures` executor, on whose workers several searches run side by side; with one start,
            the values are computed there that the gradient is checked with. It stays open. None for this process.

    Returns:
        The best design; with several starts its `starts` has a row for each, those that failed included.

    Raises:
        InputError: If method, objective and variables cannot be combined, the initial scene cannot be simulated to its
            end, no design within the bounds can satisfy a limit, or every start fails.
    """
    told: list[str] = []

    def warn(sentence: str) -> None:
        if sentence not in told:
            told.append(sentence)
            if on_warning is not None:
                on_warning(sentence)

    calls: Row = {"on_evaluation": on_evaluation, "on_check": on_check, "on_warning": warn, "on_wait": on_wait}
    if study.starts == 1:
        evaluators = None if executor is None else functools.partial(_evaluate_elsewhere, executor)
        design = solve_once(study, **calls, journal=journal, evaluators=evaluators)
        for sentence in sensitivity_check.unmoved_numbers(design.at_bounds, design.stopped_by):
            design.warnings.append(sentence)
            warn(sentence)
        return design
    check(study)
    kept = journal or Journal()
    journals = [kept.of_start(number) for number in range(1, study.starts + 1)]
    tasks = [
        (dataclasses.replace(study, starts=1, first=first), own)
        for first, own in zip(starting_points(study), journals, strict=True)
    ]
    outcomes = _search_in_line(tasks, calls) if executor is None else _search_elsewhere(tasks, executor)
    best, rows, first_row = _collect(outcomes, lambda design: _tell(design, calls, executor), on_start, kept)
    if best is None:
        raise _failure(rows)
    return dataclasses.replace(best, starts=sorted(rows, key=lambda row: row["start"]), first_row=first_row)


def starting_points(study: Study) -> list[np.ndarray | None]:
    """Numbers (n,) of the search at each start: None for the scene's own, then points of a Sobol sequence.

    The sequence is that of `scipy.stats.qmc`, scrambled; of more numbers than it has, a Latin hypercube.
    """
    from scipy.stats import qmc  # takes half a second to import

    reach = np.concatenate([variable.reach for variable in study.variables])
    kind = qmc.Sobol if reach.size <= MOST_SOBOL else qmc.LatinHypercube
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # its points are balanced for powers of two
        shares = kind(reach.size, rng=0).random(study.starts - 1)
    return [None, *(reach * (2.0 * shares - 1.0))]


def _collect(
    outcomes: Iterable[tuple[int, Outcome]],
    tell: Callable[[Design], object],
    on_start: Callable[[Row], object] | None,
    journal: Journal,
) -> tuple[Design | None, list[Row], Row | None]:
    """The best design of searches as they end, their rows, and the first row of the first one's history."""
    best, first_row, rows, known = None, None, [], 0
    try:
        for place, outcome in outcomes:
            design, replayed = outcome.value or (None, 0)
            known += replayed
            row = _row(place + 1, design, outcome)
            rows.append(row)
            if design is not None:
                tell(design)
                first_row = first_row if place else design.history[0]
                best = design if best is None or _rank(design) < _rank(best) else best
            if on_start is not None:
                on_start(row)
            if design is not None and design.stopped_by in ("caller", "interrupted"):
                break
    except KeyboardInterrupt:
        if best is None:
            raise
        best = dataclasses.replace(best, message="interrupted", stopped_by="interrupted")
    # Only now: the first start may read on in this journal in another thread.
    journal.replayed = max(known, journal.replayed)
    return best, rows, first_row


def _row(number: int, design: Design | None, outcome: Outcome) -> Row:
    """The row of a start."""
    if design is None:
        return dict(zip(COLUMNS, (number, "", outcome.status, "", outcome.seconds), strict=True))
    facts = (number, design.objective, design.status, design.simulations, design.seconds)
    return dict(zip(COLUMNS, facts, strict=True))


def _rank(design: Design) -> tuple[bool, float, float]:
    """The smaller the better: first whether its part fails, then whether limits are kept, then the objective."""
    failed = bool(int(design.result.status))
    return failed, design.violation if design.violation > KEPT else 0.0, design.objective


def _failure(rows: list[Row]) -> InputError:
    """The error where no start has a design."""
    words = {row["status"] for row in rows}
    if len(words) == 1:
        return InputError(rows[0]["status"])
    problem = f"all of them fail; the first: {rows[0]['status']}"
    return InputError(problem, "correct the scene, or narrow the bounds", "solver.starts", len(rows))


def _tell(design: Design, calls: Row, executor: Executor | None) -> None:
    """Reports the search of another process to this process's callbacks."""
    if executor is not None:
        for sentence in design.warnings:
            calls["on_warning"](sentence)
        if calls["on_check"] is not None and design.gradient_error is not None:
            calls["on_check"](design.gradient_error)


# --- In this process, and in others -----------------------------------------------------------------------------------


def _search_in_line(tasks: list[tuple[Study, Journal]], calls: Row) -> Iterator[tuple[int, Outcome]]:
    programs: dict[str, Any] = {}

    def search(task: tuple[Study, Journal, Row]) -> tuple[Design, int]:
        study, journal, calls = task
        return solve_once(study, **calls, journal=journal, programs=programs), journal.replayed

    for place, (study, journal) in enumerate(tasks):
        yield place, guarded(search, (study, journal, calls))
        calls = calls | {"on_wait": None}  # what it tells of is done


def _search_elsewhere(tasks: list[tuple[Study, Journal]], executor: Executor) -> Iterator[tuple[int, Outcome]]:
    packed = _pack(tasks[0][0])
    setting = worker_setting()
    return evaluate(_search_start, [(packed, study.first, journal, setting) for study, journal in tasks], executor)


def _pack(study: Study, decided: Any = None) -> bytes:
    """A study as bytes: a worker must set its precision before it reads them."""
    try:
        return pickle.dumps((dataclasses.replace(study, first=None), decided))
    except (pickle.PicklingError, AttributeError, TypeError) as error:
        remedy = "define what it is made of in modules, or search without an executor"
        raise InputError(f"cannot be sent to another process ({error})", remedy, "study") from None


@functools.lru_cache(maxsize=1)
def _unpack(packed: bytes) -> tuple[Study, Any, dict[str, Any]]:
    """A study, the decisions that its simulations take, and its compiled programs, in a worker."""
    return (*pickle.loads(packed), {})


def _search_start(task: tuple[bytes, np.ndarray | None, Journal, WorkerSetting]) -> tuple[Design, int]:
    """The design of a start's search, and the number of evaluations that were known; computed by a worker."""
    packed, first, journal, setting = task
    worker = set_up(setting)
    study, _, programs = _unpack(packed)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", InputWarning)
        with compile_once(worker, "start", study.digest):
            formed_part(study.scene)
        design = solve_once(dataclasses.replace(study, first=first), journal=journal, programs=programs)
    return design, journal.replayed


def _evaluate_elsewhere(
    executor: Executor, study: Study, designs: list[np.ndarray], decided: Any
) -> list[Answer | None]:
    """Values of designs (n,) by the workers of an executor; None for those that they cannot give."""
    packed, setting = _pack(study, decided), worker_setting()
    found = dict(evaluate(_evaluate_design, [(packed, free, setting) for free in designs], executor))
    return [found[place].value for place in range(len(designs))]


def _evaluate_design(task: tuple[bytes, np.ndarray, WorkerSetting]) -> Answer:
    """The value of a design, and the processor time that it took [s]; computed by a worker."""
    packed, free, setting = task
    set_up(setting)
    study, (schedule, limits), programs = _unpack(packed)
    search = Search(study, None, 1.0, schedule=schedule, limits=limits, programs=programs)
    return search.forward_timed(free)


def write_starts(path: str | Path, rows: Iterable[Row]) -> None:
    """Writes the rows of starts as CSV.

    Raises:
        InputError: It cannot be written; a previous file is kept.
    """
    with atomic_path(path, "then resume with --resume") as fresh, fresh.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(COLUMNS)
        writer.writerows([row[name] for name in COLUMNS] for row in rows)

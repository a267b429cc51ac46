"""The folder of a sweep: a row, and a folder of files, for each design as it arrives."""

from __future__ import annotations

import io
import shutil
import zipfile
from collections.abc import Callable, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from jaxform.core.disk import PREFIX, write_error
from jaxform.sweeps.designs import DesignRow
from jaxform.sweeps.engine import OK, Outcome, evaluate
from jaxform.sweeps.records import Records, Row

DESIGNS = "designs"


@dataclass
class Progress:
    """The progress of a sweep.

    Attributes:
        total: Rows of the table.
        done: Rows that are recorded.
        failed: Recorded rows whose status is not "ok".
        computed: Rows that this command has computed.
        compiled: Programs that were compiled for them.
        row: The last recorded row; None before the first.
    """

    total: int
    done: int = 0
    failed: int = 0
    computed: int = 0
    compiled: int = 0
    row: Row | None = None

    def add(self, row: Row, count: int = 1) -> None:
        """Counts a recorded row that so many designs have."""
        self.done, self.row = self.done + count, row
        self.failed += 0 if row["status"] == OK else count


def record_designs(
    designs: Sequence[DesignRow],
    function: Callable[[Any], Outcome],
    argument: Callable[[DesignRow], Any],
    executor: Executor,
    records: Records,
    on_row: Callable[[Progress], object] = lambda _: None,
) -> Progress:
    """Computes the designs that are not recorded, and records each the moment it arrives.

    Args:
        designs: All designs.
        function: What a worker does; see `evaluation.simulate_design` for its outcome.
        argument: Its argument for a design.
        executor: Where it is done.
        records: Where it is recorded, and what is so already.
        on_row: Called before the first row, and after each.

    Raises:
        InputError: A row or file cannot be written, or the executor is broken. What is recorded stays so.
    """
    alike: dict[str, list[DesignRow]] = {}
    for design in designs:
        alike.setdefault(design.digest, []).append(design)
    records.keep_only({digest: head(same[0]) for digest, same in alike.items()})
    progress = Progress(len(designs))
    for digest, row in records.rows.items():
        progress.add(row, len(alike[digest]))
    on_row(progress)
    todo = [same[0] for digest, same in alike.items() if digest not in records.rows]
    names = _folder_names(todo, {row["folder"] for row in records.rows.values()})

    def finish(design: DesignRow, outcome: Outcome) -> None:
        name, measures = "", {}
        if outcome.value is not None:
            measures, archive, compiled = outcome.value
            name = f"{DESIGNS}/{names[design.digest]}"
            unpack(archive, records.path.parent / name)
            progress.compiled += compiled
        said = {"status": outcome.status, "folder": name, "digest": design.digest}
        row = head(design) | {"seconds": outcome.seconds} | measures | said
        progress.computed += design.document is not None
        progress.add(records.append(row), len(alike[design.digest]))
        on_row(progress)

    for design in todo:
        if design.document is None:
            finish(design, Outcome(design.error))
    possible = [design for design in todo if design.document is not None]
    for place, outcome in evaluate(function, [argument(design) for design in possible], executor):
        finish(possible[place], outcome)
    return progress


def head(design: DesignRow) -> dict[str, Any]:
    """Number and values of a design, as its row has them."""
    return {"design": design.number, **design.values}


def _folder_names(designs: Sequence[DesignRow], used: set[str]) -> dict[str, str]:
    """Names of the folders of designs, by digest: their numbers, unless another design's results have it."""
    taken = {name.rpartition("/")[2] for name in used}
    names, following = {}, max([design.number for design in designs] + [int(name or 0) for name in taken], default=0)
    for design in designs:
        name = f"{design.number:04d}"
        if name in taken:
            following += 1
            name = f"{following:04d}"
        names[design.digest] = name
    return names


def unpack(archive: bytes, folder: Path) -> None:
    """Writes the files of a design into its folder, which is there whole or not at all.

    Raises:
        InputError: It cannot be written.
    """
    fresh = folder.with_name(PREFIX + folder.name)
    try:
        shutil.rmtree(fresh, ignore_errors=True)
        with zipfile.ZipFile(io.BytesIO(archive)) as files:
            files.extractall(fresh)
        shutil.rmtree(folder, ignore_errors=True)
        fresh.rename(folder)
    except OSError as error:
        shutil.rmtree(fresh, ignore_errors=True)
        raise write_error(folder, error, "free disk space, then resume with --resume") from None

"""Records of a sweep: results.csv, which gains a row the moment a design is done, and results.parquet."""

from __future__ import annotations

import csv
import io
import math
import os
import shutil
import zipfile
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from jaxform.core import disk
from jaxform.core.disk import PREFIX, atomic_path, write_all, write_error
from jaxform.core.errors import InputError
from jaxform.io.scene_rewriting import inline
from jaxform.sweeps.designs import DesignRow
from jaxform.sweeps.workers import OK, Outcome, evaluate

NAME, PARQUET, EARLIER = "results.csv", "results.parquet", "earlier.csv"
MEASURES = {
    "wall_min": "m",
    "wall_mean": "m",
    "wall_cv": "",
    "mass": "kg",
    "flash_mass": "kg",
    "contact_fraction": "",
    "gap_max": "m",
    "warnings": "",
    "seconds": "s",
}
"""Columns of what a simulation gives, and their units; `seconds` is the wall-clock time of a design on its worker."""
_FIRST, _STATUS, _LAST = "design", "status", ("folder", "digest")
_GO_ON = "then resume with --resume"
Row = dict[str, str]


class Records:
    """The file results.csv of a sweep.

    Rows are appended, each in one piece that is flushed to the disk before the next. A row that was incomplete when the
    process or the machine stopped is cut off.

    Args:
        folder: Folder of the results.
        paths: Columns of the variables.
        measures: Columns of what is computed.
        resume: True if rows that are there are kept.

    Attributes:
        path: The file.
        rows: Recorded rows, by digest of the design.

    Raises:
        InputError: The file is of another sweep, damaged, or cannot be read or written.
    """

    def __init__(self, folder: Path, paths: Sequence[str], measures: Iterable[str], resume: bool = False) -> None:
        """See the class."""
        self.path = folder / NAME
        self.columns = [_FIRST, *paths, _STATUS, *measures, *_LAST]
        self._given = {_FIRST, *paths, _STATUS, *_LAST}
        self.rows: dict[str, Row] = {}
        if resume and os.path.exists(self.path):
            self.rows = {row["digest"]: row for row in read_rows(self.path)}
        self._write(self.rows.values())

    def measures(self, digest: str) -> Row:
        """The values of a recorded design, by column."""
        return {name: text for name, text in self.rows[digest].items() if name not in self._given}

    def keep_only(self, heads: Mapping[str, Mapping[str, Any]]) -> None:
        """Moves rows of designs that are no longer requested to earlier.csv, so that no result is lost.

        Args:
            heads: Number and values of the requested designs, by digest; the rows adopt them.
        """
        gone = [row for digest, row in self.rows.items() if digest not in heads]
        if gone:
            earlier = self.path.with_name(EARLIER)
            rows = [*(read_rows(earlier) if os.path.exists(earlier) else []), *gone]
            _write_table(earlier, list(dict.fromkeys(key for row in rows for key in row)), rows)
        kept = {digest: row for digest, row in self.rows.items() if digest in heads}
        self.rows = {digest: row | _texts(heads[digest]) for digest, row in kept.items()}
        self._write(self.rows.values())

    def append(self, row: Mapping[str, Any]) -> Row:
        """Writes a row at the end of the file, and returns it as text; what has no column gets one.

        Raises:
            InputError: It cannot be written; the file is as before.
        """
        new = [name for name in row if name not in self.columns]
        if new:
            place = len(self.columns) - len(_LAST)
            self.columns[place:place] = new
            self._write(self.rows.values())
        texts = {column: _text(row.get(column)) for column in self.columns}
        line = _lines([[texts[column] for column in self.columns]])
        try:
            with self.path.open("r+b", buffering=0) as file:
                end = file.seek(0, os.SEEK_END)
                try:
                    write_all(file, line)
                    os.fsync(file.fileno())
                except OSError:
                    file.truncate(end)
                    raise
        except OSError as error:
            raise write_error(self.path, error, _GO_ON) from None
        self.rows[texts["digest"]] = texts
        return texts

    def finish(self, heads: Iterable[tuple[str, Mapping[str, Any]]]) -> list[Row]:
        """Writes a row per design in their order, and returns them.

        Args:
            heads: Digest, and number and values, of each; two of the same digest have the same results.
        """
        rows = [self.rows[digest] | _texts(head) for digest, head in heads]
        self._write(rows)
        return rows

    def _write(self, rows: Iterable[Row]) -> None:
        _write_table(self.path, self.columns, rows)


def _texts(values: Mapping[str, Any]) -> Row:
    return {column: _text(value) for column, value in values.items()}


def _write_table(path: Path, columns: Sequence[str], rows: Iterable[Row]) -> None:
    with atomic_path(path, _GO_ON) as fresh, fresh.open("wb") as file:
        file.write(_lines([list(columns), *([row.get(column, "") for column in columns] for row in rows)]))
        file.flush()
        os.fsync(file.fileno())


def _lines(rows: Iterable[Sequence[str]]) -> bytes:
    text = io.StringIO(newline="")
    csv.writer(text, lineterminator="\n").writerows(rows)
    return text.getvalue().encode()


def _text(value: Any) -> str:
    """A value as the cell of a table: numbers to the last bit, lists as in a scene file; empty for None."""
    if value is None or (isinstance(value, float) and not math.isfinite(value)):
        return ""
    if isinstance(value, str):
        return " ".join(value.split()) if "\n" in value or "\r" in value else value
    return inline(value.item() if isinstance(value, np.generic) else value)


def read_rows(path: Path) -> list[Row]:
    """The rows of a table that was written before; a last line that was not written to its end is left out."""
    text = disk.read_text(path, disk.MOST_MESH)
    whole = text[: text.rfind("\n") + 1]
    remedy = "start again with --force, or choose another folder"
    try:
        rows = list(csv.DictReader(io.StringIO(whole, newline=""), strict=True))
    except csv.Error as error:
        raise InputError(f"is damaged: {error}", remedy, file=str(path)) from None
    for number, row in enumerate(rows, 2):
        if None in row or None in row.values() or not row.get("digest") or not row.get(_STATUS):
            raise InputError(f"is damaged in line {number}", remedy, file=str(path))
    return rows


def cell_value(text: str) -> float | bool | str:
    """The number, truth value or text that a cell was written for."""
    if text in ("true", "false"):
        return text == "true"
    found = number(text)
    return text if found is None else int(text) if text.lstrip("-").isdecimal() else found


def number(text: str | None) -> float | None:
    """The number of a cell; None if it is not a number."""
    try:
        return float(text) if text else None
    except ValueError:
        return None


def write_parquet(folder: Path, columns: Sequence[str], rows: Sequence[Row], units: Mapping[str, str]) -> bool:
    """Writes results.parquet: numbers as such, units as metadata of the columns; False without the library for it."""
    try:
        import pyarrow  # pyright: ignore[reportMissingImports]
        from pyarrow import parquet  # pyright: ignore[reportMissingImports]
    except ImportError:
        return False
    fields, arrays = [], []
    for column in columns:
        values: list[Any] = [row[column] or None for row in rows]
        numbers = [number(value) for value in values]
        kind = pyarrow.string()
        if column not in (_STATUS, *_LAST) and all(
            (a is None) == (b is None) for a, b in zip(values, numbers, strict=True)
        ):
            whole = column in (_FIRST, "warnings")
            kind = pyarrow.int64() if whole else pyarrow.float64()
            values = [None if value is None else int(value) if whole else value for value in numbers]
        unit = units.get(column, "")
        fields.append(pyarrow.field(column, kind, metadata={"unit": unit} if unit else None))
        arrays.append(pyarrow.array(values, kind))
    with atomic_path(folder / PARQUET, _GO_ON) as fresh:
        parquet.write_table(pyarrow.Table.from_arrays(arrays, schema=pyarrow.schema(fields)), fresh)
    return True


# The folder of a sweep: a row, and a folder of files, for each design as it arrives.

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
        function: The function that a worker calls; see `evaluation.simulate_design` for its outcome.
        argument: Its argument for a design.
        executor: The executor of the calls.
        records: The record, with the rows that are complete.
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
        raise write_error(folder, error, _GO_ON) from None

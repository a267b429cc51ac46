"""Journal of the requests of a search and their results, on disk, so that a killed search can be resumed.

A search is deterministic: when it is repeated, it makes the same requests. Those in the journal are answered from it,
without a simulation; no other state of the search is stored. Each line ends with a checksum: an incomplete last line is
left out, and a line that is damaged otherwise is refused. Lines are read one at a time, when they are needed, so that a
journal may be larger than the memory.
"""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import stat
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any, BinaryIO

from jaxform import InputError
from jaxform.scene_files import atomic_path, write_all, write_error

Answer = dict[str, Any]

MOST_LINE = 1 << 27
"""Bytes of a line at most: an answer about a mesh of a million elements has a third of that."""
_GO_ON = "then resume with --resume"
_ANEW = "start a new search with --force"
_KEYS = {"number", "kind", "at", "answer"}
_BEGIN = b'{"'  # of every line


class Journal:
    """Questions (numbers) and answers (named numbers and lists), in the order in which they were asked.

    Args:
        path: The file, or None to keep nothing.
        study: Hash of the study; a journal of another one is refused.
        resume: True if the file is read first; else it is rewritten.

    Attributes:
        replayed: Number of questions answered from the file so far.

    Raises:
        InputError: If the journal is of another study, damaged, or cannot be read or written.
    """

    def __init__(self, path: Path | None = None, study: str = "", resume: bool = False) -> None:
        """See the class."""
        self._path, self._study, self._resume, self.replayed = path, study, resume, 0
        self._known: list[slice] = []  # the bytes of each entry
        self._count = 0
        if path is None:
            return
        if resume and os.path.exists(path):
            self._known = _read(path, study)
            self._count = len(self._known)
            return
        with atomic_path(path, _GO_ON) as fresh:
            fresh.write_bytes(_line({"study": study}))

    def of_start(self, number: int) -> Journal:
        """The journal of one of several starts: of the first, this one; of others, a file beside it.

        Raises:
            InputError: As of the class.
        """
        if number == 1 or self._path is None:
            return self if number == 1 else Journal()
        path = self._path.with_suffix(f".{number}{self._path.suffix}")
        return Journal(path, f"{self._study} start {number}", self._resume)

    def ask(self, kind: str, at: list[float], compute: Callable[[], Answer]) -> tuple[Answer, bool]:
        """The answer to a question, and whether it was known from the file.

        Raises:
            InputError: If the file cannot be read or written any more.
        """
        if self.replayed < len(self._known):
            entry = self._entry(self._known[self.replayed])
            if entry["kind"] == kind and entry["at"] == at:
                self.replayed += 1
                return entry["answer"], True
            self._part()
        answer = compute()
        self._append(_line({"number": self._count + 1, "kind": kind, "at": at, "answer": answer}))
        self._count += 1
        return answer, False

    def _entry(self, span: slice) -> dict[str, Any]:
        assert self._path is not None
        try:
            with self._path.open("rb") as file:
                file.seek(span.start)
                entry = _parse_line(file.read(span.stop - span.start))
        except OSError as error:
            raise _read_error(self._path, error) from None
        if entry is None:
            raise _damage_error(self._path, self.replayed + 2)
        return entry

    def _part(self) -> None:
        """Ends the use of the file, since another version of the program makes other requests; saves it aside."""
        assert self._path is not None
        try:
            shutil.copyfile(self._path, self._path.with_suffix(".old"))
            os.truncate(self._path, self._known[self.replayed].start)
        except OSError as error:
            raise write_error(self._path, error, _GO_ON) from None
        self._known, self._count = self._known[: self.replayed], self.replayed

    def _append(self, line: bytes) -> None:
        if self._path is None:
            return
        end = None
        try:
            # Not created again where it is gone: a journal without its beginning is invalid.
            with self._path.open("r+b", buffering=0) as file:
                end = file.seek(0, os.SEEK_END)
                write_all(file, line)
        except OSError as error:
            if end is not None:
                with contextlib.suppress(OSError):
                    os.truncate(self._path, end)
            raise write_error(self._path, error, _GO_ON) from None


def _line(entry: dict[str, Any]) -> bytes:
    """An entry as a line of JSON, with the checksum of all before it as its last item."""
    body = json.dumps(entry).encode()
    return b'%b, "sum": %d}\n' % (body[:-1], zlib.crc32(body))


def _parse_line(line: bytes) -> dict[str, Any] | None:
    """The entry of a line; None where it is damaged."""
    head, _, tail = line.rpartition(b', "sum": ')
    body = head + b"}"
    if tail != b"%d}\n" % zlib.crc32(body):
        return None
    try:
        entry = json.loads(body)
    except (ValueError, RecursionError):
        return None
    whole_one = isinstance(entry, dict) and ("study" in entry or set(entry) == _KEYS)
    return entry if whole_one else None


def _read(path: Path, study: str) -> list[slice]:
    """Bytes of a journal's entries; cuts off a last line that was not written to its end."""
    try:
        if not stat.S_ISREG(path.stat().st_mode):
            raise InputError("is not a regular file", _ANEW, "--resume", str(path))
        with path.open("rb") as file:
            spans = _spans(path, file, study)
            size = file.seek(0, os.SEEK_END)
        if spans[-1].stop < size:
            os.truncate(path, spans[-1].stop)
    except OSError as error:
        raise _read_error(path, error) from None
    return spans[1:]


def _spans(path: Path, file: BinaryIO, study: str) -> list[slice]:
    """Bytes of all complete lines, the first one included."""
    spans: list[slice] = []
    begin = 0
    while line := file.readline(MOST_LINE):
        entry = _parse_line(line)
        if entry is None:
            last = not file.read(1)
            if spans and last and _is_truncated(line):
                return spans
            raise _damage_error(path, len(spans) + 1)
        if not spans and entry.get("study") != study:
            remedy = "name its own folder, or start a new search with --force"
            raise InputError("belongs to another study, or to another version of it", remedy, "--resume", str(path))
        if spans and entry.get("number") != len(spans):
            raise _damage_error(path, len(spans) + 1)
        spans.append(slice(begin, begin + len(line)))
        begin += len(line)
    if not spans:
        raise InputError("is empty", _ANEW, "--resume", str(path))
    return spans


def _is_truncated(line: bytes) -> bool:
    """True if a line starts like one of a journal and is incomplete."""
    if _parse_line(line + b"\n"):
        return True
    try:
        json.loads(line)
    except (ValueError, RecursionError):
        return line.startswith(_BEGIN) or _BEGIN.startswith(line)
    return False


def _damage_error(path: Path, number: int) -> InputError:
    problem = f"is damaged: line {number} was not written by a search"
    remedy = (
        "delete that line and all following ones to resume from there, or start a new search with --force"
        if number > 1
        else _ANEW
    )
    return InputError(problem, remedy, "--resume", str(path))


def _read_error(path: Path, error: OSError) -> InputError:
    return InputError(f"cannot be read ({error.strerror or error})", _ANEW, "--resume", str(path))

"""What a search asked and was told, kept on disk as it goes, so that one that was killed goes on where it was.

A search is deterministic: begun again, it asks the same questions. Those that are in the journal are answered from
there, without a simulation; nothing else of the search has to be kept. A line that was being written when the process
died is left out.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

from jaxform import InputError

Answer = dict[str, Any]


class Journal:
    """Questions (numbers) and answers (named numbers and lists), in the order in which they were asked.

    Args:
        path: The file, or None to keep nothing.
        study: What tells studies apart; a journal of another one is refused.
        resume: Whether the file is read first; else it is written anew.

    Attributes:
        replayed: How many questions were answered from the file so far.

    Raises:
        InputError: If the journal is of another study or cannot be read.
    """

    def __init__(self, path: Path | None = None, study: str = "", resume: bool = False) -> None:
        """See the class."""
        self._path, self.replayed = path, 0
        self._known = _read(path, study) if path is not None and resume and path.exists() else []
        if path is not None:
            self._write_anew([{"study": study}, *self._known])

    def ask(self, kind: str, at: list[float], compute: Callable[[], Answer]) -> tuple[Answer, bool]:
        """The answer to a question, and whether it was known from the file."""
        if self.replayed < len(self._known):
            entry = self._known[self.replayed]
            if entry["kind"] == kind and entry["at"] == at:
                self.replayed += 1
                return entry["answer"], True
            # Another version of the program would search otherwise: from here on nothing is known.
            self._known = self._known[: self.replayed]
            self._write_anew([self._first, *self._known])
        answer = compute()
        self._append({"kind": kind, "at": at, "answer": answer})
        return answer, False

    def _write_anew(self, entries: list[dict[str, Any]]) -> None:
        if self._path is None:
            return
        self._first = entries[0]
        text = "".join(json.dumps(entry) + "\n" for entry in entries)
        fresh = self._path.with_suffix(".new")
        fresh.write_text(text, encoding="utf-8")
        fresh.replace(self._path)

    def _append(self, entry: dict[str, Any]) -> None:
        if self._path is not None:
            with self._path.open("a", encoding="utf-8") as file:
                file.write(json.dumps(entry) + "\n")


def _read(path: Path, study: str) -> list[dict[str, Any]]:
    entries = []
    try:
        lines = path.read_text(encoding="utf-8").split("\n")
    except (OSError, UnicodeDecodeError):
        raise InputError("cannot be read", "search anew with --force", "--resume", str(path)) from None
    for line in lines:
        try:
            entries.append(json.loads(line))
        except json.JSONDecodeError:
            break
    if not entries or entries[0].get("study") != study:
        mend = "name its own folder, or search anew with --force"
        raise InputError("is of another study, or of another version of it", mend, "--resume", str(path))
    return entries[1:]

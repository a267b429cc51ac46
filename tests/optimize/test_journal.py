"""The journal of a search: damage is one line and loses nothing; what cannot be written is one line."""

from __future__ import annotations

import json
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from benchmarks.hostile import fuzz_journals
from jaxform import InputError
from jaxform.core.disk import PREFIX, atomic_path
from optimize import Journal, write_history
from optimize.designs import COLUMNS

pytestmark = pytest.mark.quick

STUDY = "study"


def _write_journal(path: Path, count: int = 4) -> list[bytes]:
    journal = Journal(path, STUDY)
    for number in range(count):
        journal.ask("value", [float(number)], lambda number=number: {"value": 10.0 * number, "error": float("nan")})
    return path.read_bytes().splitlines(keepends=True)


def _count_known(path: Path, count: int = 4) -> int:
    """Number of answers that a resumed journal knows; all of them are right."""
    journal = Journal(path, STUDY, resume=True)
    for number in range(count):
        answer = journal.ask("value", [float(number)], lambda number=number: {"value": 10.0 * number})[0]
        assert answer["value"] == 10.0 * number
    return journal.replayed


def _without_key(key: str) -> Callable[[bytes], bytes]:
    return lambda line: json.dumps({k: v for k, v in json.loads(line).items() if k != key}).encode() + b"\n"


def _with_key(change: dict[str, Any]) -> Callable[[bytes], bytes]:
    return lambda line: json.dumps(json.loads(line) | change).encode() + b"\n"


DAMAGE: list[Callable[[bytes], bytes]] = [
    lambda _: b"5\n",
    lambda _: b"null\n",
    lambda _: b"[1]\n",
    lambda _: b"{}\n",
    lambda _: b"NaN\n",
    lambda _: b"\n",
    lambda _: b"\xff\xfe\x00junk\x80\n",
    lambda _: b"\x00" * 100 + b"\n",
    lambda _: b"[" * 100_000 + b"\n",
    _without_key("kind"),
    _without_key("at"),
    _without_key("answer"),
    _without_key("sum"),
    _with_key({"at": "text"}),
    _with_key({"answer": 5}),
    _with_key({"answer": {"value": "0.5"}}),
    _with_key({"answer": {"value": None}}),
    lambda line: line.replace(b"10.0", b"11.0").replace(b"30.0", b"31.0"),
    lambda line: line.replace(b"\n", b"\r\n"),
    lambda line: line + line,
]


@pytest.mark.parametrize("damage", DAMAGE)
@pytest.mark.parametrize("number", [2, 4])
def test_a_damaged_line_is_named_and_nothing_is_changed(
    tmp_path: Path, damage: Callable[[bytes], bytes], number: int
) -> None:
    path = tmp_path / "search.jsonl"
    lines = _write_journal(path)
    lines[number] = damage(lines[number])
    path.write_bytes(b"".join(lines))
    before = path.read_bytes()
    with pytest.raises(InputError, match=r"damaged: line \d.*delete that line.*--force") as caught:
        Journal(path, STUDY, resume=True)
    assert "\n" not in str(caught.value) and str(path) in str(caught.value)
    assert path.read_bytes() == before
    # The remedy works: what comes before the damage is known.
    path.write_bytes(b"".join(lines[:number]))
    assert _count_known(path) == number - 1


def test_a_line_that_was_cut_by_a_kill_is_left_out(tmp_path: Path) -> None:
    path = tmp_path / "search.jsonl"
    lines = _write_journal(path)
    for length in range(len(lines[-1])):
        path.write_bytes(b"".join(lines[:-1]) + lines[-1][:length])
        assert _count_known(path) == 3
        assert path.read_bytes().count(b"\n") == 5
    path.write_bytes(b"".join(lines))
    assert _count_known(path) == 4


def _link(path: Path, to: str) -> None:
    path.unlink()
    path.symlink_to(to)


def _pipe(path: Path) -> None:
    path.unlink()
    os.mkfifo(path)


@pytest.mark.parametrize(
    ("spoil", "words"),
    [
        (lambda path: _link(path, "/dev/zero"), "not a regular file"),
        (_pipe, "not a regular file"),
        (lambda path: os.truncate(path, 1 << 40), "damaged"),
        (lambda path: os.truncate(path, 0), "is empty"),
        (lambda path: path.write_bytes(b"{"), "damaged: line 1"),
        (lambda path: path.write_text('{"study": "study"}\n'), "damaged: line 1"),
        (lambda path: Journal(path, "another"), "another study"),
    ],
)
def test_what_is_no_journal_of_the_study(tmp_path: Path, spoil: Callable[[Path], object], words: str) -> None:
    path = tmp_path / "search.jsonl"
    _write_journal(path)
    spoil(path)
    with pytest.raises(InputError, match=f"--resume.*{words}"):
        Journal(path, STUDY, resume=True)


def test_what_another_course_does_not_ask_is_kept_aside(tmp_path: Path) -> None:
    path = tmp_path / "search.jsonl"
    whole_one = b"".join(_write_journal(path))
    journal = Journal(path, STUDY, resume=True)
    journal.ask("value", [0.0], dict)
    assert journal.ask("value", [7.0], lambda: {"value": 70.0}) == ({"value": 70.0}, False)
    assert (tmp_path / "search.old").read_bytes() == whole_one
    assert len(path.read_bytes().splitlines()) == 3
    assert Journal(path, STUDY, resume=True).ask("value", [0.0], dict)[1]


def test_a_folder_that_went_away_is_one_line(tmp_path: Path) -> None:
    folder = tmp_path / "out"
    folder.mkdir()
    journal = Journal(folder / "search.jsonl", STUDY)
    (folder / "search.jsonl").unlink()
    folder.rmdir()
    row = dict.fromkeys(COLUMNS, 0)
    for attempt in (
        lambda: journal.ask("value", [1.0], dict),
        lambda: write_history(folder / "history.csv", [row]),
        lambda: Journal(folder / "search.jsonl", STUDY),
    ):
        with pytest.raises(InputError, match=r"cannot be written \(No such file.*--resume"):
            attempt()
    assert not folder.exists()


def test_a_full_disk_is_one_line_and_keeps_what_was_there(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "search.jsonl"
    lines = _write_journal(path)
    journal = Journal(path, STUDY, resume=True)
    for number in range(4):
        journal.ask("value", [float(number)], dict)
    monkeypatch.setattr(Path, "open", _opens_a_full_disk)
    with pytest.raises(InputError, match=r"cannot be written \(No space left.*free disk space.*--resume"):
        journal.ask("value", [9.0], dict)
    monkeypatch.undo()
    assert path.read_bytes() == b"".join(lines) and _count_known(path) == 4


class _Full:
    """A file on a disk that is full after a few bytes."""

    def __init__(self, path: Path) -> None:
        self._file = open(path, "r+b", buffering=0)

    def __enter__(self) -> _Full:
        return self

    def __exit__(self, *_: object) -> None:
        self._file.close()

    def seek(self, *place: int) -> int:
        return self._file.seek(*place)

    def write(self, line: bytes) -> int:
        self._file.write(line[:7])
        raise OSError(28, "No space left on device")


def _opens_a_full_disk(path: Path, *_: object, **__: object) -> _Full:
    return _Full(path)


def test_files_are_there_whole_or_not_at_all(tmp_path: Path) -> None:
    path = tmp_path / "facts.json"
    path.write_text("old")
    with pytest.raises(KeyError), atomic_path(path) as fresh:
        fresh.write_text("half of")
        raise KeyError
    assert path.read_text() == "old" and [file.name for file in tmp_path.iterdir()] == ["facts.json"]
    with atomic_path(path) as fresh:
        assert fresh.name.startswith(PREFIX)
        fresh.write_text("new")
        assert path.read_text() == "old"
    assert path.read_text() == "new" and len(list(tmp_path.iterdir())) == 1


def test_damaged_journals_are_refused_or_go_on_rightly(tmp_path: Path) -> None:
    """A small part of `make fuzz`."""
    found = fuzz_journals.fuzz(tmp_path, 45, seed=7)
    assert found["refused"] + found["goes on"] == 45 and found["hang"] == 0 and found["refused"] > 30, found

"""Damaged journals of a search: each is refused in one line, or goes on with nothing but right answers.

Run it with `python -m benchmarks.hostile.fuzz_journals COUNT SEED`. A journal is written, damaged in one of many
ways, and opened as --resume does; then the questions of the search are asked again.
"""

from __future__ import annotations

import json
import os
import random
import resource
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

from jaxform import InputError
from optimize.journal import Journal

_STUDY = "5eed float64"
_LONGEST, _MOST_MEMORY = 30.0, 2.0e9  # s, bytes: beyond them it counts as a hang, or as too much
_ODD = [
    "5",
    "null",
    "[1]",
    "{}",
    '"text"',
    "NaN",
    "true",
    "",
    "{",
    "\x00" * 40,
    "[" * 5000,
    "9" * 5000,
    '{"kind": "value"}',
]
_ODD_VALUES: list[Any] = [None, "text", [], {}, float("nan"), -1, True, "1.0", [[1]], 10**400]

Questions = list[tuple[str, list[float], dict[str, Any]]]


def questions(random_: random.Random) -> Questions:
    """Questions of a search, and the answers."""
    asked = []
    for number in range(random_.randint(2, 12)):
        at = [random_.gauss(0, 1) for _ in range(4)]
        answer = {
            "value": random_.random(),
            "gradient": at,
            "status": 0,
            "error": float("nan"),
            "elapsed": float(number),
        }
        asked.append((random_.choice(["value", "gradient", "check"]), at, answer))
    return asked


def write(path: Path, asked: Questions) -> None:
    """The journal of a search that asked this."""
    journal = Journal(path, _STUDY)
    for kind, at, answer in asked:
        journal.ask(kind, at, lambda answer=answer: answer)


# --- Ways to damage a journal -----------------------------------------------------------------------------------------


def _replace_line(path: Path, random_: random.Random) -> None:
    lines = path.read_text().splitlines()
    lines[random_.randrange(len(lines))] = random_.choice(_ODD)
    path.write_text("\n".join(lines) + "\n")


def _change_key(path: Path, random_: random.Random) -> None:
    """A key left out, or with a value of another kind, deep inside or at the top."""
    lines = path.read_text().splitlines()
    number = random_.randrange(len(lines))
    table = entry = json.loads(lines[number])
    if "answer" in entry and random_.random() < 0.6:
        table = entry["answer"]
    key = random_.choice(sorted(table))
    if random_.random() < 0.4:
        del table[key]
    else:
        table[key] = random_.choice(_ODD_VALUES)
    lines[number] = json.dumps(entry)
    path.write_text("\n".join(lines) + "\n")


def _cut(path: Path, random_: random.Random) -> None:
    os.truncate(path, random_.randrange(path.stat().st_size + 1))


def _flip_bytes(path: Path, random_: random.Random) -> None:
    content = bytearray(path.read_bytes())
    for _ in range(random_.randint(1, 5)):
        content[random_.randrange(len(content))] ^= 1 << random_.randrange(8)
    path.write_bytes(bytes(content))


def _insert_junk(path: Path, random_: random.Random) -> None:
    content = path.read_bytes()
    at = random_.choice([0, len(content), random_.randrange(len(content))])
    path.write_bytes(content[:at] + random_.randbytes(random_.randint(1, 300)) + content[at:])


def _move_lines(path: Path, random_: random.Random) -> None:
    """Lines swapped, doubled or left out."""
    lines = path.read_bytes().splitlines(keepends=True)
    here, there = random_.randrange(len(lines)), random_.randrange(len(lines))
    change = random_.randrange(3)
    if change == 0:
        lines[here], lines[there] = lines[there], lines[here]
    elif change == 1:
        lines.insert(there, lines[here])
    else:
        del lines[here]
    path.write_bytes(b"".join(lines))


def _another_study(path: Path, random_: random.Random) -> None:
    other = Journal(path, random_.choice(["another float64", "5eed float32", ""]))
    other.ask("value", [1.0], dict)


def _other_line_ends(path: Path, random_: random.Random) -> None:
    text = path.read_bytes()
    path.write_bytes(
        random_.choice([text.replace(b"\n", b"\r\n"), b"\xef\xbb\xbf" + text, text.decode().encode("utf-16")])
    )


def _no_journal(path: Path, random_: random.Random) -> None:
    """A device, an endless or huge file, a pipe, a folder, nothing."""
    kind = random_.choice(["zero", "urandom", "sparse", "pipe", "folder", "dangling", "empty"])
    if kind != "sparse":
        path.unlink()
    if kind in ("zero", "urandom"):
        path.symlink_to(f"/dev/{kind}")
    elif kind == "sparse":
        os.truncate(path, 1 << 40)
    elif kind == "pipe":
        os.mkfifo(path)
    elif kind == "folder":
        path.mkdir()
    elif kind == "dangling":
        path.symlink_to("nowhere")
    else:
        path.touch()


WAYS: list[Callable[[Path, random.Random], None]] = [
    _replace_line,
    _change_key,
    _cut,
    _flip_bytes,
    _insert_junk,
    _move_lines,
    _another_study,
    _other_line_ends,
    _no_journal,
]


# --- What comes of it -------------------------------------------------------------------------------------------------


def outcome(path: Path, asked: Questions) -> str:
    """ "refused" or "goes on"; else what was wrong, in words."""
    before = path.read_bytes() if path.is_file() and path.stat().st_size < 1 << 20 else None
    try:
        journal = Journal(path, _STUDY, resume=True)
        for kind, at, answer in asked:
            if json.dumps(journal.ask(kind, at, lambda answer=answer: answer)[0]) != json.dumps(answer):
                return "a wrong answer"
    except InputError as error:
        if len(str(error).splitlines()) != 1 or str(path) not in str(error):
            return "no line that names the file"
        if before is not None and path.read_bytes() != before:
            return "refused, and changed"
        return "refused"
    except Exception as error:
        return f"traceback: {type(error).__name__}"
    return "goes on"


def fuzz(folder: Path, count: int, seed: int) -> Counter[str]:
    """Counts the ends of damaged journals, those that took too long, and whether memory grew too much."""
    found: Counter[str] = Counter()
    for number in range(count):
        random_ = random.Random(f"{seed} {number}")
        path, asked = folder / f"{number}.jsonl", questions(random_)
        write(path, asked)
        WAYS[number % len(WAYS)](path, random_)
        begun = time.perf_counter()
        found[outcome(path, asked)] += 1
        found["hang"] += time.perf_counter() - begun > _LONGEST
        if path.is_file():
            path.unlink()
    found["over 2 GB"] += 1024 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss > _MOST_MEMORY
    return found


def main(arguments: list[str]) -> int:
    """Prints how damaged journals end; 1 where one was neither refused in a line nor went on rightly."""
    count, seed = ([int(text) for text in arguments] + [200, 1][len(arguments) :])[:2]
    with tempfile.TemporaryDirectory() as name:
        found = fuzz(Path(name), count, seed)
    print(f"{count} damaged journals: " + ", ".join(f"{number} {what}" for what, number in sorted(found.items())))
    return int(sum(found.values()) > found["refused"] + found["goes on"])


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))

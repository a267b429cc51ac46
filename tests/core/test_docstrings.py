"""Docstrings, documented attributes and comments begin with a noun or a verb, not with a question or "Of"."""

from __future__ import annotations

import ast
import io
import re
import tokenize
from collections.abc import Iterator
from pathlib import Path

import pytest

pytestmark = pytest.mark.quick

ROOT = Path(__file__).parents[2]
_QUESTION = r"(What|How|Which|Whether|Who|Whose|Why|Of)\b"
_OPENING = re.compile(rf"({_QUESTION}|Where\b)")
_DOCUMENTED = re.compile(rf"\s+[\w, *]+: ({_QUESTION}|Where\b)")


def _docstrings(text: str) -> Iterator[str]:
    """Docstrings of modules, classes, functions, constants and attributes: strings that are statements."""
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant) and isinstance(node.value.value, str):
            yield node.value.value


def _first_comment_lines(text: str) -> Iterator[str]:
    """The first line of each comment that has lines of its own, without its sign."""
    last = -1
    for token in tokenize.generate_tokens(io.StringIO(text).readline):
        if token.type == tokenize.COMMENT and token.line.strip().startswith("#"):
            row = token.start[0]
            if row != last + 1:
                yield token.string.lstrip("# ")
            last = row


def _faults(text: str) -> list[str]:
    """Lines of a module that open with a question word or with "Of"."""
    found = [line for line in _first_comment_lines(text) if re.match(_QUESTION, line)]
    for docstring in _docstrings(text):
        first, *others = docstring.splitlines()
        found += [first] if _OPENING.match(first) else []
        # An error's condition may begin so: "InputError: Where ...".
        found += [line.strip() for line in others if _DOCUMENTED.match(line) and "Error: " not in line]
    return found


def test_openings_are_found() -> None:
    text = '"""Of a mesh."""\n# What it is.\n# How.\nX = 1  # Of it\n"""Sum.\n\nArgs:\n    a, b: Whether it is.\n"""\n'
    assert _faults(text) == ["What it is.", "Of a mesh.", "a, b: Whether it is."]
    assert not _faults('"""Offset.\n\nRaises:\n    InputError: Where it is.\n"""\n# Where it is open, it is used.\n')


@pytest.mark.parametrize("folder", ["jaxform", "optimize", "benchmarks", "tests", "tools"])
def test_docstrings_and_comments_open_with_their_subject(folder: str) -> None:
    found = {str(path): _faults(path.read_text()) for path in (ROOT / folder).rglob("*.py")}
    assert not {path: lines for path, lines in found.items() if lines}

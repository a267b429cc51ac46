"""The one error that bad input raises, and the warning that doubtful input gives: file, key, value and remedy."""

from __future__ import annotations

import contextlib
import os
import warnings
from collections.abc import Callable, Iterator
from contextvars import ContextVar
from dataclasses import dataclass, replace
from typing import Any

_HERE = os.path.dirname(os.path.dirname(__file__))  # the package: warnings name the line that called it


@dataclass(eq=False)
class InputError(ValueError):
    """Input that cannot be simulated.

    Its text is one line: ``FILE: KEY = VALUE: PROBLEM; MEND``, with the parts that are known.

    Attributes:
        problem: What is wrong, in words.
        remedy: What to do about it, in words.
        key: Dotted key in the scene or study file, or the name of the argument.
        value: The offending value.
        file: The file it was read from.
    """

    problem: str
    remedy: str = ""
    key: str = ""
    value: Any = None
    file: str = ""

    def with_context(self, *, file: str = "", key: str = "") -> InputError:
        """The error with the file and the key filled in where they are not known yet."""
        return replace(self, file=self.file or file, key=self.key or key)

    def __str__(self) -> str:
        """The one line for people."""
        key, value = truncate_text(self.key), None if self.value is None else _format_value(self.value)
        named = key if value is None else f"{key} = {value}" if key else value
        head = ": ".join(part for part in (truncate_text(self.file), named, truncate_text(self.problem)) if part)
        line = f"{head}; {self.remedy}" if self.remedy else head
        return " ".join(line.split())


class InputWarning(UserWarning):
    """Input that can be simulated, but is hardly what its author wants; the command writes it into summary.json too."""


def warn_of(problem: str, remedy: str = "", *, key: str = "", value: Any = None, file: str = "") -> None:
    """Warns of doubtful input, in the words of an `InputError`; it names the line of the user's code."""
    text, tell = str(InputError(problem, remedy, key, value, file)), _told.get()
    if tell is not None:
        tell(text)
    else:
        warnings.warn(text, InputWarning, stacklevel=2, skip_file_prefixes=(_HERE,))


_told: ContextVar[Callable[[str], object] | None] = ContextVar("told", default=None)


@contextlib.contextmanager
def redirect_warnings(tell: Callable[[str], object]) -> Iterator[None]:
    """Such warnings are told to a function: on a thread beside others, which may turn Python's warnings off and on."""
    token = _told.set(tell)
    try:
        yield
    finally:
        _told.reset(token)


@contextlib.contextmanager
def collect_warnings(tell: Callable[[str], object]) -> Iterator[list[str]]:
    """The texts of the `InputWarning`s raised inside, each once and told at once; others go their usual way."""
    texts: list[str] = []
    with warnings.catch_warnings():
        otherwise = warnings.showwarning

        def show(message: Warning | str, category: type[Warning], *place: Any, **more: Any) -> None:
            if not issubclass(category, InputWarning):
                otherwise(message, category, *place, **more)
            elif str(message) not in texts:
                texts.append(str(message))
                tell(texts[-1])

        warnings.showwarning = show
        warnings.simplefilter("always", InputWarning)
        yield texts


@contextlib.contextmanager
def defer_warnings() -> Iterator[None]:
    """Defers the warnings raised inside the context to its end."""
    held: list[warnings.WarningMessage] = []
    try:
        with warnings.catch_warnings(record=True) as held:
            yield
    finally:
        for one in held:
            warnings.warn_explicit(one.message, one.category, one.filename, one.lineno)


def _format_value(value: Any, limit: int = 160) -> str:
    """The value as it would be typed, cut to the limit."""
    return truncate_text(repr(value), limit)


def truncate_text(text: str, limit: int = 1000) -> str:
    """The text for people; of a long one the begin and the end, where a path has its name."""
    return text if len(text) <= limit else f"{text[: limit // 4]} ... {text[-limit // 2 :]}"

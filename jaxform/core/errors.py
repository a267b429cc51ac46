"""Errors and warnings about input (file, key, value, remedy), errors of the system, and places in words."""

from __future__ import annotations

import contextlib
import errno
import os
import warnings
from collections.abc import Callable, Iterable, Iterator
from contextvars import ContextVar
from dataclasses import dataclass, replace
from typing import Any

_HERE = os.path.dirname(os.path.dirname(__file__))  # the package: warnings name the line that called it


@dataclass(eq=False)
class InputError(ValueError):
    """Input that cannot be simulated.

    Its text is one line: ``FILE: KEY = VALUE: PROBLEM; REMEDY``, with the parts that are known.

    Attributes:
        problem: Description of the problem.
        remedy: Description of the remedy.
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
    """Warning of input that can be simulated, but is probably wrong; the command writes it into summary.json, too."""


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
    """Passes such warnings to a function, also on a thread beside others that turn Python's warnings off and on."""
    token = _told.set(tell)
    try:
        yield
    finally:
        _told.reset(token)


@contextlib.contextmanager
def collect_warnings(tell: Callable[[str], object]) -> Iterator[list[str]]:
    """The texts of the `InputWarning`s raised inside, each passed on once and at once; others are unaffected."""
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
    """The value as it would be typed, truncated to the limit."""
    return truncate_text(repr(value), limit)


def truncate_text(text: str, limit: int = 1000) -> str:
    """The text for people; of a long one the start and the end, where a path has its name."""
    return text if len(text) <= limit else f"{text[: limit // 4]} ... {text[-limit // 2 :]}"


# Places in words.


def format_coordinate(value: float, factor: float = 1.0, digits: int = 4) -> str:
    """A coordinate [m], times a factor, without rounding errors of 0 or a negative zero."""
    return f"{factor * round(float(value), 10) + 0.0:.{digits}g}"


def format_number(value: float, digits: int) -> str:
    """A number rounded to some digits, without an exponent below ten million."""
    return f"{float(f'{value:.{digits}g}'):.7g}"


def format_percent(share: float, digits: int = 2) -> str:
    """A share in per cent, rounded to some digits, and without an exponent where it is large."""
    return f"{format_number(100 * share, digits)} %"


def format_place(point: Iterable[float]) -> str:
    """A place [m] in words."""
    return f"({', '.join(map(format_coordinate, point))}) m"


def format_extent(low: Iterable[float], high: Iterable[float]) -> str:
    """The least and the largest coordinates [m] in words."""
    sides = zip(map(format_coordinate, low), map(format_coordinate, high), strict=True)
    return " x ".join(f"{least} to {largest}" for least, largest in sides) + " m"


# One-line descriptions of errors of the system or the machine: not of the input alone, nor of the program.

_NO_ROOM = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)


def describe_system_error(error: BaseException) -> str | None:
    """A description of the error and its remedy; None for an error that only a programmer can fix."""
    if isinstance(error, OSError):
        return _describe_os_error(error)
    if isinstance(error, RecursionError):
        return "the input is nested too deeply; simplify it"
    # XLA's is a RuntimeError, recognized by its text alone.
    if isinstance(error, MemoryError) or "RESOURCE_EXHAUSTED" in str(error):
        return "there is not enough memory; use fewer elements, a lower max_level or a coarser mold"
    return None


def remedy_of_writing(error: OSError) -> str:
    """The remedy for a file that cannot be written: disk space, unless the reason is another one."""
    if error.errno == errno.EFBIG:
        return "raise the limit on the size of files (ulimit -f)"
    if error.errno in (errno.EACCES, errno.EPERM, errno.EROFS):
        return "make it and its folder writable"
    return "free disk space"


def _describe_os_error(error: OSError) -> str:
    what = " ".join((error.strerror or str(error) or type(error).__name__).split())
    place = f"{truncate_text(error.filename)}: " if isinstance(error.filename, str) else ""
    if error.errno in _NO_ROOM:
        return f"{place}{what}; {remedy_of_writing(error)}, or choose another folder"
    if isinstance(error, FileNotFoundError):
        return f"{place}{what}; it or its folder was removed during the run"
    return f"{place}{what}; check the file, its folder and their permissions"

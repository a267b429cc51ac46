"""Warnings of doubtful input: each is told once, whichever thread it comes from."""

from __future__ import annotations

import threading
import warnings

import pytest

from jaxform.core.errors import collect_warnings, redirect_warnings, warn_of

pytestmark = pytest.mark.quick


def test_a_warning_of_another_thread_is_told_while_this_one_has_warnings_off() -> None:
    told: list[str] = []

    def look() -> None:
        with redirect_warnings(told.append):
            warn_of("is doubtful", "look again", key="mold")

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        thread = threading.Thread(target=look)
        thread.start()
        thread.join()
        warn_of("is not told", "nowhere")  # this thread's go their usual way
    assert told == ["mold: is doubtful; look again"]


def test_each_warning_is_told_once() -> None:
    told: list[str] = []
    with collect_warnings(told.append) as texts:
        for key in ("mold", "mold", "parison"):
            warn_of("is doubtful", key=key)
    assert told == texts == ["mold: is doubtful", "parison: is doubtful"]

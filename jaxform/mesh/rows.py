"""Rows of an array without repeats, as `numpy.unique` gives them but many times as fast, and of lists. On the host."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray


def positions_in_rows(counts: NDArray[np.integer]) -> NDArray[np.int64]:
    """0, 1, ... up to each count (n,), one after the other: the places of entries in their rows."""
    return np.arange(int(counts.sum())) - np.repeat(np.cumsum(counts) - counts, counts)


def unique_ascending(numbers: NDArray[np.int64]) -> NDArray[np.int64]:
    """Each of some numbers (n,) once, ascending; NumPy's `unique` takes many times as long."""
    found = np.sort(numbers)
    first = np.ones(len(found), bool)
    first[1:] = found[1:] != found[:-1]
    return found[first]


def distinct_rows(rows: NDArray[Any]) -> tuple[NDArray[Any], NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]:
    """The distinct ones of rows (n, c) of numbers, sorted by their first column, then by the next.

    Returns:
        As `numpy.unique`: each row once (k, c); the index of its first occurrence (k,); the index among them of each
        row of the array (n,); the number of occurrences (k,).
    """
    order = np.lexsort(rows.T[::-1])
    ordered = rows[order]
    fresh = np.ones(len(rows), bool)
    fresh[1:] = (ordered[1:] != ordered[:-1]).any(1)
    inverse = np.empty(len(rows), np.int64)
    inverse[order] = np.cumsum(fresh) - 1
    begin = np.flatnonzero(fresh)
    return ordered[begin], order[begin], inverse, np.diff(begin, append=len(rows))

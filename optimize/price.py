"""Cost of a search in relation to its gain."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np

from optimize.designs import KEPT

_LAST = 0.1  # of the gain, whose cost is reported


def price(rows: Iterable[Mapping[str, Any]]) -> dict[str, float] | None:
    """Gain of a search, and the cost of its last tenth.

    Args:
        rows: Rows of the history, in their order.

    Returns:
        `gain`, from the first design that keeps its limits to the best one, as the objective counts;
        `gain_relative`, the same over the first one's objective; `simulations_for_nine_tenths` of it, from the start;
        and `simulations_for_the_last_tenth`: from there to the search's end, rejected designs included. Both in
        simulations, by their measured time; between two best designs the gain is linear. None where nothing was
        gained.
    """
    curve: list[tuple[float, float]] = []
    spent = 0.0
    for row in rows:
        spent = float(row["simulations"])
        if row.get("violation", 0.0) <= KEPT and (not curve or row["objective"] < curve[-1][1]):
            curve.append((spent, float(row["objective"])))
    if len(curve) < 2:
        return None
    first, best = curve[0][1], curve[-1][1]
    costs, values = np.array(curve).T
    nearly = float(np.interp(-(best + _LAST * (first - best)), -values, costs))
    return {
        "gain": first - best,
        "gain_relative": (first - best) / abs(first),
        "simulations_for_nine_tenths": nearly,
        "simulations_for_the_last_tenth": spent - nearly,
    }

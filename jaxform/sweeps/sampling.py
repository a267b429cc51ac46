"""Designs of experiments: full factorials, Latin hypercubes and Sobol sequences over the variables of a sweep."""

from __future__ import annotations

import itertools
import warnings
from collections.abc import Sequence
from typing import Any

import numpy as np

from jaxform.core.errors import InputError, warn_of
from jaxform.io.schema import SweepTable, SweepVariableTable
from jaxform.io.schema.sweep import MOST_DESIGNS

MOST_SOBOL = 21_201
"""Variables of a Sobol sequence for which SciPy has direction numbers."""


def sample(table: SweepTable) -> list[dict[str, Any]]:
    """The designs of a sweep's table: values by path, in the units of the scene file.

    Points of a Latin hypercube and of a Sobol sequence (scrambled) are those of `scipy.stats.qmc`.

    Raises:
        InputError: There are too many designs.

    Warns:
        InputWarning: A Sobol sequence has a number of designs that is no power of two.
    """
    paths = [variable.path for variable in table.variable]
    if table.method == "factorial":
        levels = [_levels(variable) for variable in table.variable]
        count = int(np.prod([float(len(values)) for values in levels]))
        if count > MOST_DESIGNS:
            remedy = 'take fewer levels or variables, or method = "sobol"'
            raise InputError(f"makes {count} designs, more than {MOST_DESIGNS}", remedy, "sweep.method", table.method)
        return [dict(zip(paths, row, strict=True)) for row in itertools.product(*levels)]
    columns = [
        [_place(variable, float(share)) for share in shares]
        for variable, shares in zip(table.variable, _shares(table).T, strict=True)
    ]
    return [dict(zip(paths, row, strict=True)) for row in zip(*columns, strict=True)]


def _shares(table: SweepTable) -> np.ndarray:
    """Points in the unit cube (n_design, n_variable)."""
    from scipy.stats import qmc  # takes half a second to import

    count, dimension = table.designs or 0, len(table.variable)
    if table.method == "latin-hypercube":
        return qmc.LatinHypercube(dimension, rng=table.seed).random(count)
    if count & (count - 1):
        lower = 1 << (count.bit_length() - 1)
        words = f"is no power of two: the points of a Sobol sequence are balanced for {lower} or {2 * lower}"
        warn_of(words, "choose one of these", key="sweep.designs", value=count)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # SciPy's own words for the same
        return qmc.Sobol(dimension, rng=table.seed).random(count)


def _levels(variable: SweepVariableTable) -> Sequence[Any]:
    """The values of a variable in a full factorial."""
    if variable.values is not None:
        return variable.values
    shares = np.linspace(0.0, 1.0, variable.levels)
    return list(dict.fromkeys(_place(variable, float(share)) for share in shares))


def _place(variable: SweepVariableTable, share: float) -> Any:
    """The value at a share between 0 and 1 of a variable's range."""
    if variable.values is not None:
        return variable.values[min(int(share * len(variable.values)), len(variable.values) - 1)]
    assert variable.bounds is not None
    low, high = variable.bounds
    if variable.integer:
        # Each whole number has the same share, the two at the ends included.
        least, most = int(np.ceil(low)), int(np.floor(high))
        if variable.scale == "linear":
            return min(least + int(share * (most - least + 1)), most)
    if share in (0.0, 1.0):
        value = (low, high)[int(share)]  # the logarithm's inverse misses them by rounding
    elif variable.scale == "log":
        value = float(low * (high / low) ** share)
    else:
        value = float(low + share * (high - low))
    return round(value) if variable.integer else value

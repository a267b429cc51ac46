"""A fit: numbers of a material from tests, what it leaves unexplained, and its words, tables and files."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from jaxform import InputError, Law
from jaxform.core.errors import warn_of
from jaxform.core.parameters import listed_numbers
from jaxform.materials import LAWS
from optimize.fitting import solving, states
from optimize.fitting.numbers import VISCOUS, make_numbers
from optimize.fitting.problem import WEIGHTS, only_slow
from optimize.fitting.solving import Solution, Sure
from optimize.fitting.tables import Bubble, Pull, Table

Array = np.ndarray

MOST_TERMS, MOST_MODES = 6, 6
_USUAL_TERMS, _USUAL_MODES = 3, 4
_ALIKE = 0.99  # a correlation of two numbers that the tests can hardly tell apart
_POOR = 0.2  # a mean relative error with which a law is hardly the right one
_CURVE = 120  # points of a curve that is drawn
_MORE = "give tests of other kinds, or choose a law of fewer numbers"
ASSUMPTION = "the weighted differences are independent and of equal variance, and the law is the right one"


class Match(NamedTuple):
    """A measured column of a table and what the law says of it.

    Attributes:
        table: The table.
        column: Name of the column.
        measured: (n,), in the unit of the file; nominal stress.
        fitted: (n,).
        used: Which rows (n,) are strained, and count.
    """

    table: Table
    column: str
    measured: Array
    fitted: Array
    used: Array

    @property
    def errors(self) -> Array:
        """Relative differences of the rows that count; of what was measured as 0 there are none."""
        count = self.used & (self.measured != 0.0)
        return np.abs(self.fitted[count] / self.measured[count] - 1.0)


@dataclass(frozen=True)
class Fit:
    """Numbers of a material from tests.

    Attributes:
        model: The law's name.
        kind: Of the viscous modes; empty where there are none.
        solution: The numbers.
        sure: How sure they are.
        weights: How differences were weighted.
        matches: Each measured column, and what the law says of it.
    """

    model: str
    kind: str
    solution: Solution
    sure: Sure
    weights: str
    matches: tuple[Match, ...]

    @property
    def law(self) -> Law:
        """The law, of density 1000 kg/m^3, with its viscous modes."""
        return self.solution.problem.numbers.make(jnp.asarray(self.solution.free))

    def table(self, density: float) -> dict[str, Any]:
        """The table `[material]` of a scene file, its modes as a table `viscous` in it."""
        numbers = self.solution.problem.numbers
        found: dict[str, Any] = {}
        for number, value in zip(numbers.all, numbers.values(self.solution.free), strict=True):
            value = float(f"{value:.8g}")
            if number.place is None:
                found[number.name] = value
            else:
                found.setdefault(number.name, []).append(value)
        of_law = {name: value for name, value in found.items() if not name.startswith(VISCOUS)}
        made: dict[str, Any] = {"model": self.model, **of_law, "density": density}
        if self.kind:
            of_modes = {name.removeprefix(VISCOUS): value for name, value in found.items() if name.startswith(VISCOUS)}
            made["viscous"] = {"kind": self.kind, **of_modes}
        return made

    def summary(self, warned: Sequence[str], density: float) -> dict[str, Any]:
        """All that is known, as plain numbers, words, lists and tables, for summary.json."""
        return {
            "status": "ok",
            "model": self.model,
            "viscous": self.kind or None,
            "numbers": self._numbers(),
            "density": density,
            "level": solving.LEVEL,
            "assumption": ASSUMPTION,
            "weights": self.weights,
            "condition": self.sure.condition,
            "tables": [_facts(match) for match in self.matches],
            "warnings": list(warned),
        }

    def _numbers(self) -> list[dict[str, Any]]:
        numbers = self.solution.problem.numbers
        values = numbers.values(self.solution.free)
        rows = zip(numbers.all, values, self.sure.low, self.sure.high, self.sure.at_bound, strict=True)
        return [
            {
                "name": number.words,
                "value": float(value),
                "unit": number.allowed.unit,
                "interval": None if not np.isfinite([low, high]).all() else [float(low), float(high)],
                "at_bound": bool(bound),
            }
            for number, value, low, high, bound in rows
        ]

    def curve(self, table: Pull) -> tuple[Array, Array]:
        """Stretches and nominal stresses (k,) [Pa] of a slow test, to draw a line through."""
        low, high = min(1.0, table.stretch.min()), max(1.0, table.stretch.max())
        stretch = np.linspace(low, high, _CURVE)
        return stretch, np.asarray(states.along(self.law, table.state, jnp.asarray(stretch)))


def fit(
    tables: Sequence[Table],
    model: str,
    *,
    terms: int | None = None,
    modes: int | None = None,
    viscous: str = "christensen",
    weights: str = "relative",
) -> Fit:
    """Fits a law, and viscous modes where there are tests for them, to tests, all at once.

    Args:
        tables: The tests.
        model: The law's name in a scene file.
        terms: How long the law's lists are; 3 by default, for laws that have such.
        modes: How many viscous modes; by default, with relaxation tests, as many as say something by Schwarz's
            criterion, 4 at most, and none without.
        viscous: Their kind.
        weights: "relative" or "absolute".

    Raises:
        InputError: There is no such law, or the tests cannot tell its numbers.

    Warns:
        InputWarning: A number can hardly be told or lies at its bound, the law is unstable where it was fitted, or fits
            badly.
    """
    _check(model, terms, weights)
    stress = max(_largest_stress(table) for table in tables)
    times = _times(tables)
    _check_modes(tables, modes, times)
    solution, best, count = None, np.inf, 0
    for tried in _counts(tables, modes):
        terms = terms or _USUAL_TERMS
        numbers = make_numbers(model, terms, viscous, tried, stress, times)
        found = solving.solve(list(tables if tried else only_slow(tables)), numbers, weights, stress)
        if solution is not None and solving.information(found) >= best:
            break
        solution, best, count = found, solving.information(found), tried
    assert solution is not None
    found = Fit(
        model,
        viscous if count else "",
        solution,
        solving.sureness(solution.problem, solution.free),
        weights,
        tuple(_matches(solution)),
    )
    _look_over(found)
    return found


def _check(model: str, terms: int | None, weights: str) -> None:
    if model not in LAWS:
        raise InputError("is unknown", f"use {', '.join(LAWS)}", "--model", model)
    if terms is not None and not listed_numbers(LAWS[model]):
        raise InputError(f"means nothing to {model}", "leave it out: its numbers are no lists", "--terms", terms)
    for key, value, most in (("--terms", terms, MOST_TERMS),):
        if value is not None and not 1 <= value <= most:
            raise InputError("is out of range", f"give 1 to {most}", key, value)
    if weights not in WEIGHTS:
        raise InputError("is unknown", f"use {', '.join(WEIGHTS)}", "--weights", weights)


def _largest_stress(table: Table) -> float:
    if isinstance(table, Bubble):
        return float(table.pressure.max()) * table.radius / table.sheet
    return float(np.abs(table.stress).max())


def _times(tables: Sequence[Table]) -> tuple[float, float] | None:
    """The shortest and the longest time [s] that the tests tell of."""
    given = [table.time for table in tables if table.time is not None]
    if not given:
        return None
    steps = np.concatenate([np.diff(np.concatenate([[0.0], time])) for time in given])
    longest = max(float(time[-1]) for time in given)
    return (float(steps[steps > 0.0].min()), longest) if longest > 0.0 else None


def _check_modes(tables: Sequence[Table], modes: int | None, times: tuple[float, float] | None) -> None:
    if modes is not None and not 0 <= modes <= MOST_MODES:
        raise InputError("is out of range", f"give 0 to {MOST_MODES}", "--modes", modes)
    relaxing = any(table.kind == "relaxation" for table in tables)
    if modes and times is None:
        raise InputError("needs tests with a column time", "give a relaxation test", "--modes", modes)
    if modes == 0 and relaxing:
        raise InputError("leaves nothing that relaxes", "leave out the relaxation tests, or this option", "--modes", 0)


def _counts(tables: Sequence[Table], modes: int | None) -> Sequence[int]:
    """Of modes, those to try."""
    if modes is None and any(table.kind == "relaxation" for table in tables):
        return range(1, _USUAL_MODES + 1)
    return (modes or 0,)


def _matches(solution: Solution) -> list[Match]:
    problem = solution.problem
    fitted = problem.values(solution.free)
    return [
        Match(table, name, problem.measured[own], fitted[own], problem.used[own]) for table, name, own in problem.slices
    ]


def _facts(match: Match) -> dict[str, Any]:
    errors = match.errors
    return {
        "file": match.table.name,
        "kind": match.table.kind,
        "column": match.column,
        "rows": int(match.used.sum()),
        "mean_relative_error": float(errors.mean()) if errors.size else None,
        "largest_relative_error": float(errors.max()) if errors.size else None,
    }


def _look_over(fit: Fit) -> None:
    """Warns of what makes a fit doubtful."""
    solution = fit.solution
    if solution.unstable is not None:
        state, stretch = solution.unstable
        problem = f"is unstable from a stretch of {stretch:.4g} on ({state}), and no stable numbers were found"
        warn_of(problem, "choose another law, or fewer terms", key="--model", value=fit.model)
    elif solution.held_stable:
        warn_of(
            "would fit better where it is unstable; the numbers are the best stable ones",
            "look at the picture, or choose another law",
            key="--model",
            value=fit.model,
        )
    for match in fit.matches:
        if match.errors.size and match.errors.mean() > _POOR:
            problem = f"is off by {100 * match.errors.mean():.3g} % on average, in {match.column}"
            warn_of(
                problem, f"{fit.model} is hardly the law of this material, or a unit is wrong", file=match.table.name
            )
    _look_over_numbers(fit)


def _look_over_numbers(fit: Fit) -> None:
    numbers, sure = fit.solution.problem.numbers.all, fit.sure
    bound = [number.words for number, at in zip(numbers, sure.at_bound, strict=True) if at]
    if bound:
        warn_of(
            f"{', '.join(bound)} ended at the bound of what is allowed",
            "a simpler law may do for these tests",
        )
    values = fit.solution.problem.numbers.values(fit.solution.free)
    with np.errstate(invalid="ignore"):
        wide = ~sure.at_bound & ~(sure.high - sure.low < 2.0 * np.abs(values))
        alike = np.argwhere(np.triu(np.abs(sure.correlation), 1) > _ALIKE)
    if wide.any():
        words = ", ".join(number.words for number, is_wide in zip(numbers, wide, strict=True) if is_wide)
        warn_of(f"{words}: known to no better than the number itself", _MORE)
    if len(alike):
        pairs = ", ".join(f"{numbers[a].words} and {numbers[b].words}" for a, b in alike)
        warn_of(f"{pairs}: these tests hardly tell one from the other", _MORE)

"""Fitting of a material's parameters to tests: validation of the options, fit, and checks of the result."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import jax
import numpy as np

from jaxform import InputError
from jaxform.extend import LAWS, MODES, format_percent, list_parameter_names, warn_of
from optimize.fitting import solving
from optimize.fitting.numbers import make_numbers
from optimize.fitting.outcome import Fit, Match
from optimize.fitting.problem import WEIGHTS, only_slow
from optimize.fitting.solving import Solution
from optimize.fitting.tables import Bubble, Table

MOST_TERMS, MOST_MODES = 6, 6
_MOST_TRIED_TERMS, _MOST_TRIED_MODES = 3, 4
_ALIKE = 0.99  # correlation above which the tests hardly distinguish two parameters
_POOR = 0.2  # mean relative error above which a material model is doubtful
_MORE = "give tests of other types, or choose a model with fewer parameters"


def fit(
    tables: Sequence[Table],
    model: str,
    *,
    terms: int | None = None,
    modes: int | None = None,
    viscous: str | None = None,
    weights: str = "relative",
) -> Fit:
    """Fits a material model, and Prony terms where there are tests for them, to all tests at once.

    Args:
        tables: The tests.
        model: Name of the material model in a scene file.
        terms: Number of terms, for models with lists; by default chosen by Schwarz's criterion, 3 at most.
        modes: Number of Prony terms; by default none without relaxation tests, and with them chosen by the same
            criterion, 4 at most.
        viscous: Their kind; by default "christensen".
        weights: "relative" or "absolute".

    Raises:
        InputError: There is no such model, the tests do not determine its parameters, or JAX has no double precision.

    Warns:
        InputWarning: A parameter is poorly determined or at its bound, or the model is unstable in the fitted range or
            fits badly.
    """
    _check(tables, model, terms, viscous, weights)
    if viscous is not None and not modes and not _relaxation_tests(tables):
        problem = "cannot be used: no test is of type relaxation, and no Prony terms are requested"
        raise InputError(problem, "give a relaxation test, or --modes, or leave it out", "--viscous", viscous)
    viscous = viscous or "christensen"
    times = _times(tables)
    _check_modes(tables, modes, times)
    stress = max(_largest_stress(table) for table in tables)

    def solve_for(terms: int, modes: int) -> Solution:
        numbers = make_numbers(model, terms, viscous, modes, stress, times)
        return solving.solve(list(tables if modes else only_slow(tables)), numbers, weights, stress)

    mode_counts = range(1, _MOST_TRIED_MODES + 1) if modes is None and _relaxation_tests(tables) else (modes or 0,)
    term_counts = (
        range(1, _MOST_TRIED_TERMS + 1) if terms is None and list_parameter_names(LAWS[model]) else (terms or 1,)
    )
    solution, terms = _most_telling(term_counts, lambda count: solve_for(count, mode_counts[0]))
    if len(mode_counts) > 1:
        solution, modes = _most_telling(mode_counts, lambda count: solve_for(terms, count))
    matches = tuple(_matches(solution))
    confidence = solving.confidence_of(solution.problem, solution.free)
    found = Fit(model, viscous if modes else "", solution, confidence, weights, matches)
    _warn_of_doubtful_fit(found)
    return found


def _most_telling(counts: Sequence[int], solved: Callable[[int], Solution]) -> tuple[Solution, int]:
    """The last solution, by increasing number of parameters, that improves on the one before; and its count."""
    best = solved(counts[0]), counts[0]
    for count in counts[1:]:
        try:
            found = solved(count)
        except InputError:
            # More parameters than rows, or no admissible ones.
            break
        if _worth(found) >= _worth(best[0]):
            break
        best = found, count
    return best


def _worth(solution: Solution) -> tuple[bool, float]:
    """Rank of a solution, the smaller the better: stable models come first."""
    return solution.unstable is not None, solving.information(solution)


def _check(tables: Sequence[Table], model: str, terms: int | None, viscous: str | None, weights: str) -> None:
    if not tables:
        raise InputError("no test is given", "give one table at least", "tables")
    if model not in LAWS:
        raise InputError("is unknown", f"use {', '.join(LAWS)}", "--model", model)
    if terms is not None and not list_parameter_names(LAWS[model]):
        raise InputError(
            f"has no effect on {model}", "leave it out: the parameters of this model are not lists", "--terms", terms
        )
    if terms is not None and not 1 <= terms <= MOST_TERMS:
        raise InputError("is out of range", f"give 1 to {MOST_TERMS}", "--terms", terms)
    if viscous is not None and viscous not in MODES:
        raise InputError("is unknown", f"use {', '.join(MODES)}", "--viscous", viscous)
    if weights not in WEIGHTS:
        raise InputError("is unknown", f"use {', '.join(WEIGHTS)}", "--weights", weights)
    if not jax.config.jax_enable_x64:
        raise InputError("a fit needs double precision", 'call jax.config.update("jax_enable_x64", True) first')


def _largest_stress(table: Table) -> float:
    if isinstance(table, Bubble):
        return float(table.pressure.max()) * table.radius / table.sheet
    return float(np.abs(table.stress).max())


def _times(tables: Sequence[Table]) -> tuple[float, float] | None:
    """The shortest and the longest time [s] of the tests."""
    given = [table.time for table in tables if table.time is not None]
    if not given:
        return None
    steps = np.concatenate([np.diff(np.concatenate([[0.0], time])) for time in given])
    longest = max(float(time[-1]) for time in given)
    return (float(steps[steps > 0.0].min()), longest) if longest > 0.0 else None


def _check_modes(tables: Sequence[Table], modes: int | None, times: tuple[float, float] | None) -> None:
    if modes is not None and not 0 <= modes <= MOST_MODES:
        raise InputError("is out of range", f"give 0 to {MOST_MODES}", "--modes", modes)
    if modes and times is None:
        raise InputError("needs tests with a column time", "give a relaxation test", "--modes", modes)
    if modes == 0 and _relaxation_tests(tables):
        raise InputError(
            "leaves the relaxation tests without Prony terms",
            "leave out the relaxation tests, or this option",
            "--modes",
            0,
        )


def _relaxation_tests(tables: Sequence[Table]) -> bool:
    return any(table.kind == "relaxation" for table in tables)


def _matches(solution: Solution) -> list[Match]:
    problem = solution.problem
    fitted = problem.values(solution.free)
    return [
        Match(table, name, problem.measured[rows], fitted[rows], problem.used[rows])
        for table, name, rows in problem.slices
    ]


def _warn_of_doubtful_fit(fit: Fit) -> None:
    """Warns of the reasons for which a fit is doubtful."""
    solution = fit.solution
    if solution.unstable is not None:
        state, stretch = solution.unstable
        problem = f"is unstable from a stretch of {stretch:.4g} on ({state}), and no stable parameters were found"
        warn_of(problem, "choose another model, or fewer terms", key="--model", value=fit.model)
    elif solution.held_stable:
        warn_of(
            "fits better with unstable parameters; the parameters are the best stable ones",
            "check fit.png, or choose another model",
            key="--model",
            value=fit.model,
        )
    for match in fit.matches:
        if match.errors.size and match.errors.mean() > _POOR:
            problem = f"is off by {format_percent(match.errors.mean(), 3)} on average, in {match.column}"
            warn_of(problem, f"{fit.model} does not describe this material, or a unit is wrong", file=match.table.name)
    _warn_of_doubtful_numbers(fit)


def _warn_of_doubtful_numbers(fit: Fit) -> None:
    numbers, confidence = fit.solution.problem.numbers.all, fit.confidence
    masks = {
        " ended at the bound of its range": confidence.at_bound,
        ": no influence on the measured values": confidence.without_influence,
    }
    for problem, mask in masks.items():
        if mask.any():
            words = ", ".join(number.words for number, chosen in zip(numbers, mask, strict=True) if chosen)
            warn_of(f"{words}{problem}", "a simpler model may be sufficient for these tests")
    values = fit.solution.problem.numbers.values(fit.solution.free)
    with np.errstate(invalid="ignore"):
        determined = confidence.high - confidence.low < 2.0 * np.abs(values)
        wide = ~(determined | confidence.at_bound | confidence.without_influence)
        alike = np.argwhere(np.triu(np.abs(confidence.correlation), 1) > _ALIKE)
    if wide.any():
        words = ", ".join(number.words for number, is_wide in zip(numbers, wide, strict=True) if is_wide)
        warn_of(f"{words}: uncertain by as much as the value itself", _MORE)
    if len(alike):
        pairs = ", ".join(f"{numbers[a].words} and {numbers[b].words}" for a, b in alike)
        warn_of(f"{pairs}: these tests hardly distinguish them", _MORE)

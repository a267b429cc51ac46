"""Least squares from several starts, stability of the fitted model, and confidence intervals of its parameters."""

from __future__ import annotations

import functools
from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxform import InputError
from jaxform.extend import principal_nominal_stress
from optimize.fitting import states
from optimize.fitting.numbers import Numbers
from optimize.fitting.problem import Problem, without_bubbles
from optimize.fitting.tables import Bubble, Table

Array = np.ndarray

LEVEL = 0.95
"""Level of the confidence intervals."""
_STARTS, _BEST, _FEW = 100, 8, 2  # that are examined, and from which a search starts, where it is quick and slow
_CALLS = 100  # of one search
_SAMPLES = 24  # stretches in each state at which the stability of the model is checked
_EXACT, _NO_CHANGE = 1e-6, 1e-5  # a difference that is none, and what changes differences by so little is no number
_MARGIN, _FORCE = 1e-3, 1e3  # of the largest stress, what a place is held away from being unstable; what that weighs


class Confidence(NamedTuple):
    """Confidence intervals of the parameters, and their correlation.

    Attributes:
        low, high: Bounds of their intervals (n,); NaN where the data do not determine them.
        correlation: Correlation of the parameters (n, n), NaN where they are at a bound or without influence.
        at_bound: Mask (n,) of those at a bound of their range.
        without_influence: Mask (n,) of those without effect on the measured values.
        condition: Condition number of the slopes, each parameter's scaled to one.
    """

    low: Array
    high: Array
    correlation: Array
    at_bound: Array
    without_influence: Array
    condition: float


@dataclass(frozen=True)
class Solution:
    """Parameters that minimize the differences.

    Attributes:
        problem: The fitted problem.
        free: The vector (n,).
        unstable: The state and the stretch beyond which the stress decreases with strain; None if stable.
        held_stable: True if a better but unstable model was rejected.
    """

    problem: Problem
    free: Array
    unstable: tuple[str, float] | None
    held_stable: bool


class Stability:
    """Drucker's condition, at stretches of the sheet that the tests reach.

    The second derivatives of the energy by logarithms of the stretches are positive definite: no small strain, whatever
    its direction, then lets the true stress fall. It applies to the elastic model: overstress relaxes.
    """

    def __init__(self, tables: list[Table], numbers: Numbers, stress: float) -> None:
        """Sample the states of the tests over the range of their stretches."""
        reach: dict[str, list[float]] = {}
        for table in without_bubbles(tables):
            reach.setdefault(table.state, []).extend(np.log(table.stretch))  # pyright: ignore[reportAttributeAccessIssue]
        self.places = [
            (state, stretch)
            for state, logs in reach.items()
            for stretch in np.exp(np.linspace(min(0.0, *logs), max(0.0, *logs), _SAMPLES))
        ]
        one = jnp.array([stretch for _, stretch in self.places])
        states_of = {state: np.array([each == state for each, _ in self.places]) for state in reach}
        self._both = functools.partial(_slopes_and_least, numbers, one=one, states_of=states_of, stress=stress)

    def deficit(self, free: Array, margin: float = 0.0) -> Array:
        """Shortfall of each place from stability (n_place,), relative to the largest stress; 0 where it is stable."""
        least = np.asarray(self._both(jnp.asarray(free))[1])
        # Where the model has no finite stress, 1 keeps the search away.
        return np.where(np.isfinite(least), np.maximum(margin - least, 0.0), 1.0)

    def slopes(self, free: Array, margin: float = 0.0) -> Array:
        """Derivatives of that (n_place, n)."""
        slopes, least = map(np.asarray, self._both(jnp.asarray(free)))
        return np.where((least[:, None] < margin) & np.isfinite(slopes), -slopes, 0.0)

    def first_unstable(self, free: Array) -> tuple[str, float] | None:
        """The place nearest to no strain that is unstable."""
        lacking = self.deficit(free) > 1e-6
        found = [place for place, bad in zip(self.places, lacking, strict=True) if bad]
        return min(found, key=lambda place: abs(np.log(place[1]))) if found else None


@functools.partial(jax.jit, static_argnums=0)
def _slopes_and_least(
    numbers: Numbers, free: jax.Array, one: jax.Array, states_of: dict[str, Array], stress: float
) -> tuple[jax.Array, jax.Array]:
    """The least slope of the true stress at each place (n_place,), relative to a stress, and its derivatives."""

    def least(free: jax.Array) -> tuple[jax.Array, jax.Array]:
        across = [jnp.where(mask, states.crosswise(state, one), 0.0) for state, mask in states_of.items()]
        law = numbers.make(free)

        def true_stress(logs: jax.Array) -> jax.Array:
            stretch = jnp.exp(logs)
            first, second = principal_nominal_stress(law, stretch[:1], stretch[1:])
            return jnp.stack([stretch[0] * first[0], stretch[1] * second[0]])

        slopes = jax.vmap(jax.jacfwd(true_stress))(jnp.log(jnp.stack([one, sum(across)], axis=1)))
        mean = 0.5 * (slopes[:, 0, 0] + slopes[:, 1, 1])
        apart = jnp.hypot(0.5 * (slopes[:, 0, 0] - slopes[:, 1, 1]), 0.5 * (slopes[:, 0, 1] + slopes[:, 1, 0]))
        return (mean - apart) / stress, (mean - apart) / stress

    return jax.jacfwd(least, has_aux=True)(free)


def information(solution: Solution) -> float:
    """Schwarz's criterion: of fits with different numbers of parameters, the one with the least value is chosen."""
    rows = int(solution.problem.used.sum())
    square = float(np.mean(np.square(solution.problem.differences(solution.free)[solution.problem.used])))
    return rows * float(np.log(square + _EXACT**2)) + len(solution.free) * float(np.log(rows))


def solve(tables: list[Table], numbers: Numbers, weights: str, stress: float) -> Solution:
    """The best parameters, stable where that costs little.

    Args:
        tables: The tests.
        numbers: The parameters.
        weights: Weighting of the differences.
        stress: The largest stress of the tests [Pa].

    Raises:
        InputError: There are too few rows, or the search fails from every start.
    """
    problem = Problem(tables, numbers, weights)
    _check_rows(problem)
    rough = problem
    if any(isinstance(table, Bubble) for table in tables):
        rough = Problem(without_bubbles(tables), numbers, weights)
    stability = Stability(tables, numbers, stress)
    starts = _starts(rough)
    found = [_search(rough, free) for free in starts]
    if rough is not problem:
        # A rough model may have lost parameters that the right one needs.
        found = [_search(problem, free) for free in (*_best(found, rough)[:_FEW], *starts[:_FEW])]
    best = _first_valid(_best(found, problem), problem)
    unstable = stability.first_unstable(best)
    if unstable is None:
        return Solution(problem, numbers.order(best), None, False)
    held = [_search(problem, free, stability) for free in _best(found, problem)[:_BEST]]
    laws = [free for free in _best(held, problem) if _is_law(free, problem)]
    stable = [free for free in laws if stability.first_unstable(free) is None]
    if not stable:
        return Solution(problem, numbers.order(best), unstable, False)
    return Solution(problem, numbers.order(stable[0]), None, True)


def _starts(problem: Problem) -> list[Array]:
    """The best of many vectors, their moduli by linear least squares: stresses are proportional to moduli."""
    numbers = problem.numbers
    made = [_with_moduli(problem, free) for free in numbers.starts(_STARTS)]
    return _best(made, problem)[:_BEST]


def _with_moduli(problem: Problem, free: Array) -> Array:
    from scipy.optimize import lsq_linear

    numbers, moduli = problem.numbers, problem.numbers.moduli
    free = np.clip(free, numbers.lower, numbers.upper)
    slopes = problem.slopes(free)[:, moduli]
    wanted = slopes @ free[moduli] - problem.differences(free)
    bounds = numbers.lower[moduli], numbers.upper[moduli]
    if not moduli.any() or not np.isfinite(slopes).all():
        return free
    free = free.copy()
    # Some stiffness is kept in each: without it, the other parameters have no effect in a search.
    free[moduli] = np.clip(lsq_linear(slopes, wanted, bounds).x, bounds[0] + 1e-6, bounds[1])
    return free


def _search(problem: Problem, begin: Array, stability: Stability | None = None) -> Array:
    from scipy.optimize import least_squares

    def differences(free: Array) -> Array:
        residual = problem.differences(free)
        return residual if stability is None else np.concatenate([residual, _FORCE * stability.deficit(free, _MARGIN)])

    def slopes(free: Array) -> Array:
        jacobian = problem.slopes(free)
        return jacobian if stability is None else np.concatenate([jacobian, _FORCE * stability.slopes(free, _MARGIN)])

    lower, upper = problem.numbers.lower, problem.numbers.upper
    begin = np.clip(begin, lower, upper)
    options = {"ftol": 1e-10, "xtol": 1e-10, "gtol": 1e-12, "max_nfev": _CALLS}
    found = least_squares(differences, begin, slopes, (lower, upper), x_scale="jac", **options)  # pyright: ignore[reportArgumentType]
    return found.x


def _best(found: list[Array], problem: Problem) -> list[Array]:
    return sorted(found, key=lambda free: float(np.sum(np.square(problem.differences(free)))))


def _check_rows(problem: Problem) -> None:
    rows, unknown = int(problem.used.sum()), len(problem.numbers.all)
    if rows <= unknown:
        words = f"{rows} measured values cannot determine {unknown} parameters"
        raise InputError(words, "give more rows, or fewer terms or modes")


def _first_valid(found: list[Array], problem: Problem) -> Array:
    """The first admissible vector."""
    for free in found:
        if _is_law(free, problem):
            return free
    raise InputError(
        "no parameters of this model fit these tests", "choose another model, or check units and types of tests"
    )


def _is_law(free: Array, problem: Problem) -> bool:
    """True if parameters are admissible and give a finite value for every row: a bubble may have no equilibrium."""
    try:
        problem.numbers.make(jnp.asarray(free)).verify()
    except InputError:
        return False
    return bool(np.isfinite(problem.values(free)).all())


def confidence_of(problem: Problem, free: Array) -> Confidence:
    """Intervals from the slopes at the solution, for independent differences of equal variance and the right model."""
    from scipy.special import stdtrit

    numbers, count = problem.numbers, len(free)
    slopes = problem.slopes(free)
    size = np.linalg.norm(slopes, axis=0) / np.sqrt(problem.used.sum())
    at_bound, without_influence = _find_undetermined(numbers, free, size)
    low, high, correlation = np.full(count, np.nan), np.full(count, np.nan), np.full((count, count), np.nan)
    inside = ~(at_bound | without_influence)
    size = np.linalg.norm(slopes[:, inside], axis=0)
    if not inside.any() or not np.all(size > 0.0):
        return Confidence(low, high, correlation, at_bound, without_influence, np.inf if inside.any() else 1.0)
    _, singular, turned = np.linalg.svd(slopes[:, inside] / size, full_matrices=False)
    spread = (turned.T / np.maximum(singular, 1e-12 * singular[0]) ** 2) @ turned
    freedom = int(problem.used.sum()) - count
    variance = float(np.sum(np.square(problem.differences(free)))) / freedom
    half = stdtrit(freedom, 0.5 + 0.5 * LEVEL) * np.sqrt(variance * np.diag(spread)) / size
    with np.errstate(over="ignore"):
        for place, width in zip(np.flatnonzero(inside), half, strict=True):
            low[place], high[place] = (numbers.all[place].value(free[place] + sign * width) for sign in (-1.0, 1.0))
    deviation = np.sqrt(np.diag(spread))
    correlation[np.ix_(inside, inside)] = spread / np.outer(deviation, deviation)
    condition = float(singular[0] / max(singular[-1], 1e-300))
    return Confidence(low, high, correlation, at_bound, without_influence, condition)


def _find_undetermined(numbers: Numbers, free: Array, size: Array) -> tuple[Array, Array]:
    """Masks (n,) of parameters practically at a bound, and of those without influence; `size` is a change's effect.

    A search stays slightly inside the bounds: a parameter is at one if moving there has no effect, but farther has.
    """
    way, far = np.minimum(free - numbers.lower, numbers.upper - free), np.maximum(np.abs(free), 1.0)
    nothing = np.where(np.isfinite(way), way, far) * size < _NO_CHANGE
    idle = far * size < _NO_CHANGE
    return nothing & ~idle, nothing & idle

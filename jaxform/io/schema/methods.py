"""Tables of the search methods of a study."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, Tag

from jaxform.io.schema.quantities import Count
from jaxform.io.validation import NotNegative, Positive, Table, choice


class _SearchTable(Table):
    """Keys that all methods share; see `optimize.Study`.

    Attributes:
        iterations: Largest number in all, those of the warm start and of every round included.
        max_simulations: Stops before the search costs the time of this many simulations.
        minutes: Stops after this time [min].
        tolerance: Stops when five iterations together, or two rounds, gain less than this share, or the deviation from
            a target is less than it; 0.001 by default.
        gradient_tolerance: Stops when the gradient has become this share of the first one.
        goal: Stops when the objective is at most this.
        warm_start: Updates of the fixed point before the first iteration; by default as many as halve the objective,
            for a target or an even wall of which the sheet is a variable.
        starts: Number of designs, scattered about the first one; the search begins at the best.
        rounds: Largest number of multiplier rounds for limits.
    """

    iterations: Count = 30
    max_simulations: Positive | None = None
    minutes: Positive | None = None
    tolerance: NotNegative | None = None
    gradient_tolerance: NotNegative | None = None
    goal: Positive | None = None
    warm_start: Annotated[int, Field(ge=0, le=1_000_000)] | None = None
    starts: Annotated[int, Field(ge=1, le=10_000)] = 1
    rounds: Count | None = None


class Lbfgs(_SearchTable):
    """Limited-memory quasi-Newton method with line search.

    Attributes:
        method: Name of the method.
    """

    method: Literal["lbfgs"] = "lbfgs"


class Adam(_SearchTable):
    """First-order method with momentum.

    Attributes:
        method: Name of the method.
        learning_rate: Size of the first steps; the bounds are 4 apart.
    """

    method: Literal["adam"]
    learning_rate: Positive | None = None


class LeastSquares(_SearchTable):
    """Levenberg-Marquardt, for few variables and a sum of squares.

    Attributes:
        method: Name of the method.
    """

    method: Literal["least-squares"]


class FixedPoint(_SearchTable):
    """Thicken the sheet where the wall is thin.

    Attributes:
        method: Name of the method.
    """

    method: Literal["fixed-point"]


Method = Annotated[
    Annotated[Lbfgs, Tag("<lbfgs>")]
    | Annotated[Adam, Tag("<adam>")]
    | Annotated[LeastSquares, Tag("<least-squares>")]
    | Annotated[FixedPoint, Tag("<fixed-point>")],
    *choice("method", ["lbfgs", "adam", "least-squares", "fixed-point"], usual="lbfgs"),
]

"""Tables of how a study searches."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, Tag

from jaxform.io.schema.quantities import Count
from jaxform.io.validation import NotNegative, Positive, Table, choice


class _SearchTable(Table):
    """What all methods share; see `optimize.Study`.

    Attributes:
        iterations: In all, those of the warm start and of every round included.
        max_simulations: Stops before it costs the time of so many simulations.
        minutes: Stops when it has taken so long.
        tolerance: Stops when five iterations together, or two rounds, gain less than this share, or the deviation from
            a target is less than it; 0.001 by default.
        gradient_tolerance: Stops when the gradient has become this share of the first one.
        goal: Stops when the objective is at most this.
        warm_start: Updates of the fixed point before the first iteration; by default as many as halve the objective,
            for a target or an even wall of which the sheet is a variable.
        starts: From so many designs, strewn about the first one, the best is where the search begins.
        rounds: Of multipliers for limits, at most.
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
        method: How it is searched for.
    """

    method: Literal["lbfgs"] = "lbfgs"


class Adam(_SearchTable):
    """First-order method with momentum.

    Attributes:
        method: How it is searched for.
        learning_rate: Size of the first steps; from one bound to the other it is 4.
    """

    method: Literal["adam"]
    learning_rate: Positive | None = None


class LeastSquares(_SearchTable):
    """Levenberg-Marquardt, for few variables and a sum of squares.

    Attributes:
        method: How it is searched for.
    """

    method: Literal["least-squares"]


class FixedPoint(_SearchTable):
    """Thicken the sheet where the wall is thin.

    Attributes:
        method: How it is searched for.
    """

    method: Literal["fixed-point"]


Method = Annotated[
    Annotated[Lbfgs, Tag("<lbfgs>")]
    | Annotated[Adam, Tag("<adam>")]
    | Annotated[LeastSquares, Tag("<least-squares>")]
    | Annotated[FixedPoint, Tag("<fixed-point>")],
    *choice("method", ["lbfgs", "adam", "least-squares", "fixed-point"], usual="lbfgs"),
]

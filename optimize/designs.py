"""Input and output of a search: studies, limits, and evaluated designs."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from jaxform import Scene
from optimize.objectives import Objective
from optimize.variables import Variable

COLUMNS: tuple[str, ...] = (
    "evaluation",
    "objective",
    "thickness_rms_error",
    "wall_min",
    "wall_mean",
    "wall_cv",
    "mass",
    "gradient_norm",
    "iteration",
    "simulations",
    "seconds",
)
LIMIT_COLUMNS = ("violation", "multiplier")  # of objectives with constraints
KEPT = 5e-3  # a limit counts as kept to half a per cent of it


@dataclass(frozen=True)
class Study:
    """Design study: a scene, its variables and objective, and the settings of the search.

    Attributes:
        scene: The initial scene.
        variables: The design variables.
        objective: The objective to minimize.
        method: "lbfgs", "adam", "least-squares" or "fixed-point".
        iterations: Largest number of steps, of the warm start and of all rounds between which multipliers change.
        tolerance: The search ends when five steps together, or two rounds, gain less than this fraction of the value,
            or, of the root of a sum of squares, less than a tenth of it; and when that root itself, the deviation, is
            less than it. 0 for never.
        gradient_tolerance: It ends when the gradient's norm is below this fraction of the first one.
        goal: It ends when the objective is at most this; None for never.
        max_simulations: It ends before it costs more than the time of this many simulations; None for never.
        minutes: It ends after this wall-clock time [min]; None for never.
        learning_rate: Learning rate of Adam; the bounds are 4 apart.
        warm_start: Updates of the fixed point before the search; None for as many as halve the value, for a
            target or an even wall of which the sheet is a variable.
        hops: Number of searches that follow one which ends in a local optimum above the goal, each from the best design
            with all numbers shifted at random by a few per cent of their bounds; 0 for none.
        starts: Number of searches: the first from the scene's own design, the others from low-discrepancy points within
            the bounds; the best of their designs is the result.
        first: The search's numbers (n,) of the first design; None for the scene's own.
        rounds: Largest number of multiplier rounds.
        document: Document of the scene, for writing the best design.
        digest: Hash that identifies the study, for resuming a search.
        file: Name of the study in messages.
    """

    scene: Scene
    variables: tuple[Variable, ...]
    objective: Objective
    method: str = "lbfgs"
    iterations: int = 30
    tolerance: float = 1e-3
    gradient_tolerance: float = 1e-4
    goal: float | None = None
    max_simulations: float | None = None
    minutes: float | None = None
    learning_rate: float = 0.1
    warm_start: int | None = None
    hops: int = 0
    starts: int = 1
    first: np.ndarray | None = None
    rounds: int = 8
    document: Any = None
    digest: str = ""
    file: str = ""


@dataclass
class Point:
    """A design that was evaluated.

    Attributes:
        free: Its numbers (n,).
        value: The value to minimize: the objective with the terms of its limits; infinite where it fails.
        gradient: Gradient of the value (n,).
        objective: The objective alone.
        excess: Excess of its constraints (n,), relative to their limits; positive where a limit is broken.
        row: Row of the history.
        slope: The gradient without components that lead out of the bounds (n,).
    """

    free: np.ndarray
    value: float
    gradient: np.ndarray
    objective: float = np.inf
    excess: np.ndarray = field(default_factory=lambda: np.zeros(0))
    row: dict[str, Any] = field(default_factory=dict)
    slope: np.ndarray = field(default_factory=lambda: np.zeros(0))

    @property
    def violation(self) -> float:
        """Violation of the worst limit, relative to it; not below 0."""
        return max(float(self.excess.max()), 0.0) if self.excess.size else 0.0

    @property
    def rank(self) -> tuple[float, float]:
        """The smaller the better: first whether limits are kept, then the objective."""
        return (self.violation if self.violation > KEPT else 0.0, self.objective)

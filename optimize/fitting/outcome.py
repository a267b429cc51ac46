"""A fit: material parameters from tests, residuals, and its description, tables and files."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from jaxform import Law
from optimize.fitting import solving, states
from optimize.fitting.solving import Confidence, Solution
from optimize.fitting.tables import Pull, Table

Array = np.ndarray

_CURVE = 120  # points of a curve that is drawn
ASSUMPTION = "the weighted differences are independent and of equal variance, and the model is correct"


class Match(NamedTuple):
    """A measured column of a table and the model's values for it.

    Attributes:
        table: The table.
        column: Name of the column.
        measured: Measured values (n,), in the unit of the file; nominal stress.
        fitted: Fitted values (n,).
        used: Mask of the strained rows (n,), which count.
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
    """Material parameters from tests.

    Attributes:
        model: Name of the material model.
        kind: Kind of the Prony terms; empty where there are none.
        solution: The parameters.
        confidence: Their intervals of confidence and correlation.
        weights: Weighting of the differences.
        matches: Each measured column, and the model's values for it.
    """

    model: str
    kind: str
    solution: Solution
    confidence: Confidence
    weights: str
    matches: tuple[Match, ...]

    @property
    def law(self) -> Law:
        """The material model, of density 1000 kg/m^3, with its Prony terms."""
        return self.solution.problem.numbers.make(jnp.asarray(self.solution.free))

    def table(self, density: float) -> dict[str, Any]:
        """The table `[material]` of a scene file, its Prony terms as a table `viscous` in it."""
        numbers = self.solution.problem.numbers
        of_law, of_modes = numbers.group(float(f"{value:.8g}") for value in numbers.values(self.solution.free))
        made: dict[str, Any] = {"model": self.model, **of_law, "density": density}
        if self.kind:
            made["viscous"] = {"kind": self.kind, **of_modes}
        return made

    def summary(self, warned: Sequence[str], density: float) -> dict[str, Any]:
        """All facts as plain numbers, words, lists and tables, for summary.json."""
        return {
            "status": "ok",
            "model": self.model,
            "viscous": self.kind or None,
            "numbers": self._numbers(),
            "density": density,
            "confidence_level": solving.LEVEL,
            "assumption": ASSUMPTION,
            "weights": self.weights,
            "condition": self.confidence.condition,
            "tables": [_facts(match) for match in self.matches],
            "warnings": list(warned),
        }

    def _numbers(self) -> list[dict[str, Any]]:
        numbers = self.solution.problem.numbers
        values = numbers.values(self.solution.free)
        confidence = self.confidence
        rows = zip(
            numbers.all,
            values,
            confidence.low,
            confidence.high,
            confidence.at_bound,
            confidence.without_influence,
            strict=True,
        )
        return [
            {
                "name": number.words,
                "value": float(value),
                "unit": number.allowed.unit,
                "interval": None if not np.isfinite([low, high]).all() else [float(low), float(high)],
                "at_bound": bool(bound),
                "without_influence": bool(idle),
            }
            for number, value, low, high, bound, idle in rows
        ]

    def curve(self, table: Pull) -> tuple[Array, Array]:
        """Stretches and nominal stresses (k,) [Pa] of a slow test, to draw a line through."""
        low, high = min(1.0, table.stretch.min()), max(1.0, table.stretch.max())
        stretch = np.linspace(low, high, _CURVE)
        return stretch, np.asarray(states.nominal_stress(self.law, table.state, jnp.asarray(stretch)))


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

"""A gradient held against central differences, for a ladder of steps: which step is right is not known beforehand."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from jaxform.core.errors import InputError

STEPS = (1e-2, 1e-3, 1e-4, 1e-5, 1e-6, 1e-7)
"""Default steps, relative to the size of the numbers: above them the function curves, below them it is rounded."""


@dataclasses.dataclass(frozen=True, repr=False)
class GradientCheck:
    """A slope along one direction by `jax.grad`, and by central differences.

    Attributes:
        slope: The slope by `jax.grad`, for a step of 1 along the direction.
        steps: Steps of the differences (n_step,), as fractions of the direction.
        differences: Slopes by central differences (n_step,).
    """

    slope: float
    steps: NDArray[np.float64]
    differences: NDArray[np.float64]

    @property
    def errors(self) -> NDArray[np.float64]:
        """Differences between the slopes (n_step,), relative to the larger of the two; 0 where both vanish."""
        largest = np.maximum(np.abs(self.differences), abs(self.slope))
        return np.abs(self.differences - self.slope) / np.where(largest > 0.0, largest, 1.0)

    @property
    def error(self) -> float:
        """The least of the errors, at the step that suits the function best; NaN where no difference is finite."""
        finite = self.errors[np.isfinite(self.errors)]
        return float(finite.min()) if finite.size else float("nan")

    def __repr__(self) -> str:
        """A table with a row for each step."""
        rows = zip(self.steps, self.differences, self.errors, strict=True)
        lines = [f"{step:8.0e}  {slope:24.16g}  {error:8.1e}" for step, slope, error in rows]
        return "\n".join(
            [f"slope by jax.grad: {self.slope:.16g}", "    step       central difference     error", *lines]
        )


def check_gradient(
    function: Callable[[Any], Any],
    numbers: Any,
    *,
    direction: Any = None,
    steps: Sequence[float] = STEPS,
    seed: int = 0,
) -> GradientCheck:
    """Holds the gradient of a function against central differences along one direction.

    A run with contact is smooth between the designs at which a decision changes (which node lands first, which step of
    the ladder is taken), so a large step may show a secant across such changes where `jax.grad` gives the slope at one
    point: errors that fall as the step shrinks, and rise again when rounding takes over, are those of a right gradient.

    Args:
        function: Of the numbers, returns a scalar.
        numbers: An array of floats, or a tree of such.
        direction: Of the same structure; by default random, each number's change in proportion to its own size.
        steps: Fractions of the direction to step by, each to both sides.
        seed: Of the random direction.

    Raises:
        InputError: If there are no steps, one is not positive, or the direction has another shape than the numbers.
    """
    sizes = np.asarray(steps, float)
    if sizes.ndim != 1 or not sizes.size or not (sizes > 0).all():
        raise InputError("are not positive numbers", "give fractions such as (1e-3, 1e-5)", "steps", steps)
    if direction is None:
        direction = _random_direction(numbers, seed)
    direction = jax.tree.map(_check_shape, numbers, direction)
    gradient = jax.grad(function)(numbers)
    slope = sum(float(jnp.vdot(*pair)) for pair in _pair_leaves(gradient, direction))
    differences = [
        (float(function(_move(numbers, direction, step))) - float(function(_move(numbers, direction, -step))))
        / (2 * step)
        for step in sizes
    ]
    return GradientCheck(slope, sizes, np.asarray(differences))


def _random_direction(numbers: Any, seed: int) -> Any:
    """A change of every number of a tree, normally distributed with the number itself as its deviation."""
    random = np.random.default_rng(seed)
    return jax.tree.map(lambda values: random.standard_normal(np.shape(values)) * np.asarray(values), numbers)


def _check_shape(numbers: Any, direction: Any) -> NDArray[np.float64]:
    """A leaf of the direction as an array; InputError if its shape is not that of the numbers."""
    array = np.asarray(direction, float)
    if array.shape != np.shape(numbers):
        problem = f"has the shape {array.shape} for numbers of the shape {np.shape(numbers)}"
        raise InputError(problem, "give one change for each number", "direction")
    return array


def _pair_leaves(gradient: Any, direction: Any) -> list[tuple[jax.Array, jax.Array]]:
    """The leaves of a gradient with those of a direction."""
    leaves = zip(jax.tree.leaves(gradient), jax.tree.leaves(direction), strict=True)
    return [(slope, jnp.asarray(way, slope.dtype)) for slope, way in leaves]


def _move(numbers: Any, direction: Any, step: float) -> Any:
    """The numbers a step along the direction."""
    return jax.tree.map(
        lambda start, way: start + jnp.asarray(step * np.asarray(way), jnp.result_type(start)), numbers, direction
    )

"""Strategies for the reverse derivative of a run, which the user can choose.

Gradients are the same whichever is taken; time and memory are not. New physics is differentiable by checkpoints from
its first day, and by the reversed scheme once each of its parts can be stepped backwards.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from jaxform.adjoint.reversed_scheme import differentiable_window
from jaxform.core.errors import InputError, format_percent
from jaxform.dynamics.window import window
from jaxform.kernels.blocks import lax_cond_once
from jaxform.kernels.branches import branch
from jaxform.kernels.derivatives import checkpoint
from jaxform.model.scene import Scene
from jaxform.sheet.discretization import Discretization
from jaxform.sheet.state import Schedule, State, differentiable_leaves

BoundaryWork = Callable[[State], tuple[State, Discretization]]


@dataclass(frozen=True)
class Adjoint:
    """A strategy for the reverse derivative of a run.

    Attributes:
        windows: Number of windows between two stored states; the windows in between are recomputed.
    """

    windows: int = 1

    def __post_init__(self) -> None:
        """Checks the number of windows."""
        if not (isinstance(self.windows, int) and self.windows > 0):
            raise InputError(
                "must be a positive whole number", "keep the state at each window boundary: 1", "windows", self.windows
            )

    def check(self, scene: Scene) -> None:
        """Raises InputError where this strategy cannot differentiate a part of the scene."""

    def apply_boundary(self, work: BoundaryWork) -> BoundaryWork:
        """The work at a window boundary, whose decisions are stored for the derivative and the rest recomputed."""
        return checkpoint(work)

    def cond_once(self, asked: jax.Array, work: Callable[[State], State], state: State) -> State:
        """The state after `work` where asked for, else unchanged."""
        return lax_cond_once(asked, work, state, differentiable=True)

    def window(
        self, state: State, scene: Scene, discrete: Discretization, first: Discretization, schedule: Schedule | None
    ) -> State:
        """The state after a window."""
        raise NotImplementedError


class Reversed(Adjoint):
    """Inverts the steps of each window from its end, one by one: the fastest strategy, with the least memory.

    It raises InputError for scenes with a part whose steps cannot be inverted (see `Scene.reversible`).
    """

    def check(self, scene: Scene) -> None:
        """Raises InputError where the steps of a part of the scene cannot be inverted."""
        if not scene.reversible:
            problem = f"cannot step this scene backwards: {', '.join(scene.irreversible_parts)}"
            raise InputError(problem, "leave it out, or use jaxform.Checkpointed()", "adjoint")

    def cond_once(self, asked: jax.Array, work: Callable[[State], State], state: State) -> State:
        """The state after `work` where asked for, else unchanged; under `vmap` it is skipped where no run asks.

        JAX's own derivative of a window omits results without influence; through this branch it would compute all, so
        the other strategies do not use it.
        """
        return branch(asked, work, state, differentiable_leaves)

    def window(
        self, state: State, scene: Scene, discrete: Discretization, first: Discretization, schedule: Schedule | None
    ) -> State:
        """The state after a window, with its reverse derivative written by hand."""
        return differentiable_window(state, scene, discrete, first, schedule)


class Checkpointed(Adjoint):
    """JAX's own derivative of each window, whose steps are recomputed: for any scene.

    The decisions of the window and the contacts with the mold are stored.
    """

    def window(
        self, state: State, scene: Scene, discrete: Discretization, first: Discretization, schedule: Schedule | None
    ) -> State:
        """The state after a window; the state at its begin is stored."""
        return checkpoint(window)(state, scene, discrete, schedule)


class Stored(Adjoint):
    """JAX's own derivative, with every step stored: for short runs, and to check the other strategies."""

    def apply_boundary(self, work: BoundaryWork) -> BoundaryWork:
        """The work at a window boundary, with everything stored."""
        return work

    def window(
        self, state: State, scene: Scene, discrete: Discretization, first: Discretization, schedule: Schedule | None
    ) -> State:
        """The state after a window."""
        return window(state, scene, discrete, schedule)


def choose_adjoint(scene: Scene, chosen: Adjoint | None) -> Adjoint:
    """The strategy that was chosen, or the fastest that a scene allows.

    Raises:
        InputError: It is not a strategy, or cannot differentiate this scene.
    """
    if chosen is None:
        return Reversed() if scene.reversible else Checkpointed()
    if not isinstance(chosen, Adjoint):
        remedy = "choose jaxform.Reversed(), jaxform.Checkpointed() or jaxform.Stored()"
        raise InputError("is not an adjoint strategy", remedy, "adjoint", chosen)
    chosen.check(scene)
    return chosen


# A gradient held against central differences, for a ladder of steps: which step is right is not known beforehand.

STEPS = (1e-2, 1e-3, 1e-4, 1e-5, 1e-6, 1e-7)
"""Default steps, relative to the size of the numbers: above them the function curves, below them it is rounded."""

SECANTS = (1e-6, 1e-2)
"""Shortest and longest step of the differences that are secants: changes that a designer makes, and less."""


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

    @property
    def secants(self) -> NDArray[np.float64]:
        """Central differences over steps of a millionth to a hundredth (n_secant,): what changes of the design see."""
        return self.differences[self._in_secant_range]

    @property
    def secant_error(self) -> float:
        """Largest difference between the slope and a secant, relative to the larger of the two; NaN without secants.

        Where `error` is small and this is large, the gradient is right at this design, and yet not the trend: the
        function has steep ripples that hardly change its value.
        """
        found = self.errors[self._in_secant_range]
        return float(found.max()) if found.size else float("nan")

    @property
    def _in_secant_range(self) -> NDArray[np.bool_]:
        shortest, longest = SECANTS
        return (self.steps >= shortest * (1 - 1e-9)) & (self.steps <= longest * (1 + 1e-9))

    def _describe_secants(self) -> list[str]:
        """A line on the secants; none where there are none."""
        if not self.secants.size:
            return []
        low, high, apart = self.secants.min(), self.secants.max(), format_percent(self.secant_error)
        return [f"secants over {SECANTS[0]:.0e} to {SECANTS[1]:.0e}: {low:.4g} to {high:.4g}, up to {apart} apart"]

    def __repr__(self) -> str:
        """A table with a row for each step, and how far the slope and the secants are apart."""
        rows = zip(self.steps, self.differences, self.errors, strict=True)
        lines = [f"{step:8.0e}  {slope:24.16g}  {error:8.1e}" for step, slope, error in rows]
        title = [f"slope by jax.grad: {self.slope:.16g}", "    step       central difference     error"]
        return "\n".join([*title, *lines, *self._describe_secants()])


def check_gradient(
    function: Callable[[Any], Any],
    numbers: Any,
    *,
    direction: Any = None,
    steps: Sequence[float] = STEPS,
    seed: int = 0,
) -> GradientCheck:
    """Holds the gradient of a function against central differences along one direction.

    A run with contact is smooth between the designs at which a decision changes (which node lands first, which level
    of step length is taken), so a large step may show a secant across such changes where `jax.grad` gives the slope at
    one point: for a correct gradient the errors fall as the step shrinks, and rise again when rounding dominates.
    How far slope and secants are apart says how well the slope predicts a change of the design (`secant_error`).

    Args:
        function: Function of the numbers that returns a scalar.
        numbers: An array of floats, or a tree of such.
        direction: Tree of the same structure; by default random, each number's change in proportion to its own size.
        steps: Fractions of the direction to step by, each to both sides.
        seed: Seed of the random direction.

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

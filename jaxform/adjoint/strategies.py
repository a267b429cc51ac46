"""Strategies for the reverse derivative of a run, which the user can choose.

Gradients are the same whichever is taken; time and memory are not. New physics is differentiable by checkpoints from
its first day, and by the reversed scheme once each of its parts can be stepped backwards.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import jax

from jaxform.adjoint.reversed_scheme import differentiable_window
from jaxform.core.errors import InputError
from jaxform.dynamics.window import window
from jaxform.kernels.blocks import lax_cond_once
from jaxform.kernels.branches import branch
from jaxform.kernels.derivatives import checkpoint
from jaxform.model.scene import Scene
from jaxform.sheet.discretization import Discretization
from jaxform.sheet.state import Schedule, State, differentiable_leaves

Look = Callable[[State], tuple[State, Discretization]]


@dataclass(frozen=True)
class Adjoint:
    """A way to find the reverse derivative of a run.

    Attributes:
        windows: The state is kept before every so many windows; what is in between is worked out once more.
    """

    windows: int = 1

    def __post_init__(self) -> None:
        """Refuses what is no number of windows."""
        if not (isinstance(self.windows, int) and self.windows > 0):
            raise InputError(
                "must be a positive whole number", "keep the state at each window boundary: 1", "windows", self.windows
            )

    def check(self, scene: Scene) -> None:
        """Raises InputError where a scene has a part that this cannot go back over."""

    def apply_boundary(self, look: Look) -> Look:
        """The work at a window boundary, with its decisions kept for the derivative."""
        return checkpoint(look)

    def cond_once(self, asked: jax.Array, work: Callable[[State], State], state: State) -> State:
        """The state after work where that is asked for, else as it is."""
        return lax_cond_once(asked, work, state, differentiable=True)

    def window(
        self, state: State, scene: Scene, discrete: Discretization, first: Discretization, schedule: Schedule | None
    ) -> State:
        """The state after a window."""
        raise NotImplementedError


@dataclass(frozen=True)
class Reversed(Adjoint):
    """Takes the steps back, one by one, from each window's end: the fastest, and nothing of a window is kept.

    For scenes whose every part can be stepped backwards (`Scene.reversible`), which is what it raises InputError for.
    """

    def check(self, scene: Scene) -> None:
        """Raises InputError where a scene has a part that cannot be stepped backwards."""
        if not scene.reversible:
            problem = f"cannot step this scene backwards: {', '.join(scene.irreversible_parts)}"
            raise InputError(problem, "leave it out, or use jaxform.Checkpointed()", "adjoint")

    def cond_once(self, asked: jax.Array, work: Callable[[State], State], state: State) -> State:
        """The state after `work` where asked for; skipped where several runs go side by side and none asks.

        Not for JAX's derivative of a window, which goes back over those results alone that have an influence: here it
        would go back over all.
        """
        return branch(asked, work, state, differentiable_leaves)

    def window(
        self, state: State, scene: Scene, discrete: Discretization, first: Discretization, schedule: Schedule | None
    ) -> State:
        """The state after a window, with its reverse derivative written by hand."""
        return differentiable_window(state, scene, discrete, first, schedule)


@dataclass(frozen=True)
class Checkpointed(Adjoint):
    """JAX's own derivative of each window, whose steps are worked out once more for it: for any scene.

    Its decisions and the landings on the mold are kept.
    """

    def window(
        self, state: State, scene: Scene, discrete: Discretization, first: Discretization, schedule: Schedule | None
    ) -> State:
        """The state after a window, of which the begin is kept."""
        return checkpoint(window)(state, scene, discrete, schedule)


@dataclass(frozen=True)
class Stored(Adjoint):
    """JAX's own derivative, with every step kept: for short runs, and to check the others with."""

    def apply_boundary(self, look: Look) -> Look:
        """All of it is kept."""
        return look

    def window(
        self, state: State, scene: Scene, discrete: Discretization, first: Discretization, schedule: Schedule | None
    ) -> State:
        """The state after a window."""
        return window(state, scene, discrete, schedule)


def choose_adjoint(scene: Scene, chosen: Adjoint | None) -> Adjoint:
    """The strategy that was chosen, or the fastest that a scene allows.

    Raises:
        InputError: It is none, or not one for this scene.
    """
    if chosen is None:
        return Reversed() if scene.reversible else Checkpointed()
    if not isinstance(chosen, Adjoint):
        remedy = "choose jaxform.Reversed(), jaxform.Checkpointed() or jaxform.Stored()"
        raise InputError("is not an adjoint strategy", remedy, "adjoint", chosen)
    chosen.check(scene)
    return chosen

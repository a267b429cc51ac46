"""The search: optax's Adam and L-BFGS around one compiled value-and-gradient of a whole simulation.

The loop is the host's, so that every simulation is a row of the history and can be shown, kept and stopped. A
simulation that fails (its status is not 0, or its objective not finite) counts as infinitely bad: the line search
shortens its step, and Adam goes back to the best design and halves its rate.
"""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax

import jaxform
from jaxform import Result, Scene
from optimize.objectives import Target, Wall, wall
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
_SUFFICIENT, _CURVATURE = 1e-4, 0.9  # of the weak Wolfe conditions
_TRIALS = 12
_MEMORY = 10
_REFRESH = 5  # iterations with the same decisions about the mesh


@dataclass(frozen=True)
class Study:
    """What is designed and how.

    Attributes:
        scene: The scene to begin with.
        variables: What may change.
        objective: What is wanted.
        method: "lbfgs" or "adam".
        iterations: Accepted steps at most.
        tolerance: The search ends when the gradient's norm is below this fraction of the first one.
        learning_rate: Of Adam, in the unbounded numbers.
        document: Where the scene came from, for writing the best design.
    """

    scene: Scene
    variables: tuple[Variable, ...]
    objective: Target
    method: str = "lbfgs"
    iterations: int = 30
    tolerance: float = 1e-4
    learning_rate: float = 0.1
    document: Any = None


@dataclass(frozen=True)
class Design:
    """What a search found.

    Attributes:
        scene, result: The best scene and its part.
        first_scene, first_result: The scene to begin with and its part.
        changes: Best design as dotted keys of a scene file with plain values.
        history: A row per simulation with gradient, with the columns `COLUMNS`.
        document: Of the study.
        message: Why the search ended.
    """

    scene: Scene
    result: Result
    first_scene: Scene
    first_result: Result
    changes: dict[str, Any]
    history: list[dict[str, Any]]
    document: Any
    message: str


@dataclass
class _Point:
    free: np.ndarray
    value: float
    gradient: np.ndarray


@dataclass
class Search:
    """Evaluates designs and remembers them.

    Attributes:
        study: What is designed.
        on_evaluation: Called with every row of the history; a true answer stops the search.
        forward_seconds: What a simulation without gradient takes, the unit of `simulations`.
        history: Rows so far.
        simulations: Cost so far in simulations without gradient.
        iteration: Which step of the search is being tried.
        began: Clock at the begin [s].
        best: The best design so far.
        stopped: Whether the caller wants no more.
        schedule: Where the mesh is refined, the decisions that simulations take; None where each decides for itself.
    """

    study: Study
    on_evaluation: Callable[[dict[str, Any]], object] | None
    forward_seconds: float
    history: list[dict[str, Any]] = field(default_factory=list)
    simulations: float = 1.0
    iteration: int = 0
    began: float = field(default_factory=time.perf_counter)
    best: _Point | None = None
    stopped: bool = False
    schedule: jaxform.Schedule | None = None

    def __post_init__(self) -> None:
        splits = np.cumsum([variable.start.size for variable in self.study.variables])[:-1]
        self._splits = [int(split) for split in splits]
        start = jnp.asarray(self.start)
        compute = jax.jit(jax.value_and_grad(self._objective, has_aux=True))
        # Compiled ahead, so that the seconds of the first evaluation are those of a simulation.
        self._compute = compute.lower(start, self.study.scene, self.schedule).compile()

    @property
    def start(self) -> np.ndarray:
        """The scene's own design, as unbounded numbers (n,)."""
        return np.concatenate([variable.start for variable in self.study.variables])

    def _parts(self, free: jax.Array) -> list[tuple[Variable, jax.Array]]:
        return list(zip(self.study.variables, jnp.split(free, self._splits), strict=True))

    def changes(self, free: jax.Array) -> dict[str, jax.Array]:
        """What `jaxform.replace` takes."""
        return {path: value for part, own in self._parts(free) for path, value in part.changes(own).items()}

    def document(self, free: np.ndarray) -> dict[str, Any]:
        """The same as dotted keys of a scene file."""
        parts = self._parts(jnp.asarray(free))
        return {key: value for part, own in parts for key, value in part.document(own).items()}

    def _objective(self, free: jax.Array, scene: Scene, schedule: jaxform.Schedule | None) -> tuple[jax.Array, Wall]:
        scene = jaxform.replace(scene, self.changes(free))
        result = jaxform.simulate(scene, schedule=schedule)
        return self.study.objective(scene, result), wall(scene, result)

    def __call__(self, free: np.ndarray) -> _Point:
        """Value and gradient at a design, infinite where its simulation fails; a row of the history."""
        began = time.perf_counter()
        (value, report), gradient = self._compute(jnp.asarray(free), self.study.scene, self.schedule)
        point = _Point(free, float(value), np.asarray(gradient, float))
        self.simulations += (time.perf_counter() - began) / self.forward_seconds
        failed = bool(report.status) or not np.isfinite(point.value) or not np.all(np.isfinite(point.gradient))
        if failed:
            point = _Point(free, np.inf, np.zeros_like(free))
        elif self.best is None or point.value < self.best.value:
            self.best = point
        self._record(point, report)
        return point

    def refreshed(self, point: _Point) -> _Point:
        """The point with the decisions that a run of its design takes, where the mesh is refined and it is time.

        In between the objective is smooth, for all simulations take the same decisions.
        """
        if self.schedule is None or self.iteration % _REFRESH:
            return point
        live = jaxform.run(jaxform.replace(self.study.scene, self.changes(jnp.asarray(point.free))))
        self.simulations += 1.0
        if int(live.status) or live.used.size != self._room:
            return point
        before = self.schedule, self.best
        self.schedule, self.best = live.schedule, None
        fresh = self(point.free)
        if self.best is None:
            self.schedule, self.best = before
            return point
        return fresh

    @property
    def _room(self) -> int:
        refinement = self.study.scene.refinement
        return 0 if refinement is None else refinement.elements

    def _record(self, point: _Point, report: Wall) -> None:
        numbers = (
            len(self.history),
            point.value,
            float(np.sqrt(point.value)),
            float(report.least),
            float(report.mean),
            float(report.variation),
            float(report.mass),
            float(np.linalg.norm(point.gradient)),
            self.iteration,
            self.simulations,
            time.perf_counter() - self.began,
        )
        row: dict[str, Any] = dict(zip(COLUMNS, numbers, strict=True))
        self.history.append(row)
        if self.on_evaluation is not None and self.on_evaluation(row):
            self.stopped = True


def solve(study: Study, on_evaluation: Callable[[dict[str, Any]], object] | None = None) -> Design:
    """Searches for the best design.

    Args:
        study: What is designed and how.
        on_evaluation: Called with every row of the history as it comes; a true answer ends the search.

    Raises:
        InputError: If the scene to begin with cannot be simulated to its end.
    """
    first = jaxform.run(study.scene)
    if int(first.status):
        raise jaxform.InputError(
            f"the scene to begin with fails: {jaxform.explain(first)}", "mend the scene first", "scene"
        )
    # Once more, for the first run in a process is slower; this is the unit in which simulations are counted.
    again = jaxform.run(study.scene).seconds
    assert again is not None
    study = dataclasses.replace(study, scene=jaxform.fitted(study.scene, int(first.used.sum())))
    schedule = None if study.scene.refinement is None else first.schedule
    search = Search(study, on_evaluation, max(again.run, 1e-6), schedule=schedule)
    try:
        message = {"lbfgs": _lbfgs, "adam": _adam}[study.method](search, study)
    except KeyboardInterrupt:
        if search.best is None:
            raise
        message = "interrupted"  # what was found is worth keeping
    if search.best is None:
        raise jaxform.InputError(
            "the first design, moved into the bounds, fails", "widen the bounds", "variable.bounds"
        )
    scene = jaxform.replace(study.scene, search.changes(jnp.asarray(search.best.free)))
    return Design(
        scene=scene,
        result=jaxform.run(scene),
        first_scene=study.scene,
        first_result=first,
        changes=search.document(search.best.free),
        history=search.history,
        document=study.document,
        message=message,
    )


def _small(point: _Point, first: _Point, study: Study) -> bool:
    return float(np.linalg.norm(point.gradient)) <= study.tolerance * float(np.linalg.norm(first.gradient))


def _lbfgs(search: Search, study: Study) -> str:
    """Optax's L-BFGS direction with a weak Wolfe line search that sees every simulation."""
    transform = optax.scale_by_lbfgs(memory_size=_MEMORY)
    point = first = search(search.start)
    if not np.isfinite(first.value):
        return "the first design fails"
    state = transform.init(jnp.asarray(point.free))
    for search.iteration in range(1, study.iterations + 1):
        if _small(point, first, study):
            return "the gradient is small enough"
        update, state = transform.update(jnp.asarray(point.gradient), state, jnp.asarray(point.free))
        direction = -np.asarray(update)
        if direction @ point.gradient >= 0:
            state = transform.init(jnp.asarray(point.free))
            direction = -point.gradient / np.linalg.norm(point.gradient)
        step = _line_search(search, point, direction)
        if search.stopped:
            return "stopped by the caller"
        if step is None:
            return "no step along the search direction makes it better"
        point = search.refreshed(step)
    return f"{study.iterations} iterations done"


def _line_search(search: Search, point: _Point, direction: np.ndarray) -> _Point | None:
    """A point that meets the weak Wolfe conditions, by bisection; else the best one that is better, else None."""
    slope = float(direction @ point.gradient)
    short, long, length = 0.0, np.inf, 1.0
    better: _Point | None = None
    for _ in range(_TRIALS):
        trial = search(point.free + length * direction)
        if trial.value < (better or point).value:
            better = trial
        if search.stopped:
            break
        if not trial.value <= point.value + _SUFFICIENT * length * slope:
            long = length
        elif trial.gradient @ direction < _CURVATURE * slope:
            short = length
        else:
            return trial
        length = 2.0 * length if np.isinf(long) else 0.5 * (short + long)
    return better


def _adam(search: Search, study: Study) -> str:
    """Optax's Adam; after a failed simulation from the best design with half the rate."""
    rate = study.learning_rate
    transform = optax.scale_by_adam()
    point = first = search(search.start)
    if not np.isfinite(first.value):
        return "the first design fails"
    state = transform.init(jnp.asarray(point.free))
    for search.iteration in range(1, study.iterations + 1):
        if _small(point, first, study):
            return "the gradient is small enough"
        update, state = transform.update(jnp.asarray(point.gradient), state)
        trial = search(point.free - rate * np.asarray(update))
        if search.stopped:
            return "stopped by the caller"
        if np.isfinite(trial.value):
            point = search.refreshed(trial)
        else:
            assert search.best is not None
            rate, point, state = 0.5 * rate, search.best, transform.init(jnp.asarray(search.best.free))
    return f"{study.iterations} iterations done"

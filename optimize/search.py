"""Evaluations of designs: values, gradients, columns of the Jacobian; each a row of the history.

A simulation that fails (its status is not 0, or its objective not finite) counts as infinitely bad. Limits are kept by
an augmented Lagrangian (Hestenes, Powell, Rockafellar): each evaluation adds sum w [max(0, lambda + rho g)^2 -
lambda^2] / (2 rho), and the multipliers lambda are updated between searches.
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

import jaxform
from jaxform import Result, Scene
from jaxform.extend import compile_function, mask_part
from optimize.designs import COLUMNS, Point, Study
from optimize.gradients import gradient_error, side_of_bounds, slope_within
from optimize.journal import Answer, Journal
from optimize.termination import Ending, SpentError, budget_ending
from optimize.variables import Variable
from optimize.wall_statistics import formed_part, nodal_area, wall

Method = Callable[["Search", Study, Point], tuple[Point, Ending]]
"""A method of searching: from a point on, to the last point and why it ended."""

Evaluators = Callable[[Study, list[np.ndarray], Any], list[Answer | None]]
_REFRESH = 5  # iterations with the same decisions about the mesh
_FIRST_PENALTY = 300.0


@dataclass
class Search:
    """Evaluates and records designs.

    Attributes:
        study: The study.
        on_evaluation: Called with every row of the history; a true answer stops the search.
        forward_seconds: Processor time of a simulation without gradient, the unit of `simulations`: its time
            does not depend on what else runs on the machine.
        history: Rows so far.
        simulations: Cost so far in simulations without gradient.
        iteration: Step of the search that is being tried.
        most_iterations: The step at which the search ends; a hop allows as many again.
        pause: The step at which a round ends, though the search goes on.
        best: The best design so far.
        unmoved: Numbers (n,) that began at a bound and were there in each design that was the best one for a time.
        stopped: True if the caller has stopped the search.
        last: True if the budget of the search is spent, except for a reserved simulation.
        schedule: The decisions of simulations with refinement; None where each decides for itself.
        journal: Journal of questions and answers.
        limits: Multipliers (n,) of the constraints, and the penalty on their violation; None without constraints.
        seconds: Elapsed time, that of earlier parts of the search included [s].
        gradient_error: Error found by `check`; None before.
        secants: Slope and secant along the gradient, at the first design ("start") and the best one ("end").
        multiplier: The weighted sum of the multipliers at the end of the last round; None before.
        updates: Updates of the fixed point before the search.
        on_wait: Called with a message before programs are compiled.
        memory: Private state of the method between rounds.
        evaluators: Function that computes values of designs side by side: of a study, designs, and the decisions and
            limits that `value` takes, an answer for each, or None; without it they are computed one after the other.
        programs: Compiled programs by name.
    """

    study: Study
    on_evaluation: Callable[[dict[str, Any]], object] | None
    forward_seconds: float
    history: list[dict[str, Any]] = field(default_factory=list)
    simulations: float = 1.0
    iteration: int = 0
    most_iterations: int = 0
    pause: float = np.inf
    best: Point | None = None
    unmoved: np.ndarray = field(init=False)
    stopped: bool = False
    last: bool = False
    schedule: jaxform.Schedule | None = None
    journal: Journal = field(default_factory=Journal)
    limits: tuple[jax.Array, jax.Array] | None = None
    seconds: float = 0.0
    gradient_error: float | None = None
    secants: dict[str, dict[str, float]] = field(default_factory=dict)
    multiplier: float | None = None
    updates: int = 0
    on_wait: Callable[[str], object] | None = None
    memory: Any = None
    evaluators: Evaluators | None = None
    programs: dict[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        splits = np.cumsum([variable.start.size for variable in self.study.variables])[:-1]
        self._splits = [int(split) for split in splits]
        self.most_iterations = self.study.iterations
        self.unmoved = side_of_bounds(self.start, self.reach) != 0.0
        self._began, self._clock = time.perf_counter(), time.process_time()
        self._costs: dict[str, float] = {}
        self._curved: tuple[Point, np.ndarray] | None = None
        if self.study.objective.constrained and self.limits is None:
            multipliers = self.study.objective.first_multipliers(self.study.scene)
            self.limits = multipliers, jnp.asarray(_FIRST_PENALTY)

    @property
    def start(self) -> np.ndarray:
        """The first design, as numbers of the search (n,)."""
        first = self.study.first
        return np.concatenate([variable.start for variable in self.study.variables]) if first is None else first

    @property
    def reach(self) -> np.ndarray:
        """Bounds of the numbers on either side of 0 (n,)."""
        return np.concatenate([variable.reach for variable in self.study.variables])

    def inside(self, free: np.ndarray) -> np.ndarray:
        """The nearest numbers in the box."""
        return np.clip(free, -self.reach, self.reach)

    def _parts(self, free: jax.Array) -> list[tuple[Variable, jax.Array]]:
        return list(zip(self.study.variables, jnp.split(free, self._splits), strict=True))

    def parts(self, free: np.ndarray) -> list[tuple[Variable, np.ndarray]]:
        """The variables, each with its own numbers."""
        return list(zip(self.study.variables, np.split(free, self._splits), strict=True))

    def changes(self, free: jax.Array) -> dict[str, jax.Array]:
        """The changes of the scene, for `jaxform.replace`."""
        return {path: value for part, part_free in self._parts(free) for path, value in part.changes(part_free).items()}

    def document(self, free: np.ndarray) -> dict[str, Any]:
        """The changes as dotted keys of a scene file."""
        parts = self._parts(jnp.asarray(free))
        return {key: value for part, part_free in parts for key, value in part.document(part_free).items()}

    def scene(self, free: np.ndarray) -> Scene:
        """The study's scene with a design."""
        return jaxform.replace(self.study.scene, self.changes(jnp.asarray(free)))

    # --- What is traced -----------------------------------------------------------------------------------------

    def judge(
        self, scene: Scene, result: Result, limits: tuple[jax.Array, jax.Array] | None
    ) -> tuple[jax.Array, dict[str, jax.Array]]:
        """The value of a part, and its reported statistics; traced."""
        result = mask_part(result, scene)
        objective = value = self.study.objective(scene, result)
        report = {"objective": objective, "error": self.study.objective.error(scene, result)}
        if limits is not None:
            excess, weight = self.study.objective.constraints(scene, result)
            report["excess"] = excess
            multipliers, penalty = limits
            pressed = jnp.maximum(multipliers + penalty * excess, 0.0)
            value = value + jnp.sum(weight * (jnp.square(pressed) - jnp.square(multipliers))) / (2.0 * penalty)
            report["multiplier"] = jnp.sum(weight * pressed)
        if self.study.objective.aims:
            there = result.active & (result.thickness > 0)
            if scene.part is not None:
                there &= nodal_area(result) > 0
            ratio = self.study.objective.target_wall(result) / jnp.where(there, result.thickness, 1.0)
            report["ratio"] = jax.lax.stop_gradient(jnp.where(there, ratio, 1.0))
        return value, report | wall(result)

    def _value(
        self,
        free: jax.Array,
        scene: Scene,
        schedule: jaxform.Schedule | None,
        limits: tuple[jax.Array, jax.Array] | None,
    ) -> tuple[jax.Array, dict[str, jax.Array]]:
        scene = jaxform.replace(scene, self.changes(free))
        return self.judge(scene, jaxform.simulate(scene, schedule=schedule), limits)

    def _program(self, name: str, function: Callable[..., Any], *arguments: Any) -> Callable[..., Any]:
        """Compiled ahead, so that the cost of the first evaluation is that of a simulation."""
        if name not in self.programs:
            if self.on_wait is not None and (words := _waiting_message(name, self.study.scene)):
                self.on_wait(words)
            self.programs[name] = compile_function(jax.jit(function), *arguments)
            self._clock = time.process_time()
        return self.programs[name]

    def compute(self, free: np.ndarray) -> tuple[tuple[jax.Array, dict[str, jax.Array]], jax.Array]:
        """Value, report and gradient of a design by one simulation and its reverse derivative."""
        arguments = jnp.asarray(free), self.study.scene, self.schedule, self.limits
        return self._program("gradient", jax.value_and_grad(self._value, has_aux=True), *arguments)(*arguments)

    # --- What searches ask ----------------------------------------------------------------------------------------

    def ask(self, kind: str, free: np.ndarray, work: Callable[[], Answer]) -> Answer:
        """A result from the journal, or of some work whose cost is counted.

        Raises:
            SpentError: If the study's limit on simulations or minutes does not allow the work.
        """

        def compute() -> Answer:
            self._check_budget(kind)
            self._clock = time.process_time()
            answer = work()
            spent = answer.pop("spent", time.process_time() - self._clock)
            return answer | {"cost": spent / self.forward_seconds, "elapsed": time.perf_counter() - self._began}

        answer, known = self.journal.ask(kind, free.tolist(), compute)
        if known:
            self._began = time.perf_counter() - answer["elapsed"]
        self.simulations += answer["cost"]
        self._costs[kind] = answer["cost"]
        self.seconds = answer["elapsed"]
        return answer

    def _check_budget(self, kind: str) -> None:
        """Refuses work that would exceed the budget at the cost that its kind had before; the first design is free."""
        if not self.history or self.last:
            return
        cost = self.simulations + self._costs.get(kind, 1.0)
        if self.limits is not None:
            cost += self._costs.get("value", 1.0)  # reserved for a design that keeps the limits
        ending = budget_ending(self.study, cost, time.perf_counter() - self._began)
        if ending is not None:
            raise SpentError(ending)

    def __call__(self, free: np.ndarray) -> Point:
        """Value and gradient at a design, infinite where its simulation fails; a row of the history."""

        def work() -> Answer:
            (value, report), gradient = self.compute(free)
            return _plain(report) | {"value": float(value), "gradient": np.asarray(gradient, float).tolist()}

        return self.accept(free, self.ask("gradient", free, work))

    def curvature(self, free: np.ndarray) -> tuple[Point, np.ndarray]:
        """The point of a sum of squares, with its Gauss-Newton matrix (n, n), from the deviations' slopes.

        All directions go through one simulation forwards: its primal values are computed once for all of them.
        """

        def deviations(free: jax.Array, scene: Scene, schedule: jaxform.Schedule | None) -> tuple[jax.Array, Any]:
            scene = jaxform.replace(scene, self.changes(free))
            result = jaxform.simulate(scene, schedule=schedule)
            deviations = self.study.objective.deviations(scene, mask_part(result, scene))
            return deviations, self.judge(scene, result, None)

        def columns(free: jax.Array, scene: Scene, schedule: jaxform.Schedule | None) -> Any:
            def column(direction: jax.Array) -> Any:
                at = lambda free: deviations(free, scene, schedule)  # noqa: E731
                deviation, slope, (value, report) = jax.jvp(at, (free,), (direction,), has_aux=True)
                return deviation, slope, value, report

            out = (None, 0, None, None)
            deviation, slopes, value, report = jax.vmap(column, out_axes=out)(jnp.eye(free.size))
            return value, report, 2.0 * slopes @ deviation, 2.0 * slopes @ slopes.T

        def work() -> Answer:
            arguments = jnp.asarray(free), self.study.scene, self.schedule
            value, report, gradient, matrix = self._program("columns", columns, *arguments)(*arguments)
            numbers = {"gradient": np.asarray(gradient, float).tolist(), "matrix": np.asarray(matrix, float).tolist()}
            return _plain(report) | {"value": float(value)} | numbers

        if self._curved is None or not np.array_equal(self._curved[0].free, free):
            answer = self.ask("curvature", free, work)
            self._curved = self.accept(free, answer), np.asarray(answer["matrix"])
        return self._curved

    def evaluate_forward(self, free: np.ndarray) -> tuple[Point, np.ndarray]:
        """The point without its gradient, and the ratio of wanted to present wall (n_node,) where it is known."""
        answer = self.ask("value", free, lambda: self.forward(free))
        return self.accept(free, answer), np.asarray(answer.get("ratio", []))

    def forward(self, free: np.ndarray) -> Answer:
        """Value and report of a design by one simulation."""
        if self.schedule is not None:
            arguments = jnp.asarray(free), self.study.scene, self.schedule, self.limits
            value, report = self._program("value", self._value, *arguments)(*arguments)
            return _plain(report) | {"value": float(value)}
        scene = self.scene(free)
        result = formed_part(scene)
        # The host's records are as long as the run.
        records = dict.fromkeys(("seconds", "pressures", "contacts", "contact_periods", "contact_duration"))
        whole = dataclasses.replace(result, **records)  # pyright: ignore[reportArgumentType]
        arguments = scene, whole, self.limits
        value, report = self._program("judge", self.judge, *arguments)(*arguments)
        return _plain(report) | {"value": float(value)}

    def forward_timed(self, free: np.ndarray) -> Answer:
        """Value and report of a design, with the processor time that it took [s]."""
        self._clock = time.process_time()
        answer = self.forward(free)
        return answer | {"spent": time.process_time() - self._clock}

    def check(self, point: Point) -> float:
        """Relative difference of a gradient and differences along one direction, which it keeps."""
        self.gradient_error = gradient_error(point, self.reach, lambda designs: self._compute_values("check", designs))
        return self.gradient_error

    def secant_values(self, designs: list[np.ndarray]) -> list[float]:
        """Values of designs between which secants are taken."""
        return self._compute_values("secant", designs)

    def with_gradient(self, free: np.ndarray) -> Point:
        """Value and gradient at a design, by the program that the method uses."""
        return self.curvature(free)[0] if self.study.method == "least-squares" else self(free)

    def probe(self, free: np.ndarray) -> float:
        """The value of a design that is no part of the search; infinite where its simulation fails."""
        answer = self.ask("probe", free, lambda: self.forward(free))
        return np.inf if answer["status"] else answer["value"]

    def _compute_values(self, kind: str, designs: list[np.ndarray]) -> list[float]:
        """Values of designs, which are computed side by side where there is something to do so."""
        known: list[Answer | None] = []

        def work(place: int) -> Answer:
            if self.evaluators is not None and not known:
                known.extend(self.evaluators(self.study, designs, (self.schedule, self.limits)))
            return (known[place] if known else None) or self.forward(designs[place])

        return [self.ask(kind, free, lambda k=k: work(k))["value"] for k, free in enumerate(designs)]

    def accept(self, free: np.ndarray, answer: Answer) -> Point:
        """The point of an answer; it is the best one if it is, and a row of the history."""
        gradient = np.asarray(answer.get("gradient", np.full(free.size, np.nan)), float)
        excess = np.asarray(answer.get("excess", []), float)
        slope = slope_within(free, gradient, self.reach)
        point = Point(free, answer["value"], gradient, answer["objective"], excess, slope=slope)
        bad = "gradient" in answer and not np.all(np.isfinite(gradient))
        if answer["status"] or bad or not np.isfinite(point.value):
            point = Point(free, np.inf, np.zeros_like(free), slope=np.zeros_like(free))
        elif self.best is None or point.rank < self.best.rank:
            self.best = point
            self.unmoved = self.unmoved & (side_of_bounds(free, self.reach) == side_of_bounds(self.start, self.reach))
        self._record(point, answer)
        return point

    def _record(self, point: Point, answer: Answer) -> None:
        error, norm = answer["error"], float(np.linalg.norm(point.slope))
        numbers = (
            len(self.history),
            point.objective,
            "" if np.isnan(error) else error,
            answer["least"],
            answer["mean"],
            answer["variation"],
            answer["mass"],
            "" if np.isnan(norm) else norm,
            self.iteration,
            self.simulations,
            self.seconds,
        )
        row: dict[str, Any] = dict(zip(COLUMNS, numbers, strict=True))
        if self.limits is not None:
            row |= {"violation": point.violation, "multiplier": answer["multiplier"]}
        point.row = row
        self.history.append(row)
        if self.on_evaluation is not None and self.on_evaluation(row):
            self.stopped = True

    # --- Between iterations ------------------------------------------------------------------------------------------

    def begin(self) -> Ending | None:
        """Starts an iteration; returns the ending where the study or the round allows no more."""
        if self.iteration >= min(self.most_iterations, self.pause):
            return Ending("iterations", f"{self.iteration} iterations done")
        self.iteration += 1
        return None

    def refresh(self, point: Point) -> Point:
        """The point with the decisions that a run of its design takes, where the mesh is refined and it is time.

        In between the objective is smooth, for all simulations take the same decisions.
        """
        if self.schedule is None or self.iteration % _REFRESH:
            return point
        live = formed_part(self.scene(point.free))
        self.simulations += 1.0
        if int(live.status) or live.used.size != self._capacity:
            return point
        before = self.schedule, self.best
        self.schedule, self.best = live.schedule, None
        fresh = self(point.free)
        if self.best is None:
            self.schedule, self.best = before
            return point
        return fresh

    @property
    def _capacity(self) -> int:
        refinement = self.study.scene.refinement
        return 0 if refinement is None else refinement.elements


# Programs that take long to compile, and for how long [s], with a uniform and a refined mesh, on two cores.
_PROGRAMS = {"gradient": "value and gradient", "columns": "the Jacobian of the deviations"}
_SECONDS = (20, 40)


def _waiting_message(program: str, scene: Scene) -> str | None:
    """Message before a program of the search is compiled; None where that takes little time."""
    if program not in _PROGRAMS:
        return None
    seconds = _SECONDS[scene.refinement is not None]
    return f"compiling {_PROGRAMS[program]}, about {seconds} s unless it was compiled before"


def _plain(report: dict[str, jax.Array]) -> Answer:
    """The report in types that JSON has."""
    plain: Answer = {name: np.asarray(value, float).tolist() for name, value in report.items()}
    return plain | {"status": int(report["status"])}

"""The study file: objectives, variables, search methods."""

from __future__ import annotations

import math
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, Field, Tag, field_validator, model_validator

from jaxform.io.schema.quantities import Count, Limits, Pair, Place, TargetThickness, check_bounds
from jaxform.io.validation import (
    Coordinate,
    NotNegative,
    Positive,
    Table,
    check_increasing,
    choice,
    form,
    validation_error,
)

# Tables of the design variables of a study.


class ThicknessProfileTable(Table):
    """Design the initial thickness [m] along a place in the initial sheet; `slope` limits its change [m/m].

    Attributes:
        kind: The kind of variable.
        along: Place in the initial sheet.
        knots: Number of knots, evenly placed; this or `at`.
        at: Places of the knots [m].
        bounds: Least and largest thickness [m].
        interpolation: Linear between knots, a cubic spline, or constant zones.
        slope: Largest change along the place [m/m].
    """

    kind: Literal["thickness-profile"]
    along: Place
    knots: Annotated[int, Field(ge=2, le=10_000)] | None = None
    at: Annotated[list[Coordinate], Field(min_length=2)] | None = None
    bounds: Limits
    interpolation: Literal["linear", "cubic", "zones"] = "linear"
    slope: Positive | None = None

    @model_validator(mode="after")
    def _check(self) -> ThicknessProfileTable:
        if (self.knots is None) == (self.at is None):
            problem = "is missing" if self.at is None else "is given together with at"
            raise validation_error(
                problem, "give either the number of knots or their positions (at)", "knots", self.knots
            )
        check_increasing(self.at or [])
        if self.interpolation == "cubic" and (self.knots or 0) < 4:
            raise validation_error("needs 4 or more evenly spaced knots", "give knots, not at", "knots", self.knots)
        if self.interpolation == "zones" and self.slope is not None:
            raise validation_error(
                "cannot be combined with zones, which are discontinuous", "leave it out", "slope", self.slope
            )
        return self


class ThicknessFieldTable(Table):
    """Design the initial thickness [m] at the nodes of the mesh, no finer than a length `smoothness` [m].

    Attributes:
        kind: The kind of variable.
        bounds: Least and largest thickness [m].
        smoothness: Length below which the field does not vary [m].
    """

    kind: Literal["thickness-field"]
    bounds: Limits
    smoothness: NotNegative = 0.0


class PressureKnotsTable(Table):
    """Design the values [Pa] at the knots of the scene's pressure; `rate` [Pa/s], the last knot's time [s].

    `held` keeps the first knot's value; else the history may start with a jump.

    Attributes:
        kind: The kind of variable.
        bounds: Least and largest pressure [Pa].
        increasing: True if the pressure may not fall.
        rate: Largest change over time [Pa/s].
        held: True if the first knot keeps its value.
        end_time: Least and largest time of the last knot [s]; all are stretched with it.
    """

    kind: Literal["pressure"]
    bounds: Annotated[Pair, AfterValidator(check_bounds)]
    increasing: bool = False
    rate: Positive | None = None
    held: bool = False
    end_time: Limits | None = None


class ScaleTable(Table):
    """Design a factor on a number of the scene, such as material.c.

    Attributes:
        kind: The kind of variable.
        of: Key of the number or list: material.c, parison.thickness, pressure.value, solver.damping, mold.friction,
            tool.plug.friction, tool.plug.displacement, tool.plug.time (plug is the name of a tool), gas.mass_flow,
            gas.time, gas.supply_pressure, ...
        bounds: Least and largest factor.
    """

    kind: Literal["scale"]
    of: str
    bounds: Limits


class HeaterZonesTable(Table):
    """Design the settings of a grid of heaters over the sheet; each place has their mean, by view factors.

    Attributes:
        kind: The kind of variable.
        grid: Number of heaters along x and along y, over the sheet's extent.
        distance: Distance from the heaters to the sheet [m]: the larger, the smoother the field; 0 for sharp zones.
        bounds: Least and largest setting, in the unit of `of`.
        of: The designed field: parison.temperature [degC], or a parameter of the material.
    """

    kind: Literal["heater-zones"]
    grid: Annotated[list[Annotated[int, Field(ge=1, le=400)]], Field(min_length=2, max_length=2)]
    distance: NotNegative
    bounds: Annotated[Pair, AfterValidator(check_bounds)]
    of: str = "parison.temperature"


_VARIABLES = ["thickness-profile", "thickness-field", "pressure", "scale", "heater-zones"]
Variable = Annotated[
    Annotated[ThicknessProfileTable, Tag("<thickness-profile>")]
    | Annotated[ThicknessFieldTable, Tag("<thickness-field>")]
    | Annotated[PressureKnotsTable, Tag("<pressure>")]
    | Annotated[ScaleTable, Tag("<scale>")]
    | Annotated[HeaterZonesTable, Tag("<heater-zones>")],
    *choice("kind", _VARIABLES),
]


# Tables of the objectives of a study.


class ObjectiveTable(Table):
    """Keys that all objectives share.

    Attributes:
        weight: Weight of the objective in a sum of several.
    """

    weight: Positive = 1.0


class TargetTable(ObjectiveTable):
    """Minimize the deviation from a final thickness [m]; with `limit`, keep it (relative, rms) below a limit instead.

    Attributes:
        kind: The kind of objective.
        thickness: The target wall [m].
        limit: Largest relative deviation (rms), a constraint beside another objective; without it, the deviation is
            minimized.
    """

    kind: Literal["target"]
    thickness: TargetThickness
    limit: Positive | None = None


class UniformTable(ObjectiveTable):
    """Make the wall even.

    Attributes:
        kind: The kind of objective.
    """

    kind: Literal["uniform"]


class LeastMassTable(ObjectiveTable):
    """Minimize the mass for a minimum of the wall [m].

    Attributes:
        kind: The kind of objective.
        minimum: Minimum of the wall [m].
        flash: True if the mass is that of the whole sheet, with its flash and all that is cut from the part; the
            minimum is that of the part alone.
    """

    kind: Literal["least-mass"]
    minimum: Positive
    flash: bool = False


class FormingTimeTable(ObjectiveTable):
    """Minimize the forming time, a mean of the contact times.

    Attributes:
        kind: The kind of objective.
        power: Exponent of the power mean of the contact times: the higher, the more the last contact counts.
    """

    kind: Literal["forming-time"]
    power: Annotated[float, Field(ge=1, le=100)] = 8.0


class KineticEnergyTable(ObjectiveTable):
    """Minimize the kinetic energy at contact.

    Attributes:
        kind: The kind of objective.
    """

    kind: Literal["kinetic-energy"]


_OBJECTIVES = ["target", "uniform", "least-mass", "forming-time", "kinetic-energy"]
Objective = Annotated[
    Annotated[TargetTable, Tag("<target>")]
    | Annotated[UniformTable, Tag("<uniform>")]
    | Annotated[LeastMassTable, Tag("<least-mass>")]
    | Annotated[FormingTimeTable, Tag("<forming-time>")]
    | Annotated[KineticEnergyTable, Tag("<kinetic-energy>")],
    *choice("kind", _OBJECTIVES),
]
Objectives = Annotated[
    Annotated[Objective, Tag("<one>")] | Annotated[Annotated[list[Objective], Field(min_length=1)], Tag("<several>")],
    form(lambda value: "several" if isinstance(value, list) else "one"),
]


# Tables of the search methods of a study.


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
        hops: Searches that follow one which ends in a local optimum above the goal, each from the best design with all
            numbers shifted at random by 4 % of their bounds (basin hopping); for an objective without limits. Each has
            its own number of iterations.
        starts: Number of whole searches: one from the scene's own design, the others from points spread evenly within
            the bounds; the best design is the result. Limits on iterations, simulations and time are those of each.
        rounds: Largest number of multiplier rounds for limits.
    """

    iterations: Count = 30
    max_simulations: Positive | None = None
    minutes: Positive | None = None
    tolerance: NotNegative | None = None
    gradient_tolerance: NotNegative | None = None
    goal: Positive | None = None
    warm_start: Annotated[int, Field(ge=0, le=1_000_000)] | None = None
    hops: Annotated[int, Field(ge=0, le=10_000)] = 0
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


class StudyFile(Table):
    """A study file.

    Attributes:
        description: One line for the list of studies.
        scene: A built-in scene, or a scene file relative to this one.
        variable: Design variables: one table or more.
        objective: The objective: one table, or several that add up by weight.
        solver: The search method.
        sweep: Designs of the scene that `jaxform sweep` computes; a search passes over it.
    """

    description: str = ""
    scene: str
    variable: Annotated[list[Variable], Field(min_length=1)]
    objective: Objectives
    solver: Method
    sweep: SweepTable | None = None

    @field_validator("variable")
    @classmethod
    def _each_once(cls, variables: list[Any]) -> list[Any]:
        kinds = [getattr(variable, "of", variable.kind) for variable in variables]
        for index, kind in enumerate(kinds):
            if kind in kinds[:index]:
                raise validation_error("is given twice", "keep one of them", f"[{index}].kind", kind)
        return variables


class SweepFile(Table):
    """A study file of a sweep: without a search, its variables, objective and solver may be missing.

    Attributes:
        description: One line for the list of studies.
        scene: A built-in scene, or a scene file relative to this one.
        variable: Design variables of a search for each design of the sweep (`--optimize`).
        objective: The objective of that search.
        solver: The method of that search.
        sweep: The designs.
    """

    description: str = ""
    scene: str | None = None
    variable: list[Any] | None = None
    objective: Any = None
    solver: Any = None
    sweep: SweepTable


# The tables of a sweep: a design of experiments over numbers and files of a scene, or a table of designs.

MOST_DESIGNS = 1_000_000
_Level = bool | int | float | str | list[Any] | dict[str, Any]


class SweepVariableTable(Table):
    """A number, file or table of the scene that differs between the designs.

    Attributes:
        path: Its place in the scene file, such as `mold.depth`, `parison.thickness` or `pressure.value[1]`.
        bounds: Least and largest value, in the unit of the scene file; these or `values`.
        values: Values to choose from, as the scene file would have them.
        levels: Number of values between the bounds in a full factorial, the bounds included.
        scale: Spacing between the bounds: even, or even in the logarithm.
        integer: True if values between the bounds are rounded to whole numbers.
    """

    path: str
    bounds: Pair | None = None
    values: Annotated[list[_Level], Field(min_length=1)] | None = None
    levels: Annotated[int, Field(ge=2, le=10_000)] = 3
    scale: Literal["linear", "log"] = "linear"
    integer: bool = False

    @model_validator(mode="after")
    def _check(self) -> SweepVariableTable:
        if (self.bounds is None) == (self.values is None):
            problem = "is missing" if self.bounds is None else "is given together with values"
            remedy = "give bounds = [least, largest] or values = [...], one of them"
            raise validation_error(problem, remedy, "bounds", self.bounds)
        if self.bounds is not None and self.bounds[0] >= self.bounds[1]:
            raise validation_error(
                "does not increase", "give the lower bound first, then the upper one", "bounds", self.bounds
            )
        if self.bounds is not None and self.scale == "log" and self.bounds[0] <= 0.0:
            raise validation_error(
                "has no logarithm", 'give positive bounds, or scale = "linear"', "bounds", self.bounds
            )
        if self.bounds is not None and self.integer and math.ceil(self.bounds[0]) > math.floor(self.bounds[1]):
            remedy = "widen the bounds, or leave integer out"
            raise validation_error("has no whole number between", remedy, "bounds", self.bounds)
        return self


class SweepTable(Table):
    """The designs of `jaxform sweep`: a design of experiments, or a table of designs in a file.

    Attributes:
        method: All combinations of levels, or points of a Latin hypercube or of a Sobol sequence (scrambled).
        designs: Number of designs of a Latin hypercube or Sobol sequence; of a Sobol sequence best a power of two.
        seed: Seed of the random numbers: the same seed gives the same designs.
        variable: The variables of the designs: one table or more.
        table: A table of designs (CSV) instead, relative to this file.
    """

    method: Literal["factorial", "latin-hypercube", "sobol"] = "factorial"
    designs: Annotated[int, Field(ge=1, le=MOST_DESIGNS)] | None = None
    seed: Annotated[int, Field(ge=0)] = 0
    variable: list[SweepVariableTable] = Field(default_factory=list)
    table: str | None = None

    @model_validator(mode="after")
    def _check(self) -> SweepTable:
        if (self.table is None) == (not self.variable):
            problem = "is missing" if self.table is None else "is given together with table"
            raise validation_error(problem, "add [[sweep.variable]] tables, or name a table, one of them", "variable")
        if self.table is not None:
            return self
        if (self.designs is None) == (self.method != "factorial"):
            problem = "is missing" if self.designs is None else "cannot be combined with a full factorial"
            remedy = "give their number" if self.designs is None else "leave it out, or choose another method"
            raise validation_error(problem, remedy, "designs", self.designs)
        paths = [variable.path for variable in self.variable]
        for index, path in enumerate(paths):
            if path in paths[:index]:
                raise validation_error("occurs twice", "keep one of them", f"variable[{index}].path", path)
        return self

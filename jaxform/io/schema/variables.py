"""Tables of the design variables of a study."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import AfterValidator, Field, Tag, model_validator

from jaxform.io.schema.quantities import Limits, Pair, Place, check_bounds
from jaxform.io.validation import Coordinate, NotNegative, Positive, Table, check_increasing, choice, validation_error


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
                problem, "give the number of knots or their places (at), one of them", "knots", self.knots
            )
        check_increasing(self.at or [])
        if self.interpolation == "cubic" and (self.knots or 0) < 4:
            raise validation_error("needs 4 evenly placed knots or more", "give knots, not at", "knots", self.knots)
        if self.interpolation == "zones" and self.slope is not None:
            raise validation_error("does not go with zones, which jump", "leave it out", "slope", self.slope)
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

    `held` keeps the first knot's value; else the history may begin with a jump.

    Attributes:
        kind: The kind of variable.
        bounds: Least and largest pressure [Pa].
        increasing: Whether the pressure may not fall.
        rate: Largest change over time [Pa/s].
        held: Whether the first knot keeps its value.
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
        of: Key of the number: material.c, material.density, parison.thickness, pressure.value, solver.damping, ...
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
        distance: Distance from the heaters to the sheet [m]: the farther, the more they blur; 0 for sharp zones.
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

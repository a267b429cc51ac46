"""The tables of a sweep: a design of experiments over numbers and files of a scene, or a table of designs."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import Field, model_validator

from jaxform.io.schema.quantities import Pair
from jaxform.io.validation import Table, validation_error

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
        integer: Whether values between the bounds are rounded to whole numbers.
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
        return self


class SweepTable(Table):
    """The designs of `jaxform sweep`: a design of experiments, or a table of designs in a file.

    Attributes:
        method: All combinations of levels, or points of a Latin hypercube or of a Sobol sequence (scrambled).
        designs: Number of designs of a Latin hypercube or Sobol sequence; of a Sobol sequence best a power of two.
        seed: Seed of the random numbers: the same seed gives the same designs.
        variable: What differs between the designs: one table or more.
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
            problem = "is missing" if self.designs is None else "does not go with a full factorial"
            remedy = "give their number" if self.designs is None else "leave it out, or choose another method"
            raise validation_error(problem, remedy, "designs", self.designs)
        paths = [variable.path for variable in self.variable]
        for index, path in enumerate(paths):
            if path in paths[:index]:
                raise validation_error("is there twice", "keep one of them", f"variable[{index}].path", path)
        return self

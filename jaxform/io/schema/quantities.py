"""Numbers, profiles and fields that several tables have."""

from __future__ import annotations

from typing import Annotated, Any, Literal, TypeVar

from pydantic import AfterValidator, Field, Tag, model_validator

from jaxform.io.validation import (
    Coordinate,
    Number,
    Positive,
    Table,
    check_increasing,
    declared_range,
    form,
    validation_error,
)

Triple = Annotated[list[Coordinate], Field(min_length=3, max_length=3)]
Pair = Annotated[list[Number], Field(min_length=2, max_length=2)]
Point = Annotated[list[Coordinate], Field(min_length=2, max_length=2)]
Count = Annotated[int, Field(ge=1, le=1_000_000_000)]
"""A count of things for which no memory is allocated in advance."""
Place = Literal["radius", "x", "y", "z", "angle", "arc"]

_FORMS = 'give a number, {along, at, value}, {file, field} or "field:NAME"'


class ProfileTable(Table):
    """A positive quantity, piecewise linear along a place in the initial sheet.

    Attributes:
        along: Place in the initial sheet: distance from the z axis, a coordinate, `angle` about the z axis (from 0 to
            360 degrees, from x towards y), or `arc` along the meridian of a preform, from its pole.
        at: Knots [m, an angle in degrees], increasing; the value is held beyond the first and the last.
        value: Values, one per knot, in the unit of the quantity.
    """

    along: Place
    at: Annotated[list[Coordinate], Field(min_length=1)]
    value: list[Positive]

    @model_validator(mode="after")
    def _check(self) -> ProfileTable:
        check_knots(self.at, self.value)
        return self


class NumberProfile(Table):
    """A quantity, piecewise linear along a place in the initial sheet.

    Attributes:
        along: Place in the initial sheet: distance from the z axis, a coordinate, `angle` about the z axis (from 0 to
            360 degrees, from x towards y), or `arc` along the meridian of a preform, from its pole.
        at: Knots [m, an angle in degrees], increasing; the value is held beyond the first and the last.
        value: Values, one per knot, in the unit and the range of the quantity.
    """

    along: Place
    at: Annotated[list[Coordinate], Field(min_length=1)]
    value: list[Number]

    @model_validator(mode="after")
    def _check(self) -> NumberProfile:
        check_knots(self.at, self.value)
        return self


class TargetProfile(Table):
    """A target thickness, piecewise linear along a place in the initial sheet or in the formed part.

    Attributes:
        along: Place in the initial sheet (`initial-...`) or in the formed part.
        at: Knots [m], increasing.
        value: Target thickness [m], one per knot.
    """

    along: Literal["initial-radius", "initial-x", "initial-y", "initial-z", "radius", "x", "y", "z"]
    at: Annotated[list[Coordinate], Field(min_length=1)]
    value: list[Positive]

    @model_validator(mode="after")
    def _check(self) -> TargetProfile:
        check_knots(self.at, self.value)
        return self


class FieldReference(Table):
    """A nodal field in a mesh file, found by initial position [m].

    Attributes:
        file: A mesh file, relative to the scene file.
        field: Name of its point data. A mesh that has point data `reference` is matched by it.
    """

    file: str
    field: str


class SceneReference(Table):
    """The wall that another scene makes, at the same initial places.

    Attributes:
        scene: A built-in scene, or a scene file.
    """

    scene: str


def check_knots(at: list[float], value: list[float]) -> None:
    """Raises a validation error unless the knots increase and there is one value for each."""
    check_increasing(at)
    if len(at) != len(value):
        problem = f"has {len(value)} values for {len(at)} knots"
        raise validation_error(problem, "give one value per knot", "value", value)


def _own_field(text: str) -> str:
    if not text.startswith("field:") or text == "field:":
        raise validation_error("is not a number", _FORMS, value=text)
    return text


def _quantity_form(value: Any) -> str:
    if isinstance(value, dict):
        return "reference" if {"file", "field"} & set(value) else "profile"
    return "own field" if isinstance(value, str) else "number"


_Number = Annotated[Positive, Tag("<number>")]
_Wall = Annotated[float, declared_range("parison.thickness")]
_Reference = Annotated[FieldReference, Tag("<reference>")]
Thickness = Annotated[
    Annotated[_Wall, Tag("<number>")]
    | Annotated[ProfileTable, Tag("<profile>")]
    | _Reference
    | Annotated[str, AfterValidator(_own_field), Tag("<own field>")],
    form(_quantity_form),
]
_N = TypeVar("_N")
Zoned = Annotated[
    Annotated[_N, Tag("<number>")]
    | Annotated[NumberProfile, Tag("<profile>")]
    | _Reference
    | Annotated[str, AfterValidator(_own_field), Tag("<own field>")],
    form(_quantity_form),
]
"""A number, or a quantity that may vary over the sheet."""
Temperature = Zoned[Annotated[float, declared_range("parison.temperature")]]
ElementSize = Annotated[
    _Number | Annotated[ProfileTable, Tag("<profile>")],
    form(lambda value: "profile" if isinstance(value, dict) else "number"),
]
TargetThickness = Annotated[
    _Number | Annotated[TargetProfile, Tag("<profile>")] | _Reference | Annotated[SceneReference, Tag("<scene>")],
    form(lambda value: _target_form(value)),
]


def _target_form(value: Any) -> str:
    if isinstance(value, dict) and "scene" in value:
        return "scene"
    return "number" if isinstance(value, str) else _quantity_form(value)


def check_bounds(bounds: list[float]) -> list[float]:
    """The bounds; raises unless the lower one is below the upper one."""
    if bounds[0] >= bounds[1]:
        raise validation_error(
            "leaves no range to search", "give the lower bound first, then the upper one", value=bounds
        )
    return bounds


Limits = Annotated[list[Positive], Field(min_length=2, max_length=2), AfterValidator(check_bounds)]

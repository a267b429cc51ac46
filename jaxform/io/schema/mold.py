"""Tables of the mold and of the other tools."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import BeforeValidator, Field, Tag, model_validator

from jaxform.io.schema.quantities import Point, Triple, check_knots
from jaxform.io.validation import (
    Length,
    NotNegative,
    Number,
    Positive,
    Table,
    choice,
    declared_range,
    form,
    validation_error,
)


class MotionTable(Table):
    """Motion of the mold along a straight line, smooth from knot to knot; nodes that stick to it move with it.

    Attributes:
        direction: Direction of the displacement, a vector of any length.
        time: Knots [s].
        displacement: Displacement from the initial position at the knots [m]; the first is 0.
    """

    direction: Triple
    time: Annotated[list[Number], Field(min_length=2)]
    displacement: Annotated[list[Number], Field(min_length=2)]


class FrictionTable(Table):
    """Coefficient of friction, piecewise linear over the temperature of the sheet.

    Attributes:
        along: `temperature`.
        at: Knots [degC], increasing; the coefficient is held beyond the first and the last.
        value: Coefficients of friction, one per knot.
    """

    along: Literal["temperature"]
    at: Annotated[list[Annotated[float, declared_range("parison.temperature")]], Field(min_length=2)]
    value: list[Annotated[float, declared_range("mold.contact.friction")]]

    @model_validator(mode="after")
    def _check(self) -> FrictionTable:
        check_knots(self.at, self.value)
        return self


Friction = Annotated[
    Annotated[float, declared_range("mold.contact.friction"), Tag("<number>")]
    | Annotated[FrictionTable, Tag("<profile>")],
    form(lambda value: "profile" if isinstance(value, dict | FrictionTable) else "number"),
]


class PlacedTable(Table):
    """Keys of all tools: their position and their contact with the sheet.

    Attributes:
        translate: Translation [m] after the rotation.
        rotate: Rotation about x, y and z, one after the other [degrees].
        land: Width of the land of a mold half [m]: the flat face around its cavity, in the plane across x, y or z in
            which it is open. The parison is pinched between the lands; film on the land is flash, not part.
        contact: Contact law of the sheet: nodes `stick`, `slide` without friction, or slide with friction (`coulomb`).
        friction: Coefficient of friction, where contact = "coulomb"; a number, or { along = "temperature", at, value }.
    """

    translate: Triple = Field(default_factory=lambda: [0.0, 0.0, 0.0])
    rotate: Triple = Field(default_factory=lambda: [0.0, 0.0, 0.0])
    land: Length | None = None
    contact: Literal["stick", "coulomb", "slide"] = "stick"
    friction: Friction | None = None

    @model_validator(mode="after")
    def _check_friction(self) -> PlacedTable:
        if self.contact == "coulomb" and self.friction is None:
            remedy = 'give the coefficient of friction, or contact = "slide" without friction'
            raise validation_error("is missing, and contact is coulomb", remedy, "friction", None)
        frictionless = self.contact == "slide" and self.friction == 0.0
        if self.contact != "coulomb" and self.friction is not None and not frictionless:
            remedy = 'give contact = "coulomb", or leave the friction out'
            given = self.friction.value if isinstance(self.friction, FrictionTable) else self.friction
            raise validation_error(f"has no effect with contact = {self.contact}", remedy, "friction", given)
        return self


class MoldTable(PlacedTable):
    """Keys of all molds.

    Attributes:
        motion: Motion of the mold; at rest by default.
        fill: True if the mold is to be filled; if so, the status reports a gap of a fifth of the opening's depth.
    """

    motion: MotionTable | None = None
    fill: bool = True


_MOTION = ("direction", "time", "displacement")


class ToolTable(PlacedTable):
    """Keys of all tools besides the mold. A tool rests, or moves along a straight line, smoothly from knot to knot.

    Attributes:
        name: Name of the tool, by which studies and files of results call it; tool1, tool2, ... by default.
        direction: Direction of the motion, a vector of any length; without it, the tool rests.
        time: Knots of the motion [s].
        displacement: Displacement from the initial position at the knots [m]; the first is 0.
        temperature: Temperature of the tool [degC], where the scene cools; cooling.mold_temperature by default.
        heat_transfer: Heat transfer coefficient to the tool [W/(m^2 K)], where it cools; cooling.mold by default.
    """

    name: str | None = None
    direction: Triple | None = None
    time: Annotated[list[Number], Field(min_length=2)] | None = None
    displacement: Annotated[list[Number], Field(min_length=2)] | None = None
    temperature: Annotated[float, declared_range("mold.temperature")] | None = None
    heat_transfer: Annotated[float, declared_range("mold.heat_transfer")] | None = None

    @model_validator(mode="after")
    def _check_motion(self) -> ToolTable:
        missing = [key for key in _MOTION if getattr(self, key) is None]
        if 0 < len(missing) < len(_MOTION):
            given = next(key for key in _MOTION if key not in missing)
            remedy = "a tool that moves needs direction, time and displacement; one that rests has none of them"
            raise validation_error(f"is missing, but {given} is given", remedy, missing[0], None)
        return self

    @property
    def motion(self) -> dict[str, list[float]] | None:
        """Direction, knots and displacements of the motion; None for a tool that rests."""
        return None if self.direction is None else {key: getattr(self, key) for key in _MOTION}


class Revolved(Table):
    """A profile [[r, z], ...] from the axis outwards, turned about the z axis.

    Attributes:
        shape: The kind of surface.
        profile: Points [r, z] [m] from the axis outwards.
        segments: Number of segments around the axis; with 96 the facets lie within 0.05 % of the radius.
    """

    shape: Literal["revolved"]
    profile: Annotated[list[Point], Field(min_length=2)]
    segments: Annotated[int, Field(ge=3, le=1_000_000)] = 96


class BoxInsert(Table):
    """A box, open at z = 0, with a raised block in the middle of its bottom.

    Attributes:
        shape: The kind of surface.
        size: Sides of the box along x and y [m].
        depth: Depth of the box [m].
        insert_size: Sides of the block along x and y [m].
        insert_height: Height of the block [m].
        draft: Draft angle of all walls [degrees].
        divisions: Number of parts into which each side of a triangle is divided.
    """

    shape: Literal["box-insert"]
    size: Annotated[list[Length], Field(min_length=2, max_length=2)] = Field(default_factory=lambda: [0.3, 0.2])
    depth: Length = 0.08
    insert_size: Annotated[list[Length], Field(min_length=2, max_length=2)] = Field(
        default_factory=lambda: [0.12, 0.08]
    )
    insert_height: Length = 0.04
    draft: NotNegative = 0.0
    divisions: Annotated[int, Field(ge=1, le=200)] = 1


class BottleHalf(Table):
    """Half of a soap bottle with a handle, z >= 0.

    Attributes:
        shape: The kind of surface.
        height: Height of the bottle [m].
        radius: Radius of its body [m].
        neck_radius: Radius of its neck [m].
        hole: Half width and half height of the hole of the handle [m].
        hole_center: Distance of the hole's middle from the axis, and its height [m]; by default 0.41 radii and 0.66
            heights.
        handle_edge: Distance of the handle's outer edge from the axis [m]; by default nearly the body's radius.
        element_size: Side of a triangle [m].
    """

    shape: Literal["bottle-half"]
    height: Length = 0.23
    radius: Length = 0.04
    neck_radius: Length = 0.014
    hole: Annotated[list[Length], Field(min_length=2, max_length=2)] = Field(default_factory=lambda: [0.0075, 0.027])
    hole_center: Annotated[list[Length], Field(min_length=2, max_length=2)] | None = None
    handle_edge: Length | None = None
    element_size: Length = 0.00595


class Rod(Table):
    """A rod along z with a rounded end: the end touches z = 0 from below, the rod is at z < 0.

    Attributes:
        shape: The kind of surface.
        radius: Radius of the rod [m].
        length: Length of the rod [m], with its end.
        end_radius: Radius of the rounding between end and side [m]: by default that of the rod, so that the end is a
            hemisphere; 0 for a flat end with a sharp edge.
        segments: Number of segments around the axis.
    """

    shape: Literal["rod"]
    radius: Length
    length: Length
    end_radius: NotNegative | None = None
    segments: Annotated[int, Field(ge=3, le=10_000)] = 48


class Plate(Table):
    """A plate in z = 0: a rectangle from the origin to [a, b], as a rectangular sheet, or a disc about the origin.

    Attributes:
        shape: The kind of surface.
        size: Sides of a rectangle along x and y [m]; this or `radius`.
        radius: Radius of a disc [m].
        segments: Number of segments of a disc's circle.
    """

    shape: Literal["plate"]
    size: Annotated[list[Length], Field(min_length=2, max_length=2)] | None = None
    radius: Length | None = None
    segments: Annotated[int, Field(ge=3, le=10_000)] = 48

    @model_validator(mode="after")
    def _check_sides(self) -> Plate:
        if (self.size is None) == (self.radius is None):
            problem = "is missing" if self.size is None else "is given together with radius"
            raise validation_error(problem, "give size = [a, b] or radius, one of them", "size", self.size)
        return self


Paths = Annotated[
    Annotated[str, Tag("<one>")] | Annotated[Annotated[list[str], Field(min_length=1)], Tag("<several>")],
    form(lambda value: "several" if isinstance(value, list) else "one"),
]


class MeshFile(Table):
    """A user's mesh, in one file or several: scaled, turned about x, y, z [degrees], then moved [m].

    Attributes:
        shape: The kind of surface.
        path: A mesh file or several that are one surface, relative to the scene file.
        scale: Factor on its coordinates: 0.001 of a mesh in millimetres.
    """

    shape: Literal["file"]
    path: Paths
    scale: Positive = 1.0


class RevolvedMold(Revolved, MoldTable):
    """A profile [[r, z], ...] from the axis outwards, turned about the z axis."""


class BoxInsertMold(BoxInsert, MoldTable):
    """A box, open at z = 0, with a raised block in the middle of its bottom."""


class BottleHalfMold(BottleHalf, MoldTable):
    """Half of a soap bottle with a handle, z >= 0."""


class RodMold(Rod, MoldTable):
    """A rod along z with a rounded end: the end touches z = 0 from below, the rod is at z < 0."""


class PlateMold(Plate, MoldTable):
    """A plate in z = 0: a rectangle from the origin to [a, b], as a rectangular sheet, or a disc about the origin."""


class FileMold(MeshFile, MoldTable):
    """A user's mesh, in one file or several: scaled, turned about x, y, z [degrees], then moved [m]."""


class RevolvedTool(Revolved, ToolTable):
    """A profile [[r, z], ...] from the axis outwards, turned about the z axis."""


class BoxInsertTool(BoxInsert, ToolTable):
    """A box, open at z = 0, with a raised block in the middle of its bottom."""


class BottleHalfTool(BottleHalf, ToolTable):
    """Half of a soap bottle with a handle, z >= 0."""


class RodTool(Rod, ToolTable):
    """A rod along z with a rounded end: the end touches z = 0 from below, the rod is at z < 0."""


class PlateTool(Plate, ToolTable):
    """A plate in z = 0: a rectangle from the origin to [a, b], as a rectangular sheet, or a disc about the origin."""


class FileTool(MeshFile, ToolTable):
    """A user's mesh, in one file or several: scaled, turned about x, y, z [degrees], then moved [m]."""


SHAPES = ["revolved", "box-insert", "bottle-half", "rod", "plate", "file"]
Mold = Annotated[
    Annotated[RevolvedMold, Tag("<revolved>")]
    | Annotated[BoxInsertMold, Tag("<box-insert>")]
    | Annotated[BottleHalfMold, Tag("<bottle-half>")]
    | Annotated[RodMold, Tag("<rod>")]
    | Annotated[PlateMold, Tag("<plate>")]
    | Annotated[FileMold, Tag("<file>")],
    *choice("shape", SHAPES),
]
Tool = Annotated[
    Annotated[RevolvedTool, Tag("<revolved>")]
    | Annotated[BoxInsertTool, Tag("<box-insert>")]
    | Annotated[BottleHalfTool, Tag("<bottle-half>")]
    | Annotated[RodTool, Tag("<rod>")]
    | Annotated[PlateTool, Tag("<plate>")]
    | Annotated[FileTool, Tag("<file>")],
    *choice("shape", SHAPES),
]


def _check_list(value: Any) -> Any:
    if not isinstance(value, list):
        raise validation_error(
            "is not a list of tools", "write each tool as a section [[tool]], in two brackets", "", value
        )
    return value


Tools = Annotated[list[Tool], BeforeValidator(_check_list)]


def tool_name(table: Any, number: int) -> str:
    """The name of a tool, the number-th of a scene from 1 on; a table of a file, validated or not."""
    name = table.get("name") if isinstance(table, dict) else getattr(table, "name", None)
    return name if isinstance(name, str) else f"tool{number}"


def find_tool(tables: Any, step: str) -> int | None:
    """The index of the tool of this name in the list of a scene file's tools; None where there is none."""
    names = [tool_name(table, number) for number, table in enumerate(tables, 1)] if isinstance(tables, list) else []
    return names.index(step) if step in names else None


def check_names(tools: list[Any]) -> None:
    """Raises unless each tool has a name of its own that can be part of a file's name and of a key."""
    names: list[str] = []
    for number, table in enumerate(tools, 1):
        name = tool_name(table, number)
        plain = name.casefold()
        remedy = "give each tool a name of its own"
        if plain in names:
            raise validation_error("is the name of another tool", remedy, f"tool[{number - 1}].name", name)
        if plain == "mold":
            raise validation_error("is the name of the mold", remedy, f"tool[{number - 1}].name", name)
        if not name.replace("-", "_").isidentifier() or len(name) > 50:
            remedy = "use letters, digits, - and _, such as plug or clamp-2"
            raise validation_error("cannot be the name of a tool", remedy, f"tool[{number - 1}].name", name)
        names.append(plain)

"""Tables of the sheet."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import AfterValidator, Field, Tag, field_validator, model_validator

from jaxform.core.errors import InputError
from jaxform.io.schema.quantities import Count, ElementSize, Point, ProfileTable, Temperature, Thickness
from jaxform.io.validation import Length, Positive, Table, choice, declared_range, form, validation_error
from jaxform.mesh.shapes import parse_plane

Stretch = Annotated[float, declared_range("parison.pre_stretch")]
ClampUntil = Annotated[float, declared_range("parison.clamp_until")]


def _given_elsewhere(given: Any) -> Any:
    if isinstance(given, str):
        problem = "only a parison from a file has fields"
        raise validation_error(problem, "give {file, field}, a number or a profile", value=given)
    return given


PreStretch = Annotated[list[Stretch], Field(min_length=2, max_length=2)]


class Adapt(Table):
    """The mesh that a sheet gets before its run, finer where the wall of earlier runs is less accurate.

    Attributes:
        elements: Largest number of triangles of the new mesh; by default 2500, or that of the first mesh where it is
            larger.
        passes: Number of runs, each followed by a new mesh.
    """

    elements: Annotated[int, Field(ge=20, le=10_000_000)] | None = None
    passes: Annotated[int, Field(ge=1, le=5)] = 2


class _Sheet(Table):
    """Keys that all parisons share.

    Attributes:
        mesh: A mesh file of this sheet instead of its own triangles, as `jaxform adapt` writes it.
        adapt: Adaptation of the mesh to the wall before the run; `{}` for the defaults.
        clamp_until: Time [s] at which the clamp opens: the clamped nodes are free from then on. By default it holds
            them to the end.
    """

    mesh: str | None = None
    adapt: Adapt | None = None
    clamp_until: ClampUntil | None = None


class _BuiltIn(_Sheet):
    """Keys that the built-in parisons share: exactly one of element_size and elements, cut planes, thickness.

    Attributes:
        elements: Approximate number of triangles; this or `element_size`.
        symmetry: Fraction of the sheet that is simulated.
        thickness: Initial thickness [m].
        temperature: Temperature of the sheet [degC], where the material has a time-temperature shift.
    """

    elements: Count | None = None
    symmetry: Literal["none", "half", "quarter"] = "none"
    thickness: Thickness
    temperature: Temperature | None = None

    _no_own_field = field_validator("thickness", "temperature")(_given_elsewhere)


class Disc(_BuiltIn):
    """A round sheet about the origin in z = 0 with a clamped rim.

    Attributes:
        shape: The kind of sheet.
        radius: Radius of the sheet [m].
        element_size: Side of a triangle [m], or a profile of it along the radius.
        symmetry: Fraction of the sheet that is simulated; the cut planes are x = 0, and y = 0 of a quarter.
        pre_stretch: Stretches [along x, along y] of the flat sheet before it is clamped, from the origin; its shape and
            thickness are those before. None by default.
    """

    shape: Literal["disc"]
    radius: Length
    element_size: ElementSize | None = None
    pre_stretch: PreStretch | None = None

    @field_validator("element_size")
    @classmethod
    def _along_radius(cls, size: Any) -> Any:
        if isinstance(size, ProfileTable) and size.along != "radius":
            raise validation_error("is not possible for a disc", "use radius", "along", size.along)
        return size


class RectangleTable(_BuiltIn):
    """A sheet over [0, a] x [0, b] in z = 0 with clamped edges.

    Attributes:
        shape: The kind of sheet.
        size: Sides along x and y [m].
        element_size: Side of a triangle [m].
        pre_stretch: Stretches [along x, along y] of the flat sheet before it is clamped, from the origin; its shape and
            thickness are those before. None by default.
    """

    shape: Literal["rectangle"]
    size: Annotated[list[Length], Field(min_length=2, max_length=2)]
    element_size: Length | None = None
    pre_stretch: PreStretch | None = None


class Sphere(_BuiltIn):
    """A closed sphere about the origin, nothing clamped.

    Attributes:
        shape: The kind of sheet.
        radius: Radius of the sphere [m].
        element_size: Side of a triangle [m].
    """

    shape: Literal["sphere"]
    radius: Length
    element_size: Length | None = None


_End = Literal["clamped", "guided", "free"]
Ends = Annotated[
    Annotated[_End, Tag("<both>")] | Annotated[Annotated[list[_End], Field(min_length=2, max_length=2)], Tag("<each>")],
    form(lambda value: "each" if isinstance(value, list) else "both"),
]


class Tube(_BuiltIn):
    """A round tube about the z axis, from z = 0 to its length; pressure acts from inside.

    Attributes:
        shape: The kind of sheet.
        radius: Radius of the tube [m], or a profile of it along z, as flare and die swell make it.
        length: Its length [m].
        ends: Support of the end rings: `clamped`, `guided` (they stay in their planes) or `free`; one for both, or two,
            for the end at z = 0 and for that at the length.
        element_size: Side of a triangle [m].
    """

    shape: Literal["tube"]
    radius: ElementSize
    length: Length
    ends: Ends = "clamped"
    element_size: Length | None = None

    @field_validator("radius")
    @classmethod
    def _along_z(cls, radius: Any) -> Any:
        if isinstance(radius, ProfileTable) and radius.along != "z":
            raise validation_error("is not possible for a tube", "use z", "along", radius.along)
        return radius


class Preform(_BuiltIn):
    """A preform for stretch-blow moulding: a profile turned about the z axis; pressure acts from inside.

    It is closed at the end of the profile on the axis, and clamped at the other end, its neck.

    Attributes:
        shape: The kind of sheet.
        profile: Points [r, z] [m] of the middle of the wall, from the closed end to the neck or from the neck to the
            closed end.
        element_size: Side of a triangle [m].
    """

    shape: Literal["preform"]
    profile: Annotated[list[Point], Field(min_length=2)]
    element_size: Length | None = None


class BottleHalfParison(_Sheet):
    """Half of a flattened parison, pinched along the outline of a bottle with a handle.

    Attributes:
        shape: The kind of sheet.
        height: Height of the bottle [m].
        radius: Radius of the bottle's body [m].
        neck_radius: Radius of its neck [m].
        hole: Half width and half height of the hole of the handle [m].
        element_size: Side of a triangle [m].
        swell: Initial inflation: 0 is flat, 1 the bottle.
        neck_swell: Initial inflation at the neck, which a blow pin holds round; by default as elsewhere.
        inset: Distance of its pinched edge inside the bottle's outline [m].
        thickness: Initial thickness [m].
        temperature: Temperature of the sheet [degC], where the material has a time-temperature shift.
    """

    shape: Literal["bottle-half"]
    height: Length = 0.23
    radius: Length = 0.04
    neck_radius: Length = 0.014
    hole: Annotated[list[Length], Field(min_length=2, max_length=2)] = Field(default_factory=lambda: [0.0075, 0.027])
    element_size: Length = 0.0071
    swell: Annotated[float, Field(gt=0, lt=1)] = 0.3
    neck_swell: Annotated[float, Field(gt=0, lt=1)] | None = None
    inset: Length = 1.0e-3
    thickness: Thickness
    temperature: Temperature | None = None


class Outline(_Sheet):
    """A sheet of any planform, clamped along its edge.

    Attributes:
        shape: The kind of sheet.
        polygon: Its corners x, y [m] in z = 0, in either order; this or `mold_rim`.
        mold_rim: True if it is the opening of the mold, in the plane of its rim.
        element_size: Side of a triangle [m], less where the planform is narrow; this or `elements`.
        elements: Approximate number of triangles.
        planes: Symmetry planes: `x` where the polygon is cut at x = 0.
        thickness: Initial thickness [m].
        temperature: Temperature of the sheet [degC], where the material has a time-temperature shift.
        pre_stretch: Stretches [along x, along y] of the flat sheet before it is clamped, from the origin; its shape and
            thickness are those before. None by default.
    """

    shape: Literal["outline"]
    polygon: Annotated[list[Point], Field(min_length=3)] | None = None
    mold_rim: bool = False
    element_size: Length | None = None
    elements: Count | None = None
    planes: list[Literal["x", "y"]] = Field(default_factory=list)
    thickness: Thickness
    temperature: Temperature | None = None
    pre_stretch: PreStretch | None = None

    _no_own_field = field_validator("thickness", "temperature")(_given_elsewhere)

    @model_validator(mode="after")
    def _one_of_both(self) -> Outline:
        if (self.polygon is not None) == self.mold_rim:
            problem = "is given together with mold_rim" if self.mold_rim else "no planform is given"
            raise validation_error(problem, "give polygon = [[x, y], ...] or mold_rim = true, one of them", "polygon")
        if self.mold_rim and self.planes:
            raise validation_error(
                "is not possible with mold_rim", "give a polygon that is cut there", "planes", self.planes
            )
        return self


def _plane(text: str) -> str:
    try:
        parse_plane(text)
    except InputError as error:
        raise validation_error(error.problem, error.remedy, value=text) from None
    return text


class FileParison(_Sheet):
    """A user's mesh; pressure acts along its triangles' normals.

    Attributes:
        shape: The kind of sheet.
        path: A mesh file, relative to the scene file.
        scale: Factor on its coordinates: 0.001 of a mesh in millimetres.
        flip: Turns all triangles, and so the side that the pressure pushes to.
        clamp: Clamped nodes: `boundary` (open edges off the symmetry planes), `none`, or `field:NAME`, where that
            nodal field is not zero.
        planes: Symmetry planes: `x` where the mesh is cut at x = 0, `x=0.15` where it is at 0.15 m.
        thickness: Initial thickness [m]; `field:NAME` is a field of the mesh itself.
        temperature: Temperature of the sheet [degC], where the material has a time-temperature shift.
        pre_stretch: Stretches [along x, along y] of the flat sheet before it is clamped, from the origin; its shape and
            thickness are those before. None by default.
    """

    shape: Literal["file"]
    path: str
    scale: Positive = 1.0
    flip: bool = False
    clamp: str = "boundary"
    planes: list[Annotated[str, AfterValidator(_plane)]] = Field(default_factory=list)
    thickness: Thickness
    temperature: Temperature | None = None
    pre_stretch: PreStretch | None = None


Parison = Annotated[
    Annotated[Disc, Tag("<disc>")]
    | Annotated[RectangleTable, Tag("<rectangle>")]
    | Annotated[Sphere, Tag("<sphere>")]
    | Annotated[Tube, Tag("<tube>")]
    | Annotated[Preform, Tag("<preform>")]
    | Annotated[BottleHalfParison, Tag("<bottle-half>")]
    | Annotated[Outline, Tag("<outline>")]
    | Annotated[FileParison, Tag("<file>")],
    *choice("shape", ["disc", "rectangle", "sphere", "tube", "preform", "bottle-half", "outline", "file"]),
]

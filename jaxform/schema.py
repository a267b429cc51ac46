"""The one description of scene and study files: keys, types, ranges.

Lengths are in m, times in s, pressures and stiffnesses in Pa, densities in kg/m^3; nothing is converted. What needs
the mesh or several numbers at once is checked where the scene is built.
"""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import AfterValidator, BeforeValidator, Field, Tag, field_validator, model_validator

from jaxform.ranges import MOST_STEPS
from jaxform.validation import (
    Coordinate,
    Length,
    NotNegative,
    Number,
    Positive,
    Table,
    check_increasing,
    choice,
    form,
    within,
    wrong,
)

Triple = Annotated[list[Coordinate], Field(min_length=3, max_length=3)]
Pair = Annotated[list[Number], Field(min_length=2, max_length=2)]
Point = Annotated[list[Coordinate], Field(min_length=2, max_length=2)]
Count = Annotated[int, Field(ge=1, le=1_000_000_000)]
"""Of what no memory is taken for beforehand."""
Place = Literal["radius", "x", "y", "z"]

_THICKNESS_FORMS = 'give a number, {along, at, value}, {file, field} or "field:NAME"'


class Profile(Table):
    """A positive quantity, piecewise linear along a place in the initial sheet."""

    along: Place
    at: Annotated[list[Coordinate], Field(min_length=1)]
    value: list[Positive]

    @model_validator(mode="after")
    def _check(self) -> Profile:
        _check_knots(self.at, self.value)
        return self


class TargetProfile(Table):
    """A wanted thickness, piecewise linear along a place in the initial sheet or in the formed part."""

    along: Literal["initial-radius", "initial-x", "initial-y", "initial-z", "radius", "x", "y", "z"]
    at: Annotated[list[Coordinate], Field(min_length=1)]
    value: list[Positive]

    @model_validator(mode="after")
    def _check(self) -> TargetProfile:
        _check_knots(self.at, self.value)
        return self


class FieldReference(Table):
    """A nodal field in a mesh file, found by initial position [m]."""

    file: str
    field: str


class SceneReference(Table):
    """The wall that another scene makes, at the same initial places."""

    scene: str


def _check_knots(at: list[float], value: list[float]) -> None:
    check_increasing(at)
    if len(at) != len(value):
        problem = f"has {len(value)} values for {len(at)} knots"
        raise wrong(problem, "give one value per knot", "value", value)


def _own_field(text: str) -> str:
    if not text.startswith("field:") or text == "field:":
        raise wrong("is not a number", _THICKNESS_FORMS, value=text)
    return text


def _quantity_form(value: Any) -> str:
    if isinstance(value, dict):
        return "reference" if {"file", "field"} & set(value) else "profile"
    return "own field" if isinstance(value, str) else "number"


_Number = Annotated[Positive, Tag("<number>")]
_Wall = Annotated[float, within("parison.thickness")]
_Reference = Annotated[FieldReference, Tag("<reference>")]
Thickness = Annotated[
    Annotated[_Wall, Tag("<number>")]
    | Annotated[Profile, Tag("<profile>")]
    | _Reference
    | Annotated[str, AfterValidator(_own_field), Tag("<own field>")],
    form(_quantity_form),
]
ElementSize = Annotated[
    _Number | Annotated[Profile, Tag("<profile>")],
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


def _one_number(value: Any) -> Any:
    if isinstance(value, dict) or (isinstance(value, str) and value.startswith("field:")):
        raise wrong("stiffness zones are not there yet", "give one number", value=value)
    return value


_OneNumber = BeforeValidator(_one_number)
Density = Annotated[float, within("material.density")]


class _BuiltIn(Table):
    """What the built-in parisons share: exactly one of element_size and elements, cut planes, thickness."""

    elements: Count | None = None
    symmetry: Literal["none", "half", "quarter"] = "none"
    thickness: Thickness

    @field_validator("thickness")
    @classmethod
    def _no_own_field(cls, thickness: Any) -> Any:
        if isinstance(thickness, str):
            problem = "only a parison from a file has fields of its own"
            raise wrong(problem, "give {file, field}, a number or a profile", value=thickness)
        return thickness


class Disc(_BuiltIn):
    """A round sheet about the origin in z = 0 with a clamped rim."""

    shape: Literal["disc"]
    radius: Length
    element_size: ElementSize | None = None

    @field_validator("element_size")
    @classmethod
    def _along_radius(cls, size: Any) -> Any:
        if isinstance(size, Profile) and size.along != "radius":
            raise wrong("is not possible for a disc", "use radius", "along", size.along)
        return size


class Rectangle(_BuiltIn):
    """A sheet over [0, a] x [0, b] in z = 0 with clamped edges."""

    shape: Literal["rectangle"]
    size: Annotated[list[Length], Field(min_length=2, max_length=2)]
    element_size: Length | None = None


class Sphere(_BuiltIn):
    """A closed sphere about the origin, nothing clamped."""

    shape: Literal["sphere"]
    radius: Length
    element_size: Length | None = None


class BottleHalfParison(Table):
    """Half of a flattened parison, pinched along the outline of a bottle with a handle."""

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


class FileParison(Table):
    """A user's mesh; pressure acts along its triangles' normals."""

    shape: Literal["file"]
    path: str
    scale: Positive = 1.0
    flip: bool = False
    clamp: str = "boundary"
    planes: list[Literal["x", "y", "z"]] = Field(default_factory=list)
    thickness: Thickness


Parison = Annotated[
    Annotated[Disc, Tag("<disc>")]
    | Annotated[Rectangle, Tag("<rectangle>")]
    | Annotated[Sphere, Tag("<sphere>")]
    | Annotated[BottleHalfParison, Tag("<bottle-half>")]
    | Annotated[FileParison, Tag("<file>")],
    *choice("shape", ["disc", "rectangle", "sphere", "bottle-half", "file"], later=["tube"]),
]


class NeoHookean(Table):
    """W = c (I1 - 3)."""

    model: Literal["neo-hookean"]
    c: Annotated[float, within("material.c"), _OneNumber]
    density: Density


class MooneyRivlin(Table):
    """W = c [(I1 - 3) + alpha (I2 - 3)]."""

    model: Literal["mooney-rivlin"]
    c: Annotated[float, within("material.c"), _OneNumber]
    alpha: Annotated[float, within("material.alpha"), _OneNumber]
    density: Density


class ModifiedMooneyRivlin(Table):
    """W = a01 (I1 - 3) + a02 (I2 - 3)^2."""

    model: Literal["modified-mooney-rivlin"]
    a01: Annotated[float, within("material.a01"), _OneNumber]
    a02: Annotated[float, within("material.a02"), _OneNumber]
    density: Density


Material = Annotated[
    Annotated[NeoHookean, Tag("<neo-hookean>")]
    | Annotated[MooneyRivlin, Tag("<mooney-rivlin>")]
    | Annotated[ModifiedMooneyRivlin, Tag("<modified-mooney-rivlin>")],
    *choice("model", ["neo-hookean", "mooney-rivlin", "modified-mooney-rivlin"], later=["ogden"]),
]


class Pressure(Table):
    """Pressure difference over time, held before the first and after the last knot."""

    time: Annotated[list[Number], Field(min_length=1)]
    value: Annotated[list[Number], Field(min_length=1)]
    interpolation: Literal["linear", "cubic-ramp"] = "linear"


class RevolvedMold(Table):
    """A profile [[r, z], ...] from the axis outwards, turned about the z axis."""

    shape: Literal["revolved"]
    profile: Annotated[list[Point], Field(min_length=2)]
    segments: Annotated[int, Field(ge=3, le=1_000_000)]


class BoxInsertMold(Table):
    """A box, open at z = 0, with a raised block in the middle of its bottom."""

    shape: Literal["box-insert"]
    size: Annotated[list[Length], Field(min_length=2, max_length=2)] = Field(default_factory=lambda: [0.3, 0.2])
    depth: Length = 0.08
    insert_size: Annotated[list[Length], Field(min_length=2, max_length=2)] = Field(
        default_factory=lambda: [0.12, 0.08]
    )
    insert_height: Length = 0.04
    draft: NotNegative = 0.0
    divisions: Annotated[int, Field(ge=1, le=200)] = 1


class BottleHalfMold(Table):
    """Half of a soap bottle with a handle, z >= 0."""

    shape: Literal["bottle-half"]
    height: Length = 0.23
    radius: Length = 0.04
    neck_radius: Length = 0.014
    hole: Annotated[list[Length], Field(min_length=2, max_length=2)] = Field(default_factory=lambda: [0.0075, 0.027])
    element_size: Length = 0.00595


Paths = Annotated[
    Annotated[str, Tag("<one>")] | Annotated[Annotated[list[str], Field(min_length=1)], Tag("<several>")],
    form(lambda value: "several" if isinstance(value, list) else "one"),
]


class FileMold(Table):
    """A user's mesh, in one file or several: scaled, turned about x, y, z [degrees], then moved [m]."""

    shape: Literal["file"]
    path: Paths
    scale: Positive = 1.0
    translate: Triple = Field(default_factory=lambda: [0.0, 0.0, 0.0])
    rotate: Triple = Field(default_factory=lambda: [0.0, 0.0, 0.0])


Mold = Annotated[
    Annotated[RevolvedMold, Tag("<revolved>")]
    | Annotated[BoxInsertMold, Tag("<box-insert>")]
    | Annotated[BottleHalfMold, Tag("<bottle-half>")]
    | Annotated[FileMold, Tag("<file>")],
    *choice("shape", ["revolved", "box-insert", "bottle-half", "file"]),
]


class Refinement(Table):
    """Where the mesh becomes finer; see `jaxform.scene.Refinement`."""

    angle: Annotated[float, within("refinement.angle")] = 4.0
    interval: Annotated[int, within("refinement.interval")] = 100
    max_level: Annotated[int, within("refinement.max_level")] = 6
    min_area: Annotated[float, within("refinement.min_area")] = 0.0
    base_level: Annotated[int, within("refinement.base_level")] = 0
    base_reach: Annotated[float, within("refinement.base_reach")] = 1.0
    scaled_levels: Annotated[int, within("refinement.scaled_levels")] = 0
    at_rest: bool = True
    jump: Annotated[float, within("refinement.jump")] | None = None
    elements: Annotated[int, within("refinement.elements")] | None = None


class Solver(Table):
    """Time integration; `quasi_static` says that the process is meant to be slow, so that haste is warned of."""

    end_time: Annotated[float, within("solver.end_time")]
    damping: Annotated[float, within("solver.damping")] | None = None
    safety: Annotated[float, within("solver.safety")] = 0.9
    quasi_static: bool = False
    max_steps: Annotated[int, within("solver.max_steps")] = MOST_STEPS


class Output(Table):
    """What to write beyond the result; `reference` is an exact solution to dot over the thickness picture."""

    frames: Annotated[int, Field(ge=0, le=100_000)] = 0
    reference: str | None = None


class SceneFile(Table):
    """A scene file."""

    name: str | None = None
    description: str = ""
    parison: Parison
    material: Material
    pressure: Pressure
    mold: Mold | None = None
    refinement: Refinement | None = None
    solver: Solver
    output: Output = Output()


def _check_bounds(bounds: list[float]) -> list[float]:
    if bounds[0] >= bounds[1]:
        raise wrong("leaves no room", "give the lower bound first, then the upper one", value=bounds)
    return bounds


Limits = Annotated[list[Positive], Field(min_length=2, max_length=2), AfterValidator(_check_bounds)]


class ThicknessProfile(Table):
    """Design the initial thickness [m] along a place in the initial sheet; `slope` limits its change [m/m]."""

    kind: Literal["thickness-profile"]
    along: Place
    knots: Annotated[int, Field(ge=2, le=10_000)] | None = None
    at: Annotated[list[Coordinate], Field(min_length=2)] | None = None
    bounds: Limits
    interpolation: Literal["linear", "cubic", "zones"] = "linear"
    slope: Positive | None = None

    @model_validator(mode="after")
    def _check(self) -> ThicknessProfile:
        if (self.knots is None) == (self.at is None):
            problem = "is missing" if self.at is None else "is given together with at"
            raise wrong(problem, "give the number of knots or their places (at), one of them", "knots", self.knots)
        check_increasing(self.at or [])
        if self.interpolation == "cubic" and (self.knots or 0) < 4:
            raise wrong("needs 4 evenly placed knots or more", "give knots, not at", "knots", self.knots)
        if self.interpolation == "zones" and self.slope is not None:
            raise wrong("does not go with zones, which jump", "leave it out", "slope", self.slope)
        return self


class ThicknessField(Table):
    """Design the initial thickness [m] at the nodes of the mesh, no finer than a length `smoothness` [m]."""

    kind: Literal["thickness-field"]
    bounds: Limits
    smoothness: NotNegative = 0.0


class PressureKnots(Table):
    """Design the values [Pa] at the knots of the scene's pressure; `rate` [Pa/s], the last knot's time [s].

    `held` keeps the first knot's value where there is a rate; else the history may begin with a jump.
    """

    kind: Literal["pressure"]
    bounds: Annotated[Pair, AfterValidator(_check_bounds)]
    increasing: bool = False
    rate: Positive | None = None
    held: bool = False
    end_time: Limits | None = None


class Scale(Table):
    """Design a factor on a number of the scene, such as material.c."""

    kind: Literal["scale"]
    of: str
    bounds: Limits


_VARIABLES = ["thickness-profile", "thickness-field", "pressure", "scale"]
Variable = Annotated[
    Annotated[ThicknessProfile, Tag("<thickness-profile>")]
    | Annotated[ThicknessField, Tag("<thickness-field>")]
    | Annotated[PressureKnots, Tag("<pressure>")]
    | Annotated[Scale, Tag("<scale>")],
    *choice("kind", _VARIABLES),
]


class Wanted(Table):
    """What all objectives share: by how much each counts where there are several."""

    weight: Positive = 1.0


class Target(Wanted):
    """Come close to a final thickness [m]; with `limit`, keep a deviation (relative, rms) instead."""

    kind: Literal["target"]
    thickness: TargetThickness
    limit: Positive | None = None


class Uniform(Wanted):
    """Make the wall even."""

    kind: Literal["uniform"]


class LeastMass(Wanted):
    """Use as little material as a minimum of the wall [m] allows."""

    kind: Literal["least-mass"]
    minimum: Positive


class FormingTime(Wanted):
    """Form quickly; the higher the power of the mean, the more the last contact counts."""

    kind: Literal["forming-time"]
    power: Annotated[float, Field(ge=1, le=100)] = 8.0


class KineticEnergy(Wanted):
    """Form gently."""

    kind: Literal["kinetic-energy"]


_OBJECTIVES = ["target", "uniform", "least-mass", "forming-time", "kinetic-energy"]
Objective = Annotated[
    Annotated[Target, Tag("<target>")]
    | Annotated[Uniform, Tag("<uniform>")]
    | Annotated[LeastMass, Tag("<least-mass>")]
    | Annotated[FormingTime, Tag("<forming-time>")]
    | Annotated[KineticEnergy, Tag("<kinetic-energy>")],
    *choice("kind", _OBJECTIVES),
]
Objectives = Annotated[
    Annotated[Objective, Tag("<one>")] | Annotated[Annotated[list[Objective], Field(min_length=1)], Tag("<several>")],
    form(lambda value: "several" if isinstance(value, list) else "one"),
]


class _Search(Table):
    """What all methods share; see `optimize.Study`."""

    iterations: Count = 30
    max_simulations: Positive | None = None
    minutes: Positive | None = None
    tolerance: NotNegative | None = None
    gradient_tolerance: NotNegative | None = None
    goal: Positive | None = None
    warm_start: Annotated[int, Field(ge=0, le=1_000_000)] = 0
    starts: Annotated[int, Field(ge=1, le=10_000)] = 1
    rounds: Count | None = None


class Lbfgs(_Search):
    """Limited-memory quasi-Newton method with line search."""

    method: Literal["lbfgs"] = "lbfgs"


class Adam(_Search):
    """First-order method with momentum."""

    method: Literal["adam"]
    learning_rate: Positive | None = None


class LeastSquares(_Search):
    """Levenberg-Marquardt, for few variables and a sum of squares."""

    method: Literal["least-squares"]


class FixedPoint(_Search):
    """Thicken the sheet where the wall is thin."""

    method: Literal["fixed-point"]


Method = Annotated[
    Annotated[Lbfgs, Tag("<lbfgs>")]
    | Annotated[Adam, Tag("<adam>")]
    | Annotated[LeastSquares, Tag("<least-squares>")]
    | Annotated[FixedPoint, Tag("<fixed-point>")],
    *choice("method", ["lbfgs", "adam", "least-squares", "fixed-point"]),
]


class StudyFile(Table):
    """A study file."""

    description: str = ""
    scene: str
    variable: Annotated[list[Variable], Field(min_length=1)]
    objective: Objectives
    solver: Method

    @field_validator("variable")
    @classmethod
    def _each_once(cls, variables: list[Any]) -> list[Any]:
        kinds = [getattr(variable, "of", variable.kind) for variable in variables]
        for index, kind in enumerate(kinds):
            if kind in kinds[:index]:
                raise wrong("is there twice", "keep one of them", f"[{index}].kind", kind)
        return variables

"""Tables of the material models; each parameter may vary over the sheet."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import Field, Tag, model_validator

from jaxform.core.ranges import OF_LAWS
from jaxform.io.schema.quantities import Zoned
from jaxform.io.validation import Table, allow_range, choice, declared_range, validation_error


def _in(law: str, key: str) -> Any:
    """The range of a material model's parameter, for `Annotated`."""
    return allow_range(OF_LAWS[law][key])


_MOST_TERMS = 6
_MOST_MODES = 12
Density = Zoned[Annotated[float, declared_range("material.density")]]


class Viscous(Table):
    """Maxwell branches, whose stress is added to that of the material model, which is then the long-term response.

    Attributes:
        kind: "christensen", which follows the strain, for sheets of thermoplastic; or "maxwell", upper-convected
            Maxwell modes, for melts.
        modulus: Modulus of each branch [Pa].
        time: Relaxation time of each branch [s].
    """

    kind: Literal["christensen", "maxwell"]
    modulus: Annotated[
        list[Annotated[float, declared_range("material.viscous.modulus")]], Field(min_length=1, max_length=_MOST_MODES)
    ]
    time: Annotated[
        list[Annotated[float, declared_range("material.viscous.time")]], Field(min_length=1, max_length=_MOST_MODES)
    ]

    @model_validator(mode="after")
    def _check(self) -> Viscous:
        if len(self.time) != len(self.modulus):
            problem = f"has {len(self.time)} numbers, modulus has {len(self.modulus)}"
            raise validation_error(problem, "give one for each mode", "time", self.time)
        return self


class WlfShift(Table):
    """Relaxation times by temperature: log10 a = -c1 (T - reference) / (c2 + T - reference).

    Attributes:
        kind: The kind of shift.
        reference: Temperature [degC] at which the material parameters hold.
        c1: Dimensionless constant; 17.44 where the reference is the glass transition.
        c2: Constant [K]; 51.6 where the reference is the glass transition.
    """

    kind: Literal["wlf"]
    reference: Annotated[float, declared_range("material.shift.reference")]
    c1: Annotated[float, declared_range("material.shift.c1")]
    c2: Annotated[float, declared_range("material.shift.c2")]


class ArrheniusShift(Table):
    """Relaxation times by temperature: ln a = E / R (1 / T - 1 / reference), in kelvin.

    Attributes:
        kind: "arrhenius" shifts times alone, "arrhenius-stiffness" all moduli as well.
        reference: Temperature [degC] at which the material parameters hold.
        activation_energy: Activation energy E [J/mol].
    """

    kind: Literal["arrhenius", "arrhenius-stiffness"]
    reference: Annotated[float, declared_range("material.shift.reference")]
    activation_energy: Annotated[float, declared_range("material.shift.activation_energy")]


_SHIFTS = ["wlf", "arrhenius", "arrhenius-stiffness"]
Shift = Annotated[
    Annotated[WlfShift, Tag("<wlf>")]
    | Annotated[ArrheniusShift, Tag("<arrhenius>")]
    | Annotated[ArrheniusShift, Tag("<arrhenius-stiffness>")],
    *choice("kind", _SHIFTS),
]


class _LawTable(Table):
    """Keys that all material models share.

    Attributes:
        density: Mass per volume [kg/m^3].
        viscous: Maxwell branches; without them the sheet has no memory.
        shift: Time-temperature shift; without it the sheet's temperature has no effect on its stress.
        tension_field: Whether the sheet goes slack and wrinkles where it would otherwise be compressed.
    """

    density: Density
    viscous: Viscous | None = None
    shift: Shift | None = None
    tension_field: bool = False


class NeoHookeanTable(_LawTable):
    """W = c (I1 - 3).

    Attributes:
        model: Name of the material model.
        c: Half the shear modulus [Pa].
    """

    model: Literal["neo-hookean"]
    c: Zoned[Annotated[float, declared_range("material.c")]]


class MooneyRivlinTable(_LawTable):
    """W = c [(I1 - 3) + alpha (I2 - 3)].

    Attributes:
        model: Name of the material model.
        c: First coefficient [Pa].
        alpha: Ratio of the second coefficient to the first.
    """

    model: Literal["mooney-rivlin"]
    c: Zoned[Annotated[float, declared_range("material.c")]]
    alpha: Zoned[Annotated[float, declared_range("material.alpha")]]


class ModifiedMooneyRivlinTable(_LawTable):
    """W = a01 (I1 - 3) + a02 (I2 - 3)^2.

    Attributes:
        model: Name of the material model.
        a01: Coefficient of I1 - 3 [Pa].
        a02: Coefficient of (I2 - 3)^2 [Pa].
    """

    model: Literal["modified-mooney-rivlin"]
    a01: Zoned[Annotated[float, declared_range("material.a01")]]
    a02: Zoned[Annotated[float, declared_range("material.a02")]]


class YeohTable(_LawTable):
    """W = c1 (I1 - 3) + c2 (I1 - 3)^2 + c3 (I1 - 3)^3.

    Attributes:
        model: Name of the material model.
        c1: Half the shear modulus in small strain [Pa].
        c2: Coefficient of the square [Pa].
        c3: Coefficient of the cube [Pa].
    """

    model: Literal["yeoh"]
    c1: Zoned[Annotated[float, _in("yeoh", "c1")]]
    c2: Zoned[Annotated[float, _in("yeoh", "c2")]] = 0.0
    c3: Zoned[Annotated[float, _in("yeoh", "c3")]] = 0.0


class GentTable(_LawTable):
    """W = -mu j_max / 2 ln(1 - (I1 - 3) / j_max), which does not stretch beyond a limit.

    Attributes:
        model: Name of the material model.
        mu: Shear modulus in small strain [Pa].
        j_max: Limit of I1 - 3; from 99 % of it on the energy goes on as a parabola.
    """

    model: Literal["gent"]
    mu: Zoned[Annotated[float, _in("gent", "mu")]]
    j_max: Zoned[Annotated[float, _in("gent", "j_max")]]


class OgdenTable(_LawTable):
    """W = sum of mu / alpha (l1^alpha + l2^alpha + l3^alpha - 3), l1 to l3 the principal stretches.

    Attributes:
        model: Name of the material model.
        mu: Modulus of each term [Pa]; the sum of mu alpha is twice the shear modulus in small strain.
        alpha: The powers, of which none is 0.
    """

    model: Literal["ogden"]
    mu: Annotated[list[Zoned[Annotated[float, _in("ogden", "mu")]]], Field(min_length=1, max_length=_MOST_TERMS)]
    alpha: Annotated[list[Zoned[Annotated[float, _in("ogden", "alpha")]]], Field(min_length=1, max_length=_MOST_TERMS)]


Material = Annotated[
    Annotated[NeoHookeanTable, Tag("<neo-hookean>")]
    | Annotated[MooneyRivlinTable, Tag("<mooney-rivlin>")]
    | Annotated[ModifiedMooneyRivlinTable, Tag("<modified-mooney-rivlin>")]
    | Annotated[YeohTable, Tag("<yeoh>")]
    | Annotated[GentTable, Tag("<gent>")]
    | Annotated[OgdenTable, Tag("<ogden>")],
    *choice("model", ["neo-hookean", "mooney-rivlin", "modified-mooney-rivlin", "yeoh", "gent", "ogden"]),
]
